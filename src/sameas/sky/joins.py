"""The joined tables of two catalogues, with columns on each pair: :func:`joined`.

Join types have the names of STILTS; "pairs" lists every candidate, and for every row of the first catalogue the answer
"no partner" (its probability is p_none).

Added columns (all lower case):

sep_arcsec, dx_arcsec, dy_arcsec : separation, and its east and north parts, first minus second, at the common epoch.
mahalanobis : separation over its quoted error. log_odds : natural logarithm of the pair's odds before one-to-one.
p_match : probability of the pair. p_none : probability that the row has no partner. p_second, id_second : the most
probable other candidate. match_flag : 1 the identified pair, 2 a candidate at least half as probable as the row's
best, 0 others. group_id, group_size : the group of competing records. n_within : candidates of the row.
covered : whether the other catalogue covers the position.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from astropy.table import Column, MaskedColumn, Table
from numpy.typing import NDArray

from sameas.arrays import ABSENT, BoolArray, FloatArray, IntArray, taken
from sameas.estimate.coverage import Coverage
from sameas.kernels import threads
from sameas.records import Records
from sameas.result import Answers, Identification
from sameas.sky.output_columns import JOINS, attributes_of, check_join, free_name
from sameas.space import Sphere

if TYPE_CHECKING:
    from sameas.estimate.blends import Blends

#: Rows of a piece of :class:`JoinedTable`: 20 columns of numbers take 40 MB.
PIECE_ROWS = 1 << 18


class JoinedSource(Protocol):
    """A source with a table."""

    @property
    def table(self) -> Table: ...
    @property
    def ids(self) -> NDArray[Any]: ...
    def __len__(self) -> int: ...


class Joinable(Protocol):
    """A match of two sources with tables to join: a ``SkyMatch``, or a :class:`RecordsMatch`."""

    @property
    def first(self) -> JoinedSource: ...
    @property
    def second(self) -> JoinedSource: ...
    @property
    def result(self) -> Identification: ...
    @property
    def covered_1(self) -> BoolArray: ...
    @property
    def covered_2(self) -> BoolArray: ...


@dataclass(frozen=True)
class RecordsTable:
    """Records as a source with a table: their own astropy table if they have one, else rows and ids."""

    records: Records

    @property
    def ids(self) -> NDArray[Any]:
        """(n,) identifiers."""
        return self.records.ids

    @cached_property
    def table(self) -> Table:
        """(n,) rows."""
        if isinstance(self.records.table, Table):
            return self.records.table
        return Table({"row": np.arange(len(self)), "id": self.records.ids})

    def __len__(self) -> int:
        return self.records.n_table


@dataclass(frozen=True)
class RecordsMatch:
    """A match of two sources of records, with the tables to join. coverage : of both sources."""

    result: Identification
    coverage: Coverage

    @cached_property
    def first(self) -> RecordsTable:
        """The first source."""
        return RecordsTable(self.result.first)

    @cached_property
    def second(self) -> RecordsTable:
        """The second source."""
        return RecordsTable(self.result.second)

    @cached_property
    def covered_1(self) -> BoolArray:
        """(n,) whether the second source covers the position of each row of the first; True for unusable rows."""
        return self.result.first.over_table(self.coverage.covered[0])

    @cached_property
    def covered_2(self) -> BoolArray:
        """(n,) whether the first source covers the position of each row of the second; True for unusable rows."""
        return self.result.second.over_table(self.coverage.covered[1])


def pair_table(result: Identification) -> Table:
    """The identified pairs: rows and ids of both, probability, separation, sorted by the first source."""
    matches = result.matches
    columns: dict[str, NDArray[Any]] = {
        "row_1": matches.rows_1, "row_2": matches.rows_2,
        "id_1": result.first.ids[matches.rows_1], "id_2": result.second.ids[matches.rows_2], "p_match": matches.p_match,
    }  # fmt: skip
    columns[_separation_names(result)[0]] = np.linalg.norm(matches.residual, axis=1)
    columns |= {"mahalanobis": matches.mahalanobis, "log_odds": matches.log_odds}
    table = Table()
    for name, values in columns.items():
        table.add_column(Column(values, **attributes_of(name)), name=name, copy=False)
    return table


def blend_table(first: Records, second: Records, blends: Blends) -> Table:
    """One row per record of the coarse source, by its rows: its best answer (partners) and probabilities."""
    table, order = Table(), np.argsort(first.rows)
    columns: dict[str, tuple[NDArray[Any], str]] = {
        "row_1": (first.rows[order], "row in the first source"),
        "id_1": (first.ids[first.rows[order]], "id in the first source"),
    }
    partners = blends.partner[order], blends.other[order]
    for mark, partner, which in zip(("", "b"), partners, ("object", "other object of a blend"), strict=True):
        rows = np.ma.array(second.rows[partner.filled(0)], mask=np.ma.getmaskarray(partner))
        columns[f"row_2{mark}"] = rows, f"row of the {which} in the second source"
        ids = np.ma.array(second.ids[rows.filled(0)], mask=np.ma.getmaskarray(partner))
        columns[f"id_2{mark}"] = ids, f"id of the {which} in the second source"
    columns["p_match"] = blends.p_match[order], "probability of this answer"
    columns["p_blend"] = blends.p_blend[order], "probability that the record is two objects, whichever"
    for name, (values, words) in columns.items():
        column = MaskedColumn if isinstance(values, np.ma.MaskedArray) else Column
        table.add_column(column(values, description=words), name=name)
    return table


def _separation_names(result: Identification) -> list[str]:
    """Names of the separation and residual columns: in arcsec on the sphere, else in the unit of the features."""
    if isinstance(result.first.space, Sphere):
        return ["sep_arcsec", "dx_arcsec", "dy_arcsec"]
    return ["separation", *(f"residual_{axis}" for axis in range(1, result.pairs.d + 1))]


@dataclass(frozen=True)
class JoinedRows:
    """The rows of the output: row in the first and in the second table, and the pair, ABSENT for none.

    answers : whether each is a possible answer for its row of the first table, including "no partner"; pairs are then
        numbered among all candidates, else among the identified ones.
    """

    one: IntArray
    two: IntArray
    pair: IntArray
    answers: bool = False

    def of(self, own_1: BoolArray, own_2: BoolArray) -> JoinedRows:
        """The rows whose record is selected: in the first table, mask (n₁,), or without one in the second, (n₂,)."""
        return self.take(np.flatnonzero(self.either(own_1, own_2)))

    def take(self, rows: IntArray | slice) -> JoinedRows:
        """The output rows at indices (k,), in this order, or those of a slice, without a copy."""
        return JoinedRows(self.one[rows], self.two[rows], self.pair[rows], self.answers)

    def either(self, of_1: NDArray[Any], of_2: NDArray[Any]) -> NDArray[Any]:
        """Values (n₁,) of the row of the first table, or (n₂,) of the second where there is none."""
        if self.has_first.all():
            return of_1[self.one]
        values = np.empty(len(self.one), np.promote_types(of_1.dtype, of_2.dtype))
        values[self.has_first] = of_1[self.one[self.has_first]]
        values[~self.has_first] = of_2[self.two[~self.has_first]]
        return values

    @cached_property
    def absent(self) -> BoolArray:
        """Mask of the rows without a pair."""
        return self.pair < 0

    @cached_property
    def of_first(self) -> IntArray | slice:
        """The rows in the first table, as a slice if they are consecutive."""
        return _as_slice(self.one)

    @property
    def of_second(self) -> IntArray | slice:
        """The rows in the second table, as a slice if they are consecutive."""
        return _as_slice(self.two)

    @cached_property
    def has_first(self) -> BoolArray:
        """Mask of the rows with a record of the first catalogue; the others have one of the second only."""
        return self.one >= 0


def joined(
    match: Joinable, join: str = JOINS[0], *, nway_columns: bool = False, rows: JoinedRows | None = None
) -> Table:
    """The joined table.

    join : one of :data:`~sameas.sky.output_columns.JOINS`.
    nway_columns : add ``p_any``, ``p_i`` and ``dist_bayesfactor`` by NWAY's names.
    rows : some of :func:`joined_rows`; None: all.

    Raises InputError: an unknown join.
    """
    rows = joined_rows(match, join) if rows is None else rows
    table = Table()
    names = joined_names([match.first.table, match.second.table])
    for side, (source, at) in enumerate(((match.first.table, rows.of_first), (match.second.table, rows.of_second))):
        calls = [partial(taken_rows, column, at) for column in source.columns.values()]
        for name, column in zip(names[side], threads.each(calls, len(rows.one)), strict=True):
            table.add_column(column, name=name, copy=False)
    for name, values in _JoinedColumns(match, rows).columns(nway_columns).items():
        unique = free_name(name, table.colnames)
        table.add_column(MaskedColumn(values, **attributes_of(name)), name=unique, copy=False)
    return table


@dataclass(frozen=True)
class JoinedTable:
    """A joined table that is computed in pieces of ``piece_rows`` rows while it is written."""

    match: Joinable
    join: str = JOINS[0]
    nway_columns: bool = False
    piece_rows: int = PIECE_ROWS

    @cached_property
    def rows(self) -> JoinedRows:
        """All rows of the table."""
        return joined_rows(self.match, self.join)

    @cached_property
    def colnames(self) -> list[str]:
        """Names of the columns."""
        names: list[str] = self._of(self.rows.take(slice(0, 0))).colnames
        return names

    def __len__(self) -> int:
        return len(self.rows.one)

    def whole(self) -> Table:
        """The table."""
        return self._of(self.rows)

    def pieces(self) -> Iterator[Table]:
        """The table in pieces, or whole where the types of columns depend on all rows."""
        tables = self.match.first.table, self.match.second.table
        typed = all(
            isinstance(column, Column) and column.dtype.kind != "O"
            for table in tables
            for column in table.columns.values()
        )
        if not typed or not self.rows.has_first.all() or len(self) <= self.piece_rows:
            yield self.whole()
            return
        for begin in range(0, len(self), self.piece_rows):
            yield self._of(self.rows.take(slice(begin, begin + self.piece_rows)))

    def _of(self, rows: JoinedRows) -> Table:
        return joined(self.match, self.join, nway_columns=self.nway_columns, rows=rows)


def joined_rows(match: Joinable, join: str) -> JoinedRows:
    """The rows of a join.

    Raises InputError: an unknown join.
    """
    check_join(join)
    result = match.result
    if join == "pairs":
        return _every_answer(result)
    matches = result.matches
    both = JoinedRows(matches.rows_1, matches.rows_2, np.arange(len(matches)))
    alone_1, alone_2 = _others(len(match.first), matches.rows_1), _others(len(match.second), matches.rows_2)
    none_1, none_2 = np.full(len(alone_1), ABSENT), np.full(len(alone_2), ABSENT)
    only_1, only_2 = JoinedRows(alone_1, none_1, none_1), JoinedRows(none_2, alone_2, none_2)
    parts = {
        "1and2": (both,), "1or2": (both, only_1, only_2), "all1": (both, only_1), "all2": (both, only_2),
        "1not2": (only_1,), "2not1": (only_2,), "1xor2": (only_1, only_2),
    }[join]  # fmt: skip
    one, two, pair = (np.concatenate([getattr(part, name) for part in parts]) for name in ("one", "two", "pair"))
    # Sorted by the rows of the leading table; rows without one come last. The parts are sorted already, which a stable
    # sort exploits; ties are within one part.
    leading = two if join == "all2" else one
    order = np.argsort(np.where(leading >= 0, leading, np.iinfo(np.int64).max), kind="stable")
    return JoinedRows(one[order], two[order], pair[order])


def _others(n: int, rows: IntArray) -> IntArray:
    """The rows of a table of n that are not in ``rows``, ascending."""
    other = np.ones(n, np.bool_)
    other[rows] = False
    return np.flatnonzero(other)


def _every_answer(result: Identification) -> JoinedRows:
    """All candidates of each row of the first catalogue, the most probable first, followed by "no partner"."""
    n = result.first.n_table
    none = np.full(n, ABSENT)
    one = np.concatenate([result.rows_1, np.arange(n)])
    two = np.concatenate([result.rows_2, none])
    pair = np.concatenate([np.arange(len(result.pairs)), none])
    order = np.lexsort([np.concatenate([-result.p_pair, np.ones(n)]), one])
    return JoinedRows(one[order], two[order], pair[order], answers=True)


def joined_names(tables: Sequence[Table]) -> list[list[str]]:
    """Column names of all tables; names in several get the suffixes _1, _2 …, as in STILTS."""
    count = Counter(name for table in tables for name in {name.lower() for name in table.colnames})
    return [
        [f"{name}_{k}" if count[name.lower()] > 1 else name for name in table.colnames]
        for k, table in enumerate(tables, 1)
    ]


def _as_slice(rows: IntArray) -> IntArray | slice:
    """Row numbers as a slice if they are consecutive, which saves copies."""
    if not len(rows) or rows[0] < 0 or rows[-1] - rows[0] != len(rows) - 1 or np.any(np.diff(rows) != 1):
        return rows
    return slice(int(rows[0]), int(rows[-1]) + 1)


def taken_rows(column: Any, at: IntArray | slice) -> Any:
    """The rows ``at`` of a column, masked where ABSENT."""
    if isinstance(at, slice):
        return column if at == slice(0, len(column)) else column[at]
    absent = at < 0
    if not absent.any():
        return column[at]
    if not isinstance(column, Column):  # mixin columns such as Time mask their own cells
        picked = column[at]
        picked[absent] = np.ma.masked
        return picked
    if not len(column):
        values = np.zeros((len(at), *column.shape[1:]), column.dtype)
        mask = np.zeros(values.shape, bool)
    else:
        picked = column[at]  # ABSENT reads the last row, masked below
        values, mask = np.ma.getdata(picked), np.ma.getmaskarray(picked)
    mask = mask | absent.reshape(-1, *[1] * (values.ndim - 1))
    return MaskedColumn(
        values, name=column.name, mask=mask, unit=column.unit, description=column.description, meta=column.meta
    )


@dataclass(frozen=True)
class _JoinedColumns:
    """The columns added to the output's rows."""

    match: Joinable
    rows: JoinedRows

    def columns(self, nway_columns: bool) -> dict[str, np.ma.MaskedArray]:
        """The added columns, by name."""
        result, n = self.match.result, len(self.rows.one)
        # Computed here, before the threads below need these cached values.
        _ = result.answers_1 if self.rows.has_first.all() else result.both_answers
        _ = self.rows.absent, self.rows.of_first
        residual, distance, log_odds, p_pair = self._of_pairs()
        calls: dict[str, Callable[[], np.ma.MaskedArray]] = {
            "mahalanobis": lambda: self._of_pair(distance),
            "log_odds": lambda: self._of_pair(log_odds),
            "p_match": lambda: self._of_pair(p_pair),
            "p_none": lambda: self._of_row("p_none"),
            "p_second": lambda: self._of_row("p_second"),
            "id_second": self._id_second,
            "match_flag": self._flags,
            "group_id": lambda: self._of_row("group"),
            "group_size": lambda: self._of_row("group_size"),
            "n_within": lambda: self._of_row("candidates"),
            "covered": self._covered,
        }
        columns = self._separations(residual) | dict(zip(calls, threads.each(list(calls.values()), n), strict=True))
        if nway_columns:
            columns["p_any"] = 1.0 - columns["p_none"]
            with np.errstate(divide="ignore", invalid="ignore"):
                columns["p_i"] = columns["p_match"] / np.ma.masked_less_equal(columns["p_any"], 0.0)
            columns["dist_bayesfactor"] = columns["log_odds"] / np.log(10.0)
        return columns

    def _of_pairs(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Residuals, normalised distances, log-odds and probabilities of the pairs that the rows refer to."""
        result = self.match.result
        if self.rows.answers:
            return result.pairs.residual, np.sqrt(result.pairs.mahalanobis_sq), result.log_odds, result.p_pair
        matches = result.matches
        return matches.residual, matches.mahalanobis, matches.log_odds, matches.p_match

    def _of_pair(self, values: NDArray[Any]) -> np.ma.MaskedArray:
        absent = self.rows.absent
        if not len(values):
            return np.ma.MaskedArray(np.zeros((len(absent), *values.shape[1:]), values.dtype), absent)
        selected = taken(values, self.rows.pair)  # ABSENT reads the last pair, masked below
        selected[absent] = 0
        return np.ma.MaskedArray(selected, absent)

    def _separations(self, residual: FloatArray) -> dict[str, np.ma.MaskedArray]:
        n, d = len(self.rows.one), residual.shape[1]
        offsets = threads.each([partial(self._of_pair, residual[:, axis]) for axis in range(d)], n)
        distance = np.abs(offsets[0].data)
        for offset in offsets[1:]:
            distance = np.hypot(distance, offset.data)
        values = [np.ma.MaskedArray(distance, self.rows.absent), *offsets]
        return dict(zip(_separation_names(self.match.result), values, strict=True))

    def _of_row(self, name: str) -> np.ma.MaskedArray:
        return self._either(lambda side: getattr(self._answers(side), name))

    def _id_second(self) -> np.ma.MaskedArray:
        if self.rows.has_first.all():
            return _second_ids(self.match, self._answers(1).second[self.rows.of_first], 2)
        return self._either(lambda side: _second_ids(self.match, self._answers(side).second, 3 - side))

    def _answers(self, side: int) -> Answers:
        return self.match.result.answers_1 if side == 1 else self.match.result.answers_2

    def _either(self, of_side: Callable[[int], np.ma.MaskedArray]) -> np.ma.MaskedArray:
        """Values of the row's record: ``of_side(1)`` of the first catalogue, or ``of_side(2)`` where it has none."""
        rows, one = self.rows, of_side(1)
        if rows.has_first.all():
            return one[rows.of_first]
        two = of_side(2)
        if one.dtype.kind in "OSU" or one.dtype != two.dtype:
            one, two = np.ma.asarray(one.astype(str)), np.ma.asarray(two.astype(str))
        values, mask = (rows.either(part(one), part(two)) for part in (np.ma.getdata, np.ma.getmaskarray))
        return np.ma.MaskedArray(values, mask)

    def _covered(self) -> np.ma.MaskedArray:
        covered = self.rows.either(self.match.covered_1, self.match.covered_2)
        return np.ma.MaskedArray(covered, np.ma.getmaskarray(self._of_row("p_none")))

    def _flags(self) -> np.ma.MaskedArray:
        result, rows, absent = self.match.result, self.rows, self.rows.absent
        if not rows.answers:  # all listed pairs are identified
            return np.ma.MaskedArray((~absent).astype(np.int16), np.zeros(len(absent), bool))
        chosen = np.append(result.chosen, False)[rows.pair] & ~absent
        best = np.zeros(len(self.match.first))
        np.maximum.at(best, result.rows_1, result.p_pair)
        p = np.append(result.p_pair, 0.0)[rows.pair]
        chosen |= absent & result.answers_1.usable[rows.one] & ~np.isin(rows.one, result.matches.rows_1)
        rival = ~absent & ~chosen & (p >= 0.5 * best[rows.one]) & (p > 0)
        return np.ma.MaskedArray(np.where(chosen, 1, np.where(rival, 2, 0)).astype(np.int16), np.zeros(len(p), bool))


def _second_ids(match: Joinable, rows: np.ma.MaskedArray, other: int) -> np.ma.MaskedArray:
    """The ids of rows (n,) of a source; masked as these."""
    ids = (match.first if other == 1 else match.second).ids
    absent = np.ma.getmaskarray(rows)
    if not len(ids):
        return np.ma.MaskedArray(np.zeros(len(absent), ids.dtype), np.ones(len(absent), np.bool_))
    return np.ma.MaskedArray(ids[np.where(absent, 0, np.ma.getdata(rows))], absent)

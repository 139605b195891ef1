"""Columns and quoted errors as evidence: how a number or category of a record changes its odds of having a partner.

The evidence of a column with the value c is (METHOD 6, equation 6.6)

    ln r(c) = ln p(c | record has a partner) − ln p(c | record that the other source does not show),

in the limit of certain pairs Sutherland & Saunders' q(m)/n(m). ``sameas.estimate.columns`` estimates it from the pairs,
for all columns of a source jointly; :class:`OddsTable` is a prior given by the user instead. A :class:`Related` pair of
columns, one of each source, adds ln p(c₁, c₂ | one object) − ln p(c₁ | one object) − ln p(c₂ | one object).

:class:`Precision` compares the sizes of the quoted errors of both records, which are correlated for one object. Errors
grow with magnitude. So a shallower source more often misses a record with large errors, and both records of an object
have either large or small errors: quoted errors substitute for a magnitude where none is given.
``sameas.estimate.grades`` estimates this evidence.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import FloatArray, IntArray
from sameas.errors import InputError
from sameas.evidence.rule import Evidence, Rule
from sameas.gate import Pairs
from sameas.records import Records
from sameas.representation import in_short

#: A column of integers with at most this many different values is categorical (chosen).
MAX_CODES = 12


@in_short
@dataclass(frozen=True)
class OddsTable:
    """Odds of having a partner by the value of a column, relative to those of any record; 1 for values without a row.

    rows : (low, high, odds) for numbers in low ≤ value < high, or (value, odds) for numbers or words that are equal.

    Example
    -------
    >>> OddsTable([(15.0, 20.0, 3.0), (20.0, 26.0, 0.5)]).log_odds([16.0, 25.0, 30.0]).round(2).tolist()
    [1.1, -0.69, 0.0]
    >>> OddsTable({"AGN": 4.0}).log_odds(["AGN", "star"]).round(2).tolist()
    [1.39, 0.0]
    """

    rows: Sequence[Sequence[Any]] | Mapping[Any, float]

    def __post_init__(self) -> None:
        rows = self.rows.items() if isinstance(self.rows, Mapping) else self.rows
        object.__setattr__(self, "rows", tuple(tuple(row) for row in rows))
        for number, row in enumerate(self.rows):
            if len(row) not in (2, 3):
                raise InputError(
                    f"table of odds: row {number} has {len(row)} cells; give low, high, odds, or value, odds"
                )
            if not 0.0 < float(row[-1]) < math.inf:
                raise InputError(f"table of odds: row {number} has odds of {row[-1]}; give positive numbers")
            if len(row) == 3 and not float(row[0]) < float(row[1]):
                raise InputError(f"table of odds: row {number} is from {row[0]} to {row[1]}; give the lower end first")
        ranges = sorted((float(row[0]), float(row[1])) for row in self.rows if len(row) == 3)
        for (low, high), (next_low, _) in itertools.pairwise(ranges):
            if next_low < high:
                raise InputError(
                    f"table of odds: the ranges from {low:g} to {high:g} and from {next_low:g} overlap; "
                    "give each value once"
                )

    def log_odds(self, values: Any) -> FloatArray:
        """(n,) ln odds at values (n,)."""
        values = np.ma.asarray(values)
        out, given = np.zeros(len(values)), ~np.ma.getmaskarray(values)
        data = np.ma.getdata(values)
        number = data.astype(np.float64) if data.dtype.kind in "fiub" else None
        words = None if number is not None else np.array([str(cell).strip() for cell in data.tolist()])
        for row in self.rows:
            if number is None:
                matches = words == str(row[0]) if len(row) == 2 else np.zeros(len(out), np.bool_)
            elif len(row) == 2:
                matches = number == _number(row[0])
            else:
                matches = (number >= float(row[0])) & (number < float(row[1]))
            out[given & matches] = math.log(float(row[-1]))
        return out


def _number(value: Any) -> float:
    """The value as a number; NaN if it is none."""
    try:
        return float(value)
    except (TypeError, ValueError):
        return math.nan


@in_short
@dataclass(frozen=True)
class Column:
    """A column of one source used as evidence.

    Parameters
    ----------
    source : 1 or 2. values : the name of the column in the source's table, or (n_table,) numbers or words; NaN, masked
        or empty means missing, which is a value of its own.
    odds : a prior by value, or the rows of its :class:`OddsTable`; estimated from the pairs if not given.
    name : for reports.

    Raises
    ------
    InputError : another source.
    """

    source: int
    values: Any
    odds: OddsTable | Mapping[Any, float] | Sequence[Sequence[Any]] | None = None
    name: str = ""

    def __post_init__(self) -> None:
        if self.source not in (1, 2):
            raise InputError(f"Column: source is {self.source!r}; give 1 or 2")
        if self.odds is not None and not isinstance(self.odds, OddsTable):
            object.__setattr__(self, "odds", OddsTable(self.odds))
        if not self.name:
            object.__setattr__(self, "name", self.values if isinstance(self.values, str) else "column")

    def of(self, records: Records) -> CodedColumn:
        """The column at a source's usable records.

        Raises
        ------
        InputError : the column does not have one value for every row of the table.
        """
        values = np.ma.asarray(self.values)
        if isinstance(self.values, str) or values.shape != (records.n_table,):
            shape = "a name" if isinstance(self.values, str) else f"shape {values.shape}"
            raise InputError(
                f"{records.source}: column {self.name!r} has {shape} for {records.n_table} rows; give one value for "
                "every row of its table"
            )
        values = values[records.rows]
        log_odds = self.odds.log_odds(values) if isinstance(self.odds, OddsTable) else None
        return CodedColumn.of(self.name, values, log_odds)


@in_short
@dataclass(frozen=True)
class Related:
    """A column of source 1 and one of source 2 that may be related for records of one object, such as two fluxes.

    first, second : as the ``values`` of :class:`Column`.
    """

    first: Any
    second: Any
    names: tuple[str, str] = ("", "")

    @property
    def columns(self) -> tuple[Column, Column]:
        """Both as columns."""
        return Column(1, self.first, name=self.names[0]), Column(2, self.second, name=self.names[1])


@in_short
@dataclass(frozen=True)
class CodedColumn:
    """A column at the records of a source: numbers (n,), NaN where missing, or codes of words.

    words : the word of each code; None for numbers. log_odds : (n,) by a given prior, None if estimated.
    """

    name: str
    values: FloatArray
    words: tuple[str, ...] | None = None
    log_odds: FloatArray | None = None

    @classmethod
    def of(cls, name: str, values: Any, log_odds: FloatArray | None = None) -> CodedColumn:
        """Floats, and integers with many distinct values, are numbers; all other values categories."""
        values = np.ma.asarray(values)
        data, missing = np.ma.getdata(values), np.ma.getmaskarray(values)
        if data.dtype.kind in "f":
            number = np.where(missing | ~np.isfinite(data), np.nan, data).astype(np.float64)
            return cls(name, number, None, log_odds)
        if data.dtype.kind in "iu":
            distinct = np.unique(data[~missing])
            if len(distinct) > MAX_CODES:
                return cls(name, np.where(missing, np.nan, data.astype(np.float64)), None, log_odds)
        texts = np.array([_word(cell) for cell in data.tolist()], dtype=object)
        missing = missing | (texts == "")
        words, code = np.unique(texts.astype(str), return_inverse=True)
        return cls(name, np.where(missing, np.nan, code.astype(np.float64)), tuple(words.tolist()), log_odds)

    def coded_as(self, other: CodedColumn) -> CodedColumn:
        """The same values with the codes of ``other``, the same column of other records; words that ``other`` does not
        have get one more code."""
        if other.words == self.words:
            return self
        present = np.isfinite(self.values)
        cells = self.values[present]
        own = [str(int(cell)) for cell in cells] if self.words is None else np.array(self.words)[cells.astype(int)]
        if other.words is None:
            coded = np.array([_number(word) for word in own])
        else:
            code = {word: k for k, word in enumerate(other.words)}
            coded = np.array([code.get(str(word), len(code)) for word in own])
        values = np.full(len(self.values), np.nan)
        values[present] = coded
        return CodedColumn(self.name, values, other.words, self.log_odds)

    def take(self, rows: NDArray[np.integer]) -> CodedColumn:
        """The column at some records."""
        log_odds = None if self.log_odds is None else self.log_odds[rows]
        return CodedColumn(self.name, self.values[rows], self.words, log_odds)


def _word(cell: object) -> str:
    return "" if cell is None else (cell.decode() if isinstance(cell, bytes) else str(cell)).strip()


@in_short
@dataclass(frozen=True)
class Association:
    """ln p(c₁, c₂ | one object) − ln p(c₁ | one object) − ln p(c₂ | one object) on a grid of cells.

    cells : (n₁,), (n₂,) of the records; ABSENT for missing values. parts : (n₁,), (n₂,) fraction towards the next cell.
    folds : (n₁,) of the records of source 1. log_ratio : (folds, k₁, k₂), each estimated from the other folds.
    """

    cells: tuple[IntArray, IntArray] = field(repr=False)
    parts: tuple[FloatArray, FloatArray] = field(repr=False)
    folds: IntArray = field(repr=False)
    log_ratio: FloatArray = field(repr=False)

    def __call__(self, pairs: Pairs) -> FloatArray:
        """(m,) for the pairs."""
        one, two = self.cells[0][pairs.i], self.cells[1][pairs.j]
        part_1, part_2 = self.parts[0][pairs.i], self.parts[1][pairs.j]
        fold, (_, k1, k2) = self.folds[pairs.i], self.log_ratio.shape
        out = np.zeros(len(pairs))
        for a, weight_1 in ((one, 1.0 - part_1), (np.minimum(one + 1, k1 - 1), part_1)):
            for b, weight_2 in ((two, 1.0 - part_2), (np.minimum(two + 1, k2 - 1), part_2)):
                out += weight_1 * weight_2 * self.log_ratio[fold, a, b]
        return np.where((one < 0) | (two < 0), 0.0, out)


@in_short
@dataclass(frozen=True)
class Columns(Rule):
    """Evidence of columns, estimated by ``sameas.estimate.columns`` or given; add it to a rule of positions.

    learned : (n₁,), (n₂,) estimated ln r of all columns of each source together. given : the same of given priors.
    associations : of related columns.
    """

    learned: tuple[FloatArray, FloatArray] | None = field(repr=False)
    given: tuple[FloatArray, FloatArray] | None = field(repr=False)
    associations: tuple[Association, ...] = ()

    def __call__(self, pairs: Pairs) -> Evidence:
        terms = {}
        for name, both in (("columns", self.learned), ("prior odds", self.given)):
            if both is not None:
                terms[name] = both[0][pairs.i] + both[1][pairs.j]
        if self.associations:
            terms["relations"] = np.sum([related(pairs) for related in self.associations], axis=0)
        return Evidence(terms)


@in_short
@dataclass(frozen=True)
class TrainingPairs:
    """The pairs from which a table of grades was estimated.

    cell : (m,) index of each pair's two grades in the flattened table. own : (m,) the pair's own contribution to the
    table's log ratio there.
    """

    pairs: Pairs
    cell: NDArray[np.integer]
    own: FloatArray


@in_short
@dataclass(frozen=True)
class Precision(Rule):
    """ln p(g₁, g₂ | one object) − ln p(g₁, g₂ | two objects), with grades g of the sizes of both records' errors.

    grades : (n₁,), (n₂,) of every record, from 0. log_ratio : (k₁, k₂) of every two grades.
    training : the pairs that this was estimated from; None after a change of candidates.
    """

    grades: tuple[NDArray[np.integer], NDArray[np.integer]] = field(repr=False)
    log_ratio: FloatArray = field(repr=False)
    training: TrainingPairs | None = field(repr=False, default=None)

    def __call__(self, pairs: Pairs) -> Evidence:
        if self.training is not None and self.trained_on(pairs):
            return Evidence({"precision": self.log_ratio.ravel()[self.training.cell] - self.training.own})
        one, two = self.grades
        return Evidence({"precision": self.log_ratio[one[pairs.i], two[pairs.j]]})

    def trained_on(self, pairs: Pairs) -> bool:
        """Whether this was estimated from these pairs."""
        return self.training is not None and self.training.pairs is pairs


__all__ = ["Association", "CodedColumn", "Column", "Columns", "OddsTable", "Related"]

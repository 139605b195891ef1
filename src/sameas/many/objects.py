"""Objects: which records of many sources are one object, with probabilities and fused states.

Members are rows of the sources' own tables, in the order in which the sources were given; absence is a mask. Objects
are numbered by the content of their records, so their numbers do not depend on the order of sources or rows.

:meth:`Objects.explain` compares the terms of an object with those of every other set that one of its records could
belong to. For two sources, :mod:`sameas.result` also has the cost of every other answer for the group.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from sameas.arrays import ABSENT, BoolArray, FloatArray, IntArray, entries, over_columns, taken
from sameas.errors import InputError
from sameas.many.marginals import Answer
from sameas.many.observations import Joint, Source, records_of
from sameas.many.pooled import PooledRecords
from sameas.many.rules import Terms, pairs_of
from sameas.many.sets import Sets
from sameas.representation import counted, in_short
from sameas.result import probability_text

#: Least probability of a listed rival (chosen).
MIN_PROBABILITY = 1e-9
#: Most rivals in the text.
MAX_RIVALS = 8

#: A record: the name of its source and its id there.
Name = tuple[str, Any]


@in_short
@dataclass(frozen=True)
class Memberships:
    """The result for every row of one source's table (n_table,); masked where the row was not used.

    object : number of its object. p_object : probability of exactly that object. p_alone : probability of no partner in
    any source. partner : (n_table, S) row of the most probable partner in each source, masked without a candidate.
    p_partner : (n_table, S) its probability, 0 without a candidate; the column of the source itself is masked.
    """

    object: np.ma.MaskedArray
    p_object: np.ma.MaskedArray
    p_alone: np.ma.MaskedArray
    partner: np.ma.MaskedArray
    p_partner: np.ma.MaskedArray


@in_short
@dataclass(frozen=True)
class GroupTable:
    """How every group was solved (g,).

    records, sets : numbers of them. gap : upper bound of ln of the odds of a better partition against the answer, 0 if
    the answer is the best. cut : sets at least e^cut times less probable than the best were excluded from the sum.
    exact : cut is too large to change a probability, and no set was excluded before. floor : ln w below which sets were
    excluded.
    """

    records: IntArray
    sets: IntArray
    gap: FloatArray
    exact: BoolArray
    cut: FloatArray
    floor: FloatArray


@in_short
@dataclass(frozen=True)
class Objects:
    """The result of :func:`sameas.identify_many`.

    given : the sources, in the caller's order. pooled, sets, answer, terms : results of the stages; terms are None if
        the sets have no weights.
    """

    given: tuple[Source, ...]
    pooled: PooledRecords
    sets: Sets
    answer: Answer
    terms: Terms | None = None

    def __len__(self) -> int:
        return len(self.set_of_object)

    @cached_property
    def set_of_object(self) -> IntArray:
        """(n,) the set of each object: a row of :attr:`sets`."""
        chosen = np.flatnonzero(self.answer.chosen)
        members = taken(self.sets.members, chosen)
        first = over_columns(np.minimum, np.where(members != ABSENT, members, len(self.pooled)))
        return chosen[np.argsort(first)]

    @cached_property
    def _table(self) -> _Tables:
        return _Tables(self.pooled)

    @cached_property
    def members(self) -> np.ma.MaskedArray:
        """(n, S) row of each object's record in the table of each source, masked where the source has none."""
        return self._table.rows_of(taken(self.sets.members, self.set_of_object))

    @cached_property
    def set_rows(self) -> np.ma.MaskedArray:
        """(k, S) as :attr:`members`, of every possible set."""
        return self._table.rows_of(self.sets.members)

    @property
    def probability(self) -> FloatArray:
        """(n,) probability that exactly these records are one object."""
        return self.answer.probability[self.set_of_object]

    @property
    def n_members(self) -> IntArray:
        """(n,) number of sources with a record of each object."""
        return self.sets.size[self.set_of_object]

    @property
    def group(self) -> IntArray:
        """(n,) number of each object's group: a row of :attr:`groups`."""
        return self.sets.group[self.set_of_object]

    @cached_property
    def _second(self) -> IntArray:
        """(n,) the most probable other set that shares a record with each object, ABSENT for none."""
        best = np.full(len(self), ABSENT)
        best_p = np.zeros(len(self))
        of_record = self.object_of_record
        possible = self.answer.probability > 0
        possible[self.set_of_object] = False
        other = np.flatnonzero(possible)
        # Ascending, so that the most probable set is written last; ties go to the first by content.
        other = other[np.lexsort([-other, self.answer.probability[other]])]
        for column in self.sets.members[other].T:
            at = np.flatnonzero(column != ABSENT)
            rank = np.full(len(self), ABSENT)
            rank[of_record[column[at]]] = at
            p = np.where(rank >= 0, self.answer.probability[other[np.maximum(rank, 0)]], -1.0) if len(other) else best_p
            better = (rank >= 0) & (p > best_p)
            best[better], best_p[better] = other[rank[better]], p[better]
        return best

    @cached_property
    def runner_up(self) -> np.ma.MaskedArray:
        """(n, S) rows of the most probable other set that has one of the object's records."""
        members = self.sets.members[np.maximum(self._second, 0)].copy()
        members[self._second < 0] = ABSENT
        return self._table.rows_of(members)

    @cached_property
    def p_runner_up(self) -> np.ma.MaskedArray:
        """(n,) its probability, masked if no other set is possible."""
        return np.ma.MaskedArray(self.answer.probability[self._second], self._second < 0)

    @cached_property
    def fused(self) -> Joint:
        """Fused ``state`` (n, L) and ``covariance`` of each object, assuming independent errors of its records."""
        return self.pooled.observers.joint(self.pooled.positions(self.sets.members[self.set_of_object]))

    @cached_property
    def expected_wrong(self) -> float:
        """Expected number of objects with wrong or missing records: Σ (1 − p)."""
        return float(np.sum(1.0 - self.probability))

    @cached_property
    def groups(self) -> GroupTable:
        """How every group was solved."""
        counts = np.diff(self.sets.start)
        a = self.answer
        return GroupTable(self.pooled.sizes, counts, a.gap, a.exact(self.sets.floor), a.cut, self.sets.floor)

    def of(self, source: int | str) -> Memberships:
        """The result for every row of one source, given by its position in the list of sources or its name."""
        names = [records_of(s).source for s in self.given]
        if isinstance(source, str):
            if names.count(source) != 1:
                raise InputError(f"no single source is named {source!r}; give one of {', '.join(names)} or its place")
            source = names.index(source)
        if not 0 <= source < len(names):
            raise InputError(f"source is {source}; give 0 … {len(names) - 1}, its place in the list of sources")
        s = self.pooled.given.index(source)
        records = np.arange(self.pooled.start[s], self.pooled.start[s + 1])
        of_record = self.object_of_record[records]
        partner, p_partner = self._partners(records)
        over_table = partial(self._table.over_table, s)
        itself = np.arange(len(names)) == source
        return Memberships(
            object=over_table(of_record),
            p_object=over_table(self.probability[of_record]),
            p_alone=over_table(np.clip(self.p_alone[records], 0.0, 1.0)),
            partner=over_table(partner.data, np.ma.getmaskarray(partner)),
            p_partner=over_table(np.clip(p_partner, 0.0, 1.0), np.broadcast_to(itself, p_partner.shape)),
        )

    def explain(self, number: int) -> ObjectExplanation:
        """Why these records are object ``number``: its rivals and the terms of each; ``print`` it.

        Raises
        ------
        InputError : there is no such object, or the sets have no weights (``identify_sequentially``).
        """
        if not 0 <= number < len(self):
            raise InputError(f"there is no object {number}; give 0 … {len(self) - 1}, a row of members")
        return self._weights.of_object(self, number)

    @cached_property
    def _weights(self) -> Weights:
        return Weights.of(self)

    @cached_property
    def object_of_record(self) -> IntArray:
        """(records,) the object of every record, numbered as in the pooled records."""
        out = np.zeros(len(self.pooled), np.int64)
        at, record = entries(self.sets.members[self.set_of_object])
        out[record] = at
        return out

    @cached_property
    def p_alone(self) -> FloatArray:
        """(records,) probability of every record to have no partner."""
        single = np.flatnonzero(self.sets.size == 1)
        out = np.zeros(len(self.pooled))
        out[over_columns(np.maximum, self.sets.members[single])] = self.answer.probability[single]
        return out

    @cached_property
    def p_together(self) -> csr_array:
        """(records, records) probability that two pooled records are one object; symmetric, sparse."""
        p = self.answer.probability
        kept = np.flatnonzero((self.sets.size > 1) & (p > 0))
        incidence = _incidence(self.sets.members[kept], len(self.pooled)).astype(np.float64)
        together = csr_array((incidence * p[kept][None, :]) @ incidence.T)
        together.setdiag(0.0)
        together.eliminate_zeros()
        together.sort_indices()
        return together

    def _partners(self, records: IntArray) -> tuple[np.ma.MaskedArray, FloatArray]:
        """(k, S) each record's most probable partner in every source, in the caller's order, and its probability."""
        together = self.p_together[records].tocoo()
        n_sources = len(self.pooled.sources)
        number, p = np.full((len(records), n_sources), ABSENT), np.zeros((len(records), n_sources))
        row, record = together.row, together.col
        source = self.pooled.source[record]
        # Ascending, so that the most probable is written last; ties go to the first by content.
        order = np.lexsort([-record, together.data])
        number[row[order], source[order]], p[row[order], source[order]] = record[order], together.data[order]
        order_given = np.argsort(self.pooled.given)
        return self._table.rows_of(number), p[:, order_given]


class _Tables:
    """Conversion of pooled record numbers to rows of the sources' own tables, in the caller's order."""

    def __init__(self, pooled: PooledRecords) -> None:
        self.pooled = pooled
        self.rows = [records_of(source).rows for source in pooled.sources]

    def rows_of(self, members: IntArray) -> np.ma.MaskedArray:
        """(k, S) table rows of sets of record numbers."""
        at = self.pooled.positions(members)
        out = np.zeros(at.shape, np.int64)
        for s, rows in enumerate(self.rows):
            present = at[:, s] != ABSENT
            out[present, s] = rows[at[present, s]]
        back = np.argsort(self.pooled.given)
        return np.ma.MaskedArray(out[:, back], (at == ABSENT)[:, back])

    def over_table(self, s: int, values: NDArray[Any], mask: BoolArray | None = None) -> np.ma.MaskedArray:
        """Values of source s's records as a masked column of its table."""
        rows = self.rows[s]
        column = np.zeros((records_of(self.pooled.sources[s]).n_table, *values.shape[1:]), values.dtype)
        masked = np.ones(column.shape, bool)
        column[rows] = values
        masked[rows] = False if mask is None else mask
        return np.ma.MaskedArray(column, masked)


@dataclass(frozen=True)
class Rival:
    """A set of records that could be one object; the object itself is the ``chosen`` one.

    Attributes
    ----------
    members : the records, in the order in which the sources were given.
    probability : that exactly these records are one object.
    log_odds : ln of the odds of one object against every record being a separate one; 0 for one record.
    terms : the parts of ``log_odds`` by name; none for one record.
    taken : (record, number of its object) of the members that belong to another object of the answer.
    """

    members: tuple[Name, ...]
    probability: float
    log_odds: float
    terms: Mapping[str, float]
    taken: tuple[tuple[Name, int], ...]
    chosen: bool

    def __str__(self) -> str:
        return " = ".join(f"{source} {record}" for source, record in self.members)


@in_short
@dataclass(frozen=True)
class ObjectExplanation:
    """The result of :meth:`sameas.many.objects.Objects.explain`; ``str()`` of it is a readable text.

    Attributes
    ----------
    number : of the object. group, records : number of its group, and of the records in it.
    exact : whether the probabilities are sums over all partitions of the group.
    rivals : all sets that share a record with the object, including itself, the most probable first.
    stays : why the object is the answer although a rival is more probable; "" if none is.
    """

    number: int
    group: int
    records: int
    exact: bool
    rivals: tuple[Rival, ...]
    stays: str = ""

    @property
    def chosen(self) -> Rival:
        """The object."""
        return next(rival for rival in self.rivals if rival.chosen)

    @property
    def runner_up(self) -> Rival | None:
        """The most probable other set, if any is possible."""
        return next((rival for rival in self.rivals if not rival.chosen), None)

    @property
    def against_runner_up(self) -> dict[str, float]:
        """Each term of the object minus that of its runner-up, by name; they sum to the difference of ln w."""
        other = self.runner_up
        if other is None:
            return {}
        one, two = self.chosen.terms, other.terms
        return {name: one.get(name, 0.0) - two.get(name, 0.0) for name in {**one, **two}}

    def __str__(self) -> str:
        return "\n".join(_lines(self))


@dataclass(frozen=True)
class Weights:
    """The terms of the probable sets of an answer.

    kept : (r,) the sets of a probability of at least :data:`MIN_PROBABILITY`, or chosen. terms : (r,) by name.
    sets_of : (n, r) records in sets. names : (n) of all records. columns : of the sets' members, in the caller's order
    of sources.
    """

    # Not the objects, which keep their weights: both would stay in memory until the garbage collector finds them.
    kept: IntArray
    terms: Mapping[str, FloatArray]
    sets_of: csr_array
    names: Sequence[Name]
    columns: IntArray

    @classmethod
    def of(cls, objects: Objects) -> Weights:
        """The weights of a result of ``identify_many``."""
        if objects.terms is None:
            raise InputError("only the objects of identify_many are explained: others have no candidate sets")
        kept = np.flatnonzero((objects.answer.probability >= MIN_PROBABILITY) | objects.answer.chosen)
        sets_of = _incidence(objects.sets.members[kept], len(objects.pooled))
        sources = [records_of(source) for source in objects.pooled.sources]
        names = [(source.source, name) for source in sources for name in source.ids[source.rows].tolist()]
        columns = np.argsort(objects.pooled.given)
        return cls(kept, _terms(objects, objects.terms, kept), sets_of, names, columns)

    def of_object(self, objects: Objects, number: int) -> ObjectExplanation:
        """The explanation of one of the objects."""
        own = int(objects.set_of_object[number])
        records = objects.sets.members[own]
        indptr, indices = self.sets_of.indptr, self.sets_of.indices
        near = np.unique(np.concatenate([indices[indptr[r] : indptr[r + 1]] for r in records[records != ABSENT]]))
        # Ties go to the object itself, then to the first by content.
        p, other = objects.answer.probability[self.kept[near]], self.kept[near] != own
        rivals = tuple(self._rival(objects, at, number) for at in near[np.lexsort([near, other, -p])].tolist())
        group = int(objects.sets.group[own])
        exact = bool(objects.answer.exact(objects.sets.floor)[group])
        return ObjectExplanation(number, group, int(objects.pooled.sizes[group]), exact, rivals)

    def _rival(self, objects: Objects, at: int, number: int) -> Rival:
        which = int(self.kept[at])
        records = [r for r in objects.sets.members[which, self.columns].tolist() if r != ABSENT]
        holders = objects.object_of_record[records].tolist()
        pairs = zip(records, holders, strict=True)
        return Rival(
            tuple(self.names[r] for r in records),
            float(objects.answer.probability[which]),
            float(objects.sets.log_weight[which]),
            {name: float(values[at]) for name, values in self.terms.items() if values[at] != 0.0},
            tuple((self.names[r], holder) for r, holder in pairs if holder != number),
            which == int(objects.set_of_object[number]),
        )


def _incidence(members: IntArray, n_records: int) -> csr_array:
    """(records, k) bool, sparse: whether a record is in a set; members (k, S), ABSENT for none."""
    at, record = entries(members)
    return csr_array((np.ones(len(at), bool), (record, at)), shape=(n_records, len(members)))


def _terms(objects: Objects, terms: Terms, kept: IntArray) -> dict[str, FloatArray]:
    """(r,) every term of the kept sets by name; the position term is ln w minus the others."""
    pooled, sets = objects.pooled, objects.sets
    out: dict[str, FloatArray] = {"position": np.zeros(len(kept))}
    for size in np.unique(sets.size[kept]).tolist():
        if size == 1:
            continue
        at = np.flatnonzero(sets.size[kept] == size)
        members = sets.members[kept[at]]
        records = members[members != ABSENT].reshape(-1, size)
        named = terms.by_name(records, pairs_of(pooled, records))
        named["position"] = sets.log_weight[kept[at]] - np.sum(
            [np.zeros(len(at)), *(values for name, values in named.items() if name != "position")], axis=0
        )
        for name, values in named.items():
            out.setdefault(name, np.zeros(len(kept)))[at] = values
    return out


def _lines(x: ObjectExplanation) -> list[str]:
    chosen, other = x.chosen, x.runner_up
    summed = "summed over all partitions" if x.exact else "approximate, improbable sets left out"
    lines = [
        f"Object {x.number} is {chosen}, probability {probability_text(chosen.probability)}.",
        f"Group {x.group}: {counted(x.records, 'record')}; probabilities are {summed}.",
        "",
    ]
    first = x.rivals[:MAX_RIVALS]
    listed = first if chosen in first else (*first[:-1], chosen)
    width = max(len(str(rival)) for rival in listed) + 2
    lines.append(f"{'records':>{width}}  {'probability':>11}  {'log-odds':>8}  terms")
    for rival in listed:
        mark = "→ " if rival.chosen else "  "
        line = f"{mark + str(rival):>{width}}  {probability_text(rival.probability):>11}"
        lines.append(line + (f"  {rival.log_odds:+8.2f}  {_in_words(rival.terms)}" if rival.terms else ""))
    if len(x.rivals) > len(listed):
        lines.append(f"({len(x.rivals) - len(listed)} less probable not shown)")
    if other is None:
        return [*lines, "Nothing else is possible."]
    if other.probability > chosen.probability:
        why = x.stays or "the answer is the most probable for all records together"
        lines += ["", f"By itself {other} is more probable; {why}."]
    elif x.stays:
        lines += ["", f"For all records together another answer is more probable; {x.stays}."]
    total = chosen.log_odds - other.log_odds
    lines += ["", f"Against the runner-up, {other}: log-odds {total:+.2f}, of which {_in_words(x.against_runner_up)}."]
    if other.taken:
        taken = ", ".join(f"{source} {record} from object {holder}" for (source, record), holder in other.taken)
        lines.append(f"It would take {taken}.")
    return lines


def _in_words(terms: Mapping[str, float]) -> str:
    """Terms as text, without those that round to zero."""
    return ", ".join(f"{name} {value:+.2f}" for name, value in terms.items() if abs(value) >= 0.005) or "nothing"

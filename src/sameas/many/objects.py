"""Objects: which records of many sources are one object, with probabilities and fused states.

Members are rows of the sources' own tables, in the order in which the sources were given; absence is a mask. Objects
are numbered by the content of their records, so their numbers do not depend on the order of sources or rows.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.errors import InputError
from sameas.many.explanation import ObjectExplanation, Weights
from sameas.many.marginals import Answer
from sameas.many.observations import NO_RECORD, Joint, Source, records_of
from sameas.many.pooled import PooledRecords
from sameas.many.rules import Terms
from sameas.many.sets import Sets
from sameas.representation import in_short


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
    """The result of :func:`sameas.many.identify_many`.

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
        members = self.sets.members[chosen]
        first = np.where(members != NO_RECORD, members, len(self.pooled)).min(axis=1)
        return chosen[np.argsort(first)]

    @cached_property
    def _table(self) -> _Tables:
        return _Tables(self.pooled)

    @cached_property
    def members(self) -> np.ma.MaskedArray:
        """(n, S) row of each object's record in the table of each source, masked where the source has none."""
        return self._table.rows_of(self.sets.members[self.set_of_object])

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
        """(n,) the most probable other set that shares a record with each object, −1 for none."""
        best = np.full(len(self), -1)
        best_p = np.zeros(len(self))
        of_record = self.object_of_record
        other = np.setdiff1d(np.flatnonzero(self.answer.probability > 0), self.set_of_object)
        # Ascending, so that the most probable set is written last; ties go to the first by content.
        other = other[np.lexsort([-other, self.answer.probability[other]])]
        for column in self.sets.members[other].T:
            at = np.flatnonzero(column != NO_RECORD)
            rank = np.full(len(self), -1)
            rank[of_record[column[at]]] = at
            p = np.where(rank >= 0, self.answer.probability[other[np.maximum(rank, 0)]], -1.0) if len(other) else best_p
            better = (rank >= 0) & (p > best_p)
            best[better], best_p[better] = other[rank[better]], p[better]
        return best

    @cached_property
    def runner_up(self) -> np.ma.MaskedArray:
        """(n, S) rows of the most probable other set that has one of the object's records."""
        members = self.sets.members[np.maximum(self._second, 0)].copy()
        members[self._second < 0] = NO_RECORD
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
        over_table = self._table.over_table(s)
        itself = np.arange(len(names)) == source
        return Memberships(
            object=over_table(of_record),
            p_object=over_table(self.probability[of_record]),
            p_alone=over_table(np.clip(self._p_alone[records], 0.0, 1.0)),
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
        return self._weights.of_object(number)

    @cached_property
    def _weights(self) -> Weights:
        return Weights.of(self)

    @cached_property
    def object_of_record(self) -> IntArray:
        """(records,) the object of every record, numbered as in the pooled records."""
        out = np.zeros(len(self.pooled), np.int64)
        members = self.sets.members[self.set_of_object]
        at, source = np.nonzero(members != NO_RECORD)
        out[members[at, source]] = at
        return out

    @cached_property
    def _p_alone(self) -> FloatArray:
        """(records,) probability of every record to have no partner."""
        single = np.flatnonzero(self.sets.size == 1)
        out = np.zeros(len(self.pooled))
        out[self.sets.members[single].max(axis=1)] = self.answer.probability[single]
        return out

    @cached_property
    def p_together(self) -> csr_array:
        """(records, records) probability that two pooled records are one object; symmetric, sparse."""
        p = self.answer.probability
        kept = np.flatnonzero((self.sets.size > 1) & (p > 0))
        members = self.sets.members[kept]
        at, source = np.nonzero(members != NO_RECORD)
        shape = (len(self.pooled), len(kept))
        incidence = csr_array((np.ones(len(at)), (members[at, source], at)), shape=shape)
        together = csr_array((incidence * p[kept][None, :]) @ incidence.T)
        together.setdiag(0.0)
        together.eliminate_zeros()
        together.sort_indices()
        return together

    def _partners(self, records: IntArray) -> tuple[np.ma.MaskedArray, FloatArray]:
        """(k, S) each record's most probable partner in every source, in the caller's order, and its probability."""
        together = self.p_together[records].tocoo()
        n_sources = len(self.pooled.sources)
        number, p = np.full((len(records), n_sources), NO_RECORD), np.zeros((len(records), n_sources))
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
            present = at[:, s] != NO_RECORD
            out[present, s] = rows[at[present, s]]
        back = np.argsort(self.pooled.given)
        return np.ma.MaskedArray(out[:, back], (at == NO_RECORD)[:, back])

    def over_table(self, s: int) -> _OverTable:
        """A function from values of source s's records to a masked column of its table."""
        return _OverTable(self.rows[s], records_of(self.pooled.sources[s]).n_table)


class _OverTable:
    def __init__(self, rows: IntArray, n_table: int) -> None:
        self.rows, self.n_table = rows, n_table

    def __call__(self, values: NDArray[Any], mask: BoolArray | None = None) -> np.ma.MaskedArray:
        column = np.zeros((self.n_table, *values.shape[1:]), values.dtype)
        masked = np.ones(column.shape, bool)
        column[self.rows] = values
        masked[self.rows] = False if mask is None else mask
        return np.ma.MaskedArray(column, masked)

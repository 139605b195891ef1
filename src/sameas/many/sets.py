"""Candidate sets: which records could be one object, and what each such set weighs.

A set has at most one record of each source, and every two of its records are a pair of the gate. Sets grow record by
record, in their pooled order. A set is left where neither it nor any that grows from it can weigh more than a
``floor``: no record adds more to ln w than its gain, the most that any pair of its group says by each rule, and
−½ ln|2π R|, the peak of its density. With floor 0 nothing that the best partition needs is lost: its sets outweigh
their records alone, and a count prior only asks for more. Groups get the lowest floor of :data:`FLOORS` at which they
have no more than ``LIMIT`` sets; what a floor above 0 may have cost is reported as a gap.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.many.pooled import PooledRecords
from sameas.many.terms import Terms
from sameas.ragged import Ragged, ranges

#: ln w below which sets are left out, tried in this order.
FLOORS = (-np.inf, 0.0, 6.0, 15.0, 30.0, 80.0, np.inf)
#: Most sets of a group.
LIMIT = 400_000


@dataclass(frozen=True)
class Sets:
    """Candidate sets, group by group, in the order of their records; the records alone among them.

    Attributes
    ----------
    members : (k, S) record number per source, −1 for none.
    size : (k,) number of records.
    log_weight : (k,) ln w; 0 for one record.
    group : (k,) group of the set, ascending. start : (g+1,) of the groups.
    floor : (g,) ln w below which sets were left out.
    """

    members: IntArray
    size: IntArray
    log_weight: FloatArray
    group: IntArray
    start: IntArray
    floor: FloatArray

    def __len__(self) -> int:
        return len(self.size)

    def entries(self) -> tuple[IntArray, IntArray]:
        """(set, record) of every membership, sets ascending."""
        at, source = np.nonzero(self.members >= 0)
        return at, self.members[at, source]


def candidate_sets(pooled: PooledRecords, terms: Terms, *, limit: int = LIMIT) -> Sets:
    """The candidate sets of every group, each with the lowest floor that its size allows."""
    n_groups = len(pooled.sizes)
    floor = np.full(n_groups, FLOORS[0])
    open_ = np.ones(n_groups, bool)
    levels: list[_SetsOfSize] = []
    growth = _Growth.of(pooled, terms)
    for value in FLOORS:
        floor[open_] = value
        grown, too_many = growth.all(open_, value, limit)
        levels += [level.of_groups(pooled, ~too_many) for level in grown]
        open_ &= too_many
        if not open_.any():
            break
    return _gathered(pooled, levels, floor)


@dataclass(frozen=True)
class _SetsOfSize:
    """Sets of one size: ``records`` (k, size) ascending, their ``pairs`` as of :func:`sameas.many.terms.pairs_of`, ln
    w, and the part of it that the rules of pairs say."""

    records: IntArray
    pairs: IntArray
    log_weight: FloatArray
    between: FloatArray

    @classmethod
    def alone(cls, records: IntArray) -> _SetsOfSize:
        nothing = np.zeros(len(records))
        return cls(records[:, None], np.empty((len(records), 0), np.int64), nothing, nothing)

    def only(self, keep: NDArray) -> _SetsOfSize:
        return _SetsOfSize(self.records[keep], self.pairs[keep], self.log_weight[keep], self.between[keep])

    def of_groups(self, pooled: PooledRecords, wanted: BoolArray) -> _SetsOfSize:
        return self.only(wanted[pooled.group[self.records[:, 0]]])


@dataclass(frozen=True)
class _Growth:
    """How sets grow: later neighbours of every record as CSR, and the most that later sources can add."""

    pooled: PooledRecords
    terms: Terms
    start: IntArray
    most: FloatArray
    highest: FloatArray

    @classmethod
    def of(cls, pooled: PooledRecords, terms: Terms) -> _Growth:
        n, g, n_sources = len(pooled), len(pooled.sizes), len(pooled.sources)
        highest = terms.most_between(pooled)
        best = np.full((g, n_sources), -np.inf)
        np.maximum.at(best, (pooled.group, pooled.source), terms.gain(pooled) + pooled.log_peak)
        best = np.maximum(best + highest[:, None], 0.0)
        # What the sources after s can add at most.
        most = np.cumsum(best[:, ::-1], axis=1)[:, ::-1] - best
        return cls(pooled, terms, Ragged.of_sorted(pooled.i, n).start, most, highest)

    def all(self, wanted: BoolArray, floor: float, limit: int) -> tuple[list[_SetsOfSize], BoolArray]:
        """Levels of two records and more of the wanted groups, and which groups have more than ``limit`` sets."""
        pooled = self.pooled
        lone = np.flatnonzero(wanted[pooled.group])
        level = _SetsOfSize.alone(lone)
        levels, count, too_many = [], np.zeros(len(pooled.sizes), np.int64), np.zeros(len(pooled.sizes), bool)
        if floor == np.inf:
            return [], too_many
        while len(level.records):
            level = self._grown(level, floor, limit, count, too_many)
            levels.append(level.only(level.log_weight > floor))
        return levels, too_many

    def _grown(self, level: _SetsOfSize, floor: float, limit: int, count: IntArray, too_many: BoolArray) -> _SetsOfSize:
        """The sets of one record more; marks groups of which there are too many, and leaves them."""
        pooled, last = self.pooled, level.records[:, -1]
        width = self.start[last + 1] - self.start[last]
        group = pooled.group[last]
        # Before the room for them is taken: each set times its neighbours.
        asked = np.bincount(group, width, len(count))
        too_many |= asked > 8 * limit
        width = np.where(too_many[group], 0, width)
        parent, pair = ranges(self.start[last], width)
        added = pooled.j[pair]
        keep = np.ones(len(parent), bool)
        pairs = []
        for column in range(level.records.shape[1] - 1):
            found, at = pooled.pair(level.records[parent, column], added)
            keep &= found
            pairs.append(at)
        parent, added = parent[keep], added[keep]
        new = [at[keep] for at in (*pairs, pair)]
        grown = self._weighed(
            np.column_stack([level.records[parent], added]), np.column_stack([level.pairs[parent], *new])
        )
        group = pooled.group[added]
        keep = self._reach(grown, group) > floor
        count += np.bincount(group[keep], minlength=len(count))
        too_many |= count > limit
        return grown.only(keep & ~too_many[group])

    def _weighed(self, records: IntArray, pairs: IntArray) -> _SetsOfSize:
        log_j = self.pooled.observers.joint(self.pooled.positions(_by_source(self.pooled, records))).log_density
        between = self.terms.between_of(pairs)
        return _SetsOfSize(records, pairs, self.terms.linear_of(records) + log_j + between, between)

    def _reach(self, level: _SetsOfSize, group: IntArray) -> FloatArray:
        """(k,) more than which neither the sets nor any that grow from them can weigh."""
        slack = (level.records.shape[1] - 1) * self.highest[group] - level.between
        last = self.pooled.source[level.records[:, -1]]
        return level.log_weight + slack + self.most[group, last]


def _by_source(pooled: PooledRecords, records: IntArray) -> IntArray:
    """(k, size) record numbers as (k, S), −1 where a source has none."""
    members = np.full((len(records), len(pooled.sources)), -1)
    np.put_along_axis(members, pooled.source[records], records, axis=1)
    return members


def _gathered(pooled: PooledRecords, levels: list[_SetsOfSize], floor: FloatArray) -> Sets:
    """All levels in one table, the records alone first in each group."""
    everyone = np.arange(len(pooled))
    members = np.concatenate([_by_source(pooled, everyone[:, None]), *(_by_source(pooled, x.records) for x in levels)])
    weight = np.concatenate([np.zeros(len(pooled)), *(x.log_weight for x in levels)])
    size = np.concatenate(
        [np.ones(len(pooled), np.int64), *(np.full(len(x.records), x.records.shape[1]) for x in levels)]
    )
    group = np.concatenate([pooled.group, *(pooled.group[x.records[:, 0]] for x in levels)])
    order = np.argsort(group, kind="stable")
    order = order[np.lexsort([*members[order].T[::-1], size[order], group[order]])]
    group = group[order]
    start = Ragged.of_sorted(group, len(pooled.sizes)).start
    return Sets(members[order], size[order], weight[order], group, start, floor)

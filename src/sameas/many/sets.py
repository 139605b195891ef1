"""Candidate sets: records that could be one object, and the weight of each set.

A set has at most one record of each source, and every two of its records are a pair of the gate. Sets grow by one
record at a time, in pooled order. A set is dropped if neither it nor any larger set from it can weigh more than a
``floor``: a record adds at most its gain, the largest term of any pair of its group in each rule, and −½ ln|2π R|, the
peak of its density. With floor 0 the best partition is not affected: its sets outweigh their records alone, and a count
prior only requires more. Each group has the lowest of ``ManyTuning.floors`` with at most ``ManyTuning.max_sets`` sets.
Where even those are too many, as of twelve sources, whose records of one object have 4096 subsets, a group has the sets
near a good partition instead (:mod:`sameas.many.near_sets`), its floor is infinite, and no bound of the gap is known.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sameas.arrays import ABSENT, BoolArray, FloatArray, IntArray, entries, over_columns, taken
from sameas.kernels.components import grown_sets
from sameas.many.near_sets import near_sets
from sameas.many.pooled import PooledRecords, record_codes
from sameas.many.rules import Terms
from sameas.ragged import Ragged
from sameas.representation import in_short


@dataclass(frozen=True)
class ManyTuning:
    """Limits beyond which :func:`sameas.identify_many` approximates, chosen so that a group takes seconds at most.

    Attributes
    ----------
    floors : ln w below which sets of a group are excluded, tried in this order until ``max_sets`` is not exceeded.
    max_sets : of a group; with more it has those near a good partition.
    near_cost, near_breadth : of these, the largest cost in ln, and how many are changed further for each record.
    cuts : reduced costs above which sets are excluded from a group's sum, tried in this order until it is short enough.
    max_steps : maximum number of transitions between states in the sum of a group.
    small : groups of at most this many records are summed with all their sets.
    block_steps : most transitions in the sum of a block, a part of a group that has its own cut.
    walked_below : cut of the sum below which probabilities are those of a walk (:mod:`sameas.many.walk`); 0 for none.
    """

    floors: tuple[float, ...] = (-np.inf, 0.0)
    max_sets: int = 100_000
    near_cost: float = 20.0
    near_breadth: int = 4
    cuts: tuple[float, ...] = (30.0, 20.0, 14.0, 10.0, 8.0, 6.0, 4.0, 2.0, 1.0)
    max_steps: int = 300_000
    small: int = 8
    block_steps: int = 300_000
    walked_below: float = 2.0


TUNING = ManyTuning()


@in_short
@dataclass(frozen=True)
class Sets:
    """Candidate sets, including every single record, by group, in the order of their records.

    Attributes
    ----------
    members : (k, S) record number per source, ABSENT for none.
    size : (k,) number of records.
    log_weight : (k,) ln w; 0 for one record.
    group : (k,) group of the set, ascending. start : (g+1,) first set of each group.
    floor : (g,) ln w below which sets were excluded; infinite for a group with the sets near a good partition only.
    partition : (k,) the sets of that partition, False in other groups; None if there is no such group.
    """

    members: IntArray
    size: IntArray
    log_weight: FloatArray
    group: IntArray
    start: IntArray
    floor: FloatArray
    partition: BoolArray | None = None

    def __len__(self) -> int:
        return len(self.size)

    def take(self, which: IntArray) -> Sets:
        """Some of the sets (ascending numbers), in the same groups."""
        group = self.group[which]
        start = Ragged.of_sorted(group, len(self.start) - 1).start
        partition = None if self.partition is None else self.partition[which]
        return Sets(
            taken(self.members, which), self.size[which], self.log_weight[which], group, start, self.floor, partition
        )

    def with_more(self, members: IntArray, log_weight: FloatArray, group: IntArray) -> tuple[Sets, IntArray]:
        """The sets with others (m, S), and (k + m,) the number of each among these and those."""
        weight, of = np.concatenate([self.log_weight, log_weight]), np.concatenate([self.group, group])
        sets, order = _ordered(np.concatenate([self.members, members]), weight, of, self.floor)
        if self.partition is not None:
            sets = replace(sets, partition=np.append(self.partition, np.zeros(len(members), bool))[order])
        return sets, order

    def entries(self) -> tuple[IntArray, IntArray]:
        """(set, record) of every member of a set, sets ascending."""
        return entries(self.members)


def candidate_sets(pooled: PooledRecords, terms: Terms, tuning: ManyTuning = TUNING) -> Sets:
    """The candidate sets of every group, each group with the lowest floor that its number of sets allows."""
    n_groups = len(pooled.sizes)
    floor = np.full(n_groups, tuning.floors[0])
    unsolved = np.ones(n_groups, bool)
    levels: list[_SetsOfSize] = []
    growth = _Growth.of(pooled, terms)
    for value in tuning.floors:
        floor[unsolved] = value
        grown, too_many = growth.all(unsolved, value, tuning.max_sets)
        levels += [level.of_groups(pooled, ~too_many) for level in grown]
        unsolved &= too_many
        if not unsolved.any():
            break
    members, weight = _of_all_sizes(pooled, levels)
    if not unsolved.any():
        return _gathered(pooled, members, weight, floor)
    floor[unsolved] = np.inf
    near = near_sets(pooled, terms, unsolved, tuning.near_cost, tuning.near_breadth)
    members, weight = np.concatenate([members, near.members]), np.concatenate([weight, near.log_weight])
    return _gathered(pooled, members, weight, floor, near.partition)


@dataclass(frozen=True)
class _SetsOfSize:
    """Sets of one size: ``records`` (k, size) ascending, their ``pairs`` (:func:`sameas.many.rules.pairs_of`), ln w,
    and the part of it that the rules of pairs give."""

    records: IntArray
    pairs: IntArray
    log_weight: FloatArray
    by_pair: FloatArray

    @classmethod
    def single(cls, records: IntArray) -> _SetsOfSize:
        zero = np.zeros(len(records))
        return cls(records[:, None], np.empty((len(records), 0), np.int64), zero, zero)

    def only(self, keep: BoolArray) -> _SetsOfSize:
        if keep.all():
            return self
        rows = np.flatnonzero(keep)
        return _SetsOfSize(
            taken(self.records, rows), taken(self.pairs, rows), self.log_weight[rows], self.by_pair[rows]
        )

    def of_groups(self, pooled: PooledRecords, groups: BoolArray) -> _SetsOfSize:
        return self.only(groups[pooled.group[self.records[:, 0]]])


@dataclass(frozen=True)
class _Growth:
    """The growth of sets, with upper bounds of what further records add to ln w.

    start : (n+1,) CSR of every record's pairs with later records. most : (g, S) by the records of all later sources
    together. highest : (g,) by one record in the rules of pairs.
    """

    pooled: PooledRecords
    terms: Terms
    start: IntArray
    most: FloatArray
    highest: FloatArray

    @classmethod
    def of(cls, pooled: PooledRecords, terms: Terms) -> _Growth:
        n, g, n_sources = len(pooled), len(pooled.sizes), len(pooled.sources)
        highest = terms.max_by_pair(pooled)
        best = np.full((g, n_sources), -np.inf)
        np.maximum.at(best, (pooled.group, pooled.source), terms.gain(pooled) + pooled.log_peak)
        best = np.maximum(best + highest[:, None], 0.0)
        most = np.cumsum(best[:, ::-1], axis=1)[:, ::-1] - best
        return cls(pooled, terms, Ragged.of_sorted(pooled.i, n).start, most, highest)

    def all(
        self, groups: BoolArray, floor: float, limit: int, largest: int = 1 << 30
    ) -> tuple[list[_SetsOfSize], BoolArray]:
        """Sets of 2 to ``largest`` records of some groups (g,), by size, and the groups of more than ``limit`` sets."""
        pooled = self.pooled
        level = _SetsOfSize.single(np.flatnonzero(groups[pooled.group]))
        levels: list[_SetsOfSize] = []
        count, too_many = np.zeros(len(pooled.sizes), np.int64), np.zeros(len(pooled.sizes), bool)
        if floor == np.inf:
            return [], too_many
        while len(level.records) and len(levels) < largest - 1:
            level = self._grown(level, floor, limit, count, too_many)
            levels.append(level.only(level.log_weight > floor))
        return levels, too_many

    def _grown(self, level: _SetsOfSize, floor: float, limit: int, count: IntArray, too_many: BoolArray) -> _SetsOfSize:
        """The sets of one more record; groups with too many sets are marked and dropped."""
        pooled, last = self.pooled, level.records[:, -1]
        width = self.start[last + 1] - self.start[last]
        group = pooled.group[last]
        # An upper bound, each set times its neighbours, before memory is taken for them.
        bound = np.bincount(group, width, len(count))
        too_many |= bound > 8 * limit
        width = np.where(too_many[group], 0, width)
        n, size = int(width.sum()), level.records.shape[1]
        parent, added, new = np.empty(n, np.int64), np.empty(n, np.int64), np.empty((n, size), np.int64)
        n = grown_sets(level.records, width, self.start, pooled.j, parent, added, new)
        parent, added, new = parent[:n], added[:n], new[:n]
        grown = self._weighed(
            np.concatenate([taken(level.records, parent), added[:, None]], axis=1),
            np.concatenate([taken(level.pairs, parent), new], axis=1),
        )
        group = pooled.group[added]
        keep = self._bound(grown, group) > floor
        count += np.bincount(group[keep], minlength=len(count))
        too_many |= count > limit
        return grown.only(keep & ~too_many[group])

    def _weighed(self, records: IntArray, pairs: IntArray) -> _SetsOfSize:
        log_j = self.pooled.log_joint(records)
        by_pair = self.terms.by_pair_of(pairs)
        return _SetsOfSize(records, pairs, self.terms.linear_of(records) + log_j + by_pair, by_pair)

    def _bound(self, level: _SetsOfSize, group: IntArray) -> FloatArray:
        """(k,) upper bound of ln w of the sets and of all larger sets from them."""
        slack = (level.records.shape[1] - 1) * self.highest[group] - level.by_pair
        last = self.pooled.source[level.records[:, -1]]
        return np.asarray(level.log_weight + slack + self.most[group, last])


def _by_source(pooled: PooledRecords, records: IntArray) -> IntArray:
    """(k, size) record numbers as (k, S), ABSENT where a source has none."""
    members = np.full((len(records), len(pooled.sources)), ABSENT)
    members.ravel()[len(pooled.sources) * np.arange(len(records))[:, None] + pooled.source[records]] = records
    return members


def _of_all_sizes(pooled: PooledRecords, levels: list[_SetsOfSize]) -> tuple[IntArray, FloatArray]:
    """(k, S) the sets of all levels, and their ln w."""
    none = np.empty((0, len(pooled.sources)), np.int64)
    return (
        np.concatenate([none, *(_by_source(pooled, level.records) for level in levels)]),
        np.concatenate([np.empty(0), *(level.log_weight for level in levels)]),
    )


def _gathered(
    pooled: PooledRecords, members: IntArray, weight: FloatArray, floor: FloatArray, partition: IntArray | None = None
) -> Sets:
    """Sets (k, S) of two or more records and all single records in one table, single records first in each group.

    partition : (c, S) sets that are a partition of the groups of infinite floor.
    """
    n = len(pooled)
    members = np.concatenate([_by_source(pooled, np.arange(n)[:, None]), members])
    group = pooled.group[over_columns(np.maximum, members)]
    sets, _ = _ordered(members, np.concatenate([np.zeros(n), weight]), group, floor)
    if partition is None:
        return sets
    code = record_codes(n)
    return replace(sets, partition=np.isin(code[sets.members].sum(axis=1), code[partition].sum(axis=1)))


def _ordered(members: IntArray, log_weight: FloatArray, group: IntArray, floor: FloatArray) -> tuple[Sets, IntArray]:
    """Sets (k, S) in any order as a table, and (k,) the number of each in that order; floor : (g,) of the groups."""
    size = over_columns(np.add, (members != ABSENT).astype(np.int64))
    order = packed_order([group, size, *(members + 1).T])
    start = Ragged.of_sorted(group[order], len(floor)).start
    return Sets(taken(members, order), size[order], log_weight[order], group[order], start, floor), order


def packed_order(columns: list[IntArray]) -> IntArray:
    """(k,) rows in lexicographic order of columns of nonnegative integers, the first column most significant; equal
    rows in any order."""
    key, bits = np.zeros(len(columns[0]), np.int64), 0
    for column in columns:
        width = int(column.max(initial=0)).bit_length()
        key, bits = (key << width) | column, bits + width
    if bits > 62:
        return np.lexsort(columns[::-1])
    return np.argsort(key)

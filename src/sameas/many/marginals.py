"""Marginals: the probability of every candidate set, summed over all partitions of its group.

A group's records are eliminated one after another; the state is which later records are taken and, under a count prior,
the number of merges. Sets that the duals of the best partition prove improbable are left out first: a partition with a
set of reduced cost c is at least eᶜ times less probable than the best. Without sets of c > 30 the sum counts as exact;
groups too entangled for it are summed without sets of c > 20, 14, …, until the sum is short enough. Where that would
have to go below 2, messages between sets and records stand for the sum. The result states either.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components, reverse_cuthill_mckee

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.many.joint import NO_RECORD
from sameas.many.partition import best_counted, best_partition, incidence_of
from sameas.many.pooled import PooledRecords
from sameas.many.rules import MissedObjects
from sameas.many.sets import TUNING, ManyTuning, Sets
from sameas.ragged import Ragged
from sameas.representation import in_short

#: A sum without sets of larger reduced cost is exact: e⁻³⁰ is below what a probability can show.
EXACT = 30.0
#: Most records of a block: the bits of a state.
MOST_RECORDS = 63


@in_short
@dataclass(frozen=True)
class Answer:
    """The best partition and the probabilities of all sets.

    chosen : (k,) the sets that are objects. probability : (k,) of every set.
    gap : (g,) ln of how much more probable a better partition could be at most.
    cut : (g,) reduced cost above which sets were left out of the sum; :data:`EXACT` or more where that is exact, below
        2 where such a sum would leave too much out and probabilities are by messages.
    """

    chosen: BoolArray
    probability: FloatArray
    gap: FloatArray
    cut: FloatArray

    def exact(self, floor: FloatArray) -> BoolArray:
        """(g,) whether probabilities are exact; floor : (g,) of :class:`Sets`, −∞ where no set was left out before."""
        return np.asarray((self.cut >= EXACT) & (floor == -np.inf))


def answer(
    sets: Sets,
    pooled: PooledRecords,
    counts: MissedObjects | None,
    *,
    time_limit_s: float,
    tuning: ManyTuning = TUNING,
) -> Answer:
    """The best partition of every group and the probabilities of its sets; ``counts`` is the count prior, if any."""
    if counts is None:
        return additive_answer(sets, pooled.sizes, time_limit_s=time_limit_s, tuning=tuning)
    sums = _Sums.counted(sets, pooled, counts, tuning)
    nothing = np.zeros(len(sets))
    share, chosen, solved = sums.without(nothing, EXACT, np.ones(len(pooled.sizes), bool))
    cut = np.where(solved, np.inf, -1.0)
    gap = np.where(sets.floor > 0, np.inf, 0.0)
    if not solved.all():
        weight = sets.log_weight.copy()
        for g in np.flatnonzero(~solved).tolist():
            gap[g] = max(gap[g], _solve_counted(sets, sums, g, weight, chosen, time_limit_s))
        tilted = Sets(sets.members, sets.size, weight, sets.group, sets.start, sets.floor)
        best = best_partition(tilted, len(pooled), time_limit_s=time_limit_s)
        cost = _reduced_cost(sets, best.dual, best.slack, weight)
        part, _, cut = sums.all(cost, chosen, cut, weight)
        share = np.where(solved[sets.group], share, part)
    return Answer(chosen, share, gap, cut)


def additive_answer(sets: Sets, sizes: IntArray, *, time_limit_s: float, tuning: ManyTuning = TUNING) -> Answer:
    """The same without a count prior; sizes : (g,) records of every group."""
    n = int(sizes.sum())
    share, chosen, cut = packed_groups(sets, n, np.ones(len(sizes), bool), tuning)
    rest = cut < 0
    if not rest.any():
        return Answer(chosen, share, np.zeros(len(sizes)), cut)
    best = best_partition(sets, n, rest, time_limit_s=time_limit_s)
    cost = _reduced_cost(sets, best.dual, best.slack, sets.log_weight)
    part, _, cut = _Sums.additive(sets, n, tuning).all(cost, best.chosen, cut, sets.log_weight)
    open_ = rest[sets.group]
    return Answer(
        np.where(open_, best.chosen, chosen), np.where(open_, part, share), np.where(rest, best.gap, 0.0), cut
    )


def best_sets(
    sets: Sets, n_records: int, possible: BoolArray, *, time_limit_s: float, tuning: ManyTuning = TUNING
) -> BoolArray:
    """(k,) the sets of the best partition, without a count prior, of the records of those sets that are possible.

    possible : (k,) sets that have a probability under other weights near these, partitions of their records among them.
    """
    which, chosen, groups = np.flatnonzero(possible), np.zeros(len(sets), bool), np.zeros(len(sets.start) - 1, bool)
    groups[sets.group[which]] = True
    _, chosen[which], cut = packed_groups(sets.take(which), n_records, groups, tuning)
    rest = groups & (cut < 0)
    if not rest.any():
        return chosen
    which = np.flatnonzero(possible | (sets.size == 1))
    searched = np.zeros(len(sets), bool)
    searched[which] = best_partition(sets.take(which), n_records, rest, time_limit_s=time_limit_s).chosen
    return np.where(rest[sets.group], searched, chosen)


def packed_groups(
    sets: Sets, n_records: int, groups: BoolArray, tuning: ManyTuning = TUNING
) -> tuple[FloatArray, BoolArray, FloatArray]:
    """Probabilities and best partition (k,) of the groups (g,) of which all blocks can be summed, and their cut.

    No linear programme is needed: duals are found by descent, and by annealing where that is not enough. The cut of the
    groups that are not solved is −1.
    """
    from sameas.kernels.partitions import packed

    n, dual = len(sets), np.zeros(n_records)
    at, record = sets.entries()
    np.maximum.at(dual, record, (sets.log_weight / sets.size)[at])
    share, chosen, cut = np.zeros(n), np.zeros(n, bool), np.full(len(groups), -1.0)
    packed(
        np.flatnonzero(groups & (sets.floor <= 0)), sets.start, sets.members, sets.log_weight, tuning.small,
        np.array(tuning.cuts), MOST_RECORDS, min(tuning.block_steps, tuning.most_steps), dual, share, chosen, cut,
    )  # fmt: skip
    return share, chosen, cut


def _reduced_cost(sets: Sets, dual: FloatArray, slack: FloatArray, weight: FloatArray) -> FloatArray:
    """(k,) the sum of the duals of a set's records less its ln w, less the slack of the relaxation."""
    total = np.where(sets.members != NO_RECORD, dual[sets.members], 0.0).sum(axis=1)
    return np.asarray(total - weight - slack[sets.group])


def _solve_counted(
    sets: Sets, sums: _Sums, g: int, weight: FloatArray, chosen: BoolArray, time_limit_s: float
) -> float:
    """Choose one group's sets by branch and bound; tilt its weights by the slope of the prior there; its gap."""
    here = np.arange(sets.start[g], sets.start[g + 1])
    merges = sets.size[here] - 1
    log_p = sums.table[sums.table_start[g] : sums.table_start[g + 1]]
    several = here[merges > 0]
    incidence = incidence_of(sets, sums.n_records)[:, several]
    picked, gap = best_counted(weight[several], sets.size[several] - 1, incidence, log_p, time_limit_s)
    chosen[here] = False
    chosen[several[picked]] = True
    taken = sets.members[several[picked]]
    alone = here[merges == 0]
    chosen[alone] = ~np.isin(sets.members[alone].max(axis=1), taken)
    count = int((sets.size[several[picked]] - 1).sum())
    low, high = max(count - 1, 0), min(count + 1, len(log_p) - 1)
    weight[here] += merges * (log_p[high] - log_p[low]) / max(high - low, 1)
    return gap


@in_short
@dataclass(frozen=True)
class _Sums:
    """Sums over partitions; ``table`` holds ln P of 0, 1, … merges of group g from table_start[g] on."""

    sets: Sets
    n_records: int
    table_start: IntArray
    table: FloatArray
    counts: bool
    tuning: ManyTuning

    @classmethod
    def additive(cls, sets: Sets, n_records: int, tuning: ManyTuning) -> _Sums:
        return cls(sets, n_records, np.zeros(len(sets.start), np.int64), np.zeros(1), False, tuning)

    @classmethod
    def counted(cls, sets: Sets, pooled: PooledRecords, counts: MissedObjects, tuning: ManyTuning) -> _Sums:
        tables = {int(n): counts.table(pooled, int(n)) for n in np.unique(pooled.sizes)}
        table = np.concatenate([tables[int(n)] for n in pooled.sizes] or [np.zeros(1)])
        return cls(sets, len(pooled), Ragged.of_sizes(pooled.sizes).start, table, True, tuning)

    def all(
        self, cost: FloatArray, chosen: BoolArray, cut: FloatArray, weight: FloatArray
    ) -> tuple[FloatArray, BoolArray, FloatArray]:
        """Probabilities with as small a cut as each group allows; groups whose ``cut`` is not negative are done.

        weight : (k,) ln w, under a count prior tilted by its slope at the best partition; messages go by these.
        """
        from sameas.kernels.partitions import LEAST_CUT, set_messages

        share, cut = np.zeros(len(self.sets)), cut.copy()
        for value in self.tuning.cuts:
            unsolved = cut < 0
            if value < LEAST_CUT or not unsolved.any():
                break
            part, _, solved = self.without(np.where(chosen, 0.0, cost), value, unsolved)
            share += part
            cut[solved] = value
        rest = cut < 0
        if rest.any():
            sets = self.sets
            set_messages(np.flatnonzero(rest), sets.start, sets.members, weight, self.n_records, share)
        cut[rest] = 0.0
        return share, chosen, cut

    def without(self, cost: FloatArray, cut: float, groups: BoolArray) -> tuple[FloatArray, BoolArray, BoolArray]:
        """Probabilities, best partition and whether solved, for some groups (g,) and their sets of cost ≤ cut."""
        from sameas.kernels.partitions import eliminate

        sets = self.sets
        groups = groups & ~self._too_wide(np.flatnonzero((cost <= cut) & groups[sets.group]))
        kept = np.flatnonzero((cost <= cut) & groups[sets.group])
        blocks = _Blocks.of(sets, kept, self.n_records, self.counts)
        share, chosen = np.zeros(len(sets)), np.zeros(len(sets), bool)
        share[kept[blocks.sure]], chosen[kept[blocks.sure]] = 1.0, True
        part, best = np.zeros(len(blocks.at)), np.zeros(len(blocks.at), bool)
        solved = np.zeros(len(blocks.group), bool)
        at = kept[blocks.at]
        start, table = self._left_of_table(blocks, kept[blocks.sure])
        eliminate(
            np.flatnonzero(blocks.size <= MOST_RECORDS), blocks.start, blocks.first, blocks.mask, sets.log_weight[at],
            sets.size[at] - 1, start, table, self.counts, self.tuning.most_steps, part, best, solved,
        )  # fmt: skip
        done = groups
        done[blocks.group[~solved]] = False
        share[at], chosen[at] = part, best
        return np.where(done[sets.group], share, 0.0), chosen & done[sets.group], done

    def _too_wide(self, kept: IntArray) -> BoolArray:
        """(g,) groups in which the kept sets entangle more records than a state can hold; they are not tried."""
        sets, wide = self.sets, np.zeros(len(self.sets.start) - 1, bool)
        kept = kept[(self._sizes > MOST_RECORDS)[sets.group[kept]] & (sets.size[kept] > 1)]
        if self.counts or not len(kept):
            return wide
        at, source = np.nonzero(sets.members[kept] != NO_RECORD)
        edges = (sets.members[kept][at, source], self.n_records + at)
        size = self.n_records + len(kept)
        _, part = connected_components(
            csr_array((np.ones(len(at), np.int8), edges), shape=(size, size)), directed=False
        )
        records = np.bincount(part[: self.n_records])
        wide[sets.group[kept[records[part[self.n_records :]] > MOST_RECORDS]]] = True
        return wide

    @cached_property
    def _sizes(self) -> IntArray:
        """(g,) records of each group."""
        return np.bincount(self.sets.group[self.sets.size == 1], minlength=len(self.sets.start) - 1)

    def _left_of_table(self, blocks: _Blocks, sure: IntArray) -> tuple[IntArray, FloatArray]:
        """Starts and ln P of the merges that remain for each block after those of the sure sets."""
        if not self.counts:
            return np.zeros(len(blocks.group) + 1, np.int64), np.zeros(1)
        made = np.bincount(self.sets.group[sure], self.sets.size[sure] - 1, len(self.table_start)).astype(np.int64)
        low, high = self.table_start[blocks.group] + made[blocks.group], self.table_start[blocks.group + 1]
        lists = [self.table[a:b] for a, b in zip(low, high, strict=True)]
        return Ragged.of_sizes(high - low).start, np.concatenate([*lists, np.zeros(1)])


@in_short
@dataclass(frozen=True)
class _Blocks:
    """Records that the kept sets entangle with each other, laid out for elimination.

    sure : places among the kept of sets that share no record with another. at : of the others, block by block, by
    their first record. start : (b+1,) of the blocks. first, mask : per set the number of its first record within the
    block, and its records as bits. size : (b,) records. group : (b,) group of the block.
    """

    sure: IntArray
    at: IntArray
    start: IntArray
    first: IntArray
    mask: NDArray[np.uint64]
    size: IntArray
    group: IntArray

    @classmethod
    def of(cls, sets: Sets, kept: IntArray, n_records: int, whole_groups: bool) -> _Blocks:
        members = sets.members[kept]
        at, source = np.nonzero(members != NO_RECORD)
        record = members[at, source]
        incidence = csr_array((np.ones(len(at), np.int32), (record, at)), shape=(n_records, len(kept)))
        touching = csr_array(incidence @ incidence.T)
        _, part = connected_components(touching, directed=False)
        of_set = part[members.max(axis=1)]
        alone = np.bincount(of_set, minlength=part.max(initial=-1) + 1)[of_set] == 1
        sure, rest = np.flatnonzero(alone), np.flatnonzero(~alone)
        unit = sets.group[kept] if whole_groups else of_set
        labels, block = np.unique(unit[rest], return_inverse=True)
        # Records that share sets follow each other, so that states hold few records.
        rank = np.empty(n_records, np.int64)
        if n_records:
            rank[reverse_cuthill_mckee(touching, symmetric_mode=True)] = np.arange(n_records)
        number, size = _numbers(block, rest, at, record, part, rank, len(labels), n_records)
        bits = number[record]
        low = np.full(len(kept), 1 << 30)
        np.minimum.at(low, at, bits)
        mask = np.zeros(len(kept), np.uint64)
        np.bitwise_or.at(mask, at, np.uint64(1) << np.minimum(bits, 63).astype(np.uint64))
        order = np.lexsort([rest, low[rest], block])
        start = Ragged.of_sorted(block[order], len(labels)).start
        there = rest[order]
        group = sets.group[kept[there[start[:-1]]]] if len(labels) else np.empty(0, np.int64)
        return cls(sure, there, start, low[there], mask[there], size, group)


def _numbers(
    block: IntArray, rest: IntArray, at: IntArray, record: IntArray, part: IntArray, rank: IntArray, n_blocks: int,
    n_records: int,
) -> tuple[IntArray, IntArray]:  # fmt: skip
    """(n,) number of each record within its block (0 where it has none), and the sizes of the blocks."""
    of_set = np.full(at.max(initial=-1) + 1, -1)
    of_set[rest] = block
    of_record = np.full(n_records, -1)
    of_record[record] = of_set[at]
    inside = np.flatnonzero(of_record >= 0)
    inside = inside[np.lexsort([rank[inside], part[inside], of_record[inside]])]
    size = np.bincount(of_record[inside], minlength=n_blocks)
    number = np.zeros(n_records, np.int64)
    number[inside] = Ragged.of_sizes(size).index
    return number, size

"""The best partition of every group's records into objects, and the probability of every candidate set.

*Best partition*: set packing (:class:`Partition`). Without a count prior, the linear relaxation of all groups is solved
at once (SciPy's HiGHS). A group whose solution is integral is solved; others are solved by branch and bound. The
relaxation's dual value bounds every group's gap. With a count prior, small groups are solved by exact elimination,
others by branch and bound with one binary variable for every number of merges.

*Marginals*: sums over all partitions of a group. Records are eliminated one by one; the state is the set of later
records that are taken and, with a count prior, the number of merges. Sets of large reduced cost are excluded first: by
the duals of the best partition, a partition with a set of reduced cost c is at least eᶜ times less probable than the
best. Without the sets of c > 30 the sum counts as exact. Groups for which it is too long are summed without the sets of
c > 20, 14, …, until it is short enough; where c would have to be below 2, or no c is low enough, a walk over all
partitions (:mod:`sameas.many.walk`) replaces the sum, or samples of those of the listed sets
(:mod:`sameas.kernels.partition_samples`). The result states which.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import Bounds, LinearConstraint, linprog, milp
from scipy.sparse import csr_array, hstack, vstack
from scipy.sparse.csgraph import connected_components, reverse_cuthill_mckee

from sameas.arrays import ABSENT, BoolArray, FloatArray, IntArray, entries
from sameas.many.near_sets import SetWeights
from sameas.many.pooled import PooledRecords, record_codes
from sameas.many.rules import MissedObjects, Terms
from sameas.many.sets import TUNING, ManyTuning, Sets
from sameas.many.walk import Walk
from sameas.ragged import Ragged
from sameas.representation import in_short

#: Maximum number of nodes of a branch and bound (chosen): a time would let the answer depend on the machine.
NODES = 1000


@dataclass(frozen=True)
class Partition:
    """The best partition found.

    Attributes
    ----------
    chosen : (k,) the sets that are objects; every record is in one of them.
    gap : (g,) upper bound of ln of the odds of a better partition of the group; 0 if this is the best.
    dual : (n,) dual values of the records: a set weighs at most the sum of its records' duals.
    slack : (g,) the relaxation's value minus the partition's.
    """

    chosen: BoolArray
    gap: FloatArray
    dual: FloatArray
    slack: FloatArray


def best_partition(sets: Sets, n_records: int, groups: BoolArray | None = None) -> Partition:
    """The partition of largest Σ ln w of every group, or of some ``groups`` (g,); all records alone in the others."""
    incidence = incidence_of(sets, n_records)
    active, x, dual = _relaxation(sets, incidence, np.ones(len(sets.start) - 1, bool) if groups is None else groups)
    n_groups = len(sets.start) - 1
    chosen = np.zeros(len(sets), bool)
    chosen[active[x > 0.5]] = True
    fractional = np.zeros(n_groups, bool)
    fractional[sets.group[active[np.abs(x - np.round(x)) > 1e-6]]] = True
    group_of_record = _group_of_record(sets, n_records)
    bound = np.bincount(group_of_record, dual, n_groups)
    for g in np.flatnonzero(fractional):
        own = slice(*np.searchsorted(active, sets.start[g : g + 2]))
        chosen[active[own]] = False
        packing, tighter = _best_packing(sets, active[own], x[own], dual, incidence)
        chosen[packing] = True
        bound[g] = min(bound[g], tighter)
    chosen |= _alone(sets, chosen, incidence)
    value = np.bincount(sets.group[chosen], sets.log_weight[chosen], n_groups)
    scale = np.maximum(1.0, np.abs(value))
    slack = np.maximum(np.bincount(group_of_record, dual, n_groups) - value, 0.0)
    gap = np.maximum(bound - value, 0.0)
    gap = np.where(gap <= 1e-7 * scale, 0.0, gap)
    return Partition(chosen, np.where(sets.floor > 0, np.inf, gap), dual, slack)


def best_counted(
    weight: FloatArray, merges: IntArray, incidence: csr_array, log_p: FloatArray
) -> tuple[IntArray, float]:
    """The sets of one group that maximise Σ ln w + ln P(Σ merges), and the gap.

    weight, merges : (k,) of the sets. incidence : (n, k) records in sets. log_p : ln P of 0, 1, … merges.
    """
    n, m = len(weight), len(log_p)
    cover = hstack([incidence, csr_array((incidence.shape[0], m))])
    balance = np.concatenate([merges, -np.arange(m)]).astype(np.float64)
    one = np.concatenate([np.zeros(n), np.ones(m)])
    rows = vstack([cover, csr_array(balance[None]), csr_array(one[None])]).tocsr()
    low = np.concatenate([np.zeros(incidence.shape[0]), [0.0, 1.0]])
    high = np.concatenate([np.ones(incidence.shape[0]), [0.0, 1.0]])
    x, bound, value = _branched(np.concatenate([weight, log_p]), rows, low, high)
    return np.flatnonzero(x[:n] > 0.5), max(bound - value, 0.0)


def _relaxation(sets: Sets, incidence: csr_array, groups: BoolArray) -> tuple[IntArray, FloatArray, FloatArray]:
    """Linear relaxation of the packing of some groups: its sets, their values, and the duals (n,) of all records."""
    # A set that weighs at most as much as its records alone, or as itself without one of them, is never needed: the
    # duals of the other sets bound it too.
    positive = (sets.log_weight > 0) & groups[sets.group]
    useful = np.flatnonzero(positive & ~_dominated(sets)) if positive.any() else np.empty(0, np.int64)
    n_records = incidence.shape[0]
    if not len(useful):
        return useful, np.empty(0), np.zeros(n_records)
    solution = linprog(-sets.log_weight[useful], A_ub=incidence[:, useful], b_ub=np.ones(n_records), method="highs-ds")
    if solution.status != 0:
        raise RuntimeError(f"the linear relaxation was not solved: {solution.message}")
    return useful, solution.x, np.maximum(-solution.ineqlin.marginals, 0.0)


def _dominated(sets: Sets) -> BoolArray:
    """(k,) the sets that weigh at most as much as the set without one of their records."""
    # Sets are looked up by the sum of their codes, then compared record by record.
    code = record_codes(int(sets.members.max(initial=0)) + 1)
    total = code[sets.members].sum(axis=1, dtype=np.uint64)
    order = np.argsort(total, kind="stable")
    ordered = total[order]
    out = np.zeros(len(sets), bool)
    for s in range(sets.members.shape[1]):
        k = np.flatnonzero((sets.members[:, s] != ABSENT) & (sets.size > 2))
        sought = total[k] - code[sets.members[k, s]]
        candidate = order[np.minimum(np.searchsorted(ordered, sought), len(order) - 1)]
        rest = sets.members[k]
        rest[:, s] = ABSENT
        same = (sets.members[candidate] == rest).all(axis=1)
        out[k] |= same & (sets.log_weight[k] <= sets.log_weight[candidate])
    return out


def _best_packing(
    sets: Sets, useful: IntArray, x: FloatArray, dual: FloatArray, incidence: csr_array
) -> tuple[IntArray, float]:
    """The best packing of one group's ``useful`` sets, and its bound, from the relaxation's values x and its duals.

    First a good packing: the sets of x = 1, and the best of those that share no record with them. In a better packing,
    every set has a reduced cost of at most the relaxation's value minus the good packing's.
    """
    within, weight = incidence[:, useful], sets.log_weight[useful]
    whole = x > 1.0 - 1e-6
    disjoint = np.flatnonzero(within.T @ (within[:, whole].sum(axis=1) > 0) == 0)
    added, _ = _branched_packing(weight[disjoint], within[:, disjoint])
    good = np.concatenate([np.flatnonzero(whole), disjoint[added]])
    value, cost = float(weight[good].sum()), within.T @ dual - weight
    relaxed = float(dual[within.sum(axis=1) > 0].sum())
    cheap = np.flatnonzero(cost <= relaxed - value + 1e-6 * max(1.0, abs(relaxed)))
    packing, bound = _branched_packing(weight[cheap], within[:, cheap])
    best = cheap[packing]
    return useful[best if weight[best].sum() >= value else good], max(bound, value)


def _branched_packing(weight: FloatArray, incidence: csr_array) -> tuple[IntArray, float]:
    """The best packing of some sets by branch and bound, and the bound."""
    if not len(weight):
        return np.empty(0, np.int64), 0.0
    high = np.ones(incidence.shape[0])
    x, bound, _ = _branched(weight, incidence, np.full(len(high), -np.inf), high)
    return np.flatnonzero(x > 0.5), bound


def _branched(
    weight: FloatArray, rows: csr_array, low: FloatArray, high: FloatArray
) -> tuple[FloatArray, float, float]:
    """Solution, bound and value of the binary programme of largest weight; all 0 if the limit of nodes came first."""
    used = np.diff(rows.tocsr().indptr) > 0
    constraint = LinearConstraint(rows.tocsr()[used], low[used], high[used])
    options = {"mip_rel_gap": 0.0, "node_limit": NODES}
    solution = milp(-weight, constraints=constraint, integrality=np.ones(len(weight)), bounds=Bounds(0, 1),
                    options=options)  # fmt: skip
    bound = np.inf if solution.mip_dual_bound is None else -float(solution.mip_dual_bound)
    if solution.x is None:
        return np.zeros(len(weight)), bound, 0.0
    return np.round(solution.x), bound, float(weight @ np.round(solution.x))


def _alone(sets: Sets, chosen: BoolArray, incidence: csr_array) -> BoolArray:
    """(k,) the sets of a single record that is in no chosen set."""
    in_chosen = np.asarray(incidence[:, chosen].sum(axis=1) > 0)
    single = sets.size == 1
    return np.asarray(single & ~in_chosen[sets.members.max(axis=1)] & ~chosen)


def incidence_of(sets: Sets, n_records: int) -> csr_array:
    """(n, k) 1 where a record is in a set."""
    at, record = sets.entries()
    return csr_array((np.ones(len(at)), (record, at)), shape=(n_records, len(sets)))


def _group_of_record(sets: Sets, n_records: int) -> IntArray:
    """(n,) the group of every record."""
    single = np.flatnonzero(sets.size == 1)
    group = np.empty(n_records, np.int64)
    group[sets.members[single].max(axis=1)] = sets.group[single]
    return group


#: A sum without the sets of larger reduced cost counts as exact: e⁻³⁰ is below the resolution of a probability.
EXACT = 30.0
#: Most records of a block: the bits of a state.
MAX_RECORDS = 63


@in_short
@dataclass(frozen=True)
class Answer:
    """The best partition and the probabilities of all sets.

    chosen : (k,) the sets that are objects. probability : (k,) of every set.
    gap : (g,) upper bound of ln of the odds of a better partition.
    cut : (g,) reduced cost above which sets were excluded from the sum: :data:`EXACT` or more if the sum is exact,
        below 2 if probabilities are by samples.
    """

    chosen: BoolArray
    probability: FloatArray
    gap: FloatArray
    cut: FloatArray

    def exact(self, floor: FloatArray) -> BoolArray:
        """(g,) whether probabilities are exact; floor : (g,) of :class:`Sets`, −∞ where no set was excluded."""
        return np.asarray((self.cut >= EXACT) & (floor == -np.inf))


def answer(sets: Sets, pooled: PooledRecords, counts: MissedObjects | None, *, tuning: ManyTuning = TUNING) -> Answer:
    """The best partition of every group and the probabilities of all sets; counts : the count prior, or None."""
    if counts is None:
        return additive_answer(sets, pooled.sizes, tuning=tuning)
    sums = _Sums.of(sets, pooled, counts, tuning)
    no_cost = np.zeros(len(sets))
    share, chosen, solved = sums.below(no_cost, EXACT, np.ones(len(pooled.sizes), bool))
    cut = np.where(solved, np.inf, -1.0)
    gap = np.where(sets.floor > 0, np.inf, 0.0)
    if not solved.all():
        weight = sets.log_weight.copy()
        for g in np.flatnonzero(~solved).tolist():
            gap[g] = max(gap[g], _solve_counted(sets, sums, g, weight, chosen))
        tilted = replace(sets, log_weight=weight)
        best = best_partition(tilted, len(pooled))
        cost = _reduced_cost(sets, best.dual, best.slack, weight)
        part, _, cut = sums.all(cost, chosen, cut, weight)
        share = np.where(solved[sets.group], share, part)
    return Answer(chosen, share, gap, cut)


def additive_answer(sets: Sets, sizes: IntArray, *, tuning: ManyTuning = TUNING, samples: bool = True) -> Answer:
    """:func:`answer` without a count prior.

    sizes : (g,) number of records of every group. samples : False to leave probabilities of 0 where samples are needed.
    """
    from sameas.kernels.packing import pack
    from sameas.kernels.partitions import set_samples

    n = int(sizes.sum())
    share, chosen, cut = sum_pruned_groups(sets, n, np.ones(len(sizes), bool), tuning)
    gap = np.where(sets.floor > 0, np.inf, 0.0)
    sampled = cut < 0
    unsolved = sampled.copy()
    if sets.partition is not None:
        near = sampled & (gap > 0.0)
        chosen = np.where(near[sets.group], sets.partition, chosen)
        # The weights may have changed since the partition was found.
        pack(np.flatnonzero(near), sets.start, sets.members, sets.log_weight, n, chosen)
        unsolved &= ~near
    if unsolved.any():
        best = best_partition(sets, n, unsolved)
        chosen, gap = np.where(unsolved[sets.group], best.chosen, chosen), np.where(unsolved, best.gap, gap)
    if samples:
        set_samples(np.flatnonzero(sampled), sets.start, sets.members, sets.log_weight, chosen, n, share)
    return Answer(chosen, share, gap, np.where(sampled, 0.0, cut))


def walked_answer(
    sets: Sets, pooled: PooledRecords, terms: Terms, *, tuning: ManyTuning = TUNING
) -> tuple[Sets, Answer]:
    """:func:`additive_answer` with walks in place of samples, and the sets with those that the walks add.

    A group with the sets near a good partition is walked, too, unless a short walk meets no others and its sets could
    be summed. terms : of which the weights are sums (:func:`sameas.many.walk.can_walk`).
    """
    summed = additive_answer(sets, pooled.sizes, tuning=tuning, samples=False)
    long = summed.cut < tuning.walked_below
    groups = (long | (sets.floor == np.inf)) & (pooled.sizes > 1)
    if not groups.any():
        return sets, summed
    share, cut, walk = summed.probability.copy(), summed.cut.copy(), Walk.of(pooled, terms, groups)
    added, added_share = [sets.members[:0]], [share[:0]]
    for g in np.flatnonzero(groups).tolist():
        own = slice(sets.start[g], sets.start[g + 1])
        found = walk.group(g, sets.members[own], summed.chosen[own], is_summed=not long[g])
        if found is not None:
            share[own], members, of_members = found
            cut[g] = 0.0
            added.append(members)
            added_share.append(of_members)
    members = np.concatenate(added)
    group = pooled.group[members.max(axis=1, initial=0)]
    more, order = sets.with_more(members, SetWeights(pooled, terms)(members), group)
    chosen = np.append(summed.chosen, np.zeros(len(members), bool))[order]
    return more, Answer(chosen, np.concatenate([share, *added_share])[order], summed.gap, cut)


def best_sets(sets: Sets, n_records: int, possible: BoolArray, *, tuning: ManyTuning = TUNING) -> BoolArray:
    """(k,) the sets of the best partition, without a count prior, of the records of the ``possible`` sets.

    possible : (k,) sets of nonzero probability under similar weights; they include a partition of their records.
    """
    which, chosen, groups = np.flatnonzero(possible), np.zeros(len(sets), bool), np.zeros(len(sets.start) - 1, bool)
    groups[sets.group[which]] = True
    _, chosen[which], cut = sum_pruned_groups(sets.take(which), n_records, groups, tuning)
    unsolved = groups & (cut < 0)
    if not unsolved.any():
        return chosen
    which = np.flatnonzero(possible | (sets.size == 1))
    searched = np.zeros(len(sets), bool)
    searched[which] = best_partition(sets.take(which), n_records, unsolved).chosen
    return np.where(unsolved[sets.group], searched, chosen)


def sum_pruned_groups(
    sets: Sets, n_records: int, groups: BoolArray, tuning: ManyTuning = TUNING
) -> tuple[FloatArray, BoolArray, FloatArray]:
    """Probabilities and best partition (k,) of the ``groups`` (g,) whose blocks can all be summed, and their cut (g,).

    No linear programme is needed: duals are found by descent, and by annealing where that is not enough. Groups that
    are not solved have a cut of −1.
    """
    from sameas.kernels.partitions import FEW_RECORDS, FEW_SETS, sum_few, sum_pruned

    n, dual = len(sets), np.zeros(n_records)
    at, record = sets.entries()
    np.maximum.at(dual, record, (sets.log_weight / sets.size)[at])
    share, chosen, cut = np.zeros(n), np.zeros(n, bool), np.full(len(groups), -1.0)
    remaining, few = groups.copy(), np.zeros(len(groups), bool)
    if tuning.small >= FEW_RECORDS:
        short = np.flatnonzero(remaining & (np.diff(sets.start) <= FEW_SETS))
        sum_few(short, sets.start, sets.members, sets.log_weight, n_records, share, chosen, few)
    cut[few] = tuning.cuts[0]
    sum_pruned(
        np.flatnonzero(remaining & ~few), sets.start, sets.members, sets.log_weight, tuning.small,
        np.array(tuning.cuts), MAX_RECORDS, min(tuning.block_steps, tuning.max_steps), dual, share, chosen, cut,
    )  # fmt: skip
    return share, chosen, cut


def _reduced_cost(sets: Sets, dual: FloatArray, slack: FloatArray, weight: FloatArray) -> FloatArray:
    """(k,) sum of the duals of a set's records minus its ln w, minus the slack of its group."""
    total = np.where(sets.members != ABSENT, dual[sets.members], 0.0).sum(axis=1)
    return np.asarray(total - weight - slack[sets.group])


def _solve_counted(sets: Sets, sums: _Sums, g: int, weight: FloatArray, chosen: BoolArray) -> float:
    """Choose group g's sets by branch and bound, in ``chosen``, and tilt its ``weight`` by the prior's slope at their
    number of merges; returns the gap."""
    of_group = np.arange(sets.start[g], sets.start[g + 1])
    merges = sets.size[of_group] - 1
    log_p = sums.table[sums.table_start[g] : sums.table_start[g + 1]]
    multiple = of_group[merges > 0]
    incidence = incidence_of(sets, sums.n_records)[:, multiple]
    best, gap = best_counted(weight[multiple], sets.size[multiple] - 1, incidence, log_p)
    chosen[of_group] = False
    chosen[multiple[best]] = True
    covered = sets.members[multiple[best]]
    single = of_group[merges == 0]
    chosen[single] = ~np.isin(sets.members[single].max(axis=1), covered)
    count = int((sets.size[multiple[best]] - 1).sum())
    low, high = max(count - 1, 0), min(count + 1, len(log_p) - 1)
    weight[of_group] += merges * (log_p[high] - log_p[low]) / max(high - low, 1)
    return gap


@dataclass(frozen=True)
class _Sums:
    """Sums over partitions with a count prior. table : ln P of 0, 1, … merges of group g, from table_start[g] on."""

    sets: Sets
    n_records: int
    table_start: IntArray
    table: FloatArray
    tuning: ManyTuning

    @classmethod
    def of(cls, sets: Sets, pooled: PooledRecords, counts: MissedObjects, tuning: ManyTuning) -> _Sums:
        tables = {int(n): counts.table(pooled, int(n)) for n in np.unique(pooled.sizes)}
        table = np.concatenate([tables[int(n)] for n in pooled.sizes] or [np.zeros(1)])
        return cls(sets, len(pooled), Ragged.of_sizes(pooled.sizes).start, table, tuning)

    def all(
        self, cost: FloatArray, chosen: BoolArray, cut: FloatArray, weight: FloatArray
    ) -> tuple[FloatArray, BoolArray, FloatArray]:
        """Probabilities (k,) and cuts (g,): for each group the first of ``tuning.cuts`` with which its sum is short
        enough. Groups with a ``cut`` of 0 or more are skipped.

        cost : (k,) reduced costs. chosen : (k,) sets of the best partition, never excluded. weight : (k,) ln w, tilted
        by the prior's slope at the best partition; used by the samples.
        """
        from sameas.kernels.partitions import MIN_CUT, set_samples

        share, cut = np.zeros(len(self.sets)), cut.copy()
        for limit in self.tuning.cuts:
            unsolved = cut < 0
            if limit < MIN_CUT or not unsolved.any():
                break
            part, _, solved = self.below(np.where(chosen, 0.0, cost), limit, unsolved)
            share += part
            cut[solved] = limit
        unsolved = cut < 0
        if unsolved.any():
            sets = self.sets
            set_samples(np.flatnonzero(unsolved), sets.start, sets.members, weight, chosen, self.n_records, share)
        cut[unsolved] = 0.0
        return share, chosen, cut

    def below(self, cost: FloatArray, cut: float, groups: BoolArray) -> tuple[FloatArray, BoolArray, BoolArray]:
        """Probabilities and best partition (k,) of some groups (g,) by their sets of cost ≤ cut, and which (g,) are
        solved."""
        from sameas.kernels.partitions import eliminate

        sets = self.sets
        kept = np.flatnonzero((cost <= cut) & groups[sets.group])
        blocks = _Blocks.of(sets, kept, self.n_records)
        share, chosen = np.zeros(len(sets)), np.zeros(len(sets), bool)
        share[kept[blocks.certain]], chosen[kept[blocks.certain]] = 1.0, True
        part, best = np.zeros(len(blocks.at)), np.zeros(len(blocks.at), bool)
        solved = np.zeros(len(blocks.group), bool)
        at = kept[blocks.at]
        start, table = self._remaining_table(blocks, kept[blocks.certain])
        eliminate(
            np.flatnonzero(blocks.size <= MAX_RECORDS), blocks.start, blocks.size, blocks.first, blocks.mask,
            sets.log_weight[at], sets.size[at] - 1, start, table, self.tuning.max_steps, part, best, solved,
        )  # fmt: skip
        done = groups.copy()
        done[blocks.group[~solved]] = False
        share[at], chosen[at] = part, best
        return np.where(done[sets.group], share, 0.0), chosen & done[sets.group], done

    def _remaining_table(self, blocks: _Blocks, certain: IntArray) -> tuple[IntArray, FloatArray]:
        """Starts and ln P of the numbers of merges that remain for each block after those of the certain sets."""
        certain_merges = np.bincount(
            self.sets.group[certain], self.sets.size[certain] - 1, len(self.table_start)
        ).astype(np.int64)
        low, high = self.table_start[blocks.group] + certain_merges[blocks.group], self.table_start[blocks.group + 1]
        lists = [self.table[a:b] for a, b in zip(low, high, strict=True)]
        return Ragged.of_sizes(high - low).start, np.concatenate([*lists, np.zeros(1)])


@dataclass(frozen=True)
class _Blocks:
    """The groups' records that the kept sets connect, laid out for elimination.

    certain : positions among the kept sets of those that share no record with another. at : positions of the others,
    by block and first record. start : (b+1,) of the blocks. first, mask : of each set, the number of its first record
    within the block, and its records as bits. size : (b,) number of records. group : (b,) group of the block.
    """

    certain: IntArray
    at: IntArray
    start: IntArray
    first: IntArray
    mask: NDArray[np.uint64]
    size: IntArray
    group: IntArray

    @classmethod
    def of(cls, sets: Sets, kept: IntArray, n_records: int) -> _Blocks:
        members = sets.members[kept]
        at, record = entries(members)
        incidence = csr_array((np.ones(len(at), np.int32), (record, at)), shape=(n_records, len(kept)))
        adjacency = csr_array(incidence @ incidence.T)
        _, part = connected_components(adjacency, directed=False)
        of_set = part[members.max(axis=1)]
        isolated = np.bincount(of_set, minlength=part.max(initial=-1) + 1)[of_set] == 1
        certain, uncertain = np.flatnonzero(isolated), np.flatnonzero(~isolated)
        # Their number of merges joins all blocks of a group.
        labels, block = np.unique(sets.group[kept[uncertain]], return_inverse=True)
        # Records that share sets get consecutive numbers, so that states have few records.
        rank = np.empty(n_records, np.int64)
        if n_records:
            rank[reverse_cuthill_mckee(adjacency, symmetric_mode=True)] = np.arange(n_records)
        number, size = _numbers(block, uncertain, at, record, part, rank, len(labels), n_records)
        bits = number[record]
        low = np.full(len(kept), 1 << 30)
        np.minimum.at(low, at, bits)
        mask = np.zeros(len(kept), np.uint64)
        np.bitwise_or.at(mask, at, np.uint64(1) << np.minimum(bits, 63).astype(np.uint64))
        order = np.lexsort([uncertain, low[uncertain], block])
        start = Ragged.of_sorted(block[order], len(labels)).start
        ordered = uncertain[order]
        group = sets.group[kept[ordered[start[:-1]]]] if len(labels) else np.empty(0, np.int64)
        return cls(certain, ordered, start, low[ordered], mask[ordered], size, group)


def _numbers(
    block: IntArray, uncertain: IntArray, at: IntArray, record: IntArray, part: IntArray, rank: IntArray, n_blocks: int,
    n_records: int,
) -> tuple[IntArray, IntArray]:  # fmt: skip
    """(n,) number of each record within its block (0 without a block), and (b,) numbers of records of the blocks."""
    of_set = np.full(at.max(initial=-1) + 1, ABSENT)
    of_set[uncertain] = block
    of_record = np.full(n_records, ABSENT)
    of_record[record] = of_set[at]
    numbered = np.flatnonzero(of_record >= 0)
    numbered = numbered[np.lexsort([rank[numbered], part[numbered], of_record[numbered]])]
    size = np.bincount(of_record[numbered], minlength=n_blocks)
    number = np.zeros(n_records, np.int64)
    number[numbered] = Ragged.of_sizes(size).index
    return number, size

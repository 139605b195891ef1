"""Compiled sums over the partitions of a group's records into sets, by eliminating records one by one.

The state after r records is the set of later records that are taken and, with a count prior, the number of merges.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import BoolArray, FloatArray, Int32Array, IntArray
from sameas.kernels.compiled import inlined, kernel, part, small_by
from sameas.kernels.packing import (
    ANNEALINGS,
    KeptSets,
    anneal,
    ascending,
    blocks_of,
    local_numbers,
    not_done,
    prune,
    selected,
)
from sameas.kernels.partition_samples import sampled

NONE = -1
#: First size of the arrays of steps.
FIRST_CAPACITY = 256
#: Sums with a smaller cut are no more accurate than samples, and the best partition alone is worse: the rms error of
#: probabilities on random groups of 8 to 30 records, weak and strong sets, is 0.01 to 0.02 with a cut of 2, 0.05 to
#: 0.09 with a cut of 1, 0.01 by samples, 0.16 to 0.24 by the best partition alone.
MIN_CUT = 2.0
#: Groups of at most this many records and sets are summed partition by partition, if the best partition outweighs the
#: second by more than the last number, in nats.
FEW_RECORDS, FEW_SETS, CLEAR_NATS = 3, 7, 1e-9


@kernel
def eliminate(
    groups: IntArray, start: IntArray, size: IntArray, first: IntArray, mask: NDArray[np.uint64], weight: FloatArray,
    merges: IntArray, table_start: IntArray, table: FloatArray, cap: int, share: FloatArray, chosen: BoolArray,
    solved: BoolArray,
) -> None:  # fmt: skip
    """Write every set's probability to ``share``, the best partition to ``chosen``, the solved groups to ``solved``.

    groups : numbers of the groups to sum. start : (g+1,) sets of each group, ascending in ``first``, the number of the
    set's first record within the group, of ``size`` (g,) records. mask : records of each set as bits.
    table[table_start[g] + m] : ln P of m merges. Groups that need more than ``cap`` steps between states are not
    solved.
    """
    for g in groups:
        a, b = start[g], start[g + 1]
        log_p = table[table_start[g] : table_start[g + 1]]
        solved[g] = _sum_group(
            size[g], first[a:b], mask[a:b], weight[a:b], merges[a:b], log_p, True, cap, share[a:b], chosen[a:b]
        )


@part
def _sum_group(
    n: int, first: IntArray, mask: NDArray[np.uint64], weight: FloatArray, merges: IntArray, log_p: FloatArray,
    counted: bool, cap: int, share: FloatArray, chosen: BoolArray,
) -> bool:  # fmt: skip
    key, n_merges, layer, origin, target, used = _steps(n, first, mask, merges, counted, cap)
    if len(layer) == 0:
        return False
    best, step = _best_paths(len(key), origin, target, used, weight)
    last, stop = layer[n], layer[n + 1]
    top, highest, finish = -np.inf, -np.inf, last
    for t in range(last, stop):
        prior = log_p[n_merges[t]] if counted else 0.0
        highest = max(highest, prior)
        if best[t] + prior > top:
            top, finish = best[t] + prior, t
    ends = np.ones(stop - last)
    for t in range(last, stop):
        ends[t - last] = math.exp(log_p[n_merges[t]] - highest) if counted else 1.0
    if not _add_path_shares(layer[: n + 2], origin, target, used, _factors(n, mask, weight), ends, share):
        return False
    while step[finish] >= 0:
        e = step[finish]
        if used[e] >= 0:
            chosen[used[e]] = True
        finish = origin[e]
    return True


@part
def _factors(n: int, mask: NDArray[np.uint64], weight: FloatArray) -> FloatArray:
    """(k,) exp(ln w − Σ of a bound for each record), at most 1, so that no sum overflows.

    Every partition has every record once, so the bounds change the weights of all partitions by the same factor.
    """
    one = np.uint64(1)
    most, total = np.full(n, -np.inf), np.zeros(len(mask))
    for pass_number in range(2):
        for k in range(len(mask)):
            size = 0
            for r in range(n):
                size += (mask[k] >> np.uint64(r)) & one == one
            for r in range(n):
                if (mask[k] >> np.uint64(r)) & one == one:
                    if pass_number == 0:
                        most[r] = max(most[r], weight[k] / size)
                    else:
                        total[k] += most[r]
    for k in range(len(mask)):
        total[k] = math.exp(weight[k] - total[k])
    return total


@part
def _add_path_shares(
    layer: IntArray, origin: Int32Array, target: Int32Array, used: Int32Array, factor: FloatArray, ends: FloatArray,
    share: FloatArray,
) -> bool:  # fmt: skip
    """Add to ``share`` of every set the share of all paths, from the first state to the last ones, that use it.

    The sums of each layer are divided by their largest. A path has one step between consecutive layers, so the shares
    of a layer's steps do not depend on the scale. False if all paths underflow.
    """
    n, size = len(layer) - 2, layer[-1]
    forward, backward = np.zeros(size), np.zeros(size)
    forward[0] = 1.0
    for t in range(layer[n], size):
        backward[t] = ends[t - layer[n]]
    cuts, at = np.empty(n + 1, np.int64), 0  # first step of each layer
    for r in range(n + 1):
        while at < len(origin) and origin[at] < layer[r]:
            at += 1
        cuts[r] = at
    for r in range(n):
        for e in range(cuts[r], cuts[r + 1]):
            forward[target[e]] += forward[origin[e]] * (factor[used[e]] if used[e] >= 0 else 1.0)
        if not _normalize(forward[layer[r + 1] : layer[r + 2]]):
            return False
    for r in range(n - 1, -1, -1):
        total = 0.0
        for e in range(cuts[r], cuts[r + 1]):
            ahead = backward[target[e]] * (factor[used[e]] if used[e] >= 0 else 1.0)
            backward[origin[e]] += ahead
            total += forward[origin[e]] * ahead
        if not total > 0.0:
            return False
        for e in range(cuts[r], cuts[r + 1]):
            if used[e] >= 0:
                share[used[e]] += forward[origin[e]] * factor[used[e]] * backward[target[e]] / total
        if not _normalize(backward[layer[r] : layer[r + 1]]):
            return False
    return True


@part
def _normalize(values: FloatArray) -> bool:
    """Divide the values by the largest; returns whether that is above 0."""
    most = 0.0
    for value in values:
        most = max(most, value)
    for k in range(len(values)):
        values[k] /= most
    return most > 0.0


@part
def _steps(
    n: int, first: IntArray, mask: NDArray[np.uint64], merges: IntArray, counted: bool, cap: int
) -> tuple[Int32Array | IntArray | NDArray[np.uint64], ...]:
    """States (records taken, number of merges), the layers' starts, and the steps between states (origin, target, set
    used); empty arrays if there are more than about ``cap`` steps."""
    limit, layer = FIRST_CAPACITY, np.zeros(n + 2, np.int64)
    while limit < cap:
        limit *= 2
    width = 64 if counted else _width(first, mask)
    capacity = FIRST_CAPACITY
    # Growing arrays within the loops would cost more than the loops: if they are too small, the loops start again.
    while True:
        key, n_merges = np.empty(capacity + 1, np.uint64), np.empty(capacity + 1, np.int64)
        origin, target, used = np.empty(capacity, np.int32), np.empty(capacity, np.int32), np.empty(capacity, np.int32)
        steps = _fill_steps(n, first, mask, merges, counted, width, key, n_merges, layer, origin, target, used)
        if steps >= 0:
            return key[: layer[n + 1]], n_merges[: layer[n + 1]], layer, origin[:steps], target[:steps], used[:steps]
        if capacity == limit:
            return key[:0], n_merges[:0], layer[:0], origin[:0], target[:0], used[:0]
        capacity = min(4 * capacity, limit)


@part
def _fill_steps(
    n: int, first: IntArray, mask: NDArray[np.uint64], merges: IntArray, counted: bool, width: int,
    key: NDArray[np.uint64], n_merges: IntArray, layer: IntArray, origin: Int32Array, target: Int32Array,
    used: Int32Array,
) -> int:  # fmt: skip
    """Write the states and steps; returns the number of steps, −1 if they exceed the arrays.

    width : of :func:`_width`. If small, the bits of a state's records after r are its slot; else slots are hashed.
    """
    one, capacity = np.uint64(1), len(origin)
    direct = width < 63 and (1 << width) <= 4 * capacity
    slots, slot_of = np.full(1 << width if direct else 2 * capacity, NONE, np.int32), np.empty(capacity + 1, np.int64)
    options = np.empty(len(first) + 1, np.int64)
    key[0], n_merges[0], layer[0], layer[1] = 0, 0, 0, 1
    size, steps, low = 1, 0, 0
    for r in range(n):
        high = low
        while high < len(first) and first[high] == r:
            high += 1
        bit, after = one << np.uint64(r), np.uint64(r + 1)
        for s in range(layer[r], layer[r + 1]):
            state, n_options = key[s], 0
            taken = (state & bit) != np.uint64(0)
            if taken:
                options[0], n_options = NONE, 1
            else:
                # Without a branch, which would be mispredicted most of the time.
                for k in range(low, high):
                    options[n_options] = k
                    n_options += np.int64((mask[k] & state) == np.uint64(0))
            if steps + n_options > capacity:
                return -1
            for at in range(n_options):
                k = options[at]
                new = state & ~bit if taken else (state | mask[k]) & ~bit
                count = n_merges[s] if taken or not counted else n_merges[s] + merges[k]
                slot = np.int64(new >> after) if direct else _slot(slots, key, n_merges, new, count)
                if slots[slot] == NONE:
                    slots[slot], key[size], n_merges[size], slot_of[size] = size, new, count, slot
                    size += 1
                origin[steps], target[steps], used[steps] = s, slots[slot], k
                steps += 1
        for s in range(layer[r + 1], size):
            slots[slot_of[s]] = NONE
        layer[r + 2] = size
        low = high
    return steps


@part
def _width(first: IntArray, mask: NDArray[np.uint64]) -> int:
    """Number of bits after a set's first record that any set uses: the span of a state."""
    width = 0
    for k in range(len(first)):
        while mask[k] >> np.uint64(first[k] + 1) >> np.uint64(width) != np.uint64(0):
            width += 1
    return width


@part
def _best_paths(
    size: int, origin: Int32Array, target: Int32Array, used: Int32Array, weight: FloatArray
) -> tuple[FloatArray, IntArray]:
    """Largest weight of a path to each state, and the last step of that path."""
    best, step = np.full(size, -np.inf), np.full(size, NONE, np.int64)
    best[0] = 0.0
    for e in range(len(origin)):
        gain = best[origin[e]] + (weight[used[e]] if used[e] >= 0 else 0.0)
        if gain > best[target[e]]:
            best[target[e]], step[target[e]] = gain, e
    return best, step


@part
def _slot(slots: Int32Array, key: NDArray[np.uint64], n_merges: IntArray, new: int, count: int) -> int:
    """The slot of a state in the hash table, or the empty slot where it belongs."""
    last = np.uint64(len(slots) - 1)
    # 32-bit halves are multiplied, so that nothing overflows, which would warn when interpreted.
    low = (new & np.uint64(0xFFFFFFFF)) * np.uint64(0x9E3779B1)
    high = ((new >> np.uint64(32)) ^ np.uint64(count)) * np.uint64(0x85EBCA6B)
    mixed = low ^ high
    slot = np.int64((mixed ^ (mixed >> np.uint64(29)) ^ (mixed >> np.uint64(17))) & last)
    while slots[slot] != NONE and (key[slots[slot]] != new or n_merges[slots[slot]] != count):
        slot = (slot + 1) & np.int64(last)
    return slot


# Groups whose sets are pruned by duals, and summed block by block.


def _sums_of_pruned(groups: IntArray, start: IntArray, *rest: Any) -> float:
    """Work: measured on groups of 17 to 250 sets."""
    return float(np.sum(np.diff(start)[groups] ** 2.5))


@small_by(_sums_of_pruned)
def sum_pruned(
    groups: IntArray, start: IntArray, members: IntArray, weight: FloatArray, small: int, cuts: FloatArray,
    max_records: int, cap: int, dual: FloatArray, share: FloatArray, chosen: BoolArray, cut: FloatArray,
) -> None:  # fmt: skip
    """Write every set's probability to ``share``, the best partition to ``chosen``, and each group's ``cut``.

    groups : numbers of the groups to sum. start : (g+1,) sets of each group. members : (k, S) records of the sets, −1
    for none; a single record is a set of weight 0.

    In groups of more than ``small`` records, sets are excluded if every partition with them is at least e^c times less
    probable than the best. Duals u of the records with Σ u ≥ ln w for every set give the bound: a partition with a set
    weighs at most Σ u of all records minus the set's reduced cost Σ u − ln w. ``dual`` (n,) are such duals; they are
    lowered coordinate by coordinate, and annealed if that is not enough. Excluding sets splits the group into blocks,
    and a block's own duals are tighter. c is the first of ``cuts`` at which a block has at most ``max_records``
    records and its sum at most ``cap`` steps between states. ``cut`` is the lowest c of a group's blocks, or −1 if a
    block has none; only the other blocks are written then. Blocks of c below :data:`MIN_CUT` have the best partition
    of that sum, and probabilities from samples of their partitions.
    """
    local = np.full(len(dual), NONE)
    for g in groups:
        a, b = start[g], start[g + 1]
        cut[g] = _sum_pruned_group(
            members[a:b], weight[a:b], local, small, cuts, max_records, cap, dual, share[a:b], chosen[a:b]
        )


def _groups(groups: IntArray, *rest: Any) -> float:
    """Work: some 20 µs for each group."""
    return 20.0 * len(groups)


@small_by(_groups)
def sum_few(
    groups: IntArray, start: IntArray, members: IntArray, weight: FloatArray, n_records: int, share: FloatArray,
    chosen: BoolArray, solved: BoolArray,
) -> None:  # fmt: skip
    """:func:`sum_pruned` for groups of at most FEW_SETS sets, which most are; ``solved`` (g,) receives whether they
    have at most FEW_RECORDS records and one partition that is clearly the best, without which nothing is written."""
    local = np.full(n_records, NONE)
    mask, log_weight = np.empty(FEW_SETS, np.int64), np.empty(FEW_SETS)
    partition = np.empty((FEW_SETS, FEW_RECORDS), np.int64)
    for g in groups:
        a, b = start[g], start[g + 1]
        solved[g] = _sum_few(members[a:b], weight[a:b], local, mask, partition, log_weight, share[a:b], chosen[a:b])


@part
def _sum_few(
    members: IntArray, weight: FloatArray, local: IntArray, mask: IntArray, partition: IntArray,
    log_weight: FloatArray, share: FloatArray, chosen: BoolArray,
) -> bool:  # fmt: skip
    """Sum a group over all its partitions, if it has at most FEW_RECORDS records and one partition is clearly the best;
    returns whether that is so. Most groups have three records at most, and setting up the elimination takes ten times
    as long.

    local : −1 for all records, restored. mask, partition, log_weight : scratch for each set's records as
    bits, each partition's sets and its ln weight.
    """
    n = 0
    for s in range(len(members)):
        mask[s] = 0
        for record in members[s]:
            if record != NONE:
                if local[record] == NONE:
                    local[record] = n
                    n += 1
                if local[record] < FEW_RECORDS:
                    mask[s] |= 1 << local[record]
    for s in range(len(members)):
        for record in members[s]:
            if record != NONE:
                local[record] = NONE
    if n > FEW_RECORDS:
        return False
    count, all_records, best, second_best = 0, (1 << n) - 1, -np.inf, -np.inf
    for first in range(len(members)):
        if not mask[first] & 1:
            continue
        remaining = all_records & ~mask[first]
        # The second set contains the lowest remaining record, and the third all remaining ones.
        for second in range(len(members) if remaining else 1):
            if remaining and (mask[second] & ~remaining or not mask[second] & (remaining & -remaining)):
                continue
            third_records = remaining & ~mask[second] if remaining else 0
            for third in range(len(members) if third_records else 1):
                if third_records and mask[third] != third_records:
                    continue
                partition[count, 0] = first
                partition[count, 1] = second if remaining else NONE
                partition[count, 2] = third if third_records else NONE
                value = weight[first]
                value += weight[second] if remaining else 0.0
                value += weight[third] if third_records else 0.0
                log_weight[count] = value
                best, second_best = max(best, value), max(second_best, min(best, value))
                count += 1
    if not best - second_best > CLEAR_NATS:
        return False
    normalizer = 0.0
    for c in range(count):
        normalizer += math.exp(log_weight[c] - best)
    for c in range(count):
        for at in range(FEW_RECORDS):
            if partition[c, at] != NONE:
                share[partition[c, at]] += math.exp(log_weight[c] - best) / normalizer
                chosen[partition[c, at]] = chosen[partition[c, at]] or log_weight[c] == best
    return True


@inlined
def _sum_pruned_group(
    members: IntArray, weight: FloatArray, local: IntArray, small: int, cuts: FloatArray, max_records: int, cap: int,
    dual: FloatArray, share: FloatArray, chosen: BoolArray,
) -> float:  # fmt: skip
    """Sum one group of :func:`sum_pruned`; returns its cut."""
    k = len(members)
    begin, entry, n = local_numbers(members, local)
    own_dual, source = np.empty(n), np.empty(n, np.int64)
    for s in range(k):
        for column, record in enumerate(members[s]):
            if record != NONE and local[record] != NONE:
                own_dual[local[record]], source[local[record]] = dual[record], column
                local[record] = NONE
    block, done = np.zeros(n, np.int64), np.zeros(n, np.bool_)
    sets = KeptSets(begin, entry, weight, np.arange(k), np.zeros(k, np.bool_))
    if n <= small:
        blocks_of(begin, entry, block)
        if _sum_blocks(sets, block, done, max_records, cap, share, chosen):
            return cuts[0]
    sets = prune(sets, cuts[0], block, done, own_dual)
    if _sum_blocks(sets, block, done, max_records, cap, share, chosen):
        return cuts[0]
    # Blocks share no sets, so only those that are not summed yet need better duals.
    sets = not_done(sets, done)
    for sweeps in ANNEALINGS:
        # Each attempt starts from the sets of the first cut.
        hint = anneal(sets.begin, sets.entry, sets.weight, sweeps, own_dual)
        pruned = KeptSets(sets.begin, sets.entry, sets.weight, sets.in_group, hint)
        inexact, is_inexact = np.zeros(n, np.bool_), False
        for cut in cuts:
            if cut < MIN_CUT and not is_inexact:
                is_inexact = True
                for r in range(n):
                    inexact[r] = not done[r]
            pruned = prune(pruned, cut, block, done, own_dual)
            if _sum_blocks(pruned, block, done, max_records, cap, share, chosen):
                if cut < MIN_CUT:
                    _sample_shares(sets, inexact, source, chosen, share)
                return cut
    return -1.0


@inlined
def _sample_shares(sets: KeptSets, records: BoolArray, source: IntArray, chosen: BoolArray, share: FloatArray) -> None:
    """Write ``share`` by samples, of the sets that consist of some ``records`` (n,) only. source : (n,) of records.
    chosen : sets of the best partition of the group."""
    kept = np.ones(len(sets.weight), np.bool_)
    for s in range(len(kept)):
        for e in range(sets.begin[s], sets.begin[s + 1]):
            kept[s] = kept[s] and records[sets.entry[e]]
    some = selected(sets, kept)
    p = sampled(some.begin, some.entry, source, some.weight, chosen[some.in_group])
    for s in range(len(p)):
        share[some.in_group[s]] = p[s]


@kernel
def set_samples(groups: IntArray, start: IntArray, members: IntArray, weight: FloatArray, chosen: BoolArray, n: int,
                share: FloatArray) -> None:  # fmt: skip
    """Write every set's probability by samples to ``share``, for some ``groups``. start : (g+1,) sets of each group.
    members : (k, S) sets, −1 for none, of n records in all. chosen : (k,) the sets of a partition of each group."""
    local, source = np.full(n, NONE), np.empty(n, np.int64)
    for g in groups:
        a, b = start[g], start[g + 1]
        begin, entry, number = local_numbers(members[a:b], local)
        for s in range(a, b):
            for column, record in enumerate(members[s]):
                if record != NONE:
                    source[local[record]] = column
        share[a:b] = sampled(begin, entry, source[:number], weight[a:b], chosen[a:b])


@part
def _sum_blocks(
    kept: KeptSets, block: IntArray, done: BoolArray, max_records: int, cap: int, share: FloatArray, chosen: BoolArray
) -> bool:
    """Sum the blocks of records that the sets connect and that are not ``done`` (n,); returns whether all are now."""
    begin, entry, in_group = kept.begin, kept.entry, kept.in_group
    n, k = len(block), len(in_group)
    first_set, records = np.zeros(n + 1, np.int64), np.zeros(n, np.int64)
    for s in range(k):
        first_set[block[entry[begin[s]]] + 1] += 1
    for r in range(n):
        records[block[r]] += 1
        first_set[r + 1] += first_set[r]
    fill, of_block = first_set[:-1].copy(), np.empty(k, np.int64)
    for s in range(k):
        b = block[entry[begin[s]]]
        of_block[fill[b]] = s
        fill[b] += 1
    number, n_sets, summed = np.full(n, NONE), np.zeros(n, np.int64), np.zeros(n, np.bool_)
    for b in range(n):
        sets = of_block[first_set[b] : first_set[b + 1]]
        if done[b] or len(sets) == 0:
            continue
        if len(sets) == 1:
            share[in_group[sets[0]]], chosen[in_group[sets[0]]], summed[b] = 1.0, True, True
        elif records[b] <= max_records:
            _order(begin, entry, sets, number, n_sets)
            summed[b] = _sum_block(kept, sets, number, records[b], cap, share, chosen)
    all_done = True
    for r in range(n):
        done[r] = done[r] or summed[block[r]]
        all_done = all_done and done[r]
    return all_done


@part
def _order(begin: IntArray, entry: IntArray, sets: IntArray, number: IntArray, n_sets: IntArray) -> None:
    """Number the records of a block breadth first from one with few sets (Cuthill–McKee), so that records which share
    sets have close numbers and states few records. number : −1 for these records. n_sets : (n,) zeros, restored."""
    total = 0
    for s in sets:
        for e in range(begin[s], begin[s + 1]):
            n_sets[entry[e]] += 1
            total += 1
    queue, seed = np.empty(total, np.int64), entry[begin[sets[0]]]
    for s in sets:
        for e in range(begin[s], begin[s + 1]):
            if n_sets[entry[e]] < n_sets[seed]:
                seed = entry[e]
    number[seed], queue[0], size = 0, seed, 1
    done, first_added = np.zeros(len(sets), np.bool_), 0
    for at in range(total):
        if at == size:
            break
        # The sets of the first record in the queue append their other records, those of few sets first.
        record, first_added = queue[at], size
        for k in range(len(sets)):
            if done[k]:
                continue
            inside = False
            for e in range(begin[sets[k]], begin[sets[k] + 1]):
                inside = inside or entry[e] == record
            if not inside:
                continue
            done[k] = True
            for e in range(begin[sets[k]], begin[sets[k] + 1]):
                if number[entry[e]] == NONE:
                    position = size
                    while position > first_added and n_sets[queue[position - 1]] > n_sets[entry[e]]:
                        queue[position] = queue[position - 1]
                        number[queue[position]] = position
                        position -= 1
                    queue[position], number[entry[e]] = entry[e], position
                    size += 1
    for at in range(size):
        n_sets[queue[at]] = 0


@inlined
def _sum_block(
    kept: KeptSets, sets: IntArray, number: IntArray, n: int, cap: int, share: FloatArray, chosen: BoolArray
) -> bool:
    """Sum a block of n records, numbered by ``number``, over the partitions into some ``sets`` of the kept ones."""
    begin, entry, weight, in_group, _ = kept
    low, mask = np.empty(len(sets), np.int64), np.zeros(len(sets), np.uint64)
    for at in range(len(sets)):
        low[at] = 1 << 30
        for e in range(begin[sets[at]], begin[sets[at] + 1]):
            low[at] = min(low[at], number[entry[e]])
            mask[at] |= np.uint64(1) << np.uint64(number[entry[e]])
    order = ascending(low.astype(np.float64))
    ordered_low, ordered_mask = np.empty(len(sets), np.int64), np.empty(len(sets), np.uint64)
    ordered_weight, merges = np.empty(len(sets)), np.zeros(len(sets), np.int64)
    for at in range(len(sets)):
        ordered_low[at], ordered_mask[at] = low[order[at]], mask[order[at]]
        ordered_weight[at] = weight[sets[order[at]]]
    part_share, part_chosen = np.zeros(len(sets)), np.zeros(len(sets), np.bool_)
    if not _sum_group(
        n, ordered_low, ordered_mask, ordered_weight, merges, np.zeros(1), False, cap, part_share, part_chosen
    ):
        return False
    for at in range(len(sets)):
        s = in_group[sets[order[at]]]
        share[s], chosen[s] = part_share[at], part_chosen[at]
    return True

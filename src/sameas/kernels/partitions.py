"""Compiled sums over the partitions of a group's records into sets, records eliminated one after another.

A state after r records says which later records are taken already, and how many merges were made where that counts.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import AnyIntArray, BoolArray, FloatArray, Int32Array, IntArray
from sameas.kernels.compiled import kernel, part

NONE = -1


@kernel
def eliminate(
    groups: IntArray,
    start: IntArray,
    first: IntArray,
    mask: NDArray[np.uint64],
    weight: FloatArray,
    merges: IntArray,
    table_start: IntArray,
    table: FloatArray,
    counted: bool,
    cap: int,
    share: FloatArray,
    chosen: BoolArray,
    solved: BoolArray,
) -> None:
    """Fill ``share`` with every set's probability, ``chosen`` with the best partition, ``solved`` per group.

    groups : the groups to do. start : (g+1,) sets of each group, ascending in ``first``, the number of the set's first
    record within the group; ``mask`` its records as bits. table[table_start[g] + m] : ln P of m merges.
    Groups that ask for more than ``cap`` steps from state to state are left unsolved.
    """
    for g in groups:
        a, b = start[g], start[g + 1]
        n = first[b - 1] + 1 if b > a else 0
        for k in range(a, b):
            top = 63
            while top > 0 and (mask[k] >> np.uint64(top)) & np.uint64(1) == np.uint64(0):
                top -= 1
            n = max(n, top + 1)
        log_p = table[table_start[g] : table_start[g + 1]]
        solved[g] = _group(
            n, first[a:b], mask[a:b], weight[a:b], merges[a:b], log_p, counted, cap, share[a:b], chosen[a:b]
        )


@part
def _group(
    n: int,
    first: IntArray,
    mask: NDArray[np.uint64],
    weight: FloatArray,
    merges: IntArray,
    log_p: FloatArray,
    counted: bool,
    cap: int,
    share: FloatArray,
    chosen: BoolArray,
) -> bool:
    key, made, layer, origin, target, used = _steps(n, first, mask, merges, counted, cap)
    if len(layer) == 0:
        return False
    best, step = _best(len(key), origin, target, used, weight)
    last, stop = layer[n], layer[n + 1]
    top, highest, finish = -np.inf, -np.inf, last
    for t in range(last, stop):
        prior = log_p[made[t]] if counted else 0.0
        highest = max(highest, prior)
        if best[t] + prior > top:
            top, finish = best[t] + prior, t
    ends = np.ones(stop - last)
    for t in range(last, stop):
        ends[t - last] = math.exp(log_p[made[t]] - highest) if counted else 1.0
    if not _summed(layer[: n + 2], origin, target, used, _factors(n, mask, weight), ends, share):
        return False
    while step[finish] >= 0:
        e = step[finish]
        if used[e] >= 0:
            chosen[used[e]] = True
        finish = origin[e]
    return True


@part
def _factors(n: int, mask: NDArray[np.uint64], weight: FloatArray) -> FloatArray:
    """Per set its weight, no logarithm, by what its records could add elsewhere: at most 1, so that no sum overflows.

    Every partition has every record once, so that what is taken off for the records is the same for all of them.
    """
    one = np.uint64(1)
    most, total = np.full(n, -np.inf), np.zeros(len(mask))
    for turn in range(2):
        for k in range(len(mask)):
            size = 0
            for r in range(n):
                size += (mask[k] >> np.uint64(r)) & one == one
            for r in range(n):
                if (mask[k] >> np.uint64(r)) & one == one:
                    if turn == 0:
                        most[r] = max(most[r], weight[k] / size)
                    else:
                        total[k] += most[r]
    return np.exp(weight - total)


@part
def _summed(
    layer: IntArray,
    origin: Int32Array,
    target: Int32Array,
    used: Int32Array,
    factor: FloatArray,
    ends: FloatArray,
    share: FloatArray,
) -> bool:
    """Add to ``share`` of every set the part of all ways, from the first state to the last ones, that use it.

    Every layer's sums are divided by their largest. Every way takes one step from each layer to the next, so that the
    parts of those steps are what they are by themselves. False where all ways are too improbable for a number.
    """
    n, size = len(layer) - 2, layer[-1]
    forward, backward = np.zeros(size), np.zeros(size)
    forward[0] = 1.0
    backward[layer[n] :] = ends
    cuts = np.searchsorted(origin, layer[: n + 1])
    for r in range(n):
        for e in range(cuts[r], cuts[r + 1]):
            forward[target[e]] += forward[origin[e]] * (factor[used[e]] if used[e] >= 0 else 1.0)
        if not _scaled(forward[layer[r + 1] : layer[r + 2]]):
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
        if not _scaled(backward[layer[r] : layer[r + 1]]):
            return False
    return True


@part
def _scaled(values: FloatArray) -> bool:
    """Divide by the largest; whether there is one above 0."""
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
    """States (records taken, merges made), the layers' starts, and the steps between them; no layers beyond ``cap``."""
    one = np.uint64(1)
    key, made = np.zeros(64, np.uint64), np.zeros(64, np.int64)
    origin, target, used = np.empty(256, np.int32), np.empty(256, np.int32), np.empty(256, np.int32)
    layer = np.zeros(n + 2, np.int64)
    layer[1] = 1
    size, steps, low = 1, 0, 0
    slots = np.full(256, NONE, np.int32)
    for r in range(n):
        high = low
        while high < len(first) and first[high] == r:
            high += 1
        bit = one << np.uint64(r)
        slots[:] = NONE
        for s in range(layer[r], layer[r + 1]):
            taken = (key[s] & bit) != np.uint64(0)
            for k in range(low - 1 if taken else low, low if taken else high):
                if not taken and (mask[k] & key[s]) != np.uint64(0):
                    continue
                new = key[s] & ~bit if taken else (key[s] | mask[k]) & ~bit
                count = made[s] if taken or not counted else made[s] + merges[k]
                if size == len(key):
                    key, made = _wider(key), _wider(made)
                if 2 * (size - layer[r + 1]) >= len(slots):
                    slots = _rehashed(slots, key, made, layer[r + 1], size)
                place = _slot(slots, key, made, new, count)
                if slots[place] == NONE:
                    slots[place] = size
                    key[size], made[size] = new, count
                    size += 1
                if steps == len(origin):
                    if steps >= cap:
                        return key[:0], made[:0], layer[:0], origin[:0], target[:0], used[:0]
                    origin, target, used = _wider(origin), _wider(target), _wider(used)
                origin[steps], target[steps], used[steps] = s, slots[place], NONE if taken else k
                steps += 1
        layer[r + 2] = size
        low = high
    return key[:size], made[:size], layer, origin[:steps], target[:steps], used[:steps]


@part
def _best(
    size: int, origin: Int32Array, target: Int32Array, used: Int32Array, weight: FloatArray
) -> tuple[FloatArray, IntArray]:
    """Per state the greatest weight of a way to it, and the last step of that."""
    best, step = np.full(size, -np.inf), np.full(size, NONE, np.int64)
    best[0] = 0.0
    for e in range(len(origin)):
        gain = best[origin[e]] + (weight[used[e]] if used[e] >= 0 else 0.0)
        if gain > best[target[e]]:
            best[target[e]], step[target[e]] = gain, e
    return best, step


@part
def _slot(slots: Int32Array, key: NDArray[np.uint64], made: IntArray, new: int, count: int) -> int:
    """Where the state stands among the slots, or the empty slot where it belongs."""
    last = np.uint64(len(slots) - 1)
    # Halves of 32 bits are multiplied, so that nothing overflows, interpreted neither.
    low = (new & np.uint64(0xFFFFFFFF)) * np.uint64(0x9E3779B1)
    high = ((new >> np.uint64(32)) ^ np.uint64(count)) * np.uint64(0x85EBCA6B)
    mixed = low ^ high
    place = np.int64((mixed ^ (mixed >> np.uint64(29)) ^ (mixed >> np.uint64(17))) & last)
    while slots[place] != NONE and (key[slots[place]] != new or made[slots[place]] != count):
        place = (place + 1) & np.int64(last)
    return place


@part
def _rehashed(slots: Int32Array, key: NDArray[np.uint64], made: IntArray, low: int, high: int) -> Int32Array:
    wider = np.full(4 * len(slots), NONE, np.int32)
    for s in range(low, high):
        wider[_slot(wider, key, made, key[s], made[s])] = s
    return wider


@part
def _wider(values: AnyIntArray) -> AnyIntArray:
    out = np.zeros(2 * len(values), values.dtype)
    out[: len(values)] = values
    return out

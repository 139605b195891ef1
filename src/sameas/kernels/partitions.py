"""Compiled sums over the partitions of a group's records into sets, records eliminated one after another.

A state after r records says which later records are taken already, and how many merges were made where that counts.
"""

from __future__ import annotations

import math

import numpy as np

from sameas.kernels.compiled import kernel, part

NONE = -1


@kernel
def eliminate(groups, start, first, mask, weight, merges, table_start, table, counted, cap, share, chosen, solved):
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
def _group(n, first, mask, weight, merges, log_p, counted, cap, share, chosen):
    key, made, layer, origin, target, used = _steps(n, first, mask, merges, counted, cap)
    if len(layer) == 0:
        return False
    forward, best, step = _forward(key, origin, target, used, weight)
    last, stop = layer[n], layer[n + 1]
    top, finish = -np.inf, last
    for t in range(last, stop):
        prior = log_p[made[t]] if counted else 0.0
        if best[t] + prior > top:
            top, finish = best[t] + prior, t
    backward = np.full(len(key), -np.inf)
    total = -np.inf
    for t in range(last, stop):
        backward[t] = log_p[made[t]] if counted else 0.0
        total = _add(total, forward[t] + backward[t])
    for e in range(len(origin) - 1, -1, -1):
        gain = weight[used[e]] if used[e] >= 0 else 0.0
        ahead = gain + backward[target[e]]
        backward[origin[e]] = _add(backward[origin[e]], ahead)
        if used[e] >= 0:
            share[used[e]] += math.exp(forward[origin[e]] + ahead - total)
    while step[finish] >= 0:
        e = step[finish]
        if used[e] >= 0:
            chosen[used[e]] = True
        finish = origin[e]
    return True


@part
def _steps(n, first, mask, merges, counted, cap):
    """States (records taken, merges made), the layers' starts, and the steps between them; no layers beyond ``cap``."""
    one = np.uint64(1)
    key, made = np.zeros(64, np.uint64), np.zeros(64, np.int64)
    origin, target, used = np.empty(256, np.int64), np.empty(256, np.int64), np.empty(256, np.int64)
    layer = np.zeros(n + 2, np.int64)
    layer[1] = 1
    size, steps, low = 1, 0, 0
    slots = np.full(256, NONE, np.int64)
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
                    key, made = _wider_states(key), _wider(made)
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
def _forward(key, origin, target, used, weight):
    """Per state ln of the sum of all ways to it, the best of them, and its last step."""
    forward, best = np.full(len(key), -np.inf), np.full(len(key), -np.inf)
    step = np.full(len(key), NONE, np.int64)
    forward[0] = best[0] = 0.0
    for e in range(len(origin)):
        gain = weight[used[e]] if used[e] >= 0 else 0.0
        s, t = origin[e], target[e]
        forward[t] = _add(forward[t], forward[s] + gain)
        if best[s] + gain > best[t]:
            best[t], step[t] = best[s] + gain, e
    return forward, best, step


@part
def _add(a, b):
    """ln(eᵃ + eᵇ)."""
    if a < b:
        a, b = b, a
    if b == -np.inf or a - b > 745.0:
        return a
    return a + math.log1p(math.exp(b - a))


@part
def _slot(slots, key, made, new, count):
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
def _rehashed(slots, key, made, low, high):
    wider = np.full(4 * len(slots), NONE, np.int64)
    for s in range(low, high):
        wider[_slot(wider, key, made, key[s], made[s])] = s
    return wider


@part
def _wider(values):
    out = np.zeros(2 * len(values), np.int64)
    out[: len(values)] = values
    return out


@part
def _wider_states(values):
    out = np.zeros(2 * len(values), np.uint64)
    out[: len(values)] = values
    return out

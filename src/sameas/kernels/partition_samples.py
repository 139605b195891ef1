"""Probabilities of the sets of a group by Markov chain Monte Carlo over its partitions, if an exact sum is too large.

A step proposes a partition that differs from the current one in two sets, and accepts it with probability
a = min(1, w(proposed) / w(current)) (Metropolis). There are three proposals, each as probable as its reverse:

- exchange: the sets of two records exchange their records of some other sources;
- divide: the set of two records is divided between them, or two sets are merged;
- replace: a set is replaced by another with a common record; records that only one of them has are single otherwise.

Each step counts the current partition with weight 1 − a and the proposed one with weight a, so that rarely visited
sets have small probabilities instead of 0.

Source: Metropolis et al. 1953; expected instead of sampled acceptance as in Frenkel 2004, PNAS 101, 17571.
"""

from __future__ import annotations

import math

import numpy as np

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.kernels.compiled import part

#: Steps per record of a group, minimum number of records for that product, and the share of burn-in steps, which are
#: not counted: the chain begins at the best partition.
STEPS, MIN_RECORDS, BURN_IN = 5_000, 100, 0.1
#: Multiplier and modulus of the random numbers, equal compiled and interpreted (Park, Miller and Stockmeyer 1993).
MULTIPLIER, MODULUS = 48271, 2147483647
NO_SET = -1


@part
def sampled(begin: IntArray, entry: IntArray, source: IntArray, weight: FloatArray, chosen: BoolArray) -> FloatArray:
    """(k,) probabilities of the sets of a group, with a standard error of some 0.01 for those near ½.

    begin, entry : (k + 1,) and (e,), the records of each set as CSR. source : (n,) of each record. weight : (k,) ln w.
    chosen : (k,) whether a set is in the initial partition.
    """
    k, n = len(weight), len(source)
    total, since_step, set_of = np.zeros(k), np.zeros(k, np.int64), np.full(n, NO_SET)
    code, key, table = _keys(begin, entry, n)
    member_begin, member_sets = _memberships(begin, entry, n)
    one = np.int64(1)
    sources = 0
    for r in range(n):
        sources = max(sources, source[r] + 1)
    for s in range(k):
        if chosen[s]:
            for e in range(begin[s], begin[s + 1]):
                set_of[entry[e]] = s
    in_sets, size = np.empty(n, np.int64), 0
    for r in range(n):
        if set_of[r] >= 0:
            in_sets[size] = r
            size += 1
    if size == 0:
        return total
    records = in_sets[:size]
    steps = STEPS * max(len(records), MIN_RECORDS)
    random, burn_in = 1 + 7919 * (n + k) % (MODULUS - 1), int(BURN_IN * steps)
    old, new = np.empty(sources + 1, np.int64), np.empty(sources + 1, np.int64)
    for step in range(steps):
        if step == burn_in:
            total[:], since_step[:] = 0.0, step
        random = random * MULTIPLIER % MODULUS
        proposal = random % 8
        random = random * MULTIPLIER % MODULUS
        n_old, n_new = 0, 0
        r = records[random % len(records)]
        random = random * MULTIPLIER % MODULUS
        t = member_sets[member_begin[r] + random % (member_begin[r + 1] - member_begin[r])]
        random = random * MULTIPLIER % MODULUS
        if proposal == 7:
            s = member_sets[member_begin[r] + random % (member_begin[r + 1] - member_begin[r])]
            if set_of[r] == t:
                s, t = t, s
            if set_of[r] != s or s == t:
                continue
            # Records of t not in s must be single now, and records of s not in t become single: the move is reversible.
            old[0], new[0], n_old, n_new = s, t, 1, 1
            for e in range(begin[t], begin[t + 1]):
                single = set_of[entry[e]]
                if single != s:
                    alone = single >= 0 and begin[single + 1] - begin[single] == 1
                    old[n_old] = single if alone else NO_SET
                    n_old += 1
            for e in range(begin[s], begin[s + 1]):
                only_in_s = True
                for other in range(begin[t], begin[t + 1]):
                    only_in_s = only_in_s and entry[other] != entry[e]
                if only_in_s:
                    new[n_new] = _find_set(code[entry[e]], key, table)
                    n_new += 1
        else:
            q = entry[begin[t] + random % (begin[t + 1] - begin[t])]
            if proposal < 5:
                random = random * MULTIPLIER % MODULUS
                t = member_sets[member_begin[q] + random % (member_begin[q + 1] - member_begin[q])]
                random = random * MULTIPLIER % MODULUS
                q = entry[begin[t] + random % (begin[t + 1] - begin[t])]
            random = random * MULTIPLIER % MODULUS
            a, b, mask = set_of[r], set_of[q], random >> 8
            if r == q or b < 0:
                continue
            if proposal < 5:
                if a == b:
                    continue
                mask &= ~((one << source[r]) | (one << source[q]))
                moved = _part_key(a, mask, begin, entry, source, code) ^ _part_key(b, mask, begin, entry, source, code)
                if moved == 0:
                    continue
                old[0], old[1], n_old = a, b, 2
                new[0], new[1], n_new = _find_set(key[a] ^ moved, key, table), _find_set(key[b] ^ moved, key, table), 2
            else:
                if source[r] == source[q]:
                    continue
                mask = (mask | (one << source[r])) & ~(one << source[q])
                part_a = _part_key(a, mask, begin, entry, source, code)
                if a == b:
                    old[0], n_old = a, 1
                    new[0], new[1], n_new = _find_set(part_a, key, table), _find_set(key[a] ^ part_a, key, table), 2
                else:
                    # Only merges that the division by the same sources reverses.
                    if part_a != key[a] or _part_key(b, mask, begin, entry, source, code) != 0:
                        continue
                    old[0], old[1], n_old = a, b, 2
                    new[0], n_new = _find_set(key[a] ^ key[b], key, table), 1
        log_ratio, possible = 0.0, True
        for at in range(n_old):
            possible = possible and old[at] >= 0
            log_ratio -= weight[old[at]]
        for at in range(n_new):
            possible = possible and new[at] >= 0
            log_ratio += weight[new[at]]
        if not possible:
            continue
        accepted = 1.0 if log_ratio >= 0.0 else math.exp(log_ratio)
        for at in range(n_old):
            total[old[at]] -= accepted
        for at in range(n_new):
            total[new[at]] += accepted
        random = random * MULTIPLIER % MODULUS
        if random < accepted * MODULUS:
            for at in range(n_old):
                total[old[at]] += step + 1 - since_step[old[at]]
            for at in range(n_new):
                s = new[at]
                since_step[s] = step + 1
                for e in range(begin[s], begin[s + 1]):
                    set_of[entry[e]] = s
    for r in records:
        s = set_of[r]
        if entry[begin[s]] == r:
            total[s] += steps - since_step[s]
    counted = float(steps - burn_in)
    for s in range(k):
        total[s] = min(max(total[s] / counted, 0.0), 1.0)
    return total


@part
def _keys(begin: IntArray, entry: IntArray, n: int) -> tuple[IntArray, IntArray, IntArray]:
    """Random keys of the records, keys of the sets (exclusive or of their records' keys), and a hash table of the sets
    by key, −1 where empty."""
    code, key, random = np.empty(n, np.int64), np.zeros(len(begin) - 1, np.int64), 20231
    for r in range(n):
        random = random * MULTIPLIER % MODULUS
        high = random
        random = random * MULTIPLIER % MODULUS
        code[r] = (high << 31) ^ random
    size = 4
    while size < 2 * len(key):
        size *= 2
    table = np.full(size, NO_SET)
    for s in range(len(key)):
        for e in range(begin[s], begin[s + 1]):
            key[s] ^= code[entry[e]]
        at = (key[s] >> 20) & (size - 1)
        while table[at] != NO_SET:
            at = (at + 1) & (size - 1)
        table[at] = s
    return code, key, table


@part
def _find_set(wanted: int, key: IntArray, table: IntArray) -> int:
    """The set with a key; −1 if there is none."""
    at = (wanted >> 20) & (len(table) - 1)
    while table[at] != NO_SET and key[table[at]] != wanted:
        at = (at + 1) & (len(table) - 1)
    return table[at]


@part
def _part_key(s: int, mask: int, begin: IntArray, entry: IntArray, source: IntArray, code: IntArray) -> int:
    """The key of the records of a set whose sources are in the mask; 0 if there are none."""
    out = np.int64(0)
    for e in range(begin[s], begin[s + 1]):
        if (mask >> source[entry[e]]) & 1:
            out ^= code[entry[e]]
    return out


@part
def _memberships(begin: IntArray, entry: IntArray, n: int) -> tuple[IntArray, IntArray]:
    """The sets of each record, as CSR."""
    member_begin = np.zeros(n + 1, np.int64)
    for record in entry[: begin[-1]]:
        member_begin[record + 1] += 1
    for r in range(n):
        member_begin[r + 1] += member_begin[r]
    fill, member_sets = member_begin[:-1].copy(), np.empty(member_begin[n], np.int64)
    for s in range(len(begin) - 1):
        for e in range(begin[s], begin[s + 1]):
            member_sets[fill[entry[e]]] = s
            fill[entry[e]] += 1
    return member_begin, member_sets

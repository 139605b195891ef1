"""Probabilities of the sets of a group by a Markov chain over its partitions, for groups too entangled for a sum.

One step proposes another partition that differs from the present one in two sets, and accepts it with probability
a = min(1, w(proposed) / w(present)) (Metropolis). There are three proposals, each as probable as its reverse:

- exchange: the sets of two records exchange their records of some other sources;
- divide: the set of two records is divided between them, or two sets become one;
- replace: of two sets with a common record one takes the place of the other; what only one has is single meanwhile.

A step counts the present partition with weight 1 − a and the proposed one with a, so that sets that the chain hardly
visits have small probabilities instead of 0.

Source: Metropolis et al. 1953; expected instead of sampled acceptance as in Frenkel 2004, PNAS 101, 17571.
"""

from __future__ import annotations

import math

import numpy as np

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.kernels.compiled import part

#: Steps per record of a group, as many as for this many records at least, and the share of them that is not counted,
#: since the chain begins at the best partition.
STEPS, LEAST_RECORDS, UNCOUNTED = 5_000, 100, 0.1
#: Multiplier and modulus of the random numbers: the same compiled and interpreted (Park, Miller and Stockmeyer 1993).
MULTIPLIER, MODULUS = 48271, 2147483647
NO_SET = -1


@part
def sampled(begin: IntArray, entry: IntArray, source: IntArray, weight: FloatArray, chosen: BoolArray) -> FloatArray:
    """(k,) probabilities of the sets of a group. Where they are near ½ their standard error is some 0.01.

    begin, entry : (k + 1,), records of each set. source : (n,) of each record. weight : (k,) ln w. chosen : (k,) the
    sets of one partition.
    """
    k, n = len(weight), len(source)
    share, since, of = np.zeros(k), np.zeros(k, np.int64), np.full(n, NO_SET)
    code, key, table = _keys(begin, entry, n)
    own, sets = _memberships(begin, entry, n)
    one = np.int64(1)
    sources = int(source.max()) + 1 if n else 0
    for s in range(k):
        if chosen[s]:
            for e in range(begin[s], begin[s + 1]):
                of[entry[e]] = s
    present = np.flatnonzero(of >= 0)
    if len(present) == 0:
        return share
    steps = STEPS * max(len(present), LEAST_RECORDS)
    random, uncounted = 1 + 7919 * (n + k) % (MODULUS - 1), int(UNCOUNTED * steps)
    old, new = np.empty(sources + 1, np.int64), np.empty(sources + 1, np.int64)
    for step in range(steps):
        if step == uncounted:
            share[:], since[:] = 0.0, step
        random = random * MULTIPLIER % MODULUS
        kind = random % 8
        random = random * MULTIPLIER % MODULUS
        olds, news = 0, 0
        r = present[random % len(present)]
        random = random * MULTIPLIER % MODULUS
        t = sets[own[r] + random % (own[r + 1] - own[r])]
        random = random * MULTIPLIER % MODULUS
        if kind == 7:
            s = sets[own[r] + random % (own[r + 1] - own[r])]
            if of[r] == t:
                s, t = t, s
            if of[r] != s or s == t:
                continue
            # What t has beside s is single now, and what s has beside t becomes so: the same the other way round.
            old[0], new[0], olds, news = s, t, 1, 1
            for e in range(begin[t], begin[t + 1]):
                single = of[entry[e]]
                if single != s:
                    alone = single >= 0 and begin[single + 1] - begin[single] == 1
                    old[olds] = single if alone else NO_SET
                    olds += 1
            for e in range(begin[s], begin[s + 1]):
                left = True
                for other in range(begin[t], begin[t + 1]):
                    left = left and entry[other] != entry[e]
                if left:
                    new[news] = _set_of(code[entry[e]], key, table)
                    news += 1
        else:
            q = entry[begin[t] + random % (begin[t + 1] - begin[t])]
            if kind < 5:
                random = random * MULTIPLIER % MODULUS
                t = sets[own[q] + random % (own[q + 1] - own[q])]
                random = random * MULTIPLIER % MODULUS
                q = entry[begin[t] + random % (begin[t + 1] - begin[t])]
            random = random * MULTIPLIER % MODULUS
            a, b, mask = of[r], of[q], random >> 8
            if r == q or b < 0:
                continue
            if kind < 5:
                if a == b:
                    continue
                mask &= ~((one << source[r]) | (one << source[q]))
                moved = _part_key(a, mask, begin, entry, source, code) ^ _part_key(b, mask, begin, entry, source, code)
                if moved == 0:
                    continue
                old[0], old[1], olds = a, b, 2
                new[0], new[1], news = _set_of(key[a] ^ moved, key, table), _set_of(key[b] ^ moved, key, table), 2
            else:
                if source[r] == source[q]:
                    continue
                mask = (mask | (one << source[r])) & ~(one << source[q])
                part_a = _part_key(a, mask, begin, entry, source, code)
                if a == b:
                    old[0], olds = a, 1
                    new[0], new[1], news = _set_of(part_a, key, table), _set_of(key[a] ^ part_a, key, table), 2
                else:
                    # Only what dividing by the same sources would give back.
                    if part_a != key[a] or _part_key(b, mask, begin, entry, source, code) != 0:
                        continue
                    old[0], old[1], olds = a, b, 2
                    new[0], news = _set_of(key[a] ^ key[b], key, table), 1
        gain, possible = 0.0, True
        for at in range(olds):
            possible = possible and old[at] >= 0
            gain -= weight[old[at]]
        for at in range(news):
            possible = possible and new[at] >= 0
            gain += weight[new[at]]
        if not possible:
            continue
        accepted = 1.0 if gain >= 0.0 else math.exp(gain)
        for at in range(olds):
            share[old[at]] -= accepted
        for at in range(news):
            share[new[at]] += accepted
        random = random * MULTIPLIER % MODULUS
        if random < accepted * MODULUS:
            for at in range(olds):
                share[old[at]] += step + 1 - since[old[at]]
            for at in range(news):
                s = new[at]
                since[s] = step + 1
                for e in range(begin[s], begin[s + 1]):
                    of[entry[e]] = s
    for r in present:
        s = of[r]
        if entry[begin[s]] == r:
            share[s] += steps - since[s]
    counted = float(steps - uncounted)
    for s in range(k):
        share[s] = min(max(share[s] / counted, 0.0), 1.0)
    return share


@part
def _keys(begin: IntArray, entry: IntArray, n: int) -> tuple[IntArray, IntArray, IntArray]:
    """Random numbers of the records, those of the sets (the exclusive or of their records'), and a hash table of these,
    −1 where it is empty."""
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
def _set_of(sought: int, key: IntArray, table: IntArray) -> int:
    """The set of a key, −1 for none."""
    at = (sought >> 20) & (len(table) - 1)
    while table[at] != NO_SET and key[table[at]] != sought:
        at = (at + 1) & (len(table) - 1)
    return table[at]


@part
def _part_key(s: int, mask: int, begin: IntArray, entry: IntArray, source: IntArray, code: IntArray) -> int:
    """The key of a set's records of the sources in the mask, 0 for none."""
    out = np.int64(0)
    for e in range(begin[s], begin[s + 1]):
        if (mask >> source[entry[e]]) & 1:
            out ^= code[entry[e]]
    return out


@part
def _memberships(begin: IntArray, entry: IntArray, n: int) -> tuple[IntArray, IntArray]:
    """The sets that each record is in, as CSR."""
    own = np.zeros(n + 1, np.int64)
    for record in entry[: begin[-1]]:
        own[record + 1] += 1
    for r in range(n):
        own[r + 1] += own[r]
    fill, sets = own[:-1].copy(), np.empty(own[n], np.int64)
    for s in range(len(begin) - 1):
        for e in range(begin[s], begin[s + 1]):
            sets[fill[entry[e]]] = s
            fill[entry[e]] += 1
    return own, sets

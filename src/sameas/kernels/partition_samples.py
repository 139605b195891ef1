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
from typing import NamedTuple

import numpy as np

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.kernels.compiled import part

#: Steps per record of a group, minimum number of records for that product, and the share of burn-in steps, which are
#: not counted: the chain begins at the best partition.
STEPS, MIN_RECORDS, BURN_IN = 5_000, 100, 0.1
#: Multiplier and modulus of the random numbers, equal compiled and interpreted (Park, Miller and Stockmeyer 1993).
MULTIPLIER, MODULUS = 48271, 2147483647
NO_SET = -1
#: With more sources, half of the exchanges and divisions are by one source alone.
FEW_SOURCES = 8


class KeyedSets(NamedTuple):
    """The sets of a group, the records of each and the sets of each record (both as CSR), and their keys.

    code : (n,) a random key of each record. key : (k,) of each set, the exclusive or of its records' keys. table : a
    hash table of the sets by key, ``NO_SET`` where empty. n_sources : number of sources.
    """

    begin: IntArray
    entry: IntArray
    source: IntArray
    code: IntArray
    key: IntArray
    table: IntArray
    n_sources: int
    member_begin: IntArray
    member_sets: IntArray


@part
def sampled(begin: IntArray, entry: IntArray, source: IntArray, weight: FloatArray, chosen: BoolArray) -> FloatArray:
    """(k,) probabilities of the sets of a group, with a standard error of some 0.01 for those near ½.

    begin, entry : (k + 1,) and (e,), the records of each set as CSR. source : (n,) of each record. weight : (k,) ln w.
    chosen : (k,) whether a set is in the initial partition.
    """
    k, n = len(weight), len(source)
    total, since_step = np.zeros(k), np.zeros(k, np.int64)
    code, key, table = _keys(begin, entry, n)
    member_begin, member_sets = memberships(begin, entry, n, np.ones(len(weight), np.bool_))
    n_sources = _number_of_sources(source)
    sets = KeyedSets(begin, entry, source, code, key, table, n_sources, member_begin, member_sets)
    set_of = _sets_of_records(chosen, sets)
    # A step replaces the sets of one record of each source at most, and one.
    records, old, new = _records_in_sets(set_of), np.empty(n_sources + 1, np.int64), np.empty(n_sources + 1, np.int64)
    if len(records) == 0:
        return total
    steps = STEPS * max(len(records), MIN_RECORDS)
    random, burn_in = 1 + 7919 * (n + k) % (MODULUS - 1), int(BURN_IN * steps)
    for step in range(steps):
        if step == burn_in:
            total[:], since_step[:] = 0.0, step
        random, n_old, n_new = _propose(random, records, set_of, sets, old, new)
        log_ratio, possible = 0.0, n_old > 0
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
def _propose(
    random: int, records: IntArray, set_of: IntArray, sets: KeyedSets, old: IntArray, new: IntArray
) -> tuple[int, int, int]:
    """Write the sets of the current partition that a proposal replaces to ``old``, and the sets that replace them to
    ``new``. Returns the random number and how many sets they are; 0 and 0 if the proposal changes nothing.

    A set that is needed but is not among the sets of the group is ``NO_SET``: such a partition is impossible.
    """
    random = random * MULTIPLIER % MODULUS
    proposal = random % 8
    random = random * MULTIPLIER % MODULUS
    r = records[random % len(records)]
    random = random * MULTIPLIER % MODULUS
    t = _member_set(r, random, sets)
    random = random * MULTIPLIER % MODULUS
    if proposal == 7:
        n_old, n_new = _replace(r, t, _member_set(r, random, sets), set_of, sets, old, new)
        return random, n_old, n_new
    q = sets.entry[sets.begin[t] + random % (sets.begin[t + 1] - sets.begin[t])]
    if proposal < 5:
        random = random * MULTIPLIER % MODULUS
        t = _member_set(q, random, sets)
        random = random * MULTIPLIER % MODULUS
        q = sets.entry[sets.begin[t] + random % (sets.begin[t + 1] - sets.begin[t])]
    random = random * MULTIPLIER % MODULUS
    mask = random >> 8
    if sets.n_sources > FEW_SOURCES:
        # A set of random ones is rarely the few whose records two objects may exchange.
        random = random * MULTIPLIER % MODULUS
        mask = np.int64(1) << (mask % sets.n_sources) if random % 2 == 0 else mask | (random >> 8) << 23
    if r == q or set_of[q] == NO_SET:
        return random, 0, 0
    if proposal < 5:
        n_old, n_new = _exchange(r, q, mask, set_of, sets, old, new)
    else:
        n_old, n_new = _divide(r, q, mask, set_of, sets, old, new)
    return random, n_old, n_new


@part
def _exchange(
    r: int, q: int, mask: int, set_of: IntArray, sets: KeyedSets, old: IntArray, new: IntArray
) -> tuple[int, int]:
    """The sets of records r and q exchange their records of the sources in the mask, except r and q."""
    one, a, b = np.int64(1), set_of[r], set_of[q]
    if a == b:
        return 0, 0
    mask &= ~((one << sets.source[r]) | (one << sets.source[q]))
    moved = _part_key(a, mask, sets) ^ _part_key(b, mask, sets)
    if moved == 0:
        return 0, 0
    old[0], old[1] = a, b
    new[0], new[1] = _find_set(sets.key[a] ^ moved, sets), _find_set(sets.key[b] ^ moved, sets)
    return 2, 2


@part
def _divide(
    r: int, q: int, mask: int, set_of: IntArray, sets: KeyedSets, old: IntArray, new: IntArray
) -> tuple[int, int]:
    """The set of records r and q is divided by the sources in the mask, or the sets of r and q are merged.

    Sets are merged only if a division by the same sources reverses it.
    """
    one, a, b = np.int64(1), set_of[r], set_of[q]
    if sets.source[r] == sets.source[q]:
        return 0, 0
    mask = (mask | (one << sets.source[r])) & ~(one << sets.source[q])
    part_a = _part_key(a, mask, sets)
    old[0], old[1] = a, b
    if a == b:
        new[0], new[1] = _find_set(part_a, sets), _find_set(sets.key[a] ^ part_a, sets)
        return 1, 2
    if part_a != sets.key[a] or _part_key(b, mask, sets) != 0:
        return 0, 0
    new[0] = _find_set(sets.key[a] ^ sets.key[b], sets)
    return 2, 1


@part
def _replace(
    r: int, t: int, s: int, set_of: IntArray, sets: KeyedSets, old: IntArray, new: IntArray
) -> tuple[int, int]:
    """Of two sets with record r, the current one is replaced by the other.

    The records that only the new one has must be single, and those that only the old one has become single, so that
    the reverse is a proposal too.
    """
    if set_of[r] == t:
        s, t = t, s
    if set_of[r] != s or s == t:
        return 0, 0
    begin, entry = sets.begin, sets.entry
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
            new[n_new] = _find_set(sets.code[entry[e]], sets)
            n_new += 1
    return n_old, n_new


@part
def _sets_of_records(chosen: BoolArray, sets: KeyedSets) -> IntArray:
    """(n,) the set of each record in a partition; ``NO_SET`` of a record that is in none."""
    set_of = np.full(len(sets.source), NO_SET)
    for s in range(len(chosen)):
        if chosen[s]:
            for e in range(sets.begin[s], sets.begin[s + 1]):
                set_of[sets.entry[e]] = s
    return set_of


@part
def _records_in_sets(set_of: IntArray) -> IntArray:
    """The records that are in a set."""
    records, size = np.empty(len(set_of), np.int64), 0
    for r in range(len(set_of)):
        if set_of[r] != NO_SET:
            records[size] = r
            size += 1
    return records[:size]


@part
def _number_of_sources(source: IntArray) -> int:
    sources = 0
    for s in source:
        sources = max(sources, s + 1)
    return sources


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
    for s in range(len(key)):
        for e in range(begin[s], begin[s + 1]):
            key[s] ^= code[entry[e]]
    return code, key, hash_table(key)


@part
def hash_table(key: IntArray) -> IntArray:
    """A hash table of sets by their keys (k,), ``NO_SET`` where empty."""
    size = 4
    while size < 2 * len(key):
        size *= 2
    table = np.full(size, NO_SET)
    for s in range(len(key)):
        at = (key[s] >> 20) & (size - 1)
        while table[at] != NO_SET:
            at = (at + 1) & (size - 1)
        table[at] = s
    return table


@part
def looked_up(wanted: int, table: IntArray, key: IntArray) -> int:
    """The set with a key in a hash table of the sets' keys (k,); ``NO_SET`` if there is none."""
    at = (wanted >> 20) & (len(table) - 1)
    while table[at] != NO_SET and key[table[at]] != wanted:
        at = (at + 1) & (len(table) - 1)
    return table[at]


@part
def _find_set(wanted: int, sets: KeyedSets) -> int:
    """The set with a key; ``NO_SET`` if there is none."""
    return looked_up(wanted, sets.table, sets.key)


@part
def _member_set(r: int, random: int, sets: KeyedSets) -> int:
    """One of the sets with record r, by a random number."""
    begin = sets.member_begin[r]
    return sets.member_sets[begin + random % (sets.member_begin[r + 1] - begin)]


@part
def _part_key(s: int, mask: int, sets: KeyedSets) -> int:
    """The key of the records of a set whose sources are in the mask; 0 if there are none."""
    out = np.int64(0)
    for e in range(sets.begin[s], sets.begin[s + 1]):
        if (mask >> sets.source[sets.entry[e]]) & 1:
            out ^= sets.code[sets.entry[e]]
    return out


@part
def memberships(begin: IntArray, entry: IntArray, n: int, kept: BoolArray) -> tuple[IntArray, IntArray]:
    """The kept sets, of (k,), of each of n records, as CSR."""
    start = np.zeros(n + 1, np.int64)
    for s in range(len(kept)):
        if kept[s]:
            for e in range(begin[s], begin[s + 1]):
                start[entry[e] + 1] += 1
    for r in range(n):
        start[r + 1] += start[r]
    fill, sets = start[:-1].copy(), np.empty(start[n], np.int64)
    for s in range(len(kept)):
        if kept[s]:
            for e in range(begin[s], begin[s + 1]):
                sets[fill[entry[e]]] = s
                fill[entry[e]] += 1
    return start, sets

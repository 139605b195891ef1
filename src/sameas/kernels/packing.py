"""A good partition of a group's records into sets, and the sets that no better one has, by duals of the records.

The linear relaxation of the packing, max Σ w x with Σ_{s∋r} x_s = 1 for every record r, has a dual u_r for each record.
A set's reduced cost Σ_{r∈s} u_r − w_s bounds what a partition with it loses: sets that lose more than a cut are
excluded.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.kernels.compiled import kernel, part
from sameas.kernels.components import root
from sameas.kernels.partition_samples import memberships

NONE = -1
#: Most sweeps over the duals of a group, most prunings of its sets, and most sweeps that exchange sets of a partition
#: (tuned on crowded pictures).
SWEEPS, PRUNINGS, EXCHANGES = 6, 8, 6
#: Temperatures at which duals are annealed, in nats; sweeps at each, in the first attempt and in the second.
TEMPERATURES = (1.0, 0.5, 0.25, 0.12, 0.06, 0.03, 0.015)
ANNEALINGS = (8, 40)
#: Sets with a smaller exponent at a temperature are excluded there.
MIN_EXPONENT = -20.0
#: Largest reduced cost, in nats, of sets that are tried for a good partition.
COMPETING = 10.0
#: Sweeps end when one lowers the duals by less than this in all, in nats; prunings, when one excludes less than this
#: share of the sets.
MIN_LOWERED_NATS, MIN_PRUNED_SHARE = 0.01, 0.02


class KeptSets(NamedTuple):
    """The sets of a group that are not excluded.

    begin, entry : (k + 1,) and (e,), the records of each set as CSR. weight : (k,) ln w. in_group : (k,) the number of
    each set in the group. hint : (k,) the sets of a good partition, if known.
    """

    begin: IntArray
    entry: IntArray
    weight: FloatArray
    in_group: IntArray
    hint: BoolArray


@part
def local_numbers(members: IntArray, local: IntArray) -> tuple[IntArray, IntArray, int]:
    """The sets of a group as CSR, begin (k + 1,) and entry, its records numbered by first appearance, and the number of
    records. members : (k, S) sets, −1 for none. local : −1 for all records; receives the numbers."""
    begin, entry = np.zeros(len(members) + 1, np.int64), np.empty(members.size, np.int64)
    at, n = 0, 0
    for s in range(len(members)):
        for record in members[s]:
            if record != NONE:
                if local[record] == NONE:
                    local[record] = n
                    n += 1
                entry[at] = local[record]
                at += 1
        begin[s + 1] = at
    return begin, entry[:at], n


@kernel
def pack(groups: IntArray, start: IntArray, members: IntArray, weight: FloatArray, n: int, chosen: BoolArray) -> None:
    """Replace ``chosen`` (k,), sets of a partition of each of the ``groups``, by a better one where one is found.

    start : (g+1,) sets of each group. members : (k, S) sets, −1 for none, of n records in all. Duals are annealed, and
    the sets of little reduced cost packed, from those of the relaxation and from the partition that is known.
    """
    local = np.full(n, NONE)
    for g in groups:
        a, b = start[g], start[g + 1]
        begin, entry, number = local_numbers(members[a:b], local)
        dual = np.zeros(number)
        for s in range(b - a):
            for e in range(begin[s], begin[s + 1]):
                dual[entry[e]] = max(dual[entry[e]], weight[a + s] / (begin[s + 1] - begin[s]))
        own = weight[a:b]
        relaxed = anneal(begin, entry, own, ANNEALINGS[-1], dual)
        cost = np.empty(b - a)
        for s in range(b - a):
            cost[s] = _cost(s, begin, entry, own, dual)
        known = chosen[a:b].copy()
        _greedy(begin, entry, own, cost, relaxed, number)
        _greedy(begin, entry, own, cost, known, number)
        value, best = 0.0, 0.0
        for s in range(b - a):
            value += own[s] if relaxed[s] else 0.0
            best += own[s] if known[s] else 0.0
        if value > best + 1e-9 * abs(best):
            known = relaxed
        taken = np.zeros(number, np.bool_)
        for s in range(b - a):
            chosen[a + s] = known[s]
            if known[s]:
                for e in range(begin[s], begin[s + 1]):
                    taken[entry[e]] = True
        for s in range(b - a):
            if begin[s + 1] - begin[s] == 1:
                chosen[a + s] = not taken[entry[begin[s]]]


@part
def anneal(begin: IntArray, entry: IntArray, weight: FloatArray, sweeps: int, dual: FloatArray) -> BoolArray:
    """Replace the duals by nearly those of the linear relaxation; returns the sets (k,) of x > ½.

    With an entropy T H(x) added, the relaxation max Σ w x, Σ_{s∋r} x_s = 1, is solved by x = exp((w − Σ u)/T) with the
    duals for which all sums are 1. They are found record by record (Sinkhorn's iteration) while T decreases. Finally
    they are raised until no set weighs more than its records' duals.
    """
    k, n = len(weight), len(dual)
    x = np.zeros(k)
    for temperature in TEMPERATURES:
        # Sets of negligible x at this temperature are skipped until the next one.
        for s in range(k):
            exponent = -_cost(s, begin, entry, weight, dual) / temperature
            x[s] = math.exp(min(exponent, 50.0)) if exponent > MIN_EXPONENT or begin[s + 1] - begin[s] == 1 else 0.0
        start, sets = memberships(begin, entry, n, x > 0.0)
        for sweep in range(sweeps):
            for step in range(n):
                r = step if sweep % 2 == 0 else n - 1 - step
                total = 0.0
                for at in range(start[r], start[r + 1]):
                    total += x[sets[at]]
                if total > 0.0:
                    share = 1.0 / total
                    for at in range(start[r], start[r + 1]):
                        x[sets[at]] *= share
                    dual[r] += temperature * math.log(total)
    deficit = np.zeros(n)
    for s in range(k):
        per_record = -_cost(s, begin, entry, weight, dual) / (begin[s + 1] - begin[s])
        for e in range(begin[s], begin[s + 1]):
            deficit[entry[e]] = max(deficit[entry[e]], per_record)
    dual += deficit
    return x > 0.5


@part
def blocks_of(begin: IntArray, entry: IntArray, block: IntArray) -> None:
    """Write to ``block`` (n,) the lowest record of the component of each record in the graph of sets."""
    for r in range(len(block)):
        block[r] = r
    for s in range(len(begin) - 1):
        for e in range(begin[s] + 1, begin[s + 1]):
            one, other = root(block, entry[begin[s]]), root(block, entry[e])
            block[max(one, other)] = min(one, other)
    for r in range(len(block)):
        block[r] = root(block, r)


@part
def prune(sets: KeptSets, cut: float, block: IntArray, done: BoolArray, dual: FloatArray) -> KeptSets:
    """The sets without those of finished blocks and those that the duals of their block prove improbable."""
    n = len(block)
    sets = not_done(sets, done)
    best_weight, bound = np.zeros(n), np.zeros(n)
    for iteration in range(PRUNINGS):
        begin, entry, weight, _, hint = sets
        k = len(weight)
        blocks_of(begin, entry, block)
        cost = np.empty(k)
        for s in range(k):
            cost[s] = _cost(s, begin, entry, weight, dual)
        _descend(*memberships(begin, entry, n, begin[1:] - begin[:-1] >= 2), cost, dual)
        if iteration == 0:
            _greedy(begin, entry, weight, cost, hint, n)
        best_weight[:], bound[:] = 0.0, 0.0
        for r in range(n):
            bound[block[r]] += dual[r]
        for s in range(k):
            if begin[s + 1] - begin[s] == 1:
                cost[s] = dual[entry[begin[s]]]
            elif hint[s]:
                best_weight[block[entry[begin[s]]]] += weight[s]
        kept, n_pruned = np.ones(k, np.bool_), 0
        for s in range(k):
            b = block[entry[begin[s]]]
            if cost[s] > cut + bound[b] - best_weight[b]:
                kept[s] = False
                n_pruned += 1
        sets = selected(sets, kept)
        if n_pruned <= MIN_PRUNED_SHARE * k:
            break
    blocks_of(sets.begin, sets.entry, block)
    return sets


@part
def selected(sets: KeptSets, kept: BoolArray) -> KeptSets:
    """The sets that are ``kept`` (k,)."""
    begin, entry, weight, in_group, hint = sets
    count = 0
    for s in range(len(kept)):
        count += kept[s]
    new_begin, new_entry = np.zeros(count + 1, np.int64), np.empty(len(entry), np.int64)
    new_weight, new_in_group, new_hint = np.empty(count), np.empty(count, np.int64), np.empty(count, np.bool_)
    k, at = 0, 0
    for s in range(len(kept)):
        if kept[s]:
            for e in range(begin[s], begin[s + 1]):
                new_entry[at] = entry[e]
                at += 1
            new_weight[k], new_in_group[k], new_hint[k] = weight[s], in_group[s], hint[s]
            k += 1
            new_begin[k] = at
    return KeptSets(new_begin, new_entry[:at], new_weight, new_in_group, new_hint)


@part
def not_done(sets: KeptSets, done: BoolArray) -> KeptSets:
    """The sets of records that are not ``done`` (n,)."""
    kept = np.ones(len(sets.weight), np.bool_)
    for s in range(len(kept)):
        kept[s] = not done[sets.entry[sets.begin[s]]]
    return selected(sets, kept)


@part
def ascending(key: FloatArray) -> IntArray:
    """Positions of the keys in ascending order, equal keys in the order given."""
    return np.argsort(key, kind="mergesort")


@part
def _cost(s: int, begin: IntArray, entry: IntArray, weight: FloatArray, dual: FloatArray) -> float:
    """The reduced cost of a set: Σ of its records' duals − ln w."""
    cost = -weight[s]
    for e in range(begin[s], begin[s + 1]):
        cost += dual[entry[e]]
    return cost


@part
def _descend(start: IntArray, sets: IntArray, cost: FloatArray, dual: FloatArray) -> None:
    """Lower the duals one by one, in alternating order, as far as the reduced costs of their sets stay nonnegative."""
    n = len(dual)
    for sweep in range(SWEEPS):
        lowered = 0.0
        for step in range(n):
            r = step if sweep % 2 == 0 else n - 1 - step
            if start[r] == start[r + 1]:
                continue
            most = dual[r]
            for at in range(start[r], start[r + 1]):
                most = min(most, cost[sets[at]])
            if most > 0.0:
                lowered += most
                dual[r] -= most
                for at in range(start[r], start[r + 1]):
                    cost[sets[at]] -= most
        if lowered < MIN_LOWERED_NATS:
            return


@part
def _greedy(begin: IntArray, entry: IntArray, weight: FloatArray, cost: FloatArray, hint: BoolArray, n: int) -> None:
    """Replace ``hint`` by a packing of sets of several of the n records: first the hinted sets and those of least
    reduced cost, then any set that weighs more than the sets that it replaces."""
    # No partition with a set of a larger reduced cost is near the best.
    several, rank, size = np.empty(len(weight), np.int64), np.empty(len(weight)), 0
    for s in range(len(weight)):
        if begin[s + 1] - begin[s] > 1 and weight[s] > 0.0 and (hint[s] or cost[s] <= COMPETING):
            several[size], rank[size] = s, -1.0 if hint[s] else cost[s] - 1e-6 * weight[s]
            size += 1
    owner, order = np.full(n, NONE), ascending(rank[:size])
    for at in range(size):
        order[at] = several[order[at]]
    for sweep in range(EXCHANGES):
        changed = False
        for s in order:
            if owner[entry[begin[s]]] == s:
                continue
            displaced = 0.0
            for e in range(begin[s], begin[s + 1]):
                other, repeated = owner[entry[e]], False
                for f in range(begin[s], e):
                    repeated = repeated or owner[entry[f]] == other
                if other != NONE and not repeated:
                    displaced += weight[other]
            if weight[s] > displaced + 1e-9 * abs(displaced) and (sweep > 0 or displaced == 0.0):
                for e in range(begin[s], begin[s + 1]):
                    other = owner[entry[e]]
                    if other != NONE:
                        for f in range(begin[other], begin[other + 1]):
                            owner[entry[f]] = NONE
                for e in range(begin[s], begin[s + 1]):
                    owner[entry[e]] = s
                changed = True
        if not changed:
            break
    hint[:] = False
    for s in order:
        hint[s] = owner[entry[begin[s]]] == s

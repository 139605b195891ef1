"""Compiled posterior probabilities of groups that can be summed exactly.

Weights are *reduced* by the duals of the best hypothesis, w − u − v ≤ 0: that hypothesis then weighs 1 and every
other one at most 1, so that nothing overflows and what underflows is truly negligible.
"""

from __future__ import annotations

import math

import numpy as np

from sameas.kernels.compiled import kernel, part
from sameas.kernels.eliminate import eliminate, scratch
from sameas.kernels.forest import core_of, fold, forest, unfold
from sameas.kernels.narrow import arranged, narrow, sum_narrow

CLOSED, ELIMINATED, LOCAL = 0, 1, 2
#: Reduced log weights below this are as good as impossible; priors this far above the best count are left out.
DEEPEST = 600.0
HIGHEST = 300.0


@part
def bounded_exp(x):
    """exp(x) for x ≤ 0, never quite zero."""
    return math.exp(max(x, -DEEPEST))


@part
def by_row(n1, n2, low, high, local1, local2, weight, u, v, flipped, start, column, pair, odds, none, unused):
    """The reduced problem of one group, its rows being source 1 or, ``flipped``, source 2."""
    n = n2 if flipped else n1
    nc = n1 if flipped else n2
    row_of = local2 if flipped else local1
    column_of = local1 if flipped else local2
    start[: n + 1] = 0
    for e in range(low, high):
        start[row_of[e] + 1] += 1
    for r in range(n):
        start[r + 1] += start[r]
    for e in range(low, high):
        r = row_of[e]
        at = start[r]
        column[at] = column_of[e]
        pair[at] = e
        odds[at] = math.exp(max(weight[e] - u[local1[e]] - v[local2[e]], -700.0))
        start[r] += 1
    for r in range(n, 0, -1):
        start[r] = start[r - 1]
    start[0] = 0
    for r in range(n1):
        (unused if flipped else none)[r] = bounded_exp(-u[r])
    for c in range(n2):
        (none if flipped else unused)[c] = bounded_exp(-v[c])
    return n, nc


@part
def star(low, high, weight, share):
    """Closed form where one record has all the pairs of the group: a softmax with the null."""
    top = 0.0
    for e in range(low, high):
        top = max(top, weight[e])
    total = math.exp(-top)
    for e in range(low, high):
        share[e] = math.exp(weight[e] - top)
        total += share[e]
    for e in range(low, high):
        share[e] /= total


@part
def count_factors(prior, slope, size):
    """exp(ln P(k) − μ (k − k₀)) relative to the best hypothesis' k₀ = ``size``; 0 where out of reach."""
    factors = np.zeros(len(prior))
    for k in range(len(prior)):
        x = prior[k] - prior[size] - slope * (k - size)
        if x < HIGHEST:
            factors[k] = math.exp(max(x, -700.0))
    return factors


@kernel
def exact(first, last, start, start1, start2, local1, local2, weight, u, v, most, share, method):
    """Posterior ``share`` (m,) of the pairs of the groups first … last − 1 under a linear prior, where it can be exact.

    method (g,) receives CLOSED, ELIMINATED or, with nothing filled in, LOCAL: where both sides have more than ``most``
    records, or too many are open at a time (:mod:`narrow`).
    """
    records, pairs = np.int64(2), np.int64(1)
    for g in range(first, last):
        n1, n2 = start1[g + 1] - start1[g], start2[g + 1] - start2[g]
        if 1 < min(n1, n2) <= most:
            records = max(records, n1 + n2)
            pairs = max(pairs, start[g + 1] - start[g])
    tree, graph = forest(records), narrow(records, pairs)
    odds, core_odds = np.empty(pairs), np.empty(pairs)
    record = np.empty(records, np.int64)
    loose, open_, taken = np.empty(records), np.empty(records), np.empty(records)
    for g in range(first, last):
        low, high = start[g], start[g + 1]
        n1, n2 = start1[g + 1] - start1[g], start2[g + 1] - start2[g]
        if n1 == 1 or n2 == 1:
            method[g] = CLOSED
            star(low, high, weight, share)
            continue
        method[g] = LOCAL
        if min(n1, n2) > most:
            continue
        for r in range(n1):
            tree.loose[r] = bounded_exp(-u[start1[g] + r])
        for c in range(n2):
            tree.loose[n1 + c] = bounded_exp(-v[start2[g] + c])
        one, two, of_pair = local1[low:high], local2[low:high], share[low:high]
        for e in range(low, high):
            odds[e - low] = math.exp(max(weight[e] - u[start1[g] + local1[e]] - v[start2[g] + local2[e]], -700.0))
        leaves = fold(n1, n2, one, two, odds[: high - low], tree)
        if leaves < n1 + n2 - 1:
            n = core_of(n1, n2, one, two, odds, tree, record, graph, core_odds)
            if not arranged(n, graph):
                continue
            for x in range(n):
                loose[x] = tree.loose[record[x]]
            sum_narrow(n, core_odds, loose, graph, of_pair, open_, taken)
            for x in range(n):
                tree.open[record[x]], tree.taken[record[x]] = open_[x], taken[x]
        unfold(leaves, n1, one, two, tree, of_pair)
        method[g] = ELIMINATED


@kernel
def exact_counted(
    first, last, start, start1, start2, local1, local2, weight, chosen, u, v, table_start, table, slope, most, share,
    method,
):  # fmt: skip
    """The same as :func:`exact` under any prior of the count: weight excludes it (see ``assign_counted``).

    table[table_start[g] + k] : ln P of k pairs.
    """
    widest, longest, narrowest = np.int64(1), np.int64(1), np.int64(1)
    for g in range(first, last):
        n1, n2 = start1[g + 1] - start1[g], start2[g + 1] - start2[g]
        if 1 < min(n1, n2) <= most:
            widest = max(widest, n1, n2)
            longest = max(longest, start[g + 1] - start[g])
            narrowest = max(narrowest, min(n1, n2))
    work = scratch(longest, widest, narrowest)
    row_start = np.empty(widest + 2, np.int64)
    column, pair = np.empty(longest, np.int32), np.empty(longest, np.int64)
    odds, part = np.empty(longest), np.empty(longest)
    none, unused, alone = np.empty(widest), np.empty(widest), np.empty(widest)
    stamp = np.int64(0)  # not a literal: numba would compile for it apart
    for g in range(first, last):
        low, high = start[g], start[g + 1]
        n1, n2 = start1[g + 1] - start1[g], start2[g + 1] - start2[g]
        log_p = table[table_start[g] : table_start[g + 1]]
        if n1 == 1 or n2 == 1:
            method[g] = CLOSED
            for e in range(low, high):
                share[e] = weight[e] + log_p[1] - log_p[0]
            star(low, high, share, share)
            continue
        method[g] = LOCAL
        if min(n1, n2) > most:
            continue
        size = np.int64(0)
        for e in range(low, high):
            size += chosen[e]
            share[e] = weight[e] + slope[g]
        ug, vg = u[start1[g] : start1[g + 1]], v[start2[g] : start2[g + 1]]
        n, nc = by_row(n1, n2, low, high, local1, local2, share, ug, vg, n2 > n1, row_start, column, pair, odds,
                       none, unused)  # fmt: skip
        prior = count_factors(log_p, slope[g], size)
        after = eliminate(n, nc, row_start[: n + 1], column, odds, none, unused, prior, part, alone, stamp, work)
        if after < 0:
            stamp += n + 1
            continue
        stamp = after
        method[g] = ELIMINATED
        for t in range(high - low):
            share[pair[t]] = part[t]

"""Upper bounds of the probability of pairs.

Let i have the partner j′ in the best hypothesis and j the partner i′. With Z the sum over all hypotheses,

    P(ij) = λ_ij Z(without i, j) / Z,   Z ≥ λ_ij′ λ_i′j Z₄,   Z₄ = Z(without i, j, i′, j′),

and in Z(without i, j) the records i′ and j′ have no partner, each other, or other partners c and k:

    Z(without i, j) ≤ Z₄ [1 + λ_i′j′ + A + B + min(A B¹, A¹ B)],   A = Σ_k λ_kj′ f_k,   B = Σ_c λ_i′c f_c,

A¹ and B¹ with f = 1. f_k bounds the probability that k is free, in any problem that contains k and its partner k′:
f_k = min(1, (1 + Σ_l λ_lk′ f_l) / λ_kk′), where f_l may be any earlier bound. A factor is 1 for a record without
partner in the best hypothesis.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from sameas.arrays import BoolArray, FloatArray, Int32Array, IntArray
from sameas.kernels.compiled import part, small_by
from sameas.kernels.components import GroupLayout, sizes

#: Iterations of the bounds f; every iteration gives a valid bound.
SWEEPS = 4
#: Upper limit of log odds; exp of minus this is the lower limit of the probability of being free.
MAX_LOG_ODDS = 300.0


def _pairs_wanted(first: int, last: int, layout: GroupLayout, *rest: Any) -> float:
    """Work: the pairs of the wanted groups, twice in every sweep."""
    (pairs, _, _), wanted = sizes(first, last, layout), rest[-2]
    return 2.0 * SWEEPS * float(pairs[wanted[first:last]].sum())


@small_by(_pairs_wanted)
def bounds(
    first: int, last: int, layout: GroupLayout, weight: FloatArray, chosen: BoolArray, wanted: BoolArray,
    bound: FloatArray,
) -> None:  # fmt: skip
    """Write to ``bound`` (m,) upper bounds of P of the pairs of the ``wanted`` groups (g,) among first … last − 1.

    weight : (m,) ln λ, including the linear prior.
    """
    start, start1, start2, edges1, local1, local2 = layout
    for g in range(first, last):
        if not wanted[g]:
            continue
        low, high = start[g], start[g + 1]
        n1, n2 = start1[g + 1] - start1[g], start2[g + 1] - start2[g]
        mate1, mate2 = np.full(n1, -1, np.int64), np.full(n2, -1, np.int64)
        for e in range(low, high):
            if chosen[e]:
                mate1[local1[e]] = e
                mate2[local2[e]] = e
        # Odds of each pair relative to the chosen pair of its record 1, and of its record 2.
        relative1, relative2 = np.zeros(high - low), np.zeros(high - low)
        for e in range(low, high):
            if not chosen[e]:
                a, b = mate1[local1[e]], mate2[local2[e]]
                if a >= 0:
                    relative1[e - low] = limited(weight[e] - weight[a])
                if b >= 0:
                    relative2[e - low] = limited(weight[e] - weight[b])
        without1, without2 = inverse(mate1, weight), inverse(mate2, weight)
        record1, record2 = local1[low:high], local2[low:high]
        others1, others2 = np.empty(n1), np.empty(n2)
        free1, free2 = np.ones(n1), np.ones(n2)
        sum_of_others(record1, relative1, record2, free2, others1)
        sum_of_others(record2, relative2, record1, free1, others2)
        any1, any2 = others1.copy(), others2.copy()
        for _ in range(SWEEPS):
            freed(mate1, local2, without1, others2, free1)
            freed(mate2, local1, without2, others1, free2)
            sum_of_others(record1, relative1, record2, free2, others1)
            sum_of_others(record2, relative2, record1, free1, others2)
        for e in range(low, high):
            a, b = mate1[local1[e]], mate2[local2[e]]
            if chosen[e] or weight[e] > MAX_LOG_ODDS:
                bound[e] = 1.0
            elif a >= 0 and b >= 0:
                i, j = local1[b], local2[a]
                swapped = 0.0
                for s in range(edges1[start1[g] + i], edges1[start1[g] + i + 1]):
                    if local2[s] == j:
                        swapped = math.exp(weight[e] + weight[s] - weight[a] - weight[b])
                x, y = others2[j], others1[i]
                total = swapped + relative1[e - low] * without2[local2[e]]
                total += x * relative2[e - low] + y * relative1[e - low]
                total += min(x * any1[i], any2[j] * y) * math.exp(weight[e])
                bound[e] = min(total, 1.0)
            elif a >= 0:
                x = relative1[e - low] + others2[local2[a]] * limited(weight[e])
                bound[e] = min(x, 1.0)
            elif b >= 0:
                x = relative2[e - low] + others1[local1[b]] * limited(weight[e])
                bound[e] = min(x, 1.0)
            else:
                bound[e] = math.exp(min(weight[e], 0.0))


@part
def limited(log_odds: float) -> float:
    """exp of log odds, these limited to MAX_LOG_ODDS."""
    return math.exp(min(log_odds, MAX_LOG_ODDS))


@part
def inverse(mate: IntArray, weight: FloatArray) -> FloatArray:
    """(n,) 1 / odds of the chosen pair of each record, 0 where it has none."""
    without = np.zeros(len(mate))
    for r in range(len(mate)):
        if mate[r] >= 0:
            without[r] = math.exp(-weight[mate[r]])
    return without


@part
def sum_of_others(
    record: Int32Array, relative: FloatArray, partner: Int32Array, free: FloatArray, others: FloatArray
) -> None:
    """Write to ``others`` (n,) Σ λ f over the pairs of each record that are not chosen, relative to its chosen pair."""
    others[:] = 0.0
    for e in range(len(relative)):
        others[record[e]] += relative[e] * free[partner[e]]


@part
def freed(mate: IntArray, local: Int32Array, without: FloatArray, others: FloatArray, free: FloatArray) -> None:
    """Write to ``free`` (n,) the bounds f of records with a partner, by the sums ``others`` of their partners."""
    for r in range(len(mate)):
        e = mate[r]
        if e >= 0:
            free[r] = min(1.0, max(without[r] + others[local[e]], math.exp(-MAX_LOG_ODDS)))

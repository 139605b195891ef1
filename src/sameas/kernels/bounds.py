"""Compiled upper bounds of the probability of pairs, from what their records can do without each other.

Let i have the partner j′ in the best hypothesis and j the partner i′. With Z the sum over all hypotheses,

    P(ij) = λ_ij Z(without i, j) / Z,   Z ≥ λ_ij′ λ_i′j Z₄,   Z₄ = Z(without i, j, i′, j′),

and in Z(without i, j) the two that were left alone stay alone, have each other, or take others k and c:

    Z(without i, j) ≤ Z₄ [1 + λ_i′j′ + A + B + min(A B¹, A¹ B)],   A = Σ_k λ_kj′ f_k,   B = Σ_c λ_i′c f_c,

A¹ and B¹ with f = 1. f_k bounds the probability that k is free for it, in any problem that holds k and its partner
k′: f_k = min(1, (1 + Σ_l λ_lk′ f_l) / λ_kk′), where f_l may be any bound found before. A factor is 1 where a record is
alone in the best hypothesis.
"""

from __future__ import annotations

import math

import numpy as np

from sameas.kernels.compiled import kernel, part

#: Times that what is found of the others is put in; every time is a bound.
SWEEPS = 4
#: Logarithms of odds are not taken to be more than this; and no record is less probably free than exp of minus this.
HIGHEST = 300.0


@kernel
def bounds(first, last, start, start1, start2, edges1, local1, local2, weight, chosen, wanted, bound):
    """Fill ``bound`` (m,) with upper bounds of P of the pairs of those groups first … last − 1 that are ``wanted``.

    weight : (m,) ln λ, with the prior, which is linear.
    """
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
        # Odds of each pair in units of those of the chosen pair of its record 1, and of its record 2.
        beside1, beside2 = np.zeros(high - low), np.zeros(high - low)
        for e in range(low, high):
            if not chosen[e]:
                a, b = mate1[local1[e]], mate2[local2[e]]
                if a >= 0:
                    beside1[e - low] = limited(weight[e] - weight[a])
                if b >= 0:
                    beside2[e - low] = limited(weight[e] - weight[b])
        without1, without2 = inverse(mate1, weight), inverse(mate2, weight)
        record1, record2 = local1[low:high], local2[low:high]
        others1, others2 = np.empty(n1), np.empty(n2)
        free1, free2 = np.ones(n1), np.ones(n2)
        over(record1, beside1, record2, free2, others1)
        over(record2, beside2, record1, free1, others2)
        any1, any2 = others1.copy(), others2.copy()
        for _ in range(SWEEPS):
            freed(mate1, local2, without1, others2, free1)
            freed(mate2, local1, without2, others1, free2)
            over(record1, beside1, record2, free2, others1)
            over(record2, beside2, record1, free1, others2)
        for e in range(low, high):
            a, b = mate1[local1[e]], mate2[local2[e]]
            if chosen[e] or weight[e] > HIGHEST:
                bound[e] = 1.0
            elif a >= 0 and b >= 0:
                i, j = local1[b], local2[a]
                swapped = 0.0
                for s in range(edges1[start1[g] + i], edges1[start1[g] + i + 1]):
                    if local2[s] == j:
                        swapped = math.exp(weight[e] + weight[s] - weight[a] - weight[b])
                x, y = others2[j], others1[i]
                total = swapped + beside1[e - low] * without2[local2[e]]
                total += x * beside2[e - low] + y * beside1[e - low]
                total += min(x * any1[i], any2[j] * y) * math.exp(weight[e])
                bound[e] = min(total, 1.0)
            elif a >= 0:
                x = beside1[e - low] + others2[local2[a]] * limited(weight[e])
                bound[e] = min(x, 1.0)
            elif b >= 0:
                x = beside2[e - low] + others1[local1[b]] * limited(weight[e])
                bound[e] = min(x, 1.0)
            else:
                bound[e] = math.exp(min(weight[e], 0.0))


@part
def limited(log_odds):
    """exp of log odds that are not higher than ``HIGHEST``."""
    return math.exp(min(log_odds, HIGHEST))


@part
def inverse(mate, weight):
    """(n,) 1 / odds of the chosen pair of each record, 0 where it has none."""
    without = np.zeros(len(mate))
    for r in range(len(mate)):
        if mate[r] >= 0:
            without[r] = math.exp(-weight[mate[r]])
    return without


@part
def over(record, beside, partner, free, others):
    """Fill ``others`` (n,): Σ λ f over the pairs of each record that are not chosen, in units of the chosen one."""
    others[:] = 0.0
    for e in range(len(beside)):
        others[record[e]] += beside[e] * free[partner[e]]


@part
def freed(mate, local, without, others, free):
    """Fill ``free`` (n,) with bounds of the probability of having no partner."""
    for r in range(len(mate)):
        e = mate[r]
        if e >= 0:
            free[r] = min(1.0, max(without[r] + others[local[e]], math.exp(-HIGHEST)))

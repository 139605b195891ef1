"""Compiled upper bounds of the probability of pairs, from what their records can do without each other."""

from __future__ import annotations

import math

import numpy as np

from sameas.kernels.compiled import kernel


@kernel
def log_bounds(first, last, start, start1, start2, local1, local2, weight, chosen, wanted, bound):
    """Fill ``bound`` (m,) with upper bounds of ln P of the pairs of those groups first … last − 1 that are ``wanted``.

    Let Z be the sum over all hypotheses and Z₋ the same without the records i and j of pair e: those with e make
    exp(wₑ) Z₋. In the best hypothesis i has the partner j′, j the partner i′. Hypotheses with both pairs make
    exp(w_ij′ + w_i′j) Z₌ with Z₌ free of all four records, and Z₋ ≤ (1 + Σ_k exp w_kj′)(1 + Σ_k exp w_i′k) Z₌, the
    sums over their other pairs. So P(e) ≤ exp(wₑ − w_ij′ − w_i′j)(1 + Σ …)(1 + Σ …); a factor is 1 where a record is
    alone in the best hypothesis. weight (m,) includes the prior, which is linear.
    """
    for g in range(first, last):
        if not wanted[g]:
            continue
        n1 = start1[g + 1] - start1[g]
        n2 = start2[g + 1] - start2[g]
        mate1 = np.full(n1, -1, np.int64)
        mate2 = np.full(n2, -1, np.int64)
        top1, top2 = np.zeros(n1), np.zeros(n2)
        sum1, sum2 = np.zeros(n1), np.zeros(n2)
        for e in range(start[g], start[g + 1]):
            if chosen[e]:
                mate1[local1[e]] = e
                mate2[local2[e]] = e
            else:
                top1[local1[e]] = max(top1[local1[e]], weight[e])
                top2[local2[e]] = max(top2[local2[e]], weight[e])
        for e in range(start[g], start[g + 1]):
            if not chosen[e]:
                sum1[local1[e]] += math.exp(weight[e] - top1[local1[e]])
                sum2[local2[e]] += math.exp(weight[e] - top2[local2[e]])
        for e in range(start[g], start[g + 1]):
            total = weight[e]
            a = mate1[local1[e]]
            if a >= 0:
                c = local2[a]
                total += top2[c] + math.log(sum2[c] + math.exp(-top2[c])) - weight[a]
            b = mate2[local2[e]]
            if b >= 0:
                r = local1[b]
                total += top1[r] + math.log(sum1[r] + math.exp(-top1[r])) - weight[b]
            bound[e] = 0.0 if chosen[e] else min(total, 0.0)

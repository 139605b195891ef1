"""Compiled sum-product messages, and exact sums around each record with messages for what lies beyond."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import BoolArray, FloatArray, Int32Array, IntArray
from sameas.kernels.compiled import kernel, part
from sameas.kernels.eliminate import eliminate, scratch
from sameas.kernels.posterior import LOCAL, bounded_exp

# Compiled upper bounds of the probability of pairs, from what their records can do without each other.
#
# Let i have the partner j′ in the best hypothesis and j the partner i′. With Z the sum over all hypotheses,
#
#     P(ij) = λ_ij Z(without i, j) / Z,   Z ≥ λ_ij′ λ_i′j Z₄,   Z₄ = Z(without i, j, i′, j′),
#
# and in Z(without i, j) the two that were left alone stay alone, have each other, or take others k and c:
#
#     Z(without i, j) ≤ Z₄ [1 + λ_i′j′ + A + B + min(A B¹, A¹ B)],   A = Σ_k λ_kj′ f_k,   B = Σ_c λ_i′c f_c,
#
# A¹ and B¹ with f = 1. f_k bounds the probability that k is free for it, in any problem that holds k and its partner
# k′: f_k = min(1, (1 + Σ_l λ_lk′ f_l) / λ_kk′), where f_l may be any bound found before. A factor is 1 where a record
# is alone in the best hypothesis.

#: Times that what is found of the others is put in; every time is a bound.
SWEEPS = 4
#: Logarithms of odds are not taken to be more than this; and no record is less probably free than exp of minus this.
HIGHEST = 300.0
#: Odds are not divided by less: products of them over the rows of a neighbourhood stay finite.
TINY = 1e-30


@kernel
def bounds(
    first: int,
    last: int,
    start: IntArray,
    start1: IntArray,
    start2: IntArray,
    edges1: IntArray,
    local1: Int32Array,
    local2: Int32Array,
    weight: FloatArray,
    chosen: BoolArray,
    wanted: BoolArray,
    bound: FloatArray,
) -> None:
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
def limited(log_odds: float) -> float:
    """exp of log odds that are not higher than ``HIGHEST``."""
    return math.exp(min(log_odds, HIGHEST))


@part
def inverse(mate: IntArray, weight: FloatArray) -> FloatArray:
    """(n,) 1 / odds of the chosen pair of each record, 0 where it has none."""
    without = np.zeros(len(mate))
    for r in range(len(mate)):
        if mate[r] >= 0:
            without[r] = math.exp(-weight[mate[r]])
    return without


@part
def over(record: Int32Array, beside: FloatArray, partner: Int32Array, free: FloatArray, others: FloatArray) -> None:
    """Fill ``others`` (n,): Σ λ f over the pairs of each record that are not chosen, in units of the chosen one."""
    others[:] = 0.0
    for e in range(len(beside)):
        others[record[e]] += beside[e] * free[partner[e]]


@part
def freed(mate: IntArray, local: Int32Array, without: FloatArray, others: FloatArray, free: FloatArray) -> None:
    """Fill ``free`` (n,) with bounds of the probability of having no partner."""
    for r in range(len(mate)):
        e = mate[r]
        if e >= 0:
            free[r] = min(1.0, max(without[r] + others[local[e]], math.exp(-HIGHEST)))


@kernel
def messages(
    first: int,
    last: int,
    start: IntArray,
    start1: IntArray,
    start2: IntArray,
    edges1: IntArray,
    local2: Int32Array,
    weight: FloatArray,
    u: FloatArray,
    v: FloatArray,
    method: NDArray[np.int8],
    to_column: FloatArray,
    to_row_claim: FloatArray,
    belief: FloatArray,
    sweeps: int,
    settled: float,
) -> float:
    """Sum-product messages of the groups left LOCAL.

    to_column (m,) receives the odds with which a row claims a column, to_row_claim (m,) those with which the column
    claims the row, belief (m,) the probability of each pair by messages alone. At most ``sweeps`` sweeps, fewer when no
    message changes by more than ``settled``. Returns the largest change in the last sweep.
    """
    worst = 0.0
    for g in range(first, last):
        if method[g] != LOCAL:
            continue
        low = start[g]
        high = start[g + 1]
        n1 = start1[g + 1] - start1[g]
        n2 = start2[g + 1] - start2[g]
        edges = edges1[start1[g] : start1[g] + n1 + 1]
        free = np.empty(n2)
        total = np.empty(n2)
        largest = np.empty(n2)
        largest_at = np.empty(n2, np.int64)
        none = np.empty(n1)
        to_row = np.ones(high - low)
        odds = np.empty(high - low)
        for c in range(n2):
            free[c] = bounded_exp(-v[start2[g] + c])
        for r in range(n1):
            none[r] = bounded_exp(-u[start1[g] + r])
            for e in range(edges[r], edges[r + 1]):
                x = weight[e] - u[start1[g] + r] - v[start2[g] + local2[e]]
                odds[e - low] = math.exp(max(x, -700.0))
                to_column[e] = 0.0
        for _ in range(sweeps):
            change = 0.0
            for r in range(n1):
                best = -1
                rest = none[r]
                for e in range(edges[r], edges[r + 1]):
                    if best < 0 or odds[e - low] * to_row[e - low] > odds[best - low] * to_row[best - low]:
                        best = e
                for e in range(edges[r], edges[r + 1]):
                    if e != best:
                        rest += odds[e - low] * to_row[e - low]
                top = odds[best - low] * to_row[best - low]
                for e in range(edges[r], edges[r + 1]):
                    others = rest if e == best else rest + top - odds[e - low] * to_row[e - low]
                    new = odds[e - low] / others
                    change = max(change, abs(new - to_column[e]) / (1.0 + new))
                    to_column[e] = new
            for c in range(n2):
                total[c] = free[c]
                largest[c] = -1.0
            for e in range(low, high):
                if to_column[e] > largest[local2[e]]:
                    largest[local2[e]] = to_column[e]
                    largest_at[local2[e]] = e
            for e in range(low, high):
                if e != largest_at[local2[e]]:
                    total[local2[e]] += to_column[e]
            for e in range(low, high):
                c = local2[e]
                others = total[c] if e == largest_at[c] else total[c] + largest[c] - to_column[e]
                to_row[e - low] = 1.0 / others
            if change < settled:
                break
        worst = max(worst, change)
        for r in range(n1):
            total_ = none[r]
            for e in range(edges[r], edges[r + 1]):
                total_ += odds[e - low] * to_row[e - low]
            for e in range(edges[r], edges[r + 1]):
                to_row_claim[e] = odds[e - low] * to_row[e - low]
                belief[e] = to_row_claim[e] / total_
    return worst


@kernel
def columns_of(
    groups: int,
    start: IntArray,
    start1: IntArray,
    start2: IntArray,
    edges1: IntArray,
    local2: Int32Array,
    method: NDArray[np.int8],
) -> tuple[IntArray, IntArray]:
    """CSR of the pairs by record of source 2, for the groups left LOCAL: (starts by record of the layout, pairs)."""
    starts = np.zeros(start2[groups] + 1, np.int64)
    for g in range(groups):
        if method[g] == LOCAL:
            for e in range(start[g], start[g + 1]):
                starts[start2[g] + local2[e] + 1] += 1
    for c in range(start2[groups]):
        starts[c + 1] += starts[c]
    fill = starts[:-1].copy()
    pairs = np.empty(starts[-1], np.int64)
    for g in range(groups):
        if method[g] == LOCAL:
            for e in range(start[g], start[g + 1]):
                pairs[fill[start2[g] + local2[e]]] = e
                fill[start2[g] + local2[e]] += 1
    return starts, pairs


@kernel
def balls(
    first: int,
    last: int,
    group1: Int32Array,
    start1: IntArray,
    start2: IntArray,
    edges1: IntArray,
    local1: Int32Array,
    local2: Int32Array,
    column_start: IntArray,
    column_pairs: IntArray,
    weight: FloatArray,
    u: FloatArray,
    v: FloatArray,
    method: NDArray[np.int8],
    to_column: FloatArray,
    most_rows: int,
    most_bits: float,
    share: FloatArray,
) -> None:
    """Posterior of the pairs of rows first … last − 1 of the layout whose group was left LOCAL.

    Each row is solved exactly together with the rows that compete with it most, up to ``most_rows`` of them and
    ``most_bits`` of choices; what lies outside answers by its messages at the border.
    """
    longest = 64
    for r in range(first, last):
        longest = max(longest, edges1[r + 1] - edges1[r])
    capacity = longest * (most_rows + 1)
    work = scratch(np.int64(capacity), np.int64(most_rows), np.int64(capacity))
    inside = np.empty(most_rows, np.int64)
    start = np.empty(most_rows + 1, np.int64)
    column = np.empty(capacity, np.int32)
    odds = np.empty(capacity)
    part = np.empty(capacity)
    none = np.empty(most_rows)
    alone = np.empty(most_rows)
    name = np.empty(capacity, np.int64)
    unused = np.empty(capacity)
    prior = np.ones(1)
    stamp = np.int64(0)  # not a literal: numba would compile for it apart
    for center in range(first, last):
        g = group1[center]
        if method[g] != LOCAL:
            continue
        base2 = start2[g]
        count = 1
        inside[0] = center
        bits = math.log2(1.0 + edges1[center + 1] - edges1[center])
        pairs = edges1[center + 1] - edges1[center]
        while count < most_rows:
            best = -1
            strongest = 1e-9
            for t in range(count):
                for e in range(edges1[inside[t]], edges1[inside[t] + 1]):
                    c = base2 + local2[e]
                    for p in range(column_start[c], column_start[c + 1]):
                        other = start1[g] + local1[column_pairs[p]]
                        # A rival's claim counts for as much as the ball's own row can want the column.
                        claim = min(to_column[column_pairs[p]], 1.0) * min(to_column[e], 1.0)
                        if claim > strongest:
                            known = False
                            for s in range(count):
                                known = known or inside[s] == other
                            if not known:
                                strongest = claim
                                best = other
            if best < 0:
                break
            degree = edges1[best + 1] - edges1[best]
            if bits + math.log2(1.0 + degree) > most_bits or pairs + degree > capacity:
                break
            bits += math.log2(1.0 + degree)
            pairs += degree
            inside[count] = best
            count += 1
        nc = 0
        m = 0
        for t in range(count):
            start[t] = m
            none[t] = bounded_exp(-u[inside[t]])
            for e in range(edges1[inside[t]], edges1[inside[t] + 1]):
                c = base2 + local2[e]
                at = -1
                for s in range(nc):
                    if name[s] == c:
                        at = s
                if at < 0:
                    at = nc
                    name[nc] = c
                    nc += 1
                    unused[at] = bounded_exp(-v[c])
                    for p in range(column_start[c], column_start[c + 1]):
                        other = start1[g] + local1[column_pairs[p]]
                        known = False
                        for s in range(count):
                            known = known or inside[s] == other
                        if not known:
                            unused[at] += to_column[column_pairs[p]]
                column[m] = at
                odds[m] = math.exp(max(weight[e] - u[inside[t]] - v[c], -700.0))
                m += 1
        start[count] = m
        # A column that nobody takes counts 1: the product of hundreds of other numbers is beyond a double.
        for e in range(m):
            if unused[column[e]] > TINY:
                odds[e] /= unused[column[e]]
        for c in range(nc):
            if unused[c] > TINY:
                unused[c] = 1.0
        after = eliminate(
            count, nc, start[: count + 1], column, odds, none, unused[:nc], prior, part, alone, stamp, work
        )
        if after < 0:
            stamp += count + 1
            from_messages(
                center, base2, edges1, local1, local2, column_start, column_pairs, weight, u, v, to_column, share
            )
            continue
        stamp = after
        for e in range(edges1[center], edges1[center + 1]):
            share[e] = part[e - edges1[center]]


@part
def from_messages(
    center: int,
    base2: int,
    edges1: IntArray,
    local1: Int32Array,
    local2: Int32Array,
    column_start: IntArray,
    column_pairs: IntArray,
    weight: FloatArray,
    u: FloatArray,
    v: FloatArray,
    to_column: FloatArray,
    share: FloatArray,
) -> None:
    """The posterior of one row from its messages alone."""
    total = bounded_exp(-u[center])
    for e in range(edges1[center], edges1[center + 1]):
        c = base2 + local2[e]
        open_ = bounded_exp(-v[c])
        for p in range(column_start[c], column_start[c + 1]):
            if column_pairs[p] != e:
                open_ += to_column[column_pairs[p]]
        share[e] = math.exp(max(weight[e] - u[center] - v[c], -700.0)) / open_
        total += share[e]
    for e in range(edges1[center], edges1[center + 1]):
        share[e] /= total

"""Compiled sum-product messages for groups that cannot be summed exactly, and upper bounds of probabilities."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import BoolArray, FloatArray, Int32Array, IntArray
from sameas.kernels.compiled import inlined, part, small_by
from sameas.kernels.posterior import LOCAL, bounded_exp

# Upper bounds of the probability of pairs.
#
# Let i have the partner j′ in the best hypothesis and j the partner i′. With Z the sum sum_of_others all hypotheses,
#
#     P(ij) = λ_ij Z(without i, j) / Z,   Z ≥ λ_ij′ λ_i′j Z₄,   Z₄ = Z(without i, j, i′, j′),
#
# and in Z(without i, j) the records i′ and j′ have no partner, each other, or other partners c and k:
#
#     Z(without i, j) ≤ Z₄ [1 + λ_i′j′ + A + B + min(A B¹, A¹ B)],   A = Σ_k λ_kj′ f_k,   B = Σ_c λ_i′c f_c,
#
# A¹ and B¹ with f = 1. f_k bounds the probability that k is free, in any problem that contains k and its partner k′:
# f_k = min(1, (1 + Σ_l λ_lk′ f_l) / λ_kk′), where f_l may be any earlier bound. A factor is 1 for a record without
# partner in the best hypothesis.

#: Iterations of the bounds f; every iteration gives a valid bound.
SWEEPS = 4
#: Upper limit of log odds; exp of minus this is the lower limit of the probability of being free.
MAX_LOG_ODDS = 300.0
#: A message is not updated if it changes by less than this share of the convergence threshold. Records without an
#: updated message are skipped.
QUIET_SHARE = 0.1


def _pairs_wanted(first: int, last: int, start: IntArray, *rest: Any) -> float:
    """Work: the pairs of the wanted groups, twice in every sweep."""
    pairs, wanted = np.diff(start[first : last + 1]), rest[-2]
    return 2.0 * SWEEPS * float(pairs[wanted[first:last]].sum())


@small_by(_pairs_wanted)
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
    """Write to ``bound`` (m,) upper bounds of P of the pairs of the ``wanted`` groups (g,) among first … last − 1.

    weight : (m,) ln λ, including the linear prior.
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


@inlined
def sum_but(at: int, whole: float, none: float, values: FloatArray, first: int, last: int) -> float:
    """``whole``, the sum of ``none`` and the values first … last − 1, without the value ``at``.

    The largest value is not subtracted, as that would lose digits: the others are summed.
    """
    others = whole - values[at]
    if others < values[at]:
        others = none
        for one in range(first, last):
            if one != at:
                others += values[one]
    return others


def _pairs_left(first: int, last: int, start: IntArray, *rest: Any) -> float:
    """Work: the pairs of the LOCAL groups, for the number of sweeps that most groups need."""
    pairs, method = np.diff(start[first : last + 1]), rest[8]
    return 32.0 * float(pairs[method[first:last] == LOCAL].sum())


@small_by(_pairs_left)
def messages(
    first: int,
    last: int,
    start: IntArray,
    start1: IntArray,
    start2: IntArray,
    edges1: IntArray,
    local1: Int32Array,
    local2: Int32Array,
    weight: FloatArray,
    u: FloatArray,
    v: FloatArray,
    method: NDArray[np.int8],
    to_column: FloatArray,
    to_row_claim: FloatArray,
    belief: FloatArray,
    sweeps: int,
    tolerance: float,
) -> float:
    """Sum-product messages of the LOCAL groups.

    Writes to_column (m,), the odds of each pair without its column's other pairs; to_row_claim (m,), the odds without
    its row's other pairs; and belief (m,), the probability of each pair. At most ``sweeps`` sweeps, fewer if no message
    changes by more than ``tolerance``. Returns the largest change in the last sweep.
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
        base = start2[g]
        free = np.empty(n2)
        none = np.empty(n1)
        to_row = np.ones(high - low)
        odds, product = np.empty(high - low), np.empty(high - low)
        # Messages to columns, ordered by column, with the positions of pairs by row in that order and the reverse.
        claim, at_column, at_row = np.zeros(high - low), np.empty(high - low, np.int32), np.empty(high - low, np.int32)
        column_start = by_column(n2, local2[low:high], at_column, at_row)
        row_open, column_open = np.ones(n1, np.bool_), np.ones(n2, np.bool_)
        for c in range(n2):
            free[c] = bounded_exp(-v[base + c])
        for r in range(n1):
            none[r] = bounded_exp(-u[start1[g] + r])
            for e in range(edges[r], edges[r + 1]):
                x = weight[e] - u[start1[g] + r] - v[base + local2[e]]
                odds[e - low] = math.exp(max(x, -700.0))
        for sweep in range(sweeps):
            change = 0.0
            quiet = QUIET_SHARE * tolerance if sweep > 0 else -1.0
            for r in range(n1):
                if not row_open[r]:
                    continue
                row_open[r] = False
                first_, last_ = edges[r] - low, edges[r + 1] - low
                whole = none[r]
                for e in range(first_, last_):
                    product[e] = odds[e] * to_row[e]
                    whole += product[e]
                for e in range(first_, last_):
                    others = sum_but(e, whole, none[r], product, first_, last_)
                    new = odds[e] / others
                    at = at_column[e]
                    moved, scale = abs(new - claim[at]), 1.0 + new
                    if moved > quiet * scale:
                        change = max(change, moved / scale)
                        claim[at] = new
                        column_open[local2[low + e]] = True
            for c in range(n2):
                if not column_open[c]:
                    continue
                column_open[c] = False
                first_, last_ = column_start[c], column_start[c + 1]
                whole = free[c]
                for k in range(first_, last_):
                    whole += claim[k]
                for k in range(first_, last_):
                    others = sum_but(k, whole, free[c], claim, first_, last_)
                    new = 1.0 / others
                    e = at_row[k]
                    if abs(new - to_row[e]) > quiet * new:
                        to_row[e] = new
                        row_open[local1[low + e]] = True
            if change < tolerance:
                break
        for e in range(low, high):
            to_column[e] = claim[at_column[e - low]]
        worst = max(worst, change)
        for r in range(n1):
            total_ = none[r]
            for e in range(edges[r], edges[r + 1]):
                total_ += odds[e - low] * to_row[e - low]
            for e in range(edges[r], edges[r + 1]):
                to_row_claim[e] = odds[e - low] * to_row[e - low]
                belief[e] = to_row_claim[e] / total_
    return worst


@part
def by_column(columns: int, column: Int32Array, at_column: Int32Array, at_row: Int32Array) -> IntArray:
    """CSR starts of pairs by column; writes their positions there to ``at_column``, the reverse to ``at_row`` (m,)."""
    starts = np.zeros(columns + 1, np.int64)
    for c in column:
        starts[c + 1] += 1
    for c in range(columns):
        starts[c + 1] += starts[c]
    fill = starts[:-1].copy()
    for e in range(len(column)):
        place = fill[column[e]]
        at_column[e], at_row[place] = place, e
        fill[column[e]] = place + 1
    return starts

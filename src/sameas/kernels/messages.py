"""Compiled sum-product messages among the pairs of groups that cannot be summed exactly.

They are followed by exact sums around each record: :mod:`sameas.kernels.balls`.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import FloatArray, Int32Array, IntArray
from sameas.kernels.compiled import inlined, part, small_by
from sameas.kernels.components import GroupLayout, sizes
from sameas.kernels.posterior import LOCAL, bounded_exp

#: A message is not updated if it changes by less than this share of the convergence threshold. Records without an
#: updated message are skipped.
QUIET_SHARE = 0.1


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


def _pairs_left(first: int, last: int, layout: GroupLayout, *rest: Any) -> float:
    """Work: the pairs of the LOCAL groups, for the number of sweeps that most groups need."""
    (pairs, _, _), method = sizes(first, last, layout), rest[3]
    return 32.0 * float(pairs[method[first:last] == LOCAL].sum())


@small_by(_pairs_left)
def messages(
    first: int, last: int, layout: GroupLayout, weight: FloatArray, u: FloatArray, v: FloatArray,
    method: NDArray[np.int8], to_column: FloatArray, to_row_claim: FloatArray, belief: FloatArray, sweeps: int,
    tolerance: float,
) -> float:  # fmt: skip
    """Sum-product messages of the LOCAL groups.

    Writes to_column (m,), the odds of each pair without its column's other pairs; to_row_claim (m,), the odds without
    its row's other pairs; and belief (m,), the probability of each pair. At most ``sweeps`` sweeps, fewer if no message
    changes by more than ``tolerance``. Returns the largest change in the last sweep.
    """
    start, start1, start2, edges1, local1, local2 = layout
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

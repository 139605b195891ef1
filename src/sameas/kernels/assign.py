"""Compiled assignment: the best one-to-one hypothesis of each group by shortest augmenting paths.

Notation: rows are records of source 1, columns of source 2, both numbered within their group; ``mate`` arrays have −1
for no partner. Dual variables u ≥ 0 of rows and v ≥ 0 of columns satisfy u + v ≥ w for every candidate, with equality
on the chosen pairs and zero on records without partner. They certify that the hypothesis is the best.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from sameas.arrays import BoolArray, FloatArray, Int32Array, IntArray
from sameas.kernels.compiled import part, small_by
from sameas.kernels.components import GroupLayout, sizes
from sameas.kernels.messages import by_column


def _steps(first: int, last: int, layout: GroupLayout, *rest: Any) -> float:
    """Upper bound of the work: each record of a group's smaller side needs a path through at most all pairs."""
    pairs, rows, columns = sizes(first, last, layout)
    return float(pairs @ np.minimum(rows, columns))


@small_by(_steps)
def assign_linear(
    first: int, last: int, layout: GroupLayout, weight: FloatArray, chosen: BoolArray, u: FloatArray, v: FloatArray
) -> None:
    """Maximum-weight matching of the groups first … last − 1; having no partner costs nothing.

    weight : (m,) of the layout's pairs. Writes chosen (m,), and the duals u, v of the layout's records.
    """
    start, start1, start2, edges1, local1, local2 = layout
    most1 = 0
    most2 = 0
    for g in range(first, last):
        most1 = max(most1, start1[g + 1] - start1[g])
        most2 = max(most2, start2[g + 1] - start2[g])
    mate1 = np.empty(most1, np.int64)
    mate2 = np.empty(most2, np.int32)
    distance = np.empty(most2)
    through = np.empty(most2, np.int64)
    reached = np.zeros(most2, np.int64)
    frontier = np.empty(most2, np.int32)
    scanned = np.empty(most2, np.int32)
    stamp = np.int64(0)
    for g in range(first, last):
        if start[g + 1] - start[g] == 1:
            e = start[g]
            chosen[e] = weight[e] > 0.0
            u[start1[g]] = max(weight[e], 0.0)
            v[start2[g]] = 0.0
            continue
        base = start1[g]
        n1 = start1[g + 1] - base
        n2 = start2[g + 1] - start2[g]
        vg = v[start2[g] : start2[g + 1]]
        ug = u[base : start1[g + 1]]
        vg[:] = 0.0
        mate2[:n2] = -1
        for r in range(n1):
            mate1[r] = -1
            best = 0.0
            at = -1
            for e in range(edges1[base + r], edges1[base + r + 1]):
                if weight[e] > best:
                    best = weight[e]
                    at = e
            ug[r] = best
            if at >= 0 and mate2[local2[at]] < 0:
                mate1[r] = at
                mate2[local2[at]] = r
        for s in range(n1):
            if mate1[s] >= 0 or ug[s] == 0.0:
                continue
            stamp += 2
            augment(s, base, edges1, local1, local2, weight, ug, vg, mate1, mate2, distance, through, reached, frontier,
                    scanned, stamp)  # fmt: skip
        for r in range(n1):
            for e in range(edges1[base + r], edges1[base + r + 1]):
                chosen[e] = mate1[r] == e


@part
def augment(
    s: int, base: int, edges1: IntArray, local1: Int32Array, local2: Int32Array, weight: FloatArray, u: FloatArray,
    v: FloatArray, mate1: IntArray, mate2: Int32Array, distance: FloatArray, through: IntArray, reached: IntArray,
    frontier: Int32Array, scanned: Int32Array, stamp: int,
) -> None:  # fmt: skip
    """Match row s along the cheapest path: to a free column, or to a row that is then left without partner.

    ``mate1`` has the pair of each row. ``reached`` is stamp for a column in the frontier, stamp + 1 for a finished one.
    """
    waiting = 0
    done = 0
    end_row = s
    end_column = -1
    least = u[s]
    row = s
    at = 0.0  # distance of the row from s
    while True:
        for e in range(edges1[base + row], edges1[base + row + 1]):
            if weight[e] <= 0.0:
                continue
            c = local2[e]
            if reached[c] == stamp + 1:
                continue
            reach = at + max(0.0, u[row] + v[c] - weight[e])
            if reach >= least:
                continue
            if reached[c] != stamp:
                reached[c] = stamp
                frontier[waiting] = c
                waiting += 1
            elif reach >= distance[c]:
                continue
            distance[c] = reach
            through[c] = e
        if waiting == 0:
            break
        pick = 0
        for t in range(1, waiting):
            if distance[frontier[t]] < distance[frontier[pick]]:
                pick = t
        c = frontier[pick]
        if distance[c] >= least:
            break
        waiting -= 1
        frontier[pick] = frontier[waiting]
        reached[c] = stamp + 1
        at = distance[c]
        if mate2[c] < 0:
            least = at
            end_column = c
            break
        scanned[done] = c
        done += 1
        row = mate2[c]
        if at + u[row] < least:
            least = at + u[row]
            end_row = row
    for t in range(done):
        c = scanned[t]
        if distance[c] < least:
            v[c] += least - distance[c]
            u[mate2[c]] = max(0.0, u[mate2[c]] - (least - distance[c]))
    u[s] = max(0.0, u[s] - least)
    if end_column < 0:
        if end_row == s:
            return
        end_column = local2[mate1[end_row]]
        mate1[end_row] = -1
    c = end_column
    while True:
        row = local1[through[c]]
        follow = local2[mate1[row]] if mate1[row] >= 0 else -1
        mate1[row] = through[c]
        mate2[c] = row
        if row == s:
            return
        c = follow


@small_by(_steps)
def assign_counted(
    first: int, last: int, layout: GroupLayout, weight: FloatArray, table_start: IntArray, table: FloatArray,
    chosen: BoolArray, u: FloatArray, v: FloatArray, slope: FloatArray,
) -> None:  # fmt: skip
    """The best matching of each group under any prior of the number of pairs: the best of each size, then the size.

    table[table_start[g] + k] is ln P(k) of group g. Shortest augmenting paths from all free rows at once give the best
    matching of every size k in turn, of weight W_k; the k of largest ln P(k) + W_k is kept. slope (g,) receives the
    multiplier μ for which u + v ≥ w + μ certifies the kept matching.
    """
    start1, start2, edges1 = layout.start1, layout.start2, layout.edges1
    for g in range(first, last):
        base = start1[g]
        n1 = start1[g + 1] - base
        n2 = start2[g + 1] - start2[g]
        prior = table[table_start[g] : table_start[g + 1]]
        edges = edges1[base : base + n1 + 1]
        slope[g] = every_size(
            n1, n2, edges, layout.local1, layout.local2, weight, prior, chosen, u[base : base + n1],
            v[start2[g] : start2[g] + n2],
        )  # fmt: skip


@part
def heaviest_free(
    pairs: Int32Array, start: int, stop: int, low: int, local1: Int32Array, mate1: IntArray, weight: FloatArray
) -> int:
    """The pair of largest weight of a column with a free row, −1 for none. pairs : of all columns, from ``low`` on."""
    head = -1
    for t in range(start, stop):
        e = low + pairs[t]
        if mate1[local1[e]] < 0 and (head < 0 or weight[e] > weight[head]):
            head = e
    return head


@part
def every_size(
    n1: int, n2: int, edges: IntArray, local1: Int32Array, local2: Int32Array, weight: FloatArray, prior: FloatArray,
    chosen: BoolArray, u: FloatArray, v: FloatArray,
) -> float:  # fmt: skip
    """One group of :func:`assign_counted`: writes chosen, u, v and returns μ."""
    low = edges[0]
    chosen[low : edges[-1]] = False
    places, pairs = np.empty(edges[-1] - low, np.int32), np.empty(edges[-1] - low, np.int32)
    starts = by_column(n2, local2[low : edges[-1]], places, pairs)
    heads = np.empty(n2, np.int64)
    mate1 = np.full(n1, -1, np.int64)
    mate2 = np.full(n2, -1, np.int64)
    best1 = mate1.copy()
    potential = np.zeros(n1)
    price = np.zeros(n2)
    # Finished columns have distance −∞ and nearest ∞, so that they are neither reached again nor the nearest.
    distance, nearest = np.empty(n2), np.empty(n2)
    bits = nearest.view(np.int64)
    through = np.empty(n2, np.int64)
    scanned, reached = np.empty(n2, np.int64), np.empty(n2)
    top = -np.inf
    for e in range(low, edges[-1]):
        top = max(top, weight[e])
    total = 0.0
    best = prior[0]
    best_slope = -top
    u[:] = 0.0
    v[:] = 0.0
    for k in range(1, len(prior)):
        # All free rows have the potential ``top``; the head of a column is its best pair with a free row.
        for c in range(n2):
            if k == 1 or (heads[c] >= 0 and mate1[local1[heads[c]]] >= 0):
                heads[c] = heaviest_free(pairs, starts[c], starts[c + 1], low, local1, mate1, weight)
            nearest[c] = np.inf
            if heads[c] >= 0:
                nearest[c] = max(0.0, top + price[c] - weight[heads[c]])
                through[c] = heads[c]
            distance[c] = nearest[c]
        count = 0
        end, least = -1, np.inf
        while True:
            # Nonnegative floats are ordered as their bits; the minimum of integers is vectorised.
            lowest = bits[0]
            for t in range(n2):
                lowest = min(lowest, bits[t])
            c = 0
            while bits[c] != lowest:
                c += 1
            least = nearest[c]
            if least == np.inf:
                break
            if mate2[c] < 0:
                end = c
                break
            distance[c], nearest[c] = -np.inf, np.inf
            scanned[count], reached[count] = c, least
            count += 1
            row = local1[mate2[c]]
            own, begin = potential[row], edges[row]
            own_weight, columns = weight[begin : edges[row + 1]], local2[begin : edges[row + 1]]
            for at in range(len(columns)):
                t = np.uint64(columns[at])  # unsigned: no test for negative indices
                reach = least + max(0.0, own + price[t] - own_weight[at])
                if reach < distance[t]:
                    distance[t] = nearest[t] = reach
                    through[t] = begin + at
        if end < 0:
            break
        for t in range(count):
            c = scanned[t]
            price[c] += least - reached[t]
            potential[local1[mate2[c]]] -= least - reached[t]
        total += top - least
        top -= least
        c = end
        while True:
            e = through[c]
            row = local1[e]
            follow = mate1[row]
            mate1[row] = e
            mate2[c] = e
            if follow < 0:
                potential[row] = top
                break
            c = local2[follow]
        if prior[k] + total > best:
            best = prior[k] + total
            best_slope = -top
            for r in range(n1):
                best1[r] = mate1[r]
                u[r] = max(0.0, potential[r] - top) if mate1[r] >= 0 else 0.0
            for c in range(n2):
                v[c] = price[c]
    for r in range(n1):
        if best1[r] >= 0:
            chosen[best1[r]] = True
    return best_slope

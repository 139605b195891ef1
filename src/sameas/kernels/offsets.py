"""Compiled search for the offset between two sources: pairs under many offsets, their messages, scores and information.

Arrays of pairs concatenate the pairs of all offsets: those of offset s are ``start[s]`` … ``start[s + 1] − 1``.
"""

from __future__ import annotations

import math
from collections import namedtuple

import numpy as np

from sameas.arrays import FloatArray, IntArray
from sameas.kernels.compiled import inlined, kernel, part
from sameas.kernels.components import join, root
from sameas.kernels.linear import solve
from sameas.kernels.search import whitened
from sameas.kernels.zones import folded

LOG_2PI = math.log(2.0 * math.pi)

#: A source laid out in cells of its first and last axis, row by row: positions (n, d), errors (n, d, d), rows (n,);
#: start (cells + 1,), the first record of every cell; of both axes the edge of the first cell low (2,), the size of a
#: cell size (2,), infinite for a single cell, and the number of cells shape (2,).
Cells = namedtuple("Cells", "position error rows start low size shape")


@part
def longer(array: FloatArray | IntArray, length: int) -> FloatArray | IntArray:
    """The array with its first axis extended to ``length``."""
    grown = np.empty((length, *array.shape[1:]), array.dtype)
    old, new = array.reshape(-1), grown.reshape(-1)
    for k in range(len(old)):  # the assignment of an array to a slice takes numba a second to compile
        new[k] = old[k]
    return grown


@kernel
def near_pairs(
    one: Cells, two: FloatArray, covariance_2: FloatArray, periods: FloatArray, sigmas: float, widening: float
) -> tuple[IntArray, IntArray, IntArray, FloatArray, FloatArray, FloatArray]:
    """Pairs within ``sigmas`` standard deviations, with errors ``widening`` times as large as quoted.

    one : the first source. two, covariance_2 : (s, k, d) and (s, k, d, d) of the second, under every offset. periods
    (d,) of the axes, infinite for most.
    Returns start (s + 1,), i, j (m,), residual (m, d), precision (m, d, d), log density (m,) of a true pair.
    """
    sets, many, d = two.shape
    start = np.zeros(sets + 1, np.int64)
    capacity = max(4 * sets * many, 64)
    i, j, log_normal = np.empty(capacity, np.int64), np.empty(capacity, np.int64), np.empty(capacity)
    residual, precision = np.empty((capacity, d)), np.empty((capacity, d, d))
    matrix, delta, count = np.empty((3, d, d)), np.empty((2, d)), 0
    farthest_x, farthest_y = 0.0, 0.0
    for k in range(len(one.error)):
        farthest_x = max(farthest_x, sigmas * widening * math.sqrt(one.error[k, 0, 0]))
        farthest_y = max(farthest_y, sigmas * widening * math.sqrt(one.error[k, d - 1, d - 1]))
    for s in range(sets):
        for b in range(many):
            error = covariance_2[s, b]
            # The sum of both σ is a quick upper bound of the residual's.
            reach_x = farthest_x + sigmas * widening * math.sqrt(error[0, 0])
            reach_y = farthest_y + sigmas * widening * math.sqrt(error[d - 1, d - 1])
            left, right = span_of_cells(one, 0, two[s, b, 0], reach_x)
            bottom, top = span_of_cells(one, 1, two[s, b, d - 1], reach_y)
            for strip in range(bottom * one.shape[0], top * one.shape[0], one.shape[0]):
                for k in range(one.start[strip + left], one.start[strip + right]):
                    distance, determinant = np.inf, 1.0
                    if in_box(one, k, two[s, b], error, periods, sigmas, widening, matrix, delta):
                        distance, determinant = measured(delta, matrix)
                    if distance > sigmas * sigmas:
                        continue
                    if count == capacity:
                        capacity *= 2
                        i, j, log_normal = longer(i, capacity), longer(j, capacity), longer(log_normal, capacity)
                        residual, precision = longer(residual, capacity), longer(precision, capacity)
                    i[count], j[count] = one.rows[k], b
                    log_normal[count] = -0.5 * (distance + math.log(determinant) + d * LOG_2PI)
                    write_pair(delta, matrix, residual, precision, count)
                    count += 1
        start[s + 1] = count
    return start, i[:count], j[:count], residual[:count], precision[:count], log_normal[:count]


@inlined
def span_of_cells(one: Cells, axis: int, at: float, reach: float) -> tuple[int, int]:
    """Range [first, end) of the cells along an axis that ``at`` ± ``reach`` overlaps; (0, 0) for none."""
    last = one.shape[axis] - 1
    from_cell = (at - reach - one.low[axis]) / one.size[axis]
    to_cell = (at + reach - one.low[axis]) / one.size[axis]
    if to_cell < 0.0 or from_cell >= last + 1.0:
        return 0, 0
    return int(max(from_cell, 0.0)), int(min(to_cell, float(last))) + 1


@inlined
def in_box(
    one: Cells, k: int, two: FloatArray, error: FloatArray, periods: FloatArray, sigmas: float, widening: float,
    matrix: FloatArray, delta: FloatArray,
) -> bool:  # fmt: skip
    """Whether a pair is in the box around its gate; writes its residual to ``delta[0]`` and, if it is, its covariance
    to ``matrix[1]``."""
    d, square = len(two), widening * widening
    for v in range(d):
        delta[0, v] = folded(one.position[k, v] - two[v], periods[v])
        # The gate's ellipse is inside this box.
        if delta[0, v] * delta[0, v] > sigmas * sigmas * square * (one.error[k, v, v] + error[v, v]):
            return False
    for v in range(d):
        for w in range(d):
            matrix[1, v, w] = square * (one.error[k, v, w] + error[v, w])
    return True


@inlined
def write_pair(delta: FloatArray, matrix: FloatArray, residual: FloatArray, precision: FloatArray, count: int) -> None:
    """Write the residual and the precision of the pair number ``count``."""
    for v in range(delta.shape[1]):
        residual[count, v] = delta[0, v]
        for w in range(delta.shape[1]):
            precision[count, v, w] = matrix[0, v, w]


@inlined
def measured(delta: FloatArray, matrix: FloatArray) -> tuple[float, float]:
    """χ² of ``delta[0]`` with covariance ``matrix[1]``, and its determinant; writes its inverse to ``matrix[0]``."""
    d = delta.shape[1]
    if d == 2:
        x, y = delta[0, 0], delta[0, 1]
        xx, xy, yy = matrix[1, 0, 0], matrix[1, 0, 1], matrix[1, 1, 1]
        area = xx * yy - xy * xy
        matrix[0, 0, 0], matrix[0, 1, 1] = yy / area, xx / area
        matrix[0, 0, 1] = matrix[0, 1, 0] = -xy / area
        return (x * x * yy - 2.0 * x * y * xy + y * y * xx) / area, area
    for v in range(d):
        for w in range(d):
            matrix[0, v, w] = 1.0 if v == w else 0.0
            matrix[2, v, w] = matrix[1, v, w]
    solve(matrix[2], matrix[0])
    return whitened(matrix[1], delta[0], delta[1])


@kernel
def overlap(
    box: FloatArray, one: FloatArray, two: FloatArray, margin: float, periods: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The overlap of both sources' fields under every offset.

    box : (2, d) corners of the first field. one (n, d), two (s, k, d) : positions. margin : by which the second field
    extends beyond its records, in addition to their mean spacing. Fields cover the whole of a periodic axis.
    Returns the volume of the overlap (s,), the volumes of both fields (s, 2), and the records of each in the overlap
    (s, 2).
    """
    sets, many, d = two.shape
    volume, whole, inside = np.ones(sets), np.ones((sets, 2)), np.zeros((sets, 2))
    low, high = np.empty(d), np.empty(d)
    for s in range(sets):
        for v in range(d):
            low[v], high[v] = 0.0, periods[v]
            widths = (periods[v], periods[v])
            if periods[v] == np.inf:
                least, most = two[s, :, v].min(), two[s, :, v].max()
                more = (most - least) / max(many - 1, 1) + margin
                low[v], high[v] = max(least - more, box[0, v]), min(most + more, box[1, v])
                widths = (box[1, v] - box[0, v], most - least + 2.0 * more)
            whole[s, 0] *= widths[0]
            whole[s, 1] *= widths[1]
            volume[s] *= max(high[v] - low[v], 0.0)
        inside[s, 0], inside[s, 1] = number_within(one, low, high, periods), number_within(two[s], low, high, periods)
    return volume, whole, inside


@part
def number_within(points: FloatArray, low: FloatArray, high: FloatArray, periods: FloatArray) -> float:
    """Number of the points (n, d) in a box, which covers the whole of periodic axes."""
    number = 0.0
    for k in range(len(points)):
        within = True
        for v in range(points.shape[1]):
            if periods[v] == np.inf:
                within = within and low[v] <= points[k, v] <= high[v]
        number += within
    return number


@kernel
def messages(
    start: IntArray, i: IntArray, j: IntArray, log_weight: FloatArray, records: tuple[int, int], sweeps: int,
    tolerance: float,
) -> tuple[FloatArray, FloatArray, FloatArray]:  # fmt: skip
    """Sum-product messages under every offset: probabilities of pairs, and the sum over hypotheses.

    records : numbers of records of both sources. At most ``sweeps`` sweeps, fewer if no message changes by more than
    the relative ``tolerance``. Returns the probabilities (m,), the log of the sum over all hypotheses (s,) in Bethe's
    approximation, and the expected number of common objects (s,).
    """
    sets, m = len(start) - 1, len(i)
    share, log_sum, common = np.empty(m), np.zeros(sets), np.zeros(sets)
    weight, to_row, to_column = np.empty(m), np.ones(m), np.empty(m)
    by_row, by_column = np.empty(records[0]), np.empty(records[1])
    for e in range(m):
        weight[e] = math.exp(min(log_weight[e], 600.0))
        to_column[e] = weight[e]
    for s in range(sets):
        by_row[:], by_column[:] = 1.0, 1.0
        order, ends = by_component(i[start[s] : start[s + 1]], j[start[s] : start[s + 1]], records)
        for g in range(len(ends) - 1):
            pairs = start[s] + order[ends[g] : ends[g + 1]]
            exchange(pairs, i, j, weight, to_row, to_column, by_row, by_column, sweeps, tolerance)
        for a in range(records[0]):
            log_sum[s] += math.log(by_row[a])
        for b in range(records[1]):
            log_sum[s] += math.log(by_column[b])
        for e in range(start[s], start[s + 1]):
            log_sum[s] -= math.log1p(to_column[e] * to_row[e])
            share[e] = weight[e] * to_row[e] / by_row[i[e]]
            common[s] += share[e]
    return share, log_sum, common


@part
def by_component(i: IntArray, j: IntArray, records: tuple[int, int]) -> tuple[IntArray, IntArray]:
    """The pairs ordered by connected component, and the components' starts and end."""
    parent = np.empty(records[0] + records[1], np.int64)
    join(j, i, parent, records[1])
    number, count = np.full(len(parent), -1), 0
    sizes, order = np.zeros(len(j) + 1, np.int64), np.empty(len(j), np.int64)
    for e in range(len(j)):
        top = root(parent, j[e])
        if number[top] < 0:
            number[top] = count
            count += 1
        sizes[number[top] + 1] += 1
    ends = np.cumsum(sizes[: count + 1])
    to = ends.copy()
    for e in range(len(j)):
        g = number[root(parent, j[e])]
        order[to[g]] = e
        to[g] += 1
    return order, ends


@inlined
def exchange(
    pairs: IntArray, i: IntArray, j: IntArray, weight: FloatArray, to_row: FloatArray, to_column: FloatArray,
    by_row: FloatArray, by_column: FloatArray, sweeps: int, tolerance: float,
) -> None:  # fmt: skip
    """Iterate the messages of one component until they converge; writes the sums of its records."""
    for _ in range(sweeps):
        moving = False
        sum_by_row(pairs, i, weight, to_row, by_row)
        for e in pairs:
            new = weight[e] / (1.0 + max(by_row[i[e]] - 1.0 - weight[e] * to_row[e], 0.0))
            moving = moving or abs(new - to_column[e]) > 1e-9 + tolerance * new
            to_column[e] = new
        sum_by_column(pairs, j, to_column, by_column)
        for e in pairs:
            to_row[e] = 1.0 / (1.0 + max(by_column[j[e]] - 1.0 - to_column[e], 0.0))
        if not moving:
            break
    sum_by_row(pairs, i, weight, to_row, by_row)
    sum_by_column(pairs, j, to_column, by_column)


@inlined
def sum_by_row(pairs: IntArray, i: IntArray, weight: FloatArray, to_row: FloatArray, by_row: FloatArray) -> None:
    """Write for each record of the first source 1 (no partner) + the sum of these pairs' messages to it."""
    for e in pairs:
        by_row[i[e]] = 1.0
    for e in pairs:
        by_row[i[e]] += weight[e] * to_row[e]


@inlined
def sum_by_column(pairs: IntArray, j: IntArray, to_column: FloatArray, by_column: FloatArray) -> None:
    """Write for each record of the second source 1 (no partner) + the sum of these pairs' messages to it."""
    for e in pairs:
        by_column[j[e]] = 1.0
    for e in pairs:
        by_column[j[e]] += to_column[e]


@kernel
def score_and_information(
    s: IntArray, j: IntArray, residual: FloatArray, precision: FloatArray, weight: FloatArray, jacobian: FloatArray,
    min_weight: float,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """The score of the pairs at every offset: Σ w Jᵀ Σ⁻¹ Δ (s, p), and their information Σ w Jᵀ Σ⁻¹ J (s, p, p).

    s, j : (m,) offset and record of the second source of every pair. jacobian : (s, k, d, p). Pairs of weight up to
    ``min_weight`` are ignored.
    """
    sets, _, d, p = jacobian.shape
    score, information = np.zeros((sets, p)), np.zeros((sets, p, p))
    gradient = np.empty((d, p))
    for e in range(len(s)):
        if weight[e] <= min_weight:
            continue
        h = jacobian[s[e], j[e]]
        for v in range(d):
            for q in range(p):
                gradient[v, q] = 0.0
                for w in range(d):
                    gradient[v, q] += weight[e] * precision[e, v, w] * h[w, q]
        for q in range(p):
            for v in range(d):
                score[s[e], q] += gradient[v, q] * residual[e, v]
                for r in range(p):
                    information[s[e], q, r] += gradient[v, q] * h[v, r]
    return score, information


@kernel
def carried_errors(carried: FloatArray, covariance: FloatArray) -> FloatArray:
    """(s, k, d, d) A Σ Aᵀ, the errors Σ (k, d, d) of records propagated by A (s, k, d, d)."""
    sets, many, d, _ = carried.shape
    out = np.zeros((sets, many, d, d))
    half = np.empty((d, d))
    for s in range(sets):
        for k in range(many):
            for v in range(d):
                for w in range(d):
                    half[v, w] = 0.0
                    for t in range(d):
                        half[v, w] += carried[s, k, v, t] * covariance[k, t, w]
            for v in range(d):
                for w in range(d):
                    for t in range(d):
                        out[s, k, v, w] += half[v, t] * carried[s, k, w, t]
    return out


@kernel
def tally(
    one: FloatArray, two: FloatArray, periods: FloatArray, low: FloatArray, size: FloatArray, cells: IntArray
) -> FloatArray:
    """Number of differences of one (n, d) and two (k, d) in each cell of a grid, flattened.

    periods (d,) of the axes. low (d,) : corner of the first cell. size, cells (d,) : size and number of cells. The
    outermost cells stay empty, so that every cell with votes has neighbours.
    """
    votes = np.zeros(np.prod(cells))
    for b in range(len(two)):
        for a in range(len(one)):
            flat, inside = 0, True
            for v in range(len(periods)):
                at = math.floor((folded(one[a, v] - two[b, v], periods[v]) - low[v]) / size[v])
                inside = inside and 0 < at < cells[v] - 1
                flat = flat * cells[v] + at
            if inside:
                votes[flat] += 1.0
    return votes


@kernel
def blocks(votes: FloatArray, cell: IntArray, step: IntArray) -> FloatArray:
    """(k,) sum of the votes of the cells ``step`` (b,) away from each ``cell`` (k,) in the flattened grid."""
    out = np.zeros(len(cell))
    for k in range(len(cell)):
        for b in range(len(step)):
            out[k] += votes[cell[k] + step[b]]
    return out

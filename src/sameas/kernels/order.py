"""Compiled layout of the records of one source: by zone, then x, then their other content.

Records are distributed to zones. Then every zone, small enough for the processor's cache, is sorted: it is divided into
cells of x, a few for each record, and the few records that share a cell are sorted by comparison. The search later uses
the same cells to find its starting point.
"""

from __future__ import annotations

import math
from collections import namedtuple

import numpy as np

from sameas.arrays import FloatArray, Int32Array, IntArray
from sameas.kernels.compiled import part, small

#: A laid out source. guard : (n, 4) coordinates and variances, see ``order.into_zones``. content : covariances (n, p),
#: on a plane features and covariances (n, d + p), without rows if the guard has everything. rows : (n,).
Side = namedtuple("Side", "content guard rows")

#: Cells of a zone for each of its records: few enough for fast look-up, enough that few records share one.
CELLS = 2


@small
def extent(features: FloatArray) -> FloatArray:
    """(2, d) the smallest and the largest value of every feature."""
    ends = np.empty((2, features.shape[1]))
    for v in range(features.shape[1]):
        low = high = features[0, v]
        for k in range(1, len(features)):
            low = min(low, features[k, v])
            high = max(high, features[k, v])
        ends[0, v] = low
        ends[1, v] = high
    return ends


@small
def tally(
    features: FloatArray,
    axis_x: int,
    axis_y: int,
    low_x: float,
    low_y: float,
    per_x: float,
    per_y: float,
    counts: IntArray,
) -> None:
    """Add to ``counts`` (c, c) the number of records in each cell of a grid of per_x and per_y cells per unit."""
    last = len(counts) - 1.0
    for k in range(len(features)):
        x = min(max((features[k, axis_x] - low_x) * per_x, 0.0), last)
        y = min(max((features[k, axis_y] - low_y) * per_y, 0.0), last)
        counts[np.int64(x), np.int64(y)] += 1


@small
def zones_of(
    features: FloatArray, rows: Int32Array, axis_y: int, low: float, per_y: float, zone: Int32Array, ends: IntArray
) -> None:
    """Write the zone of each of the ``rows`` to ``zone`` (n,), and the starts of the zones to ``ends`` (z+1,).

    per_y : zones per unit of y."""
    last = len(ends) - 2.0
    ends[:] = 0
    for t in range(len(rows)):
        zone[t] = np.int32(min(max(np.floor((features[rows[t], axis_y] - low) * per_y), 0.0), last))
        ends[zone[t] + 1] += 1
    for z in range(1, len(ends)):
        ends[z] += ends[z - 1]


@small
def into_zones(
    features: FloatArray,
    variance: FloatArray,
    rows: Int32Array,
    axis_x: int,
    axis_y: int,
    zone: Int32Array,
    fill: IntArray,
    side: Side,
) -> None:
    """Write the ``rows`` and their guards to ``side`` (``order.Side``), zone by zone.

    The guard is x, y and the variances of x and y; on the sphere the third is later replaced by the cosine of y.
    variance (n, d), or (n, 1) for all axes. fill (z,) : the first place of every zone, advanced.
    """
    at_x, at_y = (axis_x, axis_y) if variance.shape[1] > 1 else (0, 0)
    guard = side.guard
    for t in range(len(rows)):
        row = rows[t]
        place = fill[zone[t]]
        fill[zone[t]] = place + 1
        side.rows[place] = row
        guard[place, 0] = features[row, axis_x]
        guard[place, 1] = features[row, axis_y]
        guard[place, 2] = variance[row, at_x]
        guard[place, 3] = variance[row, at_y]


@small
def into_cells(
    features: FloatArray,
    covariance: FloatArray,
    turning: bool,
    ends: IntArray,
    frame: tuple[float, float],
    rank: IntArray,
    base: int,
    grid: tuple[IntArray, Int32Array, FloatArray],
    side: Side,
) -> bool:
    """Sort every zone by x, then content, then ``rank`` (one for each row of features), and write its cells.

    ends (z+1,), side : results of :func:`zones_of` and :func:`into_zones`. frame : (low, extent) of x. grid : (first
    (z+1,), starts, scale (z,)) of ``spans.Grid``, written, with places from ``base`` on. Returns False if two records
    have the same content and ``rank`` is empty: call again with ranks.
    """
    first, starts, scale = grid
    x_low, x_extent = frame
    most = cut(ends, x_extent, first, scale)
    cell, order = np.empty(most, np.int32), np.empty(most, np.int32)
    fill = np.empty(most + 1, np.int32)
    guard, rows, cosine = np.empty((most, 4)), np.empty(most, np.int32), np.empty(most)
    sorted_ = True
    for z in range(len(scale)):
        low, high = ends[z], ends[z + 1]
        own = guard[: high - low]
        for t in range(high - low):
            rows[t] = side.rows[low + t]
            for v in range(4):
                own[t, v] = side.guard[low + t, v]
        cells = fill[: first[z + 1] - first[z] + 1]
        by_cell(own, x_low, scale[z], cell, cells, order)
        sorted_ &= sort_cells(features, covariance, rank, rows, own, cells, order)
        # ``cells`` are ends by now: each is the start of the next cell.
        starts[first[z]] = base + low
        for c in range(1, len(cells) - 1):
            starts[first[z] + c] = base + low + cells[c - 1]
        for t in range(high - low):
            k = order[t]
            side.rows[low + t] = rows[k]
            side.guard[low + t, 0], side.guard[low + t, 1] = own[k, 0], own[k, 1]
            side.guard[low + t, 2], side.guard[low + t, 3] = own[k, 2], own[k, 3]
        if turning:
            cosines(side.guard[low:high], cosine)
    starts[-1] = base + ends[-1]
    return sorted_


@part
def cut(ends: IntArray, x_extent: float, first: IntArray, scale: FloatArray) -> int:
    """Write the first cell of every zone to ``first`` (z+1,), its cells per unit to ``scale``; returns the largest
    number of cells of a zone."""
    first[0] = 0
    most = 0
    for z in range(len(scale)):
        number = CELLS * (ends[z + 1] - ends[z]) + 1
        first[z + 1] = first[z] + number
        scale[z] = number / x_extent
        most = max(most, number)
    return most


@part
def cosines(guard: FloatArray, cosine: FloatArray) -> None:
    """Write the cosine of y to the third column of ``guard``, through the contiguous ``cosine``, for vectorisation."""
    for t in range(len(guard)):
        cosine[t] = guard[t, 1]
    for t in range(len(guard)):
        cosine[t] = sine(90.0 - abs(cosine[t]))
    for t in range(len(guard)):
        guard[t, 2] = cosine[t]


@part
def by_cell(
    guard: FloatArray, x_low: float, scale: float, cell: Int32Array, fill: Int32Array, order: Int32Array
) -> None:
    """Write the numbers of a zone's records by cell to ``order``, and the ends of the cells to ``fill``."""
    n = len(guard)
    fill[:] = 0
    for t in range(n):
        cell[t] = cell_of((guard[t, 0] - x_low) * scale, len(fill) - 1)
    for t in range(n):
        fill[cell[t] + 1] += 1
    for c in range(len(fill) - 1):
        fill[c + 1] += fill[c]
    for t in range(n):
        place = fill[cell[t]]
        fill[cell[t]] = place + 1
        order[place] = t


@part
def cell_of(at: float, count: int) -> int:
    """The cell at a distance of ``at`` cells from the first one's edge, limited to the first and the last."""
    return np.int64(min(max(at, 0.0), count - 1.0))


@part
def sort_cells(
    features: FloatArray,
    covariance: FloatArray,
    rank: IntArray,
    rows: Int32Array,
    guard: FloatArray,
    ends: Int32Array,
    order: Int32Array,
) -> bool:
    """Sort the records of a zone that share a cell; see :func:`into_cells`."""
    start = 0
    for c in range(len(ends) - 1):
        stop = ends[c]
        if stop - start > 1 and not sort_run(features, covariance, rank, rows, guard, order[start:stop]):
            return False
        start = stop
    return True


@part
def sort_run(
    features: FloatArray, covariance: FloatArray, rank: IntArray, rows: Int32Array, guard: FloatArray, order: Int32Array
) -> bool:
    """Sort the numbers of records by x, content and rank (Shell sort); False for a tie without ranks."""
    gap = np.int64(1)
    while 9 * gap < len(order):
        gap = 3 * gap + 1
    while gap > 0:
        for k in range(gap, len(order)):
            one = order[k]
            t = k
            while t >= gap:
                other = order[t - gap]
                if guard[other, 0] < guard[one, 0]:
                    break
                if guard[other, 0] == guard[one, 0]:
                    before = precedes(features, covariance, rank, rows[other], rows[one])
                    if before == 0:
                        order[t] = one
                        return False
                    if before > 0:
                        break
                order[t] = other
                t -= gap
            order[t] = one
        gap //= 3
    return True


@part
def precedes(features: FloatArray, covariance: FloatArray, rank: IntArray, a: int, b: int) -> int:
    """1 if row a comes before row b, −1 if after, 0 if both have the same content and there is no rank."""
    for v in range(features.shape[1]):
        if features[a, v] != features[b, v]:
            return 1 if features[a, v] < features[b, v] else -1
    for v in range(covariance.shape[1]):
        if covariance[a, v] != covariance[b, v]:
            return 1 if covariance[a, v] < covariance[b, v] else -1
    if len(rank) == 0:
        return 0
    return 1 if rank[a] < rank[b] else -1


@small
def take_rows(features: FloatArray, covariance: FloatArray, rows: Int32Array, content: FloatArray) -> None:
    """Write features, if ``content`` has columns for them, and covariances of the rows to ``content``."""
    p = covariance.shape[1]
    copied = content.shape[1] - p
    if copied == 0 and p == 3:
        # Without inner loops, so that memory is read for many rows at once.
        for k in range(len(content)):
            row = rows[k]
            content[k, 0], content[k, 1], content[k, 2] = covariance[row, 0], covariance[row, 1], covariance[row, 2]
        return
    for k in range(len(content)):
        for v in range(copied):
            content[k, v] = features[rows[k], v]
        for v in range(p):
            content[k, copied + v] = covariance[rows[k], v]


@part
def sine(degrees: float) -> float:
    """The sine of 0 … 90°, by its series: the library's would take as long as the rest of the loop."""
    x = degrees * (math.pi / 180.0)
    z = x * x
    total = 1.0 / 51090942171709440000.0
    total = 1.0 / 121645100408832000.0 - z * total
    total = 1.0 / 355687428096000.0 - z * total
    total = 1.0 / 1307674368000.0 - z * total
    total = 1.0 / 6227020800.0 - z * total
    total = 1.0 / 39916800.0 - z * total
    total = 1.0 / 362880.0 - z * total
    total = 1.0 / 5040.0 - z * total
    total = 1.0 / 120.0 - z * total
    total = 1.0 / 6.0 - z * total
    return x - x * z * total


@small
def widest(covariance: FloatArray, out: FloatArray) -> None:
    """Write to ``out`` (n, 1) the largest variance in any direction of packed covariances (n, 3)."""
    for k in range(len(covariance)):
        xx, xy, yy = covariance[k, 0], covariance[k, 1], covariance[k, 2]
        out[k, 0] = 0.5 * (xx + yy) + math.sqrt(0.25 * (xx - yy) * (xx - yy) + xy * xy)


@small
def merge_rows(
    one: IntArray, other: IntArray, number: IntArray, time_s: FloatArray, serial: IntArray, merged: IntArray
) -> None:
    """Merge two lists of rows, both sorted by number, then time, then serial number. number, time_s, serial : (n,) of
    all rows."""
    a = b = 0
    for k in range(len(merged)):
        if b == len(other):
            first = True
        elif a == len(one):
            first = False
        else:
            r, s = one[a], other[b]
            first = number[r] < number[s]
            if number[r] == number[s]:
                first = time_s[r] < time_s[s] or (time_s[r] == time_s[s] and serial[r] < serial[s])
        if first:
            merged[k] = one[a]
            a += 1
        else:
            merged[k] = other[b]
            b += 1

"""Compiled layout of the records of one source: by zone, then x, then the rest of what they say.

Records are dealt into zones; then every zone, small enough to stay in the processor's memory, is put in order by
itself: it is cut into cells of x, some for every record, and the few records that share a cell are sorted one by one.
The same cells tell the search later where to look.
"""

from __future__ import annotations

import math
from collections import namedtuple

import numpy as np

from sameas.arrays import FloatArray, Int32Array, IntArray
from sameas.kernels.compiled import part, small

#: A source as it is laid out: guard (n, 4; see ``order.into_zones``); content, the covariance (n, p), on a plane after
#: the features (n, d + p), without rows where the guard says it all; rows (n,).
Side = namedtuple("Side", "content guard rows")

#: Cells of a zone for each of its records: few enough to be looked up fast, enough that few records share one.
CELLS = 2


@small
def extent(features: FloatArray) -> FloatArray:
    """(2, d) the least and the greatest value of every feature."""
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
    """Add to ``counts`` (c, c) how many records lie in each square of a grid of so many squares per unit."""
    last = len(counts) - 1.0
    for k in range(len(features)):
        x = min(max((features[k, axis_x] - low_x) * per_x, 0.0), last)
        y = min(max((features[k, axis_y] - low_y) * per_y, 0.0), last)
        counts[np.int64(x), np.int64(y)] += 1


@small
def zones_of(
    features: FloatArray, rows: Int32Array, axis_y: int, low: float, per_y: float, zone: Int32Array, ends: IntArray
) -> None:
    """Fill ``zone`` (n,) with the zone of each of the ``rows``, ends (z+1,) with how many lie in those before each.

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

    The guard holds x, y and the variances in x and in y; on the sphere the third is to become the cosine of y.
    variance (n, d), or (n, 1) for all axes. fill (z,) : the first place of every zone.
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
    """Put every zone in order by x, then content, then ``rank`` (one for each row of features), and note its cells.

    ends (z+1,), side : what :func:`zones_of` and :func:`into_zones` gave. frame : (low, extent) of x. grid : (first
    (z+1,), starts, scale (z,)) of ``spans.Grid``, to be filled, with places from ``base`` on. Returns False where two
    records say the same and ``rank`` is empty: call again with it.
    """
    first, starts, scale = grid
    x_low, x_extent = frame
    most = cut(ends, x_extent, first, scale)
    cell, order = np.empty(most, np.int32), np.empty(most, np.int32)
    fill = np.empty(most + 1, np.int32)
    guard, rows, cosine = np.empty((most, 4)), np.empty(most, np.int32), np.empty(most)
    settled = True
    for z in range(len(scale)):
        low, high = ends[z], ends[z + 1]
        here = guard[: high - low]
        for t in range(high - low):
            rows[t] = side.rows[low + t]
            for v in range(4):
                here[t, v] = side.guard[low + t, v]
        cells = fill[: first[z + 1] - first[z] + 1]
        by_cell(here, x_low, scale[z], cell, cells, order)
        settled &= sort_cells(features, covariance, rank, rows, here, cells, order)
        # Every cell has been filled up to where the next one starts.
        starts[first[z]] = base + low
        for c in range(1, len(cells) - 1):
            starts[first[z] + c] = base + low + cells[c - 1]
        for t in range(high - low):
            k = order[t]
            side.rows[low + t] = rows[k]
            side.guard[low + t, 0], side.guard[low + t, 1] = here[k, 0], here[k, 1]
            side.guard[low + t, 2], side.guard[low + t, 3] = here[k, 2], here[k, 3]
        if turning:
            cosines(side.guard[low:high], cosine)
    starts[-1] = base + ends[-1]
    return settled


@part
def cut(ends: IntArray, x_extent: float, first: IntArray, scale: FloatArray) -> int:
    """Fill ``first`` (z+1,) with the first cell of every zone, ``scale`` with its cells per unit; returns the most."""
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
    """Write the cosine of y to the third column of ``guard``; by way of ``cosine``, to work on many at once."""
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
    """Fill ``order`` with the numbers of a zone's records cell by cell, ``fill`` with where the cells end."""
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
    """The cell of a zone at so many cells from the first one's edge; beyond the first and the last, those."""
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
    """Put the records of a zone that share a cell in order; see :func:`into_cells`."""
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
    """Sort the numbers of a few records, or of many, by x, content and rank: Shell's sort."""
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
    """1 where row a comes before row b; −1 where after; 0 where both say the same and there is no rank."""
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
    """Fill ``content`` with features, where there is room for them, and covariance of the rows."""
    p = covariance.shape[1]
    copied = content.shape[1] - p
    if copied == 0 and p == 3:
        # So bare that the memory is asked for many rows at once.
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
    """The sine of 0 … 90°, by its series: the library's takes as long as the rest of the loop."""
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
    """Fill ``out`` (n, 1) with the largest variance in any direction of packed covariances (n, 3)."""
    for k in range(len(covariance)):
        xx, xy, yy = covariance[k, 0], covariance[k, 1], covariance[k, 2]
        out[k, 0] = 0.5 * (xx + yy) + math.sqrt(0.25 * (xx - yy) * (xx - yy) + xy * xy)


@small
def merge_rows(
    one: IntArray, other: IntArray, number: IntArray, time_s: FloatArray, serial: IntArray, merged: IntArray
) -> None:
    """Writes the rows of two lists as one in the order of their numbers, then times, then serial numbers, in which
    both lists are. number, time_s, serial : (n,) of all rows."""
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

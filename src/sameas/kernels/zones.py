"""Compiled layout of the records of one source by zone and x, and look-up of the pairs near enough for the gate.

Layout: records are distributed to zones. Then every zone, small enough for the processor's cache, is sorted: it is
divided into cells of x, a few for each record, and the few records that share a cell are sorted by comparison.

Look-up: the possible partners of a record are in the zones within reach of its own error and the largest of the
others, and there within a window of x. The cells of a zone give the ends of this stretch directly; if many records
share a cell, they are found by bisection.

``folds`` below are the periods of x and y on a plane, infinite for none, and None on the sphere.
"""

from __future__ import annotations

import math
from collections import namedtuple

import numpy as np

from sameas.arrays import ByteArray, FloatArray, Int32Array, IntArray
from sameas.kernels.compiled import borrowing_part, small

#: A laid out source. guard : (n, 4) coordinates and variances, see :func:`into_zones`. content : covariances (n, p),
#: on a plane features and covariances (n, d + p), without rows if the guard has everything. rows : (n,).
Side = namedtuple("Side", "content guard rows")

#: Cells of a zone for each of its records: few enough for fast look-up, enough that few records share one.
CELLS = 2

#: One class of a laid out source: the first cell of every zone, the first record of every cell, cells per unit of x in
#: every zone, x of the first cell's edge, y of the first zone's edge, zones per unit of y, whether zones form a ring.
Grid = namedtuple("Grid", "first starts scale low_x low_y per_y wraps")

#: Reach of records into a grid: squared reach for a variance of 1; the largest variances in x and in y there;
#: ``stretch`` (zones,) the half width of the window per unit of reach; the place from which on records have only the
#: listed pairs.
Reach = namedtuple("Reach", "opening widest_x widest_y stretch end")

#: Pairs that are looked up before they are tested.
ROOM = 4096
#: A stretch with more records than this in each cell on average is narrowed to the window itself.
CROWDED = 4
#: Stretches of fewer records than this are tested record by record.
LONG = 24


# Layout.


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
    features: FloatArray, axis_x: int, axis_y: int, low_x: float, low_y: float, per_x: float, per_y: float,
    counts: IntArray,
) -> None:  # fmt: skip
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
    features: FloatArray, variance: FloatArray, rows: Int32Array, axis_x: int, axis_y: int, zone: Int32Array,
    fill: IntArray, side: Side,
) -> None:  # fmt: skip
    """Write the ``rows`` and their guards to ``side`` (:data:`Side`), zone by zone.

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
    features: FloatArray, covariance: FloatArray, turning: bool, ends: IntArray, frame: tuple[float, float],
    rank: IntArray, base: int, grid: tuple[IntArray, Int32Array, FloatArray], side: Side,
) -> bool:  # fmt: skip
    """Sort every zone by x, then content, then ``rank`` (one for each row of features), and write its cells.

    ends (z+1,), side : results of :func:`zones_of` and :func:`into_zones`. frame : (low, extent) of x. grid : (first
    (z+1,), starts, scale (z,)) of :data:`Grid`, written, with places from ``base`` on. Returns False if two records
    have the same content and ``rank`` is empty: call again with ranks.
    """
    x_low, x_extent = frame
    most = cut(ends, x_extent, grid[0], grid[2])
    cell, order = np.empty(most, np.int32), np.empty(most, np.int32)
    fill = np.empty(most + 1, np.int32)
    guard, rows, cosine = np.empty((most, 4)), np.empty(most, np.int32), np.empty(most)
    workspace = cell, order, fill, guard, rows, cosine
    return _into_cells(features, covariance, turning, ends, x_low, rank, base, grid, side, workspace)


@borrowing_part
def _into_cells(
    features: FloatArray, covariance: FloatArray, turning: bool, ends: IntArray, x_low: float, rank: IntArray,
    base: int, grid: tuple[IntArray, Int32Array, FloatArray], side: Side,
    workspace: tuple[Int32Array | FloatArray, ...],
) -> bool:  # fmt: skip
    """:func:`into_cells` with a workspace for the largest zone."""
    first, starts, scale = grid
    cell, order, fill, guard, rows, cosine = workspace
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


@borrowing_part
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


@borrowing_part
def cosines(guard: FloatArray, cosine: FloatArray) -> None:
    """Write the cosine of y to the third column of ``guard``, through the contiguous ``cosine``, for vectorisation."""
    for t in range(len(guard)):
        cosine[t] = guard[t, 1]
    for t in range(len(guard)):
        cosine[t] = sine(90.0 - abs(cosine[t]))
    for t in range(len(guard)):
        guard[t, 2] = cosine[t]


@borrowing_part
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


@borrowing_part
def cell_of(at: float, count: int) -> int:
    """The cell at a distance of ``at`` cells from the first one's edge, limited to the first and the last."""
    return np.int64(min(max(at, 0.0), count - 1.0))


@borrowing_part
def sort_cells(
    features: FloatArray, covariance: FloatArray, rank: IntArray, rows: Int32Array, guard: FloatArray,
    ends: Int32Array, order: Int32Array,
) -> bool:  # fmt: skip
    """Sort the records of a zone that share a cell; see :func:`into_cells`."""
    start = 0
    for c in range(len(ends) - 1):
        stop = ends[c]
        if stop - start > 1 and not sort_run(features, covariance, rank, rows, guard, order[start:stop]):
            return False
        start = stop
    return True


@borrowing_part
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


@borrowing_part
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


@borrowing_part
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


# Look-up.


@borrowing_part
def folded(value: float, period: float) -> float:
    """A difference reduced to half a period either way."""
    return value - period * math.floor(value / period + 0.5) if period < np.inf else value


@borrowing_part
def first_from(guard: FloatArray, start: int, stop: int, x: float) -> int:
    """The first of the records start … stop − 1 of a zone that is not before x, or stop."""
    while start < stop:
        middle = (start + stop) // 2
        if guard[middle, 0] < x:
            start = middle + 1
        else:
            stop = middle
    return start


@borrowing_part
def zones_within(grid: Grid, y: float, reach: float) -> tuple[int, int]:
    """(first, last) zone within reach of y; on a ring, numbers continue beyond its ends."""
    last = len(grid.scale) - 1.0
    if grid.wraps:
        reach += 1e-12 * (last + 1.0) / grid.per_y
    bottom = np.floor((y - reach - grid.low_y) * grid.per_y)
    top = np.floor((y + reach - grid.low_y) * grid.per_y)
    if not grid.wraps:
        return np.int64(min(max(bottom, 0.0), last)), np.int64(min(max(top, 0.0), last))
    if top - bottom >= last:
        return np.int64(0), np.int64(last)
    return np.int64(bottom), np.int64(top)


@borrowing_part
def inside(grid: Grid, guard: FloatArray, zone: int, x: float, window: float) -> tuple[int, int]:
    """(low, high) of the stretch of a zone that contains the window x ± window, and perhaps some more records."""
    first = np.uint64(grid.first[zone])
    number = grid.first[zone + 1] - grid.first[zone]
    left = first + np.uint64(cell_of((x - window - grid.low_x) * grid.scale[zone], number))
    right = first + np.uint64(cell_of((x + window - grid.low_x) * grid.scale[zone], number) + 1)
    low, high = np.int64(grid.starts[left]), np.int64(grid.starts[right])
    if high - low > CROWDED * np.int64(right - left):
        low = first_from(guard, low, high, x - window)
        high = first_from(guard, low, high, np.nextafter(x + window, np.inf))
    return low, high


@borrowing_part
def across(
    grid: Grid, guard: FloatArray, zone: int, x: float, window: float, folds: tuple[float, float] | None
) -> tuple[int, ...]:
    """(low, high) of the two stretches of a zone within a window across the period's end, or of the whole zone."""
    period = 360.0 if folds is None else folds[0]
    start, stop = np.int64(grid.starts[grid.first[zone]]), np.int64(grid.starts[grid.first[zone + 1]])
    if 2.0 * window >= period:
        return start, stop, stop, stop
    if x >= window:
        x -= period
    low = first_from(guard, start, stop, np.nextafter(x + window, np.inf))
    return start, low, first_from(guard, low, stop, x - window + period), stop


@borrowing_part
def reach_of_record(
    one: Side, grid: Grid, reach: Reach, folds: tuple[float, float] | None, k: int
) -> tuple[bool | float | int, ...]:
    """Reach of record k: first and last zone, half width of the window, opening, whether it crosses the period end."""
    reach_y = math.sqrt(reach.opening * (one.guard[k, 3] + reach.widest_y))
    bottom, top = zones_within(grid, one.guard[k, 1], reach_y)
    x = one.guard[k, 0]
    if folds is None:
        # Wider nearer to a pole.
        window = reach_y * max(reach.stretch[bottom], reach.stretch[top])
        # hav s = hav Δδ + cos δ₁ cos δ₂ hav Δα, and hav x ≥ (x/2)² (1 − 1e-4) below 1°; beyond, all count as near.
        opening = reach.opening / (1.0 - 1e-4) if window < 1.0 else np.inf
        return bottom, top, window, opening, x < window or x + window >= 360.0
    window = math.sqrt(reach.opening * (one.guard[k, 2] + reach.widest_x))
    return bottom, top, window, reach.opening, folds[0] < np.inf and (x < window or x + window >= folds[0])


@borrowing_part
def near(
    one: Side, two: Side, grid: Grid, reach: Reach, folds: tuple[float, float] | None, listed: IntArray,
    at: tuple[int, ...], last: int, room: tuple[Int32Array, Int32Array, ByteArray],
) -> tuple[int, tuple[int, ...]]:  # fmt: skip
    """Write near pairs to of1, of2, of the records from ``at`` on, as many as fit.

    at : (k, zones of k done, records of the next zone done, pairs of ``listed`` done). listed : further pairs
    k << 32 | q, sorted, which follow those of the grid. room : (of1, of2, passes), of the same length. Returns the
    number of pairs, 0 at the end, and the new ``at``.
    """
    of1, of2, _ = room
    k, done, skip, e = at
    count = np.int64(0)
    while True:
        while e < len(listed) and listed[e] >> 32 < k and count < len(of1):
            of1[count], of2[count] = listed[e] >> 32, listed[e] & 0xFFFFFFFF
            count += 1
            e += 1
        if k >= last or count == len(of1):
            return count, (k, done, skip, e)
        if k >= reach.end:
            k += 1
            continue
        x, y, a, b = one.guard[k, 0], one.guard[k, 1], one.guard[k, 2], one.guard[k, 3]
        bottom, top, window, opening, crosses = reach_of_record(one, grid, reach, folds, k)
        for zone in range(bottom + done, top + 1):
            ring = zone % len(grid.scale) if grid.wraps else zone
            p, q = inside(grid, two.guard, ring, x, window)
            if not crosses and skip == 0 and q - p < LONG and q - p < len(of1) - count:
                # Unsigned, so that indices need no test for negative values.
                free = np.uint64(count)
                for c in range(np.uint64(p), np.uint64(q)):
                    of1[free], of2[free] = k, c
                    free += np.uint64(is_near(two.guard, c, x, y, a, b, opening, folds))
                count = np.int64(free)
                continue
            ends = across(grid, two.guard, ring, x, window, folds) if crosses else (p, q, q, q)
            count, skip = piecewise(one.guard, two.guard, folds, opening, k, ends, skip, room, count)
            if skip > 0:
                return count, (k, zone - bottom, skip - 1, e)
        k += 1
        done = 0


@borrowing_part
def piecewise(
    guard1: FloatArray, guard2: FloatArray, folds: tuple[float, float] | None, opening: float, k: int,
    ends: tuple[int, ...], skip: int, room: tuple[Int32Array, Int32Array, ByteArray], count: int,
) -> tuple[int, int]:  # fmt: skip
    """Add the near pairs of two stretches, from their record ``skip`` on; returns (pairs, 0), or (pairs, 1 + records
    done) if of1 is full before their end. Stretches longer than of1 are done in pieces.
    """
    p, q, r, s = ends
    both = q - p + s - r
    while skip < both and (count == 0 or both - skip <= len(room[0]) - count):
        low, high = (p + skip, q) if skip < q - p else (r + skip - (q - p), s)
        high = min(high, low + len(room[0]) - count)
        skip += high - low
        count = near_in(guard1, guard2, folds, opening, k, low, high, room, count)
    return (count, skip + 1) if skip < both else (count, np.int64(0))


@borrowing_part
def near_in(
    guard1: FloatArray, guard2: FloatArray, folds: tuple[float, float] | None, opening: float, k: int, low: int,
    high: int, room: tuple[Int32Array, Int32Array, ByteArray], count: int,
) -> int:  # fmt: skip
    """Add to of1, of2 the records low ≤ c < high near to k; returns the number of pairs."""
    of1, of2, passes = room
    x, y, a, b = guard1[k, 0], guard1[k, 1], guard1[k, 2], guard1[k, 3]
    if folds is None:
        # A stretch is on one side of the period's end.
        x -= 360.0 if x - guard2[low, 0] > 180.0 else (-360.0 if x - guard2[low, 0] < -180.0 else 0.0)
    # In two steps, of which the first is vectorised.
    guard = guard2[low:high]
    for t in range(len(guard)):
        passes[t] = is_near(guard, t, x, y, a, b, opening, folds)
    for t in range(len(guard)):
        of1[count], of2[count] = k, low + t
        count += passes[t]
    return count


@borrowing_part
def is_near(
    guard: FloatArray, c: int, x: float, y: float, a: float, b: float, opening: float, folds: tuple[float, float] | None
) -> bool:
    """Whether a record is near to one of guard (x, y, a, b); this is so for every pair that passes the gate."""
    if folds is None:
        dlat = y - guard[c, 1]
        dlon = x - guard[c, 0]
        return dlat * dlat + a * guard[c, 2] * dlon * dlon <= opening * (b + guard[c, 3])
    dx = folded(x - guard[c, 0], folds[0])
    dy = folded(y - guard[c, 1], folds[1])
    return (dx * dx <= opening * (a + guard[c, 2])) & (dy * dy <= opening * (b + guard[c, 3]))


@small
def visit(
    one: Side, two: Side, grid: Grid, reach: Reach, folds: tuple[float, float] | None, first: int, last: int,
    out: tuple[IntArray, ...],
) -> tuple[int, int]:  # fmt: skip
    """Write to out[0] the near pairs of the records ``first`` ≤ k < ``last`` with those of a grid, as k << 32 | q.

    Returns (pairs written, next k); next k < last if out[0] is full.
    """
    pairs, listed = out[0], np.empty(0, np.int64)
    room = np.empty(ROOM, np.int32), np.empty(ROOM, np.int32), np.empty(ROOM, np.uint8)
    count = np.int64(0)
    at = (np.int64(first), np.int64(0), np.int64(0), np.int64(0))
    while True:
        found, at = near(one, two, grid, reach, folds, listed, at, last, room)
        if found == 0:
            return count, last
        if count + found > len(pairs):
            k = np.int64(room[0][0])
            while count > 0 and pairs[count - 1] >> 32 == k:
                count -= 1
            return count, k
        for t in range(found):
            pairs[count + t] = (np.int64(room[0][t]) << 32) | np.int64(room[1][t])
        count += found


@borrowing_part
def count_without(place1: Int32Array, count: int, k: int) -> int:
    """The number of candidates without those of record k, which are the last."""
    while count > 0 and place1[count - 1] == k:
        count -= 1
    return count

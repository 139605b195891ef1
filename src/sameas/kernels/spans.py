"""Compiled look-up of the pairs of two sources that are near enough to be tested by the gate.

Records are laid out by zone and x (``order.py``). The possible partners of a record are in the zones within reach of
its own error and the largest of the others, and there within a window of x. The cells of a zone give the ends of this
stretch directly; if many records share a cell, they are found by bisection.

``folds`` below are the periods of x and y on a plane, infinite for none, and None on the sphere.
"""

from __future__ import annotations

import math
from collections import namedtuple

import numpy as np

from sameas.arrays import ByteArray, FloatArray, Int32Array, IntArray
from sameas.kernels.compiled import part, small
from sameas.kernels.order import Side, cell_of

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


@part
def folded(value: float, period: float) -> float:
    """A difference reduced to half a period either way."""
    return value - period * math.floor(value / period + 0.5) if period < np.inf else value


@part
def first_from(guard: FloatArray, start: int, stop: int, x: float) -> int:
    """The first of the records start … stop − 1 of a zone that is not before x, or stop."""
    while start < stop:
        middle = (start + stop) // 2
        if guard[middle, 0] < x:
            start = middle + 1
        else:
            stop = middle
    return start


@part
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


@part
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


@part
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


@part
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


@part
def near(
    one: Side,
    two: Side,
    grid: Grid,
    reach: Reach,
    folds: tuple[float, float] | None,
    listed: IntArray,
    at: tuple[int, ...],
    last: int,
    room: tuple[Int32Array, Int32Array, ByteArray],
) -> tuple[int, tuple[int, ...]]:
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
            if not crosses and skip == 0 and q - p < min(LONG, len(of1) - count):
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


@part
def piecewise(
    guard1: FloatArray,
    guard2: FloatArray,
    folds: tuple[float, float] | None,
    opening: float,
    k: int,
    ends: tuple[int, ...],
    skip: int,
    room: tuple[Int32Array, Int32Array, ByteArray],
    count: int,
) -> tuple[int, int]:
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


@part
def near_in(
    guard1: FloatArray,
    guard2: FloatArray,
    folds: tuple[float, float] | None,
    opening: float,
    k: int,
    low: int,
    high: int,
    room: tuple[Int32Array, Int32Array, ByteArray],
    count: int,
) -> int:
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


@part
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


@small
def turned_round(pairs: IntArray, starts: IntArray, out: IntArray) -> None:
    """Write sorted pairs k << 32 | q to ``out`` as q << 32 | k, sorted. starts : zeros, one more than there are q."""
    for e in range(len(pairs)):
        starts[(pairs[e] & 0xFFFFFFFF) + 1] += 1
    for q in range(len(starts) - 1):
        starts[q + 1] += starts[q]
    for e in range(len(pairs)):
        q = pairs[e] & 0xFFFFFFFF
        out[starts[q]] = (q << 32) | (pairs[e] >> 32)
        starts[q] += 1


@part
def taken_back(place1: Int32Array, count: int, k: int) -> int:
    """The number of candidates without those of record k, which are the last."""
    while count > 0 and place1[count - 1] == k:
        count -= 1
    return count

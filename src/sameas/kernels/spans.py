"""Compiled look-up of the pairs of two sources that lie near enough to be measured.

Records are laid out by zone and x (``order.py``). What a record may be with lies in the zones that its own error and
the largest of the others reach, and there within a window of x. The cells of a zone give the ends of a stretch at once,
and a search among its records where many share a cell.

``folds`` below are the periods of x and y on a plane, infinite where there is none, and None on the sphere.
"""

from __future__ import annotations

import math
from collections import namedtuple

import numpy as np

from sameas.arrays import ByteArray, FloatArray, Int32Array, IntArray
from sameas.kernels.compiled import part, small
from sameas.kernels.order import Side, cell_of

#: One class of a source, laid out: the first cell of every zone, the first record of every cell, cells per unit of x in
#: every zone, x of the first cell's edge; y of the first zone's edge and zones per unit of y,
#: whether they close to a ring.
Grid = namedtuple("Grid", "first starts scale low_x low_y per_y wraps")

#: How far records reach into a grid: what a variance of one opens, squared; the largest variances in x and in y there;
#: ``stretch`` (zones,) the half width of the window per unit of reach; and the place from which on records do not
#: reach into it, but have only the pairs that are listed.
Reach = namedtuple("Reach", "opening widest_x widest_y stretch end")

#: Pairs that are looked up before they are measured.
ROOM = 4096
#: Where the cells of a stretch hold more records than this each, it is cut to the window itself.
CROWDED = 4
#: Stretches of fewer records than this are tested one by one.
LONG = 24


@part
def folded(value: float, period: float) -> float:
    """A difference of two angles within half a period."""
    return value - period * math.floor(value / period + 0.5) if period < np.inf else value


@part
def first_from(guard: FloatArray, start: int, stop: int, x: float) -> int:
    """The first of the records start … stop − 1 of a zone that does not lie before x, or stop."""
    while start < stop:
        middle = (start + stop) // 2
        if guard[middle, 0] < x:
            start = middle + 1
        else:
            stop = middle
    return start


@part
def zones_within(grid: Grid, y: float, reach: float) -> tuple[int, int]:
    """(first, last) zone within reach of y; those of a ring are counted on beyond either end of it."""
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
    """(low, high) of the stretch of a zone within a window of x, and perhaps some more."""
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
    """(low, high) twice of the stretches of a zone within a window that reaches over the period's end, or all round."""
    period = 360.0 if folds is None else folds[0]
    start, stop = np.int64(grid.starts[grid.first[zone]]), np.int64(grid.starts[grid.first[zone + 1]])
    if 2.0 * window >= period:
        return start, stop, stop, stop
    if x >= window:
        x -= period
    low = first_from(guard, start, stop, np.nextafter(x + window, np.inf))
    return start, low, first_from(guard, low, stop, x - window + period), stop


@part
def around(
    one: Side, grid: Grid, reach: Reach, folds: tuple[float, float] | None, k: int
) -> tuple[bool | float | int, ...]:
    """What record k reaches: (first and last zone, half width of the window, opening, whether it crosses a period)."""
    reach_y = math.sqrt(reach.opening * (one.guard[k, 3] + reach.widest_y))
    bottom, top = zones_within(grid, one.guard[k, 1], reach_y)
    x = one.guard[k, 0]
    if folds is None:
        # The nearer a pole, the wider.
        window = reach_y * max(reach.stretch[bottom], reach.stretch[top])
        # hav s = hav Δδ + cos δ₁ cos δ₂ hav Δα, and hav x ≥ (x/2)² (1 − 1e-4) below a degree; beyond, all are near.
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
    """Fill of1, of2 with pairs near enough to be measured, of the records from ``at`` on, as many as fit.

    at : (k, zones of k done, records of the next one done, pairs of ``listed`` done). listed : further pairs
    k << 32 | q, sorted, which follow what the grid gives. room : (of1, of2, passes), as long as each other.
    Returns (pairs, at); at the end none.
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
        bottom, top, window, opening, crosses = around(one, grid, reach, folds, k)
        for zone in range(bottom + done, top + 1):
            ring = zone % len(grid.scale) if grid.wraps else zone
            p, q = inside(grid, two.guard, ring, x, window)
            if not crosses and skip == 0 and q - p < min(LONG, len(of1) - count):
                # Numbers without a sign, so that no index has to be looked at for counting from the end.
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
    """Two stretches, one after the other, from record ``skip`` of them on; returns (pairs, 0), or, when of1 is full
    before their end, (pairs, 1 + records done).

    Piece by piece: what is longer than the room fits in it when it is empty.
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
    """Add to of1, of2 the records low ≤ c < high that lie near enough to k; returns the number of pairs."""
    of1, of2, passes = room
    x, y, a, b = guard1[k, 0], guard1[k, 1], guard1[k, 2], guard1[k, 3]
    if folds is None:
        # All of a stretch lies on the same side of the period's end.
        x -= 360.0 if x - guard2[low, 0] > 180.0 else (-360.0 if x - guard2[low, 0] < -180.0 else 0.0)
    # In two steps, of which the first works on many at once.
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
    """Whether a record lies near (x, y), of which the guard says also (a, b): all that the gate lets pass do."""
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
    """Pairs near enough of the records ``first`` ≤ k < ``last`` of one with what lies in a grid of two, as k << 32 | q.

    Written into out[0]; returns (pairs written, next k): next k < last when it is full.
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
    """Fill ``out`` with sorted pairs k << 32 | q as q << 32 | k, sorted. starts : zeros, one more than there are q."""
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
    """The number of candidates before those of record k, which are the last ones."""
    while count > 0 and place1[count - 1] == k:
        count -= 1
    return count

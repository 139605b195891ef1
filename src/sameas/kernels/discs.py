"""Compiled discs (intervals, balls) over sorted points: which are empty, and what lies in those that are.

Points are (n, axes), in lists of cells (n, 3) with unused axes zero, wrapped into their period where an axis has one.
They are sorted into the buckets of a grid: a cell's number modulo the size of the table, so that a grid needs no more
room than its points, however wide it is. Buckets may hold points of several cells; every point is asked for its own.
"""

from __future__ import annotations

import math

import numpy as np

from sameas.kernels.compiled import kernel, part


@part
def cell_of(x, low, side, number, period):
    """The cell along one axis; the last of a period takes what rounding puts beyond it."""
    cell = math.floor((x - low) / side)
    return min(cell, number - 1) if period < np.inf else cell


@part
def bucket_of(i, j, k, number, mask):
    """Where the points of a cell are kept."""
    return ((i * number[1] + j) * number[2] + k) & mask


@part
def along(x, low, side, number, period, radius):
    """(first, last) cell along one axis that a disc around ``x`` reaches; in a period they may lie outside it."""
    if period < np.inf and 2.0 * radius + 2.0 * side >= period:
        return 0, number - 1
    return math.floor((x - radius - low) / side), math.floor((x + radius - low) / side)


@part
def reach_of(centres, c, radius, low, side, number, period):
    """The same along three axes of a disc around a centre."""
    return (
        along(centres[c, 0], low[0], side[0], number[0], period[0], radius),
        along(centres[c, 1], low[1], side[1], number[1], period[1], radius),
        along(centres[c, 2], low[2], side[2], number[2], period[2], radius),
    )


@part
def turned(cell, number, period):
    """A cell brought into its period."""
    return cell % number if period < np.inf else cell


@part
def turned_round(i, j, k, number, period):
    """The same along three axes."""
    return turned(i, number[0], period[0]), turned(j, number[1], period[1]), turned(k, number[2], period[2])


@part
def apart_sq(points, p, centres, c, period):
    """Squared distance of a point from a centre, the shorter way round."""
    total = 0.0
    for v in range(points.shape[1]):
        away = points[p, v] - centres[c, v]
        if period[v] < np.inf:
            away -= period[v] * np.round(away / period[v])
        total += away * away
    return total


@part
def at(points, p, v):
    """A coordinate of a point, zero along an axis that it has not."""
    return points[p, v] if v < points.shape[1] else 0.0


@part
def cells_at(points, p, low, side, number, period):
    """The cell of a point along three axes."""
    return (
        cell_of(at(points, p, 0), low[0], side[0], number[0], period[0]),
        cell_of(at(points, p, 1), low[1], side[1], number[1], period[1]),
        cell_of(at(points, p, 2), low[2], side[2], number[2], period[2]),
    )


@part
def company_beside(points, p, limit, source, some, low, side, number, period, mask):
    """Whether one of the points asked in the cells around that of a point is closer to it, squared, than a limit."""
    i, j, k = cells_at(points, p, low, side, number, period)
    wide, deep = min(points.shape[1] - 1, 1), max(points.shape[1] - 2, 0)
    for at_i in range(i - 1, i + 2):
        for at_j in range(j - wide, j + wide + 1):
            for at_k in range(k - deep, k + deep + 1):
                cell_i, cell_j, cell_k = turned_round(at_i, at_j, at_k, number, period)
                q = some[bucket_of(cell_i, cell_j, cell_k, number, mask)]
                if q >= 0 and apart_sq(source, q, points, p, period) < limit:
                    return True
    return False


@kernel
def lonely(points, wanted, density, least, most, expected, d, source, low, side, number, period, mask, out):
    """Write the rows of the points whose disc may be empty of ``source`` into ``out`` (n,); returns how many.

    Of those ``wanted`` with least < density ≤ most; a disc has the volume in which so many are ``expected``. One point
    of each cell of ``source`` is asked, in the point's own cell and in those around it: whoever stays is a suspect.
    """
    some, found = np.full(mask + 1, -1, np.int32), 0
    # Where every cell has a bucket of its own, nobody in the same cell is farther away than its diagonal.
    diagonal_sq = 0.0 if float(number[0]) * number[1] * number[2] <= mask + 1 else np.inf
    for v in range(source.shape[1]):
        diagonal_sq += side[v] * side[v]
    for q in range(len(source)):
        i, j, k = cells_at(source, q, low, side, number, period)
        some[bucket_of(i, j, k, number, mask)] = q
    for p in range(len(points)):
        if wanted[p] and least < density[p] <= most:
            part = expected / density[p]
            limit = part if d == 2 else part ** (2.0 / d)
            i, j, k = cells_at(points, p, low, side, number, period)
            inside = 0 <= i < number[0] and 0 <= j < number[1] and 0 <= k < number[2]
            q = some[bucket_of(i, j, k, number, mask)]
            if q >= 0 and inside and (diagonal_sq <= limit or apart_sq(source, q, points, p, period) < limit):
                continue
            if not company_beside(points, p, limit, source, some, low, side, number, period, mask):
                out[found] = p
                found += 1
    return found


@kernel
def beside(points, low, side, number, period, mask, centres, radius, out):
    """Write the rows of the points in buckets that discs around centres (c, 3) reach into ``out``; returns how many."""
    marked, found = np.zeros(mask + 1, np.bool_), 0
    for c in range(len(centres)):
        (west, east), (south, north), (below, above) = reach_of(centres, c, radius[c], low, side, number, period)
        for i in range(west, east + 1):
            for j in range(south, north + 1):
                for k in range(below, above + 1):
                    at_i, at_j, at_k = turned_round(i, j, k, number, period)
                    marked[bucket_of(at_i, at_j, at_k, number, mask)] = True
    for p in range(len(points)):
        i, j, k = cells_at(points, p, low, side, number, period)
        if marked[bucket_of(i, j, k, number, mask)]:
            out[found] = p
            found += 1
    return found


@kernel
def into_buckets(points, low, side, number, period, mask):
    """(start, rows): the rows of the points of bucket b are ``rows[start[b]:start[b + 1]]``, rising."""
    bucket = np.empty(len(points), np.int32)
    start, rows = np.zeros(mask + 2, np.int32), np.empty(len(points), np.int32)
    for p in range(len(points)):
        i, j, k = cells_at(points, p, low, side, number, period)
        bucket[p] = bucket_of(i, j, k, number, mask)
        start[bucket[p] + 1] += 1
    for b in range(mask + 1):
        start[b + 1] += start[b]
    for p in range(len(points)):
        rows[start[bucket[p]]] = p
        start[bucket[p]] += 1
    for b in range(mask + 1, 0, -1):
        start[b] = start[b - 1]
    start[0] = 0
    return start, rows


@part
def is_empty(centres, c, radius, points, low, side, number, period, mask, start, rows):
    """Whether no point lies closer to the centre than the radius."""
    i, j, k = cells_at(centres, c, low, side, number, period)
    own = bucket_of(i, j, k, number, mask)
    for place in range(start[own], start[own + 1]):  # most centres have company in their own cell
        if apart_sq(points, rows[place], centres, c, period) < radius * radius:
            return False
    (west, east), (south, north), (below, above) = reach_of(centres, c, radius, low, side, number, period)
    for i in range(west, east + 1):
        for j in range(south, north + 1):
            for k in range(below, above + 1):
                at_i, at_j, at_k = turned_round(i, j, k, number, period)
                b = bucket_of(at_i, at_j, at_k, number, mask)
                for place in range(start[b], start[b + 1]):
                    if apart_sq(points, rows[place], centres, c, period) < radius * radius:
                        return False
    return True


@kernel
def empty_discs(centres, radius, points, low, side, number, period, mask, start, rows, empty):
    """Fill ``empty`` (n,): whether no point lies closer to centre k than ``radius[k]``."""
    for c in range(len(centres)):
        empty[c] = is_empty(centres, c, radius[c], points, low, side, number, period, mask, start, rows)


@part
def is_within(p, i, j, k, limit, points, centres, c, low, side, number, period):
    """Whether a point lies in a cell, and closer to a centre than the limit."""
    if apart_sq(points, p, centres, c, period) >= limit * limit:
        return False
    own_i, own_j, own_k = cells_at(points, p, low, side, number, period)
    return own_i == i and own_j == j and own_k == k


@part
def holds(centres, c, radius, least, points, low, side, number, period, mask, start, rows):
    """Whether at least so many points are closer to a centre, itself a point, than the radius."""
    if least <= 1.0:
        return True
    count = 0
    (west, east), (south, north), (below, above) = reach_of(centres, c, radius, low, side, number, period)
    for i in range(west, east + 1):
        for j in range(south, north + 1):
            for k in range(below, above + 1):
                at_i, at_j, at_k = turned_round(i, j, k, number, period)
                b = bucket_of(at_i, at_j, at_k, number, mask)
                for place in range(start[b], start[b + 1]):
                    p = rows[place]
                    if is_within(p, at_i, at_j, at_k, radius, points, centres, c, low, side, number, period):
                        count += 1
                        if count >= least:
                            return True
    return False


@kernel
def clear(centres, radius, inner, least, points, low, side, number, period, mask, start, rows, seen):
    """Clear ``seen`` (n,) at the points closer than ``inner[c]`` to a centre that has ``least`` of them within its
    radius."""
    left = start[1:] - start[:-1]  # points of each bucket that are still seen
    for c in range(len(centres)):
        if not holds(centres, c, radius[c], least, points, low, side, number, period, mask, start, rows):
            continue
        (west, east), (south, north), (below, above) = reach_of(centres, c, inner[c], low, side, number, period)
        for i in range(west, east + 1):
            for j in range(south, north + 1):
                for k in range(below, above + 1):
                    at_i, at_j, at_k = turned_round(i, j, k, number, period)
                    b = bucket_of(at_i, at_j, at_k, number, mask)
                    if not left[b]:
                        continue
                    for place in range(start[b], start[b + 1]):
                        p = rows[place]
                        if seen[p] and apart_sq(points, p, centres, c, period) < inner[c] * inner[c]:
                            seen[p] = False
                            left[b] -= 1

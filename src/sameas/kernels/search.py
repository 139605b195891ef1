"""Compiled search in a plane of features and on the sphere.

In a plane: differences of the features, reduced to half a period for periodic ones; :func:`sweep_few` is for few
records, for which the layout of a large search costs more than it saves. On the sphere: residuals east and north,
covariances rotated to the axes at the midpoint.
"""

from __future__ import annotations

import math
from typing import TypeVar

import numpy as np

from sameas.arrays import FloatArray, Int32Array, IntArray
from sameas.kernels.compiled import borrowing_part, inlined, part, small
from sameas.kernels.zones import ROOM, Grid, Reach, Side, count_without, first_from, folded, near, sine

#: A number, or in Python an array of them.
Floats = TypeVar("Floats", float, FloatArray)
DEG = math.pi / 180.0
ARCSEC = 206264.80624709636
#: Residuals of directions closer than this in longitude and in latitude are computed by series.
CLOSE_DEG = 0.8


@inlined
def add_spread(packed: FloatArray, k: int, at: int, d: int, out: FloatArray) -> None:
    """Add row k of a packed covariance, which begins in column ``at``, to ``out`` (d, d), lower triangle only."""
    p = packed.shape[1] - at
    if p <= d:
        for v in range(d):
            out[v, v] += packed[k, at if p == 1 else at + v]
        return
    for v in range(d):
        for w in range(v, d):
            out[w, v] += packed[k, at]
            at += 1


@part
def whitened(matrix: FloatArray, residual: FloatArray, solved: FloatArray) -> tuple[float, float]:
    """χ² of the residual, and the determinant; the lower triangle of ``matrix`` is replaced by its Cholesky factor."""
    d = len(residual)
    distance = 0.0
    determinant = 1.0
    for v in range(d):
        for w in range(v):
            total = matrix[v, w]
            for t in range(w):
                total -= matrix[v, t] * matrix[w, t]
            matrix[v, w] = total / matrix[w, w]
        total = matrix[v, v]
        rest = residual[v]
        for t in range(v):
            total -= matrix[v, t] * matrix[v, t]
            rest -= matrix[v, t] * solved[t]
        root = math.sqrt(total) if total > 0.0 else 1e-150
        matrix[v, v] = root
        determinant *= root * root
        solved[v] = rest / root
        distance += solved[v] * solved[v]
    return distance, determinant


@small
def sweep_plane(
    one: Side, two: Side, grid: Grid, reach: Reach, folds: tuple[float, float], listed: IntArray, limit: float,
    box: bool, periods: FloatArray, first: int, last: int, out: tuple[FloatArray | Int32Array, ...],
) -> tuple[int, int]:  # fmt: skip
    """Write the candidates of the records at places ``first`` ≤ k < ``last`` of source 1 to the arrays ``out``.

    one, two : ``zones.Side``. grid, reach : of source 2. folds : periods of x and y. listed : see ``zones.near``, from
    ``first`` on. periods (d,). out : the columns of ``gate.Pairs``. Returns (candidates written, next k); next k < last
    if out is full.
    """
    room = np.empty(ROOM, np.int32), np.empty(ROOM, np.int32), np.empty(ROOM, np.uint8)
    count = np.int64(0)  # int64, not a literal: numba would compile a second version for the literal
    at = (np.int64(first), np.int64(0), np.int64(0), np.int64(0))
    while True:
        found, at = near(one, two, grid, reach, folds, listed, at, last, room)
        if found == 0:
            return count, last
        count, t = measured_on_plane(one, two, limit, box, periods, room[0], room[1], found, count, out)
        if t < found:
            return count_without(out[0], count, room[0][t]), np.int64(room[0][t])


@part
def measured_on_plane(
    one: Side, two: Side, limit: float, box: bool, periods: FloatArray, of1: Int32Array, of2: Int32Array, found: int,
    count: int, out: tuple[FloatArray | Int32Array, ...],
) -> tuple[int, int]:  # fmt: skip
    """Write the pairs that pass the gate; returns (candidates written, pairs tested before out was full)."""
    place1, place2, i, j, residual, distance, determinant = out
    d = len(periods)
    matrix = np.empty((d, d))
    delta = np.empty(d)
    solved = np.empty(d)
    reach = limit if box else limit * (1.0 + 1e-9)
    for t in range(found):
        k, q = of1[t], of2[t]
        matrix[:, :] = 0.0
        add_spread(one.content, k, d, d, matrix)
        add_spread(two.content, q, d, d, matrix)
        inside = True
        for v in range(d):
            delta[v] = folded(one.content[k, v] - two.content[q, v], periods[v])
            # The gate's ellipse is inside this box.
            inside = inside and delta[v] * delta[v] <= reach * matrix[v, v]
        if not inside:
            continue
        if d == 2:
            xx, xy, yy = matrix[0, 0], matrix[1, 0], matrix[1, 1]
            area = xx * yy - xy * xy
            squared = (delta[0] * delta[0] * yy - 2.0 * delta[0] * delta[1] * xy + delta[1] * delta[1] * xx) / area
        else:
            squared, area = whitened(matrix, delta, solved)
        if not box and squared > limit:
            continue
        if count == len(i):
            return count, t
        place1[count], place2[count] = k, q
        i[count], j[count] = one.rows[k], two.rows[q]
        for v in range(d):
            residual[count, v] = delta[v]
        distance[count] = squared
        determinant[count] = area
        count += 1
    return count, found


@small
def plane_covariances(cov1: FloatArray, cov2: FloatArray, i: Int32Array, j: Int32Array, out: FloatArray) -> None:
    """Write the covariance of each pair's residual to ``out`` (m, d, d)."""
    d = out.shape[1]
    out[:] = 0.0
    for k in range(len(i)):
        add_spread(cov1, i[k], 0, d, out[k])
        add_spread(cov2, j[k], 0, d, out[k])
        for v in range(d):
            for w in range(v):
                out[k, w, v] = out[k, v, w]


@small
def sweep_few(
    features1: FloatArray, packed1: FloatArray, features2: FloatArray, packed2: FloatArray, limit: float, box: bool,
    periods: FloatArray, out: tuple[FloatArray | Int32Array, ...],
) -> int:  # fmt: skip
    """Write the candidates of two sources of few records on a plane to the columns ``out`` of ``gate.Pairs``.

    Returns their number; −1 if ``out`` is too small, or two records of a source have the same content.
    """
    one, distinct1 = _in_order(features1, packed1, periods)
    two, distinct2 = _in_order(features2, packed2, periods)
    if not (distinct1 and distinct2):
        return -1
    n2, d = features2.shape
    variance1, variance2 = _along_axes(one.content, d), _along_axes(two.content, d)
    widest = 0.0
    for k in range(n2):
        widest = max(widest, variance2[k, 0])
    # Candidates are measured in batches: the overhead of each is that of twenty candidates.
    of1, of2 = np.empty(2 * n2 + 512, np.int32), np.empty(2 * n2 + 512, np.int32)
    enough = limit * (1.0 + 1e-6)
    count, found = np.int64(0), 0
    for k in range(len(features1)):
        x = one.content[k, 0]
        reach = math.sqrt(enough * (variance1[k, 0] + widest)) if periods[0] == np.inf else np.inf
        for q in range(first_from(two.content, 0, n2, x - reach), n2):
            if two.content[q, 0] > x + reach:
                break
            of1[found], of2[found] = k, q
            found += _near(one.content, variance1, k, two.content, variance2, q, periods, enough)
        if found + n2 >= len(of1) or k == len(features1) - 1:
            count, done = measured_on_plane(one, two, limit, box, periods, of1, of2, found, count, out)
            if done < found:
                return -1
            found = 0
    return count


@inlined
def _near(
    content1: FloatArray, variance1: FloatArray, k: int, content2: FloatArray, variance2: FloatArray, q: int,
    periods: FloatArray, enough: float,
) -> bool:  # fmt: skip
    """Whether two records are within the gate's box on every axis."""
    for v in range(variance1.shape[1]):
        apart = abs(content1[k, v] - content2[q, v])
        apart = min(apart, periods[v] - apart)
        if apart * apart > enough * (variance1[k, v] + variance2[q, v]):
            return False
    return True


@part
def _along_axes(content: FloatArray, d: int) -> FloatArray:
    """(n, d) variances of the features, from content (n, d + p) of features and packed covariances."""
    variance = np.zeros((len(content), d))
    matrix = np.zeros((d, d))
    for k in range(len(content)):
        matrix[:, :] = 0.0
        add_spread(content, k, d, d, matrix)
        for v in range(d):
            variance[k, v] = matrix[v, v]
    return variance


@part
def _in_order(features: FloatArray, packed: FloatArray, periods: FloatArray) -> tuple[Side, bool]:
    """A source sorted by its features and then its errors, and whether no two records have the same content."""
    n, d = features.shape
    content = np.empty((n, d + packed.shape[1]))
    for k in range(n):
        for v in range(d):
            value = features[k, v]
            if periods[v] < np.inf and not 0.0 <= value < periods[v]:
                value -= periods[v] * math.floor(value / periods[v])
                value = value if value < periods[v] else 0.0
            content[k, v] = value
        for v in range(packed.shape[1]):
            content[k, d + v] = packed[k, v]
    rows = np.argsort(content[:, 0]).astype(np.int32)
    gap = 0  # Shell sort if some records have the same first feature
    for k in range(1, n):
        if content[rows[k], 0] == content[rows[k - 1], 0]:
            gap = n // 2
    while gap > 0:
        for k in range(gap, n):
            row, at = rows[k], k
            while at >= gap and _precedes(content, row, rows[at - gap]):
                rows[at] = rows[at - gap]
                at -= gap
            rows[at] = row
        gap //= 2
    distinct = True
    for k in range(1, n):
        distinct = distinct and _precedes(content, rows[k - 1], rows[k])
    return Side(content[rows], np.empty((0, 4)), rows), distinct


@part
def _precedes(content: FloatArray, a: int, b: int) -> bool:
    """Whether row a comes before row b: by the first column in which they differ."""
    for v in range(content.shape[1]):
        if content[a, v] != content[b, v]:
            return content[a, v] < content[b, v]
    return False


@borrowing_part
def spread_2d(packed: FloatArray, k: int, at: int) -> tuple[float, float, float]:
    """(xx, xy, yy) of row k of a packed covariance of two features, which begins in column ``at``."""
    p = packed.shape[1] - at
    if p == 1:
        return packed[k, at], 0.0, packed[k, at]
    if p == 2:
        return packed[k, at], 0.0, packed[k, at + 1]
    return packed[k, at], packed[k, at + 1], packed[k, at + 2]


@borrowing_part
def turned(xx: float, xy: float, yy: float, c: float, s: float) -> tuple[float, float, float]:
    """A covariance rotated counter-clockwise by the angle of cosine c and sine s."""
    return (
        c * c * xx - 2.0 * c * s * xy + s * s * yy,
        c * s * (xx - yy) + (c * c - s * s) * xy,
        s * s * xx + 2.0 * c * s * xy + c * c * yy,
    )


@borrowing_part
def close_series(dlon: Floats, dlat: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Sine and cosine of half of two angles in degrees: (sin ½Δα, cos ½Δα, sin ½Δδ, cos ½Δδ).

    Series for about a degree: their remainders are below 1e-17 of the argument.
    """
    half_lon = 0.5 * DEG * dlon
    half_lat = 0.5 * DEG * dlat
    a2 = half_lon * half_lon
    b2 = half_lat * half_lat
    sin_lon = half_lon * (1.0 - a2 * (1.0 / 6.0 - a2 * (1.0 / 120.0 - a2 * (1.0 / 5040.0))))
    cos_lon = 1.0 - a2 * (0.5 - a2 * (1.0 / 24.0 - a2 * (1.0 / 720.0)))
    sin_lat = half_lat * (1.0 - b2 * (1.0 / 6.0 - b2 * (1.0 / 120.0 - b2 * (1.0 / 5040.0))))
    cos_lat = 1.0 - b2 * (0.5 - b2 * (1.0 / 24.0 - b2 * (1.0 / 720.0)))
    return sin_lon, cos_lon, sin_lat, cos_lat


@borrowing_part
def close_residual(dlon: Floats, dlat: Floats, cosines: Floats) -> tuple[Floats, Floats]:
    """(east, north) in arcsec of two directions less than CLOSE_DEG apart in either; cosines: cos δ₁ + cos δ₂."""
    sin_lon, cos_lon, sin_lat, cos_lat = close_series(dlon, dlat)
    # cos δ₁ + cos δ₂ = 2 cos of the middle · cos of half the difference.
    u = sin_lon * (0.5 * cosines / cos_lat)
    v = cos_lon * sin_lat
    h2 = u * u + v * v
    arc = 1.0 + h2 * (1.0 / 6.0 + h2 * (3.0 / 40.0 + h2 * (15.0 / 336.0)))
    return 2.0 * ARCSEC * arc * u, 2.0 * ARCSEC * arc * v


@borrowing_part
def close_turn(dlon: float, dlat: float, latitudes: float) -> float:
    """tan of half the rotation between the axes of two directions less than CLOSE_DEG apart; latitudes: δ₁ + δ₂."""
    sin_lon, cos_lon, _, cos_lat = close_series(dlon, dlat)
    middle = 0.5 * latitudes
    return sin_lon * math.copysign(sine(abs(middle)), middle) / (cos_lon * cos_lat)


@borrowing_part
def wide_residual(dlon: float, dlat: float, latitudes: float) -> tuple[float, float]:
    """(east, north) in arcsec of any two directions; see space.Sphere."""
    half_lon = 0.5 * DEG * dlon
    half_lat = 0.5 * DEG * dlat
    u = math.sin(half_lon) * math.cos(0.5 * DEG * latitudes)
    v = math.cos(half_lon) * math.sin(half_lat)
    h = min(1.0, math.sqrt(u * u + v * v))
    arc = math.asin(h) / h if h > 1e-9 else 1.0
    return 2.0 * ARCSEC * arc * u, 2.0 * ARCSEC * arc * v


@borrowing_part
def wide_turn(dlon: float, dlat: float, latitudes: float) -> float:
    """tan of half the rotation between the axes of any two directions."""
    across = math.sin(0.5 * DEG * dlon) * math.sin(0.5 * DEG * latitudes)
    along = math.cos(0.5 * DEG * dlon) * math.cos(0.5 * DEG * dlat)
    return across / max(along, 1e-300)


@borrowing_part
def shorter_way(dlon: float) -> float:
    """A difference of two longitudes of 0 … 360° as −180 … 180°."""
    return dlon - (360.0 if dlon > 180.0 else (-360.0 if dlon < -180.0 else 0.0))


@borrowing_part
def sphere_spread(
    packed1: FloatArray, k1: int, packed2: FloatArray, k2: int, at: int, turn: float
) -> tuple[float, float, float]:
    """(xx, xy, yy) of the sum of both covariances on the axes at the midpoint; turn: tan of half their rotation."""
    ax, axy, ay = spread_2d(packed1, k1, at)
    bx, bxy, by = spread_2d(packed2, k2, at)
    c = 1.0 / math.sqrt(1.0 + turn * turn)
    s = turn * c
    ax, axy, ay = turned(ax, axy, ay, c, s)
    bx, bxy, by = turned(bx, bxy, by, c, -s)
    return ax + bx, axy + bxy, ay + by


def shorter_ways(dlon: FloatArray) -> FloatArray:
    """:func:`shorter_way` of arrays."""
    return dlon - np.where(dlon > 180.0, 360.0, np.where(dlon < -180.0, -360.0, 0.0))


def spreads(
    one: Side, two: Side, k: IntArray, q: IntArray, dlon: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(m,) each: xx, xy, yy of the sum of both covariances of pairs of close records, as :func:`sweep_sphere`."""
    if not len(one.content):
        xx = one.guard[k, 3] + two.guard[q, 3]
        return xx, np.zeros(len(xx)), xx
    latitude_1, latitude_2 = one.guard[k, 1], two.guard[q, 1]
    sin_lon, cos_lon, _, cos_lat = close_series(dlon, latitude_1 - latitude_2)
    middle = 0.5 * (latitude_1 + latitude_2)
    turn = sin_lon * np.copysign(sine(np.abs(middle)), middle) / (cos_lon * cos_lat)
    c = 1.0 / np.sqrt(1.0 + turn * turn)
    s = turn * c
    ax, axy, ay = turned(*spread_2d(one.content, k, 0), c, s)
    bx, bxy, by = turned(*spread_2d(two.content, q, 0), c, -s)
    return ax + bx, axy + bxy, ay + by


@small
def sweep_sphere(
    one: Side, two: Side, grid: Grid, reach: Reach, listed: IntArray, limit: float, box: bool, first: int, last: int,
    out: tuple[FloatArray | Int32Array, ...],
) -> tuple[int, int]:  # fmt: skip
    """Write the candidates of the records at places ``first`` ≤ k < ``last`` of source 1 to the arrays ``out``.

    one, two : ``zones.Side``, guards (longitude, latitude, its cosine, variance). grid, reach : of source 2. listed :
    see ``zones.near``, from ``first`` on. out : the columns of ``gate.Pairs``. Returns (candidates written, next k);
    next k < last if out is full.
    """
    room = np.empty(ROOM, np.int32), np.empty(ROOM, np.int32), np.empty(ROOM, np.uint8)
    terms = np.empty((7, ROOM))
    count = np.int64(0)  # int64, not a literal: numba would compile a second version for the literal
    at = (np.int64(first), np.int64(0), np.int64(0), np.int64(0))
    while True:
        found, at = near(one, two, grid, reach, None, listed, at, last, room)
        if found == 0:
            return count, last
        count, t = measured_on_sphere(one, two, limit, box, room[0], room[1], found, terms, count, out)
        if t < found:
            return count_without(out[0], count, room[0][t]), np.int64(room[0][t])


@borrowing_part
def residuals(
    one: Side, two: Side, of1: Int32Array, of2: Int32Array, found: int, circles: bool, terms: FloatArray
) -> None:
    """Write the residuals east and north of the first ``found`` pairs to terms[0], terms[1], and their rotations to
    terms[2], unless all errors are circles."""
    east, north, turn, dlon, dlat, cosines, latitudes = terms
    close = True
    for t in range(found):
        k, q = of1[t], of2[t]
        dlon[t] = shorter_way(one.guard[k, 0] - two.guard[q, 0])
        dlat[t] = one.guard[k, 1] - two.guard[q, 1]
        cosines[t] = one.guard[k, 2] + two.guard[q, 2]
        latitudes[t] = one.guard[k, 1] + two.guard[q, 1]
        close &= (abs(dlon[t]) < CLOSE_DEG) & (abs(dlat[t]) < CLOSE_DEG)
    if close:
        for t in range(found):
            east[t], north[t] = close_residual(dlon[t], dlat[t], cosines[t])
        for t in range(0 if circles else found):
            turn[t] = close_turn(dlon[t], dlat[t], latitudes[t])
        return
    for t in range(found):
        if abs(dlon[t]) < CLOSE_DEG and abs(dlat[t]) < CLOSE_DEG:
            east[t], north[t] = close_residual(dlon[t], dlat[t], cosines[t])
        else:
            east[t], north[t] = wide_residual(dlon[t], dlat[t], latitudes[t])
        turn[t] = wide_turn(dlon[t], dlat[t], latitudes[t])


@borrowing_part
def measured_on_sphere(
    one: Side, two: Side, limit: float, box: bool, of1: Int32Array, of2: Int32Array, found: int, terms: FloatArray,
    count: int, out: tuple[FloatArray | Int32Array, ...],
) -> tuple[int, int]:  # fmt: skip
    """Write the pairs that pass the gate; returns (candidates written, pairs tested before out was full)."""
    place1, place2, i, j, residual, distance, determinant = out
    circles = len(one.content) == 0
    residuals(one, two, of1, of2, found, circles, terms)
    for t in range(found):
        k, q = of1[t], of2[t]
        east, north = terms[0, t], terms[1, t]
        if circles:
            xx = one.guard[k, 3] + two.guard[q, 3]
            xy, yy = 0.0, xx
        else:
            xx, xy, yy = sphere_spread(one.content, k, two.content, q, 0, terms[2, t])
        area = xx * yy - xy * xy
        squared = (east * east * yy - 2.0 * east * north * xy + north * north * xx) / area
        inside = east * east <= limit * xx and north * north <= limit * yy if box else squared <= limit
        if not inside:
            continue
        if count == len(i):
            return count, t
        place1[count], place2[count] = k, q
        i[count], j[count] = one.rows[k], two.rows[q]
        residual[count, 0], residual[count, 1] = east, north
        distance[count] = squared
        determinant[count] = area
        count += 1
    return count, found


@small
def sphere_covariances(
    features1: FloatArray, cov1: FloatArray, features2: FloatArray, cov2: FloatArray, i: Int32Array, j: Int32Array,
    out: FloatArray,
) -> None:  # fmt: skip
    """Write the covariance of each pair's residual to ``out`` (m, 2, 2)."""
    for k in range(len(i)):
        # Records keep their longitudes as given, which may be outside 0 … 360°; the search has reduced its own.
        dlon = shorter_way(features1[i[k], 0] % 360.0 - features2[j[k], 0] % 360.0)
        lat1, lat2 = features1[i[k], 1], features2[j[k], 1]
        xx, xy, yy = sphere_spread(cov1, i[k], cov2, j[k], 0, wide_turn(dlon, lat1 - lat2, lat1 + lat2))
        out[k, 0, 0] = xx
        out[k, 0, 1] = xy
        out[k, 1, 0] = xy
        out[k, 1, 1] = yy

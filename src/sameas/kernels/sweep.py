"""Compiled search for the candidates of a gate: zones of one coordinate, a sweep along the other.

Both sources are sorted by (zone, x). A record of zone z can only have candidates in the zones z − 1, z, z + 1, and
there only within the zone's window of x: three pointers walk along with the record. The window is constant within a
zone, so a pointer never has to go back.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

DEG = math.pi / 180.0
ARCSEC = 206264.80624709636


@njit(cache=True, nogil=True)
def spread_2d(covariance, k):
    """(xx, xy, yy) of a packed covariance of two features."""
    p = covariance.shape[1]
    if p == 1:
        return covariance[k, 0], 0.0, covariance[k, 0]
    if p == 2:
        return covariance[k, 0], 0.0, covariance[k, 1]
    return covariance[k, 0], covariance[k, 1], covariance[k, 2]


@njit(cache=True, nogil=True)
def turned(xx, xy, yy, c, s):
    """A covariance turned counter-clockwise by the angle of cosine c and sine s."""
    return (
        c * c * xx - 2.0 * c * s * xy + s * s * yy,
        c * s * (xx - yy) + (c * c - s * s) * xy,
        s * s * xx + 2.0 * c * s * xy + c * c * yy,
    )


@njit(cache=True, nogil=True)
def sphere_residual(lon1, lat1, lon2, lat2):
    """(east, north, tangent of half the turn of the axes), the residual in arcsec; see space.Sphere."""
    mid = 0.5 * DEG * (lat1 + lat2)
    return delambre(lon1 - lon2, lat1 - lat2, math.sin(mid), math.cos(mid))


@njit(cache=True, nogil=True)
def near_residual(lon1, lat1, sin1, cos1, lon2, lat2):
    """:func:`sphere_residual`, given the sine and cosine of lat1 and |lat1 − lat2| below a degree."""
    half = 0.5 * DEG * (lat1 - lat2)
    h2 = half * half
    sine = half * (1.0 - h2 / 6.0 * (1.0 - h2 / 20.0))
    cosine = 1.0 - h2 * 0.5 * (1.0 - h2 / 12.0)
    return delambre(lon1 - lon2, lat1 - lat2, sin1 * cosine - cos1 * sine, cos1 * cosine + sin1 * sine)


@njit(cache=True, nogil=True)
def delambre(dlon, dlat, sin_mid, cos_mid):
    """The residual from the differences in degrees and the sine and cosine of the middle latitude."""
    if dlon > 180.0:
        dlon -= 360.0
    elif dlon < -180.0:
        dlon += 360.0
    half_lon = 0.5 * DEG * dlon
    half_lat = 0.5 * DEG * dlat
    if abs(dlon) < 1.0 and abs(dlat) < 1.0:
        # Series for less than half a degree: their remainders are below 1e-17 of the argument.
        a2 = half_lon * half_lon
        b2 = half_lat * half_lat
        sin_lon = half_lon * (1.0 - a2 / 6.0 * (1.0 - a2 / 20.0 * (1.0 - a2 / 42.0)))
        cos_lon = 1.0 - a2 * 0.5 * (1.0 - a2 / 12.0 * (1.0 - a2 / 30.0))
        sin_lat = half_lat * (1.0 - b2 / 6.0 * (1.0 - b2 / 20.0 * (1.0 - b2 / 42.0)))
        cos_lat = 1.0 - b2 * 0.5 * (1.0 - b2 / 12.0 * (1.0 - b2 / 30.0))
    else:
        sin_lon = math.sin(half_lon)
        cos_lon = math.cos(half_lon)
        sin_lat = math.sin(half_lat)
        cos_lat = math.cos(half_lat)
    u = sin_lon * cos_mid
    v = cos_lon * sin_lat
    h2 = u * u + v * v
    if h2 < 1e-4:
        arc = 1.0 + h2 * (1.0 / 6.0 + h2 * (3.0 / 40.0 + h2 * (15.0 / 336.0)))
    else:
        h = min(1.0, math.sqrt(h2))
        arc = math.asin(h) / h
    turn = sin_lon * sin_mid / max(cos_lon * cos_lat, 1e-300)
    return 2.0 * ARCSEC * arc * u, 2.0 * ARCSEC * arc * v, turn


@njit(cache=True, nogil=True)
def sphere_spread(cov1, k1, cov2, k2, turn):
    """(xx, xy, yy) of the sum of both covariances on the axes halfway between two directions."""
    ax, axy, ay = spread_2d(cov1, k1)
    bx, bxy, by = spread_2d(cov2, k2)
    if cov1.shape[1] + cov2.shape[1] > 2:
        c = 1.0 / math.sqrt(1.0 + turn * turn)
        s = turn * c
        ax, axy, ay = turned(ax, axy, ay, c, s)
        bx, bxy, by = turned(bx, bxy, by, c, -s)
    return ax + bx, axy + bxy, ay + by


@njit(cache=True, nogil=True)
def plane_spread(cov1, k1, cov2, k2, d, out):
    """Fill ``out`` (d, d) with the sum of two packed covariances."""
    out[:, :] = 0.0
    for which in range(2):
        cov = cov1 if which == 0 else cov2
        k = k1 if which == 0 else k2
        p = cov.shape[1]
        if p <= d:
            for v in range(d):
                out[v, v] += cov[k, 0 if p == 1 else v]
        else:
            t = 0
            for v in range(d):
                for w in range(v, d):
                    out[v, w] += cov[k, t]
                    if w != v:
                        out[w, v] += cov[k, t]
                    t += 1


@njit(cache=True, nogil=True)
def whitened(matrix, residual, d):
    """(Mahalanobis distance squared, determinant); ``matrix`` is overwritten by its Cholesky factor."""
    distance = 0.0
    determinant = 1.0
    for v in range(d):
        for w in range(v):
            total = matrix[v, w]
            for t in range(w):
                total -= matrix[v, t] * matrix[w, t]
            matrix[v, w] = total / matrix[w, w]
        total = matrix[v, v]
        for t in range(v):
            total -= matrix[v, t] * matrix[v, t]
        root = math.sqrt(total) if total > 0.0 else 1e-150
        matrix[v, v] = root
        determinant *= root * root
    solved = np.empty(d)
    for v in range(d):
        total = residual[v]
        for t in range(v):
            total -= matrix[v, t] * solved[t]
        solved[v] = total / matrix[v, v]
        distance += solved[v] * solved[v]
    return distance, determinant


@njit(cache=True, nogil=True)
def sweep(
    features1, cov1, rows1, zones1, guard1, features2, cov2, rows2, zones2, guard2,
    windows, geometry, periods, first, last,
    out_place1, out_place2, out_i, out_j, out_residual, out_distance, out_determinant,
):  # fmt: skip
    """Candidates of the sorted records ``first`` ≤ k < ``last`` of source 1, written into the out arrays.

    geometry = (sphere, box, limit, axis_x, axis_y, wraps zones); zones are CSR starts into the sorted sources;
    windows (zones,) is the half width in x; for the guards (n, 2) see ``search._Side.guard``. Returns (candidates
    written, next k): next k < last when out is full.
    """
    sphere = geometry[0] > 0
    box = geometry[1] > 0
    limit = geometry[2]
    ax = int(geometry[3])
    ay = int(geometry[4])
    wraps = geometry[5] > 0
    d = features1.shape[1]
    n_zones = len(zones1) - 1
    period = periods[ax]
    capacity = len(out_i)
    count = 0
    matrix = np.empty((d, d))
    delta = np.empty(d)
    pointer = np.zeros(3, np.int64)
    zone = np.searchsorted(zones1, first, side="right") - 1
    fresh = True
    k = first
    while k < last:
        while k >= zones1[zone + 1]:
            zone += 1
            fresh = True
        window = windows[zone]
        everything = 2.0 * window >= period
        if fresh:
            for t in range(3):
                other = zone - 1 + t
                if wraps:
                    other %= n_zones
                pointer[t] = zones2[other] if 0 <= other < n_zones else 0
            fresh = False
        x = features1[k, ax]
        y = features1[k, ay]
        near = sphere and window < 1.0
        if sphere:
            sin1 = math.sin(DEG * y)
            cos1 = math.cos(DEG * y)
        begin = count
        for t in range(3):
            other = zone - 1 + t
            if wraps:
                if n_zones == 1 and t != 1:
                    continue
                other %= n_zones
            if other < 0 or other >= n_zones:
                continue
            start = zones2[other]
            stop = zones2[other + 1]
            if start == stop:
                continue
            p = pointer[t]
            if not everything:
                while p < stop and features2[p, ax] < x - window:
                    p += 1
                pointer[t] = p
            # Three stretches of the zone: the window itself, and what it reaches across the period at either end.
            for stretch in range(3):
                if stretch == 0:
                    q = start if everything else p
                    upper = np.inf if everything else x + window
                elif everything or period == np.inf:
                    break
                elif stretch == 1:
                    if x + window < period:
                        continue
                    q = start
                    upper = x + window - period
                else:
                    if x - window >= 0.0:
                        continue
                    lower = x - window + period
                    q = stop
                    while q > start and features2[q - 1, ax] >= lower:
                        q -= 1
                    upper = np.inf
                while q < stop and features2[q, ax] <= upper:
                    if sphere:
                        if near:
                            dlat = y - features2[q, 1]
                            dlon = x - features2[q, 0]
                            if dlon > 180.0:
                                dlon -= 360.0
                            elif dlon < -180.0:
                                dlon += 360.0
                            # hav s = hav Δδ + cos δ₁ cos δ₂ hav Δα, and hav x ≥ (x/2)² (1 − 1e-4) below a degree.
                            flat = dlat * dlat + cos1 * guard2[q, 1] * dlon * dlon
                            if flat * (1.0 - 1e-4) > guard1[k, 0] + guard2[q, 0]:
                                q += 1
                                continue
                            east, north, turn = near_residual(x, y, sin1, cos1, features2[q, 0], features2[q, 1])
                        else:
                            east, north, turn = sphere_residual(x, y, features2[q, 0], features2[q, 1])
                        xx, xy, yy = sphere_spread(cov1, k, cov2, q, turn)
                        delta[0] = east
                        delta[1] = north
                    else:
                        if not wraps and ay != ax:
                            dy = y - features2[q, ay]
                            if dy * dy > guard1[k, 1] + guard2[q, 1]:
                                q += 1
                                continue
                        for v in range(d):
                            value = features1[k, v] - features2[q, v]
                            if periods[v] != np.inf:
                                value -= periods[v] * math.floor(value / periods[v] + 0.5)
                            delta[v] = value
                        if d == 2:
                            a0, a1, a2 = spread_2d(cov1, k)
                            b0, b1, b2 = spread_2d(cov2, q)
                            xx = a0 + b0
                            xy = a1 + b1
                            yy = a2 + b2
                    inside = True
                    if d == 2:
                        determinant = xx * yy - xy * xy
                        if box:
                            inside = delta[0] * delta[0] <= limit * xx and delta[1] * delta[1] <= limit * yy
                        distance = (
                            delta[0] * delta[0] * yy - 2.0 * delta[0] * delta[1] * xy + delta[1] * delta[1] * xx
                        ) / determinant
                    else:
                        plane_spread(cov1, k, cov2, q, d, matrix)
                        if box:
                            for v in range(d):
                                if delta[v] * delta[v] > limit * matrix[v, v]:
                                    inside = False
                        distance, determinant = whitened(matrix, delta, d)
                    if not box:
                        inside = distance <= limit
                    if inside:
                        if count == capacity:
                            return begin, k
                        out_place1[count] = k
                        out_place2[count] = q
                        out_i[count] = rows1[k]
                        out_j[count] = rows2[q]
                        for v in range(d):
                            out_residual[count, v] = delta[v]
                        out_distance[count] = distance
                        out_determinant[count] = determinant
                        count += 1
                    q += 1
        k += 1
    return count, last


@njit(cache=True, nogil=True)
def pair_covariances(features1, cov1, features2, cov2, i, j, sphere, out):
    """Fill ``out`` (m, d, d) with the covariance of each pair's residual."""
    d = features1.shape[1]
    for k in range(len(i)):
        if sphere:
            # Records keep the longitudes that they were given, any number of turns away; the search has folded its own.
            _, _, turn = sphere_residual(
                features1[i[k], 0] % 360.0, features1[i[k], 1], features2[j[k], 0] % 360.0, features2[j[k], 1]
            )
            xx, xy, yy = sphere_spread(cov1, i[k], cov2, j[k], turn)
            out[k, 0, 0] = xx
            out[k, 0, 1] = xy
            out[k, 1, 0] = xy
            out[k, 1, 1] = yy
        else:
            plane_spread(cov1, i[k], cov2, j[k], d, out[k])

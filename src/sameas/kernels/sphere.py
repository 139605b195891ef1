"""Compiled search on the sphere: residuals east and north, the covariances turned to the axes halfway."""

from __future__ import annotations

import math

import numpy as np

from sameas.kernels.compiled import kernel, part
from sameas.kernels.spans import stretches, taken_back, zone_of

DEG = math.pi / 180.0
ARCSEC = 206264.80624709636


@part
def spread_2d(packed, k, at):
    """(xx, xy, yy) of row k of a packed covariance of two features, which begins in column ``at``."""
    p = packed.shape[1] - at
    if p == 1:
        return packed[k, at], 0.0, packed[k, at]
    if p == 2:
        return packed[k, at], 0.0, packed[k, at + 1]
    return packed[k, at], packed[k, at + 1], packed[k, at + 2]


@part
def turned(xx, xy, yy, c, s):
    """A covariance turned counter-clockwise by the angle of cosine c and sine s."""
    return (
        c * c * xx - 2.0 * c * s * xy + s * s * yy,
        c * s * (xx - yy) + (c * c - s * s) * xy,
        s * s * xx + 2.0 * c * s * xy + c * c * yy,
    )


@part
def sphere_residual(lon1, lat1, cos1, lon2, lat2, cos2):
    """(east, north) residual in arcsec of two directions, given the cosines of their latitudes; see space.Sphere."""
    dlon = lon1 - lon2
    if dlon > 180.0:
        dlon -= 360.0
    elif dlon < -180.0:
        dlon += 360.0
    half_lon = 0.5 * DEG * dlon
    half_lat = 0.5 * DEG * (lat1 - lat2)
    if abs(half_lon) < 0.01 and abs(half_lat) < 0.01:
        # Series for about half a degree: their remainders are below 1e-17 of the argument.
        a2 = half_lon * half_lon
        b2 = half_lat * half_lat
        sin_lon = half_lon * (1.0 - a2 * (1.0 / 6.0 - a2 * (1.0 / 120.0 - a2 * (1.0 / 5040.0))))
        cos_lon = 1.0 - a2 * (0.5 - a2 * (1.0 / 24.0 - a2 * (1.0 / 720.0)))
        sin_lat = half_lat * (1.0 - b2 * (1.0 / 6.0 - b2 * (1.0 / 120.0 - b2 * (1.0 / 5040.0))))
        cos_lat = 1.0 - b2 * (0.5 - b2 * (1.0 / 24.0 - b2 * (1.0 / 720.0)))
        # cos δ₁ + cos δ₂ = 2 cos of the middle · cos of half the difference.
        cos_mid = 0.5 * (cos1 + cos2) / cos_lat
    else:
        sin_lon = math.sin(half_lon)
        cos_lon = math.cos(half_lon)
        sin_lat = math.sin(half_lat)
        cos_mid = math.cos(0.5 * DEG * (lat1 + lat2))
    u = sin_lon * cos_mid
    v = cos_lon * sin_lat
    h2 = u * u + v * v
    if h2 < 1e-4:
        arc = 1.0 + h2 * (1.0 / 6.0 + h2 * (3.0 / 40.0 + h2 * (15.0 / 336.0)))
    else:
        h = min(1.0, math.sqrt(h2))
        arc = math.asin(h) / h
    return 2.0 * ARCSEC * arc * u, 2.0 * ARCSEC * arc * v


@part
def sphere_spread(packed1, k1, packed2, k2, at, lon1, lat1, lon2, lat2):
    """(xx, xy, yy) of the sum of both covariances on the axes halfway between two directions."""
    ax, axy, ay = spread_2d(packed1, k1, at)
    bx, bxy, by = spread_2d(packed2, k2, at)
    if packed1.shape[1] + packed2.shape[1] > 2 * at + 2:
        dlon = lon1 - lon2
        if dlon > 180.0:
            dlon -= 360.0
        elif dlon < -180.0:
            dlon += 360.0
        # The tangent of half the turn between the axes at either end.
        across = math.sin(0.5 * DEG * dlon) * math.sin(0.5 * DEG * (lat1 + lat2))
        along = math.cos(0.5 * DEG * dlon) * math.cos(0.5 * DEG * (lat1 - lat2))
        turn = across / max(along, 1e-300)
        c = 1.0 / math.sqrt(1.0 + turn * turn)
        s = turn * c
        ax, axy, ay = turned(ax, axy, ay, c, s)
        bx, bxy, by = turned(bx, bxy, by, c, -s)
    return ax + bx, axy + bxy, ay + by


@kernel
def sweep_sphere(one, two, cells, windows, limit, box, first, last, out):
    """Candidates of the sorted records ``first`` ≤ k < ``last`` of source 1, written into the arrays ``out``.

    one, two : ``spans.Side``, guards (longitude, latitude, its cosine, opening²). cells : ``spans.Cells``. windows
    (zones,) : half width in longitude. out : the columns of ``gate.Pairs``. Returns (candidates written, next k): next
    k < last when out is full.
    """
    record, low, high = np.empty(1024, np.int32), np.empty(1024, np.int32), np.empty(1024, np.int32)
    of1, of2, passes = np.empty(4096, np.int32), np.empty(4096, np.int32), np.empty(4096, np.uint8)
    count = np.int64(0)  # not a literal: numba would compile for it apart
    k = first
    while k < last:
        spans, k = stretches(one, two, cells, windows, 360.0, False, k, last, record, low, high)
        s = np.int64(0)
        while s < spans:
            s, near = near_on_sphere(one, two, windows, record, low, high, s, spans, of1, of2, passes)
            count, t = measured_on_sphere(one, two, limit, box, of1, of2, near, count, out)
            if t < near:
                return taken_back(out[0], count, of1[t]), of1[t]
    return count, last


@part
def near_on_sphere(one, two, windows, record, low, high, s, spans, of1, of2, passes):
    """Fill of1, of2 with the pairs of the stretches s … that lie near enough; what is left of a stretch stays in it."""
    zone = zone_of(one.zones, record[s])
    near = 0
    room = len(of1)
    while s < spans and near < room:
        k = record[s]
        while k >= one.zones[zone + 1]:
            zone += 1
        # All of a stretch lies on the same side of the period's end.
        lon = one.guard[k, 0]
        if lon - two.guard[low[s], 0] > 180.0:
            lon -= 360.0
        elif lon - two.guard[low[s], 0] < -180.0:
            lon += 360.0
        lat = one.guard[k, 1]
        cosine, opening = one.guard[k, 2], one.guard[k, 3]
        # hav s = hav Δδ + cos δ₁ cos δ₂ hav Δα, and hav x ≥ (x/2)² (1 − 1e-4) below a degree; beyond, all are measured.
        flat = 1.0 - 1e-4 if windows[zone] < 1.0 else 0.0
        stop = min(high[s], low[s] + room - near)
        if stop - low[s] < 8:
            for q in range(low[s], stop):
                dlat = lat - two.guard[q, 1]
                dlon = lon - two.guard[q, 0]
                of1[near] = k
                of2[near] = q
                near += flat * (dlat * dlat + cosine * two.guard[q, 2] * dlon * dlon) <= opening + two.guard[q, 3]
        else:
            # The same in two steps, of which the first works on many at once.
            start = low[s]
            for t in range(stop - start):
                dlat = lat - two.guard[start + t, 1]
                dlon = lon - two.guard[start + t, 0]
                length = flat * (dlat * dlat + cosine * two.guard[start + t, 2] * dlon * dlon)
                passes[t] = length <= opening + two.guard[start + t, 3]
            for t in range(stop - start):
                of1[near] = k
                of2[near] = start + t
                near += passes[t]
        low[s] = stop
        if stop == high[s]:
            s += 1
    return s, near


@part
def measured_on_sphere(one, two, limit, box, of1, of2, near, count, out):
    """Write those of the pairs that pass the gate; returns (candidates written, pairs done before out was full)."""
    place1, place2, i, j, residual, distance, determinant = out
    circles = one.content.shape[1] + two.content.shape[1] == 6
    for t in range(near):
        k, q = of1[t], of2[t]
        lon1, lat1, lon2, lat2 = one.content[k, 0], one.content[k, 1], two.content[q, 0], two.content[q, 1]
        east, north = sphere_residual(lon1, lat1, one.guard[k, 2], lon2, lat2, two.guard[q, 2])
        if circles:
            xx = one.content[k, 2] + two.content[q, 2]
            xy, yy = 0.0, xx
        else:
            xx, xy, yy = sphere_spread(one.content, k, two.content, q, 2, lon1, lat1, lon2, lat2)
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
    return count, near


@kernel
def sphere_covariances(features1, cov1, features2, cov2, i, j, out):
    """Fill ``out`` (m, 2, 2) with the covariance of each pair's residual."""
    for k in range(len(i)):
        # Records keep the longitudes that they were given, any number of turns away; the search has folded its own.
        lon1, lon2 = features1[i[k], 0] % 360.0, features2[j[k], 0] % 360.0
        lat1, lat2 = features1[i[k], 1], features2[j[k], 1]
        xx, xy, yy = sphere_spread(cov1, i[k], cov2, j[k], 0, lon1, lat1, lon2, lat2)
        out[k, 0, 0] = xx
        out[k, 0, 1] = xy
        out[k, 1, 0] = xy
        out[k, 1, 1] = yy

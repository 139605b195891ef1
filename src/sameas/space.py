"""Feature spaces: how two records' positions become one residual.

Use :class:`Plane` for anything Euclidean (frame pixels, local metres, bearing and distance with a period),
:class:`Sphere` for directions on the whole sky or globe. The residual of a pair is always a vector in the
unit of the covariances, and its two covariances are brought to the same axes before they are added.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from sameas.arrays import FloatArray
from sameas.errors import InputError
from sameas.representation import in_short

ARCSEC_PER_RADIAN = 206264.80624709636


@in_short
@dataclass(frozen=True)
class Plane:
    """A Euclidean space of any dimension, whose axes may be periodic.

    Parameters
    ----------
    periods : per feature its period in the feature's unit, or None where it does not wrap;
        None alone means that no axis wraps. Example: ``Plane(periods=(360.0, None))`` for bearing in degrees
        and distance.
    """

    periods: tuple[float | None, ...] | None = None

    def __post_init__(self) -> None:
        for axis, period in enumerate(self.periods or ()):
            if period is not None and not period > 0:
                raise InputError(f"Plane: the period of axis {axis} is {period}; give a positive number or None")

    def period_list(self, d: int) -> list[float]:
        """Per axis its period, infinity where the axis does not wrap."""
        if self.periods is None:
            return [float("inf")] * d
        if len(self.periods) != d:
            raise InputError(f"Plane has {len(self.periods)} periods, but the records have {d} features")
        return [float("inf") if p is None else float(p) for p in self.periods]


@dataclass(frozen=True)
class Sphere:
    """Directions: features are longitude and latitude in degrees, covariances of (east, north) in arcsec².

    The residual of two directions is exact for any separation, at the poles and across 0/360: with
    α, δ their longitudes and latitudes,

        sin(s/2) sin φ = sin(Δα/2) cos(½(δ₁+δ₂)),   sin(s/2) cos φ = cos(Δα/2) sin(½Δδ)

    (Delambre's analogies), s the separation and φ the position angle (east of north) halfway between the two.
    The local axes of the two records differ by the angle θ, tan(θ/2) = tan(Δα/2) sin(½(δ₁+δ₂)) / cos(½Δδ);
    each covariance is rotated by half of it.
    """


Space = Plane | Sphere


def folded(values: FloatArray, period: float) -> FloatArray:
    """Values reduced to 0 ≤ x < ``period``; a small negative number rounds to the period, which is 0."""
    values = np.mod(values, period)
    return np.where(values < period, values, 0.0)


def wrapped(difference: FloatArray, periods: ArrayLike) -> FloatArray:
    """Differences (…, d) reduced to half a period either way; ``periods`` (d,) are infinite for axes without one."""
    period = np.asarray(periods, np.float64)
    wraps = np.isfinite(period)
    if not wraps.any():
        return difference
    turns = np.where(wraps, np.ceil(difference / period - 0.5), 0.0)
    return np.asarray(difference - turns * np.where(wraps, period, 0.0))


def sphere_offset(lon_1: ArrayLike, lat_1: ArrayLike, lon_2: ArrayLike, lat_2: ArrayLike) -> FloatArray:
    """(n, 2) east and north offset of directions 1 from directions 2 in arcsec, on the axes of :class:`Sphere`.

    Longitudes and latitudes in degrees, (n,) each.
    """
    delta = np.subtract(lon_1, lon_2)
    half_lon = np.radians(delta - 360.0 * np.round(delta / 360.0)) / 2.0
    half_lat = np.radians(np.subtract(lat_1, lat_2)) / 2.0
    u = np.sin(half_lon) * np.cos(np.radians(np.add(lat_1, lat_2)) / 2.0)
    v = np.cos(half_lon) * np.sin(half_lat)
    half_chord = np.minimum(np.hypot(u, v), 1.0)
    arc = np.where(half_chord > 1e-9, np.arcsin(half_chord) / np.maximum(half_chord, 1e-300), 1.0)
    return 2.0 * ARCSEC_PER_RADIAN * np.stack([u * arc, v * arc], axis=-1)


def ball_volume(d: int) -> float:
    """Volume of the ball of radius 1 in d dimensions."""
    return float(math.pi ** (0.5 * d) / math.gamma(0.5 * d + 1.0))


def unit_vectors(lon_deg: ArrayLike, lat_deg: ArrayLike) -> FloatArray:
    """(..., 3) unit vectors of directions in degrees."""
    lon, lat = np.radians(lon_deg), np.radians(lat_deg)
    cosine = np.cos(lat)
    return np.stack([cosine * np.cos(lon), cosine * np.sin(lon), np.sin(lat)], axis=-1)


def directions_deg(vectors: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Longitude (0 … 360) and latitude in degrees of vectors (..., 3) of any length."""
    x, y, z = np.moveaxis(vectors, -1, 0)
    return np.degrees(np.arctan2(y, x)) % 360.0, np.degrees(np.arctan2(z, np.hypot(x, y)))


def chord_angle_deg(chord: float) -> float:
    """Degrees between two unit vectors, by the length of their difference."""
    return math.degrees(2 * math.asin(min(1.0, chord / 2)))


def mean_direction(vectors: FloatArray) -> FloatArray:
    """(3,) the unit vector along the mean of unit vectors (n, 3); the north pole if the mean is zero."""
    mean = vectors.mean(axis=0)
    length = float(np.linalg.norm(mean))
    return np.asarray(mean / length) if length > 0.0 else np.array([0.0, 0.0, 1.0])


def local_axes(lon: FloatArray, lat: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The unit vectors to the east and to the north, (..., 3) each, of directions in radians."""
    east = np.stack([-np.sin(lon), np.cos(lon), np.zeros_like(lon)], axis=-1)
    north = np.stack([-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)], axis=-1)
    return east, north


def axes_at(direction: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The unit vectors to the east and to the north, (..., 3) each, at unit vectors (..., 3)."""
    x, y, z = np.moveaxis(direction, -1, 0)
    return local_axes(np.arctan2(y, x), np.arctan2(z, np.hypot(x, y)))


def to_plane(vectors: FloatArray, centre: FloatArray, axes: tuple[FloatArray, FloatArray] | None = None) -> FloatArray:
    """(..., 2) gnomonic projection of unit vectors on the tangent plane at ``centre``, radians; NaN at 90° or more.

    axes : the two unit vectors of the plane, (..., 3) each; by default east and north.
    """
    first, second = axes_at(centre) if axes is None else axes
    depth = np.sum(vectors * centre, axis=-1)
    depth = np.where(depth > 0.0, depth, np.nan)
    return np.stack([np.sum(vectors * first, axis=-1), np.sum(vectors * second, axis=-1)], axis=-1) / depth[..., None]


def from_plane(plane: FloatArray, centre: FloatArray, axes: tuple[FloatArray, FloatArray] | None = None) -> FloatArray:
    """(..., 3) unit vectors of points (..., 2) on the tangent plane at ``centre``; the inverse of :func:`to_plane`."""
    first, second = axes_at(centre) if axes is None else axes
    vectors = centre + plane[..., :1] * first + plane[..., 1:] * second
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def half_convergence(lon_1: ArrayLike, lat_1: ArrayLike, lon_2: ArrayLike, lat_2: ArrayLike) -> FloatArray:
    """θ/2 of :class:`Sphere` in radians: half the increase of position angles from direction 2 to direction 1."""
    delta = np.subtract(lon_1, lon_2)
    half_lon = np.radians(delta - 360.0 * np.round(delta / 360.0)) / 2.0
    half_lat, middle = np.radians(np.subtract(lat_1, lat_2)) / 2.0, np.radians(np.add(lat_1, lat_2)) / 2.0
    return np.asarray(np.arctan2(np.sin(half_lon) * np.sin(middle), np.cos(half_lon) * np.cos(half_lat)), np.float64)


def rotations(angle: FloatArray) -> FloatArray:
    """(k, 2, 2) matrices that add ``angle`` to the position angle of a vector (east, north)."""
    sine, cosine = np.sin(angle), np.cos(angle)
    return np.stack([cosine, sine, -sine, cosine], axis=1).reshape(-1, 2, 2)


def on_axes_of(at_deg: FloatArray, position_deg: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Offsets (k, 2) in arcsec of directions from ``at_deg``, on the axes of ``at_deg``, and a rotation.

    The rotation (k, 2, 2) takes vectors from the axes of ``position_deg``, such as motions and errors, to these axes.
    """
    ends = position_deg[:, 0], position_deg[:, 1], at_deg[:, 0], at_deg[:, 1]
    half = half_convergence(*ends)
    return np.einsum("kvw,kw->kv", rotations(-half), sphere_offset(*ends)), rotations(-2.0 * half)


def displaced(position_deg: FloatArray, offset_arcsec: FloatArray) -> FloatArray:
    """(n, 2) directions reached from ``position_deg`` (n, 2) along great circles, offset (n, 2) east, north.

    The longitude of the unit vector is measured from the starting meridian, which keeps all digits of a small offset,
    also at the poles.
    """
    lat = np.radians(position_deg[:, 1])
    offset = offset_arcsec / ARCSEC_PER_RADIAN
    distance = np.hypot(offset[:, 0], offset[:, 1])
    cosine_distance = np.cos(distance)
    east, north = (offset * np.sinc(distance / np.pi)[:, None]).T
    sine, cosine = np.sin(lat), np.cos(lat)
    x, z = cosine * cosine_distance - sine * north, sine * cosine_distance + cosine * north
    lon = position_deg[:, 0] + np.degrees(np.arctan2(east, x))
    return np.stack([lon % 360, np.degrees(np.arctan2(z, np.hypot(x, east)))], axis=1)

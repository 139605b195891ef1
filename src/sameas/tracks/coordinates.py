"""Coordinates: from WGS84 and from sensor measurements to one local plane in metres, with covariances.

All sources of a picture are compared in one :class:`LocalPlane`: east and north, in metres, of the *foot* of a
position, its point on the ellipsoid below it, in the tangent plane of the ellipsoid at the origin. The foot does not
depend on the height, so sources with and without heights agree.

- :class:`LocalPlane`: WGS84 latitude and longitude ↔ the plane, with velocities and covariances. The antimeridian and
  the poles are no exceptions: all conversions use earth-centred coordinates.
- :func:`polar_to_geodetic`: range, bearing and height from a sensor at a known position to positions on the ground,
  with covariances.
- :func:`bearing_in_plane`: bearings relative to the plane's north.

Geodesy is done by pymap3d (BSD-2-Clause).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from importlib import import_module
from types import ModuleType

import numpy as np
from numpy.typing import ArrayLike

from sameas.arrays import FloatArray
from sameas.errors import InputError, naming, optional
from sameas.space import unit_vectors

#: Places farther than this from the origin are not in the plane, which shortens distances there by a fifth (chosen).
FARTHEST_M = 4000e3
#: The geometric median uses at most 20 000 positions, evenly sampled, and 50 Weiszfeld iterations (chosen).
MEDIAN_SAMPLE, MEDIAN_STEPS = 20_000, 50
#: Mean radius of the earth, where a sphere is accurate enough.
EARTH_M = 6_371_000.0
#: Lengths of ships and aircraft, metres: the nautical mile and the foot.
MILE_M = 1852.0
FOOT_M = 0.3048
#: Above this elevation the direction of a target on the ground is undefined.
STEEPEST_DEG = 80.0


def geodesy() -> ModuleType:
    """The module pymap3d; refused with the install line if it is missing."""
    with optional("positions on the earth need pymap3d", "targets"):
        return import_module("pymap3d")


@dataclass(frozen=True)
class LocalPlane:
    """The tangent plane of the WGS84 ellipsoid at an origin; x is east, y is north there, in metres.

    Distances are exact at the origin, 0.05 % short at 200 km from it, 1 % at 900 km and 20 % at 4000 km. Velocities and
    covariances are transformed accordingly.

    Parameters
    ----------
    lat_deg, lon_deg : the origin.

    Example
    -------
    >>> plane = LocalPlane(50.8, -1.3)
    >>> position = plane.of_geodetic([50.81, 50.8], [-1.3, -1.29])
    >>> print(position.round(1))
    [[   0.  1112.4]
     [ 705.     0. ]]
    >>> [axis.round(6).tolist() for axis in plane.to_geodetic(position)]
    [[50.81, 50.8], [-1.3, -1.29]]
    """

    lat_deg: float
    lon_deg: float

    def __post_init__(self) -> None:
        _degrees("LocalPlane", np.atleast_1d(self.lat_deg), np.atleast_1d(self.lon_deg))
        if not (np.isfinite(self.lat_deg) and np.isfinite(self.lon_deg)):
            raise InputError(
                f"LocalPlane: origin is {self.lat_deg}, {self.lon_deg}; give latitude, longitude in degrees"
            )

    @classmethod
    def about(cls, lat_deg: ArrayLike, lon_deg: ArrayLike) -> LocalPlane:
        """The plane at the geometric median of these positions, robust if fewer than half of them are wrong.

        The median is the point with the minimum sum of distances through the earth.
        """
        lat, lon = _numbers(lat_deg, lon_deg)
        known = np.isfinite(lat) & np.isfinite(lon)
        if not known.any():
            raise InputError("LocalPlane: no position is known; give the origin of the plane")
        few = np.unique(np.linspace(0, known.sum() - 1, min(int(known.sum()), MEDIAN_SAMPLE)).astype(np.int64))
        places = unit_vectors(lon[known][few], lat[known][few])
        middle = places.mean(axis=0)
        for _ in range(MEDIAN_STEPS):
            weight, before = 1.0 / np.maximum(np.linalg.norm(places - middle, axis=1), 1e-7), middle
            middle = weight @ places / weight.sum()
            if (middle == before).all():
                break
        x, y, z = middle
        if np.hypot(np.hypot(x, y), z) < 1e-6:
            raise InputError(
                "the positions lie all around the earth, and a picture has one plane",
                naming("use those of an area: {within:LAT,LON,KM}"),
            )
        return cls(float(np.degrees(np.arctan2(z, np.hypot(x, y)))), float(np.degrees(np.arctan2(y, x))))

    def of_geodetic(self, lat_deg: ArrayLike, lon_deg: ArrayLike, source: str = "positions") -> FloatArray:
        """(n, 2) east and north in metres of the feet of positions (n,).

        NaN where a position is unknown, or farther than 4000 km from the origin, the limit of the plane.

        Raises
        ------
        InputError : beyond ±90°, beyond ±360°, or at least half of the positions are too far; names the first row.
        """
        lat, lon = _numbers(lat_deg, lon_deg)
        _degrees(source, lat, lon)
        east, north, up = self.enu(lat, lon).T
        position = np.column_stack([east, north])
        with np.errstate(invalid="ignore"):
            beyond = np.hypot(np.hypot(east, north), up) > FARTHEST_M
        far = np.flatnonzero(beyond)
        if len(far) and 2 * len(far) >= np.isfinite(east).sum():
            first = far[0]
            raise InputError(
                f"{source}: {len(far)} positions lie farther than {FARTHEST_M / 1e3:.0f} km from the origin "
                f"{self.lat_deg:g}, {self.lon_deg:g} (first: row {first}: {lat[first]:g}, {lon[first]:g})",
                naming(
                    "check the sign of the longitude and the order latitude, longitude; of reports of the whole earth, "
                    "use an area: {within:LAT,LON,KM}"
                ),
            )
        position[beyond] = np.nan
        return position

    def great_circle_m(self, lat_deg: ArrayLike, lon_deg: ArrayLike) -> FloatArray:
        """(n,) distances of places (n,) from the origin on a sphere, in metres."""
        lat, lon = _numbers(lat_deg, lon_deg)
        phi, start, lam = np.radians(lat), math.radians(self.lat_deg), np.radians(lon - self.lon_deg)
        half = np.sin((phi - start) / 2.0) ** 2 + np.cos(phi) * math.cos(start) * np.sin(lam / 2.0) ** 2
        return np.asarray(2.0 * EARTH_M * np.arcsin(np.sqrt(np.clip(half, 0.0, 1.0))))

    def enu(self, lat_deg: FloatArray, lon_deg: FloatArray) -> FloatArray:
        """(n, 3) east, north and up in metres of places (n,) on the ellipsoid, wherever they are."""
        none = np.zeros_like(lat_deg)
        return np.column_stack(geodesy().geodetic2enu(lat_deg, lon_deg, none, self.lat_deg, self.lon_deg, 0.0))

    def to_geodetic(self, position: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """(n,) latitude and longitude in degrees of positions (n, 2) in the plane."""
        xy = np.asarray(position, dtype=np.float64).reshape(-1, 2)
        pm = geodesy()
        origin = np.array(pm.geodetic2ecef(self.lat_deg, self.lon_deg, 0.0))
        axes = _axes(np.atleast_1d(self.lat_deg), np.atleast_1d(self.lon_deg))[0]
        above, up = origin + xy @ axes[:2], axes[2]
        # The foot is where the line through the plane's point meets the ellipsoid: the upper root of a quadratic.
        ellipsoid = pm.Ellipsoid.from_name("wgs84")
        weight = np.array([ellipsoid.semimajor_axis, ellipsoid.semimajor_axis, ellipsoid.semiminor_axis]) ** -2.0
        a, b, c = up**2 @ weight, above * up @ weight, above**2 @ weight - 1.0
        with np.errstate(invalid="ignore"):
            # This form of the root has no cancellation near the origin, where c and the height are small.
            height = -c / (b + np.sqrt(b**2 - a * c))
        if np.any(np.isfinite(xy).all(axis=1) & ~np.isfinite(height)):
            raise InputError(
                "LocalPlane: a position lies beyond the edge of the earth; positions are metres east, north"
            )
        lat, lon, _ = pm.ecef2geodetic(*(above + height[:, None] * up).T)
        return np.atleast_1d(lat), np.atleast_1d(lon)

    def north_deg(self, position: ArrayLike) -> float:
        """The direction of true north in the plane at a position (2,), clockwise from the plane's own north.

        >>> round(LocalPlane(50.8, -1.3).north_deg([100e3, 0.0]), 2)
        -1.1
        """
        lat, lon = self.to_geodetic(position)
        return float((bearing_in_plane(self, [0.0], lat, lon)[0] + 180.0) % 360.0 - 180.0)

    def jacobian(self, lat_deg: ArrayLike, lon_deg: ArrayLike, height_m: ArrayLike = 0.0) -> FloatArray:
        """(n, 2, 2) Jacobians from metres east and north at places (n,) to the plane, for velocities and covariances.

        They rotate by the convergence of the meridians, and shorten lengths at large heights and distances.
        """
        lat, lon = _numbers(lat_deg, lon_deg)
        here = _axes(np.atleast_1d(self.lat_deg), np.atleast_1d(self.lon_deg))[0, :2]
        there = _axes(lat, lon)[:, :2]
        shrunk = EARTH_M / (EARTH_M + np.broadcast_to(np.asarray(height_m, np.float64), lat.shape))
        return np.asarray(np.einsum("vx,nwx->nvw", here, there) * shrunk[:, None, None])


@dataclass(frozen=True)
class GroundPositions:
    """Positions on the ground (n,), and their covariances (n, 2, 2) in m², east and north at each position."""

    lat_deg: FloatArray
    lon_deg: FloatArray
    height_m: FloatArray
    covariance: FloatArray


def polar_to_geodetic(
    *,
    range_m: ArrayLike,
    bearing_deg: ArrayLike,
    sensor_lat_deg: ArrayLike,
    sensor_lon_deg: ArrayLike,
    sensor_height_m: ArrayLike = 0.0,
    height_m: ArrayLike = 0.0,
    sigma_range_m: ArrayLike,
    sigma_bearing_deg: ArrayLike,
    sigma_height_m: ArrayLike = 0.0,
) -> GroundPositions:
    """Positions of radar targets on the ground, from slant range, bearing and height.

    The elevation of a target at its height is computed on the ellipsoid. The covariance on the ground is
    J diag(σ_r², σ_h², σ_b²) Jᵀ, with ∂g/∂r = 1/cos ε and ∂g/∂h = −tan ε along the line of sight (ε the elevation) and
    g σ_b across it; ½ g² σ_b⁴ is added along it, for the curvature of the arc of a wide beam (Lerro and Bar-Shalom
    1993). Above 80° elevation J is that at 80°. The variance along is at most r²; where it is above g², it
    replaces g² in that across, so that a target straight above the sensor has an error in both directions.

    range_m : (n,) slant range. bearing_deg : (n,) clockwise from true north at the sensor.
    sensor_lat_deg, sensor_lon_deg, sensor_height_m : the sensor, numbers or (n,) if it moves.
    height_m : (n,) or a number: height of the targets above the ellipsoid. A target whose range is shorter than the
        difference in height is placed straight above or below the sensor.
    sigma_range_m, sigma_bearing_deg, sigma_height_m : 1σ errors, numbers or (n,).
    """
    r, bearing, lat0, lon0, h0, h = np.broadcast_arrays(
        *(np.atleast_1d(np.asarray(v, dtype=np.float64)) for v in
          (range_m, bearing_deg, sensor_lat_deg, sensor_lon_deg, sensor_height_m, height_m))
    )  # fmt: skip
    sight = _LinesOfSight(r, bearing, lat0, lon0, h0)
    elevation = sight.elevation_of(h)
    lat, lon, height = sight.geodetic(elevation)
    lean = np.radians(np.clip(np.abs(elevation), 0.0, STEEPEST_DEG))
    sigma_b = np.radians(np.asarray(sigma_bearing_deg, dtype=np.float64))
    ground = r * np.cos(np.radians(elevation))
    along = (sigma_range_m / np.cos(lean)) ** 2 + (np.tan(lean) * sigma_height_m) ** 2 + 0.5 * ground**2 * sigma_b**4
    # A target whose height is nearly unknown may be anywhere between the sensor and its slant range.
    along = np.where(along > r**2, np.maximum(r, sigma_range_m) ** 2, along)
    across = np.maximum(ground**2, np.where(along > ground**2, along, 0.0)) * sigma_b**2
    # The bearing of the line of sight at a far target differs from that at the sensor.
    back, _, _ = geodesy().geodetic2aer(lat0, lon0, h0, lat, lon, height)
    return GroundPositions(
        lat, lon, height, along_and_across(along, across, np.where(r > 0, np.asarray(back) + 180.0, bearing))
    )


def along_and_across(along: ArrayLike, across: ArrayLike, bearing_deg: ArrayLike) -> FloatArray:
    """(n, 2, 2) covariance of (east, north) from variances along and across a direction, clockwise from north."""
    angle = np.radians(np.asarray(bearing_deg, dtype=np.float64))
    sine, cosine = np.sin(angle), np.cos(angle)
    along, across, sine, cosine = np.broadcast_arrays(along, across, sine, cosine)
    out = np.empty((*sine.shape, 2, 2))
    out[..., 0, 0] = along * sine**2 + across * cosine**2
    out[..., 1, 1] = along * cosine**2 + across * sine**2
    out[..., 0, 1] = out[..., 1, 0] = (along - across) * sine * cosine
    return out


def plane_polar(
    *,
    range_m: ArrayLike,
    bearing_deg: ArrayLike,
    sensor_m: ArrayLike,
    sigma_range_m: ArrayLike,
    sigma_bearing_deg: ArrayLike,
) -> tuple[FloatArray, FloatArray]:
    """(n, 2) positions and (n, 2, 2) covariances from ranges and bearings in a plane without geodetic coordinates.

    sensor_m : (2,) or (n, 2), east and north of the sensor.
    """
    r, bearing = _numbers(range_m, bearing_deg)
    angle, sigma_b = np.radians(bearing), np.radians(np.asarray(sigma_bearing_deg, dtype=np.float64))
    position = np.asarray(sensor_m, dtype=np.float64) + r[:, None] * np.column_stack([np.sin(angle), np.cos(angle)])
    along = np.asarray(sigma_range_m, dtype=np.float64) ** 2 + 0.5 * r**2 * sigma_b**4
    return position, along_and_across(along, (r * sigma_b) ** 2, bearing)


def bearing_in_plane(
    plane: LocalPlane, bearing_deg: ArrayLike, sensor_lat_deg: ArrayLike, sensor_lon_deg: ArrayLike
) -> FloatArray:
    """(n,) bearings relative to the plane's north, from bearings relative to true north at the sensor."""
    bearing, lat, lon = (
        np.atleast_1d(np.asarray(v, np.float64)) for v in (bearing_deg, sensor_lat_deg, sensor_lon_deg)
    )
    angle = np.radians(bearing)
    direction = np.einsum("nvw,nw->nv", plane.jacobian(lat, lon), np.column_stack([np.sin(angle), np.cos(angle)]))
    return np.asarray(np.degrees(np.arctan2(direction[:, 0], direction[:, 1])) % 360.0)


@dataclass(frozen=True)
class _LinesOfSight:
    """Lines of sight (n,) from sensors; lat_deg, lon_deg, height_m : of the sensors."""

    range_m: FloatArray
    bearing_deg: FloatArray
    lat_deg: FloatArray
    lon_deg: FloatArray
    height_m: FloatArray

    def geodetic(self, elevation_deg: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """(n,) latitude, longitude and height of the ends of the lines at these elevations."""
        sensor = (self.lat_deg, self.lon_deg, self.height_m)
        lat, lon, height = geodesy().aer2geodetic(self.bearing_deg, elevation_deg, self.range_m, *sensor)
        return np.atleast_1d(lat), np.atleast_1d(lon), np.atleast_1d(height)

    def elevation_of(self, height_m: FloatArray) -> FloatArray:
        """(n,) degrees: elevation of the line whose end has this height."""
        r, start = np.maximum(self.range_m, 1e-9), EARTH_M + self.height_m
        climb = height_m - self.height_m
        # Law of cosines on a sphere, then two corrections for the ellipsoid.
        sine = np.clip((climb * (2.0 * start + climb) - r**2) / (2.0 * start * r), -1.0, 1.0)
        for _ in range(2):
            elevation = np.degrees(np.arcsin(sine))
            sine = np.clip(sine + (height_m - self.geodetic(elevation)[2]) / r, -1.0, 1.0)
        return np.asarray(np.degrees(np.arcsin(sine)))


def _axes(lat_deg: FloatArray, lon_deg: FloatArray) -> FloatArray:
    """(n, 3, 3) unit vectors east, north and up at places, in earth-centred coordinates."""
    phi, lam = np.radians(lat_deg), np.radians(lon_deg)
    sp, cp, sl, cl = np.sin(phi), np.cos(phi), np.sin(lam), np.cos(lam)
    zero = np.zeros_like(phi)
    rows = [[-sl, cl, zero], [-sp * cl, -sp * sl, cp], [cp * cl, cp * sl, sp]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _numbers(first: ArrayLike, second: ArrayLike) -> tuple[FloatArray, FloatArray]:
    a, b = (np.atleast_1d(np.asarray(np.ma.filled(v, np.nan), dtype=np.float64)) for v in (first, second))
    a, b = np.broadcast_arrays(a, b)
    return a, b


def _degrees(source: str, lat: FloatArray, lon: FloatArray) -> None:
    with np.errstate(invalid="ignore"):
        for name, values, limit in (("latitudes", lat, 90.0), ("longitudes", lon, 360.0)):
            beyond = np.flatnonzero(np.abs(values) > limit)
            if len(beyond):
                raise InputError(
                    f"{source}: {len(beyond)} {name} lie beyond ±{limit:.0f}° (first: row {beyond[0]}: "
                    f"{values[beyond[0]]:g}); give latitude, longitude in degrees"
                )

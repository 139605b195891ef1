"""Reports brought to the plane of the picture: positions with covariances, velocities, directions.

:func:`placed` takes what a source wrote (``Reports``) and what is known of the source (``Description``) and gives
:class:`~sameas.tracks.alignment.States`, or :class:`Directions` where the source knows no distance. What a report
states of its errors counts; what it does not state comes from the description.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.errors import Argument, InputError, Message, naming
from sameas.many.observations import Bearing
from sameas.records import unpack
from sameas.tracks.alignment import States
from sameas.tracks.coordinates import (
    LocalPlane,
    along_and_across,
    bearing_in_plane,
    plane_polar,
    polar_to_geodetic,
    turned,
)
from sameas.tracks.reports import Reports
from sameas.tracks.source import Description

#: A radar whose place nobody tells is taken to stand so far from its targets: this share of its range.
USUAL_SHARE = 0.25
#: Of a source with so many positions or more, one is a stray beyond so many times the distance from their middle within
#: which nine of ten lie, and so many metres.
FEW, STRAY, STRAY_M = 20, 20.0, 20e3


@dataclass(frozen=True)
class Directions:
    """Bearings of a source that knows no distance: (n,) degrees from the plane's north, 1σ, and (n, 2) the sensor."""

    time_s: FloatArray
    bearing_deg: FloatArray
    sigma_deg: FloatArray
    sensor_m: FloatArray
    track: NDArray[Any] | None
    rows: IntArray

    def __len__(self) -> int:
        return len(self.time_s)

    @cached_property
    def usable(self) -> BoolArray:
        """(n,) whether a report has a direction with its error."""
        known = np.isfinite(self.bearing_deg) & np.isfinite(self.sigma_deg) & np.isfinite(self.sensor_m).all(axis=1)
        return np.asarray(known)


@dataclass(frozen=True)
class SlowBearing(Bearing):
    """A :class:`~sameas.many.observations.Bearing` that turns no faster than an object at ``nearest_m`` makes it turn.

    Where a lone direction is brought together with a broad region, the search for its most probable state may pass by
    the sensor itself, where directions have no slope that means anything.
    """

    nearest_m: float = 1.0

    def jacobian(self, states: FloatArray) -> FloatArray:
        arm = states[:, :2] - np.asarray(self.sensor)
        away = np.hypot(*arm.T)
        slope = super().jacobian(states)
        return np.asarray(slope * (np.minimum(away / self.nearest_m, 1.0) ** 2)[:, None, None])


@dataclass(frozen=True)
class _Placed:
    """Positions (n, 2) in the plane, covariances (n, 2, 2), and matrices from metres at each place to the plane's."""

    position: FloatArray
    covariance: FloatArray
    turn: FloatArray


def placed(description: Description, reports: Reports, plane: LocalPlane | None = None) -> States | Directions:
    """The reports of one source in the plane of the picture, at the times for which they hold.

    Parameters
    ----------
    description : of the source. Its latency is taken off the stamps, its errors stand where a report states none.
    reports : as a reader gave them.
    plane : of the picture; None for sources that give metres in a plane of the user's own.

    Raises
    ------
    InputError : a position, error or site that is needed is not there; the message says which and where to give it.
    """
    time_s = reports.time_s - (description.timing.latency_s or 0.0)
    track = next((c for c in (reports.track_id, reports.mmsi, reports.icao) if c is not None), None)
    if reports.position == "bearing":
        return _directions(description, reports, plane, time_s, track)
    how = {"geodetic": _of_geodetic, "local": _of_local, "polar": _of_polar}[reports.position]
    place = how(description, reports, plane)
    velocity, spread = _velocity(description, reports)
    if velocity is not None and spread is not None:
        velocity, spread = np.einsum("nvw,nw->nv", place.turn, velocity), turned(spread, place.turn)
    return States.of(
        time_s, place.position, place.covariance, velocity=velocity, velocity_covariance=spread, track=_named(track),
        speed_m_per_s=_needed(description, "motion", "speed_m_per_s"), source=description.name,
    )  # fmt: skip


def _named(track: NDArray[Any] | None) -> NDArray[Any] | None:
    """Names of tracks; reports without one, among others that have one, are tracks of their own."""
    if track is None:
        return None
    return np.array([f"unnamed {k}" if name is None else str(name) for k, name in enumerate(track)], dtype=object)


def _of_geodetic(description: Description, reports: Reports, plane: LocalPlane | None) -> _Placed:
    if plane is None:
        raise InputError(f"{description.name}: positions are latitudes and longitudes; give the plane of the picture")
    lat, lon = np.asarray(reports.lat_deg), np.asarray(reports.lon_deg)
    turn = plane.turn(lat, lon, 0.0 if reports.alt_m is None else np.nan_to_num(reports.alt_m))
    position = _without_strays(plane.of_geodetic(lat, lon, description.name))
    stated = turned(_stated(description, reports), turn)
    return _Placed(position, _as_measured(description, reports, plane, position, stated), turn)


def _without_strays(position: FloatArray) -> FloatArray:
    """The positions, NaN where one lies absurdly far from the others of its source."""
    known = np.isfinite(position).all(axis=1)
    if known.sum() < FEW:
        return position
    away = np.hypot(*(position - np.median(position[known], axis=0)).T)
    limit = max(STRAY * float(np.quantile(away[known], 0.9)), STRAY_M)
    return np.where((away > limit)[:, None], np.nan, position)


def set_aside(reports: Reports, there: States | Directions) -> tuple[str, ...]:
    """A sentence that names the reports whose positions are too far off to be believed; none where none is."""
    if reports.lat_deg is None or reports.lon_deg is None or isinstance(there, Directions):
        return ()
    said = np.isfinite(reports.lat_deg) & np.isfinite(reports.lon_deg)
    lines = reports.line[said & ~np.isfinite(there.state[:, 0])]
    if not len(lines):
        return ()
    unit = reports.damaged.unit if len(lines) == 1 else f"{reports.damaged.unit}s"
    listed = ", ".join(str(line) for line in lines[:5]) + (", …" if len(lines) > 5 else "")
    return (
        f"{reports.source}: {len(lines)} of {len(reports)} positions lie absurdly far from the rest and were set aside "
        f"({unit} {listed})",
    )


def _of_local(description: Description, reports: Reports, plane: LocalPlane | None) -> _Placed:
    n = len(reports)
    xy = np.column_stack([np.asarray(reports.x_m), np.asarray(reports.y_m)])
    stated = _stated(description, reports)
    if plane is None:
        covariance = _as_measured(description, reports, None, xy, stated)
        return _Placed(xy, covariance, np.broadcast_to(np.eye(2), (n, 2, 2)))
    site = description.site
    if site is None or site.lat_deg is None or site.lon_deg is None:
        raise InputError(
            f"{description.name}: positions are metres in a plane of its own",
            naming("give the origin of that plane, site = {{ lat_deg = …, lon_deg = … }}, in its {description}"),
        )
    lat, lon = LocalPlane(site.lat_deg, site.lon_deg).to_geodetic(xy)
    turn = plane.turn(np.full(n, site.lat_deg), np.full(n, site.lon_deg))
    position = plane.of_geodetic(lat, lon, description.name)
    return _Placed(position, _as_measured(description, reports, plane, position, turned(stated, turn)), turn)


def _of_polar(description: Description, reports: Reports, plane: LocalPlane | None) -> _Placed:
    distance, bearing = np.asarray(reports.range_m), reports.bearing_deg
    if bearing is None:
        raise InputError(f"{description.name}: ranges without bearings; no position follows from them")
    _needed(description, "errors", "range_m")
    own_range = description.errors.sigma_range_m(distance)
    sigma_range = _filled(reports.sigma_range_m, own_range)
    sigma_bearing = _filled(reports.sigma_bearing_deg, _needed(description, "errors", "bearing_deg"), len(reports))
    extent = (description.errors.extent_m or 0.0) ** 2 * np.eye(2)
    if plane is None:
        sensor = _sensor_m(description, reports, None)
        position, covariance = plane_polar(
            range_m=distance, bearing_deg=bearing, sensor_m=sensor, sigma_range_m=sigma_range,
            sigma_bearing_deg=sigma_bearing,
        )  # fmt: skip
        return _Placed(position, covariance + extent, np.broadcast_to(np.eye(2), (len(reports), 2, 2)))
    lat, lon, height = _sensor_geodetic(description, reports)
    target, sigma_height = _heights(description, reports, distance, height)
    ground = polar_to_geodetic(
        range_m=distance, bearing_deg=bearing, sensor_lat_deg=lat, sensor_lon_deg=lon, sensor_height_m=height,
        height_m=target, sigma_range_m=sigma_range, sigma_bearing_deg=sigma_bearing, sigma_height_m=sigma_height,
    )  # fmt: skip
    turn = plane.turn(ground.lat_deg, ground.lon_deg, ground.height_m)
    position = plane.of_geodetic(ground.lat_deg, ground.lon_deg, description.name)
    return _Placed(position, turned(ground.covariance + extent, turn), turn)


def _heights(
    description: Description, reports: Reports, distance: FloatArray, sensor_height_m: float
) -> tuple[FloatArray, FloatArray]:
    """(n,) heights of the targets and their 1σ: as reported, from the elevation, from the flight level, or assumed."""
    assumed, spread = description.targets.height_m or 0.0, description.targets.height_sigma_m or 0.0
    height, sigma = np.full(len(reports), assumed), np.full(len(reports), spread)
    own = description.errors.height_m or 0.0
    if reports.elevation_deg is not None:
        lean = np.radians(reports.elevation_deg)
        from_angle = sensor_height_m + distance * np.sin(lean) + (distance * np.cos(lean)) ** 2 / (2 * 6.371e6)
        error = np.radians(_filled(reports.sigma_elevation_deg, description.errors.bearing_deg or 0.0, len(reports)))
        known = np.isfinite(from_angle)
        height[known], sigma[known] = from_angle[known], (distance * np.cos(lean) * error)[known]
    for column in (reports.pressure_alt_m, reports.alt_m):
        if column is not None:
            known = np.isfinite(column)
            height[known], sigma[known] = column[known], _filled(reports.sigma_alt_m, own, len(reports))[known]
    return height, sigma


def _directions(
    description: Description, reports: Reports, plane: LocalPlane | None, time_s: FloatArray, track: NDArray[Any] | None
) -> Directions:
    bearing = np.asarray(reports.bearing_deg, dtype=np.float64)
    sigma = _filled(reports.sigma_bearing_deg, _needed(description, "errors", "bearing_deg"), len(reports))
    sensor = _sensor_m(description, reports, plane)
    if plane is not None:
        lat, lon, _ = _sensor_geodetic(description, reports)
        bearing = bearing_in_plane(plane, bearing, lat, lon)
    names = None if track is None else _named(track)
    return Directions(time_s, bearing % 360.0, sigma, sensor, names, np.arange(len(reports)))


def _sensor_geodetic(description: Description, reports: Reports) -> tuple[FloatArray, FloatArray, float]:
    """(n,) latitude and longitude of the sensor, and its height."""
    site, n = description.site, len(reports)
    height = 0.0 if site is None else site.height_m
    if reports.station_lat_deg is not None and reports.station_lon_deg is not None:
        return reports.station_lat_deg, reports.station_lon_deg, height
    if site is None or site.lat_deg is None or site.lon_deg is None:
        raise InputError(
            f"{description.name}: nothing says where the sensor is",
            naming("give site = {{ lat_deg = …, lon_deg = … }} in its {description}"),
        )
    return np.full(n, site.lat_deg), np.full(n, site.lon_deg), height


def _sensor_m(description: Description, reports: Reports, plane: LocalPlane | None) -> FloatArray:
    """(n, 2) the sensor in the plane."""
    if plane is not None:
        lat, lon, _ = _sensor_geodetic(description, reports)
        return plane.of_geodetic(lat, lon, description.name)
    if reports.station_x_m is not None and reports.station_y_m is not None:
        return np.column_stack([reports.station_x_m, reports.station_y_m])
    if description.site is None:
        raise InputError(
            f"{description.name}: nothing says where the sensor is",
            naming("give site = {{ east_m = …, north_m = … }} in its {description}"),
        )
    return np.broadcast_to(description.site.in_plane(None), (len(reports), 2)).copy()


def sensor_places(description: Description, reports: Reports, plane: LocalPlane | None) -> FloatArray | None:
    """(n, 2) where the sensor was at each report; None where nothing says so."""
    moves = reports.station_lat_deg is not None or reports.station_x_m is not None
    return _sensor_m(description, reports, plane) if moves or description.site is not None else None


def _stated(description: Description, reports: Reports) -> FloatArray:
    """(n, 2, 2) covariances on east and north: stated by the reports, else errors.position_m, else NaN."""
    given = np.full((len(reports), 3), np.nan) if reports.covariance_m2 is None else reports.covariance_m2
    covariance = unpack(given, 2)
    silent = ~np.isfinite(covariance).all(axis=(1, 2))
    if silent.any() and description.errors.position_m is not None:
        own = np.hypot(description.errors.position_m, description.errors.extent_m or 0.0)
        covariance[silent] = own**2 * np.eye(2)
    return covariance


def _as_measured(
    description: Description, reports: Reports, plane: LocalPlane | None, position: FloatArray, stated: FloatArray
) -> FloatArray:
    """(n, 2, 2) the stated covariances; where there are none, those of the range and bearing that were measured.

    Where nothing says from where, the wider of both at the distance of :func:`_usual_m`.
    """
    silent = ~np.isfinite(stated).all(axis=(1, 2))
    if not silent.any():
        return stated
    if description.errors.range_m is None or description.errors.bearing_deg is None:
        _needed(description, "errors", "position_m")
    sensor_m = sensor_places(description, reports, plane)
    arm = position - (np.nan if sensor_m is None else sensor_m)
    known = np.isfinite(arm[:, 0]) & np.isfinite(arm[:, 1])
    lost = silent & ~known & np.isfinite(position).all(axis=1)
    away = np.where(known, np.hypot(*arm.T), _usual_m(description) if lost.any() else np.nan)
    along = description.errors.sigma_range_m(away)
    across = away * np.radians(description.errors.bearing_deg or 0.0)
    # Who may stand anywhere may look from anywhere.
    along, across = np.where(known, [along, across], np.maximum(along, across))
    extent_m2 = (description.errors.extent_m or 0.0) ** 2
    bearing = np.where(known, np.degrees(np.arctan2(arm[:, 0], arm[:, 1])), 0.0)
    out = stated.copy()
    out[silent] = along_and_across(along**2 + extent_m2, across**2 + extent_m2, bearing)[silent]
    return out


def _usual_m(description: Description) -> float:
    return USUAL_SHARE * _needed(description, "coverage", "range_m")


def supposed(description: Description, reports: Reports) -> tuple[str, ...]:
    """A sentence that tells how good positions are taken to be that state no errors; none where all do."""
    given = reports.covariance_m2
    silent = len(reports) - (0 if given is None else int(np.isfinite(given).all(axis=-1).sum()))
    if reports.position not in ("geodetic", "local") or not silent or description.errors.position_m is not None:
        return ()
    name, errors = description.name, description.errors
    good = f"as good as a range ± {errors.range_m:g} m ± {100.0 * (errors.range_share or 0.0):g} % and a bearing "
    good += f"± {errors.bearing_deg:g}°"
    if description.site is None and reports.station_lat_deg is None and reports.station_x_m is None:
        good += f" at {_usual_m(description) / 1000.0:.3g} km, since nothing says where it stands"
    return (f"{name}: {silent} positions state no errors; they are taken to be {good}; errors.position_m says better",)


def _velocity(description: Description, reports: Reports) -> tuple[FloatArray | None, FloatArray | None]:
    """(n, 2) and (n, 2, 2) on east and north; NaN where not said."""
    velocity = reports.velocity_m_per_s()
    if velocity is None:
        return None, None
    given = reports.velocity_covariance_m2_per_s2
    spread = unpack(np.full((len(reports), 3), np.nan) if given is None else given, 2)
    silent = np.isfinite(velocity).all(axis=1) & ~np.isfinite(spread).all(axis=(1, 2))
    if silent.any():
        sigma = _needed(description, "errors", "speed_m_per_s")
        turn = np.radians(_needed(description, "errors", "course_deg"))
        speed, course = np.hypot(*velocity.T), np.degrees(np.arctan2(velocity[:, 0], velocity[:, 1]))
        # Who hardly moves has no course: there the error across is that of the speed.
        own = along_and_across(sigma**2, np.maximum(sigma, speed * turn) ** 2, np.nan_to_num(course))
        spread[silent] = own[silent]
    return velocity, spread


def _filled(column: FloatArray | None, default: FloatArray | float, n: int | None = None) -> FloatArray:
    """The column, with the default where it says nothing."""
    values = np.broadcast_to(np.asarray(default, dtype=np.float64), (n,) if n is not None else np.shape(default))
    return values.copy() if column is None else np.where(np.isfinite(column), column, values)


def _needed(description: Description, part: str, name: str) -> float:
    value = getattr(getattr(description, part), name)
    if value is None:
        raise InputError(
            f"{description.name}: {part}.{name} is not known and {description.kind!r} assumes none",
            Message(f"give {part} = {{ {name} = … }} in its ", Argument("description")),
        )
    return float(value)

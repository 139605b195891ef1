"""Reports in the plane of the picture: positions with covariances, velocities, directions.

:class:`PlacedReports` combines the ``Reports`` of a source, its ``Description`` and the plane. Its ``in_plane`` are
:class:`~sameas.tracks.alignment.States`, or :class:`Directions` if the source measures no distance. Errors stated by a
report are used; the others come from the description.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import BoolArray, FloatArray, IntArray, finite_rows
from sameas.errors import Argument, InputError, Message, naming
from sameas.gaussian import propagated
from sameas.many.observations import Bearing
from sameas.records import unpack
from sameas.tracks.alignment import States
from sameas.tracks.coordinates import (
    EARTH_M,
    LocalPlane,
    along_and_across,
    bearing_in_plane,
    plane_polar,
    polar_to_geodetic,
)
from sameas.tracks.reports import Reports
from sameas.tracks.source import Description, SensorErrors

#: Ranges longer than this are in another unit; no sensor reaches farther, metres.
LONGEST_M = 900e3
#: Beginning of the names that reports without an id are given.
UNNAMED = "unnamed "

#: Assumed range of the targets of a radar without a site, as a share of its maximum range.
UNKNOWN_SITE_SHARE = 0.25
#: In a source of at least STRAY_COUNT positions, those farther from the median than STRAY_M and than STRAY_RADII × the
#: radius of 90 % of them are excluded.
STRAY_COUNT, STRAY_RADII, STRAY_M = 20, 20.0, 20e3


def unnamed(names: list[str]) -> list[int]:
    """The places of the names that reports without an id were given."""
    # One search of all names at once: usually there are none.
    return [k for k, name in enumerate(names) if name.startswith(UNNAMED)] if UNNAMED in "\n".join(names) else []


@dataclass(frozen=True)
class Directions:
    """Bearings without distances: (n,) degrees clockwise from the plane's north, and 1σ; (n, 2) sensor positions.

    lasting_deg : (n,) the part of the 1σ that is the same in all reports of the source: that of its offset.
    """

    time_s: FloatArray
    bearing_deg: FloatArray
    sigma_deg: FloatArray
    sensor_m: FloatArray
    track: NDArray[Any] | None
    rows: IntArray
    lasting_deg: FloatArray | float = 0.0

    def __len__(self) -> int:
        return len(self.time_s)

    @cached_property
    def usable(self) -> BoolArray:
        """(n,) whether a report has a direction, its error and a sensor position."""
        known = np.isfinite(self.bearing_deg) & np.isfinite(self.sigma_deg) & np.isfinite(self.sensor_m).all(axis=1)
        return np.asarray(known)


@dataclass(frozen=True)
class SlowBearing(Bearing):
    """A :class:`~sameas.many.observations.Bearing` whose Jacobian is limited to that at the distance ``nearest_m``.

    The search for the most probable state given a single direction in a broad region may pass through the sensor, where
    the Jacobian is infinite.
    """

    nearest_m: float = 1.0

    def jacobian(self, states: FloatArray) -> FloatArray:
        arm = states[:, :2] - np.asarray(self.sensor)
        range_m = np.hypot(*arm.T)
        jacobian = super().jacobian(states)
        return np.asarray(jacobian * (np.minimum(range_m / self.nearest_m, 1.0) ** 2)[:, None, None])


@dataclass(frozen=True)
class _Positions:
    """Positions (n, 2) in the plane, covariances (n, 2, 2), and matrices from local east and north to the plane."""

    position: FloatArray
    covariance: FloatArray
    to_plane: FloatArray


@dataclass(frozen=True)
class PlacedReports:
    """The reports of one source in the plane of the picture, with the latency of the source subtracted from the times.

    description : of the source, with its latency, and its errors for reports that state none.
    reports : as read.
    plane : of the picture; None for sources that give metres in a plane of the user's own.

    >>> reports = Reports.of("radar", "table", {"time_s": [10.0], "x_m": [5.0], "y_m": [0.0]})
    >>> PlacedReports(Description("radar", "ais"), reports).in_plane.state[0, :2].tolist()
    [5.0, 0.0]
    """

    description: Description
    reports: Reports
    plane: LocalPlane | None = None

    @cached_property
    def in_plane(self) -> States | Directions:
        """States, or directions if the source measures no distance.

        Raises InputError: a position, error or site that is needed is missing.
        """
        if self.reports.position == "bearing":
            return self._directions()
        positions = {"geodetic": self._geodetic, "local": self._local, "polar": self._polar}[self.reports.position]()
        velocity, covariance = self._velocities()
        if velocity is not None and covariance is not None:
            velocity = np.einsum("nvw,nw->nv", positions.to_plane, velocity)
            covariance = propagated(positions.to_plane, covariance)
        return States.of(
            self._time_s, positions.position, positions.covariance, velocity=velocity, velocity_covariance=covariance,
            track=self._tracks, speed_m_per_s=self._needed("motion", "speed_m_per_s"), source=self.description.name,
        )  # fmt: skip

    @cached_property
    def sensor_m(self) -> FloatArray | None:
        """(n, 2) position of the sensor at each report; None if it is unknown."""
        stated = self.reports.station_lat_deg is not None or self.reports.station_x_m is not None
        return self._sensor_in_plane() if stated or self.description.site is not None else None

    @property
    def notes(self) -> tuple[str, ...]:
        """Printable sentences on excluded positions and assumed errors."""
        return self.strays_note + self.errors_note

    @property
    def strays_note(self) -> tuple[str, ...]:
        """A sentence that lists the reports with excluded positions; empty if there are none."""
        reports, placed = self.reports, self.in_plane
        if reports.lat_deg is None or reports.lon_deg is None or isinstance(placed, Directions):
            return ()
        stated = np.isfinite(reports.lat_deg) & np.isfinite(reports.lon_deg)
        lines = reports.line[stated & ~np.isfinite(placed.state[:, 0])]
        if not len(lines):
            return ()
        unit = reports.damaged.unit if len(lines) == 1 else f"{reports.damaged.unit}s"
        listed = ", ".join(str(line) for line in lines[:5]) + (", …" if len(lines) > 5 else "")
        return (
            f"{reports.source}: {len(lines)} of {len(reports)} positions lie far outside the rest and were set "
            f"aside ({unit} {listed})",
        )

    @property
    def errors_note(self) -> tuple[str, ...]:
        """A sentence on the errors assumed for positions without stated errors; empty if there are none."""
        reports, errors = self.reports, self.description.errors
        covariance = reports.covariance_m2
        n_not_stated = len(reports) - (0 if covariance is None else int(np.isfinite(covariance).all(axis=-1).sum()))
        if reports.position not in ("geodetic", "local") or not n_not_stated or errors.position_m is not None:
            return ()
        share = 100.0 * (errors.range_share or 0.0)
        assumed_errors = f"as good as a range ± {errors.range_m:g} m ± {share:g} % and a bearing "
        assumed_errors += f"± {errors.bearing_deg:g}°"
        if self.description.site is None and reports.station_lat_deg is None and reports.station_x_m is None:
            assumed_errors += f" at {self._assumed_range_m / 1000.0:.3g} km, since its position is not known"
        return (
            f"{self.description.name}: {n_not_stated} positions state no errors; assumed {assumed_errors}; "
            "errors.position_m overrides it",
        )

    @property
    def _time_s(self) -> FloatArray:
        return self.reports.time_s - (self.description.timing.latency_s or 0.0)

    @property
    def _tracks(self) -> NDArray[Any] | None:
        """Track ids; None if no report has one. A report without an id among others with ids is a track of its own."""
        ids = self.reports.object_ids
        if ids is None:
            return None
        listed = ids.tolist()
        if None in listed:
            listed = [f"{UNNAMED}{k}" if one is None else one for k, one in enumerate(listed)]
        out = np.empty(len(listed), object)
        out[:] = list(map(str, listed))
        return out

    def _geodetic(self) -> _Positions:
        if self.plane is None:
            name = self.description.name
            raise InputError(f"{name}: positions are latitudes and longitudes; give the plane of the picture")
        reports = self.reports
        lat, lon = np.asarray(reports.lat_deg), np.asarray(reports.lon_deg)
        to_plane = self.plane.jacobian(lat, lon, 0.0 if reports.alt_m is None else np.nan_to_num(reports.alt_m))
        position = _without_strays(self.plane.of_geodetic(lat, lon, self.description.name))
        stated = propagated(to_plane, self._stated_covariance())
        return _Positions(position, self._with_measured_errors(position, stated), to_plane)

    def _local(self) -> _Positions:
        reports, site, n = self.reports, self.description.site, len(self.reports)
        xy = np.column_stack([np.asarray(reports.x_m), np.asarray(reports.y_m)])
        stated = self._stated_covariance()
        if self.plane is None:
            return _Positions(xy, self._with_measured_errors(xy, stated), np.broadcast_to(np.eye(2), (n, 2, 2)))
        if site is None or site.lat_deg is None or site.lon_deg is None:
            raise InputError(
                f"{self.description.name}: positions are metres in a plane of its own",
                naming("give the origin of that plane, site = {{ lat_deg = …, lon_deg = … }}, in its {description}"),
            )
        lat, lon = LocalPlane(site.lat_deg, site.lon_deg).to_geodetic(xy)
        to_plane = self.plane.jacobian(np.full(n, site.lat_deg), np.full(n, site.lon_deg))
        position = self.plane.of_geodetic(lat, lon, self.description.name)
        return _Positions(position, self._with_measured_errors(position, propagated(to_plane, stated)), to_plane)

    def _polar(self) -> _Positions:
        reports, errors, n = self.reports, self.description.errors, len(self.reports)
        range_m, bearing = np.asarray(reports.range_m), reports.bearing_deg
        if bearing is None:
            raise InputError(f"{self.description.name}: ranges without bearings; no position follows from them")
        self._refuse_long_ranges(range_m)
        self._needed("errors", "range_m")
        sigma_range = _filled(reports.sigma_range_m, errors.sigma_range_m(range_m))
        sigma_bearing = _filled(reports.sigma_bearing_deg, self._needed("errors", "bearing_deg"), n)
        extent = (errors.extent_m or 0.0) ** 2 * np.eye(2)
        if self.plane is None:
            position, covariance = plane_polar(
                range_m=range_m, bearing_deg=bearing, sensor_m=self._sensor_in_plane(), sigma_range_m=sigma_range,
                sigma_bearing_deg=sigma_bearing,
            )  # fmt: skip
            return _Positions(position, covariance + extent, np.broadcast_to(np.eye(2), (n, 2, 2)))
        lat, lon, sensor_height_m = self._sensor_geodetic()
        height, sigma_height = self._target_heights(sensor_height_m)
        ground = polar_to_geodetic(
            range_m=range_m, bearing_deg=bearing, sensor_lat_deg=lat, sensor_lon_deg=lon,
            sensor_height_m=sensor_height_m, height_m=height, sigma_range_m=sigma_range,
            sigma_bearing_deg=sigma_bearing, sigma_height_m=sigma_height,
        )  # fmt: skip
        to_plane = self.plane.jacobian(ground.lat_deg, ground.lon_deg, ground.height_m)
        position = self.plane.of_geodetic(ground.lat_deg, ground.lon_deg, self.description.name)
        return _Positions(position, propagated(to_plane, ground.covariance + extent), to_plane)

    def _refuse_long_ranges(self, range_m: FloatArray) -> None:
        """Refuse ranges in another unit: of which at least half are longer than any sensor's."""
        far = np.flatnonzero(range_m > LONGEST_M)
        if len(far) and 2 * len(far) >= np.count_nonzero(np.isfinite(range_m)):
            raise InputError(
                f"{self.description.name}: {len(far)} ranges are longer than {LONGEST_M / 1e3:.0f} km "
                f"(first: row {far[0]}: {range_m[far[0]] / 1e3:.0f} km)",
                "are they in another unit? Give it in the name of the column, for example range_m or range_nm",
            )

    def _directions(self) -> Directions:
        reports = self.reports
        bearing = np.asarray(reports.bearing_deg, dtype=np.float64)
        sigma = _filled(reports.sigma_bearing_deg, self._needed("errors", "bearing_deg"), len(reports))
        sensor_m = self._sensor_in_plane()
        if self.plane is not None:
            lat, lon, _ = self._sensor_geodetic()
            bearing = bearing_in_plane(self.plane, bearing, lat, lon)
        return Directions(self._time_s, bearing % 360.0, sigma, sensor_m, self._tracks, np.arange(len(reports)))

    def _target_heights(self, sensor_height_m: float) -> tuple[FloatArray, FloatArray]:
        """(n,) heights of the targets and 1σ: the reported height, else the flight level, the elevation, what others
        report of the target, or assumed."""
        reports, targets, errors, n = self.reports, self.description.targets, self.description.errors, len(self.reports)
        height = _filled(reports.target_height_m, targets.height_m or 0.0, n)
        sigma = _filled(reports.sigma_target_height_m, targets.height_sigma_m or 0.0, n)
        by_elevation = heights_by_elevation(reports, errors, sensor_height_m)
        if by_elevation is not None:
            stated = np.isfinite(by_elevation[0])
            height[stated], sigma[stated] = (column[stated] for column in by_elevation)
        for column in (reports.pressure_alt_m, reports.alt_m):
            if column is not None:
                stated = np.isfinite(column)
                height[stated] = column[stated]
                sigma[stated] = _filled(reports.sigma_alt_m, errors.height_m or 0.0, n)[stated]
        return height, sigma

    def _sensor_geodetic(self) -> tuple[FloatArray, FloatArray, float]:
        """(n,) latitude and longitude of the sensor, and its height, m; refused if they are unknown."""
        site, reports, n = self.description.site, self.reports, len(self.reports)
        height = 0.0 if site is None else site.height_m
        if reports.station_lat_deg is not None and reports.station_lon_deg is not None:
            return reports.station_lat_deg, reports.station_lon_deg, height
        if site is None or site.lat_deg is None or site.lon_deg is None:
            raise InputError(
                f"{self.description.name}: the sensor's position is not known",
                naming(
                    "give site = {{ lat_deg = …, lon_deg = … }} in its {description}, or platform "
                    "= {{ mmsi = … }} if it is aboard a vessel"
                ),
            )
        return np.full(n, site.lat_deg), np.full(n, site.lon_deg), height

    def _sensor_in_plane(self) -> FloatArray:
        """(n, 2) position of the sensor in the plane; refused if it is unknown."""
        reports, site = self.reports, self.description.site
        if self.plane is not None:
            lat, lon, _ = self._sensor_geodetic()
            return self.plane.of_geodetic(lat, lon, self.description.name)
        if reports.station_x_m is not None and reports.station_y_m is not None:
            return np.column_stack([reports.station_x_m, reports.station_y_m])
        if site is None:
            raise InputError(
                f"{self.description.name}: the sensor's position is not known",
                naming(
                    "give site = {{ lat_deg = …, lon_deg = … }} in its {description}, or east_m and north_m in a plane "
                    "of your own"
                ),
            )
        return np.broadcast_to(site.in_plane(None), (len(reports), 2)).copy()

    def _stated_covariance(self) -> FloatArray:
        """(n, 2, 2) covariances of east and north: stated by the reports, else from errors.position_m, else NaN."""
        errors = self.description.errors
        covariance = self._unpacked(self.reports.covariance_m2)
        not_stated = ~finite_rows(covariance)
        if not_stated.any() and errors.position_m is not None:
            covariance[not_stated] = np.hypot(errors.position_m, errors.extent_m or 0.0) ** 2 * np.eye(2)
        return covariance

    def _with_measured_errors(self, position: FloatArray, stated: FloatArray) -> FloatArray:
        """(n, 2, 2) the stated covariances; where there are none, those of the errors in range and bearing.

        If the sensor's position is unknown, the larger of both at ``_assumed_range_m``, the same in all directions.
        """
        not_stated = ~finite_rows(stated)
        if not not_stated.any():
            return stated
        errors = self.description.errors
        if errors.range_m is None or errors.bearing_deg is None:
            self._needed("errors", "position_m")
        arm = position - (np.nan if self.sensor_m is None else self.sensor_m)
        known = np.isfinite(arm[:, 0]) & np.isfinite(arm[:, 1])
        without_sensor = not_stated & ~known & finite_rows(position)
        range_m = np.where(known, np.hypot(*arm.T), self._assumed_range_m if without_sensor.any() else np.nan)
        along = errors.sigma_range_m(range_m)
        across = range_m * np.radians(errors.bearing_deg or 0.0)
        # The direction to a sensor at an unknown position is unknown.
        along, across = np.where(known, [along, across], np.maximum(along, across))
        extent_m2 = (errors.extent_m or 0.0) ** 2
        bearing = np.where(known, np.degrees(np.arctan2(arm[:, 0], arm[:, 1])), 0.0)
        out = stated.copy()
        out[not_stated] = along_and_across(along**2 + extent_m2, across**2 + extent_m2, bearing)[not_stated]
        return out

    @property
    def _assumed_range_m(self) -> float:
        """Assumed range of the targets of a sensor at an unknown position."""
        return UNKNOWN_SITE_SHARE * self._needed("coverage", "range_m")

    def _velocities(self) -> tuple[FloatArray | None, FloatArray | None]:
        """Velocities (n, 2) and covariances (n, 2, 2) of east and north, NaN where not reported; None without any."""
        velocity = self.reports.velocity_m_per_s()
        if velocity is None:
            return None, None
        covariance = self._unpacked(self.reports.velocity_covariance_m2_per_s2)
        not_stated = finite_rows(velocity) & ~finite_rows(covariance)
        if not_stated.any():
            sigma = self._needed("errors", "speed_m_per_s")
            sigma_course = np.radians(self._needed("errors", "course_deg"))
            east, north = velocity[not_stated].T
            speed, course = np.hypot(east, north), np.degrees(np.arctan2(east, north))
            # The course of a slow object is undefined: its error across the course is that of the speed.
            across = np.maximum(sigma, speed * sigma_course) ** 2
            covariance[not_stated] = along_and_across(sigma**2, across, course)
        return velocity, covariance

    def _unpacked(self, packed: FloatArray | None) -> FloatArray:
        """(n, 2, 2) covariances from (n, 3) xx, xy, yy; NaN if absent."""
        return np.full((len(self.reports), 2, 2), np.nan) if packed is None else unpack(packed, 2)

    def _needed(self, part: str, name: str) -> float:
        """A value of the description; refused if it is missing."""
        value = getattr(getattr(self.description, part), name)
        if value is None:
            own = ", or covariance_m2 with its reports" if name == "position_m" else ""
            raise InputError(
                f"{self.description.name}: {part}.{name} is not known and {self.description.kind!r} assumes none",
                Message(f"give {part} = {{ {name} = … }} in its ", Argument("description"), own),
            )
        return float(value)


def _without_strays(position: FloatArray) -> FloatArray:
    """The positions, NaN where one is very far from the others of its source."""
    known = finite_rows(position)
    if known.sum() < STRAY_COUNT:
        return position
    distance_m = np.hypot(*(position - np.median(position[known], axis=0)).T)
    limit = max(STRAY_RADII * float(np.quantile(distance_m[known], 0.9)), STRAY_M)
    return np.where((distance_m > limit)[:, None], np.nan, position)


def _filled(column: FloatArray | None, default: FloatArray | float, n: int | None = None) -> FloatArray:
    """The column, with the default where it has no value."""
    values = np.broadcast_to(np.asarray(default, dtype=np.float64), (n,) if n is not None else np.shape(default))
    return values.copy() if column is None else np.where(np.isfinite(column), column, values)


def heights_by_elevation(
    reports: Reports, errors: SensorErrors, sensor_height_m: float
) -> tuple[FloatArray, FloatArray] | None:
    """(n,) heights and their 1σ from range and elevation, over a spherical earth; None without elevations."""
    if reports.elevation_deg is None or reports.range_m is None:
        return None
    lean = np.radians(reports.elevation_deg)
    ground_m = reports.range_m * np.cos(lean)
    height = sensor_height_m + reports.range_m * np.sin(lean) + ground_m**2 / (2 * EARTH_M)
    stated = _filled(reports.sigma_elevation_deg, errors.bearing_deg or 0.0, len(reports))
    return height, np.asarray(ground_m * np.radians(stated))

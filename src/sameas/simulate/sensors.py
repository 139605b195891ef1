"""Modelled sensors: reports of objects of known true motion, and the object of each report.

A sensor is modelled by its :class:`~sameas.tracks.source.Description`: coverage, misses, errors, clutter, resolution,
timing; a :class:`Bias` is an error that is not in its description. The motion may be real
(:class:`~sameas.simulate.sensors.TrueMotion`); results of such trials should be quoted as *real motion, modelled
sensors*. The model has independent errors, misses and false reports, but no weather, sea clutter, blind sectors or
trackers that swap targets.

- :class:`Sensor`: plots, or with a :class:`Tracker` numbered ones with velocities. ``Sensor(…)(motion, …)`` returns a
  :class:`SensorOutput`: the reports, as a reader would give them, and the truth.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator, make_smoothing_spline

from sameas.arrays import ColumnTable, FloatArray, IntArray
from sameas.errors import InputError
from sameas.gaussian import propagated
from sameas.ragged import Ragged, ranges
from sameas.representation import in_short
from sameas.tracks.alignment import States, follow
from sameas.tracks.coordinates import LocalPlane, geodesy
from sameas.tracks.feed import walk_of
from sameas.tracks.kinds import KINDS
from sameas.tracks.placement import PlacedReports
from sameas.tracks.reports import Reports
from sameas.tracks.source import Description

#: Fewest points of a smoothed curve (make_smoothing_spline needs 5).
FEWEST = 5


@dataclass(frozen=True)
class TruePath:
    """One object's reports: (k,) ascending times, (k, 3) east, north and height in metres.

    gap_s : the path is unknown between two reports with a longer interval.
    stiffness_s3 : σ²/q of the smoothing, 0 for a path through every report; see :meth:`TrueMotion.of`.
    """

    time_s: FloatArray
    place: FloatArray
    gap_s: float
    stiffness_s3: float = 0.0

    def at(self, time_s: FloatArray) -> FloatArray:
        """(..., 3) positions at any times; NaN where the path is unknown."""
        times = np.asarray(time_s, np.float64)
        out = np.full((*times.shape, 3), np.nan)
        if len(self.time_s) < 2:
            return out
        after = np.searchsorted(self.time_s, times, side="right").clip(1, len(self.time_s) - 1)
        in_path = (times >= self.time_s[0]) & (times <= self.time_s[-1])
        in_path &= self.time_s[after] - self.time_s[after - 1] <= self.gap_s
        out[in_path] = self._curve(times[in_path] - self.time_s[0])
        return out

    @cached_property
    def _curve(self) -> Callable[[FloatArray], FloatArray]:
        since = self.time_s - self.time_s[0]
        if self.stiffness_s3 == 0.0 or len(since) < FEWEST:
            through = PchipInterpolator(since, self.place)
            return lambda times: np.asarray(through(times), np.float64)
        curves = [make_smoothing_spline(since, axis, lam=self.stiffness_s3) for axis in self.place.T]
        return lambda times: np.stack([curve(times) for curve in curves], axis=-1)


@in_short
@dataclass(frozen=True)
class TrueMotion:
    """The paths of all objects in one plane. Make it with :meth:`of`; an object's number is its index in ``names``.

    A log of AIS or ADS-B is taken as the truth, and sensors are modelled on it. A smoothed path is a possible true
    motion, from which the log has errors; on a path through every report the log's errors are part of the truth.

    >>> columns = {"time_s": [0.0, 60.0], "lat_deg": [50.8, 50.8], "lon_deg": [-1.30, -1.29], "mmsi": ["235070762"] * 2}
    >>> motion = TrueMotion.of(Reports.of("ais", "table", columns))
    >>> motion.names, np.hypot(*motion.at(30.0)[0, :2]).round(1).item()
    (('235070762',), 0.0)
    """

    plane: LocalPlane
    names: tuple[str, ...]
    paths: tuple[TruePath, ...]

    @classmethod
    def of(
        cls,
        reports: Reports,
        description: Description | None = None,
        *,
        plane: LocalPlane | None = None,
        gap_s: float = 300.0,
    ) -> TrueMotion:
        """Paths of the objects named in reports, by the first available of track_id, MMSI and ICAO address.

        Parameters
        ----------
        reports : latitudes and longitudes, with heights if available. Reports without a name or a position are ignored,
            and so is the second of two with the same time.
        description : of the source of the reports. With it, paths are the smoothing splines for its errors σ
            (errors.position_m) and its objects' motion q (acceleration_m2_per_s3), Σ (x − f)² + σ²/q ∫ f̈²: the result
            of a Kalman smoother of nearly constant velocity. Without it, paths go through every report.
        plane : of the paths; by default about the reports.
        gap_s : longest interval between two reports that the path bridges.

        Raises
        ------
        InputError : no latitudes, no names, or gap_s not above 0.
        """
        if reports.lat_deg is None or reports.lon_deg is None:
            raise InputError(f"{reports.source}: true motion needs latitudes and longitudes; its positions are others")
        if not gap_s > 0.0:
            raise InputError(f"TrueMotion: gap_s is {gap_s}; give seconds above 0")
        plane = plane or LocalPlane.about(reports.lat_deg, reports.lon_deg)
        ids, height = _names(reports), _heights(reports)
        usable = np.flatnonzero(np.isfinite(reports.lat_deg) & np.isfinite(reports.lon_deg) & (ids != ""))
        lat, lon = reports.lat_deg[usable], reports.lon_deg[usable]
        place = np.column_stack([plane.of_geodetic(lat, lon, reports.source), height[usable]])
        names, number = np.unique(ids[usable], return_inverse=True)
        stiffness = 0.0 if description is None else _stiffness_s3(description)
        paths = []
        for k in range(len(names)):
            rows = np.flatnonzero(number == k)
            time_s, first = np.unique(reports.time_s[usable[rows]], return_index=True)
            paths.append(TruePath(time_s, place[rows[first]], gap_s, stiffness))
        return cls(plane, tuple(str(name) for name in names), tuple(paths))

    def __len__(self) -> int:
        return len(self.names)

    @property
    def span_s(self) -> tuple[float, float]:
        """The first and the last time of any path."""
        if not self.paths:
            raise InputError("TrueMotion: there are no paths; give reports that name their objects")
        return float(min(p.time_s[0] for p in self.paths)), float(max(p.time_s[-1] for p in self.paths))

    def at(self, instant_s: float) -> FloatArray:
        """(m, 3) east, north and height of every object at an instant; NaN where it is unknown."""
        return self.along(np.full(len(self), instant_s))

    def along(self, time_s: FloatArray) -> FloatArray:
        """(..., m, 3) positions of the objects, each at its own times (..., m)."""
        times = np.asarray(time_s, np.float64)
        if not self.paths:
            return np.empty((*times.shape, 3))
        return np.stack([path.at(times[..., k]) for k, path in enumerate(self.paths)], axis=-2)

    def objects_of(self, reports: Reports) -> IntArray:
        """(n,) number of the object that each report names; −1 (ABSENT) for an unknown one."""
        number = {name: k for k, name in enumerate(self.names)}
        return np.array([number.get(name, -1) for name in _names(reports)], np.int64)

    def only(self, which: Sequence[int] | IntArray) -> TrueMotion:
        """The paths of some of the objects, renumbered."""
        return TrueMotion(self.plane, tuple(self.names[k] for k in which), tuple(self.paths[k] for k in which))


def _heights(reports: Reports) -> FloatArray:
    """(n,) reported heights, geometric ones if available; 0 without one."""
    height = np.zeros(len(reports))
    for column in (reports.pressure_alt_m, reports.alt_m):
        height = height if column is None else np.where(np.isfinite(column), column, height)
    return height


def _stiffness_s3(description: Description) -> float:
    sigma, walk = description.errors.position_m, description.motion.acceleration_m2_per_s3
    if sigma is None or not walk:
        raise InputError(
            f"{description.name}: smoothing its paths needs errors.position_m and motion.acceleration_m2_per_s3; "
            "give both in its description, or no description"
        )
    return sigma**2 / walk


def _names(reports: Reports) -> NDArray[np.str_]:
    ids = reports.object_ids
    if ids is None:
        raise InputError(
            f"{reports.source}: reports do not name their objects; true motion needs track_id, mmsi or icao"
        )
    return np.array(["" if name is None else str(name) for name in ids], dtype=str)


@dataclass(frozen=True)
class Tracker:
    """The tracker of a modelled sensor, which numbers its plots and gives them velocities.

    It uses the true object of each plot, so its tracks never swap targets. As those of real trackers, they begin late,
    break and get new numbers, and false ones last for some scans.

    begins_after : plots that a track has before it is reported; its velocity is known from the second on.
    breaks_after : scans without a plot after which a track ends; the object gets a new number at its next plot.
    breaks : probability per scan that a track ends for another reason.
    false_looks : mean number of scans of a false echo.
    """

    begins_after: int = 2
    breaks_after: int = 5
    breaks: float = 0.0
    false_looks: float = 4.0

    def __post_init__(self) -> None:
        if self.begins_after < 0 or self.breaks_after < 1 or not 0.0 <= self.breaks < 1.0 or self.false_looks < 1.0:
            raise InputError(f"{self}: give begins_after ≥ 0, breaks_after ≥ 1, 0 ≤ breaks < 1, false_looks ≥ 1")

    def numbers(self, scan: IntArray, object: IntArray, rng: np.random.Generator) -> tuple[IntArray, IntArray]:
        """(n,) track number of every plot, in the order of the tracks' starts, and the plot's index in its track."""
        order = np.lexsort([scan, object])
        begins = np.ones(len(order), bool)
        same = object[order][1:] == object[order][:-1]
        silent = np.diff(scan[order]) > self.breaks_after
        begins[1:] = ~same | silent | (rng.random(max(len(order) - 1, 0)) < self.breaks)
        track = np.cumsum(begins) - 1
        first = np.flatnonzero(begins)
        rank = np.empty(len(first), np.int64)
        rank[np.lexsort([object[order][first], scan[order][first]])] = np.arange(1, len(first) + 1)
        number, place = np.empty(len(order), np.int64), np.empty(len(order), np.int64)
        number[order], place[order] = rank[track], np.arange(len(order)) - first[track]
        return number, place


def tracked(
    description: Description,
    tracker: Tracker,
    reports: Reports,
    plots: tuple[IntArray, IntArray],
    truth: IntArray,
    plane: LocalPlane,
    rng: np.random.Generator,
) -> tuple[Reports, IntArray]:
    """The plots of reported tracks, with numbers and velocities, and the truth of each.

    plots : scan and object of every report; false objects have numbers below −1.
    """
    number, place = tracker.numbers(*plots, rng)
    names = np.array([*(str(k) for k in number), None], object)[:-1]
    numbered = replace(reports, track_id=names)
    reported = np.flatnonzero(place >= tracker.begins_after)
    if numbered.position != "bearing":
        velocity, covariance = _followed(description, numbered, plane)
        velocity[place == 0] = np.nan
        numbered = replace(
            numbered, speed_m_per_s=np.hypot(*velocity.T), course_deg=np.degrees(np.arctan2(*velocity.T)) % 360.0,
            velocity_covariance_m2_per_s2=covariance,
        )  # fmt: skip
    return numbered.where(reported), truth[reported]


def _followed(description: Description, reports: Reports, plane: LocalPlane) -> tuple[FloatArray, FloatArray]:
    """(n, 2) velocities east and north of a filter over each track, and (n, 3) their covariances."""
    placed = PlacedReports(description, reports, plane).in_plane
    assert isinstance(placed, States)
    state = follow(placed, acceleration_m2_per_s3=walk_of(description)).states
    back = np.asarray(np.linalg.inv(plane.jacobian(*plane.to_geodetic(state.state[:, :2]))), np.float64)
    velocity = np.einsum("nvw,nw->nv", back, state.state[:, 2:])
    return velocity, propagated(back, state.covariance[:, 2:, 2:])[:, [0, 0, 1], [0, 1, 1]]


#: Flight levels are reported in steps of 100 feet.
LEVEL_M = 30.48


@dataclass(frozen=True)
class Bias:
    """Undescribed biases of a sensor: range too long, azimuth too far clockwise, range gain, late time stamps.

    east_m, north_m : shift of the positions of a source without a site.
    """

    range_m: float = 0.0
    azimuth_deg: float = 0.0
    range_gain: float = 0.0
    time_s: float = 0.0
    east_m: float = 0.0
    north_m: float = 0.0


@dataclass(frozen=True)
class SensorOutput:
    """The output of a modelled sensor.

    reports : in the order of time stamps. truth : (n,) number of the object of the true motion, −1 (ABSENT) for
    false reports. scan_times_s : (l,) stamps of all scans, empty ones included.
    """

    reports: Reports
    truth: IntArray
    scan_times_s: FloatArray


@dataclass(frozen=True)
class Echoes(ColumnTable):
    """Echoes (n,): the scan, the object (below 0: false), the time and the position of each.

    place : (n, 3) east, north, height in the plane of the motion. sight : (n, 2) true range and bearing from the
    sensor.
    """

    scan: IntArray
    object: IntArray
    time_s: FloatArray
    place: FloatArray
    sight: FloatArray

    def __len__(self) -> int:
        return len(self.scan)

    def and_those_of(self, other: Echoes) -> Echoes:
        """Both, in the order of time."""
        both = self.stacked(other)
        return both.take(np.lexsort([both.object, both.time_s]))


@in_short
@dataclass(frozen=True)
class Sensor:
    """One modelled sensor, called with a true motion, a span of time and a generator of random numbers.

    A sensor with a site measures range and bearing; of kind camera or esm the bearing alone; without a site positions.
    Errors are ``errors.position_m`` on each axis if the description has it (every report then quotes the corresponding
    errors of range and bearing), else range_m, range_share and bearing_deg. The antenna rotates once a period, from
    north, and measures each object when it points at it. Two objects within both the range and the bearing resolution
    have one echo, that of the object with the smaller number.

    Parameters
    ----------
    description : of the sensor; its latency is added to the time stamps.
    bias : not in the description.
    tracker : numbers the plots; None for plots without numbers.

    Example
    -------
    >>> from sameas.tracks.source import MissRate, Site
    >>> columns = {"time_s": [0.0, 60.0], "lat_deg": [50.8, 50.8], "lon_deg": [-1.30, -1.29], "mmsi": ["235070762"] * 2}
    >>> motion = TrueMotion.of(Reports.of("ais", "table", columns))
    >>> radar = Description("radar", "marine radar", site=Site(50.75, -1.3), misses=MissRate(0.01))
    >>> output = Sensor(radar)(motion, (0.0, 60.0), np.random.default_rng(1))
    >>> output.reports.position, len(output.scan_times_s), int(np.sum(output.truth == 0)) in (18, 19, 20)
    ('polar', 20, True)
    """

    description: Description
    bias: Bias = Bias()
    tracker: Tracker | None = None

    def __call__(self, motion: TrueMotion, span_s: tuple[float, float], rng: np.random.Generator) -> SensorOutput:
        period = self.description.timing.period_s
        if period is None:
            raise InputError(f"{self.description.name}: timing.period_s is not known; give seconds between looks")
        scan_times = np.arange(*span_s, period)
        detected = self._resolved(self._detected(self._passed(motion, scan_times, period), rng))
        echoes = detected.and_those_of(self._false(motion, scan_times, period, rng))
        jitter = rng.normal(size=len(scan_times)) * (self.description.timing.latency_sigma_s or 0.0)
        late = (self.description.timing.latency_s or 0.0) + self.bias.time_s + jitter
        columns = self._measured(motion, echoes, rng) | {"time_s": echoes.time_s + late[echoes.scan]}
        truth = np.maximum(echoes.object, -1)
        reports = Reports.of(self.description.name, "table", columns)
        if self.tracker is not None:
            scan_and_object = (echoes.scan, echoes.object)
            reports, truth = tracked(self.description, self.tracker, reports, scan_and_object, truth, motion.plane, rng)
        order = np.argsort(reports.time_s, kind="stable")
        reports = replace(reports.where(order), line=np.arange(1, len(reports) + 1))
        return SensorOutput(reports, truth[order], scan_times + late)

    @property
    def _turns(self) -> bool:
        return self.description.site is not None and not KINDS[self.description.kind].directions

    def _passed(self, motion: TrueMotion, scan_times: FloatArray, period: float) -> Echoes:
        """Every object at every scan, at its position when the antenna points at it."""
        times = np.broadcast_to(scan_times[:, None], (len(scan_times), len(motion))).copy()
        place = motion.along(times)
        sight = self._sight(motion, place)
        if self._turns:
            times += np.nan_to_num(sight[..., 1]) / 360.0 * period
            place = motion.along(times)
            sight = self._sight(motion, place)
        scan, number = np.nonzero(np.isfinite(place).all(axis=-1))
        known = (scan, number)
        return Echoes(scan, number, times[known], place[known], sight[known])

    def _sight(self, motion: TrueMotion, place: FloatArray) -> FloatArray:
        """(..., 2) slant range and bearing from the sensor; NaN where the sensor has no site."""
        out = np.full((*place.shape[:-1], 2), np.nan)
        site, in_path = self.description.site, np.isfinite(place).all(axis=-1)
        if site is None or not in_path.any():
            return out
        if site.lat_deg is None or site.lon_deg is None:
            raise InputError(f"{self.description.name}: a modelled sensor needs site = {{ lat_deg, lon_deg }}")
        lat, lon = motion.plane.to_geodetic(place[in_path][:, :2])
        target_and_site = (lat, lon, place[in_path][:, 2], site.lat_deg, site.lon_deg, site.height_m)
        bearing, _, distance = geodesy().geodetic2aer(*target_and_site)
        out[in_path] = np.column_stack([distance, bearing])
        return out

    def _detected(self, echoes: Echoes, rng: np.random.Generator) -> Echoes:
        """The echoes within the coverage that are not missed."""
        if self.description.site is None:
            q = np.broadcast_to(self.description.misses.at(0.0), (len(echoes),))
        else:
            q = self.description.q_at(*echoes.sight.T)
        return echoes.take(rng.random(len(echoes)) >= np.nan_to_num(q))

    def _resolved(self, echoes: Echoes) -> Echoes:
        """The echoes without those that are not resolved from another one of the same scan."""
        beam, cell = self.description.resolution.bearing_deg or 0.0, self.description.resolution.range_m or 0.0
        if self.description.site is None or not (beam and cell):
            return echoes
        keep = np.ones(len(echoes), bool)
        # Echoes are ordered by scan, then by object.
        starts = Ragged.of_sorted(echoes.scan, echoes.scan.max(initial=-1) + 1).start
        for low, high in pairwise(starts):
            apart = np.abs(echoes.sight[low:high, None] - echoes.sight[None, low:high])
            turn = np.minimum(apart[..., 1], 360.0 - apart[..., 1])
            keep[low:high] = ~np.tril((apart[..., 0] < cell) & (turn < beam), -1).any(axis=1)
        return echoes.take(keep)

    def _false(self, motion: TrueMotion, scan_times: FloatArray, period: float, rng: np.random.Generator) -> Echoes:
        """False echoes, uniform over the coverage; with a tracker each stays at its position for some scans."""
        site, reach = self.description.site, self.description.coverage.range_m
        per_m2 = (self.description.clutter.per_km2 or 0.0) / 1e6
        if site is None or not self._turns or reach is None or not per_m2:
            none = np.empty(0, np.int64)
            return Echoes(none, none, np.empty(0), np.empty((0, 3)), np.empty((0, 2)))
        lasting = 1.0 if self.tracker is None else self.tracker.false_looks
        count = rng.poisson(per_m2 * np.pi * reach**2 * (len(scan_times) + lasting - 1.0) / lasting)
        begin = rng.integers(-int(lasting - 1), len(scan_times), count)
        end = begin + rng.geometric(1.0 / lasting, count)
        sight = np.column_stack([reach * np.sqrt(rng.random(count)), rng.uniform(0.0, 360.0, count)])
        covered = self.description.coverage.covers(*sight.T)
        owner, scan = ranges(begin, np.where(covered, end - begin, 0))
        inside = (scan >= 0) & (scan < len(scan_times))
        owner, scan = owner[inside], scan[inside]
        centre = motion.plane.of_geodetic(site.lat_deg, site.lon_deg)[0]  # type: ignore[arg-type]
        angle = np.radians(sight[owner, 1])
        flat = centre + sight[owner, :1] * np.column_stack([np.sin(angle), np.cos(angle)])
        place = np.column_stack([flat, np.zeros(len(owner))])
        # Numbers below −1 distinguish false objects.
        return Echoes(scan, -2 - owner, scan_times[scan] + sight[owner, 1] / 360.0 * period, place, sight[owner])

    def _measured(self, motion: TrueMotion, echoes: Echoes, rng: np.random.Generator) -> dict[str, FloatArray]:
        """The columns of a position, with errors and bias."""
        errors, bias, n = self.description.errors, self.bias, len(echoes)
        wander = (errors.extent_m or 0.0) * rng.normal(size=(n, 2))
        place = echoes.place + np.column_stack([wander, np.zeros(n)])
        if self.description.site is None:
            position = place[:, :2] + (errors.position_m or 0.0) * rng.normal(size=(n, 2)) + (bias.east_m, bias.north_m)
            lat, lon = motion.plane.to_geodetic(position)
            return {"lat_deg": lat, "lon_deg": lon}
        distance, bearing = np.where(echoes.object[:, None] < 0, echoes.sight, self._sight(motion, place)).T
        sigma_range, sigma_bearing = self._sigmas(distance)
        azimuth = (bearing + bias.azimuth_deg + sigma_bearing * rng.normal(size=n)) % 360.0
        if not self._turns:
            return {"bearing_deg": azimuth}
        measured_m = distance * (1.0 + bias.range_gain) + bias.range_m + sigma_range * rng.normal(size=n)
        columns = {"range_m": np.maximum(measured_m, 1.0), "bearing_deg": azimuth}
        if errors.position_m is not None:
            columns |= {"sigma_range_m": sigma_range, "sigma_bearing_deg": sigma_bearing}
        return columns | self._levels(echoes, rng)

    def _sigmas(self, distance: FloatArray) -> tuple[FloatArray, FloatArray]:
        errors = self.description.errors
        if errors.position_m is not None:
            sigma = np.full(len(distance), errors.position_m)
            return sigma, np.degrees(sigma / np.maximum(distance, 10.0 * sigma))
        return errors.sigma_range_m(distance), np.full(len(distance), errors.bearing_deg or 0.0)

    def _levels(self, echoes: Echoes, rng: np.random.Generator) -> dict[str, FloatArray]:
        """Flight levels, as transponders report them; none for false echoes."""
        height = echoes.place[:, 2]
        if not height.any():
            return {}
        reported = height + (self.description.errors.height_m or 0.0) * rng.normal(size=len(echoes))
        level = LEVEL_M * np.round(reported / LEVEL_M)
        return {"pressure_alt_m": np.where(echoes.object < 0, np.nan, level)}

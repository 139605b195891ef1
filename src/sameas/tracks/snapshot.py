"""Snapshots: the last reports of one source moved to an instant, and the records of two sources at one instant.

- :class:`Snapshot`: one source at one instant, as records or observations for the core.
- :func:`common_scans`: two sources at many instants of their common time, for the bias fit: the biases of a source are
  estimated from the residuals of its records against another source's, and one instant has few pairs.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sameas.arrays import ABSENT, BoolArray, FloatArray, IntArray, taken
from sameas.gaussian import inverse, symmetric
from sameas.many.observations import LinearPart, Observations, Source
from sameas.records import Records
from sameas.registration.weights import PlacedSources as Weighing
from sameas.space import Plane
from sameas.tracks.alignment import (
    Earlier,
    States,
    aged,
    moved,
    process_noise,
    track_numbers,
    transition,
    usable_states,
)
from sameas.tracks.biases import AZIMUTH, BIASES, GAIN, RANGE, TIME, AzimuthBias, BiasModel, RelativeBias
from sameas.tracks.feed import Feed
from sameas.tracks.placement import Directions, SlowBearing
from sameas.tracks.scans import last_exposure, last_rotation

POINTING_SIGMAS = 3.0  # a direction points at places within this many σ
#: Maximum number of instants at which two sources are compared, and maximum number of records at all of them; more
#: records reduce the instants, down to MIN_INSTANTS.
COMMON_INSTANTS, COMMON_RECORDS, MIN_INSTANTS = 16, 4000, 4
SWEEPS = 8  # parts of a rotation that are compared one by one
SKIPPED_SHARE = 0.05  # share of the common time skipped at its start, when some objects have not reported yet


def pointed_at(
    bearing_deg: FloatArray, sigma_deg: ArrayLike, sensor_m: ArrayLike, places: FloatArray, extent_m: float
) -> FloatArray:
    """(n, p) probability that each direction points at each place, if at one of them; rows of 0 for directions at none.

    The distance of a direction is not measured but needed: metres of hull or of motion are more degrees the nearer the
    object, and a camera detects far boats less often than near ones. It follows from objects of other sources.

    bearing_deg, sigma_deg : (n,) directions, clockwise from the plane's north, and their 1σ.
    sensor_m : (2,) place of the sensor. places : (p, 2) in the plane.
    extent_m : 1σ of the observed point relative to the centre of the object.

    >>> boats = np.array([[0.0, 100.0], [5.0, 300.0], [90.0, 0.0]])
    >>> pointed_at(np.array([0.0, 180.0]), 1.0, (0.0, 0.0), boats, 2.0).round(2).tolist()
    [[0.51, 0.49, 0.0], [0.0, 0.0, 0.0]]
    """
    weight = np.zeros((len(bearing_deg), len(places)))
    if not weight.size:
        return weight
    arm = places - np.asarray(sensor_m)
    range_m = np.maximum(np.hypot(*arm.T), 1.0)
    residual_deg = (
        np.asarray(bearing_deg)[:, None] - np.degrees(np.arctan2(arm[:, 0], arm[:, 1])) + 180.0
    ) % 360.0 - 180.0
    sigma = np.hypot(np.broadcast_to(sigma_deg, len(bearing_deg))[:, None], np.degrees(np.arctan2(extent_m, range_m)))
    inside = np.abs(residual_deg) < POINTING_SIGMAS * sigma
    weight[inside] = (np.exp(-0.5 * (residual_deg / sigma) ** 2) / sigma)[inside]
    total = weight.sum(axis=1, keepdims=True)
    return np.asarray(np.divide(weight, total, out=weight, where=total > 0.0))


#: Features of an object at an instant: its position, or its position and velocity.
POSITION = 2
POSITION_AND_VELOCITY = 4


@dataclass(frozen=True)
class Snapshot:
    """The current reports of one source moved to an instant, (n,) each.

    rows : of the feed's reports. time_s : times of the reports. state, covariance : (n, 4) and (n, 4, 4) at the
    instant, or bearings in degrees and their variances. aged : rows of the reports removed as too uncertain.
    """

    feed: Feed
    rows: IntArray
    time_s: FloatArray
    state: FloatArray
    covariance: FloatArray
    aged: IntArray

    @classmethod
    def of(cls, feed: Feed, instant_s: float, sweep_s: float | None = None) -> Snapshot:
        """The snapshot at an instant. sweep_s : of an antenna, only the plots within half of this time of the instant,
        instead of those of the last rotation."""
        reports, description = feed.reports, feed.description
        if sweep_s is not None and is_swept(feed):
            rows = np.flatnonzero(np.abs(reports.time_s - instant_s) <= 0.5 * sweep_s)
        elif reports.track is None and feed.rotation is not None:
            rows = last_rotation(reports.time_s, feed.rotation, feed.scan_times_s, instant_s)
        elif reports.track is None:
            rows = last_exposure(feed.scan_s, feed.scan_times_s, instant_s)
        else:
            rows = feed.succession.at(instant_s)
            rows = rows[instant_s - reports.time_s[rows] <= feed.timeouts_s(rows)]
        none = np.empty(0, np.int64)
        if isinstance(reports, Directions):
            rows = rows[reports.usable[rows]]
            return cls(feed, rows, reports.time_s[rows], reports.bearing_deg[rows], reports.sigma_deg[rows] ** 2, none)
        state, covariance = taken(reports.state, rows), taken(reports.covariance, rows)
        usable = usable_states(state, covariance)
        if not usable.all():
            rows, state, covariance = rows[usable], state[usable], covariance[usable]
        time_s, late = reports.time_s[rows], description.timing.latency_sigma_s or 0.0
        state, covariance = moved(state, covariance, instant_s - time_s, feed.walk_m2_per_s3[rows], late)
        return cls(feed, rows, time_s, state, covariance, none)

    def between_reports(self, instant_s: float) -> Snapshot:
        """The snapshot with states between the last and the next report of each track, for recordings.

        Ships slow down and turn: where the velocity lasts, as for states moved ahead, they are found behind, and a
        source with older reports is ahead of the others. The state before and the next one moved back are averaged by
        their covariances without the errors of the positions, which are taken to be common to both.
        """
        reports = self.feed.reports
        if isinstance(reports, Directions) or reports.track is None or not self.feed.has_velocities:
            return self
        following = self.feed.succession.following[self.rows]
        has_next = np.flatnonzero(following != ABSENT)
        before, after = self.rows[has_next], following[has_next]
        walk = self.feed.walk_m2_per_s3
        (ahead, of_ahead), (back, of_back) = (
            moved(
                taken(reports.state, rows), _of_velocities(reports, rows), instant_s - reports.time_s[rows], walk[rows]
            )
            for rows in (before, after)
        )
        gain = of_ahead @ inverse(of_ahead + of_back)
        state, covariance = self.state.copy(), self.covariance.copy()
        state[has_next] += np.einsum("nvw,nw->nv", gain, back - ahead)
        covariance[has_next] = symmetric(covariance[has_next] - gain @ of_ahead)
        return replace(self, state=state, covariance=covariance)

    def without_aged(self, density: float) -> Snapshot:
        """The snapshot without reports too uncertain to distinguish objects; density : objects per m²."""
        if isinstance(self.feed.reports, Directions) or not len(self.rows):
            return self
        old = aged(self.covariance, density)
        if not old.any():
            return self
        return self._only(~old, self.rows[old])

    def _only(self, keep: BoolArray, aged: IntArray) -> Snapshot:
        return Snapshot(self.feed, self.rows[keep], self.time_s[keep], self.state[keep], self.covariance[keep], aged)

    def source(self, instant_s: float, features: int, places: FloatArray) -> Source:
        """Records or observations for the core; places : (p, 2) records of all sources with positions."""
        name, ids = self.feed.description.name, self.feed.reports.rows[self.rows]
        if isinstance(self.feed.reports, Directions):
            return self._bearings(instant_s, features, places)
        if features == POSITION or self.feed.has_velocities:
            cut = slice(None, features)
            return Records.of(self.state[:, cut], covariance=self.covariance[:, cut, cut], ids=ids, source=name)
        return self._plots(instant_s)

    def _plots(self, instant_s: float) -> Observations:
        """Bare positions, as observations of the position of a moving object at the time of the scan."""
        description, reports = self.feed.description, self.feed.reports
        assert isinstance(reports, States)
        age = instant_s - float(self.time_s.mean()) if len(self.rows) else 0.0
        dt_s = instant_s - age - self.time_s
        walk = self.feed.walk_m2_per_s3[self.rows]
        state, covariance = moved(reports.state[self.rows], reports.covariance[self.rows], dt_s, walk)
        late = (description.motion.speed_m_per_s or 0.0) * (description.timing.latency_sigma_s or 0.0)
        wander = process_noise(np.full(len(walk), age), walk)[:, :2, :2] + late**2 * np.eye(2)
        covariance = covariance[:, :2, :2] + wander
        records = Records.of(state[:, :2], covariance=covariance, ids=reports.rows[self.rows], source=description.name)
        return Observations(records, LinearPart(transition(-age)[0, :2]))

    def _bearings(self, instant_s: float, features: int, places: FloatArray) -> Observations:
        """Directions, as observations of the position of an object at the time of the scan."""
        description, reports = self.feed.description, self.feed.reports
        range_m = description.coverage.range_m or math.inf
        target_range_m = self._target_ranges(places, range_m)
        age = instant_s - float(self.time_s.mean()) if len(self.rows) else 0.0
        # With velocities as features the earlier position is observed; else the motion since adds to the error.
        dt = instant_s - self.time_s - (age if features == POSITION_AND_VELOCITY else 0.0)
        moved_m = (description.motion.speed_m_per_s or 0.0) * np.hypot(dt, description.timing.latency_sigma_s or 0.0)
        spread_deg = np.degrees(np.arctan2(np.hypot(moved_m, description.errors.extent_m or 0.0), target_range_m))
        records = Records.of(
            self.state[:, None], variance=(self.covariance + spread_deg**2)[:, None], ids=reports.rows[self.rows],
            source=description.name, space=Plane(periods=(360.0,)),
        )  # fmt: skip
        bearing = SlowBearing(self.sensor(), features, max(description.coverage.nearest_m, 0.02 * min(range_m, 1e6)))
        return Observations(records, Earlier(bearing, age) if features == POSITION_AND_VELOCITY else bearing)

    def _target_ranges(self, places: FloatArray, max_range_m: float) -> FloatArray:
        """(n,) range of the target of each direction, from the records of other sources in that direction.

        It is (Σ w r⁻²)^(−1/2) over those records, so that a metre there has the mean squared angle; half the maximum
        range if there are none.
        """
        extent = self.feed.description.errors.extent_m or 0.0
        weight = pointed_at(self.state, np.sqrt(self.covariance), self.sensor(), places, extent)
        out = np.full(len(self.rows), max_range_m / 2.0)
        has_records = weight.any(axis=1)
        range_m = np.maximum(np.hypot(*(places - np.asarray(self.sensor())).T), 1.0)
        out[has_records] = (weight[has_records] @ range_m**-2.0) ** -0.5
        return out

    def sensor(self) -> tuple[float, float]:
        """Position of the sensor at its last report, m; (0, 0) if it is unknown."""
        at = self.feed.sensor_m
        if at is None or not len(at):
            return 0.0, 0.0
        last = at[self.rows[np.argmax(self.time_s)] if len(self.rows) else 0]
        return float(last[0]), float(last[1])


def is_swept(feed: Feed) -> bool:
    """Whether a rotating antenna gives the reports: plots without ids and velocities, each at its own time."""
    return isinstance(feed.reports, States) and feed.reports.track is None and feed.rotation is not None


def _of_velocities(reports: States, rows: IntArray) -> FloatArray:
    """(n, 4, 4) covariances of reports whose positions are exact, to a millimetre."""
    out = np.zeros((len(rows), 4, 4))
    out[:, 2:, 2:] = reports.covariance[rows, 2:, 2:]
    out[:, :2, :2] = 1e-6 * np.eye(2)
    return out


NO_WIDTHS = np.zeros(6)


@dataclass(frozen=True)
class CommonScan:
    """Two sources at one instant.

    weighing : their records, and the model of the offset between them.
    biases : (p,) bias of each parameter: indices into :data:`sameas.tracks.biases.BIASES`, those of the second
        registered source from 6.
    track_ids : (n₁,), (n₂,) ids of tracks, None for a record without one.
    speed_m_per_s : median speed of the records.
    lasting_m2 : variance per axis of errors that are constant for one object, for records without an id: latency if
        velocities are unknown, and the echo's place on the hull; deg² for directions.
    """

    instant_s: float
    weighing: Weighing
    biases: IntArray
    track_ids: tuple[NDArray[Any], NDArray[Any]]
    speed_m_per_s: float
    lasting_m2: float = 0.0

    @property
    def most_pairs(self) -> int:
        """Number of records of the smaller source."""
        return min(len(self.weighing.first), len(self.weighing.second))

    @property
    def sources(self) -> tuple[str, str]:
        """Names of both."""
        return self.weighing.first.source, self.weighing.second.source


@dataclass(frozen=True)
class ComparedSource:
    """One of two compared sources; ``start`` is the index of its first bias, 0 or 6, or None if it has no biases."""

    feed: Feed
    start: int | None

    def widths(self) -> FloatArray:
        """(6,) prior 1σ of its biases; 0 for biases that are not fitted."""
        return NO_WIDTHS if self.start is None else bias_widths(self.feed)


def bias_widths(feed: Feed) -> FloatArray:
    """(6,) prior 1σ of the biases of a source, in the order of BIASES; 0 for biases that it cannot have."""
    bias = feed.description.bias
    prior = (bias.range_m, bias.azimuth_deg, bias.range_gain, bias.time_s, bias.shift_m, bias.shift_m)
    widths = np.array([width or 0.0 for width in prior])
    if feed.sensor_m is None:
        widths[[RANGE, AZIMUTH, GAIN]] = 0.0
    if isinstance(feed.reports, Directions):
        widths[[k for k in range(len(BIASES)) if k != AZIMUTH]] = 0.0
    return widths


def common_scans(
    one: ComparedSource, other: ComparedSource, most: int | None = None, *, sweeps: bool = False
) -> tuple[CommonScan, ...]:
    """Two sources at instants spread over their common time; none if they have no time in common.

    most : maximum number of instants; ``COMMON_INSTANTS`` if None.
    sweeps : whether plots of a rotation are compared with tracks in ``SWEEPS`` parts, each at its own time; none if it
        is not such a comparison. Together, they are behind moving objects by half of a rotation on average, since the
        velocity of a plot is unknown: the stamps seem late.
    """
    sides = [one, other]
    directions = [isinstance(side.feed.reports, Directions) for side in sides]
    if all(directions):
        return ()
    # The second is the one that is moved: the directions, or else the source with velocities.
    if directions[0] or (one.feed.has_velocities and not directions[1]):
        sides = sides[::-1]
    instants = common_instants(one.feed, other.feed, most)
    sweep_s = None
    if sweeps:
        if directions[1] or not is_swept(sides[0].feed) or not sides[1].feed.has_velocities:
            return ()
        sweep_s = sides[0].feed.scan_period_s / SWEEPS
        instants = (instants[:, None] - sweep_s * (np.arange(SWEEPS)[::-1] + 0.5)).ravel()
    scans = [_common_scan(sides[0], sides[1], instant_s, sweep_s) for instant_s in instants]
    return tuple(scan for scan in scans if scan is not None)


def common_instants(one: Feed, other: Feed, most: int | None = None) -> FloatArray:
    """(k,) instants at which both may have reports: scan times, of the source without velocities if only one has."""
    most = COMMON_INSTANTS if most is None else most
    times = [feed.reports.time_s[feed.reports.usable] for feed in (one, other)]
    if not all(len(t) for t in times):
        return np.empty(0)
    plots = other if one.has_velocities and not other.has_velocities else one
    scan_times = np.unique(plots.scan_times_s)
    scan_times = scan_times[
        (scan_times >= max(t.min() for t in times)) & (scan_times <= max(times[0].max(), times[1].max()))
    ]
    # The last report of a source that has ended remains current for three periods.
    ends = [
        t.max() + 3.0 * (feed.description.timing.period_s or 0.0) for t, feed in zip(times, (one, other), strict=True)
    ]
    scan_times = scan_times[scan_times <= min(ends)]
    if not len(scan_times):
        return scan_times
    per_instant = _typical_count(one) + _typical_count(other)
    count = int(np.clip(COMMON_RECORDS / max(per_instant, 1.0), min(MIN_INSTANTS, most), most))
    chosen = np.linspace(SKIPPED_SHARE * (len(scan_times) - 1), len(scan_times) - 1, min(count, len(scan_times)))
    return np.asarray(scan_times[np.unique(np.round(chosen).astype(np.int64))])


def _typical_count(feed: Feed) -> float:
    """Mean number of records of the source at an instant: its current tracks, or the plots of a scan."""
    reports = feed.reports
    if reports.track is None:
        return len(reports) / max(len(np.unique(feed.scan_s)), 1)
    number = track_numbers(reports.track)
    first, last = np.full(number.max() + 1, np.inf), np.full(number.max() + 1, -np.inf)
    np.minimum.at(first, number, reports.time_s)
    np.maximum.at(last, number, reports.time_s)
    span = float(reports.time_s.max() - reports.time_s.min())
    return float(np.sum(last - first)) / span if span > 0.0 else float(len(first))


def _common_scan(
    first: ComparedSource, second: ComparedSource, instant_s: float, sweep_s: float | None = None
) -> CommonScan | None:
    snapshots = [
        Snapshot.of(side.feed.as_measured, instant_s, sweep_s).between_reports(instant_s) for side in (first, second)
    ]
    density = _density(snapshots)
    snapshots = [each.without_aged(density) for each in snapshots]
    if not all(len(each.rows) for each in snapshots):
        return None
    if isinstance(second.feed.reports, Directions):
        return _of_directions(snapshots[0], snapshots[1], second, instant_s)
    return _of_positions(snapshots[0], snapshots[1], (first, second), instant_s)


def _density(snapshots: Sequence[Snapshot]) -> float:
    """Records per m² of the source with the most records."""
    densest = max((each for each in snapshots if each.state.ndim == 2), key=lambda each: len(each.rows))
    if len(densest.rows) < 3:
        return 0.0
    area = 2.0 * math.pi * math.sqrt(max(float(np.linalg.det(np.cov(densest.state[:, :2].T))), 1e-300))
    return len(densest.rows) / area


def _of_positions(
    one: Snapshot, other: Snapshot, sides: tuple[ComparedSource, ComparedSource], instant_s: float
) -> CommonScan:
    has_velocity = other.covariance[:, 2, 2] < 0.99 * (other.feed.description.motion.speed_m_per_s or math.inf) ** 2
    timed = bool(has_velocity.mean() >= 0.5)
    if timed:
        other = other._only(has_velocity, other.aged)
    velocity = other.state[:, 2:] if timed else np.zeros((len(other.rows), 2))
    widths = [side.widths() * np.where(np.arange(6) == TIME, float(timed), 1.0) for side in sides]
    models = [BiasModel(side.feed.sensor_at(instant_s)) for side in sides]
    model = RelativeBias(models[0], models[1], velocity, tuple(np.concatenate(widths).tolist()))
    biases = np.array([(sides[k // 6].start or 0) + k % 6 for k in model.which], np.int64)
    weighing = Weighing.of(_positions(one), _positions(other), model)
    speed = float(np.median(np.hypot(*velocity.T)))
    lasting = 0.0 if timed else sum(_lasting_m2(side) for side in sides)
    return CommonScan(instant_s, weighing, biases, (_track_ids(one), _track_ids(other)), speed, lasting)


def _lasting_m2(side: ComparedSource) -> float:
    description = side.feed.description
    late_m = (description.bias.time_s or 0.0) * (description.motion.speed_m_per_s or 0.0)
    return (late_m * (side.start is not None)) ** 2 + (description.errors.extent_m or 0.0) ** 2


def _positions(snapshot: Snapshot) -> Records:
    name = snapshot.feed.description.name
    return Records.of(snapshot.state[:, :2], covariance=snapshot.covariance[:, :2, :2], source=name)


def _of_directions(
    positions: Snapshot, directions: Snapshot, side: ComparedSource, instant_s: float
) -> CommonScan | None:
    """Directions compared with the bearings of the other source's records from the sensor."""
    description = directions.feed.description
    arm = positions.state[:, :2] - np.asarray(directions.sensor())
    range_m = np.hypot(*arm.T)
    # A record next to the sensor has no useful bearing, one at it none at all; one beyond its range is not visible.
    visible = (range_m > 0.0) & (range_m <= (description.coverage.range_m or math.inf))
    across = np.column_stack([arm[:, 1], -arm[:, 0]])
    np.divide(across, range_m[:, None], out=across, where=visible[:, None])
    variance = np.einsum("nv,nvw,nw->n", across, positions.covariance[:, :2, :2], across)
    sigma = np.sqrt(variance + (description.errors.extent_m or 0.0) ** 2)
    sigma = np.degrees(np.divide(sigma, range_m, out=np.full_like(sigma, np.inf), where=visible))
    visible &= sigma < 30.0
    if not visible.any():
        return None
    bearing, circle = np.degrees(np.arctan2(arm[:, 0], arm[:, 1])) % 360.0, Plane(periods=(360.0,))
    name = positions.feed.description.name
    first = Records.of(bearing[visible, None], sigma=sigma[visible, None], space=circle, source=name)
    second = Records.of(
        directions.state[:, None], variance=directions.covariance[:, None], space=circle, source=description.name
    )
    model = AzimuthBias(float(side.widths()[AZIMUTH]))
    biases = np.array([(side.start or 0) + AZIMUTH], np.int64)
    speed = float(np.median(np.hypot(*positions.state[:, 2:].T)))
    # The observed place on the hull is constant: as an angle.
    lasting_deg2 = float(np.mean(np.degrees((description.errors.extent_m or 0.0) / range_m[visible]) ** 2))
    labels = (_track_ids(positions)[visible], _track_ids(directions))
    return CommonScan(instant_s, Weighing.of(first, second, model), biases, labels, speed, lasting_deg2)


def _track_ids(snapshot: Snapshot) -> NDArray[Any]:
    track = snapshot.feed.reports.track
    return np.full(len(snapshot.rows), None, object) if track is None else track[snapshot.rows].astype(object)

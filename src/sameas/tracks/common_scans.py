"""Common scans: the records of two sources at one instant, for :mod:`sameas.registration`.

The biases of a source show in the residuals of its records against those of another, and one instant has few pairs:
:func:`common_scans` compares two sources at many instants, spread over their common time.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import FloatArray, IntArray
from sameas.records import Records
from sameas.registration.weights import PlacedSources as Weighing
from sameas.space import Plane
from sameas.tracks.biases import AZIMUTH, BIASES, GAIN, RANGE, TIME, AzimuthBias, BiasModel, RelativeBias
from sameas.tracks.feed import Feed
from sameas.tracks.placement import Directions
from sameas.tracks.snapshot import Snapshot

NO_WIDTHS = np.zeros(6)


@dataclass(frozen=True)
class CommonScan:
    """Two sources at one instant.

    weighing : their records, and the offset between them.
    biases : (p,) which biases its parameters are: numbers into :data:`sameas.tracks.biases.BIASES`, those of the second
        registered source from 6.
    track_ids : (n₁,), (n₂,) names of tracks, None where a record has none.
    speed_m_per_s : typical of the records.
    lasting_m2 : variance per axis of errors that are constant for an object, where no id identifies it: late stamps
        without known velocities, and the echo's place on the hull; deg² for directions.
    """

    instant_s: float
    weighing: Weighing
    biases: IntArray
    track_ids: tuple[NDArray[Any], NDArray[Any]]
    speed_m_per_s: float
    lasting_m2: float = 0.0

    @property
    def sources(self) -> tuple[str, str]:
        """Names of both."""
        return self.weighing.first.source, self.weighing.second.source


@dataclass(frozen=True)
class ComparedSource:
    """One of two compared sources: ``start`` is 0 or 6, the place of its biases among all, or None: it has none."""

    feed: Feed
    start: int | None

    def widths(self) -> FloatArray:
        """(6,) prior standard deviations of its biases; 0 for biases that are not fitted."""
        return NO_WIDTHS if self.start is None else bias_widths(self.feed)


def bias_widths(feed: Feed) -> FloatArray:
    """(6,) prior standard deviations of the biases that a source may have, in the order of BIASES; 0 where none."""
    bias = feed.description.bias
    prior = (bias.range_m, bias.azimuth_deg, bias.range_gain, bias.time_s, bias.shift_m, bias.shift_m)
    widths = np.array([width or 0.0 for width in prior])
    if feed.sensor_m is None:
        widths[[RANGE, AZIMUTH, GAIN]] = 0.0
    if isinstance(feed.reports, Directions):
        widths[[k for k in range(len(BIASES)) if k != AZIMUTH]] = 0.0
    return widths


def common_scans(one: ComparedSource, other: ComparedSource, most: int | None = None) -> tuple[CommonScan, ...]:
    """Two sources at ``most`` instants spread over their common time; none where they have no time in common.

    most : ``common_instants`` of the first feed's tuning where not given.
    """
    sides = [one, other]
    directions = [isinstance(side.feed.reports, Directions) for side in sides]
    if all(directions):
        return ()
    # The second is what is moved: directions against positions, or what has velocities to be moved along.
    if directions[0] or (one.feed.has_velocities and not directions[1]):
        sides = sides[::-1]
    scans = [_common_scan(sides[0], sides[1], instant_s) for instant_s in common_instants(one.feed, other.feed, most)]
    return tuple(scan for scan in scans if scan is not None)


def common_instants(one: Feed, other: Feed, most: int | None = None) -> FloatArray:
    """(k,) instants at which both may have reports: times of scans of the one without velocities."""
    tuning = one.tuning
    most = tuning.common_instants if most is None else most
    times = [feed.reports.time_s[feed.reports.usable] for feed in (one, other)]
    if not all(len(t) for t in times):
        return np.empty(0)
    plots = other if one.has_velocities and not other.has_velocities else one
    scan_times = np.unique(plots.scan_times_s)
    scan_times = scan_times[
        (scan_times >= max(t.min() for t in times)) & (scan_times <= max(times[0].max(), times[1].max()))
    ]
    # The last report of a source that ended is current for three periods.
    ends = [
        t.max() + 3.0 * (feed.description.timing.period_s or 0.0) for t, feed in zip(times, (one, other), strict=True)
    ]
    scan_times = scan_times[scan_times <= min(ends)]
    if not len(scan_times):
        return scan_times
    per_instant = _typical_count(one) + _typical_count(other)
    count = int(np.clip(tuning.common_records / max(per_instant, 1.0), min(tuning.fewest_instants, most), most))
    chosen = np.linspace(tuning.skipped_share * (len(scan_times) - 1), len(scan_times) - 1, min(count, len(scan_times)))
    return np.asarray(scan_times[np.unique(np.round(chosen).astype(np.int64))])


def _typical_count(feed: Feed) -> float:
    """Typical number of records of the source at an instant: its current tracks, or the plots of a scan."""
    reports = feed.reports
    if reports.track is None:
        return len(reports) / max(len(np.unique(feed.scan_s)), 1)
    _, number = np.unique(reports.track.astype(str), return_inverse=True)
    first, last = np.full(number.max() + 1, np.inf), np.full(number.max() + 1, -np.inf)
    np.minimum.at(first, number, reports.time_s)
    np.maximum.at(last, number, reports.time_s)
    span = float(reports.time_s.max() - reports.time_s.min())
    return float(np.sum(last - first)) / span if span > 0.0 else float(len(first))


def _common_scan(first: ComparedSource, second: ComparedSource, instant_s: float) -> CommonScan | None:
    snapshots = [Snapshot.of(side.feed.as_measured, instant_s) for side in (first, second)]
    density = _density(snapshots)
    snapshots = [each.without_aged(density) for each in snapshots]
    if not all(len(each.rows) for each in snapshots):
        return None
    if isinstance(second.feed.reports, Directions):
        return _of_directions(snapshots[0], snapshots[1], second, instant_s)
    return _of_positions(snapshots[0], snapshots[1], (first, second), instant_s)


def _density(snapshots: Sequence[Snapshot]) -> float:
    """Records per m² of the source with most of them."""
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
        other = Snapshot(
            other.feed,
            other.rows[has_velocity],
            other.time_s[has_velocity],
            other.state[has_velocity],
            other.covariance[has_velocity],
            other.aged,
        )
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
    """Directions against the directions from the sensor to the other source's records."""
    description = directions.feed.description
    arm = positions.state[:, :2] - np.asarray(directions.sensor())
    away = np.maximum(np.hypot(*arm.T), 1.0)
    across = np.column_stack([arm[:, 1], -arm[:, 0]]) / away[:, None]
    variance = np.einsum("nv,nvw,nw->n", across, positions.covariance[:, :2, :2], across)
    sigma = np.degrees(np.sqrt(variance + (description.errors.extent_m or 0.0) ** 2) / away)
    # A record beside the sensor has no direction, and one that is too far is not visible.
    visible = (sigma < 30.0) & (away <= (description.coverage.range_m or math.inf))
    if not visible.any():
        return None
    bearing, around = np.degrees(np.arctan2(arm[:, 0], arm[:, 1])) % 360.0, Plane(periods=(360.0,))
    name = positions.feed.description.name
    first = Records.of(bearing[visible, None], sigma=sigma[visible, None], space=around, source=name)
    second = Records.of(
        directions.state[:, None], variance=directions.covariance[:, None], space=around, source=description.name
    )
    model = AzimuthBias(float(side.widths()[AZIMUTH]))
    biases = np.array([(side.start or 0) + AZIMUTH], np.int64)
    speed = float(np.median(np.hypot(*positions.state[:, 2:].T)))
    # The visible place on the hull is constant: here as an angle.
    lasting_deg2 = float(np.mean(np.degrees((description.errors.extent_m or 0.0) / away[visible]) ** 2))
    labels = (_track_ids(positions)[visible], _track_ids(directions))
    return CommonScan(instant_s, Weighing.of(first, second, model), biases, labels, speed, lasting_deg2)


def _track_ids(snapshot: Snapshot) -> NDArray[Any]:
    track = snapshot.feed.reports.track
    return np.full(len(snapshot.rows), None, object) if track is None else track[snapshot.rows].astype(object)

"""A feed: one source of a scene, its reports in the plane, and its miss probability and clutter at any place."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtr

from sameas.arrays import BoolArray, FloatArray, IntArray, over_columns, taken
from sameas.errors import InputError, naming
from sameas.evidence.identity import FREQUENCY, MODELS
from sameas.gate import ChiSquare
from sameas.gaussian import mahalanobis_sq
from sameas.representation import counted, in_short
from sameas.tracks.alignment import MANOEUVRE_NOISE, States, Succession, are_unfiltered, follow, track_numbers
from sameas.tracks.biases import corrected
from sameas.tracks.clocks import Leap, leaps_of, with_minutes, without_leaps
from sameas.tracks.coordinates import LocalPlane
from sameas.tracks.duplicate_ids import MAX_SPEED_SIGMAS, split_duplicate_ids
from sameas.tracks.kinds import KINDS
from sameas.tracks.placement import Directions, PlacedReports
from sameas.tracks.random_errors import AS_STATED, RandomErrors, random_errors
from sameas.tracks.reports import PLOTS_OF_RADARS, Reports
from sameas.tracks.scans import AntennaRotation, scans_of, seen_from, usual_period_s
from sameas.tracks.source import Description
from sameas.tracks.stationary import (
    ADRIFT,
    DRIFT_WALK_M2_PER_S3,
    MODES,
    REST_S,
    RESTS,
    is_known_velocity,
    mode_shares,
    slow_objects,
)

#: Smallest probability of a mode of motion.
MIN_P = 1e-12
#: Smallest range from a sensor, and 1σ of a distance, at which objects are looked at for being resolved, metres.
MIN_RANGE_M = 1.0
#: Objects that many standard deviations farther apart than a resolution cell are resolved (a probability of 1e-18).
RESOLVED_SIGMAS = 9.0

#: The track timeout is this quantile of the gaps within tracks, with a tolerance for the rounding of stamps (ASTERIX:
#: 1/128 s).
TIMEOUT_QUANTILE, STAMP_STEP_S = 0.999, 0.01
#: Minimum track timeout of a probably stationary object: two of the intervals at which vessels at anchor report (3 min:
#: ITU-R M.1371-5, table 1).
STATIONARY_TIMEOUT_S = 360.0
#: An object moves if the χ² of its velocity against 0 exceeds this quantile for objects at rest.
AT_REST = 1.0 - 1e-6
#: An object has left a repeated position if it moved farther than this many σ of that position since: below, the
#: position is as good as others; rounding to a step of √12 σ cannot be seen either.
REPEAT_SIGMAS = 2.0
#: Tracks of another system are of aircraft if at least this share of its reports are.
AIRCRAFT_SHARE = 0.5
#: The speed above which an object is an aircraft.
FASTEST_VESSEL_M_PER_S = MAX_SPEED_SIGMAS * float(KINDS["ais"].defaults["motion.speed_m_per_s"][0])  # type: ignore[arg-type]


def track_timeout_s(time_s: FloatArray, track: NDArray[Any] | None) -> float:
    """Seconds without a report after which a track of the source has ended; infinite if no track has two reports.

    A radar drops a lost track without a message; its last report would remain current though the object has left or
    has another track number. A track has ended if its gap is longer than 99.9 % of the gaps within tracks of its
    source: a radar's tracks end after some rotations, those of vessels at anchor, which report every three minutes,
    after several of these intervals.

    >>> track_timeout_s(np.array([0.0, 3.0, 6.0, 12.0]), np.array(["7", "7", "7", "7"]))
    6.0
    """
    if track is None or len(time_s) < 2:
        return math.inf
    number = track_numbers(track)
    order = np.lexsort([time_s, number])
    gaps = np.diff(time_s[order])[np.diff(number[order]) == 0]
    return float(np.quantile(gaps, TIMEOUT_QUANTILE, method="higher")) if len(gaps) else math.inf


def position_updates(reports: States) -> tuple[States, tuple[str, ...]]:
    """The reports, NaN in place of positions repeated to the last digit though the object has moved, and notes.

    Receivers and databases resend their last position with the current time and perhaps a new velocity. Such
    repetitions would show a moving object at rest, so they are not used. An object that is stationary, of unknown
    velocity, or that has moved by less than its position is known, may report one position twice: an ARPA rounds
    ranges to 0.01 nm, which a ship of 10 kn covers in 3.6 s.

    >>> track, v = ["a"] * 3, [[50.0, 0.0]] * 3
    >>> reports = States.of([0.0, 1.0, 2.0], [[0.0, 0.0], [0.0, 0.0], [99.0, 0.0]], np.eye(2), speed_m_per_s=150.0,
    ...                     velocity=v, velocity_covariance=np.eye(2), track=track)
    >>> position_updates(reports)[0].usable.tolist()
    [True, False, True]
    """
    if reports.track is None or len(reports) < 2:
        return reports, ()
    usable = np.flatnonzero(reports.usable)
    number = track_numbers(reports.track[usable])
    stale = stale_positions(number, reports.time_s[usable], reports.state[usable], reports.covariance[usable])
    repeats = usable[stale]
    if not len(repeats):
        return reports, ()
    state = reports.state.copy()
    state[repeats] = np.nan
    repeat = counted(len(repeats), "report repeats the position", "reports repeat the positions")
    note = f"{repeat} of an earlier report though the object moves; set aside: no position was measured"
    return States(reports.time_s, state, reports.covariance, reports.track, reports.rows), (note,)


def stale_positions(track: IntArray, time_s: FloatArray, state: FloatArray, covariance: FloatArray) -> IntArray:
    """(k,) rows of reports (n,) with a position that their object had left: it repeats that of the report before.

    ``state`` (n, 4) and ``covariance`` (n, 4, 4) are position and velocity. The object has left a position if it moves,
    and by its velocity was carried farther than ``REPEAT_SIGMAS`` since the first report of that position.
    """
    repeats, held_s = repeated(track, time_s, state[:, :2])
    velocity, covariance = state[repeats, 2:], covariance[repeats]
    moved_sq = mahalanobis_sq(velocity * held_s[:, None], covariance[:, :2, :2])
    left = in_motion(velocity, covariance[:, 2:, 2:]) & (moved_sq > REPEAT_SIGMAS**2)
    return np.asarray(repeats[left])


def repeated(
    track: IntArray, time_s: FloatArray, position: FloatArray, order: IntArray | None = None
) -> tuple[IntArray, FloatArray]:
    """(k,) rows of the reports (n,) that repeat the position (n, 2) of the previous report of their track, and the
    seconds since the first report of that position. order : (n,) rows by track and time, where already known."""
    rows = np.lexsort([time_s, track]) if order is None else order
    track, position = track[rows], taken(position, rows)
    same = np.zeros(len(rows), bool)
    same[1:] = over_columns(np.logical_and, position[1:] == position[:-1]) & (track[1:] == track[:-1])
    first = np.maximum.accumulate(np.where(same, 0, np.arange(len(rows))))
    return rows[same], time_s[rows[same]] - time_s[rows[first[same]]]


def in_motion(velocity: FloatArray, covariance: FloatArray) -> BoolArray:
    """(n,) whether velocities (n, 2) differ significantly from 0."""
    return np.asarray(mahalanobis_sq(velocity, covariance) > ChiSquare(AT_REST).limit(2))


#: Kinds of sources whose position errors are correlated for minutes: a filter does not reduce them.
CORRELATED_KINDS = ("ais", "ads-b")


@in_short
@dataclass(frozen=True)
class Feed:
    """One source of a scene.

    Attributes
    ----------
    description : of the source. reports : its reports in the plane, (n,).
    scan_times_s : (l,) times of its scans. scan_s : (n,) time of the scan of each report.
    sensor_m : (n, 2) position of the sensor at each report; None if it is unknown.
    attributes : identity attributes of the reports, (n,) each: mmsi, icao, name, …
    raw_reports : as read. notes : what was excluded, printable sentences.
    measured : for filtered reports, the measured positions with the filtered velocities.
    rotation : of an antenna whose plots have their own time stamps; None if scans are exposures.
    p_slow : (n, 3) probability that a report is of an object alongside, at anchor, and adrift; None if the motion has
        no such objects.
    heights : in a live feed, the (n, 4) columns of ``heights.HeightColumns``, None if it has had
        no heights; in other feeds they are in ``raw_reports``.
    clutter_per_m2 : (n,) density of other plots about each, per scan, for a source of plots where it is estimated; None
        if the described one holds everywhere.
    leaps : jumps of its clock that the stamps themselves show, line by line.
    random : what is random of the stated errors, by which its tracks are filtered.
    """

    description: Description
    reports: States | Directions
    scan_times_s: FloatArray
    scan_s: FloatArray
    sensor_m: FloatArray | None
    attributes: Mapping[str, NDArray[Any]]
    raw_reports: Reports | None = None
    notes: tuple[str, ...] = ()
    measured: States | None = None
    rotation: AntennaRotation | None = None
    p_slow: FloatArray | None = None
    heights: FloatArray | None = None
    clutter_per_m2: FloatArray | None = None
    leaps: tuple[Leap, ...] = ()
    random: RandomErrors = AS_STATED

    @classmethod
    def of(
        cls,
        description: Description,
        reports: Reports,
        plane: LocalPlane | None = None,
        *,
        scan_times_s: ArrayLike | None = None,
        to_tracks: bool = False,
    ) -> Feed:
        """A feed of reports as read; see :meth:`of_placed`."""
        placed = PlacedReports(description, reports, plane)
        return cls.of_placed(placed, scan_times_s=scan_times_s, to_tracks=to_tracks)

    @classmethod
    def of_placed(
        cls, placed: PlacedReports, *, scan_times_s: ArrayLike | None = None, to_tracks: bool = False
    ) -> Feed:
        """A feed of reports in their plane.

        Parameters
        ----------
        scan_times_s : times of all scans of a source of bare plots, including empty scans. If None, empty scans are
            unknown, and the previous scan remains current until it is too uncertain.
        to_tracks : whether reports with ids are first filtered to tracks (:func:`need_filtering`).
        """
        description, reports, in_plane = placed.description, placed.reports, calibrated(placed)
        notes, sensor_m = placed.notes, placed.sensor_m
        if isinstance(in_plane, States) and reports.counted_clock:
            in_plane, minutes = with_minutes(in_plane, np.full(len(in_plane), walk_of(description)))
            notes += (_counted_note(description.name, minutes),)
        leaps: tuple[Leap, ...] = ()
        if isinstance(in_plane, States):
            if not reports.counted_clock:
                leaps = leaps_of(in_plane, np.full(len(in_plane), walk_of(description)))
                in_plane = without_leaps(in_plane, leaps)
            in_plane, repetitions = position_updates(in_plane)
            in_plane, duplicates = split_duplicate_ids(
                in_plane, description.motion.speed_m_per_s or math.inf,
                doubtful_s=60.0 if reports.counted_clock else 0.0,
            )  # fmt: skip
            notes += tuple(f"{description.name}: {note}" for note in (*repetitions, *duplicates))
        p_slow, measured, random = None, None, AS_STATED
        if to_tracks:
            if not isinstance(in_plane, States):
                raise InputError(f"{description.name}: directions are not filtered; give positions")
            walk = walk_of(description)
            random = random_errors(in_plane, sensor_m, walk)
            tracks = follow(random.noise(in_plane, sensor_m), acceleration_m2_per_s3=walk).states
            at_reported = at_reported_positions(in_plane, tracks, random, sensor_m, description)
            in_plane = at_reported if keep_positions(description, random) else tracks
            measured, _ = slow_objects(at_reported, description.motion)
        if isinstance(in_plane, States):
            in_plane, p_slow = slow_objects(in_plane, description.motion)
        given_times = None if scan_times_s is None else np.asarray(scan_times_s, np.float64)
        scans = scans_of(in_plane.time_s, description.timing.period_s, bearings_of(in_plane, sensor_m), given_times)
        scan_times = scans.scan_s if given_times is None else np.concatenate([given_times, scans.scan_s])
        return cls(
            description=description, reports=in_plane, scan_times_s=np.unique(scan_times), scan_s=scans.scan_s,
            sensor_m=sensor_m, attributes=identity_attributes(reports), raw_reports=reports, notes=notes,
            measured=measured, rotation=scans.rotation, p_slow=p_slow, leaps=leaps, random=random,
        )  # fmt: skip

    @property
    def filtered(self) -> bool:
        """Whether the reports were filtered to tracks."""
        return self.measured is not None

    @property
    def as_measured(self) -> Feed:
        """The feed with measured instead of filtered positions, whose errors are correlated in time."""
        return self if self.measured is None else self._of_measured

    @cached_property
    def _of_measured(self) -> Feed:
        # A feed that kept itself would stay in memory until the garbage collector finds it, hours later in a watch.
        assert self.measured is not None
        return replace(self, reports=self.measured)

    @cached_property
    def walk_m2_per_s3(self) -> FloatArray:
        """(n,) power density of the velocity random walk of each report's object, the mean over its modes of motion.

        Of plots without ids, the mean with manoeuvres: no filter notices these.
        """
        bare = self.reports.track is None
        walk = mean_walk_of(self.description) if bare else walk_of(self.description)
        if self.p_slow is None:
            return np.full(len(self.reports), walk)
        return walk * (1.0 - self.p_slow.sum(axis=1)) + DRIFT_WALK_M2_PER_S3 * self.p_slow[:, ADRIFT]

    @cached_property
    def p_stationary(self) -> FloatArray | None:
        """(n,) probability that a report is of an object alongside, at anchor or adrift; None if the motion has no such
        objects."""
        return None if self.p_slow is None else self.p_slow.sum(axis=1)

    def log_mode_ratios(self, row: IntArray, instant_s: float) -> FloatArray:
        """(len(row), MODES) ln of the probability of each mode of motion at the instant over the mode's share.

        0 where the velocity is unknown. After a report the probabilities return to the shares, as modes change: at
        three minutes a ship that was alongside may have left.
        """
        out = np.zeros((len(row), MODES))
        motion = self.description.motion
        share = mode_shares(motion)
        if share is None or self.p_slow is None or not isinstance(self.reports, States):
            return out
        known = is_known_velocity(self.reports.covariance[row, 2, 2], motion.speed_m_per_s or 0.0)
        slow = self.p_slow[row[known]]
        p = np.column_stack([slow, np.maximum(1.0 - slow.sum(axis=1), 0.0)])
        age_s = np.maximum(instant_s - self.reports.time_s[row[known]], 0.0)
        kept = np.exp(-age_s / (REST_S * share[RESTS:].sum()))[:, None]
        out[known] = np.log(np.maximum(share + kept * (p - share), MIN_P)) - np.log(share)
        return out

    @cached_property
    def track_timeout_s(self) -> float:
        """Seconds without a report after which a track of the source has ended."""
        return track_timeout_s(self.reports.time_s, self.reports.track)

    @property
    def scan_period_s(self) -> float:
        """Seconds between scans of the source: its rotation, or the usual time between exposures."""
        return usual_period_s(self.scan_times_s) if self.rotation is None else self.rotation.period_s

    def superseded_scans_s(self, after_s: float, until_s: float) -> FloatArray:
        """(l,) ascending times after ``after_s`` at which instants would show the scans of a source of plots that those
        at ``after_s`` and ``until_s`` do not show."""
        if self.rotation is None:
            times_s = self.scan_times_s[(self.scan_times_s > after_s) & (self.scan_times_s <= until_s)]
            return times_s[:-1]
        # The last rotation is that before the time, wherever the antenna points.
        n = max(math.ceil((until_s - after_s) / self.rotation.period_s) - 1, 0)
        return np.asarray(until_s - self.rotation.period_s * np.arange(n, 0, -1))

    def timeouts_s(self, rows: IntArray) -> FloatArray:
        """(n,) the track timeout after each of these reports.

        A ship at anchor reports every three minutes. Where most others report every two seconds, intervals of three
        minutes are too rare to count among the gaps of the source.
        """
        timeout_s = np.full(len(rows), self.track_timeout_s + STAMP_STEP_S)
        if self.p_stationary is None:
            return timeout_s
        return np.where(self.p_stationary[rows] > 0.5, np.maximum(timeout_s, STATIONARY_TIMEOUT_S), timeout_s)

    @cached_property
    def succession(self) -> Succession:
        """The current report of each track at any instant, of a source with track ids."""
        assert self.reports.track is not None
        usable = np.flatnonzero(self.reports.usable)
        succession = Succession.of(self.reports.time_s[usable], self.reports.track[usable])
        return replace(succession, rows=usable[succession.rows])

    def with_succession(self, succession: Succession, track_timeout_s: float) -> Feed:
        """The feed with a given succession and track timeout."""
        feed = replace(self)
        feed.__dict__.update(succession=succession, track_timeout_s=track_timeout_s)
        return feed

    @cached_property
    def has_velocities(self) -> bool:
        """Whether any report has a velocity."""
        speed = self.description.motion.speed_m_per_s or math.inf
        reports = self.reports
        return isinstance(reports, States) and bool(is_known_velocity(reports.covariance[:, 2, 2], speed).any())

    def sensor_at(self, instant_s: float) -> FloatArray | None:
        """(2,) position of the sensor at its last report up to the instant; None if it is unknown."""
        if self.sensor_m is None or not len(self.reports):
            return None
        order, times = self._in_time
        last = np.searchsorted(times, instant_s, side="right") - 1
        # Of equal times the first report.
        return np.asarray(self.sensor_m[order[np.searchsorted(times, times[last])] if last >= 0 else 0])

    @cached_property
    def _in_time(self) -> tuple[IntArray, FloatArray]:
        """(n,) rows in order of time, and their times."""
        order = np.argsort(self.reports.time_s, kind="stable")
        return order, self.reports.time_s[order]

    def q_at(self, places: FloatArray, instant_s: float) -> FloatArray:
        """(n,) probability that an object at each of the places (n, 2) is missed."""
        sensor = self.sensor_at(instant_s)
        if sensor is None:
            return self._require_q(self.description.misses.at(np.zeros(len(places))))
        arm = places - sensor
        return self._require_q(self.description.q_at(np.hypot(*arm.T), np.degrees(np.arctan2(arm[:, 0], arm[:, 1]))))

    def p_unresolved(
        self, instant_s: float, one: tuple[FloatArray, FloatArray], other: tuple[FloatArray, FloatArray]
    ) -> FloatArray:
        """(p,) probability that the sensor shows two objects as one record: they are nearer to each other than its
        resolution in range and in bearing. 0 where :meth:`resolution_reach_m` is.

        one, other : (p, 2) positions with (p, 2, 2) covariances, m².
        """
        sensor, resolution = self.sensor_at(instant_s), self.description.resolution
        if sensor is None or not self.merges:
            return np.zeros(len(one[0]))
        delta, arm = one[0] - other[0], 0.5 * (one[0] + other[0]) - sensor
        distance = np.maximum(np.hypot(*arm.T), MIN_RANGE_M)
        along = arm / distance[:, None]
        axes = np.stack([along, along[:, ::-1] * (-1.0, 1.0)], axis=1)
        apart = np.abs(np.einsum("pij,pj->pi", axes, delta))
        sigma = np.sqrt(np.maximum(np.einsum("pij,pjk,pik->pi", axes, one[1] + other[1], axes), MIN_RANGE_M**2))
        cell = np.stack(
            [np.full_like(distance, resolution.range_m), math.radians(resolution.bearing_deg or 0.0) * distance], axis=1
        )
        return np.asarray(np.prod(ndtr((cell - apart) / sigma) - ndtr((-cell - apart) / sigma), axis=1))

    def resolution_reach_m(self, instant_s: float, places: tuple[FloatArray, FloatArray]) -> FloatArray:
        """(n,) a distance about objects: two that are farther apart than the sum of theirs are resolved.

        0 for a sensor without a known position or resolution, and for directions: detectors draw a box about each of
        two ships that overlap. places : (n, 2) positions with (n, 2, 2) covariances, m².
        """
        sensor, resolution = self.sensor_at(instant_s), self.description.resolution
        if sensor is None or not self.merges:
            return np.zeros(len(places[0]))
        variance = np.trace(places[1], axis1=1, axis2=2) + MIN_RANGE_M**2
        range_m = np.hypot(*(places[0] - sensor).T) + MIN_RANGE_M
        cell_m, beam = resolution.range_m or 0.0, math.radians(resolution.bearing_deg or 0.0)
        return np.asarray(0.5 * cell_m + beam * range_m + RESOLVED_SIGMAS * np.sqrt(2.0 * variance))

    @property
    def merges(self) -> bool:
        """Whether the sensor may show two objects as one record."""
        resolution = self.description.resolution
        return not isinstance(self.reports, Directions) and bool(resolution.range_m and resolution.bearing_deg)

    def mean_q(self, places: FloatArray, instant_s: float) -> float:
        """Mean probability that an object at one of the places (n, 2) is missed, within 1e-6 … 1 − 1e-6."""
        anywhere = self.description.misses.at(np.zeros(1))
        q = self.q_at(places, instant_s) if len(places) else self._require_q(anywhere)
        return float(np.clip(q.mean(), 1e-6, 1.0 - 1e-6))

    def require_numbers(self) -> None:
        """Refuses a source whose misses or motion are not known: no instant could be identified with it."""
        self.mean_q(np.empty((0, 2)), 0.0)
        walk_of(self.description)

    def _require_q(self, q: FloatArray) -> FloatArray:
        if not np.isfinite(q).all():
            name = self.description.name
            raise InputError(f"{name}: misses.q is not known", naming("give misses = {{ q = … }} in its {description}"))
        return q

    def clutter(self, features: int) -> float:
        """Clutter density β: per m², per m² and (m/s)², or per degree, by the number of features."""
        clutter = self.description.clutter
        if isinstance(self.reports, Directions):
            return clutter.per_deg or 0.0
        return (clutter.per_km2 or 0.0) / 1e6 * self._per_velocity(features)

    def clutter_at(self, rows: IntArray, features: int) -> float | FloatArray:
        """As :meth:`clutter`, or where it is estimated at each of the reports with these row numbers (n,)."""
        if self.clutter_per_m2 is None or not len(rows):
            return self.clutter(features)
        at = np.empty(int(self.reports.rows.max()) + 1)
        at[self.reports.rows] = self.clutter_per_m2
        return np.asarray(at[rows.astype(np.int64)] * self._per_velocity(features))

    @property
    def plot_statistics(self) -> str:
        """Printable: miss rate and mean clutter of a source of plots."""
        q, clutter = self.description.misses.at(np.zeros(1))[0], self.description.clutter.per_km2 or 0.0
        return (
            f"{self.description.name}: misses {100.0 * q:.0f} % of the objects per scan; {clutter:.2g} plots per km² "
            "and scan, of which those about each plot are its clutter"
        )

    def _per_velocity(self, features: int) -> float:
        """Density of the velocities of clutter, per (m/s)², as of objects at rest; 1 for positions alone."""
        speed = self.description.motion.speed_m_per_s or 1.0
        return 1.0 if features == 2 else 1.0 / (2.0 * math.pi * speed**2)


def bearings_of(in_plane: States | Directions, sensor_m: FloatArray | None) -> FloatArray | None:
    """(n,) bearings of bare plots, from which the antenna rotation is estimated; None for tracks."""
    if in_plane.track is not None:
        return None
    return in_plane.bearing_deg if isinstance(in_plane, Directions) else seen_from(in_plane.state[:, :2], sensor_m)


def _counted_note(name: str, minutes: int) -> str:
    mended = f"{minutes} minute{'s' * (minutes != 1)} missing by the motion of the tracks were inserted"
    return f"{name}: its clock is counted on from the seconds in messages; {mended}, others may be missing"


def calibrated(placed: PlacedReports) -> States | Directions:
    """The reports in their plane, without the biases that the user gives as known."""
    in_plane, known, sensor_m = placed.in_plane, placed.description.calibration, placed.sensor_m
    polar = (known.range_m, known.azimuth_deg, known.range_gain)
    if sensor_m is None and any(polar):
        raise InputError(
            f"{placed.description.name}: calibration of range or azimuth needs to know where the sensor is; give site"
        )
    biases = np.array([value or 0.0 for value in (*polar, None, known.east_m, known.north_m)], dtype=np.float64)
    return corrected(in_plane, sensor_m, biases) if biases.any() else in_plane


def identity_attributes(reports: Reports) -> dict[str, NDArray[Any]]:
    """The columns of reports that tell who an object is, by name; the frequency beside a range is the radar's own."""
    return {
        name: column
        for name in MODELS
        if (column := getattr(reports, name, None)) is not None
        and not (name == FREQUENCY and reports.range_m is not None)
    }


def need_filtering(placed: PlacedReports) -> bool:
    """Whether the reports have object ids but are unfiltered measurements, to be filtered to tracks.

    True for reports without velocities, for plots of ASTERIX 001 and 048, and for other reports with velocities if they
    scatter like single measurements (:func:`sameas.tracks.alignment.are_unfiltered`). ARPA targets and tracks of
    another system are already smoothed; satellite positions with velocities need no filter.
    """
    description, reports = placed.description, placed.reports
    smoothed = reports.kind == "arpa" or description.kind == "tracks"
    if smoothed or reports.position == "bearing" or reports.object_ids is None:
        return False
    velocity = reports.velocity_m_per_s()
    if velocity is None or not np.isfinite(velocity).any() or reports.kind in PLOTS_OF_RADARS:
        return True
    if description.kind in CORRELATED_KINDS:
        return False
    states = placed.in_plane
    return isinstance(states, States) and are_unfiltered(states, acceleration_m2_per_s3=walk_of(description))


def of_aircraft(reports: Reports) -> BoolArray:
    """(n,) whether a report is of an aircraft: it has an address, a Mode A code, a pressure height, or its speed."""
    out = np.zeros(len(reports), bool)
    for column in (reports.icao, reports.mode_a):
        if column is not None:
            out |= np.array([text is not None and text != "" for text in column.tolist()], bool)
    if reports.pressure_alt_m is not None:
        out |= np.isfinite(reports.pressure_alt_m)
    velocity = reports.velocity_m_per_s()
    if velocity is not None:
        out |= np.hypot(*velocity.T) > FASTEST_VESSEL_M_PER_S
    return out


def of_their_objects(description: Description, reports: Reports) -> Description:
    """The description of tracks of another system, with the motion of aircraft if most of its reports are of those.

    Tracks of ships and of aircraft come in one format; no other kind has both.
    """
    if description.kind != "tracks" or not len(reports):
        return description
    is_of_aircraft = of_aircraft(reports).mean() >= AIRCRAFT_SHARE
    return description.with_motion_of_aircraft() if is_of_aircraft else description


def keep_positions(description: Description, random: RandomErrors) -> bool:
    """Whether a source with filtered tracks keeps its reported positions, whose errors no filter reduces."""
    return random.overstated or description.kind in CORRELATED_KINDS


def at_reported_positions(
    reports: States, tracks: States, random: RandomErrors, sensor_m: FloatArray | None, description: Description
) -> States:
    """The filtered velocities of the tracks at the reported positions, with the errors that these have.

    Errors of AIS and ADS-B persist, so those stated are not taken for overstated.
    """
    if description.kind not in CORRELATED_KINDS:
        reports = random.persistent(reports, sensor_m, description.errors.extent_m or 0.0)
    state, covariance = tracks.state.copy(), tracks.covariance.copy()
    state[:, :2] = reports.state[:, :2]
    covariance[:, :2, :2] = reports.covariance[:, :2, :2]
    covariance[:, :2, 2:], covariance[:, 2:, :2] = 0.0, 0.0
    return replace(tracks, state=state, covariance=covariance)


def walk_of(description: Description) -> float:
    """Power density of the velocity random walk of a source's objects, m²/s³."""
    walk = description.motion.acceleration_m2_per_s3
    if walk is None:
        raise InputError(
            f"{description.name}: motion.acceleration_m2_per_s3 is not known and {description.kind!r} assumes none",
            naming("give motion = {{ acceleration_m2_per_s3 = … }} in its {description}"),
        )
    return walk


def mean_walk_of(description: Description) -> float:
    """The mean of :func:`walk_of` over the time, of which objects manoeuvre for a share, m²/s³.

    A filter with one state for all modes of motion predicts with it: GPB1, Bar-Shalom, Li and Kirubarajan 2001, 11.6.2.
    """
    share = description.motion.manoeuvring_share or 0.0
    return walk_of(description) * (1.0 + share * (MANOEUVRE_NOISE - 1.0))

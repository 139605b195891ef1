"""A feed: one source of a scene, with its reports in the plane and its description for any place and instant."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import expit

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.errors import InputError, naming
from sameas.evidence.identity import MODELS
from sameas.gate import ChiSquare
from sameas.gaussian import Gaussian, log_density, mahalanobis_sq, symmetric
from sameas.representation import counted, in_short
from sameas.tracks.alignment import States, Succession, follow, measures_anew, with_minutes
from sameas.tracks.biases import corrected
from sameas.tracks.coordinates import LocalPlane
from sameas.tracks.duplicate_ids import split_duplicate_ids
from sameas.tracks.placement import Directions, PlacedReports
from sameas.tracks.reports import Reports
from sameas.tracks.scans import AntennaRotation, scans_of, seen_from
from sameas.tracks.source import Description, Motion
from sameas.tracks.tuning import DEFAULT_TUNING, Tuning


def stationary(reports: States, motion: Motion, tuning: Tuning = DEFAULT_TUNING) -> tuple[States, FloatArray | None]:
    """The reports with the velocities of stationary objects, and (n,) the probability that each is stationary.

    Vessels at anchor or alongside stay where they are and report a velocity of about 0. A velocity walk that fits a
    vessel under way moves one at anchor by 150 m between two reports three minutes apart; it swings by 15 m. So every
    reported velocity v, of covariance C, is that of one of two kinds of objects:

        stationary   v ~ N(0, C + s² 1), a share w of all,  s = motion.standing_m_per_s, w = motion.standing_share
        moving       v ~ N(0, C + V² 1), all others,        V = motion.speed_m_per_s

    The velocity of a stationary object is 0 ± s a priori and does not walk. The state is the mean of both kinds by
    their probabilities, its covariance that of the mixture; the walk is that of moving objects times their probability
    (Bar-Shalom, Li and Kirubarajan 2001, 1.4.16). There is no threshold: an object at 2 knots moves, one at 0.2 knots
    is stationary, and between the two the covariance holds both. Unreported velocities stay unknown.

    None, and the reports unchanged, where the motion has no share of stationary objects.

    >>> reports = States.of([0.0, 0.0], [[0.0, 0.0]] * 2, np.eye(2), speed_m_per_s=8.0,
    ...                     velocity=[[0.1, 0.0], [4.0, 0.0]], velocity_covariance=0.09 * np.eye(2))
    >>> motion = Motion(speed_m_per_s=8.0, standing_m_per_s=0.1, standing_share=0.2)
    >>> now, p_stationary = stationary(reports, motion)
    >>> p_stationary.round(2).tolist(), now.state[:, 2].round(2).tolist()
    ([0.99, 0.0], [0.01, 4.0])
    """
    slow, speed, share = motion.standing_m_per_s, motion.speed_m_per_s, motion.standing_share
    if not slow or not speed or not share:
        return reports, None
    if share >= 1.0:
        raise InputError(f"motion.standing_share is {share}; give the share of objects that stand, below 1")
    p_stationary, state, covariance = np.zeros(len(reports)), reports.state.copy(), reports.covariance.copy()
    rows = np.flatnonzero(reports.usable & (reports.covariance[:, 2, 2] < tuning.unknown_velocity_share * speed**2))
    x, p = state[rows], covariance[rows]
    slowly, quickly = (log_density(x[:, 2:], p[:, 2:, 2:] + sigma**2 * np.eye(2)) for sigma in (slow, speed))
    odds = math.log(share) - math.log1p(-share) + slowly - quickly
    chance = np.asarray(expit(odds))
    # The change of the state by a velocity that is 0 ± slow.
    still = Gaussian(np.zeros_like(x), p).conditional(p[:, :, 2:], -x[:, 2:], p[:, 2:, 2:] + slow**2 * np.eye(2))
    step = still.mean
    weight = chance[:, None, None]
    state[rows] = x + chance[:, None] * step
    mixed = (
        weight * still.covariance + (1.0 - weight) * p + weight * (1.0 - weight) * step[:, :, None] * step[:, None, :]
    )
    covariance[rows], p_stationary[rows] = symmetric(mixed), chance
    return States(reports.time_s, state, covariance, reports.track, reports.rows), p_stationary


def track_timeout_s(time_s: FloatArray, track: NDArray[Any] | None, tuning: Tuning = DEFAULT_TUNING) -> float:
    """Seconds without a report after which a track of the source has ended; infinite where no track has two reports.

    A radar drops a track that it no longer sees without a message; its last report would remain for an object that has
    gone, or has another number by now. A track has ended when its gap is longer than 99.9 % of the gaps within tracks
    of its source. So a radar's tracks end after some rotations, and those of vessels at anchor, which report every
    three minutes, after several of their reports.

    >>> track_timeout_s(np.array([0.0, 3.0, 6.0, 12.0]), np.array(["7", "7", "7", "7"]))
    6.0
    """
    if track is None or len(time_s) < 2:
        return math.inf
    _, number = np.unique(track.astype(str), return_inverse=True)
    order = np.lexsort([time_s, number])
    gaps = np.diff(time_s[order])[np.diff(number[order]) == 0]
    return float(np.quantile(gaps, tuning.timeout_quantile, method="higher")) if len(gaps) else math.inf


def position_updates(reports: States, tuning: Tuning = DEFAULT_TUNING) -> tuple[States, tuple[str, ...]]:
    """The reports without positions that are repeated to the last digit though their object moves, and notes.

    Receivers and databases send their last position again and again, with the current time and perhaps a new velocity.
    Such repetitions would show a moving object at rest, so they are set aside: they lose their position and are not
    used. A stationary object, or one of unknown velocity, may report one place twice.

    >>> track, v = ["a"] * 3, [[50.0, 0.0]] * 3
    >>> reports = States.of([0.0, 1.0, 2.0], [[0.0, 0.0], [0.0, 0.0], [99.0, 0.0]], np.eye(2), speed_m_per_s=150.0,
    ...                     velocity=v, velocity_covariance=np.eye(2), track=track)
    >>> position_updates(reports)[0].usable.tolist()
    [True, False, True]
    """
    if reports.track is None or len(reports) < 2:
        return reports, ()
    usable = np.flatnonzero(reports.usable)
    track = reports.track[usable]
    _, number = np.unique(track if track.dtype.kind in "iu" else track.astype(str), return_inverse=True)
    again = usable[repeated(number, reports.time_s[usable], reports.state[usable, :2])]
    again = again[in_motion(reports.state[again, 2:], reports.covariance[again, 2:, 2:], tuning)]
    if not len(again):
        return reports, ()
    state = reports.state.copy()
    state[again] = np.nan
    repeat = counted(len(again), "report repeats the position", "reports repeat the positions")
    note = f"{repeat} of an earlier report though the object moves; set aside: no position was measured"
    return States(reports.time_s, state, reports.covariance, reports.track, reports.rows), (note,)


def repeated(track: IntArray, time_s: FloatArray, position: FloatArray) -> IntArray:
    """(k,) those of reports (n,) that repeat the position (n, 2) of the report before them of their track."""
    rows = np.lexsort([time_s, track])
    before, after = rows[:-1], rows[1:]
    same = (position[after, 0] == position[before, 0]) & (position[after, 1] == position[before, 1])
    return np.asarray(after[same & (track[after] == track[before])])


def in_motion(velocity: FloatArray, covariance: FloatArray, tuning: Tuning) -> BoolArray:
    """(n,) whether velocities (n, 2) are certainly not 0."""
    return np.asarray(mahalanobis_sq(velocity, covariance) > ChiSquare(tuning.at_rest).limit(2))


#: Kinds of sources whose position errors last for minutes: no filter reduces them, they stay as stated.
LASTING = ("ais", "ads-b")


@in_short
@dataclass(frozen=True)
class Feed:
    """One source of a scene.

    Attributes
    ----------
    description, reports : of the source, and its reports in the plane.
    scan_times_s : (l,) times of its scans. scan_s : (n,) time of the scan of each report.
    sensor_m : (n, 2) place of its sensor, None for a source without one.
    attributes : attributes of identity of the reports, (n,) each: mmsi, icao, name, …
    raw_reports : as a reader gave them. notes : what was set aside, printable sentences.
    measured : where a filter made tracks of them, what was measured at each report, with the velocity of its track.
    rotation : of an antenna whose bare plots bear their own stamps; None where looks are exposures.
    p_stationary : (n,) probability that a report is of a stationary object; None where the motion has no such objects.
    tuning : of tracks. heights : of a growing feed the (n, 4) columns of ``heights.HeightColumns``, None where it has
        had none; otherwise they are in ``raw_reports``.
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
    p_stationary: FloatArray | None = None
    tuning: Tuning = DEFAULT_TUNING
    heights: FloatArray | None = None

    @classmethod
    def of(
        cls,
        description: Description,
        reports: Reports,
        plane: LocalPlane | None = None,
        *,
        scan_times_s: ArrayLike | None = None,
        to_tracks: bool = False,
        tuning: Tuning = DEFAULT_TUNING,
    ) -> Feed:
        """A feed of reports as a reader gave them; see :meth:`of_placed`."""
        placed = PlacedReports(description, reports, plane, tuning)
        return cls.of_placed(placed, scan_times_s=scan_times_s, to_tracks=to_tracks)

    @classmethod
    def of_placed(
        cls, placed: PlacedReports, *, scan_times_s: ArrayLike | None = None, to_tracks: bool = False
    ) -> Feed:
        """A feed of reports in their plane.

        Parameters
        ----------
        scan_times_s : times of all scans of a source of bare plots, empty scans included. Without it empty scans are
            unknown, and the scan before them is current until it is too uncertain.
        to_tracks : whether reports with ids are to be filtered to tracks first (:func:`need_filtering`).
        """
        description, reports, there = placed.description, placed.reports, placed.in_plane
        notes, sensor_m = placed.notes, placed.sensor_m
        biases = known_biases(description, sensor_m)
        there = corrected(there, sensor_m, biases) if biases.any() else there
        if isinstance(there, States) and reports.counted_clock:
            there, minutes = with_minutes(there, np.full(len(there), walk_of(description)), placed.tuning)
            notes += (_counted_note(description.name, minutes),)
        if isinstance(there, States):
            there, repetitions = position_updates(there, placed.tuning)
            there, duplicates = split_duplicate_ids(
                there, description.motion.speed_m_per_s or math.inf, placed.tuning,
                doubtful_s=60.0 if reports.counted_clock else 0.0,
            )  # fmt: skip
            notes += tuple(f"{description.name}: {note}" for note in (*repetitions, *duplicates))
        p_stationary, measured = None, None
        if to_tracks:
            if not isinstance(there, States):
                raise InputError(f"{description.name}: directions are not filtered; give positions")
            tracks = follow(there, acceleration_m2_per_s3=walk_of(description), tuning=placed.tuning).states
            placed_anew = in_place(there, tracks)
            there = placed_anew if description.kind in LASTING else tracks
            measured, _ = stationary(placed_anew, description.motion, placed.tuning)
        if isinstance(there, States):
            there, p_stationary = stationary(there, description.motion, placed.tuning)
        given_times = None if scan_times_s is None else np.asarray(scan_times_s, np.float64)
        scans = scans_of(
            there.time_s, description.timing.period_s, _bearings(there, sensor_m), given_times, placed.tuning
        )
        scan_times = scans.scan_s if given_times is None else np.concatenate([given_times, scans.scan_s])
        attributes = {name: column for name in MODELS if (column := getattr(reports, name, None)) is not None}
        return cls(
            description, there, np.unique(scan_times), scans.scan_s, sensor_m, attributes, reports, notes, measured,
            scans.rotation, p_stationary, placed.tuning,
        )  # fmt: skip

    @property
    def filtered(self) -> bool:
        """Whether a filter made tracks of the reports."""
        return self.measured is not None

    @cached_property
    def as_measured(self) -> Feed:
        """The same with the positions that were measured: errors of a filter last, as if they were the sensor's."""
        return self if self.measured is None else replace(self, reports=self.measured)

    @cached_property
    def walk_m2_per_s3(self) -> FloatArray:
        """(n,) power density of the random walk of the velocity of each report's object: 0 where stationary."""
        going = np.ones(len(self.reports)) if self.p_stationary is None else 1.0 - self.p_stationary
        return walk_of(self.description) * going

    @cached_property
    def track_timeout_s(self) -> float:
        """Seconds without a report after which a track of the source has ended."""
        return track_timeout_s(self.reports.time_s, self.reports.track, self.tuning)

    @cached_property
    def succession(self) -> Succession:
        """Which report of each track is current at an instant, of a source with track ids."""
        assert self.reports.track is not None
        usable = np.flatnonzero(self.reports.usable)
        succession = Succession.of(self.reports.time_s[usable], self.reports.track[usable])
        return replace(succession, rows=usable[succession.rows])

    def with_succession(self, succession: Succession, track_timeout_s: float) -> Feed:
        """The feed with a given succession and track timeout, which are then not computed."""
        feed = replace(self)
        feed.__dict__.update(succession=succession, track_timeout_s=track_timeout_s)
        return feed

    @cached_property
    def has_velocities(self) -> bool:
        """Whether any report has a velocity."""
        speed = self.description.motion.speed_m_per_s or math.inf
        reports = self.reports
        return isinstance(reports, States) and bool(
            np.any(reports.covariance[:, 2, 2] < self.tuning.unknown_velocity_share * speed**2)
        )

    def sensor_at(self, instant_s: float) -> FloatArray | None:
        """(2,) the sensor at its last report before the instant; None where its place is unknown."""
        if self.sensor_m is None or not len(self.reports):
            return None
        order, times = self._in_time
        last = np.searchsorted(times, instant_s, side="right") - 1
        # Of equal times the report that came first.
        return np.asarray(self.sensor_m[order[np.searchsorted(times, times[last])] if last >= 0 else 0])

    @cached_property
    def _in_time(self) -> tuple[IntArray, FloatArray]:
        """(n,) rows by their times, and these."""
        order = np.argsort(self.reports.time_s, kind="stable")
        return order, self.reports.time_s[order]

    def q_at(self, places: FloatArray, instant_s: float) -> FloatArray:
        """(n,) the probability that an object at each of the places (n, 2) is missed."""
        sensor = self.sensor_at(instant_s)
        if sensor is None:
            return self._require_q(self.description.misses.at(np.zeros(len(places))))
        arm = places - sensor
        return self._require_q(self.description.q_at(np.hypot(*arm.T), np.degrees(np.arctan2(arm[:, 0], arm[:, 1]))))

    def mean_q(self, places: FloatArray, instant_s: float) -> float:
        """The mean probability that an object at one of the places (n, 2) is missed."""
        anywhere = self.description.misses.at(np.zeros(1))
        q = self.q_at(places, instant_s) if len(places) else self._require_q(anywhere)
        return float(np.clip(q.mean(), 1e-6, 1.0 - 1e-6))

    def _require_q(self, q: FloatArray) -> FloatArray:
        if not np.isfinite(q).all():
            name = self.description.name
            raise InputError(f"{name}: misses.q is not known", naming("give misses = {{ q = … }} in its {description}"))
        return q

    def clutter(self, features: int) -> float:
        """β in the unit of its features: per m², per m² and (m/s)², or per degree."""
        clutter = self.description.clutter
        if isinstance(self.reports, Directions):
            return clutter.per_deg or 0.0
        density = (clutter.per_km2 or 0.0) / 1e6
        speed = self.description.motion.speed_m_per_s or 1.0
        return density if features == 2 else density / (2.0 * math.pi * speed**2)


def _bearings(there: States | Directions, sensor_m: FloatArray | None) -> FloatArray | None:
    """(n,) bearings of bare plots, which show how an antenna turns."""
    if there.track is not None:
        return None
    return there.bearing_deg if isinstance(there, Directions) else seen_from(there.state[:, :2], sensor_m)


def _counted_note(name: str, minutes: int) -> str:
    mended = f"{minutes} minute{'s' * (minutes != 1)} missing by the motion of the tracks were inserted"
    return f"{name}: its clock is counted on from the seconds in messages; {mended}, others may be missing"


def known_biases(description: Description, sensor_m: FloatArray | None) -> FloatArray:
    """(6,) the biases that the user knows, in the order of BIASES."""
    known = description.calibration
    polar = (known.range_m, known.azimuth_deg, known.range_gain)
    if sensor_m is None and any(polar):
        raise InputError(
            f"{description.name}: calibration of range or azimuth needs to know where the sensor is; give site"
        )
    return np.array([value or 0.0 for value in (*polar, None, known.east_m, known.north_m)], dtype=np.float64)


def need_filtering(placed: PlacedReports) -> bool:
    """Whether reports are single measurements under ids of their objects, which only a filter makes tracks.

    Reports without velocities are, and the plots of ASTERIX 048 with or without velocities. Other reports with
    velocities are where they scatter as single measurements do (:func:`sameas.tracks.alignment.measures_anew`).
    Targets of an ARPA and tracks of another system are smoothed already; satellite positions with velocities
    need no filter.
    """
    description, reports = placed.description, placed.reports
    smoothed = reports.kind == "arpa" or description.kind == "tracks"
    if smoothed or reports.position == "bearing" or reports.object_ids is None:
        return False
    velocity = reports.velocity_m_per_s()
    if velocity is None or not np.isfinite(velocity).any() or reports.kind == "asterix 048":
        return True
    if description.kind in LASTING:
        return False
    states = placed.in_plane
    return isinstance(states, States) and measures_anew(
        states, acceleration_m2_per_s3=walk_of(description), tuning=placed.tuning
    )


def in_place(reports: States, tracks: States) -> States:
    """The filtered velocities of tracks at the reported positions."""
    state, covariance = tracks.state.copy(), tracks.covariance.copy()
    state[:, :2] = reports.state[:, :2]
    covariance[:, :2, :2] = reports.covariance[:, :2, :2]
    covariance[:, :2, 2:], covariance[:, 2:, :2] = 0.0, 0.0
    return replace(tracks, state=state, covariance=covariance)


def walk_of(description: Description) -> float:
    """Power density of the random walk of a source's objects' velocities, m²/s³."""
    walk = description.motion.acceleration_m2_per_s3
    if walk is None:
        raise InputError(
            f"{description.name}: motion.acceleration_m2_per_s3 is not known and {description.kind!r} assumes none",
            naming("give motion = {{ acceleration_m2_per_s3 = … }} in its {description}"),
        )
    return walk

"""Time alignment: states moved to one instant, and the Kalman filter of tracks.

A state is (east, north, velocity east, velocity north) in a plane, metres and seconds. Its velocity is a random walk of
known power density q (m²/s³), the standard model of nearly constant velocity. Moved by dt a state becomes F x, with
covariance F P Fᵀ + Q(|dt|). A record later than the instant is moved back; its uncertainty grows as well.

- :class:`States`: the reports of one source as states, with or without velocities.
- :func:`moved`: states at other times. :class:`Succession`: the current report of each track at an instant.
- :func:`aged`: whether states are too uncertain to distinguish objects. There is no age limit.

:func:`follow` filters the plots of a source's tracks by a Kalman filter of nearly constant velocity, all tracks at
once: for sources with track ids that report positions only, or positions more precise than their velocities (AIS,
ADS-B, radar plots with track numbers). One pass in order of time gives each report the state from all reports of its
track up to it. The covariance is checked by NIS: the mean normalised innovation squared is the dimension where noise
and motion are described correctly. :func:`are_unfiltered` decides whether reports are unfiltered plots or already
smoothed.

A ship that accelerates for a minute leaves this model: the filter lags by tens of metres, with a covariance of a few.
Its innovations then lie on one side, so that their sum grows; q is larger from then on for the length of a manoeuvre,
and the noise of the time in which the sum has grown is added at once. After a longer gap nothing is known of one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sameas.arrays import ABSENT, BoolArray, FloatArray, IntArray, finite_rows, taken
from sameas.errors import InputError
from sameas.gate import ChiSquare
from sameas.gaussian import determinant, symmetric
from sameas.kernels.compiled import runs_compiled
from sameas.kernels.kalman import states_moved
from sameas.kernels.tracks import filter_tracks
from sameas.many.observations import StatePart
from sameas.representation import counted

#: Reports are independent measurements if the median of their squared innovations is at least this share of that of
#: independent errors; minimum number of innovations.
INNOVATION_RATIO, MIN_INNOVATIONS = 1.0 / 3.0, 30
#: A report beyond the χ² limit that correct reports exceed with this probability restarts its track.
NEW_TRACK_PROBABILITY = 1e-9
#: A lag of a track's filter is detected from the mean of its innovations: weight of the previous ones, per report; the
#: maximum of one, in σ; and the probability with which tracks without a lag exceed the χ² limit.
INNOVATION_MEMORY, MAX_INNOVATION, MANOEUVRE_PROBABILITY = 0.8, 3.0, 1e-3
#: Factor on the motion noise in a manoeuvre, and its length: 0.13 m/s² for a minute is 100 times the noise assumed for
#: ships, a turn at 0.26 g for a minute that for aircraft.
MANOEUVRE_NOISE, MANOEUVRE_S = 100.0, 60.0


@dataclass(frozen=True)
class States:
    """Reports of one source in a plane, in the order of the source.

    time_s : (n,) seconds, the time of the state.
    state : (n, 4) east, north, velocity east, velocity north; NaN where the position is unknown.
    covariance : (n, 4, 4).
    track : (n,) the source's name of the object; None if it has no track ids.
    rows : (n,) row in the source's table.
    """

    time_s: FloatArray
    state: FloatArray
    covariance: FloatArray
    track: NDArray[Any] | None
    rows: IntArray

    def __len__(self) -> int:
        return len(self.time_s)

    @cached_property
    def usable(self) -> BoolArray:
        """(n,) whether a report has a position with its error."""
        return usable_states(self.state, self.covariance)

    def by_track(self) -> tuple[IntArray, IntArray]:
        """(k,) rows of the usable reports, by track and time, and (k,) the numbers of their tracks."""
        assert self.track is not None
        rows = np.flatnonzero(self.usable)
        number = track_numbers(self.track[rows])
        order = np.lexsort([self.time_s[rows], number])
        return rows[order], number[order]

    def take(self, which: NDArray[Any]) -> States:
        """The reports of an index array or a mask."""
        track = None if self.track is None else self.track[which]
        rows = np.flatnonzero(which) if which.dtype == np.bool_ else which
        state, covariance = taken(self.state, rows), taken(self.covariance, rows)
        return States(self.time_s[which], state, covariance, track, self.rows[which])

    @classmethod
    def of(
        cls,
        time_s: ArrayLike,
        position: ArrayLike,
        covariance: ArrayLike,
        *,
        speed_m_per_s: float,
        velocity: ArrayLike | None = None,
        velocity_covariance: ArrayLike | None = None,
        track: ArrayLike | None = None,
        source: str = "source",
    ) -> States:
        """States from positions (n, 2) with covariances (n, 2, 2), and velocities (n, 2) where known.

        An unknown velocity, NaN or not given, is 0 ± ``speed_m_per_s`` per axis. Refused: velocities without
        covariances, reports without a time. Reports without a position are kept but not used.
        """
        t, x = np.asarray(time_s, dtype=np.float64), np.asarray(position, dtype=np.float64)
        n = len(t)
        if x.shape != (n, 2) or t.ndim != 1:
            raise InputError(f"{source}: times {t.shape}, positions {x.shape}; give (n,) and (n, 2)")
        if not np.isfinite(t).all():
            without_time = np.flatnonzero(~np.isfinite(t))
            reports = counted(len(without_time), "report has", "reports have")
            raise InputError(f"{source}: {reports} no time (first: row {without_time[0]}); give seconds")
        if not speed_m_per_s > 0.0:
            raise InputError(f"{source}: motion.speed_m_per_s is {speed_m_per_s}; give how fast objects may be, 1σ")
        state, out_covariance = np.zeros((n, 4)), np.zeros((n, 4, 4))
        state[:, :2] = x
        out_covariance[:, :2, :2] = np.broadcast_to(np.asarray(covariance, dtype=np.float64), (n, 2, 2))
        out_covariance[:, 2, 2] = out_covariance[:, 3, 3] = speed_m_per_s**2
        if velocity is not None:
            if velocity_covariance is None:
                raise InputError(f"{source}: velocities are given without their covariances; give (n, 2, 2)")
            v = np.asarray(velocity, dtype=np.float64)
            vv = np.broadcast_to(np.asarray(velocity_covariance, dtype=np.float64), (n, 2, 2))
            known = finite_rows(v) & finite_rows(vv)
            state[:, 2:], out_covariance[:, 2:, 2:] = v, vv
            if not known.all():
                state[~known, 2:], out_covariance[~known, 2:, 2:] = 0.0, speed_m_per_s**2 * np.eye(2)
        names = None if track is None else np.asarray(track)
        if names is not None and names.shape != (n,):
            raise InputError(f"{source}: {names.shape} names of tracks for {n} reports; give one each")
        return cls(t, state, out_covariance, names, np.arange(n))


@dataclass(frozen=True)
class Earlier:
    """The observation ``part`` of the state ``age_s`` seconds ago, as a function of the present state.

    >>> from sameas.many.observations import Bearing
    >>> Earlier(Bearing((0.0, 0.0), dimension=4), 2.0)(np.array([[10.0, 30.0, 5.0, 0.0]])).tolist()
    [[0.0]]
    """

    part: StatePart
    age_s: float

    @property
    def dimension(self) -> int:
        return self.part.dimension

    def __call__(self, states: FloatArray) -> FloatArray:
        return self.part(states @ transition(-self.age_s)[0].T)

    def jacobian(self, states: FloatArray) -> FloatArray:
        back = transition(-self.age_s)[0]
        return np.asarray(self.part.jacobian(states @ back.T) @ back)


def transition(dt_s: ArrayLike) -> FloatArray:
    """(n, 4, 4) F of constant velocity over dt (n,)."""
    dt = np.atleast_1d(np.asarray(dt_s, dtype=np.float64))
    f = np.broadcast_to(np.eye(4), (len(dt), 4, 4)).copy()
    f[:, 0, 2] = f[:, 1, 3] = dt
    return f


def process_noise(dt_s: ArrayLike, acceleration_m2_per_s3: ArrayLike) -> FloatArray:
    """(n, 4, 4) Q of a random walk of velocity: q [|dt|³/3, dt|dt|/2; dt|dt|/2, |dt|] per axis; one q or (n,)."""
    dt = np.atleast_1d(np.asarray(dt_s, dtype=np.float64))
    q = np.zeros((len(dt), 4, 4))
    for axis in (0, 1):
        q[:, axis, axis] = np.abs(dt) ** 3 / 3.0
        q[:, axis, axis + 2] = q[:, axis + 2, axis] = dt * np.abs(dt) / 2.0
        q[:, axis + 2, axis + 2] = np.abs(dt)
    return np.asarray(acceleration_m2_per_s3, dtype=np.float64).reshape(-1, 1, 1) * q


def usable_states(state: FloatArray, covariance: FloatArray) -> BoolArray:
    """(n,) whether a position is known with its error: of states (n, 4) and covariances (n, 4, 4)."""
    return finite_rows(covariance) & finite_rows(state)


def moved(
    state: FloatArray, covariance: FloatArray, dt_s: ArrayLike, acceleration_m2_per_s3: ArrayLike, late_s: float = 0.0
) -> tuple[FloatArray, FloatArray]:
    """States (n, 4) and covariances (n, 4, 4) moved by dt (n,) seconds, back in time where negative.

    late_s : 1σ of the stamps, which adds v vᵀ σ² along the velocity.
    """
    n = len(state)
    size, q = np.empty(n), np.empty(n)
    size[:], q[:] = np.asarray(dt_s, np.float64), np.asarray(acceleration_m2_per_s3, np.float64)
    there, out = np.empty((n, 4)), np.empty((n, 4, 4))
    if runs_compiled(states_moved):
        states_moved(np.ascontiguousarray(state), np.ascontiguousarray(covariance), size, q, float(late_s), there, out)
        return there, out
    dt, p = size[:, None], covariance
    there[:, :2], there[:, 2:] = state[:, :2] + dt * state[:, 2:], state[:, 2:]
    # F P Fᵀ + Q written out: with matrices, most of whose elements are 0, it takes four times as long.
    t, size = dt[:, :, None], np.abs(size)
    crossed = p[:, :2, 2:] + t * p[:, 2:, 2:]
    out[:, :2, :2] = symmetric(p[:, :2, :2] + t * (p[:, 2:, :2] + crossed))
    out[:, :2, 2:], out[:, 2:, :2] = crossed, crossed.transpose(0, 2, 1)
    out[:, 2:, 2:] = symmetric(p[:, 2:, 2:])
    of_position, of_both, of_velocity = q * (size * size * size) / 3.0, q * dt[:, 0] * size / 2.0, q * size
    for axis in range(2):
        out[:, axis, axis] += of_position
        out[:, axis, axis + 2] += of_both
        out[:, axis + 2, axis] += of_both
        out[:, axis + 2, axis + 2] += of_velocity
    if late_s:
        out[:, :2, :2] += late_s * late_s * (there[:, 2:, None] * there[:, None, 2:] + out[:, 2:, 2:])
    return there, out


def track_numbers(track: NDArray[Any]) -> IntArray:
    """(n,) the number of each track, from 0, in the order of their names (n,).

    >>> track_numbers(np.array(["b", "a", "b"])).tolist()
    [1, 0, 1]
    """
    return named_tracks(track)[1]


def named_tracks(track: NDArray[Any]) -> tuple[list[str], IntArray]:
    """The names of the tracks (n,) in order, each once, and (n,) the number of each among them.

    >>> named_tracks(np.array(["b", "a", "b"]))
    (['a', 'b'], array([1, 0, 1]))
    """
    if track.dtype.kind in "iu":
        numbers, number = np.unique(track, return_inverse=True)
        return list(map(str, numbers.tolist())), number
    # Names need not be comparable; their texts are. Each is looked up: to sort all takes twice as long.
    given = track.tolist()
    text = {one: str(one) for one in set(given)}
    names = sorted(set(text.values()))
    place = {name: k for k, name in enumerate(names)}
    of_given = {one: place[name] for one, name in text.items()}
    return names, np.fromiter(map(of_given.__getitem__, given), np.int64, len(given))


@dataclass(frozen=True)
class Succession:
    """The order of a source's reports within its tracks, for :meth:`at` at many instants.

    rows : (n,) reports, track by track, ordered by time; ties in the order of the reports.
    time_s : (n,) their times. final : (n,) whether a report is the last of its track.
    """

    rows: IntArray
    time_s: FloatArray
    final: BoolArray

    @classmethod
    def of(cls, time_s: FloatArray, track: NDArray[Any]) -> Succession:
        """Of reports in any order of time; track : (n,) names of their tracks.

        >>> Succession.of(np.array([5.0, 0.0, 9.0]), np.array(["a", "a", "b"])).at(6.0).tolist()
        [0]
        """
        number = track_numbers(track)
        rows = np.lexsort([time_s, number])
        final = np.append(np.diff(number[rows]) != 0, True) if len(rows) else np.empty(0, bool)
        return cls(rows, time_s[rows], final)

    def at(self, instant_s: float) -> IntArray:
        """The rows, ascending, of the current reports at an instant: of each track the last one not later.

        The time of a report counts, not its arrival: reports may be out of order.
        """
        past = self.time_s <= instant_s
        superseded = np.append(past[1:], False) & ~self.final
        return np.sort(self.rows[past & ~superseded])

    @cached_property
    def following(self) -> IntArray:
        """(m,) of each row up to the highest one, the next report of its track; ABSENT for none.

        >>> Succession.of(np.array([5.0, 0.0, 9.0]), np.array(["a", "a", "b"])).following.tolist()
        [-1, 0, -1]
        """
        out = np.full(int(self.rows.max(initial=-1)) + 1, ABSENT)
        has_next = np.flatnonzero(~self.final)
        out[self.rows[has_next]] = self.rows[has_next + 1]
        return out


#: Determinant of a covariance (2, 2), relative to the product of its variances, below which it is singular.
SINGULAR = 1e-12


def aged(covariance: FloatArray, density_per_m2: float | FloatArray) -> BoolArray:
    """(n,) whether more than one other object is expected within a state's own 1σ ellipse: π √|P| ρ > 1.

    Such a record no longer distinguishes objects. Depending on its motion and the density of objects, that takes
    seconds or hours. So is one whose covariance is so large in one direction that it is singular by rounding.
    """
    squared = determinant(covariance[:, :2, :2])
    area = math.pi * np.sqrt(np.maximum(squared, 0.0))
    is_singular = ~(squared > SINGULAR * covariance[:, 0, 0] * covariance[:, 1, 1])
    return np.asarray((area * density_per_m2 > 1.0) | is_singular)


def followed_back(measured: States, *, acceleration_m2_per_s3: float, speed_m_per_s: float) -> States:
    """The tracks of measured positions, each state filtered from the reports at and after it."""
    back = States.of(
        -measured.time_s, measured.state[:, :2], measured.covariance[:, :2, :2], track=measured.track,
        speed_m_per_s=speed_m_per_s,
    )  # fmt: skip
    tracks = follow(back, acceleration_m2_per_s3=acceleration_m2_per_s3).states
    state, covariance = tracks.state.copy(), tracks.covariance.copy()
    state[:, 2:] *= -1.0
    covariance[:, :2, 2:] *= -1.0
    covariance[:, 2:, :2] *= -1.0
    return replace(measured, state=state, covariance=covariance)


#: Median of χ² of two degrees of freedom.
MEDIAN = 2.0 * math.log(2.0)


@dataclass(frozen=True)
class FilteredTracks:
    """The filtered tracks of a source.

    states : the reports with the filtered state of their track after each.
    nis : (n,) normalised innovation squared of each report; NaN where it started a track.
    began : (n,) whether the report started a track: the first one, or one so far from the prediction that the id went
        to another object, or the object moved in a way that its motion model excludes.
    trend : (n, 4) the innovations up to each report, by which a manoeuvre is detected: the fading sum (2,) of the
        innovations, each whitened by its covariance; the sum of the squared weights, which is its variance per axis
        while the motion is as modelled; seconds since the last manoeuvre was detected.
    """

    states: States
    nis: FloatArray
    began: BoolArray
    trend: FloatArray


#: A row of :attr:`FilteredTracks.trend` without innovations.
NO_TREND = (0.0, 0.0, 0.0, math.inf)


def follow(reports: States, *, acceleration_m2_per_s3: float, trend: FloatArray | None = None) -> FilteredTracks:
    """The filtered track state after each report of a source with track ids, by the positions.

    A reported velocity counts at the start of a track only.

    reports : in any order; they are filtered in order of time.
    acceleration_m2_per_s3 : power density of the velocity's random walk.
    trend : (n, 4) :attr:`FilteredTracks.trend` at the first report of each track, where that is a filtered state.

    Source: METHOD 1 (prediction); Bar-Shalom, Li and Kirubarajan 2001, sections 5.2 and 6.2; for manoeuvres 11.2 (noise
    level adjustment), with the sum of the innovations instead of that of their squares: a lag has a direction.
    """
    if reports.track is None:
        raise InputError("follow: reports name no tracks; give the source's own track numbers or identities")
    rows, number = reports.by_track()
    state, covariance = np.array(reports.state, order="C"), np.array(reports.covariance, order="C")
    nis, began = np.full(len(reports), np.nan), np.zeros(len(reports), bool)
    trends = np.tile(NO_TREND, (len(reports), 1)) if trend is None else np.array(trend, order="C")
    filter_tracks(
        rows, np.diff(number, prepend=-1) != 0, np.ascontiguousarray(reports.time_s), float(acceleration_m2_per_s3),
        float(acceleration_m2_per_s3 * MANOEUVRE_NOISE), ChiSquare(1.0 - NEW_TRACK_PROBABILITY).limit(2),
        ChiSquare(1.0 - MANOEUVRE_PROBABILITY).limit(2), MANOEUVRE_S, INNOVATION_MEMORY,
        MAX_INNOVATION, state, covariance, trends, nis, began,
    )  # fmt: skip
    return FilteredTracks(States(reports.time_s, state, covariance, reports.track, reports.rows), nis, began, trends)


def are_unfiltered(reports: States, *, acceleration_m2_per_s3: float) -> bool:
    """Whether the reports of a source with track ids are independent measurements, not smoothed by a tracker.

    Independent measurements scatter by their stated errors, and their NIS has a χ² distribution with two degrees of
    freedom; the reports of a tracker scatter less. The median NIS decides; it is robust to breaks of tracks. False with
    too few reports.
    """
    nis = follow(reports, acceleration_m2_per_s3=acceleration_m2_per_s3).nis
    nis = nis[np.isfinite(nis)]
    return len(nis) >= MIN_INNOVATIONS and float(np.median(nis)) > INNOVATION_RATIO * MEDIAN

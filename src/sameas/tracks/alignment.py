"""Time: every record moved to one instant by its own motion, its uncertainty grown by what the motion leaves open.

A state is (east, north, velocity east, velocity north) in a plane, metres and seconds. Its velocity is a random walk of
known power density q (m²/s³), the standard model of nearly constant velocity. Moved by dt a state becomes F x, with
covariance F P Fᵀ + Q(|dt|). A record that is later than the instant is moved back, and its uncertainty grows too.

- :class:`States`: the reports of one source as states, with or without velocities.
- :func:`moved`: states at other times. :class:`Succession`: which report of each track is current at an instant.
- :func:`aged`: which of them are too uncertain to distinguish objects. There is no limit of age.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.errors import InputError
from sameas.gaussian import symmetric
from sameas.many.observations import Part


@dataclass(frozen=True)
class States:
    """Reports of one source in a plane, in the order in which it made them.

    Attributes
    ----------
    time_s : (n,) seconds, the time for which a state holds.
    state : (n, 4) east, north, velocity east, velocity north; NaN where no position is known.
    covariance : (n, 4, 4).
    track : (n,) the source's own name of the object, or None each: every report is then one of its own.
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
        return self.usable_of(slice(None))

    def usable_of(self, which: NDArray[Any] | slice) -> BoolArray:
        """(k,) the same of some of the reports."""
        sound = np.isfinite(self.covariance[which]).all(axis=(1, 2)) & np.isfinite(self.state[which]).all(axis=1)
        return np.asarray(sound)

    def take(self, which: NDArray[Any]) -> States:
        """Some of the reports."""
        track = None if self.track is None else self.track[which]
        return States(self.time_s[which], self.state[which], self.covariance[which], track, self.rows[which])

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
        """States from positions (n, 2) with covariances (n, 2, 2), and velocities (n, 2) where they are known.

        An unknown velocity, NaN or not given, is 0 ± ``speed_m_per_s`` per axis; a velocity without a covariance is
        refused. Reports without a time are refused, those without a position are kept, but not used.
        """
        t, x = np.asarray(time_s, dtype=np.float64), np.asarray(position, dtype=np.float64)
        n = len(t)
        if x.shape != (n, 2) or t.ndim != 1:
            raise InputError(f"{source}: times {t.shape}, positions {x.shape}; give (n,) and (n, 2)")
        if not np.isfinite(t).all():
            lost = np.flatnonzero(~np.isfinite(t))
            reports = "1 report has" if len(lost) == 1 else f"{len(lost)} reports have"
            raise InputError(f"{source}: {reports} no time (first: row {lost[0]}); give seconds")
        if not speed_m_per_s > 0.0:
            raise InputError(f"{source}: motion.speed_m_per_s is {speed_m_per_s}; give how fast objects may be, 1σ")
        state, spread = np.zeros((n, 4)), np.zeros((n, 4, 4))
        state[:, :2], spread[:, :2, :2] = x, np.broadcast_to(np.asarray(covariance, dtype=np.float64), (n, 2, 2))
        spread[:, 2, 2] = spread[:, 3, 3] = speed_m_per_s**2
        if velocity is not None:
            if velocity_covariance is None:
                raise InputError(f"{source}: velocities are given without their covariances; give (n, 2, 2)")
            v = np.asarray(velocity, dtype=np.float64)
            vv = np.broadcast_to(np.asarray(velocity_covariance, dtype=np.float64), (n, 2, 2))
            known = np.isfinite(v).all(axis=1) & np.isfinite(vv).all(axis=(1, 2))
            state[known, 2:], spread[known, 2:, 2:] = v[known], vv[known]
        names = None if track is None else np.asarray(track)
        if names is not None and names.shape != (n,):
            raise InputError(f"{source}: {names.shape} names of tracks for {n} reports; give one each")
        return cls(t, state, spread, names, np.arange(n))


@dataclass(frozen=True)
class Earlier:
    """The observation by ``part`` of a state (east, north, velocity) ``age_s`` seconds ago, of the state now.

    >>> from sameas.many.observations import Bearing
    >>> Earlier(Bearing((0.0, 0.0), dimension=4), 2.0)(np.array([[10.0, 30.0, 5.0, 0.0]])).tolist()
    [[0.0]]
    """

    part: Part
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
    """(n, 4, 4) F: the position goes on with the velocity for dt (n,)."""
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


def moved(
    state: FloatArray, covariance: FloatArray, dt_s: ArrayLike, acceleration_m2_per_s3: ArrayLike
) -> tuple[FloatArray, FloatArray]:
    """States (n, 4) and covariances (n, 4, 4) after dt (n,) seconds, before where dt is negative."""
    dt = np.broadcast_to(np.asarray(dt_s, dtype=np.float64), (len(state),))[:, None]
    there = np.concatenate([state[:, :2] + dt * state[:, 2:], state[:, 2:]], axis=1)
    # F P Fᵀ + Q, written out: matrices of which most elements are 0 take four times as long.
    t, p = dt[:, :, None], covariance
    crossed = p[:, :2, 2:] + t * p[:, 2:, 2:]
    out = np.empty(p.shape)
    out[:, :2, :2] = symmetric(p[:, :2, :2] + t * (p[:, 2:, :2] + crossed))
    out[:, :2, 2:], out[:, 2:, :2] = crossed, crossed.transpose(0, 2, 1)
    out[:, 2:, 2:] = symmetric(p[:, 2:, 2:])
    size, q = np.abs(dt[:, 0]), np.broadcast_to(np.asarray(acceleration_m2_per_s3, np.float64), (len(state),))
    for axis, (place, cross, speed) in enumerate([(q * size**3 / 3.0, q * dt[:, 0] * size / 2.0, q * size)] * 2):
        out[:, axis, axis] += place
        out[:, axis, axis + 2] += cross
        out[:, axis + 2, axis] += cross
        out[:, axis + 2, axis + 2] += speed
    return there, out


def stamped_late(covariance: FloatArray, state: FloatArray, sigma_s: float | FloatArray) -> FloatArray:
    """Covariances grown by stamps that are uncertain by ``sigma_s``, (n,) or one: v vᵀ σ² along the velocity."""
    grown = covariance.copy()
    speed_sq = state[:, 2:, None] * state[:, None, 2:] + covariance[:, 2:, 2:]
    grown[:, :2, :2] += np.square(sigma_s).reshape(-1, 1, 1) * speed_sq
    return grown


@dataclass(frozen=True)
class Succession:
    """Which reports of a source follow each other in its tracks; :meth:`at` is asked instant after instant.

    Attributes
    ----------
    rows : (n,) reports, track after track, in each by their times; equal times in the order in which they came.
    time_s : (n,) their times. final : (n,) whether a report is the last of its track.
    """

    rows: IntArray
    time_s: FloatArray
    final: BoolArray

    @classmethod
    def of(cls, time_s: FloatArray, track: NDArray[Any]) -> Succession:
        """Of reports in any order of time, each under the name of its track.

        >>> Succession.of(np.array([5.0, 0.0, 9.0]), np.array(["a", "a", "b"])).at(6.0).tolist()
        [0]
        """
        # Names need not be comparable; their texts are.
        _, number = np.unique(track.astype(str), return_inverse=True)
        rows = np.lexsort([time_s, number])
        final = np.append(np.diff(number[rows]) != 0, True) if len(rows) else np.empty(0, bool)
        return cls(rows, time_s[rows], final)

    def at(self, instant_s: float) -> IntArray:
        """Rows, ascending, of the current reports at an instant: of each track the last that is not later.

        The time for which a report holds counts, not its arrival: reports may be out of order.
        """
        past = self.time_s <= instant_s
        # The past reports of a track are before the others.
        overtaken = np.append(past[1:], False) & ~self.final
        return np.sort(self.rows[past & ~overtaken])


def aged(covariance: FloatArray, density_per_m2: float) -> BoolArray:
    """(n,) whether more than one other object is expected within a state's own 1σ ellipse: π √|P| ρ > 1.

    Such a record does not distinguish objects any more. That may be after seconds or hours, by its motion and the
    density of objects.
    """
    area = math.pi * np.sqrt(np.maximum(np.linalg.det(covariance[:, :2, :2]), 0.0))
    return np.asarray(area * density_per_m2 > 1.0)

"""Slow objects: the probability that an object is alongside, at anchor or adrift, and its velocity by all its reports.

Vessels at anchor report a velocity of about 0. The velocity random walk of a vessel under way would move one at anchor
by 150 m between two reports three minutes apart; it swings by 15 m, and one alongside stays where it is. A vessel
adrift, or one that waits for a pilot, keeps a slow velocity for minutes. So an object is in one of five modes of
motion, each with a share of all objects and a velocity of 0 ± s per axis; w is ``motion.stationary_share``:

    alongside    w/2              s = ``ALONGSIDE`` · motion.stationary_m_per_s, new at each report
    at anchor    w/2              s = motion.stationary_m_per_s, new at each report
    adrift       a share of 1−w   s = ``DRIFT_M_PER_S``, with a random walk of 2 s²/``DRIFT_S``
    steady       half of others   s = motion.speed_m_per_s, with the random walk of those adrift
    under way    half of others   s = motion.speed_m_per_s, with the random walk of the motion

From one report alone, even a velocity of exactly 0 with an error of 0.5 m/s leaves 6 % for a vessel under way, whose
walk then dominates the mean covariance: after three minutes 7 times the variance of the errors of those at anchor. And
0.3 ± 0.3 m/s may be the velocity of a vessel at anchor, but not report after report. A steady course fits the walk of
those adrift better than that of a motion with turns, at any speed: without a mode of their own, ships at 4 kn would be
adrift. So the modes are filtered over each track. Each has a Kalman filter of position and velocity, and a probability,
which changes by the density of each report. Modes change as a Markov process: after a mean time of (1 − w) ``REST_S``
the mode is drawn anew by the shares, except that one at rest does not follow the other, so that ``REST_S`` is the mean
time at rest. The change is at an unknown time between two reports, with the mean and variance of a uniform
distribution.

Source: the generalised pseudo-Bayesian estimator of second order (Bar-Shalom, Li and Kirubarajan 2001, 11.6.5); the
mixture is their 1.4.16.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sameas.arrays import BoolArray, FloatArray
from sameas.errors import InputError
from sameas.gaussian import Gaussian, symmetric
from sameas.kernels.modes import filter_modes
from sameas.tracks.alignment import States
from sameas.tracks.source import Motion

#: Modes of motion: alongside, at anchor, adrift, under way. The first RESTS are at rest, the first SLOW are slow.
RESTS, SLOW, MODES = 2, 3, 4
#: Modes that are filtered: those under way on a steady course and others apart.
FILTERED = MODES + 1
ADRIFT = 2
#: Reports of which the modes are in memory at once; 200 MB.
BATCH = 100_000
#: Smallest variance of a reported coordinate, m² or m²/s²: errors may be stated as 0.
MIN_VARIANCE = 1e-6

#: A velocity is unknown if its variance is at least this share of the prior variance of velocities.
UNKNOWN_VELOCITY_SHARE = 0.9
#: Mean time for which a stationary object stays so; speed of a vessel alongside, in that of one at anchor.
REST_S, ALONGSIDE = 3600.0, 0.1
#: Share of the moving objects that are adrift, their velocity (1σ per axis), and the time in which it changes: tidal
#: streams reach 1 to 2 m/s and turn within hours, but a vessel waiting under engines corrects her drift every few
#: minutes.
DRIFT_SHARE, DRIFT_M_PER_S, DRIFT_S = 0.1, 0.5, 600.0
DRIFT_WALK_M2_PER_S3 = 2.0 * DRIFT_M_PER_S**2 / DRIFT_S  # random walk of the velocity of a vessel adrift


@dataclass(frozen=True)
class Modes:
    """Modes of motion of the objects of n reports, by all reports of their tracks so far.

    log_p : (n, FILTERED) ln of their probabilities; NaN where the velocity is unknown. mean, covariance : (n, FILTERED,
    4), (n, FILTERED, 4, 4) state in each mode.
    """

    log_p: FloatArray
    mean: FloatArray
    covariance: FloatArray

    @classmethod
    def unknown(cls, n: int) -> Modes:
        return cls(*(np.full((n, FILTERED, *shape), np.nan) for shape in ((), (4,), (4, 4))))

    @property
    def p_slow(self) -> FloatArray:
        """(n, SLOW) probability of the slow modes; 0 where the velocity is unknown."""
        return np.nan_to_num(np.exp(self.log_p[:, :SLOW]))


def stationary(reports: States, motion: Motion, known: Modes | None = None) -> tuple[States, Modes | None]:
    """The reports with the velocities of slow objects, and the modes of motion.

    The returned state and covariance are the mean and covariance of the mixture of all modes: in those at rest of the
    report and a velocity of 0 ± s, adrift of the reported position and the filtered velocity, under way of the report.
    There is no threshold. Unreported velocities stay unknown. Without tracks each report is judged alone.

    If the motion has no share of stationary objects, the reports are returned unchanged, and None.

    known : modes of reports for which they are known, from an earlier call; NaN for the others.

    >>> reports = States.of([0.0, 0.0], [[0.0, 0.0]] * 2, np.eye(2), speed_m_per_s=8.0,
    ...                     velocity=[[0.1, 0.0], [4.0, 0.0]], velocity_covariance=0.09 * np.eye(2))
    >>> motion = Motion(0.01, 8.0, stationary_m_per_s=0.1, stationary_share=0.2)
    >>> now, modes = stationary(reports, motion)
    >>> modes.p_slow.sum(axis=1).round(2).tolist(), now.state[:, 2].round(2).tolist()
    ([0.99, 0.0], [0.01, 4.0])
    """
    speed = motion.speed_m_per_s
    if not motion.stationary_m_per_s or not speed or not motion.stationary_share:
        return reports, None
    if motion.stationary_share >= 1.0:
        share = motion.stationary_share
        raise InputError(f"motion.stationary_share is {share}; give the share of stationary objects, below 1")
    has_velocity = reports.usable & is_known_velocity(reports.covariance[:, 2, 2], speed)
    model = _Model.of(motion)
    modes = model.filtered(reports, has_velocity, known)
    rows = np.flatnonzero(has_velocity)
    x, cov = reports.state[rows], reports.covariance[rows]
    p = np.exp(modes.log_p[rows])
    updates = [
        Gaussian(np.zeros_like(x), cov).conditional(cov[:, :, 2:], -x[:, 2:], cov[:, 2:, 2:] + s**2 * np.eye(2))
        for s in model.speed[:RESTS]
    ]
    adrift = cov.copy()
    adrift[:, :2, 2:] = adrift[:, 2:, :2] = 0.0
    adrift[:, 2:, 2:] = modes.covariance[rows, ADRIFT, 2:, 2:]
    change = np.zeros_like(x)
    change[:, 2:] = modes.mean[rows, ADRIFT, 2:] - x[:, 2:]
    updates.append(Gaussian(change, adrift))
    mean, mixed = np.zeros_like(x), cov.copy()
    for weight, update in zip(p.T[:SLOW], updates, strict=True):
        mean += weight[:, None] * update.mean
        apart = update.mean[:, :, None] * update.mean[:, None, :]
        mixed += weight[:, None, None] * (update.covariance - cov + apart)
    state, covariance = reports.state.copy(), reports.covariance.copy()
    state[rows] = x + mean
    covariance[rows] = symmetric(mixed - mean[:, :, None] * mean[:, None, :])
    return States(reports.time_s, state, covariance, reports.track, reports.rows), modes


def slow_objects(reports: States, motion: Motion, batch: int = BATCH) -> tuple[States, FloatArray | None]:
    """As :func:`stationary`, with (n, SLOW) probabilities of the slow modes instead of all modes.

    batch : number of reports above which some whole tracks are taken at a time: the modes of a report take 2 kB.
    """
    if len(reports) <= batch:
        now, modes = stationary(reports, motion)
        return now, None if modes is None else modes.p_slow
    if mode_shares(motion) is None:
        return reports, None
    if reports.track is None:
        rows, ends = np.flatnonzero(reports.usable), np.arange(batch, len(reports), batch)
    else:
        rows, number = reports.by_track()
        last = np.flatnonzero(np.diff(number)) + 1
        ends = last[np.flatnonzero(np.diff(last // batch, prepend=0))]
    state, covariance = reports.state.copy(), reports.covariance.copy()
    p_slow = np.zeros((len(reports), SLOW))
    for part in np.split(rows, ends[ends < len(rows)]):
        part = np.sort(part)
        now, modes = stationary(reports.take(part), motion)
        assert modes is not None
        state[part], covariance[part], p_slow[part] = now.state, now.covariance, modes.p_slow
    return States(reports.time_s, state, covariance, reports.track, reports.rows), p_slow


def is_known_velocity(variance: FloatArray, speed_m_per_s: float) -> BoolArray:
    """(n,) whether velocities with these variances per axis (n,) are known, of objects with 1σ of velocity per axis
    ``speed_m_per_s``."""
    return np.asarray(variance < UNKNOWN_VELOCITY_SHARE * speed_m_per_s**2)


def mode_shares(motion: Motion) -> FloatArray | None:
    """(MODES,) the share of each mode; None if the motion has no stationary objects."""
    at_rest = motion.stationary_share
    if not motion.stationary_m_per_s or not motion.speed_m_per_s or not at_rest:
        return None
    moves = 1.0 - at_rest
    return np.array([at_rest / 2.0] * 2 + [DRIFT_SHARE * moves, (1.0 - DRIFT_SHARE) * moves])


@dataclass(frozen=True)
class _Model:
    """speed, walk, share : (FILTERED,) as of :func:`sameas.kernels.modes.filter_modes`. exchange_s : mean time after
    which the mode is drawn anew."""

    speed: FloatArray
    walk: FloatArray
    share: FloatArray
    exchange_s: float

    @classmethod
    def of(cls, motion: Motion) -> _Model:
        slow, speed, share = motion.stationary_m_per_s, motion.speed_m_per_s, mode_shares(motion)
        assert slow and speed and share is not None
        return cls(
            np.array([ALONGSIDE * slow, slow, DRIFT_M_PER_S, speed, speed]),
            np.array([-1.0, -1.0, *[DRIFT_WALK_M2_PER_S3] * 2, motion.acceleration_m2_per_s3 or 0.0]),
            np.append(share[:SLOW], np.repeat(share[SLOW:] / 2.0, 2)),
            REST_S * float(share[RESTS:].sum()),
        )

    def filtered(self, reports: States, has_velocity: BoolArray, known: Modes | None) -> Modes:
        """The modes by all reports; reports without a velocity start their tracks again."""
        if reports.track is None:
            rows = np.flatnonzero(reports.usable)
            begins = np.ones(len(rows), bool)
        else:
            rows, number = reports.by_track()
            begins = np.diff(number, prepend=-1) != 0
            begins[1:] |= ~has_velocity[rows[:-1]]
        kept = has_velocity[rows]
        rows, begins = rows[kept], begins[kept]
        modes = Modes.unknown(len(reports))
        given = np.zeros(len(rows), bool)
        if known is not None:
            given = np.isfinite(known.log_p[rows, -1])
            for column in ("log_p", "mean", "covariance"):
                getattr(modes, column)[rows[given]] = getattr(known, column)[rows[given]]
        filter_modes(
            rows, begins, given, reports.time_s, reports.state, reports.covariance + MIN_VARIANCE * np.eye(4),
            self.speed, self.walk, self.share, self.exchange_s, modes.log_p, modes.mean, modes.covariance,
        )  # fmt: skip
        return modes

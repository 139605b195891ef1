"""Stationary objects: the probability that an object is at anchor or alongside, and its velocity by all its reports.

Vessels at anchor report a velocity of about 0. The velocity random walk of a vessel under way would move one at anchor
by 150 m between two reports three minutes apart; it swings by 15 m, and one alongside stays where it is. So a reported
velocity v with covariance C comes from one of three kinds of objects:

    at anchor    v ~ N(0, C + s² 1), a share w/2 of all,  s = motion.stationary_m_per_s, w = motion.stationary_share
    alongside    the same, with ``tuning.alongside`` s
    moving       v ~ N(0, C + V² 1), all others,          V = motion.speed_m_per_s

The velocity of a stationary object is 0 ± s a priori, without a random walk. From one report alone, even a velocity of
exactly 0 with an error of 0.5 m/s leaves 6 % for a moving object, whose walk then dominates the mean covariance: after
three minutes 7 times the variance of the errors of those at anchor. But an object at anchor stays there. Objects become
moving and stationary as a Markov process with the mean time ``rest_s`` at rest and the equilibrium share w, and each
report (x, v) of a track is predicted from the previous one (x′, v′), Δt before, by each of four cases, of which three
are of either s:

    stays at rest     x′ ± s Δt, 0 ± s
    departs           x′ ± V Δt / √3, 0 ± V
    arrives           x′ + v′ Δt/2 ± v′ Δt / √12, with the random walk, 0 ± s
    moves on          x′ + v′ Δt, v′, with the random walk

Departures and arrivals are at an unknown time in between, with the variance of a uniform distribution.

Source: a hidden Markov model (Bar-Shalom, Li and Kirubarajan 2001, 11.6); the mixture is their 1.4.16.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.special import logsumexp

from sameas.arrays import ABSENT, BoolArray, FloatArray, IntArray
from sameas.errors import InputError
from sameas.gaussian import Gaussian, log_density, symmetric
from sameas.tracks.alignment import States, by_turn, moved
from sameas.tracks.source import Motion
from sameas.tracks.tuning import DEFAULT_TUNING, Tuning

#: Kinds of stationary objects: alongside, and at anchor.
RESTS = 2
#: Smallest variance of a predicted coordinate, m² or m²/s²: errors may be stated as 0.
MIN_VARIANCE = 1e-6


def stationary(
    reports: States, motion: Motion, tuning: Tuning = DEFAULT_TUNING, p_known: FloatArray | None = None
) -> tuple[States, FloatArray | None]:
    """The reports with the velocities of stationary objects, and (n, RESTS) the probability that each is of an object
    alongside, and of one at anchor.

    The returned state and covariance are the mean and covariance of the mixture of all kinds. There is no threshold:
    an object at 2 knots moves, one at 0.2 knots is stationary, and in between the covariance includes both. Unreported
    velocities stay unknown. Without tracks each report is judged alone.

    If the motion has no share of stationary objects, the reports are returned unchanged, and None.

    p_known : (n, RESTS) the probabilities of reports for which they are known, from an earlier call; NaN for the
    others.

    >>> reports = States.of([0.0, 0.0], [[0.0, 0.0]] * 2, np.eye(2), speed_m_per_s=8.0,
    ...                     velocity=[[0.1, 0.0], [4.0, 0.0]], velocity_covariance=0.09 * np.eye(2))
    >>> motion = Motion(0.01, 8.0, stationary_m_per_s=0.1, stationary_share=0.2)
    >>> now, p_at_rest = stationary(reports, motion)
    >>> p_at_rest.sum(axis=1).round(2).tolist(), now.state[:, 2].round(2).tolist()
    ([0.99, 0.0], [0.01, 4.0])
    """
    slow, speed, share = motion.stationary_m_per_s, motion.speed_m_per_s, motion.stationary_share
    if not slow or not speed or not share:
        return reports, None
    if share >= 1.0:
        raise InputError(f"motion.stationary_share is {share}; give the share of stationary objects, below 1")
    state, covariance = reports.state.copy(), reports.covariance.copy()
    has_velocity = reports.usable & (reports.covariance[:, 2, 2] < tuning.unknown_velocity_share * speed**2)
    rows = np.flatnonzero(has_velocity)
    x, cov = state[rows], covariance[rows]
    speeds = slow * np.array([tuning.alongside, 1.0])
    # Updates of the states by a measured velocity of 0 ± s.
    updates = [
        Gaussian(np.zeros_like(x), cov).conditional(cov[:, :, 2:], -x[:, 2:], cov[:, 2:, 2:] + s**2 * np.eye(2))
        for s in speeds
    ]
    log_alone = np.stack(
        [log_density(x[:, 2:], cov[:, 2:, 2:] + s**2 * np.eye(2)) for s in (*speeds, speed)], axis=1
    ) + np.log([share / RESTS, share / RESTS, 1.0 - share])
    p_at_rest = np.zeros((len(reports), RESTS))
    p_at_rest[rows] = _probabilities(log_alone)
    if reports.track is not None:
        at_rest = [(state.copy(), covariance.copy()) for _ in speeds]
        for (rest_state, rest_covariance), update in zip(at_rest, updates, strict=True):
            rest_state[rows], rest_covariance[rows] = x + update.mean, update.covariance
        transitions = _Transitions(reports, at_rest, speeds, motion, tuning)
        p_at_rest = _by_track(reports, has_velocity, p_at_rest, transitions, p_known)
    p = p_at_rest[rows]
    mean, mixed = np.zeros_like(x), cov.copy()
    for weight, update in zip(p.T, updates, strict=True):
        mean += weight[:, None] * update.mean
        apart = update.mean[:, :, None] * update.mean[:, None, :]
        mixed += weight[:, None, None] * (update.covariance - cov + apart)
    state[rows] = x + mean
    covariance[rows] = symmetric(mixed - mean[:, :, None] * mean[:, None, :])
    return States(reports.time_s, state, covariance, reports.track, reports.rows), p_at_rest


def _probabilities(log_weight: FloatArray) -> FloatArray:
    """(n, RESTS) the probabilities of the kinds at rest; log_weight : (n, RESTS + 1), that of moving objects last."""
    return np.asarray(np.exp(log_weight[:, :RESTS] - logsumexp(log_weight, axis=1, keepdims=True)))


def _by_track(
    reports: States, has_velocity: BoolArray, p_alone: FloatArray, transitions: _Transitions, p_known: FloatArray | None
) -> FloatArray:
    """(n, RESTS) the probability that reports are of stationary objects, given the previous ones of their tracks.

    p_alone : (n, RESTS) that by each report alone, for the first of a track and those after one without a velocity.
    """
    turns, previous = by_turn(reports, reports.usable), np.full(len(reports), ABSENT)
    for before, now in pairwise(turns):
        previous[now] = before[: len(now)]
    follows = (previous >= 0) & has_velocity & has_velocity[previous]
    log_p = np.zeros((len(reports), 3 * RESTS + 1))
    log_p[follows] = transitions.log_probable(previous[follows], np.flatnonzero(follows))
    p = p_alone.copy()
    for now in turns:
        some = now[follows[now]]
        before = p[previous[some]]
        with np.errstate(divide="ignore"):
            log_rests, log_moved = np.log(before), np.log(np.maximum(1.0 - before.sum(axis=1, keepdims=True), 0.0))
        stays, departs, arrives, moves = np.split(log_p[some], [RESTS, 2 * RESTS, 3 * RESTS], axis=1)
        rests = np.logaddexp(log_rests + stays, log_moved + arrives)
        moving = np.logaddexp(logsumexp(log_rests + departs, axis=1, keepdims=True), log_moved + moves)
        p[some] = _probabilities(np.concatenate([rests, moving], axis=1))
        if p_known is not None:
            p[now] = np.where(np.isnan(p_known[now]), p[now], p_known[now])
    return p


@dataclass(frozen=True)
class _Transitions:
    """From each report of a track to the next one.

    at_rest : of each kind of stationary objects, (n, 4), (n, 4, 4) states and covariances of the reports. speeds :
    (RESTS,) their 1σ per axis.
    """

    reports: States
    at_rest: Sequence[tuple[FloatArray, FloatArray]]
    speeds: FloatArray
    motion: Motion
    tuning: Tuning

    def log_probable(self, previous: IntArray, now: IntArray) -> FloatArray:
        """(k, 3 RESTS + 1) ln of the joint probability of each case and of the reports ``now``, given the previous ones
        and the state of the object then: staying, departing and arriving of each kind, and moving on."""
        reports, motion = self.reports, self.motion
        speed, share = motion.speed_m_per_s, motion.stationary_share
        assert speed and share
        dt = reports.time_s[now] - reports.time_s[previous]
        measured, errors = reports.state[now], reports.covariance[now] + MIN_VARIANCE * np.eye(4)
        moving, p_moving = moved(
            reports.state[previous], reports.covariance[previous], dt, motion.acceleration_m2_per_s3 or 0.0
        )
        half_way = 0.5 * dt[:, None] * reports.state[previous, 2:]
        arrived, arrives = np.zeros_like(moving), np.zeros_like(p_moving)
        arrived[:, :2] = moving[:, :2] - half_way
        arrives[:, :2, :2] = p_moving[:, :2, :2] + half_way[:, :, None] * half_way[:, None, :] / 3.0
        staying, departing, arriving = [], [], []
        for slow, (state, covariance) in zip(self.speeds.tolist(), self.at_rest, strict=True):
            resting, rests = np.zeros_like(moving), np.zeros_like(p_moving)
            resting[:, :2], rests[:, :2, :2] = state[previous, :2], covariance[previous, :2, :2]
            staying.append((resting, rests + slow**2 * _of_velocity(dt, 1.0, 1.0)))
            departing.append((resting, rests + speed**2 * _of_velocity(dt, 1.0 / 3.0, 0.5)))
            arriving.append((arrived, arrives + slow**2 * _of_velocity(dt, 0.0, 0.0)))
        cases = (*staying, *departing, *arriving, (moving, p_moving))
        log_p = np.stack([log_density(measured - mean, covariance + errors) for mean, covariance in cases], axis=1)
        # Probabilities of a change in between.
        changes = -np.expm1(-dt / (self.tuning.rest_s * (1.0 - share)))
        p_departs, p_arrives = (1.0 - share) * changes, share * changes
        p_case = (1.0 - p_departs, p_departs, p_arrives / RESTS)
        with np.errstate(divide="ignore"):
            prior = np.log([p for p in p_case for _ in range(RESTS)] + [1.0 - p_arrives]).T
        # A second report of one time is no further evidence.
        none = np.array([0.0] * RESTS + [-np.inf] * (2 * RESTS) + [0.0])
        return np.where(dt[:, None] > 0.0, log_p + prior, none)


def _of_velocity(dt: FloatArray, path: float, both: float) -> FloatArray:
    """(k, 4, 4) covariance of a velocity of 0 ± 1 per axis and of the displacement by it: Δt² times ``path`` of the
    displacement, Δt times ``both`` of it and the velocity."""
    out = np.zeros((len(dt), 4, 4))
    for axis in range(2):
        out[:, axis, axis], out[:, axis + 2, axis + 2] = path * dt**2, 1.0
        out[:, axis, axis + 2] = out[:, axis + 2, axis] = both * dt
    return out

"""Stationary objects: the probability that an object is at anchor or alongside, and its velocity by all its reports.

Vessels at anchor report a velocity of about 0. The velocity random walk of a vessel under way would move one at anchor
by 150 m between two reports three minutes apart; it swings by 15 m. So a reported velocity v with covariance C comes
from one of two kinds of objects:

    stationary   v ~ N(0, C + s² 1), a share w of all,  s = motion.stationary_m_per_s, w = motion.stationary_share
    moving       v ~ N(0, C + V² 1), all others,        V = motion.speed_m_per_s

The velocity of a stationary object is 0 ± s a priori, without a random walk. From one report alone, even a velocity of
exactly 0 with an error of 0.5 m/s leaves 6 % for a moving object, whose walk then dominates the mean covariance: after
three minutes 7 times the variance of the errors of those at anchor. But an object at anchor stays there. Objects become
moving and stationary as a Markov process with the mean time ``rest_s`` at rest and the equilibrium share w, and each
report (x, v) of a track is predicted from the previous one (x′, v′), Δt before, by each of four cases:

    stays at rest     x′ ± s Δt, 0 ± s
    departs           x′ ± V Δt / √3, 0 ± V
    arrives           x′ + v′ Δt/2 ± v′ Δt / √12, with the random walk, 0 ± s
    moves on          x′ + v′ Δt, v′, with the random walk

Departures and arrivals are at an unknown time in between, with the variance of a uniform distribution.

Source: a hidden Markov model of two states (Bar-Shalom, Li and Kirubarajan 2001, 11.6); the mixture is their 1.4.16.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from scipy.special import expit, logit

from sameas.arrays import ABSENT, BoolArray, FloatArray, IntArray
from sameas.errors import InputError
from sameas.gaussian import Gaussian, log_density, symmetric
from sameas.tracks.alignment import States, by_turn, moved
from sameas.tracks.source import Motion
from sameas.tracks.tuning import DEFAULT_TUNING, Tuning

#: Smallest variance of a predicted coordinate, m² or m²/s²: errors may be stated as 0.
MIN_VARIANCE = 1e-6


def stationary(
    reports: States, motion: Motion, tuning: Tuning = DEFAULT_TUNING, p_known: FloatArray | None = None
) -> tuple[States, FloatArray | None]:
    """The reports with the velocities of stationary objects, and (n,) the probability that each is stationary.

    The returned state and covariance are the mean and covariance of the mixture of both kinds. There is no threshold:
    an object at 2 knots moves, one at 0.2 knots is stationary, and in between the covariance includes both. Unreported
    velocities stay unknown. Without tracks each report is judged alone.

    If the motion has no share of stationary objects, the reports are returned unchanged, and None.

    p_known : (n,) the probability of reports for which it is known, from an earlier call; NaN for the others.

    >>> reports = States.of([0.0, 0.0], [[0.0, 0.0]] * 2, np.eye(2), speed_m_per_s=8.0,
    ...                     velocity=[[0.1, 0.0], [4.0, 0.0]], velocity_covariance=0.09 * np.eye(2))
    >>> motion = Motion(0.01, 8.0, stationary_m_per_s=0.1, stationary_share=0.2)
    >>> now, p_stationary = stationary(reports, motion)
    >>> p_stationary.round(2).tolist(), now.state[:, 2].round(2).tolist()
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
    # Update of the state by a measured velocity of 0 ± slow.
    update = Gaussian(np.zeros_like(x), cov).conditional(cov[:, :, 2:], -x[:, 2:], cov[:, 2:, 2:] + slow**2 * np.eye(2))
    log_stationary, log_moving = (log_density(x[:, 2:], cov[:, 2:, 2:] + v**2 * np.eye(2)) for v in (slow, speed))
    p_stationary = np.zeros(len(reports))
    p_stationary[rows] = expit(logit(share) + log_stationary - log_moving)
    if reports.track is not None:
        at_rest = state.copy(), covariance.copy()
        at_rest[0][rows], at_rest[1][rows] = x + update.mean, update.covariance
        p_stationary = _by_track(reports, has_velocity, p_stationary, at_rest, motion, tuning, p_known)
    step, p = update.mean, p_stationary[rows]
    weight = p[:, None, None]
    state[rows] = x + p[:, None] * step
    mixed = (
        weight * update.covariance
        + (1.0 - weight) * cov
        + weight * (1.0 - weight) * step[:, :, None] * step[:, None, :]
    )
    covariance[rows] = symmetric(mixed)
    return States(reports.time_s, state, covariance, reports.track, reports.rows), p_stationary


def _by_track(
    reports: States, has_velocity: BoolArray, p_alone: FloatArray, at_rest: tuple[FloatArray, FloatArray],
    motion: Motion, tuning: Tuning, p_known: FloatArray | None,
) -> FloatArray:  # fmt: skip
    """(n,) the probability that reports are of stationary objects, given the previous ones of their tracks.

    p_alone : (n,) that by each report alone, for the first of a track and those after one without a velocity. at_rest :
    (n, 4), (n, 4, 4) states and covariances of the reports if stationary.
    """
    turns, previous = by_turn(reports, reports.usable), np.full(len(reports), ABSENT)
    for before, now in pairwise(turns):
        previous[now] = before[: len(now)]
    follows = (previous >= 0) & has_velocity & has_velocity[previous]
    log_p = np.zeros((4, len(reports)))
    log_p[:, follows] = _log_transitions(reports, previous[follows], np.flatnonzero(follows), at_rest, motion, tuning)
    p = p_alone.copy()
    for now in turns:
        some = now[follows[now]]
        with np.errstate(divide="ignore"):
            log_previous, log_not = np.log(p[previous[some]]), np.log1p(-p[previous[some]])
        log_stays, log_departs, log_arrives, log_moves = log_p[:, some]
        log_stationary = np.logaddexp(log_previous + log_stays, log_not + log_arrives)
        p[some] = expit(log_stationary - np.logaddexp(log_previous + log_departs, log_not + log_moves))
        if p_known is not None:
            p[now] = np.where(np.isnan(p_known[now]), p[now], p_known[now])
    return p


def _log_transitions(
    reports: States, previous: IntArray, now: IntArray, at_rest: tuple[FloatArray, FloatArray], motion: Motion,
    tuning: Tuning,
) -> FloatArray:  # fmt: skip
    """(4, k) ln of the joint probability of each case, staying, departing, arriving and moving on, and of the reports
    ``now``, given the previous ones and the state of the object then."""
    slow, speed, share = motion.stationary_m_per_s, motion.speed_m_per_s, motion.stationary_share
    assert slow and speed and share
    dt = reports.time_s[now] - reports.time_s[previous]
    measured, errors = reports.state[now], reports.covariance[now] + MIN_VARIANCE * np.eye(4)
    moving, p_moving = moved(
        reports.state[previous], reports.covariance[previous], dt, motion.acceleration_m2_per_s3 or 0.0
    )
    resting, rests = np.zeros_like(moving), np.zeros_like(p_moving)
    resting[:, :2], rests[:, :2, :2] = at_rest[0][previous, :2], at_rest[1][previous, :2, :2]
    half_way = 0.5 * dt[:, None] * reports.state[previous, 2:]
    arrived, arrives = np.zeros_like(moving), np.zeros_like(p_moving)
    arrived[:, :2] = moving[:, :2] - half_way
    arrives[:, :2, :2] = p_moving[:, :2, :2] + half_way[:, :, None] * half_way[:, None, :] / 3.0
    log_p = np.stack([
        log_density(measured - mean, covariance + errors)
        for mean, covariance in (
            (resting, rests + slow**2 * _of_velocity(dt, 1.0, 1.0)),
            (resting, rests + speed**2 * _of_velocity(dt, 1.0 / 3.0, 0.5)),
            (arrived, arrives + slow**2 * _of_velocity(dt, 0.0, 0.0)),
            (moving, p_moving),
        )
    ])  # fmt: skip
    # Probabilities of a change in between.
    changes = -np.expm1(-dt / (tuning.rest_s * (1.0 - share)))
    p_departs, p_arrives = (1.0 - share) * changes, share * changes
    with np.errstate(divide="ignore"):
        out = log_p + np.log([1.0 - p_departs, p_departs, p_arrives, 1.0 - p_arrives])
    # A second report of one time is no further evidence.
    return np.where(dt > 0.0, out, np.array([0.0, -np.inf, -np.inf, 0.0])[:, None])


def _of_velocity(dt: FloatArray, path: float, both: float) -> FloatArray:
    """(k, 4, 4) covariance of a velocity of 0 ± 1 per axis and of the displacement by it: Δt² times ``path`` of the
    displacement, Δt times ``both`` of it and the velocity."""
    out = np.zeros((len(dt), 4, 4))
    for axis in range(2):
        out[:, axis, axis], out[:, axis + 2, axis + 2] = path * dt**2, 1.0
        out[:, axis, axis + 2] = out[:, axis + 2, axis] = both * dt
    return out

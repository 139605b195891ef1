"""Compiled loop over the reports of tracks: the modes of motion of their objects (:mod:`sameas.tracks.stationary`)."""

from __future__ import annotations

import math

import numpy as np

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.kernels.compiled import part, small_by
from sameas.kernels.kalman import inverse_root, state_moved
from sameas.kernels.linear import positive_2, solve_2

#: ln of the least weight of a mode from which others are predicted.
LEAST = -40.0
#: Half the χ² of a reported velocity beyond which no object has just come into a mode slower than the last one.
FAR = 46.0
LOG_2PI = math.log(2.0 * math.pi)


def _work(rows: IntArray, begins: BoolArray, given: BoolArray, *_: object) -> float:
    # Each report is predicted from up to 23 pairs of modes by matrices of 16 elements: 0.6 ms if interpreted.
    return 600.0 * (len(rows) - given.sum() - 0.9 * begins.sum())


@small_by(_work)
def filter_modes(
    rows: IntArray, begins: BoolArray, given: BoolArray, time_s: FloatArray, state: FloatArray, covariance: FloatArray,
    speed: FloatArray, walk: FloatArray, share: FloatArray, exchange_s: float, log_weight: FloatArray,
    mean: FloatArray, spread: FloatArray,
) -> None:  # fmt: skip
    """Write ln of the probability of each of M modes of motion, and the state of its object in that mode, by all
    reports of its track so far: ``log_weight`` (n, M), ``mean`` (n, M, 4), ``spread`` (n, M, 4, 4).

    rows : (k,) reports by track and time. begins : (k,) whether one is the first of its track. given : (k,) whether its
    modes are known, and read. time_s, state, covariance : (n,), (n, 4), (n, 4, 4) of all reports.
    speed, share : (M,) 1σ per axis of the velocity, m/s, and share of objects, of each mode. walk : (M,) m²/s³, random
    walk of the velocity; negative in modes at rest, whose velocity is new at each report. exchange_s : mean time after
    which the mode is drawn anew.
    """
    modes = len(speed)
    x, p, half_way = np.empty(4), np.empty((4, 4)), np.empty((4, 4))
    total, root, crossed = np.empty((4, 4)), np.empty((4, 4)), np.empty((4, 4))
    log_case, means, spreads = np.empty((modes, modes)), np.empty((modes, modes, 4)), np.empty((modes, modes, 4, 4))
    for at in range(len(rows)):
        row, last = rows[at], rows[at - 1]
        z, error = state[row], covariance[row]
        if given[at]:
            continue
        if begins[at]:
            for j in range(modes):
                log_p = _with_velocity(z, error, speed[j], mean[row, j], spread[row, j])
                log_weight[row, j] = math.log(share[j]) + log_p
            _normalise(log_weight[row])
            continue
        dt = time_s[row] - time_s[last]
        if not dt > 0.0:
            # A second report of one time is no further evidence.
            _repeat(log_weight, mean, spread, last, row)
            continue
        p_change = -math.expm1(-dt / exchange_s)
        for i in range(modes):
            for j in range(modes):
                log_case[i, j] = -math.inf
            if log_weight[last, i] < LEAST:
                continue
            _half_way(mean[last, i], spread[last, i], dt, speed[i], walk[i], x, half_way)
            p_stays = 1.0
            for j in range(modes):
                if j == i or (walk[i] < 0.0 and walk[j] < 0.0):
                    continue
                p_stays -= p_change * share[j]
                if speed[j] < speed[modes - 1] and _half_chi_sq(z, error, speed[j]) > FAR:
                    continue
                _new_velocity(half_way, dt, speed[j], 1.0 / 3.0, 0.5, p)
                log_p = _updated(x, p, z, error, total, root, crossed, means[i, j], spreads[i, j])
                log_case[i, j] = log_weight[last, i] + math.log(p_change * share[j]) + log_p
            _predict(mean[last, i], spread[last, i], dt, speed[i], walk[i], x, p)
            log_p = _updated(x, p, z, error, total, root, crossed, means[i, i], spreads[i, i])
            log_case[i, i] = log_weight[last, i] + math.log(p_stays) + log_p
        for j in range(modes):
            log_weight[row, j] = _merged(log_case[:, j], means[:, j], spreads[:, j], mean[row, j], spread[row, j])
        _normalise(log_weight[row])


@part
def _half_chi_sq(state: FloatArray, covariance: FloatArray, speed: float) -> float:
    """A lower bound of half the χ² of the velocity of a state, if it is 0 ± ``speed``."""
    square = state[2] * state[2] + state[3] * state[3]
    return 0.5 * square / (speed * speed + covariance[2, 2] + covariance[3, 3])


@part
def _repeat(log_weight: FloatArray, mean: FloatArray, spread: FloatArray, last: int, row: int) -> None:
    """Copy the modes of the report ``last`` to ``row``; in loops, since whole arrays take seconds to compile."""
    for j in range(log_weight.shape[1]):
        log_weight[row, j] = log_weight[last, j]
        for v in range(4):
            mean[row, j, v] = mean[last, j, v]
            for w in range(4):
                spread[row, j, v, w] = spread[last, j, v, w]


@part
def _predict(
    mean: FloatArray, spread: FloatArray, dt: float, speed: float, walk: float, x: FloatArray, p: FloatArray
) -> None:
    """Write the state x ± P of an object ``dt`` seconds later that stays in its mode; at rest if ``walk`` < 0."""
    if walk < 0.0:
        x[0], x[1], x[2], x[3] = mean[0], mean[1], 0.0, 0.0
        _new_velocity(spread, dt, speed, 1.0, 1.0, p)
    else:
        state_moved(mean, spread, dt, walk, x, p)


@part
def _half_way(
    mean: FloatArray, spread: FloatArray, dt: float, speed: float, walk: float, x: FloatArray, p: FloatArray
) -> None:
    """Write the position of an object at the end of its mode, uniformly distributed within ``dt`` seconds, as a state
    ``x`` (4,) of velocity 0, and its covariance, the first components of ``p`` (4, 4)."""
    third = dt * dt / 3.0
    for v in range(2):
        x[v], x[2 + v] = mean[v], 0.0
        for w in range(2):
            p[v, w] = spread[v, w]
            if walk >= 0.0:
                p[v, w] += 0.5 * dt * (spread[v, 2 + w] + spread[2 + v, w])
                p[v, w] += third * (spread[2 + v, 2 + w] + 0.25 * mean[2 + v] * mean[2 + w])
        if walk >= 0.0:
            x[v] += 0.5 * dt * mean[2 + v]
        p[v, v] += third * (speed * speed if walk < 0.0 else 0.25 * walk * dt)


@part
def _new_velocity(place: FloatArray, dt: float, speed: float, path: float, both: float, p: FloatArray) -> None:
    """Write the covariance ``p`` (4, 4) of the state of an object at ``place`` ((2, 2) or larger, its covariance) that
    has a velocity of 0 ± ``speed``; the variance of its displacement is ``path`` times that over all of ``dt``, its
    covariance with the velocity ``both`` times."""
    variance = speed * speed
    for v in range(2):
        for w in range(2):
            p[v, w], p[v, 2 + w], p[2 + v, w], p[2 + v, 2 + w] = place[v, w], 0.0, 0.0, 0.0
    for v in range(2):
        p[v, v] += path * variance * dt * dt
        p[v, 2 + v] = p[2 + v, v] = both * variance * dt
        p[2 + v, 2 + v] = variance


@part
def _log_sum(log_weight: FloatArray) -> float:
    """ln of the sum of weights given as logarithms."""
    top = -math.inf
    for value in log_weight:
        top = max(top, value)
    if top == -math.inf:
        return top
    total = 0.0
    for value in log_weight:
        total += math.exp(value - top)
    return top + math.log(total)


@part
def _normalise(log_weight: FloatArray) -> None:
    """Normalise weights (M,), given as logarithms."""
    log_total = _log_sum(log_weight)
    for j in range(len(log_weight)):
        log_weight[j] -= log_total


@part
def _with_velocity(
    state: FloatArray, covariance: FloatArray, speed: float, mean: FloatArray, spread: FloatArray
) -> float:
    """Write the state given that its velocity is 0 ± ``speed``, and return ln of that velocity's density."""
    variance = speed * speed
    a, c = covariance[2, 2] + variance, covariance[3, 3] + variance
    a, b, c, determinant = positive_2(a, 0.5 * (covariance[2, 3] + covariance[3, 2]), c)
    x, y = solve_2(a, b, c, determinant, -state[2], -state[3])
    for v in range(4):
        mean[v] = state[v] + covariance[v, 2] * x + covariance[v, 3] * y
        one, other = solve_2(a, b, c, determinant, covariance[v, 2], covariance[v, 3])
        for w in range(4):
            spread[v, w] = covariance[v, w] - one * covariance[w, 2] - other * covariance[w, 3]
    return 0.5 * (state[2] * x + state[3] * y - math.log(determinant)) - LOG_2PI


@part
def _updated(
    x: FloatArray, p: FloatArray, state: FloatArray, covariance: FloatArray, total: FloatArray, root: FloatArray,
    crossed: FloatArray, mean: FloatArray, spread: FloatArray,
) -> float:  # fmt: skip
    """Write the Kalman update of a state x ± P (4,), (4, 4) by a report of all of it, and return ln p of the report.

    total, root, crossed : scratch (4, 4).
    """
    for v in range(4):
        for w in range(v + 1):
            total[v, w] = p[v, w] + 0.5 * (covariance[v, w] + covariance[w, v])
    inverse_root(total, root)
    log_p = -2.0 * LOG_2PI
    for v in range(4):
        mean[v] = x[v]
    for k in range(4):
        residual = 0.0
        for v in range(k + 1):
            residual += root[k, v] * (state[v] - x[v])
        log_p += math.log(root[k, k]) - 0.5 * residual * residual
        for w in range(4):
            value = 0.0
            for v in range(k + 1):
                value += root[k, v] * p[v, w]
            crossed[k, w] = value
            mean[w] += value * residual
    for v in range(4):
        for w in range(v + 1):
            value = p[v, w]
            for k in range(4):
                value -= crossed[k, v] * crossed[k, w]
            spread[v, w] = spread[w, v] = value
    return log_p


@part
def _merged(
    log_case: FloatArray, means: FloatArray, spreads: FloatArray, mean: FloatArray, spread: FloatArray
) -> float:
    """Write the mean (4,) and covariance (4, 4) of a mixture of M Gaussians, and return ln of their whole weight."""
    log_total = _log_sum(log_case)
    for v in range(4):
        mean[v] = 0.0
        for w in range(4):
            spread[v, w] = 0.0
    for i in range(len(log_case)):
        if log_case[i] - log_total > LEAST:
            for v in range(4):
                mean[v] += math.exp(log_case[i] - log_total) * means[i, v]
    for i in range(len(log_case)):
        if log_case[i] - log_total > LEAST:
            weight = math.exp(log_case[i] - log_total)
            for v in range(4):
                for w in range(v + 1):
                    apart = (means[i, v] - mean[v]) * (means[i, w] - mean[w])
                    spread[v, w] += weight * (spreads[i, v, w] + apart)
    for v in range(4):
        for w in range(v):
            spread[w, v] = spread[v, w]
    return log_total

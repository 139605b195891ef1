"""Compiled prediction of states and of named tracks to the next instant (:mod:`sameas.tracks.alignment`,
:mod:`sameas.picture.named_tracks`)."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from sameas.arrays import FloatArray, IntArray
from sameas.kernels.compiled import part, small_by
from sameas.kernels.linear import solve_2


def _work(rows: IntArray | FloatArray, *_: Any) -> float:
    # Two covariances of 16 elements for each row, each used several times.
    return 100.0 * len(rows)


@small_by(_work)
def states_moved(
    state: FloatArray, covariance: FloatArray, dt: FloatArray, walk: FloatArray, late_s: float, predicted: FloatArray,
    predicted_covariance: FloatArray,
) -> None:  # fmt: skip
    """Write states (n, 4) and covariances (n, 4, 4) after ``dt`` (n,) seconds, to the last bit as the NumPy branch of
    :func:`sameas.tracks.alignment.moved`.

    walk : (n,) m²/s³, random walk of the velocities. late_s : 1σ of the time stamps, 0 for exact ones.
    """
    cross = np.empty((2, 2))
    for k in range(len(state)):
        t, p, x, out = dt[k], covariance[k], predicted[k], predicted_covariance[k]
        size = abs(t)
        for v in range(2):
            x[v], x[2 + v] = state[k, v] + t * state[k, 2 + v], state[k, 2 + v]
            for w in range(2):
                cross[v, w] = p[v, 2 + w] + t * p[2 + v, 2 + w]
                out[v, 2 + w] = out[2 + w, v] = cross[v, w]
                out[2 + v, 2 + w] = 0.5 * (p[2 + v, 2 + w] + p[2 + w, 2 + v])
        for v in range(2):
            for w in range(2):
                one, other = p[v, w] + t * (p[2 + v, w] + cross[v, w]), p[w, v] + t * (p[2 + w, v] + cross[w, v])
                out[v, w] = 0.5 * (one + other)
        # Q of :func:`sameas.tracks.alignment.process_noise`, by axis.
        q_position, q_cross, q_speed = walk[k] * (size * size * size) / 3.0, walk[k] * t * size / 2.0, walk[k] * size
        for v in range(2):
            out[v, v] += q_position
            out[v, 2 + v] += q_cross
            out[2 + v, v] += q_cross
            out[2 + v, 2 + v] += q_speed
        if late_s != 0.0:
            for v in range(2):
                for w in range(2):
                    out[v, w] += late_s * late_s * (x[2 + v] * x[2 + w] + out[2 + v, 2 + w])


@small_by(_work)
def tracks_moved(
    last: IntArray, state: FloatArray, covariance: FloatArray, walk: FloatArray, late_s: FloatArray, dt: FloatArray,
    manoeuvre: FloatArray, previous: FloatArray, place: FloatArray, old: FloatArray, drift: FloatArray,
) -> None:  # fmt: skip
    """Write the last reports of tracks predicted to the instant: ``place`` (m, 2), its covariance ``old`` (m, 2, 2),
    and ``drift`` (m, 2, 2), the growth of that covariance since the previous instant.

    last : (m,) rows of the reports. state, covariance, walk, late_s, previous : (n, 4), (n, 4, 4), (n,), (n,),
    (n, 4, 4) of all reports: state, covariance, random walk of the velocity, 1σ of the time stamps, covariance at the
    previous instant. dt : (m,) seconds since the reports. manoeuvre : (m, 4, 4) covariance of a manoeuvre.
    """
    growth = np.empty((2, 2))
    for k in range(len(last)):
        r, t = last[k], dt[k]
        x, p = state[r], covariance[r]
        for v in range(2):
            place[k, v] = x[v] + t * x[2 + v]
        for v in range(2):
            for w in range(v + 1):
                # The covariance of the velocity grows by the random walk only, which is along the axes.
                speed = 0.5 * (p[2 + v, 2 + w] + p[2 + w, 2 + v])
                cross = 0.5 * (p[v, 2 + w] + p[2 + w, v] + p[w, 2 + v] + p[2 + v, w])
                value = 0.5 * (p[v, w] + p[w, v]) + t * cross + t * t * speed
                q_speed = 0.0
                if v == w:
                    value += walk[r] * abs(t) * t * t / 3.0
                    q_speed = walk[r] * abs(t)
                value += late_s[r] * late_s[r] * (x[2 + v] * x[2 + w] + speed + q_speed)
                old[k, v, w] = old[k, w, v] = value + 0.5 * (manoeuvre[k, v, w] + manoeuvre[k, w, v])
        for v in range(2):
            for w in range(2):
                growth[v, w] = old[k, v, w] - previous[r, v, w]
        _positive_part(growth, drift[k])


@small_by(_work)
def ways_of_tracks(
    last: IntArray, now: IntArray, reported_last: FloatArray, reported: FloatArray, old: FloatArray, new: FloatArray,
    root_last: FloatArray, root: FloatArray, motion: FloatArray,
) -> None:  # fmt: skip
    """Write the Cholesky factors L, L′ of the position covariances of each track's last and new report, and its motion.

    last, now : (m,) rows of the last and the new reports. reported_last, reported : (n, 4, 4) covariances R, R′. old,
    new : (m, 2, 2) both covariances at the instant. root_last, root, motion : (m, 2, 2) L, L′, and D, the positive part
    of old + new − R − R′.
    """
    growth = np.empty((2, 2))
    for k in range(len(last)):
        one, other = reported_last[last[k]], reported[now[k]]
        _cholesky_2(one, root_last[k])
        _cholesky_2(other, root[k])
        for v in range(2):
            for w in range(2):
                growth[v, w] = old[k, v, w] + new[k, v, w] - one[v, w] - other[v, w]
        _positive_part(growth, motion[k])


@small_by(_work)
def errors_forgotten(
    root_last: FloatArray, root: FloatArray, old: FloatArray, new: FloatArray, share: FloatArray,
    decaying: FloatArray, slope: FloatArray, noise: FloatArray,
) -> None:  # fmt: skip
    """Write H (m, 2, 4) and the covariance (m, 2, 2) of n in ν = H (e, z) + n (:mod:`sameas.picture.named_tracks`).

    root_last, root : (m, 2, 2) L, L′. old, new : (m, 2, 2) P before and after the report. share : (m,) s, the constant
    part of the error variance. decaying : (m,) ρ (1 − s).
    """
    common, rest, gain = np.empty((2, 2)), np.empty((2, 2)), np.empty((2, 2))
    for k in range(len(share)):
        one, other, s = root_last[k], root[k], math.sqrt(share[k])
        for v in range(2):
            for w in range(2):
                common[v, w] = decaying[k] * (one[v, 0] * other[w, 0] + one[v, 1] * other[w, 1])
                rest[v, w] = old[k, v, w] - share[k] * (one[v, 0] * one[w, 0] + one[v, 1] * one[w, 1])
        a, b, c = rest[0, 0], 0.5 * (rest[0, 1] + rest[1, 0]), rest[1, 1]
        determinant = a * c - b * b
        for v in range(2):
            gain[v, 0], gain[v, 1] = solve_2(a, b, c, determinant, common[0, v], common[1, v])
        for v in range(2):
            for w in range(2):
                slope[k, v, w] = gain[v, w] - (1.0 if v == w else 0.0)
                slope[k, v, 2 + w] = s * (other[v, w] - gain[v, 0] * one[0, w] - gain[v, 1] * one[1, w])
                constant = share[k] * (other[v, 0] * other[w, 0] + other[v, 1] * other[w, 1])
                noise[k, v, w] = new[k, v, w] - constant - gain[v, 0] * common[0, w] - gain[v, 1] * common[1, w]


@part
def _cholesky_2(covariance: FloatArray, root: FloatArray) -> None:
    """Write the lower Cholesky factor L (2, 2) of the position's part of a covariance."""
    root[0, 0] = math.sqrt(covariance[0, 0])
    root[1, 0] = covariance[1, 0] / root[0, 0]
    root[1, 1] = math.sqrt(covariance[1, 1] - root[1, 0] * root[1, 0])
    root[0, 1] = 0.0


@part
def _positive_part(change: FloatArray, out: FloatArray) -> None:
    """Write the positive semidefinite part (2, 2) of a change of a covariance."""
    mean = 0.5 * (change[0, 0] + change[1, 1])
    half, cross = 0.5 * (change[0, 0] - change[1, 1]), 0.5 * (change[0, 1] + change[1, 0])
    radius = math.sqrt(half * half + cross * cross)
    # The eigenvalues are m ± r, with projections ½ [1 ± D / r], D = change − m.
    high, low = max(mean + radius, 0.0), max(mean - radius, 0.0)
    level, slope = 0.5 * (high + low), 0.5 * (high - low) / (radius if radius > 0.0 else 1.0)
    out[0, 0], out[1, 1] = level + slope * half, level - slope * half
    out[0, 1] = out[1, 0] = slope * cross

"""Compiled loops over states and named tracks from one instant to the next (:mod:`sameas.tracks.alignment`,
:mod:`sameas.picture.named_tracks`)."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from sameas.arrays import FloatArray, IntArray
from sameas.kernels.compiled import part, small_by


def _work(was: IntArray | FloatArray, *_: Any) -> float:
    # Two covariances of sixteen elements, each of which is used some times.
    return 100.0 * len(was)


@small_by(_work)
def states_moved(
    state: FloatArray, covariance: FloatArray, dt: FloatArray, walk: FloatArray, late_s: float, there: FloatArray,
    out: FloatArray,
) -> None:  # fmt: skip
    """Writes states and covariances (n, 4), (n, 4, 4) after ``dt`` (n,) seconds, as
    :func:`sameas.tracks.alignment.moved` gives them to the last bit.

    walk : (n,) of their velocities. late_s : 1σ of their stamps, 0 for none.
    """
    crossed = np.empty((2, 2))
    for k in range(len(state)):
        t, p, to = dt[k], covariance[k], out[k]
        size = abs(t)
        for v in range(2):
            there[k, v], there[k, 2 + v] = state[k, v] + t * state[k, 2 + v], state[k, 2 + v]
            for w in range(2):
                crossed[v, w] = p[v, 2 + w] + t * p[2 + v, 2 + w]
                to[v, 2 + w] = to[2 + w, v] = crossed[v, w]
                to[2 + v, 2 + w] = 0.5 * (p[2 + v, 2 + w] + p[2 + w, 2 + v])
        for v in range(2):
            for w in range(2):
                one, other = p[v, w] + t * (p[2 + v, w] + crossed[v, w]), p[w, v] + t * (p[2 + w, v] + crossed[w, v])
                to[v, w] = 0.5 * (one + other)
        place, cross, speed = walk[k] * (size * size * size) / 3.0, walk[k] * t * size / 2.0, walk[k] * size
        for v in range(2):
            to[v, v] += place
            to[v, 2 + v] += cross
            to[2 + v, v] += cross
            to[2 + v, 2 + v] += speed
        if late_s != 0.0:
            for v in range(2):
                for w in range(2):
                    to[v, w] += late_s * late_s * (there[k, 2 + v] * there[k, 2 + w] + to[2 + v, 2 + w])


@small_by(_work)
def tracks_moved(
    was: IntArray, state: FloatArray, covariance: FloatArray, walk: FloatArray, late_s: FloatArray, dt: FloatArray,
    left: FloatArray, before: FloatArray, place: FloatArray, old: FloatArray, drift: FloatArray,
) -> None:  # fmt: skip
    """Writes the last reports of tracks, moved to the instant: ``place`` (m, 2), its covariance ``old`` (m, 2, 2), and
    ``drift`` (m, 2, 2), by which that grew since the instant before.

    was : (m,) rows of the reports. state, covariance, walk, late_s, before : (n, 4), (n, 4, 4), (n,), (n,), (n, 4, 4)
    reported, how their objects move, 1σ of their stamps, and the covariance at the instant before. dt : (m,) seconds
    since. left : (m, 4, 4) the covariance of a manoeuvre.
    """
    growth = np.empty((2, 2))
    for k in range(len(was)):
        r, t = was[k], dt[k]
        x, p = state[r], covariance[r]
        for v in range(2):
            place[k, v] = x[v] + t * x[2 + v]
        for v in range(2):
            for w in range(v + 1):
                # The covariance of velocities stays, but for the walk, which is along the axes.
                speeds = 0.5 * (p[2 + v, 2 + w] + p[2 + w, 2 + v])
                crossed = 0.5 * (p[v, 2 + w] + p[2 + w, v] + p[w, 2 + v] + p[2 + v, w])
                value = 0.5 * (p[v, w] + p[w, v]) + t * crossed + t * t * speeds
                walked = 0.0
                if v == w:
                    value += walk[r] * abs(t) * t * t / 3.0
                    walked = walk[r] * abs(t)
                value += late_s[r] * late_s[r] * (x[2 + v] * x[2 + w] + speeds + walked)
                old[k, v, w] = old[k, w, v] = value + 0.5 * (left[k, v, w] + left[k, w, v])
        for v in range(2):
            for w in range(2):
                growth[v, w] = old[k, v, w] - before[r, v, w]
        _positive(growth, drift[k])


@small_by(_work)
def ways_of_tracks(
    was: IntArray, now: IntArray, reported_before: FloatArray, reported: FloatArray, old: FloatArray, new: FloatArray,
    root_before: FloatArray, root: FloatArray, motion: FloatArray,
) -> None:  # fmt: skip
    """Writes of two reports of every track the roots of their covariances R = L Lᵀ, and the motion between them.

    was, now : (m,) rows of the reports before and now. reported_before, reported : (n, 4, 4) R. old, new : (m, 2, 2)
    covariances at the instant. root_before, root, motion : (m, 2, 2) L, L′, and D, the positive part of what both
    covariances at the instant are more than R + R′.
    """
    growth = np.empty((2, 2))
    for k in range(len(was)):
        one, other = reported_before[was[k]], reported[now[k]]
        _root(one, root_before[k])
        _root(other, root[k])
        for v in range(2):
            for w in range(2):
                growth[v, w] = old[k, v, w] + new[k, v, w] - one[v, w] - other[v, w]
        _positive(growth, motion[k])


@small_by(_work)
def errors_forgotten(
    root_before: FloatArray, root: FloatArray, old: FloatArray, new: FloatArray, share: FloatArray,
    forgotten: FloatArray, slope: FloatArray, noise: FloatArray,
) -> None:  # fmt: skip
    """Writes H (m, 2, 4) and the covariance (m, 2, 2) of n in ν = H (e, z) + n (:mod:`sameas.picture.named_tracks`).

    root_before, root : (m, 2, 2) L, L′. old, new : (m, 2, 2) P before and after the report. share : (m,) s. forgotten :
    (m,) ρ (1 − s).
    """
    common, left, gain = np.empty((2, 2)), np.empty((2, 2)), np.empty((2, 2))
    for k in range(len(share)):
        one, other, s = root_before[k], root[k], math.sqrt(share[k])
        for v in range(2):
            for w in range(2):
                common[v, w] = forgotten[k] * (one[v, 0] * other[w, 0] + one[v, 1] * other[w, 1])
                left[v, w] = old[k, v, w] - share[k] * (one[v, 0] * one[w, 0] + one[v, 1] * one[w, 1])
        a, b, c = left[0, 0], 0.5 * (left[0, 1] + left[1, 0]), left[1, 1]
        determinant = a * c - b * b
        for v in range(2):
            gain[v, 0] = (common[0, v] * c - common[1, v] * b) / determinant
            gain[v, 1] = (common[1, v] * a - common[0, v] * b) / determinant
        for v in range(2):
            for w in range(2):
                slope[k, v, w] = gain[v, w] - (1.0 if v == w else 0.0)
                slope[k, v, 2 + w] = s * (other[v, w] - gain[v, 0] * one[0, w] - gain[v, 1] * one[1, w])
                stays = share[k] * (other[v, 0] * other[w, 0] + other[v, 1] * other[w, 1])
                noise[k, v, w] = new[k, v, w] - stays - gain[v, 0] * common[0, w] - gain[v, 1] * common[1, w]


@part
def _root(covariance: FloatArray, root: FloatArray) -> None:
    """Writes L (2, 2) of the covariance of a position."""
    root[0, 0] = math.sqrt(covariance[0, 0])
    root[1, 0] = covariance[1, 0] / root[0, 0]
    root[1, 1] = math.sqrt(covariance[1, 1] - root[1, 0] * root[1, 0])
    root[0, 1] = 0.0


@part
def _positive(change: FloatArray, out: FloatArray) -> None:
    """Writes the positive part (2, 2) of a change of a covariance."""
    mean = 0.5 * (change[0, 0] + change[1, 1])
    half, cross = 0.5 * (change[0, 0] - change[1, 1]), 0.5 * (change[0, 1] + change[1, 0])
    radius = math.sqrt(half * half + cross * cross)
    # Eigenvalues are m ± r; the part of m + r is ½ [1 + D / r] of it, D the change without its mean.
    high, low = max(mean + radius, 0.0), max(mean - radius, 0.0)
    level, slope = 0.5 * (high + low), 0.5 * (high - low) / (radius if radius > 0.0 else 1.0)
    out[0, 0], out[1, 1] = level + slope * half, level - slope * half
    out[0, 1] = out[1, 0] = slope * cross

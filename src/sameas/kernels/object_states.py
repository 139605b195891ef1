"""Compiled fusion of the states of objects from their records (:mod:`sameas.picture.object_table`)."""

from __future__ import annotations

from typing import Any

import numpy as np

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.kernels.compiled import part, small_by
from sameas.kernels.intersection import inverse_root, weigh

#: Information on the position of an object without position: of 1σ as wide as a plane, 1/m².
NO_POSITION = 1e-12


def _work(members: IntArray, *_: Any) -> float:
    # A record's covariance has 16 elements, each used some dozens of times.
    return 500.0 * members.size


@small_by(_work)
def sum_of_records(
    members: IntArray, state: FloatArray, covariance: FloatArray, placed: BoolArray, moving: BoolArray,
    smoothed: BoolArray, speed: FloatArray, steps: int, optimal: float, halvings: int, mean: FloatArray,
    spread: FloatArray, has_place: BoolArray, has_velocity: BoolArray,
) -> None:  # fmt: skip
    """Write states (n, 4) and covariances (n, 4, 4) of objects, and whether they have a position and a velocity.

    members : (n, S) records, −1 for none. state … speed : (r, …) of all records. placed, moving : whether a position
    and a velocity are reported. smoothed : records that are first fused by covariance intersection
    (:func:`sameas.kernels.intersection.weigh`). speed : 1σ of an unreported velocity on each axis.
    """
    n, most = members.shape
    information, weights, own = np.zeros((most, 4, 4)), np.ones(most), np.empty(most, np.int64)
    total, root, vector, offset = np.empty((4, 4)), np.empty((4, 4)), np.empty(4), np.empty(4)
    intersected, shares = np.empty((most, 4, 4)), np.empty(most)
    for k in range(n):
        count = n_intersected = 0
        slowest = 0.0
        has_place[k] = has_velocity[k] = False
        for record in members[k]:
            if record < 0 or not placed[record]:
                continue
            _information(covariance[record], moving[record], total, root, information[count])
            own[count], weights[count] = record, 1.0
            if smoothed[record]:
                intersected[n_intersected] = information[count]
                n_intersected += 1
            has_place[k], has_velocity[k] = True, has_velocity[k] or moving[record]
            slowest = max(slowest, speed[record])
            count += 1
        if n_intersected > 1:
            weigh(intersected[:n_intersected], steps, optimal, halvings, shares[:n_intersected])
            at = 0
            for m in range(count):
                if smoothed[own[m]]:
                    weights[m] = shares[at]
                    at += 1
        total[:], vector[:] = 0.0, 0.0
        for m in range(count):
            # Relative to the first record, so that large coordinates do not lose digits.
            for v in range(4):
                offset[v] = state[own[m], v] - (state[own[0], v] if v < 2 else 0.0)
            for v in range(4):
                for w in range(4):
                    value = weights[m] * information[m, v, w]
                    total[v, w] += value
                    vector[v] += value * offset[w]
        if not has_velocity[k]:
            total[2, 2] += 1.0 / max(slowest, 1.0) ** 2
            total[3, 3] += 1.0 / max(slowest, 1.0) ** 2
        if not has_place[k]:
            total[0, 0] = total[1, 1] = NO_POSITION
        _inverse(total, root, spread[k])
        for v in range(4):
            mean[k, v] = state[own[0], v] if v < 2 and has_place[k] else 0.0
            for w in range(4):
                mean[k, v] += spread[k, v, w] * vector[w]


@part
def _information(covariance: FloatArray, moving: bool, copy: FloatArray, root: FloatArray, out: FloatArray) -> None:
    """Write the information (4, 4) of a record, 0 on a velocity that is not reported. copy, root : scratch."""
    if moving:
        copy[:] = covariance
        _inverse(copy, root, out)
        return
    out[:] = 0.0
    a, b, c = covariance[0, 0], 0.5 * (covariance[0, 1] + covariance[1, 0]), covariance[1, 1]
    determinant = a * c - b * b
    out[0, 0], out[1, 1] = c / determinant, a / determinant
    out[0, 1] = out[1, 0] = -b / determinant


@part
def _inverse(matrix: FloatArray, root: FloatArray, out: FloatArray) -> None:
    """Write the inverse of a positive definite matrix, which is overwritten. root : scratch."""
    inverse_root(matrix, root)
    for v in range(len(matrix)):
        for w in range(v + 1):
            value = 0.0
            for c in range(v, len(matrix)):
                value += root[c, v] * root[c, w]
            out[v, w] = out[w, v] = value

"""Compiled fusion of states by covariance intersection (:mod:`sameas.many.fusion`), and of the states of objects from
their records (:mod:`sameas.picture.object_table`)."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.kernels.compiled import part, small_by

#: Jacobi's method: most sweeps, and the sum of squares off the diagonal, relative to that on it, at convergence.
SWEEPS, OFF_DIAGONAL = 30, 1e-30
#: A larger slope is positive in spite of rounding.
CERTAIN = 1e-6
#: Information on the position of an object without position: of 1σ as wide as a plane, 1/m².
NO_POSITION = 1e-12


def _work(information: FloatArray, *_: Any) -> float:
    # Each element of a matrix is used some dozens of times.
    return 30.0 * information.size


@small_by(_work)
def weights_of_least_determinant(
    information: FloatArray, steps: int, optimal: float, halvings: int, weights: FloatArray
) -> None:
    """Write the weights (n, k) of n objects of k estimates that maximise |Σ w I|, I their information (n, k, d, d).

    By vertex exchange: the estimate of largest slope tr(I (Σ w I)⁻¹) takes the best amount of the weight of that of
    smallest slope, until no slope exceeds d by more than the relative ``optimal``, or for ``steps`` iterations.
    """
    for row in range(len(information)):
        weigh(information[row], steps, optimal, halvings, weights[row])


@part
def weigh(information: FloatArray, steps: int, optimal: float, halvings: int, w: FloatArray) -> None:
    """Write the weights w (k,) of the estimates of one object, from their information (k, d, d)."""
    k, d, _ = information.shape
    total, root, half, change = np.empty((d, d)), np.empty((d, d)), np.empty((d, d)), np.empty((d, d))
    slope = np.empty(k)
    w[:] = 1.0 / k
    for _ in range(steps):
        total[:] = 0.0
        for one in range(k):
            for a in range(d):
                for b in range(a + 1):
                    total[a, b] += w[one] * information[one, a, b]
        inverse_root(total, root)
        to, off = 0, -1  # estimates of largest and of smallest slope
        for one in range(k):
            # tr(L⁻¹ I L⁻ᵀ)
            slope[one] = 0.0
            for a in range(d):
                for b in range(a + 1):
                    value = 0.0
                    for c in range(a + 1):
                        value += root[a, c] * information[one, c, b]
                    slope[one] += value * root[a, b]
            slope[one] /= d
            if slope[one] > slope[to]:
                to = one
            if w[one] > 0.0 and (off < 0 or slope[one] < slope[off]):
                off = one
        if not slope[to] > 1.0 + optimal:
            break
        for a in range(d):
            for b in range(d):
                half[a, b] = 0.0
                for c in range(a + 1):
                    half[a, b] += root[a, c] * (information[to, c, b] - information[off, c, b])
        for a in range(d):
            for b in range(a + 1):
                value = 0.0
                for c in range(b + 1):
                    value += half[a, c] * root[b, c]
                change[a, b] = change[b, a] = value
        # In most cases one estimate takes all the weight of the other, which needs no eigenvalues to see.
        step = w[off]
        if not _slope_at(change, step, total, root) > CERTAIN:
            _to_eigenvalues(change)
            step = _best_exchange(change, w[off], halvings)
        w[to] += step
        w[off] -= step
        total_weight = 0.0
        for one in range(k):
            total_weight += w[one]
        for one in range(k):
            w[one] /= total_weight


@part
def inverse_root(matrix: FloatArray, inverse: FloatArray) -> None:
    """Write L⁻¹ of a matrix L Lᵀ, whose lower triangle is used and overwritten."""
    d = len(matrix)
    for a in range(d):
        for b in range(a + 1):
            value = matrix[a, b]
            for c in range(b):
                value -= matrix[a, c] * matrix[b, c]
            matrix[a, b] = math.sqrt(max(value, 1e-300)) if a == b else value / matrix[b, b]
    for b in range(d):
        inverse[b, b] = 1.0 / matrix[b, b]
        for a in range(b + 1, d):
            value = 0.0
            for c in range(b, a):
                value -= matrix[a, c] * inverse[c, b]
            inverse[a, b], inverse[b, a] = value / matrix[a, a], 0.0


@part
def _to_eigenvalues(matrix: FloatArray) -> None:
    """Rotate a symmetric matrix until its eigenvalues are on its diagonal (Jacobi)."""
    d = len(matrix)
    for _ in range(SWEEPS):
        off_diagonal, diagonal = 0.0, 0.0
        for a in range(d):
            diagonal += matrix[a, a] * matrix[a, a]
            for b in range(a):
                off_diagonal += matrix[a, b] * matrix[a, b]
        if off_diagonal <= OFF_DIAGONAL * diagonal:
            return
        for a in range(1, d):
            for b in range(a):
                if matrix[a, b] == 0.0:
                    continue
                theta = 0.5 * (matrix[a, a] - matrix[b, b]) / matrix[a, b]
                tangent = 1.0 / (abs(theta) + math.sqrt(theta * theta + 1.0))
                tangent = tangent if theta >= 0.0 else -tangent
                cosine = 1.0 / math.sqrt(tangent * tangent + 1.0)
                sine = tangent * cosine
                for c in range(d):
                    one, other = matrix[c, b], matrix[c, a]
                    matrix[c, b], matrix[c, a] = cosine * one - sine * other, sine * one + cosine * other
                for c in range(d):
                    one, other = matrix[b, c], matrix[a, c]
                    matrix[b, c], matrix[a, c] = cosine * one - sine * other, sine * one + cosine * other


@part
def _slope_at(change: FloatArray, most: float, whole: FloatArray, root: FloatArray) -> float:
    """The slope of ln|1 + δ D| at δ = ``most``: tr(D (1 + δ D)⁻¹), with D = ``change``. whole, root : scratch."""
    for a in range(len(change)):
        for b in range(a + 1):
            whole[a, b] = most * change[a, b] + (1.0 if a == b else 0.0)
    inverse_root(whole, root)
    slope = 0.0
    for c in range(len(change)):
        for a in range(c + 1):
            value = 0.0
            for b in range(c + 1):
                value += root[c, b] * change[b, a]
            slope += value * root[c, a]
    return slope


@part
def _best_exchange(change: FloatArray, most: float, halvings: int) -> float:
    """The δ in 0 … ``most`` that maximises ln|1 + δ D|; the diagonal of ``change`` has the eigenvalues μ of D.

    The slope Σ μ/(1 + δ μ) decreases with δ. Its zero is found by bisection to 2^−halvings of ``most``; δ is ``most``
    if the slope is not negative there.
    """
    slope = 0.0
    for v in range(len(change)):
        slope += change[v, v] / max(1.0 + most * change[v, v], 1e-300)
    if slope >= 0.0:
        return most
    low, high = 0.0, most
    for _ in range(halvings):
        middle, slope = 0.5 * (low + high), 0.0
        for v in range(len(change)):
            slope += change[v, v] / (1.0 + middle * change[v, v])
        if slope > 0.0:
            low = middle
        else:
            high = middle
    return 0.5 * (low + high)


def _work_of_members(members: IntArray, *_: Any) -> float:
    # A record's covariance has 16 elements, each used some dozens of times.
    return 500.0 * members.size


@small_by(_work_of_members)
def sum_of_records(
    members: IntArray, state: FloatArray, covariance: FloatArray, placed: BoolArray, moving: BoolArray,
    smoothed: BoolArray, speed: FloatArray, steps: int, optimal: float, halvings: int, mean: FloatArray,
    spread: FloatArray, has_place: BoolArray, has_velocity: BoolArray,
) -> None:  # fmt: skip
    """Write states (n, 4) and covariances (n, 4, 4) of objects, and whether they have a position and a velocity.

    members : (n, S) records, −1 for none. state … speed : (r, …) of all records. placed, moving : whether a position
    and a velocity are reported. smoothed : records that are first fused by covariance intersection
    (:func:`weigh`). speed : 1σ of an unreported velocity on each axis.
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
        for v in range(4):
            for w in range(4):
                copy[v, w] = covariance[v, w]
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

"""Compiled search in a feature space: differences of the features, folded into half a period where they have one."""

from __future__ import annotations

import math

import numpy as np

from sameas.arrays import FloatArray, Int32Array, IntArray
from sameas.kernels.compiled import part, small
from sameas.kernels.order import Side
from sameas.kernels.spans import ROOM, Grid, Reach, folded, near, taken_back


@part
def add_spread(packed: FloatArray, k: int, at: int, d: int, out: FloatArray) -> None:
    """Add row k of a packed covariance, which begins in column ``at``, to ``out`` (d, d), lower triangle only."""
    p = packed.shape[1] - at
    if p <= d:
        for v in range(d):
            out[v, v] += packed[k, at if p == 1 else at + v]
        return
    for v in range(d):
        for w in range(v, d):
            out[w, v] += packed[k, at]
            at += 1


@part
def whitened(matrix: FloatArray, residual: FloatArray, solved: FloatArray) -> tuple[float, float]:
    """(Mahalanobis distance squared, determinant); the lower triangle of ``matrix`` becomes its Cholesky factor."""
    d = len(residual)
    distance = 0.0
    determinant = 1.0
    for v in range(d):
        for w in range(v):
            total = matrix[v, w]
            for t in range(w):
                total -= matrix[v, t] * matrix[w, t]
            matrix[v, w] = total / matrix[w, w]
        total = matrix[v, v]
        rest = residual[v]
        for t in range(v):
            total -= matrix[v, t] * matrix[v, t]
            rest -= matrix[v, t] * solved[t]
        root = math.sqrt(total) if total > 0.0 else 1e-150
        matrix[v, v] = root
        determinant *= root * root
        solved[v] = rest / root
        distance += solved[v] * solved[v]
    return distance, determinant


@small
def sweep_plane(
    one: Side,
    two: Side,
    grid: Grid,
    reach: Reach,
    folds: tuple[float, float],
    listed: IntArray,
    limit: float,
    box: bool,
    periods: FloatArray,
    first: int,
    last: int,
    out: tuple[FloatArray | Int32Array, ...],
) -> tuple[int, int]:
    """Candidates of the records at places ``first`` ≤ k < ``last`` of source 1, written into the arrays ``out``.

    one, two : ``order.Side``. grid, reach : of what lies in source 2. folds : periods of x and y. listed : see
    ``spans.near``, from ``first`` on. periods (d,). out : the columns of ``gate.Pairs``. Returns (candidates written,
    next k): next k < last when out is full.
    """
    room = np.empty(ROOM, np.int32), np.empty(ROOM, np.int32), np.empty(ROOM, np.uint8)
    count = np.int64(0)  # not a literal: numba would compile for it apart
    at = (np.int64(first), np.int64(0), np.int64(0), np.int64(0))
    while True:
        found, at = near(one, two, grid, reach, folds, listed, at, last, room)
        if found == 0:
            return count, last
        count, t = measured_on_plane(one, two, limit, box, periods, room[0], room[1], found, count, out)
        if t < found:
            return taken_back(out[0], count, room[0][t]), np.int64(room[0][t])


@part
def measured_on_plane(
    one: Side,
    two: Side,
    limit: float,
    box: bool,
    periods: FloatArray,
    of1: Int32Array,
    of2: Int32Array,
    found: int,
    count: int,
    out: tuple[FloatArray | Int32Array, ...],
) -> tuple[int, int]:
    """Write those of the pairs that pass the gate; returns (candidates written, pairs done before out was full)."""
    place1, place2, i, j, residual, distance, determinant = out
    d = len(periods)
    matrix = np.empty((d, d))
    delta = np.empty(d)
    solved = np.empty(d)
    reach = limit if box else limit * (1.0 + 1e-9)
    for t in range(found):
        k, q = of1[t], of2[t]
        matrix[:, :] = 0.0
        add_spread(one.content, k, d, d, matrix)
        add_spread(two.content, q, d, d, matrix)
        inside = True
        for v in range(d):
            delta[v] = folded(one.content[k, v] - two.content[q, v], periods[v])
            # No ellipse reaches further along an axis than its box.
            inside = inside and delta[v] * delta[v] <= reach * matrix[v, v]
        if not inside:
            continue
        if d == 2:
            xx, xy, yy = matrix[0, 0], matrix[1, 0], matrix[1, 1]
            area = xx * yy - xy * xy
            squared = (delta[0] * delta[0] * yy - 2.0 * delta[0] * delta[1] * xy + delta[1] * delta[1] * xx) / area
        else:
            squared, area = whitened(matrix, delta, solved)
        if not box and squared > limit:
            continue
        if count == len(i):
            return count, t
        place1[count], place2[count] = k, q
        i[count], j[count] = one.rows[k], two.rows[q]
        for v in range(d):
            residual[count, v] = delta[v]
        distance[count] = squared
        determinant[count] = area
        count += 1
    return count, found


@small
def plane_covariances(cov1: FloatArray, cov2: FloatArray, i: Int32Array, j: Int32Array, out: FloatArray) -> None:
    """Fill ``out`` (m, d, d) with the covariance of each pair's residual."""
    d = out.shape[1]
    out[:] = 0.0
    for k in range(len(i)):
        add_spread(cov1, i[k], 0, d, out[k])
        add_spread(cov2, j[k], 0, d, out[k])
        for v in range(d):
            for w in range(v):
                out[k, w, v] = out[k, v, w]

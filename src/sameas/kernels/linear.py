"""Compiled linear algebra: sums in order, small linear equations, and sums along motions through stacked frames."""

from __future__ import annotations

import math

import numpy as np

from sameas.arrays import FloatArray, IntArray
from sameas.kernels.compiled import kernel, part


@part
def summed(values: FloatArray) -> float:
    """Σ of values (n,), added in order; NumPy and BLAS use other orders."""
    total = 0.0
    for value in values:
        total += value
    return total


@part
def solve(matrix: FloatArray, right: FloatArray) -> None:
    """Replace ``right`` (n, r) by the solution of ``matrix`` (n, n) · x = right; the matrix is overwritten."""
    n = len(matrix)
    for k in range(n):
        pivot = k
        for a in range(k + 1, n):
            if abs(matrix[a, k]) > abs(matrix[pivot, k]):
                pivot = a
        if pivot != k:
            for b in range(n):
                matrix[k, b], matrix[pivot, b] = matrix[pivot, b], matrix[k, b]
            for b in range(right.shape[1]):
                right[k, b], right[pivot, b] = right[pivot, b], right[k, b]
        for a in range(k + 1, n):
            factor = matrix[a, k] / matrix[k, k]
            if factor != 0.0:
                for b in range(k, n):
                    matrix[a, b] -= factor * matrix[k, b]
                for b in range(right.shape[1]):
                    right[a, b] -= factor * right[k, b]
    for k in range(n - 1, -1, -1):
        for b in range(right.shape[1]):
            for a in range(k + 1, n):
                right[k, b] -= matrix[k, a] * right[a, b]
            right[k, b] /= matrix[k, k]


@part
def solve_2(a: float, b: float, c: float, determinant: float, x: float, y: float) -> tuple[float, float]:
    """S⁻¹ (x, y) for the symmetric S = [[a, b], [b, c]] with this determinant."""
    return (c * x - b * y) / determinant, (a * y - b * x) / determinant


@part
def positive_2(a: float, b: float, c: float) -> tuple[float, float, float, float]:
    """(a, b, c, determinant) of a covariance S = [[a, b], [b, c]], made positive definite where it is so but for
    rounding: as a difference of covariances thousands of times larger."""
    determinant = a * c - b * b
    if not determinant > 0.0:
        a, c = max(a, 1e-6), max(c, 1e-6)
        b = max(min(b, 0.999 * math.sqrt(a * c)), -0.999 * math.sqrt(a * c))
        determinant = a * c - b * b
    return a, b, c, determinant


@kernel
def best_motion(
    signal: np.ndarray, weight: np.ndarray, down: IntArray, right: IntArray, least: float, first: int, last: int,
    best: np.ndarray, which: IntArray,
) -> None:  # fmt: skip
    """Write to ``best`` and ``which`` (H, W) the largest T and its rate, for the pixels of rows first … last − 1.

    signal, weight : (F, H, W) matched filter ψ of every frame and its variance φ, 0 where a frame has no data.
    down, right : (R, F) displacement in px of a mover of each rate on each frame. T = Σψ/√Σφ over the frames, where
    Σφ > ``least``. A pixel of ``best`` is replaced only by a larger T.
    """
    frames, height, width = signal.shape
    light, noise = np.zeros(width, np.float32), np.zeros(width, np.float32)
    for y in range(first, last):
        top, rate = best[y], which[y]
        for r in range(len(down)):
            light[:] = 0.0
            noise[:] = 0.0
            for f in range(frames):
                v, off = y + down[r, f], right[r, f]
                if v < 0 or v >= height:
                    continue
                low, high = max(0, -off), min(width, width - off)
                if low >= high:
                    continue
                one, other = signal[f, v, low + off : high + off], weight[f, v, low + off : high + off]
                a, b = light[low:high], noise[low:high]
                for x in range(high - low):
                    a[x] += one[x]
                for x in range(high - low):
                    b[x] += other[x]
            for x in range(width):
                if noise[x] > least and light[x] > 0.0:
                    t = light[x] / math.sqrt(noise[x])
                    if t > top[x]:
                        top[x] = t
                        rate[x] = r

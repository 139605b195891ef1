"""Compiled sums, also along motions through the pixels of many frames, and the solution of a few linear equations."""

from __future__ import annotations

import math

import numpy as np

from sameas.arrays import FloatArray, IntArray
from sameas.kernels.compiled import kernel, part


@part
def summed(values: FloatArray) -> float:
    """Σ of some values (n,), one after another, as no library adds them."""
    total = 0.0
    for value in values:
        total += value
    return total


@part
def solve(matrix: FloatArray, right: FloatArray) -> None:
    """Turn ``right`` (n, r) into the solutions of ``matrix`` (n, n) · x = right, by elimination; the matrix is lost."""
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


@kernel
def best_motion(
    signal: np.ndarray, weight: np.ndarray, down: IntArray, right: IntArray, least: float, first: int, last: int,
    best: np.ndarray, which: IntArray,
) -> None:  # fmt: skip
    """Writes into best, which (H, W) the largest T and its rate for the pixels of rows first to last − 1.

    signal, weight : (F, H, W) matched filter ψ of every frame and its variance φ, 0 where a frame tells nothing.
    down, right : (R, F) px by which a mover of each rate stands off its place on each frame. T = Σψ/√Σφ over the
    frames, where Σφ is more than ``least``; ``best`` holds what is to be exceeded.
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

"""Compiled sums, the solution of a few linear equations, and of one for every row."""

from __future__ import annotations

from sameas.arrays import FloatArray
from sameas.kernels.compiled import part, small


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


@small
def best_exchange(mu: FloatArray, most: FloatArray, halvings: int, step: FloatArray) -> None:
    """Writes the δ of 0 … ``most`` (n,) at which ln|1 + δ D| is greatest, for the eigenvalues ``mu`` (n, d) of D.

    Its slope Σ μ/(1 + δ μ) falls in δ: halving finds where it is 0, to 2^−halvings of ``most``. What is not below 0 at
    ``most`` goes all the way.
    """
    for k in range(len(mu)):
        slope = 0.0
        for value in mu[k]:
            slope += value / max(1.0 + most[k] * value, 1e-300)
        if slope >= 0.0:
            step[k] = most[k]
            continue
        low, high = 0.0, most[k]
        for _ in range(halvings):
            middle, slope = 0.5 * (low + high), 0.0
            for value in mu[k]:
                slope += value / (1.0 + middle * value)
            if slope > 0.0:
                low = middle
            else:
                high = middle
        step[k] = 0.5 * (low + high)

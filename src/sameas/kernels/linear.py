"""Compiled sums, and the solution of a few linear equations."""

from __future__ import annotations

from sameas.arrays import FloatArray
from sameas.kernels.compiled import part


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

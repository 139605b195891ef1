"""Compiled Kalman updates: many small states, each by one measurement in the plane."""

from __future__ import annotations

import math

import numpy as np

from sameas.arrays import FloatArray
from sameas.kernels.compiled import small


@small
def update_in_plane(
    mean: FloatArray, covariance: FloatArray, slope: FloatArray, noise: FloatArray, shift: FloatArray,
    updated_mean: FloatArray, updated_covariance: FloatArray, log_p: FloatArray, chi_sq: FloatArray,
) -> None:  # fmt: skip
    """Writes what :func:`sameas.picture.error_correlation.error_update` gives: x by ν = H x + n.

    mean, covariance : (k, d), (k, d, d) of x. slope, noise : (k, 2, d), (k, 2, 2) H and the covariance of n.
    shift : (k, 2) ν. updated_mean, updated_covariance : of x given ν. log_p, chi_sq : (k,) ln p(ν), and χ² of ν.
    """
    d = mean.shape[1]
    one, other = np.empty(d), np.empty(d)  # the columns of P Hᵀ
    for row in range(len(mean)):
        p, h = covariance[row], slope[row]
        x, y = shift[row, 0], shift[row, 1]
        a, b, c = noise[row, 0, 0], 0.5 * (noise[row, 0, 1] + noise[row, 1, 0]), noise[row, 1, 1]
        for v in range(d):
            one[v] = other[v] = 0.0
            for w in range(d):
                one[v] += p[v, w] * h[0, w]
                other[v] += p[v, w] * h[1, w]
        for v in range(d):
            a += h[0, v] * one[v]
            b += 0.5 * (h[0, v] * other[v] + h[1, v] * one[v])
            c += h[1, v] * other[v]
            x -= h[0, v] * mean[row, v]
            y -= h[1, v] * mean[row, v]
        determinant = a * c - b * b
        # S⁻¹ times the surprise.
        east, north = (c * x - b * y) / determinant, (a * y - b * x) / determinant
        for v in range(d):
            updated_mean[row, v] = mean[row, v] + one[v] * east + other[v] * north
            gain_1 = (c * one[v] - b * other[v]) / determinant
            gain_2 = (a * other[v] - b * one[v]) / determinant
            for w in range(v + 1):
                value = 0.5 * (p[v, w] + p[w, v]) - gain_1 * one[w] - gain_2 * other[w]
                updated_covariance[row, v, w] = updated_covariance[row, w, v] = value
        chi_sq[row] = x * east + y * north
        log_p[row] = -0.5 * (chi_sq[row] + math.log(determinant)) - math.log(2.0 * math.pi)

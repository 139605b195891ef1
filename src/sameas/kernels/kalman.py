"""Compiled loops over many small states: Kalman updates by a measurement in the plane, and mixtures of two."""

from __future__ import annotations

import math

import numpy as np

from sameas.arrays import FloatArray, IntArray
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


@small
def mix(
    mean: FloatArray, covariance: FloatArray, at: IntArray, share: FloatArray, other_mean: FloatArray,
    other_covariance: FloatArray,
) -> None:  # fmt: skip
    """Turns some states into mixtures of themselves and others: their means and covariances, in place.

    mean, covariance : (k, h, d), (k, h, d, d). at : (m,) rows. share : (m,) of the others, (m, h, d), (m, h, d, d).
    """
    away = np.empty(mean.shape[2])
    for n in range(len(at)):
        row, s = at[n], share[n]
        for h in range(mean.shape[1]):
            for v in range(len(away)):
                away[v] = other_mean[n, h, v] - mean[row, h, v]
                mean[row, h, v] += s * away[v]
            for v in range(len(away)):
                for w in range(len(away)):
                    covariance[row, h, v, w] = (
                        (1.0 - s) * covariance[row, h, v, w]
                        + s * other_covariance[n, h, v, w]
                        + s * (1.0 - s) * away[v] * away[w]
                    )

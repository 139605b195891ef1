"""Weighing: normal densities in the plane, and one step of the filter of a track's error."""

from __future__ import annotations

import numpy as np

from sameas.evidence import LOG_2PI
from sameas.records import FloatArray

#: Least variance of a step, m²: keeps what is certain invertible.
LEAST_M2 = 1e-6


def looked(
    mean: FloatArray, spread: FloatArray, turn: FloatArray, fresh: FloatArray, shift: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Mean and covariance of e′ after a look that shifted a track by ν, ln p(ν), and χ² of ν.

    mean, shift : (k, 2). spread, turn, fresh : (k, 2, 2) covariance of e before, G, and the covariance of n.
    """
    slope = turn - np.eye(2)
    total = slope @ spread @ slope.transpose(0, 2, 1) + fresh + LEAST_M2 * np.eye(2)
    cross = turn @ spread @ slope.transpose(0, 2, 1) + fresh
    gain = cross @ np.linalg.inv(total)
    surprise = shift - np.einsum("kvw,kw->kv", slope, mean)
    after = np.einsum("kvw,kw->kv", turn, mean) + np.einsum("kvw,kw->kv", gain, surprise)
    narrowed = turn @ spread @ turn.transpose(0, 2, 1) + fresh - gain @ cross.transpose(0, 2, 1)
    log_p, chi_sq = log_normal(surprise, total)
    return after, 0.5 * (narrowed + narrowed.transpose(0, 2, 1)), log_p, chi_sq


def log_normal(x: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(k,) ln N(x; 0, covariance) in the plane, and (k,) χ²."""
    a, b, c = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    determinant = a * c - b * b
    chi_sq = (c * x[:, 0] ** 2 - 2.0 * b * x[:, 0] * x[:, 1] + a * x[:, 1] ** 2) / determinant
    return -LOG_2PI - 0.5 * np.log(determinant) - 0.5 * chi_sq, chi_sq


def growth(change: FloatArray) -> FloatArray:
    """(n, 2, 2) changes of covariances without what shrank."""
    values, axes = np.linalg.eigh(change)
    return np.asarray((axes * np.maximum(values, 0.0)[:, None, :]) @ axes.transpose(0, 2, 1))

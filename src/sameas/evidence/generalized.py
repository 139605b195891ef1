"""The paper's stand-in for the convolution of a normal and a box: a generalized Gaussian [T21–T25].

It has the same variance σ² + c²/3 and the same value at 0. Near the middle it is good to a few per cent; beyond the
outer box it falls faster than the truth, and the braces of METHOD 3.2 made of two of them may turn negative there.
Kept to reproduce the paper, and to show its error; the exact form costs no more.
"""

from __future__ import annotations

import math

import numpy as np

from sameas.evidence.boxes import log_interval, shell_volume
from sameas.records import FloatArray

#: ln of the shapes between which ψ lies: the normal, and what cannot be told from the uniform.
NORMAL, UNIFORM = math.log(2.0), math.log(1e7)
HALVINGS = 60


def log_generalized_density(delta: FloatArray, sigma: FloatArray, a: FloatArray, b: FloatArray) -> FloatArray:
    """(m,) ln of the paper's braces of METHOD 3.2, −∞ where they are not positive.

    Δ and σ (m, d), boxes a and b (d,); see :func:`sameas.evidence.log_neighbour_density` for the exact form.
    """
    outer = _log_box(delta, sigma, b)
    inner = np.full(len(delta), -np.inf) if np.any(a == 0.0) else _log_box(delta, sigma, a)
    positive = outer > inner
    braces = np.full(len(delta), -np.inf)
    braces[positive] = outer[positive] + np.log(-np.expm1(inner[positive] - outer[positive]))
    return np.asarray(braces - math.log(shell_volume(a, b)))


def _log_box(delta: FloatArray, sigma: FloatArray, c: FloatArray) -> FloatArray:
    """(m,) ln of V_c ∏ ψ(Δ_v; σ_v, c_v)."""
    return np.sum(log_generalized_gaussian(delta, sigma, np.broadcast_to(c, delta.shape)) + np.log(2.0 * c), axis=1)


def log_generalized_gaussian(x: FloatArray, sigma: FloatArray, c: FloatArray) -> FloatArray:
    """ln of the generalized Gaussian of variance σ² + c²/3 and the value of ψ(·; σ, c) at 0; elementwise."""
    from scipy.special import gammaln

    ratio, back = np.unique(np.ravel(c / sigma), return_inverse=True)
    at_zero = log_interval(-ratio, ratio, 2.0 * ratio) - np.log(2.0 * ratio)
    log_deviation = 0.5 * np.log1p(ratio**2 / 3.0)
    log_shape = _log_shape(at_zero + log_deviation)
    width = np.exp(log_deviation + 0.5 * (gammaln(np.exp(-log_shape)) - gammaln(3.0 * np.exp(-log_shape))))
    at_zero, shape, width = (np.reshape(values[back], np.shape(x)) for values in (at_zero, np.exp(log_shape), width))
    with np.errstate(over="ignore", divide="ignore"):
        return np.asarray(at_zero - np.log(sigma) - np.exp(shape * np.log(np.abs(x) / (sigma * width))))


def _log_shape(log_peak: FloatArray) -> FloatArray:
    """(n,) ln of the shape of the generalized Gaussian of variance 1 with these ln values at 0, by halving.

    The value at 0 falls with the shape, from that of the normal to that of the uniform.
    """
    low, high = np.full(len(log_peak), NORMAL), np.full(len(log_peak), UNIFORM)
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        above = _log_peak(middle) > log_peak
        low, high = np.where(above, middle, low), np.where(above, high, middle)
    return 0.5 * (low + high)


def _log_peak(log_shape: FloatArray) -> FloatArray:
    from scipy.special import gammaln

    inverse = np.exp(-log_shape)
    return log_shape - math.log(2.0) - 1.5 * gammaln(inverse) + 0.5 * gammaln(3.0 * inverse)

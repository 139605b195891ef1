"""Boxes under a normal whose features are independent: the density of a neighbour's residual, in logarithms.

Everything is a sum of positive terms, and every difference of Φ is taken in the negative tail: nothing cancels for
σ ≪ a, nothing underflows for |Δ| ≫ b.
"""

from __future__ import annotations

import math

import numpy as np

from sameas.evidence.spread import LOG_2PI
from sameas.records import FloatArray


def log_neighbour_density(delta: FloatArray, sigma: FloatArray, a: FloatArray, b: FloatArray) -> FloatArray:
    """(m,) ln of the braces of METHOD 3.2: density of Δ (m, d) for a neighbour between the boxes a and b (d,)."""
    x = np.abs(delta)
    log_pa = log_interval((x - a) / sigma, (x + a) / sigma, 2.0 * a / sigma)
    log_pb = log_interval((x - b) / sigma, (x + b) / sigma, 2.0 * b / sigma)
    far = log_interval((x + a) / sigma, (x + b) / sigma, (b - a) / sigma)
    near = log_interval((x - b) / sigma, (x - a) / sigma, (b - a) / sigma)
    log_e = np.logaddexp(far, near)
    before = np.cumsum(np.pad(log_pa, ((0, 0), (1, 0)))[:, :-1], axis=1)
    after = np.cumsum(np.pad(log_pb, ((0, 0), (0, 1)))[:, :0:-1], axis=1)[:, ::-1]
    return np.logaddexp.reduce(before + log_e + after, axis=1) - math.log(shell_volume(a, b))


def log_surface_density(delta: FloatArray, sigma: FloatArray, a: FloatArray) -> FloatArray:
    """(m,) the limit b = (1 + ε) a → a of :func:`log_neighbour_density`."""
    x = np.abs(delta)
    log_pa = log_interval((x - a) / sigma, (x + a) / sigma, 2.0 * a / sigma)
    near = -0.5 * ((x - a) / sigma) ** 2
    far = -0.5 * ((x + a) / sigma) ** 2
    log_e = np.logaddexp(near, far) - 0.5 * LOG_2PI - np.log(sigma) + np.log(a)
    total = np.sum(log_pa, axis=1, keepdims=True) - log_pa + log_e
    return np.logaddexp.reduce(total, axis=1) - math.log(len(a) * np.prod(2.0 * a))


def shell_volume(a: FloatArray, b: FloatArray) -> float:
    """V_b − V_a of the boxes |m_v| < a_v and |m_v| ≤ b_v, (d,) each, as a sum of positive terms."""
    terms = (np.prod(2.0 * a[:v]) * 2.0 * (b[v] - a[v]) * np.prod(2.0 * b[v + 1 :]) for v in range(len(a)))
    return float(sum(terms))


def log_interval(low: FloatArray, high: FloatArray, width: FloatArray) -> FloatArray:
    """ln[Φ(high) − Φ(low)], both flipped to the negative tail where low is positive.

    ``width`` is high − low before rounding: where it is small, the difference is the density in the middle times the
    width, to the second order.
    """
    from scipy.special import log_ndtr

    flip = low > 0
    low, high = np.where(flip, -high, low), np.where(flip, -low, high)
    middle = 0.5 * (low + high)
    top = log_ndtr(high)
    with np.errstate(divide="ignore"):
        wide = top + np.log(-np.expm1(np.minimum(log_ndtr(low) - top, 0.0)))
        narrow = np.log(width) - 0.5 * (middle**2 + LOG_2PI) + (middle**2 - 1.0) * width**2 / 24.0
    return np.where(width * (1.0 + np.abs(middle)) < 1e-3, narrow, wide)

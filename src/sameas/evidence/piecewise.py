"""Piecewise-linear curves of a magnitude: their basis, and the sums that fit them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sameas.arrays import FloatArray, IntArray
from sameas.representation import in_short

#: Quantiles are taken of about this many values of a longer list (chosen: enough for knots).
SORTED = 500


def knots_of(x: FloatArray, weights: FloatArray, per_knot: float, most: int) -> FloatArray:
    """(k,) increasing knots at quantiles of ``x``: one in about ``per_knot`` of the weight, at most ``most``."""
    count = min(max(round(float(weights.sum()) / per_knot), 1), most - 1) + 1
    every = max(1, len(x) // SORTED)
    x, weights = x[::every], weights[::every]
    order = np.argsort(x, kind="stable")
    cumulated = np.cumsum(weights[order])
    levels = cumulated[-1] * np.linspace(0.01, 0.99, count)
    knots = x[order][np.minimum(np.searchsorted(cumulated, levels), len(x) - 1)]
    apart = 1e-3 * max(float(knots[-1] - knots[0]), 1e-9)
    distinct = np.ones(count, np.bool_)
    np.greater(knots[1:] - knots[:-1], apart, out=distinct[1:])
    return np.asarray(knots[distinct])


@in_short
@dataclass(frozen=True)
class Hats:
    """The basis of curves that are straight between knots and constant outside, at (n,) places.

    A curve of the values c (k,) at the knots is (1 − part)·c[left] + part·c[left + 1].
    """

    knots: FloatArray
    left: IntArray
    part: FloatArray

    @classmethod
    def at(cls, knots: FloatArray, x: FloatArray) -> Hats:
        """The basis at places ``x`` (n,)."""
        if len(knots) == 1:
            return cls(knots, np.zeros(len(x), np.int64), np.zeros(len(x)))
        left = np.clip(np.searchsorted(knots, x, side="right") - 1, 0, len(knots) - 2)
        part = np.clip((x - knots[left]) / (knots[left + 1] - knots[left]), 0.0, 1.0)
        return cls(knots, left, part)

    def curve(self, values: FloatArray) -> FloatArray:
        """(n,) the curve of these values (k,) at the knots."""
        padded = np.append(values, values[-1])
        low = padded[self.left]
        return np.asarray(low + self.part * (padded[self.left + 1] - low))

    def sum(self, weights: FloatArray) -> FloatArray:
        """(k,) Σ weights · basis."""
        k = len(self.knots)
        upper = np.bincount(self.left + 1, weights * self.part, k + 1)[:k]
        return np.asarray(np.bincount(self.left, weights * (1.0 - self.part), k) + upper, np.float64)

    def gram(self, weights: FloatArray) -> FloatArray:
        """(k, k) Σ weights · basis basisᵀ."""
        k = len(self.knots)
        low, high = 1.0 - self.part, self.part
        square = np.diag(np.bincount(self.left, weights * low**2, k))
        square += np.diag(np.bincount(self.left + 1, weights * high**2, k + 1)[:k])
        cross = np.bincount(self.left, weights * low * high, k)[: k - 1]
        return np.asarray(square + np.diag(cross, 1) + np.diag(cross, -1), np.float64)


def roughness(k: int, bend: float, weight: FloatArray | float = 1.0) -> FloatArray:
    """(k, k) the penalty of curves whose second difference from knot to knot is drawn from N(0, bend²); each counts
    with a weight (k − 2,)."""
    second = np.diff(np.eye(k), n=2, axis=0) / bend
    return np.asarray((second.T * weight) @ second)

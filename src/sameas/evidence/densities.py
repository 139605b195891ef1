"""Densities of positions for the universal rule: flat, a Gaussian mixture, samples, or a function.

- :class:`Flat`: an object lies anywhere with the same density.
- :class:`GaussianMixture`: everything is a closed form.
- :class:`Samples`: draws from a density of no known form; sums over them come with their standard error.
- :class:`Displacement`: a function of where the other object lies from the first.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from sameas.arrays import FloatArray
from sameas.errors import InputError
from sameas.gaussian import Gaussian, log_density
from sameas.representation import in_short

#: Takes positions (n, d), gives densities (n,).
DensityFunction = Callable[[FloatArray], FloatArray]


@dataclass(frozen=True)
class Flat:
    """The same density everywhere, 1 / (unit of the features)^d: 1 / volume of the region."""

    density: float

    def __post_init__(self) -> None:
        if not 0.0 < self.density < math.inf:
            raise InputError(f"Flat: density is {self.density}; give a positive number, 1 / volume of the region")

    def __call__(self, points: FloatArray) -> FloatArray:
        """(n,) the density at positions (n, d)."""
        return np.full(len(points), self.density)

    def log_common(self, x1: FloatArray, s1: FloatArray, x2: FloatArray, s2: FloatArray) -> FloatArray:
        """(…, 1) ln ∫ p(M) N(x1; M, s1) N(x2; M, s2) dM."""
        return (log_density(x1 - x2, s1 + s2) + math.log(self.density))[..., None]


@in_short
@dataclass(frozen=True)
class GaussianMixture:
    """Σ w_k N(M; mean_k, covariance_k).

    Parameters
    ----------
    weights : (k,) shares with the sum 1. means : (k, d). covariances : (k, d, d), positive definite.
    """

    weights: ArrayLike
    means: ArrayLike
    covariances: ArrayLike

    def __post_init__(self) -> None:
        weights, means, covariances = (np.asarray(x, np.float64) for x in (self.weights, self.means, self.covariances))
        if means.ndim != 2 or weights.shape != means.shape[:1] or covariances.shape != (*means.shape, means.shape[1]):
            raise InputError(
                f"GaussianMixture: weights {weights.shape}, means {means.shape}, covariances {covariances.shape}; "
                "give (k,), (k, d) and (k, d, d)"
            )
        if not (len(weights) and np.all(weights > 0.0) and abs(weights.sum() - 1.0) < 1e-6):
            raise InputError("GaussianMixture: weights must be positive and have the sum 1")
        if not np.all(np.linalg.eigvalsh(covariances) > 0.0):
            raise InputError("GaussianMixture: a covariance is not positive definite")
        for name, values in (("weights", weights), ("means", means), ("covariances", covariances)):
            object.__setattr__(self, name, values)

    def __len__(self) -> int:
        return len(np.asarray(self.means))

    @property
    def d(self) -> int:
        """Number of features."""
        return int(np.shape(self.means)[1])

    def __call__(self, points: FloatArray) -> FloatArray:
        """(n,) the density at positions (n, d)."""
        parts = log_density(points[:, None] - np.asarray(self.means), np.asarray(self.covariances))
        return np.asarray(np.exp(parts) @ np.asarray(self.weights))

    def log_common(self, x1: FloatArray, s1: FloatArray, x2: FloatArray, s2: FloatArray) -> FloatArray:
        """(…, k) ln of the parts of ∫ p(M) N(x1; M, s1) N(x2; M, s2) dM."""
        return np.log(self.weights) + log_parts(np.asarray(self.means), np.asarray(self.covariances), x1, s1, x2, s2)


@in_short
@dataclass(frozen=True)
class Samples:
    """Draws (n, d) from a density: of positions, or of displacements between neighbours.

    They must be dense on the scale of the records' errors, or the stated error is large; see :meth:`smoothed`.
    """

    points: ArrayLike

    def __post_init__(self) -> None:
        points = np.asarray(self.points, np.float64)
        if points.ndim != 2 or len(points) < 2 or not np.isfinite(points).all():
            raise InputError(f"Samples: points have shape {points.shape}; give (n, d) finite numbers, n of 2 or more")
        object.__setattr__(self, "points", points)

    def __len__(self) -> int:
        return len(np.asarray(self.points))

    @property
    def d(self) -> int:
        """Number of features."""
        return int(np.shape(self.points)[1])

    def smoothed(self) -> GaussianMixture:
        """The same as a mixture of one normal per sample, of the width of Scott's rule for one cluster."""
        points = np.asarray(self.points)
        n, d = points.shape
        spread = np.atleast_2d(np.cov(points.T)) * n ** (-2.0 / (d + 4))
        return GaussianMixture(np.full(n, 1.0 / n), points, np.broadcast_to(spread, (n, d, d)))

    def log_common(self, x1: FloatArray, s1: FloatArray, x2: FloatArray, s2: FloatArray) -> FloatArray:
        """(…, n) ln of the parts of ∫ p(M) N(x1; M, s1) N(x2; M, s2) dM."""
        points = np.asarray(self.points)
        nothing = np.zeros((points.shape[1],) * 2)
        return log_parts(points, nothing, x1, s1, x2, s2) - math.log(len(points))


@in_short
@dataclass(frozen=True)
class Displacement:
    """The density of where the other object lies from the first, a function of M₂ − M₁ (n, d) → (n,)."""

    density: DensityFunction

    def __call__(self, points: FloatArray) -> FloatArray:
        """(n,) the density at displacements (n, d)."""
        return self.density(points)


def log_parts(
    means: FloatArray, covariances: FloatArray, x1: FloatArray, s1: FloatArray, x2: FloatArray, s2: FloatArray
) -> FloatArray:
    """(…, k) ln ∫ N(M; mean_k, covariance_k) N(x1; M, s1) N(x2; M, s2) dM.

    Two measurements of one object are one of their weighted mean, with the density of their difference.
    """
    fused = Gaussian(x1, s1).updated(Gaussian(x2, s2))
    apart = fused.mean[..., None, :] - means
    return log_density(x1 - x2, s1 + s2)[..., None] + log_density(
        apart, fused.covariance[..., None, :, :] + covariances
    )

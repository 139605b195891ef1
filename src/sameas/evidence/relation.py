"""Densities of magnitudes: of all records of a source, and of one magnitude given others of the same object."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sameas.records import FloatArray


@dataclass(frozen=True)
class MagnitudeDensity:
    """Density of the magnitudes of all records of a source in one band, 1/mag: a smoothed histogram.

    grid : (g,) mag, evenly spaced. log_density : (g,).
    """

    grid: FloatArray
    log_density: FloatArray

    def __call__(self, magnitude: FloatArray) -> FloatArray:
        """(n,) ln p at magnitudes (n,)."""
        return np.interp(magnitude, self.grid, self.log_density)


@dataclass(frozen=True)
class Relation:
    """Density of one magnitude, given one or more others of the same object.

    The mean is the first of the others, plus a curve of it, plus linear terms in the colours; about it the magnitude
    spreads as a mixture of normals, of the quoted errors and of a scatter that depends on the first of the others.
    The share ``unrelated`` follows ``background`` instead: no magnitude weighs less than that, however far off.

    Attributes
    ----------
    knots, offset, scatter : (k,) magnitudes, and there the mean difference and the scatter beyond quoted errors, mag.
    slopes, centres : (c,) mag per mag of colour, about these colours: the other magnitudes minus the first of them.
        The mean is that given measured magnitudes, as is due for what predicts measured pairs: the errors of the
        colours make its slopes smaller than those on true colours (regression dilution).
    scales, shares : of the mixture's normals, in units of error and scatter together.
    unrelated : the share that follows ``background``.
    covariance : (k + c, k + c) of offset and slopes, from the pairs that they were learned from.
    mean_basis : (k + c,) basis averaged over these pairs.
    scatter_error : standard error of the typical scatter, mag. weight : number of these pairs, as expected.
    """

    knots: FloatArray
    offset: FloatArray
    scatter: FloatArray
    slopes: FloatArray
    centres: FloatArray
    scales: FloatArray
    shares: FloatArray
    unrelated: float
    background: MagnitudeDensity
    covariance: FloatArray
    mean_basis: FloatArray
    scatter_error: float
    weight: float

    @property
    def zero_point(self) -> float:
        """Mean difference of the pairs, mag: the magnitude minus the first of the others."""
        return float(self.mean_basis @ np.concatenate([self.offset, self.slopes]))

    @property
    def zero_point_error(self) -> float:
        """Its standard error, mag."""
        return math.sqrt(max(float(self.mean_basis @ self.covariance @ self.mean_basis), 0.0))

    @property
    def slope_errors(self) -> FloatArray:
        """(c,) standard errors of the slopes."""
        k = len(self.knots)
        return np.sqrt(np.diag(self.covariance)[k:])

    @property
    def typical_scatter(self) -> float:
        """Scatter beyond the quoted errors, mag: root mean square over the pairs."""
        share = self.mean_basis[: len(self.knots)]
        return math.sqrt(float(share @ self.scatter**2) / max(float(share.sum()), 1e-300))

    def log_density(
        self,
        y: FloatArray,
        others: FloatArray,
        variance: FloatArray,
        other_variance: FloatArray,
        background: FloatArray,
    ) -> FloatArray:
        """(m,) ln p of magnitudes y (m,), given others (m, 1 + c); variances of both, and (m,) the background at y."""
        from sameas.kernels.relation import log_mixture

        relation = (
            self.offset,
            self.scatter,
            self.slopes,
            self.centres,
            self.scales,
            np.append(self.shares, self.unrelated),
        )
        out = np.empty(len(y))
        log_mixture(y, variance, others, other_variance, self.knots, relation, background, out)
        return out

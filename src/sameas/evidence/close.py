"""The close-objects rule: a different object lies near, but not nearer than two objects can be (METHOD 3.2).

:class:`CloseObjects` takes the exact convolution of the normal and the boxes (:mod:`sameas.evidence.boxes`). The
paper's stand-in for it, :func:`log_generalized_density`, is there to reproduce the paper and to show its error; the
exact form costs no more.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sameas.arrays import FloatArray
from sameas.errors import InputError
from sameas.evidence.boxes import (
    log_correlated_density,
    log_correlated_surface,
    log_interval,
    log_neighbour_density,
    log_surface_density,
    shell_volume,
)
from sameas.evidence.residuals import AS_QUOTED
from sameas.evidence.rule import Evidence, Rule
from sameas.gate import Pairs
from sameas.representation import in_short

EXACT, DIAGONAL = "exact", "diagonal"
GENERALIZED_GAUSSIAN = "generalized Gaussian"

#: ln of the shapes between which the generalized Gaussian lies: that of the normal, and one as good as uniform.
NORMAL, UNIFORM = math.log(2.0), math.log(1e7)
#: Steps of bisection from the whole range of shapes to the rounding of a double.
HALVINGS = 60


def log_generalized_density(delta: FloatArray, sigma: FloatArray, a: FloatArray, b: FloatArray) -> FloatArray:
    """(m,) ln of the paper's braces of METHOD 3.2, −∞ where they are not positive.

    A generalized Gaussian stands for the convolution of a normal and a box, with the same variance σ² + c²/3 and the
    same value at 0 [T21–T25]. It is good to a few per cent near the middle; beyond the outer box it falls faster than
    the truth, and the difference of two may be negative there. Δ and σ (m, d), boxes a and b (d,); the exact form is
    :func:`sameas.evidence.log_neighbour_density`.
    """
    outer = _log_box(delta, sigma, b)
    inner = np.full(len(delta), -np.inf) if np.any(a == 0.0) else _log_box(delta, sigma, a)
    positive = outer > inner
    braces = np.full(len(delta), -np.inf)
    braces[positive] = outer[positive] + np.log(-np.expm1(inner[positive] - outer[positive]))
    return np.asarray(braces - math.log(shell_volume(a, b)))


def _log_box(delta: FloatArray, sigma: FloatArray, c: FloatArray) -> FloatArray:
    """(m,) ln of V_c ∏ ψ(Δ_v; σ_v, c_v)."""
    return np.asarray(
        np.sum(log_generalized_gaussian(delta, sigma, np.broadcast_to(c, delta.shape)) + np.log(2.0 * c), axis=1)
    )


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
    return np.asarray(0.5 * (low + high))


def _log_peak(log_shape: FloatArray) -> FloatArray:
    from scipy.special import gammaln

    inverse = np.exp(-log_shape)
    return np.asarray(log_shape - math.log(2.0) - 1.5 * gammaln(inverse) + 0.5 * gammaln(3.0 * inverse))


@in_short
@dataclass(frozen=True)
class CloseObjects(Rule):
    """A different object is uniform in the box |m_v| ≤ b_v around the first without its inner box |m_v| < a_v.

    λ = N(Δ; 0, Σ) / [density of Δ for two such objects] (METHOD 3.2 [T14–T19, T26]), with the exact convolution of
    the normal and the box, evaluated in logarithms: a sum of positive terms that neither cancels for σ ≪ a nor
    underflows for |Δ| ≫ b. A b much smaller than the distance of neighbours is harmful, one too large hardly:
    see :func:`sameas.evidence.spacing.estimate_reach`.

    Parameters
    ----------
    a : per feature how near two objects can be, or a number for all; 0 where they may coincide.
    b : per feature how far the neighbour may be, b ≥ a. None stands for the limit b → a, taken with b = (1 + ε) a:
        the neighbour lies on the surface of the inner box.
    correlation : "exact" (default) takes the boxes under the whole of Σ in two features; "diagonal" drops the
        correlation there, as the paper does. In one, three or more features the boxes always take the diagonal of Σ.
        N takes all of Σ in any case.
    approximation : None, or "generalized Gaussian" for the paper's stand-in [T21–T25], which drops the correlation.
        Far outside the outer box its braces turn negative and mean nothing; those pairs get the exact value.

    Example
    -------
    >>> from sameas import CloseObjects, Radius, Records
    >>> pairs = Radius(9.0)(Records.of([[0.0, 0.0]], sigma=1.0), Records.of([[0.3, 1.0], [5.0, 5.0]], sigma=0.5))
    >>> CloseObjects(a=1.2, b=6.0)(pairs).log_ratio.round(2)
    array([  2.91, -16.72])
    """

    a: float | tuple[float, ...]
    b: float | tuple[float, ...] | None = None
    correlation: str = EXACT
    approximation: str | None = None

    def __post_init__(self) -> None:
        if self.correlation not in (EXACT, DIAGONAL):
            raise InputError(f'CloseObjects: correlation is {self.correlation!r}; give "{EXACT}" or "{DIAGONAL}"')
        if self.approximation not in (None, GENERALIZED_GAUSSIAN):
            raise InputError(
                f'CloseObjects: approximation is {self.approximation!r}; give "{GENERALIZED_GAUSSIAN}" or None'
            )
        a = np.atleast_1d(np.asarray(self.a, dtype=np.float64))
        if not np.all((a >= 0) & (a < np.inf)):
            raise InputError(f"CloseObjects: a is {self.a}; give distances of zero or more in the unit of the features")
        if self.b is None:
            if not np.all(a > 0):
                raise InputError("CloseObjects: a is 0 and b is not given; give b, the reach of a neighbour")
            if self.approximation is not None:
                raise InputError(
                    f"CloseObjects: the {self.approximation} has no limit b → a; give b, or no approximation"
                )
            return
        b = np.atleast_1d(np.asarray(self.b, dtype=np.float64))
        if a.size > 1 and b.size > 1 and a.size != b.size:
            raise InputError(f"CloseObjects: a has {a.size} features, b {b.size}; give one number or one per feature")
        if not (np.all(b >= a) and np.any(b > a) and np.all((b > 0) & (b < np.inf))):
            raise InputError(
                f"CloseObjects: b is {self.b} with a {self.a}; "
                "give b ≥ a and above zero in every feature, larger in one, or no b"
            )

    def __call__(self, pairs: Pairs) -> Evidence:
        a = _per_feature(self.a, pairs.d, "a")
        b = None if self.b is None else _per_feature(self.b, pairs.d, "b")
        density = _diagonal_density(pairs, a, b)
        if self.approximation is not None and b is not None:
            density = _approximate_density(pairs, a, b, density)
        elif self.correlation == EXACT and pairs.d == 2:
            _correlate(density, pairs, a, b)
        return Evidence({"position": AS_QUOTED.log_density(pairs), "neighbour": -density})


def _diagonal_density(pairs: Pairs, a: FloatArray, b: FloatArray | None) -> FloatArray:
    """(m,) ln of the density of Δ for two neighbours, with the boxes under the diagonal of Σ."""
    sigma = np.sqrt(np.einsum("mvv->mv", pairs.covariance))
    if b is None:
        return log_surface_density(pairs.residual, sigma, a)
    return log_neighbour_density(pairs.residual, sigma, a, b)


def _correlate(density: FloatArray, pairs: Pairs, a: FloatArray, b: FloatArray | None) -> None:
    """Put the exact ``density`` in the place of the diagonal one where two features are correlated."""
    rows = np.flatnonzero(pairs.covariance[:, 0, 1])
    if not len(rows):
        return
    delta, covariance = pairs.residual[rows], pairs.covariance[rows]
    if b is None:
        density[rows] = log_correlated_surface(delta, covariance, a)
    else:
        density[rows] = log_correlated_density(delta, covariance, a, b)


def _approximate_density(pairs: Pairs, a: FloatArray, b: FloatArray, exact: FloatArray) -> FloatArray:
    """(m,) the paper's approximation, and ``exact`` where its braces are not positive."""
    sigma = np.sqrt(np.einsum("mvv->mv", pairs.covariance))
    approximate = log_generalized_density(pairs.residual, sigma, a, b)
    return np.where(np.isfinite(approximate), approximate, exact)


def _per_feature(value: float | tuple[float, ...], d: int, name: str) -> FloatArray:
    values = np.atleast_1d(np.asarray(value, dtype=np.float64))
    if values.size not in (1, d):
        raise InputError(
            f"CloseObjects: {name} has {values.size} numbers for {d} features; give one, or one per feature"
        )
    return np.broadcast_to(values, d).copy()

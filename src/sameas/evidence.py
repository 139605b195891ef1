"""Evidence: how much more probable a pair's residual is if both records are one object than if they are two.

Every rule gives a natural logarithm per pair, term by term; rules add with ``+``.

- :class:`Field`: a different object lies anywhere with constant density (METHOD 3.1, the papers' uniform rule).
- :class:`PoissonField`: objects are a Poisson field; the densities of common and of unrelated objects are known or
  estimated (METHOD 4.3). The default for catalogues.
- :class:`ConstantCost`: frame and catalogue, every unmatched record costs the constant density C
  (METHOD 3.4 [F15–F17]); ``ConstantCost.calibrated`` is its form with a detection probability and the density of
  other measurements.
- :class:`CloseObjects`: a different object lies near, but not nearer than two objects can be
  (METHOD 3.2 [T14–T19, T26]).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from sameas.errors import InputError
from sameas.gate import Pairs
from sameas.records import FloatArray

LOG_2PI = math.log(2.0 * math.pi)


@dataclass(frozen=True)
class Evidence:
    """Named terms, (m,) each; their sum is the log likelihood ratio of every pair."""

    terms: Mapping[str, FloatArray]

    @cached_property
    def log_ratio(self) -> FloatArray:
        """(m,) ln λ."""
        parts = list(self.terms.values())
        return parts[0] if len(parts) == 1 else np.sum(parts, axis=0)


class Rule:
    """What every decision rule is: a call from pairs to evidence, and a sum with other rules."""

    def __call__(self, pairs: Pairs) -> Evidence:
        raise TypeError(f"{type(self).__name__} is the interface of decision rules; use one of them")

    def __add__(self, other: Rule) -> Rule:
        return Sum((*self.parts(), *other.parts()))

    def parts(self) -> tuple[Rule, ...]:
        """The rules that this one is the sum of."""
        return (self,)


@dataclass(frozen=True)
class Sum(Rule):
    """Several rules that speak of independent features."""

    rules: tuple[Rule, ...]

    def parts(self) -> tuple[Rule, ...]:
        return self.rules

    def __call__(self, pairs: Pairs) -> Evidence:
        terms: dict[str, FloatArray] = {}
        for rule in self.rules:
            for name, values in rule(pairs).terms.items():
                terms[name] = terms[name] + values if name in terms else values
        return Evidence(terms)


@dataclass(frozen=True)
class Errors:
    """How residuals spread about their quoted covariances: a mixture of normals N(0, scale²·Σ).

    ``Errors()`` takes the quoted errors as they are. ``Errors(scales=(1.4, 6.0), shares=(0.95, 0.05))`` says that they
    are 1.4 times too small, and that one pair in twenty has errors 6 times larger than quoted (a heavy tail).
    """

    scales: tuple[float, ...] = (1.0,)
    shares: tuple[float, ...] = (1.0,)

    def __post_init__(self) -> None:
        if len(self.scales) != len(self.shares) or not self.scales:
            raise InputError(
                f"Errors: {len(self.scales)} scales but {len(self.shares)} shares; give one share per scale"
            )
        positive = all(0.0 < scale < math.inf for scale in self.scales) and all(share >= 0.0 for share in self.shares)
        if not positive or abs(sum(self.shares) - 1.0) > 1e-6:
            raise InputError("Errors: scales must be positive, and shares non-negative with the sum 1")

    @property
    def typical_scale(self) -> float:
        """The factor by which the quoted errors must be multiplied for the typical pair: the median of the scales."""
        order = np.argsort(self.scales)
        shares, logs = np.asarray(self.shares)[order], np.log(np.asarray(self.scales)[order])
        return float(np.exp(np.interp(0.5, np.cumsum(shares) - 0.5 * shares, logs)))

    def log_density(self, pairs: Pairs) -> FloatArray:
        """(m,) ln of the density of the residuals [F14, T17, for one component of scale 1]."""
        base = np.log(pairs.determinant)
        base += pairs.d * LOG_2PI
        base *= -0.5
        if self.scales == (1.0,):
            base -= 0.5 * pairs.mahalanobis_sq
            return base
        base += self.log_profile(pairs.mahalanobis_sq, pairs.d)
        return base

    def log_profile(self, mahalanobis_sq: FloatArray, d: int) -> FloatArray:
        """(m,) ln Σ_k share_k scale_k^(−d) exp(−m²/(2 scale_k²)): what replaces exp(−m²/2) of one normal."""
        total = np.full(len(mahalanobis_sq), -np.inf)
        for scale, share in zip(self.scales, self.shares, strict=True):
            if share > 0.0:
                part = mahalanobis_sq * (-0.5 / scale**2)
                part += math.log(share) - d * math.log(scale)
                np.logaddexp(total, part, out=total)
        return total


@dataclass(frozen=True)
class Field(Rule):
    """A second object lies anywhere with constant density: λ = N(Δ; 0, Σ) / p_M (METHOD 3.1 [T4]).

    Parameters
    ----------
    density : p_M, the probability density of one object's position over the region, 1/volume in the residual's unit
        (on the sphere 1/arcsec²); a number, or (n₂,) at the records of source 2.
    """

    density: ArrayLike

    def __call__(self, pairs: Pairs) -> Evidence:
        density = _at(self.density, len(pairs.second), pairs.j, "Field: density")
        return Evidence(
            {"position": Errors().log_density(pairs), "elsewhere": np.broadcast_to(-np.log(density), len(pairs))}
        )


@dataclass(frozen=True)
class PoissonField(Rule):
    """Objects are a Poisson field: λ·odds = ρ₁₂ N(Δ; 0, Σ) / (ρ₁ ρ₂) with the densities below (METHOD 4.3).

    With objects of density ρ that the sources miss with q₁, q₂: ρ₁₂ = ρ(1−q₁)(1−q₂), ρ₁ = ρ(1−q₁)q₂, ρ₂ = ρq₁(1−q₂);
    false records add to ρ₁, ρ₂. The rule gives posterior log-odds before one-to-one: combine it with ``PerPair(0)``.

    Parameters
    ----------
    common : ρ₁₂, density of objects that both sources show; a number, or a pair of arrays (n₁,), (n₂,) at the records
        of either source, whose logarithms are averaged for a pair.
    only_1, only_2 : densities of records that only one source shows; numbers, or (n₁,) and (n₂,).
        Unit: 1 / (unit of the residual)^d.
    errors : how residuals spread about the quoted covariances.
    """

    common: ArrayLike | tuple[FloatArray, FloatArray]
    only_1: ArrayLike
    only_2: ArrayLike
    errors: Errors = Errors()

    def __call__(self, pairs: Pairs) -> Evidence:
        n1, n2 = len(pairs.first), len(pairs.second)
        if isinstance(self.common, tuple):
            at_1 = _at(self.common[0], n1, pairs.i, "PoissonField: common[0]")
            at_2 = _at(self.common[1], n2, pairs.j, "PoissonField: common[1]")
            common = 0.5 * (np.log(at_1) + np.log(at_2))
        else:
            common = np.log(_at(self.common, n1, pairs.i, "PoissonField: common"))
        unrelated = np.log(_at(self.only_1, n1, pairs.i, "PoissonField: only_1"))
        unrelated = unrelated + np.log(_at(self.only_2, n2, pairs.j, "PoissonField: only_2"))
        position = self.errors.log_density(pairs)
        return Evidence({"position": position, "densities": np.broadcast_to(common - unrelated, len(pairs))})


@dataclass(frozen=True)
class ConstantCost(Rule):
    """Every unmatched record costs the constant density C: a pair weighs ln N − 2 ln C (METHOD 3.4 [F15–F17])."""

    c: float

    def __post_init__(self) -> None:
        if not 0.0 < self.c < math.inf:
            raise InputError(f"ConstantCost: C is {self.c}; give a positive density in 1/(unit of the features)^(d/2)")

    @staticmethod
    def calibrated(detection_probability: ArrayLike, density: ArrayLike) -> DetectionField:
        """The calibrated form, C² = β(1 − P_d)/P_d, with P_d and β per record where they vary."""
        return DetectionField(detection_probability, density)

    def __call__(self, pairs: Pairs) -> Evidence:
        return Evidence({"position": Errors().log_density(pairs), "cost": np.full(len(pairs), -2.0 * math.log(self.c))})


@dataclass(frozen=True)
class DetectionField(Rule):
    """λ·odds = P_d N(Δ; 0, Σ) / [(1 − P_d) β]: measurements of source 1 against records of source 2 (METHOD 3.4).

    Parameters
    ----------
    detection_probability : P_d, the probability that source 1 shows record j; a number or (n₂,).
    density : β of measurements of other objects and false ones, per unit volume; a number or (n₁,).
    """

    detection_probability: ArrayLike
    density: ArrayLike

    def __call__(self, pairs: Pairs) -> Evidence:
        shown = _at(self.detection_probability, len(pairs.second), pairs.j, "detection_probability")
        if np.any(shown >= 1.0):
            raise InputError("detection_probability is 1 or more; give the probability of a detection, below 1")
        density = _at(self.density, len(pairs.first), pairs.i, "density")
        odds = np.log(shown) - np.log1p(-shown) - np.log(density)
        return Evidence({"position": Errors().log_density(pairs), "detection": np.broadcast_to(odds, len(pairs))})


@dataclass(frozen=True)
class CloseObjects(Rule):
    """A different object is uniform in the box |m_v| ≤ b_v around the first without its inner box |m_v| < a_v.

    λ = N(Δ; 0, Σ) / [density of Δ for two such objects] (METHOD 3.2 [T14–T19, T26]), with the exact convolution of
    the normal and the box, evaluated in logarithms: a sum of positive terms that neither cancels for σ ≪ a nor
    underflows for |Δ| ≫ b. The box probabilities use the diagonal of Σ, as the paper does; N uses all of it.

    Parameters
    ----------
    a : per feature how near two objects can be, or a number for all; 0 where they may coincide.
    b : per feature how far the neighbour may be, b ≥ a. None stands for the limit b → a, taken with b = (1 + ε) a:
        the neighbour lies on the surface of the inner box.
    """

    a: float | tuple[float, ...]
    b: float | tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        a = np.atleast_1d(np.asarray(self.a, dtype=np.float64))
        if not np.all((a >= 0) & (a < np.inf)):
            raise InputError(f"CloseObjects: a is {self.a}; give distances of zero or more in the unit of the features")
        if self.b is None:
            if not np.all(a > 0):
                raise InputError("CloseObjects: a is 0 and b is not given; give b, the reach of a neighbour")
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
        d = pairs.d
        a = _per_feature(self.a, d, "a")
        sigma = np.sqrt(np.einsum("mvv->mv", pairs.covariance))
        if self.b is None:
            log_density = log_surface_density(pairs.residual, sigma, a)
        else:
            log_density = log_neighbour_density(pairs.residual, sigma, a, _per_feature(self.b, d, "b"))
        return Evidence({"position": Errors().log_density(pairs), "neighbour": -log_density})


def log_neighbour_density(delta: FloatArray, sigma: FloatArray, a: FloatArray, b: FloatArray) -> FloatArray:
    """(m,) ln of the braces of METHOD 3.2: density of Δ (m, d) for a neighbour between the boxes a and b (d,)."""
    x = np.abs(delta)
    log_pa = _log_interval((x - a) / sigma, (x + a) / sigma, 2.0 * a / sigma)
    log_pb = _log_interval((x - b) / sigma, (x + b) / sigma, 2.0 * b / sigma)
    far = _log_interval((x + a) / sigma, (x + b) / sigma, (b - a) / sigma)
    near = _log_interval((x - b) / sigma, (x - a) / sigma, (b - a) / sigma)
    log_e = np.logaddexp(far, near)
    before = np.cumsum(np.pad(log_pa, ((0, 0), (1, 0)))[:, :-1], axis=1)
    after = np.cumsum(np.pad(log_pb, ((0, 0), (0, 1)))[:, :0:-1], axis=1)[:, ::-1]
    # V_b − V_a, as the same sum of positive terms.
    volume = sum(np.prod(2.0 * a[:v]) * 2.0 * (b[v] - a[v]) * np.prod(2.0 * b[v + 1 :]) for v in range(len(a)))
    return np.logaddexp.reduce(before + log_e + after, axis=1) - math.log(volume)


def log_surface_density(delta: FloatArray, sigma: FloatArray, a: FloatArray) -> FloatArray:
    """(m,) the limit b = (1 + ε) a → a of :func:`log_neighbour_density`."""
    x = np.abs(delta)
    log_pa = _log_interval((x - a) / sigma, (x + a) / sigma, 2.0 * a / sigma)
    near = -0.5 * ((x - a) / sigma) ** 2
    far = -0.5 * ((x + a) / sigma) ** 2
    log_e = np.logaddexp(near, far) - 0.5 * LOG_2PI - np.log(sigma) + np.log(a)
    total = np.sum(log_pa, axis=1, keepdims=True) - log_pa + log_e
    return np.logaddexp.reduce(total, axis=1) - math.log(len(a) * np.prod(2.0 * a))


def _log_interval(low: FloatArray, high: FloatArray, width: FloatArray) -> FloatArray:
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


def _per_feature(value: float | tuple[float, ...], d: int, name: str) -> FloatArray:
    values = np.atleast_1d(np.asarray(value, dtype=np.float64))
    if values.size not in (1, d):
        raise InputError(
            f"CloseObjects: {name} has {values.size} numbers for {d} features; give one, or one per feature"
        )
    return np.broadcast_to(values, d).copy()


def _at(value: ArrayLike, n: int, rows: np.ndarray, name: str) -> FloatArray:
    """A number, or the values (n,) at the pairs' records; positive and finite."""
    values = np.asarray(value, dtype=np.float64)
    if not np.all((values > 0) & (values < np.inf)):
        raise InputError(f"{name} is zero, negative or not finite; give positive numbers in the unit of the residual")
    if values.ndim == 0:
        return values
    if values.shape != (n,):
        raise InputError(f"{name} has shape {values.shape}; give a number or ({n},), one for each usable record")
    return values[rows]

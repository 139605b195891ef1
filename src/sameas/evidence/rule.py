"""The interface of decision rules, which turn pairs into evidence, sums of rules, and the errors that rules assume.

A rule gives exactly 0.0 for pairs that it cannot compare because one of the records has no value, so that
:attr:`Evidence.informative` is the mask of the pairs that it compares.

:class:`Errors` is the distribution of residuals relative to their quoted covariances.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.errors import InputError
from sameas.gate import Pairs
from sameas.records import Records
from sameas.representation import in_short


@in_short
@dataclass(frozen=True)
class Evidence:
    """Named terms, (m,) each, whose sum is the log likelihood ratio of every pair.

    log_error : (m,) standard error of that sum for rules that integrate numerically, None where it is exact to
        rounding; infinite where the sum is only a bound.
    precision : (m,) of rules that compare positions which both records measure with their own errors: the sum of the
        two precisions 1/σ², 0 for pairs that are not compared. It weights the pairs of sets of three records or more
        (:func:`sameas.many.rules.by_precision`); None for other rules.
    """

    terms: Mapping[str, FloatArray]
    log_error: FloatArray | None = None
    precision: FloatArray | None = None

    @property
    def log_ratio(self) -> FloatArray:
        """(m,) ln λ; summed at every call, so keep it for reuse."""
        parts = list(self.terms.values())
        return sum(parts[1:], parts[0])

    @cached_property
    def informative(self) -> BoolArray:
        """(m,) whether any term of the pair differs from exactly 0.0."""
        parts = [np.asarray(values != 0.0) for values in self.terms.values()]
        return parts[0] if len(parts) == 1 else np.logical_or.reduce(parts)


class Rule:
    """The interface of decision rules: a call from pairs to evidence, and a sum with other rules."""

    def __call__(self, pairs: Pairs) -> Evidence:
        raise TypeError(f"{type(self).__name__} is the interface of decision rules; use one of them")

    def __add__(self, other: Rule) -> Rule:
        if not isinstance(other, Rule):
            return NotImplemented
        return Sum((*self.parts(), *other.parts()))

    def parts(self) -> tuple[Rule, ...]:
        """The rules of which this one is the sum."""
        return (self,)


@dataclass(frozen=True)
class Sum(Rule):
    """Several rules for independent features."""

    rules: tuple[Rule, ...]

    def parts(self) -> tuple[Rule, ...]:
        return self.rules

    def __call__(self, pairs: Pairs) -> Evidence:
        terms: dict[str, FloatArray] = {}
        error: FloatArray | None = None
        for rule in self.rules:
            evidence = rule(pairs)
            for name, values in evidence.terms.items():
                terms[name] = terms[name] + values if name in terms else values
            if evidence.log_error is not None:
                error = evidence.log_error if error is None else np.hypot(error, evidence.log_error)
        return Evidence(terms, error)


#: Pairs in one batch, which fits into the cache.
BATCH = 16_384


@dataclass(frozen=True)
class Errors:
    """The distribution of residuals: a mixture of normals N(0, scale²·S), S = a₁²Σ₁ + a₂²Σ₂ + f²·1, Σ as quoted.

    ``Errors()`` takes the quoted errors as they are. With ``Errors(scales=(1.4, 6.0), shares=(0.95, 0.05))`` they are
    1.4 times too small, and one pair in twenty has errors 6 times larger than quoted (a heavy tail).
    ``Errors(floor=0.1)`` adds 0.1, in the unit of the residuals, in quadrature to every error.

    Parameters
    ----------
    scales, shares : of the normals of the mixture, relative to S.
    factor_1, factor_2 : a₁ and a₂, factors on the errors of the two sources.
    floor : f, standard deviation per axis of both sources together in addition to the quoted errors; a tuple if the
        axes have different units.
    added : variances per axis, (n_table,) by the rows of each source's table, in addition to these, or None; ignored in
        comparisons.

    Source: METHOD 6.
    """

    scales: tuple[float, ...] = (1.0,)
    shares: tuple[float, ...] = (1.0,)
    factor_1: float = 1.0
    factor_2: float = 1.0
    floor: float | tuple[float, ...] = 0.0
    added: tuple[FloatArray | None, FloatArray | None] = field(default=(None, None), repr=False, compare=False)

    def __post_init__(self) -> None:
        if len(self.scales) != len(self.shares) or not self.scales:
            raise InputError(
                f"Errors: {len(self.scales)} scales but {len(self.shares)} shares; give one share per scale"
            )
        positive = all(0.0 < scale < math.inf for scale in self.scales) and all(share >= 0.0 for share in self.shares)
        if not positive or abs(sum(self.shares) - 1.0) > 1e-6:
            raise InputError("Errors: scales must be positive, and shares non-negative with the sum 1")
        factors = 0.0 < self.factor_1 < math.inf and 0.0 < self.factor_2 < math.inf
        if not factors or not all(0.0 <= floor < math.inf for floor in np.atleast_1d(self.floor)):
            raise InputError(
                f"Errors: factors {self.factor_1} and {self.factor_2}, floor {self.floor}; give positive factors and a "
                "floor of 0 or more in the unit of the residuals"
            )

    @property
    def typical_scale(self) -> float:
        """The factor on the modelled errors, S, for the typical pair: the median scale."""
        order = np.argsort(self.scales)
        shares, logs = np.asarray(self.shares)[order], np.log(np.asarray(self.scales)[order])
        return float(np.exp(np.interp(0.5, np.cumsum(shares) - 0.5 * shares, logs)))

    @property
    def as_modelled(self) -> bool:
        """Whether S differs from the sum of the quoted covariances."""
        if self.factor_1 != 1.0 or self.factor_2 != 1.0 or any(variance is not None for variance in self.added):
            return True
        return self.floor != 0.0 if isinstance(self.floor, float) else bool(np.any(self.floor))

    def with_mixture(self, mixture: Errors) -> Errors:
        """The same S with the scales and shares of ``mixture``."""
        return replace(self, scales=mixture.scales, shares=mixture.shares)

    def records(self, first: Records, second: Records) -> tuple[Records, Records]:
        """Both sources with covariances whose sum is S; each gets half of the floor's variance."""
        if not self.as_modelled:
            return first, second
        half = 0.5 * np.asarray(self.floor) ** 2
        one, two = (
            half if more is None else half + more[records.rows, None]
            for records, more in zip((first, second), self.added, strict=True)
        )
        return first.with_errors(self.factor_1, one), second.with_errors(self.factor_2, two)

    def pairs(self, pairs: Pairs) -> Pairs:
        """The same candidates with distances, determinants and covariances by S."""
        return pairs.of(*self.records(pairs.first, pairs.second)) if self.as_modelled else pairs

    def typical_covariance(self, pairs: Pairs, some: IntArray) -> FloatArray:
        """(k, d, d) covariances of the residuals of some pairs (k,): S times :attr:`typical_scale` squared."""
        return self.typical_scale**2 * self.pairs(pairs.part(some)).covariance

    def log_density(self, pairs: Pairs) -> FloatArray:
        """(m,) ln of the density of the residuals [F14, T17, for one component of scale 1]."""
        modelled = self.pairs(pairs)
        if len(pairs) <= BATCH:
            return modelled.log_peaks(slice(None)) + self._profile(modelled.mahalanobis_sq, pairs.d)
        density = np.empty(len(pairs))
        for some in _batches(len(pairs)):
            density[some] = modelled.log_peaks(some) + self._profile(modelled.mahalanobis_sq[some], pairs.d)
        return density

    def log_profile(self, mahalanobis_sq: FloatArray, d: int) -> FloatArray:
        """(m,) ln Σ_k share_k scale_k^(−d) exp(−m²/(2 scale_k²)), which replaces −m²/2 of a single normal.

        mahalanobis_sq : (m,) m² by S.
        """
        profile = np.empty(len(mahalanobis_sq))
        for some in _batches(len(profile)):
            profile[some] = self._profile(mahalanobis_sq[some], d)
        return profile

    def _profile(self, mahalanobis_sq: FloatArray, d: int) -> FloatArray:
        """:meth:`log_profile` of a batch."""
        half = -0.5 * mahalanobis_sq
        if self.scales == (1.0,):
            return half
        components = [(scale, share) for scale, share in zip(self.scales, self.shares, strict=True) if share > 0.0]
        widest = max(scale for scale, _ in components)
        # Relative to the widest normal, densities neither overflow nor underflow.
        total = np.zeros(len(half))
        for scale, share in components:
            total += share * scale**-d * np.exp(half * (scale**-2 - widest**-2))
        return np.asarray(np.log(total) + half * widest**-2)


def _batches(n: int) -> Iterator[slice]:
    """Slices of n pairs that fit into the cache."""
    return (slice(begin, begin + BATCH) for begin in range(0, n, BATCH))


#: The quoted errors as they are.
AS_QUOTED = Errors()

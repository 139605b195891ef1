"""The gate: which pairs of records could be one object.

A pair is a *candidate* if its residual Δ is small relative to its own covariance Σ = Σ₁ + Σ₂ (METHOD 2). Each pair has
its own σ, so that a record with a large error neither widens the gate of others nor is lost.

- :class:`ChiSquare` (default): Δᵀ Σ⁻¹ Δ within the χ² quantile of a given completeness, the probability that the gate
  keeps a true pair.
- :class:`Radius`: Δᵀ Σ⁻¹ Δ ≤ k², a limit in standard deviations of the distance.
- :class:`Box`: |Δ_v| ≤ k σ_v in every feature, the papers' "three sigma" gate.

The gate is part of the model: pairs outside have probability zero. A wider gate than the default has no visible effect:
with a per-pair prior no probability changes by more than 1e-5 where groups are summed exactly (measured by
``benchmarks/gate.py``; 3σ changes them by up to 0.99). With a prior of the number of pairs, the gate determines which
records are counted, and no gate is wide enough. 3σ serves to reproduce the papers.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.errors import InputError
from sameas.gate.search import search
from sameas.gate.zones import DEFAULT_TUNING, Tuning
from sameas.gaussian import distance_and_log_determinant
from sameas.records import Records
from sameas.representation import in_short
from sameas.space import Sphere

# The χ² distribution: closed forms in two dimensions, SciPy's functions in others.
#
# SciPy is imported only where needed, because the import takes longer than many matches.


def quantile(share: float, d: int) -> float:
    """The squared length that a ``share`` of standard normal vectors in d dimensions does not exceed.

    >>> round(quantile(0.99, 2), 4)
    9.2103
    """
    if d == 2:
        return -2.0 * math.log1p(-share)
    from scipy.special import gammaincinv

    return 2.0 * float(gammaincinv(0.5 * d, share))


def upper_quantile(share: float, d: int) -> float:
    """The squared length that a ``share`` of standard normal vectors in d dimensions exceeds; exact for tiny shares."""
    if d == 2:
        return -2.0 * math.log(share)
    from scipy.special import gammainccinv

    return 2.0 * float(gammainccinv(0.5 * d, share))


#: Share of true pairs that the default gate keeps: 6.4σ in two dimensions.
DEFAULT_COMPLETENESS = 1.0 - 1e-9


@in_short
@dataclass(frozen=True)
class Pairs:
    """The candidates, in an order that depends on the records' content only, not on their rows.

    Attributes
    ----------
    place_1, place_2 : (m,) places of the two records in an order by content, in which near places are near in space.
    i, j : (m,) indices of the two records in ``first`` and ``second``.
    residual : (m, d) Δ = X₁ − X₂ in the space's residual unit.
    mahalanobis_sq : (m,) Δᵀ Σ⁻¹ Δ.
    determinant : (m,) |Σ|.
    gate : description of the gate, for the result.
    """

    first: Records
    second: Records
    place_1: NDArray[np.int32]
    place_2: NDArray[np.int32]
    i: NDArray[np.int32]
    j: NDArray[np.int32]
    residual: FloatArray
    mahalanobis_sq: FloatArray
    determinant: FloatArray
    gate: str

    def __post_init__(self) -> None:
        columns = (self.place_1, self.place_2, self.i, self.j, self.residual, self.mahalanobis_sq, self.determinant)
        if len({len(column) for column in columns}) != 1:
            raise InputError(f"pairs: columns of {', '.join(str(len(c)) for c in columns)} rows; cut all of them alike")

    def __len__(self) -> int:
        return len(self.i)

    @property
    def d(self) -> int:
        """Number of features of a residual."""
        return int(self.residual.shape[1])

    @cached_property
    def log_peak(self) -> FloatArray:
        """(m,) ln of the density at zero residual, −½ ln |2πΣ|."""
        return self.log_peaks(slice(None))

    def log_peaks(self, some: slice) -> FloatArray:
        """(k,) :attr:`log_peak` of some pairs, not cached."""
        return np.asarray(-0.5 * (np.log(self.determinant[some]) + self.d * math.log(2.0 * math.pi)))

    @cached_property
    def covariance(self) -> FloatArray:
        """(m, d, d) Σ of each residual, on the residual's axes."""
        return self._covariance(self.i, self.j)

    def covariance_of(self, some: IntArray) -> FloatArray:
        """(k, d, d) Σ of the residuals of some pairs (k,) only."""
        return self._covariance(self.i[some], self.j[some])

    def same_records(self, other: Pairs) -> bool:
        """Whether ``other`` has the same record objects."""
        return self.first is other.first and self.second is other.second

    def part(self, kept: BoolArray | IntArray) -> Pairs:
        """Some of the candidates, with the same records."""
        columns = ("place_1", "place_2", "i", "j", "residual", "mahalanobis_sq", "determinant")
        return replace(self, **{name: getattr(self, name)[kept] for name in columns})

    def of(self, first: Records, second: Records) -> Pairs:
        """The same candidates with the errors of these records, which must otherwise be the same."""
        pairs = replace(self, first=first, second=second)
        distance_sq, log_determinant = distance_and_log_determinant(self.residual, pairs.covariance)
        return replace(pairs, mahalanobis_sq=distance_sq, determinant=np.exp(log_determinant))

    def _covariance(self, i: NDArray[np.int32], j: NDArray[np.int32]) -> FloatArray:
        out = np.empty((len(i), self.d, self.d))
        a, b = self.first, self.second
        if isinstance(a.space, Sphere) and a.covariance.shape[1] == b.covariance.shape[1] == 1:
            out[:] = 0.0
            out[:, 0, 0] = out[:, 1, 1] = a.covariance[i, 0] + b.covariance[j, 0]  # circles need no rotation
        elif isinstance(a.space, Sphere):
            from sameas.kernels.search import sphere_covariances

            sphere_covariances(a.features, a.covariance, b.features, b.covariance, i, j, out)
        else:
            from sameas.kernels.search import plane_covariances

            plane_covariances(a.covariance, b.covariance, i, j, out)
        return out


@in_short
@dataclass(frozen=True)
class ChiSquare:
    """Δᵀ Σ⁻¹ Δ within the χ² quantile of ``completeness``, the probability of keeping a true pair."""

    completeness: float = DEFAULT_COMPLETENESS
    tuning: Tuning = field(default=DEFAULT_TUNING, repr=False)

    def __post_init__(self) -> None:
        if not 0.0 < self.completeness < 1.0:
            raise InputError(f"gate: completeness is {self.completeness}; give a probability between 0 and 1")

    def limit(self, d: int) -> float:
        """The χ² quantile for d features."""
        return upper_quantile(1.0 - self.completeness, d)

    def __call__(self, first: Records, second: Records) -> Pairs:
        limit = self.limit(feature_count(first, second))
        description = f"χ² ≤ {limit:.2f} (loses {1 - self.completeness:.1e} of the true)"
        return _candidates(first, second, limit, False, description, self.tuning)


DEFAULT_GATE = ChiSquare()


@in_short
@dataclass(frozen=True)
class Radius:
    """Mahalanobis distance within ``sigmas``: Δᵀ Σ⁻¹ Δ ≤ sigmas²."""

    sigmas: float
    tuning: Tuning = field(default=DEFAULT_TUNING, repr=False)

    def __post_init__(self) -> None:
        if not 0.0 < self.sigmas < math.inf:
            raise InputError(f"gate: sigmas is {self.sigmas}; give a positive number")

    def __call__(self, first: Records, second: Records) -> Pairs:
        return _candidates(first, second, self.sigmas**2, False, f"distance ≤ {self.sigmas:g} σ", self.tuning)


@in_short
@dataclass(frozen=True)
class Box:
    """|Δ_v| ≤ ``sigmas``·σ_v in every feature v, the gate of both papers (3σ)."""

    sigmas: float = 3.0
    tuning: Tuning = field(default=DEFAULT_TUNING, repr=False)

    def __post_init__(self) -> None:
        if not 0.0 < self.sigmas < math.inf:
            raise InputError(f"gate: sigmas is {self.sigmas}; give a positive number")

    def __call__(self, first: Records, second: Records) -> Pairs:
        return _candidates(first, second, self.sigmas**2, True, f"each feature within {self.sigmas:g} σ", self.tuning)


def feature_count(first: Records, second: Records) -> int:
    """The number of features of two sources, which must be in one space."""
    for source in (first, second):
        if not isinstance(source, Records):
            raise InputError(f"a source is a {type(source).__name__}; make it with Records.of(features, sigma=…)")
    if first.d != second.d or first.space != second.space:
        raise InputError(
            f"{first.source} has {first.d} features in {first.space}, {second.source} {second.d} in {second.space}; "
            "bring both to one feature space"
        )
    return first.d


def _candidates(first: Records, second: Records, limit: float, box: bool, description: str, tuning: Tuning) -> Pairs:
    feature_count(first, second)
    return Pairs(first, second, *search(first, second, limit, box, tuning), gate=description)

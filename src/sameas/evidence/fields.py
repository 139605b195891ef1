"""Field rules: a different object lies anywhere, with a density that is constant or known at every record."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from sameas.arrays import FloatArray, taken
from sameas.errors import InputError
from sameas.evidence.rule import AS_QUOTED, Errors, Evidence, Rule
from sameas.gate import Pairs
from sameas.kernels import threads
from sameas.representation import in_short


@in_short
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
            {"position": AS_QUOTED.log_density(pairs), "elsewhere": np.broadcast_to(-np.log(density), len(pairs))}
        )


@in_short
@dataclass(frozen=True)
class PoissonField(Rule):
    """Objects are a Poisson field: λ·odds = ρ₁₂ N(Δ; 0, Σ) / (ρ₁ ρ₂) with the densities below (METHOD 4.3).

    With objects of density ρ that the sources miss with q₁, q₂: ρ₁₂ = ρ(1−q₁)(1−q₂), ρ₁ = ρ(1−q₁)q₂, ρ₂ = ρq₁(1−q₂);
    false records add to ρ₁, ρ₂. The rule gives posterior log-odds before one-to-one: combine it with ``PerPair(0)``.

    Parameters
    ----------
    common : ρ₁₂, density of objects that both sources show; a number, or a pair of arrays (n₁,), (n₂,) at the records
        of each source, whose geometric mean is used for a pair.
    only_1, only_2 : densities of records that only one source shows; numbers, or (n₁,) and (n₂,).
        Unit: 1 / (unit of the residual)^d.
    errors : distribution of the residuals relative to the quoted covariances.
    """

    common: ArrayLike | tuple[FloatArray, FloatArray]
    only_1: ArrayLike
    only_2: ArrayLike
    errors: Errors = AS_QUOTED

    def __call__(self, pairs: Pairs) -> Evidence:
        # Logarithms are taken once per record, not per pair.
        both = isinstance(self.common, tuple)
        common = self.common if isinstance(self.common, tuple) else (self.common, self.common)
        log_1 = _log_weight(common[0], self.only_1, len(pairs.first), ("common[0]" if both else "common", "only_1"))
        log_2 = _log_weight(common[1], self.only_2, len(pairs.second), ("common[1]" if both else "common", "only_2"))
        works = partial(self.errors.log_density, pairs), partial(_sum_of_both, log_1, log_2, pairs)
        position, densities = threads.both(*works, len(pairs))
        return Evidence({"position": position, "densities": densities})


@dataclass(frozen=True)
class ConstantCost(Rule):
    """Every unmatched record costs the constant density C: a pair scores ln N − 2 ln C (METHOD 3.4 [F15–F17])."""

    c: float

    def __post_init__(self) -> None:
        if not 0.0 < self.c < math.inf:
            raise InputError(f"ConstantCost: C is {self.c}; give a positive density in 1/(unit of the features)^(d/2)")

    @staticmethod
    def calibrated(detection_probability: ArrayLike, density: ArrayLike) -> DetectionField:
        """The calibrated form, C² = β(1 − P_d)/P_d, with P_d and β as numbers or per record."""
        return DetectionField(detection_probability, density)

    def __call__(self, pairs: Pairs) -> Evidence:
        return Evidence(
            {"position": AS_QUOTED.log_density(pairs), "cost": np.full(len(pairs), -2.0 * math.log(self.c))}
        )


@in_short
@dataclass(frozen=True)
class DetectionField(Rule):
    """λ·odds = P_d N(Δ; 0, Σ) / [(1 − P_d) β]: measurements of source 1 against records of source 2 (METHOD 3.4).

    detection_probability : P_d, the probability that source 1 shows record j; a number or (n₂,).
    density : β of measurements of other objects and false ones, per unit volume; a number or (n₁,).
    """

    detection_probability: ArrayLike
    density: ArrayLike

    def __call__(self, pairs: Pairs) -> Evidence:
        p_d = _at(self.detection_probability, len(pairs.second), pairs.j, "detection_probability")
        if np.any(p_d >= 1.0):
            raise InputError("detection_probability is 1 or more; give the probability of a detection, below 1")
        density = _at(self.density, len(pairs.first), pairs.i, "density")
        odds = np.log(p_d) - np.log1p(-p_d) - np.log(density)
        return Evidence({"position": AS_QUOTED.log_density(pairs), "detection": np.broadcast_to(odds, len(pairs))})


def _at(value: ArrayLike, n: int, rows: np.ndarray, name: str) -> FloatArray:
    """The positive, finite number, or the values (n,) at the pairs' records."""
    values = _positive(value, n, name)
    return values if values.ndim == 0 else values[rows]


def _sum_of_both(log_1: FloatArray, log_2: FloatArray, pairs: Pairs) -> FloatArray:
    """(m,) the sum of the values of both records of each pair; numbers, or (n₁,) and (n₂,)."""
    total = (log_1 if log_1.ndim == 0 else taken(log_1, pairs.i)) + (
        log_2 if log_2.ndim == 0 else taken(log_2, pairs.j)
    )
    return total if total.ndim else np.full(len(pairs), total)


def _log_weight(common: ArrayLike, only: ArrayLike, n: int, names: tuple[str, str]) -> FloatArray:
    """ln √common / only; numbers or (n,)."""
    if type(common) is float and type(only) is float and 0.0 < common < math.inf and 0.0 < only < math.inf:
        # Ten times faster than NumPy for one number.
        return np.float64(0.5 * math.log(common) - math.log(only))
    with np.errstate(all="ignore"):
        weight = np.asarray(np.log(np.sqrt(common) / np.asarray(only)))
    if weight.shape in ((), (n,)) and np.isfinite(weight).all():
        return weight
    both, alone = (
        _positive(value, n, f"PoissonField: {name}") for value, name in zip((common, only), names, strict=True)
    )
    return np.asarray(0.5 * np.log(both) - np.log(alone))


def _positive(value: ArrayLike, n: int, name: str) -> FloatArray:
    """The number or values (n,); refused if not positive and finite."""
    if isinstance(value, float) and 0.0 < value < math.inf:
        return np.float64(value)
    values = np.asarray(value, dtype=np.float64)
    if not np.all((values > 0) & (values < np.inf)):
        raise InputError(f"{name} is zero, negative or not finite; give positive numbers in the unit of the residual")
    if values.ndim and values.shape != (n,):
        raise InputError(f"{name} has shape {values.shape}; give a number or ({n},), one for each usable record")
    return values

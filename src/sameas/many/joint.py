"""The joint density of the records of one object, and the object's fused state.

Records z_i = h_i(x) + v_i, v_i ~ N(0, R_i), of one object of unknown state x: with h_i linear about a point x₀,
residuals r_i = z_i − h_i(x₀), H_i = ∂h_i/∂x, and the information P₀⁻¹ of a region (0 where there is none),

    Λ = P₀⁻¹ + Σ H_iᵀ R_i⁻¹ H_i,   η = P₀⁻¹(μ₀ − x₀) + Σ H_iᵀ R_i⁻¹ r_i,   x̂ = x₀ + Λ⁻¹ η,
    χ² = (μ₀ − x₀)ᵀ P₀⁻¹ (μ₀ − x₀) + Σ r_iᵀ R_i⁻¹ r_i − ηᵀ Λ⁻¹ η,
    ln J = ½ L ln 2π − ½ ln|Λ| − ½ Σ ln|2π R_i| − ½ χ².

J is ∫ exp(−½ (x−μ₀)ᵀ P₀⁻¹ (x−μ₀)) ∏ N(z_i; h_i(x), R_i) dx: exact if h_i is linear, otherwise Laplace's approximation
at the best x̂ (Gauss–Newton steps). For records of the whole state and no region, ln J of a pair is ln N(Δ; 0, Σ₁ + Σ₂)
and ln J of one record is 0. A component of the state that no record of the set observes keeps the region's spread; with
P₀⁻¹ = 0, Λ would be singular, so sources that observe a part need a region.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import FloatArray
from sameas.errors import InputError
from sameas.gaussian import InformationSum, inverse, log_density, propagated
from sameas.many.observations import LinearPart, Observations, Region, Source, records_of
from sameas.records import Records
from sameas.representation import in_short
from sameas.space import Plane, Sphere, displaced, on_axes_of

#: Gauss–Newton steps if a source's part is not linear (chosen).
STEPS = 4
#: Stands in sets of records for a source that has no record in the set.
NO_RECORD = -1


@in_short
@dataclass(frozen=True)
class Joint:
    """Per set: ``log_density`` ln J (k,), ``chi_sq`` (k,), ``state`` (k, L) and its ``covariance`` (k, L, L)."""

    log_density: FloatArray
    chi_sq: FloatArray
    state: FloatArray
    covariance: FloatArray


@dataclass(frozen=True)
class Observers:
    """Sources that observe one state. ``sets`` (k, S) have the row of each source's record, or :data:`NO_RECORD`."""

    sources: tuple[Source, ...]
    region: Region | None = None

    @cached_property
    def dimension(self) -> int:
        """L, number of components of the state; refuses sources that differ in it or in space, or lack a region."""
        sizes = [source.dimension if isinstance(source, Observations) else source.d for source in self.sources]
        spaces = {source.space for source in self.sources if isinstance(source, Records)}
        if len(set(sizes)) > 1 or len(spaces) > 1:
            listed = ", ".join(f"{records_of(s).source}: {n}" for s, n in zip(self.sources, sizes, strict=True))
            raise InputError(
                f"the sources observe states of different size or space ({listed}); bring all to one feature space, "
                "or say with Observations which part of the state a source sees"
            )
        if self.region is None and len(self.whole) < len(self.sources):
            partial = next(records_of(s).source for s in self.sources if isinstance(s, Observations))
            raise InputError(f"{partial} observes a part of the state; give region=Region(centre, spread)")
        if self.region is not None and (len(np.asarray(self.region.centre)) != sizes[0] or Sphere() in spaces):
            raise InputError(f"the region must be in a Plane of the state's {sizes[0]} components")
        return sizes[0]

    @cached_property
    def whole(self) -> tuple[int, ...]:
        """The sources that observe the whole state."""
        return tuple(s for s, source in enumerate(self.sources) if isinstance(source, Records))

    @cached_property
    def _precision(self) -> list[tuple[FloatArray, FloatArray]]:
        """Per source R⁻¹ (n, m, m) and −½ ln|2π R| (n,) of its records."""
        out = []
        for source in self.sources:
            records = records_of(source)
            full = records.full_covariance()
            out.append((inverse(full), log_density(np.zeros(records.d), full)))
        return out

    def precision(self, s: int) -> FloatArray:
        """(n, m, m) R⁻¹ of the records of source s."""
        return self._precision[s][0]

    def log_peak(self, s: int) -> FloatArray:
        """(n,) −½ ln|2π R|, the most that a record of source s can add to ln J of a set."""
        return self._precision[s][1]

    def joint(self, sets: NDArray[np.integer]) -> Joint:
        """Density and state of ``sets`` (k, sources)."""
        at = self._anchors(sets)
        linear = all(isinstance(s, Records) or isinstance(s.part, LinearPart) for s in self.sources)
        for _ in range(0 if linear else STEPS):
            at = at + self._summed(sets, at).gaussian().mean
        summed = self._summed(sets, at)
        step = summed.gaussian()
        chi_sq = summed.chi_sq(step)
        return Joint(summed.log_peak() - 0.5 * chi_sq, chi_sq, self._moved(at, step.mean), step.covariance)

    def _anchors(self, sets: NDArray[np.integer]) -> FloatArray:
        """(k, L) the point x₀ of each set: its first record of the whole state, else the region's centre."""
        at = np.zeros((len(sets), self.dimension))
        if self.region is not None:
            at[:] = self.region.centre
        missing = np.ones(len(sets), bool)
        for s in self.whole:
            added = missing & (sets[:, s] != NO_RECORD)
            at[added] = records_of(self.sources[s]).features[sets[added, s]]
            missing &= ~added
        return at

    def _summed(self, sets: NDArray[np.integer], at: FloatArray) -> InformationSum:
        """The information of records and region on the states, about the points ``at`` (k, L)."""
        total = InformationSum.of(len(sets), self.dimension)
        if self.region is not None:
            prior = np.broadcast_to(inverse(np.asarray(self.region.covariance)), total.information.shape)
            total.add(np.arange(len(sets)), np.asarray(self.region.centre) - at, prior, np.zeros(len(sets)))
        for s in range(len(self.sources)):
            k = np.flatnonzero(sets[:, s] != NO_RECORD)
            rows = sets[k, s]
            residual, precision, slope = self._residuals(s, rows, at[k])
            total.add(k, residual, precision, self._precision[s][1][rows], slope)
        return total

    def _residuals(
        self, s: int, rows: NDArray[np.integer], at: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray | None]:
        """Residuals (k, m) of records from the states ``at``, their precisions, and the Jacobians H (None for 1)."""
        source = self.sources[s]
        precision = self._precision[s][0][rows]
        records = records_of(source)
        if isinstance(source, Observations):
            return (
                _wrapped(records.features[rows] - source.part(at), records.space),
                precision,
                source.part.jacobian(at),
            )
        if isinstance(records.space, Plane):
            return _wrapped(records.features[rows] - at, records.space), precision, None
        offset, rotation = on_axes_of(at, records.features[rows])
        return offset, propagated(rotation, precision), None

    def _moved(self, at: FloatArray, step: FloatArray) -> FloatArray:
        """The states ``at`` + ``step``, periodic features reduced to their period."""
        if not self.whole:
            return at + step
        space = records_of(self.sources[self.whole[0]]).space
        if isinstance(space, Sphere):
            return displaced(at, step)
        moved = at + step
        periods = np.array(space.period_list(self.dimension))
        wraps = np.isfinite(periods)
        moved[:, wraps] %= periods[wraps]
        return moved


def joint_density(sources: Sequence[Source], sets: NDArray[np.integer], region: Region | None = None) -> Joint:
    """Joint density and state of sets of records (k, S); see :class:`Observers`."""
    return Observers(tuple(sources), region).joint(sets)


def _wrapped(delta: FloatArray, space: Plane | Sphere) -> FloatArray:
    """Differences reduced to half a period either way, for periodic features; in place."""
    assert isinstance(space, Plane)
    for v, period in enumerate(space.periods or ()):
        if period is not None:
            delta[:, v] -= period * np.ceil(delta[:, v] / period - 0.5)
    return delta

"""The joint density of the records of one object, and the object's state that goes with it.

Records z_i = h_i(x) + v_i, v_i ~ N(0, R_i), of one object of unknown state x: with h_i linear about a point x₀,
residuals r_i = z_i − h_i(x₀), H_i = ∂h_i/∂x, and the information P₀⁻¹ of a region (0 where there is none),

    Λ = P₀⁻¹ + Σ H_iᵀ R_i⁻¹ H_i,   η = P₀⁻¹(μ₀ − x₀) + Σ H_iᵀ R_i⁻¹ r_i,   x̂ = x₀ + Λ⁻¹ η,
    χ² = (μ₀ − x₀)ᵀ P₀⁻¹ (μ₀ − x₀) + Σ r_iᵀ R_i⁻¹ r_i − ηᵀ Λ⁻¹ η,
    ln J = ½ L ln 2π − ½ ln|Λ| − ½ Σ ln|2π R_i| − ½ χ².

J is ∫ exp(−½ (x−μ₀)ᵀ P₀⁻¹ (x−μ₀)) ∏ N(z_i; h_i(x), R_i) dx: exact where h_i is linear, Laplace's approximation at the
best x̂ (Gauss and Newton's steps) where it is not. For records of the whole state and no region, ln J of a pair is
ln N(Δ; 0, Σ₁ + Σ₂) and ln J of one record is 0. A part of the state that no record of the set sees keeps the region's
spread: with P₀⁻¹ = 0 its Λ would be singular, which is why parts need a region.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import FloatArray
from sameas.errors import InputError
from sameas.evidence import LOG_2PI
from sameas.many.observations import LinearPart, Observations, Region, Source, records_of
from sameas.records import Records
from sameas.space import Plane, Sphere, displaced, sphere_offset

#: Steps of Gauss and Newton where a source's part is not linear.
STEPS = 4


@dataclass(frozen=True)
class Joint:
    """Per set: ``log_density`` ln J (k,), ``chi_sq`` (k,), ``state`` (k, L) and its ``covariance`` (k, L, L)."""

    log_density: FloatArray
    chi_sq: FloatArray
    state: FloatArray
    covariance: NDArray


@dataclass(frozen=True)
class Observers:
    """Several sources as observers of one state; ``sets`` name their records by position, −1 for none."""

    sources: tuple[Source, ...]
    region: Region | None = None

    @cached_property
    def dimension(self) -> int:
        """L, the same for all sources."""
        sizes = [source.dimension if isinstance(source, Observations) else source.d for source in self.sources]
        spaces = {source.space for source in self.sources if isinstance(source, Records)}
        if len(set(sizes)) > 1 or len(spaces) > 1:
            said = ", ".join(f"{records_of(s).source}: {n}" for s, n in zip(self.sources, sizes, strict=True))
            raise InputError(
                f"the sources observe states of different size or space ({said}); bring all to one feature space, "
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
        """Which sources observe the whole state."""
        return tuple(s for s, source in enumerate(self.sources) if isinstance(source, Records))

    @cached_property
    def _precision(self) -> list[tuple[NDArray, NDArray]]:
        """Per source R⁻¹ (n, m, m) and −½ ln|2π R| (n,) of its records."""
        out = []
        for source in self.sources:
            records = records_of(source)
            full = records.full_covariance()
            out.append((np.linalg.inv(full), -0.5 * (records.d * LOG_2PI + np.linalg.slogdet(full)[1])))
        return out

    def log_peak(self, s: int) -> FloatArray:
        """(n,) −½ ln|2π R|: no set gains more by a record of source s."""
        return self._precision[s][1]

    def joint(self, sets: NDArray[np.integer]) -> Joint:
        """Density and state of ``sets`` (k, sources)."""
        at = self._anchors(sets)
        linear = all(isinstance(s, Records) or isinstance(s.part, LinearPart) for s in self.sources)
        for _ in range(0 if linear else STEPS):
            information, vector, _, _ = self._summed(sets, at)
            at = at + np.linalg.solve(information, vector[..., None])[..., 0]
        information, vector, square, log_norm = self._summed(sets, at)
        covariance = np.linalg.inv(information)
        covariance = 0.5 * (covariance + covariance.transpose(0, 2, 1))
        step = np.einsum("kvw,kw->kv", covariance, vector)
        chi_sq = np.maximum(square - np.einsum("kv,kv->k", vector, step), 0.0)
        log_det = np.linalg.slogdet(information)[1]
        log_density = log_norm + 0.5 * (self.dimension * LOG_2PI - log_det - chi_sq)
        return Joint(log_density, chi_sq, self._moved(at, step), covariance)

    def _anchors(self, sets: NDArray[np.integer]) -> FloatArray:
        """(k, L) the point about which each set is summed: its first record of the whole state, else the region's."""
        at = np.zeros((len(sets), self.dimension))
        if self.region is not None:
            at[:] = self.region.centre
        open_ = np.ones(len(sets), bool)
        for s in self.whole:
            here = open_ & (sets[:, s] >= 0)
            at[here] = records_of(self.sources[s]).features[sets[here, s]]
            open_ &= ~here
        return at

    def _summed(
        self, sets: NDArray[np.integer], at: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Information (k, L, L), vector (k, L), square (k,) and ln norm (k,) of the sets about the points ``at``."""
        size = self.dimension
        information, vector = np.zeros((len(sets), size, size)), np.zeros((len(sets), size))
        square, log_norm = np.zeros(len(sets)), np.zeros(len(sets))
        if self.region is not None:
            prior = np.linalg.inv(self.region.covariance)
            away = np.asarray(self.region.centre) - at
            information += prior
            vector += away @ prior
            square += np.einsum("kv,vw,kw->k", away, prior, away)
        for s in range(len(self.sources)):
            k = np.flatnonzero(sets[:, s] >= 0)
            rows = sets[k, s]
            residual, precision, slope = self._seen(s, rows, at[k])
            weighted = np.einsum("kvw,kw->kv", precision, residual)
            square[k] += np.einsum("kv,kv->k", residual, weighted)
            log_norm[k] += self._precision[s][1][rows]
            if slope is None:
                information[k] += precision
                vector[k] += weighted
            else:
                information[k] += np.einsum("kmv,kmn,knw->kvw", slope, precision, slope)
                vector[k] += np.einsum("kmv,km->kv", slope, weighted)
        return information, vector, square, log_norm

    def _seen(
        self, s: int, rows: NDArray[np.integer], at: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray | None]:
        """Residuals (k, m) of records against the states ``at``, their precisions, and the slopes H (None for 1)."""
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
        return (*_on_axes_of(at, records.features[rows], precision), None)

    def _moved(self, at: FloatArray, step: FloatArray) -> FloatArray:
        """The states ``at`` moved by ``step``; periodic features come back within their period."""
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


def pooled(sources: Sequence[Source], sets: NDArray[np.integer], region: Region | None = None) -> Joint:
    """Joint density and state of sets of records; see :class:`Observers`."""
    return Observers(tuple(sources), region).joint(sets)


def _wrapped(delta: FloatArray, space: Plane | Sphere) -> FloatArray:
    """Differences brought within half a period, where features have one."""
    assert isinstance(space, Plane)
    for v, period in enumerate(space.periods or ()):
        if period is not None:
            delta[:, v] -= period * np.ceil(delta[:, v] / period - 0.5)
    return delta


def _on_axes_of(at: FloatArray, direction: FloatArray, precision: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Offsets of directions from ``at`` (k, 2) in arcsec, and their precisions, on the axes of ``at``."""
    offset = sphere_offset(direction[:, 0], direction[:, 1], at[:, 0], at[:, 1])
    turn = direction[:, 0] - at[:, 0]
    half_lon = np.radians(turn - 360.0 * np.round(turn / 360.0)) / 2.0
    half_lat, middle = np.radians(direction[:, 1] - at[:, 1]) / 2.0, np.radians(direction[:, 1] + at[:, 1]) / 2.0
    # θ/2 of :class:`Sphere`: the offset lies on axes halfway, the precision on those of the record.
    half = np.arctan2(np.sin(half_lon) * np.sin(middle), np.cos(half_lon) * np.cos(half_lat))
    full = _turn(-2.0 * half)
    return np.einsum("kvw,kw->kv", _turn(-half), offset), full @ precision @ full.transpose(0, 2, 1)


def _turn(angle: FloatArray) -> FloatArray:
    """(k, 2, 2) matrices that add ``angle`` to the position angle of (east, north)."""
    sine, cosine = np.sin(angle), np.cos(angle)
    return np.stack([cosine, sine, -sine, cosine], axis=1).reshape(-1, 2, 2)

"""Observations: records that observe the state of an object or a part of it, and their joint density and fused state.

Plain :class:`~sameas.records.Records` observe the whole state, their features. :class:`Observations` observe a part of
it: a bearing without distance, a position without velocity. The part is a strategy: :class:`LinearPart` for
z = H x + c, :class:`Bearing` for a direction from a known position. Your own needs ``dimension``, a call from states
(n, L) to observations (n, m), and ``jacobian`` from states to (n, m, L).

A record of a part leaves the rest of the state undetermined. A :class:`Region`, a broad normal density of objects,
determines it: every set of records then has a finite density. For a set that observes the whole state, the region's
effect vanishes as it widens.

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
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sameas.arrays import ABSENT, FloatArray
from sameas.errors import InputError
from sameas.gaussian import InformationSum, inverse, log_density, propagated
from sameas.records import Records
from sameas.representation import in_short
from sameas.space import Plane, Sphere, displaced, folded, on_axes_of, wrapped


class StatePart(Protocol):
    """The part of a state that a source observes."""

    @property
    def dimension(self) -> int:
        """L, the number of components of the state."""

    def __call__(self, states: FloatArray) -> FloatArray:
        """(n, m) error-free observations of states (n, L)."""

    def jacobian(self, states: FloatArray) -> FloatArray:
        """(n, m, L) their derivatives."""


@in_short
@dataclass(frozen=True)
class LinearPart:
    """z = H x + c: ``matrix`` H (m, L) and ``offset`` c (m,) or a number."""

    matrix: ArrayLike
    offset: ArrayLike = 0.0

    def __post_init__(self) -> None:
        matrix = np.asarray(self.matrix, dtype=np.float64)
        if matrix.ndim != 2 or not np.isfinite(matrix).all():
            raise InputError(f"LinearPart: matrix has shape {matrix.shape}; give finite numbers, (features, state)")
        object.__setattr__(self, "matrix", matrix)
        object.__setattr__(self, "offset", np.broadcast_to(np.asarray(self.offset, np.float64), matrix.shape[:1]))

    @property
    def dimension(self) -> int:
        return int(np.shape(self.matrix)[1])

    def __call__(self, states: FloatArray) -> FloatArray:
        return np.asarray(states @ np.asarray(self.matrix).T + self.offset)

    def jacobian(self, states: FloatArray) -> FloatArray:
        return np.broadcast_to(np.asarray(self.matrix), (len(states), *np.shape(self.matrix)))


@dataclass(frozen=True)
class Bearing:
    """The bearing of the state's first two components (east, north) from a sensor: degrees, clockwise from north.

    Its records need ``space=Plane(periods=(360.0,))``, so that 359° and 1° are near each other.

    Parameters
    ----------
    sensor : (east, north) of the sensor, in the unit of the state.
    dimension : number of components of the state, 2 or more.
    """

    sensor: tuple[float, float]
    dimension: int = 2

    def __call__(self, states: FloatArray) -> FloatArray:
        east, north = (states[:, :2] - np.asarray(self.sensor)).T
        return np.asarray(np.degrees(np.arctan2(east, north))[:, None] % 360.0)

    def jacobian(self, states: FloatArray) -> FloatArray:
        east, north = (states[:, :2] - np.asarray(self.sensor)).T
        # There is no bearing at the sensor itself; a tiny distance keeps the numbers finite.
        range_sq = np.maximum(east**2 + north**2, 1e-12)
        slope = np.zeros((len(states), 1, self.dimension))
        slope[:, 0, 0], slope[:, 0, 1] = np.degrees(north / range_sq), np.degrees(-east / range_sq)
        return slope


@in_short
@dataclass(frozen=True)
class Observations:
    """The records of a source that observes a ``part`` of the objects' state.

    >>> from sameas.records import Records
    >>> camera = Records.of([[44.0], [352.0]], sigma=0.5, space=Plane(periods=(360.0,)), source="camera")
    >>> Observations(camera, Bearing(sensor=(0.0, 0.0))).dimension
    2
    """

    records: Records
    part: StatePart

    def __post_init__(self) -> None:
        if not isinstance(self.records, Records):
            raise InputError(f"Observations: records are a {type(self.records).__name__}; make them with Records.of(…)")
        jacobian = self.part.jacobian(np.ones((1, self.part.dimension)))
        if not isinstance(self.records.space, Plane):
            raise InputError(f"{self.records.source}: parts of a state are seen in a Plane; bring the records to one")
        if jacobian.shape != (1, self.records.d, self.part.dimension):
            _, features, components = jacobian.shape
            raise InputError(
                f"{self.records.source}: its part gives {features} features of {components} components, "
                f"its records have {self.records.d} features; give a matrix (features, state)"
            )

    @property
    def dimension(self) -> int:
        """L, the number of components of the state."""
        return self.part.dimension


@in_short
@dataclass(frozen=True)
class Region:
    """Where objects are: a normal density ∝ exp(−½ (x−centre)ᵀ covariance⁻¹ (x−centre)).

    centre : (L,). spread : (L,) standard deviations of the components, or an (L, L) covariance.
    """

    centre: ArrayLike
    spread: ArrayLike

    def __post_init__(self) -> None:
        centre = np.atleast_1d(np.asarray(self.centre, dtype=np.float64))
        object.__setattr__(self, "centre", centre)
        covariance = self.covariance
        if centre.ndim != 1 or covariance.shape != (len(centre), len(centre)):
            shapes = f"centre {centre.shape}, spread {np.shape(self.spread)}"
            raise InputError(f"Region: {shapes}; give (L,) and (L,) or (L, L)")
        if not (np.isfinite(covariance).all() and np.linalg.eigvalsh(covariance)[0] > 0):
            raise InputError("Region: the covariance is not positive definite; give the spread of the objects' states")

    @property
    def covariance(self) -> FloatArray:
        """(L, L) of the states."""
        spread = np.atleast_1d(np.asarray(self.spread, dtype=np.float64))
        if spread.ndim > 1:
            return spread
        return np.diag(np.broadcast_to(spread, (np.size(self.centre),)) ** 2)


Source = Records | Observations


def records_of(source: Source) -> Records:
    """The records of a source, whether it observes the whole state or a part."""
    return source.records if isinstance(source, Observations) else source


#: Gauss–Newton steps if a source's part is not linear (chosen).
STEPS = 4


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
    """Sources that observe one state. ``sets`` (k, S) have the row of each source's record, or ABSENT."""

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
            added = missing & (sets[:, s] != ABSENT)
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
            k = np.flatnonzero(sets[:, s] != ABSENT)
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
            assert isinstance(records.space, Plane)
            residual = records.features[rows] - source.part(at)
            return wrapped(residual, records.space.period_list(records.d)), precision, source.part.jacobian(at)
        if isinstance(records.space, Plane):
            return wrapped(records.features[rows] - at, records.space.period_list(records.d)), precision, None
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
        for v, period in enumerate(space.periods or ()):
            if period is not None:
                moved[:, v] = folded(moved[:, v], period)
        return moved


def joint_density(sources: Sequence[Source], sets: NDArray[np.integer], region: Region | None) -> Joint:
    """Joint density and state of sets of records (k, S); see :class:`Observers`."""
    return Observers(tuple(sources), region).joint(sets)

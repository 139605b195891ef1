"""Observations: records of a source that observes a part of the objects' state.

Plain :class:`~sameas.records.Records` observe the whole state, their features. :class:`Observations` observe a part of
it: a bearing without distance, a position without velocity. The part is a strategy: :class:`LinearPart` for
z = H x + c, :class:`Bearing` for a direction from a known position. Your own needs ``dimension``, a call from states
(n, L) to observations (n, m), and ``jacobian`` from states to (n, m, L).

A record of a part leaves the rest of the state undetermined. A :class:`Region`, a broad normal density of objects,
determines it: every set of records then has a finite density. For a set that observes the whole state, the region's
effect vanishes as it widens.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from sameas.arrays import FloatArray
from sameas.errors import InputError
from sameas.records import Records
from sameas.representation import in_short
from sameas.space import Plane


class Part(Protocol):
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
    part: Part

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

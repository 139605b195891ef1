"""Cells of equal size over two sources, coarse to fine."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import FloatArray, IntArray
from sameas.records import Records
from sameas.representation import in_short
from sameas.space import ARCSEC_PER_RADIAN, Sphere

#: Cells get finer by this factor in volume, until most records of the richer source share theirs with hardly more than
#: so many,
REFINEMENT = 8.0
FINEST = 12.0
#: and no further than to so many cells a record: records at one and the same place are never told apart.
CELLS_PER_RECORD = 4096.0

#: The cell of every record of either source, how many cells there are, and a function from cells to their volumes.
Cut = tuple[IntArray, IntArray, int, Callable[[IntArray], FloatArray]]


@in_short
@dataclass(frozen=True)
class GridLevel:
    """Cells of one size: the cell of every record of both sources, and the volume of each cell.

    Cells are numbered as they occur. These numbers are half as wide as need be, and so half as much to fetch, level
    after level and round after round.
    """

    of_first: NDArray[np.int32]
    of_second: NDArray[np.int32]
    volume: FloatArray

    def facing(self, source: int) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """The cells of the records of ``source`` (1 or 2), and of the other's."""
        return (self.of_first, self.of_second) if source == 1 else (self.of_second, self.of_first)

    def part(self, rows_1: IntArray, rows_2: IntArray) -> GridLevel:
        """The same cells, for some of the records."""
        return GridLevel(self.of_first[rows_1], self.of_second[rows_2], self.volume)


def levels_of(first: Records, second: Records) -> tuple[float, tuple[GridLevel, ...]]:
    """The stretch that both sources span together, which must have records: its volume, and its cells."""
    space = _SphereCells.over(first, second) if isinstance(first.space, Sphere) else _BoxCells.over(first, second)
    levels = [GridLevel(np.zeros(len(first), np.int32), np.zeros(len(second), np.int32), np.array([space.volume]))]
    richer, size = max(len(first), len(second)), space.volume
    while size * CELLS_PER_RECORD * richer > space.volume:
        richest = levels[-1].of_first if len(first) >= len(second) else levels[-1].of_second
        count = np.bincount(richest).astype(np.float64)
        if count @ count <= FINEST * richer:
            break
        size /= REFINEMENT
        levels.append(_level(*space.cells(first.features, second.features, size)))
    return space.volume, tuple(levels)


def _level(one: IntArray, two: IntArray, total: int, volumes: Callable[[IntArray], FloatArray]) -> GridLevel:
    from sameas.kernels.coverage import renumber

    of_first, of_second = np.empty(len(one), np.int32), np.empty(len(two), np.int32)
    if total <= 4 * (len(one) + len(two)) + 1024:
        return GridLevel(of_first, of_second, volumes(renumber(one, two, total, of_first, of_second)))
    known, index = np.unique(np.concatenate([one, two]), return_inverse=True)
    of_first[:], of_second[:] = index[: len(one)], index[len(one) :]
    return GridLevel(of_first, of_second, volumes(known))


@dataclass(frozen=True)
class _SphereCells:
    """Rings of equal height in latitude, cut into nearly square cells along the arc of longitude that holds records.

    west, arc : where that arc begins and how long it is, degrees.
    """

    low: float
    high: float
    west: float
    arc: float

    @classmethod
    def over(cls, first: Records, second: Records) -> _SphereCells:
        latitude = np.concatenate([first.features[:, 1], second.features[:, 1]])
        low, high = float(latitude.min()), float(latitude.max())
        margin = _margin(np.array([high - low]), first, second)[0]
        low, high = max(-90.0, low - margin / 3600.0), min(90.0, high + margin / 3600.0)
        west, arc = _arc(np.concatenate([first.features[:, 0], second.features[:, 0]]))
        narrow = max(math.cos(math.radians(max(abs(low), abs(high)))), 1e-9)
        across = _margin(np.array([arc * narrow]), first, second)[0] / narrow / 3600.0
        arc += 2.0 * across
        return cls(low, high, west - across, arc) if arc < 360.0 else cls(low, high, 0.0, 360.0)

    @property
    def volume(self) -> float:
        sines = math.sin(math.radians(self.high)) - math.sin(math.radians(self.low))
        return math.radians(self.arc) * sines * ARCSEC_PER_RADIAN**2

    def cells(self, first: FloatArray, second: FloatArray, size: float) -> Cut:
        from sameas.kernels.coverage import rings, sizes, sphere_cells

        begin, volume = rings(self.low, self.high, self.arc, size)
        one, two = np.empty(len(first), np.int64), np.empty(len(second), np.int64)
        for features, cell in ((first, one), (second, two)):
            sphere_cells(features, self.low, self.high, self.west, self.arc, begin, cell)
        return one, two, int(begin[-1]), lambda known: sizes(known, begin, volume)


@in_short
@dataclass(frozen=True)
class _BoxCells:
    """Boxes of equal size over a Euclidean space, cut along every feature that has an extent."""

    low: FloatArray
    extent: FloatArray

    @classmethod
    def over(cls, first: Records, second: Records) -> _BoxCells:
        both = np.concatenate([first.features, second.features])
        low, high = both.min(axis=0), both.max(axis=0)
        margin = _margin(high - low, first, second)
        return cls(low - margin, high - low + 2.0 * margin)

    @property
    def volume(self) -> float:
        return float(np.prod(self.extent))

    def cells(self, first: FloatArray, second: FloatArray, size: float) -> Cut:
        from sameas.kernels.coverage import box_cells

        d = len(self.extent)
        cuts = max(1, round((self.volume / size) ** (1.0 / d)))
        one, two = np.empty(len(first), np.int64), np.empty(len(second), np.int64)
        for features, cell in ((first, one), (second, two)):
            box_cells(features, self.low, self.extent, cuts, cell)
        volume = self.volume / float(cuts) ** d
        return one, two, cuts**d, lambda known: np.full(len(known), volume)


def _margin(extent: FloatArray, first: Records, second: Records) -> FloatArray:
    """How far beyond its outermost records a region reaches on each side, in the unit of the residuals.

    On average by extent/(n − 1) for n records strewn evenly, both sides together; and where there are so few records
    that their errors are all one knows of the scale, to a hundred errors over √n in all. On the sphere ``extent`` is
    in degrees.
    """
    n = max(len(first), len(second))
    typical = math.sqrt(max(first.covariance[:, 0].mean(), second.covariance[:, 0].mean()))
    size = extent * 3600.0 if isinstance(first.space, Sphere) else extent
    return np.maximum(0.5 * size / max(n - 1, 1), 0.5 * (100.0 * typical / math.sqrt(n) - size)).clip(min=0.0)


def _arc(longitude: FloatArray) -> tuple[float, float]:
    """(west end, length) in degrees of the shortest arc that holds all longitudes, to half a degree of gap."""
    west, east = float(longitude.min()), float(longitude.max())
    if east - west < 180.0:
        return west, east - west
    bins, longitude = 720, np.mod(longitude, 360.0)
    empty = np.bincount((longitude * (bins / 360.0)).astype(np.int64) % bins, minlength=bins) == 0
    if not empty.any():
        return 0.0, 360.0
    # Turn the circle so that it begins with a record; the longest run of empty bins is then in one piece.
    begin = int(np.argmin(empty))
    turned = np.roll(empty, -begin)
    ends = np.flatnonzero(np.diff(np.concatenate([[0], turned.astype(np.int8), [0]])))
    gaps = ends[1::2] - ends[::2]
    widest = int(np.argmax(gaps))
    after = (ends[2 * widest + 1] + begin) % bins * (360.0 / bins)
    from_there = np.mod(longitude - after, 360.0)
    west = float(from_there.min())
    return after + west, float(from_there.max()) - west

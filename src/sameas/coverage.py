"""Where two sources look, and how densely their records lie there, from the records alone.

The space is cut into cells of equal size, coarse to fine. A local density is the count of a cell, drawn towards the
density of the coarser cell by pseudo-counts, level after level: coarse where there is little to count, fine where there
is much. A record is *not covered* by the other source where that source is empty although seven or more of its
records were to be expected.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray

from sameas import threads
from sameas.records import FloatArray, IntArray, Records
from sameas.space import ARCSEC_PER_RADIAN, Sphere

#: Cells get finer by this factor in volume, down to about ``FINEST`` records of the richer source in each.
REFINEMENT = 8.0
FINEST = 6.0
PSEUDO_COUNT = 2.0
#: The same for densities: their noise would make the odds of chance pairs too good.
SMOOTH = 20.0
SHARED_PSEUDO_COUNT = 200.0
#: Expected records in an empty cell that make it a hole: e⁻⁷ is the chance of it by accident.
HOLE = 7.0


#: The cell of each record, and a function from cells to their volumes.
Cut = tuple[NDArray[np.int64], Callable[[NDArray[np.int64]], FloatArray]]


@dataclass(frozen=True)
class Level:
    """Cells of one size: the cell of every record of both sources, and the volume of each cell."""

    of_first: NDArray[np.int32]
    of_second: NDArray[np.int32]
    volume: FloatArray

    def part(self, rows_1: IntArray, rows_2: IntArray) -> Level:
        """The same cells, for some of the records."""
        return Level(self.of_first[rows_1], self.of_second[rows_2], self.volume)


@dataclass(frozen=True)
class Coverage:
    """Cells of falling size over two sources. Make it with :meth:`Coverage.of`."""

    first: Records
    second: Records
    volume: float
    levels: tuple[Level, ...]

    @classmethod
    def of(cls, first: Records, second: Records) -> Coverage:
        """Cells over the stretch that both sources span together; both must have records."""
        cut = _SphereCells.over(first, second) if isinstance(first.space, Sphere) else _BoxCells.over(first, second)
        levels: list[Level] = []
        richer = max(len(first), len(second))
        size = cut.volume
        while len(levels) < 40:
            level = _level(cut, first, second, size) if levels else _everything(cut, first, second)
            levels.append(level)
            richest = level.of_first if len(first) >= len(second) else level.of_second
            occupied = int(np.count_nonzero(np.bincount(richest, minlength=len(level.volume))))
            if richer / occupied <= FINEST or occupied == richer:
                break
            size /= REFINEMENT
        return cls(first, second, cut.volume, tuple(levels))

    def density(self, source: int, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Local density of the records of ``source`` (1 or 2) counted with ``weights``, at the records of both.

        Unit 1 / (residual unit)^d. A record does not count where it stands itself.
        """
        from sameas.kernels.density import refine

        start = (float(weights.sum()) + 0.5) / self.volume
        at_first, at_second = np.full(len(self.first), start), np.full(len(self.second), start)
        nothing = np.empty(0)
        for level in self.levels:
            cells = level.of_first if source == 1 else level.of_second
            count = np.bincount(cells, weights, len(level.volume))
            refine(count, level.volume, level.of_first, weights if source == 1 else nothing, SMOOTH, at_first)
            refine(count, level.volume, level.of_second, weights if source == 2 else nothing, SMOOTH, at_second)
        return at_first, at_second

    @cached_property
    def covered_densities(self) -> tuple[tuple[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]:
        """Local densities of the covered records of source 1 and of source 2, each at the records of both."""
        seen_1, seen_2 = (seen.astype(np.float64) for seen in self.covered)
        one, two = threads.each([partial(self.density, 1, seen_1), partial(self.density, 2, seen_2)], len(seen_1))
        return one, two

    @cached_property
    def covered(self) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Whether source 2 looks where each record of source 1 lies, (n₁,), and the reverse, (n₂,)."""
        one, two = threads.each([partial(self._seen, 1, 2), partial(self._seen, 2, 1)], len(self.first))
        return one, two

    def _seen(self, query: int, source: int) -> NDArray[np.bool_]:
        from sameas.kernels.density import look

        n = len(self.first if query == 1 else self.second)
        density = np.full(n, len(self.first if source == 1 else self.second) / self.volume)
        seen, highest = np.ones(n, np.bool_), np.zeros(n)
        for level in self.levels:
            cells, at = (level.of_first if k == 1 else level.of_second for k in (source, query))
            count = np.bincount(cells, minlength=len(level.volume)).astype(np.float64)
            look(count, level.volume, at, PSEUDO_COUNT, HOLE, seen, density, highest)
        return seen

    def by_chance(self, sigmas: float) -> float:
        """Records of source 2 that fall so near to one of source 1 by accident, on average, as ellipsoids go."""
        (_, (at_first, _)), d = self.covered_densities, self.first.d
        spread = self.first.variances.mean(axis=0) + self.second.variances.mean(axis=0)
        ellipsoid = (
            math.pi ** (0.5 * d) / math.gamma(0.5 * d + 1.0) * math.sqrt(float(np.prod(np.broadcast_to(spread, d))))
        )
        return float(at_first.mean()) * ellipsoid * sigmas**d

    def common_volume(self) -> float:
        """Volume where both sources look, (residual unit)^d: the cells that hold a covered record of either.

        Taken one level above the finest, where an empty cell is hardly ever an accident.
        """
        finest = self.levels[max(len(self.levels) - 2, 0)]
        held = np.zeros(len(finest.volume), np.bool_)
        held[finest.of_first[self.covered[0]]] = True
        held[finest.of_second[self.covered[1]]] = True
        return float(finest.volume[held].sum())


def local_share(
    levels: Sequence[Level], source: int, part: FloatArray, weights: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Local share Σ part / Σ weights of the records of ``source`` (1 or 2), at the records of both.

    Drawn towards that of the coarser cell by many pseudo-counts: a share that is itself being estimated must not
    gather where a few chance pairs happen to lie.
    """
    from sameas.kernels.density import refine_share

    start = (float(part.sum()) + 0.5) / (float(weights.sum()) + 1.0)
    at_first, at_second = np.full(len(levels[0].of_first), start), np.full(len(levels[0].of_second), start)
    at = (at_first, at_second) if source == 1 else (at_second, at_first)
    for level in levels:
        cells = (level.of_first, level.of_second) if source == 1 else (level.of_second, level.of_first)
        sums = np.empty(len(level.volume)), np.empty(len(level.volume))
        refine_share(*cells, part, weights, *sums, SHARED_PSEUDO_COUNT, *at)
    return at_first, at_second


def _everything(cut: _SphereCells | _BoxCells, first: Records, second: Records) -> Level:
    """One cell that holds all."""
    return Level(np.zeros(len(first), np.int32), np.zeros(len(second), np.int32), np.array([cut.volume]))


def _level(cut: _SphereCells | _BoxCells, first: Records, second: Records, size: float) -> Level:
    works = [partial(cut.cells, records.features, size) for records in (first, second)]
    (one, volume), (two, _) = threads.each(works, len(first) + len(second))
    known, of_first, of_second = _renumbered(one, two)
    return Level(of_first, of_second, volume(known))


def _renumbered(one: IntArray, two: IntArray) -> tuple[IntArray, NDArray[np.int32], NDArray[np.int32]]:
    """(numbers of the cells that occur, rising; positions of either source's cells among them).

    Positions are half as wide as need be, and so half as much to fetch, level after level and round after round.
    """
    least, most = min(int(one.min()), int(two.min())), max(int(one.max()), int(two.max())) + 1
    # Numbers of cells smaller than a double can tell apart overflow, and are then no more than names.
    if most > 4 * (len(one) + len(two)) + 1024 or least < 0:
        known, index = np.unique(np.concatenate([one, two]), return_inverse=True)
        return known, index[: len(one)].astype(np.int32), index[len(one) :].astype(np.int32)
    held = np.zeros(most, np.bool_)
    held[one] = held[two] = True
    number = np.cumsum(held, dtype=np.int32) - np.int32(1)
    return np.flatnonzero(held), number[one], number[two]


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

    def cells(self, features: FloatArray, size: float) -> Cut:
        from sameas.kernels.density import sphere_cells

        rings = max(1, math.ceil((self.high - self.low) * 3600.0 / math.sqrt(size)))
        height = (self.high - self.low) / rings
        edges = np.radians(self.low + height * np.arange(rings + 1))
        areas = math.radians(self.arc) * np.diff(np.sin(edges)) * ARCSEC_PER_RADIAN**2
        per_ring = np.maximum(1, np.round(areas / size)).astype(np.int64)
        begin = np.concatenate([[0], np.cumsum(per_ring)])
        cell = np.empty(len(features), np.int64)
        sphere_cells(features, self.low, height, self.west, self.arc, begin, per_ring, cell)

        def volume(known: NDArray[np.int64]) -> FloatArray:
            of = np.searchsorted(begin, known, side="right") - 1
            return areas[of] / per_ring[of]

        return cell, volume


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

    def cells(self, features: FloatArray, size: float) -> Cut:
        d = len(self.extent)
        cuts = max(1, round((self.volume / size) ** (1.0 / d)))
        index = np.clip(((features - self.low) / self.extent * cuts).astype(np.int64), 0, cuts - 1)
        cell = np.zeros(len(features), np.int64)
        for v in range(d):
            cell = cell * cuts + index[:, v]

        def volume(known: NDArray[np.int64]) -> FloatArray:
            return np.full(len(known), self.volume / float(cuts) ** d)

        return cell, volume

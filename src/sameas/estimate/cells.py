"""The field of two sources: cells of equal size, coarse to fine, and the part of each within the field.

A field is outlined by a convex polygon (:class:`ConvexRegion`), because surveys are often cones, and cameras rotated,
while cells fill a rectangle. Without the outline, cells at the border would count as whole: the density of a disc would
be underestimated by a quarter, most at its border, and chance pairs there too.

A field may also be discs around a list of targets (:mod:`sameas.estimate.discs`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import BoolArray, FloatArray, IntArray, inner, within_turn
from sameas.estimate.discs import Discs
from sameas.kernels import threads
from sameas.records import Records
from sameas.space import ARCSEC_PER_RADIAN, Sphere

# Parameters of cells and outlines, all chosen.
FEWEST = 100  # least number of points for an outline
#: A field is a rectangle if its corners hold more than this fraction of the points expected for an even distribution,
#: or if its outline fills more than the second fraction of the rectangle.
CORNERS, MOST = 0.5, 0.95
CORNER = 0.1  # depth of a corner, as a fraction of the side
DIRECTIONS = 64  # number of directions in which the outermost points are taken first
#: About this many points are used to check the corners, and to exclude points too far inside to be vertices.
SOME = 50_000
ACROSS = 32  # positions across a cell at which the part inside the outline is measured
LEAST = 1e-3  # least fraction of the volume of a cell with a record
#: Ratio of the volumes of successive levels; they are refined until the mean number of records of the richer source in
#: the cell of a record is at most FINEST_CELLS.
REFINEMENT, FINEST_CELLS = 8.0, 4.0
#: They are refined to at most this number of cells per record, because records at the same position are never
#: separated.
CELLS_PER_RECORD = 4096.0


@dataclass(frozen=True)
class ConvexRegion:
    """A convex region in the plane.

    x : (v,) ascending. lower, upper : (v,) its border there, straight in between. area : its area.
    """

    x: FloatArray
    lower: FloatArray
    upper: FloatArray
    area: float

    @classmethod
    def of(cls, points: FloatArray, low: FloatArray, high: FloatArray, records: int) -> ConvexRegion | None:
        """The outline of points (n, 2) in a rectangle; None if that is the rectangle itself, or with too few points.

        records : least number of objects that the points represent.

        The hull of n points evenly distributed over a convex region excludes the fraction V/n of it on average, with V
        the mean number of its vertices, so it is scaled about its centre by as much (Efron 1965, Biometrika 52, 331).
        """
        extent = high - low
        if records < FEWEST or not (extent > 0.0).all():
            return None
        some = (_some_of(points) - low) / extent
        in_corners = np.count_nonzero((np.abs(some - 0.5) > 0.5 - CORNER).all(axis=1))
        if in_corners > CORNERS * (2.0 * CORNER) ** 2 * len(some):
            return None
        place = np.empty_like(points)
        threads.over(lambda a, b: np.divide(points[a:b] - low, extent, out=place[a:b]), threads.even(len(points)))
        hull = _hull(_outermost(place))
        if len(hull) < 3 or 2 * len(hull) > records:
            return None
        after = np.roll(hull, -1, axis=0)
        cross = hull[:, 0] * after[:, 1] - after[:, 0] * hull[:, 1]
        area = 0.5 * float(cross.sum())
        larger = 1.0 / (1.0 - len(hull) / records)
        if area * larger > MOST:
            return None
        centre = (cross @ (hull + after)) / (6.0 * area)
        hull = low + extent * (centre + math.sqrt(larger) * (hull - centre))
        area *= larger * float(np.prod(extent))
        west, east = int(np.argmin(hull[:, 0])), int(np.argmax(hull[:, 0]))
        hull, east = np.roll(hull, -west, axis=0), (east - west) % len(hull)
        below, above = hull[: east + 1], np.concatenate([hull[east:], hull[:1]])[::-1]
        x = np.unique(hull[:, 0])
        return cls(x, np.interp(x, *below.T), np.interp(x, *above.T), area)

    def part(self, low: FloatArray, high: FloatArray) -> FloatArray:
        """(c,) the fraction of rectangles from ``low`` to ``high``, (c, 2) each, inside; at least ``least``."""
        ends = np.stack([low[:, 0], high[:, 0]])
        inside = (ends >= self.x[0]) & (ends <= self.x[-1])
        inside &= (np.interp(ends, self.x, self.lower) <= low[:, 1]) & (
            np.interp(ends, self.x, self.upper) >= high[:, 1]
        )
        part = np.ones(len(low))
        cut = np.flatnonzero(~inside.all(axis=0))
        (west, south), (east, north) = low[cut].T, high[cut].T
        at = west + (east - west) * ((np.arange(ACROSS) + 0.5) / ACROSS)[:, None]
        height = np.minimum(np.interp(at, self.x, self.upper), north) - np.maximum(
            np.interp(at, self.x, self.lower), south
        )
        height[(at < self.x[0]) | (at > self.x[-1])] = 0.0
        part[cut] = np.clip(height, 0.0, None).mean(axis=0) / (north - south)
        return np.maximum(part, LEAST)


def _outermost(points: FloatArray) -> FloatArray:
    """The polygon of the outermost points in some directions, and the points outside it."""
    corners = _farthest(_some_of(points))
    # Points within the inscribed circle of that polygon are no vertices; this excludes most of them.
    centre = corners.mean(axis=0)
    from_centre = corners - centre, np.roll(corners, -1, axis=0) - centre
    side = np.linalg.norm(from_centre[1] - from_centre[0], axis=1)
    area = from_centre[0][:, 0] * from_centre[1][:, 1] - from_centre[0][:, 1] * from_centre[1][:, 0]
    inscribed = float((area[side > 0.0] / side[side > 0.0]).min()) if side.any() else 0.0
    least_sq = max(0.0, inscribed) ** 2

    def beyond(first: int, last: int) -> FloatArray:
        x, y = (points[first:last] - centre).T
        return np.compress(x * x + y * y >= least_sq, points[first:last], axis=0)

    points = np.concatenate(threads.over(beyond, threads.even(len(points))))
    corners = _farthest(points)
    outside = np.zeros(len(points), np.bool_)
    for one, two in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        along = two - one
        outside |= along[0] * (points[:, 1] - one[1]) - along[1] * (points[:, 0] - one[0]) < 0.0
    return np.concatenate([points[outside], corners])


def _some_of(points: FloatArray) -> FloatArray:
    """At most about ``some`` of the points, at equal steps of the row."""
    return np.ascontiguousarray(points[:: max(1, len(points) // SOME)])


def _farthest(points: FloatArray) -> FloatArray:
    """(DIRECTIONS, 2) the outermost point in each of some directions, counterclockwise."""
    angle = np.arange(DIRECTIONS) * (2.0 * math.pi / DIRECTIONS)
    return points[[int(np.argmax(points @ way)) for way in np.column_stack([np.cos(angle), np.sin(angle)])]]


def _hull(points: FloatArray) -> FloatArray:
    """The vertices (v, 2) of the convex hull, counterclockwise (Andrew 1979, Information Processing Letters 9, 216)."""
    ordered = [(float(x), float(y)) for x, y in np.unique(points, axis=0)]

    def chain(some: list[tuple[float, float]]) -> list[tuple[float, float]]:
        kept: list[tuple[float, float]] = []
        for x, y in some:
            while len(kept) > 1:
                (x0, y0), (x1, y1) = kept[-2:]
                if (x1 - x0) * (y - y0) - (y1 - y0) * (x - x0) > 0.0:
                    break
                kept.pop()
            kept.append((x, y))
        return kept[:-1]

    return np.array(chain(ordered) + chain(ordered[::-1]))


#: The cell of every record of both sources, the number of cells, and a function from cells to their volumes.
Cut = tuple[IntArray, IntArray, int, Callable[[IntArray], FloatArray]]


@dataclass(frozen=True)
class GridLevel:
    """Cells of one size: the cell of every record of both sources, and the volume of each cell.

    Cells are numbered in order of occurrence, in 32 bits, which halves the memory traffic of all levels and EM
    iterations.
    """

    of_first: NDArray[np.int32]
    of_second: NDArray[np.int32]
    volume: FloatArray

    def facing(self, source: int) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """The cells of the records of ``source`` (1 or 2), and of the other's."""
        return (self.of_first, self.of_second) if source == 1 else (self.of_second, self.of_first)

    def count(self, source: int) -> FloatArray:
        """(c,) number of records of ``source`` (1 or 2) in each cell."""
        return self._counts[source - 1]

    @cached_property
    def _counts(self) -> tuple[FloatArray, FloatArray]:
        n = len(self.volume)
        one, two = (np.bincount(of, minlength=n).astype(np.float64) for of in (self.of_first, self.of_second))
        return one, two

    def part(self, rows_1: IntArray, rows_2: IntArray) -> GridLevel:
        """The same cells for some of the records."""
        return GridLevel(self.of_first[rows_1], self.of_second[rows_2], self.volume)

    def drawn(self, counts: Sequence[NDArray[Any]], enough: int, seed: int) -> BoolArray:
        """(c,) cells drawn at random until they hold ``enough`` of each of the ``counts`` (each (c,))."""
        order = np.random.default_rng(seed).permutation(len(self.volume))
        needed = max(int(np.searchsorted(np.cumsum(count[order]), enough)) for count in counts) + 1
        drawn = np.zeros(len(order), np.bool_)
        drawn[order[:needed]] = True
        return drawn


def finest(levels: Sequence[GridLevel], max_cells: float) -> GridLevel:
    """The finest level with at most this number of cells; else the first."""
    return next((level for level in levels[::-1] if len(level.volume) <= max_cells), levels[0])


def levels_of(first: Records, second: Records) -> tuple[float, tuple[GridLevel, ...], Discs | None]:
    """Volume of the region of both sources, which must have records, its levels of cells, and its discs."""
    kind = _SphereCells if isinstance(first.space, Sphere) else _BoxCells
    space = kind.over(first, second)
    volume = space.volume if space.outline is None else space.volume * space.outline.area / space.area
    levels = [GridLevel(np.zeros(len(first), np.int32), np.zeros(len(second), np.int32), np.array([volume]))]
    richer, size = max(len(first), len(second)), space.volume
    while size * CELLS_PER_RECORD * richer > space.volume:
        count = levels[-1].count(1 if len(first) >= len(second) else 2)
        if inner(count, count) <= FINEST_CELLS * richer:
            break
        size /= REFINEMENT
        levels.append(_level(*space.cells(first.features, second.features, size)))
    discs = None
    if isinstance(first.space, Sphere) and len(levels) > 1:
        discs = Discs.of((first.features, second.features), volume, _clumped(levels[-1], volume))
    if discs is not None:
        volume, levels = float(discs.area.sum()), [_of_discs(level, discs) for level in levels]
    return volume, tuple(levels), discs


def _clumped(level: GridLevel, volume: float) -> float:
    """Pairs of one source's records in cells, as a multiple of those of an even field; of both sources the smaller."""
    count = np.array([level.count(1), level.count(2)])
    expected = count.sum(axis=1) ** 2 * float(np.median(level.volume)) / volume
    return float(((count * (count - 1.0)).sum(axis=1) / expected).min())


def _of_discs(level: GridLevel, discs: Discs) -> GridLevel:
    """The level with every record in the cell of its disc's centre, and the volume of the discs in each cell."""
    if not discs.centres:
        # In the cell of the first record of its disc.
        first_record = np.unique(discs.nearest, return_index=True)[1]
        used, index = np.unique(np.concatenate([level.of_first, level.of_second])[first_record], return_inverse=True)
        volume = np.asarray(np.bincount(index, discs.area, len(used)), np.float64)
        of_all, n = np.asarray(index, np.int32)[discs.nearest], len(level.of_first)
        return GridLevel(of_all[:n], of_all[n:], volume)
    cells = level.of_first if discs.centres == 1 else level.of_second
    used, index = np.unique(cells, return_inverse=True)
    centres = np.asarray(index, np.int32)
    others = centres[discs.nearest]
    volume = np.asarray(np.bincount(centres, discs.area, len(used)), np.float64)
    return GridLevel(centres, others, volume) if discs.centres == 1 else GridLevel(others, centres, volume)


def _level(one: IntArray, two: IntArray, total: int, volumes: Callable[[IntArray], FloatArray]) -> GridLevel:
    from sameas.kernels.coverage import renumber

    of_first, of_second = np.empty(len(one), np.int32), np.empty(len(two), np.int32)
    if total <= 4 * (len(one) + len(two)) + 1024:
        occupied = renumber(one, two, total, of_first, of_second)
    else:
        occupied, index = np.unique(np.concatenate([one, two]), return_inverse=True)
        of_first[:], of_second[:] = index[: len(one)], index[len(one) :]
    parts = threads.over(lambda a, b: volumes(occupied[a:b]), threads.even(len(occupied)))
    return GridLevel(of_first, of_second, np.concatenate(parts))


@dataclass(frozen=True)
class _SphereCells:
    """Rings of equal height in latitude, divided into nearly square cells along the arc of longitude with records.

    west, arc : west end and length of that arc, degrees. outline : of the records, in degrees of longitude from there
    and sines of latitude (an equal-area projection); None if they fill the rings.
    """

    low: float
    high: float
    west: float
    arc: float
    outline: ConvexRegion | None = None

    @classmethod
    def over(cls, first: Records, second: Records) -> _SphereCells:
        sides = first.features, second.features
        low, high = _extremes([features[:, 1] for features in sides])
        margin = _margin(np.array([high - low]), first, second)[0]
        low, high = max(-90.0, low - margin / 3600.0), min(90.0, high + margin / 3600.0)
        west, arc = _arc([features[:, 0] for features in sides])
        narrow = max(math.cos(math.radians(max(abs(low), abs(high)))), 1e-9)
        across = _margin(np.array([arc * narrow]), first, second)[0] / narrow / 3600.0
        arc += 2.0 * across
        if arc >= 360.0:
            return cls(low, high, 0.0, 360.0)
        west -= across
        points = np.empty((2, len(first) + len(second))).T  # columns in a row: arithmetic takes half the time

        def project(features: FloatArray, into: FloatArray) -> None:
            into[:, 0] = within_turn(features[:, 0] - west)
            into[:, 1] = np.sin(np.radians(features[:, 1]))

        halves = points[: len(first)], points[len(first) :]
        threads.each([partial(project, *half) for half in zip(sides, halves, strict=True)], len(points))
        south_west, north_east = (
            np.array([x, math.sin(math.radians(latitude))]) for x, latitude in ((0.0, low), (arc, high))
        )
        records = max(len(first), len(second))
        return cls(low, high, west, arc, ConvexRegion.of(points, south_west, north_east, records))

    @property
    def area(self) -> float:
        """In the coordinates of the outline: degrees times sine."""
        return self.arc * (math.sin(math.radians(self.high)) - math.sin(math.radians(self.low)))

    @property
    def volume(self) -> float:
        sines = math.sin(math.radians(self.high)) - math.sin(math.radians(self.low))
        return math.radians(self.arc) * sines * ARCSEC_PER_RADIAN**2

    def cells(self, first: FloatArray, second: FloatArray, size: float) -> Cut:
        from sameas.kernels.coverage import cell_sizes, rings, sphere_cells

        begin, volume = rings(self.low, self.high, self.arc, size)
        one, two = np.empty(len(first), np.int64), np.empty(len(second), np.int64)
        ring = self.low, self.high, self.west, self.arc, begin
        works = [partial(sphere_cells, of, *ring, cell) for of, cell in ((first, one), (second, two))]
        threads.each(works, len(first))

        def volumes(occupied: IntArray) -> FloatArray:
            whole: FloatArray = cell_sizes(occupied, begin, volume)
            if self.outline is None:
                return whole
            height, every = (self.high - self.low) / len(volume), np.arange(len(volume))
            ring = np.repeat(every, np.diff(np.searchsorted(occupied, begin)))
            number, width = occupied - begin[ring], (self.arc / np.diff(begin))[ring]
            south, north = (np.sin(np.radians(self.low + height * at))[ring] for at in (every, every + 1))
            low = np.column_stack([number * width, south])
            part: FloatArray = self.outline.part(low, np.column_stack([(number + 1) * width, north]))
            return whole * part

        return one, two, int(begin[-1]), volumes


@dataclass(frozen=True)
class _BoxCells:
    """Boxes of equal size over a Euclidean space, divided along every feature with an extent.

    outline : of the records, with two features; None if they fill the box.
    """

    low: FloatArray
    extent: FloatArray
    outline: ConvexRegion | None = None

    @classmethod
    def over(cls, first: Records, second: Records) -> _BoxCells:
        both = np.concatenate([first.features, second.features])
        low, high = both.min(axis=0), both.max(axis=0)
        margin = _margin(high - low, first, second)
        low, high = low - margin, high + margin
        records = max(len(first), len(second))
        outline = ConvexRegion.of(both, low, high, records) if len(low) == 2 else None
        return cls(low, high - low, outline)

    @property
    def area(self) -> float:
        """In the coordinates of the outline."""
        return self.volume

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
        whole = self.volume / float(cuts) ** d

        def volumes(occupied: IntArray) -> FloatArray:
            if self.outline is None:
                return np.full(len(occupied), whole)
            side = self.extent / cuts
            low = self.low + np.column_stack([occupied // cuts, occupied % cuts]) * side
            return whole * self.outline.part(low, low + side)

        return one, two, cuts**d, volumes


def _margin(extent: FloatArray, first: Records, second: Records) -> FloatArray:
    """How far a region extends beyond its outermost records on each side, in the unit of the residuals.

    On average extent/(n − 1) for n evenly distributed records, both sides together; but the region is at least a
    hundred errors over √n wide, because with few records their errors are all that is known of the scale. On the sphere
    ``extent`` is in degrees.
    """
    n, on_sphere = max(len(first), len(second)), isinstance(first.space, Sphere)
    # East and north rotate along the sphere; features of a plane may have different units.
    one, two = (records.variances.mean(axis=None if on_sphere else 0) for records in (first, second))
    typical, size = np.sqrt(np.maximum(one, two)), extent * 3600.0 if on_sphere else extent
    margin: FloatArray = np.maximum(0.5 * size / max(n - 1, 1), 0.5 * (100.0 * typical / math.sqrt(n) - size))
    return margin.clip(min=0.0)


def _extremes(parts: Sequence[FloatArray]) -> tuple[float, float]:
    """The least and the greatest of several arrays."""
    return min(float(part.min()) for part in parts), max(float(part.max()) for part in parts)


def _arc(longitudes: Sequence[FloatArray]) -> tuple[float, float]:
    """(west end, length) in degrees of the shortest arc with all longitudes, to half a degree."""
    west, east = _extremes(longitudes)
    if east - west < 180.0:
        return west, east - west
    bins, longitude = 720, within_turn(np.concatenate(longitudes))
    empty = np.bincount((longitude * (bins / 360.0)).astype(np.int64) % bins, minlength=bins) == 0
    if not empty.any():
        return 0.0, 360.0
    # Rotate the circle so that it begins with a record; then the longest run of empty bins is contiguous.
    begin = int(np.argmin(empty))
    rotated = np.roll(empty, -begin)
    ends = np.flatnonzero(np.diff(np.concatenate([[0], rotated.astype(np.int8), [0]])))
    gaps = ends[1::2] - ends[::2]
    widest = int(np.argmax(gaps))
    after = (ends[2 * widest + 1] + begin) % bins * (360.0 / bins)
    from_there = within_turn(longitude - after)
    west = float(from_there.min())
    return after + west, float(from_there.max()) - west

"""The field of two sources: cells of equal size, coarse to fine, the part of each within the field, and lists of discs.

A field is outlined by a convex polygon (:class:`ConvexRegion`), because surveys are often cones, and cameras rotated,
while cells fill a rectangle. Without the outline, cells at the border would count as whole: the density of a disc would
be underestimated by a quarter, most at its border, and chance pairs there too.

A field may also be discs (:class:`Discs`): one source, or both, were queried within a radius around each of a list of
targets, the records of the other source or in neither of the two. Such discs (cone searches) may hold two or three
records each, and fill a millionth of the sky that the list spans. Cells find a density from four records on, so they
would take the sky between the discs for a part of the field, its density for that of chance, and every neighbour for
the partner.
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
from sameas.kernels import threads
from sameas.records import Records
from sameas.representation import in_short
from sameas.space import ARCSEC_PER_RADIAN, Sphere, unit_vectors


@dataclass(frozen=True)
class CellsTuning:
    """Parameters of cells, outlines and discs; chosen where no source is given.

    Attributes
    ----------
    fewest : least number of points for an outline.
    corners, most : a field is a rectangle if its corners hold more than this fraction of the points expected for an
        even distribution, or if its outline fills more than the second fraction of the rectangle.
    corner : depth of a corner, as a fraction of the side.
    directions : number of directions in which the outermost points are taken first.
    some : about this many points are used to check the corners, and to exclude points too far inside to be
        vertices.
    across : positions across a cell at which the part inside the outline is measured.
    least : least fraction of the volume of a cell with a record.
    refinement, finest : ratio of the volumes of successive levels; they are refined until the mean number of
        records of the richer source in the cell of a record is at most ``finest``.
    cells_per_record : they are refined to at most this number of cells per record, because records at the same
        position are never separated.
    first_records, most_centres : records whose nearest centres are found first, since few fields are discs; and the
        number of centres above which none are looked for.
    full : discs must fill at most this fraction of the region of all records.
    outer, flat : least number of records in the outer half of the discs, and in the outer half per record in the
        quarter of the area next to it: in discs 2, around partners alone (residuals of any distribution that falls
        outwards) less than 1.
    repeated : least number of records that have the same nearest centre as another, per record in the outer half.
        Two catalogues of the same objects with a shift or a rotation between them fill discs as well, but with one
        record each.
    few_pairs : most pairs of a centre and a record for finding the nearest centres without a tree, whose import
        takes longer; twice ``first_records`` records, which are the most that are looked at first, stay below it.
    points : points per disc at which the number of discs that overlap is counted.
    clumped, neighbours, most_pairs : around targets that no source lists: pairs of one source's records in the
        cells, as a multiple of those of an even field, from which discs are looked for; least mean number of
        neighbours in a disc; most pairs of neighbours.
    step, growth : steps of the distance within which neighbours are counted, and most growth of their number over
        two steps where the discs end, in which an even field has 2.4 times as many.
    nine_tenths, around_targets : the distance within which 90 % of the pairs of records in a disc lie, in radii: of
        records that fill it evenly, and where one of 1 + k is the target at its centre, by 1/k (simulated).
    half : most pairs within half of that distance, as a fraction of all: 0.39 in evenly filled discs, less around
        targets, 0.44 in Gaussian clusters; two standard deviations more are allowed.
    unequal : most neighbours per record, as a multiple of the other records per disc: 1 to 2 in discs; more where
        few clusters lie among many single records.
    several : least fraction of the pairs that must be of discs with three records of a source or more: with half a
        neighbour per target it is a half; couples of companions have none.
    within, reach, most_divisions : least fraction of the records that must lie within ``reach`` radii of the middle
        of their disc where no discs overlap, and most divisions of those that do.
    """

    fewest: int = 100
    corners: float = 0.5
    most: float = 0.95
    corner: float = 0.1
    directions: int = 64
    some: int = 50_000
    across: int = 32
    least: float = 1e-3
    refinement: float = 8.0
    finest: float = 4.0
    cells_per_record: float = 4096.0
    first_records: int = 16
    most_centres: int = 200_000
    full: float = 0.25
    outer: int = 8
    flat: float = 1.2
    repeated: float = 0.5
    few_pairs: int = 8_000_000
    points: int = 64
    clumped: float = 1.5
    neighbours: float = 0.5
    most_pairs: int = 20_000_000
    step: float = 1.25
    growth: float = 1.08
    nine_tenths: float = 1.49
    around_targets: tuple[tuple[float, ...], tuple[float, ...]] = ((0.0, 0.2, 0.5, 1.0), (1.49, 1.39, 1.15, 0.95))
    half: float = 0.42
    unequal: float = 2.5
    several: float = 0.33
    within: float = 0.95
    reach: float = 1.25
    most_divisions: int = 6


DEFAULT_CELLS = CellsTuning()


@dataclass(frozen=True)
class ConvexRegion:
    """A convex region in the plane.

    x : (v,) ascending. lower, upper : (v,) its border there, straight in between. area : its area.
    """

    x: FloatArray
    lower: FloatArray
    upper: FloatArray
    area: float
    tuning: CellsTuning = DEFAULT_CELLS

    @classmethod
    def of(
        cls, points: FloatArray, low: FloatArray, high: FloatArray, records: int, tuning: CellsTuning = DEFAULT_CELLS
    ) -> ConvexRegion | None:
        """The outline of points (n, 2) in a rectangle; None if that is the rectangle itself, or with too few points.

        records : least number of objects that the points represent.

        The hull of n points evenly distributed over a convex region excludes the fraction V/n of it on average, with V
        the mean number of its vertices, so it is scaled about its centre by as much (Efron 1965, Biometrika 52, 331).
        """
        extent = high - low
        if records < tuning.fewest or not (extent > 0.0).all():
            return None
        some = (_some_of(points, tuning) - low) / extent
        in_corners = np.count_nonzero((np.abs(some - 0.5) > 0.5 - tuning.corner).all(axis=1))
        if in_corners > tuning.corners * (2.0 * tuning.corner) ** 2 * len(some):
            return None
        place = np.empty_like(points)
        threads.over(lambda a, b: np.divide(points[a:b] - low, extent, out=place[a:b]), threads.even(len(points)))
        hull = _hull(_outermost(place, tuning))
        if len(hull) < 3 or 2 * len(hull) > records:
            return None
        after = np.roll(hull, -1, axis=0)
        cross = hull[:, 0] * after[:, 1] - after[:, 0] * hull[:, 1]
        area = 0.5 * float(cross.sum())
        larger = 1.0 / (1.0 - len(hull) / records)
        if area * larger > tuning.most:
            return None
        centre = (cross @ (hull + after)) / (6.0 * area)
        hull = low + extent * (centre + math.sqrt(larger) * (hull - centre))
        area *= larger * float(np.prod(extent))
        west, east = int(np.argmin(hull[:, 0])), int(np.argmax(hull[:, 0]))
        hull, east = np.roll(hull, -west, axis=0), (east - west) % len(hull)
        below, above = hull[: east + 1], np.concatenate([hull[east:], hull[:1]])[::-1]
        x = np.unique(hull[:, 0])
        return cls(x, np.interp(x, *below.T), np.interp(x, *above.T), area, tuning)

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
        across = self.tuning.across
        at = west + (east - west) * ((np.arange(across) + 0.5) / across)[:, None]
        height = np.minimum(np.interp(at, self.x, self.upper), north) - np.maximum(
            np.interp(at, self.x, self.lower), south
        )
        height[(at < self.x[0]) | (at > self.x[-1])] = 0.0
        part[cut] = np.clip(height, 0.0, None).mean(axis=0) / (north - south)
        return np.maximum(part, self.tuning.least)


def _outermost(points: FloatArray, tuning: CellsTuning) -> FloatArray:
    """The polygon of the outermost points in some directions, and the points outside it."""
    corners = _farthest(_some_of(points, tuning), tuning.directions)
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
    corners = _farthest(points, tuning.directions)
    outside = np.zeros(len(points), np.bool_)
    for one, two in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        along = two - one
        outside |= along[0] * (points[:, 1] - one[1]) - along[1] * (points[:, 0] - one[0]) < 0.0
    return np.concatenate([points[outside], corners])


def _some_of(points: FloatArray, tuning: CellsTuning) -> FloatArray:
    """At most about ``some`` of the points, at equal steps of the row."""
    return np.ascontiguousarray(points[:: max(1, len(points) // tuning.some)])


def _farthest(points: FloatArray, directions: int) -> FloatArray:
    """(directions, 2) the outermost point in each of some directions, counterclockwise."""
    angle = np.arange(directions) * (2.0 * math.pi / directions)
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


@in_short
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


def levels_of(
    first: Records, second: Records, tuning: CellsTuning
) -> tuple[float, tuple[GridLevel, ...], Discs | None]:
    """Volume of the region of both sources, which must have records, its levels of cells, and its discs."""
    kind = _SphereCells if isinstance(first.space, Sphere) else _BoxCells
    space = kind.over(first, second, tuning)
    volume = space.volume if space.outline is None else space.volume * space.outline.area / space.area
    levels = [GridLevel(np.zeros(len(first), np.int32), np.zeros(len(second), np.int32), np.array([volume]))]
    richer, size = max(len(first), len(second)), space.volume
    while size * tuning.cells_per_record * richer > space.volume:
        count = levels[-1].count(1 if len(first) >= len(second) else 2)
        if inner(count, count) <= tuning.finest * richer:
            break
        size /= tuning.refinement
        levels.append(_level(*space.cells(first.features, second.features, size)))
    discs = None
    if isinstance(first.space, Sphere) and len(levels) > 1:
        discs = Discs.of((first.features, second.features), volume, _clumped(levels[-1], volume), tuning)
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
    def over(cls, first: Records, second: Records, tuning: CellsTuning) -> _SphereCells:
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
        return cls(low, high, west, arc, ConvexRegion.of(points, south_west, north_east, records, tuning))

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


@in_short
@dataclass(frozen=True)
class _BoxCells:
    """Boxes of equal size over a Euclidean space, divided along every feature with an extent.

    outline : of the records, with two features; None if they fill the box.
    """

    low: FloatArray
    extent: FloatArray
    outline: ConvexRegion | None = None

    @classmethod
    def over(cls, first: Records, second: Records, tuning: CellsTuning) -> _BoxCells:
        both = np.concatenate([first.features, second.features])
        low, high = both.min(axis=0), both.max(axis=0)
        margin = _margin(high - low, first, second)
        low, high = low - margin, high + margin
        records = max(len(first), len(second))
        outline = ConvexRegion.of(both, low, high, records, tuning) if len(low) == 2 else None
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
    n = max(len(first), len(second))
    typical = math.sqrt(max(first.covariance[:, 0].mean(), second.covariance[:, 0].mean()))
    size = extent * 3600.0 if isinstance(first.space, Sphere) else extent
    return np.maximum(0.5 * size / max(n - 1, 1), 0.5 * (100.0 * typical / math.sqrt(n) - size)).clip(min=0.0)


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


# Fields that are discs around a list of targets.


@in_short
@dataclass(frozen=True)
class Discs:
    """Discs around the records of one source that hold all records of the other, or discs that hold those of both.

    centres : source (1 or 2) that has the centres, or 0. radius : in arcsec. nearest : (m,) centre nearest to each
    record of the other source; without a source of centres the disc of each record of both, the first source first.
    area : (n,) of each disc in square arcsec, with its share of what overlapping discs have in common.
    """

    centres: int
    radius: float
    nearest: IntArray
    area: FloatArray

    @classmethod
    def of(
        cls,
        positions: tuple[FloatArray, FloatArray],
        region: float,
        clumped: float = 0.0,
        tuning: CellsTuning = DEFAULT_CELLS,
    ) -> Discs | None:
        """The discs of two sources on the sphere, or None if their fields are something else.

        positions : (n₁, 2), (n₂, 2) longitude and latitude in degrees. region : area of the region of all records.
        clumped : pairs of one source's records in cells, as a multiple of those of an even field; of both, the smaller.
        """
        for centres, others in ((0, 1), (1, 0)):
            found = _around(positions[centres], positions[others], tuning.full * region, tuning)
            if found is not None:
                return cls(centres + 1, *found)
        if clumped >= tuning.clumped:
            found = _around_neither(positions, region, tuning)
            if found is not None:
                return cls(0, *found)
        return None


def _around(
    centres: FloatArray, others: FloatArray, most: float, tuning: CellsTuning
) -> tuple[float, IntArray, FloatArray] | None:
    """Radius, nearest centres and areas of discs of at most this total area; None if ``others`` fill no discs."""
    if len(centres) > tuning.most_centres or len(others) < tuning.outer:
        return None
    ground = unit_vectors(*centres.T)
    some = unit_vectors(*others[:: max(1, len(others) // tuning.first_records)].T)
    least = float(_nearest(ground, some, tuning.few_pairs)[0].max()) * ARCSEC_PER_RADIAN
    # Discs that overlap at most by half.
    if 0.5 * len(centres) * math.pi * least**2 > most:
        return None
    chord, of = _nearest(ground, unit_vectors(*others.T), tuning.few_pairs)
    # The outermost of n records lies at about 1 − 1/2n of the radius.
    reach = float(chord.max()) * (1.0 + 0.5 / len(others))
    outer = int(np.count_nonzero(chord > reach * math.sqrt(0.5)))
    next_to_it = int(np.count_nonzero(chord > 0.5 * reach)) - outer
    if (
        outer < tuning.outer
        or outer < tuning.flat * next_to_it
        or len(of) - len(np.unique(of)) < tuning.repeated * outer
    ):
        return None
    radius, area = reach * ARCSEC_PER_RADIAN, _areas(ground, reach, tuning.points)
    return None if area.sum() > most else (radius, np.asarray(of, np.int64), area)


def _areas(ground: FloatArray, reach: float, points: int) -> FloatArray:
    """(n,) area in square arcsec of discs around ``ground`` (n, 3), with their shares of what overlaps.

    reach : radius of the discs, as a chord. points : per disc.
    """
    from scipy.spatial import cKDTree

    tree = cKDTree(ground)
    # A sunflower: points that share the area of a disc evenly.
    k = np.arange(points) + 0.5
    at, angle = reach * np.sqrt(k / points), k * math.pi * (3.0 - math.sqrt(5.0))
    pole = np.eye(3)[np.argmin(np.abs(ground), axis=1)]
    east = np.cross(ground, pole)
    east /= np.linalg.norm(east, axis=1)[:, None]
    north = np.cross(ground, east)
    share = np.zeros(len(ground))
    for x, y in zip(at * np.cos(angle), at * np.sin(angle), strict=True):
        share += 1.0 / np.maximum(tree.query_ball_point(ground + x * east + y * north, reach, return_length=True), 1)
    return np.asarray(math.pi * (reach * ARCSEC_PER_RADIAN) ** 2 * share / points)


def _around_neither(
    positions: tuple[FloatArray, FloatArray], region: float, tuning: CellsTuning
) -> tuple[float, IntArray, FloatArray] | None:
    """Radius, disc of each record and areas of discs around targets that no source lists; None without such discs.

    Neighbours are counted within a source, because partners of the other are no sign of a disc. Their number beyond
    those of an even field grows with the distance up to the diameter of the discs, and no more from there on.
    """
    n = np.array([len(positions[0]), len(positions[1])])
    if min(n) < 2 * tuning.outer or n.sum() > tuning.most_centres:
        return None
    from scipy.spatial import cKDTree

    units = [unit_vectors(*side.T) for side in positions]
    trees = [cKDTree(side) for side in units]
    # From a fiftieth of the mean spacing of the records to twenty times that, if it is within the region.
    spacing = math.sqrt(region / n.max()) / ARCSEC_PER_RADIAN
    steps = np.arange(math.ceil(math.log(1000.0) / math.log(tuning.step)))
    reach = 0.02 * spacing * tuning.step**steps
    reach = reach[reach < 0.2 * math.sqrt(region) / ARCSEC_PER_RADIAN]
    share = [len(side) ** 2 * math.pi * (reach * ARCSEC_PER_RADIAN) ** 2 / region for side in units]
    counts = [tree.count_neighbors(tree, reach) - len(side) for tree, side in zip(trees, units, strict=True)]
    excess = np.sum(counts, axis=0) - np.sum(share, axis=0)
    enough = excess >= max(tuning.neighbours * n.sum(), 4.0 * tuning.outer)
    ends = np.flatnonzero(enough[:-2] & (excess[2:] <= tuning.growth * excess[:-2]))
    if not len(ends) or excess[ends[0]] > tuning.most_pairs:
        return None
    most = float(excess[ends[0]])
    nine_tenths = float(np.interp(0.9 * most, excess[: ends[0] + 1], reach[: ends[0] + 1]))
    rough = nine_tenths / tuning.nine_tenths
    if np.interp(0.5 * nine_tenths, reach, excess) > tuning.half * most + 2.0 * math.sqrt(most):
        return None
    points = np.concatenate(units)
    disc = _gathered(points, 1.2 * rough, tuning.most_pairs)
    if disc is None:
        return None
    numbers_of_each = [np.bincount(of) for of in np.split(disc, [n[0]])]
    numbers = np.concatenate(numbers_of_each)
    pairs = numbers * (numbers - 1)
    if pairs[numbers > 2].sum() < tuning.several * pairs.sum():
        return None
    discs_of_each = [np.count_nonzero(numbers) for numbers in numbers_of_each]
    if most > tuning.unequal * sum(a**2 / b - a for a, b in zip(n.tolist(), discs_of_each, strict=True)):
        return None
    limit = tuning.reach * nine_tenths / float(np.interp(n.sum() / most, *tuning.around_targets))
    inside = float(np.mean(np.linalg.norm(points - _middles(points, disc)[disc], axis=1) <= limit))
    if inside < tuning.within - tuning.full:
        return None
    disc = _divided(points, disc, limit, tuning.most_divisions)
    middle = _middles(points, disc)
    # Of discs that overlap by chance, those whose middles are about half a radius apart stay together.
    together = 0.25 * len(middle) * math.pi * (rough * ARCSEC_PER_RADIAN) ** 2 / region
    radius = _half_extent(points, disc, 2.6 * rough, 0.98 - min(together, 0.1))
    area = _areas(middle / np.linalg.norm(middle, axis=1)[:, None], radius, tuning.points)
    # Discs overlap by chance as often as they fill the region.
    if inside < tuning.within - area.sum() / region or area.sum() > tuning.full * region:
        return None
    return radius * ARCSEC_PER_RADIAN, disc, area


def _gathered(points: FloatArray, width: float, most_pairs: int) -> IntArray | None:
    """(n,) groups of points, by moving each to the mean of those within ``width``, again and again; None if many."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    moved, n = points, len(points)
    for _ in range(5):
        tree = cKDTree(moved)
        if tree.count_neighbors(tree, width) > most_pairs:
            return None
        i, j = tree.query_pairs(width, output_type="ndarray").T
        number = 1.0 + np.bincount(i, minlength=n) + np.bincount(j, minlength=n)
        total = [axis + np.bincount(i, axis[j], n) + np.bincount(j, axis[i], n) for axis in moved.T]
        moved = np.column_stack(total) / number[:, None]
    i, j = cKDTree(moved).query_pairs(0.3 * width, output_type="ndarray").T
    return np.asarray(connected_components(coo_array((np.ones(len(i)), (i, j)), (n, n)), False)[1], np.int64)


def _middles(points: FloatArray, group: IntArray) -> FloatArray:
    """(g, 3) mean of the points of each group."""
    total = np.column_stack([np.bincount(group, axis) for axis in points.T])
    return np.asarray(total / np.bincount(group)[:, None])


def _divided(points: FloatArray, group: IntArray, reach: float, most_divisions: int) -> IntArray:
    """(n,) groups of points, of which those that reach farther from their middle are divided in two, again and again.

    Discs that overlap are gathered into one group.
    """
    for _ in range(most_divisions):
        off = points - _middles(points, group)[group]
        farthest = np.zeros(int(group.max()) + 1)
        np.maximum.at(farthest, group, np.linalg.norm(off, axis=1))
        wide = np.flatnonzero(farthest > reach)
        if not len(wide):
            break
        order = np.argsort(group, kind="stable")
        start = np.searchsorted(group[order], np.arange(len(farthest) + 1))
        group = group.copy()
        for number, k in enumerate(wide.tolist(), start=len(farthest)):
            rows = order[start[k] : start[k + 1]]
            group[rows[_in_two(off[rows], most_divisions)]] = number
    return group


def _in_two(points: FloatArray, steps: int) -> BoolArray:
    """(n,) which points belong to the second of two clusters (2-means, from both sides of the longest axis)."""
    second = points @ np.linalg.svd(points, full_matrices=False)[2][0] > 0.0
    for _ in range(steps):
        middles = points[~second].mean(axis=0), points[second].mean(axis=0)
        to_first, to_second = (np.linalg.norm(points - middle, axis=1) for middle in middles)
        second = to_second < to_first
    return np.asarray(second)


def _half_extent(points: FloatArray, group: IntArray, most: float, share: float) -> float:
    """Half of the largest distance in groups of points, up to ``most``: its ``share`` quantile over the groups."""
    from scipy.spatial import cKDTree

    pairs = cKDTree(points).sparse_distance_matrix(cKDTree(points), most, output_type="ndarray")
    pairs = pairs[group[pairs["i"]] == group[pairs["j"]]]
    extent = np.zeros(int(group.max()) + 1)
    np.maximum.at(extent, group[pairs["i"]], pairs["v"])
    return 0.5 * float(np.quantile(extent[extent > 0], share))


def _nearest(centres: FloatArray, others: FloatArray, few_pairs: int) -> tuple[FloatArray, IntArray]:
    """(m,) distance to the nearest of ``centres`` (n, 3) and its index, for ``others`` (m, 3); unit vectors."""
    if len(centres) * len(others) > few_pairs:
        from scipy.spatial import cKDTree

        distance, index = cKDTree(centres).query(others)
        return distance, index
    index = np.argmax(others @ centres.T, axis=1)
    return np.linalg.norm(others - centres[index], axis=1), index

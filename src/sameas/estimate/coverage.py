"""Where two sources look, and how densely their records lie there, from the records alone.

The space is cut into cells of equal size, coarse to fine. A local density is the count of a cell, drawn towards the
density of the coarser cell by pseudo-counts, level after level: coarse where there is little to count, fine where there
is much. A record is *not covered* by the other source where that source is empty although many of its records were
to be expected: seven or more in a cell, or twelve in a disc around a record (``holes.py``), by which borders are drawn
as fine as records lie.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from sameas.arrays import BoolArray, FloatArray, Int32Array, IntArray
from sameas.estimate.cells import FINEST, GridLevel, levels_of
from sameas.kernels import threads
from sameas.records import Records
from sameas.representation import in_short
from sameas.space import ARCSEC_PER_RADIAN, Sphere, ball_volume, unit_vectors

if TYPE_CHECKING:
    from sameas.kernels.coverage import Buckets

# Holes and edges of a source, as fine as its records lie: discs that are empty although many were to be expected.
#
# ``coverage.py`` finds by cells where a source does not look at all; this finds what is left at the borders of that,
# and holes that no cell fits into. A record lies in a hole where it is inside an empty disc around a record of its own
# source (in one dimension an interval, in three a ball): the space without records is opened by that disc.

Floats = TypeVar("Floats", float, FloatArray)

#: Records to be expected in an empty disc by the density where its source looks. More than in a cell (``coverage.py``):
#: cells are few and lie where they lie, a disc is tried around every record.
DISC = 12.0
#: Records to be expected in it by those of the asking source that it holds, its middle among them, so that a place that
#: is poor in objects is not taken for a hole.
COMPANY = 7.0
#: Records to be expected in an empty disc that carries a hole on to its border.
STEP = 5.0
#: An empty disc reaches beyond the border it lies at, up to the first records, by about this part of their spacing.
#: What is found lies that much deeper inside the disc, times 1 − share: discs are tried around records only, and the
#: fewer these are the less often one is found that reaches so far.
OVERREACH = 0.6
#: Dimensions that discs are made for; in more of them neighbours are too many.
MOST_DIMENSIONS = 3
#: Middles nearer to each other than this part of the radius are as good as one, where so many lie in a disc.
APART = 0.125
MANY = 64.0
#: Cells along an axis that numbers are kept for; farther ones share them.
MOST_CELLS = 2.0**40


@in_short
@dataclass(frozen=True)
class Points:
    """The points of a source among which empty discs are sought, in the unit of the residuals.

    points : (n, axes); of directions on the sphere the chords. period : (axes,), infinite where there is none.
    d : of the space, by which a disc's volume goes.
    """

    points: FloatArray
    period: FloatArray
    d: int

    @classmethod
    def of(cls, records: Records) -> Points:
        """That of the records of one source."""
        if isinstance(records.space, Sphere):
            return cls(ARCSEC_PER_RADIAN * unit_vectors(*records.features.T), np.full(3, np.inf), 2)
        period = np.array(records.space.period_list(records.d))
        wraps = np.isfinite(period)
        if not wraps.any():
            return cls(records.features, period, records.d)
        points = records.features.copy()
        points[:, wraps] = np.mod(points[:, wraps], period[wraps])
        return cls(points, period, records.d)

    def near(self, other: Points, distance: float) -> BoolArray:
        """Which points are no farther than ``distance`` from the box around another's, axis by axis."""
        low, high = other.points.min(axis=0) - distance, other.points.max(axis=0) + distance
        outside = ((self.points < low) | (self.points > high)) & np.isinf(self.period)
        return np.asarray(~outside.any(axis=1))

    def at(self, rows: IntArray) -> FloatArray:
        """(r, 3) points of some rows, unused axes zero."""
        points = np.zeros((len(rows), 3))
        points[:, : self.points.shape[1]] = self.points[rows]
        return points

    def isolated(
        self, wanted: BoolArray, density: FloatArray, limits: tuple[float, float], volume: float, other: Points
    ) -> IntArray:
        """Rows of those ``wanted`` with a density within limits in whose discs no point of the other is at hand.

        volume : of the discs, times the density.
        """
        from sameas.kernels.coverage import isolated

        rows = np.empty(len(self.points), np.int32)
        buckets = _buckets(other, (volume / limits[1]) ** (1.0 / self.d) / math.sqrt(self.d), len(other.points))
        found = isolated(self.points, wanted, density, *limits, volume, self.d, other.points, buckets, rows)
        return rows[:found].astype(np.int64)

    def beside(self, centres: FloatArray, radius: FloatArray, side: float) -> IntArray:
        """Rows of all points inside discs around some centres, with others around them."""
        from sameas.kernels.coverage import beside

        rows = np.empty(len(self.points), np.int32)
        found = beside(self.points, _buckets(self, side, len(self.points)), centres, radius, rows)
        return rows[:found].astype(np.int64)


def _buckets(ground: Points, side: float, n: int) -> Buckets:
    """Cells of about one side over a ground, in a table for n points."""
    from sameas.kernels.coverage import Buckets

    low, number, period = np.zeros(3), np.ones(3, np.int64), np.full(3, np.inf)
    sides = np.where(np.arange(3) < len(ground.period), side, np.inf)  # an unused axis is one cell
    for v, wraps in enumerate(ground.period):
        if math.isfinite(wraps):
            number[v], period[v] = math.ceil(wraps / side), wraps
            sides[v] = wraps / number[v]
        else:
            low[v] = float(ground.points[:, v].min())
            number[v] = int(min((float(ground.points[:, v].max()) - low[v]) / side, MOST_CELLS)) + 1 | 1
    return Buckets(low, sides, number, period, (1 << max(4, math.ceil(math.log2(2 * n)))) - 1)


def within_holes(here: Points, seen: BoolArray, there: Points, density: FloatArray, share: float) -> BoolArray:
    """Which records of one source, ``here`` (n,), lie in holes of the other, ``there``.

    seen : (n,) whether they may be covered at all, as far as is known.
    density : (n,) of the other's records to be expected at them, per (unit of the residuals)^d.
    share : records of the other per record of this one where both look.

    The disc of a record has the volume in which :data:`DISC` records of the other source are to be expected.
    What is so found is then carried on to the border by smaller discs around records that lie in it.
    """
    found = ~seen
    if here.d > MOST_DIMENSIONS or len(there.points) < COMPANY or not seen.any():
        return found
    wanted, beyond = seen, OVERREACH * max(0.0, 1.0 - share)
    if not seen.all():
        widest = _radius(DISC, float(density[seen].min()), here.d)
        wanted = seen | here.near(there, 2.0 * widest)
    discs = opened(here, there, wanted, density, DISC, beyond, max(2.0, COMPANY / share))
    if discs.any():
        discs |= opened(here, there, wanted & discs, density, STEP, beyond, 1.0)
    return found | discs


def _radius(expected: float, density: Floats, d: int) -> Floats:
    """Of the disc that holds so many records on average."""
    radius: Floats = (expected / ball_volume(d) / density) ** (1.0 / d)
    return radius


def opened(
    here: Points, there: Points, wanted: BoolArray, density: FloatArray, expected: float, beyond: float, least: float
) -> BoolArray:
    """Which points lie inside empty discs around the points ``wanted`` that hold at least so many of them."""
    found = np.zeros(len(here.points), np.bool_)
    left = density[wanted]
    while len(left):
        high = float(left.max())
        low = high / 2.0**here.d  # discs up to twice as large share their cells
        left = left[left <= low]
        rows = here.isolated(wanted, density, (low, high), expected / ball_volume(here.d), there)
        if len(rows):
            radius = _radius(expected, density[rows], here.d)
            inside = _inside(here, there, rows, radius, beyond * density[rows] ** (-1.0 / here.d), least)
            found[inside] = True
    return found


def _inside(
    here: Points, there: Points, rows: IntArray, radius: FloatArray, beyond: FloatArray, least: float
) -> IntArray:
    """Rows of the points inside discs around those ``rows`` whose discs are empty, and hold enough points."""
    from sameas.kernels.coverage import clear, empty_discs

    side, centres, empty = float(radius.min()) / math.sqrt(here.d), here.at(rows), np.empty(len(rows), np.bool_)
    empty_discs(centres, radius, *_sorted(there, there.beside(centres, radius, side), side), empty)
    centres, radius, beyond = centres[empty], radius[empty], beyond[empty]
    if len(centres) and least > MANY:
        chosen = _apart(centres, APART * float(radius.min()))
        centres, radius, beyond = centres[chosen], radius[chosen], beyond[chosen]
    if not len(centres):
        return np.empty(0, np.int64)
    asked = here.beside(centres, radius, side)
    seen = np.ones(len(asked), np.bool_)
    clear(centres, radius, radius - beyond, least, *_sorted(here, asked, side), seen)
    return asked[~seen]


def _sorted(ground: Points, rows: IntArray, side: float) -> tuple[FloatArray, Buckets, Int32Array, Int32Array]:
    """Some points of a ground (n, 3), their buckets, and the rows of each."""
    from sameas.kernels.coverage import into_buckets

    points, buckets = ground.at(rows), _buckets(ground, side, max(len(rows), 1))
    return points, buckets, *into_buckets(points, buckets)


def _apart(points: FloatArray, side: float) -> IntArray:
    """Of the points in each cell of that side the one nearest its middle, whatever their order."""
    cell = np.floor(points / side)
    away = ((points - (cell + 0.5) * side) ** 2).sum(axis=1)
    order = np.lexsort((*points.T, away, *cell.T))
    first = np.ones(len(order), np.bool_)
    first[1:] = (cell[order[1:]] != cell[order[:-1]]).any(axis=1)
    return np.sort(order[first])


PSEUDO_COUNT = 2.0
#: The same for densities is one of these, level by level what the records tell; few tell little, and that is least
#: where it draws strongly.
SMOOTHS = (500.0, 200.0, 80.0, 30.0, 12.0, 5.0, 2.0)
#: ln of how much less probable each is beforehand than the one before: what few records show by chance is no cluster.
LESS_PROBABLE = 0.7
#: About so many records tell which.
SOME = 10_000
#: Part of a record that the density at its own place does not count in the finest cells. What chance pairs are weighed
#: by is 1/√(ρ₁ρ₂), and of a count N with the mean μ it is (N + ¾)^−½ whose mean is μ^−½: where nobody else is counted
#: chance is likelier than it looks, for a record shows that there are objects.
LEFT_OUT = 0.25
#: The same for shares of one half; for others as many as say as much of the logit of the share.
SHARED_PSEUDO_COUNT = 200.0
#: A source so many times as rich as the other tells which part of a cell both look at.
RICHER = 2.0
#: Expected records in an empty cell that make it a hole: e⁻⁷ is the chance of it by accident.
HOLE = 7.0
#: Records to be expected in it at least by those of the asking source that it holds (see ``holes.COMPANY``).
IN_CELL = 3.5
#: Holes are sought again with the densities outside those found, at most so many times in all, and only where a source
#: proves to be so much denser there.
ROUNDS = 2
DENSER = 1.05
#: Holes smaller than all cells are sought where by so many standard deviations more records lie in empty cells than
#: chance puts there: an even field is done with at once.
UNEVEN = 2.0
#: Least part of the region that is believed to be common.
LEAST_VOLUME = 1e-3


def smoothing(others: FloatArray, volume: FloatArray, density: FloatArray, weight: FloatArray) -> float:
    """The pseudo-count of :data:`SMOOTHS` that the places of a level's records make most probable.

    others : (n,) the other records in the cell of each. volume : of that cell. density : (n,) as coarser cells have it,
    towards which it draws. weight : (n,) as how many each counts.

    An even field draws strongly, one with clusters hardly. The number of records that densities make due is the same
    for all pseudo-counts, so that every record predicted by the others tells which is best.

    Source: Duin 1976, IEEE Transactions on Computers 25, 1175 (smoothing by the likelihood of what was left out).
    """
    scores = [float(weight @ np.log((others + smooth) / (volume + smooth / density))) for smooth in SMOOTHS]
    return SMOOTHS[int(np.argmax(scores - LESS_PROBABLE * np.arange(len(SMOOTHS))))]


def _some_of(records: Records) -> IntArray:
    """About :data:`SOME` records at most, which ones depends on where they are and not on the order of the rows."""
    n = len(records)
    if n <= SOME:
        return np.arange(n)
    bits = np.ascontiguousarray(records.features[:, 0]).view(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    return np.flatnonzero(bits < np.uint64(int(SOME / n * 2.0**64)))


@in_short
@dataclass(frozen=True)
class Coverage:
    """Cells of falling size over two sources. Make it with :meth:`Coverage.of`."""

    first: Records
    second: Records
    volume: float
    levels: tuple[GridLevel, ...]

    @property
    def counted(self) -> tuple[BoolArray, BoolArray]:
        """(n₁,), (n₂,) whether a record counts; in a sample others only compete."""
        return np.ones(len(self.first), np.bool_), np.ones(len(self.second), np.bool_)

    @classmethod
    def of(cls, first: Records, second: Records) -> Coverage:
        """Cells over the stretch that both sources span together; both must have records."""
        return cls(first, second, *levels_of(first, second))

    def part(self, rows_1: IntArray, rows_2: IntArray) -> Coverage:
        """The same cells and footprints, for some of the records, or for all of them in another order."""
        made = Coverage(
            self.first.part(rows_1), self.second.part(rows_2), self.volume,
            tuple(level.part(rows_1, rows_2) for level in self.levels),
        )  # fmt: skip
        one, two = self.covered
        made.__dict__["covered"] = one[rows_1], two[rows_2]
        return made

    def density(
        self, source: int, weights: FloatArray, volumes: Sequence[FloatArray] | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Local density of the records of ``source`` (1 or 2) counted with ``weights``, at the records of both.

        Unit 1 / (residual unit)^d. Cells are as fine as these records tell. A record counts where it stands itself only
        in the finest of them, and for 1 − :data:`LEFT_OUT`.

        volumes : of the cells of each level where the source looks; if not given, all of them.
        """
        from sameas.kernels.coverage import refine

        volumes = [level.volume for level in self.levels] if volumes is None else volumes
        start = (float(weights.sum()) + 0.5) / float(volumes[0].sum())
        at_first, at_second = np.full(len(self.first), start), np.full(len(self.second), start)
        at = (at_first, at_second) if source == 1 else (at_second, at_first)
        some, every = _some_of(self.first if source == 1 else self.second), bool((weights == 1.0).all())
        for level, volume in zip(self.levels, volumes, strict=True):
            cell, _ = level.facing(source)
            count = level.count(source) if every else np.bincount(cell, weights, len(volume))
            finest = level is self.levels[-1] or count @ count <= FINEST * weights.sum()
            others = np.maximum(count[cell[some]] - weights[some], 0.0)
            smooth = smoothing(others, volume[cell[some]], at[0][some], weights[some])
            refine(*level.facing(source), LEFT_OUT * weights if finest else weights, volume, count, smooth, *at)
            if finest:
                break
        return at_first, at_second

    @cached_property
    def covered_densities(self) -> tuple[tuple[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]:
        """Local densities of the covered records of source 1 and of source 2, each at the records of both."""
        seen = [covered.astype(np.float64) for covered in self.covered]
        one, two = (float(weights.sum()) for weights in seen)
        volumes = self._common_volumes()
        if max(one, two) <= RICHER * min(one, two):
            at_1, at_2 = threads.each([partial(self.density, k + 1, seen[k], volumes) for k in (0, 1)], len(seen[0]))
            return at_1, at_2
        richer = 1 if one > two else 2
        known = self.density(richer, seen[richer - 1], volumes)
        other = self.density(3 - richer, seen[2 - richer], self._seen_volumes(richer, seen[richer - 1], known))
        return (known, other) if richer == 1 else (other, known)

    def _common_volumes(self) -> list[FloatArray]:
        """Level by level (c,) the volume of the cells where both sources look, as their records tell.

        Two fields that overlap by a strip share a part of a large cell only. Of a cell that they fill together, where
        shares s₁ and s₂ of their records lie in what is common, that is 1 / (1/s₁ + 1/s₂ − 1).
        """
        if all(covered.all() for covered in self.covered):
            return [level.volume for level in self.levels]
        volumes = []
        for level in self.levels:
            n, inverse = len(level.volume), []
            for of, covered in zip((level.of_first, level.of_second), self.covered, strict=True):
                every, seen = np.bincount(of, minlength=n), np.bincount(of, covered, n)
                inverse.append(np.where(every > 0, np.maximum(every, 0.5) / np.maximum(seen, 0.5), np.nan))
            one, two = (np.where(np.isnan(a), b, a) for a, b in (inverse, inverse[::-1]))
            volumes.append(level.volume / np.nan_to_num(np.maximum(one + two - 1.0, 1.0), nan=1.0))
        return volumes

    def _seen_volumes(self, richer: int, seen: FloatArray, density: tuple[FloatArray, FloatArray]) -> list[FloatArray]:
        """Level by level (c,) the volume of the cells where both sources look, as the records of the ``richer`` tell.

        Each of them stands for a volume in proportion to 1/density. Where the poorer source has few records in a cell,
        its density is that of cells much larger, which at the borders of a field reach far beyond it.

        seen : (n,) 1 for its records where the other source looks, else 0. density : its own, at the records of both.
        """
        stands_for = seen / density[richer - 1]
        stands_for *= self.common_volume / float(stands_for.sum())
        cells = ((level.facing(richer)[0], len(level.volume)) for level in self.levels)
        return [np.asarray(np.bincount(of, stands_for, n), np.float64) for of, n in cells]

    @cached_property
    def covered(self) -> tuple[BoolArray, BoolArray]:
        """Whether source 2 looks where each record of source 1 lies, (n₁,), and the reverse, (n₂,)."""
        works = [partial(self._looked, 1, 2), partial(self._looked, 2, 1)]
        (company_1, highest_2, excess_2), (company_2, highest_1, excess_1) = threads.each(works, len(self.first))
        n_seen = [max(int(np.count_nonzero(company == 0.0)), 1) for company in (company_1, company_2)]
        # By the other records of its own source too, so that a place poor in objects is not taken for a hole.
        least = IN_CELL * n_seen[0] / n_seen[1], IN_CELL * n_seen[1] / n_seen[0]
        seen = company_1 < max(least[0], 1.0), company_2 < max(least[1], 1.0)
        if all(where.all() for where in seen) and max(excess_1, excess_2) < UNEVEN:
            return seen
        mean = self._mean(*seen)
        for _ in range(ROUNDS):
            seen = self._opened(seen, (highest_1, highest_2), mean)
            before, mean = mean, self._mean(*seen)
            if max(mean[0] / before[0], mean[1] / before[1]) < DENSER:
                break
        return seen

    @cached_property
    def _grounds(self) -> tuple[Points, Points]:
        one, two = threads.each([partial(Points.of, self.first), partial(Points.of, self.second)], len(self.first))
        return one, two

    def _mean(self, seen_1: BoolArray, seen_2: BoolArray) -> tuple[float, float]:
        """Mean densities of both sources where both look, if they look at these records."""
        volume = max(self._volume(seen_1, seen_2), LEAST_VOLUME * self.volume)
        number_1, number_2 = (max(int(np.count_nonzero(seen)), 1) for seen in (seen_1, seen_2))
        return number_1 / volume, number_2 / volume

    def _opened(
        self, seen: tuple[BoolArray, BoolArray], highest: tuple[FloatArray, FloatArray], mean: tuple[float, float]
    ) -> tuple[BoolArray, BoolArray]:
        """``seen`` without what empty discs say too.

        highest : local densities of source 1 at the records of source 2, and of source 2 at those of source 1.
        mean : of both sources; at least as much is to be expected.
        """
        first, second = self._grounds
        of_first, of_second = (np.maximum(local, least) for local, least in zip(highest, mean, strict=True))
        one, two = threads.each(
            [
                partial(within_holes, first, seen[0], second, of_second, mean[1] / mean[0]),
                partial(within_holes, second, seen[1], first, of_first, mean[0] / mean[1]),
            ],
            len(self.first),
        )
        return ~one, ~two

    def _looked(self, query: int, source: int) -> tuple[FloatArray, FloatArray, float]:
        """As far as cells tell, of the records of ``query``: how many lie in the cell of each where ``source`` has none
        although it should, 0 where that is not so; how dense ``source`` is there if it looks; and by how many standard
        deviations more records than chance puts there lie in empty cells.
        """
        from sameas.kernels.coverage import look

        n = len(self.first if query == 1 else self.second)
        density = np.full(n, len(self.first if source == 1 else self.second) / self.volume)
        company, highest, excess = np.zeros(n), np.zeros(n), 0.0
        for level in self.levels:
            cells, _ = level.facing(query)
            counts = level.count(source), level.count(query)
            more = look(cells, level.volume, *counts, PSEUDO_COUNT, HOLE, company, density, highest)
            excess = max(excess, more)
        return company, highest, excess

    @cached_property
    def common_volume(self) -> float:
        """Volume where both sources look, (residual unit)^d: of every cell the part that its covered records tell.

        Cells are the finest that hold so many records that an empty one is hardly ever an accident.
        """
        return self._volume(*self.covered)

    def _volume(self, seen_1: BoolArray, seen_2: BoolArray) -> float:
        from sameas.kernels.coverage import shared_part

        richer = max(len(self.first), len(self.second))
        fine = next((level for level in self.levels[::-1] if richer >= HOLE * len(level.volume)), self.levels[0])
        count = np.zeros((len(fine.volume), 4))
        return float(shared_part(fine.of_first, seen_1, fine.of_second, seen_2, count) @ fine.volume)


def local_share(
    levels: Sequence[GridLevel], source: int, part: FloatArray, weights: FloatArray, *, elsewhere: bool = True
) -> tuple[FloatArray, FloatArray]:
    """Local share Σ part / Σ weights of the records of ``source`` (1 or 2), at the records of both; without
    ``elsewhere`` at these alone, and the other source's array is empty.

    Drawn towards that of the coarser cell by many pseudo-counts: a share that is itself being estimated must not
    gather where a few chance pairs happen to lie.
    """
    from sameas.kernels.coverage import refine_share

    start = (float(part.sum()) + 0.5) / (float(weights.sum()) + 1.0)
    most = None if elsewhere else 0
    own, other = (np.full(len(cells), start) for cells in levels[0].facing(source))
    other = other[:most]
    for level in levels:
        sums = np.empty(len(level.volume)), np.empty(len(level.volume))
        cells, others = level.facing(source)
        refine_share(cells, others[:most], part, weights, *sums, SHARED_PSEUDO_COUNT, own, other)
    return (own, other) if source == 1 else (other, own)

"""Where two sources observe, and how dense their records are there, from the records alone.

The space is divided into cells of equal size, coarse to fine. A local density is the count in a cell, drawn towards the
density of the coarser cell by pseudo-counts, level by level: so it is coarse where records are few and fine where they
are many. A record is *not covered* by the other source where that source is empty although many of its records are
expected: seven or more in a cell, or twelve in a disc around a record, which resolves borders to the spacing of the
records.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import TYPE_CHECKING

import numpy as np

from sameas.arrays import BoolArray, FloatArray, IntArray, inner, median
from sameas.estimate.cells import FINEST_CELLS, GridLevel, levels_of
from sameas.estimate.discs import Discs
from sameas.estimate.holes import (
    MAX_HOLE_DIMENSIONS,
    PLACE_OF_AXES,
    Points,
    geometric_mean,
    places_of_cells,
    within_holes,
)
from sameas.kernels import threads
from sameas.records import Records
from sameas.representation import in_short
from sameas.space import Sphere, ball_volume

if TYPE_CHECKING:
    from scipy.spatial import cKDTree


COVERAGE_PSEUDO_COUNT = 2.0  # pseudo-count of the densities by which holes in cells are found
#: Decrease of ln prior from one of these to the next, so that chance concentrations of few records make no cluster.
LOG_PRIOR_STEP = 0.7
SOME = 10_000  # about this many records are used for the choice
#: Fraction of itself that a record excludes from the density at its own position in the finest cells. The weight of
#: chance pairs is 1/√(ρ₁ρ₂), and for a count N with mean μ, (N + ¾)^−½ has the mean μ^−½: excluding the whole record
#: would underestimate chance, because a record shows that there are objects.
LEFT_OUT = 0.25
#: Neighbours nearer than this many typical errors of a residual are not counted in local densities: they may be
#: companions, or another record of the same object.
NEAR = 7.0
#: Ratio of the volumes of successive balls in which neighbours are counted; the first has this many times the volume of
#: a finest cell.
SHELL = 2.0
#: Least gain in ln likelihood of the sampled records by neighbours in one ball; every couple of neighbours counts twice
#: in it. Even fields gain at most 3 in a ball, clumps smaller than cells hundreds.
MIN_GAIN = 16.0
#: Most neighbours of a record in the largest ball, on average; a ball of twice a cell holds 8 in an even field. Pairs
#: of a record and a neighbour that are held at once: 100 MB.
MOST_NEIGHBOURS, PAIRS_AT_ONCE = 300, 4_000_000
#: With more records than this for each sampled one, only those near the sample are searched until it decides.
SPARSE = 20
#: Pseudo-count of local shares of one half; for other shares, the count with the same information on the logit.
SHARED_PSEUDO_COUNT = 200.0
RICHER = 2.0  # a source this many times richer than the other determines the part of a cell where both observe
#: Records expected in it from the number of records of the querying source in it, at least (as
#: MIN_EXPECTED in a disc).
IN_CELL = 3.5
#: The search for holes is repeated with the densities outside those found, at most this often, while a source is denser
#: there by this factor.
ROUNDS, DENSER = 2, 1.05
MIN_VOLUME = 1e-3  # least fraction of the region that is common to both sources


#: Pseudo-counts of local densities, one of which is chosen per level by the likelihood of the records (with few records
#: the strongest one); and those of the densities in balls of neighbours.
SMOOTHS = (500.0, 200.0, 80.0, 30.0, 12.0, 5.0, 2.0)
SHELL_SMOOTHS = (*SMOOTHS, 1.0, 0.5)
HOLE = 7.0  # records expected in an empty cell that is taken for a hole, which by chance is empty with probability e⁻⁷
#: Holes smaller than cells are searched for if the records in empty cells exceed chance by this many standard
#: deviations, which an even field does not.
UNEVEN = 2.0


def smoothing(
    others: FloatArray, volume: FloatArray, density: FloatArray, weight: FloatArray, smooths: Sequence[float]
) -> tuple[float, float]:
    """The maximum-likelihood pseudo-count of ``smooths`` for one level of cells, and the ln posterior of the records.

    others : (n,) other records in the cell of each record. volume : of that cell. density : (n,) by coarser cells,
    towards which the pseudo-count draws. weight : (n,) of the records.

    The pseudo-count is large for an even field and small for one with clusters. The expected number of records is the
    same for all pseudo-counts, so that the prediction of every record by the others decides.

    Source: Duin 1976, IEEE Transactions on Computers 25, 1175 (smoothing by leave-one-out likelihood).
    """
    fits = [inner(weight, np.log((others + smooth) / (volume + smooth / density))) for smooth in smooths]
    scores = fits - LOG_PRIOR_STEP * np.arange(len(smooths))
    best = int(np.argmax(scores))
    return smooths[best], float(scores[best])


def typical_error(one: Records, two: Records) -> FloatArray:
    """(d,) typical error of a pair along every axis, in residual units; equal for both axes of a sphere."""
    both = [np.array([median(axis) for axis in records.variances.T]) for records in (one, two)]
    variance = np.broadcast_to(both[0] + both[1], one.d)
    if isinstance(one.space, Sphere):
        variance = np.full(2, variance.mean())
    return np.asarray(np.sqrt(variance))


def _sampled(records: Records, some: int) -> IntArray:
    """At most about ``some`` records, chosen by a hash of their positions, not by the order of the rows."""
    n = len(records)
    if n <= some:
        return np.arange(n)
    bits = np.ascontiguousarray(records.features[:, 0]).view(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    return np.flatnonzero(bits < np.uint64(int(some / n * 2.0**64)))


def _near_some(points: FloatArray, some: IntArray, distance: float) -> BoolArray:
    """(n,) mask of all points (n, d) within a distance of some of them, and of further ones: of the cells around."""
    place, last = places_of_cells(points, distance)
    d = points.shape[1]
    around = np.stack(np.meshgrid(*d * [[-1, 0, 1]]), axis=-1).reshape(-1, d) @ PLACE_OF_AXES[:d]
    marked = np.zeros(last + 1, np.bool_)
    marked[(place[some][:, None] + around) & last] = True
    return np.asarray(marked[place])


@dataclass(frozen=True)
class _Balls:
    """Numbers of some points within balls around others. pairs_at_once : most pairs that are held at once."""

    tree: cKDTree
    pairs_at_once: int

    @classmethod
    def around(cls, points: FloatArray, pairs_at_once: int) -> _Balls:
        from scipy.spatial import cKDTree

        return cls(cKDTree(points), pairs_at_once)

    def number(self, centres: FloatArray, radius: float) -> int:
        """Number of pairs of a centre and a point within ``radius``."""
        return int(self.tree.count_neighbors(type(self.tree)(centres), radius))

    def neighbours(self, centres: FloatArray, radii: FloatArray, near: float) -> FloatArray:
        """(r, n) points nearer than each of descending ``radii``, and farther than ``near``, which is the least."""
        ascending, out = np.append(near, radii[::-1]), np.zeros((len(radii), len(centres)))
        pieces = 1 + self.number(centres, radii[0]) // self.pairs_at_once
        for rows in np.array_split(np.argsort(centres[:, 0], kind="stable"), pieces):
            tree = type(self.tree)(centres[rows])
            pairs = tree.sparse_distance_matrix(self.tree, radii[0], output_type="ndarray")
            place = pairs["i"] * len(ascending) + np.searchsorted(ascending, pairs["v"])
            count = np.bincount(place, minlength=len(rows) * len(ascending)).reshape(len(rows), -1)
            out[:, rows] = np.cumsum(count[:, 1:], axis=1)[:, ::-1].T
        return out


@in_short
@dataclass(frozen=True)
class Coverage:
    """Cells of decreasing size over two sources. Make it with :meth:`Coverage.of`.

    discs : of which the field consists, if one source or both were queried around targets. of_part : the levels of
    cells of a part, which are those of all records.
    """

    first: Records
    second: Records
    volume: float
    discs: Discs | None = field(default=None, kw_only=True)
    of_part: tuple[GridLevel, ...] | None = field(default=None, kw_only=True, repr=False)

    @cached_property
    def levels(self) -> tuple[GridLevel, ...]:
        """Cells, coarse to fine."""
        return levels_of(self.first, self.second)[1] if self.of_part is None else self.of_part

    @property
    def counted(self) -> tuple[BoolArray, BoolArray]:
        """(n₁,), (n₂,) whether a record counts; in a sample, other records only compete."""
        return np.ones(len(self.first), np.bool_), np.ones(len(self.second), np.bool_)

    @classmethod
    def of(cls, first: Records, second: Records) -> Coverage:
        """Cells over the region of both sources, which must have records."""
        volume, levels, discs = levels_of(first, second)
        coverage = cls(first, second, volume, discs=discs)
        coverage.__dict__["levels"] = levels
        return coverage

    def part(self, rows_1: IntArray, rows_2: IntArray) -> Coverage:
        """The same cells and footprints, for some of the records, or for all in another order."""
        levels = tuple(level.part(rows_1, rows_2) for level in self.levels)
        first, second = self.first.part(rows_1), self.second.part(rows_2)
        coverage = Coverage(first, second, self.volume, of_part=levels)
        one, two = self.covered
        coverage.__dict__["covered"] = one[rows_1], two[rows_2]
        return coverage

    def release(self) -> None:
        """Free the cells and densities, a tenth of the memory of a match; computed again when next used."""
        _ = self.covered, self.common_volume
        for name in ("levels", "covered_densities", "_points"):
            self.__dict__.pop(name, None)

    def density(
        self, source: int, weights: FloatArray, volumes: Sequence[FloatArray] | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Local density of the records of ``source`` (1 or 2) counted with ``weights``, at the records of both.

        Unit 1 / (residual unit)^d. The number of records limits the fineness of cells. At its own position, a record
        counts only in the finest cells, and there 1 − LEFT_OUT.

        volumes : per level, of the cells where the source observes; all cells if not given.
        """
        from sameas.kernels.coverage import refine

        volumes = [level.volume for level in self.levels] if volumes is None else volumes
        start = (float(weights.sum()) + 0.5) / float(volumes[0].sum())
        at_first, at_second = np.full(len(self.first), start), np.full(len(self.second), start)
        at = (at_first, at_second) if source == 1 else (at_second, at_first)
        sample = _sampled(self.first if source == 1 else self.second, SOME)
        unweighted = bool((weights == 1.0).all())
        for level, volume in zip(self.levels, volumes, strict=True):
            cell, _ = level.facing(source)
            count = (
                level.count(source) if unweighted else np.asarray(np.bincount(cell, weights, len(volume)), np.float64)
            )
            finest = level is self.levels[-1] or inner(count, count) <= FINEST_CELLS * weights.sum()
            others = np.maximum(count[cell[sample]] - weights[sample], 0.0)
            smooth, _ = smoothing(others, volume[cell[sample]], at[0][sample], weights[sample], SMOOTHS)
            without = (others + smooth) / (volume[cell[sample]] + smooth / at[0][sample])
            refine(*level.facing(source), LEFT_OUT * weights if finest else weights, volume, count, smooth, *at)
            if finest:
                break
        if smooth < SMOOTHS[0] and len(self.levels) > 1 and (unweighted or bool(np.isin(weights, (0.0, 1.0)).all())):
            self._count_neighbours(source, weights > 0.0, float(np.median(volume)), without, sample, at)
        return at_first, at_second

    def _count_neighbours(
        self, source: int, counted: BoolArray, volume: float, without: FloatArray, sample: IntArray,
        at: tuple[FloatArray, FloatArray],
    ) -> None:  # fmt: skip
        """Refine densities ``at`` the records of ``source`` and of the other in place by their neighbours in balls.

        Clumps smaller than cells are seen by the neighbours of each record: with the cells alone, chance partners in
        them were stated a fourth as often as they occurred. Balls shrink while the likelihood of the records grows.

        counted : (n,) records of the source that are counted. volume : of the finest cells. sample : (s,) rows that
        decide. without : (s,) their densities by cells, without the record itself.
        """
        d, unit = self.first.d, self.typical_error
        one, two = self._points if source == 1 else self._points[::-1]
        if d > MAX_HOLE_DIMENSIONS or np.isfinite(one.period).any() or not (unit > 0.0).all() or not counted.any():
            return
        mean = geometric_mean(unit)
        points, others = one.points / mean, two.points / mean
        per_volume = float(np.prod(unit))
        radius = (SHELL * volume / per_volume / ball_volume(d)) ** (1.0 / d)
        n_balls = math.ceil(d * math.log(radius / NEAR) / math.log(SHELL)) - 1
        if n_balls < 1:
            return
        radii = radius * SHELL ** (-np.arange(n_balls) / d)
        shells = per_volume * ball_volume(d) * (radii**d - NEAR**d)
        near_sample, weight = counted, counted[sample].astype(np.float64)
        if len(points) > SPARSE * len(sample):
            near_sample = counted & _near_some(points, sample, radius)
        balls = _Balls.around(points[near_sample], PAIRS_AT_ONCE)
        if balls.number(points[sample], radius) > MOST_NEIGHBOURS * len(sample):
            return
        accepted: list[tuple[int, float]] = []
        for ball, number in enumerate(balls.neighbours(points[sample], radii, NEAR)):
            shell = np.full(len(sample), shells[ball])
            smooth, score = smoothing(number, shell, without, weight, SHELL_SMOOTHS)
            if score - inner(weight, np.log(without)) > MIN_GAIN:
                without = (number + smooth) / (shell + smooth / without)
                accepted.append((ball, smooth))
            elif accepted:
                break
        if not accepted:
            return
        balls = balls if near_sample is counted else _Balls.around(points[counted], PAIRS_AT_ONCE)
        for density, there in zip(at, (points, others), strict=True):
            numbers = balls.neighbours(there, radii[[ball for ball, _ in accepted]], NEAR)
            for (ball, smooth), number in zip(accepted, numbers, strict=True):
                density[:] = (number + smooth) / (shells[ball] + smooth / density)

    @cached_property
    def covered_densities(self) -> tuple[tuple[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]:
        """Local densities of the covered records of source 1 and of source 2, each at the records of both sources."""
        weights = [covered.astype(np.float64) for covered in self.covered]
        one, two = (float(covered.sum()) for covered in weights)
        volumes = self._common_volumes()
        if max(one, two) <= RICHER * min(one, two):
            at_1, at_2 = threads.each(
                [partial(self.density, k + 1, weights[k], volumes) for k in (0, 1)], len(weights[0])
            )
            return at_1, at_2
        richer = 1 if one > two else 2
        rich = self.density(richer, weights[richer - 1], volumes)
        poor = self.density(3 - richer, weights[2 - richer], self._volumes_by_richer(richer, weights[richer - 1], rich))
        return (rich, poor) if richer == 1 else (poor, rich)

    def _common_volumes(self) -> list[FloatArray]:
        """Per level, (c,) the volume of the cells where both sources observe, from their records.

        Fields that overlap in a strip share only a part of a large cell. For a cell that they fill together, with
        shares s₁ and s₂ of their records in the common part, that part is 1 / (1/s₁ + 1/s₂ − 1).
        """
        if all(covered.all() for covered in self.covered):
            return [level.volume for level in self.levels]
        volumes = []
        for level in self.levels:
            n, inverse = len(level.volume), []
            for of, covered in zip((level.of_first, level.of_second), self.covered, strict=True):
                count, common = np.bincount(of, minlength=n), np.bincount(of, covered, n)
                inverse.append(np.where(count > 0, np.maximum(count, 0.5) / np.maximum(common, 0.5), np.nan))
            one, two = (np.where(np.isnan(a), b, a) for a, b in (inverse, inverse[::-1]))
            volumes.append(level.volume / np.nan_to_num(np.maximum(one + two - 1.0, 1.0), nan=1.0))
        return volumes

    def _volumes_by_richer(
        self, richer: int, covered: FloatArray, density: tuple[FloatArray, FloatArray]
    ) -> list[FloatArray]:
        """Per level, (c,) the volume of the cells where both sources observe, from the records of the ``richer``.

        Each record represents a volume proportional to 1/density. Where the poorer source has few records in a cell,
        its density is that of much larger cells, which extend far beyond the borders of a field.

        covered : (n,) 1 for its records where the other source observes, else 0. density : its own, at both sources'
        records.
        """
        represented = covered / density[richer - 1]
        represented *= self.common_volume / float(represented.sum())
        cells = ((level.facing(richer)[0], len(level.volume)) for level in self.levels)
        return [np.asarray(np.bincount(of, represented, n), np.float64) for of, n in cells]

    @cached_property
    def covered(self) -> tuple[BoolArray, BoolArray]:
        """(n₁,), (n₂,) whether the other source observes at each record of source 1, and of source 2."""
        works = [partial(self._empty_cells, 1, 2), partial(self._empty_cells, 2, 1)]
        (own_in_empty_1, highest_2, excess_2), (own_in_empty_2, highest_1, excess_1) = threads.each(
            works, len(self.first)
        )
        n_observed = [
            max(int(np.count_nonzero(own_in_empty == 0.0)), 1) for own_in_empty in (own_in_empty_1, own_in_empty_2)
        ]
        # Requires enough records of its own source, too, so that a region poor in objects is not taken for a hole.
        least = IN_CELL * n_observed[0] / n_observed[1], IN_CELL * n_observed[1] / n_observed[0]
        covered = own_in_empty_1 < max(least[0], 1.0), own_in_empty_2 < max(least[1], 1.0)
        if all(each.all() for each in covered) and max(excess_1, excess_2) < UNEVEN:
            return covered
        mean = self._mean_densities(*covered)
        for _ in range(ROUNDS):
            covered = self._outside_holes(covered, (highest_1, highest_2), mean)
            previous, mean = mean, self._mean_densities(*covered)
            if max(mean[0] / previous[0], mean[1] / previous[1]) < DENSER:
                break
        return covered

    @cached_property
    def _points(self) -> tuple[Points, Points]:
        works = [partial(Points.of, records, self.typical_error) for records in (self.first, self.second)]
        one, two = threads.each(works, len(self.first))
        return one, two

    def _mean_densities(self, covered_1: BoolArray, covered_2: BoolArray) -> tuple[float, float]:
        """Mean densities of both sources where both observe, for these covered records."""
        volume = max(self._volume(covered_1, covered_2), MIN_VOLUME * self.volume)
        number_1, number_2 = (max(int(np.count_nonzero(covered)), 1) for covered in (covered_1, covered_2))
        return number_1 / volume, number_2 / volume

    def _outside_holes(
        self, covered: tuple[BoolArray, BoolArray], highest: tuple[FloatArray, FloatArray], mean: tuple[float, float]
    ) -> tuple[BoolArray, BoolArray]:
        """``covered`` without records in holes found by empty discs.

        highest : local densities of source 1 at the records of source 2, and of source 2 at those of source 1.
        mean : densities of both sources, lower limits of the expected ones.
        """
        first, second = self._points
        of_first, of_second = (np.maximum(local, least) for local, least in zip(highest, mean, strict=True))
        one, two = threads.each(
            [
                partial(within_holes, first, covered[0], second, of_second, mean[1] / mean[0]),
                partial(within_holes, second, covered[1], first, of_first, mean[0] / mean[1]),
            ],
            len(self.first),
        )
        return ~one, ~two

    def _empty_cells(self, query: int, source: int) -> tuple[FloatArray, FloatArray, float]:
        """Empty cells of ``source`` at the records of ``query``.

        Returns (n,) the number of query records in the record's cell if ``source`` is unexpectedly empty there, else 0;
        (n,) the density of ``source`` there if it observes; and the excess of query records in empty cells over chance,
        in standard deviations.
        """
        from sameas.kernels.coverage import check_cells

        n = len(self.first if query == 1 else self.second)
        density = np.full(n, len(self.first if source == 1 else self.second) / self.volume)
        own_in_empty, highest, excess = np.zeros(n), np.zeros(n), 0.0
        for level in self.levels:
            cells, _ = level.facing(query)
            counts = level.count(source), level.count(query)
            more = check_cells(
                cells, level.volume, *counts, COVERAGE_PSEUDO_COUNT, HOLE, own_in_empty, density, highest
            )
            excess = max(excess, more)
        return own_in_empty, highest, excess

    @cached_property
    def typical_error(self) -> FloatArray:
        """(d,) :func:`typical_error` of both sources."""
        return typical_error(self.first, self.second)

    @cached_property
    def common_volume(self) -> float:
        """Volume where both sources observe, (residual unit)^d, from the covered part of the records in each cell.

        Cells are the finest that hold so many records that few are empty by chance.
        """
        return self._volume(*self.covered)

    def _volume(self, covered_1: BoolArray, covered_2: BoolArray) -> float:
        from sameas.kernels.coverage import shared_part

        richer = max(len(self.first), len(self.second))
        fine = next((level for level in self.levels[::-1] if richer >= HOLE * len(level.volume)), self.levels[0])
        count = np.zeros((len(fine.volume), 4))
        return inner(shared_part(fine.of_first, covered_1, fine.of_second, covered_2, count), fine.volume)


def local_share(
    levels: Sequence[GridLevel],
    source: int,
    part: FloatArray,
    weights: FloatArray,
    *,
    pseudo_count: float,
    elsewhere: bool = True,
) -> tuple[FloatArray, FloatArray]:
    """Local share Σ part / Σ weights of the records of ``source`` (1 or 2), at the records of both; without
    ``elsewhere`` at its own only, and the other source's array is empty.

    Drawn towards that of the coarser cell by ``pseudo_count`` records; many, so that the estimated share does not
    concentrate at chance pairs.
    """
    from sameas.kernels.coverage import refine_share

    start = (float(part.sum()) + 0.5) / (float(weights.sum()) + 1.0)
    most = None if elsewhere else 0
    own, other = (np.full(len(cells), start) for cells in levels[0].facing(source))
    other = other[:most]
    for level in levels:
        sums = np.empty(len(level.volume)), np.empty(len(level.volume))
        cells, others = level.facing(source)
        refine_share(cells, others[:most], part, weights, *sums, pseudo_count, own, other)
    return (own, other) if source == 1 else (other, own)

"""Fields that are discs around a list of targets.

One source, or both, may have been queried within a radius around each of a list of targets, the records of the other
source or in neither of the two (:class:`Discs`). Such discs (cone searches) may hold two or three records each, and
fill a millionth of the sky that the list spans. Cells find a density from four records on, so they would take the sky
between the discs for a part of the field, its density for that of chance, and every neighbour for the partner.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.space import ARCSEC_PER_RADIAN, unit_vectors

# Parameters of the search for discs; chosen where no source is given.
#: Records whose nearest centres are found first, since few fields are discs; and the number of centres above which none
#: are looked for.
FIRST_RECORDS, MOST_CENTRES = 16, 200_000
FULL = 0.25  # discs must fill at most this fraction of the region of all records
#: Least number of records in the outer half of the discs, and in the outer half per record in the quarter of the area
#: next to it: in discs 2, around partners alone (residuals of any distribution that falls outwards) less than 1.
OUTER, FLAT = 8, 1.2
#: Least number of records that have the same nearest centre as another, per record in the outer half. Two catalogues of
#: the same objects with a shift or a rotation between them fill discs as well, but with one record each.
REPEATED = 0.5
#: Most pairs of a centre and a record for finding the nearest centres without a tree, whose import takes longer; twice
#: FIRST_RECORDS records, which are the most that are looked at first, stay below it.
FEW_PAIRS = 8_000_000
POINTS = 64  # points per disc at which the number of discs that overlap is counted
#: Around targets that no source lists: pairs of one source's records in the cells, as a multiple of those of an even
#: field, from which discs are looked for; least mean number of neighbours in a disc; most pairs of neighbours.
CLUMPED, NEIGHBOURS, MOST_PAIRS = 1.5, 0.5, 20_000_000
#: Steps of the distance within which neighbours are counted, and most growth of their number over two steps where the
#: discs end, in which an even field has 2.4 times as many.
STEP, GROWTH = 1.25, 1.08
#: The distance within which 90 % of the pairs of records in a disc lie, in radii: of records that fill it evenly, and
#: where one of 1 + k is the target at its centre, by 1/k (simulated).
NINE_TENTHS = 1.49
AROUND_TARGETS = ((0.0, 0.2, 0.5, 1.0), (1.49, 1.39, 1.15, 0.95))
#: Most pairs within half of that distance, as a fraction of all: 0.39 in evenly filled discs, less around targets, 0.44
#: in Gaussian clusters; two standard deviations more are allowed.
HALF = 0.42
#: Most neighbours per record, as a multiple of the other records per disc: 1 to 2 in discs; more where few clusters lie
#: among many single records.
UNEQUAL = 2.5
#: Least fraction of the pairs that must be of discs with three records of a source or more: with half a neighbour per
#: target it is a half; couples of companions have none.
SEVERAL = 0.33
#: Least fraction of the records that must lie within REACH radii of the middle of their disc where no discs overlap,
#: and most divisions of those that do.
WITHIN, REACH, MOST_DIVISIONS = 0.95, 1.25, 6


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
    def of(cls, positions: tuple[FloatArray, FloatArray], region: float, clumped: float = 0.0) -> Discs | None:
        """The discs of two sources on the sphere, or None if their fields are something else.

        positions : (n₁, 2), (n₂, 2) longitude and latitude in degrees. region : area of the region of all records.
        clumped : pairs of one source's records in cells, as a multiple of those of an even field; of both, the smaller.
        """
        for centres, others in ((0, 1), (1, 0)):
            found = _around(positions[centres], positions[others], FULL * region)
            if found is not None:
                return cls(centres + 1, *found)
        if clumped >= CLUMPED:
            found = _around_neither(positions, region)
            if found is not None:
                return cls(0, *found)
        return None


def _around(centres: FloatArray, others: FloatArray, most: float) -> tuple[float, IntArray, FloatArray] | None:
    """Radius, nearest centres and areas of discs of at most this total area; None if ``others`` fill no discs."""
    if len(centres) > MOST_CENTRES or len(others) < OUTER:
        return None
    ground = unit_vectors(*centres.T)
    some = unit_vectors(*others[:: max(1, len(others) // FIRST_RECORDS)].T)
    least = float(_nearest(ground, some, FEW_PAIRS)[0].max()) * ARCSEC_PER_RADIAN
    # Discs that overlap at most by half.
    if 0.5 * len(centres) * math.pi * least**2 > most:
        return None
    chord, of = _nearest(ground, unit_vectors(*others.T), FEW_PAIRS)
    # The outermost of n records lies at about 1 − 1/2n of the radius.
    reach = float(chord.max()) * (1.0 + 0.5 / len(others))
    outer = int(np.count_nonzero(chord > reach * math.sqrt(0.5)))
    next_to_it = int(np.count_nonzero(chord > 0.5 * reach)) - outer
    if outer < OUTER or outer < FLAT * next_to_it or len(of) - len(np.unique(of)) < REPEATED * outer:
        return None
    radius, area = reach * ARCSEC_PER_RADIAN, _areas(ground, reach)
    return None if area.sum() > most else (radius, np.asarray(of, np.int64), area)


def _areas(ground: FloatArray, reach: float) -> FloatArray:
    """(n,) area in square arcsec of discs around ``ground`` (n, 3), with their shares of what overlaps.

    reach : radius of the discs, as a chord.
    """
    from scipy.spatial import cKDTree

    tree = cKDTree(ground)
    # A sunflower: points that share the area of a disc evenly.
    k = np.arange(POINTS) + 0.5
    at, angle = reach * np.sqrt(k / POINTS), k * math.pi * (3.0 - math.sqrt(5.0))
    pole = np.eye(3)[np.argmin(np.abs(ground), axis=1)]
    east = np.cross(ground, pole)
    east /= np.linalg.norm(east, axis=1)[:, None]
    north = np.cross(ground, east)
    share = np.zeros(len(ground))
    for x, y in zip(at * np.cos(angle), at * np.sin(angle), strict=True):
        share += 1.0 / np.maximum(tree.query_ball_point(ground + x * east + y * north, reach, return_length=True), 1)
    return np.asarray(math.pi * (reach * ARCSEC_PER_RADIAN) ** 2 * share / POINTS)


def _around_neither(
    positions: tuple[FloatArray, FloatArray], region: float
) -> tuple[float, IntArray, FloatArray] | None:
    """Radius, disc of each record and areas of discs around targets that no source lists; None without such discs.

    Neighbours are counted within a source, because partners of the other are no sign of a disc. Their number beyond
    those of an even field grows with the distance up to the diameter of the discs, and no more from there on.
    """
    n = np.array([len(positions[0]), len(positions[1])])
    if min(n) < 2 * OUTER or n.sum() > MOST_CENTRES:
        return None
    from scipy.spatial import cKDTree

    units = [unit_vectors(*side.T) for side in positions]
    trees = [cKDTree(side) for side in units]
    # From a fiftieth of the mean spacing of the records to twenty times that, if it is within the region.
    spacing = math.sqrt(region / n.max()) / ARCSEC_PER_RADIAN
    steps = np.arange(math.ceil(math.log(1000.0) / math.log(STEP)))
    reach = 0.02 * spacing * STEP**steps
    reach = reach[reach < 0.2 * math.sqrt(region) / ARCSEC_PER_RADIAN]
    share = [len(side) ** 2 * math.pi * (reach * ARCSEC_PER_RADIAN) ** 2 / region for side in units]
    counts = [tree.count_neighbors(tree, reach) - len(side) for tree, side in zip(trees, units, strict=True)]
    excess = np.sum(counts, axis=0) - np.sum(share, axis=0)
    enough = excess >= max(NEIGHBOURS * n.sum(), 4.0 * OUTER)
    ends = np.flatnonzero(enough[:-2] & (excess[2:] <= GROWTH * excess[:-2]))
    if not len(ends) or excess[ends[0]] > MOST_PAIRS:
        return None
    most = float(excess[ends[0]])
    nine_tenths = float(np.interp(0.9 * most, excess[: ends[0] + 1], reach[: ends[0] + 1]))
    rough = nine_tenths / NINE_TENTHS
    if np.interp(0.5 * nine_tenths, reach, excess) > HALF * most + 2.0 * math.sqrt(most):
        return None
    points = np.concatenate(units)
    disc = _gathered(points, 1.2 * rough, MOST_PAIRS)
    if disc is None:
        return None
    numbers_of_each = [np.bincount(of) for of in np.split(disc, [n[0]])]
    numbers = np.concatenate(numbers_of_each)
    pairs = numbers * (numbers - 1)
    if pairs[numbers > 2].sum() < SEVERAL * pairs.sum():
        return None
    discs_of_each = [np.count_nonzero(numbers) for numbers in numbers_of_each]
    if most > UNEQUAL * sum(a**2 / b - a for a, b in zip(n.tolist(), discs_of_each, strict=True)):
        return None
    limit = REACH * nine_tenths / float(np.interp(n.sum() / most, *AROUND_TARGETS))
    inside = float(np.mean(np.linalg.norm(points - _middles(points, disc)[disc], axis=1) <= limit))
    if inside < WITHIN - FULL:
        return None
    disc = _divided(points, disc, limit, MOST_DIVISIONS)
    middle = _middles(points, disc)
    # Of discs that overlap by chance, those whose middles are about half a radius apart stay together.
    together = 0.25 * len(middle) * math.pi * (rough * ARCSEC_PER_RADIAN) ** 2 / region
    radius = _half_extent(points, disc, 2.6 * rough, 0.98 - min(together, 0.1))
    area = _areas(middle / np.linalg.norm(middle, axis=1)[:, None], radius)
    # Discs overlap by chance as often as they fill the region.
    if inside < WITHIN - area.sum() / region or area.sum() > FULL * region:
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

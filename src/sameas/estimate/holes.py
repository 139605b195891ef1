"""Holes and edges of a source, to the spacing of its records: discs that are empty although many records are expected.

Cells find the large regions that a source does not observe (:mod:`sameas.estimate.coverage`); discs find the remainder
at their borders, and holes smaller than cells. A record lies in a hole if it is inside an empty disc around a record of
its own source (an interval in one dimension, a ball in three): a morphological opening of the empty space by that disc.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from sameas.arrays import ABSENT, BoolArray, FloatArray, IntArray
from sameas.records import Records
from sameas.space import ARCSEC_PER_RADIAN, Sphere, ball_volume, folded, unit_vectors

if TYPE_CHECKING:
    from scipy.spatial import cKDTree


#: Records expected in an empty disc, by the density where its source observes. More than in a cell: cells are few and
#: fixed, but a disc is tried around every record.
DISC = 12.0
#: Minimum number of records expected in it from the number of records of its own source in it (including its centre),
#: so that a region with few objects is not mistaken for a hole.
MIN_EXPECTED = 7.0
STEP = 5.0  # records expected in a smaller empty disc that extends a hole to its border
#: An empty disc at a border reaches beyond it to the first records, by about this fraction of their spacing. The
#: accepted part of the disc is that much smaller, times 1 − share, because discs are centred on records, and with fewer
#: records a disc with this overreach is less frequent.
OVERREACH = 0.6
MAX_HOLE_DIMENSIONS = 3  # maximum dimension for discs; in more dimensions records have too many neighbours
#: Where a disc must contain more records than MANY, or in a crowd of more centres than CROWDED for each of the others,
#: centres nearer than this fraction of the radius count as one.
MIN_SPACING, MANY, CROWDED = 0.125, 64.0, 4.0


POINTS_AT_ONCE = 1_000_000  # points of discs that are listed at a time, which limits the memory

Floats = TypeVar("Floats", float, FloatArray)


@dataclass(frozen=True)
class Points:
    """The points of a source for the search of empty discs.

    points : (n, axes), chords in arcsec for directions on the sphere; on a plane features whose axes are scaled to
    equal errors and the same volumes, because a disc needs equal units. period : (axes,), infinite for axes without a
    period. d : dimension of the space, for the volume of discs.
    """

    points: FloatArray
    period: FloatArray
    d: int

    @classmethod
    def of(cls, records: Records, typical_error: FloatArray) -> Points:
        """The points of one source's records, with the typical error of a residual along every axis (d,)."""
        if isinstance(records.space, Sphere):
            return cls(ARCSEC_PER_RADIAN * unit_vectors(*records.features.T), np.full(3, np.inf), 2)
        scale = typical_error / geometric_mean(typical_error)
        points = records.features if (scale == 1.0).all() else records.features / scale
        period = np.array(records.space.period_list(records.d)) / scale
        for v in np.flatnonzero(np.isfinite(period)):
            points = points.copy()
            points[:, v] = folded(points[:, v], period[v])
        return cls(points, period, records.d)

    def near(self, other: Points, distance: float) -> BoolArray:
        """(n,) whether points lie within ``distance`` of the bounding box of ``other``."""
        low, high = other.points.min(axis=0) - distance, other.points.max(axis=0) + distance
        outside = ((self.points < low) | (self.points > high)) & np.isinf(self.period)
        return np.asarray(~outside.any(axis=1))

    @cached_property
    def tree(self) -> cKDTree:
        """The k-d tree of the points."""
        from scipy.spatial import cKDTree

        return cKDTree(self.points, boxsize=np.where(np.isfinite(self.period), self.period, 0.0))


def geometric_mean(values: FloatArray) -> float:
    """The geometric mean of positive numbers (d,); of equal ones without rounding."""
    return float(values[0] * np.prod(values / values[0]) ** (1.0 / len(values)))


#: Most cells along an axis; farther ones share a number.
MOST_CELLS = 2.0**32
#: By how many places the next cell along each axis is farther in a table.
PLACE_OF_AXES = np.array([73_856_093, 19_349_663, 83_492_791])


def places_of_cells(points: FloatArray, side: float, *, rows: int | None = None) -> tuple[IntArray, int]:
    """(n,) place of each point's cell of this side in a table for some number of ``rows``, by default of points, and
    the last place. Cells may share a place."""
    last = (1 << max(len(points) if rows is None else rows, 1).bit_length()) - 1
    place = np.fmod(np.floor(points / side), MOST_CELLS).astype(np.int64) @ PLACE_OF_AXES[: points.shape[1]]
    return np.asarray(place & last), last


def within_holes(own: Points, covered: BoolArray, other: Points, density: FloatArray, share: float) -> BoolArray:
    """(n,) whether records of one source, ``own``, lie in holes of the other, ``other``.

    covered : (n,) whether they may be covered, by the cells.
    density : (n,) expected density of the other source at them, per (unit of the residuals)^d.
    share : records of the other source per record of this one where both observe.

    The disc of a record has the volume in which ``disc`` records of the other source are expected. Holes found with
    these are then extended to their borders by smaller discs around the records in them.
    """
    in_hole = ~covered
    if own.d > MAX_HOLE_DIMENSIONS or len(other.points) < MIN_EXPECTED or not covered.any():
        return in_hole
    wanted, beyond = covered, OVERREACH * max(0.0, 1.0 - share)
    if not covered.all():
        widest = _radius(DISC, float(density[covered].min()), own.d)
        wanted = covered | own.near(other, 2.0 * widest)
    least = max(2.0, MIN_EXPECTED / share)
    in_disc = in_empty_discs(own, other, wanted, density, DISC, beyond, least)
    if in_disc.any():
        in_disc |= in_empty_discs(own, other, wanted & in_disc, density, STEP, beyond, 1.0)
    return in_hole | in_disc


def _radius(expected: float, density: Floats, d: int) -> Floats:
    """Radius of the disc with this expected number of records."""
    radius: Floats = (expected / ball_volume(d) / density) ** (1.0 / d)
    return radius


def in_empty_discs(
    own: Points,
    other: Points,
    wanted: BoolArray,
    density: FloatArray,
    expected: float,
    beyond: float,
    least: float,
    points_at_once: int = POINTS_AT_ONCE,
) -> BoolArray:
    """(n,) mask of the points in empty discs around ``wanted`` points that contain at least ``least`` points."""
    in_disc = np.zeros(len(own.points), np.bool_)
    remaining = density[wanted]
    while len(remaining):
        high = float(remaining.max())
        low = high / 2.0**own.d  # discs up to twice as large are searched together
        remaining = remaining[remaining <= low]
        rows = np.flatnonzero(wanted & (density > low) & (density <= high))
        radius = _radius(expected, density[rows], own.d)
        overreach = beyond * density[rows] ** (-1.0 / own.d)
        in_disc |= _inside(own, other, rows, radius, overreach, least, points_at_once)
    return in_disc


def _inside(
    own: Points, other: Points, rows: IntArray, radius: FloatArray, beyond: FloatArray, least: float,
    points_at_once: int,
) -> BoolArray:  # fmt: skip
    """(n,) mask of the points inside empty discs around ``rows`` that contain enough points."""
    isolated = ~_near_sampled(own, rows, radius, other)
    rows, radius, beyond = rows[isolated], radius[isolated], beyond[isolated]
    distance = other.tree.query(own.points[rows], distance_upper_bound=float(radius.max(initial=0.0)))[0]
    empty = distance >= radius
    rows, radius, beyond = rows[empty], radius[empty], beyond[empty]
    inside = np.zeros(len(own.points), np.bool_)
    if not len(rows):
        return inside
    chosen = _one_per_cell(own.points[rows], MIN_SPACING * float(radius.min()))
    if least > MANY or len(rows) > CROWDED * len(chosen):
        rows, radius, beyond = rows[chosen], radius[chosen], beyond[chosen]
    number = own.tree.query_ball_point(own.points[rows], np.nextafter(radius, 0.0), return_length=True)
    enough = number >= least
    centres, inner = own.points[rows[enough]], np.nextafter(radius - beyond, 0.0)[enough]
    ends = np.flatnonzero(np.diff(np.cumsum(number[enough]) // points_at_once)) + 1
    for some in np.split(np.arange(len(centres)), ends):
        for rows_of_disc in own.tree.query_ball_point(centres[some], inner[some]):
            inside[rows_of_disc] = True
    return inside


def _near_sampled(own: Points, rows: IntArray, radius: FloatArray, other: Points) -> BoolArray:
    """(r,) mask of some points that have a point of ``other``, of one for each cell, nearer than ``radius``.

    Most have, and in a fraction of the time of a search. Across a period distances are not reduced: too large.
    """
    side, points = float(radius.min()) / math.sqrt(own.d), own.points[rows]
    place, last = places_of_cells(other.points, side)
    sample = np.full(last + 1, ABSENT)
    sample[place] = np.arange(len(place))
    nearby = sample[places_of_cells(points, side, rows=len(place))[0]]
    return np.asarray((nearby >= 0) & (np.square(points - other.points[nearby]).sum(axis=1) < radius**2))


def _one_per_cell(points: FloatArray, side: float) -> IntArray:
    """In each cell of this side, the point nearest to the centre; independent of the order of the points."""
    cell = np.floor(points / side)
    distance = ((points - (cell + 0.5) * side) ** 2).sum(axis=1)
    order = np.lexsort((*points.T, distance, *cell.T))
    first = np.ones(len(order), np.bool_)
    first[1:] = (cell[order[1:]] != cell[order[:-1]]).any(axis=1)
    return np.sort(order[first])

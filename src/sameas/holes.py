"""Holes and edges of a source, as fine as its records lie: discs that are empty although many were to be expected.

``coverage.py`` finds by cells where a source does not look at all; this finds what is left at the borders of that, and
holes that no cell fits into. A record lies in a hole where it is inside an empty disc around a record of its own
source (in one dimension an interval, in three a ball): the space without records is opened by that disc.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sameas.records import FloatArray, IntArray, Records
from sameas.space import ARCSEC_PER_RADIAN, Sphere

Mask = NDArray[np.bool_]

#: Records to be expected in an empty disc by the density where its source looks. More than in a cell (``coverage.py``):
#: cells are few and lie where they lie, a disc is tried around every record.
DISC = 12.0
#: Records to be expected in it by those of the asking source that it holds, so that a place that is poor in objects is
#: not taken for a hole.
COMPANY = 7.0
#: The same along the border of a hole that has been found.
STEP = 5.0
#: An empty disc reaches beyond the border it lies at, up to the first records, by about this part of their spacing.
OVERREACH = 0.3
#: Dimensions that discs are made for; in more of them neighbours are too many.
MOST_DIMENSIONS = 3
#: Middles nearer to each other than this part of the radius are as good as one, where so many lie in a disc.
APART = 0.125
MANY = 64.0


@dataclass(frozen=True)
class Ground:
    """The points of a source in up to three dimensions, in the unit of the residuals.

    points : (n, 3), unused axes zero; of directions on the sphere the chords. period : (3,), infinite where there is
    none. d : of the space, by which a disc's volume goes.
    """

    points: FloatArray
    period: FloatArray
    d: int

    @classmethod
    def of(cls, records: Records) -> Ground:
        """That of the records of one source."""
        period = np.full(3, np.inf)
        if isinstance(records.space, Sphere):
            lon, lat = np.radians(records.features.T)
            flat = np.cos(lat)
            across = np.stack([flat * np.cos(lon), flat * np.sin(lon), np.sin(lat)], axis=1)
            return cls(ARCSEC_PER_RADIAN * across, period, 2)
        period[: records.d] = records.space.period_list(records.d)
        points = np.zeros((len(records), 3))
        points[:, : records.d] = records.features
        for v in np.flatnonzero(np.isfinite(period)):
            points[:, v] = np.mod(points[:, v], period[v])
        return cls(points, period, records.d)

    def near(self, other: Ground, distance: float) -> Mask:
        """Which points are no farther than ``distance`` from the box around another's, axis by axis."""
        low, high = other.points.min(axis=0) - distance, other.points.max(axis=0) + distance
        outside = ((self.points < low) | (self.points > high)) & np.isinf(self.period)
        return np.asarray(~outside.any(axis=1))


@dataclass(frozen=True)
class _Grid:
    """Points sorted into cells; see ``kernels/discs.py``."""

    points: FloatArray
    low: FloatArray
    side: FloatArray
    number: IntArray
    period: FloatArray
    mask: int
    start: NDArray[np.int32]
    rows: NDArray[np.int32]

    @classmethod
    def of(cls, points: FloatArray, period: FloatArray, side: float) -> _Grid:
        from sameas.kernels.discs import into_buckets

        low, high = points.min(axis=0), points.max(axis=0)
        number = np.floor((high - low) / side).astype(np.int64) | 1
        sides = np.full(3, side)
        for v in np.flatnonzero(np.isfinite(period)):
            number[v] = max(1, int(period[v] / side))
            low[v], sides[v] = 0.0, period[v] / number[v]
        mask = (1 << max(4, math.ceil(math.log2(2 * len(points))))) - 1
        return cls(
            points, low, sides, number, period, mask, *into_buckets(points, low, sides, number, period, mask)
        )

    def arrays(self) -> tuple[FloatArray, FloatArray, FloatArray, IntArray, FloatArray, int, IntArray, IntArray]:
        """What the kernels take."""
        return self.points, self.low, self.side, self.number, self.period, self.mask, self.start, self.rows


def within_holes(asking: Records, seen: Mask, source: Records, density: FloatArray, share: float) -> Mask:
    """Which of the ``asking`` records (n,) lie in holes of ``source``.

    seen : (n,) whether they may be covered at all, as far as is known.
    density : (n,) of the records of ``source`` to be expected at them, per (unit of the residuals)^d.
    share : records of ``source`` per record of ``asking`` where both look.

    The disc of a record has the volume in which :data:`DISC` records of ``source`` are to be expected. What is so found
    is then carried on to the border by smaller discs around records that lie in it.
    """
    found = ~seen
    if asking.d > MOST_DIMENSIONS or len(source) < COMPANY or not seen.any():
        return found
    here, there = Ground.of(asking), Ground.of(source)
    spacing = density ** (-1.0 / here.d)
    reach = 2.0 * float(spacing[seen].max()) * _radius(DISC, here.d)
    rows = np.flatnonzero(seen | here.near(there, reach))
    beyond = OVERREACH * max(0.0, 1.0 - share) * spacing
    found |= _opened(here, there, rows, spacing, DISC, beyond, max(2.0, COMPANY / share))
    rows = rows[found[rows]]
    return found | _opened(here, there, rows, spacing, STEP, beyond, 1.0)


def _radius(expected: float, d: int) -> float:
    """Of the disc that holds so many records on average, in units of their spacing, density^(−1/d)."""
    return float((expected * math.gamma(0.5 * d + 1.0)) ** (1.0 / d) / math.sqrt(math.pi))


def _opened(
    here: Ground, there: Ground, rows: IntArray, spacing: FloatArray, expected: float, beyond: FloatArray, least: float
) -> Mask:
    """Which points lie inside empty discs around the points ``rows`` that hold at least so many of them."""
    found = np.zeros(len(here.points), np.bool_)
    radius = _radius(expected, here.d) * spacing
    while len(rows):
        # Discs up to twice as large share one grid.
        small = float(radius[rows].min())
        now = rows[radius[rows] < 2.0 * small]
        rows = rows[radius[rows] >= 2.0 * small]
        at = now[_middles(here.points[now], radius[now], there, small)]
        if len(at):
            found |= _inside(here, at, radius[at], radius[at] - beyond[at], least)
    return found


def _middles(centres: FloatArray, radius: FloatArray, there: Ground, small: float) -> Mask:
    """Which centres have a disc without points of the other source."""
    from sameas.kernels.discs import empty_discs

    empty = np.empty(len(centres), np.bool_)
    empty_discs(centres, radius, *_Grid.of(there.points, there.period, small / math.sqrt(there.d)).arrays(), empty)
    return empty


def _inside(here: Ground, at: IntArray, radius: FloatArray, inner: FloatArray, least: float) -> Mask:
    """Which points lie inside discs around points ``at`` that hold enough of them."""
    from sameas.kernels.discs import clear

    small = float(radius.min())
    if least > MANY:
        chosen = _apart(here.points[at], APART * small)
        at, radius, inner = at[chosen], radius[chosen], inner[chosen]
    seen = np.ones(len(here.points), np.bool_)
    grid = _Grid.of(here.points, here.period, small / math.sqrt(here.d))
    clear(here.points[at], radius, inner, least, *grid.arrays(), seen)
    return ~seen


def _apart(points: FloatArray, side: float) -> IntArray:
    """Of the points in each cell of that side the one nearest its middle, whatever their order."""
    cell = np.floor(points / side)
    away = ((points - (cell + 0.5) * side) ** 2).sum(axis=1)
    order = np.lexsort((*points.T, away, *cell.T))
    first = np.ones(len(order), np.bool_)
    first[1:] = (cell[order[1:]] != cell[order[:-1]]).any(axis=1)
    return np.sort(order[first])

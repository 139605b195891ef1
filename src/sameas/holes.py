"""Holes and edges of a source, as fine as its records lie: discs that are empty although many were to be expected.

``coverage.py`` finds by cells where a source does not look at all; this finds what is left at the borders of that, and
holes that no cell fits into. A record lies in a hole where it is inside an empty disc around a record of its own
source (in one dimension an interval, in three a ball): the space without records is opened by that disc.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from sameas.records import FloatArray, IntArray, Records
from sameas.space import ARCSEC_PER_RADIAN, Sphere

Mask = NDArray[np.bool_]
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


@dataclass(frozen=True)
class Ground:
    """The points of a source among which empty discs are sought, in the unit of the residuals.

    points : (n, axes); of directions on the sphere the chords. period : (axes,), infinite where there is none.
    d : of the space, by which a disc's volume goes.
    """

    points: FloatArray
    period: FloatArray
    d: int

    @classmethod
    def of(cls, records: Records) -> Ground:
        """That of the records of one source."""
        if isinstance(records.space, Sphere):
            lon, lat = np.radians(records.features.T)
            flat = np.cos(lat)
            chords = np.stack([flat * np.cos(lon), flat * np.sin(lon), np.sin(lat)], axis=1)
            return cls(ARCSEC_PER_RADIAN * chords, np.full(3, np.inf), 2)
        period = np.array(records.space.period_list(records.d))
        wraps = np.isfinite(period)
        if not wraps.any():
            return cls(records.features, period, records.d)
        points = records.features.copy()
        points[:, wraps] = np.mod(points[:, wraps], period[wraps])
        return cls(points, period, records.d)

    def near(self, other: Ground, distance: float) -> Mask:
        """Which points are no farther than ``distance`` from the box around another's, axis by axis."""
        low, high = other.points.min(axis=0) - distance, other.points.max(axis=0) + distance
        outside = ((self.points < low) | (self.points > high)) & np.isinf(self.period)
        return np.asarray(~outside.any(axis=1))

    def at(self, rows: IntArray) -> FloatArray:
        """(r, 3) points of some rows, unused axes zero."""
        points = np.zeros((len(rows), 3))
        points[:, : self.points.shape[1]] = self.points[rows]
        return points

    def lonely(
        self, wanted: Mask, density: FloatArray, limits: tuple[float, float], volume: float, other: Ground
    ) -> IntArray:
        """Rows of those ``wanted`` with a density within limits in whose discs no point of the other is at hand.

        volume : of the discs, times the density.
        """
        from sameas.kernels.discs import lonely

        rows = np.empty(len(self.points), np.int32)
        cells = _Cells.over(other, (volume / limits[1]) ** (1.0 / self.d) / math.sqrt(self.d), len(other.points))
        found = lonely(self.points, wanted, density, *limits, volume, self.d, other.points, *cells.arrays(), rows)
        return rows[:found].astype(np.int64)

    def beside(self, centres: FloatArray, radius: FloatArray, side: float) -> IntArray:
        """Rows of all points inside discs around some centres, with others around them."""
        from sameas.kernels.discs import beside

        rows = np.empty(len(self.points), np.int32)
        cells = _Cells.over(self, side, len(self.points))
        found = beside(self.points, *cells.arrays(), centres, radius, rows)
        return rows[:found].astype(np.int64)


@dataclass(frozen=True)
class _Cells:
    """Cells over points and the table their numbers are taken into; see ``kernels/discs.py``. All (3,)."""

    low: FloatArray
    side: FloatArray
    number: IntArray
    period: FloatArray
    mask: int

    @classmethod
    def over(cls, ground: Ground, side: float, n: int) -> _Cells:
        """Cells of about one side over a ground, in a table for n points."""
        low, number, period = np.zeros(3), np.ones(3, np.int64), np.full(3, np.inf)
        sides = np.where(np.arange(3) < len(ground.period), side, np.inf)  # an unused axis is one cell
        for v, wraps in enumerate(ground.period):
            if math.isfinite(wraps):
                number[v], period[v] = math.ceil(wraps / side), wraps
                sides[v] = wraps / number[v]
            else:
                low[v] = float(ground.points[:, v].min())
                number[v] = int(min((float(ground.points[:, v].max()) - low[v]) / side, MOST_CELLS)) + 1 | 1
        return cls(low, sides, number, period, (1 << max(4, math.ceil(math.log2(2 * n)))) - 1)

    def arrays(self) -> tuple[FloatArray, FloatArray, IntArray, FloatArray, int]:
        """What the kernels take."""
        return self.low, self.side, self.number, self.period, self.mask


def within_holes(here: Ground, seen: Mask, there: Ground, density: FloatArray, share: float) -> Mask:
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


def _volume_of_disc(d: int) -> float:
    """Volume of the disc of radius 1 in d dimensions."""
    return math.pi ** (0.5 * d) / math.gamma(0.5 * d + 1.0)


def _radius(expected: float, density: Floats, d: int) -> Floats:
    """Of the disc that holds so many records on average."""
    return (expected / _volume_of_disc(d) / density) ** (1.0 / d)


def opened(
    here: Ground, there: Ground, wanted: Mask, density: FloatArray, expected: float, beyond: float, least: float
) -> Mask:
    """Which points lie inside empty discs around the points ``wanted`` that hold at least so many of them."""
    found = np.zeros(len(here.points), np.bool_)
    left = density[wanted]
    while len(left):
        high = float(left.max())
        low = high / 2.0**here.d  # discs up to twice as large share their cells
        left = left[left <= low]
        rows = here.lonely(wanted, density, (low, high), expected / _volume_of_disc(here.d), there)
        if len(rows):
            radius = _radius(expected, density[rows], here.d)
            inside = _inside(here, there, rows, radius, beyond * density[rows] ** (-1.0 / here.d), least)
            found[inside] = True
    return found


def _inside(
    here: Ground, there: Ground, rows: IntArray, radius: FloatArray, beyond: FloatArray, least: float
) -> IntArray:
    """Rows of the points inside discs around those ``rows`` whose discs are empty, and hold enough points."""
    from sameas.kernels.discs import clear, empty_discs

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


#: Points (n, 3), their cells, and the lists of each bucket.
Sorted = tuple[FloatArray, FloatArray, FloatArray, IntArray, FloatArray, int, NDArray[np.int32], NDArray[np.int32]]


def _sorted(ground: Ground, rows: IntArray, side: float) -> Sorted:
    """Some points of a ground in lists of cells."""
    from sameas.kernels.discs import into_buckets

    points, cells = ground.at(rows), _Cells.over(ground, side, max(len(rows), 1)).arrays()
    return points, *cells, *into_buckets(points, *cells)


def _apart(points: FloatArray, side: float) -> IntArray:
    """Of the points in each cell of that side the one nearest its middle, whatever their order."""
    cell = np.floor(points / side)
    away = ((points - (cell + 0.5) * side) ** 2).sum(axis=1)
    order = np.lexsort((*points.T, away, *cell.T))
    first = np.ones(len(order), np.bool_)
    first[1:] = (cell[order[1:]] != cell[order[:-1]]).any(axis=1)
    return np.sort(order[first])

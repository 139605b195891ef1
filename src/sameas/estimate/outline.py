"""The convex outline of a field: which part of a cell at its border lies within.

Cells cut a rectangle, but what a survey was asked for is as often a cone, and a camera is turned. Without the outline
the cells at the border are taken for whole: a disc's records would look a quarter too rare, most of all at its border,
and chance pairs there too improbable.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sameas.arrays import FloatArray

#: Fewer points tell no outline.
FEWEST = 100
#: A field whose corners hold more than such a part of what they would hold evenly is a rectangle; so is one whose
#: outline leaves less than the rest of the rectangle out.
CORNERS, MOST = 0.5, 0.95
#: Depth of a corner, as a part of the side.
CORNER = 0.1
#: Directions in which the outermost points are taken before the others are sorted.
DIRECTIONS = 64
#: About so many of the points tell whether corners are empty, and which points lie too far inside to be a vertex.
SOME = 50_000
#: Places across a cell at which it is seen how much of it lies within.
ACROSS = 32
#: A cell that holds a record has at least such a part of its volume.
LEAST = 1e-3


@dataclass(frozen=True)
class Outline:
    """A convex region in the plane.

    x : (v,) rising. lower, upper : (v,) its border there, straight in between. area : its area.
    """

    x: FloatArray
    lower: FloatArray
    upper: FloatArray
    area: float

    @classmethod
    def of(cls, points: FloatArray, low: FloatArray, high: FloatArray, records: int) -> Outline | None:
        """The outline of points (n, 2) in a rectangle; None where that is the rectangle itself, or they are too few.

        records : objects that the points are of, at least.

        The hull of n points strewn evenly over a convex region leaves a part of it out that is V/n on average, with V
        the mean number of its vertices: it is scaled about its centre by as much (Efron 1965, Biometrika 52, 331).
        """
        extent = high - low
        if records < FEWEST or not (extent > 0.0).all():
            return None
        place = (points - low) / extent
        some = _some_of(place)
        in_corners = np.count_nonzero((np.abs(some - 0.5) > 0.5 - CORNER).all(axis=1))
        if in_corners > CORNERS * (2.0 * CORNER) ** 2 * len(some):
            return None
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
        """(c,) which part of rectangles from ``low`` to ``high``, (c, 2) each, lies within; at least :data:`LEAST`."""
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
    """The points that lie outside the polygon of those outermost in some directions, and these."""
    corners = _farthest(_some_of(points))
    # What lies within the circle inscribed in the polygon of some is no vertex: of many points nearly all.
    centre = corners.mean(axis=0)
    from_centre = corners - centre, np.roll(corners, -1, axis=0) - centre
    side = np.linalg.norm(from_centre[1] - from_centre[0], axis=1)
    area = from_centre[0][:, 0] * from_centre[1][:, 1] - from_centre[0][:, 1] * from_centre[1][:, 0]
    inscribed = float((area[side > 0.0] / side[side > 0.0]).min()) if side.any() else 0.0
    x, y = points[:, 0] - centre[0], points[:, 1] - centre[1]
    points = points[x * x + y * y >= max(0.0, inscribed) ** 2]
    corners = _farthest(points)
    outside = np.zeros(len(points), np.bool_)
    for one, two in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        along = two - one
        outside |= along[0] * (points[:, 1] - one[1]) - along[1] * (points[:, 0] - one[0]) < 0.0
    return np.concatenate([points[outside], corners])


def _some_of(points: FloatArray) -> FloatArray:
    """About :data:`SOME` of the points at most, evenly by row."""
    return points[:: max(1, len(points) // SOME)]


def _farthest(points: FloatArray) -> FloatArray:
    """(DIRECTIONS, 2) the point farthest out in each of some directions, counterclockwise."""
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

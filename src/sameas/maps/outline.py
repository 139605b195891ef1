"""Coasts, large lakes and borders around a place, in its local plane: the background of a map.

Natural Earth 1:10 million, public domain (outline.txt), accurate to about 1 km: for orientation, not navigation.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from importlib.resources import files

import numpy as np

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.errors import InputError
from sameas.ragged import Ragged
from sameas.tracks.coordinates import EARTH_M, FARTHEST_M, LocalPlane

#: Cells and steps of the data in degrees, and cells in a row: as in scripts/make-outline.
CELL_DEG, STEP_DEG, COLUMNS = 5.0, 0.0005, 72
#: Lines longer than this, in degrees, are split: they follow a parallel, not a chord.
LONGEST_DEG = 0.25


@dataclass(frozen=True)
class Outline:
    """Lines in a plane, each (n, 2) metres east and north.

    land : closed rings (the last point not repeated), land to the left: fill all of them as one path, nonzero rule.
    coast : open lines along the water. borders : open lines between countries.
    """

    land: tuple[FloatArray, ...] = ()
    coast: tuple[FloatArray, ...] = ()
    borders: tuple[FloatArray, ...] = ()

    def within(self, west_m: float, south_m: float, east_m: float, north_m: float) -> Outline:
        """The outline in a box: land is clipped, of lines the segments that reach into the box are kept."""
        box = MapExtent(west_m, south_m, east_m, north_m)
        rings = (_clipped(np.vstack([ring, ring[:1]]), box) for ring in self.land)
        coast, borders = (
            [piece for line in lines for piece in _pieces(line, np.zeros(len(line) - 1, np.bool_), box)]
            for lines in (self.coast, self.borders)
        )
        return Outline(tuple(ring for ring in rings if len(ring) >= 3), tuple(coast), tuple(borders))


@dataclass(frozen=True)
class MapExtent:
    """The part of a plane that is drawn, in metres."""

    west_m: float
    south_m: float
    east_m: float
    north_m: float

    def __post_init__(self) -> None:
        if not (self.west_m < self.east_m and self.south_m < self.north_m):
            raise InputError(f"MapExtent: {self} is empty; give west < east and south < north")

    @property
    def farthest_m(self) -> float:
        """From the origin of the plane to the farthest corner."""
        return float(np.hypot(max(-self.west_m, self.east_m), max(-self.south_m, self.north_m)))


def outline(plane: LocalPlane, west_m: float, south_m: float, east_m: float, north_m: float) -> Outline:
    """The outlines in a box of a plane.

    plane : of the result's coordinates.
    west_m, south_m, east_m, north_m : the box; lines farther than 4000 km from the origin are excluded.

    >>> around = outline(LocalPlane(50.8, -1.3), -30e3, -30e3, 30e3, 30e3)
    >>> len(around.land) > 0 and len(around.borders) == 0
    True
    """
    box = MapExtent(west_m, south_m, east_m, north_m)
    land, coast = [], []
    for lines in _read("land").near(plane, box):
        ring = lines.in_plane(plane, closed=True)
        cut = _clipped(ring, box)
        if len(cut) >= 3:
            land.append(cut)
            coast += _pieces(ring, lines.along_cells(), box)
    borders = []
    for lines in _read("border").near(plane, box):
        line = lines.in_plane(plane, closed=False)
        borders += _pieces(line, np.zeros(len(line) - 1, np.bool_), box)
    return Outline(tuple(land), tuple(coast), tuple(borders))


@dataclass(frozen=True)
class _Line:
    """One ring or line in steps of the data, (n, 2) eastwards and northwards from 180° W, 90° S."""

    steps: IntArray

    def in_plane(self, plane: LocalPlane, *, closed: bool) -> FloatArray:
        """(m, 2) points, metres east and north; a closed ring repeats its first point."""
        steps = np.concatenate([self.steps, self.steps[:1]]) if closed else self.steps
        number, share = _subdivided(steps)
        fine = steps[number] + share[:, None] * (steps[np.minimum(number + 1, len(steps) - 1)] - steps[number])
        lon, lat = fine[:, 0] * STEP_DEG - 180.0, fine[:, 1] * STEP_DEG - 90.0
        return plane.enu(lat, lon)[:, :2]

    def along_cells(self) -> BoolArray:
        """(m − 1,) sides of the closed ring along the edge of its cell: they are no coast."""
        steps = np.concatenate([self.steps, self.steps[:1]])
        per_cell = round(CELL_DEG / STEP_DEG)
        start, stop = steps[:-1], steps[1:]
        along = np.any((start == stop) & (start % per_cell == 0), axis=1)
        return np.asarray(along[_subdivided(steps)[0][:-1]], np.bool_)


def _subdivided(steps: IntArray) -> tuple[IntArray, FloatArray]:
    """(m,) side, and fraction of that side, of each point of the subdivided line, end point included."""
    longest = np.abs(np.diff(steps, axis=0)).max(axis=1) * STEP_DEG
    pieces = np.maximum(1, np.ceil(longest / LONGEST_DEG - 1e-9)).astype(np.int64)
    points = Ragged.of_sizes(pieces)
    return np.append(points.row, len(steps) - 1), np.append(points.index / pieces[points.row], 0.0)


@dataclass(frozen=True)
class _PackedLines:
    """All lines of a kind, packed: cell, first point and number of points of each; steps of all, concatenated."""

    cell: IntArray
    first: IntArray
    length: IntArray
    steps: IntArray

    def near(self, plane: LocalPlane, box: MapExtent) -> Iterator[_Line]:
        """The lines of all cells that may overlap the box."""
        reach = np.degrees(min(box.farthest_m, FARTHEST_M) / EARTH_M) * 1.1 + CELL_DEG
        row, column = np.divmod(self.cell, COLUMNS)
        lat = np.radians((row + 0.5) * CELL_DEG - 90.0)
        lon = np.radians((column + 0.5) * CELL_DEG - 180.0 - plane.lon_deg)
        origin_lat = np.radians(plane.lat_deg)
        cosine = np.sin(lat) * np.sin(origin_lat) + np.cos(lat) * np.cos(origin_lat) * np.cos(lon)
        start = np.cumsum(self.length - 1) - (self.length - 1)
        for k in np.flatnonzero(cosine > np.cos(np.radians(reach))):
            corner = np.array([column[k], row[k]]) * round(CELL_DEG / STEP_DEG)
            steps = self.steps[start[k] : start[k] + self.length[k] - 1]
            yield _Line(corner + self.first[k] + np.concatenate([np.zeros((1, 2), np.int64), np.cumsum(steps, axis=0)]))


@cache
def _read(kind: str) -> _PackedLines:
    """The lines of the data file of a kind, "land" or "border"."""
    with (files("sameas.maps") / "outline.npz").open("rb") as file, np.load(file) as data:
        zigzag = (data[f"{kind}_low"].astype(np.int64) + (data[f"{kind}_high"].astype(np.int64) << 8)).T
        cell, first, length = (data[f"{kind}_{name}"].astype(np.int64) for name in ("cell", "first", "length"))
    return _PackedLines(cell, first, length, (zigzag >> 1) ^ -(zigzag & 1))


def _clipped(ring: FloatArray, box: MapExtent) -> FloatArray:
    """(m, 2) a closed ring clipped to the box (Sutherland and Hodgman 1974); cut parts follow the sides of the box."""
    points = ring[:-1]
    for axis, sign, limit in ((0, -1, box.west_m), (0, 1, box.east_m), (1, -1, box.south_m), (1, 1, box.north_m)):
        if len(points) == 0:
            return points
        room = sign * (limit - points[:, axis])
        after, room_after = np.roll(points, -1, axis=0), np.roll(room, -1)
        crosses = (room >= 0) != (room_after >= 0)
        with np.errstate(divide="ignore", invalid="ignore"):
            share = np.where(crosses, room / (room - room_after), 0.0)
        both = np.stack([points, points + share[:, None] * (after - points)], axis=1)
        points = both[np.column_stack([room >= 0, crosses])]
    return points


def _pieces(line: FloatArray, hidden: BoolArray, box: MapExtent) -> list[FloatArray]:
    """The runs of consecutive segments of a line that reach into the box and are not hidden."""
    low, high = np.minimum(line[:-1], line[1:]), np.maximum(line[:-1], line[1:])
    inside = (high[:, 0] >= box.west_m) & (low[:, 0] <= box.east_m)
    inside &= (high[:, 1] >= box.south_m) & (low[:, 1] <= box.north_m) & ~hidden
    edges = np.flatnonzero(np.diff(np.concatenate([[False], inside, [False]]).astype(np.int8)))
    return [line[start : stop + 1] for start, stop in edges.reshape(-1, 2)]

"""GeoJSON given by the user (RFC 7946: WGS84, longitude first): its land and shores in the plane of a map, and places.

Harbours need a finer coast than Natural Earth: extracts of OpenStreetMap, of a chart or of a survey are GeoJSON, or
can be converted to it by a geographic information system.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sameas.arrays import FloatArray
from sameas.errors import InputError
from sameas.maps.outline import Outline
from sameas.maps.tiles import is_tiles
from sameas.tracks.coordinates import FARTHEST_M, LocalPlane


def read(path: str | os.PathLike[str], remedy: str = "") -> Any:
    """The value of a GeoJSON file.

    Raises InputError: the file cannot be read, or is not JSON; remedy : what to do then.
    """
    try:
        return json.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: is not GeoJSON: {error}", remedy) from error


def places(points: Any, where: str, *, least: int) -> FloatArray:
    """(n, 2) longitude and latitude, degrees, of a line or ring of coordinates.

    Raises InputError: fewer places than ``least``, or no longitudes and latitudes.
    """
    try:
        places = np.array([point[:2] for point in points], dtype=np.float64).reshape(-1, 2)
    except (TypeError, ValueError, IndexError) as error:
        raise InputError(f"{where}: coordinates that are not pairs of numbers") from error
    if len(places) < least or not np.isfinite(places).all() or np.abs(places[:, 1]).max() > 90.0:
        raise InputError(
            f"{where}: coordinates that are not longitudes and latitudes in degrees of {least} places or more"
        )
    return places


@dataclass(frozen=True)
class Coast:
    """Land and shores on the globe.

    lines : each (n, 2) longitude and latitude, degrees. roles : of each line: "land", "water" (a hole) or "shore".
    """

    lines: tuple[FloatArray, ...]
    roles: tuple[str, ...]

    def in_plane(self, plane: LocalPlane) -> Outline:
        """The coast in metres east and north of a plane; lines that reach farther than 4000 km are excluded."""
        land: list[FloatArray] = []
        coast: list[FloatArray] = []
        for line_deg, role in zip(self.lines, self.roles, strict=True):
            lon, lat = line_deg.T
            line, up = np.split(plane.enu(lat, lon), [2], axis=1)
            if ((np.hypot(*line.T) > FARTHEST_M) | (up[:, 0] < -FARTHEST_M)).any():
                continue
            coast.append(line)
            ring = line[:-1] if np.array_equal(line[0], line[-1]) else line
            if role != "shore" and len(ring) >= 3:
                # Land to the left: fill by the nonzero rule leaves the holes open.
                land.append(ring if (_area(ring) > 0.0) == (role == "land") else ring[::-1])
        return Outline(tuple(land), tuple(coast))


def read_coast(path: str | os.PathLike[str]) -> Coast:
    """The land and the shores of a GeoJSON file (RFC 7946: WGS84, longitude first).

    path : polygons are land, their holes are water; lines are shores. Points and properties are ignored.

    Raises InputError: the file cannot be read, is not GeoJSON, has no polygon or line, or has invalid coordinates.
    """
    remedy = "only sameas watch draws tiles; give land or shores as GeoJSON (ogr2ogr converts vector tiles)"
    whole = read(path, remedy if is_tiles(path) else "")
    lines: list[FloatArray] = []
    roles: list[str] = []
    for number, geometry in _geometries(whole, path):
        for points, role in _lines(geometry, f"{path}: feature {number}"):
            lines.append(places(points, f"{path}: feature {number}", least=2))
            roles.append(role)
    if not lines:
        raise InputError(f"{path}: has no polygon and no line", "give land as polygons, or shores as lines")
    return Coast(tuple(lines), tuple(roles))


def _geometries(value: Any, path: str | os.PathLike[str]) -> Iterator[tuple[int, dict[str, Any]]]:
    """Each geometry, with the number of its feature, from 0."""
    kind = value.get("type") if isinstance(value, dict) else None
    if kind == "FeatureCollection":
        features = value.get("features")
    elif kind == "Feature":
        features = [value]
    elif isinstance(kind, str) and ("coordinates" in value or "geometries" in value):
        features = [{"geometry": value}]
    else:
        features = None
    if not isinstance(features, list):
        raise InputError(f"{path}: is not GeoJSON", "give a FeatureCollection, a Feature or a geometry")
    for number, feature in enumerate(features):
        geometry = feature.get("geometry") if isinstance(feature, dict) else None
        parts = [geometry] if isinstance(geometry, dict) else []
        while parts:
            part = parts.pop()
            if part.get("type") == "GeometryCollection":
                inner = part.get("geometries")
                parts += [one for one in (inner if isinstance(inner, list) else []) if isinstance(one, dict)]
            else:
                yield number, part


def _lines(geometry: dict[str, Any], where: str) -> Iterator[tuple[Any, str]]:
    """The coordinates and the role (land, water or shore) of each line of a geometry."""
    kind, given = str(geometry.get("type")), geometry.get("coordinates", [])
    several = given if kind.startswith("Multi") else [given]
    is_list = isinstance(several, list)
    if kind.endswith("Polygon") and is_list and all(isinstance(polygon, list) for polygon in several):
        yield from ((ring, "water" if k else "land") for polygon in several for k, ring in enumerate(polygon))
    elif kind.endswith("LineString") and is_list:
        yield from ((line, "shore") for line in several)
    elif kind.endswith(("Polygon", "LineString")):
        raise InputError(f"{where}: coordinates that are not lists of places")


def _area(ring: FloatArray) -> float:
    """Twice the signed area: positive for an anticlockwise ring."""
    x, y = ring.T
    return float(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1)))

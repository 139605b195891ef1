"""A coast of one's own: land and shore lines of a GeoJSON file in the plane of a map.

Harbours need a finer coast than that of the whole world (:mod:`sameas.maps.outline`): extracts of OpenStreetMap, of a
chart or of a survey are GeoJSON, or become it by a geographic information system.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from sameas.arrays import FloatArray
from sameas.errors import InputError
from sameas.maps.outline import FARTHEST_M, Outline
from sameas.tracks.coordinates import LocalPlane, geodesy


@dataclass(frozen=True)
class Coast:
    """Land and shores on the globe.

    lines : each (n, 2) longitude and latitude, degrees. roles : of each: "land", "water" in it, or "shore".
    """

    lines: tuple[FloatArray, ...]
    roles: tuple[str, ...]

    def in_plane(self, plane: LocalPlane) -> Outline:
        """The same in metres east and north of a plane; what reaches farther than 2500 km away is left out."""
        land: list[FloatArray] = []
        coast: list[FloatArray] = []
        for places, role in zip(self.lines, self.roles, strict=True):
            lon, lat = places.T
            east, north, up = geodesy().geodetic2enu(lat, lon, np.zeros_like(lat), plane.lat_deg, plane.lon_deg, 0.0)
            if ((np.hypot(east, north) > FARTHEST_M) | (up < -FARTHEST_M)).any():
                continue
            line = np.column_stack([east, north])
            coast.append(line)
            ring = line[:-1] if np.array_equal(line[0], line[-1]) else line
            if role != "shore" and len(ring) >= 3:
                # Land to the left: fill by the nonzero rule leaves the holes open.
                land.append(ring if (_area(ring) > 0.0) == (role == "land") else ring[::-1])
        return Outline(tuple(land), tuple(coast))


def read_coast(path: str | os.PathLike[str]) -> Coast:
    """The land and the shores of a GeoJSON file (RFC 7946: WGS84, longitude first).

    path : polygons are land, their holes are water; lines are shores. Points and properties are passed over.

    Raises
    ------
    InputError : the file cannot be read, is not GeoJSON, has no polygon or line, or coordinates that are none.
    """
    try:
        with open(path, encoding="utf-8") as file:
            whole = json.load(file)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: is no GeoJSON: {error}") from error
    lines: list[FloatArray] = []
    roles: list[str] = []
    for number, geometry in _geometries(whole, path):
        for points, role in _lines(geometry):
            lines.append(_places(points, f"{path}: feature {number}"))
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
        raise InputError(f"{path}: is no GeoJSON", "give a FeatureCollection, a Feature or a geometry")
    for number, feature in enumerate(features):
        geometry = feature.get("geometry") if isinstance(feature, dict) else None
        parts = [geometry] if isinstance(geometry, dict) else []
        while parts:
            part = parts.pop()
            if part.get("type") == "GeometryCollection":
                parts += [inner for inner in part.get("geometries", []) if isinstance(inner, dict)]
            else:
                yield number, part


def _lines(geometry: dict[str, Any]) -> Iterator[tuple[Any, str]]:
    """The coordinates of each line of a geometry, and what it is: land, water or shore."""
    kind, places = geometry.get("type"), geometry.get("coordinates", [])
    if kind in ("Polygon", "MultiPolygon"):
        for polygon in [places] if kind == "Polygon" else places:
            for k, ring in enumerate(polygon):
                yield ring, "water" if k else "land"
    elif kind in ("LineString", "MultiLineString"):
        for line in [places] if kind == "LineString" else places:
            yield line, "shore"


def _places(points: Any, where: str) -> FloatArray:
    """(n, 2) longitude and latitude, degrees."""
    try:
        places = np.array([point[:2] for point in points], dtype=np.float64).reshape(-1, 2)
    except (TypeError, ValueError, IndexError) as error:
        raise InputError(f"{where}: coordinates that are no pairs of numbers") from error
    if len(places) < 2 or not np.isfinite(places).all() or np.abs(places[:, 1]).max() > 90.0:
        raise InputError(f"{where}: coordinates that are no longitudes and latitudes in degrees")
    return places


def _area(ring: FloatArray) -> float:
    """Twice the signed area: positive where it runs anticlockwise."""
    x, y = ring.T
    return float(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1)))

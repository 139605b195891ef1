"""Guard zones as they are given: polygons, circles and sectors, fixed or about own ship.

- :func:`read_zones`: of a GeoJSON file. :func:`zone_of`: of a table of a sensor file.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sameas.errors import InputError
from sameas.maps import geojson

#: Keys of the table of a circle or sector, and those that are numbers.
_KEYS = ("name", "lat_deg", "lon_deg", "radius_m", "nearest_m", "sector_deg", "to_bow")
_NUMBERS = ("lat_deg", "lon_deg", "radius_m", "nearest_m")


@dataclass(frozen=True)
class Zone:
    """A guard zone.

    name : of the zone, in its alarms. rings : of polygons, each of (longitude, latitude) in degrees; a place is inside
    if an odd number of them surrounds it. Without rings it is a circle: lat_deg, lon_deg : its centre; None: own ship.
    radius_m, nearest_m : its outer and inner radius. sector_deg : (from, to), clockwise; None for all around. to_bow :
    whether the sector is relative to the heading of own ship, or her course where she has none; else to north.
    """

    name: str
    rings: tuple[tuple[tuple[float, float], ...], ...] = ()
    lat_deg: float | None = None
    lon_deg: float | None = None
    radius_m: float = 0.0
    nearest_m: float = 0.0
    sector_deg: tuple[float, float] | None = None
    to_bow: bool = False

    @property
    def about_own_ship(self) -> bool:
        """Whether the zone moves with own ship."""
        return not self.rings and self.lat_deg is None


def zone_of(table: Any, where: str) -> Zone:
    """The circle or sector of a table.

    Raises InputError: unknown keys, numbers out of range, no radius; a fixed centre with a sector relative to the bow.
    """
    form = 'give { name = "…", radius_m = … }, with lat_deg and lon_deg where it does not move with own ship'
    if not isinstance(table, Mapping) or not isinstance(table.get("name"), str) or not table["name"].strip():
        raise InputError(f"{where}: is no zone with a name", form)
    if unknown := [key for key in table if key not in _KEYS]:
        raise InputError(f"{where}: {unknown[0]!r} is not known", f"give one of {', '.join(_KEYS)}")
    numbers: dict[str, float] = {}
    for key in _NUMBERS:
        if key in table:
            value = table[key]
            if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
                raise InputError(f"{where}: {key} is {value!r}", "give a number")
            numbers[key] = float(value)
    if not numbers.get("radius_m", 0.0) > numbers.get("nearest_m", 0.0) >= 0.0:
        raise InputError(f"{where}: has no radius_m above its nearest_m", form)
    if ("lat_deg" in numbers) != ("lon_deg" in numbers) or abs(numbers.get("lat_deg", 0.0)) > 90.0:
        raise InputError(f"{where}: its centre is no latitude and longitude", "give both in degrees, or none")
    sector, to_bow = table.get("sector_deg"), table.get("to_bow", False)
    if sector is not None:
        angles = sector if isinstance(sector, list | tuple) else []
        if len(angles) != 2 or any(isinstance(a, bool) or not isinstance(a, int | float) for a in angles):
            raise InputError(f"{where}: sector_deg is {sector!r}", "give [from, to] in degrees, clockwise")
        if not all(math.isfinite(a) for a in angles):
            raise InputError(f"{where}: sector_deg is {sector!r}", "give [from, to] in degrees, clockwise")
        sector = (float(angles[0]), float(angles[1]))
    if not isinstance(to_bow, bool) or (to_bow and "lat_deg" in numbers):
        raise InputError(
            f"{where}: to_bow is {to_bow!r}", "give true or false, and true for a zone about own ship only"
        )
    return Zone(
        table["name"].strip(), (), numbers.get("lat_deg"), numbers.get("lon_deg"), numbers["radius_m"],
        numbers.get("nearest_m", 0.0), sector, to_bow,
    )  # fmt: skip


def read_zones(path: str | Path) -> tuple[Zone, ...]:
    """The zones of a GeoJSON file (RFC 7946), each a feature with the property ``name``.

    A polygon is a zone as it is; a point with the properties of :func:`zone_of` is a circle or a sector about it, and a
    feature without geometry one about own ship.

    Raises InputError: the file cannot be read, is not GeoJSON, or has a feature that is no zone.
    """
    whole = geojson.read(path)
    features = (
        whole.get("features") if isinstance(whole, dict) and whole.get("type") == "FeatureCollection" else [whole]
    )
    if not isinstance(features, list) or not features:
        raise InputError(f"{path}: has no features", "give a FeatureCollection of polygons and points")
    zones = tuple(_zone_of_feature(one, f"{path}: feature {k}") for k, one in enumerate(features))
    require_names(zones, str(path))
    return zones


def require_names(zones: Sequence[Zone], where: str) -> None:
    """Refuses two zones of one name: their alarms could not be told apart."""
    names = [zone.name for zone in zones]
    if twice := [name for name in names if names.count(name) > 1]:
        raise InputError(f"{where}: two guard zones are called {twice[0]!r}", "give each its own name")


def _zone_of_feature(feature: Any, where: str) -> Zone:
    if not isinstance(feature, dict) or feature.get("type") != "Feature" or "geometry" not in feature:
        raise InputError(f"{where}: is no feature", "give features with a geometry, or null about own ship")
    properties = feature.get("properties")
    known = {key: value for key, value in properties.items() if key in _KEYS} if isinstance(properties, dict) else {}
    geometry = feature["geometry"]
    if geometry is None:
        return zone_of(known, where)
    kind = geometry.get("type") if isinstance(geometry, dict) else None
    places = geometry.get("coordinates") if isinstance(geometry, dict) else None
    if kind == "Point":
        [(lon, lat)] = _ring([places], where, least=1)
        return zone_of(known | {"lat_deg": lat, "lon_deg": lon}, where)
    if kind not in ("Polygon", "MultiPolygon") or not isinstance(places, list):
        raise InputError(f"{where}: is {kind!r}", "give polygons, or points with radius_m")
    if not isinstance(known.get("name"), str) or not known["name"].strip():
        raise InputError(f"{where}: has no name", "give the property name, a text")
    return Zone(known["name"].strip(), tuple(_rings([places] if kind == "Polygon" else places, where)))


def _rings(polygons: list[Any], where: str) -> Iterator[tuple[tuple[float, float], ...]]:
    for polygon in polygons:
        if not isinstance(polygon, list) or not polygon:
            raise InputError(f"{where}: has no ring", "give polygons with three corners or more")
        for ring in polygon:
            yield _ring(ring, where, least=3)


def _ring(points: Any, where: str, *, least: int) -> tuple[tuple[float, float], ...]:
    """(longitude, latitude) of the corners, without the repeated last one."""
    places = geojson.places(points, where, least=least)
    if len(places) > 1 and np.array_equal(places[0], places[-1]):
        places = places[:-1]
    if len(places) < least:
        raise InputError(f"{where}: {len(places)} corners", f"give {least} or more")
    return tuple((float(lon), float(lat)) for lon, lat in places)

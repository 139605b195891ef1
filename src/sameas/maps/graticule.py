"""Lines of latitude and longitude over a part of a plane, or of whole metres where there is no earth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sameas.records import FloatArray
from sameas.tracks.coordinates import LocalPlane, geodesy

#: Steps of the lines, in minutes of arc.
STEPS = (0.01, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 30, 60, 120, 300, 600, 1200, 1800)
#: Metres of a minute of latitude.
MINUTE_M = 1853.0
#: Points of a line.
POINTS = 49
#: The northernmost line, and the southernmost; beyond them lies only the pole.
LAST_DEG = 89.9


@dataclass(frozen=True)
class GridLine:
    """points : (n, 2) metres in the plane. parallel : along it the latitude, or y, is the same."""

    points: FloatArray
    words: str
    parallel: bool


def graticule(
    plane: LocalPlane | None, west_m: float, south_m: float, east_m: float, north_m: float, lines: int = 5
) -> list[GridLine]:
    """About so many lines each way over a box; of whole metres where ``plane`` is None.

    Example
    -------
    >>> [line.words for line in graticule(None, 0.0, 0.0, 1000.0, 400.0) if not line.parallel]
    ['x 0 m', 'x 200 m', 'x 400 m', 'x 600 m', 'x 800 m', 'x 1000 m']
    """
    if plane is None:
        return _metres(west_m, south_m, east_m, north_m, lines)
    x, y = np.meshgrid(np.linspace(west_m, east_m, 9), np.linspace(south_m, north_m, 9))
    lat, lon = plane.to_geodetic(np.column_stack([x.ravel(), y.ravel()]))
    turn = (lon - plane.lon_deg + 180.0) % 360.0 - 180.0
    low, high, first, last = lat.min(), lat.max(), turn.min(), turn.max()
    for pole in (-90.0, 90.0):
        if abs(plane.lat_deg - pole) < 20.0 and _holds_pole(plane, pole, (west_m, south_m, east_m, north_m)):
            low, high, first, last = min(low, pole), max(high, pole), -180.0, 180.0
    wide = max(east_m - west_m, north_m - south_m) / lines / MINUTE_M
    up = next((step for step in STEPS if step >= wide), STEPS[-1]) / 60.0
    shrunk = max(np.cos(np.radians(plane.lat_deg)), 0.03)
    across = next((step for step in STEPS if step * shrunk >= wide), STEPS[-1]) / 60.0
    found = []
    for value in np.arange(np.ceil(max(low, -LAST_DEG) / up), np.floor(min(high, LAST_DEG) / up) + 1) * up:
        along = plane.lon_deg + np.linspace(first, last, POINTS)
        found.append(GridLine(_placed(plane, np.full(POINTS, value), along), _words(value, "NS", 2, up), True))
    start, stop = plane.lon_deg + first, plane.lon_deg + last
    for value in np.arange(np.ceil(start / across), np.ceil(stop / across) + (last - first < 360.0)) * across:
        up_to = np.linspace(max(low, -LAST_DEG), min(high, LAST_DEG), POINTS)
        east = (value + 180.0) % 360.0 - 180.0
        found.append(GridLine(_placed(plane, up_to, np.full(POINTS, value)), _words(east, "EW", 3, across), False))
    return found


def _holds_pole(plane: LocalPlane, pole: float, box: tuple[float, float, float, float]) -> bool:
    x, y = _placed(plane, np.array([pole]), np.array([0.0]))[0]
    return bool(box[0] < x < box[2] and box[1] < y < box[3])


def _placed(plane: LocalPlane, lat: FloatArray, lon: FloatArray) -> FloatArray:
    east, north, _ = geodesy().geodetic2enu(lat, lon, np.zeros_like(lat), plane.lat_deg, plane.lon_deg, 0.0)
    return np.column_stack([east, north])


def _words(degrees: float, letters: str, width: int, step: float) -> str:
    """50°46′N, with as many decimals of a minute as the step needs."""
    digits = next((d for d in (0, 1) if abs(step * 60 * 10**d - round(step * 60 * 10**d)) < 1e-6), 2)
    minutes = round(abs(degrees) * 60.0, digits)
    whole = int(minutes // 60)
    wide = 3 + digits if digits else 2
    return f"{whole:0{width}d}°{minutes - 60 * whole:0{wide}.{digits}f}′{letters[int(degrees < 0)]}"


def _metres(west: float, south: float, east: float, north: float, lines: int) -> list[GridLine]:
    power = 10.0 ** np.floor(np.log10(max(east - west, north - south) / lines))
    step = next(s * power for s in (1, 2, 5, 10) if s * power * lines >= max(east - west, north - south) * 0.999)
    unit, word = (1000.0, "km") if step >= 1000 else (1.0, "m")
    found = []
    for value in np.arange(np.ceil(west / step), np.floor(east / step) + 1) * step:
        found.append(GridLine(np.array([[value, south], [value, north]]), f"x {value / unit:g} {word}", False))
    for value in np.arange(np.ceil(south / step), np.floor(north / step) + 1) * step:
        found.append(GridLine(np.array([[west, value], [east, value]]), f"y {value / unit:g} {word}", True))
    return found

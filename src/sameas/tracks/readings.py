"""Readings: other ways in which what a source says may be meant, to be tried where it makes no sense as it stands.

Each knows in words what is suspected and what to do. None is ever applied to the user's data.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from sameas.records import FloatArray
from sameas.tracks.reports import Reports
from sameas.tracks.source import Description, Site

#: What a length may be meant in, the word for it, and metres.
LENGTHS = (("kilometres", 1000.0), ("nautical miles", 1852.0), ("feet", 0.3048), ("millimetres", 0.001))
#: Hours by which the clocks of zones differ, and seconds by which the time of satellites is ahead of UTC since 2017.
HOURS, LEAP_S = (*range(-12, 0), *range(1, 15)), 18.0
DEGREE = 180.0 / math.pi

Source = tuple[Description, Reports]
Read = Callable[[Description, Reports], Source | None]


@dataclass(frozen=True)
class Reading:
    """One other way to read a source.

    suspicion : what it looks like, after "its ". changed : "with …", what was tried. remedy : what to do.
    read : the source as it would be, or None where it cannot be read so.
    """

    suspicion: str
    changed: str
    remedy: str
    read: Read


def readings_of_place(reports: Reports) -> Iterator[Reading]:
    """Ways to read coordinates on the earth: of positions, or of the sensor's site."""
    if reports.position == "geodetic":
        yield Reading("longitudes look like they have the wrong sign", "the sign turned",
                      "turn the sign of its longitudes (west is negative)", _with_signs(1.0, -1.0))  # fmt: skip
        yield Reading("latitudes look like they have the wrong sign", "the sign turned",
                      "turn the sign of its latitudes (south is negative)", _with_signs(-1.0, 1.0))  # fmt: skip
        yield Reading("latitudes and longitudes look exchanged", "them exchanged",
                      "exchange the two columns, or name them", _with_exchange)  # fmt: skip
        yield Reading("latitudes and longitudes look like radians", "them taken so",
                      "say that their unit is rad", _with_radians)  # fmt: skip
        return
    yield Reading("site's longitude looks like it has the wrong sign", "the sign turned",
                  "turn the sign of lon_deg in its site (west is negative)",
                  _with_site(lambda lat, lon: (lat, -lon)))  # fmt: skip
    yield Reading("site's latitude and longitude look exchanged", "them exchanged",
                  "exchange lat_deg and lon_deg in its site", _with_site(lambda lat, lon: (lon, lat)))  # fmt: skip


def readings(reports: Reports) -> Iterator[Reading]:
    """All ways to read the positions of a source."""
    yield from readings_of_place(reports)
    if reports.position == "local":
        yield Reading("x and y look exchanged", "them exchanged", "name the columns: x is east, y is north",
                      lambda about, said: (about, replace(said, x_m=said.y_m, y_m=said.x_m)))  # fmt: skip
        yield from (_in_length("coordinates", unit, m, _with_coordinates(m)) for unit, m in LENGTHS)
    if reports.position == "polar":
        yield from (_in_length("ranges", unit, m, _with_ranges(m)) for unit, m in LENGTHS)
    if reports.bearing_deg is not None:
        yield Reading("bearings look like radians", "them taken so", "say that their unit is rad",
                      _with_bearings(lambda bearing: bearing * DEGREE, 2.0 * math.pi + 0.01))  # fmt: skip
        yield Reading("bearings look like angles from the east, anticlockwise", "them taken so",
                      "give 90° less the angle: bearings run clockwise from north",
                      _with_bearings(lambda angle: 90.0 - angle, 360.0))  # fmt: skip


def clock_readings() -> Iterator[tuple[str, str, float]]:
    """Suspicion, remedy, and seconds by which stamps would be ahead."""
    for hours in sorted(HOURS, key=abs):
        ahead = "ahead" if hours > 0 else "behind"
        yield (f"clock looks {abs(hours)} h {ahead}, as in another time zone", "give its times in UTC", 3600.0 * hours)
    yield "clock looks 18 s ahead, as that of satellites", "take the leap seconds off its times", LEAP_S


def _with_signs(of_lat: float, of_lon: float) -> Read:
    def read(about: Description, said: Reports) -> Source | None:
        lat, lon = np.asarray(said.lat_deg), np.asarray(said.lon_deg)
        return about, replace(said, lat_deg=of_lat * lat, lon_deg=of_lon * lon)

    return read


def _with_exchange(about: Description, said: Reports) -> Source | None:
    lat, lon = np.asarray(said.lat_deg), np.asarray(said.lon_deg)
    return None if np.nanmax(np.abs(lon)) > 90.0 else (about, replace(said, lat_deg=lon, lon_deg=lat))


def _with_radians(about: Description, said: Reports) -> Source | None:
    lat, lon = np.asarray(said.lat_deg), np.asarray(said.lon_deg)
    if np.nanmax(np.abs(lat)) > math.pi / 2.0 or np.nanmax(np.abs(lon)) > math.pi:
        return None
    return about, replace(said, lat_deg=DEGREE * lat, lon_deg=DEGREE * lon)


def _with_site(changed: Callable[[float, float], tuple[float, float]]) -> Read:
    def read(about: Description, said: Reports) -> Source | None:
        if about.site is None or about.site.lat_deg is None or about.site.lon_deg is None:
            return None
        lat, lon = changed(about.site.lat_deg, about.site.lon_deg)
        site = Site(lat, lon, about.site.height_m)
        return None if abs(lat) > 90.0 else (replace(about, site=site), said)

    return read


def _in_length(what: str, unit: str, metres: float, read: Read) -> Reading:
    return Reading(f"{what} look like {unit}", "them taken so", f"say that their unit is {unit}, or give metres", read)


def _with_coordinates(metres: float) -> Read:
    def read(about: Description, said: Reports) -> Source | None:
        return about, replace(said, x_m=metres * np.asarray(said.x_m), y_m=metres * np.asarray(said.y_m))

    return read


def _with_ranges(metres: float) -> Read:
    def read(about: Description, said: Reports) -> Source | None:
        return about, replace(said, range_m=metres * np.asarray(said.range_m))

    return read


def _with_bearings(changed: Callable[[FloatArray], FloatArray], most: float) -> Read:
    def read(about: Description, said: Reports) -> Source | None:
        bearing = np.asarray(said.bearing_deg)
        if not np.nanmax(bearing) <= most:
            return None
        return about, replace(said, bearing_deg=np.mod(changed(bearing), 360.0))

    return read

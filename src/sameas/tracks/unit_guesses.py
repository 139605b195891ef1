"""Possible mistakes in the units, signs and order of a source's numbers, each with the source as it would be then.

They are tried only for sources that match no other, and only to name the remedy: data are never changed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sameas.arrays import FloatArray
from sameas.tracks.bearing_readings import MIRRORED, OF_BOW, OF_NORTH
from sameas.tracks.coordinates import FOOT_M, MILE_M
from sameas.tracks.reports import Reports
from sameas.tracks.source import Description, Site

#: Units in which a length may be given, in metres.
LENGTHS = (("kilometres", 1000.0), ("nautical miles", MILE_M), ("feet", FOOT_M), ("millimetres", 0.001))
#: Hours between time zones, and seconds by which GPS time is ahead of UTC since 2017.
HOURS, LEAP_S = (*range(-12, 0), *range(1, 15)), 18.0
#: Delays of stamps that are tried, and of clocks that are early, in seconds: a queue, a recorder, a clock set by hand.
DELAYS = (*range(15, 195, 15), *range(-60, 0, 15))
DEGREE = 180.0 / math.pi

Source = tuple[Description, Reports]
Read = Callable[[Description, Reports], Source | None]


@dataclass(frozen=True)
class UnitGuess:
    """A possible mistake in a source's coordinates or units, in words. It is never applied to the data.

    suspicion : the mistake, after "its ". changed : the change tried, after "with ". remedy : what to do.
    read : makes the changed source; None if its values exclude the mistake.
    """

    suspicion: str
    changed: str
    remedy: str
    read: Read


def place_guesses(reports: Reports) -> Iterator[UnitGuess]:
    """Possible mistakes in geodetic coordinates: of positions, or of the sensor's site."""
    if reports.position == "geodetic":
        yield UnitGuess("longitudes look like they have the wrong sign", "the sign turned",
                      "turn the sign of its longitudes (west is negative)", _scaled(-1.0, "lon_deg"))  # fmt: skip
        yield UnitGuess("latitudes look like they have the wrong sign", "the sign turned",
                      "turn the sign of its latitudes (south is negative)", _scaled(-1.0, "lat_deg"))  # fmt: skip
        yield UnitGuess("latitudes and longitudes look exchanged", "them exchanged",
                      "exchange the two columns, or name them", _with_exchange)  # fmt: skip
        yield UnitGuess("latitudes and longitudes look like radians", "them read so",
                      "give their unit as rad", _with_radians)  # fmt: skip
        return
    yield UnitGuess("site's longitude looks like it has the wrong sign", "the sign turned",
                  "turn the sign of lon_deg in its site (west is negative)",
                  _with_site(lambda lat, lon: (lat, -lon)))  # fmt: skip
    yield UnitGuess("site's latitude and longitude look exchanged", "them exchanged",
                  "exchange lat_deg and lon_deg in its site", _with_site(lambda lat, lon: (lon, lat)))  # fmt: skip


def unit_guesses(reports: Reports) -> Iterator[UnitGuess]:
    """All possible mistakes in the positions of a source."""
    yield from place_guesses(reports)
    if reports.position == "local":
        yield UnitGuess("x and y look exchanged", "them exchanged", "name the columns: x is east, y is north",
                      lambda about, reports: (about, replace(reports, x_m=reports.y_m, y_m=reports.x_m)))  # fmt: skip
        yield from (_in_length("coordinates", unit, _scaled(m, "x_m", "y_m")) for unit, m in LENGTHS)
    if reports.position == "polar":
        yield from range_guesses()
    if reports.bearing_deg is not None:
        yield UnitGuess("bearings look like radians", "them read so", "give their unit as rad",
                      _with_bearings(lambda bearing: bearing * DEGREE, 2.0 * math.pi + 0.01))  # fmt: skip
        yield UnitGuess("bearings look like angles from the east, anticlockwise", "them read so",
                      "give 90° less the angle: bearings run clockwise from north",
                      _with_bearings(lambda angle: 90.0 - angle, 360.0))  # fmt: skip
        mirrored = _with_bearings(lambda angle: -angle, 360.0)
        yield UnitGuess(MIRRORED[0], "their sign turned", MIRRORED[2], mirrored)
        yield from bow_guesses(reports)


def range_guesses(at_least_m: float = 0.0) -> Iterator[UnitGuess]:
    """Other units of the ranges, of this length or longer."""
    yield from (_in_length("ranges", unit, _scaled(m, "range_m")) for unit, m in LENGTHS if m >= at_least_m)


def bow_guesses(reports: Reports) -> Iterator[UnitGuess]:
    """That bearings from the bow of a vessel are read as from north, or the reverse."""
    heading_deg = reports.heading_deg if reports.station_heading_deg is None else reports.station_heading_deg
    if reports.position != "polar" or reports.bearing_deg is None or heading_deg is None:
        return
    of_bow = _with_bearings(lambda angle: angle + heading_deg, 360.0)
    yield UnitGuess(OF_BOW[0], "the heading added", OF_BOW[2], of_bow)
    of_north = _with_bearings(lambda angle: angle - heading_deg, 360.0)
    yield UnitGuess(OF_NORTH[0], "the heading taken off", OF_NORTH[2], of_north)


def clock_guesses() -> Iterator[tuple[str, str, float]]:
    """Suspicion, remedy, and the seconds by which the stamps would be ahead."""
    for hours in sorted(HOURS, key=abs):
        ahead = "ahead" if hours > 0 else "behind"
        yield (f"clock looks {abs(hours)} h {ahead}, as in another time zone", "give its times in UTC", 3600.0 * hours)
    yield "clock looks 18 s ahead, as that of satellites", "take the leap seconds off its times", LEAP_S
    for delay_s in DELAYS:
        yield *_delay_words(delay_s), float(delay_s)


def delay_guesses(reports: Reports) -> Iterator[UnitGuess]:
    """Delays of the stamps of a sensor that moves: its vessel was elsewhere when it measured, and headed elsewhere.

    Its bearings may be from the bow, turned by the heading at the time of the stamps, or from north.
    """
    if reports.station_lat_deg is None or reports.bearing_deg is None:
        return
    for delay_s in DELAYS:
        suspicion, remedy = _delay_words(delay_s)
        for turned in (False, True) if reports.station_heading_deg is not None else (False,):
            yield UnitGuess(suspicion, "that removed", remedy, _with_delay(delay_s, turned=turned))


def _delay_words(delay_s: float) -> tuple[str, str]:
    late = "late" if delay_s > 0 else "early"
    return f"stamps look about {abs(delay_s)} s {late}", f"give latency_s = {delay_s} in its timing, or correct them"


def _with_delay(delay_s: float, *, turned: bool) -> Read:
    def read(about: Description, reports: Reports) -> Source | None:
        order = np.argsort(reports.time_s, kind="stable")
        time_s = reports.time_s[order]

        def before(values: FloatArray) -> FloatArray:
            return np.interp(reports.time_s - delay_s, time_s, np.asarray(values)[order])

        known = (reports.time_s - delay_s >= time_s[0]) & (reports.time_s - delay_s <= time_s[-1])
        new: dict[str, Any] = {"time_s": reports.time_s - delay_s}
        new |= {name: before(getattr(reports, name)) for name in ("station_lat_deg", "station_lon_deg")}
        if turned:
            heading_deg = np.asarray(reports.station_heading_deg)
            whole = heading_deg.copy()
            whole[order] = np.unwrap(heading_deg[order], period=360.0)
            new["bearing_deg"] = np.mod(np.asarray(reports.bearing_deg) + before(whole) - heading_deg, 360.0)
        return (about, replace(reports, **new).where(known)) if known.any() else None

    return read


def _scaled(factor: float, *columns: str) -> Read:
    def read(about: Description, reports: Reports) -> Source | None:
        scaled: dict[str, Any] = {name: factor * np.asarray(getattr(reports, name)) for name in columns}
        return about, replace(reports, **scaled)

    return read


def _with_exchange(about: Description, reports: Reports) -> Source | None:
    lat, lon = np.asarray(reports.lat_deg), np.asarray(reports.lon_deg)
    return None if np.nanmax(np.abs(lon)) > 90.0 else (about, replace(reports, lat_deg=lon, lon_deg=lat))


def _with_radians(about: Description, reports: Reports) -> Source | None:
    lat, lon = np.asarray(reports.lat_deg), np.asarray(reports.lon_deg)
    if np.nanmax(np.abs(lat)) > math.pi / 2.0 or np.nanmax(np.abs(lon)) > math.pi:
        return None
    return about, replace(reports, lat_deg=DEGREE * lat, lon_deg=DEGREE * lon)


def _with_site(changed: Callable[[float, float], tuple[float, float]]) -> Read:
    def read(about: Description, reports: Reports) -> Source | None:
        if about.site is None or about.site.lat_deg is None or about.site.lon_deg is None:
            return None
        lat, lon = changed(about.site.lat_deg, about.site.lon_deg)
        site = Site(lat, lon, about.site.height_m)
        return None if abs(lat) > 90.0 else (replace(about, site=site), reports)

    return read


def _in_length(what: str, unit: str, read: Read) -> UnitGuess:
    return UnitGuess(
        f"{what} look like {unit}", "them read so", f"give their unit as {unit}, or convert them to metres", read
    )


def _with_bearings(changed: Callable[[FloatArray], FloatArray], most: float) -> Read:
    def read(about: Description, reports: Reports) -> Source | None:
        bearing = np.asarray(reports.bearing_deg)
        if not np.nanmax(bearing) <= most:
            return None
        return about, replace(reports, bearing_deg=np.mod(changed(bearing), 360.0))

    return read

"""APRS of the Open Glider Network: gliders and light aircraft with FLARM and other trackers, as servers send them.

    FLRDDE626>APRS,qAS,EGHL:/074548h5111.32N/00102.04W'086/007/A=000607 !W83! id0ADDE626 -019fpm +0.0rot 5.5dB gps2x3

Positions are of GNSS, to 0.01′, or 0.001′ with the digits of ``!W83!``; ``000/000`` is no course and no speed. Heights
are above the sea, those of ADS-B (``OGADSB``) pressure heights. Times are UTC without a date, which servers send in
comments. An aircraft has an ``id``, of 24 bits after 8 (Naviter: 16) that say whose address it is; trackers of other
systems, which hang gliders carry (Flymaster, SPOT, inReach), are known by their call, three letters and six digits.
Receivers (``TCPIP*``) and weather stations are no aircraft. A server greets with a comment, wants a login
(:func:`login`), and sends what its filter passes. Source: the OGN wiki, "aprs"; glidernet/ogn-aprs-protocol;
aprs-is.net, "Connecting to APRS-IS".
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import datetime
from typing import Any

import numpy as np

from sameas.errors import UndatedTimes, naming
from sameas.io.sensors.format import (
    DAY_S,
    FEET_PER_MINUTE_M_PER_S,
    KNOT_M_PER_S,
    SensorFormat,
    round_covariance,
    unwrapped,
)
from sameas.tracks.coordinates import FOOT_M, MILE_M
from sameas.tracks.reports import Reports, Unused, of_rows

_LINE = re.compile(
    r"(?P<call>[A-Z0-9-]{3,9})>(?P<path>[^:]+):/(?P<hour>\d{2})(?P<minute>\d{2})(?P<second>\d{2})h"
    r"(?P<lat>\d{2})(?P<lat_minutes>\d{2}\.\d{2})(?P<north>[NS]).(?P<lon>\d{3})(?P<lon_minutes>\d{2}\.\d{2})(?P<east>[EW])(?P<symbol>.)"
    r"(?:(?P<course>\d{3})/(?P<speed>\d{3}))?(?:/A=(?P<feet>-?\d{5,6}))?(?P<rest>.*)"
)
#: How the comments of servers begin: aprsc, javAPRSSrvr.
_COMMENT = re.compile(r"# ?(?:aprsc|javAPRS|logresp)")
_ID = re.compile(r"\bid([0-9A-F]{2}(?:[0-9A-F]{2})?)([0-9A-F]{6})\b")
#: The call of a tracker without such an id: who gave its address, and the address.
_CALL = re.compile(r"([A-Z]{3})([0-9A-F]{6})")
#: Who gives addresses that the ids of aircraft have, too: others number their own trackers.
_ADDRESSES = ("ICA", "FLR", "OGN")
#: Of receivers in the path of a line, and the symbol of weather stations.
_RECEIVER, _WEATHER = "TCPIP*", "_"
_FLIGHT = re.compile(r"\bfn(\w+)")
_DATE = re.compile(r"(\d{1,2} [A-Z][a-z]{2} \d{4} \d{2}:\d{2}:\d{2}) GMT")
_DIGITS = re.compile(r"!W(\d)(\d)!")
_CLIMB = re.compile(r"([+-]\d+)fpm")
_GPS = re.compile(r"\bgps(\d+)x(\d+)")
#: What an id says of an address that is ICAO's, in its two lowest bits, or in six of Naviter's.
_ICAO = 1
#: 1σ of GNSS, m, where no accuracy is stated (chosen), and that of a position to 0.01′.
_GNSS_M, _STEP_M = 10.0, 0.01 * MILE_M / 12.0**0.5


#: What tells a server that its client is there.
KEEP_ALIVE = "#keepalive\r\n"


def login(user: str, version: str, chosen: str) -> str:
    """The line with which a server is asked for what a filter chooses, as one that only reads (pass code −1).

    >>> login("N0CALL", "0.1.0", "r/51.2/-1.0/100")
    'user N0CALL pass -1 vers sameas 0.1.0 filter r/51.2/-1.0/100'
    """
    return f"user {user} pass -1 vers sameas {version}{f' filter {chosen}' if chosen else ''}"


def looks_like(lines: Sequence[str]) -> bool:
    """Whether any of these lines is of APRS: a position, or the comment of a server."""
    return any(_LINE.match(line) or _COMMENT.match(line) for line in lines)


def read(lines: Sequence[str], source: str, start_s: float | None) -> Reports:
    """The positions of aircraft in lines of APRS. start_s : UTC of the first line.

    Raises InputError: no position of an aircraft; no date.
    """
    unused, rows, day_s = Unused(), [], []
    for number, line in enumerate(lines, start=1):
        if not line.strip() or line.startswith("#"):
            start_s = _date(line) if start_s is None else start_s
            continue
        found = _LINE.search(line)
        if found is None:
            unused.passed_over["line without a position"] += 1
        elif (named := _name(found)) is None:
            unused.passed_over["position of a receiver or another station"] += 1
        else:
            try:
                rows.append({"line": number, **named, **_row(found)})
            except ValueError as error:
                unused.damaged.append((number, str(error)))
                continue
            day_s.append(3600.0 * int(found["hour"]) + 60.0 * int(found["minute"]) + float(found["second"]))
    if not rows:
        raise unused.refusal(f"{source}: no position of an aircraft: {unused.reasons() or 'no line has an id'}")
    if start_s is None:
        raise UndatedTimes(
            f"{source}: APRS has the time of day only", naming("give {start}, the UTC date of the first line")
        )
    columns = of_rows(rows) | {"time_s": unwrapped(np.array(day_s), DAY_S, start_s)}
    columns["covariance_m2"] = round_covariance(columns.pop("sigma_m"))
    return unused.reports(source, "ogn", columns, (f"{source}: times are read as UTC time of day, from the start",))


def _date(comment: str) -> float | None:
    """The time in a comment of a server; None if it has none."""
    found = _DATE.search(comment)
    try:
        return datetime.strptime(f"{found[1]} +0000", "%d %b %Y %H:%M:%S %z").timestamp() if found else None
    except ValueError:
        return None


def _name(found: re.Match[str]) -> dict[str, Any] | None:
    """The id of an aircraft, its address of ICAO and its flight; None of what is no aircraft."""
    if found["symbol"] == _WEATHER or _RECEIVER in found["path"]:
        return None
    flight = _FLIGHT.search(found["rest"])
    callsign = flight[1] if flight else None
    if named := _ID.search(found["rest"]):
        head, address = int(named[1], 16), named[2].lower()
        is_icao = (head % 4 if len(named[1]) == 2 else head >> 4 & 0x3F) == _ICAO
        return {"track_id": address, "icao": address if is_icao else None, "callsign": callsign}
    called = _CALL.fullmatch(found["call"])
    if called is None:
        return None
    address = called[2].lower()
    return {
        "track_id": address if called[1] in _ADDRESSES else called[0],
        "icao": address if called[1] == "ICA" else None, "callsign": callsign,
    }  # fmt: skip


def _row(found: re.Match[str]) -> dict[str, Any]:
    """A report by the columns of Reports. Raises ValueError with the reason."""
    more = _DIGITS.search(found["rest"])
    digits = (int(more[1]), int(more[2])) if more else (0, 0)
    place = []
    for name, digit, side, most in zip(("lat", "lon"), digits, ("north", "east"), (90.0, 180.0), strict=True):
        degrees = int(found[name]) + (float(found[f"{name}_minutes"]) + 0.001 * digit) / 60.0
        if degrees > most:
            raise ValueError("position outside the earth")
        place.append(-degrees if found[side] in "SW" else degrees)
    gps, climb = _GPS.search(found["rest"]), _CLIMB.search(found["rest"])
    sigma_m = float(gps[1]) if gps else _GNSS_M
    moves = found["course"] is not None and f"{found['course']}/{found['speed']}" != "000/000"
    height_m = None if found["feet"] is None else FOOT_M * float(found["feet"])
    return {
        "lat_deg": place[0], "lon_deg": place[1],
        "sigma_m": sigma_m if more else float(np.hypot(sigma_m, _STEP_M)),
        "course_deg": float(found["course"]) if moves else None,
        "speed_m_per_s": KNOT_M_PER_S * float(found["speed"]) if moves else None,
        "pressure_alt_m" if found["path"].startswith("OGADSB") else "alt_m": height_m,
        "climb_m_per_s": None if climb is None else FEET_PER_MINUTE_M_PER_S * float(climb[1]),
    }  # fmt: skip


FORMAT = SensorFormat(
    "ogn",
    "APRS of the Open Glider Network",
    lambda file: [read(file.lines, file.source, file.start_s)],
    lambda file: looks_like(file.head_lines),
)

"""APRS of the Open Glider Network: gliders and light aircraft with FLARM and other trackers, as servers send them.

    FLRDDE626>APRS,qAS,EGHL:/074548h5111.32N/00102.04W'086/007/A=000607 !W83! id0ADDE626 -019fpm +0.0rot 5.5dB gps2x3

Positions are of GNSS, to 0.01′, or 0.001′ with the digits of ``!W83!``. Times are UTC without a date, which servers
send in comments. Lines without an ``id`` are of receivers and other stations. Addresses are ICAO's if the id says so.
A server greets with a comment, wants a login (:func:`login`), and sends what its filter passes. Source: the OGN wiki,
"aprs"; aprs-is.net, "Connecting to APRS-IS".
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
    r"[A-Z0-9-]{3,9}>[^:]+:/(?P<hour>\d{2})(?P<minute>\d{2})(?P<second>\d{2})h"
    r"(?P<lat>\d{2})(?P<lat_minutes>\d{2}\.\d{2})(?P<north>[NS]).(?P<lon>\d{3})(?P<lon_minutes>\d{2}\.\d{2})(?P<east>[EW])."
    r"(?:(?P<course>\d{3})/(?P<speed>\d{3}))?(?:/A=(?P<feet>-?\d{5,6}))?(?P<rest>.*)"
)
#: How the comments of servers begin: aprsc, javAPRSSrvr.
_COMMENT = re.compile(r"# ?(?:aprsc|javAPRS|logresp)")
_ID = re.compile(r"\bid([0-9A-F]{2})([0-9A-F]{6})\b")
_DATE = re.compile(r"(\d{1,2} [A-Z][a-z]{2} \d{4} \d{2}:\d{2}:\d{2}) GMT")
_DIGITS = re.compile(r"!W(\d)(\d)!")
_CLIMB = re.compile(r"([+-]\d+)fpm")
_GPS = re.compile(r"\bgps(\d+)x(\d+)")
#: What the two lowest bits of an id say of an address that is ICAO's.
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
        elif (named := _ID.search(found["rest"])) is None:
            unused.passed_over["position of a receiver or another station"] += 1
        else:
            try:
                rows.append({"line": number, **_row(found, named)})
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


def _row(found: re.Match[str], named: re.Match[str]) -> dict[str, Any]:
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
    address = named[2].lower()
    return {
        "lat_deg": place[0], "lon_deg": place[1], "track_id": address,
        "icao": address if int(named[1], 16) % 4 == _ICAO else None,
        "sigma_m": sigma_m if more else float(np.hypot(sigma_m, _STEP_M)),
        "course_deg": None if found["course"] is None else float(found["course"]),
        "speed_m_per_s": None if found["speed"] is None else KNOT_M_PER_S * float(found["speed"]),
        "alt_m": None if found["feet"] is None else FOOT_M * float(found["feet"]),
        "climb_m_per_s": None if climb is None else FEET_PER_MINUTE_M_PER_S * float(climb[1]),
    }  # fmt: skip


FORMAT = SensorFormat(
    "ogn",
    "APRS of the Open Glider Network",
    lambda file: [read(file.lines, file.source, file.start_s)],
    lambda file: looks_like(file.head_lines),
)

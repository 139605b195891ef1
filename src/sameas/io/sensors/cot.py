"""Cursor on Target: events of TAK servers and clients in XML, with or without an element around them.

Atoms (types ``a-…``) with a point are reports; chats, routes and pings are passed over, and so are the objects that a
watch of sameas has sent. ``ce`` and ``le`` are errors of 90 % probability (MITRE, Cursor on Target, event schema 2.0):
1σ is ce/2.146 per axis and le/1.645; 9999999 is unknown.
"""

from __future__ import annotations

import math
import re
from typing import Any
from xml.etree import ElementTree

from sameas.errors import InputError
from sameas.io.sensors.format import SensorFile, SensorFormat, instant, round_covariance
from sameas.tracks.reports import Reports, Unused, of_rows

_EVENT = re.compile(r"<event\b.*?</event>", re.DOTALL)
#: Error of 90 % probability over 1σ, of a circle and of a height; what stands for unknown.
_CIRCULAR, _LINEAR, _UNKNOWN = math.sqrt(-2.0 * math.log(0.1)), 1.645, 9_999_999.0
#: The names of objects that gateways make of an MMSI, and of an ICAO address.
_MMSI = re.compile(r"(?i)(?:mmsi|ais)\W*(\d{9})$")
_ICAO = re.compile(r"(?i)icao\W*([0-9a-f]{6})$")
#: The beginning of the names of objects that a watch sends.
OWN_OBJECTS = "sameas."


def read(file: SensorFile) -> list[Reports]:
    """The reports of the events of a file.

    Raises InputError: no event with a position.
    """
    unused, rows = Unused(unit="record"), []
    text = file.content.decode("utf-8-sig", errors="replace")
    for number, event in enumerate(_EVENT.findall(text), start=1):
        row = _row(number, event)
        if isinstance(row, dict):
            rows.append(row)
        elif row.startswith("no "):
            unused.damaged.append((number, row))
        else:
            unused.passed_over[row] += 1
    if not rows:
        raise InputError(f"{file.source}: no event of Cursor on Target with a position", "give a log of events")
    columns = of_rows(rows)
    columns["covariance_m2"] = round_covariance(columns.pop("sigma_m"))
    return [unused.reports(file.source, "cot", columns)]


def _row(number: int, text: str) -> dict[str, Any] | str:
    """The row of a report, or why there is none."""
    try:
        event = ElementTree.fromstring(text)
    except ElementTree.ParseError:
        return "no XML"
    point, detail, uid = event.find("point"), event.find("detail"), event.get("uid", "")
    if not event.get("type", "").startswith("a-"):
        return "other event"
    if uid.startswith(OWN_OBJECTS):
        return "object that sameas has sent"
    time_s = instant(event.get("time", ""))
    if time_s is None:
        return "no time"
    lat, lon, hae, ce, le = (_number(None if point is None else point.get(name)) for name in
                             ("lat", "lon", "hae", "ce", "le"))  # fmt: skip
    if not (abs(lat) <= 90.0 and abs(lon) <= 180.0) or (lat == 0.0 and lon == 0.0):
        return "no position"
    contact, track = (None if detail is None else detail.find(name) for name in ("contact", "track"))
    mmsi, icao = _MMSI.search(uid), _ICAO.search(uid)
    return {
        "line": number, "time_s": time_s, "lat_deg": lat, "lon_deg": lon, "track_id": uid or None,
        "alt_m": hae, "sigma_m": ce / _CIRCULAR, "sigma_alt_m": le / _LINEAR,
        "speed_m_per_s": _number(None if track is None else track.get("speed")),
        "course_deg": _number(None if track is None else track.get("course")),
        "name": None if contact is None else contact.get("callsign"),
        "mmsi": mmsi[1] if mmsi else None, "icao": icao[1].lower() if icao else None,
    }  # fmt: skip


def _number(text: str | None) -> float:
    """The number in an attribute; NaN for none, and for unknown."""
    try:
        value = float(text) if text else math.nan
    except ValueError:
        return math.nan
    return math.nan if abs(value) >= _UNKNOWN else value


FORMAT = SensorFormat(
    "cot",
    "Cursor on Target: events of TAK in XML",
    read,
    lambda file: re.search(rb"<event\b[^>]*\buid=", file.head[:8192]) is not None,
)

"""NMEA 2000 as JSON: the messages that canboat's ``analyzer -json`` and canboatjs write, one in a line.

The fields have names and units in place of bits, numbers or the texts of their lookups: they become those of
:data:`sameas.io.sensors.n2k.FIELDS`. Angles are degrees in canboat, and radians in canboatjs, whose objects have the
frames (``input``) or names in camel case, and in canboat's ``-si``, which shows in their decimals: degrees have one.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Any

from sameas.io.sensors.format import KNOT_M_PER_S, instant, of_json
from sameas.io.sensors.nmea import time_of_day

#: Our names of fields, by those of the messages without blanks in lower case.
_NAMES: Mapping[str, str] = {
    "messageid": "type", "userid": "mmsi", "longitude": "lon", "latitude": "lat", "cog": "course", "sog": "speed",
    "trueheading": "heading", "timestamp": "second", "navstatus": "status", "imonumber": "imo", "name": "shipname",
    "aistransceiverinformation": "transceiver", "typeofship": "ship_type", "beam": "width",
    "positionreferencefromstarboard": "from_starboard", "positionreferencefrombow": "from_bow", "method": "method",
    "cogreference": "reference", "bearingreference": "reference", "targetid": "number", "trackstatus": "status",
    "distance": "range_m", "positionaccuracy": "accuracy",
}  # fmt: skip
_ANGLES = ("course", "heading", "bearing", "deviation", "variation")
#: An angle in radians, as canboat writes it with -si.
_RADIANS = re.compile(r'"(?:COG|Course|Heading|True Heading|Bearing|Deviation|Variation)"\s*:\s*-?[0-6]\.\d{3,}')
#: The numbers that the beginnings of texts stand for, by field.
_LOOKUPS: Mapping[str, tuple[tuple[str, int], ...]] = {
    "type": (("scheduled", 1), ("assigned", 2), ("interrogated", 3)),
    "reference": (("true", 0), ("magnetic", 1)),
    "transceiver": (("channel a vdl rec", 0), ("channel b vdl rec", 1), ("channel a vdl tr", 2),
                    ("channel b vdl tr", 3), ("own", 4)),
    "status": (("under way using", 0), ("at anchor", 1), ("not under", 2), ("moored", 5), ("aground", 6),
               ("engaged", 7), ("under way sailing", 8), ("cancel", 0), ("acquiring", 1), ("tracking", 2), ("lost", 3)),
    "method": (("no gnss", 0),),
    "accuracy": (("low", 0), ("high", 1)),
    "ship_type": (("wing", 20), ("fishing", 30), ("towing", 31), ("dredg", 33), ("diving", 34), ("military", 35),
                  ("sailing", 36), ("pleasure", 37), ("high speed", 40), ("pilot", 50), ("sar", 51), ("tug", 52),
                  ("port tender", 53), ("law", 55), ("medical", 58), ("passenger", 60), ("cargo", 70), ("tanker", 80)),
}  # fmt: skip
_TEXTS = ("callsign", "shipname")


def described(line: str) -> tuple[float | None, int, dict[str, Any]]:
    """Time of receipt, PGN and fields of a message.

    Raises ValueError: it is none.
    """
    said = of_json(line)
    if not isinstance(said, Mapping) or "pgn" not in said or not isinstance(said.get("fields"), Mapping):
        raise ValueError("no message of NMEA 2000")
    pgn, fields = int(said["pgn"]), said["fields"]
    radians = "input" in said or any(re.match(r"[a-z]+[A-Z]", name) for name in fields)
    radians = radians or _RADIANS.search(line) is not None
    given: dict[str, Any] = {}
    for name, value in fields.items():
        plain = re.sub(r"[^a-z0-9]", "", name.lower())
        column = _NAMES.get(plain, plain)
        given[column] = _value(column, value.get("value", value.get("name")) if isinstance(value, Mapping) else value)
    for column in _ANGLES:
        if radians and given.get(column) is not None:
            given[column] = math.degrees(given[column])
    if given.get("speed") is not None and "mmsi" in given:
        given["speed"] /= KNOT_M_PER_S
    return instant(iso_time(str(said.get("timestamp", "")))), pgn, given


def iso_time(text: str) -> str:
    """The time of a line as ISO 8601: canboat writes 2011-11-24-22:42:04.388, too."""
    return re.sub(r"(\d\d)-(\d\d:)", r"\1T\2", text)


def _value(column: str, value: Any) -> Any:
    """The value of a field: a number, or one of the texts; None where its text stands for no number that is known."""
    if column in _TEXTS:
        return "" if value is None else str(value).upper()
    if value is None or not isinstance(value, str):
        return value
    if column == "date":
        return datetime.strptime(value.replace(".", "-"), "%Y-%m-%d").replace(tzinfo=UTC).timestamp()
    if column == "time":
        return time_of_day(value.replace(":", ""))
    for text, number in _LOOKUPS.get(column, ()):
        if value.lower().startswith(text):
            return number
    try:
        return float(value) if "." in value else int(value)
    except ValueError:
        return None

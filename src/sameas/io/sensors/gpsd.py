"""JSON of gpsd and of AIS-catcher: the messages of AIS receivers, and own ship's position, one object in a line.

Objects of class AIS have the fields of a message, in its units or (``scaled`` false) as it is sent; where they carry
the sentences themselves (``nmea`` of AIS-catcher), these are read. TPV and ATT of gpsd give own ship's position,
velocity and heading. Everything is translated to sentences (:mod:`sameas.io.sensors.sentences`). Source: gpsd 3.25,
``gpsd_json(5)``; AIS-catcher 0.60, whose objects have the same fields and a time of receipt.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any

from sameas.io.sensors import sentences
from sameas.io.sensors.format import SensorFormat, instant, of_json
from sameas.io.sensors.sentences import AisWriter

#: What gpsd sends only to a client that asks for it (``gpsd_json(5)``, "?WATCH").
WATCH = '?WATCH={"enable":true,"json":true}'
#: The first object of a connection, and those with data.
_CLASSES = re.compile(rb'"class"\s*:\s*"(AIS|TPV|VERSION|DEVICES)"')
_POSITIONS, _STATICS = (1, 2, 3, 9, 18, 19, 27), (5, 24)
#: Fields of messages, by their name in pyais.
_OF_POSITIONS = ("mmsi", "lat", "lon", "speed", "course", "heading", "second", "accuracy", "status")
_OF_STATICS = ("mmsi", "imo", "callsign", "shipname", "to_bow", "to_stern", "to_port", "to_starboard")
#: Steps of a number as it is sent: degrees, knots (ITU-R M.1371); those of message 27 are coarser.
_STEPS = {"lat": 1 / 600_000, "lon": 1 / 600_000, "speed": 0.1, "course": 0.1}
_STEPS_OF_27 = {"lat": 1 / 600, "lon": 1 / 600, "speed": 1.0, "course": 1.0}


@dataclass
class JsonMessages:
    """Translates the lines of a receiver to sentences."""

    write_ais: AisWriter = field(default_factory=AisWriter)

    def __call__(self, line: str) -> Sequence[str]:
        """The sentences of an object; none of one that says nothing of interest.

        Raises ValueError: it is no object, or damaged.
        """
        said = of_json(line)
        if not isinstance(said, Mapping):
            raise ValueError("no JSON object")
        if said.get("class") == "TPV":
            return _own_ship(said)
        if said.get("class") == "ATT" and said.get("heading") is not None:
            return [sentences.heading(float(said["heading"]))]
        if said.get("class") != "AIS":
            return ()
        time_s = _received_s(said)
        texts = said["nmea"] if isinstance(said.get("nmea"), list) else self._ais(said)
        return [sentences.at_time(str(text), time_s) for text in texts]

    def _ais(self, said: Mapping[str, Any]) -> list[str]:
        """The sentences of a message; none of one that is not read."""
        kind = int(said["type"])
        if kind in _POSITIONS:
            steps = {} if said.get("scaled", True) else _STEPS_OF_27 if kind == 27 else _STEPS
            fields = {name: _scaled(said.get(name), steps.get(name)) for name in _OF_POSITIONS}
            # The names and sizes in 19 come in 5 and 24 of other ships; its position is like that of 18.
            return self.write_ais(fields | {"type": 18 if kind == 19 else 1 if kind == 27 else kind})
        if kind not in _STATICS:
            return []
        fields = {name: said.get(name) for name in _OF_STATICS} | {
            "ship_type": said.get("shiptype", said.get("ship_type"))
        }
        if kind == 5:
            return self.write_ais(fields | {"type": 5})
        parts = [part for part, name in enumerate(("shipname", "callsign")) if said.get(name)]
        return [text for part in parts for text in self.write_ais(fields | {"type": 24, "partno": part})]


def _received_s(said: Mapping[str, Any]) -> float | None:
    """The time of receipt of AIS-catcher, which has it by several names; None of gpsd."""
    for name in ("rxuxtime", "toa"):
        if said.get(name) is not None:
            return float(said[name])
    written = said.get("rxtime")
    return None if written is None else datetime.strptime(str(written), "%Y%m%d%H%M%S").replace(tzinfo=UTC).timestamp()


def _scaled(value: Any, step: float | None) -> Any:
    return value if value is None or step is None else float(value) * step


def _own_ship(said: Mapping[str, Any]) -> list[str]:
    """The sentences of a position, velocity and time of own ship."""
    time_s = instant(str(said.get("time", "")))
    if int(said.get("mode", 0)) < 2:
        return []
    place = sentences.position(*(None if said.get(name) is None else float(said[name]) for name in ("lat", "lon")))
    motion = (None if said.get(name) is None else float(said[name]) for name in ("track", "speed"))
    return [*([] if time_s is None else [sentences.clock(time_s)]), *place, sentences.velocity(*motion)]


def looks_like(head: bytes) -> bool:
    """Whether the first line with bytes is an object of gpsd or AIS-catcher."""
    first = head.lstrip().partition(b"\n")[0]
    return first[:1] == b"{" and _CLASSES.search(first) is not None


FORMAT = SensorFormat(
    "gpsd",
    "JSON of gpsd and AIS-catcher: AIS, and own ship's position",
    lambda file: sentences.read_translated(file, JsonMessages()),
    lambda file: looks_like(file.head),
)

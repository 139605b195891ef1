"""NMEA 2000: the frames of a ship's CAN bus, of AIS, radar targets and own ship.

Logs of candump (also ``-L``), of canboat and Actisense (``time,priority,PGN,source,destination,length,byte,…``), the
RAW protocol of Yacht Devices gateways, the sentences ``$PCDIN`` (SeaSmart, gateways with WiFi) and ``!PDGY`` (iKonvert)
that wrap a message, and the JSON of canboat (:mod:`sameas.io.sensors.n2k_json`) are read, one frame or message in a
line, with their times of receipt or else those of the bus. A message longer than 8 bytes comes in
several frames (fast packet), which are joined by source and number. Every message (PGN) that is used is translated to a
sentence of NMEA 0183 (:mod:`sameas.io.sensors.sentences`). Layouts: NMEA 2000 as analysed by the canboat project.
"""

from __future__ import annotations

import math
import re
from base64 import b64decode
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from sameas.io.sensors import sentences
from sameas.io.sensors.format import DAY_S, KNOT_M_PER_S, LOGGED, SensorFormat, instant
from sameas.io.sensors.n2k_json import described, iso_time
from sameas.io.sensors.sentences import AisWriter

#: First bit, number of bits, unit of a step, whether the number is signed.
Layout = tuple[int, int, float, bool]
_ANGLE = math.degrees(1e-4)
_KNOTS = 0.01 / KNOT_M_PER_S


def _of_position(more: dict[str, Layout]) -> dict[str, Layout]:
    """The fields of position reports of AIS, which begin alike."""
    return {
        "type": (0, 6, 1, False), "mmsi": (8, 32, 1, False), "lon": (40, 32, 1e-7, True), "lat": (72, 32, 1e-7, True),
        "accuracy": (104, 1, 1, False), "second": (106, 6, 1, False), "course": (112, 16, _ANGLE, False),
        "speed": (128, 16, _KNOTS, False), "transceiver": (163, 5, 1, False), **more,
    }  # fmt: skip


def _of_size(first: int) -> dict[str, Layout]:
    """The fields of the size of a ship, in metres, from this bit."""
    names = ("length", "width", "from_starboard", "from_bow")
    return {name: (first + 16 * k, 16, 0.1, False) for k, name in enumerate(names)}


_HEADING: dict[str, Layout] = {"heading": (168, 16, _ANGLE, False)}
_STATIC: dict[str, Layout] = {"mmsi": (8, 32, 1, False)}
#: The fields of numbers in the messages that are used, by PGN.
FIELDS: Mapping[int, Mapping[str, Layout]] = {
    126992: {"date": (16, 16, DAY_S, False), "time": (32, 32, 1e-4, False)},
    127250: {"heading": (8, 16, _ANGLE, False), "deviation": (24, 16, _ANGLE, True),
             "variation": (40, 16, _ANGLE, True), "reference": (56, 2, 1, False)},
    127258: {"variation": (32, 16, _ANGLE, True)},
    128520: {"number": (8, 16, 1, False), "status": (24, 2, 1, False), "reference": (28, 2, 1, False),
             "bearing": (32, 16, _ANGLE, False), "range_m": (48, 32, 0.01, True), "course": (80, 16, _ANGLE, False),
             "speed": (96, 16, 0.01, False)},
    129025: {"lat": (0, 32, 1e-7, True), "lon": (32, 32, 1e-7, True)},
    129026: {"reference": (8, 2, 1, False), "course": (16, 16, _ANGLE, False), "speed": (32, 16, 0.01, False)},
    129029: {"date": (8, 16, DAY_S, False), "time": (24, 32, 1e-4, False), "lat": (56, 64, 1e-16, True),
             "lon": (120, 64, 1e-16, True), "method": (252, 4, 1, False)},
    129038: _of_position(_HEADING | {"status": (200, 4, 1, False)}),
    129039: _of_position(_HEADING),
    129040: _of_position(_HEADING | {"transceiver": (422, 5, 1, False)}),
    129794: _STATIC | {"imo": (40, 32, 1, False), "ship_type": (288, 8, 1, False), "transceiver": (592, 5, 1, False),
                       **_of_size(296)},
    129798: _of_position({"speed": (128, 16, 0.1 / KNOT_M_PER_S, False)}),
    129809: _STATIC | {"transceiver": (200, 5, 1, False)},
    129810: _STATIC | {"ship_type": (40, 8, 1, False), "transceiver": (264, 5, 1, False), **_of_size(160)},
}  # fmt: skip
#: The texts in them: first byte and number of bytes.
_TEXTS: Mapping[int, Mapping[str, tuple[int, int]]] = {
    129794: {"callsign": (9, 7), "shipname": (16, 20)}, 129809: {"shipname": (5, 20)}, 129810: {"callsign": (13, 7)},
}  # fmt: skip
#: Messages in several frames, and the least number of bytes with which a message says what is used.
_LEAST: Mapping[int, int] = {
    128520: 14, 129029: 32, 129038: 26, 129039: 23, 129040: 23, 129794: 36, 129798: 21, 129809: 25, 129810: 28,
}  # fmt: skip
#: AisTransceiver information of messages that own ship's transponder sends, or would send.
_OWN = (2, 3, 4)
#: Messages that are kept until their other frames come.
_MOST_WAITING = 1000
_STATUS_OF_TARGET = {0: "L", 1: "Q", 2: "T", 3: "L"}

_CANDUMP = re.compile(
    r"\s*(?:\((?P<time>[\d. :-]+)\)\s*)?\w+\s+(?P<id>[0-9A-F]{8})(?:#|\s+\[\d\]\s+)"
    r"(?P<data>(?:[0-9A-F]{2} ?){0,8})\s*(?:[RT]\s*)?(?:'.*)?$",
    re.IGNORECASE,
)
_CANBOAT = re.compile(
    r"(?P<time>[\d-]+[T-][\d:.]+Z?),(?P<prio>[0-7]),(?P<pgn>\d{5,6}),(?P<src>\d+),\d+,(?P<n>\d+),(?P<data>[0-9A-F,]+)\s*$",
    re.IGNORECASE,
)
_YACHT_DEVICES = re.compile(
    r"\d\d:\d\d:\d\d\.\d+ [RT] (?P<id>[0-9A-F]{8})(?P<data>( [0-9A-F]{2}){0,8})\s*$", re.IGNORECASE
)
#: $PCDIN,PGN,time of the gateway,source,data*checksum, all hexadecimal.
_PCDIN = re.compile(
    r"\$PCDIN,(?P<pgn>[0-9A-F]{5,6}),[0-9A-F]*,(?P<src>[0-9A-F]{1,2}),(?P<data>(?:[0-9A-F]{2})+)(?:\*[0-9A-F]{2})?\s*$",
    re.IGNORECASE,
)
#: !PDGY,PGN,priority,source,destination,time of the gateway,data in base64.
_PDGY = re.compile(r"!PDGY,(?P<pgn>\d{5,6}),[0-7],(?P<src>\d+),\d+,[\d.]*,(?P<data>[A-Za-z0-9+/]+=*)\s*$")


@dataclass
class Bus:
    """Translates the lines of a log to sentences.

    waiting : of incomplete messages the number of the next frame, the length, and the bytes so far; by PGN, source and
        number of the message.
    """

    waiting: dict[tuple[int, int, int], tuple[int, int, bytes]] = field(default_factory=dict)
    write_ais: AisWriter = field(default_factory=AisWriter)

    def __call__(self, line: str) -> Sequence[str]:
        """The sentences of a line; none of a message that is not used, or not complete yet.

        Raises ValueError: it is no frame.
        """
        if line.lstrip()[:1] == "{":
            time_s, pgn, said = described(line)
            given: Given = {name: said.get(name) for name in (*FIELDS.get(pgn, ()), *_TEXTS.get(pgn, ()))}
            return self._sentences(time_s, pgn, given)
        time_s, pgn, source, data = _frame(line)
        if pgn not in FIELDS:
            return ()
        if pgn in _LEAST and len(data) <= 8:
            joined = self._joined(pgn, source, data)
            if joined is None:
                return ()
            data = joined
        if len(data) < _LEAST.get(pgn, 0):
            raise ValueError(f"message {pgn} of {len(data)} bytes is cut off")
        given = {name: _number(data, *layout) for name, layout in FIELDS[pgn].items()}
        given = {**given, **{name: _text(data, *place) for name, place in _TEXTS.get(pgn, {}).items()}}
        return self._sentences(time_s, pgn, given)

    def _sentences(self, time_s: float | None, pgn: int, given: Given) -> list[str]:
        texts = _SENTENCES[pgn](given, self.write_ais) if pgn in FIELDS else []
        return [sentences.at_time(text, time_s) for text in texts]

    def _joined(self, pgn: int, source: int, frame: bytes) -> bytes | None:
        """The message that this frame completes; None if frames are missing."""
        if len(frame) < 2:
            raise ValueError(f"frame of message {pgn} is cut off")
        key, number = (pgn, source, frame[0] >> 5), frame[0] & 31
        if number == 0:
            length, part, before = frame[1], frame[2:], b""
        else:
            waited = self.waiting.pop(key, None)
            if waited is None or waited[0] != number:
                return None  # the log begins within it, or a frame was lost
            length, part, before = waited[1], frame[1:], waited[2]
        data = before + part
        if len(data) >= length:
            return data[:length]
        if len(self.waiting) > _MOST_WAITING:
            self.waiting.clear()
        self.waiting[key] = (number + 1, length, data)
        return None


def _frame(line: str) -> tuple[float | None, int, int, bytes]:
    """Time of receipt, PGN, source and bytes of a line."""
    line = LOGGED.sub("", line)
    if found := _CANBOAT.match(line):
        data = bytes(int(byte, 16) for byte in found["data"].split(",") if byte)[: int(found["n"])]
        time_s = instant(iso_time(found["time"]))
        return time_s, int(found["pgn"]), int(found["src"]), data
    if found := _PCDIN.match(line):
        return None, int(found["pgn"], 16), int(found["src"], 16), bytes.fromhex(found["data"])
    if found := _PDGY.match(line):
        text = found["data"]
        return None, int(found["pgn"]), int(found["src"]), b64decode(text + "=" * (-len(text) % 4))
    found = _CANDUMP.match(line) or _YACHT_DEVICES.match(line)
    if not found:
        raise ValueError("no frame of NMEA 2000")
    number, stamp = int(found["id"], 16), found.groupdict().get("time")
    form, specific = number >> 16 & 0xFF, number >> 8 & 0xFF
    pgn = (number >> 24 & 3) << 16 | form << 8 | (specific if form >= 240 else 0)
    # A small number is the time since the first frame.
    time_s = None if stamp is None else instant(stamp)
    time_s = None if time_s is None or time_s < 1e8 else time_s
    return time_s, pgn, number & 0xFF, bytes.fromhex(found["data"])


def _number(data: bytes, first: int, bits: int, step: float, signed: bool) -> float | int | None:
    """The number in these bits; None where it is not available: all bits, but the sign, are set."""
    if 8 * len(data) < first + bits:
        return None
    value = int.from_bytes(data, "little") >> first & (1 << bits) - 1
    most = (1 << bits - signed) - 1
    if bits > 8 and value == most:
        return None
    if signed and value > most:
        value -= 1 << bits
    return value if step == 1 else value * step


def _text(data: bytes, first: int, length: int) -> str:
    """A text of fixed length; it ends with the first byte that is not of AIS."""
    return (
        re.split(r"[^ -?A-Z\[-_]", data[first : first + length].decode("latin-1").upper())[0].partition("@")[0].strip()
    )


Given = Mapping[str, Any]


def _clock(given: Given, _: AisWriter) -> list[str]:
    return [] if given["date"] is None or given["time"] is None else [sentences.clock(given["date"] + given["time"])]


def _position(given: Given, write: AisWriter) -> list[str]:
    if given.get("method") == 0:
        return []  # no fix
    return (_clock(given, write) if "date" in given else []) + sentences.position(given["lat"], given["lon"])


def _heading(given: Given, _: AisWriter) -> list[str]:
    if given["reference"] == 0:
        return [sentences.heading(given["heading"])]
    magnetic = given["heading"] if given["reference"] == 1 else None
    return [sentences.compass(magnetic, given["deviation"], given["variation"])]


def _target(given: Given, _: AisWriter) -> list[str]:
    status = _STATUS_OF_TARGET[given["status"]]
    if given["number"] is None or given["bearing"] is None or given["range_m"] is None or given["reference"] != 0:
        return []
    motion = given["speed"], given["course"]
    return [sentences.target(given["number"], given["range_m"], given["bearing"], *motion, status=status)]


def _ais(kind: int | None, **more: Any) -> Callable[[Given, AisWriter], list[str]]:
    """A translator to AIS messages of this type; None: the type that the message has."""

    def write(given: Given, write_ais: AisWriter) -> list[str]:
        if given["mmsi"] is None:
            return []
        fields = {name: value for name, value in given.items() if name not in _OF_SIZE and name != "transceiver"}
        if "length" in given:
            fields |= _sides(given)
        fields["type"] = kind or given["type"] or 1
        return write_ais(fields | more, own=given["transceiver"] in _OWN)

    return write


_OF_SIZE = ("length", "width", "from_starboard", "from_bow")


def _sides(given: Given) -> dict[str, int]:
    """The distances from the antenna to the sides of the hull, as AIS has them."""
    length, width, starboard, bow = (round(given[name] or 0) for name in _OF_SIZE)
    bow, starboard = min(bow, length), min(starboard, width)
    sizes = {"to_bow": bow, "to_stern": length - bow, "to_port": width - starboard, "to_starboard": starboard}
    return {name: min(size, 511 if name in ("to_bow", "to_stern") else 63) for name, size in sizes.items()}


_SENTENCES: Mapping[int, Callable[[Given, AisWriter], list[str]]] = {
    126992: _clock,
    127250: _heading,
    127258: lambda given, _: [sentences.compass(None, None, given["variation"])],
    128520: _target,
    129025: _position,
    129026: lambda given, _: [sentences.velocity(given["course"] if given["reference"] == 0 else None, given["speed"])],
    129029: _position,
    129038: _ais(None),
    129039: _ais(18),
    129040: _ais(18),
    129794: _ais(5),
    129798: _ais(9),
    129809: _ais(24, partno=0),
    129810: _ais(24, partno=1),
}


def _is_frame(line: str) -> bool:
    line = LOGGED.sub("", line)
    if line.lstrip()[:1] == "{":
        return re.search(r'"pgn"\s*:\s*\d', line) is not None and '"updates"' not in line
    return any(form.match(line) is not None for form in (_CANDUMP, _CANBOAT, _YACHT_DEVICES, _PCDIN, _PDGY))


def looks_like(lines: Sequence[str]) -> bool:
    """Whether the first of these lines that are no comments are frames."""
    said = [line for line in lines if line.strip() and not line.startswith("#")][:5]
    return bool(said) and sum(map(_is_frame, said)) > len(said) / 2


FORMAT = SensorFormat(
    "n2k",
    "NMEA 2000: frames of candump, canboat, Actisense, Yacht Devices, $PCDIN or !PDGY, JSON of canboat",
    lambda file: sentences.read_translated(file, Bus()),
    lambda file: looks_like(file.head_lines),
)

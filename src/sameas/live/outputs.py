"""Outputs: situations encoded for other programs, and the sinks to which they are sent.

:data:`ENCODERS`: ``jsonl`` one line per object, ``nmea`` TTM (with own ship) and TLL sentences, ``cot`` Cursor on
Target events, ``signalk`` one delta per object, ``asterix`` blocks of category 062. Only confirmed and coasting
objects are sent; ``jsonl`` has the tentative ones too, marked by ``stage``.
"""

from __future__ import annotations

import ipaddress
import json
import math
import socket
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import partial
from typing import Any
from urllib.parse import urlsplit
from xml.sax.saxutils import quoteattr

import numpy as np

from sameas.errors import InputError, blanked, reading
from sameas.io.sensors.asterix_tracks import SentTracks, track_blocks
from sameas.io.sensors.format import KNOT_M_PER_S
from sameas.io.sensors.nmea import checksum
from sameas.io.sensors.signalk import FUSED
from sameas.live.situation import Situation
from sameas.tracks.coordinates import MILE_M

#: Seconds after which a Cursor on Target event is stale.
STALE_S = 15.0
#: Half the interval of 90 % of a normal distribution, in σ.
_LE_90 = 1.6449
#: Largest datagram in bytes, below the MTU of Ethernet, so that it is not fragmented.
_DATAGRAM = 1400
#: Most characters of a sentence between the $ and the star.
_SENTENCE = 82 - len("$*hh\r\n")


def geojson(situation: Situation) -> dict[str, Any]:
    """A FeatureCollection (RFC 7946) of the objects as points; empty where the plane has no geographic origin.

    Tentative objects are left out: a chart would draw them as ships.
    """
    features = [
        {
            "type": "Feature", "id": one["object"],
            "geometry": {"type": "Point", "coordinates": [one["lon_deg"], one["lat_deg"]]},
            "properties": {
                "time": _iso(situation.time_s), **{k: v for k, v in one.items() if k not in ("lat_deg", "lon_deg")},
            },
        }
        for one in situation.listed() if one["stage"] != "tentative" and one.get("lat_deg") is not None
    ]  # fmt: skip
    return {"type": "FeatureCollection", "features": features}


def jsonl(situation: Situation) -> Iterator[bytes]:
    """One JSON line per object."""
    for one in situation.listed():
        yield json.dumps({"time_s": situation.time_s, **one}, ensure_ascii=False, allow_nan=False).encode() + b"\n"


#: Targets that TTM and TLL can number: two digits (IEC 61162-1).
_NUMBERS = 100
#: An object without a number gets that of another one if it is nearer to own ship by this factor.
_NEARER = 0.8


@dataclass
class TargetNumbers:
    """The target numbers 00 to 99 of objects; an object keeps its number, and no two have the same.

    by_object : the numbers in use. unnumbered : confirmed objects that have none, since all are in use: with own ship
    the farthest. A number that is free again is the last to be given to another object.
    """

    by_object: dict[int, int] = field(default_factory=dict)
    unnumbered: int = 0
    _free: list[int] = field(default_factory=lambda: list(range(_NUMBERS)))

    def update(self, situation: Situation) -> list[int]:
        """Numbers the confirmed objects of a situation; those whose objects ended or lost theirs to nearer ones."""
        own, confirmed = situation.own_ship, _confirmed(situation)
        rank: dict[int, float] = {}
        for one in confirmed:
            placed = own is not None and one["x_m"] is not None
            rank[one["object"]] = math.hypot(one["x_m"] - own.x_m, one["y_m"] - own.y_m) if placed and own else math.inf
        order = sorted(rank, key=lambda n: (rank[n] * (_NEARER if n in self.by_object else 1.0),
                                            n not in self.by_object, n))  # fmt: skip
        numbered, self.unnumbered = set(order[:_NUMBERS]), max(len(order) - _NUMBERS, 0)
        lost = [self.by_object.pop(n) for n in list(self.by_object) if n not in numbered]
        self._free += lost
        for n in sorted(numbered - set(self.by_object)):
            number = n % _NUMBERS if n % _NUMBERS in self._free and n % _NUMBERS not in lost else self._free[0]
            self._free.remove(number)
            self.by_object[n] = number
        return [number for number in lost if number in self._free]


def nmea(situation: Situation, numbers: TargetNumbers | None = None) -> Iterator[bytes]:
    """TTM of every object where own ship is known, and TLL where latitudes are known.

    The name is the object's, else its MMSI, else its label. A number whose object has ended is sent once with status L.
    numbers : of the targets before; updated.
    """
    own, clock = situation.own_ship, datetime.fromtimestamp(situation.time_s, UTC).strftime("%H%M%S.%f")[:9]
    numbers = TargetNumbers() if numbers is None else numbers
    plane = situation.plane
    north_deg = 0.0 if own is None or plane is None else plane.north_deg((own.x_m, own.y_m))
    for lost in numbers.update(situation):
        yield sentence(f"RATTM,{lost:02d},,,T,,,T,,,N,,L,,{clock},A")
        yield sentence(f"RATLL,{lost:02d},,,,,,{clock},L,")
    for one in _confirmed(situation):
        if one["object"] not in numbers.by_object:
            continue
        number = f"{numbers.by_object[one['object']]:02d}"
        name = _plain(one.get("name") or one.get("mmsi") or one.get("label") or "")
        if own is not None and one["x_m"] is not None:
            east, north = one["x_m"] - own.x_m, one["y_m"] - own.y_m
            bearing = math.degrees(math.atan2(east, north)) - north_deg
            range_nm = math.hypot(east, north) / MILE_M
            cpa, tcpa = situation.cpa.get(one["object"], (math.nan, math.nan))
            speed, course = one["speed_m_per_s"], one["course_deg"]
            fields = [
                "RATTM", number, f"{range_nm:.3f}", _turn(bearing), "T",
                "" if speed is None else f"{speed / KNOT_M_PER_S:.1f}", "" if course is None else _turn(course), "T",
                "" if math.isnan(cpa) else f"{cpa / MILE_M:.3f}",
                "" if math.isnan(tcpa) else f"{tcpa / 60.0:.2f}", "N",
                name, "T", "", clock, "A",
            ]  # fmt: skip
            # A sentence has 82 characters at most (NMEA 0183): the name is cut.
            fields[11] = name[: max(len(name) + _SENTENCE - len(",".join(fields)), 0)]
            yield sentence(",".join(fields))
        if one.get("lat_deg") is not None:
            lat, lon = _degrees(one["lat_deg"], 2, "NS"), _degrees(one["lon_deg"], 3, "EW")
            yield sentence(f"RATLL,{number},{lat},{lon},{name},{clock},T,")


def sentence(body: str) -> bytes:
    """An NMEA 0183 sentence with its checksum.

    >>> sentence("HEHDT,90.0,T")
    b'$HEHDT,90.0,T*16\\r\\n'
    """
    return f"${body}*{checksum(body):02X}\r\n".encode("ascii")


def cot(situation: Situation) -> Iterator[bytes]:
    """One event per object: type ``a-u-S`` at sea, ``a-u-A`` in the air.

    ``hae`` is the height above the ellipsoid where a height is known; a pressure height is converted, or taken as it is
    with the error of an unknown atmosphere. ``ce`` and ``le`` are errors of 90 % probability, as TAK reads them:
    the radius of a circle, and half the interval of the height. 9999999 is unknown.
    """
    start, stale = _iso(situation.time_s), _iso(situation.time_s + STALE_S)
    for one in _confirmed(situation):
        if one.get("lat_deg") is None:
            continue
        kind = "a-u-A" if one["object"] in situation.flying else "a-u-S"
        variance = max(one["var_x_m2"] or 0.0, one["var_y_m2"] or 0.0)
        radius = math.sqrt(variance) * math.sqrt(-2.0 * math.log(0.1))
        hae, sigma = one.get("hae_m"), one.get("sigma_hae_m")
        height = 'hae="9999999.0"' if hae is None else f'hae="{hae:.1f}"'
        error = 'le="9999999.0"' if hae is None or sigma is None else f'le="{_LE_90 * sigma:.1f}"'
        track = ""
        if one["speed_m_per_s"] is not None:
            track = f'<track course="{_turn(one["course_deg"])}" speed="{one["speed_m_per_s"]:.2f}"/>'
        callsign = quoteattr(blanked(one.get("label") or f"object {one['object']}"))
        yield (
            f'<?xml version="1.0" encoding="UTF-8"?><event version="2.0" uid="sameas.{one["object"]}" type="{kind}" '
            f'how="m-f" time="{start}" start="{start}" stale="{stale}"><point lat="{one["lat_deg"]:.7f}" '
            f'lon="{one["lon_deg"]:.7f}" {height} ce="{radius:.1f}" {error}/>'
            f"<detail><contact callsign={callsign}/>{track}</detail></event>"
        ).encode()


def signalk(situation: Situation) -> Iterator[bytes]:
    """One delta per object, for the vessel with its MMSI, else for ``urn:mrn:sameas:object:NUMBER``."""
    for one in _confirmed(situation):
        if one.get("lat_deg") is None:
            continue
        values: list[dict[str, Any]] = [
            {"path": "navigation.position", "value": {"latitude": one["lat_deg"], "longitude": one["lon_deg"]}}
        ]
        if one["speed_m_per_s"] is not None:
            values += [
                {"path": "navigation.speedOverGround", "value": one["speed_m_per_s"]},
                {"path": "navigation.courseOverGroundTrue", "value": round(math.radians(one["course_deg"]), 5)},
            ]
        if one.get("name"):
            values.append({"path": "", "value": {"name": one["name"]}})
        mmsi = str(one.get("mmsi", ""))
        who = f"mrn:imo:mmsi:{mmsi}" if mmsi.isdigit() else f"mrn:sameas:object:{one['object']}"
        update = {"$source": FUSED, "timestamp": _iso(situation.time_s), "values": values}
        delta = {"context": f"vessels.urn:{who}", "updates": [update]}
        yield json.dumps(delta, ensure_ascii=False, allow_nan=False).encode() + b"\n"


def asterix(situation: Situation, tracks: SentTracks | None = None) -> Iterator[bytes]:
    """Blocks of ASTERIX tracks (:mod:`sameas.io.sensors.asterix_tracks`). tracks : that were sent before; updated."""
    return track_blocks(situation.time_s, situation.listed(), tracks or SentTracks(), situation.heights)


ENCODERS: Mapping[str, Callable[[Situation], Iterator[bytes]]] = {
    "jsonl": jsonl, "nmea": nmea, "cot": cot, "signalk": signalk, "asterix": asterix,
}  # fmt: skip


def _confirmed(situation: Situation) -> list[dict[str, Any]]:
    return [one for one in situation.listed() if one["stage"] in ("confirmed", "coasting")]


def _iso(time_s: float) -> str:
    return datetime.fromtimestamp(time_s, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def _turn(degrees: float) -> str:
    """An angle from 0.0 to 359.9: programs refuse 360.0."""
    return f"{round(degrees, 1) % 360.0:.1f}"


def _plain(text: str) -> str:
    """The characters of a text that an NMEA field may contain, 20 at most: no comma, ``*`` or line end."""
    return "".join(letter for letter in text if letter.isascii() and (letter.isalnum() or letter in " -_./"))[:20]


def _degrees(value: float, digits: int, sides: str) -> str:
    degrees, minutes = divmod(round(abs(value) * 600_000.0) / 10_000.0, 60.0)
    return f"{int(degrees):0{digits}d}{minutes:07.4f},{sides[value < 0.0]}"


@dataclass
class Sink:
    """Where situations are sent: ``udp://HOST:PORT`` or ``stdout:``. failed : datagrams that could not be sent."""

    url: str
    format: str
    failed: int = 0

    def __post_init__(self) -> None:
        parts = urlsplit(self.url)
        if parts.scheme not in ("udp", "stdout") or (parts.scheme == "udp" and not parts.port):
            raise InputError(f"output {self.url!r}: cannot be sent to", "give udp://HOST:PORT or stdout:")
        if self.format not in ENCODERS:
            raise InputError(f"output {self.url!r}: format is {self.format!r}", f"give one of {', '.join(ENCODERS)}")
        self.numbers = TargetNumbers()
        self._encode = ENCODERS[self.format]
        if self.format == "nmea":
            self._encode = partial(nmea, numbers=self.numbers)
        elif self.format == "asterix":
            self._encode = partial(asterix, tracks=SentTracks())
        self._socket: socket.socket | None = None
        if parts.scheme == "udp":
            host, port = parts.hostname or "127.0.0.1", int(parts.port or 0)
            try:
                # Once: to look a name up takes seconds where the network is down.
                self._address = (socket.gethostbyname(host), port)
            except OSError as error:
                reason = error.strerror or str(error)
                raise InputError(f"output {self.url!r}: {host} is not found ({reason})", "give its address") from None
            self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            self._socket.setblocking(False)
            try:
                group = ipaddress.ip_address(self._address[0])
            except ValueError:
                group = None
            if group is not None and group.is_multicast:
                self._socket.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 1)

    def send(self, situation: Situation) -> None:
        """Encodes and sends a situation."""
        if self._socket is None:
            for part in self._encode(situation):
                sys.stdout.buffer.write(part)
            sys.stdout.buffer.flush()
            return
        for datagram in _datagrams(self._encode(situation), joined=self.format in ("nmea", "jsonl")):
            try:
                self._socket.sendto(datagram, self._address)
            except OSError:
                self.failed += 1

    def close(self) -> None:
        if self._socket is not None:
            self._socket.close()


def sinks_of(outputs: Sequence[Mapping[str, str]]) -> list[Sink]:
    """The sinks of the setting ``outputs``."""
    sinks: list[Sink] = []
    for one in outputs:
        if not isinstance(one, Mapping) or set(one) != {"url", "format"}:
            raise InputError(f'watch.outputs: {one!r}; give {{ url = "udp://HOST:PORT", format = "nmea" }}')
        with reading(f"watch.outputs: {one!r}", "cannot be sent to"):
            sinks.append(Sink(one["url"], one["format"]))
    return sinks


def _datagrams(parts: Iterator[bytes], *, joined: bool) -> Iterator[bytes]:
    """Parts packed into datagrams, several in one where ``joined``; no part is split."""
    waiting = b""
    for part in parts:
        if not joined:
            yield part
        elif waiting and len(waiting) + len(part) > _DATAGRAM:
            yield waiting
            waiting = part
        else:
            waiting += part
    if waiting:
        yield waiting


def metrics(health: Mapping[str, Any], durations_s: Sequence[float]) -> str:
    """Prometheus text (format 0.0.4) of a keeper's health; the quantiles are of the durations of its last ticks."""
    sources, wires, outputs = health["sources"], health["wires"], health.get("outputs", {})
    families = [
        _family("up", "gauge", "Whether the picture is advancing.", [({}, int(health["ok"]))]),
        _family("ticks_total", "counter", "Instants of the picture.", [({}, health["tick"])]),
        _family("faults_total", "counter", "Instants that failed.", [({}, health["faults"])]),
        _family("objects", "gauge", "Objects in the picture.", [({}, health["objects"])]),
        _family("alarms", "gauge", "Alarms whose condition holds.", [({}, health["alarms"])]),
    ]
    if durations_s:
        quantiles = [({"quantile": str(q)}, round(float(np.quantile(durations_s, q)), 6)) for q in (0.5, 0.9, 0.99)]
        families.append(_family("tick_seconds", "summary", "Time to decide an instant.", quantiles))
        families.append(
            [f"sameas_tick_seconds_sum {health['timed_s']:.6f}", f"sameas_tick_seconds_count {health['timed']}"]
        )
    for name, words in _OF_SOURCES.items():
        values = [({"source": source}, one[name]) for source, one in sources.items()]
        families.append(_family(f"source_{name}_total", "counter", words, values))
    with_biases = {source: one["biases"] for source, one in sources.items() if one.get("biases")}
    for key, suffix, words in (("value", "", "Estimated bias"), ("sigma", "_sigma", "Standard error of a bias")):
        values = [
            ({"source": source, "bias": bias}, format(numbers[key], "g"))
            for source, found in with_biases.items()
            for bias, numbers in found["values"].items()
        ]
        families.append(_family(f"source_bias{suffix}", "gauge", f"{words}, in the unit of its name.", values))
    established = [({"source": source}, int(found["established"])) for source, found in with_biases.items()]
    families.append(_family("source_biases_established", "gauge", "Whether biases are subtracted.", established))
    for name, words in _OF_WIRES.items():
        values = [({"wire": url}, numbers[name]) for url, numbers in wires.items()]
        families.append(_family(f"wire_{name}_total", "counter", words, values))
    for name, kind, words in (
        ("failed_total", "counter", "Datagrams that could not be sent."),
        ("unnumbered", "gauge", "Objects without a target number."),
    ):
        values = [({"output": url}, numbers[name.partition("_")[0]]) for url, numbers in outputs.items()]
        families.append(_family(f"output_{name}", kind, words, values))
    return "\n".join(line for family in families for line in family) + "\n"


#: Counters of sources and of wires, with their help.
_OF_SOURCES = {
    "reports": "Reports that were taken in.",
    "unplaced": "Reports without a position, of their own or of their sensor.",
    "late": "Reports that came later than the lag.",
    "repeated": "Reports that came again.", "jumps": "Reports that no object can move to.",
    "refused": "Reports with impossible values or times.",
}  # fmt: skip
_OF_WIRES = {
    "bytes": "Bytes received.", "dropped": "Pieces of data dropped from a full queue.",
    "damaged": "Lines or blocks damaged.", "connections": "Connections made.",
}  # fmt: skip


def _family(name: str, kind: str, words: str, samples: Sequence[tuple[Mapping[str, str], Any]]) -> list[str]:
    """The lines of a metric: its help, its type, and its samples, labels with value."""
    lines = [f"# HELP sameas_{name} {words}", f"# TYPE sameas_{name} {kind}"]
    for labels, value in samples:
        inside = ",".join(f"{key}={_label(text)}" for key, text in labels.items())
        lines.append(f"sameas_{name}{f'{{{inside}}}' if inside else ''} {value}")
    return lines


def _label(text: str) -> str:
    escaped = text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")
    return f'"{escaped}"'

"""Signal K: the deltas of a server, one JSON object per line, of vessels and of radar targets.

Positions of vessels become reports under their MMSI; speed, course, heading, name and size are in deltas of their own,
and every position gets the latest of its vessel. Positions are moved to the middle of the hull, as those of AIS are.
Own ship is ``vessels.self`` or ``self`` of the hello message; its position is that of the radars. What sameas has sent
to the server comes back in its stream and is passed over: a fused object is no evidence of itself. Angles are radians,
speeds m/s. Source: Signal K 1.7, "Delta format"; the Radar API of Signal K 2 puts targets under
``radars.ID.targets.NUMBER``.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from sameas.io.sensors.ais import LENGTH_PER_WIDTH, STATUSES_AT_REST, at_hull_centres, is_imo_number
from sameas.io.sensors.format import LOGGED, OWN_SHIP, SensorFormat, instant, of_json, plain_text
from sameas.tracks.reports import Reports, Unused, of_rows

_MMSI = re.compile(r"mmsi:(\d{9})$")
_TARGET = re.compile(r"(?:^|\.)radars\.([^.]+)\.targets\.([^.]+)$")
#: Paths of numeric values, with their column and the factor to its unit.
_NUMBERS = {
    "navigation.speedOverGround": ("speed_m_per_s", 1.0),
    "navigation.courseOverGroundTrue": ("course_deg", 180.0 / math.pi),
    "navigation.headingTrue": ("heading_deg", 180.0 / math.pi),
    "navigation.headingMagnetic": ("magnetic_heading_deg", 180.0 / math.pi),
    "navigation.magneticVariation": ("variation_deg", 180.0 / math.pi),
}
#: The beginnings of contexts that are no vessels.
_STATIONS = ("atons.", "shore.")
#: Columns of own ship's compass.
_OF_COMPASS = ("magnetic_heading_deg", "variation_deg")
#: Paths of sizes in metres, with their column; the length may be an object. The signs of ``fromCenter`` differ between
#: servers, so that antennas are taken to be on the centre line.
_SIZES = {
    "design.length": "length_m", "design.beam": "width_m", "sensors.ais.fromBow": "to_bow_m",
    "sensors.gps.fromBow": "to_bow_m",
}  # fmt: skip
#: Paths of texts, with their column; the same are keys of the value of the path "".
_TEXTS = {"name": "name", "communication.callsignVhf": "callsign", "registrations.imo": "imo"}
#: Source of the updates that sameas sends.
FUSED = "sameas"
#: Fields older than this, in seconds, are not joined to a position (chosen).
_STALE_S = 60.0
#: Sizes from here on, in metres, are none.
_LONGEST_M = 1000.0


@dataclass
class Vessels:
    """State before these lines: latest fields with their times, by context; context and position of own ship.

    positions : number of positions of own ship so far.
    """

    fields: dict[str, dict[str, tuple[float, Any]]] = field(default_factory=dict)
    own_context: str = "vessels.self"
    station: tuple[float, float] = (math.nan, math.nan)
    positions: int = 0

    @property
    def own_heading_deg(self) -> float:
        """The true heading of own ship, or that of her compass with the variation; NaN where unknown."""
        own = {name: value for name, (_, value) in self.fields.get("self", {}).items()}
        compass = own.get("magnetic_heading_deg", math.nan) + own.get("variation_deg", math.nan)
        return float(own.get("heading_deg", compass % 360.0))

    @property
    def own_velocity(self) -> tuple[float, float]:
        """Speed (m/s) and course (degrees) of own ship over ground; NaN where unknown."""
        own = self.fields.get("self", {})
        speed, course = (own.get(name, (0.0, math.nan))[1] for name in ("speed_m_per_s", "course_deg"))
        return float(speed), float(course)

    def own_ship(self) -> dict[str, float]:
        """The columns of own ship for a report, by the names of :data:`~sameas.io.sensors.format.OWN_SHIP`."""
        values = (*self.station, self.own_heading_deg, *self.own_velocity)
        return dict(zip(OWN_SHIP.values(), values, strict=True))

    @property
    def own_mmsi(self) -> str:
        """The MMSI of own ship, if her context has it; else empty."""
        found = _MMSI.search(self.own_context)
        return found[1] if found else ""


def read(lines: Sequence[str], source: str, vessels: Vessels | None = None) -> list[Reports]:
    """The vessels and the radar targets in deltas, one :class:`Reports` each where there are both.

    lines : JSON objects. source : its name in messages; two sources are named ``source:ais`` and ``source:arpa``.
    vessels : for a stream, the state before these lines; updated.

    Raises InputError: no position and no target.
    """
    vessels, live = Vessels() if vessels is None else vessels, vessels is not None
    taken = _Deltas(vessels)
    unused = taken.unused
    for number, line in enumerate(lines, start=1):
        if not line.strip():
            continue
        try:
            delta = of_json(LOGGED.sub("", line))
        except ValueError:
            unused.damaged.append((number, "no delta"))
            continue
        try:
            taken.add(delta, number)
        except (ValueError, TypeError, KeyError, AttributeError, OverflowError, RecursionError) as error:
            unused.damaged.append((number, f"no delta: {error}"))
    kinds = [kind for kind, rows in taken.rows.items() if rows]
    if not kinds:
        raise unused.refusal(f"{source}: no position of a vessel and no target: {unused.reasons() or 'no deltas'}")
    several = live or len(kinds) > 1
    return [
        (Unused() if k else unused).reports(
            f"{source}:{kind}" if several else source, kind, _at_hull_centres(of_rows(taken.rows[kind]))
        )
        for k, kind in enumerate(kinds)
    ]


@dataclass
class _Deltas:
    """Takes deltas: their fields go to ``vessels``, their reports to ``rows``."""

    vessels: Vessels
    rows: dict[str, list[dict[str, Any]]] = field(default_factory=lambda: {"ais": [], "arpa": []})
    unused: Unused = field(default_factory=Unused)

    def add(self, delta: Any, number: int) -> None:
        """Takes the delta of a line. Raises an error where it is none."""
        vessels = self.vessels
        if "updates" not in delta:
            vessels.own_context = plain_text(delta.get("self")) or vessels.own_context
            self.unused.passed_over["hello or other message"] += 1
            return
        context = plain_text(delta.get("context", vessels.own_context))
        if context is None:
            raise ValueError("its context is no text")
        if context.startswith(_STATIONS):
            self.unused.passed_over["aid to navigation or base station"] += 1
            return
        if context in ("vessels.self", vessels.own_context, f"vessels.{vessels.own_context}"):
            context = "self"
        for update in delta["updates"]:
            if _is_fused(update):
                self.unused.passed_over["update that sameas has sent"] += 1
            else:
                self._add_update(update, number, context)

    def _add_update(self, update: Mapping[str, Any], number: int, context: str) -> None:
        vessels, fields = self.vessels, self.vessels.fields.setdefault(context, {})
        time_s = instant(str(update.get("timestamp", "")))
        if time_s is None:
            raise ValueError("an update without a time")
        position_deg = None
        for one in update.get("values", ()):
            path, value = str(one["path"]), one["value"]
            if match := _TARGET.search(path):
                row = _target(value, match[1], match[2], vessels.station)
                if row is not None:
                    self.rows["arpa"].append({"line": number, "time_s": time_s, **row, **vessels.own_ship()})
            elif path == "navigation.position" and value is not None:
                position_deg = (float(value["latitude"]), float(value["longitude"]))
            else:
                fields |= _fields(path, value, time_s)
        if position_deg is None:
            self.unused.passed_over["update without a position"] += 1
        elif not (abs(position_deg[0]) <= 90.0 and abs(position_deg[1]) <= 180.0):
            raise ValueError("position outside the earth")
        elif context == "self":
            vessels.station = position_deg
            vessels.positions += 1
        else:
            match_mmsi = _MMSI.search(context)
            mmsi = match_mmsi[1] if match_mmsi else None
            last = {
                name: value for name, (when, value) in fields.items()
                if not _STALE_S < abs(time_s - when) < math.inf and name not in _OF_COMPASS
            }  # fmt: skip
            self.rows["ais"].append({
                "line": number, "time_s": time_s, "lat_deg": position_deg[0], "lon_deg": position_deg[1], "mmsi": mmsi,
                "track_id": mmsi or context, **last, **vessels.own_ship(),
            })  # fmt: skip


def _fields(path: str, value: Any, time_s: float) -> dict[str, tuple[float, Any]]:
    """The fields that a value gives, with their times; those that stay are of all times (∞)."""
    if path in _NUMBERS:
        column, scale = _NUMBERS[path]
        return {} if value is None else {column: (time_s, scale * float(value))}
    if path == "navigation.state" and isinstance(value, str):
        return {"nav_status": (math.inf, STATUSES_AT_REST.get(value.lower(), math.nan))}
    if path in _SIZES:
        size = value.get("overall", value.get("hull")) if isinstance(value, Mapping) else value
        return {_SIZES[path]: (math.inf, float(size))} if size is not None and 0.0 <= float(size) < _LONGEST_M else {}
    if path in _TEXTS or path == "":
        return {column: (math.inf, text) for column, text in _texts(path, value)}
    return {}


def _is_fused(update: Mapping[str, Any]) -> bool:
    """Whether an update is an output of sameas (:func:`sameas.live.outputs.signalk`), as servers forward it."""
    source = update.get("source")
    label = source.get("label") if isinstance(source, Mapping) else source
    return any(str(name).partition(".")[0] == FUSED for name in (update.get("$source"), label) if name)


def _at_hull_centres(columns: dict[str, Any]) -> dict[str, Any]:
    """The columns with the positions of ships of known length at the middle of the hull, its extent in their errors."""
    unknown = np.full(len(columns["time_s"]), np.nan)
    length, width, bow = (columns.get(name, unknown) for name in ("length_m", "width_m", "to_bow_m"))
    with np.errstate(invalid="ignore"):
        side = np.where(width > 0.0, width, length / LENGTH_PER_WIDTH) / 2.0
        bow = np.where((bow > 0.0) & (bow <= length), bow, np.nan)
    columns.pop("to_bow_m", None)
    return at_hull_centres(columns, (bow, length - bow, side, side))[0]


def _texts(path: str, value: Any) -> Iterator[tuple[str, str]]:
    """The columns and texts of a value of a path in ``_TEXTS``, or of the path ""."""
    for known, column in _TEXTS.items():
        text = value if path == known else None
        if not path:
            text = value
            for key in known.split("."):
                text = text.get(key) if isinstance(text, Mapping) else None
        if isinstance(text, Mapping):
            text = text.get("name")
        if text and (words := plain_text(text)):
            # An IMO number may be written "IMO 9074729".
            words = words.upper().removeprefix("IMO").strip() if column == "imo" else words
            if column != "imo" or is_imo_number(words):
                yield column, words


def _target(value: Any, radar: str, target: str, station: tuple[float, float]) -> dict[str, Any] | None:
    """The row of a radar target, None where it is lost. In the message, metres and radians from true north."""
    if value is None or value.get("status") == "lost":
        return None
    position, motion = value.get("position", value), value.get("motion", value)
    distance, bearing = float(position["distance"]), math.degrees(float(position["bearing"]))
    if not distance > 0.0:
        raise ValueError("target at distance 0")
    speed, course = motion.get("speed"), motion.get("course")
    return {
        "range_m": distance, "bearing_deg": bearing, "track_id": f"{radar} {target}",
        "speed_m_per_s": None if speed is None else float(speed),
        "course_deg": None if course is None else math.degrees(float(course)),
        "station_lat_deg": station[0], "station_lon_deg": station[1],
    }  # fmt: skip


FORMAT = SensorFormat(
    "signalk",
    "Signal K deltas, one a line",
    lambda file: read(file.lines, file.source),
    lambda file: re.search(rb'"updates"\s*:\s*\[', file.head) is not None,
)

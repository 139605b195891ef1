"""A ship's log of NMEA 0183 sentences: the targets of its radar (ARPA) from TTM and TLL, next to its AIS.

TTM gives range and bearing, speed and course, each true or relative by a flag of its own; TLL gives latitude and
longitude computed by the radar. Of a target that has both, only TTM, the measurement, is used; one that has TLL alone
beside others with TTM is reported by its range and bearing from own ship. OSD, HDT and THS give the heading of own
ship, else a compass (HDG, HDM) with the variation of HDG or RMC; RMC, GGA, GNS, GLL and own AIS (VDO) give its
position. The accuracy of the radar is in no sentence; it comes from the description of the source.

Target numbers have two digits and are used again: ``05`` is the first target with this number, ``05/2`` the second. A
target with a known number is another one if the radar had lost the number (status L), acquires it (Q) after it was
tracked, has not reported it for :data:`SILENT_S`, or reports it where the target cannot have moved to.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from sameas.arrays import FloatArray
from sameas.errors import InputError, UndatedTimes, naming
from sameas.io.sensors import ais
from sameas.io.sensors.format import KNOT_M_PER_S, OWN_SHIP, SensorFormat, forward_filled
from sameas.io.sensors.nmea import Log, Sentence, latitude, log_of, longitude, time_of_day, with_date
from sameas.space import unit_vectors
from sameas.tracks.coordinates import MILE_M, geodesy
from sameas.tracks.platforms import OWN_POSITIONS
from sameas.tracks.reports import Damaged, Reports, Unused, of_rows

#: The sentences of targets.
SENTENCES = ("TTM", "TLL")
#: Metres, and metres per second, of the units of distance and speed.
_UNITS = {"N": (MILE_M, KNOT_M_PER_S), "K": (1000.0, 1.0 / 3.6), "S": (1609.344, 0.44704)}
_STATUS = {"L": "lost", "Q": "being acquired", "T": "tracked"}


#: Seconds without a report after which a target number belongs to another target. ARPA reports each rotation.
SILENT_S = 120.0
#: A target moves by at most the first in m/s, relative to own ship, and is reported within the second in metres and the
#: third as a share of its range (chosen).
FASTEST_M_PER_S, NEAR_M, NEAR_SHARE = 80.0, 400.0, 0.05
#: Largest number of target numbers that are remembered; radars have 100, or 1000.
MOST_NUMBERS = 10_000


@dataclass
class Target:
    """The last report of a target number. use : how many targets have had it. x, y, z : from own ship, or from the
    centre of the Earth, in metres."""

    use: int = 1
    time_s: float = math.nan
    x: float = math.nan
    y: float = math.nan
    z: float = math.nan
    tracked: bool = False
    lost: bool = False

    def is_another(self, now: Target, range_m: float) -> bool:
        """Whether the target of the next report with this number is not the same."""
        elapsed_s = now.time_s - self.time_s
        reach_m = NEAR_M + NEAR_SHARE * range_m + FASTEST_M_PER_S * abs(elapsed_s)
        return (
            self.lost
            or (self.tracked and not now.tracked)
            or elapsed_s > SILENT_S
            or math.hypot(now.x - self.x, now.y - self.y, now.z - self.z) > reach_m
        )


@dataclass
class ArpaState:
    """Own ship before these lines. has_ttm : whether TTM sentences have occurred. targets : by number.

    heading : from true north, of a gyro (``true_heading``) or else a compass (``magnetic_heading`` and ``variation``).
    speed, course : over ground, m/s and degrees. mmsi : of own ship, "" before her AIS gave it. positions : number of
    positions of own ship so far.
    measured_s : clock time of the last TTM, by the number of the target.
    """

    heading: float = math.nan
    true_heading: float = math.nan
    magnetic_heading: float = math.nan
    variation: float = math.nan
    lat: float = math.nan
    lon: float = math.nan
    speed: float = math.nan
    course: float = math.nan
    mmsi: str = ""
    positions: int = 0
    has_ttm: bool = False
    targets: dict[str, Target] = field(default_factory=dict)
    measured_s: dict[str, float] = field(default_factory=dict)

    def add_measured(self, log: Log) -> None:
        """Takes the numbers of the targets that TTM reports in a log."""
        if len(self.measured_s) > MOST_NUMBERS:
            self.measured_s.clear()
        for sentence, clock_s in zip(log.sentences, log.clock_s.tolist(), strict=True):
            if sentence.kind == "TTM":
                self.has_ttm = True
                self.measured_s[sentence.field(1)] = clock_s

    def is_measured(self, number: str, clock_s: float) -> bool:
        """Whether TTM reports this number, too, around this time; where no clock is known, whether it ever did."""
        last_s = self.measured_s.get(number)
        return last_s is not None and not abs(clock_s - last_s) > SILENT_S


def read(
    log: Log,
    source: str,
    start_s: float | None = None,
    ship: ArpaState | None = None,
    own: Mapping[str, FloatArray] | None = None,
) -> Reports:
    """The targets of a ship's radar.

    log : sentences with their clock; other kinds are ignored.
    source : its name in messages.
    start_s : UTC of the first line, for logs with the time of day but no date.
    ship : for a stream, own ship before the log; updated.
    own : as of :func:`own_ship_of`, where it is known, and ``ship`` updated.

    Raises InputError: no target; no time.
    """
    ship = ArpaState() if ship is None else ship
    ship.add_measured(log)
    kind = "TTM" if ship.has_ttm else "TLL"
    unused = Unused(list(log.damaged))
    own = own_ship_of(log, ship) if own is None else own
    indices: list[int] = []
    rows: list[dict[str, Any]] = []
    # Number of the target, and its row, None where it is lost.
    events: list[tuple[str, int | None]] = []
    for index, sentence in enumerate(log.sentences):
        if sentence.kind == "TTD":
            unused.passed_over["TTD, encapsulated targets: have the radar send TTM"] += 1
        if sentence.kind not in SENTENCES:
            continue
        if sentence.kind != kind and ship.is_measured(sentence.field(1), float(log.clock_s[index])):
            unused.passed_over["TLL of targets that TTM reports too"] += 1
            continue
        ship_then = {name: float(values[index]) for name, values in own.items()}
        if sentence.kind != kind and not np.isfinite(ship_then["lat"] + ship_then["lon"]):
            # The ranges of TTM and the positions of TLL cannot be reports of one source.
            unused.passed_over["TLL of targets that no TTM reports, without own ship's position"] += 1
            continue
        try:
            row = _target(sentence, ship_then)
            row = row if row is None or sentence.kind == kind else _measured_from(row)
        except ValueError as error:
            unused.damaged.append((sentence.line, str(error)))
            continue
        if row is None:
            unused.passed_over["target lost by the radar"] += 1
            events.append((sentence.field(1), None))
        else:
            events.append((row["track_id"], len(rows)))
            indices.append(index)
            rows.append(row)
    if not rows:
        for number, _ in events:
            ship.targets.setdefault(number, Target(use=0)).lost = True
        reasons = unused.reasons() or "every target is lost"
        raise unused.refusal(f"{source}: no radar target that can be used: {reasons}")
    columns = of_rows(rows)
    if kind == "TLL" and not np.isfinite(columns["station_lat_deg"]).all():
        # Positions do not need own ship; it is dropped unless known for all of them.
        del columns["station_lat_deg"], columns["station_lon_deg"]
    columns["time_s"] = _times(log, columns.pop("day_s"), np.array(indices), source, start_s)
    columns["track_id"] = _track_ids(columns, events, ship.targets)
    return unused.reports(source, "arpa", columns, _notes(source, log, columns))


def _track_ids(
    columns: Mapping[str, Any], events: list[tuple[str, int | None]], targets: dict[str, Target]
) -> list[str]:
    """The ids of the rows: the number of the target, and which target with this number it is. Updates ``targets``."""
    if "range_m" in columns:
        range_m, bearing = np.asarray(columns["range_m"], np.float64), np.deg2rad(columns["bearing_deg"])
        place = np.column_stack([range_m * np.sin(bearing), range_m * np.cos(bearing), np.zeros(len(range_m))])
    else:
        # In three dimensions a step across the 180th meridian is as short as any other.
        lat_deg, lon_deg = (np.asarray(columns[name], np.float64) for name in ("lat_deg", "lon_deg"))
        range_m = np.zeros(len(lat_deg))
        place = np.rad2deg(60.0 * MILE_M) * unit_vectors(lon_deg, lat_deg)
    if len(targets) > MOST_NUMBERS:
        targets.clear()
    out: list[str] = []
    for number, row in events:
        if row is None:
            targets.setdefault(number, Target(use=0)).lost = True
            continue
        x, y, z = place[row].tolist()
        now = Target(1, float(columns["time_s"][row]), x, y, z, bool(columns["tracked"][row]))
        before = targets.get(number)
        if before is not None:
            now.use = before.use + before.is_another(now, float(range_m[row]))
        targets[number] = now
        out.append(number if now.use == 1 else f"{number}/{now.use}")
    return out


def own_ship_of(log: Log, ship: ArpaState) -> dict[str, FloatArray]:
    """Heading, position, speed and course of own ship at each sentence: the latest values, NaN before the first.

    ship : own ship before the log; updated.
    """
    columns = {name: np.full(len(log.sentences), np.nan) for name in _OF_SHIP}
    for name, values in columns.items():
        values[:1] = getattr(ship, name)
    for index, sentence in enumerate(log.sentences):
        reader = _OWN_SHIP.get(sentence.kind)
        if reader:
            try:
                position = reader(sentence)
            except (ValueError, IndexError):
                continue
            ship.mmsi = position.pop("mmsi", ship.mmsi)
            for name, value in position.items():
                columns[name][index] = np.nan if value is None else value
            ship.positions += "lat" in position and bool(np.isfinite(columns["lat"][index] + columns["lon"][index]))
    known = {name: _latest(values) for name, values in columns.items()}
    compass = np.mod(known["magnetic_heading"] + known["variation"], 360.0)
    known["heading"] = np.where(np.isfinite(known["true_heading"]), known["true_heading"], compass)
    for name, values in known.items():
        setattr(ship, name, float(values[-1]) if len(values) else getattr(ship, name))
    return known


#: What is known of own ship at each sentence, apart from the heading, which follows from three of these.
_OF_SHIP = ("true_heading", "magnetic_heading", "variation", "lat", "lon", "speed", "course")


def _latest(values: FloatArray) -> FloatArray:
    has_value = np.isfinite(values)
    return np.where(np.cumsum(has_value) > 0, forward_filled(values), np.nan)


def _position(lat: int) -> Callable[[Sentence], dict[str, float | None]]:
    """A reader of the position whose latitude is in this field."""

    def position_of(s: Sentence) -> dict[str, float | None]:
        return {"lat": latitude(s.field(lat), s.field(lat + 1)), "lon": longitude(s.field(lat + 2), s.field(lat + 3))}

    return position_of


def _velocity(s: Sentence, speed: int, course: int) -> dict[str, float | None]:
    """Speed and course over ground; a receiver that rests sends no course, and keeps the last one."""
    knots, degrees = s.number(speed), s.number(course)
    given = {"speed": None if knots is None else knots * KNOT_M_PER_S}
    return given if degrees is None else given | {"course": degrees}


def _eastward(s: Sentence, number: int) -> float | None:
    """An angle and its side in two fields, east positive: deviation and variation."""
    degrees = s.number(number)
    return -degrees if degrees is not None and s.field(number + 1) == "W" else degrees


def _compass(s: Sentence) -> dict[str, float | None]:
    """The magnetic heading of HDG, and the variation where it has one; the deviation is applied."""
    sensor, variation = s.number(1), _eastward(s, 4)
    heading = {"magnetic_heading": None if sensor is None else sensor + (_eastward(s, 2) or 0.0)}
    return heading if variation is None else heading | {"variation": variation}


def _recommended(s: Sentence) -> dict[str, float | None]:
    """Position, velocity and, where it is given, variation of RMC."""
    if s.field(2) == "V":
        return {}
    variation = _eastward(s, 10)
    given = _position(3)(s) | _velocity(s, 7, 8)
    return given if variation is None else given | {"variation": variation}


_OWN_SHIP: Mapping[str, Callable[[Sentence], dict[str, Any]]] = {
    "OSD": lambda s: {"true_heading": s.number(1) if s.field(2) != "V" else None},
    # Some compasses call their heading so, and say M.
    "HDT": lambda s: {"magnetic_heading" if s.field(2) == "M" else "true_heading": s.number(1)},
    "THS": lambda s: {"true_heading": s.number(1) if s.field(2) != "V" else None},
    "HDG": _compass,
    "HDM": lambda s: {"magnetic_heading": s.number(1)},
    "RMC": _recommended,
    "VTG": lambda s: _velocity(s, 5, 1),
    "GGA": lambda s: _position(2)(s) if s.field(6) != "0" else {},
    "GNS": lambda s: _position(2)(s) if s.field(6).strip("N") else {},
    "GLL": lambda s: _position(1)(s) if s.field(6) != "V" else {},
    "VDO": ais.own_ship,
}


def _target(s: Sentence, own: Mapping[str, float]) -> dict[str, Any] | None:
    """The row of a target; None where the radar has lost it. Raises ValueError with the reason."""
    ttm = s.kind == "TTM"
    status = s.field(12 if ttm else 8) or "T"
    if status not in _STATUS:
        raise ValueError(f"status of the target is {status!r}, not L, Q or T")
    if status == "L":
        return None
    number = s.field(1)
    if not number:
        raise ValueError("target without a number")
    row = {
        "line": s.line,
        "track_id": number,
        "name": s.field(11 if ttm else 6) or None,
        "day_s": time_of_day(s.field(14 if ttm else 7)),
        "tracked": float(status == "T"),
        "reference": float(s.field(13 if ttm else 9) == "R"),
    }
    if not ttm:
        lat, lon = latitude(s.field(2), s.field(3)), longitude(s.field(4), s.field(5))
        return row | {"lat_deg": lat, "lon_deg": lon, **_station(own)}
    return row | _range_and_bearing(s, own) | _station(own)


def _measured_from(row: dict[str, Any]) -> dict[str, Any]:
    """The row of a TLL with range and bearing from own ship in place of the position."""
    place, ship = ("lat_deg", "lon_deg"), ("station_lat_deg", "station_lon_deg")
    bearing, _, range_m = geodesy().geodetic2aer(
        *(row[name] for name in place), 0.0, *(row[name] for name in ship), 0.0
    )
    if not range_m > 0.0:
        raise ValueError("target at distance 0")
    rest = {name: value for name, value in row.items() if name not in place}
    return rest | {"range_m": float(range_m), "bearing_deg": float(bearing)}


def _range_and_bearing(s: Sentence, own: Mapping[str, float]) -> dict[str, Any]:
    """Range, bearing, speed and course of a TTM."""
    unit = s.field(10) or "N"
    if unit not in _UNITS:
        raise ValueError(f"unit of distance is {unit!r}, not K, N or S")
    metres, metres_per_s = _UNITS[unit]
    distance, bearing = s.number(2), s.number(3)
    if distance is None or bearing is None:
        raise ValueError("target without distance or bearing")
    if not distance > 0.0:
        raise ValueError("target at distance 0")
    speed, course = s.number(5), s.number(6)
    return {
        "range_m": distance * metres,
        "bearing_deg": _from_north(bearing, s.field(4), own["heading"]),
        "speed_m_per_s": None if speed is None else speed * metres_per_s,
        "course_deg": _course(course, s.field(7), own["heading"]),
    }


def _station(own: Mapping[str, float]) -> dict[str, Any]:
    """Position and heading of own ship."""
    return {"station_lat_deg": own["lat"], "station_lon_deg": own["lon"], "station_heading_deg": own["heading"]}


def _course(angle: float | None, flag: str, heading: float) -> float | None:
    """The course from true north; None where it is missing, or relative while the heading is unknown."""
    if angle is None or (flag == "R" and not np.isfinite(heading)):
        return None
    return _from_north(angle, flag, heading)


def _from_north(angle: float, flag: str, heading: float) -> float:
    """A direction from true north; ``flag`` says whether it is given from there (T) or from the bow (R)."""
    if flag in ("T", ""):
        return angle
    if flag != "R":
        raise ValueError(f"flag of a direction is {flag!r}, neither T nor R")
    if not np.isfinite(heading):
        raise ValueError("direction from the bow before the first heading (OSD, HDT, THS, or HDG with a variation)")
    return angle + heading


def _times(log: Log, day_s: FloatArray, indices: np.ndarray, source: str, start_s: float | None) -> FloatArray:
    """The time of each target."""
    clock_s = log.clock_s[indices]
    own_time = with_date(day_s, clock_s, start_s)
    times = np.where(np.isfinite(own_time), own_time, clock_s)
    if not np.isfinite(times).all():
        reason = "the sentences have the time of day, but no date" if np.isfinite(day_s).any() else "no line has a time"
        if np.isfinite(day_s).all():
            raise UndatedTimes(f"{source}: no time: {reason}", naming("give {start}, the UTC date of the first line"))
        raise InputError(f"{source}: no time: {reason}, no ZDA and no RMC")
    return np.asarray(times)


def _notes(source: str, log: Log, columns: Mapping[str, Any]) -> tuple[str, ...]:
    notes = [
        f"{source}: times from {log.clock or 'the start that was given'}, and from the targets where they have one"
    ]
    own_reports = sum(sentence.kind == "VDO" for sentence in log.sentences)
    if own_reports:
        notes.append(f"{source}: own ship's place from {own_reports} AIS sentences of her own (VDO) too")
    if "range_m" not in columns:
        return tuple(notes)
    notes.append(f"{source}: directions marked R are relative to the bow, at the last heading received")
    if not np.isfinite(columns["station_lat_deg"]).any():
        notes.append(f"{source}: the log lacks own ship's position; give it in the description of the source")
    return tuple(notes)


def of_log(log: Log, source: str, start_s: float | None) -> list[Reports]:
    """AIS and radar targets of a log; two sources where it has both."""
    kinds = {sentence.kind for sentence in log.sentences}
    has_ais, has_arpa = "VDM" in kinds, bool(kinds & set(SENTENCES))
    ship = ArpaState()
    own = own_ship_of(log, ship)
    if not (has_ais or has_arpa):
        if positions := own_positions(log, source, start_s, own):
            return with_own_ship([positions], log, own, replace(positions, source=OWN))
        listed = ", ".join(sorted(kinds)) or "none"
        raise InputError(f"{source}: no AIS (VDM) and no radar targets (TTM, TLL) among its sentences: {listed}")
    both = has_ais and has_arpa
    sources = [ais.read(log, f"{source}:ais" if both else source, start_s)] if has_ais else []
    if has_arpa:
        # Damaged lines are counted once, with the first source.
        rest = replace(log, damaged=()) if both else log
        sources.append(read(rest, f"{source}:arpa" if both else source, start_s, own=own))
    return with_own_ship(sources, log, own, own_track(log, own, start_s, ship.mmsi))


OWN = "own ship"  # the source of her track
#: Sentences of positions, and the field of their time of day.
_POSITIONS = {"RMC": 1, "GGA": 1, "GNS": 1, "GLL": 5}


def own_positions(log: Log, source: str, start_s: float | None, own: Mapping[str, FloatArray]) -> Reports | None:
    """The positions of own ship, as of :func:`own_ship_of`, the last of each time; None if the log has none. Those of
    her AIS count where no receiver gives any.

    Raises InputError: no time.
    """
    of_position = [k for k, s in enumerate(log.sentences) if s.kind in _POSITIONS]
    of_position = of_position or [k for k, s in enumerate(log.sentences) if s.kind == "VDO"]
    indices = np.array([k for k in of_position if np.isfinite(own["lat"][k] + own["lon"][k])], np.int64)
    if not len(indices):
        return None
    sentences = [log.sentences[k] for k in indices]
    day_s = np.array([_day_s(s) for s in sentences])
    time_s = _times(log, day_s, indices, source, start_s)
    _, last = np.unique(time_s[::-1], return_index=True)
    rows = np.sort(len(time_s) - 1 - last)
    values = {column.removeprefix("own_"): own[name][indices[rows]] for name, column in OWN_SHIP.items()}
    lines = np.array([s.line for s in sentences])[rows]
    return Reports.of(
        source, OWN_POSITIONS, values | {"time_s": time_s[rows], "line": lines}, damaged=Damaged.of(log.damaged)
    )


def _day_s(sentence: Sentence) -> float:
    """The time of day of a sentence of a position; NaN where it has none."""
    try:
        return time_of_day(sentence.field(_POSITIONS[sentence.kind]))
    except (KeyError, ValueError):
        return np.nan


def own_track(log: Log, own: Mapping[str, FloatArray], start_s: float | None, mmsi: str) -> Reports | None:
    """The positions of own ship, as of :func:`own_ship_of`, with her MMSI where it is known; None if the log has none,
    or no time of them."""
    try:
        track = own_positions(log, OWN, start_s, own)
    except InputError:
        return None
    return replace(track, mmsi=np.full(len(track), mmsi, object)) if track is not None and mmsi else track


def with_own_ship(
    sources: Sequence[Reports], log: Log, own: Mapping[str, FloatArray], track: Reports | None
) -> list[Reports]:
    """The reports of a log with own ship at each of them, as :data:`~sameas.io.sensors.format.OWN_SHIP`, and her
    ``track``, where her position is known. own : as of :func:`own_ship_of`."""
    if not sources or not np.isfinite(own["lat"] + own["lon"]).any():
        return list(sources)
    lines = np.array([sentence.line for sentence in log.sentences])
    out = []
    for reports in sources:
        index = np.searchsorted(lines, reports.line, side="right") - 1
        columns = {column: own[name][index] for name, column in OWN_SHIP.items()}
        out.append(replace(reports, extra={**reports.extra, **columns}, own_ship=track))
    return out


FORMAT = SensorFormat(
    "nmea",
    "NMEA 0183: AIS (VDM) and tracked radar targets (TTM, TLL)",
    lambda file: of_log(log_of(file.lines, file.unended, start_s=file.start_s), file.source, file.start_s),
    lambda file: any(re.search(r"[!$][A-Z]{4,9}[A-Z0-9]?,", line) for line in file.head_lines),
)

"""AIS: the self-reports of ships, from the !AIVDM sentences of a log.

Position reports 1, 2, 3, 9, 18, 19 and 27 become reports; 5, 19 and 24 give name, call sign, ship type and hull; 4 and
11 serve as a clock where the log has none. Values that mean "not available" are absent. Positions are those of the
centre of the hull where hull and heading are known (:class:`Hull`); those of the antenna are in ``extra``. The errors
of a ship that states no hull include that of one of usual length (:data:`ASSUMED_LENGTH_M`). Messages are decoded by
pyais (MIT).
"""

from __future__ import annotations

import math
import re
from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from typing import Any, SupportsFloat

import numpy as np

from sameas.arrays import BoolArray, FloatArray
from sameas.errors import InputError, UndatedTimes, naming, optional
from sameas.io.sensors.format import (
    AIS_RECKONED_SIGMA_M,
    AIS_SIGMA_M,
    KNOT_M_PER_S,
    at_second,
    forward_filled,
    round_covariance,
    unwrapped,
)
from sameas.io.sensors.nmea import Log, Sentence
from sameas.tracks.coordinates import MILE_M, along_and_across, geodesy
from sameas.tracks.distress import device_of
from sameas.tracks.reports import Damaged, Reports, Unused, of_rows


@dataclass(frozen=True)
class Hull:
    """Distances (n,) in metres from the antenna to bow, stern, port and starboard; NaN or all 0 where not known.

    A ship of 300 m with its antenna over the bridge reports a position 80 m from its centre, more than the errors of
    either sensor. :meth:`centre` moves the position along the heading and adds the extent of the hull to the
    covariance, since an echo may come from any part of it. Bow and port 0 with stern and starboard above 0 give the
    size of the ship, but not the position of its antenna (ITU-R M.1371).
    """

    to_bow_m: FloatArray
    to_stern_m: FloatArray
    to_port_m: FloatArray
    to_starboard_m: FloatArray

    @property
    def length_m(self) -> FloatArray:
        """(n,) NaN where not known."""
        return _positive(self.to_bow_m + self.to_stern_m)

    @property
    def width_m(self) -> FloatArray:
        """(n,) NaN where not known."""
        return _positive(self.to_port_m + self.to_starboard_m)

    @property
    def antenna_known(self) -> BoolArray:
        """(n,) whether the position of the antenna on the hull is known."""
        size_only = (self.to_bow_m == 0.0) & (self.to_port_m == 0.0)
        return ~np.isnan(self.length_m) & ~(size_only & (self.to_stern_m > 0.0) & (self.to_starboard_m > 0.0))

    def or_of_length(self, length_m: FloatArray) -> Hull:
        """The hulls; where none is known, one of this length (n,), the place of its antenna unknown; none where it is
        0."""
        unknown = np.isnan(self.length_m)
        sides = (self.to_bow_m, self.to_stern_m, self.to_port_m, self.to_starboard_m)
        none = np.zeros(len(length_m))
        assumed = (none, length_m, none, length_m / LENGTH_PER_WIDTH)
        return Hull(*(np.where(unknown, one, side) for side, one in zip(sides, assumed, strict=True)))

    def centre(
        self, lat_deg: FloatArray, lon_deg: FloatArray, heading_deg: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Latitude and longitude (n,) of the centre, and the hull's part of the covariance (n, 3), m² east, north.

        heading_deg : (n,) from true north; where it is NaN the position is not moved, and the covariance includes the
            offset in all directions.

        Echoes are assumed uniform over the hull: variances L²/12 along it and B²/12 across.
        """
        length, width = np.nan_to_num(self.length_m), np.nan_to_num(self.width_m)
        ahead = np.where(self.antenna_known, (self.to_bow_m - self.to_stern_m) / 2.0, 0.0)
        starboard = np.where(self.antenna_known, (self.to_starboard_m - self.to_port_m) / 2.0, 0.0)
        # An antenna at an unknown position is uniform over the hull too, as an echo is.
        factor = np.where(self.antenna_known, 1.0, 2.0)
        along, across = factor * length**2 / 12.0, factor * width**2 / 12.0
        has_heading = np.isfinite(heading_deg)
        heading = np.where(has_heading, heading_deg, 0.0)
        isotropic = (along + across + ahead**2 + starboard**2) / 2.0
        extent = along_and_across(
            np.where(has_heading, along, isotropic), np.where(has_heading, across, isotropic), heading
        )
        angle = np.radians(heading)
        east = np.where(has_heading, ahead * np.sin(angle) + starboard * np.cos(angle), 0.0)
        north = np.where(has_heading, ahead * np.cos(angle) - starboard * np.sin(angle), 0.0)
        lat, lon, _ = geodesy().enu2geodetic(east, north, np.zeros_like(east), lat_deg, lon_deg, np.zeros_like(east))
        return np.atleast_1d(lat), np.atleast_1d(lon), np.stack([extent[:, 0, 0], extent[:, 0, 1], extent[:, 1, 1]], -1)


def heading_or_course(heading_deg: FloatArray, course_deg: FloatArray, speed_m_per_s: FloatArray) -> FloatArray:
    """(n,) the heading; where it is NaN, the course of a ship that moves, else NaN."""
    course = np.where(np.nan_to_num(speed_m_per_s) > _STEERING_M_PER_S, course_deg, np.nan)
    return np.where(np.isfinite(heading_deg), heading_deg, course)


def at_hull_centres(values: Mapping[str, Any], sides: Sequence[FloatArray | None]) -> tuple[dict[str, Any], list[str]]:
    """The positions of AIS at the middle of the hull where the place of the antenna is known, with the extent of the
    hull in their errors where its size is known; and notes on both.

    sides : distances (n,) of the antenna from bow, stern, port and starboard, None where there is no column.
    """
    n = len(values["time_s"])
    unknown = np.full(n, np.nan)
    bow, stern, port, starboard = (unknown if side is None else side for side in sides)
    length, width = values.get("length_m", unknown), values.get("width_m", unknown)
    with np.errstate(invalid="ignore"):
        has_antenna = (bow + stern > 0.0) & (port + starboard > 0.0)
        known = has_antenna | (length > 0.0)
        width = np.where(width > 0.0, width, length / LENGTH_PER_WIDTH)
    if not known.any():
        return dict(values), []
    # Bow and port 0: a size without the position of the antenna. Tables differ in which of C and D is port (Danish AIS
    # has it last, ITU-R M.1371 third): the antenna is taken to be in the middle of the width.
    middle = (port + starboard) / 2.0
    hull = Hull(
        np.where(has_antenna, bow, 0.0),
        np.where(has_antenna, stern, length),
        np.where(has_antenna, middle, 0.0),
        np.where(has_antenna, middle, width),
    )
    motion = (values.get(name, unknown) for name in ("heading_deg", "course_deg", "speed_m_per_s"))
    lat, lon, extent = hull.centre(values["lat_deg"], values["lon_deg"], heading_or_course(*motion))
    stated = values.get("covariance_m2", np.full((n, 3), np.nan))
    base = np.where(np.isfinite(stated).all(axis=1)[:, None], stated, round_covariance(np.full(n, AIS_SIGMA_M[False])))
    moved = known & hull.antenna_known
    places = {"lat_deg": np.where(moved, lat, values["lat_deg"]), "lon_deg": np.where(moved, lon, values["lon_deg"])}
    notes = [f"where the antenna's place on the hull is known, {HULL_CENTRES}"] * bool(hull.antenna_known.any())
    if (known & ~hull.antenna_known).any():
        notes.append("where only the length of a ship is known, positions are not moved, and their errors include the "
                     "antenna's unknown place on the hull")  # fmt: skip
    return dict(values) | places | {"covariance_m2": np.where(known[:, None], base + extent, stated)}, notes


def _positive(size: FloatArray) -> FloatArray:
    with np.errstate(invalid="ignore"):
        return np.where(size > 0.0, size, np.nan)


#: Sentences of AIS; VDO is the report of own ship.
SENTENCES = ("VDM", "VDO")
_POSITIONS = (1, 2, 3, 9, 18, 19, 27)
_STATICS = (5, 19, 24)
_CLOCKS = (4, 11)
#: Metres of one step of latitude in reports 27 (0.1′); in all others it is 0.2 m, far below the errors.
_LONG_RANGE_STEP_M = 0.1 * MILE_M
#: Above this speed, in m/s, the course is used as heading where none is sent.
_STEERING_M_PER_S = 1.0
#: Length of a ship per width, where its width is not stated (chosen).
LENGTH_PER_WIDTH = 6.0
#: Length in metres of a ship that states none, by the type of her position report: class A, from pilot boats of 15 m to
#: ships of 400 m, class B, and aircraft, which are no hulls (chosen).
ASSUMED_LENGTH_M = {1: 60.0, 2: 60.0, 3: 60.0, 9: 0.0, 18: 15.0, 19: 15.0, 27: 60.0}
HULL_CENTRES = (
    "positions are those of the middle of the hull; echoes are assumed to be uniform over the hull; "
    f"the course is used as heading where none is sent and the speed is {_STEERING_M_PER_S:g} m/s or more"
)
#: A part that comes later than this after the first one, in seconds, is of another message (chosen).
MESSAGE_S = 10.0
#: Two messages of one number that begin within this many seconds come from two receivers (chosen).
AMBIGUOUS_S = 3.0
#: Largest number of incomplete messages; above it, they are dropped.
MOST_WAITING = 10_000
_ALONE = "part of a message without the others"
SIDES = ("bow", "stern", "port", "starboard")
#: Navigational statuses (ITU-R M.1371, table 48), and the numbers of those that tell ships at rest apart, by the words
#: of tables and of Signal K.
STATUSES = {
    0: "under way using engine", 1: "at anchor", 2: "not under command", 3: "restricted manoeuvrability",
    4: "constrained by her draught", 5: "moored", 6: "aground", 7: "engaged in fishing", 8: "under way sailing",
    11: "towing astern", 12: "pushing ahead or towing alongside", 14: "AIS-SART, MOB or EPIRB",
}  # fmt: skip
STATUSES_AT_REST = {STATUSES[number]: float(number) for number in (1, 2, 5, 6)} | {"anchored": 1.0}
_SHIP_TYPES = {20: "wing in ground", 30: "fishing", 31: "towing", 32: "towing", 33: "dredging", 34: "diving",
          35: "military", 36: "sailing", 37: "pleasure", 40: "high speed craft", 50: "pilot",
          51: "search and rescue", 52: "tug", 53: "port tender", 54: "anti-pollution", 55: "law enforcement",
          58: "medical", 60: "passenger", 70: "cargo", 80: "tanker", 90: "other"}  # fmt: skip


@dataclass(frozen=True)
class AisMessage:
    """One message decoded by pyais. line : of its last sentence. index : of that sentence in the log."""

    line: int
    index: int
    own_ship: bool
    decoded: Any

    @property
    def type(self) -> int:
        return int(self.decoded.msg_type)


@dataclass(frozen=True)
class Static:
    """The static data of a ship as of a line, by column."""

    line: int
    values: Mapping[str, Any]


@dataclass(frozen=True)
class Incomplete:
    """The first parts of a message. time_s : of the first, NaN where the log has no clock. ambiguous : whether two
    messages that cannot be told apart have begun: a further part may be of either."""

    parts: tuple[Sentence, ...] = ()
    time_s: float = math.nan
    ambiguous: bool = False


@dataclass
class ReceiverState:
    """State of a receiver before these lines: incomplete multi-part messages, and static data of ships."""

    waiting: dict[tuple[str, ...], Incomplete] = field(default_factory=dict)
    statics: dict[str, Mapping[str, Any]] = field(default_factory=dict)


def read(log: Log, source: str, start_s: float | None = None, state: ReceiverState | None = None) -> Reports:
    """The reports of ships in a log.

    log : sentences with their clock; those that are not AIS are ignored.
    source : its name in messages.
    start_s : UTC of the first message, for logs without a clock: times are counted from it by the UTC seconds in the
        messages.
    state : for a stream, the state before the log; updated. Incomplete messages at the end of the log are kept in it.

    Raises InputError: pyais is not installed; no position among the messages; no time.
    """
    messages, damaged = _messages(log, state)
    statics = _statics(messages, state)
    positions, unused = [], Unused(damaged)
    passed_over = unused.passed_over
    for message in messages:
        reason = _unusable(message)
        if message.own_ship:
            passed_over["own ship's own report (VDO)"] += 1
        elif message.type not in _POSITIONS:
            if reason:
                damaged.append((message.line, reason))
            elif message.type not in _STATICS:
                passed_over[f"AIS message of type {message.type}"] += 1
        elif reason.startswith("AIS"):
            passed_over[reason] += 1
        elif reason:
            damaged.append((message.line, reason))
        else:
            positions.append(message)
    if not positions:
        lines = [*Damaged.of(damaged).sentences(), *(f"{n} skipped: {what}" for what, n in passed_over.items())]
        raise unused.refusal(
            f"{source}: no AIS position in {len(messages)} messages; {'; '.join(lines) or 'is it AIS?'}"
        )
    time_s, clock = _times(log, messages, positions, source, start_s)
    columns = of_rows(_rows(positions, statics))
    columns |= {"time_s": time_s, **_hull_centres(columns, np.array([message.type for message in positions]))}
    return replace(unused.reports(source, "ais", columns, _notes(source, clock)), counted_clock=clock == COUNTED)


def own_ship(sentence: Sentence) -> dict[str, Any]:
    """The latitude, longitude, true heading, speed and course of own ship that a VDO sentence gives, and her MMSI.

    Raises ValueError: it cannot be decoded, or pyais is not installed.
    """
    if sentence.field(1) != "1":
        return {}
    try:
        decoded = _decoder()(sentence.text)
    except Exception as error:
        raise ValueError(f"cannot be decoded ({type(error).__name__})") from error
    message = AisMessage(sentence.line, 0, True, decoded)
    if message.type not in _POSITIONS or _unusable(message):
        return {}
    mmsi = f"{int(decoded.mmsi):09d}"
    fields: dict[str, Any] = {"lat": float(decoded.lat), "lon": float(decoded.lon), "mmsi": mmsi}
    others = {"true_heading": _available(getattr(decoded, "heading", None), 360),
              "speed": _speed(message), "course": _available(decoded.course, 360.0)}  # fmt: skip
    return fields | {name: value for name, value in others.items() if value is not None}


def _messages(log: Log, state: ReceiverState | None) -> tuple[list[AisMessage], list[tuple[int, str]]]:
    """The decoded messages, multi-part ones joined, and the damaged lines."""
    decode = _decoder()
    messages: list[AisMessage] = []
    damaged = list(log.damaged)
    waiting: dict[tuple[str, ...], Incomplete] = {} if state is None else state.waiting
    if len(waiting) > MOST_WAITING:
        waiting.clear()
    for index, sentence in enumerate(log.sentences):
        if sentence.kind not in SENTENCES:
            continue
        parts = [sentence]
        if not sentence.field(5):
            damaged.append((sentence.line, "AIS sentence without a message"))
            continue
        if sentence.field(1) != "1":
            key = (sentence.kind, *(sentence.field(k) for k in (1, 3, 4)), sentence.origin)
            parts = _parts(waiting, key, sentence, float(log.clock_s[index]), damaged)
        if not parts:
            continue
        try:
            decoded = decode(*(part.text for part in parts))
        except Exception as error:
            # pyais raises many kinds of errors; each is one damaged message.
            damaged += [(part.line, f"cannot be decoded ({type(error).__name__})") for part in parts]
            continue
        messages.append(AisMessage(sentence.line, index, sentence.kind == "VDO", decoded))
    for incomplete in waiting.values() if state is None else ():
        damaged += [(part.line, _ALONE) for part in incomplete.parts]
    return messages, damaged


def _parts(
    waiting: dict[tuple[str, ...], Incomplete],
    key: tuple[str, ...],
    sentence: Sentence,
    time_s: float,
    damaged: list[tuple[int, str]],
) -> list[Sentence]:
    """All parts of a message if this is the last one, else none; parts out of sequence become damaged.

    time_s : of the sentence, NaN where the log has no clock.
    """
    total, number = key[1], sentence.field(2)
    earlier = waiting.pop(key, Incomplete())
    if time_s - earlier.time_s > MESSAGE_S or number != str(len(earlier.parts) + 1):
        damaged += [(part.line, _ALONE) for part in earlier.parts]
        # A receiver gives the number of a message anew only after nine others: this is another receiver's.
        differs = any(part.text != sentence.text for part in earlier.parts[:1])
        ambiguous = number == "1" and differs and time_s - earlier.time_s <= AMBIGUOUS_S
        earlier = Incomplete(ambiguous=ambiguous)
    if number != "1" and not earlier.parts:
        damaged.append((sentence.line, _ALONE))
        return []
    first_s = earlier.time_s if earlier.parts else time_s
    incomplete = Incomplete((*earlier.parts, sentence), first_s, earlier.ambiguous)
    if str(len(incomplete.parts)) != total:
        waiting[key] = incomplete
        return []
    if incomplete.ambiguous:
        damaged += [(part.line, "parts of messages of several receivers that cannot be told apart")
                    for part in incomplete.parts]  # fmt: skip
        return []
    return list(incomplete.parts)


def _decoder() -> Callable[..., Any]:
    with optional("AIS messages need pyais", "targets"):
        from pyais import decode
    return decode


def _unusable(message: AisMessage) -> str:
    """Why a position report or static data cannot be used, "" where they can; starts with "AIS" where not damaged."""
    decoded = message.decoded
    if message.type in _STATICS + _POSITIONS and getattr(decoded, "mmsi", None) is None:
        return f"too short for a message of type {message.type}"
    if message.type not in _POSITIONS:
        return ""
    lat, lon = getattr(decoded, "lat", None), getattr(decoded, "lon", None)
    if lat is None or lon is None:
        return f"too short for a message of type {message.type}"
    if lat == 91.0 or lon == 181.0:
        return "AIS report without a position"
    if abs(lat) > 90.0 or abs(lon) > 180.0:
        return "position outside the earth"
    return "AIS report, positioning inoperative" if getattr(decoded, "second", None) == 63 else ""


#: Description of the clock of a log without one.
COUNTED = "the seconds in the messages, counted on from the start that was given"


def _times(
    log: Log, messages: Sequence[AisMessage], positions: Sequence[AisMessage], source: str, start_s: float | None
) -> tuple[FloatArray, str]:
    """The time of each position, and the description of the clock."""
    second = np.array([_available(getattr(message.decoded, "second", None), 60) for message in positions], float)
    indices = [message.index for message in positions]
    clock_s, clock = log.clock_s, log.clock
    if not clock and any(message.type in _CLOCKS for message in messages):
        clock_s = np.full(len(log.sentences), np.nan)
        for message in messages:
            if message.type in _CLOCKS:
                clock_s[message.index] = _base_station(message.decoded)
        clock_s, clock = forward_filled(clock_s), "base stations' reports"
    if np.isfinite(clock_s[indices]).all():
        return at_second(clock_s[indices], second), clock
    if start_s is None:
        if log.has_times_of_day:
            reason = f"{source}: no time: the lines have the time of day, but no date"
            raise UndatedTimes(reason, naming("give {start}, the UTC date of the first line"))
        raise InputError(
            f"{source}: no time: the lines carry no time of receipt, and there is no ZDA, RMC or base station",
            naming("give {start}, the UTC of the first line"),
        )
    counted = forward_filled(unwrapped(second, 60.0, start_s))
    return counted, COUNTED


def _base_station(decoded: Any) -> float:
    try:
        moment = datetime(
            decoded.year, decoded.month, decoded.day, decoded.hour, decoded.minute, decoded.second, tzinfo=UTC
        )
    except (TypeError, ValueError):
        return np.nan
    return moment.timestamp()


def _rows(positions: Sequence[AisMessage], statics: Mapping[str, list[Static]]) -> list[dict[str, Any]]:
    rows = []
    for message in positions:
        decoded = message.decoded
        second = getattr(decoded, "second", None)
        mmsi = f"{int(decoded.mmsi):09d}"
        device = device_of(mmsi)
        rows.append(
            {
                "line": message.line,
                "mmsi": mmsi,
                "track_id": mmsi,
                "antenna_lat_deg": float(decoded.lat),
                "antenna_lon_deg": float(decoded.lon),
                "alt_m": _available(getattr(decoded, "alt", None), 4095),
                "speed_m_per_s": _speed(message),
                "course_deg": _available(decoded.course, 360.0),
                "heading_deg": _available(getattr(decoded, "heading", None), 360),
                "message_type": message.type,
                # 15 is a test of a locating device, and no status of others.
                "nav_status": _available(getattr(decoded, "status", None), 15 if device is None else 16),
                "accuracy_flag": float(bool(decoded.accuracy)),
                "raim_flag": float(bool(decoded.raim)),
                "reckoned": float(second in (61, 62)),
                **({} if device is None else {"type": device}),
                **_static_at(statics.get(mmsi, []), message.line),
            }
        )
    return rows


def _available(value: str | SupportsFloat | None, limit: float) -> float | None:
    """The value as a number; None where it is missing or at the limit that means "not available"."""
    return None if value is None or not 0 <= float(value) < limit else float(value)


def _speed(message: AisMessage) -> float | None:
    """The speed over ground in m/s; None where it is not available."""
    # Knots in tenths; report 27 has whole knots and 63 for none, 9 whole knots and 1023.
    speed = _available(message.decoded.speed, {27: 63.0, 9: 1023.0}.get(message.type, 102.25))
    return None if speed is None else speed * KNOT_M_PER_S


def _statics(messages: Sequence[AisMessage], state: ReceiverState | None) -> dict[str, list[Static]]:
    """The static data of each ship in the order of lines; each entry includes the earlier values."""
    by_ship: dict[str, list[Static]] = {}
    if state is not None:
        senders = {f"{int(message.decoded.mmsi):09d}" for message in messages}
        by_ship = {mmsi: [Static(0, state.statics[mmsi])] for mmsi in senders & state.statics.keys()}
    for message in messages:
        if message.type not in _STATICS or message.own_ship or _unusable(message):
            continue
        mmsi = f"{int(message.decoded.mmsi):09d}"
        entries = by_ship.setdefault(mmsi, [])
        fields = _static_fields(message.decoded)
        entries.append(Static(message.line, {**(entries[-1].values if entries else {}), **fields}))
        if state is not None:
            state.statics[mmsi] = entries[-1].values
    return by_ship


def _static_at(statics: Sequence[Static], line: int) -> Mapping[str, Any]:
    """The static data of a ship at a line; the first entry also applies before it: hulls and names are constant."""
    if not statics:
        return {}
    return statics[max(bisect_right(statics, line, key=lambda static: static.line) - 1, 0)].values


def is_imo_number(text: str) -> bool:
    """Whether a text is an IMO number: seven digits, the last one the check digit (IMO A.1117(30)). Crews and makers
    enter others, which are no identity.

    >>> is_imo_number("9134270"), is_imo_number("9123456"), is_imo_number("0")
    (True, False, False)
    """
    if re.fullmatch(r"[1-9]\d{6}", text) is None:
        return False
    return sum(int(digit) * (7 - k) for k, digit in enumerate(text[:6])) % 10 == int(text[6])


def _static_fields(decoded: Any) -> dict[str, Any]:
    values: dict[str, Any] = {}
    for column, entry in (("name", "shipname"), ("callsign", "callsign")):
        text = str(getattr(decoded, entry, None) or "").rstrip("@ ").strip()
        if text:
            values[column] = text
    if is_imo_number(imo := str(getattr(decoded, "imo", None) or "")):
        values["imo"] = imo
    code = int(getattr(decoded, "ship_type", None) or 0)
    if 20 <= code < 100:
        values["type"] = _SHIP_TYPES.get(code, _SHIP_TYPES.get(10 * (code // 10), "other"))
    sides = {f"to_{side}_m": getattr(decoded, f"to_{side}", None) for side in SIDES}
    # An auxiliary craft (98…) sends the MMSI of its mother ship in place of the hull.
    if None not in sides.values() and any(sides.values()) and not f"{int(decoded.mmsi):09d}".startswith("98"):
        values |= {name: float(distance or 0.0) for name, distance in sides.items()}
    return values


def _hull_centres(columns: Mapping[str, Any], message_type: np.ndarray) -> dict[str, Any]:
    """Positions of the centres of the hulls, and their covariances."""
    n = len(message_type)
    lat, lon = columns["antenna_lat_deg"], columns["antenna_lon_deg"]
    sigma = np.where(columns["accuracy_flag"] > 0.0, AIS_SIGMA_M[True], AIS_SIGMA_M[False])
    sigma = np.where(columns["reckoned"] > 0.0, AIS_RECKONED_SIGMA_M, sigma)
    covariance = round_covariance(sigma)
    # Rounding error, uniform within a step.
    step = np.where(message_type == 27, _LONG_RANGE_STEP_M, 0.0)
    covariance[:, 2] += step**2 / 12.0
    covariance[:, 0] += (step * np.cos(np.radians(lat))) ** 2 / 12.0
    sides = [np.asarray(columns.get(f"to_{side}_m", np.full(n, np.nan))) for side in SIDES]
    hull = Hull(*sides)
    heading = heading_or_course(columns["heading_deg"], columns["course_deg"], columns["speed_m_per_s"])
    lat, lon, extent = hull.or_of_length(_assumed_length_m(columns["mmsi"], message_type)).centre(lat, lon, heading)
    return {"lat_deg": lat, "lon_deg": lon, "covariance_m2": covariance + extent,
            "length_m": hull.length_m, "width_m": hull.width_m}  # fmt: skip


def _assumed_length_m(mmsi: Sequence[str], message_type: np.ndarray) -> FloatArray:
    """(n,) the length of ships that state none: 0 of a locating device, of a ship's own craft (98…) that of class B."""
    return np.array([
        0.0 if device_of(one) else ASSUMED_LENGTH_M[18 if one.startswith("98") else kind]
        for one, kind in zip(mmsi, message_type.tolist(), strict=True)
    ])  # fmt: skip


def _notes(source: str, clock: str) -> tuple[str, ...]:
    return (
        f"{source}: times from {clock}, and the second within the message where it has one",
        f"{source}: assumed {AIS_SIGMA_M[True]:g} m per axis where the accuracy flag is set, {AIS_SIGMA_M[False]:g} m "
        f"where not, {AIS_RECKONED_SIGMA_M:g} m for dead-reckoned or manually entered positions",
        f"{source}: {HULL_CENTRES}",
        f"{source}: hulls of ships that state none are taken to be {ASSUMED_LENGTH_M[1]:g} m long (class A) or "
        f"{ASSUMED_LENGTH_M[18]:g} m (class B), with the antenna anywhere on them",
    )

"""Raw Mode S: the 7- and 14-byte messages of transponders, with their times.

In lines of text, ``1457996400.25,8D40621D58C382D690C8AC2863A7`` or the same with a blank, or ``@`` and 12 digits of a
12 MHz counter before the message, as AVR receivers write (counted from a start time that the user gives); in JSON lines
with ``timestamp`` and ``frame``, as jet1090 writes; or binary, see :mod:`~sameas.io.sensors.beast`. Positions are
encoded in two alternating halves (CPR); the decoder rs1090 (MIT) combines them and checks the parity. NACp and the
version are in messages of their own, NIC or NUCp in every position message.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, SupportsFloat

import numpy as np

from sameas.arrays import FloatArray
from sameas.errors import InputError, naming, optional
from sameas.io.sensors import beast
from sameas.io.sensors.aircraft import errors_of, identity_of, notes
from sameas.io.sensors.format import (
    FEET_PER_MINUTE_M_PER_S,
    KNOT_M_PER_S,
    SensorFile,
    SensorFormat,
    instant,
    json_lines,
    round_covariance,
    sigma_of_nucp,
    unwrapped,
)
from sameas.tracks.coordinates import FOOT_M
from sameas.tracks.reports import Reports, Unused, of_rows

#: Characters of the longest line, a message and its time (chosen): the patterns take quadratic time.
_LONGEST_LINE = 200
_LINE = re.compile(r"(?:(?P<time>[^,;*@\s][^,;*@]*?)[,;\s]+)?[*@]?(?P<hex>[0-9A-Fa-f]{14,42});?")
_FRAME = re.compile(r"(?:[0-9A-Fa-f]{14}){1,2}")
#: Fields older than this, in seconds, are not joined to a position: velocities, and fields sent rarely (chosen).
_STALE_S, _RARE_STALE_S = 10.0, 120.0
#: The same message again within this time, in seconds, comes from another receiver; transponders send twice a second.
_SAME_MESSAGE_S = 0.2
#: Messages that are remembered for that; above it, the older ones are forgotten.
_REMEMBERED = 10_000
#: Halves of positions older than this, in seconds, are of no use to the decoder.
_HALF_STALE_S = 60.0


@dataclass
class Messages:
    """Messages (n,) in hexadecimal, with their times.

    numbers : of their lines or frames, from 1. time_s : UTC; NaN where not stated. counter_s : seconds of the
    receiver's counter, which starts again after ``period_s``; NaN where it has none. places : (n, 2) latitudes and
    longitudes that the receiver decoded, NaN where not; used where one message says too little, as on the ground.
    unit : of the numbers.
    """

    messages: list[str] = field(default_factory=list)
    numbers: list[int] = field(default_factory=list)
    time_s: FloatArray = field(default_factory=lambda: np.empty(0))
    counter_s: FloatArray = field(default_factory=lambda: np.empty(0))
    places: FloatArray = field(default_factory=lambda: np.empty((0, 2)))
    period_s: float = beast.COUNTER_S
    damaged: list[tuple[int, str]] = field(default_factory=list)
    passed_over: Counter[str] = field(default_factory=Counter)
    unit: str = "line"

    @classmethod
    def of_lines(cls, lines: Sequence[str]) -> Messages:
        """The messages of lines of text, see the module."""
        made, times = cls(), []
        for number, line in enumerate(lines, start=1):
            text = line.strip()
            if not text or text.startswith("#") or (number == 1 and text[0].isalpha() and "," in text):
                # The first line may have column names.
                continue
            match = _LINE.fullmatch(text) if len(text) <= _LONGEST_LINE else None
            digits = match["hex"] if match else ""
            has_counter = "@" in text and len(digits) in (26, 40)
            message = digits[12:] if has_counter else digits
            # Some programs keep the prefix of a Beast receiver: type, counter and signal level.
            message = message[18:] if len(message) in (32, 46) else message
            if len(message) not in (14, 28):
                made.damaged.append((number, "no message of 14 or 28 hexadecimal digits"))
                continue
            utc = instant(match["time"]) if match and match["time"] else None
            made.numbers.append(number)
            made.messages.append(message.lower())
            times.append(
                (np.nan if utc is None else utc, int(digits[:12], 16) / beast.COUNTER_HZ if has_counter else np.nan)
            )
        made.time_s, made.counter_s = np.array(times, np.float64).reshape(-1, 2).T
        made.places = np.full((len(times), 2), np.nan)
        return made

    @classmethod
    def of_json(cls, lines: Sequence[str]) -> Messages:
        """The messages of JSON lines with ``timestamp`` and ``frame``."""
        made, times, places = cls(), [], []
        for number, value in json_lines(lines, made.damaged):
            frame = value.get("frame") if isinstance(value, dict) else None
            when = instant(str(value.get("timestamp", ""))) if isinstance(value, dict) else None
            if not isinstance(frame, str) or not _FRAME.fullmatch(frame) or when is None:
                made.damaged.append((number, "no frame of 14 or 28 hexadecimal digits with its time"))
                continue
            made.numbers.append(number)
            made.messages.append(frame.lower())
            times.append(when)
            lat, lon = (value.get(name) for name in ("latitude", "longitude"))
            is_place = isinstance(lat, float | int) and isinstance(lon, float | int)
            is_place = is_place and abs(lat) <= 90.0 and abs(lon) <= 180.0
            places.append([lat, lon] if is_place else [np.nan, np.nan])
        made.time_s, made.counter_s = np.array(times, np.float64), np.full(len(times), np.nan)
        made.places = np.array(places, np.float64).reshape(-1, 2)
        return made

    @classmethod
    def of_frames(cls, frames: beast.Frames) -> Messages:
        """The messages of Beast frames."""
        counter_s, period_s = beast.seconds_of(frames.counters)
        n = len(frames.messages)
        return cls(
            frames.messages, frames.numbers, np.full(n, np.nan), counter_s, np.full((n, 2), np.nan), period_s,
            frames.damaged, frames.passed_over, "frame",
        )  # fmt: skip

    def received(self, time_s: FloatArray | float) -> Messages:
        """These messages at the times of receipt of their lines or frames (k,), or of all, where they state none."""
        of_numbers = np.asarray(time_s) if np.ndim(time_s) == 0 else np.asarray(time_s)[np.array(self.numbers, int) - 1]
        return replace(self, time_s=np.where(np.isnan(self.time_s), of_numbers, self.time_s))

    @classmethod
    def joined(cls, parts: Sequence[Messages]) -> Messages:
        """The messages of several pieces of a stream, each with a time."""
        return cls(
            [message for part in parts for message in part.messages],
            [number for part in parts for number in part.numbers],
            np.concatenate([part.time_s for part in parts]),
            np.concatenate([part.counter_s for part in parts]),
            np.concatenate([part.places for part in parts]),
            damaged=[one for part in parts for one in part.damaged],
            passed_over=sum((part.passed_over for part in parts), Counter()),
            unit=parts[0].unit,
        )

    def times(self, source: str, start_s: float | None) -> FloatArray:
        """UTC (n,) of the messages, stated or counted from a start.

        Raises InputError: neither is known.
        """
        if np.isfinite(self.time_s).all():
            return self.time_s
        counted = np.isfinite(self.counter_s).all()
        if counted and start_s is not None:
            if self.period_s < beast.COUNTER_S:
                return unwrapped(self.counter_s, self.period_s, start_s)
            seconds = unwrapped(self.counter_s, self.period_s)
            return np.asarray(start_s + seconds - seconds[0])
        n = len(self.messages)
        message = f"{source}: no time in {int((~np.isfinite(self.time_s)).sum())} of {n} messages"
        if counted:
            raise InputError(message, naming(f"give {{start}}, the UTC of the first {self.unit}"))
        raise InputError(message, "write one before every message")


@dataclass
class Aircraft:
    """What the messages of a stream leave for the next ones.

    fields : the latest fields of each aircraft besides positions, with their times, by address and name. halves : the
    latest halves of positions with their times, by address and kind of half. last : the last time of each message.
    """

    fields: dict[str, dict[str, tuple[float, Any]]] = field(default_factory=dict)
    halves: dict[tuple[str, bool, bool], tuple[float, str]] = field(default_factory=dict)
    last: dict[str, float] = field(default_factory=dict)

    def is_repeated(self, message: str, when: float) -> bool:
        """Whether another receiver has had this message; it is remembered."""
        before = self.last.get(message, -np.inf)
        if len(self.last) > _REMEMBERED:
            self.last = {text: time_s for text, time_s in self.last.items() if when - time_s < _SAME_MESSAGE_S}
        self.last[message] = when
        return abs(when - before) < _SAME_MESSAGE_S

    def recent_halves(self, now_s: float) -> list[tuple[float, str]]:
        """Those that the decoder may need, in the order of their times; the others are forgotten."""
        self.halves = {key: half for key, half in self.halves.items() if now_s - half[0] <= _HALF_STALE_S}
        return sorted(self.halves.values())


def read(found: Messages, source: str, start_s: float | None = None, aircraft: Aircraft | None = None) -> Reports:
    """The positions of aircraft in raw messages.

    found : messages.
    source : its name in messages.
    start_s : UTC of the first message, for receivers that only count.
    aircraft : for a stream, what earlier messages left; updated.

    Raises InputError: rs1090 is not installed; no message; no time; no position.
    """
    unused = Unused(list(found.damaged), Counter(found.passed_over), found.unit)
    if not found.messages:
        raise unused.refusal(f"{source}: no Mode S message: {unused.reasons()}")
    aircraft = Aircraft() if aircraft is None else aircraft
    times = found.times(source, start_s).tolist()
    rows = []
    all_decoded = _decoded(found.messages, times, aircraft)
    for number, when, place, decoded in zip(found.numbers, times, found.places.tolist(), all_decoded, strict=True):
        if decoded is None:
            unused.damaged.append((number, "not Mode S, or wrong parity"))
            continue
        if decoded.get("df") not in ("17", "18"):
            unused.passed_over[f"downlink format {decoded.get('df')}"] += 1
            continue
        if aircraft.is_repeated(decoded["frame"], when):
            unused.passed_over["message of a second receiver"] += 1
            continue
        fields = aircraft.fields.setdefault(decoded["icao24"], {})
        fields |= {name: (when, value) for name, value in _fields(decoded).items()}
        if "lat_cpr" not in decoded:
            unused.passed_over[f"message of register {decoded.get('bds')}"] += 1
            continue
        if decoded.get("latitude") is not None:
            place = [decoded["latitude"], decoded["longitude"]]
        if np.isnan(place).any():
            unused.passed_over["half a position"] += 1
            continue
        rows.append({"line": number, "time_s": when, **_report(decoded, place, fields, when)})
    if not rows:
        raise unused.refusal(
            f"{source}: no position in {len(found.messages)} messages; two halves within 10 s make one"
        )
    columns = of_rows(rows)
    columns |= _errors(columns)
    return unused.reports(source, "adsb", columns, notes(source))


def _decoder() -> Callable[..., Any]:
    with optional("raw Mode S messages need rs1090", "targets"):
        from rs1090 import decode
    return decode


def _decoded(messages: Sequence[str], times: Sequence[float], aircraft: Aircraft) -> list[Mapping[str, Any] | None]:
    """The decoded messages; None where the parity is wrong."""
    before = aircraft.recent_halves(times[0])
    texts = [*(message for _, message in before), *messages]
    stamps = [*(when for when, _ in before), *times]
    # One batch, since the halves of a position are combined within a batch. The decoder omits broken messages.
    decoded = [one for one in _decoder()(texts, stamps, batch=len(texts)) if one]
    by_message: list[Mapping[str, Any] | None] = []
    at = 0
    for message, when in zip(texts, stamps, strict=True):
        matches = at < len(decoded) and decoded[at]["frame"] == message and decoded[at]["timestamp"] == when
        by_message.append(decoded[at] if matches else None)
        at += matches
    for message, when, one in zip(texts, stamps, by_message, strict=True):
        if one is not None and "lat_cpr" in one:
            aircraft.halves[one["icao24"], one.get("bds") == "06", one.get("parity") == "odd"] = when, message
    return by_message[len(before) :]


def _fields(decoded: Mapping[str, Any]) -> dict[str, Any]:
    """The fields of a message besides a position, by column."""
    values = {
        "callsign": str(decoded.get("callsign") or "").strip() or None,
        "mode_a": decoded.get("squawk"),
        "version": decoded.get("version"),
        "nac_p": decoded.get("NACp"),
        "nac_v": decoded.get("NACv"),
        "speed_m_per_s": _scaled(decoded.get("groundspeed"), KNOT_M_PER_S),
        "course_deg": decoded.get("track"),
        "climb_m_per_s": _scaled(decoded.get("vertical_rate"), FEET_PER_MINUTE_M_PER_S),
        "above_pressure_m": _scaled(decoded.get("geo_minus_baro"), FOOT_M),
    }
    return {name: value for name, value in values.items() if value is not None}


def _report(
    decoded: Mapping[str, Any], place: Sequence[float], fields: Mapping[str, tuple[float, Any]], when: float
) -> dict[str, Any]:
    rare = ("callsign", "mode_a", "version", "nac_p", "nac_v")
    row = {n: v for n, (time_s, v) in fields.items() if when - time_s <= (_RARE_STALE_S if n in rare else _STALE_S)}
    height = _scaled(decoded.get("altitude"), FOOT_M)
    barometric = decoded.get("source") != "GNSS"
    difference = row.get("above_pressure_m")
    geometric = height if not barometric else None
    if barometric and height is not None and difference is not None:
        geometric = height + difference
    return {
        **identity_of(decoded["icao24"]),
        **row,
        "lat_deg": place[0],
        "lon_deg": place[1],
        "pressure_alt_m": height if barometric else None,
        "alt_m": geometric,
        "on_ground": float(decoded.get("bds") == "06"),
        "nuc_p": decoded.get("NUCp"),
    }


def _scaled(value: str | SupportsFloat | None, unit: float) -> float | None:
    return None if value is None else float(value) * unit


def _errors(columns: Mapping[str, Any]) -> dict[str, Any]:
    """Covariances from NACp where it was sent, else from NUCp of the message type."""
    errors = errors_of(columns)
    by_kind = round_covariance(sigma_of_nucp(columns.get("nuc_p", np.full(len(columns["time_s"]), np.nan))))
    missing = ~np.isfinite(errors["covariance_m2"][:, 0])
    return errors | {"covariance_m2": np.where(missing[:, None], by_kind, errors["covariance_m2"])}


def _read_file(file: SensorFile) -> list[Reports]:
    if beast.looks_like(file.content):
        found = Messages.of_frames(beast.split_frames(file.content, final=True))
    elif _is_json(file):
        found = Messages.of_json(file.lines)
    else:
        found = Messages.of_lines(file.lines)
    return [read(found, file.source, file.start_s)]


#: The beginning of a JSON line with a message.
IN_JSON = r'\{[^\n]{0,2000}?"frame"\s{0,9}:\s{0,9}"(?:[0-9A-Fa-f]{14}){1,2}"'


def _is_json(file: SensorFile) -> bool:
    found = [line.endswith("}") and re.match(IN_JSON, line) is not None for line in file.head_lines]
    return sum(found) > 0.5 * max(len(found), 1)


FORMAT = SensorFormat(
    "mode-s",
    "raw Mode S messages with times: hexadecimal, JSON lines of jet1090, or Beast",
    _read_file,
    lambda file: (
        beast.looks_like(file.head)
        or _is_json(file)
        or file.share_of_lines(rf"(?=.{{14,{_LONGEST_LINE}}}$)" r"(?:[^,;*@]+[,;\s]+)?[*@]?[0-9A-Fa-f]{14,42};?") > 0.5
    ),
)

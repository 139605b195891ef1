"""Raw Mode S: the 14-byte messages of transponders in hexadecimal, one per line with its time.

``1457996400.25,8D40621D58C382D690C8AC2863A7`` or the same with a blank; ``@`` and 12 digits of a 12 MHz counter before
the message, as AVR receivers write (counted from a start time that the user gives). Positions are encoded in two
alternating halves (CPR); the decoder rs1090 (MIT) combines them and checks the parity. NACp and the version are in
messages of their own, NIC or NUCp in every position message.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any, SupportsFloat

import numpy as np

from sameas.errors import InputError, naming, optional
from sameas.io.sensors.aircraft import errors_of, identity_of, notes
from sameas.io.sensors.format import (
    FEET_PER_MINUTE_M_PER_S,
    KNOT_M_PER_S,
    SensorFormat,
    instant,
    round_covariance,
    sigma_of_nucp,
    unwrapped,
)
from sameas.tracks.coordinates import FOOT_M
from sameas.tracks.reports import Damaged, Reports, of_rows

#: Characters of the longest line, a message and its time (chosen): the patterns take quadratic time.
_LONGEST_LINE = 200
_LINE = re.compile(r"(?:(?P<time>[^,;*@\s][^,;*@]*?)[,;\s]+)?[*@]?(?P<hex>[0-9A-Fa-f]{14,42});?")
_COUNTER_HZ = 12e6
_COUNTER_S = 2.0**48 / _COUNTER_HZ
#: Fields older than this, in seconds, are not joined to a position: velocities, and fields sent rarely (chosen).
_STALE_S, _RARE_STALE_S = 10.0, 120.0


def read(lines: Sequence[str], source: str, start_s: float | None = None) -> Reports:
    """The positions of aircraft in raw messages.

    Parameters
    ----------
    lines : one message each, see the module.
    source : its name in messages.
    start_s : UTC of the first line, for receivers that only count.

    Raises
    ------
    InputError : rs1090 is not installed; no message; no time; no position.
    """
    numbers, messages, times, damaged = _messages(lines)
    if not messages:
        raise InputError(f"{source}: no Mode S message: {'; '.join(Damaged.of(damaged).sentences())}")
    time_s = _times(times, source, start_s)
    passed_over: Counter[str] = Counter()
    by_aircraft: dict[str, dict[str, tuple[float, Any]]] = {}
    rows = []
    for number, when, decoded in zip(numbers, time_s.tolist(), _decoded(messages, time_s.tolist()), strict=True):
        if decoded is None:
            damaged.append((number, "not Mode S, or wrong parity"))
            continue
        if decoded.get("df") not in ("17", "18"):
            passed_over[f"downlink format {decoded.get('df')}"] += 1
            continue
        fields = by_aircraft.setdefault(decoded["icao24"], {})
        fields |= {name: (when, value) for name, value in _fields(decoded).items()}
        if decoded.get("latitude") is not None:
            rows.append({"line": number, "time_s": when, **_report(decoded, fields, when)})
        else:
            passed_over["half a position" if "lat_cpr" in decoded else f"message of register {decoded.get('bds')}"] += 1
    if not rows:
        raise InputError(f"{source}: no position in {len(messages)} messages; two halves within 10 s make one")
    columns = of_rows(rows)
    columns |= _errors(columns)
    return Reports.of(
        source, "adsb", columns, damaged=Damaged.of(damaged), passed_over=passed_over, notes=notes(source)
    )


def _messages(lines: Sequence[str]) -> tuple[list[int], list[str], list[tuple[float, float]], list[tuple[int, str]]]:
    """Numbers of lines, messages, their times as (UTC, counter), and the damaged lines."""
    numbers, messages, times = [], [], []
    damaged = []
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
            damaged.append((number, "no message of 14 or 28 hexadecimal digits"))
            continue
        utc = instant(match["time"]) if match and match["time"] else None
        numbers.append(number)
        messages.append(message.lower())
        times.append((np.nan if utc is None else utc, int(digits[:12], 16) / _COUNTER_HZ if has_counter else np.nan))
    return numbers, messages, times, damaged


def _times(times: Sequence[tuple[float, float]], source: str, start_s: float | None) -> np.ndarray:
    utc, counter = np.array(times).T
    if np.isfinite(utc).all():
        return np.asarray(utc)
    if np.isfinite(counter).all() and start_s is not None:
        counted = unwrapped(counter, _COUNTER_S)
        return np.asarray(start_s + counted - counted[0])
    message = f"{source}: no time in {int((~np.isfinite(utc)).sum())} of {len(utc)} messages"
    if np.isfinite(counter).all():
        raise InputError(message, naming("give {start}, the UTC of the first line"))
    raise InputError(message, "write one before every message")


def _decoder() -> Callable[..., Any]:
    with optional("raw Mode S messages need rs1090", "targets"):
        from rs1090 import decode
    return decode


def _decoded(messages: Sequence[str], times: Sequence[float]) -> list[Mapping[str, Any] | None]:
    """The decoded messages; None where the parity is wrong."""
    # One batch, since the halves of a position are combined within a batch. The decoder omits broken messages.
    decoded = [one for one in _decoder()(messages, times, batch=len(messages)) if one]
    by_message: list[Mapping[str, Any] | None] = []
    at = 0
    for message, when in zip(messages, times, strict=True):
        matches = at < len(decoded) and decoded[at]["frame"] == message and decoded[at]["timestamp"] == when
        by_message.append(decoded[at] if matches else None)
        at += matches
    return by_message


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


def _report(decoded: Mapping[str, Any], fields: Mapping[str, tuple[float, Any]], when: float) -> dict[str, Any]:
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
        "lat_deg": decoded["latitude"],
        "lon_deg": decoded["longitude"],
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


FORMAT = SensorFormat(
    "mode-s",
    "raw Mode S messages in hexadecimal, with times",
    lambda file: [read(file.lines, file.source, file.start_s)],
    lambda file: (
        file.share_of_lines(rf"(?=.{{14,{_LONGEST_LINE}}}$)" r"(?:[^,;*@]+[,;\s]+)?[*@]?[0-9A-Fa-f]{14,42};?") > 0.5
    ),
)

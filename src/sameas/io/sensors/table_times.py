"""The times of tables of reports: dates, times of day and numbers, in UTC or a stated zone."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from functools import partial
from typing import Any, SupportsFloat

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import BoolArray, FloatArray
from sameas.errors import InputError, UndatedTimes, naming
from sameas.io.sensors.format import DAY_S, instant, seconds, unwrapped, utc_of
from sameas.io.sensors.languages import DATES, HOURS, plain
from sameas.io.sensors.table_cells import TableText, of_each
from sameas.io.sensors.table_columns import Choice, stem_of

#: Numbers below it, in seconds, are times from an origin of their own, not since 1970.
FIRST_S = 1e8
#: Columns of tables whose dates like 01/05/2024 have the day first: Danish AIS.
_DAY_FIRST_TABLES = ("typeofmobile",)
_DAY_FIRST = re.compile(r"(\d{1,2})[/.-](\d{1,2})[/.-](\d{4})[ T]+(\d{1,2}):(\d{2})(?::(\d{2}(?:\.\d+)?))?")
_OF_DAY = re.compile(r"(\d{1,2}):(\d{2}):(\d{2}(?:\.\d+)?)")
#: A date and a time of day that look like a number.
_FOURTEEN = re.compile(r"(?:19|20)\d{12}(?:\.\d+)?")
#: The offset of a time zone at the end of ISO text; Z is UTC.
_ZONE = re.compile(r"T.*[+-]\d\d:?\d\d$| .*:\d\d[+-]\d\d:?\d\d$")


def times_of(
    cells: TableText, chosen: Mapping[str, Choice], source: str, start_s: float | None, time_zone: str | None
) -> tuple[FloatArray, str]:
    """The time of each row, and a note on its interpretation."""
    choice = chosen.get("time_s") or chosen["day_s"]
    column = list(cells.columns[choice.name])
    known = (*choice.quantity.names, *choice.quantity.translations)
    parts = [
        next((name for word in words for name in cells.columns if plain(name) == word), None)
        for words in (DATES, [word for word in HOURS if word in known])
    ]
    if choice.name in parts and None not in parts:
        days, hours = (cells.columns[str(part)] for part in parts)
        column = [f"{day} {hour}" for day, hour in zip(days, hours, strict=True)]
    column = _in_24_hours(column)
    if choice.quantity.column == "time_s":
        if (serial := _serial_days(cells, choice)) is not None:
            program, days_since_1970 = serial
            return days_since_1970 * DAY_S, f"{source}: {choice.name} is read as days of {program}, UTC"
        # Of the languages that are read, only English has the month first.
        day_first = any("".join(stem_of(name)) in _DAY_FIRST_TABLES for name in cells.columns)
        day_first = day_first or any(one.translated for one in chosen.values())
        times = _instants(column, choice, source, start_s, day_first)
        if np.isfinite(times).any():
            if float(np.nanmax(np.abs(times))) < FIRST_S:
                note = "seconds from an origin of its own: all sources must use the same origin"
                return times, f"{source}: {choice.name} is read as {note}"
            offset, local = _zones(column)
            times[local] = utc_of(times[local], time_zone)
            zone = "UTC" if time_zone is None or not local.any() else f"the time of {time_zone}"
            if offset.any():
                others = f" that {offset.sum()} of {len(column)} rows state, the others as {zone}"
                zone = "the time of its stated zone" if offset.all() else f"the time of the zone{others}"
            return times, f"{source}: {choice.name} is read as {zone}"
    times = np.array([_seconds_of_day(cell) for cell in column])
    if not np.isfinite(times).any():
        raise InputError(
            f"{source}: no time can be read in column {choice.name!r} (first: {column[0]!r}); write ISO 8601"
        )
    if start_s is None:
        raise UndatedTimes(
            f"{source}: {choice.name!r} has the time of day only", naming("give {start}, the UTC date of the first row")
        )
    # The start is UTC, the times are of the zone.
    start_s += start_s - float(utc_of(np.array([start_s]), time_zone)[0])
    zone = time_zone or "UTC"
    note = f"{source}: {choice.name} is read as {zone} time of day, counted on from the start"
    return utc_of(unwrapped(times, DAY_S, start_s), time_zone), note


#: The number of the first day of 1970 in programs that count days, and those of the days that are times of reports.
_DAYS_OF_1970, _DAYS_SINCE_1970 = {"Excel": 25569.0, "MATLAB": 719529.0}, (0.0, 47_482.0)  # until 2100
#: Numbers with smaller steps are days: seconds have larger ones.
_STEP_OF_DAYS = 0.005


def _serial_days(cells: TableText, choice: Choice) -> tuple[str, FloatArray] | None:
    """The times of a table in days since 1970, if they are days of a program, and its name.

    Those of Expedition are; others without a unit are if their steps are small.
    """
    stem, unit = stem_of(choice.name)
    if unit:
        return None
    is_expedition = stem == "utc" and any(stem_of(name)[0] == "boat" for name in cells.columns)
    try:
        numbers = np.array(cells.columns[choice.name], np.float64)
    except (TypeError, ValueError):
        return None
    steps = np.diff(np.unique(numbers[np.isfinite(numbers)]))
    if not len(numbers) or not (is_expedition or (len(steps) and np.median(steps) < _STEP_OF_DAYS)):
        return None
    for program, first in _DAYS_OF_1970.items():
        low, high = _DAYS_SINCE_1970
        if low < np.nanmin(numbers) - first and np.nanmax(numbers) - first < high:
            return program, numbers - first
    return None


#: Rows of the first numbers by which milliseconds are told from seconds; instants that they need at least; steps of
#: milliseconds between these at least, if nothing is known of the motion, and at most: 25 scans a second, one in 5 s.
_ROWS, _INSTANTS, _LEAST_STEP, _MOST_STEP = 20_000, 10, 40.0, 5000.0
#: Speeds in m/s: nothing slower is under way, and nothing is faster.
_SLOW_M_PER_S, _FAST_M_PER_S = 0.1, 1000.0


def milliseconds(time_s: FloatArray, track: NDArray[Any] | None, place: FloatArray) -> bool:
    """Whether numbers (n,) from an origin of their own, whose column states no unit, are milliseconds, not seconds.

    track : (n,) ids of the objects, or None. place : (n, 2) positions in metres. Scans are not 40 s or more apart, and
    whole numbers that are so far apart are milliseconds; where ids show motion, if it is one of 0.1 to 1000 m/s with
    milliseconds, and slower with seconds.

    >>> t = np.repeat(np.arange(0.0, 3000.0, 100.0), 2)
    >>> milliseconds(t, None, np.zeros((60, 2))), milliseconds(t / 100.0, None, np.zeros((60, 2)))
    (True, False)
    """
    order = np.argsort(time_s[:_ROWS], kind="stable")
    time_s, place = time_s[:_ROWS][order], place[:_ROWS][order]
    instants = np.unique(time_s[np.isfinite(time_s)])
    if len(instants) < _INSTANTS or (instants % 1.0).any():
        return False
    step = float(np.median(np.diff(instants)))
    if track is None:
        return _LEAST_STEP <= step <= _MOST_STEP
    of = np.unique(track[:_ROWS][order].astype(str), return_inverse=True)[1]
    by_track = np.argsort(of, kind="stable")
    dt = np.diff(time_s[by_track])
    moved = np.hypot(*np.diff(place[by_track], axis=0).T)
    known = (np.diff(of[by_track]) == 0) & (dt > 0.0) & np.isfinite(moved)
    if np.count_nonzero(known) < _INSTANTS:
        return False
    speed = float(np.median(moved[known] / dt[known]))
    return step > 1.0 and speed < _SLOW_M_PER_S and _SLOW_M_PER_S <= 1000.0 * speed <= _FAST_M_PER_S


def _zones(column: Sequence[Any]) -> tuple[BoolArray, BoolArray]:
    """(n,) whether a cell states an offset from UTC, and whether it is a clock time without a zone."""
    stated = np.array(of_each(_zone, column), bool).reshape(-1, 2)
    return stated[:, 0], stated[:, 1]


def _zone(cell: Any) -> tuple[bool, bool]:
    text = "" if cell is None or isinstance(cell, (int, float)) else str(cell).strip()
    offset = _ZONE.search(text) is not None
    return offset, not offset and ":" in text and re.search(r"(?i)(Z|UTC|GMT)$", text) is None


#: A time of day of twelve hours, and a date with the name of its month.
_TWELVE_HOURS = re.compile(r"(?i)(.*?)(\d{1,2})(:\d{2}(?::\d{2}(?:\.\d+)?)?)\s*([ap])\.?m\.?")
_NAMED_MONTH = re.compile(r"(\d{1,2})[ /-]([A-Za-z]{3})[a-z]*[ /-](\d{4})\b(.*)")
_MONTHS = ("jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec")


def _in_24_hours(column: list[Any]) -> list[Any]:
    """The cells with hours of 24 and months as numbers, as far as these are written otherwise.

    >>> _in_24_hours(["5/14/2024 12:30:05 AM", "14-May-2024 09:30:12.5 PM", "1:02:03 pm"])
    ['5/14/2024 00:30:05', '2024-05-14 21:30:12.5', '13:02:03']
    """
    if not any(isinstance(cell, str) and re.search("[A-Za-z]{2}", cell) for cell in column[:100]):
        return column
    return [_rewritten(cell.strip()) if isinstance(cell, str) else cell for cell in column]


def _rewritten(text: str) -> str:
    if twelve := _TWELVE_HOURS.fullmatch(text):
        hour = int(twelve[2]) % 12 + (12 if twelve[4].lower() == "p" else 0)
        text = f"{twelve[1]}{hour:02d}{twelve[3]}"
    if (named := _NAMED_MONTH.fullmatch(text)) and named[2].lower() in _MONTHS:
        text = f"{named[3]}-{_MONTHS.index(named[2].lower()) + 1:02d}-{int(named[1]):02d}{named[4]}"
    return text


def _instants(column: Sequence[Any], choice: Choice, source: str, start_s: float | None, day_first: bool) -> FloatArray:
    """Times in seconds, from numbers, ISO text or dates like 13/01/2024; NaN where a cell is none of these.

    day_first : whether dates of two readings have the day first.
    """
    try:
        numbers = np.array(column, dtype=np.float64)
        if any(isinstance(cell, str) and ("_" in cell or _FOURTEEN.fullmatch(cell.strip())) for cell in column[:100]):
            raise ValueError
    except (TypeError, ValueError, OverflowError):
        texts = ["" if cell is None else str(cell).strip() for cell in column]
        if any(_DAY_FIRST.fullmatch(text) for text in texts[:100]):
            return _day_month_dates(texts, source, start_s, day_first)
        return np.array([np.nan if time_s is None else time_s for time_s in of_each(instant, texts)])
    if choice.factor in (1.0, 0.0):
        return np.array([seconds(number) for number in numbers])
    return numbers * choice.factor


def _day_month_dates(texts: Sequence[str], source: str, start_s: float | None, always_day_first: bool) -> FloatArray:
    """Times from dates like 13/01/2024 12:00:00. A number above 12 shows which one is the day, else the kind of table
    does, the start, or points between the numbers: these are written day first (DIN 5008, and wherever dates have
    points)."""
    day_first, month_first = (np.array(of_each(partial(_of_date, day=day), texts)) for day in (1, 2))
    readable = [np.isfinite(day_first), np.isfinite(month_first)]
    only = [bool((readable[k] & ~readable[1 - k]).any()) for k in (0, 1)]
    if only[0] and only[1]:
        raise InputError(f"{source}: some dates have the day first, others the month", "write them as 2024-01-13")
    if only[0] or only[1]:
        return day_first if only[0] else month_first
    if not np.array_equal(day_first, month_first, equal_nan=True):
        if always_day_first or (start_s is None and all("." in text[:3] for text in texts if text)):
            return day_first
        if start_s is None:
            example = next(text for text in texts if _DAY_FIRST.fullmatch(text))
            raise InputError(
                f"{source}: dates like {example!r} can be read in two ways",
                naming("give {start}, the UTC date of the first row, or write them as 2024-01-13"),
            )
        return min(day_first, month_first, key=lambda times: abs(float(times[np.isfinite(times)][0]) - start_s))
    return day_first


def _of_date(text: str, day: int) -> float:
    """The time of a date like 13/01/2024 12:00:00 whose ``day``-th number is the day; NaN where it is none."""
    match = _DAY_FIRST.fullmatch(text)
    if match is None:
        return np.nan
    try:
        moment = datetime(int(match[3]), int(match[3 - day]), int(match[day]), int(match[4]), int(match[5]), tzinfo=UTC)
    except ValueError:
        return np.nan
    return moment.timestamp() + float(match[6] or 0.0)


def _seconds_of_day(cell: str | SupportsFloat) -> float:
    match = _OF_DAY.fullmatch(str(cell).strip())
    if match:
        return 3600.0 * int(match[1]) + 60.0 * int(match[2]) + float(match[3])
    try:
        return float(cell)
    except (TypeError, ValueError, OverflowError):
        return np.nan

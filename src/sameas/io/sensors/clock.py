"""Clock: times in the notations of logs, and wrapped times unwrapped."""

from __future__ import annotations

from datetime import UTC, datetime

import numpy as np
from numpy.typing import ArrayLike

from sameas.arrays import FloatArray
from sameas.errors import Argument, InputError, Message
from sameas.tracks.reports import LAST_S

#: Units of ships and aircraft in metres and seconds.
MILE_M = 1852.0
FOOT_M = 0.3048
KNOT_M_PER_S = MILE_M / 3600.0
FEET_PER_MINUTE_M_PER_S = FOOT_M / 60.0


DAY_S = 86400.0
#: Numbers above these are milliseconds, microseconds, nanoseconds since 1970: as seconds they lie beyond the year 5138.
_FINER_UNITS = ((1e17, 1e9), (1e14, 1e6), (1e11, 1e3))


def instant(text: str) -> float | None:
    """UTC seconds since 1970 from ISO 8601 text or a number of (milli-, micro-, nano-) seconds; None for other text.

    Text without a zone is UTC.

    Example
    -------
    >>> instant("2016-01-12 13:02:11.5"), instant("1452603731500"), instant("radar")
    (1452603731.5, 1452603731.5, None)
    """
    cell = text.strip()
    try:
        number = seconds(float(cell))
        return number if abs(number) <= LAST_S else None
    except ValueError:
        pass
    try:
        moment = datetime.fromisoformat(cell)
        return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()
    except (ValueError, OverflowError):
        return None


def seconds(number: float) -> float:
    """Seconds, from a number in seconds, milliseconds, microseconds or nanoseconds, by its size."""
    for above, unit in _FINER_UNITS:
        if abs(number) > above:
            return number / unit
    return number


def start_seconds(start: str | float | None, source: str) -> float | None:
    """UTC in seconds of the first line of a file, from the user's option."""
    if start is None or isinstance(start, (int, float)):
        return start if start is None else float(start)
    start_s = instant(start)
    if start_s is None:
        raise InputError(
            f"{source}: start={start!r} is not an instant; give a date or a time like 2024-05-01T13:00:00Z"
        )
    return start_s


def unwrapped(values: ArrayLike, period_s: float, start_s: float | None = None) -> FloatArray:
    """Times (n,) without the wrap-around of ``values`` after every period.

    values : (n,) seconds of the day, of the minute …; NaN stays NaN.
    start_s : the first value is placed in the period nearest to this time; a start at midnight is a date only, and the
        first value is placed on that day. None: the first period starts at 0.

    Each value is placed in the period in which it is nearest to the previous one, so values out of order by less than
    half a period are placed correctly.

    Example
    -------
    >>> unwrapped([86399.0, 2.0, 86398.0, 5.0], 86400.0).tolist()
    [86399.0, 86402.0, 86398.0, 86405.0]
    """
    values = np.asarray(values, dtype=np.float64)
    rows = np.flatnonzero(np.isfinite(values))
    out = np.full(len(values), np.nan)
    if not len(rows):
        return out
    finite = values[rows]
    steps = np.diff(finite)
    wraps = np.concatenate([[0.0], np.cumsum(-np.round(steps / period_s))])
    begin = 0.0
    if start_s is not None:
        date_only = period_s == DAY_S and start_s % DAY_S == 0.0
        begin = start_s if date_only else period_s * np.round((start_s - finite[0]) / period_s)
    out[rows] = begin + finite + period_s * wraps
    return out


def forward_filled(values: FloatArray) -> FloatArray:
    """(n,) the latest finite value at each position; before the first one, that one. All NaN where there is none."""
    rows = np.flatnonzero(np.isfinite(values))
    if not len(rows):
        return values
    last = np.searchsorted(rows, np.arange(len(values)), side="right") - 1
    return np.asarray(values[rows[np.maximum(last, 0)]])


def at_second(clock_s: FloatArray, second: FloatArray) -> FloatArray:
    """Times of positions (n,), from the receive times ``clock_s`` (n,) and the UTC seconds within the minute (n,).

    The latest time with this second that is at most 5 s after the receive time; the receive time where the
    second is NaN.
    """
    age = np.mod(clock_s - second, 60.0)
    age = np.where(age > 55.0, age - 60.0, age)
    return np.where(np.isfinite(second), clock_s - age, clock_s)


def picture_time(text: str | float, argument: str, span_s: tuple[float, float]) -> float:
    """Seconds, from ISO text, seconds (since 1970 or of another clock), or HH:MM[:SS] of the first day."""
    text = str(text)
    time_s = _of_day(text, span_s)
    time_s = instant(text) if time_s is None else time_s
    if time_s is None:
        words = Message(Argument(argument, text), ": give a time such as 2024-05-01T13:00:00Z, 13:00, or seconds")
        raise InputError(words)
    return time_s


def _of_day(text: str, span_s: tuple[float, float]) -> float | None:
    """Seconds, from HH:MM[:SS] on the day of the first report, or on the next day if only that is in the span."""
    for form in ("%H:%M", "%H:%M:%S"):
        try:
            clock = datetime.strptime(text.removesuffix("Z"), form)
        except ValueError:
            continue
        moment = span_s[0] - span_s[0] % DAY_S + clock.hour * 3600.0 + clock.minute * 60.0 + clock.second
        return moment + DAY_S if moment < span_s[0] and moment + DAY_S <= span_s[1] else moment
    return None

"""Instant: the middle of an exposure, from the keywords that observatories really write.

In the order in which they are believed: the middle of the exposure; its start and its end; its start and its
duration. DATE-OBS with a time of day is believed before MJD-OBS and JD, which are often of another moment; where
they differ by more than the exposure, a line says so. The scale is that of TIMESYS, UTC without one.
"""

from __future__ import annotations

import math
import re
import warnings
from datetime import datetime
from typing import TYPE_CHECKING

from sameas.sky.frame.cards import Card, Cards

if TYPE_CHECKING:
    from astropy.time import Time

_MIDDLE = ("DATE-AVG", "DATE-MID", "DATE_MID", "MIDPOINT", "MJD-AVG", "MJD-MID", "MJD_MID", "JD-MID", "JD_MID", "JDMID")
_START = ("DATE-OBS", "DATE_OBS", "DATE-BEG", "DATE-STA", "DATEOBS", "UTSTART")
_END = ("DATE-END", "DATE_END", "MJD-END", "EXPEND")
_CLOCK = ("TIME-OBS", "TIME_OBS", "UT", "UTC", "UTC-OBS", "UT-OBS", "UT-START", "UTSTART", "TIME-BEG", "TIME", "UTIME")
_COUNTED = ("MJD-OBS", "MJD_OBS", "MJD-BEG", "EXPSTART", "MJD", "MJD-STR", "JD", "JD-OBS", "JULDAT", "JULIAN", "JD_UTC")
_SCALES = {"UTC": "utc", "UT": "utc", "GMT": "utc", "TDB": "tdb", "TT": "tt", "TDT": "tt", "TAI": "tai", "TCB": "tcb"}
_SCALES |= {"TCG": "tcg", "UT1": "ut1"}
_ISO = re.compile(r"^(\d{4})[-/](\d{1,2})[-/](\d{1,2})(?:[T\s]+(\S.*?)Z?)?$")
_OLD = re.compile(r"^(\d{1,2})[/-](\d{1,2})[/-](\d{2}|\d{4})$")
_FIRST_UTC_YEAR = 1960
# TT − UT in seconds before there was UTC (Espenak & Meeus 2006, NASA/TP-2006-214141, from Morrison & Stephenson 2004).
_DELTA_T = (
    (1880, -5.0),
    (1900, -2.7),
    (1910, 10.4),
    (1920, 21.2),
    (1930, 24.0),
    (1940, 24.3),
    (1950, 29.1),
    (1960, 33.2),
)
_S_PER_DAY = 86400.0


def middle(cards: Cards, exposure_s: float) -> tuple[Time | None, tuple[str, ...]]:
    """The middle of the exposure, None where the header does not tell, and the lines that say how it was read.

    exposure_s : NaN if it is not known; the start then stands for the middle, and a line says so.
    """
    scale, lines = _scale(cards)
    for card in cards.all(_MIDDLE):
        day = _day(card, cards)
        if day is not None:
            return _told(day, scale, f"middle of the exposure ({card.name})", lines)
    start = _start(cards)
    if start is None:
        return None, ()
    card, day, remark = start
    if card.says(r"\bmid"):
        return _told(day, scale, f"middle of the exposure ({card.name}, as its comment says)", lines)
    lines += remark + _disagreement(cards, card, day, exposure_s)
    for end in cards.all(_END):
        last = _day(end, cards)
        if last is not None and last > day:
            return _told((day + last) / 2, scale, f"midway between {card.name} and {end.name}", lines)
    if not math.isfinite(exposure_s):
        return _told(
            day, scale, f"start ({card.name})", (*lines, "assumed: exposure unknown, its start is taken for its middle")
        )
    return _told(day + exposure_s / 2 / _S_PER_DAY, scale, f"start ({card.name}) and half the exposure", lines)


def _told(day: float, scale: str, how: str, lines: tuple[str, ...]) -> tuple[Time, tuple[str, ...]]:
    from astropy.time import Time

    year = 1858.8 + day / 365.25
    if scale == "utc" and year < _FIRST_UTC_YEAR:
        years, seconds = zip(*_DELTA_T, strict=True)
        delta = _between(year, years, seconds)
        day, scale = day + delta / _S_PER_DAY, "tt"
        lines = (*lines, f"assumed: universal time, turned into TT by {delta:+.1f} s (there was no UTC before 1960)")
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*dubious year")
        whole = math.floor(day)
        time = Time(whole, day - whole, format="mjd", scale=scale)
        text = time.isot
    return time, (f"middle of the exposure {text} {scale.upper()}: {how}", *lines)


def _between(x: float, xs: tuple[float, ...], ys: tuple[float, ...]) -> float:
    import numpy as np

    return float(np.interp(x, xs, ys))


def _scale(cards: Cards) -> tuple[str, tuple[str, ...]]:
    card = cards.first(("TIMESYS",))
    if card is None:
        return "utc", ("assumed: times are UTC (no TIMESYS)",)
    name = card.text().upper()
    if name in _SCALES:
        return _SCALES[name], ()
    return "utc", (f"assumed: times are UTC (TIMESYS = {card.text()!r} is not known)",)


def _start(cards: Cards) -> tuple[Card, float, tuple[str, ...]] | None:
    """The card of the start, its MJD, and what was assumed."""
    dates = [(card, _date(card.text())) for card in cards.all(_START)]
    for card, date in dates:
        if date is not None and date[1] is not None:
            return card, date[0] + date[1], ()
    dated = next(((card, date[0]) for card, date in dates if date is not None), None)
    if dated is not None:
        for clock in cards.all(_CLOCK):
            share = _time_of_day(clock.text())
            if share is not None:
                return Card(f"{dated[0].name} and {clock.name}", None, clock.comment), dated[1] + share, ()
    for card in cards.all(_COUNTED):
        day = _day(card, cards)
        if day is not None:
            return card, day, ()
    if dated is not None:
        return dated[0], dated[1] + 0.5, (f"assumed: 12:00, for {dated[0].name} has no time of day; up to 12 h wrong",)
    return None


def _day(card: Card, cards: Cards) -> float | None:
    """MJD of a card that holds an MJD, a JD or a date with a time; None for anything else."""
    value = card.number()
    if math.isfinite(value):
        if value > 2_000_000:
            return value - 2_400_000.5
        return value if 0 < value < 100_000 and "JD" in card.name + "MJD" * card.name.startswith("EXP") else None
    date = _date(card.text())
    return date[0] + date[1] if date is not None and date[1] is not None else None


def _date(text: str) -> tuple[float, float | None] | None:
    """MJD of the day and share of the day, None where it is not told."""
    iso, old = _ISO.match(text), _OLD.match(text)
    if iso:
        year, month, day, clock = int(iso[1]), int(iso[2]), int(iso[3]), iso[4]
    elif old:
        # The rule of FITS before 2000: two digits are a year of the twentieth century.
        year, month, day, clock = int(old[3]) + (1900 if len(old[3]) == 2 else 0), int(old[2]), int(old[1]), None
    else:
        return None
    try:
        mjd = float((datetime(year, month, day) - datetime(1858, 11, 17)).days)
    except ValueError:
        return None
    return mjd, None if clock is None else _time_of_day(clock)


def _time_of_day(text: str) -> float | None:
    match = re.match(r"^(\d{1,2})[:\s](\d{1,2})(?:[:\s](\d{1,2}(?:\.\d*)?))?", text.strip())
    if match is None:
        return None
    hours, minutes, seconds = int(match[1]), int(match[2]), float(match[3] or 0.0)
    if hours > 24 or minutes > 59 or seconds >= 61:
        return None
    return (hours * 3600 + minutes * 60 + seconds) / _S_PER_DAY


def _disagreement(cards: Cards, used: Card, day: float, exposure_s: float) -> tuple[str, ...]:
    allowed_s = 2.0 + (exposure_s if math.isfinite(exposure_s) else 60.0)
    for card in cards.all(_COUNTED):
        other = _day(card, cards)
        if card.name != used.name and other is not None and abs(other - day) * _S_PER_DAY > allowed_s:
            apart_s = abs(other - day) * _S_PER_DAY
            return (f"doubt: {card.name} differs from {used.name} by {apart_s:.0f} s; {used.name} is used",)
    return ()

"""The middle of an exposure from its header, with a line on each assumption.

:func:`middle`: in this order the middle of the exposure, its start and end, its start and duration. DATE-OBS with a
time of day is preferred to MJD-OBS and JD, which often refer to another moment; a difference of more than the
exposure is reported. The scale is that of TIMESYS, else UTC.
"""

from __future__ import annotations

import math
import warnings
from typing import TYPE_CHECKING

from sameas.sky.frame.cards import (
    OLD_DATE,
    S_PER_DAY,
    TAI_MINUS_GPS_S,
    Card,
    Cards,
    date_of,
    day_of,
    is_zoned,
    scale_of,
    start_mjd,
    time_of_day,
    year_of_digits,
)

if TYPE_CHECKING:
    from astropy.time import Time

_MIDDLE = ("DATE-AVG", "DATE-MID", "DATE_MID", "MIDPOINT", "MJD-AVG", "MJD-MID", "MJD_MID", "JD-MID", "JD_MID", "JDMID")
STARTS = ("DATE-OBS", "DATE_OBS", "DATE-BEG", "DATE-STA", "DATEOBS", "UTSTART")
_END = ("DATE-END", "DATE_END", "MJD-END", "EXPEND")
_CLOCK = ("TIME-OBS", "TIME_OBS", "UT", "UTC", "UTC-OBS", "UT-OBS", "UT-START", "UTSTART", "TIME-BEG", "TIME", "UTIME")
#: Of these a number is a time of day, too.
_CLOCK_NUMBERS = ("TIME-OBS", "TIME_OBS", "UT", "UTC", "UTC-OBS", "UT-OBS", "UT-START", "UTSTART", "TIME-BEG", "UTIME")
#: Times at the Sun or the barycentre of the Solar System, used if there is no other.
_AT_SUN = ("HJD", "HJD-OBS", "HJD_UTC", "HJD-MID", "BJD", "BJD-OBS", "BJD_TDB", "BJD_UTC", "BJD-MID")
#: Those that are universal time by their name.
_UNIVERSAL = ("UT", "UTC", "UTC-OBS", "UT-OBS", "UT-START", "UTSTART", "UTIME")
_COUNTED = ("MJD-OBS", "MJD_OBS", "MJD-BEG", "EXPSTART", "MJD", "MJD-STR", "JD", "JD-OBS", "JULDAT", "JULIAN", "JD_UTC")
#: Total exposure and number of frames of a stack, which often keeps the exposure of one frame.
_TOTAL = ("LIVETIME", "TOTALEXP", "TOTEXP", "TOTEXPT")
_STACKED = ("STACKCNT", "NCOMBINE", "NCOMB", "NSTACK")
#: Keywords of digitised photographic plates: only these may be older than the first detectors.
_PLATE = ("PLTLABEL", "PLATEID", "PLTSCALE", "PLTRAH", "PLATE", "PLATENUM", "EMULSION")
#: Times at which clocks start that were never set.
_UNSET = ("1900-01-01T00:00:00", "1970-01-01T00:00:00", "1980-01-06T00:00:00", "2000-01-01T00:00:00")
_FIRST_UTC_YEAR = 1960
#: TT − UT in seconds before UTC existed (Espenak & Meeus 2006, NASA/TP-2006-214141, from Morrison & Stephenson 2004).
_DELTA_T = (
    (1880, -5.0), (1900, -2.7), (1910, 10.4), (1920, 21.2), (1930, 24.0), (1940, 24.3), (1950, 29.1), (1960, 33.2),
)  # fmt: skip


def middle(cards: Cards, exposure_s: float) -> tuple[Time | None, tuple[str, ...]]:
    """The middle of the exposure, None if the header has no time, and the lines on its origin.

    exposure_s : NaN if it is not known; the start is then used as the middle, and a line reports it.
    """
    scale, lines = _time_scale(cards)
    for card in cards.all(_MIDDLE):
        day = day_of(card)
        if day is not None:
            return _time_of(day, scale, f"middle of the exposure ({card.name})", lines + _unreadable(cards, card.name))
    start = _start(cards)
    if start is None:
        return _elsewhere(cards, scale)
    card, day, remark = start
    lines += _unreadable(cards, card.name)
    if card.says(r"\bmid"):
        return _time_of(day, scale, f"middle of the exposure ({card.name}, by its comment)", lines)
    lines += remark + _disagreement(cards, card, day, exposure_s, scale)
    if card.says(r"\bend\b") and not card.says(r"\b(start|begin)") and math.isfinite(exposure_s):
        how = f"end ({card.name}, by its comment) and half the exposure"
        return _time_of(day - exposure_s / 2 / S_PER_DAY, scale, how, lines)
    for end in cards.all(_END):
        last = day_of(end)
        if last is not None and last > day:
            lines += _shorter(end, (last - day) * S_PER_DAY, exposure_s)
            return _time_of((day + last) / 2, scale, f"midway between {card.name} and {end.name}", lines)
    if not math.isfinite(exposure_s):
        return _time_of(
            day, scale, f"start ({card.name})", (*lines, "assumed: exposure unknown, its start is used as its middle")
        )
    open_s, stacked = _stacked(cards, exposure_s)
    how = f"start ({card.name}) and half the exposure" + (" of the stack" if open_s != exposure_s else "")
    return _time_of(day + open_s / 2 / S_PER_DAY, scale, how, lines + stacked)


def _stacked(cards: Cards, exposure_s: float) -> tuple[float, tuple[str, ...]]:
    """The seconds between start and end if these are not stated: longer than an exposure for a stack, with a doubt."""
    total, count = cards.number(_TOTAL), cards.number(_STACKED)
    if total is not None and total.number() > 1.05 * exposure_s:
        return total.number(), (
            f"doubt: a stack of {total.number():g} s ({total.name}) without the time of its end: pauses between its "
            "frames are not counted",
        )
    if count is not None and count.number() > 1:
        return exposure_s, (
            f"doubt: a stack of {count.number():g} frames ({count.name}) without the time of its end: its middle may "
            "be later",
        )
    return exposure_s, ()


def _elsewhere(cards: Cards, scale: str) -> tuple[Time | None, tuple[str, ...]]:
    """The middle of the exposure by the zero of an event file, or by a time at the Sun; None without either."""
    lines = _unreadable(cards, "")
    counted = start_mjd({card.name: card.value for card in cards.all(map(str, cards.header))})
    if counted is not None:
        return _time_of(counted[0], scale, counted[1], lines)
    for card in cards.all(_AT_SUN):
        value = card.number()
        if 2_300_000 < value < 2_500_000:
            doubt = f"doubt: {card.name} is a time at the Sun, up to 8.4 min from that at the telescope; it is used"
            return _time_of(value - 2_400_000.5, "utc", f"{card.name}, of the middle or the start", (*lines, doubt))
    return None, lines


def _time_of(day: float, scale: str, how: str, lines: tuple[str, ...]) -> tuple[Time, tuple[str, ...]]:
    """The time of an MJD on a scale (TT before UTC existed), and the lines, with one on its origin ``how``."""
    from sameas.sky.times import Time

    year = 1858.8 + day / 365.25
    if scale == "utc" and year < _FIRST_UTC_YEAR:
        years, seconds = zip(*_DELTA_T, strict=True)
        delta = _between(year, years, seconds)
        day, scale = day + delta / S_PER_DAY, "tt"
        lines = (*lines, f"assumed: universal time, turned into TT by {delta:+.1f} s (there was no UTC before 1960)")
    if scale == "gps":
        day, scale, how = day + TAI_MINUS_GPS_S / S_PER_DAY, "tai", f"{how}, GPS time + {TAI_MINUS_GPS_S:.0f} s"
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*dubious year")
        whole = math.floor(day)
        time = Time(whole, day - whole, format="mjd", scale=scale)
        text = time.isot
    return time, (f"middle of the exposure {text} {scale.upper()}: {how}", *lines)


def _between(x: float, xs: tuple[float, ...], ys: tuple[float, ...]) -> float:
    import numpy as np

    return float(np.interp(x, xs, ys))


def _time_scale(cards: Cards) -> tuple[str, tuple[str, ...]]:
    card = cards.first(("TIMESYS",))
    if card is None:
        return "utc", ("assumed: times are UTC (no TIMESYS)",)
    if scale := scale_of(card.text()):
        return scale, ()
    return "utc", (f"doubt: TIMESYS = {card.text()!r} is no known time scale; times are taken as UTC",)


def _start(cards: Cards) -> tuple[Card, float, tuple[str, ...]] | None:
    """The card of the start, its MJD, and the assumptions."""
    dates = [(card, date_of(card.text(), _century(cards))) for card in cards.all(STARTS)]
    local = None
    for card, date in dates:
        if date is None or date[1] is None:
            continue
        if not _is_local(card):
            return card, date[0] + date[1], _unset(card)
        local = local or (card, date[0] + date[1])
    counted = next(((card, day) for card in cards.all(_COUNTED) if (day := day_of(card)) is not None), None)
    if local is not None and counted is None:
        card, day = local
        doubt = f"doubt: {card.name} is local time by its comment, without its difference from UTC; it is taken as UTC"
        return card, day, (doubt,)
    dated = next(((card, date[0]) for card, date in dates if date is not None), None)
    remark = () if dated is None else _order(dated[0], _century(cards))
    if dated is not None and local is None:
        for clock in cards.all(_CLOCK):
            fraction, words = _fraction_of(clock)
            if fraction is not None:
                return (
                    Card(f"{dated[0].name} and {clock.name}", None, clock.comment),
                    dated[1] + fraction,
                    remark + words,
                )
    if counted is not None:
        return (*counted, _other_day(*counted, dated))
    if dated is not None:
        noon = f"assumed: 12:00, for {dated[0].name} has no time of day; up to 12 h wrong"
        return dated[0], dated[1] + 0.5, (*remark, noon)
    return None


def _fraction_of(card: Card) -> tuple[float | None, tuple[str, ...]]:
    """The time of day of a card as a fraction of the day, or None, and a line if it is a number without a unit."""
    fraction, number = time_of_day(card.text()), card.number()
    if fraction is not None or card.name not in _CLOCK_NUMBERS or not 0.0 <= number <= S_PER_DAY:
        return fraction, ()
    in_seconds = number > 24.0 or card.says(r"\bs(ec(onds?)?)?\b")
    line = f"assumed: {card.name} = {card.text()} is in {'seconds' if in_seconds else 'hours'} of the day"
    return number / (S_PER_DAY if in_seconds else 24.0), (line,)


def _is_local(card: Card) -> bool:
    """Whether a card is local time by its comment, without a time zone."""
    return not is_zoned(card) and card.says(r"\blocal\b|\bLT\b") and not card.says(r"\b(UTC?|GMT)\b")


def _unset(card: Card) -> tuple[str, ...]:
    if card.text()[:19].replace(" ", "T") not in _UNSET:
        return ()
    return (f"doubt: {card.name} = {card.text()!r} is where a clock starts that was not set",)


def _other_day(used: Card, day: float, dated: tuple[Card, float] | None) -> tuple[str, ...]:
    """A doubt if a date without a time of day is another day than the time used, by more than local dates differ."""
    if dated is None or abs(dated[1] + 0.5 - day) <= 1.5:
        return ()
    return (f"doubt: {dated[0].name} = {dated[0].text()!r} is not the day of {used.name}; {used.name} is used",)


def _unreadable(cards: Cards, used: str) -> tuple[str, ...]:
    """A doubt about the first keyword of a time or a date, before the ``used`` one, that is neither."""
    for card in cards.all((*_MIDDLE, *STARTS, *_COUNTED)):
        if used.startswith(card.name):
            break
        if day_of(card) is None and date_of(card.text()) is None and time_of_day(card.text()) is None:
            instead = f"; {used} is used" if used else ""
            return (f"doubt: {card.name} = {card.text()!r} is no time{instead}",)
    return ()


def _century(cards: Cards) -> int:
    """The century of years below 50 of two digits: 1900 by the rule of FITS before 2000, for a photographic plate."""
    return 1900 if cards.first(_PLATE) is not None else 2000


def _order(card: Card, century: int) -> tuple[str, ...]:
    """Lines on the year of a date that gives two digits of it, and on the order of its day and month."""
    old = OLD_DATE.match(card.text())
    if old is None:
        return ()
    lines = []
    first, second = int(old[1]), int(old[2])
    if len(old[3]) == 2:
        year = year_of_digits(old[3], century)
        why = "as in FITS before 2000" if year < 2000 else "as there were no such detectors in 19" + old[3]
        lines.append(f"assumed: {card.name} = {card.text()!r} is of {year}, {why}")
    if second > 12 or (first <= 12 and first != second):
        before = "the month before the day" if second > 12 else "the day before the month"
        lines.append(f"assumed: {card.name} = {card.text()!r} has {before}")
    return tuple(lines)


def _disagreement(cards: Cards, used: Card, day: float, exposure_s: float, scale: str) -> tuple[str, ...]:
    """A doubt about the first other keyword of a time that differs by more than the exposure."""
    allowed_s = 2.0 + (exposure_s if math.isfinite(exposure_s) else 60.0) + (0.0 if scale == "utc" else 70.0)
    others = [(card, day_of(card)) for card in cards.all(_COUNTED)]
    for card in cards.all(_UNIVERSAL):
        fraction = time_of_day(card.text())
        # Of a time of day without a date only the difference within a day is known.
        others.append((card, day_of(card) if fraction is None else day + (fraction - day % 1.0 + 0.5) % 1.0 - 0.5))
    for card, other in others:
        if card.name not in used.name.split() and other is not None and abs(other - day) * S_PER_DAY > allowed_s:
            apart = _apart(abs(other - day) * S_PER_DAY, used.name)
            return (f"doubt: {card.name} differs from {used.name} by {apart}; {used.name} is used",)
    return ()


def _apart(apart_s: float, used: str) -> str:
    """A difference of times in words, with what a whole number of half hours suggests."""
    if apart_s < 900.0:
        return f"{apart_s:.0f} s"
    half_hours, rest_s = round(apart_s / 1800.0), abs((apart_s + 900.0) % 1800.0 - 900.0)
    if apart_s > 0.9 * S_PER_DAY:
        return f"{apart_s / S_PER_DAY:.3g} d"
    if rest_s < 150.0 and half_hours <= 28:
        return f"{half_hours / 2:g} h (is {used} local time?)"
    return f"{apart_s / 3600.0:.2f} h"


def _shorter(end: Card, open_s: float, exposure_s: float) -> tuple[str, ...]:
    """A doubt if the exposure does not fit before its end."""
    if not exposure_s > 1.05 * open_s + 2.0:
        return ()
    return (f"doubt: the exposure of {exposure_s:g} s is longer than the {open_s:.0f} s until {end.name}",)

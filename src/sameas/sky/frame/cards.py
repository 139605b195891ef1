"""Cards: one keyword of a FITS header with its value and comment, as a number, an angle, a date or text.

:func:`reference_mjd` is the zero from which a file counts its times: event files of X-ray telescopes count seconds from
MJDREF, or MJDREFI + MJDREFF; Kepler and TESS days from BJDREFI + BJDREFF (FITS standard 4.0, section 9).
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from astropy.io.fits import Header

_SEXAGESIMAL = re.compile(
    r"^\s*([+-]?)\s*(\d+)[\s:hHdD°]+(\d+(?:\.\d+)?)(?:[\s:mM']+(\d+(?:\.\d*)?))?\s*[mMsS'\"]?\s*([NSEWnsew]?)\s*$"
)
_NUMBER = re.compile(r"^\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eEdD][+-]?\d+)?)\s*[A-Za-z/\-_]*\s*$")
_ISO = re.compile(r"^(\d{4})[-/.](\d{1,2})[-/.](\d{1,2})(?:[T\s]+(\S.*?)Z?)?$")
_COMPACT = re.compile(r"^(\d{4})(\d{2})(\d{2})(?:T(\d{2})(\d{2})(\d{2}(?:\.\d*)?)Z?)?$")
_NAMED = re.compile(r"^(\d{1,2})[-\s]([A-Za-z]{3})[-\s](\d{4})(?:[T\s]+(\S.*?)Z?)?$")
OLD_DATE = re.compile(r"^(\d{1,2})[/-](\d{1,2})[/-](\d{2}|\d{4})$")
_MONTHS = ("jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec")
#: First year of two digits that is one of the twentieth century without a plate.
_FIRST_DETECTOR_YEAR = 50
S_PER_DAY = 86400.0


@dataclass(frozen=True)
class Card:
    """One keyword with its value and comment."""

    name: str
    value: Any
    comment: str = ""

    def number(self) -> float:
        """The value as a number, else NaN; a unit after it is ignored."""
        if isinstance(self.value, bool):
            return math.nan
        if isinstance(self.value, int | float):
            return float(self.value)
        match = _NUMBER.match(str(self.value))
        return float(match[1].replace("D", "E").replace("d", "e")) if match else math.nan

    def angle(self) -> tuple[float, bool]:
        """The value in its first unit (hours or degrees), and whether it is sexagesimal; NaN if it is not an angle."""
        match = _SEXAGESIMAL.match(str(self.value)) if isinstance(self.value, str) else None
        if match is None:
            return self.number(), False
        first, minutes, seconds = float(match[2]), float(match[3]), float(match[4] or 0.0)
        if minutes >= 60 or seconds >= 60:
            return math.nan, True
        sign = -1.0 if match[1] == "-" or match[5].upper() == "S" else 1.0
        return sign * (first + minutes / 60 + seconds / 3600), True

    def text(self) -> str:
        """The value as text, stripped."""
        return str(self.value).strip()

    def says(self, pattern: str) -> bool:
        """Whether the comment matches the pattern, ignoring case."""
        return re.search(pattern, self.comment, re.IGNORECASE) is not None


@dataclass(frozen=True)
class Cards:
    """The cards of one header."""

    header: Header

    def all(self, names: Iterable[str]) -> list[Card]:
        """The cards of the names that have a value, in the order of the names."""
        cards = []
        for name in names:
            for key in (name, f"HIERARCH {name}"):
                if key in self.header:
                    value = self.header[key]
                    text = "" if value is None or type(value).__name__ == "Undefined" else str(value).strip()
                    if text and text.lower() not in ("nan", "n/a", "none", "unknown", "null"):
                        cards.append(Card(name, value, str(self.header.comments[key])))
                    break
        return cards

    def first(self, names: Iterable[str]) -> Card | None:
        """The card of the first name that has a value."""
        return next(iter(self.all(names)), None)

    def number(self, names: Iterable[str]) -> Card | None:
        """The card of the first name that has a finite number."""
        return next((card for card in self.all(names) if math.isfinite(card.number())), None)


def day_of(card: Card) -> float | None:
    """MJD of a card with an MJD, a JD or a date with a time; else None."""
    value = card.number()
    if math.isfinite(value):
        if 2_300_000 < value < 2_500_000:
            return value - 2_400_000.5
        if not 0 < value < 100_000 or "JD" not in card.name + "MJD" * card.name.startswith("EXP"):
            return None
        return value - 0.5 if "JD" in card.name and "MJD" not in card.name else value  # a JD less 2 400 000
    date = date_of(card.text())
    return date[0] + date[1] if date is not None and date[1] is not None else None


def date_of(text: str, century: int = 2000) -> tuple[float, float | None] | None:
    """MJD of the day and fraction of the day (None without a time of day); None if the text is not a date."""
    clock: str | None = None
    if iso := _ISO.match(text):
        year, month, day, clock = int(iso[1]), int(iso[2]), int(iso[3]), iso[4]
    elif compact := _COMPACT.match(text):
        year, month, day = (int(compact[part]) for part in (1, 2, 3))
        clock = ":".join(compact.groups()[3:]) if compact[4] else None
    elif (named := _NAMED.match(text)) and named[2].lower() in _MONTHS:
        year, month, day, clock = int(named[3]), _MONTHS.index(named[2].lower()) + 1, int(named[1]), named[4]
    elif old := OLD_DATE.match(text):
        day, month = (int(old[1]), int(old[2])) if int(old[2]) <= 12 else (int(old[2]), int(old[1]))
        year = year_of_digits(old[3], century)
    else:
        return None
    try:
        mjd = float((datetime(year, month, day) - datetime(1858, 11, 17)).days)
    except ValueError:
        return None
    fraction = None if clock is None else time_of_day(clock)
    return mjd, None if fraction is None else fraction - zone_of(clock or "")


def year_of_digits(digits: str, century: int) -> int:
    if len(digits) == 4:
        return int(digits)
    return int(digits) + (century if int(digits) < _FIRST_DETECTOR_YEAR else 1900)


def time_of_day(text: str) -> float | None:
    match = re.match(r"^(\d{1,2})[:\s](\d{1,2})(?:[:\s](\d{1,2}(?:\.\d*)?))?(?:\s*([AaPp])\.?[Mm]\b)?", text.strip())
    if match is None:
        return None
    hours, minutes, seconds = int(match[1]), int(match[2]), float(match[3] or 0.0)
    if hours > 24 or minutes > 59 or seconds >= 61:
        return None
    if match[4] and 1 <= hours <= 12:
        hours = hours % 12 + (12 if match[4] in "Pp" else 0)
    return (hours * 3600 + minutes * 60 + seconds) / S_PER_DAY


def is_zoned(card: Card) -> bool:
    """Whether a date has a time zone."""
    return bool(re.search(r"\d\s*(Z|UTC?)\s*$", card.text()) or zone_of(card.text()))


def zone_of(clock: str) -> float:
    """Offset of a time from UTC in days: 0 without a time zone as in 18:33:43-0700."""
    zone = re.search(r":\d{2}(?:\.\d*)?\s*([+-])(\d{2}):?(\d{2})?$", clock.strip())
    if zone is None:
        return 0.0
    return (1.0 if zone[1] == "+" else -1.0) * (int(zone[2]) + int(zone[3] or 0) / 60.0) / 24.0


#: Scales of TIMESYS as astropy names them; "gps" is none of its own.
_SCALES = {"UTC": "utc", "UT": "utc", "GMT": "utc", "TDB": "tdb", "TT": "tt", "TDT": "tt", "TAI": "tai", "TCB": "tcb"}
_SCALES |= {"TCG": "tcg", "UT1": "ut1", "IAT": "tai", "ET": "tt", "GPS": "gps"}
TAI_MINUS_GPS_S = 19.0
_JD_OF_MJD_0 = 2400000.5


def scale_of(text: str) -> str:
    """The scale of a TIMESYS, "" if it is not known; UTC(NIST) is a realisation of UTC."""
    return _SCALES.get(re.sub(r"\(.*\)", "", text).strip().upper(), "")


def reference_mjd(keywords: Mapping[str, Any]) -> tuple[float, str] | None:
    """The MJD from which times of a file are counted, and the keyword that states it; None without one.

    keywords : by upper-case name.

    >>> reference_mjd({"MJDREFI": 51910, "MJDREFF": 7.5e-4})
    (51910.00075, 'MJDREFI')
    """
    for stem, zero in (("MJDREF", 0.0), ("JDREF", _JD_OF_MJD_0), ("BJDREF", _JD_OF_MJD_0)):
        for name in (stem, f"{stem}I"):
            whole = _number(keywords, name)
            if whole is not None:
                fraction = 0.0 if name == stem else _number(keywords, f"{stem}F") or 0.0
                return whole - zero + fraction + (_number(keywords, "TIMEZERO") or 0.0) * _unit_days(keywords), name
    return None


def start_mjd(keywords: Mapping[str, Any]) -> tuple[float, str] | None:
    """The MJD of TSTART (the middle of TSTART and TSTOP, if both are there), and what states it; None without."""
    zero, start = reference_mjd(keywords), _number(keywords, "TSTART")
    if zero is None or start is None:
        return None
    stop = _number(keywords, "TSTOP")
    elapsed = start if stop is None else 0.5 * (start + stop)
    return zero[0] + elapsed * _unit_days(keywords), f"{'TSTART' if stop is None else 'TSTART, TSTOP'} and {zero[1]}"


def _unit_days(keywords: Mapping[str, Any]) -> float:
    """Days of the file's unit of time; seconds without TIMEUNIT, as in the FITS standard."""
    return {"d": 1.0, "day": 1.0, "min": 1 / 1440.0, "h": 1 / 24.0}.get(
        str(keywords.get("TIMEUNIT", "s")).strip().lower(), 1.0 / 86400.0
    )


def _number(keywords: Mapping[str, Any], name: str) -> float | None:
    number = Card(name, keywords.get(name)).number()
    return number if math.isfinite(number) else None

"""Keywords: the facts of an exposure from its FITS header, each with a line on its origin.

These are the station, the direction of the telescope, the middle of the exposure, and the properties of the camera.
``facts.lines`` are for printing: each fact with its keyword, assumptions ("assumed: …") and doubts ("doubt: …").

Observatories use many names for one fact: each is looked up in a list of keywords, the more reliable ones first
(:class:`Cards`), and comes with a line on the keyword and its interpretation.

- :func:`station`: the sign of the longitude varies. TheSkyX and the national observatories of the United States count
  west as positive, most others east. It is decided by a letter, else by the sidereal time of the header, else by the
  comment, else by the time zone of the date, else by the program that wrote the header; else east positive is assumed.
- :func:`aim`: the direction, from the first valid pair of keywords.
- :func:`middle`: in this order the middle of the exposure, its start and end, its start and duration. DATE-OBS with a
  time of day is preferred to MJD-OBS and JD, which often refer to another moment; a difference of more than the
  exposure is reported. The scale is that of TIMESYS, else UTC.
"""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Iterable
from dataclasses import dataclass, replace
from datetime import datetime
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sameas.errors import Argument, InputError, Message
from sameas.representation import in_short
from sameas.space import ARCSEC_PER_RADIAN

if TYPE_CHECKING:
    from astropy.io.fits import Header
    from astropy.time import Time

_SEXAGESIMAL = re.compile(
    r"^\s*([+-]?)\s*(\d+)[\s:hHdD°]+(\d+)(?:[\s:mM']+(\d+(?:\.\d*)?))?\s*[sS\"]?\s*([NSEWnsew]?)\s*$"
)
_NUMBER = re.compile(r"^\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eEdD][+-]?\d+)?)\s*[A-Za-z/\-_]*\s*$")


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


_LATITUDE = ("OBSGEO-B", "SITELAT", "LATITUDE", "GEOLAT", "OBSLAT", "LAT-OBS", "OBS-LAT", "ESO TEL GEOLAT", "TELLAT")
_LONGITUDE: tuple[str, ...] = (
    "OBSGEO-L",
    "SITELONG",
    "LONGITUD",
    "GEOLON",
    "OBSLONG",
    "LONG-OBS",
    "OBS-LONG",
    "ESO TEL GEOLON",
)
_LONGITUDE += ("TELLONG", "GEOLONG", "OBSLON", "LONGITUDE", "SITELON")
_HEIGHT = ("OBSGEO-H", "SITEELEV", "ALTITUDE", "HEIGHT", "GEOELEV", "ALT-OBS", "OBS-ELEV", "ESO TEL GEOELEV", "SITEALT")
_SIDEREAL = ("LST", "ST", "LST-OBS", "LMST", "SIDEREAL", "LST-HDR")
_PLACES = ("ORIGIN", "OBSERVAT", "TELESCOP", "SITE", "SITENAME", "OBSCODE", "MPCCODE", "OBSERVER")
_AIMS: tuple[tuple[str, str], ...] = (
    ("OBJCTRA", "OBJCTDEC"),
    ("RA", "DEC"),
    ("TELRA", "TELDEC"),
    ("RA_TARG", "DEC_TARG"),
    ("RA-OBS", "DEC-OBS"),
)
_AIMS += (
    ("RA_OBJ", "DEC_OBJ"),
    ("CAT-RA", "CAT-DEC"),
    ("RA_PNT", "DEC_PNT"),
    ("OBJRA", "OBJDEC"),
    ("CRVAL1", "CRVAL2"),
)
#: Tolerance of a sidereal time, hours: it may refer to the start, middle or end of the exposure.
_SIDEREAL_TOLERANCE_H = 0.3
#: Greatest difference of the time zone of a place from its longitude, hours (western China, with daylight saving).
_ZONE_TOLERANCE_H = 3.5


@dataclass(frozen=True)
class Station:
    """An observing site: degrees, east positive; metres above the ellipsoid, NaN if not known; MPC code or ''."""

    lat_deg: float
    lon_deg: float
    height_m: float = math.nan
    code: str = ""


def station(cards: Cards, time: Time | None) -> tuple[Station | None, tuple[str, ...]]:
    """The station, None if the header has none, and the lines on its origin."""
    lat, lon = cards.first(_LATITUDE), cards.first(_LONGITUDE)
    if lat is None or lon is None:
        return None, ()
    lat_deg, lon_deg = lat.angle()[0], lon.angle()[0]
    if not (abs(lat_deg) <= 90 and abs(lon_deg) <= 360):
        return None, (
            f"doubt: {lat.name} = {lat.text()}, {lon.name} = {lon.text()} are not a place on the Earth; not used",
        )
    east_deg, how = _east(cards, lon, lon_deg, time)
    height = cards.number(_HEIGHT)
    station = Station(
        lat_deg, (east_deg + 180) % 360 - 180, math.nan if height is None else height.number(), _code(cards)
    )
    called = f" (MPC {station.code})" if station.code else ""
    return station, (f"station {lat_deg:+.4f}°, {station.lon_deg:+.4f}° east{called}: {lat.name}, {lon.name}, {how}",)


def _east(cards: Cards, card: Card, lon_deg: float, time: Time | None) -> tuple[float, str]:
    """The longitude, east positive, and how its sign was decided."""
    letter = re.search(r"[EWew]\s*$", card.text())
    if letter:
        return (lon_deg if letter[0].strip().upper() == "E" else -lon_deg), "its letter"
    if card.name.startswith("OBSGEO") or lon_deg > 180:
        return lon_deg, "east positive"
    sidereal = cards.first(_SIDEREAL)
    hours = math.nan if sidereal is None else sidereal.angle()[0]
    if time is not None and sidereal is not None and math.isfinite(hours):
        difference_h = {
            sign: abs((sidereal_time_h(time) + sign * lon_deg / 15 - hours + 12) % 24 - 12) for sign in (1, -1)
        }
        best = 1 if difference_h[1] < difference_h[-1] else -1
        if difference_h[best] < _SIDEREAL_TOLERANCE_H and difference_h[-best] > 3 * _SIDEREAL_TOLERANCE_H:
            return best * lon_deg, f"{'east' if best > 0 else 'west'} positive by {sidereal.name}"
    if card.says(r"\bwest\b|\(\+?w\)|\+\s*w\b") and not card.says(r"\beast\b|west(ern)?\s*(is\s*)?(neg|-)"):
        return -lon_deg, "west positive by its comment"
    if card.says(r"\beast\b|\(\+?e\)|\+\s*e\b"):
        return lon_deg, "east positive by its comment"
    zones_h = {card.name: 24.0 * _zone_of(card.text()) for card in cards.all(_START)}
    for name, zone_h in zones_h.items():
        off_h = {sign: abs((zone_h - sign * lon_deg / 15 + 12) % 24 - 12) for sign in (1, -1)}
        best = min(off_h, key=off_h.__getitem__)
        if zone_h and off_h[best] < _ZONE_TOLERANCE_H < off_h[-best]:
            return best * lon_deg, f"{'east' if best > 0 else 'west'} positive by the time zone of {name}"
    writer = cards.first(("SWCREATE", "OBSERVAT", "ORIGIN"))
    if writer is not None and re.search(r"TheSky|KPNO|NOAO|CTIO", writer.text()):
        return -lon_deg, f"west positive as {writer.text()} does"
    return lon_deg, "assumed: east positive"


def sidereal_time_h(time: Time) -> float:
    """Greenwich mean sidereal time in hours, accurate to a few seconds (Meeus, Astronomical Algorithms, eq. 12.4)."""
    return float((18.697374558 + 24.06570982441908 * (time.mjd - 51544.5)) % 24)


def _code(cards: Cards) -> str:
    """The MPC code: three letters and digits in parentheses, or alone under OBSCODE or MPCCODE."""
    for card in cards.all(_PLACES):
        match = re.search(r"\(([0-9A-Z]\d{2})\)", card.text())
        if match is None and card.name in ("OBSCODE", "MPCCODE"):
            match = re.fullmatch(r"([0-9A-Z]\d{2})", card.text())
        if match:
            return match[1]
    return ""


def aim(cards: Cards) -> tuple[tuple[float, float] | None, tuple[str, ...]]:
    """ICRS direction (ra_deg, dec_deg) of the telescope, None if the header has none, and the line on it."""
    for names in _AIMS:
        ra, dec = (cards.first([name]) for name in names)
        if ra is None or dec is None or (names[0] == "CRVAL1" and not _is_equatorial(cards)):
            continue
        (ra_value, sexagesimal), (dec_deg, _) = ra.angle(), dec.angle()
        hours = sexagesimal or ra.says(r"\bhours?\b|\bhrs\b")
        ra_deg = ra_value * 15 if hours else ra_value
        if not (0 <= ra_deg <= 360 and abs(dec_deg) <= 90):
            continue
        ra_deg, dec_deg, equinox = _to_icrs(cards, ra_deg, dec_deg)
        unit = "hours" if hours else "degrees"
        return (ra_deg, dec_deg), (f"aim {ra_deg:.5f}°, {dec_deg:+.5f}°: {names[0]} in {unit}, {names[1]}{equinox}",)
    return None, ()


def _is_equatorial(cards: Cards) -> bool:
    kind = cards.first(["CTYPE1"])
    return kind is not None and kind.text().upper().startswith("RA")


def _to_icrs(cards: Cards, ra_deg: float, dec_deg: float) -> tuple[float, float, str]:
    """A direction at the header's EQUINOX converted to ICRS. EPOCH is not used: it is often that of the exposure."""
    card = cards.number(["EQUINOX"])
    year = 2000.0 if card is None else card.number()
    if abs(year - 2000) < 0.01 or not 1800 < year < 2200:
        return ra_deg, dec_deg, "" if card is not None else ", assumed: J2000"
    from astropy import units as u
    from astropy.coordinates import FK4, FK5, SkyCoord

    frame = FK4(equinox=f"B{year}") if year == 1950 else FK5(equinox=f"J{year}")
    direction = SkyCoord(ra_deg * u.deg, dec_deg * u.deg, frame=frame).icrs
    return float(direction.ra.deg), float(direction.dec.deg), f", precessed from {year:g}"


_MIDDLE = ("DATE-AVG", "DATE-MID", "DATE_MID", "MIDPOINT", "MJD-AVG", "MJD-MID", "MJD_MID", "JD-MID", "JD_MID", "JDMID")
_START = ("DATE-OBS", "DATE_OBS", "DATE-BEG", "DATE-STA", "DATEOBS", "UTSTART")
_END = ("DATE-END", "DATE_END", "MJD-END", "EXPEND")
_CLOCK = ("TIME-OBS", "TIME_OBS", "UT", "UTC", "UTC-OBS", "UT-OBS", "UT-START", "UTSTART", "TIME-BEG", "TIME", "UTIME")
_COUNTED = ("MJD-OBS", "MJD_OBS", "MJD-BEG", "EXPSTART", "MJD", "MJD-STR", "JD", "JD-OBS", "JULDAT", "JULIAN", "JD_UTC")
_SCALES = {"UTC": "utc", "UT": "utc", "GMT": "utc", "TDB": "tdb", "TT": "tt", "TDT": "tt", "TAI": "tai", "TCB": "tcb"}
_SCALES |= {"TCG": "tcg", "UT1": "ut1", "IAT": "tai", "ET": "tt", "GPS": "gps"}
_TAI_MINUS_GPS_S = 19.0
_ISO = re.compile(r"^(\d{4})[-/](\d{1,2})[-/](\d{1,2})(?:[T\s]+(\S.*?)Z?)?$")
_OLD = re.compile(r"^(\d{1,2})[/-](\d{1,2})[/-](\d{2}|\d{4})$")
_FIRST_UTC_YEAR = 1960
#: TT − UT in seconds before UTC existed (Espenak & Meeus 2006, NASA/TP-2006-214141, from Morrison & Stephenson 2004).
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
    """The middle of the exposure, None if the header has no time, and the lines on its origin.

    exposure_s : NaN if it is not known; the start is then used as the middle, and a line reports it.
    """
    scale, lines = _time_scale(cards)
    for card in cards.all(_MIDDLE):
        day = _day(card)
        if day is not None:
            return _time_of(day, scale, f"middle of the exposure ({card.name})", lines + _unreadable(cards, card.name))
    start = _start(cards)
    if start is None:
        return None, _unreadable(cards, "")
    card, day, remark = start
    lines += _unreadable(cards, card.name)
    if card.says(r"\bmid"):
        return _time_of(day, scale, f"middle of the exposure ({card.name}, by its comment)", lines)
    lines += remark + _disagreement(cards, card, day, exposure_s)
    for end in cards.all(_END):
        last = _day(end)
        if last is not None and last > day:
            return _time_of((day + last) / 2, scale, f"midway between {card.name} and {end.name}", lines)
    if not math.isfinite(exposure_s):
        return _time_of(
            day, scale, f"start ({card.name})", (*lines, "assumed: exposure unknown, its start is used as its middle")
        )
    return _time_of(day + exposure_s / 2 / _S_PER_DAY, scale, f"start ({card.name}) and half the exposure", lines)


def _time_of(day: float, scale: str, how: str, lines: tuple[str, ...]) -> tuple[Time, tuple[str, ...]]:
    """The time of an MJD on a scale (TT before UTC existed), and the lines, with one on its origin ``how``."""
    from sameas.sky.times import Time

    year = 1858.8 + day / 365.25
    if scale == "utc" and year < _FIRST_UTC_YEAR:
        years, seconds = zip(*_DELTA_T, strict=True)
        delta = _between(year, years, seconds)
        day, scale = day + delta / _S_PER_DAY, "tt"
        lines = (*lines, f"assumed: universal time, turned into TT by {delta:+.1f} s (there was no UTC before 1960)")
    if scale == "gps":
        day, scale, how = day + _TAI_MINUS_GPS_S / _S_PER_DAY, "tai", f"{how}, GPS time + {_TAI_MINUS_GPS_S:.0f} s"
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
    name = re.sub(r"\(.*\)", "", card.text()).strip().upper()  # UTC(NIST) is a realization of UTC
    if name in _SCALES:
        return _SCALES[name], ()
    return "utc", (f"doubt: TIMESYS = {card.text()!r} is no known time scale; times are taken as UTC",)


def _start(cards: Cards) -> tuple[Card, float, tuple[str, ...]] | None:
    """The card of the start, its MJD, and the assumptions."""
    dates = [(card, _date(card.text())) for card in cards.all(_START)]
    for card, date in dates:
        if date is not None and date[1] is not None:
            return card, date[0] + date[1], ()
    dated = next(((card, date[0]) for card, date in dates if date is not None), None)
    remark = () if dated is None else _century(dated[0])
    if dated is not None:
        for clock in cards.all(_CLOCK):
            fraction = _time_of_day(clock.text())
            if fraction is not None:
                return Card(f"{dated[0].name} and {clock.name}", None, clock.comment), dated[1] + fraction, remark
    for card in cards.all(_COUNTED):
        day = _day(card)
        if day is not None:
            return card, day, _other_day(card, day, dated)
    if dated is not None:
        noon = f"assumed: 12:00, for {dated[0].name} has no time of day; up to 12 h wrong"
        return dated[0], dated[1] + 0.5, (*remark, noon)
    return None


def _other_day(used: Card, day: float, dated: tuple[Card, float] | None) -> tuple[str, ...]:
    """A doubt if a date without a time of day is another day than the time used, by more than local dates differ."""
    if dated is None or abs(dated[1] + 0.5 - day) <= 1.5:
        return ()
    return (f"doubt: {dated[0].name} = {dated[0].text()!r} is not the day of {used.name}; {used.name} is used",)


def _unreadable(cards: Cards, used: str) -> tuple[str, ...]:
    """A doubt about the first keyword of a time or a date, before the ``used`` one, that is neither."""
    for card in cards.all((*_MIDDLE, *_START, *_COUNTED)):
        if used.startswith(card.name):
            break
        if _day(card) is None and _date(card.text()) is None and _time_of_day(card.text()) is None:
            instead = f"; {used} is used" if used else ""
            return (f"doubt: {card.name} = {card.text()!r} is no time{instead}",)
    return ()


def _century(card: Card) -> tuple[str, ...]:
    """A line on the year of a date that gives two digits of it."""
    old = _OLD.match(card.text())
    if old is None or len(old[3]) > 2:
        return ()
    return (f"assumed: {card.name} = {card.text()!r} is of 19{old[3]}, as in FITS before 2000",)


def _day(card: Card) -> float | None:
    """MJD of a card with an MJD, a JD or a date with a time; else None."""
    value = card.number()
    if math.isfinite(value):
        if value > 2_000_000:
            return value - 2_400_000.5
        return value if 0 < value < 100_000 and "JD" in card.name + "MJD" * card.name.startswith("EXP") else None
    date = _date(card.text())
    return date[0] + date[1] if date is not None and date[1] is not None else None


def _date(text: str) -> tuple[float, float | None] | None:
    """MJD of the day and fraction of the day (None without a time of day); None if the text is not a date."""
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
    fraction = None if clock is None else _time_of_day(clock)
    return mjd, None if fraction is None else fraction - _zone_of(clock or "")


def _zone_of(clock: str) -> float:
    """Offset of a time from UTC in days: 0 without a time zone as in 18:33:43-0700."""
    zone = re.search(r":\d{2}(?:\.\d*)?\s*([+-])(\d{2}):?(\d{2})?$", clock.strip())
    if zone is None:
        return 0.0
    return (1.0 if zone[1] == "+" else -1.0) * (int(zone[2]) + int(zone[3] or 0) / 60.0) / 24.0


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
        other = _day(card)
        if card.name != used.name and other is not None and abs(other - day) * _S_PER_DAY > allowed_s:
            apart_s = abs(other - day) * _S_PER_DAY
            return (f"doubt: {card.name} differs from {used.name} by {apart_s:.0f} s; {used.name} is used",)
    return ()


_EXPOSURE = ("EXPTIME", "EXPOSURE", "EXP_TIME", "EXP-TIME", "TEXPTIME", "ITIME", "ELAPTIME", "EXPOSED", "XPOSURE")
_GAIN = ("EGAIN", "GAIN", "CCDGAIN", "GAIN1", "GAINEFF", "ATODGAIN", "ESO DET OUT1 CONAD", "HIERARCH GAIN")
_READ_NOISE = (
    "RDNOISE",
    "READNOIS",
    "READNOISE",
    "RON",
    "ENOISE",
    "RDNOISE1",
    "READNSE",
    "READNSEA",
    "ESO DET OUT1 RON",
)
_SATURATION = ("SATURATE", "SATLEVEL", "SATURAT", "SATURATI", "MAXLIN", "WELLDEPT", "SATUR_LV")
#: Names of the scale, arcsec per pixel.
_SCALE_NAMES = (
    "SECPIX", "PIXSCALE", "SECPIX1", "PIXSCAL1", "ARCSECPP", "IM_SCALE", "IMSCALE", "PIXELSCL", "PIXSCAL", "SECPPIX",
    "CCDSCALE",
)  # fmt: skip
_CALLED = {"gain_e_per_adu": "gain", "read_noise_e": "read noise", "saturation_adu": "saturation"}
#: Maximum gain, e⁻ per ADU; a larger value of GAIN is a setting of the camera (chosen).
_HIGHEST_GAIN = 30.0


@dataclass(frozen=True)
class Given:
    """Values given by the user that replace those of the header; None uses the header."""

    gain_e_per_adu: float | None = None
    read_noise_e: float | None = None
    saturation_adu: float | None = None
    exposure_s: float | None = None
    mid_time: Time | None = None
    station: Station | None = None

    def __post_init__(self) -> None:
        for name in ("gain_e_per_adu", "read_noise_e", "saturation_adu", "exposure_s"):
            value = getattr(self, name)
            lowest = "zero or more" if name in ("read_noise_e", "exposure_s") else "above zero"
            if value is not None and not (math.isfinite(value) and (value > 0 or (value == 0 and "or" in lowest))):
                raise InputError(Message(Argument(name), f" is {value:g}; give a number {lowest}"))


@in_short
@dataclass(frozen=True)
class Facts:
    """The facts of an exposure.

    Attributes
    ----------
    gain_e_per_adu, read_noise_e : NaN if not known; the noise is then measured on the image alone.
    saturation_adu : lowest value of a saturated pixel, infinite if not known.
    exposure_s : NaN if not known.
    mid_time : middle of the exposure with its scale, or None.
    station : observing site, or None.
    aim_deg : (ra, dec) ICRS direction of the telescope, or None.
    scale_arcsec_per_px : from the focal length and the pixels, NaN if not known; often wrong by ten per cent.
    pedestal_adu : constant that was added to all pixels, to be subtracted.
    kind : "light", "dark", "bias", "flat" or "" by the header.
    lines : on the origin of all this, for printing.
    name : of the frame.
    """

    gain_e_per_adu: float = math.nan
    read_noise_e: float = math.nan
    saturation_adu: float = math.inf
    exposure_s: float = math.nan
    mid_time: Time | None = None
    station: Station | None = None
    aim_deg: tuple[float, float] | None = None
    scale_arcsec_per_px: float = math.nan
    pedestal_adu: float = 0.0
    kind: str = ""
    lines: tuple[str, ...] = ()
    name: str = "frame"

    @classmethod
    def of(
        cls, header: Header, given: Given | None = None, *, name: str = "frame", notes: tuple[str, ...] = ()
    ) -> Facts:
        """The facts of a header; given values take precedence."""
        given = given or Given()
        cards = Cards(header)
        exposure, lines = _exposure(cards)
        if given.exposure_s is not None:
            exposure, lines = given.exposure_s, (f"exposure {given.exposure_s:g} s (given)",)
        time, timing = middle(cards, exposure)
        if given.mid_time is not None:
            time, timing = given.mid_time, (f"middle of the exposure {given.mid_time.isot} (given)",)
        elif time is None:
            timing = (*timing, "doubt: the header has no time (DATE-OBS, MJD-OBS, JD); motion and movers need one")
        site, placing = station(cards, time)
        if given.station is not None:
            site, placing = given.station, (f"station {given.station} (given)",)
        direction, aiming = aim(cards)
        scale, scaling = _scale(cards)
        electronics, electric = _electronics(cards, given)
        return cls(
            **electronics,
            exposure_s=exposure,
            mid_time=time,
            station=site,
            aim_deg=direction,
            scale_arcsec_per_px=scale,
            kind=_kind(cards),
            lines=(*notes, *lines, *timing, *placing, *aiming, *scaling, *electric),
            name=name,
        )

    def time(self) -> Time:
        """The middle of the exposure.

        Raises
        ------
        InputError : it is not known.
        """
        if self.mid_time is None:
            raise InputError(
                f"{self.name}: the header has no time of the exposure (DATE-OBS, MJD-OBS or JD); give the middle of it"
            )
        return self.mid_time

    def with_saturation(self, values: NDArray[Any], kind: np.dtype[Any]) -> Facts:
        """The facts with a saturation level estimated from the pixels if none was known."""
        if math.isfinite(self.saturation_adu):
            return self
        level, line = plateau(values), "saturation at {:g}: many of the brightest pixels have this value"
        if not math.isfinite(level) and kind.kind in "ui" and kind.itemsize <= 2:
            # A converter with fewer bits than the file makes a plateau; without one the full range is assumed.
            level, line = float(np.iinfo(kind).max), "assumed: saturation at {:g}, the largest number of the file"
        if not math.isfinite(level):
            return self
        return replace(self, saturation_adu=level, lines=(*self.lines, line.format(level)))


def plateau(values: NDArray[Any]) -> float:
    """The saturation level from a peak in the histogram of the brightest pixels, infinite without one.

    Above the sky the number of pixels falls with brightness; it rises again at the limit of a detector or of a
    blackened plate. The level is at half the height of this peak.
    """
    middle_value, highest = float(np.median(values)), float(values.max())
    if not highest > middle_value:
        return math.inf
    counts, edges = np.histogram(values, bins=40, range=(middle_value + 0.3 * (highest - middle_value), highest))
    top = len(counts) - 1 - int(np.argmax(counts[::-1][:20]))
    lowest = int(np.argmin(counts[: top + 1]))
    if counts[top] < 30 or counts[top] < 2 * counts[lowest] + 3 * math.sqrt(counts[lowest] + 1):
        return math.inf
    half = 0.5 * (counts[top] + counts[lowest])
    first = lowest + int(np.argmax(counts[lowest : top + 1] >= half))
    # A peak in the uppermost bin is the limit of the converter: all its pixels have the highest value.
    return float(edges[first]) if first < len(counts) - 1 else highest


def _exposure(cards: Cards) -> tuple[float, tuple[str, ...]]:
    card = cards.number(_EXPOSURE)
    if card is None or card.number() < 0:
        return math.nan, ("doubt: the header has no exposure (EXPTIME, EXPOSURE)",)
    value, unit = card.number(), "s"
    if card.says(r"\bmin(ute)?s?\b"):
        value, unit = value * 60, "minutes by its comment"
    elif card.says(r"\bmillisec|\bms\b"):
        value, unit = value / 1000, "milliseconds by its comment"
    return value, (f"exposure {value:g} s ({card.name} in {unit})",)


def _electronics(cards: Cards, given: Given) -> tuple[dict[str, float], tuple[str, ...]]:
    """Gain, read noise, saturation and pedestal."""
    gain, lines = _gain(cards)
    facts = {"gain_e_per_adu": gain, "read_noise_e": math.nan, "saturation_adu": math.inf, "pedestal_adu": 0.0}
    for key, names, unit in (("read_noise_e", _READ_NOISE, "e⁻"), ("saturation_adu", _SATURATION, "ADU")):
        card = cards.number(names)
        if card is not None and card.number() > 0:
            facts[key] = card.number()
            lines += (f"{_CALLED[key]} {card.number():g} {unit} ({card.name})",)
    pedestal = cards.number(["PEDESTAL"])
    if pedestal is not None and pedestal.number():
        # PEDESTAL is defined as "add this to each pixel for a zero-based level": the negative of what was added.
        facts["pedestal_adu"] = -pedestal.number()
        lines += (f"pedestal {-pedestal.number():g} ADU, subtracted in calibration (PEDESTAL)",)
    for key in ("gain_e_per_adu", "read_noise_e", "saturation_adu"):
        value = getattr(given, key)
        if value is not None:
            facts[key] = value
            lines += (f"{_CALLED[key]} {value:g} (given)",)
    return facts, lines


def _gain(cards: Cards) -> tuple[float, tuple[str, ...]]:
    unit = cards.first(["BUNIT"])
    if unit is not None and unit.text().lower().rstrip("s") in ("electron", "e-", "e", "photon"):
        return 1.0, (f"gain 1 e⁻ per unit (BUNIT = {unit.text()})",)
    if unit is not None and unit.text().lower().replace(" ", "") in ("electrons/s", "electron/s", "e-/s", "e/s"):
        exposure = _exposure(cards)[0]
        return exposure, (f"gain {exposure:g} e⁻ per unit (BUNIT = {unit.text()}, times the exposure)",)
    for card in cards.all(_GAIN):
        value = card.number()
        if 0 < value <= _HIGHEST_GAIN:
            return value, (f"gain {value:g} e⁻/ADU ({card.name})",)
        if value > _HIGHEST_GAIN:
            return math.nan, (f"assumed: {card.name} = {value:g} is a setting of the camera; gain not known",)
    return math.nan, ("assumed: gain not known, the noise is taken from the image",)


def _scale(cards: Cards) -> tuple[float, tuple[str, ...]]:
    card = cards.number(_SCALE_NAMES)
    if card is not None and card.number() > 0:
        return card.number(), (f"scale {card.number():g}″ per pixel ({card.name})",)
    pixel, focus = cards.number(("XPIXSZ", "PIXSIZE1")), cards.number(("FOCALLEN", "FOCUSLEN"))
    if pixel is not None and focus is not None and pixel.number() > 0 and focus.number() > 0:
        scale = pixel.number() * 1e-3 / focus.number() * ARCSEC_PER_RADIAN
        return scale, (f"scale about {scale:.4g}″ per pixel ({pixel.name} and {focus.name})",)
    plate, scanned = cards.number(["PLTSCALE"]), cards.number(["XPIXELSZ"])
    if plate is not None and scanned is not None:
        scale = plate.number() * scanned.number() * 1e-3
        return scale, (f"scale {scale:.4g}″ per pixel (PLTSCALE and XPIXELSZ)",)
    return math.nan, ()


def _kind(cards: Cards) -> str:
    card = cards.first(("IMAGETYP", "OBSTYPE", "FRAME", "IMGTYPE"))
    text = "" if card is None else card.text().lower()
    words = {"dark": "dark", "bias": "bias", "zero": "bias", "flat": "flat", "light": "light", "object": "light"}
    return next((kind for word, kind in words.items() if word in text), "")

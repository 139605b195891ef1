"""Keywords: the facts of an exposure from its FITS header, each with a line on its origin.

These are the station, the direction of the telescope, the middle of the exposure, and the properties of the camera.
``facts.lines`` are for printing: each fact with its keyword, assumptions ("assumed: …") and doubts ("doubt: …").

Observatories use many names for one fact: each is looked up in a list of keywords, the more reliable ones first
(:class:`Cards`), and comes with a line on the keyword and its interpretation.

- :func:`station`: the sign of the longitude varies. TheSkyX and the national observatories of the United States count
  west as positive, most others east. It is decided by a letter, else by the sidereal time of the header, else by the
  comment, else by the time zone of the date, else by the program that wrote the header; else east positive is assumed.
- :func:`aims`: the directions, from the valid pairs of keywords.
- :func:`~sameas.sky.frame.exposure_time.middle`: the time.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sameas.errors import Argument, InputError, Message
from sameas.representation import in_short
from sameas.sky.frame.cards import Card, Cards, is_zoned, zone_of
from sameas.sky.frame.exposure_time import STARTS, middle
from sameas.space import ARCSEC_PER_RADIAN

if TYPE_CHECKING:
    from astropy.io.fits import Header
    from astropy.time import Time

_LATITUDE = ("OBSGEO-B", "SITELAT", "LATITUDE", "GEOLAT", "OBSLAT", "LAT-OBS", "OBS-LAT", "ESO TEL GEOLAT", "TELLAT")
_LONGITUDE = ("OBSGEO-L", "SITELONG", "LONGITUD", "GEOLON", "OBSLONG", "LONG-OBS", "OBS-LONG", "ESO TEL GEOLON",
              "TELLONG", "GEOLONG", "OBSLON", "LONGITUDE", "SITELON")  # fmt: skip
_HEIGHT = ("OBSGEO-H", "SITEELEV", "ALTITUDE", "HEIGHT", "GEOELEV", "ALT-OBS", "OBS-ELEV", "ESO TEL GEOELEV", "SITEALT")
_SIDEREAL = ("LST", "ST", "LST-OBS", "LMST", "SIDEREAL", "LST-HDR")
_PLACES = ("ORIGIN", "OBSERVAT", "TELESCOP", "SITE", "SITENAME", "OBSCODE", "MPCCODE", "OBSERVER")
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
    line = f"station {lat_deg:+.4f}°, {station.lon_deg:+.4f}° east{called}: {lat.name}, {lon.name}, {how}"
    return station, (line, *_sidereal_doubt(cards, east_deg, how, time))


def _sidereal_doubt(cards: Cards, east_deg: float, how: str, time: Time | None) -> tuple[str, ...]:
    """A doubt if the sidereal time of the header fits the time and the longitude by neither sign of it.

    None if the date has a time zone: the sidereal time is then the one that is wrong.
    """
    card = cards.first(_SIDEREAL)
    if card is None or time is None or not 0 <= card.angle()[0] < 24 or any(map(is_zoned, cards.all(STARTS)[:1])):
        return ()
    signs = (1, -1) if how.startswith(("assumed", "west positive as")) else (1,)
    off_h = min((_sidereal_off_h(time, sign * east_deg, card.angle()[0]) for sign in signs), key=abs)
    if abs(off_h) < 2 * _SIDEREAL_TOLERANCE_H:
        return ()
    return (
        f"doubt: {card.name} = {card.text()} is {abs(off_h):.1f} h {'ahead of' if off_h < 0 else 'behind'} the time "
        "and the longitude: is the time local, or the longitude wrong?",
    )


def _sidereal_off_h(time: Time, east_deg: float, hours: float) -> float:
    """The sidereal time of a longitude minus ``hours``, within ±12 h."""
    return (sidereal_time_h(time) + east_deg / 15 - hours + 12) % 24 - 12


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
        difference_h = {sign: abs(_sidereal_off_h(time, sign * lon_deg, hours)) for sign in (1, -1)}
        best = 1 if difference_h[1] < difference_h[-1] else -1
        if difference_h[best] < _SIDEREAL_TOLERANCE_H and difference_h[-best] > 3 * _SIDEREAL_TOLERANCE_H:
            return best * lon_deg, f"{'east' if best > 0 else 'west'} positive by {sidereal.name}"
    if card.says(r"\bwest\b|\(\+?w\)|\+\s*w\b") and not card.says(r"\beast\b|west(ern)?\s*(is\s*)?(neg|-)"):
        return -lon_deg, "west positive by its comment"
    if card.says(r"\beast\b|\(\+?e\)|\+\s*e\b"):
        return lon_deg, "east positive by its comment"
    zones_h = {card.name: 24.0 * zone_of(card.text()) for card in cards.all(STARTS)}
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


#: Pairs of keywords of the direction, the more reliable first.
_DIRECTIONS = (
    ("OBJCTRA", "OBJCTDEC"), ("RA", "DEC"), ("TELRA", "TELDEC"), ("RA_TARG", "DEC_TARG"), ("RA-OBS", "DEC-OBS"),
    ("RA_OBJ", "DEC_OBJ"), ("CAT-RA", "CAT-DEC"), ("RA_PNT", "DEC_PNT"), ("OBJRA", "OBJDEC"), ("RA_DEG", "DEC_DEG"),
    ("RADEG", "DECDEG"), ("RA_TEL", "DEC_TEL"), ("RA-TEL", "DEC-TEL"), ("TEL-RA", "TEL-DEC"), ("TEL_RA", "TEL_DEC"),
    ("MOUNTRA", "MOUNTDEC"), ("CENTRA", "CENTDEC"), ("RAEYE", "DECEYE"), ("OBSRA", "OBSDEC"), ("CRVAL1", "CRVAL2"),
)  # fmt: skip
_HOURS = r"\bhours?\b|\bhrs?\b|[\[(]h[\])]|\d\s*h\s*$"
_RADIANS = r"\brad(ian)?s?\b"
_DEGREES = r"\bdeg(ree)?s?\b|°|\d\s*d\s*$"
#: Directions closer than this are the same, degrees.
_SAME_DEG = 0.5

Direction = tuple[float, float]


def aims(cards: Cards) -> tuple[tuple[Direction, ...], tuple[str, ...]]:
    """ICRS directions (ra_deg, dec_deg) of the telescope, the most likely first, and the lines on them.

    A right ascension is in hours if it is sexagesimal and below 24, or if its comment or unit is hours; else in
    degrees. A plain number below 24 without a unit may be hours too: this reading, and the directions of further
    keywords, come after the first, for those who can try them. A pair of exact zeros is a mount that was not set.
    """
    readings: list[tuple[Direction, str]] = []
    in_hours: list[tuple[Direction, str]] = []
    doubts: list[str] = []
    for names in _DIRECTIONS:
        ra, dec = (cards.first([name]) for name in names)
        if ra is None or dec is None or (names[0] == "CRVAL1" and not _is_equatorial(cards)):
            continue
        ra_deg, dec_deg, unit = _in_degrees(ra, dec)
        if ra_deg == dec_deg == 0:
            doubts.append(f"doubt: {ra.name} and {dec.name} are 0, as of a mount that was not set; not used")
        elif not (0 <= ra_deg <= 360 and abs(dec_deg) <= 90):
            doubts.append(f"doubt: {ra.name} = {ra.text()}, {dec.name} = {dec.text()} are no direction; not used")
        else:
            readings.append(_icrs(cards, ra_deg, dec_deg, f"{ra.name} in {unit}, {dec.name}"))
            if unit == "degrees" and ra_deg < 24 and names[0] != "CRVAL1" and not _says(ra, _DEGREES):
                in_hours.append(_icrs(cards, 15 * ra_deg, dec_deg, f"{ra.name} in hours, {dec.name}"))
    different: list[tuple[Direction, str]] = []
    for direction, how in (*readings, *in_hours):
        if all(_apart_deg(direction, other) > _SAME_DEG for other, _ in different):
            different.append((direction, how))
    lines = [
        f"{'also possible' if row else 'aim'} {ra:.5f}°, {dec:+.5f}°: {how}"
        for row, ((ra, dec), how) in enumerate(different)
    ]
    return tuple(direction for direction, _ in different), (*lines, *doubts)


def _in_degrees(ra: Card, dec: Card) -> tuple[float, float, str]:
    """Both values in degrees, NaN if not read, and the unit of the right ascension."""
    (ra_value, sexagesimal), (dec_value, _) = ra.angle(), dec.angle()
    if not sexagesimal and _says(ra, _RADIANS):
        return math.degrees(ra_value), math.degrees(dec_value), "radians"
    if _says(ra, _HOURS) or (sexagesimal and ra_value < 24 and not _says(ra, _DEGREES)):
        return 15 * ra_value, dec_value, "hours"
    return ra_value, dec_value, "degrees"


def _says(card: Card, pattern: str) -> bool:
    return card.says(pattern) or re.search(pattern, card.text(), re.IGNORECASE) is not None


def _apart_deg(one: Direction, other: Direction) -> float:
    east = ((one[0] - other[0] + 180) % 360 - 180) * math.cos(math.radians(one[1]))
    return math.hypot(east, one[1] - other[1])


def _is_equatorial(cards: Cards) -> bool:
    kind = cards.first(["CTYPE1"])
    return kind is not None and kind.text().upper().startswith("RA")


def _icrs(cards: Cards, ra_deg: float, dec_deg: float, how: str) -> tuple[Direction, str]:
    """A direction at the header's EQUINOX converted to ICRS. EPOCH is not used: it is often that of the exposure."""
    card = cards.number(["EQUINOX"])
    year = 2000.0 if card is None else card.number()
    if abs(year - 2000) < 0.01 or not 1800 < year < 2200:
        return (ra_deg, dec_deg), how + ("" if card is not None else ", assumed: J2000")
    from astropy import units as u
    from astropy.coordinates import FK4, FK5, SkyCoord

    frame = FK4(equinox=f"B{year}") if year == 1950 else FK5(equinox=f"J{year}")
    direction = SkyCoord(ra_deg * u.deg, dec_deg * u.deg, frame=frame).icrs
    return (float(direction.ra.deg), float(direction.dec.deg)), f"{how}, precessed from {year:g}"


_EXPOSURE = ("EXPTIME", "EXPOSURE", "EXP_TIME", "EXP-TIME", "TEXPTIME", "ITIME", "ELAPTIME", "EXPOSED", "XPOSURE")
#: Longest exposure that is not doubted, s: a night.
_LONGEST_S = 43_200.0
_GAIN = ("EGAIN", "GAIN", "CCDGAIN", "GAIN1", "GAINEFF", "ATODGAIN", "ESO DET OUT1 CONAD", "HIERARCH GAIN")
_READ_NOISE = (
    "RDNOISE", "READNOIS", "READNOISE", "RON", "ENOISE", "RDNOISE1", "READNSE", "READNSEA", "ESO DET OUT1 RON",
)  # fmt: skip
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

    gain_e_per_adu, read_noise_e : NaN if not known; the noise is then measured on the image alone.
    saturation_adu : lowest value of a saturated pixel, infinite if not known.
    exposure_s : NaN if not known.
    mid_time : middle of the exposure with its scale, or None.
    station : observing site, or None.
    aim_deg : (ra, dec) ICRS direction of the telescope, or None.
    other_aims_deg : of other keywords, or readings of the same, that are tried if that fails.
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
    other_aims_deg: tuple[tuple[float, float], ...] = ()
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
        directions, aiming = aims(cards)
        scale, scaling = _scale(cards)
        electronics, electric = _electronics(cards, given)
        return cls(
            **electronics,
            exposure_s=exposure,
            mid_time=time,
            station=site,
            aim_deg=directions[0] if directions else None,
            other_aims_deg=directions[1:],
            scale_arcsec_per_px=scale,
            kind=_kind(cards),
            lines=(*notes, *lines, *timing, *placing, *aiming, *scaling, *electric),
            name=name,
        )

    def time(self) -> Time:
        """The middle of the exposure.

        Raises InputError: it is not known.
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
    line = f"exposure {value:g} s ({card.name} in {unit})"
    if value > _LONGEST_S:
        return value, (line, f"doubt: an exposure of {value / 3600:.1f} h: is {card.name} in milliseconds?")
    return value, (line,)


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
        scale = card.number() * (3600 if card.says(r"\bdeg(ree)?s?\b") and not card.says("sec") else 1)
        return scale, (f"scale {scale:g}″ per pixel ({card.name})",)
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

"""Station: where a frame was taken, and where the telescope was aimed, as headers tell it.

The sign of a longitude is not agreed upon: TheSkyX and the national observatories of the United States count west as
positive, most others east. It is told by a letter or a comment, else by the sidereal time of the header, else by the
program that wrote it, else east is assumed and a line says so.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

from sameas.sky.frame.cards import Card, Cards

if TYPE_CHECKING:
    from astropy.time import Time

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
_SIDEREAL_TOLERANCE_H = 0.3  # the sidereal time may be that of the start, the middle or the end


@dataclass(frozen=True)
class Station:
    """A place on the Earth: degrees, east positive; metres above the ellipsoid, NaN if unknown; MPC code or ''."""

    lat_deg: float
    lon_deg: float
    height_m: float = math.nan
    code: str = ""


def station(cards: Cards, time: Time | None) -> tuple[Station | None, tuple[str, ...]]:
    """The station, None where the header does not tell, and the lines that say how it was read."""
    lat, lon = cards.first(_LATITUDE), cards.first(_LONGITUDE)
    if lat is None or lon is None:
        return None, ()
    lat_deg, lon_deg = lat.angle()[0], lon.angle()[0]
    if not (abs(lat_deg) <= 90 and abs(lon_deg) <= 360):
        return None, (f"doubt: {lat.name} = {lat.text()}, {lon.name} = {lon.text()} are not a place; not used",)
    east_deg, how = _east(cards, lon, lon_deg, time)
    height = cards.number(_HEIGHT)
    place = Station(
        lat_deg, (east_deg + 180) % 360 - 180, math.nan if height is None else height.number(), _code(cards)
    )
    called = f" (MPC {place.code})" if place.code else ""
    return place, (f"station {lat_deg:+.4f}°, {place.lon_deg:+.4f}° east{called}: {lat.name}, {lon.name}, {how}",)


def _east(cards: Cards, card: Card, lon_deg: float, time: Time | None) -> tuple[float, str]:
    """The longitude counted to the east, and what told its sign."""
    letter = re.search(r"[EWew]\s*$", card.text())
    if letter:
        return (lon_deg if letter[0].strip().upper() == "E" else -lon_deg), "its letter"
    if card.name.startswith("OBSGEO") or lon_deg > 180:
        return lon_deg, "east positive"
    sidereal = cards.first(_SIDEREAL)
    hours = math.nan if sidereal is None else sidereal.angle()[0]
    if time is not None and sidereal is not None and math.isfinite(hours):
        off = {sign: abs((sidereal_time_h(time) + sign * lon_deg / 15 - hours + 12) % 24 - 12) for sign in (1, -1)}
        best = 1 if off[1] < off[-1] else -1
        if off[best] < _SIDEREAL_TOLERANCE_H and off[-best] > 3 * _SIDEREAL_TOLERANCE_H:
            return best * lon_deg, f"{'east' if best > 0 else 'west'} positive as {sidereal.name} tells"
    if card.says(r"\bwest\b|\(\+?w\)|\+\s*w\b") and not card.says(r"\beast\b|west(ern)?\s*(is\s*)?(neg|-)"):
        return -lon_deg, "west positive as its comment says"
    if card.says(r"\beast\b|\(\+?e\)|\+\s*e\b"):
        return lon_deg, "east positive as its comment says"
    writer = cards.first(("SWCREATE", "OBSERVAT", "ORIGIN"))
    if writer is not None and re.search(r"TheSky|KPNO|NOAO|CTIO", writer.text()):
        return -lon_deg, f"west positive as {writer.text()} writes"
    return lon_deg, "assumed: east positive"


def sidereal_time_h(time: Time) -> float:
    """Greenwich mean sidereal time in hours, good to a few seconds (Meeus, Astronomical Algorithms, eq. 12.4)."""
    return float((18.697374558 + 24.06570982441908 * (time.mjd - 51544.5)) % 24)


def _code(cards: Cards) -> str:
    """The code of the Minor Planet Center, three letters and digits in parentheses or alone under its own name."""
    for card in cards.all(_PLACES):
        match = re.search(r"\(([0-9A-Z]\d{2})\)", card.text())
        if match is None and card.name in ("OBSCODE", "MPCCODE"):
            match = re.fullmatch(r"([0-9A-Z]\d{2})", card.text())
        if match:
            return match[1]
    return ""


def aim(cards: Cards) -> tuple[tuple[float, float] | None, tuple[str, ...]]:
    """ICRS direction (ra_deg, dec_deg) that the telescope was aimed at, None if not told, and the line on it."""
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
    """A direction of the header's EQUINOX, in ICRS. EPOCH, often that of the exposure, is not believed."""
    card = cards.number(["EQUINOX"])
    year = 2000.0 if card is None else card.number()
    if abs(year - 2000) < 0.01 or not 1800 < year < 2200:
        return ra_deg, dec_deg, "" if card is not None else ", assumed: J2000"
    from astropy import units as u
    from astropy.coordinates import FK4, FK5, SkyCoord

    frame = FK4(equinox=f"B{year}") if year == 1950 else FK5(equinox=f"J{year}")
    there = SkyCoord(ra_deg * u.deg, dec_deg * u.deg, frame=frame).icrs
    return float(there.ra.deg), float(there.dec.deg), f", precessed from {year:g}"

"""The direction of the telescope from a header, its other possible readings, and a line on each.

A right ascension is in hours if it is sexagesimal and below 24, or if its comment or unit is hours; else in degrees. A
plain number below 24 without a unit may be hours too: this reading, and the directions of further keywords, come after
the first, for those who can try them. A pair of exact zeros is a mount that was not set.
"""

from __future__ import annotations

import math
import re

from sameas.sky.frame.cards import Card, Cards

#: Pairs of keywords, the more reliable first.
_NAMES = (
    ("OBJCTRA", "OBJCTDEC"),
    ("RA", "DEC"),
    ("TELRA", "TELDEC"),
    ("RA_TARG", "DEC_TARG"),
    ("RA-OBS", "DEC-OBS"),
    ("RA_OBJ", "DEC_OBJ"),
    ("CAT-RA", "CAT-DEC"),
    ("RA_PNT", "DEC_PNT"),
    ("OBJRA", "OBJDEC"),
    ("RA_DEG", "DEC_DEG"),
    ("RADEG", "DECDEG"),
    ("RA_TEL", "DEC_TEL"),
    ("RA-TEL", "DEC-TEL"),
    ("TEL-RA", "TEL-DEC"),
    ("TEL_RA", "TEL_DEC"),
    ("MOUNTRA", "MOUNTDEC"),
    ("CENTRA", "CENTDEC"),
    ("RAEYE", "DECEYE"),
    ("OBSRA", "OBSDEC"),
    ("CRVAL1", "CRVAL2"),
)
_HOURS = r"\bhours?\b|\bhrs?\b|[\[(]h[\])]|\d\s*h\s*$"
_RADIANS = r"\brad(ian)?s?\b"
_DEGREES = r"\bdeg(ree)?s?\b|°|\d\s*d\s*$"
#: Directions closer than this are the same, degrees.
_SAME_DEG = 0.5

Direction = tuple[float, float]


def aims(cards: Cards) -> tuple[tuple[Direction, ...], tuple[str, ...]]:
    """ICRS directions (ra_deg, dec_deg), the most likely first, and the lines on them; none if the header has none."""
    readings: list[tuple[Direction, str]] = []
    in_hours: list[tuple[Direction, str]] = []
    doubts: list[str] = []
    for names in _NAMES:
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

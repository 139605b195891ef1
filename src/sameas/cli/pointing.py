"""Aims and scales as they are typed."""

from __future__ import annotations

import math

from sameas.errors import InputError
from sameas.front.framing import CLOSE


def two_numbers(text: str, option: str, what: str) -> tuple[float, float]:
    """``A,B`` as two numbers."""
    try:
        one, two = (float(part) for part in text.split(","))
    except ValueError:
        raise InputError(f"{option} {text}: give {what}") from None
    return one, two


def aim_of(text: str | None) -> tuple[float, float] | None:
    """``RA,DEC`` in degrees, or sexagesimal with right ascension in hours."""
    if text is None:
        return None
    what = "RA,DEC in degrees, or 04:10:09,+22:50:22"
    if ":" not in text and "h" not in text:
        ra, dec = two_numbers(text, "--aim", what)
    else:
        from astropy.coordinates import SkyCoord

        try:
            at = SkyCoord(*text.split(","), unit=("hourangle", "deg"))
        except (ValueError, TypeError) as error:
            raise InputError(f"--aim {text}: give {what}") from error
        ra, dec = float(at.ra.deg), float(at.dec.deg)
    if not (math.isfinite(ra) and -90 <= dec <= 90):
        raise InputError(f"--aim {text}: give {what}")
    return ra % 360.0, dec


def scale_of(text: str | None) -> tuple[float, float] | None:
    """``LO,HI``, or one number with five per cent either way."""
    if text is None:
        return None
    if "," not in text:
        one, _ = two_numbers(f"{text},0", "--scale", "LO,HI in arcsec per pixel")
        low, high = one * (1 - CLOSE), one * (1 + CLOSE)
    else:
        low, high = two_numbers(text, "--scale", "LO,HI in arcsec per pixel")
    if not 0 < low <= high < math.inf:
        raise InputError(f"--scale {text}: give LO,HI in arcsec per pixel, both above zero, the smaller one first")
    return low, high

"""Hints: what is known of where a frame points, from the command line and from its header."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from typing import Any

from sameas.errors import InputError
from sameas.sky.frame.image import Frame
from sameas.sky.frame.pointing_hints import Aim, AllSky, ApproximateWcs, Hint
from sameas.sky.frame.tangent import Pointing

#: A scale from focal length and pixels is believed so far, a scale of one number so far.
LOOSE, CLOSE = 0.2, 0.05
#: How far off an aim may be, if nothing is said: degrees, and in halves of the frame's diagonal.
OFF_DEG, OFF_FRAMES = 0.5, 1.0


@dataclass(frozen=True)
class PointingOptions:
    """What the user says of where a frame points.

    aim_deg : right ascension and declination. radius_deg : how far off. scale_arcsec : least and largest.
    header : whether a plate solution in the header is believed to be nearly right.
    """

    aim_deg: tuple[float, float] | None = None
    radius_deg: float | None = None
    scale_arcsec: tuple[float, float] | None = None
    header: bool = True


def hints(said: PointingOptions, frame: Frame, *, whole_sky: bool = True) -> list[Hint]:
    """From the surest to the least sure: the header's solution, the aim, and nothing but a range of scales.

    Raises
    ------
    InputError : nothing is known of the place, or not the scale.
    """
    found: list[Hint] = []
    wcs = _solution(frame) if said.header and said.aim_deg is None else None
    if wcs is not None:
        found.append(ApproximateWcs(wcs, radius_deg=said.radius_deg))
    scale = said.scale_arcsec or _scale(frame, wcs)
    aim = said.aim_deg or frame.facts.aim_deg
    if scale is None:
        if found:
            return found
        where = "the aim is known, but not the scale; say" if aim else "no plate solution and no aim in the header; say"
        more = "--scale LO,HI (arcsec per pixel)" if aim else "--aim RA,DEC and --scale LO,HI (arcsec per pixel)"
        raise InputError(f"{frame.name}: {where} {more}")
    if aim is not None:
        half_deg = 0.5 * math.hypot(*frame.shape) * scale[1] / 3600.0
        radius = said.radius_deg if said.radius_deg is not None else max(OFF_DEG, OFF_FRAMES * half_deg)
        found.append(Aim(*aim, radius_deg=min(radius, 180.0), scale_arcsec=scale))
    elif not found:
        if not whole_sky:
            raise InputError(
                f"{frame.name}: no aim in the header; say --aim RA,DEC, or --catalog bright for the whole sky"
            )
        found.append(AllSky(scale))
    return found


def _solution(frame: Frame) -> Any:
    """The header's WCS where it has a celestial one that makes sense, else None."""
    from astropy.wcs import WCS

    if frame.header is None:
        return None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            wcs = WCS(frame.header)
            wcs = wcs.celestial if wcs.naxis > 2 else wcs
            if not wcs.has_celestial:
                return None
            scale = Pointing.of_wcs(wcs, frame.shape).scale_arcsec
        except Exception:  # astropy and wcslib refuse broken headers in many ways; the aim may still do
            return None
    # Without CD or CDELT wcslib takes a degree per pixel.
    return wcs if 1e-4 < scale < 3599.0 else None


def _scale(frame: Frame, wcs: Any) -> tuple[float, float] | None:
    told = frame.facts.scale_arcsec_per_px
    if math.isfinite(told) and told > 0:
        return told * (1 - LOOSE), told * (1 + LOOSE)
    if wcs is not None:
        told = Pointing.of_wcs(wcs, frame.shape).scale_arcsec
        return told * (1 - CLOSE), told * (1 + CLOSE)
    return None


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

"""The pointing of a frame: what the options and the header say of it, and how far the header was wrong."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from sameas.errors import InputError, naming
from sameas.sky.frame.image import Frame
from sameas.sky.frame.keywords import sidereal_time_h
from sameas.sky.frame.pointing import Pointing, sky_of
from sameas.sky.frame.pointing_hints import Aim, AllSky, ApproximateWcs, Hint
from sameas.sky.movers.rates import OBLIQUITY, sun_longitude_deg
from sameas.space import ARCSEC_PER_RADIAN, chord_angle_deg, directions_deg, mean_direction, unit_vectors

if TYPE_CHECKING:
    from astropy.wcs import WCS

    from sameas.sky.catalogue import Catalogue

#: Relative tolerance of a scale from focal length and pixels, and of a scale that was given as one number.
LOOSE, CLOSE = 0.2, 0.05
#: Ranges of scales, times that of a header, at whose own no solution is found: it may leave out the binning of the
#: pixels, or a lens that changes the focal length. Each is as wide as the range around the header's; 2 and ½ first.
OTHER_SCALES = ((1.8, 2.7), (0.36, 0.54), (1.2, 1.8), (0.54, 0.8), (2.7, 4.05), (0.24, 0.36))
#: A catalogue within this angle from its middle gives the aim of a frame without one, degrees.
_SMALL_DEG = 10.0
#: Heights within this of the horizon, degrees, are not doubted: refraction, positions without precession (chosen).
_LOW_DEG = 1.5
#: Default error of an aim: the larger of this many degrees and this many half diagonals of the frame.
OFF_DEG, OFF_FRAMES = 0.5, 1.0


@dataclass(frozen=True)
class PointingOptions:
    """Options on the pointing of a frame.

    aim_deg : right ascension and declination. radius_deg : largest error of it. scale_arcsec : limits, per pixel.
    header : whether a plate solution in the header is used as approximate.
    """

    aim_deg: tuple[float, float] | None = None
    radius_deg: float | None = None
    scale_arcsec: tuple[float, float] | None = None
    header: bool = True


def hints(pointing: PointingOptions, frame: Frame, *, whole_sky: bool = True) -> list[Hint]:
    """Hints on the pointing, the most certain first: header solution, aim, whole sky with a range of scales.

    Raises InputError: the pointing or the scale is unknown.
    """
    candidates: list[Hint] = []
    wcs = _solution(frame) if pointing.header else None
    if wcs is not None and pointing.aim_deg is None:
        candidates.append(ApproximateWcs(wcs, radius_deg=pointing.radius_deg))
    scale = pointing.scale_arcsec or _scale(frame, wcs)
    aim = pointing.aim_deg or frame.facts.aim_deg
    if scale is None:
        if candidates:
            return candidates
        where = "the aim is known, but not the scale" if aim else "no plate solution and no aim in the header"
        more = "{scale:LO,HI} (arcsec per pixel)"
        raise InputError(f"{frame.name}: {where}", naming(f"give {more}" if aim else f"give {{aim:RA,DEC}} and {more}"))
    if aim is not None:
        half_deg = 0.5 * math.hypot(*frame.shape) * scale[1] / 3600.0
        radius = pointing.radius_deg if pointing.radius_deg is not None else max(OFF_DEG, OFF_FRAMES * half_deg)
        others = () if pointing.aim_deg is not None else frame.facts.other_aims_deg
        candidates += [Aim(*one, radius_deg=min(radius, 180.0), scale_arcsec=scale) for one in (aim, *others)]
    elif not candidates:
        if not whole_sky:
            raise InputError(
                f"{frame.name}: no aim in the header",
                naming("give {aim:RA,DEC}, or {catalogue:'bright'} for the whole sky"),
            )
        candidates.append(AllSky(scale))
    return candidates


def aim_of_catalogue(sky: AllSky, stars: Catalogue) -> Aim | None:
    """The middle of a catalogue of a small field, with its radius; None if the catalogue is larger."""
    usable = np.isfinite(stars.astrometry.ra_deg) & np.isfinite(stars.astrometry.dec_deg)
    vectors = unit_vectors(stars.astrometry.ra_deg[usable], stars.astrometry.dec_deg[usable])
    if not len(vectors):
        return None
    middle = mean_direction(vectors)
    radius_deg = chord_angle_deg(float(np.linalg.norm(vectors - middle, axis=1).max()))
    if radius_deg > _SMALL_DEG:
        return None
    ra_deg, dec_deg = (float(value) for value in directions_deg(middle))
    return Aim(ra_deg, dec_deg, max(radius_deg, 1e-3), sky.scale_arcsec)


def at_other_scales(pointing: PointingOptions, own_hints: Sequence[Hint]) -> tuple[float, list[Aim]]:
    """The scale of the header, and the first aim at each of :data:`OTHER_SCALES`; none if the scale was given."""
    aim = next((hint for hint in own_hints if isinstance(hint, Aim)), None)
    if aim is None or pointing.scale_arcsec is not None:
        return math.nan, []
    scale = sum(aim.scale_arcsec) / 2.0
    return scale, [replace(aim, scale_arcsec=(low * scale, high * scale)) for low, high in OTHER_SCALES]


def header_elsewhere(pointing: PointingOptions, own_hints: Sequence[Hint], frame: Frame) -> str:
    """The direction in the header, if it is farther than the radius from the one that was given; else ""."""
    header, aim = frame.facts.aim_deg, next((hint for hint in own_hints if isinstance(hint, Aim)), None)
    if pointing.aim_deg is None or header is None or aim is None:
        return ""
    off_deg = chord_angle_deg(float(np.linalg.norm(unit_vectors(*header) - unit_vectors(*pointing.aim_deg))))
    if off_deg <= aim.radius_deg:
        return ""
    return f"the header's aim, {header[0]:.4f} {header[1]:+.4f}, is {off_deg:.3g}° from the one given"


def _solution(frame: Frame) -> WCS | None:
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


def _scale(frame: Frame, wcs: WCS | None) -> tuple[float, float] | None:
    scale = frame.facts.scale_arcsec_per_px
    if math.isfinite(scale) and scale > 0:
        return scale * (1 - LOOSE), scale * (1 + LOOSE)
    if wcs is not None:
        scale = Pointing.of_wcs(wcs, frame.shape).scale_arcsec
        return scale * (1 - CLOSE), scale * (1 + CLOSE)
    return None


def horizon_doubt(frame: Frame, middle_deg: tuple[float, float]) -> str:
    """A doubt if, at the time and the station of the header, the frame's middle is below the horizon or the Sun above.

    middle_deg : right ascension and declination. "" if neither is, or time or station is not known.
    """
    time, station = frame.facts.mid_time, frame.facts.station
    if time is None or station is None:
        return ""
    longitude = np.radians(sun_longitude_deg(np.array(time.mjd)))
    tilt = np.array([math.cos(OBLIQUITY), math.sin(OBLIQUITY)])
    sun = np.array([np.cos(longitude), *(np.sin(longitude) * tilt)])
    zenith = unit_vectors(15.0 * sidereal_time_h(time) + station.lon_deg, station.lat_deg)
    field_deg, sun_deg = (math.degrees(math.asin(float(zenith @ one))) for one in (unit_vectors(*middle_deg), sun))
    low = [f"the frame's middle is {-field_deg:.0f}° below the horizon"] if field_deg < -_LOW_DEG else []
    high = [f"the Sun {sun_deg:.0f}° above it" if low else f"the Sun is {sun_deg:.0f}° above the horizon"]
    words = [*low, *(high if sun_deg > _LOW_DEG else [])]
    if not words:
        return ""
    return f"doubt: {' and '.join(words)} of the station at this time: is the time local, or the longitude wrong?"


#: Smallest differences of a plate solution in the header that are said: anywhere, pixels; degrees; share of the scale.
_OFF_PX, _OFF_ROTATION_DEG, _OFF_SCALE = 2.0, 0.02, 5e-4


def difference_of_solutions(header: WCS, found: WCS, shape: tuple[int, int]) -> str:
    """How one plate solution of a frame of ``shape`` (rows, columns) differs from the right one, "" if hardly.

    >>> from dataclasses import replace
    >>> one = Pointing(unit_vectors(10.0, 20.0), np.diag([-1e-5, 1e-5]), np.array([50.0, 50.0]))
    >>> other = replace(one, cd=np.diag([-1e-5, 1.02e-5]), origin_px=one.origin_px + 10.0)
    >>> difference_of_solutions(other.to_wcs(), one.to_wcs(), (101, 101))
    'off by 29.5″ in the middle, by 31″ at most, its scale by 1.00 %'
    """
    rows, columns = shape
    x, y = np.meshgrid([0.0, (columns - 1) / 2.0, columns - 1.0], [0.0, (rows - 1) / 2.0, rows - 1.0])
    px = np.column_stack([x.ravel(), y.ravel()])
    off = ARCSEC_PER_RADIAN * np.linalg.norm(sky_of(header, px) - sky_of(found, px), axis=1)
    one, right = (Pointing.of_wcs(wcs, shape) for wcs in (header, found))
    if off.max() < _OFF_PX * right.scale_arcsec:
        return ""
    parts = [f"off by {off[4]:.3g}″ in the middle, by {off.max():.3g}″ at most"]
    turned = (one.rotation_deg - right.rotation_deg + 180.0) % 360.0 - 180.0
    stretched = one.scale_arcsec / right.scale_arcsec - 1.0
    if one.parity != right.parity:
        parts.append("mirrored")
    elif abs(turned) > _OFF_ROTATION_DEG:
        parts.append(f"rotated by {abs(turned):.2f}°")
    if abs(stretched) > _OFF_SCALE:
        parts.append(f"its scale by {100.0 * abs(stretched):.2f} %")
    return ", ".join(parts)

"""Keywords: the facts of an exposure from its header, each with the line that says where it comes from.

``facts.lines`` are printed: each fact with its keyword, what was assumed ("assumed: …") and what is doubtful
("doubt: …").
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sameas.errors import InputError
from sameas.representation import in_short
from sameas.sky.frame.observation import Cards, Station, aim, middle, station
from sameas.space import ARCSEC_PER_RADIAN

if TYPE_CHECKING:
    from astropy.io.fits import Header
    from astropy.time import Time

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
# Arcsec per pixel, as observatories call it.
_SCALE_NAMES = (
    "SECPIX", "PIXSCALE", "SECPIX1", "PIXSCAL1", "ARCSECPP", "IM_SCALE", "IMSCALE", "PIXELSCL", "PIXSCAL", "SECPPIX",
    "CCDSCALE",
)  # fmt: skip
_CALLED = {"gain_e_per_adu": "gain", "read_noise_e": "read noise", "saturation_adu": "saturation"}
#: Highest gain, e⁻ per ADU; a larger value of GAIN is a setting of the camera (chosen).
_HIGHEST_GAIN = 30.0


@dataclass(frozen=True)
class Given:
    """What the user knows better than the header; None leaves it to the header."""

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
                raise InputError(f"given {name} is {value}; give a number {lowest}")


@in_short
@dataclass(frozen=True)
class Facts:
    """What is known of an exposure.

    Attributes
    ----------
    gain_e_per_adu, read_noise_e : NaN if not known; the noise is then taken from the image alone.
    saturation_adu : lowest value of a saturated pixel, infinite if not known.
    exposure_s : NaN if not known.
    mid_time : middle of the exposure with its scale, or None.
    station : where it was taken, or None.
    aim_deg : (ra, dec) ICRS that the telescope was aimed at, or None.
    scale_arcsec_per_px : from the focal length and the pixels, NaN if not known; often wrong by ten per cent.
    pedestal_adu : number that was added to all pixels, to be taken away.
    kind : "light", "dark", "bias", "flat" or "" as the header says.
    lines : how all this was read; printable.
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
        """The facts of a header; what is given goes before it."""
        given = given or Given()
        cards = Cards(header)
        exposure, lines = _exposure(cards)
        if given.exposure_s is not None:
            exposure, lines = given.exposure_s, (f"exposure {given.exposure_s:g} s (given)",)
        time, timing = middle(cards, exposure)
        if given.mid_time is not None:
            time, timing = given.mid_time, (f"middle of the exposure {given.mid_time.isot} (given)",)
        elif time is None:
            timing = ("doubt: the header has no time (DATE-OBS, MJD-OBS, JD); motion and movers need one",)
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
        """The facts with a level of saturation read off the pixels, where none was known."""
        if math.isfinite(self.saturation_adu):
            return self
        level, line = plateau(values), "saturation at {:g}: many of the brightest pixels have this value"
        if not math.isfinite(level) and kind.kind in "ui" and kind.itemsize <= 2:
            # A converter of fewer bits than the file has makes a plateau; without one the whole range is used.
            level, line = float(np.iinfo(kind).max), "assumed: saturation at {:g}, the largest number of the file"
        if not math.isfinite(level):
            return self
        return replace(self, saturation_adu=level, lines=(*self.lines, line.format(level)))


def plateau(values: NDArray[Any]) -> float:
    """Level where the brightest pixels pile up, infinite if they do not.

    Above the sky the number of pixels falls with brightness. It rises again at the limit of a detector and on a
    blackened plate. The level is where that peak has risen to half its height.
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
    # A peak in the uppermost bin is the limit of the numbers: all its pixels have the highest value.
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
        # The keyword is defined as "add this to each pixel for a zero-based level": minus what was added.
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

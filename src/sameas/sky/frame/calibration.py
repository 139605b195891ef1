"""Calibration: dark, bias and flat taken off a frame, and the pixels that darks and flats show to be bad.

    light = (raw − bias − (dark − bias) t/t_dark) / flat,   raw − dark where there is no bias,

each a median of several frames, so that a particle's hit in one of them does no harm.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sameas.arrays import BoolArray, FloatArray
from sameas.errors import InputError
from sameas.sky.frame.image import Frame
from sameas.sky.frame.measurements import Flag

#: A pixel of the dark is hot beyond this many robust standard deviations from its surroundings (chosen).
_HOT_SIGMAS = 8.0
#: Hot pixels change from frame to frame by about this share of their excess (chosen).
_UNSTEADY = 0.05
#: Pixels of a flat below this sensitivity, relative to the median, are blind (chosen).
_DARKEST_FLAT = 0.2
#: Exposures count as equal within this share (chosen).
_SAME_EXPOSURE = 0.02


@dataclass(frozen=True)
class MasterFrames:
    """Master frames; make them with :meth:`MasterFrames.of`, call them with a frame: ``masters(frame)``.

    Attributes
    ----------
    bias, dark : (rows, columns) ADU or None; the dark holds the bias unless there is one.
    dark_exposure_s : exposure of the darks, NaN without them.
    flat : (rows, columns) sensitivity around 1, or None.
    excess : (rows, columns) ADU of hot pixels above their surroundings in the dark, 0 for the others, or None.
    dead : (rows, columns) mask of the pixels that are blind in the flats, or None.
    """

    bias: FloatArray | None = None
    dark: FloatArray | None = None
    dark_exposure_s: float = math.nan
    flat: FloatArray | None = None
    excess: FloatArray | None = None
    dead: BoolArray | None = None

    @classmethod
    def of(
        cls, *, biases: Sequence[Frame] = (), darks: Sequence[Frame] = (), flats: Sequence[Frame] = ()
    ) -> MasterFrames:
        """Masters from frames of each kind; any may be missing.

        Raises
        ------
        InputError : frames of different shapes; darks of different exposures without a bias; a flat without light.
        """
        bias = _median(biases) if biases else None
        dark, exposure_s = (None, math.nan) if not darks else _dark(darks, bias)
        flat = None if not flats else _flat(flats, bias, dark, exposure_s)
        excess = None if dark is None else _excess(dark)
        dead = None if flat is None else flat < _DARKEST_FLAT
        shapes = {plane.shape for plane in (bias, dark, flat) if plane is not None}
        if len(shapes) > 1:
            raise InputError(
                f"calibration: bias, dark and flat have different shapes {sorted(shapes)}; use one binning"
            )
        return cls(bias, dark, exposure_s, flat, excess, dead)

    def __call__(self, frame: Frame) -> Frame:
        """The frame calibrated, its bad pixels flagged, one line in its facts for each step.

        Raises
        ------
        InputError : the masters have another shape.
        """
        for plane in (self.bias, self.dark, self.flat):
            if plane is not None and plane.shape != frame.shape:
                raise InputError(
                    f"{frame.name}: the frame has shape {frame.shape}, the calibration {plane.shape}; use one binning"
                )
        offset, lines = self._offset(frame)
        image = frame.image.astype(float) - offset
        if self.flat is not None:
            image, lines = image / np.maximum(self.flat, _DARKEST_FLAT), (*lines, "divided by the flat")
        sigma = frame.sigma
        if sigma is not None and self.flat is not None:
            sigma = (sigma / np.maximum(self.flat, _DARKEST_FLAT)).astype(np.float32)
        # Saturated pixels are marked already; their level falls with what is subtracted.
        level = frame.facts.saturation_adu - float(np.median(offset))
        facts = replace(frame.facts, saturation_adu=level, pedestal_adu=0.0, lines=(*frame.facts.lines, *lines))
        result = replace(frame, image=image.astype(np.float32), sigma=sigma, facts=facts)
        if self.excess is not None:
            result = result.marked(_harmful(self.excess, result), Flag.HOT)
        return result if self.dead is None else result.marked(self.dead, Flag.MASKED)

    def _offset(self, frame: Frame) -> tuple[FloatArray, tuple[str, ...]]:
        """(rows, columns) ADU of bias, pedestal and dark current, and a line for each."""
        offset: FloatArray = np.zeros(frame.shape)
        lines: tuple[str, ...] = ()
        if self.bias is not None:
            offset, lines = offset + self.bias, ("bias subtracted",)
        if self.dark is None:
            if self.bias is None and frame.facts.pedestal_adu:
                return offset + frame.facts.pedestal_adu, ("pedestal subtracted",)
            return offset, lines
        ratio = frame.facts.exposure_s / self.dark_exposure_s
        if self.bias is not None and math.isfinite(ratio):
            done = (*lines, f"dark of {self.dark_exposure_s:g} s times {ratio:.3g} subtracted")
            return offset + self.dark * ratio, done
        lines += (f"dark of {self.dark_exposure_s:g} s subtracted",)
        if not abs(ratio - 1) < _SAME_EXPOSURE:
            lines += (f"doubt: the frame has {frame.facts.exposure_s:g} s; without a bias its dark is not scaled",)
        return offset + self.dark, lines


def _median(frames: Sequence[Frame]) -> FloatArray:
    shapes = {frame.shape for frame in frames}
    if len(shapes) > 1:
        odd = next(frame for frame in frames if frame.shape != frames[0].shape)
        raise InputError(f"{odd.name}: its shape {odd.shape} is not that of {frames[0].name}, {frames[0].shape}")
    return np.asarray(np.median([frame.image for frame in frames], axis=0), float)


def _dark(darks: Sequence[Frame], bias: FloatArray | None) -> tuple[FloatArray, float]:
    exposures = np.array([frame.facts.exposure_s for frame in darks])
    if bias is None:
        if np.ptp(exposures) > _SAME_EXPOSURE * exposures.max():
            raise InputError(
                f"{darks[0].name} and other darks: exposures from {exposures.min():g} to {exposures.max():g} s; "
                "give a bias, so that they can be scaled, or darks of one exposure"
            )
        return _median(darks), float(exposures[0])
    if not (exposures > 0).all():
        raise InputError(
            f"{darks[0].name} and other darks: an exposure is missing or zero; zero-second frames are biases"
        )
    if darks[0].shape != bias.shape:
        raise InputError(f"{darks[0].name}: its shape {darks[0].shape} is not that of the bias, {bias.shape}")
    longest = float(exposures.max())
    scaled = [(frame.image - bias) * (longest / s) for frame, s in zip(darks, exposures, strict=True)]
    return np.asarray(np.median(scaled, axis=0), float), longest


def _flat(flats: Sequence[Frame], bias: FloatArray | None, dark: FloatArray | None, dark_s: float) -> FloatArray:
    """Sensitivity: each flat is divided by its median before they are combined, because the light changes."""
    dim = MasterFrames(bias=bias, dark=dark, dark_exposure_s=dark_s)
    normal = []
    for frame in flats:
        offset, _ = dim._offset(frame)
        image = frame.image - offset
        middle = float(np.median(image))
        if not middle > 0:
            raise InputError(f"{frame.name}: the flat has no signal above bias and dark; leave it out")
        normal.append(image / middle)
    return np.asarray(np.median(normal, axis=0), float)


def _excess(dark: FloatArray) -> FloatArray:
    """ADU of pixels above the median of their 5 × 5 surroundings, 0 where it is noise; amplifier glow drops out."""
    from scipy.ndimage import median_filter

    excess = dark - median_filter(dark, 5, mode="reflect")
    scatter = 1.4826 * float(np.median(np.abs(excess)))
    return np.where(excess > max(_HOT_SIGMAS * scatter, 1e-9), excess, 0.0)


def _harmful(excess: FloatArray, frame: Frame) -> BoolArray:
    """Hot pixels whose own noise, which subtracting the dark leaves, is at least half of that of the frame."""
    gain = frame.facts.gain_e_per_adu if math.isfinite(frame.facts.gain_e_per_adu) else 1.0
    step = np.diff(frame.image[:, ::2], axis=1)
    variance = (1.4826 * float(np.median(np.abs(step - np.median(step))))) ** 2 / 2
    return np.asarray(excess / gain + (_UNSTEADY * excess) ** 2 > 0.25 * max(variance, 1e-12))

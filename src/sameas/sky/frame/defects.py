"""Defects of a frame, found on the frame itself: hot pixels, cosmic rays, bad columns and rows.

A defect is sharper than any star: the limit is the contrast of a star centred on a pixel. astroscrappy (van Dokkum
2001, PASP 113, 1420) is not used because it does not compare the sharpness with the frame's stars: it flags the cores
of stars with a FWHM of 1.5 px.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sameas.arrays import BoolArray, robust_scale
from sameas.sky.frame.centroid import PSF, Background
from sameas.sky.frame.image import Frame
from sameas.sky.frame.measurements import Flag

_EIGHT_NEIGHBOURS = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]], np.int8)


# Parameters of the search for defects, tuned on simulated frames (``scripts/bench centroids`` and ``crowded``).
SIGMAS = 6.0  # a pixel is a defect if it exceeds the sharpest star by this many standard deviations
PASSES = 3  # maximum number of passes; in each, known defects are replaced by their neighbours
SHARPNESS_MARGIN = 1.4  # maximum ratio of sharpness among stars
LINE_SIGMAS = 8.0  # a column or row is bad if it differs from its neighbours by this many standard deviations of lines
MIN_LINE = 0.7  # minimum difference of a bad line, in standard deviations of a pixel; weaker lines are harmless


def without_defects(frame: Frame, background: Background, psf: PSF) -> tuple[Frame, Background]:
    """The frame with its defects flagged, and the background with infinite variance at all flagged pixels.

    Single sharp pixels are HOT, connected ones COSMIC; a single frame cannot separate a short cosmic ray hit from a hot
    pixel, darks can (:mod:`sameas.sky.frame.image`). Bad columns and rows are MASKED. psf : the sharpest of the stars.
    """
    from scipy.ndimage import label

    lines = _bad_lines(frame, background)
    sharp = _too_sharp(frame, background, psf) & ~lines
    parts, _ = label(sharp, np.ones((3, 3)))
    size = np.bincount(parts.ravel())
    single = sharp & (size[parts] == 1)
    frame = frame.marked(lines, Flag.MASKED).marked(single, Flag.HOT).marked(sharp & ~single, Flag.COSMIC)
    unusable = (frame.flags & (Flag.HOT | Flag.COSMIC | Flag.MASKED)) != 0
    return frame, replace(background, variance=np.where(unusable, np.inf, background.variance).astype(np.float32))


def _too_sharp(frame: Frame, background: Background, psf: PSF) -> BoolArray:
    """(rows, columns) mask of the pixels that are sharper than any star."""
    from scipy.ndimage import binary_dilation

    neighbour_light = np.array([psf.light(float(x), float(y)) for x in (-1, 0, 1) for y in (-1, 0, 1) if x or y])
    contrast = SHARPNESS_MARGIN * float(psf.light(0.0, 0.0)) / float(np.median(neighbour_light))
    light = frame.image - background.level
    usable = np.isfinite(background.variance)
    variance = np.where(usable, background.variance, 0.0)
    defect = np.zeros(frame.shape, bool)
    saturated = (frame.flags & Flag.SATURATED) != 0
    # Bleeding and diffraction of saturated stars may be sharper than stars.
    saturated &= ~_isolated(saturated)
    near_saturated = binary_dilation(saturated, np.ones((3, 3)), iterations=2)
    rows, columns = np.nonzero((light > SIGMAS * np.sqrt(variance)) & usable & ~near_saturated)
    work = np.pad(np.where(usable, light, 0.0), 1, mode="reflect")
    central, sky_variance = light[rows, columns], variance[rows, columns]
    for _ in range(PASSES):
        shifted = [work[rows + 1 + y, columns + 1 + x] for y in (-1, 0, 1) for x in (-1, 0, 1) if x or y]
        neighbours = np.maximum(np.median(shifted, axis=0), 0.0)
        photons = neighbours * contrast * (1 + 0.2 * contrast)
        noise = np.sqrt(sky_variance * (1 + 0.2 * contrast**2) + background.inverse_gain * photons)
        sharp = central - contrast * neighbours > SIGMAS * noise
        if not (sharp & ~defect[rows, columns]).any():
            break
        defect[rows[sharp], columns[sharp]] = True
        work[rows[sharp] + 1, columns[sharp] + 1] = neighbours[sharp]
    return defect


def _isolated(mask: BoolArray) -> BoolArray:
    """The pixels of a mask without neighbours in it."""
    from scipy.ndimage import convolve

    return np.asarray(mask & (convolve(mask.astype(np.int8), _EIGHT_NEIGHBOURS, mode="constant") == 0))


def _bad_lines(frame: Frame, background: Background) -> BoolArray:
    """(rows, columns) mask of the columns and rows whose median differs from their neighbours' by far."""
    from scipy.ndimage import median_filter

    bad = np.zeros(frame.shape, bool)
    usable = np.isfinite(background.variance)
    normal = np.where(usable, (frame.image - background.level) / np.sqrt(np.where(usable, background.variance, 1)), 0)
    for axis in (0, 1):
        # Half of the pixels are enough for a median.
        median = np.median(normal[::2] if axis == 0 else normal[:, ::2], axis=axis)
        deviation = np.abs(median - median_filter(median, 15, mode="reflect"))
        limit = max(MIN_LINE, LINE_SIGMAS * robust_scale(deviation))
        line = deviation > limit
        if line.mean() < 0.05:
            bad |= line[None, :] if axis == 0 else line[:, None]
    return bad

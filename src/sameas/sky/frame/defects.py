"""Defects: what is bright, or dead, without a star: hot pixels, hits of particles, bad columns and rows.

Found on a single frame by sharpness: no star can stand out from its neighbours more than one that is centred on a
pixel. Single pixels are called hot, several that hang together the hit of a particle; one frame cannot tell a short
hit from a hot pixel, darks can (:mod:`sameas.sky.frame.calibration`). Chosen over astroscrappy (van Dokkum 2001,
PASP 113, 1420), whose sharpness is not compared with the frame's own star: it takes the cores of stars 1.5 px wide.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sameas.sky.frame.background import Background
from sameas.sky.frame.image import Frame
from sameas.sky.frame.measurements import Flag
from sameas.sky.frame.spread import Spread

_SIGMAS = 6.0
_LINE_SIGMAS = 8.0
_LEAST_LINE = 0.7  # in standard deviations of a pixel: weaker columns do no harm
_MARGIN = 1.4  # stars differ in sharpness by less
_AROUND = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]], bool)


def marked(frame: Frame, background: Background, spread: Spread) -> Frame:
    """The frame with its defects flagged: HOT, COSMIC, and MASKED for bad columns and rows."""
    lines = _lines(frame, background)
    sharp = _sharp(frame, background, spread) & ~lines
    from scipy.ndimage import label

    parts, _ = label(sharp, np.ones((3, 3)))
    size = np.bincount(parts.ravel())
    single = sharp & (size[parts] == 1)
    return frame.marked(lines, Flag.MASKED).marked(single, Flag.HOT).marked(sharp & ~single, Flag.COSMIC)


def _sharp(frame: Frame, background: Background, spread: Spread, rounds: int = 3) -> NDArray[np.bool_]:
    """Pixels that no star explains."""
    from scipy.ndimage import binary_dilation

    around = np.array([spread.light(float(x), float(y)) for x in (-1, 0, 1) for y in (-1, 0, 1) if x or y])
    contrast = _MARGIN * float(spread.light(0.0, 0.0)) / float(np.median(around))
    light = frame.image - background.level
    usable = np.isfinite(background.variance)
    variance = np.where(usable, background.variance, 0.0)
    found = np.zeros(frame.shape, bool)
    saturated = (frame.flags & Flag.SATURATED) != 0
    # Bleeding and the diffraction of a saturated star are as sharp as they like.
    saturated &= binary_dilation(saturated, np.ones((3, 3))) & ~_alone(saturated)
    near_saturated = binary_dilation(saturated, np.ones((3, 3)), iterations=2)
    rows, columns = np.nonzero((light > _SIGMAS * np.sqrt(variance)) & usable & ~near_saturated)
    work = np.pad(np.where(usable, light, 0.0), 1, mode="reflect")
    own, sky2 = light[rows, columns], variance[rows, columns]
    for _ in range(rounds):
        shifted = [work[rows + 1 + y, columns + 1 + x] for y in (-1, 0, 1) for x in (-1, 0, 1) if x or y]
        neighbours = np.maximum(np.median(shifted, axis=0), 0.0)
        photons = neighbours * contrast * (1 + 0.2 * contrast)
        noise = np.sqrt(sky2 * (1 + 0.2 * contrast**2) + background.inverse_gain * photons)
        sharp = own - contrast * neighbours > _SIGMAS * noise
        if not (sharp & ~found[rows, columns]).any():
            break
        found[rows[sharp], columns[sharp]] = True
        work[rows[sharp] + 1, columns[sharp] + 1] = neighbours[sharp]
    return found


def _alone(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    from scipy.ndimage import convolve

    return mask & (convolve(mask.astype(np.int8), _AROUND.astype(np.int8), mode="constant") == 0)


def _lines(frame: Frame, background: Background) -> NDArray[np.bool_]:
    """Columns and rows whose middle pixel is far from that of their neighbours."""
    from scipy.ndimage import median_filter

    bad = np.zeros(frame.shape, bool)
    usable = np.isfinite(background.variance)
    normal = np.where(usable, (frame.image - background.level) / np.sqrt(np.where(usable, background.variance, 1)), 0)
    for axis in (0, 1):
        # Half of the pixels tell it as well.
        middle = np.median(normal[::2] if axis == 0 else normal[:, ::2], axis=axis)
        off = np.abs(middle - median_filter(middle, 15, mode="reflect"))
        limit = max(_LEAST_LINE, _LINE_SIGMAS * 1.4826 * float(np.median(off)))
        line = off > limit
        if line.mean() < 0.05:
            bad |= line[None, :] if axis == 0 else line[:, None]
    return bad

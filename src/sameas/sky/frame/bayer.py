"""The mosaic of colour filters over single pixels (Bayer), brought to one sky and one response.

Each of the four kinds of pixels of a square of 2 × 2 sees another part of the spectrum, so that the sky is a pattern of
levels, which hides faint stars as noise would, and a star loses light where its pixels are of a kind that sees little
of it. Kinds are compared by what they share: stars fall on all of them alike, so that quantiles of their pixels above
the sky differ by their response only. On a simulated frame of a small telescope, with responses of 0.5 to 1, this gains
2.5 mag of depth. Pixels are not interpolated, which would correlate their noise.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import BoolArray, FloatArray, robust_scale
from sameas.sky.frame.image import Frame

# Parameters of the mosaic, all chosen.
#: Levels of the kinds that differ by more than this share of the noise of a pixel are those of a mosaic.
LEVELS_APART = 0.3
#: Brightest pixels of a kind by which its response is measured, as quantiles; they are above the sky by this many times
#: its noise.
BRIGHTEST, ABOVE_SKY = np.linspace(0.99, 0.9995, 20), 8.0
#: Largest ratio of two responses; a larger one is not that of a filter.
UNLIKE = 20.0
#: Side of the boxes in which the level of the sky is measured, pixels.
BOX_PX = 64


def without_mosaic(frame: Frame) -> Frame:
    """The frame with a mosaic of colours made even; the same frame if it is none."""
    even = even_mosaic(frame.image, frame.flags == 0)
    if even is None:
        return frame
    shown = ", ".join(f"{response:.2f}" for response in even[1])
    lines = [f"image: a mosaic of colours, 2 × 2 kinds of pixels; levels and responses ({shown}) made equal"]
    if math.isfinite(frame.facts.gain_e_per_adu):
        lines.append("assumed: the gain is that of one kind of pixels; the noise is taken from the image")
    facts = replace(frame.facts, lines=(*frame.facts.lines, *lines), gain_e_per_adu=math.nan)
    return replace(frame, image=even[0], facts=facts, sigma=None)


def even_mosaic(image: NDArray[Any], usable: BoolArray) -> tuple[NDArray[Any], FloatArray] | None:
    """The image with one level and one response of all pixels, and the responses; None if it is no mosaic.

    image : (rows, columns). usable : (rows, columns) mask of the pixels that are compared. The responses are those of
    the first and second pixel of even rows and of odd rows, the largest 1.
    """
    kinds, used = ([plane[y::2, x::2] for y in (0, 1) for x in (0, 1)] for plane in (image, usable))
    if min(int(mask.sum()) for mask in used) < BOX_PX**2:
        return None
    boxes = tuple(max(1, length // BOX_PX) for length in image.shape)
    skies = [_sky(kind, boxes) for kind in kinds]
    apart = np.ptp([np.median(sky) for sky in skies])
    if apart == 0.0:
        return None
    above = [(kind - _spread(sky, kind.shape))[mask] for kind, sky, mask in zip(kinds, skies, used, strict=True)]
    noise = np.array([robust_scale(values) for values in above])
    if not apart > LEVELS_APART * float(noise.min()) > 0:
        return None
    response = _responses(above, noise)
    even = [sky / each for sky, each in zip(skies, response, strict=True)]
    middle = np.mean(even, axis=0)
    result = image.copy()
    for number, (kind, sky, each) in enumerate(zip(kinds, even, response, strict=True)):
        result[number // 2 :: 2, number % 2 :: 2] = kind / each - _spread(sky - middle, kind.shape)
    return result, response


def _responses(above: list[FloatArray], noise: FloatArray) -> FloatArray:
    """(4,) responses to the light of stars, the largest 1; all 1 where too few stars tell.

    above : values of each kind above its sky. noise : (4,) their noise.
    """
    bright = np.array([np.quantile(values, BRIGHTEST) for values in above])
    seen = (bright > ABOVE_SKY * noise[:, None]).all(axis=0)
    if not seen.any():
        return np.ones(len(above))
    ratio = np.median(bright[:, seen] / bright[:, seen].max(axis=0), axis=1)
    ratio /= ratio.max()
    return ratio if ratio.min() > 1.0 / UNLIKE else np.ones(len(above))


def _sky(kind: NDArray[Any], boxes: tuple[int, ...]) -> FloatArray:
    """Medians of this number of boxes along each axis; the last ones are larger."""
    side = BOX_PX // 2
    rows, columns = (np.arange(1, count) * side for count in boxes)
    return np.array([[np.median(box) for box in np.split(band, columns, axis=1)] for band in np.split(kind, rows)])


def _spread(boxes: FloatArray, shape: tuple[int, ...]) -> FloatArray:
    """Values of boxes on all pixels, linear between their middles."""
    from scipy.ndimage import map_coordinates

    y, x = (
        np.clip((np.arange(length) + 0.5) / (BOX_PX // 2) - 0.5, 0, count - 1)
        for length, count in zip(shape, boxes.shape, strict=True)
    )
    return np.asarray(map_coordinates(boxes, np.meshgrid(y, x, indexing="ij"), order=1))

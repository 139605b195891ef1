"""Frames through a mosaic of colour filters (Bayer): the four kinds of pixels brought to one sky and one response.

Each kind of a square of 2 × 2 pixels sees another part of the spectrum, so that the sky is a pattern of levels, which
hides faint stars as noise would, and a star loses light where its pixels are of a kind that sees little of it. Kinds
are compared by what they share: stars fall on all of them alike, so that quantiles of their pixels above the sky differ
by their response only. On a simulated frame of a small telescope, with responses of 0.5 to 1, this gains 2.5 mag of
depth. Pixels are not interpolated, which would correlate their noise.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from sameas.arrays import FloatArray, robust_scale
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
    """The frame with one level and one response of all pixels if it is a mosaic of colours, else the same frame."""
    kinds = [frame.image[y::2, x::2] for y in (0, 1) for x in (0, 1)]
    usable = [(frame.flags[y::2, x::2]) == 0 for y in (0, 1) for x in (0, 1)]
    if min(int(mask.sum()) for mask in usable) < BOX_PX**2:
        return frame
    boxes = tuple(max(1, length // BOX_PX) for length in frame.shape)
    skies = [_sky(kind, boxes) for kind in kinds]
    above = [(kind - _spread(sky, kind.shape))[mask] for kind, sky, mask in zip(kinds, skies, usable, strict=True)]
    noise = np.array([robust_scale(values) for values in above])
    if not np.ptp([np.median(sky) for sky in skies]) > LEVELS_APART * float(noise.min()) > 0:
        return frame
    response = _responses(above, noise)
    even = [sky / each for sky, each in zip(skies, response, strict=True)]
    middle = np.mean(even, axis=0)
    image = frame.image.copy()
    for number, (kind, sky, each) in enumerate(zip(kinds, even, response, strict=True)):
        light = kind / each - _spread(sky - middle, kind.shape)
        image[number // 2 :: 2, number % 2 :: 2] = light.astype(np.float32)
    shown = ", ".join(f"{each:.2f}" for each in response)
    lines = (f"image: a mosaic of colours, 2 × 2 kinds of pixels; levels and responses ({shown}) made equal",)
    if math.isfinite(frame.facts.gain_e_per_adu):
        lines += ("assumed: the gain is that of one kind of pixels; the noise is taken from the image",)
    facts = replace(frame.facts, lines=(*frame.facts.lines, *lines), gain_e_per_adu=math.nan)
    return replace(frame, image=image, facts=facts, sigma=None)


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


def _sky(kind: FloatArray, boxes: tuple[int, ...]) -> FloatArray:
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

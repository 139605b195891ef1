"""The stretch of a frame: the sky nearly black, faint stars visible, bright ones distinct."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import BoolArray

#: Standard deviations of the sky: below the sky that is black, above black at which asinh becomes logarithmic (chosen).
BLACK, SOFT = 0.7, 3.5
#: Share of the pixels that are white (chosen).
WHITE = 0.0008
#: Most pixels along a side of the picture; larger frames are averaged.
LARGEST = 2400


def stretched(image: NDArray[np.float32], masked: BoolArray | None = None) -> NDArray[np.uint8]:
    """(rows, columns) 0 … 255: asinh of the light above the sky.

    image : (rows, columns). masked : pixels without a number, which become sky.
    """
    values = np.asarray(image, np.float32)
    used = np.isfinite(values) if masked is None else np.isfinite(values) & ~masked
    values = values - _slow(np.where(used, values, np.nan))
    sample = values[used]
    if len(sample) > 1_000_000:
        sample = sample[:: len(sample) // 1_000_000]
    level = float(np.median(sample))
    below = sample[sample <= level]
    # The noise is that of the pixels below the sky, where no stars are.
    noise = 1.4826 * float(np.median(level - below)) if len(below) else 1.0
    noise = noise if noise > 0 else max(float(sample.std()), 1e-6)
    low, high = level - BLACK * noise, max(float(np.quantile(sample, 1.0 - WHITE)), level + 10.0 * noise)
    light = np.where(used, (values - low) / (SOFT * noise), BLACK / SOFT)
    top = np.arcsinh((high - low) / (SOFT * noise))
    return np.asarray(255.0 * np.clip(np.arcsinh(np.maximum(light, 0.0)) / top, 0.0, 1.0), np.uint8)


def _slow(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """(rows, columns) a parabola fitted to the sky: vignetting and moonlight, without nebulae."""
    rows, columns = values.shape
    size = max(8, min(rows, columns) // 16)
    tiles = [(y, x) for y in range(0, rows - size + 1, size) for x in range(0, columns - size + 1, size)]
    step = max(1, size // 24)
    parts = [values[y : y + size : step, x : x + size : step] for y, x in tiles]
    known = [k for k, part in enumerate(parts) if np.isfinite(part).mean() > 0.5]
    if len(known) < 12:
        return np.zeros((1, 1), np.float32)
    level = np.array([np.nanmedian(parts[k]) for k in known])
    v, u = ((np.array([tiles[k] for k in known]) + size / 2) / (rows, columns) - 0.5).T
    weight = np.ones(len(level))
    for _ in range(4):
        terms = np.column_stack([np.ones_like(u), u, v, u * u, u * v, v * v])
        fit = np.linalg.lstsq(terms * weight[:, None], level * weight, rcond=None)[0]
        left = level - terms @ fit
        # Tiles with bright stars or nebulae lie above the sky.
        scatter = max(1.4826 * float(np.median(np.abs(left))), 1e-9)
        weight = np.minimum(1.0, 2.0 * scatter / np.maximum(np.abs(left), 1e-12))
    y, x = np.arange(rows)[:, None] / rows - 0.5, np.arange(columns)[None, :] / columns - 0.5
    surface = fit[1] * x + fit[2] * y + fit[3] * x * x + fit[4] * x * y + fit[5] * y * y
    return np.asarray(surface, np.float32)


def binning(shape: tuple[int, int]) -> int:
    """Number of pixels along a side that are averaged to one of the picture."""
    return max(1, -(-max(shape) // LARGEST))


def binned(image: NDArray[np.float32], factor: int) -> NDArray[np.float32]:
    """(rows // factor, columns // factor) means."""
    if factor == 1:
        return image
    rows, columns = (size // factor * factor for size in image.shape)
    cut = image[:rows, :columns].reshape(rows // factor, factor, columns // factor, factor)
    return np.asarray(cut.mean(axis=(1, 3)), np.float32)

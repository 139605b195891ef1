"""Peaks: where on a frame there is a star, by the matched filter.

The signal to noise ratio of a star at every pixel is Σ k I/v over √(Σ k²/v), k the mean star, v the variance of the
sky, a missing pixel one of infinite variance. Its maxima are stars; two that no saddle divides are one.
"""

from __future__ import annotations

import numpy as np

from sameas.errors import InputError
from sameas.records import FloatArray, IntArray
from sameas.sky.frame.background import Background
from sameas.sky.frame.spread import Spread

_LEAST_USABLE = 0.3
_SADDLE_SIGMAS = 3.0
_SADDLE_PHOTONS = 5.0  # the same of a star's own photons: the saddle is the lowest of many places along a trail
_SADDLE_REACH = 8  # full widths of a star: longer trails than that come in parts
_SADDLE_SHARE = 0.02
_HALF_PX = 0.6


def significance(light: FloatArray, background: Background, spread: Spread) -> FloatArray:
    """(rows, columns) signal to noise ratio of a star in the middle of each pixel; 0 where most is masked."""
    from scipy.signal import oaconvolve

    half = int(np.ceil(3.5 * np.sqrt(np.linalg.eigvalsh(spread.matrix)[1])))
    reach = np.arange(-half, half + 1)
    inverse = np.linalg.inv(spread.matrix)
    dx, dy = np.meshgrid(reach, reach)
    kernel = np.exp(-0.5 * (inverse[0, 0] * dx**2 + 2 * inverse[0, 1] * dx * dy + inverse[1, 1] * dy**2))
    kernel = kernel.astype(np.float32)
    weight = np.where(np.isfinite(background.variance), 1 / background.variance, 0).astype(np.float32)
    usual = float(np.median(weight[weight > 0]))
    weight /= usual
    signal = oaconvolve((light * weight).astype(np.float32), kernel, mode="same")
    noise2 = oaconvolve(weight, kernel**2, mode="same")
    factor = float(background.factor(np.array([spread.sigma_px]))[0][0])
    usable = oaconvolve((weight > 0).astype(np.float32), kernel**2, mode="same")
    enough = usable > _LEAST_USABLE * float((kernel**2).sum())
    return np.where(enough, signal * np.sqrt(usual / factor) / np.sqrt(np.maximum(noise2, 1e-12)), 0.0)


def photon_noise(light: FloatArray, background: Background) -> FloatArray:
    """(rows, columns) noise of a pixel, the photons of the stars included, over that of the sky alone."""
    return np.sqrt(1 + background.inverse_gain * np.maximum(light, 0) / background.variance)


def peaks(snr: FloatArray, noise: FloatArray, spread: Spread, threshold_sigmas: float) -> tuple[FloatArray, FloatArray]:
    """(n, 2) pixels (x, y) of the stars, the most significant first, and their (n,) significance.

    noise : (rows, columns) of :func:`photon_noise`: a saddle must be deeper than the photons of a star make it.
    """
    try:
        from photutils.detection import find_peaks
    except ImportError as error:
        raise InputError("finding stars on frames needs photutils: pip install 'sameas[frames]'") from error
    import warnings

    box = 2 * max(1, round(spread.sigma_px)) + 1
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # photutils warns when there is nothing; the caller says it better
        found = find_peaks(snr, threshold_sigmas, box_size=box)
    if found is None or not len(found):
        return np.empty((0, 2)), np.empty(0)
    names = ("x_peak", "y_peak", "peak_value")
    x, y, value = (np.asarray(found[name], float) for name in names)
    order = np.lexsort((x, y, -value))
    xy, value = np.column_stack([x, y])[order], value[order]
    keep = _divided(snr, noise, xy, value, _SADDLE_REACH * spread.fwhm_px)
    return xy[keep], value[keep]


def _divided(snr: FloatArray, noise: FloatArray, xy: FloatArray, value: FloatArray, reach_px: float) -> IntArray:
    """Rows of the peaks that a saddle divides from every higher peak near them."""
    from scipy.ndimage import map_coordinates
    from scipy.spatial import cKDTree

    pairs = cKDTree(xy).query_pairs(reach_px, output_type="ndarray")
    if not len(pairs):
        return np.arange(len(xy))
    higher, lower = pairs.min(axis=1), pairs.max(axis=1)
    along = np.linspace(0, 1, 2 + int(np.ceil(reach_px)))[1:-1]
    way = xy[higher][:, None, :] + along[:, None] * (xy[lower] - xy[higher])[:, None, :]
    # A ridge passes the pixels of its ends by up to their half: the best of three lines side by side.
    towards = (xy[lower] - xy[higher]) / np.linalg.norm(xy[lower] - xy[higher], axis=1, keepdims=True)
    aside = np.column_stack([-towards[:, 1], towards[:, 0]])[:, None, :]
    lines = [way + offset * aside for offset in (-_HALF_PX, 0.0, _HALF_PX)]
    along_lines = [map_coordinates(snr, [line[..., 1], line[..., 0]], order=1, mode="nearest") for line in lines]
    saddle = np.max(along_lines, axis=0).min(axis=1)
    x, y = xy[lower].astype(int).T
    random = np.sqrt(_SADDLE_SIGMAS**2 + _SADDLE_PHOTONS**2 * (noise[y, x] ** 2 - 1))
    depth = np.maximum(random, _SADDLE_SHARE * value[lower])
    return np.setdiff1d(np.arange(len(xy)), lower[value[lower] - saddle < depth])

"""Peaks: the pixels on which the stars of a frame are centred, by a matched filter."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.sky.frame.centroid import PSF, Background

# Parameters of the search for peaks, tuned on simulated frames (``scripts/bench centroids`` and ``crowded``).
MIN_USABLE = 0.3  # no star is detected where less than this share of its pixels is usable
SADDLE_SIGMAS = 3.0  # minimum depth of the saddle between two stars, in standard deviations of the sky
#: The same for the photon noise of the star, larger because the saddle is the minimum of many points along a trail.
SADDLE_PHOTONS = 5.0
SADDLE_SHARE = 0.02  # minimum depth of the saddle as a share of the lower peak
SADDLE_WIDTHS = 8.0  # peaks farther apart than this many FWHM are always two stars; longer trails are split
RIDGE_PX = 0.6  # offset of the three parallel lines on which the saddle is measured; a ridge may miss the pixel centres
TRAILED = 2.0  # stars are trailed if longer than wide by this factor (chosen)
#: A peak that is closer to a higher one in standard deviations of the PSF lies on its trail, whose ends are at 1.7.
TRAIL_SIGMAS = 2.5


def peaks(
    light: FloatArray, background: Background, psf: PSF, threshold_sigmas: float
) -> tuple[FloatArray, FloatArray]:
    """(n, 2) pixels (x, y) of the stars, the most significant first, and their significance (n,).

    Stars are maxima of the significance; two maxima without a saddle between them are one star.

    light : (rows, columns) above the sky. threshold_sigmas : minimum significance.
    """
    from sameas.kernels.frames import local_maxima

    snr = _significance(light, background, psf)
    y, x = local_maxima(snr, threshold_sigmas, max(1, round(psf.sigma_px)))
    if not len(x):
        return np.empty((0, 2)), np.empty(0)
    # A saddle must be deeper than photon noise can make it: that of a pixel, relative to the noise of the sky alone.
    noise = np.sqrt(1 + background.inverse_gain * np.maximum(light, 0) / background.variance)
    value = snr[y, x].astype(float)
    x, y = x.astype(float), y.astype(float)
    order = np.lexsort((x, y, -value))
    xy, value = np.column_stack([x, y])[order], value[order]
    reach_px = SADDLE_WIDTHS * psf.fwhm_px
    pairs = _pairs(xy, reach_px)
    separate = np.ones(len(xy), bool)
    separate[_without_saddle(snr, noise, xy, value, pairs, reach_px)] = False
    minor, major = np.linalg.eigvalsh(psf.matrix)
    if major > TRAILED**2 * minor:
        sharp = _significance(light, background, replace(psf, matrix=minor * np.eye(2)))
        separate |= _separated_trails(sharp, noise, xy, pairs, psf)
    return xy[separate], value[separate]


def _significance(light: FloatArray, background: Background, psf: PSF) -> FloatArray:
    """(rows, columns) signal to noise ratio of a star at the centre of each pixel; 0 where most of it is masked.

    Matched filter: Σ k I/v over √(Σ k²/v), k the PSF, v the variance of the sky, infinite for unusable pixels.
    """
    from scipy.signal import oaconvolve

    half = int(np.ceil(3.5 * np.sqrt(np.linalg.eigvalsh(psf.matrix)[1])))
    reach = np.arange(-half, half + 1)
    inverse = np.linalg.inv(psf.matrix)
    dx, dy = np.meshgrid(reach, reach)
    kernel = np.exp(-0.5 * (inverse[0, 0] * dx**2 + 2 * inverse[0, 1] * dx * dy + inverse[1, 1] * dy**2))
    kernel = kernel.astype(np.float32)
    weight = np.where(np.isfinite(background.variance), 1 / background.variance, 0).astype(np.float32)
    typical_weight = float(np.median(weight[weight > 0]))
    weight /= typical_weight
    signal = oaconvolve((light * weight).astype(np.float32), kernel, mode="same")
    noise_sq = oaconvolve(weight, kernel**2, mode="same")
    factor = float(background.factor(np.array([psf.sigma_px]))[0][0])
    enough = usable_share(weight > 0, kernel**2) > MIN_USABLE
    return np.where(enough, signal * np.sqrt(typical_weight / factor) / np.sqrt(np.maximum(noise_sq, 1e-12)), 0.0)


def usable_share(usable: BoolArray, kernel: FloatArray) -> FloatArray:
    """(rows, columns) share of the kernel (k, k) that lies on usable pixels."""
    from scipy.signal import oaconvolve

    from sameas.kernels.frames import take_away

    kernel = kernel / kernel.sum()
    # Without unusable pixels the share depends on the distance from the edges only.
    rows, columns = (_from_edges(length, len(kernel) // 2) for length in usable.shape)
    share = oaconvolve(np.ones((rows[-1] + 1, columns[-1] + 1), np.float32), kernel, mode="same")[
        rows[:, None], columns
    ]
    at_rows, at_columns = np.nonzero(~usable)
    take_away(share, at_rows, at_columns, kernel)
    return np.asarray(share)


def _from_edges(length: int, half: int) -> IntArray:
    """(length,) the index in an axis of at most 4 half + 1 pixels that is as far from both ends, up to 2 half."""
    index = np.arange(length)
    if length <= 4 * half + 1:
        return index
    return np.minimum(index, 2 * half) + np.maximum(index - (length - 1 - 2 * half), 0)


def _separated_trails(snr: FloatArray, noise: FloatArray, xy: FloatArray, pairs: IntArray, psf: PSF) -> BoolArray:
    """(n,) mask of the peaks with a saddle in a filter as wide as the trails, and that lie on no trail of a higher one.

    The filter of trails doubles their length, so that bright ones cover the saddles around them. pairs : of peaks.
    """
    reach_px = SADDLE_WIDTHS * psf.fwhm_px
    offset = xy[pairs[:, 0]] - xy[pairs[:, 1]]
    on_trail = np.einsum("ni,ij,nj->n", offset, np.linalg.inv(psf.matrix), offset) < TRAIL_SIGMAS**2
    separate = np.ones(len(xy), bool)
    separate[pairs[on_trail, 1]] = False
    value = snr[xy[:, 1].astype(int), xy[:, 0].astype(int)].astype(float)
    separate[_without_saddle(snr, noise, xy, value, pairs[~on_trail], reach_px)] = False
    return separate


def _pairs(xy: FloatArray, reach_px: float) -> IntArray:
    """(p, 2) rows of the peaks within reach of each other, the higher first."""
    from scipy.spatial import cKDTree

    return np.sort(cKDTree(xy).query_pairs(reach_px, output_type="ndarray"), axis=1)


def _without_saddle(
    snr: FloatArray, noise: FloatArray, xy: FloatArray, value: FloatArray, pairs: IntArray, reach_px: float
) -> IntArray:
    """Rows of the lower peaks of pairs within reach without a saddle. value : (n,) of ``snr`` at the peaks."""
    from sameas.kernels.frames import saddles

    if not len(pairs):
        return np.empty(0, np.int64)
    higher, lower = pairs.T
    # A ridge may pass half a pixel from the centres of its end pixels.
    saddle = saddles(snr, xy[higher], xy[lower], int(np.ceil(reach_px)), RIDGE_PX)
    x, y = xy[lower].astype(int).T
    random_depth = np.sqrt(SADDLE_SIGMAS**2 + SADDLE_PHOTONS**2 * (noise[y, x] ** 2 - 1))
    depth = np.maximum(random_depth, SADDLE_SHARE * value[lower])
    return np.asarray(lower[value[lower] - saddle < depth])

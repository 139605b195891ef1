"""The photon noise of stars, measured on the frame: what the gain of the detector would say.

The pixels of many stars are compared with the fitted profile of each star. Their variance grows with the star's light
I:

    Var = c v + g I + (ε I)²,

v the variance of the sky (c below 1 where stars crowd and their wings count as sky), g the inverse gain, and ε the
relative misfit of the profile. Brightness separates the three: photon noise decides over two or three decades of it.

A profile is the frame's Moffat profile with the star's own flux, position, shape and a constant, fitted by linear least
squares; what all stars have in common beyond it (coma, a double image) is removed as their mean pattern. Residuals are
divided by √(1 − leverage), so that the fit does not make them too small.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sameas.arrays import BoolArray, FloatArray, IntArray, robust_scale
from sameas.sky.frame.centroid import PSF, Background, Subtracted, cut_stamps

#: The robust scale of n normal numbers has this variance, relative to the square of their standard deviation, over n.
_MEDIAN_VARIANCE = 1.36


# Parameters of the measurement of the gain, tuned on simulated frames (``scripts/bench centroids``).
GAIN_STARS, GAIN_PIXELS = 5, 240  # minimum numbers for a measured gain
GAIN_SAMPLE = 500  # maximum number of stars for it
GAIN_SNR = 8.0  # minimum signal to noise ratio of these stars
NEIGHBOURS = 0.2  # maximum share of neighbours' light in it
GAIN_REACH_SIGMAS = 2.65  # distance to which a star's pixels are used
STEPS = 8  # iterations
ACCURACY = 0.01  # relative accuracy of a scatter beyond chance
LEVERAGE, SHARE = 0.7, 0.3  # maximum weight of a pixel in the fit of its star, and in the mean pattern of all stars
#: No gain is measured if correlated noise enlarges variances of positions by more than this factor.
MAX_NOISE_CORRELATION = 1.5
#: A given gain is doubted if the photon variance is smaller by more than the first factor or larger by more than the
#: second; trails and unresolved neighbours make it up to five times larger.
LEAST_CONTRADICTION, LARGEST_CONTRADICTION = 2.5, 10.0


@dataclass(frozen=True)
class InverseGain:
    """``value`` units of the frame per electron, its standard error, and the number of stars measured."""

    value: float
    error: float
    stars: int


def measured_inverse_gain(
    residual: FloatArray, background: Background, stars: Subtracted, usable: BoolArray
) -> InverseGain | None:
    """The inverse gain from the scatter of stars' pixels about their profiles; None with too few pixels.

    residual : (rows, columns) light of the frame without the stars. stars : all stars, in ``residual`` no longer.
    usable : (n,) mask of the stars without defects, saturated pixels and edges nearby.

    >>> import numpy as np
    >>> rng = np.random.default_rng(1)
    >>> psf, x, y = PSF(1.6 * np.eye(2)), np.arange(400), np.arange(400)[:, None]
    >>> xy = np.array([[20.0 + 40 * (k % 10), 20.0 + 40 * (k // 10)] for k in range(100)])
    >>> flux = np.geomspace(1e3, 1e6, 100)
    >>> model = sum(f * psf.light(x - a, y - b) for f, (a, b) in zip(flux, xy))
    >>> residual = rng.normal(0, np.sqrt(25.0 + model / 2.0))  # two electrons per unit
    >>> sky = Background(np.zeros(model.shape), np.full(model.shape, 25.0), 0.0, np.eye(9))
    >>> found = measured_inverse_gain(residual, sky, Subtracted(xy, flux, psf), np.ones(100, bool))
    >>> bool(abs(found.value - 0.5) < 3 * found.error), found.stars
    (True, 100)
    """
    rows = _isolated_stars(stars, usable)
    if len(rows) < GAIN_STARS:
        return None
    pixels = _Pixels.of(residual, background, stars, rows)
    noise = _Noise(1.0, 0.0, 0.0, np.inf)
    for iteration in range(STEPS):
        light, deviation, sky = pixels.deviations(noise, with_pattern=iteration > 0)
        if len(light) < GAIN_PIXELS:
            return None
        noise = _Noise.of(light, deviation, sky, noise, ACCURACY)
    return InverseGain(_mean_above_zero(noise.inverse_gain, noise.error), noise.error, len(rows))


def _mean_above_zero(value: float, error: float) -> float:
    """Mean of a normal distribution cut at zero: noise that was not seen is still not excluded."""
    t = value / error
    below = 0.5 * math.erfc(t / math.sqrt(2.0))
    return value + error * math.exp(-0.5 * t * t) / math.sqrt(2.0 * math.pi) / (1.0 - below)


def _isolated_stars(stars: Subtracted, usable: BoolArray) -> IntArray:
    """Rows of usable stars to which neighbours contribute little light, at most ``sample`` of all fluxes."""
    from scipy.spatial import cKDTree

    pairs = cKDTree(stars.xy).query_pairs(5.0 * stars.psf.fwhm_px, output_type="ndarray")
    dx, dy = 0.7 * (stars.xy[pairs[:, 0]] - stars.xy[pairs[:, 1]]).T  # at the side of the star that is nearer
    share = stars.psf.light(dx, dy) / stars.psf.light(0.0, 0.0)
    others = np.bincount(pairs[:, 0], stars.flux[pairs[:, 1]] * share, len(stars.xy))
    others += np.bincount(pairs[:, 1], stars.flux[pairs[:, 0]] * share, len(stars.xy))
    rows = np.flatnonzero(usable & (others < NEIGHBOURS * stars.flux))
    by_flux = rows[np.argsort(stars.flux[rows], kind="stable")]
    if len(rows) <= GAIN_SAMPLE:
        return np.asarray(by_flux)
    return np.asarray(by_flux[np.linspace(0, len(rows) - 1, GAIN_SAMPLE).astype(int)])


@dataclass(frozen=True)
class _Noise:
    """Var = ``sky_factor`` v + ``inverse_gain`` I + (``misfit`` I)², and the standard error of the inverse gain."""

    sky_factor: float
    inverse_gain: float
    misfit_sq: float
    error: float

    def variance(self, light: FloatArray, sky: FloatArray) -> FloatArray:
        """Variance of pixels with this light of a star, where that of the sky is ``sky``."""
        light = np.maximum(light, 0.0)
        return np.maximum(self.sky_factor, 0.01) * sky + self.inverse_gain * light + self.misfit_sq * light**2

    @classmethod
    def of(cls, light: FloatArray, deviation: FloatArray, sky: FloatArray, previous: _Noise, accuracy: float) -> _Noise:
        """The noise from the scatter of pixels (n,) in bins of light, least squares with terms not below zero.

        accuracy : relative accuracy of a scatter beyond chance.
        """
        from scipy.optimize import nnls

        order = np.argsort(light, kind="stable")
        bins = np.array_split(order, int(np.clip(len(order) / 60, 4, 16)))
        typical, sky_level = np.array([np.median(light[each]) for each in bins]), float(np.median(sky))
        scatter = np.array([robust_scale(deviation[each]) ** 2 for each in bins])
        count = np.array([len(each) for each in bins])
        expected = previous.variance(typical, np.full(len(bins), sky_level))
        error = expected * np.sqrt(4 * _MEDIAN_VARIANCE / count + accuracy**2)
        terms = np.stack([np.full(len(bins), sky_level), typical, typical**2], axis=1) / error[:, None]
        size = np.linalg.norm(terms, axis=0)
        sky_factor, inverse_gain, misfit_sq = nnls(terms / size, scatter / error)[0] / size
        covariance = np.linalg.pinv((terms / size).T @ (terms / size))
        return cls(sky_factor, inverse_gain, misfit_sq, float(np.sqrt(covariance[1, 1]) / size[1]))


@dataclass(frozen=True, eq=False)
class _Pixels:
    """The pixels of n stars, k each.

    basis : (n, k, 7) change of the light with flux, position (2), shape (3) and a constant. light, sky : (n, k) light
    and variance of the sky. expected : (n, k) light by the frame's profile. usable : (n, k). cell : (n, k) whole pixel
    offset from the star, numbered.
    """

    basis: FloatArray
    light: FloatArray
    sky: FloatArray
    expected: FloatArray
    usable: BoolArray
    cell: IntArray

    @classmethod
    def of(cls, residual: FloatArray, background: Background, stars: Subtracted, rows: IntArray) -> _Pixels:
        psf, xy = stars.psf, stars.xy[rows]
        reach_sq = GAIN_REACH_SIGMAS**2
        half = int(np.ceil(np.sqrt(reach_sq * np.linalg.eigvalsh(psf.matrix)[1]))) + 1
        stamps = cut_stamps(residual, background, np.rint(xy).astype(int), half)
        stamps = stars.add_back(stamps, rows)
        dx, dy = np.broadcast_arrays(stamps.x - xy[:, 0, None, None], stamps.y - xy[:, 1, None, None])
        inverse = np.linalg.inv(psf.matrix)
        r2 = inverse[0, 0] * dx**2 + 2 * inverse[0, 1] * dx * dy + inverse[1, 1] * dy**2
        basis = _change_of_light(psf, dx, dy, GAIN_REACH_SIGMAS)
        offset = np.rint(np.stack([dx, dy])).astype(int) + half + 1
        flat = len(rows), -1
        return cls(
            basis.reshape(*flat, basis.shape[-1]),
            stamps.light.reshape(flat),
            stamps.variance.reshape(flat),
            (stars.flux[rows, None, None] * basis[..., 0]).reshape(flat),
            ((stamps.usable > 0) & (r2 < reach_sq)).reshape(flat),
            (offset[0] * (2 * half + 3) + offset[1]).reshape(flat),
        )

    def deviations(self, noise: _Noise, *, with_pattern: bool) -> tuple[FloatArray, FloatArray, FloatArray]:
        """(m,) light of pixels, their deviations from the profile with leverage allowed for, and the sky's variance.

        with_pattern : whether the mean deviation of all stars, relative to their light, is removed.
        """
        variance = noise.variance(self.expected, self.sky)
        weight = np.where(self.usable, 1 / np.sqrt(np.where(self.usable, variance, 1.0)), 0.0)
        orthogonal, _ = np.linalg.qr(self.basis * weight[:, :, None])
        leverage = (orthogonal**2).sum(axis=-1)
        scaled = self.light * weight
        fitted = np.einsum("nkp,np->nk", orthogonal, np.einsum("nkp,nk->np", orthogonal, scaled))
        safe = np.where(weight > 0, weight, 1.0)
        used = self.usable & (leverage < LEVERAGE) & (fitted > 0)
        light, sky = (fitted / safe)[used], self.sky[used]
        deviation = ((scaled - fitted) / safe)[used] / np.sqrt(1 - leverage[used])
        if not with_pattern:
            return light, deviation, sky
        relative, variance = deviation / light, noise.variance(light, sky)
        precision = light**2 / variance
        near = np.abs(deviation) < 4 * np.sqrt(variance)
        _, cell = np.unique(self.cell[used], return_inverse=True)
        total = np.maximum(np.bincount(cell, precision * near), 1e-30)
        mean = np.bincount(cell, precision * near * relative) / total
        share = precision / total[cell]
        kept = share < SHARE
        without = (relative - mean[cell]) * light / np.sqrt(np.maximum(1 - share, 1 - SHARE))
        return light[kept], without[kept], sky[kept]


def _change_of_light(psf: PSF, dx: FloatArray, dy: FloatArray, reach_sigmas: float) -> FloatArray:
    """(…, 7) light of a star of flux 1 and its change with position, shape and a constant, by differences.

    reach_sigmas : the constant is 1 over the area within this distance.
    """
    step, shape_step = 0.01, 0.02 * psf.sigma_px**2
    across = [
        (psf.light(dx + step * a, dy + step * b) - psf.light(dx - step * a, dy - step * b)) / (2 * step)
        for a, b in ((1, 0), (0, 1))
    ]
    shapes = [np.eye(2), np.diag([1.0, -1.0]), np.array([[0.0, 1.0], [1.0, 0.0]])]
    wider = [
        (
            PSF(psf.matrix + shape_step * shape, psf.beta).light(dx, dy)
            - PSF(psf.matrix - shape_step * shape, psf.beta).light(dx, dy)
        )
        / 0.04
        for shape in shapes
    ]
    constant = np.full(np.shape(dx), 1 / (np.pi * (reach_sigmas * psf.sigma_px) ** 2))
    return np.stack([psf.light(dx, dy), *across, *wider, constant], axis=-1)

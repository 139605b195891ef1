"""Background: the sky level of a frame, its noise, and the correlation of the noise between pixels.

Level and noise come from photutils (meshes of clipped pixels, mode as in SExtractor). Scanned plates and resampled
images have correlated noise; the correlation is measured here because it can make the variance of a centroid several
times larger than with independent pixels.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np

from sameas.arrays import FloatArray
from sameas.errors import InputError
from sameas.sky.frame.image import Frame, Image
from sameas.sky.frame.measurements import TUNING


@dataclass(frozen=True)
class Background:
    """The sky of a frame.

    Attributes
    ----------
    level : (rows, columns) the sky, in the unit of the frame.
    variance : (rows, columns) of a pixel without a star; infinite for unusable pixels.
    inverse_gain : units of the frame per electron: the variance added per unit of star light; 0 if not known, or if the
        frame has its own error plane.
    correlation : (2k + 1, 2k + 1) of the noise of two pixels by their offset, −k … k along both axes; 1 in the middle.
    """

    level: Image
    variance: Image
    inverse_gain: float
    correlation: FloatArray

    @classmethod
    def of(cls, frame: Frame, *, box_px: int = 64) -> Background:
        """The background of a frame; ``box_px`` should be about ten times the width of a star.

        Raises
        ------
        InputError : photutils is missing; hardly a pixel is usable.
        """
        level, rms = _meshes(frame, min(box_px, min(frame.shape) // 2))
        variance = rms**2 if frame.sigma is None else frame.sigma**2
        gain = frame.facts.gain_e_per_adu
        known = np.isfinite(gain) and gain > 0 and frame.sigma is None
        usable = ~frame.masked & (variance > 0) & np.isfinite(variance)
        if not usable.any():
            raise InputError(f"{frame.name}: the sky has no noise at all; the frame is empty or was clipped")
        normal = np.where(usable, (frame.image - level) / np.sqrt(np.where(usable, variance, 1)), np.nan)
        return cls(
            level.astype(np.float32),
            np.where(usable, variance, np.inf).astype(np.float32),
            1 / gain if known else 0.0,
            _correlation(normal),
        )

    def factor(self, sigma_px: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(n,) factors on the variance of a flux and of a centroid by noise correlation, in Gaussian windows (n,).

        Σ ρ(Δ) A(Δ)/A(0), A the autocorrelation of the window w, and of w·x for the centroid.
        """
        lags = np.arange(len(self.correlation)) - len(self.correlation) // 2
        s2 = np.asarray(sigma_px, float)[:, None, None] ** 2
        x2 = (lags**2)[None, None, :]
        near = np.exp(-(x2 + (lags**2)[None, :, None]) / (4 * s2)) * self.correlation
        # Mean over both axes, which differ little; the factor is at least that of independent pixels.
        mean_axis = 1 - (x2 + (lags**2)[None, :, None]) / (4 * s2)
        return np.maximum(near.sum((1, 2)), 1.0), np.maximum((near * mean_axis).sum((1, 2)), 1.0)


def _meshes(frame: Frame, box_px: int) -> tuple[FloatArray, FloatArray]:
    """Level and standard deviation of the sky, (rows, columns) each."""
    try:
        from photutils.background import Background2D, SExtractorBackground, StdBackgroundRMS
    except ImportError as error:
        raise InputError("finding stars on frames needs photutils: pip install 'sameas[frames]'") from error
    from astropy.stats import SigmaClip

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            sky = Background2D(
                frame.image,
                box_px,
                mask=frame.flags != 0,
                exclude_percentile=80,
                sigma_clip=SigmaClip(3.0, maxiters=5),
                bkg_estimator=SExtractorBackground(),
                bkg_rms_estimator=StdBackgroundRMS(),
            )
            return np.asarray(sky.background, float), np.asarray(sky.background_rms, float)
    except ValueError as error:
        raise InputError(f"{frame.name}: too few usable pixels for a background ({error})") from error


def _correlation(normal: FloatArray) -> FloatArray:
    """The noise correlation at small offsets, from normalised pixels without stars."""
    reach, half = TUNING.noise_reach_px, TUNING.noise_side_px // 2
    independent = np.zeros((2 * reach + 1, 2 * reach + 1))
    independent[reach, reach] = 1
    rows, columns = (slice(max(0, size // 2 - half), size // 2 + half) for size in normal.shape)
    part = normal[rows, columns]
    from scipy.ndimage import maximum_filter, uniform_filter

    usable = np.isfinite(part)
    if not usable.any():
        return independent
    smooth = uniform_filter(np.nan_to_num(part), 3)
    # Masked pixels have no noise and are excluded from the scatter; stars are excluded with their surroundings.
    limit = TUNING.star_sigmas * 1.4826 * np.median(np.abs(smooth[usable]))
    bright = maximum_filter(np.abs(smooth) > limit, 9)
    sky = usable & ~bright
    if sky.sum() < TUNING.min_noise_pixels:
        return independent
    values = np.where(sky, part - np.median(part[sky]), 0.0)
    size = [2 * n for n in part.shape]
    power = np.abs(np.fft.rfft2(values, size)) ** 2
    pairs = np.abs(np.fft.rfft2(sky.astype(float), size)) ** 2
    product, count = np.fft.irfft2(power, size), np.fft.irfft2(pairs, size)
    index = np.arange(-reach, reach + 1)
    covariance = product[np.ix_(index, index)] / np.maximum(count[np.ix_(index, index)], 1)
    rho = covariance / covariance[reach, reach]
    return np.where(np.abs(rho) < TUNING.min_correlation, 0.0, rho)

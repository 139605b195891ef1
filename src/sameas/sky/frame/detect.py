"""Star detection on a frame: from pixels to :class:`Measurements`.

The background comes from photutils (BSD-3); centroids and their covariances are our own. On simulated frames
(``scripts/bench centroids``) the windowed centroids of ``sep`` and photutils are as good as ours for single
well-sampled stars; their errors are twice ours for bright stars with a FWHM of 1.5 px, and a third larger on trailed
frames. Neither gives a covariance, subtracts neighbours before measuring, or allows for correlated pixel noise. ``sep``
is by far the fastest, but LGPL; photutils' deblending takes longer than everything done here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import BoolArray, FloatArray, IntArray, robust_scale
from sameas.errors import Argument, InputError, Message
from sameas.sky.frame.centroid import (
    DEFAULT_CENTROIDS,
    FWHM_PER_SIGMA,
    PSF,
    Background,
    Centroids,
    CentroidTuning,
    Subtracted,
    adaptive,
    centroids,
    cut_stamps,
    noise_correlation,
)
from sameas.sky.frame.image import Frame
from sameas.sky.frame.measurements import Flag, Measurements
from sameas.sky.frame.photon_noise import DEFAULT_GAIN, GainTuning, InverseGain, measured_inverse_gain

_EIGHT_NEIGHBOURS = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]], bool)


@dataclass(frozen=True)
class DetectionTuning:
    """Parameters of star detection, tuned on simulated frames (``scripts/bench centroids`` and ``crowded``).

    Attributes
    ----------
    defect_sigmas : a pixel is a defect if it exceeds the sharpest star by this many standard deviations.
    defect_passes : maximum number of passes; in each, known defects are replaced by their neighbours.
    sharpness_margin : maximum ratio of sharpness among stars.
    line_sigmas : a column or row is bad if it differs from its neighbours by this many standard deviations of lines.
    min_line : minimum difference of a bad line, in standard deviations of a pixel; weaker lines are harmless.
    min_usable : no star is detected where less than this share of its pixels is usable.
    saddle_sigmas : minimum depth of the saddle between two stars, in standard deviations of the sky.
    saddle_photons : the same for the photon noise of the star, larger because the saddle is the minimum of many points
        along a trail.
    saddle_share : minimum depth of the saddle as a share of the lower peak.
    saddle_widths : peaks farther apart than this many FWHM are always two stars; longer trails are split.
    ridge_px : offset of the three parallel lines on which the saddle is measured; a ridge may miss the pixel centres.
    first_sigma_px : standard deviation of the initial PSF.
    sharpest_sigma_px : standard deviation of the sharpest possible star before the PSF is measured (FWHM 1.3 px).
    psf_stars : maximum number of stars for the PSF.
    max_stars_of_negative, min_dark_ratio : an image is a negative if it has fewer stars than the first, and more dark
        spots than this ratio to them.
    shape_snr : stars below this signal to noise ratio get no individual shape.
    wider : a star wider than the PSF by this factor gets its own window. longer : trailed if longer by this factor.
    neighbour_passes : number of passes that subtract all neighbours and remeasure every star.
    shift_share : share of the shift by neighbours that remains after their subtraction.
    pair_share : position variance of an unresolved pair, as a share of its excess second moment.
    centroids, gain : of the centroids, and of the measurement of the gain.
    """

    defect_sigmas: float = 6.0
    defect_passes: int = 3
    sharpness_margin: float = 1.4
    line_sigmas: float = 8.0
    min_line: float = 0.7
    min_usable: float = 0.3
    saddle_sigmas: float = 3.0
    saddle_photons: float = 5.0
    saddle_share: float = 0.02
    saddle_widths: float = 8.0
    ridge_px: float = 0.6
    first_sigma_px: float = 1.3
    sharpest_sigma_px: float = 0.55
    psf_stars: int = 200
    max_stars_of_negative: int = 20
    min_dark_ratio: float = 10.0
    shape_snr: float = 15.0
    wider: float = 1.3
    longer: float = 2.0
    neighbour_passes: int = 3
    shift_share: float = 0.25
    pair_share: float = 0.1
    centroids: CentroidTuning = DEFAULT_CENTROIDS
    gain: GainTuning = DEFAULT_GAIN


@dataclass(frozen=True)
class Detection:
    """How stars are detected.

    threshold_sigmas : minimum significance in the matched filter. box_px : mesh of the background. defects : whether to
    detect hot pixels, cosmic rays and bad columns on the frame. floor_px : minimum error of a centroid.
    tuning : of the detection.
    """

    threshold_sigmas: float = 4.0
    box_px: int = 64
    defects: bool = True
    floor_px: float = 0.002
    tuning: DetectionTuning = field(default=DetectionTuning(), repr=False)

    def __post_init__(self) -> None:
        least = {"threshold_sigmas": "above 0", "box_px": "of 8 or more", "floor_px": "of 0 or more"}
        for name, right in zip(least, (self.threshold_sigmas > 0, self.box_px >= 8, self.floor_px >= 0), strict=True):
            if not right:
                raise InputError(Message(Argument(name), f" is {getattr(self, name):g}; give a number {least[name]}"))


def flag_defects(frame: Frame, background: Background, psf: PSF, tuning: DetectionTuning) -> Frame:
    """The frame with its defects flagged: HOT, COSMIC, and MASKED for bad columns and rows.

    A defect is sharper than any star: the limit is the contrast of a star centred on a pixel. Single pixels are HOT,
    connected ones COSMIC; a single frame cannot separate a short cosmic ray hit from a hot pixel, darks can
    (:mod:`sameas.sky.frame.image`). astroscrappy (van Dokkum 2001, PASP 113, 1420) is not used because it does not
    compare the sharpness with the frame's stars: it flags the cores of stars with a FWHM of 1.5 px.
    """
    lines = _bad_lines(frame, background, tuning)
    sharp = _too_sharp(frame, background, psf, tuning) & ~lines
    from scipy.ndimage import label

    parts, _ = label(sharp, np.ones((3, 3)))
    size = np.bincount(parts.ravel())
    single = sharp & (size[parts] == 1)
    return frame.marked(lines, Flag.MASKED).marked(single, Flag.HOT).marked(sharp & ~single, Flag.COSMIC)


def _too_sharp(frame: Frame, background: Background, psf: PSF, tuning: DetectionTuning) -> BoolArray:
    """(rows, columns) mask of the pixels that are sharper than any star."""
    from scipy.ndimage import binary_dilation

    neighbour_light = np.array([psf.light(float(x), float(y)) for x in (-1, 0, 1) for y in (-1, 0, 1) if x or y])
    contrast = tuning.sharpness_margin * float(psf.light(0.0, 0.0)) / float(np.median(neighbour_light))
    light = frame.image - background.level
    usable = np.isfinite(background.variance)
    variance = np.where(usable, background.variance, 0.0)
    defect = np.zeros(frame.shape, bool)
    saturated = (frame.flags & Flag.SATURATED) != 0
    # Bleeding and diffraction of saturated stars may be sharper than stars.
    saturated &= binary_dilation(saturated, np.ones((3, 3))) & ~_isolated(saturated)
    near_saturated = binary_dilation(saturated, np.ones((3, 3)), iterations=2)
    rows, columns = np.nonzero((light > tuning.defect_sigmas * np.sqrt(variance)) & usable & ~near_saturated)
    work = np.pad(np.where(usable, light, 0.0), 1, mode="reflect")
    central, sky_variance = light[rows, columns], variance[rows, columns]
    for _ in range(tuning.defect_passes):
        shifted = [work[rows + 1 + y, columns + 1 + x] for y in (-1, 0, 1) for x in (-1, 0, 1) if x or y]
        neighbours = np.maximum(np.median(shifted, axis=0), 0.0)
        photons = neighbours * contrast * (1 + 0.2 * contrast)
        noise = np.sqrt(sky_variance * (1 + 0.2 * contrast**2) + background.inverse_gain * photons)
        sharp = central - contrast * neighbours > tuning.defect_sigmas * noise
        if not (sharp & ~defect[rows, columns]).any():
            break
        defect[rows[sharp], columns[sharp]] = True
        work[rows[sharp] + 1, columns[sharp] + 1] = neighbours[sharp]
    return defect


def _isolated(mask: BoolArray) -> BoolArray:
    """The pixels of a mask without neighbours in it."""
    from scipy.ndimage import convolve

    return np.asarray(mask & (convolve(mask.astype(np.int8), _EIGHT_NEIGHBOURS.astype(np.int8), mode="constant") == 0))


def _bad_lines(frame: Frame, background: Background, tuning: DetectionTuning) -> BoolArray:
    """(rows, columns) mask of the columns and rows whose median differs from their neighbours' by far."""
    from scipy.ndimage import median_filter

    bad = np.zeros(frame.shape, bool)
    usable = np.isfinite(background.variance)
    normal = np.where(usable, (frame.image - background.level) / np.sqrt(np.where(usable, background.variance, 1)), 0)
    for axis in (0, 1):
        # Half of the pixels are enough for a median.
        median = np.median(normal[::2] if axis == 0 else normal[:, ::2], axis=axis)
        deviation = np.abs(median - median_filter(median, 15, mode="reflect"))
        limit = max(tuning.min_line, tuning.line_sigmas * robust_scale(deviation))
        line = deviation > limit
        if line.mean() < 0.05:
            bad |= line[None, :] if axis == 0 else line[:, None]
    return bad


def significance(light: FloatArray, background: Background, psf: PSF, min_usable: float) -> FloatArray:
    """(rows, columns) signal to noise ratio of a star at the centre of each pixel; 0 where most of it is masked.

    Matched filter: Σ k I/v over √(Σ k²/v), k the PSF, v the variance of the sky, infinite for unusable pixels.
    min_usable : share of the pixels of a star, weighted by k², that must be usable.
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
    enough = _usable_share(weight > 0, kernel**2) > min_usable
    return np.where(enough, signal * np.sqrt(typical_weight / factor) / np.sqrt(np.maximum(noise_sq, 1e-12)), 0.0)


def _usable_share(usable: BoolArray, kernel: FloatArray) -> FloatArray:
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


def photon_noise(light: FloatArray, background: Background) -> FloatArray:
    """(rows, columns) noise of a pixel with the photons of the stars, relative to that of the sky alone."""
    return np.sqrt(1 + background.inverse_gain * np.maximum(light, 0) / background.variance)


def peaks(snr: FloatArray, noise: FloatArray, psf: PSF, detection: Detection) -> tuple[FloatArray, FloatArray]:
    """(n, 2) pixels (x, y) of the stars, the most significant first, and their significance (n,).

    Stars are maxima of the significance; two maxima without a saddle between them are one star.
    noise : (rows, columns) from :func:`photon_noise`: a saddle must be deeper than photon noise can make it.
    """
    from sameas.kernels.frames import local_maxima

    y, x = local_maxima(snr, detection.threshold_sigmas, max(1, round(psf.sigma_px)))
    if not len(x):
        return np.empty((0, 2)), np.empty(0)
    value = snr[y, x].astype(float)
    x, y = x.astype(float), y.astype(float)
    order = np.lexsort((x, y, -value))
    xy, value = np.column_stack([x, y])[order], value[order]
    keep = _separated(snr, noise, xy, value, psf, detection.tuning)
    return xy[keep], value[keep]


def _separated(
    snr: FloatArray, noise: FloatArray, xy: FloatArray, value: FloatArray, psf: PSF, tuning: DetectionTuning
) -> IntArray:
    """Rows of the peaks with a saddle between them and every higher peak within reach."""
    from scipy.spatial import cKDTree

    from sameas.kernels.frames import saddles

    reach_px = tuning.saddle_widths * psf.fwhm_px
    pairs = cKDTree(xy).query_pairs(reach_px, output_type="ndarray")
    if not len(pairs):
        return np.arange(len(xy))
    higher, lower = pairs.min(axis=1), pairs.max(axis=1)
    # A ridge may pass half a pixel from the centres of its end pixels.
    saddle = saddles(snr, xy[higher], xy[lower], int(np.ceil(reach_px)), tuning.ridge_px)
    x, y = xy[lower].astype(int).T
    random_depth = np.sqrt(tuning.saddle_sigmas**2 + tuning.saddle_photons**2 * (noise[y, x] ** 2 - 1))
    depth = np.maximum(random_depth, tuning.saddle_share * value[lower])
    return np.setdiff1d(np.arange(len(xy)), lower[value[lower] - saddle < depth])


def detect(frame: Frame, detection: Detection | None = None) -> Measurements:
    """The stars of a frame, measured, brightest first.

    Raises
    ------
    InputError : photutils is missing; no star is found.

    >>> import numpy as np
    >>> from sameas.simulate.frames import Camera, frame_of
    >>> simulated = frame_of(np.random.default_rng(1), x_px=[20.3, 44.0, 50.6], y_px=[31.5, 12.2, 47.7],
    ...                      flux_e=[2e4, 1e4, 4e4], camera=Camera(shape=(64, 64)))
    >>> detect(simulated.frame).x_px.round(0).tolist()
    [51.0, 20.0, 44.0]
    """
    detection = detection or Detection()
    background = Background.of(frame, box_px=detection.box_px, tuning=detection.tuning.centroids)
    if detection.defects:
        sharpest = PSF(detection.tuning.sharpest_sigma_px**2 * np.eye(2))
        frame, background = _without_defects(frame, background, sharpest, detection.tuning)
    psf = _mean_psf(frame, background, detection)
    measured_gain = None
    if not background.inverse_gain and frame.sigma is None:
        measured_gain = _inverse_gain(frame, background, psf, detection)
        if measured_gain is not None:
            background = replace(background, inverse_gain=measured_gain.value)
    if detection.defects:
        frame, background = _without_defects(frame, background, psf, detection.tuning)
    light = _above_sky(frame, background)
    xy, snr = _peaks_of(light, background, psf, detection)
    _refuse_negative(frame, light, background, psf, len(xy), detection)
    if not len(xy):
        raise InputError(f"{frame.name}: no star above {detection.threshold_sigmas:g}σ; lower threshold_sigmas")
    stars = _deblended(light, background, psf, xy, snr, detection, detection.tuning.neighbour_passes)
    note = _gain_note(frame, background, stars, measured_gain, detection.tuning.gain)
    return _measurements(frame, background, psf, stars, detection, note)


def _inverse_gain(frame: Frame, background: Background, psf: PSF, detection: Detection) -> InverseGain | None:
    """The inverse gain measured on the stars, deblended in one pass; None if there are too few.

    None, too, where neighbouring pixels share their noise: on a scanned plate the scatter of pixels does not tell that
    of centroids. Unresolved stars of a crowded sky are no noise: the correlation is that without the stars.
    """
    light, tuning = _above_sky(frame, background), detection.tuning
    xy, snr = _peaks_of(light, background, psf, detection)
    if len(xy) < tuning.gain.stars:
        return None
    stars = _deblended(light, background, psf, xy, snr, detection, passes=1)
    deviation = np.sqrt(background.variance, dtype=float)
    normal = np.where(np.isfinite(deviation), stars.residual / np.where(np.isfinite(deviation), deviation, 1.0), np.nan)
    without_stars = replace(background, correlation=noise_correlation(normal, tuning.centroids))
    if float(without_stars.factor(np.array([psf.sigma_px]))[1][0]) > tuning.gain.correlation:
        return None
    return _gain_of(frame, background, stars, tuning.gain)


def _gain_of(frame: Frame, background: Background, stars: _Deblended, tuning: GainTuning) -> InverseGain | None:
    common, psf = stars.centroids, stars.subtracted.psf
    usable = common.converged & ~common.at_edge & (common.usable > 0.95) & (stars.snr > tuning.snr)
    reach_px = tuning.reach_sigmas * math.sqrt(float(np.linalg.eigvalsh(psf.matrix)[1]))
    usable &= (_flags_near(frame, common.xy, reach_px) == 0) & (stars.flux > 0)
    return measured_inverse_gain(stars.residual, background, stars.subtracted, usable, tuning)


def _gain_note(
    frame: Frame, background: Background, stars: _Deblended, measured_gain: InverseGain | None, tuning: GainTuning
) -> tuple[str, ...]:
    """What is assumed about the photon noise, or doubted about the given gain."""
    if frame.sigma is not None:
        return ()
    if measured_gain is not None:
        value, error = measured_gain.value, measured_gain.error
        gain = (
            f"about {1 / value:.3g} ± {error / value**2:.1g}"
            if value > 3 * error
            else f"at least {1 / (value + 2 * error):.2g}"
        )
        return (f"gain not known: {gain} e⁻/ADU by the scatter of the light of {measured_gain.stars} stars",)
    if not background.inverse_gain:
        return ("assumed: no photon noise of the stars (gain not known); bright stars' errors are too small",)
    found = _gain_of(frame, background, stars, tuning)
    if found is None:
        return ()
    factor = max(found.value, 1e-9) / background.inverse_gain
    certain = abs(found.value - background.inverse_gain) > 5 * found.error
    if not certain or 1 / tuning.least_contradiction < factor < tuning.largest_contradiction:
        return ()
    return (
        f"doubt: the light of {found.stars} stars has {factor:.2g} times the photon variance of the gain "
        f"{1 / background.inverse_gain:.3g} e⁻/ADU"
        + (": a mean of several frames? " if factor < 1 else ": ")
        + f"gain {1 / max(found.value, 1e-9):.3g} would explain it",
    )


def _refuse_negative(
    frame: Frame, light: FloatArray, background: Background, psf: PSF, n_stars: int, detection: Detection
) -> None:
    """Refuses an image with hardly any stars and many dark spots, as of a scanned photographic negative."""
    if n_stars >= detection.tuning.max_stars_of_negative:
        return
    dark = len(_peaks_of(-light, background, psf, detection)[0])
    if dark > detection.tuning.min_dark_ratio * max(n_stars, 1):
        raise InputError(
            f"{frame.name}: {n_stars} bright and {dark} dark spots above {detection.threshold_sigmas:g}σ: it seems to "
            "be a negative, with dark stars on a bright sky",
            "subtract its pixels from their largest value",
        )


def _above_sky(frame: Frame, background: Background) -> FloatArray:
    """(rows, columns) light above the sky, 0 where unusable."""
    return np.where(np.isfinite(background.variance), frame.image - background.level, 0.0)


def _peaks_of(
    light: FloatArray, background: Background, psf: PSF, detection: Detection
) -> tuple[FloatArray, FloatArray]:
    snr = significance(light, background, psf, detection.tuning.min_usable)
    return peaks(snr, photon_noise(light, background), psf, detection)


def _without_defects(
    frame: Frame, background: Background, psf: PSF, tuning: DetectionTuning
) -> tuple[Frame, Background]:
    """The frame with its defects flagged, and the background with infinite variance there."""
    frame = flag_defects(frame, background, psf, tuning)
    unusable = (frame.flags & (Flag.HOT | Flag.COSMIC | Flag.MASKED)) != 0
    return frame, replace(background, variance=np.where(unusable, np.inf, background.variance).astype(np.float32))


def _mean_psf(frame: Frame, background: Background, detection: Detection) -> PSF:
    """The PSF of bright, single, unsaturated stars, measured twice: from a first guess, then from the result."""
    light, tuning = _above_sky(frame, background), detection.tuning
    bright = replace(detection, threshold_sigmas=max(detection.threshold_sigmas, 8.0))
    psf = PSF(tuning.first_sigma_px**2 * np.eye(2))
    for _ in range(2):
        xy, snr = _peaks_of(light, background, psf, bright)
        xy = _single(frame, xy, snr, 4 * psf.fwhm_px)[: tuning.psf_stars]
        if len(xy) < 3:
            return psf
        start = np.broadcast_to(psf.matrix, (len(xy), 2, 2))
        stars, windows = adaptive(light, background, xy, start, tuning.centroids)
        good = stars.converged & ~stars.at_edge & (stars.usable > 0.9) & (stars.weight > 0)
        if good.sum() < 3:
            return psf
        half = int(np.ceil(2.2 * psf.fwhm_px))
        stamps = cut_stamps(light, background, np.rint(stars.xy[good]).astype(int), half)
        dx, dy = stamps.x - stars.xy[good, 0, None, None], stamps.y - stars.xy[good, 1, None, None]
        fraction = stamps.light / (2 * stars.weight[good])[:, None, None]
        pixels = [tuple(np.broadcast_arrays(*each)) for each in zip(dx, dy, fraction, strict=True)]
        psf = PSF.from_stars(windows[good], pixels)  # type: ignore[arg-type]
    return psf


def _single(frame: Frame, xy: FloatArray, snr: FloatArray, reach_px: float) -> FloatArray:
    """The peaks without a comparable neighbour and without saturated pixels; all unsaturated ones if too few."""
    if not len(xy):
        return xy
    from scipy.spatial import cKDTree

    pairs = cKDTree(xy).query_pairs(reach_px, output_type="ndarray")
    disturbed = np.zeros(len(xy), bool)
    disturbed[pairs.max(axis=1)] = True  # the fainter of the two
    comparable = snr[pairs.max(axis=1)] > 0.05 * snr[pairs.min(axis=1)]
    disturbed[pairs.min(axis=1)[comparable]] = True
    saturated = (_flags_near(frame, xy, reach_px / 4) & Flag.SATURATED) != 0
    single = xy[~disturbed & ~saturated]
    return np.asarray(single if len(single) >= 10 else xy[~saturated])


@dataclass(frozen=True)
class _Deblended:
    """Centroids in the common window after subtraction of all neighbours.

    snr : (n,) significance of the peaks. blended_xy : (n, 2) centroids before the subtraction. residual : (rows,
    columns) light without the stars, which are in ``subtracted``.
    """

    centroids: Centroids
    flux: FloatArray
    snr: FloatArray
    blended_xy: FloatArray
    residual: FloatArray
    subtracted: Subtracted


def _deblended(
    light: FloatArray,
    background: Background,
    psf: PSF,
    xy: FloatArray,
    snr: FloatArray,
    detection: Detection,
    passes: int,
) -> _Deblended:
    """The stars measured in passes: subtract all stars, add each one back alone, measure it again."""
    window_fraction, tuning = psf.window_fraction(), detection.tuning.centroids
    windows = np.broadcast_to(psf.window(), (len(xy), 2, 2))
    stars = centroids(light, background, xy, windows, tuning)
    blended_xy = stars.xy
    for _ in range(passes):
        subtracted = Subtracted(stars.xy, np.maximum(stars.weight, 0) / window_fraction, psf)
        residual = _without(light, subtracted, tuning.pixels_at_once)
        stars = centroids(residual, background, xy, windows[: len(xy)], tuning, subtracted)
        is_star = _is_star(stars, snr, detection.threshold_sigmas, psf)
        if not is_star.all():
            stars = Centroids(**{name: value[is_star] for name, value in vars(stars).items()})
            snr, blended_xy, xy = snr[is_star], blended_xy[is_star], xy[is_star]
    flux = np.maximum(stars.weight, 0) / window_fraction
    subtracted = Subtracted(stars.xy, flux, psf)
    return _Deblended(stars, flux, snr, blended_xy, _without(light, subtracted, tuning.pixels_at_once), subtracted)


def _is_star(stars: Centroids, snr: FloatArray, threshold: float, psf: PSF) -> BoolArray:
    """(n,) mask of the stars that neither vanish with their neighbours' light nor have moved onto a neighbour."""
    from scipy.spatial import cKDTree

    is_star = stars.weight > 0.75 * threshold * np.sqrt(stars.weight_variance)
    pairs = cKDTree(stars.xy).query_pairs(0.6 * psf.fwhm_px, output_type="ndarray")
    if len(pairs):
        is_star[pairs.max(axis=1)] = False  # rows are ordered by significance
    return np.asarray(is_star | (np.arange(len(snr)) == 0))


def _without(light: FloatArray, subtracted: Subtracted, pixels_at_once: int) -> FloatArray:
    """(rows, columns) the light without that of the stars, which is drawn in batches of this many pixels."""
    from sameas.kernels.frames import add_stamps

    model = np.zeros(light.shape)
    half = int(np.ceil(4 * subtracted.psf.fwhm_px))
    reach = np.arange(-half, half + 1)
    step = max(1, pixels_at_once // len(reach) ** 2)
    by_row = np.argsort(subtracted.xy[:, 1], kind="stable")  # neighbours in memory
    for first in range(0, len(by_row), step):
        rows = by_row[first : first + step]
        xy, flux = subtracted.xy[rows], subtracted.flux[rows]
        x, y = np.rint(xy).astype(np.int64).T - half
        dx = (x - xy[:, 0])[:, None, None] + (reach + half)[None, None, :]
        dy = (y - xy[:, 1])[:, None, None] + (reach + half)[None, :, None]
        add_stamps(model, x, y, flux[:, None, None] * subtracted.psf.light(dx, dy))
    return (light - model).astype(light.dtype)


@dataclass(frozen=True)
class _Shapes:
    """Shapes of bright stars: rows (k,), matrices (k, 2, 2) and centroids in windows of this shape."""

    rows: IntArray
    matrices: FloatArray
    centroids: Centroids

    @classmethod
    def of(cls, background: Background, psf: PSF, stars: _Deblended, tuning: DetectionTuning) -> _Shapes:
        common = stars.centroids
        snr = np.minimum(common.weight / np.sqrt(common.weight_variance), stars.snr)
        rows = np.flatnonzero(snr > tuning.shape_snr)
        subtracted = Subtracted(stars.subtracted.xy[rows], stars.subtracted.flux[rows], psf)
        start = np.broadcast_to(psf.matrix, (len(rows), 2, 2))
        own_centroids, matrices = adaptive(
            stars.residual, background, common.xy[rows], start, tuning.centroids, subtracted
        )
        return cls(rows, matrices, own_centroids)

    def wider(self, psf: PSF, snr: FloatArray, factor: float) -> BoolArray:
        """(k,) mask of the stars that are significantly wider than the common window by a factor."""
        mean = np.sqrt(np.linalg.det(psf.matrix))
        area = np.sqrt(np.linalg.det(self.matrices))
        return np.asarray(self.centroids.converged & (area > mean * factor**2 * (1 + 4 / snr[self.rows])))

    def trailed(self, psf: PSF, longer: float) -> BoolArray:
        """(k,) mask of the stars that are longer than the mean star by a factor, and not wider by the same."""
        values, mean = np.linalg.eigvalsh(self.matrices), np.linalg.eigvalsh(psf.matrix)
        return np.asarray(
            (values[:, 1] > longer**2 * mean[1]) & (values[:, 1] / values[:, 0] > longer**2 * mean[1] / mean[0])
        )

    def extended(self, psf: PSF, wider: float) -> BoolArray:
        """(k,) mask of the stars that are wider along both axes by a factor."""
        return np.asarray(np.linalg.eigvalsh(self.matrices)[:, 0] > wider**2 * np.linalg.eigvalsh(psf.matrix)[0])


def _measurements(
    frame: Frame,
    background: Background,
    psf: PSF,
    stars: _Deblended,
    detection: Detection,
    gain_note: tuple[str, ...] = (),
) -> Measurements:
    """Positions and errors in the common window, or in the star's own window if its shape differs."""
    common, tuning = stars.centroids, detection.tuning
    bright = (common.weight > 30 * np.sqrt(common.weight_variance)) & common.converged
    jacobian = np.median(common.jacobian[bright], axis=0) if bright.sum() >= 5 else _gaussian_jacobian(psf)
    xy, covariance = (
        common.xy.copy(),
        common.covariance(np.where(common.weight[:, None, None] > 0, jacobian, np.eye(2))),
    )
    flux, flux_err = stars.flux.copy(), np.sqrt(common.weight_variance) / psf.window_fraction()
    flags = _flags_near(frame, xy, psf.fwhm_px)
    matrices = np.full((len(xy), 2, 2), np.nan)
    shapes = _Shapes.of(background, psf, stars, tuning)
    if len(shapes.rows):
        matrices[shapes.rows] = shapes.matrices
        wider, trailed = shapes.wider(psf, stars.snr, tuning.wider), shapes.trailed(psf, tuning.longer)
        own_shape = wider & (
            trailed | shapes.extended(psf, tuning.wider) | ((flags[shapes.rows] & Flag.SATURATED) != 0)
        )
        rows = shapes.rows[own_shape]
        own = shapes.centroids
        xy[rows] = own.xy[own_shape]
        covariance[rows] = own.covariance(_bounded(own.jacobian))[own_shape]
        flux[rows] = 2 * own.weight[own_shape]
        flux_err[rows] = 2 * np.sqrt(own.weight_variance[own_shape])
        flags[rows] |= _flags_near(frame, xy[rows], 1.0, shapes.matrices[own_shape])
        flags[shapes.rows[own_shape & trailed]] |= np.uint16(Flag.TRAILED)
        # Longer, but not a trail: an unresolved pair, whose stars may both be off the centroid.
        unresolved = shapes.rows[wider & ~own_shape]
        flags[unresolved] |= np.uint16(Flag.BLENDED)
        covariance[unresolved] += tuning.pair_share * (shapes.matrices[wider & ~own_shape] - psf.matrix)
    covariance = _with_systematic_errors(covariance, stars, psf, flags, detection)  # also sets flags
    columns: dict[str, NDArray[Any]] = {
        "x_px": xy[:, 0], "y_px": xy[:, 1], "covariance": covariance[:, [0, 0, 1], [0, 1, 1]], "flux": flux,
        "flux_err": flux_err, "snr": stars.snr, "flags": flags, **_ellipses(matrices),
    }  # fmt: skip
    return _table(frame, background, psf, columns, (*_notes(frame, background, psf, tuning.longer), *gain_note))


def _with_systematic_errors(
    covariance: FloatArray, stars: _Deblended, psf: PSF, flags: NDArray[np.uint16], detection: Detection
) -> FloatArray:
    """Covariances with the errors by neighbours, sampling and saturation; sets their bits in ``flags``."""
    common = stars.centroids
    shift = common.xy - stars.blended_xy
    sigma = np.sqrt(np.trace(covariance, axis1=1, axis2=2) / 2)
    flags[np.hypot(*shift.T) > 0.3 * sigma + 0.01] |= np.uint16(Flag.BLENDED)
    flags[common.at_edge] |= np.uint16(Flag.EDGE)
    flags[~common.converged] |= np.uint16(Flag.POOR)
    covariance = covariance + detection.tuning.shift_share**2 * shift[:, :, None] * shift[:, None, :]
    floor = detection.floor_px**2 + psf.phase_error_px() ** 2
    saturated = (flags & Flag.SATURATED) != 0
    covariance = covariance + (floor + np.where(saturated, (0.03 * psf.fwhm_px) ** 2, 0.0))[:, None, None] * np.eye(2)
    covariance[~common.converged] = psf.matrix
    # An unresolved pair is wider along one axis only: the excess along the other may be negative.
    values, vectors = np.linalg.eigh((covariance + covariance.transpose(0, 2, 1)) / 2)
    return np.asarray((vectors * np.maximum(values, floor + 1e-12)[:, None, :]) @ vectors.transpose(0, 2, 1))


def _ellipses(matrices: FloatArray) -> dict[str, FloatArray]:
    """The columns of shape of second moments (n, 2, 2), NaN where these are."""
    values, vectors = np.linalg.eigh(np.where(np.isfinite(matrices), matrices, np.eye(2)))
    has_shape = np.isfinite(matrices).all(axis=(1, 2))
    theta = np.degrees(np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1])) % 180
    axes = np.sqrt(values[:, 1]), np.sqrt(values[:, 0]), theta
    a, b, theta = (np.where(has_shape, column, np.nan) for column in axes)
    return {"a_px": a, "b_px": b, "theta_deg": theta, "fwhm_px": FWHM_PER_SIGMA * np.sqrt(a * b)}


def _table(
    frame: Frame, background: Background, psf: PSF, columns: dict[str, NDArray[Any]], notes: tuple[str, ...]
) -> Measurements:
    """The measurements with these columns, and the background and peak at their pixels; the brightest first."""
    order = np.argsort(-columns["flux"], kind="stable")
    pixel = np.rint(np.column_stack([columns["x_px"], columns["y_px"]])).astype(int)
    x, y = np.clip(pixel[:, 0], 0, frame.shape[1] - 1), np.clip(pixel[:, 1], 0, frame.shape[0] - 1)
    columns = columns | {
        "background": background.level[y, x].astype(float),
        "peak": (frame.image - background.level)[y, x].astype(float),
    }
    return Measurements(
        **{name: np.ascontiguousarray(column[order]) for name, column in columns.items()},
        shape=frame.shape,
        psf_fwhm_px=psf.fwhm_px,
        name=frame.name,
        notes=notes,
        blind=_blind(frame, psf),
    )


def _blind(frame: Frame, psf: PSF) -> BoolArray | None:
    """(rows, columns) mask where most pixels of a star are masked; None without masked pixels."""
    if not frame.masked.any():
        return None
    from scipy.ndimage import uniform_filter

    size = 2 * math.ceil(psf.fwhm_px) + 1
    return np.asarray(uniform_filter(frame.masked.astype(np.float32), size, mode="nearest") > 0.5)


def _notes(frame: Frame, background: Background, psf: PSF, longer: float) -> tuple[str, ...]:
    count = {flag: int(((frame.flags & flag) != 0).sum()) for flag in (Flag.HOT, Flag.COSMIC, Flag.MASKED)}
    notes = [f"stars {psf.fwhm_px:.2f} px wide at half maximum, Moffat β {psf.beta:.1f}"]
    notes += [f"{n} pixels {Flag.words(flag)}" for flag, n in count.items() if n]
    axes = np.sqrt(np.linalg.eigvalsh(psf.matrix))
    if axes[1] > longer * axes[0]:
        notes.append(f"doubt: the stars are trailed, {axes[1] / axes[0]:.1f} times longer than wide")
    shared = float(background.factor(np.array([psf.sigma_px]))[1][0])
    if shared > 1.2:
        notes.append(
            f"noise of neighbouring pixels is correlated: variances of positions are {shared:.1f} times larger"
        )
    return tuple(notes)


def _gaussian_jacobian(psf: PSF) -> FloatArray:
    """J / Σ w I of a Gaussian star."""
    window = psf.window()
    return np.asarray(
        np.eye(2) - np.linalg.inv(np.linalg.inv(psf.matrix) + np.linalg.inv(window)) @ np.linalg.inv(window)
    )


def _bounded(jacobian: FloatArray) -> FloatArray:
    """Jacobians of individual stars with eigenvalues limited to 0.15 … 1: flat tops have singular ones."""
    symmetric = (jacobian + jacobian.transpose(0, 2, 1)) / 2
    values, vectors = np.linalg.eigh(np.nan_to_num(symmetric))
    return np.asarray((vectors * np.clip(values, 0.15, 1.0)[:, None, :]) @ vectors.transpose(0, 2, 1))


def _flags_near(
    frame: Frame, xy: FloatArray, radius_px: float, windows: FloatArray | None = None
) -> NDArray[np.uint16]:
    """(n,) combined flags of the pixels within a radius, in units of the windows (n, 2, 2) if given."""
    if windows is None:
        windows = np.broadcast_to(np.eye(2), (len(xy), 2, 2))
    if not len(xy):
        return np.empty(0, np.uint16)
    inverse = np.linalg.inv(windows)
    half = int(np.ceil(radius_px * np.sqrt(np.linalg.eigvalsh(windows)[:, 1].max())))
    reach = np.arange(-half, half + 1)
    centre = np.rint(xy).astype(int)
    x, y = centre[:, 0, None, None] + reach[None, None, :], centre[:, 1, None, None] + reach[None, :, None]
    dx, dy = x - xy[:, 0, None, None], y - xy[:, 1, None, None]
    a, b, c = (inverse[:, i, j, None, None] for i, j in ((0, 0), (0, 1), (1, 1)))
    near = (a * dx**2 + 2 * b * dx * dy + c * dy**2 <= max(radius_px, 1.0) ** 2) & (x >= 0) & (y >= 0)
    near &= (x < frame.shape[1]) & (y < frame.shape[0])
    bits = frame.flags[np.clip(y, 0, frame.shape[0] - 1), np.clip(x, 0, frame.shape[1] - 1)]
    return np.asarray(np.bitwise_or.reduce(np.where(near, bits, 0).reshape(len(xy), -1), axis=1).astype(np.uint16))

"""Detect: the stars of a frame, measured; the way from pixels to :class:`Measurements`.

Background and peaks come from photutils (BSD-3), centroids and their covariance are our own. On simulated frames
(``scripts/bench centroids``) the windowed centroids of ``sep`` and of photutils are as good as ours for single
well-sampled stars, twice as far off for bright stars 1.5 px wide, a third farther off where the frame is trailed; and
neither gives their covariance, takes the light of neighbours away before it measures, or allows for pixels that share
their noise. ``sep`` is much the fastest, but LGPL; photutils' deblending takes longer than all that is done here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.errors import InputError
from sameas.sky.frame.background import Background
from sameas.sky.frame.centroid import Centroids, Own, adaptive, centroids, cut
from sameas.sky.frame.image import Frame
from sameas.sky.frame.measurements import Flag, Measurements
from sameas.sky.frame.psf import FWHM_PER_SIGMA, PSF

# Defects: what is bright, or dead, without a star: hot pixels, hits of particles, bad columns and rows.
#
# Found on a single frame by sharpness: no star can stand out from its neighbours more than one that is centred on a
# pixel. Single pixels are called hot, several that hang together the hit of a particle; one frame cannot tell a short
# hit from a hot pixel, darks can (:mod:`sameas.sky.frame.calibration`). Chosen over astroscrappy (van Dokkum 2001,
# PASP 113, 1420), whose sharpness is not compared with the frame's own star: it takes the cores of stars 1.5 px wide.

_SIGMAS = 6.0
_LINE_SIGMAS = 8.0
_LEAST_LINE = 0.7  # in standard deviations of a pixel: weaker columns do no harm
_MARGIN = 1.4  # stars differ in sharpness by less
_AROUND = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]], bool)


def marked(frame: Frame, background: Background, psf: PSF) -> Frame:
    """The frame with its defects flagged: HOT, COSMIC, and MASKED for bad columns and rows."""
    lines = _lines(frame, background)
    sharp = _sharp(frame, background, psf) & ~lines
    from scipy.ndimage import label

    parts, _ = label(sharp, np.ones((3, 3)))
    size = np.bincount(parts.ravel())
    single = sharp & (size[parts] == 1)
    return frame.marked(lines, Flag.MASKED).marked(single, Flag.HOT).marked(sharp & ~single, Flag.COSMIC)


def _sharp(frame: Frame, background: Background, psf: PSF, rounds: int = 3) -> BoolArray:
    """Pixels that no star explains."""
    from scipy.ndimage import binary_dilation

    around = np.array([psf.light(float(x), float(y)) for x in (-1, 0, 1) for y in (-1, 0, 1) if x or y])
    contrast = _MARGIN * float(psf.light(0.0, 0.0)) / float(np.median(around))
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


def _alone(mask: BoolArray) -> BoolArray:
    from scipy.ndimage import convolve

    return np.asarray(mask & (convolve(mask.astype(np.int8), _AROUND.astype(np.int8), mode="constant") == 0))


def _lines(frame: Frame, background: Background) -> BoolArray:
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


# Peaks: where on a frame there is a star, by the matched filter.
#
# The signal to noise ratio of a star at every pixel is Σ k I/v over √(Σ k²/v), k the mean star, v the variance of the
# sky, a missing pixel one of infinite variance. Its maxima are stars; two that no saddle divides are one.

_LEAST_USABLE = 0.3
_SADDLE_SIGMAS = 3.0
_SADDLE_PHOTONS = 5.0  # the same of a star's own photons: the saddle is the lowest of many places along a trail
_SADDLE_REACH = 8  # full widths of a star: longer trails than that come in parts
_SADDLE_SHARE = 0.02
_HALF_PX = 0.6


def significance(light: FloatArray, background: Background, psf: PSF) -> FloatArray:
    """(rows, columns) signal to noise ratio of a star in the middle of each pixel; 0 where most is masked."""
    from scipy.signal import oaconvolve

    half = int(np.ceil(3.5 * np.sqrt(np.linalg.eigvalsh(psf.matrix)[1])))
    reach = np.arange(-half, half + 1)
    inverse = np.linalg.inv(psf.matrix)
    dx, dy = np.meshgrid(reach, reach)
    kernel = np.exp(-0.5 * (inverse[0, 0] * dx**2 + 2 * inverse[0, 1] * dx * dy + inverse[1, 1] * dy**2))
    kernel = kernel.astype(np.float32)
    weight = np.where(np.isfinite(background.variance), 1 / background.variance, 0).astype(np.float32)
    usual = float(np.median(weight[weight > 0]))
    weight /= usual
    signal = oaconvolve((light * weight).astype(np.float32), kernel, mode="same")
    noise2 = oaconvolve(weight, kernel**2, mode="same")
    factor = float(background.factor(np.array([psf.sigma_px]))[0][0])
    usable = oaconvolve((weight > 0).astype(np.float32), kernel**2, mode="same")
    enough = usable > _LEAST_USABLE * float((kernel**2).sum())
    return np.where(enough, signal * np.sqrt(usual / factor) / np.sqrt(np.maximum(noise2, 1e-12)), 0.0)


def photon_noise(light: FloatArray, background: Background) -> FloatArray:
    """(rows, columns) noise of a pixel, the photons of the stars included, over that of the sky alone."""
    return np.sqrt(1 + background.inverse_gain * np.maximum(light, 0) / background.variance)


def peaks(snr: FloatArray, noise: FloatArray, psf: PSF, threshold_sigmas: float) -> tuple[FloatArray, FloatArray]:
    """(n, 2) pixels (x, y) of the stars, the most significant first, and their (n,) significance.

    noise : (rows, columns) of :func:`photon_noise`: a saddle must be deeper than the photons of a star make it.
    """
    try:
        from photutils.detection import find_peaks
    except ImportError as error:
        raise InputError("finding stars on frames needs photutils: pip install 'sameas[frames]'") from error
    import warnings

    box = 2 * max(1, round(psf.sigma_px)) + 1
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # photutils warns when there is nothing; the caller says it better
        found = find_peaks(snr, threshold_sigmas, box_size=box)
    if found is None or not len(found):
        return np.empty((0, 2)), np.empty(0)
    names = ("x_peak", "y_peak", "peak_value")
    x, y, value = (np.asarray(found[name], float) for name in names)
    order = np.lexsort((x, y, -value))
    xy, value = np.column_stack([x, y])[order], value[order]
    keep = _divided(snr, noise, xy, value, _SADDLE_REACH * psf.fwhm_px)
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


_SHAPE_SNR = 15.0
_WIDER = 1.3  # a star so much wider than the others gets a window of its own
_LONGER = 2.0
_NEIGHBOUR_ROUNDS = 3
_STARS_FOR_SPREAD = 200
_PULL_KEPT = 0.25  # share of a neighbour's pull that taking it away leaves, as simulations of crowded fields show
_PAIR_KEPT = 0.1  # share of the excess second moment of two stars in one that a position may be off by, squared
_FIRST = PSF(1.3**2 * np.eye(2))
_FIRST_SHARPEST = PSF(0.55**2 * np.eye(2))  # before the frame's own stars are known, none is narrower than 1.3 px


@dataclass(frozen=True)
class Detection:
    """How stars are looked for.

    threshold_sigmas : lowest significance in the matched filter. box_px : mesh of the background. defects : look for
    hot pixels, particles and bad columns on the frame itself. floor_px : error that no centroid is below.
    """

    threshold_sigmas: float = 4.0
    box_px: int = 64
    defects: bool = True
    floor_px: float = 0.002

    def __post_init__(self) -> None:
        if not self.threshold_sigmas > 0 or self.box_px < 8 or not self.floor_px >= 0:
            raise InputError(
                f"Detection: threshold_sigmas {self.threshold_sigmas}, box_px {self.box_px}, floor_px {self.floor_px}; "
                "give a threshold above 0, a mesh of 8 px or more, a floor of 0 or more"
            )


def detect(frame: Frame, detection: Detection | None = None) -> Measurements:
    """The stars of a frame, brightest first.

    Raises
    ------
    InputError : photutils is missing; no star is found.

    >>> import numpy as np
    >>> from sameas.simulate.frames import Camera, frame_of
    >>> seen = frame_of(np.random.default_rng(1), x_px=[20.3, 44.0, 50.6], y_px=[31.5, 12.2, 47.7],
    ...                 flux_e=[2e4, 1e4, 4e4], camera=Camera(shape=(64, 64)))
    >>> detect(seen.frame).x_px.round(0).tolist()
    [51.0, 20.0, 44.0]
    """
    detection = detection or Detection()
    background = Background.of(frame, box_px=detection.box_px)
    if detection.defects:
        frame, background = _without_defects(frame, background, _FIRST_SHARPEST)
    psf = _mean_psf(frame, background, detection)
    if detection.defects:
        frame, background = _without_defects(frame, background, psf)
    light = np.where(np.isfinite(background.variance), frame.image - background.level, 0.0)
    xy, snr = peaks(
        significance(light, background, psf), photon_noise(light, background), psf, detection.threshold_sigmas
    )
    if not len(xy):
        raise InputError(f"{frame.name}: no star above {detection.threshold_sigmas:g}σ; lower threshold_sigmas")
    stars = _neighbours_apart(light, background, psf, xy, snr, detection.threshold_sigmas)
    return _measurements(frame, background, psf, stars, detection)


def _without_defects(frame: Frame, background: Background, psf: PSF) -> tuple[Frame, Background]:
    frame = marked(frame, background, psf)
    unusable = (frame.flags & (Flag.HOT | Flag.COSMIC | Flag.MASKED)) != 0
    return frame, replace(background, variance=np.where(unusable, np.inf, background.variance).astype(np.float32))


def _mean_psf(frame: Frame, background: Background, detection: Detection) -> PSF:
    """The mean star, from bright ones that are single and not saturated; of a first guess, then of the result."""
    light = np.where(np.isfinite(background.variance), frame.image - background.level, 0.0)
    psf = _FIRST
    for _ in range(2):
        xy, snr = peaks(
            significance(light, background, psf),
            photon_noise(light, background),
            psf,
            max(detection.threshold_sigmas, 8.0),
        )
        xy = _single(frame, xy, snr, 4 * psf.fwhm_px)[:_STARS_FOR_SPREAD]
        if len(xy) < 3:
            return psf
        found, windows = adaptive(light, background, xy, np.broadcast_to(psf.matrix, (len(xy), 2, 2)))
        good = found.settled & ~found.at_edge & (found.usable > 0.9) & (found.weight > 0)
        if good.sum() < 3:
            return psf
        half = int(np.ceil(2.2 * psf.fwhm_px))
        stamps = cut(light, background, np.rint(found.xy[good]).astype(int), half)
        dx, dy = stamps.x - found.xy[good, 0, None, None], stamps.y - found.xy[good, 1, None, None]
        share = stamps.light / (2 * found.weight[good])[:, None, None]
        pixels = [tuple(np.broadcast_arrays(*each)) for each in zip(dx, dy, share, strict=True)]
        psf = PSF.from_stars(windows[good], pixels)  # type: ignore[arg-type]
    return psf


def _single(frame: Frame, xy: FloatArray, snr: FloatArray, reach_px: float) -> FloatArray:
    """Peaks without a comparable neighbour and without saturated pixels."""
    if not len(xy):
        return xy
    from scipy.spatial import cKDTree

    crowd = cKDTree(xy).query_pairs(reach_px, output_type="ndarray")
    disturbed = np.zeros(len(xy), bool)
    disturbed[crowd.max(axis=1)] = True  # the fainter of the two
    strong = snr[crowd.max(axis=1)] > 0.05 * snr[crowd.min(axis=1)]
    disturbed[crowd.min(axis=1)[strong]] = True
    saturated = (_flags_near(frame, xy, reach_px / 4) & Flag.SATURATED) != 0
    single = xy[~disturbed & ~saturated]
    return np.asarray(single if len(single) >= 10 else xy[~saturated])


@dataclass(frozen=True)
class _Blended:
    """Centroids in the common window with the neighbours' light taken away. before : (n, 2) without that."""

    found: Centroids
    flux: FloatArray
    snr: FloatArray
    before: FloatArray
    residual: FloatArray
    own: Own


def _neighbours_apart(
    light: FloatArray, background: Background, psf: PSF, xy: FloatArray, snr: FloatArray, threshold: float
) -> _Blended:
    """Measures, takes all stars off the frame, puts each one back alone, measures again."""
    window, collected = psf.window(), psf.collected()
    windows = np.broadcast_to(window, (len(xy), 2, 2))
    found = centroids(light, background, xy, windows)
    before, own, residual = found.xy, None, light
    for _ in range(_NEIGHBOUR_ROUNDS):
        flux = np.maximum(found.weight, 0) / collected
        own = Own(found.xy, flux, psf)
        residual = light - _model(own, light.shape)
        found = centroids(residual, background, xy, windows[: len(xy)], own)
        lasting = _lasting(found, snr, threshold, psf)
        if not lasting.all():
            found = Centroids(**{name: value[lasting] for name, value in vars(found).items()})
            snr, before, xy = snr[lasting], before[lasting], xy[lasting]
    flux = np.maximum(found.weight, 0) / collected
    own = Own(found.xy, flux, psf)
    return _Blended(found, flux, snr, before, light - _model(own, light.shape), own)


def _lasting(found: Centroids, snr: FloatArray, threshold: float, psf: PSF) -> BoolArray:
    """Not what vanishes with the light of a neighbour, nor what has slid onto one."""
    from scipy.spatial import cKDTree

    lasting = found.weight > 0.75 * threshold * np.sqrt(found.weight_variance)
    pairs = cKDTree(found.xy).query_pairs(0.6 * psf.fwhm_px, output_type="ndarray")
    if len(pairs):
        lasting[pairs.max(axis=1)] = False  # rows are ordered by significance
    return np.asarray(lasting | (np.arange(len(snr)) == 0))


def _model(own: Own, shape: tuple[int, ...]) -> FloatArray:
    """(rows, columns) light of all stars."""
    model = np.zeros(shape)
    half = int(np.ceil(4 * own.psf.fwhm_px))
    reach = np.arange(-half, half + 1)
    step = max(1, 4_000_000 // len(reach) ** 2)
    for first in range(0, len(own.xy), step):
        xy, flux = own.xy[first : first + step], own.flux[first : first + step]
        centre = np.rint(xy).astype(int)
        x, y = centre[:, 0, None, None] + reach[None, None, :], centre[:, 1, None, None] + reach[None, :, None]
        light = flux[:, None, None] * own.psf.light(x - xy[:, 0, None, None], y - xy[:, 1, None, None])
        inside = (x >= 0) & (x < shape[1]) & (y >= 0) & (y < shape[0])
        cell = (np.clip(y, 0, shape[0] - 1) * shape[1] + np.clip(x, 0, shape[1] - 1)).ravel()
        model += np.bincount(cell, np.where(inside, light, 0).ravel(), minlength=model.size).reshape(shape)
    return model


@dataclass(frozen=True)
class _Shapes:
    """What bright stars look like: rows (k,), their matrices (k, 2, 2) and centroids in windows of that shape."""

    rows: IntArray
    matrices: FloatArray
    found: Centroids

    @classmethod
    def of(cls, background: Background, psf: PSF, stars: _Blended) -> _Shapes:
        told = np.minimum(stars.found.weight / np.sqrt(stars.found.weight_variance), stars.snr) > _SHAPE_SNR
        rows = np.flatnonzero(told)
        own = Own(stars.own.xy[rows], stars.own.flux[rows], psf)
        start = np.broadcast_to(psf.matrix, (len(rows), 2, 2))
        found, matrices = adaptive(stars.residual, background, stars.found.xy[rows], start, own)
        return cls(rows, matrices, found)

    def wider(self, psf: PSF, snr: FloatArray) -> BoolArray:
        """(k,) where the common window is too narrow by more than noise may do."""
        mean = np.sqrt(np.linalg.det(psf.matrix))
        area = np.sqrt(np.linalg.det(self.matrices))
        return np.asarray(self.found.settled & (area > mean * _WIDER**2 * (1 + 4 / snr[self.rows])))

    def trailed(self, psf: PSF) -> BoolArray:
        """(k,) longer than the mean star, and not as much wider."""
        values, mean = np.linalg.eigvalsh(self.matrices), np.linalg.eigvalsh(psf.matrix)
        return np.asarray(
            (values[:, 1] > _LONGER**2 * mean[1]) & (values[:, 1] / values[:, 0] > _LONGER**2 * mean[1] / mean[0])
        )

    def extended(self, psf: PSF) -> BoolArray:
        """(k,) wider along both axes."""
        return np.asarray(np.linalg.eigvalsh(self.matrices)[:, 0] > _WIDER**2 * np.linalg.eigvalsh(psf.matrix)[0])


def _measurements(
    frame: Frame, background: Background, psf: PSF, stars: _Blended, detection: Detection
) -> Measurements:
    """Positions and errors: in the common window, or in that of the star where it is of another shape."""
    found = stars.found
    bright = (found.weight > 30 * np.sqrt(found.weight_variance)) & found.settled
    usual = np.median(found.jacobian[bright], axis=0) if bright.sum() >= 5 else _theory(psf)
    xy, covariance = found.xy.copy(), found.covariance(np.where(found.weight[:, None, None] > 0, usual, np.eye(2)))
    flux, flux_err = stars.flux.copy(), np.sqrt(found.weight_variance) / psf.collected()
    flags = _flags_near(frame, xy, psf.fwhm_px)
    matrices = np.full((len(xy), 2, 2), np.nan)
    shapes = _Shapes.of(background, psf, stars)
    if len(shapes.rows):
        matrices[shapes.rows] = shapes.matrices
        wider, trailed = shapes.wider(psf, stars.snr), shapes.trailed(psf)
        other = wider & (trailed | shapes.extended(psf) | ((flags[shapes.rows] & Flag.SATURATED) != 0))
        rows = shapes.rows[other]
        xy[rows] = shapes.found.xy[other]
        covariance[rows] = shapes.found.covariance(_sane(shapes.found.jacobian))[other]
        flux[rows] = 2 * shapes.found.weight[other]
        flux_err[rows] = 2 * np.sqrt(shapes.found.weight_variance[other])
        flags[rows] |= _flags_near(frame, xy[rows], 1.0, shapes.matrices[other])
        flags[shapes.rows[other & trailed]] |= np.uint16(Flag.TRAILED)
        # Longer without being a trail: two stars too near to be told apart, of which neither may be in the middle.
        pairs = shapes.rows[wider & ~other]
        flags[pairs] |= np.uint16(Flag.BLENDED)
        covariance[pairs] += _PAIR_KEPT * (shapes.matrices[wider & ~other] - psf.matrix)
    covariance = _allowed(covariance, stars, psf, flags, detection)
    order = np.argsort(-flux, kind="stable")
    return _table(frame, background, psf, xy, covariance, flux, flux_err, matrices, stars.snr, flags, order)


def _allowed(
    covariance: FloatArray, stars: _Blended, psf: PSF, flags: NDArray[np.uint16], detection: Detection
) -> FloatArray:
    """Covariances with what noise does not tell: neighbours, pixels, saturation; sets the flags that go with it."""
    found = stars.found
    pull = found.xy - stars.before
    sigma = np.sqrt(np.trace(covariance, axis1=1, axis2=2) / 2)
    flags[np.hypot(*pull.T) > 0.3 * sigma + 0.01] |= np.uint16(Flag.BLENDED)
    flags[found.at_edge] |= np.uint16(Flag.EDGE)
    flags[~found.settled] |= np.uint16(Flag.POOR)
    covariance = covariance + _PULL_KEPT**2 * pull[:, :, None] * pull[:, None, :]
    floor = detection.floor_px**2 + psf.phase_error_px() ** 2
    saturated = (flags & Flag.SATURATED) != 0
    covariance = covariance + (floor + np.where(saturated, (0.03 * psf.fwhm_px) ** 2, 0.0))[:, None, None] * np.eye(2)
    covariance[~found.settled] = psf.matrix
    # A pair of stars is wider along one axis only: the excess along the other may be negative.
    values, vectors = np.linalg.eigh((covariance + covariance.transpose(0, 2, 1)) / 2)
    return np.asarray((vectors * np.maximum(values, floor + 1e-12)[:, None, :]) @ vectors.transpose(0, 2, 1))


def _table(
    frame: Frame,
    background: Background,
    psf: PSF,
    xy: FloatArray,
    covariance: FloatArray,
    flux: FloatArray,
    flux_err: FloatArray,
    matrices: FloatArray,
    snr: FloatArray,
    flags: NDArray[np.uint16],
    order: IntArray,
) -> Measurements:
    values, vectors = np.linalg.eigh(np.where(np.isfinite(matrices), matrices, np.eye(2)))
    told = np.isfinite(matrices).all(axis=(1, 2))
    theta = np.degrees(np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1])) % 180
    a, b, theta = (np.where(told, column, np.nan) for column in (np.sqrt(values[:, 1]), np.sqrt(values[:, 0]), theta))
    pixel = np.rint(xy).astype(int)
    x, y = np.clip(pixel[:, 0], 0, frame.shape[1] - 1), np.clip(pixel[:, 1], 0, frame.shape[0] - 1)
    columns = {
        "x_px": xy[:, 0], "y_px": xy[:, 1], "covariance": covariance[:, [0, 0, 1], [0, 1, 1]], "flux": flux,
        "flux_err": flux_err, "background": background.level[y, x].astype(float), "a_px": a, "b_px": b,
        "theta_deg": theta, "fwhm_px": FWHM_PER_SIGMA * np.sqrt(a * b), "snr": snr,
        "peak": (frame.image - background.level)[y, x].astype(float), "flags": flags,
    }  # fmt: skip
    return Measurements(
        **{name: np.ascontiguousarray(column[order]) for name, column in columns.items()},
        shape=frame.shape,
        psf_fwhm_px=psf.fwhm_px,
        name=frame.name,
        notes=_notes(frame, background, psf),
        blind=_blind(frame, psf),
    )


def _blind(frame: Frame, psf: PSF) -> BoolArray | None:
    """(rows, columns) where most of a star's pixels are masked; None without a mask."""
    if not frame.masked.any():
        return None
    from scipy.ndimage import uniform_filter

    size = 2 * math.ceil(psf.fwhm_px) + 1
    return np.asarray(uniform_filter(frame.masked.astype(np.float32), size, mode="nearest") > 0.5)


def _notes(frame: Frame, background: Background, psf: PSF) -> tuple[str, ...]:
    count = {flag: int(((frame.flags & flag) != 0).sum()) for flag in (Flag.HOT, Flag.COSMIC, Flag.MASKED)}
    notes = [f"stars {psf.fwhm_px:.2f} px wide at half maximum, Moffat β {psf.beta:.1f}"]
    notes += [f"{n} pixels {Flag.words(flag)}" for flag, n in count.items() if n]
    axes = np.sqrt(np.linalg.eigvalsh(psf.matrix))
    if axes[1] > _LONGER * axes[0]:
        notes.append(f"doubt: the stars are trailed, {axes[1] / axes[0]:.1f} times longer than wide")
    shared = float(background.factor(np.array([psf.sigma_px]))[1][0])
    if shared > 1.2:
        notes.append(f"neighbouring pixels share their noise: variances of positions are {shared:.1f} times larger")
    if not background.inverse_gain and frame.sigma is None:
        notes.append("assumed: no photon noise of the stars (gain not known); bright stars' errors are too small")
    return tuple(notes)


def _theory(psf: PSF) -> FloatArray:
    """J over Σ w I for a Gaussian star."""
    window = psf.window()
    return np.asarray(
        np.eye(2) - np.linalg.inv(np.linalg.inv(psf.matrix) + np.linalg.inv(window)) @ np.linalg.inv(window)
    )


def _sane(jacobian: FloatArray) -> FloatArray:
    """Jacobians of single stars, kept from the singular ones of flat tops."""
    symmetric = (jacobian + jacobian.transpose(0, 2, 1)) / 2
    values, vectors = np.linalg.eigh(np.nan_to_num(symmetric))
    return np.asarray((vectors * np.clip(values, 0.15, 1.0)[:, None, :]) @ vectors.transpose(0, 2, 1))


def _flags_near(
    frame: Frame, xy: FloatArray, radius_px: float, windows: FloatArray | None = None
) -> NDArray[np.uint16]:
    """(n,) flags of the pixels within a radius, in units of the windows (n, 2, 2) where they are given."""
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

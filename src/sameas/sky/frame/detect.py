"""Star detection on a frame: from pixels to :class:`Measurements`.

The background comes from photutils (BSD-3); centroids and their covariances are our own. On simulated frames
(``scripts/bench centroids``) the windowed centroids of ``sep`` and photutils are as good as ours for single
well-sampled stars; their errors are twice ours for bright stars with a FWHM of 1.5 px, and a third larger on trailed
frames. Neither gives a covariance, subtracts neighbours before measuring, or allows for correlated pixel noise. ``sep``
is by far the fastest, but LGPL; photutils' deblending takes longer than everything done here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.errors import Argument, InputError, Message
from sameas.gaussian import symmetric
from sameas.sky.frame.centroid import (
    FWHM_PER_SIGMA,
    PIXELS_AT_ONCE,
    PSF,
    Background,
    Centroids,
    Subtracted,
    adaptive,
    centroids,
    cut_stamps,
    noise_correlation,
)
from sameas.sky.frame.defects import without_defects
from sameas.sky.frame.image import Frame
from sameas.sky.frame.measurements import Flag, Measurements
from sameas.sky.frame.peaks import peaks
from sameas.sky.frame.photon_noise import (
    GAIN_REACH_SIGMAS,
    GAIN_SNR,
    GAIN_STARS,
    LARGEST_CONTRADICTION,
    LEAST_CONTRADICTION,
    MAX_NOISE_CORRELATION,
    InverseGain,
    measured_inverse_gain,
)

# Parameters of star detection, tuned on simulated frames (``scripts/bench centroids`` and ``crowded``).
FIRST_SIGMA_PX = 1.3  # standard deviation of the initial PSF
SHARPEST_SIGMA_PX = 0.55  # standard deviation of the sharpest possible star before the PSF is measured (FWHM 1.3 px)
PSF_STARS = 200  # maximum number of stars for the PSF
#: An image is a negative if it has fewer stars than the first, and more dark spots than this ratio to them.
MAX_STARS_OF_NEGATIVE, MIN_DARK_RATIO = 20, 10.0
SHAPE_SNR = 15.0  # stars below this signal to noise ratio get no individual shape
WIDER = 1.3  # a star wider than the PSF by this factor gets its own window
LONGER = 2.0  # trailed if longer by this factor
NEIGHBOUR_PASSES = 3  # number of passes that subtract all neighbours and remeasure every star
SHIFT_SHARE = 0.25  # share of the shift by neighbours that remains after their subtraction
PAIR_SHARE = 0.1  # position variance of an unresolved pair, as a share of its excess second moment
#: Shift of the centroid of a star cut by the edge or a mask, in standard deviations of its profile, by the unusable
#: share of its window: as of rendered stars with a FWHM of 3 to 3.5 px; of 2.2 px it is half as much, of 5 px more.
CUT_SHIFT = 6.0


@dataclass(frozen=True)
class Detection:
    """How stars are detected.

    threshold_sigmas : minimum significance in the matched filter. box_px : mesh of the background. defects : whether to
    detect hot pixels, cosmic rays and bad columns on the frame. floor_px : minimum error of a centroid.
    """

    threshold_sigmas: float = 4.0
    box_px: int = 64
    defects: bool = True
    floor_px: float = 0.002

    def __post_init__(self) -> None:
        least = {"threshold_sigmas": "above 0", "box_px": "of 8 or more", "floor_px": "of 0 or more"}
        for name, right in zip(least, (self.threshold_sigmas > 0, self.box_px >= 8, self.floor_px >= 0), strict=True):
            if not right:
                raise InputError(Message(Argument(name), f" is {getattr(self, name):g}; give a number {least[name]}"))

    def peaks(self, light: FloatArray, background: Background, psf: PSF) -> tuple[FloatArray, FloatArray]:
        """(n, 2) pixels (x, y) of the stars, the most significant first, and their significance (n,)."""
        return peaks(light, background, psf, self.threshold_sigmas)


DEFAULT_DETECTION = Detection()


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
    background = Background.of(frame, box_px=detection.box_px)
    if detection.defects:
        sharpest = PSF(SHARPEST_SIGMA_PX**2 * np.eye(2))
        frame, background = without_defects(frame, background, sharpest)
    psf = _mean_psf(frame, background, detection)
    measured_gain = None
    if not background.inverse_gain and frame.sigma is None:
        measured_gain = _inverse_gain(frame, background, psf, detection)
        if measured_gain is not None:
            background = replace(background, inverse_gain=measured_gain.value)
    if detection.defects:
        frame, background = without_defects(frame, background, psf)
    light = _above_sky(frame, background)
    xy, snr = detection.peaks(light, background, psf)
    _refuse_negative(frame, light, background, psf, len(xy), detection)
    if not len(xy):
        raise InputError(f"{frame.name}: no star above {detection.threshold_sigmas:g}σ; lower threshold_sigmas")
    stars = _deblended(light, background, psf, xy, snr, detection, NEIGHBOUR_PASSES)
    note = _gain_note(frame, background, stars, measured_gain)
    return _measurements(frame, background, psf, stars, detection, note)


def _inverse_gain(frame: Frame, background: Background, psf: PSF, detection: Detection) -> InverseGain | None:
    """The inverse gain measured on the stars, deblended in one pass; None if there are too few.

    None, too, where neighbouring pixels share their noise: on a scanned plate the scatter of pixels does not tell that
    of centroids. Unresolved stars of a crowded sky are no noise: the correlation is that without the stars.
    """
    light = _above_sky(frame, background)
    xy, snr = detection.peaks(light, background, psf)
    if len(xy) < GAIN_STARS:
        return None
    stars = _deblended(light, background, psf, xy, snr, detection, passes=1)
    deviation = np.sqrt(background.variance, dtype=float)
    normal = np.where(np.isfinite(deviation), stars.residual / np.where(np.isfinite(deviation), deviation, 1.0), np.nan)
    without_stars = replace(background, correlation=noise_correlation(normal))
    if float(without_stars.factor(np.array([psf.sigma_px]))[1][0]) > MAX_NOISE_CORRELATION:
        return None
    return _gain_of(frame, background, stars)


def _gain_of(frame: Frame, background: Background, stars: _Deblended) -> InverseGain | None:
    common, psf = stars.centroids, stars.subtracted.psf
    usable = common.converged & ~common.at_edge & (common.usable > 0.95) & (stars.snr > GAIN_SNR)
    reach_px = GAIN_REACH_SIGMAS * math.sqrt(float(np.linalg.eigvalsh(psf.matrix)[1]))
    usable &= (_flags_near(frame, common.xy, reach_px) == 0) & (stars.flux > 0)
    return measured_inverse_gain(stars.residual, background, stars.subtracted, usable)


def _gain_note(
    frame: Frame, background: Background, stars: _Deblended, measured_gain: InverseGain | None
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
    found = _gain_of(frame, background, stars)
    if found is None:
        return ()
    factor = max(found.value, 1e-9) / background.inverse_gain
    certain = abs(found.value - background.inverse_gain) > 5 * found.error
    if not certain or 1 / LEAST_CONTRADICTION < factor < LARGEST_CONTRADICTION:
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
    if n_stars >= MAX_STARS_OF_NEGATIVE:
        return
    dark = len(detection.peaks(-light, background, psf)[0])
    if dark > MIN_DARK_RATIO * max(n_stars, 1):
        raise InputError(
            f"{frame.name}: {n_stars} bright and {dark} dark spots above {detection.threshold_sigmas:g}σ: it seems to "
            "be a negative, with dark stars on a bright sky",
            "subtract its pixels from their largest value",
        )


def _above_sky(frame: Frame, background: Background) -> FloatArray:
    """(rows, columns) light above the sky, 0 where unusable."""
    return np.where(np.isfinite(background.variance), frame.image - background.level, 0.0)


def _mean_psf(frame: Frame, background: Background, detection: Detection) -> PSF:
    """The PSF of bright, single, unsaturated stars, measured twice: from a first guess, then from the result."""
    light = _above_sky(frame, background)
    bright = replace(detection, threshold_sigmas=max(detection.threshold_sigmas, 8.0))
    psf = PSF(FIRST_SIGMA_PX**2 * np.eye(2))
    for _ in range(2):
        xy, snr = bright.peaks(light, background, psf)
        xy = _single(frame, xy, snr, 4 * psf.fwhm_px)[:PSF_STARS]
        if len(xy) < 3:
            return psf
        measured = _psf_of(light, background, xy, psf)
        if measured is None:
            return psf
        psf = measured
    return psf


def _psf_of(light: FloatArray, background: Background, xy: FloatArray, start: PSF) -> PSF | None:
    """The PSF of stars at some pixels (n, 2), measured from a first one; None if fewer than three are usable."""
    if len(xy) < 3:
        return None
    stars, windows = adaptive(light, background, xy, np.broadcast_to(start.matrix, (len(xy), 2, 2)))
    good = stars.converged & ~stars.at_edge & (stars.usable > 0.9) & (stars.weight > 0)
    if good.sum() < 3:
        return None
    stamps = cut_stamps(light, background, np.rint(stars.xy[good]).astype(int), int(np.ceil(2.2 * start.fwhm_px)))
    dx, dy = stamps.x - stars.xy[good, 0, None, None], stamps.y - stars.xy[good, 1, None, None]
    fraction = stamps.light / (2 * stars.weight[good])[:, None, None]
    pixels = [tuple(np.broadcast_arrays(*each)) for each in zip(dx, dy, fraction, strict=True)]
    return PSF.from_stars(windows[good], pixels)  # type: ignore[arg-type]


def without_stars(
    frame: Frame, background: Background, xy: FloatArray, flux: FloatArray, fwhm_px: float
) -> tuple[FloatArray, FloatArray]:
    """The light above the sky without that of measured stars, and the light of these; (rows, columns) each.

    xy, flux : (n, 2) pixels and (n,) light of the stars. fwhm_px : of the stars; their profile is measured.
    """
    light = _above_sky(frame, background)
    if not len(xy):
        return light, np.zeros(light.shape)
    psf = PSF((fwhm_px / FWHM_PER_SIGMA) ** 2 * np.eye(2))
    brightest = xy[np.argsort(-flux, kind="stable")]
    single = _single(frame, brightest, np.sort(flux)[::-1], 4 * fwhm_px)[:PSF_STARS]
    psf = _psf_of(light, background, single, psf) or psf
    rest = _without(light, Subtracted(xy, np.maximum(flux, 0.0), psf), PIXELS_AT_ONCE)
    return rest, light - rest


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
    light: FloatArray, background: Background, psf: PSF, xy: FloatArray, snr: FloatArray, detection: Detection,
    passes: int,
) -> _Deblended:  # fmt: skip
    """The stars measured in passes: subtract all stars, add each one back alone, measure it again."""
    window_fraction = psf.window_fraction()
    windows = np.broadcast_to(psf.window(), (len(xy), 2, 2))
    stars = centroids(light, background, xy, windows)
    blended_xy = stars.xy
    for _ in range(passes):
        subtracted = Subtracted(stars.xy, np.maximum(stars.weight, 0) / window_fraction, psf)
        residual = _without(light, subtracted, PIXELS_AT_ONCE)
        stars = centroids(residual, background, xy, windows[: len(xy)], subtracted)
        is_star = _is_star(stars, snr, detection.threshold_sigmas, psf)
        if not is_star.all():
            stars = Centroids(**{name: value[is_star] for name, value in vars(stars).items()})
            snr, blended_xy, xy = snr[is_star], blended_xy[is_star], xy[is_star]
    flux = np.maximum(stars.weight, 0) / window_fraction
    subtracted = Subtracted(stars.xy, flux, psf)
    return _Deblended(stars, flux, snr, blended_xy, _without(light, subtracted, PIXELS_AT_ONCE), subtracted)


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
    def of(cls, background: Background, psf: PSF, stars: _Deblended) -> _Shapes:
        common = stars.centroids
        snr = np.minimum(common.weight / np.sqrt(common.weight_variance), stars.snr)
        rows = np.flatnonzero(snr > SHAPE_SNR)
        subtracted = Subtracted(stars.subtracted.xy[rows], stars.subtracted.flux[rows], psf)
        start = np.broadcast_to(psf.matrix, (len(rows), 2, 2))
        own_centroids, matrices = adaptive(stars.residual, background, common.xy[rows], start, subtracted)
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
    common = stars.centroids
    bright = (common.weight > 30 * np.sqrt(common.weight_variance)) & common.converged
    jacobian = np.median(common.jacobian[bright], axis=0) if bright.sum() >= 5 else _gaussian_jacobian(psf)
    xy, covariance = (
        common.xy.copy(),
        common.covariance(np.where(common.weight[:, None, None] > 0, jacobian, np.eye(2))),
    )
    flux, flux_err = stars.flux.copy(), np.sqrt(common.weight_variance) / psf.window_fraction()
    flags = _flags_near(frame, xy, psf.fwhm_px)
    matrices = np.full((len(xy), 2, 2), np.nan)
    cut = _cut(common.usable, psf.matrix)
    shapes = _Shapes.of(background, psf, stars)
    if len(shapes.rows):
        matrices[shapes.rows] = shapes.matrices
        wider, trailed = shapes.wider(psf, stars.snr, WIDER), shapes.trailed(psf, LONGER)
        own_shape = wider & (trailed | shapes.extended(psf, WIDER) | ((flags[shapes.rows] & Flag.SATURATED) != 0))
        rows = shapes.rows[own_shape]
        own = shapes.centroids
        xy[rows] = own.xy[own_shape]
        # Flat tops have singular Jacobians.
        covariance[rows] = own.covariance(_bounded(np.nan_to_num(symmetric(own.jacobian)), 0.15, 1.0))[own_shape]
        cut[rows] = _cut(own.usable, shapes.matrices)[own_shape]
        flux[rows] = 2 * own.weight[own_shape]
        flux_err[rows] = 2 * np.sqrt(own.weight_variance[own_shape])
        flags[rows] |= _flags_near(frame, xy[rows], 1.0, shapes.matrices[own_shape])
        flags[shapes.rows[own_shape & trailed]] |= np.uint16(Flag.TRAILED)
        # Longer, but not a trail: an unresolved pair, whose stars may both be off the centroid.
        unresolved = shapes.rows[wider & ~own_shape]
        flags[unresolved] |= np.uint16(Flag.BLENDED)
        covariance[unresolved] += PAIR_SHARE * (shapes.matrices[wider & ~own_shape] - psf.matrix)
    covariance = _with_systematic_errors(covariance + cut, stars, psf, flags, detection)  # also sets flags
    columns: dict[str, NDArray[Any]] = {
        "x_px": xy[:, 0], "y_px": xy[:, 1], "covariance": covariance[:, [0, 0, 1], [0, 1, 1]], "flux": flux,
        "flux_err": flux_err, "snr": stars.snr, "flags": flags, **_ellipses(matrices),
    }  # fmt: skip
    return _table(frame, background, psf, columns, (*_notes(frame, background, psf, LONGER), *gain_note))


def _cut(usable: FloatArray, matrices: FloatArray) -> FloatArray:
    """(n, 2, 2) covariances of the shifts of stars of matrices (n, 2, 2) or (2, 2) whose windows are partly usable."""
    return np.asarray((CUT_SHIFT * (1.0 - usable))[:, None, None] ** 2 * matrices)


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
    covariance = covariance + SHIFT_SHARE**2 * shift[:, :, None] * shift[:, None, :]
    floor = detection.floor_px**2 + psf.phase_error_px() ** 2
    saturated = (flags & Flag.SATURATED) != 0
    covariance = covariance + (floor + np.where(saturated, (0.03 * psf.fwhm_px) ** 2, 0.0))[:, None, None] * np.eye(2)
    covariance[~common.converged] = psf.matrix
    # An unresolved pair is wider along one axis only: the excess along the other may be negative.
    return _bounded(symmetric(covariance), floor + 1e-12, np.inf)


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
            f"noise of neighbouring pixels is correlated (by stars, if unresolved): variances of positions are "
            f"{shared:.1f} times larger"
        )
    return tuple(notes)


def _gaussian_jacobian(psf: PSF) -> FloatArray:
    """J / Σ w I of a Gaussian star."""
    window = psf.window()
    return np.asarray(
        np.eye(2) - np.linalg.inv(np.linalg.inv(psf.matrix) + np.linalg.inv(window)) @ np.linalg.inv(window)
    )


def _bounded(matrices: FloatArray, low: float, high: float) -> FloatArray:
    """Symmetric matrices (n, 2, 2) with eigenvalues limited to low … high."""
    values, vectors = np.linalg.eigh(matrices)
    return np.asarray((vectors * np.clip(values, low, high)[:, None, :]) @ vectors.transpose(0, 2, 1))


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

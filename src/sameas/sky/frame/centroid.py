"""Background, PSF and centroids of a frame: the sky, and windowed positions and shapes of many stars, with covariances.

Level and noise of the sky come from photutils (meshes of clipped pixels, mode as in SExtractor). Scanned plates and
resampled images have correlated noise; the correlation is measured here because it can make the variance of a centroid
several times larger than with independent pixels.

The windowed centroid c is the zero of the first moment in a Gaussian window (SExtractor's XWIN, YWIN):

    F(c) = Σ w(d) I d = 0,   d = x − c,   w = exp(−½ dᵀ S⁻¹ d).

With S the matrix of the star it is the maximum of the matched filter, as precise as fitting a Gaussian. Noise of
variance v per pixel shifts it by −F'⁻¹ δF, so its covariance is

    C = J⁻¹ N J⁻ᵀ,   N = Σ w² v d dᵀ,   J = −F' = Σ w I (1 − d dᵀ S⁻¹).

v includes the sky, with its correlation between pixels, and the star's photons. J is the mean over the frame's stars,
scaled to the flux of the star: an individual J would be as noisy as the position.

The point spread function (PSF) is the mean profile of the frame's stars. Its matrix of second moments (size, and
direction of a trail) defines the windows and the matched filter; a Moffat profile of this shape is subtracted for
neighbouring stars.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from sameas.arrays import BoolArray, FloatArray, IntArray, robust_scale
from sameas.errors import InputError, optional
from sameas.sky.frame.image import Frame, Image

# Parameters of the noise and of centroids, tuned on simulated frames (``scripts/bench centroids``).
NOISE_SIDE_PX = 600  # the noise correlation is measured in a square of this side in the middle of the frame
NOISE_REACH_PX = 4  # maximum offset along an axis for the noise correlation
STAR_SIGMAS = 3.5  # 3 × 3 means farther than this from the sky are stars, and excluded from the noise measurement
MIN_NOISE_PIXELS = 1000  # with fewer pixels the noise is assumed independent
MIN_CORRELATION = 0.02  # smaller correlations are set to zero, as noise of the estimate
STEPS = 25  # maximum number of iterations
CONVERGED_PX = 2e-4  # step length for convergence
STAMP_SIGMAS = 3.5  # half-width of a stamp in standard deviations of its window
MAX_WIDTH_PX = 48  # maximum half-width
PIXELS_AT_ONCE = 4_000_000  # pixels per batch of stamps, which bounds the memory
SHAPE_STEPS = 8  # iterations that adapt a window to the shape of its star


@dataclass(frozen=True)
class Background:
    """The sky of a frame.

    level : (rows, columns) the sky, in the unit of the frame.
    variance : (rows, columns) of a pixel without a star; infinite for unusable pixels.
    inverse_gain : units of the frame per electron: the variance added per unit of star light; 0 if not known, or if the
        frame has its own error plane. :mod:`sameas.sky.frame.photon_noise` measures it if the gain is not known.
    correlation : (2k + 1, 2k + 1) of the noise of two pixels by their offset, −k … k along both axes; 1 in the middle.
    """

    level: Image
    variance: Image
    inverse_gain: float
    correlation: FloatArray

    @classmethod
    def of(cls, frame: Frame, *, box_px: int = 64) -> Background:
        """The background of a frame; ``box_px`` should be about ten times the width of a star.

        Raises InputError: photutils is missing; hardly a pixel is usable.
        """
        level, rms = _meshes(frame, min(box_px, min(frame.shape) // 2))
        variance = rms**2 if frame.sigma is None else frame.sigma**2
        gain = frame.facts.gain_e_per_adu
        known = np.isfinite(gain) and gain > 0 and frame.sigma is None
        usable = ~frame.masked & (variance > 0) & np.isfinite(variance)
        if not usable.any():
            raise InputError(f"{frame.name}: the sky has no noise at all; the frame is empty or was clipped")
        middle = _middle(frame.shape)
        normal = (frame.image[middle] - level[middle]) / np.sqrt(np.where(usable[middle], variance[middle], 1))
        return cls(
            level.astype(np.float32),
            np.where(usable, variance, np.inf).astype(np.float32),
            1 / gain if known else 0.0,
            noise_correlation(np.where(usable[middle], normal, np.nan)),
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


#: A step of the sky from box to box above this many standard deviations is taken out before these are measured: it
#: widens the values of a box by a twelfth of its square (chosen: 5 % of the variance).
_STEEP_SIGMAS = 0.8
#: Maximum number of times that the slope is taken out (chosen).
_MOST_SLOPES = 4


def _meshes(frame: Frame, box_px: int) -> tuple[FloatArray, FloatArray]:
    """Level and standard deviation of the sky, (rows, columns) each."""
    level, rms = _mesh(frame.name, frame.image, frame.flags != 0, box_px)
    sky = interpolated(level, box_px, frame.shape)
    for _ in range(_MOST_SLOPES):
        # Boxes of a constant image, or of few photons, have no noise.
        steps = [np.abs(np.diff(level, axis=axis)) - _STEEP_SIGMAS * np.delete(rms, 0, axis=axis) for axis in (0, 1)]
        if not any(bool((step > 0.0).any()) for step in steps):
            break
        # The scatter in a box of a steep sky is mostly the slope, and its mode is not the sky in the middle.
        level, flat = _mesh(frame.name, frame.image - sky, frame.flags != 0, box_px)
        sky, rms = sky + interpolated(level, box_px, frame.shape), np.minimum(rms, flat)
    return sky, interpolated(rms, box_px, frame.shape)


def _mesh(name: str, image: Image | FloatArray, mask: BoolArray, box_px: int) -> tuple[FloatArray, FloatArray]:
    """Level and standard deviation of the sky in boxes."""
    with optional("finding stars on frames needs photutils", "frames"):
        from photutils.background import Background2D, SExtractorBackground, StdBackgroundRMS
    from astropy.stats import SigmaClip

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            sky = Background2D(
                image,
                box_px,
                mask=mask,
                exclude_percentile=80,
                sigma_clip=SigmaClip(3.0, maxiters=5),
                bkg_estimator=SExtractorBackground(),
                bkg_rms_estimator=StdBackgroundRMS(),
            )
            return np.asarray(sky.background_mesh, float), np.asarray(sky.background_rms_mesh, float)
    except ValueError as error:
        raise InputError(f"{name}: too few usable pixels for a background ({error})") from error


def interpolated(mesh: FloatArray, box_px: int, shape: tuple[int, int]) -> FloatArray:
    """(rows, columns) a mesh of boxes at every pixel, by bicubic splines, within the range of the mesh.

    That of photutils, one axis after the other, which takes less time.
    """
    from scipy.ndimage import zoom

    rows, columns = (
        zoom(np.eye(boxes), (box_px, 1), order=3, mode="reflect", grid_mode=True)[:length]
        for boxes, length in zip(mesh.shape, shape, strict=True)
    )
    return np.asarray(np.clip(rows @ mesh @ columns.T, mesh.min(), mesh.max()))


def _middle(shape: tuple[int, ...]) -> tuple[slice, ...]:
    """The middle of the frame, in which the noise correlation is measured."""
    half = NOISE_SIDE_PX // 2
    return tuple(slice(max(0, size // 2 - half), size // 2 + half) for size in shape)


def noise_correlation(normal: FloatArray) -> FloatArray:
    """The noise correlation at small offsets, from normalised pixels without stars."""
    reach = NOISE_REACH_PX
    independent = np.zeros((2 * reach + 1, 2 * reach + 1))
    independent[reach, reach] = 1
    part = normal[_middle(normal.shape)]
    from scipy.ndimage import maximum_filter, uniform_filter

    usable = np.isfinite(part)
    if not usable.any():
        return independent
    smooth = uniform_filter(np.nan_to_num(part), 3)
    # Masked pixels have no noise and are excluded from the scatter; stars are excluded with their surroundings.
    limit = STAR_SIGMAS * robust_scale(smooth[usable])
    bright = maximum_filter(np.abs(smooth) > limit, 9)
    sky = usable & ~bright
    if sky.sum() < MIN_NOISE_PIXELS:
        return independent
    values = np.where(sky, part - np.median(part[sky]), 0.0)
    size = [2 * n for n in part.shape]
    power = np.abs(np.fft.rfft2(values, size)) ** 2
    pairs = np.abs(np.fft.rfft2(sky.astype(float), size)) ** 2
    product, count = np.fft.irfft2(power, size), np.fft.irfft2(pairs, size)
    index = np.arange(-reach, reach + 1)
    covariance = product[np.ix_(index, index)] / np.maximum(count[np.ix_(index, index)], 1)
    rho = covariance / covariance[reach, reach]
    return np.where(np.abs(rho) < MIN_CORRELATION, 0.0, rho)


FWHM_PER_SIGMA = math.sqrt(8 * math.log(2))
#: Minimum standard deviation of the PSF: averaging over a pixel makes a star at least this wide.
_SMALLEST_SIGMA_PX = 0.5
#: Minimum standard deviation of a window: pixels do not sample a narrower Gaussian.
_FINEST_WINDOW_PX = 1.2
#: Approximate maximum number of pixels in the fit of the Moffat profile; more do not change it (timed).
_PIXELS_FITTED = 12_000


@dataclass(frozen=True)
class PSF:
    """The mean profile of a frame's stars.

    matrix : (2, 2) of the Gaussian core in px², including the average over a pixel. beta : exponent of the Moffat
    profile of the same full width at half maximum; infinite for a Gaussian.
    """

    matrix: FloatArray
    beta: float = 4.0

    @property
    def sigma_px(self) -> float:
        """Standard deviation of the circle of the same area."""
        return float(float(np.linalg.det(self.matrix)) ** 0.25)

    @property
    def fwhm_px(self) -> float:
        """Full width at half maximum of the circle of the same area."""
        return FWHM_PER_SIGMA * self.sigma_px

    def window(self) -> FloatArray:
        """(2, 2) matrix of the centroid window: that of the star, limited by the pixel size."""
        return (
            self.matrix
            if self.sigma_px >= _FINEST_WINDOW_PX
            else self.matrix * (_FINEST_WINDOW_PX / self.sigma_px) ** 2
        )

    def light(self, dx: Any, dy: Any) -> Any:
        """Fraction of a star's flux in pixels at (dx, dy) px from its centre."""
        xx, xy, yy, scale, norm, beta = self.terms().tolist()
        return norm * (1 + scale * (xx * dx**2 + 2 * xy * dx * dy + yy * dy**2)) ** -beta

    def terms(self) -> FloatArray:
        """(6,) inverse matrix xx, xy, yy, scale s, norm and β of norm · (1 + s r²)^−β."""
        inverse = np.linalg.inv(self.matrix)
        # Both profiles fall to half their peak at r² = 2 ln 2.
        scale = (2 ** (1 / self.beta) - 1) / (2 * math.log(2))
        norm = (self.beta - 1) * scale / (math.pi * math.sqrt(float(np.linalg.det(self.matrix))))
        return np.array([inverse[0, 0], inverse[0, 1], inverse[1, 1], scale, norm, self.beta])

    def window_fraction(self) -> float:
        """Fraction of a star's flux within its window, Σ w I over the flux."""
        inverse = np.linalg.inv(self.window())
        reach = np.arange(-60, 61) * max(self.sigma_px / 6, 0.1)
        dx, dy = np.meshgrid(reach, reach)
        w = np.exp(-0.5 * (inverse[0, 0] * dx**2 + 2 * inverse[0, 1] * dx * dy + inverse[1, 1] * dy**2))
        return float((w * self.light(dx, dy)).sum() * (reach[1] - reach[0]) ** 2)

    def phase_error_px(self) -> float:
        """Root mean square centroid error per axis by the subpixel position of the star.

        With coarse sampling Σ w I d does not vanish at the centre: 0.01 px at a FWHM of 1.5 px, nothing at 3.
        """
        inverse, phases = np.linalg.inv(self.window()), (np.arange(8) + 0.5) / 8 - 0.5
        reach = np.arange(-int(np.ceil(4 * math.sqrt(np.trace(self.window())))) - 1, 0)
        grid = np.concatenate([reach, [0], -reach[::-1]])
        sum_of_squares = 0.0
        for phase_x, phase_y in ((x, y) for x in phases for y in phases):
            dx, dy = np.meshgrid(grid - phase_x, grid - phase_y)
            w = np.exp(-0.5 * (inverse[0, 0] * dx**2 + 2 * inverse[0, 1] * dx * dy + inverse[1, 1] * dy**2))
            wi = w * self.light(dx, dy)
            first = np.array([(wi * dx).sum(), (wi * dy).sum()])
            second = np.array([[(wi * a * b).sum() for b in (dx, dy)] for a in (dx, dy)])
            error = np.linalg.solve(wi.sum() * np.eye(2) - second @ inverse, first)
            sum_of_squares += float(error @ error) / 2
        return math.sqrt(sum_of_squares / len(phases) ** 2)

    @classmethod
    def from_stars(cls, matrices: FloatArray, pixels: list[tuple[FloatArray, FloatArray, FloatArray]]) -> PSF:
        """The typical profile of the stars.

        matrices : (n, 2, 2) Gaussian fits. pixels : for each star (dx, dy, fraction of its flux).
        """
        areas = np.sqrt(np.linalg.det(matrices))
        typical = _mode(np.log(areas))
        rows = np.flatnonzero(np.abs(np.log(areas) - typical) < 0.35)
        matrix = _at_least(np.median(matrices[rows], axis=0), _SMALLEST_SIGMA_PX**2)
        chosen = [pixels[k] for k in rows]
        dx, dy, fraction = (np.concatenate([each[axis].ravel() for each in chosen]) for axis in range(3))
        factor, beta = _profile(matrix, dx, dy, fraction)
        return cls(matrix * factor, beta)


def _profile(matrix: FloatArray, dx: FloatArray, dy: FloatArray, fraction: FloatArray) -> tuple[float, float]:
    """Best-fitting factor of the matrix and exponent of the Moffat profile."""
    from scipy.optimize import least_squares

    inverse = np.linalg.inv(matrix)
    near = inverse[0, 0] * dx**2 + 2 * inverse[0, 1] * dx * dy + inverse[1, 1] * dy**2 < 20
    step = 1 + int(near.sum()) // _PIXELS_FITTED
    dx, dy, fraction = (each[near][::step] for each in (dx, dy, fraction))

    def misfit(values: FloatArray) -> FloatArray:
        model = PSF(matrix * math.exp(values[0]), math.exp(values[1]) + 1.2).light(dx, dy)
        return np.asarray((math.exp(values[2]) * model - fraction) * math.sqrt(float(np.linalg.det(matrix))))

    fit = least_squares(misfit, [0.0, 1.0, 0.0], loss="soft_l1", f_scale=0.01, bounds=([-1.5, -1, -1], [0.5, 3, 1]))
    return math.exp(fit.x[0]), math.exp(fit.x[1]) + 1.2


def _at_least(matrix: FloatArray, variance: float) -> FloatArray:
    values, vectors = np.linalg.eigh(matrix)
    return np.asarray((vectors * np.maximum(values, variance)) @ vectors.T)


def _mode(values: FloatArray) -> float:
    """Median of the shortest interval with half of the values."""
    ordered = np.sort(values)
    half = len(ordered) // 2
    if half < 2:
        return float(np.median(ordered))
    start = int(np.argmin(ordered[half:] - ordered[: len(ordered) - half]))
    return float(np.median(ordered[start : start + half + 1]))


class Stamps(NamedTuple):
    """Square cutouts of equal size.

    light : (n, k, k) above the sky, 0 where unusable. variance : (n, k, k) of the sky, 0 there. usable : (n, k, k).
    x, y : (n, 1, k), (n, k, 1) pixels of the frame. at_edge : (n,) mask.
    """

    light: FloatArray
    variance: FloatArray
    usable: FloatArray
    x: FloatArray
    y: FloatArray
    at_edge: BoolArray


@dataclass(frozen=True)
class Centroids:
    """Positions and moments, one row per star.

    xy : (n, 2) px. weight : (n,) Σ w I. weight_variance : (n,). jacobian : (n, 2, 2) J / Σ w I.
    moment_covariance : (n, 2, 2) N. moments : (n, 2, 2) second moments in the window.
    usable : (n,) usable fraction of the window. at_edge, converged : (n,) masks.
    """

    xy: FloatArray
    weight: FloatArray
    weight_variance: FloatArray
    jacobian: FloatArray
    moment_covariance: FloatArray
    moments: FloatArray
    usable: FloatArray
    at_edge: BoolArray
    converged: BoolArray

    def covariance(self, jacobian: FloatArray) -> FloatArray:
        """(n, 2, 2) of the positions in px²; ``jacobian`` (n, 2, 2) or (2, 2), J over Σ w I."""
        scaled = np.broadcast_to(jacobian, self.moment_covariance.shape) * self.weight[:, None, None]
        inverse = np.linalg.inv(scaled)
        return inverse @ self.moment_covariance @ inverse.transpose(0, 2, 1)


@dataclass(frozen=True)
class Subtracted:
    """The stars whose light was subtracted from the frame: positions (n, 2), fluxes (n,), profile."""

    xy: FloatArray
    flux: FloatArray
    psf: PSF

    def own_light(self) -> tuple[FloatArray, FloatArray]:
        """(n, 3) positions and fluxes, and (6,) the profile, as :func:`sameas.kernels.frames.windowed` takes them."""
        return np.column_stack([self.xy, self.flux]), self.psf.terms()

    def add_back(self, stamps: Stamps, rows: IntArray) -> Stamps:
        """The stamps of some stars with their own light added back; all other stars stay subtracted."""
        dx, dy = stamps.x - self.xy[rows, 0, None, None], stamps.y - self.xy[rows, 1, None, None]
        light = stamps.light + self.flux[rows, None, None] * self.psf.light(dx, dy) * stamps.usable
        return stamps._replace(light=light)


def centroids(
    light: Image | FloatArray,
    background: Background,
    xy: FloatArray,
    windows: FloatArray,
    subtracted: Subtracted | None = None,
) -> Centroids:
    """Windowed centroids near ``xy`` (n, 2) in windows (n, 2, 2).

    light : (rows, columns) above the sky. subtracted : the stars already subtracted from it, if any.
    """
    n = len(xy)
    largest = np.sqrt(np.linalg.eigvalsh(windows)[:, 1]) if n else np.empty(0)
    half = np.clip(np.ceil(STAMP_SIGMAS * largest).astype(int) + 1, 4, MAX_WIDTH_PX)
    # Half-widths are rounded up to a geometric series, so that stamps have few sizes.
    half = np.minimum(np.ceil(4 * 1.3 ** np.ceil(np.log(half / 4) / np.log(1.3))).astype(int), MAX_WIDTH_PX)
    from sameas.kernels.frames import windowed

    inverse = np.asarray(np.linalg.inv(windows), float).reshape(n, 4)[:, [0, 1, 3]]
    limit = np.sqrt(np.trace(windows, axis1=1, axis2=2))
    sums = windowed(
        light, background.variance, np.asarray(xy, float), inverse, half, limit,
        *((np.zeros((n, 3)), np.zeros(6)) if subtracted is None else subtracted.own_light()),
        background.inverse_gain, STEPS, CONVERGED_PX,
    )  # fmt: skip
    return _of_sums(sums, windows, inverse, background)


def cut_stamps(light: FloatArray, background: Background, centre: IntArray, half: int) -> Stamps:
    """Stamps of 2·half + 1 pixels around whole pixels (n, 2)."""
    rows, columns = light.shape
    reach = np.arange(-half, half + 1)
    x, y = centre[:, :1] + reach, centre[:, 1:] + reach
    inside = ((y >= 0) & (y < rows))[:, :, None] & ((x >= 0) & (x < columns))[:, None, :]
    take = np.clip(y, 0, rows - 1)[:, :, None], np.clip(x, 0, columns - 1)[:, None, :]
    variance = background.variance[take].astype(float)
    usable = inside & np.isfinite(variance)
    return Stamps(
        np.where(usable, light[take], 0.0),
        np.where(usable, variance, 0.0),
        usable.astype(float),
        x[:, None, :].astype(float),
        y[:, :, None].astype(float),
        ~inside.all(axis=(1, 2)),
    )


def _of_sums(sums: FloatArray, windows: FloatArray, inverse: FloatArray, background: Background) -> Centroids:
    """The centroids of the sums over their windows, with their covariances."""
    from sameas.kernels import frames

    total = sums[:, frames.WEIGHT]
    safe = np.where(np.abs(total) > 0, total, 1.0)
    moments = _matrices(sums, frames.MOMENTS) / safe[:, None, None]
    jacobian = np.eye(2) - moments @ inverse[:, [[0, 1], [1, 2]]]
    # Photon noise from the observed light: its sum over a window is hardly noisy.
    flux_factor, centroid_factor = background.factor(np.linalg.det(windows) ** 0.25)
    photon_covariance = _matrices(sums, frames.PHOTONS)
    moment_covariance = _matrices(sums, frames.SKY) * centroid_factor[:, None, None] + np.where(
        (np.linalg.eigvalsh(photon_covariance)[:, 0] > 0)[:, None, None], photon_covariance, 0.0
    )
    return Centroids(
        xy=sums[:, [frames.X, frames.Y]],
        weight=total,
        weight_variance=sums[:, frames.SKY_SUM] * flux_factor + np.maximum(sums[:, frames.PHOTON_SUM], 0.0),
        jacobian=jacobian,
        moment_covariance=moment_covariance,
        moments=moments,
        usable=sums[:, frames.USABLE] / sums[:, frames.WHOLE],
        at_edge=sums[:, frames.AT_EDGE] > 0,
        converged=sums[:, frames.CONVERGED] > 0,
    )


def _matrices(sums: FloatArray, first: int) -> FloatArray:
    """(n, 2, 2) of three columns xx, xy, yy."""
    return sums[:, [[first, first + 1], [first + 1, first + 2]]]


def adaptive(
    light: FloatArray, background: Background, xy: FloatArray, start: FloatArray, subtracted: Subtracted | None = None
) -> tuple[Centroids, FloatArray]:
    """Centroids in windows adapted to the shape of each star, and the window matrices (n, 2, 2).

    A Gaussian of matrix P has moments (P⁻¹ + S⁻¹)⁻¹ in a window S: P is solved for and becomes the next window
    (Bernstein & Jarvis 2002, AJ 123, 583, sect. 3.1).
    """
    windows = start.copy()
    measured = centroids(light, background, xy, windows, subtracted)
    for _ in range(SHAPE_STEPS):
        with np.errstate(all="ignore"):
            values, vectors = np.linalg.eigh(np.nan_to_num(measured.moments, posinf=1.0, neginf=1.0))
        values = np.clip(values, 0.05, None)
        moments = (vectors * values[:, None, :]) @ vectors.transpose(0, 2, 1)
        inverse = np.linalg.inv(moments) - np.linalg.inv(windows)
        values, vectors = np.linalg.eigh(inverse)
        old = np.linalg.eigvalsh(windows)
        low, high = 1 / (2.5 * old[:, 1:]), 1 / (0.4 * old[:, :1])
        values = np.clip(values, np.maximum(low, 1 / (MAX_WIDTH_PX / 3) ** 2), np.minimum(high, 1 / 0.2))
        windows = (vectors / values[:, None, :]) @ vectors.transpose(0, 2, 1)
        measured = centroids(light, background, measured.xy, windows, subtracted)
    return measured, windows

"""Centroids: windowed positions, shapes and covariances of many stars at once, and the profile that stars have (PSF).

The windowed centroid c is where the first moment in a Gaussian window vanishes (SExtractor's XWIN, YWIN):

    F(c) = Σ w(d) I d = 0,   d = x − c,   w = exp(−½ dᵀ S⁻¹ d).

With S the matrix of the star it is the maximum of the matched filter, hence as good as fitting a Gaussian. Noise
of variance v per pixel moves it by −F'⁻¹ δF, so that

    C = J⁻¹ N J⁻ᵀ,   N = Σ w² v d dᵀ,   J = −F' = Σ w I (1 − d dᵀ S⁻¹).

v is the sky's, its correlation between pixels included, and the star's own photons. J is that of the mean star of
the frame, scaled to the light of this one: its own would be as noisy as its position.

The point spread function (PSF) is the mean profile of a frame's stars, measured on the frame itself. A matrix of second
moments (the size, and where the frame is trailed its direction) sets the windows and the matched filter; a Moffat
profile of that shape stands for the light of a neighbour that is to be taken away.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.sky.frame.background import Background
from sameas.sky.frame.measurements import TUNING, DetectionTuning

FWHM_PER_SIGMA = math.sqrt(8 * math.log(2))
#: Standard deviation of the narrowest PSF: a star within one pixel, averaged over it, is not narrower.
_SMALLEST_SIGMA_PX = 0.5
#: Standard deviation of the narrowest window: whole pixels do not sample a narrower Gaussian.
_FINEST_WINDOW_PX = 1.2
#: The Moffat profile is fitted to at most about this many pixels; more change nothing (timed).
_PIXELS_FITTED = 12_000


@dataclass(frozen=True)
class PSF:
    """The mean star.

    matrix : (2, 2) of its Gaussian core in px², averaging over the pixel included. beta : exponent of the Moffat
    profile of the same full width at half maximum; it is infinite for a Gaussian.
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
        """(2, 2) matrix of the window of centroids: the star's, but never finer than the pixels can carry."""
        return (
            self.matrix
            if self.sigma_px >= _FINEST_WINDOW_PX
            else self.matrix * (_FINEST_WINDOW_PX / self.sigma_px) ** 2
        )

    def light(self, dx: Any, dy: Any) -> Any:
        """Share of a star's light in pixels at (dx, dy) px from its centre."""
        inverse = np.linalg.inv(self.matrix)
        r2 = inverse[0, 0] * dx**2 + 2 * inverse[0, 1] * dx * dy + inverse[1, 1] * dy**2
        # Both profiles fall to half their peak at r² = 2 ln 2.
        scale = (2 ** (1 / self.beta) - 1) / (2 * math.log(2))
        norm = (self.beta - 1) * scale / (math.pi * math.sqrt(float(np.linalg.det(self.matrix))))
        return norm * (1 + scale * r2) ** -self.beta

    def collected(self) -> float:
        """Share of a star's light that its window collects, Σ w I over the flux."""
        inverse = np.linalg.inv(self.window())
        reach = np.arange(-60, 61) * max(self.sigma_px / 6, 0.1)
        dx, dy = np.meshgrid(reach, reach)
        w = np.exp(-0.5 * (inverse[0, 0] * dx**2 + 2 * inverse[0, 1] * dx * dy + inverse[1, 1] * dy**2))
        return float((w * self.light(dx, dy)).sum() * (reach[1] - reach[0]) ** 2)

    def phase_error_px(self) -> float:
        """Root mean square error along an axis of a centroid, by the place of the star within its pixel.

        Where pixels are wide, Σ w I d does not vanish at the centre: 0.01 px at a full width of 1.5 px, nothing at 3.
        """
        inverse, phases = np.linalg.inv(self.window()), (np.arange(8) + 0.5) / 8 - 0.5
        reach = np.arange(-int(np.ceil(4 * math.sqrt(np.trace(self.window())))) - 1, 0)
        grid = np.concatenate([reach, [0], -reach[::-1]])
        square = 0.0
        for phase_x, phase_y in ((x, y) for x in phases for y in phases):
            dx, dy = np.meshgrid(grid - phase_x, grid - phase_y)
            w = np.exp(-0.5 * (inverse[0, 0] * dx**2 + 2 * inverse[0, 1] * dx * dy + inverse[1, 1] * dy**2))
            wi = w * self.light(dx, dy)
            first = np.array([(wi * dx).sum(), (wi * dy).sum()])
            second = np.array([[(wi * a * b).sum() for b in (dx, dy)] for a in (dx, dy)])
            off = np.linalg.solve(wi.sum() * np.eye(2) - second @ inverse, first)
            square += float(off @ off) / 2
        return math.sqrt(square / len(phases) ** 2)

    @classmethod
    def from_stars(cls, matrices: FloatArray, pixels: list[tuple[FloatArray, FloatArray, FloatArray]]) -> PSF:
        """The profile of most of the stars.

        matrices : (n, 2, 2) of the Gaussians that fit them. pixels : of each star (dx, dy, share of its light).
        """
        areas = np.sqrt(np.linalg.det(matrices))
        usual = _mode(np.log(areas))
        near = np.flatnonzero(np.abs(np.log(areas) - usual) < 0.35)
        matrix = _at_least(np.median(matrices[near], axis=0), _SMALLEST_SIGMA_PX**2)
        chosen = [pixels[k] for k in near]
        dx, dy, share = (np.concatenate([each[axis].ravel() for each in chosen]) for axis in range(3))
        narrower, beta = _profile(matrix, dx, dy, share)
        return cls(matrix * narrower, beta)


def _profile(matrix: FloatArray, dx: FloatArray, dy: FloatArray, share: FloatArray) -> tuple[float, float]:
    """Factor of the matrix and exponent of the Moffat profile that fit the pixels best."""
    from scipy.optimize import least_squares

    inverse = np.linalg.inv(matrix)
    near = inverse[0, 0] * dx**2 + 2 * inverse[0, 1] * dx * dy + inverse[1, 1] * dy**2 < 20
    step = 1 + int(near.sum()) // _PIXELS_FITTED
    dx, dy, share = (each[near][::step] for each in (dx, dy, share))

    def misfit(values: FloatArray) -> FloatArray:
        model = PSF(matrix * math.exp(values[0]), math.exp(values[1]) + 1.2).light(dx, dy)
        return np.asarray((math.exp(values[2]) * model - share) * math.sqrt(float(np.linalg.det(matrix))))

    fit = least_squares(misfit, [0.0, 1.0, 0.0], loss="soft_l1", f_scale=0.01, bounds=([-1.5, -1, -1], [0.5, 3, 1]))
    return math.exp(fit.x[0]), math.exp(fit.x[1]) + 1.2


def _at_least(matrix: FloatArray, variance: float) -> FloatArray:
    values, vectors = np.linalg.eigh(matrix)
    return np.asarray((vectors * np.maximum(values, variance)) @ vectors.T)


def _mode(values: FloatArray) -> float:
    """Middle of the shortest interval that holds half of the values."""
    ordered = np.sort(values)
    half = len(ordered) // 2
    if half < 2:
        return float(np.median(ordered))
    start = int(np.argmin(ordered[half:] - ordered[: len(ordered) - half]))
    return float(np.median(ordered[start : start + half + 1]))


class Stamps(NamedTuple):
    """Square cuts of one size. light : (n, k, k) above the sky, 0 where not usable. variance : (n, k, k) of the sky,
    0 there. usable : (n, k, k). x, y : (n, 1, k), (n, k, 1) pixels of the frame. at_edge : (n,)."""

    light: FloatArray
    variance: FloatArray
    usable: FloatArray
    x: FloatArray
    y: FloatArray
    at_edge: BoolArray


@dataclass(frozen=True)
class Centroids:
    """Positions and moments, one row a star.

    xy : (n, 2) px. weight : (n,) Σ w I. weight_variance : (n,). jacobian : (n, 2, 2) J / Σ w I.
    moment_covariance : (n, 2, 2) N. moments : (n, 2, 2) second moments in the window.
    wide : (n,) Σ w' I in a window of twice the matrix. usable : (n,) share of the window that is usable.
    at_edge, settled : (n,) masks.
    """

    xy: FloatArray
    weight: FloatArray
    weight_variance: FloatArray
    jacobian: FloatArray
    moment_covariance: FloatArray
    moments: FloatArray
    wide: FloatArray
    usable: FloatArray
    at_edge: BoolArray
    settled: BoolArray

    def covariance(self, jacobian: FloatArray) -> FloatArray:
        """(n, 2, 2) of the positions in px²; ``jacobian`` (n, 2, 2) or (2, 2), J over Σ w I."""
        scaled = np.broadcast_to(jacobian, self.moment_covariance.shape) * self.weight[:, None, None]
        inverse = np.linalg.inv(scaled)
        return inverse @ self.moment_covariance @ inverse.transpose(0, 2, 1)


@dataclass(frozen=True)
class Own:
    """The light of the stars themselves where it was taken off the frame: positions (n, 2), fluxes (n,), profile."""

    xy: FloatArray
    flux: FloatArray
    psf: PSF

    def back(self, stamps: Stamps, rows: IntArray) -> Stamps:
        """The stamps of some stars with their own light put back: what is left out is that of all others."""
        dx, dy = stamps.x - self.xy[rows, 0, None, None], stamps.y - self.xy[rows, 1, None, None]
        light = stamps.light + self.flux[rows, None, None] * self.psf.light(dx, dy) * stamps.usable
        return stamps._replace(light=light)


def centroids(
    light: FloatArray,
    background: Background,
    xy: FloatArray,
    windows: FloatArray,
    own: Own | None = None,
    tuning: DetectionTuning = TUNING,
) -> Centroids:
    """Windowed centroids near ``xy`` (n, 2) in windows (n, 2, 2).

    light : (rows, columns) above the sky; with ``own``, that of the stars was taken away from it.
    """
    n = len(xy)
    largest = np.sqrt(np.linalg.eigvalsh(windows)[:, 1]) if n else np.empty(0)
    half = np.clip(np.ceil(tuning.stamp_sigmas * largest).astype(int) + 1, 4, tuning.widest_px)
    # Stamps have a few sizes only: the half-width is rounded up to the next of a geometric series.
    half = np.minimum(np.ceil(4 * 1.3 ** np.ceil(np.log(half / 4) / np.log(1.3))).astype(int), tuning.widest_px)
    parts: list[tuple[IntArray, Centroids]] = []
    for size in np.unique(half):
        members = np.flatnonzero(half == size)
        step = max(1, tuning.pixels_at_once // (2 * size + 1) ** 2)
        for first in range(0, len(members), step):
            rows = members[first : first + step]
            stamps = cut(light, background, np.rint(xy[rows]).astype(int), int(size))
            stamps = stamps if own is None else own.back(stamps, rows)
            parts.append((rows, settle(stamps, xy[rows], windows[rows], background, tuning)))
    return _together(n, parts)


def cut(light: FloatArray, background: Background, centre: IntArray, half: int) -> Stamps:
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


def settle(
    stamps: Stamps, start: FloatArray, windows: FloatArray, background: Background, tuning: DetectionTuning
) -> Centroids:
    """The centroids of stamps, from a start (n, 2): x ← x + 2 Σ w I d / Σ w I until a step is short enough."""
    inverse = np.asarray(np.linalg.inv(windows), float)
    limit = np.sqrt(np.trace(windows, axis1=1, axis2=2))[:, None]
    reach = 0.5 + 0.8 * limit  # a centroid farther off has slid onto another star
    xy, moving = start.copy(), np.arange(len(start))
    settled = np.zeros(len(start), bool)
    for _ in range(tuning.centroid_steps):
        part = Stamps(*(plane[moving] for plane in stamps))  # type: ignore[arg-type]
        dx, dy, w = _window(part, xy[moving], inverse[moving])
        wi = w * part.light
        total = wi.sum((1, 2))
        first = np.stack([(wi * dx).sum((1, 2)), (wi * dy).sum((1, 2))], axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            step = 2 * first / total[:, None]
        good = np.isfinite(step).all(axis=1) & (total > 0)
        step = np.where(good[:, None], np.clip(step, -0.5 * limit[moving], 0.5 * limit[moving]), 0.0)
        xy[moving] += step
        still = (np.abs(step) < tuning.settled_px).all(axis=1)
        astray = (np.abs(xy[moving] - start[moving]) > reach[moving]).any(axis=1)
        settled[moving[still & good]] = True
        moving = moving[~still & ~astray]
        if not len(moving):
            break
    astray = (np.abs(xy - start) > reach).any(axis=1)
    xy = np.where(astray[:, None], start, xy)
    return _measured(stamps, xy, windows, inverse, settled & ~astray, background)


def _window(stamps: Stamps, xy: FloatArray, inverse: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    dx, dy = stamps.x - xy[:, 0, None, None], stamps.y - xy[:, 1, None, None]
    a, b, c = (inverse[:, i, j, None, None] for i, j in ((0, 0), (0, 1), (1, 1)))
    return dx, dy, np.exp(-0.5 * (a * dx**2 + 2 * b * dx * dy + c * dy**2))


def _measured(
    stamps: Stamps,
    xy: FloatArray,
    windows: FloatArray,
    inverse: FloatArray,
    settled: BoolArray,
    background: Background,
) -> Centroids:
    dx, dy, w = _window(stamps, xy, inverse)
    wi = w * stamps.light
    total = wi.sum((1, 2))
    safe = np.where(np.abs(total) > 0, total, 1.0)
    moments = _matrix(wi, dx, dy) / safe[:, None, None]
    jacobian = np.eye(2) - moments @ inverse
    # The star's photons add in proportion to its light, as observed: the sum over a window is hardly noisy.
    flux_factor, centroid_factor = background.factor(np.linalg.det(windows) ** 0.25)
    sky = w**2 * stamps.variance
    own = w**2 * stamps.light * background.inverse_gain
    noise = _matrix(sky, dx, dy) * centroid_factor[:, None, None]
    photons = _matrix(own, dx, dy)
    noise = noise + np.where((np.linalg.eigvalsh(photons)[:, 0] > 0)[:, None, None], photons, 0.0)
    variance = sky.sum((1, 2)) * flux_factor + np.maximum(own.sum((1, 2)), 0.0)
    wide = np.sqrt(w)
    return Centroids(
        xy=xy,
        weight=total,
        weight_variance=variance,
        jacobian=jacobian,
        moment_covariance=noise,
        moments=moments,
        wide=(wide * stamps.light).sum((1, 2)),
        usable=(w**2 * stamps.usable).sum((1, 2)) / (w**2).sum((1, 2)),
        at_edge=stamps.at_edge,
        settled=settled,
    )


def _matrix(weights: FloatArray, dx: FloatArray, dy: FloatArray) -> FloatArray:
    """(n, 2, 2) Σ weights d dᵀ."""
    xx, xy, yy = ((weights * product).sum((1, 2)) for product in (dx * dx, dx * dy, dy * dy))
    return np.stack([np.stack([xx, xy], -1), np.stack([xy, yy], -1)], -2)


def _together(n: int, parts: list[tuple[IntArray, Centroids]]) -> Centroids:
    shapes = {"xy": (n, 2), "jacobian": (n, 2, 2), "moment_covariance": (n, 2, 2), "moments": (n, 2, 2)}
    kinds = {"at_edge": bool, "settled": bool}
    names = Centroids.__dataclass_fields__
    whole = {name: np.zeros(shapes.get(name, (n,)), kinds.get(name, float)) for name in names}
    for rows, part in parts:
        for name in names:
            whole[name][rows] = getattr(part, name)
    return Centroids(**whole)


def adaptive(
    light: FloatArray,
    background: Background,
    xy: FloatArray,
    start: FloatArray,
    own: Own | None = None,
    tuning: DetectionTuning = TUNING,
) -> tuple[Centroids, FloatArray]:
    """Centroids in windows that take the shape of each star, and these matrices (n, 2, 2).

    A Gaussian of matrix P shows (P⁻¹ + S⁻¹)⁻¹ in a window S: P is solved for and becomes the next window
    (Bernstein & Jarvis 2002, AJ 123, 583, sect. 3.1).
    """
    windows = start.copy()
    measured = centroids(light, background, xy, windows, own, tuning)
    for _ in range(tuning.shape_steps):
        with np.errstate(all="ignore"):
            values, vectors = np.linalg.eigh(np.nan_to_num(measured.moments, posinf=1.0, neginf=1.0))
        values = np.clip(values, 0.05, None)
        moments = (vectors * values[:, None, :]) @ vectors.transpose(0, 2, 1)
        inverse = np.linalg.inv(moments) - np.linalg.inv(windows)
        values, vectors = np.linalg.eigh(inverse)
        old = np.linalg.eigvalsh(windows)
        low, high = 1 / (2.5 * old[:, 1:]), 1 / (0.4 * old[:, :1])
        values = np.clip(values, np.maximum(low, 1 / (tuning.widest_px / 3) ** 2), np.minimum(high, 1 / 0.2))
        windows = (vectors / values[:, None, :]) @ vectors.transpose(0, 2, 1)
        measured = centroids(light, background, measured.xy, windows, own, tuning)
    return measured, windows

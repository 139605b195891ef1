"""The point spread function (PSF): the mean profile of a frame's stars, measured on the frame itself.

A matrix of second moments (the size, and where the frame is trailed its direction) sets the windows and the matched
filter; a Moffat profile of that shape stands for the light of a neighbour that is to be taken away.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from sameas.arrays import FloatArray

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

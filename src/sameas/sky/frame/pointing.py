"""Pointing: the linear map between the pixels of a frame and the tangent plane of the sky.

Directions are unit vectors (n, 3), so that poles and 0°/360° are no special cases. On the plane ξ points east and η
north, in radians: ξ = (v·east)/(v·centre), η = (v·north)/(v·centre). Pixels are 0-based; (0, 0) is the centre of the
first.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from sameas.arrays import BoolArray, FloatArray
from sameas.representation import in_short
from sameas.space import ARCSEC_PER_RADIAN, directions_deg, from_plane, to_plane, unit_vectors

if TYPE_CHECKING:
    from astropy.wcs import WCS


@in_short
@dataclass(frozen=True)
class Pointing:
    """A linear map between pixels and a tangent plane: (ξ, η) = cd · (x − origin_px).

    Attributes
    ----------
    centre : (3,) direction of the tangent point.
    cd : (2, 2) radians per pixel. origin_px : (2,) the pixel of ``centre``.
    """

    centre: FloatArray
    cd: FloatArray
    origin_px: FloatArray

    def to_px(self, vectors: FloatArray) -> FloatArray:
        """(n, 2) pixels of directions; NaN at 90° or more from the centre."""
        return self.origin_px + to_plane(vectors, self.centre) @ np.linalg.inv(self.cd).T

    def to_sky(self, px: FloatArray) -> FloatArray:
        """(n, 3) directions of pixels."""
        return from_plane((px - self.origin_px) @ self.cd.T, self.centre)

    def moved(self, step: FloatArray) -> Pointing:
        """The pointing whose predictions are x′ = x + D(x) step, with the columns of :func:`design`."""
        growth, rotation, stretch, shear = step[2:]
        linear = np.array([[1 + growth + stretch, shear - rotation], [shear + rotation, 1 + growth - stretch]])
        return replace(self, cd=self.cd @ np.linalg.inv(linear), origin_px=self.origin_px + step[:2])

    @property
    def scale_arcsec(self) -> float:
        """The scale, arcsec per pixel: the root of the area of a pixel."""
        return math.sqrt(abs(np.linalg.det(self.cd))) * ARCSEC_PER_RADIAN

    @property
    def rotation_deg(self) -> float:
        """The direction of the frame's y axis, degrees from north through east, 0 … 360."""
        return math.degrees(math.atan2(self.cd[0, 1], self.cd[1, 1])) % 360.0

    @property
    def parity(self) -> int:
        """The sign of |cd|: −1 for the sky as seen from inside, +1 if mirrored."""
        return 1 if np.linalg.det(self.cd) > 0 else -1

    def to_wcs(self, shape: tuple[int, int] | None = None) -> WCS:
        """The pointing as an astropy WCS (TAN, ICRS). shape : (rows, columns) of the frame."""
        from astropy.wcs import WCS

        wcs = WCS(naxis=2)
        ra, dec = directions_deg(self.centre)
        wcs.wcs.ctype, wcs.wcs.cunit, wcs.wcs.radesys = ["RA---TAN", "DEC--TAN"], ["deg", "deg"], "ICRS"
        wcs.wcs.crval, wcs.wcs.crpix = [float(ra), float(dec)], list(self.origin_px + 1.0)
        wcs.wcs.cd = np.degrees(self.cd)
        wcs.wcs.set()
        if shape is not None:
            wcs.array_shape = shape
        return wcs

    @classmethod
    def of_wcs(cls, wcs: WCS, shape: tuple[int, int]) -> Pointing:
        """The linear least-squares fit to an astropy WCS over a frame of ``shape`` (rows, columns)."""
        rows, columns = shape
        middle = np.array([(columns - 1) / 2.0, (rows - 1) / 2.0])
        x, y = np.meshgrid(np.linspace(0, columns - 1, 9), np.linspace(0, rows - 1, 9))
        grid = np.column_stack([x.ravel(), y.ravel()])
        centre = sky_of(wcs, middle[None])[0]
        plane = to_plane(sky_of(wcs, grid), centre)
        fit = np.linalg.lstsq(np.column_stack([np.ones(len(grid)), grid - middle]), plane, rcond=None)[0]
        cd = fit[1:].T
        return cls(centre, cd, middle - np.linalg.solve(cd, fit[0]))


def sky_of(wcs: WCS, px: FloatArray) -> FloatArray:
    """(n, 3) directions of 0-based pixels (n, 2) by a celestial astropy WCS, with its distortion."""
    world = wcs.celestial if wcs.naxis > 2 else wcs
    sky = world.pixel_to_world(px[:, 0], px[:, 1]).icrs
    return unit_vectors(sky.ra.deg, sky.dec.deg)


def design(offset_px: FloatArray) -> FloatArray:
    """(n, 2, 6) derivatives of points ``offset_px`` (n, 2) by shift in x and y, growth, rotation, stretch and shear."""
    x, y = offset_px.T
    one, zero = np.ones_like(x), np.zeros_like(x)
    return np.stack([np.stack([one, zero, x, -y, x, y], axis=-1), np.stack([zero, one, y, x, -y, x], axis=-1)], axis=-2)


def similarities(
    px: FloatArray, vectors: FloatArray, mirrored: BoolArray, origin_px: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Least-squares similarity transforms of c sets of k pixels (c, k, 2) to k directions (c, k, 3).

    mirrored : (c,) whether x points east when y points north. Returns the directions of ``origin_px`` (c, 3) and the
    matrices cd (c, 2, 2) on the tangent planes there.
    """
    # Unless mirrored, x points west: the offset becomes (−x) + iy before it is compared with ξ + iη.
    sign = np.where(mirrored, 1.0, -1.0)[:, None]
    offset = sign * (px[..., 0] - origin_px[0]) + 1j * (px[..., 1] - origin_px[1])
    centre = vectors.sum(axis=1)
    centre /= np.linalg.norm(centre, axis=1, keepdims=True)
    # Each iteration fits on the tangent plane at the previous estimate of the middle of the frame.
    for _ in range(3):
        plane = to_plane(vectors, centre[:, None, :])
        offset_mean, sky = offset.mean(axis=1, keepdims=True), plane[..., 0] + 1j * plane[..., 1]
        sky_mean, spread = sky.mean(axis=1, keepdims=True), np.abs(offset - offset_mean) ** 2
        factor = np.sum(np.conj(offset - offset_mean) * (sky - sky_mean), axis=1) / np.sum(spread, axis=1)
        origin = sky_mean[:, 0] - factor * offset_mean[:, 0]
        centre = from_plane(np.stack([origin.real, origin.imag], axis=-1), centre)
    sign = sign[:, 0]
    cd = np.stack(
        [np.stack([sign * factor.real, -factor.imag], axis=-1), np.stack([sign * factor.imag, factor.real], axis=-1)],
        axis=-2,
    )
    return centre, cd

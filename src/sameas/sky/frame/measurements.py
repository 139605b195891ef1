"""Measurements: position, light and shape of every star on a frame, each with its error.

Pixels are counted from 0 and integers are pixel centres, as in NumPy: the lower left pixel extends from −0.5 to 0.5.
FITS headers, DS9 and SExtractor count from 1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import IntFlag
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.records import Records
from sameas.representation import in_short

if TYPE_CHECKING:
    from astropy.table import Table


class Flag(IntFlag):
    """Quality flags of a measurement; the first four also flag single pixels of a frame."""

    SATURATED = 1  # has pixels at the limit of the detector
    HOT = 2  # is, or covers, a hot pixel
    COSMIC = 4  # is, or covers, a cosmic ray hit
    MASKED = 8  # has unusable pixels: not a number, marked bad, a dead column
    EDGE = 16  # the window extends beyond the frame
    BLENDED = 32  # the light of a neighbour was subtracted
    TRAILED = 64  # longer than the stars of the frame
    POOR = 128  # the centroid did not converge; the position is the brightest pixel of the smoothed frame

    @classmethod
    def words(cls, bits: int) -> str:
        """The names of the bits that are set, "saturated, edge"; empty for none."""
        return ", ".join(str(flag.name).lower() for flag in cls if int(flag) & int(bits))


#: Magnitudes per unit of ln flux (Pogson 1856): times the relative error of a flux, the error of its magnitude.
POGSON = 2.5 / math.log(10.0)

PIXEL_FLAGS = Flag.SATURATED | Flag.HOT | Flag.COSMIC | Flag.MASKED


@in_short
@dataclass(frozen=True)
class Measurements:
    """The detections of one frame, brightest first.

    x_px, y_px : (n,) windowed centroids, 0-based, integers at pixel centres.
    covariance : (n, 3) of the centroid in px²: xx, xy, yy.
    flux, flux_err : (n,) in the unit of the frame (ADU of the calibrated frame): the total light of a star with
        the mean profile of the frame, and its standard deviation.
    background : (n,) level of the sky at the star, the same unit per pixel.
    a_px, b_px, theta_deg : (n,) standard deviations of the light along the long and short axis, and the angle of the
        long axis from +x to +y; NaN where too faint.
    fwhm_px : (n,) full width at half maximum of the circle of the same area; NaN likewise.
    snr : (n,) peak of the matched filter over its noise: the significance of the detection.
    peak : (n,) value of the central pixel above the sky.
    flags : (n,) bits of :class:`Flag`.
    shape : (rows, columns) of the frame.
    psf_fwhm_px : full width at half maximum of the frame's stars.
    name : of the frame.
    notes : assumptions and doubts, as text.
    blind : (rows, columns) mask where no star can be measured because most pixels are unusable; None without one.
    """

    x_px: FloatArray
    y_px: FloatArray
    covariance: FloatArray
    flux: FloatArray
    flux_err: FloatArray
    background: FloatArray
    a_px: FloatArray
    b_px: FloatArray
    theta_deg: FloatArray
    fwhm_px: FloatArray
    snr: FloatArray
    peak: FloatArray
    flags: NDArray[np.uint16]
    shape: tuple[int, int]
    psf_fwhm_px: float
    name: str = "frame"
    notes: tuple[str, ...] = ()
    blind: BoolArray | None = None

    def __len__(self) -> int:
        return len(self.x_px)

    def __getitem__(self, rows: slice | IntArray | BoolArray) -> Measurements:
        """Some of the measurements."""
        columns = {key: value[rows] for key, value in vars(self).items() if _per_row(key, value)}
        return replace(self, **columns)

    def clean(self, but: Flag) -> BoolArray:
        """(n,) mask of the measurements without flags other than ``but``."""
        return np.asarray((self.flags & ~np.uint16(but)) == 0)

    def sigma_px(self) -> FloatArray:
        """(n, 2) standard deviations along x and y."""
        return np.sqrt(self.covariance[:, [0, 2]])

    def records(self) -> Records:
        """The positions in pixels as records in the plane of the frame."""
        xy = np.column_stack([self.x_px, self.y_px])
        xx, cross, yy = self.covariance.T
        full = np.stack([np.stack([xx, cross], -1), np.stack([cross, yy], -1)], -2)
        return Records.of(xy, covariance=full, source=self.name)

    def table(self) -> Table:
        """A table with one row per measurement, with units; flags also as text."""
        from astropy.table import QTable

        units = {"x_px": "pix", "y_px": "pix", "a_px": "pix", "b_px": "pix", "fwhm_px": "pix", "theta_deg": "deg"}
        columns: dict[str, Any] = {key: value for key, value in vars(self).items() if _per_row(key, value)}
        xx, cross, yy = columns.pop("covariance").T
        table = QTable(columns, units={key: unit for key, unit in units.items() if key in columns})
        table.add_columns([xx, cross, yy], indexes=[2, 2, 2], names=["cov_xx_px2", "cov_xy_px2", "cov_yy_px2"])
        table["remarks"] = np.array([Flag.words(bits) for bits in self.flags], dtype=str)
        table.meta.update(name=self.name, psf_fwhm_px=self.psf_fwhm_px, notes=list(self.notes))
        return table


def _per_row(key: str, value: object) -> bool:
    return isinstance(value, np.ndarray) and key != "blind"

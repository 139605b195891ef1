"""Measurements: position, light and shape of every star on a frame, each with its error.

Pixels are counted from 0 and a whole number is the middle of a pixel, as in NumPy: the lower left pixel reaches
from −0.5 to 0.5. FITS headers, DS9 and SExtractor count from 1.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import IntFlag
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.errors import InputError
from sameas.records import Records
from sameas.representation import in_short

if TYPE_CHECKING:
    from astropy.table import Table

# How stars are looked for on a frame: what a user chooses (:class:`Detection`), and what was tuned once for all.


@dataclass(frozen=True)
class DetectionTuning:
    """Numbers of the detection of stars, chosen on simulated frames (``scripts/bench centroids`` and ``crowded``).

    Attributes
    ----------
    noise_side_px : the correlation of the noise is measured in a square of this side, in the middle of the frame.
    noise_reach_px : largest distance along an axis at which it is measured.
    star_sigmas : means of 3 × 3 pixels farther than this from the sky are stars; the noise is measured without them.
    fewest_noise_pixels : with fewer pixels left the noise counts as independent.
    least_correlation : correlations below this are zero: they are noise of their estimate.
    centroid_steps : most steps of a centroid. settled_px : it has settled when a step is shorter than this.
    stamp_sigmas : half-width of a stamp in standard deviations of its window. widest_px : largest half-width.
    pixels_at_once : stamps are measured in batches of this many pixels, which bounds the memory.
    shape_steps : steps in which a window takes the shape of its star.
    defect_sigmas : a pixel is a defect when it exceeds the sharpest star by this many standard deviations.
    defect_passes : most passes; in each the defects found before are replaced by their neighbours.
    sharpness_margin : stars differ in sharpness by less than this factor.
    line_sigmas : a column or row is bad when it differs from its neighbours by this many standard deviations of lines.
    least_line : and by more than this, in standard deviations of a pixel; weaker lines do no harm.
    least_usable : no star is looked for where less than this share of its pixels is usable.
    saddle_sigmas : two peaks are two stars when the saddle between them is this many standard deviations of the sky
        deep. saddle_photons : the same for the noise of the star's photons, larger because the saddle is the lowest of
        many places along a trail.
    saddle_share : a saddle is at least this share of the lower peak deep.
    saddle_widths : peaks farther apart than this are two stars, in full widths of a star; longer trails come in parts.
    ridge_px : the saddle is the best of three lines this far apart: a ridge passes the pixels of its ends beside them.
    first_sigma_px : standard deviation of the first guess at the PSF.
    sharpest_sigma_px : of the sharpest star that is thought possible before the PSF is measured (1.3 px full width).
    psf_stars : the PSF is measured on at most this many stars.
    shape_snr : fainter stars, by their signal to noise ratio, have no shape of their own.
    wider : a star wider than the PSF by this factor gets its own window. longer : beyond this factor it is trailed.
    neighbour_passes : how many times the light of all neighbours is taken away and every star measured again.
    pull_share : share of a neighbour's pull that taking its light away leaves.
    pair_share : part of the excess second moment of two stars in one by which their position may be off, squared.
    """

    noise_side_px: int = 600
    noise_reach_px: int = 4
    star_sigmas: float = 3.5
    fewest_noise_pixels: int = 1000
    least_correlation: float = 0.02
    centroid_steps: int = 25
    settled_px: float = 2e-4
    stamp_sigmas: float = 3.5
    widest_px: int = 48
    pixels_at_once: int = 4_000_000
    shape_steps: int = 8
    defect_sigmas: float = 6.0
    defect_passes: int = 3
    sharpness_margin: float = 1.4
    line_sigmas: float = 8.0
    least_line: float = 0.7
    least_usable: float = 0.3
    saddle_sigmas: float = 3.0
    saddle_photons: float = 5.0
    saddle_share: float = 0.02
    saddle_widths: float = 8.0
    ridge_px: float = 0.6
    first_sigma_px: float = 1.3
    sharpest_sigma_px: float = 0.55
    psf_stars: int = 200
    shape_snr: float = 15.0
    wider: float = 1.3
    longer: float = 2.0
    neighbour_passes: int = 3
    pull_share: float = 0.25
    pair_share: float = 0.1


TUNING = DetectionTuning()


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
    tuning: DetectionTuning = field(default=TUNING, repr=False)

    def __post_init__(self) -> None:
        if not self.threshold_sigmas > 0 or self.box_px < 8 or not self.floor_px >= 0:
            raise InputError(
                f"Detection: threshold_sigmas {self.threshold_sigmas}, box_px {self.box_px}, floor_px {self.floor_px}; "
                "give a threshold above 0, a mesh of 8 px or more, a floor of 0 or more"
            )


class Flag(IntFlag):
    """What is doubtful about a measurement; the first five also mark single pixels of a frame."""

    SATURATED = 1  # some of its pixels have reached the limit of the detector
    HOT = 2  # it is, or covers, a pixel that is bright without light
    COSMIC = 4  # it is, or covers, the hit of a cosmic ray
    MASKED = 8  # some of its pixels are not usable: no number, marked bad, a dead column
    EDGE = 16  # the frame ends within its window
    BLENDED = 32  # a neighbour's light was taken away before it was measured
    TRAILED = 64  # it is longer than the stars of the frame
    POOR = 128  # the centroid did not settle; the position is that of the brightest pixel of the smoothed frame

    @classmethod
    def words(cls, bits: int) -> str:
        """The names of the bits that are set, "saturated, edge"; empty for none."""
        return ", ".join(str(flag.name).lower() for flag in cls if int(flag) & int(bits))


PIXEL_FLAGS = Flag.SATURATED | Flag.HOT | Flag.COSMIC | Flag.MASKED


@in_short
@dataclass(frozen=True)
class Measurements:
    """The stars and other marks of one frame, brightest first.

    Attributes
    ----------
    x_px, y_px : (n,) windowed centroids, 0-based, whole numbers in the middle of pixels.
    covariance : (n, 3) of the centroid in px²: xx, xy, yy.
    flux, flux_err : (n,) in the unit of the frame (ADU of the calibrated frame): the total light of a star with
        the mean profile of the frame, and its standard deviation.
    background : (n,) level of the sky below it, the same unit per pixel.
    a_px, b_px, theta_deg : (n,) standard deviations of its light along its long and short axis, and the angle of the
        long axis from +x to +y; NaN where the light is too faint to tell.
    fwhm_px : (n,) full width at half maximum of the circle of the same area; NaN with them.
    snr : (n,) peak of the matched filter over its noise: the significance of the detection.
    peak : (n,) highest pixel above the sky.
    flags : (n,) bits of :class:`Flag`.
    shape : (rows, columns) of the frame.
    psf_fwhm_px : full width at half maximum of the frame's stars.
    name : of the frame.
    notes : what was assumed or is doubtful, in words.
    blind : (rows, columns) where a star could not be measured because most pixels around are not usable; None where the
        whole frame can be.
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

    def clean(self, but: Flag = Flag.BLENDED | Flag.TRAILED | Flag.SATURATED) -> BoolArray:
        """(n,) mask of those that carry no flag, those in ``but`` excepted."""
        return np.asarray((self.flags & ~np.uint16(but)) == 0)

    def sigma_px(self) -> FloatArray:
        """(n, 2) standard deviations along x and y."""
        return np.sqrt(self.covariance[:, [0, 2]])

    def records(self) -> Records:
        """The positions in pixels, ready to be identified in the plane of the frame."""
        xy = np.column_stack([self.x_px, self.y_px])
        xx, cross, yy = self.covariance.T
        full = np.stack([np.stack([xx, cross], -1), np.stack([cross, yy], -1)], -2)
        return Records.of(xy, covariance=full, source=self.name)

    def table(self) -> Table:
        """One row a measurement, with units; flags also in words."""
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

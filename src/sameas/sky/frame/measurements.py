"""Measurements: position, light and shape of every star on a frame, each with its error.

Pixels are counted from 0 and integers are pixel centres, as in NumPy: the lower left pixel extends from −0.5 to 0.5.
FITS headers, DS9 and SExtractor count from 1.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
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


@dataclass(frozen=True)
class DetectionTuning:
    """Parameters of star detection, tuned on simulated frames (``scripts/bench centroids`` and ``crowded``).

    Attributes
    ----------
    noise_side_px : the noise correlation is measured in a square of this side in the middle of the frame.
    noise_reach_px : maximum offset along an axis for the noise correlation.
    star_sigmas : 3 × 3 means farther than this from the sky are stars, and excluded from the noise measurement.
    min_noise_pixels : with fewer pixels the noise is assumed independent.
    min_correlation : smaller correlations are set to zero, as noise of the estimate.
    centroid_steps : maximum number of centroid iterations. converged_px : step length for convergence.
    stamp_sigmas : half-width of a stamp in standard deviations of its window. max_width_px : maximum half-width.
    pixels_at_once : pixels per batch of stamps, which bounds the memory.
    shape_steps : iterations that adapt a window to the shape of its star.
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
    gain_stars, gain_pixels : minimum numbers for a measured gain; gain_sample : maximum number of stars for it.
    gain_snr : minimum signal to noise ratio of these stars. gain_neighbours : maximum share of neighbours' light in it.
    gain_reach_sigmas : distance to which a star's pixels are used. gain_steps : iterations.
    gain_accuracy : relative accuracy of a scatter beyond chance. gain_leverage, gain_share : maximum weight of a pixel
        in the fit of its star, and in the mean pattern of all stars.
    gain_correlation : no gain is measured if correlated noise enlarges variances of positions by more than this factor.
    least_contradiction, largest_contradiction : a given gain is doubted if the photon variance is smaller by more than
        the first factor or larger by more than the second; trails and unresolved neighbours make it up to five times
        larger.
    """

    noise_side_px: int = 600
    noise_reach_px: int = 4
    star_sigmas: float = 3.5
    min_noise_pixels: int = 1000
    min_correlation: float = 0.02
    centroid_steps: int = 25
    converged_px: float = 2e-4
    stamp_sigmas: float = 3.5
    max_width_px: int = 48
    pixels_at_once: int = 4_000_000
    shape_steps: int = 8
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
    gain_stars: int = 5
    gain_pixels: int = 240
    gain_sample: int = 500
    gain_snr: float = 8.0
    gain_neighbours: float = 0.2
    gain_reach_sigmas: float = 2.65
    gain_steps: int = 8
    gain_accuracy: float = 0.01
    gain_leverage: float = 0.7
    gain_share: float = 0.3
    gain_correlation: float = 1.5
    least_contradiction: float = 2.5
    largest_contradiction: float = 10.0


TUNING = DetectionTuning()


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
        if not self.threshold_sigmas > 0 or self.box_px < 8 or not self.floor_px >= 0:
            raise InputError(
                f"Detection: threshold_sigmas {self.threshold_sigmas}, box_px {self.box_px}, floor_px {self.floor_px}; "
                "give a threshold above 0, a mesh of 8 px or more, a floor of 0 or more"
            )


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


PIXEL_FLAGS = Flag.SATURATED | Flag.HOT | Flag.COSMIC | Flag.MASKED


@in_short
@dataclass(frozen=True)
class Measurements:
    """The detections of one frame, brightest first.

    Attributes
    ----------
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

    def clean(self, but: Flag = Flag.BLENDED | Flag.TRAILED | Flag.SATURATED) -> BoolArray:
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

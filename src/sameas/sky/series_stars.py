"""The stars of a series of frames: their measurements in all frames, zero points, differential magnitudes, constancy.

Measurements of one catalogue star are linked by its identifier; other stationary sources are matched frame by frame,
one to one, with the stars found before. Zero points are fitted by ensemble photometry (Honeycutt 1992, PASP 104, 435):
the instrumental magnitude of star s in frame k is M_s − z_k, with all M and z fitted together by weighted least
squares, so no star is a standard and none must be on all frames.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from sameas._identify import identify
from sameas.arrays import ABSENT, BoolArray, FloatArray, IntArray, robust_scale
from sameas.evidence import Field
from sameas.prior import PerPair
from sameas.records import Records
from sameas.sky.frame.measurements import POGSON

ODDS = 2.0  # prior odds that a star of the series is measured on a frame
OFTEN = 0.5  # minimum share of frames of such a star
ITERATIONS = 40  # of the fit
HUBER = 2.0  # residuals beyond this many errors get a lower weight


MIN_ENSEMBLE = 3  # minimum number of stars for a zero point


@dataclass(frozen=True)
class SeriesStars:
    """The stars of a series, (s,) each, in its (f,) frames.

    name : identifier in the catalogue, "" for other stars. place : (s, 2) arcsec in the system of the series.
    sigma_arcsec : its error per axis.
    measurement : (s, f) row among the measurements of the series, ABSENT where it was not measured.
    residual_arcsec : (s, f, 2) measured minus mean position, east and north.
    magnitude, error : (s, f) differential, NaN where the flux is not the star's (saturated, cut, trailed); the error
        includes the floor. mean, mean_error : (s,) over the frames.
    scatter_mag : (s,) standard deviation. p_constant : (s,) probability of at least this scatter for a constant star.
    zero_point, zero_error : (f,) magnitude of one unit of flux. ensemble : (f,) number of stars used.
    floor_mag : extra scatter of bright stars. scale : description of the magnitude scale.
    """

    name: NDArray[Any]
    place: FloatArray
    sigma_arcsec: FloatArray
    measurement: IntArray
    residual_arcsec: FloatArray
    magnitude: FloatArray
    error: FloatArray
    mean: FloatArray
    mean_error: FloatArray
    scatter_mag: FloatArray
    p_constant: FloatArray
    zero_point: FloatArray
    zero_error: FloatArray
    ensemble: IntArray
    floor_mag: float
    scale: str

    def __len__(self) -> int:
        return len(self.name)

    def magnitudes(self, flux: FloatArray, frame: IntArray) -> FloatArray:
        """(n,) magnitudes of fluxes in given frames, NaN without a zero point or with no positive flux."""
        return _instrumental(flux) + self.zero_point[frame]


@dataclass(frozen=True)
class SeriesMeasurements:
    """The measurements of all frames of a series.

    place : (n, 2) in the common system. frame : (n,). sigma : (n,) error per axis. name : (n,) catalogue star, "" if
    none. flux, flux_err : (n,). whole : (n,) mask of complete fluxes. magnitude : (n,) on the scale of the catalogue,
    NaN where not known. frames : their number.
    """

    place: FloatArray
    frame: IntArray
    sigma: FloatArray
    name: NDArray[Any]
    flux: FloatArray
    flux_err: FloatArray
    whole: BoolArray
    magnitude: FloatArray
    frames: int


def gather(measured: SeriesMeasurements, stationary: BoolArray, blur_arcsec: float) -> SeriesStars:
    """The stars among the measurements of a series.

    stationary : (n,) mask. blur_arcsec : extra position scatter of faint stars.
    """
    place, sigma, flux, whole, frames = measured.place, measured.sigma, measured.flux, measured.whole, measured.frames
    rows, names = _rows(
        place, measured.frame, np.hypot(sigma, blur_arcsec), measured.name, stationary, frames, math.log(ODDS)
    )
    at, has_row = np.maximum(rows, 0), rows >= 0
    weight = np.where(has_row, 1.0 / sigma[at] ** 2, 0.0)
    total = weight.sum(axis=1)
    middle = np.einsum("sf,sfd->sd", weight, place[at]) / np.maximum(total, 1e-30)[:, None]
    residual = np.where(has_row[..., None], place[at] - middle[:, None], np.nan)
    raw = np.where(has_row, _instrumental(flux)[at], np.nan)
    with np.errstate(divide="ignore", invalid="ignore"):
        error = np.where(has_row & (flux[at] > 0), POGSON * measured.flux_err[at] / flux[at], np.nan)
    usable = np.isfinite(raw) & np.isfinite(error) & whole[at]
    often = usable.sum(axis=1) >= max(2.0, OFTEN * frames)
    zero, zero_error, ensemble, floor = _ensemble(raw, error, usable & often[:, None])
    zero_offset, scale = _catalogue_scale(measured.magnitude, _instrumental(flux) + zero[measured.frame])
    zero = zero + zero_offset
    light = np.where(whole[at], raw + zero, np.nan)
    error = np.where(np.isfinite(light), np.hypot(error, floor), np.nan)
    mean, mean_error, scatter, p = _constancy(light, error)
    return SeriesStars(
        name=names, place=middle, sigma_arcsec=1.0 / np.sqrt(np.maximum(total, 1e-30)), measurement=rows,
        residual_arcsec=residual, magnitude=light, error=error, mean=mean, mean_error=mean_error, scatter_mag=scatter,
        p_constant=p, zero_point=zero, zero_error=zero_error, ensemble=ensemble, floor_mag=floor, scale=scale,
    )  # fmt: skip


def _instrumental(flux: FloatArray) -> FloatArray:
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.where(flux > 0, -2.5 * np.log10(np.maximum(flux, 1e-30)), np.nan))


def _rows(
    place: FloatArray, frame: IntArray, sigma: FloatArray, name: NDArray[Any], stationary: BoolArray, frames: int,
    log_odds: float,
) -> tuple[IntArray, NDArray[Any]]:  # fmt: skip
    """(s, f) measurement of each star in each frame, ABSENT for none, and (s,) names.

    Stars measured in one frame only are kept if they are in the catalogue. log_odds : ln of the prior odds that a star
    is measured in a frame.
    """
    named = np.flatnonzero(name != "")
    names, star = np.unique(name[named], return_inverse=True)
    capacity = len(names) + int((stationary & (name == "")).sum())
    rows = np.full((capacity, frames), ABSENT)
    rows[star, frame[named]] = named
    sums, weights = np.zeros((capacity, 2)), np.zeros(capacity)
    np.add.at(sums, star, place[named] / sigma[named, None] ** 2)
    np.add.at(weights, star, 1.0 / sigma[named] ** 2)
    count, unnamed = len(names), stationary & (name == "")
    area = float(np.prod(np.maximum(np.ptp(place, axis=0), 60.0))) if len(place) else 1.0
    # The frame with most measurements comes first.
    for k in np.argsort(-np.bincount(frame[unnamed], minlength=frames), kind="stable"):
        in_frame = np.flatnonzero(unnamed & (frame == k))
        free = np.flatnonzero(rows[:count, k] < 0)
        new = np.ones(len(in_frame), bool)
        if len(in_frame) and len(free):
            frame_records = Records.of(place[in_frame], sigma=sigma[in_frame], source="frame")
            star_records = Records.of(
                sums[free] / weights[free, None], sigma=1.0 / np.sqrt(weights[free]), source="stars"
            )
            rule, prior = Field(max(len(in_frame), 1) / area), PerPair(log_odds)
            matches = identify(frame_records, star_records, rule=rule, prior=prior).matches
            rows[free[matches.rows_2], k] = in_frame[matches.rows_1]
            new[matches.rows_1] = False
        new_rows = in_frame[new]
        rows[count + np.arange(len(new_rows)), k] = new_rows
        count += len(new_rows)
        matched = np.flatnonzero((rows[:count, k] >= 0) & ~np.isin(rows[:count, k], named))
        at = rows[matched, k]
        sums[matched] += place[at] / sigma[at, None] ** 2
        weights[matched] += 1.0 / sigma[at] ** 2
    rows = rows[:count]
    names = np.concatenate([names.astype(str), np.full(count - len(names), "")])
    keep = ((rows >= 0).sum(axis=1) > 1) | (names != "")
    return rows[keep], names[keep]


def _ensemble(raw: FloatArray, error: FloatArray, usable: BoolArray) -> tuple[FloatArray, FloatArray, IntArray, float]:
    """(f,) zero points with mean 0, their errors and numbers of stars, and the floor, by iterated weighted means."""
    frames = raw.shape[1]
    ensemble = usable.sum(axis=0)
    good = ensemble >= MIN_ENSEMBLE
    usable = usable & good
    usable &= usable.sum(axis=1, keepdims=True) > 1
    if not usable.any():
        return np.full(frames, np.nan), np.full(frames, np.nan), np.zeros(frames, np.int64), 0.0
    zero, floor = np.zeros(frames), 0.02
    values, variance = np.where(usable, raw, 0.0), np.where(usable, error, 1.0) ** 2
    robust = np.ones_like(values)
    for _ in range(ITERATIONS):
        weight = np.where(usable, robust / (variance + floor**2), 0.0)
        mean = (weight * (values + zero)).sum(axis=1) / np.maximum(weight.sum(axis=1), 1e-30)
        step = (weight * (mean[:, None] - values)).sum(axis=0) / np.maximum(weight.sum(axis=0), 1e-30) - zero
        zero = zero + step - step[good].mean()
        residual = values + zero - mean[:, None]
        precise = usable & (variance <= np.quantile(variance[usable], 0.3))
        spread = robust_scale(residual[precise])
        # Residuals from a mean of n have their variance reduced by 1/n.
        share = 1.0 - 1.0 / max(float(usable.sum(axis=1)[usable.any(axis=1)].mean()), 2.0)
        floor = math.sqrt(max(spread**2 / share - float(np.median(variance[precise])), 1e-6))
        sigmas = np.abs(residual) / np.sqrt(variance + floor**2)
        robust = np.minimum(1.0, HUBER / np.maximum(sigmas, 1e-9))
        if np.abs(step - step[good].mean())[good].max() < 1e-6:
            break
    weight = np.where(usable, robust / (variance + floor**2), 0.0).sum(axis=0)
    zero_error = np.where(good, 1.0 / np.sqrt(np.maximum(weight, 1e-30)), np.nan)
    return np.where(good, zero, np.nan), zero_error, usable.sum(axis=0), floor


def _catalogue_scale(known: FloatArray, common: FloatArray) -> tuple[float, str]:
    """The offset from the common scale to that of the catalogue, and a description of the resulting scale."""
    both = np.isfinite(known) & np.isfinite(common)
    if both.sum() < 3:
        return 0.0, "instrumental, 0 for one unit of flux in a mean frame"
    return float(np.median(known[both] - common[both])), "of the catalogue"


def _constancy(light: FloatArray, error: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """(s,) mean, its error, standard deviation, and probability of this scatter for a constant star (χ²)."""
    measured = np.isfinite(light) & np.isfinite(error)
    weight = np.where(measured, 1.0 / np.where(measured, error, 1.0) ** 2, 0.0)
    total, count = weight.sum(axis=1), measured.sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = np.where(count > 0, (weight * np.where(measured, light, 0.0)).sum(axis=1) / total, np.nan)
        residual = np.where(measured, light - mean[:, None], 0.0)
        scatter = np.where(count > 1, np.sqrt((residual**2).sum(axis=1) / (count - 1)), np.nan)
        p = np.where(count > 1, chdtrc(np.maximum(count - 1, 1), (weight * residual**2).sum(axis=1)), np.nan)
        return mean, np.where(count > 0, 1.0 / np.sqrt(total), np.nan), scatter, p

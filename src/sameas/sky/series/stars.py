"""The stars of a series: each once, with its measurement, magnitude and residual in every frame.

Measurements of one star of the catalogue belong together by its identifier; what stands still and has none is
identified frame by frame, one to one, with the stars so far. Zero points are those of an ensemble (Honeycutt 1992,
PASP 104, 435): the instrumental magnitude of star s in frame k is M_s − z_k, and all M and z are fitted together with
weights, so that no star is a standard and none need be on all frames.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from sameas._identify import identify
from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.evidence import Field
from sameas.prior import PerPair
from sameas.records import Records
from sameas.representation import in_short


@dataclass(frozen=True)
class StarTuning:
    """How stars are gathered and their zero points fitted; all chosen.

    Attributes
    ----------
    odds : that a star of the series is measured on a frame.
    least_ensemble : a frame's zero point needs so many stars. often : that are on this share of the frames.
    rounds : of the fit. huber : residuals beyond so many errors count less.
    """

    odds: float = 2.0
    least_ensemble: int = 3
    often: float = 0.5
    rounds: int = 40
    huber: float = 2.0


TUNING = StarTuning()


@in_short
@dataclass(frozen=True)
class Stars:
    """The stars of a series, (s,) each, in its (f,) frames.

    Attributes
    ----------
    name : identifier in the catalogue, "" for stars that it lacks. place : (s, 2) arcsec in the system of the series.
    sigma_arcsec : its error per axis.
    measurement : (s, f) row among the measurements of the series, −1 where it was not measured.
    residual_arcsec : (s, f, 2) measured minus mean place, east and north.
    magnitude, error : (s, f) differential, NaN where not all the light was measured (saturated, cut); error with the
        floor. mean, mean_error : (s,) over the frames.
    scatter_mag : (s,) standard deviation. p_constant : (s,) probability of as much scatter, were the star constant.
    zero_point, zero_error : (f,) magnitude of one unit of flux. ensemble : (f,) stars that gave it.
    floor_mag : scatter of bright stars beside their errors. scale : what magnitudes are counted in.
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
        """(n,) magnitudes of fluxes measured in some frames, NaN where there is no zero point or no light."""
        return _instrumental(flux) + self.zero_point[frame]


def gather(
    place: FloatArray, frame: IntArray, sigma: FloatArray, name: NDArray[Any], still: BoolArray, flux: FloatArray,
    flux_err: FloatArray, whole: BoolArray, magnitude: FloatArray, frames: int, blur_arcsec: float,
    tuning: StarTuning = TUNING,
) -> Stars:  # fmt: skip
    """The stars among the measurements of a series.

    place : (n, 2) in the common system. frame : (n,). sigma : (n,) error per axis. name : (n,) star of the catalogue.
    still : (n,) stands still. flux, flux_err : (n,). whole : (n,) all the light was measured. magnitude : (n,) on the
    scale of the catalogue, NaN where not known. blur_arcsec : by which places of faint stars wander more than quoted.
    """
    rows, names = _rows(place, frame, np.hypot(sigma, blur_arcsec), name, still, frames, tuning)
    at, there = np.maximum(rows, 0), rows >= 0
    weight = np.where(there, 1.0 / sigma[at] ** 2, 0.0)
    total = weight.sum(axis=1)
    middle = np.einsum("sf,sfd->sd", weight, place[at]) / np.maximum(total, 1e-30)[:, None]
    residual = np.where(there[..., None], place[at] - middle[:, None], np.nan)
    raw = np.where(there, _instrumental(flux)[at], np.nan)
    with np.errstate(divide="ignore", invalid="ignore"):
        error = np.where(there & (flux[at] > 0), 1.0857 * flux_err[at] / flux[at], np.nan)
    usable = np.isfinite(raw) & np.isfinite(error) & whole[at]
    often = usable.sum(axis=1) >= max(2.0, tuning.often * frames)
    zero, zero_error, ensemble, floor = _ensemble(raw, error, usable & often[:, None], tuning)
    off, scale = _catalogue_scale(magnitude, _instrumental(flux) + zero[frame])
    zero = zero + off
    light = np.where(whole[at], raw + zero, np.nan)
    error = np.where(np.isfinite(light), np.hypot(error, floor), np.nan)
    mean, mean_error, scatter, p = _constancy(light, error)
    return Stars(
        names, middle, 1.0 / np.sqrt(np.maximum(total, 1e-30)), rows, residual, light, error, mean, mean_error, scatter,
        p, zero, zero_error, ensemble, floor, scale,
    )  # fmt: skip


def _instrumental(flux: FloatArray) -> FloatArray:
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.where(flux > 0, -2.5 * np.log10(np.maximum(flux, 1e-30)), np.nan))


def _rows(
    place: FloatArray, frame: IntArray, sigma: FloatArray, name: NDArray[Any], still: BoolArray, frames: int,
    tuning: StarTuning,
) -> tuple[IntArray, NDArray[Any]]:  # fmt: skip
    """(s, f) measurement of each star in each frame, −1 for none, and (s,) their names; stars of one frame alone only
    where the catalogue has them."""
    named = np.flatnonzero(name != "")
    names, star = np.unique(name[named], return_inverse=True)
    room = len(names) + int((still & (name == "")).sum())
    rows = np.full((room, frames), -1)
    rows[star, frame[named]] = named
    sums, weights = np.zeros((room, 2)), np.zeros(room)
    np.add.at(sums, star, place[named] / sigma[named, None] ** 2)
    np.add.at(weights, star, 1.0 / sigma[named] ** 2)
    count, loose = len(names), still & (name == "")
    area = float(np.prod(np.maximum(np.ptp(place, axis=0), 60.0))) if len(place) else 1.0
    # The frame that shows most comes first.
    for k in np.argsort(-np.bincount(frame[loose], minlength=frames), kind="stable"):
        here = np.flatnonzero(loose & (frame == k))
        free = np.flatnonzero(rows[:count, k] < 0)
        new = np.ones(len(here), bool)
        if len(here) and len(free):
            one = Records.of(place[here], sigma=sigma[here], source="frame")
            known = Records.of(sums[free] / weights[free, None], sigma=1.0 / np.sqrt(weights[free]), source="stars")
            rule, prior = Field(max(len(here), 1) / area), PerPair(math.log(tuning.odds))
            found = identify(one, known, rule=rule, prior=prior).matches
            rows[free[found.rows_2], k] = here[found.rows_1]
            new[found.rows_1] = False
        fresh = here[new]
        rows[count + np.arange(len(fresh)), k] = fresh
        count += len(fresh)
        mine = np.flatnonzero((rows[:count, k] >= 0) & ~np.isin(rows[:count, k], named))
        at = rows[mine, k]
        sums[mine] += place[at] / sigma[at, None] ** 2
        weights[mine] += 1.0 / sigma[at] ** 2
    rows = rows[:count]
    names = np.concatenate([names.astype(str), np.full(count - len(names), "")])
    keep = ((rows >= 0).sum(axis=1) > 1) | (names != "")
    return rows[keep], names[keep]


def _ensemble(
    raw: FloatArray, error: FloatArray, usable: BoolArray, tuning: StarTuning
) -> tuple[FloatArray, FloatArray, IntArray, float]:
    """(f,) zero points, their mean 0, their errors and stars, and the floor, by repeated weighted means."""
    frames = raw.shape[1]
    ensemble = usable.sum(axis=0)
    good = ensemble >= tuning.least_ensemble
    usable = usable & good
    usable &= usable.sum(axis=1, keepdims=True) > 1
    if not usable.any():
        return np.full(frames, np.nan), np.full(frames, np.nan), np.zeros(frames, np.int64), 0.0
    zero, floor = np.zeros(frames), 0.02
    values, variance = np.where(usable, raw, 0.0), np.where(usable, error, 1.0) ** 2
    robust = np.ones_like(values)
    for _ in range(tuning.rounds):
        weight = np.where(usable, robust / (variance + floor**2), 0.0)
        mean = (weight * (values + zero)).sum(axis=1) / np.maximum(weight.sum(axis=1), 1e-30)
        step = (weight * (mean[:, None] - values)).sum(axis=0) / np.maximum(weight.sum(axis=0), 1e-30) - zero
        zero = zero + step - step[good].mean()
        left = values + zero - mean[:, None]
        sharp = usable & (variance <= np.quantile(variance[usable], 0.3))
        spread = 1.4826 * float(np.median(np.abs(left[sharp])))
        # A mean of n takes away 1/n of the variance.
        share = 1.0 - 1.0 / max(float(usable.sum(axis=1)[usable.any(axis=1)].mean()), 2.0)
        floor = math.sqrt(max(spread**2 / share - float(np.median(variance[sharp])), 1e-6))
        away = np.abs(left) / np.sqrt(variance + floor**2)
        robust = np.minimum(1.0, tuning.huber / np.maximum(away, 1e-9))
        if np.abs(step - step[good].mean())[good].max() < 1e-6:
            break
    weight = np.where(usable, robust / (variance + floor**2), 0.0).sum(axis=0)
    zero_error = np.where(good, 1.0 / np.sqrt(np.maximum(weight, 1e-30)), np.nan)
    return np.where(good, zero, np.nan), zero_error, usable.sum(axis=0), floor


def _catalogue_scale(known: FloatArray, common: FloatArray) -> tuple[float, str]:
    """By how much the common scale is off that of the catalogue, and what it is counted in then."""
    both = np.isfinite(known) & np.isfinite(common)
    if both.sum() < 3:
        return 0.0, "instrumental, 0 for one unit of flux in a mean frame"
    return float(np.median(known[both] - common[both])), "of the catalogue"


def _constancy(light: FloatArray, error: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """(s,) mean, its error, standard deviation, and probability of that scatter in a constant star (χ²)."""
    there = np.isfinite(light) & np.isfinite(error)
    weight = np.where(there, 1.0 / np.where(there, error, 1.0) ** 2, 0.0)
    total, count = weight.sum(axis=1), there.sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = np.where(count > 0, (weight * np.where(there, light, 0.0)).sum(axis=1) / total, np.nan)
        left = np.where(there, light - mean[:, None], 0.0)
        scatter = np.where(count > 1, np.sqrt((left**2).sum(axis=1) / (count - 1)), np.nan)
        p = np.where(count > 1, chdtrc(np.maximum(count - 1, 1), (weight * left**2).sum(axis=1)), np.nan)
        return mean, np.where(count > 0, 1.0 / np.sqrt(total), np.nan), scatter, p

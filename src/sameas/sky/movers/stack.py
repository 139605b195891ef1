"""Tracklets in the pixels: forced photometry at the predicted positions, cut-outs along the motion, stacks.

A tracklet predicts the position of its mover on every frame, including those without a detection. The flux is measured
there with the star's profile (forced photometry); on frames without a detection it is additional evidence. With F the
flux of the mover, f ± e the measured one, and ε the probability that the mover is hidden (by a star, a cloud), the log
ratio of a frame is

    ln [(1 − ε) N(f; F, e² + (0.3 F)²) + ε N(f; 0, e²)] − ln N(f; 0, e²),

instead of ln(1 − P_d) for the missed detection. e is measured at positions around the track (``StackTuning.controls``)
and so includes crowding and correlated noise.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree

from sameas.arrays import BoolArray, FloatArray, robust_scale
from sameas.sky.frame.centroid import FWHM_PER_SIGMA
from sameas.sky.frame.image import Frame
from sameas.sky.movers.search import Movers
from sameas.sky.series import Series

# Parameters for measuring tracklets in the pixels; all chosen.
HALF_PX = 24  # half-size of a cut-out along the motion
MAX_HALF_PX = 60  # maximum half-size of one fixed on the sky
CONTROLS = 48  # number of positions around the track, per frame, that give the noise
FAR_WIDTHS = 6.0  # their maximum distance, FWHM
HIDDEN_WIDTHS = 1.2  # a star closer than this (FWHM) hides the mover
ABSENT = 0.1  # probability ε that it is not visible
VARIABLE = 0.3  # relative 1σ of its flux
#: Probability that the light on its path is not its own, but of a star or halo that is not listed. At 1 500 random
#: places of ten real frames a path over six of them has a likelihood ratio above 100 in 1.3 % of the cases, and a mean
#: one of 9·10⁴ where chance allows 1; with 0.02 the mean is 0.85.
UNLISTED = 0.02
MAX_TRACKLETS = 200  # maximum number of tracklets, the first ones


@dataclass(frozen=True)
class Stack:
    """Measurements of the first k tracklets in the pixels of f frames.

    place : (k, f, 2) predicted, arcsec in the system of the series. chip : (k, f, 2) the same in pixels of the frame.
    flux, error : (k, f) measured there, on the scale of the mean frame; NaN outside the frame or where unusable.
    hidden : (k, f) by a star. detected : (k, f) the tracklet has a detection.
    log_ratio : (k,) evidence of the frames without a detection, in place of the misses; natural logarithm.
    p : (k,) probability of the tracklet including it.
    along : (k, f, s, s) cut-outs around the predicted position, in units of the pixel noise of the frame.
    fixed : (k,) cut-outs fixed on the sky, (f, t, t) each, north up and east left, same units; None if the motion is
        too large.
    stacked : (k, s, s) the mean along the motion. snr : (k,) of the flux in all frames together.
    scale_arcsec_per_px : of the cut-outs.
    """

    place: FloatArray
    chip: FloatArray
    flux: FloatArray
    error: FloatArray
    hidden: BoolArray
    detected: BoolArray
    log_ratio: FloatArray
    p: FloatArray
    along: NDArray[np.float32]
    fixed: tuple[NDArray[np.float32] | None, ...]
    stacked: NDArray[np.float32]
    snr: FloatArray
    scale_arcsec_per_px: float

    def __len__(self) -> int:
        return len(self.flux)


def stack(movers: Movers, series: Series, frames: Iterable[Frame], place: FloatArray | None = None) -> Stack:
    """The tracklets measured in the pixels of the frames.

    movers : tracklets of the series. frames : calibrated, in the order of ``series.exposures``, used one at a time.
    place : (k, f, 2) arcsec, positions of movers below the limit of single frames; None for tracklets of detections.
    """
    k, f = min(len(movers), MAX_TRACKLETS), len(series.exposures)
    scale = series.scale_arcsec_per_px
    blind = place is not None
    place = (predicted(movers, series) if place is None else place)[:k]
    size, half = 2 * HALF_PX + 1, _fixed_halves(place, scale)
    chip, flux, error = np.full((k, f, 2), np.nan), np.full((k, f), np.nan), np.full((k, f), np.nan)
    along = np.zeros((k, f, size, size), np.float32)
    fixed = [None if h is None else np.zeros((f, 2 * h + 1, 2 * h + 1), np.float32) for h in half]
    hidden = np.zeros((k, f), bool)
    rng = np.random.default_rng(0)
    for n, frame in enumerate(frames):
        if not k:
            break
        to_chip = chip_map(series, n)
        chip[:, n] = to_chip(place[:, n])
        width = max(_width(series, n), 1.5)
        hidden[:, n] = _near_star(series, place[:, n], HIDDEN_WIDTHS * width * scale)
        measured = _FramePixels(frame, width / FWHM_PER_SIGMA)
        flux[:, n], error[:, n] = _forced(measured, chip[:, n], to_chip, place[:, n], width, scale, rng)
        noise = measured.noise()
        for i in range(k):
            along[i, n] = measured.cut(to_chip(_grid(place[i, n], HALF_PX, scale))) / noise
            h, cut = half[i], fixed[i]
            if h is not None and cut is not None:
                cut[n] = measured.cut(to_chip(_grid(place[i].mean(axis=0), h, scale))) / noise
    zero = series.stars.zero_point
    factor = 10 ** (-0.4 * np.nan_to_num(np.where(np.isfinite(zero), np.nanmean(zero) - zero, 0.0)))
    flux, error = flux / factor, error / factor
    detected = np.zeros((k, f), bool) if blind else _detected(movers, series)[:k]
    log_ratio = np.zeros(k) if blind else stacked_evidence(movers, flux, error, hidden, detected)
    p = movers.p_tracklet[:k]
    with np.errstate(divide="ignore", over="ignore"):
        odds = np.log(np.maximum(p, 1e-300)) - np.log(np.maximum(1 - p, 1e-16)) + log_ratio
        p = 1.0 / (1.0 + np.exp(-np.clip(odds, -700, 700)))
    stacked, snr = _stacked(along, flux, error, hidden)
    return Stack(
        place=place, chip=chip, flux=flux, error=error, hidden=hidden, detected=detected, log_ratio=log_ratio, p=p,
        along=along, fixed=tuple(fixed), stacked=stacked, snr=snr, scale_arcsec_per_px=scale,
    )  # fmt: skip


def predicted(movers: Movers, series: Series) -> FloatArray:
    """(k, f, 2) positions by a fit of linear motion, or quadratic with enough detections and time, arcsec."""
    minutes = np.array([e.mjd_utc for e in series.exposures]) * 1440.0
    minutes -= minutes.mean()
    path = np.empty((len(movers), len(minutes), 2))
    for k, members in enumerate(movers.members):
        rows = movers.detections.rows[members[members >= 0]]
        t, positions = minutes[series.frame[rows]], series.place[rows]
        weight = 1.0 / series.sigma_arcsec[rows]
        order = 2 if len(rows) >= 6 and np.ptp(t) > 0.7 * np.ptp(minutes) else 1
        terms = np.vander(t, order + 1)
        fit = np.linalg.lstsq(terms * weight[:, None], positions * weight[:, None], rcond=None)[0]
        path[k] = np.vander(minutes, order + 1) @ fit
    return path


def _fixed_halves(place: FloatArray, scale: float) -> list[int | None]:
    """Half-size of the cut-out fixed on the sky of each tracklet, px; None if its motion is too large."""
    motion_px = np.abs(place - place.mean(axis=1, keepdims=True)).max(axis=(1, 2), initial=0.0) / scale
    half = np.ceil(motion_px + 0.6 * HALF_PX).astype(int)
    return [max(int(h), HALF_PX) if h <= MAX_HALF_PX else None for h in half]


class ChipMap:
    """A polynomial map from positions, arcsec, to pixels of one frame, or back, fitted to its measurements."""

    def __init__(self, place: FloatArray, chip: FloatArray) -> None:
        self.middle, self.unit = place.mean(axis=0), max(float(np.abs(place - place.mean(axis=0)).max()), 1.0)
        self.order = 3 if len(place) > 60 else 2 if len(place) > 20 else 1
        self.fit = np.linalg.lstsq(self._terms(place), chip, rcond=None)[0]

    def _terms(self, place: FloatArray) -> FloatArray:
        u, v = ((place - self.middle) / self.unit).T
        return np.column_stack(
            [u**a * v**b for n in range(self.order + 1) for a, b in ((n - j, j) for j in range(n + 1))]
        )

    def __call__(self, place: FloatArray) -> FloatArray:
        shape = place.shape
        return np.asarray(self._terms(place.reshape(-1, 2)) @ self.fit).reshape(shape)


def chip_map(series: Series, n: int) -> ChipMap:
    """The map from positions, arcsec, to pixels of a frame."""
    in_frame, exposure = series.frame == n, series.exposures[n]
    return ChipMap(series.place[in_frame], np.column_stack([exposure.x_px, exposure.y_px])[series.row[in_frame]])


def _width(series: Series, n: int) -> float:
    """FWHM of the stars of a frame, px."""
    return float(series.exposures[n].psf_fwhm_px)


def _near_star(series: Series, place: FloatArray, reach: float) -> BoolArray:
    """(k,) mask of the positions within ``reach`` arcsec of a star of the series."""
    stars = series.stars.place
    if not len(stars):
        return np.zeros(len(place), bool)
    return np.asarray(cKDTree(stars).query(place)[0] < reach)


class _FramePixels:
    """The pixels of one frame: cut-outs, and matched-filter fluxes at given positions."""

    def __init__(self, frame: Frame, sigma_px: float) -> None:
        self.image, self.bad, self.sigma = frame.image, frame.flags != 0, sigma_px
        self.reach = math.ceil(3.0 * sigma_px)
        self.level = float(np.median(self.image[::7, ::7][~self.bad[::7, ::7]]))
        # Noise from differences over a few pixels, insensitive to gradients of the sky.
        apart = max(3, math.ceil(2.0 * sigma_px))
        good = ~(self.bad[:, apart:] | self.bad[:, :-apart])[::3, ::3]
        rough = (self.image[:, apart:] - self.image[:, :-apart])[::3, ::3][good]
        self._noise = max(robust_scale(rough) / math.sqrt(2.0), 1e-6)

    def noise(self) -> float:
        """Standard deviation of a pixel of the sky."""
        return self._noise

    def cut(self, chip: FloatArray) -> NDArray[np.float32]:
        """(s, s) light above a fitted plane of the sky, at pixels (s, s, 2)."""
        out = map_coordinates(self.image, [chip[..., 1], chip[..., 0]], order=1, mode="constant", cval=self.level)
        v, u = np.mgrid[-1.0 : 1.0 : out.shape[0] * 1j, -1.0 : 1.0 : out.shape[1] * 1j]
        terms = np.column_stack([np.ones(out.size), u.ravel(), v.ravel()])
        low = out.ravel() <= np.percentile(out, 75.0)
        sky = terms @ np.linalg.lstsq(terms[low], out.ravel()[low], rcond=None)[0]
        residual = out - sky.reshape(out.shape)
        return np.asarray(residual - np.median(residual), np.float32)

    def flux(self, chip: FloatArray) -> FloatArray:
        """(m,) flux of a Gaussian star at pixels (m, 2), NaN where most of its pixels are unusable."""
        out = np.full(len(chip), np.nan)
        half = self.reach + math.ceil(4 * self.sigma)
        rows, columns = self.image.shape
        for i, (x, y) in enumerate(chip):
            if not (half <= x < columns - half - 1 and half <= y < rows - half - 1):
                continue
            a, b = round(y) - half, round(x) - half
            box = self.image[a : a + 2 * half + 1, b : b + 2 * half + 1]
            good = ~self.bad[a : a + 2 * half + 1, b : b + 2 * half + 1]
            v, u = np.mgrid[a : a + 2 * half + 1, b : b + 2 * half + 1]
            r2 = (u - x) ** 2 + (v - y) ** 2
            profile = np.exp(-0.5 * r2 / self.sigma**2) / (2 * math.pi * self.sigma**2)
            core, ring = good & (r2 <= self.reach**2), good & (r2 > self.reach**2)
            if profile[core].sum() > 0.7 and ring.sum() > 20:
                out[i] = (profile[core] * (box[core] - np.median(box[ring]))).sum() / (profile[core] ** 2).sum()
        return out


def _forced(
    measured: _FramePixels, chip: FloatArray, to_chip: ChipMap, place: FloatArray, width: float, scale: float,
    rng: np.random.Generator,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """(k,) fluxes at the positions, and their errors from control positions around each."""
    flux, error = measured.flux(chip), np.full(len(chip), np.nan)
    for i in np.flatnonzero(np.isfinite(flux)):
        angle = rng.uniform(0, 2 * math.pi, CONTROLS)
        radius = width * scale * (2.0 + (FAR_WIDTHS - 2.0) * np.sqrt(rng.uniform(0, 1, CONTROLS)))
        control_places = place[i] + radius[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
        control_flux = measured.flux(to_chip(control_places))
        control_flux = control_flux[np.isfinite(control_flux)]
        least = measured.noise() * 2.0 * math.sqrt(math.pi) * measured.sigma
        if len(control_flux) >= CONTROLS // 3:
            # Stars near the track widen the upper half of the controls; the lower half gives the noise.
            middle = float(np.percentile(control_flux, 40.0))
            low = float(np.percentile(control_flux, 12.0))
            error[i] = max((middle - low) / 0.9215, least)
            flux[i] -= min(middle, 0.0)
        else:
            error[i] = least
    return np.where(np.isfinite(error), flux, np.nan), error


def _grid(place: FloatArray, half: int, scale: float) -> FloatArray:
    """(s, s, 2) grid of positions around one, the first row northernmost, the first column easternmost."""
    steps = np.arange(-half, half + 1) * scale
    north, east = np.meshgrid(-steps, -steps, indexing="ij")
    return np.asarray(place + np.stack([east, north], axis=-1))


def _detected(movers: Movers, series: Series) -> BoolArray:
    """(k, f) mask of the frames on which each tracklet has a detection."""
    out = np.zeros((len(movers), len(series.exposures)), bool)
    k, column = np.nonzero(movers.members >= 0)
    out[k, series.frame[movers.detections.rows[movers.members[k, column]]]] = True
    return out


def stacked_evidence(
    movers: Movers, flux: FloatArray, error: FloatArray, hidden: BoolArray, detected: BoolArray
) -> FloatArray:
    """(k,) log ratio by the frames without a detection."""
    usable = np.isfinite(flux) & ~hidden
    measured = usable & detected
    weight = np.where(measured, 1.0 / np.where(measured, error, 1.0) ** 2, 0.0)
    mean = (weight * np.where(measured, flux, 0.0)).sum(axis=1) / np.maximum(weight.sum(axis=1), 1e-30)
    mean = np.where(mean > 0, mean, np.nan)[:, None]
    missed = usable & ~detected & np.isfinite(mean)
    with np.errstate(invalid="ignore", divide="ignore"):
        variance = error**2 + (VARIABLE * mean) ** 2
        log_visible = math.log1p(-ABSENT) - 0.5 * ((flux - mean) ** 2 / variance + np.log(variance))
        log_absent = -0.5 * ((flux / error) ** 2 + np.log(error**2))
        log_ratio = np.logaddexp(log_visible, math.log(ABSENT) + log_absent) - log_absent
    # An unlisted star on the track would give much light: the evidence is limited, per frame and of all.
    gain = np.where(missed, np.minimum(log_ratio, 3.0), 0.0).sum(axis=1)
    gain -= np.logaddexp(math.log1p(-UNLISTED), math.log(UNLISTED) + gain)
    # This replaces the misses counted by the search.
    return np.asarray(gain - movers.log_missed[: len(flux)])


def _stacked(
    along: NDArray[np.float32], flux: FloatArray, error: FloatArray, hidden: BoolArray
) -> tuple[NDArray[np.float32], FloatArray]:
    """(k, s, s) mean along the motion, clipped 5σ above the median, and (k,) signal to noise of the flux."""
    usable = np.isfinite(flux) & ~hidden
    weight = np.where(usable, 1.0 / np.where(usable, error, 1.0) ** 2, 0.0)
    total = weight.sum(axis=1)
    snr = (weight * np.where(usable, flux, 0.0)).sum(axis=1) / np.sqrt(np.maximum(total, 1e-30))
    out = np.zeros((along.shape[0], *along.shape[2:]), np.float32)
    for i, cuts in enumerate(along):
        usable_frames = np.isfinite(flux[i])
        if usable_frames.any():
            usable_cuts = cuts[usable_frames]
            # Scaled to the noise of a pixel.
            out[i] = np.clip(usable_cuts, None, np.median(usable_cuts, axis=0) + 5.0).mean(axis=0) * math.sqrt(
                usable_frames.sum()
            )
    return out, snr


def confirmed(movers: Movers, stacked: Stack, min_probability: float) -> tuple[Movers, Stack]:
    """The tracklets with the evidence of forced photometry, those less probable than the minimum excluded."""
    p = np.concatenate([stacked.p, movers.p_tracklet[len(stacked) :]])
    change = np.concatenate([stacked.log_ratio, np.zeros(len(movers) - len(stacked))])
    share = p / np.maximum(movers.p_tracklet, 1e-300)
    movers = replace(
        movers, p_tracklet=p, p_exact=np.minimum(share * movers.p_exact, p),
        p_member=np.minimum(share[:, None] * movers.p_member, 1.0), log_weight=movers.log_weight + change,
        expected_chance=movers.expected_chance * np.exp(-change),
        log_missed=np.where(np.arange(len(movers)) < len(stacked), 0.0, movers.log_missed),
    )  # fmt: skip
    keep = p >= min_probability
    measured = keep[: len(stacked)]
    names = ("place", "chip", "flux", "error", "hidden", "detected", "log_ratio", "p", "along", "stacked", "snr")
    parts = {name: getattr(stacked, name)[measured] for name in names}
    fixed = tuple(cutouts for cutouts, used in zip(stacked.fixed, measured, strict=True) if used)
    return movers.only(keep), replace(stacked, **parts, fixed=fixed)

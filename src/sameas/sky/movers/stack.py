"""Tracklets in the pixels: forced photometry at the predicted positions, cut-outs along the motion, stacks, trails.

A tracklet predicts the position of its mover on every frame, including those without a detection. The flux is measured
there with the star's profile (forced photometry); on frames without a detection it is additional evidence. With F the
flux of the mover, f ± e the measured one, and ε the probability that the mover is hidden (by a star, a cloud), the log
ratio of a frame is

    ln [(1 − ε) N(f; F, e² + (0.3 F)²) + ε N(f; 0, e²)] − ln N(f; 0, e²),

instead of ln(1 − P_d) for the missed detection. e is measured at positions around the track (``StackTuning.controls``)
and so includes crowding and correlated noise.

A source that moves during the exposure makes a trail (:func:`with_trails`). Windows as wide as a star detect parts of
it, or do not converge. Unexplained and unconverged measurements are tested as trails: first by sums of the matched
filter along lines through them, then by a fit of a Gaussian star moving uniformly along a straight line,

    I(a, c) = F/L · exp(−c²/2σ²)/(√2π σ) · ½ [erf((a + L/2)/√2σ) − erf((a − L/2)/√2σ)],

a along and c across the trail, L its length (Vereš et al. 2012, PASP 124, 1197). Its middle is the position at the
middle of the exposure; its length and angle give the rate except for the sign, evidence for the links.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.spatial import cKDTree

from sameas.arrays import BoolArray, FloatArray, robust_scale
from sameas.gaussian import inverse
from sameas.representation import in_short
from sameas.sky.frame.centroid import FWHM_PER_SIGMA
from sameas.sky.frame.image import Frame
from sameas.sky.frame.measurements import Flag
from sameas.sky.movers.search import Movers
from sameas.sky.series import Exposure, Series, Trails


@dataclass(frozen=True)
class StackTuning:
    """Parameters for measuring tracklets in the pixels; all chosen.

    Attributes
    ----------
    half_px : half-size of a cut-out along the motion. max_half_px : maximum half-size of one fixed on the sky.
    controls : number of positions around the track, per frame, that give the noise. far_widths : their maximum
        distance, FWHM.
    hidden_widths : a star closer than this (FWHM) hides the mover. absent : probability ε that it is not visible.
    variable : relative 1σ of its flux. unlisted : probability that the light on its path is not its own, but of a star
        or halo that is not listed. max_tracklets : maximum number of tracklets, the first ones.
    """

    half_px: int = 24
    max_half_px: int = 60
    controls: int = 48
    far_widths: float = 6.0
    hidden_widths: float = 1.2
    absent: float = 0.1
    variable: float = 0.3
    #: At 1 500 random places of ten real frames a path over six of them has a likelihood ratio above 100 in 1.3 % of
    #: the cases, and a mean one of 9·10⁴ where chance allows 1; with 0.02 the mean is 0.85.
    unlisted: float = 0.02
    max_tracklets: int = 200


DEFAULT_STACK = StackTuning()


@in_short
@dataclass(frozen=True)
class Stack:
    """Measurements of the first k tracklets in the pixels of f frames.

    Attributes
    ----------
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


def stack(
    movers: Movers,
    series: Series,
    frames: Iterable[Frame],
    place: FloatArray | None = None,
    tuning: StackTuning = DEFAULT_STACK,
) -> Stack:
    """The tracklets measured in the pixels of the frames.

    movers : tracklets of the series. frames : calibrated, in the order of ``series.exposures``, used one at a time.
    place : (k, f, 2) arcsec, positions of movers below the limit of single frames; None for tracklets of detections.
    """
    k, f = min(len(movers), tuning.max_tracklets), len(series.exposures)
    scale = series.scale_arcsec_per_px
    blind = place is not None
    place = (predicted(movers, series) if place is None else place)[:k]
    size, half = 2 * tuning.half_px + 1, _fixed_halves(place, scale, tuning)
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
        hidden[:, n] = _near_star(series, place[:, n], tuning.hidden_widths * width * scale)
        measured = _FramePixels(frame, width / FWHM_PER_SIGMA)
        flux[:, n], error[:, n] = _forced(measured, chip[:, n], to_chip, place[:, n], width, scale, rng, tuning)
        noise = measured.noise()
        for i in range(k):
            along[i, n] = measured.cut(to_chip(_grid(place[i, n], tuning.half_px, scale))) / noise
            h, cut = half[i], fixed[i]
            if h is not None and cut is not None:
                cut[n] = measured.cut(to_chip(_grid(place[i].mean(axis=0), h, scale))) / noise
    zero = series.stars.zero_point
    factor = 10 ** (-0.4 * np.nan_to_num(np.where(np.isfinite(zero), np.nanmean(zero) - zero, 0.0)))
    flux, error = flux / factor, error / factor
    detected = np.zeros((k, f), bool) if blind else _detected(movers, series)[:k]
    log_ratio = np.zeros(k) if blind else _evidence(movers, flux, error, hidden, detected, tuning)
    p = movers.p_tracklet[:k]
    with np.errstate(divide="ignore", over="ignore"):
        odds = np.log(np.maximum(p, 1e-300)) - np.log(np.maximum(1 - p, 1e-16)) + log_ratio
        p = 1.0 / (1.0 + np.exp(-np.clip(odds, -700, 700)))
    stacked, snr = _stacked(along, flux, error, hidden)
    return Stack(
        place, chip, flux, error, hidden, detected, log_ratio, p, along, tuple(fixed), stacked, snr, scale
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


def _fixed_halves(place: FloatArray, scale: float, tuning: StackTuning) -> list[int | None]:
    """Half-size of the cut-out fixed on the sky of each tracklet, px; None if its motion is too large."""
    motion_px = np.abs(place - place.mean(axis=1, keepdims=True)).max(axis=(1, 2), initial=0.0) / scale
    half = np.ceil(motion_px + 0.6 * tuning.half_px).astype(int)
    return [max(int(h), tuning.half_px) if h <= tuning.max_half_px else None for h in half]


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
    measured: _FramePixels,
    chip: FloatArray,
    to_chip: ChipMap,
    place: FloatArray,
    width: float,
    scale: float,
    rng: np.random.Generator,
    tuning: StackTuning,
) -> tuple[FloatArray, FloatArray]:
    """(k,) fluxes at the positions, and their errors from control positions around each."""
    flux, error = measured.flux(chip), np.full(len(chip), np.nan)
    for i in np.flatnonzero(np.isfinite(flux)):
        angle = rng.uniform(0, 2 * math.pi, tuning.controls)
        radius = width * scale * (2.0 + (tuning.far_widths - 2.0) * np.sqrt(rng.uniform(0, 1, tuning.controls)))
        control_places = place[i] + radius[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
        control_flux = measured.flux(to_chip(control_places))
        control_flux = control_flux[np.isfinite(control_flux)]
        least = measured.noise() * 2.0 * math.sqrt(math.pi) * measured.sigma
        if len(control_flux) >= tuning.controls // 3:
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


def _evidence(
    movers: Movers,
    flux: FloatArray,
    error: FloatArray,
    hidden: BoolArray,
    detected: BoolArray,
    tuning: StackTuning,
) -> FloatArray:
    """(k,) log ratio by the frames without a detection."""
    usable = np.isfinite(flux) & ~hidden
    measured = usable & detected
    weight = np.where(measured, 1.0 / np.where(measured, error, 1.0) ** 2, 0.0)
    mean = (weight * np.where(measured, flux, 0.0)).sum(axis=1) / np.maximum(weight.sum(axis=1), 1e-30)
    mean = np.where(mean > 0, mean, np.nan)[:, None]
    missed = usable & ~detected & np.isfinite(mean)
    with np.errstate(invalid="ignore", divide="ignore"):
        variance = error**2 + (tuning.variable * mean) ** 2
        log_visible = math.log1p(-tuning.absent) - 0.5 * ((flux - mean) ** 2 / variance + np.log(variance))
        log_absent = -0.5 * ((flux / error) ** 2 + np.log(error**2))
        log_ratio = np.logaddexp(log_visible, math.log(tuning.absent) + log_absent) - log_absent
    # An unlisted star on the track would give much light: the evidence is limited, per frame and of all.
    gain = np.where(missed, np.minimum(log_ratio, 3.0), 0.0).sum(axis=1)
    gain -= np.logaddexp(math.log1p(-tuning.unlisted), math.log(tuning.unlisted) + gain)
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


#: Flags of measurements that are not light of the sky, or incomplete.
_NO_LIGHT = int(Flag.HOT | Flag.COSMIC | Flag.EDGE)


@dataclass(frozen=True)
class TrailTuning:
    """Parameters for measuring trails; chosen on injected ones (``scripts/bench movers --rounds``).

    Attributes
    ----------
    min_widths : minimum length, FWHM; shorter trails are measured as stars.
    max_px : maximum half-length; longer trails are of satellites and are removed.
    angles : number of directions that are tried.
    gain : minimum decrease of χ² by a trail against a star.
    min_sigmas : minimum significance of the length.
    hidden_widths : radius of excluded pixels around other sources, FWHM; larger for bright ones.
    gap : a trail ends where the light falls below this share of the maximum near the middle.
    max_fits : maximum number of fits per frame, the most significant candidates first.
    """

    min_widths: float = 0.8
    max_px: float = 60.0
    angles: int = 24
    gain: float = 30.0
    min_sigmas: float = 5.0
    hidden_widths: float = 1.2
    gap: float = 0.3
    max_fits: int = 100


TRAIL_TUNING = TrailTuning()


@dataclass(frozen=True)
class _Trail:
    """A fitted trail: its middle and half its vector, px, covariance (4, 4) of both, flux and its error."""

    middle: FloatArray
    half: FloatArray
    covariance: FloatArray
    flux: float
    flux_err: float

    @property
    def length(self) -> float:
        """Length, px."""
        return 2.0 * float(np.hypot(*self.half))

    def covers(self, at: FloatArray, width: float, beyond: float = 1.0) -> BoolArray:
        """(n,) mask of the pixels on the trail or up to ``beyond`` FWHM from its ends."""
        unit, off = 2.0 * self.half / self.length, at - self.middle
        along, across = off @ unit, off @ np.array([-unit[1], unit[0]])
        return np.asarray((np.abs(across) < 1.2 * width) & (np.abs(along) < 0.5 * self.length + beyond * width))

    def fainter_than(self, flux: float) -> float:
        """Its magnitude minus that of a flux; NaN of none."""
        return -2.5 * math.log10(self.flux / flux) if flux > 0 else math.nan

    def measured_on(self, exposure: Exposure, row: int) -> Exposure:
        """The exposure with this trail in place of a measurement."""

        def put(column: NDArray[Any], value: Any) -> NDArray[Any]:
            column = np.array(column)
            column[row] = value
            return column

        scale, spread = exposure.scale_arcsec_per_px, self.covariance[:2, :2]
        of_plate = (exposure.covariance[row] - scale**2 * exposure.covariance_px[row])[[0, 2]]
        plate = max(0.5 * float(of_plate.sum()), 0.0)
        sky = (plate + 0.5 * scale**2 * float(np.trace(spread))) * np.array([1.0, 0.0, 1.0])
        return replace(
            exposure, x_px=put(exposure.x_px, self.middle[0]), y_px=put(exposure.y_px, self.middle[1]),
            covariance_px=put(exposure.covariance_px, spread[[0, 0, 1], [0, 1, 1]]),
            covariance=put(exposure.covariance, sky), flux=put(exposure.flux, self.flux),
            flux_err=put(exposure.flux_err, self.flux_err),
            flags=put(exposure.flags, (exposure.flags[row] | int(Flag.TRAILED)) & ~int(Flag.POOR)),
            magnitude=put(exposure.magnitude, exposure.magnitude[row] + self.fainter_than(exposure.flux[row])),
        )  # fmt: skip


def with_trails(series: Series, frames: Iterable[Frame], tuning: TrailTuning = TRAIL_TUNING) -> Series:
    """The series with unexplained measurements remeasured as trails where these fit better.

    frames : calibrated, in the order of ``series.exposures``, used one at a time. Other measurements of parts of a
    trail are marked as unreliable, and so are all along lines of trails longer than ``max_px`` allows.
    """
    place, sigma, unreliable = series.place.copy(), series.sigma_arcsec.copy(), series.unreliable.copy()
    vector, error = np.full((len(place), 2), np.nan), np.full(len(place), np.nan)
    magnitude, exposures, long = series.magnitude.copy(), list(series.exposures), 0
    for n, frame in enumerate(frames):
        one = series.exposures[n]
        rows = np.flatnonzero(series.frame == n)
        at = np.column_stack([one.x_px, one.y_px])[series.row[rows]]
        flags = np.asarray(one.flags)[series.row[rows]]
        free = ~(series.star | series.stationary | series.fixed)[rows]
        tried = free & ((flags & _NO_LIGHT) == 0)
        if not tried.any() or len(rows) < 6:
            continue
        width = max(one.psf_fwhm_px, 1.5)
        pixels = _Pixels.of(frame, at[~free], one.snr[series.row[rows]][~free], width, tuning)
        to_sky = ChipMap(at, series.place[rows])
        done, measured, known = np.zeros(len(rows), bool), np.zeros(len(rows), bool), list[_Trail]()
        candidates = np.flatnonzero(tried)
        for k, start in pixels.candidates(at[candidates]):
            mine = int(candidates[k])
            if done[mine]:
                continue
            trail = pixels.fitted(at[mine], start)
            if trail is None:
                continue
            parts = free & trail.covers(at, width)
            again = any(one.covers(trail.middle[None], width)[0] for one in known)
            parts[mine] = True
            done |= parts
            unreliable[rows[parts & ~measured]] = True
            if again:
                continue
            row, own = rows[mine], int(series.row[rows[mine]])
            measured[mine], unreliable[row] = True, False
            known.append(trail)
            ends = to_sky(trail.middle + trail.half * np.array([[1.0], [-1.0], [0.0]]))
            place[row] = ends[2] + series.place[row] - to_sky(at[mine][None])[0]
            vector[row] = ends[0] - ends[1]
            scale = one.scale_arcsec_per_px
            error[row] = 2.0 * scale * math.sqrt(0.5 * np.trace(trail.covariance[2:, 2:]))
            sigma[row] = math.hypot(scale * math.sqrt(0.5 * np.trace(trail.covariance[:2, :2])), series.floor_arcsec[n])
            magnitude[row] += trail.fainter_than(one.flux[own])
            one = trail.measured_on(one, own)
        for line in _long_lines(known, width, 1.8 * tuning.max_px):
            now_at = np.column_stack([one.x_px, one.y_px])[series.row[rows]]
            parts = free & (known[line[0]].covers(at, width, math.inf) | known[line[0]].covers(now_at, width, math.inf))
            unreliable[rows[parts]], vector[rows[parts]], error[rows[parts]] = True, np.nan, np.nan
            long += 1
        exposures[n] = one
    note = f"{long} trails longer than {2 * tuning.max_px:.0f} px, as of satellites, are removed"
    return replace(
        series, place=place, sigma_arcsec=sigma, unreliable=unreliable, magnitude=magnitude, exposures=tuple(exposures),
        trails=Trails(vector, error, tuning.min_widths), notes=(*series.notes, *([note] if long else [])),
    )  # fmt: skip


def _long_lines(trails: list[_Trail], width: float, longest: float) -> list[list[int]]:
    """Groups of collinear trails that are together longer than any mover's, as of satellites cut by stars."""
    lines, remaining = [], set(range(len(trails)))
    for k, one in enumerate(trails):
        if k not in remaining:
            continue
        unit = 2.0 * one.half / one.length
        collinear = [
            m for m in sorted(remaining)
            if one.covers(trails[m].middle[None], width, math.inf)[0]
            and abs(float(trails[m].half @ np.array([-unit[1], unit[0]]))) < 0.1 * trails[m].length
        ]  # fmt: skip
        ends = [
            float((trails[m].middle + s * trails[m].half - one.middle) @ unit) for m in collinear for s in (-1.0, 1.0)
        ]
        if max(ends) - min(ends) > longest:
            lines.append(collinear)
            remaining -= set(collinear)
    return lines


@dataclass(frozen=True)
class _Pixels:
    """The pixels of a frame that is searched for trails.

    image : with excluded pixels at the sky level. good : (rows, columns) mask of usable pixels without known sources.
    smooth : the image after the matched filter of a star. noise : of a pixel. inverse_gain : photon variance over
    light. width : FWHM of a star, px.
    """

    image: FloatArray
    good: BoolArray
    smooth: FloatArray
    noise: float
    inverse_gain: float
    width: float
    tuning: TrailTuning

    @classmethod
    def of(
        cls, frame: Frame, sources: FloatArray, snr: FloatArray, width: float, tuning: TrailTuning = TRAIL_TUNING
    ) -> _Pixels:
        """The pixels of a frame. sources : (n, 2) pixels of known sources, excluded. snr : (n,)."""
        image = np.asarray(frame.image, np.float64).copy()
        good = ((frame.flags & (Flag.HOT | Flag.COSMIC | Flag.MASKED)) == 0) & np.isfinite(image)
        level = float(np.median(image[good][::7]))
        steps = np.diff(image[::3], axis=1)[good[::3, 1:] & good[::3, :-1]]
        noise = max(robust_scale(steps) / math.sqrt(2.0), 1e-9)
        radius = width * (tuning.hidden_widths + 0.6 * np.log10(np.maximum(snr / 10.0, 1.0)))
        for (x, y), r in zip(sources, radius, strict=True):
            a, b = max(int(y - r), 0), max(int(x - r), 0)
            v, u = np.mgrid[a : int(y + r) + 2, b : int(x + r) + 2]
            box = good[a : int(y + r) + 2, b : int(x + r) + 2]
            box &= ((u - x) ** 2 + (v - y) ** 2 > r * r)[: box.shape[0], : box.shape[1]]
        image[~good] = level
        sigma = width / FWHM_PER_SIGMA
        smooth = gaussian_filter(image.astype(np.float32), sigma, mode="nearest") - np.float32(level)
        gain = frame.facts.gain_e_per_adu
        return cls(
            image,
            good,
            smooth * (2 * math.sqrt(math.pi) * sigma / noise),
            noise,
            1.0 / gain if gain > 0 else 0.0,
            width,
            tuning,
        )

    def candidates(self, at: FloatArray) -> list[tuple[int, FloatArray]]:
        """The pixels (n, 2) that may be on a trail, as indices, the most significant first, with its ends (2, 2).

        The sum of the star's filter along a line, S = Σ s/√count, is used: a trail is tried if S² exceeds that of the
        star alone by half of the gain required of a fit.
        """
        steps = np.arange(1, max(int(self.tuning.max_px / self.width), 2) + 1) * self.width
        angle = np.arange(self.tuning.angles) * math.pi / self.tuning.angles
        direction = np.column_stack([np.cos(angle), np.sin(angle)])
        offsets = np.concatenate([-steps[::-1], [0.0], steps])
        points = at[:, None, None] + direction[None, :, None] * offsets[None, None, :, None]  # (n, angles, steps, 2)
        s = map_coordinates(self.smooth, [points[..., 1], points[..., 0]], order=1, mode="constant")
        # The local sky is the median along all lines.
        s = s - np.median(s, axis=(1, 2))[:, None, None]
        m = len(steps)
        # A trail has uniform brightness: it ends at a gap, and much brighter parts are other sources.
        top = np.max(s[..., max(m - 1, 0) : m + 2], axis=(1, 2))[:, None, None]
        s = np.minimum(s, 1.3 * np.maximum(top, 1.0))
        gap = s < np.maximum(self.tuning.gap * top, 0.5)
        gap = np.concatenate(
            [np.logical_or.accumulate(gap[..., :m][..., ::-1], axis=-1)[..., ::-1], np.zeros((*s.shape[:2], 1), bool),
             np.logical_or.accumulate(gap[..., m + 1 :], axis=-1)], axis=-1,
        )  # fmt: skip
        s = np.where(gap, -np.maximum(top, 1.0), s)
        left = np.concatenate([np.zeros((*s.shape[:2], 1)), np.cumsum(s[..., :m][..., ::-1], axis=-1)], axis=-1)
        right = np.concatenate([np.zeros((*s.shape[:2], 1)), np.cumsum(s[..., m + 1 :], axis=-1)], axis=-1)
        count = 1.0 + np.arange(m + 1)[:, None] + np.arange(m + 1)
        total = (left[..., :, None] + right[..., None, :] + s[..., m, None, None]) / np.sqrt(count)
        flat = total.reshape(len(at), -1)
        best = np.argmax(flat, axis=1)
        score = flat[np.arange(len(at)), best]
        best_angle, a, b = np.unravel_index(best, total.shape[1:])
        alone = np.maximum(s[:, 0, m], 0.0)
        order = np.argsort(-score)
        chosen = [k for k in order if score[k] > 0 and score[k] ** 2 - alone[k] ** 2 > 0.5 * self.tuning.gain]
        best = direction[best_angle]
        ends = [np.stack([at[k] - a[k] * self.width * best[k], at[k] + b[k] * self.width * best[k]]) for k in chosen]
        return list(zip(map(int, chosen), ends, strict=True))[: self.tuning.max_fits]

    def fitted(self, at: FloatArray, ends: FloatArray) -> _Trail | None:
        """The trail fitted from initial ends (2, 2); None if a star fits as well, or the fit fails."""
        from scipy.optimize import least_squares

        middle, half = ends.mean(axis=0), 0.5 * (ends[1] - ends[0])
        length = float(np.hypot(*half))
        direction = half / length if length > 0 else np.array([1.0, 0.0])
        reach = length + 2.5 * self.width
        a, b = (max(math.floor(v - reach), 0) for v in middle[::-1])
        c, d = (math.ceil(v + reach) + 1 for v in middle[::-1])
        v, u = np.mgrid[a : min(c, self.image.shape[0]), b : min(d, self.image.shape[1])]
        along = (u - middle[0]) * direction[0] + (v - middle[1]) * direction[1]
        across = (v - middle[1]) * direction[0] - (u - middle[0]) * direction[1]
        inside = self.good[v, u] & (np.abs(along) < reach) & (np.abs(across) < 2.5 * self.width)
        if inside.sum() < 30:
            return None
        u, v = u[inside].astype(float), v[inside].astype(float)
        light = self.image[v.astype(int), u.astype(int)]
        level = float(np.percentile(light, 30.0))
        flux = max(float((light - level).sum()), self.noise)
        error = np.sqrt(self.noise**2 + self.inverse_gain * np.maximum(light - level, 0.0))
        start = np.array([*middle, *(np.maximum(length, 0.5 * self.width) * direction), 1.0, 0.0])

        def misfit(values: FloatArray) -> FloatArray:
            model = _line(u, v, values[:2], values[2:4], self.width / FWHM_PER_SIGMA)
            return np.asarray((light - level - values[5] * self.noise - values[4] * flux * model) / error)

        def star(values: FloatArray) -> FloatArray:
            return misfit(np.array([values[0], values[1], 1e-3, 0.0, values[2], values[3]]))

        try:
            fit = least_squares(misfit, start, method="lm", max_nfev=150, ftol=1e-5, xtol=1e-4)
            point = least_squares(star, [*at, 1.0, 0.0], method="lm", max_nfev=60, ftol=1e-5, xtol=1e-4)
            covariance = inverse(fit.jac.T @ fit.jac)
        except (ValueError, np.linalg.LinAlgError):
            return None
        chi = max(2.0 * fit.cost / max(len(u) - 6, 1), 1.0)
        covariance *= chi
        half = fit.x[2:4]
        size = float(np.hypot(*half))
        if fit.x[4] <= 0 or not np.isfinite(fit.x).all() or size > 2.0 * reach:
            return None
        if not (np.diagonal(covariance) > 0.0).all():  # a parameter is undetermined, the inverse meaningless
            return None
        unit = half / max(size, 1e-9)
        spread = math.sqrt(max(float(unit @ covariance[2:4, 2:4] @ unit), 1e-12))
        gain = 2.0 * (point.cost - fit.cost) / chi
        long = 2.0 * size > self.tuning.min_widths * self.width and size > self.tuning.min_sigmas * spread
        if gain < self.tuning.gain or not long:
            return None
        trail = _Trail(fit.x[:2], half, covariance[:4, :4], float(fit.x[4] * flux),
                       float(flux * math.sqrt(covariance[4, 4])))  # fmt: skip
        # The fit may have moved to another source.
        return trail if trail.covers(at[None], self.width)[0] else None


def _line(u: FloatArray, v: FloatArray, middle: FloatArray, half: FloatArray, sigma: float) -> FloatArray:
    """(k,) fraction of the flux of a trail in pixels (u, v)."""
    from scipy.special import erf

    size = max(float(np.hypot(*half)), 1e-3)
    unit = half / size
    along = (u - middle[0]) * unit[0] + (v - middle[1]) * unit[1]
    across = (v - middle[1]) * unit[0] - (u - middle[0]) * unit[1]
    profile = np.exp(-0.5 * (across / sigma) ** 2) / (math.sqrt(2 * math.pi) * sigma)
    scale = math.sqrt(2.0) * sigma
    return np.asarray(profile * (erf((along + size) / scale) - erf((along - size) / scale)) / (4.0 * size))

"""Movers below the limit of single frames: the frames stacked along each motion on a grid of rates.

Synthetic tracking (Tyson et al. 1992; Shao et al. 2014, ApJ 782, 1; Whidden et al. 2019, AJ 157, 119). Each frame is
converted to a matched filter ψ = Σ k I/v and its variance φ = Σ k²/v, with k the star's profile and v the variance of
the sky; pixels of stars, defects and known tracklets get zero weight, and residual light of faint stars is subtracted
as the median of the frames. A motion with rate r through a position has T = Σψ/√Σφ over the frames, a standard normal
variable without light.

The number of chance peaks is measured: the same frames with a scrambled order of times have the same noise, defects and
residuals of stars, but no mover in line. Above u, the lowest of the hundred highest peaks there,
N(>T) = N_u (T/u)³ exp(−(T² − u²)/2s²), with the scale s fitted.

The probability of a candidate is λ/(λ + ν), with ν = −dN/dT the density of chance peaks and λ that of movers: their
numbers per magnitude grow with 10^0.4m (λ ∝ T⁻²), normalised by the movers linked above the limit, and with the rates
of the motion model. No light is used twice: tracklets are removed before, and a peak does not use the frames on which a
higher one passes it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates, maximum_filter
from scipy.special import expit

from sameas.arrays import ColumnTable, FloatArray, IntArray
from sameas.errors import InputError, naming
from sameas.kernels import threads
from sameas.kernels.linear import best_motion
from sameas.sky.frame.centroid import FWHM_PER_SIGMA, Background
from sameas.sky.frame.image import Frame
from sameas.sky.frame.measurements import POGSON, Flag
from sameas.sky.movers.detections import Detections
from sameas.sky.movers.rates import EclipticAxes, reference_rate, sun_longitude_deg
from sameas.sky.movers.search import ADDED, Movers
from sameas.sky.movers.stack import ChipMap, chip_map, predicted
from sameas.sky.series import Series

Plane = NDArray[np.float32]
#: Bytes per pixel of a frame: three planes, and the memory for the median of a strip.
_BYTES = 18
_NO_LIGHT = Flag.HOT | Flag.COSMIC | Flag.MASKED | Flag.SATURATED


MIN_FRAMES = 5  # minimum number of frames
STEP_WIDTHS = 0.5  # step of the rates, as the displacement on the first and last frame in FWHM of a star
MIN_WIDTHS = 2.5  # minimum motion over all frames, FWHM
HIDDEN_WIDTHS = 1.2  # radius of excluded pixels around sources, FWHM; larger for bright ones
#: Maximum signal of one frame, in its noise: residuals of stars reach 5 often, and are in line on two or three frames,
#: which made the tail of T 1.5 times as wide as that of noise; with 3 the tail is that of noise, and a mover of 2 on
#: each frame loses 4 %.
CLIP = 3.0
MEASURED_CLIP = 5.0  # the same for measuring candidates
STATIC = 2.5  # minimum significance on the median frame of static light that is removed
#: Noise around stars is averaged over this many FWHM, and increased where its variance exceeds the typical one by the
#: factor ROUGH.
BLUR_WIDTHS, ROUGH = 2.5, 1.2
SHARE = 0.5  # minimum share of the frames' weight at a position
PEAKS = 300  # maximum number of peaks
CHANCE = 100  # number of peaks of the scrambled frames for the tail
CERTAIN = 6.0  # peaks above this T are removed before scrambling
OWN_WIDTHS = 1.5  # a peak does not use frames on which a higher one is closer than this, FWHM
REFINED = 5.0  # peaks above this T are measured


MAX_BYTES = 600_000_000  # maximum memory for frames


@dataclass(frozen=True)
class Plan:
    """The plan of a search, made before it starts.

    rates : (r, 2) arcsec/min east and north. origin : (2,) position of the first pixel of the grid, arcsec. shape : of
    the grid, rows to the north. scale : arcsec per pixel of the grid. minutes : (f,) from the middle. strips : (s + 1,)
    row bounds. margin : rows of overlap on either side of a strip. width : FWHM of a star, px of the grid.
    """

    rates: FloatArray
    origin: FloatArray
    shape: tuple[int, int]
    scale: float
    minutes: FloatArray
    strips: tuple[int, ...]
    margin: int
    width: float

    @property
    def sums(self) -> float:
        """Number of pixel additions, for the frames and the scrambled ones."""
        return 2.0 * len(self.rates) * math.prod(self.shape) * len(self.minutes)

    @property
    def peak_bytes(self) -> int:
        """Memory for the frames of a strip, including its median, bytes."""
        rows = max(b - a for a, b in zip(self.strips, self.strips[1:], strict=False)) + 2 * self.margin
        return _BYTES * len(self.minutes) * min(rows, self.shape[0]) * self.shape[1]

    @classmethod
    def of(cls, series: Series, fastest: float, max_bytes: int = MAX_BYTES) -> Plan:
        """The plan for a series. fastest : maximum rate, arcsec/min. max_bytes : maximum memory for frames.

        Raises InputError: too few frames; a maximum rate below the slowest one that can be distinguished from a star.
        """
        if len(series.exposures) < MIN_FRAMES:
            raise InputError(
                f"{len(series.exposures)} frames: stacking needs at least {MIN_FRAMES}",
                naming("leave {below_limit} out"),
            )
        scale = series.scale_arcsec_per_px
        minutes = np.array([e.mjd_utc for e in series.exposures]) * 1440.0
        minutes -= 0.5 * (minutes[0] + minutes[-1])
        half = float(minutes[-1])
        width = float(np.median([max(e.psf_fwhm_px * e.scale_arcsec_per_px / scale, 1.5) for e in series.exposures]))
        slowest = MIN_WIDTHS * width * scale / (2.0 * half)
        if not fastest > slowest:
            raise InputError(
                f"{fastest:g}″/min: over {2 * half:.0f} minutes motion slower than {slowest:.2f}″/min is less "
                "than the PSF width needed", naming("give {below_limit:RATE}, a higher one"),
            )  # fmt: skip
        step = STEP_WIDTHS * width * scale / half
        count = math.ceil(fastest / step)
        east, north = np.meshgrid(*2 * [np.arange(-count, count + 1) * step])
        rates = np.column_stack([east.ravel(), north.ravel()])
        speed = np.hypot(*rates.T)
        rates = rates[(speed <= fastest + 0.5 * step) & (speed >= slowest)]
        middle = len(series.exposures) // 2
        rows, columns = series.exposures[middle].shape
        edge = np.array([[x, y] for x in np.linspace(0, columns - 1, 9) for y in np.linspace(0, rows - 1, 9)])
        place = _to_sky(series, middle)(edge)
        origin = place.min(axis=0)
        wide, high = np.ceil((place.max(axis=0) - origin) / scale).astype(int) + 1
        margin = math.ceil((fastest + step) * half / scale) + 1
        room = max_bytes // (_BYTES * len(minutes) * wide) - 2 * margin
        strips = max(1, math.ceil(high / max(room, 64)))
        bounds = tuple(int(v) for v in np.linspace(0, high, strips + 1))
        return cls(rates, origin, (int(high), int(wide)), scale, minutes, bounds, margin, width)


@dataclass(frozen=True)
class BelowLimit:
    """Movers found in the stacked frames only; (k,) the most probable first.

    movers : each as three positions, from stacks of the first, middle and last frames along its motion. snr : of all
    frames together. frames : number of frames used. flux : on the scale of the mean frame. place : (k, f, 2) predicted,
    arcsec in the system of the series. tail : N_u, u and s of the chance peaks. plan : of the search.
    """

    movers: Movers
    snr: FloatArray
    frames: IntArray
    flux: FloatArray
    place: FloatArray
    tail: tuple[float, float, float]
    plan: Plan

    def __len__(self) -> int:
        return len(self.movers)


@dataclass(frozen=True)
class _Peaks(ColumnTable):
    """Peaks, (n,).

    t : T of the search, comparable with chance peaks. place : (n, 2) arcsec at the middle of the time. rate : (n, 2)
    arcsec/min. signal, weight : (n, f) ψ and φ. snr, flux : measured to a fraction of a pixel. parts : (n, 3, 3) of the
    first, middle and last frames: offset east and north from the motion, arcsec, and signal to noise.
    """

    t: FloatArray
    place: FloatArray
    rate: FloatArray
    signal: FloatArray
    weight: FloatArray
    snr: FloatArray
    flux: FloatArray
    parts: FloatArray

    def path(self, minutes: FloatArray) -> FloatArray:
        """(n, f, 2) positions at these times, arcsec."""
        return _path(self.place, self.rate, minutes)


def search_below_limit(
    movers: Movers,
    series: Series,
    frames: Sequence[Callable[[], Frame]],
    fastest: float,
    *,
    min_probability: float = 0.5,
    max_bytes: int = MAX_BYTES,
) -> BelowLimit:
    """Movers that are visible in the stacked frames but on no single one.

    movers : the tracklets of the series, whose light is excluded, and whose motion model is used. frames : functions
    that return the calibrated frames in the order of ``series.exposures``; each is read once per strip. fastest :
    maximum rate, arcsec/min; the cost grows with its square (:class:`Plan`). max_bytes : maximum memory for frames.

    Raises InputError: fewer than five frames; a rate that is too low.
    """
    plan = Plan.of(series, fastest, max_bytes)
    known = predicted(movers, series), _signal_to_noise(movers, series)
    real, chance = [], []
    order = _scrambled(len(plan.minutes))
    groups = _thirds(len(plan.minutes))
    for first, last in zip(plan.strips, plan.strips[1:], strict=False):
        low, high = max(first - plan.margin, 0), min(last + plan.margin, plan.shape[0])
        planes = _planes(series, frames, plan, (low, high), known)
        core = (first - low, last - low)
        strip = _Strip(plan, *planes, plan.origin + np.array([0.0, low * plan.scale]), core)
        peaks = strip.peaks(plan.minutes)
        own_frames = _with_own_frames(peaks, plan.minutes, plan)
        real.append(strip.measured_peaks(own_frames, groups))
        strip.remove(own_frames.take(own_frames.t > CERTAIN))
        chance.append(_with_own_frames(strip.peaks(plan.minutes[order]), plan.minutes[order], plan))
    peaks = _with_own_frames(real[0].stacked(*real[1:]), plan.minutes, plan)
    chance_peaks = chance[0].stacked(*chance[1:])
    tail = _tail(chance_peaks.t)
    speed = np.hypot(*chance_peaks.rate[np.argsort(-chance_peaks.t)[:CHANCE]].T)
    return _answer(movers, series, plan, peaks, tail, _Speeds.of(speed, plan), min_probability)


def _to_sky(series: Series, n: int) -> ChipMap:
    """The map from pixels of a frame to arcsec."""
    in_frame, exposure = series.frame == n, series.exposures[n]
    return ChipMap(np.column_stack([exposure.x_px, exposure.y_px])[series.row[in_frame]], series.place[in_frame])


def _planes(
    series: Series, frames: Sequence[Callable[[], Frame]], plan: Plan, rows: tuple[int, int],
    known: tuple[FloatArray, FloatArray]) -> tuple[Plane, Plane, Plane]:  # fmt: skip
    """(f, h, w) ψ and φ of all frames on rows of the grid, with static light removed; and ψ for measuring candidates.

    known : (k, f, 2) positions of tracklets and (k,) their signal to noise."""
    height, width = rows[1] - rows[0], plan.shape[1]
    signal = np.zeros((len(frames), height, width), np.float32)
    weight = np.zeros_like(signal)
    north, east = np.mgrid[rows[0] : rows[1], 0:width].astype(np.float32)
    place = np.stack([east, north], axis=-1).reshape(-1, 2) * plan.scale + plan.origin
    zero = series.stars.zero_point
    factor = 10 ** (-0.4 * np.nan_to_num(np.where(np.isfinite(zero), np.nanmean(zero) - zero, 0.0))) if np.isfinite(
        zero).any() else np.ones(len(frames))  # fmt: skip
    for n, give in enumerate(frames):
        chip = chip_map(series, n)(place)
        psi, phi = _filtered(give(), series, n, known[0][:, n], known[1])
        at = [chip[:, 1], chip[:, 0]]
        for out, plane, scale in ((signal, psi, factor[n]), (weight, phi, factor[n] ** 2)):
            out[n] = (map_coordinates(plane, at, order=1, cval=0.0) * scale).reshape(height, width)
    _without_static(signal, weight, plan.width)
    # The signal of one frame is limited, more strictly in the search.
    measured = signal.copy()
    for plane, most in ((signal, CLIP), (measured, MEASURED_CLIP)):
        for psi, phi in zip(plane, weight, strict=True):
            bound = most * np.sqrt(phi)
            np.clip(psi, -bound, bound, out=psi)
    return signal, weight, measured


def _signal_to_noise(movers: Movers, series: Series) -> FloatArray:
    """(k,) largest signal to noise among the detections of each tracklet."""
    snr = series.measured("snr", movers.detections.rows)
    return np.array([float(snr[one[one >= 0]].max()) for one in movers.members])


def _filtered(frame: Frame, series: Series, n: int, movers: FloatArray, mover_snr: FloatArray) -> tuple[Plane, Plane]:
    """ψ and φ of one frame in its pixels. movers : (k, 2) positions of tracklets, arcsec. mover_snr : (k,)."""
    exposure = series.exposures[n]
    fwhm = max(exposure.psf_fwhm_px, 1.5)
    sigma = fwhm / FWHM_PER_SIGMA
    background = Background.of(frame)
    inverse = np.where(np.isfinite(background.variance), 1.0 / background.variance, 0.0).astype(np.float32)
    inverse[(frame.flags & _NO_LIGHT) != 0] = 0.0
    in_frame = np.flatnonzero(series.frame == n)
    known_sources = in_frame[(series.star | series.stationary | series.fixed | series.unreliable)[in_frame]]
    chip = np.column_stack([exposure.x_px, exposure.y_px])[series.row[known_sources]]
    snr = np.nan_to_num(exposure.snr[series.row[known_sources]], nan=10.0)
    to_chip = chip_map(series, n)
    for place, light in ((series.stars.place, np.full(len(series.stars), 10.0)), (movers, mover_snr)):
        if len(place):
            chip, snr = np.concatenate([chip, to_chip(place)]), np.concatenate([snr, light])
    snr = np.maximum(snr, 10.0)
    # The wings of a star fall with the fifth power (Moffat, β 2.5); beyond this radius they are far below the noise.
    reach = fwhm * np.maximum(HIDDEN_WIDTHS, 0.5 * (5.0 * snr) ** 0.2)
    _hide(inverse, chip, reach)
    light = (frame.image - background.level) * inverse
    psi = gaussian_filter(light, sigma, mode="constant", truncate=3.5)
    # k² of a Gaussian is a Gaussian narrower by √2.
    phi = gaussian_filter(inverse, sigma / math.sqrt(2.0), mode="constant", truncate=3.5) / (4 * math.pi * sigma**2)
    typical = float(np.median(phi[phi > 0])) if (phi > 0).any() else 0.0
    phi[phi < SHARE * typical] = 0.0
    psi[phi == 0] = 0.0
    normalise(psi, phi)
    return psi, phi


def _hide(inverse: Plane, at: FloatArray, reach: FloatArray) -> None:
    """Sets the weight to zero within radii (m,) of pixels (m, 2)."""
    rows, columns = inverse.shape
    for (x, y), r in zip(at, reach, strict=True):
        a, b, c, d = max(int(y - r), 0), max(int(x - r), 0), min(int(y + r) + 2, rows), min(int(x + r) + 2, columns)
        if a < c and b < d:
            v, u = np.mgrid[a:c, b:d]
            inverse[a:c, b:d][(u - x) ** 2 + (v - y) ** 2 <= r * r] = 0.0


def normalise(psi: Plane, phi: Plane, box: int = 64) -> None:
    """Normalises ψ/√φ to mean 0 and width 1 in each box, for correlated noise and diffuse light; in place."""
    if not (phi > 0).any():
        return
    z = psi / np.sqrt(np.where(phi > 0, phi, 1.0))
    whole = _level_and_scale(z[phi > 0])
    boxes = [max(1, round(n / box)) for n in psi.shape]
    bounds = [np.linspace(0, n, count + 1).astype(int) for n, count in zip(psi.shape, boxes, strict=True)]
    level, scale = np.full(boxes, whole[0], np.float32), np.full(boxes, whole[1], np.float32)
    measured = np.zeros(boxes, bool)
    for a in range(boxes[0]):
        for b in range(boxes[1]):
            part = slice(*bounds[0][a : a + 2]), slice(*bounds[1][b : b + 2])
            good = phi[part] > 0
            # A box with few pixels between stars gives no reliable scale.
            if good.mean() > 0.25:
                level[a, b], scale[a, b] = _level_and_scale(z[part][good])
                measured[a, b] = True
    # The scale of the whole frame includes variations of the sky; it is used only where a box has none.
    least = 0.6 * float(np.median(scale[measured])) if measured.any() else whole[1]
    rows, columns = ((np.arange(n) + 0.5) * count / n - 0.5 for n, count in zip(psi.shape, boxes, strict=True))
    grid = np.meshgrid(rows, columns, indexing="ij")
    local_level, local_scale = (map_coordinates(one, grid, order=1, mode="nearest") for one in (level, scale))
    local_scale = np.maximum(local_scale, least)
    psi[:] = np.where(phi > 0, (z - local_level) * np.sqrt(phi) / local_scale**2, 0.0)
    phi /= local_scale**2


def _level_and_scale(z: FloatArray) -> tuple[float, float]:
    """Median and width of deviates; mostly from the lower side, as light of stars widens the upper one."""
    low, middle, high = np.percentile(z, [15.87, 50.0, 84.13])
    return float(middle), max(float(middle - low), 0.5 * float(high - low), 0.1)


def _without_static(signal: Plane, weight: Plane, width: float) -> None:
    """Subtracts significant light of the median frame, and increases the noise where the frames differ; in place."""
    typical_sq = np.zeros(signal.shape[1:], np.float32)
    for row in range(signal.shape[1]):
        psi, phi = signal[:, row], weight[:, row]
        present = phi > 0
        flux, inverse = np.where(present, psi / np.where(present, phi, 1.0), np.inf), np.sqrt(phi)
        middle = _medians(flux, present)
        clear = np.abs(middle) * np.sqrt(phi.sum(axis=0)) > 1.2533 * STATIC
        psi -= np.where(clear, middle, 0.0).astype(np.float32) * phi
        typical_sq[row] = _medians(np.where(present, (psi / np.where(present, inverse, 1.0)) ** 2, np.inf), present)
    # Differences between most frames are noise (seeing, wings of stars): a mover is at a pixel on few frames.
    measured = (typical_sq > 0).astype(np.float32)
    blur_px = BLUR_WIDTHS * width / FWHM_PER_SIGMA
    mean = gaussian_filter(typical_sq, blur_px) / np.maximum(gaussian_filter(measured, blur_px), 1e-3)
    if measured.any():
        mean /= float(np.median(mean[measured > 0]))
    # Smaller excesses are within the uncertainty of the median of few frames.
    excess = np.maximum(mean / ROUGH, 1.0)
    for psi, phi in zip(signal, weight, strict=True):
        psi /= excess
        phi /= excess


def _medians(values: FloatArray, present: NDArray[np.bool_]) -> FloatArray:
    """(w,) medians of the present values of each column; 0 with fewer than two values."""
    count, columns = present.sum(axis=0), np.arange(values.shape[1])
    ordered = np.sort(values, axis=0)
    low, high = np.maximum((count - 1) // 2, 0), np.minimum(count // 2, len(values) - 1)
    with np.errstate(invalid="ignore"):
        return np.where(count > 1, 0.5 * (ordered[low, columns] + ordered[high, columns]), 0.0)


class _Strip:
    """The planes of a strip of the grid, and the search for peaks in them."""

    def __init__(
        self, plan: Plan, signal: Plane, weight: Plane, measured: Plane, origin: FloatArray, core: tuple[int, int]
    ) -> None:
        self.plan, self.signal, self.weight, self.origin, self.core = plan, signal, weight, origin, core
        self.measured = measured
        self.usual = sum(float(np.median(p[p > 0])) if (p > 0).any() else 0.0 for p in weight[:, ::5, ::5])

    def shifts(self, minutes: FloatArray) -> tuple[IntArray, IntArray]:
        """(r, f) shift of each rate on each frame, in rows and columns."""
        shift = np.rint(self.plan.rates[:, None] * minutes[None, :, None] / self.plan.scale).astype(np.int64)
        return np.ascontiguousarray(shift[..., 1]), np.ascontiguousarray(shift[..., 0])

    def peaks(self, minutes: FloatArray) -> _Peaks:
        """The highest peaks for frames at these times, in descending order."""
        down, right = self.shifts(minutes)
        shape = self.signal.shape[1:]
        best, which = np.zeros(shape, np.float32), np.zeros(shape, np.int64)
        first, last = self.core
        bounds = [first + b for b in threads.even(last - first, 8)]
        threads.over(
            lambda a, b: best_motion(self.signal, self.weight, down, right, SHARE * self.usual, a, b, best, which),
            bounds,
        )
        size = 2 * math.ceil(self.plan.width) + 1
        top = (best == maximum_filter(best, size)) & (best > 0)
        v, u = np.nonzero(top)
        order = np.argsort(-best[v, u], kind="stable")[:PEAKS]
        v, u = v[order], u[order]
        start = self.origin + np.column_stack([u, v]) * self.plan.scale
        place, speed = self._climbed(self.signal, start, self.plan.rates[which[v, u]], minutes)
        psi, phi = self._sampled(self.signal, _path(place, speed, minutes))
        t, none = _stacked_t(psi, phi), np.full(len(v), np.nan)
        return _Peaks(t, place, speed, psi, phi, t, none, np.full((len(v), 3, 3), np.nan))

    def _sampled(self, signal: Plane, place: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(n, f) ψ and φ at positions (n, f, 2), bilinear."""
        at = (place - self.origin) / self.plan.scale
        x, y = (np.clip(at[..., k], 0, signal.shape[2 - k] - 1.001) for k in (0, 1))
        a, b, frames = y.astype(int), x.astype(int), np.arange(at.shape[-2])
        p, q = y - a, x - b
        outside = (np.abs(at[..., 0] - x) > 1.0) | (np.abs(at[..., 1] - y) > 1.0)
        out = []
        for plane in (signal, self.weight):
            value = (1 - p) * ((1 - q) * plane[frames, a, b] + q * plane[frames, a, b + 1])
            value += p * ((1 - q) * plane[frames, a + 1, b] + q * plane[frames, a + 1, b + 1])
            out.append(np.where(outside, 0.0, value))
        return out[0], out[1]

    def _climbed(
        self, signal: Plane, place: FloatArray, rate: FloatArray, minutes: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Positions and rates of peaks (n, 2) at the local maximum of T, by decreasing steps up to one width away."""
        reach, half = self.plan.width * self.plan.scale, float(np.abs(minutes).max())
        start = np.column_stack([place, rate * half])
        least = SHARE * self.usual

        def height(x: FloatArray) -> FloatArray:
            psi, phi = self._sampled(signal, _path(x[..., :2], x[..., 2:] / half, minutes))
            return np.where(phi.sum(axis=-1) > least, _stacked_t(psi, phi), -np.inf)

        directions = np.vstack([np.zeros(4), np.eye(4), -np.eye(4)])
        x = start.copy()
        for step in (0.3, 0.3, 0.15, 0.15, 0.15, 0.07, 0.07, 0.07, 0.03, 0.03):
            trials = x[:, None] + step * reach * directions
            heights = height(trials)
            heights[(np.abs(trials - start[:, None]) > reach).any(axis=-1)] = -np.inf
            heights[:, 0] = np.maximum(heights[:, 0], -1e9)
            x = trials[np.arange(len(x)), heights.argmax(axis=1)]
        return x[:, :2], x[:, 2:] / half

    def measured_peaks(self, peaks: _Peaks, groups: Sequence[IntArray]) -> _Peaks:
        """The higher peaks measured, with their parts; T is kept, to be comparable with that of chance peaks."""
        high = np.flatnonzero(peaks.t > REFINED)
        minutes, reach = self.plan.minutes, self.plan.width * self.plan.scale
        place, rate = peaks.place.copy(), peaks.rate.copy()
        place[high], rate[high] = self._climbed(self.measured, place[high], rate[high], minutes)
        snr, flux, parts = peaks.snr.copy(), peaks.flux.copy(), peaks.parts.copy()
        path = _path(place[high], rate[high], minutes)
        psi, phi = self._sampled(self.measured, path)
        snr[high], flux[high] = _stacked_t(psi, phi), psi.sum(axis=1) / np.maximum(phi.sum(axis=1), 1e-30)
        grid = np.linspace(-0.6, 0.6, 13) * reach
        around = np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2)
        for k, at in zip(high, path, strict=True):
            # For the first, middle and last frames: the maximum within about half a width.
            psi, phi = self._sampled(self.measured, at[None] + around[:, None])
            for g, frames in enumerate(groups):
                t = _stacked_t(psi[:, frames], phi[:, frames])
                parts[k, g] = [*around[int(np.argmax(t))], t.max()]
        return replace(peaks, place=place, rate=rate, snr=snr, flux=flux, parts=parts)

    def remove(self, peaks: _Peaks) -> None:
        """Sets the weight to zero along these peaks."""
        for at in (peaks.path(self.plan.minutes) - self.origin) / self.plan.scale:
            for n, one in enumerate(at):
                _hide(self.weight[n], one[None], np.array([1.5 * self.plan.width]))
                self.signal[n][self.weight[n] == 0] = 0.0


def _path(place: FloatArray, rate: FloatArray, minutes: FloatArray) -> FloatArray:
    """(…, f, 2) positions at some times of motions (…, 2)."""
    return np.asarray(place[..., None, :] + minutes[:, None] * rate[..., None, :])


def _stacked_t(psi: FloatArray, phi: FloatArray) -> FloatArray:
    """T of ψ and φ (…, f), stacked over the frames."""
    return np.asarray(psi.sum(axis=-1) / np.sqrt(np.maximum(phi.sum(axis=-1), 1e-30)))


def _with_own_frames(peaks: _Peaks, minutes: FloatArray, plan: Plan) -> _Peaks:
    """The peaks, the highest first, each without the frames on which a higher one passes it, with the remaining T."""
    peaks = peaks.take(np.argsort(-peaks.t, kind="stable"))
    path = peaks.path(minutes)
    reach = OWN_WIDTHS * plan.width * plan.scale
    kept, t = list[int](), peaks.t.copy()
    weight, signal = peaks.weight.copy(), peaks.signal.copy()
    floor = float(peaks.t.min(initial=math.inf))
    for k in range(len(peaks.t)):
        if kept:
            near = (np.hypot(*(path[kept] - path[k]).transpose(2, 0, 1)) < reach).any(axis=0)
            if near.any():
                weight[k, near] = signal[k, near] = 0.0
                remaining = float(weight[k].sum())
                # It must keep at least this share of its weight.
                enough = remaining > SHARE * float(peaks.weight[k].sum())
                t[k] = signal[k].sum() / math.sqrt(remaining) if enough else 0.0
        if t[k] >= floor:
            kept.append(k)
    rows = np.array(kept, np.int64)
    return replace(peaks.take(rows), t=t[rows], weight=weight[rows], signal=signal[rows])


def _scrambled(frames: int) -> IntArray:
    """A scrambled order of the frames: of a thousand the least similar to the true one or its reverse."""
    rng, t = np.random.default_rng(0), np.arange(frames)
    orders = [rng.permutation(frames) for _ in range(1000)]

    def similarity(order: IntArray) -> float:
        # Consecutive frames that stay consecutive keep parts of a motion in line.
        adjacent = float((np.abs(np.diff(order)) == 1).mean())
        return adjacent + abs(float(np.corrcoef(order, t)[0, 1]))

    return np.asarray(min(orders, key=similarity))


def _thirds(frames: int) -> list[IntArray]:
    return [np.asarray(part) for part in np.array_split(np.arange(frames), 3)]


def _tail(t: FloatArray) -> tuple[float, float, float]:
    """N_u, u and s of N(>T) = N_u (T/u)³ exp(−(T² − u²)/2s²)."""
    t = np.sort(t)[::-1][:CHANCE]
    if len(t) < 10:
        return 1.0, 5.0, 1.0
    u = float(t[-1])
    scales = np.geomspace(0.9, 3.0, 121)
    # Prior of the scale: 1 (pure noise) within 20 %.
    score = [float(_log_rate(t, u, s).sum()) - 0.5 * (math.log(s) / 0.2) ** 2 for s in scales]
    return float(len(t)), u, float(scales[int(np.argmax(score))])


def _log_tail(t: FloatArray, u: float, s: float) -> FloatArray:
    """ln N(>T)/N_u."""
    return np.asarray(3.0 * np.log(np.maximum(t, 1e-9) / u) - (t**2 - u**2) / (2 * s * s))


def _log_rate(t: FloatArray, u: float, s: float) -> FloatArray:
    """ln of −dN/dT / N_u."""
    return np.asarray(_log_tail(t, u, s) + np.log(np.maximum(t / s**2 - 3.0 / np.maximum(t, 1e-9), 1e-3)))


@dataclass(frozen=True)
class _Speeds:
    """Speeds of chance peaks relative to a uniform distribution over the rates: residuals of stars make slow ones.

    edge : (b + 1,) arcsec/min. log_ratio : (b,) natural logarithms.
    """

    edge: FloatArray
    log_ratio: FloatArray

    @classmethod
    def of(cls, speed: FloatArray, plan: Plan, bins: int = 6) -> _Speeds:
        speeds_of_plan = np.hypot(*plan.rates.T)
        edge = np.geomspace(speeds_of_plan.min(), speeds_of_plan.max(), bins + 1)
        edge[0], edge[-1] = 0.0, np.inf
        share = np.histogram(speeds_of_plan, edge)[0] / len(speeds_of_plan)
        count = np.histogram(speed, edge)[0]
        # Three pseudo-counts, distributed as the rates.
        return cls(edge, np.log((count + 3.0) / (len(speed) * share + 3.0)))

    def __call__(self, speed: FloatArray) -> FloatArray:
        return np.asarray(self.log_ratio[np.digitize(speed, self.edge) - 1])


def _answer(
    found: Movers, series: Series, plan: Plan, peaks: _Peaks, tail: tuple[float, float, float], speeds: _Speeds,
    least: float,
) -> BelowLimit:  # fmt: skip
    """The peaks with their probabilities, those of at least ``least`` as movers."""
    n_chance, u, s = tail
    at_rate = math.log(n_chance) + speeds(np.hypot(*peaks.rate.T))
    log_chance = at_rate + _log_tail(peaks.t, u, s)
    # T of a mover at the limit of a single frame; the linked movers are the brighter ones.
    limit = 5.0 * math.sqrt(len(plan.minutes))
    linked = 0.5 + float(found.p_tracklet.sum())
    log_mover = (
        math.log(linked * limit) - 2.0 * np.log(np.maximum(peaks.t, 1e-9)) + _rate_ratio(found, series, plan, peaks)
    )
    log_weight = log_mover - (log_chance + np.log(np.maximum(peaks.t, 1e-9) / s**2))
    p = np.asarray(expit(log_weight))
    keep = np.flatnonzero((p >= least) & np.isfinite(peaks.parts).all(axis=(1, 2)) & (peaks.t > u))
    keep = keep[np.argsort(-p[keep], kind="stable")]
    chosen = peaks.take(keep)
    path = chosen.path(plan.minutes)
    movers = _movers(found, series, plan, chosen, p[keep], log_weight[keep], np.exp(log_chance[keep]))
    return BelowLimit(movers, chosen.snr, (chosen.weight > 0).sum(axis=1), chosen.flux, path, tail, plan)


def _rate_ratio(movers: Movers, series: Series, plan: Plan, peaks: _Peaks) -> FloatArray:
    """(n,) ln ratio of the model's rate density to the uniform one of chance."""
    if not len(peaks.t):
        return np.empty(0)
    ra, dec = series.sky(peaks.place)
    axes = EclipticAxes.of(ra, dec)
    mjd = np.full(len(ra), np.mean([e.mjd_utc for e in series.exposures]))
    cos, sin = axes.rotation.T
    east, north = peaks.rate.T
    rate = np.column_stack([cos * east + sin * north, cos * north - sin * east])
    rate[:, 0] -= reference_rate(axes.longitude_deg - sun_longitude_deg(mjd))
    error = (0.5 * plan.width * plan.scale / np.ptp(plan.minutes)) ** 2 * np.eye(2)[None].repeat(len(ra), axis=0)
    fastest = float(np.hypot(*plan.rates.T).max())
    return np.asarray(movers.model.rates.log_density(rate, error) + math.log(math.pi * fastest**2))


def _movers(
    movers: Movers, series: Series, plan: Plan, peaks: _Peaks, p: FloatArray, log_weight: FloatArray, chance: FloatArray
) -> Movers:
    """The candidates as tracklets of three positions, of the first, middle and last frames."""
    groups, k = _thirds(len(plan.minutes)), len(p)
    names = tuple(f"frames {g[0] + 1}–{g[-1] + 1} stacked" for g in groups)
    if not k:
        return replace(movers, prefix=ADDED).only(np.empty(0, np.int64))
    mjd0 = 0.5 * (series.exposures[0].mjd_utc + series.exposures[-1].mjd_utc)
    minutes, places, sigma = np.empty((k, 3)), np.empty((k, 3, 2)), np.empty((k, 3))
    for g, rows in enumerate(groups):
        weight = np.maximum(peaks.weight[:, rows], 1e-12)
        minutes[:, g] = (weight * plan.minutes[rows]).sum(axis=1) / weight.sum(axis=1)
        places[:, g] = peaks.place + minutes[:, g, None] * peaks.rate + peaks.parts[:, g, :2]
        # Centroid error of a Gaussian star limited by the sky: √2 σ over the signal to noise.
        sigma[:, g] = math.sqrt(2.0) * plan.width / FWHM_PER_SIGMA * plan.scale / np.maximum(peaks.parts[:, g, 2], 1.0)
    ra, dec = series.sky(places.reshape(-1, 2))
    zero = series.stars.zero_point
    magnitude = (
        np.nanmean(zero) - 2.5 * np.log10(np.maximum(peaks.flux, 1e-9))
        if np.isfinite(zero).any()
        else np.full(k, np.nan)
    )
    detections = Detections.of(
        ra, dec, (mjd0 + minutes / 1440.0).ravel(), sigma_arcsec=sigma.ravel(),
        frame=np.tile([0, 1, 2], k), magnitude=np.repeat(magnitude, 3),
        magnitude_error=np.repeat(POGSON / np.maximum(peaks.snr, 1.0), 3), name="frames stacked along motions",
    )  # fmt: skip
    detections = replace(detections, frame_names=names)
    members = np.arange(3 * k).reshape(k, 3)
    p_member = np.repeat(p[:, None], 3, axis=1)
    return Movers(
        detections=detections, model=movers.model, members=members, p_tracklet=p, p_exact=p, p_member=p_member,
        log_weight=log_weight, expected_chance=chance, gap=0.0, state=np.zeros((k, 6)), n_covered=np.full(k, 3),
        log_missed=np.zeros(k), prefix=ADDED,
    )  # fmt: skip

"""Trails of sources that move during an exposure, measured in the pixels.

Windows as wide as a star detect parts of a trail, or do not converge, and beside a brighter star they detect nothing
(:func:`with_trails`). Unexplained measurements, and the maxima that remain without the known stars, are tested as
trails: first by sums of the matched filter along lines through them, then by a fit of a Gaussian star moving uniformly
along a straight line,

    I(a, c) = F/L · exp(−c²/2σ²)/(√2π σ) · ½ [erf((a + L/2)/√2σ) − erf((a − L/2)/√2σ)],

a along and c across the trail, L its length (Vereš et al. 2012, PASP 124, 1197). Its middle is the position at the
middle of the exposure; its length and angle give the rate except for the sign, evidence for the links.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.spatial import cKDTree

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.gaussian import inverse
from sameas.kernels.frames import local_maxima
from sameas.sky.frame.centroid import FWHM_PER_SIGMA, Background
from sameas.sky.frame.detect import without_stars
from sameas.sky.frame.image import Frame
from sameas.sky.frame.measurements import Flag
from sameas.sky.movers.below_limit import normalise
from sameas.sky.movers.stack import ChipMap
from sameas.sky.series import Exposure, Series, Streak, Trails

if TYPE_CHECKING:
    from astropy.table import Table

#: Flags of measurements that are not light of the sky, or incomplete.
_NO_LIGHT = int(Flag.HOT | Flag.COSMIC | Flag.EDGE)
#: Share of a star's light that has to be on usable pixels (chosen).
_LEAST_SHARE = 0.3
#: Number of pixels whose lines are summed at once, which bounds the memory (50 MB).
_AT_ONCE = 500


# Parameters for measuring trails; chosen on injected ones (``scripts/bench movers --rounds``).
MIN_WIDTHS = 0.8  # minimum length, FWHM; shorter trails are measured as stars
MAX_PX = 60.0  # maximum half-length; longer trails are of satellites and are not linked
ANGLES = 24  # number of directions that are tried
GAIN = 30.0  # minimum decrease of χ² by a trail against a star
MIN_SIGMAS = 5.0  # minimum significance of the length
HIDDEN_WIDTHS = 1.2  # radius of excluded pixels around other sources, FWHM; larger for bright ones
STAR_SHARE = 0.05  # minimum error of the light of a subtracted star, as a share of it
LEAST_STEP = 0.8  # no mover's trails are closer in two frames than this share of their length
SEED_SIGMAS = 2.5  # trails are also sought through the maxima of what is left, above this many standard deviations
#: Minimum gain, as a share of GAIN, of a line through a measurement or such a maximum before a trail is fitted.
TRIED, TRIED_UNMEASURED = 0.35, 0.8
GAP = 0.3  # a trail ends where the light falls below this share of the maximum near the middle
MAX_FITS = 100  # maximum number of fits per frame, the most significant candidates first
STREAK_SNR, STREAK_WIDTHS = 10.0, 5.0  # minimum of a streak, length in FWHM: pairs of stars on ten real frames reach 4


@dataclass(frozen=True)
class _Trail:
    """A fitted trail: its middle and half its vector, px, covariance (4, 4) of both, flux and its error.

    sharp : a line of half the width of a star fits better, as of a particle.
    """

    middle: FloatArray
    half: FloatArray
    covariance: FloatArray
    flux: float
    flux_err: float
    sharp: bool

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
            flux_err=put(exposure.flux_err, self.flux_err), snr=put(exposure.snr, self.flux / self.flux_err),
            flags=put(exposure.flags, (exposure.flags[row] | int(Flag.TRAILED)) & ~int(Flag.POOR)),
            magnitude=put(exposure.magnitude, exposure.magnitude[row] + self.fainter_than(exposure.flux[row])),
        )  # fmt: skip


def with_trails(series: Series, frames: Iterable[Frame]) -> Series:
    """The series with unexplained measurements remeasured as trails where these fit better, and with further trails.

    frames : calibrated, in the order of ``series.exposures``, used one at a time. Other measurements of parts of a
    trail are marked as unreliable, and so are all along lines of trails longer than twice ``MAX_PX``. Trails without a
    measurement, beside a star or too faint for a window as wide as one, are added after all rows of the series.
    """
    columns, exposures = _Columns.of(series), list(series.exposures)
    for n, frame in enumerate(frames):
        exposures[n] = columns.remeasured(series, n, frame)
    return replace(columns.into(series, MIN_WIDTHS, LEAST_STEP), exposures=tuple(exposures))


def streaks(series: Series, linked: IntArray) -> tuple[Streak, ...]:
    """The trails of a series that no tracklet has, in order of time.

    Satellites show on one frame, or move too far to the next for a link. linked : rows of the detections of tracklets.
    """
    trails = series.trails
    if trails is None:
        return ()
    free = series.unexplained & np.isfinite(trails.arcsec[:, 0])
    free[linked] = False
    width = np.array([one.psf_fwhm_px * one.scale_arcsec_per_px for one in series.exposures])[series.frame]
    rows = np.flatnonzero(free & (np.nan_to_num(np.hypot(*trails.arcsec.T)) > STREAK_WIDTHS * width))
    ends = series.place[rows, None] + np.array([[-0.5], [0.5]]) * trails.arcsec[rows, None]
    alone = map(Streak.of, series.frame[rows], ends, series.measured("snr", rows))
    return tuple(sorted((one for one in (*trails.long, *alone) if one.snr >= STREAK_SNR), key=lambda one: one.frame))


def streak_table(series: Series, found: Sequence[Streak]) -> Table:
    """A table with one row per streak: its frame, ends on the sky, length, direction, rate and signal to noise ratio.

    ``angle_deg`` is from north through east, of either end; which end was first is not known.
    """
    from astropy.table import Table

    frame = np.array([one.frame for one in found], np.int64)
    ends = np.array([one.ends for one in found]).reshape(-1, 2, 2)
    east, north = (ends[:, 1] - ends[:, 0]).T
    exposure_s = np.array([one.exposure_s for one in series.exposures])[frame]
    columns = {"frame": np.array([one.name for one in series.exposures])[frame],
               "mjd_utc": np.array([one.mjd_utc for one in series.exposures])[frame]}  # fmt: skip
    for k in (1, 2):
        columns[f"ra_{k}_deg"], columns[f"dec_{k}_deg"] = series.sky(ends[:, k - 1])
    columns["length_arcsec"] = np.hypot(east, north)
    columns["angle_deg"] = np.degrees(np.arctan2(east, north)) % 180.0
    columns["rate_arcsec_per_min"] = np.ma.masked_invalid(60.0 * np.hypot(east, north) / exposure_s)
    columns["snr"] = np.array([one.snr for one in found], float)
    units = {"mjd_utc": "d", "length_arcsec": "arcsec", "rate_arcsec_per_min": "arcsec / min"}
    return Table(columns, units=units | {name: "deg" for name in columns if name.endswith("_deg")})


@dataclass
class _Columns:
    """Columns of a series, (n,) each, which change in place; vector, error : of ``Trails``, NaN where there is none.

    added : frame and row in its exposure of every row after those of the series. long : of ``Trails``. hidden : share
    of the pixels of each frame.
    """

    place: FloatArray
    sigma_arcsec: FloatArray
    unreliable: BoolArray
    magnitude: FloatArray
    vector: FloatArray
    error: FloatArray
    added: list[tuple[int, int]]
    long: list[Streak]
    hidden: list[float]

    @classmethod
    def of(cls, series: Series) -> _Columns:
        """Those of a series without trails."""
        vector = np.full(series.place.shape, np.nan)
        return cls(
            series.place.copy(), series.sigma_arcsec.copy(), series.unreliable.copy(), series.magnitude.copy(), vector,
            vector[:, 0].copy(), [], [], [],
        )  # fmt: skip

    def into(self, series: Series, min_widths: float, least_step: float) -> Series:
        """The series with these columns and rows; trails that do not move as their length requires are unreliable."""
        frame, row = np.array(self.added, np.int64).reshape(-1, 2).T
        other = np.zeros(len(frame), bool)
        self.unreliable |= _resting(self.place, np.append(series.frame, frame), self.vector, least_step)
        return replace(
            series, place=self.place, sigma_arcsec=self.sigma_arcsec, unreliable=self.unreliable,
            magnitude=self.magnitude, frame=np.append(series.frame, frame), row=np.append(series.row, row),
            star=np.append(series.star, other), stationary=np.append(series.stationary, other),
            fixed=np.append(series.fixed, other),
            trails=Trails(
                self.vector, self.error, min_widths, len(other), tuple(self.long),
                float(np.mean(self.hidden)) if self.hidden else math.nan,
            ),
        )  # fmt: skip

    def remeasured(self, series: Series, n: int, frame: Frame) -> Exposure:
        """Exposure n with the trails of its frame; those too long for a mover's go to ``long``."""
        one, rows = series.exposures[n], np.flatnonzero(series.frame == n)
        at = np.column_stack([one.x_px, one.y_px])[series.row[rows]]
        free = ~(series.star | series.stationary | series.fixed)[rows]
        if len(rows) < 6:
            return one
        width, to_sky = max(one.psf_fwhm_px, 1.5), ChipMap(at, series.place[rows])
        snr, flux = (values[series.row[rows]] for values in (one.snr, one.flux))
        pixels = TrailPixels.of(frame, at[~free], snr[~free], flux[~free], width)
        self.hidden.append(1.0 - float(pixels.good.mean()))
        light = free & ((np.asarray(one.flags)[series.row[rows]] & _NO_LIGHT) == 0)
        trails = _trails(pixels, at[light])
        # What remains of bright stars is not measured, and lies in line by chance; particles are no satellites.
        measured = [k for k, trail in enumerate(trails) if not trail.sharp and (free & trail.covers(at, width)).any()]
        lines, satellites = [], set()
        for line in _long_lines([trails[k] for k in measured], width, 1.8 * MAX_PX):
            whole = _collinear(line, trails, set(range(len(trails))), width)
            satellites.update(whole)
            lines.append(_joined([trails[k] for k in whole] or [line], line.half))
        for k, trail in enumerate(trails):
            parts = np.flatnonzero(free & trail.covers(at, width))
            self.unreliable[rows[parts]] = True
            if k in satellites or trail.sharp:
                continue
            if len(parts):
                nearest = parts[np.argmin(np.hypot(*(at[parts] - trail.middle).T))]
                row, was_at = int(rows[nearest]), at[nearest]
                own = int(series.row[row])
            else:
                row, own, was_at = len(self.place), len(one), trail.middle
                one = self._add(series, n, one, to_sky(trail.middle[None])[0])
            self._put(row, trail, one, own, series.floor_arcsec[n], was_at, to_sky)
            one = trail.measured_on(one, own)
        for line in lines:
            self.unreliable[rows[free & line.covers(at, width, math.inf)]] = True
            ends = to_sky(line.middle + np.array([[-1.0], [1.0]]) * line.half)
            self.long.append(Streak.of(n, ends, line.flux / line.flux_err))
        return one

    def _add(self, series: Series, n: int, one: Exposure, place: FloatArray) -> Exposure:
        """Adds a row for a trail at a place (2,) of the series; returns its exposure with that row, of unit flux."""
        self.added.append((n, len(one)))
        self.place, self.vector = np.vstack([self.place, place]), np.vstack([self.vector, np.full(2, np.nan)])
        self.error, self.sigma_arcsec = np.append(self.error, np.nan), np.append(self.sigma_arcsec, np.nan)
        self.unreliable = np.append(self.unreliable, False)
        self.magnitude = np.append(self.magnitude, series.stars.magnitudes(np.ones(1), np.array([n])))
        ra, dec = series.sky(place[None])
        with np.errstate(invalid="ignore", divide="ignore"):
            zero = one.magnitude + 2.5 * np.log10(one.flux)
        zero = zero[np.isfinite(zero)]
        return one.with_row(float(ra[0]), float(dec[0]), float(np.median(zero)) if len(zero) else math.nan)

    def _put(
        self, row: int, trail: _Trail, one: Exposure, own: int, floor_arcsec: float, at: FloatArray, to_sky: ChipMap
    ) -> None:
        """Puts a trail in place of a measurement, ``own`` of its exposure, which was at the pixel ``at`` (2,)."""
        ends = to_sky(trail.middle + trail.half * np.array([[1.0], [-1.0], [0.0]]))
        scale, variance = one.scale_arcsec_per_px, np.diagonal(trail.covariance)
        self.unreliable[row] = False
        self.place[row] = ends[2] + self.place[row] - to_sky(at[None])[0]
        self.vector[row] = ends[0] - ends[1]
        self.error[row] = 2.0 * scale * math.sqrt(0.5 * (variance[2] + variance[3]))
        self.sigma_arcsec[row] = math.hypot(scale * math.sqrt(0.5 * (variance[0] + variance[1])), floor_arcsec)
        self.magnitude[row] += trail.fainter_than(one.flux[own])


def _resting(place: FloatArray, frame: IntArray, vector: FloatArray, least_step: float) -> BoolArray:
    """(n,) mask of the trails with one of another frame closer than this share of their length.

    Exposures do not overlap, so a mover steps by its trail at least; what remains of stars stays.
    """
    rows, out = np.flatnonzero(np.isfinite(vector[:, 0])), np.zeros(len(frame), bool)
    if len(rows) > 1:
        length = np.hypot(*vector[rows].T)
        pairs = cKDTree(place[rows]).query_pairs(least_step * float(length.max()), output_type="ndarray")
        i, j = pairs.T
        apart = np.hypot(*(place[rows[i]] - place[rows[j]]).T)
        near = (apart < least_step * np.minimum(length[i], length[j])) & (frame[rows[i]] != frame[rows[j]])
        out[rows[i[near]]] = out[rows[j[near]]] = True
    return out


def _trails(pixels: TrailPixels, measured: FloatArray) -> list[_Trail]:
    """The trails through measured pixels (n, 2), and those of what is left of the frame; no two at one place."""
    points = np.concatenate([measured, pixels.seeds()])
    least = np.where(np.arange(len(points)) < len(measured), TRIED, TRIED_UNMEASURED) * GAIN
    trails: list[_Trail] = []
    fits = 0
    for k, start in pixels.candidates(points, least):
        if any(other.covers(points[k][None], pixels.width)[0] for other in trails):
            continue
        fits += 1
        trail = pixels.fitted(points[k], start)
        if trail is not None and not any(other.covers(trail.middle[None], pixels.width)[0] for other in trails):
            trails.append(trail)
        if fits == MAX_FITS:
            break
    return trails


def _long_lines(trails: list[_Trail], width: float, longest: float) -> list[_Trail]:
    """Collinear trails that are together longer than any mover's, as of satellites cut by stars, joined."""
    lines, remaining = [], set(range(len(trails)))
    for k, line in enumerate(trails):
        if k not in remaining:
            continue
        parts = [k]
        # Each part makes the direction better known, which may add parts farther away.
        while len(found := _collinear(line, trails, remaining, width)) > len(parts):
            parts, line = found, _joined([trails[m] for m in found], line.half)
        if line.length > longest:
            lines.append(line)
            remaining -= set(parts)
    return lines


def _collinear(line: _Trail, trails: list[_Trail], among: set[int], width: float) -> list[int]:
    """The trails whose middle and direction are those of a line."""
    across = 2.0 * line.half[::-1] * [-1.0, 1.0] / line.length
    return [
        m for m in sorted(among)
        if line.covers(trails[m].middle[None], width, math.inf)[0]
        and abs(float(trails[m].half @ across)) < 0.1 * trails[m].length
    ]  # fmt: skip


def _joined(parts: Sequence[_Trail], along: FloatArray) -> _Trail:
    """Collinear trails as one, from the first end to the last in a direction."""
    ends = np.array([part.middle + side * part.half for part in parts for side in (-1.0, 1.0)])
    first, last = ends[np.argmin(ends @ along)], ends[np.argmax(ends @ along)]
    flux, snr = sum(part.flux for part in parts), math.hypot(*(part.flux / part.flux_err for part in parts))
    return replace(parts[0], middle=0.5 * (first + last), half=0.5 * (last - first), flux=flux, flux_err=flux / snr)


@dataclass(frozen=True)
class TrailPixels:
    """The pixels of a frame that is searched for trails.

    light : (rows, columns) above the sky, without the known sources. good : mask of usable pixels, not close to known
    sources. sigma : standard deviation of a pixel. smooth : signal to noise ratio of a star at each pixel, by the
    usable ones. share : of a star's light there that is on usable pixels. inverse_gain : photon variance over light.
    width : FWHM of a star, px.
    """

    light: FloatArray
    good: BoolArray
    sigma: FloatArray
    smooth: FloatArray
    share: FloatArray
    inverse_gain: float
    width: float

    @classmethod
    def of(cls, frame: Frame, sources: FloatArray, snr: FloatArray, flux: FloatArray, width: float) -> TrailPixels:
        """The pixels of a frame. sources : (n, 2) pixels of known sources, subtracted. snr, flux : (n,)."""
        background = Background.of(frame)
        light, stars = without_stars(frame, background, sources, flux, width)
        good = ((frame.flags & (Flag.HOT | Flag.COSMIC | Flag.MASKED)) == 0) & np.isfinite(background.variance)
        variance = np.where(good, background.variance, 1.0)
        variance = variance + background.inverse_gain * np.maximum(stars, 0.0)
        _hide(good, sources, width * (HIDDEN_WIDTHS + 0.6 * np.log10(np.maximum(snr / 10.0, 1.0))))
        variance = variance + (max(STAR_SHARE, _misfit(light, stars, variance, good)) * stars) ** 2
        weight = np.where(good, 1.0 / variance, 0.0).astype(np.float32)
        psf = width / FWHM_PER_SIGMA
        # k² of a Gaussian is a Gaussian narrower by √2.
        signal = gaussian_filter(light.astype(np.float32) * weight, psf, mode="constant")
        norm = gaussian_filter(weight, psf / math.sqrt(2.0), mode="constant") / (4.0 * math.pi * psf**2)
        share = gaussian_filter(good.astype(np.float32), psf, mode="constant")
        norm[share <= _LEAST_SHARE] = 0.0
        normalise(signal, norm)
        smooth = np.where(norm > 0, signal / np.sqrt(np.where(norm > 0, norm, 1.0)), 0.0)
        return cls(light, good, np.sqrt(variance), smooth, share, background.inverse_gain, width)

    def seeds(self) -> FloatArray:
        """(n, 2) maxima of what is left of the frame, not at its edge, the most significant first."""
        y, x = local_maxima(self.smooth.astype(np.float32), SEED_SIGMAS, max(1, round(0.5 * self.width)))
        rows, columns = self.smooth.shape
        inside = np.minimum(np.minimum(x, columns - 1 - x), np.minimum(y, rows - 1 - y)) > 2.0 * self.width
        y, x = y[inside], x[inside]
        order = np.argsort(-self.smooth[y, x], kind="stable")
        return np.column_stack([x, y])[order].astype(float)

    def candidates(self, at: FloatArray, least: FloatArray) -> list[tuple[int, FloatArray]]:
        """The pixels (n, 2) that may be on a trail, as indices, the most significant first, with its ends (2, 2).

        The sum of the star's filter along a line, S = Σ s/√(3n/2 − 1/2), is used: a trail is tried if S² exceeds that
        of the star alone by ``least`` (n,).
        """
        score, gain, ends = (
            np.concatenate(each)
            for each in zip(
                *(self._best_lines(part) for part in np.array_split(at, 1 + len(at) // _AT_ONCE)), strict=True
            )
        )
        return [(int(k), ends[k]) for k in np.argsort(-score) if score[k] > 0 and gain[k] > least[k]]

    def _best_lines(self, at: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """The best line through each pixel (n, 2): S (n,), the excess of S² over a star's, and its ends (n, 2, 2)."""
        steps = np.arange(1, max(int(MAX_PX / self.width), 2) + 1) * self.width
        angle = np.arange(ANGLES) * math.pi / ANGLES
        direction = np.column_stack([np.cos(angle), np.sin(angle)])
        offsets = np.concatenate([-steps[::-1], [0.0], steps])
        points = at[:, None, None] + direction[None, :, None] * offsets[None, None, :, None]  # (n, angles, steps, 2)
        where = [points[..., 1], points[..., 0]]
        s = map_coordinates(self.smooth, where, order=1, mode="constant")
        seen = map_coordinates(self.share, where, order=1, mode="constant") > _LEAST_SHARE
        # The local sky is the median along all lines.
        s = np.where(seen, s - np.median(s, axis=(1, 2))[:, None, None], 0.0)
        m = len(steps)
        # A trail has uniform brightness: it ends at a gap, and much brighter parts are other sources.
        top = np.max(s[..., max(m - 1, 0) : m + 2], axis=(1, 2))[:, None, None]
        s = np.minimum(s, 1.3 * np.maximum(top, 1.0))
        gap = seen & (s < np.maximum(GAP * top, 0.5))
        gap = np.concatenate(
            [np.logical_or.accumulate(gap[..., :m][..., ::-1], axis=-1)[..., ::-1], np.zeros((*s.shape[:2], 1), bool),
             np.logical_or.accumulate(gap[..., m + 1 :], axis=-1)], axis=-1,
        )  # fmt: skip
        s = np.where(gap, -np.maximum(top, 1.0), s)
        # A hidden part adds neither light nor noise.
        total, count = (
            _outwards(one, m, True)[..., :, None] + _outwards(one, m, False)[..., None, :] + one[..., m, None, None]
            for one in (s, seen.astype(float))
        )
        # Neighbours on the line, one FWHM apart, share a quarter of their noise.
        total = total / np.sqrt(np.maximum(1.5 * count - 0.5, 1.0))
        flat = total.reshape(len(at), -1)
        best = np.argmax(flat, axis=1)
        score = flat[np.arange(len(at)), best]
        best_angle, a, b = np.unravel_index(best, total.shape[1:])
        alone = np.maximum(s[:, 0, m], 0.0)
        along = self.width * direction[best_angle]
        return score, score**2 - alone**2, np.stack([at - a[:, None] * along, at + b[:, None] * along], axis=1)

    def fitted(self, at: FloatArray, ends: FloatArray) -> _Trail | None:
        """The trail fitted from initial ends (2, 2); None if a star fits as well, or the fit fails."""
        from scipy.optimize import least_squares

        middle, half = ends.mean(axis=0), 0.5 * (ends[1] - ends[0])
        length = float(np.hypot(*half))
        direction = half / length if length > 0 else np.array([1.0, 0.0])
        reach = length + 2.5 * self.width
        a, b = (max(math.floor(v - reach), 0) for v in middle[::-1])
        c, d = (math.ceil(v + reach) + 1 for v in middle[::-1])
        v, u = np.mgrid[a : min(c, self.light.shape[0]), b : min(d, self.light.shape[1])]
        along = (u - middle[0]) * direction[0] + (v - middle[1]) * direction[1]
        across = (v - middle[1]) * direction[0] - (u - middle[0]) * direction[1]
        inside = self.good[v, u] & (np.abs(along) < reach) & (np.abs(across) < 2.5 * self.width)
        if inside.sum() < 30:
            return None
        u, v = u[inside].astype(float), v[inside].astype(float)
        light, sigma = (one[v.astype(int), u.astype(int)] for one in (self.light, self.sigma))
        level, noise = float(np.percentile(light, 30.0)), float(np.median(sigma))
        flux = max(float((light - level).sum()), noise)
        error = np.sqrt(sigma**2 + self.inverse_gain * np.maximum(light - level, 0.0))
        initial = np.array([*middle, *(np.maximum(length, 0.5 * self.width) * direction), 1.0, 0.0])

        def misfit(values: FloatArray) -> FloatArray:
            model = _line(u, v, values[:2], values[2:4], self.width / FWHM_PER_SIGMA)
            return np.asarray((light - level - values[5] * noise - values[4] * flux * model) / error)

        def star(values: FloatArray) -> FloatArray:
            return misfit(np.array([values[0], values[1], 1e-3, 0.0, values[2], values[3]]))

        try:
            fit = least_squares(misfit, initial, method="lm", max_nfev=150, ftol=1e-5, xtol=1e-4)
            # A line through noise may end on a star, which is then the alternative.
            brightest = np.argmax(self.smooth[v.astype(int), u.astype(int)])
            starts = [at, np.array([u[brightest], v[brightest]])]
            points = [
                least_squares(star, [*start, 1.0, 0.0], method="lm", max_nfev=60, ftol=1e-5, xtol=1e-4)
                for start in starts[: 1 + bool(np.hypot(*(starts[1] - at)) > 1.0)]
            ]
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
        gain = 2.0 * (min(point.cost for point in points) - fit.cost) / chi
        long = 2.0 * size > MIN_WIDTHS * self.width and size > MIN_SIGMAS * spread
        if gain < GAIN or not long:
            return None
        terms = np.stack([_line(u, v, fit.x[:2], half, 0.5 * self.width / FWHM_PER_SIGMA), np.ones(len(u))]) / error
        narrow = float(((light / error - np.linalg.lstsq(terms.T, light / error, rcond=None)[0] @ terms) ** 2).sum())
        trail = _Trail(fit.x[:2], half, covariance[:4, :4], float(fit.x[4] * flux),
                       float(flux * math.sqrt(covariance[4, 4])), narrow < 2.0 * fit.cost)  # fmt: skip
        # The fit may have moved to another source.
        return trail if trail.covers(at[None], self.width)[0] else None


def _outwards(values: FloatArray, middle: int, back: bool) -> FloatArray:
    """(n, angles, middle + 1) sums of values along lines (n, angles, steps) from the middle to one end."""
    side = values[..., :middle][..., ::-1] if back else values[..., middle + 1 :]
    return np.concatenate([np.zeros((*values.shape[:2], 1)), np.cumsum(side, axis=-1)], axis=-1)


def _misfit(light: FloatArray, stars: FloatArray, variance: FloatArray, good: BoolArray) -> float:
    """What subtracted stars leave of their light, as a share of it (95th percentile): profiles are not the model's."""
    bright = good & (stars > 2.0 * np.sqrt(variance))
    if bright.sum() < 100:
        return 0.0
    return float(np.percentile(np.abs(light[bright]) / stars[bright], 95.0))


def _hide(good: BoolArray, at: FloatArray, radius: FloatArray) -> None:
    """Unsets the mask within radii (n,) of pixels (n, 2), in place."""
    for (x, y), r in zip(at, radius, strict=True):
        a, b = max(int(y - r), 0), max(int(x - r), 0)
        v, u = np.mgrid[a : int(y + r) + 2, b : int(x + r) + 2]
        box = good[a : int(y + r) + 2, b : int(x + r) + 2]
        box &= ((u - x) ** 2 + (v - y) ** 2 > r * r)[: box.shape[0], : box.shape[1]]


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

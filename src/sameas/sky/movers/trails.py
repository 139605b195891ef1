"""Trails of sources that move during an exposure, measured in the pixels.

Windows as wide as a star detect parts of a trail, or do not converge (:func:`with_trails`). Unexplained and unconverged
measurements are tested as trails: first by sums of the matched filter along lines through them, then by a fit of a
Gaussian star moving uniformly along a straight line,

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

from sameas.arrays import BoolArray, FloatArray, robust_scale
from sameas.gaussian import inverse
from sameas.sky.frame.centroid import FWHM_PER_SIGMA
from sameas.sky.frame.image import Frame
from sameas.sky.frame.measurements import Flag
from sameas.sky.movers.stack import ChipMap
from sameas.sky.series import Exposure, Series, Trails

#: Flags of measurements that are not light of the sky, or incomplete.
_NO_LIGHT = int(Flag.HOT | Flag.COSMIC | Flag.EDGE)


@dataclass(frozen=True)
class TrailTuning:
    """Parameters for measuring trails; chosen on injected ones (``scripts/bench movers --rounds``).

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
    columns, exposures, long = _Columns.of(series), list(series.exposures), 0
    for n, frame in enumerate(frames):
        exposures[n], lines = columns.remeasured(series, n, frame, tuning)
        long += lines
    note = f"{long} trails longer than {2 * tuning.max_px:.0f} px, as of satellites, are removed"
    return replace(
        series, place=columns.place, sigma_arcsec=columns.sigma_arcsec, unreliable=columns.unreliable,
        magnitude=columns.magnitude, exposures=tuple(exposures),
        trails=Trails(columns.vector, columns.error, tuning.min_widths),
        notes=(*series.notes, *([note] if long else [])),
    )  # fmt: skip


@dataclass
class _Columns:
    """Columns of a series, (n,) each, which change in place; vector, error : of ``Trails``, NaN where there is none."""

    place: FloatArray
    sigma_arcsec: FloatArray
    unreliable: BoolArray
    magnitude: FloatArray
    vector: FloatArray
    error: FloatArray

    @classmethod
    def of(cls, series: Series) -> _Columns:
        """Those of a series without trails."""
        vector = np.full(series.place.shape, np.nan)
        return cls(
            series.place.copy(), series.sigma_arcsec.copy(), series.unreliable.copy(), series.magnitude.copy(), vector,
            vector[:, 0].copy(),
        )  # fmt: skip

    def remeasured(self, series: Series, n: int, frame: Frame, tuning: TrailTuning) -> tuple[Exposure, int]:
        """Exposure n with the trails of its frame, and the number of lines that are too long for a mover's."""
        one, rows = series.exposures[n], np.flatnonzero(series.frame == n)
        at = np.column_stack([one.x_px, one.y_px])[series.row[rows]]
        flags = np.asarray(one.flags)[series.row[rows]]
        free = ~(series.star | series.stationary | series.fixed)[rows]
        candidates = np.flatnonzero(free & ((flags & _NO_LIGHT) == 0))
        if not len(candidates) or len(rows) < 6:
            return one, 0
        width = max(one.psf_fwhm_px, 1.5)
        pixels = TrailPixels.of(frame, at[~free], one.snr[series.row[rows]][~free], width, tuning)
        to_sky = ChipMap(at, series.place[rows])
        done, measured, known = np.zeros(len(rows), bool), np.zeros(len(rows), bool), list[_Trail]()
        for k, start in pixels.candidates(at[candidates]):
            mine = int(candidates[k])
            trail = None if done[mine] else pixels.fitted(at[mine], start)
            if trail is None:
                continue
            parts = free & trail.covers(at, width)
            parts[mine] = True
            done |= parts
            self.unreliable[rows[parts & ~measured]] = True
            if any(other.covers(trail.middle[None], width)[0] for other in known):
                continue
            measured[mine] = True
            known.append(trail)
            own = int(series.row[rows[mine]])
            self._put(rows[mine], trail, one, own, series.floor_arcsec[n], at[mine], to_sky)
            one = trail.measured_on(one, own)
        lines = _long_lines(known, width, 1.8 * tuning.max_px)
        now_at = np.column_stack([one.x_px, one.y_px])[series.row[rows]]
        for line in lines:
            parts = free & (known[line[0]].covers(at, width, math.inf) | known[line[0]].covers(now_at, width, math.inf))
            self.unreliable[rows[parts]], self.vector[rows[parts]], self.error[rows[parts]] = True, np.nan, np.nan
        return one, len(lines)

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
class TrailPixels:
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
    ) -> TrailPixels:
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

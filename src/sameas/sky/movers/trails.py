"""Trails: what moves while the shutter is open, measured as a line with two ends instead of as stars.

On a long exposure a mover draws a trail. Windows as wide as a star find it in parts, or at a place that wanders along
it, and do not settle; such measurements were lost. Here what is left over of a frame, and what did not settle, is tried
as a trail: first by sums of the matched filter along lines through it, then by a fit of a Gaussian star that moves
evenly along a straight line,

    I(a, c) = F/L · exp(−c²/2σ²)/(√2π σ) · ½ [erf((a + L/2)/√2σ) − erf((a − L/2)/√2σ)],

a along and c across the trail, L its length (Vereš et al. 2012, PASP 124, 1197). Its middle is the place at the middle
of the exposure; its length and angle are the rate but for the sign, which links take as evidence.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates

from sameas.arrays import BoolArray, FloatArray
from sameas.sky.frame.centroid import FWHM_PER_SIGMA
from sameas.sky.frame.image import Frame
from sameas.sky.frame.measurements import Flag
from sameas.sky.movers.stack import ChipMap
from sameas.sky.series import Series, Trails

#: Measurements of these are no light of the sky, or not all of it.
_NO_LIGHT = int(Flag.HOT | Flag.COSMIC | Flag.EDGE)


@dataclass(frozen=True)
class TrailTuning:
    """How trails are measured; all chosen on injected ones (``scripts/bench movers --rounds``).

    Attributes
    ----------
    least_widths : shorter trails, in full widths of a star, are measured as stars.
    most_px : half of the longest trail; longer ones are of satellites and are taken away.
    angles : directions that are tried.
    gain : χ² by which a trail fits better than a star.
    least_sigmas : of the length.
    hidden_widths : pixels so near another source, in full widths, are left out; more for bright ones.
    gap : a trail ends where the light is less than this share of what it is in the middle.
    most : trails that are fitted on a frame, the most significant first.
    """

    least_widths: float = 0.8
    most_px: float = 60.0
    angles: int = 24
    gain: float = 30.0
    least_sigmas: float = 5.0
    hidden_widths: float = 1.2
    gap: float = 0.3
    most: int = 100


TUNING = TrailTuning()


@dataclass(frozen=True)
class _Trail:
    """A trail fitted: middle and half of its vector, px, covariance (4, 4) of both, flux and its error."""

    middle: FloatArray
    half: FloatArray
    covariance: FloatArray
    flux: float
    flux_err: float

    @property
    def length(self) -> float:
        """In px."""
        return 2.0 * float(np.hypot(*self.half))

    def covers(self, at: FloatArray, width: float, beyond: float = 1.0) -> BoolArray:
        """(n,) whether some pixels lie on it, or no farther from its ends than so many full widths."""
        unit, off = 2.0 * self.half / self.length, at - self.middle
        along, across = off @ unit, off @ np.array([-unit[1], unit[0]])
        return np.asarray((np.abs(across) < 1.2 * width) & (np.abs(along) < 0.5 * self.length + beyond * width))


def with_trails(series: Series, frames: Iterable[Frame], tuning: TrailTuning = TUNING) -> Series:
    """The series with what is left over measured as trails where that fits better.

    frames : calibrated, in the order of ``series.exposures``; one is held at a time. Parts of a trail beside its
    measurement are spoilt, and so is what is longer than ``most_px`` allows, all along its line.
    """
    place, sigma, spoilt = series.place.copy(), series.sigma_arcsec.copy(), series.spoilt.copy()
    vector, error = np.full((len(place), 2), np.nan), np.full(len(place), np.nan)
    magnitude, exposures, long = series.magnitude.copy(), list(series.exposures), 0
    for n, frame in enumerate(frames):
        one = series.exposures[n]
        rows = np.flatnonzero(series.frame == n)
        at = np.column_stack([one.x_px, one.y_px])[series.row[rows]]
        flags = np.asarray(one.flags)[series.row[rows]]
        free = ~(series.star | series.still | series.fixed)[rows]
        tried = free & ((flags & _NO_LIGHT) == 0)
        if not tried.any() or len(rows) < 6:
            continue
        width = max(one.psf_fwhm_px, 1.5)
        pixels = _Pixels.of(frame, at[~free], one.snr[series.row[rows]][~free], width, tuning)
        to_sky = ChipMap(at, series.place[rows])
        x, y, cov = one.x_px.copy(), one.y_px.copy(), one.covariance_px.copy()
        sky, flux, flux_err = one.covariance.copy(), one.flux.copy(), one.flux_err.copy()
        marks, bright = np.asarray(one.flags).copy(), one.magnitude.copy()
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
            spoilt[rows[parts & ~measured]] = True
            if again:
                continue
            row, own = rows[mine], int(series.row[rows[mine]])
            measured[mine], spoilt[row] = True, False
            known.append(trail)
            ends = to_sky(trail.middle + trail.half * np.array([[1.0], [-1.0], [0.0]]))
            place[row] = ends[2] + series.place[row] - to_sky(at[mine][None])[0]
            vector[row] = ends[0] - ends[1]
            scale = one.scale_arcsec_per_px
            error[row] = 2.0 * scale * math.sqrt(0.5 * np.trace(trail.covariance[2:, 2:]))
            spread = trail.covariance[:2, :2]
            sigma[row] = math.hypot(scale * math.sqrt(0.5 * np.trace(spread)), series.floor_arcsec[n])
            plate = max(0.5 * float((sky[own] - scale**2 * cov[own])[[0, 2]].sum()), 0.0)
            sky[own] = (plate + 0.5 * scale**2 * float(np.trace(spread))) * np.array([1.0, 0.0, 1.0])
            fainter = -2.5 * math.log10(trail.flux / flux[own]) if flux[own] > 0 else math.nan
            x[own], y[own] = trail.middle
            cov[own] = spread[[0, 0, 1], [0, 1, 1]]
            flux[own], flux_err[own] = trail.flux, trail.flux_err
            magnitude[row] += fainter
            bright[own] += fainter
            marks[own] = (marks[own] | int(Flag.TRAILED)) & ~int(Flag.POOR)
        for line in _long_lines(known, width, 1.8 * tuning.most_px):
            parts = free & (known[line[0]].covers(at, width, math.inf) | known[line[0]].covers(
                np.column_stack([x, y])[series.row[rows]], width, math.inf))  # fmt: skip
            spoilt[rows[parts]], vector[rows[parts]], error[rows[parts]] = True, np.nan, np.nan
            long += 1
        exposures[n] = replace(
            one, x_px=x, y_px=y, covariance_px=cov, covariance=sky, flux=flux, flux_err=flux_err, flags=marks,
            magnitude=bright,
        )  # fmt: skip
    note = f"{long} trails longer than {2 * tuning.most_px:.0f} px, as of satellites, are removed"
    return replace(
        series, place=place, sigma_arcsec=sigma, spoilt=spoilt, magnitude=magnitude, exposures=tuple(exposures),
        trails=Trails(vector, error, tuning.least_widths), notes=(*series.notes, *([note] if long else [])),
    )  # fmt: skip


def _long_lines(trails: list[_Trail], width: float, longest: float) -> list[list[int]]:
    """Trails that are longer than any mover's alone or, where stars cut them, together with others on their line."""
    lines, left = [], set(range(len(trails)))
    for k, one in enumerate(trails):
        if k not in left:
            continue
        unit = 2.0 * one.half / one.length
        same = [
            m for m in sorted(left)
            if one.covers(trails[m].middle[None], width, math.inf)[0]
            and abs(float(trails[m].half @ np.array([-unit[1], unit[0]]))) < 0.1 * trails[m].length
        ]  # fmt: skip
        ends = [float((trails[m].middle + s * trails[m].half - one.middle) @ unit) for m in same for s in (-1.0, 1.0)]
        if max(ends) - min(ends) > longest:
            lines.append(same)
            left -= set(same)
    return lines


@dataclass(frozen=True)
class _Pixels:
    """The pixels of a frame in which trails are looked for.

    image : without what stands still. good : (rows, columns) pixels that count. smooth : the same after the matched
    filter of a star. noise : of a pixel. inverse_gain : variance of the photons over their light. width : full width of
    a star, px.
    """

    image: FloatArray
    good: BoolArray
    smooth: FloatArray
    noise: float
    inverse_gain: float
    width: float
    tuning: TrailTuning

    @classmethod
    def of(cls, frame: Frame, sources: FloatArray, snr: FloatArray, width: float, tuning: TrailTuning) -> _Pixels:
        """Those of a frame. sources : (n, 2) pixels of what stands still, snr : (n,)."""
        image = np.asarray(frame.image, np.float64).copy()
        good = ((frame.flags & (Flag.HOT | Flag.COSMIC | Flag.MASKED)) == 0) & np.isfinite(image)
        level = float(np.median(image[good][::7]))
        steps = np.diff(image[::3], axis=1)[good[::3, 1:] & good[::3, :-1]]
        noise = max(1.4826 * float(np.median(np.abs(steps))) / math.sqrt(2.0), 1e-9)
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
        return cls(image, good, smooth * (2 * math.sqrt(math.pi) * sigma / noise), noise,
                   1.0 / gain if gain > 0 else 0.0, width, tuning)  # fmt: skip

    def candidates(self, at: FloatArray) -> list[tuple[int, FloatArray]]:
        """Which of some pixels (n, 2) may lie on a trail, the most significant first, and (2, 2) where it may end.

        A trail shows in the sum of the star's filter along a line, S = Σ s/√count: it is tried where S² exceeds that of
        the star alone by half of the gain that a fit needs.
        """
        steps = np.arange(1, max(int(self.tuning.most_px / self.width), 2) + 1) * self.width
        angle = np.arange(self.tuning.angles) * math.pi / self.tuning.angles
        way = np.column_stack([np.cos(angle), np.sin(angle)])
        both = np.concatenate([-steps[::-1], [0.0], steps])
        points = at[:, None, None] + way[None, :, None] * both[None, None, :, None]  # (n, angles, steps, 2)
        s = map_coordinates(self.smooth, [points[..., 1], points[..., 0]], order=1, mode="constant")
        # The sky around differs from the frame's; what is far along the lines tells it.
        s = s - np.median(s, axis=(1, 2))[:, None, None]
        m = len(steps)
        # A trail is as bright everywhere: it does not go on beyond a gap, and what is much brighter is another source.
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
        turn, a, b = np.unravel_index(best, total.shape[1:])
        alone = np.maximum(s[:, 0, m], 0.0)
        order = np.argsort(-score)
        chosen = [k for k in order if score[k] > 0 and score[k] ** 2 - alone[k] ** 2 > 0.5 * self.tuning.gain]
        ends = [np.stack([at[k] - a[k] * self.width * way[turn[k]], at[k] + b[k] * self.width * way[turn[k]]])
                for k in chosen]  # fmt: skip
        return list(zip(map(int, chosen), ends, strict=True))[: self.tuning.most]

    def fitted(self, at: FloatArray, ends: FloatArray) -> _Trail | None:
        """The trail between about these ends (2, 2); None where a star fits as well, or nothing does."""
        from scipy.optimize import least_squares

        middle, half = ends.mean(axis=0), 0.5 * (ends[1] - ends[0])
        length = float(np.hypot(*half))
        way = half / length if length > 0 else np.array([1.0, 0.0])
        reach = length + 2.5 * self.width
        a, b = (max(math.floor(v - reach), 0) for v in middle[::-1])
        c, d = (math.ceil(v + reach) + 1 for v in middle[::-1])
        v, u = np.mgrid[a : min(c, self.image.shape[0]), b : min(d, self.image.shape[1])]
        along = (u - middle[0]) * way[0] + (v - middle[1]) * way[1]
        across = (v - middle[1]) * way[0] - (u - middle[0]) * way[1]
        inside = self.good[v, u] & (np.abs(along) < reach) & (np.abs(across) < 2.5 * self.width)
        if inside.sum() < 30:
            return None
        u, v = u[inside].astype(float), v[inside].astype(float)
        light = self.image[v.astype(int), u.astype(int)]
        level = float(np.percentile(light, 30.0))
        flux = max(float((light - level).sum()), self.noise)
        error = np.sqrt(self.noise**2 + self.inverse_gain * np.maximum(light - level, 0.0))
        start = np.array([*middle, *(np.maximum(length, 0.5 * self.width) * way), 1.0, 0.0])

        def misfit(values: FloatArray) -> FloatArray:
            model = _line(u, v, values[:2], values[2:4], self.width / FWHM_PER_SIGMA)
            return np.asarray((light - level - values[5] * self.noise - values[4] * flux * model) / error)

        def star(values: FloatArray) -> FloatArray:
            return misfit(np.array([values[0], values[1], 1e-3, 0.0, values[2], values[3]]))

        try:
            fit = least_squares(misfit, start, method="lm", max_nfev=150, ftol=1e-5, xtol=1e-4)
            point = least_squares(star, [*at, 1.0, 0.0], method="lm", max_nfev=60, ftol=1e-5, xtol=1e-4)
            covariance = np.linalg.inv(fit.jac.T @ fit.jac)
        except (ValueError, np.linalg.LinAlgError):
            return None
        chi = max(2.0 * fit.cost / max(len(u) - 6, 1), 1.0)
        covariance *= chi
        half = fit.x[2:4]
        size = float(np.hypot(*half))
        if fit.x[4] <= 0 or not np.isfinite(fit.x).all() or size > 2.0 * reach:
            return None
        if not (np.diagonal(covariance) > 0.0).all():  # of a fit that leaves a value open the inverse is anything
            return None
        unit = half / max(size, 1e-9)
        spread = math.sqrt(max(float(unit @ covariance[2:4, 2:4] @ unit), 1e-12))
        better = 2.0 * (point.cost - fit.cost) / chi
        long = 2.0 * size > self.tuning.least_widths * self.width and size > self.tuning.least_sigmas * spread
        if better < self.tuning.gain or not long:
            return None
        trail = _Trail(fit.x[:2], half, covariance[:4, :4], float(fit.x[4] * flux),
                       float(flux * math.sqrt(covariance[4, 4])))  # fmt: skip
        # A fit that has slid onto something else says nothing of this measurement.
        return trail if trail.covers(at[None], self.width)[0] else None


def _line(u: FloatArray, v: FloatArray, middle: FloatArray, half: FloatArray, sigma: float) -> FloatArray:
    """(k,) share of the light of a trail in pixels (u, v)."""
    from scipy.special import erf

    size = max(float(np.hypot(*half)), 1e-3)
    unit = half / size
    along = (u - middle[0]) * unit[0] + (v - middle[1]) * unit[1]
    across = (v - middle[1]) * unit[0] - (u - middle[0]) * unit[1]
    profile = np.exp(-0.5 * (across / sigma) ** 2) / (math.sqrt(2 * math.pi) * sigma)
    wide = math.sqrt(2.0) * sigma
    return np.asarray(profile * (erf((along + size) / wide) - erf((along - size) / wide)) / (4.0 * size))

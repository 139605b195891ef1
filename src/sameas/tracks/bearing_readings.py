"""How the bearings of a radar are to be read: as given, mirrored, turned, or from the bow, by all its plots.

A radar whose bearings are read wrongly shows every ship at its true range. A ship near the axis of a mirrored picture
is then at its true bearing, too, and two of them may agree on an offset of the azimuth, with far more evidence than
by chance. So an offset is compared with the other readings (:class:`~sameas.tracks.bias_fit.BearingReading`), each
with an offset of its own, and with bearings that say nothing, by the likelihood of plots about tracks of
:mod:`sameas.tracks.plot_offsets`. Readings other than that given have the prior probability ``MISREAD`` each, and
their offsets are uniform on the circle.

- :func:`best_other_reading`: the reading that is more probable than others beside an offset, and its log-odds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sameas.arrays import FloatArray, IntArray
from sameas.gaussian import LOG_2PI
from sameas.tracks.bias_fit import BearingReading
from sameas.tracks.biases import AZIMUTH
from sameas.tracks.feed import Feed
from sameas.tracks.plot_pairs import (
    COMPANION,
    FITTED,
    PLOT_RATES,
    PlotPairs,
    Plots,
    azimuth_limit_deg,
    candidates,
    first_of_scans,
    log_prior_of_azimuth,
    moves,
)
from sameas.tracks.snapshot import bias_widths

#: Suspicion, change and remedy of each reading.
Words = tuple[str, str, str]
MIRRORED = "bearings look counter-clockwise", "read so", "turn their sign: bearings run clockwise from north"
TURNED = "bearings look turned by a large angle", "turned back", "give it as calibration azimuth_deg"
OF_BOW = "bearings look relative to the bow", "read so", "name their column relative_bearing"
OF_NORTH = "bearings look as from north, not from the bow", "read so", "name their column bearing"
UNREAD = (
    "bearings look wrong",
    "by its ranges alone",
    "check the sign of its bearings, their zero, and whether they are from north or from the bow",
)

#: Prior probability that a radar's bearings are read wrongly in one of the ways that are tried.
MISREAD = 0.01
#: Step of the offsets of bearings, which are tried all around; plots farther than READING_WINDOW_DEG from an offset are
#: no evidence for it, and one as given is compared at its best place within READING_NEAR_DEG.
READING_STEP_DEG, READING_WINDOW_DEG, READING_NEAR_DEG = 1.0, 12.0, 2.0
READINGS_DEG = np.arange(-180.0, 180.0, READING_STEP_DEG)
READING_PLOTS = 5000  # about the most plots used
READING_COURSE_S = 15.0  # the course of a sensor that moves is that from so long before to so long after
READING_SAME_DEG = 6.0  # bearings from the bow that differ by less from those with an offset are no other reading


def best_other_reading(
    feed: Feed, partners: Sequence[Feed], azimuth_deg: float | None = None, log_companion: float | None = None
) -> BearingReading | None:
    """The most probable reading of a radar's bearings other than that given; None without plots near tracks.

    azimuth_deg : the offset of the azimuth, or one near it, of the bearings as given; by default the most probable one.
    log_companion : as of :meth:`~sameas.tracks.plot_offsets.AzimuthSearch.log_companion`.
    """
    plots = _fewer(Plots.of(feed))
    pairs = candidates(plots, feed, partners, reach_deg=180.0)
    if not len(pairs.plot):
        return None
    log_companion = float(np.log(COMPANION)) if log_companion is None else log_companion
    width = float(bias_widths(feed)[AZIMUTH])
    limit_deg = azimuth_limit_deg(width)
    likelihood = _Likelihood.of(pairs, plots, bias_widths(feed))
    apart_deg = pairs.residual[:, 1] / pairs.jacobian[:, 1, FITTED.index(AZIMUTH)]
    grid, as_given = READINGS_DEG, likelihood.by_offset(apart_deg)
    if azimuth_deg is None:
        near = np.abs(grid) <= limit_deg
    else:
        near = np.abs(_wrapped(grid - azimuth_deg)) <= READING_NEAR_DEG
    log_prior = log_prior_of_azimuth(_wrapped(grid), width)
    given = _best(as_given, np.where(near, log_prior, -np.inf))
    azimuth_deg = float(grid[given.at])
    measured_deg = plots.azimuth_deg[pairs.plot]
    uniform = np.full(len(grid), np.log(MISREAD / 360.0))
    trials = [
        (MIRRORED, likelihood.by_offset(_wrapped(apart_deg - 2.0 * measured_deg)), uniform),
        (TURNED, as_given, np.where(np.abs(_wrapped(grid)) > limit_deg, uniform, -np.inf)),
        (UNREAD, likelihood.without_bearings(), np.log([MISREAD])),
    ]
    for words, heading_deg in _headings(feed, plots):
        turn_deg = heading_deg[pairs.plot]
        # On a steady course, bearings from the bow are bearings from north with an offset.
        differs = [_rms(_wrapped(turn_deg - offset + azimuth_deg)) > READING_SAME_DEG for offset in grid]
        of_reading = likelihood.by_offset(_wrapped(apart_deg + turn_deg))
        trials.append((words, of_reading, np.where(differs, uniform, -np.inf)))
    others = [(words, _best(of_reading, prior)) for words, of_reading, prior in trials]
    log_odds = [_log_odds(peak, given, -log_companion) for _, peak in others]
    # The preference of tracks for a reading is bounded only against the bearings as given.
    words, best = max(others, key=lambda one: one[1].log_posterior)
    bounded = best.log_likelihood - np.logaddexp(0.0, best.log_likelihood + log_companion)
    evidence = float(bounded.sum() - bounded.max() + best.log_prior)
    return BearingReading(*words, max(log_odds), evidence)


def _log_odds(one: _Peak, other: _Peak, limit: float) -> float:
    """Log-odds of one reading against another; the preference of each track is bounded."""
    lead = np.clip(one.log_likelihood - other.log_likelihood, -limit, limit)
    return float(lead.sum() + one.log_prior - other.log_prior)


@dataclass(frozen=True)
class _Peak:
    """(v,) ln L of each track at the most probable offset of a reading, the log prior density there, and its place."""

    log_likelihood: FloatArray
    log_prior: float
    at: int

    @property
    def log_posterior(self) -> float:
        return float(self.log_likelihood.sum()) + self.log_prior


def _best(log_likelihood: FloatArray, log_prior: FloatArray) -> _Peak:
    """The most probable of the offsets; log_likelihood : (s, v, g) of the scale of errors, track and offset."""
    s, g = np.unravel_index(np.argmax(log_likelihood.sum(axis=1) + log_prior), (len(log_likelihood), len(log_prior)))
    return _Peak(log_likelihood[s, :, g], float(log_prior[g]), int(g))


@dataclass(frozen=True)
class _Likelihood:
    """ln L of tracks, with what a pair contributes: (s, m) log density ratio at its own bearing and 1σ of that (°)."""

    pairs: PlotPairs
    log_ratio: FloatArray
    sigma_deg: FloatArray

    @classmethod
    def of(cls, pairs: PlotPairs, plots: Plots, widths: FloatArray) -> _Likelihood:
        """The biases other than the azimuth are integrated over their priors."""
        prior = pairs.variance_without_azimuth(widths)
        lever, step_deg = pairs.jacobian[:, 1, FITTED.index(AZIMUTH)], READING_STEP_DEG
        ratios, sigmas = [], []
        for scale, drift_deg in plots.spreads():
            variance = scale**2 * pairs.variance + prior + pairs.lasting_m2
            variance[:, 1] += (drift_deg**2 + 0.25 * step_deg**2) * lever**2
            along = -0.5 * np.log(variance[:, 0]) - 0.5 * pairs.residual[:, 0] ** 2 / variance[:, 0]
            ratios.append(along - LOG_2PI - 0.5 * np.log(variance[:, 1]) - np.log(pairs.background))
            sigmas.append(np.sqrt(variance[:, 1]) / lever)
        return cls(pairs, np.array(ratios), np.array(sigmas))

    def by_offset(self, apart_deg: FloatArray) -> FloatArray:
        """(s, v, g) ln L at the offsets of the grid; apart_deg : (m,) bearing of the plot minus that of the track, NaN
        where unknown."""
        grid = READINGS_DEG
        known = np.flatnonzero(np.isfinite(apart_deg))
        half = int(np.ceil(READING_WINDOW_DEG / READING_STEP_DEG))
        cell = np.round(apart_deg[known] / READING_STEP_DEG).astype(np.int64)[:, None] + np.arange(-half, half + 1)
        off_deg = cell * READING_STEP_DEG - apart_deg[known, None]
        at = (
            self.pairs.track[known, None] * len(grid) + (cell - round(grid[0] / READING_STEP_DEG)) % len(grid)
        ).ravel()
        out = []
        for log_ratio, sigma in zip(self.log_ratio[:, known], self.sigma_deg[:, known], strict=True):
            ratio = np.exp(log_ratio[:, None] - 0.5 * (off_deg / sigma[:, None]) ** 2).ravel()
            out.append(self._of_rates(ratio, at, len(grid)))
        return np.array(out)

    def without_bearings(self) -> FloatArray:
        """(s, v, 1) ln L if every bearing is as probable."""
        flat = self.log_ratio + np.log(self.sigma_deg) + 0.5 * LOG_2PI - np.log(360.0)
        return np.array([self._of_rates(np.exp(each), self.pairs.track, 1) for each in flat])

    def _of_rates(self, ratio: FloatArray, at: IntArray, cells: int) -> FloatArray:
        """(v, cells) ln of the mean over the rates of plots; at : of each ratio, its track × cells + its cell."""
        scans, rates = self.pairs.scans, PLOT_RATES
        size = len(scans) * cells
        terms = [
            np.bincount(at, np.log1p(rate * ratio), size).reshape(-1, cells) - rate * scans[:, None] for rate in rates
        ]
        return np.asarray(np.logaddexp.reduce(np.array(terms), axis=0) - np.log(len(rates)))


def _wrapped(angle_deg: FloatArray) -> FloatArray:
    return np.asarray((angle_deg + 180.0) % 360.0 - 180.0)


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.nanmean(values**2)))


def _fewer(plots: Plots) -> Plots:
    """The plots of evenly spread scans, at most ``READING_PLOTS`` of them or so."""
    step = int(np.ceil(len(plots) / READING_PLOTS))
    return plots if step < 2 else plots.take(np.flatnonzero(plots.scan // 4 % step == 0))


def _headings(feed: Feed, plots: Plots) -> list[tuple[Words, FloatArray]]:
    """The readings by the heading of the vessel that carries the sensor, or her course, with (n,) what they add to the
    bearings; none for a fixed sensor."""
    if not moves(plots.sensor):
        return []
    raw = feed.raw_reports
    if raw is not None:
        stated = raw.heading_deg if raw.station_heading_deg is None else raw.station_heading_deg
        if stated is not None and np.isfinite(stated[plots.rows]).any():
            return [(OF_BOW, np.asarray(stated[plots.rows])), (OF_NORTH, -np.asarray(stated[plots.rows]))]
    first = first_of_scans(plots)
    time_s, place = plots.time_s[first], plots.sensor[first]
    behind, ahead = (
        np.stack([np.interp(plots.time_s + off_s, time_s, axis) for axis in place.T])
        for off_s in (-READING_COURSE_S, READING_COURSE_S)
    )
    return [(OF_BOW, np.asarray(np.degrees(np.arctan2(*(ahead - behind)))))]

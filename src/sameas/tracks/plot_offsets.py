"""Offsets of a radar's plots without ids relative to tracks, from all plots of all scans.

A small radar in clutter detects one or two of the tracked vessels per scan, and ten echoes of land, buoys and sea: a
single scan does not determine an offset, all scans together do. Given biases θ, the plots of a track are a Poisson
process about its path,

    ln L(θ) = Σ_k ln(1 + μ N(z_k; h(t_k, θ), Σ_k) / β_k) − μ n

over plots k near it in n scans, averaged over the mean number μ of its plots per scan, so that a hull may give many
plots or none. β_k is the density of other plots at that place, per scan: plots at the same place some time before and
after, when a moving object would have left (fixed echoes), plus plots at the same range in any direction (sea clutter).

The plots of one object are not independent: errors of its hull, the antenna of the other source and its companions are
the same in all scans. So the evidence of a track is bounded: with probability ε another object accompanies the track,
and L/(1 + ε L) is its likelihood ratio against no object in common. ε is ``COMPANION``, or the share of
other azimuths at which some object seems to be a track, if that is larger. A radar may not see a track at all, such as
a boat in a marina: the likelihood of a track is 1 − φ + φ L, averaged over the share φ of the tracks that are seen. One
track alone establishes no offset: the evidence is that without the track that fits best.

The final fit is by EM (:mod:`sameas.tracks.plot_fit`).

The azimuth is searched over the whole range of its prior, which is a Cauchy distribution: a wrongly installed compass
may be off by any angle.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from operator import is_

import numpy as np

from sameas.arrays import FloatArray
from sameas.gaussian import LOG_2PI
from sameas.registration.solution import DECISIVE
from sameas.tracks.bearing_readings import best_other_reading
from sameas.tracks.bias_fit import BiasFit
from sameas.tracks.biases import AZIMUTH
from sameas.tracks.feed import Feed
from sameas.tracks.plot_fit import refined
from sameas.tracks.plot_pairs import (
    COMPANION,
    PLOT_RATES,
    PlotPairs,
    Plots,
    azimuth_limit_deg,
    candidates,
    log_mean_over_seen,
    log_prior_of_azimuth,
)
from sameas.tracks.snapshot import bias_widths

AZIMUTH_STEP_DEG, AZIMUTH_PEAKS = 0.1, 8  # steps of the search of the azimuth, and the most peaks
MAX_TRACKS = 30.0  # with more tracks than this in view, and more plots per scan, instants are compared instead


@dataclass(frozen=True)
class AzimuthSearch:
    """(g,) the azimuths of the grid, and (s, v, g) ln L of each scale of the errors, track and azimuth."""

    azimuth_deg: FloatArray
    log_likelihood: FloatArray

    def log_companion(self) -> float:
        """ln of the probability that another object than its own accompanies a track.

        At least ``COMPANION``, and the share of azimuths at which the plots of any object seem to be of a track, apart
        from the best azimuths of each: where many move, another one crosses its path at some azimuth.
        """
        best = np.argmax(self.log_likelihood, axis=2)[:, :, None]
        grid = np.arange(len(self.azimuth_deg))
        unlike = self.log_likelihood <= 0.0
        low = np.max(np.where(unlike & (grid < best), grid, -1), axis=2, keepdims=True)
        high = np.min(np.where(unlike & (grid > best), grid, len(grid)), axis=2, keepdims=True)
        elsewhere = (grid <= low) | (grid >= high)
        odds = np.log(COMPANION) + self.log_likelihood
        share = np.sum(np.exp(odds - np.logaddexp(0.0, odds)) * elsewhere) / max(int(elsewhere.sum()), 1)
        return float(np.log(max(share, COMPANION)))


def search_azimuth(pairs: PlotPairs, plots: Plots, widths: FloatArray) -> AzimuthSearch:
    """ln L of each track at each azimuth, with the other biases integrated over their priors."""
    reach = azimuth_limit_deg(widths[AZIMUTH])
    grid = np.linspace(-reach, reach, 2 * int(np.ceil(reach / AZIMUTH_STEP_DEG)) + 1)
    prior, spreads = pairs.variance_without_azimuth(widths), plots.spreads()
    out = np.zeros((len(spreads), len(pairs.scans), len(grid)))
    for number in range(len(pairs.scans)):
        own = pairs.track == number
        if not own.any():
            continue
        lever, residual = pairs.jacobian[own, 1, 1], pairs.residual[own]
        across = residual[:, 1, None] - lever[:, None] * grid
        for s, (scale, drift_deg) in enumerate(spreads):
            variance = scale**2 * pairs.variance[own] + prior[own] + pairs.lasting_m2
            variance[:, 1] += (drift_deg * lever) ** 2
            log_density = -LOG_2PI - 0.5 * np.log(variance).sum(axis=1) - 0.5 * residual[:, 0] ** 2 / variance[:, 0]
            ratio = np.exp(log_density[:, None] - 0.5 * across**2 / variance[:, 1, None])
            out[s, number] = _log_mean_over_rates(ratio / pairs.background[own, None], pairs.scans[number])
    return AzimuthSearch(grid, out)


def _log_mean_over_rates(ratio: FloatArray, scans: float) -> FloatArray:
    """(g,) ln of the mean over μ of the likelihood of plots with density ratios (m, g)."""
    rates = np.array(PLOT_RATES)
    terms = np.array([np.sum(np.log1p(rate * ratio), axis=0) - rate * scans for rate in rates])
    return np.asarray(np.logaddexp.reduce(terms, axis=0) - np.log(len(rates)))


def fit_plots(feed: Feed, partners: Sequence[Feed]) -> BiasFit | None:
    """The biases of a source of plots without ids, from the tracks of others.

    None if no plot is near a track, and if a scan may show many tracks: then single scans determine the biases, and
    tracks are near enough to be confused (use :func:`sameas.tracks.bias_fit.fit_biases`).
    """
    widths = bias_widths(feed)
    plots = Plots.of(feed)
    if not len(plots) or not partners:
        return None
    pairs = candidates(plots, feed, partners)
    # A scan shows at most as many tracks as it has plots.
    in_view = min(float(pairs.scans.sum()), float(len(plots)))
    if not len(pairs.plot) or in_view > MAX_TRACKS * (plots.scan.max() + 1):
        return None
    search = search_azimuth(pairs, plots, widths)
    # The evidence against no object in common is bounded per track; the comparison of azimuths is not.
    log_companion = search.log_companion()
    bounded = search.log_likelihood - np.logaddexp(0.0, search.log_likelihood + log_companion)
    log_prior = log_prior_of_azimuth(search.azimuth_deg, float(widths[AZIMUTH]))
    step = float(search.azimuth_deg[1] - search.azimuth_deg[0])
    log_posterior = np.logaddexp.reduce(log_mean_over_seen(bounded), axis=0) - np.log(len(bounded)) + log_prior
    peaks: list[tuple[float, int, int, slice]] = []
    for low, high in _peaks(log_posterior):
        inside = search.log_likelihood[:, :, low:high].sum(axis=1)
        scale, position = divmod(int(np.argmax(inside)), high - low)
        mass = float(np.logaddexp.reduce(log_posterior[low:high]) + np.log(step))
        peaks.append((mass, scale, low + position, slice(low, high)))
    evidence, s, at, peak = max(peaks, key=lambda one: one[:3])
    # An object that moves like one track by chance is no offset: the other tracks must agree by themselves.
    others = log_mean_over_seen(np.delete(bounded[s], np.argmax(bounded[s, :, at]), axis=0)) + log_prior
    evidence = min(evidence, float(np.logaddexp.reduce(others[peak]) + np.log(step)))
    spread = plots.spreads()[s]
    best = refined(pairs, widths, float(search.azimuth_deg[at]), spread, plots)
    rivals = []
    for other in [one[2] for one in peaks if one[2] != at]:
        # A track's preference between two azimuths is bounded like its evidence against no object in common.
        lead = search.log_likelihood[s, :, at] - search.log_likelihood[s, :, other]
        log_ratio = float(np.clip(lead, log_companion, -log_companion).sum() + log_prior[at] - log_prior[other])
        theta = np.where(best.biases == AZIMUTH, search.azimuth_deg[other], best.theta)
        if log_ratio < DECISIVE:
            # Two peaks of the search may be one solution.
            theta = refined(pairs, widths, float(search.azimuth_deg[other]), spread, plots).theta
            if _same(best, theta):
                continue
        rivals.append((theta, evidence - log_ratio))
    rivals.sort(key=lambda rival: -rival[1])
    azimuth_deg = float(best.theta[best.biases == AZIMUTH][0])
    reading = best_other_reading(feed, partners, azimuth_deg, log_companion)
    return replace(best, log_evidence=evidence, rivals=tuple(rivals), reading=reading)


class PlotFits:
    """A cache of :func:`fit_plots` for one scene: doubts and registration need the same fits."""

    def __init__(self) -> None:
        self._cache: list[tuple[Feed, tuple[Feed, ...], BiasFit | None]] = []

    def __call__(self, feed: Feed, partners: Sequence[Feed]) -> BiasFit | None:
        """The fit of a feed to its partners, from the cache if all of them are the same objects."""
        for known, others, fit in self._cache:
            if known is feed and len(others) == len(partners) and all(map(is_, others, partners)):
                return fit
        fit = fit_plots(feed, partners)
        self._cache.append((feed, tuple(partners), fit))
        return fit


def _same(best: BiasFit, theta: FloatArray) -> bool:
    """Whether biases have the azimuth of a fit, within two of its standard errors."""
    at = int(np.flatnonzero(best.biases == AZIMUTH)[0])
    return bool(abs(theta[at] - best.theta[at]) <= 2.0 * np.sqrt(best.covariance[at, at]))


def _peaks(log_density: FloatArray) -> list[tuple[int, int]]:
    """Index ranges (low, high) of the grid about its peaks, the highest first: each is connected and less than
    ``DECISIVE`` below its peak."""
    remaining = log_density.copy()
    peaks: list[tuple[int, int]] = []
    while len(peaks) < AZIMUTH_PEAKS and np.isfinite(remaining).any():
        at = int(np.argmax(remaining))
        below = np.flatnonzero(remaining < remaining[at] - DECISIVE)
        after = int(np.searchsorted(below, at))
        low = int(below[after - 1]) + 1 if after else 0
        high = int(below[after]) if after < len(below) else len(remaining)
        peaks.append((low, high))
        remaining[low:high] = -np.inf
    return peaks

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
and L/(1 + ε L) is its likelihood ratio against no object in common. ε is ``companion`` of the tuning, or the share of
other azimuths at which some object seems to be a track, if that is larger. One track alone establishes no offset: the
evidence is that without the track that fits best. A constant place of the echo on the hull is a parameter of each track
in the final fit, and so included in the standard errors.

The azimuth is searched over the whole range of its prior, which is a Cauchy distribution: a wrongly installed compass
may be off by any angle.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from operator import is_
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import FloatArray, IntArray
from sameas.gaussian import LOG_2PI, inverse
from sameas.ragged import flattened
from sameas.registration.offsets import RADIAN, line_of_sight, range_and_azimuth
from sameas.tracks.alignment import States, Succession, moved
from sameas.tracks.bias_fit import BiasFit
from sameas.tracks.biases import AZIMUTH, EAST, GAIN, NORTH, RANGE, TIME
from sameas.tracks.feed import Feed
from sameas.tracks.snapshot import bias_widths
from sameas.tracks.tuning import Tuning

#: The biases of a radar's plots, in the order of BIASES.
FITTED = (RANGE, AZIMUTH, GAIN, TIME)


def shows_bare_plots(feed: Feed) -> bool:
    """Whether a source's offsets are fitted from its plots: positions without ids, from a sensor with unknown
    azimuth bias and no unknown shift."""
    widths, reports = bias_widths(feed), feed.reports
    polar = isinstance(reports, States) and reports.track is None and feed.sensor_m is not None
    return polar and bool(widths[AZIMUTH] > 0.0) and not (widths[EAST] or widths[NORTH])


def shows_tracks(feed: Feed) -> bool:
    """Whether a source's records are tracks of objects."""
    return isinstance(feed.reports, States) and feed.reports.track is not None


@dataclass(frozen=True)
class Plots:
    """A radar's plots (n,): time, scan, position east and north, position of the sensor, range, azimuth (°).

    variance : (n, 2) m² along and across the line of sight, without the constant errors of an object.
    """

    time_s: FloatArray
    scan: IntArray
    position: FloatArray
    sensor: FloatArray
    range_m: FloatArray
    azimuth_deg: FloatArray
    variance: FloatArray

    @classmethod
    def of(cls, feed: Feed) -> Plots:
        """The plots of a feed, in order of time."""
        reports = feed.reports
        assert isinstance(reports, States) and feed.sensor_m is not None
        rows = np.flatnonzero(reports.usable & np.isfinite(feed.sensor_m).all(axis=1))
        rows = rows[np.argsort(reports.time_s[rows], kind="stable")]
        position, sensor = reports.state[rows, :2], feed.sensor_m[rows]
        range_m, azimuth, frame = _sight(position - sensor)
        stated = np.einsum("nav,nvw,naw->na", frame, reports.covariance[rows, :2, :2], frame)
        variance = np.maximum(stated - (feed.description.errors.extent_m or 0.0) ** 2, 0.05 * stated)
        scan = np.unique(feed.scan_s[rows], return_inverse=True)[1]
        return cls(reports.time_s[rows], scan, position, sensor, range_m, azimuth, variance)

    def __len__(self) -> int:
        return len(self.time_s)


def _sight(arm: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Range (at least 1 m), azimuth (°) and (n, 2, 2) unit vectors along and across (clockwise) lines of sight."""
    range_m, *frame = line_of_sight(arm, 1.0)
    return range_m, range_and_azimuth(arm)[:, 1], np.stack(frame, axis=-2)


@dataclass(frozen=True)
class PlotPairs:
    """Pairs of a plot and a track that are possible under any allowed biases, (m,) each.

    plot, track : their numbers. residual : (m, 2) range (m) and azimuth (as metres across) of the plot minus that of
    the track. jacobian : (m, 2, 4) of the residual by FITTED. variance : (m, 2) m², without the constant errors of a
    track. background : density of other plots at the plot, per m² and scan. scans : (v,) number of scans that may
    detect each track. lasting_m2 : variance per axis of the constant errors of a track. frame : (m, 2, 2) unit vectors
    along and across the line of sight.
    """

    plot: IntArray
    track: IntArray
    residual: FloatArray
    jacobian: FloatArray
    variance: FloatArray
    background: FloatArray
    scans: FloatArray
    lasting_m2: float
    frame: FloatArray


def candidates(plots: Plots, feed: Feed, partners: Sequence[Feed], tuning: Tuning) -> PlotPairs:
    """The candidate pairs of all plots and all tracks of the partners."""
    widths = bias_widths(feed)
    reach_deg = min(tuning.azimuth_reach * widths[AZIMUTH], 180.0)
    parts: list[tuple[NDArray[Any], ...]] = []
    scans: list[float] = []
    lasting = (feed.description.errors.extent_m or 0.0) ** 2
    scan_starts = _first_of_scans(plots)
    for partner in partners:
        lasting = max(lasting, sum((f.description.errors.extent_m or 0.0) ** 2 for f in (feed, partner)))
        for path in _paths(partner):
            state, covariance = path.at(plots.time_s)
            arm = state[:, :2] - plots.sensor
            range_m, azimuth, frame = _sight(arm)
            along, across = (np.einsum("nv,nvw,nw->n", frame[:, a], covariance[:, :2, :2], frame[:, a]) for a in (0, 1))
            known = np.maximum(along, across) < tuning.max_sigma_m**2
            known &= (range_m > tuning.own_platform_m) & (range_m <= (feed.description.coverage.range_m or np.inf))
            if not known.any():
                continue
            d_azimuth = (plots.azimuth_deg - azimuth + 180.0) % 360.0 - 180.0
            variance = plots.variance + np.column_stack([along, across])
            gate_m = tuning.gate_sigmas * np.sqrt(
                variance[:, 0] + lasting + widths[RANGE] ** 2 + (widths[GAIN] * range_m) ** 2
            )
            d_range = plots.range_m - range_m
            near = np.flatnonzero(known & (np.abs(d_range) <= gate_m) & (np.abs(d_azimuth) <= reach_deg))
            velocity = np.einsum("nav,nv->na", frame, state[:, 2:])[near]
            one, zero, r = np.ones(len(near)), np.zeros(len(near)), range_m[near]
            jacobian = np.stack(
                [np.stack([one, zero, r, -velocity[:, 0]], axis=-1),
                 np.stack([zero, RADIAN * r, zero, -velocity[:, 1]], axis=-1)], axis=-2,
            )  # fmt: skip
            residual = np.column_stack([d_range[near], RADIAN * d_azimuth[near] * r])
            parts.append((near, np.full(len(near), len(scans)), residual, jacobian, variance[near], frame[near]))
            scans.append(float(np.sum(known[scan_starts])))
    if not sum(len(part[0]) for part in parts):
        none, empty = np.empty(0, np.int64), np.empty((0, 2))
        return PlotPairs(
            none, none, empty, np.empty((0, 2, 4)), empty, np.empty(0), np.empty(0), lasting, np.empty((0, 2, 2))
        )
    plot, track, residual, jacobian, variance, frame = (np.concatenate(part) for part in zip(*parts, strict=True))
    in_gate = np.unique(plot)
    background = np.zeros(len(plots))
    background[in_gate] = _background(plots, in_gate, tuning)
    return PlotPairs(
        plot, track, residual, jacobian, variance, background[plot], np.array(scans), lasting, frame
    )  # fmt: skip


def _first_of_scans(plots: Plots) -> IntArray:
    """(l,) the first plot of each scan."""
    return np.unique(plots.scan, return_index=True)[1]


@dataclass(frozen=True)
class Path:
    """One track's reports in order: times (k,), states (k, 4), covariances (k, 4, 4), motion noise (k,) in m²/s³."""

    time_s: FloatArray
    state: FloatArray
    covariance: FloatArray
    walk: FloatArray

    def at(self, time_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """States and covariances at any times: the weighted mean of the reports before and after, moved there."""
        after = np.searchsorted(self.time_s, time_s, side="right")
        before, after = np.maximum(after - 1, 0), np.minimum(after, len(self.time_s) - 1)
        ends = [
            moved(self.state[k], self.covariance[k], time_s - self.time_s[k], self.walk[k]) for k in (before, after)
        ]
        # The weights are the precisions of the two moved positions.
        precision = [1.0 / np.einsum("nvv->n", covariance[:, :2, :2]) for _, covariance in ends]
        share = precision[0] / (precision[0] + precision[1])
        state = share[:, None] * ends[0][0] + (1.0 - share)[:, None] * ends[1][0]
        return state, share[:, None, None] * ends[0][1] + (1.0 - share)[:, None, None] * ends[1][1]


def _paths(feed: Feed) -> list[Path]:
    """The tracks of a source."""
    reports = feed.reports
    assert isinstance(reports, States) and reports.track is not None
    usable = np.flatnonzero(reports.usable)
    order = Succession.of(reports.time_s[usable], reports.track[usable])
    rows, walk = usable[order.rows], feed.walk_m2_per_s3
    ends = np.flatnonzero(order.final) + 1
    return [
        Path(reports.time_s[part], reports.state[part], reports.covariance[part], walk[part])
        for part in np.split(rows, ends[:-1])
    ]


def _background(plots: Plots, rows: IntArray, tuning: Tuning) -> FloatArray:
    """(m,) density of other plots at the plots ``rows``, per m² and scan: of fixed echoes, plus that of the range."""
    from scipy.spatial import cKDTree

    tree = cKDTree(plots.position)
    scans_s = plots.time_s[_first_of_scans(plots)]
    width = np.sqrt(2.0 * plots.variance[rows]) + tuning.echo_m
    frame = _sight(plots.position[rows] - plots.sensor[rows])[2]
    owner, other = flattened(tree.query_ball_point(plots.position[rows], 3.0 * width.max(axis=1), return_sorted=False))
    apart_s = np.abs(plots.time_s[other] - plots.time_s[rows[owner]])
    earliest_s, latest_s = tuning.background_from_s, tuning.background_to_s
    kept = (apart_s >= earliest_s) & (apart_s <= latest_s)
    owner, other = owner[kept], other[kept]
    step = np.einsum("mav,mv->ma", frame[owner], plots.position[other] - plots.position[rows[owner]]) / width[owner]
    kernel = np.exp(-0.5 * np.sum(step**2, axis=1)) / (2.0 * np.pi * width[owner].prod(axis=1))
    at = plots.time_s[rows]
    window = sum(
        np.searchsorted(scans_s, at + high) - np.searchsorted(scans_s, at + low)
        for low, high in ((-latest_s, -earliest_s), (earliest_s, latest_s))
    )
    fixed = np.bincount(owner, kernel, len(rows)) / np.maximum(window, 1)
    return fixed + _by_range(plots, rows, len(scans_s), tuning)


def _by_range(plots: Plots, rows: IntArray, n_scans: int, tuning: Tuning) -> FloatArray:
    """(m,) plots per m² and scan at the range of the plots ``rows``, averaged over all directions."""
    order = np.sort(plots.range_m)
    count = max(int(tuning.ring_share * len(order)), 10)
    middle = np.searchsorted(order, plots.range_m[rows])
    low, high = np.maximum(middle - count, 0), np.minimum(middle + count, len(order) - 1)
    inner, outer = np.where(low == 0, 0.0, order[low]), order[high] + 1.0
    return np.asarray((high - low) / (np.pi * (outer**2 - inner**2) * n_scans))


@dataclass(frozen=True)
class AzimuthSearch:
    """(g,) the azimuths of the grid, and (s, v, g) ln L of each scale of the errors, track and azimuth."""

    azimuth_deg: FloatArray
    log_likelihood: FloatArray

    def log_companion(self, tuning: Tuning) -> float:
        """ln of the probability that another object than its own accompanies a track.

        At least ``companion``, and the share of azimuths at which the plots of any object seem to be of a track, apart
        from the best azimuths of each: where many move, another one crosses its path at some azimuth.
        """
        best = np.argmax(self.log_likelihood, axis=2)[:, :, None]
        grid = np.arange(len(self.azimuth_deg))
        unlike = self.log_likelihood <= 0.0
        low = np.max(np.where(unlike & (grid < best), grid, -1), axis=2, keepdims=True)
        high = np.min(np.where(unlike & (grid > best), grid, len(grid)), axis=2, keepdims=True)
        elsewhere = (grid <= low) | (grid >= high)
        odds = np.log(tuning.companion) + self.log_likelihood
        share = np.sum(np.exp(odds - np.logaddexp(0.0, odds)) * elsewhere) / max(int(elsewhere.sum()), 1)
        return float(np.log(max(share, tuning.companion)))


def search_azimuth(pairs: PlotPairs, widths: FloatArray, tuning: Tuning) -> AzimuthSearch:
    """ln L of each track at each azimuth, with the other biases integrated over their priors."""
    reach = min(tuning.azimuth_reach * widths[AZIMUTH], 180.0)
    grid = np.linspace(-reach, reach, 2 * int(np.ceil(reach / tuning.azimuth_step_deg)) + 1)
    others = widths[list(FITTED)] * (np.arange(len(FITTED)) != FITTED.index(AZIMUTH))
    prior = np.einsum("map,p,map->ma", pairs.jacobian, others**2, pairs.jacobian)
    out = np.zeros((len(tuning.plot_scales), len(pairs.scans), len(grid)))
    for number in range(len(pairs.scans)):
        own = pairs.track == number
        if not own.any():
            continue
        lever, residual = pairs.jacobian[own, 1, 1], pairs.residual[own]
        across = residual[:, 1, None] - lever[:, None] * grid
        for s, scale in enumerate(tuning.plot_scales):
            variance = scale**2 * pairs.variance[own] + prior[own] + pairs.lasting_m2
            log_density = -LOG_2PI - 0.5 * np.log(variance).sum(axis=1) - 0.5 * residual[:, 0] ** 2 / variance[:, 0]
            ratio = np.exp(log_density[:, None] - 0.5 * across**2 / variance[:, 1, None])
            out[s, number] = _log_mean_over_rates(ratio / pairs.background[own, None], pairs.scans[number], tuning)
    return AzimuthSearch(grid, out)


def _log_mean_over_rates(ratio: FloatArray, scans: float, tuning: Tuning) -> FloatArray:
    """(g,) ln of the mean over μ of the likelihood of plots with density ratios (m, g)."""
    rates = np.array(tuning.plot_rates)
    terms = np.array([np.sum(np.log1p(rate * ratio), axis=0) - rate * scans for rate in rates])
    return np.asarray(np.logaddexp.reduce(terms, axis=0) - np.log(len(rates)))


def fit_plots(feed: Feed, partners: Sequence[Feed]) -> BiasFit | None:
    """The biases of a source of plots without ids (:func:`shows_bare_plots`), from the tracks of others.

    None if no plot is near a track, and if a scan may show many tracks: then single scans determine the biases, and
    tracks are near enough to be confused (use :func:`sameas.tracks.bias_fit.fit_biases`).
    """
    tuning, widths = feed.tuning, bias_widths(feed)
    plots = Plots.of(feed)
    if not len(plots) or not partners:
        return None
    pairs = candidates(plots, feed, partners, tuning)
    if not len(pairs.plot) or pairs.scans.sum() > tuning.max_tracks * (plots.scan.max() + 1):
        return None
    search = search_azimuth(pairs, widths, tuning)
    # The evidence against no object in common is bounded per track; the comparison of azimuths is not.
    log_companion = search.log_companion(tuning)
    bounded = search.log_likelihood - np.logaddexp(0.0, search.log_likelihood + log_companion)
    width = float(widths[AZIMUTH])
    log_prior = -np.log(np.pi * width * (1.0 + (search.azimuth_deg / width) ** 2))
    step = float(search.azimuth_deg[1] - search.azimuth_deg[0])
    log_posterior = np.logaddexp.reduce(bounded.sum(axis=1), axis=0) - np.log(len(tuning.plot_scales)) + log_prior
    peaks: list[tuple[float, int, int, slice]] = []
    for low, high in _peaks(log_posterior, tuning):
        inside = search.log_likelihood[:, :, low:high].sum(axis=1)
        scale, position = divmod(int(np.argmax(inside)), high - low)
        mass = float(np.logaddexp.reduce(log_posterior[low:high]) + np.log(step))
        peaks.append((mass, scale, low + position, slice(low, high)))
    evidence, s, at, peak = max(peaks, key=lambda one: one[:3])
    # An object that moves like one track by chance is no offset: the other tracks must agree by themselves.
    others = np.delete(bounded[s], np.argmax(bounded[s, :, at]), axis=0).sum(axis=0) + log_prior
    evidence = min(evidence, float(np.logaddexp.reduce(others[peak]) + np.log(step)))
    start = np.zeros(len(FITTED))
    start[FITTED.index(AZIMUTH)] = search.azimuth_deg[at]
    best = _refined(pairs, widths, start, tuning.plot_scales[s], plots, tuning)
    rivals = []
    for other in [one[2] for one in peaks if one[2] != at]:
        # A track's preference between two azimuths is bounded like its evidence against no object in common.
        lead = search.log_likelihood[s, :, at] - search.log_likelihood[s, :, other]
        limit = -log_companion
        log_ratio = float(np.clip(lead, -limit, limit).sum() + log_prior[at] - log_prior[other])
        theta = np.where(best.biases == AZIMUTH, search.azimuth_deg[other], best.theta)
        if log_ratio < tuning.registration.decisive:
            # Two peaks of the search may be one solution.
            start = np.where(np.arange(len(FITTED)) == FITTED.index(AZIMUTH), search.azimuth_deg[other], 0.0)
            theta = _refined(pairs, widths, start, tuning.plot_scales[s], plots, tuning).theta
            if _same(best, theta):
                continue
        rivals.append((theta, evidence - log_ratio))
    rivals.sort(key=lambda rival: -rival[1])
    return replace(best, log_evidence=evidence, rivals=tuple(rivals))


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


def _peaks(log_density: FloatArray, tuning: Tuning) -> list[tuple[int, int]]:
    """Index ranges (low, high) of the grid about its peaks, the highest first: each is connected and less than
    ``decisive`` below its peak."""
    remaining = log_density.copy()
    peaks: list[tuple[int, int]] = []
    while len(peaks) < tuning.azimuth_peaks and np.isfinite(remaining).any():
        at = int(np.argmax(remaining))
        below = np.flatnonzero(remaining < remaining[at] - tuning.registration.decisive)
        after = int(np.searchsorted(below, at))
        low = int(below[after - 1]) + 1 if after else 0
        high = int(below[after]) if after < len(below) else len(remaining)
        peaks.append((low, high))
        remaining[low:high] = -np.inf
    return peaks


def _refined(
    pairs: PlotPairs, widths: FloatArray, start: FloatArray, scale: float, plots: Plots, tuning: Tuning
) -> BiasFit:
    """The biases near a start, by EM over plots and tracks, with a constant place of the echo on each hull."""
    fitted = [p for p, k in enumerate(FITTED) if widths[k] > 0.0]
    precision = widths[[FITTED[p] for p in fitted]] ** -2.0
    # The azimuth's prior has the width of the search: its tails are wide.
    precision[fitted.index(FITTED.index(AZIMUTH))] = (tuning.azimuth_reach * widths[AZIMUTH]) ** -2.0
    tracks, p = len(pairs.scans), len(fitted)
    theta, hull = start[fitted], np.zeros((tracks, 2))
    rate = np.full(tracks, float(np.median(tuning.plot_rates)))
    scales, converged, axes = np.full(2, scale), False, 2 * tracks
    lasting_m2 = pairs.lasting_m2
    jacobian = pairs.jacobian[:, :, fitted]
    design = _design(pairs, jacobian)
    for step in range(tuning.max_steps):
        residual = pairs.residual - jacobian @ theta - np.einsum("mav,mv->ma", pairs.frame, hull[pairs.track])
        variance = scales**2 * pairs.variance
        weight = _probabilities(pairs, residual, variance, rate, len(plots))
        total = np.bincount(pairs.track, weight, tracks)
        rate = (total + tuning.rate_prior) / (pairs.scans + tuning.rate_prior / np.median(tuning.plot_rates))
        weighted = design * (weight[:, None] / variance)[:, :, None]
        target = residual + np.einsum("map,p->ma", design, np.concatenate([theta, hull.ravel()]))
        information = np.einsum("map,maq->pq", weighted, design)
        information[np.diag_indices(p + axes)] += np.concatenate([precision, np.full(axes, 1.0 / lasting_m2)])
        posterior_covariance = inverse(information)
        solution = posterior_covariance @ np.einsum("map,ma->p", weighted, target)
        change = np.abs(solution[:p] - theta) * np.sqrt(np.diag(information)[:p])
        theta, hull = solution[:p], solution[p:].reshape(tracks, 2)
        # The variance of places on the hull is estimated from the detected tracks.
        detected = np.repeat(total > tuning.min_plots, 2)
        square = float(np.sum((hull.ravel() ** 2 + np.diag(posterior_covariance)[p:])[detected]))
        lasting_m2 = (square + tuning.hull_prior * pairs.lasting_m2) / (detected.sum() + tuning.hull_prior)
        chi_sq = np.einsum("m,ma->a", weight, residual**2 / pairs.variance)
        scales = np.clip(
            np.sqrt((chi_sq + tuning.scale_prior * scale**2) / (weight.sum() + tuning.scale_prior)),
            *tuning.scale_limits,
        )  # fmt: skip
        converged = bool(step > 3 and np.all(change < tuning.step_tolerance))
        if converged:
            break
    sure = weight > 0.5
    inflation = _variance_inflation(plots.time_s[pairs.plot[sure]], (residual[:, 1] / np.sqrt(variance[:, 1]))[sure])
    prior = np.diag(np.concatenate([precision, np.full(axes, 1.0 / lasting_m2)]))
    covariance = inverse((information - prior) / inflation + prior)[:p, :p]
    speed = np.hypot(*pairs.jacobian[sure, :, FITTED.index(TIME)].T)
    return BiasFit(
        np.array([FITTED[k] for k in fitted], np.int64), theta, covariance, covariance, float(weight.sum()),
        int(plots.scan.max()) + 1, float(np.sum(total > tuning.min_plots)), 0.0, (), converged, tuning,
        float(np.median(speed)) if sure.any() else 0.0,
    )  # fmt: skip


def _design(pairs: PlotPairs, jacobian: FloatArray) -> FloatArray:
    """(m, 2, p + 2 t) derivatives of the residuals by p biases, then by east and north of t echoes on their hulls."""
    rows, p = np.arange(len(pairs.plot)), jacobian.shape[2]
    design = np.zeros((len(rows), 2, p + 2 * len(pairs.scans)))
    design[:, :, :p] = jacobian
    for axis in (0, 1):
        design[rows, :, p + 2 * pairs.track + axis] = pairs.frame[:, :, axis]
    return design


def _probabilities(
    pairs: PlotPairs, residual: FloatArray, variance: FloatArray, rate: FloatArray, plots: int
) -> FloatArray:
    """(m,) probability of each pair of a plot and a track, with residuals and their variances (m, 2).

    rate : (t,) expected plots of each track per scan. plots : their number.
    """
    log_ratio = (
        np.log(rate[pairs.track]) - LOG_2PI - 0.5 * np.log(variance).sum(axis=1)
        - 0.5 * np.sum(residual**2 / variance, axis=1) - np.log(pairs.background)
    )  # fmt: skip
    ratio = np.exp(np.clip(log_ratio, -700.0, 300.0))
    return np.asarray(ratio / (1.0 + np.bincount(pairs.plot, ratio, plots)[pairs.plot]))


def _variance_inflation(time_s: FloatArray, error: FloatArray) -> float:
    """The factor on the variance by correlated errors, at least 1, from times (m,) and errors across (m,) in σ.

    Heading errors of the sensor are common to all tracks for some time, so sums over blocks of 60 s scatter more than
    those of independent plots.
    """
    block = ((time_s - time_s.min(initial=0.0)) // 60.0).astype(np.int64)
    independent = float(np.sum(error**2))
    return max(float(np.sum(np.bincount(block, error) ** 2)) / independent, 1.0) if independent > 0.0 else 1.0

"""Offsets of a radar's bare plots against tracks, by every plot of every scan.

A small radar in clutter shows one or two of the vessels that others name in a scan, and ten echoes of land, buoys and
sea: no scan tells an offset, all of them together do. Every track that may be in sight is one voter. Given biases θ its
plots are a Poisson process about its path,

    ln L(θ) = Σ_k ln(1 + μ N(z_k; h(t_k, θ), Σ_k) / β_k) − μ n

over plots k near it in n scans, averaged over the mean number μ of its plots in a scan, so that a hull may give many
plots or none. β_k is the density of other plots at that place, per scan: those that the radar shows there some time
before and after, when a moving object has gone, so that what stays in place is background and not chance, and those at
this range in any direction, such as the sea's.

Plots of one object agree or disagree together: its hull, the other source's antenna and the company it keeps err alike
in all scans. So a track's vote saturates: with probability ε something else moves beside a track of its own, and
L/(1 + ε L) is what counts against nothing in common. The place of an echo on the hull that stays is a number of each
track in the last fit, and so in the standard errors.

The azimuth is searched over all that its prior allows, whose tails are Cauchy's: a compass that is set up wrongly is so
by any angle.
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
from sameas.registration.offsets import RADIAN
from sameas.tracks.alignment import States, Succession, moved
from sameas.tracks.bias_fit import BiasFit
from sameas.tracks.biases import AZIMUTH, EAST, GAIN, NORTH, RANGE, TIME
from sameas.tracks.feed import Feed
from sameas.tracks.snapshot import bias_widths
from sameas.tracks.tuning import Tuning

#: The biases of a radar's plots, in the order of BIASES.
FITTED = (RANGE, AZIMUTH, GAIN, TIME)


def shows_bare_plots(feed: Feed) -> bool:
    """Whether a source's offsets are found by its plots: positions without names, by a sensor that may be turned."""
    widths, reports = bias_widths(feed), feed.reports
    polar = isinstance(reports, States) and reports.track is None and feed.sensor_m is not None
    return polar and bool(widths[AZIMUTH] > 0.0) and not (widths[EAST] or widths[NORTH])


def shows_tracks(feed: Feed) -> bool:
    """Whether a source's records are tracks of objects."""
    return isinstance(feed.reports, States) and feed.reports.track is not None


@dataclass(frozen=True)
class Plots:
    """A radar's plots (n,): time, scan, place east and north, place of the sensor, range, azimuth (°).

    variance : (n, 2) m² along and across the line of sight, without what stays with an object.
    """

    time_s: FloatArray
    scan: IntArray
    place: FloatArray
    sensor: FloatArray
    range_m: FloatArray
    azimuth_deg: FloatArray
    variance: FloatArray

    @classmethod
    def of(cls, feed: Feed) -> Plots:
        """In the order of time."""
        reports = feed.reports
        assert isinstance(reports, States) and feed.sensor_m is not None
        rows = np.flatnonzero(reports.usable & np.isfinite(feed.sensor_m).all(axis=1))
        rows = rows[np.argsort(reports.time_s[rows], kind="stable")]
        place, sensor = reports.state[rows, :2], feed.sensor_m[rows]
        away, azimuth, frame = _sight(place - sensor)
        spread = np.einsum("nav,nvw,naw->na", frame, reports.covariance[rows, :2, :2], frame)
        least = np.maximum(spread - (feed.description.errors.extent_m or 0.0) ** 2, 0.05 * spread)
        scan = np.unique(feed.scan_s[rows], return_inverse=True)[1]
        return cls(reports.time_s[rows], scan, place, sensor, away, azimuth, least)

    def __len__(self) -> int:
        return len(self.time_s)


def _sight(arm: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Range, azimuth (°) and (n, 2, 2) unit vectors along and across (clockwise) lines of sight (n, 2)."""
    angle = np.arctan2(arm[:, 0], arm[:, 1])
    sine, cosine = np.sin(angle), np.cos(angle)
    frame = np.stack([np.stack([sine, cosine], axis=-1), np.stack([cosine, -sine], axis=-1)], axis=-2)
    return np.maximum(np.hypot(*arm.T), 1.0), np.degrees(angle), frame


@dataclass(frozen=True)
class Candidates:
    """Plots that may be of tracks, whatever the biases (m,).

    plot, track : numbers. residual : (m, 2) range (m) and azimuth (as metres across) by which the plot is beyond the
    track's place. jacobian : (m, 2, 4) of that by FITTED. variance : (m, 2) m², without what stays with a track.
    background : other plots per m² and scan at the plot. scans : (v,) scans in which each track may be shown.
    lasting_m2 : variance per axis of what stays with a track. frame : (m, 2, 2) along and across the line of sight.
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


def candidates(plots: Plots, feed: Feed, partners: Sequence[Feed], tuning: Tuning) -> Candidates:
    """All plots within the reach of the biases of all tracks of the partners."""
    widths = bias_widths(feed)
    reach_deg = min(tuning.azimuth_reach * widths[AZIMUTH], 180.0)
    parts: list[tuple[NDArray[Any], ...]] = []
    scans: list[float] = []
    lasting = (feed.description.errors.extent_m or 0.0) ** 2
    looks = _first_of_scans(plots)
    for partner in partners:
        lasting = max(lasting, sum((f.description.errors.extent_m or 0.0) ** 2 for f in (feed, partner)))
        for path in _paths(partner):
            state, spread = path.at(plots.time_s)
            arm = state[:, :2] - plots.sensor
            away, azimuth, frame = _sight(arm)
            along, across = (np.einsum("nv,nvw,nw->n", frame[:, a], spread[:, :2, :2], frame[:, a]) for a in (0, 1))
            known = np.maximum(along, across) < tuning.path_m**2
            known &= (away > tuning.beside_m) & (away <= (feed.description.coverage.range_m or np.inf))
            if not known.any():
                continue
            turn = (plots.azimuth_deg - azimuth + 180.0) % 360.0 - 180.0
            variance = plots.variance + np.column_stack([along, across])
            slack = tuning.gate_sigmas * np.sqrt(
                variance[:, 0] + lasting + widths[RANGE] ** 2 + (widths[GAIN] * away) ** 2
            )
            beyond = plots.range_m - away
            near = np.flatnonzero(known & (np.abs(beyond) <= slack) & (np.abs(turn) <= reach_deg))
            velocity = np.einsum("nav,nv->na", frame, state[:, 2:])[near]
            one, zero, r = np.ones(len(near)), np.zeros(len(near)), away[near]
            jacobian = np.stack(
                [np.stack([one, zero, r, -velocity[:, 0]], axis=-1),
                 np.stack([zero, RADIAN * r, zero, -velocity[:, 1]], axis=-1)], axis=-2,
            )  # fmt: skip
            residual = np.column_stack([beyond[near], RADIAN * turn[near] * r])
            parts.append((near, np.full(len(near), len(scans)), residual, jacobian, variance[near], frame[near]))
            scans.append(float(np.sum(known[looks])))
    if not sum(len(part[0]) for part in parts):
        none, empty = np.empty(0, np.int64), np.empty((0, 2))
        return Candidates(
            none, none, empty, np.empty((0, 2, 4)), empty, np.empty(0), np.empty(0), lasting, np.empty((0, 2, 2))
        )
    plot, track, residual, jacobian, variance, frame = (np.concatenate(part) for part in zip(*parts, strict=True))
    shown = np.unique(plot)
    background = np.zeros(len(plots))
    background[shown] = _background(plots, shown, tuning)
    return Candidates(
        plot, track, residual, jacobian, variance, background[plot], np.array(scans), lasting, frame
    )  # fmt: skip


def _first_of_scans(plots: Plots) -> IntArray:
    """One plot of each scan."""
    return np.unique(plots.scan, return_index=True)[1]


@dataclass(frozen=True)
class Path:
    """One track's reports in order: times, states (k, 4), covariances (k, 4, 4), q (k,) of its motion, timeout."""

    time_s: FloatArray
    state: FloatArray
    covariance: FloatArray
    walk: FloatArray

    def at(self, time_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """States and covariances at any times: of the reports before and after, each moved there."""
        after = np.searchsorted(self.time_s, time_s, side="right")
        before, after = np.maximum(after - 1, 0), np.minimum(after, len(self.time_s) - 1)
        ends = [
            moved(self.state[k], self.covariance[k], time_s - self.time_s[k], self.walk[k]) for k in (before, after)
        ]
        # The nearer in certainty counts more; a report is moved by its velocity either way.
        trust = [1.0 / np.einsum("nvv->n", spread[:, :2, :2]) for _, spread in ends]
        share = trust[0] / (trust[0] + trust[1])
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
    """(m,) density of other plots at some of the plots, per m² and scan: of what stays in place, and of the range."""
    from scipy.spatial import cKDTree

    tree = cKDTree(plots.place)
    looks = plots.time_s[_first_of_scans(plots)]
    width = np.sqrt(2.0 * plots.variance[rows]) + tuning.echo_m
    frame = _sight(plots.place[rows] - plots.sensor[rows])[2]
    owner, other = flattened(tree.query_ball_point(plots.place[rows], 3.0 * width.max(axis=1), return_sorted=False))
    apart_s = np.abs(plots.time_s[other] - plots.time_s[rows[owner]])
    kept = (apart_s >= tuning.gone_s) & (apart_s <= tuning.stays_s)
    owner, other = owner[kept], other[kept]
    step = np.einsum("mav,mv->ma", frame[owner], plots.place[other] - plots.place[rows[owner]]) / width[owner]
    kernel = np.exp(-0.5 * np.sum(step**2, axis=1)) / (2.0 * np.pi * width[owner].prod(axis=1))
    at = plots.time_s[rows]
    window = sum(
        np.searchsorted(looks, at + high) - np.searchsorted(looks, at + low)
        for low, high in ((-tuning.stays_s, -tuning.gone_s), (tuning.gone_s, tuning.stays_s))
    )
    stays = np.bincount(owner, kernel, len(rows)) / np.maximum(window, 1)
    return stays + _by_range(plots, rows, len(looks), tuning)


def _by_range(plots: Plots, rows: IntArray, looks: int, tuning: Tuning) -> FloatArray:
    """(m,) plots per m² and scan at the range of some of the plots, in whatever direction."""
    order = np.sort(plots.range_m)
    count = max(int(tuning.ring_share * len(order)), 10)
    middle = np.searchsorted(order, plots.range_m[rows])
    low, high = np.maximum(middle - count, 0), np.minimum(middle + count, len(order) - 1)
    inner, outer = np.where(low == 0, 0.0, order[low]), order[high] + 1.0
    return np.asarray((high - low) / (np.pi * (outer**2 - inner**2) * looks))


@dataclass(frozen=True)
class Vote:
    """What the tracks say of azimuths: (g,) the grid, (s, v, g) ln L of each scale of the errors, track and azimuth."""

    azimuth_deg: FloatArray
    log_likelihood: FloatArray


def voted(all_of: Candidates, widths: FloatArray, tuning: Tuning) -> Vote:
    """The search: ln L of every track at every azimuth, all other biases averaged over their priors."""
    reach = min(tuning.azimuth_reach * widths[AZIMUTH], 180.0)
    grid = np.linspace(-reach, reach, 2 * int(np.ceil(reach / tuning.azimuth_step_deg)) + 1)
    free = widths[list(FITTED)] * (np.arange(len(FITTED)) != FITTED.index(AZIMUTH))
    prior = np.einsum("map,p,map->ma", all_of.jacobian, free**2, all_of.jacobian)
    out = np.zeros((len(tuning.plot_scales), len(all_of.scans), len(grid)))
    for number in range(len(all_of.scans)):
        mine = all_of.track == number
        if not mine.any():
            continue
        lever, residual = all_of.jacobian[mine, 1, 1], all_of.residual[mine]
        across = residual[:, 1, None] - lever[:, None] * grid
        for s, scale in enumerate(tuning.plot_scales):
            variance = scale**2 * all_of.variance[mine] + prior[mine] + all_of.lasting_m2
            log_density = -LOG_2PI - 0.5 * np.log(variance).sum(axis=1) - 0.5 * residual[:, 0] ** 2 / variance[:, 0]
            ratio = np.exp(log_density[:, None] - 0.5 * across**2 / variance[:, 1, None])
            out[s, number] = _averaged(ratio / all_of.background[mine, None], all_of.scans[number], tuning)
    return Vote(grid, out)


def _averaged(ratio: FloatArray, scans: float, tuning: Tuning) -> FloatArray:
    """(g,) ln of the mean over μ of the likelihood of plots with density ratios (m, g)."""
    rates = np.array(tuning.plot_rates)
    terms = np.array([np.sum(np.log1p(rate * ratio), axis=0) - rate * scans for rate in rates])
    return np.asarray(np.logaddexp.reduce(terms, axis=0) - np.log(len(rates)))


def fit_plots(feed: Feed, partners: Sequence[Feed]) -> BiasFit | None:
    """The biases of a source of bare plots (:func:`shows_bare_plots`) by the tracks of others.

    None where none meet, and where a scan may show many tracks: there each scan tells by itself, and tracks are near
    enough to each other to be taken for one another (:func:`sameas.tracks.bias_fit.fit_biases`).
    """
    tuning, widths = feed.tuning, bias_widths(feed)
    plots = Plots.of(feed)
    if not len(plots) or not partners:
        return None
    all_of = candidates(plots, feed, partners, tuning)
    if not len(all_of.plot) or all_of.scans.sum() > tuning.many_tracks * (plots.scan.max() + 1):
        return None
    vote = voted(all_of, widths, tuning)
    # What counts against nothing in common saturates; what tells azimuths from each other does not.
    saturated = vote.log_likelihood - np.logaddexp(0.0, vote.log_likelihood + np.log(tuning.companion))
    width = float(widths[AZIMUTH])
    log_prior = -np.log(np.pi * width * (1.0 + (vote.azimuth_deg / width) ** 2))
    step = float(vote.azimuth_deg[1] - vote.azimuth_deg[0])
    whole = np.logaddexp.reduce(saturated.sum(axis=1), axis=0) - np.log(len(tuning.plot_scales)) + log_prior
    peaks: list[tuple[float, int, int]] = []
    for low, high in _peaks(whole, tuning):
        inside = vote.log_likelihood[:, :, low:high].sum(axis=1)
        scale, place = divmod(int(np.argmax(inside)), high - low)
        peaks.append((float(np.logaddexp.reduce(whole[low:high]) + np.log(step)), scale, low + place))
    evidence, s, at = max(peaks)
    start = np.zeros(len(FITTED))
    start[FITTED.index(AZIMUTH)] = vote.azimuth_deg[at]
    best = _refined(all_of, widths, start, tuning.plot_scales[s], plots, tuning)
    rivals = []
    for _, _, other in [peak for peak in peaks if peak[2] != at]:
        # No track's preference of one azimuth to another counts more than that against nothing in common.
        ahead = vote.log_likelihood[s, :, at] - vote.log_likelihood[s, :, other]
        limit = -float(np.log(tuning.companion))
        less = float(np.clip(ahead, -limit, limit).sum() + log_prior[at] - log_prior[other])
        theta = np.where(best.biases == AZIMUTH, vote.azimuth_deg[other], best.theta)
        if less < tuning.registration.decisive:
            # Two peaks of the search may be one solution.
            begin = np.where(np.arange(len(FITTED)) == FITTED.index(AZIMUTH), vote.azimuth_deg[other], 0.0)
            theta = _refined(all_of, widths, begin, tuning.plot_scales[s], plots, tuning).theta
            if _same(best, theta):
                continue
        rivals.append((theta, evidence - less))
    rivals.sort(key=lambda rival: -rival[1])
    return replace(best, log_evidence=evidence, rivals=tuple(rivals))


class PlotFits:
    """:func:`fit_plots` of the sources of one scene, each fit made once: doubts and registration ask for the same."""

    def __init__(self) -> None:
        self._kept: list[tuple[Feed, tuple[Feed, ...], BiasFit | None]] = []

    def __call__(self, feed: Feed, partners: Sequence[Feed]) -> BiasFit | None:
        """The fit of a feed to its partners; that which is kept where all of them are the same objects."""
        for known, others, fit in self._kept:
            if known is feed and len(others) == len(partners) and all(map(is_, others, partners)):
                return fit
        fit = fit_plots(feed, partners)
        self._kept.append((feed, tuple(partners), fit))
        return fit


def _same(best: BiasFit, theta: FloatArray) -> bool:
    """Whether biases have the azimuth of a fit, within two of its standard errors."""
    at = int(np.flatnonzero(best.biases == AZIMUTH)[0])
    return bool(abs(theta[at] - best.theta[at]) <= 2.0 * np.sqrt(best.covariance[at, at]))


def _peaks(log_density: FloatArray, tuning: Tuning) -> list[tuple[int, int]]:
    """Ranges of the grid about its peaks, the highest first: all that is connected to a peak and not far below it."""
    left = log_density.copy()
    peaks: list[tuple[int, int]] = []
    while len(peaks) < tuning.azimuth_peaks and np.isfinite(left).any():
        at = int(np.argmax(left))
        out = np.flatnonzero(left < left[at] - tuning.registration.decisive)
        after = int(np.searchsorted(out, at))
        low = int(out[after - 1]) + 1 if after else 0
        high = int(out[after]) if after < len(out) else len(left)
        peaks.append((low, high))
        left[low:high] = -np.inf
    return peaks


def _refined(
    all_of: Candidates, widths: FloatArray, start: FloatArray, scale: float, plots: Plots, tuning: Tuning
) -> BiasFit:
    """The biases about a start, by EM over plots and tracks, with a place on each hull that stays."""
    fitted = [p for p, k in enumerate(FITTED) if widths[k] > 0.0]
    precision = widths[[FITTED[p] for p in fitted]] ** -2.0
    # The azimuth's prior is that of the search: its tails are wide.
    precision[fitted.index(FITTED.index(AZIMUTH))] = (tuning.azimuth_reach * widths[AZIMUTH]) ** -2.0
    tracks, p = len(all_of.scans), len(fitted)
    theta, hull = start[fitted], np.zeros((tracks, 2))
    rate = np.full(tracks, float(np.median(tuning.plot_rates)))
    scales, settled, axes = np.full(2, scale), False, 2 * tracks
    lasting_m2 = all_of.lasting_m2
    frame = all_of.frame
    jacobian = all_of.jacobian[:, :, fitted]
    rows = np.arange(len(all_of.plot))
    for step in range(tuning.most_steps):
        left = all_of.residual - jacobian @ theta - np.einsum("mav,mv->ma", frame, hull[all_of.track])
        variance = scales**2 * all_of.variance
        log_ratio = (
            np.log(rate[all_of.track]) - LOG_2PI - 0.5 * np.log(variance).sum(axis=1)
            - 0.5 * np.sum(left**2 / variance, axis=1) - np.log(all_of.background)
        )  # fmt: skip
        ratio = np.exp(np.clip(log_ratio, -700.0, 300.0))
        weight = ratio / (1.0 + np.bincount(all_of.plot, ratio, len(plots))[all_of.plot])
        total = np.bincount(all_of.track, weight, tracks)
        rate = (total + tuning.rate_prior) / (all_of.scans + tuning.rate_prior / np.median(tuning.plot_rates))
        # Unknowns: the biases, then east and north of each track's place.
        design = np.zeros((len(rows), 2, p + axes))
        design[:, :, :p] = jacobian
        for axis in (0, 1):
            design[rows, :, p + 2 * all_of.track + axis] = frame[:, :, axis]
        pull = design * (weight[:, None] / variance)[:, :, None]
        target = left + np.einsum("map,p->ma", design, np.concatenate([theta, hull.ravel()]))
        information = np.einsum("map,maq->pq", pull, design)
        information[np.diag_indices(p + axes)] += np.concatenate([precision, np.full(axes, 1.0 / lasting_m2)])
        known = inverse(information)
        both = known @ np.einsum("map,ma->p", pull, target)
        moved_by = np.abs(both[:p] - theta) * np.sqrt(np.diag(information)[:p])
        theta, hull = both[:p], both[p:].reshape(tracks, 2)
        # By how much hulls and antennas lie beside each other is learned from the tracks that are seen.
        seen = np.repeat(total > tuning.seen, 2)
        square = float(np.sum((hull.ravel() ** 2 + np.diag(known)[p:])[seen]))
        lasting_m2 = (square + tuning.hull_prior * all_of.lasting_m2) / (seen.sum() + tuning.hull_prior)
        due = np.einsum("m,ma->a", weight, left**2 / all_of.variance)
        scales = np.clip(
            np.sqrt((due + tuning.scale_prior * scale**2) / (weight.sum() + tuning.scale_prior)),
            *tuning.scale_limits,
        )  # fmt: skip
        settled = bool(step > 3 and np.all(moved_by < tuning.settled))
        if settled:
            break
    sure = weight > 0.5
    together = _together(plots.time_s[all_of.plot[sure]], (left[:, 1] / np.sqrt(variance[:, 1]))[sure])
    held = np.diag(np.concatenate([precision, np.full(axes, 1.0 / lasting_m2)]))
    covariance = inverse((information - held) / together + held)[:p, :p]
    return BiasFit(
        np.array([FITTED[k] for k in fitted], np.int64), theta, covariance, covariance, float(weight.sum()),
        int(plots.scan.max()) + 1, float(np.sum(total > tuning.seen)), 0.0, (), settled, tuning,
    )  # fmt: skip


def _together(time_s: FloatArray, error: FloatArray) -> float:
    """How many plots count as one, by their times (m,) and errors across (m,), in σ.

    Errors of the sensor's heading are alike for all tracks for some time: sums of blocks scatter by more than their
    plots do.
    """
    block = ((time_s - time_s.min(initial=0.0)) // 60.0).astype(np.int64)
    alone = float(np.sum(error**2))
    return max(float(np.sum(np.bincount(block, error) ** 2)) / alone, 1.0) if alone > 0.0 else 1.0

"""Error fit: the errors, clutter and late stamps of sources of bare plots, by how much they differ from each other.

What a kind is assumed to measure is often wrong by a factor of three, and a detector's clutter by a hundred. No source
has the truth, but the variances of the differences of all pairs of sources are sums of those of the sources (Gray and
Allan 1974, the three-cornered hat). Along and across the line of sight, at range r,

    Var along = a₁² + a₂² + e₁² + e₂²,    Var across = (r b₁)² + (r b₂)² + e₁² + e₂²,

with a the error of ranges, b that of bearings, and e the wander of what is measured over the hull; of directions only
the second. Which plots are of one object is unknown: a pair within a box is one with probability π, and chance with
density uniform in the box otherwise. All numbers that nobody gave have log-normal priors about those of the kind (e
about ``hull_sigma_m``). EM finds those of most posterior probability, from several beginnings. Errors last, so that
looks within ``fit_correlation_s`` count as one. A source that may be late is tried with stamps late by various times,
and all that was tried is averaged by its probability.

All that see a hull from one place see its near side. This common part of the errors is in no difference. It is taken
to have half the variance of the wander, e² averaged in logarithms (chosen: three recordings ask for 0.3 to 1.2), and
is a part of the errors of fused positions that no further source makes smaller.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from sameas.arrays import FloatArray, IntArray
from sameas.tracks.coordinates import LocalPlane
from sameas.tracks.feed import Feed
from sameas.tracks.placement import Directions, PlacedReports
from sameas.tracks.scans import usual_period_s
from sameas.tracks.source import Description
from sameas.tracks.tuning import DEFAULT_TUNING, Tuning


@dataclass(frozen=True)
class ErrorFit:
    """The feeds with estimated errors, and what their errors have in common.

    feeds : all, in their order; those that could not be estimated are as they were. fitted : names of the others.
    shared_m : 1σ per axis of the part that all sources have in common.
    """

    feeds: tuple[Feed, ...]
    fitted: tuple[str, ...] = ()
    shared_m: float = 0.0

    def lines(self) -> list[str]:
        """Printable sentences, one a source."""
        out = []
        for feed in self.feeds:
            described, errors = feed.description, feed.description.errors
            if described.name not in self.fitted:
                continue
            words = [] if isinstance(feed.reports, Directions) else [f"range ± {errors.range_m:.2g} m"]
            words += [f"bearing ± {errors.bearing_deg:.2g}°", f"hull ± {errors.extent_m:.2g} m"]
            if isinstance(feed.reports, Directions):
                words.append(f"clutter {described.clutter.per_deg or 0.0:.2g} per degree")
            else:
                words.append(f"clutter {described.clutter.per_km2 or 0.0:.2g} per km²")
            if described.timing.latency_s:
                words.append(f"stamps {described.timing.latency_s:.2g} s late")
            out.append(f"{described.name}: {', '.join(words)}")
        return out


@dataclass(frozen=True)
class _Pairs:
    """Pairs of plots of two sources at one time: places (m,) of the sources s and t and rows i and j of their reports,
    range r, difference along (0 where a source has no ranges, ``placed`` False) and across in metres, half the width of
    the box, and the part of an independent look that the pair counts."""

    s: IntArray
    t: IntArray
    i: IntArray
    j: IntArray
    range_m: FloatArray
    along_m: FloatArray
    across_m: FloatArray
    placed: NDArray[np.bool_]
    box_m: FloatArray
    share: FloatArray

    def __len__(self) -> int:
        return len(self.s)


@dataclass(frozen=True)
class _Model:
    """ln a, ln b (radians), ln e of every source (3, S), and π by pair of sources (S, S)."""

    logs: FloatArray
    real: FloatArray

    def variances(self, pairs: _Pairs) -> tuple[FloatArray, FloatArray]:
        """(m,) along and across."""
        a, b, e = np.exp(2.0 * self.logs)
        hull = e[pairs.s] + e[pairs.t]
        return a[pairs.s] + a[pairs.t] + hull, pairs.range_m**2 * (b[pairs.s] + b[pairs.t]) + hull

    def log_odds(self, pairs: _Pairs) -> FloatArray:
        """(m,) that a pair is one object."""
        along, across = self.variances(pairs)
        wide = math.log(2.0) + np.log(pairs.box_m)
        real = self.real[pairs.s, pairs.t]
        each = [
            wide - 0.5 * (np.log(2.0 * np.pi * variance) + delta**2 / variance)
            for variance, delta in ((along, pairs.along_m), (across, pairs.across_m))
        ]
        return np.asarray(np.log(real) - np.log1p(-real) + np.where(pairs.placed, each[0], 0.0) + each[1])


def fit_errors(feeds: Sequence[Feed], plane: LocalPlane | None = None, tuning: Tuning = DEFAULT_TUNING) -> ErrorFit:
    """The errors of sources of bare plots by the differences of their looks.

    Estimated are, where the description was silent, the errors of ranges and bearings, the wander over a hull, clutter,
    and of sources whose stamps may be late by how much. Positions with stated errors, tracks, and sources without a
    place are left alone; so is everything where fewer than ``fit_pairs`` independent looks have pairs.
    """
    at = [k for k, feed in enumerate(feeds) if _is_fittable(feed)]
    chosen = [feeds[k] for k in at]
    if len(chosen) < 2 or all(isinstance(feed.reports, Directions) for feed in chosen):
        return ErrorFit(tuple(feeds))
    prior = _Prior.of([feed.description for feed in chosen], tuning)
    tried = _tried(chosen, prior, tuning)
    for k, feed in enumerate(chosen):
        late = feed.description.bias.time_s or 0.0
        if not late or not _is_assumed(feed.description, "timing.latency_s"):
            continue
        so_far = _best(tried).feeds
        for share in tuning.fit_latencies:
            timing = replace(feed.description.timing, latency_s=share * late)
            trial = [*so_far[:k], _rebuilt(feed, replace(feed.description, timing=timing), plane), *so_far[k + 1 :]]
            tried += _tried(trial, prior, tuning, -0.5 * share**2)
    mean, latency_s = _averaged(tried)
    weight = expit(mean.model.log_odds(mean.pairs))
    if float(weight @ mean.pairs.share) < tuning.fit_pairs:
        return ErrorFit(tuple(feeds))
    out = list(feeds)
    for k, feed, description in zip(at, mean.feeds, _described(mean, latency_s, weight), strict=True):
        out[k] = _rebuilt(feed, description, plane)
    shared = math.sqrt(tuning.shared_hull) * math.exp(float(mean.model.logs[2].mean()))
    return ErrorFit(tuple(out), tuple(feed.description.name for feed in chosen), shared)


def _is_fittable(feed: Feed) -> bool:
    errors, raw = feed.description.errors, feed.raw_reports
    if raw is None or feed.sensor_m is None or feed.reports.track is not None or errors.bearing_deg is None:
        return False
    stated = (raw.covariance_m2, raw.sigma_range_m, raw.sigma_bearing_deg)
    silent = errors.position_m is None and all(column is None for column in stated)
    return silent and (isinstance(feed.reports, Directions) or errors.range_m is not None) and len(feed.reports) > 1


def _is_assumed(description: Description, name: str) -> bool:
    return any(line.name == name for line in description.assumed)


@dataclass(frozen=True)
class _Prior:
    """(3, S) medians of ln a, ln b, ln e, and 1σ, which is next to nothing where a user gave the number."""

    median: FloatArray
    sigma: FloatArray

    @classmethod
    def of(cls, descriptions: Sequence[Description], tuning: Tuning) -> _Prior:
        names = ("range_m", "bearing_deg", "extent_m")
        given = [[getattr(d.errors, name) for d in descriptions] for name in names]
        told = [
            [
                value is not None and not _is_assumed(d, f"errors.{name}")
                for d, value in zip(descriptions, row, strict=True)
            ]
            for name, row in zip(names, given, strict=True)
        ]
        least = tuning.fit_least_m
        median = np.array([[max(value or 0.0, least) for value in row] for row in given])
        median[1] = np.radians([[max(value or 0.0, 1e-3) for value in given[1]]])
        median[2] = np.where(told[2], median[2], tuning.hull_sigma_m)
        return cls(np.log(median), np.where(told, 1e-3, np.array(tuning.fit_sigmas)[:, None]))

    def log_density(self, logs: FloatArray) -> float:
        return -0.5 * float(np.sum(((logs - self.median) / self.sigma) ** 2))


@dataclass(frozen=True)
class _Tried:
    feeds: tuple[Feed, ...]
    pairs: _Pairs
    model: _Model
    log_posterior: float


def _tried(feeds: Sequence[Feed], prior: _Prior, tuning: Tuning, log_prior: float = 0.0) -> list[_Tried]:
    """The errors of most posterior probability of feeds whose stamps are what they are, from several beginnings."""
    pairs, out = _pairs(feeds, prior, tuning), []
    for shift in tuning.fit_begins:
        begin = _Model(prior.median + shift * prior.sigma, np.full((len(feeds), len(feeds)), tuning.fit_real))
        model = _settled(pairs, begin, prior, tuning)
        out.append(_Tried(tuple(feeds), pairs, model, _gain(pairs, model) + prior.log_density(model.logs) + log_prior))
    return out


def _best(tried: Sequence[_Tried]) -> _Tried:
    return max(tried, key=lambda one: one.log_posterior)


def _averaged(tried: Sequence[_Tried]) -> tuple[_Tried, FloatArray]:
    """The best, with logarithms averaged over all by their probabilities, and (S,) the averaged latencies."""
    best = _best(tried)
    weight = np.exp([one.log_posterior - best.log_posterior for one in tried])
    weight /= weight.sum()
    logs = np.einsum("k,kvs->vs", weight, np.array([one.model.logs for one in tried]))
    late = weight @ np.array([[feed.description.timing.latency_s or 0.0 for feed in one.feeds] for one in tried])
    return replace(best, model=replace(best.model, logs=logs)), late


def _settled(pairs: _Pairs, model: _Model, prior: _Prior, tuning: Tuning) -> _Model:
    for _ in range(tuning.fit_steps if len(pairs) else 0):
        p = expit(model.log_odds(pairs))
        after = _Model(_improved(pairs, p, model.logs, prior), _shares(pairs, p, model.logs.shape[1]))
        moved = float(np.abs(after.logs - model.logs).max())
        model = after
        if moved < tuning.fit_settled:
            break
    return model


def _gain(pairs: _Pairs, model: _Model) -> float:
    """ln likelihood against chance everywhere: ln((1 − π) + π N/u) = ln(1 − π) + ln(1 + odds)."""
    real = model.real[pairs.s, pairs.t]
    return float(pairs.share @ (np.log1p(-real) + np.logaddexp(0.0, model.log_odds(pairs)))) if len(pairs) else 0.0


def _shares(pairs: _Pairs, p: FloatArray, sources: int) -> FloatArray:
    """(S, S) π: the mean of p by pair of sources, kept off 0 and 1 by a pair of either kind."""
    code = pairs.s * sources + pairs.t
    count, sure = (np.bincount(code, weights, sources**2) for weights in (None, p))
    return np.asarray((sure + 1.0) / (count + 2.0)).reshape(sources, sources)


def _improved(pairs: _Pairs, p: FloatArray, logs: FloatArray, prior: _Prior) -> FloatArray:
    """(3, S) the logarithms after a step of Fisher's scoring towards the greatest expected posterior density."""
    weight, sources = p * pairs.share, logs.shape[1]
    parts = [(weight * pairs.placed, pairs.along_m**2), (weight, pairs.across_m**2)]

    def cost(now: FloatArray) -> float:
        variances = _Model(now, np.empty(0)).variances(pairs)
        each = [w @ (np.log(v) + square / v) for v, (w, square) in zip(variances, parts, strict=True)]
        return 0.5 * float(sum(each)) - prior.log_density(now)

    a, b, e = np.exp(2.0 * logs)
    each_range = pairs.range_m**2
    slopes = np.zeros((2, len(pairs), 3, sources))
    at = np.arange(len(pairs))
    for source in (pairs.s, pairs.t):
        slopes[0, at, 0, source], slopes[1, at, 1, source] = 2.0 * a[source], 2.0 * each_range * b[source]
        slopes[:, at, 2, source] = 2.0 * e[source]
    gradient = ((logs - prior.median) / prior.sigma**2).ravel()
    information = np.diag((prior.sigma**-2.0).ravel())
    for slope, variance, (w, square) in zip(slopes, _Model(logs, np.empty(0)).variances(pairs), parts, strict=True):
        flat = slope.reshape(len(pairs), -1) / variance[:, None]
        gradient += 0.5 * (w * (1.0 - square / variance)) @ flat
        information += 0.5 * (flat * w[:, None]).T @ flat
    step, before = -np.linalg.solve(information, gradient).reshape(3, sources), cost(logs)
    for share in (1.0, 0.5, 0.25, 0.1):
        if cost(logs + share * step) <= before:
            return np.asarray(logs + share * step)
    return logs


def _pairs(feeds: Sequence[Feed], prior: _Prior, tuning: Tuning) -> _Pairs:
    """Pairs of all sources, of looks that are the nearest in time to each other."""
    scans = [_scans(feed) for feed in feeds]
    parts: list[list[Any]] = []
    for s, t in combinations(range(len(feeds)), 2):
        if all(isinstance(feeds[k].reports, Directions) for k in (s, t)):
            continue
        lead, other = (s, t) if len(scans[s][0]) <= len(scans[t][0]) else (t, s)
        times, rows = scans[lead]
        if len(times) < 2 or not len(scans[other][0]):
            continue
        period, period_other = usual_period_s(times), usual_period_s(scans[other][0])
        step = max(len(times) // tuning.fit_scans, 1)
        near = _nearest(scans[other][0], times)
        gap = np.abs(scans[other][0][near] - times)
        for k in range(0, len(times), step):
            if gap[k] <= 0.6 * period_other:
                one, two = (rows[k], scans[other][1][near[k]])[:: 1 if lead == s else -1]
                i, j = (side.ravel() for side in np.meshgrid(one, two, indexing="ij"))
                share = min(step * period / tuning.fit_correlation_s, 1.0)
                parts.append([np.full(len(i), s), np.full(len(i), t), i, j, np.full(len(i), share)])
    if not parts:
        none, no_rows = np.empty(0), np.empty(0, np.int64)
        return _Pairs(no_rows, no_rows, no_rows, no_rows, none, none, none, np.empty(0, bool), none, none)
    return _compared(feeds, prior, [np.concatenate(column) for column in zip(*parts, strict=True)], tuning)


def _compared(feeds: Sequence[Feed], prior: _Prior, columns: Sequence[NDArray[Any]], tuning: Tuning) -> _Pairs:
    s, t, i, j, share = columns
    n = len(s)
    place, sensor, bearing = np.full((2, n, 2), np.nan), np.empty((2, n, 2)), np.full((2, n), np.nan)
    for k, feed in enumerate(feeds):
        for side, (which, rows) in enumerate(((s, i), (t, j))):
            here = which == k
            sensor[side, here] = feed.sensor_m[rows[here]]  # type: ignore[index]
            if isinstance(feed.reports, Directions):
                bearing[side, here] = feed.reports.bearing_deg[rows[here]]
            else:
                place[side, here] = feed.reports.state[rows[here], :2]
    has_place = np.isfinite(place[:, :, 0])
    placed = has_place.all(axis=0)
    middle = np.where(placed[:, None], 0.5 * (place[0] + place[1]), np.where(has_place[0][:, None], place[0], place[1]))
    # Directions are compared from where they were taken.
    eye = np.where(has_place[0][:, None], sensor[1], sensor[0])
    arm = middle - eye
    away = np.maximum(np.hypot(*arm.T), 1e-9)
    sight = arm / away[:, None]
    delta = np.where(placed[:, None], place[0] - place[1], 0.0)
    towards = np.degrees(np.arctan2(arm[:, 0], arm[:, 1]))
    angles = [np.where(has_place[side], towards, bearing[side]) for side in (0, 1)]
    turn = np.radians((angles[0] - angles[1] + 180.0) % 360.0 - 180.0)
    along = np.einsum("nv,nv->n", delta, sight)
    across = np.where(placed, delta[:, 0] * sight[:, 1] - delta[:, 1] * sight[:, 0], turn * away)
    a, b, e = np.exp(2.0 * prior.median)
    hull = e[s] + e[t]
    widest = np.sqrt(np.maximum(a[s] + a[t], away**2 * (b[s] + b[t])) + hull)
    box = np.maximum(tuning.fit_box_m, tuning.fit_box_sigmas * widest)
    keep = np.flatnonzero((np.abs(along) < box) & (np.abs(across) < box) & (away > 1.0))
    return _Pairs(*(x[keep] for x in (s, t, i, j, away, along, across, placed, box, share)))


def _scans(feed: Feed) -> tuple[FloatArray, list[IntArray]]:
    """The times of the scans that show something, and the rows of each."""
    rows = np.flatnonzero(feed.reports.usable)
    times, number = np.unique(feed.scan_s[rows], return_inverse=True)
    order = np.argsort(number, kind="stable")
    return times, np.split(rows[order], np.cumsum(np.bincount(number))[:-1]) if len(rows) else []


def _nearest(times: FloatArray, at: FloatArray) -> IntArray:
    after = np.clip(np.searchsorted(times, at), 1, max(len(times) - 1, 1))
    before = after - 1
    if len(times) < 2:
        return np.zeros(len(at), np.int64)
    return np.where(np.abs(times[after] - at) < np.abs(times[before] - at), after, before)


def _described(best: _Tried, latency_s: FloatArray, weight: FloatArray) -> list[Description]:
    """The descriptions with what was estimated."""
    out = []
    densities = _clutter(best, weight)
    for k, feed in enumerate(best.feeds):
        description = feed.description
        a, b, e = np.exp(best.model.logs[:, k]).tolist()
        directions = isinstance(feed.reports, Directions)
        new: dict[str, Any] = {"errors.bearing_deg": math.degrees(b), "errors.extent_m": e}
        new |= {"clutter.per_deg": densities[k]} if directions else {"clutter.per_km2": densities[k]}
        new |= {} if directions else {"errors.range_m": a}
        new |= {"timing.latency_s": float(latency_s[k]), "timing.latency_sigma_s": 0.0}
        silent = {name for name in new if _is_assumed(description, name)}
        if description.errors.extent_m is None:
            silent.add("errors.extent_m")
        parts = {
            part: replace(
                getattr(description, part),
                **{name.partition(".")[2]: new[name] for name in silent if name.startswith(f"{part}.")},
            )
            for part in ("errors", "clutter", "timing")
        }
        assumed = tuple(line for line in description.assumed if line.name not in silent)
        out.append(replace(description, assumed=assumed, **parts))
    return out


def _clutter(best: _Tried, weight: FloatArray) -> list[float]:
    """Clutter per km² or per degree, where each source's plots lie: plots without a partner, less those of objects
    that all others miss."""
    pairs, out = best.pairs, []
    q = [
        float(np.mean(feed.description.misses.q if feed.description.misses.q is not None else 0.5))
        for feed in best.feeds
    ]
    for k, feed in enumerate(best.feeds):
        lone = np.ones(len(feed.reports))
        for side, rows in ((pairs.s, pairs.i), (pairs.t, pairs.j)):
            np.multiply.at(lone, rows[side == k], 1.0 - weight[side == k])
        alone = float(lone.sum())
        missed = float(np.prod([other for m, other in enumerate(q) if m != k]))
        false = max(alone - (len(lone) - alone) * missed / (1.0 - missed), 0.0) + 1.0
        out.append(false / (len(feed.scan_times_s) * _field(feed)))
    return out


def _field(feed: Feed) -> float:
    """Where a source has plots: degrees of directions, km² by the spread of positions about the sensor."""
    reports = feed.reports
    if isinstance(reports, Directions):
        bearing = np.sort(reports.bearing_deg[reports.usable] % 360.0)
        gap = np.diff(np.append(bearing, bearing[:1] + 360.0))
        return float(max(360.0 - gap.max(initial=0.0), 1.0)) if len(bearing) > 20 else 360.0
    assert feed.sensor_m is not None
    arm = (reports.state[:, :2] - feed.sensor_m)[reports.usable]
    # A Gaussian of covariance C has the mean density of a uniform one on 4π |C|^½.
    return float(max(4.0 * math.pi * math.sqrt(max(float(np.linalg.det(np.cov(arm.T))), 0.0)), 1.0)) / 1e6


def _rebuilt(feed: Feed, description: Description, plane: LocalPlane | None) -> Feed:
    """The feed of the same reports under another description."""
    assert feed.raw_reports is not None
    later = (feed.description.timing.latency_s or 0.0) - (description.timing.latency_s or 0.0)
    empty = np.setdiff1d(feed.scan_times_s, feed.scan_s)
    times = feed.scan_times_s + later if len(empty) else None
    return Feed.of_placed(PlacedReports(description, feed.raw_reports, plane, feed.tuning), scan_times_s=times)

"""Error fit: errors, misses, clutter and latency of sources of plots without ids, from the differences between sources.

The errors assumed for a kind of sensor are often wrong by a factor of three, and a detector's clutter by a hundred. No
source has the truth, but the variance of the difference of two sources is the sum of theirs (Gray and Allan 1974, the
three-cornered hat). Along and across the line of sight, at range r,

    Var along = a₁² + a₂² + e₁² + e₂²,    Var across = (r b₁)² + (r b₂)² + e₁² + e₂²,

with a the error of ranges, b that of bearings, and e the scatter of the measured point over the hull; directions have
only the second. Which plots are of one object is unknown: a pair within a box is of one object with probability π, else
by chance, with uniform density in the box. Values not given by the user have log-normal priors about those of the kind
(e about ``HULL_SIGMA_M``). EM finds the maximum of the posterior, from several starting points. Errors are correlated
in time, so the scans within ``FIT_CORRELATION_S`` count as one. For a source with possible latency, several latencies
are tried. All fits are averaged with their posterior probabilities as weights.

A source misses the share of the others' plots that has no plot of it in its nearest scan, of those that a third source
confirms as real: without a third one, false plots and missed objects cannot be told apart. By range, in bins of equal
weight, as a table.

Sensors at one place all detect the near side of a hull. This common error does not appear in differences. It is assumed
to have half the variance of the scatter, the mean of e² over the sources (chosen), and is a part of the errors of fused
positions that further sources do not reduce. The mean is of variances, not of logarithms: a source that always shows
the same side scatters little, but the hull is as large as the other sources show it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.special import expit

from sameas.arrays import FloatArray
from sameas.tracks.coordinates import LocalPlane
from sameas.tracks.feed import Feed
from sameas.tracks.placement import Directions, PlacedReports
from sameas.tracks.plot_differences import MatchedScans, PlotDifferences, matched_scans, plot_differences
from sameas.tracks.source import CLUTTER, MISSES, Description, MissRate

FIT_PAIRS = 5.0  # minimum number of independent pairs for which errors are estimated
#: Prior 1σ of the logarithms of the assumed errors: of ranges, of bearings, of the echo's place on the hull.
FIT_SIGMAS = (0.7, 0.35, 0.7)
#: Median of the latter, that of a hull of 20 m in any direction, and minimum of any median.
HULL_SIGMA_M, FIT_MIN_M = 4.0, 1e-3
SHARED_HULL = 0.5  # share of the variance of the echo's place that is common to all sources at one place
FIT_LATENCIES = (0.25, 0.5, 0.75, 1.0, 1.25, 1.5)  # trial latencies, in 1σ of their prior
#: Initial share of real pairs, and starting points of EM, in 1σ of the prior from its medians.
FIT_REAL, FIT_STARTS = 0.3, (0.0, -2.0)
#: Maximum number of EM iterations, and the change of a logarithm at which they end.
FIT_STEPS, FIT_TOLERANCE = 200, 1e-3
#: For miss rates by range: least weight of a bin, in independent scans, most bins, and the weight of the described rate
#: in each, in scans.
FIT_BIN_SCANS, FIT_BINS, FIT_PRIOR_SCANS = 3.0, 5, 2.0


@dataclass(frozen=True)
class TrackErrorFit:
    """The feeds with estimated errors, and the common error of all.

    feeds : all, in their order, unchanged where not estimated. fitted : names of the sources with estimates.
    shared_m : 1σ per axis of the error that all sources have in common.
    """

    feeds: tuple[Feed, ...]
    fitted: tuple[str, ...] = ()
    shared_m: float = 0.0

    def lines(self) -> list[str]:
        """Printable sentences, one per source."""
        out = []
        for feed in self.feeds:
            described, errors = feed.description, feed.description.errors
            if described.name not in self.fitted:
                continue
            words = [] if isinstance(feed.reports, Directions) else [f"range ± {errors.range_m:.2g} m"]
            words += [f"bearing ± {errors.bearing_deg:.2g}°", f"hull ± {errors.extent_m:.2g} m"]
            words += [] if described.is_assumed(MISSES) else [f"misses {_percents(described.misses)}"]
            if isinstance(feed.reports, Directions):
                words.append(f"clutter {described.clutter.per_deg or 0.0:.2g} per degree")
            else:
                words.append(f"clutter {described.clutter.per_km2 or 0.0:.2g} per km²")
            if described.timing.latency_s:
                words.append(f"stamps {described.timing.latency_s:.2g} s late")
            out.append(f"{described.name}: {', '.join(words)}")
        return out


def _percents(misses: MissRate) -> str:
    """Such as "20 %" or "10 to 60 %"."""
    percent = 100.0 * np.atleast_1d(np.asarray(misses.q, np.float64))
    low, high = (f"{q:.0f}" for q in (percent.min(), percent.max()))
    return f"{low} %" if low == high else f"{low} to {high} %"


@dataclass(frozen=True)
class _Model:
    """logs : (3, S) ln a, ln b (radians) and ln e of each source. real : (S, S) π of each pair of sources."""

    logs: FloatArray
    real: FloatArray

    def variances(self, pairs: PlotDifferences) -> tuple[FloatArray, FloatArray]:
        """(m,) variances along and across."""
        a, b, e = np.exp(2.0 * self.logs)
        hull = e[pairs.s] + e[pairs.t]
        return a[pairs.s] + a[pairs.t] + hull, pairs.range_m**2 * (b[pairs.s] + b[pairs.t]) + hull

    def log_odds(self, pairs: PlotDifferences) -> FloatArray:
        """(m,) log-odds that a pair is of one object."""
        along, across = self.variances(pairs)
        log_box = math.log(2.0) + np.log(pairs.box_m)
        real = self.real[pairs.s, pairs.t]
        log_ratio = [
            log_box - 0.5 * (np.log(2.0 * np.pi * variance) + delta**2 / variance)
            for variance, delta in ((along, pairs.along_m), (across, pairs.across_m))
        ]
        return np.asarray(np.log(real) - np.log1p(-real) + np.where(pairs.placed, log_ratio[0], 0.0) + log_ratio[1])


def fit_errors(feeds: Sequence[Feed], plane: LocalPlane | None = None) -> TrackErrorFit:
    """The errors of sources of plots without ids, from the differences between sources.

    Estimates what the descriptions do not give: errors of ranges and bearings, wander over a hull, clutter, and the
    latency of sources that may be late. Positions with stated errors, tracks, and sources without a site stay
    unchanged; so do all if the pairs weigh less than ``FIT_PAIRS`` independent scans.
    """
    at = [k for k, feed in enumerate(feeds) if _is_fittable(feed)]
    fittable = [feeds[k] for k in at]
    if len(fittable) < 2 or all(isinstance(feed.reports, Directions) for feed in fittable):
        return TrackErrorFit(tuple(feeds))
    prior = _Prior.of([feed.description for feed in fittable])
    fits = _fits(fittable, prior)
    for k, feed in enumerate(fittable):
        late = feed.description.bias.time_s or 0.0
        if not late or not feed.description.is_assumed("timing.latency_s"):
            continue
        best = _best(fits).feeds
        for share in FIT_LATENCIES:
            timing = replace(feed.description.timing, latency_s=share * late)
            trial = [*best[:k], _rebuilt(feed, replace(feed.description, timing=timing), plane), *best[k + 1 :]]
            fits += _fits(trial, prior, -0.5 * share**2)
    mean, latency_s = _averaged(fits)
    p_pair = expit(mean.model.log_odds(mean.pairs))
    if float(p_pair @ mean.pairs.weight) < FIT_PAIRS:
        return TrackErrorFit(tuple(feeds))
    matches, partner = list(matched_scans(mean.feeds)), _p_partner(mean.feeds, mean.pairs, p_pair)
    out, misses = list(feeds), _misses(mean.feeds, matches, partner)
    first = _p_first(mean.feeds, mean.pairs, p_pair)
    densities = _clutter(mean.feeds, misses, matches, partner, first)
    for k, feed, description in zip(at, mean.feeds, _described(mean, latency_s, misses, densities), strict=True):
        out[k] = _rebuilt(feed, description, plane)
    shared = common_error_m(np.exp(mean.model.logs[2]))
    return TrackErrorFit(tuple(out), tuple(feed.description.name for feed in fittable), shared)


def common_error_m(extent_m: FloatArray) -> float:
    """1σ per axis of the error that sources at one place have in common, from their scatter e over hulls (S,).

    >>> round(common_error_m(np.array([3.0, 1.0])), 2), round(common_error_m(np.array([3.0, 0.1])), 2)
    (1.58, 1.5)
    """
    return math.sqrt(SHARED_HULL * float(np.mean(np.square(extent_m))))


def _is_fittable(feed: Feed) -> bool:
    errors, raw = feed.description.errors, feed.raw_reports
    if raw is None or feed.sensor_m is None or feed.reports.track is not None or errors.bearing_deg is None:
        return False
    stated = (raw.covariance_m2, raw.sigma_range_m, raw.sigma_bearing_deg)
    unstated = errors.position_m is None and all(column is None for column in stated)
    return unstated and (isinstance(feed.reports, Directions) or errors.range_m is not None) and len(feed.reports) > 1


@dataclass(frozen=True)
class _Prior:
    """(3, S) medians of ln a, ln b, ln e and their 1σ, which is 0.001 where the user gave the number."""

    median: FloatArray
    sigma: FloatArray

    @classmethod
    def of(cls, descriptions: Sequence[Description]) -> _Prior:
        names = ("range_m", "bearing_deg", "extent_m")
        values = [[getattr(d.errors, name) for d in descriptions] for name in names]
        given = [
            [
                value is not None and not d.is_assumed(f"errors.{name}")
                for d, value in zip(descriptions, row, strict=True)
            ]
            for name, row in zip(names, values, strict=True)
        ]
        median = np.array([[max(value or 0.0, FIT_MIN_M) for value in row] for row in values])
        median[1] = np.radians([[max(value or 0.0, 1e-3) for value in values[1]]])
        median[2] = np.where(given[2], median[2], HULL_SIGMA_M)
        return cls(np.log(median), np.where(given, 1e-3, np.array(FIT_SIGMAS)[:, None]))

    def log_density(self, logs: FloatArray) -> float:
        return -0.5 * float(np.sum(((logs - self.median) / self.sigma) ** 2))


@dataclass(frozen=True)
class _Fit:
    feeds: tuple[Feed, ...]
    pairs: PlotDifferences
    model: _Model
    log_posterior: float


def _fits(feeds: Sequence[Feed], prior: _Prior, log_prior: float = 0.0) -> list[_Fit]:
    """The fits of feeds with the latencies that they have, one from each starting point."""
    pairs, out = plot_differences(feeds, prior.median), []
    for shift in FIT_STARTS:
        start = _Model(prior.median + shift * prior.sigma, np.full((len(feeds), len(feeds)), FIT_REAL))
        model = _converged(pairs, start, prior)
        log_posterior = _log_likelihood(pairs, model) + prior.log_density(model.logs) + log_prior
        out.append(_Fit(tuple(feeds), pairs, model, log_posterior))
    return out


def _best(fits: Sequence[_Fit]) -> _Fit:
    return max(fits, key=lambda fit: fit.log_posterior)


def _averaged(fits: Sequence[_Fit]) -> tuple[_Fit, FloatArray]:
    """The best fit, with logarithms averaged over all fits by their posterior, and (S,) the averaged latencies."""
    best = _best(fits)
    weight = np.exp([fit.log_posterior - best.log_posterior for fit in fits])
    weight /= weight.sum()
    logs = np.einsum("k,kvs->vs", weight, np.array([fit.model.logs for fit in fits]))
    latency_s = weight @ np.array([[feed.description.timing.latency_s or 0.0 for feed in fit.feeds] for fit in fits])
    return replace(best, model=replace(best.model, logs=logs)), latency_s


def _converged(pairs: PlotDifferences, model: _Model, prior: _Prior) -> _Model:
    """The model after EM iterations until convergence, at most ``FIT_STEPS``."""
    for _ in range(FIT_STEPS if len(pairs) else 0):
        p = expit(model.log_odds(pairs))
        after = _Model(_updated_logs(pairs, p, model.logs, prior), _pair_shares(pairs, p, model.logs.shape[1]))
        change = float(np.abs(after.logs - model.logs).max())
        model = after
        if change < FIT_TOLERANCE:
            break
    return model


def _log_likelihood(pairs: PlotDifferences, model: _Model) -> float:
    """ln of the likelihood relative to chance pairs only: ln((1 − π) + π N/u) = ln(1 − π) + ln(1 + odds)."""
    real = model.real[pairs.s, pairs.t]
    return float(pairs.weight @ (np.log1p(-real) + np.logaddexp(0.0, model.log_odds(pairs)))) if len(pairs) else 0.0


def _pair_shares(pairs: PlotDifferences, p: FloatArray, sources: int) -> FloatArray:
    """(S, S) π: the mean of p by pair of sources, with one pseudo-count of each kind."""
    code = pairs.s * sources + pairs.t
    count, total = (np.bincount(code, weights, sources**2) for weights in (None, p))
    return np.asarray((total + 1.0) / (count + 2.0)).reshape(sources, sources)


def _updated_logs(pairs: PlotDifferences, p: FloatArray, logs: FloatArray, prior: _Prior) -> FloatArray:
    """(3, S) the logarithms after a step of Fisher scoring towards the maximum of the expected posterior density."""
    weight, sources = p * pairs.weight, logs.shape[1]
    parts = [(weight * pairs.placed, pairs.along_m**2), (weight, pairs.across_m**2)]

    def cost(logs: FloatArray) -> float:
        variances = _Model(logs, np.empty(0)).variances(pairs)
        terms = [w @ (np.log(v) + square / v) for v, (w, square) in zip(variances, parts, strict=True)]
        return 0.5 * float(sum(terms)) - prior.log_density(logs)

    a, b, e = np.exp(2.0 * logs)
    range_sq = pairs.range_m**2
    slopes = np.zeros((2, len(pairs), 3, sources))
    at = np.arange(len(pairs))
    for source in (pairs.s, pairs.t):
        slopes[0, at, 0, source], slopes[1, at, 1, source] = 2.0 * a[source], 2.0 * range_sq * b[source]
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


def _described(
    best: _Fit, latency_s: FloatArray, misses: Sequence[MissRate], densities: Sequence[float]
) -> list[Description]:
    """The descriptions with the estimated numbers; densities : of clutter."""
    out = []
    for k, feed in enumerate(best.feeds):
        description = feed.description
        a, b, e = np.exp(best.model.logs[:, k]).tolist()
        directions = isinstance(feed.reports, Directions)
        new: dict[str, Any] = {"errors.bearing_deg": math.degrees(b), "errors.extent_m": e}
        new |= {"clutter.per_deg": densities[k]} if directions else {CLUTTER: densities[k]}
        new |= {} if directions else {"errors.range_m": a}
        new |= {"timing.latency_s": float(latency_s[k]), "timing.latency_sigma_s": 0.0}
        estimated = {name for name in new if description.is_assumed(name)}
        if description.errors.extent_m is None:
            estimated.add("errors.extent_m")
        parts: dict[str, Any] = {
            part: replace(
                getattr(description, part),
                **{name.partition(".")[2]: new[name] for name in estimated if name.startswith(f"{part}.")},
            )
            for part in ("errors", "clutter", "timing")
        }
        if misses[k] is not description.misses:
            parts["misses"] = misses[k]
            estimated.add(MISSES)
        assumed = tuple(line for line in description.assumed if line.name not in estimated)
        out.append(replace(description, assumed=assumed, **parts))
    return out


def _misses(
    feeds: Sequence[Feed], matches: Sequence[MatchedScans], partner: Mapping[tuple[int, int], FloatArray]
) -> list[MissRate]:
    """The miss rates of the sources, by range where enough scans tell; those described where too few do, or where the
    user gave them. partner : of :func:`_p_partner`."""
    placed = [not isinstance(feed.reports, Directions) for feed in feeds]
    parts: list[list[list[FloatArray]]] = [[] for _ in feeds]
    for match in matches:
        for reference, source, rows in zip(match.sources, match.sources[::-1], match.rows, strict=True):
            sensor, others = feeds[source].sensor_at(match.time_s), set(range(len(feeds))) - {reference, source}
            if not placed[reference] or sensor is None or not len(rows):
                continue
            arm = feeds[reference].reports.state[rows, :2] - sensor  # type: ignore[union-attr]
            range_m, bearing = np.hypot(*arm.T), np.degrees(np.arctan2(arm[:, 0], arm[:, 1]))
            p_real = 1.0 - np.prod([1.0 - partner[reference, other][rows] for other in others], axis=0)
            # An object at one time may be in the scans of all references.
            weight = match.weight / (sum(placed) - placed[source])
            weight = weight * p_real * feeds[source].description.coverage.covers(range_m, bearing)
            parts[source].append([range_m, weight, partner[reference, source][rows]])
    return [
        estimated_miss_rate(feed.description, own) if own and feed.description.is_assumed(MISSES)
        else feed.description.misses
        for feed, own in zip(feeds, parts, strict=True)
    ]  # fmt: skip


def _p_partner(feeds: Sequence[Feed], pairs: PlotDifferences, p_pair: FloatArray) -> dict[tuple[int, int], FloatArray]:
    """By two sources, (n,) the probability that each report of the first is one object with a report of the second."""
    p_alone = {(s, t): np.ones(len(feeds[s].reports)) for s in range(len(feeds)) for t in range(len(feeds)) if s != t}
    for (s, t), p in p_alone.items():
        for own, other, rows in ((pairs.s, pairs.t, pairs.i), (pairs.t, pairs.s, pairs.j)):
            of_both = (own == s) & (other == t)
            np.multiply.at(p, rows[of_both], 1.0 - p_pair[of_both])
    return {key: 1.0 - p for key, p in p_alone.items()}


def _p_first(feeds: Sequence[Feed], pairs: PlotDifferences, p_pair: FloatArray) -> list[FloatArray]:
    """By source, (n,) the share of each report in its object: below 1 where its scan has further reports that are one
    object with the same report of another source, such as those of the two ends of a hull."""
    shares, total = ([np.zeros(len(feed.reports)) for feed in feeds] for _ in range(2))
    for own, other, rows, partner in ((pairs.s, pairs.t, pairs.i, pairs.j), (pairs.t, pairs.s, pairs.j, pairs.i)):
        for k, feed in enumerate(feeds):
            at = np.flatnonzero(own == k)
            scan = np.searchsorted(feed.scan_times_s, feed.scan_s[rows[at]])
            _, group = np.unique(np.column_stack([scan, other[at], partner[at]]), axis=0, return_inverse=True)
            in_scan = np.bincount(group.ravel(), p_pair[at])[group.ravel()]
            np.add.at(shares[k], rows[at], p_pair[at] / np.maximum(in_scan, 1.0))
            np.add.at(total[k], rows[at], p_pair[at])
    return [
        np.where(sums > 0.0, share / np.maximum(sums, 1e-300), 1.0) for share, sums in zip(shares, total, strict=True)
    ]


def estimated_miss_rate(described: Description, parts: Sequence[Sequence[FloatArray]]) -> MissRate:
    """The miss rate of a source: in each bin of range the mean of the described one, weighted as ``FIT_PRIOR_SCANS``
    scans, and of the shares that the bin's plots show.

    parts : ranges of others' plots, weights in independent scans, and probabilities that the source shows them.
    """
    range_m, weight, p_shown = (np.concatenate(column) for column in zip(*parts, strict=True))
    total = float(weight.sum())
    bins = min(int(total / FIT_BIN_SCANS), FIT_BINS)
    if not bins:
        return described.misses
    order = np.argsort(range_m, kind="stable")
    order = order[weight[order] > 0.0]
    range_m, weight, p_shown = np.round(range_m[order]), weight[order], p_shown[order]
    number = np.minimum((np.cumsum(weight) - 0.5 * weight) / total * bins, bins - 1).astype(np.int64)
    # Plots at one distance in metres, such as those of one moored ship, are in one bin.
    number = np.unique(np.maximum.accumulate(number[np.searchsorted(range_m, range_m)]), return_inverse=True)[1]
    bins = int(number[-1]) + 1
    scans, missed, total_m = (
        np.bincount(number, weight * x, bins) for x in (np.ones_like(weight), 1.0 - p_shown, range_m)
    )
    middle_m = np.asarray(total_m / scans)
    q = (FIT_PRIOR_SCANS * described.misses.at(middle_m) + missed) / (FIT_PRIOR_SCANS + scans)
    return MissRate(float(q[0])) if bins == 1 else MissRate(tuple(q.tolist()), tuple(middle_m.tolist()))


def _clutter(
    feeds: Sequence[Feed], misses: Sequence[MissRate], matches: Sequence[MatchedScans],
    partner: Mapping[tuple[int, int], FloatArray], first: Sequence[FloatArray],
) -> list[float]:  # fmt: skip
    """Clutter per km² or per degree in the field of each source.

    A real plot is without a partner with the probability m that all sources miss it of which a scan is compared, a
    false one always: per scan, β times the size of the field is Σ (p_alone − m) / Σ (1 − m). A second plot of an object
    in one scan counts as false. partner, first : of :func:`_p_partner` and :func:`_p_first`.
    """
    q = [float(np.mean(each.q)) if each.q is not None else 0.5 for each in misses]
    missed = [np.ones(len(feed.scan_times_s)) for feed in feeds]
    for match in matches:
        for (k, number), other in zip(zip(match.sources, match.numbers, strict=True), match.sources[::-1], strict=True):
            missed[k][number] *= q[other]
    out = []
    for k, feed in enumerate(feeds):
        rows = np.flatnonzero(feed.reports.usable)
        p_known = 1.0 - np.prod([1.0 - p[rows] for (s, _), p in partner.items() if s == k], axis=0)
        p_alone = 1.0 - first[k][rows] * p_known
        p_missed = missed[k][np.searchsorted(feed.scan_times_s, feed.scan_s[rows])]
        n_false = float(np.sum((p_alone - p_missed)[p_missed < 1.0]))
        scans = float(np.sum(1.0 - missed[k]))
        out.append((max(n_false, 0.0) + 1.0) / (max(scans, 1.0) * field_size(feed)))
    return out


def field_size(feed: Feed) -> float:
    """The size of the field with plots: degrees of directions, or km² by the spread of positions about the sensor."""
    reports = feed.reports
    if isinstance(reports, Directions):
        bearing = np.sort(reports.bearing_deg[reports.usable] % 360.0)
        gap = np.diff(np.append(bearing, bearing[:1] + 360.0))
        return float(max(360.0 - gap.max(initial=0.0), 1.0)) if len(bearing) > 20 else 360.0
    assert feed.sensor_m is not None
    arm = (reports.state[:, :2] - feed.sensor_m)[reports.usable]
    # A Gaussian of covariance C has the mean density of a uniform distribution over an area of 4π |C|^½.
    return float(max(4.0 * math.pi * math.sqrt(max(float(np.linalg.det(np.cov(arm.T))), 0.0)), 1.0)) / 1e6


def _rebuilt(feed: Feed, description: Description, plane: LocalPlane | None) -> Feed:
    """The feed of the same reports with another description."""
    assert feed.raw_reports is not None
    shift_s = (feed.description.timing.latency_s or 0.0) - (description.timing.latency_s or 0.0)
    empty = np.setdiff1d(feed.scan_times_s, feed.scan_s)
    times = feed.scan_times_s + shift_s if len(empty) else None
    return Feed.of_placed(PlacedReports(description, feed.raw_reports, plane), scan_times_s=times)

"""Links: candidate pairs of consecutive detections of one mover, with their likelihood ratios.

Each detection has at most one predecessor and one successor, so the links are a one-to-one assignment of detections to
later ones; the alternative is a false detection or the end of a mover. The log-likelihood ratio of a link i → j over τ
minutes is

    ln λ = ln odds + ln f(Δ/τ)/τ² − ln β_j + ln g(m_j | m_i)/n(m_j) + (exposures between) · ln(1 − P_d),

with f the rate density convolved with both errors, β_j the density of detections around j, g the magnitude distribution
of a mover of magnitude m_i, and n that of all detections.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from sameas.arrays import BoolArray, ColumnTable, FloatArray, IntArray
from sameas.assignment import assign
from sameas.groups import laid_out
from sameas.posterior import posterior
from sameas.prior import EVIDENCE_ALONE
from sameas.sky.movers.model import BEND_RATE, VARIABILITY_MAG, MotionModel, Surroundings
from sameas.space import ARCSEC_PER_RADIAN

#: ln of the density of an unrelated magnitude: uniform over 8 mag.
_LOG_UNIFORM_MAG = math.log(1.0 / 8.0)

FASTEST_ARCSEC_PER_MIN = 60.0  # maximum rate
#: Minimum ln λ of pairs with a third detection in line, which adds ten and more.
MIN_SUPPORTED = -20.0
LINKS = 12  # maximum number of links from a detection to later ones, the best ones
#: Maximum number of pairs per two exposures tried beyond the reach of links, if a third detection is in line, and the
#: tolerance for being in line, in standard deviations.
FAR_PAIRS, FAR_SIGMAS = 3e5, 4.0
MISSES = 4  # maximum number of exposures in a track's gap that covered its position without a detection
ODD_BRIGHTNESS = 0.05  # share of detections with an unrelated magnitude (blends, wrong bands)
#: Share of the detections of fast movers without a measured trail, and range of ln length of unrelated ones (uniform).
NO_TRAIL, TRAIL_RANGE = 0.15, 3.0
PRIOR_SHARE = 0.02  # prior share of the detections that have a next one (alerts have 0.3, frames less)
EM_ITERATIONS = 8


@dataclass(frozen=True)
class Links(ColumnTable):
    """Links of detections i to later ones j, (m,) each.

    minutes : between them. offset : (m, 2) arcsec on the ecliptic axes at i. log_ratio : ln λ. log_brightness : its
    part from magnitudes and the trail of j. misses : exposures between that covered the position. far : links too
    improbable alone, tried because a detection of a third exposure supports them.
    """

    i: IntArray
    j: IntArray
    minutes: FloatArray
    offset: FloatArray
    log_ratio: FloatArray
    log_brightness: FloatArray
    misses: IntArray
    far: BoolArray

    def __len__(self) -> int:
        return len(self.i)


def candidate_links(around: Surroundings, model: MotionModel) -> Links:
    """The links with sufficient ln λ within the reach of the model, ordered by the exposure of j."""
    reach = Reach.of(around, model)
    return _best_links(around, _links_of(around, model, reach, _pairs(around, reach)))


def with_far_links(around: Surroundings, links: Links, model: MotionModel) -> Links:
    """The links, and links of fast movers that are too improbable alone or outnumbered by chance pairs.

    Such a link is tried if detections of three consecutive exposures (at most one skipped between two) lie on a
    straight line: few of a hundred chance pairs have a third.
    """
    tuning = around.tuning
    least = min(tuning.min_log_ratio, MIN_SUPPORTED)
    supported = replace(around, tuning=replace(tuning, min_log_ratio=least))
    reach = Reach.of(supported, model)
    reach = replace(reach, arcsec=reach.uncapped)
    pairs = _supported(around, reach)
    if not len(pairs):
        return links
    far = _links_of(supported, model, reach, pairs)
    n = len(around.detections)
    far = far.take(~np.isin(far.i * n + far.j, links.i * n + links.j))
    far = _best_links(around, far)
    both = links.stacked(far.changed(far=np.ones(len(far), bool)))
    return both.take(np.lexsort([both.i, around.detections.frame[both.j]]))


def _links_of(around: Surroundings, model: MotionModel, reach: Reach, pairs: IntArray) -> Links:
    """The links among some pairs, evaluated in chunks."""
    size = around.tuning.pairs_at_once
    parts = [
        _evaluated(around, model, reach, pairs[first : first + size]) for first in range(0, max(len(pairs), 1), size)
    ]
    return parts[0].stacked(*parts[1:])


def _best_links(around: Surroundings, links: Links) -> Links:
    """The best links of each detection to later ones, ordered by the exposure of the later one."""
    order = np.lexsort([-links.log_ratio, links.i])
    rank = np.arange(len(order)) - np.searchsorted(links.i[order], links.i[order])
    links = links.take(order[rank < LINKS])
    return links.take(np.lexsort([links.i, around.detections.frame[links.j]]))


def _pairs(around: Surroundings, reach: Reach) -> IntArray:
    """(m, 2) pairs of detections within the maximum reach of a link."""
    seen, unit = around.detections, around.axes.unit
    frames = len(seen.frame_names)
    apart = _frames_apart(around)
    if apart >= 0.5 * frames:
        return cKDTree(unit).query_pairs(reach.most() / ARCSEC_PER_RADIAN, output_type="ndarray")
    when = seen.frame_mjd * 1440.0
    radius = reach.most(float((when[apart:] - when[: frames - apart]).max())) / ARCSEC_PER_RADIAN
    tree = cKDTree(np.column_stack([unit, seen.frame * (radius / apart)]))
    return tree.query_pairs(radius, p=np.inf, output_type="ndarray")


def _frames_apart(around: Surroundings) -> int:
    """Maximum difference in exposure number between linked detections: small if all exposures show one field.

    The 99th percentile over positions of the span with at most ``Tuning.misses`` exposures in between that covered it.
    """
    before = around.coverage.before
    sampled = before[:: max(1, len(before) // 500)]
    spans = [
        np.searchsorted(covered, covered[1:][np.diff(covered) > 0] + MISSES, side="right")
        - np.flatnonzero(np.diff(covered))
        - 1
        for covered in sampled
    ]
    return int(np.percentile(np.concatenate(spans), 99.0)) + 1


def _evaluated(around: Surroundings, model: MotionModel, reach: Reach, pairs: IntArray) -> Links:
    """The links among some pairs with sufficient ln λ."""
    seen, t, unit, tuning = around.detections, around.minutes, around.axes.unit, around.tuning
    i, j = pairs.T
    minutes = t[j] - t[i]
    # Nearly all pairs are too far apart for their time difference: they are dropped first.
    chord_sq = np.zeros(len(i))
    for axis in unit.T:
        chord_sq += (axis[i] - axis[j]) ** 2
    near = (
        (chord_sq < (reach(np.abs(minutes)) / ARCSEC_PER_RADIAN) ** 2)
        & (seen.frame[i] != seen.frame[j])
        & (minutes != 0)
    )
    kept = np.flatnonzero(near)
    later = minutes[kept] < 0
    i, j = np.where(later, j[kept], i[kept]).astype(np.int64), np.where(later, i[kept], j[kept]).astype(np.int64)
    misses = around.misses(i, j)
    kept = np.flatnonzero(misses <= MISSES)
    i, j, misses = i[kept], j[kept], misses[kept]
    minutes, offset = t[j] - t[i], around.axes.offsets(i, j)
    kept = np.flatnonzero(np.hypot(*offset.T) <= FASTEST_ARCSEC_PER_MIN * minutes + 1.0)
    i, j, minutes, offset, misses = i[kept], j[kept], minutes[kept], offset[kept], misses[kept]
    rate, error = rates_of(around, i, j, minutes, offset)
    log_brightness = brightness_ratio(around, model, i, j)
    trail_i, trail_j = (trail_ratio(around, end, offset / minutes[:, None], minutes) for end in (i, j))
    log_brightness += trail_j
    log_ratio = (
        model.log_odds + model.rates.log_density(rate, error) - 2.0 * np.log(minutes) - around.log_density[j]
        + log_brightness + trail_i + misses * math.log(1.0 - model.p_detect)
    )  # fmt: skip
    links = Links(i, j, minutes, offset, log_ratio, log_brightness, misses, np.zeros(len(i), bool))
    return links.take(log_ratio > tuning.min_log_ratio)


def _supported(around: Surroundings, far: Reach) -> IntArray:
    """(m, 2) pairs of fast movers with a third detection in line.

    far : maximum distance of a mover by time.
    """
    seen, unit, tuning = around.detections, around.axes.unit, around.tuning
    order = np.argsort(seen.frame, kind="stable")
    bounds = np.searchsorted(seen.frame[order], np.arange(len(seen.frame_names) + 1))
    rows = [order[a:b] for a, b in itertools.pairwise(bounds.tolist())]
    tree = [cKDTree(unit[mine]) if len(mine) else None for mine in rows]
    when = seen.frame_mjd * 1440.0
    sigma = np.sqrt(0.5 * np.trace(around.covariance, axis1=1, axis2=2))
    out = [np.empty((0, 2), np.int64)]
    for a, b in _following(len(rows)):
        first, second, minutes = tree[a], tree[b], when[b] - when[a]
        if first is None or second is None or not minutes > 0:
            continue
        most = float(far(np.array([minutes]))[0])
        # The number of pairs is limited to bound the cost: with more detections, the maximum rate is lower.
        density = len(rows[a]) * len(rows[b]) * math.exp(float(np.median(around.log_density[rows[b]]))) / len(rows[b])
        most = min(most, math.sqrt(FAR_PAIRS / (math.pi * max(density, 1e-300))))
        pairs = first.sparse_distance_matrix(second, most / ARCSEC_PER_RADIAN, output_type="ndarray")
        i, j = rows[a][pairs["i"]], rows[b][pairs["j"]]
        for c in (b + 1, b + 2):
            third = tree[c] if c < len(rows) else None
            if third is None or not when[c] > when[b]:
                continue
            q = (when[c] - when[b]) / minutes
            predicted = unit[j] + q * (unit[j] - unit[i])
            predicted /= np.linalg.norm(predicted, axis=1, keepdims=True)
            speed = pairs["v"] * (ARCSEC_PER_RADIAN / minutes)
            bend = tuning.bend_arcsec_per_min2 * speed / BEND_RATE * minutes**2 * q
            variance = sigma[i] ** 2 * q**2 + sigma[j] ** 2 * (1.0 + q) ** 2 + bend**2
            reach = FAR_SIGMAS * np.sqrt(variance + float(np.percentile(sigma[rows[c]], 90.0)) ** 2)
            distance, k = third.query(predicted, distance_upper_bound=float(reach.max(initial=0.0)) / ARCSEC_PER_RADIAN)
            hit = distance * ARCSEC_PER_RADIAN < reach
            out += [np.column_stack([i[hit], j[hit]]), np.column_stack([j[hit], rows[c][k[hit]]])]
    return np.unique(np.concatenate(out), axis=0)


def _following(frames: int) -> list[tuple[int, int]]:
    """Pairs of consecutive exposures, at most one skipped between them."""
    return [(a, b) for a in range(frames) for b in (a + 1, a + 2) if b < frames]


def rates_of(
    around: Surroundings, i: IntArray, j: IntArray, minutes: FloatArray, offset: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """(m, 2) rates against the reference, arcsec/min, and (m, 2, 2) their covariances."""
    rate = offset / minutes[:, None]
    rate[:, 0] -= around.reference[i]
    return rate, (around.covariance[i] + around.covariance[j]) / minutes[:, None, None] ** 2


def rates_between(around: Surroundings, i: IntArray, j: IntArray) -> tuple[FloatArray, FloatArray]:
    """Rates and covariances between detections i and later ones j, as :func:`rates_of`."""
    return rates_of(around, i, j, around.minutes[j] - around.minutes[i], around.axes.offsets(i, j))


@dataclass(frozen=True)
class Reach:
    """Maximum distance of a mover's next detection, by time, at which ln λ can reach the minimum.

    minutes, arcsec : (200,) ascending time differences, and distances. uncapped : the distances without the limit by
    the number of other detections within.
    """

    minutes: FloatArray
    arcsec: FloatArray
    uncapped: FloatArray

    def __call__(self, minutes: FloatArray) -> FloatArray:
        """(m,) maximum distance after some minutes, arcsec."""
        return np.interp(minutes, self.minutes, self.arcsec)

    def most(self, minutes: float = math.inf) -> float:
        """The maximum distance within some minutes, arcsec."""
        return float(self.arcsec[: np.searchsorted(self.minutes, minutes) + 1].max())

    @classmethod
    def of(cls, around: Surroundings, model: MotionModel) -> Reach:
        """The reach for some detections and a model."""
        span, tuning = float(np.ptp(around.minutes)), around.tuning
        minutes = np.geomspace(max(span * 1e-4, 1e-3), max(span, 1e-2), 200)
        low_density = float(np.percentile(around.log_density, 1.0))
        spread = np.sqrt(np.linalg.eigvalsh(model.rates.covariance).max(axis=1))
        mean_speed = np.abs(around.reference).max() + np.hypot(*model.rates.mean.T)
        error = np.sqrt(np.percentile(around.covariance[:, [0, 1], [0, 1]].sum(axis=1), 99.0))
        # Distance within which as many chance detections lie as a detection may have links.
        limit = math.sqrt(LINKS / math.pi) * math.exp(-0.5 * float(np.median(around.log_density)))
        # 3.0 allows for brightness evidence.
        margin = model.log_odds - low_density - tuning.min_log_ratio + 3.0
        best = np.zeros(len(minutes))
        for share, width, mean in zip(model.rates.share, spread, mean_speed, strict=True):
            sigma = np.hypot(width * minutes, error)
            height = margin + math.log(share) - np.log(2 * np.pi * sigma**2)
            distance = np.where(height > 0, mean * minutes + sigma * np.sqrt(2 * np.maximum(height, 0.0)), 0.0)
            best = np.maximum(best, np.minimum(distance, FASTEST_ARCSEC_PER_MIN * minutes + 1.0))
        return cls(minutes, np.minimum(best, max(limit, 3.0 * error)), best)


def brightness_ratio(around: Surroundings, model: MotionModel, i: IntArray, j: IntArray) -> FloatArray:
    """(m,) ln likelihood ratio of the magnitude of j given that of i; 0 where one is not measured."""
    seen, odd = around.detections, ODD_BRIGHTNESS
    difference = seen.magnitude[j] - seen.magnitude[i]
    a, b = seen.band[i], seen.band[j]
    error = np.nan_to_num(seen.magnitude_error[i]) ** 2 + np.nan_to_num(seen.magnitude_error[j]) ** 2
    variance = error + model.colour_sigma[a, b] ** 2
    off = difference - model.colour[a, b]
    same = np.log1p(-odd) - 0.5 * (off**2 / variance + np.log(2 * np.pi * variance))
    with np.errstate(invalid="ignore"):
        out = np.logaddexp(same, math.log(odd) + _LOG_UNIFORM_MAG) - around.log_brightness[j]
    return np.where(np.isfinite(out), out, 0.0)


def trail_ratio(around: Surroundings, end: IntArray, rate: FloatArray, minutes: FloatArray) -> FloatArray:
    """(m,) ln likelihood ratio of the trails of some detections given the rates (m, 2) of their links.

    A trail vector v, of either sign, has the density ½ N(v; r) + ½ N(v; −r) about the rate r, and 1/(2π |v|² · range)
    if unrelated.
    """
    trail = around.detections.trail
    if trail is None:
        return np.zeros(len(end))
    v = around.trail[end]
    variance = trail.sigma[end] ** 2 + np.trace(around.covariance[end], axis1=1, axis2=2) / minutes**2
    # Trail lengths are uncertain by a tenth, by the profile of the star.
    variance = variance + (0.1 * np.hypot(*v.T)) ** 2
    distance_sq = np.minimum(((v - rate) ** 2).sum(axis=1), ((v + rate) ** 2).sum(axis=1)) / variance
    related = -0.5 * distance_sq - np.log(4.0 * np.pi * variance)
    unrelated = -np.log(2.0 * np.pi * TRAIL_RANGE * (v**2).sum(axis=1))
    odd = math.log(ODD_BRIGHTNESS)
    with_trail = np.logaddexp(np.nan_to_num(related - unrelated), odd)
    without_trail = np.where(np.hypot(*rate.T) > trail.least[end], math.log(NO_TRAIL), 0.0)
    return np.where(np.isfinite(v[:, 0]), with_trail, without_trail)


def link_probabilities(links: Links, n: int) -> FloatArray:
    """(m,) probability of each link, with at most one predecessor and one successor per detection."""
    if not len(links):
        return np.empty(0)
    order = np.lexsort([links.j, links.i])
    i, j = links.i[order].astype(np.int32), links.j[order].astype(np.int32)
    grouped = laid_out(i, j, i, j, n, n)
    best = assign(grouped, links.log_ratio[order], EVIDENCE_ALONE(grouped.sizes_1, grouped.sizes_2))
    out = np.empty(len(links))
    out[order] = posterior(grouped, best).p_pair
    return out


def learn(around: Surroundings, model: MotionModel, *, counts: float = 30.0) -> MotionModel:
    """The model estimated from these detections by EM; no identities are needed.

    counts : weight of the prior model, in links.
    """
    for _ in range(EM_ITERATIONS):
        links = candidate_links(around, model)
        p = link_probabilities(links, len(around.detections))
        model, before = _maximised(around, links, p, model, counts), model
        if abs(model.log_odds - before.log_odds) < 0.02 and abs(model.p_detect - before.p_detect) < 0.005:
            break
    return model


def _maximised(around: Surroundings, links: Links, p: FloatArray, model: MotionModel, counts: float) -> MotionModel:
    """The model that maximises the expected likelihood, given link probabilities ``p`` (M step)."""
    if p.sum() < 1.0:
        return model
    probable = np.flatnonzero(p > 0.01)
    links, p = links.take(probable), p[probable]
    rate, error = rates_of(around, links.i, links.j, links.minutes, links.offset)
    # Links over seconds do not constrain rates.
    sharp = np.sqrt(np.trace(error, axis1=1, axis2=2)) < 1.0
    rates = model.rates.refined(rate[sharp], error[sharp], p[sharp], counts=counts)
    n, share = len(around.detections), float(p.sum())
    p_next = min((share + counts * PRIOR_SHARE) / (n + counts), 0.95)
    missed = float((p * links.misses).sum())
    p_detect = (share + 2.0) / (share + missed + 3.0)
    colour, sigma = _colours(around, links, p, model, counts)
    return replace(
        model,
        rates=rates,
        # ln s/(1 − s)²: without the link, i has no next detection and j no previous one.
        log_odds=math.log(p_next) - 2.0 * math.log1p(-p_next),
        p_detect=min(max(p_detect, 0.3), 0.97),
        colour=colour,
        colour_sigma=sigma,
    )


def _colours(
    around: Surroundings, links: Links, p: FloatArray, model: MotionModel, counts: float
) -> tuple[FloatArray, FloatArray]:
    """Mean differences of magnitude between bands and their scatter, by EM with unrelated magnitudes as outliers."""
    seen = around.detections
    difference = seen.magnitude[links.j] - seen.magnitude[links.i]
    error = np.nan_to_num(seen.magnitude_error[links.i]) ** 2 + np.nan_to_num(seen.magnitude_error[links.j]) ** 2
    colour, sigma = model.colour.copy(), model.colour_sigma.copy()
    for a in range(len(seen.bands)):
        for b in range(len(seen.bands)):
            of_bands = (seen.band[links.i] == a) & (seen.band[links.j] == b) & np.isfinite(difference)
            if p[of_bands].sum() < 5.0:
                continue
            d, e, w = difference[of_bands], error[of_bands], p[of_bands]
            mean, spread = colour[a, b], sigma[a, b]
            for _ in range(5):
                variance = e + spread**2
                same = (1 - ODD_BRIGHTNESS) * np.exp(-0.5 * (d - mean) ** 2 / variance)
                same /= np.sqrt(2 * np.pi * variance)
                r = w * same / (same + ODD_BRIGHTNESS / 8.0)
                mean = 0.0 if a == b else float((r * d).sum() / r.sum())
                gain = spread**2 / variance
                second = float((r * ((gain * (d - mean)) ** 2 + spread**2 * (1 - gain))).sum())
                spread = math.sqrt((second + counts * VARIABILITY_MAG**2) / (r.sum() + counts))
            colour[a, b], sigma[a, b] = mean, max(spread, 0.02)
    return colour, sigma

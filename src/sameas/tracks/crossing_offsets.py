"""Offsets of direction finders beside which there is no source of positions: from where three of them cross.

Three directions of one object meet in a point, so each such triple has one residual. With β_k the measured directions,
θ_k(p) those to the place p of least squares, and w the combination of the three that no small shift of p changes,

    r = Σ_k w_k (β_k − θ_k(p)) = Σ_k w_k (b_k + ε_k):

the residuals of objects in different directions determine the offsets b_k, each with its prior. The relation is linear
only near the offsets, so it is made anew about each estimate. Which triples are of one object is not certain: EM, in
which a direction is of at most one triple, from several starting points.

Directions of different names or frequencies are no triple. If they have neither, of several objects other offsets make
false crossings, which last: with them standard errors were 2 to 3 times too small (144 offsets of ± 2°, root mean
square error 1.2 to 2.4°; with frequencies 0.5 to 1.7°, 0.7 to 1.3 of the standard errors), so these are not estimated.
Two places have no residual, and their offsets cannot be seen.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, product

import numpy as np

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.evidence.identity import FREQUENCY, MODELS, NAMING
from sameas.tracks.feed import Feed
from sameas.tracks.placement import Directions
from sameas.tracks.plot_differences import FIT_CORRELATION_S, nearest_scans, scans_with_rows
from sameas.tracks.scans import usual_period_s

#: Places nearer to each other than this are one: their directions do not cross.
APART_M = 20.0
#: 1σ of an offset that the description says to be none, degrees.
_NONE_DEG = 1e-3
#: Starting points of each offset, in 1σ of its prior, by the number of direction finders: of more, one suffices.
_STARTS = {3: (-1.2, 0.0, 1.2), 4: (-1.0, 1.0)}
#: Triples of an instant for each direction, beyond which they are not kept.
_MOST_TRIPLES = 3.0
#: Directions farther than this from their crossing are not of one object, degrees.
_REACH_DEG = 30.0

#: About the maximum number of instants at which directions of three places are compared, and of their triples at one
#: instant; an instant with more is left out.
CROSSING_SCANS, CROSSING_TRIPLES = 300, 1000
#: Offsets are not estimated where a direction is in more triples than this beyond the first, in the mean.
CROSSING_RIVALS = 0.5


@dataclass(frozen=True)
class CrossingFit:
    """The offsets of K direction finders: ``theta_deg`` (K,), ``covariance_deg2`` (K, K), means over all that explain
    the directions; the expected number of triples of one object, at how many instants, and the log-evidence against no
    offset."""

    theta_deg: FloatArray
    covariance_deg2: FloatArray
    triples: float
    instants: int
    log_evidence: float


def crossing_fit(feeds: Sequence[Feed]) -> CrossingFit | None:
    """The offsets of direction finders at three places or more; None if no three directions can be compared, or if most
    have several partners of equal name and frequency."""
    triples = _Triples.of(feeds) if len(feeds) > 2 else None
    if triples is None:
        return None
    widths = np.array([max(feed.description.bias.azimuth_deg or 0.0, _NONE_DEG) for feed in feeds])
    starts = _STARTS.get(len(feeds), (0.0,))
    steps = [starts if width > _NONE_DEG else (0.0,) for width in widths]
    fits = [_Fit.of(triples, widths, np.array(start) * widths) for start in product(*steps)]
    best, weight, distinct = _distinct(fits)
    theta: FloatArray = weight @ np.array([fit.theta for fit in distinct])
    spread = [fit.covariance + np.outer(fit.theta - theta, fit.theta - theta) for fit in distinct]
    no_offsets = np.zeros(len(feeds))
    none = triples.about(no_offsets, len(feeds)).log_likelihood(no_offsets, best.real)
    return CrossingFit(
        theta, np.einsum("k,kvw->vw", weight, np.array(spread)), float(best.p.sum()),
        len(np.unique(triples.instant[best.p > 0.5])), best.log_posterior - none,
    )  # fmt: skip


def _distinct(fits: Sequence[_Fit]) -> tuple[_Fit, FloatArray, list[_Fit]]:
    """The best fit, and the different ones with their probabilities, by Laplace's approximation."""
    in_order = sorted(fits, key=lambda fit: -fit.log_posterior)
    distinct: list[_Fit] = []
    for fit in in_order:
        if all(other.differs(fit) for other in distinct):
            distinct.append(fit)
    log_weight = np.array([fit.log_posterior + 0.5 * np.linalg.slogdet(fit.covariance)[1] for fit in distinct])
    weight = np.exp(log_weight - log_weight.max())
    return in_order[0], weight / weight.sum(), distinct


@dataclass(frozen=True)
class _Fit:
    """A maximum of the posterior: offsets and covariance, share of real triples, (m,) probability of each."""

    theta: FloatArray
    covariance: FloatArray
    real: float
    p: FloatArray
    log_posterior: float

    @classmethod
    def of(cls, triples: _Triples, widths: FloatArray, start: FloatArray) -> _Fit:
        """By EM; the variances of residuals include that of the offsets, which shrinks from its prior."""
        theta, covariance, real = start, np.diag(widths**2) / 4.0, 0.5
        residuals, p = triples.about(theta, len(widths)), np.zeros(len(triples.instant))
        for _ in range(6):
            for _ in range(5):
                more = np.einsum("mk,kl,ml->m", residuals.of_offset, covariance, residuals.of_offset)
                p = residuals.p_real(theta, real, more)
                precision = p * triples.weight / residuals.variance
                information = np.diag(widths**-2.0) + (residuals.of_offset.T * precision) @ residuals.of_offset
                covariance = np.asarray(np.linalg.inv(information), np.float64)
                theta = np.asarray(covariance @ (residuals.of_offset.T @ (precision * residuals.value)))
                real = float(np.clip((p.sum() + 1.0) / (triples.n_directions + 2.0), 1e-3, 0.99))
            before, residuals = residuals, triples.about(theta, len(widths))
            if np.abs(residuals.theta - before.theta).max() < 1e-2:
                break
        log_prior = -0.5 * float(np.sum((theta / widths) ** 2))
        return cls(theta, covariance, real, p, residuals.log_likelihood(theta, real) + log_prior)

    def differs(self, other: _Fit) -> bool:
        """Whether the offsets of another fit differ from these by more than 1σ."""
        delta = self.theta - other.theta
        return float(delta @ np.linalg.solve(self.covariance, delta)) > 1.0


@dataclass(frozen=True)
class _Residuals:
    """(m,) residuals r, degrees, of triples about offsets ``theta`` (K,), (m, K) their w, variances without offsets,
    half widths of r of chance, and whether the three directions cross."""

    triples: _Triples
    theta: FloatArray
    value: FloatArray
    of_offset: FloatArray
    variance: FloatArray
    reach: FloatArray
    crosses: BoolArray

    def log_ratio(self, theta: FloatArray, more: FloatArray | float = 0.0) -> FloatArray:
        """(m,) ln of the density of r, if a triple is of one object, over that of chance."""
        variance = self.variance + more
        log_real = -0.5 * ((self.value - self.of_offset @ theta) ** 2 / variance + np.log(2.0 * math.pi * variance))
        return np.where(self.crosses, log_real + np.log(2.0 * self.reach), -np.inf)

    def p_real(self, theta: FloatArray, real: float, more: FloatArray) -> FloatArray:
        """(m,) probability of each triple, the mean over those given each of its three directions."""
        ratio, mean = np.exp(np.minimum(self.log_ratio(theta, more), 50.0)), np.zeros(len(self.value))
        for group in self.triples.group:
            share = real * ratio / np.bincount(group)[group]
            mean += share / (1.0 - real + np.bincount(group, share)[group]) / 3.0
        return mean

    def log_likelihood(self, theta: FloatArray, real: float) -> float:
        """Of the directions, each in one triple or none, over that of chance; the mean over the three places."""
        ratio, total = np.exp(np.minimum(self.log_ratio(theta), 50.0)), 0.0
        for group in self.triples.group:
            count = np.bincount(group)
            weight = np.bincount(group, self.triples.weight) / np.maximum(count, 1)
            total += float(weight @ np.log(1.0 - real + real * np.bincount(group, ratio) / np.maximum(count, 1))) / 3.0
        return total


@dataclass(frozen=True)
class _Triples:
    """Triples of directions of three places: (3, m) numbers of the feeds, directions, errors, times, and numbers of the
    directions; (3, m, 2) places; (m,) weights in independent scans, and numbers of the instants.

    reach_m : to which a direction finder receives. speed_m_per_s : of the objects.
    """

    feed: IntArray
    bearing: FloatArray
    sigma: FloatArray
    late_s: FloatArray
    group: IntArray
    sensor: FloatArray
    weight: FloatArray
    instant: IntArray
    reach_m: float
    speed_m_per_s: float

    @property
    def n_directions(self) -> float:
        """The number of directions of one place, the mean over the three."""
        return float(np.mean([len(np.unique(group)) for group in self.group]))

    @classmethod
    def of(cls, feeds: Sequence[Feed]) -> _Triples | None:
        """All triples at matched scans; None without any, or where a direction is in too many."""
        parts: list[tuple[IntArray, IntArray, float, int]] = []
        n_triples, n_directions = 0, 0.0
        for which in combinations(range(len(feeds)), 3):
            own = [feeds[k] for k in which]
            for every, scan_weight, number in _of_scans(own):
                index = every[:, _alike(own, np.arange(3)[:, None].repeat(every.shape[1], axis=1), every)]
                directions = sum(len(np.unique(rows)) for rows in index) / 3.0
                n_triples, n_directions = n_triples + index.shape[1], n_directions + directions
                # Those of an instant at which most are false are not kept: they decide that nothing is estimated.
                if 0 < index.shape[1] <= _MOST_TRIPLES * directions:
                    parts.append((np.array(which), index, scan_weight, number))
        if not parts or n_triples / n_directions - 1.0 > CROSSING_RIVALS:
            return None
        # Of K directions of one object, K − 2 residuals are independent.
        share = (len(feeds) - 2.0) / math.comb(len(feeds), 3)
        feed = np.concatenate(
            [np.repeat(which[:, None], index.shape[1], axis=1) for which, index, _, _ in parts], axis=1
        )
        row = np.concatenate([index for _, index, _, _ in parts], axis=1)
        weight = share * np.concatenate([np.full(index.shape[1], one) for _, index, one, _ in parts])
        instant = np.concatenate([np.full(index.shape[1], number) for _, index, _, number in parts])
        bearing, sigma, time_s = (np.empty(feed.shape) for _ in range(3))
        sensor = np.empty((*feed.shape, 2))
        for k, one in enumerate(feeds):
            reports, at = one.reports, feed == k
            assert isinstance(reports, Directions)
            rows = row[at]
            bearing[at], sigma[at] = reports.bearing_deg[rows], reports.sigma_deg[rows]
            time_s[at] = reports.time_s[rows]
            sensor[at] = reports.sensor_m[rows]
        kept = np.ones(feed.shape[1], bool)
        for a, b in combinations(range(3), 2):
            kept &= np.hypot(*(sensor[a] - sensor[b]).T) > APART_M
        if not kept.any():
            return None
        # A direction is one of its place at an instant, among the triples of the same three places.
        combination = np.unique(feed, axis=1, return_inverse=True)[1].ravel()
        keys = [np.column_stack([combination, instant, rows])[kept] for rows in row]
        group = np.array([np.unique(key, axis=0, return_inverse=True)[1].ravel() for key in keys])
        late_s = np.abs(time_s - time_s.mean(axis=0))
        return cls(
            feed[:, kept], bearing[:, kept], sigma[:, kept], late_s[:, kept], group, sensor[:, kept], weight[kept],
            instant[kept], min(one.description.coverage.range_m or math.inf for one in feeds),
            max(one.description.motion.speed_m_per_s or 0.0 for one in feeds),
        )  # fmt: skip

    def about(self, theta: FloatArray, n: int) -> _Residuals:
        """The residuals about offsets ``theta`` (n,)."""
        angle = np.radians(self.bearing - theta[self.feed])
        along = np.stack([np.sin(angle), np.cos(angle)], axis=-1)
        across = np.stack([along[..., 1], -along[..., 0]], axis=-1)
        place = _crossing(across, self.sensor, np.ones(self.bearing.shape))
        for _ in range(2):
            distance = np.maximum(np.hypot(*np.moveaxis(place - self.sensor, -1, 0)), 1.0)
            place = _crossing(across, self.sensor, 1.0 / (self.sigma * distance) ** 2)
        arm = place - self.sensor
        distance = np.maximum(np.hypot(*np.moveaxis(arm, -1, 0)), 1.0)
        ahead, aside = (np.einsum("kmv,kmv->km", way, arm) for way in (along, across))
        off = np.degrees(np.arctan2(aside, ahead))
        # The change of the direction to the place, per metre.
        slope = np.stack([arm[..., 1], -arm[..., 0]], axis=-1) / distance[..., None] ** 2
        w = np.cross(slope[..., 0], slope[..., 1], axis=0)
        size = np.linalg.norm(w, axis=0)
        w = w / np.where(size > 0.0, size, 1.0)
        crosses = (size > 0.0) & (np.abs(off) < _REACH_DEG).all(axis=0) & (distance < self.reach_m).all(axis=0)
        late = np.degrees(self.speed_m_per_s * self.late_s / distance)
        of_offset = np.zeros((len(size), n))
        np.put_along_axis(of_offset, self.feed.T, w.T, axis=1)
        value = of_offset @ theta - np.sum(w * off, axis=0)
        variance = np.sum(w**2 * (self.sigma**2 + late**2), axis=0)
        reach = _REACH_DEG * np.abs(w).sum(axis=0)
        return _Residuals(self, theta, value, of_offset, np.maximum(variance, 1e-6), np.maximum(reach, 1e-3), crosses)


def _of_scans(feeds: Sequence[Feed]) -> list[tuple[IntArray, float, int]]:
    """The rows (3, m) of all triples of three sources at each of their matched scans, the weight and the instant."""
    scans = [scans_with_rows(feed) for feed in feeds]
    fewest = min(range(3), key=lambda k: len(scans[k][0]))
    times = scans[fewest][0]
    if len(times) < 2:
        return []
    step = max(len(times) // CROSSING_SCANS, 1)
    weight = min(step * usual_period_s(times) / FIT_CORRELATION_S, 1.0)
    nearest = [nearest_scans(own, times) for own, _ in scans]
    is_near = [
        np.abs(own[at] - times) <= (math.inf if k == fewest else 0.6 * usual_period_s(own))
        for k, ((own, _), at) in enumerate(zip(scans, nearest, strict=True))
    ]
    out = []
    for t in range(0, len(times), step):
        rows = [scans[k][1][nearest[k][t]] if is_near[k][t] else np.empty(0, np.int64) for k in range(3)]
        if 0 < math.prod(map(len, rows)) <= CROSSING_TRIPLES:
            out.append((np.stack(np.meshgrid(*rows, indexing="ij")).reshape(3, -1), weight, t))
    return out


def _crossing(across: FloatArray, sensor: FloatArray, weight: FloatArray) -> FloatArray:
    """(m, 2) places of least weighted distance from lines (3, m); far away where they are parallel."""
    normal = np.einsum("km,kmv,kmw->mvw", weight, across, across)
    right = np.einsum("km,kmv,kmw,kmw->mv", weight, across, across, sensor)
    scale = np.trace(normal, axis1=1, axis2=2)[:, None, None]
    return np.asarray(np.linalg.solve(normal + 1e-12 * scale * np.eye(2), right[..., None])[..., 0])


def _alike(feeds: Sequence[Feed], feed: IntArray, row: IntArray) -> BoolArray:
    """(m,) whether no two reports of a triple, with the feeds and rows (3, m), have different names or frequencies."""
    alike = np.ones(feed.shape[1], bool)
    for name in (FREQUENCY, *NAMING):
        of_feeds = [one.attributes.get(name) for one in feeds]
        if sum(column is not None for column in of_feeds) < 2:
            continue
        missing = np.nan if name == FREQUENCY else None
        values = np.full(feed.shape, missing, float if name == FREQUENCY else object)
        for k, column in enumerate(of_feeds):
            if column is not None:
                values[feed == k] = column[row[feed == k]]
        for one, other in combinations(values, 2):
            if name == FREQUENCY:
                both = np.isfinite(one) & np.isfinite(other)
                alike[both] &= MODELS[FREQUENCY](one[both], other[both], np.empty(0)) > 0.0
            else:
                alike &= (one == other) | (one == None) | (other == None)  # noqa: E711
    return alike

"""Compiled maximum likelihood of error scales, from pairs counted in cells of similar distance and odds."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from sameas.arrays import BoolArray, FloatArray, Int32Array, IntArray
from sameas.kernels.compiled import part, small, small_by
from sameas.kernels.linear import solve, summed


@small
def log_odds(
    i: Int32Array, j: Int32Array, p_pair: FloatArray, log_ratio: FloatArray, partner_1: FloatArray,
    partner_2: FloatArray, counted: BoolArray, faint: float, largest_p: float, profile: FloatArray,
) -> None:  # fmt: skip
    """Replace ``profile`` (m,), the pairs' log density by their errors, by their log odds without it; −∞ if record i is
    not counted.

    i, j, p_pair, log_ratio : (m,) records of the pairs, their probabilities, and log odds before the one-to-one
    constraint. partner_1, partner_2 : probability that each record has a partner. Pairs of probability up to ``faint``
    may have been set to 0: they get log_ratio times the probabilities that both records are free. Probabilities are
    limited to ``largest_p``.
    """
    for e in range(len(profile)):
        if not counted[i[e]]:
            profile[e] = -np.inf
        elif p_pair[e] > faint:
            p = min(p_pair[e], largest_p)
            profile[e] = math.log(p / (1.0 - p)) - profile[e]
        else:
            free = max(1.0 - partner_1[i[e]], 1e-30) * max(1.0 - partner_2[j[e]], 1e-30)
            profile[e] = log_ratio[e] + math.log(free) - profile[e]


@small
def cells(
    square: FloatArray, log_odds: FloatArray, least: float, most: float, nearest: float, reach: float,
    shape: tuple[int, int],
) -> tuple[IntArray, FloatArray, FloatArray, FloatArray]:  # fmt: skip
    """Counts of pairs in cells of distance and odds, as ``log_likelihood`` takes them, and mean squared distances.

    square, log_odds : (m,) squared distances and log odds; pairs of log odds up to ``least`` are ignored, those above
    ``most`` limited to it. shape : numbers of cells, even in ln distance from ``nearest`` to ``reach``, and in log
    odds. Returns start (b + 1,), count and odds (c,) of the cells that are not empty, and mean squares (b,) of the
    distances that are not.
    """
    number, log_odds_sum = np.zeros(shape), np.zeros(shape)
    squares, at_distance = np.zeros(shape[0]), np.zeros(shape[0])
    begin, closest = math.log(nearest), nearest * nearest
    along, across = (shape[0] - 1) / (math.log(reach) - begin), (shape[1] - 1) / (most - least)
    for e in range(len(square)):
        if log_odds[e] > least:
            limited = min(log_odds[e], most)
            a = int((0.5 * math.log(max(square[e], closest)) - begin) * along)
            b = int((limited - least) * across)
            number[a, b] += 1.0
            log_odds_sum[a, b] += limited
            squares[a] += square[e]
            at_distance[a] += 1.0
    size = min(len(square), shape[0] * shape[1])
    start, mean = np.zeros(shape[0] + 1, np.int64), np.empty(shape[0])
    count, odds = np.empty(size), np.empty(size)
    distances, full = 0, 0
    for a in range(shape[0]):
        if at_distance[a] > 0.0:
            for b in range(shape[1]):
                if number[a, b] > 0.0:
                    count[full], odds[full] = number[a, b], math.exp(log_odds_sum[a, b] / number[a, b])
                    full += 1
            mean[distances] = squares[a] / at_distance[a]
            distances += 1
            start[distances] = full
    return start[: distances + 1], count[:full], odds[:full], mean[:distances]


@small
def log_likelihood(
    start: IntArray, count: FloatArray, odds: FloatArray, density: FloatArray, pseudo: FloatArray, shares: FloatArray
) -> float:
    """Σ count · ln(1 + odds · f) over the cells, f = density · shares at their distances, and Σ pseudo · ln shares.

    The cells start[b]:start[b + 1] are at distance b; density : (b, k) of each component there.
    """
    total = 0.0
    for k in range(len(shares)):
        if pseudo[k] > 0.0:
            total += pseudo[k] * math.log(max(shares[k], 1e-300))
    f = _mixed(density, shares)
    for b in range(len(density)):
        for c in range(start[b], start[b + 1]):
            total += count[c] * math.log1p(odds[c] * f[b])
    return total


@part
def _mixed(density: FloatArray, shares: FloatArray) -> FloatArray:
    """(b,) Σ density (b, k) · shares (k,), added in order."""
    f = np.zeros(len(density))
    for k in range(len(shares)):
        f += density[:, k] * shares[k]
    return f


@part
def _derivatives(
    start: IntArray, count: FloatArray, odds: FloatArray, density: FloatArray, pseudo: FloatArray, shares: FloatArray,
    ridge: float, slope: FloatArray, bend: FloatArray,
) -> None:  # fmt: skip
    """Write the gradient ``slope`` (k,) and the negative curvature ``bend`` (k, k) of the log likelihood."""
    size = len(shares)
    slope[:] = 0.0
    bend[:] = 0.0
    f = _mixed(density, shares)
    for b in range(len(density)):
        once, twice = 0.0, 0.0
        for c in range(start[b], start[b + 1]):
            each = odds[c] / (1.0 + odds[c] * f[b])
            once += count[c] * each
            twice += count[c] * (each * each)
        slope += once * density[b]
        for k in range(size):
            bend[k, : k + 1] += (twice * density[b, k]) * density[b, : k + 1]
    trace = 0.0
    for k in range(size):
        trace += bend[k, k]
        for h in range(k):
            bend[h, k] = bend[k, h]
    for k in range(size):
        bend[k, k] += ridge * trace
        if pseudo[k] > 0.0:
            share = max(shares[k], 1e-100)
            slope[k] += pseudo[k] / share
            bend[k, k] += pseudo[k] / (share * share)


@part
def _on_simplex(slope: FloatArray, bend: FloatArray, free: BoolArray, target: FloatArray) -> None:
    """Write to ``wanted`` the y ≥ 0, Σ y = 1, that maximises slope·y − ½ y·bend·y (active sets). free : (k,) a guess of
    the nonzero ones, updated."""
    # In loops: np.max, np.argmin and np.flatnonzero would import scipy.linalg whenever the compiled kernel is loaded.
    size, steepest = len(slope), 0.0
    at = np.empty(size, np.int64)
    for k in range(size):
        steepest = max(steepest, abs(slope[k]))
    for _ in range(6 * size):
        n = 0
        for k in range(size):
            if free[k]:
                at[n] = k
                n += 1
        system, right = np.ones((n + 1, n + 1)), np.ones((n + 1, 1))
        for a in range(n):
            right[a, 0] = slope[at[a]]
            for b in range(n):
                system[a, b] = bend[at[a], at[b]]
        system[n, n] = 0.0
        solve(system, right)
        lowest = 0
        for a in range(1, n):
            if right[a, 0] < right[lowest, 0]:
                lowest = a
        if n > 1 and right[lowest, 0] < 0.0:
            free[at[lowest]] = False
            continue
        target[:] = 0.0
        for a in range(n):
            target[at[a]] = right[a, 0]
        best, gain = -1, 1e-9 * steepest
        for k in range(size):
            if not free[k]:
                descent = slope[k] - right[n, 0]
                for a in range(n):
                    descent -= bend[k, at[a]] * right[a, 0]
                if descent > gain:
                    best, gain = k, descent
        if best < 0:
            return
        free[best] = True


def _steps(start: IntArray, count: FloatArray, odds: FloatArray, *rest: Any) -> float:
    """Work: about a hundred passes over the cells until the shares have converged."""
    return 100.0 * len(count)


@small_by(_steps)
def max_likelihood_shares(
    start: IntArray, count: FloatArray, odds: FloatArray, density: FloatArray, pseudo: FloatArray, shares: FloatArray,
    spread: float, steps: int, min_gain: float, shortest: float, ridge: float,
) -> FloatArray:  # fmt: skip
    """The shares of maximum likelihood, by alternating EM steps, which always increase the likelihood, and Newton steps
    among nonnegative shares, which converge quickly near the maximum.

    start, count, odds, density, pseudo : as in ``log_likelihood``. shares : initial ones, to each of which ``spread``
    is added. Stops after ``steps`` iterations, or when one gains less than ``min_gain``. Newton steps are shortened to
    no less than the fraction ``shortest``.
    """
    size = len(shares)
    free = (shares > 0.0) | (pseudo > 0.0)
    shares = (shares + spread) / summed(shares + spread)
    slope, bend, target, trial = np.empty(size), np.empty((size, size)), np.empty(size), np.empty(size)
    log_reached = -np.inf
    for _ in range(steps):
        _derivatives(start, count, odds, density, pseudo, shares, ridge, slope, bend)
        shares = np.maximum(shares * slope, 0.0)
        shares /= summed(shares)
        _derivatives(start, count, odds, density, pseudo, shares, ridge, slope, bend)
        for k in range(size):
            for h in range(size):
                slope[k] += bend[k, h] * shares[h]
        _on_simplex(slope, bend, free, target)
        now = log_likelihood(start, count, odds, density, pseudo, shares)
        length = 1.0
        while length > shortest:
            for k in range(size):
                # The quadratic approximation may make a share with pseudo-counts 0, which it cannot be.
                least = 0.1 * shares[k] if pseudo[k] > 0.0 else 0.0
                trial[k] = max(shares[k] + length * (target[k] - shares[k]), least)
            trial /= summed(trial)
            log_trial = log_likelihood(start, count, odds, density, pseudo, trial)
            if log_trial > now:
                now = log_trial
                shares = trial.copy()
                break
            length *= 0.25
        gain, log_reached = now - log_reached, now
        if gain < min_gain:
            break
    return shares


@small_by(_steps)
def fit(
    start: IntArray, count: FloatArray, odds: FloatArray, squares: FloatArray, d: int, scales: FloatArray, core: int,
    pseudo: FloatArray, shares: FloatArray, min_gain: float, search: tuple[float | int, ...],
) -> tuple[FloatArray, float, float]:  # fmt: skip
    """The shares (k,) of maximum likelihood of a mixture of normals in d features, of ascending ``scales`` (k,).

    The components from ``core`` on are the tail, which is removed if it does not improve the log likelihood by more
    than ``min_gain``. Returns the shares, the improvement by the tail, and the log likelihood.

    start, count, odds, squares : as returned by ``cells``. The likelihood of n pairs of odds o is (1 + o f)^n, whose
    logarithm is concave in the shares, so the maximum is unique. pseudo, shares : as in ``max_likelihood_shares``;
    search : its last five arguments.
    """
    density = np.empty((len(squares), len(scales)))
    for k in range(len(scales)):
        variance, volume = scales[k] * scales[k], 1.0
        for _ in range(d):
            volume *= scales[k]
        for b in range(len(squares)):
            density[b, k] = math.exp(-0.5 * squares[b] / variance) / volume
    best = max_likelihood_shares(start, count, odds, density, pseudo, shares, *search)
    log_reached, typical = log_likelihood(start, count, odds, density, pseudo, best), summed(best[:core])
    if typical == summed(best):
        return best, 0.0, log_reached
    if typical == 0.0:
        return best, np.inf, log_reached
    narrow, kept = density[:, :core].copy(), pseudo[:core].copy()
    alone = max_likelihood_shares(start, count, odds, narrow, kept, best[:core] / typical, *search)
    without = log_likelihood(start, count, odds, narrow, kept, alone)
    if log_reached - without > min_gain:
        return best, log_reached - without, log_reached
    for k in range(len(best)):
        best[k] = alone[k] if k < core else 0.0
    return best, log_reached - without, without


# Grades of records, and their counts: see ``sameas.estimate.grades``.


@small
def grade(place: FloatArray, within: IntArray, limits: FloatArray, number: int, out: Int32Array) -> None:
    """Write to ``out`` (n,) the number of limits, of the ``number`` − 1 in its range, at or below each place (n,).

    within : (n,) the ranges. limits : (ranges (number − 1),) by range, ascending in each.
    """
    for k in range(len(out)):
        begin, below = within[k] * (number - 1), 0
        for limit in limits[begin : begin + number - 1]:
            below += limit <= place[k]
        out[k] = below


@small
def count_pairs(
    i: Int32Array, j: Int32Array, grades_1: Int32Array, grades_2: Int32Array, p_counted: FloatArray, common: FloatArray
) -> IntArray:
    """Add the probabilities ``p_counted`` (m,) of pairs to ``common`` (k₁, k₂); returns the flat index of each (m,)."""
    at = np.empty(len(i), np.int64)
    for e in range(len(i)):
        one, two = grades_1[i[e]], grades_2[j[e]]
        common[one, two] += p_counted[e]
        at[e] = one * common.shape[1] + two
    return at


@small
def count_alone(
    cells: Int32Array, grades: Int32Array, partner: FloatArray, covered: BoolArray, count: FloatArray
) -> None:
    """Add to ``count`` (cells, k) the probability of each covered record to have no partner."""
    for k in range(len(cells)):
        if covered[k]:
            count[cells[k], grades[k]] += 1.0 - partner[k]

"""Compiled filter of the errors of pairs of tracks from one instant to the next (:mod:`sameas.picture.track_pairs`).

The errors of a pair are (e_a, z_a, z_b) if both tracks are one object, and (e_a, z_a, z_b, d) if they are in convoy.
One row of :data:`WIDTH` numbers has both: their means, then the lower triangles of their covariances, row by row.
A crowded picture has tens of thousands of pairs, and moving them through memory takes most of the time.
"""

from __future__ import annotations

import math

import numpy as np

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.kernels.compiled import inlined, small, small_by
from sameas.kernels.linear import positive_2, solve_2

#: Components of the errors if both tracks are one object, and if they are in convoy.
ONE, CONVOY = 6, 8
#: Offsets in a row of the means and the covariances, of both hypotheses; length of a row.
MEAN = (0, ONE)
COVARIANCE = (ONE + CONVOY, ONE + CONVOY + ONE * (ONE + 1) // 2)
WIDTH = COVARIANCE[1] + CONVOY * (CONVOY + 1) // 2


@small
def pairs_stepped(
    errors: FloatArray, added_errors: FloatArray, rows: IntArray, first: IntArray, second: IntArray, last: FloatArray,
    moved: FloatArray, drift: FloatArray, slope: FloatArray, noise: FloatArray, shift: FloatArray,
    new_report: BoolArray, total: FloatArray, added_m2: float, new_errors: FloatArray, log_reports: FloatArray,
    now: FloatArray, chi_sq: FloatArray,
) -> None:  # fmt: skip
    """Write the errors of pairs of tracks after an instant: predicted by the tracks' motion, then updated by the new
    report of the first track and by that of the second. Without rows of ``new_errors`` only what the reports tell is
    computed, which takes half the time.

    errors, added_errors : (n, WIDTH), (m, WIDTH) of old and new pairs. rows : (k,) the pairs that continue, rows of
    both arrays concatenated. first, second : (k,) their tracks, rows of the step, whose columns are ``last`` …
    ``new_report`` (:class:`sameas.picture.named_tracks.Step`). total : (m, 2, 2) covariance of each track's position.
    added_m2 : added variance that keeps certain steps invertible. new_errors : (k, WIDTH), or (0, WIDTH).
    log_reports : (k, 2) ln p of the reports under both hypotheses. now, chi_sq : (k,) ln N(δ; 0, P_a + P_b) and its χ².
    """
    one, other, h, gain = np.empty(CONVOY), np.empty(CONVOY), np.empty((2, 6)), np.empty((2, 2))
    mean_one, covariance_one = np.empty(ONE), np.empty((ONE, ONE))
    mean_two, covariance_two = np.empty(CONVOY), np.empty((CONVOY, CONVOY))
    keeps = len(new_errors) > 0
    for k in range(len(rows)):
        a, b = first[k], second[k]
        row = errors[rows[k]] if rows[k] < len(errors) else added_errors[rows[k] - len(errors)]
        _unpacked(row, MEAN[0], COVARIANCE[0], mean_one, covariance_one)
        _unpacked(row, MEAN[1], COVARIANCE[1], mean_two, covariance_two)
        x, y = moved[a, 0] - moved[b, 0], moved[a, 1] - moved[b, 1]
        went_x, went_y = x - (last[a, 0] - last[b, 0]), y - (last[a, 1] - last[b, 1])
        _gain_by_drift(drift[a], drift[b], 1e-4 * added_m2, gain)
        _grow(drift[a], gain, went_x, went_y, mean_one, covariance_one)
        _grow(drift[a], gain, went_x, went_y, mean_two, covariance_two)
        log_one = log_two = 0.0
        if new_report[a]:
            for v in range(2):
                for w in range(4):
                    h[v, w] = slope[a, v, w]
            east, north = shift[a, 0], shift[a, 1]
            goes_on = keeps or new_report[b]
            log_one = _update(mean_one, covariance_one, 2, 4, h, noise[a], added_m2, east, north, goes_on, one, other)
            log_two = _update(mean_two, covariance_two, 2, 4, h, noise[a], added_m2, east, north, goes_on, one, other)
            for v in range(2):
                mean_one[v] += shift[a, v]
                mean_two[v] += shift[a, v]
            x, y = x + shift[a, 0], y + shift[a, 1]
        if new_report[b]:
            # e_b = e_a − δ + d, with d = 0 if both are one object.
            for v in range(2):
                for w in range(2):
                    h[v, w], h[v, 2 + w], h[v, 4 + w] = slope[b, v, w], slope[b, v, 2 + w], slope[b, v, w]
            east = shift[b, 0] + h[0, 0] * x + h[0, 1] * y
            north = shift[b, 1] + h[1, 0] * x + h[1, 1] * y
            log_one += _update(mean_one, covariance_one, 4, ONE, h, noise[b], added_m2, east, north, keeps, one, other)
            log_two += _update(
                mean_two, covariance_two, 4, CONVOY, h, noise[b], added_m2, east, north, keeps, one, other
            )
            x, y = x - shift[b, 0], y - shift[b, 1]
        if keeps:
            _packed(mean_one, covariance_one, MEAN[0], COVARIANCE[0], new_errors[k])
            _packed(mean_two, covariance_two, MEAN[1], COVARIANCE[1], new_errors[k])
        log_reports[k, 0], log_reports[k, 1] = log_one, log_two
        p = total[a, 0, 0] + total[b, 0, 0]
        q = total[a, 0, 1] + total[b, 0, 1]
        r = total[a, 1, 1] + total[b, 1, 1]
        determinant = p * r - q * q
        chi_sq[k] = (r * x * x - 2.0 * q * x * y + p * y * y) / determinant
        now[k] = -0.5 * (chi_sq[k] + math.log(determinant)) - math.log(2.0 * math.pi)


@inlined
def _unpacked(row: FloatArray, mean_at: int, covariance_at: int, mean: FloatArray, covariance: FloatArray) -> None:
    """Read a mean and a covariance from a row."""
    at = covariance_at
    for v in range(len(mean)):
        mean[v] = row[mean_at + v]
        for w in range(v + 1):
            covariance[v, w] = covariance[w, v] = row[at]
            at += 1


@inlined
def _packed(mean: FloatArray, covariance: FloatArray, mean_at: int, covariance_at: int, row: FloatArray) -> None:
    """Write a mean and a covariance to a row."""
    at = covariance_at
    for v in range(len(mean)):
        row[mean_at + v] = mean[v]
        for w in range(v + 1):
            row[at] = covariance[v, w]
            at += 1


@inlined
def _gain_by_drift(drift_a: FloatArray, drift_b: FloatArray, least: float, gain: FloatArray) -> None:
    """Write the gain (2, 2) of the first track's motion from the change of both tracks' separation."""
    p = drift_a[0, 0] + drift_b[0, 0] + least
    q = 0.5 * (drift_a[0, 1] + drift_b[0, 1] + drift_a[1, 0] + drift_b[1, 0])
    r = drift_a[1, 1] + drift_b[1, 1] + least
    determinant = p * r - q * q
    for v in range(2):
        gain[v, 0], gain[v, 1] = solve_2(p, q, r, determinant, drift_a[v, 0], drift_a[v, 1])


@inlined
def _grow(drift: FloatArray, gain: FloatArray, x: float, y: float, mean: FloatArray, covariance: FloatArray) -> None:
    """Add to e_a the motion of its track, given the change (x, y) of both tracks' separation."""
    for v in range(2):
        mean[v] += gain[v, 0] * x + gain[v, 1] * y
        for w in range(2):
            half_rest = 0.5 * (drift[v, w] - gain[v, 0] * drift[0, w] - gain[v, 1] * drift[1, w])
            covariance[v, w] += half_rest
            covariance[w, v] += half_rest


@inlined
def _update(
    mean: FloatArray, covariance: FloatArray, begin: int, end: int, slope: FloatArray, noise: FloatArray, least: float,
    east: float, north: float, goes_on: bool, one: FloatArray, other: FloatArray,
) -> float:  # fmt: skip
    """Update a state in place by ν = H x + n, ν = (east, north), if it goes on; returns ln p(ν). H is ``slope`` (2, …)
    on the first two components and on ``begin`` … ``end`` − 1, and 0 on others. one, other : scratch for the columns of
    P Hᵀ.

    Plain counters run over the rows and columns of the lower triangle, which the compiler unrolls; a list of the
    observed components would take a third more time.
    """
    d, skipped = len(mean), begin - 2
    a, b, c = noise[0, 0] + least, 0.5 * (noise[0, 1] + noise[1, 0]), noise[1, 1] + least
    for v in range(d):
        east_v = covariance[v, 0] * slope[0, 0] + covariance[v, 1] * slope[0, 1]
        north_v = covariance[v, 0] * slope[1, 0] + covariance[v, 1] * slope[1, 1]
        for w in range(begin, end):
            east_v += covariance[v, w] * slope[0, w - skipped]
            north_v += covariance[v, w] * slope[1, w - skipped]
        one[v], other[v] = east_v, north_v
    for at in range(2 + end - begin):
        v = at if at < 2 else at + skipped
        a += slope[0, at] * one[v]
        b += 0.5 * (slope[0, at] * other[v] + slope[1, at] * one[v])
        c += slope[1, at] * other[v]
        east -= slope[0, at] * mean[v]
        north -= slope[1, at] * mean[v]
    a, b, c, determinant = positive_2(a, b, c)
    x, y = solve_2(a, b, c, determinant, east, north)
    for v in range(d if goes_on else 0):
        mean[v] += one[v] * x + other[v] * y
        gain_1, gain_2 = solve_2(a, b, c, determinant, one[v], other[v])
        for w in range(v + 1):
            value = covariance[v, w] - (gain_1 * one[w] + gain_2 * other[w])
            covariance[v, w] = covariance[w, v] = value
    return -0.5 * (east * x + north * y + math.log(determinant)) - math.log(2.0 * math.pi)


@small_by(lambda state, covariance, one, *_: 20 * len(one))
def pair_distances(
    state: FloatArray, covariance: FloatArray, one: IntArray, other: IntArray, column: int, chi_sq: FloatArray,
    determinant: FloatArray,
) -> None:  # fmt: skip
    """Write χ² (k,) of the differences of two columns of states (n, d), from ``column`` on, of the rows ``one`` and
    ``other`` (k,), and the determinants (k,) of the sums of their covariances (n, d, d)."""
    u, v = column, column + 1
    for k in range(len(one)):
        i, j = one[k], other[k]
        x, y = state[i, u] - state[j, u], state[i, v] - state[j, v]
        a = covariance[i, u, u] + covariance[j, u, u]
        b = covariance[i, u, v] + covariance[j, u, v]
        c = covariance[i, v, v] + covariance[j, v, v]
        determinant[k] = a * c - b * b
        chi_sq[k] = (c * (x * x) - 2.0 * b * x * y + a * (y * y)) / determinant[k]


@small
def new_pair_errors(
    delta: FloatArray, covariance_a: FloatArray, covariance_b: FloatArray, lasting_a: FloatArray,
    lasting_b: FloatArray, errors: FloatArray,
) -> None:  # fmt: skip
    """Write the errors (k, WIDTH) of new pairs, given only δ = e_a − e_b + d.

    delta : (k, 2). covariance_a … lasting_b : (k, 2, 2) P and B of both tracks.
    """
    onto = np.empty((ONE, 2))
    mean_one, covariance_one = np.empty(ONE), np.empty((ONE, ONE))
    mean_two, covariance_two = np.zeros(CONVOY), np.empty((CONVOY, CONVOY))
    for k in range(len(delta)):
        p = covariance_a[k, 0, 0] + covariance_b[k, 0, 0]
        q = 0.5 * (covariance_a[k, 0, 1] + covariance_b[k, 0, 1] + covariance_a[k, 1, 0] + covariance_b[k, 1, 0])
        r = covariance_a[k, 1, 1] + covariance_b[k, 1, 1]
        determinant = p * r - q * q
        covariance_two[:] = 0.0
        for v in range(2):
            for w in range(2):
                onto[v, w], onto[2 + v, w], onto[4 + v, w] = (
                    covariance_a[k, v, w],
                    lasting_a[k, w, v],
                    -lasting_b[k, w, v],
                )
                covariance_two[v, w] = covariance_a[k, v, w]
                covariance_two[v, 2 + w] = covariance_two[2 + w, v] = lasting_a[k, v, w]
            covariance_two[2 + v, 2 + v] = covariance_two[4 + v, 4 + v] = 1.0
            # d has no prior, so δ does not constrain the errors: d = δ − e_a + e_b.
            mean_two[6 + v] = delta[k, v]
        covariance_two[6, 6], covariance_two[7, 7] = p, r
        covariance_two[6, 7] = covariance_two[7, 6] = q
        for v in range(ONE):
            gain_1, gain_2 = solve_2(p, q, r, determinant, onto[v, 0], onto[v, 1])
            mean_one[v] = gain_1 * delta[k, 0] + gain_2 * delta[k, 1]
            for w in range(ONE):
                covariance_one[v, w] = covariance_two[v, w] - (gain_1 * onto[w, 0] + gain_2 * onto[w, 1])
            for w in range(2):
                covariance_two[v, 6 + w] = covariance_two[6 + w, v] = -onto[v, w]
        _packed(mean_one, covariance_one, MEAN[0], COVARIANCE[0], errors[k])
        _packed(mean_two, covariance_two, MEAN[1], COVARIANCE[1], errors[k])


@small
def mix(errors: FloatArray, at: IntArray, share: FloatArray, others: FloatArray) -> None:
    """Replace the errors of some pairs by the moments of their mixture with others, in place.

    errors : (k, WIDTH). at : (m,) rows. share : (m,) weight of the others (m, WIDTH).
    """
    apart = np.empty(CONVOY)
    for n in range(len(at)):
        row, other, s = errors[at[n]], others[n], share[n]
        for hypothesis in range(2):
            d, place = (ONE, COVARIANCE[0]) if hypothesis == 0 else (CONVOY, COVARIANCE[1])
            begin = 0 if hypothesis == 0 else ONE
            for v in range(d):
                apart[v] = other[begin + v] - row[begin + v]
                row[begin + v] += s * apart[v]
                for w in range(v + 1):
                    row[place] = (1.0 - s) * row[place] + s * other[place] + s * (1.0 - s) * apart[v] * apart[w]
                    place += 1


@small
def best_others(label: IntArray, values: FloatArray, best: IntArray) -> None:
    """Write for every row (k,) the other row of its label with the highest value, the first of ties; −1 for none."""
    n = 0
    for one in label:
        n = max(n, one + 1)
    top, next_ = np.full(n, -1, np.int64), np.full(n, -1, np.int64)
    for k in range(len(label)):
        one = label[k]
        if top[one] < 0 or values[k] > values[top[one]]:
            top[one], next_[one] = k, top[one]
        elif next_[one] < 0 or values[k] > values[next_[one]]:
            next_[one] = k
    for k in range(len(label)):
        best[k] = next_[label[k]] if top[label[k]] == k else top[label[k]]

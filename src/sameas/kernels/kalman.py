"""Compiled loops over many small states: Kalman updates by a measurement in the plane, mixtures of two, and pairs of
tracks from one instant to the next."""

from __future__ import annotations

import math

import numpy as np

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.kernels.compiled import part, small


@small
def update_in_plane(
    mean: FloatArray, covariance: FloatArray, slope: FloatArray, noise: FloatArray, shift: FloatArray,
    updated_mean: FloatArray, updated_covariance: FloatArray, log_p: FloatArray, chi_sq: FloatArray,
) -> None:  # fmt: skip
    """Writes what :func:`sameas.picture.error_correlation.error_update` gives: x by ν = H x + n.

    mean, covariance : (k, d), (k, d, d) of x. slope, noise : (k, 2, d), (k, 2, 2) H and the covariance of n.
    shift : (k, 2) ν. updated_mean, updated_covariance : of x given ν. log_p, chi_sq : (k,) ln p(ν), and χ² of ν.
    """
    d = mean.shape[1]
    one, other = np.empty(d), np.empty(d)  # the columns of P Hᵀ
    for row in range(len(mean)):
        p, h = covariance[row], slope[row]
        x, y = shift[row, 0], shift[row, 1]
        a, b, c = noise[row, 0, 0], 0.5 * (noise[row, 0, 1] + noise[row, 1, 0]), noise[row, 1, 1]
        for v in range(d):
            one[v] = other[v] = 0.0
            for w in range(d):
                one[v] += p[v, w] * h[0, w]
                other[v] += p[v, w] * h[1, w]
        for v in range(d):
            a += h[0, v] * one[v]
            b += 0.5 * (h[0, v] * other[v] + h[1, v] * one[v])
            c += h[1, v] * other[v]
            x -= h[0, v] * mean[row, v]
            y -= h[1, v] * mean[row, v]
        determinant = a * c - b * b
        # S⁻¹ times the surprise.
        east, north = (c * x - b * y) / determinant, (a * y - b * x) / determinant
        for v in range(d):
            updated_mean[row, v] = mean[row, v] + one[v] * east + other[v] * north
            gain_1 = (c * one[v] - b * other[v]) / determinant
            gain_2 = (a * other[v] - b * one[v]) / determinant
            for w in range(v + 1):
                value = 0.5 * (p[v, w] + p[w, v]) - gain_1 * one[w] - gain_2 * other[w]
                updated_covariance[row, v, w] = updated_covariance[row, w, v] = value
        chi_sq[row] = x * east + y * north
        log_p[row] = -0.5 * (chi_sq[row] + math.log(determinant)) - math.log(2.0 * math.pi)


@small
def mix(
    mean: FloatArray, covariance: FloatArray, at: IntArray, share: FloatArray, other_mean: FloatArray,
    other_covariance: FloatArray,
) -> None:  # fmt: skip
    """Turns some states into mixtures of themselves and others: their means and covariances, in place.

    mean, covariance : (k, h, d), (k, h, d, d). at : (m,) rows. share : (m,) of the others, (m, h, d), (m, h, d, d).
    """
    away = np.empty(mean.shape[2])
    for n in range(len(at)):
        row, s = at[n], share[n]
        for h in range(mean.shape[1]):
            for v in range(len(away)):
                away[v] = other_mean[n, h, v] - mean[row, h, v]
                mean[row, h, v] += s * away[v]
            for v in range(len(away)):
                for w in range(len(away)):
                    covariance[row, h, v, w] = (
                        (1.0 - s) * covariance[row, h, v, w]
                        + s * other_covariance[n, h, v, w]
                        + s * (1.0 - s) * away[v] * away[w]
                    )


@small
def pairs_stepped(
    mean: FloatArray, covariance: FloatArray, rows: IntArray, first: IntArray, second: IntArray, last: FloatArray,
    moved: FloatArray, drift: FloatArray, slope: FloatArray, noise: FloatArray, shift: FloatArray,
    new_report: BoolArray, total: FloatArray, least_m2: float, new_mean: FloatArray, new_covariance: FloatArray,
    log_reports: FloatArray, now: FloatArray, chi_sq: FloatArray,
) -> None:  # fmt: skip
    """Writes pairs of tracks after an instant: grown by the tracks' motion, updated by the new report of the first
    track, then by that of the second.

    mean, covariance : (n, 2, 8), (n, 2, 8, 8) of (e_a, z_a, z_b, d) if the two are one object, d = 0, and if they are
    in convoy (:mod:`sameas.picture.track_pairs`). rows : (k,) pairs that go on. first, second : (k,) their tracks, rows
    of the step, of which ``last`` … ``new_report`` are columns (:class:`sameas.picture.named.Step`). total : (m, 2, 2)
    covariance of each track's position at the instant. least_m2 : what keeps certain steps invertible.
    log_reports : (k, 2) ln p of the reports under both. now, chi_sq : (k,) ln N(δ; 0, P_a + P_b) and its χ².
    """
    one, other, h = np.empty(8), np.empty(8), np.empty((2, 6))
    of_first, of_second = np.array([0, 1, 2, 3]), np.array([0, 1, 4, 5, 6, 7])
    for k in range(len(rows)):
        a, b = first[k], second[k]
        new_mean[k] = mean[rows[k]]
        new_covariance[k] = covariance[rows[k]]
        x, y = moved[a, 0] - moved[b, 0], moved[a, 1] - moved[b, 1]
        _grow(
            drift[a], drift[b], 1e-4 * least_m2, x - (last[a, 0] - last[b, 0]), y - (last[a, 1] - last[b, 1]),
            new_mean[k], new_covariance[k],
        )  # fmt: skip
        log_reports[k, 0] = log_reports[k, 1] = 0.0
        if new_report[a]:
            for v in range(2):
                for w in range(4):
                    h[v, w] = slope[a, v, w]
            for way in range(2):
                log_reports[k, way] = _update(
                    new_mean[k, way], new_covariance[k, way], of_first, h, noise[a], least_m2, shift[a, 0], shift[a, 1],
                    one, other,
                )  # fmt: skip
                for v in range(2):
                    new_mean[k, way, v] += shift[a, v]
            x, y = x + shift[a, 0], y + shift[a, 1]
        if new_report[b]:
            # e_b = e_a − δ + d.
            for v in range(2):
                for w in range(2):
                    h[v, w], h[v, 2 + w], h[v, 4 + w] = slope[b, v, w], slope[b, v, 2 + w], slope[b, v, w]
            east = shift[b, 0] + h[0, 0] * x + h[0, 1] * y
            north = shift[b, 1] + h[1, 0] * x + h[1, 1] * y
            for way in range(2):
                # d is 0 where both are one object.
                log_reports[k, way] += _update(
                    new_mean[k, way], new_covariance[k, way], of_second[: 4 + 2 * way], h, noise[b], least_m2, east,
                    north, one, other,
                )  # fmt: skip
            x, y = x - shift[b, 0], y - shift[b, 1]
        p = total[a, 0, 0] + total[b, 0, 0]
        q = total[a, 0, 1] + total[b, 0, 1]
        r = total[a, 1, 1] + total[b, 1, 1]
        determinant = p * r - q * q
        chi_sq[k] = (r * x * x - 2.0 * q * x * y + p * y * y) / determinant
        now[k] = -0.5 * (chi_sq[k] + math.log(determinant)) - math.log(2.0 * math.pi)


@part
def _grow(
    drift_a: FloatArray, drift_b: FloatArray, least: float, x: float, y: float, mean: FloatArray, covariance: FloatArray
) -> None:
    """Adds to e_a the motion of its track, of which the way (x, y) of both tracks from each other tells a part."""
    p = drift_a[0, 0] + drift_b[0, 0] + least
    q = 0.5 * (drift_a[0, 1] + drift_b[0, 1] + drift_a[1, 0] + drift_b[1, 0])
    r = drift_a[1, 1] + drift_b[1, 1] + least
    determinant = p * r - q * q
    for v in range(2):
        gain_1 = (drift_a[v, 0] * r - drift_a[v, 1] * q) / determinant
        gain_2 = (drift_a[v, 1] * p - drift_a[v, 0] * q) / determinant
        for way in range(2):
            mean[way, v] += gain_1 * x + gain_2 * y
            for w in range(2):
                left = 0.5 * (drift_a[v, w] - gain_1 * drift_a[0, w] - gain_2 * drift_a[1, w])
                covariance[way, v, w] += left
                covariance[way, w, v] += left


@part
def _update(
    mean: FloatArray, covariance: FloatArray, seen: IntArray, slope: FloatArray, noise: FloatArray, least: float,
    east: float, north: float, one: FloatArray, other: FloatArray,
) -> float:  # fmt: skip
    """Updates a state in place by ν = H x + n, ν = (east, north), and gives ln p(ν); H is ``slope`` (2, …) on the
    components ``seen`` and 0 on others. one, other : room for the columns of P Hᵀ."""
    d = len(mean)
    for v in range(d):
        one[v] = other[v] = 0.0
        for at in range(len(seen)):
            one[v] += covariance[v, seen[at]] * slope[0, at]
            other[v] += covariance[v, seen[at]] * slope[1, at]
    a, b, c = noise[0, 0] + least, 0.5 * (noise[0, 1] + noise[1, 0]), noise[1, 1] + least
    for at in range(len(seen)):
        v = seen[at]
        a += slope[0, at] * one[v]
        b += 0.5 * (slope[0, at] * other[v] + slope[1, at] * one[v])
        c += slope[1, at] * other[v]
        east -= slope[0, at] * mean[v]
        north -= slope[1, at] * mean[v]
    determinant = a * c - b * b
    x, y = (c * east - b * north) / determinant, (a * north - b * east) / determinant
    for v in range(d):
        mean[v] += one[v] * x + other[v] * y
        gain_1 = (c * one[v] - b * other[v]) / determinant
        gain_2 = (a * other[v] - b * one[v]) / determinant
        for w in range(v + 1):
            value = 0.5 * (covariance[v, w] + covariance[w, v]) - gain_1 * one[w] - gain_2 * other[w]
            covariance[v, w] = covariance[w, v] = value
    return -0.5 * (east * x + north * y + math.log(determinant)) - math.log(2.0 * math.pi)


@small
def pairs_anew(
    delta: FloatArray, covariance_a: FloatArray, covariance_b: FloatArray, lasting_a: FloatArray,
    lasting_b: FloatArray, mean: FloatArray, covariance: FloatArray,
) -> None:  # fmt: skip
    """Writes (e_a, z_a, z_b, d) of pairs by δ = e_a − e_b + d alone, if they are one object and if they are in convoy.

    delta : (k, 2). covariance_a … lasting_b : (k, 2, 2) P and B of both tracks. mean, covariance : (k, 2, 8),
    (k, 2, 8, 8), zeros.
    """
    onto = np.empty((6, 2))
    for k in range(len(delta)):
        p = covariance_a[k, 0, 0] + covariance_b[k, 0, 0]
        q = 0.5 * (covariance_a[k, 0, 1] + covariance_b[k, 0, 1] + covariance_a[k, 1, 0] + covariance_b[k, 1, 0])
        r = covariance_a[k, 1, 1] + covariance_b[k, 1, 1]
        determinant = p * r - q * q
        for v in range(2):
            for w in range(2):
                onto[v, w], onto[2 + v, w], onto[4 + v, w] = (
                    covariance_a[k, v, w],
                    lasting_a[k, w, v],
                    -lasting_b[k, w, v],
                )
                for way in range(2):
                    covariance[k, way, v, w] = covariance_a[k, v, w]
                    covariance[k, way, v, 2 + w] = covariance[k, way, 2 + w, v] = lasting_a[k, v, w]
            for way in range(2):
                covariance[k, way, 2 + v, 2 + v] = covariance[k, way, 4 + v, 4 + v] = 1.0
            # Of any distance d, δ tells nothing of the errors: d = δ − e_a + e_b.
            mean[k, 1, 6 + v] = delta[k, v]
        covariance[k, 1, 6, 6], covariance[k, 1, 7, 7] = p, r
        covariance[k, 1, 6, 7] = covariance[k, 1, 7, 6] = q
        for v in range(6):
            gain_1 = (onto[v, 0] * r - onto[v, 1] * q) / determinant
            gain_2 = (onto[v, 1] * p - onto[v, 0] * q) / determinant
            mean[k, 0, v] = gain_1 * delta[k, 0] + gain_2 * delta[k, 1]
            for w in range(6):
                covariance[k, 0, v, w] -= gain_1 * onto[w, 0] + gain_2 * onto[w, 1]
            for w in range(2):
                covariance[k, 1, v, 6 + w] = covariance[k, 1, 6 + w, v] = -onto[v, w]


@small
def best_others(label: IntArray, values: FloatArray, best: IntArray) -> None:
    """Writes for every row (k,) another one of its label of the highest value, the first of equal ones; −1 for none."""
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


@small
def swap_evidence(
    label: IntArray, log_stayed: FloatArray, log_swapped: FloatArray, near: FloatArray, most: FloatArray,
    stayed: FloatArray, change: FloatArray, some: BoolArray,
) -> None:  # fmt: skip
    """Writes per label (n,) sums over its pairs, whose probability is an affine function of the rate h of swaps.

    label, log_stayed, log_swapped, near : (k,) ln of a pair's weight without a swap and after one, and the probability
    of a swap for h = 1. most : ln of a factor of both sums. stayed, change : Σ of the weights without a swap, and
    Σ near · (weight after one less weight without). some : whether any of the pairs may be swapped.
    """
    most[:] = -np.inf
    stayed[:] = 0.0
    change[:] = 0.0
    some[:] = False
    for k in range(len(label)):
        one = label[k]
        # A swap may be as improbable as what it explains: near counts with its weight, or both sums come to 0.
        most[one] = max(most[one], log_stayed[k], log_swapped[k] + math.log(near[k]) if near[k] > 0.0 else -np.inf)
        some[one] = some[one] or near[k] > 0.0
    for k in range(len(label)):
        one = label[k]
        if some[one]:
            without = math.exp(log_stayed[k] - most[one])
            stayed[one] += without
            if near[k] > 0.0:
                change[one] += math.exp(log_swapped[k] + math.log(near[k]) - most[one]) - near[k] * without


@small
def joint_in_plane(
    sets: IntArray, place: FloatArray, precision: FloatArray, log_peak: FloatArray, centre: FloatArray,
    prior: FloatArray, log_density: FloatArray,
) -> None:  # fmt: skip
    """Writes ln J (k,) of sets of records in the plane: the integral over x of all their densities
    (:mod:`sameas.many.joint`).

    sets : (k, size) records. place, precision, log_peak : (n, 2), (n, 2, 2), (n,) z, R⁻¹ and −½ ln|2π R| of records.
    centre, prior : (2,), (2, 2) of the region of x and its information, 0 where there is none.
    """
    for k in range(len(sets)):
        x0, y0 = place[sets[k, 0], 0], place[sets[k, 0], 1]
        x, y = centre[0] - x0, centre[1] - y0
        a, b, c = prior[0, 0], prior[0, 1], prior[1, 1]
        east, north = a * x + b * y, b * x + c * y
        square, log_norm = x * east + y * north, 0.0
        for record in sets[k]:
            p, q, r = precision[record, 0, 0], precision[record, 0, 1], precision[record, 1, 1]
            x, y = place[record, 0] - x0, place[record, 1] - y0
            a, b, c = a + p, b + q, c + r
            east, north = east + p * x + q * y, north + q * x + r * y
            square += p * x * x + 2.0 * q * x * y + r * y * y
            log_norm += log_peak[record]
        determinant = a * c - b * b
        square -= (c * east * east - 2.0 * b * east * north + a * north * north) / determinant
        log_density[k] = log_norm + math.log(2.0 * math.pi) - 0.5 * (math.log(determinant) + max(square, 0.0))


@small
def correlated_shifts(
    shift: FloatArray, both: FloatArray, shared: FloatArray, motion: FloatArray, correlations: FloatArray,
    shares: FloatArray, least_m2: float, log_p: FloatArray,
) -> None:  # fmt: skip
    """Writes ln p (n, c) of the way between two reports of a track, for some correlations of their errors.

    shift : (n, 2) ν. both, shared, motion : (n, 2, 2) R + R′, L L′ᵀ + L′ Lᵀ, and D. correlations : (c,) ρ. shares : of
    D, each as probable: ν ~ N(0, R + R′ − ρ (L L′ᵀ + L′ Lᵀ) + κ D).
    """
    for k in range(len(shift)):
        x, y = shift[k, 0], shift[k, 1]
        for c in range(len(correlations)):
            rho, total, most = correlations[c], 0.0, -math.inf
            p = both[k, 0, 0] - rho * shared[k, 0, 0] + least_m2
            q = both[k, 0, 1] - rho * shared[k, 0, 1]
            r = both[k, 1, 1] - rho * shared[k, 1, 1] + least_m2
            for share in shares:
                a, b, d = p + share * motion[k, 0, 0], q + share * motion[k, 0, 1], r + share * motion[k, 1, 1]
                determinant = a * d - b * b
                value = -0.5 * ((d * x * x - 2.0 * b * x * y + a * y * y) / determinant + math.log(determinant))
                if value > most:
                    total, most = total * math.exp(most - value) + 1.0, value
                else:
                    total += math.exp(value - most)
            log_p[k, c] = most + math.log(total) - math.log(2.0 * math.pi)


@small
def add_evidence(
    source: IntArray, rho: FloatArray, log_p: FloatArray, correlations: FloatArray, shares: FloatArray,
    evidence: FloatArray,
) -> None:  # fmt: skip
    """Adds to ``evidence`` (S, s, τ) of every source ln p of n values, linear between some correlations.

    source : (n,). rho : (n, τ) exp(−Δt/τ). log_p : (n, c) at the ``correlations`` (c,), ascending. shares : (s,) that
    last.
    """
    last = len(correlations) - 1
    for k in range(len(source)):
        for s in range(len(shares)):
            for t in range(rho.shape[1]):
                correlation = shares[s] + (1.0 - shares[s]) * rho[k, t]
                above = 1
                while above < last and correlations[above] < correlation:
                    above += 1
                weight = (correlation - correlations[above - 1]) / (correlations[above] - correlations[above - 1])
                weight = min(max(weight, 0.0), 1.0)
                evidence[source[k], s, t] += (1.0 - weight) * log_p[k, above - 1] + weight * log_p[k, above]

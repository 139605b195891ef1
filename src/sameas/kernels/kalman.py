"""Compiled loops over states in the plane: Kalman updates, joint densities of sets of records, the best other pair of
a track, the evidence of swapped tracks, and the likelihood of track displacements."""

from __future__ import annotations

import math

import numpy as np

from sameas.arrays import FloatArray, IntArray
from sameas.kernels.compiled import small
from sameas.kernels.linear import solve_2


@small
def update_in_plane(
    mean: FloatArray, covariance: FloatArray, slope: FloatArray, noise: FloatArray, shift: FloatArray,
    updated_mean: FloatArray, updated_covariance: FloatArray, log_p: FloatArray, chi_sq: FloatArray,
) -> None:  # fmt: skip
    """Write the Kalman update of states x by ν = H x + n (:func:`sameas.picture.error_factors.error_update`).

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
        east, north = solve_2(a, b, c, determinant, x, y)  # S⁻¹ times the innovation
        for v in range(d):
            updated_mean[row, v] = mean[row, v] + one[v] * east + other[v] * north
            gain_1, gain_2 = solve_2(a, b, c, determinant, one[v], other[v])
            for w in range(v + 1):
                value = 0.5 * (p[v, w] + p[w, v]) - gain_1 * one[w] - gain_2 * other[w]
                updated_covariance[row, v, w] = updated_covariance[row, w, v] = value
        chi_sq[row] = x * east + y * north
        log_p[row] = -0.5 * (chi_sq[row] + math.log(determinant)) - math.log(2.0 * math.pi)


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


@small
def joint_in_plane(
    sets: IntArray, place: FloatArray, precision: FloatArray, log_peak: FloatArray, centre: FloatArray,
    prior: FloatArray, log_density: FloatArray,
) -> None:  # fmt: skip
    """Write ln J (k,) of sets of records in the plane (:mod:`sameas.many.joint`).

    sets : (k, size) records. place, precision, log_peak : (n, 2), (n, 2, 2), (n,) z, R⁻¹ and −½ ln|2π R| of records.
    centre, prior : (2,), (2, 2) centre and information of the region, 0 without a region.
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
    shares: FloatArray, added_m2: float, log_p: FloatArray,
) -> None:  # fmt: skip
    """Write ln p (n, c) of the displacements between two reports of a track, for correlations ρ (c,) of their errors.

    shift : (n, 2) ν. both, shared, motion : (n, 2, 2) R + R′, L L′ᵀ + L′ Lᵀ, and D. shares : equally probable κ:
    ν ~ N(0, R + R′ − ρ (L L′ᵀ + L′ Lᵀ) + κ D).
    """
    for k in range(len(shift)):
        x, y = shift[k, 0], shift[k, 1]
        for c in range(len(correlations)):
            rho, total, least = correlations[c], 0.0, math.inf
            p = both[k, 0, 0] - rho * shared[k, 0, 0] + added_m2
            q = both[k, 0, 1] - rho * shared[k, 0, 1]
            r = both[k, 1, 1] - rho * shared[k, 1, 1] + added_m2
            for share in shares:
                a, b, d = p + share * motion[k, 0, 0], q + share * motion[k, 0, 1], r + share * motion[k, 1, 1]
                determinant = a * d - b * b
                half = 0.5 * (d * x * x - 2.0 * b * x * y + a * y * y) / determinant
                # Relative to the smallest exponent so far, so that not all terms underflow.
                if half < least:
                    total, least = total * math.exp(half - least) + 1.0 / math.sqrt(determinant), half
                else:
                    total += math.exp(least - half) / math.sqrt(determinant)
            log_p[k, c] = math.log(total) - least - math.log(2.0 * math.pi)


@small
def add_evidence(
    source: IntArray, rho: FloatArray, log_p: FloatArray, correlations: FloatArray, shares: FloatArray,
    evidence: FloatArray,
) -> None:  # fmt: skip
    """Add to ``evidence`` (S, s, τ) of each source ln p of n displacements, interpolated linearly in the correlation.

    source : (n,). rho : (n, τ) exp(−Δt/τ). log_p : (n, c) at the ``correlations`` (c,), ascending. shares : (s,) of the
    error variance that is constant.
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

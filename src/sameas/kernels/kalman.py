"""Compiled loops over states in the plane: their prediction to the next instant (:mod:`sameas.tracks.alignment`) and
that of named tracks (:mod:`sameas.picture.named_tracks`), Kalman updates, joint densities of sets of records, the
evidence of swapped tracks, and the likelihood of track displacements."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from sameas.arrays import FloatArray, IntArray
from sameas.kernels.compiled import part, small, small_by
from sameas.kernels.linear import positive_2, solve_2


def _work(rows: IntArray | FloatArray, *_: Any) -> float:
    # Two covariances of 16 elements for each row, each used several times.
    return 100.0 * len(rows)


@small_by(_work)
def states_moved(
    state: FloatArray, covariance: FloatArray, dt: FloatArray, walk: FloatArray, late_s: float, predicted: FloatArray,
    predicted_covariance: FloatArray,
) -> None:  # fmt: skip
    """Write states (n, 4) and covariances (n, 4, 4) after ``dt`` (n,) seconds, to the last bit as the NumPy branch of
    :func:`sameas.tracks.alignment.moved`.

    walk : (n,) m²/s³, random walk of the velocities. late_s : 1σ of the time stamps, 0 for exact ones.
    """
    cross = np.empty((2, 2))
    for k in range(len(state)):
        t, p, x, out = dt[k], covariance[k], predicted[k], predicted_covariance[k]
        size = abs(t)
        for v in range(2):
            x[v], x[2 + v] = state[k, v] + t * state[k, 2 + v], state[k, 2 + v]
            for w in range(2):
                cross[v, w] = p[v, 2 + w] + t * p[2 + v, 2 + w]
                out[v, 2 + w] = out[2 + w, v] = cross[v, w]
                out[2 + v, 2 + w] = 0.5 * (p[2 + v, 2 + w] + p[2 + w, 2 + v])
        for v in range(2):
            for w in range(2):
                one, other = p[v, w] + t * (p[2 + v, w] + cross[v, w]), p[w, v] + t * (p[2 + w, v] + cross[w, v])
                out[v, w] = 0.5 * (one + other)
        # Q of :func:`sameas.tracks.alignment.process_noise`, by axis.
        q_position, q_cross, q_speed = walk[k] * (size * size * size) / 3.0, walk[k] * t * size / 2.0, walk[k] * size
        for v in range(2):
            out[v, v] += q_position
            out[v, 2 + v] += q_cross
            out[2 + v, v] += q_cross
            out[2 + v, 2 + v] += q_speed
        if late_s != 0.0:
            for v in range(2):
                for w in range(2):
                    out[v, w] += late_s * late_s * (x[2 + v] * x[2 + w] + out[2 + v, 2 + w])


@small_by(_work)
def tracks_moved(
    last: IntArray, state: FloatArray, covariance: FloatArray, walk: FloatArray, late_s: FloatArray, dt: FloatArray,
    manoeuvre: FloatArray, previous: FloatArray, place: FloatArray, old: FloatArray, drift: FloatArray,
) -> None:  # fmt: skip
    """Write the last reports of tracks predicted to the instant: ``place`` (m, 2), its covariance ``old`` (m, 2, 2),
    and ``drift`` (m, 2, 2), the growth of that covariance since the previous instant.

    last : (m,) rows of the reports. state, covariance, walk, late_s, previous : (n, 4), (n, 4, 4), (n,), (n,),
    (n, 4, 4) of all reports: state, covariance, random walk of the velocity, 1σ of the time stamps, covariance at the
    previous instant. dt : (m,) seconds since the reports. manoeuvre : (m, 4, 4) covariance of a manoeuvre.
    """
    growth = np.empty((2, 2))
    for k in range(len(last)):
        r, t = last[k], dt[k]
        x, p = state[r], covariance[r]
        for v in range(2):
            place[k, v] = x[v] + t * x[2 + v]
        for v in range(2):
            for w in range(v + 1):
                # The covariance of the velocity grows by the random walk only, which is along the axes.
                speed = 0.5 * (p[2 + v, 2 + w] + p[2 + w, 2 + v])
                cross = 0.5 * (p[v, 2 + w] + p[2 + w, v] + p[w, 2 + v] + p[2 + v, w])
                value = 0.5 * (p[v, w] + p[w, v]) + t * cross + t * t * speed
                q_speed = 0.0
                if v == w:
                    value += walk[r] * abs(t) * t * t / 3.0
                    q_speed = walk[r] * abs(t)
                value += late_s[r] * late_s[r] * (x[2 + v] * x[2 + w] + speed + q_speed)
                old[k, v, w] = old[k, w, v] = value + 0.5 * (manoeuvre[k, v, w] + manoeuvre[k, w, v])
        for v in range(2):
            for w in range(2):
                growth[v, w] = old[k, v, w] - previous[r, v, w]
        _positive_part(growth, drift[k])


@small_by(_work)
def report_factors(
    last: IntArray, now: IntArray, reported_last: FloatArray, reported: FloatArray, old: FloatArray, new: FloatArray,
    root_last: FloatArray, root: FloatArray, motion: FloatArray,
) -> None:  # fmt: skip
    """Write the Cholesky factors L, L′ of the position covariances of each track's last and new report, and its motion.

    last, now : (m,) rows of the last and the new reports. reported_last, reported : (n, 4, 4) covariances R, R′. old,
    new : (m, 2, 2) both covariances at the instant. root_last, root, motion : (m, 2, 2) L, L′, and D, the positive part
    of old + new − R − R′.
    """
    growth = np.empty((2, 2))
    for k in range(len(last)):
        one, other = reported_last[last[k]], reported[now[k]]
        _cholesky_2(one, root_last[k])
        _cholesky_2(other, root[k])
        for v in range(2):
            for w in range(2):
                growth[v, w] = old[k, v, w] + new[k, v, w] - one[v, w] - other[v, w]
        _positive_part(growth, motion[k])


@small_by(_work)
def innovation_model(
    root_last: FloatArray, root: FloatArray, old: FloatArray, new: FloatArray, share: FloatArray,
    decaying: FloatArray, slope: FloatArray, noise: FloatArray,
) -> None:  # fmt: skip
    """Write H (m, 2, 4) and the covariance (m, 2, 2) of n in ν = H (e, z) + n (:mod:`sameas.picture.named_tracks`).

    root_last, root : (m, 2, 2) L, L′. old, new : (m, 2, 2) P before and after the report. share : (m,) s, the constant
    part of the error variance. decaying : (m,) ρ (1 − s).
    """
    common, rest, gain = np.empty((2, 2)), np.empty((2, 2)), np.empty((2, 2))
    for k in range(len(share)):
        one, other, s = root_last[k], root[k], math.sqrt(share[k])
        for v in range(2):
            for w in range(2):
                common[v, w] = decaying[k] * (one[v, 0] * other[w, 0] + one[v, 1] * other[w, 1])
                rest[v, w] = old[k, v, w] - share[k] * (one[v, 0] * one[w, 0] + one[v, 1] * one[w, 1])
        a, b, c = rest[0, 0], 0.5 * (rest[0, 1] + rest[1, 0]), rest[1, 1]
        determinant = a * c - b * b
        for v in range(2):
            gain[v, 0], gain[v, 1] = solve_2(a, b, c, determinant, common[0, v], common[1, v])
        for v in range(2):
            for w in range(2):
                slope[k, v, w] = gain[v, w] - (1.0 if v == w else 0.0)
                slope[k, v, 2 + w] = s * (other[v, w] - gain[v, 0] * one[0, w] - gain[v, 1] * one[1, w])
                constant = share[k] * (other[v, 0] * other[w, 0] + other[v, 1] * other[w, 1])
                noise[k, v, w] = new[k, v, w] - constant - gain[v, 0] * common[0, w] - gain[v, 1] * common[1, w]


@part
def _cholesky_2(covariance: FloatArray, root: FloatArray) -> None:
    """Write the lower Cholesky factor L (2, 2) of the position's part of a covariance.

    A covariance of nearly rank 1 may have a slightly negative determinant by rounding; it counts as rank 1.
    """
    root[0, 0] = math.sqrt(covariance[0, 0])
    root[1, 0] = covariance[1, 0] / root[0, 0]
    root[1, 1] = math.sqrt(max(covariance[1, 1] - root[1, 0] * root[1, 0], 0.0))
    root[0, 1] = 0.0


@part
def _positive_part(change: FloatArray, out: FloatArray) -> None:
    """Write the positive semidefinite part (2, 2) of a change of a covariance."""
    mean = 0.5 * (change[0, 0] + change[1, 1])
    half, cross = 0.5 * (change[0, 0] - change[1, 1]), 0.5 * (change[0, 1] + change[1, 0])
    radius = math.sqrt(half * half + cross * cross)
    # The eigenvalues are m ± r, with projections ½ [1 ± D / r], D = change − m.
    high, low = max(mean + radius, 0.0), max(mean - radius, 0.0)
    level, slope = 0.5 * (high + low), 0.5 * (high - low) / (radius if radius > 0.0 else 1.0)
    out[0, 0], out[1, 1] = level + slope * half, level - slope * half
    out[0, 1] = out[1, 0] = slope * cross


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
        a, b, c, determinant = positive_2(a, b, c)
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
def joint_in_plane(
    sets: IntArray, place: FloatArray, precision: FloatArray, log_peak: FloatArray, centre: FloatArray,
    prior: FloatArray, log_density: FloatArray,
) -> None:  # fmt: skip
    """Write ln J (k,) of sets of records in the plane (:mod:`sameas.many.observations`).

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
            # At least a positive semidefinite matrix plus ``added_m2``, but for rounding.
            p = max(both[k, 0, 0] - rho * shared[k, 0, 0], 0.0) + added_m2
            q = both[k, 0, 1] - rho * shared[k, 0, 1]
            r = max(both[k, 1, 1] - rho * shared[k, 1, 1], 0.0) + added_m2
            for share in shares:
                a, b, d = p + share * motion[k, 0, 0], q + share * motion[k, 0, 1], r + share * motion[k, 1, 1]
                determinant = max(a * d - b * b, added_m2 * (a + d - added_m2))
                half = max(0.5 * (d * x * x - 2.0 * b * x * y + a * y * y) / determinant, 0.0)
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

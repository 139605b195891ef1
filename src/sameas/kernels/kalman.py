"""Compiled loops over states in the plane: their prediction to the next instant (:mod:`sameas.tracks.alignment`) and
that of named tracks (:mod:`sameas.picture.named_tracks`), Kalman updates, joint densities of sets of records, the
evidence of swapped tracks, the likelihood of track displacements, fusion by covariance intersection
(:mod:`sameas.many.fusion`), and the states of objects from their records (:mod:`sameas.picture.tables`).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.kernels.compiled import inlined, part, small, small_by
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
    for k in range(len(state)):
        x, out = predicted[k], predicted_covariance[k]
        state_moved(state[k], covariance[k], dt[k], walk[k], x, out)
        if late_s != 0.0:
            for v in range(2):
                for w in range(2):
                    out[v, w] += late_s * late_s * (x[2 + v] * x[2 + w] + out[2 + v, 2 + w])


@inlined
def state_moved(state: FloatArray, p: FloatArray, t: float, walk: float, x: FloatArray, out: FloatArray) -> None:
    """Write one state and its covariance after ``t`` seconds of a random walk of its velocity, F x and F P Fᵀ + Q."""
    size = abs(t)
    for v in range(2):
        x[v], x[2 + v] = state[v] + t * state[2 + v], state[2 + v]
        for w in range(2):
            out[v, 2 + w] = out[2 + w, v] = p[v, 2 + w] + t * p[2 + v, 2 + w]
            out[2 + v, 2 + w] = 0.5 * (p[2 + v, 2 + w] + p[2 + w, 2 + v])
    for v in range(2):
        for w in range(2):
            one, other = p[v, w] + t * (p[2 + v, w] + out[v, 2 + w]), p[w, v] + t * (p[2 + w, v] + out[w, 2 + v])
            out[v, w] = 0.5 * (one + other)
    # Q of :func:`sameas.tracks.alignment.process_noise`, by axis.
    q_position, q_cross, q_speed = walk * (size * size * size) / 3.0, walk * t * size / 2.0, walk * size
    for v in range(2):
        out[v, v] += q_position
        out[v, 2 + v] += q_cross
        out[2 + v, v] += q_cross
        out[2 + v, 2 + v] += q_speed


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


#: Jacobi's method: most sweeps, and the sum of squares off the diagonal, relative to that on it, at convergence.
SWEEPS, OFF_DIAGONAL = 30, 1e-30
#: A larger slope is positive in spite of rounding.
CERTAIN = 1e-6
#: Information on the position of an object without position: of 1σ as wide as a plane, 1/m².
NO_POSITION = 1e-12


def _work_of_information(information: FloatArray, *_: Any) -> float:
    # Each element of a matrix is used some dozens of times.
    return 30.0 * information.size


@small_by(_work_of_information)
def weights_of_least_determinant(
    information: FloatArray, steps: int, optimal: float, halvings: int, weights: FloatArray
) -> None:
    """Write the weights (n, k) of n objects of k estimates that maximise |Σ w I|, I their information (n, k, d, d).

    By vertex exchange: the estimate of largest slope tr(I (Σ w I)⁻¹) takes the best amount of the weight of that of
    smallest slope, until no slope exceeds d by more than the relative ``optimal``, or for ``steps`` iterations.
    """
    for row in range(len(information)):
        weigh(information[row], steps, optimal, halvings, weights[row])


@inlined
def weigh(information: FloatArray, steps: int, optimal: float, halvings: int, w: FloatArray) -> None:
    """Write the weights w (k,) of the estimates of one object, from their information (k, d, d)."""
    k, d, _ = information.shape
    total, root, half, change = np.empty((d, d)), np.empty((d, d)), np.empty((d, d)), np.empty((d, d))
    slope = np.empty(k)
    w[:] = 1.0 / k
    for _ in range(steps):
        total[:] = 0.0
        for one in range(k):
            for a in range(d):
                for b in range(a + 1):
                    total[a, b] += w[one] * information[one, a, b]
        inverse_root(total, root)
        to, off = 0, -1  # estimates of largest and of smallest slope
        for one in range(k):
            # tr(L⁻¹ I L⁻ᵀ)
            slope[one] = 0.0
            for a in range(d):
                for b in range(a + 1):
                    value = 0.0
                    for c in range(a + 1):
                        value += root[a, c] * information[one, c, b]
                    slope[one] += value * root[a, b]
            slope[one] /= d
            if slope[one] > slope[to]:
                to = one
            if w[one] > 0.0 and (off < 0 or slope[one] < slope[off]):
                off = one
        if not slope[to] > 1.0 + optimal:
            break
        for a in range(d):
            for b in range(d):
                half[a, b] = 0.0
                for c in range(a + 1):
                    half[a, b] += root[a, c] * (information[to, c, b] - information[off, c, b])
        for a in range(d):
            for b in range(a + 1):
                value = 0.0
                for c in range(b + 1):
                    value += half[a, c] * root[b, c]
                change[a, b] = change[b, a] = value
        # In most cases one estimate takes all the weight of the other, which needs no eigenvalues to see.
        step = w[off]
        if not _slope_at(change, step, total, root) > CERTAIN:
            _to_eigenvalues(change)
            step = _best_exchange(change, w[off], halvings)
        w[to] += step
        w[off] -= step
        total_weight = 0.0
        for one in range(k):
            total_weight += w[one]
        for one in range(k):
            w[one] /= total_weight


@inlined
def inverse_root(matrix: FloatArray, inverse: FloatArray) -> None:
    """Write L⁻¹ of a matrix L Lᵀ, whose lower triangle is used and overwritten."""
    d = len(matrix)
    for a in range(d):
        for b in range(a + 1):
            value = matrix[a, b]
            for c in range(b):
                value -= matrix[a, c] * matrix[b, c]
            matrix[a, b] = math.sqrt(max(value, 1e-300)) if a == b else value / matrix[b, b]
    for b in range(d):
        inverse[b, b] = 1.0 / matrix[b, b]
        for a in range(b + 1, d):
            value = 0.0
            for c in range(b, a):
                value -= matrix[a, c] * inverse[c, b]
            inverse[a, b], inverse[b, a] = value / matrix[a, a], 0.0


@part
def _to_eigenvalues(matrix: FloatArray) -> None:
    """Rotate a symmetric matrix until its eigenvalues are on its diagonal (Jacobi)."""
    d = len(matrix)
    for _ in range(SWEEPS):
        off_diagonal, diagonal = 0.0, 0.0
        for a in range(d):
            diagonal += matrix[a, a] * matrix[a, a]
            for b in range(a):
                off_diagonal += matrix[a, b] * matrix[a, b]
        if off_diagonal <= OFF_DIAGONAL * diagonal:
            return
        for a in range(1, d):
            for b in range(a):
                if matrix[a, b] == 0.0:
                    continue
                theta = 0.5 * (matrix[a, a] - matrix[b, b]) / matrix[a, b]
                tangent = 1.0 / (abs(theta) + math.sqrt(theta * theta + 1.0))
                tangent = tangent if theta >= 0.0 else -tangent
                cosine = 1.0 / math.sqrt(tangent * tangent + 1.0)
                sine = tangent * cosine
                for c in range(d):
                    one, other = matrix[c, b], matrix[c, a]
                    matrix[c, b], matrix[c, a] = cosine * one - sine * other, sine * one + cosine * other
                for c in range(d):
                    one, other = matrix[b, c], matrix[a, c]
                    matrix[b, c], matrix[a, c] = cosine * one - sine * other, sine * one + cosine * other


@inlined
def _slope_at(change: FloatArray, most: float, whole: FloatArray, root: FloatArray) -> float:
    """The slope of ln|1 + δ D| at δ = ``most``: tr(D (1 + δ D)⁻¹), with D = ``change``. whole, root : scratch."""
    for a in range(len(change)):
        for b in range(a + 1):
            whole[a, b] = most * change[a, b] + (1.0 if a == b else 0.0)
    inverse_root(whole, root)
    slope = 0.0
    for c in range(len(change)):
        for a in range(c + 1):
            value = 0.0
            for b in range(c + 1):
                value += root[c, b] * change[b, a]
            slope += value * root[c, a]
    return slope


@part
def _best_exchange(change: FloatArray, most: float, halvings: int) -> float:
    """The δ in 0 … ``most`` that maximises ln|1 + δ D|; the diagonal of ``change`` has the eigenvalues μ of D.

    The slope Σ μ/(1 + δ μ) decreases with δ. Its zero is found by bisection to 2^−halvings of ``most``; δ is ``most``
    if the slope is not negative there.
    """
    slope = 0.0
    for v in range(len(change)):
        slope += change[v, v] / max(1.0 + most * change[v, v], 1e-300)
    if slope >= 0.0:
        return most
    low, high = 0.0, most
    for _ in range(halvings):
        middle, slope = 0.5 * (low + high), 0.0
        for v in range(len(change)):
            slope += change[v, v] / (1.0 + middle * change[v, v])
        if slope > 0.0:
            low = middle
        else:
            high = middle
    return 0.5 * (low + high)


def _work_of_members(members: IntArray, *_: Any) -> float:
    # A record's covariance has 16 elements, each used some dozens of times.
    return 500.0 * members.size


@small_by(_work_of_members)
def sum_of_records(
    members: IntArray, state: FloatArray, covariance: FloatArray, placed: BoolArray, moving: BoolArray,
    smoothed: BoolArray, speed: FloatArray, steps: int, optimal: float, halvings: int, mean: FloatArray,
    spread: FloatArray, has_place: BoolArray, has_velocity: BoolArray,
) -> None:  # fmt: skip
    """Write states (n, 4) and covariances (n, 4, 4) of objects, and whether they have a position and a velocity.

    members : (n, S) records, −1 for none. state … speed : (r, …) of all records. placed, moving : whether a position
    and a velocity are reported. smoothed : records that are first fused by covariance intersection
    (:func:`weigh`). speed : 1σ of an unreported velocity on each axis.
    """
    n, most = members.shape
    information, weights, own = np.zeros((most, 4, 4)), np.ones(most), np.empty(most, np.int64)
    total, root, vector, offset = np.empty((4, 4)), np.empty((4, 4)), np.empty(4), np.empty(4)
    intersected, shares = np.empty((most, 4, 4)), np.empty(most)
    for k in range(n):
        count = n_intersected = 0
        slowest = 0.0
        has_place[k] = has_velocity[k] = False
        for record in members[k]:
            if record < 0 or not placed[record]:
                continue
            _information(covariance[record], moving[record], total, root, information[count])
            own[count], weights[count] = record, 1.0
            if smoothed[record]:
                intersected[n_intersected] = information[count]
                n_intersected += 1
            has_place[k], has_velocity[k] = True, has_velocity[k] or moving[record]
            slowest = max(slowest, speed[record])
            count += 1
        if n_intersected > 1:
            weigh(intersected[:n_intersected], steps, optimal, halvings, shares[:n_intersected])
            at = 0
            for m in range(count):
                if smoothed[own[m]]:
                    weights[m] = shares[at]
                    at += 1
        total[:], vector[:] = 0.0, 0.0
        for m in range(count):
            # Relative to the first record, so that large coordinates do not lose digits.
            for v in range(4):
                offset[v] = state[own[m], v] - (state[own[0], v] if v < 2 else 0.0)
            for v in range(4):
                for w in range(4):
                    value = weights[m] * information[m, v, w]
                    total[v, w] += value
                    vector[v] += value * offset[w]
        if not has_velocity[k]:
            total[2, 2] += 1.0 / max(slowest, 1.0) ** 2
            total[3, 3] += 1.0 / max(slowest, 1.0) ** 2
        if not has_place[k]:
            total[0, 0] = total[1, 1] = NO_POSITION
        _inverse(total, root, spread[k])
        for v in range(4):
            mean[k, v] = state[own[0], v] if v < 2 and has_place[k] else 0.0
            for w in range(4):
                mean[k, v] += spread[k, v, w] * vector[w]


@inlined
def _information(covariance: FloatArray, moving: bool, copy: FloatArray, root: FloatArray, out: FloatArray) -> None:
    """Write the information (4, 4) of a record, 0 on a velocity that is not reported. copy, root : scratch."""
    if moving:
        for v in range(4):
            for w in range(4):
                copy[v, w] = covariance[v, w]
        _inverse(copy, root, out)
        return
    out[:] = 0.0
    a, b, c = covariance[0, 0], 0.5 * (covariance[0, 1] + covariance[1, 0]), covariance[1, 1]
    determinant = a * c - b * b
    out[0, 0], out[1, 1] = c / determinant, a / determinant
    out[0, 1] = out[1, 0] = -b / determinant


@inlined
def _inverse(matrix: FloatArray, root: FloatArray, out: FloatArray) -> None:
    """Write the inverse of a positive definite matrix, which is overwritten. root : scratch."""
    inverse_root(matrix, root)
    for v in range(len(matrix)):
        for w in range(v + 1):
            value = 0.0
            for c in range(v, len(matrix)):
                value += root[c, v] * root[c, w]
            out[v, w] = out[w, v] = value

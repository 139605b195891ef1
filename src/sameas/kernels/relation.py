"""Compiled densities of one magnitude given others, and their estimation: see ``sameas.estimate.photometry``."""

from __future__ import annotations

import math

import numpy as np

from sameas.arrays import AnyIntArray, FloatArray, IntArray
from sameas.kernels.compiled import part, small
from sameas.kernels.linear import solve, summed

#: Upper limit of exponents, below the overflow of exp.
MAX_EXPONENT = 700.0

# Curves of a share against magnitude, linear between knots.


@part
def directory(knots: FloatArray) -> IntArray:
    """The knot at or before each of 128 equal steps from the first knot to the last, where a search begins."""
    starts, at = np.zeros(128, np.int64), 0
    for step in range(len(starts)):
        x = knots[0] + (knots[-1] - knots[0]) * step / len(starts)
        while at < len(knots) - 2 and knots[at + 1] <= x:
            at += 1
        starts[step] = at
    return starts


@part
def interval(knots: FloatArray, starts: IntArray, x: float) -> tuple[int, int, float]:
    """The knot at or before x, the next one, and the position of x between them, 0 … 1, constant beyond the ends.

    starts : the ``directory`` of the knots.
    """
    last = len(knots) - 1
    if last == 0 or x <= knots[0]:
        return 0, min(1, last), 0.0
    if x >= knots[last]:
        return last - 1, last, 1.0
    low = starts[int((x - knots[0]) / (knots[last] - knots[0]) * len(starts))]
    while knots[low + 1] <= x:
        low += 1
    return low, low + 1, (x - knots[low]) / (knots[low + 1] - knots[low])


@small
def climb(
    magnitude: FloatArray, log_odds: FloatArray, p_detected: FloatArray, knots: FloatArray, penalty: FloatArray,
    values: FloatArray, steps: int, longest: float, tolerance: float,
) -> None:  # fmt: skip
    """Newton steps towards the maximum of the penalised likelihood of ``values`` (k,) at ``knots``, in place.

    magnitude, log_odds, p_detected : (n,) of the records: magnitudes, log odds without the curve, and probabilities of
    being detected. penalty : (k, k). A step is limited to ``longest`` for each value; the iteration has converged when
    no value changes by more than ``tolerance``.
    """
    n, k = len(magnitude), len(knots)
    low, along, starts = np.empty(n, np.int64), np.empty(n), directory(knots)
    for e in range(n):
        low[e], _, along[e] = interval(knots, starts, magnitude[e])
    for _ in range(steps):
        gram, step = penalty.copy(), np.zeros((k, 1))
        for a in range(k):
            for b in range(k):
                step[a, 0] -= penalty[a, b] * values[b]
        for e in range(n):
            a, t = low[e], along[e]
            b = min(a + 1, k - 1)
            against = -(log_odds[e] + values[a] + t * (values[b] - values[a]))
            expected = 1.0 / (1.0 + math.exp(min(against, MAX_EXPONENT)))
            missing, weight = p_detected[e] - expected, expected * (1.0 - expected)
            step[a, 0] += missing * (1.0 - t)
            gram[a, a] += weight * ((1.0 - t) * (1.0 - t))
            if b > a:
                step[b, 0] += missing * t
                gram[b, b] += weight * (t * t)
                gram[a, b] += weight * t * (1.0 - t)
                gram[b, a] += weight * t * (1.0 - t)
        solve(gram, step)
        furthest = 0.0
        for a in range(k):
            values[a] += min(max(step[a, 0], -longest), longest)
            furthest = max(furthest, abs(step[a, 0]))
        if furthest <= tolerance:
            break


@small
def weigh(
    magnitude: FloatArray, share: FloatArray, wanted: AnyIntArray, least: float, knots: FloatArray, values: FloatArray,
    out: FloatArray,
) -> None:  # fmt: skip
    """Write to ``out`` (n,), for the records ``wanted``, the change of ½ ln s − ln (1 − s) if shares s (n,) follow the
    curve: ½ [v + ln (1 − s + s eᵛ)] for its value v; 0 for a NaN magnitude.

    Shares are limited to ``least`` … 1 − ``least``.
    """
    starts = directory(knots)
    for e in wanted:
        out[e] = 0.0
        if not np.isnan(magnitude[e]):
            low, high, along = interval(knots, starts, magnitude[e])
            s, v = min(max(share[e], least), 1.0 - least), values[low] + along * (values[high] - values[low])
            out[e] = 0.5 * (v + math.log(1.0 + s * (math.exp(min(v, MAX_EXPONENT)) - 1.0)))


@small
def log_mixture(
    y: FloatArray, variance: FloatArray, others: FloatArray, other_variance: FloatArray, knots: FloatArray,
    relation: tuple[FloatArray, ...], background: FloatArray, out: FloatArray,
) -> None:  # fmt: skip
    """Write to ``out`` (n,) ln of the density of magnitudes y (n,), given others (n, 1 + c) and the variances of both.

    knots : (k,) ascending, of the first of the others. relation : offset and scatter (k,), slopes and centres (c,),
    scales (s,), each three times the previous one, and shares (s + 1,), the last of the density ``background`` (n,).
    """
    offset, scatter, slopes, centres, scales, shares = relation
    peaks, widest = shares[:-1] / (scales * np.sqrt(2.0 * np.pi)), 1.0 / (scales[-1] * scales[-1])
    rest, starts = _square(1.0 - summed(slopes)), directory(knots)
    for e in range(len(y)):
        x = others[e, 0]
        low, high, along = interval(knots, starts, x)
        residual = y[e] - x - (offset[low] + along * (offset[high] - offset[low]))
        # The errors of the other magnitudes propagate with their coefficients in the mean.
        total = (
            _square(scatter[low] + along * (scatter[high] - scatter[low])) + variance[e] + rest * other_variance[e, 0]
        )
        for v in range(len(slopes)):
            residual -= slopes[v] * (others[e, v + 1] - x - centres[v])
            total += _square(slopes[v]) * other_variance[e, v + 1]
        precision, related = 1.0 / total, 0.0
        height = math.exp(-0.5 * (residual * residual) * precision * widest)
        for s in range(len(scales) - 1, -1, -1):
            related += peaks[s] * height
            height = _ninth(height)
        density = related * math.sqrt(precision) + shares[-1] * background[e]
        out[e] = -np.inf if density == 0.0 else math.log(density)


@part
def _square(x: float) -> float:
    return x * x


@part
def _ninth(x: float) -> float:
    """x⁹: exp(−r²/2σ²) for a third of σ, from its value x for σ."""
    square = x * x
    fourth = square * square
    return fourth * fourth * x


@small
def quartiles(order: IntArray, values: FloatArray, weight: FloatArray, nearest: IntArray, out: FloatArray) -> None:
    """Write to ``out`` (3, k + 1) the weighted quartiles of the values (n,) nearest to each of k knots, and of all.

    order : (n,) ascending order of the values. nearest : (n,) knots.
    """
    k = out.shape[1] - 1
    whole, below = np.zeros(k + 1), np.zeros(k + 1)
    out[:] = np.nan
    for e in order:
        whole[nearest[e]] += weight[e]
        whole[k] += weight[e]
    for e in order:
        for at in (nearest[e], k):
            below[at] += weight[e]
            for quarter in range(3):
                if np.isnan(out[quarter, at]) and below[at] >= 0.25 * (quarter + 1) * whole[at]:
                    out[quarter, at] = values[e]


@small
def gather(
    at: IntArray, weight: FloatArray, y: FloatArray, variance: FloatArray, others: FloatArray,
    other_variance: FloatArray, unrelated: FloatArray, assumed: FloatArray, sample: FloatArray, colours: FloatArray,
) -> None:  # fmt: skip
    """Write ``sample`` (n, 6) and ``colours`` (n, 2c), without subtracting centres, as :func:`learn` takes them, from
    the rows ``at`` (n,) of the others (r, ·), whose pairs have the probabilities ``weight`` (n,).

    assumed : (r,) the density of the magnitude in a true pair with which these probabilities were computed.
    """
    c = others.shape[1] - 1
    for e in range(len(at)):
        r = at[e]
        x = others[r, 0]
        sample[e, 0], sample[e, 1], sample[e, 2] = y[r] - x, variance[r], other_variance[r, 0]
        sample[e, 3], sample[e, 4], sample[e, 5] = unrelated[r], x, assumed[r] * (1.0 - weight[e]) / weight[e]
        for v in range(c):
            colours[e, v], colours[e, c + v] = others[r, v + 1] - x, other_variance[r, v + 1]


@small
def learn(
    sample: FloatArray, colours: FloatArray, knots: FloatArray, relation: tuple[FloatArray, ...], penalty: FloatArray,
    priors: FloatArray, steps: int,
) -> None:  # fmt: skip
    """EM iterations of the relation, in place, until it has converged or for ``steps`` iterations.

    sample : (n, 6) difference of the magnitude and the first of the others, variances of both, density of the
    magnitude if unrelated, the first of the others, and the weight of the pair being false, on the scale of the
    magnitude's density if it is true. colours : (n, 2c) other magnitudes minus the first and their centres, then their
    variances.
    knots : (k,) ascending. relation : offset and scatter (k,), slopes (c,), scales (s,), each three times the previous
    one, shares (s + 1,), the last of unrelated magnitudes, covariance (k + c, k + c), mean basis (k + c,), and the
    error of the typical scatter (1,). penalty : (k + c, k + c). priors : allowances of the shares (s,), number of
    always unrelated pairs, number of pairs by which scatters are shrunk to that of all, least scatter, and the share
    of a standard error below which a change has converged.
    """
    offset, scatter, slopes, _, shares, covariance, mean, error = relation
    k, c = len(offset), len(slopes)
    share = summed(mean[:k])
    typical = np.sqrt(summed(mean[:k] * scatter**2) / share) if share > 0.0 else np.inf
    leverages, hats = np.empty((len(sample), 2)), (np.empty(len(sample), np.int64), np.empty(len(sample)))
    starts = directory(knots)
    for e in range(len(sample)):
        hats[0][e], _, hats[1][e] = interval(knots, starts, sample[e, 4])
    for _ in range(steps):
        system, right, owned, counts, excess, weight, wider = _summed(sample, colours, hats, relation, leverages)
        number = summed(owned[:k])
        inverse = np.eye(k + c)
        solve(system + penalty, inverse)
        solved = np.empty(k + c)
        for a in range(k + c):
            solved[a] = summed(inverse[a] * right)
        covariance[:] = inverse * wider
        mean[:] = owned / max(number, 1e-300)
        before, typical = typical, _scatters(scatter, error, hats, leverages, excess, mean[:k], number, k + c, priors)
        converged = abs(typical - before) <= priors[-1] * error[0]
        alone = shares[-1]
        _shares(shares, counts, weight, number, priors)
        converged &= abs(shares[-1] - alone) <= priors[-1] * np.sqrt(shares[-1] / max(weight, 1.0))
        for a in range(k + c):
            now = offset[a] if a < k else slopes[a - k]
            converged &= abs(solved[a] - now) <= priors[-1] * np.sqrt(covariance[a, a])
        offset[:], slopes[:] = solved[:k], solved[k:]
        if converged:
            break


@part
def _summed(
    sample: FloatArray,
    colours: FloatArray,
    hats: tuple[IntArray, FloatArray],
    relation: tuple[FloatArray, ...],
    leverages: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, float, float]:
    """Sums over the pairs for one iteration.

    Returns the normal equations (k + c, k + c) and (k + c,); Σ of related weight · basis (k + c,); counts of the
    mixture's normals (s,); (3, k) Σ of the squared residuals, of their part by the quoted errors, and of their
    information on the scatter, each · basis; the expected number of pairs; and the ratio of the residuals' scatter to
    the mixture's. Writes ``leverages`` (n, 2): each squared residual and its expected value, times its information on
    the scatter.
    """
    left, upper = hats
    offset, scatter, slopes, scales, shares = relation[:5]
    k, c, normals = len(offset), len(slopes), len(scales)
    gram, right, owned = np.zeros((k + c, k + c)), np.zeros(k + c), np.zeros(k + c)
    counts, excess, parts = np.zeros(normals), np.zeros((3, k)), np.empty(normals)
    true, squared, simple, rest = 0.0, 0.0, 0.0, _square(1.0 - summed(slopes))
    peaks, narrow = shares[:-1] / (scales * np.sqrt(2.0 * np.pi)), 1.0 / scales**2
    for e in range(len(sample)):
        low, along = left[e], upper[e]
        high = min(low + 1, k - 1)
        width = scatter[low] + along * (scatter[high] - scatter[low])
        total = width * width + sample[e, 1] + rest * sample[e, 2]
        residual = sample[e, 0] - (offset[low] + along * (offset[high] - offset[low]))
        for v in range(c):
            residual -= slopes[v] * colours[e, v]
            total += _square(slopes[v]) * colours[e, c + v]
        inverse, unrelated, density = 1.0 / total, shares[-1] * sample[e, 3], 0.0
        root, height = np.sqrt(inverse), math.exp(-0.5 * (residual * residual) * inverse * narrow[-1])
        for s in range(normals - 1, -1, -1):
            parts[s] = root * peaks[s] * height
            density += parts[s]
            height = _ninth(height)
        each = 1.0 / max(density + unrelated + sample[e, 5], 1e-300)
        own, precise = density * each, 0.0
        true += own + unrelated * each
        for s in range(normals):
            counts[s] += parts[s] * each
            precise += parts[s] * each * narrow[s]
        precision, leverage = precise * inverse, inverse * inverse
        squared += (precision * precision) * (residual * residual)
        simple += precision
        leverages[e, 0], leverages[e, 1] = leverage * precise * (residual * residual), own * inverse
        for at, basis in ((low, 1.0 - along), (high, along)):
            right[at] += precision * basis * sample[e, 0]
            owned[at] += own * basis
            excess[0, at] += leverages[e, 0] * basis
            excess[1, at] += leverage * own * (total - width * width) * basis
            excess[2, at] += leverage * own * basis
            for v in range(c):
                gram[at, k + v] += precision * basis * colours[e, v]
        gram[low, low] += precision * ((1.0 - along) * (1.0 - along))
        gram[high, high] += precision * (along * along)
        if high != low:
            gram[low, high] += precision * along * (1.0 - along)
        for v in range(c):
            right[k + v] += precision * sample[e, 0] * colours[e, v]
            owned[k + v] += own * colours[e, v]
            for w in range(v, c):
                gram[k + v, k + w] += precision * colours[e, v] * colours[e, w]
    for a in range(k + c):
        for b in range(a):
            gram[a, b] = gram[b, a]
    return gram, right, owned, counts, excess, true, squared / simple


@part
def _scatters(
    scatter: FloatArray, error: FloatArray, hats: tuple[IntArray, FloatArray], leverages: FloatArray,
    excess: FloatArray, share: FloatArray, number: float, fitted: int, priors: FloatArray,
) -> float:  # fmt: skip
    """Write the scatters (k,) beyond the quoted errors and the ``error`` of the typical one; returns the typical."""
    left, upper = hats
    shrinking, least = priors[-3], priors[-2]
    # One scoring step: the squares minus the quoted variances, weighted by their information on the scatter.
    larger = number / max(number - fitted, 1.0)
    beyond, weight = larger * excess[0] - excess[1], excess[2]
    overall, drawn = summed(beyond) / summed(weight), shrinking * weight / max(number, 1e-300)
    for a in range(len(scatter)):
        pooled = (beyond[a] + drawn[a] * overall) / (weight[a] + drawn[a]) if weight[a] > 0.0 else overall
        scatter[a] = np.sqrt(max(pooled, least * least))
    # The typical scatter weights the knots by their pairs; its error is that of the squares' scatter.
    by_knot = np.where(weight > 0.0, share / np.maximum(weight + drawn, 1e-300), 0.0)
    by_all = summed(by_knot * drawn) / summed(weight)
    typical = np.sqrt(max(summed(share * scatter**2), least * least))
    total = 0.0
    for e in range(len(leverages)):
        low = left[e]
        high = min(low + 1, len(scatter) - 1)
        factor = by_knot[low] + upper[e] * (by_knot[high] - by_knot[low]) + by_all
        total += _square((larger * leverages[e, 0] - leverages[e, 1]) * factor)
    error[0] = np.sqrt(total) / (2.0 * typical)
    return typical


@part
def _shares(shares: FloatArray, counts: FloatArray, weight: float, number: float, priors: FloatArray) -> None:
    """Write the shares of the mixture's normals and, last, of unrelated magnitudes."""
    total = weight - number + priors[-4]
    shares[-1] = total
    for s in range(len(counts)):
        shares[s] = max(counts[s] - priors[s] * np.sqrt(weight), 1e-3)
        total += shares[s]
    shares /= total

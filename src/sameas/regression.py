"""How one magnitude follows others, learned from pairs of which each is true with a stated probability.

Maximum likelihood by EM, with gentle priors: curves bend little, slopes are not steep, scatters of neighbouring knots
are alike, and few pairs say little. A share of the pairs may be unrelated; where the magnitudes are useless that
share tends to 1 and the relation says nothing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from sameas.evidence import MagnitudeDensity, Relation
from sameas.piecewise import Hats, knots_of
from sameas.records import FloatArray

#: Scales of the mixture, in units of error and scatter.
SCALES = np.array([1.0, 3.0, 10.0])
#: A tail must stand out: it starts from so many pairs less, in units of the square root of their number.
TAIL_ALLOWANCE = np.array([0.0, 0.3, 0.1])
#: Pairs that are always taken to be unrelated.
PSEUDO_UNRELATED = 0.5
FIRST_SHARES, FIRST_UNRELATED = np.array([0.8, 0.12, 0.03]), 0.05
#: Pairs per knot and most knots of a curve; how much, mag, it bends from knot to knot; slopes of colours.
PER_KNOT, MOST_KNOTS = 150.0, 12
BEND, STEEP = 0.3, 1.0
#: Pairs by which the scatter at a knot is drawn to that of all, and its least value, mag.
PSEUDO_PAIRS = 20.0
LEAST_SCATTER = 0.003
FIRST_STEPS, STEPS, LAST_STEPS = 8, 2, 20
#: Steps end when they change nothing by more than this share of its standard error.
SETTLED = 0.05
#: Values that are sorted whole for their median, and steps that more are counted in.
SORTED, STEPPED = 10_000, 4_096


def density_of(magnitude: FloatArray) -> MagnitudeDensity:
    """The density of all magnitudes (n,) of a source: smoothed by half of Silverman's width, a pseudo-record flat."""
    from scipy.ndimage import gaussian_filter1d

    n = len(magnitude)
    low, high = np.quantile(magnitude, [0.0, 1.0])
    quartiles = np.subtract(*np.quantile(magnitude, [0.75, 0.25])) / 1.35
    width = 0.5 * min(x for x in (float(magnitude.std()), quartiles, math.inf) if x > 0.0) * n**-0.2
    width = min(max(width, 0.01), 1.0) if math.isfinite(width) else 0.1
    step = max(width / 3.0, (high - low) / 4000.0)
    grid = np.arange(low - 6.0 * width, high + 6.0 * width + step, step)
    count = np.bincount(np.round((magnitude - grid[0]) / step).astype(np.int64), minlength=len(grid)).astype(np.float64)
    smooth = gaussian_filter1d(count, width / step, mode="constant")
    density = (smooth / step + 1.0 / (len(grid) * step)) / (n + 1.0)
    return MagnitudeDensity(grid, np.log(density))


@dataclass(frozen=True)
class Sample:
    """Pairs to learn from: y (n,), others (n, 1 + c), the variances of both, and the probability of each pair."""

    y: FloatArray
    others: FloatArray
    variance: FloatArray
    other_variance: FloatArray
    weight: FloatArray


def fit_relation(
    sample: Sample, background: MagnitudeDensity, start: Relation | None = None, *, last: bool = False
) -> Relation:
    """The relation of greatest likelihood; a few steps on from ``start`` where there is one, many for the last time."""
    relation = replace(start, background=background) if start is not None else _first(sample, background)
    hats, alone = Hats.at(relation.knots, sample.others[:, 0]), np.exp(background(sample.y))
    for _ in range(LAST_STEPS if last else STEPS if start is not None else FIRST_STEPS):
        before, relation = relation, _improved(sample, relation, hats, alone)
        if _settled(before, relation):
            break
    return relation


def _settled(before: Relation, after: Relation) -> bool:
    """Whether a step has changed a relation by much less than its standard errors."""
    was, now = (np.concatenate([r.offset, r.slopes]) for r in (before, after))
    allowed = SETTLED * np.sqrt(np.diag(after.covariance))
    scatters = abs(after.typical_scatter - before.typical_scatter) <= SETTLED * after.scatter_error
    alone = SETTLED * math.sqrt(after.unrelated / max(after.weight, 1.0))
    return bool(scatters and np.all(np.abs(now - was) <= allowed) and abs(after.unrelated - before.unrelated) <= alone)


def _first(sample: Sample, background: MagnitudeDensity) -> Relation:
    """Medians and spreads around every knot, no slopes: what a few outliers and chance pairs cannot spoil."""
    x = sample.others[:, 0]
    knots = knots_of(x, sample.weight, PER_KNOT, MOST_KNOTS)
    colours = sample.others[:, 1:] - x[:, None]
    centres = (sample.weight[:, None] * colours).sum(axis=0) / sample.weight.sum()
    difference = sample.y - x
    nearest = np.searchsorted(0.5 * (knots[1:] + knots[:-1]), x)
    middle = weighted_median(difference, sample.weight)
    spread = 1.4826 * weighted_median(np.abs(difference - middle), sample.weight)
    offset, scatter = np.full(len(knots), middle), np.full(len(knots), spread)
    for k in range(len(knots)):
        these = nearest == k
        if sample.weight[these].sum() > PSEUDO_PAIRS:
            offset[k] = weighted_median(difference[these], sample.weight[these])
            away = np.abs(difference[these] - offset[k])
            scatter[k] = 1.4826 * weighted_median(away, sample.weight[these])
    size = len(knots) + colours.shape[1]
    nothing = np.zeros((size, size)), np.zeros(size), math.inf, float(sample.weight.sum())
    slopes, scatter = np.zeros(colours.shape[1]), np.maximum(scatter, LEAST_SCATTER)
    return Relation(
        knots, offset, scatter, slopes, centres, SCALES, FIRST_SHARES, FIRST_UNRELATED, background, *nothing
    )


def _improved(sample: Sample, relation: Relation, hats: Hats, density_alone: FloatArray) -> Relation:
    """One step of EM; ``hats`` at the first of the others, and (n,) the density of y by the background."""
    curves = hats.curve(relation.offset), hats.curve(relation.scatter)
    residual, total = relation.residual(sample.y, sample.others, sample.variance, sample.other_variance, curves)
    scales, weight = relation.scales, sample.weight
    # Not in terms of matrices: these are long and thin, and libraries would start threads for them.
    half, peak = -0.5 * residual**2 / total, 1.0 / np.sqrt(2.0 * np.pi * total)
    parts = [share / s * peak * np.exp(half / s**2) for s, share in zip(scales, relation.shares, strict=True)]
    unrelated = relation.unrelated * density_alone
    per_density = weight / np.maximum(sum(parts, unrelated), 1e-300)
    owned = weight - unrelated * per_density
    counts = np.array([(part * per_density).sum() for part in parts])
    shares = np.maximum(counts - TAIL_ALLOWANCE * math.sqrt(float(weight.sum())), 1e-3)
    alone = float((weight - owned).sum()) + PSEUDO_UNRELATED
    shares, alone = shares / (shares.sum() + alone), alone / (shares.sum() + alone)
    precise = per_density * sum(part / s**2 for s, part in zip(scales, parts, strict=True))
    solved, covariance, mean = _curve(sample, relation, hats, precise / total, owned)
    # What the residuals really scatter, where the mixture does not quite describe them.
    covariance *= float((precise**2 * residual**2 / total**2).sum() / (precise / total).sum())
    scatter, error = _scatter(relation, hats, residual, total, owned, precise)
    k = len(relation.knots)
    return replace(
        relation, offset=solved[:k], slopes=solved[k:], covariance=covariance, mean_basis=mean, scatter=scatter,
        scatter_error=error, shares=shares, unrelated=alone, weight=float(weight.sum()),
    )  # fmt: skip


def _curve(
    sample: Sample, relation: Relation, hats: Hats, precision: FloatArray, owned: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Offset and slopes by least squares with these precisions (n,), their covariance, and the mean of the basis."""
    x, k = sample.others[:, 0], len(hats.knots)
    colours = sample.others[:, 1:] - x[:, None] - relation.centres
    size = k + colours.shape[1]
    gram, right, mean = np.zeros((size, size)), np.zeros(size), np.zeros(size)
    gram[:k, :k] = hats.gram(precision)
    difference = precision * (sample.y - x)
    right[:k], mean[:k] = hats.sum(difference), hats.sum(owned)
    for c, colour in enumerate(colours.T):
        gram[:k, k + c] = gram[k + c, :k] = hats.sum(precision * colour)
        right[k + c], mean[k + c] = (difference * colour).sum(), (owned * colour).sum()
    gram[k:, k:] = np.einsum("nc,n,nd->cd", colours, precision, colours)
    penalty = np.zeros((size, size))
    penalty[:k, :k] = hats.roughness(BEND) + 1e-6 * np.eye(k)
    penalty[k:, k:] = np.eye(size - k) / STEEP**2
    covariance = np.linalg.inv(gram + penalty)
    return covariance @ right, covariance, mean / max(float(owned.sum()), 1e-300)


def _scatter(
    relation: Relation, hats: Hats, residual: FloatArray, total: FloatArray, owned: FloatArray, precise: FloatArray
) -> tuple[FloatArray, float]:
    """Scatter at the knots beyond the quoted errors, and the standard error of the typical one."""
    # One step of scoring: what r² leaves beyond the present variance, each pair weighed by what it can tell of it.
    old = hats.curve(relation.scatter) ** 2
    leverage = 1.0 / total**2
    number, fitted = float(owned.sum()), len(relation.offset) + len(relation.slopes)
    square = residual**2 * (number / max(number - fitted, 1.0))
    excess = leverage * (precise * square - owned * (total - old))  # its mean, over owned, is the scatter²
    told, weight = hats.sum(excess), hats.sum(leverage * owned)
    overall, drawn = told.sum() / weight.sum(), PSEUDO_PAIRS * weight.sum() / max(number, 1e-300)
    scatter = np.sqrt(np.maximum((told + drawn * overall) / (weight + drawn), LEAST_SCATTER**2))
    # The typical scatter weighs the knots by their pairs; its error comes from how the excesses scatter.
    share = hats.sum(owned) / max(number, 1e-300)
    by_knot, by_all = share / (weight + drawn), float((share * drawn / (weight + drawn)).sum() / weight.sum())
    spread = (excess - leverage * owned * old) * (hats.curve(by_knot) + by_all)
    typical = math.sqrt(max(float((share * scatter**2).sum()), LEAST_SCATTER**2))
    error = math.sqrt(float((spread**2).sum())) / (2.0 * typical)
    return scatter, error


def weighted_median(values: FloatArray, weights: FloatArray) -> float:
    """The value that half of the weight lies below."""
    half = 0.5 * float(weights.sum())
    if len(values) > SORTED:
        # A long list is not sorted whole: only the step of the values in which the half is reached.
        low, high = float(values.min()), float(values.max())
        step = ((values - low) * ((STEPPED - 1) / max(high - low, 1e-300))).astype(np.int64)
        below = np.cumsum(np.bincount(step, weights, STEPPED))
        at = int(np.searchsorted(below, half))
        half -= float(below[at - 1]) if at else 0.0
        values, weights = values[step == at], weights[step == at]
    order = np.argsort(values, kind="stable")
    cumulated = np.cumsum(weights[order])
    return float(values[order][min(int(np.searchsorted(cumulated, half)), len(values) - 1)])

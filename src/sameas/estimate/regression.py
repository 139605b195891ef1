"""How one magnitude follows others, learned from pairs of which each is true with a stated probability.

Maximum likelihood by EM, with gentle priors: curves bend little, slopes are not steep, scatters of neighbouring knots
are alike, and few pairs say little. A share of the pairs may be unrelated; where the magnitudes are useless that
share tends to 1 and the relation says nothing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from sameas.arrays import FloatArray
from sameas.evidence import MagnitudeDensity, Relation
from sameas.evidence.detection import knots_of, roughness
from sameas.representation import in_short

#: Scales of the mixture, in units of error and scatter; the kernels rely on their ratio.
SCALES = np.array([1.0, 3.0, 9.0])
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
#: Steps end when they change nothing by more than this share of its standard error; the first, before pairs were
#: weighed by their magnitudes, need not be nearer than that error.
SETTLED, FIRST_SETTLED = 0.05, 1.0
#: The quartiles of a normal are so many standard deviations apart.
QUARTILES_APART = 1.349
#: Values that are sorted whole for their median, and steps that more are counted in.
SORTED, STEPPED = 10_000, 4_096


def density_of(magnitude: FloatArray) -> MagnitudeDensity:
    """The density of all magnitudes (n,) of a source: smoothed by half of Silverman's width, a pseudo-record flat."""
    n, low, high = len(magnitude), float(magnitude.min()), float(magnitude.max())
    lower, upper = np.partition(magnitude, (n // 4, 3 * n // 4))[[n // 4, 3 * n // 4]]
    quartiles = (upper - lower) / QUARTILES_APART
    width = 0.5 * min(x for x in (float(magnitude.std()), quartiles, math.inf) if x > 0.0) * n**-0.2
    width = min(max(width, 0.01), 1.0) if math.isfinite(width) else 0.1
    step = max(width / 3.0, (high - low) / 4000.0)
    grid = np.arange(low - 6.0 * width, high + 6.0 * width + step, step)
    count = np.bincount(np.round((magnitude - grid[0]) / step).astype(np.int64), minlength=len(grid)).astype(np.float64)
    reach = int(4.0 * width / step + 0.5)
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) * step / width) ** 2)
    smooth = np.convolve(count, kernel / kernel.sum(), mode="same")
    density = (smooth / step + 1.0 / (len(grid) * step)) / (n + 1.0)
    return MagnitudeDensity(grid, np.log(density))


@in_short
@dataclass(frozen=True)
class Sample:
    """Pairs to learn from. Make it with :meth:`Sample.of`.

    pairs : (n, 7) difference of the magnitude and the first of the others, variances of both, the pair's weight, the
    density of the magnitude where it is unrelated, the first of the others, and that density times the odds that the
    pair is none. colours : (n, 2c) the other magnitudes minus the first of them, then their variances.
    weight : (n,) the probability of each pair.
    """

    pairs: FloatArray
    colours: FloatArray
    weight: FloatArray

    @classmethod
    def of(
        cls,
        y: FloatArray,
        others: FloatArray,
        variance: FloatArray,
        other_variance: FloatArray,
        unrelated: FloatArray,
        weight: FloatArray,
        *,
        weighed: bool = True,
    ) -> Sample:
        """Of magnitudes y (n,), others (n, 1 + c), the variances of both, the density of y where it is unrelated, and
        the probability of each pair; those of probability zero are left out.

        weighed : whether the probabilities know of the magnitudes. Where they do not, a pair whose magnitudes do not
            fit is less probable than that, and it does not count as one that is unrelated.
        """
        from sameas.kernels.relation import gather

        at = np.flatnonzero(weight)
        weight = weight[at]
        pairs, colours = np.empty((len(at), 7)), np.empty((len(at), 2 * others.shape[1] - 2))
        gather(at, weight, y, variance, others, other_variance, unrelated, weighed, pairs, colours)
        return cls(pairs, colours, weight)


def fit_relation(
    sample: Sample, background: MagnitudeDensity, start: Relation | None = None, *, last: bool = False
) -> Relation:
    """The relation of greatest likelihood; a few steps on from ``start`` where there is one, many for the last time."""
    if start is None:
        return _improved(sample, _first(sample, background), FIRST_STEPS, FIRST_SETTLED)
    return _improved(sample, replace(start, background=background), LAST_STEPS if last else STEPS, SETTLED)


def _first(sample: Sample, background: MagnitudeDensity) -> Relation:
    """Medians and spreads around every knot, no slopes: what a few outliers and chance pairs cannot spoil."""
    from sameas.kernels.relation import quartiles

    difference, x, c = sample.pairs[:, 0], sample.pairs[:, 5], sample.colours.shape[1] // 2
    knots = knots_of(x, sample.weight, PER_KNOT, MOST_KNOTS)
    centres = sample.weight @ sample.colours[:, :c] / sample.weight.sum()
    nearest = np.searchsorted(0.5 * (knots[1:] + knots[:-1]), x)
    k = len(knots)
    found = np.empty((3, k + 1))
    quartiles(np.argsort(difference, kind="stable"), difference, sample.weight, nearest, found)
    enough = np.bincount(nearest, sample.weight, k) > PSEUDO_PAIRS
    lower, offset, upper = np.where(enough, found[:, :k], found[:, k:])
    scatter = np.maximum((upper - lower) / QUARTILES_APART, LEAST_SCATTER)
    nothing = np.zeros((k + c, k + c)), np.zeros(k + c), math.inf, float(sample.weight.sum())
    return Relation(
        knots, offset, scatter, np.zeros(c), centres, SCALES, FIRST_SHARES, FIRST_UNRELATED, background, *nothing
    )


def _improved(sample: Sample, relation: Relation, steps: int, settled: float) -> Relation:
    """After at most so many steps of EM, until they change nothing by more than this share of its standard error."""
    from sameas.kernels.relation import learn

    colours, c = sample.colours.copy(), len(relation.centres)
    colours[:, :c] -= relation.centres
    offset, scatter, slopes = relation.offset.copy(), relation.scatter.copy(), relation.slopes.copy()
    shares, error = np.append(relation.shares, relation.unrelated), np.array([relation.scatter_error])
    covariance, mean = relation.covariance.copy(), relation.mean_basis.copy()
    learned = offset, scatter, slopes, relation.scales, shares, covariance, mean, error
    priors = np.array([*TAIL_ALLOWANCE, PSEUDO_UNRELATED, PSEUDO_PAIRS, LEAST_SCATTER, settled])
    learn(sample.pairs, colours, relation.knots, learned, _penalty(len(offset), len(slopes)), priors, steps)
    return replace(
        relation, offset=offset, slopes=slopes, covariance=covariance, mean_basis=mean, scatter=scatter,
        scatter_error=float(error[0]), shares=shares[:-1], unrelated=float(shares[-1]),
        weight=float(sample.weight.sum()),
    )  # fmt: skip


@cache
def _penalty(k: int, slopes: int) -> FloatArray:
    """(k + c, k + c) how curves and slopes are drawn to straight and flat ones."""
    penalty = np.zeros((k + slopes, k + slopes))
    penalty[:k, :k] = roughness(k, BEND) + 1e-6 * np.eye(k)
    penalty[k:, k:] = np.eye(slopes) / STEEP**2
    return penalty


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

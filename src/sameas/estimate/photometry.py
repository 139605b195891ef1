"""What two sources' magnitudes have to do with each other, learned along with the identification.

:class:`Photometry` is what a round of estimation knows: relations between the bands of both sources, and curves of
the shares of common objects. It becomes a rule (``evidence.Brightness``) for the next round and is reported in the end.

:func:`fit_relation` learns how one magnitude follows others, from pairs of which each is true with a stated
probability: maximum likelihood by EM, with gentle priors: curves bend little, slopes are not steep, scatters of
neighbouring knots are alike, and few pairs say little. A share of the pairs may be unrelated; where the magnitudes are
useless that share tends to 1 and the relation says nothing.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cache, partial

import numpy as np

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.estimate.coverage import Coverage
from sameas.evidence import (
    Brightness,
    Chain,
    Comparison,
    Comparisons,
    MagnitudeDensity,
    MeasuredMagnitudes,
    PartnerTilt,
    Pattern,
    Regressors,
    Relation,
    SourceMagnitudes,
    comparisons_of,
)
from sameas.evidence.detection import DetectionCurve, ShareCurve, knots_of, roughness
from sameas.gate import Pairs
from sameas.representation import in_short
from sameas.result import Identification

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


#: Expected pairs of a pattern of measured bands, and records of a source, from which anything is learned at all.
FEWEST = 50.0
#: Pairs that a relation is learned from, at most, in the end and in rounds: more would not better it noticeably.
ENOUGH, ENOUGH_IN_ROUNDS = 10_000, 1_000
#: Records that a curve of the shares is learned from, in the end and in rounds, and how the bands of a source follow
#: each other.
CURVED, CURVED_IN_ROUNDS, ALONE = 2_000, 1_000, 1_000
#: The golden ratio of 2³²: multiples of it are strewn evenly.
SCATTERING = 2_654_435_769

#: The pairs and their probabilities (m,), those of having a partner (n₁,), (n₂,), the shares at the records' positions
#: (n₁,), (n₂,), and whether each is covered.
LearningPairs = tuple[
    Pairs,
    FloatArray,
    tuple[FloatArray, FloatArray],
    tuple[FloatArray, FloatArray],
    tuple[BoolArray, BoolArray],
]


@in_short
@dataclass(frozen=True)
class Photometry:
    """The magnitudes of two sources, and what has been learned of them.

    sides : the magnitudes of either source. names : of their bands.
    chains : p(m₁ | m₂) and p(m₂ | m₁); None as long as nothing was learned. curves : of the shares, per source.
    known : the magnitudes of the candidates side by side.
    """

    sides: tuple[SourceMagnitudes, SourceMagnitudes] = field(repr=False)
    names: tuple[tuple[str, ...], tuple[str, ...]]
    chains: tuple[Chain, Chain] | None = None
    curves: tuple[ShareCurve | None, ShareCurve | None] = (None, None)
    known: tuple[Pairs, tuple[Comparisons, Comparisons]] | None = field(repr=False, default=None)

    @classmethod
    def of(
        cls, measured: tuple[MeasuredMagnitudes, MeasuredMagnitudes], names: tuple[tuple[str, ...], tuple[str, ...]]
    ) -> Photometry:
        """Nothing learned yet."""
        return cls((_side(measured[0]), _side(measured[1])), names)

    def part(self, rows_1: IntArray, rows_2: IntArray) -> Photometry:
        """The magnitudes of some of the records only."""
        one, two = (
            replace(side, measured=side.measured.take(rows))
            for side, rows in zip(self.sides, (rows_1, rows_2), strict=True)
        )
        return replace(self, sides=(one, two), known=None)

    def facing(self, pairs: Pairs) -> Photometry:
        """The same, with the magnitudes of these pairs side by side: they are asked for round after round."""
        there = self.known is not None and self.known[0] is pairs
        return self if there else replace(self, known=(pairs, comparisons_of(self.sides, pairs)))

    def learned(
        self,
        pairs: Pairs,
        p_pair: FloatArray,
        p_partner: tuple[FloatArray, FloatArray],
        shares: tuple[FloatArray, FloatArray],
        covered: tuple[BoolArray, BoolArray],
        *,
        last: bool = False,
    ) -> Photometry:
        """After a round: probabilities of pairs (m,) and of having a partner (n₁,), (n₂,), shares at the positions.

        Rounds learn from some pairs in a few steps; the ``last`` words, with their standard errors, are from many.
        """
        enough = CURVED if last else CURVED_IN_ROUNDS
        one, two = map(partial(_curve, enough), self.sides, p_partner, shares, covered, self.curves)
        curves = one, two
        telling = np.zeros(len(p_pair), np.bool_)
        telling[_some(np.flatnonzero(p_pair > 1e-3), ENOUGH if last else ENOUGH_IN_ROUNDS)] = True
        there = self.known is not None and self.known[0] is pairs
        sides = self.known[1] if there and self.known else comparisons_of(self.sides, pairs)
        before = self.chains or (None, None)
        tilts = [
            PartnerTilt.of(curve, side.measured.values[:, 0], float(p[seen].mean()) if seen.any() else 0.0)
            for curve, side, p, seen in zip(curves, self.sides, p_partner, covered, strict=True)
        ]
        forth, back = (
            _chain(side, these.tilted(tilt), np.where(telling, p_pair, 0.0), start, tilt, last=last)
            for side, these, start, tilt in zip(self.sides, sides, before, tilts, strict=True)
        )
        chains = (forth, back) if any(forth.related) and any(back.related) else None
        return replace(self, chains=chains, curves=curves)

    @property
    def share_missing(self) -> float:
        """Share of the records without a magnitude in the first band, of the source with more of them."""
        return max(float(np.isnan(side.measured.values[:, 0]).mean()) for side in self.sides)

    @property
    def telling(self) -> bool:
        """Whether the first bands of most pairs are related: far closer to each other than those of any two records."""
        relation, magnitude = self.first_relation, self.sides[0].measured.values[:, 0]
        if relation is None or relation.unrelated > 0.5:
            return False
        return relation.typical_scatter < 0.5 * float(np.nanstd(magnitude))

    def quoted_and_spread(self, pairs: Pairs, p_pair: FloatArray) -> tuple[float, float]:
        """The median error, mag, that pairs (m,) of these probabilities quote of both first bands together, and the
        least spread of a first band among them: half of what lies between the 16th and the 84th percent."""
        probable = p_pair > 0.5
        rows, sides = (pairs.i[probable], pairs.j[probable]), [side.measured for side in self.sides]
        variance = sum(side.variance[at, 0] for side, at in zip(sides, rows, strict=True))
        ends = (np.nanpercentile(side.values[at, 0], [16.0, 84.0]) for side, at in zip(sides, rows, strict=True))
        spread = min(0.5 * float(high - low) for low, high in ends)
        return math.sqrt(float(np.nanmedian(variance))), spread

    @property
    def tells(self) -> bool:
        """Whether anything has been learned."""
        return self.chains is not None or self.curves != (None, None)

    @property
    def first_relation(self) -> Relation | None:
        """How the first band of source 1 follows all bands of source 2 that most pairs have; None where unknown."""
        known = self.chains[0].related[0] if self.chains else {}
        whole = {pattern: relation for pattern, relation in known.items() if pattern[0]}
        return max(whole.values(), key=lambda relation: relation.weight, default=None)

    def rule(self, shares: tuple[FloatArray, FloatArray], pairs: Pairs | None = None) -> Brightness | None:
        """As evidence, with the shares at the records' positions; None as long as nothing was learned.

        pairs : those that it will be asked of, if no others.
        """
        if not self.tells:
            return None
        rows = (None, None) if pairs is None else (pairs.i, pairs.j)
        completeness = [
            np.zeros(len(share)) if curve is None else curve.terms(side.measured.values[:, 0], share, wanted)
            for side, share, curve, wanted in zip(self.sides, shares, self.curves, rows, strict=True)
        ]
        return Brightness(self.sides, self.chains, completeness[0], completeness[1], self.known)

    def logits(self) -> tuple[FloatArray, FloatArray]:
        """(n₁,), (n₂,) what the magnitude of each record adds to the logit of its share; 0 where it has none."""
        one, two = (
            np.zeros(len(side.measured.values)) if curve is None else curve.logit(side.measured.values[:, 0])
            for side, curve in zip(self.sides, self.curves, strict=True)
        )
        return one, two

    def detection(
        self, answer: Identification, coverage: Coverage
    ) -> tuple[DetectionCurve | None, DetectionCurve | None]:
        """The share of either source's covered records that the other shows, by magnitude in the first band."""
        volume, at, curves = coverage.common_volume, (answer.pairs.i, answer.pairs.j), []
        for side, rows, names, seen in zip(self.sides, at, self.names, coverage.covered, strict=True):
            magnitude = side.measured.values[:, 0]
            partner = np.minimum(np.bincount(rows, answer.p_pair, len(magnitude)), 1.0)
            these = np.isfinite(magnitude) & seen
            enough = np.count_nonzero(these) >= FEWEST
            curves.append(DetectionCurve.of(names[0], magnitude[these], partner[these], volume) if enough else None)
        return curves[0], curves[1]


def _some(telling: IntArray, enough: int) -> IntArray:
    """Half of enough pairs or more, strewn over all, and from round to round the same as far as these still tell."""
    if len(telling) <= enough:
        return telling
    halvings = math.ceil(math.log2(len(telling) / enough))
    strewn = (telling.astype(np.uint64) * np.uint64(SCATTERING)) & np.uint64(2**32 - 1)
    return telling[strewn < np.uint64(2 ** (32 - halvings))]


def _chain(
    side: SourceMagnitudes,
    these: Comparisons,
    weight: FloatArray,
    before: Chain | None,
    tilt: PartnerTilt | None,
    *,
    last: bool,
) -> Chain:
    """How the bands of one source follow those of the other, in pairs of these weights (m,).

    Those of the first time, without a chain ``before``, are by positions alone.
    """
    related: list[Mapping[Pattern, Relation]] = []
    for band, (density, comparisons) in enumerate(zip(side.densities, these.bands, strict=True)):
        start = before.related[band] if before else {}
        found = {
            x.regressors.pattern: _relation(
                x, weight, density, start.get(x.regressors.pattern), last=last, weighed=before is not None
            )
            for x in comparisons
        }
        related.append({pattern: relation for pattern, relation in found.items() if relation is not None})
    return Chain(tuple(related), tilt)


def _side(measured: MeasuredMagnitudes) -> SourceMagnitudes:
    """The densities of a source's bands, and how they follow each other in its records."""
    densities = tuple(map(_density, measured.values.T))
    some = measured.take(np.arange(0, len(measured.values), max(1, -(-len(measured.values) // ALONE))))
    alone: list[Mapping[Pattern, Relation]] = []
    for band, density in enumerate(densities):
        these = Regressors.split(band, some, None) if band and density is not None else ()
        weight = np.ones(len(some.values))
        seen = [Comparison(x, np.exp(density(x.y)), np.empty(0)) for x in these if density is not None]
        alone.append({x.regressors.pattern: r for x in seen if (r := _relation(x, weight, density, None))})
    return SourceMagnitudes(measured, densities, tuple(alone))


def _density(magnitude: FloatArray) -> MagnitudeDensity | None:
    known = magnitude[np.isfinite(magnitude)]
    return density_of(known) if len(known) >= FEWEST else None


def _relation(
    these: Comparison,
    weight: FloatArray,
    density: MagnitudeDensity | None,
    start: Relation | None,
    *,
    last: bool = False,
    weighed: bool = True,
) -> Relation | None:
    x = these.regressors
    weight = weight[x.rows]
    if density is None or weight.sum() < FEWEST:
        return None
    sample = Sample.of(x.y, x.others, x.variance, x.other_variance, these.background, weight, weighed=weighed)
    return fit_relation(sample, density, start, last=last)


def _curve(
    enough: int,
    side: SourceMagnitudes,
    p_partner: FloatArray,
    share: FloatArray,
    covered: BoolArray,
    before: ShareCurve | None,
) -> ShareCurve | None:
    magnitude = side.measured.values[:, 0]
    these = np.flatnonzero(np.isfinite(magnitude) & covered)
    these = these[:: max(1, -(-len(these) // enough))]
    if len(these) < FEWEST:
        return None
    return ShareCurve.fit(magnitude[these], share[these], p_partner[these], before)

"""Relations between the magnitudes of two sources, estimated together with the identification.

:class:`Photometry` holds the estimates of an EM iteration: relations between the bands of both sources, and curves of
the shares of common objects. It becomes a rule (``evidence.Brightness``) for the next iteration and is reported.

:func:`fit_relation` fits how one magnitude depends on others, from pairs each of which is true with a given
probability: maximum likelihood by EM, with weak priors for straight curves, flat slopes and equal scatter at
neighbouring knots, which dominate if pairs are few. A share of the pairs may be unrelated; with uninformative
magnitudes that share tends to 1 and the relation has no effect.
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

PSEUDO_UNRELATED = 0.5  # pairs that are always counted as unrelated
#: Pairs per knot and greatest number of knots of a curve; prior standard deviations of its second differences, mag, and
#: of slopes of colours.
PER_KNOT, MAX_KNOTS, BEND_SIGMA, SLOPE_SIGMA = 150.0, 12, 0.3, 1.0
#: Pseudo-pairs that draw the scatter at a knot to the mean scatter; least scatter, mag.
PSEUDO_PAIRS, MIN_SCATTER = 20.0, 0.003
FIRST_STEPS, STEPS, LAST_STEPS = 8, 2, 20  # EM steps of the first fit, of later ones, and of the last one
#: EM ends when no estimate changes by more than this share of its standard error; the first fit, whose pairs have
#: probabilities without magnitudes, may end earlier.
TOLERANCE, FIRST_TOLERANCE = 0.05, 1.0
MIN_PAIRS = 50.0  # expected pairs with a pattern of measured bands, or records of a source, for any fit
#: Greatest number of pairs for a relation, in the last fit and in EM iterations. A tenth of them suffices for the
#: relation, but the unrelated share decides between a wrong pair and an unrelated one.
MAX_PAIRS, MAX_PAIRS_IN_EM = 100_000, 10_000
#: Records for a curve of the shares, in the last fit and in EM iterations, and for relations between bands of a source.
CURVE_RECORDS, CURVE_RECORDS_IN_EM, OWN_BAND_RECORDS = 2_000, 1_000, 1_000
#: The records for a curve are those of a share of one half; with other shares more have the same information, up to
#: this factor.
MAX_CURVE_FACTOR = 50.0


#: Scales of the mixture, in units of error and scatter; the kernels rely on their ratio.
SCALES = np.array([1.0, 3.0, 9.0])
#: Initial tails are reduced by this many pairs, in units of the square root of their number, so that they must be
#: significant.
TAIL_ALLOWANCE = np.array([0.0, 0.3, 0.1])
INITIAL_SHARES, INITIAL_UNRELATED = np.array([0.8, 0.12, 0.03]), 0.05
#: Interquartile range of a normal, in standard deviations.
QUARTILE_RANGE = 1.349


def density_of(magnitude: FloatArray) -> MagnitudeDensity:
    """The density of all magnitudes (n,) of a source: smoothed by half of Silverman's width, plus a uniform record."""
    n, low, high = len(magnitude), float(magnitude.min()), float(magnitude.max())
    lower, upper = np.partition(magnitude, (n // 4, 3 * n // 4))[[n // 4, 3 * n // 4]]
    quartiles = (upper - lower) / QUARTILE_RANGE
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


@dataclass(frozen=True)
class Sample:
    """Pairs for a fit. Make it with :meth:`Sample.of`.

    pairs : (n, 6) difference of the magnitude and the first of the others, variances of both, the density of the
    magnitude if unrelated, the first of the others, and the weight of the pair being false, on the scale of the
    magnitude's density if it is true. colours : (n, 2c) the other magnitudes minus the first of them, then their
    variances.
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
        assumed: FloatArray,
    ) -> Sample:
        """From magnitudes y (n,), others (n, 1 + c), the variances of both, the density of y if unrelated, and the
        probability of each pair; pairs of probability zero are dropped.

        assumed : (n,) the density of y in a true pair with which the probabilities were computed: that of unrelated
            magnitudes if these are no evidence yet. With another relation the probabilities are others, and a pair
            whose magnitudes do not fit it is a false one rather than an unrelated one.
        """
        from sameas.kernels.relation import gather

        at = np.flatnonzero(weight)
        weight = weight[at]
        pairs, colours = np.empty((len(at), 6)), np.empty((len(at), 2 * others.shape[1] - 2))
        gather(at, weight, y, variance, others, other_variance, unrelated, assumed, pairs, colours)
        return cls(pairs, colours, weight)


def fit_relation(
    sample: Sample, background: MagnitudeDensity, start: Relation | None = None, *, last: bool = False
) -> Relation:
    """The relation of greatest likelihood; a few steps from ``start`` if given, many if ``last``."""
    if start is None:
        first = _initial_relation(sample, background)
        return _after_em(sample, first, FIRST_STEPS, FIRST_TOLERANCE)
    steps = LAST_STEPS if last else STEPS
    return _after_em(sample, replace(start, background=background), steps, TOLERANCE)


def _initial_relation(sample: Sample, background: MagnitudeDensity) -> Relation:
    """Medians and interquartile ranges at every knot, without slopes: robust against outliers and chance pairs."""
    from sameas.kernels.relation import quartiles

    difference, x, c = sample.pairs[:, 0], sample.pairs[:, 4], sample.colours.shape[1] // 2
    knots = knots_of(x, sample.weight, PER_KNOT, MAX_KNOTS)
    centres = sample.weight @ sample.colours[:, :c] / sample.weight.sum()
    nearest = np.searchsorted(0.5 * (knots[1:] + knots[:-1]), x)
    k = len(knots)
    by_knot = np.empty((3, k + 1))
    quartiles(np.argsort(difference, kind="stable"), difference, sample.weight, nearest, by_knot)
    enough = np.bincount(nearest, sample.weight, k) > PSEUDO_PAIRS
    lower, offset, upper = np.where(enough, by_knot[:, :k], by_knot[:, k:])
    scatter = np.maximum((upper - lower) / QUARTILE_RANGE, MIN_SCATTER)
    no_fit = np.zeros((k + c, k + c)), np.zeros(k + c), math.inf, float(sample.weight.sum())
    return Relation(
        knots, offset, scatter, np.zeros(c), centres, SCALES, INITIAL_SHARES, INITIAL_UNRELATED, background, *no_fit
    )


def _after_em(sample: Sample, relation: Relation, steps: int, tolerance: float) -> Relation:
    """After at most ``steps`` of EM, or when no estimate changes by more than ``tolerance`` of its standard error."""
    from sameas.kernels.relation import learn

    colours, c = sample.colours.copy(), len(relation.centres)
    colours[:, :c] -= relation.centres
    offset, scatter, slopes = relation.offset.copy(), relation.scatter.copy(), relation.slopes.copy()
    shares, error = np.append(relation.shares, relation.unrelated), np.array([relation.scatter_error])
    covariance, mean = relation.covariance.copy(), relation.mean_basis.copy()
    learned = offset, scatter, slopes, relation.scales, shares, covariance, mean, error
    priors = np.array([*TAIL_ALLOWANCE, PSEUDO_UNRELATED, PSEUDO_PAIRS, MIN_SCATTER, tolerance])
    learn(sample.pairs, colours, relation.knots, learned, _penalty(len(offset), len(slopes)), priors, steps)
    return replace(
        relation, offset=offset, slopes=slopes, covariance=covariance, mean_basis=mean, scatter=scatter,
        scatter_error=float(error[0]), shares=shares[:-1], unrelated=float(shares[-1]),
        weight=float(sample.weight.sum()),
    )  # fmt: skip


@cache
def _penalty(k: int, slopes: int) -> FloatArray:
    """(k + c, k + c) penalty that draws curves to straight lines and slopes to zero."""
    penalty = np.zeros((k + slopes, k + slopes))
    penalty[:k, :k] = roughness(k, BEND_SIGMA) + 1e-6 * np.eye(k)
    penalty[k:, k:] = np.eye(slopes) / SLOPE_SIGMA**2
    return penalty


#: 2³² over the golden ratio: its multiples are evenly distributed.
HASH_FACTOR = 2_654_435_769

#: Pairs and their probabilities (m,), probabilities of a partner (n₁,), (n₂,), shares at the records' positions (n₁,),
#: (n₂,), and whether records are covered.
LearningPairs = tuple[
    Pairs, FloatArray, tuple[FloatArray, FloatArray], tuple[FloatArray, FloatArray], tuple[BoolArray, BoolArray]
]


@in_short
@dataclass(frozen=True)
class Photometry:
    """The magnitudes of two sources, and their estimated relations.

    sides : the magnitudes of each source. names : of their bands.
    chains : p(m₁ | m₂) and p(m₂ | m₁); None before the first fit. curves : of the shares, per source.
    compared : cached comparisons of the magnitudes of the candidates.
    """

    sides: tuple[SourceMagnitudes, SourceMagnitudes] = field(repr=False)
    names: tuple[tuple[str, ...], tuple[str, ...]]
    chains: tuple[Chain, Chain] | None = None
    curves: tuple[ShareCurve | None, ShareCurve | None] = (None, None)
    compared: tuple[Pairs, tuple[Comparisons, Comparisons]] | None = field(repr=False, default=None)

    @classmethod
    def of(
        cls, measured: tuple[MeasuredMagnitudes, MeasuredMagnitudes], names: tuple[tuple[str, ...], tuple[str, ...]]
    ) -> Photometry:
        """Before any fit."""
        one, two = (_source_magnitudes(each) for each in measured)
        return cls((one, two), names)

    def part(self, rows_1: IntArray, rows_2: IntArray) -> Photometry:
        """The magnitudes of some records."""
        one, two = (
            replace(side, measured=side.measured.take(rows))
            for side, rows in zip(self.sides, (rows_1, rows_2), strict=True)
        )
        return replace(self, sides=(one, two), compared=None)

    def with_comparisons(self, pairs: Pairs) -> Photometry:
        """With the comparisons of these pairs cached, which all iterations need."""
        cached = self.compared is not None and self.compared[0] is pairs
        return self if cached else replace(self, compared=(pairs, comparisons_of(self.sides, pairs)))

    def fitted(
        self,
        pairs: Pairs,
        p_pair: FloatArray,
        p_partner: tuple[FloatArray, FloatArray],
        shares: tuple[FloatArray, FloatArray],
        covered: tuple[BoolArray, BoolArray],
        *,
        last: bool = False,
    ) -> Photometry:
        """The M-step: fits to probabilities of pairs (m,) and of a partner (n₁,), (n₂,), with shares at the positions.

        In EM iterations few steps are made, with a sample of the pairs; the ``last`` fit, with standard errors, uses
        more.
        """
        one, two = map(partial(_fit_curve, last), self.sides, p_partner, shares, covered, self.curves)
        curves = one, two
        used = np.zeros(len(p_pair), np.bool_)
        used[_sampled(np.flatnonzero(p_pair > 1e-3), MAX_PAIRS if last else MAX_PAIRS_IN_EM)] = True
        cached = self.compared is not None and self.compared[0] is pairs
        sides = self.compared[1] if cached and self.compared else comparisons_of(self.sides, pairs)
        previous = self.chains or (None, None)
        tilts = [
            PartnerTilt.of(curve, side.measured.values[:, 0], float(p[is_covered].mean()) if is_covered.any() else 0.0)
            for curve, side, p, is_covered in zip(curves, self.sides, p_partner, covered, strict=True)
        ]
        forth, back = (
            _fit_chain(side, compared.tilted(tilt), np.where(used, p_pair, 0.0), start, tilt, last=last)
            for side, compared, start, tilt in zip(self.sides, sides, previous, tilts, strict=True)
        )
        return replace(self, chains=(forth, back), curves=curves)

    @property
    def has_relation(self) -> bool:
        """Whether the magnitudes of both sources were compared: enough pairs have both."""
        return self.chains is not None and all(any(chain.related) for chain in self.chains)

    @property
    def share_missing(self) -> float:
        """Share of the records without a magnitude in the first band; the larger one of both sources."""
        return max(float(np.isnan(side.measured.values[:, 0]).mean()) for side in self.sides)

    @property
    def is_informative(self) -> bool:
        """Whether the first bands of most pairs are related, with a scatter far below that of all records."""
        relation, magnitude = self.first_relation, self.sides[0].measured.values[:, 0]
        if relation is None or relation.unrelated > 0.5:
            return False
        return relation.typical_scatter < 0.5 * float(np.nanstd(magnitude))

    def quoted_and_spread(self, pairs: Pairs, p_pair: FloatArray) -> tuple[float, float]:
        """The median combined quoted error in mag of the first bands of probable pairs (m,), and the smaller spread of
        a first band among them: half the difference of the 16th and 84th percentiles."""
        probable = p_pair > 0.5
        rows, sides = (pairs.i[probable], pairs.j[probable]), [side.measured for side in self.sides]
        variance = sum(side.variance[at, 0] for side, at in zip(sides, rows, strict=True))
        ends = (np.nanpercentile(side.values[at, 0], [16.0, 84.0]) for side, at in zip(sides, rows, strict=True))
        spread = min(0.5 * float(high - low) for low, high in ends)
        return math.sqrt(float(np.nanmedian(variance))), spread

    @property
    def is_fitted(self) -> bool:
        """Whether there is any fit."""
        return self.has_relation or self.curves != (None, None)

    @property
    def first_relation(self) -> Relation | None:
        """The first band of source 1 given the bands of source 2 that most pairs have; None if unknown."""
        relations = self.chains[0].related[0] if self.chains else {}
        complete = {pattern: relation for pattern, relation in relations.items() if pattern[0]}
        return max(complete.values(), key=lambda relation: relation.weight, default=None)

    def rule(self, shares: tuple[FloatArray, FloatArray], pairs: Pairs | None = None) -> Brightness | None:
        """The evidence, with the shares at the records' positions; None before the first fit.

        pairs : the only pairs that the rule will be applied to, if given.
        """
        if not self.is_fitted:
            return None
        rows = (None, None) if pairs is None else (pairs.i, pairs.j)
        completeness = [
            np.zeros(len(share)) if curve is None else curve.terms(side.measured.values[:, 0], share, wanted)
            for side, share, curve, wanted in zip(self.sides, shares, self.curves, rows, strict=True)
        ]
        return Brightness(self.sides, self.chains, completeness[0], completeness[1], self.compared)

    def logits(self) -> tuple[FloatArray, FloatArray]:
        """(n₁,), (n₂,) the addition of each record's magnitude to the logit of its share; 0 if missing."""
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
        for side, rows, names, covered in zip(self.sides, at, self.names, coverage.covered, strict=True):
            magnitude = side.measured.values[:, 0]
            partner = np.minimum(np.bincount(rows, answer.p_pair, len(magnitude)), 1.0)
            used = np.isfinite(magnitude) & covered
            enough = np.count_nonzero(used) >= MIN_PAIRS
            of_band = names[0], magnitude[used], partner[used], volume
            curves.append(DetectionCurve.of(*of_band) if enough else None)
        return curves[0], curves[1]


def _sampled(pairs: IntArray, most: int) -> IntArray:
    """About ``most``/2 to ``most`` of the pairs, chosen by a hash: similar pairs give similar samples."""
    if len(pairs) <= most:
        return pairs
    halvings = math.ceil(math.log2(len(pairs) / most))
    hashed = (pairs.astype(np.uint64) * np.uint64(HASH_FACTOR)) & np.uint64(2**32 - 1)
    return pairs[hashed < np.uint64(2 ** (32 - halvings))]


def _fit_chain(
    side: SourceMagnitudes,
    compared: Comparisons,
    weight: FloatArray,
    previous: Chain | None,
    tilt: PartnerTilt | None,
    *,
    last: bool,
) -> Chain:
    """Relations of the bands of one source to those of the other, in pairs with these weights (m,): probabilities
    with the evidence of the ``previous`` chain, if any."""
    related: list[Mapping[Pattern, Relation]] = []
    for band, (density, comparisons) in enumerate(zip(side.densities, compared.bands, strict=True)):
        start = previous.related[band] if previous else {}
        relations = {
            x.regressors.pattern: _fit_relation(x, weight, density, start.get(x.regressors.pattern), last=last)
            for x in comparisons
        }
        related.append({pattern: relation for pattern, relation in relations.items() if relation is not None})
    return Chain(tuple(related), tilt)


def _source_magnitudes(measured: MeasuredMagnitudes) -> SourceMagnitudes:
    """The densities of a source's bands, and the relations between them."""
    densities = tuple(_band_density(column) for column in measured.values.T)
    sample = measured.take(np.arange(0, len(measured.values), max(1, -(-len(measured.values) // OWN_BAND_RECORDS))))
    alone: list[Mapping[Pattern, Relation]] = []
    for band, density in enumerate(densities):
        regressors = Regressors.split(band, sample, None) if band and density is not None else ()
        weight = np.ones(len(sample.values))
        comparisons = [Comparison(x, np.exp(density(x.y)), np.empty(0)) for x in regressors if density is not None]
        fits = {x.regressors.pattern: _fit_relation(x, weight, density, None) for x in comparisons}
        alone.append({pattern: relation for pattern, relation in fits.items() if relation is not None})
    return SourceMagnitudes(measured, densities, tuple(alone))


def _band_density(magnitude: FloatArray) -> MagnitudeDensity | None:
    """The density of the measured magnitudes; None if they are too few."""
    known = magnitude[np.isfinite(magnitude)]
    return density_of(known) if len(known) >= MIN_PAIRS else None


def _fit_relation(
    compared: Comparison,
    weight: FloatArray,
    density: MagnitudeDensity | None,
    start: Relation | None,
    *,
    last: bool = False,
) -> Relation | None:
    """The relation of a band to its regressors, from pairs whose probabilities rest on the relation ``start``; None
    with too few pairs."""
    x = compared.regressors
    weight = weight[x.rows]
    if density is None or weight.sum() < MIN_PAIRS:
        return None
    background = compared.background
    assumed = background if start is None else np.exp(x.log_density(start, background))
    sample = Sample.of(x.y, x.others, x.variance, x.other_variance, background, weight, assumed)
    return fit_relation(sample, density, start, last=last)


def _fit_curve(
    last: bool,
    side: SourceMagnitudes,
    p_partner: FloatArray,
    share: FloatArray,
    covered: BoolArray,
    previous: ShareCurve | None,
) -> ShareCurve | None:
    """The curve of the shares by magnitude, in the last fit from more records; None with too few."""
    n_records = CURVE_RECORDS if last else CURVE_RECORDS_IN_EM
    magnitude = side.measured.values[:, 0]
    rows = np.flatnonzero(np.isfinite(magnitude) & covered)
    if len(rows) < MIN_PAIRS:
        return None
    mean = float(p_partner[rows].mean())
    n_records = int(n_records * min(0.25 / max(mean * (1.0 - mean), 1e-9), MAX_CURVE_FACTOR))
    rows = rows[:: max(1, -(-len(rows) // n_records))]
    return ShareCurve.fit(magnitude[rows], share[rows], p_partner[rows], previous)

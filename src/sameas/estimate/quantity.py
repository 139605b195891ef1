"""Estimated quantities with their standard errors."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np

from sameas.arrays import BoolArray, FloatArray, IntArray, median, weighted_median
from sameas.estimate.columns import ColumnEvidence
from sameas.estimate.coverage import Coverage
from sameas.estimate.photometry import Photometry
from sameas.evidence import Errors
from sameas.evidence.detection import LinearSpline
from sameas.gate.gate import quantile
from sameas.kernels import threads
from sameas.result import Identification
from sameas.space import Sphere

#: Greatest share of the information on a share that may be missing.
MAX_MISSING = 0.95
#: Lower limit of the information on a parameter: a prior of ± 6 on curves of shares, and far wider on the rest.
LEAST_INFORMATION = 1.0 / 36.0
#: Records whose scores are computed, at most, and least probability of their pairs.
MOST_SCORED, LEAST_SCORED = 20_000, 1e-6
#: Decimals of a printed quantity; one that needs more is printed with an exponent (chosen).
MOST_DECIMALS = 6


@dataclass(frozen=True)
class Quantity:
    """An estimated value and its standard error, in ``unit``.

    >>> print(Quantity(0.3512, 0.0042, "mag"))
    0.3512 ± 0.0042 mag
    >>> print(Quantity(-4.5e-9, 9e-9, "mag"))  # of magnitudes that are copies
    -4.5e-09 ± 9.0e-09 mag
    >>> print(Quantity(-2.3e-309, 0.0, "mag"))
    0 mag
    """

    value: float
    standard_error: float
    unit: str = ""

    def __str__(self) -> str:
        if not 0.0 < self.standard_error < math.inf:
            # The medians of copies leave numbers too small for their own digits.
            value = self.value if abs(self.value) >= sys.float_info.min else 0.0
            return f"{value:.4g} {self.unit}".strip()
        digits = max(0, 1 - math.floor(math.log10(self.standard_error)))
        if digits > MOST_DECIMALS:
            # As many digits as the error has a meaning for, at least two and at most six.
            above = math.log10(max(abs(self.value) / self.standard_error, 1.0))
            return f"{self.value:.{min(2 + int(above), 6)}g} ± {self.standard_error:.1e} {self.unit}".strip()
        return f"{self.value:.{digits}f} ± {self.standard_error:.{digits}f} {self.unit}".strip()


def quantities(
    answer: Identification,
    coverage: Coverage,
    photometry: Photometry | None,
    columns: ColumnEvidence | None,
    *,
    errors: Errors | None,
    learned_from: tuple[int, int],
) -> Mapping[str, Quantity]:
    """All estimated numbers; ``errors`` are those of the evidence if they were estimated, else None.

    common : number of common objects. share_1, share_2 : probability that the other source shows a covered record.
    density_common, density_only_1, density_only_2 : per (unit of the residuals)^d where both observe.
    error_scale : factor on the quoted errors. zero_point, scatter, colour_BAND, brightness_unrelated : of the
    magnitudes, see :func:`_of_relation`. learned_from : number of records of each source used for the estimates.
    """
    scores = _Scores(errors, photometry, columns)
    works = [partial(_Share.of, answer, coverage, source, learned_from[source - 1], scores) for source in (1, 2)]
    shares = threads.each(works, len(answer.pairs))
    best = min(shares, key=lambda share: share.count_error)
    common = Quantity(best.found, best.count_error)
    quantities = {"common": common, "share_1": shares[0].quantity(), "share_2": shares[1].quantity()}
    volume = coverage.common_volume
    if volume > 0.0:
        unit = "per arcsec²" if isinstance(coverage.first.space, Sphere) else ""
        alone = [share.number - share.found for share in shares]
        counts = {"density_common": common.value, "density_only_1": alone[0], "density_only_2": alone[1]}
        for name, number in counts.items():
            error = math.sqrt(max(number, 0.5) + common.standard_error**2)
            quantities[name] = Quantity(number / volume, error / volume, unit)
    if errors is not None:
        quantities["error_scale"] = _error_scale(answer)
    if photometry is not None:
        quantities |= _of_relation(photometry)
    return quantities


@dataclass(frozen=True)
class _Share:
    """Of ``number`` covered records, ``found`` are expected to have a partner; ``unsure`` is Σ p(1 − p).

    left_out : ratio of records not used for the estimate to those used, 0 if all were used.
    parameter_variance : variance of ``found`` because its parameters are estimated, if from all records.
    """

    number: int
    found: float
    unsure: float
    left_out: float
    parameter_variance: float

    @classmethod
    def of(cls, answer: Identification, coverage: Coverage, source: int, learned_from: int, scores: _Scores) -> _Share:
        records, at = (answer.first, answer.pairs.i) if source == 1 else (answer.second, answer.pairs.j)
        covered = coverage.covered[source - 1]
        all_partners = np.minimum(np.bincount(at, answer.p_pair, len(records)).astype(np.float64), 1.0)
        partner = np.compress(covered, all_partners)
        number, found, unsure = len(partner), float(partner.sum()), float((partner * (1.0 - partner)).sum())
        variance = scores.variance(answer, source, covered, all_partners)
        return cls(number, found, unsure, len(records) / max(learned_from, 1) - 1.0, variance)

    @property
    def share(self) -> float:
        return _share(self.found, self.number)

    @property
    def count_error(self) -> float:
        """Standard error of ``found`` as the number of true pairs, including that of the estimated parameters."""
        return math.sqrt(self.unsure + (1.0 + self.left_out) * self.parameter_variance)

    def quantity(self) -> Quantity:
        """The share as a probability."""
        number = max(self.number, 1)
        binomial = self.share * (1.0 - self.share) / (self.number + 1.0)
        parameters = (self.unsure + (1.0 + self.left_out) * self.parameter_variance) / number**2
        return Quantity(self.found / number, math.sqrt(binomial + parameters))


def _share(found: float, number: int) -> float:
    """The share of ``number`` records, with half a record of each kind more."""
    return (found + 0.5) / (number + 1.0)


@dataclass(frozen=True)
class _Scores:
    """What changes the probabilities of all pairs together, if estimated: the errors' scale, the shares by magnitude
    and by other columns.

    errors : of the evidence, or None if they were not estimated. photometry, columns : or None.
    """

    errors: Errors | None
    photometry: Photometry | None
    columns: ColumnEvidence | None

    def variance(self, answer: Identification, source: int, covered: BoolArray, partner: FloatArray) -> float:
        """Variance of the expected number of partners, Σ p over the ``covered`` records of a source (n,), because
        parameters θ are estimated: gᵀ I⁻¹ g, with g = ∂Σp/∂θ and the information I = Σ s sᵀ.

        The score s of a record is the expected score of the complete data [Louis 1982]: p − share for the logit of the
        share, Σ_j p_j ∂ ln(density of pair j)/∂θ for others; then ∂p/∂θ is 1 − p times it. Competition between records
        is ignored.
        """
        pairs = answer.pairs
        own, other = (pairs.i, pairs.j) if source == 1 else (pairs.j, pairs.i)
        step = max(1, -(-len(covered) // MOST_SCORED))
        chosen = np.zeros(len(covered), np.bool_)
        chosen[::step] = covered[::step]
        place = np.cumsum(chosen) - 1
        used = np.flatnonzero(chosen[own] & (answer.p_pair > LEAST_SCORED))
        at, weight, p = place[own[used]], answer.p_pair[used], partner[chosen]
        share = _share(float(p.sum()), len(p))
        whole, unsure = len(p) * share * (1.0 - share), float((p * (1.0 - p)).sum())
        others = [
            np.bincount(at, weight * values, len(p))
            for values in self._of_pairs(answer, used, source, other[used].astype(np.int64))
        ]
        scores = np.column_stack([p - share, *others])
        information = scores.T @ scores + LEAST_INFORMATION * np.eye(scores.shape[1])
        information[0, 0] = max(whole - unsure, (1.0 - MAX_MISSING) * whole, LEAST_INFORMATION)
        gradient = np.append(unsure, (1.0 - p) @ scores[:, 1:])
        return step * float(gradient @ np.linalg.solve(information, gradient))

    def _of_pairs(self, answer: Identification, used: IntArray, source: int, other: IntArray) -> Iterator[FloatArray]:
        """(u,) derivatives of the ln density of pairs ``used`` (u,), whose other records are these, by each parameter
        besides the share."""
        if self.errors is not None:
            yield _scale_scores(answer, self.errors, used)
        weight = answer.p_pair[used]
        if self.columns is not None:
            for basis in self.columns.design(3 - source, other).T:
                yield _centred(basis, weight)
        curve = None if self.photometry is None else self.photometry.curves[2 - source]
        if self.photometry is None or curve is None:
            return
        magnitude = self.photometry.sides[2 - source].measured.values[other, 0]
        known = np.isfinite(magnitude)
        spline = LinearSpline.at(curve.knots, np.where(known, magnitude, curve.knots[0]))
        for knot in np.eye(len(curve.knots)):
            score = np.zeros(len(known))
            score[known] = _centred(spline.curve(knot)[known], weight[known])
            yield score


def _centred(basis: FloatArray, weight: FloatArray) -> FloatArray:
    """The values less their weighted mean: the evidence of partners is a density, and a common factor is part of the
    share."""
    return np.asarray(basis - weight @ basis / max(float(weight.sum()), 1e-300))


def _scale_scores(answer: Identification, errors: Errors, used: IntArray) -> FloatArray:
    """(u,) derivatives of the ln densities of the residuals of pairs ``used`` (u,) by ln of a factor on all errors."""
    square, d = errors.pairs(answer.pairs.part(used)).mahalanobis_sq, answer.pairs.d
    density, score = np.zeros(len(square)), np.zeros(len(square))
    for scale, share in zip(errors.scales, errors.shares, strict=True):
        normal = share * scale**-d * np.exp(-0.5 * square / scale**2)
        density += normal
        score += normal * (square / scale**2 - d)
    return np.divide(score, density, out=np.zeros(len(square)), where=density > 0.0)


def _error_scale(answer: Identification) -> Quantity:
    """The median normalised distance of the pairs over its expected value; robust against a heavy tail.

    Pairs have the weight p; the standard error is that of a median of χ_d.
    """
    d, weight = answer.pairs.d, answer.p_pair
    used = weight > 1e-3
    middle = weighted_median(np.sqrt(np.compress(used, answer.pairs.mahalanobis_sq)), np.compress(used, weight))
    expected = math.sqrt(quantile(0.5, d))
    log_density = (
        (d - 1) * math.log(expected) - 0.5 * expected**2 - (0.5 * d - 1) * math.log(2.0) - math.lgamma(0.5 * d)
    )
    number = float(weight.sum() - (weight * (1.0 - weight)).sum())
    error = 0.5 / (expected * math.exp(log_density) * math.sqrt(max(number, 1.0)))
    return Quantity(middle / expected, middle / expected * error)


def _of_relation(photometry: Photometry) -> dict[str, Quantity]:
    """The first band of source 1 relative to that of source 2: zero point, scatter, colour terms, unrelated share.

    zero_point : mean difference of the common objects, first minus second. scatter : beyond the quoted errors.
    colour_BAND : mag per mag of BAND minus the second source's first band.
    """
    relation = photometry.first_relation
    if relation is None:
        return {}
    quantities = {
        "zero_point": Quantity(relation.zero_point, relation.zero_point_error, "mag"),
        "scatter": Quantity(relation.typical_scatter, relation.scatter_error, "mag"),
    }
    for name, slope, error in zip(photometry.names[1][1:], relation.slopes, relation.slope_errors, strict=False):
        quantities[f"colour_{name}"] = Quantity(float(slope), float(error), "mag/mag")
    share = relation.unrelated
    quantities["brightness_unrelated"] = Quantity(share, math.sqrt(share * (1.0 - share) / max(relation.weight, 1.0)))
    return quantities


def decisive(answer: Identification) -> Mapping[str, float]:
    """The median absolute value of each term of the evidence over the identified pairs."""
    chosen = answer.chosen
    if not chosen.any():
        return {}
    terms = answer.evidence.terms
    medians = threads.each([partial(_typical, values, chosen) for values in terms.values()], len(chosen))
    return dict(zip(terms, medians, strict=True))


def _typical(values: FloatArray, chosen: BoolArray) -> float:
    """The median absolute value of the chosen ones."""
    some = np.compress(chosen, values)
    return median(np.abs(some, out=some))


def changed_without(answer: Identification, names: tuple[str, ...]) -> int:
    """Number of records of source 1 that would be identified differently without these terms of the evidence."""
    from sameas.assignment import assign
    from sameas.prior import PerPair

    terms: list[FloatArray] = [values for name, values in answer.evidence.terms.items() if name in names]
    if not terms:
        return 0
    grouped = answer.groups
    linear = PerPair()(grouped.sizes_1, grouped.sizes_2)
    other = assign(grouped, answer.evidence.log_ratio - np.sum(terms, axis=0), linear)
    return len(np.unique(answer.pairs.i[grouped.in_given_order(other.chosen) != answer.chosen]))

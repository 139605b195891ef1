"""Probabilities averaged over the error models that few pairs do not rule out.

With errors θ_k, a tail of them included, and the number of common objects n_k by each,

    P(pair) = Σ_k w_k P(pair | θ_k, n_k),   w_k ∝ prior(θ_k) L(θ_k, n_k),
    ln L = ln Z + n + N₁ ln(1 − n/N₁) + N₂ ln(1 − n/N₂),

where Z sums over all one-to-one hypotheses, and the rest is the probability of N₁ and N₂ records of a Poisson field, up
to a constant (METHOD 6, equations 6.1b and 6.1c). So a pair that is certain by only one of the errors is not certain.
The errors and their prior come from the grid of ``error_grid.py``.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from sameas.arrays import FloatArray
from sameas.assignment import Hypothesis, assign
from sameas.evidence import Errors, Evidence, Rule
from sameas.gate import Pairs, Radius
from sameas.groups import Groups, groups, laid_out
from sameas.posterior import Posterior, by_messages, log_evidence, posterior
from sameas.prior import PerPair
from sameas.records import Records
from sameas.result import Identification

#: Pairs of smaller ln odds, before one-to-one, are dropped (chosen; below rounding).
MIN_LOG_ODDS = math.log(1e-12)
#: Probabilities, and their complements, below this have lost their digits; odds are then used directly.
ROUNDING = 1e-9

#: Total weight of the errors that are dropped before exact sums: no probability changes by more.
MAX_DROPPED = 0.002

Solver = Callable[..., Posterior]


@dataclass(frozen=True)
class ErrorAverage:
    """Errors that few pairs do not rule out: k of them, with ln of their prior probabilities (k,).

    limits : (k,) of Δᵀ S⁻¹ Δ, for a gate with all pairs by any of the errors.
    """

    errors: tuple[Errors, ...]
    log_prior: FloatArray
    limits: FloatArray

    def candidates(self, first: Records, second: Records) -> Pairs:
        """All candidates within the limit of any of the errors; their distances are by the quoted errors."""
        sigmas = np.sqrt(self.limits)
        factor = max(k * errors.factor_1 for k, errors in zip(sigmas.tolist(), self.errors, strict=True))
        floor = (sigmas[:, None] * _floors(self.errors)).max(axis=0)
        widest = Errors(factor_1=factor, factor_2=factor, floor=floor_of_axes(floor))
        pairs = Radius(1.0)(*widest.records(first, second)).of(first, second)
        near = np.zeros(len(pairs), np.bool_)
        for errors, limit in zip(self.errors, self.limits, strict=True):
            near |= errors.pairs(pairs).mahalanobis_sq <= limit
        return replace(
            pairs.part(near),
            gate=f"distance ≤ {sigmas.min():.2f} to {sigmas.max():.2f} σ by any of {len(sigmas)} errors",
        )

    def log_densities(self, pairs: Pairs) -> FloatArray:
        """(k, m) ln densities of the residuals; −∞ beyond the gate."""
        out = np.full((len(self.errors), len(pairs)), -np.inf)
        for row, errors, limit in zip(out, self.errors, self.limits, strict=True):
            modelled = errors.pairs(pairs)
            near = modelled.mahalanobis_sq <= limit
            row[near] = modelled.log_peak[near] + errors.log_profile(modelled.mahalanobis_sq[near], pairs.d)
        return out

    def ranges(self, weight: FloatArray) -> ErrorRanges:
        """95 % ranges of the errors with these (k,) weights."""
        factors = np.array([errors.factor_1 for errors in self.errors])
        floors = np.array([np.max(errors.floor) for errors in self.errors])
        return ErrorRanges(_interval(factors, weight), _interval(floors, weight))

    def typical(self, weight: FloatArray) -> Errors:
        """Errors whose variances, and shares of the tail, are the weighted mean of all, weights (k,)."""
        factor = math.sqrt(sum(w * e.factor_1**2 for w, e in zip(weight, self.errors, strict=True)))
        floors = _floors(self.errors)
        floor = np.sqrt(weight @ floors**2)
        shares: dict[float, float] = {}
        for of_point, errors in zip(weight.tolist(), self.errors, strict=True):
            for scale, share in zip(errors.scales, errors.shares, strict=True):
                shares[scale] = shares.get(scale, 0.0) + of_point * share
        scales = sorted(shares)
        mixture = tuple(scales), tuple(shares[scale] for scale in scales)
        return Errors(*mixture, factor_1=factor, factor_2=factor, floor=floor_of_axes(floor))


@dataclass(frozen=True)
class ErrorRanges:
    """Ranges of the errors that hold 95 % of the posterior with few pairs.

    factors : (least, greatest) factor on the quoted errors. floors : the same of the floor, in the unit of the
    residuals.
    """

    factors: tuple[float, float]
    floors: tuple[float, float]


def _interval(values: FloatArray, weight: FloatArray) -> tuple[float, float]:
    """The weighted 2.5 % and 97.5 % quantiles."""
    order = np.argsort(values)
    cumulated = np.cumsum(weight[order])
    low, high = (values[order[min(int(np.searchsorted(cumulated, q)), len(order) - 1)]] for q in (0.025, 0.975))
    return float(low), float(high)


def _floors(errors: tuple[Errors, ...]) -> FloatArray:
    """(k, 1) or (k, d) floors; with several axes in any of them, a single number applies to every axis."""
    axes = max(np.size(one.floor) for one in errors)
    return np.array([np.broadcast_to(one.floor, (axes,)) for one in errors])


def floor_of_axes(floor: FloatArray) -> float | tuple[float, ...]:
    """The floor as one number if it is the same along all axes."""
    return float(floor[0]) if np.all(floor == floor[0]) else tuple(floor.tolist())


@dataclass(frozen=True)
class Average:
    """Errors over which probabilities are averaged, k of them, for one list of candidates.

    average : the errors and their prior. log_density : (k, m) ln densities of the residuals. weight : (k,) posterior.
    n_common : (k,) expected number of common objects by each.
    """

    average: ErrorAverage
    log_density: FloatArray
    weight: FloatArray
    n_common: FloatArray

    @classmethod
    def of(cls, average: ErrorAverage, pairs: Pairs, weight: FloatArray, common: float) -> Average:
        """Before the first EM iteration, with given (k,) weights and number of common objects."""
        return cls(average, average.log_densities(pairs), weight, np.full(len(weight), common))

    @property
    def typical(self) -> Errors:
        """Errors of the mean variance."""
        return self.average.typical(self.weight)

    def without_improbable(self, most: float) -> Average:
        """Without the least probable errors, which together have at most this weight."""
        order = np.argsort(-self.weight, kind="stable")
        kept = np.sort(order[: int(np.searchsorted(np.cumsum(self.weight[order]), 1.0 - most)) + 1])
        average = self.average
        errors = tuple(average.errors[k] for k in kept.tolist())
        rest = replace(average, errors=errors, log_prior=average.log_prior[kept], limits=average.limits[kept])
        weight = self.weight[kept] / self.weight[kept].sum()
        return Average(rest, self.log_density[kept], weight, self.n_common[kept])

    def posterior(
        self,
        pairs: Pairs,
        others: FloatArray,
        expected: float,
        n_records: tuple[int, int],
        *,
        exact: bool = False,
        companion_log_odds: FloatArray | None = None,
    ) -> tuple[Average, Averaged]:
        """The updated weights, and the averaged probabilities of the pairs; ``others`` (m,) is all other evidence.

        expected : number of common objects assumed in ``others``. n_records : N₁, N₂, records that may be common.
        exact : whether groups are summed exactly; else by message passing.
        companion_log_odds : (m,) ln of the odds, before one-to-one, that a pair is two companions.
        """
        solver: Solver = posterior if exact else by_messages
        p_pairs, log_weight, n_common = [], [], []
        assumed = _count_terms(expected, n_records)
        for log_prior, log_density, number in zip(self.average.log_prior, self.log_density, self.n_common, strict=True):
            own = _count_terms(number, n_records)
            solution = HypothesisSums.of(
                pairs, others + log_density + (own.odds - assumed.odds), solver, companion_log_odds
            )
            p_pairs.append(solution.p_pair)
            log_weight.append(log_prior + solution.log_evidence + own.log_records)
            # With a uniform prior of the share in common.
            n_common.append((float(solution.p_pair.sum()) + 0.5) / (min(n_records) + 1.0) * min(n_records))
        weight = np.exp(np.array(log_weight) - max(log_weight))
        weight /= weight.sum()
        odds = others + np.array([_count_terms(n, n_records).odds - assumed.odds for n in self.n_common])[:, None]
        averaged = Averaged.of(pairs, np.array(p_pairs), odds + self.log_density, weight)
        return replace(self, weight=weight, n_common=np.array(n_common)), averaged


@dataclass(frozen=True)
class _CountTerms:
    """What the number of common objects adds to the ln odds of a pair, and to the ln probability of the records."""

    odds: float
    log_records: float


def _count_terms(number: float, n_records: tuple[int, int]) -> _CountTerms:
    number = min(max(number, 1e-3), min(n_records) * (1.0 - 1e-6))
    alone = [math.log1p(-number / n) for n in n_records]
    records = number + sum(n * log for n, log in zip(n_records, alone, strict=True))
    return _CountTerms(math.log(number) - sum(alone), records)


@dataclass(frozen=True)
class HypothesisSums:
    """Sums over all one-to-one hypotheses of one list of candidates.

    p_pair : (m,) probabilities that pairs are one object. grouped : groups of the pairs that are not dropped; best :
    their most probable hypothesis; p_related : their probabilities to be one object or companions.
    """

    p_pair: FloatArray
    grouped: Groups
    best: Hypothesis
    p_related: FloatArray

    @classmethod
    def of(
        cls,
        pairs: Pairs,
        log_same: FloatArray,
        solver: Solver,
        companion_log_odds: FloatArray | None = None,
        least: float = MIN_LOG_ODDS,
    ) -> HypothesisSums:
        """From (m,) ln odds of the pairs, before one-to-one, to be one object and (optional) two companions, against
        unrelated objects.

        Pairs with odds below ``least`` are dropped, with probability 0: one-to-one makes no pair more probable.
        """
        log_ratio = log_same if companion_log_odds is None else np.logaddexp(log_same, companion_log_odds)
        kept = np.flatnonzero(log_ratio > least)
        places = pairs.place_1[kept], pairs.place_2[kept], pairs.i[kept], pairs.j[kept]
        grouped = laid_out(*places, len(pairs.first), len(pairs.second))
        best = assign(grouped, log_ratio[kept], PerPair()(grouped.sizes_1, grouped.sizes_2))
        p, p_pair = solver(grouped, best).p_pair, np.zeros(len(pairs))
        p_pair[kept] = p if companion_log_odds is None else p * np.exp(log_same[kept] - log_ratio[kept])
        return cls(p_pair, grouped, best, p)

    @property
    def log_evidence(self) -> float:
        """ln of the sum over all hypotheses, relative to the hypothesis without pairs."""
        return float(log_evidence(self.grouped, self.best, self.p_related).sum())


@dataclass(frozen=True)
class Averaged:
    """Averaged probabilities of the pairs.

    p_pair : (m,). log_ratio : (m,) ln odds, before one-to-one, for choosing the most probable hypothesis. In a group
    without cycles, odds p (1 − p) / (p₀ p₀') give the pairs their probabilities p, with p₀ those of no partner.
    """

    p_pair: FloatArray
    log_ratio: FloatArray

    @classmethod
    def one(cls, pairs: Pairs, p_pair: FloatArray, log_ratio: FloatArray) -> Averaged:
        """From one point, (m,) each."""
        return cls.of(pairs, p_pair[None], log_ratio[None], np.ones(1))

    @classmethod
    def of(cls, pairs: Pairs, p_pairs: FloatArray, log_ratios: FloatArray, weight: FloatArray) -> Averaged:
        """From all points: p_pairs, log_ratios (k, m), weight (k,)."""
        p = np.clip(weight @ p_pairs, 0.0, 1.0)
        alone_1, alone_2 = (
            np.maximum(1.0 - np.bincount(at, p, n), 0.0)[at]
            for at, n in ((pairs.i, len(pairs.first)), (pairs.j, len(pairs.second)))
        )
        with np.errstate(divide="ignore", invalid="ignore"):
            log_weight = np.log(weight)[:, None]
            log_ratio = np.log(p) + np.log1p(-np.minimum(p, 1.0 - 1e-16)) - np.log(alone_1) - np.log(alone_2)
        least_alone = np.minimum(alone_1, alone_2)
        arithmetic = np.logaddexp.reduce(log_weight + log_ratios, axis=0)
        # Near certainty the harmonic mean of the odds: the smallest odds have the greatest effect.
        bounded = np.maximum(log_ratios, MIN_LOG_ODDS)
        harmonic = -np.logaddexp.reduce(log_weight - bounded, axis=0)
        log_ratio = np.where(p < ROUNDING, arithmetic, np.where(least_alone < ROUNDING, harmonic, log_ratio))
        return cls(p, np.maximum(log_ratio, -1e4))


def identify_averaged(
    average: Average | None,
    pairs: Pairs,
    rule: Rule,
    expected: float,
    n_records: tuple[int, int],
    companion_log_odds: FloatArray | None,
) -> Identification:
    """The identification of these candidates with averaged probabilities.

    The averaged odds replace the term of the positions in the evidence of ``rule``, or that of companions if errors are
    known (``average`` None). expected, n_records, companion_log_odds : as in :meth:`Average.posterior`.
    """
    evidence = rule(pairs)
    if average is None:
        replaced, rest, log_ratio = "companions", without_term(evidence, "companions"), evidence.log_ratio
        averaged = Averaged.one(
            pairs, HypothesisSums.of(pairs, log_ratio, posterior, companion_log_odds).p_pair, log_ratio
        )
    else:
        replaced, rest = "position", without_positions(evidence)
        _, averaged = average.without_improbable(MAX_DROPPED).posterior(
            pairs, rest, expected, n_records, exact=True, companion_log_odds=companion_log_odds
        )
    terms = {**evidence.terms, replaced: averaged.log_ratio - rest}
    grouped = groups(pairs)
    best = assign(grouped, averaged.log_ratio, PerPair()(grouped.sizes_1, grouped.sizes_2))
    solution = posterior(grouped, best)
    return Identification(
        pairs, grouped, Evidence(terms, evidence.log_error), best, replace(solution, p_pair=averaged.p_pair)
    )


def without_positions(evidence: Evidence) -> FloatArray:
    """(m,) the sum of all terms except that of the positions."""
    return without_term(evidence, "position")


def without_term(evidence: Evidence, excluded: str) -> FloatArray:
    """(m,) the sum of all terms except one."""
    return np.asarray(sum(values for name, values in evidence.terms.items() if name != excluded))

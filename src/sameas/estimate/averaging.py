"""Probabilities averaged over what few pairs cannot tell of the errors (METHOD 11.1).

With errors θ_k that are not ruled out, and n_k objects in common by each,

    P(pair) = Σ_k w_k P(pair | θ_k, n_k),   w_k ∝ prior(θ_k) L(θ_k, n_k),
    ln L = ln Z + n + N₁ ln(1 − n/N₁) + N₂ ln(1 − n/N₂),

where Z sums over all one-to-one hypotheses, and the rest is the probability of N₁ and N₂ records, of a Poisson field,
up to a constant. So nothing is certain that only one of the errors says.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from sameas.arrays import FloatArray
from sameas.assignment import Hypothesis, assign
from sameas.estimate.error_grid import ErrorAverage
from sameas.evidence import Errors, Evidence, Rule
from sameas.gate import Pairs
from sameas.groups import Groups, groups, laid_out
from sameas.posterior import Posterior, by_messages, log_evidence, posterior
from sameas.prior import PerPair
from sameas.result import Identification

#: Pairs of smaller ln of the odds, before one-to-one, are as good as impossible (chosen; less than rounding).
IMPOSSIBLE = math.log(1e-12)
#: From here on one minus a probability has lost its digits; what the odds say stands for it.
SURE = 1e-9

Solver = Callable[..., Posterior]


@dataclass(frozen=True)
class Average:
    """Errors (k,) that are left open, for one list of candidates.

    average : the errors and their prior. log_density : (k, m) ln of the density of the residuals. weight : (k,)
    posterior. numbers : (k,) expected number of common objects by each.
    """

    average: ErrorAverage
    log_density: FloatArray
    weight: FloatArray
    numbers: FloatArray

    @classmethod
    def of(cls, average: ErrorAverage, pairs: Pairs, weight: FloatArray, common: float) -> Average:
        """Before the first EM iteration, with weights (k,) from elsewhere."""
        return cls(average, average.log_densities(pairs), weight, np.full(len(weight), common))

    @property
    def typical(self) -> Errors:
        """Errors of the mean variance."""
        return self.average.typical(self.weight)

    def posterior(
        self,
        pairs: Pairs,
        others: FloatArray,
        expected: float,
        seen: tuple[int, int],
        *,
        exact: bool = False,
        beside: FloatArray | None = None,
    ) -> tuple[Average, Averaged]:
        """The weights, and the probabilities of the pairs, when all other evidence of these is ``others`` (m,).

        expected : number of common objects that ``others`` let expect. seen : N₁, N₂, records that may be common.
        exact : whether groups are summed exactly; else by messages.
        beside : (m,) ln of the odds of pairs to be companions, before one-to-one.
        """
        solver: Solver = posterior if exact else by_messages
        p_pairs, log_weight, numbers = [], [], []
        shift = _shift(expected, seen)
        for log_prior, log_density, number in zip(self.average.log_prior, self.log_density, self.numbers, strict=True):
            here = _shift(number, seen)
            solved = Solved.of(pairs, others + log_density + (here.odds - shift.odds), solver, beside)
            p_pairs.append(solved.p_pair)
            log_weight.append(log_prior + solved.log_evidence + here.log_records)
            # A share of which nothing is known before lies between none and all.
            numbers.append((float(solved.p_pair.sum()) + 0.5) / (min(seen) + 1.0) * min(seen))
        weight = np.exp(np.array(log_weight) - max(log_weight))
        weight /= weight.sum()
        odds = others + np.array([_shift(n, seen).odds - shift.odds for n in self.numbers])[:, None]
        averaged = Averaged.of(pairs, np.array(p_pairs), odds + self.log_density, weight)
        return replace(self, weight=weight, numbers=np.array(numbers)), averaged


@dataclass(frozen=True)
class _Shift:
    """What a number of common objects adds to ln of the odds of a pair, and to ln of the probability of the records."""

    odds: float
    log_records: float


def _shift(number: float, seen: tuple[int, int]) -> _Shift:
    number = min(max(number, 1e-3), min(seen) * (1.0 - 1e-6))
    alone = [math.log1p(-number / n) for n in seen]
    records = number + sum(n * log for n, log in zip(seen, alone, strict=True))
    return _Shift(math.log(number) - sum(alone), records)


@dataclass(frozen=True)
class Solved:
    """Sums over all one-to-one hypotheses of one list of candidates.

    p_pair : (m,) probabilities of the pairs to be one object. grouped, best, p_either : the groups of the pairs that
    are not as good as impossible, their most probable hypothesis, and the probabilities by it.
    """

    p_pair: FloatArray
    grouped: Groups
    best: Hypothesis
    p_either: FloatArray

    @classmethod
    def of(
        cls,
        pairs: Pairs,
        log_same: FloatArray,
        solver: Solver,
        beside: FloatArray | None = None,
        least: float = IMPOSSIBLE,
    ) -> Solved:
        """By ln of the odds of the pairs (m,), before one-to-one, to be one object, and ``beside``, if any, to be
        companions missed each by the other source, against having nothing to do with each other.

        No pair is more probable than these odds say: those below ``least`` are left out, and at zero.
        """
        log_ratio = log_same if beside is None else np.logaddexp(log_same, beside)
        kept = np.flatnonzero(log_ratio > least)
        places = pairs.place_1[kept], pairs.place_2[kept], pairs.i[kept], pairs.j[kept]
        grouped = laid_out(*places, len(pairs.first), len(pairs.second))
        best = assign(grouped, log_ratio[kept], PerPair()(grouped.sizes_1, grouped.sizes_2))
        p, p_pair = solver(grouped, best).p_pair, np.zeros(len(pairs))
        p_pair[kept] = p if beside is None else p * np.exp(log_same[kept] - log_ratio[kept])
        return cls(p_pair, grouped, best, p)

    @property
    def log_evidence(self) -> float:
        """ln of the sum over all hypotheses, against that all records are alone."""
        return float(log_evidence(self.grouped, self.best, self.p_either).sum())


@dataclass(frozen=True)
class Averaged:
    """p_pair : (m,) probabilities of the pairs, averaged. log_ratio : (m,) ln of the odds, before one-to-one, by which
    the most probable hypothesis is chosen.

    Weights of pairs that give a group without cycles its probabilities p, and p₀ to be alone, are p (1 − p) / (p₀ p₀').
    """

    p_pair: FloatArray
    log_ratio: FloatArray

    @classmethod
    def one(cls, pairs: Pairs, p_pair: FloatArray, log_ratio: FloatArray) -> Averaged:
        """Of one point, (m,) each."""
        return cls.of(pairs, p_pair[None], log_ratio[None], np.ones(1))

    @classmethod
    def of(cls, pairs: Pairs, p_pairs: FloatArray, log_ratios: FloatArray, weight: FloatArray) -> Averaged:
        """p_pairs, log_ratios : (k, m) by every point. weight : (k,)."""
        p = np.clip(weight @ p_pairs, 0.0, 1.0)
        alone_1, alone_2 = (
            np.maximum(1.0 - np.bincount(at, p, n), 0.0)[at]
            for at, n in ((pairs.i, len(pairs.first)), (pairs.j, len(pairs.second)))
        )
        with np.errstate(divide="ignore", invalid="ignore"):
            log_weight = np.log(weight)[:, None]
            log_ratio = np.log(p) + np.log1p(-np.minimum(p, 1.0 - 1e-16)) - np.log(alone_1) - np.log(alone_2)
        least = np.minimum(alone_1, alone_2)
        few = np.logaddexp.reduce(log_weight + log_ratios, axis=0)
        # Of what is as good as certain the odds that any of the points gives count, the least most.
        bounded = np.maximum(log_ratios, IMPOSSIBLE)
        many = -np.logaddexp.reduce(log_weight - bounded, axis=0)
        log_ratio = np.where(p < SURE, few, np.where(least < SURE, many, log_ratio))
        return cls(p, np.maximum(log_ratio, -1e4))


def identified(
    average: Average | None,
    pairs: Pairs,
    rule: Rule,
    expected: float,
    seen: tuple[int, int],
    beside: FloatArray | None = None,
) -> Identification:
    """The identification of these candidates, averaged; ``rule`` gives all evidence, of which the term of the positions
    is replaced, or that of companions where errors are known.

    expected, seen, beside : as in :meth:`Average.posterior`. average : None where errors are known.
    """
    evidence = rule(pairs)
    if average is None:
        changed, rest, log_ratio = "companions", but(evidence, "companions"), evidence.log_ratio
        averaged = Averaged.one(pairs, Solved.of(pairs, log_ratio, posterior, beside).p_pair, log_ratio)
    else:
        changed, rest = "position", but_positions(evidence)
        _, averaged = average.posterior(pairs, rest, expected, seen, exact=True, beside=beside)
    terms = {**evidence.terms, changed: averaged.log_ratio - rest}
    grouped = groups(pairs)
    best = assign(grouped, averaged.log_ratio, PerPair()(grouped.sizes_1, grouped.sizes_2))
    sure = posterior(grouped, best)
    return Identification(
        pairs, grouped, Evidence(terms, evidence.log_error), best, replace(sure, p_pair=averaged.p_pair)
    )


def but_positions(evidence: Evidence) -> FloatArray:
    """(m,) the sum of all terms but that of the positions."""
    return but(evidence, "position")


def but(evidence: Evidence, left_out: str) -> FloatArray:
    """(m,) the sum of all terms but one."""
    return np.asarray(sum(values for name, values in evidence.terms.items() if name != left_out))

"""The most probable one-to-one hypothesis of every group.

With a prior linear in the number of pairs it is a maximum-weight matching in which records may stay without a partner;
with any other prior, shortest augmenting paths give the best matching of every size k, and the k of greatest
ln P(k) + W_k is kept (METHOD 4.2). Both are exact, with dual variables as certificate, in O(n³) at worst and in memory
proportional to the candidates. Call :func:`refuse_crowds` before choosing among pairs; code that only weights pairs
(registration, the scale of errors) does not need it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sameas.arrays import BoolArray, FloatArray
from sameas.errors import InputError
from sameas.gate import Pairs
from sameas.groups import Groups
from sameas.kernels import threads
from sameas.prior import LogPrior
from sameas.representation import in_short

#: Largest sum over the pairs of the smaller number of candidates of its two records; n³ if each of n records has n
#: candidates. 10⁹ take about one minute of processor time.
MAX_CHOICES = 4e9


@dataclass(frozen=True)
class Certificate:
    """Proof that no other one-to-one hypothesis is more probable.

    least_reduced_cost : least of u + v − weight and of the dual variables, relative to the weight; 0 or rounding.
    duality_gap : difference of the totals of the dual variables and of the chosen weights, relative.
    """

    least_reduced_cost: float
    duality_gap: float

    @property
    def holds(self) -> bool:
        """Reduced costs ≥ −1e-12 and a gap ≤ 1e-9."""
        return self.least_reduced_cost >= -1e-12 and self.duality_gap <= 1e-9

    def __str__(self) -> str:
        word = "optimal" if self.holds else "NOT PROVED OPTIMAL"
        return f"{word}: least reduced cost {self.least_reduced_cost:.1e}, duality gap {self.duality_gap:.1e}"


@in_short
@dataclass(frozen=True)
class Hypothesis:
    """The most probable hypothesis, in the layout of the groups.

    chosen : (m,) whether each pair of the layout belongs to it.
    weight : (m,) ln λ of each pair, with the prior's slope where the prior is linear.
    dual_1, dual_2 : dual variables of the records of the layout: u + v ≥ weight + multiplier.
    multiplier : (g,) Lagrange multiplier of the number of pairs (0 where the prior is linear).
    prior : the prior that was used.
    """

    chosen: BoolArray
    weight: FloatArray
    dual_1: FloatArray
    dual_2: FloatArray
    multiplier: FloatArray
    prior: LogPrior

    def certificate(self, groups: Groups) -> Certificate:
        """The proof by dual variables, in O(candidates), that this is the most probable hypothesis."""
        total = self.weight + self.multiplier[groups.group]
        place_1, place_2 = groups.places
        u, v = self.dual_1[place_1], self.dual_2[place_2]
        scale = np.maximum(1.0, np.abs(total))
        least = float(np.min((u + v - total) / scale, initial=0.0))
        least = min(least, float(self.dual_1.min(initial=0.0)), float(self.dual_2.min(initial=0.0)))
        primal = float(total[self.chosen].sum())
        dual = float(self.dual_1.sum() + self.dual_2.sum())
        return Certificate(least, abs(dual - primal) / max(1.0, abs(primal)))

    def certify(self, groups: Groups) -> None:
        """Raise ArithmeticError unless the certificate holds."""
        certificate = self.certificate(groups)
        if not certificate.holds:
            raise ArithmeticError(f"the assignment is {certificate}; please report this with the records")


def refuse_crowds(pairs: Pairs, max_choices: float = MAX_CHOICES) -> None:
    """Raise InputError if so many records compete that the most probable hypothesis takes hours: more choices than
    MAX_CHOICES."""
    if float(len(pairs)) ** 1.5 <= max_choices:  # the sum is largest for √m × √m records
        return
    of_1 = np.bincount(pairs.i, minlength=len(pairs.first))
    if float(np.square(of_1, dtype=np.float64).sum()) <= max_choices:
        return
    fewer = np.minimum(of_1[pairs.i], np.bincount(pairs.j, minlength=len(pairs.second))[pairs.j])
    choices = float(fewer.sum(dtype=np.float64))
    if choices > max_choices:
        worst = int(np.argmax(fewer))
        first, second = pairs.first.source, pairs.second.source
        one, two = of_1[pairs.i[worst]], np.count_nonzero(pairs.j == pairs.j[worst])
        raise InputError(
            f"{first}: at row {int(pairs.first.rows[pairs.i[worst]])}, {one} records of {second} may each be any of "
            f"{two}: to tell them apart would take some {choices / 1e9:,.0f} minutes",
            "are their errors in another unit? Give smaller ones, or leave these records out",
            source=first,
        )


def assign(groups: Groups, log_ratio: FloatArray, prior: LogPrior) -> Hypothesis:
    """The most probable hypothesis of every group.

    log_ratio : (m,) ln λ of the pairs, in the order of the gate.
    """
    from sameas.kernels.assign import assign_counted, assign_linear

    weight = log_ratio[groups.order]
    chosen = np.zeros(len(weight), np.bool_)
    u = np.zeros(len(groups.rows_1))
    v = np.zeros(len(groups.rows_2))
    multiplier = np.zeros(len(groups))
    bounds = groups.bounds_of_threads()
    layout = groups.layout
    if prior.slope is not None:
        if np.count_nonzero(prior.slope):
            weight = weight + np.repeat(prior.slope, groups.pair_counts)
        threads.over(lambda a, b: assign_linear(a, b, layout, weight, chosen, u, v), bounds)
    else:
        table = (prior.start, prior.table)
        threads.over(lambda a, b: assign_counted(a, b, layout, weight, *table, chosen, u, v, multiplier), bounds)
    return Hypothesis(chosen, weight, u, v, multiplier, prior)

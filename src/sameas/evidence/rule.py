"""The interface of decision rules, which turn pairs into evidence, and sums of rules.

A rule gives exactly 0.0 for pairs that it cannot compare because one of the records has no value, so that
:attr:`Evidence.informative` is the mask of the pairs that it compares.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sameas.arrays import BoolArray, FloatArray
from sameas.gate import Pairs
from sameas.representation import in_short


@in_short
@dataclass(frozen=True)
class Evidence:
    """Named terms, (m,) each, whose sum is the log likelihood ratio of every pair.

    log_error : (m,) standard error of that sum for rules that integrate numerically, None where it is exact to
        rounding; infinite where the sum is only a bound.
    precision : (m,) of rules that compare positions which both records measure with their own errors: the sum of the
        two precisions 1/σ², 0 for pairs that are not compared. It weights the pairs of sets of three records or more
        (:func:`sameas.many.rules.by_precision`); None for other rules.
    """

    terms: Mapping[str, FloatArray]
    log_error: FloatArray | None = None
    precision: FloatArray | None = None

    @property
    def log_ratio(self) -> FloatArray:
        """(m,) ln λ; summed at every call, so keep it for reuse."""
        parts = list(self.terms.values())
        return sum(parts[1:], parts[0])

    @cached_property
    def informative(self) -> BoolArray:
        """(m,) whether any term of the pair differs from exactly 0.0."""
        parts = [np.asarray(values != 0.0) for values in self.terms.values()]
        return parts[0] if len(parts) == 1 else np.logical_or.reduce(parts)


class Rule:
    """The interface of decision rules: a call from pairs to evidence, and a sum with other rules."""

    def __call__(self, pairs: Pairs) -> Evidence:
        raise TypeError(f"{type(self).__name__} is the interface of decision rules; use one of them")

    def __add__(self, other: Rule) -> Rule:
        if not isinstance(other, Rule):
            return NotImplemented
        return Sum((*self.parts(), *other.parts()))

    def parts(self) -> tuple[Rule, ...]:
        """The rules of which this one is the sum."""
        return (self,)


@dataclass(frozen=True)
class Sum(Rule):
    """Several rules for independent features."""

    rules: tuple[Rule, ...]

    def parts(self) -> tuple[Rule, ...]:
        return self.rules

    def __call__(self, pairs: Pairs) -> Evidence:
        terms: dict[str, FloatArray] = {}
        error: FloatArray | None = None
        for rule in self.rules:
            evidence = rule(pairs)
            for name, values in evidence.terms.items():
                terms[name] = terms[name] + values if name in terms else values
            if evidence.log_error is not None:
                error = evidence.log_error if error is None else np.hypot(error, evidence.log_error)
        return Evidence(terms, error)

"""Belief: what a set of records weighs as one object against all of its records being objects of their own.

Every belief of :func:`sameas.many.identify_many` is brought to one form. A set T of k ≥ 2 records weighs

    ln w(T) = constant + Σ_{i∈T} gain_i + ln J(T) + (k − 1) · mean over its pairs of between_ij,

with J the joint density of :mod:`sameas.joint`; one record alone weighs 0. A hypothesis weighs Σ ln w(T), and under a
count prior also ln P of its number of merges, Σ (k − 1).

- :class:`PoissonObjects`: objects are a Poisson field, sources miss some and add false records (METHOD 4.3).
- Pairwise rules, ``CloseObjects`` and ``Field``, for sets: see :class:`Pairwise`.
- :class:`MissedObjects`: only the probabilities of a miss are known (METHOD 4.1 for any number of sources).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import ArrayLike

from sameas.errors import InputError
from sameas.evidence import CloseObjects, Errors, Field, Rule
from sameas.prior import PerPair
from sameas.records import FloatArray
from sameas.union import Union


@dataclass(frozen=True)
class Terms:
    """constant, gain (n,) per record, between (m,) per pair: see the module."""

    constant: float
    gain: FloatArray
    between: FloatArray

    def __add__(self, other: Terms) -> Terms:
        return Terms(self.constant + other.constant, self.gain + other.gain, self.between + other.between)


@dataclass(frozen=True)
class PoissonObjects:
    """Objects are a Poisson field of known density; a set's weight follows from it (METHOD 4.3, 7).

    A set A of records that is an object weighs ρ ∏_{s∈A}(1−q_s) ∏_{s∉A} q_s J(A); a record alone is an object that the
    others miss, or false: ρ(1−q_s) ∏_{t≠s} q_t J(i) + β_s. For two sources it is ``PoissonField`` with
    ρ₁₂ = ρ(1−q₁)(1−q₂), ρ₁ = ρ(1−q₁)q₂ + β₁, ρ₂ = ρ(1−q₂)q₁ + β₂.

    Parameters
    ----------
    density : ρ, objects per unit volume of the state (with a region: at its centre).
    q : per source, in the order in which the sources are given, the probability that it misses an object; or one.
    false : per source β, false records per unit volume of its features; or one.
    """

    density: float
    q: float | Sequence[float]
    false: float | Sequence[float] = 0.0

    def __post_init__(self) -> None:
        if not 0.0 < self.density < math.inf:
            raise InputError(f"PoissonObjects: density is {self.density}; give objects per unit volume, above 0")
        _probabilities(self.q, "PoissonObjects")
        false = np.asarray(self.false, dtype=np.float64)
        if not np.all((false >= 0.0) & (false < np.inf)):
            raise InputError(f"PoissonObjects: false is {self.false}; give densities of zero or more")

    def terms(self, union: Union) -> Terms:
        """The terms of the records and pairs of ``union``."""
        q, false = _per_source(self.q, union, "q"), _per_source(self.false, union, "false")
        log_missed, log_seen = np.log(q), np.log1p(-q)
        alone_sets = np.full((len(union), len(q)), -1)
        alone_sets[np.arange(len(union)), union.source] = np.arange(len(union))
        log_j = union.observers.joint(union.positions(alone_sets)).log_density
        odds = (log_seen - log_missed)[union.source]
        base = math.log(self.density) + log_missed.sum()
        with np.errstate(divide="ignore"):
            alone = np.logaddexp(base + odds + log_j, np.log(false)[union.source])
        return Terms(base, odds - alone, np.zeros(len(union.i)))


@dataclass(frozen=True)
class Pairwise:
    """A rule for pairs, λ = N(Δ; 0, Σ)/f(Δ), extended to sets: λ(T) = J(T) / f(T), symmetric in the records.

    ln f(T) = (k − 1) · mean over the pairs of ln f(Δ_ij). It is the rule itself for two records, and exact for any
    number where f is constant (``Field``); for ``CloseObjects`` and three records or more it is an extension, not a
    theorem: k − 1 other objects, each as near as the records of the set are to each other on average.
    """

    rule: Rule

    def __post_init__(self) -> None:
        for rule in self.rule.parts():
            numbers = [np.ndim(getattr(rule, f.name)) for f in fields(rule)] if isinstance(rule, Field) else []
            if not isinstance(rule, CloseObjects | Field) or any(numbers):
                raise InputError(
                    f"identify_many: {type(rule).__name__} speaks of two sources; give PoissonObjects(density, q), "
                    "CloseObjects(a, b), or Field(density) with one number"
                )
        if len(self.rule.parts()) > 1:
            raise InputError("identify_many: both rules speak of position; give one of them")

    def terms(self, union: Union) -> Terms:
        """The terms of the records and pairs of ``union``."""
        if len(union.observers.whole) < len(union.sources):
            raise InputError(
                f"{type(self.rule).__name__} compares whole positions, but a source observes a part of the state; "
                "give PoissonObjects(density, q) and a region"
            )
        between = np.zeros(len(union.i))
        for pairs, place in union.parts:
            between[place] = self.rule(pairs).log_ratio - Errors().log_density(pairs)
        return Terms(0.0, np.zeros(len(union)), between)


@dataclass(frozen=True)
class MissedObjects:
    """Sources miss objects with probabilities q; the number of objects is unknown, flat (METHOD 4.1 generalised).

    In a group of N records a hypothesis of n objects has ln P = ln n! + Σ_objects Σ_{s missing} ln q_s
    − (n + 1) ln(1 − ∏ q_s), up to what all share: the sum over the number of objects of the multinomial of the sets of
    sources that show them. For two sources it is ``CommonObjects(q1, q2)``.

    q : per source, in the order in which the sources are given; or one for all.
    """

    q: float | Sequence[float]

    def __post_init__(self) -> None:
        _probabilities(self.q, "MissedObjects")

    def terms(self, union: Union) -> Terms:
        """The part linear in the number of merges: every merge spares one object the misses of all sources."""
        total = float(np.log(_per_source(self.q, union, "q")).sum())
        return Terms(total, np.full(len(union), -total), np.zeros(len(union.i)))

    def table(self, union: Union, records: int) -> FloatArray:
        """(records,) ln P of 0, 1, … merges among so many records, less that of none and the linear part."""
        from scipy.special import gammaln

        n = records - np.arange(records, dtype=np.float64)
        log_p = gammaln(n + 1) - (n + 1) * math.log1p(-float(np.prod(_per_source(self.q, union, "q"))))
        return log_p - log_p[:1]


SetRule = PoissonObjects | Rule
SetPrior = MissedObjects | PerPair


def terms_of(rule: SetRule, prior: SetPrior, union: Union) -> Terms:
    """The terms of a rule and of the linear part of a prior together."""
    if not isinstance(rule, PoissonObjects | Rule):
        raise InputError(f"identify_many: rule is a {type(rule).__name__}; give PoissonObjects(…) or CloseObjects(…)")
    evidence = rule.terms(union) if isinstance(rule, PoissonObjects) else Pairwise(rule).terms(union)
    if isinstance(prior, MissedObjects):
        return evidence + prior.terms(union)
    if not isinstance(prior, PerPair):
        raise InputError(
            f"identify_many: prior is a {type(prior).__name__}; give MissedObjects(q) or PerPair(log_odds)"
        )
    # Every merge, the second record of an object and each further one, has the pair's odds.
    linear = Terms(-prior.log_odds, np.full(len(union), prior.log_odds), np.zeros(len(union.i)))
    return evidence + linear


def _probabilities(q: ArrayLike, name: str) -> None:
    values = np.asarray(q, dtype=np.float64)
    if values.ndim > 1 or not np.all((values > 0.0) & (values < 1.0)):
        raise InputError(f"{name}: q is {q!r}; give per source the probability of a miss, strictly between 0 and 1")


def _per_source(values: float | Sequence[float], union: Union, name: str) -> FloatArray:
    """(S,) the values in the order of the union's sources."""
    array = np.asarray(values, dtype=np.float64)
    if array.ndim and len(array) != len(union.sources):
        raise InputError(f"{name} has {len(array)} numbers for {len(union.sources)} sources; give one, or one a source")
    return np.broadcast_to(array, len(union.sources))[list(union.given)]

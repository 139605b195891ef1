"""Set rules: the weight w of a set of records as one object, relative to each of its records being a separate object.

- :class:`PoissonObjects`: objects are a Poisson field, sources miss some and add false records (METHOD 4.3).
- Pairwise rules, ``CloseObjects`` and ``Field``, extended to sets: see :class:`Pairwise`.
- :class:`MissedObjects`: only the probabilities of a miss are known (METHOD 4.1 for any number of sources).
- Rules on attributes are added to one on positions: ``PoissonObjects(…) + Identity(…)`` or
  ``CloseObjects(…) + Identity(…)``. Such a rule is called once for every two sources, ordered by content. It must
  identify sources by name and records by table row, give the same for (i, j) as for (j, i), and exactly 0.0 where it is
  not informative.

:func:`sameas.identify_many` brings every rule to :class:`Terms`. A set T of k ≥ 2 records weighs

    ln w(T) = ln J(T) + Σ over the linear terms (constant + Σ_{i∈T} gain_i) + Σ over the rules of pairs Σ c_ij ln r_ij,

with J of :mod:`sameas.many.observations`; one record alone weighs 0. A hypothesis weighs Σ ln w of its sets, and under
a count prior also ln P of its number of merges, Σ (k − 1).

A rule of pairs compares two records, and k − 1 comparisons determine a set of k, so its pairs have shares c_ij:

- :func:`best_reference`, for attributes. If the object has the attributes of record h, every other record is compared
  with h alone: λ(T) = Σ_θ p(θ) ∏ p(v_i|θ)/p(v_i) ≈ max_h ∏_{i≠h} r_hi. A third record with the same attribute counts
  once, and one that contradicts two others counts against them once.
- :func:`mean_of_pairs`, for the density of unrelated records: (k − 1) times the mean over the pairs.
- :func:`by_precision`, for positions compared in previous scans: as in the joint density of all records.

For two records both shares are 1.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cache, cached_property

import numpy as np
from numpy.typing import ArrayLike

from sameas.arrays import BoolArray, FloatArray, IntArray, over_columns
from sameas.errors import InputError
from sameas.evidence import (
    Brightness,
    CloseObjects,
    ConstantCost,
    DetectionField,
    Evidence,
    Field,
    PoissonField,
    Rule,
    Universal,
)
from sameas.gate import Pairs
from sameas.many.observations import records_of
from sameas.many.pooled import PooledRecords
from sameas.prior import PerPair
from sameas.representation import in_short


@dataclass(frozen=True)
class Linear:
    """A term of ln w: a constant of every set, and a gain (n,) of each record in it."""

    constant: float
    gain: FloatArray


#: (k, pairs) shares c of the pairs of k sets of one size, from ln r of the pairs and whether the rule is informative.
Shares = Callable[[FloatArray, BoolArray], FloatArray]


#: Functions that saved states refer to by name (:mod:`sameas.io.saved`).
SAVED = ("best_reference", "mean_of_pairs")


def best_reference(log_ratio: FloatArray, informative: BoolArray) -> FloatArray:
    """Share 1 for the pairs of the reference, 0 for others: the record of largest Σ ln r that is compared with all.

    Records may lack attributes, so that the rule is informative for some pairs only. If no record is compared with all
    the others (a chain), pairs have the share min(1, (k_s − 1)/n_s), with k_s records in n_s informative pairs.
    log_ratio is 0 where the rule is not informative.
    """
    if informative.shape[1] <= 1:
        return np.ones(informative.shape)
    incidence = _incidence(informative.shape[1])
    compared = informative.astype(np.float64) @ incidence
    records, pairs = np.count_nonzero(compared, axis=1), np.count_nonzero(informative, axis=1)
    with_all = (compared > 0) & (compared == records[:, None] - 1)
    total = np.where(with_all, log_ratio @ incidence, -np.inf)
    shares: FloatArray = incidence.T[total.argmax(axis=1)]
    chain = ~with_all.any(axis=1)
    shares[chain] = np.clip((records - 1.0) / np.maximum(pairs, 1), 0.0, 1.0)[chain, None]
    return np.asarray(shares)


def best_of_three(log_ratio: FloatArray, informative: BoolArray) -> FloatArray:
    """(k,) Σ c ln r of sets of three records by :func:`best_reference`: the reference leaves out the lowest of three
    informative pairs, and none of fewer."""
    a, b, c = log_ratio.T
    all_three = over_columns(np.logical_and, informative)
    return np.asarray(np.where(all_three, np.maximum(np.maximum(a + b, a + c), b + c), a + b + c))


def mean_of_pairs(log_ratio: FloatArray, informative: BoolArray) -> FloatArray:
    """The share (k − 1) / (k (k − 1)/2) for every pair."""
    return np.full(log_ratio.shape, 2.0 / _size(log_ratio.shape[1]))


def by_precision(precision: FloatArray) -> FloatArray:
    """The shares c_ij = (w_i + w_j) / W of records with the precisions w_i = 1/σ_i², W their sum over the set.

    The χ² of k positions about their weighted mean is Σ w_i w_j δ_ij² / W, that of a pair w_i w_j δ_ij² / (w_i + w_j).

    precision : (k, pairs) w_i + w_j, 0 for pairs that are not compared. Of the records of compared pairs, W is the sum
    of these divided by one less than the number of the records; no share is above 1.
    """
    if precision.shape[1] <= 1:
        return np.ones(precision.shape)
    compared, total = precision > 0.0, over_columns(np.add, precision)
    if precision.shape[1] == 3:
        # Two of three pairs have all three records.
        further = np.minimum(over_columns(np.add, compared.astype(np.int64)), 2)
    else:
        records = np.count_nonzero(compared.astype(np.float64) @ _incidence(precision.shape[1]), axis=1)
        further = np.maximum(records - 1, 0)
    scale = further / np.where(total > 0.0, total, 1.0)
    return np.asarray(np.minimum(precision * scale[:, None], 1.0))


@dataclass(frozen=True)
class PairTerms:
    """A rule of pairs: named terms (m,) of ln r of all pooled pairs, whether it is informative (m,), and the shares of
    the pairs in larger sets.

    precision : (m,) of :class:`sameas.evidence.Evidence`; if given, the shares are :func:`by_precision`.
    """

    terms: Mapping[str, FloatArray]
    informative: BoolArray
    shares: Shares
    precision: FloatArray | None = None

    @classmethod
    def of(cls, rule: Callable[[Pairs], Evidence], pooled: PooledRecords, shares: Shares) -> PairTerms:
        """The terms of ``rule`` for the pairs of every two sources.

        Raises
        ------
        InputError : a term is not finite.
        """
        m = len(pooled.i)
        terms: dict[str, FloatArray] = {}
        informative = np.zeros(m, bool)
        precision: FloatArray | None = None
        for pairs, index in pooled.parts:
            evidence = rule(pairs)
            for name, values in evidence.terms.items():
                infinite = np.flatnonzero(~np.isfinite(values))
                if len(infinite):
                    raise InputError(_not_finite(name, pairs, int(infinite[0]), values))
                terms.setdefault(name, np.zeros(m))[index] = values
            informative[index] = evidence.informative
            if evidence.precision is not None:
                precision = np.zeros(m) if precision is None else precision
                precision[index] = evidence.precision
        return cls(terms, informative, shares, precision)

    @cached_property
    def log_ratio(self) -> FloatArray:
        """(m,) ln r."""
        return Evidence(self.terms).log_ratio if self.terms else np.zeros(len(self.informative))

    def shares_of(self, pairs: IntArray) -> FloatArray:
        """(k, pairs) the shares c of the pairs of sets of one size, in the order of :func:`pairs_of`."""
        if self.precision is not None:
            return by_precision(self.precision[pairs])
        return self.shares(self.log_ratio[pairs], self.informative[pairs])

    def of_sets(self, pairs: IntArray) -> FloatArray:
        """(k,) Σ c ln r of sets, given by their pairs."""
        if pairs.shape[1] == 1:
            return self.log_ratio[pairs[:, 0]]
        if pairs.shape[1] == 3 and self.shares is best_reference and self.precision is None:
            return best_of_three(self.log_ratio[pairs], self.informative[pairs])
        return over_columns(np.add, self.shares_of(pairs) * self.log_ratio[pairs])

    @cached_property
    def is_silent(self) -> bool:
        """Whether ln r is 0 for all pairs, such as for the identities of sources of which one gives none."""
        return not self.log_ratio.any()


@in_short
@dataclass(frozen=True)
class Terms:
    """All terms of ln w except ln J: linear terms by name, and rules of pairs."""

    linear: Mapping[str, Linear]
    by_pair: tuple[PairTerms, ...] = ()

    def __add__(self, other: Terms) -> Terms:
        return Terms({**self.linear, **other.linear}, self.by_pair + other.by_pair)

    def gain(self, pooled: PooledRecords) -> FloatArray:
        """(n,) the summed gain of every pooled record in the linear terms."""
        return _sum(len(pooled), (part.gain for part in self.linear.values()))

    def linear_of(self, records: IntArray) -> FloatArray:
        """(k,) the sum of the linear terms of sets (k, size) of records."""
        return _sum(
            len(records), (part.constant + over_columns(np.add, part.gain[records]) for part in self.linear.values())
        )

    def by_pair_of(self, pairs: IntArray) -> FloatArray:
        """(k,) the sum of the rules of pairs, of sets given by their pairs in the order of :func:`pairs_of`."""
        return _sum(len(pairs), (rule.of_sets(pairs) for rule in self.by_pair if not rule.is_silent))

    def max_by_pair(self, pooled: PooledRecords) -> FloatArray:
        """(g,) upper bound, 0 or more, of what each record after a set's first adds in the rules of pairs, by group.

        The shares of the informative pairs of k records sum to at most k − 1, so a rule adds at most
        (k − 1) max ln r_ij.
        """
        most = np.zeros(len(pooled.sizes))
        for rule in (rule for rule in self.by_pair if not rule.is_silent):
            highest = np.zeros(len(most))
            np.maximum.at(highest, pooled.group[pooled.i], rule.log_ratio)
            most += highest
        return most

    def by_name(self, records: IntArray, pairs: IntArray) -> dict[str, FloatArray]:
        """(k,) each term of sets (k, size) of records and their pairs; the terms sum to ln w − ln J."""
        out = {name: part.constant + part.gain[records].sum(axis=1) for name, part in self.linear.items()}
        for rule in self.by_pair:
            shares = rule.shares_of(pairs)
            for name, values in rule.terms.items():
                out[name] = out.get(name, np.zeros(len(pairs))) + (shares * values[pairs]).sum(axis=1)
        return out


def pairs_of(pooled: PooledRecords, records: IntArray) -> IntArray:
    """(k, size (size − 1)/2) the pooled pairs of sets (k, size) of ascending records, every two of which are a pair.

    Columns are (0, 1), (0, 2), (1, 2), (0, 3), …, so that a set keeps them when a record is added.
    """
    later, earlier = np.tril_indices(records.shape[1], -1)
    return pooled.pair(records[:, earlier], records[:, later])[1]


def _sum(n: int, parts: Iterable[FloatArray]) -> FloatArray:
    """(n,) the sum of any number of arrays."""
    total = np.zeros(n)
    for part in parts:
        total += part
    return total


def _size(n_pairs: int) -> int:
    """Number of records of a set of ``n_pairs`` pairs."""
    return (1 + math.isqrt(1 + 8 * n_pairs)) // 2


@cache
def _incidence(n_pairs: int) -> FloatArray:
    """(pairs, size) 1 for the two records of each column of :func:`pairs_of`, else 0."""
    later, earlier = np.tril_indices(_size(n_pairs), -1)
    out = np.zeros((n_pairs, _size(n_pairs)))
    out[np.arange(n_pairs), earlier] = out[np.arange(n_pairs), later] = 1.0
    return out


def _not_finite(name: str, pairs: Pairs, at: int, values: FloatArray) -> str:
    first, second = pairs.first, pairs.second
    i, j = first.rows[pairs.i[at]], second.rows[pairs.j[at]]
    return (
        f"{name} is {values[at]} for {first.source} row {i} and {second.source} row {j}; a rule of identify_many gives "
        "finite logarithms: bound it by how often what it compares is wrong"
    )


#: Rules for exactly two sources, in their order.
OF_TWO_SOURCES = (Brightness, ConstantCost, DetectionField, PoissonField, Universal)


class ObjectsRule:
    """Interface of a rule on positions, to which rules on attributes can be added."""

    def terms(self, pooled: PooledRecords) -> Terms:
        """The terms of the pooled records and pairs."""
        raise TypeError(f"{type(self).__name__} is the interface of set rules; use one of them")

    def __add__(self, other: Rule) -> SetRules:
        return SetRules(self, ()) + other

    __radd__ = __add__


@in_short
@dataclass(frozen=True)
class PoissonObjects(ObjectsRule):
    """Objects are a Poisson field of known density; a set's weight follows from it (METHOD 4.3, 7).

    A set A of records that is an object weighs ρ ∏_{s∈A}(1−q_s) ∏_{s∉A} q_s J(A). A record alone is an object that the
    other sources miss, or false: ρ(1−q_s) ∏_{t≠s} q_t J(i) + β_s. For two sources it is ``PoissonField`` with
    ρ₁₂ = ρ(1−q₁)(1−q₂), ρ₁ = ρ(1−q₁)q₂ + β₁, ρ₂ = ρ(1−q₂)q₁ + β₂.

    Parameters
    ----------
    density : ρ, objects per unit volume of the state (with a region: at its centre).
    q : probability that a source misses an object: one number, or one per source in the order of the sources.
    false : β, false records of a source per unit volume of its features: one number, or one per source, or for a
        source one at each of its records (n,).
    """

    density: float
    q: float | Sequence[float] | FloatArray
    false: float | Sequence[float | FloatArray] | FloatArray = 0.0

    def __post_init__(self) -> None:
        if not 0.0 < self.density < math.inf:
            raise InputError(f"PoissonObjects: density is {self.density}; give objects per unit volume, above 0")
        _probabilities(self.q, "PoissonObjects")
        false = np.concatenate([np.atleast_1d(np.asarray(each, np.float64)) for each in self._false])
        if not np.all((false >= 0.0) & (false < np.inf)):
            raise InputError(f"PoissonObjects: false is {self.false}; give densities of zero or more")

    def terms(self, pooled: PooledRecords) -> Terms:
        """The terms of the pooled records; there are none of pairs."""
        q, false = _per_source(self.q, pooled, "q"), self._false_at(pooled)
        log_missed, log_detected = np.log(q), np.log1p(-q)
        log_j = pooled.log_joint(np.arange(len(pooled))[:, None])
        odds = (log_detected - log_missed)[pooled.source]
        base = math.log(self.density) + log_missed.sum()
        with np.errstate(divide="ignore"):
            alone = np.logaddexp(base + odds + log_j, np.log(false))
        # J of one record, 1 without a region, is shown as part of the position term and not of the densities.
        return Terms({"position": Linear(0.0, -log_j), "densities": Linear(base, odds - alone + log_j)})

    @property
    def _false(self) -> list[float | FloatArray]:
        return list(self.false) if isinstance(self.false, Sequence) else np.atleast_1d(self.false).tolist()

    def mean_false(self, n_sources: int) -> FloatArray:
        """(S,) false records of each source, the mean over its records."""
        return np.broadcast_to([float(np.mean(each)) if np.size(each) else 0.0 for each in self._false], n_sources)

    def _false_at(self, pooled: PooledRecords) -> FloatArray:
        """(n,) false records at each pooled record."""
        given, is_one = self._false, not isinstance(self.false, Sequence) and np.ndim(self.false) == 0
        which = _per_source(0 if is_one else np.arange(float(len(given))), pooled, "false").astype(np.int64).tolist()
        out = np.empty(len(pooled))
        for s, source in enumerate(pooled.sources):
            each = np.asarray(given[which[s]], np.float64)
            out[pooled.start[s] : pooled.start[s + 1]] = each[records_of(source).rows] if each.ndim else each
        return out


@dataclass(frozen=True)
class SetRules:
    """A rule on positions with rules on attributes: ``PoissonObjects(…) + Identity(…)``.

    Example
    -------
    >>> from sameas.evidence import Identity
    >>> attributes = {"radar": {"icao": ["4b1814", None]}, "adsb": {"icao": ["4b1814", "4b1815"]}}
    >>> [type(rule).__name__ for rule in (PoissonObjects(density=1e-3, q=0.2) + Identity(attributes)).attributes]
    ['Identity']
    """

    objects: ObjectsRule
    attributes: tuple[Rule, ...]

    def __add__(self, other: Rule) -> SetRules:
        if not isinstance(other, Rule):
            return NotImplemented
        return SetRules(self.objects, (*self.attributes, *other.parts()))

    __radd__ = __add__


@dataclass(frozen=True)
class Pairwise(ObjectsRule):
    """A rule on positions of pairs, λ = N(Δ; 0, Σ)/f(Δ), extended to sets: λ(T) = J(T) / f(T), independent of order.

    ln f(T) = (k − 1) · mean over the pairs of ln f(Δ_ij). It is the rule itself for two records, and exact for any
    number if f is constant (``Field``). For ``CloseObjects`` and three or more records it is an extension, not a
    theorem: k − 1 unrelated objects, each as near as the records of the set are to each other on average.
    """

    rule: CloseObjects | Field

    def __post_init__(self) -> None:
        if isinstance(self.rule, Field) and any(np.ndim(getattr(self.rule, f.name)) for f in fields(self.rule)):
            raise InputError(_two_sources(self.rule))

    def terms(self, pooled: PooledRecords) -> Terms:
        """The terms of the pooled pairs."""
        if len(pooled.observers.whole) < len(pooled.sources):
            raise InputError(
                f"{type(self.rule).__name__} compares whole positions, but a source observes a part of the state; "
                "give PoissonObjects(density, q) and a region"
            )
        return Terms({}, (PairTerms.of(self._unrelated, pooled, mean_of_pairs),))

    def _unrelated(self, pairs: Pairs) -> Evidence:
        """−ln f(Δ): the rule without its N, which J replaces."""
        return Evidence({name: values for name, values in self.rule(pairs).terms.items() if name != "position"})


@in_short
@dataclass(frozen=True)
class MissedObjects:
    """Sources miss objects with probabilities q; the number of objects has a flat prior (METHOD 4.1 generalised).

    In a group of N records a hypothesis of n objects has ln P = ln n! + Σ_objects Σ_{s missing} ln q_s
    − (n + 1) ln(1 − ∏ q_s), up to a constant: the sum over the number of objects of the multinomial of the sets of
    sources that detect them. For two sources it is ``CommonObjects(q1, q2)``.

    q : one number, or one per source in the order of the sources.
    """

    q: float | Sequence[float] | FloatArray

    def __post_init__(self) -> None:
        _probabilities(self.q, "MissedObjects")

    def terms(self, pooled: PooledRecords) -> Terms:
        """The part of ln P that is linear in the number of merges: −Σ ln q_s for each, as it removes one object."""
        total = float(np.log(_per_source(self.q, pooled, "q")).sum())
        return Terms({"linear prior": Linear(total, np.full(len(pooled), -total))})

    def table(self, pooled: PooledRecords, records: int) -> FloatArray:
        """(records,) ln P of 0, 1, … merges in a group of so many records, minus that of 0 and the linear part."""
        from scipy.special import gammaln

        n = records - np.arange(records, dtype=np.float64)
        log_p = gammaln(n + 1) - (n + 1) * math.log1p(-float(np.prod(_per_source(self.q, pooled, "q"))))
        return np.asarray(log_p - log_p[:1])


SetRule = ObjectsRule | SetRules | Rule
SetPrior = MissedObjects | PerPair


def terms_of(rule: SetRule, prior: SetPrior, pooled: PooledRecords) -> Terms:
    """The terms of a rule and of the linear part of a prior."""
    positions, attributes = parts_of(rule)
    by_pair = tuple(_attribute_terms(part, pooled) for part in attributes)
    return positions.terms(pooled) + Terms({}, by_pair) + _prior_terms(prior, pooled)


def parts_of(rule: SetRule) -> tuple[ObjectsRule, tuple[Rule, ...]]:
    """The rule on positions, and the rules on attributes.

    Raises
    ------
    InputError : no rule, or more than one, is on positions; a rule is for two sources only.
    """
    objects: ObjectsRule | None = None
    rules: tuple[Rule, ...] = ()
    if isinstance(rule, SetRules):
        objects, rules = rule.objects, rule.attributes
    elif isinstance(rule, Rule):
        rules = rule.parts()
    elif isinstance(rule, ObjectsRule):
        objects = rule
    else:
        raise InputError(f"identify_many: rule is a {type(rule).__name__}; give PoissonObjects(…) or CloseObjects(…)")
    for part in rules:
        if isinstance(part, OF_TWO_SOURCES):
            raise InputError(_two_sources(part))
    pairwise = [part for part in rules if isinstance(part, CloseObjects | Field)]
    if len(pairwise) + (objects is not None) > 1:
        raise InputError("identify_many: both rules use positions; give one of them")
    if objects is None and not pairwise:
        names = " + ".join(type(part).__name__ for part in rules)
        raise InputError(f"identify_many: {names} does not use positions; add it to PoissonObjects(density, q)")
    attributes = tuple(part for part in rules if not isinstance(part, CloseObjects | Field))
    return objects or Pairwise(pairwise[0]), attributes


def _attribute_terms(rule: Rule, pooled: PooledRecords) -> PairTerms:
    """The terms of a rule on attributes."""
    terms = PairTerms.of(rule, pooled, best_reference)
    if "position" in terms.terms:
        raise InputError(f"identify_many: both {type(rule).__name__} and the rule it is added to use positions")
    return terms


def _prior_terms(prior: SetPrior, pooled: PooledRecords) -> Terms:
    if isinstance(prior, MissedObjects):
        return prior.terms(pooled)
    if not isinstance(prior, PerPair):
        raise InputError(
            f"identify_many: prior is a {type(prior).__name__}; give MissedObjects(q) or PerPair(log_odds)"
        )
    if prior.log_odds == 0.0:
        return Terms({})
    # A set of k records has k − 1 merges, each with the pair's odds.
    return Terms({"prior": Linear(-prior.log_odds, np.full(len(pooled), prior.log_odds))})


def _two_sources(rule: Rule) -> str:
    return (
        f"identify_many: {type(rule).__name__} is for two sources; give PoissonObjects(density, q), "
        "CloseObjects(a, b), or Field(density) with one number"
    )


def _probabilities(q: ArrayLike, name: str) -> None:
    values = np.asarray(q, dtype=np.float64)
    if values.ndim > 1 or not np.all((values > 0.0) & (values < 1.0)):
        raise InputError(f"{name}: q is {q!r}; give per source the probability of a miss, strictly between 0 and 1")


def _per_source(values: float | Sequence[float] | FloatArray, pooled: PooledRecords, name: str) -> FloatArray:
    """(S,) the values in the order of the pooled records' sources."""
    array = np.asarray(values, dtype=np.float64)
    if array.ndim and len(array) != len(pooled.sources):
        raise InputError(
            f"{name} has {len(array)} numbers for {len(pooled.sources)} sources; give one, or one a source"
        )
    return np.broadcast_to(array, len(pooled.sources))[list(pooled.given)]

"""Terms: the weight of sets of records beside the joint density of their positions, each part by its name.

A set T of k ≥ 2 records weighs, against all of its records being objects of their own,

    ln w(T) = ln J(T) + Σ over the linear terms (constant + Σ_{i∈T} gain_i) + Σ over the rules of pairs Σ c_ij ln r_ij,

with J of :mod:`sameas.many.joint`; one record alone weighs 0. A rule compares two records, so the pairs of a set of k
are redundant: k − 1 comparisons are enough. The shares c_ij of its pairs are

- :func:`best_reference`, for attributes. If the object has the attributes of record h, every other record is compared
  with h alone: λ(T) = Σ_θ p(θ) ∏ p(v_i|θ)/p(v_i) ≈ max_h ∏_{i≠h} r_hi. A third record with the same attribute adds
  once, and one that contradicts two others counts against once.
- :func:`mean_of_pairs`, for the density of unrelated records: (k − 1) times the mean over the pairs.

Both are the rule itself for two records.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.errors import InputError
from sameas.evidence import Evidence
from sameas.gate import Pairs
from sameas.many.pooled import PooledRecords
from sameas.representation import in_short


@in_short
@dataclass(frozen=True)
class Linear:
    """A constant of every set, and a gain (n,) of each of its records."""

    constant: float
    gain: FloatArray


#: (k, pairs) shares of the pairs of k sets of one size, from ln r of the pairs and whether the rule is informative.
Shares = Callable[[FloatArray, BoolArray], FloatArray]


def best_reference(log_ratio: FloatArray, informative: BoolArray) -> FloatArray:
    """Share 1 for the pairs of one reference: of the records compared with all others the one of largest Σ ln r.

    Records may lack attributes, so that the rule is informative for some pairs only. Where no record is compared with
    all the others (a chain), pairs have the share min(1, (k_s − 1)/n_s), k_s of the records being in n_s informative
    pairs. log_ratio is 0 where the rule is not informative.
    """
    if informative.shape[1] <= 1:
        return np.ones(informative.shape)
    ends = _ends(informative.shape[1])
    compared = informative.astype(np.float64) @ ends
    records, pairs = np.count_nonzero(compared, axis=1), np.count_nonzero(informative, axis=1)
    with_all = (compared > 0) & (compared == records[:, None] - 1)
    total = np.where(with_all, log_ratio @ ends, -np.inf)
    shares: FloatArray = ends.T[total.argmax(axis=1)]
    chain = ~with_all.any(axis=1)
    shares[chain] = np.clip((records - 1.0) / np.maximum(pairs, 1), 0.0, 1.0)[chain, None]
    return np.asarray(shares)


def mean_of_pairs(log_ratio: FloatArray, informative: BoolArray) -> FloatArray:
    """Every pair with the share (k − 1) / (k (k − 1)/2)."""
    return np.full(log_ratio.shape, 2.0 / _size(log_ratio.shape[1]))


@in_short
@dataclass(frozen=True)
class PairTerms:
    """A rule for every pooled pair: (m,) named terms of ln r, whether it is informative, and the shares of the pairs in
    larger sets."""

    terms: Mapping[str, FloatArray]
    informative: BoolArray
    shares: Shares

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
        for pairs, place in pooled.parts:
            evidence = rule(pairs)
            for name, values in evidence.terms.items():
                wrong = np.flatnonzero(~np.isfinite(values))
                if len(wrong):
                    raise InputError(_not_finite(name, pairs, int(wrong[0]), values))
                terms.setdefault(name, np.zeros(m))[place] = values
            informative[place] = evidence.informative
        return cls(terms, informative, shares)

    @cached_property
    def log_ratio(self) -> FloatArray:
        """(m,) ln r."""
        return Evidence(self.terms).log_ratio if self.terms else np.zeros(len(self.informative))

    def shares_of(self, pairs: IntArray) -> FloatArray:
        """(k, pairs) the shares c of the pairs of sets of one size, given in the order of :func:`pairs_of`."""
        return self.shares(self.log_ratio[pairs], self.informative[pairs])

    def of_sets(self, pairs: IntArray) -> FloatArray:
        """(k,) ln of the rule's factor of the sets."""
        return np.asarray((self.shares_of(pairs) * self.log_ratio[pairs]).sum(axis=1))


@in_short
@dataclass(frozen=True)
class Terms:
    """Linear terms by name, and rules of pairs: see the module."""

    linear: Mapping[str, Linear]
    between: tuple[PairTerms, ...] = ()

    def __add__(self, other: Terms) -> Terms:
        return Terms({**self.linear, **other.linear}, self.between + other.between)

    def gain(self, pooled: PooledRecords) -> FloatArray:
        """(n,) the gain of every pooled record by the linear terms."""
        return _sum(len(pooled), (part.gain for part in self.linear.values()))

    def linear_of(self, records: IntArray) -> FloatArray:
        """(k,) the linear terms of sets (k, size) of records."""
        return _sum(len(records), (part.constant + part.gain[records].sum(axis=1) for part in self.linear.values()))

    def between_of(self, pairs: IntArray) -> FloatArray:
        """(k,) the terms of the rules of pairs, of sets given by their pairs in the order of :func:`pairs_of`."""
        return _sum(len(pairs), (rule.of_sets(pairs) for rule in self.between))

    def most_between(self, pooled: PooledRecords) -> FloatArray:
        """(g,) upper bound of what a record after a set's first adds by the rules of pairs, group by group; 0 or more.

        The shares of the informative pairs of k records add to k − 1 at most, so a rule adds at most
        (k − 1) max ln r_ij.
        """
        most = np.zeros(len(pooled.sizes))
        for rule in self.between:
            highest = np.zeros(len(most))
            np.maximum.at(highest, pooled.group[pooled.i], rule.log_ratio)
            most += highest
        return most

    def by_name(self, records: IntArray, pairs: IntArray) -> dict[str, FloatArray]:
        """(k,) each term of sets (k, size) of records and their pairs; their sum is ln w − ln J."""
        out = {name: part.constant + part.gain[records].sum(axis=1) for name, part in self.linear.items()}
        for rule in self.between:
            shares = rule.shares_of(pairs)
            for name, values in rule.terms.items():
                out[name] = out.get(name, np.zeros(len(pairs))) + (shares * values[pairs]).sum(axis=1)
        return out


def pairs_of(pooled: PooledRecords, records: IntArray) -> IntArray:
    """(k, size (size − 1)/2) the pairs of sets (k, size) of records, ascending, all of which are pooled pairs.

    A column's later record grows first: (0, 1), (0, 2), (1, 2), (0, 3), …; so a set that grows keeps its columns.
    """
    later, earlier = np.tril_indices(records.shape[1], -1)
    return pooled.pair(records[:, earlier], records[:, later])[1]


def _sum(n: int, parts: Iterable[FloatArray]) -> FloatArray:
    """(n,) the sum of any number of parts."""
    total = np.zeros(n)
    for part in parts:
        total += part
    return total


def _size(n_pairs: int) -> int:
    """Number of records of a set with so many pairs."""
    return (1 + math.isqrt(1 + 8 * n_pairs)) // 2


@cache
def _ends(n_pairs: int) -> FloatArray:
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

"""Terms: what sets of records weigh beside the joint density of their positions, each part by its name.

A set T of k ≥ 2 records weighs, against all of its records being objects of their own,

    ln w(T) = ln J(T) + Σ over the linear terms (constant + Σ_{i∈T} gain_i) + Σ over the rules of pairs Σ c_ij ln r_ij,

with J of :mod:`sameas.many.joint`; one record alone weighs 0. A rule compares two records, so in a set of k its pairs
repeat each other: k − 1 comparisons say all. The shares c_ij that it gets are

- :func:`best_word`, for what records say of themselves. If the object is what record h says, every other record is
  compared with h alone: λ(T) = Σ_θ p(θ) ∏ p(v_i|θ)/p(v_i) ≈ max_h ∏_{i≠h} r_hi. A third record that says the same adds
  once, and one that contradicts two others speaks against once.
- :func:`mean_of_pairs`, for the density of strangers: (k − 1) times the mean over the pairs.

Both are the rule itself for two records.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.errors import InputError
from sameas.evidence import Evidence
from sameas.gate import Pairs
from sameas.many.pooled import PooledRecords


@dataclass(frozen=True)
class Linear:
    """A constant of every set, and a gain (n,) of each of its records."""

    constant: float
    gain: FloatArray


#: (k, pairs) shares of the pairs of k sets of one size, from ln r of the pairs and whether the rule speaks of them.
Shares = Callable[[FloatArray, BoolArray], FloatArray]


def best_word(log_ratio: FloatArray, spoken: BoolArray) -> FloatArray:
    """Every record that speaks compared with one that is compared with all of them, the one that says most.

    Records may say different things of themselves, so that some speak with none and no pair of theirs is spoken of;
    where none is compared with all the others (a chain), pairs have the share min(1, (k_s − 1)/n_s), k_s of the
    records being in n_s pairs that the rule speaks of. log_ratio is 0 where it does not.
    """
    if spoken.shape[1] <= 1:
        return np.ones(spoken.shape)
    ends = _ends(spoken.shape[1])
    compared = spoken.astype(np.float64) @ ends
    voices, pairs = np.count_nonzero(compared, axis=1), np.count_nonzero(spoken, axis=1)
    with_all = (compared > 0) & (compared == voices[:, None] - 1)
    total = np.where(with_all, log_ratio @ ends, -np.inf)
    shares = ends.T[total.argmax(axis=1)]
    chain = ~with_all.any(axis=1)
    shares[chain] = np.clip((voices - 1.0) / np.maximum(pairs, 1), 0.0, 1.0)[chain, None]
    return shares


def mean_of_pairs(log_ratio: FloatArray, spoken: BoolArray) -> FloatArray:
    """Every pair with the share (k − 1) / (k (k − 1)/2)."""
    return np.full(log_ratio.shape, 2.0 / _size(log_ratio.shape[1]))


@dataclass(frozen=True)
class PairTerms:
    """What a rule says of every pooled pair: (m,) named terms of ln r, whether it speaks of it, and the shares
    that pairs of larger sets have."""

    terms: Mapping[str, FloatArray]
    spoken: BoolArray
    shares: Shares

    @classmethod
    def of(cls, rule: Callable[[Pairs], Evidence], pooled: PooledRecords, shares: Shares) -> PairTerms:
        """What ``rule`` says of the pairs of every two sources.

        Raises
        ------
        InputError : a term is not finite.
        """
        m = len(pooled.i)
        terms: dict[str, FloatArray] = {}
        spoken = np.zeros(m, bool)
        for pairs, place in pooled.parts:
            evidence = rule(pairs)
            for name, values in evidence.terms.items():
                wrong = np.flatnonzero(~np.isfinite(values))
                if len(wrong):
                    raise InputError(_not_finite(name, pairs, int(wrong[0]), values))
                terms.setdefault(name, np.zeros(m))[place] = values
            spoken[place] = evidence.informative
        return cls(terms, spoken, shares)

    @cached_property
    def log_ratio(self) -> FloatArray:
        """(m,) ln r."""
        return Evidence(self.terms).log_ratio if self.terms else np.zeros(len(self.spoken))

    def shares_of(self, pairs: IntArray) -> FloatArray:
        """(k, pairs) the shares c of the pairs of sets of one size, given in the order of :func:`pairs_of`."""
        return self.shares(self.log_ratio[pairs], self.spoken[pairs])

    def of_sets(self, pairs: IntArray) -> FloatArray:
        """(k,) what the rule says of the sets."""
        return np.asarray((self.shares_of(pairs) * self.log_ratio[pairs]).sum(axis=1))


@dataclass(frozen=True)
class Terms:
    """Linear terms by name, and rules of pairs: see the module."""

    linear: Mapping[str, Linear]
    between: tuple[PairTerms, ...] = ()

    def __add__(self, other: Terms) -> Terms:
        return Terms({**self.linear, **other.linear}, self.between + other.between)

    def gain(self, pooled: PooledRecords) -> FloatArray:
        """(n,) what each record of the pooled records adds by the linear terms."""
        return np.sum([np.zeros(len(pooled)), *(part.gain for part in self.linear.values())], axis=0)

    def linear_of(self, records: IntArray) -> FloatArray:
        """(k,) the linear terms of sets (k, size) of records."""
        parts = [part.constant + part.gain[records].sum(axis=1) for part in self.linear.values()]
        return np.sum([np.zeros(len(records)), *parts], axis=0)

    def between_of(self, pairs: IntArray) -> FloatArray:
        """(k,) what the rules of pairs say of sets, given by their pairs in the order of :func:`pairs_of`."""
        return np.sum([np.zeros(len(pairs)), *(rule.of_sets(pairs) for rule in self.between)], axis=0)

    def most_between(self, pooled: PooledRecords) -> FloatArray:
        """(g,) more than which no record after a set's first adds by the rules of pairs, group by group; 0 or more.

        The shares of the pairs of k records that a rule speaks of add to k − 1 at most: it says (k − 1) max ln r_ij at
        most.
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

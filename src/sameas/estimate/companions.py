"""Companions: binaries and groups, whose objects lie nearer to each other than those of a Poisson field.

If the other source misses a record's object but shows its companion, that companion looks like the record's partner.
The density of companions of an object, n κ(u) at a displacement u, is that of :mod:`sameas.estimate.clustering`; c₁ and
c₂ are the shares of objects with companions that the sources show. With k other companions shown, and x = 1 − q₁q₂ the
probability that one is shown at all, the density of different objects near a record (ρ for a Poisson field) is ρ +
G⁽ᵏ⁺¹⁾/G⁽ᵏ⁾ κ, where G is the generating function of the number of companions at q₁q₂ = 1 − x: binomial if few objects
have more than one companion, else Poisson for a part of the objects.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from sameas.arrays import ABSENT, FloatArray, IntArray, places_in
from sameas.estimate.clustering import (
    COMPANIONS_REACH,
    COMPETING_SQ,
    MIN_VOID,
    Clustering,
    ScaledSource,
    scaled_sources,
)
from sameas.estimate.sample import Setting
from sameas.evidence.rule import Evidence, Rule
from sameas.gate import Pairs
from sameas.ragged import Ragged


@dataclass(frozen=True)
class CompanionsRule(Rule):
    """The rule whose evidence for the pairs at ``index`` is ``term`` (q,), and 0 for the others."""

    index: IntArray
    term: FloatArray

    def __call__(self, pairs: Pairs) -> Evidence:
        out = np.zeros(len(pairs))
        out[self.index] = self.term
        return Evidence({"companions": out})


@dataclass(frozen=True)
class Companions:
    """Companions among one list of candidates.

    index : (q,) pairs that companions matter for. excess : (q,) w at their residuals, by the local densities.
    companion_odds : (2, q) odds, in a Poisson field, that their record of each source has a companion at its position.
    log_swap : (q,) evidence from the separations of companions for which record is which.
    """

    clustering: Clustering
    index: IntArray
    excess: FloatArray
    companion_odds: FloatArray
    log_swap: FloatArray = field(repr=False)

    @classmethod
    def of(cls, clustering: Clustering, setting: Setting) -> Companions:
        """The companions among all candidates of a setting."""
        pairs, unit = setting.pairs, clustering.unit
        one, two = scaled_sources(setting, unit)
        residual = pairs.residual / unit
        local = clustering.mean_densities[0] / one.density, clustering.mean_densities[1] / two.density
        excess = clustering.excess_at(np.sqrt((residual**2).sum(axis=1)), one.variance[pairs.i] + two.variance[pairs.j])
        excess *= np.sqrt(local[0][pairs.i] * local[1][pairs.j])
        if clustering.level is not None:
            denser = np.log(np.maximum(clustering.level + excess, 1.0))
            index = np.flatnonzero(denser > 1e-3)
            return cls(clustering, index, excess[index], np.zeros((2, len(index))), -denser[index])
        odds, companion = [], []
        for source, relative in zip((one, two), local, strict=True):
            i, k, distance = source.neighbours(COMPANIONS_REACH)
            variance = source.variance[i] + source.variance[k]
            w = clustering.excess_at(distance, variance) * np.sqrt(relative[i] * relative[k])
            odds.append(np.bincount(i, w, len(source.points)))
            companion.append(_mutual_companions(i, k, w / (1.0 + w), len(source.points)))
        log_swap = _log_swaps(clustering, setting, (one, two), residual, companion, COMPETING_SQ)
        index = np.flatnonzero((excess > 1e-3) | (log_swap != 0.0))
        companion_odds = np.array([odds[0][pairs.i[index]], odds[1][pairs.j[index]]], np.float64)
        return cls(clustering, index, excess[index], companion_odds, log_swap[index])

    @property
    def share(self) -> float:
        """Share of source 1's records that have a partner, from close pairs and companions."""
        return self.clustering.shares[0]

    @property
    def rule(self) -> CompanionsRule:
        """Evidence from the separations of companions."""
        return CompanionsRule(self.index, self.log_swap)

    def companion_log_odds(self, n: int, share_1: float, share_2: float) -> FloatArray:
        """(n,) ln of the odds, before one-to-one, that a pair is an object and its companion, each missed by the other
        source, against two unrelated objects; −∞ where companions do not matter.

        share_1, share_2 : of the records of each source that have a partner.
        """
        clustering, least = self.clustering, MIN_VOID
        (mean_1, mean_2), (known_1, known_2) = clustering.mean_densities, clustering.shares
        # At least the shares from close pairs: the shares of early EM iterations are too low, which would make
        # companions seem numerous, and that would keep the shares low.
        c1, c2 = max(share_2, known_2, 1e-3), max(share_1, known_1, 1e-3)
        number = float(clustering.volume.sum()) * math.sqrt(mean_1 * mean_2 / (c1 * c2))
        # For integers n with mean N, the mean of n (n − 1) is at least N (N − 1).
        x, t = 1.0 - (1.0 - c1) * (1.0 - c2), max(clustering.multiplicity, 1.0 - 1.0 / max(number, 1e-9))
        if t < 1.0:
            p = number * (1.0 - t)
            void = max(1.0 - p * x, least)
            none, one = 1.0 / void, t / void
            per_odds = 1.0 / max(1.0 - p * c1, least), 1.0 / max(1.0 - p * c2, least)
        else:
            unseen = math.exp(-number * t * x)
            none, one = unseen / (1.0 - 1.0 / t + unseen / t), t
            per_odds = none, none
        alone = 1.0 / ((1.0 + per_odds[0] * self.companion_odds[0]) * (1.0 + per_odds[1] * self.companion_odds[1]))
        out = np.full(n, -np.inf)
        with np.errstate(divide="ignore"):
            out[self.index] = np.log((one + (none - one) * alone) * self.excess)
        return out


def _mutual_companions(i: IntArray, k: IntArray, p: FloatArray, n: int) -> IntArray:
    """(n,) the companion of each record: mutually the most probable, with p > 0.5; ABSENT if none."""
    likely = np.flatnonzero(p > 0.5)
    order = likely[np.argsort(p[likely], kind="stable")]
    most_probable = np.full(n, ABSENT)
    most_probable[i[order]] = k[order]
    has = np.flatnonzero(most_probable >= 0)
    mutual = most_probable[most_probable[has]] == has
    out = np.full(n, ABSENT)
    out[has[mutual]] = most_probable[has[mutual]]
    return out


def _log_swaps(
    clustering: Clustering,
    setting: Setting,
    sources: tuple[ScaledSource, ScaledSource],
    residual: FloatArray,
    companion: list[IntArray],
    competing_sq: float,
) -> FloatArray:
    """(m,) evidence of pairs from the separation of companions, where two companions of one source compete for one or
    two records of the other source, and for no more."""
    pairs = setting.pairs
    i, j = pairs.i.astype(np.int64), pairs.j.astype(np.int64)
    near = pairs.mahalanobis_sq < competing_sq
    swaps = _Swaps(clustering, i, j, (sources[0].variance, sources[1].variance), residual)
    competing = [
        _Competing.of(mate, own[near], other[near]) for mate, own, other in zip(companion, (i, j), (j, i), strict=True)
    ]
    two_to_two = np.array([swaps.two_to_two(source, one) for source, one in enumerate(competing)])
    two_to_one = np.array([swaps.two_to_one(source, one) for source, one in enumerate(competing)])
    n_terms = np.count_nonzero(two_to_two, axis=0)
    mean = two_to_two.sum(axis=0) / np.maximum(n_terms, 1)
    return np.asarray(np.where(n_terms > 0, mean, two_to_one.sum(axis=0)))


@dataclass(frozen=True)
class _Competing:
    """Two companions of one source, and the records of the other source that either could have as partner.

    first, second : (c,) the companions. others : (m,) the records of the other source, companions by companions.
    rows : of these.
    """

    first: IntArray
    second: IntArray
    others: IntArray
    rows: Ragged

    @classmethod
    def of(cls, companion: IntArray, own: IntArray, other: IntArray) -> _Competing:
        """companion : (n,) of each record, ABSENT for none. own, other : (p,) the records of the pairs that compete."""
        first = np.flatnonzero(companion > np.arange(len(companion)))
        second = companion[first]
        number = np.full(len(companion), ABSENT)
        number[first] = number[second] = np.arange(len(first))
        has = number[own] >= 0
        competing = np.unique(np.column_stack([number[own[has]], other[has]]), axis=0)
        return cls(first, second, competing[:, 1], Ragged.of_sorted(competing[:, 0], len(first)))

    def with_others(self, number: int) -> tuple[IntArray, ...]:
        """The companions that compete for this number of records: first, second, and each of these records."""
        c = np.flatnonzero(self.rows.sizes == number)
        return self.first[c], self.second[c], *(self.others[self.rows.start[c] + k] for k in range(number))


@dataclass(frozen=True)
class _Swaps:
    """Evidence of pairs from the separations of companions.

    i, j : (m,) records of the pairs. variance : (n₁,), (n₂,) per axis. residual : (m, 2).
    """

    clustering: Clustering
    i: IntArray
    j: IntArray
    variance: tuple[FloatArray, FloatArray]
    residual: FloatArray

    @cached_property
    def _index(self) -> _PairIndex:
        return _PairIndex.of(self.i, self.j, len(self.variance[1]))

    def _pair(self, source: int, own: IntArray, other: IntArray) -> IntArray:
        """(k,) pairs of records of a source (0 or 1) with records of the other one, ABSENT if not a candidate."""
        return self._index(own, other) if source == 0 else self._index(other, own)

    def _log_w(self, separation: FloatArray, variance: FloatArray) -> FloatArray:
        return np.log1p(self.clustering.excess_at(np.sqrt((separation**2).sum(axis=1)), variance))

    def _fused(self, e: IntArray) -> tuple[FloatArray, FloatArray]:
        """Fused position of each pair relative to its record 1, and its variance."""
        v1, v2 = self.variance[0][self.i[e]], self.variance[1][self.j[e]]
        return (v1 / (v1 + v2))[:, None] * self.residual[e], v1 * v2 / (v1 + v2)

    def two_to_two(self, source: int, competing: _Competing) -> FloatArray:
        """(m,) evidence of the pairs of two companions of a source (0 or 1) with two records."""
        out, residual = np.zeros(len(self.i)), self.residual
        one, two, r, q = competing.with_others(2)
        four = np.array([self._pair(source, own, other) for own, other in ((one, r), (two, q), (one, q), (two, r))])
        a, b, x, y = four[:, (four >= 0).all(axis=0)]
        if not len(a):
            return out
        # Separation of the two records of source 1, from the residuals of two pairs with one record of source 2.
        (at_a, v_a), (at_b, v_b), (at_x, v_x), (at_y, v_y) = map(self._fused, (a, b, x, y))
        if source == 0:
            separation = residual[y] - residual[a]
            straight, crossed = separation - at_b + at_a, separation - at_y + at_x
        else:
            separation = residual[x] - residual[a]
            straight, crossed = separation - at_b + at_a, separation - at_x + at_y
        term = 0.25 * (self._log_w(straight, v_a + v_b) - self._log_w(crossed, v_x + v_y))
        for e, sign in ((a, 1.0), (b, 1.0), (x, -1.0), (y, -1.0)):
            out[e] = sign * term
        return out

    def two_to_one(self, source: int, competing: _Competing) -> FloatArray:
        """(m,) evidence of the pairs of two companions of a source (0 or 1) with one record."""
        out, residual = np.zeros(len(self.i)), self.residual
        one, two, r = competing.with_others(1)
        both = np.array([self._pair(source, one, r), self._pair(source, two, r)])
        a, b = both[:, (both >= 0).all(axis=0)]
        if not len(a):
            return out
        sign = 1.0 if source == 0 else -1.0
        records = (self.i, self.j)
        own, other = (self.variance[k][records[k]] for k in (source, 1 - source))  # of each pair
        separation = sign * (residual[b] - residual[a])
        w_a, w_b = (own[e] / (own[e] + other[e]) for e in (a, b))
        with_a = self._log_w(separation + sign * residual[a] * w_a[:, None], w_a * other[a] + own[b])
        with_b = self._log_w(-separation + sign * residual[b] * w_b[:, None], w_b * other[b] + own[a])
        term = 0.5 * (with_a - with_b)
        out[a], out[b] = term, -term
        return out


@dataclass(frozen=True)
class _PairIndex:
    """Index of a pair by its two records."""

    order: IntArray
    key: IntArray
    n2: int

    @classmethod
    def of(cls, i: IntArray, j: IntArray, n2: int) -> _PairIndex:
        key = i * n2 + j
        order = np.argsort(key)
        return cls(order, key[order], n2)

    def __call__(self, i: IntArray, j: IntArray) -> IntArray:
        """(k,) indices of pairs; ABSENT if not a candidate."""
        place = places_in(self.key, i * self.n2 + j)
        return np.asarray(np.where(place >= 0, self.order[place], ABSENT))

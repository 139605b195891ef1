"""Bernoulli objects: a rule for objects some of which are known beforehand, each with its probability of existing.

Unknown objects are a Poisson field, as for :class:`sameas.many.rules.PoissonObjects`; the known ones are the records of
one more source, predicted states with their covariances. Unlike there a miss depends on where the object is,
and for a known object on the object: a camera that has not seen this boat will not see it now. With r_i the probability
that known object i exists, and A the records of it,

    w({i} ∪ A) = r_i ∏_{s∈A} (1−q_is) ∏_{s∉A} q_is J(i, A)/J(i),    w({i}) = 1 − r_i + r_i ∏_s q_is,
    w(A) = ρ ∏_{s∈A} (1−q_s) ∏_{s∉A} q_s J(A) for others,           w({z}) = ρ (1−q_s) ∏_{t≠s} q_t J(z) + β_s,

the local hypotheses of Poisson multi-Bernoulli filters (Williams 2015, IEEE Trans. AES 51, 1664), with J of
:mod:`sameas.many.joint`. ln q_s is that of the place of each record, in the mean over those of A.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.gate import ChiSquare
from sameas.gaussian import log_density, mahalanobis_sq
from sameas.many.observations import records_of
from sameas.many.pooled import PooledRecords
from sameas.many.rules import ObjectsRule
from sameas.many.terms import Linear, PairTerms, Terms, best_word, mean_of_pairs
from sameas.picture.object_table import ObjectTable
from sameas.records import Records

#: Name of the source whose records are the known objects.
KNOWN = "known objects"


def log_odds(q: FloatArray) -> FloatArray:
    """ln((1 − q)/q)."""
    return np.asarray(np.log1p(-q) - np.log(q))


@dataclass(frozen=True)
class BernoulliObjects(ObjectsRule):
    """See the module.

    Parameters
    ----------
    density : ρ, unknown objects per unit volume of the state at the centre of the region.
    sources : names of the sources that scan, those that show nothing among them: the columns of the tables of q.
    q : by source the table (rows of its records, sources) of probabilities that an object there is missed.
    false : by source β, false records per unit volume of its features.
    existence : (n,) r of each record of the source :data:`KNOWN`, 0 < r < 1. known_q : (n, sources).
    """

    density: float
    sources: tuple[str, ...]
    q: Mapping[str, FloatArray]
    false: Mapping[str, float]
    existence: FloatArray
    known_q: FloatArray

    def terms(self, pooled: PooledRecords) -> Terms:
        """The terms of the records and pairs of ``pooled``."""
        parts = self._parts(pooled)
        gain = np.where(parts.known, np.log(self._existing_unseen(pooled)), parts.missed + parts.seen - parts.alone)
        i, j = pooled.i, pooled.j
        with_known = parts.known[i] | parts.known[j]
        known, record = np.where(parts.known[i], i, j), np.where(parts.known[i], j, i)
        # Of what every record says of all misses a set without a known object has the mean, with one nothing.
        missed = np.where(with_known, -parts.missed[record], -0.5 * (parts.missed[i] + parts.missed[j]))
        own = np.zeros(len(i))
        at = np.flatnonzero(with_known)
        if len(at):
            q = self.known_q[parts.row[known[at]], parts.column[record[at]]]
            own[at] = log_odds(q) - parts.seen[record[at]]
        everywhere = np.ones(len(i), bool)
        gain = np.where(parts.known, gain, gain + parts.log_j)
        rules = (
            PairTerms({"misses": missed}, everywhere, mean_of_pairs),
            PairTerms({"seen before": own}, with_known, best_word),
        )
        return Terms({"position": Linear(0.0, -parts.log_j), "densities": Linear(0.0, gain)}, rules)

    def exists(self, pooled: PooledRecords) -> FloatArray:
        """(records,) the probability that there is an object, of each pooled record that has no partner."""
        parts = self._parts(pooled)
        share = np.exp(np.minimum(parts.missed + parts.seen + parts.log_j - parts.alone, 0.0))
        return np.where(parts.known, self._existing_unseen(pooled), share)

    def _existing_unseen(self, pooled: PooledRecords) -> FloatArray:
        """(records,) r of known objects that every scan has missed; 1 for other records."""
        out = np.ones(len(pooled))
        for s, source in enumerate(pooled.sources):
            if records_of(source).source == KNOWN and len(records_of(source)):
                rows = records_of(source).rows
                r, missed = self.existence[rows], self.known_q[rows].prod(axis=1)
                out[pooled.start[s] : pooled.start[s + 1]] = r * missed / (1.0 - r + r * missed)
        return out

    def _parts(self, pooled: PooledRecords) -> _Parts:
        n = len(pooled)
        sets = np.full((n, len(pooled.sources)), -1)
        sets[np.arange(n), pooled.source] = np.arange(n)
        log_j = pooled.observers.joint(pooled.positions(sets)).log_density
        missed, seen, false = np.zeros(n), np.zeros(n), np.zeros(n)
        known, row, column = np.zeros(n, bool), np.zeros(n, np.int64), np.full(n, -1)
        for s, source in enumerate(pooled.sources):
            here, records = slice(pooled.start[s], pooled.start[s + 1]), records_of(source)
            row[here] = records.rows
            if records.source == KNOWN:
                known[here] = True
                continue
            column[here] = self.sources.index(records.source)
            q = self.q[records.source][records.rows]
            missed[here] = math.log(self.density) + np.log(q).sum(axis=1)
            seen[here] = log_odds(q[:, self.sources.index(records.source)])
            false[here] = self.false[records.source]
        with np.errstate(divide="ignore"):
            alone = np.logaddexp(missed + seen + log_j, np.log(false))
        return _Parts(log_j, missed, seen, np.where(known, 0.0, alone), known, row, column)


@dataclass(frozen=True)
class _Parts:
    """Per pooled record (n,): ln J of it alone, ln ρ∏q where it is, ln((1−q)/q) of its own source there, ln w of it
    alone; whether it is a known object, its row in its table, and its source's column (−1 for known objects)."""

    log_j: FloatArray
    missed: FloatArray
    seen: FloatArray
    alone: FloatArray
    known: BoolArray
    row: IntArray
    column: IntArray


#: Bounds of probabilities of existing: what is certain could never be unlearned.
LEAST = 1e-6
#: Bound of what scans say of two objects being two, ± ln odds.
APART = 5.0
#: Two objects are made one at these ln odds.
SURE = 3.0
#: Positions differ beyond this: that the two are two needs no scans. States agree within: they may be one.
DIFFERENT, AGREEING = ChiSquare(1.0 - 1e-6), ChiSquare(0.99)


@dataclass(frozen=True)
class Sighting:
    """What the scans that are over made of the known objects.

    p_detected : (m, S) probability that a record of the source, in a scan that is over, is of the object.
    scans : (S,) how many scans of the source are over: 1 or 0, a part of a rotation for a source that turns.
    q : (m, S) probability of a miss that was expected.
    """

    p_detected: FloatArray
    scans: FloatArray
    q: FloatArray


@dataclass(frozen=True)
class BernoulliTable(ObjectTable):
    """The known objects, (m,) each: what scans that are over say of them, every scan counted once.

    A source that has missed an object six times is not expected to show it now, so every object has its own counts of
    hits and misses. Two objects at one place that no scan has shown apart are one, listed twice (:meth:`merged`).

    existence : probability that it exists.
    hits, misses : (m, S) scans of each source that showed it, and that did not, older ones counting less.
    apart : (m, m) ln odds by the scans that two objects are two and not one.
    """

    WHOLE = frozenset({"apart"})
    existence: FloatArray = field(default_factory=lambda: np.empty(0))
    hits: FloatArray = field(default_factory=lambda: np.empty((0, 0)))
    misses: FloatArray = field(default_factory=lambda: np.empty((0, 0)))
    apart: FloatArray = field(default_factory=lambda: np.empty((0, 0)))

    @property
    def records(self) -> Records:
        """The objects as a source of their own, for ``identify_many``."""
        if not len(self):
            return Records.of(np.empty((0, 4)), sigma=1.0, source=KNOWN)
        return Records.of(self.state, covariance=self.covariance, source=KNOWN)

    @classmethod
    def none(cls, sources: int) -> BernoulliTable:
        """No objects, of so many sources."""
        nothing = np.empty((0, sources))
        return cls(hits=nothing, misses=nothing)

    @classmethod
    def born(
        cls, number: IntArray, state: FloatArray, covariance: FloatArray, existence: FloatArray, hits: FloatArray
    ) -> BernoulliTable:
        """Objects that are known for the first time."""
        apart = np.zeros((len(number), len(number)))
        sure = np.clip(existence, LEAST, 1.0 - LEAST)
        return cls(number, state, covariance, sure, hits, np.zeros_like(hits), apart)

    def take(self, which: NDArray[Any]) -> BernoulliTable:
        """Some of the objects: a mask (m,) or places."""
        return replace(super().take(which), apart=self.apart[which][:, which])

    def with_(self, more: BernoulliTable) -> BernoulliTable:
        """These and others."""
        apart = np.zeros((len(self) + len(more),) * 2)
        apart[: len(self), : len(self)], apart[len(self) :, len(self) :] = self.apart, more.apart
        return replace(self.stacked(more), apart=apart)

    def aged(self, dt_s: float, lifetime_s: float, memory_s: float) -> BernoulliTable:
        """The objects after dt: less probable by their lifetime, with hits and misses that count less."""
        older = math.exp(-dt_s / memory_s)
        existence = self.existence * math.exp(-dt_s / lifetime_s)
        return replace(self, existence=existence, hits=self.hits * older, misses=self.misses * older)

    def expected_q(self, usual_q: FloatArray, scans: float, least: float) -> FloatArray:
        """(m, S) probability of a miss: that of any object at its place, worth so many scans, and its own scans."""
        q = (scans * usual_q + self.misses) / (scans + self.misses + self.hits)
        return np.asarray(np.clip(q, least, 1.0 - least))

    def after(self, sighting: Sighting) -> BernoulliTable:
        """The existence, hits and misses of the objects after scans that are over; states stay."""
        detected, r = sighting.p_detected, self.existence
        missed = r * np.prod(sighting.q**sighting.scans, axis=1)
        unseen = np.prod(1.0 - detected, axis=1)
        r = 1.0 - unseen + unseen * missed / (1.0 - r + missed)
        return replace(
            self, existence=np.clip(r, LEAST, 1.0 - LEAST), hits=self.hits + detected,
            misses=self.misses + np.maximum(sighting.scans - detected, 0.0),
        )  # fmt: skip

    def told_apart(self, p_detected: FloatArray, usual_q: FloatArray, split: FloatArray) -> BernoulliTable:
        """The objects with what scans that are over say of any two being two.

        Where both are seen it is (1 − q)² if they are two, and (1 − q) and a split if they are one; where one of them
        is, (1 − q) q against 1 − q.

        p_detected : (m, S) as of :class:`Sighting`. usual_q : (m, S) probability that any object there is missed.
        split : (S,) probability that a scan of the source shows one object as two.
        """
        apart = self.apart.copy()
        for s in range(len(split)):
            log_q, log_both = np.log(usual_q[:, s]), np.log1p(-usual_q[:, s]) - math.log(split[s])
            p = p_detected[:, s]
            both, one = np.outer(p, p), np.outer(p, 1.0 - p)
            apart += 0.5 * both * (log_both[:, None] + log_both) + 0.5 * (one + one.T) * (log_q[:, None] + log_q)
        return replace(self, apart=np.clip(apart, -APART, APART))

    def merged(self, density_per_m2: float) -> BernoulliTable:
        """The objects without those that are listed twice; the lower number stays.

        Two are one where the place says more for it, ln N(Δ; 0, P + P′)/ρ, than the scans against it, by :data:`SURE`.
        The state of the one that was detected more often stays: the other may be the end of its hull.
        """
        objects = self
        while len(objects) > 1:
            for_one, agree, differ = objects._compared(density_per_m2)
            objects = replace(objects, apart=np.where(differ, 0.0, objects.apart))
            odds = np.where(agree, for_one - objects.apart, -np.inf)
            np.fill_diagonal(odds, -np.inf)
            i, j = sorted(np.unravel_index(int(odds.argmax()), odds.shape))
            if not odds[i, j] > SURE:
                break
            objects = objects._joined(int(i), int(j))
        return objects

    def _compared(self, density_per_m2: float) -> tuple[FloatArray, BoolArray, BoolArray]:
        """(m, m) ln N/ρ of positions, whether states agree, and whether positions differ."""
        delta = self.state[:, None] - self.state
        total = self.covariance[:, None] + self.covariance
        chi_sq, place = mahalanobis_sq(delta, total), mahalanobis_sq(delta[..., :2], total[..., :2, :2])
        log_n = log_density(delta[..., :2], total[..., :2, :2])
        return log_n - math.log(density_per_m2), chi_sq < AGREEING.limit(4), place > DIFFERENT.limit(2)

    def _joined(self, i: int, j: int) -> BernoulliTable:
        """Objects i and j as one, at i."""
        columns = {f.name: getattr(self, f.name).copy() for f in fields(self)}
        stays = max(i, j, key=lambda k: (self.existence[k] * self.hits[k].sum(), *self.state[k]))
        columns["state"][i], columns["covariance"][i] = self.state[stays], self.covariance[stays]
        columns["number"][i] = min(self.number[i], self.number[j])
        columns["existence"][i] = 1.0 - (1.0 - self.existence[i]) * (1.0 - self.existence[j])
        columns["hits"][i] = self.hits[i] + self.hits[j]
        columns["misses"][i] = np.minimum(self.misses[i], self.misses[j])
        return BernoulliTable(**columns).take(np.arange(len(self)) != j)

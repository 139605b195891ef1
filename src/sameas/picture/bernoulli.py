"""Bernoulli objects: a rule with known objects, each with a probability of existence, and unknown ones.

Unknown objects are a Poisson field, as for :class:`sameas.many.rules.PoissonObjects`; the known objects are the records
of an additional source: predicted states with covariances. In contrast to that rule, the miss probability depends on
the place, and for a known object on its own hits and misses: a camera that missed a boat six times will miss it again.
With r_i the probability that known object i exists, and A its records,

    w({i} ∪ A) = r_i ∏_{s∈A} (1−q_is) ∏_{s∉A} q_is J(i, A)/J(i),    w({i}) = 1 − r_i + r_i ∏_s q_is,
    w(A) = ρ ∏_{s∈A} (1−q_s) ∏_{s∉A} q_s J(A) for others,           w({z}) = ρ (1−q_s) ∏_{t≠s} q_t J(z) + β_s,

the local hypotheses of Poisson multi-Bernoulli filters (Williams 2015, IEEE Trans. AES 51, 1664), with J of
:mod:`sameas.many.observations`. ln q_s is the mean over the records of A of its values at their places.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import ABSENT, BoolArray, FloatArray, IntArray, places_in
from sameas.evidence.identity import FREQUENCY, MODELS
from sameas.gate import ChiSquare
from sameas.gaussian import log_density, mahalanobis_sq
from sameas.many.observations import records_of
from sameas.many.pooled import PooledRecords
from sameas.many.rules import Linear, ObjectsRule, PairTerms, Terms, best_reference, mean_of_pairs
from sameas.picture.tables import ObjectTable
from sameas.picture.tuning import Tuning
from sameas.records import Records

#: Name of the source whose records are the known objects.
KNOWN = "known objects"

#: Probabilities of existence are clipped to this distance from 0 and 1, so that later scans can change them.
MIN_PROBABILITY = 1e-6
MERGING_LOG_ODDS = 3.0  # two objects are merged at these log-odds
#: Two objects are separate, whatever the scans show, beyond the χ² limit with this share of equal ones below it.
DIFFERENT_QUANTILE = 1.0 - 1e-6
SAME_QUANTILE = 0.99  # states of two objects agree within the χ² limit that includes this share of equal ones


def log_odds(q: FloatArray) -> FloatArray:
    """ln((1 − q)/q)."""
    return np.asarray(np.log1p(-q) - np.log(q))


@dataclass(frozen=True)
class BernoulliObjects(ObjectsRule):
    """The rule of known and unknown objects; see the module.

    density : ρ, unknown objects per unit volume of the state at the centre of the region.
    sources : names of all sources, including those without records: the columns of the tables of q.
    q : by source, (rows of its records, sources) miss probabilities at the place of the record.
    false : by source, β, false records per unit volume of its features.
    existence : (n,) r of each record of the source :data:`KNOWN`, 0 < r < 1. known_q : (n, sources) its miss
        probabilities.
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
        gain = np.where(
            parts.is_known,
            np.log(self._existing_unseen(pooled)),
            parts.log_missed + parts.log_detected - parts.log_alone,
        )
        i, j = pooled.i, pooled.j
        has_known = parts.is_known[i] | parts.is_known[j]
        known_place, record = np.where(parts.is_known[i], i, j), np.where(parts.is_known[i], j, i)
        # ln ∏q of a set is the mean over its records; a known object has its own q instead.
        missed = np.where(has_known, -parts.log_missed[record], -0.5 * (parts.log_missed[i] + parts.log_missed[j]))
        own_log_odds = np.zeros(len(i))
        at = np.flatnonzero(has_known)
        if len(at):
            q = self.known_q[parts.row[known_place[at]], parts.column[record[at]]]
            own_log_odds[at] = log_odds(q) - parts.log_detected[record[at]]
        everywhere = np.ones(len(i), bool)
        gain = np.where(parts.is_known, gain, gain + parts.log_j)
        rules = (
            PairTerms({"misses": missed}, everywhere, mean_of_pairs),
            PairTerms({"seen before": own_log_odds}, has_known, best_reference),
        )
        return Terms({"position": Linear(0.0, -parts.log_j), "densities": Linear(0.0, gain)}, rules)

    def exists(self, pooled: PooledRecords) -> FloatArray:
        """(records,) probability of existence of each pooled record that has no partner."""
        parts = self._parts(pooled)
        p_exists = np.exp(np.minimum(parts.log_missed + parts.log_detected + parts.log_j - parts.log_alone, 0.0))
        return np.where(parts.is_known, self._existing_unseen(pooled), p_exists)

    def _existing_unseen(self, pooled: PooledRecords) -> FloatArray:
        """(records,) r of known objects after a miss of every source; 1 for other records."""
        out = np.ones(len(pooled))
        for s, source in enumerate(pooled.sources):
            if records_of(source).source == KNOWN and len(records_of(source)):
                rows = records_of(source).rows
                r, p_missed = self.existence[rows], self.known_q[rows].prod(axis=1)
                out[pooled.start[s] : pooled.start[s + 1]] = r * p_missed / (1.0 - r + r * p_missed)
        return out

    def _parts(self, pooled: PooledRecords) -> _Parts:
        n = len(pooled)
        sets = np.full((n, len(pooled.sources)), ABSENT)
        sets[np.arange(n), pooled.source] = np.arange(n)
        log_j = pooled.observers.joint(pooled.positions(sets)).log_density
        log_missed, log_detected, clutter = np.zeros(n), np.zeros(n), np.zeros(n)
        is_known, row, column = np.zeros(n, bool), np.zeros(n, np.int64), np.full(n, ABSENT)
        for s, source in enumerate(pooled.sources):
            own, records = slice(pooled.start[s], pooled.start[s + 1]), records_of(source)
            row[own] = records.rows
            if records.source == KNOWN:
                is_known[own] = True
                continue
            column[own] = self.sources.index(records.source)
            q = self.q[records.source][records.rows]
            log_missed[own] = math.log(self.density) + np.log(q).sum(axis=1)
            log_detected[own] = log_odds(q[:, self.sources.index(records.source)])
            clutter[own] = self.false[records.source]
        with np.errstate(divide="ignore"):
            log_alone = np.logaddexp(log_missed + log_detected + log_j, np.log(clutter))
        return _Parts(log_j, log_missed, log_detected, np.where(is_known, 0.0, log_alone), is_known, row, column)


@dataclass(frozen=True)
class _Parts:
    """Per pooled record (n,): ln J of the record alone, ln ρ∏q and ln((1−q)/q) of its own source at its place, ln w of
    the record alone; whether it is a known object, its row in its table, and its source's column (ABSENT for known
    objects)."""

    log_j: FloatArray
    log_missed: FloatArray
    log_detected: FloatArray
    log_alone: FloatArray
    is_known: BoolArray
    row: IntArray
    column: IntArray


@dataclass(frozen=True)
class Sighting:
    """The detections of the known objects in the completed scans.

    p_detected : (m, S) probability that a record of the source, in a completed scan, is of the object.
    scans : (S,) completed scans of the source: 1 or 0, or a part of a rotation for a rotating antenna.
    q : (m, S) expected miss probability.
    """

    p_detected: FloatArray
    scans: FloatArray
    q: FloatArray


@dataclass(frozen=True)
class BernoulliTable(ObjectTable):
    """The known objects, (m,) each, given the completed scans, each counted once.

    A source that missed an object six times is not expected to detect it now, so each object has its own counts of hits
    and misses. Two objects at one place that no scan resolves are duplicates of one object (:meth:`merged`).

    existence, initial : probability of existence, now and with the first scan.
    hits, misses : (m, S) weighted numbers of scans of each source that detected and missed it; older ones count less.
    frequency_hz : of the emission by which direction finders show it; NaN where unknown.
    near : (p, 2) rows i < j of every two objects whose positions did not differ at the last completed scan.
    separate_log_odds : (p,) log-odds, by the scans, that they are not one.
    """

    WHOLE = frozenset({"near", "separate_log_odds"})
    existence: FloatArray = field(default_factory=lambda: np.empty(0))
    initial: FloatArray = field(default_factory=lambda: np.empty(0))
    hits: FloatArray = field(default_factory=lambda: np.empty((0, 0)))
    misses: FloatArray = field(default_factory=lambda: np.empty((0, 0)))
    frequency_hz: FloatArray = field(default_factory=lambda: np.empty(0))
    near: IntArray = field(default_factory=lambda: np.empty((0, 2), np.int64))
    separate_log_odds: FloatArray = field(default_factory=lambda: np.empty(0))

    @property
    def records(self) -> Records:
        """The objects as a source of their own, for ``identify_many``."""
        if not len(self):
            return Records.of(np.empty((0, 4)), sigma=1.0, source=KNOWN)
        return Records.of(self.state, covariance=self.covariance, source=KNOWN)

    @classmethod
    def none(cls, sources: int) -> BernoulliTable:
        """An empty table for a number of sources."""
        empty = np.empty((0, sources))
        return cls(hits=empty, misses=empty)

    @classmethod
    def born(
        cls,
        number: IntArray,
        state: FloatArray,
        covariance: FloatArray,
        existence: FloatArray,
        hits: FloatArray,
        frequency_hz: FloatArray | None = None,
        least: float = MIN_PROBABILITY,
    ) -> BernoulliTable:
        """New objects."""
        bounded, misses = np.clip(existence, least, 1.0 - least), np.zeros_like(hits)
        frequency_hz = np.full(len(number), np.nan) if frequency_hz is None else frequency_hz
        return cls(number, state, covariance, bounded, bounded, hits, misses, frequency_hz)

    def take(self, which: NDArray[Any]) -> BernoulliTable:
        """Some of the objects: a mask (m,) or places."""
        row = np.full(len(self), ABSENT)
        row[which] = np.arange(np.count_nonzero(which) if which.dtype == bool else len(which))
        near = np.sort(row[self.near], axis=1)
        both = near[:, 0] != ABSENT
        return replace(super().take(which), near=near[both], separate_log_odds=self.separate_log_odds[both])

    def with_(self, more: BernoulliTable) -> BernoulliTable:
        """The table with more objects."""
        near = np.concatenate([self.near, more.near + len(self)])
        separate_log_odds = np.concatenate([self.separate_log_odds, more.separate_log_odds])
        return replace(self.stacked(more), near=near, separate_log_odds=separate_log_odds)

    def aged(self, dt_s: float, lifetime_s: float, memory_s: float) -> BernoulliTable:
        """The objects after ``dt_s``: existence decays with their lifetime, hits and misses with ``memory_s``."""
        decay = math.exp(-dt_s / memory_s)
        existence = self.existence * math.exp(-dt_s / lifetime_s)
        return replace(self, existence=existence, hits=self.hits * decay, misses=self.misses * decay)

    def expected_q(self, usual_q: FloatArray, scans: float, least: float) -> FloatArray:
        """(m, S) miss probability: the mean of the described one, weighted as ``scans`` scans, and the object's own."""
        q = (scans * usual_q + self.misses) / (scans + self.misses + self.hits)
        return np.asarray(np.clip(q, least, 1.0 - least))

    def after(self, sighting: Sighting, least: float = MIN_PROBABILITY) -> BernoulliTable:
        """The objects with existence, hits and misses after completed scans; their states do not change."""
        p_detected, r = sighting.p_detected, self.existence
        p_missed = r * np.prod(sighting.q**sighting.scans, axis=1)
        p_undetected = np.prod(1.0 - p_detected, axis=1)
        r = 1.0 - p_undetected + p_undetected * p_missed / (1.0 - r + p_missed)
        return replace(
            self, existence=np.clip(r, least, 1.0 - least), hits=self.hits + p_detected,
            misses=self.misses + np.maximum(sighting.scans - p_detected, 0.0),
        )  # fmt: skip

    def pairs_near(self) -> tuple[IntArray, IntArray]:
        """(p,), (p,) rows of every two objects whose positions do not differ, i < j, in their order."""
        positions = Records.of(self.state[:, :2], covariance=self.covariance[:, :2, :2], source=KNOWN)
        pairs = ChiSquare(DIFFERENT_QUANTILE)(positions, positions)
        once = np.flatnonzero(pairs.i < pairs.j)
        i, j = pairs.i[once].astype(np.int64), pairs.j[once].astype(np.int64)
        order = np.lexsort([j, i])
        return i[order], j[order]

    def separate(self, i: IntArray, j: IntArray) -> FloatArray:
        """(p,) log-odds, by the scans, that objects i and j (p,), i < j, are not one; 0 where they were not near."""
        known = self.near @ (len(self), 1)
        order = np.argsort(known)
        at = places_in(known[order], i * len(self) + j)
        return np.append(self.separate_log_odds[order], 0.0)[at]

    def with_separate_odds(
        self, pairs: tuple[IntArray, IntArray], p_detected: FloatArray, usual_q: FloatArray, split: FloatArray,
        unresolved: FloatArray, tuning: Tuning,
    ) -> BernoulliTable:  # fmt: skip
        """The objects with the odds, after completed scans, that two of them are separate objects.

        A scan that detects both has the probability (1 − q)² (1 − u) if they are separate, and (1 − q) times that of a
        split if they are one; a scan that detects one of them (1 − q) (q + (1 − q) u) and 1 − q, with u the probability
        that they are not resolved. An unresolved pair may be split like one object.

        pairs : :meth:`pairs_near`. p_detected : (m, S) as of :class:`Sighting`. usual_q : (m, S) described miss
        probability at their places. split : (S,) probability that a scan of the source shows one object as two.
        unresolved : (S, p) u of the pairs.
        """
        i, j = pairs
        separate_log_odds = self.separate(i, j)
        for s, u in enumerate(unresolved):
            (q_i, q_j), (p_i, p_j) = ((of[i, s], of[j, s]) for of in (usual_q, p_detected))
            log_both = 0.5 * (np.log1p(-q_i) + np.log1p(-q_j)) + np.log((1.0 - u) / split[s] + u)
            log_one = 0.5 * (np.log(q_i + (1.0 - q_i) * u) + np.log(q_j + (1.0 - q_j) * u))
            separate_log_odds += p_i * p_j * log_both + (p_i * (1.0 - p_j) + p_j * (1.0 - p_i)) * log_one
        bound = tuning.separate_log_odds
        return replace(self, near=np.column_stack(pairs), separate_log_odds=np.clip(separate_log_odds, -bound, bound))

    def merged(self, density_per_m2: float) -> BernoulliTable:
        """The objects without duplicates, of those near each other at the last scan; the lower number of two stays.

        Two are merged if the evidence of their positions, ln N(Δ; 0, P + P′)/ρ, exceeds the log-odds of the scans that
        they are separate by ``MERGING_LOG_ODDS``. The state of the one detected more often stays: the other may be the
        end of its hull.
        """
        objects = replace(self, **{each.name: getattr(self, each.name).copy() for each in fields(self)})
        i, j = self.near.T
        for_one, agree = self._compared(i, j, density_per_m2)
        # The object with the state of each row, ABSENT for none: every two states are compared once.
        holder = np.arange(len(self))
        while True:
            one, other = np.sort([holder[i], holder[j]], axis=0)
            both, separate_log_odds = one != ABSENT, self.separate(one, other)
            # Two emitters on one ship are not one.
            may_be_one = both & agree & ~objects._on_two_frequencies(one, other)
            odds = np.where(may_be_one, for_one - separate_log_odds, -np.inf)
            best = int(odds.argmax()) if len(odds) else 0
            if not (len(odds) and odds[best] > MERGING_LOG_ODDS):
                near = np.column_stack([one, other])[both]
                objects = replace(objects, near=near, separate_log_odds=separate_log_odds[both])
                return objects.take(np.isin(np.arange(len(self)), holder))
            stays = objects._join(int(one[best]), int(other[best]))
            rows = (i[best], j[best]) if holder[i[best]] == stays else (j[best], i[best])
            holder[list(rows)] = one[best], ABSENT

    def _compared(self, i: IntArray, j: IntArray, density_per_m2: float) -> tuple[FloatArray, BoolArray]:
        """(p,) ln N/ρ of the positions of every two objects, and whether their states agree."""
        delta, total = self.state[i] - self.state[j], self.covariance[i] + self.covariance[j]
        agree = mahalanobis_sq(delta, total) < ChiSquare(SAME_QUANTILE).limit(4)
        return log_density(delta[:, :2], total[:, :2, :2]) - math.log(density_per_m2), agree

    def _on_two_frequencies(self, i: IntArray, j: IntArray) -> BoolArray:
        """(p,) whether two objects are emitters of different frequencies."""
        f, out = self.frequency_hz, np.zeros(len(i), bool)
        both = np.flatnonzero(np.isfinite(f[i]) & np.isfinite(f[j]))
        out[both] = MODELS[FREQUENCY](f[i[both]], f[j[both]], f[np.isfinite(f)]) < 0.0
        return out

    def _join(self, i: int, j: int) -> int:
        """Merges object j into row i, in place; which of the two has the state that stays."""
        stays = max(i, j, key=lambda k: (self.existence[k] * self.hits[k].sum(), *self.state[k]))
        self.state[i], self.covariance[i] = self.state[stays], self.covariance[stays]
        self.number[i] = min(self.number[i], self.number[j])
        self.existence[i] = 1.0 - (1.0 - self.existence[i]) * (1.0 - self.existence[j])
        self.initial[i] = max(self.initial[i], self.initial[j])
        self.hits[i] += self.hits[j]
        self.misses[i] = np.minimum(self.misses[i], self.misses[j])
        return stays

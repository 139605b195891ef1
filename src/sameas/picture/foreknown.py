"""Foreknown: a belief in objects some of which are known beforehand, each with its own probability of existing.

Objects nobody knew yet are a Poisson field, as for :class:`sameas.belief.PoissonObjects`; the known ones are the
records of one more source, states foretold with their covariances. Unlike there a miss depends on where the object is,
and for a known object on the object: a camera that has not seen this boat will not see it now. With r_i the probability
that known object i exists, and A the records of it,

    w({i} ∪ A) = r_i ∏_{s∈A} (1−q_is) ∏_{s∉A} q_is J(i, A)/J(i),    w({i}) = 1 − r_i + r_i ∏_s q_is,
    w(A) = ρ ∏_{s∈A} (1−q_s) ∏_{s∉A} q_s J(A) for others,           w({z}) = ρ (1−q_s) ∏_{t≠s} q_t J(z) + β_s,

the local hypotheses of Poisson multi-Bernoulli filters (Williams 2015, IEEE Trans. AES 51, 1664), with J of
:mod:`sameas.joint`. ln q_s is that of the place of each record, in the mean over those of A.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from sameas.belief import ObjectsRule
from sameas.observations import records_of
from sameas.records import FloatArray, IntArray
from sameas.terms import Between, Linear, Terms, best_word, mean_of_pairs
from sameas.union import Union

#: Name of the source whose records are the known objects.
KNOWN = "known objects"


def log_odds(q: FloatArray) -> FloatArray:
    """ln((1 − q)/q)."""
    return np.asarray(np.log1p(-q) - np.log(q))


@dataclass(frozen=True)
class Foreknown(ObjectsRule):
    """See the module.

    Parameters
    ----------
    density : ρ, unknown objects per unit volume of the state at the centre of the region.
    sources : names of the sources that look, those that show nothing among them: the columns of the tables of q.
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

    def terms(self, union: Union) -> Terms:
        """The terms of the records and pairs of ``union``."""
        parts = self._parts(union)
        gain = np.where(parts.known, np.log(self._existing_unseen(union)), parts.missed + parts.seen - parts.alone)
        i, j = union.i, union.j
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
            Between({"misses": missed}, everywhere, mean_of_pairs),
            Between({"seen before": own}, with_known, best_word),
        )
        return Terms({"position": Linear(0.0, -parts.log_j), "densities": Linear(0.0, gain)}, rules)

    def exists(self, union: Union) -> FloatArray:
        """(records,) the probability that there is an object, of each record of the union that has no partner."""
        parts = self._parts(union)
        share = np.exp(np.minimum(parts.missed + parts.seen + parts.log_j - parts.alone, 0.0))
        return np.where(parts.known, self._existing_unseen(union), share)

    def _existing_unseen(self, union: Union) -> FloatArray:
        """(records,) r of known objects that every look has missed; 1 for other records."""
        out = np.ones(len(union))
        for s, source in enumerate(union.sources):
            if records_of(source).source == KNOWN and len(records_of(source)):
                rows = records_of(source).rows
                r, missed = self.existence[rows], self.known_q[rows].prod(axis=1)
                out[union.start[s] : union.start[s + 1]] = r * missed / (1.0 - r + r * missed)
        return out

    def _parts(self, union: Union) -> _Parts:
        n = len(union)
        sets = np.full((n, len(union.sources)), -1)
        sets[np.arange(n), union.source] = np.arange(n)
        log_j = union.observers.joint(union.positions(sets)).log_density
        missed, seen, false = np.zeros(n), np.zeros(n), np.zeros(n)
        known, row, column = np.zeros(n, bool), np.zeros(n, np.int64), np.full(n, -1)
        for s, source in enumerate(union.sources):
            here, records = slice(union.start[s], union.start[s + 1]), records_of(source)
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
    """Per record of a union (n,): ln J of it alone, ln ρ∏q where it is, ln((1−q)/q) of its own source there, ln w of it
    alone; whether it is a known object, its row in its table, and its source's column (−1 for known objects)."""

    log_j: FloatArray
    missed: FloatArray
    seen: FloatArray
    alone: FloatArray
    known: np.ndarray
    row: IntArray
    column: IntArray

"""Priors: the probability of the number of common objects in a group, before the evidence.

- :class:`PerPair` adds a constant log-odds to every pair. It decomposes exactly over groups and does not depend on
  the gate. Use it where densities are known or estimated (catalogues; with the rules ``PoissonField``, ``Field``,
  ``ConstantCost``): the rule then contains the densities and the prior is ``PerPair(0)``.
- :class:`CommonObjects` needs only the probability with which each source misses an object (METHOD 4.1), with a flat
  prior on the number of objects. It counts the records of a *group*, so the counts depend on the width of the gate:
  use it for small scenes of targets where only q₁, q₂ are known, and to reproduce the paper. A pair's odds decrease
  with the number of objects in its group; of a group of more than the largest likelihood ratio, no pair is claimed.
- ``CommonObjects(q1, q2, linear=True)`` is the paper's least-squares line through ln P(k) (METHOD 4.2), kept to
  reproduce it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from sameas.arrays import FloatArray, IntArray
from sameas.errors import InputError
from sameas.ragged import Ragged
from sameas.representation import in_short


@in_short
@dataclass(frozen=True)
class LogPrior:
    """ln P(k) of the number k of pairs in each group, up to a constant per group.

    slope : (g,) where ln P(k) = slope·k, else None.
    start, table : otherwise ln P(k) of group g is ``table[start[g] + k]``, k = 0 … min(n₁, n₂).
    """

    slope: FloatArray | None
    start: IntArray
    table: FloatArray


@dataclass(frozen=True)
class PerPair:
    """Every pair has the same prior log-odds against its two records being different objects."""

    log_odds: float = 0.0

    def __post_init__(self) -> None:
        if not math.isfinite(self.log_odds):
            raise InputError(f"PerPair: log_odds is {self.log_odds}; give a finite natural logarithm")

    def __call__(self, n1: IntArray, n2: IntArray) -> LogPrior:
        """ln P for groups with n1 and n2 records, (g,) each."""
        return LogPrior(np.full(len(n1), self.log_odds), np.zeros(len(n1) + 1, np.int64), np.empty(0))


#: The default prior: nothing in addition to the rule.
EVIDENCE_ALONE = PerPair(0.0)


@dataclass(frozen=True)
class CommonObjects:
    """Source 1 misses an object with probability q1, source 2 with q2; the number of objects is unknown, flat.

    With n = n₁ + n₂ − k objects, P(k) ∝ n! q₂^(n₁−k) q₁^(n₂−k) / (1 − q₁q₂)^(n+1) per hypothesis of k pairs
    (METHOD 4.1 [T6]). ``linear`` takes the least-squares slope a₂ of ln P(k) instead (METHOD 4.2 [T28]).
    """

    q1: float
    q2: float
    linear: bool = False

    def __post_init__(self) -> None:
        for name, q in (("q1", self.q1), ("q2", self.q2)):
            if not 0.0 < q < 1.0:
                raise InputError(
                    f"CommonObjects: {name} is {q}; give the probability that source {name[1]} misses an object, "
                    "strictly between 0 and 1"
                )

    def log_probability(self, k: ArrayLike, n1: ArrayLike, n2: ArrayLike) -> FloatArray:
        """ln P(k) up to a constant of (n1, n2), elementwise."""
        from scipy.special import gammaln

        k, n1, n2 = (np.asarray(x, dtype=np.float64) for x in (k, n1, n2))
        n = n1 + n2 - k
        both_missed = math.log1p(-self.q1 * self.q2)
        return np.asarray(
            gammaln(n + 1) + (n1 - k) * math.log(self.q2) + (n2 - k) * math.log(self.q1) - (n + 1) * both_missed
        )

    def __call__(self, n1: IntArray, n2: IntArray) -> LogPrior:
        """ln P for groups with n1 and n2 records, (g,) each."""
        sizes = np.minimum(n1, n2) + 1
        tables = Ragged.of_sizes(sizes)
        group, k = tables.row, tables.index
        table = self.log_probability(k, n1[group], n2[group])
        if not self.linear:
            return LogPrior(None, tables.start, table)
        most = (sizes - 1).astype(np.float64)
        centred = np.bincount(group, (2.0 * k - most[group]) * table, len(n1))
        return LogPrior(6.0 * centred / (most**3 + 3.0 * most**2 + 2.0 * most), tables.start, table)


Prior = PerPair | CommonObjects

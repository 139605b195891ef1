"""The result: which records are the same object, which have no partner, how sure it is, and why.

Rows in a result are rows of the sources' own tables; absence is a mask. Everything is computed from the stages'
values when it is asked for.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.assignment import Hypothesis
from sameas.errors import InputError
from sameas.evidence import Evidence
from sameas.gate import Pairs
from sameas.gate.gate import quantile
from sameas.groups import Groups
from sameas.kernels import threads
from sameas.posterior import APPROXIMATE, METHODS, Posterior
from sameas.records import Records
from sameas.representation import in_short
from sameas.result.explanation import Explanation, explain

#: An answer less probable than this is called ambiguous.
AMBIGUOUS = 0.9


@in_short
@dataclass(frozen=True)
class Matches:
    """The identified pairs, one row each, sorted by the row of the first source.

    rows_1, rows_2 : rows of the two tables. pair : position among the candidates. p_match : posterior probability.
    log_odds : ln λ with the prior's share per pair. residual : (k, d). mahalanobis : Δ over its error, (k,).
    """

    rows_1: IntArray
    rows_2: IntArray
    pair: IntArray
    p_match: FloatArray
    log_odds: FloatArray
    residual: FloatArray
    mahalanobis: FloatArray

    def __len__(self) -> int:
        return len(self.pair)


@in_short
@dataclass(frozen=True)
class Answers:
    """The answer for every row of one source's table (n_table,); masked where there is none.

    partner : row in the other table. p_match : probability of that pair. p_none : probability of having no partner.
    second : row in the other table of the most probable other candidate, and p_second its probability.
    candidates : how many pairs passed the gate. group, group_size : number of the group and of its records.
    usable : False for rows that were set aside.
    """

    partner: np.ma.MaskedArray
    pair: np.ma.MaskedArray
    p_match: np.ma.MaskedArray
    p_none: np.ma.MaskedArray
    second: np.ma.MaskedArray
    p_second: np.ma.MaskedArray
    candidates: np.ma.MaskedArray
    group: np.ma.MaskedArray
    group_size: np.ma.MaskedArray
    usable: BoolArray


@in_short
@dataclass(frozen=True)
class Identification:
    """The answer of :func:`sameas.identify`: every stage's value, and what users ask of them."""

    pairs: Pairs
    groups: Groups
    evidence: Evidence
    best: Hypothesis
    posterior: Posterior

    @property
    def first(self) -> Records:
        """The records of source 1."""
        return self.pairs.first

    @property
    def second(self) -> Records:
        """The records of source 2."""
        return self.pairs.second

    @cached_property
    def chosen(self) -> BoolArray:
        """(m,) whether each candidate belongs to the most probable hypothesis, in the order of the gate."""
        chosen = np.empty(len(self.pairs), np.bool_)
        chosen[self.groups.order] = self.best.chosen
        return chosen

    @cached_property
    def log_odds(self) -> FloatArray:
        """(m,) ln λ of each candidate, with the prior's slope where the prior is linear."""
        weight = np.empty(len(self.pairs))
        weight[self.groups.order] = self.best.weight
        return weight

    @property
    def p_pair(self) -> FloatArray:
        """(m,) posterior probability of each candidate, in the order of the gate."""
        return self.posterior.p_pair

    @cached_property
    def rows_1(self) -> IntArray:
        """(m,) row of each candidate in the table of source 1."""
        return self.first.rows[self.pairs.i]

    @cached_property
    def rows_2(self) -> IntArray:
        """(m,) row of each candidate in the table of source 2."""
        return self.second.rows[self.pairs.j]

    @cached_property
    def matches(self) -> Matches:
        """The identified pairs."""
        pairs, groups = self.pairs, self.groups
        place = np.flatnonzero(self.best.chosen)
        of_row = np.full(self.first.n_table, -1)
        of_row[self.first.rows[pairs.i[groups.order[place]]]] = place
        place = of_row[of_row >= 0]
        pair = groups.order[place]
        columns = (pairs.i, pairs.j, self.p_pair, pairs.residual, pairs.mahalanobis_sq)
        works = [partial(np.take, self.best.weight, place), *(partial(np.take, of, pair, axis=0) for of in columns)]
        log_odds, i, j, p_match, residual, distance_sq = threads.each(works, len(pair))
        rows = self.first.rows[i], self.second.rows[j]
        return Matches(*rows, pair, p_match, log_odds, residual, np.sqrt(distance_sq, out=distance_sq))

    @cached_property
    def answers_1(self) -> Answers:
        """The answer for every row of source 1."""
        return self._answers(self.first, self.pairs.i, (self.pairs.j, self.second.rows))

    @cached_property
    def answers_2(self) -> Answers:
        """The answer for every row of source 2."""
        return self._answers(self.second, self.pairs.j, (self.pairs.i, self.first.rows))

    @property
    def both_answers(self) -> tuple[Answers, Answers]:
        """The answers for every row of either source, made side by side."""
        _ = self.chosen, self._group_of  # both need them
        return threads.both(lambda: self.answers_1, lambda: self.answers_2, len(self.pairs))

    @property
    def leftovers_1(self) -> IntArray:
        """Usable rows of source 1 without a partner."""
        return np.flatnonzero(self.answers_1.usable & np.ma.getmaskarray(self.answers_1.partner))

    @property
    def leftovers_2(self) -> IntArray:
        """Usable rows of source 2 without a partner."""
        return np.flatnonzero(self.answers_2.usable & np.ma.getmaskarray(self.answers_2.partner))

    @cached_property
    def expected_wrong(self) -> float:
        """How many of the identified pairs are expected to be wrong: Σ (1 − p)."""
        return float(np.sum(1.0 - self.p_pair[self.chosen]))

    @cached_property
    def expected_missed(self) -> float:
        """How many true pairs among the candidates are expected to be missing from the identified ones."""
        return float(np.sum(self.p_pair[~self.chosen]))

    def residual_statistics(self) -> dict[str, Any]:
        """Mean and rms of the identified residuals per axis, and the median of the normalised distance with its due.

        The due is the median of the χ distribution of d degrees of freedom: errors are quoted too small where the
        observed median lies above it, too large where below.
        """
        d = self.pairs.d
        matches = self.matches
        if not len(matches):
            return {"mean": np.full(d, np.nan), "rms": np.full(d, np.nan), "median": np.nan, "median_due": np.nan}
        return {
            "mean": matches.residual.mean(axis=0),
            "rms": np.sqrt(np.mean(matches.residual**2, axis=0)),
            "median": float(np.median(matches.mahalanobis)),
            "median_due": math.sqrt(quantile(0.5, d)),
        }

    def method(self, group: int) -> str:
        """How the posterior of a group was computed."""
        return METHODS[self.posterior.method[group]]

    @property
    def approximate_pairs(self) -> int:
        """Number of candidates in groups that had to be solved by neighbourhoods and messages."""
        return int(self.groups.pair_counts[self.posterior.method == APPROXIMATE].sum())

    def explain(self, record: Any, *, source: int = 1) -> Explanation:
        """Why this record was identified as it was: its competitors, and the cost of other answers.

        Parameters
        ----------
        record : the record's id.
        source : 1 or 2, whose record it is.
        """
        if source not in (1, 2):
            raise InputError(f"source is {source}; give 1 or 2")
        return explain(self, record, source)

    @cached_property
    def _group_of(self) -> NDArray[np.int32]:
        """(m,) group of each candidate, in the order of the gate."""
        return self.groups.of_pairs()

    def _answers(
        self, records: Records, position: NDArray[np.int32], other: tuple[NDArray[np.int32], IntArray]
    ) -> Answers:
        from sameas.kernels.summary import by_row, per_record

        summary = per_record(position, len(records), self.chosen, self.p_pair)
        size = self.groups.sizes_1 + self.groups.sizes_2
        n = records.n_table
        rows = tuple(np.zeros(n, np.int64) for _ in range(3))
        shares = tuple(np.zeros(n) for _ in range(3))
        counts = np.zeros(n, np.int32), np.zeros(n, np.int32), np.zeros(n, np.int64)
        alone, no_other, no_group, unusable = absent = tuple(np.ones(n, np.bool_) for _ in range(4))
        by_row(records.rows, summary, (self.p_pair, *other, self._group_of, size), rows, shares, counts, absent)
        partner, pair, second = rows
        p_match, p_none, p_second = shares
        candidates, group, group_size = counts
        return Answers(
            partner=np.ma.MaskedArray(partner, alone),
            pair=np.ma.MaskedArray(pair, alone),
            p_match=np.ma.MaskedArray(p_match, alone),
            p_none=np.ma.MaskedArray(p_none, unusable),
            second=np.ma.MaskedArray(second, no_other),
            p_second=np.ma.MaskedArray(p_second, no_other),
            candidates=np.ma.MaskedArray(candidates, unusable),
            group=np.ma.MaskedArray(group, no_group),
            group_size=np.ma.MaskedArray(group_size, no_group),
            usable=~unusable,
        )

"""The result: which records are the same object, which have no partner, how sure it is, and why.

- :class:`Identification`: the answer of :func:`sameas.identify`, with the values of all stages. Rows in it are rows of
  the sources' own tables; absence is a mask. Everything is computed from the values of the stages when first used.
- :class:`Explanation`: why one record was identified as it was: its candidates, their terms, and the cost of other
  answers.

Other choices of pairs than the most probable hypothesis are in :mod:`sameas.decision`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import ABSENT, BoolArray, FloatArray, IntArray, taken
from sameas.assignment import Hypothesis, assign
from sameas.errors import InputError
from sameas.evidence import Evidence
from sameas.gate import Pairs
from sameas.gate.gate import quantile
from sameas.groups import Groups
from sameas.kernels import threads
from sameas.posterior import APPROXIMATE, METHODS, Posterior
from sameas.prior import LogPrior
from sameas.records import Records
from sameas.representation import in_short

#: An answer less probable than this is called ambiguous.
AMBIGUOUS = 0.9


@in_short
@dataclass(frozen=True)
class Matches:
    """The identified pairs, one row each, sorted by the row of the first source.

    rows_1, rows_2 : rows of the two tables. pair : index among the candidates. p_match : posterior probability.
    log_odds : ln λ with the prior's slope. residual : (k, d). mahalanobis : (k,) normalised distance.
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
    """The answer for every row of one source's table (n_table,); masked where absent.

    partner : row in the other table. p_match : probability of that pair. p_none : probability of no partner.
    second, p_second : row in the other table of the most probable other candidate, and its probability.
    candidates : number of pairs in the gate. group, group_size : index of the group and number of its records.
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
    """The answer of :func:`sameas.identify`: the values of all stages, and what follows from them."""

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
        return self.groups.in_given_order(self.best.chosen)

    @cached_property
    def log_odds(self) -> FloatArray:
        """(m,) ln λ of each candidate, with the prior's slope where the prior is linear."""
        return self.groups.in_given_order(self.best.weight)

    @property
    def p_pair(self) -> FloatArray:
        """(m,) posterior probability of each candidate, in the order of the gate."""
        return self.posterior.p_pair

    @cached_property
    def rows_1(self) -> IntArray:
        """(m,) row of each candidate in the table of source 1."""
        return taken(self.first.rows, self.pairs.i)

    @cached_property
    def rows_2(self) -> IntArray:
        """(m,) row of each candidate in the table of source 2."""
        return taken(self.second.rows, self.pairs.j)

    @cached_property
    def matches(self) -> Matches:
        """The identified pairs."""
        pairs, groups = self.pairs, self.groups
        place = np.flatnonzero(self.best.chosen)
        of_row = np.full(self.first.n_table, ABSENT)
        of_row[taken(self.first.rows, pairs.i[groups.order[place]])] = place
        place = np.compress(of_row >= 0, of_row)
        pair = groups.order[place]
        columns = (pairs.i, pairs.j, self.p_pair, pairs.residual, pairs.mahalanobis_sq)
        works = [partial(np.take, self.best.weight, place), *(partial(np.take, of, pair, axis=0) for of in columns)]
        log_odds, i, j, p_match, residual, distance_sq = threads.each(works, len(pair))
        rows = taken(self.first.rows, i), taken(self.second.rows, j)
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
        """The answers for every row of both sources, computed in parallel."""
        _ = self.chosen, self._group_of  # needed by both
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
        """Expected number of wrong pairs among the identified ones: Σ (1 − p)."""
        return float(np.sum(1.0 - np.compress(self.chosen, self.p_pair)))

    @cached_property
    def expected_missed(self) -> float:
        """Expected number of true pairs among the candidates that are not identified."""
        return float(np.sum(np.compress(~self.chosen, self.p_pair)))

    def residual_statistics(self) -> dict[str, Any]:
        """Mean and rms of the identified residuals per axis, and the median normalised distance with its expectation.

        The expectation is the median of the χ distribution with d degrees of freedom: quoted errors are too small if
        the observed median is above it, too large if below.
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
        """The method by which the posterior of a group was computed."""
        return METHODS[self.posterior.method[group]]

    @property
    def approximate_pairs(self) -> int:
        """Number of candidates in groups solved by neighbourhoods and messages."""
        return int(self.groups.pair_counts[self.posterior.method == APPROXIMATE].sum())

    def explain(self, record: Any, *, source: int = 1) -> Explanation:
        """Why this record was identified as it was: its competitors, and the cost of other answers.

        Parameters
        ----------
        record : the record's id.
        source : 1 or 2, the source of the record.
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
        from sameas.kernels.records import by_row, per_record

        n_records, chosen = len(records), self.chosen
        (partner_of, second_of, number, total), group_of = threads.both(
            lambda: per_record(position, n_records, chosen, self.p_pair), lambda: self._group_of, n_records
        )
        pairs = self.p_pair, *other, group_of, self.groups.sizes_1 + self.groups.sizes_2
        n = records.n_table
        rows = np.zeros(n, np.int64), np.zeros(n, np.int64), np.zeros(n, np.int64)
        shares = np.zeros(n), np.zeros(n), np.zeros(n)
        counts = np.zeros(n, np.int32), np.zeros(n, np.int32), np.zeros(n, np.int64)
        alone, no_other, no_group, unusable = absent = tuple(np.ones(n, np.bool_) for _ in range(4))
        threads.over(
            lambda a, b: by_row(
                records.rows[a:b],
                (partner_of[a:b], second_of[a:b], number[a:b], total[a:b]),
                pairs,
                rows,
                shares,
                counts,
                absent,
            ),
            threads.even(n_records),
        )
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


#: Log-odds that force a pair into a hypothesis or out of it: larger than all others, but small enough to keep 1e-9.
FORCE = 1e6
#: The next best hypothesis is searched for in groups with at most this many pairs in the best one.
SEARCHED = 200


@dataclass(frozen=True)
class Competitor:
    """One answer for the record: a candidate, or no partner (``id`` None).

    cost : ln of the probability of the best hypothesis over that of the best one with this answer, for the whole group;
        0 for the given answer. terms : the parts of ``log_odds``.
    """

    id: Any
    probability: float
    cost: float
    log_odds: float | None
    terms: dict[str, float]
    residual: FloatArray | None
    mahalanobis: float | None
    chosen: bool


@in_short
@dataclass(frozen=True)
class Explanation:
    """The result of :meth:`Identification.explain`; ``str()`` of it is a text for people.

    row : in the table of its source. set_aside : why it could not be used, empty for a usable record.
    group, records : its group, None if no pair passes the gate, and the number of the group's records of each source.
    method : by which the group's posterior was computed. competitors : all answers, the most probable first.
    prior : a sentence on the prior of the number of pairs, empty if it is part of the log-odds.
    next_best_cost : ln of the probability of the group's best hypothesis over that of the next best, None if there is
        no other or the group is too large to search. next_best : the pairs of ids that differ, (added, removed).
    """

    id: Any
    source: str
    other: str
    row: int
    set_aside: str = ""
    group: int | None = None
    records: tuple[int, int] = (0, 0)
    method: str = ""
    competitors: tuple[Competitor, ...] = ()
    prior: str = ""
    next_best_cost: float | None = None
    next_best: tuple[list[tuple[Any, Any]], list[tuple[Any, Any]]] = field(default_factory=lambda: ([], []))

    def __str__(self) -> str:
        return "\n".join(_lines(self))


def explain(result: Identification, record: Any, source: int) -> Explanation:
    """See :meth:`sameas.result.Identification.explain`."""
    own, other = (result.first, result.second) if source == 1 else (result.second, result.first)
    row = row_of(own.ids, record, own.source)
    asked, at = Explanation(own.ids[row], own.source, other.source, row), own.at_row(row)
    if at is None:
        return replace(asked, set_aside=str(own.set_aside.reasons[own.set_aside.rows == row][0]))
    own_pairs = np.flatnonzero((result.pairs.i if source == 1 else result.pairs.j) == at)
    if not len(own_pairs):
        alone = Competitor(None, 1.0, 0.0, None, {}, None, None, True)
        return replace(asked, records=(1, 0), method=METHODS[0], competitors=(alone,))
    group = int(result.groups.of_pairs()[own_pairs[0]])
    problem = _GroupProblem(result, group)
    competitors = [problem.candidate(int(e), own_pairs, source) for e in own_pairs]
    competitors.append(problem.no_partner(own_pairs, competitors))
    cost, difference = problem.next_best()
    return replace(
        asked,
        group=group,
        records=(int(result.groups.sizes_1[group]), int(result.groups.sizes_2[group])),
        method=result.method(group),
        competitors=tuple(sorted(competitors, key=lambda c: (-c.probability, c.cost))),
        prior=problem.prior_in_words(),
        next_best_cost=cost,
        next_best=difference,
    )


def row_of(ids: NDArray[Any], record: Any, source: str) -> int:
    """The table row of an id, which may be text from a command line."""
    rows = np.flatnonzero(ids == record) if not isinstance(record, str) else np.empty(0, np.int64)
    if not len(rows):
        rows = np.flatnonzero(np.char.strip(ids.astype(str)) == str(record).strip())
    if not len(rows):
        raise InputError(
            f"{source} has no record with the id {record}; its first ids are {', '.join(map(str, ids[:3]))}"
        )
    return int(rows[0])


class _GroupProblem:
    """One group of a result, to be solved again with pairs forced in or out."""

    def __init__(self, result: Identification, group: int) -> None:
        self.result = result
        g = result.groups
        part = slice(g.start[group], g.start[group + 1])
        rows1 = slice(g.start_1[group], g.start_1[group + 1])
        rows2 = slice(g.start_2[group], g.start_2[group + 1])
        self.pairs = g.order[part]
        n = len(self.pairs)
        self.groups = Groups(
            np.arange(n), np.array([0, n]), g.rows_1[rows1], np.array([0, rows1.stop - rows1.start]),
            g.edges_1[rows1.start : rows1.stop + 1] - part.start, g.rows_2[rows2],
            np.array([0, rows2.stop - rows2.start]), g.local_1[part], g.local_2[part],
        )  # fmt: skip
        prior = result.best.prior
        if prior.slope is not None:
            # The slope is already part of the weights.
            self.prior = LogPrior(np.zeros(1), np.zeros(2, np.int64), np.empty(0))
        else:
            table = prior.table[prior.start[group] : prior.start[group + 1]]
            self.prior = LogPrior(None, np.array([0, len(table)]), table)
        self.weight = result.best.weight[part]
        self.chosen = result.best.chosen[part]
        self.score = self._score(self.chosen)

    def _score(self, chosen: BoolArray) -> float:
        count = int(chosen.sum())
        log_prior = self.prior.table[count] if self.prior.slope is None else 0.0
        return float(self.weight[chosen].sum() + log_prior)

    def prior_in_words(self) -> str:
        """The prior of the count, which is not in the terms of the pairs: ln P(k) around the best hypothesis' k."""
        if self.prior.slope is not None:
            return ""
        best, table = int(self.chosen.sum()), self.prior.table
        steps = [f"{k} {table[k] - table[best]:+.2f}" for k in range(max(0, best - 2), min(len(table), best + 3))]
        return f"(the prior of the number of pairs comes on top; ln P, relative to {best}: {', '.join(steps)})"

    def solve(self, required: BoolArray, forbidden: BoolArray) -> tuple[float, BoolArray]:
        """(cost relative to the best, pairs) of the best hypothesis with some pairs required and others forbidden."""
        weight = np.where(forbidden, -FORCE * 10, self.weight + FORCE * required)
        best: Hypothesis = assign(self.groups, weight, self.prior)
        return self.score - self._score(best.chosen), best.chosen

    def candidate(self, e: int, own: IntArray, source: int) -> Competitor:
        result = self.result
        at = np.flatnonzero(self.pairs == e)[0]
        forbidden = np.isin(self.pairs, own)
        forbidden[at] = False
        required = np.zeros(len(self.pairs), np.bool_)
        required[at] = True
        cost, _ = self.solve(required, forbidden)
        other = result.second.ids[result.rows_2[e]] if source == 1 else result.first.ids[result.rows_1[e]]
        terms = {name: float(values[e]) for name, values in result.evidence.terms.items()}
        prior = float(result.log_odds[e]) - sum(terms.values())
        if result.best.prior.slope is not None and abs(prior) > 1e-12:
            terms["prior"] = prior
        return Competitor(
            other, float(result.p_pair[e]), max(0.0, cost), float(result.log_odds[e]), terms,
            result.pairs.residual[e] * (1 if source == 1 else -1), float(np.sqrt(result.pairs.mahalanobis_sq[e])),
            bool(result.chosen[e]),
        )  # fmt: skip

    def no_partner(self, own: IntArray, candidates: list[Competitor]) -> Competitor:
        cost, _ = self.solve(np.zeros(len(self.pairs), np.bool_), np.isin(self.pairs, own))
        alone = not any(c.chosen for c in candidates)
        probability = max(0.0, 1.0 - sum(c.probability for c in candidates))
        return Competitor(None, probability, max(0.0, cost), None, {}, None, None, alone)

    def next_best(self) -> tuple[float | None, tuple[list[tuple[Any, Any]], list[tuple[Any, Any]]]]:
        """Cost and changed pairs of the next best hypothesis.

        Every other hypothesis lacks a chosen pair or adds one: the best is found by forbidding each chosen pair, and by
        requiring each pair of two records without a partner.
        """
        if len(self.pairs) > SEARCHED * 20 or int(self.chosen.sum()) > SEARCHED:
            return None, ([], [])
        none = np.zeros(len(self.pairs), np.bool_)
        tries = []
        for at in np.flatnonzero(self.chosen):
            forbidden = none.copy()
            forbidden[at] = True
            tries.append(self.solve(none, forbidden))
        busy_1 = np.isin(self.groups.local_1, self.groups.local_1[self.chosen])
        busy_2 = np.isin(self.groups.local_2, self.groups.local_2[self.chosen])
        for at in np.flatnonzero(~busy_1 & ~busy_2):
            required = self.chosen.copy()
            required[at] = True
            tries.append(self.solve(required, none))
        if not tries:
            return None, ([], [])
        cost, pairs = min(tries, key=lambda t: t[0])
        added, removed = self.pairs[pairs & ~self.chosen], self.pairs[self.chosen & ~pairs]
        return max(0.0, cost), (self._ids(added), self._ids(removed))

    def _ids(self, pairs: IntArray) -> list[tuple[Any, Any]]:
        result = self.result
        ids = result.first.ids[result.rows_1[pairs]].tolist(), result.second.ids[result.rows_2[pairs]].tolist()
        return list(zip(*ids, strict=True))


def _lines(x: Explanation) -> list[str]:
    if x.set_aside:
        return [f"{x.source} {x.id} (row {x.row}) could not be used: {x.set_aside}."]
    if x.group is None:
        return [f"{x.source} {x.id} (row {x.row}): no record of {x.other} passes the gate; it has no partner."]
    chosen = next(c for c in x.competitors if c.chosen)
    who = "has no partner" if chosen.id is None else f"is {x.other} {chosen.id}"
    lines = [
        f"{x.source} {x.id} (row {x.row}) {who}, probability {probability_text(chosen.probability)}.",
        f"Group {x.group}: {x.records[0]} + {x.records[1]} records; posterior by {x.method}.",
        "",
        f"{'answer':>22}  {'probability':>11}  {'costs':>8}  {'distance':>8}  {'log-odds':>8}  terms",
    ]
    for c in x.competitors:
        name = "no partner" if c.id is None else str(c.id)
        mark = "→ " if c.chosen else "  "
        distance = "" if c.mahalanobis is None else f"{c.mahalanobis:.2f} σ"
        odds = "" if c.log_odds is None else f"{c.log_odds:+.2f}"
        terms = ", ".join(f"{key} {value:+.2f}" for key, value in c.terms.items())
        p = probability_text(c.probability)
        lines.append(f"{mark + name:>22}  {p:>11}  {c.cost:8.2f}  {distance:>8}  {odds:>8}  {terms}")
    lines.append("(costs: ln by which the best identification of the whole group with that answer is less probable)")
    if x.prior:
        lines.append(x.prior)
    if x.next_best_cost is not None:
        added = ", ".join(f"{a} = {b}" for a, b in x.next_best[0]) or "nothing"
        removed = ", ".join(f"{a} = {b}" for a, b in x.next_best[1]) or "nothing"
        lines += ["", f"The next best identification of the group is {x.next_best_cost:.2f} less probable (ln): "
                      f"it has {added} instead of {removed}."]  # fmt: skip
    return lines


def probability_text(p: float) -> str:
    """A probability with enough digits to differ from 0 and 1."""
    if p > 0.9999:
        return f"1 − {1 - p:.0e}" if p < 1 else "1"
    return f"{p:.4f}" if p > 1e-3 else f"{p:.1e}"

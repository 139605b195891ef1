"""Why a record was identified as it was: its competitors, their terms, and the cost of other answers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.assignment import Hypothesis, assign
from sameas.errors import InputError
from sameas.evidence import Evidence
from sameas.gate import Pairs
from sameas.groups import Groups
from sameas.posterior import METHODS
from sameas.prior import LogPrior
from sameas.records import Records
from sameas.representation import in_short

#: Log-odds that force a pair into a hypothesis or out of it: larger than all others, but small enough to keep 1e-9.
FORCE = 1e6
#: The next best hypothesis is searched for in groups with at most this many pairs in the best one.
SEARCHED = 200


class Identified(Protocol):
    """The part of an :class:`~sameas.result.Identification` that an explanation needs."""

    @property
    def pairs(self) -> Pairs: ...
    @property
    def groups(self) -> Groups: ...
    @property
    def evidence(self) -> Evidence: ...
    @property
    def best(self) -> Hypothesis: ...
    @property
    def first(self) -> Records: ...
    @property
    def second(self) -> Records: ...
    @property
    def rows_1(self) -> IntArray: ...
    @property
    def rows_2(self) -> IntArray: ...
    @property
    def chosen(self) -> BoolArray: ...
    @property
    def log_odds(self) -> FloatArray: ...
    @property
    def p_pair(self) -> FloatArray: ...
    def method(self, group: int) -> str: ...


@in_short
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

    prior : a sentence on the prior of the number of pairs, empty if it is part of the log-odds.
    next_best_cost : ln of the probability of the group's best hypothesis over that of the next best, None if there is
        no other or the group is too large to search. next_best : the pairs of ids that differ, (added, removed).
    """

    id: Any
    source: str
    other: str
    row: int
    usable: str
    group: int | None
    records: tuple[int, int]
    method: str
    competitors: tuple[Competitor, ...]
    prior: str
    next_best_cost: float | None
    next_best: tuple[list[tuple[Any, Any]], list[tuple[Any, Any]]]

    def __str__(self) -> str:
        return "\n".join(_lines(self))


def explain(result: Identified, record: Any, source: int) -> Explanation:
    """See :meth:`sameas.result.Identification.explain`."""
    own, other = (result.first, result.second) if source == 1 else (result.second, result.first)
    row = row_of(own.ids, record, own.source)
    at = own.at_row(row)
    if at is None:
        reason = str(own.set_aside.reasons[own.set_aside.rows == row][0])
        return Explanation(
            own.ids[row], own.source, other.source, row, reason, None, (0, 0), "", (), "", None, ([], [])
        )
    position = result.pairs.i if source == 1 else result.pairs.j
    own_pairs = np.flatnonzero(position == at)
    if not len(own_pairs):
        alone = Competitor(None, 1.0, 0.0, None, {}, None, None, True)
        return Explanation(
            own.ids[row], own.source, other.source, row, "", None, (1, 0), METHODS[0], (alone,), "", None, ([], [])
        )
    group = int(result.groups.of_pairs()[own_pairs[0]])
    problem = _GroupProblem(result, group)
    competitors = [problem.candidate(int(e), own_pairs, source) for e in own_pairs]
    competitors.append(problem.no_partner(own_pairs, competitors))
    competitors.sort(key=lambda c: (-c.probability, c.cost))
    cost, difference = problem.next_best()
    sizes = (int(result.groups.sizes_1[group]), int(result.groups.sizes_2[group]))
    return Explanation(
        own.ids[row], own.source, other.source, row, "", group, sizes, result.method(group), tuple(competitors),
        problem.prior_in_words(), cost, difference,
    )  # fmt: skip


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

    def __init__(self, result: Identified, group: int) -> None:
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
        ids = result.second.ids[result.rows_2] if source == 1 else result.first.ids[result.rows_1]
        terms = {name: float(values[e]) for name, values in result.evidence.terms.items()}
        prior = float(result.log_odds[e]) - sum(terms.values())
        if result.best.prior.slope is not None and abs(prior) > 1e-12:
            terms["prior"] = prior
        return Competitor(
            ids[e], float(result.p_pair[e]), max(0.0, cost), float(result.log_odds[e]), terms,
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
    if x.usable:
        return [f"{x.source} {x.id} (row {x.row}) could not be used: {x.usable}."]
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

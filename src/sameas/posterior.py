"""Posterior probabilities of pairs, summed over all one-to-one hypotheses of their group (METHOD 5).

Each group is solved by one of these methods, which is part of the result:

1. *Closed form*: one record has all the pairs of the group.
2. *Exact elimination*: records with one pair are folded into their partners, the others eliminated one by one; a prior
   of the count is carried along. This covers every group of up to about 16 records on its smaller side, and larger
   sparse ones, such as trees and chains. Pairs of large groups that are proved to be less probable than 1e-6 are
   dropped first, which splits most of these groups.
3. *Thinned*: sum-product messages show which pairs of an entangled group are nearly impossible. Most groups split
   without these pairs and are summed exactly.
4. *Local*: in what is still entangled, every record is solved exactly together with the records that compete with it
   most, with messages from the others. The group is thinned by these probabilities too, and its parts are summed
   exactly where it splits.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.assignment import Hypothesis
from sameas.groups import Groups, laid_out
from sameas.kernels import threads
from sameas.prior import LogPrior
from sameas.ragged import Ragged
from sameas.representation import in_short

#: Names of the methods, by the number in :attr:`Posterior.method`.
METHODS = (
    "closed form",
    "exact elimination",
    "local: exact around each record, messages beyond",
    "thinned: exact elimination without the least probable pairs",
)
ELIMINATED, APPROXIMATE, THINNED = 1, 2, 3
_NONE = np.empty(0, np.int64)

#: No limit on the records of a group.
EVERY = 2**62


#: Probabilities below which pairs of an entangled group are dropped, in turn until it splits.
THRESHOLDS = (1e-8, 1e-7, 1e-6, 1e-5, 1e-4)
NEIGHBOURHOOD_THRESHOLD = 1e-6  # the threshold from which on probabilities come from neighbourhoods instead of messages
#: Size of the exact neighbourhood around a record of an entangled group: its rows, and log2 of the choices among them.
NEIGHBOURHOOD_ROWS, NEIGHBOURHOOD_BITS = 8, 16.0
SWEEPS = 400  # greatest number of sweeps of sum-product messages
#: Relative change of a message at convergence, for single probabilities and for sums over many pairs.
TOLERANCE, ROUGH_TOLERANCE = 1e-8, 1e-4
LINEARISATIONS = 6  # how many times a prior of the count is linearised about the expected number of pairs
#: ``small`` and ``improbable`` for sums over many pairs; with a linear prior, groups of at most ROUGH_RECORDS records
#: on one side are summed exactly that need at most ``rough_sums`` partial sums a pair, about what messages cost.
ROUGH_SMALL, ROUGH_IMPROBABLE = 4, 1e-5
ROUGH_RECORDS = 1000


@dataclass(frozen=True)
class Tuning:
    """Limits of the exact posterior; the defaults are chosen with ``benchmarks/posterior.py``.

    Attributes
    ----------
    small : groups of at most this many records on one side are summed with every pair.
    improbable : pairs of larger groups that are proved to be less probable than this are dropped first, if the prior
        allows the proof.
    rough_sums : for sums over many pairs, the most partial sums a pair of a group that is summed exactly.
    """

    small: int = 16
    improbable: float = 1e-6
    rough_sums: float = 64.0


DEFAULT_TUNING = Tuning()

#: Pairs that a thread lays out again at a time, which takes 100 bytes each.
PAIRS_AT_ONCE = 200_000


@in_short
@dataclass(frozen=True)
class Posterior:
    """Posterior probabilities.

    p_pair : (m,) probability of each pair, in the order of the gate.
    method : (g,) index into :data:`METHODS`.
    excluded_below : (g,) pairs with a first estimate below this probability were not summed exactly; 0 if all were.
    message_change : largest relative change of a message in the last sweep (0 without messages).
    open : (m,) pairs that were summed exactly together with a record whose pairs are incomplete (``cut``); with all its
        pairs an exact sum may be impossible. In the order of the gate; None without ``cut``.
    """

    p_pair: FloatArray
    method: NDArray[np.int8]
    excluded_below: FloatArray
    message_change: float
    open: BoolArray | None = None

    def counts(self) -> dict[str, int]:
        """Number of groups solved by each method."""
        return {name: int(np.count_nonzero(self.method == k)) for k, name in enumerate(METHODS)}


def posterior(
    groups: Groups, best: Hypothesis, tuning: Tuning = DEFAULT_TUNING, cut: tuple[BoolArray, BoolArray] | None = None
) -> Posterior:
    """Probabilities of all pairs, with the evidence and prior of ``best``.

    cut : (n₁,), (n₂,) records of which some candidate pairs are missing.
    """
    m = len(groups.order)
    share = np.zeros(m)
    method = np.zeros(len(groups), np.int8)
    linear = best.prior.slope is not None
    _exact(groups, best, share, method, tuning.small if linear else EVERY)
    excluded_below = np.zeros(len(groups))
    message_change = 0.0
    open_pairs = _NONE
    edge = None if cut is None else _Edge.of(groups, cut, method)
    if np.count_nonzero(method == APPROXIMATE):
        if linear:
            open_pairs = _sum_probable(groups, best, method, share, excluded_below, tuning.improbable, edge)
        else:
            open_pairs = np.flatnonzero(np.repeat(method == APPROXIMATE, groups.pair_counts))
    if len(open_pairs):
        message_change = _local(groups, best, open_pairs, method, share, excluded_below, edge)
        total_1, total_2 = (np.bincount(place, share)[place] for place in groups.places)
        share = share / np.maximum(1.0, np.maximum(total_1, total_2))
        if not math.isfinite(float(share.sum())):
            raise ArithmeticError("a probability is not a number; please report this with the records")
    p_pair = groups.in_given_order(np.minimum(np.maximum(share, 0.0, out=share), 1.0, out=share))
    return Posterior(p_pair, method, excluded_below, message_change, None if edge is None else edge.pairs(groups))


@dataclass(frozen=True)
class _Edge:
    """Where the problem is cut off.

    cut : records of the layout of which pairs are missing. open : (m,) pairs of the layout that were summed exactly
    together with one of these; filled as sums are made.
    """

    cut: tuple[BoolArray, BoolArray]
    open: BoolArray

    @classmethod
    def of(cls, groups: Groups, cut: tuple[BoolArray, BoolArray], method: NDArray[np.int8]) -> _Edge:
        """From groups of which some have been summed."""
        edge = cls((cut[0][groups.rows_1], cut[1][groups.rows_2]), np.empty(0, np.bool_))
        with_cut = _with_any(groups.start_1, edge.cut[0]) | _with_any(groups.start_2, edge.cut[1])
        return cls(edge.cut, np.repeat(with_cut & (method != APPROXIMATE), groups.pair_counts))

    def note(self, thin: Thinned, pairs: IntArray, solved: BoolArray) -> None:
        """Mark ``solved`` pairs among these ``pairs`` of the layout, laid out as ``thin``."""
        g = thin.groups
        with_cut = _with_any(g.start_1, self.cut[0][g.rows_1]) | _with_any(g.start_2, self.cut[1][g.rows_2])
        self.open[pairs] = solved & thin.groups.in_given_order(np.repeat(with_cut, g.pair_counts))

    def pairs(self, groups: Groups) -> BoolArray:
        """(m,) ``open`` in the order of the gate."""
        return groups.in_given_order(self.open)


def _with_any(start: IntArray, records: BoolArray) -> BoolArray:
    """(g,) whether groups contain any of these records."""
    return np.asarray(np.logical_or.reduceat(records, start[:-1]) if len(records) else np.zeros(0, np.bool_))


def _sum_probable(
    groups: Groups, best: Hypothesis, method: NDArray[np.int8], share: FloatArray, excluded_below: FloatArray,
    improbable: float, edge: _Edge | None,
) -> IntArray:  # fmt: skip
    """Fill ``share`` of groups that split without the pairs proved improbable; returns the pairs still entangled."""
    large = method == APPROXIMATE
    _upper_bounds(groups, best, large, share)
    probable = np.flatnonzero(np.repeat(large, groups.pair_counts) & (share >= improbable))
    excluded_below[large & (np.minimum.reduceat(share, groups.start[:-1]) < improbable)] = improbable
    method[large] = ELIMINATED

    def fill(first: int, last: int) -> IntArray:
        """Fill the shares of a range of groups; returns the pairs still entangled."""
        some = probable[slice(*np.searchsorted(probable, groups.start[[first, last]]))]
        if not len(some):
            return some
        thin = Thinned.of(groups, best, some, best.weight[some])
        part, solved = thin.exact()
        if edge is not None:
            edge.note(thin, some, solved)
        share[some[solved]] = part[solved]
        return some[~solved]

    m = len(groups.order)
    parts = max(len(threads.even(m)) - 1, m // PAIRS_AT_ONCE)
    entangled = np.concatenate(threads.over(fill, groups.bounds(parts)))
    if len(entangled):
        method[groups.group[entangled]] = APPROXIMATE
    return entangled


def _upper_bounds(groups: Groups, best: Hypothesis, large: BoolArray, bound: FloatArray) -> None:
    """Fill ``bound`` (m,) with upper bounds of P of the pairs of the groups ``large`` (g,), with a linear prior."""
    from sameas.kernels.probability_bounds import bounds

    arguments = groups.layout, best.weight, best.chosen, large, bound
    threads.over(lambda a, b: bounds(a, b, *arguments), groups.bounds_of_threads())


def by_messages(groups: Groups, best: Hypothesis, tuning: Tuning = DEFAULT_TUNING) -> Posterior:
    """Probabilities of all pairs: exact where that is as fast as sum-product messages, by messages elsewhere.

    Messages are over-confident on short cycles; use them for sums over many pairs, as in estimation. Pairs that are
    proved to be less probable than 1e-5 get zero.
    """
    share = np.zeros(len(groups.order))
    method = np.zeros(len(groups), np.int8)
    linear = best.prior.slope is not None
    _exact(groups, best, share, method, ROUGH_RECORDS if linear else ROUGH_SMALL, tuning.rough_sums)
    change, large = 0.0, method == APPROXIMATE
    if not linear:
        change = PairMessages.of(groups, best, method, share, ROUGH_TOLERANCE).change
    elif large.any():
        bound = share.copy()
        _upper_bounds(groups, best, large, bound)
        probable = np.flatnonzero(np.repeat(large, groups.pair_counts) & (bound > ROUGH_IMPROBABLE))
        thin = Thinned.of(groups, best, probable, best.weight[probable])
        share[probable], messages = thin.by_messages(ROUGH_TOLERANCE)
        change = messages.change
    p_pair = groups.in_given_order(np.clip(share, 0.0, 1.0, out=share))
    return Posterior(p_pair, method, np.zeros(len(groups)), change)


def log_evidence(groups: Groups, best: Hypothesis, p_pair: FloatArray) -> FloatArray:
    """(g,) ln Z: ln of the sum over all hypotheses of a group of exp(Σ weight), under a linear prior.

    Z of METHOD 6, equation 6.1c.

    Exact where elimination is; elsewhere the Bethe approximation, which is exact on trees,

        ln Z = Σ p w − Σ p ln p + Σ (1 − p) ln(1 − p) − Σ p₀ ln p₀,

    with p₀ the probabilities of the records to have no partner.

    p_pair : (m,) probabilities of the pairs, in the order of the gate.
    """
    from sameas.kernels.posterior import log_sums

    out = np.zeros(len(groups))
    arguments = groups.layout, best.weight, best.dual_1, best.dual_2, out
    threads.over(lambda a, b: log_sums(a, b, *arguments), groups.bounds_of_threads())
    rough = np.isnan(out)
    if rough.any():
        out[rough] = bethe_log_sum(groups, best.weight, p_pair[groups.order])[rough]
    return out


def bethe_log_sum(groups: Groups, weight: FloatArray, share: FloatArray) -> FloatArray:
    """(g,) Bethe's ln Z, from pairs (m,) in the layout of the groups."""
    of_pairs = share * weight - _p_log_p(share) + _p_log_p(1.0 - share)
    total = np.add.reduceat(of_pairs, groups.start[:-1])
    for place, rows, start in zip(groups.places, (groups.rows_1, groups.rows_2), (groups.start_1, groups.start_2),
                                  strict=True):  # fmt: skip
        alone = np.maximum(1.0 - np.bincount(place, share, len(rows)), 0.0)
        total -= np.add.reduceat(_p_log_p(alone), start[:-1])
    return np.asarray(total)


def _p_log_p(p: FloatArray) -> FloatArray:
    """p ln p, 0 at 0."""
    return np.asarray(p * np.log(np.maximum(p, np.finfo(float).tiny)))


@dataclass(frozen=True)
class PairMessages:
    """Sum-product messages of the APPROXIMATE groups.

    weight : (m,) with a linear prior. claims_1 : (m,) odds with which record 1 claims record 2; claims_2 : the reverse.
    change : largest relative change of a message in the last sweep.
    """

    weight: FloatArray
    claims_1: FloatArray
    claims_2: FloatArray
    change: float

    @classmethod
    def of(
        cls, groups: Groups, best: Hypothesis, method: NDArray[np.int8], share: FloatArray, tolerance: float
    ) -> PairMessages:
        """Messages with the prior linearised about the expected number of pairs; fills ``share``."""
        limits = SWEEPS, tolerance
        if best.prior.slope is not None:
            return cls._with_weight(best.weight, groups, best, method, share, limits)
        size = np.add.reduceat(best.chosen.astype(np.float64), groups.start[:-1])
        for _ in range(LINEARISATIONS):
            weight = best.weight + np.repeat(_local_slopes(best, size), groups.pair_counts)
            messages = cls._with_weight(weight, groups, best, method, share, limits)
            previous, size = size, np.add.reduceat(share, groups.start[:-1])
            if np.all((np.abs(size - previous) < 0.5) | (method != APPROXIMATE)):
                break
        return messages

    @classmethod
    def _with_weight(
        cls, weight: FloatArray, groups: Groups, best: Hypothesis, method: NDArray[np.int8], share: FloatArray,
        limits: tuple[int, float],
    ) -> PairMessages:  # fmt: skip
        from sameas.kernels.messages import messages

        claims = np.zeros(len(weight)), np.zeros(len(weight))
        arguments = groups.layout, weight, best.dual_1, best.dual_2, method, *claims, share, *limits
        changes = threads.over(lambda a, b: messages(a, b, *arguments), groups.bounds_of_threads())
        return cls(weight, *claims, float(max(changes, default=0.0)))


def _exact(
    groups: Groups,
    best: Hypothesis,
    share: FloatArray,
    method: NDArray[np.int8],
    most: int = EVERY,
    sums_per_pair: float = math.inf,
) -> None:
    """Fill ``share`` and ``method`` of the groups that can be summed exactly; mark the others APPROXIMATE.

    most : groups of more records than this on both sides are skipped. sums_per_pair : with a linear prior, groups that
    need more partial sums are skipped.
    """
    from sameas.kernels.posterior import exact, exact_counted

    bounds, layout, prior = groups.bounds_of_threads(), groups.layout, best.prior
    duals = best.dual_1, best.dual_2
    if prior.slope is not None:
        linear = layout, best.weight, *duals, most, sums_per_pair, share, method
        threads.over(lambda a, b: exact(a, b, *linear), bounds)
    else:
        counts = prior.start, prior.table, best.multiplier
        counted = layout, best.weight, best.chosen, *duals, *counts, most, share, method
        threads.over(lambda a, b: exact_counted(a, b, *counted), bounds)


def _local(
    groups: Groups, best: Hypothesis, open_pairs: IntArray, method: NDArray[np.int8], share: FloatArray,
    excluded_below: FloatArray, edge: _Edge | None,
) -> float:  # fmt: skip
    """Fill ``share`` of the pairs that elimination gave up; returns the last relative change of the messages.

    ``method`` becomes THINNED for groups that split into parts that can be summed, and ``excluded_below`` the
    probability, as first estimated, below which their pairs keep that estimate.
    """
    messages = _messages(groups, best, open_pairs, method, share)
    group = groups.group
    method[method == APPROXIMATE] = THINNED
    for threshold in THRESHOLDS:
        if threshold == NEIGHBOURHOOD_THRESHOLD:
            # From here on the dropped pairs matter, and messages alone are too over-confident to choose them.
            share[open_pairs] = neighbourhoods(groups, best, open_pairs, messages)
        excluded_below[group[open_pairs]] = threshold
        probable = open_pairs[(share[open_pairs] > threshold) | best.chosen[open_pairs]]
        thin = Thinned.of(groups, best, probable, messages.weight[probable])
        part, solved = thin.exact()
        if edge is not None:
            edge.note(thin, probable, solved)
        share[probable[solved]] = part[solved]
        open_pairs = probable[~solved]
        if not len(open_pairs):
            break
    method[group[open_pairs]] = APPROXIMATE
    return messages.change


def _messages(
    groups: Groups, best: Hypothesis, open_pairs: IntArray, method: NDArray[np.int8], share: FloatArray
) -> PairMessages:
    """Messages among the pairs that elimination gave up; fills their ``share``."""
    m = len(share)
    if best.prior.slope is None:  # linearised group by group
        p_messages = np.zeros(m)
        messages = PairMessages.of(groups, best, method, p_messages, TOLERANCE)
        share[open_pairs] = p_messages[open_pairs]
        return messages
    thin = Thinned.of(groups, best, open_pairs, best.weight[open_pairs])
    share[open_pairs], messages = thin.by_messages(TOLERANCE)
    claims = np.zeros(m), np.zeros(m)
    claims[0][open_pairs], claims[1][open_pairs] = messages.claims_1, messages.claims_2
    return PairMessages(best.weight, *claims, messages.change)


def neighbourhoods(groups: Groups, best: Hypothesis, pairs: IntArray, messages: PairMessages) -> FloatArray:
    """Probabilities of some pairs from the neighbourhoods of their records: the mean of those around both records."""
    one = Thinned.of(groups, best, pairs, messages.weight[pairs])
    around_1 = one.by_neighbourhoods(messages.claims_1[pairs])
    del one
    order = np.lexsort([place[pairs] for place in groups.places])
    by_2 = pairs[order]
    two = Thinned.of(groups, best, by_2, messages.weight[by_2], swapped=True)
    around_2 = np.empty_like(around_1)
    around_2[order] = two.by_neighbourhoods(messages.claims_2[by_2])
    return 0.5 * (around_1 + around_2)


@dataclass(frozen=True)
class Thinned:
    """The remaining pairs of entangled groups, laid out as new groups, with a linear prior."""

    groups: Groups
    best: Hypothesis

    @classmethod
    def of(
        cls, groups: Groups, best: Hypothesis, pairs: IntArray, weight: FloatArray, *, swapped: bool = False
    ) -> Thinned:
        """The groups of some ``pairs``, sorted by group and record 1; ``swapped`` exchanges the sources, with pairs
        sorted by record 2."""
        ends = pairs[[0, -1]] if len(pairs) else np.zeros(2, np.int64)
        first, last = np.searchsorted(groups.start, ends, side="right") - (1, 0)
        of_all = np.repeat(np.arange(last - first, dtype=np.int32), groups.pair_counts[first:last])
        group = of_all[pairs - groups.start[first]]
        # Records are counted from those of the first of these groups, so that a few groups need little memory.
        begins = groups.start_1[first], groups.start_2[first]
        starts = [
            (start[first : last + 1] - begin).astype(np.int32)
            for start, begin in zip((groups.start_1, groups.start_2), begins, strict=True)
        ]
        places = starts[0][group] + groups.local_1[pairs], starts[1][group] + groups.local_2[pairs]
        duals = tuple(
            dual[begin : begin + start[-1]]
            for dual, begin, start in zip((best.dual_1, best.dual_2), begins, starts, strict=True)
        )
        if swapped:
            places, duals, begins = places[::-1], duals[::-1], begins[::-1]
        thin = laid_out(*places, *places, len(duals[0]), len(duals[1]))
        linear = LogPrior(np.zeros(len(thin)), np.zeros(len(thin) + 1, np.int64), np.empty(0))
        chosen, weight = best.chosen[pairs][thin.order], weight[thin.order]
        state = (chosen, weight, duals[0][thin.rows_1], duals[1][thin.rows_2], np.zeros(len(thin)), linear)
        rows_1, rows_2 = thin.rows_1 + np.int32(begins[0]), thin.rows_2 + np.int32(begins[1])
        return cls(replace(thin, rows_1=rows_1, rows_2=rows_2), Hypothesis(*state))

    def exact(self) -> tuple[FloatArray, BoolArray]:
        """Probability of every pair, and whether its part could be summed exactly."""
        share = np.zeros(len(self.groups.order))
        method = np.zeros(len(self.groups), np.int8)
        _exact(self.groups, self.best, share, method)
        solved = np.repeat(method != APPROXIMATE, self.groups.pair_counts)
        return self.groups.in_given_order(share), self.groups.in_given_order(solved)

    def by_messages(self, tolerance: float) -> tuple[FloatArray, PairMessages]:
        """Probability of every pair by messages alone, and the messages, in the order of the given pairs."""
        share = np.zeros(len(self.groups.order))
        method = np.full(len(self.groups), APPROXIMATE, np.int8)
        messages = PairMessages.of(self.groups, self.best, method, share, tolerance)
        of_pairs = (messages.weight, messages.claims_1, messages.claims_2)
        weight, claims_1, claims_2 = (self.groups.in_given_order(values) for values in of_pairs)
        return self.groups.in_given_order(share), PairMessages(weight, claims_1, claims_2, messages.change)

    def by_neighbourhoods(self, claims: FloatArray) -> FloatArray:
        """Probability of every pair from the neighbourhood of its record, with these messages (``claims``)."""
        from sameas.kernels.balls import Graph, balls, rank_rivals
        from sameas.kernels.posterior import MAX_DEPTH

        g, best = self.groups, self.best
        column, claim = g.places[1].astype(np.int32), claims[g.order]
        reduced = np.maximum(best.weight - best.dual_1[g.places[0]] - best.dual_2[column], -700.0)
        none, free = (np.exp(np.maximum(-dual, -MAX_DEPTH)) for dual in (best.dual_1, best.dual_2))
        odds, by_column = np.exp(reduced), np.argsort(column, kind="stable")
        start, rival = (
            Ragged.of_sorted(g.places[1][by_column], len(free)).start,
            g.places[0][by_column].astype(np.int32),
        )
        graph = Graph(g.edges_1, column, odds, claim, start, rival, claim[by_column], odds[by_column], none, free)
        rivals = np.empty((len(none), NEIGHBOURHOOD_ROWS), np.int32)
        strength, share = np.empty(rivals.shape), np.zeros(len(g.order))
        ranges = threads.even(len(none), least=256)
        threads.over(lambda a, b: rank_rivals(a, b, graph, rivals, strength), ranges)
        threads.over(lambda a, b: balls(a, b, graph, rivals, strength, NEIGHBOURHOOD_BITS, share), ranges)
        return self.groups.in_given_order(share)


def _local_slopes(best: Hypothesis, size: FloatArray) -> FloatArray:
    """(g,) slope of ln P(k) at ``size`` pairs."""
    start = best.prior.start[:-1]
    most = np.diff(best.prior.start) - 1
    middle = np.clip(np.round(size).astype(np.int64), 0, most)
    low, high = np.maximum(middle - 1, 0), np.minimum(middle + 1, most)
    return np.asarray((best.prior.table[start + high] - best.prior.table[start + low]) / (high - low))

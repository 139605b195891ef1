"""Compiled posterior probabilities of groups that can be summed exactly.

Weights are reduced by the duals of the best hypothesis, w − u − v ≤ 0. That hypothesis then weighs 1 and every other
one at most 1: nothing overflows, and what underflows is negligible.

Without a prior of the count, a group is summed in closed form where one record has all pairs, by folding leaves
(:mod:`sameas.kernels.folding`) where it is a tree, and by eliminating the records of its core
(:mod:`sameas.kernels.elimination`) elsewhere. With a prior of the count, all records
are eliminated, and every partial sum is a polynomial: one number for each number of pairs.
"""

from __future__ import annotations

import math
from collections import namedtuple
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import BoolArray, FloatArray, Int32Array, IntArray
from sameas.kernels.compiled import borrowing_part, part, small_by
from sameas.kernels.components import GroupLayout, sizes
from sameas.kernels.elimination import Elimination, elimination, log_sum_core, next_state, plan_elimination, sum_core
from sameas.kernels.folding import Forest, core_of, fold, forest, unfold, unfolded

#: How a group was solved: in closed form, exactly by folding and elimination, or not here.
CLOSED, ELIMINATED, LOCAL = 0, 1, 2
#: Reduced log weights are at least −MAX_DEPTH; counts with a log factor of MAX_LOG_PRIOR or more are excluded.
MAX_DEPTH, MAX_LOG_PRIOR = 600.0, 300.0
#: Groups of two records of one source and at most this many of the other are summed hypothesis by hypothesis.
MAX_RECORDS_AGAINST_TWO = 4


@borrowing_part
def bounded_exp(x: float) -> float:
    """exp(x) for x ≤ 0, at least exp(−MAX_DEPTH), so never 0."""
    return math.exp(max(x, -MAX_DEPTH))


@borrowing_part
def reduced(
    g: int, layout: GroupLayout, weight: FloatArray, u: FloatArray, v: FloatArray, alone: FloatArray, odds: FloatArray
) -> float:
    """Write the reduced problem of group g: odds of no partner to ``alone`` (n₁ + n₂ or more), odds of its pairs to
    ``odds``. Returns the sum of the duals, by which the ln weight of every hypothesis is reduced: that of the best."""
    low, base1, base2 = layout.start[g], layout.start1[g], layout.start2[g]
    n1, local1, local2 = layout.start1[g + 1] - base1, layout.local1, layout.local2
    total = 0.0
    for r in range(n1):
        total += u[base1 + r]
        alone[r] = bounded_exp(-u[base1 + r])
    for c in range(layout.start2[g + 1] - base2):
        total += v[base2 + c]
        alone[n1 + c] = bounded_exp(-v[base2 + c])
    for e in range(low, layout.start[g + 1]):
        odds[e - low] = math.exp(max(weight[e] - u[base1 + local1[e]] - v[base2 + local2[e]], -700.0))
    return total


@borrowing_part
def star(low: int, high: int, weight: FloatArray, share: FloatArray) -> None:
    """Write ``share`` where one record has all the pairs of the group: the softmax of their weights and 0 (alone)."""
    top = 0.0
    for e in range(low, high):
        top = max(top, weight[e])
    total = math.exp(-top)
    for e in range(low, high):
        share[e] = math.exp(weight[e] - top)
        total += share[e]
    for e in range(low, high):
        share[e] /= total


@part
def count_factors(prior: FloatArray, slope: float, size: int) -> FloatArray:
    """exp(ln P(k) − ln P(k₀) − μ (k − k₀)), k₀ = ``size`` the number of pairs of the best hypothesis; 0 where the
    logarithm is MAX_LOG_PRIOR or more."""
    factors = np.zeros(len(prior))
    for k in range(len(prior)):
        x = prior[k] - prior[size] - slope * (k - size)
        if x < MAX_LOG_PRIOR:
            factors[k] = math.exp(max(x, -700.0))
    return factors


def _sums(first: int, last: int, layout: GroupLayout, *rest: Any) -> float:
    """Upper bound of the work: sums double with each record of the smaller side, and every pair is added in each."""
    pairs, one, two = sizes(first, last, layout)
    return 10.0 * float(np.sum(pairs * 2.0 ** (np.minimum(np.minimum(one, two), 50) - 1)))


@borrowing_part
def two_at_most(
    n1: int, n2: int, first: Int32Array, second: Int32Array, odds: FloatArray, odds_alone: FloatArray, share: FloatArray
) -> None:
    """Write ``share`` (m,) of a group whose hypotheses have at most two pairs, summed hypothesis by hypothesis.

    Planning an elimination would take ten times as long. odds_alone : (n₁ + n₂,) odds of having no partner.
    """
    total = 1.0
    for x in range(n1 + n2):
        total *= odds_alone[x]
    for e in range(len(first)):
        value = odds[e]
        for x in range(n1 + n2):
            value *= 1.0 if x == first[e] or x == n1 + second[e] else odds_alone[x]
        share[e] = value
        total += value
    for e in range(len(first)):
        for f in range(e):
            if first[e] == first[f] or second[e] == second[f]:
                continue
            value = odds[e] * odds[f]
            for x in range(n1 + n2):
                taken = x == first[e] or x == first[f] or x == n1 + second[e] or x == n1 + second[f]
                value *= 1.0 if taken else odds_alone[x]
            share[e] += value
            share[f] += value
            total += value
    for e in range(len(first)):
        share[e] /= total


def _sums_of_small(first: int, last: int, layout: GroupLayout, *rest: Any) -> float:
    """The same, of at most ``sums_per_pair``; 1 item for a group of more than ``most`` records on both sides."""
    most, sums_per_pair = rest[3:5]
    pairs, one, two = sizes(first, last, layout)
    records = np.minimum(one, two)
    sums = pairs * np.minimum(2.0 ** (np.minimum(records, 50) - 1), sums_per_pair)
    return 10.0 * float(np.sum(np.where(records <= most, sums, 0.1)))


@small_by(_sums_of_small)
def exact(
    first: int, last: int, layout: GroupLayout, weight: FloatArray, u: FloatArray, v: FloatArray, most: int,
    sums_per_pair: float, share: FloatArray, method: NDArray[np.int8],
) -> None:  # fmt: skip
    """Write the exact posterior ``share`` (m,) of the pairs of the groups first … last − 1, under a linear prior.

    method (g,) receives CLOSED, ELIMINATED or LOCAL. LOCAL groups have no share written: both sides have more than
    ``most`` records, or the elimination needs more than ``sums_per_pair`` partial sums a pair, or MAX_SUMS.
    """
    start, start1, start2 = layout.start, layout.start1, layout.start2
    records, pairs = np.int64(2), np.int64(1)
    for g in range(first, last):
        n1, n2 = start1[g + 1] - start1[g], start2[g + 1] - start2[g]
        if 1 < min(n1, n2) <= most:
            records = max(records, n1 + n2)
            pairs = max(pairs, start[g + 1] - start[g])
    work = forest(records), elimination(records, pairs)
    of_pairs = np.empty(pairs), np.empty(pairs)
    of_core = np.empty(records, np.int64), np.empty(records), np.empty(records), np.empty(records)
    _exact(first, last, layout, weight, u, v, most, sums_per_pair, work, of_pairs, of_core, share, method)


@borrowing_part
def _exact(
    first: int, last: int, layout: GroupLayout, weight: FloatArray, u: FloatArray, v: FloatArray, most: int,
    sums_per_pair: float, work: tuple[Forest, Elimination], of_pairs: tuple[FloatArray, FloatArray],
    of_core: tuple[IntArray, FloatArray, FloatArray, FloatArray], share: FloatArray, method: NDArray[np.int8],
) -> None:  # fmt: skip
    """:func:`exact` with workspaces for the largest group: of its pairs (odds, odds in the core) and of the records of
    its core (number, odds of having no partner, probabilities of none and of one)."""
    start, start1, start2 = layout.start, layout.start1, layout.start2
    tree, graph = work
    odds, core_odds = of_pairs
    record, core_alone, p_alone, p_taken = of_core
    alone = tree.odds_alone
    for g in range(first, last):
        low, high = start[g], start[g + 1]
        n1, n2 = start1[g + 1] - start1[g], start2[g + 1] - start2[g]
        if n1 == 1 or n2 == 1:
            method[g] = CLOSED
            star(low, high, weight, share)
            continue
        method[g] = LOCAL
        if min(n1, n2) > most:
            continue
        reduced(g, layout, weight, u, v, alone, odds)
        one, two, p_pair = layout.local1[low:high], layout.local2[low:high], share[low:high]
        if min(n1, n2) == 2 and max(n1, n2) <= MAX_RECORDS_AGAINST_TWO:
            two_at_most(n1, n2, one, two, odds, alone, p_pair)
            method[g] = ELIMINATED
            continue
        leaves = fold(n1, n2, one, two, odds[: high - low], tree)
        if leaves < n1 + n2 - 1:
            n = core_of(n1, n2, one, two, odds, tree, record, graph, core_odds)
            max_sums = np.int64(min(float(len(graph.sum)), sums_per_pair * (high - low)))
            if not plan_elimination(n, max_sums, graph):
                continue
            for x in range(n):
                core_alone[x] = alone[record[x]]
            sum_core(n, core_odds, core_alone, graph, p_pair, p_alone, p_taken)
            for x in range(n):
                tree.p_alone[record[x]], tree.p_taken[record[x]] = p_alone[x], p_taken[x]
        unfold(leaves, n1, one, two, tree, p_pair)
        method[g] = ELIMINATED


@small_by(_sums)
def log_sums(
    first: int, last: int, layout: GroupLayout, weight: FloatArray, u: FloatArray, v: FloatArray, out: FloatArray
) -> None:
    """Write to ``out`` (g,) ln Σ over hypotheses of exp(Σ weight) of the groups first … last − 1, the sum that
    :func:`exact` divides by; NaN where the elimination needs too many partial sums."""
    start, start1, start2 = layout.start, layout.start1, layout.start2
    records, pairs = np.int64(2), np.int64(1)
    for g in range(first, last):
        records = max(records, start1[g + 1] - start1[g] + start2[g + 1] - start2[g])
        pairs = max(pairs, start[g + 1] - start[g])
    tree, graph = forest(records), elimination(records, pairs)
    odds, core_odds = np.empty(pairs), np.empty(pairs)
    record, core_alone = np.empty(records, np.int64), np.empty(records)
    for g in range(first, last):
        low, high = start[g], start[g + 1]
        n1, n2 = start1[g + 1] - start1[g], start2[g + 1] - start2[g]
        total = reduced(g, layout, weight, u, v, tree.odds_alone, odds)
        one, two = layout.local1[low:high], layout.local2[low:high]
        leaves = fold(n1, n2, one, two, odds[: high - low], tree)
        total += tree.log_scale[0]
        if leaves == n1 + n2 - 1:
            # A tree is summed into the partner of its last leaf.
            x, e = tree.leaf[leaves - 1], tree.leaf_pair[leaves - 1]
            root = n1 + two[e] if x < n1 else np.int64(one[e])
            out[g] = total + math.log(tree.odds_alone[root])
            continue
        n = core_of(n1, n2, one, two, odds, tree, record, graph, core_odds)
        if not plan_elimination(n, np.int64(len(graph.sum)), graph):
            out[g] = np.nan
            continue
        for x in range(n):
            core_alone[x] = tree.odds_alone[record[x]]
        out[g] = total + log_sum_core(n, core_odds, core_alone, graph)


#: Maximum number of values of the polynomials of one group; terms are negligible relative to the whole sum below this.
MAX_VALUES, NEGLIGIBLE = 1 << 22, 1e-14

#: By step: ``start`` of its polynomials, the least number of pairs ``low`` and how many numbers, ``width``, they have.
CountSteps = namedtuple("CountSteps", "start low width")


@borrowing_part
def _forward_counted(
    n: int, odds: FloatArray, odds_alone: FloatArray, prior: FloatArray, work: Elimination, counts: CountSteps,
    value: FloatArray,
) -> bool:  # fmt: skip
    """``elimination._forward`` of polynomials, without the terms that are negligible; False if they are more than
    ``value`` has room for. prior : factor of each number of pairs."""
    start, low, width, sum_size, bit = counts.start, counts.low, counts.width, work.sum_size, work.choice_bit
    choice_start, choice_odds = work.choice_start, work.choice_odds
    for k in range(choice_start[n]):
        choice_odds[k] = odds[work.choice_pair[k]]
    start[0], low[0], width[0], value[0], log_scale = 0, 0, 1, 1.0, 0.0
    for t in range(n):
        own, others, w = work.own_bit[t], work.open_bits[t] & ~work.own_bit[t], width[t]
        now, then, wider = start[t], start[t] + sum_size[t] * w, min(w + 1, len(prior) - low[t])
        if then + sum_size[t + 1] * wider > len(value):
            return False
        value[then : then + sum_size[t + 1] * wider] = 0.0
        for k in range(choice_start[t], choice_start[t + 1]):
            s = np.int64(0)
            while s >= 0:
                a, b = now + s * w, then + (s | bit[k]) * wider + 1
                for j in range(min(w, wider - 1)):
                    value[b + j] += value[a + j] * choice_odds[k]
                s = next_state(s, others & ~bit[k])
        factor = odds_alone[work.order[t]]
        s = np.int64(0)
        while s >= 0:
            for j in range(w):
                value[then + s * wider + j] += value[now + s * w + j] * factor
                if own:
                    value[then + s * wider + j] += value[now + (s | own) * w + j]
            s = next_state(s, others)
        start[t + 1] = then
        log_scale = _trimmed(t + 1, wider, prior, work, counts, log_scale, value)
    return True


@borrowing_part
def _trimmed(
    t: int, wide: int, prior: FloatArray, work: Elimination, counts: CountSteps, log_scale: float, value: FloatArray
) -> float:
    """Scale the polynomials of a step, of ``wide`` terms each, to at most 1 and leave out the numbers of pairs that are
    negligible; returns ``log_scale`` with the new scale.

    A small value may be followed by a large prior: it is negligible if, before all scaling and times the largest prior
    from its number on, it is so relative to 1, the weight of the hypothesis by which the problem is reduced.
    """
    begin, states, least = counts.start[t], work.sum_size[t], counts.low[t - 1]
    largest, low, high, ahead = 0.0, np.int64(wide), np.int64(0), 0.0
    for k in range(len(prior) - 1, least + wide - 1, -1):
        ahead = max(ahead, prior[k])
    for j in range(wide - 1, -1, -1):
        ahead, greatest = max(ahead, prior[least + j]), 0.0
        for s in range(states):
            greatest = max(greatest, value[begin + s * wide + j])
        largest = max(largest, greatest)
        if greatest * ahead > NEGLIGIBLE * math.exp(-log_scale):
            low, high = np.int64(j), max(high, j + 1)
    counts.low[t], counts.width[t] = least + low, high - low
    for s in range(states):
        for j in range(high - low):
            value[begin + s * (high - low) + j] = value[begin + s * wide + low + j] / largest
    return log_scale + math.log(largest)


@borrowing_part
def _backward_counted(
    n: int, odds_alone: FloatArray, prior: FloatArray, work: Elimination, counts: CountSteps, value: FloatArray,
    suffix: FloatArray, p_pair: FloatArray,
) -> None:  # fmt: skip
    """``elimination._backward`` of polynomials; the last ones are the prior."""
    start, low, width, sum_size, bit = counts.start, counts.low, counts.width, work.sum_size, work.choice_bit
    choice_start, choice_pair = work.choice_start, work.choice_pair
    for j in range(width[n]):
        value[start[n] + j] = prior[low[n] + j]
    for t in range(n - 1, -1, -1):
        own, others, w = work.own_bit[t], work.open_bits[t] & ~work.own_bit[t], width[t]
        now, then, after, ahead = start[t], start[t + 1], width[t + 1], low[t] - low[t + 1]
        suffix[: sum_size[t] * w] = 0.0
        total, factor = 0.0, odds_alone[work.order[t]]
        s = np.int64(0)
        while s >= 0:
            for j in range(max(-ahead, 0), min(w, after - ahead)):
                later = value[then + s * after + j + ahead]
                suffix[s * w + j] = factor * later
                total += value[now + s * w + j] * factor * later
                if own:
                    suffix[(s | own) * w + j] = later
                    total += value[now + (s | own) * w + j] * later
            s = next_state(s, others)
        for k in range(choice_start[t], choice_start[t + 1]):
            factor, p = work.choice_odds[k], 0.0
            s = np.int64(0)
            while s >= 0:
                for j in range(max(-ahead - 1, 0), min(w, after - ahead - 1)):
                    later = factor * value[then + (s | bit[k]) * after + j + ahead + 1]
                    p += value[now + s * w + j] * later
                    suffix[s * w + j] += later
                s = next_state(s, others & ~bit[k])
            p_pair[choice_pair[k]] = p
            total += p
        for k in range(choice_start[t], choice_start[t + 1]):
            p_pair[choice_pair[k]] /= total
        largest = 0.0
        for at in range(sum_size[t] * w):
            # What cannot be reached does not count in the scale.
            suffix[at] = suffix[at] if value[now + at] != 0.0 else 0.0
            largest = max(largest, suffix[at])
        for at in range(sum_size[t] * w):
            value[now + at] = suffix[at] / largest


@small_by(_sums)
def exact_counted(
    first: int, last: int, layout: GroupLayout, weight: FloatArray, chosen: BoolArray, u: FloatArray, v: FloatArray,
    table_start: IntArray, table: FloatArray, slope: FloatArray, most: int, share: FloatArray,
    method: NDArray[np.int8],
) -> None:  # fmt: skip
    """:func:`exact` under any prior of the count: ``weight`` excludes it (see ``assign_counted``).

    table[table_start[g] + k] : ln P of k pairs. slope : (g,) its multiplier μ at the best hypothesis.
    """
    start, start1, start2, _, local1, local2 = layout
    records, pairs = np.int64(2), np.int64(1)
    for g in range(first, last):
        n1, n2 = start1[g + 1] - start1[g], start2[g + 1] - start2[g]
        if 1 < min(n1, n2) <= most:
            records = max(records, n1 + n2)
            pairs = max(pairs, start[g + 1] - start[g])
    tree, graph, odds = forest(records), elimination(records, pairs), np.empty(pairs)
    record, core_odds, p_pair = np.empty(records, np.int64), np.empty(pairs), np.empty(pairs)
    counts = CountSteps(np.empty(records + 1, np.int64), np.empty(records + 1, np.int64),
                        np.empty(records + 1, np.int64))  # fmt: skip
    value = np.empty(min(MAX_VALUES, (records + 2) * records << records) if records < 22 else MAX_VALUES)
    suffix = np.empty(len(value))
    for g in range(first, last):
        low, high = start[g], start[g + 1]
        n1, n2 = start1[g + 1] - start1[g], start2[g + 1] - start2[g]
        log_p = table[table_start[g] : table_start[g + 1]]
        if n1 == 1 or n2 == 1:
            method[g] = CLOSED
            for e in range(low, high):
                share[e] = weight[e] + log_p[1] - log_p[0]
            star(low, high, share, share)
            continue
        method[g] = LOCAL
        if min(n1, n2) > most:
            continue
        size = np.int64(0)
        for e in range(low, high):
            size += chosen[e]
            share[e] = weight[e] + slope[g]
        reduced(g, layout, share, u, v, tree.odds_alone, odds)
        one, two, n = local1[low:high], local2[low:high], n1 + n2
        unfolded(n1, n2, one, two, tree)
        core_of(n1, n2, one, two, odds, tree, record, graph, core_odds)
        prior = count_factors(log_p, slope[g], size)
        if not plan_elimination(n, np.int64(len(graph.sum)), graph):
            continue
        if not _forward_counted(n, core_odds, tree.odds_alone, prior, graph, counts, value):
            continue
        _backward_counted(n, tree.odds_alone, prior, graph, counts, value, suffix, p_pair)
        method[g] = ELIMINATED
        for e in range(low, high):
            share[e] = p_pair[e - low]

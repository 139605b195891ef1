"""Compiled posterior probabilities of groups that can be summed exactly.

Weights are reduced by the duals of the best hypothesis, w − u − v ≤ 0. That hypothesis then weighs 1 and every other
one at most 1: nothing overflows, and what underflows is negligible.

Without a prior of the count, a group is summed in closed form where one record has all pairs, by folding leaves where
it is a tree, and by eliminating the records of its core one by one elsewhere. With a prior of the count, all records
are eliminated, and every partial sum is a polynomial: one number for each number of pairs.
"""

from __future__ import annotations

import math
from collections import namedtuple
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import BoolArray, FloatArray, Int32Array, IntArray
from sameas.kernels.compiled import borrowing_part, inlined, part, small_by
from sameas.kernels.components import GroupLayout, sizes

# Exact sums by eliminating records one by one.
#
# A record is *open* from the elimination of its first neighbour until its own; one bit says whether it has a partner by
# then. Every step has an array of partial sums, indexed by the bits of the open records. Eliminating a record that has
# no partner yet either leaves it alone or pairs it with a neighbour that is not eliminated. The order of elimination,
# through records of both sources, keeps few records open.

#: Maximum number of partial sums of one group.
MAX_SUMS = 1 << 22
#: Maximum number of open records: their sums fill MAX_SUMS, and far more would not fit into the bits of a word.
MAX_OPEN = 22
#: A group of more than RETRY_ABOVE sums is ordered from STARTS different first records; the order with the fewest sums
#: is used.
RETRY_ABOVE, STARTS = 2048, 8
#: Every RESCALE_EVERY steps, sums are divided by their largest if that is not within this factor of 1.
RESCALE_EVERY, RESCALE_BEYOND = 4, 1e60
#: Groups of two records of one source and at most this many of the other are summed hypothesis by hypothesis.
MAX_RECORDS_AGAINST_TWO = 4
#: Next is eliminated the record after which fewest are open; ties by fewest choices, then lowest number. A ``rank`` is
#: the sum of the growth of the open records times GROWTH, the choices times CHOICE, and the number.
GROWTH, CHOICE = 1 << 42, 1 << 22
#: States of a record while the order is found; ADJACENT: not open, but next to an open record.
UNTOUCHED, ADJACENT, OPEN, DONE = 0, 1, 2, 3

#: Workspace of the elimination.
#:
#: The graph: ``start`` CSR by record, of its ``neighbour`` records and the ``pair`` with each.
#: By step: ``order`` the record eliminated, ``own_bit`` its bit, ``open_bits`` those of all open records before it,
#: ``sum_start`` and ``sum_size`` the partial sums before it, ``choice_start`` CSR of its choices: the ``choice_bit`` of
#: the neighbour, ``choice_pair``, ``choice_odds``.
#: By record, while the order is found: ``state``, ``bit``, ``n_left`` neighbours not eliminated and ``xor_left`` the
#: exclusive or of their numbers, ``rank`` by which the next one is chosen; ``active`` lists the candidates for it.
#: ``sum``: the partial sums; ``suffix``: those of one step on the way back.
Elimination = namedtuple(
    "Elimination",
    "start neighbour pair order own_bit open_bits sum_start sum_size choice_start choice_bit choice_pair choice_odds "
    "state bit n_left xor_left rank active sum suffix",
)


@part
def elimination(records: int, pairs: int) -> Elimination:
    """A workspace for groups of at most this many records and pairs, and of at most MAX_SUMS partial sums."""
    return Elimination(
        np.empty(records + 1, np.int64),
        np.empty(2 * pairs, np.int64),
        np.empty(2 * pairs, np.int64),
        np.empty(records, np.int64),
        np.empty(records, np.int64),
        np.empty(records + 1, np.int64),
        np.empty(records + 1, np.int64),
        np.empty(records + 1, np.int64),
        np.empty(records + 1, np.int64),
        np.empty(pairs, np.int64),
        np.empty(pairs, np.int64),
        np.empty(pairs),
        np.empty(records, np.int64),
        np.empty(records, np.int64),
        np.empty(records, np.int64),
        np.empty(records, np.int64),
        np.empty(records, np.int64),
        np.empty(records, np.int64),
        np.empty(min(MAX_SUMS, (records + 2) << min(records, 22))),
        np.empty(min(MAX_SUMS, np.int64(1) << min(records, 22))),
    )


@borrowing_part
def plan_elimination(n: int, most: int, work: Elimination) -> bool:
    """Find an order of fewer than ``most`` partial sums for the n records of the graph; False if none is found."""
    best = np.int64(0)  # int64, not a literal: numba would compile a second version for the literal
    last = best
    fewest = _plan_from(best, n, most, work)
    if fewest > RETRY_ABOVE:
        for trial in range(1, STARTS):
            last = n * trial // STARTS
            sums = _plan_from(last, n, fewest, work)
            if sums < fewest:
                best, fewest = last, sums
        if best != last and fewest < most:
            _plan_from(best, n, most, work)
    return fewest < most


@borrowing_part
def _plan_from(first: int, n: int, limit: int, work: Elimination) -> int:
    """Order the n records, beginning with ``first``; the number of partial sums, or ``limit`` if not fewer."""
    start, neighbour, state, bit, n_left = work.start, work.neighbour, work.state, work.bit, work.n_left
    xor_left, rank, active = work.xor_left, work.rank, work.active
    sum_start, sum_size, choice_start = work.sum_start, work.sum_size, work.choice_start
    order, own_bit, open_bits = work.order, work.own_bit, work.open_bits
    for x in range(n):
        state[x] = UNTOUCHED
        bit[x] = 0
        degree = start[x + 1] - start[x]
        n_left[x] = degree
        rank[x] = degree * (GROWTH + CHOICE) + x
        left = np.int64(0)
        for q in range(start[x], start[x + 1]):
            left ^= neighbour[q]
        xor_left[x] = left
    active[0] = first
    n_active, used_bits, n_choices = np.int64(1), np.int64(0), np.int64(0)
    sum_start[0], sum_size[0], choice_start[0], open_bits[0] = 0, 1, 0, 0
    for t in range(n):
        at = _of_least_rank(n_active, active, rank)
        x = active[at]
        if n_left[x] > MAX_OPEN:
            return limit
        n_active -= 1
        active[at] = active[n_active]
        order[t], own_bit[t] = x, bit[x]
        used_bits &= ~bit[x]
        n_active, used_bits, n_choices = _eliminate_record(x, n_active, used_bits, n_choices, work)
        choice_start[t + 1], open_bits[t + 1] = n_choices, used_bits
        sum_start[t + 1] = sum_start[t] + sum_size[t]
        size = np.int64(1)
        while size <= used_bits:
            size <<= 1
        sum_size[t + 1] = size
        if sum_start[t + 1] + size >= limit:
            return limit
    return sum_start[n] + 1


@inlined
def _eliminate_record(x: int, n_active: int, used_bits: int, n_choices: int, work: Elimination) -> tuple[int, int, int]:
    """List the choices of record x and open its neighbours; returns the three counters, updated."""
    start, neighbour, pair, state, bit = work.start, work.neighbour, work.pair, work.state, work.bit
    n_left, xor_left, rank, active = work.n_left, work.xor_left, work.rank, work.active
    choice_bit, choice_pair = work.choice_bit, work.choice_pair
    # Change of the neighbours' growth: x no longer has to be opened (−1), or no longer closes with its last one (+1).
    growth = (1 if n_left[x] == 1 else 0) if state[x] == OPEN else -1
    step = growth * GROWTH - CHOICE
    state[x] = DONE
    for q in range(start[x], start[x + 1]):
        y = neighbour[q]
        if state[y] == DONE:
            continue
        rank[y] += step
        n_left[y] -= 1
        xor_left[y] ^= x
        if state[y] != OPEN:
            if state[y] == UNTOUCHED:
                active[n_active] = y
                n_active += 1
            state[y] = OPEN
            rank[y] -= GROWTH
            for p in range(start[y], start[y + 1]):
                z = neighbour[p]
                rank[z] -= GROWTH
                if state[z] == UNTOUCHED:
                    state[z] = ADJACENT
                    active[n_active] = z
                    n_active += 1
            bit[y] = ~used_bits & (used_bits + 1)  # the lowest free bit
            used_bits |= bit[y]
        if n_left[y] == 1:
            rank[xor_left[y]] -= GROWTH
        choice_bit[n_choices] = bit[y]
        choice_pair[n_choices] = pair[q]
        n_choices += 1
    return n_active, used_bits, n_choices


@inlined
def _of_least_rank(n_active: int, active: IntArray, rank: IntArray) -> int:
    """Position in ``active`` of the record of least rank."""
    best, least = np.int64(0), rank[active[0]]
    for k in range(1, n_active):
        if rank[active[k]] < least:
            best, least = k, rank[active[k]]
    return best


@borrowing_part
def sum_core(
    n: int, odds: FloatArray, odds_alone: FloatArray, work: Elimination, p_pair: FloatArray, p_alone: FloatArray,
    p_taken: FloatArray,
) -> None:  # fmt: skip
    """Write exact probabilities: of every pair, and of every record to have no partner or one, after
    :func:`plan_elimination`.

    odds, odds_alone : odds of the pairs, and of every record to have no partner.
    """
    _forward(n, odds, odds_alone, work)
    _backward(n, odds_alone, work, p_pair, p_alone, p_taken)


@borrowing_part
def log_sum_core(n: int, odds: FloatArray, odds_alone: FloatArray, work: Elimination) -> float:
    """ln of the sum over all hypotheses; arguments as :func:`sum_core`, after :func:`plan_elimination`."""
    log_scale = _forward(n, odds, odds_alone, work)
    return log_scale + math.log(work.sum[work.sum_start[n]])


# Loops run over the states of some bits, one term at a time: choosing the terms of each state takes three times as
# long, because the processor cannot predict them. Fields of the workspace are taken out once: each time, numba counts
# a reference, which takes as long as ten sums.


@borrowing_part
def _forward(n: int, odds: FloatArray, odds_alone: FloatArray, work: Elimination) -> float:
    """Write the partial sums of all steps; returns ln of what they were divided by."""
    value, sum_start, sum_size, own_bit, order = work.sum, work.sum_start, work.sum_size, work.own_bit, work.order
    choice_start, bit, choice_odds, choice_pair = (
        work.choice_start, work.choice_bit, work.choice_odds, work.choice_pair,
    )  # fmt: skip
    for k in range(choice_start[n]):
        choice_odds[k] = odds[choice_pair[k]]
    value[0] = 1.0
    log_scale = 0.0
    open_bits = work.open_bits
    for t in range(n):
        now, then, own = sum_start[t], sum_start[t + 1], own_bit[t]
        others = open_bits[t] & ~own
        for s in range(then, then + sum_size[t + 1]):
            value[s] = 0.0
        # By decreasing bit, so that every sum gets its terms in the order of the states they come from.
        last = np.int64(1) << 62
        for _ in range(choice_start[t], choice_start[t + 1]):
            k = np.int64(-1)
            for c in range(choice_start[t], choice_start[t + 1]):
                if bit[c] < last and (k < 0 or bit[c] > bit[k]):
                    k = c
            last, factor = bit[k], choice_odds[k]
            s = np.int64(0)
            while s >= 0:
                value[then + (s | last)] += value[now + s] * factor
                s = next_state(s, others & ~last)
        factor = odds_alone[order[t]]
        s = np.int64(0)
        while s >= 0:
            value[then + s] += value[now + s] * factor
            s = next_state(s, others)
        s = np.int64(0 if own else -1)
        while s >= 0:
            value[then + s] += value[now + (s | own)]
            s = next_state(s, others)
        if t % RESCALE_EVERY == 0:
            divisor = _rescale(value, then, sum_size[t + 1])
            if divisor != 1.0:
                log_scale += math.log(divisor)
    return log_scale


@borrowing_part
def next_state(s: int, bits: int) -> int:
    """The next state after s with no other than these bits; −1 after the last."""
    return (s - bits) & bits if s != bits else -1


@borrowing_part
def _backward(
    n: int, odds_alone: FloatArray, work: Elimination, p_pair: FloatArray, p_alone: FloatArray, p_taken: FloatArray
) -> None:
    """From the last step to the first, replace the partial sums before it by the sums over all later steps, and write
    the probabilities of the choices of its record."""
    value, sum_start, sum_size, own_bit, order = work.sum, work.sum_start, work.sum_size, work.own_bit, work.order
    choice_start, bit, odds, choice_pair = work.choice_start, work.choice_bit, work.choice_odds, work.choice_pair
    suffix, open_bits = work.suffix, work.open_bits
    value[sum_start[n]] = 1.0
    for t in range(n - 1, -1, -1):
        now, then, own = sum_start[t], sum_start[t + 1], own_bit[t]
        others = open_bits[t] & ~own
        alone, taken, factor = 0.0, 0.0, odds_alone[order[t]]
        s = np.int64(0)
        while s >= 0:
            later = factor * value[then + s]
            suffix[s] = later
            alone += value[now + s] * later
            s = next_state(s, others)
        for k in range(choice_start[t], choice_start[t + 1]):
            last, factor, p = bit[k], odds[k], 0.0
            s = np.int64(0)
            while s >= 0:
                later = factor * value[then + (s | last)]
                p += value[now + s] * later
                suffix[s] += later
                s = next_state(s, others & ~last)
            p_pair[choice_pair[k]] = p
        s = np.int64(0 if own else -1)
        while s >= 0:
            later = value[then + s]
            suffix[s | own] = later
            taken += value[now + (s | own)] * later
            s = next_state(s, others)
        for s in range(sum_size[t]):
            # States that cannot be reached keep 0: they do not count in the rescaling, and have no suffix.
            value[now + s] = suffix[s] if value[now + s] != 0.0 else 0.0
        for k in range(choice_start[t], choice_start[t + 1]):
            taken += p_pair[choice_pair[k]]
        for k in range(choice_start[t], choice_start[t + 1]):
            p_pair[choice_pair[k]] /= alone + taken
        p_alone[order[t]], p_taken[order[t]] = alone / (alone + taken), taken / (alone + taken)
        if t % RESCALE_EVERY == 0:
            _rescale(value, now, sum_size[t])


@borrowing_part
def _rescale(value: FloatArray, begin: int, size: int) -> float:
    """Divide partial sums by the largest if that is beyond RESCALE_BEYOND; returns the divisor, else 1."""
    largest = 0.0
    for s in range(begin, begin + size):
        largest = max(largest, value[s])
    if largest > RESCALE_BEYOND or 0.0 < largest < 1.0 / RESCALE_BEYOND:
        for s in range(begin, begin + size):
            value[s] /= largest
        return largest
    return 1.0


# Exact sums by folding leaves: a record with one pair left is summed over into its partner, until no such record is
# left.
#
# A record without partner counts ``odds_alone``, a pair its odds times the ``scale`` of both records. Summing over a
# record x whose only pair left is with y leaves y the same choices, with
#
#     alone_y ← alone_y alone_x + odds_xy scale_x scale_y,   scale_y ← scale_y alone_x.
#
# A tree is summed completely; its probabilities are products on the way back. Elsewhere the *core* remains: the records
# on cycles and between them. All terms are sums and products of nonnegative numbers, so small probabilities keep their
# digits.

#: ``odds_alone`` and ``scale`` of a record are divided by the larger if that is above this.
FOLD_RESCALE_ABOVE = 1e15

#: Workspace of the folding. By record, source 1 first: ``degree`` pairs left, ``pair_xor`` exclusive or of their
#: numbers, ``odds_alone``, ``scale``, and the probabilities of having a partner nearer to the core (``p_taken``) and no
#: partner yet (``p_alone``). By folded leaf: ``leaf`` its record, ``leaf_pair``, and the shares ``joint`` and ``apart``
#: of both terms of alone_y. ``log_scale`` (1,): ln of what all sums were divided by.
Forest = namedtuple("Forest", "degree pair_xor odds_alone scale p_taken p_alone leaf leaf_pair joint apart log_scale")


@part
def forest(records: int) -> Forest:
    """A workspace for groups of at most this many records."""
    return Forest(
        np.empty(records, np.int64),
        np.empty(records, np.int64),
        np.empty(records),
        np.empty(records),
        np.empty(records),
        np.empty(records),
        np.empty(records, np.int64),
        np.empty(records, np.int64),
        np.empty(records),
        np.empty(records),
        np.zeros(1),
    )


@borrowing_part
def unfolded(n1: int, n2: int, first: Int32Array, second: Int32Array, work: Forest) -> None:
    """Write the workspace of n₁ + n₂ records before any leaf is folded, but for ``odds_alone``."""
    degree, pair_xor = work.degree, work.pair_xor
    work.log_scale[0] = 0.0
    for x in range(n1 + n2):
        degree[x] = 0
        pair_xor[x] = 0
        work.scale[x] = 1.0
        work.p_taken[x] = 0.0
        work.p_alone[x] = 1.0
    for e in range(len(first)):
        x, y = np.int64(first[e]), n1 + second[e]
        degree[x] += 1
        degree[y] += 1
        pair_xor[x] ^= e
        pair_xor[y] ^= e


@borrowing_part
def fold(n1: int, n2: int, first: Int32Array, second: Int32Array, odds: FloatArray, work: Forest) -> int:
    """Fold the leaves of n₁ + n₂ records, whose ``odds_alone`` must be set; returns the number of leaves.

    first, second : (m,) each pair's records, numbered in their sources. Records of the core keep a ``degree`` > 0.
    """
    unfolded(n1, n2, first, second, work)
    degree, pair_xor, odds_alone, scale = work.degree, work.pair_xor, work.odds_alone, work.scale
    leaves = 0
    for x in range(n1 + n2):
        leaf = x
        while degree[leaf] == 1:
            e = pair_xor[leaf]
            other = n1 + second[e] if leaf < n1 else np.int64(first[e])
            joint = odds[e] * scale[leaf] * scale[other]
            apart = odds_alone[other] * odds_alone[leaf]
            total = joint + apart
            work.leaf[leaves] = leaf
            work.leaf_pair[leaves] = e
            work.joint[leaves] = joint / total if total > 0.0 else 0.0
            work.apart[leaves] = apart / total if total > 0.0 else 0.0
            leaves += 1
            odds_alone[other] = total
            scale[other] *= odds_alone[leaf]
            greater = max(total, scale[other])
            if greater > FOLD_RESCALE_ABOVE:
                odds_alone[other] /= greater
                scale[other] /= greater
                work.log_scale[0] += math.log(greater)
            degree[leaf] = 0
            degree[other] -= 1
            pair_xor[other] ^= e
            leaf = other
    return leaves


@borrowing_part
def unfold(leaves: int, n1: int, first: Int32Array, second: Int32Array, work: Forest, p_pair: FloatArray) -> None:
    """Write ``p_pair`` of the leaves' pairs, from ``p_alone`` and ``p_taken`` of the core's records."""
    p_taken, p_alone = work.p_taken, work.p_alone
    for k in range(leaves - 1, -1, -1):
        x = work.leaf[k]
        e = work.leaf_pair[k]
        other = n1 + second[e] if x < n1 else np.int64(first[e])
        p = p_alone[other] * work.joint[k]
        p_pair[e] = p
        p_alone[other] *= work.apart[k]
        p_taken[x] = p
        p_alone[x] = p_taken[other] + p_alone[other]
        p_taken[other] += p


@borrowing_part
def core_of(
    n1: int,
    n2: int,
    first: Int32Array,
    second: Int32Array,
    odds: FloatArray,
    folded: Forest,
    record: IntArray,
    graph: Elimination,
    core_odds: FloatArray,
) -> int:
    """Write the core as the graph of the elimination, with the odds of its pairs; returns its number of records.

    record : receives the number of each of the graph's records among the n₁ + n₂.
    """
    n = np.int64(0)
    number, fill = folded.pair_xor, graph.n_left
    graph.start[0] = 0
    for x in range(n1 + n2):
        if folded.degree[x] > 0:
            number[x] = n
            record[n] = x
            graph.start[n + 1] = graph.start[n] + folded.degree[x]
            fill[n] = graph.start[n]
            n += 1
    for e in range(len(first)):
        x, y = np.int64(first[e]), n1 + second[e]
        if folded.degree[x] > 0 and folded.degree[y] > 0:
            core_odds[e] = odds[e] * folded.scale[x] * folded.scale[y]
            a, b = number[x], number[y]
            graph.neighbour[fill[a]], graph.neighbour[fill[b]] = b, a
            graph.pair[fill[a]], graph.pair[fill[b]] = e, e
            fill[a] += 1
            fill[b] += 1
    return n


#: How a group was solved: in closed form, exactly by folding and elimination, or not here.
CLOSED, ELIMINATED, LOCAL = 0, 1, 2
#: Reduced log weights are at least −MAX_DEPTH; counts with a log factor of MAX_LOG_PRIOR or more are excluded.
MAX_DEPTH, MAX_LOG_PRIOR = 600.0, 300.0


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
    n1: int, n2: int, first: Int32Array, second: Int32Array, odds: FloatArray, odds_alone: FloatArray,
    share: FloatArray,
) -> None:  # fmt: skip
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
    first: int,
    last: int,
    layout: GroupLayout,
    weight: FloatArray,
    u: FloatArray,
    v: FloatArray,
    most: int,
    sums_per_pair: float,
    share: FloatArray,
    method: NDArray[np.int8],
) -> None:
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
    first: int,
    last: int,
    layout: GroupLayout,
    weight: FloatArray,
    u: FloatArray,
    v: FloatArray,
    most: int,
    sums_per_pair: float,
    work: tuple[Forest, Elimination],
    of_pairs: tuple[FloatArray, FloatArray],
    of_core: tuple[IntArray, FloatArray, FloatArray, FloatArray],
    share: FloatArray,
    method: NDArray[np.int8],
) -> None:
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
    first: int,
    last: int,
    layout: GroupLayout,
    weight: FloatArray,
    u: FloatArray,
    v: FloatArray,
    out: FloatArray,
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
    n: int,
    odds: FloatArray,
    odds_alone: FloatArray,
    prior: FloatArray,
    work: Elimination,
    counts: CountSteps,
    value: FloatArray,
) -> bool:
    """:func:`_forward` of polynomials, without the terms that are negligible; False if they are more than ``value``
    has room for. prior : factor of each number of pairs."""
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
    n: int,
    odds_alone: FloatArray,
    prior: FloatArray,
    work: Elimination,
    counts: CountSteps,
    value: FloatArray,
    suffix: FloatArray,
    p_pair: FloatArray,
) -> None:
    """:func:`_backward` of polynomials; the last ones are the prior."""
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
    first: int,
    last: int,
    layout: GroupLayout,
    weight: FloatArray,
    chosen: BoolArray,
    u: FloatArray,
    v: FloatArray,
    table_start: IntArray,
    table: FloatArray,
    slope: FloatArray,
    most: int,
    share: FloatArray,
    method: NDArray[np.int8],
) -> None:
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

"""Exact sums by eliminating records one by one.

A record is *open* from the elimination of its first neighbour until its own; one bit says whether it has a partner by
then. Every step has an array of partial sums, indexed by the bits of the open records. Eliminating a record that has
no partner yet either leaves it alone or pairs it with a neighbour that is not eliminated. The order of elimination,
through records of both sources, keeps few records open.
"""

from __future__ import annotations

import math
from collections import namedtuple

import numpy as np

from sameas.arrays import FloatArray, IntArray
from sameas.kernels.compiled import borrowing_part, inlined, part

#: Maximum number of partial sums of one group.
MAX_SUMS = 1 << 22
#: Maximum number of open records: their sums fill MAX_SUMS, and far more would not fit into the bits of a word.
MAX_OPEN = 22
#: A group of more than RETRY_ABOVE sums is ordered from STARTS different first records; the order with the fewest sums
#: is used.
RETRY_ABOVE, STARTS = 2048, 8
#: Every RESCALE_EVERY steps, sums are divided by their largest if that is not within this factor of 1.
RESCALE_EVERY, RESCALE_BEYOND = 4, 1e60
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

"""Compiled exact posterior of one problem: rows are eliminated one by one; a state is the set of columns taken.

A *problem* is a bipartite graph in CSR form. Row r may take one of the columns ``column[start[r]:start[r+1]]`` with
the given ``odds``, or none with the odds ``none[r]``; a column without row counts ``unused``; a hypothesis with k pairs
counts ``prior[k]`` (one element: no prior of the count). A state has only the columns that later rows may take, so
chains and trees of any length need few states. The order of the rows keeps few columns open.
"""

from __future__ import annotations

import math
from collections import namedtuple
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import FloatArray, Int32Array, IntArray
from sameas.kernels.compiled import inlined, part

#: Limits of one problem: states, values, transitions, bits of the hash table's size, open columns. A problem that
#: exceeds one of them is not solved.
STATES = 400_000
VALUES = 1_600_000
TRANSITIONS = 2_500_000
PLACE_BITS = 19
SLOTS = 62
NO_PAIR = np.int64(-1)
#: More slots than a state has: the columns open at once do not fit into one.
NO_SLOTS = np.uint64(2**64 - 1)
NEGLIGIBLE = 1e-14
#: A product above this has not underflowed, so that it may be divided by a factor.
DIVISIBLE = 1e-200

Scratch = namedtuple("Scratch", "key value back target place_key place_state place_stamp edge_bit edge_dies")


class CountedProblem(NamedTuple):
    """A problem of n rows and nc columns: pairs as CSR by row, their odds, those of each row to have none and of each
    column to be unused, and the factor of each number of pairs."""

    n: int
    nc: int
    start: IntArray
    column: Int32Array
    odds: FloatArray
    none: FloatArray
    unused: FloatArray
    prior: FloatArray


class EliminationSteps(NamedTuple):
    """Where the states, values and targets of each step begin, and the least number of pairs and how many numbers of
    pairs its states have values for."""

    state_start: IntArray
    value_start: IntArray
    target_start: IntArray
    k_low: IntArray
    k_count: IntArray


@part
def scratch(max_pairs: int, max_rows: int, max_columns: int) -> Scratch:
    """Workspace of :func:`eliminate` for problems of at most this many pairs, rows and columns.

    A problem of c columns has at most 2^c states in a step: whether it fits does not depend on the other problems.
    """
    places = np.int64(1) << min(max_columns + 1, PLACE_BITS)
    states = min(STATES, (max_rows + 2) << min(max_columns, 19))
    spread = states * (max_columns + 2)
    values = min(VALUES, spread)
    return Scratch(
        np.empty(states, np.uint64),
        np.empty(values),
        np.empty(values),
        np.empty(min(TRANSITIONS, spread), np.int32),
        np.empty(places, np.uint64),
        np.empty(places, np.int32),
        np.zeros(places, np.int32),
        np.empty(max_pairs, np.uint64),
        np.empty(max_pairs, np.bool_),
    )


@part
def elimination_order(problem: CountedProblem, order: IntArray) -> int:
    """Write to ``order`` the rows in an order with few open columns; returns the largest number of open columns.

    Stops once more than SLOTS are open.
    """
    n, nc, start, column = problem.n, problem.nc, problem.start, problem.column
    col_start, row_of = _rows_of_columns(problem)
    remaining = np.empty(nc, np.int32)
    for c in range(nc):
        remaining[c] = col_start[c + 1] - col_start[c]
    opened = np.zeros(nc, np.bool_)
    state = np.zeros(n, np.int8)  # 0 untouched, 1 with an open column, 2 eliminated
    active = np.empty(n, np.int32)
    actives = 0
    width = 0
    widest = 0
    for t in range(n):
        best = _unlinked_row(state, start, t == 0) if actives == 0 else -1
        best_score = 1 << 30
        for k in range(actives):
            r = active[k]
            score = 0
            for e in range(start[r], start[r + 1]):
                c = column[e]
                if not opened[c]:
                    score += 1 if remaining[c] > 1 else 0
                elif remaining[c] == 1:
                    score -= 1
            if score < best_score or (score == best_score and r < best):
                best = r
                best_score = score
        order[t] = best
        state[best] = 2
        for k in range(actives):
            if active[k] == best:
                actives -= 1
                active[k] = active[actives]
                break
        for e in range(start[best], start[best + 1]):
            c = column[e]
            if not opened[c]:
                opened[c] = True
                width += 1
                for p in range(col_start[c], col_start[c + 1]):
                    if state[row_of[p]] == 0:
                        state[row_of[p]] = 1
                        active[actives] = row_of[p]
                        actives += 1
            remaining[c] -= 1
            if remaining[c] == 0:
                width -= 1
        widest = max(widest, width)
        if widest > SLOTS:
            break
    return widest


@part
def _rows_of_columns(problem: CountedProblem) -> tuple[IntArray, Int32Array]:
    """The rows of each column, as CSR."""
    n, nc, start, column = problem.n, problem.nc, problem.start, problem.column
    col_start, row_of = np.zeros(nc + 1, np.int64), np.empty(start[n], np.int32)
    for e in range(start[n]):
        col_start[column[e] + 1] += 1
    for c in range(nc):
        col_start[c + 1] += col_start[c]
    fill = col_start[:-1].copy()
    for r in range(n):
        for e in range(start[r], start[r + 1]):
            row_of[fill[column[e]]] = r
            fill[column[e]] += 1
    return col_start, row_of


@part
def _unlinked_row(state: NDArray[np.int8], start: IntArray, any_row: bool) -> int:
    """The first row that is not eliminated; of all rows, the first with the fewest pairs if ``any_row``."""
    best = 0
    while state[best] == 2:
        best += 1
    if any_row:
        for r in range(len(state)):
            if start[r + 1] - start[r] < start[best + 1] - start[best]:
                best = r
    return best


@inlined
def find_state(key: int, begin: int, count: int, stamp: int, work: Scratch) -> int:
    """The state of this key in the current step, created if new; −1 if the workspace is full."""
    last = np.int64(len(work.place_key) - 1)
    place = np.int64(key) & last
    if key > np.uint64(last):
        place = np.int64((key * np.uint64(0x9E3779B97F4A7C15)) >> np.uint64(64 - PLACE_BITS)) & last
    while work.place_stamp[place] == stamp:
        if work.place_key[place] == key:
            return np.int64(work.place_state[place])
        place = (place + 1) & last
    if begin + count >= STATES or 2 * count > last:
        return np.int64(-1)
    work.place_stamp[place] = stamp
    work.place_key[place] = key
    work.place_state[place] = begin + count
    work.key[begin + count] = key
    return np.int64(begin + count)


@inlined
def unused_product(
    key: int, low: int, high: int, taken: int, column: Int32Array, unused: FloatArray, work: Scratch
) -> float:
    """Product of ``unused`` over the columns whose last row this is, that are free in the state and not taken now."""
    product = 1.0
    for e in range(low, high):
        if e != taken and work.edge_dies[e] and (key & work.edge_bit[e]) == 0:
            product *= unused[column[e]]
    return product


@inlined
def unused_after_pair(
    whole: float, key: int, low: int, high: int, taken: int, column: Int32Array, unused: FloatArray, work: Scratch
) -> float:
    """:func:`unused_product` with the pair ``taken``, from that without a pair, ``whole``, by division if accurate."""
    if not work.edge_dies[taken]:
        return whole
    if whole > DIVISIBLE:
        return whole / unused[column[taken]]
    return unused_product(key, low, high, taken, column, unused, work)


@part
def eliminate(problem: CountedProblem, share: FloatArray, alone: FloatArray, stamp: int, work: Scratch) -> int:
    """Write the exact probabilities of a problem: ``share`` of every pair, ``alone`` of every row.

    Returns the next free stamp, or −1 if the problem exceeds a limit (nothing is written then).
    """
    n, start, column, prior = problem.n, problem.start, problem.column, problem.prior
    order = np.empty(n, np.int64)
    if elimination_order(problem, order) > SLOTS:
        return -1
    ahead = prior.copy()
    for k in range(len(prior) - 2, -1, -1):
        ahead[k] = max(ahead[k], ahead[k + 1])
    log_scale = 0.0
    remaining = np.zeros(problem.nc, np.int32)
    for e in range(start[n]):
        remaining[column[e]] += 1
    slot = np.full(problem.nc, -1, np.int64)
    taken_slots = np.uint64(0)
    steps = EliminationSteps(
        np.zeros(n + 2, np.int64),
        np.zeros(n + 2, np.int64),
        np.zeros(n + 1, np.int64),
        np.zeros(n + 1, np.int64),
        np.ones(n + 1, np.int64),
    )
    steps.state_start[1] = 1
    work.key[0] = 0
    work.value[0] = 1.0
    for t in range(n):
        r = order[t]
        open_slots, dead = _open_columns(r, problem, remaining, slot, taken_slots, work)
        stamp += 1
        if open_slots == NO_SLOTS or not _forward(t, r, dead, problem, steps, stamp, work):
            return -1
        log_scale = rescale(t + 1, problem, steps, ahead, log_scale, work.value)
        taken_slots = open_slots & ~dead
    for k in range(steps.k_count[n]):
        work.back[steps.value_start[n] + k] = prior[steps.k_low[n] + k] if len(prior) > 1 else prior[0]
    for t in range(n - 1, -1, -1):
        _backward(t, order[t], problem, steps, share, alone, work)
    return stamp


@part
def _open_columns(
    r: int, problem: CountedProblem, remaining: Int32Array, slot: IntArray, taken_slots: int, work: Scratch
) -> tuple[int, int]:
    """Give a free slot, the bit of a state, to every column of row r that later rows may take and that has none.

    Writes the bit of each pair's column and whether this is its last row. Returns the slots taken during the step,
    NO_SLOTS if there are not enough, and those of the columns whose last row this is.
    """
    dead = np.uint64(0)
    for e in range(problem.start[r], problem.start[r + 1]):
        c = problem.column[e]
        remaining[c] -= 1
        if slot[c] < 0 and remaining[c] > 0:
            s = 0
            while (taken_slots >> np.uint64(s)) & np.uint64(1):
                s += 1
            if s >= SLOTS:
                return NO_SLOTS, dead
            slot[c] = s
            taken_slots |= np.uint64(1) << np.uint64(s)
        work.edge_bit[e] = np.uint64(1) << np.uint64(slot[c]) if slot[c] >= 0 else np.uint64(0)
        work.edge_dies[e] = remaining[c] == 0
        if remaining[c] == 0:
            dead |= work.edge_bit[e]
    return taken_slots, dead


@part
def _forward(
    t: int, r: int, dead: int, problem: CountedProblem, steps: EliminationSteps, stamp: int, work: Scratch
) -> bool:
    """One step forward: the states after row r and their sums over all earlier steps; False if they exceed a limit."""
    column, unused, counted = problem.column, problem.unused, len(problem.prior) > 1
    low, high = problem.start[r], problem.start[r + 1]
    begin, end, width = steps.state_start[t], steps.state_start[t + 1], steps.k_count[t]
    next_width = min(width + 1, len(problem.prior) - steps.k_low[t]) if counted else 1
    options = high - low + 1
    now, targets = steps.value_start[t], steps.target_start[t]
    then = now + (end - begin) * width
    if targets + (end - begin) * options > TRANSITIONS:
        return False
    count = np.int64(0)  # int64, not a literal: numba would compile a second version for the literal
    for s in range(begin, end):
        key = work.key[s]
        v0 = now + (s - begin) * width
        largest = 0.0
        for k in range(width):
            largest = max(largest, work.value[v0 + k])
        whole = unused_product(key, low, high, NO_PAIR, column, unused, work)
        for option in range(options):
            at = targets + (s - begin) * options + option
            work.target[at] = -1
            e = low + option - 1
            if largest == 0.0 or (option > 0 and (key & work.edge_bit[e]) != 0):
                continue
            if option == 0:
                factor = problem.none[r] * whole
                next_key = key & ~dead
            else:
                factor = problem.odds[e] * unused_after_pair(whole, key, low, high, e, column, unused, work)
                next_key = (key | work.edge_bit[e]) & ~dead
            if factor == 0.0:
                continue
            goal = find_state(next_key, end, count, stamp, work)
            if goal < 0:
                return False
            g0 = then + (goal - end) * next_width
            if goal == end + count:
                count += 1
                if g0 + next_width > VALUES:
                    return False
                for k in range(next_width):
                    work.value[g0 + k] = 0.0
            work.target[at] = goal
            step = 1 if counted and option > 0 else 0
            for k in range(width):
                if k + step < next_width:
                    work.value[g0 + k + step] += factor * work.value[v0 + k]
    steps.state_start[t + 2], steps.value_start[t + 1] = end + count, then
    steps.target_start[t + 1] = targets + (end - begin) * options
    steps.k_low[t + 1], steps.k_count[t + 1] = steps.k_low[t], next_width
    return True


@part
def rescale(
    t: int, problem: CountedProblem, steps: EliminationSteps, ahead: FloatArray, log_scale: float, value: FloatArray
) -> float:
    """Scale the values of a step to at most 1 and drop negligible ones; returns ``log_scale`` with the new scale.

    Without a prior of the count, a value is negligible relative to the largest. With one, a small value may be followed
    by a large prior: a value is negligible if, before all scaling and times the largest prior ``ahead`` from its count
    on, it is negligible relative to 1, the weight of the hypothesis by which the problem is reduced.
    """
    v0, states = steps.value_start[t], steps.state_start[t + 1] - steps.state_start[t]
    k_low, k_count, counted = steps.k_low, steps.k_count, len(problem.prior) > 1
    width = k_count[t]
    largest = 0.0
    for at in range(v0, v0 + states * width):
        largest = max(largest, value[at])
    scale = 1.0 / largest
    lo = 0
    hi = width
    unscaled = math.exp(-log_scale)
    if counted:
        lo = width
        hi = 0
        for s in range(states):
            for k in range(width):
                if value[v0 + s * width + k] * ahead[k_low[t] + k] > NEGLIGIBLE * unscaled:
                    lo = min(lo, k)
                    hi = max(hi, k + 1)
    new_width = hi - lo
    for s in range(states):
        for k in range(new_width):
            x = value[v0 + s * width + lo + k]
            least = NEGLIGIBLE * unscaled / ahead[k_low[t] + lo + k] if counted else NEGLIGIBLE * largest
            value[v0 + s * new_width + k] = x * scale if x > least else 0.0
    k_low[t] += lo
    k_count[t] = new_width
    return log_scale + math.log(largest)


@part
def _backward(
    t: int,
    r: int,
    problem: CountedProblem,
    steps: EliminationSteps,
    share: FloatArray,
    alone: FloatArray,
    work: Scratch,
) -> None:
    """One step backward: the states' sums over all later steps, and the probabilities of row r's options."""
    column, unused, counted = problem.column, problem.unused, len(problem.prior) > 1
    low, high = problem.start[r], problem.start[r + 1]
    value_start, target_start, k_low, k_count = steps.value_start, steps.target_start, steps.k_low, steps.k_count
    begin, end = steps.state_start[t], steps.state_start[t + 1]
    width = k_count[t]
    next_width = k_count[t + 1]
    shift = k_low[t] - k_low[t + 1]
    options = high - low + 1
    alone[r] = 0.0
    for e in range(low, high):
        share[e] = 0.0
    largest = 0.0
    for s in range(begin, end):
        key = work.key[s]
        v0 = value_start[t] + (s - begin) * width
        for k in range(width):
            work.back[v0 + k] = 0.0
        whole = unused_product(key, low, high, NO_PAIR, column, unused, work)
        for option in range(options):
            goal = work.target[target_start[t] + (s - begin) * options + option]
            if goal < 0:
                continue
            e = low + option - 1
            g0 = value_start[t + 1] + (goal - end) * next_width
            if option == 0:
                factor = problem.none[r] * whole
            else:
                factor = problem.odds[e] * unused_after_pair(whole, key, low, high, e, column, unused, work)
            step = shift + (1 if counted and option > 0 else 0)
            mass = 0.0
            for k in range(width):
                at = k + step
                if 0 <= at < next_width:
                    part = factor * work.back[g0 + at]
                    work.back[v0 + k] += part
                    mass += part * work.value[v0 + k]
            if option == 0:
                alone[r] += mass
            else:
                share[e] += mass
        for k in range(width):
            largest = max(largest, work.back[v0 + k])
    total = alone[r]
    for e in range(low, high):
        total += share[e]
    alone[r] /= total
    for e in range(low, high):
        share[e] /= total
    if largest > 0.0:
        for at in range(value_start[t], value_start[t] + (end - begin) * width):
            work.back[at] /= largest

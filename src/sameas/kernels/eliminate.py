"""Compiled exact posterior of one problem: rows are eliminated one by one; a state is the set of columns taken.

A *problem* is a bipartite graph in CSR form. Row r may take one of the columns ``column[start[r]:start[r+1]]`` with
the given ``odds``, or none with the odds ``none[r]``; a column without row counts ``unused``; a hypothesis with k pairs
counts ``prior[k]`` (one element: no prior of the count). A state has only the columns that later rows may take, so
chains and trees of any length need few states. The order of the rows keeps few columns open.
"""

from __future__ import annotations

import math
from collections import namedtuple

import numpy as np

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
NEGLIGIBLE = 1e-14
#: A product above this has not underflowed, so that it may be divided by a factor.
DIVISIBLE = 1e-200

Scratch = namedtuple("Scratch", "key value back target place_key place_state place_stamp edge_bit edge_dies")


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
def elimination_order(n: int, nc: int, start: IntArray, column: Int32Array, order: IntArray) -> int:
    """Write to ``order`` the rows in an order with few open columns; returns the largest number of open columns.

    Stops once more than SLOTS are open.
    """
    m = start[n]
    col_start = np.zeros(nc + 1, np.int64)
    for e in range(m):
        col_start[column[e] + 1] += 1
    for c in range(nc):
        col_start[c + 1] += col_start[c]
    fill = col_start[:-1].copy()
    row_of = np.empty(m, np.int32)
    remaining = np.empty(nc, np.int32)
    for r in range(n):
        for e in range(start[r], start[r + 1]):
            row_of[fill[column[e]]] = r
            fill[column[e]] += 1
    for c in range(nc):
        remaining[c] = col_start[c + 1] - col_start[c]
    opened = np.zeros(nc, np.bool_)
    state = np.zeros(n, np.int8)  # 0 untouched, 1 with an open column, 2 eliminated
    active = np.empty(n, np.int32)
    actives = 0
    width = 0
    widest = 0
    first_untouched = 0
    for t in range(n):
        best = -1
        best_score = 1 << 30
        if actives == 0:
            while state[first_untouched] == 2:
                first_untouched += 1
            best = first_untouched
            if t == 0:
                for r in range(n):
                    if start[r + 1] - start[r] < start[best + 1] - start[best]:
                        best = r
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
def eliminate(
    n: int,
    nc: int,
    start: IntArray,
    column: Int32Array,
    odds: FloatArray,
    none: FloatArray,
    unused: FloatArray,
    prior: FloatArray,
    share: FloatArray,
    alone: FloatArray,
    stamp: int,
    work: Scratch,
) -> int:
    """Write the exact probabilities of a problem: ``share`` of every pair, ``alone`` of every row.

    Returns the next free stamp, or −1 if the problem exceeds a limit (nothing is written then).
    """
    order = np.empty(n, np.int64)
    if elimination_order(n, nc, start, column, order) > SLOTS:
        return -1
    counted = len(prior) > 1
    ahead = prior.copy()
    for k in range(len(prior) - 2, -1, -1):
        ahead[k] = max(ahead[k], ahead[k + 1])
    log_scale = 0.0
    remaining = np.zeros(nc, np.int32)
    for e in range(start[n]):
        remaining[column[e]] += 1
    slot = np.full(nc, -1, np.int64)
    taken_slots = np.uint64(0)
    state_start = np.empty(n + 2, np.int64)
    value_start = np.empty(n + 2, np.int64)
    target_start = np.empty(n + 1, np.int64)
    k_low = np.zeros(n + 1, np.int64)
    k_count = np.ones(n + 1, np.int64)
    state_start[0] = 0
    state_start[1] = 1
    value_start[0] = 0
    target_start[0] = 0
    work.key[0] = 0
    work.value[0] = 1.0
    for t in range(n):
        r = order[t]
        low = start[r]
        high = start[r + 1]
        dead = np.uint64(0)
        for e in range(low, high):
            c = column[e]
            remaining[c] -= 1
            if slot[c] < 0 and remaining[c] > 0:
                s = 0
                while (taken_slots >> np.uint64(s)) & np.uint64(1):
                    s += 1
                if s >= SLOTS:
                    return -1
                slot[c] = s
                taken_slots |= np.uint64(1) << np.uint64(s)
            work.edge_bit[e] = np.uint64(1) << np.uint64(slot[c]) if slot[c] >= 0 else np.uint64(0)
            work.edge_dies[e] = remaining[c] == 0
            if remaining[c] == 0:
                dead |= work.edge_bit[e]
        begin = state_start[t]
        end = state_start[t + 1]
        width = k_count[t]
        next_width = min(width + 1, len(prior) - k_low[t]) if counted else 1
        options = high - low + 1
        if target_start[t] + (end - begin) * options > TRANSITIONS:
            return -1
        value_start[t + 1] = value_start[t] + (end - begin) * width
        count = np.int64(0)  # int64, not a literal: numba would compile a second version for the literal
        stamp += 1
        for s in range(begin, end):
            key = work.key[s]
            v0 = value_start[t] + (s - begin) * width
            largest = 0.0
            for k in range(width):
                largest = max(largest, work.value[v0 + k])
            whole = unused_product(key, low, high, NO_PAIR, column, unused, work)
            for option in range(options):
                at = target_start[t] + (s - begin) * options + option
                work.target[at] = -1
                e = low + option - 1
                if largest == 0.0 or (option > 0 and (key & work.edge_bit[e]) != 0):
                    continue
                if option == 0:
                    factor = none[r] * whole
                    next_key = key & ~dead
                else:
                    factor = odds[e] * unused_after_pair(whole, key, low, high, e, column, unused, work)
                    next_key = (key | work.edge_bit[e]) & ~dead
                if factor == 0.0:
                    continue
                goal = find_state(next_key, end, count, stamp, work)
                if goal < 0:
                    return -1
                g0 = value_start[t + 1] + (goal - end) * next_width
                if goal == end + count:
                    count += 1
                    if g0 + next_width > VALUES:
                        return -1
                    for k in range(next_width):
                        work.value[g0 + k] = 0.0
                work.target[at] = goal
                step = 1 if counted and option > 0 else 0
                for k in range(width):
                    if k + step < next_width:
                        work.value[g0 + k + step] += factor * work.value[v0 + k]
        state_start[t + 2] = end + count
        target_start[t + 1] = target_start[t] + (end - begin) * options
        k_low[t + 1] = k_low[t]
        k_count[t + 1] = next_width
        log_scale = rescale(
            value_start[t + 1], count, next_width, k_low, k_count, t + 1, counted, ahead, log_scale, work.value
        )
        for e in range(low, high):
            if work.edge_dies[e] and slot[column[e]] >= 0:
                taken_slots &= ~work.edge_bit[e]
    width = k_count[n]
    for k in range(width):
        work.back[value_start[n] + k] = prior[k_low[n] + k] if counted else prior[0]
    for t in range(n - 1, -1, -1):
        r = order[t]
        gather(t, r, start[r], start[r + 1], column, odds, none, unused, state_start, value_start, target_start, k_low,
               k_count, counted, share, alone, work)  # fmt: skip
    return stamp


@part
def rescale(
    v0: int,
    states: int,
    width: int,
    k_low: IntArray,
    k_count: IntArray,
    t: int,
    counted: bool,
    ahead: FloatArray,
    log_scale: float,
    value: FloatArray,
) -> float:
    """Scale the values of a step to at most 1 and drop negligible ones; returns ``log_scale`` with the new scale.

    Without a prior of the count, a value is negligible relative to the largest. With one, a small value may be followed
    by a large prior: a value is negligible if, before all scaling and times the largest prior ``ahead`` from its count
    on, it is negligible relative to 1, the weight of the hypothesis by which the problem is reduced.
    """
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
def gather(
    t: int,
    r: int,
    low: int,
    high: int,
    column: Int32Array,
    odds: FloatArray,
    none: FloatArray,
    unused: FloatArray,
    state_start: IntArray,
    value_start: IntArray,
    target_start: IntArray,
    k_low: IntArray,
    k_count: IntArray,
    counted: bool,
    share: FloatArray,
    alone: FloatArray,
    work: Scratch,
) -> None:
    """One step backward: the states' sums over all later steps, and the probabilities of row r's options."""
    begin = state_start[t]
    end = state_start[t + 1]
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
                factor = none[r] * whole
            else:
                factor = odds[e] * unused_after_pair(whole, key, low, high, e, column, unused, work)
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

"""Compiled exact sums over a graph of which few records are open at a time: records are eliminated one by one.

A record is *open* from when the first of its neighbours is eliminated until it is so itself; whether it has a partner
by then is one bit. The sums over what was eliminated stand in an array by the bits of the open records, one array for
each step. To eliminate a record that is not taken yet is to leave it alone or to give it a neighbour that is left.
Either source's records come in the order that keeps few open.
"""

from __future__ import annotations

from collections import namedtuple

import numpy as np

from sameas.kernels.compiled import part

#: Most sums of one problem.
SUMS = 1 << 22
#: More records than this, open at a time, need more sums; far more would not fit into the bits of a word.
MOST_OPEN = 22
#: Problems of more sums than this are laid out from as many records, spread over all, and the least is taken.
MANY, TRIALS = 2048, 8
#: After so many steps sums are divided by their largest where that is not within this factor of 1.
EVERY, GREAT = 4, 1e60
UNTOUCHED, BESIDE, OPEN, GONE = 0, 1, 2, 3

#: The graph: CSR starts by record, of the neighbours and the pairs with them. The order: the records, their bits, the
#: starts and sizes of the sums before them, CSR starts of the choices left to them: their bits, pairs and
#: odds. By record, while the order is found, its state, its bit, how many neighbours are left, and how many more
#: records are open after it; a list of records. The sums.
Narrow = namedtuple(
    "Narrow", "start near pair order own begin size first bit choice odds state bits left more active sum"
)


@part
def narrow(records, pairs):
    """Room for groups of at most so many records and pairs; every problem that SUMS allows fits."""
    return Narrow(
        np.empty(records + 1, np.int64),
        np.empty(2 * pairs, np.int64),
        np.empty(2 * pairs, np.int64),
        np.empty(records, np.int64),
        np.empty(records, np.int64),
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
        np.empty(min(SUMS, (records + 2) << min(records, 22))),
    )


@part
def arranged(n, room):
    """Find an order that needs few sums, and lay them out; False where there is no room for them."""
    most = len(room.sum)
    best = np.int64(0)  # not a literal: numba would compile for it apart
    last = best
    least = _laid_out_from(best, n, most, room)
    if least > MANY:
        for trial in range(1, TRIALS):
            last = n * trial // TRIALS
            sums = _laid_out_from(last, n, least, room)
            if sums < least:
                best, least = last, sums
        if best != last and least < most:
            _laid_out_from(best, n, most, room)
    return least < most


@part
def _laid_out_from(first, n, limit, room):
    """Order the n records from ``first`` on and lay the sums out; returns their number, ``limit`` where not fewer."""
    for x in range(n):
        room.state[x] = UNTOUCHED
        room.bits[x] = 0
        room.left[x] = room.start[x + 1] - room.start[x]
        room.more[x] = room.left[x]
    room.active[0] = first
    actives, used, chosen = np.int64(1), np.int64(0), np.int64(0)
    room.begin[0], room.size[0], room.first[0] = 0, 1, 0
    for t in range(n):
        at = _next(actives, room)
        x = room.active[at]
        if room.left[x] > MOST_OPEN:
            return limit
        actives -= 1
        room.active[at] = room.active[actives]
        room.order[t], room.own[t] = x, room.bits[x]
        used &= ~room.bits[x]
        actives, used, chosen = _eliminated(x, actives, used, chosen, room)
        room.first[t + 1] = chosen
        room.begin[t + 1] = room.begin[t] + room.size[t]
        size = np.int64(1)
        while size <= used:
            size <<= 1
        room.size[t + 1] = size
        if room.begin[t + 1] + size >= limit:
            return limit
    return room.begin[n] + 1


@part
def _eliminated(x, actives, used, chosen, room):
    """Note the choices that record x has left, and open its neighbours; returns the three counters anew."""
    # It counted for its neighbours: as one to be opened, or as one that closes with the last of them.
    step = (1 if room.left[x] == 1 else 0) if room.state[x] == OPEN else -1
    room.state[x] = GONE
    for q in range(room.start[x], room.start[x + 1]):
        y = room.near[q]
        if room.state[y] == GONE:
            continue
        room.more[y] += step
        room.left[y] -= 1
        if room.state[y] != OPEN:
            if room.state[y] == UNTOUCHED:
                room.active[actives] = y
                actives += 1
            room.state[y] = OPEN
            room.more[y] -= 1
            actives = _beside(y, actives, room)
            room.bits[y] = ~used & (used + 1)  # the lowest that is free
            used |= room.bits[y]
        if room.left[y] == 1:
            for p in range(room.start[y], room.start[y + 1]):
                if room.state[room.near[p]] != GONE:
                    room.more[room.near[p]] -= 1
        room.bit[chosen] = room.bits[y]
        room.choice[chosen] = room.pair[q]
        chosen += 1
    return actives, used, chosen


@part
def _beside(y, actives, room):
    """List the untouched neighbours of a record that opens as next to what is open, for which it opens no more."""
    for p in range(room.start[y], room.start[y + 1]):
        z = room.near[p]
        room.more[z] -= 1
        if room.state[z] == UNTOUCHED:
            room.state[z] = BESIDE
            room.active[actives] = z
            actives += 1
    return actives


@part
def _next(actives, room):
    """Place of the listed record after which fewest are open; of those, with fewest choices, then the first."""
    best, least = np.int64(0), np.int64(1) << 60
    for k in range(actives):
        x = room.active[k]
        score = 1024 * room.more[x] + min(room.left[x], 1000)
        if score < least or (score == least and x < room.active[best]):
            best, least = k, score
    return best


@part
def sum_narrow(n, odds, loose, room, share, open_, taken):
    """Exact probabilities: ``share`` of every pair, of every record to be left ``open_`` or ``taken``; arranged before.

    odds of the pairs, ``loose`` of every record to be left alone.
    """
    for k in range(room.first[n]):
        room.odds[k] = odds[room.choice[k]]
    room.sum[0] = 1.0
    for t in range(n):
        _forwards(t, loose[room.order[t]], room)
        if t % EVERY == 0:
            _settle(room.begin[t + 1], room.size[t + 1], room)
    room.sum[room.begin[n]] = 1.0
    for t in range(n - 1, -1, -1):
        _backwards(t, room.order[t], loose, room, share, open_, taken)
        if t % EVERY == 0:
            _settle(room.begin[t], room.size[t], room)


@part
def _forwards(t, alone, room):
    value, bit, odds = room.sum, room.bit, room.odds
    now, then, own = room.begin[t], room.begin[t + 1], room.own[t]
    low, high = room.first[t], room.first[t + 1]
    for s in range(then, then + room.size[t + 1]):
        value[s] = 0.0
    for s in range(room.size[t]):
        so_far = value[now + s]
        if so_far == 0.0:
            continue
        if s & own:
            value[then + (s ^ own)] += so_far
            continue
        value[then + s] += so_far * alone
        for k in range(low, high):
            if s & bit[k] == 0:
                value[then + (s | bit[k])] += so_far * odds[k]


@part
def _backwards(t, x, loose, room, share, open_, taken):
    """The sums ahead in the place of those so far; probabilities of the record's pairs, and of being open or taken."""
    value, bit, odds = room.sum, room.bit, room.odds
    now, then, own = room.begin[t], room.begin[t + 1], room.own[t]
    low, high = room.first[t], room.first[t + 1]
    for k in range(low, high):
        share[room.choice[k]] = 0.0
    alone, before = 0.0, 0.0
    for s in range(room.size[t]):
        so_far = value[now + s]
        if so_far == 0.0:
            continue
        if s & own:
            ahead = value[then + (s ^ own)]
            before += so_far * ahead
        else:
            ahead = loose[x] * value[then + s]
            alone += so_far * ahead
            for k in range(low, high):
                if s & bit[k] == 0:
                    more = odds[k] * value[then + (s | bit[k])]
                    share[room.choice[k]] += so_far * more
                    ahead += more
        value[now + s] = ahead
    for k in range(low, high):
        before += share[room.choice[k]]
    for k in range(low, high):
        share[room.choice[k]] /= alone + before
    open_[x], taken[x] = alone / (alone + before), before / (alone + before)


@part
def _settle(begin, size, room):
    """Divide sums by the largest where that gets out of hand."""
    largest = 0.0
    for s in range(begin, begin + size):
        largest = max(largest, room.sum[s])
    if largest > GREAT or 0.0 < largest < 1.0 / GREAT:
        for s in range(begin, begin + size):
            room.sum[s] /= largest

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
SUMS = 1 << 20
#: Problems of more sums than this are laid out from as many records, spread over all, and the least is taken.
MANY, TRIALS = 512, 8
#: Sums are divided by their largest where that is not within this factor of 1.
GREAT = 1e100
UNTOUCHED, BESIDE, OPEN, GONE = 0, 1, 2, 3

#: The graph: CSR starts by record, of the neighbours and the pairs with them. The order: the records, their bits, the
#: starts and sizes of the sums before them, CSR starts of the choices left to them: their bits and pairs. By record
#: its state while the order is found, its bit, and how many neighbours are left; a list of records; the sums.
Narrow = namedtuple("Narrow", "start near pair order own begin size first bit choice state bits left active sum")


@part
def narrow(records, pairs):
    """Room for groups of at most so many records and pairs."""
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
        np.empty(records, np.int64),
        np.empty(records, np.int64),
        np.empty(records, np.int64),
        np.empty(records, np.int64),
        np.empty(SUMS),
    )


@part
def arranged(n, room):
    """Find an order that needs few sums, and lay them out; False where there is no room for them."""
    most = np.int64(SUMS)  # not literals: numba would compile for each of them apart
    best = np.int64(0)
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
    room.active[0] = first
    actives, used, chosen = 1, np.int64(0), 0
    room.begin[0], room.size[0], room.first[0] = 0, 1, 0
    for t in range(n):
        at = _next(actives, room)
        x = room.active[at]
        actives -= 1
        room.active[at] = room.active[actives]
        room.state[x] = GONE
        room.order[t], room.own[t] = x, room.bits[x]
        used &= ~room.bits[x]
        for q in range(room.start[x], room.start[x + 1]):
            y = room.near[q]
            if room.state[y] == GONE:
                continue
            room.left[y] -= 1
            if room.state[y] != OPEN:
                if room.state[y] == UNTOUCHED:
                    room.active[actives] = y
                    actives += 1
                room.state[y] = OPEN
                actives = _beside(y, actives, room)
                room.bits[y] = ~used & (used + 1)  # the lowest that is free
                used |= room.bits[y]
            room.bit[chosen] = room.bits[y]
            room.choice[chosen] = room.pair[q]
            chosen += 1
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
def _beside(y, actives, room):
    """List the untouched neighbours of a record that opens as next to what is open."""
    for p in range(room.start[y], room.start[y + 1]):
        z = room.near[p]
        if room.state[z] == UNTOUCHED:
            room.state[z] = BESIDE
            room.active[actives] = z
            actives += 1
    return actives


@part
def _next(actives, room):
    """Place of the listed record after which fewest are open; of those, with fewest choices, then the first."""
    best, least = 0, np.int64(1) << 60
    for k in range(actives):
        x = room.active[k]
        opens = -1 if room.state[x] == OPEN else 0
        for q in range(room.start[x], room.start[x + 1]):
            y = room.near[q]
            if room.state[y] == OPEN:
                opens -= 1 if room.left[y] == 1 else 0
            elif room.state[y] != GONE:
                opens += 1
        score = 1024 * opens + min(room.left[x], 1000)
        if score < least or (score == least and x < room.active[best]):
            best, least = k, score
    return best


@part
def sum_narrow(n, odds, loose, room, share, open_, taken):
    """Exact probabilities: ``share`` of every pair, of every record to be left ``open_`` or ``taken``; arranged before.

    odds of the pairs, ``loose`` of every record to be left alone.
    """
    room.sum[0] = 1.0
    for t in range(n):
        _forwards(t, odds, loose[room.order[t]], room)
    room.sum[room.begin[n]] = 1.0
    for t in range(n - 1, -1, -1):
        x = room.order[t]
        open_[x], taken[x] = _backwards(t, odds, loose[x], room, share)


@part
def _forwards(t, odds, alone, room):
    size, own = room.size[t], room.own[t]
    now = room.sum[room.begin[t] : room.begin[t] + size]
    then = room.sum[room.begin[t + 1] : room.begin[t + 1] + room.size[t + 1]]
    then[:] = 0.0
    for s in range(size):
        so_far = now[s]
        if so_far == 0.0:
            continue
        if s & own:
            then[s ^ own] += so_far
            continue
        then[s] += so_far * alone
        for k in range(room.first[t], room.first[t + 1]):
            if s & room.bit[k] == 0:
                then[s | room.bit[k]] += so_far * odds[room.choice[k]]
    _settle(then)


@part
def _backwards(t, odds, alone, room, share):
    """The sums ahead in the place of those so far; probabilities of the record's pairs, and of being open or taken."""
    size, own = room.size[t], room.own[t]
    low, high = room.first[t], room.first[t + 1]
    now = room.sum[room.begin[t] : room.begin[t] + size]
    then = room.sum[room.begin[t + 1] : room.begin[t + 1] + room.size[t + 1]]
    for k in range(low, high):
        share[room.choice[k]] = 0.0
    open_, taken = 0.0, 0.0
    for s in range(size):
        so_far = now[s]
        if so_far == 0.0:
            continue
        if s & own:
            now[s] = then[s ^ own]
            taken += so_far * now[s]
            continue
        ahead = alone * then[s]
        open_ += so_far * ahead
        for k in range(low, high):
            if s & room.bit[k] == 0:
                more = odds[room.choice[k]] * then[s | room.bit[k]]
                share[room.choice[k]] += so_far * more
                ahead += more
        now[s] = ahead
    for k in range(low, high):
        taken += share[room.choice[k]]
    total = open_ + taken
    for k in range(low, high):
        share[room.choice[k]] /= total
    _settle(now)
    return open_ / total, taken / total


@part
def _settle(value):
    """Divide by the largest where that gets out of hand."""
    largest = 0.0
    for x in value:
        largest = max(largest, x)
    if largest > GREAT or 0.0 < largest < 1.0 / GREAT:
        for s in range(len(value)):
            value[s] /= largest

"""Compiled posterior probabilities of groups that can be summed exactly.

Weights are *reduced* by the duals of the best hypothesis, w − u − v ≤ 0: that hypothesis then weighs 1 and every
other one at most 1, so that nothing overflows and what underflows is truly negligible.
"""

from __future__ import annotations

import math
from collections import namedtuple
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import BoolArray, FloatArray, Int32Array, IntArray
from sameas.kernels.compiled import part, small_by
from sameas.kernels.eliminate import eliminate, scratch

# Compiled exact sums over a graph of which few records are open at a time: records are eliminated one by one.
#
# A record is *open* from when the first of its neighbours is eliminated until it is so itself; whether it has a partner
# by then is one bit. The sums over what was eliminated stand in an array by the bits of the open records, one array for
# each step. To eliminate a record that is not taken yet is to leave it alone or to give it a neighbour that is left.
# Either source's records come in the order that keeps few open.

#: Most sums of one problem.
SUMS = 1 << 22
#: More records than this, open at a time, need more sums; far more would not fit into the bits of a word.
MOST_OPEN = 22
#: Problems of more sums than this are laid out from as many records, spread over all, and the least is taken.
MANY, TRIALS = 2048, 8
#: After so many steps sums are divided by their largest where that is not within this factor of 1.
EVERY, TREE_GREAT = 4, 1e60
#: Groups of two records of one source and so few of the other are summed hypothesis by hypothesis.
FEW_BESIDE_TWO = 4
UNTOUCHED, BESIDE, OPEN, GONE = 0, 1, 2, 3

#: The graph: CSR starts by record, of the neighbours and the pairs with them. The order: the records, their bits, the
#: starts and sizes of the sums before them, CSR starts of the choices left to them: their bits, pairs and
#: odds. By record, while the order is found, its state, its bit, how many neighbours are left, and how many more
#: records are open after it; a list of records. The sums.
Narrow = namedtuple(
    "Narrow", "start near pair order own begin size first bit choice odds state bits left more active sum"
)


@part
def narrow(records: int, pairs: int) -> Narrow:
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
def arranged(n: int, room: Narrow) -> bool:
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
def _laid_out_from(first: int, n: int, limit: int, room: Narrow) -> int:
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
def _eliminated(x: int, actives: int, used: int, chosen: int, room: Narrow) -> tuple[int, int, int]:
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
def _beside(y: int, actives: int, room: Narrow) -> int:
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
def _next(actives: int, room: Narrow) -> int:
    """Place of the listed record after which fewest are open; of those, with fewest choices, then the first."""
    best, least = np.int64(0), np.int64(1) << 60
    for k in range(actives):
        x = room.active[k]
        score = 1024 * room.more[x] + min(room.left[x], 1000)
        if score < least or (score == least and x < room.active[best]):
            best, least = k, score
    return best


@part
def sum_narrow(
    n: int, odds: FloatArray, loose: FloatArray, room: Narrow, share: FloatArray, open_: FloatArray, taken: FloatArray
) -> None:
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
def _forwards(t: int, alone: float, room: Narrow) -> None:
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
def _backwards(
    t: int, x: int, loose: FloatArray, room: Narrow, share: FloatArray, open_: FloatArray, taken: FloatArray
) -> None:
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
def _settle(begin: int, size: int, room: Narrow) -> float:
    """Divide sums by the largest where that gets out of hand; returns by what they were divided."""
    largest = 0.0
    for s in range(begin, begin + size):
        largest = max(largest, room.sum[s])
    if largest > TREE_GREAT or 0.0 < largest < 1.0 / TREE_GREAT:
        for s in range(begin, begin + size):
            room.sum[s] /= largest
        return largest
    return 1.0


@part
def log_sum_narrow(n: int, odds: FloatArray, loose: FloatArray, room: Narrow) -> float:
    """ln of the sum over all hypotheses; ``odds`` and ``loose`` as in :func:`sum_narrow`, arranged before."""
    for k in range(room.first[n]):
        room.odds[k] = odds[room.choice[k]]
    room.sum[0] = 1.0
    divided = 0.0
    for t in range(n):
        _forwards(t, loose[room.order[t]], room)
        if t % EVERY == 0:
            divided += math.log(_settle(room.begin[t + 1], room.size[t + 1], room))
    return divided + math.log(room.sum[room.begin[n]])


# Compiled folding of leaves: a record with one pair left is summed over into its partner, until none is left.
#
# A record that stays without partner counts ``loose``, a pair its odds times the ``scale`` of both records. Where
# record x has one pair left, with y, what is summed over x leaves y the same choices as before, with other numbers,
#
#     loose_y ← loose_y loose_x + odds_xy scale_x scale_y,   scale_y ← scale_y loose_x.
#
# Trees vanish by that: their probabilities are products on the way back. What remains are the records on cycles and
# between them, the *core*. Everything is a sum or product of what is not negative: small probabilities keep their
# digits.

#: Numbers of a record are divided by the greater one where that is above this.
GREAT = 1e15

#: By record, source 1 first: pairs left, exclusive or of their numbers, loose, scale, and the probability of having
#: a partner nearer to the core, or none. By folded leaf: record, pair, and how the partner's ``loose`` divides in two.
#: (1,) ln of what all sums were divided by.
Forest = namedtuple("Forest", "degree pairs loose scale taken open leaf through joint apart divided")


@part
def forest(records: int) -> Forest:
    """Room for groups of at most so many records."""
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


@part
def fold(n1: int, n2: int, first: Int32Array, second: Int32Array, odds: FloatArray, room: Forest) -> int:
    """Fold the leaves of n₁ + n₂ records whose ``loose`` is filled in; returns the number of leaves.

    first, second : (m,) numbers of the records of each pair in their sources. Records that remain have a ``degree``.
    """
    degree, pairs, loose, scale = room.degree, room.pairs, room.loose, room.scale
    room.divided[0] = 0.0
    for x in range(n1 + n2):
        degree[x] = 0
        pairs[x] = 0
        scale[x] = 1.0
        room.taken[x] = 0.0
        room.open[x] = 1.0
    for e in range(len(odds)):
        x, y = np.int64(first[e]), n1 + second[e]
        degree[x] += 1
        degree[y] += 1
        pairs[x] ^= e
        pairs[y] ^= e
    leaves = 0
    for x in range(n1 + n2):
        at = x
        while degree[at] == 1:
            e = pairs[at]
            other = n1 + second[e] if at < n1 else np.int64(first[e])
            joint = odds[e] * scale[at] * scale[other]
            apart = loose[other] * loose[at]
            total = joint + apart
            room.leaf[leaves] = at
            room.through[leaves] = e
            room.joint[leaves] = joint / total if total > 0.0 else 0.0
            room.apart[leaves] = apart / total if total > 0.0 else 0.0
            leaves += 1
            loose[other] = total
            scale[other] *= loose[at]
            greater = max(total, scale[other])
            if greater > GREAT:
                loose[other] /= greater
                scale[other] /= greater
                room.divided[0] += math.log(greater)
            degree[at] = 0
            degree[other] -= 1
            pairs[other] ^= e
            at = other
    return leaves


@part
def unfold(leaves: int, n1: int, first: Int32Array, second: Int32Array, room: Forest, share: FloatArray) -> None:
    """Fill ``share`` of the pairs by which leaves were folded, from ``open`` and ``taken`` of the core's records."""
    taken, open_ = room.taken, room.open
    for k in range(leaves - 1, -1, -1):
        x = room.leaf[k]
        e = room.through[k]
        other = n1 + second[e] if x < n1 else np.int64(first[e])
        p = open_[other] * room.joint[k]
        share[e] = p
        open_[other] *= room.apart[k]
        taken[x] = p
        open_[x] = taken[other] + open_[other]
        taken[other] += p


@part
def core_of(
    n1: int,
    n2: int,
    first: Int32Array,
    second: Int32Array,
    odds: FloatArray,
    room: Forest,
    record: IntArray,
    graph: Narrow,
    core_odds: FloatArray,
) -> int:
    """Lay the records that remain out as a graph (``narrow``), with the ``odds`` of its pairs; returns their number.

    ``record`` is filled with the graph's records' numbers among the n₁ + n₂.
    """
    n = np.int64(0)
    graph.start[0] = 0
    for x in range(n1 + n2):
        if room.degree[x] > 0:
            room.pairs[x] = n
            record[n] = x
            graph.start[n + 1] = graph.start[n] + room.degree[x]
            graph.left[n] = graph.start[n]
            n += 1
    for e in range(len(first)):
        x, y = np.int64(first[e]), n1 + second[e]
        if room.degree[x] > 0 and room.degree[y] > 0:
            core_odds[e] = odds[e] * room.scale[x] * room.scale[y]
            a, b = room.pairs[x], room.pairs[y]
            graph.near[graph.left[a]], graph.near[graph.left[b]] = b, a
            graph.pair[graph.left[a]], graph.pair[graph.left[b]] = e, e
            graph.left[a] += 1
            graph.left[b] += 1
    return n


CLOSED, ELIMINATED, LOCAL = 0, 1, 2
#: Reduced log weights below this are as good as impossible; priors this far above the best count are left out.
DEEPEST = 600.0
HIGHEST = 300.0


@part
def bounded_exp(x: float) -> float:
    """exp(x) for x ≤ 0, never quite zero."""
    return math.exp(max(x, -DEEPEST))


@part
def by_row(
    n1: int,
    n2: int,
    low: int,
    high: int,
    local1: Int32Array,
    local2: Int32Array,
    weight: FloatArray,
    u: FloatArray,
    v: FloatArray,
    flipped: bool,
    start: IntArray,
    column: Int32Array,
    pair: IntArray,
    odds: FloatArray,
    none: FloatArray,
    unused: FloatArray,
) -> tuple[int, int]:
    """The reduced problem of one group, its rows being source 1 or, ``flipped``, source 2."""
    n = n2 if flipped else n1
    nc = n1 if flipped else n2
    row_of = local2 if flipped else local1
    column_of = local1 if flipped else local2
    start[: n + 1] = 0
    for e in range(low, high):
        start[row_of[e] + 1] += 1
    for r in range(n):
        start[r + 1] += start[r]
    for e in range(low, high):
        r = row_of[e]
        at = start[r]
        column[at] = column_of[e]
        pair[at] = e
        odds[at] = math.exp(max(weight[e] - u[local1[e]] - v[local2[e]], -700.0))
        start[r] += 1
    for r in range(n, 0, -1):
        start[r] = start[r - 1]
    start[0] = 0
    for r in range(n1):
        (unused if flipped else none)[r] = bounded_exp(-u[r])
    for c in range(n2):
        (none if flipped else unused)[c] = bounded_exp(-v[c])
    return n, nc


@part
def star(low: int, high: int, weight: FloatArray, share: FloatArray) -> None:
    """Closed form where one record has all the pairs of the group: a softmax with the null."""
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
    """exp(ln P(k) − μ (k − k₀)) relative to the best hypothesis' k₀ = ``size``; 0 where out of reach."""
    factors = np.zeros(len(prior))
    for k in range(len(prior)):
        x = prior[k] - prior[size] - slope * (k - size)
        if x < HIGHEST:
            factors[k] = math.exp(max(x, -700.0))
    return factors


def _sums(first: int, last: int, start: IntArray, start1: IntArray, start2: IntArray, *rest: Any) -> float:
    """Sums over a group double with each record that may be open at a time, and every pair counts in each."""
    pairs, one, two = (np.diff(starts[first : last + 1]) for starts in (start, start1, start2))
    return 10.0 * float(np.sum(pairs * 2.0 ** (np.minimum(np.minimum(one, two), 50) - 1)))


@part
def two_at_most(
    n1: int, n2: int, first: Int32Array, second: Int32Array, odds: FloatArray, loose: FloatArray, share: FloatArray
) -> None:
    """Fill ``share`` (m,) of a group in which no hypothesis has more than two pairs, hypothesis by hypothesis: to lay
    out the elimination of two records takes ten times as long. loose : (n₁ + n₂,) odds of records without a partner."""
    total = 1.0
    for x in range(n1 + n2):
        total *= loose[x]
    for e in range(len(first)):
        value = odds[e]
        for x in range(n1 + n2):
            value *= 1.0 if x == first[e] or x == n1 + second[e] else loose[x]
        share[e] = value
        total += value
    for e in range(len(first)):
        for f in range(e):
            if first[e] == first[f] or second[e] == second[f]:
                continue
            value = odds[e] * odds[f]
            for x in range(n1 + n2):
                taken = x == first[e] or x == first[f] or x == n1 + second[e] or x == n1 + second[f]
                value *= 1.0 if taken else loose[x]
            share[e] += value
            share[f] += value
            total += value
    for e in range(len(first)):
        share[e] /= total


def _sums_of_small(first: int, last: int, start: IntArray, start1: IntArray, start2: IntArray, *rest: Any) -> float:
    """The same over the groups that are not too large to be summed at all."""
    most = rest[5]
    pairs, one, two = (np.diff(starts[first : last + 1]) for starts in (start, start1, start2))
    records = np.minimum(one, two)
    return 10.0 * float(np.sum(np.where(records <= most, pairs * 2.0 ** (np.minimum(records, 50) - 1), 0.1)))


@small_by(_sums_of_small)
def exact(
    first: int,
    last: int,
    start: IntArray,
    start1: IntArray,
    start2: IntArray,
    local1: Int32Array,
    local2: Int32Array,
    weight: FloatArray,
    u: FloatArray,
    v: FloatArray,
    most: int,
    share: FloatArray,
    method: NDArray[np.int8],
) -> None:
    """Posterior ``share`` (m,) of the pairs of the groups first … last − 1 under a linear prior, where it can be exact.

    method (g,) receives CLOSED, ELIMINATED or, with nothing filled in, LOCAL: where both sides have more than ``most``
    records, or too many are open at a time (:mod:`narrow`).
    """
    records, pairs = np.int64(2), np.int64(1)
    for g in range(first, last):
        n1, n2 = start1[g + 1] - start1[g], start2[g + 1] - start2[g]
        if 1 < min(n1, n2) <= most:
            records = max(records, n1 + n2)
            pairs = max(pairs, start[g + 1] - start[g])
    tree, graph = forest(records), narrow(records, pairs)
    odds, core_odds = np.empty(pairs), np.empty(pairs)
    record = np.empty(records, np.int64)
    loose, open_, taken = np.empty(records), np.empty(records), np.empty(records)
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
        for r in range(n1):
            tree.loose[r] = bounded_exp(-u[start1[g] + r])
        for c in range(n2):
            tree.loose[n1 + c] = bounded_exp(-v[start2[g] + c])
        one, two, of_pair = local1[low:high], local2[low:high], share[low:high]
        for e in range(low, high):
            odds[e - low] = math.exp(max(weight[e] - u[start1[g] + local1[e]] - v[start2[g] + local2[e]], -700.0))
        if min(n1, n2) == 2 and max(n1, n2) <= FEW_BESIDE_TWO:
            two_at_most(n1, n2, one, two, odds, tree.loose, of_pair)
            method[g] = ELIMINATED
            continue
        leaves = fold(n1, n2, one, two, odds[: high - low], tree)
        if leaves < n1 + n2 - 1:
            n = core_of(n1, n2, one, two, odds, tree, record, graph, core_odds)
            if not arranged(n, graph):
                continue
            for x in range(n):
                loose[x] = tree.loose[record[x]]
            sum_narrow(n, core_odds, loose, graph, of_pair, open_, taken)
            for x in range(n):
                tree.open[record[x]], tree.taken[record[x]] = open_[x], taken[x]
        unfold(leaves, n1, one, two, tree, of_pair)
        method[g] = ELIMINATED


@small_by(_sums)
def log_sums(
    first: int,
    last: int,
    start: IntArray,
    start1: IntArray,
    start2: IntArray,
    local1: Int32Array,
    local2: Int32Array,
    weight: FloatArray,
    u: FloatArray,
    v: FloatArray,
    out: FloatArray,
) -> None:
    """Fill ``out`` (g,) with ln Σ over the hypotheses of exp(Σ weight) of the groups first … last − 1, the sum that
    :func:`exact` divides by; NaN where too many records are open at a time."""
    records, pairs = np.int64(2), np.int64(1)
    for g in range(first, last):
        records = max(records, start1[g + 1] - start1[g] + start2[g + 1] - start2[g])
        pairs = max(pairs, start[g + 1] - start[g])
    tree, graph = forest(records), narrow(records, pairs)
    odds, core_odds = np.empty(pairs), np.empty(pairs)
    record, loose = np.empty(records, np.int64), np.empty(records)
    for g in range(first, last):
        low, high = start[g], start[g + 1]
        n1, n2 = start1[g + 1] - start1[g], start2[g + 1] - start2[g]
        # Every hypothesis is reduced by the duals, which the best one weighs.
        total = 0.0
        for r in range(n1):
            total += u[start1[g] + r]
            tree.loose[r] = bounded_exp(-u[start1[g] + r])
        for c in range(n2):
            total += v[start2[g] + c]
            tree.loose[n1 + c] = bounded_exp(-v[start2[g] + c])
        one, two = local1[low:high], local2[low:high]
        for e in range(low, high):
            odds[e - low] = math.exp(max(weight[e] - u[start1[g] + local1[e]] - v[start2[g] + local2[e]], -700.0))
        leaves = fold(n1, n2, one, two, odds[: high - low], tree)
        total += tree.divided[0]
        if leaves == n1 + n2 - 1:
            # A tree: all of it is summed over into the partner of the last leaf.
            x, e = tree.leaf[leaves - 1], tree.through[leaves - 1]
            root = n1 + two[e] if x < n1 else np.int64(one[e])
            out[g] = total + math.log(tree.loose[root])
            continue
        n = core_of(n1, n2, one, two, odds, tree, record, graph, core_odds)
        if not arranged(n, graph):
            out[g] = np.nan
            continue
        for x in range(n):
            loose[x] = tree.loose[record[x]]
        out[g] = total + log_sum_narrow(n, core_odds, loose, graph)


@small_by(_sums)
def exact_counted(
    first: int,
    last: int,
    start: IntArray,
    start1: IntArray,
    start2: IntArray,
    local1: Int32Array,
    local2: Int32Array,
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
    """The same as :func:`exact` under any prior of the count: weight excludes it (see ``assign_counted``).

    table[table_start[g] + k] : ln P of k pairs.
    """
    widest, longest, narrowest = np.int64(1), np.int64(1), np.int64(1)
    for g in range(first, last):
        n1, n2 = start1[g + 1] - start1[g], start2[g + 1] - start2[g]
        if 1 < min(n1, n2) <= most:
            widest = max(widest, n1, n2)
            longest = max(longest, start[g + 1] - start[g])
            narrowest = max(narrowest, min(n1, n2))
    work = scratch(longest, widest, narrowest)
    row_start = np.empty(widest + 2, np.int64)
    column, pair = np.empty(longest, np.int32), np.empty(longest, np.int64)
    odds, part = np.empty(longest), np.empty(longest)
    none, unused, alone = np.empty(widest), np.empty(widest), np.empty(widest)
    stamp = np.int64(0)  # not a literal: numba would compile for it apart
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
        ug, vg = u[start1[g] : start1[g + 1]], v[start2[g] : start2[g + 1]]
        n, nc = by_row(n1, n2, low, high, local1, local2, share, ug, vg, n2 > n1, row_start, column, pair, odds,
                       none, unused)  # fmt: skip
        prior = count_factors(log_p, slope[g], size)
        after = eliminate(n, nc, row_start[: n + 1], column, odds, none, unused, prior, part, alone, stamp, work)
        if after < 0:
            stamp += n + 1
            continue
        stamp = after
        method[g] = ELIMINATED
        for t in range(high - low):
            share[pair[t]] = part[t]

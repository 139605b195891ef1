"""Compiled folding of leaves: a record with one pair left is summed over into its partner, until none is left.

A record that stays without partner counts ``loose``, a pair its odds times the ``scale`` of both records. Where record
x has one pair left, with y, what is summed over x leaves y the same choices as before, with other numbers,

    loose_y ← loose_y loose_x + odds_xy scale_x scale_y,   scale_y ← scale_y loose_x.

Trees vanish by that: their probabilities are products on the way back. What remains are the records on cycles and
between them, the *core*. Everything is a sum or product of what is not negative: small probabilities keep their digits.
"""

from __future__ import annotations

from collections import namedtuple

import numpy as np

from sameas.kernels.compiled import part

#: Numbers of a record are divided by the greater one where that is above this.
GREAT = 1e15

#: By record, source 1 first: pairs left, exclusive or of their numbers, loose, scale, and the probability of having
#: a partner nearer to the core, or none. By folded leaf: record, pair, and how the partner's ``loose`` divides in two.
Forest = namedtuple("Forest", "degree pairs loose scale taken open leaf through joint apart")


@part
def forest(records):
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
    )


@part
def fold(n1, n2, first, second, odds, room):
    """Fold the leaves of n₁ + n₂ records whose ``loose`` is filled in; returns the number of leaves.

    first, second : (m,) numbers of the records of each pair in their sources. Records that remain have a ``degree``.
    """
    degree, pairs, loose, scale = room.degree, room.pairs, room.loose, room.scale
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
            degree[at] = 0
            degree[other] -= 1
            pairs[other] ^= e
            at = other
    return leaves


@part
def unfold(leaves, n1, first, second, room, share):
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
def core_of(n1, n2, first, second, odds, room, record, graph, core_odds):
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

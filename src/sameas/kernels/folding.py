"""Exact sums by folding leaves: a record with one pair left is summed over into its partner, until no such record is
left.

A record without partner counts ``odds_alone``, a pair its odds times the ``scale`` of both records. Summing over a
record x whose only pair left is with y leaves y the same choices, with

    alone_y ← alone_y alone_x + odds_xy scale_x scale_y,   scale_y ← scale_y alone_x.

A tree is summed completely; its probabilities are products on the way back. Elsewhere the *core* remains: the records
on cycles and between them. All terms are sums and products of nonnegative numbers, so small probabilities keep their
digits.
"""

from __future__ import annotations

import math
from collections import namedtuple

import numpy as np

from sameas.arrays import FloatArray, Int32Array, IntArray
from sameas.kernels.compiled import borrowing_part, part
from sameas.kernels.elimination import Elimination

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
    n1: int, n2: int, first: Int32Array, second: Int32Array, odds: FloatArray, folded: Forest, record: IntArray,
    graph: Elimination, core_odds: FloatArray,
) -> int:  # fmt: skip
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

"""Compiled connected components of the candidate pairs, and the layout of pairs and records by component."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sameas.arrays import AnyIntArray, FloatArray, Int32Array, IntArray
from sameas.kernels.compiled import part, small


class GroupLayout(NamedTuple):
    """Pairs and records group by group; the fields of :class:`sameas.groups.Groups`."""

    start: IntArray
    start1: IntArray
    start2: IntArray
    edges1: IntArray
    local1: Int32Array
    local2: Int32Array


def sizes(first: int, last: int, layout: GroupLayout) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Numbers of pairs and of the records of either source, of the groups first … last − 1."""
    pairs, one, two = (np.diff(starts[first : last + 1]).astype(np.float64) for starts in layout[:3])
    return pairs, one, two


@part
def root(parent: AnyIntArray, k: int) -> int:
    """The representative of k; halves the path to it."""
    while parent[k] != k:
        parent[k] = parent[parent[k]]
        k = parent[k]
    return k


@small
def label_components(i: AnyIntArray, j: AnyIntArray, parent: IntArray, label: IntArray) -> None:
    """Write the component of every record (n,), numbered by first appearance. i, j : (m,) the records of each pair.
    parent : (n,) scratch."""
    join(i, j, parent, 0)
    count = 0
    for k in range(len(parent)):
        a = root(parent, k)
        if a == k:
            label[k] = count
            count += 1
        else:
            label[k] = label[a]


@small
def label_pairs(
    place1: Int32Array, place2: Int32Array, parent: Int32Array, label: Int32Array, number2: Int32Array,
    group: Int32Array, start: IntArray, start1: IntArray, start2: IntArray,
) -> int:  # fmt: skip
    """Number the components by first appearance among the pairs; returns their number.

    place1, place2 : (m,) record numbers, close in memory for consecutive pairs; the pairs of a record of source 1 are
    consecutive. group : (m,) receives each pair's component. number2 : (n2,) receives each record's number within its
    component. start, start1, start2 : (components + 1 or more) receive, at g + 1, the numbers of pairs and of records
    of either source in the components 0 … g. parent (n1 + n2,), label (n1,) : scratch.
    """
    n1 = len(label)
    join(place1, place2, parent, n1)
    label[:] = -1
    number2[:] = -1
    start[:], start1[:], start2[:] = 0, 0, 0
    groups = 0
    g = -1
    for e in range(len(place1)):
        if e == 0 or place1[e] != place1[e - 1]:
            a = root(parent, place1[e])
            if label[a] < 0:
                label[a] = groups
                groups += 1
            g = label[a]
            start1[g + 1] += 1
        group[e] = g
        start[g + 1] += 1
        if number2[place2[e]] < 0:
            number2[place2[e]] = start2[g + 1]
            start2[g + 1] += 1
    for g in range(groups):
        start[g + 1] += start[g]
        start1[g + 1] += start1[g]
        start2[g + 1] += start2[g]
    return groups


@part
def join(place1: AnyIntArray, place2: AnyIntArray, parent: AnyIntArray, n1: int) -> None:
    """Union of the two records of every pair; the representative is the lowest number.

    n1 : added to place2: the number of records of source 1, or 0 if both number the same records.
    """
    for k in range(len(parent)):
        parent[k] = k
    a = 0
    for e in range(len(place1)):
        if e == 0 or place1[e] != place1[e - 1]:
            a = root(parent, place1[e])
        b = root(parent, place2[e] + n1)
        if a < b:
            parent[b] = a
        elif b < a:
            parent[a] = b
            a = b


@small
def lay_out(
    place1: Int32Array, place2: Int32Array, i: Int32Array, j: Int32Array, group: Int32Array, number2: Int32Array,
    start1: IntArray, start2: IntArray, fill: IntArray, fill1: IntArray, order: IntArray, edges1: IntArray,
    local1: Int32Array, local2: Int32Array, rows: tuple[Int32Array, Int32Array],
) -> None:  # fmt: skip
    """Lay out the candidate pairs (i, j) by component, in their order within each.

    group, number2, start1, start2 : of :func:`label_pairs`. fill, fill1 : copies of its start and start1. Writes order
    (m,), the pair at each position of the layout; edges1, the CSR of pairs by record of source 1; local1, local2 (m,),
    the numbers of a pair's records within its group; rows, the records of either source.
    """
    rows1, rows2 = rows
    at = 0
    for e in range(len(place1)):
        g = group[e]
        to = fill[g]
        fill[g] = to + 1
        if e == 0 or place1[e] != place1[e - 1]:
            at = fill1[g]
            fill1[g] = at + 1
            rows1[at] = i[e]
            edges1[at] = to
        order[to] = e
        local1[to] = at - start1[g]
        local2[to] = number2[place2[e]]
        rows2[start2[g] + number2[place2[e]]] = j[e]
    edges1[len(rows1)] = len(place1)


@small
def grown_sets(
    records: IntArray, width: IntArray, start: IntArray, j: IntArray, parent: IntArray, added: IntArray, pairs: IntArray
) -> int:
    """Write the sets of one more record, every two of whose records are a pair, in order; returns their number.

    records : (k, size) sets of ascending records. width : (k,) number of records to try: of the pairs of each set's
    last record with later ones, or none of them. start : (n + 1,) first pair of each record with a later one, the
    record ``j``. parent, added : the set that each new one grows from, and the record added. pairs : (…, size) numbers
    of the added record's pairs with the others.
    """
    count, size = 0, records.shape[1]
    for k in range(len(records)):
        first = start[records[k, size - 1]]
        for pair in range(first, first + width[k]):
            complete = True
            for column in range(size - 1):
                at, stop = start[records[k, column]], start[records[k, column] + 1]
                while at < stop and j[at] < j[pair]:
                    at += 1
                complete = complete and at < stop and j[at] == j[pair]
                if not complete:
                    break
                pairs[count, column] = at
            if complete:
                parent[count], added[count], pairs[count, size - 1] = k, j[pair], pair
                count += 1
    return count

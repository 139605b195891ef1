"""Compiled connected components of the candidate graph, laid out group by group."""

from __future__ import annotations

import numpy as np

from sameas.kernels.compiled import kernel, part


@part
def root(parent, k):
    """The representative of k, halving the path on the way."""
    while parent[k] != k:
        parent[k] = parent[parent[k]]
        k = parent[k]
    return k


@kernel
def components(place1, place2, i, j, n1, n2):
    """Lay the candidate pairs (i, j) out by connected component, in the order in which components first appear.

    place1, place2 number the records so that neighbours in the list are neighbours in memory.

    Returns (order, start, rows1, start1, edges1, rows2, start2, local1, local2): pair ``order[e]`` is the e-th of the
    layout; group g holds its pairs start[g]:start[g+1], its records rows1[start1[g]:start1[g+1]] and rows2[…];
    edges1 is the CSR of the pairs by record of rows1; local1, local2 number the records of a pair within its group.
    """
    m = len(i)
    parent = np.empty(n1 + n2, np.int32)
    for k in range(n1 + n2):
        parent[k] = k
    for e in range(m):
        a = root(parent, place1[e])
        b = root(parent, place2[e] + n1)
        if a < b:
            parent[b] = a
        elif b < a:
            parent[a] = b
    label = np.full(n1 + n2, -1, np.int32)
    group = np.empty(m, np.int32)
    groups = 0
    for e in range(m):
        a = root(parent, place1[e])
        if label[a] < 0:
            label[a] = groups
            groups += 1
        group[e] = label[a]
    start = np.zeros(groups + 1, np.int64)
    for e in range(m):
        start[group[e] + 1] += 1
    for g in range(groups):
        start[g + 1] += start[g]
    order = np.empty(m, np.int64)
    fill = start[:-1].copy()
    for e in range(m):
        g = group[e]
        order[fill[g]] = e
        fill[g] += 1
    return laid_out(place1, place2, i, j, n1, n2, order, start)


@part
def laid_out(place1, place2, i, j, n1, n2, order, start):
    """The second half of :func:`components`: number the records of every group as they first appear."""
    m = len(order)
    groups = len(start) - 1
    number1 = np.full(n1, -1, np.int32)
    number2 = np.full(n2, -1, np.int32)
    rows1 = np.empty(min(n1, m), np.int32)
    rows2 = np.empty(min(n2, m), np.int32)
    start1 = np.zeros(groups + 1, np.int64)
    start2 = np.zeros(groups + 1, np.int64)
    edges1 = np.zeros(min(n1, m) + 1, np.int64)
    local1 = np.empty(m, np.int32)
    local2 = np.empty(m, np.int32)
    count1 = 0
    count2 = 0
    for g in range(groups):
        for e in range(start[g], start[g + 1]):
            a = place1[order[e]]
            b = place2[order[e]]
            if number1[a] < 0:
                number1[a] = count1 - start1[g]
                rows1[count1] = i[order[e]]
                edges1[count1] = e
                count1 += 1
            if number2[b] < 0:
                number2[b] = count2 - start2[g]
                rows2[count2] = j[order[e]]
                count2 += 1
            local1[e] = number1[a]
            local2[e] = number2[b]
        start1[g + 1] = count1
        start2[g + 1] = count2
    edges1[count1] = m
    return order, start, rows1[:count1], start1, edges1[: count1 + 1], rows2[:count2], start2, local1, local2

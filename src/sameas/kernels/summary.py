"""Compiled summary of the pairs of each record."""

from __future__ import annotations

import numpy as np

from sameas.arrays import BoolArray, FloatArray, Int32Array, IntArray
from sameas.kernels.compiled import small


@small
def per_record(
    record: Int32Array, n: int, chosen: BoolArray, p_pair: FloatArray
) -> tuple[FloatArray | Int32Array | IntArray, ...]:
    """(n,) of each record: its chosen pair or −1, its most probable other pair or −1, number and Σ p of its pairs."""
    partner = np.full(n, -1, np.int64)
    second = np.full(n, -1, np.int64)
    count = np.zeros(n, np.int32)
    total = np.zeros(n)
    for e in range(len(record)):
        r = record[e]
        count[r] += 1
        total[r] += p_pair[e]
        if chosen[e]:
            partner[r] = e
        elif second[r] < 0 or p_pair[e] > p_pair[second[r]]:
            second[r] = e
    return partner, second, count, total


@small
def greatest_pair(position: Int32Array, n: int, value: FloatArray) -> IntArray:
    """(n,) the pair of largest value of each record, the first of ties; −1 without pairs.

    position : (m,) record of each pair. value : (m,).
    """
    best = np.full(n, -1, np.int64)
    for e in range(len(position)):
        k = position[e]
        if best[k] < 0 or value[e] > value[best[k]]:
            best[k] = e
    return best


@small
def by_row(
    at: IntArray,
    of_record: tuple[FloatArray | Int32Array | IntArray, ...],
    pairs: tuple[FloatArray | Int32Array | IntArray, ...],
    rows: tuple[IntArray, IntArray, IntArray],
    shares: tuple[FloatArray, FloatArray, FloatArray],
    counts: tuple[Int32Array, Int32Array, IntArray],
    absent: tuple[BoolArray, ...],
) -> None:
    """Write the summary of each record k to row ``at[k]`` of the table.

    of_record : result of :func:`per_record`. pairs : probability (m,), position of the other record (m,), table rows of
    the other source's records (n,), group (m,), sizes of the groups. Writes rows (partner, pair, second), shares
    (p_match, p_none, p_second) and counts (candidates, group, group_size), and clears the masks absent (partner,
    second, group, record), all True before.
    """
    partner, second, number, total = of_record
    p, other, other_rows, group_of, size = pairs
    of_partner, of_pair, of_second = rows
    p_match, p_none, p_second = shares
    candidates, group, group_size = counts
    alone, no_other, no_group, unusable = absent
    for k in range(len(at)):
        r = at[k]
        unusable[r] = False
        candidates[r] = number[k]
        # 1 − Σ p is the probability of no partner; rounding may make it negative.
        p_none[r] = min(max(1.0 - total[k], 0.0), 1.0)
        if partner[k] >= 0:
            alone[r] = False
            of_partner[r], of_pair[r], p_match[r] = other_rows[other[partner[k]]], partner[k], p[partner[k]]
        if second[k] >= 0:
            no_other[r] = False
            of_second[r], p_second[r] = other_rows[other[second[k]]], p[second[k]]
        some = max(partner[k], second[k])
        if some >= 0:
            no_group[r] = False
            group[r], group_size[r] = group_of[some], size[group_of[some]]

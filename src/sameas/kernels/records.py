"""Compiled loops over the records of a source: their validation, and the summary of the pairs of each."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import BoolArray, FloatArray, Int32Array, IntArray
from sameas.kernels.compiled import part, small

USABLE, NO_POSITION, NO_ERROR, NOT_POSITIVE, BEYOND_POLE = 0, 1, 2, 3, 4


@small
def check_rows(features: FloatArray, packed: FloatArray, directions: bool, reasons: NDArray[np.int8]) -> int:
    """Write to ``reasons`` (n,) 0 for a usable row, else the number of its error; returns the number of unusable rows.

    directions : features are longitude and latitude in degrees.
    """
    n, d = features.shape
    p = packed.shape[1]
    factor = np.empty((d, d))
    wrong = 0
    for k in range(n):
        reason = USABLE
        known = True
        for t in range(p):
            known = known and abs(packed[k, t]) < np.inf
        if not known:
            reason = NO_ERROR
        elif p <= d:
            for t in range(p):
                if not packed[k, t] > 0.0:
                    reason = NOT_POSITIVE
        elif not definite(packed, k, d, factor):
            reason = NOT_POSITIVE
        if directions and abs(features[k, 1]) > 90.0:
            reason = BEYOND_POLE
        for v in range(d):
            if not abs(features[k, v]) < np.inf:
                reason = NO_POSITION
        reasons[k] = reason
        wrong += reason != USABLE
    return wrong


@small
def pack(matrices: FloatArray, packed: FloatArray) -> bool:
    """Write upper triangles to ``packed`` (n, d(d+1)/2), row by row; returns whether all matrices are symmetric."""
    d = matrices.shape[1]
    symmetric = True
    if d == 2:
        for k in range(len(matrices)):
            packed[k, 0], packed[k, 1], packed[k, 2] = matrices[k, 0, 0], matrices[k, 0, 1], matrices[k, 1, 1]
            symmetric &= matrices[k, 0, 1] == matrices[k, 1, 0]
        return symmetric
    for k in range(len(matrices)):
        t = 0
        for v in range(d):
            for w in range(v, d):
                packed[k, t] = matrices[k, v, w]
                symmetric &= matrices[k, v, w] == matrices[k, w, v]
                t += 1
    return symmetric


@part
def definite(packed: FloatArray, k: int, d: int, factor: FloatArray) -> bool:
    """Whether a packed covariance is positive definite beyond rounding errors, which correlations of ±1 are not."""
    least = 1e-14 if d == 2 else 1e-12
    t = 0
    for v in range(d):
        for w in range(v, d):
            factor[w, v] = packed[k, t]
            t += 1
    for v in range(d):
        own = factor[v, v]
        if not own > 0.0:
            return False
        total = own
        for w in range(v):
            part = factor[v, w]
            for u in range(w):
                part -= factor[v, u] * factor[w, u]
            factor[v, w] = part / factor[w, w]
            total -= factor[v, w] * factor[v, w]
        if not total > least * own:
            return False
        factor[v, v] = math.sqrt(total)
    return True


@small
def per_record(
    record: Int32Array, n: int, chosen: BoolArray, p_pair: FloatArray
) -> tuple[IntArray, IntArray, Int32Array, FloatArray]:
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
    at: IntArray, of_record: tuple[IntArray, IntArray, Int32Array, FloatArray],
    pairs: tuple[FloatArray, Int32Array, IntArray, Int32Array, IntArray], rows: tuple[IntArray, IntArray, IntArray],
    shares: tuple[FloatArray, FloatArray, FloatArray], counts: tuple[Int32Array, Int32Array, IntArray],
    absent: tuple[BoolArray, ...],
) -> None:  # fmt: skip
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

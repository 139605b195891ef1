"""Compiled summary of the pairs of each record."""

from __future__ import annotations

import numpy as np

from sameas.kernels.compiled import kernel


@kernel
def per_record(record, n, chosen, p_pair):
    """For each of n records its chosen pair or −1, its most probable other pair or −1, candidates, Σ p of its pairs."""
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


@kernel
def foremost(position, n, value):
    """(n,) the pair of greatest value of each record, the first of equal ones; −1 without pairs.

    position : (m,) record of each pair. value : (m,).
    """
    best = np.full(n, -1, np.int64)
    for e in range(len(position)):
        k = position[e]
        if best[k] < 0 or value[e] > value[best[k]]:
            best[k] = e
    return best

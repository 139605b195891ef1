"""Compiled validation of the records of a source, row by row."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import FloatArray
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

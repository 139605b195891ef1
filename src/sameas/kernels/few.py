"""Compiled search among few records: everything that a large search lays out first costs more than it saves here."""

from __future__ import annotations

import math

import numpy as np

from sameas.arrays import FloatArray, Int32Array
from sameas.kernels.compiled import part, small
from sameas.kernels.order import Side
from sameas.kernels.plane import add_spread, measured_on_plane
from sameas.kernels.spans import first_from


@small
def sweep_few(
    features1: FloatArray,
    packed1: FloatArray,
    features2: FloatArray,
    packed2: FloatArray,
    limit: float,
    box: bool,
    periods: FloatArray,
    out: tuple[FloatArray | Int32Array, ...],
) -> int:
    """Candidates of two sources of few records on a plane, written into the columns ``out`` of ``gate.Pairs``.

    Returns their number; −1 where ``out`` is too small for them, or two records of a source say exactly the same.
    """
    one, single1 = _in_order(features1, packed1, periods)
    two, single2 = _in_order(features2, packed2, periods)
    if not (single1 and single2):
        return -1
    n2, d = features2.shape
    variance1, variance2 = _along_axes(one.content, d), _along_axes(two.content, d)
    widest = 0.0
    for k in range(n2):
        widest = max(widest, variance2[k, 0])
    of1, of2 = np.empty(n2, np.int32), np.empty(n2, np.int32)
    enough = limit * (1.0 + 1e-6)
    count = np.int64(0)
    for k in range(len(features1)):
        x = one.content[k, 0]
        reach = math.sqrt(enough * (variance1[k, 0] + widest)) if periods[0] == np.inf else np.inf
        found = 0
        for q in range(first_from(two.content, 0, n2, x - reach), n2):
            if two.content[q, 0] > x + reach:
                break
            of1[found], of2[found] = k, q
            found += _near(one.content, variance1, k, two.content, variance2, q, periods, enough)
        count, done = measured_on_plane(one, two, limit, box, periods, of1, of2, found, count, out)
        if done < found:
            return -1
    return count


@part
def _near(
    content1: FloatArray,
    variance1: FloatArray,
    k: int,
    content2: FloatArray,
    variance2: FloatArray,
    q: int,
    periods: FloatArray,
    enough: float,
) -> bool:
    """Whether no axis tells two records apart."""
    for v in range(variance1.shape[1]):
        apart = abs(content1[k, v] - content2[q, v])
        apart = min(apart, periods[v] - apart)
        if apart * apart > enough * (variance1[k, v] + variance2[q, v]):
            return False
    return True


@part
def _along_axes(content: FloatArray, d: int) -> FloatArray:
    """(n, d) variances of the features, of records (n, d + p): first the features, then the packed covariance."""
    variance = np.zeros((len(content), d))
    matrix = np.zeros((d, d))
    for k in range(len(content)):
        matrix[:, :] = 0.0
        add_spread(content, k, d, d, matrix)
        for v in range(d):
            variance[k, v] = matrix[v, v]
    return variance


@part
def _in_order(features: FloatArray, packed: FloatArray, periods: FloatArray) -> tuple[Side, bool]:
    """A source by its features, one after another, then its errors; whether every record has a place of its own."""
    n, d = features.shape
    content = np.empty((n, d + packed.shape[1]))
    for k in range(n):
        for v in range(d):
            value = features[k, v]
            if periods[v] < np.inf and not 0.0 <= value < periods[v]:
                value -= periods[v] * math.floor(value / periods[v])
                value = value if value < periods[v] else 0.0
            content[k, v] = value
        for v in range(packed.shape[1]):
            content[k, d + v] = packed[k, v]
    rows = np.arange(n).astype(np.int32)
    gap = n // 2  # Shell's sort: halves the gap each time
    while gap > 0:
        for k in range(gap, n):
            row, at = rows[k], k
            while at >= gap and _precedes(content, row, rows[at - gap]):
                rows[at] = rows[at - gap]
                at -= gap
            rows[at] = row
        gap //= 2
    single = True
    for k in range(1, n):
        single = single and _precedes(content, rows[k - 1], rows[k])
    return Side(content[rows], np.empty((0, 4)), rows), single


@part
def _precedes(content: FloatArray, a: int, b: int) -> bool:
    """Whether row a comes before row b: by the first column in which they differ."""
    for v in range(content.shape[1]):
        if content[a, v] != content[b, v]:
            return content[a, v] < content[b, v]
    return False

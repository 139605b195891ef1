"""Compiled order of the records of one source: by zone, then x, then the rest of what they say."""

from __future__ import annotations

import math

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def sort_keys(features, axis_x, axis_y, cuts, row_bits, bin_bits, keys, starts):
    """Fill ``keys`` with zone | bin of x | row, and ``starts`` with the CSR of the zones.

    cuts : (low, height, count) of the zones and (low, extent) of x.
    """
    low, height, count, x_low, x_extent = cuts[0], cuts[1], cuts[2], cuts[3], cuts[4]
    bins = 2.0**bin_bits - 1.0
    scale = bins / x_extent
    for k in range(len(keys)):
        zone = int(min(max(math.floor((features[k, axis_y] - low) / height), 0.0), count - 1.0))
        bin_ = np.uint64(min((features[k, axis_x] - x_low) * scale, bins))
        keys[k] = (np.uint64(zone) << np.uint64(bin_bits + row_bits)) | (bin_ << np.uint64(row_bits)) | np.uint64(k)
        starts[zone + 1] += 1
    for zone in range(len(starts) - 1):
        starts[zone + 1] += starts[zone]


@njit(cache=True, nogil=True)
def sort_by_bits(keys, low_bit, high_bit):
    """The keys sorted by their bits low_bit … high_bit − 1, eleven at a time, stable."""
    n = len(keys)
    here = keys
    there = np.empty(n, np.uint64)
    count = np.empty(2048, np.int64)
    bit = low_bit
    while bit < high_bit:
        width = min(11, high_bit - bit)
        shift = np.uint64(bit)
        mask = np.uint64((1 << width) - 1)
        count[:] = 0
        for k in range(n):
            count[np.int64((here[k] >> shift) & mask)] += 1
        total = 0
        for digit in range(1 << width):
            total += count[digit]
            count[digit] = total - count[digit]
        for k in range(n):
            digit = np.int64((here[k] >> shift) & mask)
            there[count[digit]] = here[k]
            count[digit] += 1
        here, there = there, here
        bit += width
    return here


@njit(cache=True, nogil=True)
def gather(order, features, covariance, reach, rows, features_out, covariance_out, reach_out, rows_out):
    """The columns of one side in the given order."""
    for k in range(len(order)):
        row = order[k]
        for v in range(features.shape[1]):
            features_out[k, v] = features[row, v]
        for v in range(covariance.shape[1]):
            covariance_out[k, v] = covariance[row, v]
        for v in range(reach.shape[1]):
            reach_out[k, v] = reach[row, v]
        rows_out[k] = rows[row]


@njit(cache=True, nogil=True)
def sort_within_bins(order, row_bits, keys, features, covariance, axis_x, rank):
    """Fill ``order`` with the rows of the sorted ``keys``; those that share a bin by content, then by rank.

    Returns 0 when that settled the order, 1 where two rows are equal and ``rank`` is empty, 2 where a bin holds more
    than 256 rows.
    """
    n = len(order)
    row_mask = (np.uint64(1) << np.uint64(row_bits)) - np.uint64(1)
    key_shift = np.uint64(row_bits)
    for k in range(n):
        order[k] = np.int64(keys[k] & row_mask)
    start = 0
    while start < n:
        stop = start + 1
        bin_ = keys[start] >> key_shift
        while stop < n and keys[stop] >> key_shift == bin_:
            stop += 1
        if stop - start > 256:
            return 2
        for k in range(start + 1, stop):
            row = order[k]
            t = k - 1
            while t >= start:
                before = precedes(features, covariance, axis_x, order[t], row)
                if before == 0:
                    if len(rank) == 0:
                        order[t + 1] = row
                        return 1
                    before = 1 if rank[order[t]] < rank[row] else -1
                if before > 0:
                    break
                order[t + 1] = order[t]
                t -= 1
            order[t + 1] = row
        start = stop
    return 0


@njit(cache=True, nogil=True)
def precedes(features, covariance, axis_x, a, b):
    """1 where row a comes before row b by content, x first; −1 where after, 0 where both say the same."""
    if features[a, axis_x] != features[b, axis_x]:
        return 1 if features[a, axis_x] < features[b, axis_x] else -1
    for v in range(features.shape[1]):
        if features[a, v] != features[b, v]:
            return 1 if features[a, v] < features[b, v] else -1
    for v in range(covariance.shape[1]):
        if covariance[a, v] != covariance[b, v]:
            return 1 if covariance[a, v] < covariance[b, v] else -1
    return 0

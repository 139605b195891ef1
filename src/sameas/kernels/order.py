"""Compiled order of the records of one source: by zone, then x, then the rest of what they say.

The records are first written out as whole rows, so that taking them in their order touches each of them once.
"""

from __future__ import annotations

import math

import numpy as np

from sameas.kernels.compiled import kernel, part


@kernel
def extent(features):
    """(2, d) the least and the greatest value of every feature."""
    ends = np.empty((2, features.shape[1]))
    for v in range(features.shape[1]):
        low = high = features[0, v]
        for k in range(1, len(features)):
            low = min(low, features[k, v])
            high = max(high, features[k, v])
        ends[0, v] = low
        ends[1, v] = high
    return ends


@kernel
def write_rows(features, covariance, axis_x, axis_y, cuts, row_bits, bin_bits, keys, content, starts):
    """Fill ``content`` with features and covariance, ``keys`` with zone | bin of x | row, ``starts`` with zones' CSR.

    cuts : (low, height, count) of the zones and (low, extent) of x.
    """
    low, height, count, x_low, x_extent = cuts[0], cuts[1], cuts[2], cuts[3], cuts[4]
    bins = 2.0**bin_bits - 1.0
    scale = bins / x_extent
    d = features.shape[1]
    for k in range(len(keys)):
        for v in range(d):
            content[k, v] = features[k, v]
        for v in range(covariance.shape[1]):
            content[k, d + v] = covariance[k, v]
        zone = int(min(max(math.floor((features[k, axis_y] - low) / height), 0.0), count - 1.0))
        bin_ = np.uint64(min((features[k, axis_x] - x_low) * scale, bins))
        keys[k] = (np.uint64(zone) << np.uint64(bin_bits + row_bits)) | (bin_ << np.uint64(row_bits)) | np.uint64(k)
        starts[zone + 1] += 1
    for zone in range(len(starts) - 1):
        starts[zone + 1] += starts[zone]


@kernel
def sort_by_bits(keys, low_bit, high_bit):
    """The keys sorted by their bits low_bit … high_bit − 1, eleven at a time, stable."""
    here = keys
    there = np.empty_like(keys)
    count = np.empty(2048, np.int64)
    bit = low_bit
    while bit < high_bit:
        width = min(11, high_bit - bit)
        shift = np.uint64(bit)
        mask = np.uint64((1 << width) - 1)
        count[:] = 0
        for k in range(len(keys)):
            count[np.int64((here[k] >> shift) & mask)] += 1
        total = 0
        for digit in range(1 << width):
            total += count[digit]
            count[digit] = total - count[digit]
        for k in range(len(keys)):
            digit = np.int64((here[k] >> shift) & mask)
            there[count[digit]] = here[k]
            count[digit] += 1
        here, there = there, here
        bit += width
    return here


@kernel
def sort_within_bins(order, row_bits, keys, content, axis_x, rank):
    """Fill ``order`` with the rows of the sorted ``keys``; those that share a bin by content, then by rank.

    Returns 0 when that settled the order, 1 where two rows are equal and ``rank`` is empty, 2 where a bin holds more
    than 256 rows.
    """
    n = len(order)
    row_mask = (np.uint64(1) << np.uint64(row_bits)) - np.uint64(1)
    key_shift = np.uint64(row_bits)
    for k in range(n):
        order[k] = np.int32(keys[k] & row_mask)
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
                before = precedes(content, axis_x, order[t], row)
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


@part
def precedes(content, axis_x, a, b):
    """1 where row a comes before row b by content, x first; −1 where after, 0 where both say the same."""
    if content[a, axis_x] != content[b, axis_x]:
        return 1 if content[a, axis_x] < content[b, axis_x] else -1
    for v in range(content.shape[1]):
        if content[a, v] != content[b, v]:
            return 1 if content[a, v] < content[b, v] else -1
    return 0


@kernel
def take_rows(order, written, d, turning, axis_x, axis_y, opening, content, guard):
    """Fill ``content`` with the rows in their order, and ``guard`` (n, 4) with what tells most pairs apart.

    The guard holds x, y, and how far the record's own error opens the gate, squared: ``opening`` times the variance in
    x and in y; where the axes are ``turning`` (on the sphere) the cosine of y and, times the largest variance in any
    direction, the opening.
    """
    for start in range(0, len(order), 64):
        stop = min(start + 64, len(order))
        copy_rows(order, written, content, start, stop)
        for k in range(start, stop):
            guard[k, 0] = content[k, axis_x]
            guard[k, 1] = content[k, axis_y]
            if turning:
                guard[k, 2] = sine(90.0 - abs(content[k, 1]))
                guard[k, 3] = opening * widest(content, k)
            else:
                guard[k, 2] = opening * content[k, d + diagonal(written.shape[1] - d, d, axis_x)]
                guard[k, 3] = opening * content[k, d + diagonal(written.shape[1] - d, d, axis_y)]


@part
def copy_rows(order, written, content, start, stop):
    """Rows ``order[k]`` to the places start ≤ k < stop, so bare that the memory is asked for many of them at once."""
    width = written.shape[1]
    if width == 3:
        for k in range(start, stop):
            row = order[k]
            content[k, 0], content[k, 1], content[k, 2] = written[row, 0], written[row, 1], written[row, 2]
    else:
        for k in range(start, stop):
            row = order[k]
            for v in range(width):
                content[k, v] = written[row, v]


@part
def sine(degrees):
    """The sine of 0 … 90°, by its series: the library's takes as long as the rest of the loop."""
    x = degrees * (math.pi / 180.0)
    z = x * x
    total = 1.0 / 51090942171709440000.0
    total = 1.0 / 121645100408832000.0 - z * total
    total = 1.0 / 355687428096000.0 - z * total
    total = 1.0 / 1307674368000.0 - z * total
    total = 1.0 / 6227020800.0 - z * total
    total = 1.0 / 39916800.0 - z * total
    total = 1.0 / 362880.0 - z * total
    total = 1.0 / 5040.0 - z * total
    total = 1.0 / 120.0 - z * total
    total = 1.0 / 6.0 - z * total
    return x - x * z * total


@part
def diagonal(p, d, axis):
    """Where a packed covariance of p numbers keeps the variance of a feature."""
    if p <= d:
        return axis if p == d else 0
    return axis * d - axis * (axis - 1) // 2


@part
def widest(content, k):
    """The largest variance of a direction's two in any direction."""
    p = content.shape[1] - 2
    if p == 1:
        return content[k, 2]
    if p == 2:
        return max(content[k, 2], content[k, 3])
    half = 0.5 * (content[k, 2] - content[k, 4])
    return 0.5 * (content[k, 2] + content[k, 4]) + math.sqrt(half * half + content[k, 3] * content[k, 3])

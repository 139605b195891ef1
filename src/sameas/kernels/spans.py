"""Compiled look-up of the stretches of source 2 in which the candidates of a record of source 1 may lie.

Both sources are sorted by (zone, x). A record of zone z can only have candidates in the zones z − 1, z, z + 1, and
there only within the zone's window of x. Every zone of source 2 is cut into cells of x, as many as it has records; the
cells' starts give the ends of a stretch at once, and a search among its records where many share a cell.
"""

from __future__ import annotations

from collections import namedtuple

import numpy as np

from sameas.kernels.compiled import kernel, part

#: A source in its order: content (n, d + p), guard (n, 4; see ``order.take_rows``), rows (n,), zones (CSR starts).
Side = namedtuple("Side", "content guard rows zones")

#: The cells of source 2: the first cell of every zone (CSR), the first record of every cell, and x of its first edge.
Cells = namedtuple("Cells", "zones starts low scale")

#: Stretches that one record may need: three zones, each cut in three where its window crosses the period.
MOST = 9
#: Where the cells of a stretch hold more records than this each, it is cut to the window itself.
CROWDED = 4


@kernel
def cells_of(side, low, extent, zones, starts, scale):
    """Fill zones (z+1,), starts (cells + 1,) and scale (z,) of :data:`Cells`: cells as records in a zone, and one."""
    n_zones = len(side.zones) - 1
    zones[0] = 0
    cell = 0
    for z in range(n_zones):
        count = side.zones[z + 1] - side.zones[z] + 1
        zones[z + 1] = zones[z] + count
        scale[z] = count / extent
        for q in range(side.zones[z], side.zones[z + 1]):
            here = zones[z] + cell_at(side.guard[q, 0], low, scale[z], count)
            while cell <= here:
                starts[cell] = q
                cell += 1
        while cell < zones[z + 1]:
            starts[cell] = side.zones[z + 1]
            cell += 1
    starts[cell] = side.zones[n_zones]


@part
def cell_at(x, low, scale, count):
    """The cell of a zone in which x lies; beyond the first and the last, those."""
    return np.int64(min(max((x - low) * scale, 0.0), count - 1.0))


@part
def zone_of(zones, k):
    """The zone that record k belongs to."""
    low, high = 0, len(zones) - 1
    while high - low > 1:
        middle = (low + high) // 2
        if zones[middle] <= k:
            low = middle
        else:
            high = middle
    return low


@part
def first_from(guard, start, stop, x):
    """The first of the records start … stop − 1 of a zone that does not lie before x, or stop."""
    while start < stop:
        middle = (start + stop) // 2
        if guard[middle, 0] < x:
            start = middle + 1
        else:
            stop = middle
    return start


@part
def stretches(one, two, cells, windows, period, wraps, k, last, record, low, high):
    """Fill ``record``, ``low``, ``high`` with stretches low ≤ q < high for the records k … last − 1, as many as fit.

    Returns (stretches, next k).
    """
    n_zones = len(one.zones) - 1
    count = np.int64(0)
    zone = zone_of(one.zones, k)
    while k < last and count + MOST <= len(record):
        while k >= one.zones[zone + 1]:
            zone += 1
        window = windows[zone]
        x = one.guard[k, 0]
        everything = 2.0 * window >= period
        crosses = (not everything) and (x + window >= period or x < window) and period < np.inf
        for t in range(-1, 2):
            other = zone + t
            if wraps:
                if n_zones == 1 and t != 0:
                    continue
                other %= n_zones
            if other < 0 or other >= n_zones:
                continue
            stop = two.zones[other + 1]
            if everything:
                record[count], low[count], high[count] = k, two.zones[other], stop
                count += two.zones[other] < stop
                continue
            first, number = cells.zones[other], cells.zones[other + 1] - cells.zones[other]
            left = cell_at(x - window, cells.low, cells.scale[other], number)
            right = cell_at(x + window, cells.low, cells.scale[other], number) + 1
            p, q = cells.starts[first + left], cells.starts[first + right]
            if q - p > CROWDED * (right - left):
                p = first_from(two.guard, p, q, x - window)
                q = first_from(two.guard, p, q, np.nextafter(x + window, np.inf))
            record[count], low[count], high[count] = k, p, q
            count += p < q
            if crosses:
                # What the window reaches across the period at either end.
                start = two.zones[other]
                q = first_from(two.guard, start, stop, np.nextafter(x + window - period, np.inf))
                record[count], low[count], high[count] = k, start, q
                count += start < q
                p = first_from(two.guard, max(start, q), stop, x - window + period)
                record[count], low[count], high[count] = k, p, stop
                count += p < stop
        k += 1
    return count, k


@part
def taken_back(place1, count, k):
    """The number of candidates before those of record k, which are the last ones."""
    while count > 0 and place1[count - 1] == k:
        count -= 1
    return count

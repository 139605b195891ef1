"""Compiled cells, nested cells and densities, for the coverage of sources and their local densities."""

from __future__ import annotations

import math

import numpy as np

from sameas.arrays import AnyIntArray, BoolArray, FloatArray, Int32Array, IntArray
from sameas.kernels.compiled import part, small
from sameas.kernels.search import ARCSEC

# Cells of a space: the cells of records, and their sizes.


@small
def rings(low: float, high: float, arc: float, size: float) -> tuple[IntArray, FloatArray]:
    """Rings of equal height in latitude from ``low`` to ``high``, degrees, divided into nearly square cells of
    ``size``, arcsec², along an ``arc`` of longitude.

    Returns (r + 1,) the number of the first cell of each ring and the number of all cells, and (r,) the size of each
    ring's cells.
    """
    number = max(1, int(np.ceil((high - low) * 3600.0 / np.sqrt(size))))
    begin, volume = np.zeros(number + 1, np.int64), np.empty(number)
    height, below = (high - low) / number, math.sin(np.radians(low))
    for r in range(number):
        above = math.sin(np.radians(low + height * (r + 1)))
        area = np.radians(arc) * (above - below) * (ARCSEC * ARCSEC)
        pieces = max(1, int(np.round(area / size)))
        begin[r + 1], volume[r], below = begin[r] + pieces, area / pieces, above
    return begin, volume


@small
def sphere_cells(
    features: FloatArray, low: float, high: float, west: float, arc: float, begin: IntArray, cell: IntArray
) -> None:
    """Write to ``cell`` (n,) the cells of directions (n, 2), degrees, in :func:`rings` that begin at ``west``."""
    number = len(begin) - 1
    height = (high - low) / number
    for k in range(len(cell)):
        ring = min(max(int((features[k, 1] - low) / height), 0), number - 1)
        turn, pieces = features[k, 0] - west, begin[ring + 1] - begin[ring]
        fraction = (turn - 360.0 * np.floor(turn / 360.0)) / arc
        cell[k] = begin[ring] + min(int(fraction * pieces), pieces - 1)


@small
def box_cells(features: FloatArray, low: FloatArray, extent: FloatArray, cuts: int, cell: IntArray) -> None:
    """Write to ``cell`` (n,) the cells of points (n, d) in a box that is divided into ``cuts`` along every feature."""
    for k in range(len(cell)):
        number = 0
        for v in range(features.shape[1]):
            along = int((features[k, v] - low[v]) / extent[v] * cuts)
            number = number * cuts + min(max(along, 0), cuts - 1)
        cell[k] = number


@small
def renumber(one: IntArray, two: IntArray, total: int, of_first: Int32Array, of_second: Int32Array) -> IntArray:
    """Write to ``of_first`` and ``of_second`` the ranks of the cells ``one`` and ``two``, of ``total``, among all that
    occur; returns the cells that occur, ascending.
    """
    number, occupied = np.zeros(total, np.int32), 0
    for cells in (one, two):
        for c in cells:
            number[c] = 1
    for c in range(total):
        if number[c]:
            number[c] = occupied
            occupied += 1
    for cells, out in ((one, of_first), (two, of_second)):
        for k in range(len(cells)):
            out[k] = number[cells[k]]
    known = np.empty(occupied, np.int64)
    for cells, out in ((one, of_first), (two, of_second)):
        for k in range(len(cells)):
            known[out[k]] = cells[k]
    return known


@small
def cell_sizes(known: IntArray, begin: IntArray, volume: FloatArray) -> FloatArray:
    """(c,) sizes of the cells ``known``, ascending, of rings of first cells ``begin`` and cell sizes ``volume``."""
    out, ring = np.empty(len(known)), 0
    for k in range(len(known)):
        while begin[ring + 1] <= known[k]:
            ring += 1
        out[k] = volume[ring]
    return out


# Counts of cells: local densities and shares, refined from coarse to fine cells.


@small
def check_cells(
    cell: Int32Array, volume: FloatArray, count: FloatArray, own_count: FloatArray, pseudo_count: float, hole: float,
    own_in_empty: FloatArray, density: FloatArray, highest: FloatArray,
) -> float:  # fmt: skip
    """Test whether the other source observes around each record, by one size of cells.

    Raises ``own_in_empty`` (n,) to the number of records in a record's cell, including itself, if the other source has
    none there although at least ``hole`` are expected; refines the ``density`` (n,) of the other source by the cell's
    count.

    cell : (n,) of the records. volume : of the cells. count, own_count : records of the other source and of this one in
    each. highest : (n,) highest densities so far, at least half of which is expected: coarse cells just outside a
    border are mostly empty, and their own density is too low.

    Returns the excess of records in empty cells over chance, in standard deviations.
    """
    empty, by_chance, variance, never = 0.0, 0.0, 1.0, 20.0
    for k in range(len(cell)):
        c = cell[k]
        expected = density[k] * volume[c]
        chance = math.exp(-expected) if expected < never else 0.0
        empty += count[c] == 0.0
        by_chance += chance
        variance += chance * (1.0 - chance) * own_count[c]  # the records of a cell are not independent
        if count[c] == 0.0 and max(density[k], 0.5 * highest[k]) * volume[c] >= hole:
            own_in_empty[k] = max(own_in_empty[k], own_count[c])
        highest[k] = max(highest[k], density[k])
        density[k] = (count[c] + pseudo_count) / (volume[c] + pseudo_count / density[k])
    return (empty - by_chance) / np.sqrt(variance)


@small
def shared_part(
    of_first: Int32Array, seen_1: BoolArray, of_second: Int32Array, seen_2: BoolArray, count: FloatArray
) -> FloatArray:
    """(c,) part of each cell that both sources observe.

    A part a of the cell is observed by both sources, b by the first alone, c by the second alone, a + b + c = 1. The
    covered part of the first's records is f = a/(a + b), of the second's g = a/(a + c), so a = 1/(1/f + 1/g − 1). For a
    source without records in a cell, the part is taken as 1. count : (c, 4) zeros, scratch.
    """
    for k in range(len(of_first)):
        count[of_first[k], 0] += 1.0
        count[of_first[k], 1] += seen_1[k]
    for k in range(len(of_second)):
        count[of_second[k], 2] += 1.0
        count[of_second[k], 3] += seen_2[k]
    share = np.empty(len(count))
    for c in range(len(count)):
        one = count[c, 0] / count[c, 1] if count[c, 0] > 0.0 else 1.0
        two = count[c, 2] / count[c, 3] if count[c, 2] > 0.0 else 1.0
        share[c] = 1.0 / (one + two - 1.0)
    return share


@small
def refine(
    own: Int32Array, other: Int32Array, weight: FloatArray, volume: FloatArray, count: FloatArray, pseudo_count: float,
    at_own: FloatArray, at_other: FloatArray,
) -> None:  # fmt: skip
    """Refine densities in place by the count of each record's cell: ``at_own`` (n,) and ``at_other`` (n',).

    own, weight : (n,) cells of the counted records, and the part of each that is not counted at its own position.
    other : (n',) cells of the other records. volume, count : of the cells.
    """
    for k in range(len(own)):
        c = own[k]
        others = max(count[c] - weight[k], 0.0)
        at_own[k] = (others + pseudo_count) / (volume[c] + pseudo_count / at_own[k])
    for k in range(len(other)):
        c = other[k]
        at_other[k] = (count[c] + pseudo_count) / (volume[c] + pseudo_count / at_other[k])


@small
def refine_share(
    own: Int32Array, other: Int32Array, part: FloatArray, weight: FloatArray, parts: FloatArray, weights: FloatArray,
    pseudo_count: float, at_own: FloatArray, at_other: FloatArray,
) -> None:  # fmt: skip
    """Refine shares in place by Σ part / Σ weight of each record's cell: ``at_own`` (n,) and ``at_other`` (n',).

    own, part, weight : (n,) cells of the counted records and their contributions; a record's own is not counted at its
    position. other : (n',) cells of the other records. parts, weights : scratch for the sums of the cells.
    pseudo_count : for a share of ½; for others the number with the same information on the logit of the share.
    """
    parts[:] = 0.0
    weights[:] = 0.0
    for k in range(len(own)):
        parts[own[k]] += part[k]
        weights[own[k]] += weight[k]
    for k in range(len(own)):
        c = own[k]
        others_part, others = max(parts[c] - part[k], 0.0), max(weights[c] - weight[k], 0.0)
        pseudo = 0.25 * pseudo_count / (at_own[k] * (1.0 - at_own[k]))
        at_own[k] = (others_part + pseudo * at_own[k]) / (others + pseudo)
    for k in range(len(other)):
        c = other[k]
        pseudo = 0.25 * pseudo_count / (at_other[k] * (1.0 - at_other[k]))
        at_other[k] = (parts[c] + pseudo * at_other[k]) / (weights[c] + pseudo)


# The same of nested cells: four cells make one of the next size, cell ``c`` is in cell ``c >> 2``.
#
# Cells of any size are runs of the occupied finest cells, which ascend. Each size takes one pass over the finest cells
# and no further memory.


@part
def run_end(cells: IntArray, begin: int, shift: int) -> int:
    """End of the run of finest cells that are in the same cell, ``shift`` bits coarser, as that at ``begin``."""
    own, end = cells[begin] >> shift, begin + 1
    while end < len(cells) and cells[end] >> shift == own:
        end += 1
    return end


@part
def effective_cells(records: float, sharing: float, most: float, partly: float) -> float:
    """Number of cells over which records are scattered, from the number of pairs that share a cell: ``most``, unless
    there are more such pairs than by chance by over ``partly`` standard deviations."""
    expected = records * records / most
    if sharing > expected + partly * math.sqrt(2.0 * expected) + 1.0:
        return max(records * records / max(sharing, 1.0), 1.0)
    return most


@part
def covered_part(numbers: AnyIntArray, begin: int, end: int, most: float, partly: float) -> tuple[float, float, float]:
    """Records of both sources in a run of the finest cells, and how many of its ``most`` cells are within the field.

    A cell may extend beyond the border of the field or into holes. N records scattered over K of the finest cells have
    N²/K pairs in the same cell on average, which gives K. It is taken from the source with more records there.
    """
    one = two = sharing_1 = sharing_2 = 0.0
    for k in range(begin, end):
        n_1, n_2 = float(numbers[k, 0]), float(numbers[k, 1])
        one += n_1
        two += n_2
        sharing_1 += n_1 * (n_1 - 1.0)
        sharing_2 += n_2 * (n_2 - 1.0)
    if one > two:
        return one, two, effective_cells(one, sharing_1, most, partly)
    if two > one:
        return one, two, effective_cells(two, sharing_2, most, partly)
    both = effective_cells(one, sharing_1, most, partly) + effective_cells(two, sharing_2, most, partly)
    return one, two, 0.5 * both


@small
def covered_cells(
    cells: IntArray, numbers: AnyIntArray, shift: int, partly: float, own: IntArray, out: FloatArray
) -> int:
    """Write the cells ``shift`` bits coarser to ``own`` (u,), and the number of their finest cells within the field to
    ``out`` (u,); returns the number of coarser cells.

    cells : (u,) the occupied finest cells, ascending. numbers : (u, 2) records of either source. partly : see
    :func:`effective_cells`.
    """
    begin, found = 0, 0
    while begin < len(cells):
        end = run_end(cells, begin, shift)
        own[found] = cells[begin] >> shift
        _, _, out[found] = covered_part(numbers, begin, end, 2.0**shift, partly)
        begin, found = end, found + 1
    return found


@small
def check_cells_nested(
    cells: IntArray, numbers: AnyIntArray, shift: int, partly: float, volume: float, least: FloatArray, hole: float,
    pseudo_count: float, density: FloatArray, highest: FloatArray, observed: BoolArray,
) -> None:  # fmt: skip
    """Clear ``observed`` (u, 2) where the other source does not observe, by the cells ``shift`` bits coarser, and
    refine the ``density`` (u, 2) of the other source by their counts, as :func:`check_cells` does.

    volume : of a finest cell. least : (2,) least records of a source in a cell that may be a hole of the other. hole :
    least expected records of the other in it. highest : (u, 2) highest densities so far.
    """
    begin = 0
    while begin < len(cells):
        end = run_end(cells, begin, shift)
        one, two, covered = covered_part(numbers, begin, end, 2.0**shift, partly)
        size = volume * covered
        for s in range(2):
            count, other = (one, two) if s == 0 else (two, one)
            for k in range(begin, end):
                if other == 0.0 and count >= least[s] and max(density[k, s], 0.5 * highest[k, s]) * size >= hole:
                    observed[k, s] = False
                highest[k, s] = max(highest[k, s], density[k, s])
                density[k, s] = (other + pseudo_count) / (size + pseudo_count / density[k, s])
        begin = end


@small
def score_nested(
    cells: IntArray, numbers: AnyIntArray, shift: int, partly: float, volume: float, used_share: float,
    smooths: FloatArray, own: FloatArray, score: FloatArray,
) -> None:  # fmt: skip
    """Add to ``score`` (2, m) the log likelihood of pseudo-counts ``smooths`` (m,) for the positions of both sources'
    records, by the other records in their cells ``shift`` bits coarser; to ``score[:, m]`` the squares of the cells'
    counts.

    volume : of a finest cell. used_share : of the finest cells, selected by their cell numbers alone.
    own : (u, 2) densities by coarser cells.
    """
    begin, m = 0, len(smooths)
    while begin < len(cells):
        end = run_end(cells, begin, shift)
        one, two, covered = covered_part(numbers, begin, end, 2.0**shift, partly)
        size = volume * covered
        score[0, m] += one * one
        score[1, m] += two * two
        for k in range(begin, end):
            # Multiples of the golden ratio spread consecutive numbers evenly over 0 … 1.
            multiple = (cells[k] & 0xFFFFFFFF) * 0.6180339887498949
            if multiple - math.floor(multiple) >= used_share:
                continue
            for s in range(2):
                if numbers[k, s]:
                    left = max((one if s == 0 else two) - 1.0, 0.0)
                    for c in range(m):
                        density = (left + smooths[c]) / (size + smooths[c] / own[k, s])
                        score[s, c] += numbers[k, s] * math.log(density)
        begin = end


@small
def refine_nested(
    cells: IntArray, numbers: AnyIntArray, shift: int, partly: float, volume: float, smooth: FloatArray,
    left_out: FloatArray, open_: BoolArray, own: FloatArray, others: FloatArray,
) -> None:  # fmt: skip
    """Refine densities in place by the counts of cells ``shift`` bits coarser: ``own`` (u, 2) at the records of the
    source itself, ``others`` (u, 2) at those of the other source.

    volume : of a finest cell. smooth, left_out : (2,) pseudo-counts of the sources, and the part of a record that is
    not counted at its own position. open_ : (2,) whether a source is still refined.
    """
    begin = 0
    while begin < len(cells):
        end = run_end(cells, begin, shift)
        one, two, covered = covered_part(numbers, begin, end, 2.0**shift, partly)
        size = volume * covered
        for s in range(2):
            if not open_[s]:
                continue
            count = one if s == 0 else two
            left = max(count - left_out[s], 0.0)
            for k in range(begin, end):
                own[k, s] = (left + smooth[s]) / (size + smooth[s] / own[k, s])
                others[k, s] = (count + smooth[s]) / (size + smooth[s] / others[k, s])
        begin = end


@small
def refine_share_nested(
    cells: IntArray, known: IntArray, parts: FloatArray, weights: FloatArray, shift: int, pseudo_count: float,
    share: FloatArray,
) -> None:  # fmt: skip
    """Refine shares (u,) in place by ``parts``/``weights`` (c,) of the coarser cells ``known`` (c,), ascending; in
    other cells they do not change. pseudo_count : see :func:`refine_share`."""
    at = 0
    for k in range(len(cells)):
        own = cells[k] >> shift
        while at < len(known) and known[at] < own:
            at += 1
        if at < len(known) and known[at] == own:
            pseudo = 0.25 * pseudo_count / (share[k] * (1.0 - share[k]))
            share[k] = (parts[at] + pseudo * share[k]) / (weights[at] + pseudo)

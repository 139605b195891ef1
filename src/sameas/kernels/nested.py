"""Compiled sums over nested cells: four cells make one of the next size, cell ``c`` is in cell ``c >> 2``.

Cells of any size are runs of the occupied finest cells, which ascend. Each size takes one pass over the finest cells
and no further memory.
"""

from __future__ import annotations

import math

from sameas.arrays import AnyIntArray, BoolArray, FloatArray, IntArray
from sameas.kernels.compiled import part, small


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
def look_nested(
    cells: IntArray,
    numbers: AnyIntArray,
    shift: int,
    partly: float,
    volume: float,
    least: FloatArray,
    hole: float,
    pseudo_count: float,
    density: FloatArray,
    highest: FloatArray,
    observed: BoolArray,
) -> None:
    """Clear ``observed`` (u, 2) where the other source does not observe, by the cells ``shift`` bits coarser, and
    refine the ``density`` (u, 2) of the other source by their counts, as ``coverage.look`` does.

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
    cells: IntArray,
    numbers: AnyIntArray,
    shift: int,
    partly: float,
    volume: float,
    used_share: float,
    smooths: FloatArray,
    own: FloatArray,
    score: FloatArray,
) -> None:
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
    cells: IntArray,
    numbers: AnyIntArray,
    shift: int,
    partly: float,
    volume: float,
    smooth: FloatArray,
    left_out: FloatArray,
    open_: BoolArray,
    own: FloatArray,
    others: FloatArray,
) -> None:
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
    cells: IntArray,
    known: IntArray,
    parts: FloatArray,
    weights: FloatArray,
    shift: int,
    pseudo_count: float,
    share: FloatArray,
) -> None:
    """Refine shares (u,) in place by ``parts``/``weights`` (c,) of the coarser cells ``known`` (c,), ascending; in
    other cells they do not change. pseudo_count : see ``coverage.refine_share``."""
    at = 0
    for k in range(len(cells)):
        own = cells[k] >> shift
        while at < len(known) and known[at] < own:
            at += 1
        if at < len(known) and known[at] == own:
            pseudo = 0.25 * pseudo_count / (share[k] * (1.0 - share[k]))
            share[k] = (parts[at] + pseudo * share[k]) / (weights[at] + pseudo)

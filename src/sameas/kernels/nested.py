"""Compiled sums over nested cells: four of one size make one of the next, cell ``c`` lies in ``c >> 2``.

Cells of a size are runs of the occupied finest ones, which rise: every level is one pass over these, in which nothing
is kept but where its run ends.
"""

from __future__ import annotations

import math

from sameas.arrays import AnyIntArray, BoolArray, FloatArray, IntArray
from sameas.kernels.compiled import part, small


@part
def run_end(cells: IntArray, begin: int, shift: int) -> int:
    """Where the finest cells end that lie with the one at ``begin`` in a cell ``shift`` bits coarser."""
    own, end = cells[begin] >> shift, begin + 1
    while end < len(cells) and cells[end] >> shift == own:
        end += 1
    return end


@part
def strewn_over(records: float, sharing: float, most: float, partly: float) -> float:
    """Over how many cells records are strewn of which so many pairs share theirs: all of ``most``, unless these are by
    more than ``partly`` standard deviations too many for chance."""
    due = records * records / most
    if sharing > due + partly * math.sqrt(2.0 * due) + 1.0:
        return max(records * records / max(sharing, 1.0), 1.0)
    return most


@part
def covered_part(numbers: AnyIntArray, begin: int, end: int, most: float, partly: float) -> tuple[float, float, float]:
    """Records of both sources in a run of the finest cells, and how many of ``most`` of these lie within the field.

    Cells reach beyond the border of a field, and into holes: of N records that are strewn over K of the finest cells
    N²/K pairs share theirs on average, from which K follows. The source that has more records there tells.
    """
    one = two = sharing_1 = sharing_2 = 0.0
    for k in range(begin, end):
        n_1, n_2 = float(numbers[k, 0]), float(numbers[k, 1])
        one += n_1
        two += n_2
        sharing_1 += n_1 * (n_1 - 1.0)
        sharing_2 += n_2 * (n_2 - 1.0)
    if one > two:
        return one, two, strewn_over(one, sharing_1, most, partly)
    if two > one:
        return one, two, strewn_over(two, sharing_2, most, partly)
    both = strewn_over(one, sharing_1, most, partly) + strewn_over(two, sharing_2, most, partly)
    return one, two, 0.5 * both


@small
def covered_cells(
    cells: IntArray, numbers: AnyIntArray, shift: int, partly: float, own: IntArray, out: FloatArray
) -> int:
    """Write the cells ``shift`` bits coarser into ``own`` (u,), and how many of the finest cells of each lie within the
    field into ``out`` (u,); returns how many there are.

    cells : (u,) the occupied finest cells, rising. numbers : (u, 2) records of either source. partly : see
    :func:`covered_part`.
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
    seen: BoolArray,
) -> None:
    """Clear ``seen`` (u, 2) where the other source does not look, by the cells ``shift`` bits coarser, and refine the
    ``density`` (u, 2) of the other source by their counts, as ``coverage.look`` does.

    volume : of a finest cell. least : (2,) records of a source that such a cell holds. hole : records of the other to
    be expected in it. highest : (u, 2) of the densities so far.
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
                    seen[k, s] = False
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
    asked: float,
    smooths: FloatArray,
    own: FloatArray,
    score: FloatArray,
) -> None:
    """Add to ``score`` (2, m) ln of how probable pseudo-counts ``smooths`` (m,) make the places of both sources'
    records, by the others in their cells ``shift`` bits coarser; to ``score[:, m]`` squares of the cells' numbers.

    volume : of a finest cell. asked : the part of the finest cells that are asked; which ones depends on their numbers
    alone. own : (u, 2) densities as coarser cells have them.
    """
    begin, m = 0, len(smooths)
    while begin < len(cells):
        end = run_end(cells, begin, shift)
        one, two, covered = covered_part(numbers, begin, end, 2.0**shift, partly)
        size = volume * covered
        score[0, m] += one * one
        score[1, m] += two * two
        for k in range(begin, end):
            # The golden ratio turns numbers that follow each other into ones that are spread evenly over 0 … 1.
            turned = (cells[k] & 0xFFFFFFFF) * 0.6180339887498949
            if turned - math.floor(turned) >= asked:
                continue
            for s in range(2):
                if numbers[k, s]:
                    left = max((one if s == 0 else two) - 1.0, 0.0)
                    for c in range(m):
                        due = (left + smooths[c]) / (size + smooths[c] / own[k, s])
                        score[s, c] += numbers[k, s] * math.log(due)
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
    """Draw densities, in place, towards the counts of cells ``shift`` bits coarser: ``own`` (u, 2) at the records of
    either source, ``others`` (u, 2) at those of the other.

    volume : of a finest cell. smooth, left_out : (2,) pseudo-counts of the sources, and how much of a record does not
    count at its own place. open_ : (2,) whether a source is refined still.
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
    """Draw shares (u,), in place, towards ``parts``/``weights`` (c,) of the coarser cells ``known`` (c,), rising; where
    none is known they stay. pseudo_count : see ``coverage.refine_share``."""
    at = 0
    for k in range(len(cells)):
        own = cells[k] >> shift
        while at < len(known) and known[at] < own:
            at += 1
        if at < len(known) and known[at] == own:
            pseudo = 0.25 * pseudo_count / (share[k] * (1.0 - share[k]))
            share[k] = (parts[at] + pseudo * share[k]) / (weights[at] + pseudo)

"""Compiled counts of cells, and what they say: local densities and shares, refined from cell to finer cell."""

from __future__ import annotations

import numpy as np

from sameas.kernels.compiled import kernel


@kernel
def look(of_source, cell, volume, count, company, least, pseudo_count, hole, seen, density, highest):
    """Clear ``seen`` (n,) where a record's cell is empty although more than ``hole`` were to be expected, and ``least``
    of those that are asked for lie in it; refine the ``density`` (n,) by its count, in place.

    of_source : (n',) cells of the records that are counted. cell : (n,) of those that are asked for. volume : of the
    cells. count, company : room for the counts of either. highest : (n,) of the densities so far, which is what is
    expected at least half of: just outside a border coarse cells are empty for the most part, and their own density
    says too little.

    Returns by how many standard deviations more records lie in empty cells than chance puts there.
    """
    count[:] = 0.0
    for c in of_source:
        count[c] += 1.0
    company[:] = 0.0
    for c in cell:
        company[c] += 1.0
    empty, due, variance, never = 0.0, 0.0, 1.0, 20.0
    for k in range(len(cell)):
        c = cell[k]
        expected = density[k] * volume[c]
        chance = np.exp(-expected) if expected < never else 0.0
        empty += count[c] == 0.0
        due += chance
        variance += chance * (1.0 - chance) * company[c]  # all of a cell together
        if count[c] == 0.0 and company[c] >= least and max(density[k], 0.5 * highest[k]) * volume[c] >= hole:
            seen[k] = False
        highest[k] = max(highest[k], density[k])
        density[k] = (count[c] + pseudo_count) / (volume[c] + pseudo_count / density[k])
    return (empty - due) / np.sqrt(variance)


@kernel
def shared_part(of_first, seen_1, of_second, seen_2, count):
    """(c,) part of each cell where both sources look.

    Of a cell, a part a is seen by both, b by the first alone, c by the second alone, a + b + c = 1; so the covered part
    of the first's records is f = a/(a + b), of the second's g = a/(a + c), and a = 1/(1/f + 1/g − 1). A source
    without records in a cell says nothing. count : (c, 4) zeros, room for the counts.
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


@kernel
def refine(own, other, weight, volume, count, pseudo_count, at_own, at_other):
    """Draw densities, in place, towards the counts of each record's cell: ``at_own`` (n,) and ``at_other`` (n',).

    own, weight : (n,) cells of the records that are counted, and as how many each; it is left out at itself. other :
    (n',) cells of the other records. volume : of the cells. count : room for their counts.
    """
    count[:] = 0.0
    for k in range(len(own)):
        count[own[k]] += weight[k]
    for k in range(len(own)):
        c = own[k]
        others = max(count[c] - weight[k], 0.0)
        at_own[k] = (others + pseudo_count) / (volume[c] + pseudo_count / at_own[k])
    for k in range(len(other)):
        c = other[k]
        at_other[k] = (count[c] + pseudo_count) / (volume[c] + pseudo_count / at_other[k])


@kernel
def refine_share(own, other, part, weight, parts, weights, pseudo_count, at_own, at_other):
    """Draw shares, in place, towards part/weight of each record's cell: ``at_own`` (n,) and ``at_other`` (n',).

    own, part, weight : (n,) cells of the records that are counted, and what of each counts; its own is left out at
    itself. other : (n',) cells of the other records. parts, weights : room for the sums of the cells.
    """
    parts[:] = 0.0
    weights[:] = 0.0
    for k in range(len(own)):
        parts[own[k]] += part[k]
        weights[own[k]] += weight[k]
    for k in range(len(own)):
        c = own[k]
        others_part, others = max(parts[c] - part[k], 0.0), max(weights[c] - weight[k], 0.0)
        at_own[k] = (others_part + pseudo_count * at_own[k]) / (others + pseudo_count)
    for k in range(len(other)):
        c = other[k]
        at_other[k] = (parts[c] + pseudo_count * at_other[k]) / (weights[c] + pseudo_count)

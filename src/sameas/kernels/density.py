"""Compiled refinement of a local density by the counts of finer cells."""

from __future__ import annotations

from sameas.kernels.compiled import kernel


@kernel
def refine(count, volume, cell, own, pseudo_count, density):
    """Draw ``density`` (n,), in place, towards the counts of each record's cell, its own weight left out.

    count, volume : per cell. cell : (n,) of each record. own : (n,) weights of the records, or empty.
    """
    for k in range(len(cell)):
        c = cell[k]
        others = count[c]
        if len(own):
            others = max(others - own[k], 0.0)
        density[k] = (others + pseudo_count) / (volume[c] + pseudo_count / density[k])


@kernel
def refine_share(part, count, cell, own_part, own_count, pseudo_count, share):
    """Draw ``share`` (n,), in place, towards part/count of each record's cell, its own part and count left out.

    part, count : per cell. own_part, own_count : (n,) of the records, or empty.
    """
    for k in range(len(cell)):
        c = cell[k]
        others_part = part[c]
        others_count = count[c]
        if len(own_part):
            others_part = max(others_part - own_part[k], 0.0)
            others_count = max(others_count - own_count[k], 0.0)
        share[k] = (others_part + pseudo_count * share[k]) / (others_count + pseudo_count)

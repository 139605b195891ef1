"""Compiled cells of the sky, and what their counts say: local densities and shares, refined from cell to finer cell."""

from __future__ import annotations

import numpy as np

from sameas.kernels.compiled import kernel


@kernel
def sphere_cells(features, low, height, west, arc, begin, per_ring, cell):
    """Fill ``cell`` (n,) with the cells of directions (n, 2), degrees.

    Rings lie from ``low`` on, ``height`` apart, each cut into ``per_ring`` (rings,) cells along ``arc`` from ``west``
    on, the first of them being ``begin`` (rings,).
    """
    rings = len(per_ring)
    for k in range(len(cell)):
        ring = min(max(int((features[k, 1] - low) / height), 0), rings - 1)
        turn = features[k, 0] - west
        along = (turn - 360.0 * np.floor(turn / 360.0)) / arc
        cell[k] = begin[ring] + min(int(along * per_ring[ring]), per_ring[ring] - 1)


@kernel
def look(count, volume, cell, pseudo_count, hole, seen, density, highest):
    """Clear ``seen`` (n,) where a record's cell is empty although more than ``hole`` were to be expected; refine the
    ``density`` (n,) by its count, in place. highest : (n,) of the densities so far, which is what is expected at least
    half of: just outside a border coarse cells are empty for the most part, and their own density says too little.
    """
    for k in range(len(cell)):
        c = cell[k]
        if count[c] == 0.0 and max(density[k], 0.5 * highest[k]) * volume[c] >= hole:
            seen[k] = False
        highest[k] = max(highest[k], density[k])
        density[k] = (count[c] + pseudo_count) / (volume[c] + pseudo_count / density[k])


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

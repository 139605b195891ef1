"""Compiled cells of a space: in which of them records lie, and how large they are."""

from __future__ import annotations

import numpy as np

from sameas.kernels.compiled import kernel
from sameas.kernels.sphere import ARCSEC


@kernel
def rings(low, high, arc, size):
    """Rings of equal height in latitude from ``low`` to ``high``, degrees, cut into nearly square cells of ``size``,
    arcsec², along an ``arc`` of longitude.

    Returns (r + 1,) numbers of the first cell of each ring, and in the end of all; (r,) the size of a ring's cells.
    """
    number = max(1, int(np.ceil((high - low) * 3600.0 / np.sqrt(size))))
    begin, volume = np.zeros(number + 1, np.int64), np.empty(number)
    height, below = (high - low) / number, np.sin(np.radians(low))
    for r in range(number):
        above = np.sin(np.radians(low + height * (r + 1)))
        area = np.radians(arc) * (above - below) * ARCSEC**2
        pieces = max(1, int(np.round(area / size)))
        begin[r + 1], volume[r], below = begin[r] + pieces, area / pieces, above
    return begin, volume


@kernel
def sphere_cells(features, low, high, west, arc, begin, cell):
    """Fill ``cell`` (n,) with the cells of directions (n, 2), degrees, in ``rings`` that begin at ``west``."""
    number = len(begin) - 1
    height = (high - low) / number
    for k in range(len(cell)):
        ring = min(max(int((features[k, 1] - low) / height), 0), number - 1)
        turn, pieces = features[k, 0] - west, begin[ring + 1] - begin[ring]
        along = (turn - 360.0 * np.floor(turn / 360.0)) / arc
        cell[k] = begin[ring] + min(int(along * pieces), pieces - 1)


@kernel
def box_cells(features, low, extent, cuts, cell):
    """Fill ``cell`` (n,) with the cells of points (n, d) in a box that is cut ``cuts`` times along every feature."""
    for k in range(len(cell)):
        number = 0
        for v in range(features.shape[1]):
            along = int((features[k, v] - low[v]) / extent[v] * cuts)
            number = number * cuts + min(max(along, 0), cuts - 1)
        cell[k] = number


@kernel
def renumber(one, two, total, of_first, of_second):
    """Fill ``of_first`` and ``of_second`` with the cells ``one`` and ``two``, of ``total``, numbered as they occur.

    Returns the cells that occur, rising.
    """
    number, found = np.zeros(total, np.int32), 0
    for cells in (one, two):
        for c in cells:
            number[c] = 1
    for c in range(total):
        if number[c]:
            number[c] = found
            found += 1
    for cells, out in ((one, of_first), (two, of_second)):
        for k in range(len(cells)):
            out[k] = number[cells[k]]
    known = np.empty(found, np.int64)
    for cells, out in ((one, of_first), (two, of_second)):
        for k in range(len(cells)):
            known[out[k]] = cells[k]
    return known


@kernel
def sizes(known, begin, volume):
    """(c,) sizes of the cells ``known``, rising, of rings whose cells begin at ``begin`` and are of size ``volume``."""
    out, ring = np.empty(len(known)), 0
    for k in range(len(known)):
        while begin[ring + 1] <= known[k]:
            ring += 1
        out[k] = volume[ring]
    return out

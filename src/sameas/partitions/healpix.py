"""HEALPix cells in nested numbering: cells of positions, cells around cells, and stretches of cells.

A stretch is a range [begin, end) of cell numbers at order 29, the order of the column ``_healpix_29`` of a HATS
catalogue. A set of stretches is a (k, 2) array, ascending and disjoint.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.errors import optional

FINEST = 29
#: Mean side of a cell over the smallest width of any cell; hats uses the same number for its margins.
SIDE_OVER_WIDTH = 1.6
#: Side of a cell of order 0, arcsec: the root of 4π/12 steradian.
SIDE_ARCSEC = math.degrees(math.sqrt(math.pi / 3.0)) * 3600.0


def area_arcsec2(order: int) -> float:
    """Area of a cell, arcsec²."""
    return (SIDE_ARCSEC / 2.0**order) ** 2


def width_arcsec(order: int) -> float:
    """Smallest width of a cell, arcsec."""
    return SIDE_ARCSEC / 2.0**order / SIDE_OVER_WIDTH


def order_of_width(arcsec: float) -> int:
    """The finest order, at most 24, whose cells are at least this wide; 0 if none is."""
    return int(min(max(math.floor(math.log2(SIDE_ARCSEC / SIDE_OVER_WIDTH / max(arcsec, 1e-6))), 0), 24))


def cells_of(position_deg: FloatArray, order: int) -> IntArray:
    """(n,) cells of positions (n, 2), right ascension and declination in degrees."""
    from astropy.coordinates import Latitude, Longitude

    if not len(position_deg):
        return np.empty(0, np.int64)
    lon = Longitude(np.mod(position_deg[:, 0], 360.0), unit="deg")
    lat = Latitude(position_deg[:, 1], unit="deg")
    return np.asarray(_nested().lonlat_to_healpix(lon, lat, order, num_threads=1), np.int64)


def centres(cells: IntArray, order: int) -> FloatArray:
    """(n, 3) unit vectors of the centres of cells."""
    lon, lat = _nested().healpix_to_lonlat(cells.astype(np.uint64), order, num_threads=1)
    lon, lat = np.asarray(lon.rad), np.asarray(lat.rad)
    return np.column_stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])


def stretches(cells: IntArray, order: int) -> IntArray:
    """(k, 2) stretches of cells of one order, consecutive cells joined."""
    cells = _distinct(np.asarray(cells, np.int64))
    return joined(np.column_stack([cells, cells + 1]) << (2 * (FINEST - order)))


def joined(stretch: IntArray) -> IntArray:
    """The union of stretches as the fewest stretches (k, 2), ascending."""
    if not len(stretch):
        return stretch.reshape(0, 2)
    stretch = stretch[np.argsort(stretch[:, 0], kind="stable")]
    reach = np.maximum.accumulate(stretch[:, 1])
    first = np.ones(len(stretch), np.bool_)
    first[1:] = stretch[1:, 0] > reach[:-1]
    last = np.append(np.flatnonzero(first)[1:] - 1, len(stretch) - 1)
    return np.column_stack([stretch[first, 0], reach[last]])


def within(stretch: IntArray, cells: IntArray) -> BoolArray:
    """(n,) whether cells of order 29 are in a set of stretches."""
    if not len(stretch):
        return np.zeros(len(cells), np.bool_)
    at = np.searchsorted(stretch[:, 0], cells, side="right") - 1
    return np.asarray((at >= 0) & (cells < stretch[np.maximum(at, 0), 1]))


def ring(cells: IntArray, order: int, fine: int) -> IntArray:
    """The cells of order ``fine`` that touch a set of cells of the same or a coarser order from outside."""
    nested, fine = _nested(), max(fine, order)
    edges, corners = nested.external_neighbours(np.asarray(cells, np.uint64), order, fine - order, num_threads=1)
    # −1 where a corner does not exist
    around = np.concatenate([np.ravel(edges).astype(np.int64), np.ravel(corners).astype(np.int64)])
    around = _distinct(around[around >= 0])
    return around[~np.isin(around >> (2 * (fine - order)), cells)]


def _distinct(cells: IntArray) -> IntArray:
    """The distinct cells, ascending; ``np.unique`` uses a hash table, five times as slow for cell numbers."""
    cells = np.sort(cells)
    return cells[np.append(True, cells[1:] != cells[:-1])] if len(cells) else cells


def _nested() -> Any:
    with optional("catalogues in partitions need cdshealpix", "hats"):
        from cdshealpix import nested
    return nested

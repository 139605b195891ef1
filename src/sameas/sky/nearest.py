"""The nearest neighbour, one record at a time: what most programs give, kept to be compared with."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sameas.records import FloatArray, Records
from sameas.space import ARCSEC_PER_RADIAN


@dataclass(frozen=True)
class Nearest:
    """rows : (n,) table row of the nearest record; separation_arcsec : (n,) how far it is."""

    rows: NDArray[np.int64]
    separation_arcsec: FloatArray


def nearest(first: Records, second: Records) -> Nearest:
    """The nearest record of ``second`` to each record of ``first``, on the sphere, whatever their errors."""
    from scipy.spatial import cKDTree

    distance, at = cKDTree(_directions(second.features)).query(_directions(first.features), workers=-1)
    return Nearest(second.rows[at], 2.0 * np.arcsin(np.minimum(distance / 2.0, 1.0)) * ARCSEC_PER_RADIAN)


def _directions(position_deg: FloatArray) -> FloatArray:
    lon, lat = np.radians(position_deg).T
    return np.column_stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])

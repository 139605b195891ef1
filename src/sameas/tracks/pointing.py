"""Pointing: at which of the places that others show a direction may point.

A direction knows no distance, but much depends on it: metres of hull or of motion are more degrees the nearer the
object, and a camera sees far boats less often than near ones. The places where other sources show something tell.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from sameas.records import FloatArray

#: A direction points at places within so many standard deviations.
REACH_SIGMA = 3.0


def pointed_at(
    bearing_deg: FloatArray, sigma_deg: ArrayLike, sensor_m: ArrayLike, places: FloatArray, extent_m: float
) -> FloatArray:
    """(n, p) probability that each direction points at each place, if at one of them; rows of 0 where at none.

    Parameters
    ----------
    bearing_deg, sigma_deg : (n,) directions, clockwise from the plane's north, and their 1σ.
    sensor_m : (2,) from where. places : (p, 2) in the plane.
    extent_m : by how much the point that is seen strays from the middle of the object, 1σ.

    Example
    -------
    >>> boats = np.array([[0.0, 100.0], [5.0, 300.0], [90.0, 0.0]])
    >>> pointed_at(np.array([0.0, 180.0]), 1.0, (0.0, 0.0), boats, 2.0).round(2).tolist()
    [[0.51, 0.49, 0.0], [0.0, 0.0, 0.0]]
    """
    weight = np.zeros((len(bearing_deg), len(places)))
    if not weight.size:
        return weight
    arm = places - np.asarray(sensor_m)
    away = np.maximum(np.hypot(*arm.T), 1.0)
    off = (np.asarray(bearing_deg)[:, None] - np.degrees(np.arctan2(arm[:, 0], arm[:, 1])) + 180.0) % 360.0 - 180.0
    sigma = np.hypot(np.broadcast_to(sigma_deg, len(bearing_deg))[:, None], np.degrees(np.arctan2(extent_m, away)))
    inside = np.abs(off) < REACH_SIGMA * sigma
    weight[inside] = (np.exp(-0.5 * (off / sigma) ** 2) / sigma)[inside]
    total = weight.sum(axis=1, keepdims=True)
    return np.asarray(np.divide(weight, total, out=weight, where=total > 0.0))

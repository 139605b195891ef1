"""Compiled search for the nearest of the places of one instant, of many instants at once."""

from __future__ import annotations

import math

import numpy as np

from sameas.arrays import FloatArray, IntArray
from sameas.kernels.compiled import small_by


def _work(points: FloatArray, at: IntArray, places: FloatArray, start: IntArray, *_: object) -> float:
    return float(points.shape[0] * len(at) * (len(places) / max(len(start) - 1, 1)))


@small_by(_work)
def nearest_at_once(
    points: FloatArray, at: IntArray, places: FloatArray, start: IntArray, distance: FloatArray, nearest: IntArray
) -> None:
    """Write for points (p, k, 2) the nearest of the places (m, 2) of the same instant, the first of several, and its
    ``distance``, both (p, k).

    at : (k,) instant of the points. start : (t + 1,) instant n has the places start[n] … start[n + 1] − 1, at least
    one. A k-d tree for each instant takes longer up to thousands of places.
    """
    for p in range(len(points)):
        for k in range(len(at)):
            x, y = points[p, k, 0], points[p, k, 1]
            least, which = np.inf, start[at[k]]
            for n in range(start[at[k]], start[at[k] + 1]):
                east, north = x - places[n, 0], y - places[n, 1]
                squared = east * east + north * north
                if squared < least:
                    least, which = squared, n
            distance[p, k], nearest[p, k] = math.sqrt(least), which

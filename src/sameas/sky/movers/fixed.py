"""What is fixed on the chip while the telescope is dithered: warm pixels and other defects in a table of detections.

Between two exposures all of it moves by one vector on the sky, another one between the next two; what moves for itself
does not. From exposure to exposure the vector that most pairs of detections have is looked for. A steady drift is not
told from a common motion here (``Movers.alike``); frames have pixels that tell (:mod:`sameas.sky.series.tied`).
"""

from __future__ import annotations

import itertools
import math

import numpy as np
from scipy.spatial import cKDTree

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.sky.movers.detections import Detections
from sameas.sky.movers.rates import EclipticAxes
from sameas.space import ARCSEC_PER_RADIAN

#: Larger dithers are not looked for, arcsec; nor so large ones that more pairs than these would have to be looked at.
_FARTHEST_ARCSEC, _MOST_PAIRS = 60.0, 500_000
#: So many pairs of one vector, and so many times as many as chance makes by what is farther around, are a pattern.
_LEAST, _EXCESS = 8, 8.0


def fixed_on_chip(detections: Detections) -> BoolArray:
    """(n,) detections that are fixed on the chip; none where no three exposures show a pattern that is not a motion.

    detections : without stationary sources.
    """
    out = np.zeros(len(detections), bool)
    rows = [np.flatnonzero(detections.frame == k) for k in range(len(detections.frame_names))]
    shown = [k for k, mine in enumerate(rows) if len(mine) >= _LEAST]
    if len(shown) < 3:
        return out
    axes, width = detections.axes(), 3.0 * math.sqrt(2.0) * detections.typical_sigma_arcsec
    steps = {b: _common_step(axes, rows[a], rows[b], width) for a, b in itertools.pairwise(shown)}
    found = {b: step for b, step in steps.items() if step is not None}
    if len(found) < 2 or _one_motion(found, dict(zip(shown[1:], shown, strict=False)), detections.frame_mjd, width):
        return out
    place = np.zeros((len(rows), 2))
    for k in range(1, len(rows)):
        place[k] = place[k - 1] + found.get(k, np.zeros(2))
    chip = axes.directions(np.arange(len(detections)), -place[detections.frame])
    i, j = cKDTree(chip).query_pairs(width / ARCSEC_PER_RADIAN, output_type="ndarray").T
    moved = np.hypot(*(place[detections.frame[i]] - place[detections.frame[j]]).T) > width
    out[i[moved]] = out[j[moved]] = True
    return out


def _common_step(axes: EclipticAxes, first: IntArray, second: IntArray, width: float) -> FloatArray | None:
    """(2,) arcsec on the ecliptic axes from detections of one exposure to those of another that most pairs have.

    None where no more have it than chance makes.
    """
    trees = cKDTree(axes.unit[first]), cKDTree(axes.unit[second])
    farthest = _FARTHEST_ARCSEC
    while farthest > 4.0 * width:
        if trees[0].count_neighbors(trees[1], farthest / ARCSEC_PER_RADIAN) <= _MOST_PAIRS:
            break
        farthest *= 0.7
    pairs = trees[0].sparse_distance_matrix(trees[1], farthest / ARCSEC_PER_RADIAN, output_type="ndarray")
    if len(pairs) < _LEAST:
        return None
    step = axes.offsets(first[pairs["i"]], second[pairs["j"]])
    tree = cKDTree(step)
    near = tree.query_ball_point(step, width, return_length=True)
    best = int(near.argmax())
    around = len(tree.query_ball_point(step[best], 4.0 * width)) - near[best]
    if near[best] < _LEAST or near[best] < _EXCESS * around / 15.0:
        return None
    return np.median(step[tree.query_ball_point(step[best], width)], axis=0)


def _one_motion(found: dict[int, FloatArray], before: dict[int, int], mjd: FloatArray, width: float) -> bool:
    """Whether steps to some exposures, each from the one before, are those of one rate."""
    days = np.array([mjd[b] - mjd[before[b]] for b in found])
    step = np.array(list(found.values()))
    rate = (days[:, None] * step).sum(axis=0) / max(float((days**2).sum()), 1e-300)
    return bool((np.hypot(*(step - days[:, None] * rate).T) < 2.0 * width).all())

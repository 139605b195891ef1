"""States of objects: position and velocity, from the records that are one object at an instant.

Records with independent errors are weighted by their inverse covariances. Tracks that smooth over the same motion err
alike, whatever their sensors: those of one object (kinds :data:`SMOOTHED`) are joined by covariance intersection first,
which is right whatever their correlation, and only then with the others. Directions help where they cross.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.kernels.object_states import sum_of_records
from sameas.many.fusion import BISECTIONS, OPTIMAL, STEPS
from sameas.many.objects import Objects
from sameas.picture.scan import Scan

#: Kinds of sources whose named records are tracks, smoothed by a filter of their own.
SMOOTHED = ("tracks", "marine radar")
#: 1σ per axis of velocities of objects of which nothing is described, m/s.
UNKNOWN_SPEED = 1e3


@dataclass(frozen=True)
class ObjectStates:
    """Objects at one instant, (n,) each.

    state, covariance : (n, 4), (n, 4, 4) in the plane; an unreported velocity is 0 ± the speed of its objects.
    placed : whether the position is known, from a position or from directions of two sensors.
    moving : whether a record has a velocity.
    """

    state: FloatArray
    covariance: FloatArray
    placed: BoolArray
    moving: BoolArray


def object_states(scan: Scan, members: IntArray, identification: Objects | None) -> ObjectStates:
    """States of the objects ``identification`` of the scan, with these ``members`` (n, S), −1 for none."""
    n = len(members)
    state, covariance, placed, moving = np.empty((n, 4)), np.empty((n, 4, 4)), np.empty(n, bool), np.empty(n, bool)
    kinds = np.array([description.kind in SMOOTHED for description in scan.now.descriptions], dtype=bool)
    smoothed = scan.moving & (scan.track != "") & (kinds[scan.source] if len(scan) else False)
    speed = np.where(np.isfinite(scan.speed_m_per_s), scan.speed_m_per_s, UNKNOWN_SPEED)
    sum_of_records(
        members, scan.state, scan.covariance, scan.placed, scan.moving, smoothed, speed, STEPS, OPTIMAL, BISECTIONS,
        state, covariance, placed, moving,
    )  # fmt: skip
    is_member = members >= 0
    directed = np.flatnonzero((is_member & ~scan.placed[members]).any(axis=1)) if len(scan) else np.empty(0, np.int64)
    if len(directed) and identification is not None:
        # A direction is no linear observation; the joint density of the identification has its update already.
        fused = identification.fused
        state[directed, :2] = fused.state[directed, :2]
        covariance[directed, :2], covariance[directed, 2:, :2] = 0.0, 0.0
        covariance[directed, :2, :2] = fused.covariance[directed, :2, :2]
        # An object whose directions do not cross may be anywhere along them within the region.
        widest = np.linalg.eigvalsh(scan.now.region.covariance[:2, :2])[-1]
        placed[directed] |= (
            np.linalg.eigvalsh(covariance[directed, :2, :2])[:, -1] < scan.tuning.crossing_share**2 * widest
        )
    return ObjectStates(state, covariance, placed, moving)

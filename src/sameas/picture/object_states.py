"""States of objects: position and velocity, from the records that are one object at an instant.

Records with independent errors are weighted by their inverse covariances. Tracks that smooth over the same motion err
alike, whatever their sensors: those of one object (kinds :data:`SMOOTHED`) are joined by covariance intersection first,
which is right whatever their correlation, and only then with the others. Directions help where they cross.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.gaussian import inverse
from sameas.many.fusion import intersection_weights
from sameas.many.objects import Objects
from sameas.picture.scan import Scan

#: Kinds of sources whose named records are tracks, smoothed by a filter of their own.
SMOOTHED = ("tracks", "marine radar")


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
    information, vector, placed, moving, origin = _summed(scan, members)
    covariance = inverse(information)
    state = np.einsum("nvw,nw->nv", covariance, vector)
    state[:, :2] += origin
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


def _summed(scan: Scan, members: IntArray) -> tuple[FloatArray, FloatArray, BoolArray, BoolArray, FloatArray]:
    """Information (n, 4, 4) and vector (n, 4) about the origins (n, 2) of the objects; whether placed, and moving."""
    n = len(members)
    at, source = np.nonzero(members >= 0)
    record = members[at, source]
    keep = scan.placed[record]
    at, record = at[keep], record[keep]
    origin = np.zeros((n, 2))
    # From the last to the first, so that the first member of each stays.
    origin[at[::-1]] = scan.state[record[::-1], :2]
    precision, pull = _precision(scan, record, scan.state[record] - _wide(origin[at]))
    placed, moving = np.zeros(n, bool), np.zeros(n, bool)
    placed[at], moving[at[scan.moving[record]]] = True, True
    _intersect(scan, at, record, precision, pull)
    information, vector, slowest = np.zeros((n, 4, 4)), np.zeros((n, 4)), np.zeros(n)
    # The members of an object follow each other.
    some, first = np.unique(at, return_index=True)
    if len(some):
        speed = np.where(np.isfinite(scan.speed_m_per_s[record]), scan.speed_m_per_s[record], 1e3)
        information[some], vector[some] = np.add.reduceat(precision, first), np.add.reduceat(pull, first)
        slowest[some] = np.maximum.reduceat(speed, first)
    rest = np.where(moving, 0.0, 1.0 / np.maximum(slowest, 1.0) ** 2)
    information[:, 2, 2] += rest
    information[:, 3, 3] += rest
    # Where no member is a position the state has the variance of a plane's width.
    information[~placed, 0, 0] = information[~placed, 1, 1] = 1e-12
    return information, vector, placed, moving, origin


def _precision(scan: Scan, record: IntArray, offset: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(m, 4, 4) information of records and (m, 4) its product with their offsets; 0 on unreported velocities."""
    out = np.zeros((len(record), 4, 4))
    moving = scan.moving[record]
    out[moving] = inverse(scan.covariance[record[moving]])
    out[~moving, :2, :2] = inverse(scan.covariance[record[~moving], :2, :2])
    return out, np.einsum("mvw,mw->mv", out, offset)


def _intersect(scan: Scan, at: IntArray, record: IntArray, precision: FloatArray, pull: FloatArray) -> None:
    """Weigh the precisions of smoothed tracks of one object by covariance intersection, in place."""
    kinds = np.array([description.kind in SMOOTHED for description in scan.now.descriptions], dtype=bool)
    smoothed = kinds[scan.source[record]] & (scan.track[record] != "") & scan.moving[record]
    count = np.bincount(at[smoothed], minlength=int(at.max(initial=-1)) + 1)
    for k in np.unique(count[count > 1]).tolist():
        several = np.flatnonzero(smoothed & (count[at] == k))
        records = several[np.argsort(at[several], kind="stable")].reshape(-1, k)
        weights = intersection_weights(precision[records])
        precision[records] *= weights[..., None, None]
        pull[records] *= weights[..., None]


def _wide(position: FloatArray) -> FloatArray:
    """Positions (…, 2) as states at rest (…, 4)."""
    return np.concatenate([position, np.zeros_like(position)], axis=-1)

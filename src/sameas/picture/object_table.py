"""Tables of objects: frozen columns of equal length; row k of all columns is one object.

- :class:`ColumnTable`: the base of every such table, whatever its rows are.
- :class:`ObjectTable`: a number, a state and its covariance for every object; the base of both kinds of pictures.
- :class:`PictureObjects`: the objects of a picture at an instant, with their stages.

:func:`object_states` gives the position and velocity of objects from their records at an instant. Records with
independent errors are weighted by their inverse covariances. Tracks that smooth over the same motion have correlated
errors, whatever their sensors: those of one object (kinds :data:`SMOOTHED`) are first fused by covariance intersection,
which is consistent for any correlation, and then with the others. Directions contribute where they cross.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.kernels.kalman import sum_of_records
from sameas.many.fusion import BISECTIONS, OPTIMAL, STEPS
from sameas.many.objects import Objects
from sameas.picture.scan import Scan
from sameas.tracks.alignment import moved


class ColumnTable:
    """Base of dataclasses whose fields are columns (k, …), except those in ``WHOLE``, which belong to the table."""

    WHOLE: ClassVar[frozenset[str]] = frozenset()

    def columns(self) -> dict[str, NDArray[Any]]:
        """The columns by their names."""
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name not in self.WHOLE}  # type: ignore[arg-type]

    def take(self, which: NDArray[Any]) -> Self:
        """The rows of an index array, in any order, or of a mask."""
        return replace(self, **{name: column[which] for name, column in self.columns().items()})  # type: ignore[type-var]

    def stacked(self, *others: Self) -> Self:
        """The rows of this table followed by those of others; the fields in ``WHOLE`` are those of this table."""
        parts = [part.columns() for part in (self, *others)]
        return replace(self, **{name: np.concatenate([part[name] for part in parts]) for name in parts[0]})  # type: ignore[type-var]


@dataclass(frozen=True)
class ObjectTable(ColumnTable):
    """Objects, (k,) each.

    number : of the object, from 1. state, covariance : (k, 4), (k, 4, 4) of position and velocity in the plane.
    """

    number: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    state: FloatArray = field(default_factory=lambda: np.empty((0, 4)))
    covariance: FloatArray = field(default_factory=lambda: np.empty((0, 4, 4)))

    def __len__(self) -> int:
        return len(self.number)

    def predicted(self, dt_s: float, walk_m2_per_s3: FloatArray | float) -> Self:
        """The objects with their states predicted by ``dt_s``; walk_m2_per_s3 : of the random walk of velocities."""
        if not len(self):
            return self
        state, covariance = moved(self.state, self.covariance, dt_s, walk_m2_per_s3)
        return replace(self, state=state, covariance=covariance)


TENTATIVE, CONFIRMED, COASTING, ENDED = range(4)
STAGES = ("tentative", "confirmed", "coasting", "ended")


@dataclass(frozen=True)
class PictureObjects(ObjectTable):
    """The objects of the picture at an instant, (k,) each, by ascending number, including those that end there.

    Attributes
    ----------
    stage : index in :data:`STAGES`.
    placed : whether the position is known.
    moving : whether the velocity is known, reported or from the object's positions.
    detection : (k,) index of the detected object of the instant, −1 if not detected.
    """

    stage: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    placed: BoolArray = field(default_factory=lambda: np.empty(0, bool))
    moving: BoolArray = field(default_factory=lambda: np.empty(0, bool))
    detection: IntArray = field(default_factory=lambda: np.empty(0, np.int64))

    @property
    def detected(self) -> BoolArray:
        """(k,) whether any source detects the object."""
        return np.asarray(self.detection >= 0)

    def numbers(self, n_detections: int) -> IntArray:
        """(n,) the number of each detected object."""
        out = np.zeros(n_detections, np.int64)
        out[self.detection[self.detected]] = self.number[self.detected]
        return out

    def undetected(self, stage: IntArray) -> Self:
        """The objects with these stages (k,), none of them detected."""
        return replace(self, stage=stage, detection=np.full(len(self), -1))

    def in_order(self, *others: Self) -> Self:
        """The objects of this table and others, by ascending number."""
        objects = self.stacked(*others)
        return objects.take(np.argsort(objects.number))


#: Kinds of sources whose named records are tracks smoothed by a filter.
SMOOTHED = ("tracks", "marine radar")
#: 1σ per axis of velocities of objects without a described speed, m/s.
UNKNOWN_SPEED = 1e3


@dataclass(frozen=True)
class ObjectStates:
    """Objects at one instant, (n,) each.

    state, covariance : (n, 4), (n, 4, 4) in the plane; an unreported velocity is 0 ± the described speed.
    placed : whether the position is known, from a position or from crossing directions.
    moving : whether a record has a velocity.
    """

    state: FloatArray
    covariance: FloatArray
    placed: BoolArray
    moving: BoolArray


def object_states(scan: Scan, members: IntArray, identification: Objects | None) -> ObjectStates:
    """The states of the objects ``identification`` of a scan; members : (n, S) their records, −1 for none."""
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
        # Directions are not linear in the state; the identification's joint density has done their update.
        fused = identification.fused
        state[directed, :2] = fused.state[directed, :2]
        covariance[directed, :2], covariance[directed, 2:, :2] = 0.0, 0.0
        covariance[directed, :2, :2] = fused.covariance[directed, :2, :2]
        # Without crossing directions the position along them is unknown.
        widest = np.linalg.eigvalsh(scan.now.region.covariance[:2, :2])[-1]
        placed[directed] |= (
            np.linalg.eigvalsh(covariance[directed, :2, :2])[:, -1] < scan.tuning.crossing_share**2 * widest
        )
    return ObjectStates(state, covariance, placed, moving)

"""Tables of objects: frozen columns of equal length; row k of all columns is one object.

- :class:`ColumnTable`: the base of every such table, whatever its rows are.
- :class:`ObjectTable`: a number, a state and its covariance for every object; the base of both kinds of pictures.
- :class:`PictureObjects`: the objects of a picture at an instant, with their stages.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.tracks.alignment import moved


class ColumnTable:
    """Base of dataclasses whose fields are columns (k, …), but for those named in ``WHOLE``, which are of all rows."""

    WHOLE: ClassVar[frozenset[str]] = frozenset()

    def columns(self) -> dict[str, NDArray[Any]]:
        """The columns by their names."""
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name not in self.WHOLE}  # type: ignore[arg-type]

    def take(self, which: NDArray[Any]) -> Self:
        """Some of the rows: places, in any order, or a mask."""
        return replace(self, **{name: column[which] for name, column in self.columns().items()})  # type: ignore[type-var]

    def stacked(self, *others: Self) -> Self:
        """These rows and those of others below them; the fields in ``WHOLE`` stay those of these."""
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
        """The objects with their states after ``dt_s``: velocities walk at random, by ``walk_m2_per_s3``."""
        if not len(self):
            return self
        state, covariance = moved(self.state, self.covariance, dt_s, walk_m2_per_s3)
        return replace(self, state=state, covariance=covariance)


TENTATIVE, CONFIRMED, COASTING, ENDED = range(4)
STAGES = ("tentative", "confirmed", "coasting", "ended")


@dataclass(frozen=True)
class PictureObjects(ObjectTable):
    """The objects of the picture at an instant, (k,) each, by ascending number; those that end then are among them.

    Attributes
    ----------
    stage : place in :data:`STAGES`.
    placed : whether the position is known.
    moving : whether the velocity is known, reported or from the object's own positions.
    detection : (k,) which object of the instant it is, −1 where no source shows it.
    """

    stage: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    placed: BoolArray = field(default_factory=lambda: np.empty(0, bool))
    moving: BoolArray = field(default_factory=lambda: np.empty(0, bool))
    detection: IntArray = field(default_factory=lambda: np.empty(0, np.int64))

    @property
    def detected(self) -> BoolArray:
        """(k,) whether a source shows the object."""
        return np.asarray(self.detection >= 0)

    def numbers(self, n_detections: int) -> IntArray:
        """(n,) the number of each object of the instant."""
        out = np.zeros(n_detections, np.int64)
        out[self.detection[self.detected]] = self.number[self.detected]
        return out

    def undetected(self, stage: IntArray) -> Self:
        """The objects at these stages (k,), where no source shows any of them."""
        return replace(self, stage=stage, detection=np.full(len(self), -1))

    def in_order(self, *others: Self) -> Self:
        """These and others, by ascending number."""
        whole = self.stacked(*others)
        return whole.take(np.argsort(whole.number))

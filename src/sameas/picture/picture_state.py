"""A picture state: the picture at one instant, and the state that its next instant starts from.

:class:`sameas.picture.Picture` goes through a whole span. Nothing that was fused returns as evidence: a state without
memory is the answer of ``identify_many`` for that instant, and memory counts every report once.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.errors import InputError
from sameas.evidence.identity import Alarm
from sameas.many.explanation import Name, ObjectExplanation
from sameas.picture.instant_objects import InstantObjects
from sameas.picture.object_states import ObjectStates
from sameas.picture.object_table import PictureObjects
from sameas.picture.scan import Scan
from sameas.representation import in_short
from sameas.tracks.scene import Instant

#: The text on an object that is shown, though it is not in the most probable answer.
STAYS = "its identity is kept until another is much more probable"


class Carried(Protocol):
    """The state that a picture carries to its next instant: a ``Watch``, or a ``PlotPicture`` of bare plots."""

    @property
    def objects(self) -> PictureObjects: ...
    @property
    def texts(self) -> Mapping[int, NDArray[Any]]: ...


W = TypeVar("W", bound=Carried, covariant=True)


@in_short
@dataclass(frozen=True)
class PictureState(Generic[W]):
    """The picture at one instant; made by :meth:`Watch.advance`, or :meth:`sameas.picture.plot_picture.PlotPicture.at`.

    Attributes
    ----------
    now : the instant. scan : the records of the sources that have any.
    detections : the objects that they show, (n,), and their probabilities. states : of these.
    watch : the state for the next instant.
    """

    now: Instant
    scan: Scan
    detections: InstantObjects
    states: ObjectStates
    watch: W

    @property
    def objects(self) -> PictureObjects:
        """The objects of the picture."""
        return self.watch.objects

    @property
    def members(self) -> IntArray:
        """(n, S) records of the scan of each detected object, −1 for none."""
        return self.detections.members

    @cached_property
    def number(self) -> IntArray:
        """(n,) the number in the picture of each detected object."""
        return self.objects.numbers(len(self.members))

    @cached_property
    def object_of_record(self) -> IntArray:
        """(records,) the detected object of each record of the scan."""
        out = np.zeros(len(self.scan), np.int64)
        at, source = np.nonzero(self.members >= 0)
        out[self.members[at, source]] = at
        return out

    @property
    def runner_up(self) -> IntArray:
        """(n, S) records of the scan of the most probable other set that has one of an object's records."""
        return self.detections.runner_up

    @property
    def p_runner_up(self) -> FloatArray:
        """(n,) its probability, 0 where nothing else is possible."""
        return self.detections.p_runner_up

    @property
    def probability(self) -> FloatArray:
        """(n,) that exactly its records are one object."""
        return self.detections.probability

    @property
    def p_alone(self) -> FloatArray:
        """(records,) that a record has no partner."""
        return self.detections.p_alone

    @cached_property
    def ambiguous(self) -> BoolArray:
        """(n,) whether it is not certain that exactly these records are the object."""
        return np.asarray(self.probability < self.scan.tuning.ambiguous_below)

    @cached_property
    def alarms(self) -> tuple[Alarm, ...]:
        """Identities shown at two places too far apart for one object; rows are those of the sources' reports."""
        start = dict(zip((d.name for d in self.scan.now.descriptions), range(len(self.scan.start)), strict=False))

        def reported(where: tuple[str, int]) -> tuple[str, int]:
            return where[0], int(self.scan.row[self.scan.find(start[where[0]], np.array([where[1]]))[0]])

        return tuple(
            replace(alarm, first=reported(alarm.first), second=reported(alarm.second))
            for alarm in self.scan.now.alarms()
        )

    def explain(self, number: int) -> ObjectExplanation:
        """Why its records are object ``number`` of the picture; records are named by their track ids, else by the lines
        of their files.

        Raises
        ------
        InputError : no record of the instant is in an object of that number.
        """
        at = np.flatnonzero(self.number == number)
        if not len(at):
            raise InputError(f"object {number} is not shown by any source at {self.now.instant_s:g} s")
        reasons, names = self.detections.explain(int(at[0])), self._names
        rivals = tuple(
            replace(
                rival, members=tuple(names[record] for record in rival.members),
                taken=tuple((names[record], int(self.number[other])) for record, other in rival.taken),
            )
            for rival in reasons.rivals
        )  # fmt: skip
        stays = STAYS if self.detections.by_hysteresis[at[0]] else ""
        return replace(reasons, number=number, rivals=rivals, stays=stays)

    @cached_property
    def _names(self) -> Mapping[Name, Name]:
        """By source and row of its reports, the source and the label by which a user finds the record."""
        scan, feeds = self.scan, self.scan.now.feeds
        sources = [description.name for description in scan.now.descriptions]
        names: dict[Name, Name] = dict(self.detections.names)
        for s, row, track in zip(scan.source.tolist(), scan.row.tolist(), scan.track.tolist(), strict=True):
            raw = feeds[s].raw_reports
            label = track or (f"row {row}" if raw is None else f"{raw.damaged.unit} {raw.line[row]}")
            names[sources[s], row] = sources[s], label
        return names

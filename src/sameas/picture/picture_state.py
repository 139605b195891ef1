"""A picture state: the picture at one instant, with the state to continue from.

:class:`sameas.picture.Picture` covers a whole span. Fused states are never reused as evidence: without memory, a
picture state is the answer of ``identify_many`` for its instant, and memory counts each report once.

The objects of an instant are sets of records of its scan: :class:`IdentifiedObjects` where ``identify_many`` identifies
the instant, :class:`TrackedObjects` where objects were tracked to it. The prior of a tracked object is not a record;
sets that differ only in it count as one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.special import softmax

from sameas.arrays import ABSENT, BoolArray, FloatArray, IntArray, entries
from sameas.errors import InputError
from sameas.evidence.identity import IdentityConflict
from sameas.many.objects import Name, ObjectExplanation, Objects
from sameas.many.observations import records_of
from sameas.picture.bernoulli import KNOWN
from sameas.picture.crossings import is_placed
from sameas.picture.plot_tracker import TrackedPlots
from sameas.picture.tables import UNKNOWN_VELOCITY_SHARE, ObjectStates, PictureObjects, Scan
from sameas.representation import in_short
from sameas.tracks.alignment import States
from sameas.tracks.scene import Instant
from sameas.tracks.stationary import MODES, mode_shares

AMBIGUOUS_BELOW = 0.95  # an object is ambiguous if its probability is below this


@dataclass(frozen=True)
class IdentifiedObjects:
    """The objects of ``identify_many``; ``identification`` is None if no source has a record.

    by_hysteresis : (n,) whether an object is shown only because it was at the previous instant
        (:mod:`sameas.many.hysteresis`).
    """

    scan: Scan
    identification: Objects | None
    by_hysteresis: BoolArray

    @cached_property
    def members(self) -> IntArray:
        """(n, S) records of the scan."""
        n_sources = len(self.scan.now.sources)
        if self.identification is None:
            return np.full((0, n_sources), ABSENT)
        return self.scan.places(self.identification.members[:, :n_sources])

    @property
    def probability(self) -> FloatArray:
        """(n,) that exactly its records are one object."""
        return np.empty(0) if self.identification is None else self.identification.probability

    @cached_property
    def runner_up(self) -> IntArray:
        """(n, S) records of the scan of the most probable other set that has one of an object's records."""
        if self.identification is None:
            return self.members
        return self.scan.places(self.identification.runner_up[:, : self.members.shape[1]])

    @cached_property
    def p_runner_up(self) -> FloatArray:
        """(n,) its probability, 0 where nothing else is possible."""
        if self.identification is None:
            return np.empty(0)
        return np.asarray(np.ma.filled(self.identification.p_runner_up, 0.0))

    @cached_property
    def p_alone(self) -> FloatArray:
        """(records,) that a record has no partner."""
        out = np.ones(len(self.scan))
        if self.identification is not None:
            pooled, alone = self.identification.pooled, self.identification.p_alone
            for s, source in zip(pooled.given, pooled.sources, strict=True):
                rows, first = records_of(source).rows, pooled.start[pooled.given.index(s)]
                if s < self.members.shape[1]:
                    out[self.scan.find(s, rows)] = alone[first : first + len(rows)]
        return np.clip(out, 0.0, 1.0)

    @property
    def group(self) -> IntArray:
        """(n,) the group that each object is in."""
        return np.empty(0, np.int64) if self.identification is None else self.identification.group

    @property
    def names(self) -> Mapping[Name, Name]:
        """Names, in explanations, of members that are not records: none."""
        return {}

    def explain(self, row: int) -> ObjectExplanation:
        """The explanation why object ``row`` has its records."""
        assert self.identification is not None
        return self.identification.explain(row)


@dataclass(frozen=True)
class TrackedObjects:
    """The objects tracked to the instant of the scan that a source detects there."""

    scan: Scan
    tracks: TrackedPlots

    @cached_property
    def which(self) -> IntArray:
        """(n,) their rows among the tracked objects."""
        return np.flatnonzero((self.tracks.members >= 0).any(axis=1))

    @cached_property
    def members(self) -> IntArray:
        """(n, S) records of the scan."""
        if self.tracks.identification is None:
            return np.full((0, len(self.scan.now.sources)), ABSENT)
        return self._sets[0][self._sets[2]]

    @property
    def probability(self) -> FloatArray:
        """(n,) that exactly its records are one object, whether new or tracked."""
        return np.empty(0) if self.tracks.identification is None else self._sets[1][self._sets[2]]

    @property
    def runner_up(self) -> IntArray:
        """(n, S) records of the scan of the most probable other set that has one of an object's records."""
        second = self._second
        return np.where((second >= 0)[:, None], self._sets[0][second], ABSENT) if len(second) else self.members

    @property
    def p_runner_up(self) -> FloatArray:
        """(n,) its probability, 0 where nothing else is possible."""
        second = self._second
        return np.where(second >= 0, self._sets[1][second], 0.0) if len(second) else np.empty(0)

    @cached_property
    def p_alone(self) -> FloatArray:
        """(records,) probability that a record has no partner of another source."""
        out = np.ones(len(self.scan))
        if self.tracks.identification is not None:
            sets, probability, _ = self._sets
            lone = np.flatnonzero((sets >= 0).sum(axis=1) == 1)
            out[:] = 0.0
            out[sets[lone].max(axis=1)] = probability[lone]
        return out

    @property
    def group(self) -> IntArray:
        """(n,) the group that each object is in."""
        identification = self.tracks.identification
        return np.empty(0, np.int64) if identification is None else identification.group[self.which]

    @property
    def by_hysteresis(self) -> BoolArray:
        """(n,) False: the previous instants are part of the evidence."""
        return np.zeros(len(self.which), bool)

    @cached_property
    def names(self) -> Mapping[Name, Name]:
        """Names of the priors of tracked objects."""
        objects = self.tracks.prior_objects
        return {(KNOWN, k): ("known object", n) for k, n in zip(objects.records.ids.tolist(), objects.number.tolist(),
                                                               strict=True)}  # fmt: skip

    def explain(self, row: int) -> ObjectExplanation:
        """The explanation why object ``row`` has its records; its members include priors of tracked objects."""
        identification = self.tracks.identification
        assert identification is not None
        reasons, row_of = identification.explain(int(self.which[row])), np.full(len(self.tracks), ABSENT)
        row_of[self.which] = np.arange(len(self.which))
        rivals = tuple(
            replace(rival, taken=tuple((name, int(row_of[at])) for name, at in rival.taken if name[0] != KNOWN))
            for rival in reasons.rivals
        )
        return replace(reasons, rivals=rivals)

    @cached_property
    def states(self) -> ObjectStates:
        """The states of the objects: their priors updated by their records."""
        tracks, scan, which = self.tracks, self.scan, self.which
        state, covariance = tracks.state[which], tracks.covariance[which]
        region = tracks.now.region.covariance
        position = [isinstance(feed.reports, States) for feed in scan.now.feeds]
        placed = ((self.members >= 0) & np.array(position, dtype=bool)).any(axis=1) | (tracks.prior_of[which] >= 0)
        placed |= is_placed(covariance, region)
        return ObjectStates(state, covariance, placed, placed & has_velocity(covariance, region))

    @cached_property
    def _sets(self) -> tuple[IntArray, FloatArray, IntArray]:
        """(k, S) the possible sets of records of the scan, (k,) their probabilities, summed over prior objects, and
        (n,) the set of each object."""
        identification = self.tracks.identification
        assert identification is not None
        sets, of = np.unique(self._possible, axis=0, return_inverse=True)
        of = of.ravel()
        p = np.bincount(of, weights=identification.answer.probability, minlength=len(sets))
        return sets, np.clip(p, 0.0, 1.0), of[identification.set_of_object[self.which]]

    @cached_property
    def _possible(self) -> IntArray:
        """(k, S) the records of the scan of each set in the identification; ABSENT for none and for priors."""
        identification = self.tracks.identification
        assert identification is not None
        pooled = identification.pooled
        scan_record = np.full(len(pooled) + 1, ABSENT)
        for u, source_number in enumerate(pooled.given):
            if source_number > 0:
                rows = records_of(pooled.sources[u]).rows
                scan_record[pooled.start[u] : pooled.start[u + 1]] = self.scan.find(source_number - 1, rows)
        records = scan_record[identification.sets.members]
        out = np.full((len(records), len(self.scan.now.sources)), ABSENT)
        at, column = np.nonzero(records >= 0)
        out[at, self.scan.source[records[at, column]]] = records[at, column]
        return out

    @cached_property
    def _second(self) -> IntArray:
        """(n,) the most probable other set with one of the object's records, ABSENT for none."""
        best = np.full(len(self.which), ABSENT)
        if self.tracks.identification is None:
            return best
        sets, probability, own = self._sets
        own_row, column = np.nonzero(self.members >= 0)
        of_record = np.zeros(len(self.scan), np.int64)
        of_record[self.members[own_row, column]] = own_row
        other = np.setdiff1d(np.flatnonzero((probability > 0.0) & (sets >= 0).any(axis=1)), own)
        # Ascending: the most probable set is written last; of ties the first by content.
        other = other[np.lexsort([-other, probability[other]])]
        at, column = np.nonzero(sets[other] >= 0)
        best[of_record[sets[other[at], column]]] = other[at]
        return best


def has_velocity(covariance: FloatArray, region: FloatArray) -> BoolArray:
    """(n,) whether velocities are known better than from the region's prior; region : (4, 4) its covariance."""
    unknown = UNKNOWN_VELOCITY_SHARE * np.diagonal(region)[2:4]
    return np.asarray((covariance[:, 2, 2] < unknown[0]) & (covariance[:, 3, 3] < unknown[1]))


#: The text on an object that is shown by hysteresis.
STAYS = "its identity is kept until another is much more probable"


class Carried(Protocol):
    """The state to continue a picture from: a ``Watch``, or a ``PlotPicture`` for plots without ids."""

    @property
    def objects(self) -> PictureObjects: ...
    @property
    def texts(self) -> Mapping[int, NDArray[Any]]: ...


W = TypeVar("W", bound=Carried, covariant=True)


@in_short
@dataclass(frozen=True)
class PictureState(Generic[W]):
    """The picture at one instant, made by a ``Watch``, or by a ``PlotPicture`` for plots without ids.

    Attributes
    ----------
    now : the instant. scan : its records. detections : the detected objects, (n,), and their probabilities. states : of
        these. watch : the state for the next instant.
    """

    now: Instant
    scan: Scan
    detections: IdentifiedObjects | TrackedObjects
    states: ObjectStates
    watch: W

    @cached_property
    def objects(self) -> PictureObjects:
        """The objects of the picture."""
        return self.watch.objects.in_picture

    @property
    def members(self) -> IntArray:
        """(n, S) records of the scan of each detected object, ABSENT for none."""
        return self.detections.members

    @cached_property
    def number(self) -> IntArray:
        """(n,) the number in the picture of each detected object."""
        return self.objects.numbers(len(self.members))

    @cached_property
    def object_of_record(self) -> IntArray:
        """(records,) the detected object of each record of the scan."""
        out = np.zeros(len(self.scan), np.int64)
        at, record = entries(self.members)
        out[record] = at
        return out

    @cached_property
    def p_modes(self) -> FloatArray:
        """(n, MODES) probability that an object is alongside, at anchor, adrift, and under way, by all its records.

        The evidence of the sources is independent: each has its own reports of the motion. NaN where none tells it.
        """
        scan, n = self.scan, len(self.members)
        evidence, share = np.zeros((n, MODES)), None
        for s, feed in enumerate(scan.now.feeds):
            records = np.arange(scan.start[s], scan.start[s + 1])
            ratios = feed.log_mode_ratios(scan.row[records], self.now.instant_s)
            np.add.at(evidence, self.object_of_record[records], ratios)
            if share is None:
                share = mode_shares(feed.description.motion)
        if share is None:
            return np.full((n, MODES), np.nan)
        unknown = ~evidence.any(axis=1)
        p = softmax(evidence + np.log(share), axis=1)
        p[unknown] = np.nan
        return np.asarray(p)

    @property
    def runner_up(self) -> IntArray:
        """(n, S) records of the scan of the most probable other set with one of the object's records."""
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
        """(n,) whether the probability of the object's records is below ``AMBIGUOUS_BELOW``."""
        return np.asarray(self.probability < AMBIGUOUS_BELOW)

    @cached_property
    def alarms(self) -> tuple[IdentityConflict, ...]:
        """Alarms on identities at two places too far apart for one object; rows are of the sources' reports."""
        start = dict(zip((d.name for d in self.scan.now.descriptions), range(len(self.scan.start)), strict=False))

        def reported(where: tuple[str, int]) -> tuple[str, int]:
            return where[0], int(self.scan.row[self.scan.find(start[where[0]], np.array([where[1]]))[0]])

        return tuple(
            replace(alarm, first=reported(alarm.first), second=reported(alarm.second))
            for alarm in self.scan.now.alarms()
        )

    def explain(self, number: int) -> ObjectExplanation:
        """The explanation why its records are object ``number`` of the picture; records are named by their track ids,
        else by the lines of their files.

        Raises
        ------
        InputError : the object has no record at the instant.
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
        """By source name and row of its reports, the source name and the record's label for users."""
        scan, feeds = self.scan, self.scan.now.feeds
        sources = [description.name for description in scan.now.descriptions]
        names: dict[Name, Name] = dict(self.detections.names)
        for s, row, track in zip(scan.source.tolist(), scan.row.tolist(), scan.track.tolist(), strict=True):
            raw = feeds[s].raw_reports
            label = track or (f"row {row}" if raw is None else f"{raw.damaged.unit} {raw.line[row]}")
            names[sources[s], row] = sources[s], label
        return names

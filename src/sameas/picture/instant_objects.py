"""Objects of an instant: those that sources show, by the records of its scan, however they were found.

:class:`IdentifiedObjects` where the instant is judged by ``identify_many`` alone, :class:`TrackedObjects` where objects
were followed to it. What is remembered of an object is no record: sets that differ only in that count as one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.many.explanation import Name, ObjectExplanation
from sameas.many.objects import Objects
from sameas.many.observations import records_of
from sameas.picture.bernoulli import KNOWN
from sameas.picture.object_states import CROSSED, ObjectStates
from sameas.picture.plot_tracker import TrackedPlots
from sameas.picture.scan import UNSAID, Scan
from sameas.tracks.alignment import States


class InstantObjects(Protocol):
    """What the picture asks of the objects that sources show at an instant, (n,) each.

    members : (n, S) records of the scan, −1 for none. probability : that exactly these records are one object.
    runner_up : (n, S) the most probable other set that has one of them. p_runner_up : its probability, 0 for none.
    p_alone : (records,) that a record has no partner. group : the group that each object is in.
    names : what to call that which is no record, in explanations.
    kept : whether one is shown only since it was so at the last instant (:mod:`sameas.picture.watch`).
    """

    @property
    def members(self) -> IntArray: ...
    @property
    def probability(self) -> FloatArray: ...
    @property
    def runner_up(self) -> IntArray: ...
    @property
    def p_runner_up(self) -> FloatArray: ...
    @property
    def p_alone(self) -> FloatArray: ...
    @property
    def group(self) -> IntArray: ...
    @property
    def names(self) -> Mapping[Name, Name]: ...
    @property
    def kept(self) -> BoolArray: ...

    def explain(self, row: int) -> ObjectExplanation:
        """Why object ``row`` has its records; objects that other records are in are rows, too."""
        ...


@dataclass(frozen=True)
class IdentifiedObjects:
    """Objects as ``identify_many`` found them; ``found`` is None where nobody says anything."""

    scan: Scan
    identification: Objects | None
    kept: BoolArray

    @cached_property
    def members(self) -> IntArray:
        """(n, S) records of the scan."""
        n_sources = len(self.scan.now.sources)
        if self.identification is None:
            return np.full((0, n_sources), -1)
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
            pooled, sets = self.identification.pooled, self.identification.sets
            lone = np.flatnonzero(sets.size == 1)
            alone = np.zeros(len(pooled))
            alone[sets.members[lone].max(axis=1)] = self.identification.answer.probability[lone]
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
        """Nothing but records is in a set."""
        return {}

    def explain(self, row: int) -> ObjectExplanation:
        """Why object ``row`` has its records."""
        assert self.identification is not None
        return self.identification.explain(row)


@dataclass(frozen=True)
class TrackedObjects:
    """Objects that were followed to the instant of the scan, of them those that a source shows now."""

    scan: Scan
    tracks: TrackedPlots

    @cached_property
    def which(self) -> IntArray:
        """(n,) which of the objects followed they are."""
        return np.flatnonzero((self.tracks.members >= 0).any(axis=1))

    @cached_property
    def members(self) -> IntArray:
        """(n, S) records of the scan."""
        if self.tracks.identification is None:
            return np.full((0, len(self.scan.now.sources)), -1)
        return self._sets[0][self._own]

    @property
    def probability(self) -> FloatArray:
        """(n,) that exactly its records are one object, known or not."""
        return np.empty(0) if self.tracks.identification is None else self._sets[1][self._own]

    @property
    def runner_up(self) -> IntArray:
        """(n, S) records of the scan of the most probable other set that has one of an object's records."""
        second = self._second
        return np.where((second >= 0)[:, None], self._sets[0][second], -1) if len(second) else self.members

    @property
    def p_runner_up(self) -> FloatArray:
        """(n,) its probability, 0 where nothing else is possible."""
        second = self._second
        return np.where(second >= 0, self._sets[1][second], 0.0) if len(second) else np.empty(0)

    @cached_property
    def p_alone(self) -> FloatArray:
        """(records,) that no other source shows the object of a record."""
        out = np.ones(len(self.scan))
        if self.tracks.identification is not None:
            sets, probability = self._sets
            lone = np.flatnonzero((sets >= 0).sum(axis=1) == 1)
            out[:] = 0.0
            out[sets[lone].max(axis=1)] = probability[lone]
        return out

    @property
    def group(self) -> IntArray:
        """(n,) the group that each object is in."""
        found = self.tracks.identification
        return np.empty(0, np.int64) if found is None else found.group[self.which]

    @property
    def kept(self) -> BoolArray:
        """(n,) none: what was before is among the evidence."""
        return np.zeros(len(self.which), bool)

    @cached_property
    def names(self) -> Mapping[Name, Name]:
        """What is remembered of an object stands beside the records."""
        known = self.tracks.known
        return {(KNOWN, k): ("known object", n) for k, n in zip(known.records.ids.tolist(), known.number.tolist(),
                                                               strict=True)}  # fmt: skip

    def explain(self, row: int) -> ObjectExplanation:
        """Why object ``row`` has its records; what is remembered of objects is among them."""
        found = self.tracks.identification
        assert found is not None
        reasons, place = found.explain(int(self.which[row])), np.full(len(self.tracks), -1)
        place[self.which] = np.arange(len(self.which))
        rivals = tuple(
            replace(rival, taken=tuple((name, int(place[at])) for name, at in rival.taken if name[0] != KNOWN))
            for rival in reasons.rivals
        )
        return replace(reasons, rivals=rivals)

    @cached_property
    def states(self) -> ObjectStates:
        """States of the objects: what was remembered of each with its records."""
        followed, scan, which = self.tracks, self.scan, self.which
        state, covariance = followed.state[which], followed.covariance[which]
        region = followed.now.region.covariance
        position = [isinstance(feed.reports, States) for feed in scan.now.feeds]
        placed = ((self.members >= 0) & np.array(position, dtype=bool)).any(axis=1) | (followed.known_of[which] >= 0)
        # Directions that do not cross leave the object anywhere along them.
        widest = np.linalg.eigvalsh(region[:2, :2])[-1]
        placed |= np.linalg.eigvalsh(covariance[:, :2, :2])[:, -1] < CROSSED**2 * widest
        return ObjectStates(state, covariance, placed, placed & says_velocity(covariance, region))

    @cached_property
    def _sets(self) -> tuple[IntArray, FloatArray]:
        """(k, S) every possible set of records of the scan, and (k,) its probability, whatever known object it is."""
        found = self.tracks.identification
        assert found is not None
        members = self._possible
        sets, of = np.unique(members, axis=0, return_inverse=True)
        return sets, np.clip(np.bincount(of.ravel(), weights=found.answer.probability, minlength=len(sets)), 0.0, 1.0)

    @cached_property
    def _possible(self) -> IntArray:
        """Every set that was weighed, (k, S) records of the scan; −1 for what is known."""
        found = self.tracks.identification
        assert found is not None
        pooled = found.pooled
        scan_record = np.full(len(pooled) + 1, -1)
        for u, given in enumerate(pooled.given):
            if given > 0:
                rows = records_of(pooled.sources[u]).rows
                scan_record[pooled.start[u] : pooled.start[u + 1]] = self.scan.find(given - 1, rows)
        records = scan_record[found.sets.members]
        out = np.full((len(records), len(self.scan.now.sources)), -1)
        at, column = np.nonzero(records >= 0)
        out[at, self.scan.source[records[at, column]]] = records[at, column]
        return out

    @cached_property
    def _own(self) -> IntArray:
        """(n,) which of the sets each object is."""
        found = self.tracks.identification
        assert found is not None
        _, of = np.unique(self._possible, axis=0, return_inverse=True)
        return np.asarray(of.ravel()[found.set_of_object[self.which]])

    @cached_property
    def _second(self) -> IntArray:
        """(n,) the most probable other set that has one of an object's records, −1 where there is none."""
        best = np.full(len(self.which), -1)
        if self.tracks.identification is None:
            return best
        sets, probability = self._sets
        mine, column = np.nonzero(self.members >= 0)
        of_record = np.zeros(len(self.scan), np.int64)
        of_record[self.members[mine, column]] = mine
        other = np.setdiff1d(np.flatnonzero((probability > 0.0) & (sets >= 0).any(axis=1)), self._own)
        # Ascending, so that the last to be written is the most probable; of equals the first by content.
        other = other[np.lexsort([-other, probability[other]])]
        at, column = np.nonzero(sets[other] >= 0)
        best[of_record[sets[other[at], column]]] = other[at]
        return best


def says_velocity(covariance: FloatArray, region: FloatArray) -> BoolArray:
    """(n,) whether velocities are known better than those of any objects of the region."""
    return np.asarray((covariance[:, 2, 2] < UNSAID * region[2, 2]) & (covariance[:, 3, 3] < UNSAID * region[3, 3]))

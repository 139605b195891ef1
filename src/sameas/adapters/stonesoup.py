"""Stone Soup's track-to-track association by :func:`sameas.identify_many`.

``SameasAssociator().associate_tracks(radar_tracks, ais_tracks, ...)`` takes any number of sets of tracks, each with
states at its own times, predicts all to one instant, and returns Stone Soup's ``AssociationSet``: the most probable
hypothesis, at most one track of each set in an association, and the probability of each association.

Needs ``pip install sameas[stonesoup]``.
"""

from __future__ import annotations

import datetime
from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
from stonesoup.base import Property  # without types, as all of Stone Soup
from stonesoup.dataassociator.base import TrackToTrackAssociator
from stonesoup.predictor.base import Predictor
from stonesoup.types.association import AssociationSet, SingleTimeAssociation
from stonesoup.types.state import State
from stonesoup.types.track import Track

from sameas.errors import InputError
from sameas.evidence import CloseObjects
from sameas.evidence.close import estimate_reach
from sameas.many.identify import identify_many
from sameas.many.objects import Objects
from sameas.many.rules import MissedObjects
from sameas.records import Records


class ProbableAssociation(SingleTimeAssociation):  # type: ignore[misc]
    """Tracks that are one object, at most one of each set, at an instant."""

    probability: float = Property(doc="Probability that exactly these tracks of all sets are one object.")


class SameasAssociator(TrackToTrackAssociator):  # type: ignore[misc]
    """Associate the tracks of two sets or more, one to one, by the most probable hypothesis of all together.

    States are compared at one instant: that of the latest state of all, or ``timestamp``. A track
    whose last state up to it is older is predicted to it, its covariance growing by the predictor's process noise. No
    threshold is set: a track has no partner where that is the more probable, given both covariances, how often a set
    misses an object and how near two objects can be.

    The tracks' errors are taken as independent, and free of offsets between the sets (``sameas.register`` finds those).
    """

    mapping: Sequence[int] = Property(
        doc="Components of the state vector that are positions, in the order of all sets."
    )
    predictor: Predictor | Sequence[Predictor] = Property(
        default=None, doc="Takes states to one instant; one for all sets, or one for each. Needed if times differ."
    )
    missed: float | Sequence[float] = Property(
        default=0.1, doc="Probability that a set has no track of an object; one for all, or one for each."
    )
    nearest: float = Property(default=None, doc="No two objects are nearer, in units of the position; None: from σ.")
    reach: float = Property(
        default=None, doc="Neighbours are no farther, in units of the position; None: measured from the tracks."
    )

    def associate_tracks(
        self, *tracks_sets: Collection[Track], timestamp: datetime.datetime | None = None
    ) -> AssociationSet:
        """Associate sets of tracks.

        Parameters
        ----------
        tracks_sets : sets of :class:`~stonesoup.types.track.Track` with Gaussian states.
        timestamp : the instant; that of the latest state of all if not given.

        Returns
        -------
        AssociationSet of :class:`ProbableAssociation`, each of two tracks or more.

        Raises
        ------
        InputError : fewer than two sets; times that differ without a predictor; states without covariance; neighbours
            that cannot be measured.
        """
        if len(tracks_sets) < 2:
            raise InputError("associate_tracks: give two sets of tracks or more")
        ordered = [sorted(tracks, key=lambda track: track.id) for tracks in tracks_sets]
        if not any(ordered):
            return AssociationSet()
        instant = timestamp or max(track[-1].timestamp for tracks in ordered for track in tracks)
        kept: list[list[Track]] = []
        sources: list[Records] = []
        for number, tracks in enumerate(ordered):
            present = [(track, state) for track in tracks if (state := _state_at(track, instant)) is not None]
            kept.append([track for track, _ in present])
            sources.append(self._records([state for _, state in present], number, instant))
        if sum(map(bool, kept)) < 2:
            return AssociationSet()
        return AssociationSet(_associations(self.objects(sources), kept, instant))

    def objects(self, sources: Sequence[Records]) -> Objects:
        """The complete result for the sets' positions at one instant, of which ``associate_tracks`` gives a part."""
        return identify_many(sources, rule=self._rule(sources), prior=MissedObjects(self.missed))

    def _records(self, states: Sequence[State], number: int, instant: datetime.datetime) -> Records:
        """Positions and covariances of a set at the instant."""
        components, name = list(self.mapping), f"set {number + 1}"
        means, covariances = np.empty((len(states), len(components))), np.empty((len(states), *[len(components)] * 2))
        for k, state in enumerate(states):
            moved = self._predicted(state, number, instant)
            if getattr(moved, "covar", None) is None:
                raise InputError(
                    f"{name}: a {type(state).__name__} has no covariance", "give tracks of Gaussian states"
                )
            means[k] = np.asarray(moved.mean, np.float64)[components, 0]
            covariances[k] = np.asarray(moved.covar, np.float64)[np.ix_(components, components)]
        return Records.of(means, covariance=covariances, source=name)

    def _predicted(self, state: State, number: int, instant: datetime.datetime) -> Any:
        if state.timestamp == instant:
            return state
        if self.predictor is None:
            raise InputError(
                f"set {number + 1} has a state of {state.timestamp}, the instant is {instant}",
                "give a predictor, which takes states from one to the other",
            )
        predictor = self.predictor[number] if isinstance(self.predictor, Sequence) else self.predictor
        return predictor.predict(state, timestamp=instant)

    def _rule(self, sources: Sequence[Records]) -> CloseObjects:
        if self.nearest is not None and self.reach is not None:
            return CloseObjects(self.nearest, self.reach)
        first, second = sorted(sources, key=len)[-2:]
        spacing = estimate_reach(first, second)
        a = spacing.a if self.nearest is None else np.full(len(spacing.a), self.nearest)
        b = spacing.b if self.reach is None else np.full(len(spacing.b), self.reach)
        return CloseObjects(tuple(a), tuple(np.maximum(b, a)))


def _state_at(track: Track, instant: datetime.datetime) -> State | None:
    """The track's last state up to the instant; None for a track that begins later."""
    return next((state for state in reversed(track.states) if state.timestamp <= instant), None)


def _associations(
    objects: Objects, tracks: Sequence[Sequence[Track]], instant: datetime.datetime
) -> set[ProbableAssociation]:
    """An association for each object with tracks of two or more sets."""
    associations = set()
    for members, probability in zip(objects.members, objects.probability, strict=True):
        rows = [(number, int(row)) for number, row in enumerate(members) if row is not np.ma.masked]
        if len(rows) > 1:
            together = {tracks[number][row] for number, row in rows}
            associations.add(ProbableAssociation(together, timestamp=instant, probability=float(probability)))
    return associations

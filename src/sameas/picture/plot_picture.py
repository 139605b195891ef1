"""The picture of plots without ids: for scenes in which no source has ids, tracked from scan to scan.

:class:`PlotPicture` takes the place of :class:`sameas.picture.Watch` for scenes of plots and directions without ids. It
processes all scans between the instants of the picture, since objects are tracked from scan to scan
(:mod:`sameas.picture.plot_tracker`), and gives the :class:`~sameas.picture.picture_state.PictureState` of each instant:

    state = picture.at(scene, instant_s)
    picture = state.watch

An object is confirmed once it is certainly real (:class:`Confirmation`), coasts while no scan detects it, and ends when
it is too improbable or too uncertain. An unconfirmed object is in the picture while a scan detects it.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import logit

from sameas.arrays import ABSENT, IntArray
from sameas.errors import InputError
from sameas.evidence.identity import NAMING
from sameas.picture.bernoulli import MIN_PROBABILITY
from sameas.picture.picture_state import PictureState, TrackedObjects, has_velocity
from sameas.picture.plot_existence import still_unseen
from sameas.picture.plot_tracker import PlotTracker, TrackedPlots
from sameas.picture.tables import COASTING, CONFIRMED, TENTATIVE, PictureObjects, Scan
from sameas.picture.texts import RecordTexts, texts_of
from sameas.picture.tuning import Tuning
from sameas.tracks.feed import Feed, walk_of
from sameas.tracks.scans import joint_times
from sameas.tracks.scene import POSITION_AND_VELOCITY, Instant, Scene

JOINT_SCAN_SHARE = 0.2  # scans within this share of the shortest period are processed together
CONFIRMING_PLOTS = 3  # a tracked object is confirmed only with at least this many plots


def nameless(scene: Scene) -> bool:
    """Whether no source of a scene has ids or names."""
    return all(feed.reports.track is None and feed.attributes.keys().isdisjoint(NAMING) for feed in scene.feeds)


def scan_times_between(feeds: Sequence[Feed], after_s: float, until_s: float) -> list[float]:
    """The times of scans of any source between two times (exclusive), ascending.

    Scans within ``JOINT_SCAN_SHARE`` of the shortest period count as one, at the time of the last: no source scans
    twice in that time.
    """
    times_s = np.unique(np.concatenate([np.empty(0), *(feed.scan_times_s for feed in feeds)]))
    gap_s = JOINT_SCAN_SHARE * min((feed.scan_period_s for feed in feeds), default=math.inf)
    return joint_times(times_s[(times_s > after_s) & (times_s < until_s)], gap_s)


@dataclass(frozen=True)
class PlotObjects(PictureObjects):
    """Detected objects, and confirmed objects that no scan detects now."""

    @classmethod
    def of(cls, detections: TrackedObjects, confirmed: frozenset[int]) -> PlotObjects:
        """The detected objects, and those whose numbers are ``confirmed``."""
        tracks = detections.tracks
        detection = np.full(len(tracks), ABSENT)
        detection[detections.which] = np.arange(len(detections.which))
        placed, moving = (np.ones(len(tracks), bool), has_velocity(tracks.covariance, tracks.now.region.covariance))
        placed[detections.which], moving[detections.which] = detections.states.placed, detections.states.moving
        is_confirmed = np.isin(tracks.number, np.array(sorted(confirmed), np.int64))
        stage = np.where(is_confirmed, np.where(detection >= 0, CONFIRMED, COASTING), TENTATIVE)
        objects = cls(tracks.number, tracks.state, tracks.covariance, stage, placed, moving, detection)
        in_picture = np.flatnonzero((detection >= 0) | is_confirmed)
        return objects.take(in_picture[np.argsort(tracks.number[in_picture])])

    def not_in(self, numbers: IntArray) -> PlotObjects:
        """The confirmed objects whose numbers are not among these."""
        confirmed = (self.stage == CONFIRMED) | (self.stage == COASTING)
        return self.take(np.flatnonzero(confirmed & ~np.isin(self.number, numbers)))


@dataclass(frozen=True)
class Confirmation:
    """Which of the tracked objects are confirmed as real.

    The tracker assumes the same density of unknown objects at each scan. After some scans most objects are tracked, so
    fewer of the new ones are real: only the share u of objects that was never detected. With Q the probability that all
    completed scans missed an object, and λ the mean time that objects exist,

        u ← u Q e^{−Δt/λ} + 1 − e^{−Δt/λ},    u = 1 at first,

    and an object is confirmed once the odds of its existence, times u at its first detection, reach those of ``real``;
    an object with a prior also needs ``CONFIRMING_PLOTS`` plots.

    unseen_share : u. share : by number, u at the first detection. plots : by number, the count of plots. confirmed :
    numbers.
    """

    unseen_share: float = 1.0
    share: Mapping[int, float] = field(default_factory=dict)
    plots: Mapping[int, int] = field(default_factory=dict)
    confirmed: frozenset[int] = frozenset()

    def advance(self, before: TrackedPlots | None, after: TrackedPlots, lifetime_s: float, real: float) -> Confirmation:
        """The confirmation after the scans of ``after``."""
        unseen_share, last = self.unseen_share, {} if before is None else before.last_number
        if before is not None:
            now = after.now
            nowhere = np.empty((0, 2))
            q = np.array([feed.mean_q(nowhere, now.instant_s) for feed in now.feeds])
            p_missed, elapsed_s = float(np.prod(q ** before.scans_over(now))), now.instant_s - before.now.instant_s
            unseen_share = still_unseen(unseen_share, p_missed, elapsed_s, lifetime_s)
        new_plots = Counter(number for plot, number in after.last_number.items() if plot not in last)
        numbers = after.number.tolist()
        share = {number: self.share.get(number, unseen_share) for number in numbers}
        plots = {number: self.plots.get(number, 0) + new_plots[number] for number in numbers}
        least = MIN_PROBABILITY
        odds = logit(np.clip(after.existence, least, 1.0 - least)) + np.log([share[number] for number in numbers])
        enough_plots = (after.prior_of < 0) | (
            np.array([plots[number] for number in numbers], np.int64) >= CONFIRMING_PLOTS
        )
        newly_confirmed = after.number[(odds >= logit(real)) & enough_plots].tolist()
        return Confirmation(unseen_share, share, plots, (self.confirmed | set(newly_confirmed)) & set(numbers))


@dataclass(frozen=True)
class PlotPicture:
    """The state of a picture of plots without ids, from scan to scan; start with ``PlotPicture()``.

    Parameters
    ----------
    tracker : of its objects.
    real : an object is confirmed at this probability of existence; at most 1 − real of the confirmed ones are false.
    tracks, confirmation, objects, last_s : the tracked objects, which of them are confirmed, and the objects and the
        time of the last instant; updated from instant to instant. texts : by number of the object, the codes of its
        transponder and what else its plots say of it.
    """

    tracker: PlotTracker = field(default_factory=PlotTracker)
    real: float = 0.99
    tracks: TrackedPlots | None = None
    confirmation: Confirmation = field(default_factory=Confirmation)
    objects: PlotObjects = field(default_factory=PlotObjects)
    last_s: float = -math.inf
    texts: Mapping[int, NDArray[Any]] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        if not 0.0 < self.real < 1.0:
            raise InputError(f"PlotPicture: real is {self.real}; give a probability between 0 and 1")

    @property
    def tuning(self) -> Tuning:
        """Of its tracker."""
        return self.tracker.tuning

    def at(self, scene: Scene, instant_s: float) -> PictureState[PlotPicture]:
        """The picture at an instant not before the previous one, from all scans since; at the first instant, from the
        scans of one ``lifetime_s``.

        Raises
        ------
        InputError : the instant is before the previous one; a source has ids.
        """
        carried = self
        since = instant_s - self.tracker.lifetime_s if self.tracks is None else self.tracks.now.instant_s
        for scan_s in scan_times_between(scene.feeds, since, instant_s):
            carried = carried.updated(scene.at(scan_s, features=POSITION_AND_VELOCITY))
        return carried.advance(scene.at(instant_s, features=POSITION_AND_VELOCITY))

    def updated(self, now: Instant) -> PlotPicture:
        """The state after the scans of a later instant."""
        tracks = self.tracker.advance(now, self.tracks)
        confirmation = self.confirmation.advance(self.tracks, tracks, self.tracker.lifetime_s, self.real)
        return replace(self, tracks=tracks, confirmation=confirmation)

    def advance(self, now: Instant) -> PictureState[PlotPicture]:
        """The picture at an instant with velocities, without scans between it and the previous one."""
        updated = self.updated(now)
        assert updated.tracks is not None
        scan = Scan.of(now.with_records(), self.tuning)
        detections = TrackedObjects(scan, updated.tracks)
        objects = PlotObjects.of(detections, updated.confirmation.confirmed)
        if len(self.objects):
            walk = max(walk_of(description) for description in now.descriptions)
            ended = self.objects.not_in(updated.tracks.number)
            objects = objects.with_ends(ended, now.instant_s - self.last_s, walk)
        texts = RecordTexts.of(scan, detections.members, texts_of(scan), objects).of_objects(objects, self.texts)
        carried = replace(updated, objects=objects, last_s=now.instant_s, texts=texts)
        return PictureState(now, scan, detections, detections.states, carried)

"""The picture of plots: where no source names what it shows, carried from scan to scan.

:class:`PlotPicture` is for scenes of bare plots and directions what :class:`sameas.picture.Watch` is for all others. It
goes through every look between the instants that are asked for, since an object is found again from one look to the
next (:mod:`sameas.picture.plot_tracker`), and gives the :class:`~sameas.picture.picture_state.PictureState` of each:

    state = picture.at(scene, instant_s)
    picture = state.watch

An object is confirmed once it is real beyond doubt (:class:`Proof`), is coasting while no look shows it, and ends when
it is forgotten or could be anyone. What has not been confirmed is in the picture while a look shows it.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import logit

from sameas.arrays import IntArray
from sameas.errors import InputError
from sameas.picture.bernoulli import LEAST
from sameas.picture.instant_objects import TrackedObjects, says_velocity
from sameas.picture.object_table import COASTING, CONFIRMED, ENDED, TENTATIVE, PictureObjects
from sameas.picture.picture_state import PictureState
from sameas.picture.plot_tracker import PlotTracker, TrackedPlots
from sameas.picture.scan import Scan
from sameas.picture.watch import NOTHING
from sameas.tracks.alignment import States
from sameas.tracks.feed import Feed, walk_of
from sameas.tracks.scene import POSITION_AND_VELOCITY, Instant, Scene

#: Looks that follow each other within this share of the shortest period are gone through at once.
TOGETHER = 0.2
#: What is remembered is confirmed at so many plots or more.
PLOTS = 3


def nameless(scene: Scene) -> bool:
    """Whether no source of a scene says anything of who its objects are, and one at least says where they are."""
    silent = all(feed.reports.track is None and not feed.attributes for feed in scene.feeds)
    return silent and any(isinstance(feed.reports, States) for feed in scene.feeds)


def looks_between(feeds: Sequence[Feed], after_s: float, until_s: float) -> list[float]:
    """When any source looked, after one time and before another, ascending; looks at nearly one time are one.

    Of looks within :data:`TOGETHER` of the shortest period the last: no source looks twice in that.
    """
    looked = np.unique(np.concatenate([np.empty(0), *(feed.scan_times_s for feed in feeds)]))
    apart_s = TOGETHER * min((_period_s(feed) for feed in feeds), default=math.inf)
    out: list[float] = []
    first = -math.inf
    for look_s in looked[(looked > after_s) & (looked < until_s)].tolist():
        if look_s - first > apart_s:
            out.append(look_s)
            first = look_s
        else:
            out[-1] = look_s
    return out


def _period_s(feed: Feed) -> float:
    if feed.rotation is not None:
        return feed.rotation.period_s
    return float(np.median(np.diff(feed.scan_times_s))) if len(feed.scan_times_s) > 1 else math.inf


@dataclass(frozen=True)
class PlotObjects(PictureObjects):
    """Objects that a scan shows, and those that are confirmed without."""

    @classmethod
    def of(cls, shown: TrackedObjects, sure: frozenset[int]) -> PlotObjects:
        """Of objects that a look shows, and of those that are ``sure``."""
        now = shown.tracks
        seen = np.full(len(now), -1)
        seen[shown.which] = np.arange(len(shown.which))
        placed, moving = np.ones(len(now), bool), says_velocity(now.covariance, now.now.region.covariance)
        placed[shown.which], moving[shown.which] = shown.states.placed, shown.states.moving
        real = np.isin(now.number, np.array(sorted(sure), np.int64))
        stage = np.where(real, np.where(seen >= 0, CONFIRMED, COASTING), TENTATIVE)
        whole = cls(now.number, now.state, now.covariance, stage, placed, moving, seen)
        kept = np.flatnonzero((seen >= 0) | real)
        return whole.take(kept[np.argsort(now.number[kept])])

    def with_ends(self, before: PlotObjects, there: IntArray, dt_s: float, walk_m2_per_s3: float) -> PlotObjects:
        """The same with those that were sure ``dt_s`` before and whose numbers are not among ``there`` any more."""
        over = ((before.stage == CONFIRMED) | (before.stage == COASTING)) & ~np.isin(before.number, there)
        if not over.any():
            return self
        gone = before.take(np.flatnonzero(over)).predicted(dt_s, walk_m2_per_s3)
        return self.in_order(gone.undetected(np.full(len(gone), ENDED)))


@dataclass(frozen=True)
class Proof:
    """Which of the objects followed are real beyond doubt.

    The tracker believes at every look anew that there are as many objects as ever of which nobody knows. After some
    looks most have been found: of those that a look discovers then fewer are real, by the share u that is still to be
    found. With Q the probability that all looks that stand no more missed an object, and λ how long objects last,

        u ← u Q e^{−Δt/λ} + 1 − e^{−Δt/λ},    u = 1 at first,

    and an object is sure once the odds of its existence, times the u of when it appeared, reach those of ``real``; one
    that is remembered only at :data:`PLOTS` plots: while a look stands, a memory made of others has been judged by it.

    unfound : u. share : by number u when it appeared. plots : by number how many have shown it. sure : numbers.
    """

    unfound: float = 1.0
    share: Mapping[int, float] = field(default_factory=dict)
    plots: Mapping[int, int] = field(default_factory=dict)
    sure: frozenset[int] = frozenset()

    def on(self, before: TrackedPlots | None, after: TrackedPlots, lifetime_s: float, real: float) -> Proof:
        """The proof after the looks of ``after``."""
        unfound, last = self.unfound, {} if before is None else before.last_number
        if before is not None:
            now = after.now
            nowhere = np.empty((0, 2))
            q = np.array([feed.mean_q(nowhere, now.instant_s) for feed in now.feeds])
            lasts = math.exp(-(now.instant_s - before.now.instant_s) / lifetime_s)
            unfound = unfound * float(np.prod(q ** before.passed(now))) * lasts + 1.0 - lasts
        fresh = Counter(number for plot, number in after.last_number.items() if plot not in last)
        numbers = after.number.tolist()
        share = {number: self.share.get(number, unfound) for number in numbers}
        plots = {number: self.plots.get(number, 0) + fresh[number] for number in numbers}
        odds = logit(np.clip(after.existence, LEAST, 1.0 - LEAST)) + np.log([share[number] for number in numbers])
        often = (after.known_of < 0) | (np.array([plots[number] for number in numbers], np.int64) >= PLOTS)
        proved = after.number[(odds >= logit(real)) & often].tolist()
        return Proof(unfound, share, plots, (self.sure | set(proved)) & set(numbers))


@dataclass(frozen=True)
class PlotPicture:
    """What a picture of bare plots carries from scan to scan; start with ``PlotPicture()``.

    Parameters
    ----------
    tracker : how objects are followed.
    real : an object is confirmed once it exists with this probability: of those at most 1 − real are false.
    tracks, proof, known, asked_s : what is followed, which of it is sure, the objects of the last instant that was
        asked for, and when that was; filled in on the way.
    """

    tracker: PlotTracker = field(default_factory=PlotTracker)
    real: float = 0.99
    tracks: TrackedPlots | None = None
    proof: Proof = field(default_factory=Proof)
    known: PlotObjects = field(default_factory=PlotObjects)
    asked_s: float = -math.inf

    def __post_init__(self) -> None:
        if not 0.0 < self.real < 1.0:
            raise InputError(f"PlotPicture: real is {self.real}; give a probability between 0 and 1")

    def at(self, scene: Scene, instant_s: float) -> PictureState[PlotPicture]:
        """The picture at an instant not before the last, through all looks since; the first after looks enough.

        Raises
        ------
        InputError : the instant is before the last; a source names its objects.
        """
        carried, longest = self, self.tracker.lifetime_s
        since = instant_s - longest if self.tracks is None else self.tracks.now.instant_s
        for look_s in looks_between(scene.feeds, since, instant_s):
            carried = carried.looked(scene.at(look_s, features=POSITION_AND_VELOCITY))
        return carried.advance(scene.at(instant_s, features=POSITION_AND_VELOCITY))

    def looked(self, now: Instant) -> PlotPicture:
        """The same after the looks of a later instant, which nobody asks to see."""
        tracks = self.tracker.advance(now, self.tracks)
        proof = self.proof.on(self.tracks, tracks, self.tracker.lifetime_s, self.real)
        return replace(self, tracks=tracks, proof=proof)

    def advance(self, now: Instant) -> PictureState[PlotPicture]:
        """The picture at an instant with velocities, where no look lies between it and the last."""
        after = self.looked(now)
        assert after.tracks is not None
        scan = Scan.of(now.with_records())
        shown = TrackedObjects(scan, after.tracks)
        known = PlotObjects.of(shown, after.proof.sure)
        if len(self.known):
            walk = max(walk_of(description) for description in now.descriptions)
            known = known.with_ends(self.known, after.tracks.number, now.instant_s - self.asked_s, walk)
        carried = replace(after, known=known, asked_s=now.instant_s)
        return PictureState(now, scan, shown, shown.states, carried)

    @cached_property
    def texts(self) -> Mapping[int, NDArray[Any]]:
        """Texts of the objects: nobody says any."""
        return dict.fromkeys(self.known.number.tolist(), NOTHING)

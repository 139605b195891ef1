"""Numbers: every object of the picture keeps its own from instant to instant.

The objects of an instant are identified with those known by :func:`sameas.identify`, one to one and all at once: by
where the known ones should be now, and by the tracks that they have in common (:mod:`sameas.picture.continuity`). So a
number never goes to another object while its own is there, and where two objects exchange a record, each keeps the
number that most speaks for.

An object is *tentative* when it appears, *confirmed* when it is there beyond doubt (:class:`Stages`), *coasting* while
nobody shows it and its place is foretold, and *ended* when it could be anyone: more than one other object is expected
within its own 1σ ellipse, or all its tracks are another's. Who comes back under a name that nobody else bears has the
number again.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.special import logit

from sameas._identify import identify
from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.errors import InputError
from sameas.gaussian import Gaussian, symmetric
from sameas.picture.continuity import Continuity, InCommon, Motions, NearOrNamed
from sameas.picture.named import found_in
from sameas.picture.object_states import ObjectStates
from sameas.picture.object_table import COASTING, CONFIRMED, ENDED, TENTATIVE, ColumnTable, PictureObjects
from sameas.ragged import ranges
from sameas.records import Records
from sameas.tracks.alignment import aged

#: τ of the shares of a track's history, seconds (chosen).
LASTS_S = 300.0
#: A smaller share is forgotten (chosen).
LEAST = 1e-3


@dataclass(frozen=True)
class TrackHistory(ColumnTable):
    """Tracks and objects that they have been of, (k,) each, by ascending track, then object.

    Where the records of one object part for an instant and come together again, its number comes back with the tracks
    that were its own for long: one wrong instant does not decide which object is which. A track that goes over to
    another object for good is that object's after some minutes. Shares change at the instants that show the track:
    s ← s e^(−Δt/τ), and 1 − e^(−Δt/τ) more for the object that it is of.

    track, number : of the track and the object. share : of the last minutes. last : whether it is the object that the
    track was of when it was last shown. unique : whether no other track has the track's name. instant_s : the last one.
    """

    WHOLE = frozenset({"instant_s"})
    instant_s: float = -math.inf
    track: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    number: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    share: FloatArray = field(default_factory=lambda: np.empty(0))
    last: BoolArray = field(default_factory=lambda: np.empty(0, bool))
    unique: BoolArray = field(default_factory=lambda: np.empty(0, bool))

    def __len__(self) -> int:
        return len(self.track)

    def on(
        self, instant_s: float, track: IntArray, number: IntArray, unique: BoolArray, alive: IntArray
    ) -> TrackHistory:
        """After a later instant.

        Parameters
        ----------
        track, number, unique : (m,) the tracks that it shows, the objects that they are of, whether nobody else bears
            their names.
        alive : ascending numbers of the objects that have not ended. Of those that have only names that nobody else
            bears are kept.
        """
        fade = math.exp(-(instant_s - self.instant_s) / LASTS_S) if len(self) else 0.0
        shown = np.isin(self.track, track)
        keep = (found_in(alive, self.number) >= 0) | (self.unique & self.last & ~shown)
        old = TrackHistory(
            instant_s, self.track, self.number, np.where(shown, fade * self.share, self.share), self.last & ~shown,
            self.unique,
        ).take(np.flatnonzero(keep & (~shown | (fade * self.share >= LEAST))))  # fmt: skip
        # Who was of nobody before is wholly of its first object.
        known = np.isin(track, old.track)
        more = TrackHistory(
            instant_s, track, number, np.where(known, 1.0 - fade, 1.0), np.ones(len(track), bool), unique
        )
        return old._with(more)

    def of(self, tracks: IntArray) -> tuple[IntArray, IntArray]:
        """(m,) places in ``tracks`` (k,) and (m,) rows here of everything that these tracks have been of."""
        low, high = (np.searchsorted(self.track, tracks, side) for side in ("left", "right"))
        return ranges(low, high - low)

    def last_of(self, tracks: IntArray) -> IntArray:
        """(k,) the object that each track was of when it was last shown, 0 for none."""
        out = np.zeros(len(tracks), np.int64)
        at, row = self.of(tracks)
        out[at[self.last[row]]] = self.number[row[self.last[row]]]
        return out

    def _with(self, more: TrackHistory) -> TrackHistory:
        """Rows of both, those of one track and object as one."""
        whole = self.stacked(more)
        key = np.column_stack([whole.track, whole.number])
        rows, back = np.unique(key, axis=0, return_inverse=True)
        back, n = back.reshape(-1), len(rows)
        share = np.asarray(np.bincount(back, whole.share, n), np.float64)
        last, unique = (np.bincount(back, column, n) > 0 for column in (whole.last, whole.unique))
        return TrackHistory(self.instant_s, rows[:, 0], rows[:, 1], share, last, unique)


#: What parted from an object is another once its tracks have been its own for this share of the last minutes (chosen).
OWN = 0.8


@dataclass(frozen=True)
class Stages:
    """When an object is confirmed: as soon as it is sure, or, where its records have no names, at ``scans`` scans among
    the first ``of`` instants.

    Sure is an object of two sources or more with at least the probability ``sure``; of a source without false records:
    what speaks is there; and of a named track that has lived so long that it is real with the probability ``real``
    (:mod:`sameas.picture.track_existence`): of those at most 1 − real are false. A tentative object that is missing at
    more than of − scans instants is dropped.
    """

    scans: int = 3
    of: int = 5
    sure: float = 0.95
    real: float = 0.99

    def __post_init__(self) -> None:
        if not (1 <= self.scans <= self.of and 0.0 < self.sure <= 1.0 and 0.0 < self.real < 1.0):
            raise InputError("Stages: give 1 ≤ scans ≤ of, and sure and real as probabilities")


@dataclass(frozen=True)
class Life:
    """Lives of tracks (n,): their numbers, −1 for none; ln of the odds that each was of something real when it began,
    and what its life has added since (:mod:`sameas.picture.track_existence`)."""

    track: IntArray
    begun: FloatArray
    lived: FloatArray


@dataclass(frozen=True)
class Detections:
    """The objects of an instant, (n,) each, before they have numbers.

    states : theirs. tracks : (n, S) numbers of their named tracks, −1 for none. unique : (n, S) whether nobody else
    bears that track's name. looked : whether a source looked at it anew. plotted : whether one did that names no
    tracks. sure : whether it is there beyond doubt. life : of that track of it which says most of that.
    walk_m2_per_s3, speed_m_per_s : how they move.
    """

    states: ObjectStates
    tracks: IntArray
    unique: BoolArray
    looked: BoolArray
    plotted: BoolArray
    sure: BoolArray
    life: Life
    walk_m2_per_s3: FloatArray
    speed_m_per_s: FloatArray

    def __len__(self) -> int:
        return len(self.looked)


@dataclass(frozen=True)
class KnownObjects(PictureObjects):
    """Objects that records name, (k,) each, with what is known of them besides.

    Attributes
    ----------
    instant_s : the instant. given : numbers given so far.
    looks, plots : instants with a new look at it, and with one of a source that names no tracks.
    longest, lived, earlier : its track that has lived longest, what that life says for its being real, and what the
        lives of those before say: ln of odds.
    absent : instants without a record of it while it was tentative.
    apart : whether it parted from an object that went on, and its tracks have not been its own for most of the time.
    walk_m2_per_s3, speed_m_per_s : how it moves.
    history : which of them tracks have been of.
    """

    WHOLE = frozenset({"instant_s", "given", "history"})
    instant_s: float = -np.inf
    given: int = 0
    looks: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    plots: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    longest: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    lived: FloatArray = field(default_factory=lambda: np.empty(0))
    earlier: FloatArray = field(default_factory=lambda: np.empty(0))
    absent: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    apart: BoolArray = field(default_factory=lambda: np.empty(0, bool))
    walk_m2_per_s3: FloatArray = field(default_factory=lambda: np.empty(0))
    speed_m_per_s: FloatArray = field(default_factory=lambda: np.empty(0))
    history: TrackHistory = field(default_factory=TrackHistory)

    def on(self, instant_s: float, detections: Detections, density_per_m2: float, stages: Stages) -> KnownObjects:
        """The objects at a later instant; ``density_per_m2``: of objects."""
        alive = self.take(np.flatnonzero(self.stage != ENDED))
        alive = alive.predicted(instant_s - self.instant_s, alive.walk_m2_per_s3)
        to = alive._same_as(detections, density_per_m2)
        known, new = np.flatnonzero(to >= 0), np.flatnonzero(to < 0)
        left = np.setdiff1d(np.arange(len(alive)), to[known])
        number = alive._numbers_of(detections, new)
        parts = [
            alive.take(to[known])._shown(detections, known, stages),
            KnownObjects._appeared(detections, new, number, alive._apart(detections, new), stages),
            alive.take(left)._unseen(detections, density_per_m2, stages),
        ]
        given = int(number.max(initial=self.given))
        return replace(parts[0].in_order(*parts[1:]), instant_s=instant_s, given=given)._owning(self, detections)

    def _same_as(self, detections: Detections, density_per_m2: float) -> IntArray:
        """(n,) which of these each object of the instant is, −1 for none."""
        out = np.full(len(detections), -1)
        if not len(detections) or not len(self):
            return out
        common = self._in_common(detections)
        before = Motions(self.state, self.covariance, self.speed_m_per_s)
        after = Motions(detections.states.state, detections.states.covariance, detections.speed_m_per_s)
        known, shown = (
            Records.of(one.state[:, :2], covariance=one.covariance[:, :2, :2], source=name)
            for one, name in ((before, "known"), (after, "seen"))
        )
        rule = Continuity(density_per_m2, common, before, after)
        matches = identify(known, shown, rule=rule, gate=NearOrNamed(common)).matches
        out[matches.rows_2] = matches.rows_1
        return out

    def _in_common(self, detections: Detections) -> InCommon:
        """What tracks say of these objects and those of the instant."""
        at, column = np.nonzero(detections.tracks >= 0)
        shown, row = self.history.of(detections.tracks[at, column])
        who = found_in(self.number, self.history.number[row])
        mine = who >= 0
        shown, row = shown[mine], row[mine]
        return InCommon.of(who[mine], at[shown], self.history.share[row], detections.unique[at, column][shown])

    def _numbers_of(self, detections: Detections, new: IntArray) -> IntArray:
        """(k,) the numbers of objects that none of these is: of one that ended, by a unique name, or new ones."""
        number = np.zeros(len(new), np.int64)
        for column in range(detections.tracks.shape[1]):
            before = np.where(detections.unique[new, column], self.history.last_of(detections.tracks[new, column]), 0)
            free = (before > 0) & (number == 0) & ~np.isin(before, self.number) & ~np.isin(before, number)
            _, first = np.unique(before, return_index=True)
            once = np.isin(np.arange(len(new)), first)
            number = np.where(free & once, before, number)
        fresh = number == 0
        number[fresh] = self.given + 1 + np.arange(np.count_nonzero(fresh))
        return number

    def _apart(self, detections: Detections, new: IntArray) -> BoolArray:
        """(k,) whether a new object has a track of one of these: it parted from that, and has to earn its number."""
        tracks = detections.tracks[new]
        owner = found_in(self.number, self.history.last_of(tracks.ravel())).reshape(tracks.shape)
        return np.asarray((owner >= 0).any(axis=1))

    def _shown(self, detections: Detections, which: IntArray, stages: Stages) -> KnownObjects:
        """These objects, as the objects ``which`` of the instant show them."""
        states, looked = detections.states, detections.looked[which]
        state, covariance = states.state[which], states.covariance[which]
        own, spread = _followed(self, state, covariance, looked)
        said = states.moving[which]
        looks, plots = self.looks + looked, self.plots + detections.plotted[which]
        # A track that went on under another name has said what it had to say; one that is still there says it itself.
        there = (self.longest[:, None] == detections.tracks[which]).any(axis=1)
        over = (self.longest != detections.life.track[which]) & ~there
        earlier = self.earlier + np.where(over, self.lived, 0.0)
        real = detections.life.begun[which] + earlier + detections.life.lived[which] >= logit(stages.real)
        apart = self.apart & (self._own_share(detections.tracks[which]) < OWN)
        sure = (self.stage != TENTATIVE) | ((detections.sure[which] | real) & ~apart) | (plots >= stages.scans)
        return replace(
            self, stage=np.where(sure, CONFIRMED, TENTATIVE), state=np.where(said[:, None], state, own),
            covariance=np.where(said[:, None, None], covariance, spread), placed=states.placed[which],
            moving=said | (self.placed & states.placed[which] & (looks > 1)), detection=which, looks=looks, plots=plots,
            apart=apart, longest=detections.life.track[which], lived=detections.life.lived[which], earlier=earlier,
            walk_m2_per_s3=detections.walk_m2_per_s3[which], speed_m_per_s=detections.speed_m_per_s[which],
        )  # fmt: skip

    def _own_share(self, tracks: IntArray) -> FloatArray:
        """(k,) for what share of the last minutes any of its tracks (k, S) has been of each of these objects."""
        out = np.zeros(len(self))
        at, row = self.history.of(tracks.ravel())
        at //= max(tracks.shape[1], 1)
        mine = self.history.number[row] == self.number[at]
        np.maximum.at(out, at[mine], self.history.share[row[mine]])
        return out

    @classmethod
    def _appeared(
        cls, detections: Detections, which: IntArray, number: IntArray, apart: BoolArray, stages: Stages
    ) -> KnownObjects:
        """Objects that nobody knew, or that have ended, and their numbers; ``apart``: from one that goes on."""
        n, states = len(which), detections.states
        real = detections.life.begun[which] + detections.life.lived[which] >= logit(stages.real)
        sure = ((detections.sure[which] | real) & ~apart) | (stages.scans <= 1)
        return cls(
            number=number, stage=np.where(sure, CONFIRMED, TENTATIVE), state=states.state[which],
            covariance=states.covariance[which], placed=states.placed[which], moving=states.moving[which],
            detection=which, looks=np.ones(n, np.int64), plots=detections.plotted[which].astype(np.int64),
            absent=np.zeros(n, np.int64), apart=apart,
            longest=detections.life.track[which], lived=detections.life.lived[which], earlier=np.zeros(n),
            walk_m2_per_s3=detections.walk_m2_per_s3[which], speed_m_per_s=detections.speed_m_per_s[which],
        )  # fmt: skip

    def _unseen(self, detections: Detections, density_per_m2: float, stages: Stages) -> KnownObjects:
        """These objects, which nobody shows."""
        tentative = self.stage == TENTATIVE
        absent = self.absent + (tentative & bool(detections.looked.any()))
        old = aged(self.covariance, density_per_m2)
        # Whose tracks are all another object's now was one with it.
        own = self.history.take(np.flatnonzero(self.history.last))
        there = np.isin(own.track, detections.tracks)
        taken = np.isin(self.number, own.number[there]) & ~np.isin(self.number, own.number[~there])
        over = old | taken | (tentative & (absent > stages.of - stages.scans))
        stage = np.where(over, ENDED, np.where(tentative, TENTATIVE, COASTING))
        return replace(self.undetected(stage), absent=absent)

    def _owning(self, before: KnownObjects, detections: Detections) -> KnownObjects:
        """The same with whom the tracks of the instant are of."""
        there = detections.tracks >= 0
        number, alive = self.numbers(len(detections))[np.nonzero(there)[0]], self.number[self.stage != ENDED]
        after = before.history.on(self.instant_s, detections.tracks[there], number, detections.unique[there], alive)
        return replace(self, history=after)


def _followed(
    known: KnownObjects, state: FloatArray, covariance: FloatArray, looked: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """States of objects of which only positions are known: foretold, and corrected by a new look at them."""
    own = Gaussian(known.state, known.covariance).updated(Gaussian(state[:, :2], covariance[:, :2, :2]))
    spread = np.where(looked[:, None, None], own.covariance, known.covariance)
    return np.where(looked[:, None], own.mean, known.state), symmetric(spread)

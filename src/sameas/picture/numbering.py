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

from dataclasses import dataclass, field, fields, replace

import numpy as np

from sameas.errors import InputError
from sameas.identify import identify
from sameas.picture.continuity import Continuity, InCommon, NearOrNamed
from sameas.picture.named import found_in
from sameas.picture.roll import BoolArray
from sameas.picture.states import ObjectStates
from sameas.records import FloatArray, IntArray, Records
from sameas.tracks.alignment import aged, moved

TENTATIVE, CONFIRMED, COASTING, ENDED = range(4)
STAGES = ("tentative", "confirmed", "coasting", "ended")


@dataclass(frozen=True)
class Stages:
    """When an object is confirmed: at ``looks`` looks among the first ``of`` instants, or at once if it is sure.

    Sure is an object of two sources or more with at least the probability ``sure``, or of a source without false
    records: what speaks is there. A tentative object that is missing at more than of − looks instants is dropped.
    """

    looks: int = 3
    of: int = 5
    sure: float = 0.95

    def __post_init__(self) -> None:
        if not (1 <= self.looks <= self.of and 0.0 < self.sure <= 1.0):
            raise InputError("Stages: give 1 ≤ looks ≤ of, and sure as a probability")


@dataclass(frozen=True)
class Seen:
    """The objects of an instant, (n,) each, before they have numbers.

    states : theirs. tracks : (n, S) numbers of their named tracks, −1 for none. unique : (n, S) whether nobody else
    bears that track's name. looked : whether a source looked at it anew. sure : whether it is there beyond doubt.
    walk_m2_per_s3, speed_m_per_s : how they move.
    """

    states: ObjectStates
    tracks: IntArray
    unique: BoolArray
    looked: BoolArray
    sure: BoolArray
    walk_m2_per_s3: FloatArray
    speed_m_per_s: FloatArray

    def __len__(self) -> int:
        return len(self.looked)


@dataclass(frozen=True)
class Known:
    """The objects of the picture at an instant, (k,) each, by ascending number; those that end are in it once more.

    Attributes
    ----------
    instant_s : the instant. given : numbers given so far.
    number : from 1. stage : place in :data:`STAGES`.
    state, covariance : (k, 4), (k, 4, 4) of position and velocity. placed : whether the position is known.
    moving : whether the velocity is known, said by a record or from the object's own positions.
    seen : (k,) which object of the instant it is, −1 where nobody shows it.
    looks, absent : instants with a new look of it, and without a record of it while it was tentative.
    walk_m2_per_s3, speed_m_per_s : how it moves.
    track, owner, unique : (t,) numbers of tracks, ascending, of the objects that they belonged to last, and whether
        nobody else bears their names.
    """

    instant_s: float = -np.inf
    given: int = 0
    number: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    stage: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    state: FloatArray = field(default_factory=lambda: np.empty((0, 4)))
    covariance: FloatArray = field(default_factory=lambda: np.empty((0, 4, 4)))
    placed: BoolArray = field(default_factory=lambda: np.empty(0, bool))
    moving: BoolArray = field(default_factory=lambda: np.empty(0, bool))
    seen: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    looks: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    absent: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    walk_m2_per_s3: FloatArray = field(default_factory=lambda: np.empty(0))
    speed_m_per_s: FloatArray = field(default_factory=lambda: np.empty(0))
    track: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    owner: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    unique: BoolArray = field(default_factory=lambda: np.empty(0, bool))

    def __len__(self) -> int:
        return len(self.number)

    def on(self, instant_s: float, seen: Seen, density_per_m2: float, stages: Stages) -> Known:
        """The objects at a later instant; ``density_per_m2``: of objects."""
        alive = self.take(np.flatnonzero(self.stage != ENDED))._foretold(instant_s)
        to = alive._same_as(seen, density_per_m2)
        known, new = np.flatnonzero(to >= 0), np.flatnonzero(to < 0)
        left = np.setdiff1d(np.arange(len(alive)), to[known])
        number = alive._numbers_of(seen, new)
        parts = [
            alive.take(to[known])._shown(seen, known, stages),
            Known._appeared(seen, new, number, stages),
            alive.take(left)._unseen(seen, density_per_m2, stages),
        ]
        return parts[0]._joined(parts[1:], instant_s, int(number.max(initial=self.given)))._owning(self, seen)

    def take(self, which: IntArray) -> Known:
        """Some of the objects."""
        return replace(self, **{name: getattr(self, name)[which] for name in _COLUMNS})  # type: ignore[arg-type]

    def numbers(self, n_seen: int) -> IntArray:
        """(n,) the number of each object of the instant."""
        out = np.zeros(n_seen, np.int64)
        here = self.seen >= 0
        out[self.seen[here]] = self.number[here]
        return out

    def _foretold(self, instant_s: float) -> Known:
        """Where the objects should be at a later instant."""
        if not len(self):
            return self
        state, covariance = moved(self.state, self.covariance, instant_s - self.instant_s, self.walk_m2_per_s3)
        return replace(self, state=state, covariance=covariance)

    def _same_as(self, seen: Seen, density_per_m2: float) -> IntArray:
        """(n,) which of these each object of the instant is, −1 for none."""
        out = np.full(len(seen), -1)
        if not len(seen) or not len(self):
            return out
        at, column = np.nonzero(seen.tracks >= 0)
        who = found_in(self.number, self._owner_of(seen.tracks[at, column]))
        mine = who >= 0
        common = InCommon.of(who[mine], at[mine], seen.unique[at, column][mine].astype(np.float64))
        here, there = (slice(None), slice(0, 2)), (slice(None), slice(0, 2), slice(0, 2))
        known = Records.of(self.state[here], covariance=self.covariance[there], source="known")
        shown = Records.of(seen.states.state[here], covariance=seen.states.covariance[there], source="seen")
        matches = identify(known, shown, rule=Continuity(density_per_m2, common), gate=NearOrNamed(common)).matches
        out[matches.rows_2] = matches.rows_1
        return out

    def _owner_of(self, track: IntArray) -> IntArray:
        """(k,) the object that each track belonged to last, 0 for none."""
        at = found_in(self.track, track)
        return np.where(at >= 0, np.append(self.owner, 0)[at], 0)

    def _numbers_of(self, seen: Seen, new: IntArray) -> IntArray:
        """(k,) the numbers of objects that none of these is: of one that ended, by a unique name, or new ones."""
        number = np.zeros(len(new), np.int64)
        for column in range(seen.tracks.shape[1]):
            before = np.where(seen.unique[new, column], self._owner_of(seen.tracks[new, column]), 0)
            free = (before > 0) & (number == 0) & ~np.isin(before, self.number) & ~np.isin(before, number)
            _, first = np.unique(before, return_index=True)
            once = np.isin(np.arange(len(new)), first)
            number = np.where(free & once, before, number)
        fresh = number == 0
        number[fresh] = self.given + 1 + np.arange(np.count_nonzero(fresh))
        return number

    def _shown(self, seen: Seen, which: IntArray, stages: Stages) -> Known:
        """These objects, as the objects ``which`` of the instant show them."""
        states, looked = seen.states, seen.looked[which]
        state, covariance = states.state[which], states.covariance[which]
        own, spread = _followed(self, state, covariance, looked)
        said = states.moving[which]
        looks = self.looks + looked
        sure = (self.stage != TENTATIVE) | seen.sure[which] | (looks >= stages.looks)
        return replace(
            self, stage=np.where(sure, CONFIRMED, TENTATIVE), state=np.where(said[:, None], state, own),
            covariance=np.where(said[:, None, None], covariance, spread), placed=states.placed[which],
            moving=said | (self.placed & states.placed[which] & (looks > 1)), seen=which, looks=looks,
            walk_m2_per_s3=seen.walk_m2_per_s3[which], speed_m_per_s=seen.speed_m_per_s[which],
        )  # fmt: skip

    @classmethod
    def _appeared(cls, seen: Seen, which: IntArray, number: IntArray, stages: Stages) -> Known:
        """Objects that nobody knew, or that have ended, and their numbers."""
        n, states = len(which), seen.states
        sure = seen.sure[which] | (stages.looks <= 1)
        return cls(
            number=number, stage=np.where(sure, CONFIRMED, TENTATIVE), state=states.state[which],
            covariance=states.covariance[which], placed=states.placed[which], moving=states.moving[which], seen=which,
            looks=np.ones(n, np.int64), absent=np.zeros(n, np.int64), walk_m2_per_s3=seen.walk_m2_per_s3[which],
            speed_m_per_s=seen.speed_m_per_s[which],
        )  # fmt: skip

    def _unseen(self, seen: Seen, density_per_m2: float, stages: Stages) -> Known:
        """These objects, which nobody shows."""
        tentative = self.stage == TENTATIVE
        absent = self.absent + (tentative & bool(seen.looked.any()))
        old = aged(self.covariance, density_per_m2)
        # Whose tracks are all another object's now was one with it.
        there = np.isin(self.track, seen.tracks)
        taken = np.isin(self.number, self.owner[there]) & ~np.isin(self.number, self.owner[~there])
        over = old | taken | (tentative & (absent > stages.of - stages.looks))
        stage = np.where(over, ENDED, np.where(tentative, TENTATIVE, COASTING))
        return replace(self, stage=stage, absent=absent, seen=np.full(len(self), -1))

    def _joined(self, others: list[Known], instant_s: float, given: int) -> Known:
        whole = {name: np.concatenate([getattr(part, name) for part in (self, *others)]) for name in _COLUMNS}
        order = np.argsort(whole["number"])
        columns = {name: column[order] for name, column in whole.items()}
        return Known(instant_s, given, **columns)

    def _owning(self, before: Known, seen: Seen) -> Known:
        """The same with the tracks of the objects of the instant; other tracks stay with whom they were last.

        Of those who have ended only names that nobody else bears are kept.
        """
        there = seen.tracks >= 0
        track, unique = seen.tracks[there], seen.unique[there]
        owner = self.numbers(len(seen))[np.nonzero(there)[0]]
        alive = np.isin(before.owner, self.number[self.stage != ENDED])
        stay = ~np.isin(before.track, track) & (alive | before.unique)
        columns = ((before.track, track), (before.owner, owner), (before.unique, unique))
        track, owner, unique = (np.concatenate([old[stay], new]) for old, new in columns)
        order = np.argsort(track)
        return replace(self, track=track[order], owner=owner[order], unique=unique[order])


_COLUMNS = tuple(f.name for f in fields(Known) if f.name not in ("instant_s", "given", "track", "owner", "unique"))


def _followed(
    known: Known, state: FloatArray, covariance: FloatArray, looked: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """States of objects of which only positions are known: foretold, and corrected by a new look at them."""
    innovation, r = state[:, :2] - known.state[:, :2], covariance[:, :2, :2]
    total = known.covariance[:, :2, :2] + r
    gain = known.covariance[:, :, :2] @ np.linalg.inv(total)
    own = known.state + np.einsum("kvw,kw->kv", gain, innovation)
    spread = known.covariance - gain @ known.covariance[:, :2, :]
    own = np.where(looked[:, None], own, known.state)
    spread = np.where(looked[:, None, None], spread, known.covariance)
    return own, 0.5 * (spread + spread.transpose(0, 2, 1))

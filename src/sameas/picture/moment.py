"""A moment: the picture at one instant, and what it hands on to the next.

:class:`Watch` is what a picture carries along: what it remembers of tracks, the objects it knows, and their texts.
:meth:`Watch.advance` takes it to an instant and gives the :class:`Moment`; for live use call it instant by instant,

    moment = watch.advance(scene.at(t))
    watch = moment.watch

:class:`sameas.picture.Picture` does so for a whole span. Nothing that was fused comes back as evidence: a moment
without memory is what ``identify_many`` says of that instant, and memory counts every look once.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sameas.belief import PoissonObjects, SetRule
from sameas.errors import InputError
from sameas.evidence.identity import Alarm
from sameas.gate import ChiSquare
from sameas.many import identify_many
from sameas.objects import Objects
from sameas.observations import records_of
from sameas.picture.hysteresis import BOUND, held
from sameas.picture.memory import Past
from sameas.picture.named import found_in
from sameas.picture.numbering import Known, Life, Seen, Stages
from sameas.picture.roll import BoolArray, Roll
from sameas.picture.shown import Shown, ShownNow
from sameas.picture.states import ObjectStates, object_states
from sameas.reasons import Name, Reasons
from sameas.records import FloatArray, IntArray, Records
from sameas.tracks.scene import POSITION, Instant
from sameas.union import Union

if TYPE_CHECKING:
    from sameas.picture.lookout import Followed, Lookout

#: What the picture says of an object's identity; and what of it names one object alone.
TEXTS = ("mmsi", "icao", "callsign", "name", "mode_a", "type")
NAMES_ONE = ("mmsi", "icao", "callsign")
#: What is said of an object of which nobody says anything.
NOTHING = np.full(len(TEXTS), "", dtype=object)
#: An object is ambiguous where its records are less probable than this.
CERTAIN = 0.95

#: Why an object is shown that is not in the most probable answer.
STAYS = "it stays what it was until something else is much more probable"

#: What an instant and the past say of the records.
Say = Callable[[Instant, Past], SetRule]


def all_that_is_said(now: Instant, past: Past) -> SetRule:
    """Positions, misses and clutter as described, what records say of their identities, and what tracks did before."""
    return now.belief() + now.identity() + past.rule()


@dataclass(frozen=True)
class Watch:
    """What a picture carries from instant to instant; start with ``Watch()``.

    Parameters
    ----------
    say : what counts as evidence. ``lambda now, past: now.belief() + past.rule()`` leaves identities out,
        ``lambda now, past: now.belief() + now.identity()`` judges every instant alone.
    past : what is remembered of tracks; give one to change how long their errors last.
    bound : of the odds at which records change their company (:mod:`sameas.picture.hysteresis`); 1 for the most
        probable answer of every instant, whatever was shown before.
    stages : when objects are confirmed. gate : of ``identify_many``.
    known, called : objects and their texts; filled in from instant to instant.
    """

    say: Say = all_that_is_said
    past: Past = field(default_factory=Past)
    bound: float = BOUND
    stages: Stages = field(default_factory=Stages)
    gate: ChiSquare = field(default_factory=ChiSquare)
    known: Known = field(default_factory=Known)
    called: Mapping[int, NDArray[Any]] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        if not 1.0 <= self.bound < math.inf:
            raise InputError(f"Watch: bound is {self.bound}; give odds of 1 or more")

    def advance(self, now: Instant) -> Moment:
        """The picture at an instant not before the last.

        Raises
        ------
        InputError : the instant is before the last; a source lacks what its evidence needs.
        """
        heard = now.heard()
        roll = self.past.loosened(Roll.of(heard), _per_m2(now))
        heard, past = roll.now, self.past.on(roll)
        found = self._found(heard, past)
        kept = np.zeros(0, bool)
        if found is not None:
            found, kept = held(found, self._was(found.union, roll, past), math.log(self.bound))
            past = past.met(found.union)
        shown = ShownNow(roll, found, kept)
        members = shown.members
        texts = {name: roll.texts(name) for name in TEXTS}
        seen = self._seen(roll, members, found, past, texts)
        past = past.proved(seen.tracks[_together(members, found, self.stages)])
        known = self.known.on(now.instant_s, seen, _per_m2(now), self.stages)
        called = self._called(roll, members, texts, known)
        carried = replace(self, past=past, known=known, called=called)
        return Moment(now, roll, shown, seen.states, carried)

    def _was(self, union: Union, roll: Roll, past: Past) -> IntArray:
        """(records,) the object of the last instant that each record of the union belongs to by its track, −1 for
        those whose track was not there."""
        track = past.tracks.on_roll
        was = np.where(found_in(self.past.tracks.number, track) >= 0, self.known.belonging.last_of(track), 0)
        out = np.full(len(union), -1)
        for s, (given, source) in enumerate(zip(union.given, union.sources, strict=True)):
            if given + 1 < len(roll.start):
                out[union.start[s] : union.start[s + 1]] = was[roll.find(given, records_of(source).rows)]
        return np.where(out > 0, out, -1)

    def _found(self, heard: Instant, past: Past) -> Objects | None:
        """The objects of an instant; None where nobody says anything."""
        if not heard.sources:
            return None
        if len(heard.sources) == 1:
            # A source alone is identified with one that says nothing: each of its records is an object.
            nobody = Records.of(np.empty((0, heard.features)), sigma=1.0, source="")
            rule = PoissonObjects(heard.density, 0.5)
            return identify_many((*heard.sources, nobody), rule=rule, region=heard.region)
        return identify_many(heard.sources, rule=self.say(heard, past), gate=self.gate, region=heard.region)

    def _seen(
        self, roll: Roll, members: IntArray, found: Objects | None, past: Past, texts: Mapping[str, NDArray[Any]]
    ) -> Seen:
        """What the objects of an instant are to be recognised by."""
        states = object_states(roll, members, found)
        there = members >= 0
        track = np.append(past.tracks.on_roll, -1)[members]
        named = np.append(np.any([texts[name] != "" for name in NAMES_ONE], axis=0), False)[members]
        # No clutter: what the source shows is there.
        honest = np.array([feed.clutter(2) == 0.0 for feed in roll.now.feeds], dtype=bool)
        sure = (there & honest).any(axis=1) | _together(members, found, self.stages)
        new = np.append(roll.new_since(self.past.tracks.roll), False)
        plotted = np.append(new[:-1] & (past.tracks.on_roll < 0), False)
        looked, plotted = (np.asarray(column[members].any(axis=1)) for column in (new, plotted))
        walk = np.append(roll.walk_m2_per_s3, 0.0)[members].max(axis=1, initial=0.0)
        speed = np.append(roll.speed_m_per_s, 0.0)[members].max(axis=1, initial=0.0)
        return Seen(states, track, named & there, looked, plotted, sure, _longest(track, past), walk, speed)

    def _called(
        self, roll: Roll, members: IntArray, texts: Mapping[str, NDArray[Any]], known: Known
    ) -> Mapping[int, NDArray[Any]]:
        """Per object of the picture its texts: what its newest record says, else what was said before."""
        at, source = np.nonzero(members >= 0)
        record = members[at, source]
        said = np.full((len(members), len(TEXTS)), "", dtype=object)
        for column, name in enumerate(TEXTS):
            values = texts[name][record]
            tells = np.flatnonzero(values != "")
            # The newest is written last; of equally new ones the first by the alphabet.
            order = tells[
                np.lexsort([np.argsort(np.argsort(values[tells].astype(str)[::-1])), roll.time_s[record[tells]]])
            ]
            said[at[order], column] = values[order]
        called = {}
        for number, k in zip(known.number.tolist(), known.seen.tolist(), strict=True):
            before = self.called.get(number, NOTHING)
            called[number] = before if k < 0 else np.where(said[k] != "", said[k], before)
        return called


def _longest(track: IntArray, past: Past) -> Life:
    """The life of that track of each object, of its tracks (n, S), that is most surely of something real."""
    track = np.column_stack([track, np.full(len(track), -1)])
    begun, lived = past.lives.log_odds(track)
    most = np.argmax(begun + lived, axis=1)[:, None]
    return Life(*(np.take_along_axis(column, most, 1)[:, 0] for column in (track, begun, lived)))  # type: ignore[arg-type]


def _together(members: IntArray, found: Objects | None, stages: Stages) -> BoolArray:
    """(n,) whether two sources or more show an object beyond doubt."""
    if found is None:
        return np.zeros(len(members), bool)
    return np.asarray(((members >= 0).sum(axis=1) > 1) & (found.probability >= stages.sure))


def _per_m2(now: Instant) -> float:
    """Objects per m² of the plane at the middle of the region."""
    if now.features == POSITION:
        return now.density
    # The density of velocities falls to 1/(2π σ²) at rest.
    variance = np.linalg.det(now.region.covariance[2:, 2:]) ** 0.5
    return float(now.density * 2.0 * np.pi * variance)


@dataclass(frozen=True)
class Moment:
    """The picture at one instant; made by :meth:`Watch.advance`, or :meth:`sameas.picture.lookout.Lookout.at`.

    Attributes
    ----------
    now : the instant. roll : the records of the sources that say anything.
    shown : the objects that they show, (n,), and how sure they are. states : of these.
    watch : what the picture carries on.
    """

    now: Instant
    roll: Roll
    shown: Shown
    states: ObjectStates
    watch: Watch | Lookout

    @property
    def known(self) -> Known | Followed:
        """The objects of the picture."""
        return self.watch.known

    @property
    def members(self) -> IntArray:
        """(n, S) records on the roll of each object found, −1 for none."""
        return self.shown.members

    @cached_property
    def number(self) -> IntArray:
        """(n,) the number in the picture of each object found."""
        return self.known.numbers(len(self.members))

    @cached_property
    def object_of_record(self) -> IntArray:
        """(records,) which object found each record of the roll is in."""
        out = np.zeros(len(self.roll), np.int64)
        at, source = np.nonzero(self.members >= 0)
        out[self.members[at, source]] = at
        return out

    @property
    def runner_up(self) -> IntArray:
        """(n, S) records on the roll of the most probable other set that has one of an object's records."""
        return self.shown.runner_up

    @property
    def p_runner_up(self) -> FloatArray:
        """(n,) its probability, 0 where nothing else is possible."""
        return self.shown.p_runner_up

    @property
    def probability(self) -> FloatArray:
        """(n,) that exactly its records are one object."""
        return self.shown.probability

    @property
    def p_alone(self) -> FloatArray:
        """(records,) that a record has no partner."""
        return self.shown.p_alone

    @cached_property
    def ambiguous(self) -> BoolArray:
        """(n,) whether it is not certain that exactly these records are the object."""
        return np.asarray(self.probability < CERTAIN)

    @cached_property
    def alarms(self) -> tuple[Alarm, ...]:
        """Identities shown at two places too far apart for one object; rows are those of the sources' reports."""
        start = dict(zip((d.name for d in self.roll.now.descriptions), range(len(self.roll.start)), strict=False))

        def reported(where: tuple[str, int]) -> tuple[str, int]:
            return where[0], int(self.roll.row[self.roll.find(start[where[0]], np.array([where[1]]))[0]])

        return tuple(
            replace(alarm, first=reported(alarm.first), second=reported(alarm.second))
            for alarm in self.roll.now.alarms()
        )

    def explain(self, number: int) -> Reasons:
        """Why its records are object ``number`` of the picture; records are named as their sources name them: by their
        tracks, else by the lines of their files.

        Raises
        ------
        InputError : no record of the instant is in an object of that number.
        """
        at = np.flatnonzero(self.number == number)
        if not len(at):
            raise InputError(f"object {number} is not shown by any source at {self.now.instant_s:g} s")
        reasons, names = self.shown.explain(int(at[0])), self._names
        rivals = tuple(
            replace(
                rival, members=tuple(names[record] for record in rival.members),
                taken=tuple((names[record], int(self.number[other])) for record, other in rival.taken),
            )
            for rival in reasons.rivals
        )  # fmt: skip
        stays = STAYS if self.shown.kept[at[0]] else ""
        return replace(reasons, number=number, rivals=rivals, stays=stays)

    @cached_property
    def _names(self) -> Mapping[Name, Name]:
        """By source and row of its reports, the source and what a user finds the record by."""
        roll, feeds = self.roll, self.roll.now.feeds
        sources = [description.name for description in roll.now.descriptions]
        names: dict[Name, Name] = dict(self.shown.names)
        for s, row, track in zip(roll.source.tolist(), roll.row.tolist(), roll.track.tolist(), strict=True):
            given = feeds[s].given
            said = track or (f"row {row}" if given is None else f"{given.damaged.unit} {given.line[row]}")
            names[sources[s], row] = sources[s], said
        return names

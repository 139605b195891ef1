"""The watch: what a picture carries along, which is what it remembers of tracks, the objects it knows, and their texts.

:meth:`Watch.advance` takes it to an instant and gives the :class:`~sameas.picture.picture_state.PictureState`; for live
use call it instant by instant,

    state = watch.advance(scene.at(t))
    watch = state.watch
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.errors import InputError
from sameas.gate import ChiSquare
from sameas.many.identify import identify_many
from sameas.many.objects import Objects
from sameas.many.observations import records_of
from sameas.many.partition import best_partition
from sameas.many.pooled import PooledRecords
from sameas.many.rules import PoissonObjects, SetRule
from sameas.many.sets import Sets
from sameas.picture.instant_objects import IdentifiedObjects
from sameas.picture.memory import Past
from sameas.picture.named import found_in
from sameas.picture.object_ids import Detections, KnownObjects, Life, Stages
from sameas.picture.object_states import object_states
from sameas.picture.picture_state import PictureState
from sameas.picture.scan import Scan, objects_per_m2
from sameas.records import Records
from sameas.tracks.scene import Instant

#: b of :func:`with_hysteresis`: how many times as probable per link (chosen).
BOUND = 4.0
#: Longest search for the best partition of one group, seconds (chosen).
TIME_LIMIT_S = 10.0


def with_hysteresis(found: Objects, before: IntArray, log_bound: float) -> tuple[Objects, BoolArray]:
    """The objects of an instant, as they were where nothing else is much more probable, and which (n,) of them are
    shown for that reason alone.

    Two vessels at one pier share an echo, and its owner stays open for hours: 60 to 40, then 45 to 55. The most
    probable answer of every instant would hand it to and fro. So the picture shows the partition that maximises

        ln P(partition) − ln b · links,

    with P from all scans so far, and ``links`` the number of links that it breaks: one for every part but one into
    which it takes the records that were one object at the last instant. An answer that is b times as probable per link
    is shown at once; records that come together break nothing. Probabilities stay as they are. Only named tracks were
    in an object before: a new record costs nothing. Source: the decision of least expected loss where a change that is
    taken back costs, too (Berger 1985, section 2).

    Parameters
    ----------
    before : (records,) the object that each record's track was of at the last instant, in the order of the pooled
        records; −1 for records that were not there.
    log_bound : ln b; 0 where the most probable answer is always shown.
    """
    sets, answer = found.sets, found.answer
    links = _links(sets, before)
    wanted = _changed(sets, before, answer.chosen) if log_bound > 0.0 else np.zeros(len(sets.start) - 1, bool)
    if not wanted.any():
        return found, np.zeros(len(found), bool)
    tilted = replace(sets, log_weight=sets.log_weight + log_bound * links)
    steady = best_partition(tilted, len(found.pooled), wanted, time_limit_s=TIME_LIMIT_S).chosen
    chosen = np.where(wanted[sets.group], steady, answer.chosen)
    lost = _value(sets, answer.chosen) - _value(sets, chosen)
    shown = replace(found, answer=replace(answer, chosen=chosen, gap=answer.gap + np.maximum(lost, 0.0)))
    return shown, ~answer.chosen[shown.set_of_object]


def _links(sets: Sets, before: IntArray) -> IntArray:
    """(k,) links that a set keeps: its records that were there, less the objects of the last instant that they were."""
    was = np.sort(np.append(before, -1)[sets.members], axis=1)
    there = was >= 0
    objects = (there[:, :1] + np.cumsum((was[:, 1:] != was[:, :-1]) & there[:, 1:], axis=1))[:, -1:].sum(axis=1)
    return np.asarray(there.sum(axis=1) - objects)


def _changed(sets: Sets, before: IntArray, chosen: BoolArray) -> BoolArray:
    """(g,) groups in which the chosen sets part what was together and could still be."""
    which = np.flatnonzero(chosen)
    at, source = np.nonzero(sets.members[which] >= 0)
    was = before[sets.members[which][at, source]]
    known = np.unique(np.column_stack([sets.group[which[at]], was, which[at]])[was >= 0], axis=0)
    parted = (known[1:, :2] == known[:-1, :2]).all(axis=1)
    out = np.zeros(len(sets.start) - 1, bool)
    out[known[1:][parted, 0]] = True
    return out


def _value(sets: Sets, chosen: BoolArray) -> FloatArray:
    """(g,) ln w of the partition of each group."""
    return np.asarray(np.bincount(sets.group[chosen], sets.log_weight[chosen], len(sets.start) - 1), np.float64)


#: Attributes of identity that the picture states of an object.
TEXTS = ("mmsi", "icao", "callsign", "name", "mode_a", "type")
#: Those of them that one object alone has.
NAMES_ONE = ("mmsi", "icao", "callsign")
#: The texts of an object without any.
NOTHING = np.full(len(TEXTS), "", dtype=object)


#: The rule of evidence at an instant, from the instant and the past.
EvidenceOf = Callable[[Instant, Past], SetRule]


def all_evidence(now: Instant, past: Past) -> SetRule:
    """Positions, misses and clutter as described, what records say of their identities, and what tracks did before."""
    return now.rule() + now.identity() + past.rule()


@dataclass(frozen=True)
class Watch:
    """What a picture carries from instant to instant; start with ``Watch()``.

    Parameters
    ----------
    evidence : what counts as evidence. ``lambda now, past: now.rule() + past.rule()`` leaves identities out,
        ``lambda now, past: now.rule() + now.identity()`` judges every instant alone.
    past : what is remembered of tracks; give one to change how long their errors last.
    bound : of the odds at which records change their object (:func:`with_hysteresis`); 1 for the most
        probable answer of every instant, whatever was shown before.
    stages : when objects are confirmed. gate : of ``identify_many``.
    known, texts : objects and their texts; filled in from instant to instant.
    """

    evidence: EvidenceOf = all_evidence
    past: Past = field(default_factory=Past)
    bound: float = BOUND
    stages: Stages = field(default_factory=Stages)
    gate: ChiSquare = field(default_factory=ChiSquare)
    known: KnownObjects = field(default_factory=KnownObjects)
    texts: Mapping[int, NDArray[Any]] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        if not 1.0 <= self.bound < math.inf:
            raise InputError(f"Watch: bound is {self.bound}; give odds of 1 or more")

    def advance(self, now: Instant) -> PictureState[Watch]:
        """The picture at an instant not before the last.

        Raises
        ------
        InputError : the instant is before the last; a source lacks what its evidence needs.
        """
        heard = now.with_records()
        scan = self.past.loosened(Scan.of(heard), objects_per_m2(now))
        heard, past = scan.now, self.past.on(scan)
        found = self._found(heard, past)
        kept = np.zeros(0, bool)
        if found is not None:
            found, kept = with_hysteresis(found, self._was(found.pooled, scan, past), math.log(self.bound))
            past = past.met(found.pooled)
        shown = IdentifiedObjects(scan, found, kept)
        members = shown.members
        texts = {name: scan.texts(name) for name in TEXTS}
        seen = self._seen(scan, members, found, past, texts)
        past = past.proved(seen.tracks[_together(members, found, self.stages)])
        known = self.known.on(now.instant_s, seen, objects_per_m2(now), self.stages)
        called = self._called(scan, members, texts, known)
        carried = replace(self, past=past, known=known, texts=called)
        return PictureState(now, scan, shown, seen.states, carried)

    def _was(self, pooled: PooledRecords, scan: Scan, past: Past) -> IntArray:
        """(records,) the object of the last instant that each pooled record belongs to by its track, −1 for
        those whose track was not there."""
        track = past.tracks.track_of_record
        was = np.where(found_in(self.past.tracks.number, track) >= 0, self.known.history.last_of(track), 0)
        out = np.full(len(pooled), -1)
        for s, (given, source) in enumerate(zip(pooled.given, pooled.sources, strict=True)):
            if given + 1 < len(scan.start):
                out[pooled.start[s] : pooled.start[s + 1]] = was[scan.find(given, records_of(source).rows)]
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
        return identify_many(heard.sources, rule=self.evidence(heard, past), gate=self.gate, region=heard.region)

    def _seen(
        self, scan: Scan, members: IntArray, found: Objects | None, past: Past, texts: Mapping[str, NDArray[Any]]
    ) -> Detections:
        """What the objects of an instant are to be recognised by."""
        states = object_states(scan, members, found)
        there = members >= 0
        track = np.append(past.tracks.track_of_record, -1)[members]
        named = np.append(np.any([texts[name] != "" for name in NAMES_ONE], axis=0), False)[members]
        # No clutter: what the source shows is there.
        honest = np.array([feed.clutter(2) == 0.0 for feed in scan.now.feeds], dtype=bool)
        sure = (there & honest).any(axis=1) | _together(members, found, self.stages)
        new = np.append(scan.new_since(self.past.tracks.scan), False)
        plotted = np.append(new[:-1] & (past.tracks.track_of_record < 0), False)
        looked, plotted = (np.asarray(column[members].any(axis=1)) for column in (new, plotted))
        walk = np.append(scan.walk_m2_per_s3, 0.0)[members].max(axis=1, initial=0.0)
        speed = np.append(scan.speed_m_per_s, 0.0)[members].max(axis=1, initial=0.0)
        return Detections(states, track, named & there, looked, plotted, sure, _longest(track, past), walk, speed)

    def _called(
        self, scan: Scan, members: IntArray, texts: Mapping[str, NDArray[Any]], known: KnownObjects
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
                np.lexsort([np.argsort(np.argsort(values[tells].astype(str)[::-1])), scan.time_s[record[tells]]])
            ]
            said[at[order], column] = values[order]
        called = {}
        for number, k in zip(known.number.tolist(), known.detection.tolist(), strict=True):
            before = self.texts.get(number, NOTHING)
            called[number] = before if k < 0 else np.where(said[k] != "", said[k], before)
        return called


def _longest(track: IntArray, past: Past) -> Life:
    """The life of that track of each object, of its tracks (n, S), that is most surely of something real."""
    track = np.column_stack([track, np.full(len(track), -1)])
    begun, lived = past.existence.log_odds(track)
    most = np.argmax(begun + lived, axis=1)[:, None]
    return Life(*(np.take_along_axis(column, most, 1)[:, 0] for column in (track, begun, lived)))  # type: ignore[arg-type]


def _together(members: IntArray, found: Objects | None, stages: Stages) -> BoolArray:
    """(n,) whether two sources or more show an object beyond doubt."""
    if found is None:
        return np.zeros(len(members), bool)
    return np.asarray(((members >= 0).sum(axis=1) > 1) & (found.probability >= stages.sure))

"""Alarms: which are active, with their ids and who acknowledged them; and those of the picture and of the watch itself.

An alarm is active as long as its condition is found at the ticks. It is kept in the journal; where there is none, or
the disk refuses, it is kept here, with a negative id.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.distance import cdist

from sameas.arrays import FloatArray
from sameas.live.journal import Journal, Store
from sameas.live.replay import in_words
from sameas.live.situation import Alarm, Situation
from sameas.picture.picture_state import PictureState
from sameas.tracks.distress import DistressCall, calls_in
from sameas.tracks.faults import Fault
from sameas.tracks.reports import Reports

#: An alarm ends when its condition has been absent for this many seconds of picture time.
ALARM_ENDS_S = 10.0
#: Alarms that are kept where there is no journal, once they have ended; those that are active are kept whatever their
#: number.
MOST_UNSAVED = 500
#: Largest number of alarms that wait for a terminal that takes none: it may be stopped.
MOST_BEGUN = 100_000
#: The picture stands still if the clock is this many seconds before its last instant.
STANDS_S = 5.0
#: An alarm is raised if half of the last SLOW_TICKS ticks take longer than their interval by the factor SLOWER.
SLOW_TICKS, SLOWER = 10, 1.2


class AlarmLog:
    """The alarms, tick after tick. ``key in log`` : whether the alarm of this condition is active;
    ``len(log)`` : how many are.

    store : whose journal keeps them, and has those that were active when it was last closed. time_s : of the picture.

    begun : alarms that began, with their times, for the terminal, which takes them.
    """

    def __init__(self, store: Store, time_s: float) -> None:
        self._store = store
        self.begun: deque[tuple[float, Alarm]] = deque(maxlen=MOST_BEGUN)
        # Id of each active alarm, and when its condition was last found.
        active = {} if store.journal is None else store.journal.active()
        self._active = {key: (alarm_id, time_s) for key, alarm_id in active.items()}
        # Alarms that are not in the journal, by their negative ids, as it would have them.
        self._unsaved: dict[int, dict[str, Any]] = {}
        self._count = 0

    def __contains__(self, key: object) -> bool:
        return key in self._active

    def __len__(self) -> int:
        return len(self._active)

    def update(self, alarms: Sequence[Alarm], now_s: float) -> None:
        """Begins the alarms that are new at a tick, and ends those that have been absent for ``ALARM_ENDS_S``."""
        for alarm in alarms:
            known = self._active.get(alarm.key)
            if known is None:
                self._count += 1
                self.begun.append((now_s, alarm))
            number = -self._count if known is None else known[0]
            if number < 0:
                number = self._saved(number, alarm, now_s)
            self._active[alarm.key] = (number, now_s)
        for key, (alarm_id, held_s) in list(self._active.items()):
            if now_s - held_s > ALARM_ENDS_S:
                del self._active[key]
                if alarm_id > 0:
                    self._store.attempt(partial(Journal.ended, alarm_id=alarm_id, time_s=held_s))
                elif alarm_id in self._unsaved:
                    self._unsaved[alarm_id] |= {"active": 0, "last_s": held_s}
        if self._store.journal is not None:
            self._save_ended()

    def rows(self, most_ended: int = MOST_UNSAVED) -> list[dict[str, Any]]:
        """The active alarms and the last ``most_ended`` others, the newest first, with the columns of the journal."""
        journalled = self._store.attempt(partial(Journal.alarms, most_ended=most_ended), "list of alarms") or []
        unsaved = [dict(row) for _, row in sorted(self._unsaved.items())]
        ended = [row["id"] for row in unsaved if not row["active"]][:most_ended]
        return [*(row for row in unsaved if row["active"] or row["id"] in ended), *journalled]

    def acknowledge(self, alarm_id: int, who: str, time_s: float) -> bool:
        """Records who acknowledged an alarm; False where the id is unknown or was acknowledged before."""
        if (row := self._unsaved.get(alarm_id)) is not None:
            fresh = row["acknowledged_s"] is None
            row |= {"acknowledged_s": time_s, "acknowledged_by": who[:80]} if fresh else {}
            return fresh
        # Larger numbers are none of SQLite's.
        if not 0 < alarm_id < 1 << 63:
            return False
        return bool(self._store.attempt(lambda journal: journal.acknowledge(alarm_id, who, time_s)))

    def _saved(self, number: int, alarm: Alarm, now_s: float) -> int:
        """The id of an alarm in the journal; where it cannot be written there, it is kept here, and the id stays."""
        began_s = self._unsaved[number]["first_s"] if number in self._unsaved else now_s
        saved = self._store.attempt(partial(Journal.alarm, alarm=alarm, time_s=began_s))
        if saved is None:
            self._unsaved.setdefault(number, {
                "id": number, "key": alarm.key, "kind": alarm.kind, "text": alarm.text, "objects": list(alarm.objects),
                "first_s": now_s, "last_s": now_s, "active": 1, "acknowledged_s": None, "acknowledged_by": None,
            })  # fmt: skip
            ended = [one for one, row in self._unsaved.items() if not row["active"]]
            if ended and len(self._unsaved) > MOST_UNSAVED:
                del self._unsaved[ended[0]]
            return number
        before = self._unsaved.pop(number, None)
        if before is not None and before["acknowledged_s"] is not None:
            who, when_s = before["acknowledged_by"], before["acknowledged_s"]
            self._store.attempt(lambda journal: journal.acknowledge(saved, who, when_s))
        return saved

    def _save_ended(self) -> None:
        """Writes to the journal the alarms that the disk refused, and that have ended since."""
        for number, row in [(number, row) for number, row in self._unsaved.items() if not row["active"]]:
            alarm = Alarm(row["key"], row["kind"], row["text"], tuple(row["objects"]))
            saved = self._saved(number, alarm, row["first_s"])
            if saved < 0:
                return
            self._store.attempt(partial(Journal.ended, alarm_id=saved, time_s=row["last_s"]))


class DistressCalls:
    """The calls received so far, by identity.

    calls : of the saved state. unsaved : whether there is one more since that was saved; the next tick saves it.
    """

    def __init__(self, calls: Sequence[DistressCall] = ()) -> None:
        self._calls = {(call.column, call.identity): call for call in calls}
        self.unsaved = False

    @property
    def calls(self) -> tuple[DistressCall, ...]:
        """The calls, to be saved."""
        return tuple(self._calls.values())

    def take(self, reports: Reports) -> None:
        """Takes the calls among new reports of a source."""
        for call in calls_in(reports):
            before = self._calls.get(who := (call.column, call.identity))
            self._calls[who] = call.after(before)
            self.unsaved |= before is None

    def alarms(self, situation: Situation) -> list[Alarm]:
        """An alarm of each call, with the objects that have its identity."""
        self._calls = {who: call for who, call in self._calls.items() if situation.time_s <= call.ends_s}
        objects = situation.objects
        return [
            Alarm(f"distress {who}", "distress", str(call), tuple(objects["object"][objects[column] == who].tolist()))
            for (column, who), call in self._calls.items()
            if call.is_sure
        ]


def identity_alarms(state: PictureState[Any]) -> list[Alarm]:
    """Alarms of identities that are reported at two places at once."""
    out = []
    number: Mapping[tuple[str, int], int] = {}
    if state.alarms:
        names = [d.name for d in state.scan.now.descriptions]
        owner = state.number[state.object_of_record].tolist()
        places = zip(state.scan.source.tolist(), state.scan.row.tolist(), owner, strict=True)
        number = {(names[s], row): n for s, row, n in places}
    for alarm in state.alarms:
        text = (
            f"{alarm.attribute.upper()} {alarm.value} is reported at two places {alarm.distance:.0f} m apart: "
            "forged, duplicate or wrong"
        )
        objects = tuple(sorted({number[where] for where in (alarm.first, alarm.second) if where in number}))
        out.append(Alarm(f"identity {alarm.attribute} {alarm.value}", "identity", text, objects))
    return out


def fault_alarms(faults: Mapping[str, Fault], situation: Situation) -> list[Alarm]:
    """Alarms of deception of tracks and of faults of sources, by key; with the objects that have the tracks now."""
    out = []
    for key, fault in faults.items():
        objects = tuple(_objects_of(fault, situation)) if fault.track else ()
        out.append(Alarm(key, "deception" if fault.track else "source", str(fault), objects))
    return out


def _objects_of(fault: Fault, situation: Situation) -> list[int]:
    """The objects that have the track of a fault, or one by which a sensor still shows its ship."""
    tracks = {(fault.source, fault.track), *fault.seen_as}
    return [n for n, members in situation.members.items() if not tracks.isdisjoint(members)]


#: A ship so near to a place where another one was not received is not received for the same reason, and nobody who is
#: received so near to that place is (chosen: hills hide ships over kilometres).
GAP_M, RECEIVED_M = 1000.0, 500.0
#: Age of a report that shows that its place is within reception, and number of places that are kept of a source.
FRESH_S, MOST_GAPS = 15.0, 2000


@dataclass
class ReceptionGaps:
    """Places where sensors showed ships that a source did not receive, and received again later: those behind land.

    Only what was received again tells them from those who switch off, and nobody must have been received there since.
    """

    places: dict[str, FloatArray] = field(default_factory=dict)

    def add(self, source: str, places: Sequence[tuple[float, float]]) -> None:
        """The places (metres) where a ship was silent that reports again."""
        known = self.places.get(source, np.empty((0, 2)))
        self.places[source] = np.concatenate([known, np.array(places, float).reshape(-1, 2)])[-MOST_GAPS:]

    def received(self, situation: Situation) -> None:
        """Forgets the places near which a source receives somebody now."""
        records = situation.records
        for source, places in self.places.items():
            fresh = (records["source"] == source) & (np.ma.filled(records["age_s"], np.inf) < FRESH_S)
            at = np.column_stack([np.ma.filled(records[name], np.nan)[fresh] for name in ("x_m", "y_m")])
            at = at[np.isfinite(at).all(axis=1)]
            if len(at) and len(places):
                self.places[source] = places[cdist(places, at).min(axis=1) > RECEIVED_M]

    def has(self, source: str, place: tuple[float, float]) -> bool:
        """Whether a place is near one of them."""
        places = self.places.get(source, np.empty((0, 2)))
        return bool((np.hypot(*(places - place).T) < GAP_M).any())


@dataclass
class ConfirmedFaults:
    """Faults that two successive searches found, by key: that of one search alone would too often be false, with a
    search every half minute. ``suspected`` : the keys of the last search.

    A search knows the last minutes only. A ship that was silent for longer is so until she reports again, or no sensor
    shows her any more. Where others were silent and reported again later, she need not have switched off. ``paths`` :
    her fault and where she was since, by key.
    """

    confirmed: Mapping[str, Fault] = field(default_factory=dict)
    suspected: frozenset[str] = frozenset()
    gaps: ReceptionGaps = field(default_factory=ReceptionGaps)
    paths: dict[str, tuple[Fault, list[tuple[float, float]]]] = field(default_factory=dict)

    def update(self, faults: Sequence[Fault], situation: Situation | None) -> None:
        """Takes what a search found. situation : the last one, None before the first."""
        found = {f"{fault.kind} {fault.source} {fault.track}".rstrip(): fault for fault in reversed(faults)}
        new = {key: fault for key, fault in found.items() if key in self.suspected}
        if situation is not None:
            self.gaps.received(situation)
            new = self._still_silent(situation) | new
            self._follow({key: fault for key, fault in new.items() if fault.kind == "silent"}, situation)
        self.confirmed = {
            key: fault
            for key, fault in new.items()
            if key in self.confirmed or key not in self.paths or not self.gaps.has(fault.source, self.paths[key][1][-1])
        }
        self.suspected = frozenset(found)

    def _still_silent(self, situation: Situation) -> dict[str, Fault]:
        """The silences of ships that sensors still show; these may show them by other tracks meanwhile."""
        out: dict[str, Fault] = {}
        for key, fault in self.confirmed.items():
            objects = _objects_of(fault, situation) if fault.kind == "silent" else ()
            tracks = dict.fromkeys(one for n in objects for one in situation.members[n])
            if tracks:
                out[key] = replace(fault, seen_as=tuple(tracks))
        return out

    def _follow(self, silent: Mapping[str, Fault], situation: Situation) -> None:
        """Adds where silent ships are now to their paths."""
        columns = (situation.objects[name].tolist() for name in ("object", "x_m", "y_m"))
        place_of = {n: (x, y) for n, x, y in zip(*columns, strict=True) if x is not None}
        paths = {}
        for key, fault in silent.items():
            path = self.paths.get(key, (fault, []))[1]
            path += [place_of[n] for n in _objects_of(fault, situation)[:1] if n in place_of]
            if path:
                paths[key] = fault, path
        self.paths = paths

    def take(self, reports: Reports) -> None:
        """Ends the silence of ships that report again."""
        if not self.paths or reports.object_ids is None:
            return
        ids = reports.object_ids.astype(str)
        for key, (fault, places) in list(self.paths.items()):
            own = ids == fault.track
            if own.any() and reports.time_s[own].max() > fault.first_s:
                self.gaps.add(fault.source, places)
                del self.paths[key]
                self.confirmed = {other: one for other, one in self.confirmed.items() if other != key}


def disk_alarms(folder: Path | None, refusal: str, recordings: str | None, errors: Sequence[str]) -> list[Alarm]:
    """Alarms where the folder of the watch, or that of its recordings, cannot be written."""
    alarms = []
    if refusal:
        text = f"{folder} cannot be written ({refusal}); what happens is written when it can"
        alarms.append(Alarm("folder", "fault", text))
    if errors:
        text = f"{recordings} cannot be written; what is received is not recorded: {'; '.join(errors)}"
        alarms.append(Alarm("record", "fault", text))
    return alarms


def pace_alarms(durations_s: Sequence[float], every_s: float, *, active: bool) -> list[Alarm]:
    """An alarm where the picture is older than its interval says, because an instant takes longer than that.

    durations_s : of all ticks. active : whether there is an alarm; it holds a little longer, so that the limit is not
    crossed again and again.
    """
    last = durations_s[-SLOW_TICKS:]
    if len(last) < SLOW_TICKS or float(np.median(last)) <= (every_s if active else SLOWER * every_s):
        return []
    text = (
        f"an instant takes {np.median(last):.1f} s, and every_s is {every_s:g}: the picture is that old; give a "
        "longer every_s, or fewer sources"
    )
    return [Alarm("pace", "fault", text)]


def clock_alarms(set_back_s: float, early_s: float) -> list[Alarm]:
    """Alarms where the clock of this computer was set back, now or while the watch was ended.

    set_back_s : by how much it was, now. early_s : by how much it is before the picture's last instant.
    """
    alarms = []
    if set_back_s > 0.0:
        by = in_words(set_back_s)
        text = f"the clock of this computer was set back by {by}; the watch keeps the time before: set it right"
        alarms.append(Alarm("set back", "fault", text))
    if early_s > STANDS_S:
        text = (
            f"the picture is {in_words(early_s)} later than the clock of this computer, and stands still until "
            "then: set the clock right, or move the folder of its state away and begin anew"
        )
        alarms.append(Alarm("stands still", "fault", text))
    return alarms

"""The keeper: the main loop of a live picture.

A tick takes the new reports (:mod:`~sameas.live.reception`), advances the picture, begins and ends alarms
(:mod:`~sameas.live.alarms`), writes the journal, and notifies the listeners of the changes. Unusable input is counted
at its source and never ends the loop.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import secrets
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from sameas.errors import InputError, reading
from sameas.io.processes import Aside
from sameas.live.alarms import (
    MOST_UNSAVED,
    AlarmLog,
    ConfirmedFaults,
    DistressCalls,
    clock_alarms,
    disk_alarms,
    fault_alarms,
    identity_alarms,
    pace_alarms,
)
from sameas.live.approaches import Approaches
from sameas.live.guard import GuardZones
from sameas.live.journal import Store, load_state, save_state
from sameas.live.offsets import SourceOffsets
from sameas.live.outputs import sinks_of
from sameas.live.own_ship import OwnShipMotion
from sameas.live.reception import Reception
from sameas.live.replay import Playback, Replay, SteadyClock, WatchClock
from sameas.live.settings import Settings, WatchSettings
from sameas.live.situation import Alarm, Delta, Situation
from sameas.picture.live import LivePicture, estimated, faults_of
from sameas.picture.picture_state import PictureState
from sameas.tracks.coordinates import LocalPlane
from sameas.tracks.reports import Reports
from sameas.tracks.source import Description

LOG = logging.getLogger("sameas.live")
#: Number of deltas that are kept for listeners that reconnect.
KEPT_DELTAS = 300
#: Registration and the search for faults of fewer reports take less than half a second, and are done in a thread.
LEAST_ASIDE = 20_000
#: Biases are estimated so soon after the beginning, in seconds, and then at growing intervals: what a radar that is
#: read wrongly shows alone is confirmed until there is a doubt about it.
FIRST_REGISTERED_S = 10.0
#: Number of ticks whose durations are kept.
KEPT_DURATIONS = 600


class Keeper:
    """The live picture for given settings.

    settings : sources and watch options. folder : for state, journal and archive; None writes none of them.
    replay : reports of files instead of wires. playback : recordings of the wires, as they were received. clock : UTC
        in seconds; that of the computer if not given.

    Raises InputError: a source has no wire and is not replayed; the folder cannot be written.
    """

    def __init__(
        self,
        settings: Settings,
        folder: Path | None = None,
        *,
        replay: Replay | None = None,
        playback: Playback | None = None,
        clock: Callable[[], float] | None = None,
    ) -> None:
        if playback is not None:
            # A recording is not recorded again.
            settings = replace(settings, watch=replace(settings.watch, record=None))
        self.settings, self.folder = settings, folder
        #: Whose ticks these are: after a kill, the numbers since the last state was saved come again.
        self.run_id = secrets.token_hex(4)
        self.clock = WatchClock(clock or SteadyClock(), replay=replay, playback=playback)
        self.reception = Reception(settings, self.clock, replay=replay, playback=playback, use=self._use)
        self.wires = self.reception.wires
        self.situation: Situation | None = None
        # The state of the last tick, from which explanations are made.
        self._state: PictureState[Any] | None = None
        self.deltas: deque[Delta] = deque(maxlen=KEPT_DELTAS)
        self.history: deque[Situation] = deque()
        #: Number of ticks that failed.
        self.failed_ticks = 0
        # The last exception of a tick.
        self._fault = ""
        self.durations_s: deque[float] = deque(maxlen=KEPT_DURATIONS)
        # Number of all ticks since the start, and their durations together.
        self._timed, self._timed_s = 0, 0.0
        self.lock = threading.Lock()
        self.sinks = sinks_of(settings.watch.outputs)
        self._listeners: set[asyncio.Event] = set()
        # Whether no tick will follow.
        self.ended = False
        self.approaches = Approaches(settings.watch)
        self.zones = GuardZones(settings.watch.zones)
        self.own_ship = OwnShipMotion(settings, self.wires, replayed=replay is not None)
        self._saved_s = -math.inf
        self._tick = 0
        self.store = Store(folder, archive_every_s=settings.watch.archive_every_s)
        with contextlib.ExitStack() as opened:
            if self.store.journal is not None:
                opened.callback(self.store.journal.close)
            self._restore(folder)
            opened.pop_all()
        self.alarms = AlarmLog(self.store, self.picture.instant_s)
        self.background = BackgroundWork(self.picture, settings.watch, self.lock, lambda: self.situation)

    def _restore(self, folder: Path | None) -> None:
        """Continues with the saved state of the folder; without one, begins anew."""
        watch, settings, replay = self.settings.watch, self.settings, self.clock.replay
        state = None if folder is None else load_state(folder)
        descriptions = [source.description for source in settings.sources.values()]
        origin = watch.origin or (None if replay is None else replay.origin)
        self.picture, self.distress = LivePicture(descriptions, plane=origin, lag_s=watch.lag_s), DistressCalls()
        with reading(f"{folder}: the state of the watch", "is damaged"):
            self.restored = state is not None
            #: Names of the sources that are new or described differently since the state was saved.
            self.changed: tuple[str, ...] = ()
            if state is not None:
                self.picture, self._tick = state["picture"], int(state["tick"])
                self.distress = DistressCalls(state.get("calls", ()))
                self.picture.instant_s  # noqa: B018 (the state may hold anything by that name)
                self._require_plane(self.picture.plane)
                self.changed = self.picture.describe(descriptions, watch.lag_s)
        self.picture.return_s = 3600.0 * watch.return_h
        self.offsets = SourceOffsets(self.picture, self.settings.sources, self.store, self.lock, self.clock)
        self.offsets.restore(self.changed)

    def _require_plane(self, saved: LocalPlane | None) -> None:
        """Refuses another plane than that of the saved state: all its positions are in metres from there."""
        given = self.settings.watch.origin
        if given is None or given == saved:
            return
        about = "metres of your own"
        remedy = "leave plane out of [watch], or move the folder away to begin a new watch"
        if saved is not None:
            about = f"the plane about {saved.lat_deg:.6f}, {saved.lon_deg:.6f}"
        here = f"{given.lat_deg:.6f}, {given.lon_deg:.6f}"
        raise InputError(f"{self.folder}: its picture is in {about}, and [watch] gives the plane about {here}", remedy)

    # ---- one tick ----

    def now_s(self) -> float:
        """The current time of the picture."""
        return self.clock.replayed_s() - self.settings.watch.behind_s

    def tick(self, now_s: float | None = None) -> Situation | None:
        """Processes the new reports and returns the situation then; None, and a log entry, where this failed."""
        began = time.perf_counter()
        instant_s = max(self.now_s() if now_s is None else now_s, self.picture.instant_s)
        self.reception.take(instant_s)
        try:
            state: PictureState[Any] = self.picture.advance(instant_s)
        except Exception as error:
            # A fault in one tick must not end the watch: the next tick has other reports.
            # One that stays must not fill the terminal.
            LOG.error("tick at %.1f s: %r", instant_s, error, exc_info=repr(error) != self._fault)
            self._fault = repr(error)
            self.failed_ticks += 1
            with self.lock:
                text = f"the picture could not be advanced: {error}"
                self.alarms.update([Alarm("fault", "fault", text)], instant_s)
            return None
        with self.lock:
            self._tick += 1
            clock_s, plane = self.reception.taken_s, self.picture.plane
            own_ship = self.own_ship.at(instant_s, clock_s, state, plane)
            situation = Situation.of(self._tick, state, plane, (), own_ship, self.picture.height_model)
            alarms = [*self.distress.alarms(situation), *identity_alarms(state),
                      *self.reception.alarms(excused={self.own_ship.source(clock_s)}),
                      *fault_alarms(self.background.faults.confirmed, situation), *self._own_ship_alarms(situation),
                      *self.approaches.alarms(situation, state, self.alarms, self.own_ship.mmsi),
                      *self.zones.alarms(situation, self.alarms, self.own_ship.mmsis),
                      *self._own_alarms()]  # fmt: skip
            situation = replace(situation, alarms=tuple(alarms))
            self.alarms.update(alarms, instant_s)
            self.deltas.append(Delta.between(self.situation, situation))
            self.situation, self._state = situation, state
            self._keep_history(situation)
            self.store.attempt(lambda journal: journal.write(situation))
            unsaved = self.offsets.unsaved or self.distress.unsaved
            if unsaved or instant_s - self._saved_s >= self.settings.watch.save_every_s:
                self.store.attempt(lambda journal: self.save(), "state")
        self.durations_s.append(time.perf_counter() - began)
        self._timed, self._timed_s = self._timed + 1, self._timed_s + self.durations_s[-1]
        return situation

    def _tick_and_send(self) -> None:
        situation = self.tick()
        if situation is not None:
            for sink in self.sinks:
                sink.send(situation)

    def save(self) -> None:
        """Saves the state."""
        if self.folder is not None:
            save_state(self.folder, {"picture": self.picture, "tick": self._tick, "calls": self.distress.calls})
            self._saved_s = self.picture.instant_s
            self.offsets.unsaved = self.distress.unsaved = False

    def _use(self, name: str, reports: Reports) -> None:
        """Takes the reports of a source into the picture; they are refused as of :meth:`LivePicture.add`."""
        self.picture.add(name, reports)
        self.approaches.take(reports)
        self.distress.take(reports)
        with self.lock:
            self.background.faults.take(reports)
        self.own_ship.take(name, reports)

    def _keep_history(self, situation: Situation) -> None:
        """Keeps a situation every 10 s, or every tick where these are longer, for the history that pages show."""
        every_s = max(10.0, self.settings.watch.every_s)
        if not self.history or situation.time_s - self.history[-1].time_s >= every_s:
            self.history.append(situation)
        while self.history and situation.time_s - self.history[0].time_s > self.settings.watch.history_s:
            self.history.popleft()

    def _own_ship_alarms(self, situation: Situation) -> list[Alarm]:
        """An alarm where own ship's position is to come from a source, and does not: no approach is computed."""
        silence = self.own_ship.silence(self.reception.taken_s, self.reception.began_s)
        if not silence or situation.own_ship is not None:
            return []
        return [Alarm("own ship", "source", f"own ship: {silence}; no approach is watched")]

    def _own_alarms(self) -> list[Alarm]:
        """The alarms of the watch itself: of its disk, its pace and the clock."""
        watch = self.settings.watch
        alarms = disk_alarms(self.folder, self.store.refusal, watch.record, self.reception.recorder_errors())
        early_s = -math.inf
        if self.clock.replay is None:
            alarms += pace_alarms(list(self.durations_s), watch.every_s, active="pace" in self.alarms)
            early_s = self.picture.instant_s - self.now_s()
        return [*alarms, *clock_alarms(self.clock.set_back_s, early_s)]

    # ---- the loop ----

    async def run(self, *, until: Callable[[], bool] | None = None, stop: asyncio.Event | None = None) -> None:
        """Ticks until it is cancelled or ``until`` returns True; then saves the state.

        stop : ends the wait for the next tick, so that ``until`` is checked at once.
        """
        wires = self.wires.values() if self.clock.playback is None else ()
        readers = [asyncio.create_task(wire.run()) for wire in wires]
        watch = self.settings.watch
        from_s = self.picture.instant_s
        self.clock.begin(from_s if self.restored and math.isfinite(from_s) else None)
        next_s = self.clock()
        try:
            while until is None or not until():
                # Missed ticks are not caught up: the next one has all reports. A replay waits instead.
                next_s = self.clock.begin_tick(next_s)
                await asyncio.to_thread(self._tick_and_send)
                self._tell_listeners()
                self.background.begin_due(self.picture.instant_s)
                next_s += watch.every_s
                wait_s = self.clock.end_tick(next_s)
                if stop is None:
                    await asyncio.sleep(wait_s)
                else:
                    with contextlib.suppress(asyncio.TimeoutError):
                        await asyncio.wait_for(stop.wait(), wait_s)
        finally:
            self.ended = True
            self._tell_listeners()
            for task in readers:
                task.cancel()
            try:
                # The state is saved whatever the tasks raise.
                await asyncio.gather(*readers, *self.background.tasks, return_exceptions=True)
            finally:
                self.close()

    def close(self) -> None:
        """Saves the state and closes the journal.

        Raises InputError: the disk refused the state; the last one that was saved stays.
        """
        self.background.aside.close()
        with self.lock:
            for sink in self.sinks:
                sink.close()
            for wire in self.wires.values():
                wire.close()
            self.store.attempt(lambda journal: self.save(), "state")
            self.store.close()

    def listen(self) -> asyncio.Event:
        """An event that is set at every tick and at the end; :meth:`leave` ends this."""
        event = asyncio.Event()
        self._listeners.add(event)
        return event

    def leave(self, event: asyncio.Event) -> None:
        """Removes a listener."""
        self._listeners.discard(event)

    def _tell_listeners(self) -> None:
        for listener in self._listeners:
            listener.set()

    # ---- queries ----

    def alarm_list(self, most_ended: int = MOST_UNSAVED) -> list[dict[str, Any]]:
        """The active alarms and the last ``most_ended`` others, the newest first, with their ids."""
        with self.lock:
            return self.alarms.rows(most_ended)

    def why(self, number: int) -> str:
        """Why its records are this object now, and the status in its AIS; a sentence where no source shows it."""
        state, situation = self._state, self.situation
        if state is None or not (state.number == number).any():
            return f"no source shows object {number} now"
        objects = {} if situation is None else situation.objects
        mmsi = [] if not objects else objects["mmsi"][objects["object"] == number].tolist()
        status = self.approaches.status(str(mmsi[0])) if mmsi else ""
        return (f"Navigational status in its AIS: {status}\n" if status else "") + str(state.explain(number))

    def acknowledge(self, alarm_id: int, who: str) -> bool:
        """Records who acknowledged an alarm."""
        with self.lock:
            # In a replay, alarms and those who acknowledge them live in the time of the picture.
            time_s = self.clock() if self.clock.replay is None or self.situation is None else self.situation.time_s
            return self.alarms.acknowledge(alarm_id, who, time_s)

    def health(self) -> dict[str, Any]:
        """Whether the picture advances, and the counters of every source and wire."""
        age_s = None if self.situation is None else self.now_s() - self.situation.time_s
        late_s = max(10.0 * self.settings.watch.every_s * (self.clock.pace or 1.0), 10.0)
        ticking = age_s is not None and abs(age_s) < late_s
        counts, biases = self.picture.counts, self.offsets.biases()
        sources = {
            name: {
                "reports": counts[name].taken, "unplaced": counts[name].unplaced, "late": counts[name].late,
                "repeated": counts[name].repeated, "jumps": counts[name].jumps,
                "refused": state.refused, "error": state.error,
                "delay_s": None if math.isnan(state.delay_s) else round(state.delay_s, 3),
                "biases": biases.get(name),
            }
            for name, state in self.reception.sources.items()
        }  # fmt: skip
        return {
            "ok": bool(ticking), "tick": self._tick,
            "time_s": None if self.situation is None else self.situation.time_s,
            "objects": 0 if self.situation is None else len(self.situation.objects["object"]),
            "harbour": self.approaches.in_harbour, "berthed": len(self.approaches.berthed),
            "faults": self.failed_ticks, "alarms": len(self.alarms), "sources": sources,
            "timed": self._timed, "timed_s": round(self._timed_s, 6),
            "wires": self.reception.wire_counters(),
            "set_aside": dict(self.settings.set_aside),
            "outputs": {f"{sink.format} {sink.url}": {"failed": sink.failed, "unnumbered": sink.numbers.unnumbered}
                        for sink in self.sinks},
        }  # fmt: skip


class BackgroundWork:
    """Registration and the search for faults, each in a thread, with many reports in a process of its own.

    picture : whose last minutes they use, and lock : held while ticks change it. situation : the last one. A failure of
    either is logged and changes nothing.
    """

    def __init__(
        self,
        picture: LivePicture,
        watch: WatchSettings,
        lock: threading.Lock,
        situation: Callable[[], Situation | None] = lambda: None,
    ) -> None:
        self.picture, self.lock, self.situation = picture, lock, situation
        self.aside = Aside(LEAST_ASIDE)
        self.faults = ConfirmedFaults()
        self._work = (
            _Periodic(self.register, watch.register_every_s, FIRST_REGISTERED_S),
            _Periodic(self.search, watch.faults_every_s),
        )

    def register(self) -> None:
        """Estimates the biases of the sources from the last minutes."""
        recent = self.picture.recent()
        try:
            registered = self.aside.call(_number(recent), estimated, recent, self.picture.plane)
            self.picture.take_off(registered)
        except Exception as error:
            # A failed bias fit must not end the watch: the previous biases stay in use.
            LOG.info("registration: %s", error, exc_info=not isinstance(error, InputError))

    def search(self) -> None:
        """Searches the last minutes for deception and source faults."""
        with self.lock:
            recent, sightings, tuning = self.picture.recent(), self.picture.sightings(), self.picture.picture_tuning
        plane = self.picture.plane
        try:
            faults = self.aside.call(_number(recent), faults_of, recent, sightings, plane, tuning)
        except Exception as error:
            # A failed search must not end the watch.
            LOG.info("faults: %s", error, exc_info=not isinstance(error, InputError))
            return
        with self.lock:
            self.faults.update(faults, self.situation())

    def begin_due(self, now_s: float) -> None:
        """Begins what is due at this time of the picture."""
        for work in self._work:
            work.begin_if_due(now_s)

    @property
    def tasks(self) -> list[asyncio.Task[None]]:
        """The last of each that was begun."""
        return [work.task for work in self._work if work.task is not None]


def _number(sources: Sequence[tuple[Description, Reports]]) -> int:
    """Of all reports."""
    return sum(len(reports) for _, reports in sources)


@dataclass
class _Periodic:
    """Work in a thread of its own, every so many seconds of picture time; 0: never. It is not begun while it lasts.

    first_s : the first times are so many seconds after the beginning, and then twice as long after the last.
    """

    work: Callable[[], None]
    every_s: float
    first_s: float = math.inf
    begun_s: float = -math.inf
    task: asyncio.Task[None] | None = None

    def begin_if_due(self, now_s: float) -> None:
        """Begins the work at this time of the picture if it is due."""
        wait_s = min(self.every_s, self.first_s)
        due = self.every_s > 0.0 and now_s - self.begun_s >= wait_s
        if due and (self.task is None or self.task.done()):
            # The very first time there is hardly a report.
            self.first_s *= 2.0 if math.isfinite(self.begun_s) else 1.0
            self.begun_s, self.task = now_s, asyncio.create_task(asyncio.to_thread(self.work))

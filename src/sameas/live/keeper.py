"""The keeper: the main loop of a live picture, with its state, its journal and its alarms.

A tick takes the new reports of the wires (or of a replay), advances the picture, raises and ends alarms, writes the
journal, and notifies the listeners of the changes. Unusable input is counted at its source and never ends the loop.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import sqlite3
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from sameas.errors import Argument, InputError, Message, reading
from sameas.io.sensors.recording import Recorder
from sameas.io.sensors.sources import ZONED
from sameas.io.sensors.stream import ReportStream
from sameas.live.approaches import Approaches
from sameas.live.inputs import Playback, Replay, SteadyClock, Wire, in_words
from sameas.live.journal import Journal, load_state, save_state
from sameas.live.outputs import sinks_of
from sameas.live.settings import Settings
from sameas.live.situation import Alarm, OwnShipState, Situation
from sameas.picture.deception import Fault
from sameas.picture.live import LivePicture, LiveState, faults_of
from sameas.picture.picture_state import PictureState
from sameas.representation import listed
from sameas.tracks.coordinates import LocalPlane
from sameas.tracks.reports import Reports
from sameas.tracks.source import Description

T = TypeVar("T")
LOG = logging.getLogger("sameas.live")
#: An alarm ends when its condition has been absent for this many seconds of picture time.
ALARM_ENDS_S = 10.0
#: Number of deltas that are kept for listeners that reconnect.
KEPT_DELTAS = 300
#: A source that never gave a report raises an alarm when its data have been unusable for this many seconds.
MISFIT_S = 5.0
#: The same if this many lines were damaged and none was good.
MISFIT_LINES = 20
#: Reports whose stamps are later than this many seconds from now are refused: kept until then, they would fill memory.
AHEAD_S = 600.0
#: The picture stands still if the clock is this many seconds before its last instant.
STANDS_S = 5.0
#: Largest number of sensors of a wire that are named where no source takes their reports.
MOST_SENSORS = 20
#: An alarm is raised if half of the last SLOW_TICKS ticks take longer than their interval by the factor SLOWER.
SLOW_TICKS, SLOWER = 10, 1.2
#: Alarms that are kept where there is no journal, once they have ended; those that are active are kept whatever their
#: number.
MOST_UNSAVED = 500
#: Largest number of alarms that wait for a terminal that takes none: it may be stopped.
MOST_BEGUN = 100_000
#: Number of ticks whose durations are kept.
KEPT_DURATIONS = 600


@dataclass
class SourceState:
    """State of a source. refused : reports not used. error : the last reason, and error_s : since when there is one.

    last_s : last receive time. delay_s : receive time minus time stamp, median of the last reports.
    """

    refused: int = 0
    error: str = ""
    error_s: float = math.inf
    last_s: float = -math.inf
    delay_s: float = math.nan

    def set_error(self, error: str, time_s: float) -> None:
        """Sets the reason why reports were not used, at this time."""
        self.error_s = self.error_s if self.error else time_s
        self.error = error


@dataclass
class Delta:
    """The changes from one tick to the next, as sent to web pages."""

    tick: int
    time_s: float
    objects: list[tuple[Any, ...]] = field(default_factory=list)
    removed_objects: list[int] = field(default_factory=list)
    records: list[tuple[Any, ...]] = field(default_factory=list)
    removed_records: list[str] = field(default_factory=list)

    @classmethod
    def between(cls, previous: Situation | None, situation: Situation) -> Delta:
        """The changes from one situation to the next; all rows where there was none before."""
        old_objects = {} if previous is None else previous.object_rows
        old_records = {} if previous is None else previous.record_rows
        return cls(
            situation.tick, situation.time_s,
            [row for n, row in situation.object_rows.items() if old_objects.get(n) != row],
            [n for n in old_objects if n not in situation.object_rows],
            [row for key, row in situation.record_rows.items() if old_records.get(key) != row],
            [key for key in old_records if key not in situation.record_rows],
        )  # fmt: skip


class Keeper:
    """The live picture for given settings.

    Parameters
    ----------
    settings : sources and watch options. folder : for state, journal and archive; None writes none of them.
    replay : reports of files instead of wires. playback : recordings of the wires, as they were received. clock : UTC
        in seconds; that of the computer if not given.

    Raises
    ------
    InputError : a source has no wire and is not replayed; the folder cannot be written.
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
        clock = clock or SteadyClock()
        if playback is not None:
            # All times are those of the recording, which is not recorded again.
            real_clock, played = clock, playback
            settings = replace(settings, watch=replace(settings.watch, record=None))

            def clock() -> float:
                return played.time_s(real_clock())

        self._real_clock = clock if playback is None else real_clock
        self.settings, self.folder, self.replay, self.clock = settings, folder, replay, clock
        self.playback = playback
        self.wires = _wires(settings, clock) if replay is None else {}
        for wire in self.wires.values() if playback is not None else ():
            wire.state.open_word = "replayed"
        self.sources = {name: SourceState() for name in settings.sources}
        self.situation: Situation | None = None
        # The state of the last tick, from which explanations are made.
        self._state: PictureState[Any] | None = None
        self.deltas: deque[Delta] = deque(maxlen=KEPT_DELTAS)
        self.history: deque[Situation] = deque()
        #: Alarms that began, with their times, for the terminal, which takes them.
        self.begun: deque[tuple[float, Alarm]] = deque(maxlen=MOST_BEGUN)
        self.counters: Counter[str] = Counter()
        # The last exception of a tick.
        self._fault = ""
        #: Seconds by which a replay waited for the picture.
        self.waited_s = 0.0
        self.durations_s: deque[float] = deque(maxlen=KEPT_DURATIONS)
        self.lock = threading.Lock()
        self.sinks = sinks_of(settings.watch.outputs)
        self._listeners: set[asyncio.Event] = set()
        # Whether no tick will follow.
        self.ended = False
        self._alarms: dict[str, tuple[int, float]] = {}
        self.approaches = Approaches(settings.watch)
        # Latitude, longitude and heading of the sensor with the last replayed report of the source of own ship.
        self._station = (math.nan, math.nan, math.nan)
        self._own: deque[tuple[float, float, float]] = deque(maxlen=30)
        self._saved_s = self._registered_s = self._searched_s = -math.inf
        self._faults: dict[str, Fault] = {}
        self._suspected: frozenset[str] = frozenset()
        #: Sensors whose reports no source takes, by wire.
        self._foreign: dict[str, set[str]] = {}
        #: Alarms that are not in the journal, by their negative ids, as it would have them.
        self._unsaved: dict[int, dict[str, Any]] = {}
        #: Why the journal or the state could not be written when last tried.
        self._refusals: dict[str, str] = {}
        self._tick = 0
        # Receive times are compared with the time at which the queues were emptied: a tick may take long.
        self._began_s = self._taken_s = clock()
        watch = settings.watch
        with contextlib.ExitStack() as opened:
            self.journal = None if folder is None else Journal(folder, archive_every_s=watch.archive_every_s)
            if self.journal is not None:
                opened.callback(self.journal.close)
            self._restore(folder)
            opened.pop_all()

    def _restore(self, folder: Path | None) -> None:
        """Continues with the saved state of the folder; without one, begins anew."""
        watch, settings = self.settings.watch, self.settings
        state = None if folder is None else load_state(folder)
        descriptions = [source.description for source in settings.sources.values()]
        origin = watch.origin or (None if self.replay is None else self.replay.origin)
        self.picture = LivePicture(descriptions, plane=origin, lag_s=watch.lag_s)
        with reading(f"{folder}: the state of the watch", "is damaged"):
            self.restored = state is not None
            #: Names of the sources that are new or described differently since the state was saved.
            self.changed: tuple[str, ...] = ()
            if state is not None:
                self.picture, self._tick = state["picture"], int(state["tick"])
                self.picture.instant_s  # noqa: B018 (the state may hold anything by that name)
                self._require_plane(self.picture.plane)
                self.changed = self.picture.describe(descriptions, watch.lag_s)
        if self.journal is not None:
            self._alarms = {key: (alarm_id, self.picture.instant_s) for key, alarm_id in self.journal.active().items()}

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
        clock_s = self.clock()
        now_s = clock_s if self.replay is None else self.replay.now_s(clock_s)
        return now_s - self.settings.watch.behind_s

    @property
    def pace(self) -> float | None:
        """How many times as fast files or recordings are replayed; None where nothing is."""
        return None if self._replayed is None else self._replayed.pace

    @property
    def done(self) -> bool:
        """Whether all that is replayed has been taken."""
        return self._replayed is not None and self._replayed.done

    @property
    def _replayed(self) -> Replay | Playback | None:
        return self.replay or self.playback

    def tick(self, now_s: float | None = None) -> Situation | None:
        """Processes the new reports and returns the situation then; None, and a log entry, where this failed."""
        began = time.perf_counter()
        instant_s = max(self.now_s() if now_s is None else now_s, self.picture.instant_s)
        self._take_reports(instant_s)
        try:
            state: PictureState[Any] = self.picture.advance(instant_s)
        except Exception as error:
            # A fault in one tick must not end the watch: the next tick has other reports.
            # One that stays must not fill the terminal.
            LOG.error("tick at %.1f s: %r", instant_s, error, exc_info=repr(error) != self._fault)
            self._fault = repr(error)
            self.counters["faults"] += 1
            self._raise_alarms([Alarm("fault", "fault", f"the picture could not be advanced: {error}")], instant_s)
            return None
        with self.lock:
            self._tick += 1
            own_ship = self._own_ship(instant_s, state)
            situation = Situation.of(self._tick, state, self.picture.plane, (), own_ship, self.picture.height_model)
            alarms = [*_identity_alarms(state), *self._source_alarms(), *self._fault_alarms(situation),
                      *self._own_ship_alarms(situation), *self._approach_alarms(situation, state),
                      *self._folder_alarms(), *self._pace_alarms(), *self._clock_alarms()]  # fmt: skip
            situation = replace(situation, alarms=tuple(alarms))
            self._raise_alarms(alarms, instant_s)
            self.deltas.append(Delta.between(self.situation, situation))
            self.situation, self._state = situation, state
            self._keep_history(situation)
            self._try_journal(lambda journal: journal.write(situation))
            if self.journal is not None and instant_s - self._saved_s >= self.settings.watch.save_every_s:
                self._try_journal(lambda journal: self.save(), "state")
        self.durations_s.append(time.perf_counter() - began)
        self.counters["ticks"] += 1
        return situation

    def _tick_and_send(self) -> None:
        situation = self.tick()
        if situation is not None:
            for sink in self.sinks:
                sink.send(situation)

    def save(self) -> None:
        """Saves the state."""
        if self.folder is not None:
            save_state(self.folder, {"picture": self.picture, "tick": self._tick})
            self._saved_s = self.picture.instant_s

    def register(self) -> None:
        """Estimates the biases of the sources from the last minutes; a failure is logged and changes nothing."""
        try:
            self.picture.register()
        except Exception as error:
            # A failed bias fit must not end the watch: the previous biases stay in use.
            LOG.info("registration: %s", error, exc_info=not isinstance(error, InputError))

    def search(self) -> None:
        """Searches the last minutes for deception and source faults; a failure is logged and changes nothing.

        A fault raises an alarm when two successive searches find it: with a search every half minute, the false-alarm
        rate of a single search would be too high.
        """
        with self.lock:
            recent, sightings, tuning = self.picture.recent(), self.picture.sightings(), self.picture.picture_tuning
        try:
            faults = faults_of(recent, sightings, self.picture.plane, self.picture.tuning, tuning)
        except Exception as error:
            # A failed search must not end the watch.
            LOG.info("faults: %s", error, exc_info=not isinstance(error, InputError))
            return
        found = {f"{fault.kind} {fault.source} {fault.track}".rstrip(): fault for fault in reversed(faults)}
        with self.lock:
            self._faults = {key: fault for key, fault in found.items() if key in self._suspected}
            self._suspected = frozenset(found)

    def _take_reports(self, until_s: float) -> None:
        self._taken_s = self.clock()
        if self.playback is not None:
            for url, piece, dropped in self.playback.take(self._taken_s):
                self.wires[url].play(piece, dropped)
        if self.replay is not None:
            for name, reports in self.replay.take(until_s):
                self._add(name, reports, self.clock())
            return
        for url, wire in self.wires.items():
            try:
                parts = wire.take()
            except InputError as error:
                for name in self._names_on(url):
                    self.sources[name].set_error(_in_settings(error, name), self._taken_s)
                self.counters["refused pieces"] += 1
                continue
            for reports in parts:
                taken = [n for n in self._names_on(url) if self.settings.sources[n].takes(reports)]
                if not taken:
                    sensors = self._foreign.setdefault(url, set())
                    if len(sensors) < MOST_SENSORS:
                        sensors.add(reports.source.partition(":")[2] or reports.source)
                    self.counters[f"reports of no source: {reports.source}"] += len(reports)
                for name in taken[:1]:
                    self._add(name, reports, wire.state.last_s)

    def _names_on(self, url: str) -> list[str]:
        return [name for name, source in self.settings.sources.items() if source.url == url]

    def _add(self, name: str, reports: Reports, received_s: float) -> None:
        state = self.sources[name]
        if self.replay is None:
            # Older ones may have waited in the queue.
            state.delay_s = received_s - float(np.median(np.sort(reports.time_s)[-5:]))
            ahead = reports.time_s > self._taken_s + AHEAD_S
            if ahead.any():
                state.refused += int(ahead.sum())
                reports, state.last_s = reports.where(~ahead), received_s
        if not len(reports):
            return
        try:
            self.picture.add(name, reports)
        except InputError as error:
            state.refused += len(reports)
            state.set_error(_in_settings(error, name), self._taken_s)
            return
        state.last_s, state.error = received_s, ""
        self.approaches.take(reports)
        own = self.settings.watch.own_ship
        if self.replay is not None and own is not None and own.source == name:
            self._station = _last_station(reports, self._station)

    def _keep_history(self, situation: Situation) -> None:
        """Keeps a situation every 10 s, or every tick where these are longer, for the history that pages show."""
        every_s = max(10.0, self.settings.watch.every_s)
        if not self.history or situation.time_s - self.history[-1].time_s >= every_s:
            self.history.append(situation)
        while self.history and situation.time_s - self.history[0].time_s > self.settings.watch.history_s:
            self.history.popleft()

    # ---- own ship and alarms ----

    def _own_ship(self, now_s: float, state: PictureState[Any]) -> OwnShipState | None:
        own, plane = self.settings.watch.own_ship, self.picture.plane
        if own is None:
            return None
        if own.mmsi is not None:
            texts = state.watch.texts
            for k, number in enumerate(state.objects.number.tolist()):
                if number in texts and texts[number][0] == own.mmsi and state.objects.placed[k]:
                    return OwnShipState(*state.objects.state[k].tolist())
            return None
        if plane is None:
            return None
        heading = math.nan
        lat, lon = own.lat_deg, own.lon_deg
        if own.source is not None and own.source in self.settings.sources:
            wire = self._own_wire()
            lat, lon, heading = self._station if wire is None else wire.stream.own_ship
            if wire is not None and self._taken_s - wire.stream.own_ship_s > self.settings.watch.silent_s:
                # Approaches to where she was would be worse than none.
                return None
        if lat is None or lon is None or not math.isfinite(lat + lon):
            return None
        east, north = plane.of_geodetic([lat], [lon])[0].tolist()
        # A position that stays is one, too: else the first jitter of a receiver alongside is the speed of a ship.
        if not self._own or self._own[-1][1:] != (east, north) or now_s - self._own[-1][0] >= 1.0:
            self._own.append((now_s, east, north))
        speed, course = self._own_over_ground()
        if math.isfinite(speed + course):
            angle = math.radians(course)
            return OwnShipState(east, north, speed * math.sin(angle), speed * math.cos(angle), heading)
        return OwnShipState(east, north, *self._own_velocity(now_s), heading)

    def _approach_alarms(self, situation: Situation, state: LiveState) -> list[Alarm]:
        wire = self._own_wire()
        return self.approaches.alarms(situation, state, self._alarms, "" if wire is None else wire.stream.own_mmsi)

    def _own_wire(self) -> Wire | None:
        """The wire of the source that gives own ship's position; None where no source does, or it is replayed."""
        own = self.settings.watch.own_ship
        source = None if own is None or own.source is None else self.settings.sources.get(own.source)
        return None if source is None else self.wires.get(source.url or "")

    def _own_over_ground(self) -> tuple[float, float]:
        """Speed (m/s) and course (degrees) of own ship as her receiver gives them, NaN where it does not."""
        wire = self._own_wire()
        speed, course = (math.nan, math.nan) if wire is None else wire.stream.own_velocity
        # One that rests has no course.
        return speed, 0.0 if speed == 0.0 and math.isnan(course) else course

    def _own_velocity(self, now_s: float) -> tuple[float, float]:
        """Slope (m/s east, north) of a line through the positions of the last 30 s; 0 where they span less than 1 s."""
        recent = [one for one in self._own if one[0] > now_s - 30.0]
        if len(recent) < 2 or recent[-1][0] - recent[0][0] < 1.0:
            return 0.0, 0.0
        times, east, north = np.array(recent).T
        slope = np.polynomial.polynomial.polyfit(times - times[-1], np.column_stack([east, north]), 1)[1]
        return float(slope[0]), float(slope[1])

    def _source_alarms(self) -> list[Alarm]:
        watch, clock_s, silent = self.settings.watch, self._taken_s, self._silent_wires()
        out = [Alarm(f"set aside {name}", "source", f"{name} is set aside: {why.removeprefix(name + ': ')}")
               for name, why in self.settings.set_aside.items()]  # fmt: skip
        out += [self._wire_alarm(url, names) for url, names in silent.items()]
        on_silent = {name for names in silent.values() for name in names}
        for name, state in self.sources.items() if self.replay is None else ():
            if name in on_silent:
                continue
            never = not math.isfinite(state.last_s)
            if never and (reason := self._misfit(name)):
                out.append(Alarm(f"silent {name}", "source", f"{name}: none of its data can be used: {reason}"))
            elif clock_s - max(state.last_s, self._began_s) > watch.silent_s and not self._gives_own_ship(name):
                text = f"{name} has sent no report {self._since(state.last_s)}: {self._silence(name)}"
                out.append(Alarm(f"silent {name}", "source", text))
            elif abs(state.delay_s) > watch.clock_s:
                sense = "behind" if state.delay_s > 0.0 else "ahead of"
                zone = self._zone_hint(name) if _is_time_zone(state.delay_s) else ""
                by = in_words(abs(state.delay_s))
                text = f"{name}: its time stamps are {by} {sense} the times of receipt{zone}"
                out.append(Alarm(f"clock {name}", "source", text))
        for url, wire in self.wires.items():
            if wire.queue.dropped > self.counters[f"dropped {url}"]:
                out.append(
                    Alarm(
                        f"flood {url}", "source", f"{url} sends more than can be processed; the oldest data are dropped"
                    )
                )
                self.counters[f"dropped {url}"] = wire.queue.dropped
        return out

    def _own_ship_alarms(self, situation: Situation) -> list[Alarm]:
        """An alarm where own ship's position is to be on the wire of a source, and is not: no approach is computed."""
        own, silent_s = self.settings.watch.own_ship, self.settings.watch.silent_s
        if self.replay is not None or own is None or own.source is None or situation.own_ship is not None:
            return []
        wire = self._own_wire()
        last_s = self._began_s if wire is None else max(wire.stream.own_ship_s, self._began_s)
        if self._taken_s - last_s <= silent_s:
            return []
        text = f"own ship: {own.source} has given no position for {silent_s:.0f} s; no approach is watched"
        return [Alarm("own ship", "source", text)]

    def _silent_wires(self) -> dict[str, list[str]]:
        """The wires of several sources on which nothing has arrived for too long, with the names of their sources."""
        silent = [
            url for url, wire in self.wires.items()
            if self._taken_s - max(wire.state.last_s, self._began_s) > self.settings.watch.silent_s
        ]  # fmt: skip
        return {url: names for url in silent if len(names := self._names_on(url)) > 1}

    def _wire_alarm(self, url: str, names: Sequence[str]) -> Alarm:
        """The alarm of a silent wire of several sources, one for all: their silence has one cause."""
        state = self.wires[url].state
        since = self._since(state.last_s)
        why = "nothing has arrived" if state.connected else f"it is not connected ({state.error or 'no answer'})"
        return Alarm(f"silent {url}", "source", f"{url}, of {listed(names)}, is silent {since}: {why}")

    def _since(self, last_s: float) -> str:
        """For how long something is silent whose last sign was at ``last_s``, −∞ for none, in words."""
        return f"for {self.settings.watch.silent_s:.0f} s" if math.isfinite(last_s) else "since the watch began"

    def _gives_own_ship(self, name: str) -> bool:
        """Whether the wire of a source gives the position of own ship now; it need not give reports, too."""
        own, wire = self.settings.watch.own_ship, self._own_wire()
        if own is None or own.source != name or wire is None or math.isnan(wire.stream.own_ship[0]):
            return False
        return self._taken_s - wire.state.last_s <= self.settings.watch.silent_s

    def _zone_hint(self, name: str) -> str:
        """The remedy for a clock that is wrong by whole hours, where its format can have any zone."""
        wire = self.wires[self.settings.sources[name].url or ""]
        return " (a time zone? give time_zone in its input)" if wire.stream.format in ZONED else " (a time zone?)"

    def _misfit(self, name: str) -> str:
        """Why no report of a source can be used, whatever else arrives; empty where none has arrived yet."""
        source, state = self.settings.sources[name], self.sources[name]
        if state.error:
            # Own ship's position, which targets need, may come with the next sentence.
            return state.error if self._taken_s - state.error_s >= MISFIT_S else ""
        foreign = self._foreign.get(source.url or "")
        if foreign and source.sensor is not None:
            given = ", ".join(sorted(foreign))
            return f'{source.url} has {given}, but no {source.sensor}: give sensor = "{min(foreign)}"'
        stream = self.wires[source.url or ""].stream
        damaged = sum(stream.damaged.values())
        if damaged >= MISFIT_LINES and not +stream.passed_over and len(self._names_on(source.url or "")) == 1:
            reason, n = stream.damaged.most_common(1)[0]
            remedy = "; leave out its format, to have it detected" if source.format else ""
            return f"{n} × {reason}{remedy}"
        return ""

    def _silence(self, name: str) -> str:
        """Why a source gives no reports, as far as its wire shows it."""
        source, state = self.settings.sources[name], self.sources[name]
        if state.error:
            return state.error
        wire = self.wires[source.url or ""]
        if not wire.state.connected:
            return f"{source.url} is not connected ({wire.state.error or 'no answer'})"
        if not math.isfinite(wire.state.last_s) or self._taken_s - wire.state.last_s > self.settings.watch.silent_s:
            return f"nothing arrives on {source.url}"
        unused = wire.stream.damaged + wire.stream.passed_over
        reasons = ", ".join(f"{n} × {reason}" for reason, n in unused.most_common(2))
        return f"data arrive on {source.url}, but none are its reports" + (f" ({reasons})" if reasons else "")

    def _folder_alarms(self) -> list[Alarm]:
        alarms = []
        if self._refusal:
            text = f"{self.folder} cannot be written; events are not saved: {self._refusal}"
            alarms.append(Alarm("folder", "fault", text))
        recorders = [wire.recorder for wire in self.wires.values() if wire.recorder is not None]
        if errors := list(dict.fromkeys(one.error for one in recorders if one.error)):
            folder = self.settings.watch.record
            text = f"{folder} cannot be written; what is received is not recorded: {'; '.join(errors)}"
            alarms.append(Alarm("record", "fault", text))
        return alarms

    def _pace_alarms(self) -> list[Alarm]:
        """An alarm where the picture is older than its interval says, because an instant takes longer than that."""
        last = list(self.durations_s)[-SLOW_TICKS:]
        every_s = self.settings.watch.every_s
        # An active alarm holds a little longer, so that the limit is not crossed again and again.
        limit_s = every_s if "pace" in self._alarms else SLOWER * every_s
        if self.replay is not None or len(last) < SLOW_TICKS or float(np.median(last)) <= limit_s:
            return []
        text = (
            f"an instant takes {np.median(last):.1f} s, and every_s is {every_s:g}: the picture is that old; give a "
            "longer every_s, or fewer sources"
        )
        return [Alarm("pace", "fault", text)]

    def _clock_alarms(self) -> list[Alarm]:
        """Alarms where the clock of this computer was set back, now or while the watch was ended."""
        alarms = []
        if isinstance(self.clock, SteadyClock) and self.clock.set_back_s > 0.0:
            by = in_words(self.clock.set_back_s)
            text = f"the clock of this computer was set back by {by}; the watch keeps the time before: set it right"
            alarms.append(Alarm("set back", "fault", text))
        early_s = self.picture.instant_s - self.now_s()
        if self.replay is None and early_s > STANDS_S:
            text = (
                f"the picture is {in_words(early_s)} later than the clock of this computer, and stands still until "
                "then: set the clock right, or move the folder of its state away and begin anew"
            )
            alarms.append(Alarm("stands still", "fault", text))
        return alarms

    @property
    def _refusal(self) -> str:
        """Why something could not be written to the folder when last tried; empty if all was."""
        return "; ".join(dict.fromkeys(self._refusals.values()))

    def _try_journal(self, write: Callable[[Journal], T], what: str = "journal") -> T | None:
        """The result of a write into the folder; None where there is no folder or the disk refuses.

        A full disk must not end the watch: it raises an alarm, and the missing rows are written once there is room.
        """
        if self.journal is None:
            return None
        try:
            value = write(self.journal)
        except (OSError, sqlite3.Error, InputError) as error:
            if what not in self._refusals:
                LOG.warning("%s: %s", self.folder, error)
            self._refusals[what] = str(error)
            self.counters["refused writes"] += 1
            return None
        self._refusals.pop(what, None)
        return value

    def _fault_alarms(self, situation: Situation) -> list[Alarm]:
        """Alarms of the last search: deception of tracks, faults of sources."""
        out = []
        for key, fault in self._faults.items():
            where = (fault.source, fault.track)
            objects = (
                tuple(number for number, tracks in situation.members.items() if where in tracks) if fault.track else ()
            )
            out.append(Alarm(key, "deception" if fault.track else "source", str(fault), objects))
        return out

    def _raise_alarms(self, alarms: list[Alarm], now_s: float) -> None:
        """Writes new alarms to the journal, and ends those whose condition has been absent for ``ALARM_ENDS_S``.

        Alarms that are not in the journal, because there is none or the disk refuses, have negative ids.
        """
        for alarm in alarms:
            known = self._alarms.get(alarm.key)
            if known is None:
                self.counters["alarms"] += 1
                self.begun.append((now_s, alarm))
            number = -self.counters["alarms"] if known is None else known[0]
            if number < 0:
                number = self._saved(number, alarm, now_s)
            self._alarms[alarm.key] = (number, now_s)
        for key, (alarm_id, held_s) in list(self._alarms.items()):
            if now_s - held_s > ALARM_ENDS_S:
                del self._alarms[key]
                if alarm_id > 0:
                    self._try_journal(partial(Journal.ended, alarm_id=alarm_id, time_s=held_s))
                elif alarm_id in self._unsaved:
                    self._unsaved[alarm_id] |= {"active": 0, "last_s": held_s}

    def _saved(self, number: int, alarm: Alarm, now_s: float) -> int:
        """The id of an alarm in the journal; where it cannot be written there, it is kept here, and the id stays."""
        saved = self._try_journal(partial(Journal.alarm, alarm=alarm, time_s=now_s))
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
            self._try_journal(lambda journal: journal.acknowledge(saved, who, when_s))
        return saved

    # ---- the loop ----

    async def run(self, *, until: Callable[[], bool] | None = None, stop: asyncio.Event | None = None) -> None:
        """Ticks until it is cancelled or ``until`` returns True; then saves the state.

        stop : ends the wait for the next tick, so that ``until`` is checked at once.
        """
        wires = self.wires.values() if self.playback is None else ()
        readers = [asyncio.create_task(wire.run()) for wire in wires]
        every_s = self.settings.watch.every_s
        registration: asyncio.Task[None] | None = None
        search: asyncio.Task[None] | None = None
        replayed = self._replayed
        if replayed is not None:
            from_s = self.picture.instant_s
            replayed.begin(self._real_clock(), from_s if self.restored and math.isfinite(from_s) else None)
        # Seconds of the keeper's clock in a second: that of a recording runs at its pace.
        tempo = 1.0 if self.playback is None else self.playback.pace
        next_s = self.clock()
        try:
            while until is None or not until():
                # Missed ticks are not caught up: the next one has all reports. A replay waits instead.
                late_s = max(self.clock() - next_s, 0.0)
                next_s += late_s
                if replayed is not None:
                    replayed.wait(late_s / tempo)
                    self.waited_s += late_s / tempo
                if self.playback is not None:
                    # Ticks are as far apart in the recording as they were.
                    next_s -= late_s
                await asyncio.to_thread(self._tick_and_send)
                self._tell_listeners()
                every = self.settings.watch.register_every_s
                due = every > 0.0 and self.picture.instant_s - self._registered_s >= every
                if due and (registration is None or registration.done()):
                    self._registered_s = self.picture.instant_s
                    registration = asyncio.create_task(asyncio.to_thread(self.register))
                every = self.settings.watch.faults_every_s
                due = every > 0.0 and self.picture.instant_s - self._searched_s >= every
                if due and (search is None or search.done()):
                    self._searched_s = self.picture.instant_s
                    search = asyncio.create_task(asyncio.to_thread(self.search))
                next_s += every_s
                wait_s = max(next_s - self.clock(), 0.0) / tempo
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
                background = (task for task in (registration, search) if task is not None)
                await asyncio.gather(*readers, *background, return_exceptions=True)
            finally:
                self.close()

    def close(self) -> None:
        """Saves the state and closes the journal.

        Raises
        ------
        InputError : the disk refused the state; the last one that was saved stays.
        """
        with self.lock:
            for sink in self.sinks:
                sink.close()
            for wire in self.wires.values():
                wire.close()
            self._try_journal(lambda journal: self.save(), "state")
            refusal = self._refusal
            self._try_journal(Journal.close)
            self.journal = None
            if refusal or self._refusal:
                raise InputError(
                    f"{self.folder}: the last state of the watch is not saved: {refusal or self._refusal}",
                    "make room, or give a folder that can be written",
                )

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
            journalled = self._try_journal(partial(Journal.alarms, most_ended=most_ended)) or []
            unsaved = [dict(row) for _, row in sorted(self._unsaved.items())]
            return [*unsaved, *journalled]

    def why(self, number: int) -> str:
        """Why its records are this object now; a sentence where no source shows it."""
        state = self._state
        if state is None or not (state.number == number).any():
            return f"no source shows object {number} now"
        return str(state.explain(number))

    def acknowledge(self, alarm_id: int, who: str) -> bool:
        """Records who acknowledged an alarm."""
        with self.lock:
            # In a replay, alarms and those who acknowledge them live in the time of the picture.
            time_s = self.clock() if self.replay is None or self.situation is None else self.situation.time_s
            if (row := self._unsaved.get(alarm_id)) is not None:
                fresh = row["acknowledged_s"] is None
                row |= {"acknowledged_s": time_s, "acknowledged_by": who[:80]} if fresh else {}
                return fresh
            # Larger numbers are none of SQLite's.
            if not 0 < alarm_id < 1 << 63:
                return False
            return bool(self._try_journal(lambda journal: journal.acknowledge(alarm_id, who, time_s)))

    def biases(self) -> dict[str, dict[str, Any]]:
        """By source with estimated biases, their text, whether they are established and so subtracted, and values."""
        return {
            name: {
                "text": found.values, "established": found.established, "log_evidence": round(found.log_evidence, 1),
                "values": {bias: {"value": one.value, "sigma": one.standard_error, "unit": one.unit}
                           for bias, one in found.parameters.items()},
            }
            for name, found in self.picture.estimates.items() if found.parameters
        }  # fmt: skip

    def alignment(self) -> dict[str, dict[str, Any]]:
        """By source, what is subtracted from its reports and why, in words, and whether an operator holds it."""
        out = {}
        for name, source in self.settings.sources.items():
            found, held = self.picture.estimates.get(name), name in self.picture.held
            subtracted = name in self.picture.biases
            state = "subtracted" if subtracted else "not established, not subtracted"
            if found is None or not found.parameters:
                state = "the others are compared with it" if found is not None and not found.notes else "none estimated"
            out[name] = {
                "described": _known_biases(source.description), "held": held, "state": state,
                "offsets": [] if found is None else [text for text in found.values.split(", ") if text],
                "by": "" if found is None or not found.parameters else f"{found.tracks:.0f} tracks in common with "
                f"{listed(found.against)}, log evidence {found.log_evidence:.0f}",
                "notes": [] if found is None else list(found.notes),
            }  # fmt: skip
        return out

    def hold(self, source: str, held: bool) -> bool:
        """Keeps the biases of a source as they are, or releases them; False for an unknown source."""
        with self.lock:
            if source not in self.settings.sources:
                return False
            self.picture.hold(source, held)
            return True

    def health(self) -> dict[str, Any]:
        """Whether the picture advances, and the counters of every source and wire."""
        age_s = None if self.situation is None else self.now_s() - self.situation.time_s
        late_s = max(10.0 * self.settings.watch.every_s * (self.pace or 1.0), 10.0)
        ticking = age_s is not None and abs(age_s) < late_s
        counts, biases = self.picture.counts, self.biases()
        sources = {
            name: {
                "reports": counts[name].taken, "late": counts[name].late, "repeated": counts[name].repeated,
                "jumps": counts[name].jumps, "refused": state.refused, "error": state.error,
                "delay_s": None if math.isnan(state.delay_s) else round(state.delay_s, 3),
                "biases": biases.get(name),
            }
            for name, state in self.sources.items()
        }  # fmt: skip
        wires = {
            url: {
                "connected": wire.state.connected, "connections": wire.state.connections, "error": wire.state.error,
                "bytes": wire.state.received, "dropped": wire.queue.dropped,
                "damaged": sum(wire.stream.damaged.values()), "damage": dict(+wire.stream.damaged),
                "unused": dict(wire.stream.passed_over),
                **({} if wire.recorder is None else
                   {"recorded": wire.recorder.written, "not_recorded": wire.recorder.lost}),
            }
            for url, wire in self.wires.items()
        }  # fmt: skip
        return {
            "ok": bool(ticking), "tick": self._tick,
            "time_s": None if self.situation is None else self.situation.time_s,
            "objects": 0 if self.situation is None else len(self.situation.objects["object"]),
            "harbour": self.approaches.in_harbour, "berthed": len(self.approaches.berthed),
            "faults": self.counters["faults"], "sources": sources, "wires": wires,
            "set_aside": dict(self.settings.set_aside),
            "outputs": {f"{sink.format} {sink.url}": {"failed": sink.failed, "unnumbered": sink.numbers.unnumbered}
                        for sink in self.sinks},
        }  # fmt: skip


def _known_biases(description: Description) -> str:
    """Printable: the biases that the description gives, and that are subtracted; empty for none."""
    known, late_s = description.calibration, description.timing.latency_s
    texts = {
        "range {:+g} m": known.range_m, "azimuth {:+g}°": known.azimuth_deg, "range gain {:+g}": known.range_gain,
        "east {:+g} m": known.east_m, "north {:+g} m": known.north_m, "stamps {:+g} s late": late_s or None,
    }  # fmt: skip
    return ", ".join(text.format(value) for text, value in texts.items() if value is not None)


def _last_station(reports: Reports, before: tuple[float, float, float]) -> tuple[float, float, float]:
    """Latitude, longitude and heading of the sensor at the last report that has them; as before where none has."""
    lat, lon = reports.station_lat_deg, reports.station_lon_deg
    if lat is None or lon is None or not np.isfinite(lat + lon).any():
        return before
    last = int(np.flatnonzero(np.isfinite(lat + lon))[-1])
    heading = reports.extra.get("station_heading_deg")
    return float(lat[last]), float(lon[last]), math.nan if heading is None else float(heading[last])


def _in_settings(error: InputError, name: str) -> str:
    """The text of an error of a source, with keys of its table in place of arguments, and without its name."""

    def key(argument: Argument) -> str:
        return f"{argument.table} in its input" if argument.keys else str(argument)

    text = error.words.with_options(key) if isinstance(error.words, Message) else str(error)
    return text.removeprefix(f"{name}: ")


def _is_time_zone(seconds: float) -> bool:
    """Whether a difference is a multiple of a quarter of an hour, within a minute, up to 14 h: time zones are such."""
    return 600.0 < abs(seconds) < 50_500.0 and abs(seconds - 900.0 * round(seconds / 900.0)) < 60.0


def _wires(settings: Settings, clock: Callable[[], float]) -> dict[str, Wire]:
    wires: dict[str, Wire] = {}
    for name, source in settings.sources.items():
        if source.url is None:
            raise InputError(f"{name}: has no input", 'give input = "udp://HOST:PORT", tcp://, serial: … in its table')
        with reading(f"{name}: input {source.url!r}", "cannot be listened to"):
            if source.url in wires:
                continue
            stream, recorder = ReportStream(name, source.format, source.options), None
            if (watch := settings.watch).record is not None:
                recorded = settings.recorded_input(source.url)
                recorder = Recorder(Path(watch.record), recorded, watch.record_hours * 3600.0)
            wires[source.url] = Wire(source.url, stream, clock=clock, recorder=recorder, login=source.login)
    return wires


def _identity_alarms(state: PictureState[Any]) -> list[Alarm]:
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

"""Reception: the new reports of all sources, tick by tick, and the alarms of sources that give none or wrong ones.

Reports come from the wires, from recordings that are played to the wires, or from a replay of files. What cannot be
used is counted at its source, with the reason.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Container, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from sameas.errors import Argument, InputError, Message, reading
from sameas.io.sensors.format import kind_of
from sameas.io.sensors.recording import Recorder, taker
from sameas.io.sensors.report_formats import ZONED
from sameas.io.sensors.stream import ReportStream
from sameas.live.inputs import Wire, serial_speed
from sameas.live.replay import Playback, Replay, in_words
from sameas.live.settings import Settings
from sameas.live.situation import Alarm
from sameas.representation import listed
from sameas.tracks.kinds import AT_REST_EVERY_S
from sameas.tracks.platforms import gives_own_ship
from sameas.tracks.reports import Reports

#: A source that never gave a report raises an alarm when its data have been unusable for this many seconds.
MISFIT_S = 5.0
#: The same if this many lines were damaged and none was good.
MISFIT_LINES = 20
#: Reports whose stamps are later than this many seconds from now are refused: kept until then, they would fill memory.
AHEAD_S = 600.0
#: A source that gave nothing for this many seconds has paused; one whose stamps stand for as long repeats its reports.
RESUMED_S = 10.0
#: A source has paused if it is silent for so many times its mean pause, at most so many seconds (chosen): reports of a
#: few ships at anchor, three minutes apart, come in bunches. Of AIS with so long mean pauses all may be at anchor.
PAUSES, MOST_PAUSE_S, SPARSE_S = 5.0, 600.0, 5.0
#: Number of pauses whose mean counts.
PAUSES_KEPT = 9
#: A serial line that shows nothing readable in as many bytes has another speed: NMEA has 82 in a sentence.
LEAST_BYTES = 250
#: Largest number of kinds of sentences that are named where none is a report.
MOST_KINDS = 6
#: Largest number of sensors of a wire that are named where no source takes their reports.
MOST_SENSORS = 20


@dataclass
class SourceState:
    """State of a source. refused : reports not used. error : the last reason, and error_s : since when there is one.

    last_s : last receive time. delay_s : receive time minus time stamp, median of the last reports: stamp_s is theirs,
    and moved_s when the first with it were received. pause_s, resumed_s : last pause of the source, and its end.
    pauses_s : the last ones between receipts.
    """

    refused: int = 0
    error: str = ""
    error_s: float = math.inf
    last_s: float = -math.inf
    delay_s: float = math.nan
    stamp_s: float = math.nan
    moved_s: float = math.nan
    pause_s: float = 0.0
    resumed_s: float = -math.inf
    pauses_s: deque[float] = field(default_factory=lambda: deque(maxlen=PAUSES_KEPT))

    def longest_pause_s(self, kind: str) -> float:
        """For how long a source of this kind that gives reports may pause, by its own pauses."""
        mean_s = sum(self.pauses_s) / len(self.pauses_s) if self.pauses_s else SPARSE_S
        at_rest_s = AT_REST_EVERY_S + RESUMED_S if kind == "ais" and mean_s >= SPARSE_S else 0.0
        return max(min(PAUSES * mean_s, MOST_PAUSE_S), at_rest_s)

    def set_delay(self, stamp_s: float, received_s: float) -> None:
        """Takes the time stamp of the last reports, received at this time."""
        if stamp_s != self.stamp_s:
            self.stamp_s, self.moved_s = stamp_s, received_s
        self.delay_s = received_s - stamp_s
        pause_s = received_s - self.last_s
        if 0.0 < pause_s < math.inf:
            self.pauses_s.append(pause_s)
            if pause_s > RESUMED_S:
                self.pause_s, self.resumed_s = pause_s, received_s

    def clock_words(self, now_s: float) -> str:
        """What makes the time stamps differ from the times of receipt: their source repeats its last reports, sends
        after a pause what it had kept, or has a wrong clock."""
        by = in_words(abs(self.delay_s))
        if self.delay_s > 0.0 and min(self.delay_s, now_s - self.moved_s) > RESUMED_S:
            return f"repeats its last reports, whose time stamps are {by} old: it is frozen, or its clock is"
        if 0.0 < self.delay_s <= self.pause_s and now_s - self.resumed_s < self.pause_s:
            return f"sends, after a pause of {in_words(self.pause_s)}, what it had kept; its last reports are {by} old"
        return f"its time stamps are {by} {'behind' if self.delay_s > 0.0 else 'ahead of'} the times of receipt"

    def set_error(self, error: str, time_s: float) -> None:
        """Sets the reason why reports were not used, at this time."""
        self.error_s = self.error_s if self.error else time_s
        self.error = error


class Reception:
    """The wires and the states of all sources.

    settings : sources and watch options. clock : UTC in seconds. replay : reports of files instead of wires.
    playback : recordings of the wires, as they were received. use : takes the reports of a source, by name.

    wires : by URL. sources : by name. began_s : when the reception began. taken_s : when reports were last taken.
        Receive times are compared with this: a tick may take long.

    Raises InputError: a source has no wire and is not replayed.
    """

    def __init__(
        self,
        settings: Settings,
        clock: Callable[[], float],
        *,
        replay: Replay | None = None,
        playback: Playback | None = None,
        use: Callable[[str, Reports], None],
    ) -> None:
        self.settings, self.clock, self.replay, self.playback = settings, clock, replay, playback
        self._use = use
        self.wires = _wires(settings, clock) if replay is None else {}
        for wire in self.wires.values() if playback is not None else ():
            wire.state.open_word = "replayed"
        self.sources = {name: SourceState() for name in settings.sources}
        #: Sensors whose reports no source takes, and the kind of each, by wire.
        self._foreign: dict[str, dict[str, str | None]] = {}
        #: Pieces dropped by each wire at the last alarm of it.
        self._dropped: dict[str, int] = {}
        self.began_s = self.taken_s = clock()

    # ---- reports ----

    def take(self, until_s: float) -> None:
        """Takes the new reports of all sources; of a replay those up to this time."""
        self.taken_s = self.clock()
        if self.playback is not None:
            for url, piece, dropped in self.playback.take(self.taken_s):
                self.wires[url].play(piece, dropped)
        if self.replay is not None:
            self._add_all([(name, reports, self.clock()) for name, reports in self.replay.take(until_s)])
            return
        received: list[tuple[str, Reports, float]] = []
        for url, wire in self.wires.items():
            try:
                parts = wire.take()
            except InputError as error:
                for name in self._names_on(url):
                    self.sources[name].set_error(_in_settings(error, name), self.taken_s)
                continue
            for reports in parts:
                owner = taker((self.settings.sources[n].recorded for n in self._names_on(url)), reports)
                sensors = self._foreign.setdefault(url, {})
                if owner is not None:
                    received.append((owner, reports, wire.state.last_s))
                elif len(sensors) < MOST_SENSORS:
                    sensors[reports.source.partition(":")[2] or reports.source] = kind_of(reports.kind)
        self._add_all(received)

    def _add_all(self, received: list[tuple[str, Reports, float]]) -> None:
        """Takes reports with their receive times, those of a sensor after those of the vessel that carries it."""

        def order(one: tuple[str, Reports, float]) -> int:
            name, reports, _ = one
            if gives_own_ship(reports):
                return 0
            return 1 if self.settings.sources[name].description.platform is None else 2

        for name, reports, received_s in sorted(received, key=order):
            self.add(name, reports, received_s)

    def add(self, name: str, reports: Reports, received_s: float) -> None:
        """Takes reports of a source that were received at this time, as far as they can be used."""
        state = self.sources[name]
        if self.replay is None:
            # Older ones may have waited in the queue.
            state.set_delay(float(np.median(np.sort(reports.time_s)[-5:])), received_s)
            ahead = reports.time_s > self.taken_s + AHEAD_S
            if ahead.any():
                state.refused += int(ahead.sum())
                reports, state.last_s = reports.where(~ahead), received_s
        if not len(reports):
            return
        try:
            self._use(name, reports)
        except InputError as error:
            state.refused += len(reports)
            state.set_error(_in_settings(error, name), self.taken_s)
            return
        state.last_s, state.error = received_s, ""

    def _names_on(self, url: str) -> list[str]:
        return [name for name, source in self.settings.sources.items() if source.url == url]

    # ---- alarms ----

    def alarms(self, excused: Container[str | None] = ()) -> list[Alarm]:
        """Alarms of sources that were set aside, are silent or cannot be used, of clocks, and of floods.

        excused : names of sources that need give no reports now.
        """
        watch, clock_s, silent = self.settings.watch, self.taken_s, self._silent_wires()
        out = [Alarm(f"set aside {name}", "source", f"{name} is set aside: {why.removeprefix(name + ': ')}")
               for name, why in self.settings.set_aside.items()]  # fmt: skip
        out += [self._wire_alarm(url, names) for url, names in silent.items()]
        on_silent = {name for names in silent.values() for name in names}
        for name, state in self.sources.items() if self.replay is None else ():
            if name in on_silent:
                continue
            never, allowed_s = not math.isfinite(state.last_s), self._allowed_s(name)
            if never and (reason := self._misfit(name)):
                out.append(Alarm(f"silent {name}", "source", f"{name}: none of its data can be used: {reason}"))
            elif clock_s - max(state.last_s, self.began_s) > allowed_s and name not in excused:
                text = f"{name} has sent no report {_since(state.last_s, allowed_s)}: {self._silence(name)}"
                out.append(Alarm(f"silent {name}", "source", text))
            elif abs(state.delay_s) > watch.clock_s:
                words = state.clock_words(clock_s)
                zone = self._zone_hint(name) if words.startswith("its") and is_time_zone(state.delay_s) else ""
                out.append(Alarm(f"clock {name}", "source", f"{name}: {words}{zone}"))
        for url, wire in self.wires.items():
            if wire.queue.dropped > self._dropped.get(url, 0):
                text = f"{url} sends more than can be processed; the oldest data are dropped"
                out.append(Alarm(f"flood {url}", "source", text))
                self._dropped[url] = wire.queue.dropped
        return out

    def recorder_errors(self) -> list[str]:
        """Why what is received cannot be recorded, each reason once."""
        recorders = [wire.recorder for wire in self.wires.values() if wire.recorder is not None]
        return list(dict.fromkeys(one.error for one in recorders if one.error))

    def _silent_wires(self) -> dict[str, list[str]]:
        """The wires of several sources on which nothing has arrived for too long, with the names of their sources."""
        silent = [
            url for url, wire in self.wires.items()
            if self.taken_s - max(wire.state.last_s, self.began_s) > self.settings.watch.silent_s
        ]  # fmt: skip
        return {url: names for url in silent if len(names := self._names_on(url)) > 1}

    def _wire_alarm(self, url: str, names: Sequence[str]) -> Alarm:
        """The alarm of a silent wire of several sources, one for all: their silence has one cause."""
        state = self.wires[url].state
        since = _since(state.last_s, self.settings.watch.silent_s)
        why = "nothing has arrived" if state.connected else f"it is not connected ({state.error or 'no answer'})"
        return Alarm(f"silent {url}", "source", f"{url}, of {listed(names)}, is silent {since}: {why}")

    def _allowed_s(self, name: str) -> float:
        """For how long a source may give no report; longer than ``silent_s`` if its own pauses are."""
        state, kind = self.sources[name], self.settings.sources[name].description.kind
        usual_s = state.longest_pause_s(kind) if math.isfinite(state.last_s) else 0.0
        return max(self.settings.watch.silent_s, usual_s)

    def _zone_hint(self, name: str) -> str:
        """The remedy for a clock that is wrong by whole hours, where its format can have any zone."""
        wire = self.wires[self.settings.sources[name].url or ""]
        return " (a time zone? give time_zone in its input)" if wire.stream.format in ZONED else " (a time zone?)"

    def _misfit(self, name: str) -> str:
        """Why no report of a source can be used, whatever else arrives; empty where none has arrived yet."""
        source, state = self.settings.sources[name], self.sources[name]
        if state.error:
            # Own ship's position, which targets need, may come with the next sentence.
            return state.error if self.taken_s - state.error_s >= MISFIT_S else ""
        foreign = self._foreign.get(source.url or "")
        if foreign and source.sensor is not None:
            given = ", ".join(sorted(foreign))
            return f'{source.url} has {given}, but no {source.sensor}: give sensor = "{min(foreign)}"'
        stream = self.wires[source.url or ""].stream
        if speed := self._other_speed(source.url or ""):
            return speed
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
        if not math.isfinite(wire.state.last_s) or self.taken_s - wire.state.last_s > self.settings.watch.silent_s:
            return f"nothing arrives on {source.url}"
        if speed := self._other_speed(source.url or ""):
            return f"data arrive on {source.url}, but {speed}"
        unused = wire.stream.damaged + wire.stream.passed_over
        reasons = ", ".join(f"{n} × {reason}" for reason, n in unused.most_common(2))
        if foreign := self._foreign.get(source.url or ""):
            sensor, kind = min(foreign.items())
            reasons = f"{sensor} is there, of kind {kind}, not {source.description.kind}: change kind in its table"
        if not reasons and wire.stream.sentence_kinds:
            reasons = f"sentences {', '.join(sorted(wire.stream.sentence_kinds)[:MOST_KINDS])}"
        return f"data arrive on {source.url}, but none are its reports" + (f" ({reasons})" if reasons else "")

    def _other_speed(self, url: str) -> str:
        """What a serial line says that runs at another speed than its address; empty where anything can be read."""
        wire = self.wires[url]
        stream = wire.stream
        readable = stream.sentence_kinds or stream.format not in (None, "nmea") or wire.state.received < LEAST_BYTES
        if not url.startswith("serial:") or readable:
            return ""
        return f"none of it can be read: is its speed another than ?baud={serial_speed(url)}?"

    # ---- counters ----

    def wire_counters(self) -> dict[str, dict[str, Any]]:
        """By URL: whether the wire is connected, and how much it received, dropped, decoded and recorded."""
        return {
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


def _in_settings(error: InputError, name: str) -> str:
    """The text of an error of a source, with keys of its table in place of arguments, and without its name."""

    def key(argument: Argument) -> str:
        return f"{argument.table} in its input" if argument.keys else str(argument)

    text = error.words.with_options(key) if isinstance(error.words, Message) else str(error)
    return text.removeprefix(f"{name}: ")


def is_time_zone(seconds: float) -> bool:
    """Whether a difference is a multiple of a quarter of an hour, within a minute, up to 14 h: time zones are such."""
    return 600.0 < abs(seconds) < 50_500.0 and abs(seconds - 900.0 * round(seconds / 900.0)) < 60.0


def _wires(settings: Settings, clock: Callable[[], float]) -> dict[str, Wire]:
    wires: dict[str, Wire] = {}
    platforms = [source.description.platform for source in settings.sources.values()]
    carriers = {platform.source for platform in platforms if platform is not None}
    for name, source in settings.sources.items():
        if source.url is None:
            raise InputError(f"{name}: has no input", 'give input = "udp://HOST:PORT", tcp://, serial: … in its table')
        with reading(f"{name}: input {source.url!r}", "cannot be listened to"):
            if source.url in wires:
                continue
            stream, recorder = ReportStream(name, source.format, source.options, name in carriers), None
            if (watch := settings.watch).record is not None:
                recorded = settings.recorded_input(source.url)
                recorder = Recorder(Path(watch.record), recorded, watch.record_hours * 3600.0)
            wires[source.url] = Wire(source.url, stream, clock=clock, recorder=recorder, login=source.login)
    return wires


def _since(last_s: float, silent_s: float) -> str:
    """For how long something is silent whose last sign was at ``last_s``, −∞ for none, in words."""
    return f"for {silent_s:.0f} s" if math.isfinite(last_s) else "since the watch began"

"""The time of a watch: that of the computer, or of reports of files and recordings that are replayed."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

from sameas.errors import InputError
from sameas.io.sensors.recording import Piece, Recording
from sameas.tracks.coordinates import LocalPlane
from sameas.tracks.reports import Reports


class SteadyClock:
    """UTC in seconds that is never set back: where the computer's clock is, it goes on as before, by ``set_back_s``.

    A clock that is set forward is followed: a small computer has no time of its own until a network gives it.

    wall : the clock of the computer. steady : seconds that nobody sets.
    """

    def __init__(self, wall: Callable[[], float] = time.time, steady: Callable[[], float] = time.monotonic) -> None:
        self._wall, self._steady = wall, steady
        self._lock = threading.Lock()
        self._last = wall(), steady()
        self.set_back_s = 0.0

    def __call__(self) -> float:
        with self._lock:
            wall_s, steady_s = self._wall(), self._steady()
            step_s = (wall_s - self._last[0]) - (steady_s - self._last[1])
            self._last = wall_s, steady_s
            # Networks correct clocks by fractions of a second all the time.
            if abs(step_s) > 1.0:
                self.set_back_s = max(self.set_back_s - step_s, 0.0)
            return wall_s + self.set_back_s


def in_words(seconds: float) -> str:
    """A time in the largest unit that fits.

    >>> in_words(7200.0), in_words(90.0), in_words(12.3)
    ('2.0 h', '1.5 min', '12 s')
    """
    for unit, size in (("days", 86400.0), ("h", 3600.0), ("min", 60.0)):
        if seconds >= size:
            return f"{seconds / size:.1f} {unit}"
    return f"{seconds:.0f} s"


class Paced:
    """What is replayed: its time runs from ``first_s`` to ``last_s``, ``pace`` times as fast as the clock."""

    pace: float
    first_s: float
    last_s: float
    _began_s = math.inf

    def __post_init__(self) -> None:
        if not 0.0 < self.pace < math.inf:
            raise InputError(f"replay: pace is {self.pace}; give a factor above 0")

    def begin(self, clock_s: float, from_s: float | None = None) -> None:
        """Starts at this time of the clock, from its beginning or after ``from_s``."""
        start_s = self.first_s if from_s is None else from_s
        self._began_s = clock_s - (start_s - self.first_s) / self.pace

    def wait(self, seconds: float) -> None:
        """Stops for this many seconds of the clock."""
        self._began_s += seconds

    def time_s(self, clock_s: float) -> float:
        """The replayed time at this time of the clock; the first before the beginning."""
        return self.first_s if math.isinf(self._began_s) else self.first_s + self.pace * (clock_s - self._began_s)


@dataclass
class Replay(Paced):
    """Replays the reports of files in the order of their times, at ``pace`` times real time.

    sources : name and reports of each source. pace : seconds of the reports per second of the clock.
    origin : the plane about all positions, unless the user gives one; None for metres on a plane of their own.

    >>> replay = Replay([("a", Reports.of("a", "table", {"time_s": [5.0, 7.0], "x_m": [0, 1], "y_m": [0, 0]}))], 2.0)
    >>> replay.begin(100.0)
    >>> replay.now_s(100.75), [(name, len(reports)) for name, reports in replay.take(6.5)]
    (6.5, [('a', 1)])
    >>> [(name, len(reports)) for name, reports in replay.take(7.0)], replay.done
    ([('a', 1)], True)
    """

    sources: list[tuple[str, Reports]]
    pace: float = 1.0
    origin: LocalPlane | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        self.sources = [(name, reports.in_time_order()) for name, reports in self.sources if len(reports)]
        if not self.sources:
            raise InputError("replay: no source has a report")
        self.first_s = min(float(reports.time_s[0]) for _, reports in self.sources)
        self.last_s = max(float(reports.time_s[-1]) for _, reports in self.sources)
        self._next = [0] * len(self.sources)

    def now_s(self, clock_s: float) -> float:
        """The replayed time at this time of the clock; the last report's where that has passed.

        At 100 times real time an instant may be 100 s after the last report: its objects would have ended.
        """
        return min(self.time_s(clock_s), self.last_s)

    @property
    def done(self) -> bool:
        """Whether all reports have been taken."""
        return all(k >= len(reports) for k, (_, reports) in zip(self._next, self.sources, strict=True))

    def apart(self) -> list[str]:
        """Sentences on the sources that have no time in common with any other, as with a clock in another time zone."""
        spans = [(name, float(reports.time_s[0]), float(reports.time_s[-1])) for name, reports in self.sources]
        out = []
        for k, (name, first_s, last_s) in enumerate(spans):
            others = [one for n, one in enumerate(spans) if n != k]
            if not others or any(first_s <= last and first <= last_s for _, first, last in others):
                continue
            later_s = first_s - max(last for _, _, last in others)
            earlier_s = min(first for _, first, _ in others) - last_s
            where = "between those of the others"
            if later_s > 0.0 or earlier_s > 0.0:
                where = f"{in_words(max(later_s, earlier_s))} {'after' if later_s > 0.0 else 'before'} all others"
            shift_s = first_s - min(first for _, first, _ in others)
            zone = f"; its first is {in_words(abs(shift_s))} {'after' if shift_s > 0 else 'before'} theirs"
            out.append(f"{name}: its reports are {where}{zone}: is its clock in another time zone, or its date wrong?")
        return out

    def take(self, until_s: float) -> list[tuple[str, Reports]]:
        """The reports up to this time that have not been taken yet."""
        out = []
        for s, (name, reports) in enumerate(self.sources):
            stop = int(reports.time_s.searchsorted(until_s, side="right"))
            if stop > self._next[s]:
                out.append((name, reports.where(range(self._next[s], stop))))
                self._next[s] = stop
        return out


@dataclass
class Playback(Paced):
    """Replays recordings as they were received: each piece at its receive time, ``pace`` times as fast.

    Late reports, clocks that jump, sources that fall silent and floods come again as they came.

    recordings : each with the wire that it was received on. pace : seconds of the recording per second of the clock.

    >>> from sameas.io.sensors.recording import RecordedInput
    >>> pieces = [(100.0, b"a", 1, False), (107.0, b"b", 1, False)]
    >>> played = Playback([("tcp://ais:1", Recording(RecordedInput(()), pieces, [0, 2, 0]))], pace=2.0)
    >>> played.begin(50.0)
    >>> played.time_s(52.0), played.take(104.0), played.done
    (104.0, [('tcp://ais:1', (100.0, b'a', 1, False), 0)], False)
    >>> played.take(107.0), played.done
    ([('tcp://ais:1', (107.0, b'b', 1, False), 2)], True)
    """

    recordings: list[tuple[str, Recording]]
    pace: float = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        self._pieces: list[tuple[float, str, Piece, int]] = []
        for url, recording in self.recordings:
            until_s = -math.inf
            for piece, dropped in zip(recording.pieces, recording.dropped, strict=False):
                # The clock of the receiver may have been set back: the order of receipt stays.
                until_s = max(until_s, piece[0])
                self._pieces.append((until_s, url, piece, dropped))
        if not self._pieces:
            raise InputError("replay: the recordings have no data")
        self._pieces.sort(key=lambda one: one[0])
        self.first_s, self.last_s = self._pieces[0][0], self._pieces[-1][0]
        self._next = 0

    def begin(self, clock_s: float, from_s: float | None = None) -> None:
        super().begin(clock_s, from_s)
        if from_s is not None:
            self.take(from_s)

    @property
    def done(self) -> bool:
        """Whether all pieces have been taken."""
        return self._next >= len(self._pieces)

    def take(self, until_s: float) -> list[tuple[str, Piece, int]]:
        """The pieces up to this time that have not been taken yet: wire, piece, and number of those lost before it."""
        out = []
        while not self.done and self._pieces[self._next][0] <= until_s:
            out.append(self._pieces[self._next][1:])
            self._next += 1
        return out


class WatchClock:
    """The clock of a watch: that of the computer, or the time at which played recordings were received.

    clock : UTC in seconds. replay : reports of files. playback : recordings; at most one of the two.
    """

    def __init__(
        self, clock: Callable[[], float], *, replay: Replay | None = None, playback: Playback | None = None
    ) -> None:
        self._clock, self.replay, self.playback = clock, replay, playback
        #: Seconds by which a replay waited for the picture.
        self.waited_s = 0.0
        #: Time of the recording during a tick, which takes none of it; None between ticks.
        self._tick_s: float | None = None

    def __call__(self) -> float:
        return self._running_s() if self._tick_s is None else self._tick_s

    def _running_s(self) -> float:
        clock_s = self._clock()
        return clock_s if self.playback is None else self.playback.time_s(clock_s)

    def replayed_s(self) -> float:
        """The time that files replay now; else that of the clock."""
        return self() if self.replay is None else self.replay.now_s(self())

    @property
    def set_back_s(self) -> float:
        """Seconds by which the clock of the computer was set back."""
        clock = self._clock
        return clock.set_back_s if self.playback is None and isinstance(clock, SteadyClock) else 0.0

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

    def begin(self, from_s: float | None) -> None:
        """Starts what is replayed, from its beginning or after ``from_s``."""
        if self._replayed is not None:
            self._replayed.begin(self._clock(), from_s)

    def begin_tick(self, due_s: float) -> float:
        """When a tick begins that is due at this time. What is replayed waits for one that is late."""
        late_s = max(self._running_s() - due_s, 0.0)
        if self._replayed is not None:
            self._replayed.wait(late_s / self._tempo)
            self.waited_s += late_s / self._tempo
        if self.playback is None:
            return due_s + late_s
        # Ticks are as far apart in a recording as they were.
        self._tick_s = due_s
        return due_s

    def end_tick(self, next_s: float) -> float:
        """Ends a tick; the seconds to wait for the next one, which is due at this time."""
        self._tick_s = None
        return max(next_s - self(), 0.0) / self._tempo

    @property
    def _tempo(self) -> float:
        """Seconds of this clock in a second: that of a recording runs at its pace."""
        return 1.0 if self.playback is None else self.playback.pace

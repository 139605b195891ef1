"""NMEA 0183: the sentences of a log, their checksums, and the log's own clock.

``$RATTM,…*hh`` of navigation equipment and ``!AIVDM,…*hh`` of AIS occur in the same files. The receive time may be a
tag block (``\\c:1241544035*53\\!AIVDM…``), a time before the sentence, a time after its checksum (coast guards), or a
``$PGHP`` sentence before it. Otherwise ``ZDA`` and ``RMC`` of own ship are the clock.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np

from sameas.arrays import FloatArray
from sameas.io.sensors.format import DAY_S, forward_filled, instant, seconds, unwrapped

#: A sentence without its checksum, or with a part of it.
CUT_OFF = "checksum cut off"
_SENTENCE = re.compile(r"([!$])([A-Z]{1,5}[A-Z0-9]{0,4})((?:,[^*]*)?)(?:\*([0-9A-Fa-f]{1,2}))?")
#: Between two sentences without a line end, as some dispatchers put them into a datagram.
_JOINT = re.compile(r"(?<=\*[0-9A-Fa-f]{2})(?=[!$])")
_TAG_BLOCK = re.compile(r"\\([^\\]*)\\")
_TAG_TIME = re.compile(r"(?:^|,)c:(\d+(?:\.\d+)?)")
#: The group of sentences, and the station, in a tag block (IEC 61162-450): \\g:1-2-73,s:r003669945*hh\\.
_TAG_GROUP = re.compile(r"(?:^|,)g:\d+-\d+-(\w+)")
_TAG_STATION = re.compile(r"(?:^|,)s:([^,*]+)")
#: A time of day alone, as terminal programs and pipes write it before a line: 15:35:17, [15:35:17.250].
_OF_DAY = re.compile(r"[\s\[(<]*([01]?\d|2[0-3]):([0-5]\d):([0-5]\d(?:\.\d+)?)[\s\])>;,|]*")
#: A date of the receive time with the day first, as German programs write it: 01.06.2026 12:00:00.
_DAY_FIRST = re.compile(r"(\d{1,2})\.(\d{1,2})\.(\d{4})[ T,]+(\d{1,2}):(\d{2}:\d{2}(?:\.\d+)?)")


@dataclass(frozen=True)
class Sentence:
    """One sentence. line : its number. text : from the first character to the checksum.

    kind : the sentence type without talker ("TTM" of "RATTM"). fields : the values after it.
    time_s : the receive time in the line, NaN where it has none. received_of_day_s : its time of day without a date.
    origin : what the sentences of one message have in common, and those of other stations have not: the talker, and the
    group or else the station of the tag block.
    """

    line: int
    text: str
    kind: str
    fields: tuple[str, ...]
    time_s: float
    origin: str = ""
    received_of_day_s: float = math.nan

    @property
    def address(self) -> str:
        """The talker and the sentence type."""
        return self.text[1:].partition("*")[0].partition(",")[0]

    def field(self, number: int) -> str:
        """Field 1, 2, … without blanks; empty where the sentence is shorter."""
        return self.fields[number - 1].strip() if number <= len(self.fields) else ""

    def number(self, number: int) -> float | None:
        """The field as a number; None where it is empty.

        Raises ValueError: the field is no finite number.
        """
        text = self.field(number)
        if not text:
            return None
        value = float(text)
        if not np.isfinite(value):
            raise ValueError(f"field {number} is {text!r}")
        return value


@dataclass(frozen=True)
class Log:
    """The sentences of a file, and the time of each by the log's clock.

    clock_s : (n,) UTC; all NaN where the log has no time. clock : description of the clock.
    damaged : line numbers with the reason.
    """

    sentences: tuple[Sentence, ...]
    clock_s: FloatArray
    clock: str
    damaged: tuple[tuple[int, str], ...]

    @property
    def has_times_of_day(self) -> bool:
        """Whether lines have the time of day before their sentence."""
        return any(math.isfinite(sentence.received_of_day_s) for sentence in self.sentences)


def log_of(
    lines: Sequence[str],
    unended: bool = False,
    received_s: Sequence[float] | None = None,
    numbers: Sequence[int] | None = None,
    start_s: float | None = None,
    checked: Counter[str] | None = None,
) -> Log:
    """The sentences of these lines. Lines that are no sentences, or have a wrong checksum, are damaged; so are those
    without one where at least half of their address have one: they are cut off.

    unended : whether the last line has no line end; then it needs its checksum.
    received_s : (n,) for a stream, the receive time of each line, used where the line has none.
    numbers : (n,) of the lines; None: they are 1, 2, …
    start_s : UTC of the first line, for lines with their time of day only.
    checked : for a stream, by address how many more sentences had a checksum before than had none; updated.
    """
    sentences, damaged = [], []
    checked = Counter() if checked is None else checked
    last = len(lines) if numbers is None else math.inf
    for number, raw in zip(range(1, len(lines) + 1) if numbers is None else numbers, lines, strict=True):
        if not raw.strip() or raw.lstrip().startswith("#"):
            continue
        for one in _JOINT.split(raw):
            sentence = _sentence(number, one, whole=not unended or number < last)
            if isinstance(sentence, Sentence):
                sentences.append(sentence)
                checked[sentence.address] += 1 if "*" in sentence.text else -1
            else:
                damaged.append((number, sentence))
    damaged += [(s.line, CUT_OFF) for s in sentences if "*" not in s.text and checked[s.address] >= 0]
    sentences = [s for s in sentences if "*" in s.text or checked[s.address] < 0]
    if received_s is not None:
        own = np.array([sentence.time_s for sentence in sentences], np.float64)
        received = np.array([received_s[sentence.line - 1] for sentence in sentences], np.float64)
        return Log(tuple(sentences), np.where(np.isfinite(own), own, received), "the times of receipt", tuple(damaged))
    clock_s, clock = _clock(sentences, start_s)
    return Log(tuple(sentences), clock_s, clock, tuple(damaged))


def latitude(text: str, hemisphere: str) -> float:
    """Degrees, of ddmm.mm and N or S.

    Raises ValueError: another text.
    """
    return _degrees(text, hemisphere, 2, "NS", 90.0)


def longitude(text: str, hemisphere: str) -> float:
    """Degrees, of dddmm.mm and E or W; raises as :func:`latitude`."""
    return _degrees(text, hemisphere, 3, "EW", 180.0)


def time_of_day(text: str) -> float:
    """Seconds since midnight, of hhmmss.ss; NaN where empty. Raises ValueError for another text."""
    if not text:
        return np.nan
    if len(text) < 6:
        raise ValueError(f"time {text!r}")
    hours, minutes, rest = int(text[:2]), int(text[2:4]), float(text[4:])
    if not (hours < 24 and minutes < 60 and 0.0 <= rest < 61.0):
        raise ValueError(f"time {text!r}")
    return 3600.0 * hours + 60.0 * minutes + rest


def _degrees(text: str, hemisphere: str, digits: int, sides: str, limit: float) -> float:
    if hemisphere not in tuple(sides):
        raise ValueError(f"{hemisphere!r} is neither {sides[0]} nor {sides[1]}")
    minutes = float(text[digits:])
    value = int(text[:digits]) + minutes / 60.0
    if not (0.0 <= minutes < 60.0 and value <= limit):
        raise ValueError(f"position {text!r}")
    return value if hemisphere == sides[0] else -value


def _sentence(number: int, raw: str, whole: bool) -> Sentence | str:
    """The sentence in a line, or why there is none. whole : whether the line has a line end."""
    tags = "".join(block + "," for block in _TAG_BLOCK.findall(raw))
    line = _TAG_BLOCK.sub("", raw)
    match = _SENTENCE.search(line)
    if match is None:
        return "no NMEA sentence"
    text, given_checksum = match[0].strip(), match[4]
    body = text[1:].split("*")[0]
    if given_checksum is None:
        if not whole or "*" in line[match.start() :]:
            return CUT_OFF
    elif int(given_checksum, 16) != checksum(body):
        return "wrong checksum"
    address, *values = body.split(",")
    kind = address[1:] if address.startswith("P") else address[2:]
    time_s = _receive_time(tags, line[: match.start()], line[match.end() :])
    of_day = _OF_DAY.fullmatch(line[: match.start()])
    of_day_s = np.nan if of_day is None else 3600.0 * int(of_day[1]) + 60.0 * int(of_day[2]) + float(of_day[3])
    group, station = _TAG_GROUP.search(tags), _TAG_STATION.search(tags)
    # Only the first sentence of a group needs to have the station.
    origin = f"group {group[1]}" if group else f"station {station[1]}" if station else ""
    return Sentence(
        number, text, kind, tuple(values), time_s, f"{address.removesuffix(kind)} {origin}".rstrip(), of_day_s
    )


def checksum(body: str) -> int:
    """Exclusive or of the bytes between the first character and the star."""
    total = 0
    for byte in body.encode("utf-8", errors="replace"):
        total ^= byte
    return total


def _receive_time(tags: str, before: str, after: str) -> float:
    """The receive time in the line; NaN where it has none."""
    tagged = _TAG_TIME.search(tags)
    if tagged:
        return seconds(float(tagged[1]))
    # Before it may stand more than a time: 1780315200100;N;$GPRMC…, or the columns of a log in CSV.
    begin = re.split(r"[;,]", before, maxsplit=1)[0]
    day_first = _DAY_FIRST.search(before)
    if day_first:
        day, month, year, hour, rest = day_first.groups()
        before = f"{year}-{month:0>2}-{day:0>2}T{hour:0>2}:{rest}"
    for text in (before.strip(" \t[]<>,;|"), begin, *reversed(after.split(","))):
        time_s = instant(text.strip(" \t[]<>,;|")) if text.strip() else None
        # A small number is a counter or a signal strength.
        if time_s is not None and time_s > 1e8:
            return time_s
    return np.nan


def _clock(sentences: Sequence[Sentence], start_s: float | None) -> tuple[FloatArray, str]:
    received = np.array([s.time_s for s in sentences])
    if np.isfinite(received).any():
        return forward_filled(received), "times of receipt written in the log"
    times = [(s, _date_time(s)) for s in sentences]
    for kinds, description in (({"GHP"}, "$PGHP sentences"), ({"ZDA", "RMC"}, "own ship's ZDA and RMC sentences")):
        clock_s = np.array([time_s if s.kind in kinds else np.nan for s, time_s in times])
        if np.isfinite(clock_s).any():
            return forward_filled(clock_s), description
    of_day_s = np.array([s.received_of_day_s for s in sentences])
    if start_s is not None and np.isfinite(of_day_s).any():
        return forward_filled(unwrapped(of_day_s, DAY_S, start_s)), "times of day before the sentences, read as UTC"
    return np.full(len(sentences), np.nan), ""


def _date_time(sentence: Sentence) -> float:
    """The instant of a sentence with a date, else NaN."""
    s = sentence
    try:
        if s.kind == "ZDA":
            return _date(int(s.field(4)), int(s.field(3)), int(s.field(2))) + time_of_day(s.field(1))
        if s.kind == "RMC":
            date = s.field(9)
            year = int(date[4:6])
            return _date(year + (1900 if year >= 80 else 2000), int(date[2:4]), int(date[:2])) + time_of_day(s.field(1))
        if s.kind == "GHP":
            year, month, day, hour, minute, second, thousandth = (int(s.field(k)) for k in range(2, 9))
            return _date(year, month, day) + 3600.0 * hour + 60.0 * minute + second + thousandth / 1e3
    except (ValueError, IndexError, OverflowError):
        pass
    return np.nan


def _date(year: int, month: int, day: int) -> float:
    return datetime(year, month, day, tzinfo=UTC).timestamp()


def with_date(day_s: FloatArray, clock_s: FloatArray, start_s: float | None) -> FloatArray:
    """UTC (n,) of times of day: on the day nearest to the clock, else counted from the start."""
    if np.isfinite(clock_s).any():
        return np.asarray(day_s + DAY_S * np.round((clock_s - day_s) / DAY_S))
    return unwrapped(day_s, DAY_S, start_s) if start_s is not None else np.full(len(day_s), np.nan)

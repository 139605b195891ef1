"""The description of a sensor file format: name, recogniser and reader; and what the readers share: times and errors.

A format is a module of this package with a ``FORMAT``, listed in
:data:`sameas.io.sensors.report_formats.SENSOR_FORMATS`.
"""

from __future__ import annotations

import io
import json
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta, timezone, tzinfo
from functools import cached_property
from pathlib import Path
from typing import Any
from zoneinfo import ZoneInfo

import numpy as np
from numpy.typing import ArrayLike

from sameas.arrays import FloatArray
from sameas.bounds import MAGIC, ZIP, ZSTD, Unpacking, unpacked
from sameas.errors import Argument, InputError, Message
from sameas.io.format import in_utf_8
from sameas.io.sensors.captures import with_text_as_lines
from sameas.tracks.coordinates import FOOT_M, MILE_M
from sameas.tracks.reports import LAST_S, PLOTS_OF_RADARS, Reports

#: Speeds of ships and aircraft in metres per second.
KNOT_M_PER_S = MILE_M / 3600.0
FEET_PER_MINUTE_M_PER_S = FOOT_M / 60.0


DAY_S = 86400.0
#: Numbers above these are milliseconds, microseconds, nanoseconds since 1970: as seconds they lie beyond the year 5138.
_FINER_UNITS = ((1e17, 1e9), (1e14, 1e6), (1e11, 1e3))


#: A date and a time of day without signs between the numbers, as exactEarth writes them: 20240501_104000.
_COMPACT = re.compile(r"((?:19|20)\d{6})[T_ -]?(\d{6})(\.\d+)?Z?")
#: The name of the zone at the end of a time.
_UTC = re.compile(r"\s+(UTC|GMT)$", re.IGNORECASE)


def instant(text: str) -> float | None:
    """UTC seconds since 1970 from ISO 8601 text or a number of (milli-, micro-, nano-) seconds; None for other text.

    Text without a zone is UTC, and so is text that ends with UTC or GMT. Fourteen digits that are a date are one: as
    milliseconds they lie beyond the year 2570.

    >>> instant("2016-01-12 13:02:11.5"), instant("1452603731500"), instant("radar"), instant("20160112_130211")
    (1452603731.5, 1452603731.5, None, 1452603731.0)
    """
    cell = text.strip()
    if compact := _COMPACT.fullmatch(cell):
        try:
            moment = datetime.strptime(compact[1] + compact[2], "%Y%m%d%H%M%S").replace(tzinfo=UTC)
        except ValueError:
            return None
        return moment.timestamp() + float(compact[3] or 0.0)
    if "_" in cell:
        return None  # a number for Python
    try:
        number = seconds(float(cell))
        return number if abs(number) <= LAST_S else None
    except ValueError:
        pass
    try:
        moment = datetime.fromisoformat(_UTC.sub("", cell))
        return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()
    except (ValueError, OverflowError):
        return None


def seconds(number: float) -> float:
    """Seconds, from a number in seconds, milliseconds, microseconds or nanoseconds, by its size."""
    for above, unit in _FINER_UNITS:
        if abs(number) > above:
            return number / unit
    return number


def zone_of(name: str) -> tzinfo:
    """A time zone, of a name such as ``Europe/Berlin`` or an offset from UTC such as ``+02:00``.

    Raises InputError: it is neither.
    """
    match = re.fullmatch(r"(?:UTC|GMT)?\s*([+-])(\d{1,2})(?::?([0-5]\d))?", name.strip())
    if match and int(match[2]) <= 15:
        minutes = 60 * int(match[2]) + int(match[3] or 0)
        return timezone(timedelta(minutes=-minutes if match[1] == "-" else minutes))
    try:
        return ZoneInfo(name.strip())
    except (KeyError, ValueError, OSError):
        raise InputError(
            f"time_zone: {name!r} is not known on this machine", "give a name such as Europe/Berlin, or +02:00"
        ) from None


def utc_of(wall_s: FloatArray, zone: str | None) -> FloatArray:
    """UTC (n,) of clock times of a zone, which were read as UTC; unchanged where there is no zone.

    In autumn, the hour that the clock shows twice is taken for the first one.

    >>> utc_of(np.array([1452603731.0, 1468000000.0]), "Europe/Berlin") - [1452603731.0, 1468000000.0]
    array([-3600., -7200.])
    """
    if zone is None:
        return wall_s
    known, out = zone_of(zone), np.array(wall_s, np.float64)
    finite = np.isfinite(out)
    # The offset of a zone changes at a quarter of an hour.
    quarters, inverse = np.unique(out[finite] // 900.0, return_inverse=True)
    clock = [datetime.fromtimestamp(900.0 * quarter, UTC).replace(tzinfo=known) for quarter in quarters.tolist()]
    offset = np.array([(moment.utcoffset() or timedelta()).total_seconds() for moment in clock], np.float64)
    out[finite] -= offset[inverse]
    return out


def start_seconds(start: str | float | None, source: str) -> float | None:
    """UTC in seconds of the first line of a file, from the user's option."""
    if start is None or isinstance(start, (int, float)):
        return start if start is None else float(start)
    start_s = instant(start)
    if start_s is None:
        raise InputError(
            f"{source}: start={start!r} is not an instant; give a date or a time like 2024-05-01T13:00:00Z"
        )
    return start_s


def unwrapped(values: ArrayLike, period_s: float, start_s: float | None = None) -> FloatArray:
    """Times (n,) without the wrap-around of ``values`` after every period.

    values : (n,) seconds of the day, of the minute …; NaN stays NaN.
    start_s : the first value is placed in the period nearest to this time; a start at midnight is a date only, and the
        first value is placed on that day. None: the first period starts at 0.

    Each value is placed in the period in which it is nearest to the previous one, so values out of order by less than
    half a period are placed correctly.

    >>> unwrapped([86399.0, 2.0, 86398.0, 5.0], 86400.0).tolist()
    [86399.0, 86402.0, 86398.0, 86405.0]
    """
    values = np.asarray(values, dtype=np.float64)
    rows = np.flatnonzero(np.isfinite(values))
    out = np.full(len(values), np.nan)
    if not len(rows):
        return out
    finite = values[rows]
    steps = np.diff(finite)
    wraps = np.concatenate([[0.0], np.cumsum(-np.round(steps / period_s))])
    begin = 0.0
    if start_s is not None:
        date_only = period_s == DAY_S and start_s % DAY_S == 0.0
        begin = start_s if date_only else period_s * np.round((start_s - finite[0]) / period_s)
    out[rows] = begin + finite + period_s * wraps
    return out


def forward_filled(values: FloatArray) -> FloatArray:
    """(n,) the latest finite value at each position; before the first one, that one. All NaN where there is none."""
    rows = np.flatnonzero(np.isfinite(values))
    if not len(rows):
        return values
    last = np.searchsorted(rows, np.arange(len(values)), side="right") - 1
    return np.asarray(values[rows[np.maximum(last, 0)]])


def at_second(clock_s: FloatArray, second: FloatArray) -> FloatArray:
    """Times of positions (n,), from the receive times ``clock_s`` (n,) and the UTC seconds within the minute (n,).

    The latest time with this second that is at most 5 s after the receive time; the receive time where the
    second is NaN.
    """
    age = np.mod(clock_s - second, 60.0)
    age = np.where(age > 55.0, age - 60.0, age)
    return np.where(np.isfinite(second), clock_s - age, clock_s)


def picture_time(text: str | float, argument: str, span_s: tuple[float, float]) -> float:
    """Seconds, from ISO text, seconds (since 1970 or of another clock), or HH:MM[:SS] of the first day."""
    text = str(text)
    time_s = _of_day(text, span_s)
    time_s = instant(text) if time_s is None else time_s
    if time_s is None:
        words = Message(Argument(argument, text), ": give a time such as 2024-05-01T13:00:00Z, 13:00, or seconds")
        raise InputError(words)
    return time_s


#: A duration, and the seconds of its units.
_DURATION = re.compile(r"\s*([0-9]*\.?[0-9]+)\s*([a-z]*)\s*")
_DURATION_S = {"": 1.0, "s": 1.0, "sec": 1.0, "min": 60.0, "m": 60.0, "h": 3600.0}


def duration(text: str) -> float | None:
    """Seconds of "10s", "2min", "0.5h" or a plain number of seconds; None for other text, and for no time.

    >>> duration("2min"), duration("10"), duration("0s"), duration("soon")
    (120.0, 10.0, None, None)
    """
    match = _DURATION.fullmatch(text.lower())
    if match is None or match[2] not in _DURATION_S or float(match[1]) <= 0.0:
        return None
    return float(match[1]) * _DURATION_S[match[2]]


def _of_day(text: str, span_s: tuple[float, float]) -> float | None:
    """Seconds, from HH:MM[:SS] on the day of the first report, or on the next day if only that is in the span."""
    for form in ("%H:%M", "%H:%M:%S"):
        try:
            clock = datetime.strptime(text.removesuffix("Z"), form)
        except ValueError:
            continue
        moment = span_s[0] - span_s[0] % DAY_S + clock.hour * 3600.0 + clock.minute * 60.0 + clock.second
        return moment + DAY_S if moment < span_s[0] and moment + DAY_S <= span_s[1] else moment
    return None


#: Number of bytes at the start of a file, and of lines in them, that are used to recognise its format.
HEAD_BYTES, HEAD_LINES = 65536, 200
#: Logs shrink five- to twentyfold, snapshots that repeat each other more; each line is a Python object (chosen).
_UNPACKING = Unpacking(least=1 << 25, ratio=50)


@dataclass(frozen=True)
class ReadOptions:
    """Options for what a file does not contain.

    source : name of the source in messages; the name of the file if not given.
    format : one of :data:`sameas.io.sensors.REPORT_FORMATS`, if it cannot be detected from the content.
    start : UTC of the first line as ISO text or seconds, for files with the time of day only, or with counters.
    columns : for tables, the name of the column of a quantity (``lat_deg``, ``time_s`` …).
    units : for tables, the unit of a column, by its name.
    kind : of the source, if its name does not show it: speeds of AIS are knots.
    time_zone : of times that state none, in tables and SBS lines: ``Europe/Berlin`` or ``+02:00``; UTC if not given.
    """

    source: str | None = None
    format: str | None = None
    start: str | float | None = None
    columns: Mapping[str, str] | None = None
    units: Mapping[str, str] | None = None
    kind: str | None = None
    time_zone: str | None = None

    def __post_init__(self) -> None:
        if self.time_zone is not None:
            zone_of(self.time_zone)


#: Words in the name of a source, and the kind that they indicate.
_WORDS = {
    "droneradar": "drone radar", "cuas": "drone radar", "counteruas": "drone radar", "counterdrone": "drone radar",
    "drone": "drone", "remoteid": "drone", "mavlink": "drone", "airradar": "air radar", "radar": "marine radar",
    "lidar": "lidar", "ais": "ais", "adsb": "ads-b", "flarm": "ads-b", "mlat": "mlat", "wam": "wam", "esm": "esm",
    "camera": "camera", "tracks": "tracks",
}  # fmt: skip


def kind_by_name(source: str) -> str | None:
    """The kind that the name of a source shows, or None."""
    plain = re.sub(r"[^a-z]", "", source.lower())
    return next((kind for word, kind in _WORDS.items() if word in plain), None)


@dataclass(frozen=True)
class SensorFile:
    """A file to read: unpacked content, name of the source, options.

    start_s : UTC of the first line, if given by the user.
    """

    path: Path
    content: bytes
    source: str
    options: ReadOptions
    start_s: float | None = None

    @classmethod
    def of(cls, path: str | os.PathLike[str], options: ReadOptions) -> SensorFile:
        """The file at a path.

        Raises InputError: no such file, a directory, empty, a packed file cut off.
        """
        path = Path(path)
        source = options.source or path.name
        start_s = start_seconds(options.start, source)
        return cls(path, with_text_as_lines(content(path)), source, options, start_s)

    @cached_property
    def lines(self) -> list[str]:
        """All lines; line 1 is the first."""
        return lines_of(self.content)

    @property
    def unended(self) -> bool:
        """Whether the last line has no line end, as in a truncated file."""
        return not self.content.rstrip(b"\0 \t").endswith((b"\n", b"\r"))

    @cached_property
    def head(self) -> bytes:
        """The first bytes."""
        return self.content[:HEAD_BYTES]

    @cached_property
    def head_lines(self) -> list[str]:
        """The first lines that are not blank, stripped."""
        return [line.strip() for line in lines_of(self.head)[:HEAD_LINES] if line.strip()]

    def share_of_lines(self, pattern: str) -> float:
        """The fraction of the first lines that match a pattern completely."""
        return sum(re.fullmatch(pattern, line) is not None for line in self.head_lines) / max(len(self.head_lines), 1)


@dataclass(frozen=True)
class SensorFormat:
    """One format.

    name : as in ``ReadOptions.format``. label : its description in messages.
    read : returns the reports of a file, one for each sensor in it. recognises : whether a file has this format.
    magic : first bytes that identify the format; checked before all ``recognises``.
    """

    name: str
    label: str
    read: Callable[[SensorFile], list[Reports]]
    recognises: Callable[[SensorFile], bool]
    magic: tuple[bytes, ...] = ()


#: What a Signal K server writes before each message of its log: milliseconds and the provider, or its kind.
LOGGED = re.compile(r"^\d{13};[^;{]*;")
#: The columns of own ship at each report of a log that has her position, in m/s and degrees from north.
OWN_SHIP: Mapping[str, str] = {
    "lat": "own_lat_deg", "lon": "own_lon_deg", "heading": "own_heading_deg", "speed": "own_speed_m_per_s",
    "course": "own_course_deg",
}  # fmt: skip

#: The kind of source of a format.
_KIND_OF_FORMAT: Mapping[str, str] = {
    "ais": "ais", "arpa": "marine radar", "adsb": "ads-b", "asterix 021": "ads-b",
    **dict.fromkeys(PLOTS_OF_RADARS, "air radar"), "asterix 062": "tracks", "asterix 020": "wam",
    "asterix 010": "tracks", "mavlink": "drone", "remote id": "drone", "ogn": "ads-b",
}  # fmt: skip


def kind_of(format_name: str) -> str | None:
    """The kind of source that a format of reports shows, or None."""
    return _KIND_OF_FORMAT.get(format_name)


def content(path: str | os.PathLike[str]) -> bytes:
    """All bytes of a file, unpacked where it is packed: gzip, Zstandard, or one file in a zip archive.

    Raises InputError: no such file, a directory, empty, a packed file cut off.
    """
    path = Path(path)
    if os.path.isdir(path):  # Path's own raises where a name is too long for a file
        raise InputError(f"{path}: is a directory; give a file")
    if not os.path.exists(path):
        raise InputError(f"{path}: no such file")
    try:
        content_bytes = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    if content_bytes.startswith((MAGIC, ZSTD, ZIP)):
        content_bytes = unpacked(path, _UNPACKING)
    if not content_bytes:
        raise InputError(f"{path}: is empty")
    return in_utf_8(content_bytes)


def lines_of(content_bytes: bytes) -> list[str]:
    """The lines of a file; line 1 is the first. Bytes that are not UTF-8 become replacement characters."""
    return (
        content_bytes.decode("utf-8-sig", errors="replace")
        .replace("\r\n", "\n")
        .replace("\r", "\n")
        .rstrip("\n")
        .split("\n")
    )


def lines_in(content_bytes: bytes) -> Iterator[str]:
    """:func:`lines_of` with their ends, one after another: as a list those of a day of AIS take more memory than the
    file.

    >>> list(lines_in(b"time,lat\\r\\n1,2\\r3,4"))
    ['time,lat\\n', '1,2\\n', '3,4']
    """
    return io.TextIOWrapper(io.BytesIO(content_bytes), "utf-8-sig", "replace")


def of_json(text: str) -> Any:
    """The value of a JSON text.

    Raises ValueError: it is not JSON, or is nested too deeply for Python's stack.
    """
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError("no JSON: nested too deep") from None


def json_lines(lines: Sequence[str], damaged: list[tuple[int, str]]) -> list[tuple[int, Any]]:
    """Line numbers and values of lines of JSON; blank lines are skipped, others appended to ``damaged``."""
    numbered = []
    for number, line in enumerate(lines, start=1):
        if line.strip():
            try:
                numbered.append((number, of_json(line)))
            except ValueError:
                damaged.append((number, "no JSON"))
    return numbered


def plain_text(value: object) -> str | None:
    """A JSON string or number as text; None for other values and blank text."""
    return str(value).strip() or None if isinstance(value, str | int | float) else None


# Accuracy: standard deviations from the accuracy categories that transponders state.
#
# ADS-B states 95 % radii (NACp), containment radii that are almost never exceeded (NIC), or the older NUCp; AIS one
# bit. The 95 % radius r of a circular Gaussian is 2.45 σ: P(ρ < r) = 1 − exp(−r²/2σ²). The categories describe the
# accuracy of the navigation only, not of the clock or the transmission.

#: 95 % radius over the standard deviation of one axis: sqrt(−2 ln 0.05).
RADIUS_95 = float(np.sqrt(-2.0 * np.log(0.05)))
#: Radii of 95 % in metres by NACp 0 to 11 (RTCA DO-260B): 10 NM is class 1, 3 m class 11.
_NACP_M = (np.nan, 18520.0, 7408.0, 3704.0, 1852.0, 926.0, 555.6, 185.2, 92.6, 30.0, 10.0, 3.0)
#: Containment radii in metres by NIC 0 to 11 (DO-260B).
_NIC_M = (np.nan, 37040.0, 14816.0, 7408.0, 3704.0, 1852.0, 1111.2, 370.4, 185.2, 75.0, 25.0, 7.5)
#: Radii of 95 % in metres by NUCp 0 to 9 (DO-260).
_NUCP_M = (np.nan, 18520.0, 9260.0, 1852.0, 926.0, 463.0, 185.2, 92.6, 10.0, 3.0)
#: Errors of 95 % of the horizontal velocity in m/s by NACv 0 to 4 (DO-260B).
_NACV_M_PER_S = (np.nan, 10.0, 3.0, 1.0, 0.3)
#: 1σ in metres per axis by the accuracy bit of AIS (ITU-R M.1371: within 10 m or not; without it that of ships' GNSS).
AIS_SIGMA_M = {True: 5.0, False: 15.0}
#: 1σ in metres per axis of AIS positions that are dead reckoned or entered by hand (chosen).
AIS_RECKONED_SIGMA_M = 100.0


def sigma_of_nacp(nacp: ArrayLike) -> FloatArray:
    """(n,) metres per axis, of navigation accuracy categories; NaN where the class is 0, not known or reserved.

    >>> sigma_of_nacp([9, 8, 0]).round(1).tolist()
    [12.3, 37.8, nan]
    """
    return _lookup(_NACP_M, nacp) / RADIUS_95


def sigma_of_nucp(nucp: ArrayLike) -> FloatArray:
    """(n,) metres per axis, of the uncertainty categories of version 0; NaN as for :func:`sigma_of_nacp`."""
    return _lookup(_NUCP_M, nucp) / RADIUS_95


def sigma_of_containment(radius_m: ArrayLike) -> FloatArray:
    """(n,) metres per axis, of containment radii Rc, for transponders that state nothing else.

    Rc is a bound, not a multiple of σ; the categories of DO-260 that state both have Rc/2 as their 95 % radius, which
    is used here for all. Zero or less means unknown.
    """
    radius = np.asarray(radius_m, dtype=np.float64)
    return np.where(radius > 0.0, 0.5 * radius / RADIUS_95, np.nan)


def sigma_of_nic(nic: ArrayLike) -> FloatArray:
    """(n,) metres per axis, of navigation integrity categories; see :func:`sigma_of_containment`."""
    return sigma_of_containment(_lookup(_NIC_M, nic))


def sigma_of_nacv(nacv: ArrayLike) -> FloatArray:
    """(n,) metres per second per axis, of velocity accuracy categories; NaN as for :func:`sigma_of_nacp`."""
    return _lookup(_NACV_M_PER_S, nacv) / RADIUS_95


def round_covariance(sigma: ArrayLike) -> FloatArray:
    """(n, 3) xx, xy, yy of isotropic errors; NaN where sigma is."""
    variance = np.square(np.asarray(sigma, dtype=np.float64))
    return np.stack([variance, np.where(np.isnan(variance), np.nan, 0.0), variance], axis=-1)


def _lookup(table: tuple[float, ...], classes: ArrayLike) -> FloatArray:
    values = np.append(np.asarray(table), np.nan)
    classes = np.asarray(classes, dtype=np.float64)
    known = np.isfinite(classes) & (classes >= 0) & (classes < len(table))
    return np.asarray(values[np.where(known, classes, len(table)).astype(np.int64)])

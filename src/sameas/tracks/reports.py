"""The reports of one source as columns, as read.

A reader (:mod:`sameas.io.sensors`) makes Reports of a file: times in UTC, lengths in metres, angles in degrees,
positions and errors *as given by the source*. A missing column is None, a missing cell NaN or None; the description of
the source supplies them later where needed. Unusable lines are listed with their numbers and reasons; other lines (a
weather message among ships) are counted by kind.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.errors import InputError
from sameas.representation import counted, in_short

TextArray = NDArray[np.object_]
#: Seconds from 1970 to the end of the year 9999; larger absolute values are not accepted as times.
LAST_S = 253402300800.0
#: The kind of reports of the heading of a ship by her own compass, which have no positions.
OWN_HEADING = "own heading"
#: The kinds of reports of a radar's plots, which may have a velocity and are not filtered for all that.
PLOTS_OF_RADARS = ("asterix 001", "asterix 048")
#: The 1σ error of a speed of AIS (``errors.speed_m_per_s`` of its kind): up to this a speed does not differ from 0.
AT_REST_M_PER_S = 0.3


@dataclass(frozen=True)
class Damaged:
    """Unusable lines: their numbers (k,), counted from 1, and the reason for each.

    unit : of the numbers: "line" of a text, "record" or "packet" of a binary file.
    """

    lines: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    reasons: TextArray = field(default_factory=lambda: np.empty(0, object))
    unit: str = "line"

    def __len__(self) -> int:
        return len(self.lines)

    @classmethod
    def of(cls, lines: Iterable[tuple[int, str]], unit: str = "line") -> Damaged:
        """From pairs of number and reason, in the order of the numbers."""
        pairs = sorted(lines)
        return cls(np.array([n for n, _ in pairs], np.int64), np.array([r for _, r in pairs], object), unit)

    def with_lines(self, lines: Iterable[tuple[int, str]]) -> Damaged:
        """These lines and others."""
        return Damaged.of([*zip(self.lines.tolist(), self.reasons.tolist(), strict=True), *lines], self.unit)

    def counts(self) -> dict[str, int]:
        """Number of damaged lines by reason, the most frequent first."""
        reasons, counts = np.unique(self.reasons.astype(str), return_counts=True)
        order = np.argsort(-counts, kind="stable")
        return {str(reasons[i]): int(counts[i]) for i in order}

    def sentences(self) -> list[str]:
        """One printable line per reason: the number of lines, and the first of them.

        >>> Damaged.of([(7, "wrong checksum"), (3, "wrong checksum")]).sentences()
        ['2 lines damaged: wrong checksum (lines 3, 7)']
        """
        sentences = []
        for reason, count in self.counts().items():
            where = self.lines[self.reasons == reason]
            numbers = ", ".join(str(n) for n in where[:5]) + (", …" if count > 5 else "")
            damaged = counted(count, self.unit)
            sentences.append(f"{damaged} damaged: {reason} ({damaged.rpartition(' ')[2]} {numbers})")
        return sentences


class NoReports(InputError):
    """A reader's input contains no report; ``damaged`` and ``passed_over`` list its lines.

    A file is refused; of a stream the next lines may have reports.
    """

    def __init__(
        self,
        message: str,
        remedy: Any = "",
        *,
        damaged: Damaged | None = None,
        passed_over: Mapping[str, int] | None = None,
    ) -> None:
        super().__init__(message, remedy) if remedy else super().__init__(message)
        self.damaged = Damaged() if damaged is None else damaged
        self.passed_over = dict(passed_over or {})


@dataclass
class Unused:
    """What a reader does not use of its input: damaged lines, by number and reason, and others, by what they are.

    unit : of the numbers, as of :class:`Damaged`.
    """

    damaged: list[tuple[int, str]] = field(default_factory=list)
    passed_over: Counter[str] = field(default_factory=Counter)
    unit: str = "line"

    def reasons(self) -> str:
        """The damage in one line; empty for none."""
        return "; ".join(Damaged.of(self.damaged, self.unit).sentences())

    def refusal(self, message: str, remedy: Any = "") -> NoReports:
        """The error of an input of which nothing is used."""
        return NoReports(message, remedy, damaged=Damaged.of(self.damaged, self.unit), passed_over=self.passed_over)

    def reports(self, source: str, kind: str, columns: Mapping[str, Any], notes: Sequence[str] = ()) -> Reports:
        """The reports of the input, with what is not used of it."""
        damaged = Damaged.of(self.damaged, self.unit)
        return Reports.of(source, kind, columns, damaged=damaged, passed_over=self.passed_over, notes=notes)


@in_short
@dataclass(frozen=True)
class Reports:
    """The reports of one source, in the order of its file. :meth:`Reports.of` makes and checks them.

    Attributes
    ----------
    source : name of the source, used in messages.
    kind : format: "ais", "arpa", "adsb", "asterix 010", "asterix 020", … or "table".
    time_s : (n,) UTC, seconds since 1970: time of the position if the source gives it.
    line : (n,) number of the line (or record) in the file, counted from 1.
    lat_deg, lon_deg : (n,) WGS84, longitude from −180 to 180.
    alt_m : (n,) height above the ellipsoid. pressure_alt_m : (n,) height in the standard atmosphere (flight level).
    x_m, y_m, z_m : (n,) in a local plane of the source, x to the east and y to the north unless it states otherwise.
    range_m : (n,) distance from the sensor; slant range for air radars.
    bearing_deg : (n,) clockwise from true north, 0 to 360. elevation_deg : (n,) above the horizon.
    relative_bearing_deg : (n,) clockwise from the bow of the vessel that carries the sensor, of reports without
        ``bearing_deg`` and without ``station_heading_deg``, whose sum they are where both are known.
    station_lat_deg, station_lon_deg, station_x_m, station_y_m : (n,) position of the sensor, if in the file.
    station_heading_deg : (n,) direction of the bow of the vessel that carries the sensor, from true north.
    speed_m_per_s, course_deg : (n,) over ground, course clockwise from true north.
    vx_m_per_s, vy_m_per_s : (n,) velocity east and north, or along x and y. climb_m_per_s : (n,) upwards.
    heading_deg : (n,) direction of the bow, from true north.
    covariance_m2 : (n, 3) xx, xy, yy of the position, east and north (or x and y).
    velocity_covariance_m2_per_s2 : (n, 3) the same of the velocity.
    target_height_m, sigma_target_height_m : (n,) height that others report of the object that a radar without heights
        has measured, and 1σ: for its slant range only (:mod:`sameas.tracks.target_heights`).
    sigma_alt_m, sigma_range_m, sigma_bearing_deg, sigma_elevation_deg : (n,) standard deviations.
    track_id : (n,) the source's number of the object. mmsi, imo, icao, callsign, mode_a, name, type : (n,) texts in
        their usual form (nine digits, six lower hexadecimal digits, four octal digits); None if absent.
    length_m, width_m : (n,) of the hull. frequency_hz : (n,) of the emission that a direction finder has received.
    extra : further columns of the format by name.
    damaged : unusable lines.
    passed_over : number of other lines of the file, by kind.
    notes : assumptions, one printable sentence each.
    counted_clock : whether times are counted from the seconds in messages, so that whole minutes may be missing.
    own_ship : the positions and headings of the ship whose receivers wrote the log, where it has them.
    sac_sic : codes of the sensor in ASTERIX, such as "1/2"; else empty. site : its latitude and longitude (degrees) and
        height (m), where the file states it once for all reports.
    """

    source: str
    kind: str
    time_s: FloatArray
    line: IntArray
    lat_deg: FloatArray | None = None
    lon_deg: FloatArray | None = None
    alt_m: FloatArray | None = None
    pressure_alt_m: FloatArray | None = None
    x_m: FloatArray | None = None
    y_m: FloatArray | None = None
    z_m: FloatArray | None = None
    range_m: FloatArray | None = None
    bearing_deg: FloatArray | None = None
    relative_bearing_deg: FloatArray | None = None
    elevation_deg: FloatArray | None = None
    station_lat_deg: FloatArray | None = None
    station_lon_deg: FloatArray | None = None
    station_x_m: FloatArray | None = None
    station_y_m: FloatArray | None = None
    station_heading_deg: FloatArray | None = None
    speed_m_per_s: FloatArray | None = None
    course_deg: FloatArray | None = None
    vx_m_per_s: FloatArray | None = None
    vy_m_per_s: FloatArray | None = None
    climb_m_per_s: FloatArray | None = None
    heading_deg: FloatArray | None = None
    covariance_m2: FloatArray | None = None
    velocity_covariance_m2_per_s2: FloatArray | None = None
    target_height_m: FloatArray | None = None
    sigma_target_height_m: FloatArray | None = None
    sigma_alt_m: FloatArray | None = None
    sigma_range_m: FloatArray | None = None
    sigma_bearing_deg: FloatArray | None = None
    sigma_elevation_deg: FloatArray | None = None
    track_id: TextArray | None = None
    mmsi: TextArray | None = None
    imo: TextArray | None = None
    icao: TextArray | None = None
    callsign: TextArray | None = None
    mode_a: TextArray | None = None
    name: TextArray | None = None
    type: TextArray | None = None
    length_m: FloatArray | None = None
    frequency_hz: FloatArray | None = None
    width_m: FloatArray | None = None
    extra: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    damaged: Damaged = field(default_factory=Damaged)
    passed_over: Mapping[str, int] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    counted_clock: bool = False
    own_ship: Reports | None = None
    sac_sic: str = ""
    site: tuple[float, float, float] | None = None

    def __len__(self) -> int:
        return len(self.time_s)

    @classmethod
    def of(
        cls,
        source: str,
        kind: str,
        columns: Mapping[str, ArrayLike],
        *,
        damaged: Damaged | None = None,
        passed_over: Mapping[str, int] | None = None,
        notes: Sequence[str] = (),
    ) -> Reports:
        """Reports from columns by name, checked.

        Parameters
        ----------
        source, kind, damaged, passed_over, notes : see :class:`Reports`.
        columns : by the names of the attributes, all of one length, with ``time_s`` and a position. Other names become
            columns of ``extra``. A column without any value counts as absent.

        Raises
        ------
        InputError : no time, no position, columns of different lengths, a latitude beyond ±90°.

        Rows with an invalid time, an infinite or impossible position or a negative range are excluded as damaged; other
        infinite and impossible values become absent (:data:`POSSIBLE`).
        """
        if "time_s" not in columns:
            raise InputError(f"{source}: no time; give a column time_s (UTC, seconds since 1970)")
        n = len(np.asarray(columns["time_s"]))
        own: dict[str, Any] = {"line": np.arange(1, n + 1)}
        extra: dict[str, NDArray[Any]] = {}
        for name, values in columns.items():
            array = np.asarray(values)
            if len(array) != n:
                raise InputError(f"{source}: column {name} has {len(array)} values for {n} times")
            if name not in _COLUMNS:
                extra[name] = _all_writable(array)
            elif name in ("time_s", "line") or not _is_empty(array):
                own[name] = _typed(name, array)
        about = Damaged() if damaged is None else damaged
        own = _with_true_bearings(_with_infinite_impossible(own))
        own, extra, about = _without_infinite(source, own, extra, about)
        reports = cls(
            source, kind, **own, extra=extra, damaged=about, passed_over=passed_over or {}, notes=tuple(notes)
        )
        return _with_plain_angles(_checked(reports))

    @property
    def position(self) -> str:
        """Kind of the positions: "geodetic", "local", "polar", "bearing" without a distance, or "no" of a compass."""
        if self.kind == OWN_HEADING:
            return "no"
        if self.lat_deg is not None and self.lon_deg is not None:
            return "geodetic"
        if self.x_m is not None and self.y_m is not None:
            return "local"
        return "polar" if self.range_m is not None else "bearing"

    @property
    def object_ids(self) -> TextArray | None:
        """(n,) the source's ids of its objects: the first available of track_id, MMSI and ICAO address; else None."""
        return next((ids for ids in (self.track_id, self.mmsi, self.icao) if ids is not None), None)

    def columns(self) -> dict[str, NDArray[Any]]:
        """The available columns by name; those of ``extra`` after the others."""
        own = {name: getattr(self, name) for name in _COLUMNS}
        return {name: column for name, column in own.items() if column is not None} | dict(self.extra)

    def velocity_m_per_s(self) -> FloatArray | None:
        """(n, 2) velocity to the east and north (or along x and y), NaN if absent; None if the source has none.

        A speed of at most :data:`AT_REST_M_PER_S` is a velocity of 0 even without a course.
        """
        if self.vx_m_per_s is not None and self.vy_m_per_s is not None:
            return np.column_stack([self.vx_m_per_s, self.vy_m_per_s])
        if self.speed_m_per_s is None:
            return None
        course = np.full(len(self), np.nan) if self.course_deg is None else np.radians(self.course_deg)
        with np.errstate(invalid="ignore"):
            at_rest = np.isnan(course) & (self.speed_m_per_s <= AT_REST_M_PER_S)
        speed, course = np.where(at_rest, 0.0, self.speed_m_per_s), np.where(at_rest, 0.0, course)
        return np.asarray(speed[:, None] * np.column_stack([np.sin(course), np.cos(course)]), np.float64)

    def where(self, rows: ArrayLike) -> Reports:
        """The reports of the given rows, a mask (n,) or row numbers; ``damaged`` is kept."""
        chosen = np.asarray(rows)
        own = {name: column[chosen] for name in _COLUMNS if (column := getattr(self, name)) is not None}
        return replace(self, **own, extra={name: column[chosen] for name, column in self.extra.items()})

    def in_time_order(self) -> Reports:
        """The reports in order of time; equal times keep the order of the file."""
        return self.where(np.argsort(self.time_s, kind="stable"))

    def summary(self) -> list[str]:
        """Printable lines on the reports, damaged and other lines, and assumptions."""
        lines = [f"{self.source}: {len(self)} report{'s' * (len(self) != 1)} ({self.kind}, {self.position} positions)"]
        lines += self.damaged.sentences()
        lines += [f"{count} skipped: {what}" for what, count in self.passed_over.items()]
        return lines + list(self.notes)


def joined(parts: Sequence[Reports]) -> Reports:
    """The reports of several parts of one source, concatenated; columns missing in a part are absent there.

    >>> one = Reports.of("a", "table", {"time_s": [0.0], "x_m": [1.0], "y_m": [2.0]})
    >>> two = Reports.of("a", "table", {"time_s": [3.0], "x_m": [4.0], "y_m": [5.0], "track_id": ["7"]})
    >>> both = joined([one, two])
    >>> both.x_m.tolist(), both.track_id.tolist()
    ([1.0, 4.0], [None, '7'])
    """
    if not parts:
        raise InputError("joined: there are no reports; give one part or more")
    if len(parts) == 1:
        return parts[0]
    first, given = parts[0], [part.columns() for part in parts]
    columns: dict[str, NDArray[Any]] = {}
    for name in dict.fromkeys(name for part in given for name in part):
        like = next(part[name] for part in given if name in part)
        cells = [
            part[name] if name in part else _absent(like, len(reports))
            for part, reports in zip(given, parts, strict=True)
        ]
        columns[name] = np.concatenate(cells)
    own: dict[str, Any] = {name: column for name, column in columns.items() if name in _COLUMNS}
    extra = {name: column for name, column in columns.items() if name not in _COLUMNS}
    counted = any(part.counted_clock for part in parts)
    site = next((part.site for part in parts if part.site is not None), None)
    return Reports(
        first.source, first.kind, **own, extra=extra, counted_clock=counted, sac_sic=first.sac_sic, site=site
    )


def _absent(like: NDArray[Any], n: int) -> NDArray[Any]:
    """n absent cells of the type of a column."""
    if like.dtype == object:
        return np.full(n, None, object)
    return np.full((n, *like.shape[1:]), np.nan if like.dtype.kind == "f" else -1, like.dtype)


def of_rows(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Columns for :meth:`Reports.of` from one mapping per report; missing keys are absent."""
    columns: dict[str, Any] = {}
    for name in dict.fromkeys(name for row in rows for name in row):
        cells = [row.get(name) for row in rows]
        if name in _MATRICES:
            columns[name] = np.array([(np.nan,) * 3 if cell is None else cell for cell in cells], float).reshape(-1, 3)
        elif name in _TEXTS or any(isinstance(cell, str) for cell in cells):
            columns[name] = np.array([*cells, None], object)[:-1]
        else:
            columns[name] = np.array([np.nan if cell is None else cell for cell in cells], float)
    return columns


_MATRICES = ("covariance_m2", "velocity_covariance_m2_per_s2")
#: Reports are of a wrong date if at most STRAY_REPORTS follow each other in the file, they are at most STRAY_SHARE of
#: all, and apart from the others by more than STRAY_S, in seconds, and by more than all others last.
STRAY_REPORTS, STRAY_SHARE, STRAY_S = 3, 0.05, 6 * 3600.0


def without_stray_times(reports: Reports) -> Reports:
    """The reports without those of a wrong date, which are damaged: a few at a time, days from all others.

    One wrong date would make the picture of five minutes one of a month. A log that is split into sessions keeps all.

    >>> t = [*range(300), 2_592_000.0]
    >>> reports = Reports.of("ais", "table", {"time_s": t, "x_m": [0.0] * 301, "y_m": [0.0] * 301})
    >>> without_stray_times(reports).damaged.sentences()
    ['1 line damaged: a time far from all others (line 301)']
    """
    order = np.argsort(reports.time_s, kind="stable")
    time_s = reports.time_s[order]
    cuts = np.flatnonzero(np.diff(time_s) > STRAY_S) + 1
    if not len(cuts):
        return reports
    starts, ends = np.append(0, cuts), np.append(cuts, len(time_s))
    main = int(np.argmax(ends - starts))
    first_s, last_s = time_s[starts[main]], time_s[ends[main] - 1]
    apart = np.maximum(first_s - reports.time_s, reports.time_s - last_s) > max(STRAY_S, last_s - first_s)
    # The length of the run of lines, in the order of the file, to which each belongs.
    changes = np.flatnonzero(np.diff(apart)) + 1
    lengths = np.diff(np.concatenate([[0], changes, [len(apart)]]))
    stray = apart & (np.repeat(lengths, lengths) <= STRAY_REPORTS)
    if not 0 < stray.sum() <= max(1.0, STRAY_SHARE * len(time_s)) or ends[main] - starts[main] <= STRAY_REPORTS:
        return reports
    lines = [(int(line), "a time far from all others") for line in reports.line[stray]]
    return replace(reports.where(~stray), damaged=reports.damaged.with_lines(lines))


_TEXTS = ("track_id", "mmsi", "imo", "icao", "callsign", "mode_a", "name", "type")
_NO_COLUMNS = (
    "source", "kind", "extra", "damaged", "passed_over", "notes", "counted_clock", "own_ship", "sac_sic", "site",
)  # fmt: skip
_COLUMNS = tuple(f.name for f in fields(Reports) if f.name not in _NO_COLUMNS)
_PLACES = ("lat_deg", "lon_deg", "x_m", "y_m", "range_m", "bearing_deg", "relative_bearing_deg")
#: Directions, from 0° to 360°.
DIRECTIONS = ("bearing_deg", "relative_bearing_deg", "course_deg", "heading_deg", "station_heading_deg")
_HEIGHTS, _SPEEDS = ("alt_m", "pressure_alt_m"), ("speed_m_per_s", "length_m", "width_m")
#: Lowest and highest value of a quantity; beyond are marks of a missing value, such as −999, 3600 or 9999. Angles may
#: be a quarter beyond a turn, as after the subtraction of an offset. 511 is the missing heading of AIS.
POSSIBLE: Mapping[str, tuple[float, float]] = {
    **dict.fromkeys(DIRECTIONS, (-360.0, 450.0)), "elevation_deg": (-90.0, 90.0), "lon_deg": (-360.0, 360.0),
    "station_lat_deg": (-90.0, 90.0), "station_lon_deg": (-360.0, 360.0),
    "frequency_hz": (1.0, 1e12), **dict.fromkeys(_HEIGHTS, (-900.0, 90e3)), **dict.fromkeys(_SPEEDS, (0.0, 20e3)),
}  # fmt: skip


def is_impossible(name: str, values: FloatArray) -> BoolArray:
    """(n,) whether values of a column are not possible (:data:`POSSIBLE`); none are of a column without limits.

    >>> is_impossible("heading_deg", np.array([511.0, -170.0, np.nan, 3600.0])).tolist()
    [True, False, False, True]
    """
    lowest, highest = POSSIBLE.get(name, (-np.inf, np.inf))
    with np.errstate(invalid="ignore"):
        return np.asarray((values < lowest) | (values > highest))


def _with_infinite_impossible(own: Mapping[str, Any]) -> dict[str, Any]:
    """The columns, infinite in place of values that are not possible."""
    out = dict(own)
    for name in set(POSSIBLE) & set(own):
        if (impossible := is_impossible(name, own[name])).any():
            out[name] = np.where(impossible, np.inf, own[name])
    if "bearing_deg" in own and ("lat_deg" in own or "x_m" in own):
        # No position is made of it.
        out["bearing_deg"] = np.where(np.isinf(out["bearing_deg"]), np.nan, out["bearing_deg"])
    return out


def _with_true_bearings(own: dict[str, Any]) -> dict[str, Any]:
    """The columns with bearings from true north in place of those from the bow, if the heading is known."""
    if "relative_bearing_deg" not in own or not {"bearing_deg", "station_heading_deg"} & set(own):
        return own
    out = dict(own)
    relative_deg = out.pop("relative_bearing_deg")
    return out if "bearing_deg" in own else out | {"bearing_deg": relative_deg + own["station_heading_deg"]}


def _without_infinite(
    source: str, own: dict[str, Any], extra: dict[str, NDArray[Any]], damaged: Damaged
) -> tuple[dict[str, Any], dict[str, NDArray[Any]], Damaged]:
    """The columns without rows of invalid time, position or range, which become damaged, and without infinite cells."""
    with np.errstate(invalid="ignore"):
        no_time = ~(np.abs(own["time_s"]) <= LAST_S)
        negative = np.zeros(len(no_time), bool) if "range_m" not in own else own["range_m"] < 0.0
    no_position = negative.copy()
    for name, column in own.items():
        infinite = np.isinf(column) if name not in _TEXTS else np.zeros(0, bool)
        if not infinite.any():
            continue
        if name in _PLACES:
            no_position |= infinite
        elif name != "time_s":
            own[name] = np.where(infinite, np.nan, column)
    extra = {
        name: np.where(np.isinf(column), np.nan, column) if column.dtype.kind == "f" else column
        for name, column in extra.items()
    }
    reasons = np.where(no_time, "no time", np.where(negative, "a distance below 0", "no position")).astype(object)
    excluded = np.flatnonzero(no_time | no_position)
    if not len(excluded):
        return own, extra, damaged
    if len(excluded) == len(no_time):
        if negative.all():
            raise InputError(f"{source}: all ranges are negative; give the distances from the sensor")
        what = "time" if no_time.all() else "position"
        raise InputError(f"{source}: no report has a {what} that is a finite number")
    lines = zip(own["line"][excluded], reasons[excluded], strict=True)
    kept = ~(no_time | no_position)
    own, extra = ({name: column[kept] for name, column in columns.items()} for columns in (own, extra))
    return own, extra, damaged.with_lines(lines)


def _typed(name: str, array: NDArray[Any]) -> NDArray[Any]:
    if name == "line":
        return array.astype(np.int64)
    if name not in _TEXTS:
        return array.astype(np.float64)
    return np.array([*(None if cell is None else _writable(str(cell)) for cell in array), None], object)[:-1]


def _all_writable(array: NDArray[Any]) -> NDArray[Any]:
    """A column of any type, its texts made valid Unicode (see ``_writable``)."""
    if array.dtype.kind not in "UO" or not any(isinstance(cell, str) and not cell.isascii() for cell in array):
        return array
    cells = [_writable(cell) if isinstance(cell, str) else cell for cell in array]
    return np.array([*cells, None], object)[:-1].astype(array.dtype)


def _writable(text: str) -> str:
    """A text with U+FFFD for each lone surrogate: JSON may contain one (\\ud800), but UTF-8 cannot encode it."""
    if text.isascii():
        return text
    return text.encode("utf-16-le", "surrogatepass").decode("utf-16-le", "replace")


def _is_empty(array: NDArray[Any]) -> bool:
    if array.dtype == object:
        return all(cell is None for cell in array)
    return array.dtype.kind == "f" and bool(np.isnan(array).all())


def _checked(reports: Reports) -> Reports:
    for first, second in (("lat_deg", "lon_deg"), ("x_m", "y_m"), ("vx_m_per_s", "vy_m_per_s")):
        if len(reports) and (getattr(reports, first) is None) != (getattr(reports, second) is None):
            there, missing = (first, second) if getattr(reports, second) is None else (second, first)
            raise InputError(f"{reports.source}: has {there}, but no {missing}; give both")
    has_bearings = reports.bearing_deg is not None or reports.relative_bearing_deg is not None
    if len(reports) and reports.position == "bearing" and not has_bearings:
        raise InputError(f"{reports.source}: no position; give lat and lon, x and y, range and bearing, or a bearing")
    lat = reports.lat_deg
    beyond = np.flatnonzero(np.abs(lat) > 90.0) if lat is not None else np.empty(0, int)
    if lat is not None and len(beyond):
        first_line = reports.line[beyond[0]]
        raise InputError(
            f"{reports.source}: {len(beyond)} latitudes lie beyond ±90° "
            f"(first: {reports.damaged.unit} {first_line}, {lat[beyond[0]]:g}); are latitude and longitude swapped?"
        )
    return reports


def _with_plain_angles(reports: Reports) -> Reports:
    """The reports with longitudes within ±180° and directions from 0° to 360°."""
    changed: dict[str, Any] = {}
    for name in DIRECTIONS:
        if (angle := getattr(reports, name)) is not None:
            changed[name] = np.mod(angle, 360.0)
    for name in ("lon_deg", "station_lon_deg"):
        if (angle := getattr(reports, name)) is not None and (np.abs(angle) > 180.0).any():
            changed[name] = np.mod(angle + 180.0, 360.0) - 180.0
    return replace(reports, **changed) if changed else reports

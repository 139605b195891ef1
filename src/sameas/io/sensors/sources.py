"""Sources: sensor files with the descriptions of the sensors, as input of a scene.

A source is named after its file (``radar.csv`` is radar), or by the user (``radar=plots.csv``). A TOML file describes
sources by these names; in addition to the fields of :class:`~sameas.tracks.source.Description`, a table may have
options of reading:

    [sources.radar]
    kind = "marine radar"
    file = { path = "plots.csv", start = "2024-05-01", columns = { range_m = "d" }, units = { d = "km" } }

    [sources.wien]
    sac_sic = "80/12"  # the sensor of these codes, in whatever recording of ASTERIX it is

A source without a given kind gets one from its format, its name or its columns; the guess is printed.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from datetime import UTC, date, datetime
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from sameas.errors import Argument, InputError, Message, UndatedTimes
from sameas.io.sensors import data_sources, recording, tables
from sameas.io.sensors.format import DAY_S, OWN_SHIP, ReadOptions, kind_by_name, kind_of
from sameas.io.sensors.report_formats import read_reports
from sameas.io.sensors.table_times import FIRST_S
from sameas.tracks.kinds import CARRIER_KIND, KINDS
from sameas.tracks.platforms import OWN_POSITIONS, only_carries
from sameas.tracks.reports import OWN_HEADING, Damaged, NoReports, Reports, joined, without_stray_times
from sameas.tracks.source import Description, Site, source_tables

#: The keys of ``file`` in a description, and their types.
_FILE: Mapping[str, type | tuple[type, ...]] = {
    "path": str, "format": str, "start": (str, int, float, date), "columns": Mapping, "units": Mapping,
    "time_zone": str,
}  # fmt: skip
#: Columns of a table, and the kind of source that they indicate.
_COLUMNS = {"mmsi": "ais", "icao": "ads-b", "range_m": "marine radar", "covariance_m2": "tracks"}
#: Cameras give more directions than one in this time; direction finders and sonars rarely do.
SLOWEST_CAMERA_S = 1.0


@dataclass(frozen=True)
class SourceOptions:
    """The user's options of one source: description, options of reading, and file, if given here.

    has_kind : whether the user gives its kind. sac_sic : its codes in ASTERIX, "SAC/SIC"; "" if not given.
    may_be_absent : whether it is one of a list of all sensors, which need no files.
    """

    description: Description
    options: ReadOptions = field(default_factory=ReadOptions)
    path: Path | None = None
    has_kind: bool = True
    sac_sic: str = ""
    may_be_absent: bool = False


@dataclass(frozen=True)
class SensorSource:
    """One source that was read.

    why_kind : reason of a guessed kind; None where the user gave it. is_part : whether it is one of the recordings of
        a sensor that follow each other.
    """

    description: Description
    reports: Reports
    path: Path
    why_kind: str | None
    is_part: bool = False

    def lines(self) -> list[str]:
        """Printable lines: the reports, and the guess of the kind."""
        first, *rest = self.reports.summary()
        first = first.replace(self.reports.source, f"{self.reports.source} ({self.path.name})", 1)
        if self.why_kind is None:
            return [f"{first}, {self.description.kind}", *rest]
        if self.reports.kind in (OWN_POSITIONS, OWN_HEADING):
            return [f"{first}: {self.why_kind}", *rest]
        return [f"{first}, read as {self.description.kind}: {self.why_kind}", *rest]


def read_source_options(
    path: str | Path, *, set_aside: dict[str, InputError] | None = None
) -> dict[str, SourceOptions]:
    """The options of every source in a TOML file, or in data sources of COMPASS (JSON), by name.

    set_aside : receives the errors of tables that cannot be used, by name. Without it, the first one is raised.

    Raises InputError: not TOML, no sources, an unknown name.
    """
    found: dict[str, SourceOptions] = {}
    listed = Path(path).suffix.lower() == ".json"
    for name, table in (data_sources.tables_of(path) if listed else source_tables(path)).items():
        with setting_aside(name, set_aside):
            found[name] = replace(_options(name, table, Path(path)), may_be_absent=listed)
    return found


@contextmanager
def setting_aside(name: str, set_aside: dict[str, InputError] | None) -> Iterator[None]:
    """Takes the error of a source that cannot be used, where it may be set aside, so that the others can."""
    try:
        yield
    except InputError as error:
        if set_aside is None:
            raise
        set_aside.setdefault(name, error)


def _options(name: str, table: Mapping[str, Any], toml: Path) -> SourceOptions:
    description = {key: value for key, value in table.items() if key not in ("file", "input", "sac_sic")}
    sac_sic = str(table.get("sac_sic", ""))
    if sac_sic and not re.fullmatch(r"\d{1,3}/\d{1,3}", sac_sic):
        raise InputError(f'{toml}: sources.{name}.sac_sic is {sac_sic!r}; give SAC and SIC, such as "80/12"')
    file = table.get("file", {})
    file = {"path": file} if isinstance(file, str) else file
    where = f"{toml}: sources.{name}.file"
    if not isinstance(file, Mapping):
        raise InputError(f'{where} is {file!r}; give a path, or {{ path = "…", start = "…" }}')
    for key, value in file.items():
        if key not in _FILE:
            raise InputError(f"{where}: {key!r} is not known; give {', '.join(_FILE)}")
        if not isinstance(value, _FILE[key]) or isinstance(value, bool):
            example = '{ range_m = "d" }' if key == "columns" else '{ d = "km" }' if key == "units" else "a text"
            raise InputError(f"{where}.{key} is {value!r}; give {example}")
    described = Description.from_mapping(name, description)
    kind = described.kind if "kind" in table else None
    # Dates and times of TOML as text.
    given: dict[str, Any] = {
        key: value.isoformat() if isinstance(value, date) else value for key, value in file.items()
    }
    options = ReadOptions(name, kind=kind, **{key: value for key, value in given.items() if key != "path"})
    path = toml.parent / file["path"] if "path" in file else None
    return SourceOptions(described, options, path, "kind" in table, sac_sic)


def read_sources(
    files: Sequence[str | Path],
    options: Mapping[str, SourceOptions] | None = None,
    *,
    start: str | None = None,
    set_aside: dict[str, InputError] | None = None,
) -> list[SensorSource]:
    """All sources of the given files, and of files named in the descriptions, with their descriptions.

    files : paths, or NAME=PATH, or a folder of recordings, which say the names of their sources. A file that holds
        several sensors (a log of AIS and radar) gives NAME:ais, NAME:arpa. Files with one NAME are parts of one source.
    options : by name, from :func:`read_source_options`.
    start : UTC of the first line of files with the time of day only.
    set_aside : the errors of sources that cannot be used, by name. Those in it are not read, and it receives those that
        cannot be read, or have no file, if others can. Without it, and if no source can be read, the first error is
        raised.

    Raises InputError: no files, two sources of one name; without ``set_aside`` a description without a file, an unknown
    kind, an unreadable file.
    """
    described = dict(options or {})
    named = [_named(str(file)) for file in files]
    named += [(name, one.path) for name, one in described.items() if one.path and name not in dict(named)]
    if not named:
        if set_aside:
            raise next(iter(set_aside.values()))
        raise InputError("no files; give the sensors' files, or descriptions that name them")
    found: dict[int, list[SensorSource]] = {}
    undated: list[tuple[int, Path, ReadOptions, UndatedTimes]] = []
    for at, (name, path) in enumerate(named):
        if set_aside and name in set_aside:
            continue
        reading = described[name].options if name in described else ReadOptions(name)
        if reading.start is None:
            reading = replace(reading, start=start)
        with setting_aside(name, set_aside):
            try:
                found[at] = _sources_in(path, reading, described, set_aside)
            except UndatedTimes as error:
                undated.append((at, path, reading, error))
    day, which = _common_day(source for of_file in found.values() for source in of_file), "the date of the others"
    if not found and len(undated) > 1:
        day, which = _day_written(*undated[0][1:3])
    for at, path, reading, no_date in undated:
        with setting_aside(named[at][0], set_aside):
            if day is None:
                raise no_date
            of_file = _sources_in(path, replace(reading, start=day), described, set_aside)
            found[at] = [_dated(one, which) for one in of_file]
    sources = _with_sensors_of_parts([source for at in sorted(found) for source in found[at]], described)
    names = [source.description.name for source in sources]
    parts = {source.description.name for source in sources if source.is_part}
    duplicate = next((name for name in names if names.count(name) > 1 and name not in parts), None)
    if duplicate is not None and not any(f"{duplicate.partition(':')[0]}=" in str(file) for file in files):
        raise InputError(
            f"two sources are called {duplicate}; name them, as in {duplicate}2=FILE, or {duplicate}=FILE for each if "
            "they are parts of one"
        )
    sources = [_of_parts([one for one in sources if one.description.name == name]) for name in dict.fromkeys(names)]
    if set_aside and not sources:
        raise next(iter(set_aside.values()))
    # A source may have been silent while its input was recorded.
    if not any(path.is_dir() for _, path in named):
        for name in described:
            with setting_aside(name, set_aside):
                if not described[name].may_be_absent:
                    _check_used(name, names, set_aside or {})
    return sources


def _sources_in(
    path: Path, reading: ReadOptions, described: Mapping[str, SourceOptions], set_aside: dict[str, InputError] | None
) -> list[SensorSource]:
    """The sources in a file, or a folder of recordings."""
    sources: list[SensorSource] = []
    for reports in _recorded(path) if path.is_dir() else read_reports(path, reading):
        if not set_aside or reports.source not in set_aside:
            with setting_aside(reports.source, set_aside):
                read = without_stray_times(reports)
                name = read.source if read.source in described else _name_by_codes(read, described)
                sources.append(source_of(name, _renamed(read, name), described, path))
    return sources


def _name_by_codes(reports: Reports, described: Mapping[str, SourceOptions]) -> str:
    """The name of the description with the codes of this sensor in ASTERIX, or that of the reports."""
    names = (name for name, one in described.items() if one.sac_sic and one.sac_sic == reports.sac_sic)
    return next(names, reports.source)


def _renamed(reports: Reports, name: str) -> Reports:
    """The reports under another name of their source, in their notes too."""
    if name == reports.source:
        return reports
    notes = tuple(re.sub(f"^{re.escape(reports.source)}: ", f"{name}: ", note) for note in reports.notes)
    return replace(reports, source=name, notes=notes)


def _with_sensors_of_parts(sources: list[SensorSource], described: Mapping[str, SourceOptions]) -> list[SensorSource]:
    """The sources; recordings of one sensor of ASTERIX that follow each other in time are parts of one source.

    It is called as it is described, or by category and codes. Recordings at the same time stay apart: they may be of
    two networks with the same reports.
    """
    by_sensor: dict[tuple[str, str], list[int]] = {}
    for at, source in enumerate(sources):
        if source.reports.sac_sic:
            by_sensor.setdefault((source.reports.kind, source.reports.sac_sic), []).append(at)
    out = list(sources)
    for (kind, sac_sic), places in by_sensor.items():
        parts = [sources[at].reports for at in places]
        names = {part.source for part in parts}
        spans = sorted((float(part.time_s.min()), float(part.time_s.max())) for part in parts)
        if len(parts) == 1 or any(after[0] < before[1] for before, after in pairwise(spans)):
            continue
        if len(names) > 1 and not names.isdisjoint(described):
            continue
        name = names.pop() if len(names) == 1 else f"{kind.removeprefix('asterix ')} {sac_sic}"
        for at in places:
            one = sources[at]
            out[at] = replace(
                one, description=replace(one.description, name=name), reports=_renamed(one.reports, name),
                is_part=True,
            )  # fmt: skip
    return out


def _common_day(sources: Iterable[SensorSource]) -> float | None:
    """The middle of the time of sources with dates, if they are of a day or less: times of day beside them are of the
    half day before or after it. None if they are not, or there are none."""
    times = [source.reports.time_s for source in sources if len(source.reports)]
    dated = [(float(np.nanmin(time_s)), float(np.nanmax(time_s))) for time_s in times]
    dated = [(first, last) for first, last in dated if first >= FIRST_S]
    if not dated:
        return None
    first, last = min(one for one, _ in dated), max(one for _, one in dated)
    return 0.5 * (first + last) if last - first < DAY_S else None


def _day_written(path: Path, reading: ReadOptions) -> tuple[float, str]:
    """The first time of a file with times of day, on the day when it was written, and words for that day."""
    written_s = path.stat().st_mtime
    noon_s = DAY_S * (written_s // DAY_S + 0.5)
    first_s = float(read_reports(path, replace(reading, start=noon_s))[0].time_s[0])
    return first_s, f"as no source states a date and {path.name} was written then"


def _dated(source: SensorSource, which: str) -> SensorSource:
    """A source with times of day, whose date is that of the others or another, and a note that says so."""
    reports = source.reports
    day = datetime.fromtimestamp(float(reports.time_s[0]), UTC).strftime("%Y-%m-%d")
    note = f"{reports.source}: its times of day are read as those of {day}, {which}"
    return replace(source, reports=replace(reports, notes=(*reports.notes, note)))


def _of_parts(parts: list[SensorSource]) -> SensorSource:
    """The source of one or more files, in order of time.

    Raises InputError: their positions are of several kinds.
    """
    if len(parts) == 1:
        return parts[0]
    parts.sort(key=lambda part: float(part.reports.time_s[0]))
    name, reports = parts[0].description.name, [part.reports for part in parts]
    kinds = list(dict.fromkeys(f"{one.kind}, {one.position} positions" for one in reports))
    if len(kinds) > 1:
        raise InputError(
            f"{name}: its files are of several kinds: {'; '.join(kinds)}; give each kind a name of its own"
        )
    files = ", ".join(part.path.name for part in parts)
    damaged = [
        (line, f"{reason} ({part.path.name})")
        for part in parts
        for line, reason in zip(part.reports.damaged.lines.tolist(), part.reports.damaged.reasons.tolist(), strict=True)
    ]
    passed_over = sum((Counter(one.passed_over) for one in reports), Counter())
    notes = tuple(dict.fromkeys(note for one in reports for note in one.notes))
    tracks = [one.own_ship for one in reports if one.own_ship is not None]
    whole = replace(
        joined(reports), notes=notes, damaged=Damaged.of(damaged, reports[0].damaged.unit), passed_over=passed_over,
        own_ship=joined(tracks) if tracks else None,
    )  # fmt: skip
    placed = next((part.description for part in parts if part.description.site is not None), parts[0].description)
    return replace(parts[0], description=placed, reports=whole, path=Path(files))


def _recorded(folder: Path) -> list[Reports]:
    """The reports of all recordings in a folder.

    Raises InputError: there is no recording, or no report in any of them.
    """
    out: list[Reports] = []
    empty: list[InputError] = []
    for file in recording.files_in(folder):
        try:
            out += recording.read(file)
        except NoReports as error:
            empty.append(error)
    if not out:
        raise InputError(f"{folder}: {empty[0]}")
    return out


def _named(argument: str) -> tuple[str, Path]:
    """Name and path of NAME=PATH or PATH."""
    name, equals, path = argument.partition("=")
    if equals and re.fullmatch(r"[\w:. -]+", name) and not Path(argument).exists():
        return name, Path(path)
    path = Path(argument).name.removesuffix(".gz")
    return (path.rpartition(".")[0] or path), Path(argument)


def source_of(name: str, reports: Reports, described: Mapping[str, SourceOptions], path: Path) -> SensorSource:
    """The source of these reports, with its description; a missing kind is guessed.

    name : of its description. described : all sources, by name. One that only gives the positions of a vessel with a
        sensor needs no kind.
    """
    options = described.get(name)
    description = Description(reports.source) if options is None else options.description
    description, reports = _at_stated_site(description, reports)
    if options is not None and options.has_kind:
        return SensorSource(description, reports, path, None)
    if reports.kind != OWN_HEADING and only_carries(name, reports, (one.description for one in described.values())):
        kind, why = CARRIER_KIND, "it has the positions of a vessel with a sensor"
        reports = _as_own_ship(reports)
    elif reports.kind == OWN_HEADING:
        kind, why = CARRIER_KIND, "it has headings and no positions: the compass of own ship"
    elif _is_of_one_ship(reports):
        kind, why = (CARRIER_KIND, "its positions have no names and are on one path: own ship; if not, give its kind")
        reports = _as_own_ship(reports)
    else:
        kind, why = _kind(reports)
    return SensorSource(replace(description, kind=kind), reports, path, why)


#: Metres by which a site may differ from the one that the file states.
SITE_M = 500.0


def _at_stated_site(description: Description, reports: Reports) -> tuple[Description, Reports]:
    """The description with the site that the file states, where the user gives none, and a note that says so, or that
    the user's is another place."""
    if reports.site is None or description.platform is not None:
        return description, reports
    lat, lon, height_m = reports.site
    stated, site = f"{lat:.5f}°, {lon:.5f}°, height {height_m:.0f} m", description.site
    if site is None:
        description = replace(description, site=Site(lat, lon, height_m))
        note = f"{reports.source}: its place is that of its service messages: {stated}"
    elif site.lat_deg is None or site.lon_deg is None:
        return description, reports
    else:
        north_deg, east_deg = lat - site.lat_deg, (lon - site.lon_deg) * math.cos(math.radians(lat))
        apart_m = tables.DEGREE_M * math.hypot(north_deg, east_deg)
        if apart_m < SITE_M:
            return description, reports
        note = f"{reports.source}: the given site is {apart_m / 1e3:.1f} km from that of its service messages: {stated}"
    return description, replace(reports, notes=(*reports.notes, note))


def _as_own_ship(reports: Reports) -> Reports:
    """The positions of a vessel that carries a sensor, as own ship's."""
    columns = {"lat": "lat_deg", "lon": "lon_deg", "heading": "heading_deg", "speed": "speed_m_per_s",
               "course": "course_deg"}  # fmt: skip
    absent = np.full(len(reports), np.nan)
    own = {
        OWN_SHIP[name]: absent if getattr(reports, column) is None else getattr(reports, column)
        for name, column in columns.items()
    }
    return replace(reports, kind=OWN_POSITIONS, extra={**reports.extra, **own})


#: Positions that are a path; speed that no ship exceeds between two, m/s, and the share that may seem to; metres by
#: which the height of a ship may vary.
PATH_POSITIONS, SHIP_M_PER_S, SHIP_SHARE, SHIP_HEIGHT_M = 20, 40.0, 0.01, 50.0


def _is_of_one_ship(reports: Reports) -> bool:
    """Whether a table that shows no kind of sensor is the track of one ship: her positions follow each other."""
    if reports.kind != "table" or reports.object_ids is not None or reports.covariance_m2 is not None:
        return False
    if kind_by_name(reports.source) or any(getattr(reports, column) is not None for column in _COLUMNS):
        return False
    track = reports.in_time_order()
    if track.lat_deg is None or track.lon_deg is None or len(track) < PATH_POSITIONS:
        return False
    if track.alt_m is not None and np.nanmax(track.alt_m) - np.nanmin(track.alt_m) > SHIP_HEIGHT_M:
        return False
    east_deg = track.lon_deg * np.cos(np.radians(track.lat_deg))
    way = tables.DEGREE_M * np.hypot(np.diff(track.lat_deg), np.diff(east_deg))
    # Stamps may be rounded to seconds.
    return bool(np.mean(way > SHIP_M_PER_S * np.maximum(np.diff(track.time_s), 1.0)) <= SHIP_SHARE)


def _kind(reports: Reports) -> tuple[str, str]:
    """The guessed kind of a source without a description, and the reason."""
    if (kind := kind_of(reports.kind)) is not None:
        return kind, f"its format is {reports.kind}"
    if reports.kind in KINDS:
        return reports.kind, f"its format is {reports.kind}"
    by_name = kind_by_name(reports.source)
    if by_name is not None and KINDS[by_name].directions and reports.position in ("local", "geodetic"):
        return "lidar", f"it has positions, which a {by_name} does not measure"
    if by_name is not None:
        return by_name, "by its name"
    for column, kind in _COLUMNS.items():
        if getattr(reports, column) is not None:
            return kind, f"it has a column of {column}"
    if reports.position == "bearing":
        times_s = np.unique(reports.time_s)
        if len(times_s) > 1 and float(np.median(np.diff(times_s))) < SLOWEST_CAMERA_S:
            return "camera", "it has directions only, several a second"
        return "esm", f"it has directions only, not more often than every {SLOWEST_CAMERA_S:g} s"
    raise InputError(
        f"{reports.source}: what kind of sensor is it? Neither its name nor its columns show it",
        Message(
            "describe it in a file for ",
            Argument("read_source_options"),
            f': {toml_table(reports.source)} kind = "…", one of {", ".join(KINDS)}',
        ),
    )


def toml_table(name: str) -> str:
    """The header of the table of a source in a TOML file.

    >>> toml_table("radar"), toml_table("bridge:ais")
    ('[sources.radar]', '[sources."bridge:ais"]')
    """
    return f"[sources.{name}]" if re.fullmatch(r"[A-Za-z0-9_-]+", name) else f'[sources."{name}"]'


def _check_used(name: str, read: Sequence[str], set_aside: Mapping[str, InputError]) -> None:
    """Refuses a description to which no file belongs."""
    if name not in read and name not in set_aside and name.rpartition(":")[0] not in set_aside:
        raise InputError(
            f"{name} is described, but no file belongs to it; there are {', '.join(read)}: give {name}=FILE, "
            f"or describe {toml_table(read[-1])}"
        )

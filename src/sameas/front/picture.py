"""A picture of many sensors: :func:`match_picture` and its result, :class:`MatchPicture`; the command uses both."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sameas.errors import Argument, InputError, Message, MissingPackage, naming
from sameas.front.explain import REASONS
from sameas.front.match import call_text
from sameas.front.picture_options import Area, Instants, Method
from sameas.front.provenance import made_by
from sameas.front.tables import table_of
from sameas.io import checksum, write_table
from sameas.io.atomic import filling
from sameas.io.format import json_text
from sameas.io.sensors.asterix_tracks import blocks_of_objects
from sameas.io.sensors.format import ReadOptions, duration, picture_time
from sameas.io.sensors.recording import paths_in
from sameas.io.sensors.sources import SensorSource, SourceOptions, read_source_options, read_sources, source_of
from sameas.io.sensors.table_cells import TableText
from sameas.io.sensors.tables import read as read_cells
from sameas.maps.geojson import Coast, read_coast
from sameas.maps.sheet import MapAlarm, MapSensor, MapSheet
from sameas.picture.picture import Picture
from sameas.picture.plot_picture import nameless
from sameas.report.picture import assumed_lines, doubt_lines, estimated_lines, found_lines, read_lines, scene_lines
from sameas.report.prose import Lines, Result, in_one, span
from sameas.representation import count, counted, listed
from sameas.tracks.heights import HeightModel
from sameas.tracks.registration import SourceBiases
from sameas.tracks.reports import Reports
from sameas.tracks.scene import Scene

if TYPE_CHECKING:
    from astropy.table import Table
    from matplotlib.figure import Figure

# Outputs: tables, GeoJSON, map, image and summary, written into a folder atomically.

#: Names of all output files; those of the tables without extension.
TABLES = ("objects", "identities")
OTHERS = ("objects.geojson", "objects.ast", "summary.json", REASONS, "map.html", "picture.png")


@dataclass(frozen=True)
class PictureOutputs:
    """The requested outputs. format : of the tables. coast : drawn on the map. asterix : whether tracks of category 062
    are written. command : as typed.

    most_positions : of objects in GeoJSON (0.7 kB each) and on the map; of more, those of fewer instants.
    """

    folder: Path
    format: str = "parquet"
    map: bool = True
    image: bool = True
    command: str = ""
    coast: Coast | None = None
    asterix: bool = False
    most_positions: int = 500_000


@dataclass(frozen=True, repr=False)
class MatchPicture(Result):
    """A picture of many sensors, returned by :func:`match_picture`. ``len()`` is the number of instants.

    Attributes
    ----------
    picture : objects and records at every instant, and their summary.
    sources : the input. scene : the sources in one plane, corrected for their offsets. biases : the offsets.
    source_doubts : doubts about whole sources. call : the call that made it.
    """

    _offers = ".objects .pairs .report() .explain(object) .plot(at) .write(folder)"

    picture: Picture
    sources: Sequence[SensorSource]
    scene: Scene
    biases: Sequence[SourceBiases]
    source_doubts: Sequence[str]
    call: str = ""

    def __len__(self) -> int:
        return len(self.picture.instants_s)

    @property
    def doubts(self) -> tuple[str, ...]:
        """One sentence for each problem: alarms first, then doubts."""
        summary = self.picture.summary
        return (*(f"ALARM {alarm}" for alarm in summary.urgent), *self.source_doubts, *summary.notes)

    @cached_property
    def objects(self) -> Table:
        """A row for every object at every instant; columns as of :func:`sameas.picture.picture.object_columns`."""
        from astropy.table import Table

        return Table(dict(self.picture.objects))

    @property
    def table(self) -> Table:
        """The objects."""
        return self.objects

    @cached_property
    def pairs(self) -> Table:
        """A row for every record at every instant, with its object and probability; as in identities.parquet."""
        from astropy.table import Table

        return Table(dict(self.picture.records))

    def report(self) -> str:
        """The report of the command: input, result, estimates and assumptions."""
        lines = [*read_lines((source.reports.source, source.lines()) for source in self.sources)]
        lines += doubt_lines(self.source_doubts)
        return in_one(
            [*lines, *found_lines(self.picture.summary), *estimated_lines(self.scene), *assumed_lines(self.scene)]
        )

    def explain(self, id: Any, *, source: str | None = None, at: float | str | None = None, other: Any = None) -> Lines:
        """Why records were assigned to an object; ``print`` the result.

        Parameters
        ----------
        id : number or label of the object; with ``source``, a track, line or row of that source.
        at : time in seconds, or a date; the last instant of the object if None.
        other : a second track or object, to ask whether and why both are one.

        Raises
        ------
        InputError : no such object, record or time.
        """
        from sameas.report.explain_picture import picture_lines

        when = None if at is None else picture_time(at, "at", self.scene.span_s)
        why, second = self.picture.reasons(), None if other is None else str(other)
        return Lines(tuple(picture_lines(self.objects, self.pairs, str(id), source, when, why, second)))

    def plot(self, at: float | str | None = None) -> Figure:
        """The chart of an instant; by default the last of those with most sources. Notebooks show it.

        Raises
        ------
        InputError : matplotlib is missing.
        """
        from sameas.plots.map import chart

        return chart(self.sheet(), fullest(self.picture) if at is None else picture_time(at, "at", self.scene.span_s))

    def write(self, folder: str | os.PathLike[str], *, format: str = "parquet", map: bool = True, image: bool = True,
              coast: str | os.PathLike[str] | None = None, asterix: bool = False) -> None:  # fmt: skip
        """Writes the outputs of the command into a folder, atomically: tables, GeoJSON, summary, map, image.

        Parameters
        ----------
        format : of the tables, "parquet" or "csv". map, image : whether to write map.html and picture.png.
        coast : GeoJSON file of land or coastlines for the map.
        asterix : whether to write objects.ast, the confirmed objects as tracks of ASTERIX category 062.

        Raises
        ------
        InputError : the folder cannot be written; an unknown format.
        """
        if format not in ("parquet", "csv"):
            raise InputError(f"format is {format!r}; give 'parquet' or 'csv'")
        outline = None if coast is None else read_coast(coast)
        outputs = PictureOutputs(Path(folder), format, map, image, self.call, outline, asterix)
        with filling(outputs.folder) as draft:
            write(self, draft, outputs)

    @property
    def headline(self) -> str:
        """A summary in one line."""
        summary = self.picture.summary
        times = f"{counted(summary.instants, 'instant')}, {span(summary.first_s, summary.last_s)}"
        confirmed = counted(sum(summary.by_sources), "confirmed object")
        return f"Picture of {listed([one.description.name for one in self.sources])}: {confirmed}; {times}"

    def facts(self, command: str) -> dict[str, Any]:
        """The provenance of the outputs; it depends on the command and the input files only."""
        given = [path for path in dict.fromkeys(source.path for source in self.sources) if path.exists()]
        files = [one for path in given for one in (paths_in(path) if path.is_dir() else [path])]
        return made_by(command) | {"files": [str(path) for path in files], "sha256": [checksum(path) for path in files]}

    def as_json(self) -> dict[str, Any]:
        """The summary as a mapping that JSON can encode."""
        summary = self.picture.summary
        return {
            "sources": [_source(source) for source in self.sources],
            "instants": summary.instants, "first_s": summary.first_s, "last_s": summary.last_s,
            "confirmed_objects_by_number_of_sources": list(summary.by_sources),
            "unconfirmed_objects": summary.unconfirmed,
            "objects_per_instant": summary.detected, "expected_wrong_per_instant": summary.expected_wrong,
            "ambiguous_groups_per_instant": summary.ambiguous_groups, "places": asdict(summary.places),
            "alarms": [str(alarm) for alarm in summary.urgent],
            "doubts": [*self.source_doubts, *summary.notes],
            "offsets": [_offset(biases) for biases in self.biases],
            "misses": [asdict(misses) for misses in summary.misses],
            "estimated": [*self.scene.estimated, *summary.errors],
            "assumed": [asdict(line) for feed in self.scene.feeds for line in feed.description.assumed],
        }  # fmt: skip

    def sheet(self, shown: Picture | None = None) -> MapSheet:
        """The content of the map. shown : the picture at some of the instants; None: at all."""
        picture, plane = self.picture if shown is None else shown, self.picture.plane
        feeds = {feed.description.name: feed for feed in self.scene.feeds}
        sensors = [MapSensor.of(source.description, plane, source.path.name) for source in self.sources]
        sensors = [one.aboard(feeds[one.name], picture.instants_s) if one.name in feeds else one for one in sensors]
        title = "Picture of " + listed([source.description.name for source in self.sources])
        return MapSheet.of(
            title, picture.objects, picture.records, instants_s=picture.instants_s, sensors=sensors, plane=plane,
            summary=[*(f"doubt: {doubt}" for doubt in self.source_doubts), *picture.summary.lines()],
            alarms=list(_map_alarms(self.picture)), texts=picture.texts,
        )  # fmt: skip


def write(
    result: MatchPicture, draft: Path, outputs: PictureOutputs, warn: Callable[[str], object] = warnings.warn
) -> list[str]:
    """Writes the requested outputs into a folder and returns the file names. warn : called for an omitted one."""
    from astropy.table import Table

    from sameas.io.geojson import write_geojson

    picture, facts = result.picture, result.facts(outputs.command)
    written = []
    for name, columns in zip(TABLES, (picture.objects, picture.records), strict=True):
        written.append(f"{name}.{outputs.format}")
        write_table(Table(dict(columns), copy=False), draft / written[-1], provenance=facts, format=outputs.format)
    drawn = thinned(picture, outputs.most_positions)
    if len(drawn.instants_s) < len(picture.instants_s) and (picture.plane is not None or outputs.map):
        names = listed(["objects.geojson"] * (picture.plane is not None) + ["map.html"] * outputs.map)
        warn(
            f"{names}: {len(drawn.instants_s)} of the {count(len(picture.instants_s))} instants, since all "
            f"{count(len(picture.objects['object']))} positions are too many for maps; {' and '.join(written)} have all"
        )
    if picture.plane is not None:
        written.append("objects.geojson")
        write_geojson(drawn.objects, draft / written[-1])
    if outputs.asterix and picture.plane is None:
        warn("no objects.ast: the picture has metres of a plane of its own, and ASTERIX needs latitudes")
    elif outputs.asterix:
        written.append("objects.ast")
        blocks = blocks_of_objects(picture.objects, HeightModel.as_given(result.scene.feeds))
        (draft / written[-1]).write_bytes(b"".join(blocks))
    written.append("summary.json")
    (draft / written[-1]).write_text(json_text(facts | result.as_json()), "utf-8")
    written.append(REASONS)
    (draft / written[-1]).write_text(json_text({"objects": picture.reasons()}), "utf-8")
    if outputs.map or outputs.image:
        written += _drawn(result, drawn, draft, outputs, warn)
    return written


def older(folder: Path, written: Sequence[str]) -> list[str]:
    """Files of an earlier picture in the folder that this one did not overwrite."""
    known = [*(f"{name}.{extension}" for name in TABLES for extension in ("parquet", "csv")), *OTHERS]
    return [name for name in known if name not in written and (folder / name).exists()]


def thinned(picture: Picture, most: int) -> Picture:
    """The picture at every k-th instant, the last among them, with the least k that leaves at most so many objects.

    Explanations are those of the instants left out, too: each is valid from the next instant on.
    """
    k = -(-len(picture.objects["object"]) // most)
    if k <= 1:
        return picture
    kept = np.arange(len(picture.instants_s))[::-k][::-1]
    times = picture.instants_s[kept]
    objects, records = (
        {name: column[rows] for name, column in columns.items()}
        for columns, rows in ((c, np.isin(c["time_s"], times)) for c in (picture.objects, picture.records))
    )
    texts = {(int(np.searchsorted(kept, at)), number): text for (at, number), text in sorted(picture.texts.items())}
    return replace(picture, instants_s=times, objects=objects, records=records, texts=texts)


def fullest(picture: Picture) -> float:
    """The last of the instants with the largest number of sources."""
    records = picture.records
    sources = [len(np.unique(records["source"][records["time_s"] == t])) for t in picture.instants_s]
    return float(picture.instants_s[np.flatnonzero(np.array(sources) == max(sources))[-1]])


def _drawn(
    result: MatchPicture, shown: Picture, draft: Path, outputs: PictureOutputs, warn: Callable[[str], object]
) -> Iterator[str]:
    """Writes the map and the image of the instants that are shown, and yields their file names."""
    sheet = result.sheet(shown)
    if outputs.coast is not None and sheet.plane is not None:
        sheet = replace(sheet, ground=outputs.coast.in_plane(sheet.plane))
    if outputs.map:
        from sameas.pages.map import write_map_page

        write_map_page(sheet, draft / "map.html")
        yield "map.html"
    if outputs.image:
        from sameas.plots.map import chart
        from sameas.plots.sheet import save

        try:
            save(chart(sheet, fullest(shown)), draft / "picture.png")
        except MissingPackage as error:  # only the image is omitted
            warn(f"no picture.png: {error}")
        else:
            yield "picture.png"


def _map_alarms(picture: Picture) -> Iterator[MapAlarm]:
    """The calls for help, alarms and faults, each with the objects of its records."""
    records, objects = picture.records, picture.objects
    for call in picture.summary.calls:
        numbers = np.unique(objects["object"][objects[call.column] == call.identity])
        yield MapAlarm(str(call), call.first_s, tuple(numbers.tolist()))
    for alarmed in picture.summary.alarms:
        concerned = np.zeros(len(records["row"]), bool)
        for source, row in (alarmed.alarm.first, alarmed.alarm.second):
            concerned |= (records["source"] == source) & (records["row"] == row)
        yield MapAlarm(str(alarmed), alarmed.first_s, tuple(np.unique(records["object"][concerned]).tolist()))
    for fault in picture.summary.faults:
        concerned = (records["source"] == fault.source) & (records["track_id"] == (fault.track or None))
        yield MapAlarm(str(fault), fault.first_s, tuple(np.unique(records["object"][concerned]).tolist()))


def _source(source: SensorSource) -> dict[str, Any]:
    reports, damaged = source.reports, source.reports.damaged
    return {
        "name": source.description.name, "kind": source.description.kind, "kind_guessed": source.why_kind,
        "file": str(source.path), "format": reports.kind, "positions": reports.position, "reports": len(reports),
        "damaged": damaged.counts(), "passed_over": dict(reports.passed_over), "notes": list(reports.notes),
    }  # fmt: skip


def _offset(biases: SourceBiases) -> dict[str, Any]:
    return {
        "source": biases.source, "against": list(biases.against), "established": biases.established,
        "parameters": {name: asdict(it) for name, it in biases.parameters.items()}, "words": list(biases.lines()),
    }  # fmt: skip


def pictured(
    sources: Sequence[SensorSource],
    when: Instants,
    method: Method,
    *,
    call: str,
    set_aside: dict[str, InputError] | None = None,
    words: Callable[[InputError], str] = str,
    progress: Callable[[str], object],
    say: Callable[[Iterable[str]], object] = lambda lines: None,
) -> MatchPicture:
    """The picture of sources.

    call : the call or command that makes it.
    set_aside : the errors of sources that cannot be used, by name. It receives those of sources that cannot be placed;
        without it, the first of these is raised. words : of such an error.
    progress : called with the name of each step. say : called with the lines of the report, section by section.
    """
    progress("the sensors' places and times")
    scene = Scene.of([(source.description, source.reports) for source in sources], set_aside=set_aside)
    placed = {feed.description.name for feed in scene.feeds}
    sources = [source for source in sources if source.description.name in placed]
    left_out = list(_left_out({name: words(error) for name, error in (set_aside or {}).items()}))
    say(doubt_lines(left_out))
    times = when.of(scene.sessions_s)
    say(scene_lines(scene, method.watch(scene)))
    progress("looking for what is wrong")
    doubts, misread = scene.doubts(), scene.misread
    say(doubt_lines(doubts))
    if method.memory and nameless(scene):
        progress("the sensors' errors")
        scene, _ = scene.with_fitted_errors()
    biases: tuple[SourceBiases, ...] = ()
    if method.registration and len(sources) > 1:
        progress("the sensors' offsets")
        scene, biases = scene.registered()
    progress(counted(len(times), "instant"))
    lines = [line for source_biases in biases for line in source_biases.lines()]
    lines += dict.fromkeys(note for heights in scene.heights if heights is not None for note in heights.notes)
    picture = Picture.of(scene, times, watch=method.watch(scene, misread), biases=lines, progress=progress)
    if not len(picture.records["row"]):
        raise InputError(
            f"no source has a report at {span(times[0], times[-1])}; reports are of {span(*scene.span_s)}",
            naming("give {at}, or {begin} and {end}, within that span"),
        )
    say([*found_lines(picture.summary), *estimated_lines(scene), *assumed_lines(scene)])
    return MatchPicture(picture, sources, scene, biases, (*left_out, *doubts), call)


def _left_out(errors: Mapping[str, str]) -> Iterator[str]:
    """Doubts about the sources that are set aside, by name: one for all that have the same error."""
    names: dict[str, list[str]] = {}
    for name, error in errors.items():
        names.setdefault(error.removeprefix(f"{name}: "), []).append(name)
    for error, which in names.items():
        of_name = error != errors[which[0]]
        yield f"set aside: {listed(which)}: {error}" if of_name else f"set aside: {error}"


def match_picture(
    sources: Any,
    *,
    sensors: str | os.PathLike[str] | None = None,
    every: float | str | None = None,
    at: float | str | None = None,
    begin: float | str | None = None,
    end: float | str | None = None,
    start: str | None = None,
    within: str | None = None,
    without: str | Sequence[str] = (),
    registration: bool = True,
    identity: bool = True,
    memory: bool = True,
    progress: Callable[[str], object] = lambda stage: None,
) -> MatchPicture:
    """One picture from many sensors: which records are the same ship or aircraft, with probabilities.

    Parameters
    ----------
    sources : path, paths, or a mapping of source names to paths or tables (data frames, astropy and Arrow tables,
        dicts of columns) with times and positions. sensors : TOML file that describes the sources.
    every : time between instants, in seconds or as 10s, 2min, 1h. at : a single instant. begin, end : first and last
        instant, in seconds since 1970 or as dates. start : UTC of the first line, for files without dates.
    within : "LAT,LON,KM", an area outside of which reports are not used, as "55.5,10.5,50km" or 20nm.
    without : sources to exclude. registration : whether to correct the sensors' offsets. identity, memory : whether
        reported identities and the history of tracks are evidence.
    progress : called with the name of each step.

    Raises
    ------
    InputError : input that cannot be read or interpreted, with the remedy.

    Example
    -------
    >>> import sameas
    >>> ais = {"time": [0.0, 10.0], "mmsi": ["235000001"] * 2, "x_m": [3.0, 54.0], "y_m": [1.0, 2.0]}
    >>> plots = {"time": [0.0, 10.0], "track_id": ["7", "7"], "x_m": [0.0, 50.0], "y_m": [0.0, 0.0]}
    >>> picture = sameas.match_picture({"ais": ais, "lidar": plots})
    >>> sorted(set(picture.pairs["object"].tolist()))
    [1]
    """
    stated = {
        "sensors": sensors, "every": every, "at": at, "begin": begin, "end": end, "start": start, "within": within,
        "without": without, "registration": registration, "identity": identity, "memory": memory,
    }  # fmt: skip
    alone = isinstance(sources, str | os.PathLike)
    given = [sources] if alone else list(sources.values() if isinstance(sources, Mapping) else sources)
    call = call_text(match_picture, given, stated)
    if at is not None and (every, begin, end) != (None, None, None):
        raise InputError("match_picture: give at, or every with begin and end, not both")
    described = read_source_options(Path(sensors)) if sensors is not None else {}
    excluded = (without,) if isinstance(without, str) else tuple(without)
    area = None if within is None else Area.of_text(within)
    method = Method(registration, identity, memory, excluded, area)
    included = method.included(sensor_sources(sources, described, start))
    return pictured(included, Instants(_duration_s(every), at, begin, end), method, call=call, progress=progress)


def _duration_s(every: float | str | None) -> float | None:
    """Seconds of a time between instants, which may be words."""
    if not isinstance(every, str):
        return every
    seconds = duration(every)
    if seconds is None:
        raise InputError(Message(Argument("every", every), " is not a duration"), "give seconds, or 10s, 2min or 1h")
    return seconds


def sensor_sources(sources: Any, described: Mapping[str, SourceOptions], start: str | None) -> list[SensorSource]:
    """The sources, from any form that :func:`match_picture` accepts."""
    if isinstance(sources, str | os.PathLike):
        sources = [sources]
    if not isinstance(sources, Mapping):
        return read_sources([os.fspath(one) for one in sources], described, start=start)
    files = [f"{name}={os.fspath(one)}" for name, one in sources.items() if isinstance(one, str | os.PathLike)]
    in_memory = {name: one for name, one in sources.items() if not isinstance(one, str | os.PathLike)}
    of_files = {name: one for name, one in described.items() if name not in in_memory}
    has_files = bool(files) or any(one.path for one in of_files.values())
    read = read_sources(files, of_files, start=start) if has_files else []
    for name, data in in_memory.items():
        options = described[name].options if name in described else ReadOptions()
        reports = data if isinstance(data, Reports) else read_cells(_cells(data, name), name, options)
        read.append(source_of(name, reports, described, Path(name)))
    unused = [name for name in described if name not in sources and described[name].path is None]
    if unused and not files:
        raise InputError(f"{unused[0]} is described, but no file belongs to it; there are {', '.join(sources)}")
    order = {name: k for k, name in enumerate(sources)}
    return sorted(read, key=lambda one: order.get(one.description.name, len(order)))


def _cells(data: Any, name: str) -> TableText:
    """The cells of an in-memory table, with times in seconds since 1970."""
    from sameas.sky.times import Time

    table = table_of(data, name)
    columns: dict[str, Sequence[Any]] = {}
    for column in table.colnames:
        values = table[column]
        if isinstance(values, Time):
            values = values.utc.unix
        elif values.dtype.kind == "M":
            values = values.astype("datetime64[us]").astype(np.int64) / 1e6
        masked = np.ma.getmaskarray(np.ma.asarray(values))
        cells = np.ma.getdata(np.ma.asarray(values)).tolist()
        columns[column] = [None if missing else cell for cell, missing in zip(cells, masked.tolist(), strict=True)]
    return TableText(columns, np.arange(1, len(table) + 1))

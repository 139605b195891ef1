"""A picture of many sensors: :func:`match_picture`, and the :class:`MatchPicture` it gives, as the command makes it."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from datetime import datetime
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sameas.arrays import FloatArray
from sameas.errors import Argument, InputError, Message, naming
from sameas.front.explain import Lines
from sameas.front.match import call_text
from sameas.front.provenance import made_by
from sameas.front.tables import table_of
from sameas.io import checksum
from sameas.io.atomic import filling
from sameas.io.format import json_text
from sameas.io.sensors.clock import DAY_S, instant
from sameas.io.sensors.sources import SensorSource, SourceOptions, read_source_options, read_sources, source_of
from sameas.io.sensors.tables import TableText
from sameas.io.sensors.tables import read as read_cells
from sameas.maps.outline import Coast
from sameas.maps.sheet import MapAlarm, MapSensor, MapSheet
from sameas.picture.picture import MOST_INSTANTS, Picture, instants
from sameas.picture.plot_picture import PlotPicture, nameless
from sameas.picture.watch import EvidenceOf, Watch, all_evidence
from sameas.report.picture import (
    assumed_lines,
    doubt_lines,
    estimated_lines,
    found_lines,
    listed,
    read_lines,
    scene_lines,
)
from sameas.report.prose import in_html, in_lines, in_one, span
from sameas.representation import count, counted
from sameas.tracks.registration import SourceBiases
from sameas.tracks.reports import Reports
from sameas.tracks.scene import Scene

if TYPE_CHECKING:
    from astropy.table import Table
    from matplotlib.figure import Figure

#: Steps between instants that are chosen from, seconds, and how many instants there may then be.
STEPS_S = (1.0, 2.0, 5.0, 10.0, 20.0, 30.0, 60.0, 120.0, 300.0, 600.0, 1200.0, 1800.0, 3600.0)
ENOUGH = 200


@dataclass(frozen=True)
class Instants:
    """When the user wants to see the picture."""

    every_s: float | None = None
    at: str | float | None = None
    begin: str | float | None = None
    end: str | float | None = None

    def of(self, span_s: tuple[float, float]) -> FloatArray:
        """(k,) the instants, ascending, for reports within a span."""
        if self.at is not None:
            return np.array([_time(self.at, "at", span_s)])
        first = span_s[0] if self.begin is None else _time(self.begin, "begin", span_s)
        last = span_s[1] if self.end is None else _time(self.end, "end", span_s)
        if first > last:
            words = Message("the picture would be from ", self._in_words(first, last), ": it ends before it begins")
            raise InputError(words)
        if self.every_s is not None and not 0.0 < self.every_s < np.inf:
            raise InputError(Message(Argument("every", f"{self.every_s:g}s"), " is no time between instants"),
                             "give a time above 0")  # fmt: skip
        if self.every_s is not None and (last - first) / self.every_s >= MOST_INSTANTS:
            times = f" makes {count(round((last - first) / self.every_s))} instants from {span(first, last)}"
            every = Argument("every", f"{self.every_s:g}s")
            raise InputError(Message(every, times), "give a longer time between instants")
        step = next((step for step in STEPS_S if (last - first) / step <= ENOUGH), (last - first) / ENOUGH)
        return instants((first, last), self.every_s or step)

    def _in_words(self, first_s: float, last_s: float) -> Message:
        begin, end = span(first_s, last_s).split(" to ", 1)
        given = [Message(" (", Argument(name, str(value)), ")") if value else ""
                 for name, value in (("begin", self.begin), ("end", self.end))]  # fmt: skip
        return Message(begin, given[0], " to ", end, given[1])


@dataclass(frozen=True)
class Method:
    """What is done beside the positions. without : names of sources that are left out."""

    registration: bool = True
    identity: bool = True
    memory: bool = True
    without: tuple[str, ...] = ()

    def taken(self, sources: Sequence[SensorSource]) -> list[SensorSource]:
        """The sources that are not left out.

        Raises
        ------
        InputError : a name that no source has; none is left.
        """
        names = [source.description.name for source in sources]
        for name in self.without:
            if name not in names:
                words = Message(Argument("without", name), ": there is no such source")
                raise InputError(words, f"give one of {', '.join(names)}")
        left = [source for source in sources if source.description.name not in self.without]
        if not left:
            raise InputError(Message(Argument("without", ", ".join(self.without)), ": no source is left"))
        return left

    def say(self) -> EvidenceOf:
        """What counts as evidence at an instant."""

        return partial(all_evidence, identity=self.identity, memory=self.memory)

    def watch(self, scene: Scene) -> Watch | PlotPicture:
        """What the picture carries from instant to instant; without memory every instant is its own."""
        if not self.memory:
            return Watch(evidence=self.say(), bound=1.0)
        return PlotPicture() if nameless(scene) else Watch(evidence=self.say())


# What is written: tables, GeoJSON, a map, an image and a summary, into a folder and all at once.

#: Every file that may be written, without the extension of the tables.
TABLES = ("objects", "identities")
OTHERS = ("objects.geojson", "summary.json", "map.html", "picture.png")


@dataclass(frozen=True)
class PictureOutputs:
    """What the user wants to have. format : of the tables. coast : of the map. command : as it was typed."""

    folder: Path
    format: str = "parquet"
    map: bool = True
    image: bool = True
    command: str = ""
    coast: Coast | None = None


@dataclass(frozen=True, repr=False)
class MatchPicture:
    """A picture of many sensors: what :func:`match_picture` gives. ``len()`` of it is the number of its instants.

    Attributes
    ----------
    picture : its objects and records at every instant, and their summary.
    sources : that it was made of. scene : these in one plane, without their offsets. biases : the offsets.
    source_doubts : what is in doubt of the sources as a whole. call : the call that made it.
    """

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
        """What looks wrong, a sentence each: alarms, then what is in doubt."""
        summary = self.picture.summary
        return (
            *(f"ALARM {alarm}" for alarm in (*summary.alarms, *summary.faults)),
            *self.source_doubts,
            *summary.notes,
        )

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
        """A row for every record at every instant: the object that it is, and how sure; that of identities.parquet."""
        from astropy.table import Table

        return Table(dict(self.picture.records))

    def report(self) -> str:
        """What was read, found, estimated and assumed, as the command prints it."""
        lines = [*read_lines((source.reports.source, source.lines()) for source in self.sources)]
        lines += doubt_lines(self.source_doubts)
        return in_one(
            [*lines, *found_lines(self.picture.summary), *estimated_lines(self.scene), *assumed_lines(self.scene)]
        )

    def explain(self, id: Any, *, source: str | None = None, at: float | str | None = None) -> Lines:
        """Why an object has its records; ``print`` it.

        Parameters
        ----------
        id : number or label of the object; with ``source`` a track, line or row of that source's records.
        at : the time: seconds, or a date; None stands for the last instant at which it is shown.

        Raises
        ------
        InputError : no such object, record or time.
        """
        from sameas.report.written import picture_lines

        when = None if at is None else _time(at, "at", self.scene.span_s)
        return Lines(tuple(picture_lines(self.objects, self.pairs, str(id), source, when)))

    def plot(self, at: float | str | None = None) -> Figure:
        """The chart of an instant, of the fullest if none is given; notebooks show it.

        Raises
        ------
        InputError : matplotlib is missing.
        """
        from sameas.plots.map import chart

        return chart(self.sheet(), fullest(self.picture) if at is None else _time(at, "at", self.scene.span_s))

    def write(self, folder: str | os.PathLike[str], *, format: str = "parquet", map: bool = True, image: bool = True,
              coast: str | os.PathLike[str] | None = None) -> None:  # fmt: skip
        """Writes what the command writes into a folder, all of it or nothing: tables, GeoJSON, summary, map, image.

        Parameters
        ----------
        format : of the tables, "parquet" or "csv". map, image : whether map.html and picture.png are wanted.
        coast : GeoJSON with land or shores for the map.

        Raises
        ------
        InputError : the folder cannot be written; an unknown format.
        """
        from sameas.maps.outline import read_coast

        if format not in ("parquet", "csv"):
            raise InputError(f"format is {format!r}; give 'parquet' or 'csv'")
        outline = None if coast is None else read_coast(coast)
        outputs = PictureOutputs(Path(folder), format, map, image, self.call, outline)
        with filling(outputs.folder) as draft:
            write(self, draft, outputs)

    @property
    def headline(self) -> str:
        """What it is, in one line."""
        summary = self.picture.summary
        times = f"{counted(summary.instants, 'instant')}, {span(summary.first_s, summary.last_s)}"
        confirmed = counted(sum(summary.by_sources), "confirmed object")
        return f"Picture of {listed([one.description.name for one in self.sources])}: {confirmed}; {times}"

    def __repr__(self) -> str:
        offers = ".objects .pairs .report() .explain(object) .plot(at) .write(folder)"
        return in_lines(self.headline, self.doubts, offers)

    def _repr_html_(self) -> str:
        return in_html(self.headline, self.report(), self.plot)

    def facts(self, command: str) -> dict[str, Any]:
        """How the outputs were made: the same for the same command on the same files."""
        files = [path for path in dict.fromkeys(source.path for source in self.sources) if path.exists()]
        return made_by(command) | {
            "files": [str(path) for path in files], "sha256": [checksum(path) for path in files],
        }  # fmt: skip

    def as_json(self) -> dict[str, Any]:
        """The summary as JSON has it."""
        summary = self.picture.summary
        return {
            "sources": [_source(source) for source in self.sources],
            "instants": summary.instants, "first_s": summary.first_s, "last_s": summary.last_s,
            "confirmed_objects_by_number_of_sources": list(summary.by_sources),
            "unconfirmed_objects": summary.unconfirmed,
            "objects_per_instant": summary.detected, "expected_wrong_per_instant": summary.expected_wrong,
            "ambiguous_groups_per_instant": summary.ambiguous_groups, "places": asdict(summary.places),
            "alarms": [str(alarm) for alarm in (*summary.alarms, *summary.faults)],
            "doubts": [*self.source_doubts, *summary.notes],
            "offsets": [_offset(found) for found in self.biases],
            "misses": [asdict(misses) for misses in summary.misses],
            "estimated": [*self.scene.estimated, *summary.errors],
            "assumed": [asdict(line) for feed in self.scene.feeds for line in feed.description.assumed],
        }  # fmt: skip

    def sheet(self) -> MapSheet:
        """What a map shows of it."""
        picture, plane = self.picture, self.picture.plane
        sensors = [MapSensor.of(source.description, plane, source.path.name) for source in self.sources]
        title = "Picture of " + listed([source.description.name for source in self.sources])
        return MapSheet.of(
            title, picture.objects, picture.records, instants_s=picture.instants_s, sensors=sensors, plane=plane,
            summary=[*(f"doubt: {doubt}" for doubt in self.source_doubts), *picture.summary.lines()],
            alarms=list(_map_alarms(picture)), texts=picture.texts,
        )  # fmt: skip


def write(
    made: MatchPicture, draft: Path, outputs: PictureOutputs, warn: Callable[[str], object] = warnings.warn
) -> list[str]:
    """Writes everything that is wanted into a folder; the names of the files. warn : takes what cannot be."""
    from astropy.table import Table

    from sameas.io import write_table
    from sameas.io.geojson import write_geojson

    picture, facts = made.picture, made.facts(outputs.command)
    written = []
    for name, columns in zip(TABLES, (picture.objects, picture.records), strict=True):
        written.append(f"{name}.{outputs.format}")
        write_table(Table(dict(columns)), draft / written[-1], provenance=facts, format=outputs.format)
    if picture.plane is not None:
        written.append("objects.geojson")
        write_geojson(picture.objects, draft / written[-1])
    written.append("summary.json")
    (draft / written[-1]).write_text(json_text(facts | made.as_json()), "utf-8")
    if outputs.map or outputs.image:
        written += _drawn(made, draft, outputs, warn)
    return written


def older(folder: Path, written: Sequence[str]) -> list[str]:
    """Files of an earlier picture that are still in the folder and are not of this one."""
    known = [*(f"{name}.{extension}" for name in TABLES for extension in ("parquet", "csv")), *OTHERS]
    return [name for name in known if name not in written and (folder / name).exists()]


def fullest(picture: Picture) -> float:
    """The last of the instants at which most sources speak."""
    records = picture.records
    sources = [len(np.unique(records["source"][records["time_s"] == t])) for t in picture.instants_s]
    return float(picture.instants_s[np.flatnonzero(np.array(sources) == max(sources))[-1]])


def _drawn(made: MatchPicture, draft: Path, outputs: PictureOutputs, warn: Callable[[str], object]) -> Iterator[str]:
    """The map and the image; their names."""
    shown = made.sheet()
    if outputs.coast is not None and shown.plane is not None:
        shown = replace(shown, ground=outputs.coast.in_plane(shown.plane))
    if outputs.map:
        from sameas.pages.map import write_map_page

        write_map_page(shown, draft / "map.html")
        yield "map.html"
    if outputs.image:
        with _optional_plots(warn):
            from sameas.plots.map import chart
            from sameas.plots.sheet import save

            save(chart(shown, fullest(made.picture)), draft / "picture.png")
            yield "picture.png"


@contextmanager
def _optional_plots(warn: Callable[[str], object]) -> Iterator[None]:
    """Without matplotlib there is no image, and a line says so; the rest is there."""
    try:
        yield
    except InputError as error:
        if "matplotlib" not in str(error):
            raise
        warn(f"no picture.png: {error}")


def _map_alarms(picture: Picture) -> Iterator[MapAlarm]:
    """The alarms, with the objects that their records were."""
    records = picture.records
    for found in picture.summary.alarms:
        about = np.zeros(len(records["row"]), bool)
        for source, row in (found.alarm.first, found.alarm.second):
            about |= (records["source"] == source) & (records["row"] == row)
        yield MapAlarm(str(found), found.first_s, tuple(np.unique(records["object"][about]).tolist()))
    for fault in picture.summary.faults:
        about = (records["source"] == fault.source) & (records["track_id"] == (fault.track or None))
        yield MapAlarm(str(fault), fault.first_s, tuple(np.unique(records["object"][about]).tolist()))


def _source(source: SensorSource) -> dict[str, Any]:
    reports, damaged = source.reports, source.reports.damaged
    return {
        "name": source.description.name, "kind": source.description.kind, "kind_guessed": source.why_kind,
        "file": str(source.path), "format": reports.kind, "positions": reports.position, "reports": len(reports),
        "damaged": damaged.counts(), "passed_over": dict(reports.passed_over), "notes": list(reports.notes),
    }  # fmt: skip


def _offset(found: SourceBiases) -> dict[str, Any]:
    return {
        "source": found.source, "against": list(found.against), "established": found.established,
        "parameters": {name: asdict(it) for name, it in found.parameters.items()}, "words": list(found.lines()),
    }  # fmt: skip


def pictured(
    sources: Sequence[SensorSource],
    when: Instants,
    method: Method,
    *,
    call: str = "",
    unread: Sequence[str] = (),
    progress: Callable[[str], object] = lambda stage: None,
    say: Callable[[Iterable[str]], object] = lambda lines: None,
) -> MatchPicture:
    """The picture of sources.

    Parameters
    ----------
    call : the call or command that makes it. unread : doubts on files that were set aside.
    progress : called with what is being done. say : called with the lines of the report, part after part.
    """
    progress("the sensors' places and times")
    scene = Scene.of([(source.description, source.reports) for source in sources])
    times = when.of(scene.span_s)
    say(scene_lines(scene, method.watch(scene)))
    progress("looking for what is wrong")
    doubts = scene.doubts()
    say(doubt_lines(doubts))
    if method.memory and nameless(scene):
        progress("the sensors' errors")
        scene, _ = scene.with_fitted_errors()
    biases: tuple[SourceBiases, ...] = ()
    if method.registration and len(sources) > 1:
        progress("the sensors' offsets")
        scene, biases = scene.registered()
    progress(counted(len(times), "instant"))
    lines = [line for found in biases for line in found.lines()]
    lines += dict.fromkeys(note for heights in scene.heights if heights is not None for note in heights.notes)
    picture = Picture.of(scene, times, watch=method.watch(scene), biases=lines, progress=progress)
    if not len(picture.records["row"]):
        raise InputError(
            f"no source has a report at {span(times[0], times[-1])}; reports are of {span(*scene.span_s)}",
            naming("give {at}, or {begin} and {end}, within that span"),
        )
    say([*found_lines(picture.summary), *estimated_lines(scene), *assumed_lines(scene)])
    return MatchPicture(picture, sources, scene, biases, (*unread, *doubts), call)


def match_picture(
    sources: Any,
    *,
    sensors: str | os.PathLike[str] | None = None,
    every: float | None = None,
    at: float | str | None = None,
    begin: float | str | None = None,
    end: float | str | None = None,
    start: str | None = None,
    without: str | Sequence[str] = (),
    registration: bool = True,
    identity: bool = True,
    memory: bool = True,
    progress: Callable[[str], object] = lambda stage: None,
) -> MatchPicture:
    """One picture from many sensors: which record of each source is which ship or aircraft, and how sure that is.

    Parameters
    ----------
    sources : path, paths, or by the names of the sources paths or tables (data frames, astropy and Arrow tables, dicts
        of columns) with a time and positions. sensors : TOML file that describes the sources.
    every : seconds between instants. at : one instant only; begin, end : the first and the last: seconds since 1970, or
        dates. start : UTC of the first line, for files without a date.
    without : sources to leave out. registration, identity, memory : whether the sensors' offsets are taken away, and
        whether identities and the past of tracks are evidence.
    progress : called with what is being done.

    Raises
    ------
    InputError : what cannot be read or understood, with the remedy.

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
        "sensors": sensors, "every": every, "at": at, "begin": begin, "end": end, "start": start, "without": without,
        "registration": registration, "identity": identity, "memory": memory,
    }  # fmt: skip
    alone = isinstance(sources, str | os.PathLike)
    given = [sources] if alone else list(sources.values() if isinstance(sources, Mapping) else sources)
    call = call_text(match_picture, given, stated)
    if at is not None and (every or begin or end):
        raise InputError("match_picture: give at, or every with begin and end, not both")
    described = read_source_options(Path(sensors)) if sensors is not None else {}
    left_out = (without,) if isinstance(without, str) else tuple(without)
    method = Method(registration, identity, memory, left_out)
    every_source = method.taken(_sources(sources, described, start))
    return pictured(every_source, Instants(every, at, begin, end), method, call=call, progress=progress)


def _sources(sources: Any, described: Mapping[str, SourceOptions], start: str | None) -> list[SensorSource]:
    """The sources of anything that :func:`match_picture` takes."""
    if isinstance(sources, str | os.PathLike):
        sources = [sources]
    if not isinstance(sources, Mapping):
        return read_sources([os.fspath(one) for one in sources], described, start=start)
    files = [f"{name}={os.fspath(one)}" for name, one in sources.items() if isinstance(one, str | os.PathLike)]
    held = {name: one for name, one in sources.items() if not isinstance(one, str | os.PathLike)}
    there = {name: one for name, one in described.items() if name not in held}
    read = read_sources(files, there, start=start) if files or any(one.path for one in there.values()) else []
    for name, data in held.items():
        own = data if isinstance(data, Reports) else read_cells(_cells(data, name), name, *_reading(name, described))
        read.append(source_of(own, described.get(name), Path(name)))
    unused = [name for name in described if name not in sources and described[name].path is None]
    if unused and not files:
        raise InputError(f"{unused[0]} is described, but no file belongs to it; there are {', '.join(sources)}")
    order = {name: k for k, name in enumerate(sources)}
    return sorted(read, key=lambda one: order.get(one.description.name, len(order)))


def _cells(data: Any, name: str) -> TableText:
    """The cells of a table in memory; times as seconds since 1970."""
    from sameas.times import Time

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
        columns[column] = [None if off else cell for cell, off in zip(cells, masked.tolist(), strict=True)]
    return TableText(columns, np.arange(1, len(table) + 1))


def _reading(name: str, described: Mapping[str, SourceOptions]) -> tuple[Any, ...]:
    """Date, columns and units of a source as it is described."""
    if name not in described:
        return ()
    options = described[name].options
    return None if options.start is None else instant(str(options.start)), options.columns, options.units


def _time(text: str | float, argument: str, span_s: tuple[float, float]) -> float:
    """A time as the user writes it: ISO text, seconds since 1970, or of the user's own clock; HH:MM[:SS] of the day."""
    text = str(text)
    found = _of_day(text, span_s)
    moment = instant(text) if found is None else found
    if moment is None:
        words = Message(Argument(argument, text), ": give a time such as 2024-05-01T13:00:00Z, 13:00, or seconds")
        raise InputError(words)
    return moment


def _of_day(text: str, span_s: tuple[float, float]) -> float | None:
    """HH:MM or HH:MM:SS on the day on which the reports begin, or on the next where they have got there by then."""
    for form in ("%H:%M", "%H:%M:%S"):
        try:
            clock = datetime.strptime(text.removesuffix("Z"), form)
        except ValueError:
            continue
        moment = span_s[0] - span_s[0] % DAY_S + clock.hour * 3600.0 + clock.minute * 60.0 + clock.second
        return moment + DAY_S if moment < span_s[0] and moment + DAY_S <= span_s[1] else moment
    return None

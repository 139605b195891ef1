"""``sameas picture``: read the sensors' files, take their offsets away, identify, say, write."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from sameas.arrays import FloatArray
from sameas.cli.options import in_options, sensor_option
from sameas.cli.terminal import Pace, Printer, notice, share_compilation
from sameas.errors import InputError
from sameas.front.provenance import made_by
from sameas.io import checksum
from sameas.io.atomic import filling
from sameas.io.sensors.clock import DAY_S, instant
from sameas.io.sensors.sources import SensorSource, read_source_options, read_sources
from sameas.many.rules import SetRule
from sameas.maps.coast import Coast
from sameas.maps.sheet import MapAlarm, MapSensor, MapSheet
from sameas.picture.memory import Past
from sameas.picture.picture import MOST_INSTANTS, Picture, instants
from sameas.picture.plot_picture import PlotPicture, nameless
from sameas.picture.watch import Watch
from sameas.report.picture import assumed_lines, doubt_lines, found_lines, listed, read_lines, scene_lines
from sameas.report.prose import count, counted, span
from sameas.tracks.registration import SourceBiases
from sameas.tracks.scene import Instant, Scene

#: Steps between instants that are chosen from, seconds, and how many instants there may then be.
STEPS_S = (1.0, 2.0, 5.0, 10.0, 20.0, 30.0, 60.0, 120.0, 300.0, 600.0, 1200.0, 1800.0, 3600.0)
ENOUGH = 200


@dataclass(frozen=True)
class Instants:
    """When the user wants to see the picture."""

    every_s: float | None
    at: str | None
    begin: str | None
    end: str | None

    def of(self, span_s: tuple[float, float]) -> FloatArray:
        """(k,) the instants, ascending, for reports within a span."""
        if self.at is not None:
            return np.array([_time(self.at, "--at", span_s)])
        first = span_s[0] if self.begin is None else _time(self.begin, "--from", span_s)
        last = span_s[1] if self.end is None else _time(self.end, "--to", span_s)
        if first > last:
            raise InputError(f"the picture would be from {self._said(first, last)}: it ends before it begins")
        if self.every_s is not None and (last - first) / self.every_s >= MOST_INSTANTS:
            raise InputError(
                f"--every {self.every_s:g}s makes {count(round((last - first) / self.every_s))} instants from "
                f"{span(first, last)}; give a longer time between instants"
            )
        step = next((step for step in STEPS_S if (last - first) / step <= ENOUGH), (last - first) / ENOUGH)
        return instants((first, last), self.every_s or step)

    def _said(self, first_s: float, last_s: float) -> str:
        given = f" (--from {self.begin})" if self.begin else ""
        return span(first_s, last_s).replace(" to ", f"{given} to ") + (f" (--to {self.end})" if self.end else "")


@dataclass(frozen=True)
class Method:
    """What is done beside the positions. without : names of sources that are left out."""

    registration: bool
    identity: bool
    memory: bool
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
                raise InputError(f"--without {name}: there is no such source", f"give one of {', '.join(names)}")
        left = [source for source in sources if source.description.name not in self.without]
        if not left:
            raise InputError(f"--without {', '.join(self.without)}: no source is left")
        return left

    def say(self) -> Callable[[Instant, Past], SetRule]:
        """What counts as evidence at an instant."""

        def rule(now: Instant, past: Past) -> SetRule:
            said: SetRule = now.rule() + now.height()
            if self.identity:
                said = said + now.identity()
            return said + past.rule() if self.memory else said

        return rule

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
    format: str
    map: bool
    image: bool
    command: str
    coast: Coast | None = None


@dataclass(frozen=True)
class Made:
    """A picture, what it was made of, and what is in doubt of its sources as a whole."""

    picture: Picture
    sources: Sequence[SensorSource]
    biases: Sequence[SourceBiases]
    doubts: Sequence[str]

    def facts(self, command: str) -> dict[str, Any]:
        """How the outputs were made: the same for the same command on the same files."""
        files = list(dict.fromkeys(source.path for source in self.sources))
        return made_by(command) | {
            "files": [str(path) for path in files], "sha256": [checksum(path) for path in files],
        }  # fmt: skip

    def told(self) -> dict[str, Any]:
        """The summary as JSON has it."""
        said = self.picture.summary
        return {
            "sources": [_source(source) for source in self.sources],
            "instants": said.instants, "first_s": said.first_s, "last_s": said.last_s,
            "confirmed_objects_by_number_of_sources": list(said.by_sources), "unconfirmed_objects": said.unconfirmed,
            "objects_per_instant": said.detected, "expected_wrong_per_instant": said.expected_wrong,
            "ambiguous_groups_per_instant": said.ambiguous_groups, "places": asdict(said.places),
            "alarms": [str(alarm) for alarm in said.alarms], "doubts": [*self.doubts, *said.notes],
            "offsets": [_offset(found) for found in self.biases], "misses": [asdict(misses) for misses in said.misses],
            "assumed": [asdict(line) for source in self.sources for line in source.description.assumed],
        }  # fmt: skip

    def sheet(self) -> MapSheet:
        """What a map shows of it."""
        picture, plane = self.picture, self.picture.plane
        sensors = [MapSensor.of(source.description, plane, source.path.name) for source in self.sources]
        title = "Picture of " + listed([source.description.name for source in self.sources])
        return MapSheet.of(
            title, picture.objects, picture.records, instants_s=picture.instants_s, sensors=sensors, plane=plane,
            summary=[*(f"doubt: {doubt}" for doubt in self.doubts), *picture.summary.lines()],
            alarms=list(_map_alarms(picture)), texts=picture.texts,
        )  # fmt: skip


def write(made: Made, draft: Path, outputs: PictureOutputs) -> list[str]:
    """Writes everything that is wanted into a folder; the names of the files."""
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
    (draft / written[-1]).write_text(json.dumps(facts | made.told(), indent=1, ensure_ascii=False) + "\n", "utf-8")
    if outputs.map or outputs.image:
        written += _drawn(made, draft, outputs)
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


def _drawn(made: Made, draft: Path, outputs: PictureOutputs) -> Iterator[str]:
    """The map and the image; their names."""
    shown = made.sheet()
    if outputs.coast is not None and shown.plane is not None:
        shown = replace(shown, ground=outputs.coast.in_plane(shown.plane))
    if outputs.map:
        from sameas.pages.map import write_map_page

        write_map_page(shown, draft / "map.html")
        yield "map.html"
    if outputs.image:
        with _optional_plots():
            from sameas.plots.map import chart
            from sameas.plots.sheet import save

            save(chart(shown, fullest(made.picture)), draft / "picture.png")
            yield "picture.png"


@contextmanager
def _optional_plots() -> Iterator[None]:
    """Without matplotlib there is no image, which is said; the rest is there."""
    try:
        yield
    except InputError as error:
        if "matplotlib" not in str(error):
            raise
        notice(f"no picture.png: {error}")


def _map_alarms(picture: Picture) -> Iterator[MapAlarm]:
    """The alarms, with the objects that their records were."""
    records = picture.records
    for found in picture.summary.alarms:
        about = np.zeros(len(records["row"]), bool)
        for source, row in (found.alarm.first, found.alarm.second):
            about |= (records["source"] == source) & (records["row"] == row)
        yield MapAlarm(str(found), found.first_s, tuple(np.unique(records["object"][about]).tolist()))


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


def run(
    files: Sequence[str],
    sensors: Path | None,
    start: str | None,
    when: Instants,
    method: Method,
    outputs: PictureOutputs,
    quiet: bool,
) -> bool:
    """Make the picture, print what was found, write what is wanted; whether every file could be read."""
    began = time.perf_counter()
    printer = Printer(quiet)
    with filling(outputs.folder) as draft:
        with Pace(quiet) as pace:
            pace("reading")
            with _remedies(sensors):
                described = read_source_options(sensors) if sensors else None
                unread: list[InputError] = []
                sources = read_sources(files, described, start=start, set_aside=unread)
                sources = method.taken(sources)
            pace.pause()
            printer(read_lines((source.reports.source, source.lines()) for source in sources))
            left_out = [f"set aside: {in_options(error.words, sensor_option)}" for error in unread]
            printer(doubt_lines(left_out))
            share_compilation(quiet)
            made = _made(sources, sensors, when, method, pace, printer)
            made = replace(made, doubts=[*left_out, *made.doubts])
            pace("writing")
            written = write(made, draft, outputs)
        seconds = time.perf_counter() - began
    printer(["", f"Output: {outputs.folder}/: {', '.join(written)}", f"Time: {seconds:.1f} s"])
    if left := older(outputs.folder, written):
        notice(f"of an earlier picture, and not of this one: {', '.join(str(outputs.folder / name) for name in left)}")
    return not unread


def _made(
    sources: Sequence[SensorSource],
    sensors: Path | None,
    when: Instants,
    method: Method,
    pace: Pace,
    printer: Printer,
) -> Made:
    """The picture of the sources, said on the way."""
    pace("the sensors' places and times")
    with _remedies(sensors):
        scene = Scene.of([(source.description, source.reports) for source in sources])
    times = when.of(scene.span_s)
    printer(scene_lines(scene, method.watch(scene)))
    pace("looking for what is wrong")
    doubts = scene.doubts()
    pace.pause()
    printer(doubt_lines(doubts))
    biases: tuple[SourceBiases, ...] = ()
    if method.registration and len(sources) > 1:
        pace("the sensors' offsets")
        scene, biases = scene.registered()
    pace(counted(len(times), "instant"))
    lines = [line for found in biases for line in found.lines()]
    lines += dict.fromkeys(note for heights in scene.heights if heights is not None for note in heights.notes)
    picture = Picture.of(scene, times, watch=method.watch(scene), biases=lines, progress=pace)
    if not len(picture.records["row"]):
        raise InputError(
            f"no source says anything at {span(times[0], times[-1])}; they speak from {span(*scene.span_s)}: "
            "say --at, or --from and --to, within that"
        )
    pace.pause()
    printer([*found_lines(picture.summary), *assumed_lines(scene)])
    return Made(picture, sources, biases, doubts)


@contextmanager
def _remedies(sensors: Path | None) -> Iterator[None]:
    """Remedies in the words of Python come with those of the command."""
    try:
        yield
    except InputError as error:
        file = str(sensors) if sensors else "a TOML file given with --sensors"
        options = {
            "description": f", its table in {file}",
            "columns": f"; in {file}: file = {{ columns = {{ … }} }} in the table of the source",
            "start": ": --start, or file = { start = … } in its description",
        }
        more = next((options[argument.name] for argument in error.words.arguments if argument.name in options), "")
        raise InputError(in_options(error.words, sensor_option) + more) from error


def _time(text: str, option: str, span_s: tuple[float, float]) -> float:
    """A time as the user writes it: ISO text, seconds since 1970, or of the user's own clock; HH:MM[:SS] of the day."""
    found = _of_day(text, span_s)
    moment = instant(text) if found is None else found
    if moment is None:
        raise InputError(f"{option} {text}: give a time such as 2024-05-01T13:00:00Z, 13:00, or seconds")
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

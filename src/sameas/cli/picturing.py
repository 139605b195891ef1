"""``sameas picture``: read the sensors' files, take their offsets away, identify, say, write."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

import sameas
from sameas.belief import SetRule
from sameas.cli.terminal import Pace, Printer, tell_compilation
from sameas.errors import InputError
from sameas.io.atomic import replacing
from sameas.io.sensors.clock import instant
from sameas.io.sensors.sources import SensorSource, read_sources, read_told
from sameas.picture.memory import Past
from sameas.picture.moment import Watch
from sameas.picture.picture import Picture, instants
from sameas.prose import DOUBT, count, entry
from sameas.records import FloatArray
from sameas.tracks.registration import SourceBiases
from sameas.tracks.scene import Instant, Scene

#: Steps between instants that are chosen from, seconds, and how many instants there may then be.
STEPS_S = (1.0, 2.0, 5.0, 10.0, 20.0, 30.0, 60.0, 120.0, 300.0, 600.0, 1200.0, 1800.0, 3600.0)
ENOUGH = 200
#: Numbers above this are seconds since 1970.
EPOCH_S = 1e8


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
            raise InputError(f"--from {self.begin} is after --to {self.end}")
        if self.every_s is not None:
            return instants((first, last), self.every_s)
        step = next((step for step in STEPS_S if (last - first) / step <= ENOUGH), (last - first) / ENOUGH)
        return instants((first, last), step)


@dataclass(frozen=True)
class Method:
    """What is done beside the positions."""

    registration: bool
    identity: bool
    memory: bool

    def say(self) -> Callable[[Instant, Past], SetRule]:
        """What counts as evidence at an instant."""

        def rule(now: Instant, past: Past) -> SetRule:
            said: SetRule = now.belief()
            if self.identity:
                said = said + now.identity()
            return said + past.rule() if self.memory else said

        return rule


@dataclass(frozen=True)
class Outputs:
    """What the user wants to have."""

    folder: Path
    format: str
    map: bool
    image: bool
    command: str


def run(
    files: Sequence[str],
    sensors: Path | None,
    start: str | None,
    when: Instants,
    method: Method,
    outputs: Outputs,
    quiet: bool,
) -> None:
    """Make the picture, print what was found, write what is wanted."""
    began = time.perf_counter()
    printer = Printer(quiet)
    with Pace(quiet) as pace:
        pace("reading")
        sources = read_sources(files, read_told(sensors) if sensors else None, start=start)
        printer(_read_lines(sources))
        if not quiet:
            tell_compilation()
        pace("the sensors' places and times")
        scene = Scene.of([(source.description, source.reports) for source in sources])
        pace("looking for what is wrong")
        printer(_doubt_lines(scene))
        biases: tuple[SourceBiases, ...] = ()
        if method.registration and len(sources) > 1:
            pace("the sensors' offsets")
            scene, biases = scene.registered()
        times = when.of(scene.span_s)
        pace(f"{count(len(times))} instants")
        lines = [line for found in biases for line in found.lines()]
        picture = Picture.of(scene, times, watch=Watch(say=method.say()), biases=lines)
        printer(_found_lines(picture, scene))
        pace("writing")
        written = _write(picture, scene, sources, outputs)
    seconds = time.perf_counter() - began
    printer(["", f"Output: {outputs.folder}/: {', '.join(written)}", f"Time: {seconds:.1f} s"])


def _time(text: str, option: str, span_s: tuple[float, float]) -> float:
    """A time as the user writes it: ISO text, seconds since 1970, or of the user's own clock; HH:MM[:SS] of the day."""
    if found := _of_day(text, span_s):
        return found
    moment = instant(text)
    if moment is None:
        raise InputError(f"{option} {text}: give a time such as 2024-05-01T13:00:00Z, 13:00, or seconds")
    return moment


def _of_day(text: str, span_s: tuple[float, float]) -> float | None:
    """HH:MM or HH:MM:SS on the day on which the reports begin."""
    for form in ("%H:%M", "%H:%M:%S"):
        try:
            clock = datetime.strptime(text.removesuffix("Z"), form)
        except ValueError:
            continue
        day = span_s[0] - span_s[0] % 86400.0
        return day + clock.hour * 3600.0 + clock.minute * 60.0 + clock.second
    return None


def said_time(time_s: float) -> str:
    """A time as text: UTC where it counts from 1970, else seconds."""
    if time_s < EPOCH_S:
        return f"{time_s:g} s"
    return datetime.fromtimestamp(time_s, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")


def _read_lines(sources: Sequence[SensorSource]) -> Iterator[str]:
    yield "Sources"
    for source in sources:
        first, *rest = source.lines()
        yield f"  {first} ({source.path.name})"
        yield from (f"    {line}" for line in rest)


def _doubt_lines(scene: Scene) -> Iterator[str]:
    yield from (f"{DOUBT}{doubt}" for doubt in scene.doubts())


def _found_lines(picture: Picture, scene: Scene) -> Iterator[str]:
    """The summary: what was found, what is to be looked at, offsets, misses, and what was assumed."""
    said = picture.summary
    yield ""
    yield f"Picture: {count(said.instants)} instants, {said_time(said.first_s)} to {said_time(said.last_s)}"
    seen = [f"{count(n)} by {k}" for k, n in enumerate(said.by_sources) if n and k]
    yield from entry("objects", f"{count(sum(said.by_sources))} confirmed, at best {', '.join(seen[::-1]) or 'none'} "
                                   f"of the sources at once; {count(said.unconfirmed)} never confirmed")  # fmt: skip
    yield from entry("how sure", f"at an instant {said.expected_wrong:.2g} objects are expected not to be exactly "
                                    f"right, {said.ambiguous_groups:.2g} groups are ambiguous")  # fmt: skip
    for alarm in said.alarms:
        yield from entry("ALARM", f"{alarm}, from {said_time(alarm.first_s)}")
    for line in said.biases:
        yield from entry("offset", line)
    for misses in said.misses:
        yield from entry("misses", str(misses))
    for note in said.notes:
        yield f"{DOUBT}{note}"
    for words in _assumptions(scene):
        yield from entry("assumed", words)


def _assumptions(scene: Scene) -> Iterator[str]:
    """Every number that nobody gave, those of one kind of source together; summary.json says why each was taken."""
    said: dict[tuple[str, str], list[str]] = {}
    for feed in scene.feeds:
        described = feed.description
        if described.assumed:
            numbers = ", ".join(f"{line.name} {_number(line.value)}" for line in described.assumed)
            said.setdefault((described.kind, numbers), []).append(described.name)
    for (kind, numbers), names in said.items():
        yield f"{_listed(names)} ({kind}): {numbers}"


def _number(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def _write(picture: Picture, scene: Scene, sources: Sequence[SensorSource], outputs: Outputs) -> list[str]:
    """Tables, GeoJSON, map, image and summary; their names."""
    from astropy.table import Table

    from sameas.io import write_table

    folder = outputs.folder
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot be made ({error.strerror}); say -o another folder") from error
    facts = {"program": "sameas", "version": sameas.__version__, "command": outputs.command,
             "files": [str(source.path) for source in sources]}  # fmt: skip
    written = []
    for name, columns in (("objects", picture.objects), ("identities", picture.records)):
        written.append(f"{name}.{outputs.format}")
        write_table(Table(dict(columns)), folder / written[-1], provenance=facts, format=outputs.format)
    if picture.plane is not None:
        from sameas.io.geojson import write_geojson

        written.append("objects.geojson")
        write_geojson(picture.objects, folder / written[-1])
    with replacing(folder / "summary.json") as draft:
        draft.write_text(json.dumps(facts | _told(picture), indent=1, ensure_ascii=False), encoding="utf-8")
    written.append("summary.json")
    if outputs.map or outputs.image:
        written += _drawn(picture, scene, sources, outputs)
    return written


def _told(picture: Picture) -> dict[str, Any]:
    """The summary as JSON has it."""
    said = picture.summary
    return {
        "instants": said.instants, "first_s": said.first_s, "last_s": said.last_s,
        "confirmed_objects_by_number_of_sources": list(said.by_sources), "unconfirmed": said.unconfirmed,
        "expected_wrong_per_instant": said.expected_wrong, "ambiguous_groups_per_instant": said.ambiguous_groups,
        "alarms": [str(alarm) for alarm in said.alarms], "offsets": list(said.biases),
        "misses": [str(misses) for misses in said.misses], "notes": list(said.notes), "assumed": list(said.assumed),
    }  # fmt: skip


def _drawn(picture: Picture, scene: Scene, sources: Sequence[SensorSource], outputs: Outputs) -> Iterator[str]:
    """The map and the image; their names."""
    from sameas.maps.sheet import MapSensor, MapSheet

    sensors = [MapSensor.of(source.description, scene.plane, source.path.name) for source in sources]
    title = "Picture of " + _listed([source.description.name for source in sources])
    shown = MapSheet.of(
        title, picture.objects, picture.records, instants_s=picture.instants_s, sensors=sensors, plane=picture.plane,
        summary=picture.summary.lines(), alarms=_map_alarms(picture), texts=picture.texts,
    )  # fmt: skip
    if outputs.map:
        from sameas.pages.map import write_map_page

        write_map_page(shown, outputs.folder / "map.html")
        yield "map.html"
    if outputs.image:
        with _optional_plots():
            from sameas.plots.map import chart
            from sameas.plots.sheet import save

            save(chart(shown, _fullest(picture)), outputs.folder / "picture.png")
            yield "picture.png"


def _fullest(picture: Picture) -> float:
    """The last of the instants at which most sources speak."""
    records = picture.records
    sources = [len(np.unique(records["source"][records["time_s"] == t])) for t in picture.instants_s]
    return float(picture.instants_s[np.flatnonzero(np.array(sources) == max(sources))[-1]])


def _map_alarms(picture: Picture) -> list[Any]:
    """The alarms, with the objects that their records were."""
    from sameas.maps.sheet import MapAlarm

    records = picture.records
    alarms = []
    for found in picture.summary.alarms:
        about = np.zeros(len(records["row"]), bool)
        for source, row in (found.alarm.first, found.alarm.second):
            about |= (records["source"] == source) & (records["row"] == row)
        alarms.append(MapAlarm(str(found), found.first_s, tuple(np.unique(records["object"][about]).tolist())))
    return alarms


@contextmanager
def _optional_plots() -> Iterator[None]:
    """Without matplotlib there is no image, which is said; the rest is there."""
    from sameas.cli.terminal import notice

    try:
        yield
    except InputError as error:
        if "matplotlib" not in str(error):
            raise
        notice(f"no picture.png: {error}")


def _listed(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"

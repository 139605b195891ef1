"""``sameas picture``: read the sensors' files, take their offsets away, identify, say, write."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np

from sameas.arrays import FloatArray
from sameas.cli.options import in_options, sensor_option
from sameas.cli.picture_files import Made, Outputs, older, write
from sameas.cli.terminal import Pace, Printer, notice, tell_compilation
from sameas.errors import InputError
from sameas.io.atomic import filling
from sameas.io.sensors.clock import DAY_S, instant
from sameas.io.sensors.sources import SensorSource, read_sources, read_told
from sameas.many.rules import SetRule
from sameas.picture.memory import Past
from sameas.picture.picture import MOST, Picture, instants
from sameas.picture.plot_picture import PlotPicture, nameless
from sameas.picture.watch import Watch
from sameas.report.picture import assumed_lines, doubt_lines, found_lines, read_lines, scene_lines
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
        if self.every_s is not None and (last - first) / self.every_s >= MOST:
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
    """What is done beside the positions."""

    registration: bool
    identity: bool
    memory: bool

    def say(self) -> Callable[[Instant, Past], SetRule]:
        """What counts as evidence at an instant."""

        def rule(now: Instant, past: Past) -> SetRule:
            said: SetRule = now.rule()
            if self.identity:
                said = said + now.identity()
            return said + past.rule() if self.memory else said

        return rule

    def watch(self, scene: Scene) -> Watch | PlotPicture:
        """What the picture carries from instant to instant; without memory every instant is its own."""
        if not self.memory:
            return Watch(evidence=self.say(), bound=1.0)
        return PlotPicture() if nameless(scene) else Watch(evidence=self.say())


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
    with filling(outputs.folder) as draft:
        with Pace(quiet) as pace:
            pace("reading")
            with _remedies(sensors):
                sources = read_sources(files, read_told(sensors) if sensors else None, start=start)
            pace.pause()
            printer(read_lines((source.reports.source, source.lines()) for source in sources))
            if not quiet:
                tell_compilation()
            made = _made(sources, sensors, when, method, pace, printer)
            pace("writing")
            written = write(made, draft, outputs)
        seconds = time.perf_counter() - began
    printer(["", f"Output: {outputs.folder}/: {', '.join(written)}", f"Time: {seconds:.1f} s"])
    if left := older(outputs.folder, written):
        notice(f"of an earlier picture, and not of this one: {', '.join(str(outputs.folder / name) for name in left)}")


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

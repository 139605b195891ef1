"""``sameas picture``: read the sensors' files, say what is found, write."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from sameas.cli.options import in_options, sensor_option
from sameas.cli.terminal import Pace, Printer, notice, share_compilation
from sameas.errors import InputError
from sameas.front.picture import Instants, Method, PictureOutputs, older, pictured, write
from sameas.io.atomic import filling
from sameas.io.sensors.sources import read_source_options, read_sources
from sameas.report.picture import doubt_lines, read_lines


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

            def say(lines: Iterable[str]) -> None:
                pace.pause()
                printer(lines)

            with _remedies(sensors):
                made = pictured(sources, when, method, call=outputs.command, unread=left_out, progress=pace, say=say)
            pace("writing")
            written = write(made, draft, outputs, notice)
        seconds = time.perf_counter() - began
    printer(["", f"Output: {outputs.folder}/: {', '.join(written)}", f"Time: {seconds:.1f} s"])
    if left := older(outputs.folder, written):
        notice(f"of an earlier picture, and not of this one: {', '.join(str(outputs.folder / name) for name in left)}")
    return not unread


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

"""``sameas picture``: one picture of the situation from the files of many sensors."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from sameas.cli.options import Debug, Folder, Quiet, in_options, one_of, option, sensor_option
from sameas.cli.outcome import INPUT_ERROR, answering
from sameas.cli.terminal import Pace, Printer, notice, share_compilation
from sameas.errors import InputError
from sameas.front.picture import PictureOutputs, older, pictured, write
from sameas.front.picture_options import Area, Instants, Method
from sameas.io.atomic import filling
from sameas.io.sensors.format import duration
from sameas.io.sensors.sources import read_source_options, read_sources
from sameas.maps.geojson import read_coast
from sameas.report.picture import read_lines

_TIMES, _AREA, _METHOD, _FILES = "The instants", "The area", "The method", "Outputs"
TABLES = ("parquet", "csv")


def duration_s(text: str | None) -> float | None:
    """Seconds of "10s", "2min", "0.5h" or a plain number of seconds."""
    if text is None:
        return None
    seconds = duration(text)
    if seconds is None:
        raise typer.BadParameter(f"{text!r} is not a duration; give 10s, 2min or 1h", param_hint="--every")
    return seconds


def picture(
    ctx: typer.Context,
    files: Annotated[list[str] | None, typer.Argument(
        metavar="FILE...", show_default=False,
        help="Recordings of the sensors: CSV, Parquet, JSON lines, MAT files, AIS and ARPA NMEA, NMEA 2000, Signal K, "
        "gpsd, aircraft.json, SBS, Mode S, ASTERIX. NAME=FILE names the source.",
    )] = None,
    sensors: Annotated[Path | None, option(
        "--sensors", "-s", metavar="TOML",
        help="Description of the sensors (TOML): position, coverage, errors, misses, biases; and their files. Or data "
        "sources exported by COMPASS (JSON).",
    )] = None,
    output: Folder = Path("picture"),
    every: Annotated[
        str | None, option("--every", panel=_TIMES, metavar="10s", help="Time between instants; 10s, 2min, 1h.")
    ] = None,
    at: Annotated[str | None, option("--at", panel=_TIMES, metavar="TIME", help="One instant only.")] = None,
    begin: Annotated[str | None, option("--from", panel=_TIMES, metavar="TIME", help="The first instant.")] = None,
    end: Annotated[str | None, option("--to", panel=_TIMES, metavar="TIME", help="The last instant.")] = None,
    start: Annotated[str | None, option(
        "--start", panel=_TIMES, metavar="TIME", help="UTC of the first line, for files without a date.",
    )] = None,
    within: Annotated[str | None, option(
        "--within", panel=_AREA, metavar="LAT,LON,KM",
        help="Use only reports within this distance of a place; 50km, 20nm.",
    )] = None,
    without: Annotated[list[str] | None, option(
        "--without", panel=_METHOD, metavar="SOURCE", help="Exclude this source, for comparison; may be repeated.",
    )] = None,
    no_registration: Annotated[
        bool, option("--no-registration", panel=_METHOD, help="Assume sensor offsets of zero, or as described.")
    ] = False,
    no_identity: Annotated[
        bool, option("--no-identity", panel=_METHOD, help="Do not use MMSI, ICAO address, callsign … as evidence.")
    ] = False,
    no_memory: Annotated[bool, option(
        "--no-memory", panel=_METHOD, help="Identify every instant by itself, without the tracks' history.",
    )] = False,
    format: Annotated[
        str, option("--format", panel=_FILES, metavar="parquet|csv", callback=one_of(TABLES), help="Table format.")
    ] = "parquet",
    coast: Annotated[Path | None, option(
        "--coast", panel=_FILES, metavar="GEOJSON", help="Land and shores for the map, finer than the world's.",
    )] = None,
    asterix: Annotated[bool, option(
        "--asterix", panel=_FILES, help="Also objects.ast: the objects as tracks of ASTERIX category 062.",
    )] = False,
    no_map: Annotated[bool, option("--no-map", panel=_FILES, help="No map.html.")] = False,
    no_image: Annotated[bool, option("--no-image", panel=_FILES, help="No picture.png.")] = False,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:  # fmt: skip
    """One picture from many sensors: which record of each source is which ship or aircraft, and how sure that is.

    Writes tables of identities and objects, GeoJSON, a map to open in a browser and a picture for a report.
    Everything assumed and estimated is printed.
    """
    if not files and sensors is None:
        raise typer.BadParameter("give the sensors' files, or --sensors with a TOML file that names them")
    if at is not None and (every or begin or end):
        raise typer.BadParameter("give --at, or --every with --from and --to, not both", param_hint="--at")
    with answering(debug, sensor_option):
        began, printer = time.perf_counter(), Printer(quiet)
        when = Instants(duration_s(every), at, begin, end)
        area = None if within is None else Area.of_text(within)
        method = Method(not no_registration, not no_identity, not no_memory, tuple(without or ()), area)
        land = None if coast is None else read_coast(coast)
        outputs = PictureOutputs(output, format, not no_map, not no_image, ctx.meta.get("typed", ""), land,
                                 asterix)  # fmt: skip
        set_aside: dict[str, InputError] = {}
        words = partial(_with_options, sensors)
        with filling(output) as draft:
            with Pace(quiet) as pace:

                def say(lines: Iterable[str]) -> None:
                    pace.pause()
                    printer(lines)

                pace("reading")
                with _remedies(sensors):
                    described = read_source_options(sensors, set_aside=set_aside) if sensors else None
                    read = read_sources(files or [], described, start=start, set_aside=set_aside)
                sources = method.included(read, set_aside)
                say(read_lines((source.reports.source, source.lines()) for source in sources))
                share_compilation(quiet, "picture")
                with _remedies(sensors):
                    result = pictured(
                        sources, when, method, call=outputs.command, set_aside=set_aside, words=words, progress=pace,
                        say=say,
                    )  # fmt: skip
                pace("writing")
                written = write(result, draft, outputs, notice)
            seconds = time.perf_counter() - began
        printer(["", f"Output: {output}/: {', '.join(written)}", f"Time: {seconds:.1f} s"])
        if left := older(output, written):
            notice(f"of an earlier picture, and not of this one: {', '.join(str(output / name) for name in left)}")
    if set_aside:
        raise typer.Exit(INPUT_ERROR)


@contextmanager
def _remedies(sensors: Path | None) -> Iterator[None]:
    """Names the command's options in remedies that name arguments of the library."""
    try:
        yield
    except InputError as error:
        raise InputError(_with_options(sensors, error)) from error


def _with_options(sensors: Path | None, error: InputError) -> str:
    """The words of an error with the command's options in place of the library's arguments."""
    file = str(sensors) if sensors else "a TOML file given with --sensors"
    options = {
        "description": f", its table in {file}",
        "start": ": --start, or file = { start = … } in its description",
    }
    more = next((options[argument.name] for argument in error.words.arguments if argument.name in options), "")
    return in_options(error.words, sensor_option) + more

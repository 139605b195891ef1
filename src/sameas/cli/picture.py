"""``sameas picture``: one picture of the situation from the files of many sensors."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Any

import typer

from sameas.cli.arguments import Debug, Quiet
from sameas.cli.options import one_of, sensor_option
from sameas.cli.outcome import answering

_TIMES, _METHOD, _FILES = "The instants", "The method", "Outputs"
TABLES = ("parquet", "csv")
_SECONDS = {"": 1.0, "s": 1.0, "sec": 1.0, "min": 60.0, "m": 60.0, "h": 3600.0}


def _option(*names: str, panel: str | None = None, **settings: Any) -> Any:
    return typer.Option(*names, rich_help_panel=panel, show_default=settings.pop("show_default", False), **settings)


def duration_s(text: str | None) -> float | None:
    """Seconds of "10s", "2min", "0.5h" or a plain number of seconds."""
    if text is None:
        return None
    found = re.fullmatch(r"\s*([0-9]*\.?[0-9]+)\s*([a-z]*)\s*", text.lower())
    if found is None or found[2] not in _SECONDS or float(found[1]) <= 0.0:
        raise typer.BadParameter(f"{text!r} is no duration; give 10s, 2min or 1h", param_hint="--every")
    return float(found[1]) * _SECONDS[found[2]]


Files = Annotated[
    list[str] | None,
    typer.Argument(
        metavar="FILE...",
        show_default=False,
        help="What the sensors wrote: CSV, Parquet, JSON lines, AIS and ARPA NMEA, aircraft.json, SBS, Mode S, "
        "ASTERIX. NAME=FILE names the source.",
    ),
]
Sensors = Annotated[
    Path | None,
    _option(
        "--sensors",
        "-s",
        metavar="TOML",
        help="What is known of the sensors: place, coverage, errors, misses, biases; and their files.",
    ),
]
Folder = Annotated[Path, _option("-o", "--output", metavar="FOLDER", show_default=True, help="Where the outputs go.")]
Every = Annotated[
    str | None, _option("--every", panel=_TIMES, metavar="10s", help="Time between instants; 10s, 2min, 1h.")
]
At = Annotated[str | None, _option("--at", panel=_TIMES, metavar="TIME", help="One instant only.")]
Begin = Annotated[str | None, _option("--from", panel=_TIMES, metavar="TIME", help="The first instant.")]
End = Annotated[str | None, _option("--to", panel=_TIMES, metavar="TIME", help="The last instant.")]
Start = Annotated[
    str | None,
    _option("--start", panel=_TIMES, metavar="TIME", help="UTC of the first line of files that tell no date."),
]
NoRegistration = Annotated[
    bool, _option("--no-registration", panel=_METHOD, help="Take the sensors' offsets as zero, or as described.")
]
NoIdentity = Annotated[
    bool, _option("--no-identity", panel=_METHOD, help="Leave MMSI, ICAO address, callsign … out of the evidence.")
]
NoMemory = Annotated[
    bool, _option("--no-memory", panel=_METHOD, help="Judge every instant alone, without what the tracks did before.")
]
TableFormat = Annotated[
    str, _option("--format", panel=_FILES, metavar="parquet|csv", callback=one_of(TABLES), help="Of the tables.")
]
NoMap = Annotated[bool, _option("--no-map", panel=_FILES, help="No map.html.")]
NoImage = Annotated[bool, _option("--no-image", panel=_FILES, help="No picture.png.")]


def picture(
    ctx: typer.Context,
    files: Files = None,
    sensors: Sensors = None,
    output: Folder = Path("picture"),
    every: Every = None,
    at: At = None,
    begin: Begin = None,
    end: End = None,
    start: Start = None,
    no_registration: NoRegistration = False,
    no_identity: NoIdentity = False,
    no_memory: NoMemory = False,
    format: TableFormat = "parquet",
    no_map: NoMap = False,
    no_image: NoImage = False,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """One picture from many sensors: which record of each source is which ship or aircraft, and how sure that is.

    Writes tables of identities and objects, GeoJSON, a map to open in a browser and a picture for a report.
    Everything assumed and estimated is printed.
    """
    if not files and sensors is None:
        raise typer.BadParameter("say what to read: the sensors' files, or --sensors with a TOML that names them")
    if at is not None and (every or begin or end):
        raise typer.BadParameter("say --at, or --every with --from and --to, not both", param_hint="--at")
    with answering(debug, sensor_option):
        from sameas.cli.picture_files import Outputs
        from sameas.cli.picturing import Instants, Method, run

        instants = Instants(duration_s(every), at, begin, end)
        method = Method(registration=not no_registration, identity=not no_identity, memory=not no_memory)
        outputs = Outputs(output, format, map=not no_map, image=not no_image, command=ctx.meta.get("typed", ""))
        run(files or [], sensors, start, instants, method, outputs, quiet)

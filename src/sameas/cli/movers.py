"""``sameas movers``: find moving objects among the detections of several exposures."""

from __future__ import annotations

import time as clock
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sameas.cli.options import (
    Debug,
    OutFormat,
    Overwrite,
    Quiet,
    frame_option,
    in_options,
    mover_option,
    option,
    with_columns,
)
from sameas.cli.outcome import answering
from sameas.errors import InputError
from sameas.front.options import SIDE_OPTIONS, fields_of

if TYPE_CHECKING:
    from sameas.cli.outputs import Outputs
    from sameas.front.framing import FrameRequest
    from sameas.front.movers import MoverOptions
    from sameas.sky.movers.detections import DetectionColumns

_COLUMNS = "Columns of the tables"
_FRAMES = "A series of frames"


@with_columns({"": _COLUMNS}, SIDE_OPTIONS)
def movers(
    ctx: typer.Context,
    files: Annotated[list[Path], typer.Argument(
        metavar="FILE…", help="Detections of one night, in tables, or the frames of a series.", show_default=False,
    )],
    output: Annotated[Path | None, option(
        "-o", "--output", metavar="OUT",
        help="Table of the detections of tracklets, one row each; of frames, a folder.",
    )] = None,
    tracklets: Annotated[
        Path | None, option("--tracklets", metavar="OUT", help="Table of the tracklets, one row each.")
    ] = None,
    least: Annotated[
        int, option("--least", metavar="N", min=2, show_default=True, help="Fewest detections of a tracklet.")
    ] = 2,
    probability: Annotated[float, option(
        "--probability", metavar="P", min=0, max=1, show_default=True, help="Lowest probability of a tracklet.",
    )] = 0.5,
    learn: Annotated[list[Path] | None, option(
        "--learn", metavar="TABLE", help="Detections of another night, to learn the rates of motion; repeatable.",
    )] = None,
    time: Annotated[
        str | None, option("--time", panel=_COLUMNS, metavar="NAME", help="Column: middle of the exposure, UTC.")
    ] = None,
    exposure: Annotated[
        str | None, option("--exposure", panel=_COLUMNS, metavar="NAME|none", help="Column: exposure.")
    ] = None,
    band: Annotated[
        str | None, option("--band", panel=_COLUMNS, metavar="NAME|none", help="Column: band of the magnitude.")
    ] = None,
    catalog: Annotated[str | None, option(
        "--catalog", "-c", panel=_FRAMES, metavar="NAME", help="Star catalogue, as of sameas frame: files are frames.",
    )] = None,
    aim: Annotated[str | None, option(
        "--aim", panel=_FRAMES, metavar="RA,DEC", help="Centre of the frames, if their headers lack it.",
    )] = None,
    scale: Annotated[str | None, option("--scale", panel=_FRAMES, metavar="LO,HI", help="Arcsec per pixel.")] = None,
    dark: Annotated[
        list[Path] | None, option("--dark", panel=_FRAMES, metavar="FILE", help="Dark frames; repeat it.")
    ] = None,
    flat: Annotated[
        list[Path] | None, option("--flat", panel=_FRAMES, metavar="FILE", help="Flat fields; repeat it.")
    ] = None,
    bias: Annotated[
        list[Path] | None, option("--bias", panel=_FRAMES, metavar="FILE", help="Biases; repeat it.")
    ] = None,
    elements: Annotated[Path | None, option(
        "--elements", metavar="FILE", help="Orbits of known objects: MPCORB.DAT, JPL's JSON, or demo.",
    )] = None,
    report: Annotated[Path | None, option(
        "--report", metavar="TOML", help="Observer and telescope (TOML): also writes the ADES and 80-column reports.",
    )] = None,
    report_probability: Annotated[float | None, option(
        "--report-probability", metavar="P", min=0, max=1,
        help="Lowest probability of a tracklet in the report; the tables contain all. [0.9]",
    )] = None,
    site: Annotated[
        str | None, option("--site", metavar="LAT,LON,M", help="Observer: degrees, east positive, metres. [header's]")
    ] = None,
    below_limit: Annotated[float | None, option(
        "--below-limit", panel=_FRAMES, metavar="RATE", min=0.0,
        help="Stack the frames along all motions to this rate, arcsec/min: finds movers too faint for one frame.",
    )] = None,
    processes: Annotated[
        int, option("--processes", "-j", panel=_FRAMES, metavar="N", min=1, show_default=True, help="Frames at a time.")
    ] = 2,
    overwrite: Overwrite = True,
    out_format: OutFormat = None,
    quiet: Quiet = False,
    debug: Debug = False,
    **columns: Any,
) -> None:  # fmt: skip
    """Find what moves: tracklets of detections, how sure each is, and each of its detections.

    With --catalog the files are the frames of a series, and -o is a folder. Without it they are tables of the
    detections of one night: stationary ones are excluded, the others are linked one to one over two exposures or more.
    """
    if output is None and tracklets is None and catalog is None:
        raise typer.BadParameter("give -o OUT, the table to write", param_hint="-o")
    folder = next((file for file in files if Path(file).is_dir()), None) if catalog is None else None
    if folder is not None:
        raise typer.BadParameter(
            f"{folder} is a folder: for a series of frames give the catalogue of the stars, too", param_hint="--catalog"
        )
    if report_probability is not None and report is None:
        raise typer.BadParameter("there is no report; give --report TOML", param_hint="--report-probability")
    if catalog is not None:
        with answering(debug, frame_option):
            from sameas.cli.frames import aim_of, scale_of
            from sameas.front.framing import FrameRequest
            from sameas.front.pointing import PointingOptions

            darks, flats, biases = (tuple(map(str, kind or ())) for kind in (dark, flat, bias))
            template = FrameRequest(
                path="", folder=str(output or Path("movers")), name="", catalogue=catalog,
                columns=fields_of(columns, 1), pointing=PointingOptions(aim_of(aim), None, scale_of(scale)),
                darks=darks, flats=flats, biases=biases, page=False, picture=False,
            )  # fmt: skip
            options = _options(max(least, 3), probability, elements, report, report_probability, site)
            run_series(tuple(map(str, files)), template, options, below_limit, processes, quiet)
        return
    with answering(debug, mover_option):
        from sameas.cli.outputs import Outputs
        from sameas.sky.movers.detections import DetectionColumns

        wanted = DetectionColumns(time, exposure, band)
        outputs = {
            name: Outputs(path, out_format, overwrite, ctx.meta["typed"])
            for name, path in (("detections", output), ("tracklets", tracklets))
            if path is not None
        }
        options = _options(least, probability, elements, report, report_probability, site)
        run_tables(tuple(map(str, files)), tuple(map(str, learn or ())), wanted, columns, options, outputs, quiet)


def _options(
    least: int, probability: float, elements: Path | None, report: Path | None, reported: float | None, site: str | None
) -> Callable[[], MoverOptions]:
    """The options of the search; the files that they name are read when it is called."""
    from sameas.front.movers import REPORTED, MoverOptions

    return partial(
        MoverOptions.read, least, probability, elements=None if elements is None else str(elements),
        header=None if report is None else str(report), reported=REPORTED if reported is None else reported,
        site=_site(site),
    )  # fmt: skip


def _site(text: str | None) -> tuple[float, float, float] | None:
    if text is None:
        return None
    try:
        lat, lon, height = map(float, text.split(","))
    except ValueError:
        raise typer.BadParameter(f"{text!r} is not LAT,LON,M, such as 42.61,-71.48,100", param_hint="--site") from None
    if not (abs(lat) <= 90 and abs(lon) <= 360 and abs(height) < 1e5):
        raise typer.BadParameter(f"{text!r} is not a place on the Earth", param_hint="--site")
    return lat, lon, height


def run_series(
    paths: tuple[str, ...],
    template: FrameRequest,
    read_options: Callable[[], MoverOptions],
    below_limit: float | None,
    processes: int,
    quiet: bool,
) -> None:
    """Identify the frames, search the series, print, write. template : request of a frame, without path and name."""
    from sameas.cli.frames import expanded, identified, names_of, print_outcome, run_all
    from sameas.cli.terminal import Printer, share_compilation
    from sameas.front.movers import series_movers
    from sameas.io.ades import REPORTS
    from sameas.report.frame import frames_lines
    from sameas.report.movers import report_lines

    began, printer = clock.perf_counter(), Printer(quiet)
    options = read_options()
    share_compilation(quiet, "frame")
    frames = expanded(paths, (*template.darks, *template.flats, *template.biases))
    requests = [replace(template, path=path, name=name) for path, name in zip(frames, names_of(frames), strict=True)]
    tell = partial(print_outcome, printer=printer)
    done, failed = identified(run_all(requests, processes=processes, again=False, quiet=quiet, tell=tell))
    printer(frames_lines([one.summary for one in done]))
    movers = series_movers(done, options, failed=failed, below_limit=below_limit, say=printer)
    written = movers.write(Path(template.folder), _title(paths), template.catalogue)
    if options.observer is not None:
        reports = ", ".join(f"report.{end}" for end in REPORTS)
        lines = report_lines(movers.found, options.reported, "--report-probability", options.observer.doubts)
        printer(["", f"Report: {reports}", *lines])
    printer(["", f"Output: {template.folder}/: {', '.join(written)}", f"Time: {clock.perf_counter() - began:.1f} s"])


def _title(paths: tuple[str, ...]) -> str:
    """Name of a series: the folder of its first frame."""
    first = Path(paths[0]).resolve()
    return (first if first.is_dir() else first.parent).name


def run_tables(
    paths: tuple[str, ...],
    others: tuple[str, ...],
    wanted: DetectionColumns,
    columns: dict[str, Any],
    read_options: Callable[[], MoverOptions],
    outputs: dict[str, Outputs],
    quiet: bool,
) -> None:
    """Read the detections, search, print, write. others : tables of other nights."""
    from sameas.cli.terminal import Pace, Printer, share_compilation
    from sameas.front.movers import night_movers, read_night
    from sameas.report.movers import report_lines

    began, printer = clock.perf_counter(), Printer(quiet)
    options, inputs = read_options(), (*paths, *others)
    output = next(iter(outputs.values()))
    reports = [] if options.observer is None else _reports(output.path, inputs, output.overwrite)
    for one in outputs.values():
        one.check(inputs)
    with Pace(quiet) as pace:

        def say(lines: Iterable[str]) -> None:
            pace.pause()
            printer(in_options(line, mover_option) for line in lines)

        night = read_night(paths, others, wanted, columns=columns, progress=pace, say=say)
        share_compilation(quiet, "frame")
        movers = night_movers(night, options, progress=pace, say=say)
        facts, tables = movers.facts(), movers.tables()
        written = [one.write(tables[name], {**facts, "command": one.command}, name) for name, one in outputs.items()]
        if options.observer is not None:
            movers.write_reports(reports)
            written += [f"Report: {place}" for place in reports]
            written += report_lines(movers.found, options.reported, "--report-probability", options.observer.doubts)
    printer([*written, f"Time: {clock.perf_counter() - began:.1f} s"])


def _reports(output: Path, inputs: tuple[str, ...], overwrite: bool) -> list[Path]:
    """Paths of the reports next to the output: PSV, XML and MPC 80-column."""
    from sameas.io.ades import REPORTS
    from sameas.io.atomic import is_input

    stem = output.name.split(".")[0]
    paths = [output.with_name(f"{stem}.{end}") for end in REPORTS]
    for path in paths:
        if is_input(path, inputs):
            raise InputError(f"{path}: is also an input; the report would overwrite it; give -o another name")
        if path.exists() and not overwrite:
            raise InputError(f"{path}: is there already; give -o another name, or leave --no-overwrite out")
    return paths

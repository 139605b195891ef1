"""``sameas movers``: find moving objects among the detections of several exposures."""

from __future__ import annotations

import time as clock
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from sameas.cli.options import (
    Debug,
    Overwrite,
    Quiet,
    frame_option,
    known_format,
    option,
    option_of,
    with_columns,
)
from sameas.cli.outcome import answering
from sameas.errors import InputError
from sameas.front.options import SIDE_OPTIONS

_COLUMNS = "Columns of the tables"
_FRAMES = "A series of frames"
#: A report holds tracklets of at least this probability: of ten that are as probable as this, nine are real.
REPORTED = 0.9


@with_columns({"": _COLUMNS}, SIDE_OPTIONS)
def movers(
    ctx: typer.Context,
    files: Annotated[
        list[Path],
        typer.Argument(
            metavar="FILE…", help="Detections of one night, in tables, or the frames of a series.", show_default=False
        ),
    ],
    output: Annotated[
        Path | None,
        option(
            "-o",
            "--output",
            metavar="OUT",
            help="Table of the detections of tracklets, one row each; of frames, a folder.",
        ),
    ] = None,
    tracklets: Annotated[
        Path | None, option("--tracklets", metavar="OUT", help="Table of the tracklets, one row each.")
    ] = None,
    least: Annotated[
        int, option("--least", metavar="N", min=2, show_default=True, help="Fewest detections of a tracklet.")
    ] = 2,
    probability: Annotated[
        float,
        option("--probability", metavar="P", min=0, max=1, show_default=True, help="Lowest probability of a tracklet."),
    ] = 0.5,
    learn: Annotated[
        list[Path] | None,
        option(
            "--learn", metavar="TABLE", help="Detections of another night, to learn the rates of motion; repeatable."
        ),
    ] = None,
    time: Annotated[
        str | None, option("--time", panel=_COLUMNS, metavar="NAME", help="Column: middle of the exposure, UTC.")
    ] = None,
    exposure: Annotated[
        str | None, option("--exposure", panel=_COLUMNS, metavar="NAME|none", help="Column: which exposure.")
    ] = None,
    band: Annotated[
        str | None, option("--band", panel=_COLUMNS, metavar="NAME|none", help="Column: band of the magnitude.")
    ] = None,
    catalog: Annotated[
        str | None,
        option(
            "--catalog", "-c", panel=_FRAMES, metavar="NAME", help="Of stars, as of sameas frame: the files are frames."
        ),
    ] = None,
    aim: Annotated[
        str | None,
        option("--aim", panel=_FRAMES, metavar="RA,DEC", help="Centre of the frames, if their headers lack it."),
    ] = None,
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
    elements: Annotated[
        Path | None,
        option("--elements", metavar="FILE", help="Of known objects: MPCORB.DAT, JPL's JSON, or demo."),
    ] = None,
    report: Annotated[
        Path | None,
        option(
            "--report",
            metavar="TOML",
            help="Observer and telescope (TOML): also writes the ADES and 80-column reports.",
        ),
    ] = None,
    report_probability: Annotated[
        float | None,
        option(
            "--report-probability",
            metavar="P",
            min=0,
            max=1,
            help="Of a tracklet in the report, at least; the tables have those of less. [0.9]",
        ),
    ] = None,
    site: Annotated[
        str | None,
        option("--site", metavar="LAT,LON,M", help="Of the observer: degrees, east positive, metres. [header's]"),
    ] = None,
    below_limit: Annotated[
        float | None,
        option(
            "--below-limit",
            panel=_FRAMES,
            metavar="RATE",
            min=0.0,
            help="Stack the frames along all motions to this rate, arcsec/min: finds movers too faint for one frame.",
        ),
    ] = None,
    processes: Annotated[
        int, option("--processes", "-j", panel=_FRAMES, metavar="N", min=1, show_default=True, help="Frames at a time.")
    ] = 2,
    overwrite: Overwrite = True,
    out_format: Annotated[
        str | None,
        option("--out-format", metavar="NAME", callback=known_format, help="Format of OUT, as --format."),
    ] = None,
    quiet: Quiet = False,
    debug: Debug = False,
    **columns: Any,
) -> None:
    """Find what moves: tracklets of detections, how sure each is, and each of its detections.

    With --catalog the files are the frames of a series, and -o is a folder. Else give the detections of one night,
    stars taken away; all that moves over two exposures or more is linked one to one.
    """
    if output is None and tracklets is None and catalog is None:
        raise typer.BadParameter("give -o OUT, the table to write", param_hint="-o")
    if report_probability is not None and report is None:
        raise typer.BadParameter("there is no report; give --report TOML", param_hint="--report-probability")
    reported = REPORTED if report_probability is None else report_probability
    if catalog is not None:
        with answering(debug, frame_option):
            from sameas.cli import series
            from sameas.cli.frames import aim_of, scale_of
            from sameas.front.framing import PointingOptions
            from sameas.front.options import fields_of

            darks, flats, biases = (tuple(map(str, kind or ())) for kind in (dark, flat, bias))
            request = series.SeriesRequest(
                paths=tuple(map(str, files)), catalogue=catalog, columns=fields_of(columns, 1),
                folder=output or Path("movers"), pointing=PointingOptions(aim_of(aim), None, scale_of(scale)),
                darks=darks, flats=flats, biases=biases, least=max(least, 3), probability=probability,
                elements=None if elements is None else str(elements), header=None if report is None else str(report),
                reported=reported, processes=processes, below_limit=below_limit, site=_site(site),
            )  # fmt: skip
            series.run(request, quiet)
        return
    with answering(debug, option_of):
        from sameas.cli.outputs import Outputs
        from sameas.sky.movers.detections import DetectionColumns

        wanted = DetectionColumns(time, exposure, band)
        outputs = {
            name: Outputs(path, out_format, overwrite, ctx.meta["typed"])
            for name, path in (("detections", output), ("tracklets", tracklets))
            if path is not None
        }
        known = KnownRequest(
            None if elements is None else str(elements), None if report is None else str(report), _site(site),
            overwrite, reported,
        )  # fmt: skip
        run(
            tuple(map(str, files)), tuple(map(str, learn or ())), wanted, columns, outputs, least, probability, known,
            quiet,
        )  # fmt: skip


@dataclass(frozen=True)
class KnownRequest:
    """How tracklets of tables are identified with known objects, and reported.

    elements : file of known objects, or None. header : TOML of the report, or None. site : latitude, longitude, height
    of the observer, or None. overwrite : whether reports may exist. reported : minimum probability in a report.
    """

    elements: str | None
    header: str | None
    site: tuple[float, float, float] | None
    overwrite: bool
    reported: float


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


def run(
    paths: tuple[str, ...],
    others: tuple[str, ...],
    wanted: Any,
    columns: dict[str, Any],
    outputs: dict[str, Any],
    least: int,
    probability: float,
    wanted_known: KnownRequest,
    quiet: bool,
) -> None:
    """Read the detections, search, identify known objects, print, write."""
    import numpy as np

    from sameas.cli.terminal import Pace, Printer, share_compilation
    from sameas.io.ades import REPORTS, Observer, observations
    from sameas.report.movers import (
        known_lines,
        left_out_lines,
        model_lines,
        mover_lines,
        report_lines,
        searched_lines,
    )
    from sameas.sky.movers import find_movers
    from sameas.sky.movers.detections import detections_of
    from sameas.sky.movers.known import name_movers
    from sameas.sky.movers.orbits import Elements

    began = clock.perf_counter()
    printer = Printer(quiet)
    observer = None if wanted_known.header is None else Observer.read(wanted_known.header)
    elements = None if wanted_known.elements is None else Elements.read(wanted_known.elements)
    first = next(iter(outputs.values())).path
    reports = [] if observer is None else _reports(first, (*paths, *others), wanted_known.overwrite)
    for one in outputs.values():
        one.check((*paths, *others))
    every = (*paths, *others)
    with Pace(quiet) as pace:
        read = []
        for path in every:
            pace(f"reading {path}")
            read.append(_catalogue(path, columns))
        pace.pause()
        seen, lines = detections_of(read[: len(paths)], wanted)
        printer([*lines, *searched_lines(seen), ""])
        nights = [detections_of([one], wanted)[0] for one in read[len(paths) :]]
        share_compilation(quiet)
        pace("searching")
        found = find_movers(seen, others=nights, least=least, least_probability=probability)
        pace.pause()
        printer([*left_out_lines(found), *model_lines(found), "", *mover_lines(found), ""])
        known, site = None, wanted_known.site
        if elements is not None:
            pace("predicting known objects")
            known = name_movers(found, elements, site=site)
            pace.pause()
            printer([*known_lines(found, known, site is not None), ""])
        facts = _facts(every, found)
        in_report = found.p_tracklet >= wanted_known.reported
        tables = {"detections": found.detection_table(), "tracklets": found.table()}
        if known is not None:
            known.into(tables["tracklets"], found)
        if observer is not None:
            tables["tracklets"]["in_report"] = in_report
        written = [one.write(tables[name], {**facts, "command": one.command}, name) for name, one in outputs.items()]
        if observer is not None:
            rows = observations(found, known, np.flatnonzero(in_report))
            for place, write in zip(reports, REPORTS.values(), strict=True):
                write(rows, observer, place, software=f"sameas {facts['version']}")
                written.append(f"Report: {place}")
            written += report_lines(found, wanted_known.reported)
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


def _catalogue(path: str, columns: dict[str, Any]) -> Any:
    """The catalogue of a table of detections."""
    from sameas.front.options import fields_of
    from sameas.io import read_table
    from sameas.sky.catalogue import Catalogue, CatalogueOptions

    hdu = columns.get("hdu")
    hdu = int(hdu) if hdu is not None and hdu.isdigit() else hdu
    table = read_table(path, format=columns.get("format"), hdu=hdu)
    name = Path(path).name.removesuffix(".gz").rsplit(".", 1)[0]
    return Catalogue.of(table, name, options=CatalogueOptions(**fields_of(columns, 0)))


def _facts(paths: tuple[str, ...], found: Any) -> dict[str, Any]:
    """Provenance: inputs with checksums, and the parameters of the model of movers."""
    from sameas.front.provenance import program
    from sameas.io import checksum

    facts = program()
    for k, path in enumerate(paths, 1):
        facts[f"input_{k}"], facts[f"sha256_{k}"] = str(Path(path).resolve()), checksum(path)
    model = found.model
    facts |= {"p_detect": model.p_detect, "log_odds_next": model.log_odds, "gap": found.gap}
    return facts

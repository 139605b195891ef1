"""``sameas match``: read two catalogues, identify their records, write the joined table."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sameas.cli.options import (
    FILES,
    THE_MATCH,
    Debug,
    DryRun,
    ErrorScale,
    GateSigmas,
    Output,
    Overwrite,
    Quiet,
    ToEpoch,
    in_options,
    known_format,
    one_of,
    option,
    with_columns,
)
from sameas.cli.outcome import answering
from sameas.errors import InputError
from sameas.sky.output_columns import JOINS

if TYPE_CHECKING:
    from sameas.cli.outputs import Outputs
    from sameas.cli.terminal import Pace, Printer
    from sameas.evidence import Column, Related
    from sameas.front.match import Match
    from sameas.front.request import Request
    from sameas.sky.catalogue import Catalogue
    from sameas.sky.crossmatch import MatchOptions
    from sameas.sky.sky_match import SkyMatch

#: Size of both files from which tables and cached kernels are read ahead: larger files need compiled kernels.
READ_AHEAD_BYTES = 32_000_000

_PANELS = {"": "Columns of both catalogues", "1": "First catalogue alone", "2": "Second catalogue alone"}


@with_columns(_PANELS)
def match(
    ctx: typer.Context,
    first: Annotated[Path, typer.Argument(
        metavar="A", help="First catalogue: FITS, VOTable, ECSV, CSV or Parquet.", show_default=False,
    )],
    second: Annotated[Path, typer.Argument(metavar="B", help="Second catalogue.", show_default=False)],
    output: Output = None,
    join: Annotated[str, option(
        "--join", metavar="TYPE", callback=one_of(JOINS), show_default=True,
        help=f"Rows of the output: {', '.join(JOINS)}.",
    )] = JOINS[0],
    nway_columns: Annotated[
        bool, option("--nway-columns", show_default=True, help="Add p_any, p_i and dist_bayesfactor of NWAY.")
    ] = False,
    compare_nearest: Annotated[bool, option(
        "--compare-nearest", show_default=True, help="Print a nearest-neighbour match for comparison.",
    )] = False,
    certify: Annotated[bool, option(
        "--certify", show_default=True,
        help="Prove that no other one-to-one answer is more probable, and print the proof.",
    )] = False,
    pictures: Annotated[Path | None, option(
        "--pictures", metavar="FOLDER", help="Folder for plots of residuals, errors, probabilities and magnitudes.",
    )] = None,
    blends: Annotated[float | None, option(
        "--blends", metavar="ARCSEC", help="Resolution of A: write its blends of two records of B to OUT-blends.",
    )] = None,
    dry_run: DryRun = False,
    quiet: Quiet = False,
    debug: Debug = False,
    to_epoch: ToEpoch = None,
    gate_sigmas: GateSigmas = None,
    error_scale: ErrorScale = "auto",
    density: Annotated[str | None, option(
        "--density", panel=THE_MATCH, metavar="N1,N2",
        help="Records per square degree of A and B, instead of local densities from the data.",
    )] = None,
    magnitudes: Annotated[str, option(
        "--magnitudes", panel=THE_MATCH, metavar="auto|off|A,…:B,…", show_default=True,
        help="Magnitudes as evidence: those of both catalogues, none, or columns of A and of B.",
    )] = "auto",
    precision: Annotated[bool, option(
        "--precision/--no-precision", panel=THE_MATCH, show_default=True,
        help="Use the sizes of the quoted errors as evidence if magnitudes decide too little.",
    )] = True,
    column1: Annotated[list[str] | None, option(
        "--column1", panel=THE_MATCH, metavar="NAME[=FILE]",
        help="Column of A to use as evidence; with a table of odds by value, a prior of your own. Repeatable.",
    )] = None,
    column2: Annotated[
        list[str] | None, option("--column2", panel=THE_MATCH, metavar="NAME[=FILE]", help="The same of B.")
    ] = None,
    relation: Annotated[list[str] | None, option(
        "--relation", panel=THE_MATCH, metavar="A:B",
        help="Column of A and column of B that may be related, such as two fluxes. Repeatable.",
    )] = None,
    offset: Annotated[str, option(
        "--offset", panel=THE_MATCH, metavar="none|find", callback=one_of(("none", "find")), show_default=True,
        help="Fit and remove the shift and rotation of B relative to A.",
    )] = "none",
    hdu1: Annotated[
        str | None, option("--hdu1", panel=FILES, metavar="HDU", help="Number or name of the FITS extension of A.")
    ] = None,
    hdu2: Annotated[str | None, option("--hdu2", panel=FILES, metavar="HDU", help="The same of B.")] = None,
    format1: Annotated[str | None, option(
        "--format1", panel=FILES, metavar="NAME", callback=known_format,
        help="Format of A; by default by its extension.",
    )] = None,
    format2: Annotated[str | None, option(
        "--format2", panel=FILES, metavar="NAME", callback=known_format, help="The same of B.",
    )] = None,
    out_format: Annotated[str | None, option(
        "--out-format", panel=FILES, metavar="NAME", callback=known_format, help="The same of OUT.",
    )] = None,
    overwrite: Overwrite = True,
    workers: Annotated[int | None, option(
        "--workers", panel=FILES, metavar="N", help="Processes, where A and B are HATS catalogues.",
    )] = None,
    **columns: Any,
) -> None:  # fmt: skip
    """Identify the records of two catalogues and join their tables.

    Columns, units, epochs and errors are recognised and printed; options say what cannot be known.
    """
    if output is None and not dry_run:
        raise typer.BadParameter("give -o OUT, the table to write, or --dry-run", param_hint="-o")
    with answering(debug):
        from sameas.cli.outputs import Outputs
        from sameas.front.request import Request

        columns |= {"format1": format1, "format2": format2, "hdu1": hdu1, "hdu2": hdu2}
        options = match_options(to_epoch, gate_sigmas, error_scale, density, magnitudes, offset, precision)
        options = replace(options, evidence=column_evidence(column1 or [], column2 or [], relation or []))
        from sameas.front.partitioned import both_hats

        request = Request((str(first), str(second)), options, columns)
        if both_hats(first, second):
            unsupported = {"--compare-nearest": compare_nearest, "--certify": certify, "--pictures": pictures,
                           "--out-format": out_format, "--blends": blends}  # fmt: skip
            for name, value in unsupported.items():
                if value:
                    raise InputError(f"{name}: not over the partitions of HATS catalogues", "leave it out")
            over_partitions(request, join, nway_columns, None if dry_run else output, workers, quiet)
            return
        if output is None or dry_run:
            look(request, quiet)
        else:
            joining = Joining(join, nway_columns, compare_nearest, certify, pictures, blends)
            run(request, joining, Outputs(output, out_format, overwrite, ctx.meta["typed"]), quiet)


@dataclass(frozen=True)
class Joining:
    """What the joined table contains, and which further outputs are made."""

    join: str
    nway_columns: bool
    compare_nearest: bool
    certify: bool
    pictures: Path | None
    blends: float | None


def match_options(
    to_epoch: float | None,
    gate_sigmas: float | None,
    error_scale: str,
    density: str | None,
    magnitudes: str,
    offset: str,
    precision: bool,
) -> MatchOptions:
    """The options of the match. Invalid values are refused before any file is read."""
    from sameas.sky.crossmatch import MatchOptions
    from sameas.sky.evidence_columns import AUTO, OFF

    options = MatchOptions(
        to_epoch, gate_sigmas, error_scale, magnitudes=magnitudes, offset=offset, precision=precision
    )
    if density is not None:
        try:
            one, two = (float(part) for part in density.split(","))
        except ValueError:
            raise InputError(
                f"--density {density}: give two numbers N1,N2, records per square degree of either catalogue"
            ) from None
        options = replace(options, density_per_deg2=(one, two))
    if magnitudes not in (AUTO, OFF) and magnitudes.count(":") != 1:
        raise InputError(f"--magnitudes {magnitudes}: give auto, off, or columns of both catalogues, A,…:B,…")
    options.check()
    return options


def column_evidence(of_first: list[str], of_second: list[str], related: list[str]) -> tuple[Column | Related, ...]:
    """The evidence columns, given as NAME or NAME=FILE (a table of odds) and, for related columns, as A:B."""
    from sameas.evidence import Column, Related
    from sameas.front.tables import odds_of

    evidence: list[Column | Related] = []
    for source, of_source in ((1, of_first), (2, of_second)):
        for text in of_source:
            name, given, path = text.partition("=")
            evidence.append(Column(source, name.strip(), odds_of(path.strip()) if given else None))
    for text in related:
        one, colon, other = (part.strip() for part in text.partition(":"))
        if not (one and colon and other):
            raise InputError(f"--relation {text}: give a column of A and a column of B, A:B")
        evidence.append(Related(one, other, (one, other)))
    return tuple(evidence)


def run(request: Request[MatchOptions], joining: Joining, outputs: Outputs, quiet: bool) -> None:
    """Match, print, write."""
    from sameas.io import parquet

    large = request.n_bytes >= READ_AHEAD_BYTES
    if large:
        _read_ahead(request)
    from concurrent.futures import ThreadPoolExecutor

    from sameas.cli.terminal import Pace, Printer, share_compilation
    from sameas.front.match import identified

    if joining.pictures is not None:
        from sameas.plots.sheet import required

        required()
    if joining.blends is not None:
        if not 0.0 < joining.blends < math.inf:
            raise InputError(
                f"--blends {joining.blends:g}: give the resolution of the first catalogue in arcsec, above 0"
            )
        _of_blends(outputs).check(request.paths)
    outputs.check(request.paths)
    began = time.perf_counter()
    printer = Printer(quiet)
    with Pace(quiet) as pace:
        share_compilation(quiet)
        if large:
            from sameas.cli import warmup

            warmup.read_ahead()
        catalogues = _read_both(request, printer, pace)
        if large:
            parquet.release_unused()
        match = identified(request, catalogues, progress=pace)
        match = replace(match, join=joining.join, nway_columns=joining.nway_columns)
        assert match.sky is not None
        pace("joining the tables")
        # Both the report and the table need these: compute them once, before the report's thread starts.
        _ = match.identification.chosen, match.identification.matches
        with ThreadPoolExecutor(1) as side:
            report = side.submit(_report, match, joining)
            try:
                written = _written(match, joining, outputs, pace)
            finally:
                lines = report.result()
                pace.pause()
                printer(lines)
    printer(["", *written])
    if joining.pictures is not None:
        printer([f"Pictures: {joining.pictures}/: {', '.join(drawn(match.sky, joining.pictures))}"])
    printer([f"Time: {time.perf_counter() - began:.1f} s; peak memory: {_peak_memory()}"])


def _read_ahead(request: Request[MatchOptions]) -> None:
    """Decode Parquet files and compute checksums in threads, while modules are imported."""
    from sameas.io import parquet

    for path in map(Path, request.paths):
        if path.name.lower().endswith(parquet.FORMAT.extensions):
            parquet.read_ahead(path)
    request.begin_checksums()


def _of_blends(outputs: Outputs) -> Outputs:
    """The output next to the joined table that lists the blends."""
    return replace(outputs, path=outputs.path.with_stem(f"{outputs.path.stem}-blends"))


def _written(match: Match, joining: Joining, outputs: Outputs, pace: Pace) -> list[str]:
    """Write the joined table, and the blends if wanted; returns the lines that report them."""
    from sameas.report.match import blends_lines

    table = match.joined_table()
    pace(f"writing {outputs.path}")
    facts = match.facts(outputs.command, in_options)
    written = [outputs.write(table, facts, joining.join)]
    if joining.blends is None:
        return written
    pace("blends")
    blended = match.blends(joining.blends)
    lines = [*blends_lines(blended, joining.blends), "", *written]
    return [*lines, _of_blends(outputs).write(blended, facts, "blends")]


def _report(match: Match, joining: Joining) -> list[str]:
    """The lines about the result, with the nearest-neighbour comparison and the certificate if wanted."""
    from sameas.report.match import nearest_lines

    lines = match.result_lines(in_options)
    if joining.compare_nearest:
        assert match.sky is not None
        lines += ["", *nearest_lines(match.sky)]
    if joining.certify:
        best, groups = match.identification.best, match.identification.groups
        best.certify(groups)
        lines += ["", f"Certificate: {best.certificate(groups)}"]
    return lines


def over_partitions(
    request: Request[MatchOptions], join: str, nway_columns: bool, output: Path | None, workers: int | None, quiet: bool
) -> None:
    """Match two HATS catalogues and write the result as a third; without an output print the estimates only."""
    from sameas.cli.terminal import Pace, Printer
    from sameas.front.partitioned import PartitionedMatch, refuse_existing, refuse_file_name, written_lines

    began, printer = time.perf_counter(), Printer(quiet)
    if output is not None:
        refuse_file_name(output)
        refuse_existing(output)
    with Pace(quiet) as pace:
        typed = f"sameas match {' '.join(request.paths)}"
        match = PartitionedMatch(request, join, nway_columns, typed, pace, workers)
        lines = list(match.report_lines(in_options))
        pace.pause()
        printer(lines)
        if output is not None:
            lines = written_lines(match.write(output))
    printer(["", *lines] if output is not None else ["", "Nothing was identified or written (--dry-run)."])
    printer([f"Time: {time.perf_counter() - began:.1f} s"])


def look(request: Request[MatchOptions], quiet: bool) -> None:
    """Print the chosen columns of both catalogues, their coverage and densities; write nothing (--dry-run)."""
    from sameas.cli.terminal import Pace, Printer
    from sameas.estimate.coverage import Coverage
    from sameas.report.match import coverage_lines
    from sameas.sky.completion import completed
    from sameas.sky.crossmatch import at_common_epoch
    from sameas.sky.disjoint import disjoint_doubt
    from sameas.sky.match_doubts import density_doubts

    printer = Printer(quiet)
    with Pace(quiet) as pace:
        first, second = _read_both(request, printer, pace)
        pace("motion")
        (first, second), assumed = completed((first, second), request.options.epoch_jyr)
        together = request.naming_sides(lambda: at_common_epoch(first, second, request.options.epoch_jyr))
        _, moved, one, two = together
        pace("densities")
        coverage = Coverage.of(one, two)
        doubts = (*assumed, *density_doubts(coverage, request.options.density_per_deg2))
        if coverage.common_volume == 0.0:
            doubts += disjoint_doubt(first, second, one, two)
        lines = coverage_lines(moved, coverage, doubts, in_options)
    printer([*lines, "", "Nothing was identified or written (--dry-run)."])


def _read_both(request: Request[MatchOptions], printer: Printer, pace: Pace) -> tuple[Catalogue, Catalogue]:
    """Both catalogues; the chosen columns of each are printed once it has been read."""
    from sameas.cli.outputs import catalogues
    from sameas.report.prose import DOUBT

    first, second = catalogues(request, printer, pace)
    if request.twice:
        printer([f"{DOUBT}{request.twice}", ""])
    return first, second


def drawn(match: SkyMatch, folder: Path) -> list[str]:
    """Draw all plots for which there are data; returns the names of the files."""
    from sameas import plots

    folder.mkdir(parents=True, exist_ok=True)
    names = []
    for name, figure in plots.every(match):
        plots.save(figure, folder / f"{name}.png")
        names.append(f"{name}.png")
    return names


def _peak_memory() -> str:
    try:
        import resource
    except ImportError:  # Windows
        return "not known"
    import sys

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
    return f"{peak / 1e9:.2f} GB" if peak > 1e9 else f"{peak / 1e6:.0f} MB"

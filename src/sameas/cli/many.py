"""``sameas many``: identify the records of several catalogues at once; the output has one row per object."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sameas.cli.options import (
    THE_MATCH,
    Debug,
    DryRun,
    ErrorScale,
    GateSigmas,
    OutFormat,
    Output,
    Overwrite,
    Quiet,
    in_options,
    one_of,
    option,
    with_columns,
)
from sameas.cli.outcome import answering
from sameas.errors import InputError
from sameas.front.options import MOST, SIDE_OPTIONS, refuse_numbers

if TYPE_CHECKING:
    from sameas.cli.outputs import Outputs
    from sameas.front.request import Request
    from sameas.sky.many import ManyOptions

_PANEL = "Columns and files: of all catalogues, or with a number of one (--sigma2 0.1)"
_PANELS = dict.fromkeys(["", *map(str, range(1, MOST + 1))], _PANEL)


@with_columns(_PANELS, SIDE_OPTIONS, numbered_hidden=True)
def many(
    ctx: typer.Context,
    files: Annotated[
        list[Path], typer.Argument(metavar="A B C …", help="Two catalogues or more, in any order.", show_default=False)
    ],
    output: Output = None,
    least: Annotated[int, option(
        "--least", metavar="N", min=1, max=MOST, show_default=True,
        help="Write objects that at least this many catalogues show.",
    )] = 1,
    dry_run: DryRun = False,
    quiet: Quiet = False,
    debug: Debug = False,
    to_epoch: Annotated[
        float | None, option("--to-epoch", metavar="YEAR", help="Epoch of the objects' positions in the output.")
    ] = None,
    gate_sigmas: GateSigmas = None,
    error_scale: ErrorScale = "auto",
    offset: Annotated[str, option(
        "--offset", panel=THE_MATCH, metavar="none|find", callback=one_of(("none", "find")), show_default=True,
        help="Fit and remove each catalogue's shift and rotation relative to the most precise one.",
    )] = "none",
    magnitudes: Annotated[str, option(
        "--magnitudes", panel=THE_MATCH, metavar="auto|off", callback=one_of(("auto", "off")), show_default=True,
        help="Magnitudes as evidence, or not.",
    )] = "auto",
    out_format: OutFormat = None,
    overwrite: Overwrite = True,
    **columns: Any,
) -> None:  # fmt: skip
    """Identify the records of several catalogues at once and join their tables, one row per object.

    The answer does not depend on the order of the catalogues. Options of a column speak of all catalogues, or with a
    number of one: --epoch 2016 --sigma2 0.1.
    """
    if output is None and not dry_run:
        raise typer.BadParameter("give -o OUT, the table to write, or --dry-run", param_hint="-o")
    with answering(debug):
        from sameas.cli.outputs import Outputs
        from sameas.front.request import Request
        from sameas.sky.many import ManyOptions

        options = ManyOptions(to_epoch, gate_sigmas, error_scale, offset=offset, magnitudes=magnitudes)
        options.of_two().check()
        request = Request(tuple(map(str, files)), options, columns)
        _check(request, least)
        wanted = None if dry_run or output is None else Outputs(output, out_format, overwrite, ctx.meta["typed"])
        run(request, wanted, least, quiet)


def _check(request: Request[ManyOptions], least: int) -> None:
    """Refuse invalid numbers of catalogues before any file is read."""
    n = len(request.paths)
    refuse_numbers(n)
    if least > n:
        raise InputError(f"--least {least}: there are {n} catalogues; give 1 to {n}")
    for name, value in request.columns.items():
        number = int(name[-1]) if name[-1].isdigit() else 0
        if value is not None and number > n:
            raise InputError(f"--{name.replace('_', '-')}: there is no catalogue {number}; {n} files are given")


def run(request: Request[ManyOptions], outputs: Outputs | None, least: int, quiet: bool) -> None:
    """Read the catalogues, identify, print, write; without ``outputs`` only read."""
    from sameas.cli.outputs import catalogues as read_catalogues
    from sameas.cli.terminal import Pace, Printer, share_compilation
    from sameas.front.many import MatchMany, identified

    began = time.perf_counter()
    printer = Printer(quiet)
    if outputs is not None:
        outputs.check(request.paths)
    with Pace(quiet) as pace:
        catalogues = read_catalogues(request, printer, pace)
        if outputs is None:
            printer(["Nothing was identified or written (--dry-run)."])
            return
        share_compilation(quiet)
        match = MatchMany(identified(request, catalogues, progress=pace), request, least)
        pace.pause()
        printer(match.result_lines(in_options))
        pace("joining the tables")
        table = match.table
        pace(f"writing {outputs.path}")
        rows = f"objects of {least} or more catalogues"
        written = outputs.write(table, match.facts(outputs.command, in_options), rows)
    printer(["", written, f"Time: {time.perf_counter() - began:.1f} s"])

"""``sameas internal``: which rows of one table are the same object; the output has the rows, or one row per object."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated, Any

import typer

from sameas.cli.options import (
    THE_MATCH,
    Debug,
    DryRun,
    ErrorScale,
    OutFormat,
    Output,
    Overwrite,
    Quiet,
    in_options,
    option,
    with_columns,
)
from sameas.cli.outcome import answering
from sameas.front.options import SIDE_OPTIONS


@with_columns({"": "Columns and file"}, SIDE_OPTIONS)
def internal(
    ctx: typer.Context,
    file: Annotated[Path, typer.Argument(metavar="A", help="The table.", show_default=False)],
    output: Output = None,
    objects: Annotated[bool, option(
        "--objects", help="Write one row for each object, with the mean place of its rows.",
    )] = False,
    dry_run: DryRun = False,
    quiet: Quiet = False,
    debug: Debug = False,
    exposure: Annotated[str | None, option(
        "--exposure", panel=THE_MATCH, metavar="NAME",
        help="Column that numbers the exposures, images or visits; each shows an object once.",
    )] = None,
    error_scale: ErrorScale = "auto",
    out_format: OutFormat = None,
    overwrite: Overwrite = True,
    **columns: Any,
) -> None:  # fmt: skip
    """Find which rows of one table are the same object: detections on many exposures, duplicates.

    The output has the rows of the table with the object of each, or with --objects one row for each object, which
    `sameas match` reads as a catalogue.
    """
    if output is None and not dry_run:
        raise typer.BadParameter("give -o OUT, the table to write, or --dry-run", param_hint="-o")
    with answering(debug):
        from sameas.cli.outputs import Outputs
        from sameas.cli.outputs import catalogues as read_catalogues
        from sameas.cli.terminal import Pace, Printer, share_compilation
        from sameas.front.internal import MatchInternal, gathered
        from sameas.front.request import Request
        from sameas.sky.internal import InternalOptions

        began = time.perf_counter()
        options = InternalOptions(error_scale, exposure)
        options.check()
        request = Request((str(file),), options, columns)
        outputs = None if dry_run or output is None else Outputs(output, out_format, overwrite, ctx.meta["typed"])
        printer = Printer(quiet)
        if outputs is not None:
            outputs.check(request.paths)
        with Pace(quiet) as pace:
            (catalogue,) = read_catalogues(request, printer, pace)
            if outputs is None:
                printer(["Nothing was gathered or written (--dry-run)."])
                return
            share_compilation(quiet)
            match = MatchInternal(gathered(request, catalogue, progress=pace), request)
            pace.pause()
            printer(match.result_lines(in_options))
            pace(f"writing {outputs.path}")
            table = match.objects if objects else match.table
            written = outputs.write(table, match.facts(outputs.command, in_options), "objects" if objects else "rows")
        printer(["", written, f"Time: {time.perf_counter() - began:.1f} s"])

"""The commands and their options; what they do is imported when they run."""

from __future__ import annotations

import shlex
from typing import Annotated, Any

import typer
from typer.core import TyperCommand

import sameas
from sameas.cli.arguments import (
    Certify,
    CompareNearest,
    Debug,
    Density,
    DryRun,
    ErrorScale,
    First,
    Format,
    Format1,
    Format2,
    GateSigmas,
    Hdu1,
    Hdu2,
    Join,
    Made,
    MagnitudeEvidence,
    Nway,
    Offset,
    OutFormat,
    Output,
    Overwrite,
    Pictures,
    PrecisionEvidence,
    Quiet,
    Record,
    Second,
    Source,
    ToEpoch,
)  # fmt: skip
from sameas.cli.frame import frame
from sameas.cli.many import many
from sameas.cli.options import ellipses_split, fields_of, with_columns
from sameas.cli.outcome import answering
from sameas.cli.picture import picture

app = typer.Typer(
    name="sameas",
    help="Which records of two catalogues are the same object, and how sure that is.",
    epilog="Start with: sameas match A.fits B.fits -o OUT.fits",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


class _Recorded(TyperCommand):
    """A command that keeps its arguments as they were typed, for the output's provenance."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        ctx.meta["typed"] = shlex.join(["sameas", str(self.name), *args])
        return super().parse_args(ctx, ellipses_split(args))


def _tell_version(asked: bool) -> None:
    if asked:
        typer.echo(f"sameas {sameas.__version__}")
        raise typer.Exit


Version = Annotated[bool, typer.Option("--version", callback=_tell_version, is_eager=True, help="Print it.")]


@app.callback()
def _sameas(
    version: Version = False,
) -> None:
    pass


@app.command("match", cls=_Recorded, no_args_is_help=True)
@with_columns
def match(
    ctx: typer.Context,
    first: First,
    second: Second,
    output: Output = None,
    join: Join = "all1",
    nway_columns: Nway = False,
    compare_nearest: CompareNearest = False,
    certify: Certify = False,
    pictures: Pictures = None,
    dry_run: DryRun = False,
    quiet: Quiet = False,
    debug: Debug = False,
    to_epoch: ToEpoch = None,
    gate_sigmas: GateSigmas = None,
    error_scale: ErrorScale = "auto",
    density: Density = None,
    magnitudes: MagnitudeEvidence = "auto",
    precision: PrecisionEvidence = True,
    offset: Offset = "none",
    hdu1: Hdu1 = None,
    hdu2: Hdu2 = None,
    format1: Format1 = None,
    format2: Format2 = None,
    out_format: OutFormat = None,
    overwrite: Overwrite = True,
    **columns: Any,
) -> None:
    """Identify the records of two catalogues and join their tables.

    Columns, units, epochs and errors are recognised and printed; options say what cannot be known.
    """
    if output is None and not dry_run:
        raise typer.BadParameter("say -o OUT, the table to write (or --dry-run)", param_hint="-o")
    with answering(debug):
        from sameas.cli.matching import Wanted, run
        from sameas.cli.request import Request, match_options

        options = match_options(to_epoch, gate_sigmas, error_scale, density, magnitudes, offset, precision)
        fields = fields_of(columns, 1), fields_of(columns, 2)
        paths = str(first), str(second)
        request = Request(paths, (format1, format2), (hdu1, hdu2), fields, options, columns)
        command = ctx.meta["typed"]
        wanted = None
        if output:
            told = join, nway_columns, compare_nearest, certify, pictures
            wanted = Wanted(output, out_format, overwrite, *told, command)
        run(request, None if dry_run else wanted, quiet)


@app.command("explain", no_args_is_help=True)
def explain(
    output: Made,
    record: Record,
    source: Source = 1,
    format: Format = None,
    debug: Debug = False,
) -> None:
    """Why a record was identified as it was: its competitors, and what other answers would cost.

    The match is repeated with what OUT says of it; the catalogues must still be where they were.
    """
    with answering(debug):
        from sameas.cli.explain import run

        run(output, record, source, format)


app.command("many", cls=_Recorded, no_args_is_help=True)(many)
app.command("frame", no_args_is_help=True)(frame)

app.command("picture", cls=_Recorded, no_args_is_help=True)(picture)


@app.command("formats")
def formats() -> None:
    """The file formats that are read and written, with their extensions."""
    from sameas.io import known_formats

    for name, extensions in known_formats().items():
        typer.echo(f"{name:8}  {' '.join(extensions)}")

"""``sameas many``: several catalogues identified at once, one row per object."""

from __future__ import annotations

import inspect
import json
import os
import platform
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from sameas.cli.arguments import FORMATS, Debug, DryRun, ErrorScale, GateSigmas, Output, Overwrite, Quiet
from sameas.cli.options import COLUMN_OPTIONS, FILE_OPTIONS, ColumnOption, fields_of, in_options, one_of, option_of
from sameas.cli.outcome import answering

#: Catalogues that options can speak of; ``sameas.sky.many`` takes no more.
MOST = 8
_PANEL = "Columns and files: of all catalogues, or with a number of one (--sigma2 0.1)"

Files = Annotated[
    list[Path], typer.Argument(metavar="A B C …", help="Two catalogues or more, in any order.", show_default=False)
]
Least = Annotated[
    int, typer.Option("--least", metavar="N", min=1, max=MOST, help="Rows: objects of at least so many catalogues.")
]
OutFormat = Annotated[
    str | None,
    typer.Option("--out-format", metavar="NAME", callback=one_of(FORMATS), help="Format of OUT, as --format."),
]
Epoch = Annotated[
    float | None, typer.Option("--to-epoch", metavar="YEAR", help="Epoch of the objects' places in the output.")
]


def with_numbered_columns(command: Callable[..., None]) -> Callable[..., None]:
    """The command, its ``**columns`` spelled out as options of all catalogues and of each, for typer to read."""
    written = inspect.signature(command, eval_str=True)
    kept = [p for p in written.parameters.values() if p.kind is not inspect.Parameter.VAR_KEYWORD]
    sides = ["", *map(str, range(1, MOST + 1))]
    spelled = [_parameter(option, side) for side in sides for option in (*COLUMN_OPTIONS, *FILE_OPTIONS)]
    command.__signature__ = written.replace(parameters=[*kept, *spelled])  # type: ignore[attr-defined]
    command.__annotations__ = {p.name: p.annotation for p in (*kept, *spelled)}
    return command


def _parameter(option: ColumnOption, side: str) -> inspect.Parameter:
    said = typer.Option(
        f"--{option.name}{side}", metavar=option.metavar, help=option.help, rich_help_panel=_PANEL,
        show_default=False, hidden=bool(side),
    )  # fmt: skip
    name, kind = option.parameter + side, inspect.Parameter.KEYWORD_ONLY
    return inspect.Parameter(name, kind, default=None, annotation=Annotated[option.kind | None, said])


@with_numbered_columns
def many(
    ctx: typer.Context,
    files: Files,
    output: Output = None,
    least: Least = 1,
    dry_run: DryRun = False,
    quiet: Quiet = False,
    debug: Debug = False,
    to_epoch: Epoch = None,
    gate_sigmas: GateSigmas = None,
    error_scale: ErrorScale = "auto",
    out_format: OutFormat = None,
    overwrite: Overwrite = True,
    **columns: Any,
) -> None:
    """Identify the records of several catalogues at once and join their tables, one row per object.

    The answer does not depend on the order of the catalogues. Options of a column speak of all catalogues, or with a
    number of one: --epoch 2016 --sigma2 0.1.
    """
    if output is None and not dry_run:
        raise typer.BadParameter("say -o OUT, the table to write (or --dry-run)", param_hint="-o")
    with answering(debug):
        from sameas.sky.many import ManyOptions

        options = ManyOptions(to_epoch, gate_sigmas, error_scale)
        for check in (options.of_two().errors, options.of_two().gate):
            check()
        request = ManyRequest(tuple(map(str, files)), columns, options)
        request.check(least)
        wanted = None if dry_run or output is None else Wanted(output, out_format, overwrite, least, ctx.meta["typed"])
        run(request, wanted, quiet)


@dataclass(frozen=True)
class Wanted:
    """The output that the user wants."""

    path: Path
    format: str | None
    overwrite: bool
    least: int
    command: str


@dataclass(frozen=True)
class ManyRequest:
    """Files, and what is said of their columns: options as they were typed, with the number of the catalogue."""

    paths: tuple[str, ...]
    columns: Mapping[str, Any]
    options: Any

    @property
    def names(self) -> tuple[str, ...]:
        """The catalogues' names in messages: their files' stems, or more where these are not different."""
        stems = tuple(Path(path).name.removesuffix(".gz").rsplit(".", 1)[0] for path in self.paths)
        files = tuple(Path(path).name for path in self.paths)
        for names in (stems, files, self.paths):
            if len(set(names)) == len(names):
                return names
        return tuple(f"{stem} ({k})" for k, stem in enumerate(stems, 1))

    def check(self, least: int) -> None:
        """Refuses what no reading of the files is needed for."""
        from sameas.errors import InputError

        if not 2 <= len(self.paths) <= MOST:
            raise InputError(f"{len(self.paths)} catalogue given; give two to {MOST} files")
        if least > len(self.paths):
            raise InputError(f"--least {least}: there are {len(self.paths)} catalogues; give 1 to {len(self.paths)}")
        for name, value in self.columns.items():
            number = int(name[-1]) if name[-1].isdigit() else 0
            if value is not None and number > len(self.paths):
                option = f"--{name.replace('_', '-')}"
                raise InputError(f"{option}: there is no catalogue {number}; {len(self.paths)} files are given")

    def catalogue(self, side: int) -> Any:
        """Catalogue 1, 2, …, read and understood."""
        from sameas.errors import InputError
        from sameas.io import read_table
        from sameas.sky.catalogue import Catalogue, CatalogueOptions

        try:
            table = read_table(self.paths[side - 1], format=self.said("format", side), hdu=self._hdu(side))
            options = CatalogueOptions(**fields_of(self.columns, side))
            return Catalogue.of(table, self.names[side - 1], options=options)
        except InputError as error:
            raise InputError(self.in_options(error.words, side)) from error

    def in_options(self, text: str, side: int) -> str:
        """A text on one catalogue, with that catalogue's own options."""
        return in_options(text, lambda argument: option_of(argument, side, self.columns))

    def said(self, name: str, side: int) -> str | None:
        """An option of one catalogue's file."""
        own = self.columns.get(f"{name}{side}")
        return self.columns.get(name) if own is None else own

    def _hdu(self, side: int) -> str | int | None:
        said = self.said("hdu", side)
        return int(said) if said is not None and said.isdigit() else said


def run(request: ManyRequest, wanted: Wanted | None, quiet: bool) -> None:
    """Read, understand, identify, say, write; without ``wanted`` only the first two."""
    from sameas.cli.terminal import Pace, Printer, tell_compilation
    from sameas.io import write_table
    from sameas.report.many import estimate_lines, summary_lines
    from sameas.report.match import catalogue_lines
    from sameas.report.prose import count
    from sameas.sky.many import joined_many, match_many

    began = time.perf_counter()
    printer = Printer(quiet)
    if wanted is not None:
        _refuse_inputs(request, wanted)
    with Pace(quiet) as pace:
        catalogues = []
        for side, path in enumerate(request.paths, 1):
            pace(f"reading {path}")
            catalogues.append(request.catalogue(side))
            pace.pause()
            printer([*catalogue_lines(catalogues[-1], side, path, partial(request.in_options, side=side)), ""])
        if wanted is None:
            pace.pause()
            printer(["Nothing was identified or written (--dry-run)."])
            return
        if not quiet:
            tell_compilation()
        match = match_many(catalogues, request.options, progress=pace)
        pace.pause()
        printer([*estimate_lines(match, in_options), "", *summary_lines(match)])
        pace("joining the tables")
        table = joined_many(match, least=wanted.least)
        pace(f"writing {wanted.path}")
        facts = provenance(request, match, wanted.command)
        write_table(table, wanted.path, provenance=facts, format=wanted.format, overwrite=wanted.overwrite)
    size = f"{count(len(table))} rows, {len(table.columns)} columns (objects of {wanted.least} or more catalogues)"
    printer(["", f"Output: {wanted.path}, {size}", f"Time: {time.perf_counter() - began:.1f} s"])


def _refuse_inputs(request: ManyRequest, wanted: Wanted) -> None:
    """Refuses an output that would destroy an input or that has no format, before any work is done."""
    from sameas.errors import InputError
    from sameas.io import known_formats

    for path in request.paths:
        if os.path.realpath(path) == os.path.realpath(wanted.path):
            raise InputError(f"{wanted.path}: is also an input; it would be overwritten; give -o another name")
    known = tuple(extension for extensions in known_formats().values() for extension in extensions)
    if wanted.format is None and not wanted.path.name.lower().endswith(known):
        raise InputError(
            f"{wanted.path}: its extension does not tell a format; see `sameas formats`, or say --out-format NAME"
        )


def provenance(request: ManyRequest, match: Any, command: str) -> dict[str, Any]:
    """How an output was made, a flat mapping of plain values."""
    import sameas
    from sameas.io import checksum

    facts: dict[str, Any] = {
        "program": "sameas",
        "version": sameas.__version__,
        "command": command,
        "date_utc": datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ"),
        "python": platform.python_version(),
    }
    for k, (path, catalogue) in enumerate(zip(request.paths, match.catalogues, strict=True), 1):
        facts[f"input_{k}"] = str(Path(path).resolve())
        facts[f"sha256_{k}"] = checksum(Path(path))
        facts[f"name_{k}"], facts[f"rows_{k}"] = catalogue.name, len(catalogue)
        facts[f"epoch_{k}"] = catalogue.epoch_jyr
        facts[f"options_{k}"] = json.dumps(fields_of(request.columns, k), sort_keys=True)
    facts |= {"options_match": json.dumps(asdict(request.options), sort_keys=True), "epoch_object": match.epoch_jyr}
    for names, expected in match.expected.items():
        facts[f"expected_{'_'.join(names)}"] = expected
    return facts | {
        "objects": len(match.objects),
        "rounds": match.rounds,
        "doubts": [in_options(doubt) for doubt in match.doubts],
    }

"""``sameas match``: read, understand, identify, say, write."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from sameas.cli.options import in_options
from sameas.cli.provenance import provenance
from sameas.cli.request import Request
from sameas.cli.terminal import Pace, Printer, tell_compilation
from sameas.errors import InputError
from sameas.estimate.coverage import Coverage
from sameas.io import known_formats, replacing, write_table
from sameas.report.match import catalogue_lines, coverage_lines, estimate_lines, nearest_lines, summary_lines
from sameas.report.prose import DOUBT, count
from sameas.sky.catalogue import Catalogue
from sameas.sky.crossmatch import SkyMatch, brought_together, density_doubts
from sameas.sky.joins import joined


@dataclass(frozen=True)
class Wanted:
    """The output that the user wants."""

    path: Path
    format: str | None
    overwrite: bool
    join: str
    nway_columns: bool
    compare_nearest: bool
    certify: bool
    pictures: Path | None
    command: str

    def fulfil(self, request: Request, quiet: bool) -> None:
        """Match, print, write."""
        began = time.perf_counter()
        printer = Printer(quiet)
        with Pace(quiet) as pace:
            first, second = _understood(request, printer, pace)
            if not quiet:
                tell_compilation()
            match = request.match(first, second, pace)
            pace("report")
            lines = [*estimate_lines(match, in_options), "", *summary_lines(match)]
            if self.compare_nearest:
                lines += ["", *nearest_lines(match)]
            if self.certify:
                match.result.best.certify(match.result.groups)
                lines += ["", f"Certificate: {match.result.best.certificate(match.result.groups)}"]
            pace.pause()
            printer(lines)
            pace("joining the tables")
            table = joined(match, self.join, nway_columns=self.nway_columns)
            pace(f"writing {self.path}")
            facts = provenance(request, match, self.command)
            write_table(table, self.path, provenance=facts, format=self.format, overwrite=self.overwrite)
        size = f"{count(len(table))} rows, {len(table.columns)} columns ({self.join})"
        printer(["", f"Output: {self.path}, {size}"])
        if self.pictures is not None:
            printer([f"Pictures: {self.pictures}/: {', '.join(drawn(match, self.pictures))}"])
        printer([f"Time: {time.perf_counter() - began:.1f} s; peak memory: {_peak_memory()}"])


def run(request: Request, wanted: Wanted | None, quiet: bool) -> None:
    """Match and write what is wanted; without it only look."""
    if wanted is None:
        look(request, quiet)
    else:
        check(request, wanted)
        wanted.fulfil(request, quiet)


def check(request: Request, wanted: Wanted) -> None:
    """Refuses an output that could not be written or would destroy an input, before any work is done."""
    out = wanted.path
    for path in request.paths:
        same = Path(path).exists() and out.exists() and os.path.samefile(path, out)
        if same or os.path.realpath(path) == os.path.realpath(out):
            raise InputError(f"{out}: is also an input; it would be overwritten; give -o another name")
    if wanted.pictures is not None:
        from sameas.plots.sheet import required

        required()
    known = tuple(extension for extensions in known_formats().values() for extension in extensions)
    if wanted.format is None and not out.name.lower().endswith(known):
        raise InputError(f"{out}: its extension does not tell a format; see `sameas formats`, or say --out-format NAME")
    for path in request.paths:
        if not Path(path).exists():
            return  # reading it will say so, which is more important
    # Opens the temporary file beside the output and throws it away: no directory, no permission.
    with suppress(_Rehearsed), replacing(out, overwrite=wanted.overwrite):
        raise _Rehearsed


class _Rehearsed(Exception):
    """The output could be opened."""


def drawn(match: SkyMatch, folder: Path) -> list[str]:
    """Draws every picture that there is something to draw for; the names of the files."""
    from sameas import plots

    folder.mkdir(parents=True, exist_ok=True)
    names = []
    for name, figure in plots.every(match):
        plots.save(figure, folder / f"{name}.png")
        names.append(f"{name}.png")
    return names


def look(request: Request, quiet: bool) -> None:
    """Print what is understood of both catalogues, where they look and how densely; write nothing."""
    printer = Printer(quiet)
    with Pace(quiet) as pace:
        first, second = _understood(request, printer, pace)
        pace("motion")
        together = request.saying_sides(lambda: brought_together(first, second, request.options.epoch_jyr))
        _, moved, one, two = together
        pace("densities")
        coverage = Coverage.of(one, two)
        lines = coverage_lines(moved, coverage, density_doubts(coverage, request.options))
    printer([*lines, "", "Nothing was identified or written (--dry-run)."])


def _understood(request: Request, printer: Printer, pace: Pace) -> tuple[Catalogue, Catalogue]:
    """Both catalogues, printed as soon as each is understood."""
    read = []
    for side in (1, 2):
        path = request.paths[side - 1]
        pace(f"reading {path}")
        catalogue = request.catalogue(side)
        pace.pause()
        printer([*catalogue_lines(catalogue, side, path, partial(request.in_options, side=side)), ""])
        read.append(catalogue)
    printer(_same_file(request.paths))
    return read[0], read[1]


def _same_file(paths: tuple[str, str]) -> Iterator[str]:
    if os.path.samefile(*paths):
        yield f"{DOUBT}{paths[0]} is given twice: every record will be found to be itself"
        yield ""


def _peak_memory() -> str:
    try:
        import resource
    except ImportError:  # Windows
        return "not known"
    import sys

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
    return f"{peak / 1e9:.2f} GB" if peak > 1e9 else f"{peak / 1e6:.0f} MB"

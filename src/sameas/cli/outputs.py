"""Tables of a command: its catalogues, each printed as soon as it is understood, and the one that it writes."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sameas.cli.options import in_options
from sameas.cli.terminal import Pace, Printer
from sameas.errors import InputError
from sameas.front.request import Request
from sameas.io import replacing, write_table, written_formats
from sameas.io.atomic import is_input
from sameas.report.match import catalogue_lines
from sameas.representation import counted
from sameas.sky.catalogue import Catalogue

if TYPE_CHECKING:
    from astropy.table import Table

# Reading: the catalogues of a request, each printed as soon as it is understood.


def catalogues(request: Request[Any], printer: Printer, pace: Pace) -> list[Catalogue]:
    """All catalogues of a request."""

    def printed(side: int, catalogue: Catalogue) -> None:
        pace.pause()
        printer([*catalogue_lines(catalogue, side, request.paths[side - 1], partial(_in_own_terms, request, side)), ""])
        if side < len(request.paths):
            pace(f"reading {request.paths[side]}")

    pace(f"reading {request.paths[0]}")
    return request.catalogues(printed)


def _in_own_terms(request: Request[Any], side: int, text: str) -> str:
    """A text on one catalogue, with that catalogue's own options."""
    return in_options(request.words(text, side))


@dataclass(frozen=True)
class Outputs:
    """The table that the user wants. command : as it was typed."""

    path: Path
    format: str | None
    overwrite: bool
    command: str

    def check(self, inputs: Sequence[str]) -> None:
        """Refuses an output that could not be written or would destroy an input, before any work is done."""
        if is_input(self.path, inputs):
            raise InputError(f"{self.path}: is also an input; it would be overwritten; give -o another name")
        known = tuple(extension for extensions in written_formats().values() for extension in extensions)
        if self.format is None and not self.path.name.lower().endswith(known):
            raise InputError(
                f"{self.path}: its extension is not that of a format; see `sameas formats`, or give --out-format NAME"
            )
        if all(map(os.path.exists, inputs)):  # reading the others says so, which is more important
            # Opens the temporary file beside the output and throws it away: no directory, no permission.
            with suppress(_Rehearsed), replacing(self.path, overwrite=self.overwrite):
                raise _Rehearsed

    def write(self, table: Table, facts: Mapping[str, Any], rows: str) -> str:
        """Writes the table; the line that says so. rows : which ones it holds, in words."""
        write_table(table, self.path, provenance=facts, format=self.format, overwrite=self.overwrite)
        return f"Output: {self.path}, {counted(len(table), 'row')}, {len(table.columns)} columns ({rows})"


class _Rehearsed(Exception):
    """The output could be opened."""

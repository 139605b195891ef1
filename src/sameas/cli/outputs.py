"""Tables of a command: its catalogues, described on the terminal as they are read, and its output."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sameas.cli import set_malloc
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

    from sameas.io.format import LazyTable

#: Size of all files from which catalogues are read two at a time.
TWO_AT_ONCE_BYTES = 4_000_000
#: Bytes of freed memory that are kept for later arrays.
KEPT_BYTES = 1 << 26


def catalogues(request: Request[Any], printer: Printer, pace: Pace) -> list[Catalogue]:
    """All catalogues of a request; the description of each is printed once it has been read."""

    def printed(side: int, catalogue: Catalogue) -> None:
        pace.pause()
        words = partial(request.in_own_terms, in_options, side)
        which = side if len(request.paths) > 1 else 0
        printer([*catalogue_lines(catalogue, which, request.paths[side - 1], words), ""])
        if side < len(request.paths):
            pace(f"reading {request.paths[side]}")

    pace(f"reading {request.paths[0]}")
    large = request.n_bytes >= TWO_AT_ONCE_BYTES
    if large:
        keep_freed_memory()
    return request.catalogues(printed, two_at_once=large)


def keep_freed_memory(kept_bytes: int = KEPT_BYTES) -> None:
    """Let malloc keep the memory of freed arrays, up to ``kept_bytes``, for later ones.

    By default it returns that of large arrays to the system, which clears the pages of every new array: a third of the
    time of some million rows, and of a frame of 16 million pixels.
    """
    # M_MMAP_MAX, M_TRIM_THRESHOLD and M_TOP_PAD of glibc's malloc.h.
    for parameter, value in ((-4, 0), (-1, kept_bytes), (-2, kept_bytes // 4)):
        set_malloc(parameter, value)


@dataclass(frozen=True)
class Outputs:
    """Where and how the output table is written. command : as typed."""

    path: Path
    format: str | None
    overwrite: bool
    command: str

    def check(self, inputs: Sequence[str]) -> None:
        """Refuse an output that cannot be written or would overwrite an input, before any work is done."""
        if is_input(self.path, inputs):
            raise InputError(f"{self.path}: is also an input; it would be overwritten; give -o another name")
        known = tuple(extension for extensions in written_formats().values() for extension in extensions)
        if self.format is None and not self.path.name.lower().endswith(known):
            raise InputError(
                f"{self.path}: its extension is not that of a format; see `sameas formats`, or give --out-format NAME"
            )
        if all(map(os.path.exists, inputs)):  # a missing input is reported first, when it is read
            # Create and discard the temporary file: fails without the folder or the permission to write.
            with suppress(_Rehearsed), replacing(self.path, overwrite=self.overwrite):
                raise _Rehearsed

    def write(self, table: Table | LazyTable, facts: Mapping[str, Any], rows: str) -> str:
        """Write the table; returns the line that reports it. rows : the join, for that line."""
        write_table(table, self.path, provenance=facts, format=self.format, overwrite=self.overwrite)
        return f"Output: {self.path}, {counted(len(table), 'row')}, {len(table.colnames)} columns ({rows})"


class _Rehearsed(Exception):
    """Raised to discard the temporary file of a successful check."""

"""Outputs: the table that a command writes; refused at the door, and written whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sameas.errors import InputError
from sameas.front.outputs import is_input
from sameas.io import replacing, write_table, written_formats
from sameas.report.prose import count

if TYPE_CHECKING:
    from astropy.table import Table


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
                f"{self.path}: its extension does not tell a format; see `sameas formats`, or say --out-format NAME"
            )
        if all(map(os.path.exists, inputs)):  # reading the others says so, which is more important
            # Opens the temporary file beside the output and throws it away: no directory, no permission.
            with suppress(_Rehearsed), replacing(self.path, overwrite=self.overwrite):
                raise _Rehearsed

    def write(self, table: Table, facts: Mapping[str, Any], rows: str) -> str:
        """Writes the table; the line that says so. rows : which ones it holds, in words."""
        write_table(table, self.path, provenance=facts, format=self.format, overwrite=self.overwrite)
        return f"Output: {self.path}, {count(len(table))} rows, {len(table.columns)} columns ({rows})"


class _Rehearsed(Exception):
    """The output could be opened."""

"""IPAC tables, as IRSA and NED write them: names, types, units and nulls between bars; parsed by astropy."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

from sameas.io.csv import content_of
from sameas.io.format import Format

if TYPE_CHECKING:
    from astropy.table import Table

# No two parts may match the same line end: backtracking over blank lines would take exponential time.
_NAMES = re.compile(rb"\A(?:[^\S\n]*(?:\\[^\n]*)?\n)*[^\S\n]*\|[^\n]*\|[^\S\n]*\n\s*\|")


def has_bars(path: Path, first: bytes) -> bool:
    """Whether two lines between bars follow the comments, which begin with a backslash."""
    return _NAMES.match(first) is not None


FORMAT = Format(
    "ipac", "IPAC table", (".tbl", ".ipac", ".tbl.gz", ".ipac.gz"), unmarked=True, read_only=True, recognised=has_bars
)


def read(path: Path, hdu: None) -> Table:
    """The table of an IPAC file; its keywords are its metadata."""
    from astropy.io import ascii as text_tables

    text = memoryview(content_of(path)).tobytes().decode("utf-8", "replace")
    table = text_tables.read(text.splitlines(), format="ipac")
    keywords = table.meta.pop("keywords", {})
    table.meta = {key: value for key, value in table.meta.items() if value}
    table.meta.update({name: keyword["value"] for name, keyword in keywords.items()})
    return table

"""Text separated by blanks, as NumPy, IRAF and awk write it: names in the first line, or in a comment above it.

The rows are converted to tab-separated text and read as CSV, so that column types, empty cells and long identifiers are
handled alike: 300 000 rows of 8 columns take 0.7 s (astropy's fast reader, which does not do this, 0.45 s). A cell that
contains blanks is quoted; a missing one is ``nan``, ``null`` or ``--``.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

from sameas.errors import InputError
from sameas.io.csv import TableHead, content_of, distinct, is_number, table_of
from sameas.io.format import TEXT_EXTENSIONS, Format

if TYPE_CHECKING:
    import pyarrow as pa
    from astropy.table import Table

_WORD = re.compile(rb'"[^"]*"|[^\s"]+')
_DELIMITERS = b",;\t|"


def is_separated_by_blanks(path: Path, first: bytes) -> bool:
    """Whether the first two lines that are not comments have several words, and no other delimiter."""
    if not path.name.lower().endswith(TEXT_EXTENSIONS):
        return False
    lines = [line.strip() for line in first.split(b"\n")[:-1] if line.strip()] or [first.strip()]
    comments = [line.lstrip(b"#").strip() for line in lines if line.startswith(b"#")]
    cells = [line for line in lines if not line.startswith(b"#")] or comments[-1:]
    if not cells or any(sign in cell for cell in cells[:2] for sign in (b"\0", *(bytes([d]) for d in _DELIMITERS))):
        return False
    # The title of a single column may have blanks, its numbers have none.
    return len(words(cells[1] if len(cells) > 1 else cells[0])) > 1


FORMAT = Format(
    "ascii",
    "text separated by blanks",
    TEXT_EXTENSIONS,
    unmarked=True,
    read_only=True,
    recognised=is_separated_by_blanks,
)


def read(path: Path, hdu: None) -> Table:
    """The table of a text file separated by blanks."""
    text = content_of(path)
    names, row = _names(text, path)
    return rows_of(text, names, row, path)


def words(line: bytes) -> list[bytes]:
    """The cells of a line; quoted ones may contain blanks."""
    return _WORD.findall(line) if b'"' in line else line.split()


def rows_of(text: pa.Buffer, names: list[str], first_row: int, path: Path) -> Table:
    """The table of rows separated by blanks, from line ``first_row`` on, counted from 0; comments are skipped."""
    import pyarrow as pa

    rows = []
    for number, line in enumerate(memoryview(text).tobytes().split(b"\n")):
        cells = [] if number < first_row or line[:1] == b"#" else words(line)
        if cells and len(cells) != len(names):
            message = f"{path}: line {number + 1} has {len(cells)} cells, not {len(names)}"
            raise InputError(message, "put text with blanks in it in quotes, and nan where there is nothing")
        if cells:
            rows.append(b"\t".join(cells))
    return table_of(pa.py_buffer(b"\n".join(rows) + b"\n"), TableHead(distinct(names, path), "\t", 0), path)


def _names(text: pa.Buffer, path: Path) -> tuple[list[str], int]:
    """The names of the columns, and the number of lines before the first row."""
    comment: list[str] = []
    for number, raw in enumerate(memoryview(text)[: 1 << 20].tobytes().split(b"\n")):
        line = raw.decode("utf-8", "replace").strip()
        if line.startswith("#"):
            comment = _unquoted(line.lstrip("#").strip()) or comment
        elif line:
            names = _unquoted(line)
            if not any(map(is_number, names)):
                return names, number + 1
            if len(comment) == len(names) and not any(map(is_number, comment)):
                return comment, number
            raise InputError(
                f"{path}: line {number + 1} holds numbers; put the names of the columns above the first row"
            )
    if not comment:
        raise InputError(f"{path}: has no line with the names of the columns")
    return comment, number + 1


def _unquoted(line: str) -> list[str]:
    return [word.decode().strip('"') for word in words(line.encode())]

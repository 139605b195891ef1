"""Text as people type and print it, which is read only: lists of positions without names, and drawn tables.

A list has a right ascension and a declination in every line and nothing else: two numbers in degrees, two sexagesimal
words (hours and degrees), or six numbers (h m s d m s). A drawn table has bars between cells and lines of dashes, as
databases, Astropy and Markdown print them. Both are converted to CSV.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

from sameas.errors import InputError
from sameas.io.csv import TableHead, content_of, distinct, is_any_text, is_number, table_of, with_note
from sameas.io.format import TEXT_EXTENSIONS, Format

if TYPE_CHECKING:
    from astropy.table import Table

_BETWEEN = re.compile(rb"[\s,;]+")
_SEXAGESIMAL = re.compile(rb"[+-]?\d{1,3}(:\d{1,2}(:\d{1,2}(\.\d*)?)?|[hd]\d{1,2}m(\d{1,2}(\.\d*)?s)?)")
_DASHES = re.compile(rb"[+|][-+|: =]*-[-+|: =]*")


def is_list_of_positions(path: Path, first: bytes) -> bool:
    """Whether all lines are positions, and no comment names them."""
    if not is_any_text(path, first):
        return False
    lines = [line.strip() for line in first.split(b"\n")[: -1 if len(first) > 1 << 15 else None] if line.strip()]
    rows = [_BETWEEN.split(line) for line in lines if not line.startswith(b"#")]
    names = [_BETWEEN.split(line.lstrip(b"# ")) for line in lines if line.startswith(b"#")]
    named = any(len(above) == len(row) for above in names for row in rows[:1])
    return bool(rows) and not named and all(map(_position, rows))


def _position(words: list[bytes]) -> tuple[bytes, bytes] | None:
    """The right ascension and declination in the words of a line; None if they are anything else."""
    if len(words) == 6 and all(is_number(word.decode("latin-1")) for word in words):
        words = [b":".join(words[:3]), b":".join(words[3:])]
    if len(words) != 2:
        return None
    ra, dec = words
    if _SEXAGESIMAL.fullmatch(ra) and _SEXAGESIMAL.fullmatch(dec):
        return ra, dec
    numbers = [float(word) for word in words if is_number(word.decode("latin-1"))]
    possible = len(numbers) == 2 and 0.0 <= numbers[0] <= 360.0 and -90.0 <= numbers[1] <= 90.0
    return (ra, dec) if possible else None


def read_positions(path: Path) -> Table:
    """The table of a list of positions, with columns RA and DEC."""
    import pyarrow as pa

    rows = []
    for number, line in enumerate(_lines(path), start=1):
        if line.strip() and not line.startswith(b"#"):
            position = _position(_BETWEEN.split(line.strip()))
            if position is None:
                raise InputError(f"{path}: line {number} is not a right ascension and a declination like the first")
            rows.append(b"\t".join(position))
    table = table_of(pa.py_buffer(b"\n".join(rows) + b"\n"), TableHead(["RA", "DEC"], "\t", 0), path)
    return with_note(table, f"{path}: its columns have no names: they are read as right ascension and declination")


def is_drawn(path: Path, first: bytes) -> bool:
    """Whether the first or second line is one of dashes and corners, and rows begin with a bar."""
    if not is_any_text(path, first):
        return False
    lines = [line.strip() for line in first.split(b"\n") if line.strip()][:3]
    return any(_DASHES.fullmatch(line) for line in lines[:2]) and any(line.startswith(b"|") for line in lines)


def read_drawn(path: Path) -> Table:
    """The table of a drawn table, with the names of its first row."""
    import pyarrow as pa

    rows = []
    for line in _lines(path):
        if line.strip() and not _DASHES.fullmatch(line.strip()):
            rows.append(b"|".join(cell.strip() for cell in line.strip().strip(b"|").split(b"|")))
    names = [name.decode() for name in rows[0].split(b"|")]
    return table_of(pa.py_buffer(b"\n".join(rows) + b"\n"), TableHead(distinct(names, path), "|", 1), path)


def _lines(path: Path) -> list[bytes]:
    return memoryview(content_of(path)).tobytes().split(b"\n")


LIST_FORMATS = (
    Format("positions", "list of positions", TEXT_EXTENSIONS, unmarked=True,
           recognised=is_list_of_positions, read=read_positions),
    Format("drawn", "table with drawn lines", TEXT_EXTENSIONS, unmarked=True, recognised=is_drawn, read=read_drawn),
)  # fmt: skip

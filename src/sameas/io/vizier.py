"""VizieR's text output: lines of names, units and dashes, then rows, separated by tabs, semicolons, bars or blanks.

Comments above give the catalogue (``#Name``, ``#Title``) and its columns (``#Column``), with descriptions and UCDs.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from sameas.errors import InputError
from sameas.io.csv import TableHead, content_of, distinct, table_of
from sameas.io.format import TEXT_EXTENSIONS, Format, unit_of

if TYPE_CHECKING:
    from astropy.table import Table

#: Names, units and dashes; the separator of the columns is the one between the dashes.
_HEAD = re.compile(rb"(?m)^(?P<names>[^#\s-][^\n]*|_[^\n]*)\n(?P<units>[^\n]*)\n(?P<dashes>-+(?:[;\t|, ]+-+)*) *\r?\n")
_ABOUT = re.compile(r"#(Name|Title|Table):?\s+(.*\S)")
_UCD = re.compile(r"\[ucd=([^\]]+)\]")


def has_dashes(path: Path, first: bytes) -> bool:
    """Whether a line of dashes follows the names and units of the columns."""
    return _HEAD.search(first) is not None


FORMAT = Format("vizier", "VizieR table", TEXT_EXTENSIONS, unmarked=True, read_only=True, recognised=has_dashes)


@dataclass(frozen=True)
class _Comments:
    """The comments above the rows: metadata of the table, and (description, UCD) of each column."""

    meta: dict[str, str]
    columns: dict[str, tuple[str, str]]


def read(path: Path, hdu: None) -> Table:
    """The first table of a file that VizieR wrote."""
    import pyarrow as pa

    text = memoryview(content_of(path)).tobytes().replace(b"\r\n", b"\n")
    head = _HEAD.search(text)
    if head is None:
        raise InputError(f"{path}: has no lines of names, units and dashes, as VizieR writes them")
    end = _end_of_rows(text, head.end())
    body = text[head.end() : len(text) if end is None else end]
    dashes = head["dashes"].decode()
    separators = sorted(set(dashes) - {"-"})
    names, units = (head[line].decode("utf-8", "replace") for line in ("names", "units"))
    if separators == [" "]:
        widths = [(word.start(), word.end()) for word in re.finditer("-+", dashes)]
        cells = [[line[start:end].strip() for start, end in widths] for line in (names, units)]
        lines = (
            b"\t".join(line[start:end].strip() for start, end in widths) for line in body.split(b"\n") if line.strip()
        )
        body, delimiter = b"\n".join(lines) + b"\n", "\t"
    else:
        delimiter = separators[0] if separators else "\t"
        cells = [[cell.strip() for cell in line.split(delimiter)] for line in (names, units)]
    table = table_of(pa.py_buffer(body), TableHead(distinct(cells[0], path), delimiter, 0), path)
    comments = _comments(text[: head.start()].decode("utf-8", "replace"))
    table = _with_descriptions(_without_padding(table), cells[1], comments)
    if end is not None and _HEAD.search(text, end - 1):
        title = f" ({comments.meta['name'].rpartition('; ')[2]})" if "name" in comments.meta else ""
        table.meta["sameas_notes"] = [f"{path} holds several tables of VizieR; used the first{title}"]
    return table


def _end_of_rows(text: bytes, begin: int) -> int | None:
    """Where the rows from ``begin`` end: before the blank lines above the next comment; None where there is none."""
    comment = text.find(b"\n#", begin - 1)
    if comment < 0:
        return None
    filled = begin - 1 + len(text[begin - 1 : comment].rstrip())
    return text.index(b"\n", filled) + 1


def _comments(text: str) -> _Comments:
    meta: dict[str, str] = {}
    columns: dict[str, tuple[str, str]] = {}
    for line in text.splitlines():
        parts = line.split("\t")
        if parts[0] == "#Column" and len(parts) >= 4:
            ucd = _UCD.search(line)
            columns[parts[1].strip()] = parts[3].strip(), ucd[1] if ucd else ""
        elif about := _ABOUT.match(line):
            # A key that occurs twice belongs to the catalogue, then to the table.
            key, words = about[1].lower(), about[2].rstrip(":")
            meta[key] = f"{meta[key]}; {words}" if meta.get(key, words) != words else words
    return _Comments(meta, columns)


def _without_padding(table: Table) -> Table:
    """The table with the padding of text cells removed; empty text is masked."""
    import numpy as np
    from astropy.table import Column, MaskedColumn

    for name in table.colnames:
        column = table[name]
        if column.dtype.kind == "U":
            values = np.char.strip(np.ma.getdata(column))
            empty = np.ma.getmaskarray(column) | (values == "")
            stripped = MaskedColumn(values, name=name, mask=empty) if empty.any() else Column(values, name=name)
            table.replace_column(name, stripped)
    return table


def _with_descriptions(table: Table, units: list[str], comments: _Comments) -> Table:
    for name, unit in zip(table.colnames, units, strict=False):
        # Quoted formats such as '"h:m:s"' and '"Y:M:D"' are not units.
        if unit and not unit.startswith('"'):
            table[name].unit = unit_of(unit)
        description, ucd = comments.columns.get(name, ("", ""))
        table[name].description = description or None
        if ucd:
            table[name].meta["ucd"] = ucd
    table.meta.update(comments.meta)
    return table

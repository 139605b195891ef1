"""Text tables, which are read only: separated by blanks, SExtractor, VizieR, IPAC, CDS, lists of positions, drawn ones.

Their rows are converted to text with a separator and read as CSV, so that column types, empty cells and long
identifiers are handled alike; IPAC and CDS tables are parsed by astropy.
"""

from __future__ import annotations

import re
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from sameas.errors import InputError
from sameas.io.csv import TableHead, content_of, distinct, is_any_text, is_number, table_of, with_note
from sameas.io.format import TEXT_EXTENSIONS, Format, unit_of

if TYPE_CHECKING:
    import pyarrow as pa
    from astropy.table import Table


def _content(path: Path) -> bytes:
    return memoryview(content_of(path)).tobytes()


def _joined(rows: list[bytes], head: TableHead, path: Path) -> Table:
    import pyarrow as pa

    return table_of(pa.py_buffer(b"\n".join(rows) + b"\n"), head, path)


# Text separated by blanks, as NumPy, IRAF and awk write it: names in the first line, or in a comment above it.
#
# 300 000 rows of 8 columns take 0.7 s (astropy's fast reader, which does not convert them as CSV, 0.45 s). A cell that
# contains blanks is quoted; a missing one is ``nan``, ``null`` or ``--``.

_WORD = re.compile(rb'"[^"]*"|[^\s"]+')
_DELIMITERS = b",;\t|"


def is_separated_by_blanks(path: Path, first: bytes) -> bool:
    """Whether the first two lines that are not comments have several words, and no other delimiter."""
    if not is_any_text(path, first):
        return False
    lines = [line.strip() for line in first.split(b"\n")[:-1] if line.strip()] or [first.strip()]
    comments = [line.lstrip(b"#").strip() for line in lines if line.startswith(b"#")]
    cells = [line for line in lines if not line.startswith(b"#")] or comments[-1:]
    if not cells or any(sign in cell for cell in cells[:2] for sign in (b"\0", *(bytes([d]) for d in _DELIMITERS))):
        return False
    # The title of a single column may have blanks, its numbers have none.
    return len(words(cells[1] if len(cells) > 1 else cells[0])) > 1


def read_words(path: Path) -> Table:
    """The table of a text file separated by blanks."""
    text = content_of(path)
    names, row = _names_above(text, path)
    return rows_of(text, names, row, path)


def words(line: bytes) -> list[bytes]:
    """The cells of a line; quoted ones may contain blanks."""
    return _WORD.findall(line) if b'"' in line else line.split()


def rows_of(text: pa.Buffer | bytes, names: list[str], first_row: int, path: Path) -> Table:
    """The table of rows separated by blanks, from line ``first_row`` on, counted from 0; comments are skipped."""
    rows = []
    for number, line in enumerate(memoryview(text).tobytes().split(b"\n")):
        cells = [] if number < first_row or line[:1] == b"#" else words(line)
        if cells and len(cells) != len(names):
            message = f"{path}: line {number + 1} has {len(cells)} cells, not {len(names)}"
            raise InputError(message, "put text with blanks in it in quotes, and nan where there is nothing")
        if cells:
            rows.append(b"\t".join(cells))
    return _joined(rows, TableHead(distinct(names, path), "\t", 0), path)


def _names_above(text: pa.Buffer, path: Path) -> tuple[list[str], int]:
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


# SExtractor's ASCII_HEAD: one comment per column (number, name, description, unit), then rows separated by blanks.
#
# A vector column, such as MAG_APER of three apertures, shows as a gap in the numbering; its columns are named MAG_APER,
# MAG_APER_1, MAG_APER_2, as in astropy. The rows are parsed in bulk: 300 000 of 8 columns take 0.8 s, with astropy's
# own reader 3.1 s.

#: Largest column number (chosen); a larger one is damaged.
_MOST_COLUMNS = 10_000
_NUMBERED = re.compile(r"#\s*(\d{1,9})\s+(\S+)(.*)")
_COLUMN_1 = re.compile(rb"\A\s*#\s*1\s+[A-Z]\w+\b")


def is_ascii_head(path: Path, first: bytes) -> bool:
    """Whether the first comment describes column 1."""
    return _COLUMN_1.match(first) is not None


@dataclass(frozen=True)
class _HeadLine:
    """One line of the head: the column that it describes."""

    number: int
    name: str
    description: str
    unit: str


def read_sextractor(path: Path) -> Table:
    """The table of an ASCII_HEAD catalogue."""
    text = content_of(path)
    head_lines, width = _numbered_head(memoryview(text)[: 1 << 20].tobytes(), path)
    columns = _expanded(head_lines, width, path)
    return _described(rows_of(text, [column.name for column in columns], 0, path), columns)


def _numbered_head(first: bytes, path: Path) -> tuple[list[_HeadLine], int]:
    """The lines of the head, and the number of cells in the first row."""
    head_lines, width = [], 0
    for line in first.split(b"\n"):
        if line.startswith(b"#"):
            match = _NUMBERED.match(line.decode("utf-8", "replace"))
            head_lines += [_HeadLine(int(match[1]), match[2], *_description_and_unit(match[3]))] if match else []
        elif line.strip():
            width = len(words(line))
            break
    numbers = [column.number for column in head_lines]
    if not head_lines or numbers != sorted(set(numbers)) or numbers[0] != 1 or numbers[-1] > _MOST_COLUMNS:
        raise InputError(f"{path}: its comments do not number the columns from 1 on, as SExtractor does")
    return head_lines, width or numbers[-1]


def _description_and_unit(text: str) -> tuple[str, str]:
    """Description and unit, from the text after the name; the unit is in brackets at the end."""
    text = text.strip()
    if text.endswith("]"):
        begin = text.find("[", text.rfind("]", 0, -1) + 1)
        if begin >= 0:
            return text[:begin].rstrip(), text[begin + 1 : -1]
    return text, ""


def _expanded(head_lines: list[_HeadLine], width: int, path: Path) -> list[_HeadLine]:
    """One description for each cell of a row; vector columns are expanded."""
    ends = [*(column.number for column in head_lines[1:]), width + 1]
    if ends[-1] <= head_lines[-1].number:
        raise InputError(
            f"{path}: its comments number {head_lines[-1].number} columns, but the first row has {width} cells"
        )
    columns = []
    for column, end in zip(head_lines, ends, strict=True):
        for k in range(end - column.number):
            name = f"{column.name}_{k}" if k else column.name
            columns.append(_HeadLine(column.number + k, name, column.description, column.unit))
    return columns


def _described(table: Table, columns: list[_HeadLine]) -> Table:
    for column in columns:
        table[column.name].description = column.description or None
        if column.unit and column.unit != "-":
            table[column.name].unit = unit_of(column.unit)
    return table


# VizieR's text output: lines of names, units and dashes, then rows, separated by tabs, semicolons, bars or blanks.
#
# Comments above give the catalogue (``#Name``, ``#Title``) and its columns (``#Column``), with descriptions and UCDs.

#: Names, units and dashes; the separator of the columns is the one between the dashes.
_DASHES = re.compile(
    rb"(?m)^(?P<names>[^#\s-][^\n]*|_[^\n]*)\n(?P<units>[^\n]*)\n(?P<dashes>-+(?:[;\t|, ]+-+)*) *\r?\n"
)
_ABOUT = re.compile(r"#(Name|Title|Table):?\s+(.*\S)")
_UCD = re.compile(r"\[ucd=([^\]]+)\]")


def has_dashes(path: Path, first: bytes) -> bool:
    """Whether a line of dashes follows the names and units of the columns."""
    return _DASHES.search(first) is not None


@dataclass(frozen=True)
class _Comments:
    """The comments above the rows: metadata of the table, and (description, UCD) of each column."""

    meta: dict[str, str]
    columns: dict[str, tuple[str, str]]


def read_vizier(path: Path) -> Table:
    """The first table of a file that VizieR wrote."""
    import pyarrow as pa

    text = _content(path).replace(b"\r\n", b"\n")
    head = _DASHES.search(text)
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
    table = _with_units(_without_padding(table), cells[1], comments)
    if end is not None and _DASHES.search(text, end - 1):
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


def _with_units(table: Table, units: list[str], comments: _Comments) -> Table:
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


# IPAC tables, as IRSA and NED write them: names, types, units and nulls between bars; parsed by astropy.

# No two parts may match the same line end: backtracking over blank lines would take exponential time.
_BARS = re.compile(rb"\A(?:[^\S\n]*(?:\\[^\n]*)?\n)*[^\S\n]*\|[^\n]*\|[^\S\n]*\n\s*\|")


def has_bars(path: Path, first: bytes) -> bool:
    """Whether two lines between bars follow the comments, which begin with a backslash."""
    return _BARS.match(first) is not None


def read_ipac(path: Path) -> Table:
    """The table of an IPAC file; its keywords are its metadata."""
    from astropy.io import ascii as text_tables

    text = _content(path).decode("utf-8", "replace")
    table = text_tables.read(text.splitlines(), format="ipac")
    keywords = table.meta.pop("keywords", {})
    table.meta = {key: value for key, value in table.meta.items() if value}
    table.meta.update({name: keyword["value"] for name, keyword in keywords.items()})
    return table


# CDS and machine-readable tables: fixed columns, defined by a "Byte-by-byte Description"; parsed by astropy.
#
# The description precedes the rows (machine-readable tables) or is in the file ReadMe of the folder (CDS).

_BYTES = b"Byte-by-byte Description of file"
#: Title with the names of files, head of the columns, columns; a rule of dashes after each.
_SECTION = re.compile(rf"(?m)^{_BYTES.decode()}:?(.*)\n-{{3,}}.*\n.*Bytes.*\n-{{3,}}.*\n(?:[^-].*\n)+-{{3,}}.*\n")


def has_description(path: Path, first: bytes) -> bool:
    """Whether the file, or the ReadMe in its folder, has a byte-by-byte description."""
    return _BYTES in first or _byte_by_byte(path) != ""


def read_mrt(path: Path) -> Table:
    """The table of a CDS or machine-readable file."""
    from astropy.io import ascii as text_tables

    text = _content(path).decode("utf-8", "replace")
    if _BYTES.decode() not in text:
        # The layout of machine-readable tables: description, rule, rows.
        text = _byte_by_byte(path) + text
    with warnings.catch_warnings():
        # Units outside the standard are kept as text.
        warnings.simplefilter("ignore")
        return text_tables.read(text.splitlines(), format="cds")


def _byte_by_byte(path: Path) -> str:
    """The byte-by-byte description of a file in the ReadMe of its folder; empty where there is none."""
    for name in ("ReadMe", "readme", "README", "ReadMe.txt"):
        readme = path.with_name(name)
        if readme.is_file():
            for section in _SECTION.finditer(readme.read_text("utf-8", "replace")):
                if path.name.removesuffix(".gz") in section[1].split():
                    return section[0]
    return ""


# Lists of positions without names: a right ascension and a declination in every line and nothing else; two numbers in
# degrees, two sexagesimal words (hours and degrees), or six numbers (h m s d m s).

_BETWEEN = re.compile(rb"[\s,;]+")
_SEXAGESIMAL = re.compile(rb"[+-]?\d{1,3}(:\d{1,2}(:\d{1,2}(\.\d*)?)?|[hd]\d{1,2}m(\d{1,2}(\.\d*)?s)?)")


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
    rows = []
    for number, line in enumerate(_content(path).split(b"\n"), start=1):
        if line.strip() and not line.startswith(b"#"):
            position = _position(_BETWEEN.split(line.strip()))
            if position is None:
                raise InputError(f"{path}: line {number} is not a right ascension and a declination like the first")
            rows.append(b"\t".join(position))
    table = _joined(rows, TableHead(["RA", "DEC"], "\t", 0), path)
    return with_note(table, f"{path}: its columns have no names: they are read as right ascension and declination")


# Drawn tables: bars between cells and lines of dashes, as databases, Astropy and Markdown print them.

_RULE = re.compile(rb"[+|][-+|: =]*-[-+|: =]*")


def is_drawn(path: Path, first: bytes) -> bool:
    """Whether the first or second line is one of dashes and corners, and rows begin with a bar."""
    if not is_any_text(path, first):
        return False
    lines = [line.strip() for line in first.split(b"\n") if line.strip()][:3]
    return any(_RULE.fullmatch(line) for line in lines[:2]) and any(line.startswith(b"|") for line in lines)


def read_drawn(path: Path) -> Table:
    """The table of a drawn table, with the names of its first row."""
    rows = []
    for line in _content(path).split(b"\n"):
        if line.strip() and not _RULE.fullmatch(line.strip()):
            rows.append(b"|".join(cell.strip() for cell in line.strip().strip(b"|").split(b"|")))
    names = [name.decode() for name in rows[0].split(b"|")]
    return _joined(rows, TableHead(distinct(names, path), "|", 1), path)


#: In the order of recognition.
TEXT_FORMATS = (
    Format("positions", "list of positions", TEXT_EXTENSIONS, unmarked=True,
           recognised=is_list_of_positions, read=read_positions),
    Format("drawn", "table with drawn lines", TEXT_EXTENSIONS, unmarked=True, recognised=is_drawn, read=read_drawn),
    Format("sextractor", "SExtractor catalogue", (".cat", ".cat.gz"), unmarked=True,
           recognised=is_ascii_head, read=read_sextractor),
    Format("ipac", "IPAC table", (".tbl", ".ipac", ".tbl.gz", ".ipac.gz"), unmarked=True,
           recognised=has_bars, read=read_ipac),
    Format("mrt", "CDS table", (".mrt", ".dat", ".mrt.gz", ".dat.gz"), unmarked=True,
           recognised=has_description, read=read_mrt),
    Format("vizier", "VizieR table", TEXT_EXTENSIONS, unmarked=True, recognised=has_dashes, read=read_vizier),
    Format("ascii", "text separated by blanks", TEXT_EXTENSIONS, unmarked=True,
           recognised=is_separated_by_blanks, read=read_words),
)  # fmt: skip

"""CSV: one line per row, names in the first line, separated by commas, semicolons, tabs or bars.

Empty cells and the cells null, NA, N/A and -- are masked; nan is a number. Comment lines (#) before the names are
skipped. Multidimensional columns are written as name_1, name_2, … The provenance is written to a separate file,
``out.csv.provenance.json``, since many readers do not accept comments.
"""

from __future__ import annotations

import csv
import gzip
import io
import json
import os
import re
from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sameas.bounds import TEXT_UNPACKING, check_columns, unpacked
from sameas.errors import InputError
from sameas.io.arrow import FEW_ROWS, array_of, column_of, numbers_in
from sameas.io.atomic import replacing, together
from sameas.io.format import TEXT_EXTENSIONS, Format, in_utf_8, json_text, utf_16_of

if TYPE_CHECKING:
    import pyarrow as pa
    from astropy.table import Column, Table


def is_any_text(path: Path, first: bytes) -> bool:
    """Whether the file has an extension of text; text that no other format recognises is read as CSV."""
    return path.name.lower().endswith(TEXT_EXTENSIONS)


FORMAT = Format(
    "csv",
    "CSV",
    (".csv", ".tsv", ".txt", ".csv.gz", ".tsv.gz", ".txt.gz"),
    unmarked=True,
    sidecar=True,
    recognised=is_any_text,
)

_NULLS = ["null", "NULL", "NA", "N/A", "n/a", "--", *(" " * width for width in range(33))]
_DELIMITERS = ",;\t|"


@dataclass(frozen=True)
class TableHead:
    """Column names, delimiter, and the number of lines before the first row."""

    names: list[str]
    delimiter: str
    lines: int


def read(path: Path, hdu: None) -> Table:
    """The table in a CSV file; column types are inferred from the cells."""
    text = content_of(path)
    try:
        return table_of(text, _header(text, path), path)
    except EncodingError as error:
        text = _from_windows_1252(text, error)
    table = table_of(text, _header(text, path), path)
    return with_note(table, f"{path}: is not UTF-8 text and is read as Windows-1252")


def with_note(table: Table, note: str) -> Table:
    """The table with a further note of its reader."""
    table.meta["sameas_notes"] = [*table.meta.get("sameas_notes", []), note]
    return table


class EncodingError(InputError):
    """A text is not UTF-8."""


def _from_windows_1252(text: pa.Buffer, error: EncodingError) -> pa.Buffer:
    """The text in UTF-8, of the code page that spreadsheets of Western Europe write; raises the error if it has bytes
    that stand for nothing there."""
    import pyarrow as pa

    content = memoryview(text).tobytes()
    if b"\0" not in content:
        with suppress(UnicodeDecodeError):
            return pa.py_buffer(content.decode("cp1252").encode())
    raise error


def table_of(text: pa.Buffer, head: TableHead, path: Path) -> Table:
    """The table in a text with known names, delimiter and first row; column types are inferred from the cells."""
    from astropy.table import Table

    content, commas = _parsed(text, head, path)
    table = Table([_column(name, content.column(i), path) for i, name in enumerate(head.names)], copy=False)
    notes = [f"{path}: commas within numbers are read as decimal points"] if commas else []
    notes += [may_be_cut(path)] if unended(text) else []
    if notes:
        table.meta["sameas_notes"] = notes
    return table


def unended(text: pa.Buffer | bytes) -> bool:
    """Whether the last line of a text has no line end, as in a truncated file."""
    return bytes(memoryview(text)[-1:]) not in (b"\n", b"\r", b"")


def may_be_cut(path: Path) -> str:
    """The note on a table whose last line has no line end."""
    return f"{path}: its last line has no line end: it may be incomplete"


def write(table: Table, path: Path, provenance: Mapping[str, Any]) -> None:
    """Writes a CSV file, separated by tabs if its extension is .tsv; see :func:`write_with_sidecar`."""
    names, arrays = _flat_columns(table)
    with opened(path) as file:
        write_rows(names, arrays, file, "\t" if ".tsv" in path.suffixes else ",")


def write_with_sidecar(table: Table, path: Path, provenance: Mapping[str, Any], overwrite: bool) -> None:
    """Writes a CSV file and its provenance file; without provenance an existing provenance file is removed."""
    notes_path = sidecar(path)
    if not provenance or not (path.is_file() or not path.exists()):
        with replacing(path, overwrite=overwrite) as draft:
            write(table, draft, {})
        with suppress(FileNotFoundError):
            # An earlier run's provenance does not describe this file.
            notes_path.unlink()
        return
    with together() as arm, replacing(notes_path) as notes, replacing(path, overwrite=overwrite) as draft:
        notes.write_text(json_text(provenance), encoding="utf-8")
        write(table, draft, {})
        arm()


def provenance(path: Path) -> dict[str, Any]:
    """The content of the provenance file; empty if there is none."""
    notes_path = sidecar(path)
    return dict(json.loads(notes_path.read_text(encoding="utf-8"))) if notes_path.exists() else {}


def sidecar(path: Path) -> Path:
    """The path of the provenance file of a CSV file.

    >>> sidecar(Path("pairs.csv")).name
    'pairs.csv.provenance.json'
    """
    return path.with_name(path.name + ".provenance.json")


def write_rows(names: list[str], arrays: list[pa.Array], file: Any, delimiter: str) -> None:
    """Writes the names and the rows; text is quoted if any cell requires it."""
    import pyarrow as pa
    from pyarrow import csv as arrow_csv

    line = io.StringIO()
    csv.writer(line, delimiter=delimiter, lineterminator="\n").writerow(names)
    file.write(line.getvalue().encode("utf-8"))
    # Unquoted, a cell that begins with # would be read as a comment, and outer blanks would be lost.
    if len(arrays) == 1 and arrays[0].null_count:
        # An empty line would not be read as a row; Python's writer puts quotes there.
        rows = io.StringIO()
        csv.writer(rows, delimiter=delimiter, lineterminator="\n").writerows([[c] for c in _texts(arrays[0])])
        file.write(rows.getvalue().encode("utf-8"))
        return
    special = f'["\\r\\n{delimiter}]|^#|^ | $'
    texts = [array for array in arrays if pa.types.is_string(array.type)]
    quoted = any(_has(array, special) for array in texts)
    options = arrow_csv.WriteOptions(
        include_header=False, delimiter=delimiter, quoting_style="needed" if quoted else "none"
    )
    keys = [str(number) for number in range(len(names))]
    arrow_csv.write_csv(pa.Table.from_arrays(arrays, names=keys), file, options)


def _has(array: pa.Array, expression: str) -> bool:
    """Whether any text cell matches the regular expression."""
    if len(array) <= FEW_ROWS:
        wanted = re.compile(expression)
        return any(wanted.search(cell) for cell in array.to_pylist() if cell)
    from pyarrow import compute

    return bool(compute.any(compute.match_substring_regex(array, expression)).as_py())


def _texts(array: pa.Array) -> list[str]:
    import pyarrow as pa

    return [text or "" for text in array.cast(pa.string()).to_pylist()]


def opened(path: Path) -> Any:
    """The file, open for writing bytes; gzipped if its name ends in .gz."""
    return gzip.open(path, "wb", compresslevel=4) if path.suffix == ".gz" else path.open("wb")


def content_of(path: Path) -> pa.Buffer:
    """The bytes of a text, decompressed if its name ends in .gz, and in UTF-8 if it is UTF-16."""
    import pyarrow as pa

    if path.suffix.lower() == ".gz":
        return pa.py_buffer(in_utf_8(unpacked(path, TEXT_UNPACKING)))
    with pa.memory_map(os.fsencode(path)) as file:  # a file name may have bytes that are not UTF-8
        buffer = file.read_buffer()
    return pa.py_buffer(in_utf_8(buffer.to_pybytes())) if utf_16_of(bytes(buffer[:64])) else buffer


def _header(text: pa.Buffer, path: Path) -> TableHead:
    """The names from the first line that is neither blank nor a comment, or else from the last comment before it."""
    lines, comment = 0, ""
    for raw in io.BytesIO(memoryview(text)[: 1 << 20]):
        lines += 1
        try:
            # A comment may have another encoding.
            line = raw.decode("utf-8-sig" if lines == 1 else "utf-8", "replace" if raw[:1] == b"#" else "strict")
            line = line.strip("\r\n")
        except UnicodeDecodeError as error:
            raise EncodingError(f"{path}: is not UTF-8 text (line {lines}); save it as UTF-8") from error
        if line.startswith("#"):
            comment = line.lstrip("#").strip()
        elif line.strip():
            break
    else:
        if not any(delimiter in comment for delimiter in _DELIMITERS):
            raise InputError(f"{path}: has no line with the names of the columns")
        line = comment
    delimiter = _delimiter(line, path)
    names = _split(line, delimiter)
    if any(is_number(name) for name in names):
        above = _split(comment, delimiter)
        if len(above) != len(names) or any(is_number(name) for name in above):
            raise InputError(f"{path}: line {lines} holds numbers; put the names of the columns above the first row")
        names, lines = above, lines - 1
    return TableHead(distinct(names, path), delimiter, lines)


def distinct(names: list[str], path: Path) -> list[str]:
    """The column names, empty ones replaced by column_1, …; refused if one occurs twice or there are too many."""
    check_columns(len(names), path)
    names = [name or f"column_{number}" for number, name in enumerate(names, start=1)]
    counts = Counter(names)
    if len(counts) < len(names):
        twice = next(name for name in names if counts[name] > 1)
        raise InputError(f"{path}: two columns are called {twice}; rename one")
    return names


def _split(line: str, delimiter: str) -> list[str]:
    return [name.strip() for name in next(csv.reader([line], delimiter=delimiter), [])]


def _delimiter(line: str, path: Path) -> str:
    if path.name.lower().removesuffix(".gz").endswith(".tsv"):
        return "\t"
    for delimiter in _DELIMITERS:
        if len(_split(line, delimiter)) > 1:
            return delimiter
    return ","


def is_number(text: str) -> bool:
    """Whether a cell is a number, so that its line does not contain column names."""
    try:
        float(text)
    except ValueError:
        return False
    return text.lower() not in ("nan", "inf", "infinity")


def _parsed(text: pa.Buffer, header: TableHead, path: Path) -> tuple[pa.Table, bool]:
    """The rows, with integers beyond 63 bits and dates kept exactly as written; and whether decimals have commas."""
    import pyarrow as pa

    content, point = _arrow(text, header, path, {}), "."
    if _decimal_commas(content):
        content, point = _arrow(text, header, path, {}, ","), ","
    again, large = {}, []
    for name, column in zip(content.column_names, content.columns, strict=True):
        if pa.types.is_temporal(column.type):
            again[name] = pa.string()
        elif pa.types.is_floating(column.type) and len(column):
            largest = max(np.fmax.reduce(numbers_in(chunk), initial=-np.inf) for chunk in column.chunks)
            # A whole number beyond 63 bits was read as a float and lost its last digits.
            if 2.0**63 <= largest < 2.0**65:
                large.append(name)
    if large:
        spelled = _arrow(text, header, path, dict.fromkeys(large, pa.string()))
        again |= {name: pa.uint64() if _all_whole(spelled.column(name)) else pa.float64() for name in large}
    return _arrow(text, header, path, again, point) if again else content, point == ","


#: A number with a comma; and one whose comma may separate thousands.
_COMMA, _THOUSANDS = re.compile(r"\s*[+-]?\d+,\d+([eE][+-]?\d+)?\s*"), re.compile(r"\s*[+-]?\d{1,3},\d{3}\s*")


def _decimal_commas(content: pa.Table) -> bool:
    """Whether commas are decimal points: some columns consist of numbers with commas, not all of them with three digits
    after it, and no number of the table has a point."""
    import pyarrow as pa

    decimal = False
    for column in content.columns:
        if pa.types.is_floating(column.type) and any(np.isfinite(numbers_in(chunk)).any() for chunk in column.chunks):
            return False
        if pa.types.is_string(column.type):
            cells = (cell for chunk in column.chunks for cell in chunk if cell.is_valid)
            first = next(cells, None)
            if first is not None and _COMMA.fullmatch(first.as_py()):
                texts = [first.as_py(), *(cell.as_py() for cell in cells)]
                decimal |= all(map(_COMMA.fullmatch, texts)) and not all(map(_THOUSANDS.fullmatch, texts))
    return decimal


def _all_whole(column: pa.ChunkedArray) -> bool:
    """Whether the cells of a text column are whole numbers without a sign."""
    import pyarrow as pa
    from pyarrow import compute

    try:
        compute.cast(compute.utf8_trim_whitespace(column), pa.uint64())
    except pa.ArrowInvalid:
        return False
    return True


def _arrow(
    text: pa.Buffer, header: TableHead, path: Path, kinds: Mapping[str, Any], decimal_point: str = "."
) -> pa.Table:
    import pyarrow as pa
    from pyarrow import csv as arrow_csv

    wrong: list[Any] = []

    def note(row: Any) -> str:
        wrong.append(row)
        return "error"

    def parse(threads: bool, handler: Any = None) -> pa.Table:
        return arrow_csv.read_csv(
            pa.BufferReader(text),
            arrow_csv.ReadOptions(use_threads=threads, column_names=header.names, skip_rows=header.lines),
            arrow_csv.ParseOptions(delimiter=header.delimiter, newlines_in_values=True, invalid_row_handler=handler),
            arrow_csv.ConvertOptions(
                null_values=_NULLS, strings_can_be_null=True, column_types=kinds, decimal_point=decimal_point
            ),
        )

    if not _has_rows(text, header):
        return pa.table({name: pa.array([], pa.float64()) for name in header.names})
    try:
        return parse(True)
    except pa.ArrowInvalid as error:
        # Arrow decodes a row for its handler, and prints a traceback if it is not UTF-8.
        _check_encoding(text, header, path)
        # Row numbers are known only without threads.
        with suppress(pa.ArrowInvalid):
            parse(False, note)
        if not wrong:
            raise
        row = wrong[0]
        if unended(text) and bytes(memoryview(text)[-len(row.text.encode()) :]) == row.text.encode():
            raise InputError(f"{path}: the last line is incomplete, the file was cut off; copy it again") from error
        line = f"line {row.number}" if row.number else f"the line {row.text[:60]!r}"
        raise InputError(
            f"{path}: {line} has {row.actual_columns} cells, not {row.expected_columns}; "
            "put text with a delimiter in it in quotes"
        ) from error


def _check_encoding(text: pa.Buffer, header: TableHead, path: Path) -> None:
    """Refuses rows that are not UTF-8, naming the first such line."""
    for number, line in enumerate(io.BytesIO(memoryview(text)), start=1):
        try:
            line.decode()
        except UnicodeDecodeError as error:
            if number > header.lines:
                raise EncodingError(f"{path}: is not UTF-8 text (line {number}); save it as UTF-8") from error


def _has_rows(text: pa.Buffer, header: TableHead) -> bool:
    lines = io.BytesIO(memoryview(text))
    for _ in range(header.lines):
        lines.readline()
    return any(line.strip() for line in lines)


def _column(name: str, values: Any, path: Path) -> Column:
    import pyarrow as pa

    if pa.types.is_binary(values.type):
        raise EncodingError(f"{path}: column {name} is not UTF-8 text; save the file as UTF-8")
    column = column_of(name, values)
    if column is None:
        raise InputError(f"{path}: column {name} cannot be read ({values.type})")
    return column


def _flat_columns(table: Table) -> tuple[list[str], list[pa.Array]]:
    names: list[str] = []
    arrays: list[pa.Array] = []
    for name in table.colnames:
        column = table[name]
        if len(column.shape) == 1:
            names.append(name)
            arrays.append(_cell_texts(column))
            continue
        flat = column.reshape(len(column), -1) if len(column) else column.reshape(0, int(np.prod(column.shape[1:])))
        for number in range(flat.shape[1]):
            names.append(f"{name}_{number + 1}")
            arrays.append(_cell_texts(flat[:, number]))
    twice = [name for name in names if names.count(name) > 1]
    if twice:
        raise InputError(f"two columns would be called {twice[0]}; rename one")
    return names, arrays


def _cell_texts(column: Column) -> pa.Array:
    import pyarrow as pa

    array = array_of(column)
    if pa.types.is_nested(array.type):
        lists = f"column {column.name} has lists in its cells"
        raise InputError(f"{lists}; CSV has no room for them, write .parquet or .ecsv")
    if pa.types.is_float16(array.type):
        array = array.cast(pa.float32())
    return array.cast(pa.string()) if pa.types.is_large_string(array.type) else array

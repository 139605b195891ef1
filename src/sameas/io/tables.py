"""Reading and writing of tables in any known format, chosen by the file's extension and first bytes."""

from __future__ import annotations

import difflib
import gzip
import hashlib
import os
import re
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sameas.bounds import check_facts
from sameas.errors import Argument, InputError, Message, first_line, printable, reading
from sameas.io import ascii as text
from sameas.io import csv, daophot, ecsv, fits, parquet, votable
from sameas.io.atomic import replacing
from sameas.io.format import TEXT_EXTENSIONS, Format, LazyTable, in_utf_8, plain, utf_16_of

if TYPE_CHECKING:
    from astropy.table import Table

#: The formats of text, whose readers take UTF-16, too; ECSV is UTF-8 by its standard.
_OF_TEXT: tuple[Format, ...] = (daophot.FORMAT, *text.TEXT_FORMATS, csv.FORMAT)
#: The formats, in the order of messages and of the recognition of texts.
FORMATS: tuple[Format, ...] = (fits.FORMAT, votable.FORMAT, ecsv.FORMAT, parquet.FORMAT, *_OF_TEXT)
#: Number of bytes for the recognition of a format; VizieR's comments are long.
_HEAD_BYTES = 1 << 16

_UTF_16 = "UTF-16 text"
_AS_CSV, _AS_FITS = "save it as CSV", "open it in Python and give the table, or write it as FITS"
#: Signatures of files that are not readable tables, their descriptions, and what to do.
_OTHER_SIGNATURES = (
    (b"\x89PNG", "a PNG picture", ""),
    (b"\xff\xd8\xff", "a JPEG picture", ""),
    (b"GIF8", "a GIF picture", ""),
    (b"%PDF", "a PDF document", ""),
    (b"PK\x03\x04", "a ZIP archive or a spreadsheet (.xlsx, .ods)", f"unpack it, or {_AS_CSV}"),
    (b"\xd0\xcf\x11\xe0", "an old spreadsheet (.xls)", _AS_CSV),
    (b"\x89HDF", "an HDF5 file", _AS_FITS),
    (b"\x93NUMPY", "an array of NumPy", _AS_FITS),
    (b"\x80\x04\x95", "a pickle of Python", _AS_FITS),
    (b"\x80\x05\x95", "a pickle of Python", _AS_FITS),
    (b"ARROW1", "a Feather file", "write it as Parquet"),
    (b"BZh", "a bzip2 file", "unpack it"),
    (b"\xfd7zXZ", "an xz file", "unpack it"),
    (b"(\xb5/\xfd", "a zstd file", "unpack it"),
    (b"\x1f\x8b", "a gzip file", ""),
)


def checksum(path: str | os.PathLike[str]) -> str:
    """The SHA-256 of a file, in hexadecimal digits.

    Raises InputError: the file cannot be read.
    """
    try:
        with open(path, "rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error


def first_bytes(path: Path) -> bytes:
    """The first :data:`_HEAD_BYTES` bytes of a file, decompressed if its name ends in .gz."""
    try:
        if path.suffix.lower() == ".gz":
            with gzip.open(path) as file:
                return file.read(_HEAD_BYTES)
        with path.open("rb") as file:
            return file.read(_HEAD_BYTES)
    except (gzip.BadGzipFile, zlib.error) as error:
        raise InputError(f"{path}: is not a gzip file, though its name ends in .gz") from error
    except EOFError as error:
        raise InputError(f"{path}: is cut off in the middle; copy it again") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error


def kind_of(first: bytes) -> str | None:
    """The kind of a file by its first bytes: the label of a format, another description, or None.

    With it a wrong file is refused in plain words before a library fails on it.
    """
    labels = [(signature, known.label) for known in FORMATS for signature in known.signatures]
    for signature, kind in (*labels, *((signature, kind) for signature, kind, _ in _OTHER_SIGNATURES)):
        if first.startswith(signature):
            return kind
    text = first.removeprefix(b"\xef\xbb\xbf").lstrip().lower()
    if text.startswith((b"<!doctype html", b"<html")):
        return "a web page (HTML)"
    for known in FORMATS:
        if any(marker in text for marker in known.markers):
            return known.label
    if text.startswith(b"<?xml"):
        return "an XML file without a table"
    if text.startswith((b"{", b"[{")):
        return "a JSON file"
    if utf_16_of(first):
        return _UTF_16
    return "a binary file" if b"\x00" in first else None


def known_formats() -> dict[str, tuple[str, ...]]:
    """The readable formats by name, with their extensions.

    Text formats are recognised by content: a file with any of the text extensions may have any of the text formats.

    >>> known_formats()["ecsv"]
    ('.ecsv', '.ecsv.gz')
    """
    return {known.name: known.extensions for known in FORMATS}


def written_formats() -> dict[str, tuple[str, ...]]:
    """The writable formats by name, with their extensions.

    >>> ", ".join(written_formats())
    'fits, votable, ecsv, parquet, csv'
    """
    return {known.name: known.extensions for known in FORMATS if not known.read_only}


def read_table(path: str | os.PathLike[str], *, format: str | None = None, hdu: int | str | None = None) -> Table:
    """The table in a file, with its units, descriptions and metadata.

    Parameters
    ----------
    path : a file of one of the :func:`known_formats`.
    format : name of the format, if the extension does not determine it.
    hdu : FITS only: number or name of the extension; the first table if None.

    Returns
    -------
    An :class:`astropy.table.Table`. Missing values are masked; NaN is kept. Text is fixed-width Unicode, or Python
    strings if the longest exceeds 256 characters. Empty text counts as missing in FITS, ECSV and CSV. The UCD of a
    column is ``column.meta["ucd"]``. Notes for the user (several tables in the file, a skipped column) are in
    ``table.meta["sameas_notes"]``, a list of sentences. The file is closed.

    Raises
    ------
    InputError : no such file, a directory, an empty file, an unknown extension, content of another format.
    """
    path = Path(path)
    known = _format_in(path, format)
    if hdu is not None and not known.several_tables:
        given = Message(f"{path}: ", Argument("hdu", repr(hdu)), " was given")
        raise InputError(Message(given, ", but only FITS files have several tables to choose from"))
    with reading(str(path), f"cannot be read as {known.label}"):
        table: Table = known.read(path) if known.read is not None else known.module().read(path, hdu)
        check_facts({"": table.meta} | {name: column.info.meta for name, column in table.columns.items()}, path)
    return table


def write_table(
    table: Table | LazyTable,
    path: str | os.PathLike[str],
    *,
    provenance: Mapping[str, Any],
    format: str | None = None,
    overwrite: bool = True,
) -> None:
    """Writes a table and its provenance atomically: the file is complete or absent.

    Parameters
    ----------
    table : columns of numbers, booleans, text and arrays of them. Masked cells become the format's nulls.
        Quantities are written as numbers with a unit, times as ISO text; other mixin columns are refused. A table that
        is computed in pieces is computed while it is written, in formats that allow it.
    path : determines the format by its extension.
    provenance : flat mapping to text, numbers, booleans or lists; :func:`read_provenance` reads it back.
        It is stored in the file: in the card SAMEAS (FITS), as INFO elements (VOTable), in the metadata
        (ECSV, Parquet); for CSV in a separate file, ``path`` + ``.provenance.json``.
    format : name of the format, if the extension does not determine it.
    overwrite : if False, an existing path is refused.

    Raises
    ------
    InputError : the path or a column cannot be written; an existing file is kept, and no partial file remains.
    """
    path = Path(path)
    known = _format_for(path, format)
    facts = plain(provenance)
    lazy = hasattr(table, "pieces")
    whole = None if lazy and known.in_pieces else _with_plain_columns(table.whole() if lazy else table, path)
    try:
        if known.sidecar:
            known.module().write_with_sidecar(whole, path, facts, overwrite)
            return
        with replacing(path, overwrite=overwrite) as draft:
            if whole is None:
                known.module().write_pieces(
                    (_with_plain_columns(piece, path) for piece in table.pieces()), draft, facts
                )
            else:
                known.module().write(whole, draft, facts)
    except (InputError, MemoryError, ModuleNotFoundError) as error:
        raise _naming(error, path) from error.__cause__
    except Exception as error:
        raise InputError(f"cannot write {path} as {known.label}: {first_line(error)}") from error


def read_provenance(path: str | os.PathLike[str], *, format: str | None = None) -> dict[str, Any]:
    """The provenance of a file, as given to :func:`write_table`; empty if the file has none.

    Raises InputError: as :func:`read_table`.
    """
    path = Path(path)
    known = _format_in(path, format)
    if known.read_only:  # these formats have none
        return {}
    with reading(str(path), "its provenance cannot be read"):
        facts = dict(known.module().provenance(path))
        check_facts(facts, path)
        return facts


def _named(name: str, path: Path) -> Format:
    """The format with this name or label."""
    for known in FORMATS:
        if name.lower() in (known.name, known.label.lower()):
            return known
    raise InputError(f"{path}: unknown format {name!r}; give one of {', '.join(f.name for f in FORMATS)}")


def _format_for(path: Path, name: str | None) -> Format:
    """The format of a file to be written."""
    if name is not None:
        known = _named(name, path)
        if known.read_only:
            raise InputError(f"{path}: {known.label} is read, not written; give one of {', '.join(written_formats())}")
        return known
    for known in FORMATS:
        if not known.read_only and path.name.lower().endswith(known.extensions):
            return known
    raise _unknown_extension(path, written_formats())


def _format_in(path: Path, name: str | None) -> Format:
    """The format of a file to be read; other content is refused before a library reads it."""
    if os.path.isdir(path):  # Path.is_dir raises if a name is too long
        if any((path / name).exists() for name in ("hats.properties", "collection.properties")):
            raise InputError(f"{path}: is a HATS catalogue; only two of them are matched together, here give a table")
        raise InputError(f"{path}: is a directory; give a file")
    try:
        os.stat(path)
    except PermissionError:  # the folder may not be looked into, where os.path.exists would answer no
        raise
    except (OSError, ValueError):
        raise InputError(f"{path}: no such file{_similar_names(path)}") from None
    if path.is_fifo():
        raise InputError(f"{path}: is a pipe, and a table is read more than once; save it as a file first")
    first = first_bytes(path)
    if not first:
        raise InputError(f"{path}: is empty")
    text_of_head = in_utf_8(first)
    known = _recognised(path, text_of_head) if name is None else _named(name, path)
    if known is None:
        _check_kind(path, csv.FORMAT, kind_of(first[:4096]), "a table")
        raise _unknown_extension(path, known_formats())
    _check_kind(path, known, kind_of((text_of_head if known in _OF_TEXT else first)[:4096]))
    return known


def _recognised(path: Path, first: bytes) -> Format | None:
    """The format of a file: by its extension, or by its first bytes for text and unknown extensions."""
    lowered = path.name.lower()
    by_extension = next((known for known in FORMATS if lowered.endswith(known.extensions)), None)
    if by_extension is not None and not lowered.endswith(TEXT_EXTENSIONS):
        return by_extension
    kind = kind_of(first[:4096])
    if kind is not None and kind not in [known.label for known in FORMATS]:
        # Not a table (a web page, a picture …), whatever its text. CSV is the last format with a matching extension.
        return next((known for known in reversed(FORMATS) if lowered.endswith(known.extensions)), None)
    for known in FORMATS:
        signed = bool(known.signatures) and by_extension is None and first.startswith(known.signatures)
        if signed or (known.recognised is not None and known.recognised(path, first)):
            return known
    return by_extension


def _unknown_extension(path: Path, formats: Mapping[str, tuple[str, ...]]) -> InputError:
    every = " ".join(dict.fromkeys(e for extensions in formats.values() for e in extensions if ".gz" not in e))
    suffix = f"the extension {path.suffix!r} is not known" if path.suffix else "the name has no extension"
    return InputError(f"{path}: {suffix}", Message(f"known are {every}, or give ", Argument("format", "NAME")))


def _check_kind(path: Path, known: Format, kind: str | None, wanted: str = "") -> None:
    """Refuses a file of another format, in plain words, before a library reads it. wanted : the format in words."""
    if kind == known.label or (kind is None and known.unmarked):
        return
    remedy = next((remedy for _, other, remedy in _OTHER_SIGNATURES if other == kind), "")
    if kind in {other.label for other in FORMATS}:
        remedy = Message("rename it, or give ", Argument("format", repr(str(kind).lower())))
        kind = f"a {kind} file"
    elif kind == "a web page (HTML)":
        remedy = "the download probably failed"
    elif kind == _UTF_16:
        remedy = "save it as UTF-8"
    reason = f"is {kind}, not {wanted or known.label}" if kind else f"is not a {known.label} file"
    raise InputError(f"{path}: {reason}", remedy)


def _similar_names(path: Path) -> str:
    if not path.parent.is_dir():
        return f": the directory {path.parent} does not exist"
    names = sorted(entry.name for entry in path.parent.iterdir() if not entry.name.startswith("."))
    similar = difflib.get_close_matches(path.name, names, n=3, cutoff=0.6)
    return f"; did you mean {' or '.join(similar)}?" if similar else f" in {path.parent.absolute()}"


def _with_plain_columns(table: Table, path: Path) -> Table:
    """The table with quantities and times as plain columns, and names and units without line breaks."""
    from astropy.table import Column, Table
    from astropy.time import Time
    from astropy.units import Quantity, UnrecognizedUnit

    columns = []
    for name, column in table.columns.items():
        if isinstance(column, Quantity):
            column = Table({name: column})[name]
        elif isinstance(column, Time):
            column = Column(column.isot, name=name)
        elif not isinstance(column, Column):
            kind = type(column).__name__
            raise InputError(f"cannot write {path}: column {name} is a {kind}; write its parts as columns")
        columns.append(column)
    writable = Table(columns, names=_names_of_one_line(table.colnames), meta=table.meta, copy=False)
    for column in writable.columns.values():
        if _NO_NAME.search(str(column.unit or "")):
            column.unit = UnrecognizedUnit(_one_line(str(column.unit)))
    return writable


#: Line ends and control characters, not allowed in column names and units.
_NO_NAME = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028\u2029\ufffe\uffff]")


def _one_line(name: str) -> str:
    return _NO_NAME.sub(lambda match: printable(match[0]), name)


def _names_of_one_line(names: Sequence[str]) -> list[str]:
    """The names without line breaks, still distinct; names without line breaks are unchanged."""
    taken, one_line_names = {name for name in names if not _NO_NAME.search(name)}, []
    for name in names:
        if _NO_NAME.search(name):
            name = begin = _one_line(name)
            number = 1
            while name in taken:
                number += 1
                name = f"{begin}_{number}"
            taken.add(name)
        one_line_names.append(name)
    return one_line_names


def _naming(error: BaseException, path: Path) -> BaseException:
    """The error, with the name of the output."""
    if not isinstance(error, InputError) or str(path) in str(error):
        return error
    return InputError(f"cannot write {path}: {error}")

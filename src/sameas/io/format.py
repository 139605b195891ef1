"""The description of a file format, and what the formats share: provenance as text, units, text cells.

A format is one module with its ``FORMAT``, ``read(path, hdu)``, ``write(table, path, provenance)`` and
``provenance(path)``, or, if it is only read, a function; :data:`sameas.io.tables.FORMATS` lists it. Libraries are
imported inside these functions, so that the list is cheap to import.
"""

from __future__ import annotations

import codecs
import importlib
import json
import os
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from sameas.errors import InputError

if TYPE_CHECKING:
    from astropy.table import Table
    from astropy.units import UnitBase

_SURROGATE = re.compile("[\ud800-\udfff]")
_PLAIN = (".csv", ".tsv", ".tab", ".txt", ".lst", ".dat", ".asc", ".ascii", ".cat", ".tbl", ".ipac", ".mrt",
          ".als", ".coo", ".mag", ".ap", ".nst")  # fmt: skip
#: Extensions of text files, which do not determine the format.
TEXT_EXTENSIONS: tuple[str, ...] = (*_PLAIN, *(f"{extension}.gz" for extension in _PLAIN))
#: The first bytes of texts in UTF-16.
UTF_16 = codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE


@dataclass(frozen=True)
class Format:
    """One format of tables.

    name : as given by users, and of its module in ``sameas.io`` unless it is only read. label : its name in messages.
    extensions : of its files, with their dots.
    signatures : files of the format begin with one of these; may be empty.
    markers : files of the format contain one of these, in lower case, among their first bytes.
    unmarked : whether a file without a known signature or marker may have this format.
    recognised : tests, from the path and the first bytes, whether a text file has this format; its extension may be
        any of ``TEXT_EXTENSIONS``.
    read : the reader of a format that is only read; the others are read by their module.
    several_tables : whether a file may hold several tables, so that ``hdu`` selects one.
    in_pieces : whether a table can be written piece by piece; the module then has
        ``write_pieces(tables, path, provenance)``, which takes tables with the same columns.
    sidecar : whether the provenance goes to a file of its own; the module then has
        ``write_with_sidecar(table, path, provenance, overwrite)``.
    """

    name: str
    label: str
    extensions: tuple[str, ...]
    signatures: tuple[bytes, ...] = ()
    markers: tuple[bytes, ...] = ()
    unmarked: bool = False
    several_tables: bool = False
    in_pieces: bool = False
    sidecar: bool = False
    recognised: Callable[[Path, bytes], bool] | None = None
    read: Callable[[Path], Table] | None = None

    @property
    def read_only(self) -> bool:
        """Whether it is read but not written."""
        return self.read is not None

    def module(self) -> ModuleType:
        """The module that reads and writes the format."""
        return importlib.import_module(f"sameas.io.{self.name}")


class LazyTable(Protocol):
    """A table that is computed when it is written, at once or in pieces with the same columns."""

    @property
    def colnames(self) -> list[str]:
        """Names of the columns."""

    def __len__(self) -> int:
        """Number of rows."""

    def whole(self) -> Table:
        """The table."""

    def pieces(self) -> Iterator[Table]:
        """The table's rows, in order; at least one table."""


# Provenance: how a file was made, as a flat mapping of plain values, and its encoding as text.


def plain(provenance: Mapping[str, Any]) -> dict[str, Any]:
    """The mapping with plain values only: text, whole numbers, floats, truth values, None, lists of these.

    Raises InputError: a key that is not text, or a value of another kind.
    """
    wrong = [key for key in provenance if not isinstance(key, str)]
    if wrong:
        raise InputError(f"provenance: the key {wrong[0]!r} is not text")
    return {key: _plain_value(key, value) for key, value in provenance.items()}


def _plain_value(key: str, value: Any) -> Any:
    if hasattr(value, "tolist"):  # NumPy's scalars and arrays, without importing it
        value = value.tolist()
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if isinstance(value, list | tuple):
        return [_plain_value(key, item) for item in value]
    for kind in (bool, int, float, str):
        # Subclasses (enumerations, astropy's strings) become the plain kind, which every format can spell.
        if isinstance(value, kind):
            return kind(value)
    if value is None:
        return None
    raise InputError(f"provenance: {key} is a {type(value).__name__}; give text, numbers, truth values or lists")


def to_json(provenance: Mapping[str, Any]) -> str:
    """JSON in one line of ASCII, without the apostrophes and ampersands that FITS cards treat specially."""
    return json.dumps(provenance).replace("'", "\\u0027").replace("&", "\\u0026")


def json_text(facts: Mapping[str, Any]) -> str:
    """Indented JSON that can be encoded as UTF-8.

    A file name with bytes that are not UTF-8 has surrogates in Python; then everything but ASCII is escaped.
    """
    text = json.dumps(facts, indent=1, ensure_ascii=False)
    return (text if text.isascii() or not _SURROGATE.search(text) else json.dumps(facts, indent=1)) + "\n"


def to_text(value: object) -> str:
    """One value as text: a string unchanged where it cannot be mistaken for another value, else JSON."""
    if isinstance(value, str) and value.isprintable() and value.strip() == value and from_text(value) == value:
        return value
    return json.dumps(value)


def from_text(text: str) -> Any:
    """The value that :func:`to_text` encoded."""
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return text


# Units.

#: A power with an exponent of four or more digits, which no real unit has; astropy would compute it.
_HUGE_POWER = re.compile(r"(?:\*\*|\^|10[+-])[\s(+-]*\d{4,}")


def has_huge_power(unit: str) -> bool:
    """Whether a unit has a power that takes astropy minutes to compute, such as ``10**99999999 deg``."""
    return _HUGE_POWER.search(unit) is not None


def unit_of(text: str, format: str | None = None) -> UnitBase:
    """The unit of a text; an ``UnrecognizedUnit`` where the text is not a unit."""
    from astropy.units import Unit, UnrecognizedUnit

    return UnrecognizedUnit(text) if has_huge_power(text) else Unit(text, format=format, parse_strict="silent")


# Text cells: bytes to Unicode and back, for whole columns at once.
#
# NumPy converts cell by cell; nearly all text in catalogues is ASCII, where it is enough to widen the bytes.


#: Bytes from which UTF-16 without a byte order mark is recognised, and the least of them.
_MARKLESS_BYTES, _LEAST_BYTES = 64, 8
#: Least share of Latin letters among the first letters of a text (chosen; names of columns are Latin).
_LATIN = 0.75
_PRINTED = frozenset(b"\t\n\r") | frozenset(range(32, 127))


def utf_16_of(first: bytes) -> str | None:
    """The variant of UTF-16 of a text by its first bytes: with a byte order mark, or without one if it begins with
    mostly Latin letters, every other byte of which is 0. None for other bytes.

    >>> utf_16_of("ra,dec".encode("utf-16")), utf_16_of("ra,dec".encode("utf-16-be")), utf_16_of(b"ra,dec")
    ('utf-16', 'utf-16-be', None)
    """
    if first[:2] in UTF_16:
        return "utf-16"
    start = first[:_MARKLESS_BYTES]
    for codec, letters, zeros in (("utf-16-le", start[::2], start[1::2]), ("utf-16-be", start[1::2], start[::2])):
        latin = sum(high == 0 and low in _PRINTED for low, high in zip(letters, zeros, strict=False))
        if len(start) >= _LEAST_BYTES and 0 not in letters and latin >= _LATIN * len(zeros):
            return codec
    return None


def in_utf_8(content: bytes) -> bytes:
    """UTF-16 text, as spreadsheets and Windows save it, in UTF-8; all other bytes unchanged.

    >>> in_utf_8("ra,dec".encode("utf-16")), in_utf_8(b"ra,dec")
    (b'ra,dec', b'ra,dec')
    """
    codec = utf_16_of(content)
    if codec is None:
        return content
    try:
        # Of the beginning of a file, the last letter may be half.
        text = codecs.getincrementaldecoder(codec)().decode(content)
    except UnicodeDecodeError:
        return content
    return content if "\0" in text else text.encode("utf-8", "replace")


def unicode_of(cells: NDArray[Any]) -> NDArray[Any]:
    """Unicode cells from bytes: decoded as ASCII, else UTF-8, else Latin-1, which never fails."""
    width = cells.dtype.itemsize
    if width == 0 or cells.size == 0:
        return np.zeros(cells.shape, dtype=f"U{max(width, 1)}")
    codes = np.ascontiguousarray(cells).reshape(-1).view(np.uint8)
    if codes.max() < 128:
        return codes.astype(np.uint32).view(f"U{width}").reshape(cells.shape)
    try:
        return np.char.decode(cells, "utf-8")
    except UnicodeDecodeError:
        return np.char.decode(cells, "latin-1")


def ascii_of(cells: NDArray[Any]) -> NDArray[Any] | None:
    """Bytes from Unicode cells; None where a character is not ASCII."""
    width = cells.dtype.itemsize // 4
    if width == 0 or cells.size == 0:
        return np.zeros(cells.shape, dtype=f"S{max(width, 1)}")
    native = np.ascontiguousarray(cells.astype(cells.dtype.newbyteorder("="), copy=False))
    codes = native.reshape(-1).view(np.uint32)
    if codes.max() > 127:
        return None
    return codes.astype(np.uint8).view(f"S{width}").reshape(cells.shape)

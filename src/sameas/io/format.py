"""What a module of this package says of the format that it reads and writes.

A format is one module with its ``FORMAT``, ``read(path, hdu)``, ``write(table, path, provenance)`` and
``provenance(path)``; :data:`sameas.io.tables.FORMATS` lists it. The module imports the library that it needs inside
these functions, so that the list costs nothing.
"""

from __future__ import annotations

import importlib
import json
import os
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sameas.errors import InputError

if TYPE_CHECKING:
    from astropy.units import UnitBase

_SURROGATE = re.compile("[\ud800-\udfff]")
_PLAIN = (".csv", ".tsv", ".txt", ".dat", ".asc", ".ascii", ".cat", ".tbl", ".ipac", ".mrt")
#: Endings of the names of text files, which do not tell how the text is laid out.
TEXT_EXTENSIONS: tuple[str, ...] = (*_PLAIN, *(f"{extension}.gz" for extension in _PLAIN))


@dataclass(frozen=True)
class Format:
    """One format of tables.

    Attributes
    ----------
    name : of its module in ``sameas.io``. label : how people call it. extensions : of its files, with their dots.
    signatures : a file of the format begins with one of these; empty where it has none.
    markers : a file of the format has one of these, in lower case, among its first bytes.
    unmarked : whether a file of no known kind may be of this format.
    recognised : whether a text file is of this format, by its path and its first bytes: any of ``TEXT_EXTENSIONS``
        may hold it. read_only : whether it is read, never written.
    several_tables : whether a file may hold several tables, so that ``hdu`` chooses one.
    sidecar : whether the provenance goes to a file beside; the module then has
        ``write_with_sidecar(table, path, provenance, overwrite)``.
    """

    name: str
    label: str
    extensions: tuple[str, ...]
    signatures: tuple[bytes, ...] = ()
    markers: tuple[bytes, ...] = ()
    unmarked: bool = False
    several_tables: bool = False
    sidecar: bool = False
    recognised: Callable[[Path, bytes], bool] | None = None
    read_only: bool = False

    def module(self) -> ModuleType:
        """The module that reads and writes it."""
        return importlib.import_module(f"sameas.io.{self.name}")


# How a file was made, kept with it: a flat mapping of plain values, and its spelling as text.


def plain(provenance: Mapping[str, Any]) -> dict[str, Any]:
    """The mapping with plain values only: text, whole numbers, floats, truth values, None, lists of these.

    Raises
    ------
    InputError : a key that is not text, or a value of another kind.
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
    """One line of ASCII without quotes (') and ampersands, which FITS cards treat specially."""
    return json.dumps(provenance).replace("'", "\\u0027").replace("&", "\\u0026")


def json_text(facts: Mapping[str, Any]) -> str:
    """JSON for people, in lines, as a file in UTF-8 may hold it.

    The name of a file may have bytes that are no UTF-8, which Python keeps as surrogates: all but ASCII is escaped.
    """
    text = json.dumps(facts, indent=1, ensure_ascii=False)
    return (text if text.isascii() or not _SURROGATE.search(text) else json.dumps(facts, indent=1)) + "\n"


def to_text(value: Any) -> str:
    """One value as text: a string as it is, where that cannot be taken for another value; else JSON."""
    if isinstance(value, str) and value.isprintable() and value.strip() == value and from_text(value) == value:
        return value
    return json.dumps(value)


def from_text(text: str) -> Any:
    """The value that :func:`to_text` spelled."""
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return text


# Units: what a library makes of them.

#: A power with an exponent of four digits or more, which no unit has; astropy would multiply it out.
_HUGE_POWER = re.compile(r"(?:\*\*|\^|10[+-])[\s(+-]*\d{4,}")


def has_huge_power(unit: str) -> bool:
    """Whether a unit has a power that astropy would compute for minutes, such as ``10**99999999 deg``."""
    return _HUGE_POWER.search(unit) is not None


def unit_of(text: str, format: str | None = None) -> UnitBase:
    """The unit that a text names; an ``UnrecognizedUnit`` where it names none."""
    from astropy.units import Unit, UnrecognizedUnit

    return UnrecognizedUnit(text) if has_huge_power(text) else Unit(text, format=format, parse_strict="silent")


# Cells of text: bytes to Unicode and back, for whole columns at once.
#
# NumPy converts one cell after the other; nearly all text in catalogues is ASCII, where widening is enough.


def unicode_of(cells: NDArray[Any]) -> NDArray[Any]:
    """Unicode cells from bytes: ASCII, else UTF-8, else Latin-1, in which every byte means something."""
    width = cells.dtype.itemsize
    if width == 0 or cells.size == 0:
        return np.zeros(cells.shape, dtype=f"U{max(width, 1)}")
    numbers = np.ascontiguousarray(cells).reshape(-1).view(np.uint8)
    if numbers.max() < 128:
        return numbers.astype(np.uint32).view(f"U{width}").reshape(cells.shape)
    try:
        return np.char.decode(cells, "utf-8")
    except UnicodeDecodeError:
        return np.char.decode(cells, "latin-1")


def ascii_of(cells: NDArray[Any]) -> NDArray[Any] | None:
    """Bytes from Unicode cells; None when a letter is not ASCII."""
    width = cells.dtype.itemsize // 4
    if width == 0 or cells.size == 0:
        return np.zeros(cells.shape, dtype=f"S{max(width, 1)}")
    native = np.ascontiguousarray(cells.astype(cells.dtype.newbyteorder("="), copy=False))
    numbers = native.reshape(-1).view(np.uint32)
    if numbers.max() > 127:
        return None
    return numbers.astype(np.uint8).view(f"S{width}").reshape(cells.shape)

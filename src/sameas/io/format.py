"""What a module of this package says of the format that it reads and writes.

A format is one module with its ``FORMAT``, ``read(path, hdu)``, ``write(table, path, provenance)`` and
``provenance(path)``; :data:`sameas.io.tables.FORMATS` lists it. The module imports the library that it needs inside
these functions, so that the list costs nothing.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

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

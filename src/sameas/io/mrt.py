"""CDS and machine-readable tables: fixed columns, defined by a "Byte-by-byte Description"; parsed by astropy.

The description precedes the rows (machine-readable tables) or is in the file ReadMe of the folder (CDS).
"""

from __future__ import annotations

import re
import warnings
from pathlib import Path
from typing import TYPE_CHECKING

from sameas.io.csv import content_of
from sameas.io.format import Format

if TYPE_CHECKING:
    from astropy.table import Table

_BYTES = b"Byte-by-byte Description of file"
#: Title with the names of files, head of the columns, columns; a rule of dashes after each.
_SECTION = re.compile(rf"(?m)^{_BYTES.decode()}:?(.*)\n-{{3,}}.*\n.*Bytes.*\n-{{3,}}.*\n(?:[^-].*\n)+-{{3,}}.*\n")


def has_description(path: Path, first: bytes) -> bool:
    """Whether the file, or the ReadMe in its folder, has a byte-by-byte description."""
    return _BYTES in first or _description(path) != ""


FORMAT = Format(
    "mrt",
    "CDS table",
    (".mrt", ".dat", ".mrt.gz", ".dat.gz"),
    unmarked=True,
    read_only=True,
    recognised=has_description,
)


def read(path: Path, hdu: None) -> Table:
    """The table of a CDS or machine-readable file."""
    from astropy.io import ascii as text_tables

    text = memoryview(content_of(path)).tobytes().decode("utf-8", "replace")
    if _BYTES.decode() not in text:
        # The layout of machine-readable tables: description, rule, rows.
        text = _description(path) + text
    with warnings.catch_warnings():
        # Units outside the standard are kept as text.
        warnings.simplefilter("ignore")
        return text_tables.read(text.splitlines(), format="cds")


def _description(path: Path) -> str:
    """The byte-by-byte description of a file in the ReadMe of its folder; empty where there is none."""
    for name in ("ReadMe", "readme", "README", "ReadMe.txt"):
        readme = path.with_name(name)
        if readme.is_file():
            for section in _SECTION.finditer(readme.read_text("utf-8", "replace")):
                if path.name.removesuffix(".gz") in section[1].split():
                    return section[0]
    return ""

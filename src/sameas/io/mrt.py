"""Tables of journals and of the CDS: columns by their bytes, given in a "Byte-by-byte Description"; read by astropy.

The description stands above the rows (machine-readable tables) or in the file ReadMe beside (``table.dat`` of the CDS).
"""

from __future__ import annotations

import re
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sameas.io.ascii import rows_content_of
from sameas.io.format import Format

if TYPE_CHECKING:
    from astropy.table import Table

_BYTES = b"Byte-by-byte Description of file"
#: Title with the names of files, head of the columns, columns, each behind a line.
_SECTION = re.compile(rf"(?m)^{_BYTES.decode()}:?(.*)\n-{{3,}}.*\n.*Bytes.*\n-{{3,}}.*\n(?:[^-].*\n)+-{{3,}}.*\n")


def has_description(path: Path, first: bytes) -> bool:
    """Whether the file describes its bytes, or the ReadMe beside it does."""
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

    text = memoryview(rows_content_of(path)).tobytes().decode("utf-8", "replace")
    if _BYTES.decode() not in text:
        # As the machine-readable tables have it: the description, a line, the rows.
        text = _description(path) + text
    with warnings.catch_warnings():
        # Units beyond the standard stay what they are.
        warnings.simplefilter("ignore")
        return text_tables.read(text.splitlines(), format="cds")


def provenance(path: Path) -> dict[str, Any]:
    """Such files do not say how they were made."""
    return {}


def _description(path: Path) -> str:
    """What the ReadMe beside a file says of its bytes; empty where there is none."""
    for name in ("ReadMe", "readme", "README", "ReadMe.txt"):
        beside = path.with_name(name)
        if beside.is_file():
            for section in _SECTION.finditer(beside.read_text("utf-8", "replace")):
                if path.name.removesuffix(".gz") in section[1].split():
                    return section[0]
    return ""

"""Content: the bytes and lines of a file, whatever is wrong with single ones."""

from __future__ import annotations

import gzip
import os
import zlib
from pathlib import Path

from sameas.errors import InputError


def content(path: str | os.PathLike[str]) -> bytes:
    """All bytes of a file, unpacked where it is gzipped.

    Raises
    ------
    InputError : no such file, a directory, empty, a packed file cut off.
    """
    path = Path(path)
    if path.is_dir():
        raise InputError(f"{path}: is a directory; give a file")
    if not path.exists():
        raise InputError(f"{path}: no such file")
    found = path.read_bytes()
    if found[:2] == b"\x1f\x8b":
        try:
            found = gzip.decompress(found)
        except (EOFError, zlib.error, gzip.BadGzipFile) as error:
            raise InputError(f"{path}: is cut off in the middle; copy it again") from error
    if not found:
        raise InputError(f"{path}: is empty")
    return found


def lines_of(found: bytes) -> list[str]:
    """Its lines; line 1 is the first. Bytes that are no UTF-8 become replacement characters."""
    return (
        found.decode("utf-8-sig", errors="replace").replace("\r\n", "\n").replace("\r", "\n").rstrip("\n").split("\n")
    )

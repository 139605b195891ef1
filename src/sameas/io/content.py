"""What a file holds, judged by its first bytes; used to say what is wrong before a library fails on it."""

from __future__ import annotations

import gzip
import hashlib
import os
import zlib
from pathlib import Path

from sameas.errors import InputError

_SIGNATURES = (
    (b"SIMPLE  =", "FITS"),
    (b"PAR1", "Parquet"),
    (b"# %ECSV", "ECSV"),
    (b"\x89PNG", "a PNG picture"),
    (b"\xff\xd8\xff", "a JPEG picture"),
    (b"GIF8", "a GIF picture"),
    (b"%PDF", "a PDF document"),
    (b"PK\x03\x04", "a ZIP archive or a spreadsheet (.xlsx)"),
    (b"\xd0\xcf\x11\xe0", "an old spreadsheet (.xls)"),
    (b"\x89HDF", "an HDF5 file"),
    (b"BZh", "a bzip2 file"),
    (b"\xfd7zXZ", "an xz file"),
    (b"\x28\xb5\x2f\xfd", "a zstd file"),
    (b"\x1f\x8b", "a gzip file"),
)


def checksum(path: str | os.PathLike[str]) -> str:
    """The SHA-256 of a file, in hexadecimal digits.

    Raises
    ------
    InputError : the file cannot be read.
    """
    try:
        with open(path, "rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error


def first_bytes(path: Path, count: int = 4096) -> bytes:
    """The first ``count`` bytes of a file, unpacked when it is gzipped and its name ends in .gz."""
    try:
        if path.suffix.lower() == ".gz":
            with gzip.open(path) as file:
                return file.read(count)
        with path.open("rb") as file:
            return file.read(count)
    except (gzip.BadGzipFile, zlib.error) as error:
        raise InputError(f"{path}: is not a gzip file, though its name ends in .gz") from error
    except EOFError as error:
        raise InputError(f"{path}: is cut off in the middle; copy it again") from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error


def kind_of(first: bytes) -> str | None:
    """What its first bytes say that a file is: the label of a format, other words, or None."""
    for signature, kind in _SIGNATURES:
        if first.startswith(signature):
            return kind
    text = first.removeprefix(b"\xef\xbb\xbf").lstrip().lower()
    if text.startswith((b"<!doctype html", b"<html")):
        return "a web page (HTML)"
    if b"<votable" in text or b":votable" in text:
        return "VOTable"
    if text.startswith(b"<?xml"):
        return "an XML file without a table"
    if text.startswith((b"{", b"[{")):
        return "a JSON file"
    return "a binary file" if b"\x00" in first else None

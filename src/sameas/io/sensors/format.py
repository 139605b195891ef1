"""A format of sensor files: its name, how its files are recognised, and how they are read.

A format is a module of this package with a ``FORMAT``, listed in :data:`sameas.io.sensors.sources.FORMATS`.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from sameas.bounds import MAGIC, unpacked
from sameas.errors import InputError
from sameas.io.sensors.clock import started
from sameas.tracks.reports import Reports

#: Bytes at the start of a file, and lines of them, by which its format is recognised.
HEAD_BYTES, HEAD_LINES = 65536, 200


@dataclass(frozen=True)
class ReadOptions:
    """Options of reading that a file does not have itself.

    source : the name of the source in messages; the name of the file if not given.
    format : one of :data:`REPORT_FORMATS`, where the content does not show it.
    start : UTC of the first line as ISO text or seconds, for files with the time of day only, or with counters.
    columns : tables only: by quantity (``lat_deg``, ``time_s`` …) the name of the column that it is.
    units : tables only: by name of a column its unit.
    """

    source: str | None = None
    format: str | None = None
    start: str | float | None = None
    columns: Mapping[str, str] | None = None
    units: Mapping[str, str] | None = None


@dataclass(frozen=True)
class SensorFile:
    """A file to read: its bytes, unpacked, the name of its source, and its options.

    start_s : UTC of the first line, where the user gives it.
    """

    path: Path
    content: bytes
    source: str
    options: ReadOptions
    start_s: float | None = None

    @classmethod
    def of(cls, path: str | os.PathLike[str], options: ReadOptions) -> SensorFile:
        """The file at a path.

        Raises
        ------
        InputError : no such file, a directory, empty, a packed file cut off.
        """
        path = Path(path)
        source = options.source or path.name
        start_s = started(options.start, source)
        return cls(path, content(path), source, options, start_s)

    @cached_property
    def lines(self) -> list[str]:
        """All lines; line 1 is the first."""
        return lines_of(self.content)

    @property
    def unended(self) -> bool:
        """Whether its last line has no end, as where a file was cut off."""
        return not self.content.rstrip(b"\0 \t").endswith((b"\n", b"\r"))

    @cached_property
    def head(self) -> bytes:
        """The first bytes."""
        return self.content[:HEAD_BYTES]

    @cached_property
    def head_lines(self) -> list[str]:
        """The first lines that are not blank, without the blanks around them."""
        return [line.strip() for line in lines_of(self.head)[:HEAD_LINES] if line.strip()]

    def share_of_lines(self, pattern: str) -> float:
        """The share of the first lines that match a pattern from end to end."""
        return sum(re.fullmatch(pattern, line) is not None for line in self.head_lines) / max(len(self.head_lines), 1)


@dataclass(frozen=True)
class SensorFormat:
    """One format.

    name : as ``ReadOptions.format`` names it. label : what it is, in words.
    read : the reports of a file, one for each sensor in it. recognises : whether a file has this format.
    magic : first bytes that no other format has; they are checked before any ``recognises``.
    """

    name: str
    label: str
    read: Callable[[SensorFile], list[Reports]]
    recognises: Callable[[SensorFile], bool]
    magic: tuple[bytes, ...] = ()


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
    content_bytes = path.read_bytes()
    if content_bytes[:2] == MAGIC:
        content_bytes = unpacked(path)
    if not content_bytes:
        raise InputError(f"{path}: is empty")
    return content_bytes


def lines_of(content_bytes: bytes) -> list[str]:
    """Its lines; line 1 is the first. Bytes that are no UTF-8 become replacement characters."""
    return (
        content_bytes.decode("utf-8-sig", errors="replace")
        .replace("\r\n", "\n")
        .replace("\r", "\n")
        .rstrip("\n")
        .split("\n")
    )

"""Bounds on what input may require, so that a small file can neither fill the memory nor take hours.

:func:`unpacked` unpacks gzip, Zstandard and zip within them; :func:`checked_fits` checks the headers of a FITS file
before a library uses them. :func:`memory_left` is the available memory.
"""

from __future__ import annotations

import gzip
import io
import os
import re
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import Any

from sameas.errors import InputError

MAGIC = b"\x1f\x8b"
#: The first bytes of files packed with Zstandard, and of zip archives.
ZSTD, ZIP = b"\x28\xb5\x2f\xfd", b"PK\x03\x04"
_PART = 1 << 22


@dataclass(frozen=True)
class Unpacking:
    """Greatest size of an unpacked file: ``least`` bytes in any case, or ``ratio`` times its packed size.

    Catalogues shrink three to twentyfold, blank images up to a thousandfold; zeros alone shrink further.
    """

    least: int = 1 << 28
    ratio: int = 100

    def of(self, size: int) -> int:
        """The greatest number of bytes for a file of ``size`` bytes."""
        return max(self.least, self.ratio * size)


#: Of a text with a table: catalogues shrink three to twentyfold, and rows take more time and memory than their bytes.
TEXT_UNPACKING = Unpacking(least=1 << 25, ratio=30)


def unpacked(path: str | os.PathLike[str], bounds: Unpacking | None = None) -> bytes:
    """All bytes of a file packed with gzip or Zstandard, or of the only file in a zip archive.

    Raises InputError: it is cut off, damaged, or unpacks to more than its ``bounds``; an archive of several files.
    """
    path = Path(path)
    most = (bounds or Unpacking()).of(path.stat().st_size)
    parts, total = [], 0
    try:
        with _opened(path) as file:
            while part := file.read(_PART):
                parts.append(part)
                total += len(part)
                if total > most:
                    raise InputError(
                        f"{path}: unpacks to more than {most >> 20} MB; unpack it yourself if that is right"
                    )
    except EOFError as error:
        raise InputError(f"{path}: is cut off in the middle; copy it again") from error
    except (zlib.error, gzip.BadGzipFile, zipfile.BadZipFile, NotImplementedError, RuntimeError, OSError) as error:
        raise InputError(f"{path}: is damaged, it cannot be unpacked ({error}); copy it again") from error
    return b"".join(parts)


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """The unpacked content of a packed file, to be read in parts."""
    with path.open("rb") as raw:
        first = raw.read(4)
    if first == ZSTD:
        import pyarrow as pa

        with pa.input_stream(str(path), compression="zstd") as file:
            yield file
    elif first == ZIP:
        with zipfile.ZipFile(path) as archive:
            names = [one.filename for one in archive.infolist() if not one.is_dir() and "__MACOSX" not in one.filename]
            if len(names) != 1:
                raise InputError(f"{path}: is an archive of {len(names)} files; unpack it, and give the files")
            with archive.open(names[0]) as file:
                yield file
    else:
        with gzip.open(path) as file:
            yield file


def memory_left(system: Path = Path("/")) -> int | None:
    """Bytes that this process may still take: the least left by its limits, its container and the machine.

    None if all are unknown (on Windows). system : the root of Linux' system files.
    """
    left = [_within_limit(system), _within_container(system), _of_machine(system)]
    return min((max(one, 0) for one in left if one is not None), default=None)


def _within_limit(system: Path) -> int | None:
    """Bytes left by ``ulimit -v``."""
    try:
        import resource
    except ImportError:
        return None
    most = resource.getrlimit(resource.RLIMIT_AS)[0]
    used = _first_number(system / "proc/self/statm")
    return None if most == resource.RLIM_INFINITY or used is None else most - used * resource.getpagesize()


def _within_container(system: Path) -> int | None:
    """Bytes left by the control group of the process; that of a container is at the root."""
    most, used = (_first_number(system / f"sys/fs/cgroup/memory.{name}") for name in ("max", "current"))
    return None if most is None or used is None else most - used


def _of_machine(system: Path) -> int | None:
    """Free bytes; half of all memory if unknown."""
    with suppress(OSError):
        for line in (system / "proc/meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) << 10
    names = getattr(os, "sysconf_names", {})
    if "SC_PHYS_PAGES" in names and "SC_PAGE_SIZE" in names:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // 2
    return None


def _first_number(path: Path) -> int | None:
    """The number at the beginning of a file; None if there is none."""
    try:
        return int(path.read_text().split()[0])
    except (OSError, ValueError):  # "max" means no limit
        return None


#: Columns of a table: the widest known catalogues have a thousand; a file of 400 kB can name a hundred thousand.
MOST_COLUMNS = 5000
#: A file may always have this many rows, and more in proportion to its size.
MOST_ROWS, ROWS_PER_BYTE = 10_000_000, 4
#: Values of the metadata, each counted as often as it is referenced: YAML can repeat a value a thousand million times.
MOST_FACTS = 1_000_000


def check_columns(count: int, path: str | os.PathLike[str]) -> None:
    """Refuse a table with more columns than any real one has."""
    if count > MOST_COLUMNS:
        raise InputError(
            f"{path}: has {count} columns; tables of up to {MOST_COLUMNS} are read; leave out what is not needed"
        )


def check_rows(count: int, path: str | os.PathLike[str]) -> None:
    """Refuse a file of so few bytes a row that it cannot hold positions: rows that are all equal take no space."""
    size = os.path.getsize(path)
    if count > max(MOST_ROWS, ROWS_PER_BYTE * size):
        raise InputError(
            f"{path}: claims {count} rows in {size} bytes, which cannot hold a position each; is it the right file?"
        )


def check_facts(facts: Mapping[Any, Any], path: str | os.PathLike[str]) -> None:
    """Refuse metadata that expand to more values than any real table has, or that contain themselves."""
    if _unfolded(facts, MOST_FACTS + 1, {}) > MOST_FACTS:
        raise InputError(f"{path}: its metadata unfold to more than {MOST_FACTS} values; leave them out")


def _unfolded(value: object, endless: int, counts: dict[int, int]) -> int:
    """The number of values in a value, ``endless`` if it contains itself; counts : by id, those counted already."""
    if not isinstance(value, Mapping | list | tuple):
        return 1
    if id(value) not in counts:
        counts[id(value)] = endless
        inner = value.values() if isinstance(value, Mapping) else value
        counts[id(value)] = 1 + sum(_unfolded(one, endless, counts) for one in inner)
    return counts[id(value)]


@dataclass(frozen=True)
class Headers:
    """Limits on headers, which astropy does not check: it would look for a thousand million columns.

    cards : of one header; the largest known ones, of mosaics with their histories, have 30 000.
    axes, fields : those of the standard (FITS 4.0, sections 4.4.1 and 7.3.1).
    shrunk : greatest compression of an image, at 8 bytes a pixel, beyond ``least`` bytes.
    """

    cards: int = 100_000
    axes: int = 999
    fields: int = 999
    shrunk: int = 1000
    least: int = 1 << 27


_BLOCK, _CARD_BYTES = 2880, 80
_BEGIN = re.compile(rb"SIMPLE  = +[TF] |XTENSION= *'[A-Z0-9 ]*' *(?:/| {20})")
_FORM = re.compile(rb"(TFORM\d+) *= *' *(\d*)([LXBIJKAEDCMPQ])")
#: Bits of one value of a column of a binary table (FITS 4.0, table 18).
_BITS = {b"X": 1, b"L": 8, b"B": 8, b"A": 8, b"I": 16, b"J": 32, b"E": 32, b"K": 64, b"D": 64, b"C": 64, b"M": 128,
         b"P": 64, b"Q": 128}  # fmt: skip
#: Cards that count something; a library multiplies them without a check.
_COUNTS = re.compile(rb"(Z?(BITPIX|NAXIS\d*|PCOUNT|GCOUNT)|TFIELDS|ZTILE\d*) *$")
_WHOLE = re.compile(rb"([A-Z0-9_-]{1,8}) *= *([+-]?\d+) *(?:/|$)")


def checked_fits(path: Path, limits: Headers | None = None) -> Path | io.BytesIO:
    """What astropy may open: the path, or all bytes of a packed file, where it may search endlessly for a next header.

    Headers that require more than the file can contain are refused.

    Raises InputError: a header without an end; impossible axes, columns, rows or sizes; see :func:`unpacked`.
    """
    limits = limits or Headers()
    size = path.stat().st_size
    with path.open("rb") as file:
        if file.read(2) != MAGIC:
            _check_headers(file, path, size, size, limits)
            return path
    content = unpacked(path)
    _check_headers(io.BytesIO(content), path, len(content), size, limits)
    return io.BytesIO(content)


def _check_headers(file: Any, path: Path, length: int, size: int, limits: Headers) -> None:
    """Check all headers. length : of the unpacked file. size : of the file, which may be packed."""
    at, number = 0, 0
    while at < length:
        file.seek(at)
        cards = _whole_numbers(file, path, number, limits)
        if not cards:
            return
        at = file.tell() + _data_bytes(cards, path, number, size, limits)
        at += -at % _BLOCK
        number += 1


def _whole_numbers(file: Any, path: Path, number: int, limits: Headers) -> dict[str, int]:
    """The integers of the next header by keyword, the first of duplicates; empty after the last header."""
    cards: dict[str, int] = {}
    is_header = True
    for _ in range(0, limits.cards, _BLOCK // _CARD_BYTES):
        block = file.read(_BLOCK)
        if not cards:
            is_header = block.startswith((b"SIMPLE  =", b"XTENSION="))
            if is_header and not _BEGIN.match(block):
                raise InputError(f"{path}: extension {number} begins with {block[:30]!r}; it is damaged, copy it again")
            cards[""] = 0
        for begin in range(0, len(block), _CARD_BYTES):
            card = block[begin : begin + _CARD_BYTES]
            if card.rstrip() == b"END":
                return cards
            if match := _WHOLE.match(card):
                cards.setdefault(match[1].decode("ascii"), int(match[2]))
            elif is_header and _COUNTS.match(card[:8]):
                raise InputError(
                    f"{path}: the header of extension {number} has no whole number in {card[:8].decode().strip()}; "
                    "it is damaged, copy it again"
                )
            elif match := _FORM.match(card):
                cells = (int(match[2] or 1) * _BITS[match[3]] + 7) // 8
                cards[match[1].decode("ascii")] = cells
        if len(block) < _BLOCK:
            break
    if not is_header:  # bytes after the last extension are ignored
        return {}
    raise InputError(f"{path}: the header of extension {number} has no END; it is damaged or cut off, copy it again")


def _data_bytes(cards: Mapping[str, int], path: Path, number: int, size: int, limits: Headers) -> int:
    """The number of bytes of data after a header."""

    def refuse(what: str) -> InputError:
        return InputError(f"{path}: the header of extension {number} {what}; it is damaged, copy it again")

    most = {"NAXIS": limits.axes, "TFIELDS": limits.fields, "ZNAXIS": limits.axes}
    for name, highest in most.items():
        if not 0 <= cards.get(name, 0) <= highest:
            raise refuse(f"says {name} = {cards[name]}, not 0 to {highest}")
    axes = [cards.get(f"NAXIS{k}", 0) for k in range(1, cards.get("NAXIS", 0) + 1)]
    for name, value in [*((f"NAXIS{k}", axis) for k, axis in enumerate(axes, 1)), *_counts(cards)]:
        if value < 0:
            raise refuse(f"says {name} = {value}")
    if "TFIELDS" in cards and len(axes) == 2 and axes[0] == 0 < axes[1]:
        raise refuse(f"says {axes[1]} rows without a byte in them")
    row = sum(cards.get(f"TFORM{k}", 0) for k in range(1, cards.get("TFIELDS", 0) + 1))
    if axes and row > axes[0]:
        raise refuse(f"says columns of {row} bytes in rows of {axes[0]}")
    image = [cards.get(f"ZNAXIS{k}", 0) for k in range(1, cards.get("ZNAXIS", 0) + 1)]
    if image and 8 * prod(image) > max(limits.least, limits.shrunk * size):
        raise refuse(f"says a compressed image of {' × '.join(map(str, image))} pixels, in a file of {size} bytes")
    axes = axes[1:] if axes[:1] == [0] and "GROUPS" in cards else axes
    values = prod(axes) if axes else 0
    return abs(cards.get("BITPIX", 8)) // 8 * cards.get("GCOUNT", 1) * (cards.get("PCOUNT", 0) + values)


def _counts(cards: Mapping[str, int]) -> list[tuple[str, int]]:
    return [(name, cards[name]) for name in ("PCOUNT", "GCOUNT") if name in cards]

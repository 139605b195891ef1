"""Chart tiles of the user: the pictures of an MBTiles or a PMTiles file, by zoom, column and row.

Tiles are squares of Web Mercator: at zoom z the world has 2^z columns from 180° W and 2^z rows from 85.05° N. MBTiles
1.3 is an SQLite file that counts rows from the south. PMTiles 3 has directories, sorted by the number of a tile on a
Hilbert curve, in front of the tiles.

PMTiles are read here, in some eighty lines, and not with a library: the directories are all that there is to read.
"""

from __future__ import annotations

import html
import json
import math
import os
import re
import sqlite3
import struct
import zlib
from bisect import bisect_right
from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

from sameas.errors import InputError, printable

#: First bytes of the files.
_SQLITE, _PMTILES = b"SQLite format 3\0", b"PMTiles"
#: First bytes of the pictures that are served, and their media types.
_PICTURES = ((b"\x89PNG\r\n\x1a\n", "image/png"), (b"\xff\xd8\xff", "image/jpeg"), (b"RIFF", "image/webp"))
#: Formats of tiles in a PMTiles header, by number.
_PMTILES_KINDS = {1: "pbf", 2: "png", 3: "jpg", 4: "webp", 5: "avif"}
#: Deepest zoom: a tile is then smaller than 5 mm.
DEEPEST = 32
#: Largest directory and largest tile in bytes; larger ones are of a damaged file.
_MOST_DIRECTORY, _MOST_TILE = 64 << 20, 16 << 20
#: Levels of directories below the first one; files have one or two.
_MOST_LEVELS = 4
#: Directories that are kept unpacked.
_KEPT_DIRECTORIES = 64
#: What reading a damaged file raises.
_DAMAGED = (sqlite3.Error, OverflowError, EOFError, zlib.error, ValueError, IndexError, struct.error)


@dataclass(frozen=True)
class Chart:
    """What a tile file has. Make it with :func:`open_chart`.

    zooms : the least and the deepest. bounds_deg : west, south, east and north. credit : plain text that must be shown.
    """

    path: Path
    zooms: tuple[int, int]
    bounds_deg: tuple[float, float, float, float]
    credit: str
    _tiles: _MBTiles | _PMTiles = field(repr=False, compare=False)

    def tile(self, zoom: int, column: int, row: int) -> tuple[bytes, str] | None:
        """The picture of a tile and its media type; None where the chart has none. Rows are counted from the north.

        Raises InputError: the file cannot be read there, or the tile is no picture.
        """
        if not (0 <= zoom <= DEEPEST and 0 <= column < 1 << zoom and 0 <= row < 1 << zoom):
            return None
        where = f"{self.path}: tile {zoom}/{column}/{row}"
        try:
            data = self._tiles.tile(zoom, column, row)
        except (OSError, *_DAMAGED) as error:
            raise InputError(f"{where} cannot be read ({error})", "the file is damaged; copy it again") from None
        if not data:
            return None
        kind = _media_type(data)
        if kind is None:
            raise InputError(f"{where} is no picture", "give a chart of PNG, JPEG or WebP tiles")
        return data, kind


def is_tiles(path: str | os.PathLike[str]) -> bool:
    """Whether a file is MBTiles or PMTiles, by its first bytes; False where it cannot be read."""
    try:
        with open(path, "rb") as file:
            head = file.read(len(_SQLITE))
    except OSError:
        return False
    return head == _SQLITE or head.startswith(_PMTILES)


def open_chart(path: str | os.PathLike[str]) -> Chart:
    """The chart of an MBTiles or PMTiles file.

    Raises InputError: the file cannot be read, is damaged, has vector tiles, or has none.
    """
    path = Path(path)
    try:
        with open(path, "rb") as file:
            base = file.read(len(_SQLITE)) == _SQLITE
        opened = _MBTiles(path) if base else _PMTiles(path)
        kind, about = opened.kind, opened.about
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    except _DAMAGED as error:
        raise InputError(
            f"{path}: its tiles cannot be read ({error})", "give a whole file of MBTiles 1.3 or PMTiles 3"
        ) from None
    if kind in ("pbf", "mvt", "application/x-protobuf"):
        raise InputError(
            f"{path}: has vector tiles, which are not drawn",
            "give a chart of PNG, JPEG or WebP tiles, or its land and shores as GeoJSON (ogr2ogr converts them)",
        )
    if kind not in ("png", "jpg", "jpeg", "webp"):
        raise InputError(f"{path}: its tiles are {kind or 'of no known format'}", "give PNG, JPEG or WebP tiles")
    credit = printable(" ".join(html.unescape(re.sub(r"<[^>]*>", "", str(about.get("attribution") or ""))).split()))
    return Chart(path, opened.zooms, opened.bounds_deg, credit[:300], opened)


def _media_type(data: bytes) -> str | None:
    kind = next((kind for magic, kind in _PICTURES if data.startswith(magic)), None)
    return None if kind == "image/webp" and data[8:12] != b"WEBP" else kind


def _bounds(given: tuple[float, ...]) -> tuple[float, float, float, float]:
    """The bounds in degrees; those of Web Mercator where they are not known or make no sense."""
    if len(given) == 4 and all(map(math.isfinite, given)):
        west, south, east, north = given
        if -180.0 <= west < east <= 180.0 and -90.0 <= south < north <= 90.0:
            return west, south, east, north
    return -180.0, -85.06, 180.0, 85.06


class _MBTiles:
    """An SQLite file of tiles. It is opened for each request: these come from several threads."""

    def __init__(self, path: Path) -> None:
        self._address = f"{path.resolve().as_uri()}?mode=ro"
        self.about = {str(name): value for name, value in self._rows("SELECT name, value FROM metadata")}
        zooms = self._rows("SELECT MIN(zoom_level), MAX(zoom_level) FROM tiles")[0]
        if zooms[0] is None:
            raise ValueError("there is none")
        if not 0 <= int(zooms[0]) <= int(zooms[1]) <= DEEPEST:
            raise ValueError(f"zooms {zooms[0]} to {zooms[1]}")
        self.zooms = (int(zooms[0]), int(zooms[1]))
        self.kind = str(self.about.get("format") or "").lower() or self._first_kind()
        texts = str(self.about.get("bounds") or "").split(",")
        self.bounds_deg = _bounds(tuple(float(text) for text in texts) if len(texts) == 4 else ())

    def _first_kind(self) -> str:
        kind = _media_type(self._rows("SELECT tile_data FROM tiles LIMIT 1")[0][0])
        return "" if kind is None else kind.removeprefix("image/")

    def _rows(self, words: str, values: tuple[int, ...] = ()) -> list[Any]:
        with closing(sqlite3.connect(self._address, uri=True)) as base:
            return base.execute(words, values).fetchall()

    def tile(self, zoom: int, column: int, row: int) -> bytes | None:
        rows = self._rows(
            "SELECT tile_data FROM tiles WHERE zoom_level = ? AND tile_column = ? AND tile_row = ?",
            (zoom, column, (1 << zoom) - 1 - row),
        )
        return bytes(rows[0][0]) if rows and rows[0][0] is not None else None


@dataclass(frozen=True)
class _Directory:
    """Entries of a PMTiles directory, ascending: number of the first tile; tiles that share the picture, 0 for a
    directory below; place and size."""

    first: tuple[int, ...]
    run: tuple[int, ...]
    offset: tuple[int, ...]
    length: tuple[int, ...]


class _PMTiles:
    """A PMTiles file, version 3 of the specification. It is opened for each request, as MBTiles are."""

    def __init__(self, path: Path) -> None:
        self._path = path
        with open(path, "rb") as file:
            head = file.read(127)
        if not head.startswith(_PMTILES):
            raise ValueError("it is neither MBTiles nor PMTiles")
        if len(head) < 127 or head[7] != 3:
            raise ValueError(f"version {head[7] if len(head) > 7 else '?'} of PMTiles; give version 3")
        self._root, (about_at, about_size), self._leaves, self._data = (
            struct.unpack_from("<QQ", head, 8 + 16 * k) for k in range(4)
        )
        self._packing, tile_packing, kind = head[97], head[98], head[99]
        if self._packing not in (1, 2) or tile_packing not in (0, 1, 2):
            raise ValueError("it is packed by brotli or zstd; give one packed by gzip")
        self._tile_packing, self.kind = tile_packing, _PMTILES_KINDS.get(kind, "")
        self.zooms = (head[100], head[101])
        if not self.zooms[0] <= self.zooms[1] <= DEEPEST:
            raise ValueError(f"zooms {head[100]} to {head[101]}")
        self.bounds_deg = _bounds(tuple(v / 1e7 for v in struct.unpack_from("<iiii", head, 102)))
        self._directory = lru_cache(_KEPT_DIRECTORIES)(self._read_directory)
        self._directory(*self._root)
        about = json.loads(self._unpacked(self._read(about_at, about_size, _MOST_DIRECTORY), self._packing) or b"{}")
        self.about: Mapping[str, Any] = about if isinstance(about, dict) else {}

    def tile(self, zoom: int, column: int, row: int) -> bytes | None:
        number, place = tile_number(zoom, column, row), self._root
        for _ in range(_MOST_LEVELS):
            directory = self._directory(*place)
            k = bisect_right(directory.first, number) - 1
            if k < 0:
                return None
            offset, length = directory.offset[k], directory.length[k]
            if directory.run[k] == 0:
                place = (self._leaves[0] + offset, length)
            elif number < directory.first[k] + directory.run[k]:
                return self._unpacked(self._read(self._data[0] + offset, length, _MOST_TILE), self._tile_packing)
            else:
                return None
        raise ValueError("its directories have no end")

    def _read(self, at: int, size: int, most: int) -> bytes:
        if size > most:
            raise ValueError(f"{size} bytes at {at}")
        with open(self._path, "rb") as file:
            file.seek(at)
            data = file.read(size)
        if len(data) < size:
            raise EOFError("it is cut off")
        return data

    @staticmethod
    def _unpacked(data: bytes, packing: int) -> bytes:
        if packing != 2 or not data:
            return data
        # A few bytes may unpack to many.
        unpacking = zlib.decompressobj(zlib.MAX_WBITS | 16)
        out = unpacking.decompress(data, _MOST_DIRECTORY)
        if unpacking.unconsumed_tail or not unpacking.eof:
            raise ValueError("a part is cut off, or unpacks to too much")
        return out

    def _read_directory(self, at: int, size: int) -> _Directory:
        data = self._unpacked(self._read(at, size, _MOST_DIRECTORY), self._packing)
        numbers = _varints(data)
        n = numbers[0]
        if len(numbers) < 1 + 4 * n:
            raise ValueError("a directory is cut off")
        steps, run, length, placed = (numbers[1 + k * n : 1 + (k + 1) * n] for k in range(4))
        first: list[int] = []
        offset: list[int] = []
        for k in range(n):
            first.append(steps[k] + (first[-1] if k else 0))
            # 0: the tile follows the previous one.
            offset.append(placed[k] - 1 if placed[k] or not k else offset[-1] + length[k - 1])
        return _Directory(tuple(first), tuple(run), tuple(offset), tuple(length))


def _varints(data: bytes) -> list[int]:
    """The numbers in the bytes, seven bits in each, the lowest first; the highest bit says that more follow."""
    numbers, value, shift = [], 0, 0
    for byte in data:
        value |= (byte & 0x7F) << shift
        shift += 7
        if byte < 0x80:
            numbers.append(value)
            value = shift = 0
    return numbers


def tile_number(zoom: int, column: int, row: int) -> int:
    """The number of a tile in PMTiles: all tiles of smaller zooms, and the place on the Hilbert curve of this one.

    >>> [tile_number(0, 0, 0), *(tile_number(1, x, y) for x, y in ((0, 0), (0, 1), (1, 1), (1, 0)))]
    [0, 1, 2, 3, 4]
    """
    place, x, y = 0, column, row
    for side in (1 << k for k in range(zoom - 1, -1, -1)):
        right, lower = int(x & side > 0), int(y & side > 0)
        place += side * side * ((3 * right) ^ lower)
        if not lower:
            if right:
                x, y = side - 1 - x, side - 1 - y
            x, y = y, x
    return (4**zoom - 1) // 3 + place

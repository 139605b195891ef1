"""Chart tiles: the pictures of MBTiles and PMTiles files, and what is refused."""

from __future__ import annotations

import gzip
import json
import sqlite3
import struct
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sameas.errors import InputError
from sameas.maps.tiles import is_tiles, open_chart, tile_number
from sameas.pages import png

STORED = Path(__file__).parent / "data" / "tiles.pmtiles"
JPEG, WEBP = b"\xff\xd8\xff\xe0rest", b"RIFF\x04\0\0\0WEBPrest"


def picture(zoom: int, column: int, row: int) -> bytes:
    """A picture of its own for every tile."""
    return png(np.array([[zoom, column % 256, row % 256]], np.uint8))


TILES = {(z, x, y): picture(z, x, y) for z in range(3, 6) for x in range(1 << z) for y in range(1 << z) if (x + y) % 3}


def mbtiles(path: Path, tiles: Mapping[tuple[int, int, int], Any] = TILES, **about: str) -> Path:
    with closing(sqlite3.connect(path)) as base, base:
        base.execute("CREATE TABLE metadata (name TEXT, value TEXT)")
        base.execute("CREATE TABLE tiles (zoom_level INT, tile_column INT, tile_row INT, tile_data BLOB)")
        base.executemany("INSERT INTO metadata VALUES (?, ?)", list(about.items()))
        base.executemany("INSERT INTO tiles VALUES (?, ?, ?, ?)",
                         [(z, x, (1 << z) - 1 - y, data) for (z, x, y), data in tiles.items()])  # fmt: skip
    return path


def varint(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*out, value])


def directory(entries: list[tuple[int, int, int, int]]) -> bytes:
    """Entries of (number, run, offset, length), each with its offset written in full."""
    firsts = [e[0] for e in entries]
    columns = [[b - a for a, b in zip([0, *firsts], firsts, strict=False)], [e[1] for e in entries],
               [e[3] for e in entries], [e[2] + 1 for e in entries]]  # fmt: skip
    return gzip.compress(b"".join(map(varint, [len(entries), *(v for column in columns for v in column)])), mtime=0)


def pmtiles(path: Path, tiles: Mapping[tuple[int, int, int], Any] = TILES, kind: int = 2, **about: str) -> Path:
    """A file with two levels of directories, four tiles in each of the lower ones."""
    numbered = sorted((tile_number(*place), data) for place, data in tiles.items())
    data, leaves, root = b"", b"", []
    for k in range(0, len(numbered), 4):
        entries = []
        for number, content in numbered[k : k + 4]:
            entries.append((number, 1, len(data), len(content)))
            data += content
        leaf = directory(entries)
        root.append((entries[0][0], 0, len(leaves), len(leaf)))
        leaves += leaf
    parts, zooms = (
        [directory(root), gzip.compress(json.dumps(about).encode(), mtime=0), leaves, data],
        [z for z, *_ in tiles],
    )
    ends = np.cumsum([127, *map(len, parts)]).tolist()
    spans = [value for at, part in zip(ends, parts, strict=False) for value in (at, len(part))]
    head = b"PMTiles\x03" + struct.pack("<11Q", *spans, len(tiles), len(tiles), len(tiles))
    head += bytes([1, 2, 1, kind, min(zooms), max(zooms)]) + struct.pack(
        "<4i", -20000000, 500000000, -10000000, 510000000
    )
    path.write_bytes(head + bytes([3]) + struct.pack("<2i", 0, 0) + b"".join(parts))
    return path


MAKERS: dict[str, Any] = {"mbtiles": mbtiles, "pmtiles": pmtiles}


@pytest.mark.slow
@pytest.mark.parametrize("kind", MAKERS)
def test_every_tile_of_a_file_is_found_and_no_other(tmp_path, kind):
    chart = open_chart(MAKERS[kind](tmp_path / "a", attribution="x"))
    found = {(z, x, y): chart.tile(z, x, y) for z in range(2, 7) for x in range(1 << z) for y in range(1 << z)}
    assert {place: one[0] for place, one in found.items() if one} == TILES
    assert {one[1] for one in found.values() if one} == {"image/png"} and chart.zooms == (3, 5)
    for outside in [(5, 32, 0), (5, 0, 32), (5, -1, 0), (-1, 0, 0), (99, 0, 0)]:
        assert chart.tile(*outside) is None
    # The server reads in threads.
    with ThreadPoolExecutor(4) as threads:
        asked = list(TILES)
        assert [one and one[0] for one in threads.map(lambda place: chart.tile(*place), asked)] == list(TILES.values())


def test_a_file_of_another_program_is_read():
    """tests/data/make_tiles.py wrote it, with the package pmtiles 3.8.1."""
    chart = open_chart(STORED)
    assert chart.zooms == (0, 4) and chart.bounds_deg == (-2.0, 50.0, -1.0, 51.0) and chart.credit == "© Somebody & Co"
    found = {(z, x, y): chart.tile(z, x, y) for z in range(5) for x in range(1 << z) for y in range(1 << z)}
    # Equal neighbours share one entry; every seventh tile is missing.
    for (z, x, y), one in found.items():
        assert (one is None) == ((x + 2 * y + z) % 7 == 6)
        assert one is None or one == (png(np.full((1, 1), 10 * z + (x // 4), np.uint8)), "image/png")


def test_the_metadata_of_mbtiles_are_optional_and_its_credit_is_plain_text(tmp_path):
    bare = open_chart(mbtiles(tmp_path / "bare.mbtiles"))
    assert bare.credit == "" and bare.bounds_deg == (-180.0, -85.06, 180.0, 85.06)
    credit = '<a href="https://example.org" onclick="x()">&copy; Harbour\n office</a> <script>'
    full = open_chart(mbtiles(tmp_path / "full.mbtiles", bounds="-2,50,-1,51", format="png", attribution=credit))
    assert full.credit == "© Harbour office" and full.bounds_deg == (-2.0, 50.0, -1.0, 51.0)
    wrong = open_chart(mbtiles(tmp_path / "wrong.mbtiles", bounds="5,50,-1,51"))
    assert wrong.bounds_deg == bare.bounds_deg


@pytest.mark.parametrize("data, kind", [(JPEG, "image/jpeg"), (WEBP, "image/webp")])
def test_the_media_type_is_that_of_the_picture(tmp_path, data, kind):
    for name, make in MAKERS.items():
        assert open_chart(make(tmp_path / name, {(3, 1, 2): data})).tile(3, 1, 2) == (data, kind)


def test_vector_tiles_are_refused_with_what_to_do(tmp_path):
    vector = mbtiles(tmp_path / "v.mbtiles", {(0, 0, 0): gzip.compress(b"layers")}, format="pbf")
    for path in (vector, pmtiles(tmp_path / "v.pmtiles", {(0, 0, 0): b"layers"}, kind=1)):
        with pytest.raises(InputError, match=r"has vector tiles, which are not drawn; give a chart of PNG.*ogr2ogr"):
            open_chart(path)


def test_a_tile_that_is_no_picture_is_not_served(tmp_path):
    tiles = {(3, 1, 2): b"<svg onload='x()'>", (3, 1, 3): JPEG}
    for path in (mbtiles(tmp_path / "a.mbtiles", tiles, format="png"), pmtiles(tmp_path / "a.pmtiles", tiles)):
        chart = open_chart(path)
        with pytest.raises(InputError, match=r"tile 3/1/2 is no picture"):
            chart.tile(3, 1, 2)
        assert chart.tile(3, 1, 3) is not None


@pytest.mark.parametrize("content, words", [
    (b"PMTiles\x02" + bytes(200), "version 2 of PMTiles; give version 3"),
    (b"PMTiles\x03", r"version \S+ of PMTiles|its tiles cannot be read"),
    (b"PMTiles\x03" + bytes(119), "packed by brotli or zstd"),
    (b"SQLite format 3\0" + bytes(200), "its tiles cannot be read"),
    (b"{}", "neither MBTiles nor PMTiles"),
    (b"", "neither MBTiles nor PMTiles"),
])  # fmt: skip
def test_a_wrong_file_is_refused(tmp_path, content, words):
    (tmp_path / "chart").write_bytes(content)
    with pytest.raises(InputError, match=words):
        open_chart(tmp_path / "chart")


def test_a_database_without_tiles_and_a_missing_file_are_refused(tmp_path):
    with closing(sqlite3.connect(tmp_path / "other")) as base:
        base.execute("CREATE TABLE other (a)")
    with pytest.raises(InputError, match="no such table: metadata"):
        open_chart(tmp_path / "other")
    with pytest.raises(InputError, match=r"there is none.*MBTiles 1.3 or PMTiles 3"):
        open_chart(mbtiles(tmp_path / "empty.mbtiles", {}, format="png"))
    with pytest.raises(InputError, match="nowhere: cannot be read: No such file"):
        open_chart(tmp_path / "nowhere")


@pytest.mark.slow
def test_a_file_that_is_cut_off_is_refused_or_its_tiles_are(tmp_path):
    whole = pmtiles(tmp_path / "whole").read_bytes()
    seen = set()
    for size in range(0, len(whole) - 1, 977):
        (tmp_path / "cut").write_bytes(whole[:size])
        try:
            chart = open_chart(tmp_path / "cut")
        except InputError:
            seen.add("refused")
            continue
        for place, data in TILES.items():
            try:
                assert chart.tile(*place) == (data, "image/png")
                seen.add("right")
            except InputError as error:
                assert "cut off" in str(error) and "copy it again" in str(error)
                seen.add("cut off")
    assert seen == {"refused", "right", "cut off"}


@pytest.mark.slow
def test_a_directory_that_unpacks_to_too_much_is_refused(tmp_path):
    bomb = gzip.compress(bytes(80 << 20))
    head = (
        b"PMTiles\x03"
        + struct.pack("<11Q", 127, len(bomb), 127, 0, 127, 0, 127, 0, 0, 0, 0)
        + bytes([1, 2, 1, 2, 0, 1])
    )
    (tmp_path / "bomb").write_bytes(head.ljust(127, b"\0") + bomb)
    with pytest.raises(InputError, match="unpacks to too much"):
        open_chart(tmp_path / "bomb")


def test_damaged_directories_end_in_a_refusal(tmp_path):
    whole = bytearray(pmtiles(tmp_path / "whole").read_bytes())
    rng, refused = np.random.default_rng(4), 0
    for _ in range(200):
        broken = bytearray(whole)
        for place in rng.integers(8, len(whole), 3).tolist():
            broken[place] = int(rng.integers(256))
        (tmp_path / "broken").write_bytes(broken)
        try:
            chart = open_chart(tmp_path / "broken")
            for place in [(3, 1, 0), (4, 7, 7), (5, 20, 3)]:
                chart.tile(*place)
        except InputError:
            refused += 1
    assert 0 < refused < 200  # some damage is in tiles that are not asked for


def test_tiles_are_recognised_by_their_content(tmp_path):
    assert is_tiles(mbtiles(tmp_path / "a")) and is_tiles(STORED) and not is_tiles(tmp_path / "nowhere")
    (tmp_path / "b.pmtiles").write_text("{}")
    assert not is_tiles(tmp_path / "b.pmtiles")

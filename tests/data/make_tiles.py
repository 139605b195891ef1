"""Writes tiles.pmtiles with the package pmtiles (BSD-3; python make_tiles.py, with pmtiles 3.8.1 installed)."""

from pathlib import Path

import numpy as np
from pmtiles.tile import Compression, TileType, zxy_to_tileid
from pmtiles.writer import Writer

from sameas.pages import png

ABOUT = {
    "tile_type": TileType.PNG, "tile_compression": Compression.NONE,
    "min_lon_e7": -20_000_000, "min_lat_e7": 500_000_000, "max_lon_e7": -10_000_000, "max_lat_e7": 510_000_000,
    "center_zoom": 4, "center_lon_e7": -15_000_000, "center_lat_e7": 505_000_000,
}  # fmt: skip

with (Path(__file__).parent / "tiles.pmtiles").open("wb") as file:
    writer = Writer(file)
    tiles = [(zxy_to_tileid(z, x, y), z, x, y) for z in range(5) for x in range(1 << z) for y in range(1 << z)]
    for number, z, x, y in sorted(tiles):
        if (x + 2 * y + z) % 7 != 6:
            writer.write_tile(number, png(np.full((1, 1), 10 * z + x // 4, np.uint8)))
    writer.finalize(ABOUT, {"attribution": "<b>&copy; Somebody &amp; Co</b>"})

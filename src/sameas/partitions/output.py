"""The output: a HATS collection of the joined catalogue and its margin, each file whole or absent."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sameas.arrays import IntArray
from sameas.io.arrow import array_of
from sameas.io.parquet import column_metadata
from sameas.partitions import healpix
from sameas.partitions.layout import CELL, COLLECTION, Cell, HatsCatalogue, numbers_of

if TYPE_CHECKING:
    import pyarrow as pa
    from astropy.table import Table

#: Rows of a row group: a halo is read in pieces of these.
GROUP_ROWS = 1 << 16


@contextmanager
def _whole(path: Path) -> Iterator[Path]:
    """A file beside ``path`` that comes into its place when the block ends well, and vanishes otherwise."""
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        yield beside
        os.replace(beside, path)
    finally:
        beside.unlink(missing_ok=True)


def written_whole(path: Path, content: bytes) -> None:
    """Puts a file into its place, whole or not at all."""
    with _whole(path) as beside:
        beside.write_bytes(content)


def write_rows(tables: Iterable[pa.Table], path: Path) -> int:
    """Writes a partition's file, whole or not at all, and none where there are no rows; their number.

    tables : its rows, one piece after another, with the columns of the first.
    """
    import pyarrow as pa
    from pyarrow import parquet

    pieces = (table for table in tables if table.num_rows)
    first = next(pieces, None)
    if first is None:
        return 0
    # A dictionary of numbers that are nearly all different costs two thirds of the writing and makes files larger.
    texts = [field.name for field in first.schema if pa.types.is_string(field.type)]
    rows = 0
    with _whole(path) as beside, parquet.ParquetWriter(
        beside, first.schema, compression="zstd", use_dictionary=texts or False
    ) as writer:  # fmt: skip
        for table in chain([first], pieces):
            writer.write_table(table.cast(first.schema), row_group_size=GROUP_ROWS)
            rows += int(table.num_rows)
    return rows


def arrow_of(table: Table, cells: IntArray, facts: Mapping[str, Any]) -> pa.Table:
    """A joined table as a partition has it, with the cells of order 29 of its rows first."""
    import pyarrow as pa

    arrays = [pa.array(cells, pa.int64()), *(array_of(table[name]) for name in table.colnames)]
    fields = [pa.field(CELL, pa.int64())]
    fields += [pa.field(name, array.type, metadata=column_metadata(table[name]))
               for name, array in zip(table.colnames, arrays[1:], strict=True)]  # fmt: skip
    return pa.Table.from_arrays(arrays, schema=pa.schema(fields, metadata={b"sameas": json.dumps(facts).encode()}))


def partition_file(folder: Path, cell: Cell) -> Path:
    """Where a partition of a catalogue lies."""
    place = folder / "dataset" / f"Norder={cell.order}" / f"Dir={cell.number // 10000 * 10000}"
    return place / f"Npix={cell.number}.parquet"


def finish_catalogue(
    folder: Path, cells: Iterable[Cell], properties: Mapping[str, Any], facts: Mapping[str, Any]
) -> int:
    """Writes what a catalogue says of itself, from its partitions; the number of its rows.

    properties : properties besides those that follow from the partitions. facts : how it was made.
    """
    from pyarrow import parquet

    cells = sorted(cells, key=lambda cell: (int(cell.stretch[0, 0]), cell.order))
    collected, schema = [], None
    for cell in cells:
        path = partition_file(folder, cell)
        opened = parquet.ParquetFile(path)
        opened.metadata.set_file_path(str(path.relative_to(folder / "dataset").as_posix()))
        collected.append(opened.metadata)
        schema = opened.schema_arrow if schema is None else schema
    if schema is None:
        raise AssertionError("a catalogue without partitions is not written")
    rows = sum(int(one.num_rows) for one in collected)
    parquet.write_metadata(schema, folder / "dataset" / "_metadata", metadata_collector=collected)
    parquet.write_metadata(schema, folder / "dataset" / "_common_metadata")
    lines = ["Norder,Npix", *(f"{cell.order},{cell.number}" for cell in cells)]
    written_whole(folder / "partition_info.csv", ("\n".join(lines) + "\n").encode())
    size = sum(partition_file(folder, cell).stat().st_size for cell in cells) // 1024
    sky = sum(4.0**-cell.order for cell in cells) / 12.0
    own = {
        "hats_nrows": rows, "hats_order": max(cell.order for cell in cells), "moc_sky_fraction": f"{sky:.6g}",
        "hats_estsize": size, "hats_version": "v1.0", "hats_npix_suffix": ".parquet",
    }  # fmt: skip
    written_whole(folder / "hats.properties", _lines({**properties, **own}))
    written_whole(folder / "sameas.json", json.dumps(facts, indent=1, sort_keys=True).encode() + b"\n")
    return rows


def write_collection(folder: Path, name: str, margin: str | None) -> None:
    """Says which catalogue and margin a folder holds."""
    properties = {"obs_collection": name, "hats_primary_table_url": name}
    if margin is not None:
        properties |= {"all_margins": margin, "default_margin": margin}
    written_whole(folder / COLLECTION, _lines(properties))


def _lines(properties: Mapping[str, Any]) -> bytes:
    """Lines as Java's properties have them: what ends a line or does not show is \\uXXXX."""
    return "".join(f"{_escaped(key)}={_escaped(str(value))}\n" for key, value in properties.items()).encode()


def _escaped(text: str) -> str:
    return "".join(c if c.isprintable() or ord(c) > 0xFFFF else f"\\u{ord(c):04x}" for c in text)


def write_margin(catalogue: HatsCatalogue, cell: Cell, margin_arcsec: float, folder: Path) -> int:
    """Writes the rows around a partition that others hold, for the margin catalogue in a folder; their number."""
    import pyarrow as pa

    order = max(healpix.order_of_width(margin_arcsec), cell.order)
    ring = healpix.ring(np.array([cell.number]), cell.order, order)
    rows = catalogue.rows(healpix.stretches(ring, order))
    if not rows.num_rows:
        return 0
    schema = catalogue.schema
    rows = rows.select(schema.names).cast(pa.schema(list(schema)))
    order_of_rows = np.argsort(numbers_of(rows, CELL), kind="stable")
    rows = rows.take(pa.array(order_of_rows)).replace_schema_metadata(schema.metadata)
    return write_rows([rows], partition_file(folder, cell))


def write_hats(
    table: Table, folder: Path, *, ra: str = "ra", dec: str = "dec", cells: Iterable[Cell] | None = None,
    most_rows: int = 1_000_000,
) -> list[Cell]:  # fmt: skip
    """Writes a table as a HATS catalogue; its partitions.

    ra, dec : columns of positions, degrees. cells : the partitions; if not given, of at most ``most_rows`` rows each.
    """
    position = np.column_stack([np.asarray(table[ra], np.float64), np.asarray(table[dec], np.float64)])
    place = healpix.cells_of(position, healpix.FINEST)
    order = np.argsort(place, kind="stable")
    table, place = table[order], place[order]
    wanted = [Cell(0, k) for k in range(12)] if cells is None else cells
    chosen = [one for cell in wanted for one in (_parts(cell, place, most_rows) if cells is None else [cell])]
    full = []
    for cell in chosen:
        begin, end = np.searchsorted(place, cell.stretch[0])
        if begin < end:
            write_rows([arrow_of(table[begin:end], place[begin:end], {})], partition_file(folder, cell))
            full.append(cell)
    properties = {"obs_collection": folder.name, "dataproduct_type": "object", "hats_col_ra": ra, "hats_col_dec": dec,
            "hats_col_healpix": CELL, "hats_col_healpix_order": healpix.FINEST, "hats_builder": "sameas"}  # fmt: skip
    finish_catalogue(folder, full, properties, {})
    return full


def _parts(cell: Cell, place: IntArray, most_rows: int) -> list[Cell]:
    """A cell, or those within it that hold no more rows than that."""
    begin, end = np.searchsorted(place, cell.stretch[0])
    if end - begin <= most_rows or cell.order == 20:
        return [cell] if begin < end else []
    return [one for part in cell.inner for one in _parts(part, place, most_rows)]

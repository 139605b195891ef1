"""Writing a HATS collection of the joined catalogue and its margin; every file is complete or absent."""

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
from sameas.partitions.layout import CELL, COLLECTION, Cell, HatsCatalogue, numbers_of, partition_file, sky_order

if TYPE_CHECKING:
    import pyarrow as pa
    from astropy.table import Table

#: Rows of a row group, the unit in which halos are read.
GROUP_ROWS = 1 << 16


@contextmanager
def _draft(path: Path) -> Iterator[Path]:
    """A draft file next to ``path``, which replaces it when the block ends and is removed if the block fails."""
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        yield draft
        os.replace(draft, path)
    finally:
        draft.unlink(missing_ok=True)


def written_whole(path: Path, content: bytes) -> None:
    """Write a file completely or not at all."""
    with _draft(path) as draft:
        draft.write_bytes(content)


def write_rows(tables: Iterable[pa.Table], path: Path) -> int:
    """Write a partition's file completely or not at all, and none without rows; returns the number of rows.

    tables : its rows in pieces, with the columns of the first piece.
    """
    import pyarrow as pa
    from pyarrow import parquet

    pieces = (table for table in tables if table.num_rows)
    first = next(pieces, None)
    if first is None:
        return 0
    # Dictionary encoding of numbers that are nearly all different takes two thirds of the time and enlarges files.
    texts = [field.name for field in first.schema if pa.types.is_string(field.type)]
    rows = 0
    with _draft(path) as draft, parquet.ParquetWriter(
        draft, first.schema, compression="zstd", use_dictionary=texts or False
    ) as writer:  # fmt: skip
        for table in chain([first], pieces):
            writer.write_table(table.cast(first.schema), row_group_size=GROUP_ROWS)
            rows += int(table.num_rows)
    return rows


def arrow_of(table: Table, cells: IntArray, facts: Mapping[str, Any]) -> pa.Table:
    """The Arrow table of a partition's joined rows, the rows' cells of order 29 in its first column."""
    import pyarrow as pa

    arrays = [pa.array(cells, pa.int64()), *(array_of(table[name]) for name in table.colnames)]
    fields = [pa.field(CELL, pa.int64())]
    fields += [pa.field(name, array.type, metadata=column_metadata(table[name]))
               for name, array in zip(table.colnames, arrays[1:], strict=True)]  # fmt: skip
    return pa.Table.from_arrays(arrays, schema=pa.schema(fields, metadata={b"sameas": json.dumps(facts).encode()}))


def catalogue_properties(name: str, ra: str, dec: str) -> dict[str, Any]:
    """HATS properties of a catalogue, except those that its partitions determine. ra, dec : columns of positions."""
    return {
        "obs_collection": name, "dataproduct_type": "object", "hats_col_ra": ra, "hats_col_dec": dec,
        "hats_col_healpix": CELL, "hats_col_healpix_order": healpix.FINEST, "hats_builder": "sameas",
    }  # fmt: skip


def finish_catalogue(
    folder: Path, cells: Iterable[Cell], properties: Mapping[str, Any], facts: Mapping[str, Any]
) -> int:
    """Write a catalogue's metadata, properties and list of partitions; returns its number of rows.

    properties : those of :func:`catalogue_properties`. facts : the provenance.
    """
    from pyarrow import parquet

    cells = sorted(cells, key=sky_order)
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
    """Write the properties of a collection: its catalogue and margin."""
    properties = {"obs_collection": name, "hats_primary_table_url": name}
    if margin is not None:
        properties |= {"all_margins": margin, "default_margin": margin}
    written_whole(folder / COLLECTION, _lines(properties))


def _lines(properties: Mapping[str, Any]) -> bytes:
    """Lines of a Java properties file: line ends and unprintable characters as \\uXXXX."""
    return "".join(f"{_escaped(key)}={_escaped(str(value))}\n" for key, value in properties.items()).encode()


def _escaped(text: str) -> str:
    return "".join(c if c.isprintable() or ord(c) > 0xFFFF else f"\\u{ord(c):04x}" for c in text)


def write_margin(catalogue: HatsCatalogue, cell: Cell, margin_arcsec: float, folder: Path) -> int:
    """Write a partition of the margin catalogue: the rows of other partitions around the cell; returns their number."""
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
    max_rows: int = 1_000_000,
) -> list[Cell]:  # fmt: skip
    """Write a table as a HATS catalogue; returns its partitions.

    ra, dec : columns of positions, degrees. cells : the partitions; by default of at most ``max_rows`` rows each.
    """
    position = np.column_stack([np.asarray(table[ra], np.float64), np.asarray(table[dec], np.float64)])
    place = healpix.cells_of(position, healpix.FINEST)
    order = np.argsort(place, kind="stable")
    table, place = table[order], place[order]
    if cells is None:
        cells = [one for k in range(12) for one in _split(Cell(0, k), place, max_rows)]
    full = []
    for cell in cells:
        begin, end = np.searchsorted(place, cell.stretch[0])
        if begin < end:
            write_rows([arrow_of(table[begin:end], place[begin:end], {})], partition_file(folder, cell))
            full.append(cell)
    finish_catalogue(folder, full, catalogue_properties(folder.name, ra, dec), {})
    return full


def _split(cell: Cell, place: IntArray, max_rows: int) -> list[Cell]:
    """The cell, or the largest cells within it, with at most ``max_rows`` of the ascending cells ``place``; those
    without rows omitted."""
    begin, end = np.searchsorted(place, cell.stretch[0])
    if end - begin <= max_rows or cell.order == 20:
        return [cell] if begin < end else []
    return [one for part in cell.inner for one in _split(part, place, max_rows)]

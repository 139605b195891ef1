"""A HATS catalogue on disk: its partitions, and its rows in stretches of HEALPix cells, read and written with pyarrow.

https://www.ivoa.net/documents/Notes/HATS/: a folder ``dataset`` with a Parquet file for each HEALPix cell, whose rows
have their cell of order 29 in the column ``_healpix_29``; a collection names the folders of its catalogue and margin.
Every file is written completely or not at all.
"""

from __future__ import annotations

import csv
import hashlib
import json
import os
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from itertools import chain, pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import IntArray
from sameas.errors import InputError, reading
from sameas.io.arrow import array_of, numbers_in
from sameas.io.parquet import PANDAS, column_metadata, pandas_types
from sameas.partitions.healpix import FINEST, cells_of, joined, order_of_width, ring, stretches, within
from sameas.ragged import ranges
from sameas.representation import in_short

if TYPE_CHECKING:
    import pyarrow as pa
    from astropy.table import Table
    from pyarrow import parquet

#: The column of the cell of order 29.
CELL = "_healpix_29"
#: Columns of HATS itself, which are never a catalogue's positions, ids or magnitudes.
OWN = (CELL, "_hipscat_index", "Norder", "Dir", "Npix")
COLLECTION, PROPERTIES = "collection.properties", ("hats.properties", "properties")
#: Rows of a row group as written, the unit in which halos are read.
GROUP_ROWS = 1 << 16
#: Accepted suffixes of partitions; any other could lead to files outside the catalogue.
_SUFFIX = re.compile(r"/|(\.\w{1,20}){1,3}")


@dataclass(frozen=True, order=True)
class Cell:
    """A HEALPix cell: order and number."""

    order: int
    number: int

    @property
    def stretch(self) -> IntArray:
        """(1, 2) its range of cells of order 29."""
        shift = 2 * (FINEST - self.order)
        return np.array([[self.number << shift, (self.number + 1) << shift]], np.int64)

    @property
    def inner(self) -> tuple[Cell, ...]:
        """Its four cells of the next order."""
        return tuple(Cell(self.order + 1, 4 * self.number + k) for k in range(4))

    def at(self, order: int) -> Cell:
        """The cell of this order, coarser or the same, that contains it."""
        return Cell(order, self.number >> 2 * (self.order - order))

    def __str__(self) -> str:
        return f"Norder={self.order}, Npix={self.number}"


def sky_order(cell: Cell) -> tuple[int, int]:
    """Sort key of cells along HEALPix' nested order."""
    return int(cell.stretch[0, 0]), cell.order


def partition_file(folder: Path, cell: Cell, suffix: str = ".parquet") -> Path:
    """The file of a partition of the catalogue in a folder, or, for suffix "/", the folder of its files."""
    place = folder / "dataset" / f"Norder={cell.order}" / f"Dir={cell.number // 10000 * 10000}"
    return place / f"Npix={cell.number}{'' if suffix == '/' else suffix}"


def numbers_of(table: pa.Table, column: str) -> NDArray[Any]:
    """(n,) a column of numbers; ``to_numpy`` would import pandas, which takes a third of a second."""
    chunks = [numbers_in(chunk) for chunk in table.column(column).chunks]
    return chunks[0] if len(chunks) == 1 else np.concatenate([np.empty(0, np.int64), *chunks])


def is_hats(path: object) -> bool:
    """Whether a path is a HATS catalogue or a collection of them."""
    if not isinstance(path, str | os.PathLike) or not os.path.isdir(path):
        return False
    folder = Path(path)
    return any((folder / name).is_file() for name in (COLLECTION, *PROPERTIES)) and (
        (folder / COLLECTION).is_file() or (folder / "dataset").is_dir()
    )


def without_properties(path: object) -> bool:
    """Whether a path is a HATS catalogue except that its properties are missing."""
    return (
        isinstance(path, str | os.PathLike)
        and os.path.isdir(path)
        and (Path(path) / "dataset").is_dir()
        and not is_hats(path)
    )


def properties(path: Path) -> dict[str, str]:
    """The keys and values of a properties file."""
    lines = (line.partition("=") for line in path.read_text(encoding="utf-8").splitlines() if not line.startswith("#"))
    return {_unescaped(key.strip()): _unescaped(value.strip()) for key, equals, value in lines if equals}


def _unescaped(text: str) -> str:
    return re.sub(r"\\u([0-9a-fA-F]{4})", lambda found: chr(int(found[1], 16)), text)


@in_short
@dataclass(frozen=True)
class HatsCatalogue:
    """A catalogue in partitions. Make it with :meth:`open`.

    path : the folder that contains ``dataset``. name : for messages. cells : of the partitions, by :func:`sky_order`.
    properties : of its properties file.
    """

    path: Path
    name: str
    cells: tuple[Cell, ...]
    properties: dict[str, str]

    @classmethod
    def open(cls, path: str | os.PathLike[str], name: str = "") -> HatsCatalogue:
        """The catalogue in a folder, or the primary one of a collection.

        Raises InputError: not a HATS catalogue; no partitions; partitions that overlap or are no HEALPix cells.
        """
        folder = Path(path)
        with reading(str(path), "its list of partitions or its properties cannot be read"):
            if (folder / COLLECTION).is_file():
                folder = folder / properties(folder / COLLECTION).get("hats_primary_table_url", "")
            file = next((folder / name for name in PROPERTIES if (folder / name).is_file()), None)
            if file is None or not (folder / "dataset").is_dir():
                raise InputError(f"{path}: no HATS catalogue", "give a folder with hats.properties and dataset/")
            stated = properties(file)
            suffix = stated.get("hats_npix_suffix", ".parquet")
            if not _SUFFIX.fullmatch(suffix):
                raise InputError(f"{file}: hats_npix_suffix is {suffix!r}", "give .parquet, or / for folders")
            listed = _listed(folder, suffix)
            for one in listed:
                if not (0 <= one.order <= FINEST and 0 <= one.number < 12 * 4**one.order):
                    raise InputError(f"{path}: no cell of HEALPix is of order {one.order} and number {one.number}")
            cells = sorted(listed, key=sky_order)
        if not cells:
            raise InputError(f"{path}: the catalogue has no partitions", "was it imported to the end?")
        for one, other in pairwise(cells):
            if one.stretch[0, 1] > other.stretch[0, 0]:
                raise InputError(f"{path}: the partitions {one} and {other} overlap", "import the catalogue again")
        return cls(folder, name or folder.name, tuple(cells), stated)

    @cached_property
    def stretches(self) -> IntArray:
        """(p, 2) of the partitions."""
        return np.concatenate([cell.stretch for cell in self.cells])

    def file(self, cell: Cell) -> Path:
        """The file of a partition, or the folder of its files."""
        return partition_file(self.path, cell, self.properties.get("hats_npix_suffix", ".parquet"))

    @cached_property
    def schema(self) -> pa.Schema:
        """The schema of the first partition."""
        return _opened(self._files(self.cells[0])[0], self.cells[0]).schema_arrow

    @cached_property
    def position(self) -> tuple[str, str]:
        """The columns of right ascension and declination by which the catalogue is partitioned.

        Raises InputError: its files have no such column.
        """
        names = self.properties.get("hats_col_ra", "ra"), self.properties.get("hats_col_dec", "dec")
        for key, name in zip(("hats_col_ra", "hats_col_dec"), names, strict=True):
            if name not in self.schema.names:
                raise InputError(
                    f"{self.path}: its partitions have no column {name!r}, which {key} of its properties names",
                    "correct the properties",
                )
        return names

    def _files(self, cell: Cell) -> list[Path]:
        file = self.file(cell)
        files = sorted(file.glob("*.parquet")) if file.is_dir() else [file] if file.is_file() else []
        if not files:
            raise InputError(f"{file}: the partition {cell} of {self.name} is missing", "restore it, and call again")
        return files

    def touching(self, stretch: IntArray) -> list[int]:
        """The partitions that overlap a set of stretches, ascending."""
        own = self.stretches
        first = np.searchsorted(stretch[:, 1], own[:, 0], side="right")
        overlaps = (first < len(stretch)) & (stretch[np.minimum(first, len(stretch) - 1), 0] < own[:, 1])
        return [int(k) for k in np.flatnonzero(overlaps)] if len(stretch) else []

    def rows(self, stretch: IntArray, columns: list[str] | None = None) -> pa.Table:
        """The rows in a set of stretches by ascending cell, with the cells in ``_healpix_29``.

        columns : names; None for all except those of HATS itself. Row groups that the statistics exclude are not read.

        Raises InputError: a partition is missing or broken; it is named.
        """
        import pyarrow as pa

        stretch = joined(stretch)
        names = [name for name in self.schema.names if name not in OWN] if columns is None else columns
        names = list(dict.fromkeys(names))
        parts = []
        for number in self.touching(stretch):
            cell = self.cells[number]
            for file in self._files(cell):
                with _naming(file, cell):
                    parts += self._part(file, cell, stretch, names)
        if parts:
            table = pa.concat_tables(parts, promote_options="permissive")
            place = numbers_of(table, CELL)
            sorted_ = bool(np.all(place[1:] >= place[:-1]))
            return table if sorted_ else table.take(pa.array(np.argsort(place, kind="stable")))
        empty = self.schema.empty_table().select(names)
        return empty.append_column(CELL, pa.array([], pa.int64()))

    def pieces(self, cell: Cell, columns: list[str], max_rows: int) -> Iterator[pa.Table]:
        """The rows of a partition in their stored order, at most ``max_rows`` in a table, with their cells.

        Raises InputError: the partition is missing or broken; it is named.
        """
        import pyarrow as pa
        from pyarrow import parquet

        names = list(dict.fromkeys(columns))
        for file in self._files(cell):
            with _naming(file, cell), parquet.ParquetFile(file, memory_map=True) as opened:
                for batch in opened.iter_batches(max_rows, columns=self._needed(opened, names), use_threads=False):
                    yield self._with_cells(pa.Table.from_batches([batch]), names)

    def chunks(self, number: int, size: int, columns: list[str]) -> list[pa.Table]:
        """``number`` tables of ``size`` rows consecutive on the sky, equally spaced among all rows, with their cells; a
        single table of all rows if there are not more. They do not depend on the partitions."""
        import pyarrow as pa

        end = np.concatenate([[0], np.cumsum(self.partition_rows)])
        total = int(end[-1])
        if total <= number * size:
            return [self.rows(self.stretches, columns)]
        begins = (np.arange(number) * 2 + 1) * total // (2 * number) - size // 2
        parts: list[list[pa.Table]] = [[] for _ in begins]
        for k, cell in enumerate(self.cells):
            for chunk in np.flatnonzero((begins < end[k + 1]) & (begins + size > end[k])):
                low, high = max(int(begins[chunk] - end[k]), 0), int(min(begins[chunk] + size, end[k + 1]) - end[k])
                parts[chunk].append(self._consecutive(cell, low, high, columns))
        return [pa.concat_tables(part, promote_options="permissive") for part in parts]

    def _consecutive(self, cell: Cell, low: int, high: int, columns: list[str]) -> pa.Table:
        """The rows low … high − 1 of a partition, counted by ascending cell."""
        import pyarrow as pa
        from pyarrow import parquet

        files = self._files(cell)
        if len(files) == 1:
            with _naming(files[0], cell), parquet.ParquetFile(files[0], memory_map=True) as opened:
                if _groups_ascend(opened.metadata):
                    end = np.cumsum([0, *(opened.metadata.row_group(k).num_rows for k in range(opened.num_row_groups))])
                    groups = [int(k) for k in np.flatnonzero((end[:-1] < high) & (end[1:] > low))]
                    part = pa.concat_tables([self._read(opened, k, columns) for k in groups])
                    place = numbers_of(part, CELL)
                    if np.all(place[1:] >= place[:-1]):
                        return part.take(pa.array(np.arange(low, high) - end[groups[0]]))
        rows = self.rows(cell.stretch, columns)
        return rows.take(pa.array(np.arange(low, high)))  # a slice would keep all rows in memory

    def _part(self, file: Path, cell: Cell, stretch: IntArray, names: list[str]) -> list[pa.Table]:
        """The rows of a file in a set of stretches, in pieces."""
        import pyarrow as pa
        from pyarrow import parquet

        parts = []
        whole = bool(np.any((stretch[:, 0] <= cell.stretch[0, 0]) & (stretch[:, 1] >= cell.stretch[0, 1])))
        with parquet.ParquetFile(file, memory_map=True) as opened:
            stored = CELL in opened.schema_arrow.names
            if stored and whole and opened.metadata.num_rows:
                return [self._with_cells(opened.read(self._needed(opened, names), use_threads=False), names)]
            for number in range(opened.num_row_groups):
                if stored and not whole and _outside(opened.metadata.row_group(number), stretch):
                    continue
                group = _Group.of(self._read(opened, number, names))
                kept = np.arange(len(group.cells)) if whole else group.inside(stretch)
                if len(kept):
                    parts.append(group.table if len(kept) == len(group.cells) else group.table.take(pa.array(kept)))
        return parts

    def _read(self, opened: parquet.ParquetFile, number: int, names: list[str]) -> pa.Table:
        """A row group, with its rows' cells in the last column."""
        return self._with_cells(opened.read_row_group(number, self._needed(opened, names), use_threads=False), names)

    def _needed(self, opened: parquet.ParquetFile, names: list[str]) -> list[str]:
        """The columns, and those that give the cells."""
        return list(dict.fromkeys([*names, *([CELL] if CELL in opened.schema_arrow.names else self.position)]))

    def _with_cells(self, part: pa.Table, names: list[str]) -> pa.Table:
        """The columns, and the rows' cells in the last one."""
        import pyarrow as pa

        if CELL not in part.column_names:
            ra, dec = (numbers_of(part, name).astype(np.float64) for name in self.position)
            part = part.append_column(CELL, pa.array(cells_of(np.column_stack([ra, dec]), FINEST)))
        kept = [*(name for name in names if name != CELL), CELL]
        part = part.select(kept)
        return part.set_column(len(kept) - 1, CELL, part.column(CELL).cast(pa.int64())).replace_schema_metadata()

    @cached_property
    def partition_rows(self) -> IntArray:
        """(p,) numbers of rows of the partitions, from their footers.

        Raises InputError: a partition is missing or broken; it is named.
        """
        return np.array([sum(_opened(file, cell).metadata.num_rows for file in self._files(cell))
                         for cell in self.cells], np.int64)  # fmt: skip

    def fingerprint(self) -> str:
        """SHA-256 of the names, sizes and modification times of the partitions' files."""
        files = [(str(file.relative_to(self.path)), file.stat().st_size, file.stat().st_mtime_ns)
                for cell in self.cells for file in self._files(cell)]  # fmt: skip
        return hashlib.sha256(json.dumps(files).encode()).hexdigest()


@dataclass(frozen=True)
class _Group:
    """A row group: its rows with their cells in the last column, these cells (n,), and whether they ascend."""

    table: pa.Table
    cells: IntArray
    ascending: bool

    @classmethod
    def of(cls, table: pa.Table) -> _Group:
        cells = numbers_of(table, CELL)
        return cls(table, cells, bool(len(cells)) and bool(np.all(cells[1:] >= cells[:-1])))

    def inside(self, stretch: IntArray) -> IntArray:
        """The rows in a set of stretches."""
        if not self.ascending:
            return np.flatnonzero(within(stretch, self.cells))
        overlap = stretch[np.searchsorted(stretch[:, 1], self.cells[0], side="right") :]
        overlap = overlap[: np.searchsorted(overlap[:, 0], self.cells[-1], side="right")]
        begin, end = np.searchsorted(self.cells, overlap).T
        return ranges(begin, end - begin)[1]


def _groups_ascend(metadata: parquet.FileMetaData) -> bool:
    """Whether the cells of a file's row groups ascend without overlap, by their statistics."""
    last = -1
    for number in range(metadata.num_row_groups):
        limits = _limits(metadata.row_group(number))
        if limits is None or limits[0] < last:
            return False
        last = limits[1]
    return True


def _limits(group: parquet.RowGroupMetaData) -> tuple[int, int] | None:
    """The lowest and highest cell of a row group, from its statistics; None without statistics."""
    for k in range(group.num_columns):
        column = group.column(k)
        if column.path_in_schema == CELL:
            statistics = column.statistics
            return (statistics.min, statistics.max) if statistics is not None and statistics.has_min_max else None
    return None


def _outside(group: parquet.RowGroupMetaData, stretch: IntArray) -> bool:
    """Whether the statistics of a row group exclude that a row is in a set of stretches."""
    limits = _limits(group)
    if limits is None:
        return False
    at = int(np.searchsorted(stretch[:, 1], limits[0], side="right"))
    return at == len(stretch) or bool(stretch[at, 0] > limits[1])


def _opened(file: Path, cell: Cell) -> parquet.ParquetFile:
    """The file's footer."""
    from pyarrow import parquet

    with _naming(file, cell):
        return parquet.ParquetFile(file)


@contextmanager
def _naming(file: Path, cell: Cell) -> Iterator[None]:
    """Errors while reading a partition's file become an InputError that names it."""
    try:
        yield
    except (InputError, MemoryError):
        raise
    except Exception as error:  # Arrow raises many types on damaged files
        words = " ".join(str(error).split())[:160]
        raise InputError(
            f"{file}: the partition {cell} cannot be read ({words})", "restore it, and call again"
        ) from error


def _listed(folder: Path, suffix: str) -> list[Cell]:
    """The partitions in ``partition_info.csv``, or, without that file, those found in the folder."""
    listing = folder / "partition_info.csv"
    if listing.is_file():
        with listing.open(encoding="utf-8", newline="") as lines:
            return [Cell(int(row["Norder"]), int(row["Npix"])) for row in csv.DictReader(lines)]
    pattern = "Norder=*/Dir=*/Npix=*" + ("" if suffix == "/" else suffix)
    cells = []
    for path in (folder / "dataset").glob(pattern):
        number = path.name.removeprefix("Npix=").split(".")[0]
        cells.append(Cell(int(path.parent.parent.name.removeprefix("Norder=")), int(number)))
    return cells


# Writing.


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
    # Whether a column has nulls differs by partition; its type for pandas should not.
    metadata = {
        b"sameas": json.dumps(facts).encode(),
        PANDAS: json.dumps(pandas_types(table.columns.values())).encode(),
    }
    return pa.Table.from_arrays(arrays, schema=pa.schema(fields, metadata=metadata))


def catalogue_properties(name: str, ra: str, dec: str) -> dict[str, Any]:
    """HATS properties of a catalogue, except those that its partitions determine. ra, dec : columns of positions."""
    return {
        "obs_collection": name, "dataproduct_type": "object", "hats_col_ra": ra, "hats_col_dec": dec,
        "hats_col_healpix": CELL, "hats_col_healpix_order": FINEST, "hats_builder": "sameas",
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

    order = max(order_of_width(margin_arcsec), cell.order)
    around = ring(np.array([cell.number]), cell.order, order)
    rows = catalogue.rows(stretches(around, order))
    if not rows.num_rows:
        return 0
    schema = catalogue.schema
    rows = rows.select(schema.names).cast(pa.schema(list(schema)))
    order_of_rows = np.argsort(numbers_of(rows, CELL), kind="stable")
    rows = rows.take(pa.array(order_of_rows)).replace_schema_metadata(schema.metadata)
    return write_rows([rows], partition_file(folder, cell))


def write_hats(table: Table, folder: Path, *, max_rows: int = 1_000_000) -> list[Cell]:
    """Write a table with columns ``ra`` and ``dec``, degrees, as a HATS catalogue; returns its partitions.

    max_rows : of a partition.
    """
    position = np.column_stack([np.asarray(table[name], np.float64) for name in ("ra", "dec")])
    place = cells_of(position, FINEST)
    order = np.argsort(place, kind="stable")
    table, place = table[order], place[order]
    cells = [one for k in range(12) for one in _split(Cell(0, k), place, max_rows)]
    for cell in cells:
        begin, end = np.searchsorted(place, cell.stretch[0])
        write_rows([arrow_of(table[begin:end], place[begin:end], {})], partition_file(folder, cell))
    finish_catalogue(folder, cells, catalogue_properties(folder.name, "ra", "dec"), {})
    return cells


def _split(cell: Cell, place: IntArray, max_rows: int) -> list[Cell]:
    """The cell, or the largest cells within it, with at most ``max_rows`` of the ascending cells ``place``; those
    without rows omitted."""
    begin, end = np.searchsorted(place, cell.stretch[0])
    if end - begin <= max_rows or cell.order == 20:
        return [cell] if begin < end else []
    return [one for part in cell.inner for one in _split(part, place, max_rows)]

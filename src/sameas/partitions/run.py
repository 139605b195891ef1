"""A crossmatch of two partitioned catalogues: parts are decided in parallel processes, and a run can be resumed.

Every worker reads the settings of all parts (:class:`~sameas.partitions.part.Work`) from a folder in the output, and
writes each finished part as a file that is complete or absent. Workers share nothing but that folder.
"""

from __future__ import annotations

import errno
import json
import shutil
import sqlite3
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, suppress
from dataclasses import asdict, dataclass, fields, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sameas.arrays import IntArray
from sameas.errors import InputError, reading
from sameas.estimate.places import CellCounts
from sameas.io.atomic import held, refused_by_disk, together
from sameas.partitions import healpix
from sameas.partitions.estimated import Estimated, Progress
from sameas.partitions.hats import (
    CELL,
    Cell,
    HatsCatalogue,
    arrow_of,
    catalogue_properties,
    finish_catalogue,
    numbers_of,
    partition_file,
    sky_order,
    write_collection,
    write_margin,
    write_rows,
    written_whole,
)
from sameas.partitions.part import WITH_SECOND, PartSums, Work
from sameas.partitions.workers import Workers, store, stored_work
from sameas.sky.joins import joined_names

if TYPE_CHECKING:
    import pyarrow as pa

#: Most records of both catalogues in a piece, and most candidates (0.4 kB each). A worker then takes 0.6 GB, with the
#: libraries and the sums. Smaller pieces spend a larger part of the work on halos.
PIECE_ROWS, PIECE_PAIRS = 300_000, 750_000


@dataclass(frozen=True)
class Task:
    """A unit of work: what one call of a worker decides and writes.

    cells : partitions of the output. pieces : decided one after another, each of cells of one order. Either one piece
    covers all the partitions, or several pieces make up a single partition.
    """

    cells: tuple[Cell, ...]
    pieces: tuple[tuple[Cell, ...], ...]

    @property
    def cell(self) -> Cell:
        """The cell that contains the task."""
        return self.cells[0] if len(self.cells) == 1 else self.pieces[0][0]


@dataclass(frozen=True)
class Decided:
    """A task that is decided and written.

    cell : of the task. written : its partitions that have rows. sums : of its parts. cpu_seconds : it took; 0 for a
    task of an interrupted run.
    """

    cell: Cell
    written: tuple[Cell, ...]
    sums: PartSums
    cpu_seconds: float = 0.0

    def write(self, file: Path) -> None:
        """To a JSON file, which is whole or absent."""
        cells = {"written": [[cell.order, cell.number] for cell in self.written]}
        own = {"order": self.cell.order, "number": self.cell.number}
        written_whole(file, json.dumps({**asdict(self.sums), **cells, **own}).encode())

    @classmethod
    def read(cls, file: Path) -> Decided:
        """From a file that :meth:`write` wrote."""
        with reading(str(file), "is not as it was written"):
            stored = json.loads(file.read_text(encoding="utf-8"))
            sums = PartSums(**{one.name: stored[one.name] for one in fields(PartSums)})
            written = tuple(Cell(*cell) for cell in stored["written"])
            return cls(Cell(stored["order"], stored["number"]), written, sums)


def decide_partition(folder: str, given: tuple[Task, str, dict[str, Any]]) -> Decided:
    """Decide a task and write its partitions. given : the task, the output catalogue's folder, the provenance."""
    task, catalogue, facts = given
    work = stored_work(folder)
    cpu = time.process_time()
    sums: list[PartSums] = []
    pieces = (_joined_piece(work, piece, facts, sums) for piece in task.pieces)
    if len(task.cells) == 1:
        written = [write_rows(pieces, partition_file(Path(catalogue), task.cells[0]))]
    else:
        (rows,) = pieces
        begins = np.searchsorted(numbers_of(rows, CELL), [cell.stretch[0] for cell in task.cells])
        written = [write_rows([rows.slice(begin, end - begin)], partition_file(Path(catalogue), cell))
                   for cell, (begin, end) in zip(task.cells, begins, strict=True)]  # fmt: skip
    non_empty = tuple(cell for cell, rows in zip(task.cells, written, strict=True) if rows)
    decided = Decided(task.cell, non_empty, PartSums.of(sums))
    decided.write(_file_of(Path(folder), task))
    return replace(decided, cpu_seconds=time.process_time() - cpu)


def _joined_piece(work: Work, piece: tuple[Cell, ...], facts: dict[str, Any], sums: list[PartSums]) -> pa.Table:
    """A piece's joined rows, by ascending cell of order 29; appends to ``sums`` those of its parts."""
    import pyarrow as pa

    tables = []
    for part in work.decide(piece):
        sums.append(part.sums)
        tables.append(arrow_of(*part.table(work), facts))
    if len(tables) == 1:
        return tables[0]
    rows = pa.concat_tables([table.cast(tables[0].schema) for table in tables])
    return rows.take(pa.array(np.argsort(numbers_of(rows, CELL), kind="stable")))


def margin_partition(folder: str, task: tuple[Cell, str, str, float]) -> int:
    """Write a partition's margin; returns its number of rows. task : the cell, the folders of the catalogue and of its
    margins, the width in arcsec."""
    cell, catalogue, margin, arcsec = task
    return write_margin(_output(catalogue), cell, arcsec, Path(margin))


@lru_cache(maxsize=2)
def _output(folder: str) -> HatsCatalogue:
    return HatsCatalogue.open(folder)


def _file_of(folder: Path, task: Task) -> Path:
    """The file of a decided task."""
    return folder / "done" / f"{task.cell.order}-{task.cell.number}.json"


@dataclass(frozen=True)
class Written(PartSums):
    """The output of a run, with the sums of all its parts.

    path : the collection. rows, partitions : of the joined catalogue. decided : tasks decided in this call, the others
    were already written. cpu_seconds : of these.
    """

    path: Path
    rows: int
    partitions: int
    decided: int
    cpu_seconds: float


def write(
    estimated: Estimated,
    path: Path,
    facts: dict[str, Any],
    *,
    margin_arcsec: float = 10.0,
    workers: Workers,
    progress: Progress = lambda stage: None,
    piece_rows: int = PIECE_ROWS,
) -> Written:
    """Decide all parts and write them as a HATS collection; parts written by an interrupted run are kept.

    path : the collection's folder. facts : the provenance; an unfinished run with another one is refused. piece_rows :
    approximate records of both catalogues in a piece; fewer where they would have too many candidates.

    Raises InputError: the folder exists and is not an unfinished run with the same provenance; a partition cannot be
    read, by name; workers keep dying; the disk is full.
    """
    collection = _Collection(path, facts, margin_arcsec, piece_rows)
    try:
        write_all = partial(_write_all, estimated, collection, workers, progress)
        return _locked(path, facts, write_all)
    except OSError as error:
        if error.errno == errno.ENOSPC:
            raise InputError(
                f"{path}: the disk is full; finished parts are kept", "make room, and call again"
            ) from error
        missing = "the folder no longer exists" if isinstance(error, FileNotFoundError) else None
        reason = refused_by_disk(error) or missing
        if reason is None:
            raise
        raise InputError(f"cannot write {path}: {reason}; finished parts are kept", "call again") from error


def _locked(path: Path, facts: dict[str, Any], write_all: Callable[[Callable[[], None]], Written]) -> Written:
    """The result of ``write_all(last)``, by the only run in the folder; see :func:`_write_all`."""
    scratch = path / ".sameas-run"
    if (path / "collection.properties").exists():
        shutil.rmtree(scratch, ignore_errors=True)  # of a run that was killed in its last step
        raise InputError(f"{path}: exists already", "give another name, or remove it")
    mark = scratch / "begun.json"
    with reading(str(mark), "cannot be read"):
        begun_facts = json.loads(mark.read_text(encoding="utf-8")) if mark.exists() else facts
    if begun_facts != facts:
        raise InputError(f"{path}: was begun with other catalogues or options", "give another name, or remove it")
    # A scratch folder without the mark is of a run that was killed before it wrote anything else.
    if path.exists() and not mark.exists() and any(one != scratch for one in path.iterdir()):
        raise InputError(f"{path}: exists already, and is not an unfinished match", "give another name, or remove it")
    scratch.mkdir(parents=True, exist_ok=True)
    with together() as last:
        with ExitStack() as stack:
            with suppress(sqlite3.Error):  # a file system without locks
                stack.enter_context(closing(held(scratch)))
            if (path / "collection.properties").exists():
                raise InputError(f"{path}: another run has just written it", "give another name, or remove it")
            written = write_all(last)
        shutil.rmtree(scratch)
    return written


@dataclass(frozen=True)
class _Collection:
    """A collection to be written; the fields are the arguments of :func:`write`."""

    path: Path
    facts: dict[str, Any]
    margin_arcsec: float
    piece_rows: int


def _write_all(
    estimated: Estimated, collection: _Collection, workers: Workers, progress: Progress, last: Callable[[], None]
) -> Written:
    """Write the collection, by the only run in its folder, continuing what another run left.

    last : called before the last step, which completes the collection.
    """
    work, path, facts, margin_arcsec = estimated.work, collection.path, collection.facts, collection.margin_arcsec
    name = path.name
    catalogue, scratch = path / name, path / ".sameas-run"
    mark = scratch / "begun.json"
    store(work, scratch)
    written_whole(mark, json.dumps(facts).encode())
    max_records = min(collection.piece_rows, estimated.rows_with_halo(PIECE_PAIRS))
    all_tasks = list(divide(output_cells(work), estimated.counts, work.sides[0].cell_order, max_records))
    earlier = [_decided_earlier(scratch, catalogue, task) for task in all_tasks]
    tasks = [(task, str(catalogue), facts) for task, done in zip(all_tasks, earlier, strict=True) if done is None]
    finished = [done for done in earlier if done is not None]
    with workers if len(tasks) > 1 else workers.alone() as pool:
        for _, decided in pool.each(decide_partition, str(scratch), tasks):
            finished.append(decided)
            progress(f"part {len(finished)} of {len(all_tasks)}")
        non_empty = [cell for decided in finished for cell in decided.written]
        if not non_empty:
            raise InputError(f"{path}: the join {work.join} has no rows; nothing was written")
        properties = catalogue_properties(name, *position_columns(work))
        rows = finish_catalogue(catalogue, non_empty, properties, facts)
        margin = f"{name}_{margin_arcsec:g}arcs" if margin_arcsec > 0.0 else None
        if margin is not None:
            progress("margin")
            _write_margins(pool, str(scratch), catalogue, path / margin, non_empty, margin_arcsec, properties, facts)
    for draft in path.rglob(".*.part"):  # of workers that died while writing
        draft.unlink(missing_ok=True)
    last()
    write_collection(path, name, margin if margin is not None and (path / margin).exists() else None)
    cpu_seconds = sum(decided.cpu_seconds for decided in finished)
    # Added in the order of the sky, so that the sums do not depend on the workers.
    in_order = sorted(finished, key=lambda decided: (decided.cell.order, decided.cell.number))
    sums = PartSums.of([decided.sums for decided in in_order])
    return Written(**asdict(sums), path=path, rows=rows, partitions=len(non_empty), decided=len(tasks),
                   cpu_seconds=cpu_seconds)  # fmt: skip


def _decided_earlier(scratch: Path, catalogue: Path, task: Task) -> Decided | None:
    """A task that an interrupted run has decided, if all its files exist; else None."""
    file = _file_of(scratch, task)
    if not file.exists():
        return None
    decided = Decided.read(file)
    return decided if all(partition_file(catalogue, cell).exists() for cell in decided.written) else None


def _write_margins(
    pool: Workers, scratch: str, catalogue: Path, margin: Path, cells: Sequence[Cell], arcsec: float,
    properties: dict[str, Any], facts: dict[str, Any],
) -> None:  # fmt: skip
    _output.cache_clear()
    tasks = [(cell, str(catalogue), str(margin), arcsec) for cell in cells]
    non_empty = [task[0] for task, rows in pool.each(margin_partition, scratch, tasks) if rows]
    if non_empty:
        own = {"dataproduct_type": "margin", "obs_collection": margin.name, "hats_primary_table_url": catalogue.name,
               "hats_margin_threshold": f"{arcsec:g}"}  # fmt: skip
        finish_catalogue(margin, non_empty, {**properties, **own}, facts)


def position_columns(work: Work) -> tuple[str, str]:
    """The output's columns of RA and Dec: those of the first catalogue, or ``_ra``, ``_dec`` if rows may lack it."""
    if work.join in WITH_SECOND:
        return "_ra", "_dec"
    schemas = [[name for name in side.stored.schema.names if name not in (CELL, "Norder", "Dir", "Npix")]
               for side in work.sides]  # fmt: skip
    from astropy.table import Table

    tables = [Table({name: [0] for name in names}) for names in schemas]
    output_name = dict(zip(schemas[0], joined_names(tables)[0], strict=True))
    ra, dec = work.sides[0].stored.position
    return output_name[ra], output_name[dec]


def output_cells(work: Work) -> list[Cell]:
    """The output's partitions: those of the first catalogue, and, if the join writes rows of the second catalogue
    alone, the part of its partitions outside them."""
    cells = list(work.sides[0].stored.cells)
    if work.join in WITH_SECOND:
        covered = healpix.joined(work.sides[0].stored.stretches)
        for cell in work.sides[1].stored.cells:
            cells += _uncovered(cell, covered)
    return sorted(cells, key=sky_order)


def divide(cells: Sequence[Cell], counts: CellCounts, order: int, max_records: int) -> Iterator[Task]:
    """The output's cells in tasks of pieces of at most ``max_records`` records of both catalogues, in HEALPix order; a
    piece may have more if it is as small as the cells of the counts, which are of ``order``."""
    begins = counts.cells << 2 * (healpix.FINEST - order)
    total = np.concatenate([[0], np.cumsum(counts.numbers.sum(axis=1))])

    def small_enough(*cells: Cell) -> bool:
        begin, end = np.searchsorted(begins, [cells[0].stretch[0, 0], cells[-1].stretch[0, 1]])
        return cells[0].order >= order or bool(total[end] - total[begin] <= max_records)

    def pieces(*cells: Cell) -> Iterator[tuple[Cell, ...]]:
        """A cell or two adjacent ones if small enough, else pieces of them."""
        if small_enough(*cells):
            yield cells
        elif len(cells) == 2:
            for cell in cells:
                yield from pieces(cell)
        else:
            yield from pieces(*cells[0].inner[:2])
            yield from pieces(*cells[0].inner[2:])

    def tasks(cell: Cell, in_cell: Sequence[Cell]) -> Iterator[Task]:
        if len(in_cell) == 1 and (in_cell[0].order <= cell.order or not small_enough(in_cell[0])):
            yield Task((in_cell[0],), tuple(pieces(in_cell[0])))
        elif small_enough(cell):
            yield Task(tuple(in_cell), ((common(in_cell),),))
        else:
            for inner in cell.inner:
                inside = [one for one in in_cell if one.order > cell.order and one.at(inner.order) == inner]
                if inside:
                    yield from tasks(inner, inside)

    for k in range(12):
        in_cell = [cell for cell in cells if cell.at(0) == Cell(0, k)]
        if in_cell:
            yield from tasks(Cell(0, k), in_cell)


def common(cells: Sequence[Cell]) -> Cell:
    """The smallest cell that contains all the cells."""
    order = min(cell.order for cell in cells)
    while len({cell.at(order) for cell in cells}) > 1:
        order -= 1
    return cells[0].at(order)


def _uncovered(cell: Cell, covered: IntArray) -> list[Cell]:
    """The largest cells within a cell that are outside the ``covered`` (k, 2) stretches."""
    begin, end = cell.stretch[0]
    at = int(np.searchsorted(covered[:, 1], begin, side="right"))
    if at == len(covered) or covered[at, 0] >= end:
        return [cell]
    if covered[at, 0] <= begin and covered[at, 1] >= end:
        return []
    return [one for part in cell.inner for one in _uncovered(part, covered)]

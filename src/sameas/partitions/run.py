"""A crossmatch of two partitioned catalogues: parts are decided in parallel processes, and a run can be resumed.

Every worker reads the settings of all parts (:class:`~sameas.partitions.part.Work`) from a folder in the output, and
writes each finished part as a file that is complete or absent. Workers share nothing but that folder.
"""

from __future__ import annotations

import errno
import json
import math
import os
import shutil
import signal
import sqlite3
import sys
import time
import types
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from sameas.arrays import FloatArray, IntArray
from sameas.errors import InputError, reading
from sameas.estimate.match import Assumed
from sameas.estimate.places import CellCounts, Learned, Places, SampleRecords, drawn, learn
from sameas.estimate.sample import Sampling
from sameas.evidence import Related
from sameas.io.atomic import end_with_parent, held, refused_by_disk, together
from sameas.io.saved import dumps, loads
from sameas.kernels import threads
from sameas.partitions import healpix
from sameas.partitions.hats import (
    CELL,
    OWN,
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
from sameas.partitions.part import (
    DEFAULT_PART,
    WITH_SECOND,
    Counted,
    PartTuning,
    Side,
    Work,
    brightness,
    table_of,
    without_rows,
)
from sameas.representation import in_short
from sameas.sky.catalogue import Catalogue, CatalogueOptions
from sameas.sky.crossmatch import MatchOptions, columns_of, common_epoch
from sameas.sky.doubts import completed
from sameas.sky.joins import joined_names

Progress = Callable[[str], None]


@dataclass(frozen=True)
class RunTuning:
    """Numbers of a run, all chosen.

    Attributes
    ----------
    column_rows, column_partitions : rows of each partition, and partitions, from which columns are recognised.
    far_arcsec, far_sigmas : a record is *far* if its motion or error reach exceeds the larger of far_arcsec and
        far_sigmas median errors; far records are read for every part.
    chunks, chunk_rows : number and size of runs of rows consecutive on the sky, from which a catalogue's density and
        median error are measured. Their choice does not depend on the partitions.
    records_per_cell : in the finest cells of the counts, the mean number of records in a record's cell, in the densest
        chunk.
    margin_gates : margin of the sample, in gates of the width expected from the quoted errors.
    halo_share, margin_share : the first halo of a part, and one that is wide enough for nearly all parts, span the
        groups that hold this share of the sample's pairs. min_halo_arcsec : lower limit of both.
    max_failures : workers may die this many times in a row before the run stops, if no task ends in between.
    max_rows_in_process : catalogues of at most this many rows are counted without workers, each of which takes a CPU
        second to start.
    sampling : size of the sample. part : of every part.
    """

    column_rows: int = 20_000
    column_partitions: int = 3
    far_arcsec: float = 10.0
    far_sigmas: float = 40.0
    chunks: int = 16
    chunk_rows: int = 4_000
    records_per_cell: float = 8.0
    margin_gates: float = 8.0
    halo_share: float = 0.8
    margin_share: float = 0.9999
    min_halo_arcsec: float = 1.0
    max_failures: int = 3
    max_rows_in_process: int = 3_000_000
    sampling: Sampling = Sampling()  # noqa: RUF009
    part: PartTuning = DEFAULT_PART


DEFAULT_RUN = RunTuning()
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


@in_short
@dataclass(frozen=True)
class Estimated:
    """Two catalogues with their columns recognised, and all estimates: the input of every part.

    work : settings of all parts. counts : records of both by cell. catalogues : with a sample of their rows, and the
    doubts about the rows from which columns are recognised. moved : one sentence on the common epoch. rows : numbers of
    rows. doubts : what looks wrong. sample : numbers of records from which was estimated.
    """

    work: Work
    counts: CellCounts = field(repr=False)
    catalogues: tuple[Catalogue, Catalogue]
    moved: str
    rows: tuple[int, int]
    doubts: tuple[str, ...]
    sample: tuple[int, int]

    @property
    def learned(self) -> Learned:
        """The estimates."""
        assert self.work.learned is not None
        return self.work.learned

    def rows_with_halo(self, pairs: int) -> int:
        """Records of both in a square that, with its halo, has this many candidates; its side is at least twice the
        halo's width."""
        assert self.learned.estimate is not None
        answer, halo = self.learned.estimate.answer, self.work.halo_arcsec
        per_record = max(len(answer.pairs), 1) / (len(answer.first) + len(answer.second))
        density = sum(self.sample) / self.learned.estimate.coverage.volume
        side = max(math.sqrt(pairs / per_record / density) - 2.0 * halo, 2.0 * halo)
        return max(int(density * side**2), 1)


def estimate(
    stored: tuple[HatsCatalogue, HatsCatalogue],
    columns: tuple[CatalogueOptions, CatalogueOptions],
    options: MatchOptions,
    *,
    join: str = "all1",
    nway_columns: bool = False,
    workers: int | None = None,
    executor: Executor | None = None,
    progress: Progress = lambda stage: None,
    tuning: RunTuning = DEFAULT_RUN,
    scratch: Path,
) -> Estimated:
    """Everything that has to be estimated from two catalogues: once, from the counts of all partitions and a sample.

    stored : the catalogues. columns : the user's choice of their columns. options : of the match. join, nway_columns :
    of the output. workers : number of processes, default one a processor. executor : used instead of own processes.
    scratch : a folder that workers can read and write.

    Raises
    ------
    InputError : columns that are not recognised; no usable rows; a partition that cannot be read, by name.
    """
    if options.offset != "none":
        raise InputError("offset: offsets are not fitted over partitions", "remove it before the import")
    for one in options.evidence:
        for column in one.columns if isinstance(one, Related) else (one,):
            if not isinstance(column.values, str):
                raise InputError(
                    "evidence: values for rows cannot be used over partitions", "give the names of columns"
                )
    for side in columns:
        if side.fill_errors:
            raise InputError("fill_errors: typical errors would depend on the partition", "give every row an error")
    progress("columns")
    samples = tuple(_first_rows(one, chosen, tuning) for one, chosen in zip(stored, columns, strict=True))
    columns_of(samples[0], samples[1], options.evidence)  # refuses columns that do not exist
    epochs = completed_epochs(samples, options.epoch_jyr)
    epoch, moved = common_epoch(*epochs, options.epoch_jyr)
    bare = tuple(Side(one, without_rows(sample), epoch, 0) for one, sample in zip(stored, epochs, strict=True))
    work = Work(
        (bare[0], bare[1]), options.magnitudes, tuple(options.evidence), join, nway_columns, np.inf, tuning=tuning.part
    )
    chunks = [_Chunks.of(side, work.columns(k), tuning) for k, side in enumerate(bare, 1)]
    order = max(one.order for one in chunks)
    far = max(tuning.far_arcsec, tuning.far_sigmas * max(one.sigma_arcsec for one in chunks))
    sigma = math.hypot(*(one.sigma_arcsec for one in chunks)) or 1.0
    work = replace(work, sides=tuple(replace(side, cell_order=order) for side in bare), far_arcsec=far)  # type: ignore[arg-type]
    counted = _count_all(work, scratch, workers, executor, tuning, progress)
    work = replace(work, sides=tuple(_with_far(s, counted[k]) for k, s in enumerate(work.sides)))  # type: ignore[arg-type]
    rows = tuple(sum(one.rows for one in side) for side in counted)
    progress("sample")
    counts = CellCounts.sum([one.counts for side in counted for one in side])
    del counted
    places = Places.of(counts, healpix.area_arcsec2(order))
    steps, cells = drawn(counts, tuning.sampling)
    volume = places.within(counts, cells, steps)
    sampled, learned, assumed = _learn_from_sample(work, sigma, places, steps, cells, volume, options, tuning, progress)
    final = tuple(replace(s, catalogue=without_rows(c)) for s, c in zip(work.sides, sampled, strict=True))
    work = replace(work, sides=(final[0], final[1]), learned=learned)
    halo, margin = _halos(work, tuning)
    work = replace(work, halo_arcsec=halo, margin_arcsec=margin)
    assert learned.estimate is not None
    catalogues = [replace(c, doubts=first.doubts) for c, first in zip(sampled, epochs, strict=True)]
    return Estimated(work, counts, (catalogues[0], catalogues[1]), moved, (rows[0], rows[1]),
                     (*assumed, *learned.estimate.notes), learned.estimate.learned_from)  # fmt: skip


def completed_epochs(catalogues: Sequence[Catalogue], epoch_jyr: float | None) -> tuple[Catalogue, Catalogue]:
    """The catalogues with missing epochs taken from the other one; unknown errors are completed later, from the sample
    where both overlap."""
    known = [one for one in catalogues if not one.error_is_unknown and not one.choice.error.guessed_unit]
    if len(known) == 2:
        with_epochs, _ = completed(catalogues, epoch_jyr)
        return with_epochs[0], with_epochs[1]
    return catalogues[0], catalogues[1]


def _first_rows(stored: HatsCatalogue, options: CatalogueOptions, tuning: RunTuning) -> Catalogue:
    """The first rows of some partitions, with columns recognised."""
    import pyarrow as pa
    from astropy.table import Table, vstack
    from pyarrow import parquet

    tables = []
    for k in sorted({int(k) for k in np.linspace(0, len(stored.cells) - 1, tuning.column_partitions)}):
        cell = stored.cells[k]
        for file in stored._files(cell)[:1]:
            try:
                with parquet.ParquetFile(file) as opened:
                    batch = next(opened.iter_batches(batch_size=tuning.column_rows, use_threads=False), None)
            except MemoryError:
                raise
            except Exception as error:  # Arrow raises many types on damaged files
                raise InputError(f"{file}: the partition {cell} cannot be read ({error})", "restore it") from error
            if batch is not None:
                tables.append(_rows_of(pa.Table.from_batches([batch])))
    if not tables:
        raise InputError(f"{stored.name}: the catalogue has no rows")
    table = vstack(tables, metadata_conflicts="silent") if len(tables) > 1 else tables[0]
    return Catalogue.of(Table(table, copy=False), stored.name, options=options)


def _rows_of(table: Any) -> Any:
    return table_of(table.drop_columns([name for name in OWN if name in table.column_names]))


@dataclass(frozen=True)
class _Chunks:
    """Density and error of a catalogue, from runs of rows that do not depend on the partitions: the order of cells that
    hold ``records_per_cell`` records in the densest run, and the median error in arcsec, 0 if it has no errors."""

    order: int
    sigma_arcsec: float

    @classmethod
    def of(cls, side: Side, columns: list[str], tuning: RunTuning) -> _Chunks:
        chunks = [side.rows(table) for table in side.stored.chunks(tuning.chunks, tuning.chunk_rows, columns)]
        order = max(_order_of(np.sort(chunk.stored), tuning.records_per_cell) for chunk in chunks)
        if side.catalogue.error_is_unknown:
            return cls(order, 0.0)
        sigma = np.concatenate([chunk.sigma_arcsec for chunk in chunks])
        return cls(order, float(np.median(sigma)) if len(sigma) else 0.0)


def _order_of(stored: IntArray, records_per_cell: float) -> int:
    """The coarsest order at which a record's cell holds at most this many records on average; stored : (n,) ascending
    cells."""
    for order in range(3, 24):
        cells = stored >> 2 * (healpix.FINEST - order)
        count = np.diff(np.append(np.flatnonzero(np.append(True, cells[1:] != cells[:-1])), len(cells)))
        if float(count @ count) <= records_per_cell * len(cells):
            return order
    return 24


def _count_all(
    work: Work,
    scratch: Path,
    workers: int | None,
    executor: Executor | None,
    tuning: RunTuning,
    progress: Progress,
) -> tuple[list[Counted], list[Counted]]:
    """The counts of every partition of both catalogues, in parallel."""
    store(work, scratch)
    tasks = [(side, cell) for side in (1, 2) for cell in work.sides[side - 1].stored.cells]
    by_task: dict[tuple[int, Cell], Counted] = {}
    rows = sum(int(side.stored.partition_rows.sum()) for side in work.sides)
    if executor is None and rows <= tuning.max_rows_in_process:
        workers = 1
    with Workers(workers, executor, tuning.max_failures) as pool:
        for n, (task, counted) in enumerate(pool.each(count_partition, str(scratch), tasks), 1):
            by_task[task] = counted
            progress(f"counting partition {n} of {len(tasks)}")
    one, two = ([by_task[task] for task in tasks if task[0] == side] for side in (1, 2))
    return one, two


def _with_far(side: Side, counted: Sequence[Counted]) -> Side:
    """The side with its far records, their positions and their error reach."""
    cells = np.unique(np.concatenate([one.far for one in counted]))
    if not len(cells):
        return side
    table = side.stored.rows(healpix.stretches(cells, healpix.FINEST))
    rows = side.rows(table)
    kept = rows.records.rows
    import pyarrow as pa

    return replace(
        side, far=table.take(pa.array(kept)), far_direction=rows.direction, far_reach_arcsec=10.0 * rows.sigma_arcsec
    )


def _learn_from_sample(
    work: Work,
    sigma: float,
    places: Places,
    steps: int,
    cells: IntArray,
    volume: float,
    options: MatchOptions,
    tuning: RunTuning,
    progress: Progress,
) -> tuple[list[Catalogue], Learned, tuple[str, ...]]:
    """The sample's catalogues with errors and epochs completed, the estimates, and doubts on what was assumed.

    sigma : median error of a residual, arcsec. cells : (c,) of the sample, ``steps`` orders coarser than the counts;
    volume : theirs.
    """
    order = work.sides[0].cell_order - steps
    margin = tuning.margin_gates * 6.4 * sigma + 2.0 * _motion(work)
    fine = max(min(healpix.order_of_width(margin), 24), order)
    around = healpix.ring(cells, order, fine) if healpix.width_arcsec(fine) >= margin or fine > order else cells
    stretch = healpix.joined(np.concatenate([healpix.stretches(cells, order), healpix.stretches(around, fine)]))
    whole_sky = np.array([0.0, 0.0, 1.0, 2.0 * 206265.0])
    rows = [work.read(side, stretch, whole_sky, work.columns(side)) for side in (1, 2)]
    # The epoch is fixed by now; errors and their units may be inferred from both catalogues together.
    (one, two), assumed = completed([part.catalogue for part in rows], options.epoch_jyr)
    parts = [replace(part, catalogue=c, records=c.records(side.epoch_jyr))
            for part, c, side in zip(rows, (one, two), work.sides, strict=True)]  # fmt: skip
    counted = [np.isin(part.cells >> 2 * steps, cells) for part in parts]
    sample = SampleRecords(
        (parts[0].records, parts[1].records), (parts[0].cells, parts[1].cells), (counted[0], counted[1]), volume
    )
    learned = learn(
        sample, places, Assumed(options.errors(), options.gate(), options.density(), options.precision),
        brightness=brightness(one, two, options.magnitudes), progress=progress,
        evidence=columns_of(one, two, options.evidence, options.magnitudes),
    )  # fmt: skip
    return [one, two], learned, tuple(assumed)


def _motion(work: Work) -> float:
    return (
        work.far_arcsec if any(side.epoch_jyr is not None and side.catalogue.has_motion for side in work.sides) else 0.0
    )


def _halos(work: Work, tuning: RunTuning) -> tuple[float, float]:
    """Width, arcsec, of the first halo of a part, and of one that is wide enough for nearly all parts: the extent of
    the sample's groups, a gate on either side, and the motion of records."""
    from sameas.groups import laid_out

    assert work.learned is not None and work.learned.estimate is not None
    answer, learned = work.learned.estimate.answer, work.learned
    pairs = answer.pairs
    kept = np.flatnonzero(answer.evidence.log_ratio > work.tuning.competing)
    sigma = [np.sqrt(r.variances.max(axis=1)) for r in learned.start.records(pairs.first, pairs.second)]
    reach = learned.gate_sigmas * math.hypot(*(float(np.quantile(s, 0.999)) for s in sigma))
    extents = np.zeros(1)
    if len(kept):
        i, j = pairs.i[kept], pairs.j[kept]
        grouped = laid_out(pairs.place_1[kept], pairs.place_2[kept], i, j, len(pairs.first), len(pairs.second))
        lat = pairs.first.features[i, 1]
        lon = pairs.first.features[i, 0]
        extents = _group_extents(grouped.of_pairs().astype(np.int64), len(grouped), lon, lat)

    def width(share: float) -> float:
        extent = float(np.quantile(extents, share))
        return max(min(extent, 32.0 * reach) + 2.0 * reach, tuning.min_halo_arcsec) + _motion(work)

    return width(tuning.halo_share), width(tuning.margin_share)


def _group_extents(group: IntArray, n: int, lon: FloatArray, lat: FloatArray) -> FloatArray:
    """(m,) extent in arcsec of the group of each pair: an upper bound of the distance of any two of its records."""
    east = np.where(lon > 180.0, lon - 360.0, lon), np.mod(lon, 360.0)
    least_lat = _minimum_by_group(group, n, np.abs(lat))
    width = np.minimum(*(_range_by_group(group, n, x) for x in east)) * np.cos(np.radians(least_lat))
    return np.asarray(3600.0 * np.hypot(width, _range_by_group(group, n, lat)))[group]


def _range_by_group(group: IntArray, n: int, values: FloatArray) -> FloatArray:
    high = np.full(n, -np.inf)
    np.maximum.at(high, group, values)
    return high - _minimum_by_group(group, n, values)


def _minimum_by_group(group: IntArray, n: int, values: FloatArray) -> FloatArray:
    low = np.full(n, np.inf)
    np.minimum.at(low, group, values)
    return low


# A worker's functions take a folder and a task; each worker reads the common settings once.


def store(work: Work, folder: Path) -> None:
    """Write the common settings to a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    if work.learned is not None:
        work.learned.places.write(folder / "places")
        bare = replace(work.learned, places=work.learned.places.without_columns(), estimate=None)
        work = replace(work, learned=bare)
    written_whole(folder / "work.pickle", dumps(work))


def stored_work(folder: str) -> Work:
    """The settings that :func:`store` wrote."""
    return _read_work(folder, (Path(folder) / "work.pickle").stat().st_mtime_ns)


@lru_cache(maxsize=2)
def _read_work(folder: str, time_ns: int) -> Work:
    path = Path(folder) / "work.pickle"
    work: Work = loads(path.read_bytes(), str(path))
    if work.learned is None:
        return work
    places = work.learned.places.with_columns(Path(folder) / "places")
    return replace(work, learned=replace(work.learned, places=places))


def count_partition(folder: str, task: tuple[int, Cell]) -> Counted:
    """The counts of a partition; task : catalogue 1 or 2, cell."""
    return stored_work(folder).count(*task)


def decide_partition(folder: str, given: tuple[Task, str, dict[str, Any]]) -> dict[str, Any]:
    """Decide a task and write its partitions; returns the summary. given : the task, the output catalogue's folder, the
    provenance."""
    task, catalogue, facts = given
    work = stored_work(folder)
    cpu = time.process_time()
    summaries: list[dict[str, Any]] = []
    pieces = (_joined_piece(work, piece, facts, summaries) for piece in task.pieces)
    if len(task.cells) == 1:
        written = [write_rows(pieces, partition_file(Path(catalogue), task.cells[0]))]
    else:
        (rows,) = pieces
        begins = np.searchsorted(numbers_of(rows, CELL), [cell.stretch[0] for cell in task.cells])
        written = [write_rows([rows.slice(begin, end - begin)], partition_file(Path(catalogue), cell))
                   for cell, (begin, end) in zip(task.cells, begins, strict=True)]  # fmt: skip
    non_empty = [[cell.order, cell.number] for cell, rows in zip(task.cells, written, strict=True) if rows]
    summary = {key: (max if key == "halo_arcsec" else sum)(one[key] for one in summaries) for key in summaries[0]}
    summary |= {"written": non_empty, "order": task.cell.order, "number": task.cell.number}
    written_whole(summary_file(Path(folder), task), json.dumps(summary).encode())
    return summary | {"cpu_seconds": time.process_time() - cpu}


def _joined_piece(work: Work, piece: tuple[Cell, ...], facts: dict[str, Any], summaries: list[dict[str, Any]]) -> Any:
    """The Arrow table of a piece's joined rows, by ascending cell of order 29; appends to ``summaries``."""
    import pyarrow as pa

    tables = []
    for part in work.decide(piece):
        summaries.append(part.summary)
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


def summary_file(folder: Path, task: Task) -> Path:
    """The file of a finished task's summary."""
    return folder / "done" / f"{task.cell.order}-{task.cell.number}.json"


class Workers:
    """A context manager of worker processes, or of the caller's executor."""

    def __init__(
        self, number: int | None, executor: Executor | None, max_failures: int = DEFAULT_RUN.max_failures
    ) -> None:
        self.max_failures = max_failures
        self.number = threads.count() if number is None else number
        if self.number < 1:
            raise InputError(f"workers is {number}; give 1 or more")
        self.executor = executor
        self._own: ProcessPoolExecutor | None = None

    def __enter__(self) -> Workers:
        return self

    def __exit__(self, *error: object) -> None:
        if self._own is not None:
            self._own.shutdown(wait=error[0] is None, cancel_futures=True)

    def each(self, work: Callable[[str, Any], Any], folder: str, tasks: Sequence[Any]) -> Iterator[tuple[Any, Any]]:
        """Tasks and their results, in the order of completion.

        Raises
        ------
        InputError : raised by a task; or workers keep dying: names the tasks that they were at.
        """
        if self.executor is None and self.number == 1:
            for task in tasks:
                yield task, work(folder, task)
            return
        left, failures = list(tasks), 0
        while left:
            done = []
            try:
                for task, result in self._completed(work, folder, left):
                    done.append(task)
                    yield task, result
            except BrokenProcessPool as error:
                failures = 1 if done else failures + 1
                self._own = None
                if failures >= self.max_failures:
                    at = ", ".join(str(_cell_of_task(task)) for task in left[: len(done) + self.number][:3])
                    raise InputError(
                        f"workers died {failures} times, at one of the partitions {at} …; finished parts are kept",
                        "give fewer workers if memory ran out, and call again",
                    ) from error
            finished = {id(task) for task in done}
            left = [task for task in left if id(task) not in finished]

    def _completed(
        self, work: Callable[[str, Any], Any], folder: str, tasks: Sequence[Any]
    ) -> Iterator[tuple[Any, Any]]:
        """Tasks and their results, until a worker dies."""
        pool = self._pool()
        with _empty_main():
            futures: dict[Future[Any], Any] = {pool.submit(work, folder, task): task for task in tasks}
        for future in as_completed(futures):
            yield futures[future], future.result()

    def _pool(self) -> Executor:
        if self.executor is not None:
            return self.executor
        if self._own is None:
            import multiprocessing

            # With a fork server, one process imports everything and workers are forked from it.
            can_fork = "forkserver" in multiprocessing.get_all_start_methods()
            context: Any = multiprocessing.get_context("forkserver" if can_fork else "spawn")
            if can_fork:
                context.set_forkserver_preload(list(_PRELOADED))
            self._own = ProcessPoolExecutor(self.number, mp_context=context, initializer=_start_worker)
        return self._own


def _cell_of_task(task: Any) -> Any:
    return next((part for part in task if isinstance(part, Cell)), task)


@contextmanager
def _empty_main() -> Iterator[None]:
    """Processes started within it do not import the caller's script: scripts need no ``if __name__ == "__main__"``."""
    main = sys.modules["__main__"]
    sys.modules["__main__"] = types.ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = main


#: Modules that the fork server imports.
_PRELOADED = ("sameas.partitions.run", "sameas._identify", "numba", "pyarrow.parquet", "pyarrow.compute", "cdshealpix",
           "scipy.spatial", "astropy.table", "astropy.coordinates")  # fmt: skip


def _start_worker() -> None:
    """Let a worker use one thread, ignore Ctrl-C, and end with the process that started the run."""
    os.environ["SAMEAS_THREADS"] = "1"
    # A terminal sends SIGINT to all processes; the main process ends its workers. The worker watches the main process
    # and not its own parent, the fork server, which lives as long as its workers do.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_with_parent()


# The output.


@in_short
@dataclass(frozen=True)
class Written:
    """The output of a run.

    path : the collection. rows, partitions : of the joined catalogue. pairs : identified. expected_wrong,
    expected_common : expected numbers of wrong pairs among them and of common objects. doubtful : rows of both
    catalogues whose answer a wider halo might change. halo_arcsec : the widest. decided : tasks decided in this call,
    the others were already written. cpu_seconds : of these. read : records in all pieces and their halos, counted again
    for each widened halo.
    """

    path: Path
    rows: int
    partitions: int
    pairs: int
    expected_common: float
    expected_wrong: float
    doubtful: int
    halo_arcsec: float
    decided: int
    cpu_seconds: float
    read: int


def write(
    estimated: Estimated,
    path: Path,
    facts: dict[str, Any],
    *,
    margin_arcsec: float = 10.0,
    workers: int | None = None,
    executor: Executor | None = None,
    progress: Progress = lambda stage: None,
    piece_rows: int = PIECE_ROWS,
) -> Written:
    """Decide all parts and write them as a HATS collection; parts written by an interrupted run are kept.

    path : the collection's folder. facts : the provenance; an unfinished run with another one is refused. piece_rows :
    approximate records of both catalogues in a piece; fewer where they would have too many candidates.

    Raises
    ------
    InputError : the folder exists and is not an unfinished run with the same provenance; a partition cannot be read, by
        name; workers keep dying; the disk is full.
    """
    collection = _Collection(path, facts, margin_arcsec, piece_rows)
    try:
        write_all = partial(_write_all, estimated, collection, workers, executor, progress)
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
    estimated: Estimated,
    collection: _Collection,
    workers: int | None,
    executor: Executor | None,
    progress: Progress,
    last: Callable[[], None],
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
    summaries = [_finished_summary(scratch, catalogue, task) for task in all_tasks]
    tasks = [(task, str(catalogue), facts)
             for task, summary in zip(all_tasks, summaries, strict=True) if summary is None]  # fmt: skip
    finished, cpu = [summary for summary in summaries if summary is not None], 0.0
    with Workers(workers if len(tasks) > 1 else 1, executor) as pool:
        for n, (_, summary) in enumerate(pool.each(decide_partition, str(scratch), tasks), 1):
            finished.append(summary)
            cpu += summary["cpu_seconds"]
            progress(f"part {n + len(summaries) - len(tasks)} of {len(summaries)}")
        non_empty = [Cell(*cell) for summary in finished for cell in summary["written"]]
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
    finished = sorted(finished, key=lambda summary: (summary["order"], summary["number"]))
    sums = {key: sum(summary[key] for summary in finished)
            for key in ("pairs", "expected_common", "expected_wrong", "doubtful", "read")}  # fmt: skip
    widest = max(summary["halo_arcsec"] for summary in finished)
    return Written(path, rows, len(non_empty), sums["pairs"], sums["expected_common"], sums["expected_wrong"],
                   sums["doubtful"], widest, len(tasks), cpu, sums["read"])  # fmt: skip


def _finished_summary(scratch: Path, catalogue: Path, task: Task) -> dict[str, Any] | None:
    """The summary of a finished task whose files all exist, else None."""
    file = summary_file(scratch, task)
    if not file.exists():
        return None
    with reading(str(file), "is not as it was written"):
        summary: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
        complete = all(partition_file(catalogue, Cell(*cell)).exists() for cell in summary["written"])
    return summary if complete else None


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

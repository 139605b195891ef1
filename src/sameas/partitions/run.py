"""A run over all parts: side by side in processes, each part kept when it is done, gone on with after an interruption.

Every worker reads the value that is the same for all parts (:class:`~sameas.partitions.part.Work`) from a folder beside
the output; what a part gives is a file that is whole or absent, so that nothing but the folder is shared.
"""

from __future__ import annotations

import json
import math
import os
import shutil
import sys
import threading
import time
import types
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from sameas.arrays import FloatArray, IntArray
from sameas.errors import InputError
from sameas.estimate.places import Counts, Learned, Places, drawn, learn
from sameas.estimate.sample import Sampling
from sameas.kernels import threads
from sameas.partitions import cells as healpix
from sameas.partitions.layout import CELL, OWN, Cell, HatsCatalogue
from sameas.partitions.output import (  # fmt: skip
    arrow_of,
    finish_catalogue,
    partition_file,
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
from sameas.saved import dumps, loads
from sameas.sky.assumed import completed
from sameas.sky.catalogue import Catalogue, CatalogueOptions
from sameas.sky.crossmatch import MatchOptions, common_epoch
from sameas.sky.joins import joined_names

Progress = Callable[[str], None]


@dataclass(frozen=True)
class RunTuning:
    """How a run is cut and what it looks at; all chosen.

    Attributes
    ----------
    looked_at : rows of a partition by which its columns are understood. partitions : so many of them.
    far_arcsec, far_sigmas : records that move, or whose errors reach, farther than this, and than so many usual
        errors, are looked for everywhere.
    in_cell : records in a cell of the finest counts, where the catalogue is densest.
    margin_gates : the margin of the sample, in gates that are as wide as the quoted errors let expect.
    groups : the halo holds this share of the groups of the sample. least_halo_arcsec : at least.
    failures : a worker may die so often without anything being done meanwhile.
    """

    looked_at: int = 20_000
    partitions: int = 3
    far_arcsec: float = 10.0
    far_sigmas: float = 40.0
    in_cell: float = 4.0
    margin_gates: float = 8.0
    groups: float = 0.9999
    least_halo_arcsec: float = 1.0
    failures: int = 3
    sampling: Sampling = Sampling()  # noqa: RUF009


DEFAULT_RUN = RunTuning()


@in_short
@dataclass(frozen=True)
class Estimated:
    """Two catalogues understood, and everything estimated: what every part is decided by.

    work : the same for all parts. catalogues : as understood, with a sample of their rows. moved : one sentence on the
    common epoch. rows : of both. doubts : what looks wrong. sample : of both catalogues, which was estimated from.
    """

    work: Work
    catalogues: tuple[Catalogue, Catalogue]
    moved: str
    rows: tuple[int, int]
    doubts: tuple[str, ...]
    sample: tuple[int, int]

    @property
    def learned(self) -> Learned:
        """What is known."""
        assert self.work.learned is not None
        return self.work.learned


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
    part_tuning: PartTuning = DEFAULT_PART,
    scratch: Path,
) -> Estimated:
    """Everything that is not known of two catalogues, estimated once, from all partitions.

    stored : the catalogues. columns : what the user says of their columns. options : of the match. join, nway_columns :
    of the output. workers : processes; as many as there are processors if not given. executor : used instead of them.
    scratch : a folder that workers see too.

    Raises
    ------
    InputError : columns that are not understood; no usable rows; a partition that cannot be read, by name.
    """
    if options.offset != "none":
        raise InputError("offset: an offset is not looked for over partitions", "take it away before the import")
    if options.evidence:
        raise InputError("evidence: columns are not learned over partitions", "leave them out")
    for side in columns:
        if side.fill_errors:
            raise InputError("fill_errors: typical errors would depend on the partition", "give every row an error")
    progress("columns")
    looks = tuple(_look(one, stated, tuning) for one, stated in zip(stored, columns, strict=True))
    epochs = completed_epochs(looks, options.epoch_jyr)
    epoch, moved = common_epoch(*epochs, options.epoch_jyr)
    order = _cell_order(stored, tuning)
    sides = tuple(Side(one, without_rows(look), epoch, order) for one, look in zip(stored, epochs, strict=True))
    far = max(tuning.far_arcsec, tuning.far_sigmas * max(_usual_sigma(look) for look in epochs))
    work = Work((sides[0], sides[1]), options.magnitudes, join, nway_columns, far, tuning=part_tuning)
    counted = _counted(work, scratch, workers, executor, progress, tuning)
    work = replace(work, sides=tuple(_with_far(s, counted[k], work) for k, s in enumerate(work.sides)))  # type: ignore[arg-type]
    progress("sample")
    counts = Counts.sum([one.counts for side in counted for one in side])
    places = Places.of(counts, healpix.area_arcsec2(order))
    steps, cells = drawn(counts, tuning.sampling)
    volume = len(cells) * healpix.area_arcsec2(order - steps)
    sampled, learned, assumed = _learned(work, epochs, places, steps, cells, volume, options, progress, tuning)
    final = tuple(replace(s, understood=without_rows(c)) for s, c in zip(work.sides, sampled, strict=True))
    work = replace(work, sides=(final[0], final[1]), learned=learned)
    work = replace(work, halo_arcsec=_halo(work, tuning))
    assert learned.estimate is not None
    rows = tuple(sum(one.rows for one in side) for side in counted)
    return Estimated(work, (sampled[0], sampled[1]), moved, (rows[0], rows[1]),
                     (*assumed, *learned.estimate.notes), learned.estimate.learned_from)  # fmt: skip


def completed_epochs(looks: Sequence[Catalogue], epoch_jyr: float | None) -> tuple[Catalogue, Catalogue]:
    """The catalogues with epochs that the other one tells; errors are completed later, where both overlap."""
    known = [look for look in looks if not look.error_is_unknown and not look.choice.error.guessed_unit]
    if len(known) == 2:
        made, _ = completed(looks, epoch_jyr)
        return made[0], made[1]
    return looks[0], looks[1]


def _look(stored: HatsCatalogue, stated: CatalogueOptions, tuning: RunTuning) -> Catalogue:
    """A catalogue understood by some rows of some partitions."""
    import pyarrow as pa
    from astropy.table import Table, vstack
    from pyarrow import parquet

    places = sorted({int(k) for k in np.linspace(0, len(stored.cells) - 1, tuning.partitions)})
    tables = []
    for k in places:
        cell = stored.cells[k]
        for file in stored._files(cell)[:1]:
            try:
                with parquet.ParquetFile(file) as opened:
                    batch = next(opened.iter_batches(batch_size=tuning.looked_at, use_threads=False), None)
            except (OSError, pa.ArrowException) as error:
                raise InputError(f"{file}: the partition {cell} cannot be read ({error})", "restore it") from error
            if batch is not None:
                tables.append(_rows_of(pa.Table.from_batches([batch])))
    if not tables:
        raise InputError(f"{stored.name}: the catalogue has no rows")
    table = vstack(tables, metadata_conflicts="silent") if len(tables) > 1 else tables[0]
    return Catalogue.of(Table(table, copy=False), stored.name, options=stated)


def _rows_of(table: Any) -> Any:
    return table_of(table.drop_columns([name for name in OWN if name in table.column_names]))


def _usual_sigma(look: Catalogue) -> float:
    if look.error_is_unknown:
        return 0.0
    variances = look.records().variances
    return float(np.sqrt(np.median(variances.max(axis=1)))) if len(variances) else 0.0


def _cell_order(stored: Sequence[HatsCatalogue], tuning: RunTuning) -> int:
    """The order of cells that hold a few records where a catalogue is densest."""
    most = 1.0
    for one in stored:
        rows = one.count()
        density = max(n / healpix.area_arcsec2(cell.order) for n, cell in zip(rows, one.cells, strict=True))
        most = max(most, math.log(max(density, 1e-30) / tuning.in_cell * healpix.area_arcsec2(0), 4.0))
    return int(min(max(math.ceil(most), 3), 24))


def _counted(
    work: Work, scratch: Path, workers: int | None, executor: Executor | None, progress: Progress, tuning: RunTuning
) -> tuple[list[Counted], list[Counted]]:
    """What every partition of both catalogues tells, counted side by side."""
    store(work, scratch)
    tasks = [(side, cell) for side in (1, 2) for cell in work.sides[side - 1].stored.cells]
    by_task: dict[tuple[int, Cell], Counted] = {}
    with Workers(workers, executor, tuning) as pool:
        for n, (task, counted) in enumerate(pool.each(count_partition, str(scratch), tasks), 1):
            by_task[task] = counted
            progress(f"counting partition {n} of {len(tasks)}")
    one, two = ([by_task[task] for task in tasks if task[0] == side] for side in (1, 2))
    return one, two


def _with_far(side: Side, counted: Sequence[Counted], work: Work) -> Side:
    """The side with its far records, where they are and how far they reach."""
    cells = np.unique(np.concatenate([one.far for one in counted]))
    if not len(cells):
        return side
    table = side.stored.rows(healpix.stretches(cells, healpix.FINEST))
    rows = side.rows(table)
    kept = rows.records.rows
    import pyarrow as pa

    return replace(
        side, far=table.take(pa.array(kept)), far_place=rows.place, far_reach_arcsec=10.0 * rows.sigma_arcsec
    )


def _learned(
    work: Work, looks: tuple[Catalogue, Catalogue], places: Places, steps: int, cells: IntArray, volume: float,
    options: MatchOptions, progress: Progress, tuning: RunTuning,
) -> tuple[list[Catalogue], Learned, tuple[str, ...]]:  # fmt: skip
    """The sample's catalogues, completed; what they say; and the doubts of what was assumed."""
    order = work.sides[0].cell_order - steps
    usual = math.hypot(*(_usual_sigma(look) for look in looks)) or 1.0
    margin = tuning.margin_gates * 6.4 * usual + 2.0 * _motion(work)
    fine = max(min(healpix.order_of_width(margin), 24), order)
    ring = healpix.ring(cells, order, fine) if healpix.width_arcsec(fine) >= margin or fine > order else cells
    stretch = healpix.joined(np.concatenate([healpix.stretches(cells, order), healpix.stretches(ring, fine)]))
    every = np.array([0.0, 0.0, 1.0, 2.0 * 206265.0])
    rows = [work.read(side, stretch, every, work.sides[side - 1].columns(work.magnitudes)) for side in (1, 2)]
    # The epoch is the same for all; errors and their units may follow from both together.
    (one, two), assumed = completed([part.catalogue for part in rows], options.epoch_jyr)
    made = [replace(part, catalogue=c, records=c.records(side.epoch_jyr))
            for part, c, side in zip(rows, (one, two), work.sides, strict=True)]  # fmt: skip
    counted = [np.isin(part.cells >> 2 * steps, cells) for part in made]
    learned = learn(
        (made[0].records, made[1].records), (made[0].cells, made[1].cells), (counted[0], counted[1]), places, volume,
        errors=options.errors(), gate=options.gate(), density=options.density(),
        brightness=brightness(one, two, options.magnitudes), precision=options.precision, progress=progress,
    )  # fmt: skip
    return [one, two], learned, tuple(assumed)


def _motion(work: Work) -> float:
    return (
        work.far_arcsec
        if any(side.epoch_jyr is not None and side.understood.has_motion for side in work.sides)
        else 0.0
    )


def _halo(work: Work, tuning: RunTuning) -> float:
    """The halo with which parts are decided first: it holds nearly all groups of the sample, a gate around them, and
    what may have moved into it."""
    from sameas.groups import laid_out

    assert work.learned is not None and work.learned.estimate is not None
    answer, learned = work.learned.estimate.answer, work.learned
    pairs = answer.pairs
    kept = np.flatnonzero(answer.evidence.log_ratio > work.tuning.competing)
    sigma = [np.sqrt(r.variances.max(axis=1)) for r in learned.start.records(pairs.first, pairs.second)]
    reach = learned.gate_sigmas * math.hypot(*(float(np.quantile(s, 0.999)) for s in sigma))
    extent = 0.0
    if len(kept):
        i, j = pairs.i[kept], pairs.j[kept]
        grouped = laid_out(pairs.place_1[kept], pairs.place_2[kept], i, j, len(pairs.first), len(pairs.second))
        lat = pairs.first.features[i, 1]
        lon = pairs.first.features[i, 0]
        extents = _extents(grouped.of_pairs().astype(np.int64), len(grouped), lon, lat)
        extent = float(np.quantile(extents, tuning.groups))
    halo = max(min(extent, 32.0 * reach) + 2.0 * reach, tuning.least_halo_arcsec) + _motion(work)
    return halo


def _extents(group: IntArray, n: int, lon: FloatArray, lat: FloatArray) -> FloatArray:
    """(m,) arcsec, of the group of each pair, no less than between the two records farthest apart."""
    east = np.where(lon > 180.0, lon - 360.0, lon), np.mod(lon, 360.0)
    width = np.minimum(*(_spread(group, n, x) for x in east)) * np.cos(np.radians(_least(group, n, np.abs(lat))))
    return np.asarray(3600.0 * np.hypot(width, _spread(group, n, lat)))[group]


def _spread(group: IntArray, n: int, values: FloatArray) -> FloatArray:
    high = np.full(n, -np.inf)
    np.maximum.at(high, group, values)
    return high - _least(group, n, values)


def _least(group: IntArray, n: int, values: FloatArray) -> FloatArray:
    low = np.full(n, np.inf)
    np.minimum.at(low, group, values)
    return low


# What workers are given: a folder and a task. What is the same for all is read once by each.


def store(work: Work, folder: Path) -> None:
    """Puts what is the same for all parts into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    if work.learned is not None:
        work.learned.places.write(folder / "places")
        bare = replace(work.learned, places=work.learned.places.without_columns(), estimate=None)
        work = replace(work, learned=bare)
    written_whole(folder / "work.pickle", dumps(work))


def stored_work(folder: str) -> Work:
    """What :func:`store` put there."""
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
    """A partition counted."""
    return stored_work(folder).count(*task)


def decide_partition(folder: str, task: tuple[Cell, str, dict[str, Any]]) -> dict[str, Any]:
    """A part decided and written; its summary. task : its cell, the catalogue's folder, how it was made."""
    cell, catalogue, facts = task
    work = stored_work(folder)
    began, cpu = time.perf_counter(), time.process_time()
    part = work.decided(cell)
    table, cells = part.table(work)
    summary = part.summary | {"written": len(cells), "order": cell.order, "number": cell.number}
    if len(cells):
        write_rows(arrow_of(table, cells, facts), partition_file(Path(catalogue), cell))
    written_whole(summary_file(Path(folder), cell), json.dumps(summary).encode())
    return summary | {"seconds": time.perf_counter() - began, "cpu_seconds": time.process_time() - cpu}


def margin_partition(folder: str, task: tuple[Cell, str, str, float]) -> int:
    """A partition's margin written; its rows. task : cell, folders of the catalogue and of its margin, its width."""
    cell, catalogue, margin, arcsec = task
    return write_margin(_output(catalogue), cell, arcsec, Path(margin))


@lru_cache(maxsize=2)
def _output(folder: str) -> HatsCatalogue:
    return HatsCatalogue.open(folder)


def summary_file(folder: Path, cell: Cell) -> Path:
    """Where the summary of a part that is done lies."""
    return folder / "done" / f"{cell.order}-{cell.number}.json"


class Workers:
    """Processes that work on tasks, or an executor that somebody else brought; use it with ``with``."""

    def __init__(self, number: int | None, executor: Executor | None, tuning: RunTuning) -> None:
        self.number = threads.count() if number is None else number
        if self.number < 1:
            raise InputError(f"workers is {number}; give 1 or more")
        self.given, self.tuning = executor, tuning
        self._own: ProcessPoolExecutor | None = None

    def __enter__(self) -> Workers:
        return self

    def __exit__(self, *error: object) -> None:
        if self._own is not None:
            self._own.shutdown(wait=error[0] is None, cancel_futures=True)

    def each(self, work: Callable[[str, Any], Any], folder: str, tasks: Sequence[Any]) -> Iterator[tuple[Any, Any]]:
        """Tasks and their results, in the order in which they are done.

        Raises
        ------
        InputError : what a task refuses; workers that keep dying, with the tasks that they were at.
        """
        if self.given is None and self.number == 1:
            for task in tasks:
                yield task, work(folder, task)
            return
        left, failures = list(tasks), 0
        while left:
            done = []
            try:
                for task, result in self._round(work, folder, left):
                    done.append(task)
                    yield task, result
            except BrokenProcessPool as error:
                failures = 1 if done else failures + 1
                self._own = None
                if failures >= self.tuning.failures:
                    at = ", ".join(str(_cell_of(task)) for task in left[: len(done) + self.number][:3])
                    raise InputError(
                        f"workers died {failures} times, at one of the partitions {at} …; what is done stays",
                        "give fewer workers if memory ran out, and call again",
                    ) from error
            gone = {id(task) for task in done}
            left = [task for task in left if id(task) not in gone]

    def _round(self, work: Callable[[str, Any], Any], folder: str, tasks: Sequence[Any]) -> Iterator[tuple[Any, Any]]:
        pool = self._pool()
        with _nameless_main():
            futures: dict[Future[Any], Any] = {pool.submit(work, folder, task): task for task in tasks}
        for future in as_completed(futures):
            yield futures[future], future.result()

    def _pool(self) -> Executor:
        if self.given is not None:
            return self.given
        if self._own is None:
            from multiprocessing import get_context

            self._own = ProcessPoolExecutor(
                self.number, mp_context=get_context("spawn"), initializer=_begin, initargs=(os.getpid(),)
            )
        return self._own


def _cell_of(task: Any) -> Any:
    return next((part for part in task if isinstance(part, Cell)), task)


@contextmanager
def _nameless_main() -> Iterator[None]:
    """Processes that start meanwhile do not run the caller's script again: a script needs no guard."""
    main = sys.modules["__main__"]
    sys.modules["__main__"] = types.ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = main


def _begin(parent: int) -> None:
    """A worker uses one thread, and ends when the one who started it is gone."""
    os.environ["SAMEAS_THREADS"] = "1"

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(1.0)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


# The output.


@in_short
@dataclass(frozen=True)
class Written:
    """What a run wrote.

    path : the collection. rows : of the joined catalogue. partitions : of it. pairs : identified. expected_wrong,
    expected_common : of them. doubtful : rows of the first catalogue whose answer a wider halo might change.
    halo_arcsec : the widest. decided : parts decided in this call, the others were there. cpu_seconds : of these.
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


def write(
    estimated: Estimated,
    path: Path,
    facts: dict[str, Any],
    *,
    margin_arcsec: float = 10.0,
    workers: int | None = None,
    executor: Executor | None = None,
    progress: Progress = lambda stage: None,
    tuning: RunTuning = DEFAULT_RUN,
) -> Written:
    """All parts decided and written as a HATS collection; parts that an interrupted run has written stay.

    path : the collection's folder. facts : how it is made; a folder that was begun otherwise is refused.
    """
    work, name = estimated.work, path.name
    catalogue, scratch = path / name, path / ".sameas-run"
    if (path / "collection.properties").exists():
        raise InputError(f"{path}: exists already", "give another name, or remove it")
    mark = scratch / "begun.json"
    if mark.exists() and json.loads(mark.read_text(encoding="utf-8")) != facts:
        raise InputError(f"{path}: was begun with other catalogues or options", "give another name, or remove it")
    if path.exists() and not mark.exists() and any(path.iterdir()):
        raise InputError(f"{path}: exists already, and is no unfinished match", "give another name, or remove it")
    store(work, scratch)
    written_whole(mark, json.dumps(facts).encode())
    cells = output_cells(work)
    summaries = [_finished(scratch, catalogue, cell) for cell in cells]
    tasks = [(cell, str(catalogue), facts) for cell, done in zip(cells, summaries, strict=True) if done is None]
    done, cpu = [one for one in summaries if one is not None], 0.0
    with Workers(workers, executor, tuning) as pool:
        for n, (_, summary) in enumerate(pool.each(decide_partition, str(scratch), tasks), 1):
            done.append(summary)
            cpu += summary["cpu_seconds"]
            progress(f"partition {n + len(cells) - len(tasks)} of {len(cells)}")
        full = [Cell(one["order"], one["number"]) for one in done if one["written"]]
        if not full:
            raise InputError(f"{path}: the join {work.join} has no rows; nothing was written")
        rows = finish_catalogue(catalogue, full, _properties(work, name), facts)
        margin = f"{name}_{margin_arcsec:g}arcs" if margin_arcsec > 0.0 else None
        if margin is not None:
            progress("margin")
            _write_margins(
                pool, str(scratch), catalogue, path / margin, full, margin_arcsec, _properties(work, name), facts
            )
    for left in path.rglob(".*.part"):  # of workers that died while they wrote
        left.unlink(missing_ok=True)
    write_collection(path, name, margin if margin is not None and (path / margin).exists() else None)
    shutil.rmtree(scratch)
    sums = {key: sum(one[key] for one in sorted(done, key=lambda one: (one["order"], one["number"])))
            for key in ("pairs", "expected_common", "expected_wrong", "doubtful")}  # fmt: skip
    widest = max(one["halo_arcsec"] for one in done)
    return Written(path, rows, len(full), sums["pairs"], sums["expected_common"], sums["expected_wrong"],
                   sums["doubtful"], widest, len(tasks), cpu)  # fmt: skip


def _finished(scratch: Path, catalogue: Path, cell: Cell) -> dict[str, Any] | None:
    """The summary of a part that is done; None where it is not."""
    file = summary_file(scratch, cell)
    if not file.exists():
        return None
    summary: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
    return summary if not summary["written"] or partition_file(catalogue, cell).exists() else None


def _write_margins(
    pool: Workers, scratch: str, catalogue: Path, margin: Path, cells: Sequence[Cell], arcsec: float,
    stated: dict[str, Any], facts: dict[str, Any],
) -> None:  # fmt: skip
    _output.cache_clear()
    tasks = [(cell, str(catalogue), str(margin), arcsec) for cell in cells]
    full = [task[0] for task, rows in pool.each(margin_partition, scratch, tasks) if rows]
    if full:
        own = {"dataproduct_type": "margin", "obs_collection": margin.name, "hats_primary_table_url": catalogue.name,
               "hats_margin_threshold": f"{arcsec:g}"}  # fmt: skip
        finish_catalogue(margin, full, {**stated, **own}, facts)


def _properties(work: Work, name: str) -> dict[str, Any]:
    """Properties of the output besides those that follow from its partitions."""
    ra, dec = position_columns(work)
    return {
        "obs_collection": name, "dataproduct_type": "object", "hats_col_ra": ra, "hats_col_dec": dec,
        "hats_col_healpix": CELL, "hats_col_healpix_order": healpix.FINEST, "hats_builder": "sameas",
    }  # fmt: skip


def position_columns(work: Work) -> tuple[str, str]:
    """The columns of positions in the output: those of the first catalogue, or of whichever a row has."""
    if work.join in WITH_SECOND:
        return "_ra", "_dec"
    schemas = [[name for name in side.stored.schema.names if name not in (CELL, "Norder", "Dir", "Npix")]
               for side in work.sides]  # fmt: skip
    from astropy.table import Table

    tables = [Table({name: [0] for name in names}) for names in schemas]
    called = dict(zip(schemas[0], joined_names(*tables)[0], strict=True))
    ra, dec = work.sides[0].stored.position
    return called[ra], called[dec]


def output_cells(work: Work) -> list[Cell]:
    """The cells that are decided one by one: the first catalogue's partitions, and where the join writes rows of the
    second alone, what of its partitions these leave uncovered."""
    cells = list(work.sides[0].stored.cells)
    if work.join in WITH_SECOND:
        covered = healpix.joined(work.sides[0].stored.stretches)
        for cell in work.sides[1].stored.cells:
            cells += _uncovered(cell, covered)
    return sorted(cells, key=lambda cell: (int(cell.stretch[0, 0]), cell.order))


def _uncovered(cell: Cell, covered: IntArray) -> list[Cell]:
    """The largest cells within one that a set of stretches does not touch."""
    begin, end = cell.stretch[0]
    at = int(np.searchsorted(covered[:, 1], begin, side="right"))
    if at == len(covered) or covered[at, 0] >= end:
        return [cell]
    if covered[at, 0] <= begin and covered[at, 1] >= end:
        return []
    inner = (Cell(cell.order + 1, 4 * cell.number + k) for k in range(4))
    return [one for part in inner for one in _uncovered(part, covered)]

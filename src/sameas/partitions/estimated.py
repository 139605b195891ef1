"""What is estimated from two partitioned catalogues, once: from the counts of all partitions and a sample of cells."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sameas.arrays import FloatArray, IntArray
from sameas.errors import InputError, naming
from sameas.estimate.match import Assumed
from sameas.estimate.places import CellCounts, Learned, Places, SampleRecords, drawn, learn
from sameas.estimate.sample import Sampling
from sameas.evidence import Related
from sameas.partitions import healpix
from sameas.partitions.hats import OWN, Cell, HatsCatalogue
from sameas.partitions.part import COMPETING, Counted, Side, Work, brightness, table_of, without_rows
from sameas.partitions.workers import Workers, store, stored_work
from sameas.representation import in_short
from sameas.sky.catalogue import Catalogue, CatalogueOptions
from sameas.sky.completion import completed, with_known_epochs
from sameas.sky.crossmatch import MatchOptions, common_epoch, left_behind_doubt
from sameas.sky.evidence_columns import columns_of

if TYPE_CHECKING:
    import pyarrow as pa
    from astropy.table import Table

Progress = Callable[[str], None]


COLUMN_ROWS, COLUMN_PARTITIONS = 20_000, 3  # rows of each partition, and partitions, from which columns are recognised
#: A record is *far* if its motion or error reach exceeds the larger of FAR_ARCSEC and FAR_SIGMAS median errors; far
#: records are read for every part.
FAR_ARCSEC, FAR_SIGMAS = 10.0, 40.0
#: Number and size of runs of rows consecutive on the sky, from which a catalogue's density and median error are
#: measured. Their choice does not depend on the partitions.
CHUNKS, CHUNK_ROWS = 16, 4_000
#: In the finest cells of the counts, the mean number of records in a record's cell, in the densest chunk.
RECORDS_PER_CELL = 8.0
MARGIN_GATES = 8.0  # margin of the sample, in gates of the width expected from the quoted errors
#: The first halo of a part, and one that is wide enough for nearly all parts, span the groups that hold this share of
#: the sample's pairs.
HALO_SHARE, MARGIN_SHARE = 0.8, 0.9999
MIN_HALO_ARCSEC = 1.0  # lower limit of both
#: Catalogues of at most this many rows are counted without workers, each of which takes a CPU second to start.
MAX_ROWS_IN_PROCESS = 3_000_000
#: Size of the sample. Noqa: RUF009.
SAMPLING = Sampling()


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
    workers: Workers,
    scratch: Path,
    progress: Progress = lambda stage: None,
) -> Estimated:
    """Everything that has to be estimated from two catalogues: once, from the counts of all partitions and a sample.

    stored : the catalogues. columns : the user's choice of their columns. options : of the match. join, nway_columns :
    of the output. scratch : a folder that workers can read and write.

    Raises
    ------
    InputError : columns that are not recognised; no usable rows; a partition that cannot be read, by name.
    """
    _refuse_unsupported(options, columns)
    progress("columns")
    samples = tuple(_first_rows(one, chosen) for one, chosen in zip(stored, columns, strict=True))
    columns_of(samples[0], samples[1], options.evidence)  # refuses columns that do not exist
    # Unknown errors are completed later, from the sample where both overlap.
    epochs, assumed_epochs = with_known_epochs(samples, options.epoch_jyr)
    epoch, moved = common_epoch(epochs[0], epochs[1], options.epoch_jyr)
    bare = tuple(Side(one, without_rows(sample), epoch, 0) for one, sample in zip(stored, epochs, strict=True))
    work = Work((bare[0], bare[1]), options.magnitudes, tuple(options.evidence), join, nway_columns, np.inf)
    chunks = [_Chunks.of(side, work.columns(k)) for k, side in enumerate(bare, 1)]
    order = max(one.order for one in chunks)
    far = max(FAR_ARCSEC, FAR_SIGMAS * max(one.sigma_arcsec for one in chunks))
    sigma = math.hypot(*(one.sigma_arcsec for one in chunks)) or 1.0
    work = replace(work, sides=tuple(replace(side, cell_order=order) for side in bare), far_arcsec=far)  # type: ignore[arg-type]
    counted = _count_all(work, scratch, workers, progress)
    work = replace(work, sides=tuple(_with_far(s, counted[k]) for k, s in enumerate(work.sides)))  # type: ignore[arg-type]
    rows = tuple(sum(one.rows for one in side) for side in counted)
    progress("sample")
    counts = CellCounts.sum([one.counts for side in counted for one in side])
    del counted
    places = Places.of(counts, healpix.area_arcsec2(order))
    sampled, learned, assumed = _learn_from_sample(work, sigma, places, counts, options, progress)
    final = tuple(replace(s, catalogue=without_rows(c)) for s, c in zip(work.sides, sampled, strict=True))
    work = replace(work, sides=(final[0], final[1]), learned=learned)
    halo, margin = _halos(work)
    work = replace(work, halo_arcsec=halo, margin_arcsec=margin)
    assert learned.estimate is not None
    doubts = *assumed_epochs, *left_behind_doubt(epochs[0], epochs[1], options.epoch_jyr)
    catalogues = [replace(c, doubts=first.doubts) for c, first in zip(sampled, epochs, strict=True)]
    return Estimated(work, counts, (catalogues[0], catalogues[1]), moved, (rows[0], rows[1]),
                     (*doubts, *assumed, *learned.estimate.notes), learned.estimate.learned_from)  # fmt: skip


def _refuse_unsupported(options: MatchOptions, columns: tuple[CatalogueOptions, CatalogueOptions]) -> None:
    """Refuse what needs the rows of all partitions at once."""
    if options.offset != "none":
        raise InputError(naming("{offset}: offsets are not fitted over partitions"), "remove it before the import")
    evidence = (column for one in options.evidence for column in (one.columns if isinstance(one, Related) else (one,)))
    if not all(isinstance(column.values, str) for column in evidence):
        raise InputError("evidence: values for rows cannot be used over partitions", "give the names of columns")
    if any(side.fill_errors for side in columns):
        typical = naming("{fill_errors}: typical errors would depend on the partition")
        raise InputError(typical, "give every row an error")


def _first_rows(stored: HatsCatalogue, options: CatalogueOptions) -> Catalogue:
    """The first rows of some partitions, with columns recognised."""
    import pyarrow as pa
    from astropy.table import Table, vstack
    from pyarrow import parquet

    tables = []
    for k in sorted({int(k) for k in np.linspace(0, len(stored.cells) - 1, COLUMN_PARTITIONS)}):
        cell = stored.cells[k]
        for file in stored._files(cell)[:1]:
            try:
                with parquet.ParquetFile(file) as opened:
                    batch = next(opened.iter_batches(batch_size=COLUMN_ROWS, use_threads=False), None)
            except MemoryError:
                raise
            except Exception as error:  # Arrow raises many types on damaged files
                raise InputError(f"{file}: the partition {cell} cannot be read ({error})", "restore it") from error
            if batch is not None:
                tables.append(_rows_of(pa.Table.from_batches([batch])))
    if not tables:
        raise InputError(f"{stored.name}: the catalogue has no rows")
    table = vstack(tables, metadata_conflicts="silent") if len(tables) > 1 else tables[0]
    try:
        return Catalogue.of(Table(table, copy=False), stored.name, options=options)
    except InputError as error:
        raise InputError(error.words, source=stored.name) from error  # for the options of this side


def _rows_of(table: pa.Table) -> Table:
    return table_of(table.drop_columns([name for name in OWN if name in table.column_names]))


@dataclass(frozen=True)
class _Chunks:
    """Density and error of a catalogue, from runs of rows that do not depend on the partitions: the order of cells that
    hold ``records_per_cell`` records in the densest run, and the median error in arcsec, 0 if it has no errors."""

    order: int
    sigma_arcsec: float

    @classmethod
    def of(cls, side: Side, columns: list[str]) -> _Chunks:
        chunks = [side.rows(table) for table in side.stored.chunks(CHUNKS, CHUNK_ROWS, columns)]
        order = max(_order_of(np.sort(chunk.stored), RECORDS_PER_CELL) for chunk in chunks)
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


def _count_all(work: Work, scratch: Path, workers: Workers, progress: Progress) -> tuple[list[Counted], list[Counted]]:
    """The counts of every partition of both catalogues, in parallel."""
    store(work, scratch)
    tasks = [(side, cell) for side in (1, 2) for cell in work.sides[side - 1].stored.cells]
    by_task: dict[tuple[int, Cell], Counted] = {}
    rows = sum(int(side.stored.partition_rows.sum()) for side in work.sides)
    few = workers.executor is None and rows <= MAX_ROWS_IN_PROCESS
    with workers.alone() if few else workers as pool:
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
    work: Work, sigma: float, places: Places, counts: CellCounts, options: MatchOptions, progress: Progress
) -> tuple[list[Catalogue], Learned, tuple[str, ...]]:
    """The sample's catalogues with errors and epochs completed, the estimates, and doubts on what was assumed.

    sigma : median error of a residual, arcsec.
    """
    steps, cells = drawn(counts, SAMPLING)
    order = work.sides[0].cell_order - steps
    margin = MARGIN_GATES * 6.4 * sigma + 2.0 * _motion(work)
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
        (parts[0].records, parts[1].records),
        (parts[0].cells, parts[1].cells),
        (counted[0], counted[1]),
        places.within(counts, cells, steps),
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


def _halos(work: Work) -> tuple[float, float]:
    """Width, arcsec, of the first halo of a part, and of one that is wide enough for nearly all parts: the extent of
    the sample's groups, a gate on either side, and the motion of records."""
    from sameas.groups import laid_out

    assert work.learned is not None and work.learned.estimate is not None
    answer, learned = work.learned.estimate.answer, work.learned
    pairs = answer.pairs
    kept = np.flatnonzero(answer.evidence.log_ratio > COMPETING)
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
        return max(min(extent, 32.0 * reach) + 2.0 * reach, MIN_HALO_ARCSEC) + _motion(work)

    return width(HALO_SHARE), width(MARGIN_SHARE)


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


def count_partition(folder: str, task: tuple[int, Cell]) -> Counted:
    """The counts of a partition; task : catalogue 1 or 2, cell."""
    return stored_work(folder).count(*task)

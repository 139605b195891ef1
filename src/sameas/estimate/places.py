"""Estimates for two sources in partitions, made once: densities, coverage, shares, errors, magnitudes.

Sources too large for one machine are identified in parts. If each part made its own estimates, shares would scatter by
a per cent, and decisions near a border would depend on the part. Therefore the estimates are

- counts in cells, by every part, and summed (:class:`CellCounts`): local densities, and where a source sees nothing;
- fitted to a sample of cells with all competing records (:func:`learn`), by the EM iterations of ``estimate.match``;
- given to all parts as one value (:class:`Learned`), whose rule depends only on a pair and its positions.

Cells are nested: four of one size make one of the next, cell ``c`` lies in ``c >> 2``. All cells of a size have equal
volumes, as in HEALPix.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from sameas.arrays import AnyIntArray, BoolArray, FloatArray, IntArray
from sameas.errors import InputError
from sameas.estimate.cells import FINEST_CELLS, GridLevel
from sameas.estimate.columns import ColumnEvidence
from sameas.estimate.coverage import (
    COVERAGE_PSEUDO_COUNT,
    HOLE,
    IN_CELL,
    LEFT_OUT,
    LOG_PRIOR_STEP,
    SHARED_PSEUDO_COUNT,
    SMOOTHS,
    Coverage,
)
from sameas.estimate.em import EMState
from sameas.estimate.grades import Grades
from sameas.estimate.match import Assumed, match_sample
from sameas.estimate.photometry import Photometry
from sameas.estimate.result import Estimate
from sameas.estimate.sample import Sampling, Setting
from sameas.estimate.share_regression import COLUMN_FOLDS
from sameas.evidence import Column, Errors, Magnitudes, MeasuredMagnitudes, Related, Rule
from sameas.gate import Pairs, Radius
from sameas.kernels.coverage import check_cells_nested, covered_cells, refine_nested, refine_share_nested, score_nested
from sameas.records import Records

_EMPTY = np.empty(0)


COARSEST = 100_000.0  # records in the coarsest cells on average; larger cells give no more than the overall mean
#: A cell lies entirely within the field unless pairs of its records that share one of its finest cells exceed chance by
#: this many standard deviations.
PARTLY = 2.0


#: About this many cells choose the smoothing of densities; those at borders, which matter most, are few.
SMOOTHING_CELLS = 300_000


@dataclass(frozen=True)
class CellCounts:
    """Records of both sources in occupied cells.

    cells : (u,) their numbers, ascending. numbers : (u, 2) records of each source.
    """

    cells: IntArray
    numbers: AnyIntArray

    @classmethod
    def of(cls, cells_1: IntArray, cells_2: IntArray) -> CellCounts:
        """From the cells of records, (n₁,) and (n₂,)."""
        numbers = np.zeros((len(cells_1) + len(cells_2), 2), np.int32)
        numbers[: len(cells_1), 0] = numbers[len(cells_1) :, 1] = 1
        return cls._summed(np.concatenate([cells_1, cells_2]), numbers)

    @classmethod
    def sum(cls, parts: Sequence[CellCounts]) -> CellCounts:
        """The sum of several parts."""
        return cls._summed(np.concatenate([part.cells for part in parts]), np.concatenate([p.numbers for p in parts]))

    @classmethod
    def _summed(cls, cells: IntArray, numbers: AnyIntArray) -> CellCounts:
        if not len(cells):
            return cls(cells, numbers)
        if np.any(cells[1:] < cells[:-1]):
            order = np.argsort(cells, kind="stable")
            cells, numbers = cells[order], numbers[order]
        start = np.flatnonzero(np.append(True, cells[1:] != cells[:-1]))
        return cls(cells[start], np.add.reduceat(numbers, start, axis=0))

    def coarser(self, steps: int) -> CellCounts:
        """The counts in cells ``4 ** steps`` times as large."""
        return self._summed(self.cells >> (2 * steps), self.numbers.astype(np.int64))

    def at(self, cells: IntArray) -> IntArray:
        """Indices of cells among the occupied ones, which must contain them."""
        return np.minimum(np.searchsorted(self.cells, cells), len(self.cells) - 1)


@dataclass(frozen=True)
class Places:
    """Densities, coverage and shares in cells. Make it with :meth:`of`.

    cells : (u,) the occupied cells, ascending, ``steps`` steps above the counted cells.
    density : (u, 2, 2) of the covered records of source k + 1 at records of its own, [:, k, 0], and of the other
    source, [:, k, 1]. seen : (u, 2) whether the other source observes there.
    share : (u, 2) of the records of a source there that have a partner. levels : steps from these to coarser cells.
    volume : of a cell.
    """

    cells: IntArray
    steps: int
    density: FloatArray = field(repr=False)
    seen: BoolArray = field(repr=False)
    share: FloatArray = field(repr=False)
    levels: tuple[int, ...]
    volume: float

    @classmethod
    def of(cls, counts: CellCounts, volume: float, smoothing_cells: int = SMOOTHING_CELLS) -> Places:
        """From the counts of all records, in cells of this volume; shares are NaN. smoothing_cells : about this many
        cells choose the smoothing of densities.

        Raises InputError: a source has no records.
        """
        totals = counts.numbers.sum(axis=0)
        if not totals.all():
            raise InputError("one of the catalogues has no usable records; nothing can be identified")
        # To limit memory, only one size is kept in addition to the counted cells.
        richer, level, last, finest = int(np.argmax(totals)), counts, 0, 0
        while True:
            number = level.numbers[:, richer].astype(np.float64)
            if number @ number <= FINEST_CELLS * totals[richer]:
                finest = last
            if len(level.cells) * COARSEST <= totals.sum() or len(level.cells) == 1 or last == 24:
                break
            level, last = level.coarser(1), last + 1
        counts, levels = counts.coarser(finest), tuple(range(last - finest, -1, -1))
        cells, volume, numbers = counts.cells, volume * 4.0**finest, counts.numbers
        covered = _covered_cells(cells, numbers, levels, volume)
        density = _density(cells, numbers * covered, levels, volume, smoothing_cells)
        return cls(cells, finest, density, covered, np.full((len(cells), 2), np.nan), levels, volume)

    def at(self, counted: IntArray) -> IntArray:
        """Indices of records into ``cells``, from the cells in which they were counted."""
        return np.minimum(np.searchsorted(self.cells, counted >> (2 * self.steps)), len(self.cells) - 1)

    def within(self, counts: CellCounts, cells: IntArray, steps: int) -> float:
        """The volume of ``cells`` inside the field; they are ``steps`` steps above the cells of ``counts``."""
        if steps < self.steps:
            return len(cells) * self.volume / 4.0 ** (self.steps - steps)
        counts = counts.coarser(self.steps)
        own, covered = np.empty(len(counts.cells), np.int64), np.empty(len(counts.cells))
        number = covered_cells(counts.cells, counts.numbers, 2 * (steps - self.steps), PARTLY, own, covered)
        return float(covered[:number][np.isin(own[:number], cells)].sum()) * self.volume

    def folds(self, counted: Sequence[IntArray], number: int) -> tuple[IntArray, IntArray]:
        """(n₁,), (n₂,) which of some folds each record is in, for the fit of columns, by cells of dozens of records."""
        one, two = ((cells >> 2 * (self.steps + 2)) % number for cells in counted)
        return one, two

    def densities(self, at_1: IntArray, at_2: IntArray) -> tuple[tuple[FloatArray, FloatArray], ...]:
        """Densities of source 1, and of source 2, each at the records of both."""
        one, two = self.density[:, 0], self.density[:, 1]
        return (one[at_1, 0], one[at_2, 1]), (two[at_1, 1], two[at_2, 0])

    def with_shares(
        self, cells: Sequence[IntArray], part: Sequence[FloatArray], weight: Sequence[FloatArray]
    ) -> Places:
        """With the shares of a sample: ``part`` of ``weight``, of the records of each source, in these cells."""
        share = np.column_stack([self._share(*side) for side in zip(cells, part, weight, strict=True)])
        return replace(self, share=share)

    def _share(self, counted: IntArray, part: FloatArray, weight: FloatArray) -> FloatArray:
        """Shares by level, each drawn towards that of the coarser cells, as in ``coverage.local_share``."""
        share = np.full(len(self.cells), (float(part.sum()) + 0.5) / (float(weight.sum()) + 1.0))
        cells = counted >> (2 * self.steps)
        # The coarsest level gives the mean of all; the finest has too few records a cell.
        for steps in self.levels[1:-1] or self.levels:
            coarse, at = np.unique(cells >> (2 * steps), return_inverse=True)
            parts, weights = np.bincount(at, part), np.bincount(at, weight)
            refine_share_nested(
                self.cells,
                coarse,
                parts.astype(np.float64),
                weights.astype(np.float64),
                2 * steps,
                SHARED_PSEUDO_COUNT,
                share,
            )
        return share

    def write(self, folder: Path) -> None:
        """Write the columns to files in a folder, of which parts read only what they need."""
        folder.mkdir(parents=True, exist_ok=True)
        for name in _COLUMNS:
            np.save(folder / f"{name}.npy", getattr(self, name))

    def without_columns(self) -> Places:
        """Without the columns that :meth:`write` writes."""
        empty: dict[str, Any] = dict.fromkeys(_COLUMNS, _EMPTY)
        return replace(self, **empty)

    def with_columns(self, folder: Path) -> Places:
        """With the columns that were written to a folder."""
        stored: dict[str, Any] = {name: np.load(folder / f"{name}.npy", mmap_mode="r") for name in _COLUMNS}
        return replace(self, **stored)


_COLUMNS = ("cells", "density", "seen", "share")


def _covered_cells(cells: IntArray, numbers: AnyIntArray, levels: Sequence[int], volume: float) -> BoolArray:
    """(u, 2) whether the other source observes there, as by ``kernels.coverage.check_cells``. volume : of a cell."""
    total = numbers.sum(axis=0).astype(np.float64)
    density = np.tile(total[::-1] / _field_volume(cells, numbers, levels[0], volume), (len(cells), 1))
    highest, covered = np.zeros(numbers.shape), np.ones(numbers.shape, np.bool_)
    for steps in levels:
        check_cells_nested(
            cells, numbers, 2 * steps, PARTLY, volume, IN_CELL * total / total[::-1],
            HOLE, COVERAGE_PSEUDO_COUNT, density, highest, covered,
        )  # fmt: skip
    return covered


def _density(
    cells: IntArray, numbers: AnyIntArray, levels: Sequence[int], volume: float, smoothing_cells: int
) -> FloatArray:
    """(u, 2, 2) densities of the counted records of each source at its own records, [:, k, 0], and at the other's, as
    by ``Coverage.density``. volume : of a cell."""
    total, density = numbers.sum(axis=0).astype(np.float64), np.empty((len(cells), 2, 2))
    own, others = density[:, :, 0], density[:, :, 1]
    own[:] = others[:] = (total + 0.5) / _field_volume(cells, numbers, levels[0], volume)
    partly, open_ = PARTLY, total > 0.0
    smooths, sampled = np.array(SMOOTHS), min(smoothing_cells / len(cells), 1.0)
    log_prior = -LOG_PRIOR_STEP * np.arange(len(smooths))
    for steps in levels:
        score = np.zeros((2, len(smooths) + 1))
        score_nested(cells, numbers, 2 * steps, partly, volume, sampled, smooths, own, score)
        finest = (score[:, -1] <= FINEST_CELLS * total) | (steps == 0)
        smooth = smooths[np.argmax(score[:, :-1] + log_prior, axis=1)]
        left_out = np.where(finest, LEFT_OUT, 1.0)
        refine_nested(cells, numbers, 2 * steps, partly, volume, smooth, left_out, open_, own, others)
        open_ &= ~finest
    return density


def _field_volume(cells: IntArray, numbers: AnyIntArray, steps: int, volume: float) -> float:
    """The volume of all cells inside the field."""
    own, covered = np.empty(len(cells), np.int64), np.empty(len(cells))
    number = covered_cells(cells, numbers, 2 * steps, PARTLY, own, covered)
    return volume * float(covered[:number].sum())


def drawn(counts: CellCounts, sampling: Sampling = Sampling()) -> tuple[int, IntArray]:  # noqa: B008
    """A sample of cells with enough records of both sources: steps to their size, and their numbers.

    The sample depends only on the positions of the records.
    """
    total, steps, level = int(counts.numbers.sum()), 0, counts
    while len(level.cells) * sampling.cell > total and len(level.cells) > 1 and steps < 25:
        level, steps = level.coarser(1), steps + 1
    order = np.random.default_rng(sampling.seed).permutation(len(level.cells))
    held = np.cumsum(level.numbers[order], axis=0)
    enough = sampling.size(int(held[-1].min()))
    needed = max(int(np.searchsorted(held[:, k], enough)) for k in range(2)) + 1
    return steps, np.sort(level.cells[order[:needed]])


@dataclass(frozen=True)
class _SampleCoverage(Coverage):
    """The coverage of a sample, computed from all records."""

    given_counted: tuple[BoolArray, BoolArray] = field(repr=False)
    given_covered: tuple[BoolArray, BoolArray] = field(repr=False)
    given_densities: tuple[tuple[FloatArray, FloatArray], ...] = field(repr=False)

    @property
    def counted(self) -> tuple[BoolArray, BoolArray]:
        return self.given_counted

    @property
    def covered(self) -> tuple[BoolArray, BoolArray]:
        return self.given_covered

    @property
    def covered_densities(self) -> tuple[tuple[FloatArray, FloatArray], ...]:  # type: ignore[override]
        return self.given_densities

    @property
    def common_volume(self) -> float:
        pairs = zip(self.given_covered, self.given_counted, strict=True)
        return self.volume * min(float(covered[c].mean()) if c.any() else 1.0 for covered, c in pairs)


@dataclass(frozen=True)
class Learned:
    """The estimates for the evidence of any part of both sources. Make it with :func:`learn`.

    errors : of the evidence. start, gate_sigmas : errors of the gate's distances, and its radius in these.
    means : overall shares with a partner. photometry, grades, columns : fits without records.
    density : of all records of each source if given by the user. places : densities, coverage and shares.
    estimate : of the sample, for reports; None if not needed.
    """

    errors: Errors
    start: Errors
    gate_sigmas: float
    means: tuple[float, float]
    photometry: Photometry | None = field(repr=False)
    grades: Grades | None = field(repr=False)
    columns: ColumnEvidence | None = field(repr=False)
    density: tuple[float, float] | None
    places: Places
    estimate: Estimate | None = field(repr=False, default=None)

    def pairs(self, first: Records, second: Records) -> Pairs:
        """The candidates."""
        pairs = Radius(self.gate_sigmas)(*self.start.records(first, second))
        return pairs.of(first, second) if self.start.as_modelled else pairs

    def rule(
        self,
        pairs: Pairs,
        cells: tuple[IntArray, IntArray],
        measured: tuple[MeasuredMagnitudes, MeasuredMagnitudes] | None = None,
        columns: ColumnEvidence | None = None,
    ) -> Rule:
        """The evidence of pairs whose records lie in these counted cells, (n₁,) and (n₂,).

        measured : magnitudes of the records; None without evidence of magnitudes. columns : of the records, without
        fits; None without evidence of columns.
        """
        n1, n2 = len(pairs.first), len(pairs.second)
        at_1, at_2 = self.places.at(cells[0]), self.places.at(cells[1])
        counted = np.ones(n1, np.bool_), np.ones(n2, np.bool_)
        level = GridLevel(np.zeros(n1, np.int32), np.zeros(n2, np.int32), np.ones(1))
        ((d_1, _), (_, d_2)), share = self.places.densities(at_1, at_2), self.places.share
        setting = Setting(
            pairs, (np.arange(n1), np.arange(n2)), (level,), counted, counted, (d_1, d_2), SHARED_PSEUDO_COUNT
        )
        photometry = self._photometry(measured)
        estimates = EMState(
            setting, (np.full(n1, self.means[0]), np.full(n2, self.means[1])), counted,
            (share[at_1, 0], share[at_2, 1]), self.errors, False, photometry,
            self.density,
        )  # fmt: skip
        if self.grades is not None:
            estimates = replace(estimates, grades=self.grades.for_setting(setting, photometry))
        if self.columns is not None and columns is not None:
            folds = self.places.folds(cells, COLUMN_FOLDS)
            estimates = replace(estimates, columns=self.columns.over(columns, folds))
        return estimates.rule()

    def seen(self, cells: IntArray, source: int) -> BoolArray:
        """(n,) whether the other source observes at records of ``source`` (1 or 2)."""
        return np.asarray(self.places.seen[self.places.at(cells), source - 1])

    def _photometry(self, measured: tuple[MeasuredMagnitudes, MeasuredMagnitudes] | None) -> Photometry | None:
        if self.photometry is None or measured is None:
            return None
        one, two = (replace(s, measured=m) for s, m in zip(self.photometry.sides, measured, strict=True))
        return replace(self.photometry, sides=(one, two), compared=None)


@dataclass(frozen=True)
class SampleRecords:
    """The records of a sample: counted ones, and all that compete with them.

    cells : (n₁,), (n₂,) of the records, of the counted size. counted : (n₁,), (n₂,). volume : of the sample.
    """

    records: tuple[Records, Records]
    cells: tuple[IntArray, IntArray]
    counted: tuple[BoolArray, BoolArray]
    volume: float


def learn(
    sample: SampleRecords,
    places: Places,
    assumed: Assumed = Assumed(),  # noqa: B008 (frozen)
    *,
    brightness: tuple[Magnitudes, Magnitudes] | None = None,
    evidence: Sequence[Column | Related] = (),
    progress: Callable[[str], None] = lambda stage: None,
) -> Learned:
    """The estimates for all records, from a sample.

    places : densities and coverage, from the counts of all records.
    assumed, brightness, evidence : as for ``estimate.match.match``.

    Raises InputError: the sample holds no records of one source.
    """
    (first, second), cells = sample.records, sample.cells
    for one, has_counted in zip(sample.records, sample.counted, strict=True):
        if not has_counted.any():
            raise InputError(f"{one.source} has no usable records in the sample; nothing can be identified")
    at = places.at(cells[0]), places.at(cells[1])
    covered = places.seen[at[0], 0], places.seen[at[1], 1]
    levels = tuple(_level(places.cells[at[0]], places.cells[at[1]], steps, places.volume) for steps in places.levels)
    coverage = _SampleCoverage(
        first, second, sample.volume, sample.counted, covered, places.densities(*at), of_part=levels
    )
    columns = ColumnEvidence.of(first, second, evidence)
    columns = columns and replace(columns, folds=places.folds(cells, COLUMN_FOLDS))
    matched = match_sample(coverage, assumed, brightness=brightness, columns=columns, progress=progress)
    estimates = matched.estimates
    weights = [(s & c).astype(np.float64) for s, c in zip(covered, estimates.counted, strict=True)]
    part = [p * w for p, w in zip(estimates.p_partner, weights, strict=True)]
    places = places.with_shares(cells, part, weights)
    return Learned(
        errors=estimates.errors, start=matched.gate_errors, gate_sigmas=matched.gate_sigmas,
        means=estimates.mean_shares, photometry=_without_records(estimates.photometry),
        grades=None if estimates.grades is None or estimates.grades.rule is None else _without_grades(estimates.grades),
        columns=estimates.columns and estimates.columns.without_records(), density=assumed.density, places=places,
        estimate=matched.estimate,
    )  # fmt: skip


def _level(one: IntArray, two: IntArray, steps: int, volume: float) -> GridLevel:
    cells, at = np.unique(np.concatenate([one, two]) >> (2 * steps), return_inverse=True)
    at = at.astype(np.int32)
    return GridLevel(at[: len(one)], at[len(one) :], np.full(len(cells), volume * 4.0**steps))


def _without_records(photometry: Photometry | None) -> Photometry | None:
    if photometry is None or not photometry.is_fitted:
        return None
    none = np.empty(0, np.int64)
    return photometry.part(none, none)


def _without_grades(grades: Grades) -> Grades:
    none = np.empty(0, np.int32)
    rule = grades.rule and replace(grades.rule, grades=(none, none), training=None)
    return replace(grades, grades=(none, none), cells=(none, none), rule=rule)


__all__ = ["CellCounts", "Learned", "Places", "SampleRecords", "drawn", "learn"]

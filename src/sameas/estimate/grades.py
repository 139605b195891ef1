"""Grades of precision: evidence of the sizes of quoted errors, estimated together with the identification.

The records of each source are graded by the volume of their quoted errors, in about equal numbers; with magnitudes,
within ranges of magnitude, so that only information beyond the magnitudes counts. The pairs of every two grades are
counted with their probabilities, and compared with two different objects at the same position.

Otherwise matches of a deeper source's records with large errors would be too probable: by position every neighbour of
such a record fits, although the other source shows few of these objects.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.estimate.photometry import Photometry
from sameas.estimate.sample import Setting
from sameas.evidence import Precision, TrainingPairs
from sameas.gate import Pairs
from sameas.ragged import Ragged
from sameas.records import Records

# Parameters of the grades of precision; chosen where no source is given.
#: Records of the poorer source per cell of the table of two grades, and greatest number of grades.
RECORDS_PER_CELL, MAX_GRADES = 20.0, 16
PSEUDO_COUNT = 0.1  # pseudo-pairs per cell of the table, distributed as for unrelated grades
#: Limit of what a cell's pairs gain because its count is fitted to them, in ln likelihood per pair.
MAX_FITTED_GAIN = 1.0
#: The evidence is used if twice its gain in ln likelihood exceeds this per cell of the table. Uninformative grades stay
#: below 4, even in crowded fields with uncertain pairs; for stars it reaches 30 and more.
MIN_GAIN = 6.0
GRADES_PSEUDO_COUNT = 2.0  # pseudo-count that draws the grades in a cell of the sky to those of all records
#: Mean number of records of the poorer source in the cells of the sky whose grades are counted separately.
RECORDS_PER_SKY_CELL = 25.0
#: Records from which a scale is made (more give no noticeable gain), and records per grade in a range of magnitudes.
SCALE_RECORDS, RECORDS_PER_GRADE = 1_000, 8
#: Number of records without a magnitude, among those of the scale, from which they get grades of their own.
MIN_UNMEASURED = 100
MIN_VOLUME_RATIO = 1.0 + 1e-9  # errors that differ by less than this factor in volume are equal


Both = tuple[FloatArray, FloatArray]
BothGrades = tuple[NDArray[np.int32], NDArray[np.int32]]


@dataclass(frozen=True)
class Scale:
    """The grading of one source's records by the volume of their errors, within ranges of magnitude.

    number : of grades. edges : (b − 1,) between ranges of magnitude; records without one are in the last range.
    limits : ((b + 1)(number − 1),) volumes between the grades, by range. apart : whether records without a magnitude
    have grades of their own.
    """

    number: int
    edges: FloatArray
    limits: FloatArray
    apart: bool

    @classmethod
    def of(cls, volume: FloatArray, magnitude: FloatArray | None, number: int) -> Scale:
        """From records with errors of these volumes (n,), and magnitudes (n,), NaN where missing."""
        every, parts = max(1, len(volume) // SCALE_RECORDS), np.arange(1, number)
        some, some_magnitude = volume[::every], None if magnitude is None else magnitude[::every]
        measured = np.empty(0) if some_magnitude is None else some_magnitude[np.isfinite(some_magnitude)]
        ranges = max(1, len(measured) // (RECORDS_PER_GRADE * number))
        edges = np.quantile(measured, np.linspace(0.0, 1.0, ranges + 1)[1:-1]) if ranges > 1 else np.empty(0)
        apart = len(measured) > 0 and len(some) - len(measured) >= MIN_UNMEASURED
        scale = cls(number, edges, np.empty(0), apart)
        within = scale._range(some_magnitude, len(some))
        line = np.sort(some) if some_magnitude is None else some[np.lexsort((some, within))]
        count = np.bincount(within, minlength=ranges + 1)
        at = Ragged.of_sizes(count).start[:-1, None] + count[:, None] * parts // number
        # The limits of a range without records are never used.
        return replace(scale, limits=line[np.minimum(at, len(line) - 1)].ravel())

    @property
    def size(self) -> int:
        """Number of grades, including those of records without a magnitude."""
        return self.number * (1 + self.apart)

    def grades(self, volume: FloatArray, magnitude: FloatArray | None) -> NDArray[np.int32]:
        """(n,) grades of records, from 0."""
        from sameas.kernels.mixture import grade

        within, grades = self._range(magnitude, len(volume)), np.empty(len(volume), np.int32)
        grade(volume, within, self.limits, self.number, grades)
        if self.apart:
            grades[within == len(self.edges) + 1] += self.number
        return grades

    def _range(self, magnitude: FloatArray | None, n: int) -> IntArray:
        """(n,) ranges of magnitude of the records."""
        if magnitude is None:
            return np.zeros(n, np.int64)
        return np.where(np.isfinite(magnitude), np.searchsorted(self.edges, magnitude), len(self.edges) + 1)


@dataclass(frozen=True)
class Grades:
    """The grades of two sources' records, and their evidence. Make it with :meth:`Grades.of`.

    scales : of each source. grades : (n₁,), (n₂,) of the records. cells : (n₁,), (n₂,) of the sky, of the records.
    rule : None before the first fit, and if the grades are not informative. by_magnitude : whether records are graded
    within ranges of magnitude.
    """

    scales: tuple[Scale, Scale] = field(repr=False)
    grades: BothGrades = field(repr=False)
    cells: BothGrades = field(repr=False)
    rule: Precision | None = None
    by_magnitude: bool = False

    @classmethod
    def of(cls, setting: Setting, photometry: Photometry | None) -> Grades | None:
        """Before any fit; None with too few records, or with equal errors in both sources."""
        cells = min(setting.n_counted) / RECORDS_PER_CELL
        number = min(int(math.sqrt(cells)), MAX_GRADES)
        volumes = [_volume(records) for records in (setting.pairs.first, setting.pairs.second)]
        if number < 2 or all(volume.max() < MIN_VOLUME_RATIO * volume.min() for volume in volumes):
            return None
        magnitudes = first_magnitudes(photometry)
        one, two = (Scale.of(*side, number) for side in zip(volumes, magnitudes, strict=True))
        if one.apart or two.apart:
            # Grades of their own for records without a magnitude must not make the table of pairs sparse.
            number = max(min(int(math.sqrt(cells / (1 + one.apart) / (1 + two.apart))), MAX_GRADES), 1)
            one, two = (Scale.of(*side, number) for side in zip(volumes, magnitudes, strict=True))
        placed = _grades_and_cells((one, two), volumes, setting, photometry)
        return cls((one, two), *placed, by_magnitude=photometry is not None)

    def for_setting(self, setting: Setting, photometry: Photometry | None) -> Grades:
        """The same evidence for other records, with their magnitudes."""
        volumes = [_volume(records) for records in (setting.pairs.first, setting.pairs.second)]
        magnitudes = photometry if self.by_magnitude else None
        grades, cells = _grades_and_cells(self.scales, volumes, setting, magnitudes)
        return replace(
            self, grades=grades, cells=cells, rule=self.rule and replace(self.rule, grades=grades, training=None)
        )

    def fitted(
        self,
        pairs: Pairs,
        p_counted: FloatArray,
        partner: Both,
        covered: tuple[BoolArray, ...],
        likelihood_ratio: Both | None = None,
        has_curve: tuple[bool, bool] = (False, False),
    ) -> Grades:
        """The M-step, from pairs with these probabilities (m,).

        partner : (n₁,), (n₂,) probability of having one. covered : (n₁,), (n₂,) whether a record is used.
        likelihood_ratio : (n₁,), (n₂,) of a record's other evidence with a partner over that without. Records without
        a partner get it as weight, so that the grades add only information beyond that evidence. has_curve : of each
        source, whether its records with a magnitude have a term of completeness.
        """
        from sameas.kernels.mixture import count_pairs

        k1, k2 = (scale.size for scale in self.scales)
        common, chance = np.zeros((k1, k2)), self._by_chance(partner, covered, likelihood_ratio)
        at = count_pairs(pairs.i, pairs.j, *self.grades, p_counted, common)
        unrelated = _margin(common, 1)[:, None] * _margin(common, 0) * chance
        unrelated /= chance.sum(axis=1)[:, None] * chance.sum(axis=0)
        pseudo = PSEUDO_COUNT * k1 * k2 * unrelated / unrelated.sum()
        counted = common + pseudo
        # The information about ln of a count: Σ p² (of certain pairs their number).
        information = np.zeros((k1, k2))
        count_pairs(pairs.i, pairs.j, *self.grades, p_counted**2, information)
        information += pseudo
        log_ratio = np.log(counted / counted.sum()) - np.log(chance)
        # The pair's own contribution to ln of the count, subtracted from its evidence: without it the count of its
        # cell falls by p / Σ p², because the other pairs become less probable, but not below the pseudo-pairs.
        remaining = np.maximum(1.0 - p_counted / information.ravel()[at], (pseudo / counted).ravel()[at])
        own = -np.log(remaining)
        # The logarithm of a cell's count is uncertain by 1/√information: fitted to its own pairs, it gains half a pair.
        fitted = np.minimum(0.5 / information, MAX_FITTED_GAIN)
        twice_gain = 2.0 * float(p_counted @ ((log_ratio - fitted).ravel()[at] - own))
        one, two = (self._measured_terms(k, partner[k], covered[k]) if has_curve[k] else 0.0 for k in (0, 1))
        log_ratio -= np.reshape(one, (-1, 1)) + two
        significant = twice_gain > MIN_GAIN * (k1 * k2 - 1)
        rule = Precision(self.grades, log_ratio, TrainingPairs(pairs, at, own)) if significant else None
        return replace(self, rule=rule)

    def _measured_terms(self, source: int, partner: FloatArray, covered: BoolArray) -> FloatArray:
        """(k,) what the completeness by magnitude adds on average to the log-odds of records of each grade: the share
        of records with a magnitude is not that of all, which those without keep."""
        scale = self.scales[source]
        terms = np.zeros(scale.size)
        measured = covered & (self.grades[source] < scale.number)
        if scale.apart and measured.any():
            share, of_all = (float(np.clip(partner[rows].mean(), 1e-9, 1.0 - 1e-9)) for rows in (measured, covered))
            # As ShareCurve.terms.
            terms[: scale.number] = 0.5 * math.log(share / of_all) - math.log((1.0 - share) / (1.0 - of_all))
        return terms

    def _by_chance(self, partner: Both, covered: tuple[BoolArray, ...], likelihood_ratio: Both | None) -> FloatArray:
        """(k₁, k₂) probability of every two grades for two different objects, where common objects lie.

        By cells of the sky, because grades that vary together over the sky are no evidence for a pair.
        """
        from sameas.kernels.mixture import count_alone

        number, parts = int(max(cells.max() for cells in self.cells)) + 1, []
        for source in range(2):
            count = np.zeros((number, self.scales[source].size))
            alone = partner[source]
            if likelihood_ratio is not None:
                alone = 1.0 - (1.0 - alone) * likelihood_ratio[source]
            count_alone(self.cells[source], self.grades[source], alone, covered[source], count)
            count += GRADES_PSEUDO_COUNT * _margin(count, 0)
            parts.append(count / count.sum(axis=1, keepdims=True))
        weight = np.bincount(self.cells[0], np.where(covered[0], partner[0], 0.0), number)
        return np.asarray((parts[0] * weight[:, None]).T @ parts[1] / max(float(weight.sum()), 1e-300))


def _margin(count: FloatArray, axis: int) -> FloatArray:
    """Shares of the counts summed over an axis, with half a pseudo-count."""
    sums = count.sum(axis=axis) + 0.5
    return np.asarray(sums / sums.sum())


def _volume(records: Records) -> FloatArray:
    """(n,) products of the quoted variances, whose order does not depend on units."""
    return np.asarray(records.variances.prod(axis=1))


def first_magnitudes(photometry: Photometry | None) -> tuple[FloatArray | None, FloatArray | None]:
    """(n₁,), (n₂,) magnitudes in the first band of each source."""
    if photometry is None:
        return None, None
    one, two = photometry.sides
    return one.measured.values[:, 0], two.measured.values[:, 0]


def _grades_and_cells(
    scales: tuple[Scale, Scale], volumes: Sequence[FloatArray], setting: Setting, photometry: Photometry | None
) -> tuple[BothGrades, BothGrades]:
    """The grades of both sources' records, with errors of these volumes, and their cells."""
    most = min(setting.n_counted) / RECORDS_PER_SKY_CELL
    one, two = (
        scale.grades(volume, magnitude)
        for scale, volume, magnitude in zip(scales, volumes, first_magnitudes(photometry), strict=True)
    )
    level = next((level for level in setting.levels[::-1] if len(level.volume) <= most), setting.levels[0])
    return (one, two), (level.of_first, level.of_second)

"""Grades of precision: what the sizes of the quoted errors say of pairs, learned along with the identification.

The records of either source are graded by the volume of their quoted errors, in about equal numbers; where there are
magnitudes, among records of like magnitude, so that only what magnitudes leave unsaid is counted. The pairs of each two
grades are counted with their probabilities, and set against what two different objects at one place would give.

Without this, records of a source that sees deeper are believed too easily where their errors are large: to a rule of
positions every neighbour of such a record is a good one, and it does not know that the other source hardly shows any.
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
from sameas.representation import in_short

#: Records of the poorer source for each two grades, and most grades.
PER_TWO_GRADES, MOST = 20.0, 16
#: Pairs that each two grades begin with, as if they had nothing to do with each other.
PSEUDO_COUNT = 0.1
#: What the grades say is believed when it betters twice ln of the likelihood by so much for each two grades. Those that
#: say nothing stay below 4, even in crowds where pairs are not sure; those of stars reach 30 and more.
TELLING = 6.0
#: Where records are few the grades are as everywhere, which counts as so many.
SHARED_PSEUDO_COUNT = 2.0
#: Records of the poorer source in a cell, on average, for its grades to be counted by themselves.
CELL = 25.0
#: Records that a scale is taken from: more would not better it noticeably; for each grade in a range of magnitudes.
ENOUGH, PER_GRADE = 1_000, 8
#: Records without a magnitude, of those that have a scale, that are graded by themselves.
UNMEASURED = 100
#: Errors that differ by less than this factor, in volume, are all alike.
ALIKE = 1.0 + 1e-9

Both = tuple[FloatArray, FloatArray]
BothGrades = tuple[NDArray[np.int32], NDArray[np.int32]]


@in_short
@dataclass(frozen=True)
class Scale:
    """How one source's records are graded: by the volume of their errors, among those of like magnitude.

    number : of grades. edges : (b − 1,) between ranges of magnitude; what has none is of another range, the last.
    limits : ((b + 1)(number − 1),) volumes between the grades, range after range. apart : whether records without a
    magnitude have grades of their own.
    """

    number: int
    edges: FloatArray
    limits: FloatArray
    apart: bool

    @classmethod
    def of(cls, volume: FloatArray, magnitude: FloatArray | None, number: int) -> Scale:
        """For records with errors of these volumes (n,), and magnitudes (n,), NaN where they have none."""
        every, parts = max(1, len(volume) // ENOUGH), np.arange(1, number)
        some, seen = volume[::every], None if magnitude is None else magnitude[::every]
        measured = np.empty(0) if seen is None else seen[np.isfinite(seen)]
        ranges = max(1, len(measured) // (PER_GRADE * number))
        edges = np.quantile(measured, np.linspace(0.0, 1.0, ranges + 1)[1:-1]) if ranges > 1 else np.empty(0)
        apart = len(measured) > 0 and len(some) - len(measured) >= UNMEASURED
        scale = cls(number, edges, np.empty(0), apart)
        within = scale._range(seen, len(some))
        line = np.sort(some) if seen is None else some[np.lexsort((some, within))]
        count = np.bincount(within, minlength=ranges + 1)
        at = Ragged.of_sizes(count).start[:-1, None] + count[:, None] * parts // number
        # The limits of a range without records are never asked for.
        return replace(scale, limits=line[np.minimum(at, len(line) - 1)].ravel())

    @property
    def size(self) -> int:
        """Number of grades, with those of records without a magnitude."""
        return self.number * (1 + self.apart)

    def grades(self, volume: FloatArray, magnitude: FloatArray | None) -> NDArray[np.int32]:
        """(n,) of records, from 0."""
        from sameas.kernels.mixture import grade

        within, grades = self._range(magnitude, len(volume)), np.empty(len(volume), np.int32)
        grade(volume, within, self.limits, self.number, grades)
        if self.apart:
            grades[within == len(self.edges) + 1] += self.number
        return grades

    def _range(self, magnitude: FloatArray | None, n: int) -> IntArray:
        """(n,) the ranges of magnitude of the records."""
        if magnitude is None:
            return np.zeros(n, np.int64)
        return np.where(np.isfinite(magnitude), np.searchsorted(self.edges, magnitude), len(self.edges) + 1)


@dataclass(frozen=True)
class Grades:
    """The grades of two sources' records, and what has been learned of them. Make it with :meth:`Grades.of`.

    scales : of either source. grades : (n₁,), (n₂,) of the records. cells : (n₁,), (n₂,) in which the records lie.
    rule : None as long as nothing was learned, or where the grades say too little. by_magnitude : whether records are
    graded among those of like magnitude.
    """

    scales: tuple[Scale, Scale] = field(repr=False)
    grades: BothGrades = field(repr=False)
    cells: BothGrades = field(repr=False)
    rule: Precision | None = None
    by_magnitude: bool = False

    @classmethod
    def of(cls, setting: Setting, photometry: Photometry | None) -> Grades | None:
        """Nothing learned yet; None where records are too few, or the errors of either source all alike."""
        number = min(int(math.sqrt(min(setting.n_counted) / PER_TWO_GRADES)), MOST)
        volumes = [_volume(records) for records in (setting.pairs.first, setting.pairs.second)]
        if number < 2 or all(volume.max() < ALIKE * volume.min() for volume in volumes):
            return None
        one, two = (
            Scale.of(volume, magnitude, number)
            for volume, magnitude in zip(volumes, _magnitudes(photometry), strict=True)
        )
        placed = _placed((one, two), volumes, setting, photometry)
        return cls((one, two), *placed, by_magnitude=photometry is not None)

    def for_setting(self, setting: Setting, photometry: Photometry | None) -> Grades:
        """The same where other records take part, with the magnitudes of these."""
        volumes = [_volume(records) for records in (setting.pairs.first, setting.pairs.second)]
        grades, cells = _placed(self.scales, volumes, setting, photometry if self.by_magnitude else None)
        return replace(
            self, grades=grades, cells=cells, rule=self.rule and replace(self.rule, grades=grades, training=None)
        )

    def fitted(
        self,
        pairs: Pairs,
        p_counted: FloatArray,
        partner: Both,
        covered: tuple[BoolArray, ...],
        like: Both | None = None,
    ) -> Grades:
        """What pairs of these probabilities (m,) say.

        partner : (n₁,), (n₂,) probability of having one. covered : (n₁,), (n₂,) whether a record tells of it.
        like : (n₁,), (n₂,) how much likelier partners are than others to have what else is known of a record; records
        without a partner count with it, so that only what this leaves unsaid is counted.
        """
        from sameas.kernels.mixture import count_pairs

        k1, k2 = (scale.size for scale in self.scales)
        common, chance = np.zeros((k1, k2)), self._by_chance(partner, covered, like)
        at = count_pairs(pairs.i, pairs.j, *self.grades, p_counted, common)
        apart = _margin(common, 1)[:, None] * _margin(common, 0) * chance
        apart /= chance.sum(axis=1)[:, None] * chance.sum(axis=0)
        counted = common + PSEUDO_COUNT * k1 * k2 * apart / apart.sum()
        log_ratio = np.log(counted / counted.sum()) - np.log(chance)
        # A pair must not be its own witness: what its own count adds to ln of the counts.
        own = -np.log1p(-np.minimum(p_counted / counted.ravel()[at], 1.0 - 1e-9))
        gained = 2.0 * float(p_counted @ (log_ratio.ravel()[at] - own))
        tells = gained > TELLING * (k1 * k2 - 1)
        return replace(self, rule=Precision(self.grades, log_ratio, TrainingPairs(pairs, at, own)) if tells else None)

    def _by_chance(self, partner: Both, covered: tuple[BoolArray, ...], like: Both | None) -> FloatArray:
        """(k₁, k₂) how probable each two grades are of two different objects, where common objects lie.

        Cell by cell, because grades that change over the sky alike say nothing of which two records are one object.
        """
        from sameas.kernels.mixture import count_alone

        number, parts = int(max(cells.max() for cells in self.cells)) + 1, []
        for source in range(2):
            count = np.zeros((number, self.scales[source].size))
            alone = partner[source]
            if like is not None:
                alone = 1.0 - (1.0 - alone) * like[source]
            count_alone(self.cells[source], self.grades[source], alone, covered[source], count)
            count += SHARED_PSEUDO_COUNT * _margin(count, 0)
            parts.append(count / count.sum(axis=1, keepdims=True))
        weight = np.bincount(self.cells[0], np.where(covered[0], partner[0], 0.0), number)
        return np.asarray((parts[0] * weight[:, None]).T @ parts[1] / max(float(weight.sum()), 1e-300))


def _margin(count: FloatArray, axis: int) -> FloatArray:
    """What shares of the counts remain when summed over an axis, none of them nothing."""
    sums = count.sum(axis=axis) + 0.5
    return np.asarray(sums / sums.sum())


def _volume(records: Records) -> FloatArray:
    """(n,) products of the quoted variances, whose order no unit of a feature changes."""
    return np.asarray(records.variances.prod(axis=1))


def _magnitudes(photometry: Photometry | None) -> tuple[FloatArray | None, FloatArray | None]:
    """(n₁,), (n₂,) in the first band of either source."""
    if photometry is None:
        return None, None
    one, two = photometry.sides
    return one.measured.values[:, 0], two.measured.values[:, 0]


def _placed(
    scales: tuple[Scale, Scale], volumes: Sequence[FloatArray], setting: Setting, photometry: Photometry | None
) -> tuple[BothGrades, BothGrades]:
    """The grades of either source's records, with errors of these volumes, and their cells."""
    most = min(setting.n_counted) / CELL
    one, two = (
        scale.grades(volume, magnitude)
        for scale, volume, magnitude in zip(scales, volumes, _magnitudes(photometry), strict=True)
    )
    level = next((level for level in setting.levels[::-1] if len(level.volume) <= most), setting.levels[0])
    return (one, two), (level.of_first, level.of_second)

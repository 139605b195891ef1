"""Grades of precision: what the sizes of the quoted errors say of pairs, learned along with the identification.

The records of either source are graded by the volume of their quoted errors, in about equal numbers; where there are
magnitudes, among records of like magnitude, so that only what magnitudes leave unsaid is counted. The pairs of each two
grades are counted with their probabilities, and set against what two different objects at one place would give.

Without this, records of a source that sees deeper are believed too easily where their errors are large: to a rule of
positions every neighbour of such a record is a good one, and it does not know that the other source hardly shows any.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sameas.evidence import Graded, Precision, both_grades
from sameas.gate import Pairs
from sameas.photometry import Photometry
from sameas.records import FloatArray, Records
from sameas.sample import Setting

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
ENOUGH, PER_GRADE = 2_000, 8
#: Records without a magnitude, of those that have a scale, that are graded by themselves.
UNMEASURED = 200

Both = tuple[FloatArray, FloatArray]
BothGrades = tuple[NDArray[np.int16], NDArray[np.int16]]
Places = tuple[NDArray[np.intp], NDArray[np.intp], int]


@dataclass(frozen=True)
class Scale:
    """How one source's records are graded: by the volume of their errors, among those of like magnitude.

    number : of grades. edges : (b − 1,) between ranges of magnitude; what has none is of another range, the last.
    limits : (b + 1, number − 1) least volumes of the grades but for the first, in each range. apart : whether records
    without a magnitude have grades of their own.
    """

    number: int
    edges: FloatArray
    limits: FloatArray
    apart: bool

    @classmethod
    def of(cls, volume: FloatArray, magnitude: FloatArray | None, number: int) -> Scale:
        """For records of these volumes (n,), and magnitudes (n,), NaN where they have none."""
        every = max(1, len(volume) // ENOUGH)
        some = volume[::every]
        if magnitude is None:
            return cls(number, np.empty(0), _limits(some, number)[None], False)
        magnitude = magnitude[::every]
        measured = magnitude[np.isfinite(magnitude)]
        ranges = max(1, len(measured) // (PER_GRADE * number))
        edges = np.quantile(measured, np.linspace(0.0, 1.0, ranges + 1)[1:-1]) if ranges > 1 else np.empty(0)
        within = _range(edges, magnitude)
        limits = np.stack([_limits(some[within == k], number) for k in range(len(edges) + 2)])
        return cls(number, edges, limits, len(measured) > 0 and len(some) - len(measured) >= UNMEASURED)

    @property
    def size(self) -> int:
        """Number of grades, with those of records without a magnitude."""
        return self.number * (1 + self.apart)

    def grades(self, volume: FloatArray, magnitude: FloatArray | None) -> NDArray[np.int16]:
        """(n,) of records, from 0."""
        grade = np.zeros(len(volume), np.int16)
        if magnitude is None:
            for limit in self.limits[0]:
                grade += volume >= limit
            return grade
        within = _range(self.edges, magnitude)
        for limits in self.limits.T:
            grade += volume >= limits[within]
        return grade + np.int16(self.number) * (within == len(self.edges) + 1) if self.apart else grade


def _range(edges: FloatArray, magnitude: FloatArray) -> NDArray[np.int64]:
    """(n,) between which edges magnitudes lie; NaN after the last."""
    return np.where(np.isfinite(magnitude), np.searchsorted(edges, magnitude), len(edges) + 1)


def _limits(volume: FloatArray, number: int) -> FloatArray:
    """(number − 1,) that part volumes into grades of about equal numbers; any where there are none."""
    if not len(volume):
        return np.zeros(number - 1)
    return np.sort(volume)[len(volume) * np.arange(1, number) // number]


@dataclass(frozen=True)
class Grades:
    """The grades of two sources' records, and what has been learned of them. Make it with :meth:`Grades.of`.

    scales : of either source. grades : (n₁,), (n₂,) of the records.
    places : (n₁,), (n₂,) cell · number of grades + grade of the records, and how many cells there are.
    rule : None as long as nothing was learned, or where the grades say too little.
    """

    scales: tuple[Scale, Scale] = field(repr=False)
    grades: BothGrades = field(repr=False)
    places: Places = field(repr=False)
    rule: Precision | None = None

    @classmethod
    def of(cls, setting: Setting, photometry: Photometry | None) -> Grades | None:
        """Nothing learned yet; None where records are too few, or the errors of either source all alike."""
        number = min(int(math.sqrt(min(setting.numbers) / PER_TWO_GRADES)), MOST)
        one, two = (_volume(records) for records in (setting.pairs.first, setting.pairs.second))
        if number < 2 or (one.min() == one.max() and two.min() == two.max()):
            return None
        seen_1, seen_2 = _magnitudes(photometry)
        scales = Scale.of(one, seen_1, number), Scale.of(two, seen_2, number)
        grades = scales[0].grades(one, seen_1), scales[1].grades(two, seen_2)
        return cls(scales, grades, _places(scales, grades, setting))

    def at(self, setting: Setting, photometry: Photometry | None) -> Grades:
        """The same where other records take part, with the magnitudes of these."""
        seen, sides = _magnitudes(photometry), (setting.pairs.first, setting.pairs.second)
        one, two = (
            scale.grades(_volume(records), magnitude)
            for scale, records, magnitude in zip(self.scales, sides, seen, strict=True)
        )
        rule = self.rule and replace(self.rule, grades=(one, two), lesson=None)
        return Grades(self.scales, (one, two), _places(self.scales, (one, two), setting), rule)

    def learned(self, pairs: Pairs, told: FloatArray, partner: Both, covered: tuple[NDArray[np.bool_], ...]) -> Grades:
        """What pairs of these probabilities (m,) say.

        partner : (n₁,), (n₂,) probability of having one. covered : (n₁,), (n₂,) whether a record tells of it.
        """
        k1, k2 = (scale.size for scale in self.scales)
        both = self._both(pairs)
        common = np.asarray(np.bincount(both, told, k1 * k2).reshape(k1, k2), np.float64)
        chance = self._by_chance(partner, covered)
        apart = _margin(common, 1)[:, None] * _margin(common, 0) * chance
        apart /= chance.sum(axis=1)[:, None] * chance.sum(axis=0)
        counted = common + PSEUDO_COUNT * k1 * k2 * apart / apart.sum()
        log_ratio = np.log(counted / counted.sum()) - np.log(chance)
        # A pair must not be its own witness: to first order, what its own count adds to ln of the counts.
        own = told / counted.ravel()[both]
        gained = 2.0 * float((common * log_ratio).sum() - (told * own).sum())
        tells = gained > TELLING * (k1 * k2 - 1)
        return replace(self, rule=Precision(self.grades, log_ratio, Graded(pairs, both, own)) if tells else None)

    def _both(self, pairs: Pairs) -> NDArray[np.integer]:
        """(m,) both grades of the pairs."""
        lesson = None if self.rule is None else self.rule.lesson
        if lesson is not None and lesson.pairs is pairs:
            return lesson.both
        return both_grades(self.grades, self.scales[1].size, pairs)

    def _by_chance(self, partner: Both, covered: tuple[NDArray[np.bool_], ...]) -> FloatArray:
        """(k₁, k₂) how probable each two grades are of two different objects, where common objects lie.

        Cell by cell, because grades that change over the sky alike say nothing of which two records are one object.
        """
        *places, number = self.places
        parts, shape = [], [(number, scale.size) for scale in self.scales]
        for source in range(2):
            alone = np.where(covered[source], 1.0 - partner[source], 0.0)
            count = np.bincount(places[source], alone, math.prod(shape[source])).reshape(shape[source])
            part = count + SHARED_PSEUDO_COUNT * _margin(count, 0)
            parts.append(part / part.sum(axis=1, keepdims=True))
        common = np.where(covered[0], partner[0], 0.0)
        weight = np.bincount(places[0], common, math.prod(shape[0])).reshape(shape[0]).sum(axis=1)
        return np.asarray((parts[0] * weight[:, None]).T @ parts[1] / max(float(weight.sum()), 1e-300))


def _margin(count: NDArray[Any], axis: int) -> FloatArray:
    """What shares of the counts remain when summed over an axis, none of them nothing."""
    sums = count.sum(axis=axis) + 0.5
    return np.asarray(sums / sums.sum())


def _volume(records: Records) -> FloatArray:
    """(n,) product of the quoted variances, whose order no unit of a feature changes."""
    d, packed = records.d, records.covariance
    # Packed are all variances, or the upper triangles row by row.
    whole = packed.shape[1] in (1, d)
    diagonal = range(packed.shape[1]) if whole else [v * d - v * (v - 1) // 2 for v in range(d)]
    return np.asarray(math.prod(packed[:, v] for v in diagonal))


def _magnitudes(photometry: Photometry | None) -> tuple[FloatArray | None, FloatArray | None]:
    """(n₁,), (n₂,) in the first band of either source."""
    if photometry is None:
        return None, None
    one, two = photometry.sides
    return one.measured.values[:, 0], two.measured.values[:, 0]


def _places(scales: tuple[Scale, Scale], grades: BothGrades, setting: Setting) -> Places:
    """Cell and grade of every record, and how many cells there are."""
    most = min(setting.numbers) / CELL
    level = next((level for level in setting.levels[::-1] if len(level.volume) <= most), setting.levels[0])
    one, two = (
        cell.astype(np.intp) * scale.size + grade
        for cell, scale, grade in zip((level.of_first, level.of_second), scales, grades, strict=True)
    )
    return one, two, len(level.volume)

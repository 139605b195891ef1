"""Precision as evidence: how well a record is measured tells what it may be a record of.

Errors grow towards faint objects. So a record with large errors is less often shown by a source that sees less deep,
and the errors of two records of one object go together: quoted errors stand for a magnitude where none is given.
``sameas.estimate.grades`` learns how much they say.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import FloatArray
from sameas.evidence.rule import Evidence, Rule
from sameas.gate import Pairs


@dataclass(frozen=True)
class Graded:
    """Pairs, (m,) where both grades stand in the table, row by row, and (m,) by how much each made these too good."""

    pairs: Pairs
    both: NDArray[np.integer]
    own: FloatArray


@dataclass(frozen=True)
class Precision(Rule):
    """ln p(g₁, g₂ | one object) − ln p(g₁, g₂ | two objects), with the grades g of how well both records are measured.

    Parameters
    ----------
    grades : (n₁,), (n₂,) of every record, from 0. log_ratio : (k₁, k₂) of every two grades.
    lesson : the pairs that this was learned from, None where others have taken their place since.
    """

    grades: tuple[NDArray[np.integer], NDArray[np.integer]] = field(repr=False)
    log_ratio: FloatArray = field(repr=False)
    lesson: Graded | None = field(repr=False, default=None)

    def __call__(self, pairs: Pairs) -> Evidence:
        if self.says_of(pairs) and self.lesson is not None:
            return Evidence({"precision": self.log_ratio.ravel()[self.lesson.both] - self.lesson.own})
        one, two = self.grades
        return Evidence({"precision": self.log_ratio[one[pairs.i], two[pairs.j]]})

    def says_of(self, pairs: Pairs) -> bool:
        """Whether it was these pairs that this was learned from."""
        return self.lesson is not None and self.lesson.pairs is pairs

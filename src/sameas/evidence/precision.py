"""Precision as evidence: the sizes of the quoted errors of two records of one object go together.

Errors grow towards faint objects. So a record with large errors is more often missed by a source that is less deep, and
both records of an object have large errors or neither: quoted errors stand for a magnitude where none is given.
``sameas.estimate.grades`` learns how much evidence that is.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import FloatArray
from sameas.evidence.rule import Evidence, Rule
from sameas.gate import Pairs
from sameas.representation import in_short


@in_short
@dataclass(frozen=True)
class TrainingPairs:
    """The pairs from which a table of grades was learned.

    cell : (m,) the place of each pair's two grades in the table, row by row. own : (m,) by how much the pair itself
    raised the table's log ratio there.
    """

    pairs: Pairs
    cell: NDArray[np.integer]
    own: FloatArray


@in_short
@dataclass(frozen=True)
class Precision(Rule):
    """ln p(g₁, g₂ | one object) − ln p(g₁, g₂ | two objects), with the grades g of how well both records are measured.

    Parameters
    ----------
    grades : (n₁,), (n₂,) of every record, from 0. log_ratio : (k₁, k₂) of every two grades.
    training : the pairs that this was learned from, None where others have taken their place since.
    """

    grades: tuple[NDArray[np.integer], NDArray[np.integer]] = field(repr=False)
    log_ratio: FloatArray = field(repr=False)
    training: TrainingPairs | None = field(repr=False, default=None)

    def __call__(self, pairs: Pairs) -> Evidence:
        if self.training is not None and self.trained_on(pairs):
            return Evidence({"precision": self.log_ratio.ravel()[self.training.cell] - self.training.own})
        one, two = self.grades
        return Evidence({"precision": self.log_ratio[one[pairs.i], two[pairs.j]]})

    def trained_on(self, pairs: Pairs) -> bool:
        """Whether this was learned from these pairs."""
        return self.training is not None and self.training.pairs is pairs

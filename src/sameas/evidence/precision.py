"""Precision as evidence: the sizes of the quoted errors of both records of an object are correlated.

Errors grow with magnitude. So a shallower source more often misses a record with large errors, and both records of an
object have either large or small errors: quoted errors substitute for a magnitude where none is given.
``sameas.estimate.grades`` estimates this evidence.
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
    """The pairs from which a table of grades was estimated.

    cell : (m,) index of each pair's two grades in the flattened table. own : (m,) the pair's own contribution to the
    table's log ratio there.
    """

    pairs: Pairs
    cell: NDArray[np.integer]
    own: FloatArray


@in_short
@dataclass(frozen=True)
class Precision(Rule):
    """ln p(g₁, g₂ | one object) − ln p(g₁, g₂ | two objects), with grades g of the sizes of both records' errors.

    Parameters
    ----------
    grades : (n₁,), (n₂,) of every record, from 0. log_ratio : (k₁, k₂) of every two grades.
    training : the pairs that this was estimated from; None after a change of candidates.
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
        """Whether this was estimated from these pairs."""
        return self.training is not None and self.training.pairs is pairs

"""Variances: errors of several parameters that are not correlated; what is the same for all rows takes no room."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from sameas.records import FloatArray, unpack


@dataclass(frozen=True)
class Variances:
    """(n,) variances of each parameter.

    >>> Variances((np.array([1.0, 4.0]), np.broadcast_to(9.0, 2))).matrices(2)[1]
    array([[4., 0.],
           [0., 9.]])
    """

    columns: tuple[FloatArray, ...]

    @classmethod
    def of(cls, sigmas: tuple[FloatArray, ...]) -> Variances:
        """The squares of standard deviations (n,); one number that stands for all rows stays one."""
        return cls(tuple(_squared(sigma) for sigma in sigmas))

    def __getitem__(self, rows: Any) -> Variances:
        """Those of some rows."""
        return Variances(tuple(column[rows] for column in self.columns))

    def stacked(self, k: int) -> FloatArray:
        """(n, k) of the first k parameters."""
        return np.column_stack(self.columns[:k])

    def matrices(self, k: int) -> FloatArray:
        """(n, k, k) covariances of the first k parameters."""
        return unpack(self.stacked(k), k)


def _squared(sigma: FloatArray) -> FloatArray:
    if sigma.strides == (0,) and len(sigma):
        return np.broadcast_to(np.square(sigma[0]), sigma.shape)
    return np.square(sigma)

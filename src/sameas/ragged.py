"""Ragged ranges: rows of unequal length laid end to end (compressed sparse rows, CSR).

Row k owns the entries ``start[k]`` … ``start[k + 1] − 1`` of all columns with this layout.

- :class:`Ragged`: rows of given sizes, or of entries sorted by row; the row of each entry and its index within it.
- :func:`ranges`: all integers of several ranges, and the range of each.
- :func:`flattened`: the same for several lists, such as the neighbours from a k-d tree.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from sameas.arrays import IntArray


@dataclass(frozen=True)
class Ragged:
    """n rows of unequal length, m entries in all, end to end.

    start : (n+1,) row k has the entries start[k]:start[k+1]; the first is 0, the last m.

    >>> rows = Ragged.of_sizes([2, 0, 3])
    >>> rows.start, rows.row, rows.index
    (array([0, 2, 2, 5]), array([0, 0, 2, 2, 2]), array([0, 1, 0, 1, 2]))
    """

    start: IntArray

    @classmethod
    def of_sizes(cls, sizes: ArrayLike) -> Ragged:
        """Rows with these numbers of entries, (n,)."""
        size = np.asarray(sizes, np.int64)
        start = np.zeros(len(size) + 1, np.int64)
        np.cumsum(size, out=start[1:])
        return cls(start)

    @classmethod
    def of_sorted(cls, row: IntArray, n: int) -> Ragged:
        """The n rows of entries with ascending row numbers ``row`` (m,)."""
        return cls.of_sizes(np.bincount(row, minlength=n))

    def __len__(self) -> int:
        return len(self.start) - 1

    @property
    def sizes(self) -> IntArray:
        """(n,) number of entries of each row."""
        return self.start[1:] - self.start[:-1]

    @cached_property
    def row(self) -> IntArray:
        """(m,) row of each entry."""
        return np.repeat(np.arange(len(self)), self.sizes)

    @property
    def index(self) -> IntArray:
        """(m,) index of each entry within its row, from 0."""
        return self.value(0)

    def value(self, first: ArrayLike) -> IntArray:
        """(m,) integers that count up from ``first``, (n,) or one for all, in each row."""
        shift: IntArray = np.repeat(self.start[:-1] - np.asarray(first), self.sizes)
        return np.arange(self.start[-1]) - shift

    def bounds(self, parts: int) -> list[int]:
        """Bounds of ``parts`` ranges of rows with about equal numbers of entries.

        >>> Ragged.of_sizes([2, 0, 3, 1]).bounds(2)
        [0, 3, 4]
        """
        if parts == 1 or len(self) == 1:
            return [0, len(self)]
        cuts = np.linspace(0, self.start[-1], parts + 1)[1:-1]
        return [0, *np.searchsorted(self.start, cuts).tolist(), len(self)]


def ranges(first: IntArray, size: IntArray) -> tuple[IntArray, IntArray]:
    """Row and value of each entry of the ranges first[k] … first[k] + size[k] − 1, in order.

    >>> ranges(np.array([7, 0, 4]), np.array([2, 0, 3]))
    (array([0, 0, 2, 2, 2]), array([7, 8, 4, 5, 6]))
    """
    if (size == 1).all():
        return np.arange(len(size)), first
    rows = Ragged.of_sizes(size)
    return rows.row, rows.value(first)


def flattened(lists: Sequence[Sequence[int]]) -> tuple[IntArray, IntArray]:
    """Row and value of each entry of lists of integers, in order.

    >>> flattened([[7, 8], [], [4]])
    (array([0, 0, 2]), array([7, 8, 4]))
    """
    rows = Ragged.of_sizes([len(each) for each in lists])
    return rows.row, np.concatenate([np.empty(0, np.int64), *(np.asarray(each, np.int64) for each in lists)])

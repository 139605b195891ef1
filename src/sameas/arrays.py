"""Types of arrays by their elements, with shapes in the docstrings, and what NumPy does slowly with long arrays.

- :func:`inner`, :func:`tall_product`, :func:`within_turn`: sums and angles.
- :func:`median`, :func:`weighted_median`, :func:`robust_scale`: of numbers.
- :func:`taken`: rows; :func:`ordered_by`: rows in the order of their columns; :func:`distinct`: without duplicates.
- :func:`places_in`: positions of numbers among ascending ones; :func:`spans_in`: among ones with duplicates;
  :func:`are_among`: whether they are there; :func:`numbers_of`: of names.
- :class:`ColumnTable`: frozen columns of equal length; row k of all columns is one object, pair or track.
- :func:`finite_rows`: rows without NaN; :func:`entries`: the numbers in a table with gaps.
- :data:`ABSENT`: the number of no row.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import repeat
from typing import Any, ClassVar, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
Int32Array = NDArray[np.int32]
AnyIntArray = NDArray[np.integer[Any]]
ByteArray = NDArray[np.uint8]
BoolArray = NDArray[np.bool_]
Scalar = TypeVar("Scalar", bound=np.generic)

#: The number of no element in arrays of rows, records, groups, tracks or objects. As an index it reads the last one, so
#: what it reads is masked; tables and files have a mask or a null instead. Kernels write −1.
ABSENT = -1


def inner(one: NDArray[Any], other: NDArray[Any]) -> float:
    """Σ one · other, of two arrays (n,), in one thread.

    With more than 10 000 elements OpenBLAS (``@``) wakes a thread per processor for it, which then spins for 20 ms
    while other work waits, and the sum depends on their number.
    """
    return float(np.einsum("n,n->", one, other))


#: OpenBLAS multiplies with one thread up to this many multiplications (its GEMM_MULTITHREAD_THRESHOLD).
_ONE_THREAD = 2**18


def tall_product(one: FloatArray, other: FloatArray) -> FloatArray:
    """(p, q) ``one.T @ other`` of long arrays (n, p) and (n, q) with few columns, in one thread.

    By blocks of rows, for the reason of :func:`inner`: beside other work the threads of OpenBLAS took from 20 to 200
    times the time of the product.

    >>> tall_product(np.ones((3, 1)), np.arange(6.0).reshape(3, 2)).tolist()
    [[6.0, 9.0]]
    """
    product = np.zeros((one.shape[1], other.shape[1]))
    step = max(_ONE_THREAD // max(product.size, 1), 64)
    for first in range(0, len(one), step):
        product += one[first : first + step].T @ other[first : first + step]
    return product


def median(values: NDArray[Any]) -> float:
    """The median of numbers (n,) without NaN; NaN of none: that of ``np.median``, in an eighth of the time.

    NumPy selects with vector instructions for one rank at a time; ``np.median`` asks for three at once.

    >>> median(np.array([3.0, 1.0, 2.0, 5.0]))
    2.5
    """
    if not len(values):
        return float("nan")
    half = len(values) // 2
    parted = np.partition(values, half)
    upper = float(parted[half])
    return upper if len(values) % 2 else 0.5 * (float(parted[:half].max()) + upper)


#: A weighted median sorts up to this many values; of more, it counts them in this many bins and sorts one bin.
_SORTED_VALUES, _BINS = 10_000, 4_096


def weighted_median(values: FloatArray, weights: FloatArray) -> float:
    """The smallest value of (n,) up to which lies half of the weight (n,).

    >>> weighted_median(np.array([1.0, 2.0, 3.0]), np.array([1.0, 1.0, 10.0]))
    3.0
    """
    half = 0.5 * float(weights.sum())
    if len(values) > _SORTED_VALUES:
        low, high = float(values.min()), float(values.max())
        bin_ = ((values - low) * ((_BINS - 1) / max(high - low, 1e-300))).astype(np.int64)
        below = np.cumsum(np.bincount(bin_, weights, _BINS))
        at = int(np.searchsorted(below, half))
        half -= float(below[at - 1]) if at else 0.0
        some = np.flatnonzero(bin_ == at)
        values, weights = values[some], weights[some]
    order = np.argsort(values, kind="stable")
    cumulated = np.cumsum(weights[order])
    return float(values[order][min(int(np.searchsorted(cumulated, half)), len(values) - 1)])


#: The standard deviation of a normal distribution over its median absolute deviation, 1 / Φ⁻¹(3/4).
NORMAL_PER_MAD = 1.4826


def robust_scale(residual: NDArray[Any], weights: FloatArray | None = None) -> float:
    """1.4826 · median |x|: the standard deviation of normal residuals x (n, …) around zero, however large the outliers.

    NaN are left out; NaN of none. weights : (n,) of the residuals (n,), for a weighted median.

    >>> round(robust_scale(np.array([-0.5, 0.7, -0.6, 0.8, 900.0, np.nan])), 4)
    1.0378
    """
    size = np.abs(residual)
    if weights is not None:
        return NORMAL_PER_MAD * weighted_median(size, weights)
    return NORMAL_PER_MAD * median(size[~np.isnan(size)])


def taken(values: NDArray[Scalar], rows: AnyIntArray) -> NDArray[Scalar]:
    """``values[rows]``, of rows (k,) along the first axis, in half the time or less.

    Indexing by 32-bit integers converts them one by one, and takes rows of two numbers seven times as long. For a mask,
    ``np.compress`` takes a quarter of the time of indexing.
    """
    return values.take(rows, axis=0)


def taken_plane(values: FloatArray, rows: AnyIntArray) -> FloatArray:
    """(k, 2, 2) ``values[rows, :2, :2]`` of matrices (n, d, d), in a tenth of the time."""
    if values.shape[1:] != (4, 4):
        return np.ascontiguousarray(taken(values, rows)[:, :2, :2])
    # Two numbers are taken as one: NumPy copies short rows number by number.
    return taken(np.ascontiguousarray(values).view(np.complex128)[:, :2, 0], rows).view(np.float64).reshape(-1, 2, 2)


def finite_rows(values: FloatArray) -> BoolArray:
    """(n,) whether all numbers of a row (n, …) are finite, in a fifth of the time of ``isfinite(values).all(axis=…)``;
    where all are, as in nearly all tables, in a twentieth.

    >>> finite_rows(np.array([[[1.0, 2.0]], [[1.0, np.nan]]])).tolist()
    [True, False]
    """
    finite = np.isfinite(values)
    if finite.all():
        return np.ones(len(values), bool)
    return over_columns(np.logical_and, finite.reshape(len(values), math.prod(values.shape[1:])))


def over_columns(combine: np.ufunc, values: NDArray[Any]) -> NDArray[Any]:
    """(n,) ``combine.reduce(values, axis=1)`` of a few columns (n, c), in a tenth of the time.

    >>> over_columns(np.maximum, np.array([[1, 5, 2], [7, 0, 3]])).tolist()
    [5, 7]
    """
    if not len(values):
        return np.empty(0, values.dtype)
    if not values.shape[1]:
        return np.asarray(combine.reduce(values, axis=1))
    out = values[:, 0].copy()
    for column in values.T[1:]:
        combine(out, column, out=out)
    return out


def entries(table: IntArray) -> tuple[IntArray, IntArray]:
    """Row and value of every number in a table (n, c) except ABSENT, row by row; ``np.nonzero`` of a table takes three
    times as long.

    >>> entries(np.array([[7, ABSENT], [ABSENT, ABSENT], [3, 7]]))
    (array([0, 2, 2]), array([7, 3, 7]))
    """
    values = table.ravel()
    at = np.flatnonzero(values != ABSENT)
    return at // max(table.shape[1], 1), values[at]


def within_turn(degrees: FloatArray) -> FloatArray:
    """Angles (n,) reduced to 0 … 360°: ``np.mod(degrees, 360.0)``, without its division where all are within a turn of
    that, in a fifth of the time; the same array if all are above 0° and below 360°.

    >>> within_turn(np.array([-90.0, -0.0, 360.0]))
    array([270.,   0.,   0.])
    """
    least, largest = (float(degrees.min()), float(degrees.max())) if len(degrees) else (np.nan, np.nan)
    if not (least >= -360.0 and largest < 720.0):
        return np.mod(degrees, 360.0)
    if least > 0.0 and largest < 360.0:
        return degrees
    reduced = degrees + 0.0  # −0 becomes 0
    np.subtract(reduced, 360.0, out=reduced, where=reduced >= 360.0)
    return np.add(reduced, 360.0, out=reduced, where=reduced < 0.0)


def _within(numbers: IntArray, low: int, high: int) -> IntArray:
    """Places of numbers among low … high, from 1; 0 below and high − low + 2 above. ``np.clip`` takes three times as
    long."""
    return np.asarray(np.minimum(np.maximum(numbers, low - 1), high + 1) - (low - 1))


#: Integers are dense if they span at most this many times their number.
DENSE = 4


def is_dense(ascending: IntArray, numbers: IntArray) -> bool:
    """Whether ascending integers span so little that to look numbers up in a table takes less time than a search."""
    n = len(ascending)
    return n > 0 and int(ascending[-1]) - int(ascending[0]) < DENSE * (n + np.size(numbers))


def spans_in(ascending: IntArray, numbers: IntArray) -> tuple[IntArray, IntArray]:
    """(k,) first positions of numbers among ascending ones, and how often they occur.

    >>> spans_in(np.array([3, 3, 5]), np.array([5, 3, 4]))
    (array([2, 0, 2]), array([1, 2, 0]))
    """
    if is_dense(ascending, numbers):
        low, high = int(ascending[0]), int(ascending[-1])
        start = np.zeros(high - low + 4, np.int64)
        np.cumsum(np.bincount(ascending - low, minlength=high - low + 1), out=start[2:-1])
        start[-1] = len(ascending)
        at = _within(numbers, low, high)
        first = start[at]
        return first, start[at + 1] - first
    first, last = (np.searchsorted(ascending, numbers, side) for side in ("left", "right"))
    return first, last - first


def distinct(numbers: IntArray) -> IntArray:
    """Integers (n,), ascending, each once: ``np.unique``, whose hash table takes four times as long.

    >>> distinct(np.array([7, 2, 7])).tolist()
    [2, 7]
    """
    ascending = np.sort(numbers, kind="stable")
    is_first = np.append(True, ascending[1:] != ascending[:-1])[: len(numbers)]
    return np.asarray(ascending[is_first])


def ordered_by(columns: Sequence[NDArray[Any]] | NDArray[Any]) -> IntArray:
    """(n,) rows in the order of their columns (n,), the first column first; equal rows stay in order.

    Equals ``np.lexsort`` of the columns from the last to the first, in a third of the time if the first column has no
    duplicates.

    >>> ordered_by([np.array([2.0, 1.0, 2.0]), np.array([5, 6, 4])])
    array([1, 2, 0])
    """
    order = np.argsort(columns[0])
    first = columns[0][order]
    # NaN is sorted last.
    if np.any(first[1:] == first[:-1]) or (len(first) and first[-1] != first[-1]):
        return np.lexsort(columns[::-1])
    return order


def places_in(ascending: IntArray, numbers: IntArray) -> IntArray:
    """(k,) positions of numbers among ascending ones, ABSENT for others."""
    if not len(ascending):
        return np.full(np.shape(numbers), ABSENT)
    if is_dense(ascending, numbers):
        # A search takes four times as long.
        low, high = int(ascending[0]), int(ascending[-1])
        place = np.full(high - low + 3, ABSENT)
        place[ascending - (low - 1)] = np.arange(len(ascending))
        return place[_within(numbers, low, high)]
    at = np.minimum(np.searchsorted(ascending, numbers), len(ascending) - 1)
    return np.where(ascending[at] == numbers, at, ABSENT)


def numbers_of(names: list[Any], known: Mapping[Any, int]) -> IntArray:
    """(n,) the number of each name, ABSENT for others. That all are known, as those of tracks nearly always are, is
    tried first, since it takes half the time.

    >>> numbers_of(["b", "x"], {"a": 4, "b": 7})
    array([ 7, -1])
    """
    try:
        return np.fromiter(map(known.__getitem__, names), np.int64, len(names))
    except KeyError:
        return np.fromiter(map(known.get, names, repeat(ABSENT)), np.int64, len(names))


def are_among(numbers: IntArray, others: IntArray) -> BoolArray:
    """(k,) whether integers are among others: ``np.isin``, in a third of the time where these are dense.

    >>> are_among(np.array([7, 2, 9]), np.array([9, 7])).tolist()
    [True, False, True]
    """
    if not len(others):
        return np.zeros(np.shape(numbers), bool)
    low, high = int(others.min()), int(others.max())
    if high - low >= DENSE * (len(others) + np.size(numbers)):
        return np.isin(numbers, others)
    found = np.zeros(high - low + 3, bool)
    found[others - (low - 1)] = True
    return np.asarray(found[_within(numbers, low, high)])


class ColumnTable:
    """Base of dataclasses whose fields are columns (k, …), except those in ``WHOLE``, which belong to the table."""

    WHOLE: ClassVar[frozenset[str]] = frozenset()

    def columns(self) -> dict[str, NDArray[Any]]:
        """The columns by their names."""
        return {name: column for name, column in self._fields.items() if name not in self.WHOLE}

    @property
    def _fields(self) -> dict[str, Any]:
        """All fields by their names, without what the table has cached."""
        own = self.__dict__
        return {name: own[name] for name in type(self).__dataclass_fields__}  # type: ignore[attr-defined]

    def changed(self, **values: Any) -> Self:
        """The table with other values of some fields: as ``dataclasses.replace``, which takes ten times as long for two
        dozen fields since it calls the constructor. No table has a check there."""
        fields = self._fields
        if not values.keys() <= fields.keys():
            raise TypeError(f"{type(self).__name__} has no field {', '.join(values.keys() - fields.keys())}")
        out = object.__new__(type(self))
        out.__dict__.update(fields, **values)
        return out

    def take(self, which: NDArray[Any]) -> Self:
        """The rows of an index array, in any order, or of a mask; the table itself if a mask has all rows."""
        if which.dtype == np.bool_:
            if which.all():
                return self
            which = np.flatnonzero(which)
        return self.changed(**{name: taken(column, which) for name, column in self.columns().items()})

    def stacked(self, *others: Self) -> Self:
        """The rows of this table followed by those of others; the fields in ``WHOLE`` are those of this table."""
        parts = [columns for columns in (other.columns() for other in others) if any(map(len, columns.values()))]
        if not parts:
            return self
        own = self.columns()
        return self.changed(**{name: np.concatenate([own[name], *(part[name] for part in parts)]) for name in own})

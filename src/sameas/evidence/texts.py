"""Texts that name things: their plain spelling, and whether two differ by one bit or one slip of typing."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray


def plain(values: ArrayLike, unknown: Sequence[str] = ()) -> NDArray[Any]:
    """(n,) numbers as they are; texts in capitals, without spaces around them, "" where missing or in ``unknown``.

    Whole numbers count as texts: an MMSI is a name, not a size.
    """
    if isinstance(values, np.ma.MaskedArray):
        hidden, values = np.ma.getmaskarray(values), values.data.astype(object)
        values[hidden] = None
    array = np.asarray(values)
    if array.dtype.kind == "f":
        return array.astype(np.float64)
    cells = array.astype(object)
    if all(cell is None or isinstance(cell, float | np.floating) for cell in cells):
        return np.array([np.nan if cell is None else cell for cell in cells], dtype=np.float64)
    nothing = {"", "NONE", "NAN", *(text.upper() for text in unknown)}
    texts = (("" if cell is None else str(cell)).strip().upper() for cell in cells)
    return np.array(["" if text in nothing else text for text in texts], dtype=np.str_)


def differ_by_one_bit(first: NDArray[Any], second: NDArray[Any]) -> NDArray[np.bool_]:
    """(m,) whether two hexadecimal addresses differ in one bit; False where either is none."""
    a, b = _hexadecimal(first), _hexadecimal(second)
    difference = a ^ b
    return (a >= 0) & (b >= 0) & (difference != 0) & ((difference & (difference - 1)) == 0)


def _hexadecimal(texts: NDArray[Any]) -> NDArray[np.int64]:
    values, place = np.unique(texts, return_inverse=True)
    numbers = np.full(len(values), -1, np.int64)
    for k, text in enumerate(values):
        if 0 < len(text) <= 15 and not set(text) - set("0123456789ABCDEF"):
            numbers[k] = int(text, 16)
    return numbers[place]


def differ_by_one_typing(first: NDArray[Any], second: NDArray[Any]) -> NDArray[np.bool_]:
    """(m,) whether one letter was changed, lost or added, or two neighbours swapped (Damerau 1964)."""
    width = max(first.dtype.itemsize, second.dtype.itemsize, 4) // 4 + 1
    a, b = (
        np.ascontiguousarray(texts.astype(f"U{width}")).view(np.uint32).reshape(-1, width) for texts in (first, second)
    )
    long_a, long_b = np.count_nonzero(a, axis=1), np.count_nonzero(b, axis=1)
    other = a != b
    differing = other.sum(axis=1)
    at = other.argmax(axis=1)
    row, after = np.arange(len(a)), np.minimum(at + 1, width - 1)
    swapped = (differing == 2) & (a[row, at] == b[row, after]) & (a[row, after] == b[row, at]) & other[row, after]
    same_length = (long_a == long_b) & ((differing == 1) | swapped)
    longer = np.where((long_a > long_b)[:, None], a, b)
    shorter = np.where((long_a > long_b)[:, None], b, a)
    # Without the letter at the first difference the longer text is the shorter one.
    column = np.arange(width - 1)
    without = np.where(column < at[:, None], longer[:, :-1], longer[:, 1:])
    lost = (np.abs(long_a - long_b) == 1) & (without == shorter[:, :-1]).all(axis=1)
    return np.asarray(same_length | lost)

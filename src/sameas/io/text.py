"""Cells of text: bytes to Unicode and back, for whole columns at once.

NumPy converts one cell after the other; nearly all text in catalogues is ASCII, where widening is enough.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def unicode_of(cells: NDArray[Any]) -> NDArray[Any]:
    """Unicode cells from bytes: ASCII, else UTF-8, else Latin-1, in which every byte means something."""
    width = cells.dtype.itemsize
    if width == 0 or cells.size == 0:
        return np.zeros(cells.shape, dtype=f"U{max(width, 1)}")
    numbers = np.ascontiguousarray(cells).reshape(-1).view(np.uint8)
    if numbers.max() < 128:
        return numbers.astype(np.uint32).view(f"U{width}").reshape(cells.shape)
    try:
        return np.char.decode(cells, "utf-8")
    except UnicodeDecodeError:
        return np.char.decode(cells, "latin-1")


def ascii_of(cells: NDArray[Any]) -> NDArray[Any] | None:
    """Bytes from Unicode cells; None when a letter is not ASCII."""
    width = cells.dtype.itemsize // 4
    if width == 0 or cells.size == 0:
        return np.zeros(cells.shape, dtype=f"S{max(width, 1)}")
    native = np.ascontiguousarray(cells.astype(cells.dtype.newbyteorder("="), copy=False))
    numbers = native.reshape(-1).view(np.uint32)
    if numbers.max() > 127:
        return None
    return numbers.astype(np.uint8).view(f"S{width}").reshape(cells.shape)

"""Types of arrays by their elements, with shapes in the docstrings; the inner product of long arrays."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
Int32Array = NDArray[np.int32]
AnyIntArray = NDArray[np.integer[Any]]
ByteArray = NDArray[np.uint8]
BoolArray = NDArray[np.bool_]


def inner(one: NDArray[Any], other: NDArray[Any]) -> float:
    """Σ one · other, of two arrays (n,), in one thread.

    With more than 10 000 elements OpenBLAS (``@``) wakes a thread per processor for it, which then spins for 20 ms
    while other work waits, and the sum depends on their number.
    """
    return float(np.einsum("n,n->", one, other))

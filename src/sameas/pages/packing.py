"""Columns of numbers packed for a page: small in the file, and unpacked by a few lines of script (map-table.js).

A column is rounded to a step; of each number the difference from the one before is kept, its sign in the lowest bit
(zigzag), in as few bytes as the largest needs. All lowest bytes come first, then the next ones: most bytes of slowly
changing columns are then 0, and DEFLATE packs them away. Browsers unpack gzip by themselves.
"""

from __future__ import annotations

import base64
import gzip
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sameas.errors import InputError


def packed(columns: Mapping[str, tuple[NDArray[Any], float]]) -> tuple[list[dict[str, Any]], str]:
    """What the columns are, in order, and all their numbers as text.

    Parameters
    ----------
    columns : name to (values (n,), step). NaN says that there is no number.

    Returns
    -------
    (heads, text) : per column its name, step, length, bytes per number, and whether a byte of presence follows for
        each; base64 of gzip of the bytes.

    Example
    -------
    >>> heads, text = packed({"x_m": (np.array([1.0, 2.5]), 0.5)})
    >>> heads
    [{'name': 'x_m', 'step': 0.5, 'n': 2, 'bytes': 1, 'holes': False}]
    """
    heads, parts = [], []
    for name, (values, step) in columns.items():
        head, body = _column(name, np.asarray(values, np.float64), step)
        heads.append(head)
        parts.append(body)
    return heads, squeezed(b"".join(parts))


def squeezed(data: bytes) -> str:
    """base64 of gzip; the same bytes give the same text."""
    return base64.b64encode(gzip.compress(data, 6, mtime=0)).decode("ascii")


def _column(name: str, values: NDArray[np.float64], step: float) -> tuple[dict[str, Any], bytes]:
    there = np.isfinite(values)
    if np.any(np.abs(values[there]) / step >= 2**31):
        raise InputError(f"map: column {name} holds {np.abs(values[there]).max():g}, too large to be shown")
    counts = np.rint(np.where(there, values, 0.0) / step).astype(np.int64)
    # Where there is none, the number before stands: no difference to keep.
    last = np.maximum.accumulate(np.where(there, np.arange(len(values)), 0)) if len(values) else np.empty(0, np.int64)
    difference = np.diff(counts[last], prepend=0)
    zigzag = (difference << 1) ^ (difference >> 63)
    width = next(w for w in (1, 2, 4, 8) if not len(zigzag) or int(zigzag.max()) < 1 << (8 * w))
    planes = [((zigzag >> (8 * k)) & 255).astype(np.uint8).tobytes() for k in range(width)]
    holes = not bool(there.all())
    head = {"name": name, "step": step, "n": len(values), "bytes": width, "holes": holes}
    return head, b"".join([*planes, there.astype(np.uint8).tobytes() if holes else b""])

"""What pages hold in their data: numbers rounded, and images."""

from __future__ import annotations

import struct
import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray


def png(grey: NDArray[np.uint8]) -> bytes:
    """A grey image (rows, columns) of eight bits as the bytes of a PNG file (ISO/IEC 15948), first row on top."""
    rows, columns = grey.shape
    # Filter 1 (sub) keeps each byte less the one to its left: smooth images compress better.
    less = grey.copy()
    less[:, 1:] -= grey[:, :-1]
    lines = np.concatenate([np.ones((rows, 1), np.uint8), less], axis=1)
    head = struct.pack(">IIBBBBB", columns, rows, 8, 0, 0, 0, 0)
    body = zlib.compress(lines.tobytes(), 6)
    return b"\x89PNG\r\n\x1a\n" + _chunk(b"IHDR", head) + _chunk(b"IDAT", body) + _chunk(b"IEND", b"")


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def column(values: NDArray[Any], digits: int) -> list[float | None]:
    """Numbers rounded, null where they are none."""
    kept = np.round(np.asarray(values, np.float64), digits)
    return [None if value != value or abs(value) == float("inf") else value for value in kept.tolist()]


def rounded(value: float, digits: int) -> float | None:
    """A number rounded, null where it is none."""
    return column(np.array([value]), digits)[0]

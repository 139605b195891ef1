"""Silence: after how long a named track that says nothing more has ended.

A radar drops a track that it no longer sees, and says nothing about it; the last report would stand for an object that
has gone, or has another number by now. How long a source lets its tracks be silent is told by its own gaps: a track
that is silent for longer than all but one in a thousand of the gaps that did end is taken to have ended. So a radar's
tracks end after some turns, and vessels at anchor, which report every three minutes, after several of these.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sameas.records import FloatArray

#: Share of the gaps within tracks that are shorter than the silence that ends one.
SHORTER = 0.999


def ending_silence_s(time_s: FloatArray, track: NDArray[Any] | None) -> float:
    """Seconds of silence after which a track of the source has ended; infinite where no track has two reports.

    >>> ending_silence_s(np.array([0.0, 3.0, 6.0, 12.0]), np.array(["7", "7", "7", "7"]))
    6.0
    """
    if track is None or len(time_s) < 2:
        return math.inf
    _, number = np.unique(track.astype(str), return_inverse=True)
    order = np.lexsort([time_s, number])
    gaps = np.diff(time_s[order])[np.diff(number[order]) == 0]
    return float(np.quantile(gaps, SHORTER, method="higher")) if len(gaps) else math.inf

"""Typical position errors by magnitude, learned from the rows that have one."""

from __future__ import annotations

import numpy as np

from sameas.arrays import FloatArray

#: Rows that one median of the errors stands for, at least (chosen).
_ROWS_PER_MEDIAN = 25
#: At most so many medians along the magnitudes (chosen).
_MOST_MEDIANS = 50


def typical_errors(sigma: FloatArray, magnitude: FloatArray | None) -> FloatArray:
    """(n,) the median error at the magnitude of every row; of a row without magnitude the median of all.

    sigma : (n,) errors, NaN where not known. magnitude : (n,), NaN where not known. All NaN where no error is known.

    >>> typical_errors(np.array([0.1, 0.1, np.nan, 0.3, 0.3]), None).tolist()
    [0.2, 0.2, 0.2, 0.2, 0.2]
    """
    known = np.isfinite(sigma) & (sigma > 0)
    if not known.any():
        return np.full(len(sigma), np.nan)
    overall = np.full(len(sigma), float(np.median(sigma[known])))
    both = np.flatnonzero(known & np.isfinite(magnitude)) if magnitude is not None else np.zeros(0, np.int64)
    if magnitude is None or len(both) < 2 * _ROWS_PER_MEDIAN:
        return overall
    parts = np.array_split(both[np.argsort(magnitude[both])], min(_MOST_MEDIANS, len(both) // _ROWS_PER_MEDIAN))
    mags = [float(np.median(magnitude[part])) for part in parts]
    logs = [float(np.median(np.log(sigma[part]))) for part in parts]
    return np.where(np.isfinite(magnitude), np.exp(np.interp(magnitude, mags, logs)), overall)

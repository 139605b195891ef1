"""Compiled grades of records, and counts of them: see ``sameas.grades``."""

from __future__ import annotations

import numpy as np

from sameas.kernels.compiled import kernel


@kernel
def grade(place, within, limits, number, out):
    """Fill ``out`` (n,) with how many of the ``number`` − 1 limits of its own range lie at or below each place (n,).

    within : (n,) the ranges. limits : (ranges (number − 1),) rising in each range, range after range.
    """
    for k in range(len(out)):
        begin, here = within[k] * (number - 1), 0
        for limit in limits[begin : begin + number - 1]:
            here += limit <= place[k]
        out[k] = here


@kernel
def count_pairs(i, j, grades_1, grades_2, told, common):
    """Add the probabilities ``told`` (m,) of pairs to ``common`` (k₁, k₂); returns (m,) where each was added, row by
    row."""
    at = np.empty(len(i), np.int64)
    for e in range(len(i)):
        one, two = grades_1[i[e]], grades_2[j[e]]
        common[one, two] += told[e]
        at[e] = one * common.shape[1] + two
    return at


@kernel
def count_alone(cells, grades, partner, covered, count):
    """Add to ``count`` (cells, k) how probably each covered record is without a partner."""
    for k in range(len(cells)):
        if covered[k]:
            count[cells[k], grades[k]] += 1.0 - partner[k]

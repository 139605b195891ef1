"""The report of ``sameas internal``: what was estimated of one table, and the objects found in it."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from sameas.report.prose import DOUBT, entry, expected
from sameas.representation import count, counted
from sameas.result import AMBIGUOUS
from sameas.sky.crossmatch import typical_sigma_arcsec

if TYPE_CHECKING:
    from sameas.sky.internal import InternalMatch

#: Upper ends of the ranges of rows of an object that are listed; the last one has no end.
RANGES = (1, 2, 4, 8, 16, 32, 64, 128)


def internal_estimate_lines(match: InternalMatch, words: Callable[[str], str]) -> list[str]:
    """The estimates. words : formats a message that names arguments."""
    lines = ["Estimated"]
    if match.reach_arcsec:
        lines += entry("reach", f"rows of one object lie within {match.reach_arcsec:.3g} arcsec of each other; "
                       f"by chance a row has {match.chance:.2g} other objects there")  # fmt: skip
    if match.exposures:
        lines += entry("exposures", f"{count(match.exposures)}; each shows an object once")
    errors, sigma = match.errors, typical_sigma_arcsec(match.records)
    quoted = "as quoted" if abs(errors.factor_1 - 1.0) < 0.005 else f"{errors.factor_1:.2f} times those quoted"
    if match.catalogue.error_is_unknown:
        quoted = "from the distances of the rows to each other"
    floor = float(np.max(errors.floor)) / math.sqrt(2.0)
    added = f", and {floor:.2g} arcsec in quadrature" if floor > 0.01 * sigma else ""
    lines += entry("errors", f"median {sigma:.3g} arcsec on each axis: {quoted}{added}")
    if match.tail_share > 0.0:
        lines += entry("tail", f"{100.0 * match.tail_share:.1f} % of the rows err more than that by far")
    return [*lines, *(DOUBT + words(doubt) for doubt in match.doubts)]


def internal_summary_lines(match: InternalMatch) -> list[str]:
    """The objects by their numbers of rows, and how sure they are."""
    aside = len(match.catalogue) - len(match.records)
    several = match.n_rows > 1
    lines = ["Found", *entry("rows", f"{count(len(match.records))} used"
             + (f", {count(aside)} set aside" if aside else ""))]  # fmt: skip
    lines += [f"    set aside: {why} ({count(n)})" for why, n in match.records.set_aside.counts().items()]
    lines += entry("objects", f"{count(len(match))}: {count(int(several.sum()))} of several rows, "
                   f"{count(int((~several).sum()))} of one")  # fmt: skip
    bounds = [0, *RANGES, np.inf]
    for low, high in pairwise(bounds):
        number = int(np.count_nonzero((match.n_rows > low) & (match.n_rows <= high)))
        if number:
            name = (
                f"{low + 1}" if high == low + 1 else f"{low + 1} or more" if high == np.inf else f"{low + 1} to {high}"
            )
            lines += entry(f"  of {name} rows" if high > 1 else "  of 1 row", count(number))
    wrong_rows, wrong = float((1.0 - match.p_row).sum()), float((1.0 - match.p_object).sum())
    lines += entry("expected wrong", f"{expected(wrong_rows)} rows, {expected(wrong)} objects that lack or have a row")
    doubtful = int(np.count_nonzero(match.p_object < AMBIGUOUS))
    return [*lines, *entry("ambiguous", f"{counted(doubtful, 'object')} with a probability below {AMBIGUOUS}")]

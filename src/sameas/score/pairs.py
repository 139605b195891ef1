"""Scores of an identification against the truth: its decisions and its probabilities.

:func:`score_pairs` and :func:`score_records` score decisions; :func:`score_probabilities` and :func:`reliability` score
stated probabilities. All take plain arrays, so that any program can be scored. Pairs are given as (rows_1, rows_2), two
arrays of equal length, each row in at most one pair.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.errors import InputError
from sameas.representation import in_short

Pairs = tuple[ArrayLike, ArrayLike]


@dataclass(frozen=True)
class PairScore:
    """Numbers of claimed, true and right pairs; a ratio without a denominator is NaN."""

    n_claimed: int
    n_true: int
    n_right: int

    @property
    def precision(self) -> float:
        """Share of the claimed pairs that are true."""
        return self.n_right / self.n_claimed if self.n_claimed else math.nan

    @property
    def recall(self) -> float:
        """Share of the true pairs that are claimed."""
        return self.n_right / self.n_true if self.n_true else math.nan

    @property
    def f1(self) -> float:
        """Harmonic mean of precision and recall."""
        total = self.n_claimed + self.n_true
        return 2 * self.n_right / total if total else math.nan


@dataclass(frozen=True)
class RecordScore:
    """Numbers of records of each source, and of those assigned their true partner or rightly none."""

    n_1: int
    n_2: int
    n_right_1: int
    n_right_2: int

    @property
    def share_right(self) -> float:
        """Share of the records of both sources with the right decision; NaN without records."""
        total = self.n_1 + self.n_2
        return (self.n_right_1 + self.n_right_2) / total if total else math.nan


@dataclass(frozen=True)
class ProbabilityScore:
    """Scores of n stated probabilities, each a mean over the events.

    Attributes
    ----------
    brier : (p − outcome)², outcome 0 or 1; 0 is best.
    log_score : ln of the probability stated for the outcome; 0 is best, −∞ if an outcome had probability 0.
    expected_calibration_error : |stated − observed| of the bins of :func:`reliability`.
    """

    n: int
    brier: float
    log_score: float
    expected_calibration_error: float


@in_short
@dataclass(frozen=True)
class Reliability:
    """Stated probability against observed frequency, one row for each bin that is not empty.

    Attributes
    ----------
    stated : (b,) mean of the stated probabilities.
    observed : (b,) share of the events that happened.
    count : (b,) number of events.
    standard_error : (b,) of ``observed`` for right probabilities and independent events: √Σ p(1 − p) / count. Events of
        one group are not quite independent.
    """

    stated: FloatArray
    observed: FloatArray
    count: IntArray
    standard_error: FloatArray

    @property
    def deviation(self) -> FloatArray:
        """(b,) observed − stated in standard errors, 0 where both agree to rounding."""
        difference = self.observed - self.stated
        # Bins at p = 0 or 1 have an error of 0, so any difference there is infinite.
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(np.abs(difference) < 1e-9, 0.0, difference / self.standard_error)

    @property
    def expected_calibration_error(self) -> float:
        """Mean over the events of |stated − observed| of their bins; NaN without events."""
        if not len(self.count):
            return math.nan
        return float(np.average(np.abs(self.observed - self.stated), weights=self.count))


def score_pairs(claimed: Pairs, true: Pairs) -> PairScore:
    """Precision, recall and F1 of the claimed pairs.

    Parameters
    ----------
    claimed, true : (rows_1, rows_2), each (k,): rows of the two sources.

    >>> score_pairs(([0, 1, 2], [5, 6, 7]), ([0, 1, 3], [5, 7, 6])).precision
    0.3333333333333333
    """
    one, two = _one_to_one(claimed, "claimed"), _one_to_one(true, "true")
    return PairScore(len(one[0]), len(two[0]), int(is_true_pair(one, two).sum()))


def score_records(claimed: Pairs, true: Pairs, n1: int, n2: int) -> RecordScore:
    """How many of the n1 and n2 records were assigned their true partner, or rightly none.

    Parameters
    ----------
    claimed, true : (rows_1, rows_2), each (k,): rows of the two sources.
    n1, n2 : number of records of the sources, unmatched ones included.

    Source: METHOD 8 ("share of records decided rightly" [T]).
    """
    one, two = _one_to_one(claimed, "claimed"), _one_to_one(true, "true")
    right = int(is_true_pair(one, two).sum())
    # A record in neither list rightly has no partner.
    counts = []
    for n, side in ((n1, 0), (n2, 1)):
        paired = np.zeros(n, bool)
        for rows in (one[side], two[side]):
            if rows.max(initial=-1) >= n:
                raise InputError(f"a pair names row {rows.max()} of source {side + 1}, which has {n} records")
            paired[rows] = True
        counts.append(right + n - int(paired.sum()))
    return RecordScore(n1, n2, *counts)


def is_true_pair(pairs: Pairs, true: Pairs) -> BoolArray:
    """(m,) whether each of ``pairs``, not necessarily one to one, is among ``true``; both (rows_1, rows_2)."""
    rows_1, rows_2 = _rows(pairs, "pairs")
    true_1, true_2 = _one_to_one(true, "true")
    size = 1 + max(rows_1.max(initial=-1), true_1.max(initial=-1))
    partner, has_partner = np.empty(size, np.int64), np.zeros(size, bool)
    partner[true_1], has_partner[true_1] = true_2, True
    right: BoolArray = has_partner[rows_1] & (partner[rows_1] == rows_2)
    return right


def score_probabilities(p: ArrayLike, happened: ArrayLike) -> ProbabilityScore:
    """Brier score, log score and calibration error (in ten bins of equal width) of stated probabilities.

    Parameters
    ----------
    p : (m,) stated probabilities.
    happened : (m,) whether the event happened, e.g. :func:`is_true_pair`.
    """
    stated, event = _events(p, happened)
    if not len(stated):
        return ProbabilityScore(0, math.nan, math.nan, math.nan)
    with np.errstate(divide="ignore"):
        log_score = float(np.mean(np.log(np.where(event, stated, 1 - stated))))
    error = reliability(stated, event).expected_calibration_error
    return ProbabilityScore(len(stated), float(np.mean((stated - event) ** 2)), log_score, error)


def reliability(p: ArrayLike, happened: ArrayLike, *, bins: int = 10, width: str = "equal") -> Reliability:
    """The reliability table: the observed frequency of events with stated probabilities near p, by bins of p.

    Parameters
    ----------
    p : (m,) stated probabilities.
    happened : (m,) whether the event happened.
    bins : number of bins.
    width : "equal" for bins of equal width from 0 to 1; "adaptive" for bins of equal numbers of events.

    >>> table = reliability([0.2, 0.2, 0.2, 0.2, 0.2, 0.9], [True, False, False, False, False, True])
    >>> table.observed
    array([0.2, 1. ])
    """
    stated, event = _events(p, happened)
    if bins < 1:
        raise InputError(f"bins is {bins}; give at least one")
    if width == "equal":
        number = np.minimum((stated * bins).astype(np.int64), bins - 1)
    elif width == "adaptive":
        number = np.empty(len(stated), np.int64)
        number[np.argsort(stated, kind="stable")] = np.arange(len(stated)) * bins // max(len(stated), 1)
    else:
        raise InputError(f'width is {width!r}; give "equal" or "adaptive"')
    count, total, hits, variance = (
        np.bincount(number, weights, minlength=bins) for weights in (None, stated, event, stated * (1 - stated))
    )
    used = count > 0
    count = count[used]
    return Reliability(total[used] / count, hits[used] / count, count, np.sqrt(variance[used]) / count)


def _events(p: ArrayLike, happened: ArrayLike) -> tuple[FloatArray, BoolArray]:
    stated, event = np.asarray(p, np.float64), np.asarray(happened, bool)
    if stated.ndim != 1 or stated.shape != event.shape:
        raise InputError(f"{stated.shape} probabilities for {event.shape} events; give one per event")
    # Sums of probabilities may exceed 1 by rounding; more is an error in the input.
    wrong = np.flatnonzero(~((stated >= -1e-9) & (stated <= 1 + 1e-9)))
    if len(wrong):
        raise InputError(f"{len(wrong)} probabilities lie outside 0 … 1 (first: row {wrong[0]}: {stated[wrong[0]]:g})")
    return np.clip(stated, 0.0, 1.0), event


def _rows(pairs: Pairs, name: str) -> tuple[IntArray, IntArray]:
    rows = [np.asarray(side) for side in pairs]
    if len(rows) != 2 or rows[0].ndim != 1 or rows[0].shape != rows[1].shape:
        raise InputError(f"{name} pairs: give (rows_1, rows_2), two lists of equal length")
    for side, numbers in enumerate(rows, start=1):
        if len(numbers) and (numbers.dtype.kind not in "iu" or numbers.min() < 0):
            raise InputError(f"{name} pairs: rows of source {side} are not row numbers; give integers from 0")
    return rows[0].astype(np.int64), rows[1].astype(np.int64)


def _one_to_one(pairs: Pairs, name: str) -> tuple[IntArray, IntArray]:
    rows = _rows(pairs, name)
    for side, numbers in enumerate(rows, start=1):
        twice = np.flatnonzero(np.bincount(numbers) > 1)
        if len(twice):
            raise InputError(f"{name} pairs: row {twice[0]} of source {side} has several partners; give at most one")
    return rows

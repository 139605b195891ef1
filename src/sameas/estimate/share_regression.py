"""Share regression: how the columns of a source change the share of its records with a partner.

All columns of a source are fitted jointly, by penalised likelihood, to the probability that each record has a partner:

    logit P(partner | position, c) = logit of the local share + Σ f(c of one column) + Σ g(cells of two columns).

So correlated columns are not counted twice, and no column gets more weight than the pairs support: the penalty draws
curves and tables to zero.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.evidence.columns import CodedColumn
from sameas.evidence.detection import LinearSpline, logit, roughness

if TYPE_CHECKING:
    from scipy.sparse import csr_array


COLUMN_FOLDS = 4  # number of folds for cross-fitting
ROWS_PER_CELL = 5.0  # mean number of records of the poorer source in the cells that are assigned to folds, at least
PER_KNOT, MAX_KNOTS = 40.0, 16  # expected partners per knot of a curve, and their greatest number, without KNOTS_OF_ALL
KNOTS_OF_ALL = 6  # knots at quantiles of all records
EXTREME = 0.003  # share of the partners beyond the outermost of their knots
#: Prior scale of a curve's second differences, and prior standard deviation of its value.
BEND_SIGMA, VALUE_SIGMA = 0.7, 6.0
#: Degrees of freedom of Student's t, the prior of the second differences: a curve may break at a knot, such as at the
#: limit of a catalogue.
FREEDOM = 2.0
JOINT_SIGMA = 0.5  # for cells of two columns
MAX_WORDS = 24  # number of categories of a column, the most frequent ones
CELLS = 4  # coarse cells of a column in a joint table
PER_JOINT_CELL = 20.0  # expected partners per cell of such a table; with fewer it is not used
MIN_P_COLUMNS = 1e-3  # records with this probability of a partner are sampled separately
MAX_LIKELY = 6_000  # size of that sample
MAX_LOG_RATIO = 12.0  # ln r is clipped to ± this
MIN_PARTNERS = 30.0  # expected partners for any fit
#: Pairs per cell of a table of related columns, and its greatest size per axis.
ROWS_PER_RELATED_CELL, MAX_RELATED = 6.0, 16
COLUMNS_PSEUDO_COUNT = 2.0  # pairs added to each cell, as if unrelated


# Parameters of the fit; tuned on simulated counterparts of X-ray sources (``simulate.counterparts``).
WORD_SIGMA = 2.0  # prior standard deviation of the value for a word or a missing value
MAX_UNMATCHED = 6_000  # size of the sample of records without a partner
STEPS, FIRST_STEPS = 4, 12  # Newton steps of later fits and of the first one
MAX_STEP, TOLERANCE = 2.0, 0.02  # greatest step, and the step at convergence
MIN_GAIN = 3.0  # gain in ln likelihood, for records not fitted to, to use a column


@dataclass(frozen=True)
class ColumnFinding:
    """The evidence of one column: ``gain`` in ln likelihood for records that it was not fitted to.

    source : 1 or 2; 0 for two related columns, the second of which is ``other``. used : whether it is used. span : the
    1 % and 99 % quantiles of ln r by this column alone.
    """

    source: int
    name: str
    gain: float
    used: bool
    span: tuple[float, float] = (0.0, 0.0)
    other: str = ""


@dataclass(frozen=True)
class _Basis:
    """The basis functions of one column: a curve, or a value for each of some words; and a value if missing.

    knots : (k,), or the codes of words. edges : of its coarse cells in joint tables.
    """

    knots: FloatArray
    words: bool
    edges: FloatArray

    @classmethod
    def of(cls, column: CodedColumn, weight: FloatArray, partners: float) -> _Basis:
        """For a column, at records with these weights (n,) of having a partner."""
        known = np.isfinite(column.values)
        if column.words is not None:
            codes, count = np.unique(column.values[known], return_counts=True)
            codes = np.sort(codes[np.argsort(-count, kind="stable")[:MAX_WORDS]])
            return cls(codes, True, codes)
        x, w = column.values[known], weight[known]
        if not len(x):
            return cls(np.zeros(1), False, np.empty(0))
        number = int(np.clip(partners / PER_KNOT, 2, MAX_KNOTS))
        levels = np.linspace(EXTREME, 1.0 - EXTREME, number)
        of_partners = quantiles(x, w, levels) if w.sum() > 0.0 else np.empty(0)
        of_all = np.quantile(x, np.linspace(0.002, 0.998, KNOTS_OF_ALL))
        knots = np.unique(np.concatenate([of_partners, of_all]))
        min_distance = 1e-3 * max(float(knots[-1] - knots[0]), 1e-12)
        knots = knots[np.append(True, np.diff(knots) > min_distance)]
        inner = np.linspace(0.0, 1.0, CELLS + 1)[1:-1]
        edges = np.unique(quantiles(x, w, inner)) if w.sum() > 0.0 else np.empty(0)
        return cls(knots, False, edges)

    @property
    def size(self) -> int:
        """Number of functions."""
        return len(self.knots) + 1

    def penalty(self, values: FloatArray) -> FloatArray:
        """(size, size) at coefficients (size,): the weight of a second difference falls with its size (Student's t)."""
        out, k = np.eye(self.size) / WORD_SIGMA**2, len(self.knots)
        if not self.words:
            bends = np.diff(values[:k], n=2) / BEND_SIGMA
            weight = (FREEDOM + 1.0) / (FREEDOM + bends**2)
            out[:k, :k] = roughness(k, BEND_SIGMA, weight) + np.eye(k) / VALUE_SIGMA**2
        return out

    def design(self, values: FloatArray) -> FloatArray:
        """(n, size) the basis functions at values (n,)."""
        out, rows, k = np.zeros((len(values), self.size)), np.arange(len(values)), len(self.knots)
        missing = ~np.isfinite(values)
        if self.words:
            at, known = self._code(values)
            out[rows[known], at[known]] = 1.0
        else:
            spline = LinearSpline.at(self.knots, np.where(missing, self.knots[0], values))
            out[rows, spline.left] = 1.0 - spline.part
            out[rows, np.minimum(spline.left + 1, k - 1)] += spline.part
            out[missing] = 0.0
        out[missing, k] = 1.0
        return out

    def values(self, coefficients: FloatArray, fold: IntArray, x: FloatArray) -> FloatArray:
        """(n,) the sum of the basis functions at x (n,), with the coefficients (folds, size) of these folds (n,)."""
        k, missing = len(self.knots), ~np.isfinite(x)
        if self.words:
            at, known = self._code(x)
            return np.where(missing, coefficients[fold, k], np.where(known, coefficients[fold, at], 0.0))
        spline = LinearSpline.at(self.knots, np.where(missing, self.knots[0], x))
        right = np.minimum(spline.left + 1, k - 1)
        curve = (1.0 - spline.part) * coefficients[fold, spline.left] + spline.part * coefficients[fold, right]
        return np.where(missing, coefficients[fold, k], curve)

    def _code(self, values: FloatArray) -> tuple[IntArray, BoolArray]:
        if not len(self.knots):
            return np.zeros(len(values), np.int64), np.zeros(len(values), np.bool_)
        at = np.clip(np.searchsorted(self.knots, np.where(np.isfinite(values), values, -1.0)), 0, len(self.knots) - 1)
        return at, self.knots[at] == values

    @property
    def cells(self) -> int:
        """Number of coarse cells; the last is for missing values and infrequent words."""
        return len(self.edges) + (1 if self.words else 2)

    def cell(self, values: FloatArray) -> IntArray:
        """(n,) coarse cells."""
        if self.words:
            at, known = self._code(values)
            return np.where(known, at, len(self.knots))
        return np.where(np.isfinite(values), np.searchsorted(self.edges, values), len(self.edges) + 1)


def quantiles(x: FloatArray, weight: FloatArray, levels: FloatArray) -> FloatArray:
    """Weighted quantiles of x at these levels."""
    order = np.argsort(x, kind="stable")
    cumulated = np.cumsum(weight[order])
    return np.asarray(x[order][np.minimum(np.searchsorted(cumulated, levels * cumulated[-1]), len(x) - 1)])


@dataclass(frozen=True)
class _Bases:
    """The basis functions of all used columns, and the joint tables of pairs of columns with enough partners.

    used : (c,) whether a column is used. two : pairs of columns.
    """

    single: tuple[_Basis, ...]
    used: tuple[bool, ...]
    two: tuple[tuple[int, int], ...]

    @classmethod
    def of(cls, columns: Sequence[CodedColumn], weight: FloatArray, partners: float) -> _Bases:
        single = tuple(_Basis.of(column, weight, partners) for column in columns)
        two = [
            (a, b)
            for a, b in combinations(range(len(columns)), 2)
            if single[a].cells * single[b].cells * PER_JOINT_CELL <= partners
        ]
        return cls(single, (True,) * len(columns), tuple(two))

    def without(self, k: int) -> _Bases:
        """The basis without column k."""
        return replace(
            self, used=tuple(used and n != k for n, used in enumerate(self.used)),
            two=tuple(pair for pair in self.two if k not in pair),
        )  # fmt: skip

    def without_pair(self, pair: tuple[int, int]) -> _Bases:
        """The basis without the joint table of these two columns."""
        return replace(self, two=tuple(two for two in self.two if two != pair))

    def cells(self, a: int, b: int) -> int:
        """Number of cells of a joint table."""
        return self.single[a].cells * self.single[b].cells

    def cell(self, a: int, b: int, columns: Sequence[CodedColumn]) -> IntArray:
        """(n,) cells of a joint table."""
        return self.single[a].cell(columns[a].values) * self.single[b].cells + self.single[b].cell(columns[b].values)

    def design(self, columns: Sequence[CodedColumn]) -> FloatArray:
        """(n, P) all basis functions at the values of the columns."""
        blocks = [
            basis.design(column.values)
            for basis, column, used in zip(self.single, columns, self.used, strict=True)
            if used
        ]
        for a, b in self.two:
            cell = self.cell(a, b, columns)
            block = np.zeros((len(cell), self.cells(a, b)))
            block[np.arange(len(cell)), cell] = 1.0
            blocks.append(block)
        return np.hstack(blocks) if blocks else np.zeros((len(columns[0].values), 0))

    def penalty(self, values: FloatArray) -> FloatArray:
        """(P, P) at coefficients (P,)."""
        parts: list[FloatArray] = []
        for basis, used in zip(self.single, self.used, strict=True):
            if used:
                begin = sum(map(len, parts))
                parts.append(basis.penalty(values[begin : begin + basis.size]))
        parts += [np.eye(self.cells(a, b)) / JOINT_SIGMA**2 for a, b in self.two]
        out, at = np.zeros((sum(map(len, parts)),) * 2), 0
        for part in parts:
            out[at : at + len(part), at : at + len(part)] = part
            at += len(part)
        return out


@dataclass(frozen=True)
class ShareFit:
    """Coefficients (folds, P), each fitted without one of the folds; ``whole`` (P,) from all."""

    bases: _Bases
    coefficients: FloatArray
    whole: FloatArray

    def log_ratio(self, columns: Sequence[CodedColumn], fold: IntArray) -> FloatArray:
        """(n,) ln r of records in these folds."""
        out, begin, bases = np.zeros(len(fold)), 0, self.bases
        for basis, column, used in zip(bases.single, columns, bases.used, strict=True):
            if used:
                out += basis.values(self.coefficients[:, begin : begin + basis.size], fold, column.values)
                begin += basis.size
        for a, b in bases.two:
            out += self.coefficients[fold, begin + bases.cell(a, b, columns)]
            begin += bases.cells(a, b)
        return np.clip(out, -MAX_LOG_RATIO, MAX_LOG_RATIO)


@dataclass(frozen=True)
class ShareRegression:
    """A sample of the records of a source, for the regression of the share with a partner.

    columns : at these records. p, offset, fold : (n,) probability of a partner, logit expected without columns, fold.
    rivals : (n,) probability that the record or a rival of it, by its candidates, is a partner; p if it has no rivals.
    weight : (n,) number of records that each represents. previous : the fit to start from.
    """

    columns: tuple[CodedColumn, ...]
    p: FloatArray
    rivals: FloatArray
    offset: FloatArray
    fold: IntArray
    weight: FloatArray
    bases: _Bases
    previous: ShareFit | None

    @classmethod
    def of(
        cls, partner: FloatArray, rivals: FloatArray, offset: FloatArray, covered: BoolArray, fold: IntArray,
        previous: ShareFit | None, columns: Sequence[CodedColumn],
    ) -> ShareRegression | None:  # fmt: skip
        """The regression; None with too few partners."""
        likely = np.flatnonzero(covered & (partner >= MIN_P_COLUMNS))
        alone = np.flatnonzero(covered & (partner < MIN_P_COLUMNS))
        partners = float(partner[likely].sum())
        if partners < MIN_PARTNERS:
            return None
        parts = []
        for rows, enough in ((likely, MAX_LIKELY), (alone, MAX_UNMATCHED)):
            # By a hash of the row: the same rows in every iteration, however many others come and go.
            bits = rows.astype(np.uint32) * np.uint32(0x9E3779B1)
            kept = rows[bits <= np.uint32(min(1.0, enough / max(len(rows), 1)) * 0xFFFFFFFF)]
            parts.append((kept, np.full(len(kept), len(rows) / max(len(kept), 1))))
        rows, weight = (np.concatenate(both) for both in zip(*parts, strict=True))
        some = tuple(column.take(rows) for column in columns)
        p = partner[rows]
        # The basis stays the same, so that a fit can start from the previous one.
        bases = _Bases.of(some, p * weight, partners) if previous is None else previous.bases
        return cls(some, p, np.maximum(rivals[rows], p), offset[rows], fold[rows], weight, bases, previous)

    def fit(self, bases: _Bases) -> ShareFit:
        """The fit of greatest penalised likelihood; those without a fold are one Newton step from that of all."""
        design = _sparse(bases.design(self.columns))
        resumed = self.previous is not None and self.previous.bases is bases
        values = self.previous.whole.copy() if resumed and self.previous else np.zeros(design.shape[1])
        folds = [np.flatnonzero(self.fold == fold) for fold in range(COLUMN_FOLDS)]
        for _ in range(STEPS if resumed else FIRST_STEPS):
            penalty = bases.penalty(values)
            slope, curvature = self._derivatives(design, values, slice(None))
            if not _is_positive_definite(curvature + penalty):
                # Not concave: take an EM step, with the curvature of certain partners.
                slope, curvature = self._derivatives(design, values, slice(None), certain=True)
            step = np.linalg.solve(curvature + penalty, slope - penalty @ values)
            step *= min(1.0, MAX_STEP / max(float(np.abs(step).max(initial=0.0)), 1e-12))
            values = values + step
            if np.abs(step).max(initial=0.0) < TOLERANCE:
                break
        parts, penalty = [self._derivatives(design[k], values, k) for k in folds], bases.penalty(values)
        slope, curvature = (np.sum(part, axis=0) for part in zip(*parts, strict=True))
        if not all(_is_positive_definite(curvature - own + penalty) for _, own in parts):
            parts = [self._derivatives(design[k], values, k, certain=True) for k in folds]
            slope, curvature = (np.sum(part, axis=0) for part in zip(*parts, strict=True))
        without = [
            values + np.linalg.solve(curvature - own + penalty, slope - own_slope - penalty @ values)
            for own_slope, own in parts
        ]
        return ShareFit(bases, np.array(without), values)

    def _derivatives(
        self, design: csr_array, values: FloatArray, rows: IntArray | slice, *, certain: bool = False
    ) -> tuple[FloatArray, FloatArray]:
        """Slope (P,) and negative curvature (P, P) of Σ (p/P) ln [Q r + 1 − Q] − ln [π r + 1 − π] over some records;
        ``certain`` takes the curvature for certain partners.

        P is ``rivals``, and Q its value without the columns. The candidates k of one record of the other source have
        ln [1 − P + Σ p_k x_k] together, with x = r over its previous value. By the concavity of ln this is at least
        Σ (p_k/P) ln [1 − P + P x_k], and equal at x = 1: a step that raises the sum raises the likelihood. With each
        candidate by itself, as if it had no rivals, fits in crowds overshot, and the iterations went to and fro.
        """
        log_ratio, offset, weight = design @ values, self.offset[rows], self.weight[rows]
        share = _probability(offset + log_ratio)
        p, rivals = self.p[rows], self.rivals[rows]
        either = np.where(p > 0.0, _probability(logit(rivals) - self.included[rows] + log_ratio), 0.0)
        p = either * p / np.maximum(rivals, 1e-300)
        bend = share * (1.0 - share) - (0.0 if certain else p * (1.0 - either))
        weighted = design.multiply((weight * bend)[:, None]).tocsr()
        return design.T @ (weight * (p - share)), (weighted.T @ design).toarray()

    @cached_property
    def included(self) -> FloatArray:
        """(n,) ln r that the probabilities include."""
        none = np.zeros(len(self.p))
        return none if self.previous is None else self.previous.log_ratio(self.columns, self.fold)

    def informative(self, source: int) -> tuple[ShareFit | None, list[ColumnFinding]]:
        """The fit with the informative columns, and the findings for all."""
        weight, findings = self.p * self.weight, []
        bases = _Bases.of(self.columns, weight, float(weight.sum()))
        best = self.fit(bases)
        best_gain = self.gain(best)
        for pair in bases.two:
            fewer = bases.without_pair(pair)
            rest = self.fit(fewer)
            if best_gain - (without := self.gain(rest)) <= MIN_GAIN:
                bases, best, best_gain = fewer, rest, without
        for k, column in enumerate(self.columns):
            fewer = bases.without(k)
            rest = self.fit(fewer)
            gain = best_gain - (without := self.gain(rest))
            if gain <= MIN_GAIN:
                bases, best, best_gain = fewer, rest, without
            findings.append(ColumnFinding(source, column.name, gain, gain > MIN_GAIN, self._span(column)))
        return best, findings

    def _span(self, column: CodedColumn) -> tuple[float, float]:
        """The 1 % and 99 % quantiles of ln r by this column alone."""
        bases = _Bases.of([column], self.p * self.weight, float((self.p * self.weight).sum()))
        alone = replace(self, columns=(column,), bases=bases, previous=None)
        low, high = np.quantile(alone.fit(bases).log_ratio([column], self.fold), (0.01, 0.99))
        return float(low), float(high)

    def gain(self, fit: ShareFit) -> float:
        """Gain in ln likelihood of the columns' values over no evidence, with cross-fitted coefficients.

        Per record ln [q r + 1 − q] − ln [π r + 1 − π], with q the probability of a partner without the columns, and π
        that by the position.
        """
        if fit.coefficients.shape[1] == 0:
            return 0.0
        r = np.expm1(fit.log_ratio(self.columns, self.fold))
        q = np.where(self.p < MIN_P_COLUMNS * 1e-3, 0.0, _probability(logit(self.p) - self.included))
        return float((self.weight * (np.log1p(q * r) - np.log1p(_probability(self.offset) * r))).sum())


def _sparse(design: FloatArray) -> csr_array:
    """A design (n, P), of whose functions few differ from 0 at a record: products of it as dense matrices would be as
    fast, but for the threads of BLAS, which take 100 times as long where other processes keep the cores busy."""
    from scipy.sparse import csr_array

    return csr_array(design)


def _probability(logits: FloatArray) -> FloatArray:
    return np.asarray(1.0 / (1.0 + np.exp(-np.clip(logits, -40.0, 40.0))))


def _is_positive_definite(curvature: FloatArray) -> bool:
    """Whether a symmetric matrix is positive definite."""
    try:
        np.linalg.cholesky(curvature)
    except np.linalg.LinAlgError:
        return False
    return True

"""Evidence of columns for whether a record has a partner, estimated together with the identification.

The columns of a source are fitted jointly (:mod:`sameas.estimate.share_regression`): ln r (METHOD 6, equation 6.6) is
their addition to the logit of the share of records with a partner. Related columns of both sources are tables of how
much oftener their values occur together in pairs than apart. No record influences its own evidence: what is applied to
the records of some cells of the sky is fitted to the others (cross-fitting). A column without a significant gain in
likelihood for records that it was not fitted to is dropped, and reported.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import ABSENT, BoolArray, FloatArray, IntArray
from sameas.estimate.sample import Setting
from sameas.estimate.share_regression import (
    COLUMN_FOLDS,
    COLUMNS_PSEUDO_COUNT,
    MAX_RELATED,
    MIN_GAIN,
    MIN_P_COLUMNS,
    ROWS_PER_CELL,
    ROWS_PER_RELATED_CELL,
    ColumnFinding,
    ShareFit,
    ShareRegression,
    quantiles,
)
from sameas.evidence.columns import Association, CodedColumn, Column, Columns, Related
from sameas.evidence.detection import LinearSpline
from sameas.gate import Pairs
from sameas.records import Records
from sameas.representation import in_short

Both = tuple[FloatArray, FloatArray]


@in_short
@dataclass(frozen=True)
class ColumnEvidence:
    """The columns of two sources and their estimated evidence. Make it with :meth:`of`.

    sides : columns of each source. relations : of both. folds : (n₁,), (n₂,) of the records; None before assignment.
    fits : of each source, None without a fit. log_ratio : (n₁,), (n₂,) ln r of all fitted columns; None without a fit.
    associations : of each relation, None without one. findings : of every column.
    """

    sides: tuple[tuple[CodedColumn, ...], tuple[CodedColumn, ...]] = field(repr=False)
    relations: tuple[tuple[CodedColumn, CodedColumn], ...] = field(repr=False, default=())
    fits: tuple[ShareFit | None, ShareFit | None] = field(repr=False, default=(None, None))
    associations: tuple[Association | None, ...] = field(repr=False, default=())
    folds: tuple[IntArray, IntArray] | None = field(repr=False, default=None)
    log_ratio: Both | None = field(repr=False, default=None)
    findings: tuple[ColumnFinding, ...] = ()

    @classmethod
    def of(cls, first: Records, second: Records, evidence: Sequence[Column | Related]) -> ColumnEvidence | None:
        """Without fits; None without columns. Related columns also count as columns of their sources."""
        sides: tuple[list[CodedColumn], list[CodedColumn]] = ([], [])
        relations = []
        for one in evidence:
            columns = one.columns if isinstance(one, Related) else (one,)
            coded = [column.of((first, second)[column.source - 1]) for column in columns]
            for column, coded_column in zip(columns, coded, strict=True):
                own = sides[column.source - 1]
                if not any(_is_same(coded_column, other) for other in own):
                    own.append(coded_column)
            if isinstance(one, Related):
                relations.append((coded[0], coded[1]))
        if not any(sides):
            return None
        return cls((tuple(sides[0]), tuple(sides[1])), tuple(relations))

    def part(self, rows_1: IntArray, rows_2: IntArray) -> ColumnEvidence:
        """The columns of some records, before any fit."""
        rows = rows_1, rows_2
        one, two = (tuple(c.take(at) for c in side) for side, at in zip(self.sides, rows, strict=True))
        relations = tuple((a.take(rows_1), b.take(rows_2)) for a, b in self.relations)
        return replace(self, sides=(one, two), relations=relations, associations=(), folds=None)

    def in_folds(self, setting: Setting) -> ColumnEvidence:
        """With folds assigned to the records, by cells of the sky."""
        if self.folds is not None:
            return self
        most = min(len(setting.pairs.first), len(setting.pairs.second)) / ROWS_PER_CELL
        level = next((level for level in setting.levels[::-1] if len(level.volume) <= most), setting.levels[0])
        one, two = (cell.astype(np.int64) % COLUMN_FOLDS for cell in (level.of_first, level.of_second))
        return replace(self, folds=(one, two))

    def for_setting(self, setting: Setting, columns: ColumnEvidence) -> ColumnEvidence:
        """The same fits for other records, whose ``columns`` are given."""
        folds = columns.in_folds(setting).folds
        assert folds is not None
        return self.over(columns, folds)

    def over(self, columns: ColumnEvidence, folds: tuple[IntArray, IntArray]) -> ColumnEvidence:
        """The same fits for other records of the same sources, with given columns and folds (n₁,), (n₂,)."""
        one, two = (
            tuple(column.coded_as(own) for column, own in zip(given, own_side, strict=True))
            for given, own_side in zip(columns.sides, self.sides, strict=True)
        )
        coded = {(source, c.name): c for source, side in ((1, one), (2, two)) for c in side}
        pairs = [(coded[1, a.name], coded[2, b.name]) for a, b in self.relations]
        related = tuple(
            association and replace(_for_columns(association, pair), folds=folds[0])
            for association, pair in zip(self.associations, pairs, strict=False)
        )
        return replace(
            columns, sides=(one, two), relations=tuple(pairs), fits=self.fits, findings=self.findings, folds=folds,
            associations=related,
        )._with_log_ratio()  # fmt: skip

    def without_records(self) -> ColumnEvidence:
        """The fits only, for :meth:`over`."""
        none = np.empty(0, np.int64)
        associations = tuple(
            one and replace(one, cells=(none, none), parts=(none.astype(np.float64),) * 2, folds=none)
            for one in self.associations
        )
        return replace(self.part(none, none), associations=associations, log_ratio=None)

    @property
    def given_only(self) -> ColumnEvidence | None:
        """The given priors without fits; None without any."""
        one, two = (tuple(c for c in side if c.log_odds is not None) for side in self.sides)
        return replace(self, sides=(one, two), relations=(), associations=()) if one or two else None

    def rule(self) -> Columns | None:
        """The evidence; None without fits and given priors."""
        sizes = self._sizes
        given = None
        if any(c.log_odds is not None for side in self.sides for c in side):
            one, two = (
                np.sum([c.log_odds for c in side if c.log_odds is not None] or [np.zeros(n)], axis=0)
                for side, n in zip(self.sides, sizes, strict=True)
            )
            given = one, two
        associations = tuple(one for one in self.associations if one is not None)
        if given is None and self.log_ratio is None and not associations:
            return None
        return Columns(self.log_ratio, given, associations)

    def design(self, source: int, rows: IntArray) -> FloatArray:
        """(k, P) basis functions of the source's fit at these records (k,); P is 0 without a fit."""
        fit, side = self.fits[source - 1], _to_fit(self.sides[source - 1])
        return np.zeros((len(rows), 0)) if fit is None else fit.bases.design([column.take(rows) for column in side])

    def _with_log_ratio(self) -> ColumnEvidence:
        """With ln r of the records by the fits."""
        if self.folds is None or not any(fit is not None for fit in self.fits):
            return replace(self, log_ratio=None)
        one, two = (
            np.zeros(n) if fit is None else fit.log_ratio(_to_fit(side), fold)
            for fit, side, fold, n in zip(self.fits, self.sides, self.folds, self._sizes, strict=True)
        )
        return replace(self, log_ratio=(one, two))

    @property
    def _sizes(self) -> tuple[int, int]:
        assert self.folds is not None
        return len(self.folds[0]), len(self.folds[1])

    def fitted(
        self, pairs: Pairs, p_counted: FloatArray, partner: Both, offset: Both, covered: tuple[BoolArray, BoolArray], *,
        last: bool = False,
    ) -> ColumnEvidence:  # fmt: skip
        """The M-step: fits to the probabilities of pairs (m,) and of having a partner (n₁,), (n₂,).

        offset : (n₁,), (n₂,) logit of the share expected from position and magnitude. covered : whether records are
        used. In the first and the ``last`` fit, uninformative columns are dropped.
        """
        assert self.folds is not None
        fits: list[ShareFit | None] = []
        findings: list[ColumnFinding] = []
        rivals = _rivals(pairs, p_counted, partner)
        for k, (side, previous) in enumerate(zip(self.sides, self.fits, strict=True)):
            columns, of_records = _to_fit(side), (partner[k], rivals[k], offset[k], covered[k], self.folds[k])
            regression = ShareRegression.of(*of_records, previous, columns) if columns else None
            if regression is None:
                fits.append(None)
                continue
            fit, own_findings = (
                regression.informative(k + 1) if last or previous is None else (regression.fit(regression.bases), [])
            )
            fits.append(fit)
            findings += own_findings
        fitted = [(pair, *_fit_association(*pair, pairs, p_counted, self.folds[0])) for pair in self.relations]
        if last:
            findings += [finding for _, _, finding in fitted]
            fitted = [each for each in fitted if each[2].used]
        return replace(
            self,
            fits=(fits[0], fits[1]),
            associations=tuple(association for _, association, _ in fitted),
            relations=tuple(pair for pair, _, _ in fitted),
            findings=tuple(findings),
        )._with_log_ratio()


def _is_same(one: CodedColumn, other: CodedColumn) -> bool:
    return one.name == other.name and np.array_equal(one.values, other.values, equal_nan=True)


def _rivals(pairs: Pairs, p_pair: FloatArray, partner: Both) -> Both:
    """(n₁,), (n₂,) probability that a record's candidates of the other source have a partner, weighted by those (m,) of
    the pairs; 0 without candidates."""
    one, two = (
        np.bincount(own, p_pair * of_other[other], len(p)) / np.maximum(np.bincount(own, p_pair, len(p)), 1e-300)
        for own, other, p, of_other in (
            (pairs.i, pairs.j, partner[0], partner[1]), (pairs.j, pairs.i, partner[1], partner[0])
        )
    )  # fmt: skip
    return one, two


def _to_fit(side: Sequence[CodedColumn]) -> tuple[CodedColumn, ...]:
    return tuple(column for column in side if column.log_odds is None)


# ---- related columns ----


def _knots(column: CodedColumn, weight: FloatArray, rows: NDArray[np.integer], number: int) -> FloatArray:
    """(k,) knots of a numeric column at quantiles of the pairs, or its codes."""
    values, w = column.values[rows], weight
    known = np.isfinite(values)
    if column.words is not None:
        return np.arange(len(column.words), dtype=np.float64)
    if not known.any() or not w[known].sum() > 0.0:
        return np.zeros(1)
    return np.unique(quantiles(values[known], w[known], (np.arange(number) + 0.5) / number))


def _cells_and_parts(column: CodedColumn, knots: FloatArray) -> tuple[IntArray, FloatArray]:
    """(n,) cells of values, ABSENT if missing, and the fraction of each towards the next cell."""
    missing = ~np.isfinite(column.values)
    if column.words is not None:
        missing |= column.values >= len(column.words)  # words unknown to the fit
        return np.where(missing, ABSENT, np.nan_to_num(column.values)).astype(np.int64), np.zeros(len(missing))
    spline = LinearSpline.at(knots, np.where(missing, knots[0], column.values))
    return np.where(missing, ABSENT, spline.left), np.where(missing, 0.0, spline.part)


def _fit_association(
    a: CodedColumn, b: CodedColumn, pairs: Pairs, p_counted: FloatArray, folds: IntArray
) -> tuple[Association | None, ColumnFinding]:
    """The association of two columns in pairs of these probabilities, and its finding."""
    known = np.isfinite(a.values[pairs.i]) & np.isfinite(b.values[pairs.j]) & (p_counted > MIN_P_COLUMNS)
    i, j, p = pairs.i[known], pairs.j[known], p_counted[known]
    number = int(min(math.sqrt(float(p.sum()) / ROWS_PER_RELATED_CELL), MAX_RELATED))
    without = ColumnFinding(0, a.name, 0.0, False, other=b.name)
    if number < 2:
        return None, without
    knots = _knots(a, p, i, number), _knots(b, p, j, number)
    sizes = tuple(map(len, knots))
    cells, parts = zip(*(_cells_and_parts(column, at) for column, at in zip((a, b), knots, strict=True)), strict=True)
    counts = np.zeros((COLUMN_FOLDS, *sizes))
    for left, weight_1 in ((cells[0][i], 1.0 - parts[0][i]), (np.minimum(cells[0][i] + 1, sizes[0] - 1), parts[0][i])):
        for right, weight_2 in (
            (cells[1][j], 1.0 - parts[1][j]),
            (np.minimum(cells[1][j] + 1, sizes[1] - 1), parts[1][j]),
        ):
            np.add.at(counts, (folds[i], left, right), p * weight_1 * weight_2)
    table = np.array([_log_association(counts.sum(axis=0) - own, COLUMNS_PSEUDO_COUNT) for own in counts])
    association = _KnottedAssociation(cells, parts, folds, table, knots)
    values = association(pairs)[known]
    # As for single columns, with cross-fitted tables and by the odds without the relation.
    gain = float((p * values).sum())
    return association, replace(without, gain=gain, used=gain > MIN_GAIN)


def _log_association(counts: FloatArray, pseudo_count: float) -> FloatArray:
    """(k₁, k₂) ln of the joint over the product of the marginal probabilities, with pseudo-counts as if unrelated."""
    unrelated = np.outer(counts.sum(axis=1) + 0.5, counts.sum(axis=0) + 0.5)
    unrelated /= unrelated.sum()
    shrunk = counts + pseudo_count * counts.size * unrelated
    return np.asarray(np.log(shrunk / shrunk.sum()) - np.log(unrelated))


@dataclass(frozen=True)
class _KnottedAssociation(Association):
    """With its knots (k₁,), (k₂,), for use on other records."""

    knots: tuple[FloatArray, FloatArray] = field(default=(np.empty(0), np.empty(0)), repr=False)


def _for_columns(association: Association, columns: tuple[CodedColumn, CodedColumn]) -> Association:
    """The association for the same columns of other records."""
    assert isinstance(association, _KnottedAssociation)
    (one, part_1), (two, part_2) = (_cells_and_parts(c, at) for c, at in zip(columns, association.knots, strict=True))
    return replace(association, cells=(one, two), parts=(part_1, part_2))

"""What columns of one source say of its records' having partners, learned along with the identification.

The columns of a source are taken jointly: ln r of METHOD 11.2 is what they add to the logit of the share of records
that have a partner, fitted by penalised likelihood with every record's probability of having one,

    logit P(partner | place, c) = logit of the share at the place + Σ f(c of one column) + Σ g(cells of two columns),

so that columns that say the same are not counted twice, and none weighs more than the pairs support: curves bend and
tables differ from nothing only as far as the likelihood asks for it. No record is its own witness: what is applied to
the records of some cells of the sky was learned in the others (cross-fitting). A column that does not better the
likelihood of records that it was not learned from is dropped, and said.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.estimate.sample import Setting
from sameas.evidence.columns import Association, CodedColumn, Column, Columns, Related
from sameas.evidence.detection import Hats, logit, roughness
from sameas.gate import Pairs
from sameas.records import Records
from sameas.representation import in_short

Both = tuple[FloatArray, FloatArray]


@dataclass(frozen=True)
class ColumnsTuning:
    """How columns are learned; tuned on simulated counterparts of X-ray sources (``simulate.counterparts``).

    Attributes
    ----------
    folds : parts that the cells of the sky are dealt into; each is judged by what was learned on the others.
    per_cell : mean number of records of the poorer source in a cell that is dealt, at least.
    per_knot, most_knots : expected partners to a knot of a curve, and most knots, besides those of all records.
    knots_of_all : knots at quantiles of all records.
    extreme : share of the partners beyond the outermost of their knots.
    bend, far : scale of a curve's second difference from knot to knot, and standard deviation of its value. freedom :
        of Student's t, which the second differences are drawn from: a curve may break at a knot, as where a catalogue
        ends.
    apart : of what a word, or the absence of a value, adds. together : of what cells of two columns add besides.
    most_words : categories of a column that are told apart, the most frequent ones.
    cells : of a column beside another. per_two : expected partners to each two cells; with fewer they are not asked.
    alone : records without a partner that stand for all of them. likely : a record counts as one that may have a
        partner from this probability on; enough : so many of these stand for all.
    steps, first_steps, longest, done : Newton steps of a later and of the first fit, the longest, the one that ends.
    farthest : ln r lies between −farthest and farthest.
    telling : ln of the likelihood, of records not learned from, that a column must better.
    fewest : expected partners from which anything is learned.
    per_two_related : pairs to each two cells of related columns. pseudo_count : pairs that a cell of them begins with,
        as if unrelated.
    """

    folds: int = 4
    per_cell: float = 5.0
    per_knot: float = 40.0
    most_knots: int = 16
    knots_of_all: int = 6
    extreme: float = 0.003
    bend: float = 0.7
    freedom: float = 2.0
    far: float = 6.0
    apart: float = 2.0
    together: float = 0.5
    most_words: int = 24
    cells: int = 4
    per_two: float = 20.0
    alone: int = 6_000
    likely: float = 1e-3
    enough: int = 6_000
    steps: int = 4
    first_steps: int = 12
    longest: float = 2.0
    done: float = 0.02
    farthest: float = 12.0
    telling: float = 3.0
    fewest: float = 30.0
    per_two_related: float = 6.0
    most_related: int = 16
    pseudo_count: float = 2.0


DEFAULT_COLUMNS = ColumnsTuning()


@in_short
@dataclass(frozen=True)
class ColumnFinding:
    """What one column says: ``gain`` of ln of the likelihood of records it was not learned from.

    source : 1 or 2; 0 of two related columns, the second of which is ``other``. tells : whether it is used. span : ln r
    by it alone, between which all but 1 % of the records lie on either side.
    """

    source: int
    name: str
    gain: float
    tells: bool
    span: tuple[float, float] = (0.0, 0.0)
    other: str = ""


@in_short
@dataclass(frozen=True)
class ColumnEvidence:
    """The columns of two sources, and what has been learned of them. Make it with :meth:`of`.

    sides : of either source. relations : of both. folds : (n₁,), (n₂,) of the records; None before they are dealt.
    fits : of either source, None where nothing was learned. log_ratio : (n₁,), (n₂,) ln r of all learned columns; None
    as long as nothing was. associations : of related columns. findings : of every column.
    """

    sides: tuple[tuple[CodedColumn, ...], tuple[CodedColumn, ...]] = field(repr=False)
    relations: tuple[tuple[CodedColumn, CodedColumn], ...] = field(repr=False, default=())
    fits: tuple[_Fit | None, _Fit | None] = field(repr=False, default=(None, None))
    associations: tuple[Association, ...] = field(repr=False, default=())
    folds: tuple[IntArray, IntArray] | None = field(repr=False, default=None)
    log_ratio: Both | None = field(repr=False, default=None)
    findings: tuple[ColumnFinding, ...] = ()
    tuning: ColumnsTuning = DEFAULT_COLUMNS

    @classmethod
    def of(
        cls,
        first: Records,
        second: Records,
        evidence: Sequence[Column | Related],
        tuning: ColumnsTuning = DEFAULT_COLUMNS,
    ) -> ColumnEvidence | None:
        """Nothing learned yet; None without columns. Related columns count as columns of their sources, too."""
        sides: tuple[list[CodedColumn], list[CodedColumn]] = ([], [])
        relations = []
        for one in evidence:
            columns = one.columns if isinstance(one, Related) else (one,)
            coded = [column.of((first, second)[column.source - 1]) for column in columns]
            for column, made in zip(columns, coded, strict=True):
                mine = sides[column.source - 1]
                if not any(_same(made, other) for other in mine):
                    mine.append(made)
            if isinstance(one, Related):
                relations.append((coded[0], coded[1]))
        if not any(sides):
            return None
        return cls((tuple(sides[0]), tuple(sides[1])), tuple(relations), tuning=tuning)

    def part(self, rows_1: IntArray, rows_2: IntArray) -> ColumnEvidence:
        """The columns of some of the records only, as long as nothing was learned."""
        rows = rows_1, rows_2
        one, two = (tuple(c.take(at) for c in side) for side, at in zip(self.sides, rows, strict=True))
        relations = tuple((a.take(rows_1), b.take(rows_2)) for a, b in self.relations)
        return replace(self, sides=(one, two), relations=relations, associations=(), folds=None)

    def in_folds(self, setting: Setting) -> ColumnEvidence:
        """With the records of cells of the sky dealt into folds."""
        if self.folds is not None:
            return self
        most = min(len(setting.pairs.first), len(setting.pairs.second)) / self.tuning.per_cell
        level = next((level for level in setting.levels[::-1] if len(level.volume) <= most), setting.levels[0])
        one, two = (cell.astype(np.int64) % self.tuning.folds for cell in (level.of_first, level.of_second))
        return replace(self, folds=(one, two))

    def for_setting(self, setting: Setting, columns: ColumnEvidence) -> ColumnEvidence:
        """The same where other records take part, whose ``columns`` are given."""
        folds = columns.in_folds(setting).folds
        assert folds is not None
        return self.over(columns, folds)

    def over(self, columns: ColumnEvidence, folds: tuple[IntArray, IntArray]) -> ColumnEvidence:
        """What was learned, for other records of the same sources, whose columns and folds (n₁,), (n₂,) are given."""
        one, two = (
            tuple(column.coded_as(known) for column, known in zip(given, mine, strict=True))
            for given, mine in zip(columns.sides, self.sides, strict=True)
        )
        coded = {(source, c.name): c for source, side in ((1, one), (2, two)) for c in side}
        pairs = [(coded[1, a.name], coded[2, b.name]) for a, b in self.relations]
        related = tuple(
            replace(_placed(association, pair), folds=folds[0])
            for association, pair in zip(self.associations, pairs, strict=False)
        )
        return replace(
            columns, sides=(one, two), relations=tuple(pairs), fits=self.fits, findings=self.findings, folds=folds,
            associations=related,
        )._applied()  # fmt: skip

    def without_records(self) -> ColumnEvidence:
        """What was learned alone, for :meth:`over`."""
        none = np.empty(0, np.int64)
        associations = tuple(
            replace(one, cells=(none, none), parts=(none.astype(np.float64),) * 2, folds=none)
            for one in self.associations
        )
        return replace(self.part(none, none), associations=associations, log_ratio=None)

    @property
    def given_only(self) -> ColumnEvidence | None:
        """The priors that were given, without what is learned; None where none was."""
        one, two = (tuple(c for c in side if c.log_odds is not None) for side in self.sides)
        return replace(self, sides=(one, two), relations=(), associations=()) if one or two else None

    def rule(self) -> Columns | None:
        """As evidence; None as long as nothing was learned and nothing given."""
        sizes = self._sizes
        given = None
        if any(c.log_odds is not None for side in self.sides for c in side):
            one, two = (
                np.sum([c.log_odds for c in side if c.log_odds is not None] or [np.zeros(n)], axis=0)
                for side, n in zip(self.sides, sizes, strict=True)
            )
            given = one, two
        if given is None and self.log_ratio is None and not self.associations:
            return None
        return Columns(self.log_ratio, given, self.associations)

    def _applied(self) -> ColumnEvidence:
        """With what the fits say of the records."""
        if self.folds is None or not any(fit is not None for fit in self.fits):
            return replace(self, log_ratio=None)
        one, two = (
            np.zeros(n) if fit is None else fit.log_ratio(_learnable(side), fold)
            for fit, side, fold, n in zip(self.fits, self.sides, self.folds, self._sizes, strict=True)
        )
        return replace(self, log_ratio=(one, two))

    @property
    def _sizes(self) -> tuple[int, int]:
        assert self.folds is not None
        return len(self.folds[0]), len(self.folds[1])

    def learned(
        self, pairs: Pairs, p_counted: FloatArray, partner: Both, offset: Both, covered: tuple[BoolArray, BoolArray], *,
        last: bool = False,
    ) -> ColumnEvidence:  # fmt: skip
        """After a round: probabilities of pairs (m,) and of having a partner (n₁,), (n₂,), the logit of the shares that
        places and magnitudes let expect, and whether a record tells of it.

        The first time and the last columns that tell nothing are dropped.
        """
        assert self.folds is not None
        fits: list[_Fit | None] = []
        findings: list[ColumnFinding] = []
        for source, (side, p, at, seen, fold, before) in enumerate(
            zip(self.sides, partner, offset, covered, self.folds, self.fits, strict=True), start=1
        ):
            columns = _learnable(side)
            regression = _ShareRegression.of(p, at, seen, fold, before, columns, self.tuning) if columns else None
            if regression is None:
                fits.append(None)
                continue
            fit, mine = (
                regression.informative(source) if last or before is None else (regression.fit(regression.bases), [])
            )
            fits.append(fit)
            findings += mine
        associations = []
        for a, b in self.relations:
            association, words = _associated(a, b, pairs, p_counted, self.folds[0], self.tuning)
            findings += [words] if last else []
            if association is not None and (words.tells or not last):
                associations.append(association)
        relations = self.relations
        if last:
            kept = [words.tells for words in findings if words.other]
            relations = tuple(pair for pair, tells in zip(self.relations, kept, strict=True) if tells)
        return replace(
            self,
            fits=(fits[0], fits[1]),
            associations=tuple(associations),
            relations=relations,
            findings=tuple(findings),
        )._applied()


def _same(one: CodedColumn, other: CodedColumn) -> bool:
    return one.name == other.name and np.array_equal(one.values, other.values, equal_nan=True)


def _learnable(side: Sequence[CodedColumn]) -> tuple[CodedColumn, ...]:
    return tuple(column for column in side if column.log_odds is None)


# ---- a source's columns, jointly ----


@in_short
@dataclass(frozen=True)
class _Basis:
    """The functions of one column: a curve between knots, or a value for each of some words; and one for no value.

    knots : (k,), or the codes of words. edges : between its coarse cells beside another column.
    """

    knots: FloatArray
    words: bool
    edges: FloatArray

    @classmethod
    def of(cls, column: CodedColumn, weight: FloatArray, partners: float, tuning: ColumnsTuning) -> _Basis:
        """For a column, at records whose partners count with these weights (n,)."""
        known = np.isfinite(column.values)
        if column.words is not None:
            codes, count = np.unique(column.values[known], return_counts=True)
            codes = np.sort(codes[np.argsort(-count, kind="stable")[: tuning.most_words]])
            return cls(codes, True, codes)
        x, w = column.values[known], weight[known]
        if not len(x):
            return cls(np.zeros(1), False, np.empty(0))
        number = int(np.clip(partners / tuning.per_knot, 2, tuning.most_knots))
        levels = np.linspace(tuning.extreme, 1.0 - tuning.extreme, number)
        of_partners = _quantiles(x, w, levels) if w.sum() > 0.0 else np.empty(0)
        of_all = np.quantile(x, np.linspace(0.002, 0.998, tuning.knots_of_all))
        knots = np.unique(np.concatenate([of_partners, of_all]))
        apart = 1e-3 * max(float(knots[-1] - knots[0]), 1e-12)
        knots = knots[np.append(True, np.diff(knots) > apart)]
        inner = np.linspace(0.0, 1.0, tuning.cells + 1)[1:-1]
        edges = np.unique(_quantiles(x, w, inner)) if w.sum() > 0.0 else np.empty(0)
        return cls(knots, False, edges)

    @property
    def size(self) -> int:
        """Number of functions."""
        return len(self.knots) + 1

    def penalty(self, tuning: ColumnsTuning, values: FloatArray) -> FloatArray:
        """(size, size) about coefficients (size,): a break that stands is drawn to a straight line the less."""
        out, k = np.eye(self.size) / tuning.apart**2, len(self.knots)
        if not self.words:
            bends = np.diff(values[:k], n=2) / tuning.bend
            weight = (tuning.freedom + 1.0) / (tuning.freedom + bends**2)
            out[:k, :k] = roughness(k, tuning.bend, weight) + np.eye(k) / tuning.far**2
        return out

    def design(self, values: FloatArray) -> FloatArray:
        """(n, size) the functions at values (n,)."""
        out, rows, k = np.zeros((len(values), self.size)), np.arange(len(values)), len(self.knots)
        gone = ~np.isfinite(values)
        if self.words:
            at, known = self._code(values)
            out[rows[known], at[known]] = 1.0
        else:
            hats = Hats.at(self.knots, np.where(gone, self.knots[0], values))
            out[rows, hats.left] = 1.0 - hats.part
            out[rows, np.minimum(hats.left + 1, k - 1)] += hats.part
            out[gone] = 0.0
        out[gone, k] = 1.0
        return out

    def values(self, coefficients: FloatArray, fold: IntArray, x: FloatArray) -> FloatArray:
        """(n,) the sum of the functions at values x (n,), with the coefficients (folds, size) of these folds (n,)."""
        k, gone = len(self.knots), ~np.isfinite(x)
        if self.words:
            at, known = self._code(x)
            return np.where(gone, coefficients[fold, k], np.where(known, coefficients[fold, at], 0.0))
        hats = Hats.at(self.knots, np.where(gone, self.knots[0], x))
        right = np.minimum(hats.left + 1, k - 1)
        curve = (1.0 - hats.part) * coefficients[fold, hats.left] + hats.part * coefficients[fold, right]
        return np.where(gone, coefficients[fold, k], curve)

    def _code(self, values: FloatArray) -> tuple[IntArray, BoolArray]:
        at = np.clip(np.searchsorted(self.knots, np.where(np.isfinite(values), values, -1.0)), 0, len(self.knots) - 1)
        return at, self.knots[at] == values

    @property
    def cells(self) -> int:
        """Number of coarse cells, the last for no value and for words that are not told apart."""
        return len(self.edges) + (1 if self.words else 2)

    def cell(self, values: FloatArray) -> IntArray:
        """(n,) coarse cells."""
        if self.words:
            at, known = self._code(values)
            return np.where(known, at, len(self.knots))
        return np.where(np.isfinite(values), np.searchsorted(self.edges, values), len(self.edges) + 1)


def _quantiles(x: FloatArray, weight: FloatArray, levels: FloatArray) -> FloatArray:
    order = np.argsort(x, kind="stable")
    cumulated = np.cumsum(weight[order])
    return np.asarray(x[order][np.minimum(np.searchsorted(cumulated, levels * cumulated[-1]), len(x) - 1)])


@in_short
@dataclass(frozen=True)
class _Bases:
    """The functions of all columns that are used, and of each two of them where there are pairs enough.

    used : (c,) whether a column is.
    """

    single: tuple[_Basis, ...]
    used: tuple[bool, ...]
    two: tuple[tuple[int, int], ...]

    @classmethod
    def of(cls, columns: Sequence[CodedColumn], weight: FloatArray, partners: float, tuning: ColumnsTuning) -> _Bases:
        single = tuple(_Basis.of(column, weight, partners, tuning) for column in columns)
        two = [
            (a, b)
            for a, b in combinations(range(len(columns)), 2)
            if single[a].cells * single[b].cells * tuning.per_two <= partners
        ]
        return cls(single, (True,) * len(columns), tuple(two))

    def without(self, k: int) -> _Bases:
        """The same without column k."""
        return replace(
            self, used=tuple(used and n != k for n, used in enumerate(self.used)),
            two=tuple(pair for pair in self.two if k not in pair),
        )  # fmt: skip

    def apart(self, pair: tuple[int, int]) -> _Bases:
        """The same without the cells of these two columns."""
        return replace(self, two=tuple(two for two in self.two if two != pair))

    def cells(self, a: int, b: int) -> int:
        """Number of cells of two columns."""
        return self.single[a].cells * self.single[b].cells

    def cell(self, a: int, b: int, columns: Sequence[CodedColumn]) -> IntArray:
        """(n,) the cells of two columns."""
        return self.single[a].cell(columns[a].values) * self.single[b].cells + self.single[b].cell(columns[b].values)

    def design(self, columns: Sequence[CodedColumn]) -> FloatArray:
        """(n, P) all functions at the values of the columns."""
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

    def penalty(self, tuning: ColumnsTuning, values: FloatArray) -> FloatArray:
        """(P, P) about coefficients (P,)."""
        parts: list[FloatArray] = []
        for basis, used in zip(self.single, self.used, strict=True):
            if used:
                begin = sum(map(len, parts))
                parts.append(basis.penalty(tuning, values[begin : begin + basis.size]))
        parts += [np.eye(self.cells(a, b)) / tuning.together**2 for a, b in self.two]
        out, at = np.zeros((sum(map(len, parts)),) * 2), 0
        for part in parts:
            out[at : at + len(part), at : at + len(part)] = part
            at += len(part)
        return out


@in_short
@dataclass(frozen=True)
class _Fit:
    """Coefficients (folds, P) of the functions, each learned without one of the folds; ``whole`` (P,) from all."""

    bases: _Bases
    coefficients: FloatArray
    whole: FloatArray
    farthest: float

    def log_ratio(self, columns: Sequence[CodedColumn], fold: IntArray) -> FloatArray:
        """(n,) ln r of records of these folds."""
        out, begin, bases = np.zeros(len(fold)), 0, self.bases
        for basis, column, used in zip(bases.single, columns, bases.used, strict=True):
            if used:
                out += basis.values(self.coefficients[:, begin : begin + basis.size], fold, column.values)
                begin += basis.size
        for a, b in bases.two:
            out += self.coefficients[fold, begin + bases.cell(a, b, columns)]
            begin += bases.cells(a, b)
        return np.clip(out, -self.farthest, self.farthest)


@dataclass(frozen=True)
class _ShareRegression:
    """Some records of a source, that stand for all.

    columns : of them. p, offset, fold : (n,) probability of a partner, the logit expected without columns, the fold.
    weight : (n,) for how many records each stands. before : what was known, on which steps go on.
    """

    columns: tuple[CodedColumn, ...]
    p: FloatArray
    offset: FloatArray
    fold: IntArray
    weight: FloatArray
    bases: _Bases
    before: _Fit | None
    tuning: ColumnsTuning

    @classmethod
    def of(
        cls, partner: FloatArray, offset: FloatArray, seen: BoolArray, fold: IntArray, before: _Fit | None,
        columns: Sequence[CodedColumn], tuning: ColumnsTuning,
    ) -> _ShareRegression | None:  # fmt: skip
        """None where partners are too few."""
        likely = np.flatnonzero(seen & (partner >= tuning.likely))
        alone = np.flatnonzero(seen & (partner < tuning.likely))
        partners = float(partner[likely].sum())
        if partners < tuning.fewest:
            return None
        parts = []
        for rows, enough in ((likely, tuning.enough), (alone, tuning.alone)):
            every = max(1, -(-len(rows) // enough))
            kept = rows[::every]
            parts.append((kept, np.full(len(kept), len(rows) / max(len(kept), 1))))
        rows, weight = (np.concatenate(both) for both in zip(*parts, strict=True))
        some = tuple(column.take(rows) for column in columns)
        p = partner[rows]
        # A rebuilt basis would begin again each round.
        bases = _Bases.of(some, p * weight, partners, tuning) if before is None else before.bases
        return cls(some, p, offset[rows], fold[rows], weight, bases, before, tuning)

    def fit(self, bases: _Bases) -> _Fit:
        """Of greatest penalised likelihood, and without each of the folds: one Newton step on from that of all."""
        design = bases.design(self.columns)
        known = self.before is not None and self.before.bases is bases
        values = self.before.whole.copy() if known and self.before else np.zeros(design.shape[1])
        folds = [np.flatnonzero(self.fold == fold) for fold in range(self.tuning.folds)]
        for _ in range(self.tuning.steps if known else self.tuning.first_steps):
            penalty = bases.penalty(self.tuning, values)
            slope, curvature = self._derivatives(design, values, slice(None))
            if not _rises(curvature + penalty):
                # Not concave there: as if partners were sure, an EM step.
                slope, curvature = self._derivatives(design, values, slice(None), sure=True)
            step = np.linalg.solve(curvature + penalty, slope - penalty @ values)
            step *= min(1.0, self.tuning.longest / max(float(np.abs(step).max(initial=0.0)), 1e-12))
            values = values + step
            if np.abs(step).max(initial=0.0) < self.tuning.done:
                break
        parts, penalty = [self._derivatives(design[k], values, k) for k in folds], bases.penalty(self.tuning, values)
        slope, curvature = (np.sum(part, axis=0) for part in zip(*parts, strict=True))
        if not all(_rises(curvature - own + penalty) for _, own in parts):
            parts = [self._derivatives(design[k], values, k, sure=True) for k in folds]
            slope, curvature = (np.sum(part, axis=0) for part in zip(*parts, strict=True))
        without = [
            values + np.linalg.solve(curvature - own + penalty, slope - mine - penalty @ values) for mine, own in parts
        ]
        return _Fit(bases, np.array(without), values, self.tuning.farthest)

    def _derivatives(
        self, design: FloatArray, values: FloatArray, rows: IntArray | slice, *, sure: bool = False
    ) -> tuple[FloatArray, FloatArray]:
        """Of ln of the likelihood of some records, Σ ln [q r + 1 − q] − ln [π r + 1 − π] (see ``gain``): its slope
        (P,) and minus its curvature (P, P), that of ``sure`` partners where this is asked for."""
        log_ratio, offset, weight = design @ values, self.offset[rows], self.weight[rows]
        share = _probability(offset + log_ratio)
        p = np.where(self.p[rows] > 0.0, _probability(self.others[rows] + log_ratio), 0.0)
        bend = share * (1.0 - share) - (0.0 if sure else p * (1.0 - p))
        return design.T @ (weight * (p - share)), (design * (weight * bend)[:, None]).T @ design

    @cached_property
    def others(self) -> FloatArray:
        """(n,) logit of q, the probability of a partner by all but the columns."""
        counted = 0.0 if self.before is None else self.before.log_ratio(self.columns, self.fold)
        return np.asarray(logit(self.p) - counted)

    def informative(self, source: int) -> tuple[_Fit | None, list[ColumnFinding]]:
        """The fit with the columns that tell something, and what is said of all."""
        weight, findings = self.p * self.weight, []
        bases = _Bases.of(self.columns, weight, float(weight.sum()), self.tuning)
        whole = self.fit(bases)
        reached = self.gain(whole)
        for pair in bases.two:
            fewer = bases.apart(pair)
            rest = self.fit(fewer)
            if reached - (without := self.gain(rest)) <= self.tuning.telling:
                bases, whole, reached = fewer, rest, without
        for k, column in enumerate(self.columns):
            fewer = bases.without(k)
            rest = self.fit(fewer)
            gain = reached - (without := self.gain(rest))
            if gain <= self.tuning.telling:
                bases, whole, reached = fewer, rest, without
            findings.append(ColumnFinding(source, column.name, gain, gain > self.tuning.telling, self._span(column)))
        return whole, findings

    def _span(self, column: CodedColumn) -> tuple[float, float]:
        """ln r by this column alone, its least and greatest, but for 1 % of the records."""
        bases = _Bases.of([column], self.p * self.weight, float((self.p * self.weight).sum()), self.tuning)
        alone = replace(self, columns=(column,), bases=bases, before=None)
        low, high = np.quantile(alone.fit(bases).log_ratio([column], self.fold), (0.01, 0.99))
        return float(low), float(high)

    def gain(self, fit: _Fit) -> float:
        """By how much ln of the likelihood of the columns' values is better than if they told nothing.

        Each record by what others taught: ln [q r + 1 − q] − ln [π r + 1 − π], where q is the probability of a partner
        by all but the columns, and π that by the place.
        """
        if fit.coefficients.shape[1] == 0:
            return 0.0
        r = np.expm1(fit.log_ratio(self.columns, self.fold))
        q = np.where(self.p < self.tuning.likely * 1e-3, 0.0, _probability(self.others))
        return float((self.weight * (np.log1p(q * r) - np.log1p(_probability(self.offset) * r))).sum())


def _probability(logits: FloatArray) -> FloatArray:
    return np.asarray(1.0 / (1.0 + np.exp(-np.clip(logits, -40.0, 40.0))))


def _rises(curvature: FloatArray) -> bool:
    """Whether a symmetric matrix is positive definite."""
    try:
        np.linalg.cholesky(curvature)
    except np.linalg.LinAlgError:
        return False
    return True


# ---- related columns ----


def _grid(column: CodedColumn, weight: FloatArray, rows: NDArray[np.integer], number: int) -> FloatArray:
    """(k,) knots of a column of numbers at quantiles of the pairs, or its codes."""
    values, w = column.values[rows], weight
    known = np.isfinite(values)
    if column.words is not None:
        return np.arange(len(column.words), dtype=np.float64)
    if not known.any() or not w[known].sum() > 0.0:
        return np.zeros(1)
    return np.unique(_quantiles(values[known], w[known], (np.arange(number) + 0.5) / number))


def _place(column: CodedColumn, knots: FloatArray) -> tuple[IntArray, FloatArray]:
    """(n,) cells of values, −1 where there is none, and the part of each that counts to the next."""
    gone = ~np.isfinite(column.values)
    if column.words is not None:
        gone |= column.values >= len(column.words)  # a word that was not known
        return np.where(gone, -1, np.nan_to_num(column.values)).astype(np.int64), np.zeros(len(gone))
    hats = Hats.at(knots, np.where(gone, knots[0], column.values))
    return np.where(gone, -1, hats.left), np.where(gone, 0.0, hats.part)


def _associated(
    a: CodedColumn, b: CodedColumn, pairs: Pairs, p_counted: FloatArray, folds: IntArray, tuning: ColumnsTuning
) -> tuple[Association | None, ColumnFinding]:
    """How two columns go together in pairs of these probabilities, and what is said of it."""
    known = np.isfinite(a.values[pairs.i]) & np.isfinite(b.values[pairs.j]) & (p_counted > tuning.likely)
    i, j, p = pairs.i[known], pairs.j[known], p_counted[known]
    number = int(min(math.sqrt(float(p.sum()) / tuning.per_two_related), tuning.most_related))
    nothing = ColumnFinding(0, a.name, 0.0, False, other=b.name)
    if number < 2:
        return None, nothing
    knots = _grid(a, p, i, number), _grid(b, p, j, number)
    sizes = tuple(map(len, knots))
    cells, parts = zip(*(_place(column, at) for column, at in zip((a, b), knots, strict=True)), strict=True)
    counts = np.zeros((tuning.folds, *sizes))
    for left, weight_1 in ((cells[0][i], 1.0 - parts[0][i]), (np.minimum(cells[0][i] + 1, sizes[0] - 1), parts[0][i])):
        for right, weight_2 in (
            (cells[1][j], 1.0 - parts[1][j]),
            (np.minimum(cells[1][j] + 1, sizes[1] - 1), parts[1][j]),
        ):
            np.add.at(counts, (folds[i], left, right), p * weight_1 * weight_2)
    table = np.array([_log_association(counts.sum(axis=0) - own, tuning.pseudo_count) for own in counts])
    association = _KnottedAssociation(cells, parts, folds, table, knots)
    values = association(pairs)[known]
    # As for single columns: by what others taught, and by the odds without the relation.
    gain = float((p * values).sum())
    return association, replace(nothing, gain=gain, tells=gain > tuning.telling)


def _log_association(counts: FloatArray, pseudo_count: float) -> FloatArray:
    apart = np.outer(counts.sum(axis=1) + 0.5, counts.sum(axis=0) + 0.5)
    apart /= apart.sum()
    shrunk = counts + pseudo_count * counts.size * apart
    return np.asarray(np.log(shrunk / shrunk.sum()) - np.log(apart))


@in_short
@dataclass(frozen=True)
class _KnottedAssociation(Association):
    """With the knots (k₁,), (k₂,) that it stands on, for other records."""

    knots: tuple[FloatArray, FloatArray] = field(default=(np.empty(0), np.empty(0)), repr=False)


def _placed(association: Association, columns: tuple[CodedColumn, CodedColumn]) -> Association:
    assert isinstance(association, _KnottedAssociation)
    (one, part_1), (two, part_2) = (_place(c, at) for c, at in zip(columns, association.knots, strict=True))
    return replace(association, cells=(one, two), parts=(part_1, part_2))

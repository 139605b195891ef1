"""Sample of two large sources, from which estimates are made.

Cells of the sky (or of any space) are drawn until they hold enough records of both sources. The sample has all
candidates of their records, and the candidates that compete with these, but only the records of the cells are counted.
So borders of cells cause no loss. The sample depends on the positions of records, not on their rows.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import BoolArray, FloatArray, IntArray, taken
from sameas.estimate.cells import GridLevel, finest
from sameas.estimate.coverage import SHARED_PSEUDO_COUNT, Coverage
from sameas.gate import Pairs


@dataclass(frozen=True)
class Sampling:
    """How a sample is drawn.

    enough : records of each source in a sample. share, most : of the poorer source's records, if these are more, up to
        a number that fits into memory: small shares, such as that of pairs with unrelated magnitudes, decide about many
        records of a large source.
    worth_sampling : a sample is drawn if there are more than this many times as many records; else all are used.
    cell : least mean number of records of both sources in a cell.
    seed : of the generator that draws the cells.
    """

    enough: int = 30_000
    share: float = 0.04
    most: int = 300_000
    worth_sampling: int = 4
    cell: int = 1_000
    seed: int = 20_041

    def size(self, n_poorer: int) -> int:
        """Records of each source in a sample, from the number of those of the poorer source."""
        return max(self.enough, min(round(self.share * n_poorer), self.most))


@dataclass(frozen=True)
class Setting:
    """The candidates and records of an estimation, which stay the same in all EM iterations.

    pairs : the candidates.
    rows : (n₁,), (n₂,) indices of their records among all records.
    levels : their cells, coarse to fine.
    covered : (n₁,), (n₂,) whether the other source observes there.
    counted : (n₁,), (n₂,) whether a record counts; others only compete.
    densities : (n₁,), (n₂,) local densities of the source's other covered records.
    shared_pseudo_count : of local shares, as in ``CoverageTuning``.
    """

    pairs: Pairs
    rows: tuple[IntArray, IntArray]
    levels: tuple[GridLevel, ...]
    covered: tuple[BoolArray, BoolArray]
    counted: tuple[BoolArray, BoolArray]
    densities: tuple[FloatArray, FloatArray]
    shared_pseudo_count: float

    @classmethod
    def whole(cls, pairs: Pairs, coverage: Coverage) -> Setting:
        """All candidates and records."""
        n1, n2 = len(pairs.first), len(pairs.second)
        (density_1, _), (_, density_2) = coverage.covered_densities
        rows = np.arange(n1), np.arange(n2)
        return cls(
            pairs, rows, coverage.levels, coverage.covered, coverage.counted, (density_1, density_2),
            SHARED_PSEUDO_COUNT,
        )  # fmt: skip

    @property
    def n_counted(self) -> tuple[int, int]:
        """Number of counted records of each source."""
        one, two = (int(np.count_nonzero(counted)) for counted in self.counted)
        return one, two

    def p_counted(self, p_pair: FloatArray) -> FloatArray:
        """(m,) probabilities of the pairs whose record 1 is counted, 0 for the others."""
        return p_pair if self.counted[0].all() else p_pair * self.counted[0][self.pairs.i]

    def by_chance(self, p_counted: FloatArray) -> float:
        """Mean number of chance candidates of a record, with these probabilities (m,)."""
        candidates = np.count_nonzero(self.counted[0][self.pairs.i])
        return max(int(candidates) - float(p_counted.sum()), 0.0) / min(self.n_counted)

    def sample(self, sampling: Sampling) -> Setting:
        """A sample; itself if it is not large."""
        chosen = self._drawn(sampling)
        if chosen is None:
            return self
        level, cells = chosen
        counted = cells[level.of_first], cells[level.of_second]
        kept, used_1, used_2 = _competing(self.pairs, *counted)
        rows_1, rows_2 = np.flatnonzero(used_1), np.flatnonzero(used_2)
        pairs, (of_1, of_2) = _part(self.pairs, kept, rows_1, rows_2), self.densities
        return Setting(
            pairs, (rows_1, rows_2), tuple(level.part(rows_1, rows_2) for level in self.levels),
            (self.covered[0][rows_1], self.covered[1][rows_2]), (counted[0][rows_1], counted[1][rows_2]),
            (of_1[rows_1], of_2[rows_2]), self.shared_pseudo_count,
        )  # fmt: skip

    def _drawn(self, sampling: Sampling) -> tuple[GridLevel, BoolArray] | None:
        """Sampled cells with enough records of both sources; None if they would hold most of all records."""
        n = len(self.pairs.first), len(self.pairs.second)
        if min(n) <= sampling.worth_sampling * sampling.enough:
            return None
        level = finest(self.levels, sum(n) / sampling.cell)
        counts = level.count(1), level.count(2)
        drawn = level.drawn(counts, sampling.size(min(n)), sampling.seed)
        share = max(count[drawn].sum() / count.sum() for count in counts)
        return (level, drawn) if share * sampling.worth_sampling < 1.0 else None


def _competing(pairs: Pairs, counted_1: BoolArray, counted_2: BoolArray) -> tuple[IntArray, BoolArray, BoolArray]:
    """Indices of the pairs of counted records and of their candidates, and masks of the records of these pairs."""
    touched_1, touched_2 = counted_1.copy(), counted_2.copy()
    one, two = taken(counted_1, pairs.i), taken(counted_2, pairs.j)
    touched_2[np.compress(one, pairs.j)] = True
    touched_1[np.compress(two, pairs.i)] = True
    kept = np.flatnonzero(taken(touched_1, pairs.i) | taken(touched_2, pairs.j))
    touched_1[pairs.i[kept]] = True
    touched_2[pairs.j[kept]] = True
    return kept, touched_1, touched_2


def _part(pairs: Pairs, kept: IntArray, rows_1: IntArray, rows_2: IntArray) -> Pairs:
    """The pairs ``kept``, with the records ``rows_1`` and ``rows_2`` only."""
    i, j = (_renumbered(at[kept], rows) for at, rows in ((pairs.i, rows_1), (pairs.j, rows_2)))
    place_1, place_2 = (_renumbered(place[kept], _places(place[kept])) for place in (pairs.place_1, pairs.place_2))
    return Pairs(
        first=pairs.first.part(rows_1), second=pairs.second.part(rows_2), place_1=place_1, place_2=place_2, i=i, j=j,
        residual=pairs.residual[kept], mahalanobis_sq=pairs.mahalanobis_sq[kept], determinant=pairs.determinant[kept],
        gate=pairs.gate,
    )  # fmt: skip


def _places(place: NDArray[np.int32]) -> IntArray:
    """The places that occur, ascending."""
    occurs = np.zeros(int(place.max(initial=-1)) + 1, np.bool_)
    occurs[place] = True
    return np.flatnonzero(occurs)


def _renumbered(at: NDArray[np.int32], numbers: IntArray) -> NDArray[np.int32]:
    """Indices into the ascending ``numbers``, which must contain all of ``at``."""
    number = np.zeros(int(numbers.max(initial=-1)) + 1, np.int32)
    number[numbers] = np.arange(len(numbers), dtype=np.int32)
    return number[at]

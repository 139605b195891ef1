"""Groups: the connected components of the candidate graph, identified independently of each other (METHOD 2).

The layout does not depend on the row order of the sources: groups in the order in which the gate lists their first
pair, records of a group in the order in which they appear there.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import IntArray, Scalar
from sameas.gate import Pairs
from sameas.kernels import threads
from sameas.kernels.components import GroupLayout
from sameas.ragged import Ragged
from sameas.representation import in_short

PlaceArray = NDArray[np.int32]


@in_short
@dataclass(frozen=True)
class Groups:
    """Candidates laid out group by group; g groups, m pairs.

    order : (m,) pair ``order[e]`` of the gate is the e-th of the layout.
    start : (g+1,) group k holds the layout's pairs start[k]:start[k+1].
    rows_1, start_1 : records of source 1, group by group, and their (g+1,) starts; rows_2, start_2 likewise.
    edges_1 : CSR starts of the layout's pairs by record of ``rows_1``.
    local_1, local_2 : (m,) number of each pair's records within their group.
    """

    order: IntArray
    start: IntArray
    rows_1: NDArray[np.int32]
    start_1: IntArray
    edges_1: IntArray
    rows_2: NDArray[np.int32]
    start_2: IntArray
    local_1: NDArray[np.int32]
    local_2: NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.start) - 1

    @property
    def sizes_1(self) -> IntArray:
        """(g,) number of records of source 1 in each group."""
        return self.start_1[1:] - self.start_1[:-1]

    @property
    def sizes_2(self) -> IntArray:
        """(g,) number of records of source 2 in each group."""
        return self.start_2[1:] - self.start_2[:-1]

    @property
    def pair_counts(self) -> IntArray:
        """(g,) number of candidate pairs in each group."""
        return self.start[1:] - self.start[:-1]

    @cached_property
    def group(self) -> IntArray:
        """(m,) group of each pair of the layout."""
        return Ragged(self.start).row

    @cached_property
    def places(self) -> tuple[IntArray, IntArray]:
        """(m,), (m,) indices into ``rows_1`` and ``rows_2`` of the two records of each pair of the layout."""
        return self.start_1[self.group] + self.local_1, self.start_2[self.group] + self.local_2

    @property
    def layout(self) -> GroupLayout:
        """The layout for compiled loops."""
        return GroupLayout(self.start, self.start_1, self.start_2, self.edges_1, self.local_1, self.local_2)

    def in_given_order(self, values: NDArray[Scalar]) -> NDArray[Scalar]:
        """(m,) values of the layout's pairs, in the order of the gate."""
        out = np.empty_like(values)
        out[self.order] = values
        return out

    def of_pairs(self) -> NDArray[np.int32]:
        """(m,) group of each pair, in the order of the gate."""
        group, counts = np.empty(len(self.order), np.int32), self.pair_counts

        def fill(first: int, last: int) -> None:
            numbers = np.repeat(np.arange(first, last, dtype=np.int32), counts[first:last])
            group[self.order[self.start[first] : self.start[last]]] = numbers

        threads.over(fill, self.bounds_of_threads())
        return group

    def bounds_of_threads(self) -> list[int]:
        """Bounds of one range of groups for each thread, fewer if there are few pairs."""
        return self.bounds(len(threads.even(len(self.order))) - 1)

    def bounds(self, parts: int) -> list[int]:
        """Bounds of ``parts`` ranges of groups with about equal numbers of pairs."""
        return Ragged(self.start).bounds(parts)

    def statistics(self) -> dict[str, int]:
        """Number of groups by size (one pair, up to 4, 16 and 64 records, larger), and size of the largest."""
        size = self.sizes_1 + self.sizes_2
        edges = (("of one pair", size <= 2), ("of 3 to 4 records", (size > 2) & (size <= 4)),
                 ("of 5 to 16", (size > 4) & (size <= 16)), ("of 17 to 64", (size > 16) & (size <= 64)),
                 ("larger", size > 64))  # fmt: skip
        counts = {name: int(np.count_nonzero(mask)) for name, mask in edges}
        return counts | {"records in the largest": int(size.max(initial=0))}


def groups(pairs: Pairs) -> Groups:
    """The connected components of ``pairs``."""
    return laid_out(pairs.place_1, pairs.place_2, pairs.i, pairs.j, len(pairs.first), len(pairs.second))


def laid_out(place_1: PlaceArray, place_2: PlaceArray, i: PlaceArray, j: PlaceArray, n_1: int, n_2: int) -> Groups:
    """The connected components of pairs of records i and j, (m,) each, of n₁ and n₂.

    The places, (m,) each, number the records so that neighbours in the list are neighbours in memory; pairs of a record
    of source 1 must be consecutive.
    """
    from sameas.kernels.components import label_pairs, lay_out

    m = len(i)
    group, number_2 = np.empty(m, np.int32), np.empty(n_2, np.int32)
    start, start_1, start_2 = (np.empty(min(n_1, n_2, m) + 1, np.int64) for _ in range(3))
    scratch = np.empty(n_1 + n_2, np.int32), np.empty(n_1, np.int32)
    count = label_pairs(place_1, place_2, *scratch, number_2, group, start, start_1, start_2)
    del scratch
    for column in (start, start_1, start_2):  # allocated for as many groups as records
        column.resize(count + 1, refcheck=False)
    order, edges_1 = np.empty(m, np.int64), np.empty(start_1[-1] + 1, np.int64)
    local_1, local_2 = np.empty(m, np.int32), np.empty(m, np.int32)
    rows_1, rows_2 = np.empty(start_1[-1], np.int32), np.empty(start_2[-1], np.int32)
    given = (place_1, place_2, i, j, group, number_2, start_1, start_2, start.copy(), start_1.copy())
    lay_out(*given, order, edges_1, local_1, local_2, (rows_1, rows_2))
    return Groups(order, start, rows_1, start_1, edges_1, rows_2, start_2, local_1, local_2)

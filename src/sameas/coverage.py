"""Where two sources look, and how densely their records lie there, from the records alone.

The space is cut into cells of equal size, coarse to fine. A local density is the count of a cell, drawn towards the
density of the coarser cell by pseudo-counts, level after level: coarse where there is little to count, fine where there
is much. A record is *not covered* by the other source where that source is empty although many of its records were
to be expected: seven or more in a cell, or twelve in a disc around a record (``holes.py``), by which borders are drawn
as fine as records lie.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray

from sameas import threads
from sameas.holes import Ground, within_holes
from sameas.levels import Level, levels_of
from sameas.records import FloatArray, Records

PSEUDO_COUNT = 2.0
#: The same for densities: their noise would make the odds of chance pairs too good.
SMOOTH = 20.0
SHARED_PSEUDO_COUNT = 200.0
#: Expected records in an empty cell that make it a hole: e⁻⁷ is the chance of it by accident.
HOLE = 7.0
#: Records to be expected in it at least by those of the asking source that it holds (see ``holes.COMPANY``).
IN_CELL = 3.5
#: Holes are sought again with the densities outside those found, at most so many times in all, and only where a source
#: proves to be so much denser there.
ROUNDS = 2
DENSER = 1.05
#: Holes smaller than all cells are sought where by so many standard deviations more records lie in empty cells than
#: chance puts there: an even field is done with at once.
UNEVEN = 2.0
#: Least part of the region that is believed to be common.
LEAST_VOLUME = 1e-3

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Coverage:
    """Cells of falling size over two sources. Make it with :meth:`Coverage.of`."""

    first: Records
    second: Records
    volume: float
    levels: tuple[Level, ...]

    @classmethod
    def of(cls, first: Records, second: Records) -> Coverage:
        """Cells over the stretch that both sources span together; both must have records."""
        return cls(first, second, *levels_of(first, second))

    def density(self, source: int, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Local density of the records of ``source`` (1 or 2) counted with ``weights``, at the records of both.

        Unit 1 / (residual unit)^d. A record does not count where it stands itself.
        """
        from sameas.kernels.density import refine

        start = (float(weights.sum()) + 0.5) / self.volume
        at_first, at_second = np.full(len(self.first), start), np.full(len(self.second), start)
        at = (at_first, at_second) if source == 1 else (at_second, at_first)
        for level in self.levels:
            count = np.empty(len(level.volume))
            refine(*level.facing(source), weights, level.volume, count, SMOOTH, *at)
        return at_first, at_second

    @cached_property
    def covered_densities(self) -> tuple[tuple[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]:
        """Local densities of the covered records of source 1 and of source 2, each at the records of both."""
        seen_1, seen_2 = (seen.astype(np.float64) for seen in self.covered)
        one, two = threads.each([partial(self.density, 1, seen_1), partial(self.density, 2, seen_2)], len(seen_1))
        return one, two

    @cached_property
    def covered(self) -> tuple[Mask, Mask]:
        """Whether source 2 looks where each record of source 1 lies, (n₁,), and the reverse, (n₂,)."""
        rough = self._by_cells((0.0, 0.0))
        shown = [max(int(np.count_nonzero(seen)), 1) for seen, _, _ in rough]
        if shown != [len(self.first), len(self.second)]:
            # By the other records of its own source too, so that a place poor in objects is not taken for a hole.
            rough = self._by_cells((IN_CELL * shown[0] / shown[1], IN_CELL * shown[1] / shown[0]))
        elif max(excess for _, _, excess in rough) < UNEVEN:
            return rough[0][0], rough[1][0]
        (seen_1, highest_2, _), (seen_2, highest_1, _) = rough
        seen, mean = (seen_1, seen_2), self._mean(seen_1, seen_2)
        for _ in range(ROUNDS):
            seen = self._opened(seen, (highest_1, highest_2), mean)
            before, mean = mean, self._mean(*seen)
            if max(mean[0] / before[0], mean[1] / before[1]) < DENSER:
                break
        return seen

    @cached_property
    def _grounds(self) -> tuple[Ground, Ground]:
        one, two = threads.each([partial(Ground.of, self.first), partial(Ground.of, self.second)], len(self.first))
        return one, two

    def _mean(self, seen_1: Mask, seen_2: Mask) -> tuple[float, float]:
        """Mean densities of both sources where both look, if they look at these records."""
        volume = max(self._volume(seen_1, seen_2), LEAST_VOLUME * self.volume)
        number_1, number_2 = (max(int(np.count_nonzero(seen)), 1) for seen in (seen_1, seen_2))
        return number_1 / volume, number_2 / volume

    def _opened(
        self, seen: tuple[Mask, Mask], highest: tuple[FloatArray, FloatArray], mean: tuple[float, float]
    ) -> tuple[Mask, Mask]:
        """``seen`` without what empty discs say too.

        highest : local densities of source 1 at the records of source 2, and of source 2 at those of source 1.
        mean : of both sources; at least as much is to be expected.
        """
        first, second = self._grounds
        of_first, of_second = (np.maximum(local, least) for local, least in zip(highest, mean, strict=True))
        one, two = threads.each(
            [
                partial(within_holes, first, seen[0], second, of_second, mean[1] / mean[0]),
                partial(within_holes, second, seen[1], first, of_first, mean[0] / mean[1]),
            ],
            len(self.first),
        )
        return ~one, ~two

    def _by_cells(self, least: tuple[float, float]) -> list[tuple[Mask, FloatArray, float]]:
        return threads.each([partial(self._seen, 1, 2, least[0]), partial(self._seen, 2, 1, least[1])], len(self.first))

    def _seen(self, query: int, source: int, least: float) -> tuple[Mask, FloatArray, float]:
        """Whether ``source`` looks at the records of ``query`` as far as cells tell, how dense it is if it does, and by
        how many standard deviations more records than chance puts there lie in empty cells.

        least : of the records of ``query`` in an empty cell that is a hole.
        """
        from sameas.kernels.density import look

        n = len(self.first if query == 1 else self.second)
        density = np.full(n, len(self.first if source == 1 else self.second) / self.volume)
        seen, highest, excess = np.ones(n, np.bool_), np.zeros(n), 0.0
        for level in self.levels:
            own, other = level.facing(source)
            room = np.empty(len(level.volume)), np.empty(len(level.volume))
            more = look(own, other, level.volume, *room, least, PSEUDO_COUNT, HOLE, seen, density, highest)
            excess = max(excess, more)
        return seen, highest, excess

    def common_volume(self) -> float:
        """Volume where both sources look, (residual unit)^d: of every cell the part that its covered records tell.

        Cells are the finest that hold so many records that an empty one is hardly ever an accident.
        """
        return self._volume(*self.covered)

    def _volume(self, seen_1: Mask, seen_2: Mask) -> float:
        from sameas.kernels.density import shared_part

        richer = max(len(self.first), len(self.second))
        fine = next((level for level in self.levels[::-1] if richer >= HOLE * len(level.volume)), self.levels[0])
        count = np.zeros((len(fine.volume), 4))
        return float(shared_part(fine.of_first, seen_1, fine.of_second, seen_2, count) @ fine.volume)


def local_share(
    levels: Sequence[Level], source: int, part: FloatArray, weights: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Local share Σ part / Σ weights of the records of ``source`` (1 or 2), at the records of both.

    Drawn towards that of the coarser cell by many pseudo-counts: a share that is itself being estimated must not
    gather where a few chance pairs happen to lie.
    """
    from sameas.kernels.density import refine_share

    start = (float(part.sum()) + 0.5) / (float(weights.sum()) + 1.0)
    at_first, at_second = np.full(len(levels[0].of_first), start), np.full(len(levels[0].of_second), start)
    at = (at_first, at_second) if source == 1 else (at_second, at_first)
    for level in levels:
        sums = np.empty(len(level.volume)), np.empty(len(level.volume))
        refine_share(*level.facing(source), part, weights, *sums, SHARED_PSEUDO_COUNT, *at)
    return at_first, at_second

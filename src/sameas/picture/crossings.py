"""Crossings: new objects at crossings of directions that no source of positions shows.

Two direction finders that show n emitters have n² crossings, of which n are emitters and the others are ghosts: a new
object begins at a crossing of two only if no other crossing of its directions rivals it. Three directions rarely cross
by chance: those of the most probable hypothesis begin one. Elsewhere the directions stay without a position.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sameas.arrays import ABSENT, BoolArray, FloatArray, IntArray
from sameas.many.objects import Objects
from sameas.many.observations import Region, joint_density, records_of
from sameas.tracks.scene import Instant

#: Directions cross if the object's 1σ is below this share of that of the region.
CROSSING_SHARE = 0.2
#: A new object begins at a crossing of at least this probability, which is at least the share CLEAR_CROSSING of that of
#: all crossings of its directions.
CROSSING_EXISTENCE, CLEAR_CROSSING = 0.3, 0.8


def is_placed(covariance: FloatArray, region: FloatArray) -> BoolArray:
    """(n,) whether directions cross: otherwise the position along them is as uncertain as the region is wide."""
    widest = np.linalg.eigvalsh(region[:2, :2])[-1]
    return np.asarray(np.linalg.eigvalsh(covariance[:, :2, :2])[:, -1] < CROSSING_SHARE**2 * widest)


@dataclass(frozen=True)
class Crossings:
    """Sets of directions that cross: the ``object`` (n,) whose number each gets, the rows ``sets`` (n, S), and the
    probability ``p`` (n,) that they are one object."""

    object: IntArray
    sets: IntArray
    p: FloatArray

    @classmethod
    def among(
        cls, now: Instant, identification: Objects, members: IntArray, is_free: BoolArray, region: Region
    ) -> Crossings:
        """The clear crossings of the directions of free objects at an instant, with rows of all its sources.

        identification : of the known objects, its first source, and the sources with records, in their order.
        members : (n, S) rows of the objects' records. is_free : (n,) whether an object is new and has no position.
        region : of the new objects.
        """
        with_records = [s for s, source in enumerate(now.sources) if len(records_of(source))]
        found = cls._of(identification, members[:, with_records], is_free)
        rows = np.full((len(found.object), members.shape[1]), ABSENT)
        rows[:, with_records] = found.sets
        joint = joint_density(list(now.sources), rows, region)
        return replace(found, sets=rows)._take(is_placed(joint.covariance, now.region.covariance))

    def with_any(self, sets: IntArray) -> Crossings:
        """Those with at least one of the rows ``sets`` (n, S)."""
        return self._take(np.array([((sets == one) & (one >= 0)).any() for one in self.sets], bool))

    def _take(self, which: BoolArray) -> Crossings:
        return Crossings(self.object[which], self.sets[which], self.p[which])

    @classmethod
    def _of(cls, identification: Objects, members: IntArray, is_free: BoolArray) -> Crossings:
        """As :meth:`among`, with the rows of the sources with records only, wherever the directions cross."""
        rows = np.ma.filled(identification.set_rows, ABSENT)
        possible, known, p = rows[:, 1:], rows[:, 0] >= 0, identification.answer.probability
        n_directions = (possible >= 0).sum(axis=1)
        owner = [dict(zip(column[at].tolist(), at.tolist(), strict=True)) for column, at in _free(members, is_free)]
        found: dict[tuple[int, ...], tuple[int, float]] = {}
        of_three = (n_directions > 2) & identification.answer.chosen
        candidate = of_three | ((n_directions > 1) & (p > CROSSING_EXISTENCE))
        for k in np.flatnonzero(candidate & ~known).tolist():
            of = [owner[s].get(row) for s, row in enumerate(possible[k].tolist()) if row >= 0]
            if None not in of and (of_three[k] or cls._is_clear(possible, known, p, k)):
                found[tuple(possible[k].tolist())] = min(one for one in of if one is not None), float(p[k])
        chosen: list[tuple[tuple[int, ...], tuple[int, float]]] = []
        for one, value in sorted(found.items(), key=lambda item: -item[1][1]):
            if all(_present(one).isdisjoint(_present(other)) for other, _ in chosen):
                chosen.append((one, value))
        return cls(
            np.array([value[0] for _, value in chosen], np.int64),
            np.array([one for one, _ in chosen], np.int64).reshape(-1, members.shape[1]),
            np.array([value[1] for _, value in chosen]),
        )

    @staticmethod
    def _is_clear(possible: IntArray, known: BoolArray, p: FloatArray, k: int) -> bool:
        """Whether no other crossing of the directions of a set is nearly as probable."""
        own = possible[k]
        shared = (possible == own) & (own >= 0)
        differs = ((possible >= 0) & (own >= 0) & (possible != own)).any(axis=1)
        rival = shared.any(axis=1) & (differs | known) & ((possible >= 0).sum(axis=1) + known > 1)
        support = (shared.sum(axis=1) > 1) & ~differs & ~known
        total = p[rival].sum() + p[support].sum()
        return bool(p[support].sum() >= CLEAR_CROSSING * total)


def _free(members: IntArray, is_free: BoolArray) -> list[tuple[IntArray, IntArray]]:
    """Per source its column of the members, and the free objects with a record of it."""
    return [(column, np.flatnonzero(is_free & (column >= 0))) for column in members.T]


def _present(rows: tuple[int, ...]) -> set[tuple[int, int]]:
    return {(s, row) for s, row in enumerate(rows) if row >= 0}

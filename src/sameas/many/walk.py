"""Probabilities of sets by a walk over all partitions, where a group has more sets than can be listed or summed.

The sets near a good partition (:mod:`sameas.many.near_sets`) hold most of the probability where few objects compete.
Two objects of twenty sources within an error of each other may exchange the records of any of these: then most of it is
in sets that are not listed, and sums over those that are come out too high. The walk
(:mod:`sameas.kernels.partition_walk`) weighs sets when it meets them. A listed set has the share of the steps at which
it is in the partition. The sets of :data:`SEEN` of these partitions that are not listed are added, each with the share
of these partitions that have it, so that the probabilities of the partners of a record remain complete.

It needs weights that are sums over records: positions in a plane, and linear terms. Rules of pairs, such as identities,
and positions on a sphere or in part leave the group to samples of its listed sets.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from sameas.arrays import ABSENT, BoolArray, FloatArray, IntArray
from sameas.many.pooled import PooledRecords, record_codes
from sameas.many.rules import Terms
from sameas.ragged import Ragged

if TYPE_CHECKING:
    from sameas.kernels.partition_walk import Walked

#: Partitions of the walk whose sets are added.
SEEN = 200
#: Share of the steps of a walk that only looks whether there are other sets than those listed.
TRIAL = 0.05


def can_walk(pooled: PooledRecords, terms: Terms) -> bool:
    """Whether the weights of sets are sums over their records."""
    return pooled.in_plane is not None and all(rule.is_silent for rule in terms.by_pair)


@dataclass(frozen=True)
class Walk:
    """Walks over the partitions of groups of pooled records.

    terms : (n, 8) of all records, about the first one's place. prior : (8,). start, neighbour : of
    :meth:`PooledRecords.neighbours`. by_group : all records, those of a group together, from ``first`` of it on. code :
    (n + 1,) of :func:`record_codes`.
    """

    pooled: PooledRecords
    terms: FloatArray
    prior: FloatArray
    constant: float
    start: IntArray
    neighbour: IntArray
    by_group: IntArray
    first: IntArray
    code: IntArray

    @classmethod
    def of(cls, pooled: PooledRecords, terms: Terms, groups: BoolArray) -> Walk:
        """For some of the groups (g,), where :func:`can_walk`."""
        assert pooled.in_plane is not None
        place, precision, log_peak, centre, prior = pooled.in_plane
        gain, origin = log_peak + terms.gain(pooled), place[:1]
        of_region = _sums(centre[None] - origin, prior[None], np.zeros(1), 0.0)[0]
        constant = float(sum(part.constant for part in terms.linear.values()))
        by_group = np.argsort(pooled.group, kind="stable")
        return cls(
            pooled, _sums(place - origin, precision, gain, 1.0), of_region, constant, *pooled.neighbours(groups),
            by_group, Ragged.of_sizes(pooled.sizes).start, record_codes(len(pooled)).astype(np.int64),
        )  # fmt: skip

    def group(
        self, g: int, listed: IntArray, chosen: BoolArray, *, is_summed: bool
    ) -> tuple[FloatArray, IntArray, FloatArray] | None:
        """(k,) probabilities of the listed sets (k, S) of a group, from the partition of its ``chosen`` ones, and other
        sets (m, S) with theirs (m,).

        is_summed : the listed sets were summed; None if a short walk meets no others.
        """
        from sameas.kernels.partition_walk import MIN_RECORDS, STEPS, walk

        records = self.by_group[self.first[g] : self.first[g + 1]]
        of_records, begin = self._walked(records), _local(records, listed[chosen])
        keys = np.bitwise_xor.reduce(self.code[listed], axis=1)
        share, seen = np.empty(len(listed)), np.empty((SEEN, len(records)), np.int64)
        steps = STEPS * max(len(records), MIN_RECORDS)
        for part in (TRIAL, 1.0) if is_summed else (1.0,):
            walk(of_records, begin, keys, int(part * steps), share, seen)
            others, of_others = self._unlisted(records, of_records.source, seen, keys)
            if is_summed and part < 1.0 and not len(others):
                return None
        return share, others, of_others

    def _walked(self, records: IntArray) -> Walked:
        """The records of a group as the kernel wants them."""
        from sameas.kernels.partition_walk import Walked

        first = self.start[records]
        width = self.start[records + 1] - first
        start = Ragged.of_sizes(width).start
        near = self.neighbour[np.repeat(first - start[:-1], width) + np.arange(start[-1])]
        return Walked(
            self.terms[records], self.prior, self.constant, self.pooled.source[records], start,
            np.searchsorted(records, near), self.code[records],
        )  # fmt: skip

    def _unlisted(
        self, records: IntArray, source: IntArray, seen: IntArray, keys: IntArray
    ) -> tuple[IntArray, FloatArray]:
        """The sets (m, S) of the partitions seen that are not listed, and the share of these that have each."""
        m, n = seen.shape
        members = np.full((m * n, len(self.pooled.sources)), ABSENT)
        members[(seen + n * np.arange(m)[:, None]).ravel(), np.tile(source, m)] = np.tile(records, m)
        key = np.bitwise_xor.reduce(self.code[members], axis=1)
        new = np.flatnonzero((members != ABSENT).any(axis=1) & ~np.isin(key, keys))
        _, first, count = np.unique(key[new], return_index=True, return_counts=True)
        return members[new[first]], count / m


def _local(records: IntArray, sets: IntArray) -> IntArray:
    """Sets (k, S) of ascending ``records`` (n,) as numbers among these; ABSENT stays."""
    return np.where(sets == ABSENT, ABSENT, np.searchsorted(records, sets))


def _sums(place: FloatArray, precision: FloatArray, log_peak: FloatArray, count: float) -> FloatArray:
    """(n, 8) what each record adds to the sums of its set (:data:`sameas.kernels.partition_walk.SUMS`)."""
    x, y = place.T
    xx, xy, yy = precision[:, 0, 0], precision[:, 0, 1], precision[:, 1, 1]
    east, north = xx * x + xy * y, xy * x + yy * y
    square = x * east + y * north
    return np.column_stack([xx, xy, yy, east, north, square, log_peak, np.full(len(x), count)])

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

import numpy as np

from sameas.arrays import ABSENT, BoolArray, FloatArray, IntArray
from sameas.many.near_sets import SetWeights
from sameas.many.pooled import PooledRecords
from sameas.many.rules import Terms
from sameas.ragged import Ragged

#: Partitions of the walk whose sets are added.
SEEN = 200
#: Share of the steps of a walk that only looks whether there are other sets than those listed.
TRIAL = 0.05


@dataclass(frozen=True)
class Walk:
    """Walks over the partitions of groups of pooled records.

    terms : (n, 8) of all records, about the first one's place. prior : (8,). start, neighbour : CSR of the pairs of
    every record, both ways. code : (n + 1,) random numbers, 0 for ABSENT. weights : of sets.
    """

    pooled: PooledRecords
    terms: FloatArray
    prior: FloatArray
    constant: float
    start: IntArray
    neighbour: IntArray
    code: IntArray
    weights: SetWeights

    @classmethod
    def of(cls, pooled: PooledRecords, terms: Terms) -> Walk | None:
        """None unless there are pairs, and the weights of sets are sums over their records."""
        if not len(pooled.i) or pooled.in_plane is None or not all(rule.is_silent for rule in terms.by_pair):
            return None
        place, precision, log_peak, centre, prior = pooled.in_plane
        one, two = np.concatenate([pooled.i, pooled.j]), np.concatenate([pooled.j, pooled.i])
        order = np.lexsort([two, one])
        gain, origin = log_peak + terms.gain(pooled), place[:1]
        of_region = _sums(centre[None] - origin, prior[None], np.zeros(1), 0.0)[0]
        constant = float(sum(part.constant for part in terms.linear.values()))
        code = np.random.default_rng(0).integers(0, 1 << 62, len(pooled) + 1)
        code[ABSENT] = 0
        start = Ragged.of_sorted(one[order], len(pooled)).start
        terms_of_records = _sums(place - origin, precision, gain, 1.0)
        weights = SetWeights(pooled, terms)
        return cls(pooled, terms_of_records, of_region, constant, start, two[order], code, weights)

    def group(
        self, g: int, listed: IntArray, chosen: BoolArray, part: float = 1.0
    ) -> tuple[FloatArray, IntArray, FloatArray]:
        """(k,) probabilities of the listed sets (k, S) of a group, from the partition of its ``chosen`` ones, and other
        sets (m, S) with theirs (m,). part : of the steps of a walk."""
        from sameas.kernels.partition_walk import MIN_RECORDS, STEPS, Walked, walk

        records = np.flatnonzero(self.pooled.group == g)
        local = np.full(len(self.pooled) + 1, ABSENT)
        local[records] = np.arange(len(records))
        n, source, first = len(records), self.pooled.source[records], self.start[records]
        width = self.start[records + 1] - first
        start = Ragged.of_sizes(width).start
        near = local[self.neighbour[np.repeat(first - start[:-1], width) + np.arange(start[-1])]]
        keys = np.bitwise_xor.reduce(self.code[listed], axis=1)
        share, seen = np.empty(len(listed)), np.empty((SEEN, n), np.int64)
        walk(
            Walked(self.terms[records], self.prior, self.constant, source, start, near, self.code[records]),
            local[listed[chosen]], keys, int(part * STEPS * max(n, MIN_RECORDS)), share, seen,
        )  # fmt: skip
        return share, *self._unlisted(records, source, seen, keys)

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


def _sums(place: FloatArray, precision: FloatArray, log_peak: FloatArray, count: float) -> FloatArray:
    """(n, 8) what each record adds to the sums of its set (:data:`sameas.kernels.partition_walk.SUMS`)."""
    x, y = place.T
    xx, xy, yy = precision[:, 0, 0], precision[:, 0, 1], precision[:, 1, 1]
    east, north = xx * x + xy * y, xy * x + yy * y
    square = x * east + y * north
    return np.column_stack([xx, xy, yy, east, north, square, log_peak, np.full(len(x), count)])

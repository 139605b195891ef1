"""Sets of records near a good partition, for groups of more sets than can be listed.

Twenty records of one object have a million subsets, nearly all of which are in no partition of any weight. Here sets
are reached from a good partition instead, one record at a time:

1. *Partition.* Source after source is assigned to the clusters of those before it, by the best assignment as a whole;
   then every source anew to the clusters of all others, and clusters merge whose union outweighs them, until that
   gains no more. Three starts, the first source, the last, and all records alone, are packed into one partition.
2. *Division.* Three objects that sit in two clusters stay there. So some clusters at a time are divided in two, their
   parts and the clusters near them are assigned and merged once more, and these sets are packed with all before.
3. *Cost.* A set A taken out of the clusters C that it has records of leaves C∖A. Its cost is
   Σ ln w(C) − ln w(A) − Σ ln w(C∖A): so much less probable, in ln, is the partition with this one change.
4. *Search.* From the single records and the clusters, a record is added (in place of one of the same source) or
   removed. Sets of a cost up to ``ManyTuning.near_cost`` are changed further, the cheapest first, in a group at most
   ``ManyTuning.near_breadth`` for each record.
5. *Packing.* All sets found, and what they leave, are packed anew (:func:`sameas.kernels.packing.pack`), and the
   search begins again from the better partition, if there is one.

All sets found are candidates: any partition made of them counts, not only those of one change. A set that is excluded
costs more than ``near_cost``, is reached only through such sets, or was beyond the breadth.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import min_weight_full_bipartite_matching

from sameas.arrays import ABSENT, BoolArray, FloatArray, IntArray
from sameas.many.pooled import PooledRecords, record_codes
from sameas.many.rules import Terms, pairs_of
from sameas.ragged import Ragged, ranges

#: Most searches, each from a better partition (chosen: two or three are usual).
ROUNDS = 8
#: Increase of ln w of a partition below which it is not better, against rounding.
LEAST_GAIN = 1e-6
#: Of how many clusters one is divided at a time: neighbours divided at once take each other's records (chosen: of 5, 10
#: and 20, the last gives the most probable partitions). Clusters of fewer records are not divided.
SPACING, MIN_DIVIDED = 20, 4


@dataclass(frozen=True)
class NearSets:
    """members : (k, S) sets of two records or more. log_weight : (k,) ln w. partition : (c, S) a good partition made of
    them and of single records."""

    members: IntArray
    log_weight: FloatArray
    partition: IntArray


def near_sets(pooled: PooledRecords, terms: Terms, groups: BoolArray, most_cost: float, breadth: int) -> NearSets:
    """The sets near a good partition of each of the ``groups`` (g,).

    most_cost, breadth : see :class:`~sameas.many.sets.ManyTuning`.
    """
    search = _Search.of(pooled, terms, groups)
    single = search.single(np.flatnonzero(groups[pooled.group]))
    starts = [search.settled(c) for c in (search.in_sequence(single, 1), search.in_sequence(single, -1), single)]
    found = search.known.unique(np.concatenate([single, *starts]))
    partition, found = search.divided(search.packed(starts[0], found), found)
    improving = groups
    for _ in range(ROUNDS):
        searched = improving[search.group_of(partition)]
        clusters = partition[searched]
        found = search.known.unique(np.concatenate([found, search.around(clusters, most_cost, breadth)]))
        packed = search.packed(clusters, found[improving[search.group_of(found)]])
        partition = np.concatenate([partition[~searched], packed])
        improving = search.value(packed) > search.value(clusters) + LEAST_GAIN
        if not improving.any():
            break
    found = found[np.count_nonzero(found != ABSENT, axis=1) > 1]
    return NearSets(found, search.known(found), partition)


class SetWeights:
    """ln w of sets (k, S), each weighed once."""

    def __init__(self, pooled: PooledRecords, terms: Terms) -> None:
        self.pooled, self.terms = pooled, terms
        self.codes = record_codes(len(pooled))
        self.key, self.weight = np.empty(0, np.uint64), np.empty(0)

    def keys(self, sets: IntArray) -> NDArray[np.uint64]:
        """(k,) the key of each set."""
        return np.asarray(self.codes[sets].sum(axis=1, dtype=np.uint64))

    def unique(self, sets: IntArray) -> IntArray:
        """The different ones of the sets."""
        return np.asarray(sets[_first_of_each(self.keys(sets))])

    def __call__(self, sets: IntArray) -> FloatArray:
        """(k,) ln w; 0 of a single record and of none."""
        out = np.zeros(len(sets))
        several = np.flatnonzero(np.count_nonzero(sets != ABSENT, axis=1) > 1)
        key = self.keys(sets[several])
        fresh = np.flatnonzero(~_among(key, self.key))
        if len(fresh):
            fresh = fresh[_first_of_each(key[fresh])]
            new, weight = key[fresh], self._weighed(sets[several[fresh]])
            order = np.argsort(np.concatenate([self.key, new]), kind="stable")
            self.key = np.concatenate([self.key, new])[order]
            self.weight = np.concatenate([self.weight, weight])[order]
        out[several] = self.weight[np.searchsorted(self.key, key)]
        return out

    def _weighed(self, sets: IntArray) -> FloatArray:
        """(k,) ln w of sets of two records or more."""
        compiled = self.pooled.in_plane is not None
        weight = np.zeros(len(sets)) if compiled else self.pooled.log_joint_of_members(sets)
        sizes = np.count_nonzero(sets != ABSENT, axis=1)
        for size in np.unique(sizes).tolist():
            rows = np.flatnonzero(sizes == size)
            records = np.sort(sets[rows], axis=1)[:, sets.shape[1] - size :]
            weight[rows] += self.terms.linear_of(records)
            if compiled:
                weight[rows] += self.pooled.log_joint(records)
            if self.terms.by_pair:
                weight[rows] += self.terms.by_pair_of(pairs_of(self.pooled, records))
        return weight


@dataclass(frozen=True)
class _Search:
    """start, neighbour : CSR of the pairs of every record, both ways."""

    pooled: PooledRecords
    start: IntArray
    neighbour: IntArray
    known: SetWeights

    @classmethod
    def of(cls, pooled: PooledRecords, terms: Terms, groups: BoolArray) -> _Search:
        return cls(pooled, *pooled.neighbours(groups), SetWeights(pooled, terms))

    def single(self, records: IntArray) -> IntArray:
        """(k, S) every record as a set."""
        sets = np.full((len(records), len(self.pooled.sources)), ABSENT)
        sets[np.arange(len(records)), self.pooled.source[records]] = records
        return sets

    def group_of(self, sets: IntArray) -> IntArray:
        """(k,) the group of sets that are not empty."""
        return np.asarray(self.pooled.group[sets.max(axis=1)])

    def in_sequence(self, single: IntArray, order: int) -> IntArray:
        """(c, S) clusters of single records: one source after another assigned to those before, from the first source
        on (``order`` 1) or from the last (−1)."""
        clusters = single[:0]
        for s in range(len(self.pooled.sources))[::order]:
            clusters = self._assigned(clusters, single[single[:, s] != ABSENT, s], s)
        return clusters

    def settled(self, clusters: IntArray) -> IntArray:
        """(c, S) clusters with every source assigned anew and unions merged, until that gains no more."""
        value = -np.inf
        while (now := float(self.known(clusters).sum())) > value + LEAST_GAIN:
            value, clusters = now, self._reassigned(clusters)
        return clusters

    def _reassigned(self, clusters: IntArray) -> IntArray:
        """(c, S) clusters with every source assigned anew, once, and then unions merged."""
        for s in range(len(self.pooled.sources)):
            records = np.sort(clusters[clusters[:, s] != ABSENT, s])
            others = clusters.copy()
            others[:, s] = ABSENT
            clusters = self._assigned(others[(others != ABSENT).any(axis=1)], records, s)
        return self._merged(clusters)

    def divided(self, clusters: IntArray, found: IntArray) -> tuple[IntArray, IntArray]:
        """A partition (c, S) no worse than the clusters, packed from the sets found and those to which divided clusters
        lead, until that gains no more; and all these sets (k, S)."""
        for turn in range(ROUNDS):
            value = self.known(clusters).sum()
            for first in range(SPACING):
                large = np.count_nonzero(clusters != ABSENT, axis=1) >= MIN_DIVIDED
                divided = large & (np.arange(len(clusters)) % SPACING == first)
                if not divided.any():
                    continue
                near = self._near(clusters, divided) & ~divided
                tried = self._reassigned(np.concatenate([clusters[near], *self._parts(clusters[divided], turn)]))
                found = self.known.unique(np.concatenate([found, tried]))
                clusters = self.packed(clusters, found)
            if self.known(clusters).sum() <= value + LEAST_GAIN:
                break
        return clusters, found

    def _near(self, clusters: IntArray, some: BoolArray) -> BoolArray:
        """(c,) the clusters with a record that is a pair with one of ``some`` (c,) clusters."""
        records = clusters[some]
        records = records[records != ABSENT]
        _, place = ranges(self.start[records], self.start[records + 1] - self.start[records])
        number = self._numbers(clusters)[self.neighbour[place]]
        near = np.zeros(len(clusters), bool)
        near[number[number != ABSENT]] = True
        return near

    def _parts(self, clusters: IntArray, turn: int) -> tuple[IntArray, IntArray]:
        """Two parts (c, S) of each cluster, about two of its records: with which a record weighs more, as a pair.
        One is that which fits worst, or second worst in ``turn`` 1, and so on; the other weighs least with it."""
        at, source = np.nonzero(clusters != ABSENT)
        record, first = clusters[at, source], Ragged.of_sorted(at, len(clusters)).start[:-1]
        less = clusters[at]
        less[np.arange(len(at)), source] = ABSENT
        worst = np.lexsort([-self.known(less), at])
        one = record[worst[first + turn % np.bincount(at)]]
        with_one = self._as_pairs(record, one[at])
        other = record[np.lexsort([with_one, at])[first]]
        moved = self._as_pairs(record, other[at]) > with_one
        parts = clusters.copy(), np.full_like(clusters, ABSENT)
        parts[0][at[moved], source[moved]] = ABSENT
        parts[1][at[moved], source[moved]] = record[moved]
        return parts

    def _as_pairs(self, records: IntArray, others: IntArray) -> FloatArray:
        """(k,) ln w of pairs of one set; infinite of a record with itself."""
        pairs = self.single(records)
        pairs[np.arange(len(others)), self.pooled.source[others]] = others
        return np.where(records == others, np.inf, self.known(pairs))

    def _assigned(self, clusters: IntArray, records: IntArray, s: int) -> IntArray:
        """The clusters (c, S) with the records (n,) of source s, of which they have none, assigned by the largest gain
        in all; a record that is not assigned is a cluster of its own."""
        if not len(records):
            return clusters
        row, place = ranges(self.start[records], self.start[records + 1] - self.start[records])
        column = self._numbers(clusters)[self.neighbour[place]]
        inside = column != ABSENT
        pair, count = np.unique(row[inside] * len(clusters) + column[inside], return_counts=True)
        row, column = np.divmod(pair, max(len(clusters), 1))
        all_pairs = count == np.count_nonzero(clusters[column] != ABSENT, axis=1)
        row, column = row[all_pairs], column[all_pairs]
        together = clusters[column]
        together[:, s] = records[row]
        gain = self.known(together) - self.known(clusters[column])
        row, column, gain = row[gain > 0.0], column[gain > 0.0], gain[gain > 0.0]
        # A record may also stay alone, in a column of its own. Costs are above 0, which would mean no edge.
        alone, n = 1.0 + gain.max(initial=0.0), len(records)
        cost = np.concatenate([alone - gain, np.full(n, alone)])
        edges = np.concatenate([row, np.arange(n)]), np.concatenate([column, len(clusters) + np.arange(n)])
        _, chosen = min_weight_full_bipartite_matching(csr_array((cost, edges), shape=(n, len(clusters) + n)))
        joined = chosen < len(clusters)
        clusters = clusters.copy()
        clusters[chosen[joined], s] = records[joined]
        return np.concatenate([clusters, self.single(records[~joined])])

    def _merged(self, clusters: IntArray) -> IntArray:
        """The clusters merged while a union outweighs its parts, mutual best ones first."""
        while True:
            a, b = self._unions(clusters)
            if not len(a):
                return clusters
            union = np.maximum(clusters[a], clusters[b])
            gain = self.known(union) - self.known(clusters[a]) - self.known(clusters[b])
            best = _mutual_best(a, b, gain, len(clusters))
            if not len(best):
                return clusters
            gone = np.zeros(len(clusters), bool)
            gone[a[best]] = gone[b[best]] = True
            clusters = np.concatenate([clusters[~gone], union[best]])

    def _unions(self, clusters: IntArray) -> tuple[IntArray, IntArray]:
        """Two clusters each whose records are all pairs of the gate, which records of one source are not."""
        of_record = self._numbers(clusters)
        i, j = of_record[self.pooled.i], of_record[self.pooled.j]
        across = (i != ABSENT) & (j != ABSENT) & (i != j)
        key = np.minimum(i, j)[across] * len(clusters) + np.maximum(i, j)[across]
        key, count = np.unique(key, return_counts=True)
        a, b = key // len(clusters), key % len(clusters)
        size = (clusters != ABSENT).sum(axis=1)
        all_pairs = count == size[a] * size[b]
        return a[all_pairs], b[all_pairs]

    def _numbers(self, clusters: IntArray) -> IntArray:
        """(n + 1,) the cluster of every record; ABSENT of those in none, and of the record ABSENT."""
        out = np.full(len(self.pooled) + 1, ABSENT)
        at, source = np.nonzero(clusters != ABSENT)
        out[clusters[at, source]] = at
        return out

    def value(self, clusters: IntArray) -> FloatArray:
        """(g,) Σ ln w of a partition of some groups, 0 of the others."""
        return np.bincount(self.group_of(clusters), self.known(clusters), len(self.pooled.sizes)).astype(np.float64)

    def around(self, clusters: IntArray, most_cost: float, breadth: int) -> IntArray:
        """The sets near a partition (c, S) of some groups, with those that they leave."""
        of_record = self._numbers(clusters)
        sets = [clusters]
        seen = np.sort(self.known.keys(clusters))
        fresh = np.concatenate([self.single(clusters[clusters != ABSENT]), self._changes(clusters)])
        waiting, cost_of_waiting = fresh[:0], np.empty(0)
        remaining = breadth * self.pooled.sizes
        while True:
            fresh = self.known.unique(fresh)
            fresh = fresh[~_among(self.known.keys(fresh), seen)]
            seen = np.sort(np.concatenate([seen, self.known.keys(fresh)]))
            cost, left, of_set = self._costs(fresh, clusters, of_record)
            near = cost <= most_cost
            left = left[near[of_set]]
            sets += [fresh[near], left]
            waiting = np.concatenate([waiting, fresh[near]])
            cost_of_waiting = np.concatenate([cost_of_waiting, cost[near]])
            now = self._cheapest(waiting, cost_of_waiting, remaining)
            if not now.any():
                return np.concatenate(sets)
            remaining = remaining - np.bincount(self.group_of(waiting[now]), minlength=len(remaining))
            fresh = self._changes(waiting[now])
            waiting, cost_of_waiting = waiting[~now], cost_of_waiting[~now]

    def packed(self, clusters: IntArray, sets: IntArray) -> IntArray:
        """(c, S) a partition made of the clusters and sets, which include each other, no worse than the clusters."""
        from sameas.kernels.packing import pack

        weight, group = self.known(sets), self.group_of(sets)
        order = np.argsort(group, kind="stable")
        sets, weight, group = sets[order], weight[order], group[order]
        start = Ragged.of_sorted(group, len(self.pooled.sizes)).start
        chosen = _among(self.known.keys(sets), np.sort(self.known.keys(clusters)))
        pack(np.unique(group), start, sets, weight, len(self.pooled), chosen)
        return np.asarray(sets[chosen])

    def _costs(self, sets: IntArray, clusters: IntArray, of_record: IntArray) -> tuple[FloatArray, IntArray, IntArray]:
        """(k,) cost of each set, and what is left of the clusters: sets (m, S) that are not empty, and of which set."""
        at, source = np.nonzero(sets != ABSENT)
        touched = np.unique(at * len(clusters) + of_record[sets[at, source]])
        of_set, cluster = touched // len(clusters), touched % len(clusters)
        left = np.where(clusters[cluster] == sets[of_set], ABSENT, clusters[cluster])
        lost = self.known(clusters)[cluster] - self.known(left)
        cost = np.bincount(of_set, lost, len(sets)) - self.known(sets)
        some = (left != ABSENT).any(axis=1)
        left, of_set = left[some], of_set[some]
        return self._exchanged(cost, left, of_set)

    def _exchanged(self, cost: FloatArray, left: IntArray, of_set: IntArray) -> tuple[FloatArray, IntArray, IntArray]:
        """:meth:`_costs` with what is left of two clusters as one set where that weighs more: records are exchanged."""
        rank = Ragged.of_sorted(of_set, len(cost)).index
        first = np.flatnonzero(np.bincount(of_set, minlength=len(cost))[of_set] == 2)
        first = first[rank[first] == 0]
        one, two = left[first], left[first + 1]
        first = first[~((one != ABSENT) & (two != ABSENT)).any(axis=1)]
        union = np.maximum(left[first], left[first + 1])
        valid = self._all_pairs(union)
        first, union = first[valid], union[valid]
        gain = self.known(union) - self.known(left[first]) - self.known(left[first + 1])
        first, union, gain = first[gain > 0.0], union[gain > 0.0], gain[gain > 0.0]
        cost[of_set[first]] -= gain
        left = left.copy()
        left[first] = union
        kept = np.ones(len(left), bool)
        kept[first + 1] = False
        return cost, left[kept], of_set[kept]

    def _all_pairs(self, sets: IntArray) -> BoolArray:
        """(k,) whether every two records of a set are a pair."""
        valid = np.ones(len(sets), bool)
        for s in range(sets.shape[1]):
            for t in range(s):
                k = np.flatnonzero(valid & (sets[:, s] != ABSENT) & (sets[:, t] != ABSENT))
                a, b = sets[k, s], sets[k, t]
                valid[k] = self.pooled.pair(np.minimum(a, b), np.maximum(a, b))[0]
        return valid

    def _cheapest(self, sets: IntArray, cost: FloatArray, remaining: IntArray) -> BoolArray:
        """(k,) the cheapest sets of each group, one for each of its records but at most ``remaining`` (g,)."""
        group = self.group_of(sets) if len(sets) else np.empty(0, np.int64)
        order = np.lexsort([self.known.keys(sets), cost, group])
        rank = Ragged.of_sorted(group[order], len(remaining)).index
        kept = np.zeros(len(sets), bool)
        kept[order[rank < np.minimum(remaining, self.pooled.sizes)[group[order]]]] = True
        return kept

    def _changes(self, sets: IntArray) -> IntArray:
        """The sets with one record less, or one more that is a pair with all others, in place of one of its source."""
        at, source = np.nonzero(sets != ABSENT)
        less = sets[at]
        less[np.arange(len(at)), source] = ABSENT
        less = less[(less != ABSENT).any(axis=1)]
        # A record that is a pair of all is one of any: that of the first, or of the second in place of the first.
        size = (sets != ABSENT).sum(axis=1)
        first_two = Ragged.of_sizes(size).index < 2
        of, record = at[first_two], sets[at, source][first_two]
        row, place = ranges(self.start[record], self.start[record + 1] - self.start[record])
        added = self.neighbour[place]
        more = sets[of[row]]
        new = more[np.arange(len(more)), self.pooled.source[added]] != added
        more, added = more[new], added[new]
        more[np.arange(len(more)), self.pooled.source[added]] = added
        pick = _first_of_each(self.known.keys(more))
        more, added = more[pick], added[pick]
        at, source = np.nonzero(more != ABSENT)
        other, mine = more[at, source], added[at]
        is_pair, _ = self.pooled.pair(np.minimum(other, mine), np.maximum(other, mine))
        apart = np.bincount(at, ~is_pair & (other != mine), len(more)) > 0
        return np.concatenate([less, more[~apart]])


def _first_of_each(keys: NDArray[np.uint64]) -> IntArray:
    """Position of the first of every different key, by key; ``np.unique`` of 64-bit numbers hashes, and is slower."""
    order = np.argsort(keys, kind="stable")
    ordered = keys[order]
    return np.asarray(order[np.concatenate([[True], ordered[1:] != ordered[:-1]])[: len(order)]])


def _among(keys: NDArray[np.uint64], ordered: NDArray[np.uint64]) -> BoolArray:
    """(k,) whether each key is one of the ascending ``ordered`` ones."""
    if not len(ordered):
        return np.zeros(len(keys), bool)
    return np.asarray(ordered[np.minimum(np.searchsorted(ordered, keys), len(ordered) - 1)] == keys)


def _mutual_best(a: IntArray, b: IntArray, gain: FloatArray, n: int) -> IntArray:
    """The unions (k,) of clusters a and b that gain, and gain more than any other of either; ties by their numbers."""
    order = np.lexsort([b, a, -gain])
    order = order[gain[order] > 0.0]
    rank = np.arange(len(order))
    best = np.full(n, len(order))
    np.minimum.at(best, a[order], rank)
    np.minimum.at(best, b[order], rank)
    return np.asarray(order[(best[a[order]] == rank) & (best[b[order]] == rank)])

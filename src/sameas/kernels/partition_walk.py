"""Probabilities of sets of records in the plane by a Markov chain over all partitions of a group, listed or not.

Twenty records of one object beside twenty of another can be divided in more ways than can be listed. Here a set is
weighed when it is proposed, from sums over its records, so the chain needs no list
(:mod:`sameas.kernels.partition_samples` knows listed sets only). A step takes a record r, and a record q that is a pair
with it; a and b are their sets:

- *move*: r joins b, is alone if a is b, or changes places with the record of its source in b;
- *divide*: if a is b, it is divided in two, r and q apart; the other records follow one by one in random order, each as
  its parts so far make it probable. If a and b have no source in common, they are united; the probability of the
  division that reverses this is known;
- *exchange*: the other records of a and b are divided between r and q in the same way, source by source.

A proposal is accepted with the probability of Metropolis and Hastings, so a partition is visited as often as it is
probable.

Source: METHOD 7; Hastings 1970, Biometrika 57, 97; sequential allocation of Dahl 2003 (technical report 1086,
University of Wisconsin).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from sameas.arrays import ABSENT, FloatArray, IntArray
from sameas.kernels.compiled import kernel, part
from sameas.kernels.partition_samples import MODULUS, MULTIPLIER, NO_SET, hash_table, looked_up

#: Steps for each record of a group, least number of records for that product, and share of the steps before any is
#: counted (chosen: 20 sources of 100 objects with λ = 0.2 then have probabilities within 0.02, in 10 s).
STEPS, MIN_RECORDS, BURN_IN = 6_000, 100, 0.1
#: Of so many steps one is a division and one an exchange.
MOVES = 16
#: What a record adds to the sums of its set: information (xx, xy, yy), its product with the position (x, y), the square
#: zᵀ R⁻¹ z, ln of peak and gain, and 1.
SUMS = 8


class Walked(NamedTuple):
    """The records of a group.

    terms : (n, SUMS). prior : (SUMS,) of the region. constant : of ln w of every set of two records or more. source :
    (n,). start, neighbour : CSR of the records that are pairs with each, ascending. code : (n,) random numbers; the key
    of a set is the exclusive or of those of its records.
    """

    terms: FloatArray
    prior: FloatArray
    constant: float
    source: IntArray
    start: IntArray
    neighbour: IntArray
    code: IntArray


class Clusters(NamedTuple):
    """A partition into clusters, some of them empty.

    of : (n,) cluster of each record. member : (n, S) records, ABSENT for none. sums : (n, SUMS). weight : (n,) ln w.
    key, size, since : (n,) of each cluster; since which step it is as it is. free : (n + 1,) empty clusters, and last
    their number.
    """

    of: IntArray
    member: IntArray
    sums: FloatArray
    weight: FloatArray
    key: IntArray
    size: IntArray
    since: IntArray
    free: IntArray


class Listed(NamedTuple):
    """Sets by key: a hash table of them, their keys, and the steps that each was there."""

    table: IntArray
    key: IntArray
    steps: FloatArray


class Proposal(NamedTuple):
    """Two sets in place of those of r and q: their records (S,), ABSENT for none, and while they are divided their
    sums and order: sums (2, SUMS), order (S,) of the sources."""

    first: IntArray
    second: IntArray
    sums: FloatArray
    order: IntArray


@kernel
def walk(records: Walked, member: IntArray, keys: IntArray, steps: int, share: FloatArray, seen: IntArray) -> None:
    """Write the share of the steps at which each listed set is in the partition to ``share`` (k,).

    member : (c, S) the partition to begin with. keys : (k,) of the listed sets. seen : (m, n) the clusters of all
    records at m steps evenly apart, written.
    """
    n, n_sources = len(records.source), member.shape[1]
    clusters = _clusters(records, member)
    listed = Listed(hash_table(keys), keys, share)
    proposal = Proposal(
        np.empty(n_sources, np.int64), np.empty(n_sources, np.int64), np.empty((2, SUMS)), np.arange(n_sources)
    )
    share[:] = 0.0
    burn_in, written = int(BURN_IN * steps), 0
    counted, random = steps - burn_in, 1 + 7919 * n % (MODULUS - 1)
    clusters.since[:] = burn_in
    for step in range(steps):
        if step - burn_in >= written * counted // len(seen) and step >= burn_in and written < len(seen):
            seen[written] = clusters.of
            written += 1
        random = random * MULTIPLIER % MODULUS
        r = random % n
        if records.start[r] == records.start[r + 1]:
            continue
        random = random * MULTIPLIER % MODULUS
        q = records.neighbour[records.start[r] + random % (records.start[r + 1] - records.start[r])]
        random = random * MULTIPLIER % MODULUS
        kind = random % MOVES
        a, b = clusters.of[r], clusters.of[q]
        if kind > 1:
            b, log_odds = _move(r, a, b, records, clusters, proposal)
        elif kind == 1:
            b, log_odds, random = _divide(r, q, a, b, random, records, clusters, proposal)
        elif a != b:
            log_odds, random = _exchange(r, q, a, b, random, records, clusters, proposal)
        else:
            continue
        random = random * MULTIPLIER % MODULUS
        if log_odds >= 0.0 or random < math.exp(log_odds) * MODULUS:
            _replace(a, b, max(step, burn_in), records, clusters, proposal, listed)
    for c in range(n):
        if clusters.size[c] > 0:
            _count(c, steps, clusters, listed)
    for k in range(len(share)):
        share[k] /= counted


@part
def _move(r: int, a: int, b: int, records: Walked, clusters: Clusters, proposal: Proposal) -> tuple[int, float]:
    """Record r, of cluster a, joins b, is alone if a is b, or changes places with the record of its source in b.
    Returns the second cluster and ln of the probability to accept, up to 1."""
    s, size, term = records.source[r], clusters.size, records.terms[r]
    if a == b:
        b = clusters.free[clusters.free[-1] - 1]
    other = clusters.member[b, s]
    if not _fits(r, clusters.member[b], s, records):
        return b, -math.inf
    proposal.first[:], proposal.second[:] = clusters.member[a], clusters.member[b]
    proposal.first[s], proposal.second[s] = other, r
    if other == ABSENT:
        first = _log_weight_with(clusters.sums[a], term, -1.0, records.constant)
        second = _log_weight_with(clusters.sums[b], term, 1.0, records.constant)
        # One of the |b| records of b is q, and of a, to return, one of |a| − 1; to be alone, one of |a| − 1 both ways.
        back = 1.0 if size[a] == 1 or size[b] == 0 else (size[a] - 1) / size[b]
    else:
        if not _fits(other, clusters.member[a], s, records):
            return b, -math.inf
        first = _log_weight_exchanged(clusters.sums[a], records.terms[other], term, records.constant)
        second = _log_weight_exchanged(clusters.sums[b], term, records.terms[other], records.constant)
        of_r = 1.0 / (records.start[r + 1] - records.start[r])
        of_other = 1.0 / (records.start[other + 1] - records.start[other])
        there = (size[b] - 1) * of_r + (size[a] - 1) * of_other
        back = ((size[a] - 1) * of_r + (size[b] - 1) * of_other) / there
    return b, first + second - clusters.weight[a] - clusters.weight[b] + math.log(back)


@part
def _divide(
    r: int, q: int, a: int, b: int, random: int, records: Walked, clusters: Clusters, proposal: Proposal
) -> tuple[int, float, int]:
    """Cluster a is divided between r and q, or a and b are united. Returns the second cluster, ln of the probability to
    accept, up to 1, and the random number."""
    random = _shuffle(proposal.order, random)
    if a == b:
        b = clusters.free[clusters.free[-1] - 1]
        log_p, weight, random = _allocate(r, q, a, b, True, random, records, clusters, proposal)
        return b, weight - clusters.weight[a] - log_p, random
    for s in range(len(proposal.first)):
        if clusters.member[b, s] != ABSENT and not _fits(clusters.member[b, s], clusters.member[a], ABSENT, records):
            return b, -math.inf, random
        if clusters.member[a, s] != ABSENT and clusters.member[b, s] != ABSENT:
            return b, -math.inf, random
    log_p, weight, random = _allocate(r, q, a, b, False, random, records, clusters, proposal)
    for s in range(len(proposal.first)):
        proposal.first[s] = max(clusters.member[a, s], clusters.member[b, s])
        proposal.second[s] = ABSENT
    for k in range(SUMS):
        proposal.sums[0, k] += proposal.sums[1, k] - records.prior[k]
    united = _log_weight(proposal.sums[0], records.constant)
    return b, united - clusters.weight[a] - clusters.weight[b] + log_p, random


@part
def _exchange(
    r: int, q: int, a: int, b: int, random: int, records: Walked, clusters: Clusters, proposal: Proposal
) -> tuple[float, int]:
    """The records of a and b are divided anew between r and q. Returns ln of the probability to accept, up to 1, and
    the random number."""
    random = _shuffle(proposal.order, random)
    log_back, _, random = _allocate(r, q, a, b, False, random, records, clusters, proposal)
    log_p, weight, random = _allocate(r, q, a, b, True, random, records, clusters, proposal)
    if log_p == -math.inf:
        return -math.inf, random
    return weight - clusters.weight[a] - clusters.weight[b] + log_back - log_p, random


@part
def _allocate(
    r: int, q: int, a: int, b: int, is_new: bool, random: int, records: Walked, clusters: Clusters, proposal: Proposal
) -> tuple[float, float, int]:
    """Divide the records of a and b between the sets of r and q, one source after the other: as they are, or at random
    (``is_new``) by the weights of the sets so far. Returns ln of the probability of this division, −∞ if there is none,
    the ln w of both sets, and the random number."""
    sums, first, second = proposal.sums, proposal.first, proposal.second
    for k in range(SUMS):
        sums[0, k] = records.prior[k] + records.terms[r, k]
        sums[1, k] = records.prior[k] + records.terms[q, k]
    first[:], second[:] = ABSENT, ABSENT
    first[records.source[r]], second[records.source[q]] = r, q
    log_p, one, two = 0.0, 0.0, 0.0
    for s in proposal.order:
        x, y = clusters.member[a, s], clusters.member[b, s]
        x = ABSENT if x in (r, q) else x
        y = ABSENT if y in (r, q) else y
        if x == ABSENT and y == ABSENT:
            continue
        # As they are, x with r and y with q; or the other way round, where the place is not that of r or q.
        here = _free(first, s, x) and _free(second, s, y)
        there = _free(first, s, y) and _free(second, s, x)
        here = here and (not is_new or (_joins(x, first, records) and _joins(y, second, records)))
        there = there and _joins(x, second, records) and _joins(y, first, records)
        if not here and not there:
            return -math.inf, 0.0, random
        one_here = _log_weight_with_any(sums[0], x, one, records) if here else -math.inf
        two_here = _log_weight_with_any(sums[1], y, two, records) if here else 0.0
        one_there = _log_weight_with_any(sums[0], y, one, records) if there else -math.inf
        two_there = _log_weight_with_any(sums[1], x, two, records) if there else 0.0
        log_here, log_there = _log_shares(one_here + two_here, one_there + two_there)
        stays = True
        if is_new:
            random = random * MULTIPLIER % MODULUS
            stays = random < math.exp(log_here) * MODULUS
        log_p += log_here if stays else log_there
        one, two = (one_here, two_here) if stays else (one_there, two_there)
        x, y = (x, y) if stays else (y, x)
        _join(x, s, first, sums[0], records)
        _join(y, s, second, sums[1], records)
    return log_p, one + two, random


@part
def _log_shares(one: float, two: float) -> tuple[float, float]:
    """ln of eᵃ / (eᵃ + eᵇ) and of eᵇ / (eᵃ + eᵇ)."""
    if one >= two:
        log_one = -math.log1p(math.exp(two - one))
        return log_one, log_one + two - one
    log_two = -math.log1p(math.exp(one - two))
    return log_two + one - two, log_two


@part
def _free(members: IntArray, s: int, record: int) -> bool:
    """Whether a set has no record of source s yet, if there is a record to join it."""
    return record == ABSENT or members[s] == ABSENT


@part
def _joins(record: int, members: IntArray, records: Walked) -> bool:
    """Whether a record, or none, is a pair with all of a set."""
    return record == ABSENT or _fits(record, members, ABSENT, records)


@part
def _join(record: int, s: int, members: IntArray, sums: FloatArray, records: Walked) -> None:
    """Add a record of source s, or none, to a set and its sums."""
    if record != ABSENT:
        members[s] = record
        for k in range(SUMS):
            sums[k] += records.terms[record, k]


@part
def _log_weight_with_any(sums: FloatArray, record: int, weight: float, records: Walked) -> float:
    """ln w of a set with one more record, or ``weight`` with none."""
    return weight if record == ABSENT else _log_weight_with(sums, records.terms[record], 1.0, records.constant)


@part
def _log_weight(sums: FloatArray, constant: float) -> float:
    """ln w of a set by its sums; 0 of one record and of none."""
    return _of_sums(sums[0], sums[1], sums[2], sums[3], sums[4], sums[5], sums[6], sums[7], constant)


@part
def _log_weight_with(sums: FloatArray, term: FloatArray, sign: float, constant: float) -> float:
    """ln w of a set with one record more (``sign`` 1) or less (−1)."""
    return _of_sums(
        sums[0] + sign * term[0], sums[1] + sign * term[1], sums[2] + sign * term[2], sums[3] + sign * term[3],
        sums[4] + sign * term[4], sums[5] + sign * term[5], sums[6] + sign * term[6], sums[7] + sign, constant,
    )  # fmt: skip


@part
def _log_weight_exchanged(sums: FloatArray, more: FloatArray, less: FloatArray, constant: float) -> float:
    """ln w of a set with one record in place of another."""
    return _of_sums(
        sums[0] + (more[0] - less[0]), sums[1] + (more[1] - less[1]), sums[2] + (more[2] - less[2]),
        sums[3] + (more[3] - less[3]), sums[4] + (more[4] - less[4]), sums[5] + (more[5] - less[5]),
        sums[6] + (more[6] - less[6]), sums[7], constant,
    )  # fmt: skip


@part
def _of_sums(
    xx: float, xy: float, yy: float, x: float, y: float, square: float, log_peak: float, size: float, constant: float
) -> float:
    """ln w of a set by its sums; 0 of one record and of none."""
    if size < 1.5:
        return 0.0
    determinant = xx * yy - xy * xy
    chi_sq = square - (yy * x * x - 2.0 * xy * x * y + xx * y * y) / determinant
    return constant + log_peak + math.log(2.0 * math.pi) - 0.5 * (math.log(determinant) + max(chi_sq, 0.0))


@part
def _fits(record: int, members: IntArray, without: int, records: Walked) -> bool:
    """Whether a record is a pair with all of a set but that of the source ``without``."""
    for s in range(len(members)):
        other = members[s]
        if s != without and other != ABSENT and other != record and not _is_pair(record, other, records):
            return False
    return True


@part
def _is_pair(one: int, two: int, records: Walked) -> bool:
    low, high = records.start[one], records.start[one + 1]
    end = high
    while low < high:
        middle = (low + high) // 2
        if records.neighbour[middle] < two:
            low = middle + 1
        else:
            high = middle
    return low < end and records.neighbour[low] == two


@part
def _shuffle(order: IntArray, random: int) -> int:
    """Put the sources in random order; returns the random number."""
    for s in range(len(order) - 1, 0, -1):
        random = random * MULTIPLIER % MODULUS
        k = random % (s + 1)
        order[s], order[k] = order[k], order[s]
    return random


@part
def _replace(
    a: int, b: int, step: int, records: Walked, clusters: Clusters, proposal: Proposal, listed: Listed
) -> None:
    """Put the proposed sets in place of clusters a and b."""
    _count(a, step, clusters, listed)
    _count(b, step, clusters, listed)
    was_empty = clusters.size[b] == 0
    clusters.member[a], clusters.member[b] = proposal.first, proposal.second
    _sum(a, records, clusters)
    _sum(b, records, clusters)
    if was_empty:
        clusters.free[-1] -= 1
    for c in (a, b):
        clusters.since[c] = step
        if clusters.size[c] == 0:
            clusters.free[clusters.free[-1]] = c
            clusters.free[-1] += 1


@part
def _sum(c: int, records: Walked, clusters: Clusters) -> None:
    """Sums, weight, key, size and records of a cluster by its members."""
    clusters.sums[c] = records.prior
    clusters.key[c], clusters.size[c] = 0, 0
    for record in clusters.member[c]:
        if record != ABSENT:
            clusters.of[record] = c
            clusters.size[c] += 1
            clusters.key[c] ^= records.code[record]
            for k in range(SUMS):
                clusters.sums[c, k] += records.terms[record, k]
    clusters.weight[c] = _log_weight(clusters.sums[c], records.constant)


@part
def _count(c: int, step: int, clusters: Clusters, listed: Listed) -> None:
    """Count the steps since a cluster was changed for its set, if that is listed."""
    if step > clusters.since[c] and clusters.size[c] > 0:
        number = looked_up(clusters.key[c], listed.table, listed.key)
        if number != NO_SET:
            listed.steps[number] += step - clusters.since[c]


@part
def _clusters(records: Walked, member: IntArray) -> Clusters:
    """The partition (c, S) as clusters, as many as records."""
    n = len(records.source)
    members = np.full((n, member.shape[1]), ABSENT)
    members[: len(member)] = member
    clusters = Clusters(
        np.empty(n, np.int64), members, np.empty((n, SUMS)), np.empty(n), np.empty(n, np.int64), np.empty(n, np.int64),
        np.zeros(n, np.int64), np.zeros(n + 1, np.int64),
    )  # fmt: skip
    for c in range(n):
        _sum(c, records, clusters)
    for c in range(len(member), n):
        clusters.free[clusters.free[-1]] = c
        clusters.free[-1] += 1
    return clusters

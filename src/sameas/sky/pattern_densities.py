"""Densities of the objects of each pattern of catalogues, at the records of each catalogue.

A *pattern* is a set of catalogues, one bit each: the catalogues that contain an object. The density of its objects by
one catalogue is the local density of that catalogue's records times their share in the pattern; all catalogues of the
pattern count the same objects, so the mean of the logarithms is used. Shares refer to the records in the footprint of
all of its catalogues.

Up to eight catalogues have 255 patterns, each with a share that varies over the field. Twelve have 4095, of which most
have a few objects or none: there the most frequent ones have local shares, and the others one share everywhere, drawn
towards what the matches of every two catalogues let expect.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sameas.arrays import ABSENT, BoolArray, FloatArray, IntArray
from sameas.estimate.coverage import SHARED_PSEUDO_COUNT, Coverage, local_share
from sameas.estimate.em import MIN_SHARE

Coverages = Mapping[tuple[int, int], Coverage]

#: Number of patterns with a local share, the most frequent ones: all of up to eight catalogues (chosen).
MOST_LOCAL = 256
#: Weight of the expected share of a pattern without a local one, in records (chosen).
EXPECTED_RECORDS = 100.0
#: Number of records of a catalogue, evenly taken, whose patterns give the expected shares (chosen).
EXPECTED_FROM = 20_000
#: Limits of a probability whose logarithm is taken.
_LEAST_P = 1e-12


@dataclass(frozen=True)
class PatternShares:
    """Probabilities of patterns of the records of each catalogue.

    local : (m,) the patterns whose shares are local, ascending. of_records : per catalogue (n, m) the probability that
    a record is in an object of each. total : (2^S, S) sum over all records of a catalogue, by pattern. expected :
    (2^S, S) the same as a share, from the pairwise matches. The last two are empty if all patterns are local.
    """

    local: IntArray
    of_records: list[FloatArray]
    total: FloatArray
    expected: FloatArray

    @classmethod
    def independent(cls, p_partner: Mapping[tuple[int, int], FloatArray]) -> PatternShares:
        """From the probabilities (n_a,) that a record of catalogue a has a partner in b, independent of each other."""
        n_sources = max(b for _, b in p_partner) + 1
        local, total = np.arange(1 << n_sources), np.empty((0, n_sources))
        if len(local) > MOST_LOCAL:
            total = np.column_stack([_expected_total(p_partner, s, n_sources) for s in range(n_sources)])
            local = most_frequent(total.max(axis=1))
        of_records = []
        for s in range(n_sources):
            others = [t for t in range(n_sources) if t != s]
            share = np.zeros((len(p_partner[s, others[0]]), len(local)), order="F")
            for k, pattern in enumerate(local.tolist()):
                if pattern >> s & 1:
                    parts = (p_partner[s, t] if pattern >> t & 1 else 1.0 - p_partner[s, t] for t in others)
                    share[:, k] = np.prod(list(parts), axis=0)
            of_records.append(share)
        return cls(local, of_records, total, total / np.array([len(share) for share in of_records]))

    @classmethod
    def of_sets(
        cls, sets: IntArray, patterns: IntArray, probability: FloatArray, n_records: Sequence[int], expected: FloatArray
    ) -> PatternShares:
        """From the probabilities (k,) of sets (k, S) of these patterns; n_records : of each catalogue."""
        n_patterns, local = 1 << sets.shape[1], np.arange(1 << sets.shape[1])
        if len(expected):
            local = most_frequent(np.bincount(patterns, probability, n_patterns).astype(np.float64))
        total, column, of_records = np.zeros(expected.shape), column_of(local, n_patterns), []
        for s, n in enumerate(n_records):
            share = np.zeros((n, len(local)), order="F")
            k = np.flatnonzero(sets[:, s] != ABSENT)
            if len(total):
                total[:, s] = np.bincount(patterns[k], probability[k], n_patterns)
            k = k[column[patterns[k]] != ABSENT]
            np.add.at(share, (sets[k, s], column[patterns[k]]), probability[k])
            of_records.append(np.minimum(share, 1.0, out=share))
        return cls(local, of_records, total, expected)


@dataclass(frozen=True)
class PatternDensities:
    """ln of the density of the objects of each pattern, per arcsec², at the records of S catalogues.

    column : (2^S,) column of the patterns with local shares, ABSENT for the others. local : per catalogue (n, m) at its
    records, −∞ for patterns without the catalogue. of_records : per catalogue (n, S) ln of the density of the records
    of every catalogue, and log_share : (2^S, S) ln of the share of each pattern in the records of every catalogue; both
    empty if all patterns have local shares.
    """

    column: IntArray
    local: tuple[FloatArray, ...]
    of_records: tuple[FloatArray, ...]
    log_share: FloatArray

    @classmethod
    def of(cls, coverages: Coverages, shares: PatternShares) -> PatternDensities:
        """The densities by the records' probabilities of the patterns."""
        by_source = [_covered(coverages, s, len(shares.of_records)) for s in range(len(shares.of_records))]
        local = _local(coverages, shares, by_source)
        column = column_of(shares.local, 1 << len(local))
        if not len(shares.total):
            return cls(column, local, (), np.empty((0, len(local))))
        covered = np.column_stack([_n_covered(mask) for mask in by_source])
        share = (shares.total + EXPECTED_RECORDS * shares.expected) / (covered + EXPECTED_RECORDS)
        of_records = _of_records(coverages, [len(each) for each in shares.of_records])
        return cls(column, local, of_records, np.log(np.clip(share, MIN_SHARE, 1.0)))

    def at(self, s: int, records: IntArray, patterns: IntArray) -> FloatArray:
        """(k,) at records of catalogue s, each for a pattern that contains it."""
        column = self.column[patterns]
        out = self.local[s][records, column]
        rare = np.flatnonzero(column == ABSENT)
        if len(rare):
            within = patterns[rare, None] >> np.arange(len(self.local)) & 1
            by_source = self.of_records[s][records[rare]] + self.log_share[patterns[rare]]
            out[rare] = np.where(within, by_source, 0.0).sum(axis=1) / within.sum(axis=1)
        return np.asarray(out)


def most_frequent(number: FloatArray) -> IntArray:
    """The :data:`MOST_LOCAL` patterns of most objects, ascending, with all of one catalogue; number : (2^S,)."""
    n_sources = len(number).bit_length() - 1
    ranked = number.copy()
    ranked[1 << np.arange(n_sources)] = np.inf
    return np.sort(np.argsort(-ranked, kind="stable")[:MOST_LOCAL])


def column_of(local: IntArray, n_patterns: int) -> IntArray:
    """(patterns,) the place of each pattern in ``local``, ABSENT for none."""
    column = np.full(n_patterns, ABSENT)
    column[local] = np.arange(len(local))
    return column


def _expected_total(p_partner: Mapping[tuple[int, int], FloatArray], s: int, n_sources: int) -> FloatArray:
    """(2^S,) expected number of the records of catalogue s in each pattern."""
    others = [t for t in range(n_sources) if t != s]
    n = len(p_partner[s, others[0]])
    some = np.unique(np.linspace(0, n - 1, min(n, EXPECTED_FROM)).astype(np.int64)) if n else np.empty(0, np.int64)
    p = np.clip(np.column_stack([p_partner[s, t][some] for t in others]), _LEAST_P, 1.0 - _LEAST_P)
    patterns = np.arange(1 << n_sources)
    patterns = patterns[patterns >> s & 1 == 1]
    within = (patterns >> np.array(others)[:, None] & 1).astype(np.float64)
    total = np.zeros(1 << n_sources)
    for low in range(0, len(some), 1000):
        chunk = p[low : low + 1000]
        log_p = np.log1p(-chunk).sum(axis=1)[:, None] + (np.log(chunk) - np.log1p(-chunk)) @ within
        total[patterns] += np.exp(log_p).sum(axis=0)
    return np.asarray(total * (n / max(len(some), 1)))


def _local(coverages: Coverages, shares: PatternShares, by_source: Sequence[BoolArray]) -> tuple[FloatArray, ...]:
    """Per catalogue (n, m) ln of the density of objects of the patterns with local shares at its records.

    The arrays are large and taken by columns, hence in Fortran order and in place.
    """
    n_sources = len(shares.of_records)
    total = [np.zeros(share.shape, order="F") for share in shares.of_records]
    for s, k, densities in _densities(coverages, shares, by_source):
        for t, density, share in densities:
            if int(shares.local[k]) >> t & 1:
                # A catalogue's own records are in n − 1 coverages, those of another in one.
                weight = 1.0 / (n_sources - 1) if t == s else 1.0
                total[t][:, k] += weight * np.log(density * np.maximum(share, MIN_SHARE))
    sizes = np.array([max(pattern.bit_count(), 1) for pattern in shares.local.tolist()])
    for s, column in enumerate(total):
        column /= sizes
        column[:, shares.local >> s & 1 == 0] = -np.inf
    return tuple(total)


def _densities(
    coverages: Coverages, shares: PatternShares, by_source: Sequence[BoolArray]
) -> Iterator[tuple[int, int, Iterable[tuple[int, FloatArray, FloatArray]]]]:
    """For each catalogue and each of its patterns, by each of its coverages: the two catalogues of the coverage, the
    density of the first's records at the records of both, and the share of the pattern in it."""
    for pair, coverage in coverages.items():
        for side, s in enumerate(pair, start=1):
            everywhere = np.ones(len(shares.of_records[s]))
            density, is_everywhere = coverage.density(side, everywhere), bool(by_source[s].all())
            for k, pattern in enumerate(shares.local.tolist()):
                if pattern >> s & 1:
                    within = [t for t in range(len(by_source)) if pattern >> t & 1]
                    weights = everywhere if is_everywhere else _ones_where(by_source[s][:, within])
                    part = shares.of_records[s][:, k] * weights
                    share = share_of_source(coverage, side, part, weights, MIN_SHARE)
                    yield s, k, zip(pair, density, share, strict=True)


def _ones_where(masks: BoolArray) -> FloatArray:
    """(n,) 1 where all masks (n, m) are set, else 0."""
    return np.asarray(masks.all(axis=1), np.float64)


def _of_records(coverages: Coverages, n_records: Sequence[int]) -> tuple[FloatArray, ...]:
    """Per catalogue (n, S) ln of the density of the records of every catalogue at its records."""
    n_sources = len(n_records)
    total = [np.zeros((n, n_sources)) for n in n_records]
    for pair, coverage in coverages.items():
        for side, s in enumerate(pair, start=1):
            for t, density in zip(pair, coverage.density(side, np.ones(n_records[s])), strict=True):
                total[t][:, s] += np.log(density) / (n_sources - 1 if t == s else 1)
    return tuple(total)


def share_of_source(
    coverage: Coverage, side: int, part: FloatArray, weights: FloatArray, min_share: float
) -> tuple[FloatArray, FloatArray]:
    """Local share Σ part / Σ weights at the records of both, arrays of no dimension where it is the same everywhere.

    It is a mean of the records' values and of that of the field. So it is that of the field without any record, and at
    most ``min_share`` if they all are: of most combinations of catalogues whose areas do not all overlap.
    """
    field = (float(part.sum()) + 0.5) / (float(weights.sum()) + 1.0)
    if not weights.any() or max(field, float(part.max(initial=0.0))) <= min_share:
        return np.array(field), np.array(field)
    return local_share(coverage.levels, side, part, weights, pseudo_count=SHARED_PSEUDO_COUNT)


def _covered(coverages: Coverages, s: int, n_sources: int) -> BoolArray:
    """(n, S) mask of the records of s in the footprint of each catalogue."""
    masks = {b if s == a else a: each.covered[0 if s == a else 1] for (a, b), each in coverages.items() if s in (a, b)}
    own = np.ones(len(next(iter(masks.values()))), bool)
    return np.column_stack([masks.get(t, own) for t in range(n_sources)])


def _n_covered(by_source: BoolArray) -> FloatArray:
    """(2^S,) number of records in the footprint of all catalogues of each pattern; by_source : (n, S)."""
    n_sources = by_source.shape[1]
    seen, number = np.unique(by_source @ (1 << np.arange(n_sources)), return_counts=True)
    total = np.zeros(1 << n_sources)
    for one, count in zip(seen.tolist(), number.tolist(), strict=True):
        total[np.arange(len(total)) & ~one == 0] += count
    return total

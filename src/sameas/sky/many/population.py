"""The population: how densely objects lie that exactly these catalogues show, and how their residuals spread.

A *pattern* is a set of catalogues, one bit for each. Of every pattern the data tell the local density of its objects
and the spread of the residuals about the quoted errors; nothing is assumed of how catalogues miss objects, as they miss
the faint ones together. A set of records of pattern A weighs

    ln w = ln J + mean over its records of ln ρ_A − Σ over its records of ln ρ_alone,

ρ at the records' places, J spread as ``Errors`` of A say about the quoted errors. For two catalogues that is
``PoissonField``, its densities and errors estimated as :mod:`sameas.estimate` does, by the same cells and shares.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.estimate.coverage import Coverage, local_share
from sameas.estimate.em import FEWEST, LEAST_SHARE, THINKABLE
from sameas.estimate.error_scales import fit_errors
from sameas.evidence import Errors

Coverages = Mapping[tuple[int, int], Coverage]
#: Sets less probable than this say nothing of the errors; none is taken to be more probable than the other number.
UNLIKELY, SUREST = 1e-3, 1.0 - 1e-9


@dataclass(frozen=True)
class Population:
    """What is believed of the objects of every pattern.

    log_density : per catalogue (n, 2^S) ln of the density of objects of each pattern at its records, per arcsec²;
        −∞ for patterns without the catalogue. spread : by pattern. learns_errors : whether spreads are estimated.
    """

    log_density: tuple[FloatArray, ...]
    spread: Mapping[int, Errors]
    learns_errors: bool = True

    def log_spread(self, patterns: IntArray, chi_sq: FloatArray) -> FloatArray:
        """(k,) what replaces −½ χ² of one normal for sets of these patterns."""
        out = np.zeros(len(patterns))
        for pattern, here in self._several(patterns):
            out[here] = self.spread[pattern].log_profile(chi_sq[here], freedom(pattern))
        return out

    def scale_sq(self, patterns: IntArray, chi_sq: FloatArray) -> FloatArray:
        """(k,) the expected square of the factor on the quoted errors of sets of these patterns; 1 for one record."""
        out = np.ones(len(patterns))
        for pattern, here in self._several(patterns):
            errors, d = self.spread[pattern], freedom(pattern)
            # ∫ scale² is the profile of two degrees of freedom less.
            mean = errors.log_profile(chi_sq[here], d - 2) - errors.log_profile(chi_sq[here], d)
            out[here] = np.exp(mean)
        return out

    def _several(self, patterns: IntArray) -> Iterator[tuple[int, IntArray]]:
        for pattern in np.unique(patterns).tolist():
            if pattern.bit_count() > 1:
                yield pattern, np.flatnonzero(patterns == pattern)

    def log_together(self, sets: IntArray, patterns: IntArray) -> FloatArray:
        """(k,) the mean ln ρ of the pattern of sets (k, S) at their records."""
        total = np.zeros(len(sets))
        for s, density in enumerate(self.log_density):
            k = np.flatnonzero(sets[:, s] >= 0)
            total[k] += density[sets[k, s], patterns[k]]
        return np.asarray(total / np.count_nonzero(sets >= 0, axis=1))

    def log_alone(self, s: int) -> FloatArray:
        """(n,) ln ρ of the records of catalogue s that no other shows."""
        return self.log_density[s][:, 1 << s]

    def learned(self, sets: IntArray, chi_sq: FloatArray, probability: FloatArray, coverages: Coverages) -> Population:
        """The population of greatest likelihood for sets (k, S) of these probabilities (one step of EM)."""
        patterns = patterns_of(sets)
        shares = []
        for s, density in enumerate(self.log_density):
            share = np.zeros(density.shape)
            k = np.flatnonzero(sets[:, s] >= 0)
            np.add.at(share, (sets[k, s], patterns[k]), probability[k])
            shares.append(np.minimum(share, 1.0))
        spread = self._spread(patterns, chi_sq, probability) if self.learns_errors else self.spread
        return replace(self, log_density=log_densities(coverages, shares), spread=spread)

    def _spread(self, patterns: IntArray, chi_sq: FloatArray, probability: FloatArray) -> dict[int, Errors]:
        spread = dict(self.spread)
        for pattern, errors in self.spread.items():
            here = np.flatnonzero((patterns == pattern) & (probability > UNLIKELY))
            if probability[here].sum() < FEWEST:
                continue
            # What everything but the residuals says of these sets: their odds without the spread that was believed.
            p, d = np.minimum(probability[here], SUREST), freedom(pattern)
            log_odds = np.log(p / (1.0 - p)) - errors.log_profile(chi_sq[here], d)
            # No wider than the catalogues two by two were found to spread: chance fills what lies beyond.
            widest = max(THINKABLE, *(max(self.spread[pair].scales) for pair in pairs_within(pattern)))
            spread[pattern] = fit_errors(chi_sq[here], log_odds, d, errors, widest=widest).errors
        return spread


def first_guess(
    coverages: Coverages, partnered: Mapping[tuple[int, int], FloatArray], spread: Mapping[int, Errors], learns: bool
) -> Population:
    """The population that the catalogues two by two make one believe in, as if they missed objects independently.

    partnered : (n_a,) per catalogues (a, b) the probability that a record of a has a partner in b.
    spread : the errors of every two catalogues, by pattern.
    """
    n_sources = max(b for _, b in coverages) + 1
    shares = []
    for s in range(n_sources):
        others = [t for t in range(n_sources) if t != s]
        share = np.zeros((len(partnered[s, others[0]]), 1 << n_sources))
        for pattern in range(1 << n_sources):
            if pattern >> s & 1:
                parts = (partnered[s, t] if pattern >> t & 1 else 1.0 - partnered[s, t] for t in others)
                share[:, pattern] = np.prod(list(parts), axis=0)
        shares.append(share)
    spreads = dict(spread)
    for pattern in range(1, 1 << n_sources):
        if pattern.bit_count() > 2:
            spreads[pattern] = max((spread[pair] for pair in pairs_within(pattern)), key=lambda e: e.typical_scale)
    return Population(log_densities(coverages, shares), spreads, learns)


def log_densities(coverages: Coverages, shares: Sequence[FloatArray]) -> tuple[FloatArray, ...]:
    """Per catalogue (n, 2^S) ln ρ of every pattern at its records, from every record's share in it.

    ρ_A of a catalogue is the density of its records times their share in A; all catalogues of A count the same objects,
    and the mean of the logarithms favours none. A share is that among records where all of A look.
    """
    n_sources = len(shares)
    total = [np.zeros(share.shape) for share in shares]
    seen = [_seen(coverages, s, shares) for s in range(n_sources)]
    for (a, b), coverage in coverages.items():
        for side, s in ((1, a), (2, b)):
            all_at = coverage.density(side, np.ones(len(shares[s])))
            for pattern in _patterns_with(s, n_sources):
                weights = seen[s][:, pattern].astype(np.float64)
                share_at = local_share(coverage.levels, side, shares[s][:, pattern] * weights, weights)
                for t, density, share in zip((a, b), all_at, share_at, strict=True):
                    if pattern >> t & 1:
                        # Two catalogues share one coverage; a catalogue's own place is in all of its coverages.
                        part = 1.0 / (n_sources - 1) if t == s else 1.0
                        total[t][:, pattern] += part * np.log(density * np.maximum(share, LEAST_SHARE))
    sizes = np.array([max(pattern.bit_count(), 1) for pattern in range(1 << n_sources)])
    out = []
    for s, column in enumerate(total):
        within = np.arange(1 << n_sources) >> s & 1 == 1
        out.append(np.where(within, column / sizes, -np.inf))
    return tuple(out)


def patterns_of(sets: IntArray) -> IntArray:
    """(k,) the pattern of sets (k, S) of records."""
    return (sets >= 0) @ (1 << np.arange(sets.shape[1]))


def freedom(pattern: int) -> int:
    """Degrees of freedom of the χ² of a star seen by the catalogues of a pattern."""
    return 2 * (pattern.bit_count() - 1)


def pairs_within(pattern: int) -> list[int]:
    """The patterns of two catalogues within one of more."""
    within = [s for s in range(pattern.bit_length()) if pattern >> s & 1]
    return [1 << s | 1 << t for s, t in combinations(within, 2)]


def _patterns_with(s: int, n_sources: int) -> list[int]:
    return [pattern for pattern in range(1, 1 << n_sources) if pattern >> s & 1]


def _seen(coverages: Coverages, s: int, shares: Sequence[FloatArray]) -> BoolArray:
    """(n, 2^S) whether all catalogues of a pattern look at the records of s."""
    n_sources = len(shares)
    looks = np.ones((len(shares[s]), n_sources), bool)
    for (a, b), coverage in coverages.items():
        if s in (a, b):
            looks[:, b if s == a else a] = coverage.covered[0 if s == a else 1]
    out = np.zeros(shares[s].shape, bool)
    for pattern in _patterns_with(s, n_sources):
        within = [t for t in range(n_sources) if pattern >> t & 1]
        out[:, pattern] = looks[:, within].all(axis=1)
    return out

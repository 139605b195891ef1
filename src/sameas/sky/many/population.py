"""The population: the density of the objects in exactly certain catalogues, and the scatter of their residuals.

A *pattern* is a set of catalogues, one bit for each. For every pattern the local density of its objects and the scatter
of the residuals about the quoted errors are estimated; misses of the catalogues are not assumed to be independent, as
all miss the faint objects. A set of records of pattern A weighs

    ln w = ln J + mean over its records of ln ρ_A − Σ over its records of ln ρ_alone,

ρ at the records' positions, J with the errors of pattern A. For two catalogues that is ``PoissonField``, with densities
and errors estimated as in :mod:`sameas.estimate`, by the same cells and shares.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.estimate.coverage import Coverage, local_share
from sameas.estimate.em import DEFAULT_EM
from sameas.estimate.error_scales import fit_errors
from sameas.evidence import Errors
from sameas.representation import in_short

Coverages = Mapping[tuple[int, int], Coverage]


@dataclass(frozen=True)
class PopulationTuning:
    """Numbers of the estimate of the population (EM), all chosen.

    Attributes
    ----------
    iterations : at most.
    settled : converged when the expected number of objects of no pattern changes by more than this share of all.
    least_p_set : sets less probable than this are not used for the errors.
    largest_p_set : probabilities are bounded by this, so that their odds are finite.
    """

    iterations: int = 8
    settled: float = 3e-4
    least_p_set: float = 1e-3
    largest_p_set: float = 1.0 - 1e-9


TUNING = PopulationTuning()


@in_short
@dataclass(frozen=True)
class Population:
    """Densities and errors of the objects of every pattern.

    log_density : per catalogue (n, 2^S) ln of the density of objects of each pattern at its records, per arcsec²;
        −∞ for patterns without the catalogue. spread : by pattern. learns_errors : whether spreads are estimated.
    """

    log_density: tuple[FloatArray, ...]
    spread: Mapping[int, Errors]
    learns_errors: bool = True

    def log_spread(self, patterns: IntArray, chi_sq: FloatArray) -> FloatArray:
        """(k,) the term that replaces −½ χ² of one normal for sets of these patterns."""
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

    def learned(
        self,
        sets: IntArray,
        chi_sq: FloatArray,
        probability: FloatArray,
        coverages: Coverages,
        tuning: PopulationTuning = TUNING,
    ) -> Population:
        """The population of greatest likelihood for sets (k, S) of these probabilities (one step of EM)."""
        patterns = patterns_of(sets)
        shares = []
        for s, density in enumerate(self.log_density):
            share = np.zeros(density.shape)
            k = np.flatnonzero(sets[:, s] >= 0)
            np.add.at(share, (sets[k, s], patterns[k]), probability[k])
            shares.append(np.minimum(share, 1.0))
        spread = self._spread(patterns, chi_sq, probability, tuning) if self.learns_errors else self.spread
        return replace(self, log_density=log_densities(coverages, shares), spread=spread)

    def _spread(
        self, patterns: IntArray, chi_sq: FloatArray, probability: FloatArray, tuning: PopulationTuning
    ) -> dict[int, Errors]:
        spread = dict(self.spread)
        for pattern, errors in self.spread.items():
            here = np.flatnonzero((patterns == pattern) & (probability > tuning.least_p_set))
            if probability[here].sum() < DEFAULT_EM.fewest:
                continue
            # The odds of these sets by everything but their residuals.
            p, d = np.minimum(probability[here], tuning.largest_p_set), freedom(pattern)
            log_odds = np.log(p / (1.0 - p)) - errors.log_profile(chi_sq[here], d)
            # Not wider than of the catalogues two by two: chance pairs prevail beyond.
            widest = max(DEFAULT_EM.widest_scale, *(max(self.spread[pair].scales) for pair in pairs_within(pattern)))
            spread[pattern] = fit_errors(chi_sq[here], log_odds, d, errors, widest=widest).errors
        return _beside_others(spread)


def first_guess(
    coverages: Coverages, partnered: Mapping[tuple[int, int], FloatArray], spread: Mapping[int, Errors], learns: bool
) -> Population:
    """The population by the catalogues two by two, as if they missed objects independently; the start of EM.

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
    spreads = _beside_others(spread)
    for pattern in range(1, 1 << n_sources):
        if pattern.bit_count() > 2:
            spreads[pattern] = max((spread[pair] for pair in pairs_within(pattern)), key=lambda e: e.typical_scale)
    return Population(log_densities(coverages, shares), spreads, learns)


def _beside_others(spread: Mapping[int, Errors]) -> dict[int, Errors]:
    """The errors by pattern, those of two catalogues no smaller than quoted where both have larger ones with others.

    Such catalogues have errors in common: one took its positions from the other. One spread tells all residuals of a
    set of more, so that the density of two that nearly coincide would tear them from the rest.
    """
    pairs = {pattern: errors.typical_scale for pattern, errors in spread.items() if pattern.bit_count() == 2}
    out = dict(spread)
    for pattern, scale in pairs.items():
        least = min((each for other, each in pairs.items() if (other & pattern).bit_count() == 1), default=scale)
        least = min(least, 1.0)
        if scale < least:
            errors = spread[pattern]
            out[pattern] = replace(errors, scales=tuple(max(each, least) for each in errors.scales))
    return out


def log_densities(coverages: Coverages, shares: Sequence[FloatArray]) -> tuple[FloatArray, ...]:
    """Per catalogue (n, 2^S) ln ρ of every pattern at its records, from every record's share in it.

    ρ_A of a catalogue is the density of its records times their share in A; all catalogues of A count the same objects,
    and the mean of the logarithms favours none. Shares are among the records in the footprint of all of A.
    """
    n_sources = len(shares)
    total = [np.zeros(share.shape) for share in shares]
    covered = [_covered(coverages, s, shares) for s in range(n_sources)]
    for (a, b), coverage in coverages.items():
        for side, s in ((1, a), (2, b)):
            all_at = coverage.density(side, np.ones(len(shares[s])))
            for pattern in _patterns_with(s, n_sources):
                weights = covered[s][:, pattern].astype(np.float64)
                share_at = local_share(coverage.levels, side, shares[s][:, pattern] * weights, weights)
                for t, density, share in zip((a, b), all_at, share_at, strict=True):
                    if pattern >> t & 1:
                        # A catalogue's own records are in all of its coverages, those of another in one.
                        part = 1.0 / (n_sources - 1) if t == s else 1.0
                        total[t][:, pattern] += part * np.log(density * np.maximum(share, DEFAULT_EM.least_share))
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
    """Degrees of freedom of the χ² of a star in the catalogues of a pattern."""
    return 2 * (pattern.bit_count() - 1)


def pairs_within(pattern: int) -> list[int]:
    """The patterns of two catalogues within one of more."""
    within = [s for s in range(pattern.bit_length()) if pattern >> s & 1]
    return [1 << s | 1 << t for s, t in combinations(within, 2)]


def _patterns_with(s: int, n_sources: int) -> list[int]:
    return [pattern for pattern in range(1, 1 << n_sources) if pattern >> s & 1]


def _covered(coverages: Coverages, s: int, shares: Sequence[FloatArray]) -> BoolArray:
    """(n, 2^S) whether the records of s lie in the footprint of all catalogues of a pattern."""
    n_sources = len(shares)
    by_source = np.ones((len(shares[s]), n_sources), bool)
    for (a, b), coverage in coverages.items():
        if s in (a, b):
            by_source[:, b if s == a else a] = coverage.covered[0 if s == a else 1]
    out = np.zeros(shares[s].shape, bool)
    for pattern in _patterns_with(s, n_sources):
        within = [t for t in range(n_sources) if pattern >> t & 1]
        out[:, pattern] = by_source[:, within].all(axis=1)
    return out

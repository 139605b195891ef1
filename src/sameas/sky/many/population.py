"""The population: the density of the objects in exactly certain catalogues, and the scatter of their residuals.

A *pattern* is a set of catalogues, one bit for each. For every pattern the local density of its objects and the scatter
of the residuals about the quoted errors are estimated; misses of the catalogues are not assumed to be independent, as
all miss the faint objects. A set of records of pattern A weighs

    ln w = ln J + mean over its records of ln ρ_A − Σ over its records of ln ρ_alone,

ρ at the records' positions, J with the errors of pattern A. For two catalogues that is ``PoissonField``, with densities
and errors estimated as in :mod:`sameas.estimate`, by the same cells and shares.

The position and motion of one star come from several catalogues, each at its own epoch (:func:`fitted`). A star is at x
at a reference epoch T and moves by v. A record of epoch t without a motion measures z = x + (t − T) v; one with a
motion measures both, x and v, carried to T. With Λ, η and χ² summed over the records of a set as in
:mod:`sameas.many.joint`, on the tangent plane at the set's first record, the density of their positions is

    ln J = Σ ln norm + 2 ln 2π − ½ ln|Λ| − ½ χ²,

less the same of the motions alone where two records or more have one: the density is that of the positions, given one
motion, as in :func:`sameas.sky.crossmatch.match`. Where no record of a set has a motion, v is normal about 0 with the
standard deviation that the catalogues were given for unknown motions. So a star of large motion is identified in
catalogues without motions wherever one catalogue has it, in both directions of time; a common epoch cannot do that.
For two catalogues J is the density of the residual at the common epoch.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.estimate.coverage import Coverage, local_share
from sameas.estimate.em import DEFAULT_EM
from sameas.estimate.error_model import fit_errors
from sameas.evidence import Errors
from sameas.gaussian import LOG_2PI, InformationSum, inverse, log_density, propagated
from sameas.many.joint import NO_RECORD
from sameas.records import Records
from sameas.representation import in_short
from sameas.sky import column_values
from sameas.sky.catalogue import Catalogue
from sameas.sky.motion import propagate
from sameas.space import displaced, on_axes_of

#: Sets worked on at a time, which bounds the memory.
CHUNK = 100_000
#: Stands for the unknown motion of records at the reference epoch, whose position it does not change.
_STILL_ARCSEC_PER_YR = 1.0
#: Position and proper motion among the six parameters of an :class:`~sameas.sky.motion.Astrometry`.
_PLACE_AND_MOTION = np.array([0, 1, 3, 4])


@in_short
@dataclass(frozen=True)
class AstrometricRecords:
    """Position and motion of one catalogue's usable records; lengths in arcsec, times in years, axes east, north.

    Attributes
    ----------
    direction : (n, 2) right ascension and declination, degrees: at the reference epoch where the motion is known, at
        the record's own epoch where not.
    motion : (n, 2) proper motion, 0 where it is not known.
    precision : (n, 4, 4) of (position, motion) at the reference epoch. log_norm : (n,) ln of their normal's factor.
    moving : (n,) whether the motion is known.
    motion_precision : (n, 2, 2), 0 where it is not known. motion_log_norm : (n,) the same of the motion alone.
    unknown_motion : (n,) standard deviation of a motion that is not known.
    """

    direction: FloatArray
    motion: FloatArray
    precision: FloatArray
    log_norm: FloatArray
    moving: BoolArray
    motion_precision: FloatArray
    motion_log_norm: FloatArray
    unknown_motion: FloatArray

    def __len__(self) -> int:
        return len(self.direction)

    def at(self, rows: IntArray) -> AstrometricRecords:
        """Some of the records."""
        return AstrometricRecords(**{name: values[rows] for name, values in vars(self).items()})

    @classmethod
    def of(cls, catalogue: Catalogue, records: Records, epoch_jyr: float | None) -> AstrometricRecords:
        """The ``records`` of a catalogue; ``epoch_jyr`` is None where nothing moves."""
        part = catalogue.astrometry[records.rows]
        covariance = 1e-6 * part.covariance[:, :2, :2]
        direction, motion = np.column_stack([part.ra_deg, part.dec_deg]), np.zeros((len(records), 2))
        span = np.zeros(len(records)) if epoch_jyr is None else part.epoch_jyr - epoch_jyr
        precision_2 = inverse(covariance)
        # z = (1, span) (x, v)
        precision = np.empty((len(records), 4, 4))
        precision[:, :2, :2] = precision_2
        precision[:, :2, 2:] = precision[:, 2:, :2] = span[:, None, None] * precision_2
        precision[:, 2:, 2:] = span[:, None, None] ** 2 * precision_2
        log_norm = _log_norm(covariance)
        moving = np.zeros(len(records), bool) if epoch_jyr is None else moving_rows(catalogue)[records.rows]
        motion_precision, motion_log_norm = np.zeros((len(records), 2, 2)), np.zeros(len(records))
        k = np.flatnonzero(moving)
        if len(k):
            carried = propagate(part[k], float(epoch_jyr or 0.0))
            both = 1e-6 * carried.covariance[:, _PLACE_AND_MOTION[:, None], _PLACE_AND_MOTION]
            direction[k] = np.column_stack([carried.ra_deg, carried.dec_deg])
            motion[k] = 1e-3 * np.column_stack([carried.pm_ra_mas_per_yr, carried.pm_dec_mas_per_yr])
            precision[k], log_norm[k] = inverse(both), _log_norm(both)
            alone = both[:, 2:, 2:]
            motion_precision[k], motion_log_norm[k] = inverse(alone), _log_norm(alone)
        unknown = 1e-3 * np.sqrt(part.covariance[:, 3, 3])
        unknown = np.where(moving | (unknown <= 0.0) | (epoch_jyr is None), _STILL_ARCSEC_PER_YR, unknown)
        return cls(direction, motion, precision, log_norm, moving, motion_precision, motion_log_norm, unknown)


class AstrometricFit(NamedTuple):
    """Per set (k,): ``log_peak`` ln J without its −½ χ², ``chi_sq`` χ² of 2 (size − 1) degrees of freedom.

    direction, motion : (k, 2) of the star at the reference epoch. covariance : (k, 4, 4) of both.
    has_residual : whether χ² is one of errors; where no record has a motion and their epochs differ, it is one of
        motions.
    """

    log_peak: FloatArray
    chi_sq: FloatArray
    direction: FloatArray
    motion: FloatArray
    covariance: FloatArray
    has_residual: BoolArray


def fitted(astrometric: tuple[AstrometricRecords, ...], sets: NDArray[np.integer]) -> AstrometricFit:
    """The star of each of the ``sets`` (k, catalogues) of positions of records, NO_RECORD for none; none is empty."""
    parts = [_fitted(astrometric, sets[low : low + CHUNK]) for low in range(0, max(len(sets), 1), CHUNK)]
    return (
        parts[0]
        if len(parts) == 1
        else AstrometricFit(*(np.concatenate(column) for column in zip(*parts, strict=True)))
    )


def _fitted(astrometric: tuple[AstrometricRecords, ...], sets: NDArray[np.integer]) -> AstrometricFit:
    anchor = _anchors(astrometric, sets)
    whole, motions = InformationSum.of(len(sets), 4), InformationSum.of(len(sets), 2)
    moving, spread = np.zeros(len(sets), np.int64), np.zeros(len(sets))
    for s, catalogue in enumerate(astrometric):
        k = np.flatnonzero(sets[:, s] != NO_RECORD)
        members = catalogue.at(sets[k, s])
        offset, rotation = on_axes_of(anchor[k], members.direction)
        velocity = np.einsum("kvw,kw->kv", rotation, members.motion)
        axes = np.zeros((len(k), 4, 4))
        axes[:, :2, :2] = axes[:, 2:, 2:] = rotation
        whole.add(k, np.column_stack([offset, velocity]), propagated(axes, members.precision), members.log_norm)
        motions.add(k, velocity, propagated(rotation, members.motion_precision), members.motion_log_norm)
        moving[k] += members.moving
        spread[k] = np.maximum(spread[k], np.where(members.moving, 0.0, members.unknown_motion))
    still = np.flatnonzero(moving == 0)
    open_motion = np.zeros((len(still), 4, 4))
    open_motion[:, [2, 3], [2, 3]] = 1.0 / spread[still, None] ** 2
    whole.add(still, np.zeros((len(still), 4)), open_motion, -LOG_2PI - 2.0 * np.log(spread[still]))
    log_peak, star = whole.log_peak(), whole.gaussian()
    chi_sq = whole.chi_sq(star)
    has_residual = (moving > 0) | ~whole.information[:, :2, 2:].any(axis=(1, 2))
    several = np.flatnonzero(moving > 1)
    if len(several):
        known = motions.at(several)
        log_peak[several] -= known.log_peak()
        chi_sq[several] -= known.chi_sq(known.gaussian())
    return AstrometricFit(
        log_peak,
        np.maximum(chi_sq, 0.0),
        displaced(anchor, star.mean[:, :2]),
        star.mean[:, 2:],
        star.covariance,
        has_residual,
    )


def _anchors(astrometric: tuple[AstrometricRecords, ...], sets: NDArray[np.integer]) -> FloatArray:
    """(k, 2) the direction of each set's first record."""
    at = np.full((len(sets), 2), np.nan)
    for s in reversed(range(len(astrometric))):
        here = sets[:, s] != NO_RECORD
        at[here] = astrometric[s].direction[sets[here, s]]
    return at


def _log_norm(covariance: FloatArray) -> FloatArray:
    return log_density(np.zeros(covariance.shape[1]), covariance)


def moving_rows(catalogue: Catalogue) -> BoolArray:
    """(n,) the rows of the table that have a proper motion."""
    known = np.ones(len(catalogue), bool)
    for column in catalogue.choice.motion[1:3]:
        if column is None:
            return np.zeros(len(catalogue), bool)
        known &= np.isfinite(column_values.numbers(catalogue.table, column.name, catalogue.name))
    return known


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
            if probability[here].sum() < DEFAULT_EM.min_pairs:
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

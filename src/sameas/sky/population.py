"""The population: densities of the objects by pattern of catalogues, and the errors of their residuals.

For each pattern of catalogues (:mod:`sameas.sky.pattern_densities`) the density of its objects and the scale of the
residuals are estimated; non-detections in different catalogues are not assumed independent, as all miss the faint
objects. The log weight of a set of records of pattern A is

    ln w = ln J + mean over its records of ln ρ_A − Σ over its records of ln ρ_alone,

with ρ at the records' positions and J with the errors of pattern A. For two catalogues this is ``PoissonField``, with
densities and errors estimated as in :mod:`sameas.estimate`, by the same cells and shares.

The position and motion of a star are fitted to records at different epochs (:func:`fitted`). A star is at x at a
reference epoch T and moves by v. A record of epoch t without a motion measures z = x + (t − T) v; one with a motion
measures x and v, propagated to T. With Λ, η and χ² summed over the records of a set as in
:mod:`sameas.many.observations`, on the tangent plane at the set's first record, the density of their positions is

    ln J = Σ ln norm + 2 ln 2π − ½ ln|Λ| − ½ χ²,

minus the same of the motions alone if two or more records have one: J is the density of the positions given a common
motion, as in :func:`sameas.sky.crossmatch.match`. If no record of a set has a motion, v is normal about 0 with the
catalogues' standard deviation of unknown motions. A fast star is thus identified in catalogues without motions if any
catalogue has its motion, before and after its epoch; a common epoch cannot do this. For two catalogues J is the density
of the residual at the common epoch.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import ABSENT, BoolArray, FloatArray, IntArray
from sameas.estimate.em import MIN_LARGEST_SCALE, MIN_PAIRS_TO_LEARN
from sameas.estimate.error_scales import fit_errors
from sameas.evidence import Errors
from sameas.gaussian import LOG_2PI, InformationSum, inverse, log_density, propagated
from sameas.kernels import threads
from sameas.records import Records
from sameas.sky import column_values
from sameas.sky.catalogue import Catalogue
from sameas.sky.motion import propagate
from sameas.sky.pattern_densities import Coverages, PatternDensities, PatternShares
from sameas.space import displaced, on_axes_of

#: Sets per chunk, which bounds the memory.
CHUNK = 100_000
#: Prior error of unknown motions where it does not matter: at the reference epoch, or without motions.
_ANY_ARCSEC_PER_YR = 1.0
#: Indices of position and proper motion in the six parameters of an :class:`~sameas.sky.motion.Astrometry`.
_POSITION_AND_MOTION = np.array([0, 1, 3, 4])


@dataclass(frozen=True)
class AstrometricRecords:
    """Position and motion of one catalogue's usable records; lengths in arcsec, times in years, axes east, north.

    direction : (n, 2) right ascension and declination, degrees: at the reference epoch if the motion is known, else at
        the record's own epoch.
    motion : (n, 2) proper motion, 0 where not known.
    precision : (n, 4, 4) of (position, motion) at the reference epoch. log_norm : (n,) ln of the normalisation.
    moving : (n,) mask of known motions.
    motion_precision : (n, 2, 2), 0 where not known. motion_log_norm : (n,) the same for the motion alone.
    unknown_motion : (n,) standard deviation of an unknown motion.
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

    @classmethod
    def of(cls, catalogue: Catalogue, records: Records, epoch_jyr: float | None) -> AstrometricRecords:
        """The ``records`` of a catalogue. epoch_jyr : reference epoch, None if positions are not moved."""
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
            at_epoch = propagate(part[k], float(epoch_jyr or 0.0))
            covariance_4 = 1e-6 * at_epoch.covariance[:, _POSITION_AND_MOTION[:, None], _POSITION_AND_MOTION]
            direction[k] = np.column_stack([at_epoch.ra_deg, at_epoch.dec_deg])
            motion[k] = at_epoch.motion_arcsec_per_yr
            precision[k], log_norm[k] = inverse(covariance_4), _log_norm(covariance_4)
            of_motion = covariance_4[:, 2:, 2:]
            motion_precision[k], motion_log_norm[k] = inverse(of_motion), _log_norm(of_motion)
        unknown = 1e-3 * np.sqrt(part.covariance[:, 3, 3])
        unknown = np.where(moving | (unknown <= 0.0) | (epoch_jyr is None), _ANY_ARCSEC_PER_YR, unknown)
        return cls(direction, motion, precision, log_norm, moving, motion_precision, motion_log_norm, unknown)


class AstrometricFit(NamedTuple):
    """Fit of each set (k,): ``log_peak`` ln J without −½ χ², ``chi_sq`` χ² with 2 (size − 1) degrees of freedom.

    direction, motion : (k, 2) of the star at the reference epoch. covariance : (k, 4, 4) of both.
    has_residual : whether χ² measures errors; it measures motions if no record has one and the epochs differ.
    """

    log_peak: FloatArray
    chi_sq: FloatArray
    direction: FloatArray
    motion: FloatArray
    covariance: FloatArray
    has_residual: BoolArray


def fitted(astrometric: tuple[AstrometricRecords, ...], sets: NDArray[np.integer]) -> AstrometricFit:
    """The star fitted to each of the ``sets`` (k, catalogues), indices of records or ABSENT; no set is empty."""
    chunks = [sets[low : low + CHUNK] for low in range(0, max(len(sets), 1), CHUNK)]
    parts = threads.each([partial(_fitted, astrometric, chunk) for chunk in chunks], len(sets))
    return (
        parts[0]
        if len(parts) == 1
        else AstrometricFit(*(np.concatenate(column) for column in zip(*parts, strict=True)))
    )


def _fitted(astrometric: tuple[AstrometricRecords, ...], sets: NDArray[np.integer]) -> AstrometricFit:
    anchor = _anchors(astrometric, sets)
    all_terms, motion_terms = InformationSum.of(len(sets), 4), InformationSum.of(len(sets), 2)
    moving, unknown_motion = np.zeros(len(sets), np.int64), np.zeros(len(sets))
    for s, catalogue in enumerate(astrometric):
        k = np.flatnonzero(sets[:, s] != ABSENT)
        rows = sets[k, s]
        offset, rotation = on_axes_of(anchor[k], catalogue.direction[rows])
        axes, residual = np.zeros((len(k), 4, 4)), np.zeros((len(k), 4))
        axes[:, :2, :2] = axes[:, 2:, 2:] = rotation
        residual[:, :2] = offset
        is_moving = catalogue.moving[rows]
        if is_moving.any():
            residual[:, 2:] = np.einsum("kvw,kw->kv", rotation, catalogue.motion[rows])
            motion_terms.add(
                k,
                residual[:, 2:],
                propagated(rotation, catalogue.motion_precision[rows]),
                catalogue.motion_log_norm[rows],
            )
        all_terms.add(k, residual, propagated(axes, catalogue.precision[rows]), catalogue.log_norm[rows])
        moving[k] += is_moving
        unknown_motion[k] = np.maximum(unknown_motion[k], np.where(is_moving, 0.0, catalogue.unknown_motion[rows]))
    without_motion = np.flatnonzero(moving == 0)
    prior_precision = np.zeros((len(without_motion), 4, 4))
    prior_precision[:, [2, 3], [2, 3]] = 1.0 / unknown_motion[without_motion, None] ** 2
    all_terms.add(
        without_motion,
        np.zeros((len(without_motion), 4)),
        prior_precision,
        -LOG_2PI - 2.0 * np.log(unknown_motion[without_motion]),
    )
    log_peak, star = all_terms.log_peak(), all_terms.gaussian()
    chi_sq = all_terms.chi_sq(star)
    has_residual = (moving > 0) | ~all_terms.information[:, :2, 2:].any(axis=(1, 2))
    several = np.flatnonzero(moving > 1)
    if len(several):
        motion = motion_terms.at(several)
        log_peak[several] -= motion.log_peak()
        chi_sq[several] -= motion.chi_sq(motion.gaussian())
    return AstrometricFit(
        log_peak,
        np.maximum(chi_sq, 0.0),
        displaced(anchor, star.mean[:, :2]),
        star.mean[:, 2:],
        star.covariance,
        has_residual,
    )


def _anchors(astrometric: tuple[AstrometricRecords, ...], sets: NDArray[np.integer]) -> FloatArray:
    """(k, 2) direction of the first record of each set."""
    direction = np.full((len(sets), 2), np.nan)
    for s in reversed(range(len(astrometric))):
        present = sets[:, s] != ABSENT
        direction[present] = astrometric[s].direction[sets[present, s]]
    return direction


def _log_norm(covariance: FloatArray) -> FloatArray:
    return log_density(np.zeros(covariance.shape[1]), covariance)


def moving_rows(catalogue: Catalogue) -> BoolArray:
    """(n,) mask of the table's rows with a proper motion."""
    known = np.ones(len(catalogue), bool)
    for column in catalogue.choice.motion[1:3]:
        if column is None:
            return np.zeros(len(catalogue), bool)
        known &= np.isfinite(column_values.numbers(catalogue.table, column.name, catalogue.name))
    return known


POPULATION_ITERATIONS = 8  # maximum number
#: Maximum change of the expected number of objects of a pattern at convergence, as a share of all.
CONVERGED_SHARE = 3e-4
MIN_P_SET = 1e-3  # minimum probability of a set used for the errors
LARGEST_P_SET = 1.0 - 1e-9  # maximum probability of a set, to keep its odds finite


@dataclass(frozen=True)
class Population:
    """Densities and errors of the objects by pattern.

    densities : of the objects of each pattern. expected : (2^S, S) shares of :class:`PatternShares`. errors : mixtures
        of error factors, by pattern. estimates_errors : whether EM updates the errors.
    """

    densities: PatternDensities
    expected: FloatArray
    errors: Mapping[int, Errors]
    estimates_errors: bool = True

    def log_profile(self, patterns: IntArray, chi_sq: FloatArray) -> FloatArray:
        """(k,) the term that replaces −½ χ² of a single normal, for sets of these patterns."""
        out = np.zeros(len(patterns))
        for pattern, rows in self._several(patterns):
            out[rows] = self.errors[pattern].log_profile(chi_sq[rows], degrees_of_freedom(pattern))
        return out

    def scale_sq(self, patterns: IntArray, chi_sq: FloatArray) -> FloatArray:
        """(k,) expected square of the factor on the quoted errors, for sets of these patterns; 1 for single records."""
        out = np.ones(len(patterns))
        for pattern, rows in self._several(patterns):
            errors, d = self.errors[pattern], degrees_of_freedom(pattern)
            # ∫ scale² is the profile with two degrees of freedom less.
            mean = errors.log_profile(chi_sq[rows], d - 2) - errors.log_profile(chi_sq[rows], d)
            out[rows] = np.exp(mean)
        return out

    def _several(self, patterns: IntArray) -> Iterator[tuple[int, IntArray]]:
        """The patterns of two or more catalogues that occur, and their rows."""
        for pattern, rows in rows_by_pattern(patterns):
            if pattern.bit_count() > 1:
                yield pattern, rows

    def mean_log_density(self, sets: IntArray, patterns: IntArray) -> FloatArray:
        """(k,) mean over the records of sets (k, S) of ln ρ of their pattern."""
        total = np.zeros(len(sets))
        for s in range(sets.shape[1]):
            k = np.flatnonzero(sets[:, s] >= 0)
            total[k] += self.densities.at(s, sets[k, s], patterns[k])
        return np.asarray(total / np.count_nonzero(sets >= 0, axis=1))

    def log_alone(self, s: int) -> FloatArray:
        """(n,) ln ρ of objects in catalogue s alone, at its records."""
        return np.asarray(self.densities.local[s][:, self.densities.column[1 << s]])

    def m_step(self, sets: IntArray, chi_sq: FloatArray, probability: FloatArray, coverages: Coverages) -> Population:
        """The maximum-likelihood population given probabilities of sets (k, S) (the M step)."""
        patterns = patterns_of(sets)
        n_records = [len(local) for local in self.densities.local]
        shares = PatternShares.of_sets(sets, patterns, probability, n_records, self.expected)
        errors = self.errors
        if self.estimates_errors:
            errors = self._fitted_errors(patterns, chi_sq, probability)
        return replace(self, densities=PatternDensities.of(coverages, shares), errors=errors)

    def _fitted_errors(self, patterns: IntArray, chi_sq: FloatArray, probability: FloatArray) -> dict[int, Errors]:
        fitted_errors = dict(self.errors)
        likely = np.flatnonzero(probability > MIN_P_SET)
        for pattern, among in rows_by_pattern(patterns[likely]):
            rows = likely[among]
            if pattern.bit_count() < 2 or probability[rows].sum() < MIN_PAIRS_TO_LEARN:
                continue
            errors = self.errors[pattern]
            # The odds of these sets without their residuals.
            p, d = np.minimum(probability[rows], LARGEST_P_SET), degrees_of_freedom(pattern)
            log_odds = np.log(p / (1.0 - p)) - errors.log_profile(chi_sq[rows], d)
            # Not wider than in the pairwise matches: beyond, chance pairs prevail.
            widest = max(MIN_LARGEST_SCALE, *(max(self.errors[pair].scales) for pair in pairs_within(pattern)))
            fitted_errors[pattern] = fit_errors(chi_sq[rows], log_odds, d, errors, widest=widest).errors
        return _with_common_errors(fitted_errors)


def initial_population(
    coverages: Coverages,
    p_partner: Mapping[tuple[int, int], FloatArray],
    errors: Mapping[int, Errors],
    estimates_errors: bool,
) -> Population:
    """The initial population of EM, from the pairwise matches, with independent non-detections.

    p_partner : for catalogues (a, b), (n_a,) the probability that a record of a has a partner in b.
    errors : of every two catalogues, by pattern.
    """
    by_pattern = _with_common_errors(errors)
    widest_first = sorted(errors, key=lambda pair: -errors[pair].typical_scale)
    for pattern in range(1, 1 << max(b for _, b in coverages) + 1):
        if pattern.bit_count() > 2:
            by_pattern[pattern] = errors[next(pair for pair in widest_first if pair & pattern == pair)]
    shares = PatternShares.independent(p_partner)
    densities = PatternDensities.of(coverages, shares)
    return Population(densities, shares.expected, by_pattern, estimates_errors)


def _with_common_errors(by_pattern: Mapping[int, Errors]) -> dict[int, Errors]:
    """The errors by pattern, those of two catalogues raised to the smallest with any other, at most to the quoted ones.

    Such catalogues have errors in common: one took its positions from the other. A larger set has one mixture for all
    its residuals, so the high density of two nearly coincident records would separate them from the rest.
    """
    pairs = {pattern: errors.typical_scale for pattern, errors in by_pattern.items() if pattern.bit_count() == 2}
    out = dict(by_pattern)
    for pattern, scale in pairs.items():
        least = min((each for other, each in pairs.items() if (other & pattern).bit_count() == 1), default=scale)
        least = min(least, 1.0)
        if scale < least:
            errors = by_pattern[pattern]
            out[pattern] = replace(errors, scales=tuple(max(each, least) for each in errors.scales))
    return out


def patterns_of(sets: IntArray) -> IntArray:
    """(k,) patterns of sets (k, S) of records."""
    return (sets >= 0) @ (1 << np.arange(sets.shape[1]))


def rows_by_pattern(patterns: IntArray) -> Iterator[tuple[int, IntArray]]:
    """Each pattern that occurs, ascending, and its rows, ascending."""
    order = np.argsort(patterns, kind="stable")
    different, start = np.unique(patterns[order], return_index=True)
    return zip(different.tolist(), np.split(order, start[1:]), strict=True) if len(order) else iter(())


def degrees_of_freedom(pattern: int) -> int:
    """Degrees of freedom of the χ² of a star with a pattern."""
    return 2 * (pattern.bit_count() - 1)


def pairs_within(pattern: int) -> list[int]:
    """The patterns of two catalogues within a pattern."""
    within = [s for s in range(pattern.bit_length()) if pattern >> s & 1]
    return [1 << s | 1 << t for s, t in combinations(within, 2)]

"""Many catalogues at once: :func:`match_many` finds the objects of two catalogues or more, jointly.

Data flow: catalogues → pairwise crossmatches → candidates → astrometry of each record → candidate sets of one star →
population, estimated together with the probabilities of the sets (:mod:`sameas.sky.population`) → the best
partition into stars. The result does not depend on the order of the catalogues.

>>> import numpy as np
>>> from sameas.sky.catalogue import Catalogue, CatalogueOptions
>>> rng = np.random.default_rng(1)
>>> ra, dec = rng.uniform(10.0, 11.0, 200), rng.uniform(40.0, 41.0, 200)
>>> def observed(name, rows):
...     scatter = 0.1 / 3600.0 * rng.standard_normal((2, len(rows)))
...     positions = {"ra": ra[rows] + scatter[0] / np.cos(np.radians(dec[rows])), "dec": dec[rows] + scatter[1]}
...     return Catalogue.of(positions, name, options=CatalogueOptions(sigma=0.1))
>>> radio, optical = observed("radio", np.arange(150)), observed("optical", np.arange(200))
>>> xray = observed("xray", np.arange(60))
>>> result = match_many([radio, optical, xray])
>>> np.bincount(result.objects.n_members).tolist()
[0, 50, 90, 60]
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from sameas.arrays import ABSENT, BoolArray, FloatArray, IntArray
from sameas.errors import InputError, Message, naming
from sameas.estimate.coverage import Coverage
from sameas.evidence import Errors
from sameas.gate import Pairs
from sameas.gaussian import mahalanobis_sq
from sameas.many.marginals import Answer, answer
from sameas.many.objects import Objects
from sameas.many.observations import Joint, Observers
from sameas.many.pooled import PooledRecords, pooled
from sameas.many.rules import Linear, Terms
from sameas.many.sets import TUNING as TUNING_OF_SETS
from sameas.many.sets import Sets, candidate_sets
from sameas.records import Records
from sameas.representation import counted, in_short
from sameas.sky.catalogue import Catalogue
from sameas.sky.completion import completed
from sameas.sky.crossmatch import MatchOptions, at_common_epoch, by_position
from sameas.sky.crossmatch import match as match_two
from sameas.sky.disjoint import WHETHER_SAME_SKY
from sameas.sky.evidence_columns import AUTO, OFF
from sameas.sky.match_doubts import REMOVE_OFFSET
from sameas.sky.pattern_densities import Coverages
from sameas.sky.population import (
    CONVERGED_SHARE,
    POPULATION_ITERATIONS,
    AstrometricRecords,
    Population,
    fitted,
    initial_population,
    moving_rows,
    patterns_of,
)
from sameas.sky.set_magnitudes import SetMagnitudes
from sameas.sky.sky_match import SkyMatch
from sameas.sky.systematics import Rotation, find_rotation
from sameas.space import sphere_offset

#: Upper bound of a log density that excludes no set: with a motion positions may be far apart.
UNBOUNDED = 1e4
#: Minimum pairwise probability of candidates that imply further ones (chosen).
PLAUSIBLE = 1e-6
#: Maximum number of catalogues: more have too many patterns (chosen).
MAX_CATALOGUES = 12
#: Sets of a group, beyond which it has those near a good partition: nine records of one star have 511 subsets, and the
#: answers of eight catalogues are the same with either.
MAX_SETS = 300
#: Number of catalogues up to which the limits of :func:`sameas.identify_many` hold, as there are few stars (chosen).
FEW_CATALOGUES = 8
#: Minimum time span, years, that determines a motion (chosen).
MIN_SPAN_YR = 0.1


@dataclass(frozen=True)
class StarObservers(Observers):
    """Catalogues as observers of moving stars, for :mod:`sameas.many`; ``sources`` are their pooled records.

    The state of a set: right ascension and declination in degrees at the reference epoch, proper motion east and north
    in arcsec per year, (k, 4); its covariance in arcsec and arcsec per year, scaled by the residuals of its pattern
    where there are any.

    astrometric, population : in the order of the catalogues and their tables. catalogue : (S,) catalogue number of each
    source. index : per source, the indices of its records in the catalogue's records. magnitudes : as evidence; None if
    they are not used.
    """

    astrometric: tuple[AstrometricRecords, ...] = field(kw_only=True)
    population: Population = field(kw_only=True)
    catalogue: tuple[int, ...] = field(kw_only=True)
    index: tuple[IntArray, ...] = field(kw_only=True)
    magnitudes: SetMagnitudes | None = field(kw_only=True, default=None)

    @classmethod
    def of(
        cls,
        pooled: PooledRecords,
        records: Sequence[Records],
        astrometric: tuple[AstrometricRecords, ...],
        population: Population,
        magnitudes: SetMagnitudes | None = None,
    ) -> StarObservers:
        """The observers of the pooled ``records`` of the catalogues."""
        names = [one.source for one in records]
        sources = tuple(source for source in pooled.sources if isinstance(source, Records))
        catalogue = tuple(names.index(source.source) for source in sources)
        index = tuple(indices_among(source, records[c]) for source, c in zip(sources, catalogue, strict=True))
        return cls(
            sources, None, astrometric=astrometric, population=population, catalogue=catalogue, index=index,
            magnitudes=magnitudes,
        )  # fmt: skip

    def by_catalogue(self, sets: NDArray[np.integer]) -> IntArray:
        """Sets (k, sources) of indices in the sources, as (k, catalogues) of indices in the catalogues' records."""
        out = np.full(sets.shape, ABSENT, np.int64)
        for s, c in enumerate(self.catalogue):
            k = np.flatnonzero(sets[:, s] != ABSENT)
            out[k, c] = self.index[s][sets[k, s]]
        return out

    def joint(self, sets: NDArray[np.integer]) -> Joint:
        """Density and state of ``sets`` (k, sources): density of objects of their pattern times that of positions."""
        members = self.by_catalogue(sets)
        fit, patterns = fitted(self.astrometric, members), patterns_of(members)
        log_density = fit.log_peak + self.population.log_profile(patterns, fit.chi_sq)
        several = patterns & (patterns - 1) > 0
        log_density += np.where(several, self.population.mean_log_density(members, patterns), 0.0)
        if self.magnitudes is not None:
            log_density += self.magnitudes(members)
        scale_sq = np.where(fit.has_residual, self.population.scale_sq(patterns, fit.chi_sq), 1.0)
        state = np.column_stack([fit.direction, fit.motion])
        return Joint(log_density, fit.chi_sq, state, scale_sq[:, None, None] * fit.covariance)

    def terms(self, pooled: PooledRecords) -> Terms:
        """The weights of single records as objects."""
        alone = [self.population.log_alone(c)[p] for c, p in zip(self.catalogue, self.index, strict=True)]
        return Terms({"density of lone records": Linear(0.0, -np.concatenate(alone))})

    def log_peak(self, s: int) -> FloatArray:
        """(n,) upper bound on the log density gained by a record of source s."""
        return np.full(len(self.index[s]), UNBOUNDED)


Matches = Mapping[tuple[int, int], SkyMatch]


@dataclass(frozen=True)
class PairwiseGate:
    """Candidate pairs of every two catalogues; a gate for :func:`sameas.many.pooled.pooled`, by the sources' names.

    Every two catalogues are matched first (:func:`sameas.sky.crossmatch.match`), because the residuals determine the
    gate. Fast stars in two catalogues without motions are outside any gate; if a third catalogue has the motion,
    records that are both candidates of one of its moving records are candidates of each other.

    records : of each catalogue. indices : for each two (a < b), indices i (m,) and j (m,) in their records.
    """

    records: tuple[Records, ...]
    indices: Mapping[tuple[int, int], tuple[IntArray, IntArray]]

    @classmethod
    def of(
        cls, matches: Matches, records: Sequence[Records], astrometric: Sequence[AstrometricRecords]
    ) -> PairwiseGate:
        """The candidates of the ``matches`` of every two catalogues, and those implied by moving stars."""
        links = {}
        for (a, b), match in matches.items():
            i, j, p = candidate_indices(match, records[a], records[b])
            links[a, b] = csr_array((p + 1.0, (i, j)), shape=(len(records[a]), len(records[b])))
        candidates = {}
        for a, b in combinations(range(len(records)), 2):
            link = links[a, b]
            for c in range(len(records)):
                if c in (a, b) or not astrometric[c].moving.any():
                    continue
                to_third, from_third = _plausible(links, a, c), _plausible(links, c, b)
                link = link + (to_third * astrometric[c].moving.astype(np.float64)) @ from_third
            pairs = csr_array(link).tocoo()
            candidates[a, b] = pairs.row.astype(np.int64), pairs.col.astype(np.int64)
        return cls(tuple(records), candidates)

    def __call__(self, first: Records, second: Records) -> Pairs:
        """The candidates of two of the catalogues, for any order of their records."""
        names = [records.source for records in self.records]
        a, b = names.index(first.source), names.index(second.source)
        i, j = self.indices[min(a, b), max(a, b)]
        if a > b:
            i, j = j, i
        return pairs_on_sphere(
            first, second, indices_among(self.records[a], first)[i], indices_among(self.records[b], second)[j]
        )


def candidate_indices(match: SkyMatch, first: Records, second: Records) -> tuple[IntArray, IntArray, FloatArray]:
    """The candidates of a match as indices in two sets of records of its catalogues, and their probabilities."""
    result = match.result
    i, j = _indices_of_table_rows(first)[result.rows_1], _indices_of_table_rows(second)[result.rows_2]
    used = (i >= 0) & (j >= 0)
    return i[used], j[used], result.p_pair[used]


def pairs_on_sphere(first: Records, second: Records, rows_1: IntArray, rows_2: IntArray) -> Pairs:
    """Pairs of records on the sphere with residuals, squared Mahalanobis distances and determinants."""
    i, j = rows_1.astype(np.int32), rows_2.astype(np.int32)
    offset = sphere_offset(*first.features[i].T, *second.features[j].T)
    zeros = np.zeros(len(i))
    pairs = Pairs(first, second, i, j, i, j, offset, zeros, zeros, "candidates of the catalogues two by two")
    sigma = pairs.covariance
    distance = mahalanobis_sq(offset, sigma)
    return replace(pairs, mahalanobis_sq=distance, determinant=np.linalg.det(sigma))


def indices_among(records: Records, among: Records) -> IntArray:
    """(n,) index of each of the ``records`` in ``among``, the same records in another order."""
    return _indices_of_table_rows(among)[records.rows]


def _indices_of_table_rows(records: Records) -> IntArray:
    """(table rows,) index of each row among the records, ABSENT for rows set aside."""
    index = np.full(records.n_table, ABSENT)
    index[records.rows] = np.arange(len(records))
    return index


def _plausible(links: Mapping[tuple[int, int], csr_array], a: int, b: int) -> csr_array:
    """Candidate pairs of catalogues a and b above :data:`PLAUSIBLE`, in either order, as a sparse matrix of ones."""
    # A copy: eliminate_zeros moves the indices in place, and csr_array shares them.
    plausible = csr_array(links[a, b] if a < b else links[b, a].T, copy=True)
    plausible.data = np.where(plausible.data > 1.0 + PLAUSIBLE, 1.0, 0.0)
    plausible.eliminate_zeros()
    return plausible


def _coverage_of(match: SkyMatch, first: Records, second: Records) -> Coverage:
    """The coverage of a match with its records in the order of ``first`` and ``second`` (at the common epoch)."""
    coverage = match.estimate.coverage
    part = coverage.part(indices_among(first, coverage.first), indices_among(second, coverage.second))
    coverage.release()
    return part


@dataclass(frozen=True)
class ManyOptions:
    """Options of a joint match; options that are not given are estimated from the catalogues.

    epoch_jyr : epoch of the objects' positions in the result; the mean of the catalogues' epochs by default.
    gate_sigmas, error_scale : as in :class:`~sameas.sky.crossmatch.MatchOptions`, for every two catalogues.
    magnitudes : "auto" uses the magnitude of each catalogue as evidence; "off" positions only.
    offset : "none" assumes one frame; "find" rotates each catalogue onto the most precise one, or onto one already
        rotated (see :mod:`sameas.sky.systematics`).
    """

    epoch_jyr: float | None = None
    gate_sigmas: float | None = None
    error_scale: float | str | Errors = "auto"
    offset: str = "none"
    magnitudes: str = AUTO

    def of_two(self) -> MatchOptions:
        """The options of the pairwise matches."""
        return MatchOptions(gate_sigmas=self.gate_sigmas, error_scale=self.error_scale, magnitudes=self.magnitudes)


@in_short
@dataclass(frozen=True)
class ManyMatch:
    """Result of a joint crossmatch.

    catalogues : in the given order, as the sources of ``objects``. epoch_jyr : of the objects' states, None if
    positions were not moved. objects : the result; its ``fused.state`` is (n, 4), see :class:`StarObservers`.
    two_by_two : the pairwise matches, by catalogue names. expected : by catalogue names, the expected number of objects
    in exactly these. iterations, converged : of EM, and whether it converged. doubts : what looks wrong.
    rotations : by catalogue name, the rotation that was removed.
    magnitude_information : by the names of two catalogues, the mean information in their magnitudes, ln per common
        object, the most informative first; empty if magnitudes are not used.
    """

    catalogues: tuple[Catalogue, ...]
    epoch_jyr: float | None
    objects: Objects
    two_by_two: dict[tuple[str, str], SkyMatch]
    expected: dict[tuple[str, ...], float]
    iterations: int
    converged: bool
    doubts: tuple[str, ...]
    rotations: Mapping[str, Rotation] = field(default_factory=dict)
    magnitude_information: Mapping[tuple[str, str], float] = field(default_factory=dict)

    @cached_property
    def state(self) -> Joint:
        """Position and motion of each object, χ² and covariance; see :class:`StarObservers`."""
        return self.objects.fused

    @cached_property
    def has_motion(self) -> BoolArray:
        """(n,) mask of the objects with a motion from a record, or from records of different epochs."""
        members = np.ma.filled(self.objects.members, ABSENT)
        measured = np.zeros(len(members), bool)
        first, last = np.full(len(members), np.inf), np.full(len(members), -np.inf)
        for k, catalogue in enumerate(self.catalogues):
            present = np.flatnonzero(members[:, k] != ABSENT)
            rows = members[present, k]
            epoch = catalogue.astrometry.epoch_jyr[rows]
            measured[present] |= moving_rows(catalogue)[rows]
            first[present], last[present] = np.fmin(first[present], epoch), np.fmax(last[present], epoch)
        return np.asarray(measured | (last - first > MIN_SPAN_YR))

    @cached_property
    def broken(self) -> int:
        """Number of pairs of the pairwise matches that are not in one object of the joint match."""
        names = [catalogue.name for catalogue in self.catalogues]
        number = [np.ma.filled(self.objects.of(name).object, ABSENT) for name in names]
        total = 0
        for (a, b), match in self.two_by_two.items():
            matches = match.result.matches
            one, two = number[names.index(a)][matches.rows_1], number[names.index(b)][matches.rows_2]
            total += int(np.count_nonzero(one != two))
        return total


def match_many(
    catalogues: Sequence[Catalogue],
    options: ManyOptions | None = None,
    *,
    progress: Callable[[str], None] = lambda stage: None,
) -> ManyMatch:
    """Joint crossmatch of two or more catalogues.

    Parameters
    ----------
    catalogues : with different names; their order has no effect.
    options : given values.
    progress : called with the name of each stage.

    Raises
    ------
    InputError : fewer than two catalogues or too many, equal names, no usable rows, motions without an epoch.
    """
    options = ManyOptions() if options is None else options
    _refuse(catalogues)
    catalogues, assumed = completed(catalogues, options.epoch_jyr)
    order = sorted(range(len(catalogues)), key=lambda k: _content(catalogues[k]))
    epoch, ordered = _at_common_epoch([catalogues[k] for k in order], options.epoch_jyr)
    searches: dict[str, Rotation] = {}
    if options.offset == "find":
        ordered, searches = _on_one_frame(ordered, progress)
    matches = _pairwise(ordered, options, progress)
    progress("candidates of all")
    records = [by_position(catalogue.records(epoch)) for catalogue in ordered]
    astrometric = tuple(AstrometricRecords.of(c, r, epoch) for c, r in zip(ordered, records, strict=True))
    candidates = PairwiseGate.of(matches, records, astrometric)
    records_as_given = [records[order.index(k)] for k in range(len(order))]
    pooled_records = pooled(records_as_given, candidates)
    coverages = {(a, b): _coverage_of(match, records[a], records[b]) for (a, b), match in matches.items()}
    magnitudes = None
    if options.magnitudes != OFF:
        two = {(a, b): candidate_indices(match, records[a], records[b]) for (a, b), match in matches.items()}
        magnitudes = SetMagnitudes.of(matches, ordered, records, two)
    population = _initial_population(matches, records, coverages, options)
    observers = StarObservers.of(pooled_records, records, astrometric, population, magnitudes)
    em = _estimate_population(replace(pooled_records, observers=observers), coverages, options, progress)
    objects = Objects(tuple(records_as_given), em.pooled, em.sets, em.answer, em.terms)
    expected = _by_names(em.expected, order, [catalogue.name for catalogue in catalogues])
    pairs = {(ordered[a].name, ordered[b].name): match for (a, b), match in matches.items()}
    doubts = assumed + _search_doubts(searches) + _doubts(ordered, pairs, objects, em.converged)
    removed = {name: rotation for name, rotation in searches.items() if not rotation.by_chance}
    information = {
        (ordered[a].name, ordered[b].name): edge.information
        for (a, b), edge in (() if magnitudes is None else magnitudes.edges.items())
    }
    return ManyMatch(
        tuple(catalogues), epoch, objects, pairs, expected, em.iterations, em.converged, doubts, removed, information
    )


def _on_one_frame(
    catalogues: Sequence[Catalogue], progress: Callable[[str], None]
) -> tuple[list[Catalogue], dict[str, Rotation]]:
    """The catalogues on the frame of the most precise one, and the rotation found for each other one, by name.

    A catalogue with too few common objects is rotated onto one already on this frame. The errors of the rotations, from
    many records, are not added to the errors of the records.
    """
    precise = sorted(range(len(catalogues)), key=lambda k: _typical_sigma(catalogues[k]))
    aligned, rotations, remaining = {precise[0]: catalogues[precise[0]]}, {}, precise[1:]
    while remaining:
        tries = ((k, reference) for k in remaining for reference in aligned.values())
        for k, reference in tries:
            _, _, one, two = at_common_epoch(reference, catalogues[k])
            rotation = find_rotation(one, two, partial(_stage, progress, f"{reference.name} and {catalogues[k].name}"))
            rotations[catalogues[k].name] = rotation
            if not rotation.by_chance:
                aligned[k] = _rotated(catalogues[k], rotation)
                break
        else:  # no remaining catalogue can be rotated
            break
        remaining.remove(k)
    return [aligned.get(k, catalogue) for k, catalogue in enumerate(catalogues)], rotations


def _typical_sigma(catalogue: Catalogue) -> float:
    """Median position error in right ascension, mas."""
    return float(np.nanmedian(np.sqrt(catalogue.astrometry.variance(0))))


def _rotated(catalogue: Catalogue, rotation: Rotation) -> Catalogue:
    at = catalogue.astrometry
    ra, dec = rotation.moved(np.column_stack([at.ra_deg, at.dec_deg])).T
    return replace(catalogue, astrometry=replace(at, ra_deg=ra, dec_deg=dec))


def _search_doubts(searches: Mapping[str, Rotation]) -> tuple[str, ...]:
    """Doubts about the rotations that were searched for."""
    lines = []
    for name, search in searches.items():
        lines += [f"{name}: {note}" for note in search.notes]
        if search.by_chance:
            lines.append(f"{name}: no offset was removed")
    return tuple(lines)


def _pairwise(
    catalogues: Sequence[Catalogue], options: ManyOptions, progress: Callable[[str], None]
) -> dict[tuple[int, int], SkyMatch]:
    """The matches of every two catalogues."""
    matches = {}
    for a, b in combinations(range(len(catalogues)), 2):
        stages = partial(_stage, progress, f"{catalogues[a].name} and {catalogues[b].name}")
        matches[a, b] = match_two(catalogues[a], catalogues[b], options.of_two(), progress=stages)
    return matches


def _by_names(expected: FloatArray, order: list[int], names: list[str]) -> dict[tuple[str, ...], float]:
    """Expected numbers of objects by catalogue names in the given order, single catalogues first."""
    numbers = {}
    for pattern, number in enumerate(expected.tolist()):
        within = tuple(sorted(order[s] for s in range(len(order)) if pattern >> s & 1))
        if within:
            numbers[within] = number
    return {tuple(names[k] for k in within): numbers[within] for within in sorted(numbers, key=lambda w: (len(w), w))}


def _stage(progress: Callable[[str], None], names: str, stage: str) -> None:
    progress(f"{names}: {stage}")


@dataclass(frozen=True)
class _Estimate:
    """The result of EM. expected : (2^S,) numbers of objects of each pattern."""

    pooled: PooledRecords
    sets: Sets
    terms: Terms
    answer: Answer
    expected: FloatArray
    iterations: int
    converged: bool


def _estimate_population(
    pooled_records: PooledRecords, coverages: Coverages, options: ManyOptions, progress: Callable[[str], None]
) -> _Estimate:
    """Population and probabilities of the sets by EM."""
    observers = pooled_records.observers
    assert isinstance(observers, StarObservers)
    progress("sets of all")
    limits = TUNING_OF_SETS if len(observers.sources) <= FEW_CATALOGUES else replace(TUNING_OF_SETS, max_sets=MAX_SETS)
    sets = candidate_sets(pooled_records, observers.terms(pooled_records), limits)
    members = observers.by_catalogue(pooled_records.positions(sets.members))
    log_weight = _LogWeight.of(members, observers)
    previous = np.full(1 << len(observers.sources), -1.0)
    population = observers.population
    for iteration in range(1, POPULATION_ITERATIONS + 1):
        progress(f"estimation of all, round {iteration}")
        weighted_sets = replace(sets, log_weight=log_weight(population))
        best = answer(weighted_sets, pooled_records, None)
        expected = np.bincount(log_weight.patterns, best.probability, len(previous)).astype(np.float64)
        converged = bool(np.abs(expected - previous).max() <= CONVERGED_SHARE * expected.sum() + 0.01)
        if converged or iteration == POPULATION_ITERATIONS:
            break
        previous = expected
        population = population.m_step(members, log_weight.chi_sq, best.probability, coverages)
    observers = replace(observers, population=population)
    pooled_records = replace(pooled_records, observers=observers)
    return _Estimate(
        pooled_records, weighted_sets, observers.terms(pooled_records), best, expected, iteration, converged
    )


@dataclass(frozen=True)
class _LogWeight:
    """Log weights of sets (k, S), with the part that is independent of the population; 0 for single records."""

    sets: IntArray
    patterns: IntArray
    several: IntArray
    log_peak: FloatArray
    chi_sq: FloatArray

    @classmethod
    def of(cls, sets: IntArray, observers: StarObservers) -> _LogWeight:
        patterns = patterns_of(sets)
        several = np.flatnonzero(patterns & (patterns - 1))
        fit = fitted(observers.astrometric, sets[several])
        log_peak, chi_sq = np.zeros(len(sets)), np.zeros(len(sets))
        log_peak[several], chi_sq[several] = fit.log_peak, fit.chi_sq
        if observers.magnitudes is not None:
            log_peak[several] += observers.magnitudes(sets[several])
        return cls(sets, patterns, several, log_peak, chi_sq)

    def __call__(self, population: Population) -> FloatArray:
        """(k,) ln w under a population."""
        k, weight = self.several, self.log_peak.copy()
        sets, patterns = self.sets[k], self.patterns[k]
        weight[k] += population.log_profile(patterns, self.chi_sq[k]) + population.mean_log_density(sets, patterns)
        for s in range(sets.shape[1]):
            present = np.flatnonzero(sets[:, s] != ABSENT)
            weight[k[present]] -= population.log_alone(s)[sets[present, s]]
        return weight


def _initial_population(
    matches: Matches, records: Sequence[Records], coverages: Coverages, options: ManyOptions
) -> Population:
    """The initial population of EM, from the pairwise matches."""
    p_partner: dict[tuple[int, int], FloatArray] = {}
    for (a, b), match in matches.items():
        for (s, t), answers in zip(((a, b), (b, a)), match.result.both_answers, strict=True):
            p_partner[s, t] = 1.0 - np.ma.filled(answers.p_none, 1.0)[records[s].rows]
    errors = {1 << a | 1 << b: match.estimate.spread for (a, b), match in matches.items()}
    return initial_population(coverages, p_partner, errors, options.error_scale == "auto")


def _refuse(catalogues: Sequence[Catalogue]) -> None:
    if not 2 <= len(catalogues) <= MAX_CATALOGUES:
        n = counted(len(catalogues), "catalogue")
        raise InputError(f"{n} given", f"give two to {MAX_CATALOGUES}, as a list")
    names = [catalogue.name for catalogue in catalogues]
    duplicate = next((name for name in names if names.count(name) > 1), None)
    if duplicate is not None:
        raise InputError(f"two catalogues are named {duplicate!r}; give each a name of its own")


def _content(catalogue: Catalogue) -> tuple[object, ...]:
    """The sort key of a catalogue: its content, independent of the order of its rows."""
    epoch = catalogue.epoch_jyr
    positions = np.sort(catalogue.astrometry.ra_deg).tobytes()
    return len(catalogue), -np.inf if epoch is None else epoch, positions, catalogue.name


def _at_common_epoch(catalogues: list[Catalogue], given: float | None) -> tuple[float | None, list[Catalogue]]:
    """The reference epoch, and the catalogues; without epochs unless all are known.

    Raises InputError: some have proper motions, and not all epochs are known.
    """
    epochs = [catalogue.epoch_jyr for catalogue in catalogues]
    unknown = [c.name for c, epoch in zip(catalogues, epochs, strict=True) if epoch is None]
    if not unknown:
        return (
            float(np.mean([epoch for epoch in epochs if epoch is not None])) if given is None else given
        ), catalogues
    if given is not None or any(catalogue.has_motion for catalogue in catalogues):
        raise InputError(
            f"{unknown[0]}: its epoch is not known, so stars cannot be moved to or from it", naming("give {epoch:YEAR}")
        )
    without_epochs = [
        replace(c, astrometry=replace(c.astrometry, epoch_jyr=np.full(len(c), np.nan))) for c in catalogues
    ]
    return None, without_epochs


def _doubts(
    catalogues: Sequence[Catalogue], pairs: dict[tuple[str, str], SkyMatch], objects: Objects, converged: bool
) -> tuple[str, ...]:
    # Two small fields in a large one lie apart rightly.
    placed = {name for names, match in pairs.items() if len(match.result.matches.rows_1) for name in names}
    # Between two epochs objects move by themselves; where a third catalogue has their motions, it tells the frames.
    moving = {catalogue.name for catalogue in catalogues if catalogue.has_motion}
    epoch_of = {catalogue.name: catalogue.epoch_jyr for catalogue in catalogues}
    doubts: list[str] = [
        Message(f"{a} and {b}: ", words)
        for (a, b), match in pairs.items()
        for words in match.doubts
        if not ({a, b} <= placed and words.endswith(WHETHER_SAME_SKY))
        and not (moving and not {a, b} & moving and epoch_of[a] != epoch_of[b] and words.endswith(REMOVE_OFFSET))
    ]
    if not converged:
        doubts.append("the estimates of all catalogues had not converged at the last iteration")
    groups = objects.groups
    approximate = int(groups.records[~groups.exact].sum())
    if approximate:
        doubts.append(
            f"{counted(approximate, 'record')} in groups with too many sets for exact sums; their p is approximate"
        )
    unproved = int(groups.records[groups.gap > 0].sum())
    if unproved:
        doubts.append(f"{counted(unproved, 'record')} in groups whose objects are not proved to be the most probable")
    return tuple(doubts)

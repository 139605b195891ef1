"""Several catalogues identified at once: every object, its record in each catalogue, and how sure that is.

Data passes: catalogues → identified two by two → candidates → what each record says of place and motion
→ the sets that could be one star → the population, estimated with the probabilities of the sets
(:mod:`sameas.sky.many.population`) → the best partition into stars. Nothing of it depends on the order of the
catalogues.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.errors import InputError, Message, naming
from sameas.estimate.coverage import Coverage
from sameas.evidence import Errors
from sameas.gate import Pairs
from sameas.gaussian import mahalanobis_sq
from sameas.many.joint import NO_RECORD, Joint, Observers
from sameas.many.marginals import Answer, answer
from sameas.many.objects import Objects
from sameas.many.pooled import PooledRecords, pooled
from sameas.many.rules import Linear, Terms
from sameas.many.sets import Sets, candidate_sets
from sameas.records import Records
from sameas.representation import in_short
from sameas.sky.bands import OFF
from sameas.sky.catalogue import Catalogue
from sameas.sky.crossmatch import MatchOptions, SkyMatch, at_common_epoch, by_position
from sameas.sky.crossmatch import match as match_two
from sameas.sky.doubts import completed
from sameas.sky.many.population import (
    TUNING,
    AstrometricRecords,
    Coverages,
    Population,
    PopulationTuning,
    first_guess,
    fitted,
    moving_rows,
    patterns_of,
)
from sameas.sky.systematics import Rotation, find_rotation
from sameas.space import sphere_offset

#: An upper bound of a log density that excludes no set: a motion allows positions far apart.
UNBOUNDED = 1e4
#: Candidates less probable than this, two by two, lead to no others (chosen).
PLAUSIBLE = 1e-6
#: Most catalogues: more have more patterns than data can distinguish (chosen).
MOST_CATALOGUES = 8
#: Years; records nearer in time do not determine a motion (chosen).
LEAST_SPAN_YR = 0.1


@in_short
@dataclass(frozen=True)
class StarObservers(Observers):
    """Catalogues as observers of stars that move, for :mod:`sameas.many`; ``sources`` are their pooled records.

    The state of a set: right ascension and declination in degrees at the reference epoch, proper motion east and north
    in arcsec per year, (k, 4); its covariance in arcsec and arcsec per year, scaled by the residuals of its pattern
    where these are errors.

    astrometric, population : in the order of the catalogues and of their tables. catalogue : (S,) number of the
    catalogue of each source. position : per source the positions of its records there.
    """

    astrometric: tuple[AstrometricRecords, ...] = field(kw_only=True)
    population: Population = field(kw_only=True)
    catalogue: tuple[int, ...] = field(kw_only=True)
    position: tuple[IntArray, ...] = field(kw_only=True)

    @classmethod
    def of(
        cls,
        pooled: PooledRecords,
        records: Sequence[Records],
        astrometric: tuple[AstrometricRecords, ...],
        population: Population,
    ) -> StarObservers:
        """The observers of the pooled ``records`` of the catalogues."""
        names = [one.source for one in records]
        sources = tuple(source for source in pooled.sources if isinstance(source, Records))
        catalogue = tuple(names.index(source.source) for source in sources)
        position = tuple(place(source, records[c]) for source, c in zip(sources, catalogue, strict=True))
        return cls(
            sources, None, astrometric=astrometric, population=population, catalogue=catalogue, position=position
        )

    def placed(self, sets: NDArray[np.integer]) -> IntArray:
        """Sets (k, sources) of positions in the sources, as (k, catalogues) of positions in the catalogues' records."""
        out = np.full(sets.shape, NO_RECORD, np.int64)
        for s, c in enumerate(self.catalogue):
            k = np.flatnonzero(sets[:, s] != NO_RECORD)
            out[k, c] = self.position[s][sets[k, s]]
        return out

    def joint(self, sets: NDArray[np.integer]) -> Joint:
        """Density and state of ``sets`` (k, sources): density of objects of their pattern times that of the places."""
        placed = self.placed(sets)
        fit, patterns = fitted(self.astrometric, placed), patterns_of(placed)
        log_density = fit.log_peak + self.population.log_spread(patterns, fit.chi_sq)
        several = patterns & (patterns - 1) > 0
        log_density += np.where(several, self.population.log_together(placed, patterns), 0.0)
        scale_sq = np.where(fit.has_residual, self.population.scale_sq(patterns, fit.chi_sq), 1.0)
        state = np.column_stack([fit.direction, fit.motion])
        return Joint(log_density, fit.chi_sq, state, scale_sq[:, None, None] * fit.covariance)

    def terms(self, pooled: PooledRecords) -> Terms:
        """The weights of the records as objects of their own."""
        alone = [self.population.log_alone(c)[p] for c, p in zip(self.catalogue, self.position, strict=True)]
        return Terms({"density of lone records": Linear(0.0, -np.concatenate(alone))})

    def log_peak(self, s: int) -> FloatArray:
        """(n,) an upper bound of what a set gains by a record of source s."""
        return np.full(len(self.position[s]), UNBOUNDED)


Matches = Mapping[tuple[int, int], SkyMatch]


@in_short
@dataclass(frozen=True)
class Candidates:
    """Candidate pairs of every two catalogues; a gate for :func:`sameas.many.pooled.pooled`, by the sources' names.

    Every two catalogues are matched first (:func:`sameas.sky.crossmatch.match`), because their residuals determine the
    width of their gate. Fast stars of two catalogues without motions lie beyond any gate; where a third catalogue has
    the motion, records that are both candidates of one of its moving records are candidates of each other.

    records : of every catalogue. positions : per two of them (a < b) positions i (m,) and j (m,) in their records.
    """

    records: tuple[Records, ...]
    positions: Mapping[tuple[int, int], tuple[IntArray, IntArray]]

    @classmethod
    def of(cls, matches: Matches, records: Sequence[Records], astrometric: Sequence[AstrometricRecords]) -> Candidates:
        """Those of the ``matches`` of every two catalogues, and those that moving stars lead to."""
        links = {}
        for (a, b), match in matches.items():
            i, j, p = positions(match, records[a], records[b])
            links[a, b] = csr_array((p + 1.0, (i, j)), shape=(len(records[a]), len(records[b])))
        candidates = {}
        for a, b in combinations(range(len(records)), 2):
            link = links[a, b]
            for c in range(len(records)):
                if c in (a, b) or not astrometric[c].moving.any():
                    continue
                to, off = _through(links, a, c), _through(links, c, b)
                link = link + (to * astrometric[c].moving.astype(np.float64)) @ off
            pairs = csr_array(link).tocoo()
            candidates[a, b] = pairs.row.astype(np.int64), pairs.col.astype(np.int64)
        return cls(tuple(records), candidates)

    def __call__(self, first: Records, second: Records) -> Pairs:
        """The candidates of two of the catalogues, whatever the order of their records."""
        names = [records.source for records in self.records]
        a, b = names.index(first.source), names.index(second.source)
        i, j = self.positions[min(a, b), max(a, b)]
        if a > b:
            i, j = j, i
        return measured(first, second, place(self.records[a], first)[i], place(self.records[b], second)[j])


def positions(match: SkyMatch, first: Records, second: Records) -> tuple[IntArray, IntArray, FloatArray]:
    """A match's candidates as positions in two sets of records of its catalogues, and their probabilities."""
    result = match.result
    i, used_1 = _positions_of(first, result.rows_1)
    j, used_2 = _positions_of(second, result.rows_2)
    used = used_1 & used_2
    return i[used], j[used], result.p_pair[used]


def measured(first: Records, second: Records, rows_1: IntArray, rows_2: IntArray) -> Pairs:
    """Pairs of records on the sphere, named by position, with residuals, squared distances and determinants."""
    i, j = rows_1.astype(np.int32), rows_2.astype(np.int32)
    offset = sphere_offset(*first.features[i].T, *second.features[j].T)
    nothing = np.zeros(len(i))
    pairs = Pairs(first, second, i, j, i, j, offset, nothing, nothing, "candidates of the catalogues two by two")
    sigma = pairs.covariance
    distance = mahalanobis_sq(offset, sigma)
    return replace(pairs, mahalanobis_sq=distance, determinant=np.linalg.det(sigma))


def place(records: Records, among: Records) -> IntArray:
    """(n,) position of each of the ``records`` among the same records in another order."""
    order = np.argsort(among.rows)
    return order[np.searchsorted(among.rows, records.rows, sorter=order)]


def _through(links: Mapping[tuple[int, int], csr_array], a: int, b: int) -> csr_array:
    """Plausible candidates of catalogues a and b, in either order, as a matrix of ones."""
    kept = csr_array(links[a, b] if a < b else links[b, a].T)
    kept.data = np.where(kept.data > 1.0 + PLAUSIBLE, 1.0, 0.0)
    kept.eliminate_zeros()
    return kept


def _positions_of(records: Records, rows: IntArray) -> tuple[IntArray, BoolArray]:
    """Positions of table rows among the records, and whether they are among them."""
    order = np.argsort(records.rows)
    at = order[np.minimum(np.searchsorted(records.rows, rows, sorter=order), max(len(records) - 1, 0))]
    return at, records.rows[at] == rows


def _placed_alike(match: SkyMatch, first: Records, second: Records) -> Coverage:
    """A match's coverage, its records in the order of these, which are of the epoch of all catalogues."""
    coverage = match.estimate.coverage
    return coverage.part(place(first, coverage.first), place(second, coverage.second))


@dataclass(frozen=True)
class ManyOptions:
    """What the user gives; everything else is estimated or decided by the catalogues.

    epoch_jyr : of the objects' positions in the answer; the mean of the catalogues' epochs by default.
    gate_sigmas, error_scale : as in :class:`~sameas.sky.crossmatch.MatchOptions`, of every two catalogues.
    time_limit_s : of branch and bound in one group; where it is reached the answer states its gap.
    offset : "none" takes all catalogues to be on one frame; "find" rotates each onto the most precise one, or onto one
        that was rotated so before (see :mod:`sameas.sky.systematics`).
    """

    epoch_jyr: float | None = None
    gate_sigmas: float | None = None
    error_scale: float | str | Errors = "auto"
    time_limit_s: float = 60.0
    offset: str = "none"

    def of_two(self) -> MatchOptions:
        """The options of every two catalogues."""
        return MatchOptions(gate_sigmas=self.gate_sigmas, error_scale=self.error_scale, magnitudes=OFF)


@in_short
@dataclass(frozen=True)
class ManyMatch:
    """Several catalogues identified.

    catalogues : in the order given, as the sources of ``objects``. epoch_jyr : of the objects' states, None where
    nothing was moved. objects : the answer; its ``fused.state`` is (n, 4), see :class:`StarObservers`.
    two_by_two : the catalogues identified in pairs, by their names. expected : by names of catalogues, the expected
    number of objects in exactly these. iterations, settled : of EM, and whether it converged. doubts : in words.
    rotations : by the name of a catalogue, what was taken away from it.
    """

    catalogues: tuple[Catalogue, ...]
    epoch_jyr: float | None
    objects: Objects
    two_by_two: dict[tuple[str, str], SkyMatch]
    expected: dict[tuple[str, ...], float]
    iterations: int
    settled: bool
    doubts: tuple[str, ...]
    rotations: Mapping[str, Rotation] = field(default_factory=dict)

    @cached_property
    def state(self) -> Joint:
        """Place and motion of every object, χ² and covariance; see :class:`StarObservers`."""
        return self.objects.fused

    @cached_property
    def has_motion(self) -> BoolArray:
        """(n,) whether an object's records determine its motion: one has it, or two are of different epochs."""
        members = np.ma.filled(self.objects.members, NO_RECORD)
        measured = np.zeros(len(members), bool)
        first, last = np.full(len(members), np.inf), np.full(len(members), -np.inf)
        for k, catalogue in enumerate(self.catalogues):
            here = np.flatnonzero(members[:, k] != NO_RECORD)
            rows = members[here, k]
            epoch = catalogue.astrometry.epoch_jyr[rows]
            measured[here] |= moving_rows(catalogue)[rows]
            first[here], last[here] = np.fmin(first[here], epoch), np.fmax(last[here], epoch)
        return np.asarray(measured | (last - first > LEAST_SPAN_YR))

    @cached_property
    def broken(self) -> int:
        """Number of pairs of the catalogues two by two that are not one object of all together."""
        names = [catalogue.name for catalogue in self.catalogues]
        number = [np.ma.filled(self.objects.of(name).object, -1) for name in names]
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
    tuning: PopulationTuning = TUNING,
) -> ManyMatch:
    """Identify two catalogues or more, all at once.

    Parameters
    ----------
    catalogues : of different names; their order changes nothing.
    options : what the user gives.
    progress : called with the name of each stage. tuning : numbers of the estimate of the population.

    Raises
    ------
    InputError : fewer than two catalogues or too many, two of one name, no usable rows, motions without an epoch.
    """
    options = ManyOptions() if options is None else options
    _refuse(catalogues)
    catalogues, assumed = completed(catalogues, options.epoch_jyr)
    order = sorted(range(len(catalogues)), key=lambda k: _content(catalogues[k]))
    epoch, ordered = _at_one_time([catalogues[k] for k in order], options.epoch_jyr)
    searches: dict[str, Rotation] = {}
    if options.offset == "find":
        ordered, searches = _on_one_frame(ordered, progress)
    matches = _two_by_two(ordered, options, progress)
    progress("candidates of all")
    records = [by_position(catalogue.records(epoch)) for catalogue in ordered]
    astrometric = tuple(AstrometricRecords.of(c, r, epoch) for c, r in zip(ordered, records, strict=True))
    candidates = Candidates.of(matches, records, astrometric)
    given = [records[order.index(k)] for k in range(len(order))]
    together = pooled(given, candidates)
    coverages = {(a, b): _placed_alike(match, records[a], records[b]) for (a, b), match in matches.items()}
    observers = StarObservers.of(together, records, astrometric, _first_guess(matches, records, coverages, options))
    em = _estimated(replace(together, observers=observers), coverages, options, progress, tuning)
    objects = Objects(tuple(given), em.pooled, em.sets, em.answer, em.terms)
    expected = _by_names(em.expected, order, [catalogue.name for catalogue in catalogues])
    pairs = {(ordered[a].name, ordered[b].name): match for (a, b), match in matches.items()}
    doubts = assumed + _search_doubts(searches) + _doubts(pairs, objects, em.settled)
    taken = {name: rotation for name, rotation in searches.items() if not rotation.by_chance}
    return ManyMatch(tuple(catalogues), epoch, objects, pairs, expected, em.iterations, em.settled, doubts, taken)


def _on_one_frame(
    catalogues: Sequence[Catalogue], progress: Callable[[str], None]
) -> tuple[list[Catalogue], dict[str, Rotation]]:
    """The catalogues on the frame of the most precise one, and what was found of each other, by name.

    A catalogue that has too little in common with that one is rotated onto one that was brought there before. Errors of
    the rotations, which are those of many records together, are left out of the errors of the records.
    """
    precise = sorted(range(len(catalogues)), key=lambda k: _typical_sigma(catalogues[k]))
    placed, found, waiting = {precise[0]: catalogues[precise[0]]}, {}, precise[1:]
    while waiting:
        tries = ((k, reference) for k in waiting for reference in placed.values())
        for k, reference in tries:
            _, _, one, two = at_common_epoch(reference, catalogues[k])
            rotation = find_rotation(one, two, partial(_stage, progress, f"{reference.name} and {catalogues[k].name}"))
            found[catalogues[k].name] = rotation
            if not rotation.by_chance:
                placed[k] = _rotated(catalogues[k], rotation)
                break
        else:  # nothing of what is left can be brought there
            break
        waiting.remove(k)
    return [placed.get(k, catalogue) for k, catalogue in enumerate(catalogues)], found


def _typical_sigma(catalogue: Catalogue) -> float:
    """Median error of the positions, mas."""
    return float(np.nanmedian(np.sqrt(catalogue.astrometry.variance(0))))


def _rotated(catalogue: Catalogue, rotation: Rotation) -> Catalogue:
    at = catalogue.astrometry
    ra, dec = rotation.moved(np.column_stack([at.ra_deg, at.dec_deg])).T
    return replace(catalogue, astrometry=replace(at, ra_deg=ra, dec_deg=dec))


def _search_doubts(searches: Mapping[str, Rotation]) -> tuple[str, ...]:
    """Doubts of the rotations that were looked for."""
    lines = []
    for name, search in searches.items():
        lines += [f"{name}: {note}" for note in search.notes]
        if search.by_chance:
            lines.append(f"{name}: no offset was removed")
    return tuple(lines)


def _two_by_two(
    catalogues: Sequence[Catalogue], options: ManyOptions, progress: Callable[[str], None]
) -> dict[tuple[int, int], SkyMatch]:
    """Every two catalogues identified with each other."""
    matches = {}
    for a, b in combinations(range(len(catalogues)), 2):
        stages = partial(_stage, progress, f"{catalogues[a].name} and {catalogues[b].name}")
        matches[a, b] = match_two(catalogues[a], catalogues[b], options.of_two(), progress=stages)
    return matches


def _by_names(expected: FloatArray, order: list[int], names: list[str]) -> dict[tuple[str, ...], float]:
    """Expected numbers of objects by names, as the catalogues were given; those of one catalogue first."""
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
    """The answer and its population; ``expected`` (2^S,) numbers of objects of every pattern."""

    pooled: PooledRecords
    sets: Sets
    terms: Terms
    answer: Answer
    expected: FloatArray
    iterations: int
    settled: bool


def _estimated(
    together: PooledRecords,
    coverages: Coverages,
    options: ManyOptions,
    progress: Callable[[str], None],
    tuning: PopulationTuning,
) -> _Estimate:
    """Population and probabilities estimated alternately until they converge (EM)."""
    observers = together.observers
    assert isinstance(observers, StarObservers)
    progress("sets of all")
    sets = candidate_sets(together, observers.terms(together))
    placed = observers.placed(together.positions(sets.members))
    weighing = _Weighing.of(placed, observers)
    before = np.full(1 << len(observers.sources), -1.0)
    population = observers.population
    for number in range(1, tuning.iterations + 1):
        progress(f"estimation of all, round {number}")
        weighed = replace(sets, log_weight=weighing(population))
        best = answer(weighed, together, None, time_limit_s=options.time_limit_s)
        expected = np.bincount(weighing.patterns, best.probability, len(before)).astype(np.float64)
        settled = bool(np.abs(expected - before).max() <= tuning.settled * expected.sum() + 0.01)
        if settled or number == tuning.iterations:
            break
        before = expected
        population = population.learned(placed, weighing.chi_sq, best.probability, coverages, tuning)
    observers = replace(observers, population=population)
    together = replace(together, observers=observers)
    return _Estimate(together, weighed, observers.terms(together), best, expected, number, settled)


@dataclass(frozen=True)
class _Weighing:
    """Sets (k, S) of records and the part of their weight that no population changes; 0 for one record alone."""

    sets: IntArray
    patterns: IntArray
    several: IntArray
    log_peak: FloatArray
    chi_sq: FloatArray

    @classmethod
    def of(cls, sets: IntArray, observers: StarObservers) -> _Weighing:
        patterns = patterns_of(sets)
        several = np.flatnonzero(patterns & (patterns - 1))
        fit = fitted(observers.astrometric, sets[several])
        log_peak, chi_sq = np.zeros(len(sets)), np.zeros(len(sets))
        log_peak[several], chi_sq[several] = fit.log_peak, fit.chi_sq
        return cls(sets, patterns, several, log_peak, chi_sq)

    def __call__(self, population: Population) -> FloatArray:
        """(k,) ln w under a population."""
        k, weight = self.several, self.log_peak.copy()
        sets, patterns = self.sets[k], self.patterns[k]
        weight[k] += population.log_spread(patterns, self.chi_sq[k]) + population.log_together(sets, patterns)
        for s in range(sets.shape[1]):
            here = np.flatnonzero(sets[:, s] != NO_RECORD)
            weight[k[here]] -= population.log_alone(s)[sets[here, s]]
        return weight


def _first_guess(
    matches: Matches, records: Sequence[Records], coverages: Coverages, options: ManyOptions
) -> Population:
    """The start of EM: the population by the catalogues two by two."""
    partnered: dict[tuple[int, int], FloatArray] = {}
    for (a, b), match in matches.items():
        for (s, t), answers in zip(((a, b), (b, a)), match.result.both_answers, strict=True):
            partnered[s, t] = 1.0 - np.ma.filled(answers.p_none, 1.0)[records[s].rows]
    spread = {1 << a | 1 << b: match.estimate.spread for (a, b), match in matches.items()}
    return first_guess(coverages, partnered, spread, options.error_scale == "auto")


def _refuse(catalogues: Sequence[Catalogue]) -> None:
    if not 2 <= len(catalogues) <= MOST_CATALOGUES:
        raise InputError(f"{len(catalogues)} catalogues given; give two to {MOST_CATALOGUES}, as a list")
    names = [catalogue.name for catalogue in catalogues]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise InputError(f"two catalogues are named {twice!r}; give each a name of its own")


def _content(catalogue: Catalogue) -> tuple[object, ...]:
    """The key by which catalogues are ordered: their content, whatever the order of their rows."""
    epoch = catalogue.epoch_jyr
    positions = np.sort(catalogue.astrometry.ra_deg).tobytes()
    return len(catalogue), -np.inf if epoch is None else epoch, positions, catalogue.name


def _at_one_time(catalogues: list[Catalogue], given: float | None) -> tuple[float | None, list[Catalogue]]:
    """The reference epoch, and the catalogues; without their epochs where these are not known of all.

    Raises
    ------
    InputError : some move, and not all epochs are known.
    """
    epochs = [catalogue.epoch_jyr for catalogue in catalogues]
    unknown = [c.name for c, epoch in zip(catalogues, epochs, strict=True) if epoch is None]
    if not unknown:
        return (
            float(np.mean([epoch for epoch in epochs if epoch is not None])) if given is None else given
        ), catalogues
    if given is not None or any(catalogue.has_motion for catalogue in catalogues):
        raise InputError(
            f"{unknown[0]}: its epoch is not known, so stars cannot be moved to or from it",
            naming("give {epoch:YEAR}"),
        )
    still = [replace(c, astrometry=replace(c.astrometry, epoch_jyr=np.full(len(c), np.nan))) for c in catalogues]
    return None, still


def _doubts(pairs: dict[tuple[str, str], SkyMatch], objects: Objects, settled: bool) -> tuple[str, ...]:
    doubts: list[str] = [Message(f"{a} and {b}: ", words) for (a, b), match in pairs.items() for words in match.doubts]
    if not settled:
        doubts.append("the estimates of all catalogues had not converged at the last iteration")
    groups = objects.groups
    rough = int(np.count_nonzero(~groups.exact))
    if rough:
        doubts.append(f"{rough} groups are large; their probabilities are approximate")
    open_ = int(np.count_nonzero(groups.gap > 0))
    if open_:
        doubts.append(f"in {open_} groups a better partition is possible, at most e^{groups.gap.max():.2g} as probable")
    return tuple(doubts)

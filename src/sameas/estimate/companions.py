"""Companions: binaries and groups, whose objects lie nearer to each other than those of a Poisson field.

If the other source misses a record's object but shows its companion, that companion looks like the record's partner.
Each source measures the number and distances of companions from the excess of close neighbours among its own records
over their density. The density of companions of an object, at a displacement u, is

    n κ(u),   κ = Σ_m share_m K(|u|; s_m, v),

with K a ring of radius s_m blurred by the variance v of both errors. It is the same for both sources, except for the
shares c₁, c₂ of objects that they show. With k other companions shown, and x = 1 − q₁q₂ the probability that one is
shown at all, the density of different objects near a record (ρ for a Poisson field) is ρ + G⁽ᵏ⁺¹⁾/G⁽ᵏ⁾ κ, where G is
the generating function of the number of companions at q₁q₂ = 1 − x: binomial if few objects have more than one
companion, else Poisson for a part of the objects.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from sameas.arrays import ABSENT, BoolArray, FloatArray, IntArray, places_in
from sameas.estimate.cells import GridLevel, finest
from sameas.estimate.coverage import typical_error
from sameas.estimate.sample import Setting
from sameas.evidence.rule import Evidence, Rule
from sameas.gate import Pairs, Radius
from sameas.ragged import Ragged, ranges
from sameas.records import Records
from sameas.representation import in_short
from sameas.space import ARCSEC_PER_RADIAN, Sphere, ball_volume, unit_vectors


@dataclass(frozen=True)
class CompanionsTuning:
    """Sample sizes and limits for companions.

    Attributes
    ----------
    radii : of the rings, in typical standard deviations of a residual. reach : greatest distance of neighbours, same
        unit.
    n_records : approximate number of records used, of each source. n_neighbours : of their neighbour pairs.
    iterations : of the fits.
    max_records : of both sources; with more, companions are ignored. max_dimensions : of the space.
    min_excess_sigmas : excess of neighbours at some distance over a Poisson field, in standard deviations, for a fit.
    min_gain : gain in ln likelihood of the neighbour pairs to accept the fit.
    max_chance_share : share of chance pairs among apparent companions; above it the field is crowded, and companions
        are ignored.
    max_companions : per record; above it the field has clumps, which the local densities describe, and companions are
        ignored.
    min_multiple_sigmas : significance, in standard deviations, of records with several companions.
    min_void : lower limit of the probability that no companion of an object is shown.
    competing_sq : squared normalised distance within which records compete for a pair of companions.
    same_object_radius : records of one source nearer than this, in the unit of ``radii``, may be one object.
    max_in_strips : up to this many pairs in strips along one axis, all distances are computed; with more, the gate
        finds the near ones.
    cell, seed : mean number of records of both sources in a sampled cell, and the seed of the sample.
    """

    radii: tuple[float, ...] = (0.0, 0.5, 1.0, 1.5, 2.0, 2.75, 3.5, 4.5, 5.5)
    reach: float = 7.0
    n_records: int = 8_000
    n_neighbours: int = 30_000
    iterations: int = 100
    max_records: int = 200_000
    max_dimensions: int = 3
    min_excess_sigmas: float = 2.5
    min_gain: float = 8.0
    max_chance_share: float = 0.7
    max_companions: float = 1.2
    min_multiple_sigmas: float = 2.5
    min_void: float = 0.02
    competing_sq: float = 25.0
    same_object_radius: float = 2.0
    max_in_strips: int = 1_000_000
    cell: int = 1_000
    seed: int = 20_063


DEFAULT_COMPANIONS = CompanionsTuning()
#: Quantiles of the variances at which averages over records are taken.
VARIANCES = np.linspace(0.01, 0.99, 50)
#: A box of side L has the fraction (this · r/L) fewer pairs at distance r than without edges, in 1, 2 and 3 dimensions.
EDGES = (1.0, 4.0 / math.pi, 1.5)


#: Coefficients of √(2πx) e⁻ˣ I₀(x) in powers of 1/x (Abramowitz & Stegun 9.7.1), and the x from which they are exact to
#: 1e-15.
_EXPANSION, _LARGE = [math.prod((2 * j - 1) ** 2 / (8 * j) for j in range(1, k + 1)) for k in range(16)], 30.0


def scaled_i0(x: FloatArray) -> FloatArray:
    """e⁻ˣ I₀(x), x ≥ 0 of any shape. scipy.special takes 0.1 s to import, and ``np.i0`` ten times as long."""
    out, large = np.empty_like(x), x >= _LARGE
    inverse = 1.0 / x[large]
    total = np.full_like(inverse, _EXPANSION[-1])
    for coefficient in reversed(_EXPANSION[:-1]):
        total *= inverse
        total += coefficient
    out[large] = total * np.sqrt(inverse / (2.0 * math.pi))
    small = x[~large]
    out[~large] = np.exp(-small) * np.i0(small)
    return out


def ring(distance: FloatArray, radius: float, variance: FloatArray, d: int) -> FloatArray:
    """(m,) density, at distance from the centre, of points on a sphere of ``radius`` blurred by a variance per axis."""
    with np.errstate(over="ignore"):
        x = distance * radius / variance
    peak = (2.0 * math.pi * variance) ** (-0.5 * d) * np.exp(-0.5 * (distance - radius) ** 2 / variance)
    if d == 2:
        return np.asarray(peak * scaled_i0(x))
    if d == 1:
        return np.asarray(peak * 0.5 * (1.0 + np.exp(-2.0 * x)))
    return np.asarray(peak * np.where(x > 1e-6, -np.expm1(-2.0 * x) / np.maximum(2.0 * x, 1e-300), 1.0))


def share_within(reach: float, radius: float, variance: FloatArray, d: int) -> FloatArray:
    """(m,) share of the points of :func:`ring` that lie within ``reach``, which must exceed the radius."""
    steps = np.linspace(0.0, 10.0, 401)
    distance = reach + steps * np.sqrt(variance)[:, None]
    surface = (2.0, 2.0 * math.pi * distance, 4.0 * math.pi * distance**2)[d - 1]
    beyond = surface * ring(distance, radius, variance[:, None], d)
    return np.asarray(1.0 - np.trapezoid(beyond, distance, axis=1))


@in_short
@dataclass(frozen=True)
class Clustering:
    """The excess of close neighbours: 1 + w(u) times as many pairs as in a Poisson field.

    unit : (d,) typical standard deviation of a residual; unit of all lengths. radii : (r,) of the rings.
    volume : (r,) ∫ w of each ring. multiplicity : mean number of pairs of companions of an object over the squared mean
        number of companions (⟨n(n − 1)⟩/⟨n⟩²); 0 where not significant.
    mean_densities : (ρ₁, ρ₂). shares : of the records of each source that have a partner, from the number of close
        records of the other; 0 if not estimated.
    level : in clumps of more records than a couple of companions, the factor on the local densities that remains;
        else None. The density of different objects near a record is then ρ (level + w).
    """

    unit: FloatArray
    radii: FloatArray
    volume: FloatArray
    multiplicity: float
    mean_densities: tuple[float, float]
    shares: tuple[float, float] = (0.0, 0.0)
    level: float | None = None

    @property
    def d(self) -> int:
        return len(self.unit)

    def excess_at(self, distance: FloatArray, variance: FloatArray) -> FloatArray:
        """(m,) w at a distance, blurred by a variance per axis."""
        total = np.zeros(len(distance))
        for radius, volume in zip(self.radii, self.volume, strict=True):
            if volume > 0.0:
                total += volume * ring(distance, float(radius), variance, self.d)
        return total


@in_short
@dataclass(frozen=True)
class _Source:
    """Records of one source in units of typical errors.

    points : (n, …) positions. even_records : the records with equal errors, for distances by the gate.
    """

    points: FloatArray
    even_records: Records
    variance: FloatArray
    density: FloatArray
    counted: BoolArray
    tuning: CompanionsTuning

    def part(self, rows: IntArray) -> _Source:
        """The source with these rows only."""
        return replace(
            self, points=self.points[rows], even_records=self.even_records.part(rows), variance=self.variance[rows],
            density=self.density[rows], counted=self.counted[rows],
        )  # fmt: skip

    def near(self, other: _Source, reach: float) -> tuple[IntArray, IntArray, FloatArray]:
        """(m,) i, k and distance of pairs of a record of this source and one of the other within ``reach``."""
        axis = int(np.argmax(np.ptp(other.points, axis=0)))
        order = np.argsort(other.points[:, axis], kind="stable")
        along = other.points[order, axis]
        low, high = (np.searchsorted(along, self.points[:, axis] + side) for side in (-reach, reach))
        if int((high - low).sum()) <= self.tuning.max_in_strips:
            i, place = ranges(low, high - low)
            k = order[place]
            distance = np.sqrt(((self.points[i] - other.points[k]) ** 2).sum(axis=1))
            near = distance <= reach
            return i[near], k[near], distance[near]
        pairs = Radius(reach)(self.even_records, other.even_records)
        return pairs.i.astype(np.int64), pairs.j.astype(np.int64), np.sqrt(pairs.mahalanobis_sq)

    def neighbours(self, reach: float, centres: IntArray | None = None) -> tuple[IntArray, IntArray, FloatArray]:
        """(c,) i, k and distance of neighbours within the source; i runs over ``centres``, or over all records."""
        i, k, distance = (self if centres is None else self.part(centres)).near(self, reach)
        i = i if centres is None else centres[i]
        distinct = i != k
        return i[distinct], k[distinct], distance[distinct]


def _points(records: Records, unit: FloatArray) -> FloatArray:
    """(n, d) positions in ``unit``, or (n, 3) on a sphere."""
    if isinstance(records.space, Sphere):
        return np.asarray(unit_vectors(*records.features.T) * (ARCSEC_PER_RADIAN / unit[0]))
    return np.asarray(records.features / unit)


def _with_equal_errors(records: Records, unit: FloatArray) -> Records:
    """The records with errors such that normalised distances are distances in ``unit``."""
    variance = 0.5 * (unit[:1] if isinstance(records.space, Sphere) else unit) ** 2
    return replace(records, covariance=np.tile(variance, (len(records), 1)))


def _sources(setting: Setting, unit: FloatArray, tuning: CompanionsTuning) -> tuple[_Source, _Source]:
    scale = float(np.prod(unit))
    one, two = (
        _Source(
            _points(records, unit),
            _with_equal_errors(records, unit),
            (records.variances / unit**2).mean(axis=1),
            density * scale,
            covered & counted,
            tuning,
        )
        for records, density, covered, counted in zip(
            (setting.pairs.first, setting.pairs.second),
            setting.densities,
            setting.covered,
            setting.counted,
            strict=True,
        )
    )
    return one, two


def _sampled_rows(levels: Sequence[GridLevel], tuning: CompanionsTuning) -> tuple[IntArray, IntArray]:
    """Rows of both sources in sampled cells with enough records of both; all rows if a sample were hardly smaller."""
    n1, n2 = len(levels[0].of_first), len(levels[0].of_second)
    if min(n1, n2) <= 2 * tuning.n_records:
        return np.arange(n1), np.arange(n2)
    level = finest(levels, (n1 + n2) / tuning.cell)
    sampled = level.drawn((level.count(1), level.count(2)), tuning.n_records, tuning.seed)
    return np.flatnonzero(sampled[level.of_first]), np.flatnonzero(sampled[level.of_second])


def _sampled_sources(setting: Setting, tuning: CompanionsTuning) -> tuple[FloatArray, _Source, _Source] | None:
    """The typical error of a residual by axis, and both sources, sampled; None with too many records or dimensions."""
    if setting.pairs.d > tuning.max_dimensions or not 0 < sum(setting.n_counted) <= tuning.max_records:
        return None
    rows = _sampled_rows(setting.levels, tuning)
    unit = typical_error(setting.pairs.first, setting.pairs.second)
    one, two = (s.part(some) for s, some in zip(_sources(setting, unit, tuning), rows, strict=True))
    return unit, one, two


def _sampled_centres(source: _Source, reach: float, d: int, most: int) -> IntArray:
    """Counted rows, sampled by a hash of their position so that about ``most`` neighbours are expected."""
    rows = np.flatnonzero(source.counted)
    expected = float(source.density[rows].sum()) * ball_volume(d) * reach**d + len(rows)
    if expected <= most:
        return rows
    bits = np.ascontiguousarray(source.points[rows, 0]).view(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    return rows[bits < np.uint64(int(most / expected * 2.0**64))]


def _edge_loss(source: _Source, d: int) -> float:
    """The fraction of pairs at a distance of 1 that the edges of the field remove."""
    return EDGES[d - 1] * math.pow(float(source.density.mean()) / len(source.points), 1.0 / d)


@in_short
@dataclass(frozen=True)
class _Neighbours:
    """Neighbour pairs of one source, c of them, each counted from both of its records.

    first : (c,) record that the pair is counted from. background : (c,) density of pairs of a Poisson field there;
    expected : their number. ring_density : (r, c) density added by a ring of unit volume; ring_expected : (r,) number.
    n_centres : records that pairs are counted from. n_records : all records. density : mean density at the centres.
    """

    first: IntArray
    background: FloatArray
    expected: float
    ring_density: FloatArray
    ring_expected: FloatArray
    n_centres: int
    n_records: int
    density: float

    @classmethod
    def of(cls, source: _Source, d: int, tuning: CompanionsTuning) -> _Neighbours | None:
        """The neighbour pairs of sampled records; None without any."""
        reach, centres = tuning.reach, _sampled_centres(source, tuning.reach, d, tuning.n_neighbours)
        if len(centres) < 2:
            return None
        i, k, distance = source.neighbours(reach, centres)
        if not len(i):
            return None
        density, variance = float(source.density[centres].mean()), source.variance[i] + source.variance[k]
        ring_density = density * np.array([ring(distance, radius, variance, d) for radius in tuning.radii])
        typical = 2.0 * np.quantile(source.variance[centres], VARIANCES)
        share = [float(share_within(reach, radius, typical, d).mean()) for radius in tuning.radii]
        # In a box of side L, pairs at distance r are 1 − c r/L of those without edges.
        edge = _edge_loss(source, d)
        background = 0.5 * (source.density[i] + source.density[k]) * np.maximum(1.0 - edge * distance, 0.1)
        inside = max(1.0 - edge * reach * d / (d + 1.0), 0.1)
        expected = float(source.density[centres].sum()) * ball_volume(d) * reach**d * inside
        ring_expected = density * len(centres) * np.array(share)
        return cls(i, background, expected, ring_density, ring_expected, len(centres), len(source.points), density)

    def log_likelihood(self, volume: FloatArray, level: float) -> float:
        """ln likelihood of the pairs, each counted once; ``level`` multiplies the background."""
        density = level * self.background + volume @ self.ring_density
        return 0.5 * (float(np.log(density).sum()) - level * self.expected - float(volume @ self.ring_expected))

    def companions(self, volume: FloatArray, level: float) -> FloatArray:
        """(c,) probability that a pair is two companions."""
        excess = volume @ self.ring_density
        return np.asarray(excess / (level * self.background + excess))


def clustering(setting: Setting, tuning: CompanionsTuning = DEFAULT_COMPANIONS) -> Clustering | None:
    """The excess of close neighbours in both sources; None without a significant excess."""
    sampled = None if sum(setting.n_counted) < sum(map(len, setting.counted)) else _sampled_sources(setting, tuning)
    if sampled is None:
        return None
    d, (unit, one, two) = setting.pairs.d, sampled
    of_1, of_2 = _Neighbours.of(one, d, tuning), _Neighbours.of(two, d, tuning)
    if of_1 is None or of_2 is None:
        return None
    volume, levels, gain = _fit_rings((of_1, of_2), tuning)
    if not gain > tuning.min_gain:
        return None
    densities = of_1.density, of_2.density
    clumps = Clustering(unit, np.array(tuning.radii), volume, 0.0, densities, level=math.sqrt(levels[0] * levels[1]))
    if float(volume.sum()) * max(densities) > tuning.max_companions:
        return clumps
    multiple, squared_mean, noise = 0.0, 0.0, 1.0
    for neighbours, level in zip((of_1, of_2), levels, strict=True):
        p = neighbours.companions(volume, level)
        several = float((np.bincount(neighbours.first, p, neighbours.n_records) ** 2).sum() - (p**2).sum())
        true, chance = float((p * p).sum()), float((p * (1.0 - p)).sum())
        if chance > tuning.max_chance_share * (chance + true):
            return clumps
        # A chance neighbour may itself be one of two companions.
        multiple += several - (chance**2 + 3.0 * chance * true) / neighbours.n_centres
        squared_mean += true**2 / neighbours.n_centres
        noise += 2.0 * several
    multiplicity = multiple / squared_mean if multiple > tuning.min_multiple_sigmas * math.sqrt(noise) else 0.0
    excess = replace(clumps, multiplicity=multiplicity, level=None)
    return replace(excess, shares=_fit_shares(excess, (one, two), tuning))


@in_short
@dataclass(frozen=True)
class CloseNeighbours:
    """Neighbour pairs of one source within their errors.

    n_records : records searched. n_pairs : pairs nearer than twice the typical error of a residual. by_chance : number
    expected from the local densities.
    """

    n_records: int
    n_pairs: int
    by_chance: float


def close_neighbours(
    setting: Setting, tuning: CompanionsTuning = DEFAULT_COMPANIONS
) -> tuple[CloseNeighbours, CloseNeighbours] | None:
    """Neighbour pairs of each source within their errors; None with too many records or dimensions."""
    sampled = _sampled_sources(setting, tuning)
    if sampled is None:
        return None
    one, two = (_close_neighbours(source, tuning.same_object_radius, setting.pairs.d) for source in sampled[1:])
    return one, two


def _close_neighbours(source: _Source, reach: float, d: int) -> CloseNeighbours:
    first, _, _ = source.neighbours(reach)
    by_chance = 0.5 * float(source.density.sum()) * ball_volume(d) * reach**d
    return CloseNeighbours(len(source.points), len(first) // 2, by_chance)


def _fit_rings(
    sources: tuple[_Neighbours, _Neighbours], tuning: CompanionsTuning
) -> tuple[FloatArray, tuple[float, float], float]:
    """(r,) ∫ w of each ring, factors on the background of both sources, and the gain in ln likelihood, by EM.

    All zero, 1 and 0 if no ring has significantly more pairs than the background.
    """
    expected = sources[0].ring_expected + sources[1].ring_expected
    levels = [len(source.background) / source.expected for source in sources]
    ratios = [source.ring_density / (level * source.background) for source, level in zip(sources, levels, strict=True)]
    excess = ratios[0].sum(axis=1) + ratios[1].sum(axis=1) - expected
    sigma = np.sqrt((ratios[0] ** 2).sum(axis=1) + (ratios[1] ** 2).sum(axis=1))
    if not (excess > tuning.min_excess_sigmas * sigma).any():
        return np.zeros(len(expected)), (1.0, 1.0), 0.0
    without = sum(x.log_likelihood(np.zeros(len(expected)), level) for x, level in zip(sources, levels, strict=True))
    n_pairs = sum(len(source.background) for source in sources)
    volume = np.full(len(expected), 0.1 * n_pairs / expected.sum() / len(expected))
    for _ in range(tuning.iterations):
        slope = np.zeros(len(expected))
        for s, source in enumerate(sources):
            density = levels[s] * source.background + volume @ source.ring_density
            slope += source.ring_density @ (1.0 / density)
            levels[s] *= float((source.background / density).sum()) / source.expected
        volume = volume * slope / expected
    fitted = sum(x.log_likelihood(volume, level) for x, level in zip(sources, levels, strict=True))
    return volume, (levels[0], levels[1]), fitted - without


def _fit_shares(
    clustering: Clustering, sources: tuple[_Source, _Source], tuning: CompanionsTuning
) -> tuple[float, float]:
    """Shares of the records of both sources that have a partner, from the number of close records of the other source
    in addition to companions; too low if the errors are larger than quoted."""
    one, two = sources
    i, k, distance = one.near(two, tuning.reach)
    n1, n2 = (int(np.count_nonzero(source.counted)) for source in sources)
    if not len(i):
        return 0.0, 0.0
    d, variance, (mean_1, mean_2) = clustering.d, one.variance[i] + two.variance[k], clustering.mean_densities
    # Densities of pairs, summed over all records: by chance, of companions and of common objects.
    scale = math.sqrt(n1 * n2 * mean_1 * mean_2)
    inside = np.maximum(1.0 - 0.5 * (_edge_loss(one, d) + _edge_loss(two, d)) * distance, 0.1)
    background = scale * inside * np.sqrt(one.density[i] * two.density[k] / (mean_1 * mean_2))
    companions, same = scale * clustering.excess_at(distance, variance), ring(distance, 0.0, variance, d)
    expected, most = scale * ball_volume(d) * tuning.reach**d, float(min(n1, n2))
    common, level = 0.5 * most, 1.0
    for _ in range(tuning.iterations):
        total = common * same + companions + level * background
        common = min(common * float((same / total).sum()), most)
        level *= float((background / total).sum()) / expected
    return common / n1, common / n2


@in_short
@dataclass(frozen=True)
class CompanionsRule(Rule):
    """The rule whose evidence for the pairs at ``index`` is ``term`` (q,), and 0 for the others."""

    index: IntArray
    term: FloatArray

    def __call__(self, pairs: Pairs) -> Evidence:
        out = np.zeros(len(pairs))
        out[self.index] = self.term
        return Evidence({"companions": out})


@in_short
@dataclass(frozen=True)
class Companions:
    """Companions among one list of candidates.

    index : (q,) pairs that companions matter for. excess : (q,) w at their residuals, by the local densities.
    companion_odds : (2, q) odds, in a Poisson field, that their record of each source has a companion at its position.
    log_swap : (q,) evidence from the separations of companions for which record is which.
    """

    clustering: Clustering
    index: IntArray
    excess: FloatArray
    companion_odds: FloatArray
    log_swap: FloatArray = field(repr=False)
    tuning: CompanionsTuning = DEFAULT_COMPANIONS

    @classmethod
    def of(cls, clustering: Clustering, setting: Setting, tuning: CompanionsTuning = DEFAULT_COMPANIONS) -> Companions:
        """The companions among all candidates of a setting."""
        pairs, unit = setting.pairs, clustering.unit
        one, two = _sources(setting, unit, tuning)
        residual = pairs.residual / unit
        local = clustering.mean_densities[0] / one.density, clustering.mean_densities[1] / two.density
        excess = clustering.excess_at(np.sqrt((residual**2).sum(axis=1)), one.variance[pairs.i] + two.variance[pairs.j])
        excess *= np.sqrt(local[0][pairs.i] * local[1][pairs.j])
        if clustering.level is not None:
            denser = np.log(np.maximum(clustering.level + excess, 1.0))
            index = np.flatnonzero(denser > 1e-3)
            return cls(clustering, index, excess[index], np.zeros((2, len(index))), -denser[index], tuning)
        odds, companion = [], []
        for source, relative in zip((one, two), local, strict=True):
            i, k, distance = source.neighbours(tuning.reach)
            variance = source.variance[i] + source.variance[k]
            w = clustering.excess_at(distance, variance) * np.sqrt(relative[i] * relative[k])
            odds.append(np.bincount(i, w, len(source.points)))
            companion.append(_mutual_companions(i, k, w / (1.0 + w), len(source.points)))
        log_swap = _log_swaps(clustering, setting, (one, two), residual, companion, tuning.competing_sq)
        index = np.flatnonzero((excess > 1e-3) | (log_swap != 0.0))
        companion_odds = np.array([odds[0][pairs.i[index]], odds[1][pairs.j[index]]], np.float64)
        return cls(clustering, index, excess[index], companion_odds, log_swap[index], tuning)

    @property
    def share(self) -> float:
        """Share of source 1's records that have a partner, from close pairs and companions."""
        return self.clustering.shares[0]

    @property
    def rule(self) -> CompanionsRule:
        """Evidence from the separations of companions."""
        return CompanionsRule(self.index, self.log_swap)

    def companion_log_odds(self, n: int, share_1: float, share_2: float) -> FloatArray:
        """(n,) ln of the odds, before one-to-one, that a pair is an object and its companion, each missed by the other
        source, against two unrelated objects; −∞ where companions do not matter.

        share_1, share_2 : of the records of each source that have a partner.
        """
        clustering, least = self.clustering, self.tuning.min_void
        (mean_1, mean_2), (known_1, known_2) = clustering.mean_densities, clustering.shares
        # At least the shares from close pairs: the shares of early EM iterations are too low, which would make
        # companions seem numerous, and that would keep the shares low.
        c1, c2 = max(share_2, known_2, 1e-3), max(share_1, known_1, 1e-3)
        number = float(clustering.volume.sum()) * math.sqrt(mean_1 * mean_2 / (c1 * c2))
        # For integers n with mean N, the mean of n (n − 1) is at least N (N − 1).
        x, t = 1.0 - (1.0 - c1) * (1.0 - c2), max(clustering.multiplicity, 1.0 - 1.0 / max(number, 1e-9))
        if t < 1.0:
            p = number * (1.0 - t)
            void = max(1.0 - p * x, least)
            none, one = 1.0 / void, t / void
            per_odds = 1.0 / max(1.0 - p * c1, least), 1.0 / max(1.0 - p * c2, least)
        else:
            unseen = math.exp(-number * t * x)
            none, one = unseen / (1.0 - 1.0 / t + unseen / t), t
            per_odds = none, none
        alone = 1.0 / ((1.0 + per_odds[0] * self.companion_odds[0]) * (1.0 + per_odds[1] * self.companion_odds[1]))
        out = np.full(n, -np.inf)
        with np.errstate(divide="ignore"):
            out[self.index] = np.log((one + (none - one) * alone) * self.excess)
        return out


def _mutual_companions(i: IntArray, k: IntArray, p: FloatArray, n: int) -> IntArray:
    """(n,) the companion of each record: mutually the most probable, with p > 0.5; ABSENT if none."""
    likely = np.flatnonzero(p > 0.5)
    order = likely[np.argsort(p[likely], kind="stable")]
    most_probable = np.full(n, ABSENT)
    most_probable[i[order]] = k[order]
    has = np.flatnonzero(most_probable >= 0)
    mutual = most_probable[most_probable[has]] == has
    out = np.full(n, ABSENT)
    out[has[mutual]] = most_probable[has[mutual]]
    return out


def _log_swaps(
    clustering: Clustering,
    setting: Setting,
    sources: tuple[_Source, _Source],
    residual: FloatArray,
    companion: list[IntArray],
    competing_sq: float,
) -> FloatArray:
    """(m,) evidence of pairs from the separation of companions, where two companions of one source compete for one or
    two records of the other source, and for no more."""
    pairs = setting.pairs
    i, j = pairs.i.astype(np.int64), pairs.j.astype(np.int64)
    near = pairs.mahalanobis_sq < competing_sq
    swaps = _Swaps(clustering, i, j, (sources[0].variance, sources[1].variance), residual)
    competing = [
        _Competing.of(mate, own[near], other[near]) for mate, own, other in zip(companion, (i, j), (j, i), strict=True)
    ]
    two_to_two = np.array([swaps.two_to_two(source, one) for source, one in enumerate(competing)])
    two_to_one = np.array([swaps.two_to_one(source, one) for source, one in enumerate(competing)])
    n_terms = np.count_nonzero(two_to_two, axis=0)
    mean = two_to_two.sum(axis=0) / np.maximum(n_terms, 1)
    return np.asarray(np.where(n_terms > 0, mean, two_to_one.sum(axis=0)))


@dataclass(frozen=True)
class _Competing:
    """Two companions of one source, and the records of the other source that either could have as partner.

    first, second : (c,) the companions. others : (m,) the records of the other source, companions by companions.
    rows : of these.
    """

    first: IntArray
    second: IntArray
    others: IntArray
    rows: Ragged

    @classmethod
    def of(cls, companion: IntArray, own: IntArray, other: IntArray) -> _Competing:
        """companion : (n,) of each record, ABSENT for none. own, other : (p,) the records of the pairs that compete."""
        first = np.flatnonzero(companion > np.arange(len(companion)))
        second = companion[first]
        number = np.full(len(companion), ABSENT)
        number[first] = number[second] = np.arange(len(first))
        has = number[own] >= 0
        competing = np.unique(np.column_stack([number[own[has]], other[has]]), axis=0)
        return cls(first, second, competing[:, 1], Ragged.of_sorted(competing[:, 0], len(first)))

    def with_others(self, number: int) -> tuple[IntArray, ...]:
        """The companions that compete for this number of records: first, second, and each of these records."""
        c = np.flatnonzero(self.rows.sizes == number)
        return self.first[c], self.second[c], *(self.others[self.rows.start[c] + k] for k in range(number))


@dataclass(frozen=True)
class _Swaps:
    """Evidence of pairs from the separations of companions.

    i, j : (m,) records of the pairs. variance : (n₁,), (n₂,) per axis. residual : (m, 2).
    """

    clustering: Clustering
    i: IntArray
    j: IntArray
    variance: tuple[FloatArray, FloatArray]
    residual: FloatArray

    @cached_property
    def _index(self) -> _PairIndex:
        return _PairIndex.of(self.i, self.j, len(self.variance[1]))

    def _pair(self, source: int, own: IntArray, other: IntArray) -> IntArray:
        """(k,) pairs of records of a source (0 or 1) with records of the other one, ABSENT if not a candidate."""
        return self._index(own, other) if source == 0 else self._index(other, own)

    def _log_w(self, separation: FloatArray, variance: FloatArray) -> FloatArray:
        return np.log1p(self.clustering.excess_at(np.sqrt((separation**2).sum(axis=1)), variance))

    def _fused(self, e: IntArray) -> tuple[FloatArray, FloatArray]:
        """Fused position of each pair relative to its record 1, and its variance."""
        v1, v2 = self.variance[0][self.i[e]], self.variance[1][self.j[e]]
        return (v1 / (v1 + v2))[:, None] * self.residual[e], v1 * v2 / (v1 + v2)

    def two_to_two(self, source: int, competing: _Competing) -> FloatArray:
        """(m,) evidence of the pairs of two companions of a source (0 or 1) with two records."""
        out, residual = np.zeros(len(self.i)), self.residual
        one, two, r, q = competing.with_others(2)
        four = np.array([self._pair(source, own, other) for own, other in ((one, r), (two, q), (one, q), (two, r))])
        a, b, x, y = four[:, (four >= 0).all(axis=0)]
        if not len(a):
            return out
        # Separation of the two records of source 1, from the residuals of two pairs with one record of source 2.
        (at_a, v_a), (at_b, v_b), (at_x, v_x), (at_y, v_y) = map(self._fused, (a, b, x, y))
        if source == 0:
            separation = residual[y] - residual[a]
            straight, crossed = separation - at_b + at_a, separation - at_y + at_x
        else:
            separation = residual[x] - residual[a]
            straight, crossed = separation - at_b + at_a, separation - at_x + at_y
        term = 0.25 * (self._log_w(straight, v_a + v_b) - self._log_w(crossed, v_x + v_y))
        for e, sign in ((a, 1.0), (b, 1.0), (x, -1.0), (y, -1.0)):
            out[e] = sign * term
        return out

    def two_to_one(self, source: int, competing: _Competing) -> FloatArray:
        """(m,) evidence of the pairs of two companions of a source (0 or 1) with one record."""
        out, residual = np.zeros(len(self.i)), self.residual
        one, two, r = competing.with_others(1)
        both = np.array([self._pair(source, one, r), self._pair(source, two, r)])
        a, b = both[:, (both >= 0).all(axis=0)]
        if not len(a):
            return out
        sign = 1.0 if source == 0 else -1.0
        records = (self.i, self.j)
        own, other = (self.variance[k][records[k]] for k in (source, 1 - source))  # of each pair
        separation = sign * (residual[b] - residual[a])
        w_a, w_b = (own[e] / (own[e] + other[e]) for e in (a, b))
        with_a = self._log_w(separation + sign * residual[a] * w_a[:, None], w_a * other[a] + own[b])
        with_b = self._log_w(-separation + sign * residual[b] * w_b[:, None], w_b * other[b] + own[a])
        term = 0.5 * (with_a - with_b)
        out[a], out[b] = term, -term
        return out


@dataclass(frozen=True)
class _PairIndex:
    """Index of a pair by its two records."""

    order: IntArray
    key: IntArray
    n2: int

    @classmethod
    def of(cls, i: IntArray, j: IntArray, n2: int) -> _PairIndex:
        key = i * n2 + j
        order = np.argsort(key)
        return cls(order, key[order], n2)

    def __call__(self, i: IntArray, j: IntArray) -> IntArray:
        """(k,) indices of pairs; ABSENT if not a candidate."""
        place = places_in(self.key, i * self.n2 + j)
        return np.asarray(np.where(place >= 0, self.order[place], ABSENT))

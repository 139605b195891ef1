"""Clustering: how many companions objects have, at which distances, from the excess of close neighbours.

Each source measures the number and distances of companions from the excess of close neighbours among its own records
over their density. The density of companions of an object, at a displacement u, is

    n κ(u),   κ = Σ_m share_m K(|u|; s_m, v),

with K a ring of radius s_m blurred by the variance v of both errors. It is the same for both sources, except for the
shares c₁, c₂ of objects that they show.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.estimate.cells import GridLevel, finest
from sameas.estimate.coverage import typical_error
from sameas.estimate.sample import Setting
from sameas.gate import Radius
from sameas.ragged import ranges
from sameas.records import Records
from sameas.space import ARCSEC_PER_RADIAN, Sphere, ball_volume, unit_vectors

#: Coefficients of √(2πx) e⁻ˣ I₀(x) in powers of 1/x (Abramowitz & Stegun 9.7.1), and the x from which they are exact to
#: 1e-15.
_EXPANSION, _LARGE = [math.prod((2 * j - 1) ** 2 / (8 * j) for j in range(1, k + 1)) for k in range(16)], 30.0


RADII = (0.0, 0.5, 1.0, 1.5, 2.0, 2.75, 3.5, 4.5, 5.5)  # of the rings, in typical standard deviations of a residual
COMPANIONS_REACH = 7.0  # greatest distance of neighbours, same unit
N_RECORDS = 8_000  # approximate number of records used, of each source
N_NEIGHBOURS = 30_000  # of their neighbour pairs
ITERATIONS = 100  # of the fits
MAX_RECORDS = 200_000  # of both sources; with more, companions are ignored
MAX_DIMENSIONS = 3  # of the space
MIN_EXCESS_SIGMAS = 2.5  # excess of neighbours at some distance over a Poisson field, in standard deviations, for a fit
MIN_GAIN = 8.0  # gain in ln likelihood of the neighbour pairs to accept the fit
#: Share of chance pairs among apparent companions; above it the field is crowded, and companions are ignored.
MAX_CHANCE_SHARE = 0.7
#: Per record; above it the field has clumps, which the local densities describe, and companions are ignored.
MAX_COMPANIONS = 1.2
MIN_MULTIPLE_SIGMAS = 2.5  # significance, in standard deviations, of records with several companions
MIN_VOID = 0.02  # lower limit of the probability that no companion of an object is shown
COMPETING_SQ = 25.0  # squared normalised distance within which records compete for a pair of companions
SAME_OBJECT_RADIUS = 2.0  # records of one source nearer than this, in the unit of RADII, may be one object
CELL, SEED = 1_000, 20_063  # mean number of records of both sources in a sampled cell, and the seed of the sample


#: Up to this many pairs in strips along one axis, all distances are computed; with more, the gate finds the near ones.
MAX_IN_STRIPS = 1_000_000
#: Quantiles of the variances at which averages over records are taken.
VARIANCES = np.linspace(0.01, 0.99, 50)

#: A box of side L has the fraction (this · r/L) fewer pairs at distance r than without edges, in 1, 2 and 3 dimensions.
EDGES = (1.0, 4.0 / math.pi, 1.5)


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


@dataclass(frozen=True)
class ScaledSource:
    """Records of one source in units of typical errors.

    points : (n, …) positions. even_records : the records with equal errors, for distances by the gate.
    variance : (n,) of each, per axis. density : (n,) of the source's records there. counted : (n,) whether it counts.
    """

    points: FloatArray
    even_records: Records
    variance: FloatArray
    density: FloatArray
    counted: BoolArray

    def part(self, rows: IntArray) -> ScaledSource:
        """The source with these rows only."""
        return replace(
            self, points=self.points[rows], even_records=self.even_records.part(rows), variance=self.variance[rows],
            density=self.density[rows], counted=self.counted[rows],
        )  # fmt: skip

    def near(
        self, other: ScaledSource, reach: float, max_in_strips: int = MAX_IN_STRIPS
    ) -> tuple[IntArray, IntArray, FloatArray]:
        """(m,) i, k and distance of pairs of a record of this source and one of the other within ``reach``."""
        axis = int(np.argmax(np.ptp(other.points, axis=0)))
        order = np.argsort(other.points[:, axis], kind="stable")
        along = other.points[order, axis]
        low, high = (np.searchsorted(along, self.points[:, axis] + side) for side in (-reach, reach))
        if int((high - low).sum()) <= max_in_strips:
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


def scaled_sources(setting: Setting, unit: FloatArray) -> tuple[ScaledSource, ScaledSource]:
    """Both sources of a setting. unit : (d,) typical error of a residual per axis, the unit of their distances."""
    scale = float(np.prod(unit))
    one, two = (
        ScaledSource(
            _points(records, unit), _with_equal_errors(records, unit), (records.variances / unit**2).mean(axis=1),
            density * scale, covered & counted,
        )
        for records, density, covered, counted in zip(
            (setting.pairs.first, setting.pairs.second), setting.densities, setting.covered, setting.counted,
            strict=True,
        )
    )  # fmt: skip
    return one, two


def _sampled_rows(levels: Sequence[GridLevel]) -> tuple[IntArray, IntArray]:
    """Rows of both sources in sampled cells with enough records of both; all rows if a sample were hardly smaller."""
    n1, n2 = len(levels[0].of_first), len(levels[0].of_second)
    if min(n1, n2) <= 2 * N_RECORDS:
        return np.arange(n1), np.arange(n2)
    level = finest(levels, (n1 + n2) / CELL)
    sampled = level.drawn((level.count(1), level.count(2)), N_RECORDS, SEED)
    return np.flatnonzero(sampled[level.of_first]), np.flatnonzero(sampled[level.of_second])


def _sampled_sources(setting: Setting) -> tuple[FloatArray, ScaledSource, ScaledSource] | None:
    """The typical error of a residual by axis, and both sources, sampled; None with too many records or dimensions."""
    if setting.pairs.d > MAX_DIMENSIONS or not 0 < sum(setting.n_counted) <= MAX_RECORDS:
        return None
    rows = _sampled_rows(setting.levels)
    unit = typical_error(setting.pairs.first, setting.pairs.second)
    one, two = (s.part(some) for s, some in zip(scaled_sources(setting, unit), rows, strict=True))
    return unit, one, two


def _sampled_centres(source: ScaledSource, reach: float, d: int, most: int) -> IntArray:
    """Counted rows, sampled by a hash of their position so that about ``most`` neighbours are expected."""
    rows = np.flatnonzero(source.counted)
    expected = float(source.density[rows].sum()) * ball_volume(d) * reach**d + len(rows)
    if expected <= most:
        return rows
    bits = np.ascontiguousarray(source.points[rows, 0]).view(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    return rows[bits < np.uint64(int(most / expected * 2.0**64))]


def _edge_loss(source: ScaledSource, d: int) -> float:
    """The fraction of pairs at a distance of 1 that the edges of the field remove."""
    return EDGES[d - 1] * math.pow(float(source.density.mean()) / len(source.points), 1.0 / d)


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
    def of(cls, source: ScaledSource, d: int) -> _Neighbours | None:
        """The neighbour pairs of sampled records; None without any."""
        reach, centres = COMPANIONS_REACH, _sampled_centres(source, COMPANIONS_REACH, d, N_NEIGHBOURS)
        if len(centres) < 2:
            return None
        i, k, distance = source.neighbours(reach, centres)
        if not len(i):
            return None
        density, variance = float(source.density[centres].mean()), source.variance[i] + source.variance[k]
        ring_density = density * np.array([ring(distance, radius, variance, d) for radius in RADII])
        typical = 2.0 * np.quantile(source.variance[centres], VARIANCES)
        share = [float(share_within(reach, radius, typical, d).mean()) for radius in RADII]
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


def clustering(setting: Setting) -> Clustering | None:
    """The excess of close neighbours in both sources; None without a significant excess."""
    sampled = None if sum(setting.n_counted) < sum(map(len, setting.counted)) else _sampled_sources(setting)
    if sampled is None:
        return None
    d, (unit, one, two) = setting.pairs.d, sampled
    of_1, of_2 = _Neighbours.of(one, d), _Neighbours.of(two, d)
    if of_1 is None or of_2 is None:
        return None
    volume, levels, gain = _fit_rings((of_1, of_2))
    if not gain > MIN_GAIN:
        return None
    densities = of_1.density, of_2.density
    clumps = Clustering(unit, np.array(RADII), volume, 0.0, densities, level=math.sqrt(levels[0] * levels[1]))
    if float(volume.sum()) * max(densities) > MAX_COMPANIONS:
        return clumps
    multiple, squared_mean, noise = 0.0, 0.0, 1.0
    for neighbours, level in zip((of_1, of_2), levels, strict=True):
        p = neighbours.companions(volume, level)
        several = float((np.bincount(neighbours.first, p, neighbours.n_records) ** 2).sum() - (p**2).sum())
        true, chance = float((p * p).sum()), float((p * (1.0 - p)).sum())
        if chance > MAX_CHANCE_SHARE * (chance + true):
            return clumps
        # A chance neighbour may itself be one of two companions.
        multiple += several - (chance**2 + 3.0 * chance * true) / neighbours.n_centres
        squared_mean += true**2 / neighbours.n_centres
        noise += 2.0 * several
    multiplicity = multiple / squared_mean if multiple > MIN_MULTIPLE_SIGMAS * math.sqrt(noise) else 0.0
    excess = replace(clumps, multiplicity=multiplicity, level=None)
    return replace(excess, shares=_fit_shares(excess, (one, two)))


@dataclass(frozen=True)
class CloseNeighbours:
    """Neighbour pairs of one source within their errors.

    n_records : records searched. n_pairs : pairs nearer than twice the typical error of a residual. by_chance : number
    expected from the local densities.
    """

    n_records: int
    n_pairs: int
    by_chance: float


def close_neighbours(setting: Setting) -> tuple[CloseNeighbours, CloseNeighbours] | None:
    """Neighbour pairs of each source within their errors; None with too many records or dimensions."""
    sampled = _sampled_sources(setting)
    if sampled is None:
        return None
    one, two = (_close_neighbours(source, SAME_OBJECT_RADIUS, setting.pairs.d) for source in sampled[1:])
    return one, two


def _close_neighbours(source: ScaledSource, reach: float, d: int) -> CloseNeighbours:
    first, _, _ = source.neighbours(reach)
    by_chance = 0.5 * float(source.density.sum()) * ball_volume(d) * reach**d
    return CloseNeighbours(len(source.points), len(first) // 2, by_chance)


def _fit_rings(sources: tuple[_Neighbours, _Neighbours]) -> tuple[FloatArray, tuple[float, float], float]:
    """(r,) ∫ w of each ring, factors on the background of both sources, and the gain in ln likelihood, by EM.

    All zero, 1 and 0 if no ring has significantly more pairs than the background.
    """
    expected = sources[0].ring_expected + sources[1].ring_expected
    levels = [len(source.background) / source.expected for source in sources]
    ratios = [source.ring_density / (level * source.background) for source, level in zip(sources, levels, strict=True)]
    excess = ratios[0].sum(axis=1) + ratios[1].sum(axis=1) - expected
    sigma = np.sqrt((ratios[0] ** 2).sum(axis=1) + (ratios[1] ** 2).sum(axis=1))
    if not (excess > MIN_EXCESS_SIGMAS * sigma).any():
        return np.zeros(len(expected)), (1.0, 1.0), 0.0
    without = sum(x.log_likelihood(np.zeros(len(expected)), level) for x, level in zip(sources, levels, strict=True))
    n_pairs = sum(len(source.background) for source in sources)
    volume = np.full(len(expected), 0.1 * n_pairs / expected.sum() / len(expected))
    for _ in range(ITERATIONS):
        slope = np.zeros(len(expected))
        for s, source in enumerate(sources):
            density = levels[s] * source.background + volume @ source.ring_density
            slope += source.ring_density @ (1.0 / density)
            levels[s] *= float((source.background / density).sum()) / source.expected
        volume = volume * slope / expected
    fitted = sum(x.log_likelihood(volume, level) for x, level in zip(sources, levels, strict=True))
    return volume, (levels[0], levels[1]), fitted - without


def _fit_shares(clustering: Clustering, sources: tuple[ScaledSource, ScaledSource]) -> tuple[float, float]:
    """Shares of the records of both sources that have a partner, from the number of close records of the other source
    in addition to companions; too low if the errors are larger than quoted."""
    one, two = sources
    i, k, distance = one.near(two, COMPANIONS_REACH)
    n1, n2 = (int(np.count_nonzero(source.counted)) for source in sources)
    if not len(i):
        return 0.0, 0.0
    d, variance, (mean_1, mean_2) = clustering.d, one.variance[i] + two.variance[k], clustering.mean_densities
    # Densities of pairs, summed over all records: by chance, of companions and of common objects.
    scale = math.sqrt(n1 * n2 * mean_1 * mean_2)
    inside = np.maximum(1.0 - 0.5 * (_edge_loss(one, d) + _edge_loss(two, d)) * distance, 0.1)
    background = scale * inside * np.sqrt(one.density[i] * two.density[k] / (mean_1 * mean_2))
    companions, same = scale * clustering.excess_at(distance, variance), ring(distance, 0.0, variance, d)
    expected, most = scale * ball_volume(d) * COMPANIONS_REACH**d, float(min(n1, n2))
    common, level = 0.5 * most, 1.0
    for _ in range(ITERATIONS):
        total = common * same + companions + level * background
        common = min(common * float((same / total).sum()), most)
        level *= float((background / total).sum()) / expected
    return common / n1, common / n2

"""Companions: objects lie nearer to each other than a Poisson field has them, as binaries and members of groups do.

A record whose object the other source misses has, where a companion of it was shown, a record beside it that looks
like its partner. How many companions objects have, and how far away, each source tells by itself: by couples of its own
records nearer than its densities let expect. The density of companions of an object, at a displacement u, is

    n κ(u),   κ = Σ_m share_m K(|u|; s_m, v),

with K a ring of radius s_m blurred by the variance v of both errors; the same for both sources but for the shares c₁,
c₂ of objects that they show. With k other companions shown and x = 1 − q₁q₂ the chance that one is shown at all, the
density of different objects near a record, ρ for a Poisson field, is ρ + G⁽ᵏ⁺¹⁾/G⁽ᵏ⁾ κ, where G is the generating
function of the number of companions at q₁q₂ = 1 − x: binomial where few have more than one, else of Poisson numbers
that a part of the objects have.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.estimate.cells import GridLevel, finest
from sameas.estimate.sample import Setting
from sameas.evidence.rule import Evidence, Rule
from sameas.gate import Pairs, Radius
from sameas.ragged import places_in, ranges
from sameas.records import Records
from sameas.representation import in_short
from sameas.space import ARCSEC_PER_RADIAN, Sphere, ball_volume, unit_vectors


@dataclass(frozen=True)
class CompanionsTuning:
    """When companions are believed.

    Attributes
    ----------
    radii : of the rings, in typical standard deviations of a residual. reach : so far companions are counted, in the
        same unit.
    records : of each source tell, about. couples : of them, about. iterations : of the fit.
    most_records : of both sources for which they are asked. most_dimensions : of the space.
    score : standard deviations by which couples at one distance must be more than a Poisson field has, for a fit.
    gain : ln of the likelihood of the couples by which companions must better it.
    mistaken : where a larger part of what looks like a companion is there by chance, the field is crowded, and
    most : where records have more companions than this, it has clumps: of both the local densities tell.
    significant : standard deviations by which records must have more than one companion, for that to be believed.
    least_void : probability at least that no companion of an object is shown.
    near : squares of normalised distances within which records compete for a couple.
    beside : records of one source nearer than this, in the unit of ``radii``, may be of one object.
    """

    radii: tuple[float, ...] = (0.0, 0.5, 1.0, 1.5, 2.0, 2.75, 3.5, 4.5, 5.5)
    reach: float = 7.0
    records: int = 8_000
    couples: int = 30_000
    iterations: int = 100
    most_records: int = 200_000
    most_dimensions: int = 3
    score: float = 2.5
    gain: float = 8.0
    mistaken: float = 0.7
    most: float = 1.2
    significant: float = 2.5
    least_void: float = 0.02
    near: float = 25.0
    beside: float = 2.0


DEFAULT_COMPANIONS = CompanionsTuning()
#: Records of both sources in a cell that is drawn, on average, and the seed of the draw.
CELL, SEED = 1_000, 20_063
#: Pairs in strips along one axis that are measured all; where there are more, the gate finds those that count.
STRIP = 1_000_000
#: Quantiles of the variances that stand for all.
VARIANCES = np.linspace(0.01, 0.99, 50)
#: By how much of r/L fewer couples at a distance r a box of side L has than it would have without edges, in one, two
#: and three dimensions.
EDGES = (1.0, 4.0 / math.pi, 1.5)


#: Coefficients of √(2πx) e⁻ˣ I₀(x) in powers of 1/x (Abramowitz & Stegun 9.7.1), and the x from which so many give
#: it to 1e-15.
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
    """(m,) density of points at a distance, that lie on a sphere of a radius blurred by a variance per axis."""
    with np.errstate(over="ignore"):
        x = distance * radius / variance
    peak = (2.0 * math.pi * variance) ** (-0.5 * d) * np.exp(-0.5 * (distance - radius) ** 2 / variance)
    if d == 2:
        return np.asarray(peak * scaled_i0(x))
    if d == 1:
        return np.asarray(peak * 0.5 * (1.0 + np.exp(-2.0 * x)))
    return np.asarray(peak * np.where(x > 1e-6, -np.expm1(-2.0 * x) / np.maximum(2.0 * x, 1e-300), 1.0))


def within(reach: float, radius: float, variance: FloatArray, d: int) -> FloatArray:
    """(m,) share of such points nearer than ``reach`` (which is larger than the radius) to the middle."""
    steps = np.linspace(0.0, 10.0, 401)
    distance = reach + steps * np.sqrt(variance)[:, None]
    surface = (2.0, 2.0 * math.pi * distance, 4.0 * math.pi * distance**2)[d - 1]
    beyond = surface * ring(distance, radius, variance[:, None], d)
    return np.asarray(1.0 - np.trapezoid(beyond, distance, axis=1))


@in_short
@dataclass(frozen=True)
class Clustering:
    """The excess of close couples: 1 + w(u) times as many as a Poisson field has.

    unit : (d,) typical standard deviation of a residual, in which all lengths are. radii : (r,) of the rings.
    volume : (r,) ∫ w of each. further : how many times as many companions an object has that has one.
    mean : (ρ₁, ρ₂) mean densities. shares : of the records of either source that have a partner, by how many of the
        other lie near; 0 where not asked.
    """

    unit: FloatArray
    radii: FloatArray
    volume: FloatArray
    further: float
    mean: tuple[float, float]
    shares: tuple[float, float] = (0.0, 0.0)

    @property
    def d(self) -> int:
        return len(self.unit)

    def at(self, distance: FloatArray, variance: FloatArray) -> FloatArray:
        """(m,) w at a distance, blurred."""
        total = np.zeros(len(distance))
        for radius, volume in zip(self.radii, self.volume, strict=True):
            if volume > 0.0:
                total += volume * ring(distance, float(radius), variance, self.d)
        return total


@in_short
@dataclass(frozen=True)
class _Source:
    """Records of one source in typical errors. points : (n, …) where they are. evenly : they with errors all the same,
    by which the gate measures distances."""

    points: FloatArray
    evenly: Records
    variance: FloatArray
    density: FloatArray
    counted: BoolArray

    def part(self, rows: IntArray) -> _Source:
        """Some of its records."""
        return _Source(
            self.points[rows], self.evenly.part(rows), self.variance[rows], self.density[rows], self.counted[rows]
        )

    def near(self, other: _Source, reach: float) -> tuple[IntArray, IntArray, FloatArray]:
        """(m,) pairs of a record of this and one of the other, and how far apart they are."""
        axis = int(np.argmax(np.ptp(other.points, axis=0)))
        order = np.argsort(other.points[:, axis], kind="stable")
        along = other.points[order, axis]
        low, high = (np.searchsorted(along, self.points[:, axis] + side) for side in (-reach, reach))
        if int((high - low).sum()) <= STRIP:
            i, place = ranges(low, high - low)
            k = order[place]
            distance = np.sqrt(((self.points[i] - other.points[k]) ** 2).sum(axis=1))
            found = distance <= reach
            return i[found], k[found], distance[found]
        pairs = Radius(reach)(self.evenly, other.evenly)
        return pairs.i.astype(np.int64), pairs.j.astype(np.int64), np.sqrt(pairs.mahalanobis_sq)

    def couples(self, reach: float, centres: IntArray | None = None) -> tuple[IntArray, IntArray, FloatArray]:
        """(c,) couples of its records, seen from each, or from some."""
        i, k, distance = (self if centres is None else self.part(centres)).near(self, reach)
        i = i if centres is None else centres[i]
        other = i != k
        return i[other], k[other], distance[other]


def _unit(setting: Setting) -> FloatArray:
    one, two = setting.pairs.first, setting.pairs.second
    variance = np.median(one.variances, axis=0) + np.median(two.variances, axis=0)
    if isinstance(one.space, Sphere):
        variance = variance.mean()
    return np.array(np.broadcast_to(np.sqrt(variance), setting.pairs.d))


def _points(records: Records, unit: FloatArray) -> FloatArray:
    if isinstance(records.space, Sphere):
        return np.asarray(unit_vectors(*records.features.T) * (ARCSEC_PER_RADIAN / unit[0]))
    return np.asarray(records.features / unit)


def _evenly(records: Records, unit: FloatArray) -> Records:
    variance = 0.5 * (unit[:1] if isinstance(records.space, Sphere) else unit) ** 2
    return replace(records, covariance=np.tile(variance, (len(records), 1)))


def _sources(setting: Setting, unit: FloatArray) -> tuple[_Source, _Source]:
    scale = float(np.prod(unit))
    one, two = (
        _Source(
            _points(records, unit),
            _evenly(records, unit),
            (records.variances / unit**2).mean(axis=1),
            density * scale,
            seen & counted,
        )
        for records, density, seen, counted in zip(
            (setting.pairs.first, setting.pairs.second), setting.densities, setting.seen, setting.counted, strict=True
        )
    )
    return one, two


def _drawn(levels: Sequence[GridLevel], enough: int) -> tuple[IntArray, IntArray]:
    """Records of either source in cells that hold enough of both; all, where these are hardly fewer."""
    n1, n2 = len(levels[0].of_first), len(levels[0].of_second)
    if min(n1, n2) <= 2 * enough:
        return np.arange(n1), np.arange(n2)
    level = finest(levels, (n1 + n2) / CELL)
    drawn = level.drawn((level.count(1), level.count(2)), enough, SEED)
    return np.flatnonzero(drawn[level.of_first]), np.flatnonzero(drawn[level.of_second])


def _asked(setting: Setting, tuning: CompanionsTuning) -> tuple[_Source, _Source] | None:
    """The records of either source that are asked of couples; None where there are too many, or dimensions."""
    if setting.pairs.d > tuning.most_dimensions or not 0 < sum(setting.numbers) <= tuning.most_records:
        return None
    rows = _drawn(setting.levels, tuning.records)
    one, two = (s.part(some) for s, some in zip(_sources(setting, _unit(setting)), rows, strict=True))
    return one, two


def _some_centres(source: _Source, reach: float, d: int, most: int) -> IntArray:
    rows = np.flatnonzero(source.counted)
    due = float(source.density[rows].sum()) * ball_volume(d) * reach**d + len(rows)
    if due <= most:
        return rows
    bits = np.ascontiguousarray(source.points[rows, 0]).view(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    return rows[bits < np.uint64(int(most / due * 2.0**64))]


def _edge(source: _Source, d: int) -> float:
    """By which share fewer couples there are at a distance of 1."""
    return EDGES[d - 1] * math.pow(float(source.density.mean()) / len(source.points), 1.0 / d)


@in_short
@dataclass(frozen=True)
class _Couples:
    """Couples of one source's records, c of them, each from either of its records.

    first : (c,) the record that it is seen from. background : (c,) density of couples of a Poisson field there, and
    expected : how many of them are due. table : (r, c) what a ring of unit volume adds, (r,) due : how many that is.
    centres : records that couples are seen from, size : records of them all, density : their mean one.
    """

    first: IntArray
    background: FloatArray
    expected: float
    table: FloatArray
    due: FloatArray
    centres: int
    size: int
    density: float

    @classmethod
    def of(cls, source: _Source, d: int, tuning: CompanionsTuning) -> _Couples | None:
        """Those of some records; None where there is none."""
        reach, centres = tuning.reach, _some_centres(source, tuning.reach, d, tuning.couples)
        if len(centres) < 2:
            return None
        i, k, distance = source.couples(reach, centres)
        if not len(i):
            return None
        density, variance = float(source.density[centres].mean()), source.variance[i] + source.variance[k]
        table = density * np.array([ring(distance, radius, variance, d) for radius in tuning.radii])
        typical = 2.0 * np.quantile(source.variance[centres], VARIANCES)
        due = [float(within(reach, radius, typical, d).mean()) for radius in tuning.radii]
        # Near its edge a field has fewer at a distance: of a box of side L, a share 1 − c r/L of all couples.
        edge = _edge(source, d)
        background = 0.5 * (source.density[i] + source.density[k]) * np.maximum(1.0 - edge * distance, 0.1)
        inside = max(1.0 - edge * reach * d / (d + 1.0), 0.1)
        expected = float(source.density[centres].sum()) * ball_volume(d) * reach**d * inside
        due_of_all = density * len(centres) * np.array(due)
        return cls(i, background, expected, table, due_of_all, len(centres), len(source.points), density)

    def log_likelihood(self, volume: FloatArray, level: float) -> float:
        """ln of that of the couples, each counted once."""
        density = level * self.background + volume @ self.table
        return 0.5 * (float(np.log(density).sum()) - level * self.expected - float(volume @ self.due))

    def companions(self, volume: FloatArray, level: float) -> FloatArray:
        """(c,) how probable it is that a couple is one of companions."""
        excess = volume @ self.table
        return np.asarray(excess / (level * self.background + excess))


def clustering(setting: Setting, tuning: CompanionsTuning = DEFAULT_COMPANIONS) -> Clustering | None:
    """The excess of close couples in both sources; None where there is none to be seen."""
    asked = None if sum(setting.numbers) < sum(map(len, setting.counted)) else _asked(setting, tuning)
    if asked is None:
        return None
    d, unit, (one, two) = setting.pairs.d, _unit(setting), asked
    of_1, of_2 = _Couples.of(one, d, tuning), _Couples.of(two, d, tuning)
    if of_1 is None or of_2 is None:
        return None
    volume, levels, gain = _fitted((of_1, of_2), tuning)
    if not gain > tuning.gain or float(volume.sum()) * max(of_1.density, of_2.density) > tuning.most:
        return None
    squares, firsts, noise = 0.0, 0.0, 1.0
    for couples, level in zip((of_1, of_2), levels, strict=True):
        p = couples.companions(volume, level)
        several = float((np.bincount(couples.first, p, couples.size) ** 2).sum() - (p**2).sum())
        ours, chance = float((p * p).sum()), float((p * (1.0 - p)).sum())
        if chance > tuning.mistaken * (chance + ours):
            return None
        # What is there by chance may be a couple itself.
        squares += several - (chance**2 + 3.0 * chance * ours) / couples.centres
        firsts += ours**2 / couples.centres
        noise += 2.0 * several
    further = squares / firsts if squares > tuning.significant * math.sqrt(noise) else 0.0
    known = Clustering(unit, np.array(tuning.radii), volume, further, (of_1.density, of_2.density))
    return replace(known, shares=_shares(known, (one, two), tuning))


@in_short
@dataclass(frozen=True)
class CloseCouples:
    """Records of one source nearer to each other than their errors.

    records : that were looked at. couples : of them, nearer than twice the typical error of a residual. by_chance : as
    many are due by the local densities.
    """

    records: int
    couples: int
    by_chance: float


def close_couples(
    setting: Setting, tuning: CompanionsTuning = DEFAULT_COMPANIONS
) -> tuple[CloseCouples, CloseCouples] | None:
    """How many records of either source lie nearer to each other than their errors; None where not asked."""
    asked = _asked(setting, tuning)
    if asked is None:
        return None
    one, two = (_close_couples(source, tuning.beside, setting.pairs.d) for source in asked)
    return one, two


def _close_couples(source: _Source, reach: float, d: int) -> CloseCouples:
    first, _, _ = source.couples(reach)
    by_chance = 0.5 * float(source.density.sum()) * ball_volume(d) * reach**d
    return CloseCouples(len(source.points), len(first) // 2, by_chance)


def _fitted(
    sources: tuple[_Couples, _Couples], tuning: CompanionsTuning
) -> tuple[FloatArray, tuple[float, float], float]:
    """(r,) ∫ w of each ring, how many times as many other couples there are as densities say, and by how much that
    betters ln of the likelihood without companions: by EM, couple by couple; none where no distance has more."""
    due = sources[0].due + sources[1].due
    levels = [len(couples.background) / couples.expected for couples in sources]
    ratios = [couples.table / (level * couples.background) for couples, level in zip(sources, levels, strict=True)]
    more = ratios[0].sum(axis=1) + ratios[1].sum(axis=1) - due
    spread = np.sqrt((ratios[0] ** 2).sum(axis=1) + (ratios[1] ** 2).sum(axis=1))
    if not (more > tuning.score * spread).any():
        return np.zeros(len(due)), (1.0, 1.0), 0.0
    none = sum(x.log_likelihood(np.zeros(len(due)), level) for x, level in zip(sources, levels, strict=True))
    volume = np.full(len(due), 0.1 * sum(len(couples.background) for couples in sources) / due.sum() / len(due))
    for _ in range(tuning.iterations):
        seen = np.zeros(len(due))
        for s, couples in enumerate(sources):
            density = levels[s] * couples.background + volume @ couples.table
            seen += couples.table @ (1.0 / density)
            levels[s] *= float((couples.background / density).sum()) / couples.expected
        volume = volume * seen / due
    found = sum(x.log_likelihood(volume, level) for x, level in zip(sources, levels, strict=True))
    return volume, (levels[0], levels[1]), found - none


def _shares(known: Clustering, sources: tuple[_Source, _Source], tuning: CompanionsTuning) -> tuple[float, float]:
    """Of the records of either source that have a partner, by how many of the other lie near beside companions of
    theirs; too low where errors are larger than thought."""
    one, two = sources
    i, k, distance = one.near(two, tuning.reach)
    n1, n2 = (int(np.count_nonzero(source.counted)) for source in sources)
    if not len(i):
        return 0.0, 0.0
    v = one.variance[i] + two.variance[k]
    # Per unit of volume about all records: pairs there by chance, and of companions.
    scale = math.sqrt(n1 * n2 * known.mean[0] * known.mean[1])
    inside = np.maximum(1.0 - 0.5 * (_edge(one, known.d) + _edge(two, known.d)) * distance, 0.1)
    background = scale * inside * np.sqrt(one.density[i] * two.density[k] / (known.mean[0] * known.mean[1]))
    companions, same = scale * known.at(distance, v), ring(distance, 0.0, v, known.d)
    due, most = scale * ball_volume(known.d) * tuning.reach**known.d, float(min(n1, n2))
    common, level = 0.5 * most, 1.0
    for _ in range(tuning.iterations):
        total = common * same + companions + level * background
        common = min(common * float((same / total).sum()), most)
        level *= float((background / total).sum()) / due
    return common / n1, common / n2


@in_short
@dataclass(frozen=True)
class CompanionsRule(Rule):
    """What companions say of pairs."""

    at: IntArray
    term: FloatArray

    def __call__(self, pairs: Pairs) -> Evidence:
        out = np.zeros(len(pairs))
        out[self.at] = self.term
        return Evidence({"companions": out})


@in_short
@dataclass(frozen=True)
class Companions:
    """What is known of companions, for one list of candidates.

    at : (q,) pairs that it matters for. excess : (q,) w of their residuals, by the densities there.
    shown : (2, q) odds that their record of either source has a companion there, if objects had no more than a Poisson
        field has. swap : (q,) ln of what the separations of couples say of which of two is which.
    """

    clustering: Clustering
    at: IntArray
    excess: FloatArray
    shown: FloatArray
    swap: FloatArray = field(repr=False)
    tuning: CompanionsTuning = DEFAULT_COMPANIONS

    @classmethod
    def of(cls, clustering: Clustering, setting: Setting, tuning: CompanionsTuning = DEFAULT_COMPANIONS) -> Companions:
        """For all candidates of a setting."""
        pairs, unit = setting.pairs, clustering.unit
        one, two = _sources(setting, unit)
        residual = pairs.residual / unit
        local = clustering.mean[0] / one.density, clustering.mean[1] / two.density
        excess = clustering.at(np.sqrt((residual**2).sum(axis=1)), one.variance[pairs.i] + two.variance[pairs.j])
        excess *= np.sqrt(local[0][pairs.i] * local[1][pairs.j])
        numbers, companion = [], []
        for source, relative in zip((one, two), local, strict=True):
            i, k, distance = source.couples(tuning.reach)
            w = clustering.at(distance, source.variance[i] + source.variance[k]) * np.sqrt(relative[i] * relative[k])
            numbers.append(np.bincount(i, w, len(source.points)))
            companion.append(_companion(i, k, w / (1.0 + w), len(source.points)))
        swap = _swaps(clustering, setting, (one, two), residual, companion, tuning.near)
        at = np.flatnonzero((excess > 1e-3) | (swap != 0.0))
        shown = np.array([numbers[0][pairs.i[at]], numbers[1][pairs.j[at]]], np.float64)
        return cls(clustering, at, excess[at], shown, swap[at], tuning)

    @property
    def share(self) -> float:
        """Of source 1's records that have a partner, as close pairs beyond chance and companions show."""
        return self.clustering.shares[0]

    @property
    def rule(self) -> CompanionsRule:
        """What the separations of couples say of which is which."""
        return CompanionsRule(self.at, self.swap)

    def log_beside(self, n: int, share_1: float, share_2: float) -> FloatArray:
        """(n,) ln of the odds of pairs, before one-to-one, to be an object and a companion of it, each missed by the
        other source, against objects that have nothing to do with each other.

        share_1, share_2 : of the records of either source that have a partner.
        """
        known, least = self.clustering, self.tuning.least_void
        # Shares that are still being estimated must not fall because companions seem to be many, nor these grow by it.
        c1, c2 = max(share_2, known.shares[1], 1e-3), max(share_1, known.shares[0], 1e-3)
        number = float(known.volume.sum()) * math.sqrt(known.mean[0] * known.mean[1] / (c1 * c2))
        # Of whole numbers n with the mean N, the mean of n (n − 1) is not below N (N − 1).
        x, t = 1.0 - (1.0 - c1) * (1.0 - c2), max(known.further, 1.0 - 1.0 / max(number, 1e-9))
        if t < 1.0:
            p = number * (1.0 - t)
            void = max(1.0 - p * x, least)
            none, one = 1.0 / void, t / void
            here = 1.0 / max(1.0 - p * c1, least), 1.0 / max(1.0 - p * c2, least)
        else:
            unseen = math.exp(-number * t * x)
            none, one = unseen / (1.0 - 1.0 / t + unseen / t), t
            here = none, none
        alone = 1.0 / ((1.0 + here[0] * self.shown[0]) * (1.0 + here[1] * self.shown[1]))
        out = np.full(n, -np.inf)
        with np.errstate(divide="ignore"):
            out[self.at] = np.log((one + (none - one) * alone) * self.excess)
        return out


def _companion(i: IntArray, k: IntArray, p: FloatArray, n: int) -> IntArray:
    """(n,) the companion of each record, mutually the likeliest and likelier than not; −1 where there is none."""
    sure = np.flatnonzero(p > 0.5)
    order = sure[np.argsort(p[sure], kind="stable")]
    likeliest = np.full(n, -1)
    likeliest[i[order]] = k[order]
    has = np.flatnonzero(likeliest >= 0)
    mutual = likeliest[likeliest[has]] == has
    out = np.full(n, -1)
    out[has[mutual]] = likeliest[has[mutual]]
    return out


def _swaps(
    clustering: Clustering,
    setting: Setting,
    sources: tuple[_Source, _Source],
    residual: FloatArray,
    companion: list[IntArray],
    nearest: float,
) -> FloatArray:
    """(m,) what the separations of couples say of pairs, where two records of a source compete for one or two of the
    other, and for no more."""
    pairs = setting.pairs
    i, j = pairs.i.astype(np.int64), pairs.j.astype(np.int64)
    near = pairs.mahalanobis_sq < nearest
    found = _Lookup.of(i, j, len(pairs.second))
    v1, v2 = sources[0].variance, sources[1].variance
    two_of_both, two_of_one = np.zeros((2, len(pairs))), np.zeros((2, len(pairs)))

    def log_w(apart: FloatArray, variance: FloatArray) -> FloatArray:
        return np.log1p(clustering.at(np.sqrt((apart**2).sum(axis=1)), variance))

    def fused(of: IntArray) -> tuple[FloatArray, FloatArray]:
        total = v1[i[of]] + v2[j[of]]
        return (v1[i[of]] / total)[:, None] * residual[of], v1[i[of]] * v2[j[of]] / total

    for source, (mine, theirs) in enumerate(((i, j), (j, i))):
        mate = companion[source]
        one = np.flatnonzero(mate > np.arange(len(mate)))
        two = mate[one]
        number = np.full(len(mate), -1)
        number[one] = number[two] = np.arange(len(one))
        # Records of the other source that either could have.
        e = np.flatnonzero(near & (number[mine] >= 0))
        known = np.unique(np.column_stack([number[mine[e]], theirs[e]]), axis=0)
        count = np.bincount(known[:, 0], minlength=len(one))
        start = np.concatenate([[0], np.cumsum(count)])[:-1]

        def pair(a: IntArray, b: IntArray, source: int = source) -> IntArray:
            return found(a, b) if source == 0 else found(b, a)

        c = np.flatnonzero(count == 2)
        r, q = known[start[c], 1], known[start[c] + 1, 1]
        four = np.array([pair(one[c], r), pair(two[c], q), pair(one[c], q), pair(two[c], r)])
        a, b, x, y = four[:, (four >= 0).all(axis=0)]
        if len(a):
            # From the first of source 1 to its second, by way of the record of source 2 that both pairs have.
            (at_a, v_a), (at_b, v_b), (at_x, v_x), (at_y, v_y) = map(fused, (a, b, x, y))
            if source == 0:
                apart = residual[y] - residual[a]
                straight, crossed = apart - at_b + at_a, apart - at_y + at_x
            else:
                apart = residual[x] - residual[a]
                straight, crossed = apart - at_b + at_a, apart - at_x + at_y
            says = 0.25 * (log_w(straight, v_a + v_b) - log_w(crossed, v_x + v_y))
            for of, sign in ((a, 1.0), (b, 1.0), (x, -1.0), (y, -1.0)):
                two_of_both[source, of] = sign * says
        c = np.flatnonzero(count == 1)
        r = known[start[c], 1]
        both = np.array([pair(one[c], r), pair(two[c], r)])
        a, b = both[:, (both >= 0).all(axis=0)]
        if len(a):
            own, other = (v1, v2) if source == 0 else (v2, v1)
            sign = 1.0 if source == 0 else -1.0
            apart = sign * (residual[b] - residual[a])
            w_a, w_b = (own[mine[of]] / (own[mine[of]] + other[theirs[of]]) for of in (a, b))
            with_a = log_w(apart + sign * residual[a] * w_a[:, None], w_a * other[theirs[a]] + own[mine[b]])
            with_b = log_w(-apart + sign * residual[b] * w_b[:, None], w_b * other[theirs[b]] + own[mine[a]])
            says = 0.5 * (with_a - with_b)
            two_of_one[source, a], two_of_one[source, b] = says, -says
    said = np.count_nonzero(two_of_both, axis=0)
    both = two_of_both.sum(axis=0) / np.maximum(said, 1)
    return np.asarray(np.where(said > 0, both, two_of_one.sum(axis=0)))


@dataclass(frozen=True)
class _Lookup:
    """Where a pair of two records stands."""

    order: IntArray
    key: IntArray
    n2: int

    @classmethod
    def of(cls, i: IntArray, j: IntArray, n2: int) -> _Lookup:
        key = i * n2 + j
        order = np.argsort(key)
        return cls(order, key[order], n2)

    def __call__(self, i: IntArray, j: IntArray) -> IntArray:
        """(k,) positions of pairs; −1 of those that are none."""
        place = places_in(self.key, i * self.n2 + j)
        return np.asarray(np.where(place >= 0, self.order[place], -1))

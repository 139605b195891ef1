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
from sameas.estimate.cells import GridLevel
from sameas.estimate.sample import Setting
from sameas.evidence.rule import Evidence, Rule
from sameas.gate import Pairs
from sameas.records import Records
from sameas.representation import in_short
from sameas.space import ARCSEC_PER_RADIAN, Sphere, unit_vectors


@dataclass(frozen=True)
class CompanionsTuning:
    """Attributes
    ----------
    radii : of the rings, in typical standard deviations of a residual. reach : so far companions are counted, in the
        same unit.
    gain : ln of the likelihood by which companions must better that of the couples.
    couples : about so many, of each source, tell.
    most_dimensions : of the space.
    iterations : of the fit.
    """

    radii: tuple[float, ...] = (0.0, 0.5, 1.0, 1.5, 2.0, 2.75, 3.5, 4.5, 5.5)
    reach: float = 7.0
    gain: float = 8.0
    couples: int = 30_000
    records: int = 8_000
    most_records: int = 200_000
    score: float = 2.5
    most_dimensions: int = 3
    iterations: int = 100
    mistaken: float = 0.7
    most: float = 1.2
    significant: float = 2.5


DEFAULT_COMPANIONS = CompanionsTuning()
#: Squares of normalised distances within which records compete for a couple.
NEAR = 25.0
#: Records of both sources in a cell that is drawn, on average, and the seed of the draw.
CELL, SEED = 1_000, 20_063
#: Quantiles of the variances that stand for all.
VARIANCES = np.linspace(0.01, 0.99, 50)
#: By how much of r/L fewer couples at a distance r a box of side L has than there would be without edges, in one, two and
#: three dimensions.
EDGES = (1.0, 4.0 / math.pi, 1.5)


def ring(distance: FloatArray, radius: float, variance: FloatArray, d: int) -> FloatArray:
    """(m,) density of points at a distance, that lie on a sphere of a radius blurred by a variance per axis."""
    from scipy.special import i0e

    with np.errstate(over="ignore"):
        x = distance * radius / variance
    peak = (2.0 * math.pi * variance) ** (-0.5 * d) * np.exp(-0.5 * (distance - radius) ** 2 / variance)
    if d == 2:
        return np.asarray(peak * i0e(x))
    if d == 1:
        return np.asarray(peak * 0.5 * (1.0 + np.exp(-2.0 * x)))
    return np.asarray(peak * np.where(x > 1e-6, -np.expm1(-2.0 * x) / np.maximum(2.0 * x, 1e-300), 1.0))


@in_short
@dataclass(frozen=True)
class Clustering:
    """The excess of close couples: 1 + w(u) times as many as a Poisson field has.

    unit : (d,) typical standard deviation of a residual, in which all lengths are. radii : (r,) of the rings.
    volume : (r,) ∫ w of each. further : how many times as many companions an object has that has one.
    mean : (ρ₁, ρ₂) mean densities.
    """

    unit: FloatArray
    radii: FloatArray
    volume: FloatArray
    further: float
    mean: tuple[float, float]
    gain: float
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
    """Records of one source in typical errors."""

    points: FloatArray
    variance: FloatArray
    density: FloatArray
    counted: BoolArray

    def part(self, rows: IntArray) -> _Source:
        """Some of its records."""
        return _Source(self.points[rows], self.variance[rows], self.density[rows], self.counted[rows])

    def couples(self, reach: float, centres: IntArray | None) -> tuple[IntArray, IntArray, FloatArray]:
        from scipy.spatial import cKDTree

        tree = cKDTree(self.points)
        if centres is None:
            pairs = tree.query_pairs(reach, output_type="ndarray").astype(np.int64)
            i, k = np.concatenate([pairs, pairs[:, ::-1]]).T
        else:
            table = cKDTree(self.points[centres]).sparse_distance_matrix(tree, reach, output_type="ndarray")
            i, k = centres[table["i"]], table["j"].astype(np.int64)
            other = i != k
            i, k = i[other], k[other]
        return i, k, np.sqrt(((self.points[i] - self.points[k]) ** 2).sum(axis=1))


def _unit(setting: Setting) -> FloatArray:
    one, two = setting.pairs.first, setting.pairs.second
    variance = np.median(one.variances, axis=0) + np.median(two.variances, axis=0)
    if isinstance(one.space, Sphere):
        variance = variance.mean()
    return np.broadcast_to(np.sqrt(variance), setting.pairs.d)


def _points(records: Records, unit: FloatArray) -> FloatArray:
    if isinstance(records.space, Sphere):
        return unit_vectors(*records.features.T) * (ARCSEC_PER_RADIAN / unit[0])
    return records.features / unit


def _sources(setting: Setting, unit: FloatArray) -> tuple[_Source, _Source]:
    scale = float(np.prod(unit))
    one, two = (
        _Source(_points(records, unit), (records.variances / unit**2).mean(axis=1), density * scale, seen & counted)
        for records, density, seen, counted in zip(
            (setting.pairs.first, setting.pairs.second), setting.densities, setting.seen, setting.counted, strict=True
        )
    )
    return one, two


def _drawn(levels: Sequence[GridLevel], enough: int) -> tuple[IntArray, IntArray]:
    """Records of either source in cells that hold enough of both; all, where these are hardly fewer."""
    coarse = levels[0]
    n = min(len(coarse.of_first), len(coarse.of_second))
    if n > 2 * enough:
        total = len(coarse.of_first) + len(coarse.of_second)
        level = next((x for x in levels[::-1] if len(x.volume) * CELL <= total), coarse)
        order = np.random.default_rng(SEED).permutation(len(level.volume))
        sums = [np.cumsum(level.count(source)[order]) for source in (1, 2)]
        drawn = np.zeros(len(order), np.bool_)
        drawn[order[: max(int(np.searchsorted(sum_, enough)) for sum_ in sums) + 1]] = True
        return np.flatnonzero(drawn[level.of_first]), np.flatnonzero(drawn[level.of_second])
    return np.arange(len(coarse.of_first)), np.arange(len(coarse.of_second))


def _some_centres(source: _Source, reach: float, d: int, most: int) -> IntArray:
    rows = np.flatnonzero(source.counted)
    due = float(source.density[rows].sum()) * _ball(d) * reach**d + len(rows)
    if due <= most:
        return rows
    bits = np.ascontiguousarray(source.points[rows, 0]).view(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    return rows[bits < np.uint64(int(most / due * 2.0**64))]


def _edge(source: _Source, d: int) -> float:
    """By which share fewer couples there are at a distance of 1."""
    return EDGES[d - 1] * float(source.density.mean() / len(source.points)) ** (1.0 / d)


def _ball(d: int) -> float:
    return float(math.pi ** (0.5 * d) / math.gamma(0.5 * d + 1.0))


def clustering(setting: Setting, tuning: CompanionsTuning = DEFAULT_COMPANIONS) -> Clustering | None:
    """The excess of close couples in both sources; None where there is none to be seen."""
    from scipy.special import chndtr

    d, records = setting.pairs.d, sum(setting.numbers)
    if d > tuning.most_dimensions or not 0 < records <= tuning.most_records or records < sum(map(len, setting.counted)):
        return None
    unit = _unit(setting)
    radii, reach = np.array(tuning.radii), tuning.reach
    one, two = _sources(setting, unit)
    rows_1, rows_2 = _drawn(setting.levels, tuning.records)
    sources = one.part(rows_1), two.part(rows_2)
    mean, parts, due, own = [], [], np.zeros(len(radii)), []
    found = []
    for source in sources:
        centres = _some_centres(source, reach, d, tuning.couples)
        if len(centres) < 2:
            return None
        i, k, distance = source.couples(reach, centres)
        if not len(i):
            return None
        density = float(source.density[centres].mean())
        v = source.variance[i] + source.variance[k]
        table = density * np.array([ring(distance, s, v, d) for s in radii])
        w = 2.0 * np.quantile(source.variance[centres], VARIANCES)
        due += density * len(centres) * np.array([chndtr(reach**2 / w, d, s**2 / w).mean() for s in radii])
        # Near its edge a field has fewer at a distance: of a box of side L, a share 1 − c r/L of all couples.
        edge = _edge(source, d)
        background = 0.5 * (source.density[i] + source.density[k]) * np.maximum(1.0 - edge * distance, 0.1)
        inside = max(1.0 - edge * reach * d / (d + 1.0), 0.1)
        own.append(float(source.density[centres].sum()) * _ball(d) * reach**d * inside)
        parts.append((background, table))
        mean.append(density)
        found.append((i, k, len(centres), len(source.points)))
    level = [max(len(b), 1) / e for (b, _), e in zip(parts, own, strict=True)]
    more, spread = -due, np.zeros(len(radii))
    for (background, table), g in zip(parts, level, strict=True):
        more = more + (table / (g * background)).sum(axis=1)
        spread += ((table / (g * background)) ** 2).sum(axis=1)
    if not (more > tuning.score * np.sqrt(spread)).any():
        return None

    def likelihood(volume: FloatArray, level: list[float]) -> float:
        total = -float(volume @ due)
        for (background, table), g, expected in zip(parts, level, own, strict=True):
            total += float(np.log(g * background + volume @ table).sum()) - g * expected
        return 0.5 * total

    none = likelihood(np.zeros(len(radii)), level)
    volume = np.full(len(radii), 0.1 * sum(len(b) for b, _ in parts) / max(due.sum(), 1e-300) / len(radii))
    for _ in range(tuning.iterations):
        summed = np.zeros(len(radii))
        for s, ((background, table), expected) in enumerate(zip(parts, own, strict=True)):
            total = level[s] * background + volume @ table
            summed += (table / total).sum(axis=1)
            level[s] *= float((background / total).sum()) / expected
        volume = volume * summed / due
    gain = likelihood(volume, level) - none
    if not gain > tuning.gain:
        return None
    squares, firsts, noise, mistaken = 0.0, 0.0, 1.0, []
    for (i, _, count, size), (background, table), g in zip(found, parts, level, strict=True):
        excess = volume @ table
        p = excess / (g * background + excess)
        several = float((np.bincount(i, p, size) ** 2).sum() - (p**2).sum())
        ours, chance = float((p * p).sum()), float((p * (1.0 - p)).sum())
        # What is there by chance may be a couple itself.
        squares += several - (chance**2 + 3.0 * chance * ours) / count
        firsts += ours**2 / count
        noise += 2.0 * several
        mistaken.append(chance / max(chance + ours, 1e-300))
    if max(mistaken) > tuning.mistaken:
        return None
    if float(volume.sum()) * max(mean) > tuning.most:
        return None
    further = squares / firsts if squares > tuning.significant * math.sqrt(noise) else 0.0
    known = Clustering(unit, radii, volume, further, (mean[0], mean[1]), gain)
    return replace(known, shares=_shares(known, sources, tuning))


def _shares(known: Clustering, sources: tuple[_Source, _Source], tuning: CompanionsTuning) -> tuple[float, float]:
    """Of the records of either source that have a partner, by how many of the other lie near beside companions of
    theirs; too low where errors are larger than thought."""
    from scipy.spatial import cKDTree

    one, two = sources
    found = cKDTree(one.points).sparse_distance_matrix(cKDTree(two.points), tuning.reach, output_type="ndarray")
    n1, n2 = (int(np.count_nonzero(source.counted)) for source in sources)
    if not len(found):
        return 0.0, 0.0
    i, k, distance = found["i"], found["j"], found["v"]
    v = one.variance[i] + two.variance[k]
    # Per unit of volume about all records: pairs there by chance, and of companions.
    scale = math.sqrt(n1 * n2 * known.mean[0] * known.mean[1])
    inside = np.maximum(1.0 - 0.5 * (_edge(one, known.d) + _edge(two, known.d)) * distance, 0.1)
    background = scale * inside * np.sqrt(one.density[i] * two.density[k] / (known.mean[0] * known.mean[1]))
    companions, same = scale * known.at(distance, v), ring(distance, 0.0, v, known.d)
    due, most = scale * _ball(known.d) * tuning.reach**known.d, float(min(n1, n2))
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

    at : (q,) pairs that it matters for. excess : (q,) w of their residuals, by the densities there. shown : (2, q) odds that
    their record of either source has a companion there, if no more than a Poisson field's have. swap : (q,) ln of what the separation of
    couples says of which of two is which.
    """

    clustering: Clustering
    at: IntArray
    excess: FloatArray
    shown: FloatArray
    swap: FloatArray = field(repr=False)

    @classmethod
    def of(cls, clustering: Clustering, setting: Setting, swaps: bool = True) -> Companions:
        pairs, unit = setting.pairs, clustering.unit
        sources = _sources(setting, unit)
        variance = sources[0].variance[pairs.i] + sources[1].variance[pairs.j]
        residual = pairs.residual / unit
        local = [mean / source.density for mean, source in zip(clustering.mean, sources, strict=True)]
        excess = clustering.at(np.sqrt((residual**2).sum(axis=1)), variance)
        excess *= np.sqrt(local[0][pairs.i] * local[1][pairs.j])
        alone, nearest = [], []
        for source, relative in zip(sources, local, strict=True):
            i, k, distance = source.couples(DEFAULT_COMPANIONS.reach, None)
            w = clustering.at(distance, source.variance[i] + source.variance[k]) * np.sqrt(relative[i] * relative[k])
            number = np.bincount(i, w, len(source.points))
            alone.append(number)
            nearest.append(_companion(i, k, w / (1.0 + w), len(source.points)))
        taken = np.stack([alone[0][pairs.i], alone[1][pairs.j]])
        swap = _swaps(clustering, setting, sources, residual, nearest) if swaps else np.zeros(len(pairs))
        at = np.flatnonzero((excess > 1e-3) | (swap != 0.0))
        return cls(clustering, at, excess[at], taken[:, at], swap[at])

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
        known = self.clustering
        c1, c2 = max(share_2, known.shares[1], 1e-3), max(share_1, known.shares[0], 1e-3)
        number = float(known.volume.sum()) * math.sqrt(known.mean[0] * known.mean[1] / (c1 * c2))
        # Of numbers with the mean n, the mean of n (n − 1) is no less than n (n − 1) of the mean.
        x, t = 1.0 - (1.0 - c1) * (1.0 - c2), max(known.further, 1.0 - 1.0 / max(number, 1e-9))
        if t < 1.0:
            p = number * (1.0 - t)
            void = max(1.0 - p * x, 1e-6)
            none, one = 1.0 / void, t / void
            here = 1.0 / max(1.0 - p * c1, 1e-6), 1.0 / max(1.0 - p * c2, 1e-6)
        else:
            unseen = math.exp(-number * t * x)
            none, one = unseen / (1.0 - 1.0 / t + unseen / t), t
            here = none, none
        alone = 1.0 / ((1.0 + here[0] * self.shown[0]) * (1.0 + here[1] * self.shown[1]))
        ratio = one + (none - one) * alone
        out = np.full(n, -np.inf)
        with np.errstate(divide="ignore"):
            out[self.at] = np.log(ratio * self.excess)
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
) -> FloatArray:
    """(m,) what the separations of couples say of pairs, where two records of a source compete for one or two of the
    other, and for no more."""
    pairs = setting.pairs
    i, j = pairs.i.astype(np.int64), pairs.j.astype(np.int64)
    near = pairs.mahalanobis_sq < NEAR
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
    return np.where(said > 0, two_of_both.sum(axis=0) / np.maximum(said, 1), two_of_one.sum(axis=0))


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
        wanted = i * self.n2 + j
        place = np.minimum(np.searchsorted(self.key, wanted), len(self.key) - 1)
        return np.where(self.key[place] == wanted, self.order[place], -1)

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
from dataclasses import dataclass, field

import numpy as np

from sameas.arrays import BoolArray, FloatArray, IntArray
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
    gain: float = 6.0
    couples: int = 60_000
    most_dimensions: int = 3
    iterations: int = 100


DEFAULT_COMPANIONS = CompanionsTuning()


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
        variance = np.full(2, variance.mean())
    return np.sqrt(variance)


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


def _some_centres(source: _Source, reach: float, d: int, most: int) -> IntArray:
    rows = np.flatnonzero(source.counted)
    due = float(source.density[rows].sum()) * _ball(d) * reach**d + len(rows)
    if due <= most:
        return rows
    bits = np.ascontiguousarray(source.points[rows, 0]).view(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    return rows[bits < np.uint64(int(most / due * 2.0**64))]


def _ball(d: int) -> float:
    return float(math.pi ** (0.5 * d) / math.gamma(0.5 * d + 1.0))


def clustering(setting: Setting, tuning: CompanionsTuning = DEFAULT_COMPANIONS) -> Clustering | None:
    """The excess of close couples in both sources; None where there is none to be seen."""
    from scipy.special import chndtr

    d = setting.pairs.d
    if d > tuning.most_dimensions:
        return None
    unit = _unit(setting)
    radii, reach = np.array(tuning.radii), tuning.reach
    sources = _sources(setting, unit)
    mean, parts, due, own = [], [], np.zeros(len(radii)), []
    found = []
    for source in sources:
        centres = _some_centres(source, reach, d, tuning.couples)
        if len(centres) < 2:
            return None
        i, k, distance = source.couples(reach, centres)
        density = float(source.density[centres].mean())
        v = source.variance[i] + source.variance[k]
        table = density * np.array([ring(distance, s, v, d) for s in radii])
        w = 2.0 * source.variance[centres]
        due += density * np.array([chndtr(reach**2 / w, d, s**2 / w).sum() for s in radii])
        background = 0.5 * (source.density[i] + source.density[k])
        own.append(float(source.density[centres].sum()) * _ball(d) * reach**d)
        parts.append((background, table))
        mean.append(density)
        found.append((i, k, len(centres), len(source.points)))
    volume = np.full(len(radii), 0.01 / max(due.sum(), 1e-300))
    level = [1.0, 1.0]

    def likelihood(volume: FloatArray, level: list[float]) -> float:
        total = -float(volume @ due)
        for (background, table), g, expected in zip(parts, level, own, strict=True):
            total += float(np.log(g * background + volume @ table).sum()) - g * expected
        return 0.5 * total

    none = likelihood(0.0 * volume, [len(b) / e if len(b) else 1e-9 for (b, _), e in zip(parts, own, strict=True)])
    volume = np.full(len(radii), 0.1 * sum(len(b) for b, _ in parts) / max(due.sum(), 1e-300) / len(radii))
    for _ in range(tuning.iterations):
        summed = np.zeros(len(radii))
        for s, ((background, table), expected) in enumerate(zip(parts, own, strict=True)):
            if not len(background):
                level[s] = 1e-9
                continue
            total = level[s] * background + volume @ table
            summed += (table / total).sum(axis=1)
            level[s] *= float((background / total).sum()) / expected
        volume = volume * summed / due
    gain = likelihood(volume, level) - none
    if not gain > tuning.gain:
        return None
    squares, firsts, n = 0.0, 0.0, 0
    for (i, k, count, size), (background, table), g in zip(found, parts, level, strict=True):
        excess = volume @ table
        p = excess / (g * background + excess)
        mean_k = np.bincount(i, p, size)
        squares += float((mean_k**2).sum() - (p**2).sum())
        firsts += float(p.sum()) ** 2 / count
        n += count
    further = (squares + 1.0) / (firsts + 1.0)
    return Clustering(unit, radii, volume, further, (mean[0], mean[1]), gain)


@in_short
@dataclass(frozen=True)
class CompanionsRule(Rule):
    """What companions say of pairs."""

    pairs: Pairs
    at: IntArray
    term: FloatArray

    def __call__(self, pairs: Pairs) -> Evidence:
        assert pairs is self.pairs
        out = np.zeros(len(pairs))
        out[self.at] = self.term
        return Evidence({"companions": out})


@in_short
@dataclass(frozen=True)
class Companions:
    """What is known of companions, for one list of candidates.

    at : (q,) pairs that it matters for. excess : (q,) w of their residuals, by the densities there. taken : (q,) how
    probable it is that one of their records has a companion in its own source. swap : (q,) ln of what the separation of
    couples says of which of two is which.
    """

    clustering: Clustering
    at: IntArray
    excess: FloatArray
    taken: FloatArray
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
            p = w / (1.0 + w)
            alone.append(np.exp(np.bincount(i, np.log1p(-p), len(source.points))))
            nearest.append(_companion(i, k, p, len(source.points)))
        taken = 1.0 - np.minimum(alone[0][pairs.i], alone[1][pairs.j])
        swap = _swaps(clustering, setting, sources, residual, nearest) if swaps else np.zeros(len(pairs))
        at = np.flatnonzero((excess > 1e-3) | (swap != 0.0))
        return cls(clustering, at, excess[at], taken[at], swap[at])

    def rule(self, pairs: Pairs, share_1: float, share_2: float) -> CompanionsRule:
        """share_1, share_2 : of the records of either source that have a partner."""
        c1, c2 = max(share_2, 1e-3), max(share_1, 1e-3)
        known = self.clustering
        n = float(known.volume.sum()) * math.sqrt(known.mean[0] * known.mean[1] / (c1 * c2))
        x, t = 1.0 - (1.0 - c1) * (1.0 - c2), known.further
        if t < 1.0:
            void = max(1.0 - n * (1.0 - t) * x, 0.02)
            none, one = 1.0 / void, t / void
        else:
            unseen = math.exp(-n * t * x)
            none, one = unseen / (1.0 - 1.0 / t + unseen / t), t
        ratio = none + (one - none) * self.taken
        return CompanionsRule(pairs, self.at, self.swap - np.log1p(ratio * self.excess))


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
    pairs = setting.pairs
    i, j = pairs.i.astype(np.int64), pairs.j.astype(np.int64)
    n2 = len(pairs.second)
    key = i * n2 + j
    order = np.argsort(key)
    ordered = key[order]

    def find(i: IntArray, j: IntArray) -> IntArray:
        wanted = i * n2 + j
        place = np.minimum(np.searchsorted(ordered, wanted), len(ordered) - 1)
        return np.where(ordered[place] == wanted, order[place], -1)

    v1, v2 = sources[0].variance, sources[1].variance
    i_, j_ = companion[0][i], companion[1][j]
    swap = np.zeros(len(pairs))

    def log_w(apart: FloatArray, variance: FloatArray) -> FloatArray:
        return np.log1p(clustering.at(np.sqrt((apart**2).sum(axis=1)), variance))

    # Two of either source.
    e = np.flatnonzero((i_ >= 0) & (j_ >= 0))
    if len(e):
        a, b, c = find(i_[e], j_[e]), find(i[e], j_[e]), find(i_[e], j[e])
        whole = (a >= 0) & (b >= 0) & (c >= 0)
        e, a, b, c = e[whole], a[whole], b[whole], c[whole]

        def fused(of: IntArray) -> tuple[FloatArray, FloatArray]:
            total = v1[i[of]] + v2[j[of]]
            return (v1[i[of]] / total)[:, None] * residual[of], v1[i[of]] * v2[j[of]] / total

        apart = residual[c] - residual[e]  # x_i' − x_i, by way of j
        (at_e, v_e), (at_a, v_a), (at_b, v_b), (at_c, v_c) = map(fused, (e, a, b, c))
        straight = log_w(apart - at_a + at_e, v_e + v_a)
        crossed = log_w(apart - at_c + at_b, v_b + v_c)
        swap[e] = 0.25 * (straight - crossed)
    # Two of one source, one of the other.
    for one, mate, v_one, v_other, sign in ((i_, j_, v1[i], v2[j], 1.0), (j_, i_, v2[j], v1[i], -1.0)):
        e = np.flatnonzero((one >= 0) & (mate < 0))
        if not len(e):
            continue
        a = find(one[e], j[e]) if sign > 0 else find(i[e], one[e])
        e, a = e[a >= 0], a[a >= 0]
        # From the record asked: x' − x = sign · (Δ' − Δ); the fused place of the pair is x − sign Δ v/(v + v_other).
        apart = sign * (residual[a] - residual[e])
        fuse_e, fuse_a = v_one[e] / (v_one[e] + v_other[e]), v_one[a] / (v_one[a] + v_other[a])
        with_e = log_w(apart + sign * residual[e] * fuse_e[:, None], fuse_e * v_other[e] + v_one[a])
        with_a = log_w(-apart + sign * residual[a] * fuse_a[:, None], fuse_a * v_other[a] + v_one[e])
        swap[e] = 0.5 * (with_e - with_a)
    return swap

"""Blends: one record of a coarse source may be two objects of a fine one (METHOD 11.3).

Two objects of the fine source (2) at separation s give one record of the coarse source (1) with probability B(s), which
is 1 at s = 0 and ½ at the resolution; else each is shown by itself. Couples merge or part from the nearest on, and no
object is of two. With c the probability that the coarse source shows an object, or the two that are one record, and ρ₁
its density of other records, a hypothesis weighs, beside that in which nothing has a partner,

    Π N(x_i − x_j; Σ) / ρ₁  Π N(x_i − w x_j − (1 − w) x_k; Σ) / ρ₁  Q(hypothesis) / Q(nothing)

over its records of one object and of two. Q = Σ P(M) c^shown (1 − c)^(units − shown) over the ways M in which couples
may have merged: those that have merged the hypothesis' couples and none of its single objects. Units are couples that
merged, and objects that did not; w is j's share of the flux, or all of 0 to 1 where fluxes are not given. Hypotheses
of a group are summed exactly: every record of the coarse source has no partner, one, or two, and no object is taken
twice. c, ρ₁ and the shares of the error scales are estimated from the result in turn.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.errors import InputError
from sameas.estimate.coverage import Coverage
from sameas.evidence import Errors
from sameas.gate import Radius
from sameas.gaussian import log_density
from sameas.records import Records
from sameas.representation import in_short
from sameas.result import Identification


@dataclass(frozen=True)
class BlendTuning:
    """How blends are looked for; chosen with ``scripts/bench field --only blends``.

    Attributes
    ----------
    steepness : B(s) = exp(−ln 2 · (s/resolution)^steepness).
    reach : objects farther apart than so many resolutions are never blended.
    gate_sigmas, tail_sigmas : farther than this from where it is due no partner is, in typical standard deviations and
        in those of the widest scale of the errors, the latter to a resolution at most.
    flux_shares : shares w that are averaged over where fluxes are not given.
    most_ways : in which objects near each other may have merged; with more, the widest couples never merge.
    least_log_odds : candidates of smaller ln of the odds against no partner are left out.
    most_hypotheses : of a group; with more, its least probable candidates are left out until it has fewer.
    asked, beyond_sigmas, within_sigmas : pairs that are asked whether the coarse source may show two objects as one, at
        most, how many standard deviations of theirs their neighbours must be away, and within how many of the typical
        pair's they are looked for, where few lie there by chance.
    fewest, suspected : of such neighbours, and the standard errors by which residuals must point to them.
    rounds, settled : of the estimation, and the change of c that ends it.
    least_share : of c, and of 1 − c.
    """

    steepness: float = 4.0
    reach: float = 1.75
    gate_sigmas: float = 6.4
    tail_sigmas: float = 3.0
    flux_shares: int = 9
    most_ways: int = 1_000
    least_log_odds: float = math.log(1e-6)
    most_hypotheses: float = 1e4
    asked: int = 5_000
    beyond_sigmas: float = 4.0
    within_sigmas: float = 60.0
    fewest: int = 20
    suspected: float = 6.0
    rounds: int = 10
    settled: float = 1e-3
    least_share: float = 1e-3


DEFAULT_BLENDS = BlendTuning()


@in_short
@dataclass(frozen=True)
class Candidates:
    """What records of the coarse source may be: o candidates, those of one object first.

    i, j, k : (o,) record of source 1, of source 2, and the other of a blend, −1 where there is none.
    log_density : (o, s) ln N by every scale of the errors. couple : (o,) which couple it is, −1 for one object.
    couples : (q, 2) objects of source 2 that may be one record. blended : (q,) B of each.
    """

    i: IntArray
    j: IntArray
    k: IntArray
    log_density: FloatArray
    couple: IntArray
    couples: IntArray
    blended: FloatArray

    def part(self, kept: BoolArray) -> Candidates:
        """Some of the candidates."""
        return replace(
            self, i=self.i[kept], j=self.j[kept], k=self.k[kept], log_density=self.log_density[kept],
            couple=self.couple[kept],
        )  # fmt: skip


@in_short
@dataclass(frozen=True)
class Blends:
    """Records of the coarse source, each with no partner, one, or two.

    Attributes
    ----------
    partner, other : (n₁,) records of source 2 by the most probable answer of each group, the other of a blend; masked
        where there is none.
    p_match : (n₁,) probability of that answer, of no partner where it has none. p_blend : (n₁,) probability that the
        record is two objects, whichever.
    candidates, p : (o,) what records may be, and how probable it is.
    share : c, the probability that the coarse source shows an object. shares : of the error scales.
    exact : (n₁,) whether all candidates of the record's group were summed.
    """

    partner: np.ma.MaskedArray
    other: np.ma.MaskedArray
    p_match: FloatArray
    p_blend: FloatArray
    candidates: Candidates = field(repr=False)
    p: FloatArray = field(repr=False)
    share: float
    shares: tuple[float, ...]
    exact: BoolArray = field(repr=False)


def find_blends(
    first: Records,
    second: Records,
    resolution: float,
    *,
    errors: Errors,
    flux: FloatArray | None = None,
    coverage: Coverage | None = None,
    tuning: BlendTuning = DEFAULT_BLENDS,
) -> Blends:
    """Which records of a coarse source are one object of a fine one, which are two, and how sure that is.

    Parameters
    ----------
    first, second : the coarse and the fine source.
    resolution : separation in the unit of the residuals (arcsec on the sphere) at which half of the couples are one
        record of the coarse source.
    errors : how residuals spread about the quoted errors, as :func:`sameas.estimate.match.match` estimates them.
    flux : (n₂,) of the fine source's records in the coarse source's band; NaN where not known.
    coverage : of both, where it is known already.

    Raises
    ------
    InputError : a resolution that is not positive, fluxes that are not those of the records.

    Source: METHOD 11.3, with the probability that neither of a couple is shown written out.

    >>> rng = np.random.default_rng(3)
    >>> fine = rng.uniform(0.0, 100.0, (60, 2))
    >>> fine[1] = fine[0] + (1.0, 0.0)
    >>> coarse = np.concatenate([[fine[:2].mean(axis=0)], fine[2:50]]) + 0.1 * rng.standard_normal((49, 2))
    >>> two = find_blends(Records.of(coarse, sigma=0.1), Records.of(fine, sigma=1e-3), 2.0, errors=Errors())
    >>> int(two.partner[0]), int(two.other[0]), bool(two.p_blend[0] > 0.9)
    (0, 1, True)
    """
    if not 0.0 < resolution < math.inf:
        raise InputError(f"blends: the resolution is {resolution:g}; give a positive separation")
    if flux is not None and (np.shape(flux) != (len(second),) or np.any(np.asarray(flux) <= 0.0)):
        raise InputError(
            f"blends: fluxes of shape {np.shape(flux)}; give one above 0 for each of {len(second)} records"
        )
    coverage = Coverage.of(first, second) if coverage is None else coverage
    n1, n2 = (max(int(np.count_nonzero(seen)), 1) for seen in coverage.covered)
    density = coverage.covered_densities[0][0]
    every = candidates_of(first, second, resolution, errors, flux, tuning)
    merging = Merging.of(every.couples, every.blended, len(second), tuning.most_ways)
    share, alone, shares = 0.5, 0.5, np.asarray(errors.shares)
    for _ in range(tuning.rounds):
        shown_with = Shown(merging, share)
        log_density, log_odds = log_odds_of(every, shown_with, shares, density * alone)
        kept = log_odds > tuning.least_log_odds
        found = every.part(kept)
        summed = hypotheses(found, log_density[kept], log_odds[kept], shown_with, len(first), tuning)
        shown, two = float(summed.p.sum()), float(summed.p[found.k >= 0].sum())
        before = share
        # Of couples that are one record, a share c is shown: so many more objects than units that may be.
        units = max(n2 - two / share, 1.0)
        share = float(np.clip((shown + 0.5) / (units + 1.0), tuning.least_share, 1.0 - tuning.least_share))
        alone = min(max(1.0 - shown / n1, tuning.least_share), 1.0)
        part = shares * np.exp(found.log_density - found.log_density.max(axis=1, keepdims=True, initial=-np.inf))
        shares = (summed.p @ (part / part.sum(axis=1, keepdims=True)) + shares) / (shown + 1.0)
        if abs(share - before) < tuning.settled:
            break
    return _answered(found, summed, len(first), share, shares)


def suspected(
    answer: Identification, errors: Errors, coverage: Coverage, coarse: int, tuning: BlendTuning = DEFAULT_BLENDS
) -> tuple[int, float, float] | None:
    """Whether source ``coarse`` (0 or 1) seems to show two objects of the other as one: of how many pairs the fine
    record has a neighbour without partner, within what distance, and by how many standard errors residuals point to it.

    A record that is two objects lies between them, where that of one object is as often on this side as on that. None
    where they point nowhere.
    """
    fine = (answer.second, answer.first)[coarse]
    chosen = np.flatnonzero(answer.chosen)
    chosen = chosen[:: max(1, len(chosen) // tuning.asked)]
    if len(chosen) < tuning.fewest:
        return None
    rows = ((answer.pairs.j, answer.pairs.i)[coarse])[answer.chosen]
    alone = np.ones(len(fine), np.bool_)
    alone[rows] = False
    some = errors.pairs(answer.pairs.part(chosen))
    own = (some.j, some.i)[coarse]
    without = np.flatnonzero(alone)
    if len(without) < tuning.fewest:
        return None
    # To the coarse record, on the axes of the pair.
    toward = some.residual if coarse == 0 else -some.residual
    sigma = np.sqrt(np.einsum("mdd->m", some.covariance) / some.d)
    spacing = math.sqrt(coverage.common_volume / (math.pi * len(without)))
    reach = min(tuning.within_sigmas * float(np.median(sigma)), spacing)
    here, there = (fine.part(at.astype(np.int64)).with_errors(0.0, 0.5) for at in (own, without))
    near = Radius(reach)(here, there)
    # The residual of two fine records is the first minus the second: to the neighbour it is the other way.
    separation = np.sqrt((near.residual**2).sum(axis=1))
    order = np.lexsort((separation, near.i))
    nearest = order[np.unique(near.i[order], return_index=True)[1]]
    nearest = nearest[separation[nearest] > tuning.beyond_sigmas * sigma[near.i[nearest]]]
    nearest = nearest[np.argsort(separation[nearest], kind="stable")]
    if len(nearest) < tuning.fewest:
        return None
    at = near.i[nearest]
    along = -(toward[at] * near.residual[nearest]).sum(axis=1) / (separation[nearest] * sigma[at])
    number = np.arange(1, len(along) + 1)
    significance = np.cumsum(np.clip(along, -3.0, 3.0)) / np.sqrt(number)
    significance[: tuning.fewest - 1] = 0.0
    best = int(np.argmax(significance))
    if significance[best] < tuning.suspected:
        return None
    return best + 1, float(separation[nearest[best]]), float(significance[best])


def candidates_of(
    first: Records, second: Records, resolution: float, errors: Errors, flux: FloatArray | None, tuning: BlendTuning
) -> Candidates:
    """All that records of the coarse source may be, one object or two, without regard to how dense they are."""
    by_model = errors.records(first, second)
    sigma = math.sqrt(sum(float(np.einsum("ndd->nd", one.full_covariance()).max()) for one in by_model))
    in_tail = min(sigma * tuning.tail_sigmas * max(errors.scales), resolution)
    off = max(sigma * tuning.gate_sigmas * errors.typical_scale, in_tail)
    apart, alike = tuning.reach * resolution, [records.with_errors(0.0, 0.5) for records in (first, second)]
    near = Radius(apart + off)(*alike).of(*by_model)
    order = np.lexsort((near.j, near.i))
    i, j, residual = near.i[order].astype(np.int64), near.j[order].astype(np.int64), near.residual[order]
    covariance = near.covariance[order]
    single = _log_densities(residual, covariance, errors)
    e, f = _of_one_record(i)
    separation = np.sqrt(((residual[e] - residual[f]) ** 2).sum(axis=1))
    close = separation <= apart
    e, f, separation = e[close], f[close], separation[close]
    blended = np.exp(-math.log(2.0) * (separation / resolution) ** tuning.steepness)
    couples, at, which = np.unique(np.column_stack([j[e], j[f]]), axis=0, return_index=True, return_inverse=True)
    if flux is not None:
        parts = (np.asarray(flux)[j[e]] / (np.asarray(flux)[j[e]] + np.asarray(flux)[j[f]]))[:, None]
    else:
        parts = np.broadcast_to(
            (np.arange(tuning.flux_shares) + 0.5) / tuning.flux_shares, (len(e), tuning.flux_shares)
        )
    density = np.full((len(e), len(errors.scales)), -np.inf)
    for part in parts.T:
        between = part[:, None] * residual[e] + (1.0 - part[:, None]) * residual[f]
        log_n = _log_densities(between, covariance[np.where(part >= 0.5, e, f)], errors)
        density = np.logaddexp(density, log_n - math.log(parts.shape[1]))
    return Candidates(
        np.concatenate([i, i[e]]), np.concatenate([j, j[e]]), np.concatenate([np.full(len(i), -1), j[f]]),
        np.concatenate([single, density]), np.concatenate([np.full(len(i), -1), which.reshape(-1)]), couples,
        blended[at],
    )  # fmt: skip


def _of_one_record(i: IntArray) -> tuple[IntArray, IntArray]:
    """(c,), (c,) every two places with the same number, of numbers that rise."""
    count = np.bincount(i) if len(i) else np.zeros(1, np.int64)
    parts = [(np.empty(0, np.int64), np.empty(0, np.int64))]
    for step in range(1, int(count.max())):
        e = np.flatnonzero(i[:-step] == i[step:])
        parts.append((e, e + step))
    one, two = (np.concatenate(side) for side in zip(*parts, strict=True))
    return one, two


def _log_densities(residual: FloatArray, covariance: FloatArray, errors: Errors) -> FloatArray:
    """(m, s) ln N of residuals (m, d) by every scale of the errors."""
    return np.stack([log_density(residual, scale**2 * covariance) for scale in errors.scales], axis=1)


Couple = tuple[int, int]


@in_short
@dataclass(frozen=True)
class Merging:
    """In which ways the objects of the fine source may be one record, two by two. Make it with :meth:`Merging.of`.

    cluster : (n₂,) of each object; those of one cluster may merge, directly or one after the other. couples : (q, 2).
    sizes : objects of each cluster. ways : of each cluster of more than one, the probability of every way, the couples
    that have merged in it, and their objects.
    """

    cluster: IntArray
    couples: list[Couple]
    sizes: IntArray
    ways: dict[int, list[tuple[float, frozenset[Couple], frozenset[int]]]]

    @classmethod
    def of(cls, couples: IntArray, blended: FloatArray, n2: int, most: int) -> Merging:
        """Of couples (q, 2) of n₂ objects that merge with these probabilities (q,), at most so many ways a cluster."""
        cluster = _components(couples[:, 0], couples[:, 1], n2)
        of_cluster: dict[int, list[tuple[float, Couple]]] = {}
        named = [(int(j), int(k)) for j, k in couples]
        for at in np.argsort(-blended, kind="stable"):
            of_cluster.setdefault(int(cluster[named[at][0]]), []).append((float(blended[at]), named[at]))
        ways = {each: _ways(nearest_first, most) for each, nearest_first in of_cluster.items()}
        return cls(cluster, named, np.bincount(cluster), ways)


def _ways(
    nearest_first: list[tuple[float, Couple]], most: int
) -> list[tuple[float, frozenset[Couple], frozenset[int]]]:
    """Every way in which couples merge or part, from the nearest on."""
    ways: list[tuple[float, frozenset[Couple], frozenset[int]]] = [(1.0, frozenset(), frozenset())]
    for b, couple in nearest_first:
        more = []
        for p, merged, objects in ways:
            if couple[0] in objects or couple[1] in objects:
                more.append((p, merged, objects))
                continue
            more.append((p * (1.0 - b), merged, objects))
            more.append((p * b, merged | {couple}, objects | set(couple)))
        if len(more) > most:
            break
        ways = more
    return [way for way in ways if way[0] > 0.0]


class Shown:
    """How probable it is that some objects and couples are shown, and no others, when objects are with probability c.

    merging : in which ways couples may have merged. share : c.
    """

    def __init__(self, merging: Merging, share: float) -> None:
        self.merging, self._shown, self._missed = merging, share, 1.0 - share
        self._known: dict[tuple[int, frozenset[Couple], frozenset[int]], float] = {}

    def log_ratio(self, cluster: int, couples: frozenset[Couple], single: frozenset[int]) -> float:
        """ln of the probability of showing these couples and single objects of a cluster over that of showing none."""
        none = self._probability(cluster, frozenset(), frozenset())
        shown = self._probability(cluster, couples, single) / none
        return math.log(shown) if shown > 0.0 else -math.inf

    def _probability(self, cluster: int, couples: frozenset[Couple], single: frozenset[int]) -> float:
        key = cluster, couples, single
        if key not in self._known:
            size, shown = int(self.merging.sizes[cluster]), len(couples) + len(single)
            ways = self.merging.ways.get(cluster, [(1.0, frozenset(), frozenset())])
            self._known[key] = sum(
                p * self._shown**shown * self._missed ** (size - len(merged) - shown)
                for p, merged, objects in ways
                if couples <= merged and not (single & objects)
            )
        return self._known[key]

    def of_all(self, sets: list[tuple[list[int], list[Couple]]]) -> list[float]:
        """ln of the same of several sets of single objects and couples, of whatever clusters."""
        out = []
        for objects, couples in sets:
            parts: dict[int, tuple[set[Couple], set[int]]] = {}
            for one in objects:
                parts.setdefault(int(self.merging.cluster[one]), (set(), set()))[1].add(one)
            for couple in couples:
                parts.setdefault(int(self.merging.cluster[couple[0]]), (set(), set()))[0].add(couple)
            out.append(sum(self.log_ratio(c, frozenset(a), frozenset(b)) for c, (a, b) in parts.items()))
        return out


def log_odds_of(
    found: Candidates, shown: Shown, shares: FloatArray, alone: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """(o,) ln of N / ρ₁ of each candidate, and ln of its odds against no partner where nothing else has one.

    shares : (s,) of the error scales. alone : (n₁,) density ρ₁ of coarse records that are nothing else.
    """
    with np.errstate(divide="ignore"):
        log_density = np.logaddexp.reduce(found.log_density + np.log(shares), axis=1) - np.log(alone[found.i])
    objects, at = np.unique(found.j[found.k < 0], return_inverse=True)
    log_odds = np.empty(len(log_density))
    log_odds[found.k < 0] = np.array(shown.of_all([([j], []) for j in objects.tolist()]))[at]
    couples = np.array(shown.of_all([([], [couple]) for couple in shown.merging.couples]))
    if len(couples):
        log_odds[found.k >= 0] = couples[found.couple[found.k >= 0]]
    return log_density, log_density + log_odds


@in_short
@dataclass(frozen=True)
class Summed:
    """(o,) probability of each candidate, and whether it is in the most probable answer of its group; (n₁,) exact."""

    p: FloatArray
    chosen: BoolArray
    exact: BoolArray


def hypotheses(
    found: Candidates,
    log_density: FloatArray,
    log_odds: FloatArray,
    shown: Shown,
    n1: int,
    tuning: BlendTuning = DEFAULT_BLENDS,
) -> Summed:
    """The sum over all hypotheses of every group.

    log_density, log_odds : (o,) of the candidates, from :func:`log_odds_of`.
    """
    p, chosen, exact = np.zeros(len(log_odds)), np.zeros(len(log_odds), np.bool_), np.ones(n1, np.bool_)
    if not len(log_odds):
        return Summed(p, chosen, exact)
    group = _groups(found, n1, shown.merging.cluster)
    order = np.lexsort((found.i, group))
    for rows in np.split(order, np.flatnonzero(np.diff(group[order])) + 1):
        i = found.i[rows]
        if i[0] == i[-1]:
            w = np.exp(np.minimum(log_odds[rows], 700.0))
            p[rows] = w / (1.0 + w.sum())
            best = int(np.argmax(w))
            chosen[rows[best]] = w[best] > 1.0
            continue
        least = -np.inf
        while np.prod(np.bincount(np.unique(i, return_inverse=True)[1]) + 1.0) > tuning.most_hypotheses:
            least = float(np.quantile(log_odds[rows], 0.2))
            rows = rows[log_odds[rows] > least]
            i = found.i[rows]
        exact[i] = np.isneginf(least)
        p[rows], chosen[rows] = _enumerated(found, rows, log_density[rows], shown)
    return Summed(p, chosen, exact)


def _groups(found: Candidates, n1: int, cluster: IntArray) -> IntArray:
    """(o,) number of the group of each candidate: of records that compete, or whose objects may merge."""
    objects = n1 + cluster[found.j]
    return _components(found.i, objects, int(objects.max()) + 1)[found.i]


def _components(one: IntArray, other: IntArray, n: int) -> IntArray:
    """(n,) which of n nodes hang together by these edges (q,), (q,)."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    joined = coo_array((np.ones(len(one), np.bool_), (one, other)), (n, n))
    return np.asarray(connected_components(joined, directed=False)[1], np.int64)


def _enumerated(
    found: Candidates, rows: IntArray, log_density: FloatArray, shown: Shown
) -> tuple[FloatArray, BoolArray]:
    """Probabilities of the candidates ``rows`` of one group, and which are in its most probable answer."""
    options: dict[int, list[int]] = {}
    for place, row in enumerate(rows):
        options.setdefault(int(found.i[row]), []).append(place)
    j, k = found.j[rows].tolist(), found.k[rows].tolist()

    def walked(level: int, taken: frozenset[int]) -> Iterator[tuple[int, ...]]:
        """The candidates of every way to go on from the first ``level`` records."""
        if level == len(lists):
            yield ()
            return
        yield from walked(level + 1, taken)
        for place in lists[level]:
            one, two = j[place], k[place]
            if one in taken or two in taken:
                continue
            for others in walked(level + 1, taken | ({one} if two < 0 else {one, two})):
                yield (place, *others)

    lists = list(options.values())
    ways = list(walked(0, frozenset()))
    sets = [([j[at] for at in way if k[at] < 0], [(j[at], k[at]) for at in way if k[at] >= 0]) for way in ways]
    weight = np.array(shown.of_all(sets)) + [float(sum(log_density[at] for at in way)) for way in ways]
    weight = np.exp(weight - weight.max())
    weight /= weight.sum()
    p = np.zeros(len(rows))
    for share, places in zip(weight, ways, strict=True):
        p[list(places)] += share
    chosen = np.zeros(len(rows), np.bool_)
    chosen[list(ways[int(np.argmax(weight))])] = True
    return p, chosen


def _answered(found: Candidates, summed: Summed, n1: int, share: float, shares: FloatArray) -> Blends:
    partner, other = (np.ma.array(np.zeros(n1, np.int64), mask=True) for _ in range(2))
    p_match: FloatArray = np.clip(1.0 - np.bincount(found.i, summed.p, n1), 0.0, 1.0)
    at = np.flatnonzero(summed.chosen)
    partner[found.i[at]] = found.j[at]
    p_match[found.i[at]] = summed.p[at]
    two = at[found.k[at] >= 0]
    other[found.i[two]] = found.k[two]
    p_blend: FloatArray = np.clip(np.bincount(found.i, summed.p * (found.k >= 0), n1), 0.0, 1.0)
    return Blends(partner, other, p_match, p_blend, found, summed.p, share, tuple(shares.tolist()), summed.exact)

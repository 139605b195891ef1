"""Blends: one record of a coarse source may be two objects of a fine one.

Two objects of the fine source (2) at separation s give one record of the coarse source (1) with probability B(s), which
is 1 at s = 0 and ½ at the resolution; otherwise they are detected separately. Couples (two objects near each other)
merge or not in order of separation, and no object merges twice. With c the probability that the coarse source detects
an object or a merged couple, and ρ₁ its density of other records, the weight of a hypothesis relative to the one
without partners is

    Π N(x_i − x_j; Σ) / ρ₁  Π N(x_i − w x_j − (1 − w) x_k; Σ) / ρ₁  Q(hypothesis) / Q(nothing)

over its records of one object and of two. Q = Σ P(M) cⁿ (1 − c)^(units − n) over the sets M of merged couples that
contain the hypothesis' couples and none of its single objects, n its number of both. Units are merged couples and
unmerged objects; w is j's share of the flux, or averaged over 0 to 1 without fluxes. Hypotheses of a group are summed
exactly: every record of the coarse source has no partner, one, or two, and no object is assigned twice. c, ρ₁ and the
shares of the error scales are estimated from the result by iteration.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from sameas.arrays import ABSENT, BoolArray, FloatArray, IntArray
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
    """Parameters of the search for blends; chosen with ``scripts/bench field --only blends``.

    steepness : B(s) = exp(−ln 2 · (s/resolution)^steepness).
    reach : maximum separation of a blend, in resolutions.
    gate_sigmas, tail_sigmas : maximum distance of a partner from its expected position, in typical standard
        deviations, and in those of the largest error scale; the latter at most a resolution.
    flux_shares : number of shares w that are averaged over without fluxes.
    max_mergers : maximum number of sets of merged couples of a cluster; with more, the widest couples never merge.
    min_log_odds : minimum ln odds of a candidate against no partner.
    max_hypotheses : of a group; with more, its least probable candidates are dropped.
    max_pairs, min_sigmas, max_sigmas : for the test for blends: maximum number of pairs, and range of the distance of
        their unmatched neighbours: the minimum in standard deviations of the pair, the maximum in those of the typical
        pair (less if more than one chance neighbour is expected).
    min_neighbours, min_significance : minimum number of such neighbours, and minimum offset of residuals towards them,
        in standard errors.
    max_iterations, tolerance : of the estimation, and the change of c at convergence.
    min_share : lower limit of c, and of 1 − c.
    """

    steepness: float = 4.0
    reach: float = 1.75
    gate_sigmas: float = 6.4
    tail_sigmas: float = 3.0
    flux_shares: int = 9
    max_mergers: int = 1_000
    min_log_odds: float = math.log(1e-6)
    max_hypotheses: float = 1e4
    max_pairs: int = 5_000
    min_sigmas: float = 4.0
    max_sigmas: float = 60.0
    min_neighbours: int = 20
    min_significance: float = 6.0
    max_iterations: int = 10
    tolerance: float = 1e-3
    min_share: float = 1e-3


DEFAULT_BLENDS = BlendTuning()


@in_short
@dataclass(frozen=True)
class BlendCandidates:
    """The candidates of records of the coarse source, o in number, those of one object first.

    i, j, k : (o,) record of source 1, of source 2, and the second one of a blend, ABSENT if none.
    log_density : (o, s) ln N by every scale of the errors. couple : (o,) index of the couple, ABSENT for one object.
    couples : (q, 2) objects of source 2 that may be one record. blended : (q,) B of each.
    """

    i: IntArray
    j: IntArray
    k: IntArray
    log_density: FloatArray
    couple: IntArray
    couples: IntArray
    blended: FloatArray

    def part(self, kept: BoolArray) -> BlendCandidates:
        """The candidates of a mask (o,)."""
        return replace(
            self, i=self.i[kept], j=self.j[kept], k=self.k[kept], log_density=self.log_density[kept],
            couple=self.couple[kept],
        )  # fmt: skip


@in_short
@dataclass(frozen=True)
class Blends:
    """Records of the coarse source, each with no partner, one, or two.

    partner, other : (n₁,) records of source 2 in the most probable hypothesis of each group, and the second one of a
        blend; masked where there is none.
    p_match : (n₁,) probability of that answer (of no partner if masked). p_blend : (n₁,) probability that the record
        is two objects, of any couple.
    candidates, p : (o,) candidates and their probabilities.
    share : c, the probability that the coarse source detects an object. shares : of the error scales.
    exact : (n₁,) whether all candidates of the record's group were summed.
    """

    partner: np.ma.MaskedArray
    other: np.ma.MaskedArray
    p_match: FloatArray
    p_blend: FloatArray
    candidates: BlendCandidates = field(repr=False)
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
    """Which records of a coarse source are one object of a fine one, and which are two, with probabilities.

    first, second : the coarse and the fine source.
    resolution : separation in the unit of the residuals (arcsec on the sphere) at which half of the couples are one
        record of the coarse source.
    errors : distribution of the residuals, as estimated by :func:`sameas.estimate.match.match`.
    flux : (n₂,) of the fine source's records in the coarse source's band; NaN where unknown.
    coverage : of both; estimated if None.

    Raises InputError: a resolution that is not positive, fluxes that are not one above 0 per record.

    The model is that of the module.

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
    n1, n2 = (max(int(np.count_nonzero(covered)), 1) for covered in coverage.covered)
    density = coverage.covered_densities[0][0]
    all_candidates = candidates_of(first, second, resolution, errors, flux, tuning)
    merging = Merging.of(all_candidates.couples, all_candidates.blended, len(second), tuning.max_mergers)
    share, share_unmatched, shares = 0.5, 0.5, np.asarray(errors.shares)
    for _ in range(tuning.max_iterations):
        detection = DetectionOdds(merging, share)
        log_density, log_odds = log_odds_of(all_candidates, detection, shares, density * share_unmatched)
        kept = log_odds > tuning.min_log_odds
        candidates = all_candidates.part(kept)
        solution = hypotheses(candidates, log_density[kept], log_odds[kept], detection, len(first), tuning)
        n_detected, two = float(solution.p.sum()), float(solution.p[candidates.k >= 0].sum())
        previous = share
        # A share c of the merged couples is detected; each merged couple reduces the number of units by one.
        units = max(n2 - two / share, 1.0)
        share = float(np.clip((n_detected + 0.5) / (units + 1.0), tuning.min_share, 1.0 - tuning.min_share))
        share_unmatched = min(max(1.0 - n_detected / n1, tuning.min_share), 1.0)
        log_n = candidates.log_density
        part = shares * np.exp(log_n - log_n.max(axis=1, keepdims=True, initial=-np.inf))
        shares = (solution.p @ (part / part.sum(axis=1, keepdims=True)) + shares) / (n_detected + 1.0)
        if abs(share - previous) < tuning.tolerance:
            break
    return _to_blends(candidates, solution, len(first), share, shares)


def suspected_blends(
    answer: Identification, errors: Errors, coverage: Coverage, coarse: int, tuning: BlendTuning = DEFAULT_BLENDS
) -> tuple[int, float, float] | None:
    """Evidence that records of source ``coarse`` (0 or 1) are blends of two objects of the other; None without any.

    Returned are the number of pairs whose fine record has an unmatched neighbour, the maximum distance of these
    neighbours, and the significance, in standard errors, of the offset of residuals towards them. A blend lies between
    its two objects; residuals of single objects have no preferred side.
    """
    fine = (answer.second, answer.first)[coarse]
    chosen = np.flatnonzero(answer.chosen)
    chosen = chosen[:: max(1, len(chosen) // tuning.max_pairs)]
    if len(chosen) < tuning.min_neighbours:
        return None
    rows = np.compress(answer.chosen, (answer.pairs.j, answer.pairs.i)[coarse])
    is_unmatched = np.ones(len(fine), np.bool_)
    is_unmatched[rows] = False
    sampled_pairs = errors.pairs(answer.pairs.part(chosen))
    own = (sampled_pairs.j, sampled_pairs.i)[coarse]
    unmatched_rows = np.flatnonzero(is_unmatched)
    if len(unmatched_rows) < tuning.min_neighbours:
        return None
    # Towards the coarse record, on the axes of the pair.
    toward = sampled_pairs.residual if coarse == 0 else -sampled_pairs.residual
    sigma = np.sqrt(np.einsum("mdd->m", sampled_pairs.covariance) / sampled_pairs.d)
    spacing = math.sqrt(coverage.common_volume / (math.pi * len(unmatched_rows)))
    reach = min(tuning.max_sigmas * float(np.median(sigma)), spacing)
    own_records, unmatched = (fine.part(at.astype(np.int64)).with_errors(0.0, 0.5) for at in (own, unmatched_rows))
    near = Radius(reach)(own_records, unmatched)
    # The residual of two fine records is the first minus the second, so the direction to the neighbour is its negative.
    separation = np.sqrt((near.residual**2).sum(axis=1))
    order = np.lexsort((separation, near.i))
    nearest = order[np.unique(near.i[order], return_index=True)[1]]
    nearest = nearest[separation[nearest] > tuning.min_sigmas * sigma[near.i[nearest]]]
    nearest = nearest[np.argsort(separation[nearest], kind="stable")]
    if len(nearest) < tuning.min_neighbours:
        return None
    at = near.i[nearest]
    along = -(toward[at] * near.residual[nearest]).sum(axis=1) / (separation[nearest] * sigma[at])
    number = np.arange(1, len(along) + 1)
    significance = np.cumsum(np.clip(along, -3.0, 3.0)) / np.sqrt(number)
    significance[: tuning.min_neighbours - 1] = 0.0
    best = int(np.argmax(significance))
    if significance[best] < tuning.min_significance:
        return None
    return best + 1, float(separation[nearest[best]]), float(significance[best])


def candidates_of(
    first: Records, second: Records, resolution: float, errors: Errors, flux: FloatArray | None, tuning: BlendTuning
) -> BlendCandidates:
    """All candidates of records of the coarse source, one object or two."""
    by_model = errors.records(first, second)
    sigma = math.sqrt(sum(float(np.einsum("ndd->nd", one.full_covariance()).max()) for one in by_model))
    tail_reach = min(sigma * tuning.tail_sigmas * max(errors.scales), resolution)
    max_offset = max(sigma * tuning.gate_sigmas * errors.typical_scale, tail_reach)
    greatest_separation = tuning.reach * resolution
    alike = [records.with_errors(0.0, 0.5) for records in (first, second)]
    near = Radius(greatest_separation + max_offset)(*alike).of(*by_model)
    order = np.lexsort((near.j, near.i))
    i, j, residual = near.i[order].astype(np.int64), near.j[order].astype(np.int64), near.residual[order]
    covariance = near.covariance[order]
    single = _log_densities(residual, covariance, errors)
    e, f = _pairs_of_equal(i)
    separation = np.sqrt(((residual[e] - residual[f]) ** 2).sum(axis=1))
    close = separation <= greatest_separation
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
    return BlendCandidates(
        np.concatenate([i, i[e]]), np.concatenate([j, j[e]]), np.concatenate([np.full(len(i), ABSENT), j[f]]),
        np.concatenate([single, density]), np.concatenate([np.full(len(i), ABSENT), which.reshape(-1)]), couples,
        blended[at],
    )  # fmt: skip


def _pairs_of_equal(i: IntArray) -> tuple[IntArray, IntArray]:
    """(c,), (c,) all pairs of positions with equal numbers, for ascending numbers."""
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
    """The possible mergers of objects of the fine source, in couples. :meth:`Merging.of` makes it.

    cluster : (n₂,) of each object: connected by couples. couples : (q, 2). sizes : number of objects in each cluster.
    mergers : for each cluster of several objects, the probability of every set of merged couples, the couples, and
    their objects.
    """

    cluster: IntArray
    couples: list[Couple]
    sizes: IntArray
    mergers: dict[int, list[tuple[float, frozenset[Couple], frozenset[int]]]]

    @classmethod
    def of(cls, couples: IntArray, blended: FloatArray, n2: int, max_mergers: int) -> Merging:
        """From couples (q, 2) of n₂ objects with merging probabilities (q,)."""
        cluster = _components(couples[:, 0], couples[:, 1], n2)
        of_cluster: dict[int, list[tuple[float, Couple]]] = {}
        pairs = [(int(j), int(k)) for j, k in couples]
        for at in np.argsort(-blended, kind="stable"):
            of_cluster.setdefault(int(cluster[pairs[at][0]]), []).append((float(blended[at]), pairs[at]))
        mergers = {each: _mergers(nearest_first, max_mergers) for each, nearest_first in of_cluster.items()}
        return cls(cluster, pairs, np.bincount(cluster), mergers)


def _mergers(
    nearest_first: list[tuple[float, Couple]], max_mergers: int
) -> list[tuple[float, frozenset[Couple], frozenset[int]]]:
    """All sets of couples that may merge, with probabilities, from the nearest couple on."""
    mergers: list[tuple[float, frozenset[Couple], frozenset[int]]] = [(1.0, frozenset(), frozenset())]
    for b, couple in nearest_first:
        longer = []
        for p, merged, objects in mergers:
            if couple[0] in objects or couple[1] in objects:
                longer.append((p, merged, objects))
                continue
            longer.append((p * (1.0 - b), merged, objects))
            longer.append((p * b, merged | {couple}, objects | set(couple)))
        if len(longer) > max_mergers:
            break
        mergers = longer
    return [merger for merger in mergers if merger[0] > 0.0]


class DetectionOdds:
    """Odds that the given objects and couples are detected, and no others, with detection probability c = ``share``."""

    def __init__(self, merging: Merging, share: float) -> None:
        self.merging, self._p_detected, self._p_missed = merging, share, 1.0 - share
        self._cache: dict[tuple[int, frozenset[Couple], frozenset[int]], float] = {}

    def log_ratio(self, cluster: int, couples: frozenset[Couple], single: frozenset[int]) -> float:
        """ln of the probability that these couples and single objects of a cluster are detected, over that of none."""
        none = self._probability(cluster, frozenset(), frozenset())
        ratio = self._probability(cluster, couples, single) / none
        return math.log(ratio) if ratio > 0.0 else -math.inf

    def _probability(self, cluster: int, couples: frozenset[Couple], single: frozenset[int]) -> float:
        key = cluster, couples, single
        if key not in self._cache:
            size, n_detected = int(self.merging.sizes[cluster]), len(couples) + len(single)
            mergers = self.merging.mergers.get(cluster, [(1.0, frozenset(), frozenset())])
            self._cache[key] = sum(
                p * self._p_detected**n_detected * self._p_missed ** (size - len(merged) - n_detected)
                for p, merged, objects in mergers
                if couples <= merged and not (single & objects)
            )
        return self._cache[key]

    def of_all(self, sets: list[tuple[list[int], list[Couple]]]) -> list[float]:
        """:meth:`log_ratio` of several sets of single objects and couples, of any clusters."""
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
    candidates: BlendCandidates, detection: DetectionOdds, shares: FloatArray, rho: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """(o,) ln of N / ρ₁ of each candidate, and (o,) ln of its odds against no partner if no other record has one.

    shares : (s,) of the error scales. rho : (n₁,) density ρ₁ of coarse records without a partner.
    """
    with np.errstate(divide="ignore"):
        log_density = np.logaddexp.reduce(candidates.log_density + np.log(shares), axis=1) - np.log(rho[candidates.i])
    objects, at = np.unique(candidates.j[candidates.k < 0], return_inverse=True)
    log_odds = np.empty(len(log_density))
    log_odds[candidates.k < 0] = np.array(detection.of_all([([j], []) for j in objects.tolist()]))[at]
    couples = np.array(detection.of_all([([], [couple]) for couple in detection.merging.couples]))
    if len(couples):
        log_odds[candidates.k >= 0] = couples[candidates.couple[candidates.k >= 0]]
    return log_density, log_density + log_odds


@in_short
@dataclass(frozen=True)
class Summed:
    """(o,) probability of each candidate, and whether it is in the most probable answer of its group; (n₁,) exact."""

    p: FloatArray
    chosen: BoolArray
    exact: BoolArray


def hypotheses(
    candidates: BlendCandidates,
    log_density: FloatArray,
    log_odds: FloatArray,
    detection: DetectionOdds,
    n1: int,
    tuning: BlendTuning = DEFAULT_BLENDS,
) -> Summed:
    """The sum over all hypotheses of every group.

    log_density, log_odds : (o,) of the candidates, from :func:`log_odds_of`.
    """
    p, chosen, exact = np.zeros(len(log_odds)), np.zeros(len(log_odds), np.bool_), np.ones(n1, np.bool_)
    if not len(log_odds):
        return Summed(p, chosen, exact)
    group = _groups(candidates, n1, detection.merging.cluster)
    order = np.lexsort((candidates.i, group))
    for rows in np.split(order, np.flatnonzero(np.diff(group[order])) + 1):
        i = candidates.i[rows]
        if i[0] == i[-1]:
            w = np.exp(np.minimum(log_odds[rows], 700.0))
            p[rows] = w / (1.0 + w.sum())
            best = int(np.argmax(w))
            chosen[rows[best]] = w[best] > 1.0
            continue
        least = -np.inf
        while np.prod(np.bincount(np.unique(i, return_inverse=True)[1]) + 1.0) > tuning.max_hypotheses:
            least = float(np.quantile(log_odds[rows], 0.2))
            rows = rows[log_odds[rows] > least]
            i = candidates.i[rows]
        exact[i] = np.isneginf(least)
        p[rows], chosen[rows] = _enumerate(candidates, rows, log_density[rows], detection)
    return Summed(p, chosen, exact)


def _groups(candidates: BlendCandidates, n1: int, cluster: IntArray) -> IntArray:
    """(o,) group of each candidate: of records that compete, or whose objects may merge."""
    objects = n1 + cluster[candidates.j]
    return _components(candidates.i, objects, int(objects.max()) + 1)[candidates.i]


def _components(one: IntArray, other: IntArray, n: int) -> IntArray:
    """(n,) connected component of each of n nodes with the edges (q,), (q,)."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    joined = coo_array((np.ones(len(one), np.bool_), (one, other)), (n, n))
    return np.asarray(connected_components(joined, directed=False)[1], np.int64)


def _enumerate(
    candidates: BlendCandidates, rows: IntArray, log_density: FloatArray, detection: DetectionOdds
) -> tuple[FloatArray, BoolArray]:
    """Probabilities of the candidates ``rows`` of one group, and which are in its most probable hypothesis."""
    options: dict[int, list[int]] = {}
    for at, row in enumerate(rows):
        options.setdefault(int(candidates.i[row]), []).append(at)
    j, k = candidates.j[rows].tolist(), candidates.k[rows].tolist()

    def assignments(level: int, assigned: frozenset[int]) -> Iterator[tuple[int, ...]]:
        """All assignments of candidates to the records from ``level`` on, without the objects ``taken``."""
        if level == len(lists):
            yield ()
            return
        yield from assignments(level + 1, assigned)
        for at in lists[level]:
            one, two = j[at], k[at]
            if one in assigned or two in assigned:
                continue
            for others in assignments(level + 1, assigned | ({one} if two < 0 else {one, two})):
                yield (at, *others)

    lists = list(options.values())
    solutions = list(assignments(0, frozenset()))
    sets = [([j[at] for at in each if k[at] < 0], [(j[at], k[at]) for at in each if k[at] >= 0]) for each in solutions]
    weight = np.array(detection.of_all(sets)) + [float(sum(log_density[at] for at in each)) for each in solutions]
    weight = np.exp(weight - weight.max())
    weight /= weight.sum()
    p = np.zeros(len(rows))
    for share, assigned_rows in zip(weight, solutions, strict=True):
        p[list(assigned_rows)] += share
    chosen = np.zeros(len(rows), np.bool_)
    chosen[list(solutions[int(np.argmax(weight))])] = True
    return p, chosen


def _to_blends(candidates: BlendCandidates, solution: Summed, n1: int, share: float, shares: FloatArray) -> Blends:
    """The result by record of the coarse source."""
    partner, other = (np.ma.array(np.zeros(n1, np.int64), mask=True) for _ in range(2))
    p_match: FloatArray = np.clip(1.0 - np.bincount(candidates.i, solution.p, n1), 0.0, 1.0)
    at = np.flatnonzero(solution.chosen)
    partner[candidates.i[at]] = candidates.j[at]
    p_match[candidates.i[at]] = solution.p[at]
    two = at[candidates.k[at] >= 0]
    other[candidates.i[two]] = candidates.k[two]
    p_blend: FloatArray = np.clip(np.bincount(candidates.i, solution.p * (candidates.k >= 0), n1), 0.0, 1.0)
    scale_shares = tuple(shares.tolist())
    return Blends(partner, other, p_match, p_blend, candidates, solution.p, share, scale_shares, solution.exact)

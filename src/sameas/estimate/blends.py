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
from dataclasses import dataclass, field, replace

import numpy as np

from sameas.arrays import ABSENT, BoolArray, FloatArray, IntArray, are_among, places_in
from sameas.errors import InputError
from sameas.estimate.coverage import Coverage
from sameas.evidence import Errors
from sameas.gate import Radius
from sameas.gaussian import log_density
from sameas.ragged import Ragged
from sameas.records import Records
from sameas.result import Identification

STEEPNESS = 4.0  # B(s) = exp(−ln 2 · (s/resolution)^steepness)
REACH = 1.75  # maximum separation of a blend, in resolutions
#: Maximum distance of a partner from its expected position, in typical standard deviations, and in those of the largest
#: error scale; the latter at most a resolution.
GATE_SIGMAS, TAIL_SIGMAS = 6.4, 3.0
MAX_COUPLES = 1_000.0  # maximum mean number of couples near a record; with more, the resolution is refused
FLUX_SHARES = 9  # number of shares w that are averaged over without fluxes
#: Minimum number of such neighbours, and minimum offset of residuals towards them, in standard errors.
MIN_NEIGHBOURS, MIN_SIGNIFICANCE = 20, 6.0
MAX_ITERATIONS, TOLERANCE = 10, 1e-3  # of the estimation, and the change of c at convergence
MIN_SHARE = 1e-3  # lower limit of c, and of 1 − c


#: Range of the distance of these neighbours: the minimum in standard deviations of the pair, the maximum in those of
#: the typical pair (less if more than one chance neighbour is expected).
NEAREST_SIGMAS, FARTHEST_SIGMAS = 4.0, 60.0


@dataclass(frozen=True)
class BlendTuning:
    """Parameters of the search for blends; chosen with ``scripts/bench field --only blends``.

    max_mergers : maximum number of sets of merged couples of a cluster; with more, its widest couples are apart: they
        merge or not whatever the others do.
    min_log_odds : minimum ln odds of a candidate against no partner.
    max_hypotheses : of a group; with more, the least probable options of its records are dropped.
    max_pairs : for the test for blends, maximum number of pairs.
    """

    max_mergers: int = 1_000
    min_log_odds: float = math.log(1e-6)
    max_hypotheses: float = 1e4
    max_pairs: int = 5_000


DEFAULT_BLENDS = BlendTuning()


@dataclass(frozen=True)
class BlendCandidates:
    """The candidates of records of the coarse source, o in number, those of one object first.

    i, j, k : (o,) record of source 1, of source 2, and the second one of a blend, ABSENT if none.
    log_density : (o, s) ln N by every scale of the errors. couples : (q, 2) objects of source 2 that may be one record.
    blended : (q,) B of each.
    """

    i: IntArray
    j: IntArray
    k: IntArray
    log_density: FloatArray
    couples: IntArray
    blended: FloatArray

    def part(self, kept: BoolArray) -> BlendCandidates:
        """The candidates of a mask (o,)."""
        return replace(self, i=self.i[kept], j=self.j[kept], k=self.k[kept], log_density=self.log_density[kept])


@dataclass(frozen=True)
class Blends:
    """Records of the coarse source, each with no partner, one, or two.

    partner, other : (n₁,) records of source 2 in the most probable hypothesis of each group, and the second one of a
        blend; masked where there is none.
    p_match : (n₁,) probability of that answer (of no partner if masked). p_blend : (n₁,) probability that the record
        is two objects, of any couple.
    candidates, p : (o,) candidates and their probabilities.
    share : c, the probability that the coarse source detects an object. shares : of the error scales.
    exact : (n₁,) whether all candidates and mergers of the record's group were summed.
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

    Raises InputError: a resolution that is not positive, or so large that crowds lie within it; fluxes that are not one
    above 0 per record.

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
    if flux is not None and (flux.shape != (len(second),) or np.any(flux <= 0.0) or np.isinf(flux).any()):
        raise InputError(f"blends: fluxes of shape {flux.shape}; give one above 0 for each of {len(second)} records")
    coverage = Coverage.of(first, second) if coverage is None else coverage
    n1, n2 = (max(int(np.count_nonzero(covered)), 1) for covered in coverage.covered)
    density = coverage.covered_densities[0][0]
    all_candidates = candidates_of(first, second, resolution, errors, flux)
    merging = Merging.of(all_candidates.couples, all_candidates.blended, len(second), tuning.max_mergers)
    share, share_unmatched, shares = 0.5, 0.5, np.asarray(errors.shares)
    for _ in range(MAX_ITERATIONS):
        detection = DetectionOdds(merging, share)
        log_density, log_odds = log_odds_of(all_candidates, detection, shares, density * share_unmatched)
        kept = log_odds > tuning.min_log_odds
        candidates = all_candidates.part(kept)
        solution = hypotheses(candidates, log_density[kept], log_odds[kept], detection, len(first), tuning)
        n_detected, two = float(solution.p.sum()), float(solution.p[candidates.k >= 0].sum())
        previous = share
        # A share c of the merged couples is detected; each merged couple reduces the number of units by one.
        units = max(n2 - two / share, 1.0)
        share = float(np.clip((n_detected + 0.5) / (units + 1.0), MIN_SHARE, 1.0 - MIN_SHARE))
        share_unmatched = min(max(1.0 - n_detected / n1, MIN_SHARE), 1.0)
        log_n = candidates.log_density
        part = shares * np.exp(log_n - log_n.max(axis=1, keepdims=True, initial=-np.inf))
        shares = (solution.p @ (part / part.sum(axis=1, keepdims=True)) + shares) / (n_detected + 1.0)
        if abs(share - previous) < TOLERANCE:
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
    if len(chosen) < MIN_NEIGHBOURS:
        return None
    rows = np.compress(answer.chosen, (answer.pairs.j, answer.pairs.i)[coarse])
    is_unmatched = np.ones(len(fine), np.bool_)
    is_unmatched[rows] = False
    sampled_pairs = errors.pairs(answer.pairs.part(chosen))
    own = (sampled_pairs.j, sampled_pairs.i)[coarse]
    unmatched_rows = np.flatnonzero(is_unmatched)
    if len(unmatched_rows) < MIN_NEIGHBOURS:
        return None
    # Towards the coarse record, on the axes of the pair.
    toward = sampled_pairs.residual if coarse == 0 else -sampled_pairs.residual
    sigma = np.sqrt(np.einsum("mdd->m", sampled_pairs.covariance) / sampled_pairs.d)
    spacing = math.sqrt(coverage.common_volume / (math.pi * len(unmatched_rows)))
    reach = min(FARTHEST_SIGMAS * float(np.median(sigma)), spacing)
    own_records, unmatched = (fine.part(at.astype(np.int64)).with_errors(0.0, 0.5) for at in (own, unmatched_rows))
    near = Radius(reach)(own_records, unmatched)
    # The residual of two fine records is the first minus the second, so the direction to the neighbour is its negative.
    separation = np.sqrt((near.residual**2).sum(axis=1))
    order = np.lexsort((separation, near.i))
    nearest = order[np.unique(near.i[order], return_index=True)[1]]
    nearest = nearest[separation[nearest] > NEAREST_SIGMAS * sigma[near.i[nearest]]]
    nearest = nearest[np.argsort(separation[nearest], kind="stable")]
    if len(nearest) < MIN_NEIGHBOURS:
        return None
    at = near.i[nearest]
    along = -(toward[at] * near.residual[nearest]).sum(axis=1) / (separation[nearest] * sigma[at])
    number = np.arange(1, len(along) + 1)
    significance = np.cumsum(np.clip(along, -3.0, 3.0)) / np.sqrt(number)
    significance[: MIN_NEIGHBOURS - 1] = 0.0
    best = int(np.argmax(significance))
    if significance[best] < MIN_SIGNIFICANCE:
        return None
    return best + 1, float(separation[nearest[best]]), float(significance[best])


def candidates_of(
    first: Records, second: Records, resolution: float, errors: Errors, flux: FloatArray | None
) -> BlendCandidates:
    """All candidates of records of the coarse source, one object or two."""
    by_model = errors.records(first, second)
    sigma = math.sqrt(sum(float(np.einsum("ndd->nd", one.full_covariance()).max()) for one in by_model))
    tail_reach = min(sigma * TAIL_SIGMAS * max(errors.scales), resolution)
    max_offset = max(sigma * GATE_SIGMAS * errors.typical_scale, tail_reach)
    greatest_separation = REACH * resolution
    alike = [records.with_errors(0.0, 0.5) for records in (first, second)]
    near = Radius(greatest_separation + max_offset)(*alike).of(*by_model)
    order = np.lexsort((near.j, near.i))
    i, j, residual = near.i[order].astype(np.int64), near.j[order].astype(np.int64), near.residual[order]
    covariance = near.covariance[order]
    number = np.bincount(i, minlength=len(first))
    if float((number * (number - 1)).mean()) > 2.0 * MAX_COUPLES:
        raise InputError(
            f"blends: about {number.mean():.0f} records of {second.source} lie within "
            f"{greatest_separation + max_offset:.3g} of each one of {first.source}, too many for blends of two",
            "give a smaller resolution",
        )
    single = _log_densities(residual, covariance, errors)
    e, f = _pairs_of_equal(i)
    separation = np.sqrt(((residual[e] - residual[f]) ** 2).sum(axis=1))
    close = separation <= greatest_separation
    e, f, separation = e[close], f[close], separation[close]
    blended = np.exp(-math.log(2.0) * (separation / resolution) ** STEEPNESS)
    couples, at = np.unique(np.column_stack([j[e], j[f]]), axis=0, return_index=True)
    share = np.full(len(e), np.nan) if flux is None else flux[j[e]] / (flux[j[e]] + flux[j[f]])

    def between(couple: BoolArray, w: FloatArray) -> FloatArray:
        nearer = covariance[np.where(w >= 0.5, e[couple], f[couple])]
        w = w[:, None]
        return _log_densities(w * residual[e[couple]] + (1.0 - w) * residual[f[couple]], nearer, errors)

    density, unknown = np.full((len(e), len(errors.scales)), -np.inf), np.isnan(share)
    density[~unknown] = between(~unknown, share[~unknown])
    for w in (np.arange(FLUX_SHARES) + 0.5) / FLUX_SHARES:
        at_share = between(unknown, np.full(np.count_nonzero(unknown), w)) - math.log(FLUX_SHARES)
        density[unknown] = np.logaddexp(density[unknown], at_share)
    return BlendCandidates(
        np.concatenate([i, i[e]]), np.concatenate([j, j[e]]), np.concatenate([np.full(len(i), ABSENT), j[f]]),
        np.concatenate([single, density]), couples, blended[at],
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


@dataclass(frozen=True)
class Merging:
    """The possible mergers of objects of the fine source, in couples. :meth:`Merging.of` makes it.

    cluster : (n₂,) of each object: connected by couples that may merge. place : (n₂,) its index within the cluster.
    mergers : of each cluster of several objects, the probability (s,) of every set of merged couples, and the place
    (s, size) of the object that each one is merged with, ABSENT for none.
    apart : the couples that are in no set, because a cluster with them would have too many, and their B.
    """

    cluster: IntArray
    place: IntArray
    mergers: dict[int, tuple[FloatArray, IntArray]]
    apart: dict[tuple[int, int], float]

    @classmethod
    def of(cls, couples: IntArray, blended: FloatArray, n2: int, max_mergers: int) -> Merging:
        """From couples (q, 2) of n₂ objects with merging probabilities (q,)."""
        mergers, kept = {}, np.ones(len(couples), np.bool_)
        pending, least = np.argsort(-blended, kind="stable"), 0.0
        while len(pending):
            cluster = _components(couples[pending, 0], couples[pending, 1], n2)[couples[pending, 0]]
            undone, least = [np.empty(0, np.int64)], max(2.0 * least, 1e-3)
            for rows in _by(pending, cluster):
                of_cluster = _mergers(couples[rows], blended[rows], max_mergers)
                if of_cluster is None:
                    kept[rows] = blended[rows] >= least
                    undone.append(rows[kept[rows]])
                else:
                    mergers[int(rows[0])] = of_cluster
            pending = np.concatenate(undone)
        cluster = _components(couples[kept, 0], couples[kept, 1], n2)
        order = np.argsort(cluster, kind="stable")
        place = np.empty(n2, np.int64)
        place[order] = Ragged.of_sorted(cluster[order], int(cluster.max(initial=-1)) + 1).index
        apart = {(j, k): b for (j, k), b in zip(couples[~kept].tolist(), blended[~kept].tolist(), strict=True)}
        return cls(cluster, place, {int(cluster[couples[k, 0]]): each for k, each in mergers.items()}, apart)

    def are_apart(self, j: IntArray, k: IntArray) -> BoolArray:
        """(o,) whether the objects j and k (o,) are a couple that is in no set."""
        if not self.apart:
            return np.zeros(len(j), np.bool_)
        return np.array([couple in self.apart for couple in zip(j.tolist(), k.tolist(), strict=True)], np.bool_)

    def clusters(self, j: IntArray, k: IntArray) -> IntArray:
        """(2, o) clusters of the objects j (o,) and k (o,) of candidates; that of j twice if k is ABSENT."""
        return np.asarray(self.cluster[np.stack([j, np.where(k < 0, j, k)])])


def _by(rows: IntArray, label: IntArray) -> list[IntArray]:
    """Rows of equal labels, in order."""
    order = np.argsort(label, kind="stable")
    return np.split(rows[order], np.flatnonzero(np.diff(label[order])) + 1)


def _mergers(couples: IntArray, blended: FloatArray, max_mergers: int) -> tuple[FloatArray, IntArray] | None:
    """All sets of couples (q, 2) of a cluster that may merge, the nearest couple first; None if they are too many."""
    objects, places = np.unique(couples, return_inverse=True)
    p, mates = np.ones(1), np.full((1, len(objects)), ABSENT)
    for (one, two), b in zip(places.reshape(-1, 2).tolist(), blended.tolist(), strict=True):
        free = (mates[:, one] < 0) & (mates[:, two] < 0)
        merged = mates[free]
        merged[:, one], merged[:, two] = two, one
        p = np.concatenate([np.where(free, p * (1.0 - b), p), p[free] * b])
        possible = p > 0.0
        p, mates = p[possible], np.concatenate([mates, merged])[possible]
        if len(p) > max_mergers:
            return None
    return p, mates


class DetectionOdds:
    """Odds that the given objects and couples are detected, and no others, with detection probability c = ``share``."""

    def __init__(self, merging: Merging, share: float) -> None:
        self.merging, self.share, self._log_odds = merging, share, math.log(share / (1.0 - share))
        # Relative to no merged couple: each one is a unit less that is not detected.
        self._weights = {
            cluster: p * (1.0 - share) ** (-0.5 * np.count_nonzero(mates >= 0, axis=1))
            for cluster, (p, mates) in merging.mergers.items()
        }

    def log_ratio(self, cluster: int, j: IntArray, k: IntArray) -> float:
        """ln of the probability that the objects and couples of a cluster that these candidates (u,) have are detected,
        over that of none. k is ABSENT for one object."""
        merging = self.merging
        apart = merging.are_apart(j, k)
        if apart.any():
            separate = np.concatenate([j[apart], k[apart]])
            separate = separate[merging.cluster[separate] == cluster]
            j, k = np.concatenate([j[~apart], separate]), np.concatenate([k[~apart], np.full(len(separate), ABSENT)])
        log_detected = len(j) * self._log_odds
        if cluster not in self._weights:
            return log_detected
        mates, weight, place = merging.mergers[cluster][1], self._weights[cluster], merging.place
        fits = (mates[:, place[j]] == np.where(k < 0, ABSENT, place[k])).all(axis=1)
        ratio = float(weight @ fits / weight.sum())
        return log_detected + math.log(ratio) if ratio > 0.0 else -math.inf


def log_odds_of(
    candidates: BlendCandidates, detection: DetectionOdds, shares: FloatArray, rho: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """(o,) ln of N / ρ₁ of each candidate, and (o,) ln of its odds against no partner if no other record has one.

    A couple that is in no set of mergers is B / c times as probable as both of its objects detected separately, with
    the mergers that each of them may be in; N includes the factor.

    shares : (s,) of the error scales. rho : (n₁,) density ρ₁ of coarse records without a partner.
    """
    with np.errstate(divide="ignore"):
        log_density = np.logaddexp.reduce(candidates.log_density + np.log(shares), axis=1) - np.log(rho[candidates.i])
    merging, share = detection.merging, detection.share
    couples, at = np.unique(np.column_stack([candidates.j, candidates.k]), axis=0, return_inverse=True)
    (j, k), at = couples.T, at.reshape(-1)
    blended_over_c = [merging.apart.get((one, two), share) / share for one, two in couples.tolist()]
    log_density += np.log(blended_over_c)[at]
    log_ratio = np.zeros(len(couples))
    for row, clusters in enumerate(merging.clusters(j, k).T.tolist()):
        log_ratio[row] = sum(detection.log_ratio(one, j[row : row + 1], k[row : row + 1]) for one in set(clusters))
    return log_density, log_density + log_ratio[at]


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

    log_density, log_odds : (o,) of the candidates, from :func:`log_odds_of`. A group with more hypotheses than
    ``tuning.max_hypotheses`` is summed without its least probable options, by their probabilities without the other
    records: candidates, or that a record has no partner. What then falls apart is summed apart.
    """
    p, chosen, exact = np.zeros(len(log_odds)), np.zeros(len(log_odds), np.bool_), np.ones(n1, np.bool_)
    if not len(log_odds):
        return Summed(p, chosen, exact)
    most = np.zeros(n1)
    np.maximum.at(most, candidates.i, log_odds)
    log_none = -most - np.log(np.exp(-most) + np.bincount(candidates.i, np.exp(log_odds - most[candidates.i]), n1))
    log_p, may_be_none = log_odds + log_none[candidates.i], np.ones(n1, np.bool_)
    exact[candidates.i[detection.merging.are_apart(candidates.j, candidates.k)]] = False
    clusters, pending = detection.merging.clusters(candidates.j, candidates.k), []
    for rows in _by(np.arange(len(p)), _groups(candidates.i, clusters)):
        if (candidates.i[rows] == candidates.i[rows[0]]).all():
            p[rows], best = np.exp(log_p[rows]), rows[np.argmax(log_p[rows])]
            chosen[best] = log_p[best] > log_none[candidates.i[best]]
        else:
            pending.append(rows)
    while pending:
        rows = pending.pop()
        records, number = np.unique(candidates.i[rows], return_counts=True)
        if np.log(number + may_be_none[records]).sum() <= math.log(tuning.max_hypotheses):
            p[rows], chosen[rows] = _enumerate(candidates, rows, log_density[rows], may_be_none, detection)
            continue
        exact[records] = False
        rows = _without_improbable(candidates, rows, log_p, log_none, may_be_none)
        pending += _by(rows, _groups(candidates.i[rows], clusters[:, rows]))
    return Summed(p, chosen, exact)


def _groups(i: IntArray, clusters: IntArray) -> IntArray:
    """(o,) group of each candidate: of records i (o,) that compete, or whose objects, in clusters (2, o), may merge."""
    records, i = np.unique(i, return_inverse=True)
    distinct_clusters, of = np.unique(clusters, return_inverse=True)
    n = len(records) + len(distinct_clusters)
    return _components(np.tile(i, 2), len(records) + of.reshape(-1), n)[i]


def _components(one: IntArray, other: IntArray, n: int) -> IntArray:
    """(n,) connected component of each of n nodes with the edges (q,), (q,)."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    joined = coo_array((np.ones(len(one), np.bool_), (one, other)), (n, n))
    return np.asarray(connected_components(joined, directed=False)[1], np.int64)


def _is_contested(candidates: BlendCandidates, rows: IntArray) -> BoolArray:
    """(o,) whether another record of the candidates ``rows`` (o,) could have one of a candidate's objects."""
    i, j, k = candidates.i[rows], candidates.j[rows], candidates.k[rows]
    both = np.unique(np.column_stack([np.concatenate([j, k]), np.concatenate([i, i])]), axis=0)
    objects, number = np.unique(both[:, 0], return_counts=True)
    contested = objects[(number > 1) & (objects >= 0)]
    return are_among(j, contested) | are_among(k, contested)


def _without_improbable(
    candidates: BlendCandidates, rows: IntArray, log_p: FloatArray, log_none: FloatArray, may_be_none: BoolArray
) -> IntArray:
    """The candidates ``rows`` (o,) of a group without a fifth of its options, the least probable; "no partner" is one
    of them, and changes ``may_be_none`` (n₁,).

    The most probable option of a record remains; "no partner" does if its most probable candidate is contested.
    """
    i, contested = candidates.i[rows], _is_contested(candidates, rows)
    order = np.lexsort((log_p[rows], i))
    best = order[np.append(np.flatnonzero(np.diff(i[order])), len(order) - 1)]
    has_partner = ~contested[best] & (log_p[rows[best]] > log_none[i[best]])
    is_droppable = np.ones(len(rows), np.bool_)
    is_droppable[best[has_partner]] = False
    some = np.flatnonzero(is_droppable)
    none = i[best][has_partner]
    none = none[may_be_none[none]]
    options = np.concatenate([log_p[rows[some]], log_none[none]])
    dropped = np.argsort(options, kind="stable")[: -(-len(options) // 5)]
    may_be_none[none[dropped[dropped >= len(some)] - len(some)]] = False
    return np.delete(rows, some[dropped[dropped < len(some)]])


def _enumerate(
    candidates: BlendCandidates,
    rows: IntArray,
    log_density: FloatArray,
    may_be_none: BoolArray,
    detection: DetectionOdds,
) -> tuple[FloatArray, BoolArray]:
    """Probabilities of the candidates ``rows`` (o,) of a group, and which are in its most probable hypothesis.

    may_be_none : (n₁,) whether a record may have no partner.
    """
    j, k = candidates.j[rows], candidates.k[rows]
    options = [
        np.append(own, ABSENT) if may_be_none[candidates.i[rows[own[0]]]] else own
        for own in _by(np.arange(len(rows)), candidates.i[rows])
    ]
    sizes = np.array([len(each) for each in options])
    stride = np.cumprod(sizes) // sizes
    # (h, r) option of each record in every hypothesis, as its index and as a candidate.
    index = np.arange(int(np.prod(sizes)))[:, None] // stride % sizes
    choice = np.column_stack([each[at] for each, at in zip(options, index.T, strict=True)])
    contested = np.flatnonzero(_is_contested(candidates, rows))
    objects = np.setdiff1d(np.concatenate([j[contested], k[contested]]), [ABSENT])
    users = np.zeros((len(choice), len(objects) + 1), np.int8)
    for column in choice.T:
        for of in (j, k):
            place = places_in(objects, of)
            users[np.arange(len(users)), np.where(column < 0, ABSENT, place[column])] += 1
    possible = (users[:, :-1] <= 1).all(axis=1)
    index, choice = index[possible], choice[possible]
    log_weight = np.append(log_density, 0.0)[choice].sum(axis=1)
    clusters = detection.merging.clusters(j, k)
    for one in np.unique(clusters).tolist():
        # Hypotheses with the same options in this cluster have the same odds.
        is_inside = np.append((clusters == one).any(axis=0), False)
        code = np.zeros(len(choice), np.int64)
        for each, at, step in zip(options, index.T, stride.tolist(), strict=True):
            outside = np.flatnonzero(~is_inside[each])
            same = np.arange(len(each))
            same[outside] = outside[:1]
            code += step * same[at]
        _, first, state = np.unique(code, return_index=True, return_inverse=True)
        inside = [hypothesis[is_inside[hypothesis]] for hypothesis in choice[first]]
        log_weight += np.array([detection.log_ratio(one, j[at], k[at]) for at in inside])[state]
    weight = np.exp(log_weight - log_weight.max())
    weight /= weight.sum()
    p = np.zeros(len(rows) + 1)
    np.add.at(p, choice, weight[:, None])
    chosen = np.zeros(len(rows) + 1, np.bool_)
    chosen[choice[int(np.argmax(weight))]] = True
    return p[:-1], chosen[:-1]


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

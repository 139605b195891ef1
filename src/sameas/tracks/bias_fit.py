"""Bias fit: the biases under which two sources agree best, over all instants at which they are compared.

The search covers every offset that brings any two records of an instant together (:mod:`sameas.registration`); its
solutions at a few instants are refined over all of them at once, every pair weighted by its posterior probability.
Priors are normal about zero. Where neither source is without bias they are the gauge: of the biases that would
displace both sources alike, the least likely to be large stay zero.

The covariance is never less than the scatter from track to track shows: errors of one track are alike at all instants.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import FloatArray, IntArray
from sameas.gaussian import inverse, log_determinant, propagated, symmetric
from sameas.registration.hough import Votes, vote
from sameas.registration.solution import displacement_sigmas, refine
from sameas.registration.weights import Weighed, weigh
from sameas.tracks.biases import RelativeBias
from sameas.tracks.snapshot import CommonScan
from sameas.tracks.tuning import DEFAULT_TUNING, Tuning


@dataclass(frozen=True)
class BiasFit:
    """Biases that explain the scans.

    Attributes
    ----------
    biases : (p,) which they are: see :class:`~sameas.tracks.snapshot.CommonScan`. theta : (p,) their values.
    covariance : (p, p) of theta, by data and prior.
    relative : (p, p) the same without what displaces all sources alike: for comparing them with each other.
    pairs : expected number of pairs, over all instants. tracks : of how many objects they are.
    log_evidence : ln of the odds of these biases, with the pairs they make, against nothing in common.
    rivals : other solutions, with their log evidence. tuning : of tracks.
    """

    biases: IntArray
    theta: FloatArray
    covariance: FloatArray
    relative: FloatArray
    pairs: float
    instants: int
    tracks: float
    log_evidence: float
    rivals: tuple[tuple[FloatArray, float], ...]
    settled: bool
    tuning: Tuning = DEFAULT_TUNING

    @property
    def near_rivals(self) -> tuple[tuple[FloatArray, float], ...]:
        """The rivals that are not much less probable."""
        return tuple(rival for rival in self.rivals if rival[1] > self.log_evidence - self.tuning.registration.decisive)

    @property
    def established(self) -> bool:
        """Whether these biases, and no others nor nothing in common, explain the scans."""
        return self.log_evidence > self.tuning.registration.decisive and not self.near_rivals


@dataclass(frozen=True)
class Pool:
    """Scans with one set of biases; θ (…, p) runs over ``biases``."""

    scans: tuple[CommonScan, ...]
    tuning: Tuning = DEFAULT_TUNING

    @cached_property
    def biases(self) -> IntArray:
        """(p,) the biases that any scan speaks of."""
        return np.unique(np.concatenate([scan.biases for scan in self.scans]))

    @cached_property
    def columns(self) -> list[IntArray]:
        """Per scan where its biases stand in θ."""
        return [np.searchsorted(self.biases, scan.biases) for scan in self.scans]

    @cached_property
    def precision(self) -> FloatArray:
        """(p,) of the prior."""
        width = np.zeros(len(self.biases))
        for scan, at in zip(self.scans, self.columns, strict=True):
            width[at] = scan.weighing.model.widths
        return width**-2.0

    def weighed(self, theta: FloatArray, common: list[FloatArray], widening: float) -> list[Weighed]:
        """Weights of all pairs of every scan under s candidates θ (s, p)."""
        return [
            weigh(scan.weighing, theta[:, at], here, widening)
            for scan, at, here in zip(self.scans, self.columns, common, strict=True)
        ]

    def gain(self, theta: FloatArray, weights: Sequence[Weighed]) -> FloatArray:
        """(s,) log posterior, up to a constant."""
        return np.asarray(sum(each.gain for each in weights) - 0.5 * np.sum(self.precision * theta**2, axis=1))

    def equations(self, theta: FloatArray, weights: Sequence[Weighed]) -> tuple[FloatArray, FloatArray]:
        """Score (s, p) of the log posterior, and its information (s, p, p) if the weights were the truth."""
        score = -self.precision * theta
        information = np.broadcast_to(np.diag(self.precision), (len(theta), *np.shape(self.precision) * 2)).copy()
        for k, each in enumerate(weights):
            terms, squares, s = self.contributions(k, theta, each)
            np.add.at(score, s, terms)
            np.add.at(information, s, squares)
        return score, information

    def contributions(self, k: int, theta: FloatArray, weights: Weighed) -> tuple[FloatArray, FloatArray, IntArray]:
        """The contribution of each pair of a scan to score (m, p) and information (m, p, p), and its candidate (m,)."""
        scan, at = self.scans[k], self.columns[k]
        model, features = scan.weighing.model, scan.weighing.second.features
        jacobian = np.zeros((len(weights.s), weights.residual.shape[1], theta.shape[1]))
        jacobian[:, :, at] = model.jacobian(features, theta[:, None, at])[weights.s, weights.j]
        pull = np.einsum("mvw,mwp->mvp", weights.precision, jacobian) * weights.weight[:, None, None]
        terms = np.einsum("mvp,mv->mp", pull, weights.residual)
        return terms, np.einsum("mvp,mvq->mpq", pull, jacobian), weights.s

    def fresh(self, count: int) -> list[FloatArray]:
        """(count,) numbers of common objects to begin with, per scan."""
        sizes = [min(len(e.weighing.first), len(e.weighing.second)) for e in self.scans]
        return [np.full(count, 0.5 * size) for size in sizes]


def fit_biases(scans: Sequence[CommonScan], tuning: Tuning = DEFAULT_TUNING) -> BiasFit:
    """The biases under which the sources of these scans agree best; at least one scan."""
    pool = Pool(tuple(scans), tuning)
    theta = _annealed(pool, _beginnings(pool))
    fits = [_fitted(pool, one) for one in theta]
    fits.sort(key=lambda one: -one.log_evidence)
    best, biggest = fits[0], _biggest(pool)[0]
    at = pool.columns[biggest]
    apart = [
        (one.theta, one.log_evidence)
        for one in fits[1:]
        if displacement_sigmas(pool.scans[biggest].weighing, best.theta[at], one.theta[at]) > tuning.same_sigmas
    ]
    return replace(best, rivals=tuple(apart))


def _biggest(pool: Pool) -> list[int]:
    """Scans in the order of how many records the poorer source shows."""
    sizes = [min(len(e.weighing.first), len(e.weighing.second)) for e in pool.scans]
    return sorted(range(len(sizes)), key=lambda k: -sizes[k])


def _beginnings(pool: Pool) -> FloatArray:
    """(s, p) the solutions of the instants with most records, and no bias at all."""
    starts = [np.zeros(len(pool.biases))]
    # One of the richer half at a time, far apart in time: the same chance does not come twice.
    rich = sorted(_biggest(pool)[: max(len(pool.scans) // 2, pool.tuning.searched_instants)])
    for k in np.unique(
        np.linspace(0, len(rich) - 1, min(pool.tuning.searched_instants, len(rich))).round().astype(int)
    ):
        scan, at = pool.scans[rich[k]], pool.columns[rich[k]]
        weighing = scan.weighing
        votes = vote(
            weighing.first, weighing.second, weighing.model, pool.tuning.search_offsets, pool.tuning.registration
        )
        none = np.zeros((1, len(at)))
        votes = Votes(
            np.concatenate([votes.theta, none]), np.append(votes.score, 0.0), np.append(votes.patch, 0), votes.patches
        )
        for solution in refine(weighing, votes, pool.tuning.search_steps):
            theta = np.zeros(len(pool.biases))
            theta[at] = solution.theta
            starts.append(theta)
    return np.array(starts)


def _annealed(pool: Pool, theta: FloatArray) -> FloatArray:
    """The best candidates, refined over all scans together with errors from wide to quoted."""
    common = pool.fresh(len(theta))
    for widening, keep in zip(pool.tuning.widenings, pool.tuning.kept, strict=True):
        weights = pool.weighed(theta, common, widening)
        score, information = pool.equations(theta, weights)
        gain = pool.gain(theta, weights)
        best = np.sort(np.argsort(-gain, kind="stable")[:keep])
        theta = (theta + np.linalg.solve(information, score[..., None])[..., 0])[best]
        common = [each.common[best] for each in weights]
    return theta


def _fitted(pool: Pool, theta: FloatArray) -> BiasFit:
    """One candidate brought to its maximum, with covariance and evidence."""
    at, common, settled = theta[None, :], pool.fresh(1), False
    for _ in range(pool.tuning.most_steps):
        weights = pool.weighed(at, common, 1.0)
        score, information = pool.equations(at, weights)
        step = np.linalg.solve(information, score[..., None])[..., 0]
        at, common = at + step, [each.common for each in weights]
        settled = float(np.einsum("sp,spq,sq->", step, information, step)) <= pool.tuning.settled**2
        if settled:
            break
    weights = pool.weighed(at, common, 1.0)
    _, complete = pool.equations(at, weights)
    by_model = _covariance(pool, at, common, complete[0])
    covariance, tracks = _scattered(pool, at, weights, complete[0], by_model)
    filtered = _without_gauge(pool, at)
    instants = len({scan.instant_s for scan in pool.scans})
    occam = 0.5 * (float(log_determinant(covariance)) + np.sum(np.log(pool.precision)))
    prior = -0.5 * float(np.sum(pool.precision * at[0] ** 2))
    likelihood = float(sum(each.gain[0] for each in weights)) * _independent(pool) / instants
    return BiasFit(
        pool.biases, at[0], covariance, filtered @ covariance @ filtered.T, float(sum(e.common[0] for e in weights)),
        instants, tracks, likelihood + prior + min(float(occam), 0.0), (), settled, pool.tuning,
    )  # fmt: skip


def _covariance(pool: Pool, theta: FloatArray, common: list[FloatArray], complete: FloatArray) -> FloatArray:
    """(p, p) inverse of the observed information (Louis 1982), by central differences of the score."""
    p = theta.shape[1]
    step = 0.2 / np.sqrt(np.diag(complete))
    nodes = np.concatenate([theta + np.diag(step), theta - np.diag(step)])
    weights = pool.weighed(nodes, [np.repeat(here, 2 * p) for here in common], 1.0)
    score, _ = pool.equations(nodes, weights)
    observed = -(score[:p] - score[p:]) / (2.0 * step[:, None])
    # In the units of the complete information: the shares of it that are not missing, at least a little.
    scale = np.linalg.cholesky(inverse(complete))
    shares, axes = np.linalg.eigh(scale.T @ symmetric(observed) @ scale)
    root = scale @ axes / np.sqrt(np.clip(shares, pool.tuning.least_information, None))
    return np.asarray(root @ root.T)


def _scattered(
    pool: Pool, theta: FloatArray, weights: Sequence[Weighed], complete: FloatArray, by_model: FloatArray
) -> tuple[FloatArray, float]:
    """The covariance, nowhere less than tracks scatter (Liang and Zeger 1986), and how many tracks there are.

    Pairs without any name are tracks of their own, so what stays with their objects is added as it is described.
    """
    parts = [pool.contributions(k, theta, each) for k, each in enumerate(weights)]
    names = [_owners(scan, each) for scan, each in zip(pool.scans, weights, strict=True)]
    owner, count = _numbered(np.concatenate(names))
    p, weight = len(by_model), np.concatenate([each.weight for each in weights])
    score, leverage = np.zeros((count, p)), np.zeros((count, p, p))
    np.add.at(score, owner, np.concatenate([part[0] for part in parts]))
    np.add.at(leverage, owner, np.concatenate([part[1] for part in parts]))
    # Every track pulled the answer towards itself: its score at the answer without it.
    apart = np.einsum("pq,cq->cp", complete, np.linalg.solve(complete - leverage, score[..., None])[..., 0])
    instants = len({scan.instant_s for scan in pool.scans})
    lasting = np.zeros((p, p))
    for scan, part, each, own in zip(pool.scans, parts, weights, names, strict=True):
        nameless = own == ""
        spread = np.einsum("mvv->m", each.precision[nameless]) / each.residual.shape[1] * scan.lasting_m2
        lasting += instants * np.einsum("mpq,m->pq", part[1][nameless], spread)
    total = by_model + by_model @ lasting @ by_model
    nameless = np.concatenate(names) == ""
    named = np.sum(np.bincount(owner[~nameless], weight[~nameless], count) > 0.5)
    return _at_least(total, by_model @ apart.T @ apart @ by_model), float(named + weight[nameless].sum() / instants)


def _numbered(names: NDArray[np.str_]) -> tuple[IntArray, int]:
    """(m,) a number for every name, and one for each of those that have none; and how many there are."""
    own = np.where(names == "", [f"0 {m}" for m in range(len(names))], names)
    number = np.unique(own, return_inverse=True)[1]
    return number, int(number.max(initial=-1)) + 1


def _owners(scan: CommonScan, weights: Weighed) -> NDArray[np.str_]:
    """(m,) the track of each pair: the second's id, else the first's, else an empty one."""
    names = [labels[rows] for labels, rows in zip(scan.track_ids, (weights.i, weights.j), strict=True)]
    chosen = [
        f"2 {two}" if two is not None else (f"1 {one}" if one is not None else "")
        for one, two in zip(*names, strict=True)
    ]
    return np.array(chosen, dtype=str)


def _at_least(least: FloatArray, other: FloatArray) -> FloatArray:
    """A covariance (p, p) that is nowhere smaller than either."""
    root = np.linalg.cholesky(least)
    ratio, axes = np.linalg.eigh(propagated(np.linalg.inv(root), other))
    grown = root @ axes * np.sqrt(np.maximum(ratio, 1.0))
    return np.asarray(grown @ grown.T)


def _without_gauge(pool: Pool, theta: FloatArray) -> FloatArray:
    """(p, p) matrix that removes what displaces all sources alike, which no pair can show."""
    every = np.zeros((len(pool.biases), len(pool.biases)))
    for scan, at in zip(pool.scans, pool.columns, strict=True):
        weighing = scan.weighing
        jacobian = weighing.model.jacobian(weighing.second.features, theta[0, at])
        precision = inverse(weighing.covariance_2 + np.median(weighing.covariance_1, axis=0))
        every[np.ix_(at, at)] += np.einsum("nvp,nvw,nwq->pq", jacobian, precision, jacobian)
    return np.asarray(np.linalg.solve(every + np.diag(pool.precision), every), np.float64)


def _independent(pool: Pool) -> float:
    """The number of independent instants: scenes at rest repeat the same coincidences."""
    times = np.unique([scan.instant_s for scan in pool.scans])
    if len(times) < 2:
        return 1.0
    apart = [
        scan.speed_m_per_s * float(np.median(np.diff(times))) / (pool.tuning.moved_sigmas * scan.weighing.sigma)
        for scan in pool.scans
        if isinstance(scan.weighing.model, RelativeBias)
    ]
    return 1.0 + (len(times) - 1) * min(1.0, float(np.median(apart)) if apart else 0.0)

"""Bias fit: the biases of maximum posterior probability of two sources, over all instants at which they are compared.

The search tries all offsets that bring any two records of an instant together (:mod:`sameas.registration`). Its
solutions at a few instants are refined over all instants jointly, with pairs weighted by their posterior probability.
Priors are normal about zero. If both sources may be biased, the priors are the gauge: a displacement common to both is
not observable and takes its prior value.

The covariance is at least that of the scatter between tracks: the errors of one track are the same at all instants.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import FloatArray, IntArray
from sameas.gaussian import inverse, log_determinant, propagated, symmetric
from sameas.registration.hough import HoughSearch
from sameas.registration.solution import DECISIVE, displacement_sigmas, refine
from sameas.registration.weights import Weighed, weigh
from sameas.tracks.biases import AzimuthDrift, RelativeBias
from sameas.tracks.snapshot import CommonScan

#: Of the bias search: instants, offsets per instant, and iterations.
SEARCHED_INSTANTS, SEARCH_OFFSETS, SEARCH_STEPS = 3, 32, 20
#: Factor on the errors, and number of candidates kept, for each iteration.
WIDENINGS, N_CANDIDATES = (2.0, 1.5, 1.2, 1.0, 1.0), (12, 8, 6, 4, 3)
STEP_TOLERANCE, MAX_STEPS = 0.01, 40  # a fit ends at steps below this share of a standard error, or after this many
SAME_SIGMAS = 0.7  # two solutions are one if no record moves between them by more than this many σ
MIN_INFORMATION = 0.02  # minimum eigenvalue of the observed information relative to the complete one
MOVED_SIGMAS = 3.0  # instants are independent if records have moved by at least this many σ between them


@dataclass(frozen=True)
class BearingReading:
    """A reading of a radar's bearings other than that given; see :mod:`sameas.tracks.bearing_readings`.

    suspicion : what is wrong, after "its ". changed : what is tried, before "its plots". remedy : what to do.
    log_odds : against the biases that it is compared with. log_evidence : against no object in common, without the
    track that fits best.
    """

    suspicion: str
    changed: str
    remedy: str
    log_odds: float
    log_evidence: float

    def is_decisive(self) -> bool:
        """Whether it is decisively more probable than these biases and than no object in common."""
        return min(self.log_odds, self.log_evidence) > DECISIVE


@dataclass(frozen=True)
class BiasFit:
    """The fitted biases.

    biases : (p,) their numbers, as in :class:`~sameas.tracks.snapshot.CommonScan`. theta : (p,) their values.
    covariance : (p, p) of theta, by data and prior.
    relative : (p, p) the same without the common displacement of all sources, for comparing these with each other.
    pairs : expected number of pairs, over all instants. instants : their number. tracks : number of objects in pairs.
    log_evidence : log-odds of these biases against no object in common.
    rivals : other solutions, with their log evidence. converged : whether the refinement converged.
    speed_m_per_s : median speed of the compared objects, 0 if unknown.
    drift : of the azimuth about its mean, for a sensor that moves. missed : for a source of plots, the mean probability
        that a scan has none of a track.
    reading : the most probable other reading of the bearings; None if there is none, or none was compared.
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
    converged: bool
    speed_m_per_s: float = 0.0
    drift: AzimuthDrift | None = None
    missed: float | None = None
    reading: BearingReading | None = None

    @property
    def near_rivals(self) -> tuple[tuple[FloatArray, float], ...]:
        """The rivals whose log evidence is lower by less than ``DECISIVE``."""
        return tuple(rival for rival in self.rivals if rival[1] > self.log_evidence - DECISIVE)

    @property
    def established(self) -> bool:
        """Whether these biases are decisively more probable than any rival, than no object in common, and than another
        reading of the bearings."""
        reread = self.reading is not None and self.reading.log_odds > -DECISIVE
        return self.log_evidence > DECISIVE and not self.near_rivals and not reread

    @property
    def misread(self) -> BearingReading | None:
        """The other reading of the bearings, if it is decisively more probable than these biases and than no object in
        common."""
        return self.reading if self.reading is not None and self.reading.is_decisive() else None


@dataclass(frozen=True)
class Pool:
    """Scans with one set of biases; θ (…, p) has the order of ``biases``."""

    scans: tuple[CommonScan, ...]

    @cached_property
    def biases(self) -> IntArray:
        """(p,) the biases of all scans."""
        return np.unique(np.concatenate([scan.biases for scan in self.scans]))

    @cached_property
    def columns(self) -> list[IntArray]:
        """Per scan the columns of its biases in θ."""
        return [np.searchsorted(self.biases, scan.biases) for scan in self.scans]

    @cached_property
    def precision(self) -> FloatArray:
        """(p,) of the prior."""
        width = np.zeros(len(self.biases))
        for scan, at in zip(self.scans, self.columns, strict=True):
            width[at] = scan.weighing.model.widths
        return width**-2.0

    def weighed(self, theta: FloatArray, common: list[FloatArray], widening: float) -> list[Weighed]:
        """The weights of all pairs of each scan under s candidates θ (s, p); common : per scan, (s,) common objects."""
        return [
            weigh(scan.weighing, theta[:, at], n_common, widening)
            for scan, at, n_common in zip(self.scans, self.columns, common, strict=True)
        ]

    def gain(self, theta: FloatArray, weights: Sequence[Weighed]) -> FloatArray:
        """(s,) log posterior, up to a constant."""
        return np.asarray(sum(each.gain for each in weights) - 0.5 * np.sum(self.precision * theta**2, axis=1))

    def equations(self, theta: FloatArray, weights: Sequence[Weighed]) -> tuple[FloatArray, FloatArray]:
        """The score (s, p) of the log posterior, and its information (s, p, p) for fixed weights."""
        score = -self.precision * theta
        information = np.broadcast_to(np.diag(self.precision), (len(theta), *np.shape(self.precision) * 2)).copy()
        for k, each in enumerate(weights):
            terms, squares, s = self.contributions(k, each)
            np.add.at(score, s, terms)
            np.add.at(information, s, squares)
        return score, information

    def contributions(self, k: int, weights: Weighed) -> tuple[FloatArray, FloatArray, IntArray]:
        """The contributions of the pairs of a scan to score (m, p) and information (m, p, p), and their candidates."""
        jacobian = np.zeros((len(weights.s), weights.residual.shape[1], len(self.biases)))
        jacobian[:, :, self.columns[k]] = weights.displaced.by_theta[weights.s, weights.j]
        weighted = np.einsum("mvw,mwp->mvp", weights.precision, jacobian) * weights.weight[:, None, None]
        terms = np.einsum("mvp,mv->mp", weighted, weights.residual)
        return terms, np.einsum("mvp,mvq->mpq", weighted, jacobian), weights.s

    def initial_common(self, count: int) -> list[FloatArray]:
        """Per scan, (count,) initial numbers of common objects."""
        return [np.full(count, 0.5 * scan.most_pairs) for scan in self.scans]


def fit_biases(scans: Sequence[CommonScan], sweeps: Sequence[CommonScan] = ()) -> BiasFit:
    """The biases of maximum posterior probability of the sources of these scans, at least one of which shows a bias.

    sweeps : the scans in parts, each at its own time, for the final fit; none if it has all scans as they are.
    """
    pool = Pool(tuple(scans))
    theta = _annealed(pool, _starting_points(pool))
    fits = [_converged(pool, candidate) for candidate in theta]
    fits.sort(key=lambda fit: -fit.log_evidence)
    best, largest = fits[0], _by_size(pool)[0]
    at = pool.columns[largest]
    rivals = [
        (fit.theta, fit.log_evidence)
        for fit in fits[1:]
        if displacement_sigmas(pool.scans[largest].weighing, best.theta[at], fit.theta[at]) > SAME_SIGMAS
    ]
    if sweeps:
        fine = _converged(Pool(tuple(sweeps)), best.theta)
        best = replace(fine, instants=best.instants, log_evidence=best.log_evidence)
    return replace(best, rivals=tuple(rivals))


def _by_size(pool: Pool) -> list[int]:
    """The scans that show a bias, in descending order of the number of records of their smaller source."""
    return sorted((k for k in range(len(pool.scans)) if len(pool.columns[k])), key=lambda k: -pool.scans[k].most_pairs)


def _starting_points(pool: Pool) -> FloatArray:
    """(s, p) no bias, and the solutions of some instants with many records."""
    starts = [np.zeros(len(pool.biases))]
    # Instants of the larger half, far apart in time, so that they do not share their chance coincidences.
    large = sorted(_by_size(pool)[: max(len(pool.scans) // 2, SEARCHED_INSTANTS)])
    for k in np.unique(np.linspace(0, len(large) - 1, min(SEARCHED_INSTANTS, len(large))).round().astype(int)):
        scan, at = pool.scans[large[k]], pool.columns[large[k]]
        weighing = scan.weighing
        search = HoughSearch(weighing.first, weighing.second, weighing.model)
        votes = search.vote(SEARCH_OFFSETS).with_zero()
        for solution in refine(weighing, votes, SEARCH_STEPS):
            theta = np.zeros(len(pool.biases))
            theta[at] = solution.theta
            starts.append(theta)
    return np.array(starts)


def _annealed(pool: Pool, theta: FloatArray) -> FloatArray:
    """The best candidates, refined over all scans jointly, with errors decreasing to the stated ones."""
    common = pool.initial_common(len(theta))
    for widening, keep in zip(WIDENINGS, N_CANDIDATES, strict=True):
        weights = pool.weighed(theta, common, widening)
        score, information = pool.equations(theta, weights)
        gain = pool.gain(theta, weights)
        best = np.sort(np.argsort(-gain, kind="stable")[:keep])
        theta = (theta + np.linalg.solve(information, score[..., None])[..., 0])[best]
        common = [each.common[best] for each in weights]
    return theta


def _converged(pool: Pool, theta: FloatArray) -> BiasFit:
    """One candidate refined to its maximum, with covariance and evidence."""
    at, common, converged = theta[None, :], pool.initial_common(1), False
    for _ in range(MAX_STEPS):
        weights = pool.weighed(at, common, 1.0)
        score, information = pool.equations(at, weights)
        step = np.linalg.solve(information, score[..., None])[..., 0]
        at, common = at + step, [each.common for each in weights]
        converged = float(np.einsum("sp,spq,sq->", step, information, step)) <= STEP_TOLERANCE**2
        if converged:
            break
    weights = pool.weighed(at, common, 1.0)
    _, complete = pool.equations(at, weights)
    by_model = _covariance(pool, at, common, complete[0])
    covariance, tracks = _with_scatter(pool, weights, complete[0], by_model)
    projection = _without_gauge(pool, at)
    instants = len({scan.instant_s for scan in pool.scans})
    occam = 0.5 * (float(log_determinant(covariance)) + np.sum(np.log(pool.precision)))
    prior = -0.5 * float(np.sum(pool.precision * at[0] ** 2))
    likelihood = float(sum(each.gain[0] for each in weights)) * _independent(pool) / instants
    return BiasFit(
        biases=pool.biases, theta=at[0], covariance=covariance, relative=projection @ covariance @ projection.T,
        pairs=float(sum(e.common[0] for e in weights)), instants=instants, tracks=tracks,
        log_evidence=likelihood + prior + min(float(occam), 0.0), rivals=(), converged=converged,
        speed_m_per_s=float(np.median([scan.speed_m_per_s for scan in pool.scans])),
    )  # fmt: skip


def _covariance(pool: Pool, theta: FloatArray, common: list[FloatArray], complete: FloatArray) -> FloatArray:
    """(p, p) inverse of the observed information (Louis 1982), by central differences of the score."""
    p = theta.shape[1]
    step = 0.2 / np.sqrt(np.diag(complete))
    nodes = np.concatenate([theta + np.diag(step), theta - np.diag(step)])
    weights = pool.weighed(nodes, [np.repeat(n_common, 2 * p) for n_common in common], 1.0)
    score, _ = pool.equations(nodes, weights)
    observed = -(score[:p] - score[p:]) / (2.0 * step[:, None])
    # Eigenvalues relative to the complete information, bounded from below by ``MIN_INFORMATION``.
    scale = np.linalg.cholesky(inverse(complete))
    shares, axes = np.linalg.eigh(scale.T @ symmetric(observed) @ scale)
    root = scale @ axes / np.sqrt(np.clip(shares, MIN_INFORMATION, None))
    return np.asarray(root @ root.T)


def _with_scatter(
    pool: Pool, weights: Sequence[Weighed], complete: FloatArray, by_model: FloatArray
) -> tuple[FloatArray, float]:
    """The covariance, at least that of the scatter between tracks (Liang and Zeger 1986), and the number of tracks.

    A pair without an id counts as a track of its own; so the described constant errors of its object are added.
    """
    parts = [pool.contributions(k, each) for k, each in enumerate(weights)]
    names = [_pair_names(scan, each) for scan, each in zip(pool.scans, weights, strict=True)]
    track, count = _numbered(np.concatenate(names))
    p, weight = len(by_model), np.concatenate([each.weight for each in weights])
    score, leverage = np.zeros((count, p)), np.zeros((count, p, p))
    np.add.at(score, track, np.concatenate([part[0] for part in parts]))
    np.add.at(leverage, track, np.concatenate([part[1] for part in parts]))
    # Leave-one-out score of each track: at the solution without it.
    without = np.einsum("pq,cq->cp", complete, np.linalg.solve(complete - leverage, score[..., None])[..., 0])
    instants = len({scan.instant_s for scan in pool.scans})
    lasting = np.zeros((p, p))
    for scan, part, each, name in zip(pool.scans, parts, weights, names, strict=True):
        no_id = name == ""
        relative = np.einsum("mvv->m", each.precision[no_id]) / each.residual.shape[1] * scan.lasting_m2
        lasting += instants * np.einsum("mpq,m->pq", part[1][no_id], relative)
    total = by_model + by_model @ lasting @ by_model
    no_id = np.concatenate(names) == ""
    n_tracks = np.sum(np.bincount(track[~no_id], weight[~no_id], count) > 0.5)
    scatter = by_model @ without.T @ without @ by_model
    return _at_least(total, scatter), float(n_tracks + weight[no_id].sum() / instants)


def _numbered(names: NDArray[np.str_]) -> tuple[IntArray, int]:
    """(m,) a number for each distinct name and for each pair without one; and the count of numbers."""
    own = np.where(names == "", [f"0 {m}" for m in range(len(names))], names)
    number = np.unique(own, return_inverse=True)[1]
    return number, int(number.max(initial=-1)) + 1


def _pair_names(scan: CommonScan, weights: Weighed) -> NDArray[np.str_]:
    """(m,) the track of each pair: the second source's id, else the first's, else ""."""
    names = [labels[rows] for labels, rows in zip(scan.track_ids, (weights.i, weights.j), strict=True)]
    chosen = [
        f"2 {two}" if two is not None else (f"1 {one}" if one is not None else "")
        for one, two in zip(*names, strict=True)
    ]
    return np.array(chosen, dtype=str)


def _at_least(least: FloatArray, other: FloatArray) -> FloatArray:
    """A covariance (p, p) at least as large as both in any direction."""
    root = np.linalg.cholesky(least)
    ratio, axes = np.linalg.eigh(propagated(np.linalg.inv(root), other))
    scaled = root @ axes * np.sqrt(np.maximum(ratio, 1.0))
    return np.asarray(scaled @ scaled.T)


def _without_gauge(pool: Pool, theta: FloatArray) -> FloatArray:
    """(p, p) matrix that removes the common displacement of all sources, which pairs cannot show."""
    information = np.zeros((len(pool.biases), len(pool.biases)))
    for scan, at in zip(pool.scans, pool.columns, strict=True):
        weighing = scan.weighing
        jacobian = weighing.model.jacobian(weighing.second.features, theta[0, at])
        precision = inverse(weighing.covariance_2 + np.median(weighing.covariance_1, axis=0))
        information[np.ix_(at, at)] += np.einsum("nvp,nvw,nwq->pq", jacobian, precision, jacobian)
    return np.asarray(np.linalg.solve(information + np.diag(pool.precision), information), np.float64)


def _independent(pool: Pool) -> float:
    """The number of independent instants: objects that hardly move repeat the same coincidences."""
    times = np.unique([scan.instant_s for scan in pool.scans])
    if len(times) < 2:
        return 1.0
    moved = [
        scan.speed_m_per_s * float(np.median(np.diff(times))) / (MOVED_SIGMAS * scan.weighing.sigma)
        for scan in pool.scans
        if isinstance(scan.weighing.model, RelativeBias)
    ]
    return 1.0 + (len(times) - 1) * min(1.0, float(np.median(moved)) if moved else 0.0)

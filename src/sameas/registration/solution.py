"""Refinement: from initial offsets to those of greatest likelihood, with their covariances and evidence.

EM iterates weights of the pairs and offsets, with errors wider than quoted at first. Less likely offsets are dropped
on the way. The covariance is the inverse of the observed information: that of the pairs less the missing information,
since it is not known which pairs are true (Louis 1982). It is the
derivative of the score, in which the weights follow the offset.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import FloatArray, IntArray
from sameas.gaussian import LOG_2PI, inverse, log_determinant, mahalanobis_sq, symmetric
from sameas.registration.hough import Votes
from sameas.registration.tuning import Tuning
from sameas.registration.weights import PlacedSources, Weighed, boxed, flattened, meet, weigh, weighed


@dataclass(frozen=True)
class Solution:
    """One offset that explains the data.

    theta (p,), covariance (p, p). common : expected number of common objects. log_likelihood : of the identification,
    less that of nothing in common. log_evidence : the same, averaged over all offsets near this one by their prior.
    in_common : records of either source in the overlap. rounds, settled : of the refinement.
    """

    theta: FloatArray
    covariance: FloatArray
    common: float
    log_likelihood: float
    log_evidence: float
    in_common: tuple[int, int]
    rounds: int
    settled: bool


@dataclass(frozen=True)
class OffsetPrior:
    """The prior of θ: normal around zero, or flat over all shifts that the records can have.

    precision : (p,). log_density : (p,) ln of the prior density at zero.
    """

    precision: FloatArray
    log_density: FloatArray

    @classmethod
    def of(cls, scene: PlacedSources) -> OffsetPrior:
        widths = np.array(scene.model.widths)
        p = len(widths)
        flat = ~np.isfinite(widths)
        jacobian = scene.model.jacobian(scene.second.features, np.zeros(p))
        moves = np.maximum(np.sqrt(np.max(np.sum(jacobian**2, axis=1), axis=0)), 1e-300)
        other = boxed(flattened(scene.second.features, scene.model, scene.second), scene.sigma)
        span = float(np.max(scene.box[1] - scene.box[0] + other[1] - other[0]))
        # A flat parameter ranges over what brings any two records together; one without width hardly moves.
        width = np.where(flat, span / moves, widths)
        fixed = 1e12 * (moves / scene.sigma) ** 2
        precision = np.where(width > 0.0, 1.0 / np.maximum(width, 1e-300) ** 2, fixed)
        log_normal = 0.5 * np.log(precision) - 0.5 * LOG_2PI
        return cls(precision, np.where(flat, 0.5 * np.log(precision), log_normal))


@dataclass(frozen=True)
class Trials:
    """Offsets theta (s, p) on their way to solutions, their common objects (s,), log likelihoods (s,); best first."""

    theta: FloatArray
    common: FloatArray
    gain: FloatArray

    @classmethod
    def fresh(cls, scene: PlacedSources, theta: FloatArray) -> Trials:
        """Offsets before any evaluation."""
        return cls(theta, np.full(len(theta), 0.5 * min(len(scene.first), len(scene.second))), np.zeros(len(theta)))

    def chosen(self, which: Sequence[int] | NDArray[Any]) -> Trials:
        """Some of them."""
        return Trials(self.theta[which], self.common[which], self.gain[which])

    def shared_by(self, factor: float) -> Trials:
        """The same for ``factor`` times as many records."""
        return Trials(self.theta, self.common * factor, self.gain)


def refine(scene: PlacedSources, votes: Votes, most_steps: int) -> list[Solution]:
    """The refined votes, most probable first; at most ``most_steps`` steps each after the search."""
    prior = OffsetPrior.of(scene)
    sample = scene.of_patch(_sampled(len(scene.second), _searched_records(scene, votes)))
    trials, search_steps = _searched(scene, sample, prior, votes)
    solutions = []
    for k in range(len(trials.gain)):
        one, steps = trials.chosen([k]), search_steps
        if sample is not scene:
            one, _, number, _ = _settled(sample, prior, one, most_steps)
            one, steps = one.shared_by(len(scene.second) / len(sample.second)), steps + number
        solutions.append(_finished(scene, sample, prior, one, most_steps, steps))
    solutions.sort(key=lambda solution: -solution.log_evidence)
    return _without_doubles(scene, solutions)


def _sampled(n: int, size: int) -> IntArray:
    """Rows of ``size`` of n records, in even steps."""
    return np.linspace(0, n - 1, min(n, size)).astype(np.int64)


def _searched_records(scene: PlacedSources, votes: Votes) -> int:
    """Number of records in the search: fewer where the votes of a few have decided."""
    tuning = scene.tuning
    return tuning.sample if scene.model.turns() else min(tuning.sample, tuning.sample_ratio * len(votes.patches[0]))


def _searched(scene: PlacedSources, sample: PlacedSources, prior: OffsetPrior, votes: Votes) -> tuple[Trials, int]:
    """The offsets refined on their patches and then on the sample of all records; and the number of steps."""
    ends = []
    for number, rows in enumerate(votes.patches):
        trials = Trials.fresh(scene, votes.theta[votes.patch == number])
        for part, keep in _nested(scene, rows) if len(trials.theta) else []:
            here = sample if part is None else scene.of_patch(part)
            trials = _anneal(here, prior, Trials.fresh(here, trials.theta), keep, scene.tuning.widenings)
            trials = trials.shared_by(len(sample.second) / len(here.second))
        ends.append(trials)
    if len(ends) == 1:
        trials, steps = _distinct(scene, _promising(ends[0], scene.tuning)), len(scene.tuning.widenings)
        if len(votes.patches[0]) == len(sample.second) or len(trials.gain) == 1:
            return trials, steps
        closing = scene.tuning.widenings[scene.tuning.from_sample :]
    else:
        # The offsets of a patch are only approximate for all records.
        trials = _distinct(scene, Trials.fresh(sample, np.concatenate([trials.theta for trials in ends])))
        steps, closing = len(scene.tuning.widenings), scene.tuning.widenings[scene.tuning.from_patches :]
    trials = _anneal(sample, prior, Trials.fresh(sample, trials.theta), scene.tuning.kept[-1], closing)
    return _distinct(scene, _promising(trials, scene.tuning)), steps + len(closing)


def _promising(trials: Trials, tuning: Tuning) -> Trials:
    """Those that may be true, or show that a pattern repeats."""
    return trials.chosen(trials.gain > min(trials.gain[0] - tuning.most_behind, tuning.repeating * trials.gain[0]))


def _nested(scene: PlacedSources, rows: IntArray) -> list[tuple[IntArray | None, int]]:
    """The patch, then larger and larger ones around it, or None for a sample of all; and how many each keeps."""
    n = len(scene.second)
    if len(rows) == n:
        return [(None, scene.tuning.kept[-1])]
    if not scene.model.turns():
        return [(rows, scene.tuning.kept[-1])]
    features = scene.second.features
    distance = np.sum((features - features[rows].mean(axis=0)) ** 2, axis=1)
    order = np.argsort(distance, kind="stable")
    parts: list[tuple[IntArray | None, int]] = [(rows, 4)]
    size = len(rows) * scene.tuning.patch_growth
    while size < min(n, scene.tuning.sample):
        parts.append((np.sort(order[:size]), 2))
        size *= scene.tuning.patch_growth
    return parts


def _anneal(scene: PlacedSources, prior: OffsetPrior, trials: Trials, keep: int, widenings: Sequence[float]) -> Trials:
    """All offsets refined together, errors from wide to quoted: the best ``keep`` of them."""
    for number, widening in enumerate(widenings):
        weights = weigh(scene, trials.theta, trials.common, widening)
        score, information = _normal_equations(scene, prior, trials.theta, weights)
        theta = trials.theta + np.linalg.solve(information, score[..., None])[..., 0]
        gain = weights.gain - 0.5 * np.sum(prior.precision * theta**2, axis=1)
        best = np.argsort(-gain, kind="stable")[: max(scene.tuning.kept[number], keep)]
        trials = Trials(theta, weights.common, gain).chosen(best)
    return trials.chosen(range(min(keep, len(trials.gain))))


def _normal_equations(
    scene: PlacedSources, prior: OffsetPrior, theta: FloatArray, weights: Weighed
) -> tuple[FloatArray, FloatArray]:
    """Score (s, p) of the log posterior of θ, and its information (s, p, p) if the weights were the truth."""
    from sameas.kernels.offsets import score_and_information

    d, p = scene.second.d, theta.shape[1]
    jacobian = scene.model.jacobian(scene.second.features, theta[:, None, :])
    jacobian = np.ascontiguousarray(np.broadcast_to(jacobian, (len(theta), len(scene.second), d, p)))
    score, information = score_and_information(
        weights.s, weights.j, weights.residual, weights.precision, weights.weight, jacobian, scene.tuning.weak
    )
    return score - prior.precision * theta, information + np.diag(prior.precision)


def _settled(
    scene: PlacedSources, prior: OffsetPrior, one: Trials, most_steps: int
) -> tuple[Trials, FloatArray, int, bool]:
    """One offset near its maximum, (p, p) its information if the weights were true, rounds, whether they settled."""
    at, common, number, settled = one.theta, one.common, 0, False
    while True:
        number += 1
        weights = weigh(scene, at, common, 1.0)
        score, information = _normal_equations(scene, prior, at, weights)
        step = np.linalg.solve(information, score[..., None])[..., 0]
        at = at + step
        moved_by = math.sqrt(max(float(step[0] @ information[0] @ step[0]), 0.0))
        settled = moved_by <= scene.tuning.settled and abs(float(weights.common[0] - common[0])) <= 0.01 + 3e-3 * float(
            common[0]
        )
        common = weights.common
        if settled or number >= most_steps:
            return Trials(at, common, weights.gain), information[0], number, settled


def _finished(
    scene: PlacedSources, sample: PlacedSources, prior: OffsetPrior, one: Trials, most_steps: int, search_steps: int
) -> Solution:
    """One offset brought to its maximum, with its covariance and evidence."""
    one, complete, number, settled = _settled(scene, prior, one, most_steps)
    share = len(sample.second) / len(scene.second)
    axes, score, weights = _missing(sample, prior, one.shared_by(share), share * complete)
    if sample is not scene:
        weights = weigh(scene, one.theta, one.common, 1.0)
        score, _ = _normal_equations(scene, prior, one.theta, weights)
    root = np.linalg.cholesky(inverse(complete)) @ axes
    theta = one.theta[0] + root @ root.T @ score[0]
    if weights.common[0] < scene.tuning.many:
        root = _stretched(scene, prior, theta, weights.common[:1], root)
    covariance = root @ root.T
    log_prior = float(np.sum(prior.log_density - 0.5 * prior.precision * theta**2))
    occam = 0.5 * (float(log_determinant(covariance)) + len(theta) * LOG_2PI)
    likelihood = float(weights.gain[0])
    # No mean is larger than the maximum, however little the data say of an offset.
    evidence = likelihood + min(log_prior + occam, 0.0)
    shared = (int(weights.in_common[0, 0]), int(weights.in_common[0, 1]))
    return Solution(
        theta, covariance, float(weights.common[0]), likelihood, evidence, shared, search_steps + number, settled,
    )  # fmt: skip


def _missing(
    scene: PlacedSources, prior: OffsetPrior, one: Trials, complete: FloatArray
) -> tuple[FloatArray, FloatArray, Weighed]:
    """By how much longer the axes (p, p) of the covariance are than if it were known which pairs are true.

    The observed information is taken by central differences of the score over a fifth of a standard error: its
    eigenvalues, in the units of the complete information (p, p), are the shares of it that are not missing. Also the
    scores, and the weights, at the offset itself and around.
    """
    p = one.theta.shape[1]
    step = 0.2 / np.sqrt(np.diag(complete))
    nodes = np.concatenate([one.theta, one.theta + np.diag(step), one.theta - np.diag(step)])
    weights = weigh(scene, nodes, np.repeat(one.common, 2 * p + 1), 1.0)
    score, information = _normal_equations(scene, prior, nodes, weights)
    observed = -(score[1 : p + 1] - score[p + 1 :]) / (2.0 * step[:, None])
    scale = np.linalg.cholesky(inverse(information[0]))
    shares, axes = np.linalg.eigh(scale.T @ symmetric(observed) @ scale)
    return axes / np.sqrt(np.clip(shares, 0.02, None)), score, weights


def _stretched(
    scene: PlacedSources, prior: OffsetPrior, theta: FloatArray, common: FloatArray, root: FloatArray
) -> FloatArray:
    """The axes ``root`` (p, p) of the covariance, as long as the posterior of θ reaches along each of them.

    The likelihood of a few pairs is wider than by its curvature at the maximum: other pairs take over further out,
    and the number of common objects follows. Second moments along the axes, by the trapezoidal rule.
    """
    away = np.array(scene.tuning.away)
    nodes = np.concatenate([theta[None, :], (theta + away[:, None, None] * root.T).reshape(-1, len(theta))])
    candidates = meet(scene, nodes, 1.0).as_overlapping_at(0)
    common_at = weighed(scene, candidates, np.repeat(common, len(nodes)), scene.tuning.roughly).common
    log_density = weighed(scene, candidates, common_at, scene.tuning.closely).gain - 0.5 * np.sum(
        prior.precision * nodes**2, axis=1
    )
    density = np.exp(np.minimum(log_density[1:] - log_density[0], 0.0)).reshape(len(away), -1)
    return np.asarray(root * np.sqrt((away**2 @ density) / (1.0 + density.sum(axis=0))))


def displacement_sigmas(scene: PlacedSources, one: FloatArray, other: FloatArray) -> float:
    """By how many standard deviations the records stand apart under two offsets, at most (but for one in ten)."""
    jacobian = scene.model.jacobian(scene.second.features, one)
    move = np.einsum("nvp,p->nv", jacobian, other - one)
    return float(np.quantile(np.sqrt(np.sum(move**2, axis=1)), 0.9)) / scene.sigma


def _distinct(scene: PlacedSources, trials: Trials) -> Trials:
    """The same offsets, each only once, in their order."""
    kept: list[int] = []
    for k, one in enumerate(trials.theta):
        if all(displacement_sigmas(scene, one, trials.theta[other]) > 0.1 for other in kept):
            kept.append(k)
    return trials.chosen(kept)


def _same(scene: PlacedSources, one: Solution, other: Solution) -> bool:
    """Whether two solutions are one: by where they put the records, or by how well either is known."""
    apart = other.theta - one.theta
    by_errors = float(mahalanobis_sq(apart, one.covariance))
    return (
        by_errors <= scene.tuning.same_errors**2
        or displacement_sigmas(scene, one.theta, other.theta) <= scene.tuning.same_sigmas
    )


def _without_doubles(scene: PlacedSources, solutions: list[Solution]) -> list[Solution]:
    distinct: list[Solution] = []
    for one in solutions:
        if not any(_same(scene, other, one) for other in distinct):
            distinct.append(one)
    return distinct

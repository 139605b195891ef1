"""Offsets refined: from rough beginnings to the offsets of greatest likelihood, their covariances and their evidence.

Weights of the pairs and offsets take turns (EM), with errors taken wide at first and as quoted in the end. Of many
beginnings the less likely ones are dropped on the way. The covariance is the inverse of the observed information: the
information of the pairs less what is missing because nobody knows which pairs are true (Louis 1982). It is the
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
from sameas.registration.weights import CLOSELY, ROUGHLY, PlacedSources, Weighed, boxed, flattened, meet, weigh, weighed

#: Factors by which errors are taken wider than quoted, round by round, and how many beginnings go on after each.
WIDENINGS = (2.0, 1.5, 1.2, 1.0, 1.0)
KEPT = (64, 64, 48, 32, 16)
#: Where the widenings begin again with all records, after patches and after a sample.
FROM_PATCHES, FROM_SAMPLE = 2, 3
#: A step below this share of a standard error is near enough: the last one knows the curvature, and needs no other.
SETTLED = 0.01
#: Two solutions are one when no record moves between them by more than so many standard deviations, or when they differ
#: by no more than so many standard errors.
SAME_SIGMAS, SAME_ERRORS = 0.7, 2.0
#: Solutions that are less likely than the best by this factor (its logarithm) are not pursued.
HOPELESS = 8.0
#: A pattern repeats where another solution explains this share of what the best explains: chance never does.
REPEATING = 0.4
#: Many records are searched with so many of the second source; all of them speak in the last refinement.
SAMPLE = 4000
#: So many times more records than were asked for votes are searched where those votes decided.
OF_ASKED = 16
#: A patch grows by this factor from one refinement to the next.
GROWTH = 8
WEAK = 1e-6
#: With fewer common objects than this the likelihood is looked at so many standard deviations away from its maximum.
MANY, AWAY = 200.0, np.array([-3.0, -1.5, 1.5, 3.0])


@dataclass(frozen=True)
class Solution:
    """One offset that explains the data.

    theta (p,), covariance (p, p). common : expected number of common objects. log_likelihood : of the identification,
    less that of nothing in common. log_evidence : the same, averaged over all offsets near this one by their prior.
    in_common : records of either source where both look. rounds, settled : of the refinement.
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
    """What is believed of θ beforehand: normal around zero, or flat over all shifts that the records can have.

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
        """Offsets of which nothing is known yet."""
        return cls(theta, np.full(len(theta), 0.5 * min(len(scene.first), len(scene.second))), np.zeros(len(theta)))

    def chosen(self, which: Sequence[int] | NDArray[Any]) -> Trials:
        """Some of them."""
        return Trials(self.theta[which], self.common[which], self.gain[which])

    def shared_by(self, factor: float) -> Trials:
        """The same of so many times as many records."""
        return Trials(self.theta, self.common * factor, self.gain)


def refine(scene: PlacedSources, votes: Votes, rounds: int) -> list[Solution]:
    """The solutions that the votes lead to, most probable first; at most ``rounds`` rounds each after the search."""
    belief = OffsetPrior.of(scene)
    sample = scene.of_patch(_sampled(len(scene.second), _searched_records(scene, votes)))
    trials, spent = _searched(scene, sample, belief, votes)
    found = []
    for k in range(len(trials.gain)):
        one, more = trials.chosen([k]), spent
        if sample is not scene:
            one, _, number, _ = _settled(sample, belief, one, rounds)
            one, more = one.shared_by(len(scene.second) / len(sample.second)), more + number
        found.append(_finished(scene, sample, belief, one, rounds, more))
    found.sort(key=lambda solution: -solution.log_evidence)
    return _without_doubles(scene, found)


def _sampled(n: int, size: int) -> IntArray:
    """Rows of so many of n records, in even steps."""
    return np.linspace(0, n - 1, min(n, size)).astype(np.int64)


def _searched_records(scene: PlacedSources, votes: Votes) -> int:
    """How many records the search takes: fewer where the votes of a few have decided."""
    return SAMPLE if scene.model.turns() else min(SAMPLE, OF_ASKED * len(votes.patches[0]))


def _searched(scene: PlacedSources, sample: PlacedSources, belief: OffsetPrior, votes: Votes) -> tuple[Trials, int]:
    """What the votes lead to on their patches and then on the sample of all; and in how many rounds."""
    ends = []
    for number, rows in enumerate(votes.patches):
        trials = Trials.fresh(scene, votes.theta[votes.patch == number])
        for part, keep in _nested(scene, rows) if len(trials.theta) else []:
            here = sample if part is None else scene.of_patch(part)
            trials = _anneal(here, belief, Trials.fresh(here, trials.theta), keep, WIDENINGS)
            trials = trials.shared_by(len(sample.second) / len(here.second))
        ends.append(trials)
    if len(ends) == 1:
        trials, spent = _distinct(scene, _hopeful(ends[0])), len(WIDENINGS)
        if len(votes.patches[0]) == len(sample.second) or len(trials.gain) == 1:
            return trials, spent
        closing = WIDENINGS[FROM_SAMPLE:]
    else:
        # What was found on a patch is only near for all records.
        trials = _distinct(scene, Trials.fresh(sample, np.concatenate([trials.theta for trials in ends])))
        spent, closing = len(WIDENINGS), WIDENINGS[FROM_PATCHES:]
    trials = _anneal(sample, belief, Trials.fresh(sample, trials.theta), KEPT[-1], closing)
    return _distinct(scene, _hopeful(trials)), spent + len(closing)


def _hopeful(trials: Trials) -> Trials:
    """Those that may be the truth, or show that a pattern repeats."""
    return trials.chosen(trials.gain > min(trials.gain[0] - HOPELESS, REPEATING * trials.gain[0]))


def _nested(scene: PlacedSources, rows: IntArray) -> list[tuple[IntArray | None, int]]:
    """The patch, then larger and larger ones around it, or None for a sample of all; and how many each keeps."""
    n = len(scene.second)
    if len(rows) == n:
        return [(None, KEPT[-1])]
    if not scene.model.turns():
        return [(rows, KEPT[-1])]
    features = scene.second.features
    distance = np.sum((features - features[rows].mean(axis=0)) ** 2, axis=1)
    order = np.argsort(distance, kind="stable")
    parts: list[tuple[IntArray | None, int]] = [(rows, 4)]
    size = len(rows) * GROWTH
    while size < min(n, SAMPLE):
        parts.append((np.sort(order[:size]), 2))
        size *= GROWTH
    return parts


def _anneal(scene: PlacedSources, belief: OffsetPrior, trials: Trials, keep: int, widenings: Sequence[float]) -> Trials:
    """All offsets refined together, errors from wide to quoted: the best ``keep`` of them."""
    for number, widening in enumerate(widenings):
        found = weigh(scene, trials.theta, trials.common, widening)
        score, information = _normal_equations(scene, belief, trials.theta, found)
        theta = trials.theta + np.linalg.solve(information, score[..., None])[..., 0]
        gain = found.gain - 0.5 * np.sum(belief.precision * theta**2, axis=1)
        best = np.argsort(-gain, kind="stable")[: max(KEPT[number], keep)]
        trials = Trials(theta, found.common, gain).chosen(best)
    return trials.chosen(range(min(keep, len(trials.gain))))


def _normal_equations(
    scene: PlacedSources, belief: OffsetPrior, theta: FloatArray, found: Weighed
) -> tuple[FloatArray, FloatArray]:
    """Score (s, p) of the log posterior of θ, and its information (s, p, p) if the weights were the truth."""
    from sameas.kernels.offsets import pulls

    d, p = scene.second.d, theta.shape[1]
    jacobian = scene.model.jacobian(scene.second.features, theta[:, None, :])
    jacobian = np.ascontiguousarray(np.broadcast_to(jacobian, (len(theta), len(scene.second), d, p)))
    score, information = pulls(found.s, found.j, found.residual, found.precision, found.weight, jacobian, WEAK)
    return score - belief.precision * theta, information + np.diag(belief.precision)


def _settled(
    scene: PlacedSources, belief: OffsetPrior, one: Trials, rounds: int
) -> tuple[Trials, FloatArray, int, bool]:
    """One offset near its maximum, (p, p) its information if the weights were true, rounds, whether they settled."""
    at, common, number, settled = one.theta, one.common, 0, False
    while True:
        number += 1
        found = weigh(scene, at, common, 1.0)
        score, information = _normal_equations(scene, belief, at, found)
        step = np.linalg.solve(information, score[..., None])[..., 0]
        at = at + step
        moved_by = math.sqrt(max(float(step[0] @ information[0] @ step[0]), 0.0))
        settled = moved_by <= SETTLED and abs(float(found.common[0] - common[0])) <= 0.01 + 3e-3 * float(common[0])
        common = found.common
        if settled or number >= rounds:
            return Trials(at, common, found.gain), information[0], number, settled


def _finished(
    scene: PlacedSources, sample: PlacedSources, belief: OffsetPrior, one: Trials, rounds: int, spent: int
) -> Solution:
    """One offset brought to its maximum, with its covariance and evidence."""
    one, complete, number, settled = _settled(scene, belief, one, rounds)
    share = len(sample.second) / len(scene.second)
    axes, score, found = _missing(sample, belief, one.shared_by(share), share * complete)
    if sample is not scene:
        found = weigh(scene, one.theta, one.common, 1.0)
        score, _ = _normal_equations(scene, belief, one.theta, found)
    root = np.linalg.cholesky(inverse(complete)) @ axes
    theta = one.theta[0] + root @ root.T @ score[0]
    if found.common[0] < MANY:
        root = _stretched(scene, belief, theta, found.common[:1], root)
    covariance = root @ root.T
    log_prior = float(np.sum(belief.log_density - 0.5 * belief.precision * theta**2))
    occam = 0.5 * (float(log_determinant(covariance)) + len(theta) * LOG_2PI)
    likelihood = float(found.gain[0])
    # No mean is larger than the maximum, however little the data say of an offset.
    evidence = likelihood + min(log_prior + occam, 0.0)
    shared = (int(found.in_common[0, 0]), int(found.in_common[0, 1]))
    return Solution(
        theta, covariance, float(found.common[0]), likelihood, evidence, shared, spent + number, settled,
    )  # fmt: skip


def _missing(
    scene: PlacedSources, belief: OffsetPrior, one: Trials, complete: FloatArray
) -> tuple[FloatArray, FloatArray, Weighed]:
    """By how much longer the axes (p, p) of the covariance are than if it were known which pairs are true.

    The observed information is taken by central differences of the score over a fifth of a standard error: its
    eigenvalues, in the units of the complete information (p, p), are the shares of it that are not missing. Also the
    scores, and the weights, at the offset itself and around.
    """
    p = one.theta.shape[1]
    step = 0.2 / np.sqrt(np.diag(complete))
    nodes = np.concatenate([one.theta, one.theta + np.diag(step), one.theta - np.diag(step)])
    found = weigh(scene, nodes, np.repeat(one.common, 2 * p + 1), 1.0)
    score, information = _normal_equations(scene, belief, nodes, found)
    observed = -(score[1 : p + 1] - score[p + 1 :]) / (2.0 * step[:, None])
    scale = np.linalg.cholesky(inverse(information[0]))
    shares, axes = np.linalg.eigh(scale.T @ symmetric(observed) @ scale)
    return axes / np.sqrt(np.clip(shares, 0.02, None)), score, found


def _stretched(
    scene: PlacedSources, belief: OffsetPrior, theta: FloatArray, common: FloatArray, root: FloatArray
) -> FloatArray:
    """The axes ``root`` (p, p) of the covariance, as long as the posterior of θ reaches along each of them.

    The likelihood of a few pairs is wider than its curvature at the maximum says: other pairs take over further out,
    and the number of common objects follows. Second moments along the axes, by the trapezoidal rule.
    """
    nodes = np.concatenate([theta[None, :], (theta + AWAY[:, None, None] * root.T).reshape(-1, len(theta))])
    met = meet(scene, nodes, 1.0).as_overlapping_at(0)
    shared = weighed(scene, met, np.repeat(common, len(nodes)), ROUGHLY).common
    log_density = weighed(scene, met, shared, CLOSELY).gain - 0.5 * np.sum(belief.precision * nodes**2, axis=1)
    density = np.exp(np.minimum(log_density[1:] - log_density[0], 0.0)).reshape(len(AWAY), -1)
    return np.asarray(root * np.sqrt((AWAY**2 @ density) / (1.0 + density.sum(axis=0))))


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
    return by_errors <= SAME_ERRORS**2 or displacement_sigmas(scene, one.theta, other.theta) <= SAME_SIGMAS


def _without_doubles(scene: PlacedSources, found: list[Solution]) -> list[Solution]:
    kept: list[Solution] = []
    for one in found:
        if not any(_same(scene, other, one) for other in kept):
            kept.append(one)
    return kept

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

import numpy as np
from numpy.typing import NDArray

from sameas.records import FloatArray
from sameas.registration.votes import Votes
from sameas.registration.weights import Scene, Weighed, boxed, flattened, weigh

#: Factors by which errors are taken wider than quoted, round by round, and how many beginnings go on after each.
WIDENINGS = (2.0, 1.5, 1.2, 1.0, 1.0, 1.0)
KEPT = (64, 64, 48, 32, 24, 16)
#: A step below this share of a standard error is no step.
SETTLED = 0.003
#: Two solutions are one when no record moves between them by more than so many standard deviations.
SAME_SIGMAS = 0.7
#: Solutions that are less likely than the best by this factor (its logarithm) are not pursued.
HOPELESS = 8.0
#: A pattern repeats where another solution explains this share of what the best explains: chance never does.
REPEATING = 0.4
#: Many records are searched with so many of the second source; all of them speak in the last refinement.
SAMPLE = 4000
#: A patch grows by this factor from one refinement to the next.
GROWTH = 8
WEAK = 1e-6


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
class Belief:
    """What is believed of θ beforehand: normal around zero, or flat over all shifts that the records can have.

    precision : (p,). log_density : (p,) ln of the prior density at zero.
    """

    precision: FloatArray
    log_density: FloatArray

    @classmethod
    def of(cls, scene: Scene) -> Belief:
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
        log_normal = 0.5 * np.log(precision) - 0.5 * math.log(2.0 * math.pi)
        return cls(precision, np.where(flat, 0.5 * np.log(precision), log_normal))


def refine(scene: Scene, votes: Votes, rounds: int) -> list[Solution]:
    """The solutions that the votes lead to, most probable first; at most ``rounds`` rounds each after the search."""
    belief = Belief.of(scene)
    n = len(scene.second)
    sample = scene.of_patch(np.linspace(0, n - 1, min(n, SAMPLE)).astype(np.int64))
    ends: list[FloatArray] = []
    for number, rows in enumerate(votes.patches):
        theta = votes.theta[votes.patch == number]
        for part, keep in _nested(scene, rows) if len(theta) else []:
            theta, _ = _anneal(sample if part is None else scene.of_patch(part), belief, theta, keep, WIDENINGS)
        ends.extend(theta)
    distinct = _distinct(scene, np.array(ends).reshape(-1, len(belief.precision)))
    # What was found on a patch is only near for all records.
    closing = WIDENINGS[-2:] if len(votes.patches) == 1 else WIDENINGS[2:]
    theta, gain = _anneal(sample, belief, distinct, KEPT[-1], closing)
    theta = _distinct(scene, theta[gain > min(gain[0] - HOPELESS, REPEATING * gain[0])])
    if sample is not scene:
        theta = np.array([_finished(sample, belief, one, rounds, 0).theta for one in theta])
    spent = len(WIDENINGS) + len(closing)
    found = [_finished(scene, belief, one, rounds, spent) for one in theta]
    found.sort(key=lambda solution: -solution.log_evidence)
    return _without_doubles(scene, found)


def _nested(scene: Scene, rows: NDArray[np.int64]) -> list[tuple[NDArray[np.int64] | None, int]]:
    """The patch, then larger and larger ones around it, or None for a sample of all; and how many each keeps."""
    n = len(scene.second)
    if len(rows) == n:
        return [(None, KEPT[-1])]
    features = scene.second.features
    distance = np.sum((features - features[rows].mean(axis=0)) ** 2, axis=1)
    order = np.argsort(distance, kind="stable")
    parts: list[tuple[NDArray[np.int64] | None, int]] = [(rows, 4)]
    size = len(rows) * GROWTH
    while size < min(n, SAMPLE):
        parts.append((np.sort(order[:size]), 2))
        size *= GROWTH
    return parts


def _anneal(
    scene: Scene, belief: Belief, theta: FloatArray, keep: int, widenings: Sequence[float]
) -> tuple[FloatArray, FloatArray]:
    """All offsets refined together, errors from wide to quoted: the best ``keep`` of them and their log likelihoods."""
    common = np.full(len(theta), 0.5 * min(len(scene.first), len(scene.second)))
    gain = np.zeros(len(theta))
    for number, widening in enumerate(widenings):
        found = weigh(scene, theta, common, widening)
        score, information = _normal_equations(scene, belief, theta, found)
        theta = theta + np.linalg.solve(information, score[..., None])[..., 0]
        gain = found.gain - 0.5 * np.sum(belief.precision * theta**2, axis=1)
        best = np.sort(np.argsort(-gain, kind="stable")[: max(KEPT[number], keep)])
        theta, common, gain = theta[best], found.common[best], gain[best]
    best = np.argsort(-gain, kind="stable")[:keep]
    return theta[best], gain[best]


def _normal_equations(scene: Scene, belief: Belief, theta: FloatArray, found: Weighed) -> tuple[FloatArray, FloatArray]:
    """Score (s, p) of the log posterior of θ, and its information (s, p, p) if the weights were the truth."""
    use = found.weight > WEAK
    s, j, weight = found.s[use], found.j[use], found.weight[use]
    jacobian = scene.model.jacobian(scene.second.features, theta[:, None, :])[s, j]
    pull = np.einsum("mvw,mwp->mvp", found.precision[use], jacobian) * weight[:, None, None]
    p, sets = theta.shape[1], len(theta)
    terms = np.einsum("mvp,mv->mp", pull, found.residual[use])
    squares = np.einsum("mvp,mvq->mpq", pull, jacobian).reshape(-1, p * p)
    score = np.stack([np.bincount(s, terms[:, k], sets) for k in range(p)], axis=1)
    information = np.stack([np.bincount(s, squares[:, k], sets) for k in range(p * p)], axis=1).reshape(-1, p, p)
    return np.asarray(score - belief.precision * theta), np.asarray(information + np.diag(belief.precision), np.float64)


def _finished(scene: Scene, belief: Belief, theta: FloatArray, rounds: int, spent: int) -> Solution:
    """One offset brought to its maximum, with its covariance and evidence."""
    at, common, number, settled = theta[None, :], np.array([0.5 * min(len(scene.first), len(scene.second))]), 0, False
    common = weigh(scene, at, common, 1.0).common
    while not settled and number < rounds:
        number += 1
        found = weigh(scene, at, common, 1.0)
        score, information = _normal_equations(scene, belief, at, found)
        step = np.linalg.solve(information, score[..., None])[..., 0]
        at = at + step
        moved_by = math.sqrt(max(float(step[0] @ information[0] @ step[0]), 0.0))
        settled = moved_by <= SETTLED and abs(float(found.common[0] - common[0])) <= 0.01 + 3e-3 * float(common[0])
        common = found.common
    found = weigh(scene, at, common, 1.0)
    _, complete = _normal_equations(scene, belief, at, found)
    covariance = _covariance(scene, belief, at, common, complete[0])
    log_prior = float(np.sum(belief.log_density - 0.5 * belief.precision * at[0] ** 2))
    occam = 0.5 * (np.linalg.slogdet(covariance)[1] + len(theta) * math.log(2.0 * math.pi))
    likelihood = float(found.gain[0])
    # No mean is larger than the maximum, however little the data say of an offset.
    evidence = likelihood + min(log_prior + float(occam), 0.0)
    shared = (int(found.in_common[0, 0]), int(found.in_common[0, 1]))
    return Solution(
        at[0], covariance, float(found.common[0]), likelihood, evidence, shared,
        spent + number, settled,
    )  # fmt: skip


def _covariance(
    scene: Scene, belief: Belief, theta: FloatArray, common: FloatArray, complete: FloatArray
) -> FloatArray:
    """(p, p) inverse of the observed information, by central differences of the score over a fifth of a sigma."""
    p = theta.shape[1]
    step = 0.2 / np.sqrt(np.diag(complete))
    nodes = np.concatenate([theta + np.diag(step), theta - np.diag(step)])
    found = weigh(scene, nodes, np.repeat(common, 2 * p), 1.0)
    score, _ = _normal_equations(scene, belief, nodes, found)
    observed = -(score[:p] - score[p:]) / (2.0 * step[:, None])
    observed = 0.5 * (observed + observed.T)
    # In the units of the complete information its eigenvalues are the shares of it that are not missing.
    scale = np.linalg.cholesky(np.linalg.inv(complete))
    shares, axes = np.linalg.eigh(scale.T @ observed @ scale)
    root = scale @ axes / np.sqrt(np.clip(shares, 0.02, None))
    return np.asarray(root @ root.T)


def displacement_sigmas(scene: Scene, one: FloatArray, other: FloatArray) -> float:
    """By how many standard deviations the records stand apart under two offsets, at most (but for one in ten)."""
    jacobian = scene.model.jacobian(scene.second.features, one)
    move = np.einsum("nvp,p->nv", jacobian, other - one)
    return float(np.quantile(np.sqrt(np.sum(move**2, axis=1)), 0.9)) / scene.sigma


def _distinct(scene: Scene, theta: FloatArray) -> FloatArray:
    """The same offsets, each only once, in their order."""
    kept: list[FloatArray] = []
    for one in theta:
        if all(displacement_sigmas(scene, one, other) > 0.1 for other in kept):
            kept.append(one)
    return np.array(kept).reshape(-1, theta.shape[1])


def _without_doubles(scene: Scene, found: list[Solution]) -> list[Solution]:
    kept: list[Solution] = []
    for one in found:
        if all(displacement_sigmas(scene, other.theta, one.theta) > SAME_SIGMAS for other in kept):
            kept.append(one)
    return kept

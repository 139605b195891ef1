"""Refinement of initial offsets to maximum likelihood, jointly with the identification, and the registration itself.

EM iterates the pairs' weights and the offset, at first with errors wider than quoted; less likely offsets are dropped
on the way. The covariance is the inverse of the observed information: the information of the pairs minus the missing
information, as it is not known which pairs are true (Louis 1982). It is the derivative of the score, in which the
weights depend on the offset.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sameas._identify import identify
from sameas.arrays import FloatArray, IntArray
from sameas.errors import InputError
from sameas.estimate.match import match
from sameas.evidence import Errors, Rule
from sameas.gate.gate import feature_count
from sameas.gaussian import LOG_2PI, inverse, log_determinant, mahalanobis_sq, propagated, symmetric
from sameas.prior import EVIDENCE_ALONE, Prior
from sameas.records import Records
from sameas.registration.hough import HoughSearch, Votes
from sameas.registration.offsets import Offset
from sameas.registration.weights import (
    MESSAGE_TOLERANCE,
    SEARCH_MESSAGE_TOLERANCE,
    PlacedSources,
    Weighed,
    boxed,
    candidates_at,
    flattened,
    records_moved,
    weigh,
    weighed,
)
from sameas.representation import in_short
from sameas.result import Identification

#: Maximum and minimum number of refined offsets. Fewer than STARTS are refined if the second source has more than
#: 16 × REFINED_RECORDS / STARTS records.
STARTS, MIN_STARTS, REFINED_RECORDS = 64, 6, 4000
SURE = 0.95  # minimum posterior probability of an established offset
DECISIVE = math.log(SURE / (1.0 - SURE))  # ln of its odds
SMALL_OVERLAP = 0.2  # an overlap below this share of both sources is reported
#: Factors on the errors, by iteration, and candidates that remain after each.
WIDENINGS, N_CANDIDATES = (2.0, 1.5, 1.2, 1.0, 1.0), (64, 64, 48, 32, 16)
FROM_PATCHES, FROM_SAMPLE = 2, 3  # first of the widenings with all records, after patches and after a sample
STEP_TOLERANCE = 0.01  # the refinement has converged if a step is below this share of a standard error
#: Two solutions are the same if 9 of 10 records move by at most this many σ, or if they differ by at most this many
#: standard errors.
SAME_SIGMAS, SAME_ERRORS = 0.7, 2.0
MAX_LOG_DEFICIT = 8.0  # solutions with a log likelihood lower than the best by this are dropped
REPEAT_SHARE = 0.4  # the pattern repeats if another solution has this share of the best one's log likelihood
#: Records of the second source in the search (the last refinement uses all of them), and records in the search per
#: record whose votes decided.
SAMPLE, SAMPLE_RATIO = 4000, 16
PATCH_GROWTH = 8  # factor by which a patch grows from one refinement to the next
MIN_WEIGHT = 1e-6  # pairs of lower weight are ignored in the normal equations
#: With fewer common objects, the likelihood is also evaluated at so many standard deviations from its maximum.
FEW_COMMON, TRIAL_SIGMAS = 200.0, (-3.0, -1.5, 1.5, 3.0)


@dataclass(frozen=True)
class Solution:
    """A refined offset.

    theta (p,), covariance (p, p). common : expected number of common objects. log_likelihood : of the identification,
    minus that of nothing in common. log_evidence : the same, averaged over the offsets near this one by their prior.
    in_common : number of records of either source in the overlap. iterations, converged : their number, and
    whether they converged.
    """

    theta: FloatArray
    covariance: FloatArray
    common: float
    log_likelihood: float
    log_evidence: float
    in_common: tuple[int, int]
    iterations: int
    converged: bool


@dataclass(frozen=True)
class OffsetPrior:
    """The prior of θ: normal around zero, or flat over all shifts that bring any two records together.

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
        # A parameter of infinite width is flat over ``span``; one of width 0 is practically fixed.
        width = np.where(flat, span / moves, widths)
        fixed = 1e12 * (moves / scene.sigma) ** 2
        precision = np.where(width > 0.0, 1.0 / np.maximum(width, 1e-300) ** 2, fixed)
        log_normal = 0.5 * np.log(precision) - 0.5 * LOG_2PI
        return cls(precision, np.where(flat, 0.5 * np.log(precision), log_normal))


@dataclass(frozen=True)
class Trials:
    """Offsets in refinement, best first: theta (s, p), expected common objects (s,), log likelihoods (s,)."""

    theta: FloatArray
    common: FloatArray
    gain: FloatArray

    @classmethod
    def initial(cls, scene: PlacedSources, theta: FloatArray) -> Trials:
        """Offsets before any evaluation."""
        return cls(theta, np.full(len(theta), 0.5 * min(len(scene.first), len(scene.second))), np.zeros(len(theta)))

    def chosen(self, which: Sequence[int] | NDArray[Any]) -> Trials:
        """Some of them."""
        return Trials(self.theta[which], self.common[which], self.gain[which])

    def scaled(self, factor: float) -> Trials:
        """The same for ``factor`` times as many records."""
        return Trials(self.theta, self.common * factor, self.gain)


def refine(scene: PlacedSources, votes: Votes, max_steps: int) -> list[Solution]:
    """Solutions from the votes, most probable first; at most ``max_steps`` iterations each after the search."""
    prior = OffsetPrior.of(scene)
    n, size = len(scene.second), SAMPLE
    if not scene.model.turns():
        # The search has fewer records where the votes of few decided.
        size = min(size, SAMPLE_RATIO * len(votes.patches[0]))
    sample = scene.of_patch(np.linspace(0, n - 1, min(n, size)).astype(np.int64))
    trials, search_steps = _searched(scene, sample, prior, votes)
    solutions = []
    for k in range(len(trials.gain)):
        one, steps = trials.chosen([k]), search_steps
        if sample is not scene:
            one, _, number, _ = _converged(sample, prior, one, max_steps)
            one, steps = one.scaled(len(scene.second) / len(sample.second)), steps + number
        solutions.append(_finished(scene, sample, prior, one, max_steps, steps))
    solutions.sort(key=lambda solution: -solution.log_evidence)
    return _without_repetitions(scene, solutions)


def _searched(scene: PlacedSources, sample: PlacedSources, prior: OffsetPrior, votes: Votes) -> tuple[Trials, int]:
    """The offsets refined on their patches and then on the sample of all records, and the number of iterations."""
    ends = []
    for number, rows in enumerate(votes.patches):
        trials = Trials.initial(scene, votes.theta[votes.patch == number])
        for part, keep in _growing_patches(scene, rows) if len(trials.theta) else []:
            patch = sample if part is None else scene.of_patch(part)
            trials = _anneal(patch, prior, Trials.initial(patch, trials.theta), keep, WIDENINGS)
            trials = trials.scaled(len(sample.second) / len(patch.second))
        ends.append(trials)
    if len(ends) == 1:
        trials, steps = _distinct(scene, _promising(ends[0])), len(WIDENINGS)
        if len(votes.patches[0]) == len(sample.second) or len(trials.gain) == 1:
            return trials, steps
        closing = WIDENINGS[FROM_SAMPLE:]
    else:
        # The offsets of a patch hold only approximately for all records.
        trials = _distinct(scene, Trials.initial(sample, np.concatenate([trials.theta for trials in ends])))
        steps, closing = len(WIDENINGS), WIDENINGS[FROM_PATCHES:]
    trials = _anneal(sample, prior, Trials.initial(sample, trials.theta), N_CANDIDATES[-1], closing)
    return _distinct(scene, _promising(trials)), steps + len(closing)


def _promising(trials: Trials) -> Trials:
    """The offsets that may be the true one, or show that the pattern repeats."""
    best = trials.gain[0]
    return trials.chosen(trials.gain > min(best - MAX_LOG_DEFICIT, REPEAT_SHARE * best))


def _growing_patches(scene: PlacedSources, rows: IntArray) -> list[tuple[IntArray | None, int]]:
    """The patch and larger ones around it, or None for the sample of all records; and how many offsets each keeps."""
    n = len(scene.second)
    if len(rows) == n:
        return [(None, N_CANDIDATES[-1])]
    if not scene.model.turns():
        return [(rows, N_CANDIDATES[-1])]
    features = scene.second.features
    distance = np.sum((features - features[rows].mean(axis=0)) ** 2, axis=1)
    order = np.argsort(distance, kind="stable")
    parts: list[tuple[IntArray | None, int]] = [(rows, 4)]
    size = len(rows) * PATCH_GROWTH
    while size < min(n, SAMPLE):
        parts.append((np.sort(order[:size]), 2))
        size *= PATCH_GROWTH
    return parts


def _anneal(scene: PlacedSources, prior: OffsetPrior, trials: Trials, keep: int, widenings: Sequence[float]) -> Trials:
    """The best ``keep`` offsets, after refining all together with errors decreasing to the quoted ones."""
    for number, widening in enumerate(widenings):
        weights = weigh(scene, trials.theta, trials.common, widening)
        score, information = normal_equations(scene, prior, trials.theta, weights)
        theta = trials.theta + np.linalg.solve(information, score[..., None])[..., 0]
        gain = weights.gain - 0.5 * np.sum(prior.precision * theta**2, axis=1)
        best = np.argsort(-gain, kind="stable")[: max(N_CANDIDATES[number], keep)]
        trials = Trials(theta, weights.common, gain).chosen(best)
    return trials.chosen(range(min(keep, len(trials.gain))))


def normal_equations(
    scene: PlacedSources, prior: OffsetPrior, theta: FloatArray, weights: Weighed
) -> tuple[FloatArray, FloatArray]:
    """Score (s, p) of the log posterior of θ, and its complete information (s, p, p), for fixed weights."""
    from sameas.kernels.offsets import score_and_information

    d, p = scene.second.d, theta.shape[1]
    jacobian = np.ascontiguousarray(np.broadcast_to(weights.displaced.by_theta, (len(theta), len(scene.second), d, p)))
    score, information = score_and_information(
        weights.s, weights.j, weights.residual, weights.precision, weights.weight, jacobian, MIN_WEIGHT
    )
    return score - prior.precision * theta, information + np.diag(prior.precision)


def _converged(
    scene: PlacedSources, prior: OffsetPrior, one: Trials, max_steps: int
) -> tuple[Trials, FloatArray, int, bool]:
    """One offset at its maximum, its complete information (p, p), the number of iterations, whether they converged."""
    at, common, number, converged = one.theta, one.common, 0, False
    while True:
        number += 1
        weights = weigh(scene, at, common, 1.0)
        score, information = normal_equations(scene, prior, at, weights)
        step = np.linalg.solve(information, score[..., None])[..., 0]
        at = at + step
        moved_by = math.sqrt(max(float(step[0] @ information[0] @ step[0]), 0.0))
        common_change = abs(float(weights.common[0] - common[0]))
        converged = moved_by <= STEP_TOLERANCE and common_change <= 0.01 + 3e-3 * float(common[0])
        common = weights.common
        if converged or number >= max_steps:
            return Trials(at, common, weights.gain), information[0], number, converged


def _finished(
    scene: PlacedSources, sample: PlacedSources, prior: OffsetPrior, one: Trials, max_steps: int, search_steps: int
) -> Solution:
    """One offset at its maximum, with its covariance and evidence."""
    one, complete, number, converged = _converged(scene, prior, one, max_steps)
    share = len(sample.second) / len(scene.second)
    axes, score, weights = missing_information(sample, prior, one.scaled(share), share * complete)
    if sample is not scene:
        weights = weigh(scene, one.theta, one.common, 1.0)
        score, _ = normal_equations(scene, prior, one.theta, weights)
    root = np.linalg.cholesky(inverse(complete)) @ axes
    theta = one.theta[0] + root @ root.T @ score[0]
    if weights.common[0] < FEW_COMMON:
        root = _stretched(scene, prior, theta, weights.common[:1], root)
    covariance = root @ root.T
    log_prior = float(np.sum(prior.log_density - 0.5 * prior.precision * theta**2))
    occam = 0.5 * (float(log_determinant(covariance)) + len(theta) * LOG_2PI)
    likelihood = float(weights.gain[0])
    # A mean of the likelihood over offsets cannot exceed its maximum.
    evidence = likelihood + min(log_prior + occam, 0.0)
    in_common = (int(weights.in_common[0, 0]), int(weights.in_common[0, 1]))
    return Solution(
        theta, covariance, float(weights.common[0]), likelihood, evidence, in_common, search_steps + number, converged
    )


def missing_information(
    scene: PlacedSources, prior: OffsetPrior, one: Trials, complete: FloatArray
) -> tuple[FloatArray, FloatArray, Weighed]:
    """Axes (p, p) of the covariance in units of the complete one, longer by the missing information; also the scores
    and weights at the offset itself and around it.

    The observed information is found by central differences of the score over a fifth of a standard error. Its
    eigenvalues, in units of the complete information (p, p), are the shares of it that are not missing.
    """
    p = one.theta.shape[1]
    step = 0.2 / np.sqrt(np.diag(complete))
    nodes = np.concatenate([one.theta, one.theta + np.diag(step), one.theta - np.diag(step)])
    weights = weigh(scene, nodes, np.repeat(one.common, 2 * p + 1), 1.0)
    score, information = normal_equations(scene, prior, nodes, weights)
    observed = -(score[1 : p + 1] - score[p + 1 :]) / (2.0 * step[:, None])
    scale = np.linalg.cholesky(inverse(information[0]))
    shares, axes = np.linalg.eigh(scale.T @ symmetric(observed) @ scale)
    return axes / np.sqrt(np.clip(shares, 0.02, None)), score, weights


def _stretched(
    scene: PlacedSources, prior: OffsetPrior, theta: FloatArray, common: FloatArray, root: FloatArray
) -> FloatArray:
    """The axes ``root`` (p, p) of the covariance, scaled to the posterior's second moment along each of them.

    The likelihood of a few pairs is wider than its curvature at the maximum suggests: farther out other pairs gain
    weight, and the number of common objects changes. The moments are by the trapezoidal rule.
    """
    away = np.array(TRIAL_SIGMAS)
    nodes = np.concatenate([theta[None, :], (theta + away[:, None, None] * root.T).reshape(-1, len(theta))])
    candidates = candidates_at(scene, nodes, 1.0).with_overlap_of_first()
    common_at = weighed(scene, candidates, np.repeat(common, len(nodes)), SEARCH_MESSAGE_TOLERANCE).common
    log_density = weighed(scene, candidates, common_at, MESSAGE_TOLERANCE).gain - 0.5 * np.sum(
        prior.precision * nodes**2, axis=1
    )
    density = np.exp(np.minimum(log_density[1:] - log_density[0], 0.0)).reshape(len(away), -1)
    return np.asarray(root * np.sqrt((away**2 @ density) / (1.0 + density.sum(axis=0))))


def displacement_sigmas(scene: PlacedSources, one: FloatArray, other: FloatArray) -> float:
    """Displacement of the records between two offsets, in standard deviations: the 90 % quantile."""
    jacobian = scene.model.jacobian(scene.second.features, one)
    move = np.einsum("nvp,p->nv", jacobian, other - one)
    return float(np.quantile(np.sqrt(np.sum(move**2, axis=1)), 0.9)) / scene.sigma


def _distinct(scene: PlacedSources, trials: Trials) -> Trials:
    """The offsets without repetitions, in their order."""
    kept: list[int] = []
    for k, one in enumerate(trials.theta):
        if all(displacement_sigmas(scene, one, trials.theta[other]) > 0.1 for other in kept):
            kept.append(k)
    return trials.chosen(kept)


def _same(scene: PlacedSources, one: Solution, other: Solution) -> bool:
    """Whether two solutions are the same, within σ of the records or within their standard errors."""
    apart = other.theta - one.theta
    by_errors = float(mahalanobis_sq(apart, one.covariance))
    return by_errors <= SAME_ERRORS**2 or displacement_sigmas(scene, one.theta, other.theta) <= SAME_SIGMAS


def _without_repetitions(scene: PlacedSources, solutions: list[Solution]) -> list[Solution]:
    """The solutions of which no more probable one is the same."""
    distinct: list[Solution] = []
    for one in solutions:
        if not any(_same(scene, other, one) for other in distinct):
            distinct.append(one)
    return distinct


@dataclass(frozen=True)
class Parameter:
    """One parameter of the offset: value and standard error, in ``unit`` ("" for the unit of the features)."""

    value: float
    standard_error: float
    unit: str


@in_short
@dataclass(frozen=True)
class Registration:
    """The offset between two sources, and the identification after removing it.

    Attributes
    ----------
    model : the offset model, as placed on the data.
    theta, covariance : (p,) and (p, p), in the order of ``model.names``.
    registered : the second source's records moved onto the first's; their covariances include the offset's uncertainty.
    identification : of ``first`` and ``registered``.
    common : expected number of common objects under the offset.
    log_evidence : ln of the odds of this offset against nothing in common.
    rivals : other solutions, most probable first.
    probability : of this offset, among all solutions and nothing in common.
    iterations, converged : iterations of the refinement, and whether they converged.
    notes : doubts; empty if there are none.
    """

    model: Offset
    theta: FloatArray
    covariance: FloatArray
    registered: Records
    identification: Identification
    common: float
    log_evidence: float
    rivals: tuple[Solution, ...]
    probability: float
    iterations: int
    converged: bool
    notes: tuple[str, ...]

    @property
    def established(self) -> bool:
        """Whether this offset alone explains the data, neither another one nor chance (nothing in common)."""
        return self.probability >= SURE and not any(_credible(rival, self.log_evidence) for rival in self.rivals)

    @property
    def standard_errors(self) -> FloatArray:
        """(p,) of theta."""
        return np.sqrt(np.diag(self.covariance))

    @cached_property
    def parameters(self) -> Mapping[str, Parameter]:
        """The parameters by name."""
        columns = zip(self.model.names, self.theta, self.standard_errors, self.model.units, strict=True)
        return {name: Parameter(float(value), float(error), unit) for name, value, error, unit in columns}


def register(
    first: Records,
    second: Records,
    model: Offset,
    *,
    errors: Errors | None = Errors(),  # noqa: B008 (frozen)
    density: tuple[float, float] | None = None,
    rule: Rule | None = None,
    prior: Prior = EVIDENCE_ALONE,
    max_iterations: int = 40,
) -> Registration:
    """The offset of the second source from the first, with its covariance, and the identification after removing it.

    The search covers every offset that brings any pair of records together. The refinement weights every pair by its
    posterior. The solution of largest evidence is the answer; others nearly as good are in the notes.

    Parameters
    ----------
    first, second : records of one feature space, with errors that do not include the offset.
    model : ``Shift()``, ``Similarity()``, ``Affine()`` or ``SensorBias(position)``; the second source is moved.
    errors : how residuals relate to the quoted errors in the identification; None estimates it. The offset itself is
        found with the quoted errors.
    density : (ρ₁, ρ₂) of all records of each source; estimated if not given.
    rule, prior : evidence and prior of the identification, such as ``Field`` and ``CommonObjects(q1, q2)``; without a
        rule everything is estimated as by ``match``.
    max_iterations : maximum number of iterations of the last refinement.

    Raises
    ------
    InputError : a source without usable records, different spaces, a model that does not suit the space.

    Source: METHOD 6; Levedahl 2002 (offset and assignment are estimated jointly), Louis 1982 (the covariance).

    >>> from sameas.registration import Shift
    >>> rng = np.random.default_rng(1)
    >>> places = rng.uniform(0.0, 60.0, (40, 2))
    >>> radar = Records.of(places + 0.7 * rng.standard_normal((40, 2)), sigma=0.7, source="radar")
    >>> ais = Records.of(places + 0.7 * rng.standard_normal((40, 2)) - [21.0, 4.0], sigma=0.7, source="ais")
    >>> found = register(radar, ais, Shift())
    >>> abs(found.parameters["shift_x"].value - 21.0) < 0.5, found.established, len(found.identification.matches)
    (True, True, 40)
    """
    feature_count(first, second)
    for records in (first, second):
        if not len(records):
            raise InputError(f"{records.source} has no usable records; no offset can be found")
    placed = model.placed(first, second)
    scene = PlacedSources.of(first, second, placed)
    solutions = refine(scene, _initial_offsets(HoughSearch(first, second, placed)), max_iterations)
    best = solutions[0]
    registered = _registered(scene, best)
    if rule is None:
        answer, _ = match(first, registered, errors=errors, density=density)
    else:
        answer = identify(first, registered, rule=rule, prior=prior)
    ahead = [one.log_evidence - best.log_evidence for one in solutions[1:]]
    probability = 1.0 / (1.0 + sum(math.exp(x) for x in ahead) + math.exp(min(-best.log_evidence, 700.0)))
    return Registration(
        model=placed, theta=best.theta, covariance=best.covariance, registered=registered, identification=answer,
        common=best.common, log_evidence=best.log_evidence, rivals=tuple(solutions[1:]), probability=probability,
        iterations=best.iterations, converged=best.converged, notes=_notes(scene, solutions),
    )  # fmt: skip


def _initial_offsets(search: HoughSearch) -> Votes:
    """The offsets with the most votes, and the offset 0."""
    few = min(STARTS, REFINED_RECORDS * 16 // len(search.second))
    return search.vote(STARTS if search.model.turns() else max(few, MIN_STARTS)).with_zero()


def _credible(rival: Solution, log_evidence: float) -> bool:
    """Whether a solution is nearly as good as the best one, or so good that the pattern must repeat.

    Randomly scattered objects fit at one offset only. If they fit at two, as on a lattice, the assumptions of the
    evidence do not hold, and its differences are not reliable.
    """
    return rival.log_evidence > min(log_evidence - DECISIVE, max(REPEAT_SHARE * log_evidence, DECISIVE))


def _registered(scene: PlacedSources, solution: Solution) -> Records:
    """The second source moved by the solution: Σ propagated, plus J C Jᵀ for the offset's own uncertainty."""
    features = scene.second.features
    carried = scene.model.carried(features, solution.theta)
    jacobian = scene.model.jacobian(features, solution.theta)
    covariance = propagated(carried, scene.covariance_2) + propagated(jacobian, solution.covariance)
    return records_moved(scene.second, scene.model.moved(features, solution.theta), covariance)


def _notes(scene: PlacedSources, solutions: list[Solution]) -> tuple[str, ...]:
    """Doubts about the best solution."""
    best, names = solutions[0], (scene.first.source, scene.second.source)
    notes = []
    if best.log_evidence < DECISIVE:
        notes.append(
            f"{names[0]} and {names[1]} may have no object in common: the offset is not significant "
            f"(log evidence {best.log_evidence:.1f})"
        )
    rivals = [one for one in solutions[1:] if _credible(one, best.log_evidence)]
    if rivals:
        columns = zip(scene.model.names, rivals[0].theta, strict=True)
        values = ", ".join(f"{name} {value:.4g}" for name, value in columns)
        notes.append(
            f"{len(rivals)} other offset{'s explain' if len(rivals) > 1 else ' explains'} the data nearly as well, the "
            f"next with log evidence lower by {best.log_evidence - rivals[0].log_evidence:.1f}: {values}"
        )
    needed = len(best.theta) / scene.first.d + 2.0
    if best.common < needed:
        notes.append(
            f"too few pairs: {best.common:.1f} expected for {len(best.theta)} parameters, {needed:.0f} are needed"
        )
    fewest = min(best.in_common[0] / len(scene.first), best.in_common[1] / len(scene.second))
    most = max(best.in_common[0] / len(scene.first), best.in_common[1] / len(scene.second))
    if most < SMALL_OVERLAP:
        notes.append(
            f"small overlap: only {100 * fewest:.0f} % to {100 * most:.0f} % of the records lie in the common area"
        )
    if not best.converged:
        notes.append(f"the offset had not converged after {best.iterations} iterations")
    return tuple(notes)

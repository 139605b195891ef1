"""Identification and the offset between the sources as one estimate."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sameas._identify import identify
from sameas.arrays import FloatArray
from sameas.errors import InputError
from sameas.estimate.match import match
from sameas.evidence import Errors, Rule
from sameas.gaussian import propagated
from sameas.prior import EVIDENCE_ALONE, Prior
from sameas.records import Records
from sameas.registration.hough import Votes, vote
from sameas.registration.offsets import Offset
from sameas.registration.solution import Solution, refine
from sameas.registration.tuning import DEFAULT_TUNING, Tuning
from sameas.registration.weights import PlacedSources, records_moved
from sameas.representation import in_short
from sameas.result import Identification


@dataclass(frozen=True)
class Parameter:
    """One parameter of the offset: value and standard error, in ``unit`` ("" stands for the unit of the features)."""

    value: float
    standard_error: float
    unit: str


@in_short
@dataclass(frozen=True)
class Registration:
    """The offset between two sources, and the identification once it is removed.

    Attributes
    ----------
    model : the offset, as placed on the data.
    theta, covariance : (p,) and (p, p), in the order of ``model.names``.
    registered : the second source's records moved onto the first's; their covariances include the offset's uncertainty.
    identification : of ``first`` and ``registered``.
    common : expected number of common objects under the offset.
    log_evidence : ln of the odds of this offset against nothing in common.
    rivals : other offsets that were found, most probable first.
    probability : of this offset among all that were found and nothing in common.
    rounds, settled : steps of the refinement, and whether they converged.
    notes : doubts; empty where there are none.
    tuning : of the search and the verdict.
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
    rounds: int
    settled: bool
    notes: tuple[str, ...]
    tuning: Tuning = DEFAULT_TUNING

    @property
    def established(self) -> bool:
        """Whether this offset, and no other, nor nothing in common, explains the data."""
        return self.probability >= self.tuning.sure and not any(
            _credible(rival, self.log_evidence, self.tuning) for rival in self.rivals
        )

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
    rounds: int = 40,
    tuning: Tuning = DEFAULT_TUNING,
) -> Registration:
    """The offset of the second source from the first, with its covariance, and the identification without it.

    The search covers every offset that brings any pair of records together; the refinement weighs every pair by its
    posterior; the solution with the most evidence is the answer, and others that come near are in the notes.

    Parameters
    ----------
    first, second : records of one feature space. Quoted errors without the offset.
    model : ``Shift()``, ``Similarity()``, ``Affine()`` or ``SensorBias(position)``; the second source is moved.
    errors : how residuals spread about the quoted errors in the identification; None estimates it. The offset itself is
        found with the quoted errors.
    density : (ρ₁, ρ₂) of all records of each source; estimated if not given.
    rule, prior : evidence and belief of the identification, such as ``Field`` and ``CommonObjects(q1, q2)``; if no rule
        is given, everything is estimated as by ``match``.
    rounds : most steps of the last refinement. tuning : chosen numbers of the search and the verdict.

    Raises
    ------
    InputError : a source without usable records, different spaces, a model that does not suit the space.

    Source: METHOD 6; Levedahl 2002 (the offset belongs into the assignment), Louis 1982 (the covariance).

    >>> from sameas.registration import Shift
    >>> rng = np.random.default_rng(1)
    >>> places = rng.uniform(0.0, 60.0, (40, 2))
    >>> radar = Records.of(places + 0.7 * rng.standard_normal((40, 2)), sigma=0.7, source="radar")
    >>> ais = Records.of(places + 0.7 * rng.standard_normal((40, 2)) - [21.0, 4.0], sigma=0.7, source="ais")
    >>> found = register(radar, ais, Shift())
    >>> abs(found.parameters["shift_x"].value - 21.0) < 0.5, found.established, len(found.identification.matches)
    (True, True, 40)
    """
    if first.d != second.d or first.space != second.space:
        raise InputError(
            f"{first.source} has {first.d} features in {first.space}, {second.source} {second.d} in {second.space}; "
            "bring both to one feature space"
        )
    for records in (first, second):
        if not len(records):
            raise InputError(f"{records.source} has no usable records; no offset can be found")
    placed = model.placed(first, second)
    scene = PlacedSources.of(first, second, placed, tuning)
    solutions = refine(scene, _beginnings(first, second, placed, tuning), rounds)
    best = solutions[0]
    registered = _registered(scene, best)
    if rule is None:
        answer, _ = match(first, registered, errors=errors, density=density)
    else:
        answer = identify(first, registered, rule=rule, prior=prior)
    ahead = [one.log_evidence - best.log_evidence for one in solutions[1:]]
    probability = 1.0 / (1.0 + sum(math.exp(x) for x in ahead) + math.exp(min(-best.log_evidence, 700.0)))
    return Registration(
        placed, best.theta, best.covariance, registered, answer, best.common, best.log_evidence, tuple(solutions[1:]),
        probability, best.rounds, best.settled, _notes(scene, solutions), tuning,
    )  # fmt: skip


def _beginnings(first: Records, second: Records, model: Offset, tuning: Tuning) -> Votes:
    """The most voted offsets, and none at all."""
    turning = bool(model.turns())
    few = min(tuning.beginnings, tuning.refined_records * 16 // len(second))
    count = tuning.beginnings if turning else max(few, tuning.fewest_beginnings)
    votes = vote(first, second, model, count, tuning)
    theta = np.concatenate([votes.theta, np.zeros((1, len(model.names)))])
    return Votes(theta, np.append(votes.score, 0.0), np.append(votes.patch, 0), votes.patches)


def _credible(rival: Solution, log_evidence: float, tuning: Tuning) -> bool:
    """Whether a solution comes near the best one, or explains so much that the pattern must repeat.

    Objects scattered at random never fit twice. Where they do, as on a lattice, the assumptions of the evidence do not
    hold, and its differences mean little.
    """
    decisive = tuning.decisive
    return rival.log_evidence > min(log_evidence - decisive, max(tuning.repeating * log_evidence, decisive))


def _registered(scene: PlacedSources, solution: Solution) -> Records:
    """The second source in the first's space: Σ carried along, plus J C Jᵀ for the offset's own uncertainty."""
    features = scene.second.features
    carried = scene.model.carried(features, solution.theta)
    jacobian = scene.model.jacobian(features, solution.theta)
    covariance = propagated(carried, scene.covariance_2) + propagated(jacobian, solution.covariance)
    return records_moved(scene.second, scene.model.moved(features, solution.theta), covariance)


def _notes(scene: PlacedSources, solutions: list[Solution]) -> tuple[str, ...]:
    """Doubts about the best solution."""
    best, names = solutions[0], (scene.first.source, scene.second.source)
    notes = []
    if best.log_evidence < scene.tuning.decisive:
        notes.append(
            f"{names[0]} and {names[1]} may have no object in common: the offset is not significant "
            f"(log evidence {best.log_evidence:.1f})"
        )
    rivals = [one for one in solutions[1:] if _credible(one, best.log_evidence, scene.tuning)]
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
    if most < scene.tuning.small_overlap:
        notes.append(
            f"small overlap: only {100 * fewest:.0f} % to {100 * most:.0f} % of the records lie in the common area"
        )
    if not best.settled:
        notes.append(f"the offset had not converged after {best.rounds} iterations")
    return tuple(notes)

"""Contenders: the decision rules that the study compares, each with the parameters that its user would know.

A contender is called with scenes and the formation they were drawn from, and returns a :class:`Verdict`. All get the
same candidates. The parameters that a rule takes from the formation are in its class: the papers' rule the spacing and
q, the uniform rule the box of the records and q, the constant cost the density and q. ``factor`` makes one wrong.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from operator import attrgetter
from typing import Protocol

import numpy as np

from benchmarks.study.scenes import Formation, Lattice, Scenes
from sameas._identify import identify
from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.decision import most_right
from sameas.evidence import CloseObjects, ConstantCost, Field, Flat, GaussianMixture, Rule, Universal
from sameas.gate import Box, Pairs
from sameas.groups import groups
from sameas.prior import CommonObjects, PerPair, Prior
from sameas.records import Records
from sameas.result import Identification
from sameas.score.baselines import classified, enumerated, most_pairs, mutual_nearest, nearest

Gate = Callable[[Records, Records], Pairs]
#: The papers' gate: each feature within 3σ.
PAPERS_GATE = Box(3.0)
#: The papers' inner box, in σ.
INNER = 1.1


@dataclass(frozen=True)
class Verdict:
    """Pairs that a contender decides to be one object: rows ``i``, ``j`` (k,) of the two sources.

    candidates : rows of all candidates and their probabilities, ((m,), (m,), (m,)); None without probabilities.
    """

    i: IntArray
    j: IntArray
    candidates: tuple[IntArray, IntArray, FloatArray] | None = None


class Contender(Protocol):
    """A decision rule with a name."""

    @property
    def name(self) -> str:
        """Name in the tables."""

    def __call__(self, scenes: Scenes, formation: Formation) -> Verdict:
        """The pairs it decides for."""


# ---- rules and priors with the parameters of a formation ----


@dataclass(frozen=True)
class Close:
    """The papers' rule: a = 1.1 σ, b = 2 · spacing · ``factor``; below a its limit b → a.

    approximation : as of ``CloseObjects``.
    """

    factor: float = 1.0
    approximation: str | None = None

    def __call__(self, scenes: Scenes, formation: Formation) -> Rule:
        b = 2.0 * formation.spacing * self.factor
        return CloseObjects(INNER, b if b > INNER else None, approximation=self.approximation)


@dataclass(frozen=True)
class Uniform:
    """Constant density: 1 over the box around the scene's records, ``margin`` σ wider on each side (METHOD 3.1)."""

    margin: float = 1.0

    def __call__(self, scenes: Scenes, formation: Formation) -> Rule:
        return Field(1.0 / scenes.boxes(self.margin)[scenes.scene[1]])


@dataclass(frozen=True)
class Constant:
    """The frame paper's constant, C² = ρ q₁ q₂ (METHOD 4.3), with the density of the formation; C times ``factor``."""

    factor: float = 1.0

    def __call__(self, scenes: Scenes, formation: Formation) -> Rule:
        return ConstantCost(self.factor * math.sqrt(formation.density * math.prod(formation.q[:2])))


@dataclass(frozen=True)
class KnownFormation:
    """The universal rule, given the displacements between targets (METHOD 3.3); lattices only."""

    def __call__(self, scenes: Scenes, formation: Formation) -> Rule:
        assert isinstance(formation, Lattice)
        means, shares = formation.offsets
        points = np.broadcast_to(1e-6 * np.eye(formation.d), (len(means), formation.d, formation.d))
        return Universal(Flat(formation.density), GaussianMixture(shares, means, points))


@dataclass(frozen=True)
class CountPrior:
    """Prior of the number of common targets for q · ``factor``, at most 0.95."""

    factor: float = 1.0
    linear: bool = False

    def __call__(self, formation: Formation) -> Prior:
        q1, q2 = (min(max(q * self.factor, 1e-4), 0.95) for q in formation.q[:2])
        return CommonObjects(q1, q2, linear=self.linear)


@dataclass(frozen=True)
class NoPrior:
    """No prior: the rule contains the prior odds."""

    def __call__(self, formation: Formation) -> Prior:
        return PerPair(0.0)


# ---- contenders ----


@dataclass(frozen=True)
class Identified:
    """The result of ``identify`` with a rule and a prior, with probabilities.

    decide : the chosen pairs (m,) of the result; default the most probable one-to-one hypothesis.
    """

    name: str
    rule: Callable[[Scenes, Formation], Rule]
    prior: Callable[[Formation], Prior] = field(default_factory=CountPrior)
    gate: Gate = PAPERS_GATE
    decide: Callable[[Identification], BoolArray] = attrgetter("chosen")

    def __call__(self, scenes: Scenes, formation: Formation) -> Verdict:
        answer = identify(*scenes.sources[:2], rule=self.rule(scenes, formation), prior=self.prior(formation),
                          gate=self.gate)  # fmt: skip
        return _verdict(answer.pairs, self.decide(answer), answer.p_pair)


@dataclass(frozen=True)
class Enumerated:
    """The most probable hypothesis by enumeration, for small scenes."""

    name: str
    rule: Callable[[Scenes, Formation], Rule]
    prior: Callable[[Formation], Prior] = field(default_factory=CountPrior)
    gate: Gate = PAPERS_GATE

    def __call__(self, scenes: Scenes, formation: Formation) -> Verdict:
        pairs = self.gate(*scenes.sources[:2])
        grouped = groups(pairs)
        log_prior = self.prior(formation)(grouped.sizes_1, grouped.sizes_2)
        return _verdict(pairs, enumerated(grouped, self.rule(scenes, formation)(pairs).log_ratio, log_prior))


@dataclass(frozen=True)
class ByDistance:
    """A method that uses only the distances of the pairs; ``choose`` returns the mask (m,) of the chosen ones."""

    name: str
    choose: Callable[[Pairs], BoolArray]
    gate: Gate = PAPERS_GATE

    def __call__(self, scenes: Scenes, formation: Formation) -> Verdict:
        pairs = self.gate(*scenes.sources[:2])
        return _verdict(pairs, self.choose(pairs))


def most_pairs_of_groups(pairs: Pairs) -> BoolArray:
    """(m,) mask of the k = min(N₁, N₂) pairs with the least Σ ΔᵀΣ⁻¹Δ in every group [T3]."""
    return most_pairs(pairs, groups(pairs))


@dataclass(frozen=True)
class Independent:
    """The most probable candidate, or none, for each record of source 1 by itself (METHOD 3.5), with the constant C."""

    name: str = "independent Bayes"
    gate: Gate = PAPERS_GATE

    def __call__(self, scenes: Scenes, formation: Formation) -> Verdict:
        pairs = self.gate(*scenes.sources[:2])
        return _verdict(pairs, classified(pairs, Constant()(scenes, formation)(pairs).log_ratio))


def _most_right(answer: Identification) -> BoolArray:
    """The decision with the largest expected number of right records."""
    return most_right(answer).chosen


def _verdict(pairs: Pairs, chosen: BoolArray, p: FloatArray | None = None) -> Verdict:
    i, j = pairs.i.astype(np.int64), pairs.j.astype(np.int64)
    return Verdict(i[chosen], j[chosen], None if p is None else (i, j, p))


def line_up(formation: Formation) -> tuple[Contender, ...]:
    """The contenders of the main comparison that a formation allows; the first is the reference."""
    contenders: list[Contender] = [
        Identified("close objects", Close()),
        Identified("close objects, linear prior", Close(), CountPrior(linear=True)),
        Identified("close objects, most right", Close(), decide=_most_right),
        Identified("uniform", Uniform()),
        Identified("constant C", Constant(), NoPrior()),
        Independent(),
        ByDistance("k = min", most_pairs_of_groups),
        ByDistance("mutual nearest", mutual_nearest),
        ByDistance("nearest", nearest),
    ]
    if isinstance(formation, Lattice) and formation.targets > 1:
        contenders.append(Identified("universal, formation known", KnownFormation()))
    return tuple(contenders)

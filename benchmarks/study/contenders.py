"""Contenders: the decision rules that the study compares, each told what its user would know.

A contender is called with scenes and the formation they were drawn from, and gives a :class:`Verdict`. All get the same
candidates. What a rule is told of the formation is written in it: the papers' rule the spacing and q, the uniform rule
the box of the records and q, the constant cost the density and q. ``factor`` tells it a wrong number on purpose.
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
from sameas.evidence import CloseObjects, ConstantCost, Field, Flat, GaussianMixture, Rule, Universal
from sameas.gate import Box, Pairs
from sameas.groups import groups
from sameas.prior import CommonObjects, PerPair, Prior
from sameas.records import Records
from sameas.result import Identification, most_right
from sameas.score.baselines import classified, enumerated, most_pairs, mutual_nearest, nearest

Gate = Callable[[Records, Records], Pairs]
#: The papers' gate: each feature within 3σ.
PAPERS_GATE = Box(3.0)
#: The papers' inner box, in σ.
INNER = 1.1


@dataclass(frozen=True)
class Verdict:
    """Pairs that a contender takes for one object: rows ``i``, ``j`` (k,) of the two sources.

    candidates : rows of all candidates and their probabilities, ((m,), (m,), (m,)); None where none are stated.
    """

    i: IntArray
    j: IntArray
    candidates: tuple[IntArray, IntArray, FloatArray] | None = None


class Contender(Protocol):
    """A decision rule with a name."""

    @property
    def name(self) -> str:
        """As the tables call it."""

    def __call__(self, scenes: Scenes, formation: Formation) -> Verdict:
        """What it decides."""


# ---- what rules are told ----


@dataclass(frozen=True)
class Close:
    """The papers' rule: a = 1.1 σ, b = 2 · spacing · ``factor``; below a its limit b → a.

    approximation : of the boxes, as ``CloseObjects`` takes it.
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
class Known:
    """The universal rule told where the other targets stand from a target (METHOD 3.3); lattices only."""

    def __call__(self, scenes: Scenes, formation: Formation) -> Rule:
        assert isinstance(formation, Lattice)
        means, shares = formation.offsets
        points = np.broadcast_to(1e-6 * np.eye(formation.d), (len(means), formation.d, formation.d))
        return Universal(Flat(formation.density), GaussianMixture(shares, means, points))


@dataclass(frozen=True)
class Counted:
    """Prior of the number of common targets from q, told q · ``factor`` at most 0.95."""

    factor: float = 1.0
    linear: bool = False

    def __call__(self, formation: Formation) -> Prior:
        q1, q2 = (min(max(q * self.factor, 1e-4), 0.95) for q in formation.q[:2])
        return CommonObjects(q1, q2, linear=self.linear)


@dataclass(frozen=True)
class Nothing:
    """No prior beside what the rule contains."""

    def __call__(self, formation: Formation) -> Prior:
        return PerPair(0.0)


# ---- contenders ----


@dataclass(frozen=True)
class Identified:
    """What ``identify`` says under a rule and a prior, with probabilities.

    decide : the pairs (m,) taken of it; the most probable one-to-one hypothesis unless told otherwise.
    """

    name: str
    rule: Callable[[Scenes, Formation], Rule]
    prior: Callable[[Formation], Prior] = field(default_factory=Counted)
    gate: Gate = PAPERS_GATE
    decide: Callable[[Identification], BoolArray] = attrgetter("chosen")

    def __call__(self, scenes: Scenes, formation: Formation) -> Verdict:
        found = identify(*scenes.sources[:2], rule=self.rule(scenes, formation), prior=self.prior(formation),
                         gate=self.gate)  # fmt: skip
        return _verdict(found.pairs, self.decide(found), found.p_pair)


@dataclass(frozen=True)
class Enumerated:
    """The most probable hypothesis by looking at all of them: the oracle, for small scenes."""

    name: str
    rule: Callable[[Scenes, Formation], Rule]
    prior: Callable[[Formation], Prior] = field(default_factory=Counted)
    gate: Gate = PAPERS_GATE

    def __call__(self, scenes: Scenes, formation: Formation) -> Verdict:
        pairs = self.gate(*scenes.sources[:2])
        grouped = groups(pairs)
        believed = self.prior(formation)(grouped.sizes_1, grouped.sizes_2)
        return _verdict(pairs, enumerated(grouped, self.rule(scenes, formation)(pairs).log_ratio, believed))


@dataclass(frozen=True)
class Measured:
    """A way that looks at the distances of the pairs and at nothing else; ``choose`` gives those it takes, (m,)."""

    name: str
    choose: Callable[[Pairs], BoolArray]
    gate: Gate = PAPERS_GATE

    def __call__(self, scenes: Scenes, formation: Formation) -> Verdict:
        pairs = self.gate(*scenes.sources[:2])
        return _verdict(pairs, self.choose(pairs))


def most_pairs_of_groups(pairs: Pairs) -> BoolArray:
    """(m,) k = min(N₁, N₂) pairs of least Σ ΔᵀΣ⁻¹Δ in every group [T3]."""
    return most_pairs(pairs, groups(pairs))


@dataclass(frozen=True)
class Independent:
    """Each record of source 1 for itself to the most probable candidate or nobody (METHOD 3.5), by the constant C."""

    name: str = "independent Bayes"
    gate: Gate = PAPERS_GATE

    def __call__(self, scenes: Scenes, formation: Formation) -> Verdict:
        pairs = self.gate(*scenes.sources[:2])
        return _verdict(pairs, classified(pairs, Constant()(scenes, formation)(pairs).log_ratio))


def _most_right(found: Identification) -> BoolArray:
    """The decision with most records expected to be right."""
    return most_right(found).chosen


def _verdict(pairs: Pairs, chosen: BoolArray, p: FloatArray | None = None) -> Verdict:
    i, j = pairs.i.astype(np.int64), pairs.j.astype(np.int64)
    return Verdict(i[chosen], j[chosen], None if p is None else (i, j, p))


def line_up(formation: Formation) -> tuple[Contender, ...]:
    """The contenders of the main comparison that a formation allows, ours first."""
    chosen: list[Contender] = [
        Identified("close objects", Close()),
        Identified("close objects, linear prior", Close(), Counted(linear=True)),
        Identified("close objects, most right", Close(), decide=_most_right),
        Identified("uniform", Uniform()),
        Identified("constant C", Constant(), Nothing()),
        Independent(),
        Measured("k = min", most_pairs_of_groups),
        Measured("mutual nearest", mutual_nearest),
        Measured("nearest", nearest),
    ]
    if isinstance(formation, Lattice) and formation.targets > 1:
        chosen.append(Identified("universal, formation known", Known()))
    return tuple(chosen)

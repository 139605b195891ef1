"""Priors: the exact prior of the number of common objects compared with the papers' straight line, group by group.

Groups are those of scenes of random formations. The most probable hypothesis of each group under either prior is found,
and both are evaluated under the exact prior (METHOD 4.2).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from benchmarks.study.contenders import PAPERS_GATE, Close, Verdict
from benchmarks.study.scenes import Lattice, Scenes
from benchmarks.study.tally import rightly
from benchmarks.study.trial import generator
from sameas._identify import identify
from sameas.arrays import FloatArray
from sameas.groups import Groups
from sameas.prior import CommonObjects, LogPrior
from sameas.result import Identification

#: Scenes of one random formation.
SCENES = 10


@dataclass(frozen=True)
class Priors:
    """Decisions under the two priors on the same groups (g,).

    differ : whether the decisions differ. loss : ln of the ratio of their probabilities under the exact prior, exact
    over linear decision. right_exact, right_linear : share of all records that are right.
    """

    differ: np.ndarray
    loss: FloatArray
    right_exact: float
    right_linear: float

    def __len__(self) -> int:
        return len(self.differ)


def compared(groups: int) -> Priors:
    """The two priors compared on ``groups`` groups of at least two candidates."""
    rng = generator("priors", 0)
    differ: list[np.ndarray] = []
    loss: list[FloatArray] = []
    right, records = np.zeros(2), 0
    while sum(len(part) for part in differ) < groups:
        q = (float(rng.uniform(0.02, 0.6)), float(rng.uniform(0.02, 0.6)))
        formation = Lattice((int(rng.integers(2, 8)), 1), float(rng.uniform(0.5, 4.0)), q)
        scenes = formation(rng, SCENES)
        rule = Close()(scenes, formation)
        exact, linear = (
            identify(*scenes.sources, rule=rule, prior=CommonObjects(q[0], q[1], linear=line), gate=PAPERS_GATE)
            for line in (False, True)
        )
        ambiguous = exact.groups.pair_counts >= 2
        changed = exact.best.chosen != linear.best.chosen
        differ.append((np.bincount(exact.groups.group, changed, len(exact.groups)) > 0)[ambiguous])
        weight = exact.evidence.log_ratio[exact.groups.order]
        totals = [log_posterior(exact.groups, weight, a.best.chosen, exact.best.prior) for a in (exact, linear)]
        loss.append((totals[0] - totals[1])[ambiguous])
        right += [_right(scenes, answer) for answer in (exact, linear)]
        records += int(scenes.sizes.sum())
    return Priors(np.concatenate(differ)[:groups], np.concatenate(loss)[:groups], *(right / records))


def log_posterior(groups: Groups, log_ratio: FloatArray, chosen: np.ndarray, prior: LogPrior) -> FloatArray:
    """(g,) ln P(k) + Σ ln λ of a hypothesis of every group, in the layout of the groups (METHOD 4.2)."""
    total = np.bincount(groups.group, np.where(chosen, log_ratio, 0.0), len(groups))
    k = np.bincount(groups.group, chosen, len(groups)).astype(np.int64)
    return total + prior.table[prior.start[:-1] + k]


def _right(scenes: Scenes, answer: Identification) -> float:
    """Number of records that are right."""
    pairs = answer.pairs
    verdict = Verdict(pairs.i[answer.chosen].astype(np.int64), pairs.j[answer.chosen].astype(np.int64))
    return float(rightly(scenes, verdict).sum())

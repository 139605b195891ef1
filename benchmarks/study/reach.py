"""Reach: close objects with b estimated from each scene's own records, as by a user who does not know it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from benchmarks.study.contenders import INNER, PAPERS_GATE, CountPrior, Gate, Verdict
from benchmarks.study.scenes import Formation, Scenes
from sameas._identify import identify
from sameas.evidence import CloseObjects
from sameas.evidence.close import MIN_SIGMAS, estimate_reach
from sameas.prior import Prior


@dataclass(frozen=True)
class EstimatedReach:
    """``CloseObjects`` with the boxes of :func:`sameas.evidence.close.estimate_reach`, scene by scene.

    If no source has two records, b cannot be measured; the smallest value that the estimate can have is used.
    """

    name: str = "b estimated"
    prior: Callable[[Formation], Prior] = field(default_factory=CountPrior)
    gate: Gate = PAPERS_GATE

    def __call__(self, scenes: Scenes, formation: Formation) -> Verdict:
        prior = self.prior(formation)
        columns: list[list[np.ndarray]] = [[], [], [], [], []]
        for scene in np.flatnonzero(scenes.open):
            rows, (first, second) = scenes.one(int(scene))
            measurable = max(len(first), len(second)) >= 2
            b = tuple(estimate_reach(first, second).b) if measurable else MIN_SIGMAS
            answer = identify(first, second, rule=CloseObjects(INNER, b), prior=prior, gate=self.gate)
            i, j = rows[0][answer.pairs.i], rows[1][answer.pairs.j]
            parts = i[answer.chosen], j[answer.chosen], i, j, answer.p_pair
            for column, part in zip(columns, parts, strict=True):
                column.append(part)
        one, two, all_1, all_2 = (np.concatenate(part or [np.empty(0)]).astype(np.int64) for part in columns[:4])
        return Verdict(one, two, (all_1, all_2, np.concatenate(columns[4] or [np.empty(0)])))

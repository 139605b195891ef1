"""Stone Soup's one-to-one associator on the same scenes (Stone Soup, Dstl, MIT licence; ``sameas[stonesoup]``).

Every record is a track of one state, all at one time. Stone Soup's Mahalanobis measure uses the covariance of its first
argument only, here source 1; the threshold is chosen so that it is the circle of 3σ of the residuals.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from importlib.util import find_spec

import numpy as np

from benchmarks.study.contenders import Verdict
from benchmarks.study.scenes import Formation, Scenes
from sameas.errors import InputError
from sameas.records import Records

INSTALL = "Stone Soup is missing: pip install 'sameas[stonesoup]'"


def is_installed() -> bool:
    """Whether Stone Soup can be imported."""
    return find_spec("stonesoup") is not None


@dataclass(frozen=True)
class StoneSoup:
    """``OneToOneTrackAssociator`` with a threshold of ``sigmas`` σ, scene by scene."""

    name: str = "Stone Soup 1–1"
    sigmas: float = 3.0

    def __call__(self, scenes: Scenes, formation: Formation) -> Verdict:
        if not is_installed():
            raise InputError(INSTALL)
        from stonesoup.dataassociator.tracktotrack import OneToOneTrackAssociator
        from stonesoup.measures import Mahalanobis
        from stonesoup.measures.multi import MeanMeasure, StateSequenceMeasure

        threshold = self.sigmas * math.hypot(*formation.sigma[:2]) / formation.sigma[0]
        measure = MeanMeasure(StateSequenceMeasure(Mahalanobis()))
        associator = OneToOneTrackAssociator(measure=measure, association_threshold=threshold)
        first, second = (_tracks(records) for records in scenes.sources[:2])
        rows: list[tuple[int, int]] = []
        for one, two in zip(*(_by_scene(k, len(scenes)) for k in scenes.scene[:2]), strict=True):
            if not (len(one) and len(two)):
                continue
            row = {id(first[k]): (0, int(k)) for k in one} | {id(second[k]): (1, int(k)) for k in two}
            associated = associator.associate_tracks({first[k] for k in one}, {second[k] for k in two})
            for association in associated.associations:
                (_, i), (_, j) = sorted(row[id(track)] for track in association.objects)
                rows.append((i, j))
        pairs = np.array(sorted(rows), np.int64).reshape(-1, 2)
        return Verdict(pairs[:, 0], pairs[:, 1])


def _tracks(records: Records) -> list:
    from datetime import datetime

    from stonesoup.types.state import GaussianState
    from stonesoup.types.track import Track

    now = datetime(2026, 1, 1)
    places, covariances = records.features, records.full_covariance()
    return [Track([GaussianState(x[:, None], p, now)]) for x, p in zip(places, covariances, strict=True)]


def _by_scene(scene: np.ndarray, count: int) -> list[np.ndarray]:
    """Rows of every scene."""
    order = np.argsort(scene, kind="stable")
    return np.split(order, np.searchsorted(scene[order], np.arange(1, count)))

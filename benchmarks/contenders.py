"""Other methods to identify the records of an instant, for comparison in ``picture``.

Each method matches source after source with the existing objects; an object has the position of its first record. The
methods get the states of `sameas`, moved to one time. Unmatched records start objects.
"""

from __future__ import annotations

from collections.abc import Callable
from datetime import datetime
from importlib.util import find_spec

import numpy as np
from scipy.spatial import cKDTree

from sameas.gate import ChiSquare
from sameas.groups import groups
from sameas.many.observations import records_of
from sameas.records import Records
from sameas.score.baselines import most_pairs, nearest
from sameas.tracks.scene import Instant

#: Three sigma in the plane.
THREE_SIGMA = ChiSquare(float(1.0 - np.exp(-4.5)))
#: COMPASS: maximum acceptable distance of target reports.
COMPASS_M = 1852.0

Pairing = Callable[[Records, Records, np.ndarray], tuple[np.ndarray, np.ndarray]]


def methods() -> dict[str, Callable[[Instant], list[np.ndarray]]]:
    """The methods by name; that of Stone Soup if it is installed."""
    pairings: dict[str, Pairing] = {"nearest": nearest_one, "k = min": most, "1852 m": compass, "50 m + 4 %": radar_pi}
    if find_spec("stonesoup") is not None:
        pairings["Stone Soup"] = stone_soup
    return {name: _source_by_source(pairing) for name, pairing in pairings.items()}


def _source_by_source(pairing: Pairing) -> Callable[[Instant], list[np.ndarray]]:
    def method(now: Instant) -> list[np.ndarray]:
        positions, covariances = np.empty((0, 2)), np.empty((0, 2, 2))
        numbers = []
        for feed, source in zip(now.feeds, now.sources, strict=True):
            new = records_of(source)
            number = np.full(len(new), -1)
            sensor = feed.sensor_at(now.instant_s)
            range_m = np.hypot(*(new.features - (0.0 if sensor is None else sensor)).T)
            if len(positions) and len(new):
                objects = Records.of(positions, covariance=covariances, source="objects")
                i, j = pairing(objects, new, range_m)
                number[j] = i
            unmatched = np.flatnonzero(number < 0)
            number[unmatched] = len(positions) + np.arange(len(unmatched))
            positions = np.concatenate([positions, new.features[unmatched]])
            covariances = np.concatenate([covariances, new.full_covariance()[unmatched]])
            numbers.append(number)
        return numbers

    return method


def nearest_one(objects: Records, new: Records, range_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Every new record to the object nearest in Mahalanobis distance, within 3σ."""
    pairs = THREE_SIGMA(objects, new)
    chosen = nearest(pairs, source=2)
    return pairs.i[chosen], pairs.j[chosen]


def most(objects: Records, new: Records, range_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The largest number of pairs within 3σ, with the least sum of squares."""
    pairs = THREE_SIGMA(objects, new)
    chosen = most_pairs(pairs, groups(pairs))
    return pairs.i[chosen], pairs.j[chosen]


def compass(objects: Records, new: Records, range_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Every new record to the nearest object within 1852 m, record by record, as COMPASS does without identities."""
    return _within(objects, new, np.full(len(new), COMPASS_M))


def radar_pi(objects: Records, new: Records, range_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Every new record to the nearest object within 50 m and 4 % of the range, as OpenCPN's radar_pi."""
    return _within(objects, new, 50.0 + 0.04 * range_m)


def _within(objects: Records, new: Records, reach_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    distance, at = cKDTree(objects.features).query(new.features)
    near = np.flatnonzero(distance <= reach_m)
    return at[near], near


def stone_soup(objects: Records, new: Records, range_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Stone Soup's OneToOneTrackAssociator, every state a track of one time, threshold three sigma.

    Its Mahalanobis measure uses the covariance of the first side only: new records are first, each with the median
    covariance of the objects added to its own.
    """
    from stonesoup.dataassociator.tracktotrack import OneToOneTrackAssociator
    from stonesoup.measures import Mahalanobis
    from stonesoup.measures.multi import MeanMeasure, StateSequenceMeasure
    from stonesoup.types.state import GaussianState
    from stonesoup.types.track import Track

    when = datetime(2026, 1, 1)
    measure = MeanMeasure(StateSequenceMeasure(Mahalanobis()))
    associator = OneToOneTrackAssociator(measure=measure, association_threshold=3.0)
    other = np.median(objects.full_covariance(), axis=0)
    sides = [
        [Track([GaussianState(x[:, None], p, when)]) for x, p in zip(records.features, covariances, strict=True)]
        for records, covariances in ((new, new.full_covariance() + other), (objects, objects.full_covariance()))
    ]
    place = {id(track): (side, k) for side, tracks in enumerate(sides) for k, track in enumerate(tracks)}
    rows = []
    for association in associator.associate_tracks(set(sides[0]), set(sides[1])).associations:
        (_, j), (_, i) = sorted(place[id(track)] for track in association.objects)
        rows.append((i, j))
    pairs = np.array(rows, np.int64).reshape(-1, 2)
    return pairs[:, 0], pairs[:, 1]

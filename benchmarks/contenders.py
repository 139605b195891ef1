"""Other ways to identify the records of an instant, as others do it, beside ours in ``picture``.

All take source after source against the objects so far, an object standing where its first record is, and get our
states, moved to one time. Each way pairs the objects with the records of the next source; what is not paired begins an
object.
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


def ways() -> dict[str, Callable[[Instant], list[np.ndarray]]]:
    """By name; Stone Soup's only where it is installed."""
    pairings: dict[str, Pairing] = {"nearest": nearest_one, "k = min": most, "1852 m": compass, "50 m + 4 %": radar_pi}
    if find_spec("stonesoup") is not None:
        pairings["Stone Soup"] = stone_soup
    return {name: _in_turn(pairing) for name, pairing in pairings.items()}


def _in_turn(pairing: Pairing) -> Callable[[Instant], list[np.ndarray]]:
    def way(now: Instant) -> list[np.ndarray]:
        places, spreads = np.empty((0, 2)), np.empty((0, 2, 2))
        numbers = []
        for feed, source in zip(now.feeds, now.sources, strict=True):
            new = records_of(source)
            number = np.full(len(new), -1)
            sensor = feed.sensor_at(now.instant_s)
            away = np.hypot(*(new.features - (0.0 if sensor is None else sensor)).T)
            if len(places) and len(new):
                known = Records.of(places, covariance=spreads, source="objects")
                i, j = pairing(known, new, away)
                number[j] = i
            alone = np.flatnonzero(number < 0)
            number[alone] = len(places) + np.arange(len(alone))
            places = np.concatenate([places, new.features[alone]])
            spreads = np.concatenate([spreads, new.full_covariance()[alone]])
            numbers.append(number)
        return numbers

    return way


def nearest_one(known: Records, new: Records, away_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Every new record to the object that is nearest in the metric of both errors, within three sigma."""
    pairs = THREE_SIGMA(known, new)
    chosen = nearest(pairs, source=2)
    return pairs.i[chosen], pairs.j[chosen]


def most(known: Records, new: Records, away_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """As many pairs as can be within three sigma, with the least sum of squares."""
    pairs = THREE_SIGMA(known, new)
    chosen = most_pairs(pairs, groups(pairs))
    return pairs.i[chosen], pairs.j[chosen]


def compass(known: Records, new: Records, away_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Every new record to the nearest object within 1852 m, record by record, as COMPASS does without identities."""
    return _within(known, new, np.full(len(new), COMPASS_M))


def radar_pi(known: Records, new: Records, away_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Every new record to the nearest object within 50 m and 4 % of the range, as OpenCPN's radar_pi."""
    return _within(known, new, 50.0 + 0.04 * away_m)


def _within(known: Records, new: Records, reach_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    distance, at = cKDTree(known.features).query(new.features)
    near = np.flatnonzero(distance <= reach_m)
    return at[near], near


def stone_soup(known: Records, new: Records, away_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Stone Soup's OneToOneTrackAssociator, every state a track of one time, threshold three sigma.

    Its Mahalanobis measure takes the covariance of the first side alone: new records stand first, and to be fair each
    is given the median covariance of the objects beside its own.
    """
    from stonesoup.dataassociator.tracktotrack import OneToOneTrackAssociator
    from stonesoup.measures import Mahalanobis
    from stonesoup.measures.multi import MeanMeasure, StateSequenceMeasure
    from stonesoup.types.state import GaussianState
    from stonesoup.types.track import Track

    when = datetime(2026, 1, 1)
    measure = MeanMeasure(StateSequenceMeasure(Mahalanobis()))
    associator = OneToOneTrackAssociator(measure=measure, association_threshold=3.0)
    other = np.median(known.full_covariance(), axis=0)
    sides = [
        [Track([GaussianState(x[:, None], p, when)]) for x, p in zip(records.features, covariances, strict=True)]
        for records, covariances in ((new, new.full_covariance() + other), (known, known.full_covariance()))
    ]
    place = {id(track): (side, k) for side, tracks in enumerate(sides) for k, track in enumerate(tracks)}
    rows = []
    for association in associator.associate_tracks(set(sides[0]), set(sides[1])).associations:
        (_, j), (_, i) = sorted(place[id(track)] for track in association.objects)
        rows.append((i, j))
    found = np.array(rows, np.int64).reshape(-1, 2)
    return found[:, 0], found[:, 1]

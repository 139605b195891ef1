"""Continuity: the evidence that an object of an instant is an object of the picture.

It compares the object's position with the prediction, the velocities, and the tracks that both have. Where a track
breaks and continues under another id, they have none in common, and two that cross unseen are told apart by their
velocities. A unique id (an MMSI, an ICAO address) weighs more and counts at any distance: a ferry that brakes harder
than vessels should is still that ferry. A radar's track numbers are reused, so they do not.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.evidence import Evidence, Field, Rule
from sameas.gate import Pairs
from sameas.gaussian import Gaussian, log_density, mahalanobis_sq
from sameas.picture.tuning import DEFAULT_TUNING, GATE, Tuning
from sameas.records import Records


@dataclass(frozen=True)
class CommonTracks:
    """Objects of the picture and of the instant that have a track in common, (k,) each, by ascending key.

    object_place, detection_place : places of both. weight : ln r. unique : how many of the tracks have a unique id.
    """

    object_place: IntArray
    detection_place: IntArray
    weight: FloatArray
    unique: FloatArray

    @classmethod
    def of(
        cls,
        object_place: IntArray,
        detection_place: IntArray,
        share: FloatArray,
        unique: BoolArray,
        tuning: Tuning = DEFAULT_TUNING,
    ) -> CommonTracks:
        """Of tracks in common (m,): a track that was the object's for a share s of the last minutes gives ln(1 + s/ε).

        share : s. unique : whether the track's id is unique. ε is ``id_reassigned``.
        """
        key, back = np.unique((object_place << 32) | detection_place, return_inverse=True)
        of_track = np.log1p(share / tuning.id_reassigned) + math.log(tuning.unique_id_odds) * unique
        weight = np.bincount(back, of_track, len(key)).astype(np.float64)
        n_unique = np.bincount(back, unique, len(key)).astype(np.float64)
        return cls(key >> 32, key & 0xFFFFFFFF, weight, n_unique)

    def of_pairs(self, pairs: Pairs) -> tuple[FloatArray, FloatArray]:
        """(m,) weight of each pair and (m,) its unique names; 0 where it has nothing in common."""
        key = (self.object_place << 32) | self.detection_place
        pair_key = (pairs.first.rows[pairs.i].astype(np.int64) << 32) | pairs.second.rows[pairs.j]
        at = np.minimum(np.searchsorted(key, pair_key), max(len(key) - 1, 0))
        same = np.append(key, -1)[at] == pair_key
        weight, unique = (np.append(column, 0.0)[at] for column in (self.weight, self.unique))
        return np.where(same, weight, 0.0), np.where(same, unique, 0.0)


@dataclass(frozen=True)
class Motions:
    """States of objects (n, 4) with their covariances (n, 4, 4), and (n,) how fast such objects go, 1σ per axis."""

    state: FloatArray
    covariance: FloatArray
    speed_m_per_s: FloatArray


@dataclass(frozen=True)
class Continuity(Rule):
    """ln r of an object of the picture and one of the instant: by their positions, among objects of ``per_m2``, by
    their tracks, and, where they have no track in common, by their velocities."""

    per_m2: float
    common: CommonTracks
    objects: Motions
    detections: Motions
    tuning: Tuning = DEFAULT_TUNING

    def __call__(self, pairs: Pairs) -> Evidence:
        place = Field(self.tuning.new_share * self.per_m2)(pairs).log_ratio
        weight, unique = self.common.of_pairs(pairs)
        place = np.where(unique > 0.0, np.maximum(place, math.log(self.tuning.id_reassigned)), place)
        velocity = np.zeros(len(pairs))
        unrelated = np.flatnonzero(weight == 0.0)
        velocity[unrelated] = self._velocities(
            pairs.first.rows[pairs.i[unrelated]], pairs.second.rows[pairs.j[unrelated]]
        )
        return Evidence({"place": place, "velocity": velocity, "tracks in common": weight})

    def _velocities(self, i: IntArray, j: IntArray) -> FloatArray:
        """(m,) ln of how probable the velocity of j is as that of i, given both places, against that of any object."""
        residual = self.objects.state[i] - self.detections.state[j]
        total = self.objects.covariance[i] + self.detections.covariance[j]
        velocity = Gaussian(residual[:, 2:], total[:, 2:, 2:])
        rest = velocity.conditional(total[:, 2:, :2], -residual[:, :2], total[:, :2, :2])
        same = log_density(rest.mean, rest.covariance)
        any_ = self.detections.covariance[j, 2:, 2:] + self.detections.speed_m_per_s[j, None, None] ** 2 * np.eye(2)
        return np.asarray(same - log_density(self.detections.state[j, 2:], any_))


@dataclass(frozen=True)
class NearOrNamed:
    """A gate: pairs that are near, and pairs at any distance that have a unique id in common."""

    common: CommonTracks

    def __call__(self, first: Records, second: Records) -> Pairs:
        near = GATE(first, second)
        named = self.common.unique > 0.0
        by_id = (self.common.object_place[named] << 32) | self.common.detection_place[named]
        key = np.unique(np.concatenate([(near.i.astype(np.int64) << 32) | near.j, by_id]))
        i, j = (key >> 32).astype(np.int32), (key & 0xFFFFFFFF).astype(np.int32)
        residual = first.features[i] - second.features[j]
        total = first.full_covariance()[i] + second.full_covariance()[j]
        chi_sq = mahalanobis_sq(residual, total)
        return Pairs(first, second, i, j, i, j, residual, chi_sq, np.linalg.det(total), f"{near.gate}, or one name")

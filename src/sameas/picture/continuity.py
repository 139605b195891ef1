"""Continuity: the evidence that an object of the picture is one of the instant, and the gate of such pairs.

The evidence compares the position with the prediction, the velocities, and the tracks of both objects. If a track
breaks and continues under another id, there is no common track; then velocities separate two objects that cross
undetected. A unique id (MMSI, ICAO address) has a higher weight and counts at any distance: a ferry that brakes harder
than its motion model allows is still that ferry. A radar's track numbers are reused, so they are not unique, and count
as far as a manoeuvre reaches: an aircraft in a holding turns by 20° from one instant to the next.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sameas.arrays import BoolArray, FloatArray, IntArray, distinct, taken
from sameas.evidence import Evidence, Field, Rule
from sameas.gate import Pairs
from sameas.gaussian import Gaussian, determinant, log_density, mahalanobis_sq
from sameas.kernels.tracks import places_of
from sameas.picture.tuning import GATE
from sameas.records import Records
from sameas.tracks.alignment import MANOEUVRE_NOISE

ID_REASSIGNED = 1e-3  # probability that a report of a track is of another object, when objects are matched over time
UNIQUE_ID_ODDS = 1e7  # factor on the odds of a match whose tracks share a unique id
NEW_SHARE = 0.05  # share of the objects of an instant that may be new
MANOEUVRING = 0.1  # share of the time in which an object manoeuvres, as near an airport


@dataclass(frozen=True)
class CommonTracks:
    """Pairs of an object of the picture and one of the instant with a common track, (k,) each, in ascending order.

    object_place, detection_place : rows of both. weight : ln r. unique : number of common tracks with a unique id.
    """

    object_place: IntArray
    detection_place: IntArray
    weight: FloatArray
    unique: FloatArray

    @classmethod
    def of(
        cls, object_place: IntArray, detection_place: IntArray, share: FloatArray, unique: BoolArray
    ) -> CommonTracks:
        """Of common tracks (m,): each adds ln(1 + s/ε), ε ``ID_REASSIGNED``.

        share : s, the track's share in the object over the last minutes. unique : whether the track's id is unique.
        """
        key, pair = np.unique((object_place << 32) | detection_place, return_inverse=True)
        log_ratio = np.log1p(share / ID_REASSIGNED) + math.log(UNIQUE_ID_ODDS) * unique
        weight = np.bincount(pair, log_ratio, len(key)).astype(np.float64)
        n_unique = np.bincount(pair, unique, len(key)).astype(np.float64)
        return cls(key >> 32, key & 0xFFFFFFFF, weight, n_unique)

    def of_pairs(self, pairs: Pairs) -> tuple[FloatArray, FloatArray]:
        """(m,) weight of each pair and (m,) its number of common unique ids; 0 without a common track."""
        key = (self.object_place << 32) | self.detection_place
        pair_key = (pairs.first.rows[pairs.i].astype(np.int64) << 32) | pairs.second.rows[pairs.j]
        at = places_of(key, pair_key)
        return np.append(self.weight, 0.0)[at], np.append(self.unique, 0.0)[at]


@dataclass(frozen=True)
class Motions:
    """States (n, 4) of objects, covariances (n, 4, 4), and (n,) the 1σ per axis of velocities of such objects."""

    state: FloatArray
    covariance: FloatArray
    speed_m_per_s: FloatArray


def manoeuvre_m2(walk_m2_per_s3: FloatArray, elapsed_s: float) -> FloatArray:
    """(n,) by which a manoeuvre adds to the variance of a position predicted over a time, per axis.

    walk_m2_per_s3 : (n,) motion noise, which is ``MANOEUVRE_NOISE`` times as large in a manoeuvre.
    """
    return (MANOEUVRE_NOISE - 1.0) * walk_m2_per_s3 * elapsed_s**3 / 3.0


@dataclass(frozen=True)
class PlotContinuity:
    """What objects of the instant that only plots without names show add to :class:`Continuity`.

    clutter_per_m2 : (n,) about each of these, 0 for the others. is_new : (n,) whether its plot is a new one of clutter.
    log_odds : (k,) that a look since the previous instant shows each object of the picture, if that is real.
    """

    clutter_per_m2: FloatArray
    is_new: BoolArray
    log_odds: FloatArray

    def __call__(self, pairs: Pairs) -> FloatArray:
        """(m,) what the pairs gain: an object that hardly exists, or is hardly detected, rarely has a plot."""
        i, j = pairs.first.rows[pairs.i], pairs.second.rows[pairs.j]
        return np.where(self.is_new[j], self.log_odds[i], 0.0)


@dataclass(frozen=True)
class Continuity(Rule):
    """ln r of an object of the picture and one of the instant: by positions, at ``per_m2`` objects per m² and the
    clutter of plots, by tracks, and without a common track by velocities, which plots do not have.

    manoeuvre_m2 : (k,) of the objects, see :func:`manoeuvre_m2`.
    """

    per_m2: float
    common: CommonTracks
    manoeuvre_m2: FloatArray
    objects: Motions
    detections: Motions
    has_velocity: BoolArray
    plots: PlotContinuity

    def __call__(self, pairs: Pairs) -> Evidence:
        elsewhere = NEW_SHARE * self.per_m2 + self.plots.clutter_per_m2
        place = Field(elsewhere)(pairs).log_ratio + self.plots(pairs)
        weight, unique = self.common.of_pairs(pairs)
        related = np.flatnonzero(weight > 0.0)
        place[related] += self._manoeuvre(pairs, related)
        place = np.where(unique > 0.0, np.maximum(place, math.log(ID_REASSIGNED)), place)
        velocity = np.zeros(len(pairs))
        unrelated = np.flatnonzero((weight == 0.0) & self.has_velocity[pairs.second.rows[pairs.j]])
        velocity[unrelated] = self._velocities(
            pairs.first.rows[pairs.i[unrelated]], pairs.second.rows[pairs.j[unrelated]]
        )
        return Evidence({"place": place, "velocity": velocity, "tracks in common": weight})

    def _manoeuvre(self, pairs: Pairs, some: IntArray) -> FloatArray:
        """(m,) what the densities of the positions of some pairs (m,) gain if the object may have manoeuvred."""
        residual, total = pairs.residual[some], pairs.covariance_of(some)
        wide = total + self.manoeuvre_m2[pairs.first.rows[pairs.i[some]], None, None] * np.eye(2)
        gain = log_density(residual, wide) - log_density(residual, total)
        return np.logaddexp(math.log1p(-MANOEUVRING), math.log(MANOEUVRING) + gain)

    def _velocities(self, i: IntArray, j: IntArray) -> FloatArray:
        """(m,) ln of the density of j's velocity as that of i, given both positions, relative to that of any object."""
        residual = taken(self.objects.state, i) - taken(self.detections.state, j)
        total = taken(self.objects.covariance, i) + taken(self.detections.covariance, j)
        velocity = Gaussian(residual[:, 2:], total[:, 2:, 2:])
        rest = velocity.conditional(total[:, 2:, :2], -residual[:, :2], total[:, :2, :2])
        same = log_density(rest.mean, rest.covariance)
        any_ = self.detections.covariance[j, 2:, 2:] + self.detections.speed_m_per_s[j, None, None] ** 2 * np.eye(2)
        return np.asarray(same - log_density(self.detections.state[j, 2:], any_))


@dataclass(frozen=True)
class NearOrSameId:
    """A gate: near pairs, pairs with a common track that are near after a manoeuvre, and pairs at any distance with a
    common unique id. manoeuvre_m2 : (k,) of the objects, see :func:`manoeuvre_m2`."""

    common: CommonTracks
    manoeuvre_m2: FloatArray

    def __call__(self, first: Records, second: Records) -> Pairs:
        near = GATE(first, second)
        reached = (self.common.unique > 0.0) | self._within_manoeuvres(first, second)
        by_track = (self.common.object_place[reached] << 32) | self.common.detection_place[reached]
        key = distinct(np.concatenate([(near.i.astype(np.int64) << 32) | near.j, by_track]))
        if len(key) == len(near):
            return near
        i, j = (key >> 32).astype(np.int32), (key & 0xFFFFFFFF).astype(np.int32)
        residual = taken(first.features, i) - taken(second.features, j)
        total = taken(first.full_covariance(), i) + taken(second.full_covariance(), j)
        chi_sq = mahalanobis_sq(residual, total)
        return Pairs(
            first=first, second=second, place_1=i, place_2=j, i=i, j=j, residual=residual, mahalanobis_sq=chi_sq,
            determinant=determinant(total), gate=f"{near.gate}, or one name",
        )  # fmt: skip

    def _within_manoeuvres(self, first: Records, second: Records) -> BoolArray:
        """Of the pairs with a common track, those that are near if the object has manoeuvred."""
        i, j = self.common.object_place, self.common.detection_place
        residual = taken(first.features, i) - taken(second.features, j)
        total = taken(first.full_covariance(), i) + taken(second.full_covariance(), j)
        wide = total + self.manoeuvre_m2[i, None, None] * np.eye(2)
        return np.asarray(mahalanobis_sq(residual, wide) <= GATE.limit(2))

"""Continuity: what says that an object of an instant is one that the picture knows already.

Where the known one should be now and how fast it goes, and the names of the tracks that both have. A track that breaks
and goes on under another name shares none with the object that it was of, and two that cross while nobody sees them are
told apart by their velocities. A track's name that nobody else bears (an
MMSI, an address) carries more, and is heard however far away: a ferry that brakes harder than vessels should is still
that ferry. For a radar's number that is not so: numbers are given again.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.evidence import Evidence, Field, Rule
from sameas.gate import ChiSquare, Pairs
from sameas.gaussian import Gaussian, log_density, mahalanobis_sq
from sameas.records import Records

#: A look of a track that is another object's: one in a thousand. So a track that has been a known object's for a share
#: s of the last minutes says ln(1 + s/ε).
REASSIGNED = 1e-3
#: What a name adds that nobody else bears, so that the number goes where the name goes.
UNIQUE = math.log(1e7)
#: Share of the objects of an instant that may be new (chosen).
APPEARING = 0.05


@dataclass(frozen=True)
class InCommon:
    """Known objects and objects of the instant that have a track in common, (k,) each, by ascending key.

    known, seen : places of both. weight : ln r. unique : whether one of the tracks bears a name that nobody else does.
    """

    known: IntArray
    seen: IntArray
    weight: FloatArray
    unique: FloatArray

    @classmethod
    def of(cls, known: IntArray, seen: IntArray, share: FloatArray, unique: BoolArray) -> InCommon:
        """Of each track in common (m,): whose it was and for what share of the last minutes, whose it is, and whether
        its name is unique."""
        key, back = np.unique((known << 32) | seen, return_inverse=True)
        weight = np.bincount(back, np.log1p(share / REASSIGNED) + UNIQUE * unique, len(key)).astype(np.float64)
        alike = np.bincount(back, unique, len(key)).astype(np.float64)
        return cls(key >> 32, key & 0xFFFFFFFF, weight, alike)

    def of_pairs(self, pairs: Pairs) -> tuple[FloatArray, FloatArray]:
        """(m,) weight of each pair and (m,) its unique names; 0 where it has nothing in common."""
        mine = (self.known << 32) | self.seen
        wanted = (pairs.first.rows[pairs.i].astype(np.int64) << 32) | pairs.second.rows[pairs.j]
        at = np.minimum(np.searchsorted(mine, wanted), max(len(mine) - 1, 0))
        same = np.append(mine, -1)[at] == wanted
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
    """ln r of a known object and one of the instant: by their places, among objects of ``per_m2``, by their tracks,
    and, where they have none of these in common, by their velocities."""

    per_m2: float
    in_common: InCommon
    known: Motions
    seen: Motions

    def __call__(self, pairs: Pairs) -> Evidence:
        place = Field(APPEARING * self.per_m2)(pairs).log_ratio
        weight, unique = self.in_common.of_pairs(pairs)
        place = np.where(unique > 0.0, np.maximum(place, math.log(REASSIGNED)), place)
        velocity = np.zeros(len(pairs))
        strange = np.flatnonzero(weight == 0.0)
        velocity[strange] = self._velocities(pairs.first.rows[pairs.i[strange]], pairs.second.rows[pairs.j[strange]])
        return Evidence({"place": place, "velocity": velocity, "tracks in common": weight})

    def _velocities(self, i: IntArray, j: IntArray) -> FloatArray:
        """(m,) ln of how probable the velocity of j is as that of i, given both places, against that of any object."""
        residual = self.known.state[i] - self.seen.state[j]
        total = self.known.covariance[i] + self.seen.covariance[j]
        velocity = Gaussian(residual[:, 2:], total[:, 2:, 2:])
        rest = velocity.conditional(total[:, 2:, :2], -residual[:, :2], total[:, :2, :2])
        same = log_density(rest.mean, rest.covariance)
        any_ = self.seen.covariance[j, 2:, 2:] + self.seen.speed_m_per_s[j, None, None] ** 2 * np.eye(2)
        return np.asarray(same - log_density(self.seen.state[j, 2:], any_))


@dataclass(frozen=True)
class NearOrNamed:
    """A gate: pairs that are near, and pairs however far that have a unique name in common."""

    in_common: InCommon

    def __call__(self, first: Records, second: Records) -> Pairs:
        near = ChiSquare()(first, second)
        named = self.in_common.unique > 0.0
        key = np.unique(np.concatenate([
            (near.i.astype(np.int64) << 32) | near.j, (self.in_common.known[named] << 32) | self.in_common.seen[named]
        ]))  # fmt: skip
        i, j = (key >> 32).astype(np.int32), (key & 0xFFFFFFFF).astype(np.int32)
        residual = first.features[i] - second.features[j]
        total = first.full_covariance()[i] + second.full_covariance()[j]
        chi_sq = mahalanobis_sq(residual, total)
        return Pairs(first, second, i, j, i, j, residual, chi_sq, np.linalg.det(total), f"{near.gate}, or one name")

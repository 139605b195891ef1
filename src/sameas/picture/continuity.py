"""Continuity: what says that an object of an instant is one that the picture knows already.

Where the known one should be now, and the names of the tracks that both have. A track's name that nobody else bears (an
MMSI, an address) carries more, and is heard however far away: a ferry that brakes harder than vessels should is still
that ferry. For a radar's number that is not so: numbers are given again.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sameas.evidence import Evidence, Field, Rule
from sameas.gate import ChiSquare, Pairs
from sameas.records import FloatArray, IntArray, Records

#: ln r of a track in common, of which one look in a thousand is another object's; and what a name adds that nobody else
#: bears, so that the number goes where the name goes.
IN_COMMON, UNIQUE = math.log(1e3), math.log(1e6)
#: Share of the objects of an instant that may be new. Taken.
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
    def of(cls, known: IntArray, seen: IntArray, unique: FloatArray) -> InCommon:
        """Of each track in common: whose it was (m,), whose it is (m,), and whether its name is unique, 1 or 0."""
        key, back = np.unique((known << 32) | seen, return_inverse=True)
        weight = np.bincount(back, IN_COMMON + UNIQUE * unique, len(key)).astype(np.float64)
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
class Continuity(Rule):
    """ln r of a known object and one of the instant: by their places, among objects of ``per_m2``, and their tracks."""

    per_m2: float
    in_common: InCommon

    def __call__(self, pairs: Pairs) -> Evidence:
        place = Field(APPEARING * self.per_m2)(pairs).log_ratio
        weight, unique = self.in_common.of_pairs(pairs)
        place = np.where(unique > 0.0, np.maximum(place, -IN_COMMON), place)
        return Evidence({"place": place, "tracks in common": weight})


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
        chi_sq = np.einsum("mv,mv->m", residual, np.linalg.solve(total, residual[..., None])[..., 0])
        return Pairs(first, second, i, j, i, j, residual, chi_sq, np.linalg.det(total), f"{near.gate}, or one name")

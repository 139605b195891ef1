"""Remembered: what is known of objects from looks that stand no more; every look is counted once.

Beside its state an object has the probability that it exists, and what every source made of it so far: a source that
has missed it six times is not expected to show it now. Of every two objects it is remembered whether looks have shown
them apart: two that no source tells apart, at one place, are one that lives twice (:meth:`Remembered.merged`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from sameas.evidence import LOG_2PI
from sameas.gate import ChiSquare
from sameas.picture.foreknown import KNOWN
from sameas.picture.rows import Rows
from sameas.records import FloatArray, IntArray, Records
from sameas.tracks.alignment import moved

#: Bounds of probabilities of existing: what is certain could never be unlearned.
LEAST = 1e-6
#: Bound of what looks say of two objects being two, ± ln odds.
APART = 5.0
#: Two objects are made one at these ln odds.
SURE = 3.0
#: Positions differ beyond this: that the two are two needs no looks. States agree within: they may be one.
DIFFERENT, AGREEING = ChiSquare(1.0 - 1e-6), ChiSquare(0.99)


@dataclass(frozen=True)
class Sighting:
    """What the looks that stand no more made of the remembered objects.

    seen : (m, S) probability that a record of each source that stands no more is of the object.
    passed : (S,) how many looks of the source stand no more: 1 or 0, a part of a turn for one that turns.
    q : (m, S) probability of a miss as it was believed.
    """

    seen: FloatArray
    passed: FloatArray
    q: FloatArray


@dataclass(frozen=True)
class Remembered(Rows):
    """Objects, (m,) each.

    number : of the object. state, covariance : (m, 4), (m, 4, 4) in the plane. existence : probability that it exists.
    hits, misses : (m, S) looks of each source that showed it, and that did not, older ones counting less.
    apart : (m, m) ln odds by the looks that two objects are two and not one.
    """

    WHOLE = frozenset({"apart"})
    number: IntArray
    state: FloatArray
    covariance: FloatArray
    existence: FloatArray
    hits: FloatArray
    misses: FloatArray
    apart: FloatArray

    def __len__(self) -> int:
        return len(self.number)

    @property
    def records(self) -> Records:
        """The objects as a source of their own, for ``identify_many``."""
        if not len(self):
            return Records.of(np.empty((0, 4)), sigma=1.0, source=KNOWN)
        return Records.of(self.state, covariance=self.covariance, source=KNOWN)

    @classmethod
    def none(cls, sources: int) -> Remembered:
        """No objects, of so many sources."""
        looks = np.empty((0, sources))
        nothing = np.empty(0, np.int64), np.empty((0, 4)), np.empty((0, 4, 4)), np.empty(0)
        return cls(*nothing, looks, looks, np.empty((0, 0)))

    @classmethod
    def born(
        cls, number: IntArray, state: FloatArray, covariance: FloatArray, existence: FloatArray, hits: FloatArray
    ) -> Remembered:
        """Objects that are remembered for the first time."""
        apart = np.zeros((len(number), len(number)))
        sure = np.clip(existence, LEAST, 1.0 - LEAST)
        return cls(number, state, covariance, sure, hits, np.zeros_like(hits), apart)

    def take(self, which: NDArray) -> Remembered:
        """Some of the objects: a mask (m,) or places."""
        return replace(super().take(which), apart=self.apart[which][:, which])

    def with_(self, more: Remembered) -> Remembered:
        """These and others."""
        apart = np.zeros((len(self) + len(more),) * 2)
        apart[: len(self), : len(self)], apart[len(self) :, len(self) :] = self.apart, more.apart
        return replace(self.stacked(more), apart=apart)

    def moved(self, dt_s: float, walk_m2_per_s3: float, lasting_s: float, memory_s: float) -> Remembered:
        """The objects after dt: gone on, surer that they are gone, and with an older memory."""
        state, covariance = moved(self.state, self.covariance, dt_s, walk_m2_per_s3)
        older = math.exp(-dt_s / memory_s)
        return replace(
            self, state=state, covariance=covariance, existence=self.existence * math.exp(-dt_s / lasting_s),
            hits=self.hits * older, misses=self.misses * older,
        )  # fmt: skip

    def expected_q(self, usual_q: FloatArray, looks: float, least: float) -> FloatArray:
        """(m, S) probability of a miss: that of any object at its place, worth so many looks, and its own looks."""
        q = (looks * usual_q + self.misses) / (looks + self.misses + self.hits)
        return np.asarray(np.clip(q, least, 1.0 - least))

    def after(self, sighting: Sighting) -> Remembered:
        """The objects after looks that stand no more; their states are another matter."""
        seen, r = sighting.seen, self.existence
        missed = r * np.prod(sighting.q**sighting.passed, axis=1)
        unseen = np.prod(1.0 - seen, axis=1)
        r = 1.0 - unseen + unseen * missed / (1.0 - r + missed)
        return replace(
            self, existence=np.clip(r, LEAST, 1.0 - LEAST), hits=self.hits + seen,
            misses=self.misses + np.maximum(sighting.passed - seen, 0.0),
        )  # fmt: skip

    def told_apart(self, seen: FloatArray, usual_q: FloatArray, split: FloatArray) -> Remembered:
        """The objects with what looks that stand no more say of any two being two.

        Where both are seen it is (1 − q)² if they are two, and (1 − q) and a split if they are one; where one of them
        is, (1 − q) q against 1 − q.

        seen : (m, S) as of :class:`Sighting`. usual_q : (m, S) probability that any object at the place is missed.
        split : (S,) probability that a look of the source shows one object as two.
        """
        apart = self.apart.copy()
        for s in range(len(split)):
            log_q, log_both = np.log(usual_q[:, s]), np.log1p(-usual_q[:, s]) - math.log(split[s])
            both, one = np.outer(seen[:, s], seen[:, s]), np.outer(seen[:, s], 1.0 - seen[:, s])
            apart += 0.5 * both * (log_both[:, None] + log_both) + 0.5 * (one + one.T) * (log_q[:, None] + log_q)
        return replace(self, apart=np.clip(apart, -APART, APART))

    def merged(self, density_per_m2: float) -> Remembered:
        """The objects without those that live twice; the lower number stays.

        Two are one where the place says more for it, ln N(Δ; 0, P + P′)/ρ, than the looks against it, by :data:`SURE`.
        The state of the one that was seen more often stays: the other may be the end of its hull.
        """
        objects = self
        while len(objects) > 1:
            for_one, agree, differ = objects._compared(density_per_m2)
            objects = replace(objects, apart=np.where(differ, 0.0, objects.apart))
            odds = np.where(agree, for_one - objects.apart, -np.inf)
            np.fill_diagonal(odds, -np.inf)
            i, j = sorted(np.unravel_index(int(odds.argmax()), odds.shape))
            if not odds[i, j] > SURE:
                break
            objects = objects._joined(int(i), int(j))
        return objects

    def _compared(self, density_per_m2: float) -> tuple[FloatArray, NDArray[np.bool_], NDArray[np.bool_]]:
        """(m, m) ln N/ρ of positions, whether states agree, and whether positions differ."""
        delta = self.state[:, None] - self.state
        total = self.covariance[:, None] + self.covariance
        chi_sq = np.einsum("ijv,ijvw,ijw->ij", delta, np.linalg.inv(total), delta)
        place = np.einsum("ijv,ijvw,ijw->ij", delta[..., :2], np.linalg.inv(total[..., :2, :2]), delta[..., :2])
        log_n = -LOG_2PI - 0.5 * np.linalg.slogdet(total[..., :2, :2])[1] - 0.5 * place
        return log_n - math.log(density_per_m2), chi_sq < AGREEING.limit(4), place > DIFFERENT.limit(2)

    def _joined(self, i: int, j: int) -> Remembered:
        """Objects i and j as one, at i."""
        columns = {f.name: getattr(self, f.name).copy() for f in fields(self)}
        stays = max(i, j, key=lambda k: (self.existence[k] * self.hits[k].sum(), *self.state[k]))
        columns["state"][i], columns["covariance"][i] = self.state[stays], self.covariance[stays]
        columns["number"][i] = min(self.number[i], self.number[j])
        columns["existence"][i] = 1.0 - (1.0 - self.existence[i]) * (1.0 - self.existence[j])
        columns["hits"][i] = self.hits[i] + self.hits[j]
        columns["misses"][i] = np.minimum(self.misses[i], self.misses[j])
        return Remembered(**columns).take(np.arange(len(self)) != j)

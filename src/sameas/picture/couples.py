"""Couples: two named tracks, and what their looks weigh for their being one object against their being two.

Every new look of track a or b weighs ln p(look | looks of both so far) − ln p(look | looks of its own track so far),
the first if they are one object, the second if they are two. If they are one, their positions differ by their errors
alone, δ = x_a − x_b = e_a − e_b, so what the looks of both leave open is the mean and covariance of e_a, with
e_b = e_a − δ; errors go from look to look as :mod:`sameas.picture.named` says. Between looks nothing is added: a report
repeated is no evidence. Tracks that move alike in a convoy are told apart by their distance only, and others by their
motion, too: either follows from the same formula.

Source: METHOD 3.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sameas.picture.named import Step, found_in
from sameas.picture.rows import Rows
from sameas.picture.weighing import LEAST_M2, log_normal, looked
from sameas.records import FloatArray, IntArray


def keys(first: IntArray, second: IntArray) -> IntArray:
    """(k,) one number a couple, ascending as their tracks are."""
    return (first << 32) | second


@dataclass(frozen=True)
class Couples(Rows):
    """Couples of tracks at an instant, (k,) each, by ascending numbers of their tracks.

    Attributes
    ----------
    first, second : numbers of the tracks, first < second.
    mean, covariance : (k, 2), (k, 2, 2) of the first one's error, if they are one object.
    log_ratio : ln r of the looks before the last one, less than certain: see :meth:`stepped`.
    at_look : ln N(δ; 0, P_a + P_b) at the last look of either. now : the same at the instant. chi_sq : its χ².
    """

    first: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    second: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    mean: FloatArray = field(default_factory=lambda: np.empty((0, 2)))
    covariance: FloatArray = field(default_factory=lambda: np.empty((0, 2, 2)))
    log_ratio: FloatArray = field(default_factory=lambda: np.empty(0))
    at_look: FloatArray = field(default_factory=lambda: np.empty(0))
    now: FloatArray = field(default_factory=lambda: np.empty(0))
    chi_sq: FloatArray = field(default_factory=lambda: np.empty(0))

    def __len__(self) -> int:
        return len(self.first)

    @classmethod
    def of(cls, first: IntArray, second: IntArray, delta: FloatArray, one: FloatArray, other: FloatArray) -> Couples:
        """Couples that meet now: δ (k, 2) and covariances P_a, P_b (k, 2, 2). They have no past."""
        share = one @ np.linalg.inv(one + other)
        density, chi_sq = log_normal(delta, one + other)
        mean = np.einsum("kvw,kw->kv", share, delta)
        return cls(first, second, mean, one - share @ one, np.zeros(len(first)), density, density, chi_sq)

    def has(self, first: IntArray, second: IntArray) -> NDArray[np.bool_]:
        """(k,) whether couples are among these."""
        return np.asarray(found_in(keys(self.first, self.second), keys(first, second)) >= 0)

    def with_(self, more: Couples) -> Couples:
        """These and others, in order."""
        both = self.stacked(more)
        return both.take(np.argsort(keys(both.first, both.second)))

    def stepped(self, step: Step, reassigned: float) -> Couples:
        """The couples whose tracks are both in the step, after it.

        What ``now`` says is taken off what all looks say, so that both can be added. A look may be of another object
        than its name says, with probability ε = ``reassigned``: x ← ln[((1−ε) eˣ + ε)/((1−ε) + ε eˣ)] at every look.
        """
        a, b = step.find(self.first), step.find(self.second)
        both = (a >= 0) & (b >= 0)
        return self.take(both)._wandered(step, a[both], b[both])._looked(step, a[both], b[both], reassigned)

    def _wandered(self, step: Step, a: IntArray, b: IntArray) -> Couples:
        """Both tracks wander on, as far as their motion leaves open; a, b : where they stand in the step."""
        drift = step.drift[a]
        share = drift @ np.linalg.inv(drift + step.drift[b] + LEAST_M2 * np.eye(2))
        went = (step.moved[a] - step.moved[b]) - (step.last[a] - step.last[b])
        mean = self.mean + np.einsum("kvw,kw->kv", share, went)
        covariance = _symmetric(self.covariance + drift - share @ drift)
        return Couples(self.first, self.second, mean, covariance, self.log_ratio, self.at_look, self.now, self.chi_sq)

    def _looked(self, step: Step, a: IntArray, b: IntArray, reassigned: float) -> Couples:
        """After the new looks of the step, where there are any: those of the first track, then of the second."""
        mean, spread, more = self.mean, self.covariance, np.zeros(len(self))
        delta = step.moved[a] - step.moved[b]
        for track, side in ((a, 1.0), (b, -1.0)):
            shift, new = step.here[track] - step.moved[track], step.looked[track]
            # e of this track; with the other's position it is known as well as the other's.
            own = mean if side > 0.0 else mean - delta
            after, narrowed, log_p, _ = looked(own, spread, step.turn[track], step.fresh[track], shift)
            delta = delta + side * shift
            mean = np.where(new[:, None], after if side > 0.0 else after + delta, mean)
            spread = np.where(new[:, None, None], narrowed, spread)
            more += np.where(new, log_p - step.log_own[track], 0.0)
        now, chi_sq = log_normal(delta, step.covariance[a] + step.covariance[b])
        rivals = Rivals.of(self.first, self.second, step.source[a], step.source[b])
        ratio = rivals.leaky(self.log_ratio + self.at_look + more - now, chi_sq, reassigned)
        new = step.looked[a] | step.looked[b]
        return Couples(
            self.first, self.second, mean, spread, np.where(new, ratio, self.log_ratio),
            np.where(new, now, self.at_look), now, chi_sq,
        )  # fmt: skip


@dataclass(frozen=True)
class Rivals:
    """Couples of which one at most is one object: a track with each of the tracks of one other source.

    sides : (k,) numbers of the two crowds that each couple is of.
    """

    sides: tuple[IntArray, IntArray]

    @classmethod
    def of(cls, first: IntArray, second: IntArray, one: IntArray, other: IntArray) -> Rivals:
        """Of tracks (k,) and the sources that they are of (k,)."""
        crowds = (np.unique((track << 16) | source, return_inverse=True)[1].reshape(-1)
                  for track, source in ((first, other), (second, one)))  # fmt: skip
        return cls(tuple(crowds))

    def most(self, values: FloatArray) -> FloatArray:
        """(k,) the highest value of any rival of each couple, itself among them."""
        out = values
        for crowd in self.sides:
            best = np.full(int(crowd.max(initial=-1)) + 1, -np.inf)
            np.maximum.at(best, crowd, values)
            out = np.maximum(out, best[crowd])
        return out

    def bounded(self, log_ratio: FloatArray, chi_sq: FloatArray, reassigned: float) -> FloatArray:
        """ln r within ±ln((1−ε)/ε), less what the best of the rivals has too much, so that they keep their distances.

        chi_sq : (k,) of δ now: what the past says more only because the present contradicts is not held against rivals.
        """
        sure = math.log((1.0 - reassigned) / reassigned)
        excess = np.maximum(self.most(np.where(chi_sq <= 13.8, log_ratio, -np.inf)) - sure, 0.0)
        return np.clip(log_ratio - excess, -sure, sure)

    def leaky(self, log_ratio: FloatArray, chi_sq: FloatArray, reassigned: float) -> FloatArray:
        """ln r after one more look that may belong to another object than its name says."""
        best = np.maximum(self.most(np.where(chi_sq <= 13.8, log_ratio, -np.inf)), 0.0)
        leaked = np.logaddexp(math.log1p(-reassigned) + log_ratio, math.log(reassigned) + best)
        return self.bounded(leaked, chi_sq, reassigned)


def _symmetric(covariance: FloatArray) -> FloatArray:
    return np.asarray(0.5 * (covariance + covariance.transpose(0, 2, 1)))

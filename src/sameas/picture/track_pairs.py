"""Track pairs: two named tracks, and what their looks weigh for their being one object against their being two.

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
from dataclasses import dataclass, field, replace

import numpy as np

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.gaussian import Gaussian, log_density, mahalanobis_sq
from sameas.many.observations import Source
from sameas.picture.error_correlation import LEAST_M2, error_update
from sameas.picture.named import NamedTracks, Step, found_in
from sameas.picture.object_table import ColumnTable
from sameas.picture.scan import Scan
from sameas.records import Records


def keys(first: IntArray, second: IntArray) -> IntArray:
    """(k,) one number a pair, ascending as their tracks are."""
    return (first << 32) | second


@dataclass(frozen=True)
class TrackPairs(ColumnTable):
    """Pairs of tracks at an instant, (k,) each, by ascending numbers of their tracks.

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
    def of(cls, first: IntArray, second: IntArray, delta: FloatArray, one: FloatArray, other: FloatArray) -> TrackPairs:
        """Pairs that meet now: δ (k, 2) and covariances P_a, P_b (k, 2, 2). They have no past."""
        error = Gaussian(np.zeros_like(delta), one).updated(Gaussian(delta, other))
        density, chi_sq = log_density(delta, one + other), mahalanobis_sq(delta, one + other)
        return cls(first, second, error.mean, error.covariance, np.zeros(len(first)), density, density, chi_sq)

    def has(self, first: IntArray, second: IntArray) -> BoolArray:
        """(k,) whether pairs are among these."""
        return np.asarray(found_in(keys(self.first, self.second), keys(first, second)) >= 0)

    def with_(self, more: TrackPairs) -> TrackPairs:
        """These and others, in order."""
        both = self.stacked(more)
        return both.take(np.argsort(keys(both.first, both.second)))

    def stepped(self, step: Step, reassigned: float) -> TrackPairs:
        """The pairs whose tracks are both in the step, after it.

        What ``now`` says is taken off what all looks say, so that both can be added. A look may be of another object
        than its name says, with probability ε = ``reassigned``: x ← ln[((1−ε) eˣ + ε)/((1−ε) + ε eˣ)] at every look.
        """
        a, b = step.find(self.first), step.find(self.second)
        both = (a >= 0) & (b >= 0)
        return self.take(both)._wandered(step, a[both], b[both])._looked(step, a[both], b[both], reassigned)

    def _wandered(self, step: Step, a: IntArray, b: IntArray) -> TrackPairs:
        """Both tracks wander on, as far as their motion leaves open; a, b : where they stand in the step."""
        drift = step.drift[a]
        went = (step.moved[a] - step.moved[b]) - (step.last[a] - step.last[b])
        total = drift + step.drift[b] + LEAST_M2 * np.eye(2)
        error = Gaussian(self.mean, self.covariance + drift).conditional(drift, went, total)
        return replace(self, mean=error.mean, covariance=error.covariance)

    def _looked(self, step: Step, a: IntArray, b: IntArray, reassigned: float) -> TrackPairs:
        """After the new looks of the step, where there are any: those of the first track, then of the second."""
        mean, spread, more = self.mean, self.covariance, np.zeros(len(self))
        delta = step.moved[a] - step.moved[b]
        for track, side in ((a, 1.0), (b, -1.0)):
            shift, new = step.here[track] - step.moved[track], step.looked[track]
            # e of this track; with the other's position it is known as well as the other's.
            own = mean if side > 0.0 else mean - delta
            after, narrowed, log_p, _ = error_update(own, spread, step.turn[track], step.fresh[track], shift)
            delta = delta + side * shift
            mean = np.where(new[:, None], after if side > 0.0 else after + delta, mean)
            spread = np.where(new[:, None, None], narrowed, spread)
            more += np.where(new, log_p - step.log_own[track], 0.0)
        total = step.covariance[a] + step.covariance[b]
        now, chi_sq = log_density(delta, total), mahalanobis_sq(delta, total)
        rivals = Rivals.of(self.first, self.second, step.source[a], step.source[b])
        ratio = rivals.leaky(self.log_ratio + self.at_look + more - now, chi_sq, reassigned)
        new = step.looked[a] | step.looked[b]
        return TrackPairs(
            self.first, self.second, mean, spread, np.where(new, ratio, self.log_ratio),
            np.where(new, now, self.at_look), now, chi_sq,
        )  # fmt: skip


@dataclass(frozen=True)
class Rivals:
    """Pairs of which one at most is one object: a track with each of the tracks of one other source.

    sides : (k,) numbers of the two crowds that each pair is of.
    """

    sides: tuple[IntArray, IntArray]

    @classmethod
    def of(cls, first: IntArray, second: IntArray, one: IntArray, other: IntArray) -> Rivals:
        """Of tracks (k,) and the sources that they are of (k,)."""
        crowds = (np.unique((track << 16) | source, return_inverse=True)[1].reshape(-1)
                  for track, source in ((first, other), (second, one)))  # fmt: skip
        return cls(tuple(crowds))

    def most(self, values: FloatArray) -> FloatArray:
        """(k,) the highest value of any rival of each pair, itself among them."""
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


#: Mean time between two manoeuvres of an object, seconds (chosen).
EVERY_S = 600.0
#: A pair of tracks counts as partners although it is less probable than strangers by so much in ln r of places: that
#: sources would have missed both speaks for it, too.
TOGETHER = math.log(20.0)


def loosened(scan: Scan, tracks: NamedTracks, track_pairs: TrackPairs, said: FloatArray, per_m2: float) -> Scan:
    """The scan with larger covariances of reports that their objects have left behind by a manoeuvre.

    A report is moved to the instant by a random walk of its velocity, which is how objects move nearly always. A ferry
    that stops at a pier leaves it by six of its σ within a minute; by the normal law her AIS of before the stop is then
    of no object, however long the radar's track has gone with it. So each report of a named track may be followed by a
    manoeuvre, :data:`EVERY_S` apart on average: at an unknown time since, its velocity v became that of any object,
    0 ± s per axis, which leaves open

        D = (s² I + v vᵀ) ⊗ [t²/3, t/2; t/2, 1],   t the report's age.

    A manoeuvre is assumed where the report's partners so far, one track of each other source, are together more
    probable with D than without, by more than the odds against a manoeuvre. A radar too coarse to see it does not
    outvote one that does. The position stays what its source reported; only the covariance grows, for evidence, memory
    and fused states alike.

    tracks, track_pairs : of the instant before. said : (k,) ln r of the pairs then.
    """
    a, b = (_places(scan, tracks, number) for number in (track_pairs.first, track_pairs.second))
    there = (a >= 0) & (b >= 0) & (said + track_pairs.now >= math.log(per_m2) - TOGETHER)
    a, b, said = a[there], b[there], said[there]
    if not len(a):
        return scan
    open_ = left_open(scan)
    delta, spread = scan.state[a, :2] - scan.state[b, :2], scan.covariance[a, :2, :2] + scan.covariance[b, :2, :2]
    usual = log_density(delta, spread)
    with np.errstate(divide="ignore"):
        # ln of the odds that there was a manoeuvre since the report.
        log_odds = np.log(np.expm1(np.maximum(scan.now.instant_s - scan.time_s, 0.0) / EVERY_S))
    foretold = said + usual
    best = Rivals.of(a, b, scan.source[a], scan.source[b]).most(foretold)
    # Either of the two may be the one that was left behind.
    own, other, k = np.append(a, b), np.append(b, a), np.tile(np.arange(len(a)), 2)
    moved = log_density(delta[k], spread[k] + open_[own, :2, :2])
    gone = log_odds[own] + said[k] + moved
    likely = np.maximum(foretold[k], gone)
    partner = likely == _most(own * len(scan.start) + scan.source[other], likely)
    told = np.bincount(own[partner], (moved - usual[k])[partner], len(scan)) + log_odds
    left = np.zeros(len(scan), bool)
    # No rival explains the other without a manoeuvre, and its partners in all sources together say that there was one.
    left[own[(gone > best[k]) & (told[own] > 0.0)]] = True
    return _with(scan, np.where(left[:, None, None], open_, 0.0)) if left.any() else scan


def left_open(scan: Scan) -> FloatArray:
    """(n, 4, 4) D of every record; 0 where nothing is known of how fast its objects are."""
    age = np.maximum(scan.now.instant_s - scan.time_s, 0.0)
    speed = np.where(np.isfinite(scan.speed_m_per_s), scan.speed_m_per_s, 0.0)
    v = np.where(scan.moving[:, None], scan.state[:, 2:], 0.0)
    change = np.einsum("nv,nw->nvw", v, v) + speed[:, None, None] ** 2 * np.eye(2)
    change[speed == 0.0] = 0.0
    out = np.zeros((len(scan), 4, 4))
    out[:, :2, :2] = change * (age**2 / 3.0)[:, None, None]
    out[:, :2, 2:] = out[:, 2:, :2] = change * (age / 2.0)[:, None, None]
    out[:, 2:, 2:] = change
    return out


def _places(scan: Scan, tracks: NamedTracks, number: IntArray) -> IntArray:
    """(k,) where tracks stand on a new scan, −1 for those that do not."""
    on = tracks.numbers_on(scan)
    order = np.argsort(on, kind="stable")
    at = found_in(on[order], number)
    return np.where(at >= 0, np.append(order, -1)[at], -1)


def _with(scan: Scan, more: FloatArray) -> Scan:
    """The scan with covariances that are larger by ``more`` (n, 4, 4)."""
    sources = list(scan.now.sources)
    for s, source in enumerate(sources):
        here = slice(scan.start[s], scan.start[s + 1])
        sources[s] = _grown(source, scan.table[here], more[here])
    now = replace(scan.now, sources=tuple(sources))
    return replace(scan, now=now, covariance=scan.covariance + more, loose=more)


def _grown(source: Source, table: IntArray, more: FloatArray) -> Source:
    """A source's records with larger covariances; ``table`` their rows, ascending."""
    if not isinstance(source, Records) or not more.any():
        return source
    d = source.d
    covariance = source.full_covariance() + more[np.searchsorted(table, source.rows), :d, :d]
    upper = np.triu_indices(d)
    return replace(source, covariance=covariance[:, upper[0], upper[1]])


def _most(crowd: IntArray, values: FloatArray) -> FloatArray:
    """(k,) the highest value in the crowd of each."""
    best = np.full(int(crowd.max(initial=-1)) + 1, -np.inf)
    np.maximum.at(best, crowd, values)
    return best[crowd]

"""Track pairs: two named tracks, and the evidence of their reports that they are one object.

Every new report of track a or b adds ln p(report | reports of both tracks) − ln p(report | reports of its own track):
the first holds if they are one object, the second if they are two. If they are one, their positions differ by their
errors alone, δ = x_a − x_b = e_a − e_b, so the state of a pair is the mean and covariance of e_a, with e_b = e_a − δ;
errors develop from report to report as in :mod:`sameas.picture.named`. Between reports nothing is added: a repeated
report is no evidence. Tracks of a convoy are distinguished by their distance only, others by their motion too: both
follow from the same formula.

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
from sameas.picture.named import NamedTracks, Step, places_in
from sameas.picture.object_table import ColumnTable
from sameas.picture.scan import Scan
from sameas.picture.tuning import DEFAULT_TUNING, Tuning
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
    log_ratio : ln r of the reports before the last one, bounded: see :meth:`stepped`.
    at_scan : ln N(δ; 0, P_a + P_b) at the last report of either. now : the same at the instant. chi_sq : its χ².
    """

    first: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    second: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    mean: FloatArray = field(default_factory=lambda: np.empty((0, 2)))
    covariance: FloatArray = field(default_factory=lambda: np.empty((0, 2, 2)))
    log_ratio: FloatArray = field(default_factory=lambda: np.empty(0))
    at_scan: FloatArray = field(default_factory=lambda: np.empty(0))
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
        return np.asarray(places_in(keys(self.first, self.second), keys(first, second)) >= 0)

    def with_(self, others: TrackPairs) -> TrackPairs:
        """These and others, in order."""
        both = self.stacked(others)
        return both.take(np.argsort(keys(both.first, both.second)))

    def stepped(self, step: Step, reassigned: float, tuning: Tuning = DEFAULT_TUNING) -> TrackPairs:
        """The pairs whose tracks are both in the step, after it.

        ``now`` is subtracted from the evidence of all reports, so that both can be added. A report may be of another
        object than its id says, with probability ε = ``reassigned``: x ← ln[((1−ε) eˣ + ε)/((1−ε) + ε eˣ)] at every
        report.
        """
        a, b = step.find(self.first), step.find(self.second)
        both = (a >= 0) & (b >= 0)
        continuing = self.take(both)._predicted(step, a[both], b[both])
        return continuing._updated(step, a[both], b[both], reassigned, tuning)

    def _predicted(self, step: Step, a: IntArray, b: IntArray) -> TrackPairs:
        """The errors of both tracks grown by their motion; a, b : places of the tracks in the step."""
        drift = step.drift[a]
        went = (step.moved[a] - step.moved[b]) - (step.last[a] - step.last[b])
        total = drift + step.drift[b] + LEAST_M2 * np.eye(2)
        error = Gaussian(self.mean, self.covariance + drift).conditional(drift, went, total)
        return replace(self, mean=error.mean, covariance=error.covariance)

    def _updated(self, step: Step, a: IntArray, b: IntArray, reassigned: float, tuning: Tuning) -> TrackPairs:
        """After the new reports of the step: those of the first track, then of the second."""
        mean, covariance, gain = self.mean, self.covariance, np.zeros(len(self))
        delta = step.moved[a] - step.moved[b]
        for track, side in ((a, 1.0), (b, -1.0)):
            shift, new_report = step.here[track] - step.moved[track], step.new_report[track]
            # e of this track, from the mean of the other's and δ.
            own_mean = mean if side > 0.0 else mean - delta
            updated_mean, updated_covariance, log_p, _ = error_update(
                own_mean, covariance, step.transition[track], step.noise[track], shift
            )
            delta = delta + side * shift
            mean = np.where(new_report[:, None], updated_mean if side > 0.0 else updated_mean + delta, mean)
            covariance = np.where(new_report[:, None, None], updated_covariance, covariance)
            gain += np.where(new_report, log_p - step.log_own[track], 0.0)
        total = step.covariance[a] + step.covariance[b]
        now, chi_sq = log_density(delta, total), mahalanobis_sq(delta, total)
        rivals = Rivals.of(self.first, self.second, step.source[a], step.source[b])
        ratio = rivals.leaky(self.log_ratio + self.at_scan + gain - now, chi_sq <= tuning.manoeuvre_chi_sq, reassigned)
        new_report = step.new_report[a] | step.new_report[b]
        return TrackPairs(
            self.first, self.second, mean, covariance, np.where(new_report, ratio, self.log_ratio),
            np.where(new_report, now, self.at_scan), now, chi_sq,
        )  # fmt: skip


@dataclass(frozen=True)
class Rivals:
    """Pairs of which one at most is one object: a track with each of the tracks of one other source.

    sides : (k,) numbers of the two such sets that each pair is in.
    """

    sides: tuple[IntArray, IntArray]

    @classmethod
    def of(cls, first: IntArray, second: IntArray, one: IntArray, other: IntArray) -> Rivals:
        """Of tracks (k,) and the sources that they are of (k,)."""
        sets = (np.unique((track << 16) | source, return_inverse=True)[1].reshape(-1)
                  for track, source in ((first, other), (second, one)))  # fmt: skip
        return cls(tuple(sets))

    def most(self, values: FloatArray) -> FloatArray:
        """(k,) the highest value of any rival of each pair, itself among them."""
        out = values
        for rivals in self.sides:
            best = np.full(int(rivals.max(initial=-1)) + 1, -np.inf)
            np.maximum.at(best, rivals, values)
            out = np.maximum(out, best[rivals])
        return out

    def bounded(self, log_ratio: FloatArray, agrees: BoolArray, reassigned: float) -> FloatArray:
        """ln r within ±ln((1−ε)/ε), less the excess of the best rival, so that differences between rivals stay.

        agrees : (k,) whether the positions of the instant agree. Where they contradict the past, ln r of the past is
            large for that reason alone, and rivals do not pay for it.
        """
        bound = math.log((1.0 - reassigned) / reassigned)
        excess = np.maximum(self.most(np.where(agrees, log_ratio, -np.inf)) - bound, 0.0)
        return np.clip(log_ratio - excess, -bound, bound)

    def leaky(self, log_ratio: FloatArray, agrees: BoolArray, reassigned: float) -> FloatArray:
        """ln r after one more report that may be of another object than its id says; see :meth:`bounded`."""
        best = np.maximum(self.most(np.where(agrees, log_ratio, -np.inf)), 0.0)
        leaked = np.logaddexp(math.log1p(-reassigned) + log_ratio, math.log(reassigned) + best)
        return self.bounded(leaked, agrees, reassigned)


def with_manoeuvres(
    scan: Scan, tracks: NamedTracks, track_pairs: TrackPairs, log_ratio: FloatArray, per_m2: float
) -> Scan:
    """The scan with larger covariances of reports whose objects have made a manoeuvre since.

    A report is moved to the instant by a random walk of its velocity, which fits nearly all motion. A ferry that stops
    at a pier is six of its σ away from the prediction within a minute; by the normal law her AIS report from before the
    stop is then of no object, however long it was that of the radar's track. So each report of a named track may be
    followed by a manoeuvre, one in ``manoeuvre_every_s`` on average: at an unknown time since, its velocity v became
    that of any object, 0 ± s per axis, which adds the covariance

        D = (s² I + v vᵀ) ⊗ [t²/3, t/2; t/2, 1],   t the report's age.

    A manoeuvre is assumed where the report's partners, one track of each other source, are together more probable
    with D than without, by more than the odds against a manoeuvre. A radar too coarse to see it does not outvote one
    that does. The position stays as reported; only the covariance grows, for evidence, memory and fused states alike.

    tracks, track_pairs : of the instant before. log_ratio : (k,) ln r of the pairs then.
    """
    a, b = _places(scan, tracks, np.stack([track_pairs.first, track_pairs.second]))
    partners = (
        (a >= 0) & (b >= 0) & (log_ratio + track_pairs.now >= math.log(per_m2) - math.log(scan.tuning.partner_odds))
    )
    a, b, log_ratio = a[partners], b[partners], log_ratio[partners]
    if not len(a):
        return scan
    extra = manoeuvre_covariance(scan)
    delta, spread = scan.state[a, :2] - scan.state[b, :2], scan.covariance[a, :2, :2] + scan.covariance[b, :2, :2]
    log_usual = log_density(delta, spread)
    with np.errstate(divide="ignore"):
        # ln of the odds that there was a manoeuvre since the report.
        log_odds = np.log(np.expm1(np.maximum(scan.now.instant_s - scan.time_s, 0.0) / scan.tuning.manoeuvre_every_s))
    log_same = log_ratio + log_usual
    best = Rivals.of(a, b, scan.source[a], scan.source[b]).most(log_same)
    # Either of the two may have made the manoeuvre.
    own, other, k = np.append(a, b), np.append(b, a), np.tile(np.arange(len(a)), 2)
    log_density_moved = log_density(delta[k], spread[k] + extra[own, :2, :2])
    log_moved = log_odds[own] + log_ratio[k] + log_density_moved
    likely = np.maximum(log_same[k], log_moved)
    partner = likely == _most(own * len(scan.start) + scan.source[other], likely)
    log_manoeuvre = np.bincount(own[partner], (log_density_moved - log_usual[k])[partner], len(scan)) + log_odds
    manoeuvred = np.zeros(len(scan), bool)
    # No rival explains the other without a manoeuvre, and its partners in all sources together say that there was one.
    manoeuvred[own[(log_moved > best[k]) & (log_manoeuvre[own] > 0.0)]] = True
    return _grown_scan(scan, np.where(manoeuvred[:, None, None], extra, 0.0)) if manoeuvred.any() else scan


def manoeuvre_covariance(scan: Scan) -> FloatArray:
    """(n, 4, 4) D of every record; 0 where the speed of its objects is not known."""
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
    """(…) places of tracks in a new scan, −1 for those that are not in it."""
    on = tracks.numbers_on(scan)
    order = np.argsort(on, kind="stable")
    at = places_in(on[order], number)
    return np.where(at >= 0, np.append(order, -1)[at], -1)


def _grown_scan(scan: Scan, extra: FloatArray) -> Scan:
    """The scan with covariances that are larger by ``extra`` (n, 4, 4)."""
    sources = list(scan.now.sources)
    for s, source in enumerate(sources):
        here = slice(scan.start[s], scan.start[s + 1])
        sources[s] = _grown_source(source, scan.table[here], extra[here])
    now = replace(scan.now, sources=tuple(sources))
    return replace(scan, now=now, covariance=scan.covariance + extra, manoeuvre_covariance=extra)


def _grown_source(source: Source, table: IntArray, extra: FloatArray) -> Source:
    """A source's records with larger covariances; ``table`` their rows, ascending."""
    if not isinstance(source, Records) or not extra.any():
        return source
    d = source.d
    covariance = source.full_covariance() + extra[np.searchsorted(table, source.rows), :d, :d]
    upper = np.triu_indices(d)
    return replace(source, covariance=covariance[:, upper[0], upper[1]])


def _most(group: IntArray, values: FloatArray) -> FloatArray:
    """(k,) the highest value in the set of each."""
    best = np.full(int(group.max(initial=-1)) + 1, -np.inf)
    np.maximum.at(best, group, values)
    return best[group]

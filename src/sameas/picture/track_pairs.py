"""Track pairs: two named tracks, and the evidence of their reports that they are one object.

Every new report of track a or b adds ln p(report | one object) − ln p(report | two objects), each given all reports
before it. If they are one, their positions differ by their errors alone, δ = x_a − x_b = e_a − e_b; errors develop from
report to report as in :mod:`sameas.picture.named`, so what a residual adds is what it is not by the residuals before
it. If they are two, either each goes its own way, and a report is predicted by its own track; or they are in convoy,
moored side by side or one behind the other, at a distance d that stays: δ = e_a − e_b + d. Then their motion tells
nothing, and all that tells them from one object is how near 0 the reports show d to be. Both are weighed by the
reports. Between reports nothing is added: a repeated report is no evidence.

Trackers swap near objects: after a report the ids of two tracks of a source that are χ² apart by their own positions
have been exchanged with the probability h e^(−χ²/8), and with ε whatever their distance. A pair whose past is then
that of its best rival begins anew, so its state is a mixture of its own and one without a past. h is estimated for
every source (:class:`SwapRates`) by how probable the next reports are with and without a swap.

The state of a pair is the mean and covariance of (e_a, z_a, z_b) if they are one object, z what lasts of the errors,
and of (e_a, z_a, z_b, d) in convoy.

Pairs that have gone far apart are no longer compared (:class:`PartedPairs`): the positions of the instant tell them
apart, and further reports tell nothing new. What their reports have told until then is kept for as long as they might
meet again.

Source: METHOD 3.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.special import expit

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.gaussian import LOG_2PI, distance_and_log_determinant, log_density, mahalanobis_sq
from sameas.kernels.kalman import best_others, swap_evidence
from sameas.kernels.track_pairs import WIDTH, mix, pairs_anew, pairs_stepped
from sameas.picture.error_factors import LEAST_M2, ErrorCorrelation
from sameas.picture.named import Step
from sameas.picture.object_table import ColumnTable
from sameas.picture.scan import Scan
from sameas.picture.tuning import DEFAULT_TUNING, Tuning
from sameas.ragged import places_in
from sameas.tracks.kinds import KINDS


def keys(first: IntArray, second: IntArray) -> IntArray:
    """(k,) one number a pair, ascending as their tracks are."""
    return (first << 32) | second


@dataclass(frozen=True)
class PartedPairs(ColumnTable):
    """Pairs of tracks that have gone far apart, (k,) each, by ascending numbers of their tracks.

    first, second : numbers of the tracks, first < second. log_ratio : ln r of their reports until then. near_s : when
    their positions agreed last.
    """

    first: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    second: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    log_ratio: FloatArray = field(default_factory=lambda: np.empty(0))
    near_s: FloatArray = field(default_factory=lambda: np.empty(0))

    def __len__(self) -> int:
        return len(self.first)

    def on(self, step: Step, parting: PartedPairs, tuning: Tuning) -> PartedPairs:
        """At an instant: with those that part now, without those whose tracks have gone or that parted long ago."""
        every = self.stacked(parting) if len(parting) else self
        if not len(every):
            return self
        here = (step.find(every.first) >= 0) & (step.find(every.second) >= 0)
        every = every.take(np.flatnonzero(here & (step.instant_s - every.near_s <= tuning.pair_timeout_s)))
        return every.take(np.argsort(keys(every.first, every.second))) if len(parting) else every

    def met(self, first: IntArray, second: IntArray) -> tuple[FloatArray, PartedPairs]:
        """(k,) ln r of pairs that meet now, 0 for those that never parted, and the other parted pairs."""
        at = places_in(keys(self.first, self.second), keys(first, second))
        left = np.ones(len(self), bool)
        left[at[at >= 0]] = False
        return np.append(self.log_ratio, 0.0)[at], self if left.all() else self.take(np.flatnonzero(left))


@dataclass(frozen=True)
class TrackPairs(ColumnTable):
    """Pairs of tracks at an instant, (k,) each, by ascending numbers of their tracks.

    Attributes
    ----------
    first, second : numbers of the tracks, first < second.
    errors, met : (n, WIDTH), (m, WIDTH) mean and covariance of (e_a, z_a, z_b) if they are one object, and of
        (e_a, z_a, z_b, d) if they are in convoy, as :mod:`sameas.kernels.track_pairs` has them: of those that have gone
        through a step, and of those that have met since. row : where each pair stands in both, one below the other.
    log_convoy : log-odds that two objects, if they are two, are in convoy.
    log_ratio : ln r of the reports before the last one, bounded: see :meth:`stepped`.
    at_scan : ln N(δ; 0, P_a + P_b) at the last report of either. now : the same at the instant. chi_sq : its χ².
    anchor_s, anchor : (k,), (k, 2) when they were surely one object, and δ then; NaN before. anchor_new : (k, 2)
        whether each track has a new report since. sure : whether they surely are one object.
    offset, offsets : (k, 2), (k,) mean of δ at times ``lasting_s`` apart, and how many; offset_s : the last of them.
    offset_new : (k, 2) whether each track has a new report since. offset_chi_sq, log_offset : (k,) its χ² by stated
        errors, and what it adds to ln r; see :meth:`with_offsets`.
    near_s : when their positions agreed last. Pairs of which that is long ago are forgotten: whoever passes another
        once would else be compared with it for ever.
    parted : the pairs that have gone far apart.
    """

    WHOLE = frozenset({"errors", "met", "parted"})
    first: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    second: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    row: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    log_convoy: FloatArray = field(default_factory=lambda: np.empty(0))
    log_ratio: FloatArray = field(default_factory=lambda: np.empty(0))
    at_scan: FloatArray = field(default_factory=lambda: np.empty(0))
    now: FloatArray = field(default_factory=lambda: np.empty(0))
    chi_sq: FloatArray = field(default_factory=lambda: np.empty(0))
    anchor_s: FloatArray = field(default_factory=lambda: np.empty(0))
    anchor: FloatArray = field(default_factory=lambda: np.empty((0, 2)))
    anchor_new: BoolArray = field(default_factory=lambda: np.empty((0, 2), bool))
    sure: BoolArray = field(default_factory=lambda: np.empty(0, bool))
    offset: FloatArray = field(default_factory=lambda: np.empty((0, 2)))
    offsets: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    offset_s: FloatArray = field(default_factory=lambda: np.empty(0))
    offset_new: BoolArray = field(default_factory=lambda: np.empty((0, 2), bool))
    offset_chi_sq: FloatArray = field(default_factory=lambda: np.empty(0))
    log_offset: FloatArray = field(default_factory=lambda: np.empty(0))
    near_s: FloatArray = field(default_factory=lambda: np.empty(0))
    errors: FloatArray = field(default_factory=lambda: np.empty((0, WIDTH)))
    met: FloatArray = field(default_factory=lambda: np.empty((0, WIDTH)))
    parted: PartedPairs = field(default_factory=PartedPairs)

    def __len__(self) -> int:
        return len(self.first)

    @classmethod
    def of(
        cls,
        first: IntArray,
        second: IntArray,
        delta: FloatArray,
        covariances: tuple[FloatArray, FloatArray],
        lasting: tuple[FloatArray, FloatArray],
        instant_s: float,
    ) -> TrackPairs:
        """Pairs that meet now: δ (k, 2), covariances P_a, P_b and roots B_a, B_b (k, 2, 2). They have no past."""
        errors, total = _without_past(delta, covariances, lasting), covariances[0] + covariances[1]
        density, chi_sq = _density_and_distance(delta, total)
        never, none = np.full(len(first), np.nan), np.zeros(len(first))
        return cls(
            first, second, np.arange(len(first)), none, none, density, density, chi_sq,
            never, np.full_like(delta, np.nan), np.zeros(delta.shape, bool), np.zeros(len(first), bool),
            np.zeros_like(delta), np.zeros(len(first), np.int64), np.full(len(first), -np.inf),
            np.ones(delta.shape, bool), none, none, np.full(len(first), instant_s), errors,
        )  # fmt: skip

    def has(self, first: IntArray, second: IntArray) -> BoolArray:
        """(k,) whether pairs are among these."""
        return np.asarray(places_in(keys(self.first, self.second), keys(first, second)) >= 0)

    def with_(self, others: TrackPairs) -> TrackPairs:
        """These and others that meet now, in order; of those that have parted before, what was known then counts."""
        if not len(others):
            return self
        log_ratio, parted = self.parted.met(others.first, others.second)
        others = replace(others, log_ratio=others.log_ratio + log_ratio)
        met = np.concatenate([self.met, others.errors, others.met])
        both = self.stacked(replace(others, row=len(self.errors) + len(self.met) + others.row))
        return replace(both.take(np.argsort(keys(both.first, both.second), kind="stable")), met=met, parted=parted)

    def stepped(
        self, step: Step, reassigned: float, swaps: SwapRates, per_m2: float, tuning: Tuning = DEFAULT_TUNING
    ) -> tuple[TrackPairs, SwapRates]:
        """The pairs whose tracks are both in the step, after it, and what it shows of swaps.

        ``now`` is subtracted from the evidence of all reports, so that both can be added. A report may be of another
        object than its id says, with probability ε = ``reassigned``: x ← ln[(1−ε) eˣ + ε e^(best)], best that of the
        best rival, or of an id that goes to any other object: ln of how probable an object anywhere (``per_m2``) makes
        the report, by the track's own reports 1. Two tracks that keep apart are not one again for that reason.
        """
        a, b = step.find(self.first), step.find(self.second)
        unlike_s = step.instant_s - self.near_s
        recent, far = unlike_s <= tuning.pair_timeout_s, self.chi_sq > tuning.parted_chi_sq
        far &= unlike_s > tuning.parted_s
        rows = np.flatnonzero((a >= 0) & (b >= 0) & recent & ~far)
        a, b = a[rows], b[rows]
        updated, log_two = self._updated(step, rows, a, b, tuning)
        parting = PartedPairs(self.first[far], self.second[far], self.log_ratio[far], self.near_s[far])
        updated = replace(updated, parted=self.parted.on(step, parting, tuning))
        rivals = Rivals.of(a, b, step.source[a], step.source[b])
        weight = self.log_ratio[rows] + self.at_scan[rows]
        log_before, log_swapped, near = _swapped(self.log_ratio[rows], weight, log_two, step, (a, b), rivals, tuning)
        rate = np.column_stack([swaps.rate(step.source[track], tuning) for track in (b, a)])
        for side, track in ((0, b), (1, a)):
            weights = updated.log_ratio + updated.now, log_swapped[:, side] + updated.now
            swaps = swaps.updated(rivals.sides[side], step.source[track], *weights, near[:, side], tuning)
        # More than one may pass between two instants, and among more than two tracks.
        swapped = log_before, np.minimum(tuning.swap_caution * rate, max(tuning.swap_rates)) * near
        return updated._leaked(step, (a, b), rivals, reassigned, swapped, math.log(per_m2), tuning), swaps

    def _updated(
        self, step: Step, rows: IntArray, a: IntArray, b: IntArray, tuning: Tuning
    ) -> tuple[TrackPairs, FloatArray]:
        """The pairs ``rows`` after the motion of their tracks, places a and b in the step, and after its new reports:
        those of the first track, then of the second; and (k,) ln p of these if they are two objects."""
        k = len(rows)
        errors, log_reports, now, chi_sq = np.empty((k, WIDTH)), np.empty((k, 2)), np.empty(k), np.empty(k)
        pairs_stepped(
            self.errors, self.met, self.row[rows], a, b, step.last, step.moved, step.drift, step.slope, step.noise,
            step.shift, step.new_report, step.covariance, LEAST_M2, errors, log_reports, now, chi_sq,
        )  # fmt: skip
        # ln p of the reports if they are one object, in convoy, or each on its own way.
        log_one, log_together = log_reports.T
        log_apart, log_convoy = step.log_own[a] + step.log_own[b], self.log_convoy[rows]
        log_two = np.logaddexp(log_together + log_convoy, log_apart) - np.logaddexp(log_convoy, 0.0)
        gain, bound = log_one - log_two, tuning.convoy_log_odds
        is_new = np.column_stack([step.new_report[a], step.new_report[b]])
        new_report = is_new.any(axis=1)
        before, at_scan = self.log_ratio[rows], self.at_scan[rows]
        return TrackPairs(
            self.first[rows], self.second[rows], np.arange(k),
            np.clip(log_convoy + log_together - log_apart, -bound, bound),
            np.where(new_report, before + at_scan + gain - now, before), np.where(new_report, now, at_scan), now,
            chi_sq, self.anchor_s[rows], self.anchor[rows], self.anchor_new[rows] | is_new, self.sure[rows],
            self.offset[rows], self.offsets[rows], self.offset_s[rows], self.offset_new[rows] | is_new,
            self.offset_chi_sq[rows], self.log_offset[rows],
            np.where(chi_sq <= tuning.manoeuvre_chi_sq, step.instant_s, self.near_s[rows]), errors,
        ), log_two  # fmt: skip

    def _leaked(
        self, step: Step, tracks: tuple[IntArray, IntArray], rivals: Rivals, reassigned: float,
        swapped: tuple[FloatArray, FloatArray], log_density_anywhere: float, tuning: Tuning,
    ) -> TrackPairs:  # fmt: skip
        """After reports that may be of another object than their ids say; swapped : ln r before and the probability of
        a swap, (k, 2) each. The states are changed in place."""
        new_report = step.new_report[tracks[0]] | step.new_report[tracks[1]]
        agrees = self.chi_sq <= tuning.manoeuvre_chi_sq
        best_rival = rivals.most_other(np.where(agrees, self.log_ratio, -np.inf))
        best = np.maximum(best_rival, step.log_elsewhere(tracks, log_density_anywhere))
        log_stays = np.log1p(-reassigned - swapped[1].sum(axis=1)) + self.log_ratio
        # ln r is bounded, and so are its exponentials.
        log_changes = np.log(reassigned * np.exp(best) + (np.exp(swapped[0]) * swapped[1]).sum(axis=1))
        leaked = rivals.bounded(np.logaddexp(log_stays, log_changes), agrees, reassigned)
        anew = np.where(new_report, expit(log_changes - log_stays), 0.0)
        at = np.flatnonzero(anew > 1e-3)
        a, b = (track[at] for track in tracks)
        # The share of states without a past: the mean and covariance of the mixture.
        fresh = _without_past(
            step.here[a] - step.here[b], (step.covariance[a], step.covariance[b]), (step.lasting[a], step.lasting[b])
        )
        mix(self.errors, at, anew[at], fresh)
        self.log_convoy[at] *= 1.0 - anew[at]
        # Offsets of another object are no longer theirs.
        other = anew > tuning.offset_anew
        self.offsets[other], self.offset[other], self.log_offset[other] = 0, 0.0, 0.0
        return replace(self, log_ratio=np.where(new_report, leaked, self.log_ratio))

    def with_offsets(self, step: Step, correlation: ErrorCorrelation, tuning: Tuning = DEFAULT_TUNING) -> TrackPairs:
        """After the step, with the mean offsets δ̄ of the pairs that are due, and what these tell beyond the reports.

        Errors that are stated, or assumed for a kind of sensor, are often too large: then any object that keeps beside
        another is one with it. By the stated errors the offset δ̄ of one object is N(0, V). By those of the other n sure
        pairs of its two sources V is κ times as large, κ unknown: δ̄ has Student's t, of ν = ν₀ + 2n degrees of freedom
        and a scale matrix κ̂ V, κ̂ = (ν₀ + Σ δ̄ᵀ V⁻¹ δ̄) / ν; ν₀ stands for κ = 1. Only what makes δ̄ less probable counts:
        that stated errors may be too small is no reason to join what they part.

        Source: a normal variance with its conjugate prior (Gelman et al., Bayesian Data Analysis, section 2.6).
        """
        due = np.flatnonzero((step.instant_s - self.offset_s >= tuning.lasting_s) & self.offset_new.all(axis=1))
        if not len(due):
            return self
        out = replace(self, **{name: getattr(self, name).copy() for name in _OFFSETS})
        a, b = step.find(self.first), step.find(self.second)
        out.offsets[due] += 1
        out.offset[due] += (step.here[a[due]] - step.here[b[due]] - out.offset[due]) / out.offsets[due, None]
        out.offset_s[due], out.offset_new[due] = step.instant_s, False
        spread = LEAST_M2 * np.eye(2) + sum(
            correlation.of_mean(step.source[track], tuning.lasting_s, out.offsets[due], tuning)[:, None, None]
            * step.reported[track]
            for track in (a[due], b[due])
        )
        out.offset_chi_sq[due] = mahalanobis_sq(out.offset[due], spread)
        # One that is no pair in truth does not speak for many.
        votes = self.sure & (out.offsets >= tuning.known_offsets)
        value = np.where(votes, np.minimum(out.offset_chi_sq, tuning.manoeuvre_chi_sq), 0.0)
        sources = len(correlation.names)
        couple = np.minimum(step.source[a], step.source[b]) * sources + np.maximum(step.source[a], step.source[b])
        n = np.bincount(couple, votes, sources**2)[couple[due]] - votes[due]
        total = np.bincount(couple, value, sources**2)[couple[due]] - value[due]
        counted = np.minimum(1.0, tuning.most_offset_freedom / np.maximum(2.0 * n, 1.0))
        freedom = tuning.offset_freedom + counted * 2.0 * n
        kappa = (tuning.offset_freedom + counted * total) / freedom
        chi_sq = out.offset_chi_sq[due]
        student = -np.log(kappa) - 0.5 * (freedom + 2.0) * np.log1p(chi_sq / (freedom * kappa))
        known = (out.offsets[due] >= tuning.known_offsets) & (n > 0)
        out.log_offset[due] = np.where(known, np.minimum(student + 0.5 * chi_sq, 0.0), 0.0)
        return out

    def anchored(self, sure: IntArray, begin: BoolArray, instant_s: float, delta: FloatArray) -> TrackPairs:
        """With pairs (places ``sure``) that are surely one object at the instant, δ (m, 2) apart; ``begin`` : (m,)
        whether they are compared with what they are now."""
        anchor_s, anchor, anchor_new = self.anchor_s.copy(), self.anchor.copy(), self.anchor_new.copy()
        at, is_sure = sure[begin], np.zeros(len(self), bool)
        anchor_s[at], anchor[at], anchor_new[at] = instant_s, delta[begin], False
        is_sure[sure] = True
        return replace(self, anchor_s=anchor_s, anchor=anchor, anchor_new=anchor_new, sure=is_sure)


#: Columns that :meth:`TrackPairs.with_offsets` changes.
_OFFSETS = ("offset", "offsets", "offset_s", "offset_new", "offset_chi_sq", "log_offset")


def _swapped(
    log_ratio: FloatArray, weight: FloatArray, log_two: FloatArray, step: Step, tracks: tuple[IntArray, IntArray],
    rivals: Rivals, tuning: Tuning,
) -> tuple[FloatArray, FloatArray, FloatArray]:  # fmt: skip
    """(k, 2) ln r before the step of each pair's most probable rival, 0 for none, ln r of the pair itself if its ids
    were swapped with the rival's, and the probability of that for h = 1: of rivals with the same first track, and with
    the same second. log_ratio : (k,) before the step.

    After a swap the past is the rival's, ``weight`` (k,) by all reports before the step, and the new report is where
    the other track is, instead of where its own reports predict it: ``log_two`` (k,), less that of the other's report.
    Both count, or a rival whose last report was far off is excused from it, and rates of swaps grow without any.
    """
    log_before, log_swapped, near_both = np.zeros((3, len(weight), 2))
    for side, track in ((0, tracks[1]), (1, tracks[0])):
        best = rivals.best_other(weight, side)
        at = np.flatnonzero((best >= 0) & step.new_report[track])
        one, other = track[at], track[best[at]]
        apart = mahalanobis_sq(step.here[one] - step.here[other], step.covariance[one] + step.covariance[other])
        near = np.zeros(len(weight))
        near[at] = np.exp(-apart / tuning.swap_chi_sq)
        # The most probable one of a set swaps with one of the others at most, and each of these with it.
        leads = (best >= 0) & (weight >= weight[best])
        total = np.bincount(rivals.sides[side], np.where(leads, 0.0, near))[rivals.sides[side]]
        near_both[at, side] = np.where(leads, np.minimum(total, 1.0), near / np.maximum(total, 1.0))[at]
        log_before[at, side] = log_ratio[best[at]]
        log_swapped[at, side] = weight[best[at]] - (log_two - step.log_own[tracks[side]])[at]
    return log_before, log_swapped, near_both


def _without_past(
    delta: FloatArray, covariances: tuple[FloatArray, FloatArray], lasting: tuple[FloatArray, FloatArray]
) -> FloatArray:
    """(k, WIDTH) errors of pairs by δ = e_a − e_b + d alone."""
    out = np.empty((len(delta), WIDTH))
    pairs_anew(delta, *covariances, *lasting, out)
    return out


@dataclass(frozen=True)
class Rivals:
    """Pairs of which one at most is one object: a track with each of the tracks of one other source.

    sides : (k,) numbers of the two such sets that each pair is in.
    """

    sides: tuple[IntArray, IntArray]

    @classmethod
    def of(cls, first: IntArray, second: IntArray, one: IntArray, other: IntArray) -> Rivals:
        """Of tracks (k,), numbered from 0 without large gaps, and the sources that they are of (k,)."""
        sources = 1 + max(int(one.max(initial=0)), int(other.max(initial=0)))
        return cls((first * sources + other, second * sources + one))

    def best_other(self, values: FloatArray, side: int) -> IntArray:
        """(k,) the pair of the highest value in the set of each, itself not among them; −1 where there is none."""
        best = np.empty(len(values), np.int64)
        best_others(self.sides[side], values, best)
        return best

    def most_other(self, values: FloatArray) -> FloatArray:
        """(k,) the highest value of any rival of each pair, itself not among them; −∞ without one."""
        padded = np.append(values, -np.inf)
        best = [padded[self.best_other(values, side)] for side in range(2)]
        return np.asarray(np.maximum(*best))

    def most(self, values: FloatArray) -> FloatArray:
        """(k,) the highest value of any rival of each pair, itself among them."""
        out = values
        for rivals in self.sides:
            out = np.maximum(out, _most(rivals, values))
        return out

    def bounded(self, log_ratio: FloatArray, agrees: BoolArray, reassigned: float) -> FloatArray:
        """ln r between −2b and b = ln((1−ε)/ε), less the excess of the best rival, so that differences stay.

        agrees : (k,) whether the positions of the instant agree. Where they contradict the past, ln r of the past is
            large for that reason alone, and rivals do not pay for it.
        """
        bound = math.log((1.0 - reassigned) / reassigned)
        excess = np.maximum(self.most(np.where(agrees, log_ratio, -np.inf)) - bound, 0.0)
        return np.clip(log_ratio - excess, -2.0 * bound, bound)


@dataclass(frozen=True)
class SwapRates:
    """How often trackers swap near objects; log_probable : (S, r) ln of the probability of each rate, by source."""

    log_probable: FloatArray = field(default_factory=lambda: np.empty((0, 0)))

    def of_sources(self, kinds: Sequence[str], tuning: Tuning = DEFAULT_TUNING) -> SwapRates:
        """The same with the sources of these kinds, in their order; the first ones are here already."""
        rates = np.log(np.array(tuning.swap_rates))
        prior = -0.5 * ((rates - math.log(tuning.swap_rate)) / tuning.swap_sigma) ** 2
        never = np.where(rates == rates.min(), 0.0, -np.inf)
        new = [never if KINDS[kind].self_named else prior for kind in kinds[len(self.log_probable) :]]
        if not new:
            return self
        return SwapRates(np.concatenate([self.log_probable.reshape(-1, len(rates)), new]))

    def rate(self, source: IntArray, tuning: Tuning) -> FloatArray:
        """(n,) mean h of sources."""
        if not len(source):
            return np.empty(0)
        weight = np.exp(self.log_probable - self.log_probable.max(axis=1, initial=-np.inf, keepdims=True))
        return np.asarray((weight @ np.array(tuning.swap_rates) / weight.sum(axis=1))[source])

    def updated(
        self, rivals: IntArray, source: IntArray, log_stayed: FloatArray, log_swapped: FloatArray,
        near: FloatArray, tuning: Tuning,
    ) -> SwapRates:  # fmt: skip
        """After new reports: rivals : (k,) set of each pair, source : (k,) whose tracks it compares, ln of the pairs'
        weights by all reports, without a swap before the last one and with one, and its probability for h = 1."""
        n = int(rivals.max(initial=-1)) + 1
        sums, some, source_of = np.empty((3, n)), np.empty(n, bool), np.zeros(n, np.int64)
        swap_evidence(rivals, log_stayed, log_swapped, near, *sums, some)
        source_of[rivals] = source
        if not some.any():
            return self
        most, stayed, change = sums[:, some]
        # With probability p = h · near of a swap a pair weighs (1 − p) w + p w′, so the sum of a set is affine in h.
        log_sum = most + np.log(stayed + np.array(tuning.swap_rates)[:, None] * change)
        log_probable = self.log_probable.copy()
        for r in range(len(log_sum)):
            log_probable[:, r] += np.bincount(source_of[some], log_sum[r], len(log_probable))
        return SwapRates(log_probable - log_probable.max(axis=1, keepdims=True))


def with_manoeuvres(
    scan: Scan, track_of_record: IntArray, track_pairs: TrackPairs, log_ratio: FloatArray, per_m2: float
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

    track_of_record : (n,) numbers of the records' tracks, −1 for those that are new. track_pairs : of the instant
    before. log_ratio : (k,) ln r of the pairs then.
    """
    a, b = _places(track_of_record, np.stack([track_pairs.first, track_pairs.second]))
    partners = (
        (a >= 0) & (b >= 0) & (log_ratio + track_pairs.now >= math.log(per_m2) - math.log(scan.tuning.partner_odds))
    )
    a, b, log_ratio = a[partners], b[partners], log_ratio[partners]
    if not len(a):
        return scan
    delta, spread = scan.state[a, :2] - scan.state[b, :2], scan.covariance[a, :2, :2] + scan.covariance[b, :2, :2]
    log_usual, chi_sq = _density_and_distance(delta, spread)
    with np.errstate(divide="ignore"):
        # ln of the odds that there was a manoeuvre since the report.
        log_odds = np.log(np.expm1(np.maximum(scan.now.instant_s - scan.time_s, 0.0) / scan.tuning.manoeuvre_every_s))
    log_same = log_ratio + log_usual
    best = Rivals.of(a, b, scan.source[a], scan.source[b]).most(log_same)
    # Either of the two may have made the manoeuvre.
    own, other, k = np.append(a, b), np.append(b, a), np.tile(np.arange(len(a)), 2)
    # No covariance adds more to ln p than χ²/2, so that most records are not looked at any further.
    likely = np.bincount(own, 0.5 * chi_sq[k], len(scan)) + log_odds > 0.0
    own, other, k = own[likely[own]], other[likely[own]], k[likely[own]]
    if not len(own):
        return scan
    extra = manoeuvre_covariance(scan)
    log_density_moved = log_density(delta[k], spread[k] + extra[own, :2, :2])
    log_moved = log_odds[own] + log_ratio[k] + log_density_moved
    most_likely = np.maximum(log_same[k], log_moved)
    partner = most_likely == _most(own * len(scan.start) + scan.source[other], most_likely)
    log_manoeuvre = np.bincount(own[partner], (log_density_moved - log_usual[k])[partner], len(scan)) + log_odds
    manoeuvred = np.zeros(len(scan), bool)
    # No rival explains the other without a manoeuvre, and its partners in all sources together say that there was one.
    manoeuvred[own[(log_moved > best[k]) & (log_manoeuvre[own] > 0.0)]] = True
    if not manoeuvred.any():
        return scan
    extra = np.where(manoeuvred[:, None, None], extra, 0.0)
    return replace(scan.with_covariance(extra), manoeuvre_covariance=extra)


def manoeuvre_covariance(scan: Scan) -> FloatArray:
    """(n, 4, 4) D of every record; 0 where the speed of its objects is not known."""
    age = np.maximum(scan.now.instant_s - scan.time_s, 0.0)
    speed = np.where(np.isfinite(scan.speed_m_per_s), scan.speed_m_per_s, 0.0)
    v = np.where(scan.moving[:, None], scan.state[:, 2:], 0.0)
    change = v[:, :, None] * v[:, None, :] + speed[:, None, None] ** 2 * np.eye(2)
    change[speed == 0.0] = 0.0
    out = np.zeros((len(scan), 4, 4))
    out[:, :2, :2] = change * (age**2 / 3.0)[:, None, None]
    out[:, :2, 2:] = out[:, 2:, :2] = change * (age / 2.0)[:, None, None]
    out[:, 2:, 2:] = change
    return out


def _places(track_of_record: IntArray, number: IntArray) -> IntArray:
    """(…) places of tracks in a new scan, −1 for those that are not in it; track_of_record : (n,) of that."""
    order = np.argsort(track_of_record, kind="stable")
    at = places_in(track_of_record[order], number)
    return np.where(at >= 0, np.append(order, -1)[at], -1)


def _density_and_distance(delta: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(k,) ln N(Δ; 0, Σ) and χ²."""
    chi_sq, log_det = distance_and_log_determinant(delta, covariance)
    return -0.5 * (chi_sq + log_det + delta.shape[-1] * LOG_2PI), chi_sq


def _most(group: IntArray, values: FloatArray) -> FloatArray:
    """(k,) the highest value in the set of each."""
    best = np.full(int(group.max(initial=-1)) + 1, -np.inf)
    np.maximum.at(best, group, values)
    return best[group]

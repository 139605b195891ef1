"""Track pairs: the likelihood ratio, from all their reports, that two named tracks are one object.

Each new report of track a or b adds ln p(report | one object) − ln p(report | two objects), each given all previous
reports. A repeated report adds nothing. The hypotheses:

- One object: the positions differ only by their errors, δ = x_a − x_b = e_a − e_b. The errors evolve from report to
  report as in :mod:`sameas.picture.named_tracks`, so a residual counts only as far as previous residuals do not
  predict it.
- Two objects that move independently: each report is predicted by its own track.
- Two objects in convoy, moored side by side or one behind the other, at a constant offset d: δ = e_a − e_b + d. Their
  motion is the same; only an estimate of d different from 0 separates this hypothesis from one object.

The reports also weight the last two hypotheses against each other.

Id swaps: after a report, two tracks of one source at distance χ² have exchanged their ids with probability
h e^(−χ²/c), and with probability ε at any distance. A pair then has the history of its best rival and its errors are
unknown, so its state is a mixture of its own and of a pair without history. The rate h and the range c of a source are
estimated by how probable its reports are under each of several models (:class:`SwapRates`), and r is the mean over the
models, by their probability. With the mean rate instead, a history would be lost before enough reports have shown that
a tracker does not swap.

The state of a pair is the mean and covariance of (e_a, z_a, z_b) for one object, z the constant part of the errors, and
of (e_a, z_a, z_b, d) for a convoy.

Pairs that are far apart are no longer compared (:class:`DistantPairs`): their present positions rule out one object,
and further reports add no information. Their ln r is kept while they may come near each other again.

Source: METHOD 3.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.special import expit

from sameas.arrays import ABSENT, BoolArray, FloatArray, IntArray, places_in, taken
from sameas.gaussian import LOG_2PI, distance_and_log_determinant, log_density, mahalanobis_sq
from sameas.kernels.track_pairs import COVARIANCE, MEAN, WIDTH, best_others, mix, new_pair_errors, pairs_stepped
from sameas.picture.error_factors import MIN_M2, ErrorCorrelation
from sameas.picture.named_tracks import Step
from sameas.picture.tables import ColumnTable, Scan
from sameas.picture.tuning import DEFAULT_TUNING, Tuning
from sameas.tracks.kinds import KINDS


def keys(first: IntArray, second: IntArray) -> IntArray:
    """(k,) one sort key per pair: ordered by the first track, then by the second."""
    return (first << 32) | second


@dataclass(frozen=True)
class DistantPairs(ColumnTable):
    """Pairs of tracks that are far apart, (k,) each, ordered by :func:`keys`.

    first, second : numbers of the tracks, first < second. log_ratio : ln r of their reports before they separated.
    agreed_s : last time at which their positions agreed.
    """

    first: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    second: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    log_ratio: FloatArray = field(default_factory=lambda: np.empty(0))
    agreed_s: FloatArray = field(default_factory=lambda: np.empty(0))

    def __len__(self) -> int:
        return len(self.first)

    def advance(self, step: Step, new: DistantPairs, tuning: Tuning) -> DistantPairs:
        """The pairs after a step: with ``new`` ones, without those whose tracks ended or that have timed out."""
        pairs = self.stacked(new) if len(new) else self
        if not len(pairs):
            return self
        continues = (step.find(pairs.first) >= 0) & (step.find(pairs.second) >= 0)
        pairs = pairs.take(np.flatnonzero(continues & (step.instant_s - pairs.agreed_s <= tuning.pair_timeout_s)))
        return pairs.take(np.argsort(keys(pairs.first, pairs.second))) if len(new) else pairs

    def without(self, first: IntArray, second: IntArray) -> tuple[FloatArray, DistantPairs]:
        """(k,) the ln r of the given pairs, 0 for pairs that are not in the table; and the table without them."""
        at = places_in(keys(self.first, self.second), keys(first, second))
        remains = np.ones(len(self), bool)
        remains[at[at >= 0]] = False
        return np.append(self.log_ratio, 0.0)[at], self if remains.all() else self.take(np.flatnonzero(remains))


@dataclass(frozen=True)
class TrackPairs(ColumnTable):
    """Pairs of tracks at an instant, (k,) each, ordered by :func:`keys`.

    Attributes
    ----------
    first, second : numbers of the tracks, first < second.
    errors, new_errors : (n, WIDTH), (m, WIDTH) mean and covariance of (e_a, z_a, z_b) for one object and of
        (e_a, z_a, z_b, d) for a convoy, in the layout of :mod:`sameas.kernels.track_pairs`: of the pairs of the last
        step, and of the pairs added since. row : row of each pair in the two tables stacked.
    log_convoy : log-odds of convoy against independent motion, given two objects.
    log_ratio : ln r of the reports before the last one, bounded: see :meth:`stepped`. by_model : (k, r) how much larger
        it is under each of ``swap_models``.
    log_reported : ln N(δ; 0, P_a + P_b) at the last report of either track. log_now : the same at the instant.
    chi_sq : χ² of δ at the instant.
    anchor_s, anchor : (k,), (k, 2) time at which the pair first was sure or was last compared since, and δ then; NaN
        before.
    anchor_new : (k, 2) whether each track has a new report since. anchor_kept : (k, 2) ``Step.log_kept`` of both then.
        n_compared : (k,) number of comparisons.
    sure : whether the pair is surely one object.
    offset, n_offsets : (k, 2), (k,) mean and number of values of δ taken at least ``lasting_s`` apart. offset_s : time
        of the last one. offset_new : (k, 2) whether each track has a new report since. offset_chi_sq, log_offset : χ²
        of the mean by the stated errors, and its contribution to ln r; see :meth:`with_offsets`.
    agreed_s : last time at which the positions agreed. Pairs are dropped ``pair_timeout_s`` later: else two objects
        that pass once would be compared for ever.
    distant : the pairs that are too far apart to be compared.
    """

    WHOLE = frozenset({"errors", "new_errors", "distant"})
    first: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    second: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    row: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    log_convoy: FloatArray = field(default_factory=lambda: np.empty(0))
    log_ratio: FloatArray = field(default_factory=lambda: np.empty(0))
    log_reported: FloatArray = field(default_factory=lambda: np.empty(0))
    log_now: FloatArray = field(default_factory=lambda: np.empty(0))
    chi_sq: FloatArray = field(default_factory=lambda: np.empty(0))
    anchor_s: FloatArray = field(default_factory=lambda: np.empty(0))
    anchor: FloatArray = field(default_factory=lambda: np.empty((0, 2)))
    anchor_new: BoolArray = field(default_factory=lambda: np.empty((0, 2), bool))
    anchor_kept: FloatArray = field(default_factory=lambda: np.empty((0, 2)))
    n_compared: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    sure: BoolArray = field(default_factory=lambda: np.empty(0, bool))
    offset: FloatArray = field(default_factory=lambda: np.empty((0, 2)))
    n_offsets: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    offset_s: FloatArray = field(default_factory=lambda: np.empty(0))
    offset_new: BoolArray = field(default_factory=lambda: np.empty((0, 2), bool))
    offset_chi_sq: FloatArray = field(default_factory=lambda: np.empty(0))
    log_offset: FloatArray = field(default_factory=lambda: np.empty(0))
    agreed_s: FloatArray = field(default_factory=lambda: np.empty(0))
    by_model: FloatArray = field(default_factory=lambda: np.empty((0, len(DEFAULT_TUNING.swap_models[0]))))
    errors: FloatArray = field(default_factory=lambda: np.empty((0, WIDTH)))
    new_errors: FloatArray = field(default_factory=lambda: np.empty((0, WIDTH)))
    distant: DistantPairs = field(default_factory=DistantPairs)

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
        """New pairs, without history: δ (k, 2), covariances P_a, P_b and roots B_a, B_b, (k, 2, 2) each."""
        errors, total = _without_history(delta, covariances, lasting), covariances[0] + covariances[1]
        log_n, chi_sq = _log_density_and_chi_sq(delta, total)
        k = len(first)
        zero = np.zeros(k)
        return cls(
            first, second, np.arange(k), zero, zero, log_n, log_n, chi_sq,
            np.full(k, np.nan), np.full_like(delta, np.nan), np.zeros(delta.shape, bool), np.zeros(delta.shape),
            np.zeros(k, np.int64), np.zeros(k, bool),
            np.zeros_like(delta), np.zeros(k, np.int64), np.full(k, -np.inf),
            np.ones(delta.shape, bool), zero, zero, np.full(k, instant_s),
            np.zeros((k, len(DEFAULT_TUNING.swap_models[0]))), errors,
        )  # fmt: skip

    def has(self, first: IntArray, second: IntArray) -> BoolArray:
        """(k,) whether each of the given pairs is in the table."""
        return np.asarray(places_in(keys(self.first, self.second), keys(first, second)) >= 0)

    def with_(self, others: TrackPairs) -> TrackPairs:
        """The table with new pairs; pairs that were distant before keep their previous ln r."""
        if not len(others):
            return self
        log_ratio, distant = self.distant.without(others.first, others.second)
        others = replace(others, log_ratio=others.log_ratio + log_ratio)
        new_errors = np.concatenate([self.new_errors, others.errors, others.new_errors])
        both = self.stacked(replace(others, row=len(self.errors) + len(self.new_errors) + others.row))
        both = both.take(np.argsort(keys(both.first, both.second), kind="stable"))
        return replace(both, new_errors=new_errors, distant=distant)

    def with_errors(
        self, rows: IntArray, delta: FloatArray, before: tuple[FloatArray, FloatArray],
        covariances: tuple[FloatArray, FloatArray], factors: tuple[FloatArray, FloatArray],
    ) -> TrackPairs:  # fmt: skip
        """The table with other errors of the pairs ``rows`` (k,): δ (k, 2), P of both tracks before and after, (k, 2,
        2) each, and by which the 1σ of their reports are multiplied, (k,) each.

        The last positions are judged by the new P. What is known of (e_a, z_a, z_b) of one object stays known, in the
        new units: given δ, the means are P_a S⁻¹ δ and ± Bᵀ S⁻¹ δ with S = P_a + P_b, and the covariance of e_a is
        P_a S⁻¹ P_b; they change as these do. Without what is known, a constant error would be evidence once more.
        ln r of the previous reports stays, and so does the offset of a convoy, which does not depend on the size of
        errors.
        """
        errors = np.concatenate([self.errors, self.new_errors])[self.row]
        (a, b), (new_a, new_b) = ([np.trace(p, axis1=1, axis2=2) for p in pair] for pair in (before, covariances))
        of_sum = (a + b) / (new_a + new_b)
        means = np.stack([new_a / a * of_sum, *(factor * of_sum for factor in factors)])
        scales = np.stack([np.sqrt(new_a / a * new_b / b * of_sum), np.ones(len(rows)), np.ones(len(rows))])
        means, scales = np.repeat(means, 2, axis=0).T, np.repeat(scales, 2, axis=0).T
        errors[rows, slice(*MEAN)] *= means
        v, w = np.tril_indices(means.shape[1])
        errors[rows, slice(*COVARIANCE)] *= scales[:, v] * scales[:, w]
        log_now, chi_sq = _log_density_and_chi_sq(delta, covariances[0] + covariances[1])
        changed = {name: getattr(self, name).copy() for name in ("log_reported", "log_now", "chi_sq")}
        out = replace(self, row=np.arange(len(self)), errors=errors, new_errors=np.empty((0, WIDTH)), **changed)
        out.log_reported[rows] += log_now - self.log_now[rows]
        out.log_now[rows], out.chi_sq[rows] = log_now, chi_sq
        return out

    def without_history(
        self, rows: IntArray, delta: FloatArray, covariances: tuple[FloatArray, FloatArray],
        lasting: tuple[FloatArray, FloatArray],
    ) -> TrackPairs:  # fmt: skip
        """The table with the errors of the pairs ``rows`` (k,) as of new pairs, for sources whose correlation of errors
        is estimated anew; arguments as of :meth:`of`.

        Errors that were thought three times too large, and to persist, became large constant ones in these pairs, and
        the errors of later reports would count as evidence against them. ln r stays.
        """
        if not len(rows):
            return self
        errors = np.concatenate([self.errors, self.new_errors])[self.row]
        errors[rows] = _without_history(delta, covariances, lasting)
        return replace(self, row=np.arange(len(self)), errors=errors, new_errors=np.empty((0, WIDTH)))

    def without_evidence(
        self, rows: IntArray, delta: FloatArray, covariances: tuple[FloatArray, FloatArray],
        lasting: tuple[FloatArray, FloatArray],
    ) -> TrackPairs:  # fmt: skip
        """The table with the pairs ``rows`` (k,) as of new ones: errors as by :meth:`without_history`, and no ln r."""
        if not len(rows):
            return self
        out = self.without_history(rows, delta, covariances, lasting)
        changed = {name: getattr(out, name).copy() for name in ("log_ratio", "log_convoy", "by_model")}
        for column in changed.values():
            column[rows] = 0.0
        return replace(out, **changed)

    def stepped(
        self, step: Step, reassigned: float, swaps: SwapRates, per_m2: float, tuning: Tuning = DEFAULT_TUNING
    ) -> tuple[TrackPairs, SwapRates]:
        """The pairs after a step, if both tracks are in it, and the updated swap rates.

        ln r excludes the present positions (``log_now`` is subtracted), so that the evidence of the instant can be
        added. With probability ε = ``reassigned`` a report is of another object than that of its id:
        x ← ln[(1−ε) eˣ + ε e^(best)]. best is the larger of two: ln r of the best rival, and the case that the id went
        to any other object, ln of the probability of the report of an object anywhere (``per_m2``) relative to that by
        the track's own reports. The second case cannot join two tracks that stay apart.
        """
        a, b = step.find(self.first), step.find(self.second)
        disagree_s = step.instant_s - self.agreed_s
        recent, distant = disagree_s <= tuning.pair_timeout_s, self.chi_sq > tuning.distant_chi_sq
        distant &= disagree_s > tuning.distant_s
        rows = np.flatnonzero((a >= 0) & (b >= 0) & recent & ~distant)
        a, b = a[rows], b[rows]
        updated, log_two = self._updated(step, rows, a, b, tuning)
        newly_distant = DistantPairs(
            self.first[distant], self.second[distant], self.log_ratio[distant], self.agreed_s[distant]
        )
        updated = replace(updated, distant=self.distant.advance(step, newly_distant, tuning))
        rivals = Rivals.of(a, b, step.source[a], step.source[b])
        by_source = by_source_order((a, b), (step.source[a], step.source[b]))
        log_weight = self.log_ratio[rows] + self.log_reported[rows]
        swap = _swap_hypotheses(log_weight, log_two, step, by_source, rivals, tuning)
        exchanged = step.source[by_source[1]], step.source[by_source[0]]
        log_ratio, by_model, p_swapped, swaps = swaps.updated(
            (self.log_ratio[rows], self.log_reported[rows], updated.by_model), updated.log_ratio, updated.log_now,
            swap, rivals, exchanged, math.log(per_m2), tuning,
        )  # fmt: skip
        updated = replace(updated, log_ratio=log_ratio, by_model=by_model)
        return updated._with_id_changes(step, (a, b), rivals, reassigned, p_swapped, math.log(per_m2), tuning), swaps

    def _updated(
        self, step: Step, rows: IntArray, a: IntArray, b: IntArray, tuning: Tuning
    ) -> tuple[TrackPairs, FloatArray]:
        """The pairs ``rows``, whose tracks are rows a and b of the step, after the motion of the tracks and their new
        reports, first those of track a, then those of b; and (k,) ln p of the reports given two objects."""
        k = len(rows)
        errors, log_reports, log_now, chi_sq = np.empty((k, WIDTH)), np.empty((k, 2)), np.empty(k), np.empty(k)
        pairs_stepped(
            self.errors, self.new_errors, self.row[rows], a, b, step.last, step.moved, step.drift, step.slope,
            step.noise, step.shift, step.new_report, step.covariance, MIN_M2, errors, log_reports, log_now, chi_sq,
        )  # fmt: skip
        log_one, log_in_convoy = log_reports.T
        log_independent, log_convoy = step.log_own[a] + step.log_own[b], self.log_convoy[rows]
        log_two = np.logaddexp(log_in_convoy + log_convoy, log_independent) - np.logaddexp(log_convoy, 0.0)
        gain, bound = log_one - log_two, tuning.convoy_log_odds
        is_new = np.column_stack([step.new_report[a], step.new_report[b]])
        new_report = is_new.any(axis=1)
        log_ratio, log_reported = self.log_ratio[rows], self.log_reported[rows]
        return TrackPairs(
            self.first[rows], self.second[rows], np.arange(k),
            np.clip(log_convoy + log_in_convoy - log_independent, -bound, bound),
            np.where(new_report, log_ratio + log_reported + gain - log_now, log_ratio),
            np.where(new_report, log_now, log_reported), log_now,
            chi_sq, self.anchor_s[rows], self.anchor[rows], self.anchor_new[rows] | is_new,
            self.anchor_kept[rows], self.n_compared[rows], self.sure[rows],
            self.offset[rows], self.n_offsets[rows], self.offset_s[rows], self.offset_new[rows] | is_new,
            self.offset_chi_sq[rows], self.log_offset[rows],
            np.where(chi_sq <= tuning.manoeuvre_chi_sq, step.instant_s, self.agreed_s[rows]),
            self.by_model[rows], errors,
        ), log_two  # fmt: skip

    def _with_id_changes(
        self, step: Step, tracks: tuple[IntArray, IntArray], rivals: Rivals, reassigned: float,
        p_swapped: FloatArray, log_density_anywhere: float, tuning: Tuning,
    ) -> TrackPairs:  # fmt: skip
        """The pairs, allowing that new reports are of other objects than those of their ids.

        p_swapped : (k,) probability that ids were swapped, which ln r includes. The states are changed in place.
        """
        new_report = step.new_report[tracks[0]] | step.new_report[tracks[1]]
        agrees = self.chi_sq <= tuning.manoeuvre_chi_sq
        best_rival = rivals.max_other(np.where(agrees, self.log_ratio, -np.inf))
        best = np.maximum(best_rival, step.log_elsewhere(tracks, log_density_anywhere))
        log_same, log_reassigned = np.log1p(-reassigned) + self.log_ratio, math.log(reassigned) + best
        log_ratio = rivals.bounded(np.logaddexp(log_same, log_reassigned), agrees, reassigned)
        p_same = (1.0 - p_swapped) * expit(log_same - log_reassigned)
        p_changed = np.where(new_report, 1.0 - p_same, 0.0)
        at = np.flatnonzero(p_changed > 1e-3)
        a, b = (track[at] for track in tracks)
        without_history = _without_history(
            step.here[a] - step.here[b], (step.covariance[a], step.covariance[b]), (step.lasting[a], step.lasting[b])
        )
        mix(self.errors, at, p_changed[at], without_history)
        self.log_convoy[at] *= 1.0 - p_changed[at]
        restart = p_changed > tuning.offset_restart
        self.n_offsets[restart], self.offset[restart], self.log_offset[restart] = 0, 0.0, 0.0
        return replace(self, log_ratio=np.where(new_report, log_ratio, self.log_ratio))

    def with_offsets(self, step: Step, correlation: ErrorCorrelation, tuning: Tuning = DEFAULT_TUNING) -> TrackPairs:
        """The pairs with their mean offsets δ̄ updated where due, and the contribution of δ̄ to ln r.

        Stated or assumed errors are often too large; then any two objects that stay close would pass as one. By the
        stated errors, δ̄ of one object is N(0, V). The other n sure pairs of the two sources give a factor κ on V, with
        uncertainty: δ̄ has Student's t with ν = ν₀ + 2n degrees of freedom and scale matrix κ̂ V,
        κ̂ = (ν₀ + Σ δ̄ᵀ V⁻¹ δ̄) / ν; the prior, worth ν₀, is κ = 1. The contribution is at most 0: errors larger than
        stated do not join two tracks.

        Source: a normal variance with its conjugate prior (Gelman et al., Bayesian Data Analysis, section 2.6).
        """
        due = np.flatnonzero((step.instant_s - self.offset_s >= tuning.lasting_s) & self.offset_new.all(axis=1))
        if not len(due):
            return self
        out = replace(self, **{name: getattr(self, name).copy() for name in _OFFSETS})
        a, b = step.find(self.first), step.find(self.second)
        out.n_offsets[due] += 1
        out.offset[due] += (step.here[a[due]] - step.here[b[due]] - out.offset[due]) / out.n_offsets[due, None]
        out.offset_s[due], out.offset_new[due] = step.instant_s, False
        covariance = MIN_M2 * np.eye(2) + sum(
            correlation.of_mean(step.source[track], tuning.lasting_s, out.n_offsets[due], tuning)[:, None, None]
            * step.reported[track]
            for track in (a[due], b[due])
        )
        out.offset_chi_sq[due] = mahalanobis_sq(out.offset[due], covariance)
        # χ² is clipped so that one false pair cannot dominate the sum over sure pairs.
        counts = self.sure & (out.n_offsets >= tuning.min_offsets)
        clipped = np.where(counts, np.minimum(out.offset_chi_sq, tuning.manoeuvre_chi_sq), 0.0)
        n_sources = len(correlation.names)
        sources = np.minimum(step.source[a], step.source[b]) * n_sources + np.maximum(step.source[a], step.source[b])
        n = np.bincount(sources, counts, n_sources**2)[sources[due]] - counts[due]
        total = np.bincount(sources, clipped, n_sources**2)[sources[due]] - clipped[due]
        discount = np.minimum(1.0, tuning.max_offset_freedom / np.maximum(2.0 * n, 1.0))
        nu = tuning.offset_freedom + discount * 2.0 * n
        kappa = (tuning.offset_freedom + discount * total) / nu
        chi_sq = out.offset_chi_sq[due]
        student = -np.log(kappa) - 0.5 * (nu + 2.0) * np.log1p(chi_sq / (nu * kappa))
        known = (out.n_offsets[due] >= tuning.min_offsets) & (n > 0)
        out.log_offset[due] = np.where(known, np.minimum(student + 0.5 * chi_sq, 0.0), 0.0)
        return out

    def anchored(
        self, sure: IntArray, restart: BoolArray, instant_s: float, delta: FloatArray, log_kept: FloatArray
    ) -> TrackPairs:
        """The pairs with new anchors for later comparison.

        sure : (m,) rows of the pairs that are surely one object at the instant. delta, log_kept : (m, 2) their δ, and
        ``Step.log_kept`` of both tracks. restart : (m,) whether the next comparison is with this δ.
        """
        out = replace(self, **{name: getattr(self, name).copy() for name in _ANCHORS}, sure=np.zeros(len(self), bool))
        at = sure[restart]
        out.n_compared[at] += ~np.isnan(out.anchor_s[at])
        out.anchor_s[at], out.anchor[at], out.anchor_new[at] = instant_s, delta[restart], False
        out.anchor_kept[at], out.sure[sure] = log_kept[restart], True
        return out


#: Columns that :meth:`TrackPairs.anchored` changes.
_ANCHORS = ("anchor_s", "anchor", "anchor_new", "anchor_kept", "n_compared")
#: Columns that :meth:`TrackPairs.with_offsets` changes.
_OFFSETS = ("offset", "n_offsets", "offset_s", "offset_new", "offset_chi_sq", "log_offset")


def _swap_hypotheses(
    log_weight: FloatArray, log_two: FloatArray, step: Step, tracks: tuple[IntArray, IntArray], rivals: Rivals,
    tuning: Tuning,
) -> tuple[IntArray, FloatArray, FloatArray]:  # fmt: skip
    """Of each pair and its most probable rival with the same first track, and with the same second, (k, 2) each: the
    rival (ABSENT without one), ln p of the pair's new reports apart from the position if their ids were swapped, and,
    (k, 2, c), the probability of a swap for h = 1 and each range.

    tracks : (k,), (k,) of both sources, as of :func:`by_source_order`.
    log_weight : (k,) ln r with the positions of the last reports. log_two : (k,) ln p of the new reports given two
    objects.

    After a swap the pair has the rival's ``log_weight``, and its new report agrees with the other track rather than
    with the prediction of its own: the subtracted term is ``log_two`` less that of the other track's report. Leaving
    out either would favour a rival whose last report was an outlier, and inflate the estimated swap rates.
    """
    k, ranges = len(log_weight), np.array(tuning.swap_ranges)
    rival, log_report, p_swap = np.full((k, 2), ABSENT), np.zeros((k, 2)), np.zeros((k, 2, len(ranges)))
    for side, track in ((0, tracks[1]), (1, tracks[0])):
        best = rivals.best_other(log_weight, side)
        at = np.flatnonzero((best >= 0) & step.new_report[track])
        one, other = track[at], track[best[at]]
        chi_sq = mahalanobis_sq(
            taken(step.here, one) - taken(step.here, other),
            taken(step.covariance, one) + taken(step.covariance, other),
        )
        # The most probable pair of a set swaps with at most one of the others, and each of these only with it.
        leads, sets = log_weight[at] >= log_weight[best[at]], rivals.sides[side][at]
        for c, p in enumerate(np.exp(-chi_sq / ranges[:, None])):
            total = np.bincount(sets, np.where(leads, 0.0, p))[sets]
            p_swap[at, side, c] = np.where(leads, np.minimum(total, 1.0), p / np.maximum(total, 1.0))
        rival[at, side] = best[at]
        log_report[at, side] = -(log_two - step.log_own[tracks[side]])[at]
    return rival, log_report, p_swap


def _without_history(
    delta: FloatArray, covariances: tuple[FloatArray, FloatArray], lasting: tuple[FloatArray, FloatArray]
) -> FloatArray:
    """(k, WIDTH) errors of pairs given only δ = e_a − e_b + d of the instant."""
    out = np.empty((len(delta), WIDTH))
    new_pair_errors(delta, *covariances, *lasting, out)
    return out


def by_source_order(pair: tuple[IntArray, IntArray], source: tuple[IntArray, IntArray]) -> tuple[IntArray, IntArray]:
    """(k,), (k,) both values of each pair, that of the source with the lower number first."""
    in_order = source[0] <= source[1]
    return np.where(in_order, *pair), np.where(in_order, *pair[::-1])


@dataclass(frozen=True)
class Rivals:
    """Sets of mutually exclusive pairs: one track with each of the tracks of one other source.

    sides : (k,), (k,) numbers of the two sets of each pair: with the same track of the one source, and with the same of
    the other, in the order of :func:`by_source_order`.
    """

    sides: tuple[IntArray, IntArray]

    @classmethod
    def of(cls, first: IntArray, second: IntArray, one: IntArray, other: IntArray) -> Rivals:
        """first, second : (k,) numbers of the tracks, from 0 without large gaps. one, other : (k,) their sources."""
        sources = 1 + max(int(one.max(initial=0)), int(other.max(initial=0)))
        # A track that began later may be the second of one pair and the first of another.
        (first, second), (one, other) = (
            by_source_order(pair, (one, other)) for pair in ((first, second), (one, other))
        )
        return cls((first * sources + other, second * sources + one))

    def best_other(self, values: FloatArray, side: int) -> IntArray:
        """(k,) the other pair with the highest value in each pair's set; ABSENT without one."""
        best = np.empty(len(values), np.int64)
        best_others(self.sides[side], values, best)
        return best

    def max_other(self, values: FloatArray) -> FloatArray:
        """(k,) the highest value of any rival of each pair; −∞ without one."""
        padded = np.append(values, -np.inf)
        best = [padded[self.best_other(values, side)] for side in range(2)]
        return np.asarray(np.maximum(*best))

    def most(self, values: FloatArray) -> FloatArray:
        """(k,) the highest value of each pair and its rivals."""
        out = values
        for side in self.sides:
            out = np.maximum(out, _group_maximum(side, values))
        return out

    def level(self, values: FloatArray, agrees: BoolArray) -> FloatArray:
        """(k,) the mean of the highest values with the one and with the other track, each pair's own included.

        agrees : (k,) whether the positions of the instant agree; other rivals are ignored.
        """
        agreeing = np.where(agrees, values, -np.inf)
        first, second = (np.maximum(values, _group_maximum(side, agreeing)) for side in self.sides)
        return np.asarray(0.5 * (first + second))

    def most_free(self, values: FloatArray, agrees: BoolArray) -> FloatArray:
        """(k,) the highest value of each pair and its rivals, without rivals whose other track has a better pair.

        agrees : (k,) whether a pair may be such a better one.
        """
        out, padded = values, np.append(np.where(agrees, values, -np.inf), -np.inf)
        for side in range(2):
            better = padded[self.best_other(padded[:-1], 1 - side)]
            out = np.maximum(out, _group_maximum(self.sides[side], np.where(better > values, -np.inf, values)))
        return out

    def with_joint_swaps(
        self, log_ratio: FloatArray, by_model: FloatArray, log_odds: FloatArray,
        swaps: Callable[[int, IntArray, IntArray], tuple[IntArray, FloatArray, FloatArray]],
    ) -> FloatArray:  # fmt: skip
        """(k,) ln r, bounded as far as a swap of ids may have exchanged two pairs at once.

        A swap of b and b′ exchanges (a, b), (a′, b′) for (a, b′), (a′, b). As ln r of each pair allows for it alone,
        the sum of both is bounded by 2 ln[(1 − p) / p], twice what one swap permits. So the difference Δ of ln r of a
        pair and of its best rival becomes ½ ln{[(1 − p) e^(2Δ) + p] / [(1 − p) + p e^(2Δ)]}, under each swap model.

        by_model : (k, r) how much larger ln r is under each model. log_odds : (k,) of each pair against chance, −∞
        where the positions of the instant disagree. swaps : gives, of pairs (n,) and their rivals (n,) with the same
        first track (0) or the same second one (1), those that may have been exchanged, (m,), p under each model, (m,
        r), and the probability of each model, (m, r).
        """
        out = log_ratio.copy()
        padded = np.append(log_odds, -np.inf)
        for side in range(2):
            best = self.best_other(log_odds, side)
            partner = padded[self.best_other(log_odds, 1 - side)]
            at = np.flatnonzero(padded[best] > -np.inf)  # ABSENT, no rival, reads the last
            # Without a pair (a′, b′) or (a′, b), the swap exchanges one pair only, and ln r allows for it.
            at = at[np.maximum(partner[at], partner[best[at]]) > 0.0]
            which, p, probability = swaps(side, at, best[at])
            at, rival = at[which], best[at[which]]
            change = (log_ratio[at] - log_ratio[rival])[:, None] + by_model[at] - by_model[rival]
            odds_against = np.exp(np.clip(-change, -300.0, 300.0))
            exchanged = 1.0 / (1.0 + odds_against**2)
            exchanged += p * (1.0 - 2.0 * exchanged)
            # ½ logit is the logit of the square roots' ratio.
            root, rest = np.sqrt(exchanged), np.sqrt(1.0 - exchanged)
            joint, alone = root / (root + rest), 1.0 / (1.0 + odds_against)
            out[at] += np.log(np.einsum("nr,nr->n", probability, joint) / np.einsum("nr,nr->n", probability, alone))
        return out

    def bounded(self, log_ratio: FloatArray, agrees: BoolArray, reassigned: float) -> FloatArray:
        """(k,) ln r within −2b … b, b = ln((1−ε)/ε); the excess of the best rival over b is subtracted, which keeps
        differences between rivals.

        agrees : (k,) whether the positions of the instant agree. Where they do not, ln r of the history is large only
            because it leaves them out; such pairs do not lower their rivals.
        """
        bound = math.log((1.0 - reassigned) / reassigned)
        excess = np.maximum(self.most(np.where(agrees, log_ratio, -np.inf)) - bound, 0.0)
        return np.clip(log_ratio - excess, -2.0 * bound, bound)


@dataclass(frozen=True)
class SwapRates:
    """How often trackers swap the ids of near objects: the probability of each of ``swap_models``, per source.

    log_probable : (S, r) its ln, up to a constant.
    """

    log_probable: FloatArray = field(default_factory=lambda: np.empty((0, 0)))

    def of_sources(self, kinds: Sequence[str], tuning: Tuning = DEFAULT_TUNING) -> SwapRates:
        """The rates with new sources at their prior; kinds : of all sources, those already known first.

        Sources that name themselves (AIS, ADS-B) have the lowest rate for certain.
        """
        rates = np.log(tuning.swap_models[0])
        prior = -0.5 * ((rates - math.log(tuning.swap_rate)) / tuning.swap_sigma) ** 2
        never = np.where(rates == rates.min(), 0.0, -np.inf)
        new = [never if KINDS[kind].self_named else prior for kind in kinds[len(self.log_probable) :]]
        if not new:
            return self
        return SwapRates(np.concatenate([self.log_probable.reshape(-1, len(rates)), new]))

    @property
    def probability(self) -> FloatArray:
        """(S, r) of each model."""
        weight = np.exp(self.log_probable - self.log_probable.max(axis=1, initial=-np.inf, keepdims=True))
        return np.asarray(weight / weight.sum(axis=1, keepdims=True))

    @property
    def may_swap(self) -> BoolArray:
        """(S,) whether a source may swap ids; self-named ones never do."""
        return np.asarray(np.isfinite(self.log_probable).all(axis=1))

    @property
    def probable(self) -> IntArray:
        """The models that are not improbable for every source that may swap ids."""
        return np.flatnonzero((self.probability[self.may_swap] > MIN_PROBABILITY).any(axis=0))

    def rate(self, source: IntArray, tuning: Tuning) -> FloatArray:
        """(n,) mean h of each source."""
        return np.asarray((self.probability @ tuning.swap_models[0])[source]) if len(source) else np.empty(0)

    def of_pairs(self, sources: Sequence[IntArray]) -> FloatArray:
        """(k, r) probability of each model for pairs of tracks of two sources: the mean of those that may swap ids."""
        weight = np.where(self.may_swap, 1.0, 1e-9)
        one, other = (weight[source][:, None] for source in sources)
        probability = self.probability
        return np.asarray((one * probability[sources[0]] + other * probability[sources[1]]) / (one + other))

    def updated(
        self, before: tuple[FloatArray, FloatArray, FloatArray], log_ratio: FloatArray, log_now: FloatArray,
        swap: tuple[IntArray, FloatArray, FloatArray], rivals: Rivals, sources: tuple[IntArray, IntArray],
        log_density_anywhere: float, tuning: Tuning,
    ) -> tuple[FloatArray, FloatArray, FloatArray, SwapRates]:  # fmt: skip
        """Of pairs after new reports: ln r and how much larger it is under each model, (k,) and (k, r), and the
        probability that ids were swapped, (k,); and the updated rates.

        A swap of near objects is not evident from one report, only from many later ones. So ln r of every pair is kept
        for each model, and the likelihood of a model is the probability of the reports given its ln r: for a set of
        pairs, the sum of their weights, including that of no pair, divided by the sum before the reports.

        After a swap, ln r counts the present positions only, not the rival's last ones: where errors are constant, both
        have the same error. The likelihood of a model counts both: see :func:`_swap_hypotheses`.

        before : (k,), (k,), (k, r) ln r, ln N of the positions of the last reports, and how much larger ln r was under
        each model. log_ratio, log_now : (k,) ln r with the new reports without swaps, and ln N of the present
        positions. swap : of :func:`_swap_hypotheses`. sources : (k,), (k,) sources of the tracks that differ within the
        sets of ``rivals.sides``. log_density_anywhere : ln of the density of objects anywhere.
        """
        log_old, log_reported, by_model = before
        p_swapped = np.zeros(len(log_ratio))
        at = np.flatnonzero((swap[2] > MIN_SWAP).any(axis=(1, 2)))
        if not len(at):
            return log_ratio, by_model, p_swapped, self
        (rival, log_report, near), now = (part[at] for part in swap), log_now[at]
        rates, of_range = tuning.swap_models[0], np.repeat(np.arange(len(tuning.swap_ranges)), len(tuning.swap_rates))
        log_stays = (log_ratio[at] + now)[:, None] + by_model[at]
        # Weights of the pairs relative to that without swaps: with the present positions only, and with both.
        p_stays, swapped, swapped_by_both = np.ones_like(log_stays), np.zeros_like(log_stays), np.zeros_like(log_stays)
        for side in range(2):
            h = np.where(self.may_swap[sources[side][at]][:, None], rates, rates.min())
            p = np.minimum(h * near[:, side, of_range], MAX_SWAP)
            p_stays -= p
            log_rival = (log_old[rival[:, side]] + now)[:, None] + by_model[rival[:, side]] - log_stays
            p *= np.exp(np.minimum(log_rival, MAX_LOG_WEIGHT))
            swapped += p
            log_last = log_reported[rival[:, side]] + log_report[:, side]
            swapped_by_both += p * np.exp(np.minimum(log_last, MAX_LOG_WEIGHT))[:, None]
        swaps = self._with_reports(
            (log_old + log_reported)[at, None] + by_model[at], log_stays + np.log(p_stays + swapped_by_both),
            tuple(side[at] for side in rivals.sides), tuple(source[at] for source in sources), log_density_anywhere,
        )  # fmt: skip
        log_after, probability = log_stays + np.log(p_stays + swapped), swaps.of_pairs(tuple(s[at] for s in sources))
        top = log_after.max(axis=1)
        log_mean = top + np.log((probability * np.exp(log_after - top[:, None])).sum(axis=1))
        log_ratio, by_model = log_ratio.copy(), by_model.copy()
        log_ratio[at] = log_mean - now
        by_model[at] = np.clip(log_after - log_mean[:, None], -MAX_DIFFERENCE, MAX_DIFFERENCE)
        p_swapped[at] = (probability * swapped / (p_stays + swapped)).sum(axis=1)
        return log_ratio, by_model, p_swapped, swaps

    def _with_reports(
        self, log_before: FloatArray, log_after: FloatArray, sides: Sequence[IntArray], sources: Sequence[IntArray],
        log_density_anywhere: float,
    ) -> SwapRates:  # fmt: skip
        """The rates after reports; log_before, log_after : (n, r) weights of pairs. sides, sources : (n,), (n,) sets of
        pairs, and sources of the tracks that differ within them."""
        log_probable = self.log_probable.copy()
        # The sets of both tracks of the other source contain the same swap.
        share = 0.5
        for side, source in zip(sides, sources, strict=True):
            _, first, label = np.unique(side, return_index=True, return_inverse=True)
            before, after = (_log_sums(label, weights, log_density_anywhere) for weights in (log_before, log_after))
            np.add.at(log_probable, source[first], share * (after - before))
        return SwapRates(log_probable - log_probable.max(axis=1, keepdims=True))


#: Minimum probability, for h = 1, of a swap that is counted, and maximum probability of one.
MIN_SWAP, MAX_SWAP = 1e-3, 0.4
#: Less probable models of swaps do not change the mean over models.
MIN_PROBABILITY = 1e-4
#: Maximum difference of ln r under one model of swaps from ln of the mean, and maximum ln of a relative weight.
MAX_DIFFERENCE, MAX_LOG_WEIGHT = 20.0, 300.0


def _log_sums(label: IntArray, values: FloatArray, least: float) -> FloatArray:
    """(n, r) ln of the sums of exp(values) (k, r) per label (k,) from 0, and of exp(least).

    One rate at a time: for rows of several, ``ufunc.at`` takes ten times as long.
    """
    rates = np.ascontiguousarray(values.T)
    top = np.full((len(rates), int(label.max(initial=-1)) + 1), least)
    for highest, terms in zip(top, rates, strict=True):
        np.maximum.at(highest, label, terms)
    total = np.exp(least - top)
    for one, terms in zip(total, np.exp(rates - np.take(top, label, axis=1)), strict=True):
        np.add.at(one, label, terms)
    return np.asarray((top + np.log(total)).T)


def with_manoeuvres(
    scan: Scan,
    track_of_record: IntArray,
    previous: Scan | None,
    track_pairs: TrackPairs,
    log_ratio: FloatArray,
    per_m2: float,
    swap_rate: FloatArray,
    together: Callable[[IntArray, IntArray], BoolArray],
) -> Scan:
    """The scan with larger covariances for reports whose objects have manoeuvred since.

    A report is moved to the instant by a random walk of its velocity, which fits nearly all motion. But a ferry that
    stops at a pier is 6σ from her prediction within a minute; by the normal distribution her AIS report from before the
    stop then matches no object, whatever its history with the radar's track. So a report of a named track may be
    followed by a manoeuvre, on average one every ``manoeuvre_every_s``, and of a stationary object one every
    ``rest_s``: at an unknown time since the report, the velocity v changed to that of any object, 0 ± s per axis, which
    adds the covariance

        D = (s² I + v vᵀ) ⊗ [t²/3, t/2; t/2, 1],   t the report's age.

    A manoeuvre is assumed where the report's partners, one track of each other source, are jointly more probable with D
    than without by more than the prior odds against a manoeuvre, and no rival explains their reports without one.
    Tracks that never were one object need none: without a manoeuvre, they are as probable as two objects by chance. A
    rival that only passes does not: its own partner is where it should be. An assumed manoeuvre stays in the past of
    its report until the partners favour the prediction again. A radar too coarse to resolve the manoeuvre does not
    outvote one that does. The position stays as reported; only the covariance grows, for evidence, memory and fused
    states alike.

    track_of_record : (n,) numbers of the records' tracks, ABSENT for new ones. previous : the scan of the previous
    instant. track_pairs, log_ratio : its pairs, and (k,) their ln r. swap_rate : (S,) h of the scan's sources, 0 for
    new ones.
    together : gives of numbers of tracks, (n,) and (n,), whether each two were one object before.
    """
    assumed = _assumed_before(scan, previous)
    a, b = _places(track_of_record, np.stack([track_pairs.first, track_pairs.second]))
    log_limit = math.log(per_m2) - math.log(scan.tuning.partner_odds)
    partners = (a >= 0) & (b >= 0) & (log_ratio + track_pairs.log_now >= log_limit)
    a, b, log_ratio = a[partners], b[partners], log_ratio[partners]
    if not len(a):
        return _with_manoeuvres_of(scan, assumed)
    delta, total = scan.state[a, :2] - scan.state[b, :2], scan.covariance[a, :2, :2] + scan.covariance[b, :2, :2]
    log_steady, chi_sq = _log_density_and_chi_sq(delta, total)
    log_odds = _log_manoeuvre_odds(scan)
    log_pair_steady = log_ratio + log_steady
    # Either of the two may have manoeuvred.
    own, other, k = np.append(a, b), np.append(b, a), np.tile(np.arange(len(a)), 2)
    # No covariance raises ln p by more than χ²/2, which excludes most records early.
    has_partner = np.bincount(own, minlength=len(scan)) > 0
    possible = np.bincount(own, 0.5 * chi_sq[k], len(scan)) + log_odds > 0.0
    assumed &= possible | ~has_partner
    own, other, k = own[possible[own]], other[possible[own]], k[possible[own]]
    if not len(own):
        return _with_manoeuvres_of(scan, assumed)
    log_apart = np.where(together(track_of_record[own], track_of_record[other]), -np.inf, math.log(per_m2))
    rivals = Rivals.of(a, b, scan.source[a], scan.source[b])
    # Where a swap of ids is more probable than a manoeuvre, a rival may have the history of its better pair.
    free = rivals.most_free(log_pair_steady, chi_sq <= scan.tuning.manoeuvre_chi_sq)
    is_swap = np.exp(log_odds[own]) < swap_rate[scan.source[other]]
    best = np.maximum(np.where(is_swap, rivals.most(log_pair_steady)[k], free[k]), log_apart)
    extra = manoeuvre_covariance(scan)
    log_with_d = log_density(delta[k], total[k] + extra[own, :2, :2])
    log_pair_with_d = log_odds[own] + log_ratio[k] + log_with_d
    log_pair = np.maximum(log_pair_steady[k], log_pair_with_d)
    is_partner = log_pair == _group_maximum(own * len(scan.start) + scan.source[other], log_pair)
    gain = log_ratio[k] + log_with_d - np.maximum(log_pair_steady[k], log_apart)
    log_manoeuvre = np.bincount(own[is_partner], gain[is_partner], len(scan)) + log_odds
    assumed &= (log_manoeuvre > 0.0) | ~has_partner
    # No rival explains the other record without a manoeuvre, and the partners of all sources jointly favour one.
    assumed[own[(log_pair_with_d > best) & (log_manoeuvre[own] > 0.0)]] = True
    return _with_manoeuvres_of(scan, assumed)


def _log_manoeuvre_odds(scan: Scan) -> FloatArray:
    """(n,) ln of the prior odds of a manoeuvre since each report."""
    age = np.maximum(scan.now.instant_s - scan.time_s, 0.0)
    rest_s = np.array([feed.tuning.rest_s for feed in scan.now.feeds])[scan.source]
    since = [-np.expm1(-age / every_s) for every_s in (scan.tuning.manoeuvre_every_s, rest_s)]
    p = (1.0 - scan.p_stationary) * since[0] + scan.p_stationary * since[1]
    with np.errstate(divide="ignore"):
        return np.asarray(np.log(p) - np.log1p(-p))


def _assumed_before(scan: Scan, previous: Scan | None) -> BoolArray:
    """(n,) whether a manoeuvre since the same report was assumed in the previous scan."""
    out = np.zeros(len(scan), bool)
    if previous is None:
        return out
    assumed = previous.manoeuvre_covariance[:, 0, 0] > 0.0
    names = [description.name for description in previous.now.descriptions]
    for s, description in enumerate(scan.now.descriptions):
        if assumed.any() and description.name in names:
            t = names.index(description.name)
            before = np.arange(previous.start[t], previous.start[t + 1])
            before, records = before[assumed[before]], slice(scan.start[s], scan.start[s + 1])
            out[records] = np.isin(scan.row[records], previous.row[before])
    return out


def _with_manoeuvres_of(scan: Scan, manoeuvred: BoolArray) -> Scan:
    """The scan with D added to the covariances of the records (n,) whose objects have manoeuvred."""
    if not manoeuvred.any():
        return scan
    extra = np.where(manoeuvred[:, None, None], manoeuvre_covariance(scan), 0.0)
    return replace(scan.with_covariance(extra), manoeuvre_covariance=extra)


def manoeuvre_covariance(scan: Scan) -> FloatArray:
    """(n, 4, 4) D of each record; 0 where the speed of its objects is unknown."""
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
    """(…) the record of each track in a scan, ABSENT without one; track_of_record : (n,) of that scan."""
    order = np.argsort(track_of_record, kind="stable")
    at = places_in(track_of_record[order], number)
    return np.where(at >= 0, np.append(order, ABSENT)[at], ABSENT)


def _log_density_and_chi_sq(delta: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(k,) ln N(Δ; 0, Σ) and χ²."""
    chi_sq, log_det = distance_and_log_determinant(delta, covariance)
    return -0.5 * (chi_sq + log_det + delta.shape[-1] * LOG_2PI), chi_sq


def _group_maximum(group: IntArray, values: FloatArray) -> FloatArray:
    """(k,) the highest value in each one's group."""
    best = np.full(int(group.max(initial=-1)) + 1, -np.inf)
    np.maximum.at(best, group, values)
    return best[group]

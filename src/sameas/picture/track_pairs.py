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

Two tracks of one source may have exchanged their ids after a report (:mod:`sameas.picture.id_swaps`). A pair then has
the history of its best rival and its errors are unknown, so its state is a mixture of its own and of a pair without
history.

The state of a pair is the mean and covariance of (e_a, z_a, z_b) for one object, z the constant part of the errors, and
of (e_a, z_a, z_b, d) for a convoy.

Pairs that are far apart are no longer compared (:class:`DistantPairs`): their present positions rule out one object,
and further reports add no information. Their ln r is kept while they may come near each other again.

Source: METHOD 3.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from scipy.special import expit

from sameas.arrays import BoolArray, ColumnTable, FloatArray, IntArray, over_columns, taken
from sameas.gaussian import log_density_and_distance, mahalanobis_sq
from sameas.kernels.track_pairs import COVARIANCE, MEAN, WIDTH, mix, new_pair_errors, pairs_stepped
from sameas.kernels.tracks import places_of
from sameas.picture.error_correlation import MANOEUVRE_CHI_SQ, MIN_M2, ErrorCorrelation
from sameas.picture.id_swaps import SWAP_MODELS, Rivals, SwapRates, by_source_order, swap_hypotheses
from sameas.picture.named_tracks import Step
from sameas.picture.tuning import DEFAULT_TUNING, Tuning

LASTING_S = 60.0  # time between two comparisons of a sure pair, to estimate lasting shares
MIN_OFFSETS = 3  # a mean offset of two tracks is used from this many differences LASTING_S apart on
#: Prior weight of the stated errors against the offsets of sure pairs, in degrees of freedom, and maximum weight of the
#: latter, since hulls differ.
OFFSET_FREEDOM, MAX_OFFSET_FREEDOM = 4.0, 30.0
OFFSET_RESTART = 0.1  # a mean offset restarts if the ids were swapped or reassigned with at least this probability
#: Two tracks are not compared while their χ² is above ``distant_chi_sq``, once their positions have not agreed for this
#: time; their history is kept for when they are near again.
DISTANT_S = 20.0
#: The history of two tracks of which one has no report is kept for so long since they agreed (chosen): a radar that
#: misses an object for some scans shows it again under its number, and gives the number to another one later.
ABSENT_S = 60.0


def keys(first: IntArray, second: IntArray) -> IntArray:
    """(k,) one sort key per pair: ordered by the first track, then by the second."""
    return (first << 32) | second


@dataclass(frozen=True)
class DistantPairs(ColumnTable):
    """Pairs of tracks that are far apart, or of which one has no report, (k,) each, ordered by :func:`keys`.

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
        restarted = np.isin(pairs.first, step.restarted) | np.isin(pairs.second, step.restarted)
        kept_s = np.where(continues, tuning.pair_timeout_s, ABSENT_S)
        pairs = pairs.take(np.flatnonzero(~restarted & (step.instant_s - pairs.agreed_s <= kept_s)))
        return pairs.take(np.argsort(keys(pairs.first, pairs.second))) if len(new) else pairs

    def returned(self, number: IntArray, step: Step) -> tuple[IntArray, IntArray]:
        """(k,), (k,) both tracks of the pairs that are all among the tracks ``number`` of an instant, ascending, and
        not all in the step to it: one is seen again."""
        at = [places_of(number, track) for track in (self.first, self.second)]
        continues = (step.find(self.first) >= 0) & (step.find(self.second) >= 0)
        back = np.flatnonzero((at[0] >= 0) & (at[1] >= 0) & ~continues)
        return at[0][back], at[1][back]

    def without(self, first: IntArray, second: IntArray) -> tuple[FloatArray, DistantPairs]:
        """(k,) the ln r of the given pairs, 0 for pairs that are not in the table; and the table without them."""
        at = places_of(keys(self.first, self.second), keys(first, second))
        remains = np.ones(len(self), bool)
        remains[at[at >= 0]] = False
        return np.append(self.log_ratio, 0.0)[at], self if remains.all() else self.take(np.flatnonzero(remains))


@dataclass(frozen=True)
class TrackPairs(ColumnTable):
    """Pairs of tracks at an instant, (k,) each, ordered by :func:`keys`.

    first, second : numbers of the tracks, first < second.
    errors, new_errors : (n, WIDTH), (m, WIDTH) mean and covariance of (e_a, z_a, z_b) for one object and of
        (e_a, z_a, z_b, d) for a convoy, in the layout of :mod:`sameas.kernels.track_pairs`: of the pairs of the last
        step, and of the pairs added since. row : row of each pair in the two tables stacked.
    log_convoy : log-odds of convoy against independent motion, given two objects.
    log_ratio : ln r of the reports before the last one, bounded: see :meth:`stepped`. by_model : (k, r) how much larger
        it is under each of ``SWAP_MODELS``.
    log_met : the part of it that comes from where both were before they met, which no estimate of errors refutes.
    log_reported : ln N(δ; 0, P_a + P_b) at the last report of either track. log_now : the same at the instant.
    chi_sq : χ² of δ at the instant.
    anchor_s, anchor : (k,), (k, 2) time at which the pair first was sure or was last compared since, and δ then; NaN
        before.
    anchor_new : (k, 2) whether each track has a new report since. anchor_kept : (k, 2) ``Step.log_kept`` of both then.
        n_compared : (k,) number of comparisons.
    sure : whether the pair is surely one object.
    offset, n_offsets : (k, 2), (k,) mean and number of values of δ taken at least ``LASTING_S`` apart. offset_s : time
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
    log_met: FloatArray = field(default_factory=lambda: np.empty(0))
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
    by_model: FloatArray = field(default_factory=lambda: np.empty((0, len(SWAP_MODELS[0]))))
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
        log_met: FloatArray | float = 0.0,
    ) -> TrackPairs:
        """New pairs, without history: δ (k, 2), covariances P_a, P_b and roots B_a, B_b, (k, 2, 2) each.

        log_met : (k,) ln r of where the tracks were before (:meth:`sameas.picture.named_tracks.NamedTracks.log_met`).
        """
        errors, total = _without_history(delta, covariances, lasting), covariances[0] + covariances[1]
        log_n, chi_sq = log_density_and_distance(delta, total)
        k = len(first)
        zero, log_met = np.zeros(k), np.full(k, log_met)
        return cls(
            first=first, second=second, row=np.arange(k), log_convoy=zero, log_ratio=log_met, log_met=log_met,
            log_reported=log_n,
            log_now=log_n, chi_sq=chi_sq, anchor_s=np.full(k, np.nan), anchor=np.full_like(delta, np.nan),
            anchor_new=np.zeros(delta.shape, bool), anchor_kept=np.zeros(delta.shape), n_compared=np.zeros(k, np.int64),
            sure=np.zeros(k, bool), offset=np.zeros_like(delta), n_offsets=np.zeros(k, np.int64),
            offset_s=np.full(k, -np.inf), offset_new=np.ones(delta.shape, bool), offset_chi_sq=zero, log_offset=zero,
            agreed_s=np.full(k, instant_s), by_model=np.zeros((k, len(SWAP_MODELS[0]))), errors=errors,
        )  # fmt: skip

    def has(self, first: IntArray, second: IntArray) -> BoolArray:
        """(k,) whether each of the given pairs is in the table."""
        return np.asarray(places_of(keys(self.first, self.second), keys(first, second)) >= 0)

    def with_(self, others: TrackPairs) -> TrackPairs:
        """The table with new pairs; pairs that were distant before keep their previous ln r."""
        if not len(others):
            return self
        log_ratio, distant = self.distant.without(others.first, others.second)
        others = others.changed(log_ratio=others.log_ratio + log_ratio)
        new_errors = np.concatenate([self.new_errors, others.errors, others.new_errors])
        both = self.stacked(others.changed(row=len(self.errors) + len(self.new_errors) + others.row))
        both = both.take(np.argsort(keys(both.first, both.second), kind="stable"))
        return both.changed(new_errors=new_errors, distant=distant)

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
        log_now, chi_sq = log_density_and_distance(delta, covariances[0] + covariances[1])
        changed = {name: getattr(self, name).copy() for name in ("log_reported", "log_now", "chi_sq")}
        out = self.changed(row=np.arange(len(self)), errors=errors, new_errors=np.empty((0, WIDTH)), **changed)
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
        return self.changed(row=np.arange(len(self)), errors=errors, new_errors=np.empty((0, WIDTH)))

    def without_evidence(
        self, rows: IntArray, delta: FloatArray, covariances: tuple[FloatArray, FloatArray],
        lasting: tuple[FloatArray, FloatArray],
    ) -> TrackPairs:  # fmt: skip
        """The table with the pairs ``rows`` (k,) as of new ones: errors as by :meth:`without_history`, and ln r as when
        they met."""
        if not len(rows):
            return self
        out = self.without_history(rows, delta, covariances, lasting)
        changed = {name: getattr(out, name).copy() for name in ("log_ratio", "log_convoy", "by_model")}
        for column in changed.values():
            column[rows] = 0.0
        changed["log_ratio"][rows] = self.log_met[rows]
        return out.changed(**changed)

    def stepped(self, step: Step, swaps: SwapRates, per_m2: float, tuning: Tuning) -> tuple[TrackPairs, SwapRates]:
        """The pairs after a step, if both tracks are in it, and the updated swap rates.

        ln r excludes the present positions (``log_now`` is subtracted), so that the evidence of the instant can be
        added. With probability ε = ``report_reassigned`` a report is of another object than that of its id:
        x ← ln[(1−ε) eˣ + ε e^(best)]. best is the larger of two: ln r of the best rival, and the case that the id went
        to any other object, ln of the probability of the report of an object anywhere (``per_m2``) relative to that by
        the track's own reports. The second case cannot join two tracks that stay apart.
        """
        compared = self._compared(step, tuning)
        return self._stepped(step, compared, np.empty((len(compared[0]), WIDTH)), swaps, per_m2, tuning)

    def looked_ahead(self, step: Step, swaps: SwapRates, per_m2: float, tuning: Tuning) -> tuple[TrackPairs, SwapRates]:
        """As :meth:`stepped`, for an instant alone: the pairs have no ``errors``, and cannot be stepped again."""
        return self._stepped(step, self._compared(step, tuning), np.empty((0, WIDTH)), swaps, per_m2, tuning)

    def _compared(self, step: Step, tuning: Tuning) -> tuple[IntArray, IntArray, IntArray, BoolArray]:
        """The rows of the pairs that are compared at a step, those of their tracks, and (n,) which are too distant, or
        have a track without a report."""
        a, b = step.find(self.first), step.find(self.second)
        disagree_s, present = step.instant_s - self.agreed_s, (a >= 0) & (b >= 0)
        recent, distant = disagree_s <= tuning.pair_timeout_s, self.chi_sq > tuning.distant_chi_sq
        distant = ~present | distant & (disagree_s > DISTANT_S)
        rows = np.flatnonzero(recent & ~distant)
        return rows, a[rows], b[rows], distant

    def _stepped(
        self, step: Step, compared: tuple[IntArray, IntArray, IntArray, BoolArray], errors: FloatArray,
        swaps: SwapRates, per_m2: float, tuning: Tuning,
    ) -> tuple[TrackPairs, SwapRates]:  # fmt: skip
        """As :meth:`stepped`. errors : (k, WIDTH) is written and kept; (0, WIDTH) for none."""
        rows, a, b, distant = compared
        updated, log_two = self._updated(step, rows, a, b, errors, tuning)
        newly_distant = DistantPairs(
            self.first[distant], self.second[distant], self.log_ratio[distant], self.agreed_s[distant]
        )
        rivals = Rivals.of(a, b, step.source[a], step.source[b])
        by_source = by_source_order((a, b), (step.source[a], step.source[b]))
        log_weight = self.log_ratio[rows] + self.log_reported[rows]
        swap = swap_hypotheses(log_weight, log_two, step, by_source, rivals)
        exchanged = step.source[by_source[1]], step.source[by_source[0]]
        log_ratio, by_model, p_swapped, swaps = swaps.updated(
            (self.log_ratio[rows], self.log_reported[rows], updated.by_model), updated.log_ratio, updated.log_now,
            swap, rivals, exchanged, math.log(per_m2),
        )  # fmt: skip
        updated = updated.changed(
            log_ratio=log_ratio, by_model=by_model, distant=self.distant.advance(step, newly_distant, tuning)
        )
        return updated._with_id_changes(step, (a, b), rivals, p_swapped, math.log(per_m2), tuning), swaps

    def _updated(
        self, step: Step, rows: IntArray, a: IntArray, b: IntArray, errors: FloatArray, tuning: Tuning
    ) -> tuple[TrackPairs, FloatArray]:
        """The pairs ``rows``, whose tracks are rows a and b of the step, after the motion of the tracks and their new
        reports, first those of track a, then those of b; and (k,) ln p of the reports given two objects.

        errors : (k, WIDTH) is written and kept; (0, WIDTH) for none.
        """
        k = len(rows)
        log_reports, log_now, chi_sq = np.empty((k, 2)), np.empty(k), np.empty(k)
        pairs_stepped(
            self.errors, self.new_errors, self.row[rows], a, b, step.last, step.moved, step.drift, step.slope,
            step.noise, step.shift, step.new_report, step.covariance, MIN_M2, errors, log_reports, log_now, chi_sq,
        )  # fmt: skip
        log_one, log_in_convoy = log_reports.T
        log_independent, log_convoy = step.log_own[a] + step.log_own[b], self.log_convoy[rows]
        log_two = np.logaddexp(log_in_convoy + log_convoy, log_independent) - np.logaddexp(log_convoy, 0.0)
        gain, bound = log_one - log_two, tuning.convoy_log_odds
        is_new = np.column_stack([step.new_report[a], step.new_report[b]])
        new_report = over_columns(np.logical_or, is_new)
        log_ratio, log_reported = self.log_ratio[rows], self.log_reported[rows]
        # These are those of before if all pairs continue, as they mostly do.
        column = {name: getattr(self, name) for name in _FIXED}
        if k < len(self):
            column = {name: taken(values, rows) for name, values in column.items()}
        return TrackPairs(
            **column, row=np.arange(k),
            log_convoy=np.clip(log_convoy + log_in_convoy - log_independent, -bound, bound),
            log_ratio=np.where(new_report, log_ratio + log_reported + gain - log_now, log_ratio),
            log_reported=np.where(new_report, log_now, log_reported), log_now=log_now, chi_sq=chi_sq,
            anchor_new=taken(self.anchor_new, rows) | is_new, offset=taken(self.offset, rows),
            n_offsets=self.n_offsets[rows], offset_new=taken(self.offset_new, rows) | is_new,
            log_offset=self.log_offset[rows],
            agreed_s=np.where(chi_sq <= MANOEUVRE_CHI_SQ, step.instant_s, self.agreed_s[rows]),
            by_model=taken(self.by_model, rows), errors=errors,
        ), log_two  # fmt: skip

    def _with_id_changes(
        self, step: Step, tracks: tuple[IntArray, IntArray], rivals: Rivals,
        p_swapped: FloatArray, log_density_anywhere: float, tuning: Tuning,
    ) -> TrackPairs:  # fmt: skip
        """The pairs, allowing that new reports are of other objects than those of their ids.

        p_swapped : (k,) probability that ids were swapped, which ln r includes. The states are changed in place.
        """
        new_report = step.new_report[tracks[0]] | step.new_report[tracks[1]]
        agrees = self.chi_sq <= MANOEUVRE_CHI_SQ
        best_rival = rivals.max_other(np.where(agrees, self.log_ratio, -np.inf))
        best = np.maximum(best_rival, step.log_elsewhere(tracks, log_density_anywhere))
        log_same = np.log1p(-tuning.report_reassigned) + self.log_ratio
        log_reassigned = math.log(tuning.report_reassigned) + best
        log_ratio = rivals.bounded(np.logaddexp(log_same, log_reassigned), agrees, tuning)
        p_same = (1.0 - p_swapped) * expit(log_same - log_reassigned)
        p_changed = np.where(new_report, 1.0 - p_same, 0.0)
        if len(self.errors):
            at = np.flatnonzero(p_changed > 1e-3)
            a, b = (track[at] for track in tracks)
            without_history = _without_history(
                taken(step.here, a) - taken(step.here, b), (taken(step.covariance, a), taken(step.covariance, b)),
                (taken(step.lasting, a), taken(step.lasting, b)),
            )  # fmt: skip
            mix(self.errors, at, p_changed[at], without_history)
            self.log_convoy[at] *= 1.0 - p_changed[at]
        restart = p_changed > OFFSET_RESTART
        self.n_offsets[restart], self.offset[restart], self.log_offset[restart] = 0, 0.0, 0.0
        return self.changed(log_ratio=np.where(new_report, log_ratio, self.log_ratio))

    def with_offsets(
        self, step: Step, correlation: ErrorCorrelation, tuning: Tuning = DEFAULT_TUNING, *, least: int = 1
    ) -> TrackPairs:
        """The pairs with their mean offsets δ̄ updated where due, and the contribution of δ̄ to ln r.

        least : offsets that would be of fewer values are not updated.

        Stated or assumed errors are often too large; then any two objects that stay close would pass as one. By the
        stated errors, δ̄ of one object is N(0, V). The other n sure pairs of the two sources give a factor κ on V, with
        uncertainty: δ̄ has Student's t with ν = ν₀ + 2n degrees of freedom and scale matrix κ̂ V,
        κ̂ = (ν₀ + Σ δ̄ᵀ V⁻¹ δ̄) / ν; the prior, worth ν₀, is κ = 1. The contribution is at most 0: errors larger than
        stated do not join two tracks.

        Source: a normal variance with its conjugate prior (Gelman et al., Bayesian Data Analysis, section 2.6).
        """
        is_due = step.instant_s - self.offset_s >= LASTING_S
        is_due &= self.n_offsets + 1 >= least
        due = np.flatnonzero(is_due & over_columns(np.logical_and, self.offset_new))
        if not len(due):
            return self
        out = self.changed(**{name: getattr(self, name).copy() for name in _OFFSETS})
        a, b = step.find(self.first), step.find(self.second)
        out.n_offsets[due] += 1
        tracks = np.stack([a[due], b[due]])
        here, offset = taken(step.here, tracks), taken(out.offset, due)
        out.offset[due] = offset + (here[0] - here[1] - offset) / out.n_offsets[due, None]
        out.offset_s[due], out.offset_new[due] = step.instant_s, False
        share = correlation.of_mean(step.source[tracks], LASTING_S, out.n_offsets[due], tuning)
        covariance = MIN_M2 * np.eye(2) + sum(share[:, :, None, None] * taken(step.reported, tracks))
        out.offset_chi_sq[due] = mahalanobis_sq(out.offset[due], covariance)
        # χ² is clipped so that one false pair cannot dominate the sum over sure pairs.
        counts = self.sure & (out.n_offsets >= MIN_OFFSETS)
        clipped = np.where(counts, np.minimum(out.offset_chi_sq, MANOEUVRE_CHI_SQ), 0.0)
        n_sources = len(correlation.names)
        sources = np.minimum(step.source[a], step.source[b]) * n_sources + np.maximum(step.source[a], step.source[b])
        n = np.bincount(sources, counts, n_sources**2)[sources[due]] - counts[due]
        total = np.bincount(sources, clipped, n_sources**2)[sources[due]] - clipped[due]
        discount = np.minimum(1.0, MAX_OFFSET_FREEDOM / np.maximum(2.0 * n, 1.0))
        nu = OFFSET_FREEDOM + discount * 2.0 * n
        kappa = (OFFSET_FREEDOM + discount * total) / nu
        chi_sq = out.offset_chi_sq[due]
        student = -np.log(kappa) - 0.5 * (nu + 2.0) * np.log1p(chi_sq / (nu * kappa))
        known = (out.n_offsets[due] >= MIN_OFFSETS) & (n > 0)
        out.log_offset[due] = np.where(known, np.minimum(student + 0.5 * chi_sq, 0.0), 0.0)
        return out

    def anchored(
        self, sure: IntArray, restart: BoolArray, instant_s: float, delta: FloatArray, log_kept: FloatArray
    ) -> TrackPairs:
        """The pairs with new anchors for later comparison.

        sure : (m,) rows of the pairs that are surely one object at the instant. delta, log_kept : (m, 2) their δ, and
        ``Step.log_kept`` of both tracks. restart : (m,) whether the next comparison is with this δ.
        """
        out = self.changed(**{name: getattr(self, name).copy() for name in _ANCHORS}, sure=np.zeros(len(self), bool))
        at = sure[restart]
        out.n_compared[at] += ~np.isnan(out.anchor_s[at])
        out.anchor_s[at], out.anchor[at], out.anchor_new[at] = instant_s, delta[restart], False
        out.anchor_kept[at], out.sure[sure] = log_kept[restart], True
        return out


#: Columns that no method changes in place, but for those that copy them.
_FIXED = (
    "first", "second", "log_met", "anchor_s", "anchor", "anchor_kept", "n_compared", "sure", "offset_s",
    "offset_chi_sq",
)  # fmt: skip
#: Columns that :meth:`TrackPairs.anchored` changes.
_ANCHORS = ("anchor_s", "anchor", "anchor_new", "anchor_kept", "n_compared")
#: Columns that :meth:`TrackPairs.with_offsets` changes.
_OFFSETS = ("offset", "n_offsets", "offset_s", "offset_new", "offset_chi_sq", "log_offset")


def _without_history(
    delta: FloatArray, covariances: tuple[FloatArray, FloatArray], lasting: tuple[FloatArray, FloatArray]
) -> FloatArray:
    """(k, WIDTH) errors of pairs given only δ = e_a − e_b + d of the instant."""
    out = np.empty((len(delta), WIDTH))
    new_pair_errors(delta, *covariances, *lasting, out)
    return out

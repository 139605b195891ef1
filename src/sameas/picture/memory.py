"""Memory: the evidence of previous scans that two named tracks are one object.

Two tracks that agreed for ten minutes are not separated because noise brings another track nearer for one antenna
rotation. :class:`TrackMemory` is updated from instant to instant; :meth:`TrackMemory.rule` is a rule for
:func:`sameas.identify_many`, to be added to those of the instant:

    memory = memory.advance(scan)
    found = identify_many(now.sources, rule=now.rule() + now.identity() + memory.rule(), region=now.region)
    memory = memory.with_pairs(found.pooled)

Its log-likelihood ratio is that of all reports (:mod:`sameas.picture.track_pairs`) minus that of the two positions of
the instant, so the sum counts each report once. It is bounded by −2b and b = ln((1−ε)/ε), with ε the probability that a
report is of another object than that of its id (ids are reused, and swapped where two targets cross), so that a wrong
picture corrects itself. The stated lasting errors are checked against the mean offsets of pairs that are surely one
object (:meth:`sameas.picture.track_pairs.TrackPairs.with_offsets`). Records without an id have no memory; that of a
track ends with its reports.

A pair that passes the gate for the first time has no history; :meth:`TrackMemory.first_contact` is the rule for pairs
that were never sure: the velocities of both records, and the kinds of their targets (:class:`FirstContact`).

Track existence (:class:`TrackExistence`) is the probability that a named track is of a real object, by its duration.
False echoes start tracks too: a tracker that detects the same patch of sea four times in a row gives it a number. Such
tracks end soon; tracks of real objects continue until the object is lost. The durations of a source's tracks are a
mixture of two exponentials with means T₀ of false and T₁ of real tracks. The share of real tracks is w among those that
begin later than the source's first scan, and another among those present at it. For a track that continues after a
duration ℓ,

    ln P(real) / P(false) = ln w / (1 − w) + ℓ (1/T₀ − 1/T₁).

This is Wald's sequential test: under the model, at most a share 1 − p of the tracks that it confirms at probability p
are false. The parameters are estimated per source by EM from all its tracks: continuing tracks are censored, tracks
that another source confirms as real are labelled. The prior of T₀ is ``false_scans`` scans with the weight of
``false_weight`` tracks (:class:`sameas.picture.tuning.Tuning`).

Source: Wald 1947, section 3; lifetime mixtures with censoring as in McLachlan and Peel 2000, section 10.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import expit

from sameas.arrays import ABSENT, BoolArray, FloatArray, IntArray, places_in, taken
from sameas.errors import InputError
from sameas.evidence.rule import Evidence, Rule
from sameas.gate import Pairs
from sameas.gaussian import distance_and_log_determinant, mahalanobis_sq
from sameas.many.pooled import PooledRecords
from sameas.picture.error_factors import MAX_PAIRS, ErrorFactors, evenly, information, pairs_within
from sameas.picture.id_swaps import MIN_SWAP, Rivals, SwapRates, by_source_order
from sameas.picture.manoeuvres import with_manoeuvres
from sameas.picture.named_tracks import NamedTracks
from sameas.picture.tables import RANGE_BANDS, ColumnTable, Scan, objects_per_m2
from sameas.picture.track_pairs import TrackPairs, keys
from sameas.picture.tuning import DEFAULT_TUNING, Tuning
from sameas.representation import in_short
from sameas.tracks.kinds import KINDS


@dataclass(frozen=True)
class DurationMixture(ColumnTable):
    """The duration model of each source, (s,) each.

    false_s, real_s : T₀ and T₁. share : (s, 2) of real tracks among those present at the first scan, and among those
    that began later. prior_false_s : prior T₀.
    """

    false_s: FloatArray = field(default_factory=lambda: np.empty(0))
    real_s: FloatArray = field(default_factory=lambda: np.empty(0))
    share: FloatArray = field(default_factory=lambda: np.empty((0, 2)))
    prior_false_s: FloatArray = field(default_factory=lambda: np.empty(0))

    def with_sources(self, period_s: FloatArray, tuning: Tuning = DEFAULT_TUNING) -> DurationMixture:
        """The model with new sources, (k,) with these scan periods, at their prior."""
        false_s, n, tracks = tuning.false_scans * period_s, len(period_s), np.array(tuning.prior_tracks)
        share = np.tile(tracks[0] / tracks.sum(axis=0), (n, 1))
        return self.stacked(DurationMixture(false_s, np.maximum(tuning.real_s, 10.0 * false_s), share, false_s))

    def log_odds(
        self, source: IntArray, began_later: BoolArray, duration_s: FloatArray, ended: BoolArray
    ) -> FloatArray:
        """(n,) log-odds that tracks are real."""
        rate_0, rate_1 = 1.0 / self.false_s[source], 1.0 / self.real_s[source]
        share = self.share[source, began_later.astype(np.int64)]
        log_end = np.where(ended, np.log(rate_1 / rate_0), 0.0)
        return np.asarray(np.log(share) - np.log1p(-share) + log_end + duration_s * (rate_0 - rate_1))

    def fitted(
        self,
        source: IntArray,
        began_later: BoolArray,
        duration_s: FloatArray,
        ended: BoolArray,
        is_real: BoolArray,
        tuning: Tuning = DEFAULT_TUNING,
    ) -> DurationMixture:
        """The model after one EM iteration on tracks (n,); is_real : tracks that another source confirms as real."""
        p_real = np.where(is_real, 1.0, expit(self.log_odds(source, began_later, duration_s, ended)))

        def sums(weight: FloatArray) -> FloatArray:
            return np.asarray(np.bincount(source, weight, len(self.false_s)), np.float64)

        ended_0, ended_1 = sums((1.0 - p_real) * ended), sums(p_real * ended)
        prior_weight = tuning.false_weight
        false_s = (sums((1.0 - p_real) * duration_s) + prior_weight * self.prior_false_s) / (ended_0 + prior_weight)
        real_s = (sums(p_real * duration_s) + tuning.real_weight * tuning.real_s) / (ended_1 + tuning.real_weight)
        # Labelled tracks are excluded: they are all real and would bias the share of the others.
        unlabelled = [~is_real & (began_later == later) for later in (False, True)]
        counts = np.array(tuning.prior_tracks)[:, :, None] + [
            [sums(weight * which) for which in unlabelled] for weight in (p_real, 1.0 - p_real)
        ]
        share = (counts[0] / counts.sum(axis=0)).T
        # Without T₁ ≥ 2 T₀ the two components could exchange their roles.
        return DurationMixture(false_s, np.maximum(real_s, 2.0 * false_s), share, self.prior_false_s)


@dataclass(frozen=True)
class TrackExistence(ColumnTable):
    """The durations of named tracks, (k,) each, by ascending number.

    number, source : of the track, and the index of its source in ``NamedTracks.error_correlation.names``.
    began_later : whether it began after the source's first scan.
    first_s, last_s : times of its first and last report. last_scan_s : instant of the last scan with the track.
    after_s : mean time for which an ended track may have continued after its last report; 0 for the others.
    is_real : whether another source confirms it as real.
    mixture : the duration model of all sources.
    """

    WHOLE = frozenset({"mixture"})
    number: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    source: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    began_later: BoolArray = field(default_factory=lambda: np.empty(0, bool))
    first_s: FloatArray = field(default_factory=lambda: np.empty(0))
    last_s: FloatArray = field(default_factory=lambda: np.empty(0))
    last_scan_s: FloatArray = field(default_factory=lambda: np.empty(0))
    after_s: FloatArray = field(default_factory=lambda: np.empty(0))
    is_real: BoolArray = field(default_factory=lambda: np.empty(0, bool))
    mixture: DurationMixture = field(default_factory=DurationMixture)

    def __len__(self) -> int:
        return len(self.number)

    def advance(self, tracks: NamedTracks) -> TrackExistence:
        """The durations and the model after the scan of ``tracks``."""
        assert tracks.scan is not None
        scan, now_s = tracks.scan, tracks.instant_s
        time_s = scan.time_s[tracks.place]
        at = places_in(self.number, tracks.number)
        is_old = at >= 0
        first_s, is_real, began_later = time_s.copy(), np.zeros(len(at), bool), tracks.source < len(self.mixture.share)
        first_s[is_old], is_real[is_old], began_later[is_old] = (
            self.first_s[at[is_old]],
            self.is_real[at[is_old]],
            self.began_later[at[is_old]],
        )
        last_s = time_s.copy()
        last_s[is_old] = np.maximum(last_s[is_old], self.last_s[at[is_old]])
        n = len(at)
        current = TrackExistence(
            tracks.number, tracks.source, began_later, first_s, last_s, np.full(n, now_s), np.zeros(n), is_real
        )
        ended_tracks = self._ended(np.flatnonzero(places_in(tracks.number, self.number) < 0), tracks, now_s)
        out = ended_tracks.stacked(current)
        out = replace(out.take(np.argsort(out.number)), mixture=self._mixture(tracks))
        duration_s, ended = out.last_s - out.first_s + out.after_s, out.last_scan_s < now_s
        mixture = out.mixture
        for _ in range(scan.tuning.em_steps):
            mixture = mixture.fitted(out.source, out.began_later, duration_s, ended, out.is_real, scan.tuning)
        return replace(out, mixture=mixture)

    def with_real(self, number: IntArray) -> TrackExistence:
        """The same, with tracks that another source confirms as real; number : theirs."""
        return replace(self, is_real=self.is_real | np.isin(self.number, number))

    def log_odds(self, number: IntArray) -> tuple[FloatArray, FloatArray]:
        """The log-odds that tracks are real at their begin, and the gain by their duration since.

        number : of tracks, any shape. −∞ and 0 for ABSENT.
        """
        at, ended = places_in(self.number, number.ravel()).reshape(number.shape), np.zeros(len(self), bool)
        initial = self.mixture.log_odds(self.source, self.began_later, np.zeros(len(self)), ended)
        now = self.mixture.log_odds(self.source, self.began_later, self.last_s - self.first_s, ended)
        return np.append(initial, -math.inf)[at], np.append(now - initial, 0.0)[at]

    def _ended(self, which: IntArray, tracks: NamedTracks, now_s: float) -> TrackExistence:
        """The tracks ``which``, not in the scan, without those whose id has timed out."""
        assert tracks.scan is not None
        tuning = tracks.scan.tuning
        which = which[now_s - self.last_scan_s[which] <= tuning.id_timeout_s]
        just_ended = np.flatnonzero(self.after_s[which] == 0.0)
        after_s = self.after_s[which].copy()
        # The track ended between its last report and the later of the next scan and now minus the track timeout.
        timeout_s = _timeouts(tracks)[self.source[which[just_ended]]]
        period_s = self.mixture.prior_false_s[self.source[which[just_ended]]] / tuning.false_scans
        after_s[just_ended] = 0.5 * np.maximum(now_s - timeout_s - self.last_s[which[just_ended]], period_s)
        return replace(self.take(which), after_s=after_s)

    def _mixture(self, tracks: NamedTracks) -> DurationMixture:
        """The model of the previous instant, with the new sources at their prior."""
        assert tracks.scan is not None
        new = tracks.error_correlation.names[len(self.mixture.share) :]
        periods = {d.name: d.timing.period_s or tracks.scan.tuning.period_s for d in tracks.scan.now.descriptions}
        return self.mixture.with_sources(np.array([periods[name] for name in new], np.float64), tracks.scan.tuning)


def _timeouts(tracks: NamedTracks) -> FloatArray:
    """(s,) the track timeout of each source; ∞ for sources that are not in the scan."""
    assert tracks.scan is not None
    timeout_s = {feed.description.name: feed.track_timeout_s for feed in tracks.scan.now.feeds}
    return np.array([timeout_s.get(name, math.inf) for name in tracks.error_correlation.names])


#: Default ε: one report in ten thousand, for a radar of 20 rotations a minute once in eight hours (chosen).
REASSIGNED = 1e-4


@in_short
@dataclass(frozen=True)
class PreviousScans(Rule):
    """The evidence of previous scans on pairs of named tracks; made by :meth:`TrackMemory.rule`.

    ln r of a pair has two parts, which count differently in a set of tracks of three sources or more:

    - The level, the same for all ways to match the tracks of rivals, shows whether sources have objects in common. The
      best reference counts, so that one source with a wrong time or wrong errors does not separate the others.
    - The difference from the level, 0 or less, shows which of the rivals is the object. All sources count by their
      precision. With the best reference of each set, a wrong set would count only the more favourable part of the
      evidence: of two tracks of the same wrong ship, one.

    Parameters
    ----------
    numbers : by source name, the track number of each row of the source's table, ABSENT for rows without an id.
    first, second : (k,) numbers of tracks, first < second, in ascending order. log_ratio : (k,) their ln r.
    level : (k,) of ln r; None if every set counts its best reference. precision : (k,) sum of the precisions of both
        tracks, above 0; required with a level.

    Example
    -------
    >>> from sameas import Radius, Records
    >>> radar = Records.of([[0.0, 0.0], [9.0, 0.0]], sigma=5.0, source="radar")
    >>> ais = Records.of([[5.0, 0.0]], sigma=5.0, source="ais")
    >>> previous = PreviousScans({"radar": [3, 4], "ais": [7]}, first=[3], second=[7], log_ratio=[5.5])
    >>> previous(Radius(5.0)(radar, ais)).log_ratio.tolist()
    [5.5, 0.0]
    """

    numbers: Mapping[str, ArrayLike] = field(repr=False)
    first: ArrayLike
    second: ArrayLike
    log_ratio: ArrayLike
    level: ArrayLike | None = None
    precision: ArrayLike | None = None

    def __post_init__(self) -> None:
        first, second, log_ratio = np.asarray(self.first), np.asarray(self.second), np.asarray(self.log_ratio)
        if not len(first) == len(second) == len(log_ratio) or np.any(first >= second):
            raise InputError("PreviousScans: give first, second and log_ratio of every pair of tracks, first < second")
        if np.any(np.diff(keys(first, second)) <= 0):
            raise InputError("PreviousScans: give every pair of tracks once, in ascending order")
        if (self.level is None) != (self.precision is None):
            raise InputError("PreviousScans: give level and precision of every pair of tracks, or neither")

    def __call__(self, pairs: Pairs) -> Evidence:
        return Evidence({"memory": self._of_pairs(pairs, self.log_ratio)})

    def parts(self) -> tuple[Rule, ...]:
        """The level, and the differences from it; the rule itself without a level."""
        if self.level is None:
            return (self,)
        at_level = PreviousScans(self.numbers, self.first, self.second, self.level)
        differences = _RivalHistories(self.numbers, self.first, self.second, self.log_ratio, self.level, self.precision)
        return at_level, differences

    def _of_pairs(self, pairs: Pairs, values: ArrayLike) -> FloatArray:
        """(m,) the values (k,) of the pairs' tracks; 0 for pairs that are not among them."""
        one, two = (
            np.asarray(self.numbers.get(side.source, np.full(side.n_table, ABSENT)))[side.rows[at]]
            for side, at in ((pairs.first, pairs.i), (pairs.second, pairs.j))
        )
        pair_key = np.where((one >= 0) & (two >= 0), keys(np.minimum(one, two), np.maximum(one, two)), ABSENT)
        at = places_in(keys(np.asarray(self.first), np.asarray(self.second)), pair_key)
        return np.append(np.asarray(values, dtype=np.float64), 0.0)[at]


@dataclass(frozen=True)
class _RivalHistories(PreviousScans):
    """How much less probable the history of each pair is than its level: see :class:`PreviousScans`."""

    def parts(self) -> tuple[Rule, ...]:
        return (self,)

    def __call__(self, pairs: Pairs) -> Evidence:
        assert self.level is not None and self.precision is not None
        difference = np.asarray(self.log_ratio, np.float64) - np.asarray(self.level, np.float64)
        precision = self._of_pairs(pairs, self.precision)
        return Evidence({"memory": self._of_pairs(pairs, difference)}, precision=precision)


#: Shares of velocities that are right, and that have ten times their stated errors; the rest is of any other object.
VELOCITY_SHARES = (0.99, 0.01)
#: Probability that an object which AIS names as a ship is one that ADS-B names as an aircraft, or the reverse (chosen).
WRONG_TARGET = 1e-3
#: First digits of the MMSI of search and rescue aircraft, which send both.
RESCUE_AIRCRAFT = "111"


@dataclass(frozen=True)
class FirstContact(Rule):
    """The evidence of velocities and kinds of targets on pairs that were never surely one object.

    Positions alone join an aircraft that passes over a ship to it, for an instant. The ratio of the probabilities of
    the difference Δ of two velocities with covariances V_a, V_b, if both are of one object and if not, is

        r = [0.99 N(Δ; 0, V) + 0.01 N(Δ; 0, 100 V)] / N(Δ; 0, S) + ε²,   V = V_a + V_b,   S = s_a² + s_b²,

    s the usual speeds of both sources' targets. It counts at most as 1: equal velocities do not join two records, since
    most ships in a harbour have the velocity 0. The history of a pair contains its velocities, as displacements: the
    lower of both counts. Where one source names ships and the other aircraft, the ratio is :data:`WRONG_TARGET` times
    that.

    Parameters
    ----------
    scan : of the instant. records : by source name, the record of the scan of each row of the source's table, or
        ABSENT. number : (n,) track number of each record, ABSENT for records without an id.
    history : of the pairs of tracks. sure : (k,) which of them were sure before. reassigned : ε.
    """

    scan: Scan = field(repr=False)
    records: Mapping[str, IntArray] = field(repr=False)
    number: IntArray = field(repr=False)
    history: PreviousScans
    sure: BoolArray = field(repr=False)
    reassigned: float = REASSIGNED

    def __call__(self, pairs: Pairs) -> Evidence:
        out = np.zeros(len(pairs))
        first, second = (self.records.get(side.source) for side in (pairs.first, pairs.second))
        if first is not None and second is not None:
            a, b = first[pairs.first.rows[pairs.i]], second[pairs.second.rows[pairs.j]]
            named = (self.number[a] >= 0) & (self.number[b] >= 0)
            one, two = np.sort([self.number[a], self.number[b]], axis=0)
            known = keys(np.asarray(self.history.first), np.asarray(self.history.second))
            pair = np.where(named, places_in(known, keys(one, two)), ABSENT)
            at = np.flatnonzero((a >= 0) & (b >= 0) & ~np.append(self.sure, False)[pair])
            counted = np.minimum(np.append(np.asarray(self.history.log_ratio), 0.0)[pair[at]], 0.0)
            out[at] = np.minimum(self._by_velocity(a[at], b[at]) - counted, 0.0) + self._by_target(a[at], b[at])
        return Evidence({"velocity": out})

    def _by_velocity(self, a: IntArray, b: IntArray) -> FloatArray:
        """(k,) ln r of the velocities of records; 0 where one has none."""
        scan, out = self.scan, np.zeros(len(a))
        at = np.flatnonzero(scan.moving[a] & scan.moving[b])
        a, b = a[at], b[at]
        covariance = scan.covariance[a, 2:, 2:] + scan.covariance[b, 2:, 2:]
        delta = scan.state[a, 2:] - scan.state[b, 2:]
        chi_sq, log_det = distance_and_log_determinant(delta, covariance)
        variance = scan.speed_m_per_s[a] ** 2 + scan.speed_m_per_s[b] ** 2
        log_other = -0.5 * (delta**2).sum(axis=1) / variance - np.log(variance)
        right, wide = np.log(VELOCITY_SHARES)
        log_same = np.logaddexp(right - 0.5 * chi_sq, wide - math.log(100.0) - 0.005 * chi_sq) - 0.5 * log_det
        log_ratio = np.logaddexp(log_same - log_other, 2.0 * math.log(self.reassigned))
        out[at] = np.where(np.isfinite(variance), np.minimum(log_ratio, 0.0), 0.0)
        return out

    def _by_target(self, a: IntArray, b: IntArray) -> FloatArray:
        """(k,) ln of :data:`WRONG_TARGET` for a ship and an aircraft, 0 for others."""
        out, target = np.zeros(len(a)), np.array([KINDS[d.kind].target for d in self.scan.now.descriptions])
        one, two = target[self.scan.source[a]], target[self.scan.source[b]]
        differ = np.flatnonzero((one != two) & (one != "") & (two != ""))
        if len(differ):
            rescue = np.array([name.startswith(RESCUE_AIRCRAFT) for name in self.scan.texts("mmsi").tolist()])
            out[differ] = np.where(rescue[a[differ]] | rescue[b[differ]], 0.0, math.log(WRONG_TARGET))
        return out


@in_short
@dataclass(frozen=True)
class TrackMemory:
    """The memory of named tracks and of the pairs of them that passed the gate.

    Parameters
    ----------
    reassigned : ε of the module. correlation_s : by source name, the correlation time of its errors where it is given
        rather than estimated (:mod:`sameas.picture.error_factors`); 0 for independent errors.
    tracks, existence, track_pairs, swaps : the state, updated from instant to instant.
    """

    reassigned: float = REASSIGNED
    correlation_s: Mapping[str, float] = field(default_factory=dict)
    tracks: NamedTracks = field(default_factory=NamedTracks)
    existence: TrackExistence = field(default_factory=TrackExistence)
    track_pairs: TrackPairs = field(default_factory=TrackPairs)
    swaps: SwapRates = field(default_factory=SwapRates)

    def __post_init__(self) -> None:
        if not 0.0 < self.reassigned < 0.5:
            raise InputError(f"memory: reassigned is {self.reassigned}; give a probability between 0 and 0.5")

    @property
    def error_factors(self) -> ErrorFactors:
        """The estimated factors on the errors that sources state."""
        return self.tracks.error_factors

    def advance(self, scan: Scan, track_of_record: IntArray | None = None) -> TrackMemory:
        """The memory after the scan of a later instant.

        track_of_record : (n,) ``tracks.numbers_on(scan)``, where already known.

        Raises
        ------
        InputError : the scan is of an instant before the previous one.
        """
        require_order(self.tracks.instant_s, scan.now.instant_s)
        before = self._with_present_factors()._with_present_correlation(scan.tuning)
        correlation = replace(before.tracks.error_correlation, fixed_s=self.correlation_s)
        tracks, step = replace(before.tracks, error_correlation=correlation).advance(scan, track_of_record)
        kind = {description.name: description.kind for description in scan.now.descriptions}
        known = len(self.swaps.log_probable)
        swaps = self.swaps.of_sources(
            ["" if k < known else kind[name] for k, name in enumerate(tracks.error_correlation.names)], scan.tuning
        )
        track_pairs, swaps = before.track_pairs.stepped(
            step, self.reassigned, swaps, objects_per_m2(scan.now), scan.tuning
        )
        track_pairs = track_pairs.with_offsets(step, tracks.error_correlation, scan.tuning)
        existence = self.existence.advance(tracks)
        return replace(self, tracks=tracks, track_pairs=track_pairs, swaps=swaps, existence=existence)

    def with_numbers_of(self, later: TrackMemory, tuning: Tuning) -> TrackMemory:
        """The memory with the numbers that were given to the ids of tracks until a later instant, and their existence
        then: false tracks may begin and end between two steps of the memory."""
        return replace(self, tracks=self.tracks.with_numbers_of(later.tracks, tuning), existence=later.existence)

    def _with_present_factors(self) -> TrackMemory:
        """The memory of the previous instant by the present factors: :meth:`NamedTracks.with_present_factors`."""
        tracks, changed = self.tracks.with_present_factors()
        if tracks is self.tracks or tracks.scan is None or self.tracks.scan is None:
            return self
        rows, a, b = self._pairs_with(changed)
        scan, before, covariance = (
            tracks.scan,
            self.tracks.scan.covariance[:, :2, :2],
            tracks.scan.covariance[:, :2, :2],
        )
        change = scan.error_factor / self.tracks.scan.error_factor
        delta, after = scan.state[a, :2] - scan.state[b, :2], (covariance[a], covariance[b])
        track_pairs = self.track_pairs.with_errors(rows, delta, (before[a], before[b]), after, (change[a], change[b]))
        correlation = tracks.error_correlation
        anew = correlation.begun_anew(self.tracks.error_correlation)[correlation.numbers(scan)[scan.source]]
        restart = anew[a] | anew[b]
        lasting = tracks.lasting[a[restart]], tracks.lasting[b[restart]]
        track_pairs = track_pairs.without_history(
            rows[restart], delta[restart], (after[0][restart], after[1][restart]), lasting
        )
        return replace(self, tracks=tracks, track_pairs=track_pairs)

    def _with_present_correlation(self, tuning: Tuning) -> TrackMemory:
        """The memory of the previous instant without evidence that the present correlation of errors refutes:
        :meth:`sameas.picture.error_factors.ErrorCorrelation.weighing`."""
        if not self.tracks.error_correlation.names:
            return self
        correlation, outgrown = self.tracks.error_correlation.weighing(tuning)
        out, scan = replace(self, tracks=replace(self.tracks, error_correlation=correlation)), self.tracks.scan
        if not outgrown.any() or scan is None:
            return out
        rows, a, b = out._pairs_with(outgrown[correlation.numbers(scan)[scan.source]])
        delta, covariance, lasting = (
            scan.state[a, :2] - scan.state[b, :2],
            scan.covariance[:, :2, :2],
            self.tracks.lasting,
        )
        track_pairs = self.track_pairs.without_evidence(
            rows, delta, (covariance[a], covariance[b]), (lasting[a], lasting[b])
        )
        return replace(out, track_pairs=track_pairs)

    def _pairs_with(self, changed: BoolArray) -> tuple[IntArray, IntArray, IntArray]:
        """(m,) the pairs with a record of the last scan that ``changed`` (n,), and the records of their two tracks."""
        record, number = np.append(self.tracks.place, ABSENT), self.tracks.number
        a, b = (record[places_in(number, k)] for k in (self.track_pairs.first, self.track_pairs.second))
        rows = np.flatnonzero((a >= 0) & (b >= 0) & (changed[a] | changed[b]))
        return rows, a[rows], b[rows]

    def rule(self) -> PreviousScans:
        """The rule of previous scans for the records of the instant."""
        log_ratio, level = self._log_ratio()
        first, second = self.track_pairs.first, self.track_pairs.second
        return PreviousScans(self._numbers(), first, second, log_ratio, level, self._precision())

    def _numbers(self) -> dict[str, IntArray]:
        """By source name, the track number of each row of the source's table, ABSENT for rows without an id."""
        scan, numbers = self.tracks.scan, {}
        for s, description in enumerate(() if scan is None else scan.now.descriptions):
            assert scan is not None
            records = slice(scan.start[s], scan.start[s + 1])
            numbers[description.name] = np.full(int(scan.table[records].max(initial=-1)) + 1, ABSENT)
            numbers[description.name][scan.table[records]] = self.tracks.track_of_record[records]
        return numbers

    def first_contact(self, history: PreviousScans) -> FirstContact | None:
        """The rule for pairs of records of the instant that were never sure; None before the first instant.

        history : :meth:`rule`.
        """
        scan = self.tracks.scan
        if scan is None:
            return None
        records = {}
        for s, description in enumerate(scan.now.descriptions):
            own = np.arange(scan.start[s], scan.start[s + 1])
            records[description.name] = np.full(int(scan.table[own].max(initial=-1)) + 1, ABSENT)
            records[description.name][scan.table[own]] = own
        sure = ~np.isnan(self.track_pairs.anchor_s)
        return FirstContact(scan, records, self.tracks.track_of_record, history, sure, self.reassigned)

    def _precision(self) -> FloatArray:
        """(k,) sum of the precisions of both tracks of each pair, |P|^(−½) in m⁻²."""
        if self.tracks.scan is None:
            return np.zeros(len(self.track_pairs))
        covariance = self.tracks.scan.covariance[self.tracks.place, :2, :2]
        precision = 1.0 / np.sqrt(np.linalg.det(covariance))
        one, other = (
            precision[places_in(self.tracks.number, number)]
            for number in (self.track_pairs.first, self.track_pairs.second)
        )
        return np.asarray(one + other)

    def _log_ratio(self) -> tuple[FloatArray, FloatArray]:
        """(k,) ln r of the pairs, without the positions of the instant, and its level (:class:`PreviousScans`)."""
        track_pairs, tracks = self.track_pairs, self.tracks
        first, second = (places_in(tracks.number, number) for number in (track_pairs.first, track_pairs.second))
        rivals = Rivals.of(first, second, tracks.source[first], tracks.source[second])
        log_ratio = track_pairs.log_ratio + track_pairs.log_reported - track_pairs.log_now
        chi_sq = math.inf if tracks.scan is None else tracks.scan.tuning.manoeuvre_chi_sq
        agrees = track_pairs.chi_sq <= chi_sq
        # With an agreeing rival, ids may have been swapped: the mean offset may mix several objects.
        alone = rivals.max_other(np.where(agrees, 0.0, -np.inf)) < 0.0
        log_ratio += np.where(alone, track_pairs.log_offset, 0.0)
        if tracks.scan is not None:
            log_odds = log_ratio + track_pairs.log_now - math.log(objects_per_m2(tracks.scan.now))
            numbers = by_source_order((first, second), (tracks.source[first], tracks.source[second]))
            models = self.swaps.probable
            log_ratio = rivals.with_joint_swaps(
                log_ratio, track_pairs.by_model[:, models], np.where(agrees, log_odds, -np.inf),
                partial(self._swaps_since, tracks.scan, numbers, models),
            )  # fmt: skip
        log_ratio = rivals.bounded(log_ratio, agrees, self.reassigned)
        return log_ratio, rivals.level(log_ratio, agrees)

    def _swaps_since(
        self,
        scan: Scan,
        numbers: tuple[IntArray, IntArray],
        models: IntArray,
        side: int,
        pair: IntArray,
        rival: IntArray,
    ) -> tuple[IntArray, FloatArray, FloatArray]:
        """Pairs whose track that differs from the rival's may have exchanged ids with it since a scan.

        (m,) indices of pairs and rivals (n,); (m, r), (m, r) probability of a swap under each of ``models``, and that
        of the model. Both tracks have a report of their source's last scan. numbers : (k,), (k,) indices of the tracks.
        """
        tracks, tuning = self.tracks, scan.tuning
        one, other = tracks.place[numbers[1 - side][pair]], tracks.place[numbers[1 - side][rival]]
        source = tracks.source[numbers[1 - side][pair]]
        period_s = np.array([d.timing.period_s or tuning.period_s for d in scan.now.descriptions])[scan.source]
        is_recent = scan.now.instant_s - scan.time_s <= 1.5 * period_s
        which = np.flatnonzero(is_recent[one] & is_recent[other] & self.swaps.may_swap[source])
        one, other, place, covariance = one[which], other[which], scan.state[:, :2], scan.reported_covariance[:, :2, :2]
        chi_sq = mahalanobis_sq(
            taken(place, one) - taken(place, other), taken(covariance, one) + taken(covariance, other)
        )
        near = chi_sq < -math.log(MIN_SWAP) * max(tuning.swap_ranges)
        which, (rates, ranges) = which[near], tuning.swap_models
        p = rates[models] * np.exp(chi_sq[near, None] * (-1.0 / ranges[models]))
        return which, p, self.swaps.probability[:, models][source[which]]

    def with_real(self, track: IntArray) -> TrackMemory:
        """The memory after other sources confirm tracks (any shape, ABSENT for none) as real."""
        return replace(self, existence=self.existence.with_real(track[track >= 0]))

    def with_manoeuvres(
        self, scan: Scan, track_of_record: IntArray, per_m2: float, together: Callable[[IntArray, IntArray], BoolArray]
    ) -> Scan:
        """The scan of a later instant with larger covariances for reports that a manoeuvre has made obsolete.

        track_of_record : (n,) ``tracks.numbers_on(scan)``. together : gives of numbers of tracks, (n,) and (n,),
        whether each two were one object before.
        """
        names, n = self.tracks.error_correlation.names, len(self.swaps.log_probable)
        known = np.array([names.index(d.name) if d.name in names else n for d in scan.now.descriptions], np.int64)
        swap_rate = np.append(self.swaps.rate(np.arange(n), scan.tuning), 0.0)[known]
        return with_manoeuvres(
            scan, track_of_record, self.tracks.scan, self.track_pairs, self._log_ratio()[0], per_m2, swap_rate,
            together,
        )  # fmt: skip

    def with_pairs(self, pooled: PooledRecords) -> TrackMemory:
        """The memory with the pairs that passed the gate for the first time; they have no history yet."""
        scan = self.tracks.scan
        if scan is None:
            return self
        names = [description.name for description in scan.now.descriptions]
        parts = [np.empty((0, 2), np.int64)]
        for pairs in (part for part, _ in pooled.parts if len(part)):
            one, two = names.index(pairs.first.source), names.index(pairs.second.source)
            i, j = pairs.first.rows[pairs.i], pairs.second.rows[pairs.j]
            parts.append(np.column_stack([scan.find(one, i), scan.find(two, j)]))
        (one, two), number = np.concatenate(parts).T, self.tracks.track_of_record
        named = (number[one] >= 0) & (number[two] >= 0) & scan.placed[one] & scan.placed[two]
        a, b = (np.where(number[one] < number[two], *both)[named] for both in ((one, two), (two, one)))
        new = ~self.track_pairs.has(number[a], number[b])
        a, b = a[new], b[new]
        if not len(a):
            return self
        delta, covariance = scan.state[a, :2] - scan.state[b, :2], scan.covariance[:, :2, :2]
        lasting = self.tracks.lasting
        new_pairs = TrackPairs.of(
            number[a], number[b], delta, (covariance[a], covariance[b]), (lasting[a], lasting[b]), scan.now.instant_s
        )
        return replace(self, track_pairs=self.track_pairs.with_(new_pairs))

    def with_sure(self, members: IntArray, probability: FloatArray) -> TrackMemory:
        """The memory with error factors and correlations updated by the pairs that are surely one object.

        members, probability : (n, S) records of the scan, ABSENT for none, and (n,) of the objects of the instant.
        """
        tracks, scan = self.tracks, self.tracks.scan
        if scan is None or not len(members):
            return self
        sure = members[probability >= scan.tuning.sure_pair]
        usable = (sure >= 0) & scan.placed[sure] & (tracks.track_of_record[sure] >= 0)
        places, share = pairs_within(np.where(usable, sure, ABSENT))
        places = np.take_along_axis(places, np.argsort(tracks.track_of_record[places], axis=1), axis=1)
        number = tracks.track_of_record[places]
        at = places_in(keys(self.track_pairs.first, self.track_pairs.second), keys(number[:, 0], number[:, 1]))
        at, places, share = at[at >= 0], places[at >= 0], share[at >= 0]
        elapsed = scan.now.instant_s - self.track_pairs.anchor_s[at]
        delta = scan.state[places[:, 0], :2] - scan.state[places[:, 1], :2]
        due = np.flatnonzero((elapsed >= scan.tuning.lasting_s) & self.track_pairs.anchor_new[at].all(axis=1))
        # Pairs added at one instant are due at one instant; beyond MAX_PAIRS they wait for the next.
        due = due[evenly(scan.state[places[due, 0], :2], MAX_PAIRS)]
        correlation = tracks.error_correlation
        source = correlation.numbers(scan)[scan.source]
        restart = np.isnan(elapsed)
        restart[due] = True
        log_kept = np.zeros(len(scan))
        log_kept[tracks.place] = tracks.log_kept
        track_pairs = self.track_pairs.anchored(at, restart, scan.now.instant_s, delta, log_kept[places])
        a, b = places[due].T
        kept = np.exp(np.minimum(log_kept[places[due]] - self.track_pairs.anchor_kept[at[due]], 0.0))
        reported, total = scan.reported_covariance[:, :2, :2], scan.covariance[:, :2, :2]
        # Correlation of a pair's difference with its previous one, and with all previous ones by lasting errors.
        trace = _trace(total[a] + total[b])
        rho = sum(
            (_trace(reported[record]) * correlation.correlation(source[record], elapsed[due], scan.tuning, g)
             for record, g in zip((a, b), kept.T, strict=True)), np.zeros(len(a)),
        ) / trace  # fmt: skip
        lasting_rho = sum(
            (_trace(reported[record]) * correlation.lasting(source[record], scan.tuning) for record in (a, b)),
            np.zeros(len(a)),
        ) / trace  # fmt: skip
        part = source * RANGE_BANDS + scan.range_band
        factors = self.error_factors.with_sure_pairs(
            (part[a], part[b]), delta[due],
            tuple(reported[record] / scan.error_factor[record, None, None] ** 2 for record in (a, b)),
            total[a] + total[b] - reported[a] - reported[b],
            share[due] * information(self.track_pairs.n_compared[at[due]], rho, lasting_rho), scan.tuning,
        )  # fmt: skip
        correlation = correlation.with_sure_pairs(
            (source[a], source[b]), elapsed[due], (self.track_pairs.anchor[at[due]], delta[due]),
            (reported[a], reported[b]), total[a] + total[b], kept, scan.tuning,
        )  # fmt: skip
        tracks = replace(tracks, error_correlation=correlation, error_factors=factors)
        return replace(self, tracks=tracks, track_pairs=track_pairs)


def _trace(covariance: FloatArray) -> FloatArray:
    return np.asarray(np.trace(covariance, axis1=1, axis2=2))


def require_order(last_s: float, instant_s: float) -> None:
    """Refuse an instant before the last one."""
    if instant_s < last_s:
        raise InputError(
            f"the picture is at {last_s:g} s and was given {instant_s:g} s; give instants in the order of time"
        )

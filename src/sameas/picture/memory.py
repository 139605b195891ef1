"""Memory: the evidence of past scans that two named tracks are one object, beside that of the instant.

Two tracks that were together for ten minutes do not part because noise brings another nearer for one turn of the
antenna. :class:`Past` goes from instant to instant; :meth:`Past.rule` is a rule for
:func:`sameas.many.identify_many`, to be added to those of the instant:

    past = past.on(scan)
    found = identify_many(now.sources, rule=now.rule() + now.identity() + past.rule(), region=now.region)
    past = past.with_pairs(found.pooled)

Its logarithm is that of all reports (:mod:`sameas.picture.track_pairs`) less that of the two positions of the instant,
so the sum of both counts every report once. It stays between −2b and b = ln((1−ε)/ε), with ε the probability that a
report is of another object than its id says: ids are reused, and swapped where two targets cross. So a wrong picture
corrects itself. What sensors state of errors that last is judged by the mean offsets of pairs that are surely one
object (:meth:`sameas.picture.track_pairs.TrackPairs.with_offsets`). Records without an id have no past, and tracks that
are not reported any more are forgotten.

Track existence is the probability that a named track is of a real object, by its duration (:class:`TrackExistence`).
False echoes make tracks too: a tracker that has seen the same patch of sea four times in a row gives it a number. They
end soon, and tracks of real objects continue until the object is lost. The durations of a source's tracks are
exponential with two means, T₀ of false and T₁ of real tracks; the real ones are a share w of those that begin (and
another share of those that were there at the source's first scan). For a track that continues after a duration ℓ,

    ln P(real) / P(false) = ln w / (1 − w) + ℓ (1/T₀ − 1/T₁).

That is Wald's sequential test: if durations are such, at most 1 − p of the tracks that it confirms at a probability p
are false. The numbers are estimated per source by EM from all its tracks so far: tracks that continue are censored,
those that another source has shown to be real are labelled. Before there are any, T₀ is ``false_scans`` scans with a
weight of ``false_weight`` tracks (:class:`sameas.picture.tuning.Tuning`).

Source: Wald 1947, section 3; mixtures of lives with censoring as in McLachlan and Peel 2000, section 10.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import expit

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.errors import InputError
from sameas.evidence.rule import Evidence, Rule
from sameas.gate import Pairs
from sameas.many.pooled import PooledRecords
from sameas.picture.error_factors import MOST_PAIRS, ErrorFactors, evenly
from sameas.picture.named import NamedTracks
from sameas.picture.object_table import ColumnTable
from sameas.picture.scan import Scan, objects_per_m2
from sameas.picture.track_pairs import Rivals, SwapRates, TrackPairs, keys, with_manoeuvres
from sameas.picture.tuning import DEFAULT_TUNING, Tuning
from sameas.ragged import places_in
from sameas.representation import in_short


@dataclass(frozen=True)
class Mixture(ColumnTable):
    """Per source (s,): T₀ and T₁ in seconds, and T₀ before any track ended; share : (s, 2) of the real among the
    tracks that were there first, and among those that began later."""

    false_s: FloatArray = field(default_factory=lambda: np.empty(0))
    real_s: FloatArray = field(default_factory=lambda: np.empty(0))
    share: FloatArray = field(default_factory=lambda: np.empty((0, 2)))
    before_s: FloatArray = field(default_factory=lambda: np.empty(0))

    def with_sources(self, period_s: FloatArray, tuning: Tuning = DEFAULT_TUNING) -> Mixture:
        """The same and new sources with these periods (k,)."""
        before, n, prior = tuning.false_scans * period_s, len(period_s), np.array(tuning.prior_tracks)
        share = np.tile(prior[0] / prior.sum(axis=0), (n, 1))
        return self.stacked(Mixture(before, np.maximum(tuning.real_s, 10.0 * before), share, before))

    def log_odds(self, source: IntArray, began_later: BoolArray, life_s: FloatArray, ended: BoolArray) -> FloatArray:
        """(n,) ln of the odds that tracks are real."""
        rate_0, rate_1 = 1.0 / self.false_s[source], 1.0 / self.real_s[source]
        share = self.share[source, began_later.astype(np.int64)]
        at_end = np.where(ended, np.log(rate_1 / rate_0), 0.0)
        return np.asarray(np.log(share) - np.log1p(-share) + at_end + life_s * (rate_0 - rate_1))

    def fitted(
        self,
        source: IntArray,
        began_later: BoolArray,
        life_s: FloatArray,
        ended: BoolArray,
        is_real: BoolArray,
        tuning: Tuning = DEFAULT_TUNING,
    ) -> Mixture:
        """One step of EM on tracks (n,); ``is_real``: those that another source has shown to be real."""
        p_real = np.where(is_real, 1.0, expit(self.log_odds(source, began_later, life_s, ended)))

        def sums(weight: FloatArray) -> FloatArray:
            return np.asarray(np.bincount(source, weight, len(self.false_s)), np.float64)

        dead_0, dead_1 = sums((1.0 - p_real) * ended), sums(p_real * ended)
        false_s = (sums((1.0 - p_real) * life_s) + tuning.false_weight * self.before_s) / (dead_0 + tuning.false_weight)
        real_s = (sums(p_real * life_s) + tuning.real_weight * tuning.real_s) / (dead_1 + tuning.real_weight)
        # The tracks that others have shown to be real do not count for the share of real ones among the rest.
        undecided = [~is_real & (began_later == which) for which in (False, True)]
        counts = np.array(tuning.prior_tracks)[:, :, None] + [
            [sums(weight * some) for some in undecided] for weight in (p_real, 1.0 - p_real)
        ]
        share = (counts[0] / counts.sum(axis=0)).T
        # Real tracks last longer: without that bound the two kinds could swap.
        return Mixture(false_s, np.maximum(real_s, 2.0 * false_s), share, self.before_s)


@dataclass(frozen=True)
class TrackExistence(ColumnTable):
    """The durations of named tracks, (k,) each, by ascending number.

    number, source : of the track, and the place of its source in ``NamedTracks.error_correlation.names``.
    began_later : whether it began after the source's first scan.
    first_s, last_s : times of its first and its last report. last_scan_s : when it was last in a scan.
    life_after_s : mean time that it may have continued after its last report.
    is_real : whether another source has shown it to be real.
    """

    WHOLE = frozenset({"mixture"})
    number: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    source: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    began_later: BoolArray = field(default_factory=lambda: np.empty(0, bool))
    first_s: FloatArray = field(default_factory=lambda: np.empty(0))
    last_s: FloatArray = field(default_factory=lambda: np.empty(0))
    last_scan_s: FloatArray = field(default_factory=lambda: np.empty(0))
    life_after_s: FloatArray = field(default_factory=lambda: np.empty(0))
    is_real: BoolArray = field(default_factory=lambda: np.empty(0, bool))
    mixture: Mixture = field(default_factory=Mixture)

    def __len__(self) -> int:
        return len(self.number)

    def on(self, tracks: NamedTracks) -> TrackExistence:
        """After the instant of these tracks."""
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
        every_track = ended_tracks.stacked(current)
        tracks_now = replace(every_track.take(np.argsort(every_track.number)), mixture=self._mixture(tracks))
        life_s, ended = tracks_now.last_s - tracks_now.first_s + tracks_now.life_after_s, tracks_now.last_scan_s < now_s
        mixture = tracks_now.mixture
        for _ in range(scan.tuning.em_steps):
            mixture = mixture.fitted(
                tracks_now.source, tracks_now.began_later, life_s, ended, tracks_now.is_real, scan.tuning
            )
        return replace(tracks_now, mixture=mixture)

    def with_real(self, number: IntArray) -> TrackExistence:
        """The same, with tracks that another source has shown to be real."""
        return replace(self, is_real=self.is_real | np.isin(self.number, number))

    def log_odds(self, number: IntArray) -> tuple[FloatArray, FloatArray]:
        """ln of the odds that tracks are real when they began, and the gain by their duration since.

        number : of tracks, any shape. −∞ and 0 for −1.
        """
        at, living = places_in(self.number, number.ravel()).reshape(number.shape), np.zeros(len(self), bool)
        begun = self.mixture.log_odds(self.source, self.began_later, np.zeros(len(self)), living)
        now = self.mixture.log_odds(self.source, self.began_later, self.last_s - self.first_s, living)
        return np.append(begun, -math.inf)[at], np.append(now - begun, 0.0)[at]

    def _ended(self, which: IntArray, tracks: NamedTracks, now_s: float) -> TrackExistence:
        """The tracks that are not in the scan, without those whose id has timed out."""
        assert tracks.scan is not None
        tuning = tracks.scan.tuning
        which = which[now_s - self.last_scan_s[which] <= tuning.id_timeout_s]
        just_ended = np.flatnonzero(self.life_after_s[which] == 0.0)
        life_after_s = self.life_after_s[which].copy()
        # It ended between its last report and the next scan, or now less the track timeout.
        timeout_s = _timeouts(tracks)[self.source[which[just_ended]]]
        period_s = self.mixture.before_s[self.source[which[just_ended]]] / tuning.false_scans
        life_after_s[just_ended] = 0.5 * np.maximum(now_s - timeout_s - self.last_s[which[just_ended]], period_s)
        return replace(self.take(which), life_after_s=life_after_s)

    def _mixture(self, tracks: NamedTracks) -> Mixture:
        """The mixture of the last instant, with the new sources."""
        assert tracks.scan is not None
        new = tracks.error_correlation.names[len(self.mixture.share) :]
        periods = {d.name: d.timing.period_s or tracks.scan.tuning.period_s for d in tracks.scan.now.descriptions}
        return self.mixture.with_sources(np.array([periods[name] for name in new], np.float64), tracks.scan.tuning)


def _timeouts(tracks: NamedTracks) -> FloatArray:
    """(s,) the track timeout of each source; ∞ for sources that are not in the scan."""
    assert tracks.scan is not None
    timeout_s = {feed.description.name: feed.track_timeout_s for feed in tracks.scan.now.feeds}
    return np.array([timeout_s.get(name, math.inf) for name in tracks.error_correlation.names])


#: Default ε: one scan in ten thousand, which a radar of 20 rotations a minute has every eight hours (chosen).
REASSIGNED = 1e-4


@in_short
@dataclass(frozen=True)
class Memory(Rule):
    """The evidence of the past on pairs of named tracks; made by :meth:`Past.rule`.

    Parameters
    ----------
    numbers : per source, by its name, the number of the track of every row of its table, −1 for rows without an id.
    first, second : (k,) numbers of tracks, first < second, in ascending order. log_ratio : (k,) ln r of the past.

    Example
    -------
    >>> from sameas import Radius, Records
    >>> radar = Records.of([[0.0, 0.0], [9.0, 0.0]], sigma=5.0, source="radar")
    >>> ais = Records.of([[5.0, 0.0]], sigma=5.0, source="ais")
    >>> past = Memory({"radar": [3, 4], "ais": [7]}, first=[3], second=[7], log_ratio=[5.5])
    >>> past(Radius(5.0)(radar, ais)).log_ratio.tolist()
    [5.5, 0.0]
    """

    numbers: Mapping[str, ArrayLike] = field(repr=False)
    first: ArrayLike
    second: ArrayLike
    log_ratio: ArrayLike

    def __post_init__(self) -> None:
        first, second, log_ratio = np.asarray(self.first), np.asarray(self.second), np.asarray(self.log_ratio)
        if not len(first) == len(second) == len(log_ratio) or np.any(first >= second):
            raise InputError("Memory: give first, second and log_ratio of every couple of tracks, first < second")
        if np.any(np.diff(keys(first, second)) <= 0):
            raise InputError("Memory: give every couple of tracks once, in ascending order")

    def __call__(self, pairs: Pairs) -> Evidence:
        one, two = (
            np.asarray(self.numbers.get(side.source, np.full(side.n_table, -1)))[side.rows[at]]
            for side, at in ((pairs.first, pairs.i), (pairs.second, pairs.j))
        )
        pair_key = np.where((one >= 0) & (two >= 0), keys(np.minimum(one, two), np.maximum(one, two)), -1)
        at = places_in(keys(np.asarray(self.first), np.asarray(self.second)), pair_key)
        return Evidence({"memory": np.append(np.asarray(self.log_ratio, dtype=np.float64), 0.0)[at]})


@in_short
@dataclass(frozen=True)
class Past:
    """The memory of named tracks, and of pairs of them that the gate has let through.

    Parameters
    ----------
    reassigned : ε of the module. correlation_s : by name of source the correlation time of its errors, where it is not
        to be estimated (:mod:`sameas.picture.error_factors`); 0 where the errors of all reports are independent.
    tracks, existence, track_pairs, swaps : filled in from instant to instant.
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
        """By how much the errors that sources state are too small."""
        return self.tracks.error_factors

    def on(self, scan: Scan, track_of_record: IntArray | None = None) -> Past:
        """The past after the scan of a later instant.

        track_of_record : (n,) ``tracks.numbers_on(scan)``, where it is known already.

        Raises
        ------
        InputError : the scan is of an earlier instant than the last.
        """
        if scan.now.instant_s < self.tracks.instant_s:
            raise InputError(
                f"the picture is at {self.tracks.instant_s:g} s and was given {scan.now.instant_s:g} s; "
                "give instants in the order of time"
            )
        correlation = replace(self.tracks.error_correlation, fixed_s=self.correlation_s)
        tracks, step = replace(self.tracks, error_correlation=correlation).on(scan, track_of_record)
        kind = {description.name: description.kind for description in scan.now.descriptions}
        known = len(self.swaps.log_probable)
        swaps = self.swaps.of_sources(
            ["" if k < known else kind[name] for k, name in enumerate(tracks.error_correlation.names)], scan.tuning
        )
        track_pairs, swaps = self.track_pairs.stepped(
            step, self.reassigned, swaps, objects_per_m2(scan.now), scan.tuning
        )
        track_pairs = track_pairs.with_offsets(step, tracks.error_correlation, scan.tuning)
        existence = self.existence.on(tracks)
        return replace(self, tracks=tracks, track_pairs=track_pairs, swaps=swaps, existence=existence)

    def rule(self) -> Memory:
        """The rule of the past at the instant."""
        scan, track_pairs, numbers = self.tracks.scan, self.track_pairs, {}
        for s, description in enumerate(() if scan is None else scan.now.descriptions):
            assert scan is not None
            here = slice(scan.start[s], scan.start[s + 1])
            numbers[description.name] = np.full(int(scan.table[here].max(initial=-1)) + 1, -1)
            numbers[description.name][scan.table[here]] = self.tracks.track_of_record[here]
        return Memory(numbers, track_pairs.first, track_pairs.second, self._log_ratio())

    def _log_ratio(self) -> FloatArray:
        """(k,) ln r of the pairs by the past."""
        track_pairs, tracks = self.track_pairs, self.tracks
        first, second = (places_in(tracks.number, number) for number in (track_pairs.first, track_pairs.second))
        rivals = Rivals.of(first, second, tracks.source[first], tracks.source[second])
        past = track_pairs.log_ratio + track_pairs.at_scan - track_pairs.now
        chi_sq = DEFAULT_TUNING.manoeuvre_chi_sq if tracks.scan is None else tracks.scan.tuning.manoeuvre_chi_sq
        agrees = track_pairs.chi_sq <= chi_sq
        # Among rivals tracks may have been swapped since, and offsets are those of several objects.
        alone = rivals.most_other(np.where(agrees, 0.0, -np.inf)) < 0.0
        past += np.where(alone, track_pairs.log_offset, 0.0)
        return rivals.bounded(past, agrees, self.reassigned)

    def with_real(self, track: IntArray) -> Past:
        """The same, with tracks (any shape, −1 for none) that other sources show to be real."""
        return replace(self, existence=self.existence.with_real(track[track >= 0]))

    def with_manoeuvres(self, scan: Scan, track_of_record: IntArray, per_m2: float) -> Scan:
        """A later instant's scan with larger covariances of the reports that a manoeuvre has made obsolete.

        track_of_record : (n,) ``tracks.numbers_on(scan)``.
        """
        return with_manoeuvres(scan, track_of_record, self.track_pairs, self._log_ratio(), per_m2)

    def with_pairs(self, pooled: PooledRecords) -> Past:
        """The same with the pairs that the gate let through for the first time, which have no past yet."""
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
        fresh = TrackPairs.of(
            number[a], number[b], delta, (covariance[a], covariance[b]), (lasting[a], lasting[b]), scan.now.instant_s
        )
        return replace(self, track_pairs=self.track_pairs.with_(fresh))

    def with_sure(self, members: IntArray, probability: FloatArray) -> Past:
        """The same after objects of the instant, (n, S) places in the scan and their probabilities: what surely is one
        object shows how long errors last."""
        tracks, scan = self.tracks, self.tracks.scan
        if scan is None or not len(members):
            return self
        sure = members[probability >= scan.tuning.sure_pair]
        one, two = np.triu_indices(sure.shape[1], 1)
        places = np.stack([sure[:, one].ravel(), sure[:, two].ravel()], axis=1)
        places = places[(places >= 0).all(axis=1)]
        places = places[scan.placed[places].all(axis=1) & (tracks.track_of_record[places] >= 0).all(axis=1)]
        places = np.take_along_axis(places, np.argsort(tracks.track_of_record[places], axis=1), axis=1)
        number = tracks.track_of_record[places]
        at = places_in(keys(self.track_pairs.first, self.track_pairs.second), keys(number[:, 0], number[:, 1]))
        at, places = at[at >= 0], places[at >= 0]
        elapsed = scan.now.instant_s - self.track_pairs.anchor_s[at]
        delta = scan.state[places[:, 0], :2] - scan.state[places[:, 1], :2]
        due = np.flatnonzero((elapsed >= scan.tuning.lasting_s) & self.track_pairs.anchor_new[at].all(axis=1))
        # Pairs that met at one instant are due at one; those beyond some dozens wait for the next.
        due = due[evenly(scan.state[places[due, 0], :2], MOST_PAIRS)]
        correlation = tracks.error_correlation
        number_of = correlation.numbers(scan)[scan.source]
        begin = np.isnan(elapsed)
        begin[due] = True
        track_pairs = self.track_pairs.anchored(at, begin, scan.now.instant_s, delta)
        a, b = places[due].T
        reported, total = scan.reported_covariance[:, :2, :2], scan.covariance[:, :2, :2]
        # Shares of a difference's variance that the last one of its pair has shown.
        shown = sum(
            (correlation.correlation(number_of[record], elapsed[due], scan.tuning) * _trace(reported[record])
             for record in (a, b)), np.zeros(len(a)),
        ) / _trace(total[a] + total[b])  # fmt: skip
        factors = self.error_factors.with_sure_pairs(
            (number_of[a], number_of[b]), delta[due],
            tuple(reported[record] / scan.error_factor[record, None, None] ** 2 for record in (a, b)),
            total[a] + total[b] - reported[a] - reported[b], 1.0 - shown**2, scan.tuning,
        )  # fmt: skip
        correlation = correlation.with_sure_pairs(
            (number_of[a], number_of[b]), elapsed[due], (self.track_pairs.anchor[at[due]], delta[due]),
            (reported[a], reported[b]), total[a] + total[b], scan.tuning,
        )  # fmt: skip
        tracks = replace(tracks, error_correlation=correlation, error_factors=factors)
        return replace(self, tracks=tracks, track_pairs=track_pairs)


def _trace(covariance: FloatArray) -> FloatArray:
    return np.asarray(np.trace(covariance, axis1=1, axis2=2))

"""Track existence: the probability that a named track is of a real object, by its duration.

False echoes start tracks too: a tracker that detects the same patch of sea four times in a row gives it a number. Such
tracks end soon; tracks of real objects continue until the object is lost. The durations of a source's tracks are a
mixture of two exponentials with means T₀ of false and T₁ of real tracks. The share of real tracks is w among those that
begin later than the source's first scan, and another among those present at it. For a track that continues after a
duration ℓ,

    ln P(real) / P(false) = ln w / (1 − w) + ℓ (1/T₀ − 1/T₁).

This is Wald's sequential test: under the model, at most a share 1 − p of the tracks that it confirms at probability p
are false. The parameters are estimated per source by EM from all its tracks: continuing tracks are censored, tracks
that another source confirms as real are labelled. The prior of T₀ is ``FALSE_SCANS`` scans with the weight of
``FALSE_WEIGHT`` tracks.

Source: Wald 1947, section 3; lifetime mixtures with censoring as in McLachlan and Peel 2000, section 10.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.special import expit

from sameas.arrays import ABSENT, BoolArray, ColumnTable, FloatArray, IntArray
from sameas.kernels.tracks import DURATION_SUMS, add_durations, places_of
from sameas.picture.named_tracks import NamedTracks

FALSE_SCANS, FALSE_WEIGHT = 4.0, 4.0  # prior mean duration of false tracks in scans, and its weight in tracks
REAL_S, REAL_WEIGHT = 1800.0, 1.0  # prior mean duration of real tracks in seconds, and its weight in tracks
#: Pseudo-counts of tracks per source: real (first row) and false, present at its first scan and begun later. Most
#: tracks that begin later are false.
PRIOR_TRACKS = ((1.0, 1.0), (1.0, 3.0))
PERIOD_S = 10.0  # time between two scans of a source whose description has none
EM_STEPS = 4  # EM iterations per instant; they continue from the previous instant


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

    def with_sources(self, period_s: FloatArray) -> DurationMixture:
        """The model with new sources, (k,) with these scan periods, at their prior."""
        false_s, n, tracks = FALSE_SCANS * period_s, len(period_s), np.array(PRIOR_TRACKS)
        share = np.tile(tracks[0] / tracks.sum(axis=0), (n, 1))
        return self.stacked(DurationMixture(false_s, np.maximum(REAL_S, 10.0 * false_s), share, false_s))

    def log_odds(
        self, source: IntArray, began_later: BoolArray, duration_s: FloatArray, ended: BoolArray
    ) -> FloatArray:
        """(n,) log-odds that tracks are real."""
        rate_0, rate_1 = 1.0 / self.false_s, 1.0 / self.real_s
        log_initial = (np.log(self.share) - np.log1p(-self.share))[source, began_later.astype(np.int64)]
        log_end = np.where(ended, np.log(rate_1 / rate_0)[source], 0.0)
        return np.asarray(log_initial + log_end + duration_s * (rate_0 - rate_1)[source])

    def fitted(
        self, source: IntArray, began_later: BoolArray, duration_s: FloatArray, ended: BoolArray, is_real: BoolArray
    ) -> DurationMixture:
        """The model after one EM iteration on tracks (n,); is_real : tracks that another source confirms as real."""
        p_real = np.where(is_real, 1.0, expit(self.log_odds(source, began_later, duration_s, ended)))

        sums = np.zeros((len(self.false_s), len(DURATION_SUMS)))
        add_durations(source, began_later, duration_s, ended, is_real, p_real, sums)
        ended_0, ended_1, duration_0, duration_1 = sums[:, :4].T
        false_s = (duration_0 + FALSE_WEIGHT * self.prior_false_s) / (ended_0 + FALSE_WEIGHT)
        real_s = (duration_1 + REAL_WEIGHT * REAL_S) / (ended_1 + REAL_WEIGHT)
        counts = np.array(PRIOR_TRACKS)[:, None, :] + sums[:, 4:].reshape(-1, 2, 2).transpose(1, 0, 2)
        share = counts[0] / counts.sum(axis=0)
        # Without T₁ ≥ 2 T₀ the two components could exchange their roles.
        return DurationMixture(false_s, np.maximum(real_s, 2.0 * false_s), share, self.prior_false_s)


@dataclass(frozen=True)
class ExistenceOdds:
    """Existence of tracks (n,): their numbers, ABSENT for none; the log-odds that each is real when it begins, and the
    gain by its duration since."""

    track: IntArray
    log_initial: FloatArray
    log_gain: FloatArray


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
        at = places_of(self.number, tracks.number)
        is_old = at >= 0
        first_s, is_real, began_later = time_s.copy(), np.zeros(len(at), bool), tracks.source < len(self.mixture.share)
        first_s[is_old], is_real[is_old] = self.first_s[at[is_old]], self.is_real[at[is_old]]
        began_later[is_old] = self.began_later[at[is_old]]
        last_s = time_s.copy()
        last_s[is_old] = np.maximum(last_s[is_old], self.last_s[at[is_old]])
        n = len(at)
        current = TrackExistence(
            tracks.number, tracks.source, began_later, first_s, last_s, np.full(n, now_s), np.zeros(n), is_real
        )
        out, absent = replace(current, mixture=self._mixture(tracks)), places_of(tracks.number, self.number) < 0
        if absent.any():
            out = out.stacked(self._ended(np.flatnonzero(absent), tracks, now_s))
            out = out.take(np.argsort(out.number))
        duration_s, ended = out.last_s - out.first_s + out.after_s, out.last_scan_s < now_s
        mixture = out.mixture
        for _ in range(EM_STEPS):
            mixture = mixture.fitted(out.source, out.began_later, duration_s, ended, out.is_real)
        return replace(out, mixture=mixture)

    def with_real(self, number: IntArray) -> TrackExistence:
        """The same, with tracks that another source confirms as real; number : theirs."""
        at, is_real = places_of(self.number, number.ravel()), self.is_real.copy()
        is_real[at[at >= 0]] = True
        return replace(self, is_real=is_real)

    def log_odds(self, number: IntArray) -> tuple[FloatArray, FloatArray]:
        """The log-odds that tracks are real at their begin, and the gain by their duration since.

        number : of tracks, any shape. −∞ and 0 for ABSENT.
        """
        at, ended = places_of(self.number, number.ravel()).reshape(number.shape), np.zeros(len(self), bool)
        initial = self.mixture.log_odds(self.source, self.began_later, np.zeros(len(self)), ended)
        now = self.mixture.log_odds(self.source, self.began_later, self.last_s - self.first_s, ended)
        return np.append(initial, -math.inf)[at], np.append(now - initial, 0.0)[at]

    def of_objects(self, track: IntArray) -> ExistenceOdds:
        """The existence of the most probable track of each object; track : (n, S) its tracks, ABSENT for none."""
        track = np.column_stack([track, np.full(len(track), ABSENT)])
        log_initial, log_gain = self.log_odds(track)
        best = np.arange(len(track)), np.argmax(log_initial + log_gain, axis=1)
        return ExistenceOdds(track[best], log_initial[best], log_gain[best])

    def _ended(self, which: IntArray, tracks: NamedTracks, now_s: float) -> TrackExistence:
        """The tracks ``which``, not in the scan, without those whose id has timed out."""
        assert tracks.scan is not None
        which = which[now_s - self.last_scan_s[which] <= tracks.scan.tuning.id_timeout_s]
        just_ended = np.flatnonzero(self.after_s[which] == 0.0)
        after_s = self.after_s[which].copy()
        # The track ended between its last report and the later of the next scan and now minus the track timeout.
        timeout_s = _timeouts(tracks)[self.source[which[just_ended]]]
        period_s = self.mixture.prior_false_s[self.source[which[just_ended]]] / FALSE_SCANS
        after_s[just_ended] = 0.5 * np.maximum(now_s - timeout_s - self.last_s[which[just_ended]], period_s)
        return replace(self.take(which), after_s=after_s)

    def _mixture(self, tracks: NamedTracks) -> DurationMixture:
        """The model of the previous instant, with the new sources at their prior."""
        assert tracks.scan is not None
        new = tracks.error_correlation.names[len(self.mixture.share) :]
        periods = {d.name: d.timing.period_s or PERIOD_S for d in tracks.scan.now.descriptions}
        return self.mixture.with_sources(np.array([periods[name] for name in new], np.float64))


def _timeouts(tracks: NamedTracks) -> FloatArray:
    """(s,) the track timeout of each source; ∞ for sources that are not in the scan."""
    assert tracks.scan is not None
    timeout_s = {feed.description.name: feed.track_timeout_s for feed in tracks.scan.now.feeds}
    return np.array([timeout_s.get(name, math.inf) for name in tracks.error_correlation.names])

"""Track existence: the probability that a named track is of a real object, by its duration.

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
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.special import expit

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.picture.named import NamedTracks
from sameas.picture.object_table import ColumnTable
from sameas.picture.tuning import DEFAULT_TUNING, Tuning
from sameas.ragged import places_in


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

"""Track existence: whether a named track is of something real, by how long it has lived.

False echoes make tracks, too: a tracker that has seen the same patch of sea four times running gives it a number. They
die soon, and real objects' tracks go on until the object is lost. So a source's tracks live for exponential times of
two means, T₀ for the false and T₁ for the real ones, which are a share w of those that begin (and another share of
those that were there when the source was first heard); and of one that has lived for ℓ and still does

    ln P(real) / P(false) = ln w / (1 − w) + ℓ (1/T₀ − 1/T₁).

That is Wald's sequential test, and what it confirms at a probability p is false in at most
1 − p of all cases, where lives are such. These numbers are estimated source by source from all its tracks so far,
those that live still as censored ones, those that another source has shown to be real as known ones, by EM; before
there are any, T₀ is :data:`FALSE_SCANS` looks and weighs as much as :data:`BEFOREHAND` tracks.

Source: Wald 1947, section 3; mixtures of lives with censoring as in McLachlan and Peel 2000, section 10.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.special import expit

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.picture.named import KEPT_S, NamedTracks, found_in
from sameas.picture.object_table import ColumnTable

#: T₀ before any track has died, in looks of the source; and how many tracks that is worth (chosen).
FALSE_SCANS, BEFOREHAND = 4.0, 4.0
#: T₁ before any real track has died, and how many tracks that is worth (chosen).
REAL_S, REAL_BEFOREHAND = 1800.0, 1.0
#: Tracks as real (first row) and false ones, there first and begun later, that all sources are believed to have had
#: before: what begins later is false more often than not (chosen).
ALIKE = np.array([[1.0, 1.0], [1.0, 3.0]])
#: Between two looks where the description does not say.
PERIOD_S = 10.0
#: Steps of EM at every instant; it goes on from where it was.
STEPS = 4


@dataclass(frozen=True)
class Mixture(ColumnTable):
    """Of the sources heard so far (s,): T₀ and T₁ in seconds, and T₀ beforehand; share : (s, 2) of the real among the
    tracks that were there first, and among those that began later."""

    false_s: FloatArray = field(default_factory=lambda: np.empty(0))
    real_s: FloatArray = field(default_factory=lambda: np.empty(0))
    share: FloatArray = field(default_factory=lambda: np.empty((0, 2)))
    before_s: FloatArray = field(default_factory=lambda: np.empty(0))

    def with_sources(self, period_s: FloatArray) -> Mixture:
        """The same and new sources with these periods (k,)."""
        before, n = FALSE_SCANS * period_s, len(period_s)
        share = np.tile(ALIKE[0] / ALIKE.sum(axis=0), (n, 1))
        return self.stacked(Mixture(before, np.maximum(REAL_S, 10.0 * before), share, before))

    def log_odds(self, source: IntArray, later: BoolArray, life_s: FloatArray, ended: BoolArray) -> FloatArray:
        """(n,) ln of the odds that tracks are real."""
        rate_0, rate_1 = 1.0 / self.false_s[source], 1.0 / self.real_s[source]
        share = self.share[source, later.astype(np.int64)]
        at_end = np.where(ended, np.log(rate_1 / rate_0), 0.0)
        return np.asarray(np.log(share) - np.log1p(-share) + at_end + life_s * (rate_0 - rate_1))

    def fitted(
        self, source: IntArray, later: BoolArray, life_s: FloatArray, ended: BoolArray, known: BoolArray
    ) -> Mixture:
        """One step of EM on tracks (n,); ``known``: to be real."""
        real = np.where(known, 1.0, expit(self.log_odds(source, later, life_s, ended)))

        def sums(weight: FloatArray) -> FloatArray:
            return np.asarray(np.bincount(source, weight, len(self.false_s)), np.float64)

        dead_0, dead_1 = sums((1.0 - real) * ended), sums(real * ended)
        false_s = (sums((1.0 - real) * life_s) + BEFOREHAND * self.before_s) / (dead_0 + BEFOREHAND)
        real_s = (sums(real * life_s) + REAL_BEFOREHAND * REAL_S) / (dead_1 + REAL_BEFOREHAND)
        # Those that others have shown to be real are told from the rest, and say nothing of how many of these are.
        unknown = [~known & (later == which) for which in (False, True)]
        counts = ALIKE[:, :, None] + [[sums(weight * some) for some in unknown] for weight in (real, 1.0 - real)]
        share = (counts[0] / counts.sum(axis=0)).T
        # Real ones live longer: without that, either name could be the other's.
        return Mixture(false_s, np.maximum(real_s, 2.0 * false_s), share, self.before_s)


@dataclass(frozen=True)
class TrackExistence(ColumnTable):
    """The lives of named tracks, (k,) each, by ascending number.

    number, source : of the track, and the place of its source in ``NamedTracks.error_correlation.names``.
    later : whether it began after its source was first heard.
    first_s, last_s : times of its first and its last report. shown_s : when it was last in a scan.
    later_s : for how long after its last report it may have lived on, unheard, in the mean.
    known : whether another source has shown it to be real.
    """

    WHOLE = frozenset({"mixture"})
    number: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    source: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    later: BoolArray = field(default_factory=lambda: np.empty(0, bool))
    first_s: FloatArray = field(default_factory=lambda: np.empty(0))
    last_s: FloatArray = field(default_factory=lambda: np.empty(0))
    shown_s: FloatArray = field(default_factory=lambda: np.empty(0))
    later_s: FloatArray = field(default_factory=lambda: np.empty(0))
    known: BoolArray = field(default_factory=lambda: np.empty(0, bool))
    mixture: Mixture = field(default_factory=Mixture)

    def __len__(self) -> int:
        return len(self.number)

    def on(self, tracks: NamedTracks) -> TrackExistence:
        """After the instant of these tracks."""
        assert tracks.scan is not None
        scan, now_s = tracks.scan, tracks.instant_s
        time_s = scan.time_s[tracks.place]
        at = found_in(self.number, tracks.number)
        old = at >= 0
        first_s, known, later = time_s.copy(), np.zeros(len(at), bool), tracks.source < len(self.mixture.share)
        first_s[old], known[old], later[old] = self.first_s[at[old]], self.known[at[old]], self.later[at[old]]
        last_s = time_s.copy()
        last_s[old] = np.maximum(last_s[old], self.last_s[at[old]])
        n = len(at)
        shown = TrackExistence(
            tracks.number, tracks.source, later, first_s, last_s, np.full(n, now_s), np.zeros(n), known
        )
        gone = self._gone(np.flatnonzero(found_in(tracks.number, self.number) < 0), tracks, now_s)
        whole = gone.stacked(shown)
        lives = replace(whole.take(np.argsort(whole.number)), mixture=self._mixture(tracks))
        life_s, ended = lives.last_s - lives.first_s + lives.later_s, lives.shown_s < now_s
        mixture = lives.mixture
        for _ in range(STEPS):
            mixture = mixture.fitted(lives.source, lives.later, life_s, ended, lives.known)
        return replace(lives, mixture=mixture)

    def met(self, number: IntArray) -> TrackExistence:
        """The same, with tracks that another source has shown to be real."""
        return replace(self, known=self.known | np.isin(self.number, number))

    def log_odds(self, number: IntArray) -> tuple[FloatArray, FloatArray]:
        """ln of the odds that tracks were of something real when they began, and what their lives have added since.

        number : of tracks, any shape. −∞ and 0 for −1.
        """
        at, living = found_in(self.number, number.ravel()).reshape(number.shape), np.zeros(len(self), bool)
        begun = self.mixture.log_odds(self.source, self.later, np.zeros(len(self)), living)
        now = self.mixture.log_odds(self.source, self.later, self.last_s - self.first_s, living)
        return np.append(begun, -math.inf)[at], np.append(now - begun, 0.0)[at]

    def _gone(self, which: IntArray, tracks: NamedTracks, now_s: float) -> TrackExistence:
        """The tracks that are not in the scan, but those that went long ago."""
        which = which[now_s - self.shown_s[which] <= KEPT_S]
        just = np.flatnonzero(self.later_s[which] == 0.0)
        later_s = self.later_s[which].copy()
        # It was dropped some time between its last report and the next look, or now less the silence that may be.
        silence_s = _silences(tracks)[self.source[which[just]]]
        period_s = self.mixture.before_s[self.source[which[just]]] / FALSE_SCANS
        later_s[just] = 0.5 * np.maximum(now_s - silence_s - self.last_s[which[just]], period_s)
        return replace(self.take(which), later_s=later_s)

    def _mixture(self, tracks: NamedTracks) -> Mixture:
        """That of the last instant, with the sources that were not heard before."""
        assert tracks.scan is not None
        new = tracks.error_correlation.names[len(self.mixture.share) :]
        periods = {d.name: d.timing.period_s or PERIOD_S for d in tracks.scan.now.descriptions}
        return self.mixture.with_sources(np.array([periods[name] for name in new], np.float64))


def _silences(tracks: NamedTracks) -> FloatArray:
    """(s,) after how long a track of each source has ended; ∞ for sources that are not heard now."""
    assert tracks.scan is not None
    silence = {feed.description.name: feed.track_timeout_s for feed in tracks.scan.now.feeds}
    return np.array([silence.get(name, math.inf) for name in tracks.error_correlation.names])

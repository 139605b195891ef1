"""Plot existence: the probability that an object is real which only plots without names show, by its hits and misses.

For pictures in which another source has names (AIS, a tracker); where none has, :mod:`sameas.picture.plot_tracker`
follows the plots of all sources. Clutter gives plots, too. An object begins with a plot, with odds

    u β (1 − q) / λ

that it is real: β objects per m², of which the share u has not been seen before; q the probability that the source
misses one, and λ its clutter there, per m² and look. At each later instant the odds are multiplied

    by (1 − q) N(z; x, P + R) / λ    if a new plot z ± R is of the object, which is expected at x ± P,
    by 1 − s (1 − q)                 otherwise, s the part of a look that the source has taken since then.

Objects differ: 1 − s (1 − q) is that of the place with the weight of ``OWN_LOOKS``, and the object's own misses among
its last looks; 1 − q changes by the same factor as its complement.

The share of those not seen before falls with every look, and rises as objects come, which stay for a mean time T:

    u ← u · Π (1 − s (1 − q)) · e^(−Δt/T) + 1 − e^(−Δt/T),    u = 1 at first.

Under the model at most a share 1 − p of the objects that are confirmed at probability p is false.

Source: integrated probabilistic data association, Mušicki, Evans and Stanković 1994, IEEE Trans. Automatic Control 39,
section III, with the most probable assignment only.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, logit

from sameas.arrays import ABSENT, BoolArray, ColumnTable, FloatArray, IntArray
from sameas.gaussian import log_density
from sameas.picture.bernoulli import MIN_PROBABILITY
from sameas.picture.hull_echoes import OWN_LOOKS_KEPT, Hulls, ScanPlots
from sameas.picture.plot_tracker import MIN_EXISTENCE, MIN_SHARE_OF_INITIAL
from sameas.picture.tables import ObjectTable, Scan, objects_per_m2
from sameas.picture.track_existence import REAL_S
from sameas.picture.tuning import DEFAULT_TUNING, Tuning
from sameas.tracks.alignment import States
from sameas.tracks.feed import Feed
from sameas.tracks.scans import joint_times
from sameas.tracks.scene import Instant

#: Least probability of which a logarithm is taken.
MIN_P = 1e-12

#: Beside named tracks, the probability that a source of plots misses an object is within this of 0 and 1: misses of one
#: object come in runs.
LEAST_Q = 0.1
OWN_LOOKS = 6.0  # weight of the usual misses beside an object's own, in looks


@dataclass(frozen=True)
class Looks:
    """The looks since the previous instant of the sources that give plots without names.

    feeds : of these sources. share : (f,) s, the part of a look that each has taken. per_m2 : β, objects per m².
    """

    instant_s: float
    feeds: tuple[Feed, ...]
    share: FloatArray
    per_m2: float

    @classmethod
    def since(cls, now: Instant, before_s: float) -> Looks:
        """The looks of an instant after ``before_s``, −∞ for none before."""
        plots = [feed for feed in now.feeds if gives_plots(feed)]
        share = np.array([_part_of_a_look(feed, before_s, now.instant_s) for feed in plots], np.float64)
        looked = np.flatnonzero(share > 0.0).tolist()
        return cls(now.instant_s, tuple(plots[k] for k in looked), share[looked], objects_per_m2(now))

    def p_missed(self, places: FloatArray) -> FloatArray:
        """(n,) probability that no source has a new plot of a real object at each of the places (n, 2)."""
        out = np.ones(len(places))
        for feed, share in zip(self.feeds, self.share.tolist(), strict=True):
            out *= 1.0 - share * (1.0 - self.miss_rate(feed, places))
        return out

    def miss_rate(self, feed: Feed, places: FloatArray) -> FloatArray:
        """(n,) q of a source at each of the places (n, 2), within ``LEAST_Q`` of 0 and 1: misses of one object come in
        runs."""
        return np.asarray(np.clip(feed.q_at(places, self.instant_s), LEAST_Q, 1.0 - LEAST_Q))

    def unseen_share(self, before: float, places: FloatArray, elapsed_s: float) -> float:
        """u after the looks; before : u. places : (n, 2) of the objects."""
        p_missed = float(self.p_missed(places).mean()) if len(places) else 1.0
        return still_unseen(before, p_missed, elapsed_s, REAL_S)


def gives_plots(feed: Feed) -> bool:
    """Whether a source gives positions without names."""
    return feed.reports.track is None and isinstance(feed.reports, States)


def looks_between(
    feeds: Sequence[Feed], after_s: float, until_s: float, tuning: Tuning = DEFAULT_TUNING
) -> list[float]:
    """The times, ascending, of the looks of sources of plots that neither an instant at ``after_s`` nor one at
    ``until_s`` shows: at least ``scan_every_s`` apart, the last ``scan_steps`` of them."""
    times_s = [feed.superseded_scans_s(after_s, until_s) for feed in feeds if gives_plots(feed)]
    if not times_s:
        return []
    return joint_times(np.unique(np.concatenate(times_s)), tuning.scan_every_s)[-tuning.scan_steps :]


def still_unseen(share: float, p_missed: float, elapsed_s: float, stay_s: float) -> float:
    """The share u of the objects that no look has shown yet, after looks that miss one with ``p_missed``; objects stay
    for ``stay_s`` in the mean, and as many come."""
    stays = math.exp(-elapsed_s / stay_s)
    return share * p_missed * stays + 1.0 - stays


def _part_of_a_look(feed: Feed, after_s: float, until_s: float) -> float:
    """The part of a look, at most 1, that a source has taken in (after_s, until_s]."""
    times_s = feed.scan_times_s
    if feed.rotation is None:
        return float(((times_s > after_s) & (times_s <= until_s)).any())
    if not (times_s <= until_s).any():
        return 0.0
    return min((until_s - after_s) / feed.rotation.period_s, 1.0)


@dataclass(frozen=True)
class NewPlots(ColumnTable):
    """The new plot of each object of an instant, (n,) each; of several that with the least clutter about it.

    found : whether it has one. place, covariance : (n, 2), (n, 2, 2) of the plot. log_odds_per_m2 : ln[(1 − q) / λ].
    clutter_per_m2 : λ about the plots of an object without names, new or not; 0 for one with a name.
    own_clutter_per_m2, source : λ of the new plot, and the name of its source.
    """

    found: BoolArray
    place: FloatArray
    covariance: FloatArray
    log_odds_per_m2: FloatArray
    clutter_per_m2: FloatArray
    own_clutter_per_m2: FloatArray
    source: NDArray[Any]
    extent: FloatArray

    @classmethod
    def none(cls, n: int) -> NewPlots:
        """No new plot of n objects."""
        covariance = np.broadcast_to(np.eye(2), (n, 2, 2)).copy()
        return cls(np.zeros(n, bool), np.zeros((n, 2)), covariance, np.zeros(n), np.zeros(n), np.zeros(n),
                   np.full(n, "", dtype=object), np.zeros((n, 2, 2)))  # fmt: skip

    @classmethod
    def of(cls, scan: Scan, members: IntArray, is_new: BoolArray, is_named: BoolArray, looks: Looks) -> NewPlots:
        """members : (n, S) records of the objects, ABSENT for none. is_new, is_named : (records,) whether the report is
        new, and whether it is of a named track."""
        is_plot, clutter, log_odds = ~is_named & scan.placed, np.zeros(len(scan)), np.full(len(scan), -math.inf)
        if not is_plot.any():
            return cls.none(len(members))
        for s, feed in enumerate(scan.now.feeds):
            rows = scan.start[s] + np.flatnonzero(is_plot[scan.start[s] : scan.start[s + 1]])
            clutter[rows] = feed.clutter_at(scan.row[rows], 2)
            new = rows[is_new[rows] & (clutter[rows] > 0.0)]
            log_odds[new] = np.log1p(-looks.miss_rate(feed, scan.state[new, :2])) - np.log(clutter[new])
        members = np.column_stack([members, np.full(len(members), ABSENT)])
        of_members = np.append(log_odds, -math.inf)[members]
        out = cls.none(len(members))
        out.found[:] = np.isfinite(of_members).any(axis=1)
        best = members[np.arange(len(members)), of_members.argmax(axis=1)][out.found]
        out.place[out.found], out.extent[out.found] = scan.state[best, :2], scan.hull_covariance[best]
        out.covariance[out.found] = scan.covariance[best, :2, :2] - out.extent[out.found]
        out.log_odds_per_m2[out.found], out.own_clutter_per_m2[out.found] = log_odds[best], clutter[best]
        names = np.array([description.name for description in scan.now.descriptions], dtype=object)
        out.source[out.found] = names[scan.source[best]]
        only_plots = np.append(is_plot, True)[members].all(axis=1)
        out.clutter_per_m2[only_plots] = np.append(clutter, 0.0)[members[only_plots]].max(axis=1)
        return out

    def besides(self, hulls: Hulls, own: IntArray) -> NewPlots:
        """These with the echoes of hulls as further clutter about them, and those of owners at any place of the hull.

        own : (n,) numbers of the objects, 0 for new ones.
        """
        if not hulls.echoes or not self.found.any():
            return self
        density = np.zeros(len(self.found))
        for name in np.unique(self.source[self.found].astype(str)).tolist():
            at = np.flatnonzero(self.found & (self.source == name))
            density[at] = hulls.per_m2(name, ScanPlots(self.place[at], self.covariance[at], own[at]))
        log_odds = self.log_odds_per_m2 - np.log1p(density / np.where(self.found, self.own_clutter_per_m2, 1.0))
        clutter = self.clutter_per_m2 + np.where(self.clutter_per_m2 > 0.0, density, 0.0)
        extent = np.where(np.isin(own, hulls.owners.number)[:, None, None], self.extent, 0.0)
        return replace(
            self, log_odds_per_m2=log_odds, clutter_per_m2=clutter, covariance=self.covariance + extent, extent=extent
        )

    def log_initial(self, per_m2: float, unseen_share: float) -> FloatArray:
        """(n,) log-odds that objects which begin with these plots are real; −∞ without a new plot."""
        return np.where(self.found, self.log_odds_per_m2 + math.log(per_m2 * unseen_share), -math.inf)


@dataclass(frozen=True)
class PlotOdds:
    """What plots say of objects, (k,) each.

    log_odds, log_initial : log-odds that the object is real, now and with its first plot; −∞ without a plot. looked,
    missed : its looks, and those that missed it; old ones fade.
    """

    log_odds: FloatArray
    log_initial: FloatArray
    looked: FloatArray
    missed: FloatArray

    @classmethod
    def begun(cls, plots: NewPlots, looks: Looks, unseen_share: float) -> PlotOdds:
        """Those of new objects with these plots."""
        initial = plots.log_initial(looks.per_m2, unseen_share)
        return cls(initial, initial, np.zeros(len(initial)), np.zeros(len(initial)))

    @property
    def known(self) -> BoolArray:
        """(k,) whether the object has had a plot."""
        return np.isfinite(self.log_odds)

    def after(
        self, objects: ObjectTable, plots: NewPlots, looks: Looks, elapsed_s: float, unseen_share: float
    ) -> PlotOdds:
        """Those after an instant; objects : (k,) predicted to it. plots : (k,) their new ones. elapsed_s : since the
        previous instant. unseen_share : as for :meth:`begun`."""
        begun = PlotOdds.begun(plots, looks, unseen_share)
        first = begun.known & ~self.known
        log_initial = np.where(first, begun.log_initial, self.log_initial)
        if not self.known.any() or (not looks.feeds and not plots.found.any()):
            return replace(self, log_odds=np.where(first, begun.log_odds, self.log_odds), log_initial=log_initial)
        found = plots.found & self.known
        usual = looks.p_missed(objects.state[:, :2])
        p_missed = self.p_missed(usual)
        gain, hit = np.log(p_missed), np.flatnonzero(found)
        total = plots.covariance[hit] + objects.covariance[hit, :2, :2]
        gain[hit] = plots.log_odds_per_m2[hit] + log_density(plots.place[hit] - objects.state[hit, :2], total)
        gain[hit] += np.log1p(-p_missed[hit]) - np.log(np.maximum(1.0 - usual[hit], MIN_P))
        p_stays = np.clip(math.exp(-elapsed_s / REAL_S) * expit(self.log_odds), MIN_P, 1.0 - MIN_P)
        bound = _bound()
        log_odds = np.where(self.known, np.clip(logit(p_stays) + gain, -bound, bound), begun.log_odds)
        kept = 1.0 / (1.0 + 1.0 / OWN_LOOKS_KEPT)
        return PlotOdds(log_odds, log_initial, kept * self.looked + 1.0, kept * self.missed + ~found)

    def p_missed(self, usual: FloatArray) -> FloatArray:
        """(k,) probability that a look misses each object; usual : (k,) that of its place."""
        return (OWN_LOOKS * usual + self.missed) / (OWN_LOOKS + self.looked)

    def improbable(self, was_confirmed: BoolArray) -> BoolArray:
        """(k,) whether plots make the object improbable: among much clutter that of a real one begins so, too.

        was_confirmed : (k,) whether it was confirmed. One that began below the least odds would never end.
        """
        least = np.minimum(logit(MIN_EXISTENCE), self.log_initial + math.log(MIN_SHARE_OF_INITIAL))
        least = np.where(was_confirmed, np.maximum(least, -_bound()), least)
        return np.asarray(self.known & (self.log_odds <= least))


def _bound() -> float:
    """The largest log-odds, so that later looks can change them."""
    return float(logit(1.0 - MIN_PROBABILITY))

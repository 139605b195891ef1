"""Plot rates: the misses of a source of plots without names, and its clutter about each place (a clutter map).

What is assumed for a kind of sensor is often wrong by a factor of ten: a small radar on a boat misses four ships of
five, and shores, buoys and waves give plots at the same places, scan after scan. So both are counted from instant to
instant, but for the misses and the mean clutter that a description gives:

- misses q: the share of the looks at confirmed objects with a name (AIS, a tracker) that gave no plot of them, with the
  assumed q as a prior of ``RATE_LOOKS`` looks;
- clutter λ at a plot z ± R: the plots of the last ``CLUTTER_S`` within ``CLUTTER_SIGMAS`` of z that are not of an
  object with a name, per m² and look: their mean over all places, or, with the prior probability ``DENSE_SHARE``, a
  density there of anything up to one plot a look. The assumed clutter has the weight of one plot in the mean.

Earlier plots at the place of the next one are no clutter about it, if there are not as many of other objects beside
them: an echo that returns within its own error is an object, a boat or a buoy, and many about each other, as of a
shore, are clutter.

The further echoes of a hull are clutter, too (:mod:`sameas.picture.hull_echoes`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import expit, gammaln, xlogy

from sameas.arrays import BoolArray, FloatArray, IntArray, spans_in
from sameas.many.observations import records_of
from sameas.picture.hull_echoes import CLUTTER_SIGMAS, HullEchoes, ScanPlots
from sameas.picture.plot_existence import Looks
from sameas.picture.tables import ObjectTable, Scan
from sameas.ragged import ranges
from sameas.tracks.alignment import States
from sameas.tracks.feed import Feed
from sameas.tracks.scene import Instant
from sameas.tracks.source import CLUTTER, MISSES, Description, MissRate

#: Weight of the assumed clutter, in plots.
MEAN_WEIGHT = 1.0
#: So many times the plots that the mean density gives are usual about a plot.
AROUND_USUAL = 2.0
#: A place is like those beside it if these have one plot for so many of its own: they are few at first.
BESIDE = 3.0
#: A plot may be of an object within this many 1σ.
GATE_SIGMAS = 3.0

RATE_LOOKS = 10.0  # weight of an assumed miss rate, in looks at objects
#: The clutter about a plot is counted over this time, or that of so many plots; echoes within AROUND_SIGMAS of it are
#: beside it, as on a shore.
CLUTTER_S, MOST_PLOTS, AROUND_SIGMAS = 300.0, 20_000, 6.0
DENSE_SHARE = 0.1  # prior probability that the clutter at a place is denser than elsewhere


@dataclass(frozen=True)
class SourceCounts:
    """Counts of one source of plots.

    looked, hit : looks at confirmed objects with a name, and those that gave a plot of them.
    time_s, place, number : (m,), (m, 2), (m,) of the last plots that are not of an object with a name: the instant, the
    position, and the number of the object. look_s, share : (l,) the instants with a look, and its part of a whole one.
    """

    looked: float = 0.0
    hit: float = 0.0
    time_s: FloatArray = field(default_factory=lambda: np.empty(0))
    place: FloatArray = field(default_factory=lambda: np.empty((0, 2)))
    number: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    look_s: FloatArray = field(default_factory=lambda: np.empty(0))
    share: FloatArray = field(default_factory=lambda: np.empty(0))

    def with_look(self, instant_s: float, share: float, place: FloatArray, number: IntArray) -> SourceCounts:
        """The counts after a look; place, number : (k, 2), (k,) of its plots."""
        since_s = instant_s - CLUTTER_S
        if len(self.time_s) > MOST_PLOTS:
            since_s = max(since_s, float(self.time_s[-MOST_PLOTS]))
        old, looks = self.time_s >= since_s, self.look_s >= since_s
        return replace(
            self,
            time_s=np.concatenate([self.time_s[old], np.full(len(place), instant_s)]),
            place=np.concatenate([self.place[old], place]), number=np.concatenate([self.number[old], number]),
            look_s=np.append(self.look_s[looks], instant_s), share=np.append(self.share[looks], share),
        )  # fmt: skip

    def miss_rate(self, assumed: float) -> float:
        """q, with the assumed one as prior."""
        n = RATE_LOOKS
        return (n * assumed + self.looked - self.hit) / (n + self.looked)

    def clutter_per_m2(self, place: FloatArray, sigma: FloatArray, own: IntArray, usual: FloatArray) -> FloatArray:
        """(n,) λ at plots.

        place, sigma : (n, 2), (n,) of them, and their largest 1σ. own : (n,) the number of the object that each may be
        of, 0 for none. usual : (n,) λ where they do not return to the place, per m² and look.
        """
        looks = float(self.share.sum())
        radius = np.outer((CLUTTER_SIGMAS, GATE_SIGMAS, AROUND_SIGMAS), sigma)
        (here, _), (gate, gate_own), (around, around_own) = self._within(place, radius, own)
        area = math.pi * radius[0] ** 2
        expected_beside = AROUND_USUAL * usual * math.pi * (radius[2] ** 2 - radius[1] ** 2) * looks
        # A place at which plots return, with others beside it as on a shore.
        beside = np.maximum(around - around_own - (gate - gate_own) - expected_beside, 0.0)
        near = np.minimum(here, BESIDE * beside)
        # As dense as everywhere, or anything up to one plot a look.
        expected = usual * area * looks
        log_dense = math.log(DENSE_SHARE / (1.0 - DENSE_SHARE)) - math.log1p(looks)
        p_dense = expit(log_dense - xlogy(near, expected) + expected + gammaln(near + 1.0))
        return np.asarray((1.0 - p_dense) * usual + p_dense * (near + 1.0) / (looks + 2.0) / area)

    def _within(self, place: FloatArray, radii_m: FloatArray, own: IntArray) -> list[tuple[FloatArray, FloatArray]]:
        """For each of the radii (r, n) the plots within it of each place, (n,), and those of ``own`` among these."""
        order, tree = np.argsort(self.number, kind="stable"), cKDTree(self.place)
        at, row = ranges(*spans_in(self.number[order], own))
        distance_m = np.hypot(*(self.place[order[row]] - place[at]).T)
        out = []
        for radius_m in radii_m:
            of_own = np.bincount(at[distance_m <= radius_m[at]], minlength=len(place)).astype(np.float64)
            out.append((tree.query_ball_point(place, radius_m, return_length=True).astype(np.float64), of_own))
        return out


def mean_per_m2(place: FloatArray, looks: float, assumed_per_m2: float) -> float:
    """Mean density of the plots (m, 2) of so many looks over all their places, per m² and look."""
    # Of places spread evenly over a disc the area is 4π times the root of the determinant of their covariance.
    spread = float(np.linalg.det(np.cov(place.T))) if len(place) > 2 else 0.0
    area = 4.0 * math.pi * math.sqrt(max(spread, 0.0))
    return (len(place) + MEAN_WEIGHT) / (area * looks + MEAN_WEIGHT / assumed_per_m2)


def _largest_sigma(covariance: FloatArray) -> FloatArray:
    """(n,) the largest 1σ of covariances (n, 2, 2)."""
    return np.asarray(np.sqrt(np.linalg.eigvalsh(covariance)[:, -1]))


def nearest_object(place: FloatArray, covariance: FloatArray, known: ObjectTable) -> IntArray:
    """(n,) the number of the object that is nearest to each plot, 0 where none is within ``GATE_SIGMAS``.

    place, covariance : (n, 2), (n, 2, 2) of the plots.
    """
    out = np.zeros(len(place), np.int64)
    if len(known) and len(place):
        distance, row = cKDTree(known.state[:, :2]).query(place)
        sigma = np.hypot(_largest_sigma(covariance), _largest_sigma(known.covariance[row, :2, :2]))
        within = distance <= GATE_SIGMAS * sigma
        out[within] = known.number[row[within]]
    return out


@dataclass(frozen=True)
class PlotRates:
    """The counts of the sources of plots without names, by name of the source; of : misses and clutter. hulls : plots
    about owners of hulls."""

    of: Mapping[str, SourceCounts] = field(default_factory=dict)
    hulls: Mapping[str, HullEchoes] = field(default_factory=dict)

    def applied(self, now: Instant, known: ObjectTable) -> Instant:
        """The instant with the counted misses and clutter of the sources of plots, where they were assumed.

        known : the objects that only plots show, predicted to the instant.
        """
        feeds = zip(now.feeds, now.sources, strict=True)
        applied = (self._applied(feed, records_of(own).ids, known) for feed, own in feeds)
        return replace(now, feeds=tuple(applied))

    def _applied(self, feed: Feed, ids: NDArray[Any], known: ObjectTable) -> Feed:
        reports, description, described = feed.reports, feed.description, feed.description.clutter.per_km2
        if reports.track is not None or not isinstance(reports, States):
            return feed
        counts = self.of.get(description.name, SourceCounts())
        if description.is_assumed(MISSES) and isinstance(description.misses.q, float):
            q = counts.miss_rate(description.misses.q)
            description = replace(description, misses=MissRate.counted(q))
        clutter = feed.clutter_per_m2
        if described:
            rows, looks = ids.astype(np.int64), float(counts.share.sum())
            place, covariance = reports.state[rows, :2], reports.covariance[rows, :2, :2]
            usual = np.broadcast_to(feed.clutter_at(rows, 2), len(rows))
            if description.is_assumed(CLUTTER):
                given = looks > 0.0
                mean = mean_per_m2(counts.place if given else place, looks if given else 1.0, 1e-6 * described)
                usual = np.full(len(rows), mean)
            clutter = np.full(len(reports), 1e-6 * described) if clutter is None else clutter.copy()
            clutter[rows] = counts.clutter_per_m2(
                place, _largest_sigma(covariance), nearest_object(place, covariance, known), usual
            )
        return replace(feed, description=description, clutter_per_m2=clutter)

    def lines(self, descriptions: Sequence[Description]) -> list[str]:
        """Printable lines on what was counted in place of what was assumed; descriptions : of the sources."""
        out = []
        for description in descriptions:
            counts, words = self.of.get(description.name), []
            assumed = {line.name: line.value for line in description.assumed}
            if counts is None:
                continue
            if MISSES in assumed and counts.looked >= RATE_LOOKS and isinstance(assumed[MISSES], float):
                rates = 100.0 * counts.miss_rate(assumed[MISSES]), 100.0 * assumed[MISSES]
                words.append("misses {:.0f} % of the objects with names ({:.0f} % was assumed)".format(*rates))
            if assumed.get(CLUTTER) and len(counts.look_s) >= RATE_LOOKS:
                per_m2 = mean_per_m2(counts.place, float(counts.share.sum()), 1e-6 * assumed[CLUTTER])
                words.append(
                    f"has {1e6 * per_m2:.2g} other plots per km² and scan (clutter of {assumed[CLUTTER]:.2g} was "
                    "assumed), of which those about each plot count as its clutter"
                )
            if words:
                out.append(f"{description.name}: {'; '.join(words)}")
        return out

    def advance(
        self, scan: Scan, looks: Looks, is_named: BoolArray, number: IntArray, is_new: BoolArray,
        named: ObjectTable, shown: BoolArray, owners: ObjectTable,
    ) -> PlotRates:  # fmt: skip
        """The counts after an instant.

        is_named, number : (records,), (records,) whether the object of each record of the scan has a name, and its
            number. is_new : (records,) whether the report is new. named : (k,) the confirmed objects with a name.
            shown : (k, S) whether each source of the scan has a new plot of them. owners : of hulls.
        """
        out, hulls = dict(self.of), dict(self.hulls)
        plain = scan.covariance[:, :2, :2] - scan.hull_covariance
        names, places = [description.name for description in scan.now.descriptions], named.state[:, :2]
        for feed, share in zip(looks.feeds, looks.share.tolist(), strict=True):
            name = feed.description.name
            counts = out.get(name, SourceCounts())
            if name in names:
                s = names.index(name)
                rows = np.arange(scan.start[s], scan.start[s + 1])
                new = rows[is_new[rows] & scan.placed[rows]]
                rows = new[~is_named[new]]
                hit = shown[:, s]
            else:
                new, rows = np.empty((2, 0), np.int64)
                hit = np.zeros(len(named), bool)
            covered = feed.q_at(places, looks.instant_s) < 1.0
            counts = counts.with_look(looks.instant_s, share, scan.reported_state[rows, :2], number[rows])
            hulls[name] = hulls.get(name, HullEchoes()).after(
                share, owners, ScanPlots(scan.state[new, :2], plain[new], number[new])
            )
            looked, hits = share * float(covered.sum()), float((hit & covered).sum())
            out[name] = replace(counts, looked=counts.looked + looked, hit=counts.hit + hits)
        return PlotRates(out, hulls)

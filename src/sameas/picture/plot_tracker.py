"""Plot tracker: objects followed from scan to scan, where sources show bare plots and directions without names.

    tracker, tracks = PlotTracker(), None
    for t in instants:
        tracks = tracker.advance(scene.at(t, features=POSITION_AND_VELOCITY), tracks)

At every instant the last look of every source stands, and all that stand are identified jointly, together with the
objects remembered from looks before them (:mod:`sameas.picture.bernoulli`). Only when a look is replaced by the next
one of its source does it become memory, once, with the members that it had last: what a look is of stays open as long
as it stands. So nothing fused comes back as evidence of itself.

The errors of looks last: the same side of a hull, the same error of a compass. A look counts as the share of one that
it adds, Δt/τ, in the states. And sources miss the same objects again and again, which every object remembers.

Use it where sources name nothing; tracks with names have :class:`sameas.picture.Watch`, and a whole picture of bare
plots :class:`sameas.picture.PlotPicture`. Source: METHOD 7; Bernoulli
objects with a Poisson field of unknown ones as in Williams 2015, the most probable hypothesis kept.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import FloatArray, IntArray
from sameas.errors import InputError
from sameas.many.identify import identify_many
from sameas.many.joint import Joint, joint_density
from sameas.many.objects import Objects
from sameas.many.observations import Observations, Region, Source, records_of
from sameas.picture.bernoulli import KNOWN, LEAST, BernoulliObjects, BernoulliTable, Sighting
from sameas.picture.scan import objects_per_m2
from sameas.tracks.alignment import aged
from sameas.tracks.feed import Feed, walk_of
from sameas.tracks.placement import Directions
from sameas.tracks.scene import POSITION_AND_VELOCITY, Instant
from sameas.tracks.snapshot import pointed_at

#: Where neither the description nor the kind of a source says how often it shows one object as two.
SPLIT = 0.02
#: Less probable objects are forgotten.
FORGOTTEN = 0.01
#: The region does not say where known objects are: it is this much wider for them.
WIDE = 1e4


@dataclass(frozen=True)
class PlotTracker:
    """How objects are followed.

    Parameters
    ----------
    correlation_s : τ, correlation time of the errors of scans; 10 s (chosen).
    lifetime_s : mean time that objects last undetected. sighting_scans : how many scans the described probability of a
        miss is worth against the object's own hits and misses, which count for sighting_s.
    least_q : no probability of a miss is nearer to 0 or 1: misses of one object repeat themselves.
    """

    correlation_s: float = 10.0
    lifetime_s: float = 60.0
    sighting_scans: float = 6.0
    sighting_s: float = 10.0
    least_q: float = 0.1

    def __post_init__(self) -> None:
        for name in ("lifetime_s", "sighting_scans", "sighting_s"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise InputError(f"PlotTracker: {name} is {getattr(self, name)}; give a number above 0")
        if not 0.0 <= self.correlation_s < math.inf:
            raise InputError(
                f"PlotTracker: correlation_s is {self.correlation_s}; give seconds, 0 for looks that err anew"
            )
        if not 0.0 < self.least_q < 0.5:
            raise InputError(f"PlotTracker: least_q is {self.least_q}; give a probability between 0 and 0.5")

    def advance(self, now: Instant, before: TrackedPlots | None = None) -> TrackedPlots:
        """The objects at an instant: those of ``before``, found again or not, and new ones.

        now : with velocities among its features, all sources of the scene at every instant.

        Raises
        ------
        InputError : positions only, a source that names its objects, an instant before the last, other sources than
            before.
        """
        _require_plots(now, before)
        known = BernoulliTable.none(len(now.feeds)) if before is None else self._carried(before, now)
        places = np.concatenate([known.state[:, :2], *(_places(source) for source in now.sources)])
        usual = np.column_stack([self._usual_q(feed, known.state[:, :2], now) for feed in now.feeds])
        q = known.expected_q(usual, self.sighting_scans, self.least_q)
        q_of, false = {}, {}
        for feed, source in zip(now.feeds, now.sources, strict=True):
            q_of[feed.description.name] = self._q_of(feed, source, places, now)
            false[feed.description.name] = feed.clutter(records_of(source).d)
        rule = BernoulliObjects(now.density, tuple(q_of), q_of, false, known.existence, q)
        return TrackedPlots.of(now, before, known, rule, usual)

    def _carried(self, before: TrackedPlots, now: Instant) -> BernoulliTable:
        """What is remembered when the looks of ``now`` stand."""
        dt = now.instant_s - before.now.instant_s
        sets = before.retiring(now)
        seen, (born, born_q) = before.seen(sets), before.born(sets)
        known = before.fused(sets, self.correlation_s).after(Sighting(seen, before.passed(now), before.rule.known_q))
        split = np.array([d.resolution.split or SPLIT for d in now.descriptions])
        known = known.with_(born).told_apart(np.vstack([seen, born.hits]), np.vstack([before.usual_q, born_q]), split)
        density = objects_per_m2(now)
        known = known.merged(density)
        known = known.take((known.existence > FORGOTTEN) & ~aged(known.covariance, density))
        walk = max(walk_of(description) for description in now.descriptions)
        return known.predicted(dt, walk).aged(dt, self.lifetime_s, self.sighting_s)

    def _usual_q(self, feed: Feed, places: FloatArray, now: Instant) -> FloatArray:
        """(n,) how probably any object at these places is missed."""
        return np.clip(feed.q_at(places, now.instant_s), self.least_q, 1.0 - self.least_q)

    def _q_of(self, feed: Feed, source: Source, places: FloatArray, now: Instant) -> FloatArray:
        """(rows, S) for every record of a source, how probably each source misses an object where it is.

        A direction is where others show something in it; where they do not, it is anywhere.
        """
        records = records_of(source)
        if not isinstance(feed.reports, Directions):
            return np.column_stack([self._usual_q(other, records.features[:, :2], now) for other in now.feeds])
        sensor = feed.sensor_at(now.instant_s)
        sigma, extent = feed.reports.sigma_deg[records.ids], feed.description.errors.extent_m or 0.0
        weight = pointed_at(records.features[:, 0], sigma, (0.0, 0.0) if sensor is None else sensor, places, extent)
        nowhere = ~weight.any(axis=1)
        columns = []
        for other in now.feeds:
            q = self._usual_q(other, places, now) if len(places) else np.empty(0)
            mean = np.clip(other.mean_q(places, now.instant_s), self.least_q, 1.0 - self.least_q)
            columns.append(np.where(nowhere, mean, weight @ q))
        return np.column_stack(columns)


@dataclass(frozen=True)
class TrackedPlots:
    """The objects at an instant, (n,) each; made by :meth:`PlotTracker.advance`.

    Attributes
    ----------
    now : the instant. number : of every object, its own as long as it lasts.
    members : (n, S) rows of the sources' records at the instant, −1 for none; all −1 where an object is only foretold.
    probability : that exactly these records are that object. existence : that there is such an object.
    known : the objects remembered, at the instant, before the looks that stand. known_of : which of them each object
        is, −1 for new ones. rule, usual_q, found : how they were identified; found is None where no look stands.
    look_s, gap_s : (S,) when each source looked last, and how long after the look before that.
    given : numbers given so far.
    """

    now: Instant
    number: IntArray
    members: IntArray
    probability: FloatArray
    existence: FloatArray
    known: BernoulliTable
    known_of: IntArray
    rule: BernoulliObjects
    usual_q: FloatArray
    identification: Objects | None
    look_s: FloatArray
    gap_s: FloatArray
    given: int

    def __len__(self) -> int:
        return len(self.number)

    @classmethod
    def of(
        cls,
        now: Instant,
        before: TrackedPlots | None,
        known: BernoulliTable,
        rule: BernoulliObjects,
        usual_q: FloatArray,
    ) -> TrackedPlots:
        """The looks that stand identified with the objects remembered."""
        heard = [s for s, source in enumerate(now.sources) if len(records_of(source))]
        look_s, gap_s = _looks(now, before)
        given = 0 if before is None else before.given
        if not heard:
            nothing = np.full((len(known), len(now.sources)), -1)
            return cls(now, known.number, nothing, np.ones(len(known)), known.existence, known, np.arange(len(known)),
                       rule, usual_q, None, look_s, gap_s, given)  # fmt: skip
        found = identify_many([known.records, *(now.sources[s] for s in heard)], rule=rule, region=now.region)
        rows = np.ma.filled(found.members, -1)
        members = np.full((len(rows), len(now.sources)), -1)
        members[:, heard] = rows[:, 1:]
        known_of = rows[:, 0]
        number, given = _numbered(now, before, known, known_of, members, given)
        return cls(now, number, members, found.probability, _existence(found, rule), known, known_of, rule, usual_q,
                   found, look_s, gap_s, given)  # fmt: skip

    @property
    def state(self) -> FloatArray:
        """(n, 4) east, north and their velocities; each record counts as much as it is sure to be the object's."""
        return self._joint[0]

    @property
    def covariance(self) -> FloatArray:
        """(n, 4, 4) of the states."""
        return self._joint[1]

    @cached_property
    def _joint(self) -> tuple[FloatArray, FloatArray]:
        """States and covariances; where known objects are is known without the region."""
        state, covariance = np.empty((len(self), 4)), np.empty((len(self), 4, 4))
        for region, which in ((_wide(self.now.region), self.known_of >= 0), (self.now.region, self.known_of < 0)):
            there = self._pooled(which, self.members[which], np.ones(len(self.look_s)), region)
            state[which], covariance[which] = there.state, there.covariance
        return state, covariance

    def _pooled(self, which: NDArray[Any], sets: IntArray, count: FloatArray, region: Region) -> Joint:
        """States of some of the objects from what was known of them and the records ``sets``.

        count : (S,) how much a record counts that is the object's for sure.
        """
        pairs = zip(self.now.sources, self.sure, count, strict=True)
        sources = [_counting(source, sure * share) for source, sure, share in pairs]
        return joint_density([self.known.records, *sources], np.column_stack([self.known_of[which], sets]), region)

    @cached_property
    def last_number(self) -> Mapping[tuple[int, int], int]:
        """The number of the object of every record that stands, by source and row of its reports."""
        at, s = np.nonzero(self.members >= 0)
        ids = [records_of(source).ids for source in self.now.sources]
        rows = self.members[at, s].tolist()
        return {(k, int(ids[k][row])): n for k, row, n in zip(s.tolist(), rows, self.number[at].tolist(), strict=True)}

    def retiring(self, now: Instant) -> IntArray:
        """(n, S) the members that stand no more at a later instant, −1 for the others."""
        out = self.members.copy()
        for s, (old, new) in enumerate(zip(self.now.sources, now.sources, strict=True)):
            stands = np.append(np.isin(records_of(old).ids, records_of(new).ids), True)
            out[stands[self.members[:, s]], s] = -1
        return out

    def passed(self, now: Instant) -> FloatArray:
        """(S,) how many looks of each source stand no more at a later instant."""
        dt = now.instant_s - self.now.instant_s
        share = [math.inf if feed.rotation is None else dt / feed.rotation.period_s for feed in now.feeds]
        looked = np.isfinite(self.look_s) & (_looks(now, self)[0] > self.look_s)
        return np.asarray(np.where(looked, np.minimum(share, 1.0), 0.0))

    @cached_property
    def p_known(self) -> tuple[FloatArray, ...]:
        """Per source (m, rows): the probability that each known object is each row of its table."""
        out = tuple(np.zeros((len(self.known), records_of(source).n_table)) for source in self.now.sources)
        if self.identification is None or not len(self.known):
            return out
        pooled = self.identification.pooled
        place = {records_of(source).source: u for u, source in enumerate(pooled.sources)}
        k = place[KNOWN]
        known = self.identification.p_together[pooled.start[k] : pooled.start[k + 1]].toarray()
        rows = records_of(pooled.sources[k]).rows
        for s, source in enumerate(self.now.sources):
            u = place.get(records_of(source).source)
            if u is not None:
                columns = known[:, pooled.start[u] : pooled.start[u + 1]]
                out[s][np.ix_(rows, records_of(pooled.sources[u]).rows)] = np.clip(columns, 0.0, 1.0)
        return out

    def seen(self, sets: IntArray) -> FloatArray:
        """(m, S) probability that each known object is one of the records ``sets``, source by source."""
        parts = [p[:, np.unique(rows[rows >= 0])].sum(axis=1) for p, rows in zip(self.p_known, sets.T, strict=True)]
        return np.asarray(np.clip(np.column_stack(parts), 0.0, 1.0))

    @cached_property
    def sure(self) -> tuple[FloatArray, ...]:
        """Per source (rows,) probability that a record is of the known object that it is taken for, 1 for new ones."""
        out = tuple(np.ones(p.shape[1]) for p in self.p_known)
        at, s = np.nonzero((self.members >= 0) & (self.known_of >= 0)[:, None])
        for n, source in zip(at.tolist(), s.tolist(), strict=True):
            row = self.members[n, source]
            out[source][row] = self.p_known[source][self.known_of[n], row]
        return out

    def fused(self, sets: IntArray, correlation_s: float) -> BernoulliTable:
        """The known objects with the records ``sets`` that are theirs.

        A record counts as the share Δt/τ of one, times the probability that it is the object's.
        """
        at = np.flatnonzero((self.known_of >= 0) & (sets >= 0).any(axis=1))
        if not len(at):
            return self.known
        count = np.minimum(self.gap_s / correlation_s, 1.0) if correlation_s > 0.0 else np.ones(len(self.gap_s))
        there = self._pooled(at, sets[at], count, _wide(self.now.region))
        state, covariance = self.known.state.copy(), self.known.covariance.copy()
        state[self.known_of[at]], covariance[self.known_of[at]] = there.state, there.covariance
        return replace(self.known, state=state, covariance=covariance)

    def born(self, sets: IntArray) -> tuple[BernoulliTable, FloatArray]:
        """Objects that nobody knew, from those of the records ``sets`` that say where they are.

        And (b, S) how probably any object there is missed.
        """
        placed = np.array([not isinstance(feed.reports, Directions) for feed in self.now.feeds], dtype=bool)
        at = np.flatnonzero((self.known_of < 0) & ((sets >= 0) & placed).any(axis=1))
        if not len(at):
            return BernoulliTable.none(sets.shape[1]), np.empty((0, sets.shape[1]))
        open_ = _wide(self.now.region).covariance
        open_[2:, 2:] = self.now.region.covariance[2:, 2:]
        there = joint_density(list(self.now.sources), sets[at], Region(self.now.region.centre, open_))
        hits = (sets[at] >= 0).astype(np.float64)
        tables = [self.rule.q[name] for name in self.rule.sources]
        own = [[tables[s][sets[n, s]] for s in np.flatnonzero((sets[n] >= 0) & placed)] for n in at]
        q = np.array([np.mean(each, axis=0) for each in own])
        return BernoulliTable.born(self.number[at], there.state, there.covariance, self.existence[at], hits), q


def _require_plots(now: Instant, before: TrackedPlots | None) -> None:
    if now.features != POSITION_AND_VELOCITY:
        raise InputError(
            "PlotTracker: the instant has positions only; give scene.at(t, features=POSITION_AND_VELOCITY)"
        )
    for feed in now.feeds:
        if feed.reports.track is not None:
            raise InputError(
                f"{feed.description.name} names its objects; PlotTracker follows bare plots: give it to Watch, "
                "or leave its names out"
            )
    if before is None:
        return
    if now.instant_s < before.now.instant_s:
        raise InputError(
            f"PlotTracker: the last instant was {before.now.instant_s:g} s and this is {now.instant_s:g} s; give "
            "instants in the order of time"
        )
    if [d.name for d in now.descriptions] != [d.name for d in before.now.descriptions]:
        raise InputError(
            "PlotTracker: the sources are not those of the instant before; give all of them at every instant"
        )


def _looks(now: Instant, before: TrackedPlots | None) -> tuple[FloatArray, FloatArray]:
    """(S,) when each source looked last, −inf for never, and (S,) how long after the look that stood before."""
    look = np.array(
        [feed.scan_times_s[feed.scan_times_s <= now.instant_s].max(initial=-math.inf) for feed in now.feeds]
    )
    if before is None:
        return look, np.full(len(look), math.inf)
    first = ~np.isfinite(before.look_s)
    gap = np.where(first, math.inf, look - np.where(first, 0.0, before.look_s))
    return look, np.where(look > before.look_s, gap, before.gap_s)


def _places(source: Source) -> FloatArray:
    records = records_of(source)
    return records.features[:, :2] if records.d > 1 else np.empty((0, 2))


def _wide(region: Region) -> Region:
    return Region(region.centre, WIDE * region.covariance)


def _counting(source: Source, share: FloatArray) -> Source:
    """A source whose records count as shares (rows,) of one."""
    records = records_of(source)
    less = replace(records, covariance=records.covariance / np.maximum(share[records.rows], LEAST)[:, None])
    return replace(source, records=less) if isinstance(source, Observations) else less


def _existence(found: Objects, rule: BernoulliObjects) -> FloatArray:
    """(n,) probability that there is an object: less sure where a record stands alone, and where a known one does."""
    pooled, exists = found.pooled, rule.exists(found.pooled)
    members = found.sets.members[found.set_of_object]
    out = np.where(found.n_members > 1, found.probability, exists[members.max(axis=1)])
    own = members[:, pooled.given.index(0)]
    known = own >= 0
    row = records_of(pooled.sources[pooled.given.index(0)]).rows[own[known] - pooled.start[pooled.given.index(0)]]
    alone = np.ma.filled(found.of(KNOWN).p_alone, 1.0)[row]
    out[known] = 1.0 - alone * (1.0 - exists[own[known]])
    return np.asarray(out)


def _numbered(
    now: Instant, before: TrackedPlots | None, known: BernoulliTable, known_of: IntArray, members: IntArray, given: int
) -> tuple[IntArray, int]:
    """(n,) numbers: of the known; of the records where they stood before; else new ones."""
    ids = [records_of(source).ids for source in now.sources]
    stood = {} if before is None else before.last_number
    taken = set(known.number.tolist())
    number = np.empty(len(members), np.int64)
    for n, (i, row) in enumerate(zip(known_of.tolist(), members.tolist(), strict=True)):
        old = [stood.get((s, int(ids[s][k]))) for s, k in enumerate(row) if k >= 0]
        free = [value for value in old if value is not None and value not in taken]
        if i >= 0:
            number[n] = known.number[i]
        elif free:
            number[n] = free[0]
        else:
            given += 1
            number[n] = given
        taken.add(int(number[n]))
    return number, given

"""Plot tracker: objects tracked from scan to scan, for sources of plots and directions without ids.

    tracker, tracks = PlotTracker(), None
    for t in instants:
        tracks = tracker.advance(scene.at(t, features=POSITION_AND_VELOCITY), tracks)

The current scan of a source is its last one. At each instant all current scans are identified jointly, together with
the prior objects of previous scans (:mod:`sameas.picture.bernoulli`). A scan updates the prior once, when the next scan
of its source replaces it, with its latest assignment, which may change until then. So fused states are never evidence
for themselves.

The errors of successive scans are correlated: the same side of a hull, the same compass error. For the states, a scan
counts as the share Δt/τ of an independent one. Sources miss the same objects repeatedly, so each object has its own
miss probabilities.

Use it where no source has ids; use :class:`sameas.picture.Watch` for tracks with ids, and
:class:`sameas.picture.PlotPicture` for a whole picture of plots without ids. Source: METHOD 7; Bernoulli objects with a
Poisson field of unknown ones as in Williams 2015, keeping the most probable hypothesis only.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import ABSENT, BoolArray, FloatArray, IntArray
from sameas.errors import InputError
from sameas.evidence.identity import FREQUENCY, Identity
from sameas.many.identify import identify_many
from sameas.many.objects import Objects
from sameas.many.observations import Joint, Observations, Region, Source, joint_density, records_of
from sameas.picture.bernoulli import KNOWN, MIN_PROBABILITY, BernoulliObjects, BernoulliTable, Sighting
from sameas.picture.crossings import Crossings
from sameas.picture.tables import objects_per_m2
from sameas.picture.tuning import DEFAULT_TUNING, Tuning
from sameas.tracks.alignment import aged
from sameas.tracks.feed import Feed, mean_walk_of
from sameas.tracks.placement import Directions
from sameas.tracks.scene import POSITION_AND_VELOCITY, Instant, record_positions
from sameas.tracks.snapshot import pointed_at

CURRENT_WEIGHT = 0.01  # of directions that will be used again, in the position at which an object begins
SPLIT = 0.02  # probability that a scan shows one object as two, if neither the description nor the kind has it
#: Objects of plots without ids are dropped below the first probability and below this share of that with their first
#: scan: among much clutter the first plot of a real object is below the first.
MIN_EXISTENCE, MIN_SHARE_OF_INITIAL = 0.01, 0.1
#: A record updates the state of an object that may not exist if, in case it does, the record is its with this
#: probability.
LIKELY_MEMBER = 0.9
REGION_FACTOR = 1e4  # factor on the region's covariance for the states of objects that are already tracked


@dataclass(frozen=True)
class PlotTracker:
    """The parameters of the tracker.

    correlation_s : τ, correlation time of the errors of scans; 10 s (chosen).
    lifetime_s : mean time that undetected objects exist. sighting_scans : weight, in scans, of the described miss
        probability relative to the object's own hits and misses. sighting_s : time constant of the latter.
    min_q : miss probabilities are clipped to min_q … 1 − min_q, since misses of one object are correlated.
    tuning : other chosen numbers.
    """

    correlation_s: float = 10.0
    lifetime_s: float = 60.0
    sighting_scans: float = 6.0
    sighting_s: float = 10.0
    min_q: float = 0.1
    tuning: Tuning = DEFAULT_TUNING

    def __post_init__(self) -> None:
        for name in ("lifetime_s", "sighting_scans", "sighting_s"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise InputError(f"PlotTracker: {name} is {getattr(self, name)}; give a number above 0")
        if not 0.0 <= self.correlation_s < math.inf:
            raise InputError(
                f"PlotTracker: correlation_s is {self.correlation_s}; give seconds, 0 if scans err independently"
            )
        if not 0.0 < self.min_q < 0.5:
            raise InputError(f"PlotTracker: min_q is {self.min_q}; give a probability between 0 and 0.5")

    def advance(self, now: Instant, before: TrackedPlots | None = None) -> TrackedPlots:
        """The objects at an instant: those of ``before``, detected again or not, and new ones.

        now : with velocities among its features, and with the same sources at each instant.

        Raises InputError: positions only; a source with ids; an instant before the previous one; other sources than
        before.
        """
        _require_plots(now, before)
        prior_objects = BernoulliTable.none(len(now.feeds)) if before is None else self._carried(before, now)
        places = np.concatenate([prior_objects.state[:, :2], *(record_positions(source) for source in now.sources)])
        usual_q = np.column_stack([self._usual_q(feed, prior_objects.state[:, :2], now) for feed in now.feeds])
        # Of objects that the source does not resolve one has the record.
        n_shared = [_sharing(feed, prior_objects, now.instant_s) for feed in now.feeds]
        q = 1.0 - (1.0 - prior_objects.expected_q(usual_q, self.sighting_scans, self.min_q)) / np.column_stack(n_shared)
        q_of, false = {}, {}
        for feed, source in zip(now.feeds, now.sources, strict=True):
            q_of[feed.description.name] = self._q_of(feed, source, places, now)
            false[feed.description.name] = feed.clutter(records_of(source).d)
        rule = BernoulliObjects(now.density, tuple(q_of), q_of, false, prior_objects.existence, q)
        return TrackedPlots.of(now, before, prior_objects, rule, usual_q)

    def _carried(self, before: TrackedPlots, now: Instant) -> BernoulliTable:
        """The prior objects for the scans of ``now``: those of ``before`` updated by its scans that are not current any
        more, and predicted."""
        dt = now.instant_s - before.now.instant_s
        retired = before.retired(before.members, now)
        p_detected, (new, new_q) = before.p_detected(retired), before.new_objects(retired)
        objects = before.fused(before.retired(before.likely_members, now), self.correlation_s).after(
            Sighting(p_detected, before.scans_over(now), before.rule.known_q), MIN_PROBABILITY
        )
        split = np.array([d.resolution.split or SPLIT for d in now.descriptions])
        objects = objects.with_(new)
        pairs = objects.pairs_near()
        unresolved = [_p_unresolved(feed, objects, pairs, before.now.instant_s) for feed in before.now.feeds]
        objects = objects.with_separate_odds(
            pairs, np.vstack([p_detected, new.hits]), np.vstack([before.usual_q, new_q]), split, np.array(unresolved),
            self.tuning,
        )  # fmt: skip
        density = objects_per_m2(now)
        objects = objects.merged(density)
        least = np.minimum(MIN_EXISTENCE, MIN_SHARE_OF_INITIAL * objects.initial)
        objects = objects.take((objects.existence > least) & ~aged(objects.covariance, density))
        walk = max(mean_walk_of(description) for description in now.descriptions)
        return objects.predicted(dt, walk).aged(dt, self.lifetime_s, self.sighting_s)

    def _usual_q(self, feed: Feed, places: FloatArray, now: Instant) -> FloatArray:
        """(n,) the described miss probability at these places."""
        return np.clip(feed.q_at(places, now.instant_s), self.min_q, 1.0 - self.min_q)

    def _q_of(self, feed: Feed, source: Source, places: FloatArray, now: Instant) -> FloatArray:
        """(rows, S) the probability that each source misses an object at the place of each record of a source.

        A direction has the places of other records along it; without any, the mean over all places is used.
        """
        records = records_of(source)
        if not isinstance(feed.reports, Directions):
            return np.column_stack([self._usual_q(other, records.features[:, :2], now) for other in now.feeds])
        sensor = feed.sensor_at(now.instant_s)
        sigma, extent = feed.reports.sigma_deg[records.ids], feed.description.errors.extent_m or 0.0
        sensor = np.zeros(2) if sensor is None else sensor
        weight = pointed_at(records.features[:, 0], sigma, sensor, places, extent)
        points_nowhere = ~weight.any(axis=1)
        columns = []
        for other in now.feeds:
            q = self._usual_q(other, places, now) if len(places) else np.empty(0)
            mean = np.clip(other.mean_q(places, now.instant_s), self.min_q, 1.0 - self.min_q)
            columns.append(np.where(points_nowhere, mean, weight @ q))
        return np.column_stack(columns)


@dataclass(frozen=True)
class TrackedPlots:
    """The objects at an instant, (n,) each; made by :meth:`PlotTracker.advance`.

    now : the instant. number : of each object, constant while it exists.
    members : (n, S) rows of the sources' records at the instant, ABSENT for none, and if the object is only predicted.
    probability : that exactly these records are the object. existence : probability that the object exists.
    prior_objects : the objects predicted to the instant, without the current scans. prior_of : row of each object
        among them, ABSENT for new ones.
    rule, usual_q, identification : of the records; identification is None if no scan is current.
    scan_s, gap_s : (S,) the time of each source's last scan, and the time between its last two scans.
    n_numbers : the highest number in use.
    """

    now: Instant
    number: IntArray
    members: IntArray
    probability: FloatArray
    existence: FloatArray
    prior_objects: BernoulliTable
    prior_of: IntArray
    rule: BernoulliObjects
    usual_q: FloatArray
    identification: Objects | None
    scan_s: FloatArray
    gap_s: FloatArray
    n_numbers: int

    def __len__(self) -> int:
        return len(self.number)

    @classmethod
    def of(
        cls,
        now: Instant,
        before: TrackedPlots | None,
        prior_objects: BernoulliTable,
        rule: BernoulliObjects,
        usual_q: FloatArray,
    ) -> TrackedPlots:
        """The objects from the joint identification of the current scans and the prior objects."""
        with_records = [s for s, source in enumerate(now.sources) if len(records_of(source))]
        scan_s, gap_s = _scan_times(now, before)
        n_numbers = 0 if before is None else before.n_numbers
        if not with_records:
            no_members = np.full((len(prior_objects), len(now.sources)), ABSENT)
            one, each = np.ones(len(prior_objects)), np.arange(len(prior_objects))
            return cls(now, prior_objects.number, no_members, one, prior_objects.existence, prior_objects, each, rule,
                       usual_q, None, scan_s, gap_s, n_numbers)  # fmt: skip
        identification = identify_many(
            [prior_objects.records, *(now.sources[s] for s in with_records)],
            rule=rule + _frequencies(prior_objects, now),
            region=now.region,
        )
        rows = np.ma.filled(identification.members, ABSENT)
        members = np.full((len(rows), len(now.sources)), ABSENT)
        members[:, with_records] = rows[:, 1:]
        prior_of = rows[:, 0]
        number, n_numbers = _numbered(now, before, prior_objects, prior_of, members, n_numbers)
        existence = _existence(identification, rule)
        return cls(now, number, members, identification.probability, existence, prior_objects, prior_of, rule, usual_q,
                   identification, scan_s, gap_s, n_numbers)  # fmt: skip

    @property
    def state(self) -> FloatArray:
        """(n, 4) east, north and their velocities; records are weighted by their probability to be of the object."""
        return self._joint[0]

    @property
    def covariance(self) -> FloatArray:
        """(n, 4, 4) of the states, including the common error of all sources."""
        return self._joint[1]

    @cached_property
    def _joint(self) -> tuple[FloatArray, FloatArray]:
        """States and covariances; those of prior objects are not constrained by the region."""
        state, covariance = np.empty((len(self), 4)), np.empty((len(self), 4, 4))
        for region, which in ((self._wide_region, self.prior_of >= 0), (self.now.region, self.prior_of < 0)):
            joint = self._pooled(which, self.likely_members[which], np.ones(len(self.scan_s)), region)
            state[which], covariance[which] = joint.state, joint.covariance
        covariance[:, :2, :2] += self.now.shared_error_m**2 * np.eye(2) + self._by_offsets(state[:, :2])
        return state, covariance

    def _by_offsets(self, places: FloatArray) -> FloatArray:
        """(n, 2, 2) covariance of crossings at ``places`` (n, 2) by the offsets of the directions, which no number of
        scans reduces; 0 beside a source of positions."""
        information, spread = np.zeros((2, len(places), 2, 2))
        for feed in self.now.feeds:
            sensor = feed.sensor_at(self.now.instant_s)
            if not isinstance(feed.reports, Directions):
                return np.zeros((len(places), 2, 2))
            # The rows of a live feed that hold no report have no error.
            usable = feed.reports.usable
            if sensor is None or not usable.any():
                continue
            arm = places - sensor
            distance = np.maximum(np.hypot(*arm.T), 1.0)
            across = np.column_stack([arm[:, 1], -arm[:, 0]]) / distance[:, None] ** 2
            variance = float(np.median(feed.reports.sigma_deg[usable])) ** 2
            lasting = float(np.median(np.broadcast_to(feed.reports.lasting_deg, len(usable))[usable])) ** 2
            outer = across[:, :, None] * across[:, None, :]
            information += outer / variance
            spread += outer * (lasting / variance**2)
        if not spread.any():
            return spread
        inverse = np.linalg.pinv(information)
        return np.asarray(np.radians(1.0) ** 2 * (inverse @ spread @ inverse), np.float64)

    @property
    def _wide_region(self) -> Region:
        """The region with its covariance times ``REGION_FACTOR``: it does not constrain prior objects."""
        region = self.now.region
        return Region(region.centre, REGION_FACTOR * region.covariance)

    def _pooled(self, which: NDArray[Any], sets: IntArray, count: FloatArray, region: Region) -> Joint:
        """The states of the objects ``which`` from their priors and their records ``sets``.

        count : (S,) the weight of a record that is certainly of its object, per source.
        """
        sources: list[Source] = [self.prior_objects.records]
        columns, objects = [self.prior_of[which]], np.flatnonzero(which)
        for s, source in enumerate(self.now.sources):
            at = np.flatnonzero(sets[:, s] >= 0)
            weight = self._p_of_existing(s, objects[at], sets[at, s]) * count[s]
            sources.append(_weighted(source, sets[at, s], np.maximum(weight, MIN_PROBABILITY)))
            columns.append(np.full(len(sets), ABSENT))
            columns[-1][at] = np.arange(len(at))
        return joint_density(sources, np.column_stack(columns), region)

    def _p_of_existing(self, s: int, objects: IntArray, rows: IntArray) -> FloatArray:
        """(k,) probability, if an object exists, that a record of a source is of it; 1 for new objects."""
        prior, out = self.prior_of[objects], np.ones(len(objects))
        has = prior >= 0
        out[has] = self.p_association[s][prior[has], rows[has]] / self.existence[objects[has]]
        return np.minimum(out, 1.0)

    @cached_property
    def likely_members(self) -> IntArray:
        """(n, S) the members, and where a prior object has none of a source, the record that is its member with a
        probability of ``LIKELY_MEMBER`` if it exists. An object that hardly exists yet has no members in the most
        probable hypothesis, but its state is that of one that exists."""
        out, prior = self.members.copy(), np.flatnonzero(self.prior_of >= 0)
        for s, p in enumerate(self.p_association):
            if p.shape[1]:
                best = p[self.prior_of[prior]].argmax(axis=1)
                likely = (self.members[prior, s] < 0) & (self._p_of_existing(s, prior, best) > LIKELY_MEMBER)
                out[prior[likely], s] = best[likely]
        return out

    @cached_property
    def last_number(self) -> Mapping[tuple[int, int], int]:
        """By source and row of its reports, the object number of each current record."""
        at, s = np.nonzero(self.members >= 0)
        ids = [records_of(source).ids for source in self.now.sources]
        rows = self.members[at, s].tolist()
        return {(k, int(ids[k][row])): n for k, row, n in zip(s.tolist(), rows, self.number[at].tolist(), strict=True)}

    def retired(self, members: IntArray, now: Instant) -> IntArray:
        """(n, S) those of the members whose scans are not current at a later instant, ABSENT for the others."""
        out = members.copy()
        for s, (before, after) in enumerate(zip(self.now.sources, now.sources, strict=True)):
            is_current = np.append(np.isin(records_of(before).ids, records_of(after).ids), True)
            out[is_current[members[:, s]], s] = ABSENT
        return out

    def scans_over(self, now: Instant) -> FloatArray:
        """(S,) the number of scans of each source completed since: 1 or 0, or a part of a rotation."""
        dt = now.instant_s - self.now.instant_s
        share = [math.inf if feed.rotation is None else dt / feed.rotation.period_s for feed in now.feeds]
        scanned = np.isfinite(self.scan_s) & (_scan_times(now, self)[0] > self.scan_s)
        return np.asarray(np.where(scanned, np.minimum(share, 1.0), 0.0))

    @cached_property
    def p_association(self) -> tuple[FloatArray, ...]:
        """Per source (m, rows): the probability that each prior object and each record are one object."""
        out = tuple(np.zeros((len(self.prior_objects), records_of(source).n_table)) for source in self.now.sources)
        if self.identification is None or not len(self.prior_objects):
            return out
        pooled = self.identification.pooled
        index_of = {records_of(source).source: u for u, source in enumerate(pooled.sources)}
        k = index_of[KNOWN]
        prior_objects = self.identification.p_together[pooled.start[k] : pooled.start[k + 1]].toarray()
        rows = records_of(pooled.sources[k]).rows
        for s, source in enumerate(self.now.sources):
            u = index_of.get(records_of(source).source)
            if u is not None:
                columns = prior_objects[:, pooled.start[u] : pooled.start[u + 1]]
                out[s][np.ix_(rows, records_of(pooled.sources[u]).rows)] = np.clip(columns, 0.0, 1.0)
        return out

    def p_detected(self, sets: IntArray) -> FloatArray:
        """(m, S) probability that each prior object has one of the records ``sets`` of each source."""
        parts = [
            p[:, np.unique(rows[rows >= 0])].sum(axis=1) for p, rows in zip(self.p_association, sets.T, strict=True)
        ]
        return np.asarray(np.clip(np.column_stack(parts), 0.0, 1.0))

    def fused(self, sets: IntArray, correlation_s: float) -> BernoulliTable:
        """The prior objects updated by their records ``sets``, weighted by Δt/τ (at most 1) times the probability that
        the record is of the object if that exists."""
        which = (self.prior_of >= 0) & (sets >= 0).any(axis=1)
        if not which.any():
            return self.prior_objects
        count = np.minimum(self.gap_s / correlation_s, 1.0) if correlation_s > 0.0 else np.ones(len(self.gap_s))
        joint = self._pooled(which, sets[which], count, self._wide_region)
        state, covariance = self.prior_objects.state.copy(), self.prior_objects.covariance.copy()
        state[self.prior_of[which]], covariance[self.prior_of[which]] = joint.state, joint.covariance
        frequency_hz, received = self.prior_objects.frequency_hz.copy(), self._frequency_hz(sets[which])
        frequency_hz[self.prior_of[which]] = np.where(
            np.isfinite(received), received, frequency_hz[self.prior_of[which]]
        )
        return replace(self.prior_objects, state=state, covariance=covariance, frequency_hz=frequency_hz)

    def _frequency_hz(self, sets: IntArray) -> FloatArray:
        """(k,) the mean frequency of the records ``sets`` (k, S) that have one; NaN where none has."""
        columns = [
            np.append(_frequency_of(feed, source), np.nan)[rows]
            for feed, source, rows in zip(self.now.feeds, self.now.sources, sets.T, strict=True)
        ]
        given = np.column_stack(columns)
        known = np.isfinite(given)
        count = known.sum(axis=1)
        return np.where(count, np.where(known, given, 0.0).sum(axis=1) / np.maximum(count, 1), np.nan)

    def new_objects(self, sets: IntArray) -> tuple[BernoulliTable, FloatArray]:
        """The new objects among the records ``sets`` with positions, and at clear crossings of directions with one of
        them, and (b, S) the described miss probabilities at their places."""
        has_place = np.array([not isinstance(feed.reports, Directions) for feed in self.now.feeds], dtype=bool)
        at = np.flatnonzero((self.prior_of < 0) & ((sets >= 0) & has_place).any(axis=1))
        born, q = self._born(at, sets[at], np.ones(sets[at].shape), self.existence[at], has_place)
        if self.identification is None or has_place.all():
            return born, q
        is_free = (self.prior_of < 0) & ~((self.members >= 0) & has_place).any(axis=1)
        crossings = Crossings.among(self.now, self.identification, self.members, is_free, self._birth_region).with_any(
            sets
        )
        if not len(crossings.object):
            return born, q
        is_new = (crossings.sets[:, None] == sets).any(axis=1) & (crossings.sets >= 0)
        weight = np.where(is_new, 1.0, CURRENT_WEIGHT)
        more, more_q = self._born(crossings.object, crossings.sets, weight, crossings.p, ~has_place)
        return born.with_(more), np.vstack([q, more_q])

    @property
    def _birth_region(self) -> Region:
        """The region of new objects: it constrains their velocities only."""
        covariance = self._wide_region.covariance
        covariance[2:, 2:] = self.now.region.covariance[2:, 2:]
        return Region(self.now.region.centre, covariance)

    def _born(
        self, objects: IntArray, sets: IntArray, weight: FloatArray, existence: FloatArray, located_by: BoolArray
    ) -> tuple[BernoulliTable, FloatArray]:
        """New objects with the numbers of ``objects`` (b,) from the weighted records ``sets`` (b, S), and (b, S) the
        miss probabilities at the places of those of the sources ``located_by`` (S,)."""
        if not len(objects):
            return BernoulliTable.none(sets.shape[1]), np.empty((0, sets.shape[1]))
        sources, columns = [], np.full(sets.shape, ABSENT)
        for s, source in enumerate(self.now.sources):
            at = np.flatnonzero(sets[:, s] >= 0)
            sources.append(_weighted(source, sets[at, s], weight[at, s]))
            columns[at, s] = np.arange(len(at))
        joint = joint_density(sources, columns, self._birth_region)
        hits = (sets >= 0).astype(np.float64)
        tables = [self.rule.q[name] for name in self.rule.sources]
        own_q = [[tables[s][row[s]] for s in np.flatnonzero((row >= 0) & located_by)] for row in sets]
        q = np.array([np.mean(each, axis=0) for each in own_q])
        least, frequency_hz = MIN_PROBABILITY, self._frequency_hz(sets)
        number, state, covariance = self.number[objects], joint.state, joint.covariance
        return BernoulliTable.born(number, state, covariance, existence, hits, frequency_hz, least), q


def _frequency_of(feed: Feed, source: Source) -> FloatArray:
    """(n,) the frequencies of a source's records; NaN where they have none."""
    column, rows = feed.attributes.get(FREQUENCY), records_of(source).ids
    return np.full(len(rows), np.nan) if column is None else np.asarray(column[rows], np.float64)


def _frequencies(objects: BernoulliTable, now: Instant) -> Identity:
    """The rule of the frequencies of known objects and of the records."""
    columns = {KNOWN: {FREQUENCY: objects.frequency_hz}}
    for feed, source in zip(now.feeds, now.sources, strict=True):
        if FREQUENCY in feed.attributes:
            columns[feed.description.name] = {FREQUENCY: _frequency_of(feed, source)}
    return Identity(columns)


def _p_unresolved(
    feed: Feed, objects: BernoulliTable, pairs: tuple[IntArray, IntArray], instant_s: float
) -> FloatArray:
    """(p,) probability that a source shows two of the objects as one record."""
    one, other = ((objects.state[k, :2], objects.covariance[k, :2, :2]) for k in pairs)
    return feed.p_unresolved(instant_s, one, other)


def _sharing(feed: Feed, objects: BernoulliTable, instant_s: float) -> FloatArray:
    """(m,) the expected number of objects, itself one of them, that a source shows as one record with each object."""
    from scipy.spatial import cKDTree

    out, places = np.ones(len(objects)), objects.state[:, :2]
    reach_m = feed.resolution_reach_m(instant_s, (places, objects.covariance[:, :2, :2]))
    if not reach_m.any():
        return out
    i, j = cKDTree(places).query_pairs(2.0 * float(reach_m.max()), output_type="ndarray").T
    near = np.hypot(*(places[i] - places[j]).T) <= reach_m[i] + reach_m[j]
    i, j = i[near], j[near]
    p = _p_unresolved(feed, objects, (i, j), instant_s)
    for one, other in ((i, j), (j, i)):
        out += np.bincount(one, p * objects.existence[other], len(out))
    return out


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


def _scan_times(now: Instant, before: TrackedPlots | None) -> tuple[FloatArray, FloatArray]:
    """(S,) the time of each source's last scan, −inf for none, and (S,) the time between its last two scans."""
    scan_s = np.array(
        [feed.scan_times_s[feed.scan_times_s <= now.instant_s].max(initial=-math.inf) for feed in now.feeds]
    )
    if before is None:
        return scan_s, np.full(len(scan_s), math.inf)
    is_first = ~np.isfinite(before.scan_s)
    gap = np.where(is_first, math.inf, scan_s - np.where(is_first, 0.0, before.scan_s))
    return scan_s, np.where(scan_s > before.scan_s, gap, before.gap_s)


def _weighted(source: Source, rows: IntArray, weight: FloatArray) -> Source:
    """The records ``rows`` of a source, with their covariances divided by weights (k,)."""
    records = records_of(source).part(rows)
    weighted = replace(records, covariance=records.covariance / weight[:, None])
    return replace(source, records=weighted) if isinstance(source, Observations) else weighted


def _existence(identification: Objects, rule: BernoulliObjects) -> FloatArray:
    """(n,) probability of existence: below 1 for single records and for prior objects without a record."""
    pooled, exists = identification.pooled, rule.exists(identification.pooled)
    members = identification.sets.members[identification.set_of_object]
    out = np.where(identification.n_members > 1, identification.probability, exists[members.max(axis=1)])
    prior_record = members[:, pooled.given.index(0)]
    has_prior = prior_record >= 0
    row = records_of(pooled.sources[pooled.given.index(0)]).rows[
        prior_record[has_prior] - pooled.start[pooled.given.index(0)]
    ]
    p_alone = np.ma.filled(identification.of(KNOWN).p_alone, 1.0)[row]
    out[has_prior] = 1.0 - p_alone * (1.0 - exists[prior_record[has_prior]])
    return np.asarray(out)


def _numbered(
    now: Instant,
    before: TrackedPlots | None,
    prior_objects: BernoulliTable,
    prior_of: IntArray,
    members: IntArray,
    n_numbers: int,
) -> tuple[IntArray, int]:
    """(n,) numbers, and the highest in use: that of the prior, else the previous one of a record, else a new one."""
    ids = [records_of(source).ids for source in now.sources]
    earlier = {} if before is None else before.last_number
    taken = set(prior_objects.number.tolist())
    number = np.empty(len(members), np.int64)
    for n, (i, row) in enumerate(zip(prior_of.tolist(), members.tolist(), strict=True)):
        candidates = [earlier.get((s, int(ids[s][k]))) for s, k in enumerate(row) if k >= 0]
        available = [value for value in candidates if value is not None and value not in taken]
        if i >= 0:
            number[n] = prior_objects.number[i]
        elif available:
            number[n] = available[0]
        else:
            n_numbers += 1
            number[n] = n_numbers
        taken.add(int(number[n]))
    return number, n_numbers

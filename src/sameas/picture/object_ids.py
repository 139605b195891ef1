"""Object ids: each object of the picture keeps its number from instant to instant.

The objects of an instant are identified with those of the picture as by :func:`sameas.identify`, one to one and
jointly, by the evidence of :mod:`sameas.picture.continuity`. So a number never goes to another object while its own is
present, and if two objects exchange a record, each keeps the most probable number.

An object is *tentative* when it appears, *confirmed* when it is certain (:class:`Stages`), *coasting* while no source
detects it and its position is predicted, and *ended* when more than one other object is expected within its own 1σ
ellipse, an aircraft when that is larger than 1 NM, or when all its tracks are of another object. An object that returns
with a unique id gets its number again.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.special import expit, logit

from sameas.arrays import ABSENT, BoolArray, FloatArray, IntArray, entries, over_columns, taken
from sameas.assignment import assign, refuse_crowds
from sameas.errors import InputError
from sameas.gaussian import Gaussian, symmetric
from sameas.groups import groups
from sameas.kernels.tracks import places_of
from sameas.picture.continuity import CommonTracks, Continuity, Motions, NearOrSameId, PlotContinuity, manoeuvre_m2
from sameas.picture.fixes import Fixes
from sameas.picture.hull_echoes import Hulls, owners_among
from sameas.picture.plot_existence import Looks, NewPlots, PlotOdds
from sameas.picture.tables import COASTING, CONFIRMED, ENDED, TENTATIVE, ObjectStates, PictureObjects
from sameas.picture.track_existence import ExistenceOdds
from sameas.picture.track_history import TrackHistory
from sameas.picture.tuning import Tuning
from sameas.prior import EVIDENCE_ALONE
from sameas.records import Records
from sameas.tracks.alignment import aged
from sameas.tracks.coordinates import MILE_M

#: Least distance from 0 and 1 of the probability that a look shows an object. LEAST_WEIGHT : a plot goes to an object
#: that is hardly real, if it exists, but rather to one that is certain: the most by which it counts less.
MIN_SHOWN, LEAST_WEIGHT = 1e-6, 0.2

#: An undetected aircraft is lost when its 1σ ellipse is larger than a circle of this radius in metres, 1 NM: the least
#: separation by radar is 3 NM (ICAO Doc 4444, 8.7.3). Aircraft are objects with at least this motion noise.
LOST_M, AIRCRAFT_WALK_M2_PER_S3 = MILE_M, 1.0

#: An object that split off another is confirmed once its tracks were its own for this share of the time.
OWN_SHARE = 0.8


@dataclass(frozen=True)
class Stages:
    """When an object is confirmed: as soon as it is certain.

    An object is certain if it has records of two or more sources with at least the probability ``sure``, or a record of
    a source without false records, or if it is real with the probability ``real``: by the duration of a named track
    (:mod:`sameas.picture.track_existence`), or by plots without names, at least ``scans`` of them
    (:mod:`sameas.picture.plot_existence`). At most 1 − real of these are false. An object without a position, as of one
    camera, is confirmed with ``scans`` directions. An object of plots ends when it is improbable by them; a tentative
    one with a named track once it is missing at more than of − scans instants.
    """

    scans: int = 3
    of: int = 5
    sure: float = 0.95
    real: float = 0.99

    def __post_init__(self) -> None:
        if not (1 <= self.scans <= self.of and 0.0 < self.sure <= 1.0 and 0.0 < self.real < 1.0):
            raise InputError("Stages: give 1 ≤ scans ≤ of, and sure and real as probabilities")


@dataclass(frozen=True)
class UnnumberedObjects:
    """The objects of an instant, (n,) each, before they have numbers.

    states : of the objects. tracks : (n, S) numbers of their named tracks, ABSENT for none. unique : (n, S) whether the
    track's id is unique. new_report : whether the object has a new report. new_plot : whether it has one of a source
    without track ids. plots : its new plot. fixes : all its plots, where it has no velocity. hulls : whose echoes are
    beside it. looks : of the sources of plots. is_certain : whether it certainly exists. is_believed : whether a source
    shows it whose reports are read rightly. existence : of its most probable track.
    walk_m2_per_s3, speed_m_per_s : motion noise, and 1σ per axis of velocities.
    lasting_share : of the variance of a position, that is the same at the next instants: of directions that cross, by
        their offsets; 0 of others.
    forgotten : (f,) numbers of tracks whose ids have timed out.
    """

    states: ObjectStates
    tracks: IntArray
    unique: BoolArray
    new_report: BoolArray
    new_plot: BoolArray
    plots: NewPlots
    fixes: Fixes
    hulls: Hulls
    looks: Looks
    is_certain: BoolArray
    is_believed: BoolArray
    existence: ExistenceOdds
    walk_m2_per_s3: FloatArray
    speed_m_per_s: FloatArray
    lasting_share: FloatArray
    forgotten: IntArray = field(default_factory=lambda: np.empty(0, np.int64))

    def __len__(self) -> int:
        return len(self.new_report)


@dataclass(frozen=True)
class NamedObjects(PictureObjects):
    """The objects of a picture whose sources have track ids, (k,) each.

    instant_s : the instant. n_numbers : the highest number in use.
    n_updates, n_plots : number of instants with a new report, and with one of a source without track ids.
    main_track, main_log_odds, earlier_log_odds : the track with the highest odds of existence, the gain of log-odds by
        its duration, and that by the tracks that it replaced.
    plot_log_odds, plot_log_initial, plot_looked, plot_missed : the fields of :class:`PlotOdds`.
    n_missing : number of instants without a record while tentative, and the last ones without a position.
    split_off : whether the object split off one that continues and has not had its own tracks for most of the time.
    walk_m2_per_s3, speed_m_per_s : motion noise, and 1σ per axis of velocities.
    history : the objects that each track was assigned to.
    unseen_share : of the objects, that no source of plots has shown yet.
    """

    WHOLE = frozenset({"instant_s", "n_numbers", "history", "unseen_share"})
    instant_s: float = -np.inf
    n_numbers: int = 0
    unseen_share: float = 1.0
    n_updates: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    n_plots: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    main_track: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    main_log_odds: FloatArray = field(default_factory=lambda: np.empty(0))
    earlier_log_odds: FloatArray = field(default_factory=lambda: np.empty(0))
    plot_log_odds: FloatArray = field(default_factory=lambda: np.empty(0))
    plot_log_initial: FloatArray = field(default_factory=lambda: np.empty(0))
    plot_looked: FloatArray = field(default_factory=lambda: np.empty(0))
    plot_missed: FloatArray = field(default_factory=lambda: np.empty(0))
    n_missing: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    split_off: BoolArray = field(default_factory=lambda: np.empty(0, bool))
    walk_m2_per_s3: FloatArray = field(default_factory=lambda: np.empty(0))
    speed_m_per_s: FloatArray = field(default_factory=lambda: np.empty(0))
    history: TrackHistory = field(default_factory=TrackHistory)

    @property
    def plot_odds(self) -> PlotOdds:
        """(k,) what plots without names say of the objects."""
        return PlotOdds(self.plot_log_odds, self.plot_log_initial, self.plot_looked, self.plot_missed)

    @property
    def by_plots(self) -> BoolArray:
        """(k,) whether only plots without names have shown the object."""
        return np.asarray((self.main_track < 0) & self.plot_odds.known)

    @property
    def p_real(self) -> FloatArray:
        """(k,) probability that each object is real, by its plots if nothing else shows it."""
        return np.where(self.by_plots, expit(self.plot_log_odds), 1.0)

    def of_plots_at(self, instant_s: float) -> NamedObjects:
        """The objects that only plots without names show, predicted to an instant."""
        return self._at(instant_s, self.by_plots & (self.stage != ENDED))

    def owners_at(self, instant_s: float) -> NamedObjects:
        """The owners of hulls (:mod:`sameas.picture.hull_echoes`), predicted to an instant."""
        confirmed = np.flatnonzero(self.placed & np.isin(self.stage, (CONFIRMED, COASTING)))
        named = ~self.by_plots[confirmed] & (self.main_track[confirmed] >= 0)
        chosen = np.zeros(len(self), bool)
        chosen[confirmed] = owners_among(self.state[confirmed, :2], named)
        return self._at(instant_s, chosen)

    def _at(self, instant_s: float, chosen: BoolArray) -> NamedObjects:
        which = np.flatnonzero(chosen)
        if not len(which):
            return self.take(which)
        return self.take(which).predicted(instant_s - self.instant_s, self.walk_m2_per_s3[which])

    def not_in(self, after: NamedObjects) -> NamedObjects:
        """The objects, apart from tentative ones of plots, that have ended before a later instant with other ones."""
        shown = (self.stage != ENDED) & ~(self.by_plots & (self.stage == TENTATIVE))
        return self.take(np.flatnonzero(shown & ~np.isin(self.number, after.number)))

    @property
    def in_picture(self) -> NamedObjects:
        """The objects without tentative ones of plots that no source detects now."""
        hidden = self.by_plots & (self.stage == TENTATIVE) & ~self.detected
        return self.take(~hidden)

    def advance(self, instant_s: float, detections: UnnumberedObjects, stages: Stages, tuning: Tuning) -> NamedObjects:
        """The objects at a later instant."""
        alive = self.take(self.stage != ENDED)
        elapsed_s = instant_s - self.instant_s if math.isfinite(self.instant_s) else 0.0
        alive = alive.predicted(elapsed_s, alive.walk_m2_per_s3)
        match = alive._matches(detections, elapsed_s)
        # The detection of each object; the last place is that of detections without an object.
        detection = np.full(len(alive) + 1, ABSENT)
        detection[match] = np.arange(len(match))
        is_matched, new = detection[:-1] >= 0, np.flatnonzero(match < 0)
        matched = detection[:-1][is_matched]
        number = alive._new_numbers(detections, new)
        found = alive.take(is_matched)._detected(detections, matched, elapsed_s, stages)
        others = []
        if not is_matched.all():
            others.append(alive.take(~is_matched)._undetected(detections, elapsed_s, stages))
        if len(new):
            split_off = alive._split_off(detections, new)
            others.append(NamedObjects._new(detections, new, number, split_off, self.unseen_share, stages))
        n_numbers = int(number.max(initial=self.n_numbers))
        places = detections.states.state[detections.states.placed, :2]
        objects = found.in_order(*others).changed(
            instant_s=instant_s, n_numbers=n_numbers,
            unseen_share=detections.looks.unseen_share(self.unseen_share, places, elapsed_s),
        )  # fmt: skip
        return objects._with_history(self, detections, tuning)

    def _matches(self, detections: UnnumberedObjects, elapsed_s: float) -> IntArray:
        """(n,) the row of each object of the instant among these, ABSENT for none."""
        out = np.full(len(detections), ABSENT)
        if not len(detections) or not len(self):
            return out
        common = self._common_tracks(detections)
        manoeuvred = manoeuvre_m2(self.walk_m2_per_s3, elapsed_s)
        before = Motions(self.state, self._of_hulls(detections.hulls), self.speed_m_per_s)
        after = Motions(detections.states.state, detections.states.covariance, detections.speed_m_per_s)
        first, second = (
            Records.of(one.state[:, :2], covariance=one.covariance[:, :2, :2], source=name)
            for one, name in ((before, "known"), (after, "seen"))
        )
        plots = detections.plots.besides(detections.hulls, np.zeros(len(detections), np.int64))
        is_new = plots.found & (plots.clutter_per_m2 > 0.0)
        log_shown = self._log_shown(detections.looks) if is_new.any() else np.zeros(len(self))
        of_plots = PlotContinuity(plots.clutter_per_m2, is_new, log_shown)
        # The stages of `identify` without its last: no probability of a match is used.
        pairs = NearOrSameId(common, manoeuvred)(first, second)
        pairs = detections.fixes.observed_in(pairs, before.state, before.covariance)
        refuse_crowds(pairs)
        has_velocity = ~detections.fixes.only
        evidence = Continuity(detections.looks.per_m2, common, manoeuvred, before, after, has_velocity, of_plots)(pairs)
        grouped = groups(pairs)
        best = assign(grouped, evidence.log_ratio, EVIDENCE_ALONE(grouped.sizes_1, grouped.sizes_2))
        matched = grouped.order[best.chosen]
        out[second.rows[pairs.j[matched]]] = first.rows[pairs.i[matched]]
        return out

    def _log_shown(self, looks: Looks) -> FloatArray:
        """(k,) log-odds that a look shows each object, if that is real, lowered as far as it may not be."""
        p_shown = 1.0 - self.plot_odds.p_missed(looks.p_missed(self.state[:, :2]))
        log_odds = logit(np.clip(p_shown, MIN_SHOWN, 1.0 - MIN_SHOWN))
        return np.asarray(log_odds + np.log(np.maximum(self.p_real, LEAST_WEIGHT)))

    def _of_hulls(self, hulls: Hulls) -> FloatArray:
        """(k, 4, 4) covariances of where an object may have a plot: on the hull that it owns."""
        if not hulls.echoes or not len(hulls.owners):
            return self.covariance
        covariance = self.covariance.copy()
        covariance[:, :2, :2] += hulls.of_objects(np.where(self.by_plots, self.number, 0))
        return covariance

    def _common_tracks(self, detections: UnnumberedObjects) -> CommonTracks:
        """The common tracks of these objects and those of the instant."""
        at, track = entries(detections.tracks)
        track_place, row = self.history.of(track)
        object_place = places_of(self.number, self.history.number[row])
        is_alive = object_place >= 0
        track_place, row = track_place[is_alive], row[is_alive]
        unique = detections.unique[detections.tracks >= 0][track_place]
        return CommonTracks.of(object_place[is_alive], at[track_place], self.history.share[row], unique)

    def _new_numbers(self, detections: UnnumberedObjects, new: IntArray) -> IntArray:
        """(k,) numbers of the objects ``new`` without a match: that of an ended object with the same unique id, else
        a new one."""
        number = np.zeros(len(new), np.int64)
        if not len(new):
            return number
        for column in range(detections.tracks.shape[1]):
            tracks = detections.tracks[new, column]
            previous = np.where(detections.unique[new, column], self.history.main_ended(tracks, self.number), 0)
            free = (previous > 0) & (number == 0) & ~np.isin(previous, self.number) & ~np.isin(previous, number)
            _, first = np.unique(previous, return_index=True)
            once = np.isin(np.arange(len(new)), first)
            number = np.where(free & once, previous, number)
        is_new = number == 0
        number[is_new] = self.n_numbers + 1 + np.arange(np.count_nonzero(is_new))
        return number

    def _split_off(self, detections: UnnumberedObjects, new: IntArray) -> BoolArray:
        """(k,) whether a new object split off one of these: it has a track whose last object is one of them."""
        tracks = detections.tracks[new]
        owner = places_of(self.number, self.history.last_of(tracks.ravel())).reshape(tracks.shape)
        return np.asarray((owner >= 0).any(axis=1))

    def _detected(
        self, detections: UnnumberedObjects, which: IntArray, elapsed_s: float, stages: Stages
    ) -> NamedObjects:
        """These objects, updated by their matches ``which`` of the instant."""
        states, new_report = detections.states, detections.new_report[which]
        new_plots = detections.plots.take(which).besides(detections.hulls, self.number)
        state, covariance = taken(states.state, which), taken(states.covariance, which)
        extent = np.where(self.by_plots[:, None, None], new_plots.extent, 0.0)
        covariance[:, :2, :2] += extent
        velocity_known = taken(states.moving, which)
        # Without a velocity, it follows from the object's positions.
        by_fixes = detections.fixes.only[which]
        at = np.flatnonzero(~velocity_known & ~by_fixes)
        if len(at):
            before = Gaussian(taken(self.state, at), taken(self.covariance, at))
            state[at], covariance[at] = _updated(before, state[at], covariance[at], new_report[at])
        # Offsets of directions do not average out.
        lasting = detections.lasting_share[which, None, None] * states.covariance[which][:, :2, :2]
        covariance[:, :2, :2] += np.where((~velocity_known & ~by_fixes)[:, None, None], lasting, 0.0)
        at = np.flatnonzero(by_fixes)
        if len(at):
            state[at], covariance[at] = detections.fixes.updated(
                which[at], self.state[at], self.covariance[at], extent[at]
            )
        n_updates, n_plots = self.n_updates + new_report, self.n_plots + detections.new_plot[which]
        # The gain of an ended main track is kept; one that continues still counts by its own duration.
        continues = over_columns(np.logical_or, self.main_track[:, None] == taken(detections.tracks, which))
        replaced = (self.main_track != detections.existence.track[which]) & ~continues
        earlier_log_odds = self.earlier_log_odds + np.where(replaced, self.main_log_odds, 0.0)
        log_initial, log_gain = detections.existence.log_initial[which], detections.existence.log_gain[which]
        is_real = log_initial + earlier_log_odds + log_gain >= logit(stages.real)
        split_off = self.split_off.copy()
        at = np.flatnonzero(split_off)
        if len(at):
            split_off[at] = self.take(at)._own_share(detections.tracks[which[at]]) < OWN_SHARE
        odds = self.plot_odds.after(self, new_plots, detections.looks, elapsed_s, self.unseen_share)
        is_real_by_plots = (odds.log_odds >= logit(stages.real)) | ~states.placed[which]
        newly = ((detections.is_certain[which] | is_real) & ~split_off) | (is_real_by_plots & (n_plots >= stages.scans))
        confirmed = (self.stage != TENTATIVE) | (newly & detections.is_believed[which])
        # A direction alone gives no position, but improves one that is known.
        placed = states.placed[which] | (self.placed & ~velocity_known & ~aged(covariance, detections.looks.per_m2))
        return self.changed(stage=np.where(confirmed, CONFIRMED, TENTATIVE),
            state=state, covariance=covariance, placed=placed,
            moving=velocity_known | (self.placed & placed & (n_updates > 1)), detection=which,
            n_updates=n_updates, n_plots=n_plots, split_off=split_off, **_columns_of(odds),
            n_missing=np.where(confirmed, 0, self.n_missing),
            main_track=detections.existence.track[which], main_log_odds=log_gain, earlier_log_odds=earlier_log_odds,
            walk_m2_per_s3=detections.walk_m2_per_s3[which], speed_m_per_s=detections.speed_m_per_s[which],
        )  # fmt: skip

    def _own_share(self, tracks: IntArray) -> FloatArray:
        """(k,) the largest share in each object's history of any of its present tracks (k, S)."""
        out = np.zeros(len(self))
        at, row = self.history.of(tracks.ravel())
        at //= max(tracks.shape[1], 1)
        own = self.history.number[row] == self.number[at]
        np.maximum.at(out, at[own], self.history.share[row[own]])
        return out

    @classmethod
    def _new(
        cls, detections: UnnumberedObjects, which: IntArray, number: IntArray, split_off: BoolArray,
        unseen_share: float, stages: Stages,
    ) -> NamedObjects:  # fmt: skip
        """The objects ``which`` of the instant as new or returning objects.

        number : theirs. split_off : whether each split off an object that continues. unseen_share : of the objects,
        before the instant.
        """
        n, states = len(which), detections.states
        is_real = detections.existence.log_initial[which] + detections.existence.log_gain[which] >= logit(stages.real)
        plots = detections.plots.take(which).besides(detections.hulls, np.zeros(n, np.int64))
        odds = PlotOdds.begun(plots, detections.looks, unseen_share)
        is_real_by_plots = (odds.log_odds >= logit(stages.real)) | ~states.placed[which]
        confirmed = ((detections.is_certain[which] | is_real) & ~split_off) | (is_real_by_plots & (stages.scans <= 1))
        confirmed &= detections.is_believed[which]
        state, covariance = states.state[which], states.covariance[which]
        at = np.flatnonzero(detections.fixes.only[which])
        if len(at):
            state[at], covariance[at] = detections.fixes.started(which[at])
        return cls(
            number=number, stage=np.where(confirmed, CONFIRMED, TENTATIVE), state=state, covariance=covariance,
            placed=states.placed[which], moving=states.moving[which],
            detection=which, n_updates=np.ones(n, np.int64), n_plots=detections.new_plot[which].astype(np.int64),
            n_missing=np.zeros(n, np.int64), split_off=split_off, **_columns_of(odds),
            main_track=detections.existence.track[which],
            main_log_odds=detections.existence.log_gain[which], earlier_log_odds=np.zeros(n),
            walk_m2_per_s3=detections.walk_m2_per_s3[which], speed_m_per_s=detections.speed_m_per_s[which],
        )  # fmt: skip

    def _undetected(self, detections: UnnumberedObjects, elapsed_s: float, stages: Stages) -> NamedObjects:
        """These objects at an instant at which no source detects them."""
        tentative = self.stage == TENTATIVE
        n_missing = self.n_missing + ((tentative | ~self.placed) & bool(detections.new_report.any()))
        per_m2 = np.where(self.walk_m2_per_s3 >= AIRCRAFT_WALK_M2_PER_S3, 1.0 / (math.pi * LOST_M**2), 0.0)
        too_uncertain = aged(self.covariance, np.maximum(per_m2, detections.looks.per_m2))
        # If all tracks of an object now belong to others, it was one of those objects.
        last = self.history.take(np.flatnonzero(self.history.last))
        in_scan = np.isin(last.track, detections.tracks)
        absorbed = np.isin(self.number, last.number[in_scan]) & ~np.isin(self.number, last.number[~in_scan])
        none = NewPlots.none(len(self))
        odds = self.plot_odds.after(self, none, detections.looks, elapsed_s, self.unseen_share)
        missed = tentative & (n_missing > stages.of - stages.scans)
        # Without a position there is nothing to predict.
        too_uncertain |= ~self.placed & (n_missing > stages.of)
        ended = too_uncertain | absorbed | np.where(self.by_plots, odds.improbable(~tentative), missed)
        stage = np.where(ended, ENDED, np.where(tentative, TENTATIVE, COASTING))
        objects = self.undetected(stage).changed(n_missing=n_missing, **_columns_of(odds))
        return objects.take(np.flatnonzero(~(ended & tentative & self.by_plots)))

    def _with_history(self, before: NamedObjects, detections: UnnumberedObjects, tuning: Tuning) -> NamedObjects:
        """These objects with the history after the instant."""
        at, track = entries(detections.tracks)
        number, alive = self.numbers(len(detections))[at], self.number[self.stage != ENDED]
        history = before.history.advance(
            self.instant_s, track, number, detections.unique[detections.tracks >= 0], alive, tuning,
            detections.forgotten,
        )  # fmt: skip
        return self.changed(history=history)


def _columns_of(odds: PlotOdds) -> dict[str, Any]:
    """The columns of :class:`NamedObjects` with these odds."""
    return {f"plot_{name}": getattr(odds, name) for name in ("log_odds", "log_initial", "looked", "missed")}


def _updated(
    objects: Gaussian, state: FloatArray, covariance: FloatArray, new_report: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Predicted states and covariances of objects, updated by the reported positions where there is a new report."""
    updated = objects.updated(Gaussian(state[:, :2], covariance[:, :2, :2]))
    updated_covariance = np.where(new_report[:, None, None], updated.covariance, objects.covariance)
    return np.where(new_report[:, None], updated.mean, objects.mean), symmetric(updated_covariance)

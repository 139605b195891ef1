"""The watch: the state of a picture over time, that is the memory of its tracks, its objects and their texts.

:meth:`Watch.advance` gives the :class:`~sameas.picture.picture_state.PictureState` of the next instant and the watch
after it:

    state = watch.at(scene, t)
    watch = state.watch

The memory of tracks takes in reports at steps of ``memory_every_s``, whatever the instants are that are shown. Between
two of these the picture is that of the last step with the present positions; where instants are farther apart, the
memory steps in between. So do the objects at each scan of a source of plots without names: it shows an object once, and
an instant shows its last scan only.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import ABSENT, BoolArray, FloatArray, IntArray, are_among, over_columns
from sameas.errors import InputError
from sameas.gate import ChiSquare
from sameas.many.hysteresis import with_hysteresis
from sameas.many.identify import identify_many
from sameas.many.objects import Objects
from sameas.many.observations import records_of
from sameas.many.pooled import PooledRecords
from sameas.many.rules import PoissonObjects, SetRule
from sameas.picture.fixes import Fixes
from sameas.picture.hull_echoes import Hulls, ScanPlots
from sameas.picture.memory import TrackMemory, require_order
from sameas.picture.object_ids import NamedObjects, Stages, UnnumberedObjects
from sameas.picture.picture_state import IdentifiedObjects, PictureState
from sameas.picture.plot_existence import Looks, NewPlots, gives_plots, looks_between
from sameas.picture.plot_rates import PlotRates, nearest_object
from sameas.picture.tables import COASTING, CONFIRMED, TENTATIVE, ObjectStates, Scan, object_states, objects_per_m2
from sameas.picture.texts import RecordTexts, texts_of
from sameas.picture.tuning import DEFAULT_TUNING, GATE, LIVE, Tuning
from sameas.records import Records
from sameas.representation import in_short
from sameas.tracks.placement import Directions
from sameas.tracks.scene import Instant, Scene

#: Attributes that are unique to an object.
UNIQUE_IDS = ("mmsi", "icao", "callsign")
#: Makes the rule of an instant from the instant and the memory.
EvidenceOf = Callable[[Instant, TrackMemory], SetRule]


#: Functions that saved states refer to by name (:mod:`sameas.io.saved`).
SAVED = ("all_evidence",)

MEMORY_STEPS = 60  # the memory of tracks takes in reports at this many instants between two of the picture, at most


def all_evidence(now: Instant, memory: TrackMemory, *, identity: bool = True, previous_scans: bool = True) -> SetRule:
    """The rule of positions, misses and clutter as described, of what sensors do not resolve, of heights and
    identities, of the memory of tracks, and of velocities for pairs that it does not know yet.

    identity, previous_scans : False to exclude attributes of identity, and the memory.
    """
    evidence: SetRule = now.rule() + now.resolution()
    if any(heights is not None for heights in now.heights):
        evidence = evidence + now.height()
    if identity:
        evidence = evidence + now.identity()
    if not previous_scans:
        return evidence
    history = memory.rule()
    first_contact = memory.first_contact(history)
    return evidence + history if first_contact is None else evidence + history + first_contact


@in_short
@dataclass(frozen=True)
class Watch:
    """The state of a picture from instant to instant; start with ``Watch()``.

    Parameters
    ----------
    evidence : makes the rule of an instant. ``lambda now, memory: now.rule() + memory.rule()`` ignores identities,
        ``lambda now, memory: now.rule() + now.height() + now.identity()`` identifies each instant without memory.
    memory : the memory of tracks, updated from instant to instant.
    bound : odds at which records change their object (:mod:`sameas.many.hysteresis`; chosen); 1 for the most
        probable answer of each instant.
    stages : when objects are confirmed. gate : of ``identify_many``. tuning : other chosen numbers.
    misread : names of sources whose positions may be wrong (:attr:`sameas.tracks.scene.Scene.misread`): one with false
        records confirms no object by itself.
    objects, texts : the objects and their texts, updated from instant to instant.
    plot_rates : misses and clutter of sources of plots without names, where they are assumed; updated likewise.
    shown, shown_tracks, forgotten : the scan of the last instant shown, the numbers of its records' tracks, ABSENT for
        none, and those of tracks that ended since; updated likewise.
    """

    evidence: EvidenceOf = all_evidence
    memory: TrackMemory = field(default_factory=TrackMemory)
    bound: float = 4.0
    stages: Stages = field(default_factory=Stages)
    misread: frozenset[str] = frozenset()
    gate: ChiSquare = GATE
    tuning: Tuning = DEFAULT_TUNING
    objects: NamedObjects = field(default_factory=NamedObjects)
    texts: Mapping[int, NDArray[Any]] = field(default_factory=dict, repr=False)
    plot_rates: PlotRates = field(default_factory=PlotRates, repr=False)
    shown: Scan | None = field(default=None, repr=False)
    shown_tracks: IntArray | None = field(default=None, repr=False)
    forgotten: IntArray = field(default_factory=lambda: np.empty(0, np.int64), repr=False)

    def __post_init__(self) -> None:
        if not 1.0 <= self.bound < math.inf:
            raise InputError(f"Watch: bound is {self.bound}; give odds of 1 or more")

    def at(self, scene: Scene, instant_s: float) -> PictureState[Watch]:
        """The picture at an instant not before the previous one, from all steps of the memory and all scans of plots
        without names since.

        Raises
        ------
        InputError : as of :meth:`advance`.
        """
        if self.shown is None:
            return self._to(scene, instant_s)
        carried = self
        looks_s = looks_between(scene.feeds, self.shown.now.instant_s, instant_s, self.tuning)
        for look_s in looks_s:
            carried = carried._to(scene, look_s).watch
        state = carried._to(scene, instant_s)
        return replace(state, watch=state.watch._with_ends(self)) if looks_s else state

    def _to(self, scene: Scene, instant_s: float) -> PictureState[Watch]:
        """The picture at an instant from all steps of the memory since the last."""
        carried, since_s = self, instant_s - self.memory.tracks.instant_s
        if math.isfinite(since_s):
            n = min(int(since_s / self.tuning.memory_every_s + 1e-9), MEMORY_STEPS)
            for k in range(1, n):
                carried = carried.passed(scene.at(instant_s - since_s * (1.0 - k / n)))
        return carried.advance(scene.at(instant_s))

    def _with_ends(self, before: Watch) -> Watch:
        """The watch with the objects of an earlier instant that have ended between that and this one."""
        ended = before.objects.not_in(self.objects)
        elapsed_s = self.objects.instant_s - before.objects.instant_s
        objects = self.objects.with_ends(ended, elapsed_s, ended.walk_m2_per_s3)
        texts = {number: before.texts[number] for number in ended.number.tolist()}
        return replace(self, objects=objects, texts={**self.texts, **texts})

    def doubting(self, misread: frozenset[str], members: IntArray) -> Watch:
        """The watch with other sources whose positions may be wrong.

        A confirmed object is tentative again if new ones of these alone show it, or if plots without names alone ever
        showed it and all sources of such plots are among them.

        members : (n, S) records of the objects of the last instant shown.
        """
        out = replace(self, misread=misread)
        if self.shown is None or not misread - self.misread:
            return out
        feeds, objects = self.shown.now.feeds, self.objects
        wrong = np.array([feed.description.name in misread and feed.clutter(2) > 0.0 for feed in feeds], dtype=bool)
        of_plots = np.array([gives_plots(feed) for feed in feeds], dtype=bool)
        only_wrong = np.append(np.append(wrong[self.shown.source], True)[members].all(axis=1), False)[objects.detection]
        only_wrong |= objects.by_plots & bool(wrong[of_plots].all())
        doubtful = only_wrong & np.isin(objects.stage, (CONFIRMED, COASTING))
        return replace(out, objects=replace(objects, stage=np.where(doubtful, TENTATIVE, objects.stage)))

    def displaced(self) -> Watch:
        """The watch after the positions of sources changed altogether, by other offsets: no track went there."""
        tracks = self.memory.tracks
        tracks = replace(tracks, past=np.full_like(tracks.past, np.nan))
        return replace(self, memory=replace(self.memory, tracks=tracks))

    def passed(self, now: Instant) -> Watch:
        """The watch after an instant that is not shown: its reports are in the memory of tracks."""
        scan, track_of_record = self._scan(now, self._hulls_at(now))
        memory = self.memory.advance(scan, track_of_record)
        return replace(self, memory=memory, forgotten=np.concatenate([self.forgotten, memory.tracks.forgotten]))

    def _scan(self, now: Instant, hulls: Hulls) -> tuple[Scan, IntArray]:
        """The scan of an instant, and (n,) the numbers of its records' tracks, ABSENT for new ones."""
        scan = self.memory.tracks.error_factors.applied(Scan.of(now.with_records(), self.tuning))
        if hulls.echoes:
            scan = self._with_hulls(scan, hulls)
        track_of_record = self.memory.tracks.numbers_on(scan)
        together = self.objects.history.together
        return self.memory.with_manoeuvres(scan, track_of_record, objects_per_m2(now), together), track_of_record

    def _hulls_at(self, now: Instant) -> Hulls:
        """The hulls about which echoes are looked for at an instant; none without a source of plots."""
        if not any(gives_plots(feed) for feed in now.feeds):
            return Hulls()
        return Hulls(self.objects.owners_at(now.instant_s), self.plot_rates.hulls)

    def _with_hulls(self, scan: Scan, hulls: Hulls) -> Scan:
        """The scan with the errors of the plots that may be of any place of a hull."""
        extent = np.zeros((len(scan), 4, 4))
        others = self.objects.of_plots_at(scan.now.instant_s)
        others = others.take((others.p_real > 0.5) & ~np.isin(others.number, hulls.owners.number))
        for s, feed in enumerate(scan.now.feeds):
            if gives_plots(feed):
                rows = np.arange(scan.start[s], scan.start[s + 1])
                place, covariance = scan.state[rows, :2], scan.covariance[rows, :2, :2]
                own = nearest_object(place, covariance, others)
                of_hulls = hulls.extent(feed.description.name, ScanPlots(place, covariance, own))
                extent[rows, :2, :2] = np.where((own == 0)[:, None, None], of_hulls, 0.0)
        return replace(scan.with_covariance(extent), hull_covariance=extent[:, :2, :2]) if extent.any() else scan

    def _is_due(self, now: Instant) -> bool:
        """Whether the memory steps at an instant: after ``memory_every_s``, or where a source is new."""
        tracks = self.memory.tracks
        is_new = not {description.name for description in now.descriptions} <= set(tracks.error_correlation.names)
        return is_new or now.instant_s - tracks.instant_s >= self.tuning.memory_every_s - 1e-6

    def advance(self, now: Instant) -> PictureState[Watch]:
        """The picture at an instant not before the previous one, without steps of the memory in between.

        Raises
        ------
        InputError : the instant is before the previous one; a source lacks what its evidence needs.
        """
        if self.shown is not None:
            require_order(self.shown.now.instant_s, now.instant_s)
        if any(feed.reports.track is None for feed in now.feeds):
            now = self.plot_rates.applied(now, self.objects.of_plots_at(now.instant_s))
        hulls = self._hulls_at(now)
        scan, track_of_record = self._scan(now, hulls)
        with_records, is_due = scan.now, self._is_due(scan.now)
        memory = (self.memory.advance if is_due else self.memory.looked_ahead)(scan, track_of_record)
        identification = self._identify(with_records, memory)
        by_hysteresis = np.zeros(0, bool)
        if identification is not None:
            identification, by_hysteresis = with_hysteresis(
                identification,
                self._previous_objects(identification.pooled, scan, memory),
                math.log(self.bound),
                tuning=LIVE,
            )
        objects_now = IdentifiedObjects(scan, identification, by_hysteresis)
        members = objects_now.members
        texts = texts_of(scan)
        looks = Looks.since(now, -math.inf if self.shown is None else self.shown.now.instant_s)
        is_new = scan.new_since(self.shown)
        hulls = hulls if looks.feeds else Hulls()
        detections = self._detections(scan, members, identification, memory, texts, looks, hulls, is_new)
        memory = memory.with_real(detections.tracks[_certain_pairs(members, identification, self.stages)])
        objects = self.objects.advance(now.instant_s, detections, self.stages, self.tuning)
        object_texts = RecordTexts.of(scan, members, texts, objects).of_objects(objects, self.texts)
        if not is_due:
            kept = self.memory.with_numbers_of(memory, self.tuning)
        elif identification is None:
            kept = memory
        else:
            kept = memory.with_pairs(identification.pooled).with_sure(members, identification.probability)
        carried = replace(
            self, memory=kept, objects=objects, texts=object_texts, shown=scan,
            shown_tracks=memory.tracks.track_of_record, forgotten=np.empty(0, np.int64),
            plot_rates=self._counted(scan, members, is_new, looks, objects),
        )  # fmt: skip
        return PictureState(now, scan, objects_now, detections.states, carried)

    def _counted(
        self, scan: Scan, members: IntArray, is_new: BoolArray, looks: Looks, objects: NamedObjects
    ) -> PlotRates:
        """The counts of the sources of plots after an instant with these objects."""
        if not looks.feeds:
            return self.plot_rates
        detected, is_named = np.flatnonzero(objects.detected), np.zeros(len(scan) + 1, bool)
        is_named[members[objects.detection[detected]]] = ~objects.by_plots[detected, None]
        number = np.zeros(len(scan) + 1, np.int64)
        number[members[objects.detection[detected]]] = objects.number[detected, None]
        named = np.flatnonzero(objects.detected & (objects.main_track >= 0) & (objects.stage == CONFIRMED))
        shown = np.append(is_new, False)[members[objects.detection[named]]]
        owners = objects.owners_at(scan.now.instant_s)
        return self.plot_rates.advance(
            scan, looks, is_named[:-1], number[:-1], is_new, objects.take(named), shown, owners
        )

    def _previous_objects(self, pooled: PooledRecords, scan: Scan, memory: TrackMemory) -> IntArray:
        """(records,) the object of each pooled record's track at the previous instant, ABSENT without one."""
        out = np.full(len(pooled), ABSENT)
        if self.shown_tracks is None:
            return out
        track, before = memory.tracks.track_of_record, self.shown_tracks
        previous = np.where(are_among(track, before[before >= 0]), self.objects.history.last_of(track), 0)
        for s, (source_number, source) in enumerate(zip(pooled.given, pooled.sources, strict=True)):
            if source_number + 1 < len(scan.start):
                out[pooled.start[s] : pooled.start[s + 1]] = previous[scan.find(source_number, records_of(source).rows)]
        return np.where(out > 0, out, ABSENT)

    def _identify(self, now: Instant, memory: TrackMemory) -> Objects | None:
        """The objects of an instant; None where no source has a record."""
        if not now.sources:
            return None
        if len(now.sources) == 1:
            # identify_many needs two sources; with an empty one each record is an object.
            empty = Records.of(np.empty((0, 2)), sigma=1.0, source="")
            rule = PoissonObjects(now.density, 0.5)
            return identify_many((*now.sources, empty), rule=rule, region=now.region)
        return identify_many(
            now.sources, rule=self.evidence(now, memory), gate=self.gate, region=now.region, tuning=LIVE
        )

    def _detections(
        self, scan: Scan, members: IntArray, identification: Objects | None, memory: TrackMemory,
        texts: Mapping[str, NDArray[Any]], looks: Looks, hulls: Hulls, is_new: BoolArray,
    ) -> UnnumberedObjects:  # fmt: skip
        """The objects of an instant with the properties that identify them over time."""
        states = object_states(scan, members, identification)
        is_member = members >= 0
        # A plot alone is of its own place: an object that owns a hull adds its extent.
        alone = np.flatnonzero(is_member.sum(axis=1) == 1) if scan.hull_covariance.any() else np.empty(0, np.int64)
        states.covariance[alone, :2, :2] -= scan.hull_covariance[members[alone].max(axis=1, initial=ABSENT)]
        track = np.append(memory.tracks.track_of_record, ABSENT)[members]
        has_unique_id = np.zeros(len(scan) + 1, bool)  # the last place is that of no record
        for name in UNIQUE_IDS:
            if name in texts:
                has_unique_id[:-1] |= texts[name] != ""
        # Each record of a source without clutter is of a real object.
        clutter_free = np.array([feed.clutter(2) == 0.0 for feed in scan.now.feeds], dtype=bool)
        is_certain = over_columns(np.logical_or, is_member & clutter_free) | _certain_pairs(
            members, identification, self.stages
        )
        is_named = memory.tracks.track_of_record >= 0
        names = [description.name for description in scan.now.descriptions]
        believed = clutter_free | np.array([name not in self.misread for name in names], dtype=bool)
        new_report, new_plot = (
            over_columns(np.logical_or, np.append(column, False)[members]) for column in (is_new, is_new & ~is_named)
        )
        walk, speed = (
            over_columns(np.maximum, np.append(column, 0.0)[members])
            for column in (scan.walk_m2_per_s3, scan.speed_m_per_s)
        )
        return UnnumberedObjects(
            states=states,
            tracks=track,
            unique=has_unique_id[members] & is_member,
            new_report=new_report,
            new_plot=new_plot,
            plots=NewPlots.of(scan, members, is_new, is_named, looks),
            fixes=Fixes.of(scan, members, is_new),
            hulls=hulls,
            looks=looks,
            is_certain=is_certain,
            is_believed=(is_member & believed).any(axis=1),
            existence=memory.existence.of_objects(track),
            walk_m2_per_s3=walk,
            speed_m_per_s=speed,
            lasting_share=_lasting_share(scan, members, states),
            forgotten=np.concatenate([self.forgotten, memory.tracks.forgotten]),
        )


def _lasting_share(scan: Scan, members: IntArray, states: ObjectStates) -> FloatArray:
    """(n,) the share of the variance that the offsets of crossing directions have; 0 of objects with a position."""
    share = np.zeros(len(scan) + 1)  # the last place is that of no record
    for s, feed in enumerate(scan.now.feeds):
        if isinstance(feed.reports, Directions):
            rows = scan.row[scan.start[s] : scan.start[s + 1]]
            lasting = np.broadcast_to(feed.reports.lasting_deg, len(feed.reports))[rows]
            share[scan.start[s] : scan.start[s + 1]] = (lasting / feed.reports.sigma_deg[rows]) ** 2
    if not share.any():
        return np.zeros(len(members))
    is_member = members >= 0
    mean = np.where(is_member, share[members], 0.0).sum(axis=1) / np.maximum(is_member.sum(axis=1), 1)
    has_position = np.append(scan.placed, False)[members].any(axis=1)
    return np.where(states.placed & ~has_position, mean, 0.0)


def _certain_pairs(members: IntArray, identification: Objects | None, stages: Stages) -> BoolArray:
    """(n,) whether an object certainly has records of two or more sources."""
    if identification is None:
        return np.zeros(len(members), bool)
    several = over_columns(np.add, (members >= 0).astype(np.int64)) > 1
    return np.asarray(several & (identification.probability >= stages.sure))

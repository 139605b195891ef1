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

from sameas.arrays import ABSENT, BoolArray, FloatArray, IntArray, are_among, entries, over_columns, taken
from sameas.errors import InputError
from sameas.gate import ChiSquare
from sameas.kernels.components import label_components
from sameas.many.identify import identify_many
from sameas.many.marginals import best_sets
from sameas.many.objects import Objects
from sameas.many.observations import records_of
from sameas.many.pooled import PooledRecords
from sameas.many.rules import PoissonObjects, SetRule
from sameas.many.sets import ManyTuning, Sets
from sameas.picture.fixes import Fixes
from sameas.picture.hull_echoes import Hulls, ScanPlots
from sameas.picture.memory import TrackMemory, require_order
from sameas.picture.object_ids import NamedObjects, Stages, UnnumberedObjects
from sameas.picture.picture_state import IdentifiedObjects, PictureState
from sameas.picture.plot_existence import Looks, NewPlots, gives_plots, looks_between
from sameas.picture.plot_rates import PlotRates, nearest_object
from sameas.picture.tables import CONFIRMED, PictureObjects, Scan, object_states, objects_per_m2
from sameas.picture.tuning import DEFAULT_TUNING, GATE, Tuning
from sameas.records import Records
from sameas.representation import in_short
from sameas.tracks.scene import POSITION, Instant, Scene

#: Default b of :func:`with_hysteresis`: odds of a change (chosen).
BOUND = 4.0


def with_hysteresis(
    identification: Objects, previous_object: IntArray, log_bound: float, tuning: Tuning = DEFAULT_TUNING
) -> tuple[Objects, BoolArray]:
    """The objects of an instant, with those of the previous instant kept unless another answer is much more probable;
    and (n,) whether each object is shown only because it is kept.

    Two vessels at one pier share an echo whose owner stays uncertain for hours: 60 to 40, then 45 to 55. The most
    probable answer would switch back and forth. So the picture shows the partition that maximises

        ln P(partition) − ln b · links,

    with P from all scans, and ``links`` the number of links that the partition breaks: n − 1 where it splits the
    records of one object of the previous instant into n parts. Joining breaks no link, and only records of named tracks
    have a previous object. Two trackers that exchange two ships' ids once are one change, which breaks two links or
    more; so where this partition and the most probable one differ, each connected part of the difference is kept only
    while the other answer is less than b times as probable. Probabilities do not change.
    Source: the decision of least expected loss when a reversed change has a cost (Berger 1985, section 2).

    Parameters
    ----------
    previous_object : (records,) the object of each pooled record's track at the previous instant, ABSENT without one.
    log_bound : ln b; 0 to show the most probable answer always.
    tuning : with the time limit of the search for the best partition of one group.
    """
    sets, answer, n = identification.sets, identification.answer, len(identification.pooled)
    if log_bound <= 0.0:
        return identification, np.zeros(len(identification), bool)
    # Components that no possible set connects are independent; only those that split a previous object are re-solved.
    possible, record = answer.probability > 0.0, over_columns(np.maximum, sets.members)
    component = _components(sets, possible | answer.chosen, n)[record]
    resolve = _splits(sets, component, previous_object, answer.chosen)[component]
    if not resolve.any():
        return identification, np.zeros(len(identification), bool)
    which = np.flatnonzero(resolve)
    log_weight = sets.log_weight.copy()
    log_weight[which] += log_bound * _links(taken(sets.members, which), previous_object)
    with_links = replace(sets, log_weight=log_weight)
    best = best_sets(with_links, n, possible & resolve, time_limit_s=tuning.search_s, tuning=LIVE)
    chosen = np.where(resolve, best, answer.chosen)
    change = _components(sets, chosen ^ answer.chosen, n)[record]
    gain = np.bincount(change, sets.log_weight * (answer.chosen.astype(np.int64) - chosen), n)
    chosen = np.where(gain[change] < log_bound, chosen, answer.chosen)
    log_loss = _log_weight(sets, answer.chosen) - _log_weight(sets, chosen)
    kept = replace(identification, answer=replace(answer, chosen=chosen, gap=answer.gap + np.maximum(log_loss, 0.0)))
    return kept, ~answer.chosen[kept.set_of_object]


def _components(sets: Sets, which: BoolArray, n_records: int) -> IntArray:
    """(records,) the connected component of each record, by the sets ``which``."""
    several = np.flatnonzero(which & (sets.size > 1))
    members = taken(sets.members, several)
    at, record = entries(members)
    edges = (n_records + at, record)
    parent, component = np.empty((2, n_records + len(several)), np.int64)
    label_components(*edges, parent, component)
    return component[:n_records]


def _links(members: IntArray, previous_object: IntArray) -> IntArray:
    """(k,) links within each set (k, S): its records with a previous object, minus the number of these objects."""
    previous = np.sort(np.append(previous_object, ABSENT)[members], axis=1)
    has_previous = previous >= 0
    objects = (has_previous[:, :1] + np.cumsum((previous[:, 1:] != previous[:, :-1]) & has_previous[:, 1:], axis=1))[
        :, -1:
    ].sum(axis=1)
    return np.asarray(has_previous.sum(axis=1) - objects)


def _splits(sets: Sets, component: IntArray, previous_object: IntArray, chosen: BoolArray) -> BoolArray:
    """(components,) whether the chosen sets split a previous object; component : (k,) of each set."""
    which = np.flatnonzero(chosen)
    members = taken(sets.members, which)
    at, record = entries(members)
    previous, own = previous_object[record], which[at]
    order = np.lexsort([own, component[own], previous])
    order = order[previous[order] >= 0]
    one, other = order[:-1], order[1:]
    same_component = component[own[one]] == component[own[other]]
    split = (previous[one] == previous[other]) & same_component & (own[one] != own[other])
    out = np.zeros(int(component.max(initial=-1)) + 1, bool)
    out[component[own[other[split]]]] = True
    return out


def _log_weight(sets: Sets, chosen: BoolArray) -> FloatArray:
    """(g,) ln w of the partition of each group."""
    return np.asarray(np.bincount(sets.group[chosen], sets.log_weight[chosen], len(sets.start) - 1), np.float64)


#: Attributes of identity in the tables of a picture: names of an object, and what is reported with them.
NAMES, WITH_NAMES = ("mmsi", "icao", "callsign", "name"), ("mode_a", "type")
TEXTS = (*NAMES, *WITH_NAMES)
#: Attributes that are unique to an object.
UNIQUE_IDS = ("mmsi", "icao", "callsign")
#: Work limits of an instant. In crowded pictures (500 objects, 0.1 others within σ) the excluded sets change
#: probabilities by at most 5e-4; a first cut of 20, with 6 for the largest groups as well, takes twice as long.
LIVE = ManyTuning(cuts=(10.0, 8.0, 6.0, 4.0, 2.0, 1.0), block_steps=10_000)
#: The texts of an object without any.
NO_TEXTS = np.full(len(TEXTS), "", dtype=object)


#: Makes the rule of an instant from the instant and the memory.
EvidenceOf = Callable[[Instant, TrackMemory], SetRule]


#: Functions that saved states refer to by name (:mod:`sameas.io.saved`).
SAVED = ("all_evidence",)


def all_evidence(now: Instant, memory: TrackMemory, *, identity: bool = True, previous_scans: bool = True) -> SetRule:
    """The rule of positions, misses and clutter as described, of heights and identities, and of the memory of tracks,
    and of velocities for pairs that it does not know yet.

    identity, previous_scans : False to exclude attributes of identity, and the memory.
    """
    evidence: SetRule = now.rule()
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
    memory : the memory of tracks; give one to set the correlation times of their errors.
    bound : odds at which records change their object (:func:`with_hysteresis`); 1 for the most probable answer of
        each instant.
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
    bound: float = BOUND
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

    def at(self, scene: Scene, instant_s: float, *, features: int = POSITION) -> PictureState[Watch]:
        """The picture at an instant not before the previous one, from all steps of the memory and all scans of plots
        without names since.

        features : as of ``Scene.at``.

        Raises
        ------
        InputError : as of :meth:`advance`.
        """
        if self.shown is None:
            return self._to(scene, instant_s, features)
        carried = self
        looks_s = looks_between(scene.feeds, self.shown.now.instant_s, instant_s, self.tuning)
        for look_s in looks_s:
            carried = carried._to(scene, look_s, features).watch
        state = carried._to(scene, instant_s, features)
        return replace(state, watch=state.watch._with_ends(self)) if looks_s else state

    def _to(self, scene: Scene, instant_s: float, features: int) -> PictureState[Watch]:
        """The picture at an instant from all steps of the memory since the last."""
        carried, since_s = self, instant_s - self.memory.tracks.instant_s
        if math.isfinite(since_s):
            n = min(int(since_s / self.tuning.memory_every_s + 1e-9), self.tuning.memory_steps)
            for k in range(1, n):
                carried = carried.passed(scene.at(instant_s - since_s * (1.0 - k / n), features=features))
        return carried.advance(scene.at(instant_s, features=features))

    def _with_ends(self, before: Watch) -> Watch:
        """The watch with the objects of an earlier instant that have ended between that and this one."""
        ended = before.objects.not_in(self.objects)
        elapsed_s = self.objects.instant_s - before.objects.instant_s
        objects = self.objects.with_ends(ended, elapsed_s, ended.walk_m2_per_s3)
        texts = {number: before.texts[number] for number in ended.number.tolist()}
        return replace(self, objects=objects, texts={**self.texts, **texts})

    def passed(self, now: Instant) -> Watch:
        """The watch after an instant that is not shown: its reports are in the memory of tracks."""
        scan, track_of_record = self._scan(now, self._hulls_at(now))
        memory = self.memory.advance(scan, track_of_record)
        return replace(self, memory=memory, forgotten=np.concatenate([self.forgotten, memory.tracks.forgotten]))

    def _scan(self, now: Instant, hulls: Hulls) -> tuple[Scan, IntArray]:
        """The scan of an instant, and (n,) the numbers of its records' tracks, ABSENT for new ones."""
        scan = self.memory.error_factors.applied(Scan.of(now.with_records(), self.tuning))
        if hulls.echoes:
            scan = self._with_hulls(scan, hulls)
        track_of_record = self.memory.tracks.numbers_on(scan)
        together = self.objects.history.together
        return self.memory.with_manoeuvres(scan, track_of_record, objects_per_m2(now), together), track_of_record

    def _hulls_at(self, now: Instant) -> Hulls:
        """The hulls about which echoes are looked for at an instant; none without a source of plots."""
        if not any(gives_plots(feed) for feed in now.feeds):
            return Hulls()
        return Hulls(self.objects.owners_at(now.instant_s, self.tuning), self.plot_rates.hulls, self.tuning)

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
            now = self.plot_rates.applied(now, self.objects.of_plots_at(now.instant_s), self.tuning)
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
                self.tuning,
            )
        objects_now = IdentifiedObjects(scan, identification, by_hysteresis)
        members = objects_now.members
        texts = texts_of(scan)
        looks = Looks.since(now, -math.inf if self.shown is None else self.shown.now.instant_s, self.tuning)
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
        owners = objects.owners_at(scan.now.instant_s, self.tuning)
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
            empty = Records.of(np.empty((0, now.features)), sigma=1.0, source="")
            rule = PoissonObjects(now.density, 0.5)
            return identify_many((*now.sources, empty), rule=rule, region=now.region)
        return identify_many(
            now.sources, rule=self.evidence(now, memory), gate=self.gate, region=now.region, tuning=LIVE
        )

    def _detections(
        self,
        scan: Scan,
        members: IntArray,
        identification: Objects | None,
        memory: TrackMemory,
        texts: Mapping[str, NDArray[Any]],
        looks: Looks,
        hulls: Hulls,
        is_new: BoolArray,
    ) -> UnnumberedObjects:
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
        plots = NewPlots.of(scan, members, is_new, is_named, looks)
        new_report, new_plot = (
            over_columns(np.logical_or, np.append(column, False)[members]) for column in (is_new, is_new & ~is_named)
        )
        walk, speed = (
            over_columns(np.maximum, np.append(column, 0.0)[members])
            for column in (scan.walk_m2_per_s3, scan.speed_m_per_s)
        )
        return UnnumberedObjects(
            states,
            track,
            has_unique_id[members] & is_member,
            new_report,
            new_plot,
            plots,
            Fixes.of(scan, members, is_new),
            hulls,
            looks,
            is_certain,
            (is_member & believed).any(axis=1),
            memory.existence.of_objects(track),
            walk,
            speed,
            np.concatenate([self.forgotten, memory.tracks.forgotten]),
        )


def texts_of(scan: Scan) -> dict[str, NDArray[Any]]:
    """(records,) the texts of an instant by column, of the columns that a source reports."""
    return {name: scan.texts(name) for name in TEXTS if scan.reports(name)}


@dataclass(frozen=True)
class RecordTexts:
    """The texts of the records of an instant, one column of :data:`TEXTS` each.

    newest : (n, texts) of each detected object, that of its newest record with it; "" for none. holders : by column and
    text, the numbers of the objects that have a record with it.
    """

    newest: NDArray[Any]
    holders: Mapping[tuple[int, str], set[int]]

    @classmethod
    def of(
        cls, scan: Scan, members: IntArray, texts: Mapping[str, NDArray[Any]], objects: PictureObjects
    ) -> RecordTexts:
        """members : (n, S) records of the detected objects. texts : (records,) by column, if reported."""
        at, record = entries(members)
        newest = np.full((len(members), len(TEXTS)), "", dtype=object)
        holders: dict[tuple[int, str], set[int]] = {}
        number_of = np.zeros(len(members) + 1, np.int64)  # the last place is that of objects without records
        number_of[objects.detection] = objects.number
        number_of[-1] = 0
        for column, name in enumerate(TEXTS):
            if name not in texts:
                continue
            values = texts[name][record]
            with_value = np.flatnonzero(values != "")
            if not len(with_value):
                continue
            # The newest is written last; of ties the first in alphabetical order.
            alphabetical = np.argsort(np.argsort(values[with_value].astype(str)[::-1]))
            order = with_value[np.lexsort([alphabetical, scan.time_s[record[with_value]]])]
            newest[at[order], column] = values[order]
            for value, number in zip(values[with_value], number_of[at[with_value]].tolist(), strict=True):
                if number:
                    holders.setdefault((column, value), set()).add(number)
        return cls(newest, holders)

    def of_objects(self, objects: PictureObjects, previous: Mapping[int, NDArray[Any]]) -> Mapping[int, NDArray[Any]]:
        """By number of the object, its texts: those of its records, else the previous ones, except those that another
        object has now."""
        out = {number: previous.get(number, NO_TEXTS) for number in objects.number.tolist()}
        has_text = np.append((self.newest != "").any(axis=1), False)[objects.detection]
        for number, k in zip(objects.number[has_text].tolist(), objects.detection[has_text].tolist(), strict=True):
            out[number] = np.where(self.newest[k] != "", self.newest[k], out[number])
        if not self.holders:
            return out
        return {number: self._without_foreign(number, words) for number, words in out.items()}

    def _without_foreign(self, number: int, words: NDArray[Any]) -> NDArray[Any]:
        """The texts of an object without the names that only others have now; then what came with them goes, too."""
        foreign = [
            column
            for column, value in enumerate(words[: len(NAMES)].tolist())
            if value != "" and number not in self.holders.get((column, value), {number})
        ]
        if not foreign:
            return words
        dropped = np.isin(np.arange(len(TEXTS)), [*foreign, *range(len(NAMES), len(TEXTS))])
        return np.where(dropped, "", words).astype(object)


def _certain_pairs(members: IntArray, identification: Objects | None, stages: Stages) -> BoolArray:
    """(n,) whether an object certainly has records of two or more sources."""
    if identification is None:
        return np.zeros(len(members), bool)
    several = over_columns(np.add, (members >= 0).astype(np.int64)) > 1
    return np.asarray(several & (identification.probability >= stages.sure))

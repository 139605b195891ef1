"""The scene: all sources of a picture in one plane, and their records at any instant, input of ``identify_many``.

>>> from sameas import identify_many
>>> from sameas.tracks.reports import Reports
>>> from sameas.tracks.source import Description, Motion, SensorErrors
>>> columns = {"time_s": [0.0, 0.0], "x_m": [0.0, 400.0], "y_m": [0.0, 0.0]}
>>> radar = Reports.of("radar", "table", columns | {"vx_m_per_s": [5.0, 0.0], "vy_m_per_s": [0.0, 0.0]})
>>> ais = Reports.of("ais", "table", {"time_s": [10.0], "x_m": [47.0], "y_m": [3.0]})
>>> scene = Scene.of([
...     (Description("radar", "tracks", errors=SensorErrors(position_m=5.0)), radar), (Description("ais", "ais"), ais)])
>>> now = scene.at(10.0)
>>> now.sources[0].features.round(1).tolist()
[[50.0, 0.0], [400.0, 0.0]]
>>> print(identify_many(now.sources, rule=now.rule(), region=now.region).members)
[[0 0]
 [1 --]]
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import pdist

from sameas.arrays import AnyIntArray, FloatArray, IntArray, taken, tall_product
from sameas.errors import InputError
from sameas.evidence.heights import Heights
from sameas.evidence.identity import Identity, IdentityConflict, alarms
from sameas.evidence.rule import Evidence, Rule
from sameas.gate import Pairs
from sameas.many.observations import Region, Source, records_of
from sameas.many.rules import PoissonObjects
from sameas.records import Records
from sameas.representation import in_short
from sameas.tracks.alignment import States
from sameas.tracks.antennas import antenna_lines, antenna_offsets, with_antennas
from sameas.tracks.coordinates import LocalPlane
from sameas.tracks.doubts import Doubt, doubts
from sameas.tracks.elsewhere import of_other_days, too_far_apart
from sameas.tracks.error_fit import TrackErrorFit, fit_errors
from sameas.tracks.feed import Feed, need_filtering, of_their_objects
from sameas.tracks.heights import HeightModel, HeightReports, heights_of
from sameas.tracks.placement import Directions, PlacedReports
from sameas.tracks.platforms import on_platform, only_carries
from sameas.tracks.plot_offsets import PlotFits
from sameas.tracks.plot_pairs import moves
from sameas.tracks.registration import SourceBiases, registered
from sameas.tracks.reports import Reports
from sameas.tracks.running_fixes import running_fixes
from sameas.tracks.snapshot import POSITION, POSITION_AND_VELOCITY, Snapshot
from sameas.tracks.source import Assumption, Description
from sameas.tracks.target_heights import Partners, with_target_heights

#: Seconds without a report of any source that separate two sessions (chosen): a source that is slow reports more often.
PAUSE_S = 1800.0
#: A sensor aboard is placed anew at most so often, if its stamps are late by more than SURE standard errors, and the
#: log evidence of the biases grows by EVIDENCE (chosen).
PLACINGS, SURE, EVIDENCE = 3, 2.0, 3.0
#: Probability that of two objects in one resolution cell the echo is of that which only the radar shows: ships with
#: AIS are mostly the larger ones (chosen).
HIDDEN = 0.2

__all__ = ["POSITION", "POSITION_AND_VELOCITY", "Feed", "Instant", "Scene"]


@in_short
@dataclass(frozen=True)
class Scene:
    """Feeds of all sources in one plane. :meth:`Scene.of` makes it; :meth:`at` gives the records at an instant.

    height_model : conversion of all heights to one kind; estimated from the reports if None.
    shared_error_m : 1σ per axis of the error common to all sources, such as the near side of a hull.
    estimated : printable sentences on estimated errors.
    given : the sources of which it was made, before sensors aboard vessels were placed.
    antennas : by source of AIS and track, the distance by which its positions were moved ahead, metres.
    partners : by radar that measures no heights, the aircraft of other sources that its tracks keep to.
    """

    feeds: tuple[Feed, ...]
    plane: LocalPlane | None = None
    height_model: HeightModel | None = None
    shared_error_m: float = 0.0
    estimated: tuple[str, ...] = ()
    given: tuple[tuple[Description, Reports], ...] = field(default=(), repr=False)
    antennas: Mapping[str, Mapping[str, float]] = field(default_factory=dict, repr=False)
    partners: Mapping[str, Partners] = field(default_factory=dict, repr=False)

    @classmethod
    def of(
        cls,
        sources: Sequence[tuple[Description, Reports]],
        plane: LocalPlane | None = None,
        *,
        set_aside: dict[str, InputError] | None = None,
    ) -> Scene:
        """A scene of descriptions and their reports, in the given plane or in one about the middle of the positions.

        No plane is needed if all sources give metres in one plane of the user's own. Reports with ids are filtered to
        tracks first if they are unfiltered measurements (:func:`sameas.tracks.feed.need_filtering`).

        set_aside : receives the errors of sources that cannot be placed, such as a radar without a site, by name, if
            others can. Without it, and if no source can be placed, the first error is raised.
        """
        names = [description.name for description, _ in sources]
        if len(set(names)) < len(names):
            raise InputError(f"two sources are called {max(names, key=names.count)}; give every source its own name")
        notes: dict[str, tuple[str, ...]] = {}
        given = tuple(sources)
        sources = _with_platforms(sources, set_aside, notes)
        far = too_far_apart(sources)
        if set_aside is None and far:
            raise InputError("; ".join(far.values()))
        if set_aside is not None:
            far |= of_other_days(sources)
            set_aside |= {name: InputError(words) for name, words in far.items()}
        sources, partners = with_target_heights([source for source in sources if source[0].name not in far])
        if plane is None and (middle := _middle(sources)) is not None:
            plane = LocalPlane.about(*middle)
        feeds: list[Feed] = []
        for description, reports in sources:
            placed = PlacedReports(of_their_objects(description, reports), reports, plane)
            try:
                feed = Feed.of_placed(placed, to_tracks=need_filtering(placed))
                if set_aside is not None:
                    feed.require_numbers()
            except InputError as error:
                if set_aside is None:
                    raise
                set_aside[description.name] = error
            else:
                feeds.append(replace(feed, notes=(*feed.notes, *notes.get(description.name, ()))))
        if set_aside and not feeds:
            raise next(iter(set_aside.values()))
        if len(feeds) == 1:
            feeds = [_by_running_fixes(feeds[0], plane)]
        scatter = tuple(feed.random.line(feed.description.name) for feed in feeds if feed.random.overstated)
        return cls(tuple(feeds), plane, estimated=scatter, given=given, partners=partners)

    @property
    def span_s(self) -> tuple[float, float]:
        """The first and the last time of any report."""
        times = [feed.reports.time_s for feed in self.feeds if len(feed.reports)]
        if not times:
            raise InputError("no source of the scene has a report")
        return float(min(t.min() for t in times)), float(max(t.max() for t in times))

    @property
    def sessions_s(self) -> list[tuple[float, float]]:
        """The spans with reports, which pauses of all sources longer than :data:`PAUSE_S` separate."""
        first_s, last_s = self.span_s
        times = np.unique(np.concatenate([feed.reports.time_s for feed in self.feeds]))
        pauses = np.flatnonzero(np.diff(times) > PAUSE_S)
        begins, ends = [first_s, *times[pauses + 1].tolist()], [*times[pauses].tolist(), last_s]
        return list(zip(begins, ends, strict=True))

    def registered(self, references: Sequence[str] | None = None) -> tuple[Scene, tuple[SourceBiases, ...]]:
        """The scene without the biases of its sources, and the biases of each, in their order.

        Positions of AIS are moved from the antennas to the middles of the ships, where another source shows them.

        Every source is compared, at many instants of the whole span, with those that have no bias (satellite positions:
        AIS, ADS-B); if there are none, the sources are compared with each other. The uncertainty of the removed biases
        is added to the covariances. ``bias`` in the descriptions is the prior of biases; the known ones,
        ``calibration``, are already removed.

        A sensor aboard a vessel whose stamps are late measured from where she was and headed before: it is placed anew,
        and registered again, as long as that explains the records better.

        references : names of the sources assumed to have no bias, if not given by their descriptions.
        """
        scene, late_s = self, dict.fromkeys((feed.description.name for feed in self.feeds), 0.0)
        feeds, biases = registered(self.feeds, references, self._plot_fits)
        for _ in range(PLACINGS):
            more_s = {one.source: one.parameters["time_s"].value for one in biases if scene._is_placed_late(one)}
            if not more_s:
                break
            placed = scene._placed_earlier(more_s)
            found = registered(placed.feeds, references, placed._plot_fits)
            if sum(one.log_evidence for one in found[1]) < sum(one.log_evidence for one in biases) + EVIDENCE:
                break
            scene, (feeds, biases) = placed, found
            late_s |= {name: late_s[name] + value for name, value in more_s.items()}
        of_plots = tuple(feed.plot_statistics for feed in feeds if feed.clutter_per_m2 is not None)
        antennas = antenna_offsets(feeds)
        feeds = tuple(with_antennas(feed, antennas.get(feed.description.name, {})) for feed in feeds)
        estimated = (*self.estimated, *of_plots, *antenna_lines(antennas))
        scene = replace(scene, feeds=feeds, estimated=estimated, antennas=antennas)
        return scene, tuple(one.later(late_s[one.source]) for one in biases)

    def _is_placed_late(self, biases: SourceBiases) -> bool:
        """Whether a sensor was placed by the positions of its vessel, and has stamps that are surely late or early."""
        late = biases.parameters.get("time_s")
        if not biases.established or late is None or abs(late.value) < SURE * late.standard_error:
            return False
        [raw] = [feed.raw_reports for feed in self.feeds if feed.description.name == biases.source]
        given = [reports for description, reports in self.given if description.name == biases.source]
        is_placed = raw is not None and raw.station_lat_deg is not None
        return is_placed and any(one.station_lat_deg is None or one.relative_bearing_deg is not None for one in given)

    def _placed_earlier(self, late_s: Mapping[str, float]) -> Scene:
        """The scene with the stamps of some sources known to be later than given, by these seconds."""
        sources = []
        for description, reports in self.given:
            latency_s = (description.timing.latency_s or 0.0) + late_s.get(description.name, 0.0)
            timing = replace(description.timing, latency_s=latency_s)
            sources.append(
                (replace(description, timing=timing) if description.name in late_s else description, reports)
            )
        return Scene.of(sources, self.plane, set_aside={})

    def with_fitted_errors(self) -> tuple[Scene, TrackErrorFit]:
        """The scene with errors, clutter and latencies estimated from its bare plots, and the fit.

        Values given by the user are kept; see :mod:`sameas.tracks.error_fit`. To be called before :meth:`registered`.
        """
        fit = fit_errors(self.feeds, self.plane)
        lines = tuple(fit.lines())
        return replace(self, feeds=fit.feeds, shared_error_m=fit.shared_m, estimated=lines, given=()), fit

    def doubts(self) -> tuple[str, ...]:
        """Suspected errors of whole sources, one sentence each with its remedy; empty if there are none.

        Such as wrong signs, exchanged columns, kilometres, miles, feet or radians instead of metres and degrees, a
        clock in another zone, or nothing in common with the other sources. Nothing is changed. A source with such an
        error takes seconds.
        """
        return tuple(doubt.sentence for doubt in self._doubts)

    @property
    def misread(self) -> frozenset[str]:
        """Names of the sources of which a doubt says that they have wrong positions, since they match others if their
        reports are read in another way; of both where it cannot tell which of two."""
        return frozenset().union(*(doubt.misread for doubt in self._doubts))

    @cached_property
    def _doubts(self) -> tuple[Doubt, ...]:
        return doubts(self.feeds, self.plane, self._plot_fits)

    @cached_property
    def _plot_fits(self) -> PlotFits:
        return PlotFits()

    @property
    def notes(self) -> tuple[str, ...]:
        """What was excluded when the scene was made, printable sentences."""
        return tuple(note for feed in self.feeds for note in feed.notes)

    @cached_property
    def heights(self) -> tuple[HeightReports | None, ...]:
        """Heights of the reports of each source, all of one kind; None for a source without any."""
        return heights_of(self.feeds, self.height_model)

    def at(self, instant_s: float, *, features: int = POSITION) -> Instant:
        """The records of every source at an instant: its last reports at or before it, moved to it by their velocities.

        features : POSITION, or POSITION_AND_VELOCITY, of which sources without velocities observe a part.
        """
        if features not in (POSITION, POSITION_AND_VELOCITY):
            raise InputError(f"Scene: features is {features}; give 2 (positions) or 4 (positions and velocities)")
        snapshots = [Snapshot.of(feed, instant_s) for feed in self.feeds]
        surroundings = _Surroundings.of(snapshots, features)
        snapshots = [one.without_aged(surroundings.per_m2) for one in snapshots]
        places = np.concatenate([np.empty((0, 2)), *(one.state[:, :2] for one in snapshots if one.state.ndim == 2)])
        heights = tuple(
            None if known is None else known.at(one.feed.reports.rows[one.rows], instant_s - one.time_s)
            for known, one in zip(self.heights, snapshots, strict=True)
        )
        return Instant(
            instant_s=instant_s, features=features, feeds=tuple(self.feeds),
            sources=tuple(one.source(instant_s, features, places) for one in snapshots),
            age_s=tuple(instant_s - one.time_s for one in snapshots), aged=tuple(one.aged for one in snapshots),
            heights=heights, region=surroundings.region, density=surroundings.density,
            shared_error_m=self.shared_error_m,
        )  # fmt: skip


@in_short
@dataclass(frozen=True)
class Instant:
    """All sources at one instant.

    Attributes
    ----------
    sources : for :func:`sameas.identify_many`, in the scene's order; the ids of their records are rows of the
        source's reports.
    age_s : per source (n,) age of each record's report.
    aged : per source the rows of reports excluded as too uncertain to distinguish objects.
    heights : per source (n, 4) heights of the records and their 1σ, metres, vertical speeds and their 1σ, m/s, NaN if
        unknown; None if no report of the source has either.
    region : of the objects; needed by ``identify_many`` if a source observes a part of the state.
    density : objects per m² at the middle of the region (per m² and (m/s)² with velocities as features).
    shared_error_m : of the scene; not included in the covariances.
    """

    instant_s: float
    features: int
    feeds: tuple[Feed, ...]
    sources: tuple[Source, ...]
    age_s: tuple[FloatArray, ...]
    aged: tuple[IntArray, ...]
    heights: tuple[FloatArray | None, ...]
    region: Region
    density: float
    shared_error_m: float = 0.0

    @property
    def descriptions(self) -> tuple[Description, ...]:
        """Descriptions of the sources, in their order."""
        return tuple(feed.description for feed in self.feeds)

    @property
    def assumed(self) -> tuple[Assumption, ...]:
        """All assumed values of the descriptions."""
        return tuple(line for description in self.descriptions for line in description.assumed)

    def with_records(self) -> Instant:
        """The instant without the sources that have no records; ``identify_many`` needs two with records."""
        keep = [k for k, source in enumerate(self.sources) if len(records_of(source))]
        chosen = {
            name: tuple(getattr(self, name)[k] for k in keep)
            for name in ("feeds", "sources", "age_s", "aged", "heights")
        }
        return replace(self, **chosen)  # type: ignore[arg-type]

    def identity(self) -> Identity:
        """The rule of the records' identity attributes, to be added to a rule of positions."""
        columns = {}
        for feed, source in zip(self.feeds, self.sources, strict=True):
            rows = records_of(source).ids
            columns[feed.description.name] = {name: column[rows] for name, column in feed.attributes.items()}
        return Identity(columns)

    def height(self) -> Heights:
        """The rule of the records' heights and vertical speeds, to be added to a rule of positions."""
        pairs = zip(self.feeds, self.heights, strict=True)
        given = {feed.description.name: heights for feed, heights in pairs if heights is not None}
        climbs = {name: heights[:, 2:] for name, heights in given.items() if np.isfinite(heights[:, 2]).any()}
        return Heights({name: heights[:, :2] for name, heights in given.items()}, climbs=climbs)

    def alarms(self) -> list[IdentityConflict]:
        """Identities reported at two places too far apart for one object: forged, duplicate or wrong."""
        return alarms([source for source in self.sources if isinstance(source, Records)], self.identity())

    def rule(self) -> PoissonObjects:
        """The rule of positions for ``identify_many``, with the described misses and clutter.

        The miss probability of a source is the mean over the positions of all records, so it is high for a source that
        covers few of them.
        """
        records = [records_of(source) for source in self.sources]
        clutter = [feed.clutter_at(np.asarray(one.ids), one.d) for feed, one in zip(self.feeds, records, strict=True)]
        return PoissonObjects(self.density, self._q, clutter)

    def resolution(self) -> MergedEchoes:
        """The rule of sensors that show two near objects as one, to be added to a rule of positions."""
        return MergedEchoes(self.feeds, self._q, self.instant_s)

    @cached_property
    def _q(self) -> tuple[float, ...]:
        """Miss probability of each source, the mean over the positions of all records."""
        places = np.concatenate([np.empty((0, 2)), *(record_positions(source) for source in self.sources)])
        return tuple(feed.mean_q(places, self.instant_s) for feed in self.feeds)


@dataclass(frozen=True)
class MergedEchoes(Rule):
    """The evidence against one object that a sensor may show another one in its place: of two in one resolution cell it
    shows one, the stronger. A life raft whose echo hides the lifeboat beside it is not surely the lifeboat.

    It counts for a record of a sensor that merges near objects and one of a source that does not. With q the
    probability that the sensor misses an object, and s that both, if they are two, are in one resolution cell, it
    misses that of the other record with probability q′ = q + (1 − q) s h, h = :data:`HIDDEN`, so ln r = ln q − ln q′.
    Two sensors that merge objects both show the stronger one.

    feeds : (S,) of the instant. q : (S,) of each. instant_s : the instant.
    """

    feeds: Sequence[Feed] = field(repr=False)
    q: Sequence[float]
    instant_s: float

    def __call__(self, pairs: Pairs) -> Evidence:
        sources, out = {pairs.first.source, pairs.second.source}, np.zeros(len(pairs))
        known = zip(self.feeds, self.q, strict=True)
        merging = [(feed, q) for feed, q in known if feed.description.name in sources and feed.merges]
        if len(merging) == 1 and min(pairs.first.d, pairs.second.d) > 1:
            [(feed, q)] = merging
            one, other = _positions(pairs.first, pairs.i), _positions(pairs.second, pairs.j)
            out -= np.log1p((1.0 / q - 1.0) * HIDDEN * feed.p_unresolved(self.instant_s, one, other))
        return Evidence({"resolution": out})


def _positions(side: Records, rows: AnyIntArray) -> tuple[FloatArray, FloatArray]:
    """(m, 2) positions of records, (m, 2, 2) their covariances."""
    return taken(side.features, rows)[:, :2], taken(side.full_covariance(), rows)[:, :2, :2]


@dataclass(frozen=True)
class _Surroundings:
    """Region and density of the objects at an instant, from the positions of all sources.

    density : per unit of the features. per_m2 : per m².
    """

    region: Region
    density: float
    per_m2: float

    @classmethod
    def of(cls, snapshots: Sequence[Snapshot], features: int) -> _Surroundings:
        states = [one.state for one in snapshots if isinstance(one.feed.reports, States) and len(one.rows)]
        reach = max((one.feed.description.coverage.range_m or 0.0 for one in snapshots), default=0.0)
        if states:
            places = np.concatenate(states)[:, :2]
            centre, spread = places.mean(axis=0), np.zeros((2, 2))
            if len(places) > 2:
                from_centre = places - centre
                spread = tall_product(from_centre, from_centre) * (1.0 / (len(places) - 1))
            # Two positions or one do not show how far objects are from what has only their directions, and what a
            # direction finder receives need not be among the positions.
            far = [one.sensor() for one in snapshots if isinstance(one.feed.reports, Directions)
                   and (len(places) < 3 or one.feed.description.kind == "esm")]  # fmt: skip
            if far:
                farthest = np.max(np.sum((np.vstack([places, far]) - centre) ** 2, axis=1))
                spread = spread + farthest * np.eye(2)
            narrow = max(float(np.trace(spread)) / 20.0, (min(reach, 1000.0) or 1000.0) ** 2 / 16.0)
            spread = spread + narrow * np.eye(2)
        else:
            sensors = np.array([one.sensor() for one in snapshots])
            apart_m = float(pdist(sensors).max(initial=0.0))
            half = 0.5 * (reach or 1000.0)
            centre, spread = sensors.mean(axis=0), np.eye(2) * (min(half, 2.0 * apart_m) or half) ** 2
        area = 2.0 * math.pi * math.sqrt(float(np.linalg.det(spread)))
        density = _objects(snapshots, area) / area
        if features == POSITION:
            return cls(Region(centre, spread), density, density)
        speed = max(one.feed.description.motion.speed_m_per_s or 1.0 for one in snapshots)
        whole = np.diag(np.full(4, speed**2))
        whole[:2, :2] = spread
        return cls(Region(np.concatenate([centre, [0.0, 0.0]]), whole), density / (2.0 * math.pi * speed**2), density)


def _by_running_fixes(feed: Feed, plane: LocalPlane | None) -> Feed:
    """The feed; of a moving direction finder, that of the places of its emitters."""
    raw, reports = feed.raw_reports, feed.reports
    if raw is None or not isinstance(reports, Directions) or feed.description.kind != "esm":
        return feed
    if not len(reports) or not moves(reports.sensor_m):
        return feed
    fixes, notes = running_fixes(feed.description, reports, raw, plane)
    if fixes is not None:
        feed = Feed.of_placed(PlacedReports(*fixes, plane), to_tracks=False)
    return replace(feed, notes=(*feed.notes, *notes))


def _with_platforms(
    sources: Sequence[tuple[Description, Reports]], set_aside: dict[str, InputError] | None,
    notes: dict[str, tuple[str, ...]],
) -> list[tuple[Description, Reports]]:  # fmt: skip
    """The sources with the positions of sensors aboard vessels; those whose vessel is not known are set aside.

    notes : receives the notes on each source.
    """
    descriptions = [description for description, _ in sources]
    given, out = {description.name: [reports] for description, reports in sources}, []
    for description, reports in sources:
        if only_carries(description.name, reports, descriptions):
            continue
        try:
            placed, notes[description.name] = on_platform(description, reports, given)
        except InputError as error:
            if set_aside is None:
                raise
            set_aside[description.name] = error
        else:
            out.append((description, placed))
    if sources and not out and not set_aside:
        names = ", ".join(description.name for description in descriptions)
        raise InputError(f"{names}: only the positions of own ship", "give the file of an AIS receiver or a radar, too")
    return out


def _objects(snapshots: Sequence[Snapshot], area_m2: float) -> float:
    """Number of objects, by the source with the most: (its records − its clutter) / (1 − q)."""
    most = 1.0
    of_directions = not any(isinstance(one.feed.reports, States) for one in snapshots)
    for one in snapshots:
        description = one.feed.description
        if isinstance(one.feed.reports, States):
            clutter = (description.clutter.per_km2 or 0.0) * area_m2 / 1e6
        elif of_directions:
            clutter = min(360.0 * (description.clutter.per_deg or 0.0), 0.5 * len(one.rows))
        else:
            continue
        q = float(np.mean(description.misses.at(np.zeros(1)))) if description.misses.q is not None else 0.5
        most = max(most, (len(one.rows) - clutter) / (1.0 - q))
    return most


def record_positions(source: Source) -> FloatArray:
    """(n, 2) the positions of a source's records; none for directions."""
    records = records_of(source)
    return records.features[:, :2] if records.d > 1 else np.empty((0, 2))


def _middle(sources: Sequence[tuple[Description, Reports]]) -> tuple[NDArray[Any], NDArray[Any]] | None:
    """Latitudes and longitudes of all positions, or else of the sensors; None if neither are given in degrees."""
    pairs = [(r.lat_deg, r.lon_deg) for _, r in sources if r.lat_deg is not None]
    pairs = pairs or [(r.station_lat_deg, r.station_lon_deg) for _, r in sources if r.station_lat_deg is not None]
    if not pairs and not any(r.x_m is not None for _, r in sources):
        sites = [one.site for one, _ in sources if one.site is not None and one.site.lat_deg is not None]
        pairs = [(np.array([site.lat_deg]), np.array([site.lon_deg])) for site in sites]
    if not pairs:
        return None
    lat, lon = (np.concatenate([np.asarray(column) for column in side]) for side in zip(*pairs, strict=True))
    return lat, lon

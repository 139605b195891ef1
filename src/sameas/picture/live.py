"""The live picture: reports are added as they arrive, and instants computed as time advances.

    picture = LivePicture([radar_description, ais_description], plane=LocalPlane(50.7, -1.1))
    picture.add("radar", reports)
    state = picture.advance(now_s)

On the same reports, none later than its lag, it gives the same objects as :class:`~sameas.picture.picture.Picture`
gives from whole files. :meth:`LivePicture.register` estimates the biases of sources from the reports of the last
minutes and subtracts them at all later instants; :meth:`LivePicture.faults` gives deceptions and faults of sources.

It can be pickled and continues from there, so a program that is killed keeps the numbers of its objects.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from sameas.arrays import FloatArray
from sameas.errors import InputError
from sameas.picture.deception import faults_and_deceptions, sightings_of
from sameas.picture.picture import error_lines, object_columns, record_columns, with_degrees
from sameas.picture.picture_state import PictureState
from sameas.picture.plot_picture import PlotPicture
from sameas.picture.rows import Columns, gathered
from sameas.picture.tuning import DEFAULT_TUNING, Tuning
from sameas.picture.watch import Watch
from sameas.tracks.antennas import with_antennas
from sameas.tracks.biases import AZIMUTH, BIASES, EAST, GAIN, RANGE, TIME
from sameas.tracks.coordinates import LocalPlane
from sameas.tracks.faults import Fault
from sameas.tracks.feed import Feed
from sameas.tracks.heights import HeightModel
from sameas.tracks.kinds import KINDS
from sameas.tracks.live_feed import LiveFeed, ReportCounts, unbiased_now
from sameas.tracks.platforms import on_platform, only_carries
from sameas.tracks.random_errors import RandomErrors
from sameas.tracks.registration import SourceBiases, with_delay_prior
from sameas.tracks.reports import Reports, joined
from sameas.tracks.scene import Scene
from sameas.tracks.source import Assumption, Description, Site
from sameas.tracks.target_heights import PartnerHeights, Partners

LiveState = PictureState[Watch] | PictureState[PlotPicture]


#: Reports that are further from the present than this multiple of the window are of a wrong date.
STRAY_SPANS = 6.0
#: Changes of biases, in the order and the units of ``BIASES``, by which the positions of a source are others (chosen):
#: some 30 m at 10 km.
DISPLACED = np.array([30.0, 0.2, 0.003, 2.0, 30.0, 30.0])


@dataclass(frozen=True)
class Window:
    """The reports used for biases and faults: of the last ``span_s`` seconds, at most ``reports`` per source.

    sightings_s : seconds between the instants whose records are kept to find deception.
    """

    span_s: float = 600.0
    reports: int = 50_000
    sightings_s: float = 10.0


class LivePicture:
    """A picture from reports that arrive one after another.

    Parameters
    ----------
    descriptions : of all sources.
    plane : of the picture. None: about the first site or position on the earth, else the user's own metres.
    watch : the initial state: evidence, memory and stages. None: a :class:`PlotPicture` while no source has ids, else a
        :class:`Watch`.
    lag_s : reports late by at most this are inserted by their time.
    window : for :meth:`register` and :meth:`faults`.

    Example
    -------
    >>> from sameas.tracks.source import SensorErrors
    >>> tracker = Description("radar", "tracks", errors=SensorErrors(position_m=5.0))
    >>> picture = LivePicture([tracker, Description("ais", "ais")])
    >>> for t in (0.0, 10.0):
    ...     place = {"time_s": [t], "x_m": [5.0 * t], "y_m": [0.0]}
    ...     picture.add("radar", Reports.of("radar", "table", place | {"track_id": ["7"]}))
    ...     picture.add("ais", Reports.of("ais", "ais", place | {"mmsi": ["235000001"]}))
    ...     state = picture.advance(t)
    >>> state.objects.number.tolist(), (state.members >= 0).sum(axis=1).tolist()
    ([1], [2])
    >>> picture.objects["object"].tolist(), picture.objects["x_m"].round().tolist(), picture.objects["members"].tolist()
    ([1], [50.0], ['radar:1 ais:1'])
    """

    def __init__(
        self,
        descriptions: Sequence[Description],
        *,
        plane: LocalPlane | None = None,
        watch: Watch | PlotPicture | None = None,
        lag_s: float = 10.0,
        window: Window | None = None,
    ) -> None:
        names = [description.name for description in descriptions]
        if not names or len(set(names)) < len(names):
            raise InputError("live picture: give one description or more, each with its own name")
        sites = [site for d in descriptions if (site := d.site) is not None]
        places = [(s.lat_deg, s.lon_deg) for s in sites if s.lat_deg is not None and s.lon_deg is not None]
        self.plane = plane or (LocalPlane(*places[0]) if places else None)
        self.lag_s = _lag(lag_s)
        self.window = window or Window()
        self._feeds = {d.name: LiveFeed(d, self.plane, lag_s) for d in descriptions}
        self._carried: Watch | PlotPicture | None = watch
        self._biases: dict[str, SourceBiases] = {}
        self._subtracted: dict[str, FloatArray] = {}
        self._estimates: dict[str, SourceBiases] = {}
        #: By source of AIS and track, the distance from the antenna ahead to the middle of the ship; whether any, or
        #: the height of a target, has changed by as much as displaces positions since that was last asked.
        self._antennas: dict[str, dict[str, float]] = {}
        self._moved = False
        self._held: frozenset[str] = frozenset()
        self._given_misread = watch.misread if isinstance(watch, Watch) else frozenset()
        self._doubts, self._misread = tuple[str, ...](), frozenset[str]()
        self._misread_s = -math.inf
        #: Seconds for which an object that names itself keeps its number while it is away; None: as the watch says.
        self.return_s: float | None = None
        self._heights: HeightModel | None = None
        #: Conversion of the heights of the last instant; None if none was reported.
        self.height_model: HeightModel | None = None
        #: Heights of targets of radars without heights.
        self._partner_heights = PartnerHeights()
        self._recent: dict[str, deque[Reports]] = {name: deque() for name in names}
        #: Their numbers, which are counted up and down: to add up 600 lengths takes as long as a batch.
        self._n_recent = dict.fromkeys(names, 0)
        self._sightings: deque[Columns] = deque()
        self._last_s = -math.inf
        self._state: LiveState | None = None

    def __getstate__(self) -> dict[str, Any]:
        """The state without the reports of the last minutes and the last instant; estimated biases stay."""
        recent: dict[str, deque[Reports]] = {name: deque() for name in self._recent}
        forgotten = {"_recent": recent, "_n_recent": dict.fromkeys(recent, 0), "_sightings": deque(), "_state": None}
        return self.__dict__ | forgotten

    @property
    def descriptions(self) -> tuple[Description, ...]:
        """The descriptions of the sources, in their order."""
        return tuple(feed.description for feed in self._feeds.values())

    @property
    def instant_s(self) -> float:
        """The latest instant; −∞ before the first."""
        return self._last_s

    @property
    def picture_tuning(self) -> Tuning:
        """The tuning of the picture."""
        return DEFAULT_TUNING if self._carried is None else self._carried.tuning

    @property
    def counts(self) -> Mapping[str, ReportCounts]:
        """By source, the counts of its reports."""
        return {name: feed.counts for name, feed in self._feeds.items()}

    @property
    def objects(self) -> Columns:
        """The objects of the last instant as columns, as of ``Picture.objects``; empty before the first."""
        return {} if self._state is None else with_degrees(object_columns(self._state), self.plane)

    @property
    def records(self) -> Columns:
        """The records of the last instant as columns, as of ``Picture.records``; empty before the first."""
        return {} if self._state is None else with_degrees(record_columns(self._state), self.plane)

    @property
    def biases(self) -> Mapping[str, SourceBiases]:
        """By source, the biases that are subtracted."""
        return {name: biases for name, biases in self._biases.items() if biases.established}

    @property
    def estimates(self) -> Mapping[str, SourceBiases]:
        """By source, the biases that are subtracted, else those last estimated."""
        return self._estimates | dict(self.biases)

    @property
    def last_estimates(self) -> Mapping[str, SourceBiases]:
        """By source, the biases last estimated, whether subtracted or not."""
        return dict(self._estimates)

    @property
    def held(self) -> frozenset[str]:
        """The sources whose biases stay as they are."""
        return self._held

    def hold(self, source: str, held: bool = True) -> None:
        """Keeps the biases that are subtracted from a source, or none, as they are; ``held=False`` releases them.

        Raises
        ------
        InputError : an unknown source.
        """
        self._require(source)
        self._held = self._held | {source} if held else self._held - {source}
        if not held and source in self._biases and self._biases[source].by_hand:
            # What an operator has set ends with the hold; the last estimate counts again.
            last = self._estimates.get(source)
            if last is not None and last.established and last.theta is not None:
                self._biases[source] = last
            else:
                del self._biases[source]

    def set_offset(self, source: str, bias: str, value: float) -> None:
        """Subtracts an offset of a source as an operator sets it, besides those subtracted now, and holds them.

        bias : a name of ``sameas.tracks.biases.BIASES``. value : in its unit. It adds to what the description gives as
        known (``calibration``). ``hold(source, False)`` ends it.

        Raises
        ------
        InputError : an unknown source or bias; a value that no sensor has; a range or azimuth of a source without both.
        """
        self._require(source)
        if bias not in self.settable(source):
            known = ", ".join(self.settable(source)) or "none"
            raise InputError(f"{source}: has no offset {bias!r} to set", f"give one of {known}")
        self._biases[source] = self._biases.get(source, SourceBiases(source)).with_set(bias, value)
        self._held |= {source}

    def settable(self, source: str) -> tuple[str, ...]:
        """The biases of a source that :meth:`set_offset` accepts."""
        self._require(source)
        description = self._feeds[source].description
        if KINDS[description.kind].directions:
            return (BIASES[AZIMUTH],)
        feed = self._feeds[source]
        # Before the first report the place of a sensor that moves is not known yet.
        polar = description.site is not None or feed.has_sensor or not feed.has_reports
        return tuple(bias for bias in BIASES if polar or bias not in (BIASES[RANGE], BIASES[AZIMUTH], BIASES[GAIN]))

    @property
    def errors(self) -> tuple[str, ...]:
        """Printable lines on sources whose errors, as estimated by the picture, are not as stated."""
        return tuple(error_lines(self._carried)) if self._carried is not None else ()

    @property
    def doubts(self) -> tuple[str, ...]:
        """Suspected errors of whole sources in the last minutes, as of ``Scene.doubts``, from :meth:`register`."""
        return self._doubts

    def describe(self, descriptions: Sequence[Description], lag_s: float | None = None) -> tuple[str, ...]:
        """Goes on with these sources, and gives the names of those that are new or were described differently before.

        lag_s : the lag from now on; as before if not given.

        Objects keep their numbers. The biases of a source that is described differently are estimated anew. Sources
        that are not given any more stay, and get no more reports.

        Raises
        ------
        InputError : the sources give plots without ids, and others are given now.
        """
        changed, before = [], set(self._feeds)
        lag_s = self.lag_s if lag_s is None else _lag(lag_s)
        if isinstance(self._carried, PlotPicture) and {description.name for description in descriptions} != before:
            raise InputError(
                f"the picture of plots without ids of {', '.join(sorted(before))} cannot go on with other sources",
                "begin a new one; where it is a watch's, move its folder away",
            )
        self.lag_s = lag_s
        for known in self._feeds.values():
            known.lag_s = lag_s
        for description in descriptions:
            feed = self._feeds.get(description.name)
            if feed is not None and feed.given == description:
                continue
            changed.append(description.name)
            if feed is not None and KINDS[feed.given.kind].directions == KINDS[description.kind].directions:
                feed.describe(description)
            else:
                self._feeds[description.name] = LiveFeed(description, self.plane, self.lag_s)
                self._recent[description.name], self._n_recent[description.name] = deque(), 0
            self._biases.pop(description.name, None)
            self._antennas.pop(description.name, None)
            self._estimates.pop(description.name, None)
            self._held -= {description.name}
        if changed and isinstance(self._carried, Watch):
            self._carried = self._carried.displaced()
        if self._misread & set(changed):
            self._doubts, self._misread, self._misread_s = (), frozenset(), -math.inf
        return tuple(changed)

    def add(self, source: str, reports: Reports) -> None:
        """Adds reports of a source, of any time within the lag.

        Raises
        ------
        InputError : an unknown source; a number is missing that the reports need. Then nothing is added.
        """
        self._require(source)
        if not len(reports):
            return
        feed = self._feeds[source]
        given = len(reports)
        if reports.site is not None:
            self._place(feed, Site(*reports.site))
        reports, _ = on_platform(feed.given, reports, self._recent)
        places = (reports.lat_deg, reports.lon_deg)
        if places[0] is None:
            places = (reports.station_lat_deg, reports.station_lon_deg)
        if self.plane is None and places[0] is not None and places[1] is not None:
            if any(other.has_reports for other in self._feeds.values()):
                raise InputError(
                    f"{source}: gives latitudes and longitudes, others metres of their own", "give the plane"
                )
            somewhere = (places[0] != 0.0) | (places[1] != 0.0)
            if not somewhere.any():
                # As of a receiver that has no position yet: a plane about it would have no place for any other.
                raise InputError(f"{source}: its latitudes and longitudes are 0, and no other position is known yet")
            self._begin_plane(LocalPlane.about(places[0][somewhere], places[1][somewhere]))
        if only_carries(source, reports, [one.given for one in self._feeds.values()]):
            feed.counts.taken += given
            feed.counts.newest_s = max(feed.counts.newest_s, float(reports.time_s.max()))
        else:
            feed.add(self._with_partner_heights(source, reports))
            feed.counts.unplaced += given - len(reports)
        self._keep_recent(source, reports)

    def _place(self, feed: LiveFeed, site: Site) -> None:
        """Places a sensor where its own messages say it is, and begins a plane there if there is none."""
        feed.place(site)
        if self.plane is None and not any(one.has_reports for one in self._feeds.values()):
            self._begin_plane(LocalPlane(site.lat_deg or 0.0, site.lon_deg or 0.0))

    def _begin_plane(self, plane: LocalPlane) -> None:
        self.plane = plane
        for feed in self._feeds.values():
            feed.plane = plane

    def _with_partner_heights(self, source: str, reports: Reports) -> Reports:
        """The reports of a radar with the last heights of the aircraft that its tracks keep to."""
        self._partner_heights.take(source, reports)
        reports, elsewhere = self._partner_heights.applied(self._feeds[source].description, reports)
        self._moved |= elsewhere
        return reports

    def _require(self, source: str) -> None:
        if source not in self._feeds:
            raise InputError(f"live picture: there is no source {source!r}", f"give one of {', '.join(self._feeds)}")

    def _keep_recent(self, source: str, reports: Reports) -> None:
        """Keeps reports for the searches in the last minutes; those of a wrong date would stretch these to days."""
        recent, newest_s = self._recent[source], self._feeds[source].counts.newest_s
        if math.isfinite(self._last_s):
            newest_s = min(newest_s, self._last_s)
            near = np.abs(reports.time_s - self._last_s) <= STRAY_SPANS * self.window.span_s
            reports = reports if near.all() else reports.where(near)
        if len(reports):
            recent.append(reports)
        n = self._n_recent[source] + len(reports)
        while len(recent) > 1 and (
            n > self.window.reports or float(recent[0].time_s.max()) < newest_s - self.window.span_s
        ):
            n -= len(recent.popleft())
        self._n_recent[source] = n

    def advance(self, instant_s: float) -> LiveState:
        """The picture at an instant not before the previous one.

        Raises
        ------
        InputError : the instant is before the previous one.
        """
        if not instant_s >= self._last_s:
            raise InputError(
                f"the picture is at {self._last_s:g} s and was asked for {instant_s:g} s; give instants in the order "
                "of time"
            )
        feeds = tuple(self._feed(feed, instant_s) for feed in self._feeds.values())
        self.height_model = self._heights or HeightModel.as_given(feeds)
        scene = Scene(feeds, self.plane, self.height_model)
        carried = self._start() if self._carried is None else self._named(self._carried)
        misread = self._given_misread | self._misread
        if isinstance(carried, Watch) and carried.misread != misread and self._state is not None:
            carried = carried.doubting(misread, self._state.members)
        if isinstance(carried, Watch) and self._are_displaced():
            carried = carried.displaced()
        if isinstance(carried, Watch) and self.return_s not in (None, carried.tuning.return_s):
            carried = replace(carried, tuning=replace(carried.tuning, return_s=self.return_s))
        state: LiveState = carried.at(scene, instant_s)
        self._carried, self._last_s, self._state = state.watch, instant_s, state
        for feed in self._feeds.values():
            feed.release()
        self._keep_sightings(state)
        return state

    def register(self) -> tuple[SourceBiases, ...]:
        """Estimates the biases of the sources from the reports of the last minutes, and subtracts the established ones.

        It takes as long as for a file of these minutes. To estimate in another process, use :meth:`recent`,
        :func:`estimated` and :meth:`take_off`.
        """
        registered = estimated(self.recent(), self.plane)
        self.take_off(registered)
        return registered.biases

    def recent(self) -> list[tuple[Description, Reports]]:
        """The sources that have reports in the last minutes, with these reports.

        The delay of a source's stamps, once established, is estimated again in every window, also where the reports of
        one window would not establish it.
        """
        return [(self._described(name), joined(list(recent))) for name, recent in self._recent.items() if recent]

    def _described(self, source: str) -> Description:
        description, biases = self._feeds[source].description, self._biases.get(source)
        if biases is None or "time_s" not in biases.parameters or description.bias.time_s is not None:
            return description
        return with_delay_prior(description)

    def faults(self) -> tuple[Fault, ...]:
        """The deceptions and faults of sources in the last minutes, each with its evidence and probability.

        It takes as long as for a file of these minutes. To run it in another process, use :meth:`recent`,
        :meth:`sightings` and :func:`faults_of`.
        """
        return faults_of(self.recent(), self.sightings(), self.plane, self.picture_tuning)

    def sightings(self) -> Columns:
        """The records of instants of the last minutes, for :func:`sameas.picture.deception.deceptions`."""
        return gathered(list(self._sightings))

    def take_off(self, registered: Registered) -> None:
        """Subtracts the established biases at later instants; for other sources, and those held, the previous stay.

        What only sources show that are read wrongly, by a doubt, is not confirmed from then on, until no such doubt has
        come for the span of the window, or one of them is described differently.
        """
        # Reports that raised such a doubt are in the window for as long.
        if registered.misread or self._last_s - self._misread_s > self.window.span_s:
            self._doubts, self._misread = registered.doubts, registered.misread
            self._misread_s = self._last_s if registered.misread else -math.inf
        self._heights = registered.heights or self._heights
        for name, assumed in registered.targets.items():
            if name not in self._held:
                self._feeds[name].assume(assumed)
        for name, random in registered.random.items():
            self._feeds[name].random = random
        self._partner_heights = self._partner_heights.with_partners(registered.partners)
        for name, offsets in registered.antennas.items():
            known = self._antennas.setdefault(name, {})
            changes = [abs(offset_m - known.get(track, 0.0)) for track, offset_m in offsets.items()]
            self._moved |= bool(max(changes) > DISPLACED[EAST])
            known.update(offsets)
        for biases in registered.biases:
            self._estimates[biases.source] = biases
            # What is not established replaces nothing; it may allow for an unknown offset.
            is_first = biases.source not in self._biases
            if biases.theta is not None and (biases.established or is_first) and biases.source not in self._held:
                self._biases[biases.source] = biases

    def _are_displaced(self) -> bool:
        """Whether the biases subtracted from a source, the places of antennas or heights of targets have changed by
        more than :data:`DISPLACED` since they last were found to have."""
        moved, self._moved = self._moved, False
        now = {name: one.theta for name, one in self._biases.items() if one.theta is not None}
        before, none = self._subtracted, np.zeros(len(BIASES))
        change = [np.abs(now.get(name, none) - before.get(name, none)) for name in now.keys() | before.keys()]
        if not any((one > DISPLACED).any() for one in change):
            return moved
        self._subtracted = now
        return True

    def _keep_sightings(self, state: LiveState) -> None:
        kept, now_s = self._sightings, state.now.instant_s
        if not kept or now_s - float(kept[-1]["time_s"][0]) >= self.window.sightings_s:
            columns = sightings_of(state)
            if len(columns["time_s"]):
                kept.append(columns)
        while kept and now_s - float(kept[0]["time_s"][0]) > self.window.span_s:
            kept.popleft()

    def _feed(self, live_feed: LiveFeed, instant_s: float) -> Feed:
        biases = self._biases.get(live_feed.description.name)
        antennas = self._antennas.get(live_feed.description.name, {})
        if biases is None or biases.theta is None or biases.covariance is None:
            return with_antennas(live_feed.feed(instant_s), antennas)
        delay_s = float(biases.theta[TIME])
        feed = live_feed.feed(instant_s, early_s=max(0.0, -delay_s))
        return with_antennas(unbiased_now(feed, biases, live_feed.track_timeout_s(delay_s), instant_s), antennas)

    def _start(self) -> Watch | PlotPicture:
        reporting = [feed for feed in self._feeds.values() if feed.has_reports]
        bare = bool(reporting) and not any(feed.named for feed in reporting)
        return PlotPicture() if bare else Watch()

    def _named(self, carried: Watch | PlotPicture) -> Watch | PlotPicture:
        """The state to continue from: a plot picture is replaced by a watch once a source has ids; numbers continue."""
        if isinstance(carried, Watch) or not any(feed.named for feed in self._feeds.values()):
            return carried
        watch = Watch()
        used = int(np.max(carried.objects.number, initial=0))
        return replace(watch, objects=replace(watch.objects, n_numbers=used))


@dataclass(frozen=True)
class Registered:
    """The biases of the sources from some minutes of reports, and the model of their heights.

    doubts, misread : as of :class:`~sameas.tracks.scene.Scene`. targets : of sources whose heights of targets are
    assumed, the assumptions with which the biases hold. partners, antennas : as of
    :class:`~sameas.tracks.scene.Scene`. random : of their feeds.
    """

    biases: tuple[SourceBiases, ...] = ()
    heights: HeightModel | None = None
    doubts: tuple[str, ...] = ()
    misread: frozenset[str] = frozenset()
    targets: Mapping[str, tuple[Assumption, ...]] = field(default_factory=dict)
    partners: Mapping[str, Partners] = field(default_factory=dict)
    antennas: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    random: Mapping[str, RandomErrors] = field(default_factory=dict)


def estimated(sources: Sequence[tuple[Description, Reports]], plane: LocalPlane | None) -> Registered:
    """The biases of sources and of their heights from some minutes of their reports, and doubts about them; empty for a
    single source."""
    if len(sources) < 2:
        return Registered()
    given = Scene.of(sources, plane)
    doubts, misread = given.doubts(), given.misread
    scene, biases = given.registered()
    of_targets = {
        feed.description.name: tuple(line for line in feed.description.assumed if line.name.startswith("targets."))
        for feed in given.feeds
    }
    targets = {name: lines for name, lines in of_targets.items() if lines}
    random = {feed.description.name: feed.random for feed in given.feeds}
    heights = HeightModel.of(scene.feeds)
    return Registered(biases, heights, doubts, misread, targets, given.partners, scene.antennas, random)


def faults_of(
    sources: Sequence[tuple[Description, Reports]], sightings: Columns, plane: LocalPlane | None, tuning: Tuning
) -> tuple[Fault, ...]:
    """The deceptions and faults in some minutes of the reports of sources and in the records of their picture.

    Raises InputError: the sources have no common plane.
    """
    if not sources:
        return ()
    return faults_and_deceptions(Scene.of(sources, plane).feeds, sightings, tuning)


def _lag(lag_s: float) -> float:
    if not 0.0 <= lag_s < math.inf:
        raise InputError(f"live picture: lag_s is {lag_s}; give seconds, 0 where no report is late")
    return lag_s

"""The feed of a live source: reports are added as they arrive, and old ones dropped.

A :class:`~sameas.tracks.feed.Feed` has all reports of a source; a source that runs for months needs bounded memory.
:class:`LiveFeed` keeps, of each track, the reports of the last ``lag_s`` seconds and the one before them, filters
only new reports, and gives the feed of any instant for a scene. A late report is inserted by its time and its track is
filtered again from the report before it, so within the lag the order of arrival changes nothing. Reports later than
that, or of a time before all that is kept of their track, are counted and ignored.

A report keeps its row as long as it may be current, and no other report takes that row at the next instant. So a plot
without an id can be recognised from instant to instant by its row.

It changes in place, as do its table, its counts and the branches of its ids: the arrays are too large to be copied at
each report.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import BoolArray, FloatArray, IntArray, are_among, numbers_of, ordered_by, places_in, taken
from sameas.evidence.identity import NAMING
from sameas.kernels.tracks import neighbours, outdated
from sameas.kernels.zones import merge_rows
from sameas.tracks.alignment import MIN_INNOVATIONS, NO_TREND, States, Succession, are_unfiltered, follow
from sameas.tracks.biases import TIME
from sameas.tracks.coordinates import LocalPlane
from sameas.tracks.duplicate_ids import MAX_SPEED_SIGMAS, POSITION_SIGMAS, Branches, fastest
from sameas.tracks.feed import (
    AIRCRAFT_SHARE,
    CORRELATED_KINDS,
    STATIONARY_TIMEOUT_S,
    TIMEOUT_QUANTILE,
    Feed,
    at_reported_positions,
    bearings_of,
    calibrated,
    identity_attributes,
    in_motion,
    keep_positions,
    need_filtering,
    of_aircraft,
    repeated,
    stale_positions,
    walk_of,
)
from sameas.tracks.heights import HeightColumns
from sameas.tracks.kinds import KINDS
from sameas.tracks.placement import UNNAMED, Directions, PlacedReports, unnamed
from sameas.tracks.random_errors import AS_STATED, RandomErrors
from sameas.tracks.registration import SourceBiases
from sameas.tracks.report_table import FILTER, HEIGHTS, MODES, ReportTable
from sameas.tracks.reports import PLOTS_OF_RADARS, Reports
from sameas.tracks.scans import scans_of
from sameas.tracks.source import Assumption, Description, Site
from sameas.tracks.stationary import Modes, stationary

#: Plots of a source without ids are kept for PLOTS_S seconds and at least PLOT_PERIODS periods, to estimate the
#: rotation of the antenna.
PLOTS_S, PLOT_PERIODS = 30.0, 12.0
GAPS = 4096  # the track timeout is computed from this many of the last gaps within tracks
SPARE_ROWS = 4.0  # a table with less than this multiple of the rows in use is not made smaller


@dataclass(frozen=True)
class LiveTuning:
    """The chosen numbers of live feeds.

    id_timeout_s : a track without reports is dropped after this time; until then its filter can continue.
    least_rows : a table of at most this many rows is not made smaller.
    """

    id_timeout_s: float = 3600.0
    least_rows: int = 2048


@dataclass
class ReportCounts:
    """Counts of a source's reports. taken : all with a position. unplaced : ignored without one, of their own or of the
    sensor. late : older than the lag. repeated : with the position of an earlier report. jumps : ignored as outliers of
    their ids. newest_s : latest time of a report."""

    taken: int = 0
    unplaced: int = 0
    late: int = 0
    repeated: int = 0
    jumps: int = 0
    newest_s: float = -math.inf


@dataclass
class LiveFeed:
    """The feed of a source whose reports arrive one after another.

    Parameters
    ----------
    description : of the source. plane : of the picture; None for the user's own metres.
    lag_s : reports late by at most this are treated as if on time.
    to_tracks : whether reports with ids are filtered to tracks; None to decide by their kind, and for reports with
        velocities by their scatter, once there are ``MIN_INNOVATIONS`` of them
        (:func:`sameas.tracks.feed.need_filtering`).
    random : what is random of the stated errors, by which the next reports are filtered.

    Example
    -------
    >>> columns = {"x_m": [0.0], "y_m": [0.0], "vx_m_per_s": [5.0], "vy_m_per_s": [0.0], "track_id": ["7"]}
    >>> radar = LiveFeed(Description("radar", "tracks"))
    >>> for t in (0.0, 4.0, 2.0):
    ...     columns["x_m"] = [5.0 * t]
    ...     radar.add(Reports.of("radar", "table", {"time_s": [t], "covariance_m2": [[9.0, 0.0, 9.0]], **columns}))
    >>> feed = radar.feed(5.0)
    >>> feed.reports.time_s[feed.succession.at(5.0)].tolist(), feed.reports.time_s[feed.succession.at(3.0)].tolist()
    ([4.0], [2.0])
    """

    description: Description
    plane: LocalPlane | None = None
    lag_s: float = 10.0
    to_tracks: bool | None = None
    live: LiveTuning = field(default_factory=LiveTuning)
    counts: ReportCounts = field(default_factory=ReportCounts)
    random: RandomErrors = AS_STATED

    def __post_init__(self) -> None:
        self._numbers: dict[str, int] = {}
        self._next_number, self._serial = 0, 0
        self._rows = ReportTable(0)
        self._order = np.empty(0, np.int64)
        # (n, 2): final gaps within tracks, and how late the later report of each was.
        self._gaps = np.empty((0, 2))
        self._instant_s = -math.inf
        #: Times between the last instants, and how late the latest report was for one.
        self._spacings_s: tuple[float, ...] = ()
        self._latest_s = -math.inf
        self._split: dict[str, Branches] = {}
        self._named: bool | None = None
        self._horizon_s = -math.inf
        self._directions = KINDS[self.description.kind].directions
        self._given = self.description
        #: Number of reports of aircraft, and of all.
        self._of_aircraft = np.zeros(2, np.int64)

    @property
    def named(self) -> bool:
        """Whether any report so far has an id or a name."""
        return bool(self._named) or not self._rows.attributes.keys().isdisjoint(NAMING)

    @property
    def has_sensor(self) -> bool:
        """Whether the place of its sensor is known at any of its current reports."""
        return bool(np.isfinite(self._rows.sensor_m).any())

    @property
    def _models_stationary(self) -> bool:
        """Whether its objects may be at rest."""
        return bool(self.description.motion.stationary_share)

    @property
    def has_reports(self) -> bool:
        """Whether any report was added."""
        return self._serial > 0

    def add(self, reports: Reports) -> None:
        """Adds reports, in any order; those without a position are counted and ignored.

        Raises
        ------
        InputError : an error, a place or another number that they need is missing; then nothing was added.
        """
        if not len(reports):
            return
        self._take_motion_of(reports)
        placed = PlacedReports(self.description, reports, self.plane)
        in_plane = calibrated(placed)
        heights = None
        if not isinstance(in_plane, Directions):
            heights = HeightColumns.of(self.description, reports)
        usable = np.flatnonzero(in_plane.usable)
        self.counts.newest_s = max(self.counts.newest_s, float(in_plane.time_s.max()))
        if isinstance(in_plane, Directions):
            self._directions = True
        elif self.to_tracks is None and in_plane.track is not None:
            self._decide_filtering(placed)
        new = ReportTable.of(in_plane, usable, placed.sensor_m, identity_attributes(reports))
        if heights is not None:
            new.add_groups(HEIGHTS)
            new.heights = heights.table[usable]
        if self._named is None:
            self._named = in_plane.track is not None
        if in_plane.track is not None:
            new.name = self._names(in_plane.track[usable])
        new.serial = self._serial + np.arange(len(usable))
        new.late_s = self._instant_s - new.time_s
        self._latest_s = max(self._latest_s, float(new.late_s.max(initial=-math.inf)))
        self._serial += len(usable)
        self.counts.taken += len(usable)
        self.counts.unplaced += len(reports) - len(usable)
        if in_plane.track is None or isinstance(in_plane, Directions):
            if in_plane.track is not None:
                new.number = self._numbered(new.name)
            self._rows.add(new)
        else:
            self._add_to_tracks(new)

    @property
    def given(self) -> Description:
        """The description as given; that of tracks of aircraft has their motion."""
        return self._given

    def describe(self, description: Description) -> None:
        """Replaces the description, for the reports that are added from now on."""
        self.description = self._given = description

    def place(self, site: Site) -> None:
        """Gives a sensor of unknown place the one that its own messages state."""
        if self.description.site is None and self.description.platform is None:
            self.description = replace(self.description, site=site)

    def assume(self, lines: Iterable[Assumption]) -> None:
        """Replaces numbers that are assumed, for the reports that are added from now on."""
        self.description = self.description.with_assumed({line.name: (line.value, line.why) for line in lines})

    def _take_motion_of(self, reports: Reports) -> None:
        """Gives tracks of another system the motion of aircraft while most of the reports so far are of aircraft."""
        if self.description.kind != "tracks":
            return
        self._of_aircraft += (int(of_aircraft(reports).sum()), len(reports))
        most = self._of_aircraft[0] >= AIRCRAFT_SHARE * self._of_aircraft[1]
        self.description = self._given.with_motion_of_aircraft() if most else self._given

    def feed(self, instant_s: float, early_s: float = 0.0) -> Feed:
        """The feed of an instant, for a scene; reports that no later instant needs are dropped.

        early_s : by which the stamps are early; such reports become current later, so older ones are needed until then.
        """
        self._drop(instant_s - early_s - self.lag_s)
        if math.isfinite(self._instant_s):
            self._spacings_s = (*self._spacings_s[-8:], instant_s - self._instant_s)
        self._instant_s = instant_s
        if self._models_stationary:
            self._rows.add_groups(MODES)
        # Copies: later reports must not change them.
        rows = self._rows
        time_s, sensor_m = rows.time_s.copy(), rows.sensor_m.copy() if self.has_sensor else None
        track = rows.name.copy() if self._named else None
        row, (state, covariance) = np.arange(len(rows)), (column.copy() for column in rows.tracks)
        reports: States | Directions
        if self._directions:
            reports = Directions(time_s, state[:, 0], state[:, 1], rows.sensor_m.copy(), track, row)
        else:
            reports = States(time_s, state, covariance, track, row)
        scan_s, scan_times_s, rotation = time_s, np.empty(0), None  # tracks are not shown by scans
        if not self._named:
            live = np.flatnonzero(rows.taken)
            bearing = bearings_of(reports, sensor_m)
            scans = scans_of(
                time_s[live], self.description.timing.period_s, None if bearing is None else bearing[live], None
            )
            scan_s = np.full(len(rows), -math.inf)
            scan_s[live], scan_times_s, rotation = scans.scan_s, np.unique(scans.scan_s), scans.rotation
        p_slow = rows.p_slow.copy() if isinstance(reports, States) and self._models_stationary else None
        heights = rows.heights.copy() if HEIGHTS in rows.groups else None
        attributes = {name: column.copy() for name, column in rows.attributes.items()}
        feed = Feed(
            self.description, reports, scan_times_s, scan_s, sensor_m, attributes, rotation=rotation,
            p_slow=p_slow, heights=heights,
        )  # fmt: skip
        if self._named:
            feed = feed.with_succession(self._succession(rows), self.track_timeout_s())
        return feed

    def release(self) -> None:
        """Frees the rows of dropped reports for new ones; to be called after each instant."""
        self._rows.release()
        if len(self._rows) > max(self.live.least_rows, SPARE_ROWS * self._rows.n_held):
            self._shrink()

    def _shrink(self) -> None:
        """Gives back rows that a flood of reports has left empty.

        Those beyond twice the number in use are cut off once no instant needs a report there: it has been replaced, or
        its track has ended.
        """
        rows = self._rows
        rows.use_lowest()
        taken = np.flatnonzero(rows.taken)
        size = max(self.live.least_rows // 2, 2 * len(taken))
        beyond = taken[taken >= size]
        ended_s = self._instant_s - self.lag_s - max(self.track_timeout_s(), 2.0 * STATIONARY_TIMEOUT_S)
        if (rows.time_s[beyond] >= ended_s).any() or (len(beyond) and not self._named):
            return
        self._order = rows.shrink(size)[self._order]

    def track_timeout_s(self, delay_s: float = 0.0) -> float:
        """Seconds without a report after which a track has ended; infinite while no track has two reports.

        A report that was not there yet at an instant after its time is late: its track was without a report until then.
        Where any is, the next one may be later by the time between two instants: else all tracks of a sensor would end
        for an instant, again and again, while its phase moves against that of the instants.
        delay_s : by which the times of the reports are corrected afterwards; it makes them later by as much.
        """
        if not len(self._gaps):
            return math.inf
        gaps = self._gaps[:, 0] + np.maximum(self._gaps[:, 1] + delay_s, 0.0)
        # The quantile with method "higher": np.quantile takes ten times as long, and np.partition twenty times where
        # most gaps are equal.
        place = math.ceil(TIMEOUT_QUANTILE * (len(gaps) - 1))
        # How late a report can be is known to within an instant.
        late = bool(self._spacings_s) and self._latest_s + delay_s > 0.0
        return float(np.sort(gaps)[place]) + (float(np.median(self._spacings_s)) if late else 0.0)

    # ---- adding reports ----

    def _names(self, track: NDArray[Any]) -> NDArray[Any]:
        """Names of tracks; reports without an id are named by their unique serial number."""
        out = np.empty(len(track), object)
        out[:] = names = track.tolist()
        for k in unnamed(names):
            out[k] = f"{UNNAMED}{self._serial + k}"
        return out

    def _numbered(self, names: NDArray[Any]) -> IntArray:
        """(n,) the number of each track; new names get the next numbers."""
        numbers, listed = self._numbers, names.tolist()
        out = numbers_of(listed, numbers)
        for k in np.flatnonzero(out < 0).tolist():
            if listed[k] not in numbers:
                numbers[listed[k]] = self._next_number
                self._next_number += 1
            out[k] = numbers[listed[k]]
        return out

    def _decide_filtering(self, placed: PlacedReports) -> None:
        """Sets ``to_tracks``: by the kind of the reports at once, by their scatter once there are enough."""
        velocity = placed.reports.velocity_m_per_s()
        if (
            velocity is None
            or not np.isfinite(velocity).any()
            or placed.description.kind in (*CORRELATED_KINDS, "tracks")
            or placed.reports.kind in ("arpa", *PLOTS_OF_RADARS)
        ):
            self.to_tracks = need_filtering(placed)
            return
        rows, taken = self._rows, np.flatnonzero(self._rows.taken)
        if len(taken) > MIN_INNOVATIONS + len(np.unique(rows.number[taken])):
            measured = States(rows.time_s, rows.measured, rows.measured_covariance, rows.number, np.arange(len(rows)))
            self.to_tracks = are_unfiltered(measured.take(taken), acceleration_m2_per_s3=walk_of(self.description))

    def _add_to_tracks(self, new: ReportTable) -> None:
        """Adds reports with ids: without late ones, repetitions and outliers, filtered, written into rows."""
        new.number = self._numbered(new.name)
        in_time = self._in_time(new)
        self.counts.late += int(len(new) - in_time.sum())
        new = new.only(in_time)
        if not len(new):
            return
        own = self._neighbours(new)
        updated = self._new_positions(new, own)
        self.counts.repeated += int(len(new) - updated.sum())
        new = new.only(updated)
        split = self._split_ids(new, own)
        new = new.only(new.taken)
        if not len(new):
            return
        if split:
            # A split changes the tracks of the new reports, and so their neighbours.
            own = self._neighbours(new)
        places = self._rows.add(new)
        self._insert(places)
        self._filter(np.concatenate([own, places]), np.concatenate([np.zeros(len(own), bool), np.ones(len(new), bool)]))

    def _insert(self, places: IntArray) -> None:
        """Merges new rows into ``_order``: by track, then time, then serial number."""
        rows, old = self._rows, self._order
        new = places[ordered_by([rows.number[places], rows.time_s[places], rows.serial[places]])]
        self._order = np.empty(len(old) + len(new), np.int64)
        merge_rows(old, new, rows.number, rows.time_s, rows.serial, self._order)

    def _neighbours(self, new: ReportTable) -> IntArray:
        """Rows of the tracks of new reports, in order: of each track the last one before these, and all after it."""
        rows, own = self._rows, np.empty(len(self._order), np.int64)
        by_track = np.argsort(new.number)
        n = neighbours(self._order, rows.number, rows.time_s, new.number[by_track], new.time_s[by_track], own)
        return own[:n]

    def _in_time(self, new: ReportTable) -> BoolArray:
        """(n,) whether a report is within the lag, or not before the oldest report that is kept of its track."""
        late = new.time_s < self._horizon_s
        if not late.any():
            return ~late
        rows, own = self._rows, self._order
        first = own[np.flatnonzero(np.diff(rows.number[own], prepend=-1))]
        at = places_in(rows.number[first], new.number)
        known, oldest = at >= 0, np.append(rows.time_s[first], math.inf)[at]
        dropped_s = self._horizon_s + self.lag_s - self._memory_s
        return np.asarray(
            (new.time_s >= self._horizon_s) | (new.time_s >= oldest) | (~known & (new.time_s >= dropped_s))
        )

    @property
    def _memory_s(self) -> float:
        """Seconds for which the last report of a track is kept, so that its filter can continue."""
        return self.lag_s + self.live.id_timeout_s

    def _new_positions(self, new: ReportTable, own: IntArray) -> BoolArray:
        """(n,) whether a report has a new position: it does not repeat one that its object has left."""
        rows, out = self._rows, np.ones(len(new), bool)
        place = np.concatenate([taken(rows.measured, own)[:, :2], new.measured[:, :2]])
        number, time_s, order = self._beside(own, new)
        repeats = repeated(number, time_s, place, order)[0] - len(own)
        repeats = repeats[repeats >= 0]
        if not len(repeats):
            return out
        moving = in_motion(new.measured[repeats, 2:], new.measured_covariance[repeats, 2:, 2:])
        tracks = np.unique(new.number[repeats[moving]])
        if not len(tracks):
            return out
        # For how long a position has been repeated, all reports of these tracks that are kept show.
        kept = self._order[np.isin(rows.number[self._order], tracks)]
        stale = stale_positions(
            np.concatenate([rows.number[kept], new.number]), np.concatenate([rows.time_s[kept], new.time_s]),
            np.concatenate([rows.measured[kept], new.measured]),
            np.concatenate([rows.measured_covariance[kept], new.measured_covariance]),
        ) - len(kept)  # fmt: skip
        out[stale[stale >= 0]] = False
        return out

    def _split_ids(self, new: ReportTable, own: IntArray) -> bool:
        """Moves reports of one id that cannot be of one object to a track of their own, or excludes them (``taken``);
        gives whether any id was checked."""
        rows, limit = self._rows, MAX_SPEED_SIGMAS * (self.description.motion.speed_m_per_s or math.inf)
        last = own[np.flatnonzero(np.diff(rows.number[own], append=-1))]
        radius = POSITION_SIGMAS * _sigma_m(new.measured_covariance)
        suspects = self._far(new, last, radius, limit)
        if not (self._split or suspects.any()):
            return False
        last_radius = POSITION_SIGMAS * _sigma_m(taken(rows.measured_covariance, last))
        for k in np.lexsort([new.serial, new.time_s]).tolist():
            name = new.name[k]
            if name not in self._split and suspects[k]:
                at = np.flatnonzero(rows.number[last] == new.number[k])
                if len(at):
                    row, radius_m = last[at[0]], float(last_radius[at[0]])
                    self._split[name] = Branches.of(float(rows.time_s[row]), rows.measured[row], radius_m)
            if name not in self._split:
                continue
            branches = self._split[name]
            owner = branches.add(float(new.time_s[k]), new.measured[k], float(radius[k]), limit)
            if owner is None:
                new.taken[k] = False
                self.counts.jumps += 1
            elif owner:
                new.name[k] = f"{name} ({owner + 1})"
                new.number[k] = self._numbered(new.name[k : k + 1])[0]
            if branches.single(float(new.time_s[k]), self._memory_s):
                del self._split[name]
        return True

    def _beside(self, own: IntArray, new: ReportTable) -> tuple[IntArray, FloatArray, IntArray]:
        """Numbers of tracks and times of ``own`` (k,) rows, which are in order, followed by new reports, and the order
        of both together: by track, then time, then serial number."""
        rows, k = self._rows, len(own)
        number, time_s, serial = (
            np.concatenate([getattr(rows, name)[own], getattr(new, name)]) for name in ("number", "time_s", "serial")
        )
        of_new, order = ordered_by([new.number, new.time_s, new.serial]), np.empty(len(number), np.int64)
        merge_rows(np.arange(k), k + of_new, number, time_s, serial, order)
        return number, time_s, order

    def _far(self, new: ReportTable, last: IntArray, radius: FloatArray, limit: float) -> BoolArray:
        """(n,) whether any report of the same id lies out of reach of the one before it, in its track or this batch."""
        rows = self._rows
        number, time_s, order = self._beside(last, new)
        number, time_s = number[order], time_s[order]
        same = np.flatnonzero(number[1:] == number[:-1])
        state = np.concatenate([taken(rows.measured, last), new.measured])
        first, second = taken(state, order[same]), taken(state, order[same + 1])
        last_radius = POSITION_SIGMAS * _sigma_m(taken(rows.measured_covariance, last))
        reach = np.concatenate([last_radius, radius])[order]
        distance, elapsed_s = np.hypot(*(second[:, :2] - first[:, :2]).T), time_s[same + 1] - time_s[same]
        far = distance > reach[same] + reach[same + 1] + fastest(limit, first, second) * elapsed_s
        # All reports of such an id in the batch are then checked one by one.
        return are_among(new.number, number[same[far]])

    def _filter(self, rows: IntArray, is_new: BoolArray) -> None:
        """Filters tracks again, each from the last report before its first new one.

        rows, is_new : (n,) rows of these tracks, in any order, and whether each is new.
        """
        if not self.to_tracks and not self._models_stationary:
            return
        table = self._rows
        table.add_groups(FILTER)
        order = np.lexsort([table.serial[rows], table.time_s[rows], table.number[rows]])
        rows, is_new = rows[order], is_new[order]
        number = table.number[rows]
        begins = np.flatnonzero(np.diff(number, prepend=-1))
        track = np.cumsum(np.diff(number, prepend=-1) != 0) - 1
        place = np.arange(len(rows))
        first_new = np.full(len(begins), len(rows))
        np.minimum.at(first_new, track[is_new], place[is_new])
        use = np.flatnonzero(place >= first_new[track] - 1)
        is_start = place[use] < first_new[track[use]]
        at = rows[use]
        measured = States(table.time_s[at], table.measured[at], table.measured_covariance[at], number[use], use)
        tracks = measured
        if self.to_tracks:
            tracks = self._followed(at, is_start, measured)
        self._write(at, is_start, measured, tracks)

    def _followed(self, at: IntArray, is_start: BoolArray, measured: States) -> States:
        """The filtered states of reports, by track and time; is_start : (n,) whether one is filtered already."""
        table = self._rows
        noise = self.random.noise(measured, table.sensor_m[at])
        reports = replace(
            measured,
            state=np.where(is_start[:, None], table.filtered[at], measured.state),
            covariance=np.where(is_start[:, None, None], table.filtered_covariance[at], noise.covariance),
        )
        tracks = follow(
            reports, acceleration_m2_per_s3=walk_of(self.description),
            trend=np.where(is_start[:, None], table.trend[at], NO_TREND),
        )  # fmt: skip
        updated = np.flatnonzero(~is_start)
        table.trend[at[updated]] = tracks.trend[updated]
        return tracks.states

    def _write(self, at: IntArray, is_start: BoolArray, measured: States, tracks: States) -> None:
        """Writes the filtered states of reports into their rows; is_start : (n,) as of :meth:`_followed`."""
        table, updated = self._rows, np.flatnonzero(~is_start)
        visible = tracks
        if self.to_tracks and keep_positions(self.description, self.random):
            visible = at_reported_positions(measured, tracks, self.random, table.sensor_m[at], self.description)
        known = None
        if self._models_stationary:
            table.add_groups(MODES)
            log_p = np.where(is_start[:, None], table.modes[at], np.nan)
            known = Modes(log_p, table.modes_mean[at], table.modes_covariance[at])
        visible, modes = stationary(visible, self.description.motion, known)
        at = at[updated]
        table.filtered[at], table.filtered_covariance[at] = tracks.state[updated], tracks.covariance[updated]
        table.state[at], table.covariance[at] = visible.state[updated], visible.covariance[updated]
        if modes is not None:
            table.p_slow[at] = modes.p_slow[updated]
            table.modes[at], table.modes_mean[at] = modes.log_p[updated], modes.mean[updated]
            table.modes_covariance[at] = modes.covariance[updated]

    # ---- feeds ----

    def _drop(self, horizon_s: float) -> None:
        """Drops the reports that no instant at or after ``horizon_s`` needs."""
        rows, self._horizon_s = self._rows, horizon_s
        live = np.flatnonzero(rows.taken)
        names: list[str] = []
        if self._named:
            order = self._ordered(live)
            (is_dropped, is_ended), gaps = np.empty((2, len(order)), bool), np.empty((len(order), 2))
            n_gaps = outdated(
                order, rows.number, rows.time_s, rows.late_s, horizon_s, horizon_s - (self._memory_s - self.lag_s),
                is_dropped, is_ended, gaps,
            )  # fmt: skip
            # These gaps are final: no late report can change them.
            self._gaps = np.concatenate([self._gaps, gaps[:n_gaps]])[-GAPS:]
            dropped, names = order[is_dropped], rows.name[order[is_ended]].tolist()
        else:
            period_s = self.description.timing.period_s or 0.0
            kept_s = max(PLOTS_S, PLOT_PERIODS * period_s)
            dropped = live[rows.time_s[live] < horizon_s - kept_s]
        if not len(dropped):
            return
        rows.clear(dropped)
        self._order = self._order[rows.taken[self._order]]
        for name in names:
            self._numbers.pop(name, None)
            self._split.pop(name, None)

    def _succession(self, rows: ReportTable) -> Succession:
        order = self._ordered(np.flatnonzero(rows.taken))
        final = np.append(np.diff(rows.number[order]) != 0, True) if len(order) else np.empty(0, bool)
        return Succession(order, rows.time_s[order], final)

    def _ordered(self, live: IntArray) -> IntArray:
        """The rows ``live`` by track, then time, then serial number; for positions that is ``_order``."""
        rows = self._rows
        if len(self._order) == len(live):
            return self._order
        return live[np.lexsort([rows.serial[live], rows.time_s[live], rows.number[live]])]


def _sigma_m(covariance: FloatArray) -> FloatArray:
    """(n,) √ of the trace of positions' covariances."""
    return np.asarray(np.sqrt(covariance[:, 0, 0] + covariance[:, 1, 1]))


def unbiased_now(feed: Feed, biases: SourceBiases, track_timeout_s: float, instant_s: float) -> Feed:
    """A live feed corrected for biases, for one instant; the order of its reports stays.

    Of tracks, only the reports that are current at the instant have a place: to correct all takes ten times as long.
    """
    reports = feed.reports
    if reports.track is None or biases.theta is None:
        return biases.removed(feed)
    succession = replace(feed.succession, time_s=feed.succession.time_s - biases.theta[TIME])
    if isinstance(reports, States):
        state = np.full_like(reports.state, np.nan)
        current = succession.at(instant_s)
        state[current] = reports.state[current]
        feed = replace(feed, reports=replace(reports, state=state))
    return biases.removed(feed).with_succession(succession, track_timeout_s)

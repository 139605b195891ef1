"""A growing feed: one source of a live picture, which takes in reports as they arrive.

A :class:`~sameas.tracks.feed.Feed` is of all reports of a source; a source that goes on for months must forget.
:class:`GrowingFeed` keeps of every track the reports of the last ``lag_s`` seconds and the one before them, filters
only what is new, and gives at any instant the feed that a scene needs. A report that is late is filtered in its place:
from the last report before it on, its track is filtered again; so within the lag the order of arrival changes nothing.
What is later than that, or of a time that its track has passed and forgotten, is counted and left out.

A report keeps its row as long as it may be current, and no other report has that row at the next instant: so what is
carried from instant to instant knows a plot again though its source has no names for it.

This is the one value of this room that changes: it stands for arrays that would be copied at every report.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from itertools import repeat
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.evidence.identity import MODELS
from sameas.kernels.order import merge_rows
from sameas.tracks.alignment import States, Succession, follow, measures_anew
from sameas.tracks.biases import TIME, corrected
from sameas.tracks.coordinates import LocalPlane
from sameas.tracks.duplicate_ids import Branches
from sameas.tracks.feed import (
    LASTING,
    Feed,
    in_motion,
    in_place,
    known_biases,
    need_filtering,
    repeated,
    stationary,
    walk_of,
)
from sameas.tracks.heights import HeightColumns
from sameas.tracks.kinds import KINDS
from sameas.tracks.placement import Directions, PlacedReports
from sameas.tracks.reports import Reports
from sameas.tracks.scans import scans_of
from sameas.tracks.source import Description
from sameas.tracks.tuning import DEFAULT_TUNING, Tuning


@dataclass(frozen=True)
class LiveTuning:
    """The chosen numbers of growing feeds.

    id_timeout_s : a track without reports is forgotten after this long; until then a filter goes on with it.
    plots_s, plot_periods : of a source of bare plots the last ``plots_s`` seconds are kept, and at least so many
        periods: they show how its antenna turns.
    gaps : the track timeout is by so many of the last gaps within tracks.
    """

    id_timeout_s: float = 3600.0
    plots_s: float = 30.0
    plot_periods: float = 12.0
    gaps: int = 4096


@dataclass
class Counts:
    """What became of a source's reports. late : older than the lag. repeated : positions that were told before."""

    taken: int = 0
    late: int = 0
    repeated: int = 0
    jumps: int = 0
    newest_s: float = -math.inf


@dataclass
class GrowingFeed:
    """The feed of a source whose reports arrive one after another.

    Parameters
    ----------
    description : of the source. plane : of the picture; None for the user's own metres.
    lag_s : reports may be late by this, and are then as if they had come in time.
    to_tracks : whether reports with ids are filtered to tracks; None: by their kind, and for reports with speeds by how
        they scatter, once ``measured_fewest`` of them have come (:func:`sameas.tracks.feed.need_filtering`).

    Example
    -------
    >>> columns = {"x_m": [0.0], "y_m": [0.0], "vx_m_per_s": [5.0], "vy_m_per_s": [0.0], "track_id": ["7"]}
    >>> radar = GrowingFeed(Description("radar", "tracks"))
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
    tuning: Tuning = DEFAULT_TUNING
    live: LiveTuning = field(default_factory=LiveTuning)
    counts: Counts = field(default_factory=Counts)

    def __post_init__(self) -> None:
        self._numbers: dict[str, int] = {}
        self._next_number, self._serial = 0, 0
        self._rows = _Rows(0)
        self._freed = np.empty(0, np.int64)
        self._free = np.empty(0, np.int64)
        self._order = np.empty(0, np.int64)
        self._gaps = np.empty(0)
        self._split: dict[str, Branches] = {}
        self._named: bool | None = None
        self._horizon_s = -math.inf
        self._directions = KINDS[self.description.kind].directions
        self._has_heights = False

    @property
    def named(self) -> bool:
        """Whether its reports have had ids or attributes of identity."""
        return bool(self._named) or bool(self._rows.attributes)

    @property
    def has_reports(self) -> bool:
        """Whether it has had a report."""
        return self._serial > 0

    @property
    def directions(self) -> bool:
        """Whether its reports are directions."""
        return self._directions

    def add(self, reports: Reports) -> None:
        """Takes in reports, in any order; those without a position are left out.

        Raises
        ------
        InputError : an error, a place or another number that they need is missing; nothing was taken in then.
        """
        if not len(reports):
            return
        placed = PlacedReports(self.description, reports, self.plane, self.tuning)
        there, sensor_m = placed.in_plane, placed.sensor_m
        biases = known_biases(self.description, sensor_m)
        there = corrected(there, sensor_m, biases) if biases.any() else there
        attributes = {name: column for name in MODELS if (column := getattr(reports, name, None)) is not None}
        heights = None if isinstance(there, Directions) else HeightColumns.of(self.description, reports)
        usable = np.flatnonzero(there.usable)
        self.counts.newest_s = max(self.counts.newest_s, float(there.time_s.max()))
        if isinstance(there, Directions):
            self._directions = True
            new = _Rows.of_directions(there, usable, sensor_m, attributes)
        else:
            if self.to_tracks is None and there.track is not None:
                self._decide_filtering(placed)
            new = _Rows.of_states(there, usable, sensor_m, attributes)
        if heights is not None:
            new.heights, self._has_heights = heights.table[usable], True
        if self._named is None:
            self._named = there.track is not None
        if there.track is not None:
            new.name = self._names(there.track[usable])
        new.serial = self._serial + np.arange(len(usable))
        self._serial += len(usable)
        self.counts.taken += len(usable)
        if there.track is None or isinstance(there, Directions):
            if there.track is not None:
                new.number = self._numbered(new.name)
            places = self._claim(len(new))
            self._rows.put(places, new)
        else:
            self._add_to_tracks(new)

    def feed(self, instant_s: float) -> Feed:
        """The feed by which a scene knows the source at an instant; reports that no later instant needs are dropped."""
        self._drop(instant_s - self.lag_s)
        rows = self._rows.visible(("measured",) if self._directions or not self._named else ())
        time_s, sensor_m = rows.time_s, rows.sensor_m if np.isfinite(rows.sensor_m).any() else None
        track = rows.name if self._named else None
        every = np.arange(len(rows))
        reports: States | Directions
        if self._directions:
            reports = Directions(time_s, rows.measured[:, 0], rows.measured[:, 1], rows.sensor_m, track, every)
        else:
            reports = States(time_s, rows.state, rows.covariance, track, every)
        scan_s, scan_times_s, rotation = time_s, np.unique(time_s[rows.taken]), None
        if not self._named:
            live = np.flatnonzero(rows.taken)
            bearing = self._bearings(rows, live)
            scans = scans_of(time_s[live], self.description.timing.period_s, bearing, None, self.tuning)
            scan_s = np.full(len(rows), -math.inf)
            scan_s[live], scan_times_s, rotation = scans.scan_s, np.unique(scans.scan_s), scans.rotation
        still = None
        if isinstance(reports, States) and self.description.motion.standing_share:
            still = rows.p_stationary
        feed = Feed(
            self.description, reports, scan_times_s, scan_s, sensor_m, rows.attributes, None, (), None, rotation,
            still, self.tuning, rows.heights if self._has_heights else None,
        )  # fmt: skip
        if self._named:
            feed = feed.knowing(self._succession(rows), self.track_timeout_s)
        return feed

    def release(self) -> None:
        """After the instant was judged: the rows of dropped reports may be given to new ones."""
        self._free = np.concatenate([self._free, self._freed])
        self._freed = np.empty(0, np.int64)

    @property
    def track_timeout_s(self) -> float:
        """Seconds without a report after which a track has ended; infinite while no track has two reports."""
        if not len(self._gaps):
            return math.inf
        # The quantile, "higher": np.quantile takes ten times as long, and np.partition twenty times where most gaps are
        # equal.
        place = math.ceil(self.tuning.timeout_quantile * (len(self._gaps) - 1))
        return float(np.sort(self._gaps)[place])

    # ---- taking in ----

    def _names(self, track: NDArray[Any]) -> NDArray[Any]:
        """Names of tracks; reports without an id are called by their serial number, which no other report has."""
        out = np.empty(len(track), object)
        out[:] = list(map(str, track.tolist()))
        for k in [k for k, name in enumerate(out.tolist()) if name[:8] == "unnamed "]:
            out[k] = f"unnamed {self._serial + k}"
        return out

    def _numbered(self, names: NDArray[Any]) -> IntArray:
        """(n,) the number of each track; new names get the next ones."""
        numbers, listed = self._numbers, names.tolist()
        out = list(map(numbers.get, listed, repeat(-1)))
        for k in [k for k, number in enumerate(out) if number < 0]:
            if listed[k] not in numbers:
                numbers[listed[k]] = self._next_number
                self._next_number += 1
            out[k] = numbers[listed[k]]
        return np.array(out, np.int64)

    def _decide_filtering(self, placed: PlacedReports) -> None:
        """Whether to filter: by the kind of the reports at once; by their scatter once there are enough of them."""
        velocity = placed.reports.velocity_m_per_s()
        if velocity is None or not np.isfinite(velocity).any() or placed.description.kind in (*LASTING, "tracks"):
            self.to_tracks = need_filtering(placed)
            return
        if placed.reports.kind in ("arpa", "asterix 048"):
            self.to_tracks = need_filtering(placed)
            return
        rows, taken = self._rows, np.flatnonzero(self._rows.taken)
        if len(taken) > self.tuning.measured_fewest + len(np.unique(rows.number[taken])):
            measured = States(rows.time_s, rows.measured, rows.measured_covariance, rows.number, np.arange(len(rows)))
            self.to_tracks = measures_anew(
                measured.take(taken), acceleration_m2_per_s3=walk_of(self.description), tuning=self.tuning
            )

    def _add_to_tracks(self, new: _Rows) -> None:
        """New reports of tracks: repetitions and jumps set aside, filtered, in their rows."""
        new.number = self._numbered(new.name)
        kept = self._in_time(new)
        self.counts.late += int(len(new) - kept.sum())
        new = new.only(kept)
        if not len(new):
            return
        own = self._neighbours(new)
        fresh = self._measured_anew(new, own)
        self.counts.repeated += int(len(new) - fresh.sum())
        new = new.only(fresh)
        split = self._split_ids(new, own)
        new = new.only(new.taken)
        if not len(new):
            return
        if split:
            # A track of its own for one of two objects has reports of its own too.
            own = self._neighbours(new)
        places = self._claim(len(new))
        self._rows.put(places, new)
        self._into_order(places)
        self._filter(np.concatenate([own, places]), np.concatenate([np.zeros(len(own), bool), np.ones(len(new), bool)]))

    def _into_order(self, places: IntArray) -> None:
        """Rows of tracks that have come, into the order of all: by track, then time, then as they came."""
        rows, old = self._rows, self._order
        new = places[np.lexsort([rows.serial[places], rows.time_s[places], rows.number[places]])]
        self._order = np.empty(len(old) + len(new), np.int64)
        merge_rows(old, new, rows.number, rows.time_s, rows.serial, self._order)

    def _neighbours(self, new: _Rows) -> IntArray:
        """Rows of the tracks of new reports, in order: of each the last before these, and all after it."""
        rows, order = self._rows, self._order
        number, time_s = rows.number[order], rows.time_s[order]
        by_track = np.lexsort([new.time_s, new.number])
        of_track, first = np.unique(new.number[by_track], return_index=True)
        earliest_s = np.append(new.time_s[by_track][first], math.inf)
        at = np.minimum(np.searchsorted(of_track, number), len(of_track) - 1)
        here = of_track[at] == number
        after = here & (time_s >= earliest_s[at])
        # What stands before those, or at the end of its track.
        before = here & ~after
        before[:-1] &= after[1:] | (number[1:] != number[:-1])
        return order[after | before]

    def _in_time(self, new: _Rows) -> BoolArray:
        """(n,) whether a report is not later than the lag, or at least not than the last of its track before that."""
        late = new.time_s < self._horizon_s
        if not late.any():
            return ~late
        rows, own = self._rows, self._order
        first = own[np.flatnonzero(np.diff(rows.number[own], prepend=-1))]
        at = np.searchsorted(rows.number[first], new.number)
        at = np.minimum(at, max(len(first) - 1, 0))
        known = np.append(rows.number[first], -2)[at] == new.number if len(first) else np.zeros(len(new), bool)
        oldest = np.append(rows.time_s[first], math.inf)[np.where(known, at, -1)]
        forgotten_s = self._horizon_s + self.lag_s - self._memory_s
        return np.asarray(
            (new.time_s >= self._horizon_s) | (new.time_s >= oldest) | (~known & (new.time_s >= forgotten_s))
        )

    @property
    def _memory_s(self) -> float:
        """Seconds for which the last report of a track is kept: its filter goes on from there."""
        return self.lag_s + self.live.id_timeout_s

    def _measured_anew(self, new: _Rows, own: IntArray) -> BoolArray:
        """(n,) whether a report has a position of its own, and does not repeat that of the one before."""
        rows, anew = self._rows, np.ones(len(new), bool)
        number, time_s, place = (
            np.concatenate(both)
            for both in (
                (rows.number[own], new.number), (rows.time_s[own], new.time_s),
                (rows.measured[own, :2], new.measured[:, :2]),
            )
        )  # fmt: skip
        again = repeated(number, time_s, place) - len(own)
        again = again[again >= 0]
        anew[again[in_motion(new.measured[again, 2:], new.measured_covariance[again, 2:, 2:], self.tuning)]] = False
        return anew

    def _split_ids(self, new: _Rows, own: IntArray) -> bool:
        """Reports of one id that cannot be of one object become tracks of their own, or are set aside (``taken``);
        whether any id is looked at so."""
        rows, limit = self._rows, self.tuning.fastest * (self.description.motion.speed_m_per_s or math.inf)
        last = own[np.flatnonzero(np.diff(rows.number[own], append=-1))]
        order = np.lexsort([new.serial, new.time_s])
        radius = self.tuning.place_sigmas * _sigma_m(new.measured_covariance)
        suspects = self._far(new, last, radius, limit)
        if not (self._split or suspects.any()):
            return False
        for k in order.tolist():
            name = new.name[k]
            if name not in self._split and not suspects[k]:
                continue
            if name not in self._split:
                at = last[rows.number[last] == new.number[k]]
                if not len(at):
                    continue
                away = self.tuning.place_sigmas * math.sqrt(float(np.trace(rows.measured_covariance[at[0], :2, :2])))
                self._split[name] = Branches.of(float(rows.time_s[at[0]]), rows.measured[at[0]], away)
            branches = self._split[name]
            owner = branches.add(float(new.time_s[k]), new.measured[k], float(radius[k]), limit, self.tuning)
            if owner is None:
                new.taken[k] = False
                self.counts.jumps += 1
            elif owner:
                new.name[k] = f"{name} ({owner + 1})"
                new.number[k] = self._numbered(new.name[k : k + 1])[0]
            if branches.single(float(new.time_s[k]), self._memory_s):
                del self._split[name]
        return True

    def _far(self, new: _Rows, last: IntArray, radius: FloatArray, limit: float) -> BoolArray:
        """(n,) whether a report lies beyond the reach of the one before it in its track, or in this batch."""
        rows = self._rows
        number = np.concatenate([rows.number[last], new.number])
        time_s = np.concatenate([rows.time_s[last], new.time_s])
        place = np.concatenate([rows.measured[last, :2], new.measured[:, :2]])
        reach = np.concatenate([self.tuning.place_sigmas * _sigma_m(rows.measured_covariance[last]), radius])
        order = np.lexsort([time_s, number])
        a, b = order[:-1], order[1:]
        way = np.hypot(*(place[b] - place[a]).T)
        leap = (number[a] == number[b]) & (way > reach[a] + reach[b] + limit * np.abs(time_s[b] - time_s[a]))
        # Within one batch all reports of the id are looked at one by one.
        return np.asarray(np.isin(new.number, number[b[leap]]))

    def _filter(self, rows: IntArray, is_new: BoolArray) -> None:
        """Filters tracks again from the last report before the first new one of each; ``rows`` of these tracks."""
        table = self._rows
        if not self.to_tracks:
            at = rows[is_new]
            measured = States(
                table.time_s[at], table.measured[at], table.measured_covariance[at], None, np.arange(len(at))
            )
            self._show(at, measured, measured)
            return
        order = np.lexsort([table.serial[rows], table.time_s[rows], table.number[rows]])
        rows, is_new = rows[order], is_new[order]
        number = table.number[rows]
        begins = np.flatnonzero(np.diff(number, prepend=-1))
        track = np.cumsum(np.diff(number, prepend=-1) != 0) - 1
        place = np.arange(len(rows))
        first_new = np.full(len(begins), len(rows))
        np.minimum.at(first_new, track[is_new], place[is_new])
        use = np.flatnonzero(place >= first_new[track] - 1)
        base = place[use] < first_new[track[use]]
        again = rows[use]
        measured = States(
            table.time_s[again], np.where(base[:, None], table.filtered[again], table.measured[again]),
            np.where(base[:, None, None], table.filtered_covariance[again], table.measured_covariance[again]),
            number[use], np.arange(len(use)),
        )  # fmt: skip
        tracks = follow(measured, acceleration_m2_per_s3=walk_of(self.description), tuning=self.tuning).states
        done = np.flatnonzero(~base)
        self._show(again[done], measured.take(done), tracks.take(done))

    def _show(self, at: IntArray, measured: States, tracks: States) -> None:
        """Writes reports of tracks, as they were measured and filtered, into their rows."""
        table = self._rows
        table.filtered[at], table.filtered_covariance[at] = tracks.state, tracks.covariance
        visible = in_place(measured, tracks) if self.to_tracks and self.description.kind in LASTING else tracks
        visible, still = stationary(visible, self.description.motion, self.tuning)
        table.state[at], table.covariance[at] = visible.state, visible.covariance
        table.p_stationary[at] = 0.0 if still is None else still

    def _claim(self, n: int) -> IntArray:
        """(n,) free rows; the table grows where there are too few."""
        if len(self._free) < n:
            grown = max(64, n - len(self._free), len(self._rows))
            self._free = np.concatenate([self._free, len(self._rows) + np.arange(grown)])
            self._rows = self._rows.grown(grown)
        claimed, self._free = self._free[:n], self._free[n:]
        return claimed

    # ---- giving ----

    def _drop(self, horizon_s: float) -> None:
        """Drops the reports that no instant from ``horizon_s`` on needs."""
        rows, self._horizon_s = self._rows, horizon_s
        live = np.flatnonzero(rows.taken)
        if self._named:
            order = self._ordered(live)
            number, time_s = rows.number[order], rows.time_s[order]
            overtaken = np.append((number[1:] == number[:-1]) & (time_s[1:] <= horizon_s), False)[: len(order)]
            # Of what no late report can change any more the gaps are known.
            self._gaps = np.append(self._gaps, np.diff(time_s, append=0.0)[overtaken])[-self.live.gaps :]
            forgotten = time_s < horizon_s - (self._memory_s - self.lag_s)
            gone = order[overtaken | forgotten]
        else:
            period_s = self.description.timing.period_s or 0.0
            kept_s = max(self.live.plots_s, self.live.plot_periods * period_s)
            gone = live[rows.time_s[live] < horizon_s - kept_s]
        if not len(gone):
            return
        stays = np.zeros(len(rows), bool)
        stays[live], stays[gone] = True, False
        names = {rows.name[k] for k in gone[~np.isin(rows.number[gone], rows.number[stays])].tolist()}
        self._order = self._order[stays[self._order]]
        rows.clear(gone)
        self._freed = np.concatenate([self._freed, gone])
        for name in names:
            self._numbers.pop(name, None)
            self._split.pop(name, None)

    def _succession(self, rows: _Rows) -> Succession:
        order = self._ordered(np.flatnonzero(rows.taken))
        final = np.append(np.diff(rows.number[order]) != 0, True) if len(order) else np.empty(0, bool)
        return Succession(order, rows.time_s[order], final)

    def _ordered(self, live: IntArray) -> IntArray:
        """The rows ``live``, by track, then time, then as they came: those of positions are kept so."""
        rows = self._rows
        if len(self._order) == len(live):
            return self._order
        return live[np.lexsort([rows.serial[live], rows.time_s[live], rows.number[live]])]

    def _bearings(self, rows: _Rows, live: IntArray) -> FloatArray | None:
        if self._directions:
            return rows.measured[live, 0]
        if not np.isfinite(rows.sensor_m).any():
            return None
        arm = rows.measured[live, :2] - rows.sensor_m[live]
        return np.asarray(np.degrees(np.arctan2(arm[:, 0], arm[:, 1])))


def _sigma_m(covariance: FloatArray) -> FloatArray:
    """(n,) √ of the trace of positions' covariances."""
    return np.asarray(np.sqrt(covariance[:, 0, 0] + covariance[:, 1, 1]))


def unbiased_now(feed: Feed, biases: FloatArray, covariance: FloatArray) -> Feed:
    """A growing feed's feed without biases (6,), known with a covariance (6, 6); its succession stays."""
    reports = corrected(feed.reports, feed.sensor_m, biases, covariance)
    without = replace(
        feed, reports=reports, scan_times_s=feed.scan_times_s - biases[TIME], scan_s=feed.scan_s - biases[TIME]
    )
    if feed.reports.track is None:
        return without
    timed = replace(feed.succession, time_s=feed.succession.time_s - biases[TIME])
    return without.knowing(timed, feed.track_timeout_s)


#: Columns of a feed that its reports have.
_VISIBLE = ("time_s", "state", "covariance", "p_stationary", "sensor_m", "heights", "name")


class _Rows:
    """Rows of reports, columns by name; ``taken`` says which hold one."""

    ARRAYS: tuple[tuple[str, tuple[int, ...], float], ...] = (
        ("time_s", (), -math.inf), ("measured", (4,), math.nan), ("measured_covariance", (4, 4), math.nan),
        ("filtered", (4,), math.nan), ("filtered_covariance", (4, 4), math.nan), ("state", (4,), math.nan),
        ("covariance", (4, 4), math.nan), ("p_stationary", (), 0.0), ("sensor_m", (2,), math.nan),
        ("heights", (4,), math.nan),
    )  # fmt: skip
    time_s: FloatArray
    measured: FloatArray
    measured_covariance: FloatArray
    filtered: FloatArray
    filtered_covariance: FloatArray
    state: FloatArray
    covariance: FloatArray
    p_stationary: FloatArray
    sensor_m: FloatArray
    heights: FloatArray

    def __init__(self, n: int) -> None:
        for name, shape, empty in self.ARRAYS:
            setattr(self, name, np.full((n, *shape), empty))
        self.taken = np.zeros(n, bool)
        self.number = np.full(n, -1)
        self.serial = np.full(n, -1)
        self.name: NDArray[Any] = np.full(n, "", object)
        self.attributes: dict[str, NDArray[Any]] = {}

    def __len__(self) -> int:
        return len(self.taken)

    @classmethod
    def _beside(cls, n: int) -> _Rows:
        """Rows without the columns of times and states, which are given after."""
        rows = cls(0)
        rows.p_stationary, rows.sensor_m, rows.heights = np.zeros(n), np.full((n, 2), np.nan), np.full((n, 4), np.nan)
        rows.number, rows.serial, rows.name = np.full(n, -1), np.full(n, -1), np.full(n, "", object)
        return rows

    @classmethod
    def of_states(
        cls, there: States, usable: IntArray, sensor_m: FloatArray | None, attributes: dict[str, NDArray[Any]]
    ) -> _Rows:
        rows = cls._beside(len(usable))
        for column in ("measured", "filtered", "state"):
            setattr(rows, column, there.state[usable])
        for column in ("measured_covariance", "filtered_covariance", "covariance"):
            setattr(rows, column, there.covariance[usable])
        return rows._with(there.time_s[usable], usable, sensor_m, attributes)

    @classmethod
    def of_directions(
        cls, there: Directions, usable: IntArray, sensor_m: FloatArray | None, attributes: dict[str, NDArray[Any]]
    ) -> _Rows:
        rows = cls(len(usable))
        rows.measured[:, 0], rows.measured[:, 1] = there.bearing_deg[usable], there.sigma_deg[usable]
        return rows._with(there.time_s[usable], usable, sensor_m, attributes)

    def _with(
        self, time_s: FloatArray, usable: IntArray, sensor_m: FloatArray | None, attributes: dict[str, NDArray[Any]]
    ) -> _Rows:
        self.time_s, self.taken = time_s.copy(), np.ones(len(usable), bool)
        if sensor_m is not None:
            self.sensor_m = np.asarray(sensor_m)[usable]
        self.attributes = {name: column[usable] for name, column in attributes.items()}
        return self

    @property
    def _columns(self) -> tuple[str, ...]:
        return (*(name for name, _, _ in self.ARRAYS), "taken", "number", "serial", "name")

    def only(self, which: BoolArray) -> _Rows:
        """Some of the rows, or these themselves where it is all of them."""
        if which.all():
            return self
        out = _Rows(0)
        for name in self._columns:
            setattr(out, name, getattr(self, name)[which])
        out.attributes = {name: column[which] for name, column in self.attributes.items()}
        return out

    def visible(self, also: tuple[str, ...]) -> _Rows:
        """Of a feed: copies of what later reports would change, without what only the filter needs; ``also`` others."""
        out = _Rows(0)
        for name in (*_VISIBLE, *also):
            setattr(out, name, getattr(self, name).copy())
        # These no feed has.
        out.taken, out.number, out.serial = self.taken, self.number, self.serial
        out.attributes = {name: column.copy() for name, column in self.attributes.items()}
        return out

    def grown(self, n: int) -> _Rows:
        """The same with ``n`` empty rows more."""
        more, out = _Rows(n), _Rows(0)
        for name in self._columns:
            setattr(out, name, np.concatenate([getattr(self, name), getattr(more, name)]))
        nothing = np.full(n, None, object)
        for name, column in self.attributes.items():
            empty = nothing if column.dtype == object else np.full(n, np.nan)
            out.attributes[name] = np.concatenate([column, empty])
        return out

    def put(self, places: IntArray, new: _Rows) -> None:
        """Writes rows to these places."""
        for name in self._columns:
            getattr(self, name)[places] = getattr(new, name)
        for name in new.attributes.keys() - self.attributes.keys():
            kind = new.attributes[name].dtype
            self.attributes[name] = np.full(len(self), np.nan if kind.kind == "f" else None, kind)
        for name, column in self.attributes.items():
            column[places] = new.attributes.get(name, None if column.dtype == object else np.nan)

    def clear(self, places: IntArray) -> None:
        """Empties these rows."""
        for name, _, empty in self.ARRAYS:
            if name in (*_VISIBLE, "measured"):
                getattr(self, name)[places] = empty
        self.taken[places], self.number[places], self.serial[places], self.name[places] = False, -1, -1, ""
        for column in self.attributes.values():
            column[places] = None if column.dtype == object else np.nan

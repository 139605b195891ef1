"""Deceptive tracks: those that contradict the sensors that tracked the same object.

Deception is a cooperative track (AIS, ADS-B) that contradicts the sensors that tracked the same object. It was one
object with a sensor's track for a while. Then

- its reported positions move away, while the sensor continues to track the ship where it was ("dragged"). Instead, the
  sensor's tracker may have swapped to a neighbour; the evidence against that is other sensors that continue too, and
  that no sensor covering the reported position detects anything there.
- its reports end, while others of its source continue and the sensor still tracks the ship ("silent"). Several that end
  where the source has received nobody farther out have left its reception.
- its reported positions jump farther than it can move, and stay there ("jumped"), or two tracks jump to each other's
  place ("exchanged": two ships with each other's MMSI). No sensor is needed for these.

A ship that no radar sees where it sees others may be invented ("phantom", :mod:`sameas.picture.phantoms`).

:func:`deceptions` finds them in the records of a picture, each with its log-odds; :func:`faults_and_deceptions` gives
the faults of sources (:mod:`sameas.tracks.faults`), and the deceptions that these do not explain.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import ABSENT, BoolArray, FloatArray, IntArray, distinct, places_in, spans_in
from sameas.picture.phantoms import APART_SIGMAS, TRACKER_LAG_S, Phantom, instant_keys, phantoms
from sameas.picture.picture_state import Carried, PictureState
from sameas.picture.tuning import DEFAULT_TUNING, Tuning
from sameas.ragged import ranges
from sameas.tracks.alignment import States, named_tracks
from sameas.tracks.coordinates import MILE_M
from sameas.tracks.duplicate_ids import MAX_SPEED_SIGMAS, POSITION_SIGMAS, fastest
from sameas.tracks.faults import Fault, log_odds_of_silence, source_faults
from sameas.tracks.feed import CORRELATED_KINDS, FASTEST_VESSEL_M_PER_S, Feed
from sameas.tracks.kinds import AT_REST_EVERY_S, KINDS

if TYPE_CHECKING:
    from scipy.spatial import Delaunay

#: Minimum number of reports of a track, to find its silence, and before and after a jump.
MIN_REPORTS, JUMP_REPORTS = 5, 3
APART_INSTANTS = 3  # two tracks are apart at this many instants or more
#: Prior odds that reported positions are false, against a swap of the sensor's track to another ship; the probability
#: of such a swap for each further sensor; maximum evidence of one sensor without a detection at the reported position.
FALSE_POSITION_ODDS, SENSOR_SWAP, EMPTY_VOTE = 0.1, 0.01, 6.0
#: Minimum duration of a silence, and its prior odds. A crossing ship, a crane or a quay may hide the antenna of a ship
#: for two minutes, and all her reports are lost then.
SILENT_S, SILENT_ODDS = 180.0, 0.01
#: Below this speed a ship may be one of those that report every :data:`AT_REST_EVERY_S` seconds.
SPARSE_M_PER_S = 3.0 * MILE_M / 3600.0
DISPLACED_S = 60.0  # a deception that begins so long before a fault of its source may be the fault's (chosen)
SURE_DECEPTION = 0.95  # probability at which either is an alarm


@dataclass(frozen=True)
class PictureTrack:
    """One track in the records of a picture, (k,) each.

    number : its own, from 0. source, track : number of its source, and its id. at : indices of its instants, ascending.
    object : numbers of its objects. position, variance : (k, 2), (k,) positions and the larger variance of their axes.
    """

    number: int
    source: int
    track: str
    at: IntArray
    object: IntArray
    position: FloatArray
    variance: FloatArray

    @cached_property
    def keys(self) -> IntArray:
        """(k,) instant and object in one number."""
        return instant_keys(self.at, self.object)


@dataclass(frozen=True)
class _Meeting:
    """Another source's track at the instants (k,) at which both it and one's own have records.

    own, theirs : (k,) indices of their records. together : (k,) whether they are one object then, as once at least.
    """

    other: PictureTrack
    own: IntArray
    theirs: IntArray
    together: BoolArray

    @classmethod
    def of(cls, own: PictureTrack, other: PictureTrack) -> _Meeting:
        place = places_in(own.at, other.at)
        theirs = np.flatnonzero(place != ABSENT)
        place = place[theirs]
        return cls(other, place, theirs, own.object[place] == other.object[theirs])

    def shift(self, own: PictureTrack, i: IntArray, j: IntArray) -> FloatArray:
        """(k,) χ² of the way from their records ``j`` to the own ones ``i``, against its median while they were one
        object. Neighbours that were one by mistake, while errors were not known yet, stay as far apart as they were."""
        own_rows, theirs = self.own[self.together], self.theirs[self.together]
        before = np.median(own.position[own_rows] - self.other.position[theirs], axis=0)
        variance = own.variance[i] + self.other.variance[j]
        return np.asarray(np.sum((own.position[i] - self.other.position[j] - before) ** 2, axis=1) / variance)

    @cached_property
    def last(self) -> int:
        """The index of the last of their records at which they are one object."""
        return int(self.theirs[self.together][-1])


@dataclass(frozen=True)
class Silence:
    """The alarm of a track whose reports end. outside : whether the ship then was where its source received nobody."""

    fault: Fault
    outside: bool


@dataclass(frozen=True)
class _Sighting:
    """What a track shows of a ship after her own reports have ended: its records (k,), and their times."""

    track: PictureTrack
    rows: IntArray
    times_s: FloatArray

    def until_s(self, area: Delaunay | None) -> float:
        """When it last shows her within an area, None for anywhere; −∞ where never."""
        inside = self.times_s
        if area is not None:
            inside = inside[area.find_simplex(self.track.position[self.rows]) >= 0]
        return float(inside.max(initial=-math.inf))


def _tracks(feeds: Sequence[Feed], records: Mapping[str, NDArray[Any]], instants: FloatArray) -> list[PictureTrack]:
    """All tracks of sources with track ids."""
    out: list[PictureTrack] = []
    at = np.searchsorted(instants, records["time_s"])
    hidden = np.ma.getmaskarray(records["x_m"])
    position = np.column_stack([np.ma.filled(records[name], np.nan) for name in ("x_m", "y_m")])
    variance = np.maximum(np.ma.filled(records["var_x_m2"], np.nan), np.ma.filled(records["var_y_m2"], np.nan))
    for s, feed in enumerate(feeds):
        if feed.reports.track is None:
            continue
        own = np.flatnonzero((records["source"] == feed.description.name) & ~hidden)
        names, number = np.unique(records["track_id"][own].astype(str), return_inverse=True)
        order = np.lexsort([at[own], number])
        for name, rows in zip(names, np.split(own[order], np.flatnonzero(np.diff(number[order])) + 1), strict=False):
            columns = (at[rows], records["object"][rows], position[rows], variance[rows])
            out.append(PictureTrack(len(out), s, str(name), *columns))
    return out


def sightings_of(state: PictureState[Carried]) -> dict[str, NDArray[Any]]:
    """The columns that :func:`deceptions` needs of the records of a picture state."""
    scan = state.scan
    names = np.array([description.name for description in scan.now.descriptions] or [""], dtype=object)
    return {
        "time_s": np.full(len(scan), state.now.instant_s),
        "source": names[scan.source],
        "track_id": scan.track,
        "object": state.number[state.object_of_record] if len(scan) else np.empty(0, np.int64),
        **{name: np.ma.MaskedArray(column, ~scan.placed) for name, column in (
            ("x_m", scan.state[:, 0]), ("y_m", scan.state[:, 1]),
            ("var_x_m2", scan.covariance[:, 0, 0]), ("var_y_m2", scan.covariance[:, 1, 1]),
        )},
    }  # fmt: skip


def deceptions(
    feeds: Sequence[Feed], records: Mapping[str, NDArray[Any]], tuning: Tuning = DEFAULT_TUNING
) -> tuple[Fault, ...]:
    """The deceptions in the records of a picture with a probability above ``SURE_DECEPTION``, in order of time."""
    if not len(records["time_s"]):
        return ()
    instants = np.unique(records["time_s"])
    tracks = _tracks(feeds, records, instants)
    if not tracks:
        return ()
    histories = _TrackHistories.of(tracks, feeds, instants, tuning)
    alarms, silences = list[Fault](), list[Silence]()
    for own in filter(histories.is_cooperative, tracks):
        meetings = [
            meeting
            for meeting in histories.meetings(own)
            if not (histories.is_of_another(meeting, own) or histories.carried(meeting, own))
        ]
        alarms += histories.dragged(own, meetings)
        silences += histories.silent(own, meetings)
    outside = Counter(silence.fault.source for silence in silences if silence.outside)
    alarms += [one.fault for one in silences if not one.outside or outside[one.fault.source] == 1]
    dragged = {(fault.source, fault.track) for fault in alarms if fault.probability > SURE_DECEPTION}
    for feed in feeds:
        alarms += [fault for fault in _jumped(feed) if (fault.source, fault.track) not in dragged]
    alarms += [_phantom(one) for one in phantoms(feeds, records) if (one.source, one.track) not in dragged]
    alarms = [fault for fault in alarms if fault.probability > SURE_DECEPTION]
    return tuple(sorted(alarms, key=lambda fault: fault.first_s))


def _phantom(one: Phantom) -> Fault:
    """The alarm of a ship that is never seen."""
    shown = "never saw it" if one.seen == 0 else f"saw it {100.0 * one.seen / one.looks:.0f} % of the time"
    words = (
        f"{one.source}: {one.track} may be invented: {one.radar} {shown} in {one.minutes:.0f} min under way within "
        f"{one.within_m / 1000.0:.1f} km, where it sees {one.others} others {100.0 * one.share:.0f} % of the time; "
        "look out for it"
    )
    return Fault("phantom", one.source, one.first_s, one.last_s, min(one.log_odds, 50.0), words, one.track)


def faults_and_deceptions(
    feeds: Sequence[Feed], records: Mapping[str, NDArray[Any]], tuning: Tuning
) -> tuple[Fault, ...]:
    """The faults of the sources, and the deceptions in the records of a picture that they do not explain.

    A clock that jumps or a source that freezes displaces all its ships; that is not a deception by each of them.
    """
    faults = source_faults(feeds)
    displacing = [fault for fault in faults if fault.kind in ("clock", "frozen")]

    def displaced(one: Fault) -> bool:
        return any(one.source == fault.source and one.first_s > fault.first_s - DISPLACED_S for fault in displacing)

    return (*faults, *(one for one in (deceptions(feeds, records, tuning) if records else ()) if not displaced(one)))


@dataclass(frozen=True)
class _TrackHistories:
    """The tracks of a picture over its instants.

    feeds : of the sources. instants : (t,) in seconds. key, track : (k,) instants and objects as of
    :attr:`PictureTrack.keys`, ascending, and the index of the track that has each.
    """

    tracks: list[PictureTrack]
    feeds: Sequence[Feed]
    instants: FloatArray
    key: IntArray
    track: IntArray
    tuning: Tuning

    @classmethod
    def of(
        cls, tracks: list[PictureTrack], feeds: Sequence[Feed], instants: FloatArray, tuning: Tuning
    ) -> _TrackHistories:
        key = np.concatenate([track.keys for track in tracks])
        number = np.repeat(np.arange(len(tracks)), [len(track.at) for track in tracks])
        order = np.argsort(key, kind="stable")
        return cls(tracks, feeds, instants, key[order], number[order], tuning)

    @cached_property
    def report_times_s(self) -> dict[int, dict[str, FloatArray]]:
        """The times of the reports of each track, ascending, by source and id, of cooperative sources."""
        own = {track.source for track in self.tracks if self.is_cooperative(track)}
        return {s: _times_by_track(self.feeds[s].reports.track, self.feeds[s].reports.time_s) for s in own}

    @cached_property
    def of_track(self) -> tuple[IntArray, BoolArray, IntArray]:
        """(n,) of each track: the number of its source, whether that is cooperative, and the number of its id."""
        cooperative = np.array([self.is_cooperative(track) for track in self.tracks])
        ids = np.unique([track.track for track in self.tracks], return_inverse=True)[1]
        return np.array([track.source for track in self.tracks]), cooperative, ids

    def name(self, track: PictureTrack) -> str:
        """The name of its source."""
        return self.feeds[track.source].description.name

    def is_cooperative(self, track: PictureTrack) -> bool:
        return self.feeds[track.source].description.kind in CORRELATED_KINDS

    def company(self, own: PictureTrack) -> tuple[IntArray, IntArray]:
        """(e,) records of a track, ascending, and the number of each track that is one object with it then, also of
        itself; of its source no other."""
        record, rows = ranges(*spans_in(self.key, own.keys))
        number = self.track[rows]
        kept = (number == own.number) | (self.of_track[0][number] != own.source)
        return record[kept], number[kept]

    def meetings(self, own: PictureTrack) -> list[_Meeting]:
        """With the tracks of other sources that were one object with this one at any instant."""
        numbers = distinct(self.company(own)[1]).tolist()
        return [_Meeting.of(own, self.tracks[k]) for k in numbers if k != own.number]

    def is_of_another(self, meeting: _Meeting, own: PictureTrack) -> bool:
        """Whether a track is that of a vessel that reports another identity, before and after the own one left it.

        A helicopter leaves its ship, or switches off on board: the radar still sees the ship. A neighbour whose reports
        meet the radar's track only after the own ones have left it is no proof: they may be forged.
        """
        other, after = meeting.other, meeting.last + 1
        if after == len(other.at):
            return False
        record, number = self.company(other)
        _, cooperative, ids = self.of_track
        named = np.zeros(len(other.at), bool)
        named[record[cooperative[number] & (ids[number] != ids[own.number])]] = True
        return all(part.mean() > 0.5 for part in (named[:after], named[after:]))

    def carried(self, meeting: _Meeting, own: PictureTrack) -> bool:
        """Whether a track is that of a vessel on which an aircraft stood: while both are one object, and afterwards, it
        moves no faster than vessels do.

        Nothing else shows it where the vessel reports nothing. A slow aircraft whose reports leave it is not found.
        """
        if KINDS[self.feeds[own.source].description.kind].target != "aircraft":
            return False
        fastest = FASTEST_VESSEL_M_PER_S
        parts = np.split(np.arange(len(meeting.other.at)), [meeting.last + 1])
        return all(self._mean_speed(meeting.other, part) <= fastest for part in parts)

    def _mean_speed(self, track: PictureTrack, part: IntArray) -> float:
        """Metres per second from the first of some records of a track to the last; 0 for less than two."""
        if len(part) < 2:
            return 0.0
        ends = part[[0, -1]]
        seconds = float(np.diff(self.instants[track.at[ends]])[0])
        return float(np.hypot(*np.diff(track.position[ends], axis=0)[0])) / max(seconds, 1e-9)

    def companions(self, meetings: Sequence[_Meeting]) -> Iterator[_Meeting]:
        """The tracks that were one object with it for ``min_instants`` instants."""
        return (meeting for meeting in meetings if meeting.together.sum() >= self.tuning.min_instants)

    def dragged(self, own: PictureTrack, meetings: Sequence[_Meeting]) -> Iterator[Fault]:
        """An alarm if its positions moved away from those of the sensors that tracked the same object before."""
        contradicting, begins = [], []
        after = np.zeros(len(own.at), bool)
        for meeting in self.companions(meetings):
            since = meeting.theirs > meeting.last
            if since.sum() < APART_INSTANTS:
                continue
            other, i, j = meeting.other, meeting.own[since], meeting.theirs[since]
            contradicts = self.disagreement(own, other, i, j) > APART_SIGMAS**2
            contradicts &= meeting.shift(own, i, j) > APART_SIGMAS**2
            if contradicts.sum() >= APART_INSTANTS and contradicts[-1]:
                distance_m = float(np.sqrt(np.sum((own.position[i[-1]] - other.position[j[-1]]) ** 2)))
                contradicting.append((self.name(other), distance_m))
                begins.append(int(own.at[i[contradicts][0]]))
                after |= own.at >= begins[-1]
        if not contradicting:
            return
        # If a sensor tracks an object at the reported position, the sensor lost its old track; nothing was dragged.
        unaccompanied = after & ~_has_partner(own, meetings)
        if unaccompanied.sum() < 0.8 * after.sum():
            return
        sensors = sorted({name for name, _ in contradicting})
        log_odds = (
            math.log(FALSE_POSITION_ODDS)
            + self.log_undetected(own, unaccompanied)
            - (len(sensors) - 1) * math.log(SENSOR_SWAP)
        )
        distance_m = max(distance for _, distance in contradicting)
        words = (
            f"{self.name(own)} reports {own.track} at one place, {' and '.join(sensors)} "
            f"{'sees' if len(sensors) == 1 else 'see'} it at another, {distance_m:.0f} m away at the end, and nothing "
            "at the place reported; its positions are forged or faulty"
        )
        first_s, last_s = float(self.instants[min(begins)]), float(self.instants[own.at[-1]])
        yield Fault("dragged", self.name(own), first_s, last_s, log_odds, words, own.track)

    def disagreement(self, own: PictureTrack, other: PictureTrack, i: IntArray, j: IntArray) -> FloatArray:
        """(k,) χ² of the positions ``j`` of the other track against the path of the own one about its reports ``i``.

        The other track may be late or early on the path by some seconds, 1σ ``TRACKER_LAG_S``.
        """
        sigma_s, widest = TRACKER_LAG_S, APART_SIGMAS
        lag_s = sigma_s * np.linspace(-widest, widest, 41)
        times = self.instants[own.at[i]] + lag_s[:, None]
        path = np.stack([np.interp(times, self.instants[own.at], axis) for axis in own.position.T], axis=-1)
        chi_sq = np.sum((path - other.position[j]) ** 2, axis=2) / (own.variance[i] + other.variance[j])
        return np.asarray((chi_sq + (lag_s[:, None] / sigma_s) ** 2).min(axis=0))

    def log_undetected(self, own: PictureTrack, which: BoolArray) -> float:
        """−ln of the probability that no sensor that covers its positions ``which`` detects anything there."""
        start_s = float(self.instants[own.at[which][0]])
        return sum(
            min(float(-np.log(feed.q_at(own.position[which], start_s)).sum()), EMPTY_VOTE)
            for feed in self.feeds
            if feed.sensor_m is not None
            and feed.description.kind not in CORRELATED_KINDS
            and feed.reports.track is not None
        )

    def received_later(self, own: PictureTrack, time_s: float) -> bool:
        """Whether another source of its kind has a report of the same ship after this time."""
        kind = self.feeds[own.source].description.kind
        return any(
            float(reported[own.track][-1]) > time_s
            for s, reported in self.report_times_s.items()
            if s != own.source and own.track in reported and self.feeds[s].description.kind == kind
        )

    @cached_property
    def received(self) -> dict[int, Delaunay]:
        """By cooperative source, the area within which it received reports: the convex hull of their positions."""
        from scipy.spatial import ConvexHull, Delaunay, QhullError

        out = {}
        for s in {track.source for track in self.tracks if self.is_cooperative(track)}:
            position = np.concatenate([track.position for track in self.tracks if track.source == s])
            try:
                out[s] = Delaunay(position[ConvexHull(position).vertices])
            except (QhullError, ValueError):  # all on one line, or fewer than three
                continue
        return out

    def silent(self, own: PictureTrack, meetings: Sequence[_Meeting]) -> Iterator[Silence]:
        """An alarm if its reports end while its source continues and a sensor still tracks the ship.

        Of several base stations, only the one that received the ship last can tell.
        """
        times = self.report_times_s[own.source].get(own.track, np.empty(0))
        if len(times) < MIN_REPORTS or self.received_later(own, float(times[-1])):
            return
        pauses, ended_s = np.diff(times), float(times[-1])
        sightings = [
            seen
            for meeting in self.companions(meetings)
            if self.instants[meeting.other.at[meeting.last]] >= ended_s - float(pauses.max())
            and (seen := self._seen_after(meeting.other, ended_s))
        ]
        if not sightings:
            return
        longest = max(float(pauses.max()), self._longest_allowed_s(own, sightings))
        end = float(self.feeds[own.source].reports.time_s.max())
        areas = None, self.received.get(own.source)
        seen_until, within_until = (max(one.until_s(area) for one in sightings) for area in areas)
        outside = min(within_until, end) - ended_s < SILENT_S
        last_s = min(seen_until if outside else within_until, end)
        silent_s = last_s - ended_s
        if silent_s < SILENT_S:
            return
        log_odds = log_odds_of_silence(silent_s, longest, len(pauses), SILENT_ODDS)
        tracks = tuple(dict.fromkeys((self.name(one.track), one.track.track) for one in sightings))
        sensors = " and ".join(sorted({name for name, _ in tracks}))
        words = (
            f"{self.name(own)}: {self._called(own)} has gone silent: {sensors} saw it for {silent_s:.0f} s more, its "
            f"longest pause before was {pauses.max():.3g} s; call it: its transponder is off, or is not received there"
        )
        fault = Fault("silent", self.name(own), ended_s, last_s, min(log_odds, 50.0), words, own.track, tracks)
        yield Silence(fault, outside)

    def _seen_after(self, track: PictureTrack, time_s: float) -> _Sighting | None:
        """What a track shows after a time, if it continues without large gaps."""
        after = np.flatnonzero(self.instants[track.at] > time_s)
        if not len(after):
            return None
        passed = track.at[after[-1]] - np.searchsorted(self.instants, time_s, side="right") + 1
        return None if len(after) < 0.8 * passed else _Sighting(track, after, self.instants[track.at[after]])

    def _longest_allowed_s(self, own: PictureTrack, sightings: Sequence[_Sighting]) -> float:
        """The longest pause between the reports of a ship that has stopped, as a sensor shows; 0 for others."""
        if self.feeds[own.source].description.kind != "ais":
            return 0.0
        slowest = min(self._mean_speed(one.track, one.rows) for one in sightings)
        return AT_REST_EVERY_S if slowest < SPARSE_M_PER_S else 0.0

    def _called(self, own: PictureTrack) -> str:
        """A track by the name that it last reported, where it has one, and its id."""
        raw = self.feeds[own.source].raw_reports
        if raw is None or raw.name is None or raw.object_ids is None:
            return own.track
        names = [name for name in raw.name[raw.object_ids.astype(str) == own.track].tolist() if name]
        return f"{names[-1]} ({own.track})" if names else own.track


def _times_by_track(track: NDArray[Any] | None, time_s: FloatArray) -> dict[str, FloatArray]:
    if track is None or not len(track):
        return {}
    names, number = named_tracks(track)
    order = np.lexsort([time_s, number])
    times = np.split(time_s[order], np.flatnonzero(np.diff(number[order])) + 1)
    return {name: np.unique(own) for name, own in zip(names, times, strict=True)}


def _has_partner(own: PictureTrack, meetings: Sequence[_Meeting]) -> BoolArray:
    """(k,) whether another source's track is one object with it."""
    out = np.zeros(len(own.at), bool)
    for meeting in meetings:
        out[meeting.own[meeting.together]] = True
    return out


@dataclass(frozen=True)
class _Jump:
    """A jump of a track between two of its reports: their times, positions (2,), and the reach of the object (m)."""

    track: str
    times_s: tuple[float, float]
    places_m: tuple[FloatArray, FloatArray]
    reach_m: float

    @property
    def distance_m(self) -> float:
        return float(np.hypot(*(self.places_m[1] - self.places_m[0])))

    def exchanges(self, other: _Jump) -> bool:
        """Whether both jump to where the other was, one soon after the other."""
        overlap_s = min(self.times_s[1], other.times_s[1]) - max(self.times_s[0], other.times_s[0])
        apart = [np.hypot(*(self.places_m[k] - other.places_m[1 - k])) for k in (0, 1)]
        return overlap_s > -60.0 and max(apart) < self.reach_m + other.reach_m


def _jumps_of(feed: Feed, n_around: int) -> list[_Jump]:
    """The jumps in the tracks of a source, each with ``n_around`` reports before and after it, in order of time."""
    reports, speed = feed.reports, feed.description.motion.speed_m_per_s
    if not isinstance(reports, States) or reports.track is None or not speed:
        return []
    names, number = named_tracks(reports.track)
    rows = np.flatnonzero(reports.usable)
    rows = rows[np.lexsort([reports.time_s[rows], number[rows]])]
    number, time_s, place = number[rows], reports.time_s[rows], reports.state[rows, :2]
    radius = POSITION_SIGMAS * np.sqrt(np.trace(reports.covariance[rows, :2, :2], axis1=1, axis2=2))
    limit, state = MAX_SPEED_SIGMAS * speed, reports.state[rows]
    reach = radius[1:] + radius[:-1] + fastest(limit, state[:-1], state[1:]) * np.diff(time_s)
    same_track = np.diff(number) == 0
    far = same_track & (np.hypot(*np.diff(place, axis=0).T) > reach)
    jumps = []
    for k in np.flatnonzero(far).tolist():
        around = slice(max(k + 1 - n_around, 0), k + n_around)
        # A single false position is no jump, and has two of these.
        if len(far[around]) == 2 * n_around - 1 and same_track[around].all() and far[around].sum() == 1:
            track, times_s = names[number[k]], (float(time_s[k]), float(time_s[k + 1]))
            jumps.append(_Jump(track, times_s, (place[k], place[k + 1]), float(reach[k])))
    return sorted(jumps, key=lambda jump: jump.times_s)


def _jumped(feed: Feed) -> Iterator[Fault]:
    """Alarms on tracks of a cooperative source that jump farther than their objects can move, and stay there."""
    if feed.description.kind not in CORRELATED_KINDS or (feed.raw_reports and feed.raw_reports.counted_clock):
        return
    name, jumps = feed.description.name, _jumps_of(feed, JUMP_REPORTS)
    exchanged: set[int] = set()
    for k, jump in enumerate(jumps):
        if k in exchanged:
            continue
        later = (n for n in range(k + 1, len(jumps)) if n not in exchanged and jumps[n].track != jump.track)
        n_other = next((n for n in later if jump.exchanges(jumps[n])), None)
        log_odds = 0.5 * (POSITION_SIGMAS * jump.distance_m / jump.reach_m) ** 2
        log_odds = min(log_odds + math.log(FALSE_POSITION_ODDS), 50.0)
        kind, within = "jumped", f"within {jump.times_s[1] - jump.times_s[0]:.0f} s"
        words = (
            f"{name}: {jump.track} jumps by {jump.distance_m:.0f} m {within}, faster than it can move: another sender "
            "uses its identity, or its positions are forged or faulty"
        )
        if n_other is not None:
            exchanged |= {k, n_other}
            kind = "exchanged"
            words = (
                f"{name}: {jump.track} and {jumps[n_other].track} change places, {jump.distance_m:.0f} m apart, "
                f"{within}, faster than they can move: each uses the identity of the other, or their positions "
                "are forged"
            )
        yield Fault(kind, name, jump.times_s[1], jump.times_s[1], log_odds, words, jump.track)

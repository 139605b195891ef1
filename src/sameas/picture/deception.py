"""Deception: what names itself says one thing, and the sensors that look keep seeing another.

A track that names itself, as AIS and ADS-B do, was one object with a sensor's track for a while. Then

- it says it is elsewhere, and the sensor goes on seeing the ship where it was ("dragged"). The sensor's tracker may
  have gone over to a neighbour instead; against that speak other sensors that go on with it, and that no sensor which
  covers the place shows anything where the track says it is.
- it says nothing more, while others of its source speak on, and the sensor goes on seeing the ship ("silent").

:func:`deceptions` finds both in the records of a picture, each with ln of its odds; :func:`faults_and_deceptions` those
that no fault of a source explains, and these faults.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.picture.picture_state import Carried, PictureState
from sameas.picture.tuning import DEFAULT_TUNING, Tuning
from sameas.ragged import ranges
from sameas.tracks.faults import Fault, log_odds_of_silence, source_faults
from sameas.tracks.feed import LASTING, Feed


@dataclass(frozen=True)
class Followed:
    """One track in the records of a picture (k,): places in ``instants``, objects, places (k, 2) and variances (k,).

    source : number of its source, and its name. track : its id.
    """

    source: int
    track: str
    at: IntArray
    object: IntArray
    place: FloatArray
    variance: FloatArray


def _followed(feeds: Sequence[Feed], records: Mapping[str, NDArray[Any]], instants: FloatArray) -> list[Followed]:
    """All tracks of sources that number what they show."""
    out = []
    at = np.searchsorted(instants, records["time_s"])
    hidden = np.ma.getmaskarray(records["x_m"])
    place = np.column_stack([np.ma.filled(records[name], np.nan) for name in ("x_m", "y_m")])
    variance = np.maximum(np.ma.filled(records["var_x_m2"], np.nan), np.ma.filled(records["var_y_m2"], np.nan))
    for s, feed in enumerate(feeds):
        if feed.reports.track is None:
            continue
        mine = np.flatnonzero((records["source"] == feed.description.name) & ~hidden)
        names, number = np.unique(records["track_id"][mine].astype(str), return_inverse=True)
        order = np.argsort(number, kind="stable")
        for name, rows in zip(names, np.split(mine[order], np.flatnonzero(np.diff(number[order])) + 1), strict=False):
            out.append(Followed(s, str(name), at[rows], records["object"][rows], place[rows], variance[rows]))
    return out


def sightings_of(state: PictureState[Carried]) -> dict[str, NDArray[Any]]:
    """The columns of the records of a picture's instant that :func:`deceptions` reads."""
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


@dataclass(frozen=True)
class _Together:
    """Which tracks were one object with which: (k,) keys of instant and object, ascending, and numbers of tracks."""

    tracks: list[Followed]
    key: IntArray
    track: IntArray

    @classmethod
    def of(cls, tracks: list[Followed]) -> _Together:
        key = np.concatenate([_key(one) for one in tracks])
        track = np.repeat(np.arange(len(tracks)), [len(one.at) for one in tracks])
        order = np.argsort(key, kind="stable")
        return cls(tracks, key[order], track[order])

    def with_(self, own: Followed) -> list[Followed]:
        """The tracks of other sources that were one object with this one at any instant."""
        keys = _key(own)
        low, high = np.searchsorted(self.key, keys), np.searchsorted(self.key, keys, side="right")
        _, rows = ranges(low, high - low)
        return [one for k in np.unique(self.track[rows]) if (one := self.tracks[k]).source != own.source]


def _key(one: Followed) -> IntArray:
    return np.asarray(one.at.astype(np.int64) << 32 | one.object.astype(np.int64))


def deceptions(
    feeds: Sequence[Feed], records: Mapping[str, NDArray[Any]], tuning: Tuning = DEFAULT_TUNING
) -> tuple[Fault, ...]:
    """The deceptions that the records of a picture show, in the order of time."""
    if not len(records["time_s"]) or len(feeds) < 2:
        return ()
    instants = np.unique(records["time_s"])
    tracks = _followed(feeds, records, instants)
    if not tracks:
        return ()
    together = _Together.of(tracks)
    found: list[Fault] = []
    for own in [one for one in tracks if feeds[one.source].description.kind in LASTING]:
        others = together.with_(own)
        found += _dragged(own, others, feeds, instants, tuning)
        found += _silent(own, others, feeds, instants, tuning)
    found = [fault for fault in found if fault.probability > tuning.sure_deception]
    return tuple(sorted(found, key=lambda fault: fault.first_s))


def faults_and_deceptions(
    feeds: Sequence[Feed], records: Mapping[str, NDArray[Any]], tuning: Tuning = DEFAULT_TUNING
) -> tuple[Fault, ...]:
    """The faults of the sources and the deceptions that the records of a picture show.

    The source is doubted first: where its clock jumps or it freezes, all of its ships are elsewhere than they are seen,
    and that is no deception by each of them.
    """
    faults = source_faults(feeds)
    doubted = [fault for fault in faults if fault.kind in ("clock", "frozen")]
    return (*faults, *(
        one for one in (deceptions(feeds, records, tuning) if records else ())
        if not any(one.source == fault.source and one.first_s > fault.first_s - tuning.silent_s for fault in doubted)
    ))  # fmt: skip


def _companions(own: Followed, others: Sequence[Followed], tuning: Tuning) -> Iterator[tuple[Followed, int]]:
    """Those that were one object with it for a while, and the place of the last such instant."""
    for other in others:
        both, i, j = np.intersect1d(own.at, other.at, return_indices=True)
        together = own.object[i] == other.object[j]
        if together.sum() >= tuning.known_instants:
            yield other, int(both[together][-1])


def _dragged(
    own: Followed, others: Sequence[Followed], feeds: Sequence[Feed], instants: FloatArray, tuning: Tuning
) -> Iterator[Fault]:
    """The track says it is elsewhere than the sensors that knew it go on seeing the ship."""
    stay, begins = [], []
    after = np.zeros(len(own.at), bool)
    for other, last in _companions(own, others, tuning):
        both, i, j = np.intersect1d(own.at, other.at, return_indices=True)
        away = np.sum((own.place[i] - other.place[j]) ** 2, axis=1) / (own.variance[i] + other.variance[j])
        apart = (both > last) & (away > tuning.apart_sigmas**2)
        # A sensor that tracks it anew tells it is there: the track was lost, not the ship.
        if apart.sum() >= tuning.apart_instants and apart[-1]:
            stay.append((other, float(np.sqrt(np.sum((own.place[i[-1]] - other.place[j[-1]]) ** 2)))))
            begins.append(int(both[apart][0]))
            after |= own.at >= both[apart][0]
    if not stay:
        return
    alone = after & ~_seen(own, others)
    if alone.sum() < 0.8 * after.sum():
        return
    empty = sum(
        min(float(-np.log(feed.q_at(own.place[alone], float(instants[own.at[alone][0]]))).sum()), tuning.empty_vote)
        for feed in feeds
        if feed.sensor_m is not None and feed.description.kind not in LASTING and feed.reports.track is not None
    )
    sensors = sorted({feeds[other.source].description.name for other, _ in stay})
    log_odds = math.log(tuning.dragged_odds) + empty - (len(sensors) - 1) * math.log(tuning.swap)
    name, first = feeds[own.source].description.name, float(instants[min(begins)])
    words = (
        f"{name} reports {own.track} at one place, {' and '.join(sensors)} {'sees' if len(sensors) == 1 else 'see'} it "
        f"at another, {max(away for _, away in stay):.0f} m away at the end, and nothing at the place reported; its "
        "positions are forged or faulty"
    )
    yield Fault("dragged", name, first, float(instants[own.at[-1]]), log_odds, words, own.track)


def _seen(own: Followed, others: Sequence[Followed]) -> BoolArray:
    """(k,) whether another source's track is one object with it."""
    out = np.zeros(len(own.at), bool)
    for other in others:
        _, i, j = np.intersect1d(own.at, other.at, return_indices=True)
        out[i[own.object[i] == other.object[j]]] = True
    return out


def _silent(
    own: Followed, others: Sequence[Followed], feeds: Sequence[Feed], instants: FloatArray, tuning: Tuning
) -> Iterator[Fault]:
    """The track says nothing more, while its source speaks on and a sensor goes on seeing the ship."""
    reports = feeds[own.source].reports
    assert reports.track is not None
    mine = reports.track.astype(str) == own.track
    times = np.unique(reports.time_s[mine])
    if len(times) < tuning.known_reports:
        return
    pauses, end = np.diff(times), float(reports.time_s.max())
    longest = float(pauses.max())
    seen_until, sensors = -math.inf, set()
    for other, last in _companions(own, others, tuning):
        if instants[last] < times[-1] - longest or other.at[-1] <= last:
            continue
        # The same track of the sensor goes on, at every instant or nearly so.
        until = float(instants[other.at[-1]])
        if np.sum(other.at > last) < 0.8 * (other.at[-1] - last):
            continue
        seen_until = max(seen_until, until)
        sensors.add(feeds[other.source].description.name)
    silent_s = min(seen_until, end) - float(times[-1])
    if silent_s < tuning.silent_s or not sensors:
        return
    log_odds = log_odds_of_silence(silent_s, longest, len(pauses), tuning.silent_odds)
    name = feeds[own.source].description.name
    words = (
        f"{name}: {own.track} has gone silent: {' and '.join(sorted(sensors))} saw it for {silent_s:.0f} s more, its "
        f"longest pause before was {longest:.3g} s"
    )
    yield Fault("silent", name, float(times[-1]), min(seen_until, end), min(log_odds, 50.0), words, own.track)

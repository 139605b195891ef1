"""Duplicate ids: reports of one id that cannot be of one object, since nothing moves between the places so fast.

An MMSI typed into two ships' transponders, a forged address, a track number used again: the source has one id for two
objects. :func:`split_duplicate_ids` gives each object a track of its own, so that both stay in the picture and the
alarms can say that they show one identity. A single report far from all others of its id is an error of the link and
is not used.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.representation import counted
from sameas.tracks.alignment import States
from sameas.tracks.tuning import DEFAULT_TUNING, Tuning


def split_duplicate_ids(
    reports: States, speed_m_per_s: float, tuning: Tuning = DEFAULT_TUNING, *, doubtful_s: float = 0.0
) -> tuple[States, tuple[str, ...]]:
    """The reports with a track for every object of a duplicate id, and printable notes.

    Parameters
    ----------
    reports : of one source; without track ids they are returned unchanged.
    speed_m_per_s : usual speed of its objects, motion.speed_m_per_s of the description.
    doubtful_s : by how much the stamps of two reports may disagree: the clock is doubted before the identity.
    """
    if reports.track is None or not len(reports):
        return reports, ()
    limit = tuning.fastest * speed_m_per_s
    usable = np.flatnonzero(reports.usable)
    names, number = np.unique(reports.track[usable].astype(str), return_inverse=True)
    order = np.lexsort([reports.time_s[usable], number])
    rows, owner = usable[order], number[order]
    radius = (
        tuning.place_sigmas * np.sqrt(np.trace(reports.covariance[rows, :2, :2], axis1=1, axis2=2))
        + 0.5 * doubtful_s * limit
    )
    leaps = _too_far(reports, rows[:-1], rows[1:], radius[:-1] + radius[1:], limit) & (owner[1:] == owner[:-1])
    track, state, notes = reports.track.astype(object), reports.state.copy(), []
    for k in np.unique(owner[1:][leaps]):
        own = np.flatnonzero(owner == k)
        branch = _branches(reports, rows[own], radius[own], limit)
        count = np.bincount(branch)
        stray, true = count[branch] == 1, np.flatnonzero(count > 1)
        if np.count_nonzero(np.diff(branch[~stray])) < tuning.alternations:
            true = true[:1]
        for place, one in enumerate(true[1:], start=2):
            track[rows[own[branch == one]]] = f"{names[k]} ({place})"
        if len(true):
            state[rows[own[stray]]] = np.nan
        notes += _notes(str(names[k]), len(true), int(stray.sum()))
    return States(reports.time_s, state, reports.covariance, track, reports.rows), tuple(notes)


def _too_far(reports: States, first: IntArray, second: IntArray, radius: FloatArray, limit: float) -> BoolArray:
    """(k,) whether the second report of each two lies beyond the reach of the first."""
    way = np.linalg.norm(reports.state[second, :2] - reports.state[first, :2], axis=1)
    return np.asarray(way > radius + limit * np.abs(reports.time_s[second] - reports.time_s[first]))


def _branches(reports: States, rows: IntArray, radius: FloatArray, limit: float) -> IntArray:
    """(k,) number of the object of each report of one id: the nearest of those that can have moved there."""
    ends: list[int] = []
    branch = np.zeros(len(rows), np.int64)
    for at, row in enumerate(rows):
        last_rows = np.array(ends, np.int64)
        away = np.full(len(last_rows), math.inf)
        if len(last_rows):
            before = rows[last_rows]
            far = _too_far(reports, before, np.full(len(last_rows), row), radius[last_rows] + radius[at], limit)
            ahead = reports.state[before, :2] + reports.state[before, 2:] * (
                reports.time_s[row] - reports.time_s[before, None]
            )
            away = np.where(far, math.inf, np.linalg.norm(ahead - reports.state[row, :2], axis=1))
        if len(last_rows) and away.min() < math.inf:
            branch[at] = int(away.argmin())
            ends[branch[at]] = at
        else:
            branch[at] = len(ends)
            ends.append(at)
    return branch


def _notes(name: str, objects: int, strays: int) -> list[str]:
    notes = []
    if objects > 1:
        notes.append(f"{name} is reported at {objects} places too far apart for one object: split into one track each")
    if strays and objects:
        notes.append(f"{counted(strays, 'report')} of {name} set aside: no object moves that fast")
    return notes


@dataclass
class Branches:
    """The objects of one id as its reports arrive: as :func:`split_duplicate_ids`, but not knowing what follows.

    A report beyond the reach of all objects of the id is set aside until another one is there too. From then on the id
    is at two places; each object has a track of its own once the reports have changed between them ``alternations``
    times. Before that the id may have gone to another object, and its track goes with it.

    ends : time, state and radius of the last report of each object. counts : its reports. last : the object of the last
    report of those with two or more. changes : how often that one changed.
    """

    ends: list[tuple[float, FloatArray, float]] = field(default_factory=list)
    counts: list[int] = field(default_factory=list)
    last: int = 0
    changes: int = 0

    @classmethod
    def of(cls, time_s: float, state: FloatArray, radius: float) -> Branches:
        """Of one object with its last report."""
        return cls([(time_s, state, radius)], [2])

    def add(
        self, time_s: float, state: FloatArray, radius: float, limit: float, tuning: Tuning = DEFAULT_TUNING
    ) -> int | None:
        """The object of a report, 0 for the first or while the id may just have moved; None where it is set aside."""
        away = [self._away(end, time_s, state, radius, limit) for end in self.ends]
        nearest = int(np.argmin(away))
        if math.isinf(away[nearest]):
            self.ends.append((time_s, state, radius))
            self.counts.append(1)
            return None
        self.counts[nearest] += 1
        if time_s >= self.ends[nearest][0]:
            self.ends[nearest] = (time_s, state, radius)
        self.changes += nearest != self.last
        self.last = nearest
        if self.changes < tuning.alternations:
            return 0
        return int(np.count_nonzero(np.array(self.counts[:nearest]) > 1))

    def single(self, time_s: float, memory_s: float) -> bool:
        """Whether only one object is left; those without a report for ``memory_s`` are forgotten."""
        keep = [k for k, end in enumerate(self.ends) if time_s - end[0] <= memory_s]
        if len(keep) == 1 and self.changes == 0:
            return True
        stray = [k for k in range(len(self.ends)) if k not in keep and self.counts[k] == 1]
        for k in reversed(stray):
            del self.ends[k], self.counts[k]
            self.last -= k < self.last
        return len(self.ends) == 1 and self.changes == 0

    @staticmethod
    def _away(
        end: tuple[float, FloatArray, float], time_s: float, state: FloatArray, radius: float, limit: float
    ) -> float:
        """Metres from where that object would be now; infinite beyond its reach."""
        then, before, reach = end
        dt = time_s - then
        way = float(np.hypot(*(state[:2] - before[:2])))
        if way > reach + radius + limit * abs(dt):
            return math.inf
        return float(np.hypot(*(before[:2] + before[2:] * dt - state[:2])))

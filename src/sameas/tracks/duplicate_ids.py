"""Duplicate ids: reports of one id that are of two objects, since no object moves that fast.

An MMSI entered into two ships' transponders, a forged address, a reused track number: the source has one id for two
objects. :func:`split_duplicate_ids` gives each object its own track, so that both stay in the picture and an alarm can
name the shared identity; :class:`Branches` does so while the reports arrive. A single report far from all others of its
id is a transmission error and is ignored.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.representation import counted
from sameas.tracks.alignment import States, named_tracks

#: Maximum speed, in units of the typical speed of the source's objects (1σ per axis). An object that states a speed may
#: move at STATED_SPEEDS times it, whatever the maximum speed is.
MAX_SPEED_SIGMAS, STATED_SPEEDS = 5.0, 1.5
#: An id belongs to two objects if its reports change between their places at least this often; a single change is a
#: repeated position or a reused id.
ALTERNATIONS = 4
SUPPORT_INTERVALS = 10.0  # a report supports another one of a second object of its id within so many usual intervals
POSITION_SIGMAS = 6.0  # tolerance of positions
WAY_M_PER_S = 1.0  # speed above which a hull lies along the course


def split_duplicate_ids(
    reports: States, speed_m_per_s: float, *, doubtful_s: float = 0.0
) -> tuple[States, tuple[str, ...]]:
    """The reports with one track per object of a duplicate id, and printable notes.

    reports : of one source; without track ids they are returned unchanged.
    speed_m_per_s : usual speed of its objects, motion.speed_m_per_s of the description.
    doubtful_s : possible error of the time between two reports, for sources with a doubtful clock.
    """
    if reports.track is None or not len(reports):
        return reports, ()
    limit = MAX_SPEED_SIGMAS * speed_m_per_s
    usable = np.flatnonzero(reports.usable)
    names, number = named_tracks(reports.track[usable])
    order = np.lexsort([reports.time_s[usable], number])
    rows, owner = usable[order], number[order]
    radius = (
        POSITION_SIGMAS * np.sqrt(np.trace(reports.covariance[rows, :2, :2], axis1=1, axis2=2))
        + 0.5 * doubtful_s * limit
    )
    jumps = _too_far(reports, rows[:-1], rows[1:], radius[:-1] + radius[1:], limit) & (owner[1:] == owner[:-1])
    track, state, notes = reports.track.astype(object), reports.state.copy(), []
    for k in np.unique(owner[1:][jumps]):
        own = np.flatnonzero(owner == k)
        branch = _branches(reports, rows[own], radius[own], limit)
        is_outlier = ~_supported(reports, rows[own], radius[own], branch, limit)
        objects = np.flatnonzero(np.bincount(branch, ~is_outlier))
        if np.count_nonzero(np.diff(branch[~is_outlier])) < ALTERNATIONS:
            objects = objects[:1]
        for nth, of_object in enumerate(objects[1:], start=2):
            track[rows[own[branch == of_object]]] = f"{names[k]} ({nth})"
        if len(objects):
            state[rows[own[is_outlier]]] = np.nan
        notes += _notes(names[k], len(objects), int(is_outlier.sum()))
    return States(reports.time_s, state, reports.covariance, track, reports.rows), tuple(notes)


def fastest(limit: float, first: FloatArray, second: FloatArray) -> FloatArray:
    """(k,) greatest speed, m/s, between two states (k, 4): the limit, or what the speeds that they state allow.

    A rescue helicopter among ships states her speed by AIS. limit : of the objects that state none.
    """
    stated = np.maximum(np.hypot(first[:, 2], first[:, 3]), np.hypot(second[:, 2], second[:, 3]))
    return np.fmax(limit, STATED_SPEEDS * stated)


def _too_far(reports: States, first: IntArray, second: IntArray, radius: FloatArray, limit: float) -> BoolArray:
    """(k,) whether the second report of each pair is out of reach of the first."""
    a, b = reports.state[first], reports.state[second]
    reach = radius + fastest(limit, a, b) * np.abs(reports.time_s[second] - reports.time_s[first])
    return np.asarray(np.linalg.norm(b[:, :2] - a[:, :2], axis=1) > reach)


def _branches(reports: States, rows: IntArray, radius: FloatArray, limit: float) -> IntArray:
    """(k,) number of the object of each report of one id: the nearest one that can have moved there."""
    ends: list[int] = []
    branch = np.zeros(len(rows), np.int64)
    for at, row in enumerate(rows):
        last_rows = np.array(ends, np.int64)
        distance = np.full(len(last_rows), math.inf)
        if len(last_rows):
            before = rows[last_rows]
            far = _too_far(reports, before, np.full(len(last_rows), row), radius[last_rows] + radius[at], limit)
            predicted = reports.state[before, :2] + reports.state[before, 2:] * (
                reports.time_s[row] - reports.time_s[before, None]
            )
            distance = np.where(far, math.inf, np.linalg.norm(predicted - reports.state[row, :2], axis=1))
        if len(last_rows) and distance.min() < math.inf:
            branch[at] = int(distance.argmin())
            ends[branch[at]] = at
        else:
            branch[at] = len(ends)
            ends.append(at)
    return branch


def _supported(reports: States, rows: IntArray, radius: FloatArray, branch: IntArray, limit: float) -> BoolArray:
    """(k,) whether another report of its object supports each report of one id.

    Wrong positions are not where one another's speeds lead, and come rarely. So a report of another object than the
    main one, which has most reports, is supported by the one before or after it only within ``SUPPORT_INTERVALS`` of
    the id's usual interval, and if the stated speeds lead from one to the other.
    """
    count = np.bincount(branch)
    out = (branch == count.argmax()) & (count[branch] > 1)
    # Two objects with one id may report at the same times.
    gaps_s = np.diff(np.unique(reports.time_s[rows]))
    usual_s = float(np.median(gaps_s)) if len(gaps_s) else 0.0
    for other in np.flatnonzero((count > 1) & (np.arange(len(count)) != count.argmax())):
        own = np.flatnonzero(branch == other)
        first, second = own[:-1], own[1:]
        a, b = reports.state[rows[first]], reports.state[rows[second]]
        dt = reports.time_s[rows[second]] - reports.time_s[rows[first]]
        stated = np.maximum(np.hypot(*a[:, 2:].T), np.hypot(*b[:, 2:].T))
        speed = np.where(stated > WAY_M_PER_S, STATED_SPEEDS * stated, limit)
        near = np.hypot(*(b - a)[:, :2].T) <= radius[first] + radius[second] + speed * dt
        near &= dt <= SUPPORT_INTERVALS * usual_s
        out[first[near]] = out[second[near]] = True
    return np.asarray(out)


def _notes(name: str, objects: int, strays: int) -> list[str]:
    notes = []
    if objects > 1:
        notes.append(f"{name} is reported at {objects} places too far apart for one object: split into one track each")
    if strays and objects:
        notes.append(f"{counted(strays, 'report')} of {name} set aside: no object moves that fast")
    return notes


@dataclass
class Branches:
    """The objects of one id while its reports arrive: :func:`split_duplicate_ids` without later reports.

    A report out of reach of all objects of the id is excluded until a second one confirms its place; then the id has
    two objects. Each gets its own track once the reports have alternated between them ``ALTERNATIONS`` times; before
    that the id may have gone to another object, and its track with it.

    ends : time, state and radius of the last report of each object. counts : number of its reports. last : the object
    of the last report that was not excluded. changes : how often that object changed.
    """

    ends: list[tuple[float, FloatArray, float]] = field(default_factory=list)
    counts: list[int] = field(default_factory=list)
    last: int = 0
    changes: int = 0

    @classmethod
    def of(cls, time_s: float, state: FloatArray, radius: float) -> Branches:
        """One object, with its last report."""
        return cls([(time_s, state, radius)], [2])

    def add(self, time_s: float, state: FloatArray, radius: float, limit: float) -> int | None:
        """The object of a report: 0 for the first one, or while the id may just have moved; None if excluded."""
        distance = [self._distance_m(end, time_s, state, radius, limit) for end in self.ends]
        nearest = int(np.argmin(distance))
        if math.isinf(distance[nearest]):
            self.ends.append((time_s, state, radius))
            self.counts.append(1)
            return None
        self.counts[nearest] += 1
        if time_s >= self.ends[nearest][0]:
            self.ends[nearest] = (time_s, state, radius)
        self.changes += nearest != self.last
        self.last = nearest
        if self.changes < ALTERNATIONS:
            return 0
        return int(np.count_nonzero(np.array(self.counts[:nearest]) > 1))

    def single(self, time_s: float, memory_s: float) -> bool:
        """Whether only one object remains, after dropping outliers older than ``memory_s``."""
        keep = [k for k, end in enumerate(self.ends) if time_s - end[0] <= memory_s]
        if len(keep) == 1 and self.changes == 0:
            return True
        outliers = [k for k in range(len(self.ends)) if k not in keep and self.counts[k] == 1]
        for k in reversed(outliers):
            del self.ends[k], self.counts[k]
            self.last -= k < self.last
        return len(self.ends) == 1 and self.changes == 0

    @staticmethod
    def _distance_m(
        end: tuple[float, FloatArray, float], time_s: float, state: FloatArray, radius: float, limit: float
    ) -> float:
        """The distance from the predicted place of an object; infinite if out of its reach."""
        last_s, last, last_radius = end
        dt, limit = time_s - last_s, float(fastest(limit, last[None], state[None])[0])
        if float(np.hypot(*(state[:2] - last[:2]))) > last_radius + radius + limit * abs(dt):
            return math.inf
        return float(np.hypot(*(last[:2] + last[2:] * dt - state[:2])))

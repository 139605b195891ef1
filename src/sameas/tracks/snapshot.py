"""Snapshot: the last reports of one source moved to an instant, as records or observations for the core."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from sameas.arrays import FloatArray, IntArray
from sameas.many.observations import LinearPart, Observations, Source
from sameas.records import Records
from sameas.space import Plane
from sameas.tracks.alignment import Earlier, States, aged, moved, process_noise, stamped_late
from sameas.tracks.feed import Feed
from sameas.tracks.placement import Directions, SlowBearing
from sameas.tracks.scans import last_exposure, last_rotation

# Pointing: at which of the places that others show a direction may point.
#
# A direction knows no distance, but much depends on it: metres of hull or of motion are more degrees the nearer the
# object, and a camera sees far boats less often than near ones. The places where other sources show something tell.

#: A direction points at places within 3 standard deviations (chosen).
REACH_SIGMA = 3.0


def pointed_at(
    bearing_deg: FloatArray, sigma_deg: ArrayLike, sensor_m: ArrayLike, places: FloatArray, extent_m: float
) -> FloatArray:
    """(n, p) probability that each direction points at each place, if at one of them; rows of 0 where at none.

    Parameters
    ----------
    bearing_deg, sigma_deg : (n,) directions, clockwise from the plane's north, and their 1σ.
    sensor_m : (2,) from where. places : (p, 2) in the plane.
    extent_m : by how much the point that is seen strays from the middle of the object, 1σ.

    Example
    -------
    >>> boats = np.array([[0.0, 100.0], [5.0, 300.0], [90.0, 0.0]])
    >>> pointed_at(np.array([0.0, 180.0]), 1.0, (0.0, 0.0), boats, 2.0).round(2).tolist()
    [[0.51, 0.49, 0.0], [0.0, 0.0, 0.0]]
    """
    weight = np.zeros((len(bearing_deg), len(places)))
    if not weight.size:
        return weight
    arm = places - np.asarray(sensor_m)
    away = np.maximum(np.hypot(*arm.T), 1.0)
    off = (np.asarray(bearing_deg)[:, None] - np.degrees(np.arctan2(arm[:, 0], arm[:, 1])) + 180.0) % 360.0 - 180.0
    sigma = np.hypot(np.broadcast_to(sigma_deg, len(bearing_deg))[:, None], np.degrees(np.arctan2(extent_m, away)))
    inside = np.abs(off) < REACH_SIGMA * sigma
    weight[inside] = (np.exp(-0.5 * (off / sigma) ** 2) / sigma)[inside]
    total = weight.sum(axis=1, keepdims=True)
    return np.asarray(np.divide(weight, total, out=weight, where=total > 0.0))


#: What an object's state is at an instant: a place, or a place and a velocity.
POSITION = 2
POSITION_AND_VELOCITY = 4


@dataclass(frozen=True)
class Snapshot:
    """What one source says at an instant: its reports, moved; ``rows`` of the feed's reports."""

    feed: Feed
    rows: IntArray
    time_s: FloatArray
    state: FloatArray
    covariance: FloatArray
    aged: IntArray

    @classmethod
    def of(cls, feed: Feed, instant_s: float) -> Snapshot:
        reports, description = feed.reports, feed.description
        if reports.track is None and feed.rotation is not None:
            rows = last_rotation(reports.time_s, feed.rotation, feed.scan_times_s, instant_s)
        elif reports.track is None:
            rows = last_exposure(feed.scan_s, feed.scan_times_s, instant_s)
        else:
            rows = feed.succession.at(instant_s)
            rows = rows[instant_s - reports.time_s[rows] <= feed.track_timeout_s]
        rows = rows[reports.usable[rows]]
        time_s, none = reports.time_s[rows], np.empty(0, np.int64)
        if isinstance(reports, Directions):
            return cls(feed, rows, time_s, reports.bearing_deg[rows], reports.sigma_deg[rows] ** 2, none)
        late = description.timing.latency_sigma_s or 0.0
        state, covariance = moved(
            reports.state[rows], reports.covariance[rows], instant_s - time_s, feed.walk_m2_per_s3[rows]
        )
        return cls(feed, rows, time_s, state, stamped_late(covariance, state, late), none)

    def without_aged(self, density: float) -> Snapshot:
        """The same without the reports that tell objects apart no more."""
        if isinstance(self.feed.reports, Directions) or not len(self.rows):
            return self
        old = aged(self.covariance, density)
        keep = ~old
        return Snapshot(
            self.feed, self.rows[keep], self.time_s[keep], self.state[keep], self.covariance[keep], self.rows[old]
        )

    def source(self, instant_s: float, features: int, places: FloatArray) -> Source:
        """Records or observations for the core."""
        name, ids = self.feed.description.name, self.feed.reports.rows[self.rows]
        if isinstance(self.feed.reports, Directions):
            return self._bearings(instant_s, features, places)
        if features == POSITION or self.feed.tells_velocities:
            cut = slice(None, features)
            return Records.of(self.state[:, cut], covariance=self.covariance[:, cut, cut], ids=ids, source=name)
        return self._plots(instant_s)

    def _plots(self, instant_s: float) -> Observations:
        """Bare positions, as observations of where an object with a velocity was when the source looked."""
        description, reports = self.feed.description, self.feed.reports
        assert isinstance(reports, States)
        age = instant_s - float(self.time_s.mean()) if len(self.rows) else 0.0
        rest = instant_s - age - self.time_s
        walk = self.feed.walk_m2_per_s3[self.rows]
        state, covariance = moved(reports.state[self.rows], reports.covariance[self.rows], rest, walk)
        late = (description.motion.speed_m_per_s or 0.0) * (description.timing.latency_sigma_s or 0.0)
        wander = process_noise(np.full(len(walk), age), walk)[:, :2, :2] + late**2 * np.eye(2)
        covariance = covariance[:, :2, :2] + wander
        records = Records.of(state[:, :2], covariance=covariance, ids=reports.rows[self.rows], source=description.name)
        return Observations(records, LinearPart(np.hstack([np.eye(2), -age * np.eye(2)])))

    def _bearings(self, instant_s: float, features: int, places: FloatArray) -> Observations:
        """Directions to where an object was when the source looked."""
        description, reports = self.feed.description, self.feed.reports
        reach = description.coverage.range_m or math.inf
        away = self._ranges(places, reach)
        age = instant_s - float(self.time_s.mean()) if len(self.rows) else 0.0
        # Where the velocity is a feature the object is seen where it was; else it has gone on by so much.
        dt = instant_s - self.time_s - (age if features == POSITION_AND_VELOCITY else 0.0)
        strayed = (description.motion.speed_m_per_s or 0.0) * np.hypot(dt, description.timing.latency_sigma_s or 0.0)
        open_ = np.degrees(np.arctan2(np.hypot(strayed, description.errors.extent_m or 0.0), away))
        records = Records.of(
            self.state[:, None], variance=(self.covariance + open_**2)[:, None], ids=reports.rows[self.rows],
            source=description.name, space=Plane(periods=(360.0,)),
        )  # fmt: skip
        bearing = SlowBearing(self.sensor(), features, max(description.coverage.nearest_m, 0.02 * min(reach, 1e6)))
        return Observations(records, Earlier(bearing, age) if features == POSITION_AND_VELOCITY else bearing)

    def _ranges(self, places: FloatArray, reach_m: float) -> FloatArray:
        """(n,) how far what each direction points at may be, by the places that others show where it points.

        Metres are most degrees at the nearest: it is the distance at which they are as many degrees in the mean square.
        Half the reach where no other source shows anything there.
        """
        extent = self.feed.description.errors.extent_m or 0.0
        weight = pointed_at(self.state, np.sqrt(self.covariance), self.sensor(), places, extent)
        out = np.full(len(self.rows), reach_m / 2.0)
        some = weight.any(axis=1)
        away = np.maximum(np.hypot(*(places - np.asarray(self.sensor())).T), 1.0)
        out[some] = (weight[some] @ away**-2.0) ** -0.5
        return out

    def sensor(self) -> tuple[float, float]:
        """Where the sensor was: one place at an instant, that of its last report."""
        at = self.feed.sensor_m
        if at is None or not len(at):
            return 0.0, 0.0
        last = at[self.rows[np.argmax(self.time_s)] if len(self.rows) else 0]
        return float(last[0]), float(last[1])

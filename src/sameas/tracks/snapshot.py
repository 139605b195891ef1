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
from sameas.tracks.tuning import DEFAULT_TUNING, Tuning


def pointed_at(
    bearing_deg: FloatArray,
    sigma_deg: ArrayLike,
    sensor_m: ArrayLike,
    places: FloatArray,
    extent_m: float,
    tuning: Tuning = DEFAULT_TUNING,
) -> FloatArray:
    """(n, p) probability that each direction points at each place, if at one of them; rows of 0 where at none.

    A direction has no distance, but much depends on it: metres of hull or of motion are more degrees the nearer the
    object, and a camera sees far boats less often than near ones. The places where other sources show objects give it.

    Parameters
    ----------
    bearing_deg, sigma_deg : (n,) directions, clockwise from the plane's north, and their 1σ.
    sensor_m : (2,) place of the sensor. places : (p, 2) in the plane.
    extent_m : 1σ of the visible point about the centre of the object.

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
    inside = np.abs(off) < tuning.pointing_sigmas * sigma
    weight[inside] = (np.exp(-0.5 * (off / sigma) ** 2) / sigma)[inside]
    total = weight.sum(axis=1, keepdims=True)
    return np.asarray(np.divide(weight, total, out=weight, where=total > 0.0))


#: Features of an object at an instant: its position, or its position and velocity.
POSITION = 2
POSITION_AND_VELOCITY = 4


@dataclass(frozen=True)
class Snapshot:
    """The reports of one source moved to an instant; ``rows`` of the feed's reports."""

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
        usable = reports.usable[rows] if isinstance(reports, Directions) else reports.usable_of(rows)
        rows = rows[usable]
        time_s, none = reports.time_s[rows], np.empty(0, np.int64)
        if isinstance(reports, Directions):
            return cls(feed, rows, time_s, reports.bearing_deg[rows], reports.sigma_deg[rows] ** 2, none)
        late = description.timing.latency_sigma_s or 0.0
        state, covariance = moved(
            reports.state[rows], reports.covariance[rows], instant_s - time_s, feed.walk_m2_per_s3[rows]
        )
        return cls(feed, rows, time_s, state, stamped_late(covariance, state, late), none)

    def without_aged(self, density: float) -> Snapshot:
        """The same without the reports that are too uncertain to distinguish objects."""
        if isinstance(self.feed.reports, Directions) or not len(self.rows):
            return self
        old = aged(self.covariance, density)
        if not old.any():
            return self
        keep = ~old
        return Snapshot(
            self.feed, self.rows[keep], self.time_s[keep], self.state[keep], self.covariance[keep], self.rows[old]
        )

    def source(self, instant_s: float, features: int, places: FloatArray) -> Source:
        """Records or observations for the core."""
        name, ids = self.feed.description.name, self.feed.reports.rows[self.rows]
        if isinstance(self.feed.reports, Directions):
            return self._bearings(instant_s, features, places)
        if features == POSITION or self.feed.has_velocities:
            cut = slice(None, features)
            return Records.of(self.state[:, cut], covariance=self.covariance[:, cut, cut], ids=ids, source=name)
        return self._plots(instant_s)

    def _plots(self, instant_s: float) -> Observations:
        """Bare positions, as observations of the place of a moving object at the time of the scan."""
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
        """Directions to the place of an object at the time of the scan."""
        description, reports = self.feed.description, self.feed.reports
        range_m = description.coverage.range_m or math.inf
        away = self._ranges(places, range_m)
        age = instant_s - float(self.time_s.mean()) if len(self.rows) else 0.0
        # With velocities as features the observation is of the earlier place; else the motion since adds to its error.
        dt = instant_s - self.time_s - (age if features == POSITION_AND_VELOCITY else 0.0)
        moved_m = (description.motion.speed_m_per_s or 0.0) * np.hypot(dt, description.timing.latency_sigma_s or 0.0)
        spread_deg = np.degrees(np.arctan2(np.hypot(moved_m, description.errors.extent_m or 0.0), away))
        records = Records.of(
            self.state[:, None], variance=(self.covariance + spread_deg**2)[:, None], ids=reports.rows[self.rows],
            source=description.name, space=Plane(periods=(360.0,)),
        )  # fmt: skip
        bearing = SlowBearing(self.sensor(), features, max(description.coverage.nearest_m, 0.02 * min(range_m, 1e6)))
        return Observations(records, Earlier(bearing, age) if features == POSITION_AND_VELOCITY else bearing)

    def _ranges(self, places: FloatArray, reach_m: float) -> FloatArray:
        """(n,) the range of what each direction points at, by the places of other sources' records in it.

        It is the range at which a metre is as many degrees as in the mean square over those places; half the sensor's
        range where no other source has a record there.
        """
        extent = self.feed.description.errors.extent_m or 0.0
        weight = pointed_at(self.state, np.sqrt(self.covariance), self.sensor(), places, extent, self.feed.tuning)
        out = np.full(len(self.rows), reach_m / 2.0)
        some = weight.any(axis=1)
        away = np.maximum(np.hypot(*(places - np.asarray(self.sensor())).T), 1.0)
        out[some] = (weight[some] @ away**-2.0) ** -0.5
        return out

    def sensor(self) -> tuple[float, float]:
        """The place of the sensor at the instant, that of its last report."""
        at = self.feed.sensor_m
        if at is None or not len(at):
            return 0.0, 0.0
        last = at[self.rows[np.argmax(self.time_s)] if len(self.rows) else 0]
        return float(last[0]), float(last[1])

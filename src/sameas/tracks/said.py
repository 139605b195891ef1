"""What one source says at an instant: its last reports moved there, as records or observations for the core."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sameas.observations import LinearPart, Observations, Source
from sameas.records import FloatArray, IntArray, Records
from sameas.space import Plane
from sameas.tracks.alignment import Earlier, States, aged, moved, process_noise, stamped_late
from sameas.tracks.feed import Feed
from sameas.tracks.looks import last_look, last_turn
from sameas.tracks.placement import Directions, Sight
from sameas.tracks.pointing import pointed_at

#: What an object's state is at an instant: a place, or a place and a velocity.
POSITION, POSITION_AND_VELOCITY = 2, 4


@dataclass(frozen=True)
class Said:
    """What one source says at an instant: its reports, moved; ``rows`` of the feed's reports."""

    feed: Feed
    rows: IntArray
    time_s: FloatArray
    state: FloatArray
    covariance: FloatArray
    aged: IntArray

    @classmethod
    def of(cls, feed: Feed, instant_s: float) -> Said:
        reports, description = feed.reports, feed.description
        if reports.track is None and feed.turn is not None:
            rows = last_turn(reports.time_s, feed.turn, feed.looked_s, instant_s)
        elif reports.track is None:
            rows = last_look(feed.look_s, feed.looked_s, instant_s)
        else:
            rows = feed.succession.at(instant_s)
            rows = rows[instant_s - reports.time_s[rows] <= feed.ending_silence_s]
        rows = rows[reports.usable[rows]]
        time_s, none = reports.time_s[rows], np.empty(0, np.int64)
        if isinstance(reports, Directions):
            return cls(feed, rows, time_s, reports.bearing_deg[rows], reports.sigma_deg[rows] ** 2, none)
        late = description.timing.latency_sigma_s or 0.0
        state, covariance = moved(
            reports.state[rows], reports.covariance[rows], instant_s - time_s, feed.walk_m2_per_s3[rows]
        )
        return cls(feed, rows, time_s, state, stamped_late(covariance, state, late), none)

    def without_aged(self, density: float) -> Said:
        """The same without the reports that tell objects apart no more."""
        if isinstance(self.feed.reports, Directions) or not len(self.rows):
            return self
        old = aged(self.covariance, density)
        keep = ~old
        return Said(
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
        bearing = Sight(self.sensor(), features, max(description.coverage.nearest_m, 0.02 * min(reach, 1e6)))
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

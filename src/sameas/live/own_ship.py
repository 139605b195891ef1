"""Own ship: her position and velocity at every tick, from what the settings say of her.

A fixed position; the object with her MMSI; or the sentences of her receiver on the wire of a source, or in its replayed
reports. If they say nothing, she is the ship of the first wire that has such sentences, as in a log that is replayed.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from sameas.arrays import FloatArray
from sameas.io.sensors.format import OWN_SHIP
from sameas.live.inputs import Wire
from sameas.live.settings import OwnShip, Settings
from sameas.picture.picture_state import PictureState
from sameas.tracks.coordinates import LocalPlane, geodesy
from sameas.tracks.kinds import CARRIER_KIND
from sameas.tracks.reports import Reports

#: Positions that are kept for a velocity, and seconds over which it is fitted.
KEPT_POSITIONS, FIT_S = 30, 30.0


@dataclass(frozen=True)
class OwnShipState:
    """Position (m) and velocity (m/s) of own ship in the plane; heading in degrees, NaN where unknown."""

    x_m: float
    y_m: float
    vx_m_per_s: float = 0.0
    vy_m_per_s: float = 0.0
    heading_deg: float = math.nan


class OwnShipMotion:
    """Own ship's position and velocity, tick after tick.

    settings : which ship is own ship, if any. wires : by URL; one of them may give her position. replayed : whether
        reports are replayed from files.
    """

    def __init__(self, settings: Settings, wires: Mapping[str, Wire], *, replayed: bool) -> None:
        self.settings, self.silent_s, self.replayed = settings.watch.own_ship, settings.watch.silent_s, replayed
        # Of several sources on one cable, AIS is not the one that gives her position.
        sources = sorted(settings.sources.items(), key=lambda one: one[1].description.kind == "ais")
        self._carriers = {name for name, source in sources if source.description.kind == CARRIER_KIND}
        self._wires = {name: wires[source.url] for name, source in sources if source.url and source.url in wires}
        name = None if self.settings is None else self.settings.source
        # None where her source was set aside.
        self._source = name if name in settings.sources else None
        self.wire = self._wires.get(self._source or "")
        self._replayed = ReplayedShip()
        # Time, east and north of the last positions.
        self._positions: deque[tuple[float, float, float]] = deque(maxlen=KEPT_POSITIONS)

    def take(self, name: str, reports: Reports) -> None:
        """Takes the position of the sensor from replayed reports of her source."""
        if self.replayed and self._source == name:
            self._replayed = self._replayed.after(reports)

    def at(
        self, time_s: float, clock_s: float, state: PictureState[Any], plane: LocalPlane | None
    ) -> OwnShipState | None:
        """Her state at a time of the picture; None if it is unknown, or without an own ship.

        clock_s : time of the clock, with which receive times of her sentences are compared. state : the picture then.
        """
        self._find()
        own = self.settings
        if own is None:
            return None
        if own.mmsi is not None:
            texts = state.watch.texts
            for k, number in enumerate(state.objects.number.tolist()):
                if number in texts and texts[number][0] == own.mmsi and state.objects.placed[k]:
                    return OwnShipState(*state.objects.state[k].tolist())
            return None
        if plane is None:
            return None
        heading = math.nan
        lat, lon = own.lat_deg, own.lon_deg
        if self._source is not None:
            replayed = self._replayed.at(time_s)
            lat, lon, heading = replayed if self.wire is None else self.wire.stream.own_ship
            if self.wire is not None and clock_s - self.wire.stream.own_ship_s > self.silent_s:
                # Approaches to where she was would be worse than none.
                return None
        if lat is None or lon is None or not math.isfinite(lat + lon):
            return None
        east, north = plane.of_geodetic([lat], [lon])[0].tolist()
        # A position that stays is one, too: else the first jitter of a receiver alongside is the speed of a ship.
        last = self._positions[-1] if self._positions else None
        if last is None or last[1:] != (east, north) or time_s - last[0] >= 1.0:
            self._positions.append((time_s, east, north))
        velocity = self._given_velocity()
        if velocity is None:
            vx, vy = self._fitted_velocity(time_s)
        else:
            # By true north; away from the plane's origin that is not the plane's.
            vx, vy = (plane.jacobian([lat], [lon])[0] @ velocity).tolist()
        return OwnShipState(east, north, vx, vy, heading)

    def _find(self) -> None:
        """Takes the first wire with her position, if the settings do not say who she is."""
        if self.settings is not None:
            return
        for name, wire in self._wires.items():
            if math.isfinite(wire.stream.own_ship[0]):
                self.settings, self._source, self.wire = OwnShip(source=name), name, wire
                return

    def silence(self, clock_s: float, began_s: float) -> str:
        """How long her position has been missing though a source is to give it; empty if it is not.

        clock_s : as of :meth:`at`. began_s : when the reception began.
        """
        own = self.settings
        if self.replayed or own is None or own.source is None:
            return ""
        last_s = began_s if self.wire is None else max(self.wire.stream.own_ship_s, began_s)
        late = clock_s - last_s > self.silent_s
        return f"{own.source} has given no position for {self.silent_s:.0f} s" if late else ""

    def source(self, clock_s: float) -> str | None:
        """The name of the source whose wire gives her position now; it need not give reports, too."""
        wire = self.wire
        if wire is None or math.isnan(wire.stream.own_ship[0]):
            return None
        return self._source if clock_s - wire.state.last_s <= self.silent_s else None

    @property
    def carrier(self) -> str | None:
        """The name of a source that gives her position, and no objects."""
        return self._source if self._source in self._carriers else None

    @property
    def mmsi(self) -> str:
        """Her MMSI as her transponder gives it; empty if it does not."""
        return "" if self.wire is None else self.wire.stream.own_mmsi

    @property
    def mmsis(self) -> tuple[str, ...]:
        """Her MMSIs, as her transponder and the settings give them."""
        given = "" if self.settings is None else self.settings.mmsi or ""
        return tuple(mmsi for mmsi in (self.mmsi, given) if mmsi)

    def _given_velocity(self) -> tuple[float, float] | None:
        """Her velocity (m/s to true east and north) as her receiver gives it; None if it does not."""
        replayed = self._replayed.speed_m_per_s, self._replayed.course_deg
        speed, course = replayed if self.wire is None else self.wire.stream.own_velocity
        if speed == 0.0 and math.isnan(course):
            # One that rests has no course.
            course = 0.0
        if not math.isfinite(speed + course):
            return None
        angle = math.radians(course)
        return speed * math.sin(angle), speed * math.cos(angle)

    def _fitted_velocity(self, time_s: float) -> tuple[float, float]:
        """Slope (m/s east, north) of a line through the last positions; 0 where they span less than 1 s."""
        recent = [one for one in self._positions if one[0] > time_s - FIT_S]
        if len(recent) < 2 or recent[-1][0] - recent[0][0] < 1.0:
            return 0.0, 0.0
        times, east, north = np.array(recent).T
        return _slope(times, np.column_stack([east, north]))


@dataclass(frozen=True)
class ReplayedShip:
    """Own ship with the last replayed report of her source; NaN where unknown.

    track : (k, 3) time, latitude and longitude at the reports of the last :data:`FIT_S` before it.
    """

    time_s: float = math.nan
    lat_deg: float = math.nan
    lon_deg: float = math.nan
    heading_deg: float = math.nan
    speed_m_per_s: float = math.nan
    course_deg: float = math.nan
    track: FloatArray = field(default_factory=lambda: np.empty((0, 3)))

    def after(self, reports: Reports) -> ReplayedShip:
        """Her state at the last of these reports that has her position, or that of the sensor; as before where none
        has."""
        columns = [reports.extra.get(name) for name in OWN_SHIP.values()]
        if columns[0] is None:
            columns = [reports.station_lat_deg, reports.station_lon_deg, reports.station_heading_deg, None, None]
        lat, lon = columns[:2]
        if lat is None or lon is None or not np.isfinite(lat + lon).any():
            return self
        placed = np.flatnonzero(np.isfinite(lat + lon))
        last = int(placed[-1])
        heading, speed, course = (math.nan if column is None else float(column[last]) for column in columns[2:])
        track = np.vstack([self.track, np.column_stack([reports.time_s, lat, lon])[placed]])
        track = track[track[:, 0] > track[-1, 0] - FIT_S]
        if not math.isfinite(speed + course):
            # By the times of the reports: at a fast pace the instants are too far apart.
            speed, course = _motion(track)
        return ReplayedShip(
            float(reports.time_s[last]), float(lat[last]), float(lon[last]), heading, speed, course, track
        )

    def at(self, time_s: float) -> tuple[float, float, float]:
        """Latitude, longitude and heading at this time, on her course since the report where it is known."""
        if not math.isfinite(self.speed_m_per_s + self.course_deg):
            return self.lat_deg, self.lon_deg, self.heading_deg
        metres = self.speed_m_per_s * min(max(time_s - self.time_s, 0.0), FIT_S)
        lat, lon, _ = geodesy().aer2geodetic(self.course_deg, 0.0, metres, self.lat_deg, self.lon_deg, 0.0)
        return float(lat), float(lon), self.heading_deg


def _motion(track: FloatArray) -> tuple[float, float]:
    """Speed (m/s) and course (degrees) of a track (k, 3) of time, latitude and longitude; NaN below 1 s of it."""
    if not len(track) or np.ptp(track[:, 0]) < 1.0:
        return math.nan, math.nan
    places = LocalPlane.about(track[-1:, 1], track[-1:, 2]).of_geodetic(track[:, 1], track[:, 2])
    east, north = _slope(track[:, 0], places)
    return math.hypot(east, north), math.degrees(math.atan2(east, north)) % 360.0


def _slope(times: FloatArray, places: FloatArray) -> tuple[float, float]:
    """Slope (m/s east, north) of the line that fits places (k, 2) at these times (k,)."""
    slope = np.polynomial.polynomial.polyfit(times - times[-1], places, 1)[1]
    return float(slope[0]), float(slope[1])

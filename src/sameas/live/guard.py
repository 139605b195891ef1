"""Guard zones on watch: an object that is inside raises an alarm.

An object's position has an error, so each alarm has the probability that the object is inside: the share of its normal
distribution within the zone, by fixed quasi-random points. An alarm begins when the probability reaches ``ENTERED``,
and lasts until it falls below ``LEFT``: an object that follows the border raises one alarm, not one a second.
"""

from __future__ import annotations

import math
from collections.abc import Container, Sequence
from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np
from scipy.special import ndtri

from sameas.arrays import BoolArray, FloatArray
from sameas.live.own_ship import OwnShipState
from sameas.live.situation import Alarm, Situation
from sameas.live.zones import Zone
from sameas.tracks.coordinates import LocalPlane

#: Probability of being inside from which an alarm begins, and below which it ends.
ENTERED, LEFT = 0.5, 0.25
#: Number of points of a position's distribution, and the σ beyond which it has none.
POINTS, REACH_SIGMAS = 512, 6.0
#: Points of the outline of a circle.
CIRCLE_POINTS = 72


def placed(zone: Zone, plane: LocalPlane | None, own: OwnShipState | None) -> PlacedZone | str:
    """The zone in the plane of the picture; why it has no place there, in words."""
    if zone.rings or not zone.about_own_ship:
        if plane is None:
            return "the picture is in metres of its own, without degrees"
        if zone.rings:
            rings = (np.array(ring) for ring in zone.rings)
            return PlacedZone(zone, tuple(plane.of_geodetic(ring[:, 1], ring[:, 0]) for ring in rings))
        centre = plane.of_geodetic(np.array([zone.lat_deg]), np.array([zone.lon_deg]))[0]
        return PlacedZone(zone, centre=centre, north_deg=plane.north_deg(centre))
    if own is None:
        return "the position of own ship is not known"
    centre = np.array([own.x_m, own.y_m])
    north = 0.0 if plane is None else plane.north_deg(centre)
    if zone.to_bow:
        north += own.heading_deg if math.isfinite(own.heading_deg) else 0.0
        if not math.isfinite(own.heading_deg):
            north = math.degrees(math.atan2(own.vx_m_per_s, own.vy_m_per_s))
            if math.hypot(own.vx_m_per_s, own.vy_m_per_s) < 0.5:
                # Without a heading and a course all around is guarded.
                zone = replace(zone, sector_deg=None)
    return PlacedZone(zone, centre=centre, north_deg=north)


@dataclass(frozen=True)
class PlacedZone:
    """A zone in the plane: rings (n, 2) in metres, or a centre (2,) and the direction from which sectors count."""

    zone: Zone
    rings: tuple[FloatArray, ...] = ()
    centre: FloatArray = field(default_factory=lambda: np.zeros(2))
    north_deg: float = 0.0

    @property
    def limits(self) -> tuple[FloatArray, FloatArray]:
        """(2,), (2,) the lower left and the upper right corner of a rectangle around it."""
        if self.rings:
            every = np.concatenate(self.rings)
            return every.min(axis=0), every.max(axis=0)
        return self.centre - self.zone.radius_m, self.centre + self.zone.radius_m

    def has(self, place: FloatArray) -> BoolArray:
        """(m,) whether places (m, 2) are inside."""
        if self.rings:
            inside = np.zeros(len(place), bool)
            for ring in self.rings:
                for (x, y), (x_to, y_to) in zip(ring, np.roll(ring, -1, axis=0), strict=True):
                    if y != y_to:
                        crosses = (y > place[:, 1]) != (y_to > place[:, 1])
                        inside ^= crosses & (place[:, 0] < x + (x_to - x) * (place[:, 1] - y) / (y_to - y))
            return inside
        arm = place - self.centre
        distance = np.hypot(*arm.T)
        inside = (distance <= self.zone.radius_m) & (distance >= self.zone.nearest_m)
        if self.zone.sector_deg is not None:
            first, last = self.zone.sector_deg
            bearing = np.degrees(np.arctan2(*arm.T)) - self.north_deg
            inside &= (bearing - first) % 360.0 <= ((last - first) % 360.0 or 360.0)
        return np.asarray(inside)

    def probability(self, place: FloatArray, covariance: FloatArray) -> FloatArray:
        """(n,) probability that objects at (n, 2), with errors (n, 2, 2), are inside; 0 without a position."""
        out = np.zeros(len(place))
        low, high = self.limits
        reach = REACH_SIGMAS * np.sqrt(np.maximum(covariance[:, 0, 0], covariance[:, 1, 1]))[:, None]
        with np.errstate(invalid="ignore"):
            near = np.flatnonzero(((place + reach >= low) & (place - reach <= high)).all(axis=1))
        if len(near):
            root = np.linalg.cholesky(covariance[near] + 1e-6 * np.eye(2))
            points = place[near, None] + np.einsum("nij,kj->nki", root, _normal_points())
            out[near] = self.has(points.reshape(-1, 2)).reshape(len(near), -1).mean(axis=1)
        return out

    def outline(self) -> list[list[list[float]]]:
        """Its lines in the plane, metres, each closed."""
        if self.rings:
            return [[*ring.round(1).tolist(), ring[0].round(1).tolist()] for ring in self.rings]
        sector = self.zone.sector_deg
        first, last = (0.0, 360.0) if sector is None else sector
        width = (last - first) % 360.0 or 360.0
        angle = np.radians(self.north_deg + first + np.linspace(0.0, width, CIRCLE_POINTS + 1))
        ray = np.column_stack([np.sin(angle), np.cos(angle)])
        outer, inner = (self.centre + radius * ray for radius in (self.zone.radius_m, self.zone.nearest_m))
        if width == 360.0:
            lines = [outer, *([inner] if self.zone.nearest_m else [])]
        else:
            lines = [np.concatenate([outer, inner[::-1] if self.zone.nearest_m else self.centre[None], outer[:1]])]
        return [line.round(1).tolist() for line in lines]


@cache
def _normal_points() -> FloatArray:
    """(POINTS, 2) points of the standard normal distribution in the plane: a Sobol sequence."""
    from scipy.stats import qmc

    even = qmc.Sobol(2, scramble=False).random_base2(POINTS.bit_length() - 1)
    # Shifted to the middles of its cells: none is at infinity.
    return np.asarray(ndtri(even + 0.5 / POINTS))


@dataclass
class GuardZones:
    """The alarms of guard zones, tick after tick.

    zones : as given. outlines : name and lines (metres) of each at the last tick, for the map.
    """

    zones: tuple[Zone, ...]
    outlines: list[tuple[str, list[list[list[float]]]]] = field(default_factory=list)

    def alarms(self, situation: Situation, active: Container[str], own_mmsis: Sequence[str] = ()) -> list[Alarm]:
        """One alarm for each object in each zone, and one for each zone that is not watched.

        active : keys of the alarms of the last tick. own_mmsis : of own ship, which is no intruder.
        """
        out: list[Alarm] = []
        self.outlines = []
        objects = situation.objects
        shown = np.isin(objects["stage"], ("confirmed", "coasting")) if len(objects["object"]) else np.zeros(0, bool)
        if len(shown):
            shown &= ~np.isin(objects["mmsi"], [mmsi for mmsi in own_mmsis if mmsi])
        names = ("x_m", "y_m", "var_x_m2", "cov_xy_m2", "var_y_m2")
        x, y, xx, xy, yy = (np.ma.filled(objects[name], np.nan)[shown] for name in names)
        place, covariance = np.column_stack([x, y]), np.stack([xx, xy, xy, yy], axis=-1).reshape(-1, 2, 2)
        for zone in self.zones:
            zone_now = placed(zone, situation.plane, situation.own_ship)
            if isinstance(zone_now, str):
                if situation.plane is None and not len(objects["object"]):
                    continue  # Before the first report no zone has a place.
                out.append(Alarm(f"zone {zone.name}", "source", f"guard zone {zone.name} is not watched: {zone_now}"))
                continue
            self.outlines.append((zone.name, zone_now.outline()))
            p = zone_now.probability(place, covariance)
            for k in np.flatnonzero(p >= LEFT).tolist():
                number, label = int(objects["object"][shown][k]), str(objects["label"][shown][k])
                key = f"zone {zone.name} {number}"
                if p[k] >= ENTERED or key in active:
                    sure = "more than 0.99" if p[k] > 0.99 else f"{p[k]:.2f}"
                    who = label or f"object {number}"
                    text = f"{who} is in the guard zone {zone.name} (probability {sure})"
                    out.append(Alarm(key, "zone", text, (number,)))
        return out

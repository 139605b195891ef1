"""Modelled hulls: positions fused from sensors each of which shows another part of a hull, of boats beside ships.

Two vessels pass a boat with a lidar, a radar whose stamps are a second late, and two cameras. Their lengths are drawn
from those of 223 vessels with AIS in New York harbour (median 28 m, 1σ of the logarithm 0.87, here between 6 and 60 m),
with a beam of 0.29 lengths. The lidar shows the middle of the side that it sees, the radar one bright spot of that
side, the optical camera the middle of the hull, and the infrared camera one warm spot of it; spots change within 30 s.
Nothing but the kinds of the sensors is given, and their errors are estimated (:mod:`sameas.tracks.error_fit`).

An object is right for a vessel within half her length and 8 m. ``scripts/bench hulls``, 5 minutes.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from benchmarks.tables import Table, report
from sameas.many.observations import records_of
from sameas.picture.plot_tracker import PlotTracker
from sameas.tracks.feed import Feed
from sameas.tracks.reports import Reports
from sameas.tracks.scene import POSITION_AND_VELOCITY, Scene
from sameas.tracks.source import Description, Site

#: Kind, 1σ of ranges (m) and of bearings (°), period, lateness (s), share of the scans with the vessel, range (m), and
#: false plots a scan.
SENSORS = {
    "lidar": ("lidar", 0.3, 0.3, 0.5, 0.0, 0.8, 120.0, 0.3),
    "radar": ("marine radar", 2.0, 0.7, 1.7, 1.0, 0.9, 250.0, 2.0),
    "infrared": ("camera", 0.0, 0.5, 0.5, 0.0, 0.6, 250.0, 1.0),
    "electro-optical": ("camera", 0.0, 0.5, 0.5, 0.0, 0.6, 250.0, 3.0),
}
BEAM, SPOT_S, SECONDS, REACH_M = 0.29, 30.0, 90.0, 150.0
#: Angles of the points of an outline.
OUTLINE = np.linspace(0.0, 2.0 * np.pi, 72, endpoint=False)


@dataclass(frozen=True)
class Vessel:
    """A vessel on a straight course. start_m, velocity : (2,) east and north. spot : (k,) draws, which place spots."""

    length_m: float
    start_m: np.ndarray
    velocity: np.ndarray
    spot: np.ndarray

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> Vessel:
        """A vessel that passes the origin at 30 to 90 m in the middle of the scene."""
        length_m = float(np.clip(np.exp(rng.normal(np.log(28.0), 0.87)), 6.0, 60.0))
        course, beside = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(30.0, 90.0) * rng.choice([-1, 1])
        way = rng.uniform(1.5, 4.0) * np.array([np.sin(course), np.cos(course)])
        nearest = beside * np.array([np.cos(course), -np.sin(course)])
        return cls(length_m, nearest - 0.5 * SECONDS * way, way, rng.uniform(size=64))

    def at(self, t: float) -> np.ndarray:
        """(2,) the middle of the hull."""
        return np.asarray(self.start_m + t * self.velocity)

    def shown(self, sensor: str, t: float) -> np.ndarray:
        """(2,) the point of the hull that a sensor at the origin shows."""
        way = self.velocity / np.hypot(*self.velocity)
        axes = np.array([way, [-way[1], way[0]]])
        half = 0.5 * self.length_m * np.array([1.0, BEAM])
        circle = np.column_stack([np.cos(OUTLINE), np.sin(OUTLINE)])
        outline, normal = (circle * half) @ axes, (circle / half) @ axes
        sight = self.at(t) / np.hypot(*self.at(t))
        facing = np.maximum(-(normal @ sight) / np.linalg.norm(normal, axis=1), 0.0)
        facing /= facing.sum()
        spot = float(self.spot[(int(t / SPOT_S) * 2 + (sensor == "radar")) % len(self.spot)])
        if sensor == "lidar":
            return self.at(t) + facing @ outline
        if sensor == "radar":
            return self.at(t) + outline[min(int(np.searchsorted(np.cumsum(facing), spot)), len(outline) - 1)]
        return self.at(t) + (0.0 if sensor == "electro-optical" else spot - 0.5) * self.length_m * way


def feed_of(rng: np.random.Generator, name: str, vessels: tuple[Vessel, ...]) -> Feed:
    """The plots of a sensor at the origin."""
    kind, sigma_m, sigma_deg, period_s, late_s, share, reach_m, false = SENSORS[name]
    times = np.arange(0.0, SECONDS, period_s)
    columns: dict[str, list[float]] = {"time_s": [], "bearing_deg": [], "range_m": []}
    for t in times.tolist():
        places = [v.shown(name, t) for v in vessels if rng.random() < share and np.hypot(*v.at(t)) < reach_m]
        places += list(rng.uniform(-REACH_M, REACH_M, (rng.poisson(false), 2)))
        for place in places:
            columns["time_s"].append(t + late_s)
            columns["range_m"].append(max(float(np.hypot(*place)) + sigma_m * rng.standard_normal(), 0.1))
            columns["bearing_deg"].append(float(np.degrees(np.arctan2(*place))) + sigma_deg * rng.standard_normal())
    if kind == "camera":
        del columns["range_m"]
    description = Description(name, kind, site=Site(east_m=0.0, north_m=0.0))
    return Feed.of(description, Reports.of(name, "table", columns), scan_times_s=times + late_s)


def drawn(seed: int) -> tuple[Scene, tuple[Vessel, ...]]:
    """A scene of two vessels, and they."""
    rng = np.random.default_rng(seed)
    vessels = (Vessel.drawn(rng), Vessel.drawn(rng))
    return Scene(tuple(feed_of(rng, name, vessels) for name in SENSORS)), vessels


def errors_of(seed: int) -> list[tuple[float, ...]]:
    """Of every second and vessel: her length, her distance from the nearest object, its NEES per dimension, whether it
    is right, and how far the lidar's and the radar's last plot of her are (NaN without one)."""
    scene, vessels = drawn(seed)
    scene, _ = scene.with_fitted_errors()
    tracker, tracks, out = PlotTracker(), None, []
    for t in np.arange(1.0, SECONDS, 0.5).tolist():
        now = scene.at(t, features=POSITION_AND_VELOCITY)
        tracks = tracker.advance(now, tracks)
        for vessel in vessels if t >= 15.0 and t % 1.0 == 0.0 else ():
            place, near_m = vessel.at(t), 0.5 * vessel.length_m + 8.0
            sure = np.flatnonzero(tracks.existence > 0.5)
            if np.hypot(*place) > 120.0:
                continue
            off = tracks.state[sure, :2] - place
            k = int(np.argmin(np.hypot(*off.T))) if len(sure) else -1
            error = off[k] if k >= 0 else np.full(2, np.inf)
            distance = float(np.hypot(*error))
            nees = float(error @ np.linalg.solve(tracks.covariance[sure[k], :2, :2], error)) / 2.0 if k >= 0 else np.inf
            plots = []
            for feed, source in list(zip(now.feeds, now.sources, strict=True))[:2]:
                rows = records_of(source).ids
                apart_m = np.hypot(*(feed.reports.state[rows, :2] - place).T)  # type: ignore[union-attr]
                nearest_m = float(apart_m.min(initial=np.inf))
                plots.append(nearest_m if nearest_m < near_m else np.nan)
            out.append((vessel.length_m, distance, nees, float(distance < near_m), *plots))
    return out


def tables(scenes: int) -> Iterator[Table]:
    """The errors by the length of the vessel."""
    every = np.array([row for seed in range(scenes) for row in errors_of(seed)])
    rows: list[list[object]] = []
    for low, high in ((6.0, 15.0), (15.0, 30.0), (30.0, 61.0), (6.0, 61.0)):
        own = every[(every[:, 0] >= low) & (every[:, 0] < high)]
        right = own[own[:, 3] == 1.0]
        lidar, radar = (right[np.isfinite(right[:, k])][:, (k, 1)] for k in (4, 5))
        rms = [float(x) for shown in (lidar, radar) for x in np.sqrt(np.mean(shown**2, axis=0))]
        rows.append([f"{low:g} to {high:g} m", len(own), 100.0 * own[:, 3].mean(), *rms, right[:, 2].mean()])
    columns = ("length", "seconds", "found %", "lidar, m", "fused", "radar, m", "fused", "NEES")
    yield Table(f"Vessels by their length, {scenes} scenes, only the kinds of the sensors given", columns, rows)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=20)
    report("hulls", tables(parser.parse_args().scenes))


if __name__ == "__main__":
    main()

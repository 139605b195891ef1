"""Up to 500 ships that two radars without track numbers show among false plots: found, false, and time of a scan.

Ships with velocities of ± 4 m/s an axis fill a square; two radars 5 km apart, of 3 and 2.5 s a rotation, show each with
a probability of 85 %, ± 15 m in range and ± 0.3° in bearing, and false plots. Only the kind of the radars and their
sites are given, and the whole picture is made. Scored are the confirmed objects every 10 s after the first minute as in
``unnamed_boats``: within 150 m of a ship (40 m in the small square), or more than twice as far from all.

Stone Soup gets the errors of the plots along and across the line of sight, and a motion of the same noise: global
nearest neighbour, gate of 3σ, tracks of three plots or more, deleted after five scans without a plot. It runs in the
lines of up to ``--peer`` ships. ``scripts/bench many_plots``.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.util import find_spec

import numpy as np

from benchmarks.tables import Table, report
from benchmarks.unnamed import Scoring, Shown, StoneSoup, of_picture
from sameas.tracks.reports import Reports
from sameas.tracks.scene import Scene
from sameas.tracks.source import Description, Site

SPAN_S, AFTER_S, EVERY_S = 180.0, 60.0, 10.0
RADARS = (("north", (0.0, 0.0), 3.0), ("south", (5000.0, 2000.0), 2.5))
P_SHOWN, RANGE_M, BEARING_DEG, SPEED_M_PER_S = 0.85, 15.0, 0.3, 4.0
#: Ships, false plots a scan, the side of the square in km, and metres within which an object is of a ship.
LINES = (
    (50, 15, 30.0, 150.0), (200, 60, 30.0, 150.0), (500, 150, 30.0, 150.0), (50, 15, 3.0, 40.0), (150, 45, 3.0, 40.0)
)  # fmt: skip


@dataclass(frozen=True)
class Trial:
    """The scans of both radars in order of time: radar, time, places (n, 2) of the plots. start, velocity : (k, 2)."""

    scans: tuple[tuple[int, float, np.ndarray], ...]
    start: np.ndarray
    velocity: np.ndarray

    @classmethod
    def of(cls, ships: int, false: int, side_m: float, seed: int) -> Trial:
        """A modelled scene."""
        rng = np.random.default_rng(seed)
        start, velocity = rng.uniform(-0.5, 0.5, (ships, 2)) * side_m, rng.normal(0.0, SPEED_M_PER_S, (ships, 2))
        scans = []
        for radar, (_, site, period_s) in enumerate(RADARS):
            for t in np.arange(0.0, SPAN_S, period_s).tolist():
                arm = (start + velocity * t)[rng.random(ships) < P_SHOWN] - site
                range_m = np.hypot(*arm.T) + rng.normal(0.0, RANGE_M, len(arm))
                angle = np.arctan2(*arm.T) + np.radians(rng.normal(0.0, BEARING_DEG, len(arm)))
                real = site + range_m[:, None] * np.column_stack([np.sin(angle), np.cos(angle)])
                scans.append((radar, t, np.vstack([real, rng.uniform(-0.5, 0.5, (rng.poisson(false), 2)) * side_m])))
        return cls(tuple(sorted(scans, key=lambda scan: scan[1])), start, velocity)

    @property
    def scene(self) -> Scene:
        """The scene with the kinds and the sites of the radars."""
        sources = []
        for radar, (name, (east_m, north_m), _) in enumerate(RADARS):
            own = [(t, places) for which, t, places in self.scans if which == radar]
            time_s = np.concatenate([np.full(len(places), t) for t, places in own])
            x_m, y_m = np.vstack([places for _, places in own]).T
            plots = Reports.of(name, "table", {"time_s": time_s, "x_m": x_m, "y_m": y_m})
            sources.append((Description(name, "marine radar", site=Site(east_m=east_m, north_m=north_m)), plots))
        return Scene.of(sources)

    def score(self, shown: Shown, near_m: float) -> tuple[float, float, float]:
        """Per cent shown, numbers a ship, false objects an instant."""
        times = np.arange(AFTER_S, SPAN_S - EVERY_S, EVERY_S)
        return Scoring(times, lambda t: self.start + self.velocity * t, len(self.start), near_m, 2.0 * near_m)(shown)


def by_sameas(trial: Trial) -> Shown:
    """The picture."""
    return of_picture(trial.scene, EVERY_S)


def by_stone_soup(trial: Trial) -> Shown:
    """Stone Soup's multi-target tracker, with the plots of both radars."""
    tracker = StoneSoup(walk=0.01, speed_m_per_s=SPEED_M_PER_S, sigma_m=RANGE_M, gate_sigmas=3, scans=5)

    def scans() -> Iterator[tuple[float, np.ndarray, np.ndarray]]:
        for radar, t, places in trial.scans:
            arm = places - RADARS[radar][1]
            range_m = np.hypot(*arm.T)
            along = arm / range_m[:, None]
            across = np.column_stack([along[:, 1], -along[:, 0]])
            parts = ((along, np.full(len(arm), RANGE_M)), (across, np.radians(BEARING_DEG) * range_m))
            yield t, places, sum(s[:, None, None] ** 2 * u[:, :, None] * u[:, None, :] for u, s in parts)

    at = {t: (number, state[:, [0, 2]]) for t, number, state in tracker(scans())}
    times = np.array(sorted(at))
    return lambda t: at[times[np.searchsorted(times, t, side="right") - 1]]


def table(scenes: int, peer_ships: int) -> Table:
    """All lines."""
    rows: list[list[object]] = []
    by_sameas(Trial.of(3, 2, 3000.0, 0))  # compiles
    for ships, false, side_km, near_m in LINES:
        trials = [Trial.of(ships, false, 1e3 * side_km, seed) for seed in range(scenes)]
        row: list[object] = [ships, false, f"{side_km:g} km"]
        for way in (by_sameas, by_stone_soup):
            if way is by_stone_soup and (ships > peer_ships or find_spec("stonesoup") is None):
                row += ["–"] * 4
                continue
            began = time.process_time()
            shown = [way(trial) for trial in trials]
            ms = 1e3 * (time.process_time() - began) / sum(len(trial.scans) for trial in trials)
            scores = np.mean([trial.score(each, near_m) for trial, each in zip(trials, shown, strict=True)], axis=0)
            row += [*scores.tolist(), ms]
        rows.append(row)
    what = ("shown, %", "numbers a ship", "false objects", "ms a scan")
    columns = [f"{way}: {each}" for way in ("sameas", "Stone Soup") for each in what]
    return Table(
        "Ships in two radars without track numbers", ("ships", "false plots a scan", "square", *columns), rows,
        (f"{scenes} scenes of {SPAN_S:g} s; false objects at an instant; time of the processor, all threads",),
    )  # fmt: skip


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=2, help="scenes of a line")
    parser.add_argument("--peer", type=int, default=50, help="most ships for Stone Soup")
    options = parser.parse_args()
    report("many_plots", [table(options.scenes, options.peer)])


if __name__ == "__main__":
    main()

"""Boats without AIS that a radar without track numbers shows among clutter, beside ships with AIS.

Six ships with AIS and six boats without cross a square of 8 km for ten minutes. A radar of 2.5 s a rotation gives plots
of ± 15 m without names: of the ships and boats with the probability of the line, false ones all over the square, and in
some lines returns of a shore, of which each scan shows some of 400 echoes along 8 km. The radar is described with its
misses and mean clutter, or by its kind only. Scored are the confirmed objects of the instants 5 s apart after two
minutes: boats within 100 m of one, the numbers used for a boat, and objects more than 200 m from all ships and boats.

Stone Soup gets the radar's plots, its misses and clutter described, and the same motion: global nearest neighbour, gate
of 3σ, tracks of three plots or more (``MultiMeasurementInitiator``), deleted after five scans without a plot.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib.util import find_spec

import numpy as np

from benchmarks.tables import Table
from benchmarks.unnamed import Scoring, StoneSoup, of_picture
from sameas.tracks.reports import Reports
from sameas.tracks.scene import Scene
from sameas.tracks.source import Clutter, Description, MissRate, Motion, SensorCoverage, SensorErrors, Site, Timing

SHIPS, BOATS, SPAN_S, PERIOD_S, SIDE_M, SIGMA_M, AFTER_S = 6, 6, 600.0, 2.5, 8000.0, 15.0, 120.0
WALK = Motion(0.01, 6.0)
#: Metres within which an object is of a boat, and beyond which it is of none.
NEAR_M, FAR_M = 100.0, 200.0


@dataclass(frozen=True)
class Kind:
    """A line: probability that a scan shows a ship and a boat; plots of clutter and of the shore per scan."""

    p_ship: float
    p_boat: float
    clutter: float
    shore: float = 0.0


KINDS = (
    Kind(0.8, 0.8, 5.0), Kind(0.8, 0.8, 25.0), Kind(0.3, 0.3, 5.0), Kind(0.9, 0.3, 5.0),
    Kind(0.8, 0.8, 5.0, 20.0), Kind(0.3, 0.3, 5.0, 20.0),
)  # fmt: skip


@dataclass(frozen=True)
class Trial:
    """Plots (time, east, north), AIS reports, and the motion of ships and boats, ships first."""

    kind: Kind
    plots: np.ndarray
    ais: Reports
    start: np.ndarray
    velocity: np.ndarray

    @classmethod
    def of(cls, kind: Kind, seed: int) -> Trial:
        rng, n = np.random.default_rng(seed), SHIPS + BOATS
        start, velocity = rng.uniform(-0.5, 0.5, (n, 2)) * SIDE_M, rng.normal(0.0, 4.0, (n, 2))
        p = np.where(np.arange(n) < SHIPS, kind.p_ship, kind.p_boat)
        east = np.linspace(-0.5, 0.5, 400)
        shore = np.column_stack([east * SIDE_M, 0.3 * SIDE_M + 300.0 * np.sin(9.0 * (east + 0.5))])
        plots = []
        for t in np.arange(0.0, SPAN_S, PERIOD_S):
            shown = (start + velocity * t)[rng.random(n) < p]
            real = np.vstack([shown, shore[rng.integers(0, len(shore), rng.poisson(kind.shore))]])
            false = rng.uniform(-0.5, 0.5, (rng.poisson(kind.clutter), 2)) * SIDE_M
            plots += [(t, *place) for place in np.vstack([real + rng.normal(0.0, SIGMA_M, real.shape), false])]
        rows = [
            (t, *(start[k] + velocity[k] * t + rng.normal(0.0, 8.0, 2)), *(velocity[k] + rng.normal(0.0, 0.3, 2)), k)
            for k in range(SHIPS) for t in np.arange(rng.uniform(0.0, 10.0), SPAN_S, 10.0)
        ]  # fmt: skip
        names = ("time_s", "x_m", "y_m", "vx_m_per_s", "vy_m_per_s")
        columns = dict(zip(names, np.array(rows).T, strict=False)) | {"track_id": [f"ship {row[-1]}" for row in rows]}
        return cls(kind, np.array(plots), Reports.of("ais", "table", columns), start, velocity)

    def scene(self, described: bool) -> Scene:
        """The scene; described : whether misses and mean clutter of the radar are."""
        per_km2 = (self.kind.clutter + self.kind.shore) / (SIDE_M / 1e3) ** 2
        misses = MissRate(1.0 - self.kind.p_ship) if described else MissRate()
        clutter = Clutter(per_km2=per_km2) if described else Clutter()
        radar = Description(
            "radar", "marine radar", site=Site(east_m=0.0, north_m=0.0), motion=WALK, timing=Timing(PERIOD_S, 0.0, 0.0),
            coverage=SensorCoverage(range_m=9000.0), errors=SensorErrors(position_m=SIGMA_M, extent_m=0.0),
            misses=misses, clutter=clutter,
        )  # fmt: skip
        ais = Description("ais", "ais", misses=MissRate(0.5), motion=WALK, errors=SensorErrors(position_m=8.0))
        plots = Reports.of("radar", "table", dict(zip(("time_s", "x_m", "y_m"), self.plots.T, strict=True)))
        return Scene.of([(radar, plots), (ais, self.ais)])

    @property
    def score(self) -> Scoring:
        """Of the boats, beside the ships."""
        times = np.arange(AFTER_S, SPAN_S - PERIOD_S, 5.0)
        return Scoring(times, lambda t: self.start + self.velocity * t, BOATS, NEAR_M, FAR_M)


def by_sameas(trial: Trial, described: bool) -> tuple[float, float, float]:
    """The score of the picture."""
    return trial.score(of_picture(trial.scene(described), 5.0))


def by_stone_soup(trial: Trial) -> tuple[float, float, float]:
    """The score of Stone Soup's multi-target tracker."""
    tracker = StoneSoup(walk=0.01, speed_m_per_s=6.0, sigma_m=SIGMA_M, gate_sigmas=3, scans=5)

    def scans() -> Iterator[tuple[float, np.ndarray, np.ndarray]]:
        for t in np.arange(0.0, SPAN_S, PERIOD_S).tolist():
            here = trial.plots[trial.plots[:, 0] == t, 1:]
            yield t, here, np.tile(SIGMA_M**2 * np.eye(2), (len(here), 1, 1))

    at = {t: (number, state[:, [0, 2]]) for t, number, state in tracker(scans())}
    return trial.score(lambda t: at[t])


def table(scenes: int) -> Table:
    """Boats found and false objects of each kind of scene."""
    ways: dict[str, Callable[[Trial], tuple[float, float, float]]] = {
        "described": lambda trial: by_sameas(trial, True), "kind only": lambda trial: by_sameas(trial, False),
    }  # fmt: skip
    if find_spec("stonesoup") is not None:
        ways["Stone Soup"] = by_stone_soup
    rows: list[list[object]] = []
    for kind in KINDS:
        trials = [Trial.of(kind, seed) for seed in range(scenes)]
        row: list[object] = [f"{100 * kind.p_ship:g} %, {100 * kind.p_boat:g} %", kind.clutter, kind.shore]
        for way in ways.values():
            own = trials[:1] if way is by_stone_soup else trials  # in clutter it takes two minutes a scene
            row += np.mean([way(trial) for trial in own], axis=0).tolist()
        rows.append(row)
    columns = [f"{way}: {what}" for way in ways for what in ("boats shown, %", "numbers a boat", "false objects")]
    return Table(
        "Boats without AIS in a radar without track numbers",
        ("shown: ships, boats", "clutter a scan", "shore a scan", *columns), rows,
        (f"{scenes} scenes of six boats, Stone Soup the first; false objects at an instant, beside twelve in all",),
    )  # fmt: skip

"""Pictures of dense traffic: stated probabilities against the truth.

Ships side by side in a lock, pilot boats alongside, tugs and their tows, ferries across a fairway, boats in tight
turns, aircraft above each other in a stack. Scored as the scenes of ``hard``; none was used to choose a number of the
library.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.hard import AIRCRAFT, AIS, COLUMNS, RADAR, SPAN_S, Kind, Sensor, line
from benchmarks.tables import Table, report

#: Times of the positions of :class:`Paths`.
TIME_S = np.arange(-5.0, SPAN_S + 6.0)


@dataclass(frozen=True)
class Paths:
    """Objects with positions (n, times, 2) every second from the first of :data:`TIME_S`, heights (n,) in metres."""

    position: np.ndarray
    height: np.ndarray

    @classmethod
    def of(cls, *position: np.ndarray) -> Paths:
        """Ships."""
        return cls(np.array(position), np.zeros(len(position)))

    @property
    def turn(self) -> np.ndarray:
        """(n,) for the number of objects."""
        return self.height

    def at(self, rows: np.ndarray, time_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(k, 2) positions and velocities of objects at times."""
        time_s = np.broadcast_to(np.asarray(time_s, float), np.shape(rows))
        k = np.clip(np.floor(time_s - TIME_S[0]).astype(int), 0, self.position.shape[1] - 2)
        velocity = self.position[rows, k + 1] - self.position[rows, k]
        return self.position[rows, k] + velocity * (time_s - TIME_S[0] - k)[:, None], velocity


def smooth(position: np.ndarray, s: float = 8.0) -> np.ndarray:
    """(times, 2) a path without sudden changes of velocity."""
    t = np.arange(-3.0 * s, 3.0 * s + 1.0)
    weight = np.exp(-0.5 * (t / s) ** 2)
    half = len(t) // 2
    padded = np.concatenate([np.repeat(position[:1], half, 0), position, np.repeat(position[-1:], half, 0)])
    return np.column_stack([np.convolve(column, weight / weight.sum(), "valid") for column in padded.T])


def _course(
    rng: np.random.Generator, speed: float, time_s: np.ndarray, width_m: float = 2000.0
) -> tuple[np.ndarray, np.ndarray]:
    """(times, 2) a path with slow turns, and its directions."""
    heading = rng.uniform(0.0, 2.0 * np.pi) + np.cumsum(rng.normal(0.0, 0.004, len(time_s)))
    along = np.column_stack([np.sin(heading), np.cos(heading)])
    return rng.uniform(0.3, 0.7, 2) * width_m + np.cumsum(speed * along, axis=0), along


def in_lock(rng: np.random.Generator) -> Paths:
    """Eight ships go into a lock one after another, lie 18 m abreast in four rows, and leave."""
    ships = []
    for k in range(8):
        berth = np.array([9.0 if k % 2 else -9.0, 60.0 - 45.0 * (k // 2)]) + rng.normal(0.0, 2.0, 2)
        enters, leaves = 14.0 * k + rng.uniform(0.0, 5.0), 300.0 + 9.0 * k
        north = np.minimum(berth[1], berth[1] - 2.5 * (enters + 90.0 - TIME_S))
        north = north + 3.0 * np.maximum(TIME_S - leaves, 0.0)
        ships.append(smooth(np.column_stack([np.full(len(TIME_S), berth[0]), north])))
    return Paths.of(*ships)


def with_pilots(rng: np.random.Generator, time_s: np.ndarray = TIME_S) -> Paths:
    """Four ships under way; a pilot boat comes to each, stays 20 m alongside for two minutes, and leaves."""
    ships = []
    for _ in range(4):
        path, along = _course(rng, rng.uniform(3.0, 6.0), time_s)
        side = rng.choice([-1.0, 1.0]) * np.column_stack([along[:, 1], -along[:, 0]])
        begin = rng.uniform(100.0, 200.0)
        away = 20.0 + 7.0 * np.maximum(np.maximum(begin - time_s, time_s - begin - 120.0), 0.0)
        ships += [path, smooth(path + away[:, None] * side)]
    return Paths.of(*ships)


def towed(rng: np.random.Generator, time_s: np.ndarray = TIME_S) -> Paths:
    """Three tows: a tug, its tow 120 m behind, and a tug 30 m on either side of the tow."""
    ships = []
    for _ in range(3):
        speed = rng.uniform(1.5, 3.0)
        path, along = _course(rng, speed, time_s)
        behind = int(120.0 / speed)
        tow = np.concatenate([path[0] - speed * along[0] * np.arange(behind, 0.0, -1.0)[:, None], path])[: len(path)]
        side = np.column_stack([along[:, 1], -along[:, 0]])
        side = np.concatenate([np.repeat(side[:1], behind, 0), side])[: len(path)]
        ships += [path, tow, tow + 30.0 * side, tow - 30.0 * side]
    return Paths.of(*ships)


def fairway(rng: np.random.Generator) -> Paths:
    """Two lanes of five ships in a fairway, 120 m apart, and three ferries across it."""
    ships = []
    for lane in (-1.0, 1.0):
        for k in range(5):
            speed = rng.uniform(3.5, 5.0)
            north = 300.0 * (k - 2) + rng.normal(0.0, 40.0) + lane * speed * (TIME_S - 0.5 * SPAN_S)
            ships.append(np.column_stack([60.0 * lane + 8.0 * np.sin(TIME_S / 90.0 + k), north]))
    for k in range(3):
        leg = rng.uniform(110.0, 150.0)
        phase = (TIME_S + rng.uniform(0.0, 2.0 * leg)) / leg % 2.0
        east = 400.0 - 800.0 * np.abs(1.0 - phase)
        ships.append(smooth(np.column_stack([east, np.full(len(TIME_S), 250.0 * (k - 1) + rng.normal(0.0, 30.0))])))
    return Paths.of(*ships)


def stack(rng: np.random.Generator) -> Paths:
    """Eight aircraft on one circle of 4 km, 300 m above each other."""
    turn = rng.uniform(100.0, 120.0, 8) / 4000.0
    angle = rng.uniform(0.0, 2.0 * np.pi, 8)[:, None] + turn[:, None] * TIME_S
    position = 4000.0 * np.stack([np.sin(angle), np.cos(angle)], axis=2) + rng.normal(0.0, 150.0, (8, 1, 2))
    return Paths(position + 5000.0, 2000.0 + 300.0 * np.arange(8))


def agile(rng: np.random.Generator) -> Paths:
    """Twelve rigid-hulled boats at 12 m/s; every eight seconds half of them begin a turn of some 17° a second."""
    boats, parts = [], len(TIME_S) // 8 + 1
    for _ in range(12):
        turn = np.repeat(rng.normal(0.0, 0.3, parts) * (rng.random(parts) < 0.5), 8)[: len(TIME_S)]
        heading = rng.uniform(0.0, 2.0 * np.pi) + np.cumsum(turn)
        way = np.cumsum(12.0 * np.column_stack([np.sin(heading), np.cos(heading)]), axis=0)
        boats.append(rng.uniform(300.0, 1200.0, 2) + way)
    return Paths.of(*boats)


def _of(paths: Callable[[np.random.Generator], Paths]) -> Callable[..., Paths]:
    return lambda _, rng: paths(rng)


NEAR = replace(AIS, sigma_m=4.0), Sensor("west", sigma_m=8.0), Sensor("east", sigma_m=8.0)
FAR = AIS, Sensor("west"), Sensor("east")
ADS_B = Sensor("ads-b", "ads-b", sigma_m=40.0, period_s=2.0, heights=0.95, motion=AIRCRAFT, speed_error=1.5)
AIR_RADAR = Sensor("radar", sigma_m=150.0, period_s=6.0, heights=0.6, motion=AIRCRAFT, speed_error=5.0)
TOWS = np.array([1, 5, 9])
SILENT_TOWS = replace(AIS, which=lambda n: np.setdiff1d(np.arange(n), TOWS))


def _kind(
    words: str, sources: tuple[Sensor, ...], paths: Callable[[np.random.Generator], Paths], **more: float
) -> Kind:
    return Kind(words, sources, arranged=_of(paths), **more)  # type: ignore[arg-type]


def _swapping(sources: tuple[Sensor, ...]) -> tuple[Sensor, ...]:
    return tuple(one if one.kind == "ais" else replace(one, swaps=0.02) for one in sources)


KINDS = (
    _kind("lock, trackers of 8 m", NEAR, in_lock),
    _kind("lock, trackers of 25 m", FAR, in_lock),
    _kind("lock, 8 m, 2 % swaps", _swapping(NEAR), in_lock),
    _kind("pilot boats, trackers of 8 m", NEAR, with_pilots),
    _kind("pilot boats, trackers of 25 m", FAR, with_pilots),
    _kind("pilot boats, 25 m, 2 % swaps", _swapping(FAR), with_pilots),
    _kind("tugs and tows without AIS, 8 m", (SILENT_TOWS, *NEAR[1:]), towed),
    _kind("tugs and tows without AIS, 25 m", (SILENT_TOWS, *FAR[1:]), towed),
    _kind("ferries across a fairway", FAR, fairway),
    _kind("ferries, 2 % swaps", _swapping(FAR), fairway),
    _kind("ferries, one tracker 2 s late", (AIS, Sensor("west"), Sensor("east", late_s=2.0)), fairway),
    _kind("ferries, AIS 2 s late", (replace(AIS, late_s=2.0), *FAR[1:]), fairway),
    _kind("ferries, radar with 2 % of range, clutter", (AIS, replace(RADAR, range_share=0.02, false=6.0)), fairway),
    _kind("ferries, AIS and trackers with gaps", tuple(replace(one, gap_s=45.0) for one in FAR), fairway),
    _kind("boats in tight turns, trackers of 8 m", NEAR, agile),
    _kind("boats in tight turns, AIS every 3 s, a tracker of 15 m", (replace(NEAR[0], period_s=3.0),
          Sensor("west", sigma_m=15.0)), agile),
    _kind("aircraft in a stack, heights in most records", (ADS_B, AIR_RADAR), stack, width_m=10000.0),
    _kind("aircraft in a stack, no heights of the radar", (ADS_B, replace(AIR_RADAR, heights=0.0)), stack,
          width_m=10000.0),
    _kind("aircraft in a stack, ADS-B with gaps", (replace(ADS_B, gap_s=30.0), AIR_RADAR), stack, width_m=10000.0),
    _kind("aircraft in a stack, radar 2 s late", (ADS_B, replace(AIR_RADAR, late_s=2.0)), stack, width_m=10000.0),
)  # fmt: skip


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(prog="scripts/bench traffic", description=__doc__)
    parser.add_argument("--seeds", type=int, default=6, help="scenes of each kind (default 6)")
    parser.add_argument("--first", type=int, default=0, help="number of the first scene (default 0)")
    parser.add_argument("--only", default="", help="kinds whose name contains this")
    options = parser.parse_args()
    rows = [
        line(kind, range(begin, begin + options.seeds))
        for number, kind in enumerate(KINDS)
        for begin in [5_000_000 + 1000 * number + options.first]
        if options.only in kind.words
    ]
    report("traffic", [Table("Traffic: stated → right (number)", COLUMNS, rows)])


if __name__ == "__main__":
    main()

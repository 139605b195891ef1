"""Situations at sea and in the air as they are met: their objects, on which paths, and the sensors that show them.

Each is a model of ten to fifteen minutes with a known truth. Positions are every second, in metres about
:data:`benchmarks.situation_files.PLANE`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from benchmarks.situation_files import AdsB, Ais, Flarm, Radar, Sensor, World
from benchmarks.traffic import smooth, towed, with_pilots

Built = tuple[World, Sequence[Sensor]]
AIR = Radar("radar", kind="air radar", sigma_m=50.0, sigma_deg=0.07, resolution=(150.0, 1.2), hull=0.0, reach_m=120e3,
            azimuth_deg=0.1, range_m=50.0, misses=0.05)  # fmt: skip


@dataclass(frozen=True)
class Situation:
    """A situation. built : draws its world and sensors."""

    words: str
    built: Callable[[np.random.Generator], Built]


def clock(minutes: float) -> np.ndarray:
    """Seconds from a little before the first report to a little after the last."""
    return np.arange(-5.0, 60.0 * minutes + 6.0)


def still(place: npt.ArrayLike, t: np.ndarray) -> np.ndarray:
    """(times, 2) a place."""
    return np.repeat(np.asarray(place, float)[None], len(t), 0)


def along(heading: np.ndarray, speed: npt.ArrayLike, start: npt.ArrayLike) -> np.ndarray:
    """(times, 2) a path by headings, from east to north, every second."""
    step = np.asarray(speed) * np.stack([np.cos(heading), np.sin(heading)])
    return np.asarray(np.asarray(start) + np.cumsum(step.T, axis=0))


def abreast(path: np.ndarray, ahead: npt.ArrayLike, aside: npt.ArrayLike) -> np.ndarray:
    """(times, 2) the path of one that keeps its place beside another."""
    way = np.gradient(path, axis=0)
    way = way / np.maximum(np.hypot(*way.T), 1e-6)[:, None]
    side = np.column_stack([-way[:, 1], way[:, 0]])
    return path + np.reshape(ahead, (-1, 1)) * way + np.reshape(aside, (-1, 1)) * side


def wander(rng: np.random.Generator, t: np.ndarray, sigma: float, correlation_s: float) -> np.ndarray:
    """(times,) a slow random walk about zero."""
    noise = rng.normal(size=len(t) + 8 * int(correlation_s))
    window = np.hanning(2 * int(correlation_s) + 1)
    slow = np.convolve(noise, window / np.sqrt(np.sum(window**2)), "same")
    return sigma * np.asarray(slow[4 * int(correlation_s) :][: len(t)])


def harbour(rng: np.random.Generator) -> Built:
    """Ships at two quays and under way between them, two without AIS, no lengths; two radars with numbers."""
    t = clock(12.0)
    paths, length = [], []
    for quay in (-350.0, 350.0):
        east = -800.0
        for _ in range(6):
            length.append(rng.uniform(80.0, 230.0))
            paths.append(still([east + 0.5 * length[-1], quay + rng.normal(0.0, 5.0)], t))
            east += length[-1] + rng.uniform(20.0, 90.0)
    moored = len(paths)
    for k in range(6):
        length.append(rng.uniform(60.0, 250.0))
        side, speed = (-1.0) ** k, rng.uniform(2.5, 4.5)
        east = side * speed * (t - 60.0 * rng.uniform(2.0, 10.0))
        paths.append(np.column_stack([east, side * -110.0 + wander(rng, t, 15.0, 60.0)]))
    silent = {int(rng.integers(moored)), moored + int(rng.integers(6))}
    period = {k: 180.0 if k < moored else 8.0 for k in range(len(paths)) if k not in silent}
    world = World.of(paths, length_m=length, strength=np.array(length) / 50.0)
    radars = [Radar("north", (300.0, 1800.0)), Radar("south", (-900.0, -2200.0), azimuth_deg=-0.4, range_m=-15.0)]
    return world, [Ais(period, moored=frozenset(range(moored))), *radars]


def rescue(rng: np.random.Generator) -> Built:
    """Three lifeboats at 30 to 150 m from drifting rafts without AIS, two helicopters; one radar that merges both."""
    t, paths, height, strength = clock(15.0), [], [], []
    for k in range(3):
        drift = rng.normal(0.0, 0.4, 2)
        raft = rng.uniform(-1500.0, 1500.0, 2) + [4000.0 * (k - 1), 0.0] + t[:, None] * drift
        range_m = np.clip(90.0 + wander(rng, t, 35.0, 120.0), 30.0, 150.0)
        angle = rng.uniform(0.0, 2.0 * np.pi) + np.cumsum(wander(rng, t, 0.006, 90.0))
        boat = raft + range_m[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1)
        paths += [smooth(boat), raft]
        height += [0.0 * t, 0.0 * t]
        strength += [2.0, 1.0]
    boats = [0, 2, 4]
    for k in range(2):
        come_s, hover = rng.uniform(120.0, 400.0), paths[2 * k + 1]
        angle = rng.uniform(0.0, 2.0 * np.pi)
        away = 60.0 * np.maximum(come_s - t, 0.0) + rng.uniform(20.0, 60.0)
        paths.append(smooth(hover + away[:, None] * [np.cos(angle), np.sin(angle)], 15.0))
        height.append(np.clip(20.0 + 0.1 * away, 20.0, 300.0))
        strength.append(2.0)
    world = World.of(paths, height_m=height, length_m=12.0, strength=strength)
    period = dict.fromkeys(boats, 10.0)
    radar = Radar("radar", (0.0, -6000.0), resolution=(35.0, 0.6), sigma_deg=0.2, misses=0.15, clutter=0.3)
    return world, [Ais(period), AdsB([6, 7]), radar]


def pilots(rng: np.random.Generator) -> Built:
    """Four ships and the pilot boats that come alongside at 20 m, all with AIS; a radar with numbers."""
    t = clock(10.0)
    paths = with_pilots(rng, t)
    ship = np.arange(8) % 2 == 0
    length = np.where(ship, rng.uniform(90.0, 250.0, 8), 15.0)
    # The pilot boat is beside the hull, not in it.
    world = World.of(paths.position, length_m=length, strength=np.where(ship, 5.0, 1.0))
    return world, [Ais({k: 8.0 if k % 2 == 0 else 3.0 for k in range(8)}), Radar("radar", (1000.0, -4000.0))]


def tows(rng: np.random.Generator) -> Built:
    """Three tugs, their tows without AIS and two tugs beside each; two radars, errors stated far too large."""
    t = clock(10.0)
    paths = towed(rng, t)
    tow = np.arange(12) % 4 == 1
    world = World.of(paths.position, length_m=np.where(tow, 60.0, 25.0), strength=np.where(tow, 4.0, 1.5))
    stated = "errors = { range_m = 80, bearing_deg = 2.0 }"
    radars = [Radar("west", (-2000.0, 0.0), sigma_m=6.0, described=stated),
              Radar("east", (3500.0, -500.0), sigma_m=6.0, azimuth_deg=-0.2, described=stated)]  # fmt: skip
    return world, [Ais({k: 8.0 for k in range(12) if not tow[k]}), *radars]


def convoy(rng: np.random.Generator) -> Built:
    """Eight naval ships 300 to 600 m apart that zigzag together, half without AIS; two radars with numbers."""
    t = clock(15.0)
    course = rng.uniform(0.0, 2.0 * np.pi) + 0.35 * np.sign(np.sin(2.0 * np.pi * t / rng.uniform(300.0, 420.0)))
    guide = smooth(along(course, 7.0, rng.uniform(-1000.0, 1000.0, 2)), 20.0)
    guide -= guide[len(t) // 2]
    paths = []
    for k in range(8):
        ahead = -rng.uniform(320.0, 520.0) * (k // 2) - 100.0 * (k % 2)
        aside = (k % 2 - 0.5) * rng.uniform(300.0, 600.0)
        paths.append(abreast(guide, ahead + wander(rng, t, 20.0, 120.0), aside + wander(rng, t, 20.0, 120.0)))
    world = World.of(paths, length_m=rng.uniform(80.0, 180.0, 8), strength=4.0)
    named = rng.permutation(8)[:4].tolist()
    radars = [Radar("flag", (1500.0, -7000.0)), Radar("coast", (-9000.0, 4000.0), azimuth_deg=-0.5)]
    return world, [Ais(dict.fromkeys(named, 6.0)), *radars]


def regatta(rng: np.random.Generator) -> Built:
    """25 sailing boats 10 to 60 m apart that beat to windward, AIS of class B every 30 s; a radar with numbers."""
    t, paths = clock(10.0), []
    for _ in range(25):
        tack = np.sign(np.sin(2.0 * np.pi * (t + rng.uniform(0.0, 60.0)) / rng.uniform(110.0, 170.0)))
        heading = np.pi / 2.0 + tack * np.radians(42.0) + wander(rng, t, 0.05, 20.0)
        paths.append(smooth(along(heading, 2.6 + 0.15 * rng.normal(), rng.uniform(-75.0, 75.0, 2)), 5.0))
    world = World.of(paths, length_m=10.0)
    named = np.flatnonzero(rng.random(25) < 0.8).tolist()
    ais = Ais(dict.fromkeys(named, 30.0), class_b=frozenset(named))
    return world, [ais, Radar("radar", (1800.0, 0.0), resolution=(25.0, 0.8), sigma_m=6.0)]


def oil_rig(rng: np.random.Generator) -> Built:
    """A rig and two supply vessels beside it with AIS, five helicopters that come and go; an air radar, no heights."""
    t = clock(15.0)
    leaving = still([-80.0, -40.0], t) + 0.8 * np.maximum(t - 400.0, 0.0)[:, None]
    paths, height = [still([0.0, 0.0], t), still([60.0, 20.0], t), smooth(leaving, 20.0)], [0.0 * t] * 3
    for k in range(5):
        lands = rng.uniform(150.0, 350.0) + 90.0 * k
        leaves = lands + rng.uniform(120.0, 240.0)
        away = 62.0 * np.maximum(np.maximum(lands - t, t - leaves), 0.0)
        angle = np.where(t < 0.5 * (lands + leaves), rng.uniform(2.0, 3.5), rng.uniform(2.0, 3.5))
        paths.append(smooth(away[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1), 12.0))
        height.append(np.clip(40.0 + 0.06 * away, 40.0, 600.0))
    world = World.of(paths, height_m=height, length_m=[90.0, 80.0, 80.0, *[15.0] * 5],
                     strength=[20.0, 6.0, 6.0, *[1.0] * 5])  # fmt: skip
    radar = replace(AIR, site=(-45e3, 20e3), period_s=5.0, sees=lambda place, height_m: height_m > 100.0)
    return world, [Ais({0: 180.0, 1: 180.0, 2: 8.0}, moored=frozenset([0])), AdsB(range(3, 8)), radar]


def jets(rng: np.random.Generator) -> Built:
    """Four pairs of jets 150 to 600 m apart, ADS-B of the leaders only; an air radar with numbers, some heights."""
    t, paths, height = clock(12.0), [], []
    for k in range(4):
        turn = np.where(np.sin(2.0 * np.pi * t / rng.uniform(150.0, 260.0)) > 0.3, rng.choice([-1.0, 1.0]) * 0.025, 0.0)
        start = rng.uniform(-15e3, 15e3, 2)
        lead = along(rng.uniform(0.0, 2.0 * np.pi) + np.cumsum(turn), rng.uniform(180.0, 240.0), start)
        lead += start - lead[len(t) // 2]
        aside = rng.uniform(150.0, 600.0) + wander(rng, t, 50.0, 60.0)
        paths += [lead, abreast(lead, -0.5 * aside, aside)]
        height += [3000.0 + 700.0 * k + 0.0 * t, 3000.0 + 700.0 * k + 20.0 + 0.0 * t]
    world = World.of(paths, height_m=height)
    return world, [AdsB(range(0, 8, 2)), replace(AIR, site=(5e3, -30e3), period_s=5.0, heights=0.7)]


def thermal(rng: np.random.Generator) -> Built:
    """Fourteen gliders that circle in two thermals, some with ADS-B, most with FLARM of its own addresses."""
    t, paths, height = clock(12.0), [], []
    for k in range(14):
        centre = np.array([3000.0 * (k % 2), 0.0]) + t[:, None] * [2.0, 1.0] + rng.normal(0.0, 30.0, 2)
        radius, speed = rng.uniform(90.0, 180.0) + wander(rng, t, 15.0, 40.0), rng.uniform(22.0, 30.0)
        angle = rng.uniform(0.0, 2.0 * np.pi) + np.cumsum(speed / radius)
        paths.append(centre + radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1))
        height.append(rng.uniform(600.0, 1600.0) + np.cumsum(1.5 + wander(rng, t, 0.8, 60.0)))
    world = World.of(paths, height_m=height)
    order = rng.permutation(14)
    return world, [AdsB(sorted(order[:8].tolist())), Flarm(sorted(order[3:].tolist()))]


def holding(rng: np.random.Generator) -> Built:
    """Five aircraft in racetracks above each other, seen by two radars only: plots without numbers and heights."""
    t, paths = clock(20.0), []
    for _ in range(5):
        phase, leg, turn = rng.uniform(0.0, 240.0), 60.0, 60.0
        x = (t + phase) % (2.0 * (leg + turn))
        rate = np.where((x % (leg + turn)) < turn, np.pi / turn, 0.0)
        path = along(np.cumsum(rate), rng.uniform(105.0, 120.0), [0.0, 0.0])
        path += rng.normal(0.0, 300.0, 2) - path.mean(axis=0) - np.outer(t, np.polyfit(t, path, 1)[0])
        paths.append(path)
    world = World.of(paths, height_m=2400.0 + 300.0 * np.arange(5))
    radars = [replace(AIR, name="approach", site=(-20e3, 5e3), period_s=4.0, numbers=False, clutter=1.0),
              replace(AIR, name="route", site=(40e3, -45e3), period_s=8.0, numbers=False, clutter=1.0)]  # fmt: skip
    return world, radars


def approach(rng: np.random.Generator) -> Built:
    """Nine aircraft on two approaches, seven with ADS-B; plots of a radar of 4 s a turn, Mode C in half of them."""
    t, paths, height = clock(15.0), [], []
    for k in range(9):
        side = 1.0 if k % 2 else -1.0
        to_go = 75.0 * (rng.uniform(-60.0, 60.0) + 150.0 * (k // 2) + 500.0 - t)
        bend = np.clip(to_go - 18e3, 0.0, None)
        angle = 0.5 * side * (1.0 - np.exp(-bend / 8e3))
        path = np.column_stack([to_go - bend + bend * np.cos(angle), 900.0 * side + bend * np.sin(angle)])
        paths.append(smooth(path + rng.normal(0.0, 40.0, 2), 10.0))
        height.append(np.clip(0.052 * to_go, 100.0, 2500.0) + 300.0 * (k % 2))
    world = World.of(paths, height_m=height)
    named = sorted(rng.permutation(9)[:7].tolist())
    radar = replace(AIR, site=(3e3, -2e3), period_s=4.0, numbers=False, heights=0.5, clutter=1.0)
    return world, [AdsB(named), radar]


def wind_farm(rng: np.random.Generator) -> Built:
    """Sixteen turbines, whose echoes a radar tracks, and four service boats that go to them and moor at 15 m."""
    t = clock(15.0)
    grid = 600.0 * np.stack(np.meshgrid(np.arange(4), np.arange(4)), -1).reshape(-1, 2)
    paths = [still(place, t) for place in grid]
    for _ in range(4):
        here, way, at_s = int(rng.integers(16)), np.empty((0, 2)), 0.0
        berth = grid[here] + 15.0 * _unit(rng)
        while at_s < len(t):
            stay = int(rng.uniform(120.0, 300.0))
            way = np.concatenate([way, np.repeat(berth[None], stay, 0)])
            there = grid[int(rng.integers(16))] + 15.0 * _unit(rng)
            steps = max(int(np.hypot(*(there - berth)) / rng.uniform(5.0, 9.0)), 1)
            way = np.concatenate([way, berth + np.linspace(0.0, 1.0, steps)[:, None] * (there - berth)])
            berth, at_s = there, len(way)
        paths.append(smooth(way[: len(t)], 6.0))
    strength = [6.0] * 16 + [1.5] * 4
    world = World.of(paths, length_m=[8.0] * 16 + [25.0] * 4, strength=strength)
    boats = list(range(16, 20))
    ais = Ais(dict.fromkeys(boats, 30.0), class_b=frozenset(boats))
    return world, [ais, Radar("radar", (-3500.0, 900.0), resolution=(30.0, 0.7))]


def _unit(rng: np.random.Generator) -> np.ndarray:
    angle = rng.uniform(0.0, 2.0 * np.pi)
    return np.array([np.cos(angle), np.sin(angle)])


def river(rng: np.random.Generator) -> Built:
    """Twelve barges on a winding river that meet at 40 m, all but one with AIS; a radar ashore sees one reach."""
    t, paths = clock(15.0), []
    for k in range(12):
        side, speed = (-1.0) ** k, rng.uniform(2.5, 4.5)
        x = side * (speed * t - rng.uniform(-2000.0, 2000.0) - speed * 450.0)
        slope = 500.0 / 600.0 * np.cos(x / 600.0)
        # Along the river the speed is kept: the way east is shorter where it winds.
        x = side * np.cumsum(speed / np.sqrt(1.0 + slope**2)) + x[0]
        centre = np.column_stack([x, 500.0 * np.sin(x / 600.0)])
        paths.append(abreast(smooth(centre), 0.0, np.full(len(t), -20.0) + wander(rng, t, 3.0, 60.0)))
    world = World.of(paths, length_m=rng.uniform(60.0, 130.0, 12), strength=3.0)
    silent = int(rng.integers(12))
    radar = Radar("radar", (0.0, 700.0), sees=lambda place, _: np.abs(place[:, 0]) < 900.0, resolution=(20.0, 1.0))
    return world, [Ais({k: 8.0 for k in range(12) if k != silent}), radar]


SITUATIONS = (
    Situation("harbour", harbour),
    Situation("search and rescue", rescue),
    Situation("pilots alongside", pilots),
    Situation("tugs and tows, errors stated too large", tows),
    Situation("convoy, half without AIS", convoy),
    Situation("regatta", regatta),
    Situation("oil rig and helicopters", oil_rig),
    Situation("pairs of jets", jets),
    Situation("gliders in thermals", thermal),
    Situation("holding, plots of two radars", holding),
    Situation("approach, plots with some heights", approach),
    Situation("wind farm", wind_farm),
    Situation("river", river),
)

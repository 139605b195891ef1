"""Error models of the Autoferry sensors, learned from the truth of other scenarios than the one that is judged.

Of every look the detections on a vessel's hull are the vessel's, several of them share one vote, those on no hull are
clutter. A detection lies anywhere on the hull, which lies in any direction: L²/24 per axis, of the lengths of vessels
that may be there, which whoever describes his sensors knows. What errors along and across the sight leave beside it is
learned: σ_r² + L²/24 along and (r σ_β)² + L²/24 across, of most likelihood. A radar's stamps are late by what brings
its detections nearest to the vessels.

The scenarios are few and unlike: two are of a fjord with a ship of 36 m, one of a canal. There cameras show more that
is false than the fjord teaches, and a radar's stamps are a second less late. What that is worth was tried: with the
density of all its own detections told as a camera's clutter, 90, 99 and 82 % of the instants were right with memory in
scenarios 2, 4 and 17, and not 92, 96 and 95 %; in the canal's 60 instants of half a minute that is no firm number.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.optimize import minimize

from benchmarks.autoferry_scenes import (
    CAMERAS,
    HALF_HULL_M,
    INFRARED,
    LIDAR,
    OPTICAL,
    RADAR,
    SENSORS,
    off_hulls,
    off_sights,
    scans_of,
    truth_of,
    turned,
)
from sameas.tracks.source import (
    Clutter,
    Description,
    MissRate,
    Motion,
    Resolution,
    SensorCoverage,
    SensorErrors,
    Timing,
)

KIND = {LIDAR: "lidar", RADAR: "marine radar", INFRARED: "camera", OPTICAL: "camera"}
NAME = {LIDAR: "lidar", RADAR: "radar", INFRARED: "infrared", OPTICAL: "electro-optical"}
#: What nobody learns from detections: how vessels move, and that none of the sensors sees farther.
MOTION, REACH_M = Motion(acceleration_m2_per_s3=0.1, speed_m_per_s=3.0), 300.0
#: Misses by range between these; misses repeat themselves, so that looks within so many seconds count as one.
RANGES_M, REPEATED_S = (0.0, 60.0, 90.0, 120.0, 160.0, REACH_M), 5.0
#: Clutter of positions is counted within so many metres.
CLUTTER_M = 150.0
LATENCIES_S = np.arange(0.0, 3.01, 0.25)


@dataclass(frozen=True)
class Errors:
    """σ along the sight in metres, and across in degrees, beside what the hull does."""

    range_m: float
    bearing_deg: float
    of_camera: bool

    def log_loss(self, shown: _Shown) -> float:
        """−ln of the likelihood, but for a constant."""
        hull = shown.half_m**2 / 6.0
        across = (np.radians(self.bearing_deg) * shown.range_m) ** 2 + hull
        parts = [(shown.along_m, self.range_m**2 + hull), (shown.across, across)]
        if self.of_camera:
            parts = [(shown.across, self.bearing_deg**2 + np.degrees(np.sqrt(hull) / shown.range_m) ** 2)]
        return sum(
            float(shown.share @ (0.5 * np.log(variance) + 0.5 * error**2 / variance)) for error, variance in parts
        )


@dataclass(frozen=True)
class Learned:
    """Of one sensor: errors, q by range, probability of splits, clutter per m² or degree."""

    errors: Errors
    latency_s: float
    q: tuple[float, ...]
    q_range_m: tuple[float, ...]
    split: float
    clutter: float

    def describe(self, sensor: int, half_hull_m: Sequence[float]) -> Description:
        """The sensor among vessels of these half lengths."""
        own, extent = self.errors, float(np.sqrt(np.mean(np.square(half_hull_m)) / 6.0))
        polar = SensorErrors(bearing_deg=own.bearing_deg, extent_m=extent)
        plane = SensorErrors(own.range_m, 0.0, own.bearing_deg, extent_m=extent)
        camera = sensor in CAMERAS
        late = Timing(period_s=1.7, latency_s=self.latency_s, latency_sigma_s=0.5)
        return Description(
            NAME[sensor], KIND[sensor], coverage=SensorCoverage(range_m=REACH_M),
            misses=MissRate(self.q, self.q_range_m), errors=polar if camera else plane, motion=MOTION,
            timing=late if sensor == RADAR else Timing(),
            clutter=Clutter(per_deg=self.clutter) if camera else Clutter(1e6 * self.clutter),
            resolution=Resolution(5.0, 2.0, self.split) if sensor == RADAR else Resolution(split=self.split),
        )  # fmt: skip


def learned_elsewhere(scenario: str, scenarios: Iterable[str]) -> dict[int, Learned]:
    """The models of all sensors from the scenarios but this one."""
    others = [other for other in scenarios if other != scenario]
    nearest = [_Shown.of(others, RADAR, late).median_m for late in LATENCIES_S.tolist()]
    late = float(LATENCIES_S[int(np.argmin(nearest))])
    return {sensor: _learned(others, sensor, late if sensor == RADAR else 0.0) for sensor in SENSORS}


def describe_all(models: dict[int, Learned], scenario: str) -> dict[int, Description]:
    """The sensors among the vessels of a scenario."""
    return {sensor: model.describe(sensor, HALF_HULL_M[scenario]) for sensor, model in models.items()}


@dataclass(frozen=True)
class _Shown:
    """What a sensor showed of the vessels.

    range_m, half_m, along_m, across, share : (n,) of the detections that are the vessels': where, of which length,
        their errors, across in metres, of cameras in degrees, and their parts of a vote. sight_m, missed : of every
        look at a vessel its range, and whether it was missed. splits, clutter, looks : how many.
    """

    range_m: np.ndarray
    half_m: np.ndarray
    along_m: np.ndarray
    across: np.ndarray
    share: np.ndarray
    sight_m: np.ndarray
    missed: np.ndarray
    splits: int
    clutter: int
    looks: int

    @property
    def median_m(self) -> float:
        return float(np.median(np.hypot(self.along_m, self.across)))

    @classmethod
    def of(cls, scenarios: Sequence[str], sensor: int, latency_s: float) -> _Shown:
        """What it showed in several scenarios."""
        parts = [_shown(scenario, sensor, latency_s) for scenario in scenarios]
        columns = [[getattr(part, f.name) for part in parts] for f in fields(cls)]
        joined: list[Any] = [np.concatenate(c) if isinstance(c[0], np.ndarray) else sum(c) for c in columns]
        return cls(*joined)


@cache
def _shown(scenario: str, sensor: int, latency_s: float) -> _Shown:
    """All looks of a sensor in a scenario against the truth."""
    own: list[tuple[float, ...]] = []
    sights: list[tuple[float, bool]] = []
    splits = clutter = 0
    truth, looks = truth_of(scenario), scans_of(scenario, sensor)
    for look in looks:
        arm = truth.at(look.time_s - latency_s) - look.own_m
        away = np.hypot(*arm.T).tolist()
        along, across, cost, near = _compared(sensor, look.seen, arm, truth.half_m)
        clutter += int(((cost >= 1.0).all(axis=0) & near).sum())
        for v in (0, 1):
            at = np.flatnonzero((cost[v] < 1.0) & (cost[v] <= cost[1 - v])).tolist()
            sights.append((away[v], not at))
            splits += max(len(at) - 1, 0)
            own += [(away[v], truth.half_m[v], along[v, k], across[v, k], 1.0 / len(at)) for k in at]
    sight_m, missed = np.array(sights).T
    range_m, half_m, along_m, across_m_or_deg, share = np.array(own).T
    return _Shown(
        range_m, half_m, along_m, across_m_or_deg, share, sight_m, missed.astype(bool), splits, clutter, len(looks)
    )


def _compared(
    sensor: int, seen: np.ndarray, arm: np.ndarray, half: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Per vessel (2, n) errors along and across and distance from the hull, below 1 on it; (n,) whether it is near."""
    away = np.hypot(*arm.T)
    if sensor in CAMERAS:
        across = turned(seen - np.degrees(np.arctan2(*arm.T))[:, None])
        return np.zeros_like(across), across, off_sights(across, away, half), np.ones(len(seen), bool)
    delta = seen - arm[:, None]
    sight = arm / away[:, None]
    along = np.einsum("vnk,vk->vn", delta, sight)
    across = np.einsum("vnk,vk->vn", delta, np.column_stack([sight[:, 1], -sight[:, 0]]))
    return along, across, off_hulls(delta, half), np.hypot(*seen.T) < CLUTTER_M


def _learned(scenarios: Sequence[str], sensor: int, latency_s: float) -> Learned:
    shown = _Shown.of(scenarios, sensor, latency_s)
    # Two looks' worth of not knowing: half of them miss.
    period_s = float(np.median(np.diff([look.time_s for look in scans_of(scenarios[0], sensor)])))
    weight = min(period_s / REPEATED_S, 1.0)
    q, middle = [], []
    for low, high in pairwise(RANGES_M):
        here = (shown.sight_m >= low) & (shown.sight_m < high)
        if here.any():
            q.append((weight * float(shown.missed[here].sum()) + 1.0) / (weight * float(here.sum()) + 2.0))
            middle.append(float(shown.sight_m[here].mean()))
    space = 360.0 if sensor in CAMERAS else np.pi * CLUTTER_M**2
    # One false detection more than was seen: none in some minutes is not none at all.
    clutter = (shown.clutter + 1.0) / (shown.looks * space)
    split = float(np.clip(shown.splits / shown.share.sum(), 0.02, 0.5))
    return Learned(_fitted(shown, sensor), latency_s, tuple(q), tuple(middle), split, clutter)


def _fitted(shown: _Shown, sensor: int) -> Errors:
    """The errors of most likelihood."""

    def errors(logs: np.ndarray) -> Errors:
        range_m, bearing_deg = np.exp(logs).tolist()
        return Errors(range_m, bearing_deg, sensor in CAMERAS)

    def cost(logs: np.ndarray) -> float:
        return errors(logs).log_loss(shown)

    bounds = [(np.log(0.2), np.log(10.0))] * 2
    best = minimize(cost, np.log([2.0, 2.0]), method="L-BFGS-B", bounds=bounds)
    return errors(best.x)

"""Error models of the Autoferry sensors, estimated from the truth of the scenarios that are not tested.

In every scan, detections on a vessel's hull belong to the vessel and share a weight of 1; those on no hull are clutter.
A detection lies anywhere on a hull of length L in any direction: variance L²/24 per axis, with the lengths given.
Maximum likelihood gives σ_r and σ_β of σ_r² + L²/24 along and (r σ_β)² + L²/24 across the line of sight. The latency of
the radar is the one that brings its detections closest to the vessels.

The scenarios are few and different: two in a fjord with a ship of 36 m, one in a canal, where the cameras have more
clutter and the radar is a second less late; the canal has only 57 instants within half a minute.
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
    Scan,
    Truth,
    bearing_difference,
    hull_bearing_distance,
    hull_distance,
    scans_of,
    truth_of,
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
#: Assumed, not estimated: the motion of the vessels, and the range of all sensors.
MOTION, REACH_M = Motion(acceleration_m2_per_s3=0.1, speed_m_per_s=3.0), 300.0
#: Bins of range for the miss rate. Misses are correlated in time: scans within REPEATED_S count as one.
RANGES_M, REPEATED_S = (0.0, 60.0, 90.0, 120.0, 160.0, REACH_M), 5.0
#: Clutter of radar and lidar is counted within this range.
CLUTTER_M = 150.0
LATENCIES_S = np.arange(0.0, 3.01, 0.25)


@dataclass(frozen=True)
class Errors:
    """σ along the line of sight in metres and across it in degrees, without the extent of the hull."""

    range_m: float
    bearing_deg: float
    of_camera: bool

    def negative_log_likelihood(self, data: _Residuals) -> float:
        """−ln likelihood, up to a constant."""
        hull = data.half_m**2 / 6.0  # L²/24
        across = (np.radians(self.bearing_deg) * data.range_m) ** 2 + hull
        parts = [(data.along_m, self.range_m**2 + hull), (data.across, across)]
        if self.of_camera:
            parts = [(data.across, self.bearing_deg**2 + np.degrees(np.sqrt(hull) / data.range_m) ** 2)]
        return sum(
            float(data.weight @ (0.5 * np.log(variance) + 0.5 * error**2 / variance)) for error, variance in parts
        )


@dataclass(frozen=True)
class SensorModel:
    """One sensor: errors, latency, miss rate q by range, probability of a split, clutter per m² or degree."""

    errors: Errors
    latency_s: float
    q: tuple[float, ...]
    q_range_m: tuple[float, ...]
    split: float
    clutter: float

    def describe(self, sensor: int, half_hull_m: Sequence[float]) -> Description:
        """The description of the sensor for vessels of these half lengths."""
        errors, extent = self.errors, float(np.sqrt(np.mean(np.square(half_hull_m)) / 6.0))
        polar = SensorErrors(bearing_deg=errors.bearing_deg, extent_m=extent)
        plane = SensorErrors(errors.range_m, 0.0, errors.bearing_deg, extent_m=extent)
        camera = sensor in CAMERAS
        late = Timing(period_s=1.7, latency_s=self.latency_s, latency_sigma_s=0.5)
        return Description(
            NAME[sensor], KIND[sensor], coverage=SensorCoverage(range_m=REACH_M),
            misses=MissRate(self.q, self.q_range_m), errors=polar if camera else plane, motion=MOTION,
            timing=late if sensor == RADAR else Timing(),
            clutter=Clutter(per_deg=self.clutter) if camera else Clutter(1e6 * self.clutter),
            resolution=Resolution(5.0, 2.0, self.split) if sensor == RADAR else Resolution(split=self.split),
        )  # fmt: skip


def models_from_others(scenario: str, scenarios: Iterable[str]) -> dict[int, SensorModel]:
    """The models of all sensors, estimated from the other scenarios."""
    others = [other for other in scenarios if other != scenario]
    distances = [_Residuals.of(others, RADAR, latency).median_m for latency in LATENCIES_S.tolist()]
    latency_s = float(LATENCIES_S[int(np.argmin(distances))])
    return {sensor: _estimated(others, sensor, latency_s if sensor == RADAR else 0.0) for sensor in SENSORS}


def describe_all(models: dict[int, SensorModel], scenario: str) -> dict[int, Description]:
    """The descriptions of all sensors for the vessels of a scenario."""
    return {sensor: model.describe(sensor, HALF_HULL_M[scenario]) for sensor, model in models.items()}


@dataclass(frozen=True)
class _Residuals:
    """The detections of a sensor against the truth.

    range_m, half_m, along_m, across, weight : (n,) of the detections of vessels: range and half length of the vessel,
        residuals (across in metres, of cameras in degrees), weights. vessel_range_m, missed : of every scan and vessel.
    splits, clutter, scans : counts.
    """

    range_m: np.ndarray
    half_m: np.ndarray
    along_m: np.ndarray
    across: np.ndarray
    weight: np.ndarray
    vessel_range_m: np.ndarray
    missed: np.ndarray
    splits: int
    clutter: int
    scans: int

    @property
    def median_m(self) -> float:
        return float(np.median(np.hypot(self.along_m, self.across)))

    @classmethod
    def of(cls, scenarios: Sequence[str], sensor: int, latency_s: float) -> _Residuals:
        """Those of several scenarios together."""
        parts = [_residuals(scenario, sensor, latency_s) for scenario in scenarios]
        columns = [[getattr(part, f.name) for part in parts] for f in fields(cls)]
        joined: list[Any] = [np.concatenate(c) if isinstance(c[0], np.ndarray) else sum(c) for c in columns]
        return cls(*joined)


@cache
def _residuals(scenario: str, sensor: int, latency_s: float) -> _Residuals:
    """Those of one scenario."""
    detections: list[tuple[float, ...]] = []
    opportunities: list[tuple[float, bool]] = []
    splits = clutter = 0
    truth, scans = truth_of(scenario), scans_of(scenario, sensor)
    for scan in scans:
        offset = truth.at(scan.time_s - latency_s) - scan.own_m
        ranges = np.hypot(*offset.T).tolist()
        along, across, distance, near = _compared(sensor, scan, offset, truth)
        clutter += int(((distance >= 1.0).all(axis=0) & near).sum())
        for v in (0, 1):
            on_hull = np.flatnonzero((distance[v] < 1.0) & (distance[v] <= distance[1 - v])).tolist()
            opportunities.append((ranges[v], not on_hull))
            splits += max(len(on_hull) - 1, 0)
            detections += [(ranges[v], truth.half_m[v], along[v, k], across[v, k], 1.0 / len(on_hull)) for k in on_hull]
    vessel_range_m, missed = np.array(opportunities).T
    range_m, half_m, along_m, across_m_or_deg, weight = np.array(detections).T
    return _Residuals(
        range_m, half_m, along_m, across_m_or_deg, weight, vessel_range_m, missed.astype(bool), splits, clutter,
        len(scans),
    )  # fmt: skip


def _compared(
    sensor: int, scan: Scan, offset: np.ndarray, truth: Truth
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Per vessel (2, n) residuals along and across, and distance from the hull; (n,) whether within ``CLUTTER_M``."""
    ranges, measured = np.hypot(*offset.T), scan.measured
    if sensor in CAMERAS:
        across = bearing_difference(measured - np.degrees(np.arctan2(*offset.T))[:, None])
        distance = hull_bearing_distance(across, offset, truth, scan.time_s)
        return np.zeros_like(across), across, distance, np.ones(len(measured), bool)
    delta = measured - offset[:, None]
    sight = offset / ranges[:, None]
    along = np.einsum("vnk,vk->vn", delta, sight)
    across = np.einsum("vnk,vk->vn", delta, np.column_stack([sight[:, 1], -sight[:, 0]]))
    return along, across, hull_distance(delta, truth.half_m), np.hypot(*measured.T) < CLUTTER_M


def _estimated(scenarios: Sequence[str], sensor: int, latency_s: float) -> SensorModel:
    data = _Residuals.of(scenarios, sensor, latency_s)
    period_s = float(np.median(np.diff([scan.time_s for scan in scans_of(scenarios[0], sensor)])))
    weight = min(period_s / REPEATED_S, 1.0)
    q, mean_range_m = [], []
    for low, high in pairwise(RANGES_M):
        in_bin = (data.vessel_range_m >= low) & (data.vessel_range_m < high)
        if in_bin.any():
            # Uniform prior: one more miss in two more scans.
            q.append((weight * float(data.missed[in_bin].sum()) + 1.0) / (weight * float(in_bin.sum()) + 2.0))
            mean_range_m.append(float(data.vessel_range_m[in_bin].mean()))
    space = 360.0 if sensor in CAMERAS else np.pi * CLUTTER_M**2
    # One more than counted, so that no clutter in some minutes does not become a rate of zero.
    clutter = (data.clutter + 1.0) / (data.scans * space)
    split = float(np.clip(data.splits / data.weight.sum(), 0.02, 0.5))
    return SensorModel(_fitted(data, sensor), latency_s, tuple(q), tuple(mean_range_m), split, clutter)


def _fitted(data: _Residuals, sensor: int) -> Errors:
    """The maximum likelihood errors."""

    def errors(logs: np.ndarray) -> Errors:
        range_m, bearing_deg = np.exp(logs).tolist()
        return Errors(range_m, bearing_deg, sensor in CAMERAS)

    def cost(logs: np.ndarray) -> float:
        return errors(logs).negative_log_likelihood(data)

    bounds = [(np.log(0.2), np.log(10.0))] * 2
    best = minimize(cost, np.log([2.0, 2.0]), method="L-BFGS-B", bounds=bounds)
    return errors(best.x)

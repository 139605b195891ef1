"""The Autoferry scenarios: scans of the sensors, GNSS truth of the two vessels, distances of detections from hulls."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from sameas.tracks.feed import Feed
from sameas.tracks.reports import Reports
from sameas.tracks.scene import Scene
from sameas.tracks.source import Description

FOLDER = Path(__file__).resolve().parents[1].parent / "shared" / "data" / "autoferry"
SCENARIOS = ("scenario2", "scenario4", "scenario17")
LIDAR, RADAR, INFRARED, OPTICAL = 1, 2, 3, 4
SENSORS = (LIDAR, RADAR, INFRARED, OPTICAL)
CAMERAS = (INFRARED, OPTICAL)
#: Half the lengths of the hulls: Havfruen, and Gunnerus (36 m) or, in the canal, the jet boat.
HALF_HULL_M = {"scenario2": (6.0, 18.0), "scenario4": (6.0, 18.0), "scenario17": (6.0, 5.0)}
#: Beam of a hull in lengths, the median of 191 vessels with AIS in New York harbour; Gunnerus has 0.27.
BEAM = 0.29
#: A detection farther than this from the hull is not one of the vessel.
MARGIN_M, MARGIN_DEG = 8.0, 3.0
#: The course over ground, taken for the heading, is that of the path within this time to either side.
COURSE_S = 2.0


@dataclass(frozen=True)
class Truth:
    """GNSS positions of the two vessels: per vessel (n,) times and (n, 2) east and north; half their lengths."""

    time_s: tuple[np.ndarray, ...]
    position: tuple[np.ndarray, ...]
    half_m: np.ndarray

    def at(self, instant_s: float) -> np.ndarray:
        """(2, 2) positions of both vessels at an instant."""
        pairs = zip(self.time_s, self.position, strict=True)
        return np.array([[np.interp(instant_s, t, x[:, axis]) for axis in (0, 1)] for t, x in pairs])

    def half_widths_m(self, instant_s: float, direction: np.ndarray) -> np.ndarray:
        """(2,) half the widths of the hulls along horizontal directions (2, 2), one for each vessel."""
        way = self.at(instant_s + COURSE_S) - self.at(instant_s - COURSE_S)
        along = np.einsum("vk,vk->v", way, direction)
        along /= np.maximum(np.linalg.norm(way, axis=1) * np.linalg.norm(direction, axis=1), 1e-9)
        return np.asarray(self.half_m * np.hypot(along, BEAM * np.sqrt(np.maximum(1.0 - along**2, 0.0))))


@dataclass(frozen=True)
class Scan:
    """One scan of a sensor. own_m : its position. measured : (n, 2) metres east, north of it, or (n,) bearings, deg."""

    time_s: float
    own_m: np.ndarray
    measured: np.ndarray


@cache
def scans_of(scenario: str, sensor: int) -> tuple[Scan, ...]:
    """All scans of one sensor. The file has norths, then easts (radar, lidar), or bearings in radians (cameras)."""
    scans = []
    for scan in _loaded(scenario, "detections"):
        if scan["sensorID"] == sensor:
            values = np.asarray(scan["measurement"], dtype=np.float64).reshape(-1)
            measured = np.degrees(values) if sensor in CAMERAS else values.reshape(2, -1)[::-1].T
            scans.append(Scan(scan["time"], np.array(scan["ownshipPosition"][::-1]), measured))
    return tuple(scans)


@cache
def truth_of(scenario: str) -> Truth:
    """The truth of one scenario, in metres east and north of the data set's origin."""
    rows = [row for rows in _loaded(scenario, "groundTruth") for row in (rows if isinstance(rows, list) else [rows])]
    times, positions = [], []
    for vessel in (1, 2):
        own = {row["time"]: row["position"][1::-1] for row in rows if row["targetID"] == vessel}
        times.append(np.array(sorted(own)))
        positions.append(np.array([own[t] for t in sorted(own)]))
    return Truth(tuple(times), tuple(positions), np.array(HALF_HULL_M[scenario]))


def _loaded(scenario: str, what: str) -> list[Any]:
    loaded: list[Any] = json.loads((FOLDER / scenario / f"{scenario}_{what}.json").read_text())
    return loaded


def scene_of(scenario: str, describe: dict[int, Description]) -> Scene:
    """The scene with these descriptions of the sensors."""
    return Scene(tuple(_feed(describe[sensor], scans_of(scenario, sensor), sensor) for sensor in SENSORS))


def _feed(description: Description, scans: tuple[Scan, ...], sensor: int) -> Feed:
    columns: dict[str, list[float]] = {name: [] for name in ("time_s", "bearing_deg", "station_x_m", "station_y_m")}
    distance: list[float] = []
    for scan in scans:
        bearing = scan.measured
        if sensor not in CAMERAS:
            distance += list(np.hypot(*scan.measured.T))
            bearing = np.degrees(np.arctan2(*scan.measured.T))
        columns["bearing_deg"] += list(bearing)
        for name, value in (("time_s", scan.time_s), ("station_x_m", scan.own_m[0]), ("station_y_m", scan.own_m[1])):
            columns[name] += [value] * len(bearing)
    if sensor not in CAMERAS:
        columns["range_m"] = distance
    times = [scan.time_s - (description.timing.latency_s or 0.0) for scan in scans]
    return Feed.of(description, Reports.of(description.name, "table", columns), scan_times_s=times)


def hull_distance(delta_m: np.ndarray, half_m: np.ndarray) -> np.ndarray:
    """(2, n) scaled distances of positions from the vessels, below 1 on the hull; delta_m : (2, n, 2) offsets."""
    return np.asarray(np.linalg.norm(delta_m, axis=2) / (MARGIN_M + half_m)[:, None])


def hull_bearing_distance(delta_deg: np.ndarray, offset_m: np.ndarray, truth: Truth, instant_s: float) -> np.ndarray:
    """(2, n) scaled distances of bearings from the vessels, below 1 on the hull as it is turned to the camera.

    delta_deg : (2, n). offset_m : (2, 2) of the vessels from the camera.
    """
    across = np.column_stack([offset_m[:, 1], -offset_m[:, 0]])
    half_m = truth.half_widths_m(instant_s, across)
    half_width_deg = MARGIN_DEG + np.degrees(np.arctan2(half_m, np.hypot(*offset_m.T)))
    return np.asarray(np.abs(delta_deg) / half_width_deg[:, None])


def bearing_difference(angle_deg: np.ndarray) -> np.ndarray:
    """Differences of bearings, wrapped to −180° to 180°."""
    return np.asarray((angle_deg + 180.0) % 360.0 - 180.0)

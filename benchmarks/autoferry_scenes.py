"""The Autoferry scenarios: looks of the sensors and truth of the two vessels, and what a sensor shows of a vessel."""

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
#: Half the length of the hulls: Havfruen, and Gunnerus (36 m) or the jet boat of the canal.
HALF_HULL_M = {"scenario2": (6.0, 18.0), "scenario4": (6.0, 18.0), "scenario17": (6.0, 5.0)}
#: How far from the hull a detection may be and still be one of it.
MARGIN_M, MARGIN_DEG = 8.0, 3.0


@dataclass(frozen=True)
class Truth:
    """GNSS positions of the two vessels: per vessel (n,) times and (n, 2) east and north; half their lengths."""

    time_s: tuple[np.ndarray, ...]
    position: tuple[np.ndarray, ...]
    half_m: np.ndarray

    def at(self, instant_s: float) -> np.ndarray:
        """(2, 2) both vessels at an instant."""
        pairs = zip(self.time_s, self.position, strict=True)
        return np.array([[np.interp(instant_s, t, x[:, axis]) for axis in (0, 1)] for t, x in pairs])


@dataclass(frozen=True)
class Look:
    """One look of a sensor: from where, and what it shows: (n, 2) east and north of it, or (n,) bearings in degrees."""

    time_s: float
    own_m: np.ndarray
    seen: np.ndarray


@cache
def scans_of(scenario: str, sensor: int) -> tuple[Look, ...]:
    """All looks of one sensor; a measurement is norths, then easts (radar, lidar), or bearings in radians (cameras)."""
    looks = []
    for look in _loaded(scenario, "detections"):
        if look["sensorID"] == sensor:
            seen = np.asarray(look["measurement"], dtype=np.float64).reshape(-1)
            shown = np.degrees(seen) if sensor in CAMERAS else seen.reshape(2, -1)[::-1].T
            looks.append(Look(look["time"], np.array(look["ownshipPosition"][::-1]), shown))
    return tuple(looks)


@cache
def truth_of(scenario: str) -> Truth:
    """The truth of one scenario, in metres east and north of the data set's origin."""
    rows = [row for rows in _loaded(scenario, "groundTruth") for row in (rows if isinstance(rows, list) else [rows])]
    times, places = [], []
    for vessel in (1, 2):
        own = {row["time"]: row["position"][1::-1] for row in rows if row["targetID"] == vessel}
        times.append(np.array(sorted(own)))
        places.append(np.array([own[t] for t in sorted(own)]))
    return Truth(tuple(times), tuple(places), np.array(HALF_HULL_M[scenario]))


def _loaded(scenario: str, what: str) -> list[Any]:
    loaded: list[Any] = json.loads((FOLDER / scenario / f"{scenario}_{what}.json").read_text())
    return loaded


def scene_of(scenario: str, describe: dict[int, Description]) -> Scene:
    """The scene as these descriptions of the sensors have it."""
    return Scene(tuple(_feed(describe[sensor], scans_of(scenario, sensor), sensor) for sensor in SENSORS))


def _feed(description: Description, looks: tuple[Look, ...], sensor: int) -> Feed:
    columns: dict[str, list[float]] = {name: [] for name in ("time_s", "bearing_deg", "station_x_m", "station_y_m")}
    distance: list[float] = []
    for look in looks:
        bearing = look.seen
        if sensor not in CAMERAS:
            distance += list(np.hypot(*look.seen.T))
            bearing = np.degrees(np.arctan2(*look.seen.T))
        columns["bearing_deg"] += list(bearing)
        for name, value in (("time_s", look.time_s), ("station_x_m", look.own_m[0]), ("station_y_m", look.own_m[1])):
            columns[name] += [value] * len(bearing)
    said = columns if sensor in CAMERAS else columns | {"range_m": distance}
    looked = [look.time_s - (description.timing.latency_s or 0.0) for look in looks]
    return Feed.of(description, Reports.of(description.name, "table", said), scan_times_s=looked)


def off_hulls(delta_m: np.ndarray, half_m: np.ndarray) -> np.ndarray:
    """(2, n) how far positions lie from the vessels, (2, n, 2) metres off them, below 1 where on the hull."""
    return np.asarray(np.linalg.norm(delta_m, axis=2) / (MARGIN_M + half_m)[:, None])


def off_sights(delta_deg: np.ndarray, range_m: np.ndarray, half_m: np.ndarray) -> np.ndarray:
    """(2, n) how far bearings lie from those of the vessels at these ranges (2,), below 1 where on the hull."""
    wide = MARGIN_DEG + np.degrees(np.arctan2(half_m, range_m))
    return np.asarray(np.abs(delta_deg) / wide[:, None])


def turned(angle_deg: np.ndarray) -> np.ndarray:
    """Differences of bearings from −180° to 180°."""
    return np.asarray((angle_deg + 180.0) % 360.0 - 180.0)

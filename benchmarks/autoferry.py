"""Two vessels seen by radar, lidar, infrared and optical cameras: are they found as two, with the right members?

Real detections of the Autoferry sensor fusion benchmark (Helgesen and others 2022, CC0): three scenarios, two vessels
with GNSS truth that come as near to each other as 9 m. Every instant is judged on its own: the last look of every
sensor, and nothing remembered. Counted are instants at which two sensors or more show each of the vessels. One is right
where both are found as two objects, each with a detection of it from every sensor that shows it, and with nothing that
is not on its hull. Cameras split a hull of 36 m in two, so any detection on the hull is a right one; one where both
hulls lie may be either's.

Positions are compared where a sensor shows a vessel: root mean square of that sensor's error, and of the object's that
its detection is a member of.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from benchmarks.tables import Table, report
from sameas.many import identify_many
from sameas.objects import Objects
from sameas.observations import Region, records_of
from sameas.tracks.placement import Directions
from sameas.tracks.reports import Reports
from sameas.tracks.scene import POSITION_AND_VELOCITY, Feed, Instant, Scene
from sameas.tracks.source import Clutter, Coverage, Description, ErrorModel, Misses, Motion, Resolution, Timing

FOLDER = Path(__file__).resolve().parents[1].parent / "shared" / "data" / "autoferry"
SCENARIOS = ("scenario2", "scenario4", "scenario17")
SENSORS = (1, 2, 3, 4)
MOTION = Motion(acceleration_m2_per_s3=0.1, speed_m_per_s=3.0)
#: Half the length of the hulls: Havfruen, and Gunnerus (36 m) or the jet boat of the canal.
HALF_HULL_M = {"scenario2": (6.0, 18.0), "scenario4": (6.0, 18.0), "scenario17": (6.0, 5.0)}
#: How far from the hull a detection may be and still be one of it.
MARGIN_M, MARGIN_DEG = 8.0, 3.0
#: False detections of infrared and optical cameras per degree: two in a picture of the fjord, many in the canal.
CLUTTER_PER_DEG = {"scenario2": (0.001, 0.004), "scenario4": (0.001, 0.004), "scenario17": (0.013, 0.04)}


def descriptions(scenario: str) -> dict[int, Description]:
    """The sensors: errors, misses and clutter as seen against the truth of these data; a radar's stamp is late."""
    infrared, optical = CLUTTER_PER_DEG[scenario]
    laser = ErrorModel(range_m=1.0, bearing_deg=0.8, extent_m=3.0)
    radar = ErrorModel(range_m=2.0, range_share=0.0, bearing_deg=1.5, extent_m=3.5)
    camera, reach = ErrorModel(bearing_deg=2.0, extent_m=5.0), Coverage(range_m=300.0)
    late, cells = Timing(period_s=1.7, latency_s=1.5, latency_sigma_s=0.5), Resolution(range_m=5.0, bearing_deg=2.0)
    per_deg, per_km2 = (Clutter(per_deg=infrared), Clutter(per_deg=optical)), (Clutter(5.0), Clutter(15.0))
    return {
        1: Description("lidar", "lidar", misses=Misses(0.4), errors=laser, clutter=per_km2[0], motion=MOTION),
        2: Description("radar", "marine radar", coverage=reach, misses=Misses(0.15), errors=radar, clutter=per_km2[1],
                       resolution=cells, timing=late, motion=MOTION),
        3: Description("infrared", "camera", coverage=reach, misses=Misses(0.6), errors=camera, clutter=per_deg[0],
                       motion=MOTION),
        4: Description("electro-optical", "camera", coverage=reach, misses=Misses(0.3), errors=camera,
                       clutter=per_deg[1], motion=MOTION),
    }  # fmt: skip


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


def read(scenario: str) -> tuple[Scene, Truth]:
    """The scene and the truth of one scenario, in metres east and north of the data set's origin."""
    looks, describe = _loaded(scenario, "detections"), descriptions(scenario)
    feeds = tuple(_feed(describe[sensor], [look for look in looks if look["sensorID"] == sensor]) for sensor in SENSORS)
    rows = [row for rows in _loaded(scenario, "groundTruth") for row in (rows if isinstance(rows, list) else [rows])]
    times, places = [], []
    for vessel in (1, 2):
        own = {row["time"]: row["position"][1::-1] for row in rows if row["targetID"] == vessel}
        times.append(np.array(sorted(own)))
        places.append(np.array([own[t] for t in sorted(own)]))
    return Scene(feeds), Truth(tuple(times), tuple(places), np.array(HALF_HULL_M[scenario]))


def _loaded(scenario: str, what: str) -> list:
    return json.loads((FOLDER / scenario / f"{scenario}_{what}.json").read_text())


def _feed(description: Description, looks: list[dict]) -> Feed:
    """All looks of one sensor; a measurement is norths, then easts (radar, lidar), or bearings in radians (cameras)."""
    columns: dict[str, list] = {name: [] for name in ("time_s", "range_m", "bearing_deg", "station_x_m", "station_y_m")}
    for look in looks:
        seen = np.asarray(look["measurement"], dtype=np.float64).reshape(-1)
        own_north, own_east = look["ownshipPosition"]
        if description.kind != "camera":
            north, east = seen.reshape(2, -1)
            columns["range_m"] += list(np.hypot(east, north))
            bearing = np.degrees(np.arctan2(east, north))
        else:
            bearing = np.degrees(seen)
        columns["bearing_deg"] += list(bearing)
        for name, value in (("time_s", look["time"]), ("station_x_m", own_east), ("station_y_m", own_north)):
            columns[name] += [value] * len(bearing)
    if description.kind == "camera":
        del columns["range_m"]
    latency = description.timing.latency_s or 0.0
    looked = [look["time"] - latency for look in looks]
    return Feed.of(description, Reports.of(description.name, "table", columns), looked_s=looked)


@dataclass(frozen=True)
class Due:
    """What the sensors show of the vessels at an instant: distances from the hulls, below 1 where on the hull.

    cost : per sensor (2, n).
    """

    cost: tuple[np.ndarray, ...]

    @classmethod
    def of(cls, now: Instant, truth: Truth) -> Due:
        return cls(tuple(_cost(records_of(s).ids, feed, truth) for s, feed in zip(now.sources, now.feeds, strict=True)))

    def shows(self, vessel: int) -> np.ndarray:
        """(S,) whether each sensor shows the vessel: it has a detection on its hull that is nearer to it."""
        return np.array([bool(((c[vessel] < 1.0) & (c[vessel] <= c[1 - vessel])).any()) for c in self.cost], bool)

    def must_show(self, vessel: int) -> np.ndarray:
        """(S,) whether each sensor has a detection that is on its hull and not on the other's, which hides it."""
        return np.array([bool(((c[vessel] < 1.0) & (c[1 - vessel] >= 1.0)).any()) for c in self.cost], bool)

    def right(self, members: np.ndarray) -> bool:
        """Whether two of the objects, (n, S) members, are the two vessels."""
        fits = np.array([[self._fits(row, vessel) for vessel in (0, 1)] for row in members])
        return bool(fits.any(axis=0).all() and fits.any(axis=1).sum() >= 2)

    def _fits(self, row: np.ndarray, vessel: int) -> bool:
        on_hull = all(self.cost[s][vessel, k] < 1.0 for s, k in enumerate(row) if k >= 0)
        return on_hull and (row >= 0).sum() >= 2 and bool((row >= 0)[self.must_show(vessel)].all())


def _cost(rows: np.ndarray, feed: Feed, truth: Truth) -> np.ndarray:
    reports = feed.reports
    if not len(rows):
        return np.ones((2, 0))
    places = truth.at(float(reports.time_s[rows[0]]))
    if isinstance(reports, Directions):
        arm = places - reports.sensor_m[rows[0]]
        delta = reports.bearing_deg[rows] - np.degrees(np.arctan2(arm[:, 0], arm[:, 1]))[:, None]
        wide = MARGIN_DEG + np.degrees(np.arctan2(truth.half_m, np.hypot(*arm.T)))
        return np.abs((delta + 180.0) % 360.0 - 180.0) / wide[:, None]
    away = np.linalg.norm(reports.state[rows, :2] - places[:, None], axis=2)
    return away / (MARGIN_M + truth.half_m)[:, None]


@dataclass
class Tally:
    """Counts of one scenario; errors are pairs of a sensor's error and the fused one, by sensor."""

    instants: int = 0
    right: int = 0
    errors: dict[str, list[tuple[float, float]]] = field(default_factory=lambda: {"lidar": [], "radar": []})

    def add(self, due: Due, members: np.ndarray) -> None:
        if all(due.shows(vessel).sum() >= 2 for vessel in (0, 1)):
            self.instants += 1
            self.right += due.right(members)

    def measure(self, now: Instant, due: Due, found: Objects, members: np.ndarray, truth: Truth) -> None:
        """Errors of the records that show a vessel best, and of the objects that they are members of."""
        places = truth.at(now.instant_s)
        for s, feed in enumerate(now.feeds):
            if isinstance(feed.reports, Directions):
                continue
            seen = feed.reports.state[records_of(now.sources[s]).ids, :2]
            for v in (0, 1):
                if due.shows(v)[s]:
                    k = int(np.argmin(due.cost[s][v]))
                    state = found.fused.state[np.flatnonzero(members[:, s] == k)[0], :2]
                    own, fused = (float(np.linalg.norm(x - places[v])) for x in (seen[k], state))
                    self.errors[feed.description.name].append((own, fused))

    def root_mean_square(self, sensor: str) -> tuple[float, float]:
        """The sensor's, and the fused one where the sensor shows a vessel."""
        pairs = np.array(self.errors[sensor]).reshape(-1, 2)
        return (float("nan"),) * 2 if not len(pairs) else tuple(np.sqrt(np.mean(pairs**2, axis=0)))


def region_of(now: Instant) -> tuple[Region, float]:
    """120 m about the own ship, where eight objects are thought to be, and their density in the middle."""
    ship = np.mean(
        [feed.sensor_m[np.searchsorted(feed.reports.time_s, now.instant_s) - 1] for feed in now.feeds], axis=0
    )
    region = Region(np.concatenate([ship, [0.0, 0.0]]), (120.0, 120.0, 3.0, 3.0))
    return region, 8.0 / ((2.0 * np.pi) ** 2 * 120.0**2 * 3.0**2)


def run(scenario: str, step_s: float) -> Tally:
    """One scenario from its beginning to its end."""
    scene, truth = read(scenario)
    start, end = scene.span_s
    tally = Tally()
    for instant_s in np.arange(start + step_s, end, step_s):
        now = scene.at(instant_s, features=POSITION_AND_VELOCITY).heard()
        if len(now.sources) < 2:
            continue
        region, density = region_of(now)
        found = identify_many(now.sources, rule=replace(now, density=density).belief(), region=region)
        due, members = Due.of(now, truth), np.ma.filled(found.members, -1)
        tally.add(due, members)
        tally.measure(now, due, found, members, truth)
    return tally


def row_of(scenario: str, step_s: float) -> list[object]:
    """The table's row of one scenario."""
    tally = run(scenario, step_s)
    share = 100.0 * tally.right / max(tally.instants, 1)
    return [scenario, tally.instants, share, *tally.root_mean_square("lidar"), *tally.root_mean_square("radar")]


def main() -> None:
    """Prints the table and keeps it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--step", type=float, default=0.5, help="seconds between instants")
    options = parser.parse_args()
    if not FOLDER.exists():
        print(f"the data are not there: {FOLDER}")
        return
    columns = ("scenario", "instants", "right %", "lidar, m", "fused there", "radar, m", "fused there")
    rows = [row_of(scenario, options.step) for scenario in SCENARIOS]
    report("autoferry", [Table("Two vessels, four sensors", columns, rows)])


if __name__ == "__main__":
    main()

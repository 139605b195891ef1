"""How often two vessels seen by radar, lidar, infrared and optical cameras are identified correctly.

Real detections of the Autoferry sensor fusion benchmark (Helgesen et al. 2022, CC0): three scenarios with two vessels,
GNSS truth, closest approach 9 m. Errors, misses, clutter and latency of the sensors are estimated from the truth of the
two other scenarios (``autoferry_models.py``); the possible lengths of the vessels, their motion model and their number
are given. Two methods:

- alone: each instant on its own, from the latest scan of every sensor;
- with memory: :class:`sameas.picture.plot_tracker.PlotTracker`, every scan used once.

A last table is given the kinds of the sensors only: errors, clutter and latency are the defaults of the kind, or fitted
to the plots themselves (:mod:`sameas.tracks.error_fit`).

An instant counts if at least two sensors detect each vessel. It is right if the vessels are two objects, each with a
detection from every sensor that detects it, and all members on its hull. Cameras split a hull of 36 m in two, so any
detection on the hull is a right one; a detection on both hulls may belong to either.

Position errors are RMS where a sensor detects a vessel: of the sensor, and of the object with its detection.
``scripts/bench autoferry``, 3 minutes; skipped without the data.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from benchmarks.autoferry_models import KIND, NAME, SensorModel, describe_all, models_from_others
from benchmarks.autoferry_scenes import (
    FOLDER,
    SCENARIOS,
    SENSORS,
    Truth,
    bearing_difference,
    hull_bearing_distance,
    hull_distance,
    scene_of,
    truth_of,
)
from benchmarks.tables import Table, report
from sameas.many.identify import identify_many
from sameas.many.observations import Region, records_of
from sameas.picture.plot_tracker import PlotTracker, TrackedPlots
from sameas.tracks.feed import Feed
from sameas.tracks.placement import Directions
from sameas.tracks.scene import POSITION_AND_VELOCITY, Instant, Scene
from sameas.tracks.source import Description

METHODS = ("alone", "with memory")
#: Below this scaled distance a detection is just off the hull.
NEARLY = 1.3
#: Edges of the bins of the distance between the vessels.
DISTANCE_BINS_M = (0.0, 20.0, 50.0, 100.0, np.inf)


@dataclass(frozen=True)
class Detected:
    """Which detections of an instant lie on the hulls of the vessels.

    distance : per sensor (2, n) scaled distances from the hulls, below 1 on the hull. names : of the sensors.
    """

    distance: tuple[np.ndarray, ...]
    names: tuple[str, ...]

    @classmethod
    def of(cls, now: Instant, truth: Truth) -> Detected:
        pairs = zip(now.sources, now.feeds, strict=True)
        distance = tuple(_hull_distance(records_of(source).ids, feed, truth) for source, feed in pairs)
        return cls(distance, tuple(d.name for d in now.descriptions))

    def detects(self, vessel: int) -> np.ndarray:
        """(S,) whether each sensor has a detection on the hull that is not nearer to the other vessel."""
        return np.array([bool(((d[vessel] < 1.0) & (d[vessel] <= d[1 - vessel])).any()) for d in self.distance], bool)

    def detects_alone(self, vessel: int) -> np.ndarray:
        """(S,) whether each sensor has a detection on the hull that is not on the other hull too."""
        return np.array([bool(((d[vessel] < 1.0) & (d[1 - vessel] >= 1.0)).any()) for d in self.distance], bool)

    @property
    def counts(self) -> bool:
        """Whether at least two sensors detect each of the vessels."""
        return all(self.detects(vessel).sum() >= 2 for vessel in (0, 1))

    def right(self, members: np.ndarray) -> bool:
        """Whether two of the objects, with (n, S) members, are the two vessels."""
        fits = np.array([[self.fits(row, vessel) for vessel in (0, 1)] for row in members]).reshape(-1, 2)
        return bool(fits.any(axis=0).all() and fits.any(axis=1).sum() >= 2)

    def fits(self, row: np.ndarray, vessel: int) -> bool:
        """Whether an object with these members is the vessel."""
        on_hull = all(self.distance[s][vessel, k] < 1.0 for s, k in enumerate(row) if k >= 0)
        return on_hull and (row >= 0).sum() >= 2 and bool((row >= 0)[self.detects_alone(vessel)].all())

    def failures(self, members: np.ndarray) -> Iterator[str]:
        """What is wrong with the object that fits each vessel best, in words."""
        for vessel in (0, 1):
            if any(self.fits(row, vessel) for row in members):
                continue
            on_hull = [[self.distance[s][vessel, k] < 1.0 for s, k in enumerate(row) if k >= 0] for row in members]
            best = max(range(len(members)), key=lambda n: 2 * sum(on_hull[n]) - len(on_hull[n]), default=None)
            if best is None or sum(on_hull[best]) < 2:
                yield "not found"
                continue
            row = members[best]
            for s in np.flatnonzero(row >= 0):
                distance = self.distance[s][vessel, row[s]]
                if distance >= 1.0:
                    yield f"{self.names[s]}: " + ("just off the hull" if distance < NEARLY else "wrong member")
            for s in np.flatnonzero(self.detects_alone(vessel) & (row < 0)).tolist():
                yield f"{self.names[s]}: " + self._missing_member(members, s, vessel)

    def _missing_member(self, members: np.ndarray, s: int, vessel: int) -> str:
        """Where the sensor's detections on the hull are instead."""
        own = np.flatnonzero(self.distance[s][vessel] < 1.0)
        for row in members[np.isin(members[:, s], own)]:
            others = [self.distance[t][vessel, k] < 1.0 for t, k in enumerate(row) if k >= 0 and t != s]
            if others:
                return "in another object on the hull" if all(others) else "in a wrong object"
        return "unmatched"


def _hull_distance(rows: np.ndarray, feed: Feed, truth: Truth) -> np.ndarray:
    reports = feed.reports
    if not len(rows):
        return np.ones((2, 0))
    instant_s = float(reports.time_s[rows[0]])
    true = truth.at(instant_s)
    if isinstance(reports, Directions):
        offset = true - reports.sensor_m[rows[0]]
        delta = bearing_difference(reports.bearing_deg[rows] - np.degrees(np.arctan2(*offset.T))[:, None])
        return hull_bearing_distance(delta, offset, truth, instant_s)
    return hull_distance(reports.state[rows, :2] - true[:, None], truth.half_m)


@dataclass(frozen=True)
class Objects:
    """The objects of an instant: (n, S) members, (n, 2) positions with (n, 2, 2) covariances, (n,) track numbers."""

    members: np.ndarray
    position: np.ndarray
    covariance: np.ndarray
    number: np.ndarray | None = None


@dataclass
class Tally:
    """The results of one method in one scenario.

    instants : time, distance of the vessels and whether right, of every instant that counts. failures : reasons where
        it is wrong. errors : by sensor, its error at the instant, that of the object, and its error at the time of its
        scan, m. nees : per dimension. changes : of the vessels' track numbers. last : number of each vessel.
    """

    instants: list[tuple[float, float, bool]] = field(default_factory=list)
    failures: Counter[str] = field(default_factory=Counter)
    errors: dict[str, list[tuple[float, float, float]]] = field(default_factory=lambda: {"lidar": [], "radar": []})
    nees: list[float] = field(default_factory=list)
    changes: int = 0
    last: dict[int, int] = field(default_factory=dict)

    def add(self, now: Instant, detected: Detected, objects: Objects, truth: Truth) -> None:
        """Add one instant."""
        places = truth.at(now.instant_s)
        if detected.counts:
            right = detected.right(objects.members)
            self.instants.append((now.instant_s, float(np.linalg.norm(places[0] - places[1])), right))
            self.failures.update(() if right else set(detected.failures(objects.members)))
        for s, feed in enumerate(now.feeds):
            if not isinstance(feed.reports, Directions):
                for vessel in (0, 1):
                    self._add_errors(now, detected, objects, (s, vessel), truth)

    def _add_errors(
        self, now: Instant, detected: Detected, objects: Objects, sensor_and_vessel: tuple[int, int], truth: Truth
    ) -> None:
        """Add the errors of a sensor's nearest detection on the hull of a vessel, and of the object with it."""
        s, vessel = sensor_and_vessel
        true = truth.at(now.instant_s)[vessel]
        distance = detected.distance[s]
        on_hull = np.flatnonzero((distance[vessel] < 1.0) & (distance[vessel] <= distance[1 - vessel]))
        if not len(on_hull):
            return
        best = int(on_hull[distance[vessel, on_hull].argmin()])
        feed, (n, *_) = now.feeds[s], np.flatnonzero(objects.members[:, s] == best)
        measured = feed.reports.state[records_of(now.sources[s]).ids[best], :2]  # type: ignore[union-attr]
        error = objects.position[n] - true
        scan_s = feed.reports.time_s[records_of(now.sources[s]).ids[best]]
        errors = measured - true, error, measured - truth.at(float(scan_s))[vessel]
        sensor, fused, at_scan = (float(np.linalg.norm(e)) for e in errors)
        self.errors[feed.description.name].append((sensor, fused, at_scan))
        self.nees.append(float(error @ np.linalg.solve(objects.covariance[n], error)) / 2.0)
        if objects.number is not None:
            numbers = objects.number[np.isin(objects.members[:, s], on_hull)].tolist()
            self.changes += vessel in self.last and self.last[vessel] not in numbers
            self.last[vessel] = self.last[vessel] if self.last.get(vessel) in numbers else int(objects.number[n])

    def percent_right(self, nearest_m: float = 0.0, farthest_m: float = np.inf) -> float:
        """Per cent of the instants that are right, of those with the vessels within this range of distances."""
        right = [right for _, distance_m, right in self.instants if nearest_m <= distance_m < farthest_m]
        return 100.0 * float(np.mean(right)) if right else float("nan")

    def rms(self, sensor: str) -> tuple[float, float, float]:
        """RMS errors: of the sensor, of the objects with its detections, of the sensor at the time of its scan."""
        own, fused, at_scan = np.sqrt(np.mean(np.square(self.errors[sensor]).reshape(-1, 3), axis=0)).tolist()
        return own, fused, at_scan


def with_density(now: Instant) -> Instant:
    """The instant with a prior of eight objects around the own ship (Gaussian, σ 120 m and 3 m/s)."""
    ship = np.mean([feed.sensor_at(now.instant_s) for feed in now.feeds], axis=0)
    region = Region(np.concatenate([ship, [0.0, 0.0]]), (120.0, 120.0, 3.0, 3.0))
    return replace(now, region=region, density=8.0 / ((2.0 * np.pi) ** 2 * 120.0**2 * 3.0**2))


def run(scenario: str, models: dict[int, SensorModel], step_s: float) -> dict[str, Tally]:
    """One scenario by every method, with the sensor models of ``models``."""
    return scored(scenario, scene_of(scenario, describe_all(models, scenario)), step_s, with_density)


def scored(
    scenario: str, scene: Scene, step_s: float, prior: Callable[[Instant], Instant], methods: Sequence[str] = METHODS
) -> dict[str, Tally]:
    """The results of every method on a scene of one scenario; ``prior`` sets the prior of an instant."""
    truth = truth_of(scenario)
    start, end = scene.span_s
    tallies = {method: Tally() for method in methods}
    tracker, tracks = PlotTracker(), None
    for instant_s in np.arange(start + step_s, end, step_s):
        now = prior(scene.at(instant_s, features=POSITION_AND_VELOCITY))
        tracks = tracker.advance(now, tracks)
        reporting = now.with_records()
        if len(reporting.sources) < 2:
            continue
        detected = Detected.of(reporting, truth)
        for method, tally in tallies.items():
            tally.add(reporting, detected, alone(reporting) if method == "alone" else tracked(tracks), truth)
    return tallies


def alone(now: Instant) -> Objects:
    """The objects of one instant on its own."""
    identified = identify_many(now.sources, rule=now.rule(), region=now.region)
    covariance = identified.fused.covariance[:, :2, :2] + now.shared_error_m**2 * np.eye(2)
    return Objects(np.ma.filled(identified.members, -1), identified.fused.state[:, :2], covariance)


def tracked(tracks: TrackedPlots) -> Objects:
    """The tracked objects, with members of the sources that have records at the instant."""
    reporting = [s for s, source in enumerate(tracks.now.sources) if len(records_of(source))]
    state, covariance = tracks.state[:, :2], tracks.covariance[:, :2, :2]
    return Objects(tracks.members[:, reporting], state, covariance, tracks.number)


def tables(step_s: float) -> Iterator[Table]:
    """The tables over all scenarios."""
    results = {scenario: run(scenario, models_from_others(scenario, SCENARIOS), step_s) for scenario in SCENARIOS}
    yield _right(results)
    yield _distances(results)
    yield _positions(results)
    yield _failures(results)
    yield kinds_only(step_s)


def _right(results: dict[str, dict[str, Tally]]) -> Table:
    columns = ("scenario", "instants", *(f"right % {method}" for method in METHODS), "number changes")
    rows, notes = [], []
    for scenario, by_method in results.items():
        last = by_method[METHODS[-1]]
        rows.append([scenario, len(last.instants), *(t.percent_right() for t in by_method.values()), last.changes])
        start = last.instants[0][0]
        wrong = ", ".join(f"{t - start:.1f} ({apart_m:.0f} m)" for t, apart_m, right in last.instants if not right)
        notes.append(f"{scenario}, wrong with memory, seconds from the first (distance of the vessels): {wrong}")
    return Table("Two vessels, four sensors, models estimated from the other two scenarios", columns, rows, notes)


def _distances(results: dict[str, dict[str, Tally]]) -> Table:
    rows: list[list[object]] = []
    for scenario, by_method in results.items():
        for near, far in pairwise(DISTANCE_BINS_M):
            number = sum(near <= distance_m < far for _, distance_m, _ in by_method[METHODS[0]].instants)
            if number:
                label = f"{near:g} to {far:g} m" if np.isfinite(far) else f"{near:g} m and more"
                rows.append([scenario, label, number, *(t.percent_right(near, far) for t in by_method.values())])
    return Table(
        "By the distance of the vessels",
        ("scenario", "distance", "instants", *(f"right % {method}" for method in METHODS)),
        rows,
    )


def _positions(results: dict[str, dict[str, Tally]]) -> Table:
    columns = (
        "scenario",
        "sensor",
        "sensor RMS, m",
        "at its scan",
        *(f"fused {method}" for method in METHODS),
        *(f"NEES {method}" for method in METHODS),
    )
    rows: list[list[object]] = []
    for scenario, by_method in results.items():
        nees = [float(np.mean(tally.nees)) for tally in by_method.values()]
        for sensor in ("lidar", "radar"):
            rms = [tally.rms(sensor) for tally in by_method.values()]
            rows.append([scenario, sensor, rms[0][0], rms[0][2], *(fused for _, fused, _ in rms), *nees])
    notes = (
        "sensor RMS at the instant includes the age of the scan; for approaching vessels that and the bias to the near "
        "side of the hull cancel",
        "NEES per dimension of all objects with a radar or lidar detection, 1 if the covariances are right",
    )
    return Table("Position errors where the sensor detects a vessel", columns, rows, notes)


def positions(step_s: float) -> Table:
    """Errors of the fused positions and of the sensors in all scenarios."""
    return _positions({one: run(one, models_from_others(one, SCENARIOS), step_s) for one in SCENARIOS})


def kinds_only(step_s: float) -> Table:
    """All scenarios with the kinds of the sensors given only: errors of the kind, and errors fitted to the plots."""
    kinds = {sensor: Description(NAME[sensor], KIND[sensor]) for sensor in SENSORS}
    rows: list[list[object]] = []
    notes = []
    for scenario in SCENARIOS:
        assumed = scene_of(scenario, kinds)
        estimated, fit = assumed.with_fitted_errors()
        notes.append(f"{scenario}: {'; '.join(fit.lines())}; shared ± {fit.shared_m:.2g} m")
        for label, scene in (("of the kind", assumed), ("estimated", estimated)):
            tally = scored(scenario, scene, step_s, lambda now: now, METHODS[1:])["with memory"]
            lidar, radar = tally.rms("lidar"), tally.rms("radar")
            rows.append([scenario, label, tally.percent_right(), *lidar, *radar, float(np.mean(tally.nees))])
    columns = (
        "scenario", "errors", "right %", "lidar, m", "fused", "at its scan", "radar, m", "fused", "at its scan", "NEES"
    )  # fmt: skip
    return Table("With memory, only the kinds of the sensors given", columns, rows, tuple(notes))


def _failures(results: dict[str, dict[str, Tally]]) -> Table:
    rows: list[list[object]] = []
    for scenario, by_method in results.items():
        reasons = sorted({reason for tally in by_method.values() for reason in tally.failures})
        rows += [[scenario, reason, *(t.failures[reason] for t in by_method.values())] for reason in reasons]
    columns = ("scenario", "failure", *METHODS)
    return Table("Wrong instants by failure (an instant may have several)", columns, rows)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--step", type=float, default=0.5, help="seconds between instants")
    options = parser.parse_args()
    if not FOLDER.exists():
        print(f"no data: {FOLDER} does not exist")
        return
    report("autoferry", tables(options.step))


if __name__ == "__main__":
    main()

"""Two vessels seen by radar, lidar, infrared and optical cameras: are they found as two, with the right members?

Real detections of the Autoferry sensor fusion benchmark (Helgesen and others 2022, CC0): three scenarios, two vessels
with GNSS truth that come as near to each other as 9 m. What is told of the sensors, errors, misses, clutter, latency,
is learned from the truth of the two scenarios that are not judged; the lengths of the vessels that may be there, how
they move, and how many, are told. Two ways are judged:

- alone: every instant for itself, the last look of every sensor;
- with memory: :class:`sameas.picture.plot_tracker.PlotTracker`, every look used once.

A last table tells nothing but the kinds of the sensors: errors, clutter and late stamps are those of the kinds, or
those that the plots themselves show (:mod:`sameas.tracks.error_fit`).

Counted are instants at which two sensors or more show each of the vessels. One is right where both are found as two
objects, each with a detection of it from every sensor that shows it, and with nothing that is not on its hull. Cameras
split a hull of 36 m in two, so any detection on the hull is a right one; one where both hulls lie may be either's.

Positions are compared where a sensor shows a vessel: root mean square of that sensor's error, and of the object's that
its detection is a member of.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from benchmarks.autoferry_models import KIND, NAME, Learned, describe_all, learned_elsewhere
from benchmarks.autoferry_scenes import (
    FOLDER,
    SCENARIOS,
    SENSORS,
    Truth,
    off_hulls,
    off_sights,
    scene_of,
    truth_of,
    turned,
)
from benchmarks.tables import Table, report
from sameas.many.identify import identify_many
from sameas.many.observations import Region, records_of
from sameas.picture.plot_tracker import PlotTracker, TrackedPlots
from sameas.tracks.feed import Feed
from sameas.tracks.placement import Directions
from sameas.tracks.scene import POSITION_AND_VELOCITY, Instant, Scene
from sameas.tracks.source import Description

WAYS = ("alone", "with memory")
#: Off the hull, but by so little that the criterion is to blame.
NEARLY = 1.3
#: Between these distances of the vessels instants are told apart.
APART_M = (0.0, 20.0, 50.0, 100.0, np.inf)


@dataclass(frozen=True)
class Due:
    """What the sensors show of the vessels at an instant: distances from the hulls, below 1 where on the hull.

    cost : per sensor (2, n). names : of the sensors.
    """

    cost: tuple[np.ndarray, ...]
    names: tuple[str, ...]

    @classmethod
    def of(cls, now: Instant, truth: Truth) -> Due:
        pairs = zip(now.sources, now.feeds, strict=True)
        cost = tuple(_cost(records_of(source).ids, feed, truth) for source, feed in pairs)
        return cls(cost, tuple(d.name for d in now.descriptions))

    def shows(self, vessel: int) -> np.ndarray:
        """(S,) whether each sensor shows the vessel: it has a detection on its hull that is nearer to it."""
        return np.array([bool(((c[vessel] < 1.0) & (c[vessel] <= c[1 - vessel])).any()) for c in self.cost], bool)

    def must_show(self, vessel: int) -> np.ndarray:
        """(S,) whether each sensor has a detection that is on its hull and not on the other's, which hides it."""
        return np.array([bool(((c[vessel] < 1.0) & (c[1 - vessel] >= 1.0)).any()) for c in self.cost], bool)

    @property
    def counts(self) -> bool:
        """Whether two sensors or more show each of the vessels."""
        return all(self.shows(vessel).sum() >= 2 for vessel in (0, 1))

    def right(self, members: np.ndarray) -> bool:
        """Whether two of the objects, (n, S) members, are the two vessels."""
        fits = np.array([[self.fits(row, vessel) for vessel in (0, 1)] for row in members]).reshape(-1, 2)
        return bool(fits.any(axis=0).all() and fits.any(axis=1).sum() >= 2)

    def fits(self, row: np.ndarray, vessel: int) -> bool:
        """Whether an object with these members is the vessel."""
        on_hull = all(self.cost[s][vessel, k] < 1.0 for s, k in enumerate(row) if k >= 0)
        return on_hull and (row >= 0).sum() >= 2 and bool((row >= 0)[self.must_show(vessel)].all())

    def failures(self, members: np.ndarray) -> Iterator[str]:
        """What is wrong with the objects nearest to being the vessels, in words."""
        for vessel in (0, 1):
            if any(self.fits(row, vessel) for row in members):
                continue
            on = [[self.cost[s][vessel, k] < 1.0 for s, k in enumerate(row) if k >= 0] for row in members]
            best = max(range(len(members)), key=lambda n: 2 * sum(on[n]) - len(on[n]), default=None)
            if best is None or sum(on[best]) < 2:
                yield "not found"
                continue
            row = members[best]
            for s in np.flatnonzero(row >= 0):
                cost = self.cost[s][vessel, row[s]]
                if cost >= 1.0:
                    yield f"{self.names[s]}: " + ("just off the hull" if cost < NEARLY else "something else taken in")
            for s in np.flatnonzero(self.must_show(vessel) & (row < 0)).tolist():
                yield f"{self.names[s]}: " + self._left_out(members, s, vessel)

    def _left_out(self, members: np.ndarray, s: int, vessel: int) -> str:
        """Where the sensor's detections on the hull went."""
        mine = np.flatnonzero(self.cost[s][vessel] < 1.0)
        for row in members[np.isin(members[:, s], mine)]:
            others = [self.cost[t][vessel, k] < 1.0 for t, k in enumerate(row) if k >= 0 and t != s]
            if others:
                return "with another part of the hull" if all(others) else "taken by something else"
        return "left alone"


def _cost(rows: np.ndarray, feed: Feed, truth: Truth) -> np.ndarray:
    reports = feed.reports
    if not len(rows):
        return np.ones((2, 0))
    places = truth.at(float(reports.time_s[rows[0]]))
    if isinstance(reports, Directions):
        arm = places - reports.sensor_m[rows[0]]
        delta = turned(reports.bearing_deg[rows] - np.degrees(np.arctan2(*arm.T))[:, None])
        return off_sights(delta, np.hypot(*arm.T), truth.half_m)
    return off_hulls(reports.state[rows, :2] - places[:, None], truth.half_m)


@dataclass(frozen=True)
class Found:
    """The objects of an instant: (n, S) members, (n, 2) positions with (n, 2, 2) covariances; numbers (n,), if any."""

    members: np.ndarray
    position: np.ndarray
    covariance: np.ndarray
    number: np.ndarray | None = None


@dataclass
class Tally:
    """Counts of one scenario, judged in one way.

    judged : of every instant that counts its time, how far the vessels are apart, and whether it is right. wrong : what
        is wrong where it is not. errors : by sensor its error at the instant, the fused one, and the sensor's at the
        time of its look. changes : of the vessels' numbers.
    """

    judged: list[tuple[float, float, bool]] = field(default_factory=list)
    wrong: Counter[str] = field(default_factory=Counter)
    errors: dict[str, list[tuple[float, float, float]]] = field(default_factory=lambda: {"lidar": [], "radar": []})
    square: list[float] = field(default_factory=list)
    changes: int = 0
    last: dict[int, int] = field(default_factory=dict)

    def add(self, now: Instant, due: Due, found: Found, truth: Truth) -> None:
        """One instant."""
        places = truth.at(now.instant_s)
        if due.counts:
            right = due.right(found.members)
            self.judged.append((now.instant_s, float(np.linalg.norm(places[0] - places[1])), right))
            self.wrong.update(() if right else set(due.failures(found.members)))
        for s, feed in enumerate(now.feeds):
            if not isinstance(feed.reports, Directions):
                for vessel in (0, 1):
                    self._measure(now, due, found, (s, vessel), truth)

    def _measure(self, now: Instant, due: Due, found: Found, which: tuple[int, int], truth: Truth) -> None:
        """Errors of the detection of a sensor that shows a vessel best, and of the object that it is a member of."""
        s, vessel = which
        place = truth.at(now.instant_s)[vessel]
        cost = due.cost[s]
        shown = np.flatnonzero((cost[vessel] < 1.0) & (cost[vessel] <= cost[1 - vessel]))
        if not len(shown):
            return
        best = int(shown[cost[vessel, shown].argmin()])
        feed, (n, *_) = now.feeds[s], np.flatnonzero(found.members[:, s] == best)
        seen = feed.reports.state[records_of(now.sources[s]).ids[best], :2]  # type: ignore[union-attr]
        off = found.position[n] - place
        looked_s = feed.reports.time_s[records_of(now.sources[s]).ids[best]]
        errors = seen - place, off, seen - truth.at(float(looked_s))[vessel]
        one, fused, at_look = (float(np.linalg.norm(error)) for error in errors)
        self.errors[feed.description.name].append((one, fused, at_look))
        self.square.append(float(off @ np.linalg.solve(found.covariance[n], off)) / 2.0)
        if found.number is not None:
            numbers = found.number[np.isin(found.members[:, s], shown)].tolist()
            self.changes += vessel in self.last and self.last[vessel] not in numbers
            self.last[vessel] = self.last[vessel] if self.last.get(vessel) in numbers else int(found.number[n])

    def share(self, nearest_m: float = 0.0, farthest_m: float = np.inf) -> float:
        """Per cent of the instants that are right, of those at which the vessels are so far apart."""
        right = [right for _, apart_m, right in self.judged if nearest_m <= apart_m < farthest_m]
        return 100.0 * float(np.mean(right)) if right else float("nan")

    def root_mean_square(self, sensor: str) -> tuple[float, float, float]:
        """The sensor's, the fused one where the sensor shows a vessel, and the sensor's at the time of its look."""
        own, fused, at_look = np.sqrt(np.mean(np.square(self.errors[sensor]).reshape(-1, 3), axis=0)).tolist()
        return own, fused, at_look


def among_few(now: Instant) -> Instant:
    """The instant with eight objects thought to be within 120 m about the own ship."""
    ship = np.mean([feed.sensor_at(now.instant_s) for feed in now.feeds], axis=0)
    region = Region(np.concatenate([ship, [0.0, 0.0]]), (120.0, 120.0, 3.0, 3.0))
    return replace(now, region=region, density=8.0 / ((2.0 * np.pi) ** 2 * 120.0**2 * 3.0**2))


def run(scenario: str, models: dict[int, Learned], step_s: float) -> dict[str, Tally]:
    """One scenario from its beginning to its end, in every way, with sensors as described by ``models``."""
    return judged(scenario, scene_of(scenario, describe_all(models, scenario)), step_s, among_few)


def judged(
    scenario: str, scene: Scene, step_s: float, told: Callable[[Instant], Instant], ways: Sequence[str] = WAYS
) -> dict[str, Tally]:
    """A scene of one scenario from its beginning to its end; ``told`` adds to an instant what is told."""
    truth = truth_of(scenario)
    start, end = scene.span_s
    tallies = {way: Tally() for way in ways}
    tracker, tracks = PlotTracker(), None
    for instant_s in np.arange(start + step_s, end, step_s):
        now = told(scene.at(instant_s, features=POSITION_AND_VELOCITY))
        tracks = tracker.advance(now, tracks)
        heard = now.with_records()
        if len(heard.sources) < 2:
            continue
        due = Due.of(heard, truth)
        for way, tally in tallies.items():
            tally.add(heard, due, alone(heard) if way == "alone" else followed(tracks), truth)
    return tallies


def alone(heard: Instant) -> Found:
    """An instant for itself."""
    found = identify_many(heard.sources, rule=heard.rule(), region=heard.region)
    covariance = found.fused.covariance[:, :2, :2] + heard.shared_error_m**2 * np.eye(2)
    return Found(np.ma.filled(found.members, -1), found.fused.state[:, :2], covariance)


def followed(tracks: TrackedPlots) -> Found:
    """What was followed, of the sources that say something."""
    heard = [s for s, source in enumerate(tracks.now.sources) if len(records_of(source))]
    state, covariance = tracks.state[:, :2], tracks.covariance[:, :2, :2]
    return Found(tracks.members[:, heard], state, covariance, tracks.number)


def tables(step_s: float) -> Iterator[Table]:
    """Judges all scenarios."""
    done = {scenario: run(scenario, learned_elsewhere(scenario, SCENARIOS), step_s) for scenario in SCENARIOS}
    yield _shares(done)
    yield _distances(done)
    yield _positions(done)
    yield _failures(done)
    yield untold(step_s)


def _shares(done: dict[str, dict[str, Tally]]) -> Table:
    columns = ("scenario", "instants", *(f"right % {way}" for way in WAYS), "numbers changed")
    rows, notes = [], []
    for scenario, by_way in done.items():
        last = by_way[WAYS[-1]]
        rows.append([scenario, len(last.judged), *(tally.share() for tally in by_way.values()), last.changes])
        start = last.judged[0][0]
        wrong = ", ".join(f"{t - start:.1f} ({apart_m:.0f} m)" for t, apart_m, right in last.judged if not right)
        notes.append(f"{scenario}, not right with memory, seconds from the first (vessels apart): {wrong}")
    return Table("Two vessels, four sensors, models learned from the other two scenarios", columns, rows, notes)


def _distances(done: dict[str, dict[str, Tally]]) -> Table:
    rows: list[list[object]] = []
    for scenario, by_way in done.items():
        for near, far in pairwise(APART_M):
            number = sum(near <= apart_m < far for _, apart_m, _ in by_way[WAYS[0]].judged)
            if number:
                here = f"{near:g} to {far:g} m" if np.isfinite(far) else f"{near:g} m and more"
                rows.append([scenario, here, number, *(tally.share(near, far) for tally in by_way.values())])
    return Table(
        "By the distance of the vessels",
        ("scenario", "apart", "instants", *(f"right % {way}" for way in WAYS)),
        rows,
    )


def _positions(done: dict[str, dict[str, Tally]]) -> Table:
    columns = (
        "scenario",
        "sensor",
        "its error, m",
        "at its look",
        *(f"fused {way}" for way in WAYS),
        *(f"NEES {way}" for way in WAYS),
    )
    rows: list[list[object]] = []
    for scenario, by_way in done.items():
        nees = [float(np.mean(tally.square)) for tally in by_way.values()]
        for sensor in ("lidar", "radar"):
            pairs = [tally.root_mean_square(sensor) for tally in by_way.values()]
            rows.append([scenario, sensor, pairs[0][0], pairs[0][2], *(fused for _, fused, _ in pairs), *nees])
    notes = (
        "its error at the instant has its age: of a vessel that approaches, that and the near side cancel",
        "NEES per dimension of all objects that a sensor of positions shows, 1 where covariances are right",
    )
    return Table("Positions where the sensor shows a vessel", columns, rows, notes)


def positions(step_s: float) -> Table:
    """Errors of the fused positions in all scenarios, beside those of the sensors."""
    return _positions({one: run(one, learned_elsewhere(one, SCENARIOS), step_s) for one in SCENARIOS})


def untold(step_s: float) -> Table:
    """All scenarios with nothing told but what kind a sensor is: errors of its kind, and those that its plots show."""
    kinds = {sensor: Description(NAME[sensor], KIND[sensor]) for sensor in SENSORS}
    rows: list[list[object]] = []
    notes = []
    for scenario in SCENARIOS:
        assumed = scene_of(scenario, kinds)
        estimated, fit = assumed.with_fitted_errors()
        notes.append(f"{scenario}: {'; '.join(fit.lines())}; in common ± {fit.shared_m:.2g} m")
        for words, scene in (("of the kinds", assumed), ("estimated", estimated)):
            tally = judged(scenario, scene, step_s, lambda now: now, WAYS[1:])["with memory"]
            lidar, radar = tally.root_mean_square("lidar"), tally.root_mean_square("radar")
            rows.append([scenario, words, tally.share(), *lidar, *radar, float(np.mean(tally.square))])
    columns = (
        "scenario", "errors", "right %", "lidar, m", "fused", "at its look", "radar, m", "fused", "at its look", "NEES"
    )  # fmt: skip
    return Table("With memory, nothing told of the sensors but their kinds", columns, rows, tuple(notes))


def _failures(done: dict[str, dict[str, Tally]]) -> Table:
    rows: list[list[object]] = []
    for scenario, by_way in done.items():
        kinds = sorted({kind for tally in by_way.values() for kind in tally.wrong})
        rows += [[scenario, kind, *(tally.wrong[kind] for tally in by_way.values())] for kind in kinds]
    columns = ("scenario", "what is wrong", *WAYS)
    return Table("Instants that are not right, by what is wrong (several may be)", columns, rows)


def main() -> None:
    """Prints the tables and keeps them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--step", type=float, default=0.5, help="seconds between instants")
    options = parser.parse_args()
    if not FOLDER.exists():
        print(f"the data are not there: {FOLDER}")
        return
    report("autoferry", tables(options.step))


if __name__ == "__main__":
    main()

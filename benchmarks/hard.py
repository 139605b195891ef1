"""Pictures of small fleets with one unstated sensor trouble each, 19 kinds: stated probabilities against the truth.

Fourteen ships in a bay, or aircraft, turn slowly near each other; three of four report (AIS or ADS-B), the others do
not. Trackers and radars see them, and each kind of scene has one trouble that the descriptions of the sensors do not
state. The picture is made as by ``sameas picture``, with estimated offsets. Scored is every object with two records or
an alternative: stated probability against the frequency with which exactly its records are one ship; and wrong and
missed pairs, compared with mutual nearest within the 99 % region of the stated errors.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from itertools import combinations, pairwise

import numpy as np

from benchmarks.tables import Table, report
from sameas.picture.picture import picture_states, watch_of
from sameas.picture.picture_state import PictureState
from sameas.tracks.reports import Reports
from sameas.tracks.scene import Scene
from sameas.tracks.source import Clutter, Description, MissRate, Motion, SensorErrors, Site, Timing

SPAN_S, WARM_S, EVERY_S = 400.0, 100.0, 10.0
#: Bins of the stated probability.
BINS = (0.0, 0.5, 0.8, 0.95, 0.99, 1.0 + 1e-9)
SURE = 0.99
GATE = 9.21  # χ² of two degrees of freedom that 99 % stay below


@dataclass(frozen=True)
class Fleet:
    """Objects (n,) on circles: centres (n, 2) and radii in metres, phases, turn rates in rad/s, heights in metres."""

    centre: np.ndarray
    radius: np.ndarray
    phase: np.ndarray
    turn: np.ndarray
    height: np.ndarray

    def at(self, rows: np.ndarray, time_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(k, 2) positions and velocities of objects at times."""
        angle = self.phase[rows] + self.turn[rows] * time_s
        direction = np.column_stack([np.cos(angle), np.sin(angle)])
        position = self.centre[rows] + self.radius[rows, None] * direction
        return position, (self.radius * self.turn)[rows, None] * np.column_stack([-direction[:, 1], direction[:, 0]])

    @classmethod
    def of(cls, rng: np.random.Generator, n: int, width_m: float, speed: tuple[float, float], height: float) -> Fleet:
        """``n`` objects in a square; heights uniform between 0 and ``height``."""
        turn = np.radians(rng.uniform(0.15, 0.4, n)) * rng.choice([-1.0, 1.0], n)
        radius = rng.uniform(*speed, n) / np.abs(turn)
        phase = rng.uniform(0.0, 2.0 * np.pi, n)
        centre = rng.uniform(0.0, width_m, (n, 2))
        return cls(centre, radius, phase, turn, rng.uniform(0.0, height, n))

    def in_convoy(self, spacing_m: float) -> Fleet:
        """The fleet in pairs abreast."""
        lead = np.arange(len(self.turn)) // 2 * 2
        aside = spacing_m * (np.arange(len(self.turn)) % 2)
        return Fleet(self.centre[lead], self.radius[lead] + aside, self.phase[lead], self.turn[lead], self.height[lead])

    def crossing(self, rng: np.random.Generator) -> Fleet:
        """The fleet; every second object passes the previous one within some 20 m in mid-run, at an angle."""
        lead = np.arange(len(self.turn)) // 2 * 2
        followers = np.flatnonzero(np.arange(len(self.turn)) % 2)
        when = rng.uniform(0.4, 0.8, len(self.turn)) * SPAN_S
        lead_position, _ = self.at(lead, when)
        own_position, _ = self.at(np.arange(len(lead)), when)
        centre = self.centre.copy()
        centre[followers] += (lead_position - own_position + rng.normal(0.0, 10.0, own_position.shape))[followers]
        return replace(self, centre=centre)


SHIPS, AIRCRAFT = Motion(0.01, 8.0), Motion(4.0, 150.0)


@dataclass(frozen=True)
class Sensor:
    """One source. ``stated`` : errors of its description over the true ones. late_s, azimuth_deg : not described.

    share : of the objects that it reports, drawn at random, or ``which`` of n objects. west, east : part of the width
    that it covers. swaps : probability per scan that two objects within 60 m exchange ids. twice : share of the objects
    that it shows under two ids. heights : share of the records with one. false : false plots or tracks per scan; tracks
    last 20 scans. range_share : growth of a radar's error with range; not described. gap_s : mean duration of
    an object's gaps without reports, and of the times between them; 0 for none.
    """

    name: str
    kind: str = "tracks"
    sigma_m: float = 25.0
    period_s: float = 3.0
    misses: float = 0.1
    stated_misses: float = 0.1
    stated: float = 1.0
    late_s: float = 0.0
    azimuth_deg: float = 0.0
    polar: bool = False
    share: float = 1.0
    which: Callable[[int], np.ndarray] | None = None
    west: float = -np.inf
    east: float = np.inf
    until_s: float = np.inf
    swaps: float = 0.0
    twice: float = 0.0
    heights: float = 0.0
    false: float = 0.0
    stated_false_per_km2: float = 0.0
    range_share: float = 0.0
    gap_s: float = 0.0
    motion: Motion = SHIPS
    speed_error: float = 0.5


AIS = Sensor("ais", "ais", sigma_m=8.0, period_s=6.0, misses=0.2, stated_misses=0.2, share=0.75)
RADAR = Sensor("radar", "marine radar", sigma_m=15.0, polar=True)


def reported(
    fleet: Fleet, sensor: Sensor, width_m: float, span_s: float, rng: np.random.Generator
) -> tuple[Description, Reports, np.ndarray]:
    """The description, the reports and the object of each, −1 for false ones."""
    n, rows = len(fleet.turn), []
    reporting = np.flatnonzero(rng.random(n) < sensor.share) if sensor.which is None else sensor.which(n)
    with_two_ids = {k for k in reporting.tolist() if rng.random() < sensor.twice}
    first_s = rng.uniform(0.0, 1.0)
    own_phase = rng.uniform(0.0, sensor.period_s, n) if sensor.kind in ("ais", "ads-b") else np.full(n, first_s)
    for k in reporting.tolist():
        for track_number in range(1 + (k in with_two_ids)):
            times = np.arange(own_phase[k], span_s, sensor.period_s)
            times = times[rng.random(len(times)) >= sensor.misses]
            position, velocity = fleet.at(np.full(len(times), k), times)
            detected = (position[:, 0] >= sensor.west * width_m) & (position[:, 0] <= sensor.east * width_m)
            detected &= times <= sensor.until_s
            if sensor.gap_s:
                changes = np.cumsum(rng.exponential(sensor.gap_s, 2 + int(8.0 * span_s / sensor.gap_s)))
                detected &= np.searchsorted(changes, times) % 2 == 0
            m = int(detected.sum())
            displacement = rng.normal(0.0, 12.0, 2) if k in with_two_ids else 0.0
            rows.append(
                (
                    times[detected],
                    position[detected] + displacement,
                    velocity[detected],
                    np.full(m, k),
                    np.full(m, k + 1000 * track_number),
                )
            )
    scans_s = np.arange(first_s, span_s, sensor.period_s)
    mean_scans = 1.0 if sensor.polar else 20.0
    for number in range(rng.poisson(sensor.false * len(scans_s) / mean_scans)):
        times = scans_s[rng.integers(len(scans_s)) :][: rng.geometric(1.0 / mean_scans)]
        start = rng.uniform(0.0, width_m, 2)
        rows.append((times, np.tile(start, (len(times), 1)), np.zeros((len(times), 2)), np.full(len(times), -1),
                     np.full(len(times), 5000 + number)))  # fmt: skip
    time_s, position, velocity, owner, track = (np.concatenate(column) for column in zip(*rows, strict=True))
    order = np.argsort(time_s, kind="stable")
    time_s, position, velocity, owner, track = (x[order] for x in (time_s, position, velocity, owner, track))
    track = _swapped(fleet, time_s, owner, track, sensor.swaps, rng)
    columns: dict[str, np.ndarray] = {"time_s": time_s + sensor.late_s}
    errors = SensorErrors(position_m=sensor.stated * sensor.sigma_m, speed_m_per_s=sensor.speed_error, course_deg=5.0,
                          extent_m=0.0)  # fmt: skip
    site = None
    if sensor.polar:
        site = Site(east_m=0.5 * width_m, north_m=-0.3 * width_m)
        from_site = position - (site.east_m, site.north_m)
        range_m = np.hypot(*from_site.T)
        sigma_deg = 0.5
        sigma_m = sensor.sigma_m + sensor.range_share * range_m
        columns["range_m"] = np.maximum(range_m + sigma_m * rng.normal(size=len(range_m)), 1.0)
        columns["bearing_deg"] = (
            np.degrees(np.arctan2(*from_site.T)) + sensor.azimuth_deg + sigma_deg * rng.normal(size=len(range_m))
        ) % 360.0
        errors = SensorErrors(range_m=sensor.stated * sensor.sigma_m, range_share=0.0,
                              bearing_deg=sensor.stated * sigma_deg, extent_m=1.0)  # fmt: skip
    else:
        x = position + sensor.sigma_m * rng.normal(size=position.shape)
        v = velocity + sensor.speed_error * rng.normal(size=velocity.shape)
        columns |= {"x_m": x[:, 0], "y_m": x[:, 1], "vx_m_per_s": v[:, 0], "vy_m_per_s": v[:, 1]}
        names = np.array([f"{k:04d}" for k in track], object)
        if sensor.kind == "ais":
            columns["mmsi"] = np.array([f"23500{name}" for name in names], object)
        elif sensor.kind == "ads-b":
            columns["icao"] = np.array([f"a0{name}" for name in names], object)
        else:
            columns["track_id"] = names
    if sensor.heights:
        height = fleet.height[np.maximum(owner, 0)] + 20.0 * rng.normal(size=len(owner))
        columns["pressure_alt_m"] = np.where(rng.random(len(owner)) < sensor.heights, height, np.nan)
        errors = replace(errors, height_m=20.0)
    description = Description(
        sensor.name, sensor.kind, site=site, errors=errors, misses=MissRate(sensor.stated_misses), motion=sensor.motion,
        clutter=Clutter(sensor.stated_false_per_km2),
        timing=Timing(sensor.period_s, 0.0, None if sensor.kind in ("ais", "ads-b", "marine radar") else 0.0),
    )  # fmt: skip
    return description, Reports.of(sensor.name, "ais" if sensor.kind == "ais" else "table", columns), owner


def _swapped(
    fleet: Fleet, time_s: np.ndarray, owner: np.ndarray, track: np.ndarray, swaps: float, rng: np.random.Generator
) -> np.ndarray:
    """Track numbers; those of two near objects are exchanged permanently with probability ``swaps`` per scan."""
    if not swaps:
        return track
    swapped, number = track.copy(), {int(k): int(k) for k in np.unique(track)}
    for scan in np.split(np.arange(len(time_s)), np.flatnonzero(np.diff(time_s) > 0.0) + 1):
        position, _ = fleet.at(np.maximum(owner[scan], 0), time_s[scan])
        distance = np.hypot(*(position[:, None] - position).transpose(2, 0, 1))
        for i, j in np.argwhere(np.triu(distance < 60.0, 1)):
            if rng.random() < swaps:
                one, two = int(track[scan[i]]), int(track[scan[j]])
                number[one], number[two] = number[two], number[one]
        swapped[scan] = [number[int(k)] for k in track[scan]]
    return swapped


@dataclass(frozen=True)
class Kind:
    """One kind of scene."""

    words: str
    sources: tuple[Sensor, ...]
    n: int = 14
    width_m: float = 1000.0
    speed: tuple[float, float] = (1.0, 3.0)
    height: float = 0.0
    arranged: Callable[[Fleet, np.random.Generator], Fleet] = field(default=lambda fleet, rng: fleet)


def _trackers(**trouble: object) -> tuple[Sensor, ...]:
    """AIS and two trackers, the second with a trouble."""
    return AIS, Sensor("west"), replace(Sensor("east"), **trouble)  # type: ignore[arg-type]


def _all(**trouble: object) -> tuple[Sensor, ...]:
    return tuple(replace(one, **trouble) for one in (AIS, Sensor("west"), Sensor("east")))  # type: ignore[arg-type]


KINDS = (
    Kind("as stated", _trackers()),
    Kind("errors stated twice too large", _all(stated=2.0)),
    Kind("errors stated half as large", _all(stated=0.5)),
    Kind("one source's errors stated half", _trackers(stated=0.5)),
    Kind("one source 5 s late", _trackers(late_s=5.0)),
    Kind("azimuth 3° off and clutter", (AIS, replace(RADAR, azimuth_deg=3.0, false=10.0)), n=10, width_m=3000.0),
    Kind("crossing", _trackers(), arranged=lambda fleet, rng: fleet.crossing(rng)),
    Kind("convoys 80 m apart", _trackers(), arranged=lambda fleet, rng: fleet.in_convoy(80.0)),
    Kind("convoys 40 m apart", _trackers(), arranged=lambda fleet, rng: fleet.in_convoy(40.0)),
    Kind("2 % swaps", _all()[:1] + tuple(replace(Sensor(name), swaps=0.02) for name in ("west", "east"))),
    Kind("ends early", _trackers(until_s=250.0)),
    Kind("a third shown twice by one source", _trackers(twice=0.33)),
    Kind("false tracks, none stated", _trackers(false=3.0)),
    Kind("misses 0.4, stated 0.1", _trackers(misses=0.4)),
    Kind("halves of the bay, overlapping", (AIS, Sensor("west", east=0.6), Sensor("east", west=0.4), Sensor("all"))),
    Kind("halves of the bay, no overlap", (AIS, Sensor("west", east=0.5), Sensor("east", west=0.5))),
    Kind("two trackers that share half the ships", (
        Sensor("west", which=lambda n: np.arange(0, 2 * n // 3)),
        Sensor("east", which=lambda n: np.arange(n // 3, n)))),
    Kind("aircraft, heights in half the records", (
        Sensor("ads-b", "ads-b", sigma_m=40.0, period_s=2.0, heights=0.9, share=0.75, motion=AIRCRAFT, speed_error=1.5),
        Sensor("radar", sigma_m=150.0, period_s=6.0, heights=0.5, motion=AIRCRAFT, speed_error=5.0)),
        width_m=8000.0, speed=(80.0, 140.0), height=9000.0),
    Kind("3 silent ships 75 m from AIS-only ones", (
        replace(AIS, which=lambda n: np.r_[np.arange(0, 6, 2), np.arange(6, n)]),
        Sensor("west", which=lambda n: np.r_[np.arange(1, 6, 2), np.arange(6, n)])),
        n=20, width_m=3000.0, arranged=lambda fleet, rng: fleet.in_convoy(75.0)),
)  # fmt: skip


def simulated(kind: Kind, seed: int) -> tuple[Fleet, Scene, list[np.ndarray]]:
    """The fleet, the scene of its sources and the object of each report."""
    rng = np.random.default_rng(seed)
    fleet = kind.arranged(Fleet.of(rng, kind.n, kind.width_m, kind.speed, kind.height), rng)
    parts = [reported(fleet, sensor, kind.width_m, SPAN_S, rng) for sensor in kind.sources]
    return fleet, Scene.of([(d, r) for d, r, _ in parts]), [owner for _, _, owner in parts]


@dataclass
class Score:
    """Of every scored object: p, whether it is right, and its members; and counts of pairs."""

    p: list[float] = field(default_factory=list)
    right: list[bool] = field(default_factory=list)
    members: list[str] = field(default_factory=list)
    wrong: int = 0
    missed: int = 0
    pairs: int = 0
    near_wrong: int = 0
    near_missed: int = 0

    def add(self, state: PictureState, truth: list[np.ndarray], names: list[str]) -> None:  # type: ignore[type-arg]
        """Add the objects of an instant."""
        scan = state.scan
        of = [names.index(d.name) for d in scan.now.descriptions]
        true = np.array([truth[of[s]][row] for s, row in zip(scan.source, scan.row, strict=True)], np.int64)
        shows = {k: set(scan.source[true == k].tolist()) for k in set(true.tolist()) if k >= 0}
        twice = {k for k, sources in shows.items() if np.sum(true == k) > len(sources)}
        pairs = set()
        for n, members in enumerate(state.members):
            own = members[members >= 0]
            ship = int(true[own[0]])
            pairs |= {(int(i), int(j)) for i, j in combinations(sorted(own.tolist()), 2)}
            if len(own) < 2 and state.p_runner_up[n] <= 0.0:
                continue
            right = bool((true[own] == ship).all()) if ship >= 0 else len(own) == 1
            if right and ship >= 0:
                right = len(own) == len(shows[ship]) or (ship in twice and len(own) == 1)
            self.p.append(float(state.probability[n]))
            self.right.append(right)
            self.members.append(f"{' '.join(f'{names[of[scan.source[k]]]}:{true[k]}' for k in own)}")
        wrong, missed, total = _pairs(pairs, true, scan.source, shows)
        self.wrong, self.missed, self.pairs = self.wrong + wrong, self.missed + missed, self.pairs + total
        wrong, missed, _ = _pairs(_nearest(scan), true, scan.source, shows)
        self.near_wrong, self.near_missed = self.near_wrong + wrong, self.near_missed + missed


def _pairs(
    pairs: set[tuple[int, int]], true: np.ndarray, source: np.ndarray, shows: dict[int, set[int]]
) -> tuple[int, int, int]:
    """Numbers of wrong pairs, of missed ones, and of true pairs (of a ship and two sources that show it)."""
    good = {(int(true[i]), *sorted((int(source[i]), int(source[j])))) for i, j in pairs
            if true[i] == true[j] and true[i] >= 0}  # fmt: skip
    true_pairs = {(ship, s, t) for ship, sources in shows.items() for s, t in combinations(sorted(sources), 2)}
    wrong = sum(true[i] != true[j] or true[i] < 0 for i, j in pairs)
    return wrong, len(true_pairs - good), len(true_pairs)


def _nearest(scan) -> set[tuple[int, int]]:  # type: ignore[no-untyped-def]
    """Mutual nearest neighbours within the gate."""
    out = set()
    for s, t in combinations(range(len(scan.start) - 1), 2):
        i, j = np.arange(scan.start[s], scan.start[s + 1]), np.arange(scan.start[t], scan.start[t + 1])
        if not len(i) or not len(j):
            continue
        residual = scan.state[i][:, None, :2] - scan.state[j][None, :, :2]
        total = scan.covariance[i][:, None, :2, :2] + scan.covariance[j][None, :, :2, :2]
        chi_sq = np.einsum("ijv,ijv->ij", residual, np.linalg.solve(total, residual[..., None])[..., 0])
        for a in range(len(i)):
            b = int(np.argmin(chi_sq[a]))
            if chi_sq[a, b] < GATE and int(np.argmin(chi_sq[:, b])) == a:
                out.add((int(i[a]), int(j[b])))
    return out


def scored(kind: Kind, seed: int) -> Score:
    """The score of a scene over all instants."""
    _, scene, truth = simulated(kind, seed)
    names = [feed.description.name for feed in scene.feeds]
    scene, _ = scene.registered()
    score = Score()
    for state in picture_states(scene, np.arange(EVERY_S, SPAN_S, EVERY_S), watch_of(scene)):
        if state.now.instant_s >= WARM_S:
            score.add(state, truth, names)  # type: ignore[arg-type]
    return score


COLUMNS = (
    "scene", "objects", "stated", "right", "worst bin of 100", "above 0.99", "wrong of them", "expected",
    "pairs", "wrong", "missed", "nearest: wrong", "missed", *(f"{a:g} to {min(b, 1.0):g}" for a, b in pairwise(BINS)),
    "CPU s",
)  # fmt: skip


def line(kind: Kind, seeds: range) -> list[object]:
    """One row."""
    began = time.process_time()
    parts = [scored(kind, seed) for seed in seeds]
    p, right = (np.concatenate([getattr(one, name) for one in parts]) for name in ("p", "right"))
    cells, worst = [], 0.0
    for a, b in pairwise(BINS):
        inside = (p >= a) & (p < b)
        n = int(inside.sum())
        cells.append(f"{p[inside].mean():.3f}→{right[inside].mean():.3f} ({n})" if n else "")
        if n >= 100 and abs(gap := float(p[inside].mean() - right[inside].mean())) > abs(worst):
            worst = gap
    sure = p > SURE
    sums = [sum(getattr(one, name) for one in parts)
            for name in ("pairs", "wrong", "missed", "near_wrong", "near_missed")]  # fmt: skip
    return [kind.words, len(p), float(p.mean()), float(right.mean()), worst, int(sure.sum()),
            int((~right.astype(bool) & sure).sum()), float((1.0 - p[sure]).sum()), *sums, *cells,
            time.process_time() - began]  # fmt: skip


def rows(only: str, seeds: int) -> Iterator[list[object]]:
    """All rows."""
    for number, kind in enumerate(KINDS):
        if only in kind.words:
            yield line(kind, range(1000 * number, 1000 * number + seeds))


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(prog="scripts/bench hard", description=__doc__)
    parser.add_argument("--seeds", type=int, default=8, help="scenes of each kind (default 8)")
    parser.add_argument("--only", default="", help="kinds whose name contains this")
    options = parser.parse_args()
    report("hard", [Table("Hard scenes: stated → right (number)", COLUMNS, list(rows(options.only, options.seeds)))])


if __name__ == "__main__":
    main()

"""Stated probabilities of a picture with memory against observed frequencies, for errors that persist in time.

Real motion (AIS of the Solent), modelled trackers. The errors of every source have a constant part per track (position
of the antenna on the hull, residual bias), a part with correlation time τ, and white noise. The descriptions of the
sensors are right, but do not give the correlation time. Trackers may swap ships that are close to each other. Scored is
every object with two records or more, or an alternative: stated probability against the frequency with which exactly
its records are one ship, by the spacing of the ships; with memory, and for each instant alone.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from benchmarks import motion
from benchmarks.tables import Table, report
from sameas.evidence.rule import Rule
from sameas.picture.memory import TrackMemory
from sameas.picture.picture import picture_states
from sameas.picture.watch import Watch, all_evidence
from sameas.simulate.sensors import TrueMotion
from sameas.tracks.reports import Reports
from sameas.tracks.scene import Instant, Scene
from sameas.tracks.source import Description, MissRate, Motion, SensorErrors, Timing

SPAN_S, WARM_S = 1200.0, 240.0
#: Ships nearer than this may be swapped by a tracker.
SWAPPED_M = 60.0
#: Bins of the distance to the nearest other ship, metres.
SPACING_M = (0.0, 60.0, 200.0, np.inf)
#: Bins of the stated probability.
BINS = (0.0, 0.5, 0.8, 0.95, 0.99, 0.999, 1.0 + 1e-9)


@dataclass(frozen=True)
class Errors:
    """Errors of a tracker: 1σ per axis in metres, the share of the variance that is constant per track, the share with
    correlation time ``tau_s``, and the probability per scan that two near ships are swapped."""

    sigma_m: float
    constant: float = 0.0
    correlated: float = 0.0
    tau_s: float = 30.0
    swaps: float = 0.0

    def of_track(self, times_s: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """(k, 2) errors of one track at its times."""
        error = np.empty((len(times_s), 2))
        state = rng.standard_normal(2)
        for k, dt in enumerate(np.diff(times_s, prepend=times_s[:1])):
            rho = np.exp(-dt / self.tau_s)
            state = rho * state + np.sqrt(1.0 - rho**2) * rng.standard_normal(2)
            error[k] = state
        new = rng.standard_normal((len(times_s), 2)) * np.sqrt(1.0 - self.constant - self.correlated)
        constant = np.sqrt(self.constant) * rng.standard_normal(2)
        return self.sigma_m * (constant + np.sqrt(self.correlated) * error + new)


@dataclass(frozen=True)
class Kind:
    """One scene: errors of each tracker, and those of AIS."""

    words: str
    trackers: tuple[Errors, ...]
    ais: Errors = Errors(8.0, 0.5, 0.4, 300.0)


KINDS = (
    Kind("all errors new", (Errors(25.0), Errors(25.0)), Errors(8.0)),
    Kind("errors correlated over 20 s", (Errors(25.0, 0.0, 0.8, 20.0), Errors(25.0, 0.0, 0.8, 20.0))),
    Kind("half of the variance constant", (Errors(25.0, 0.5, 0.3, 20.0), Errors(25.0, 0.5, 0.3, 20.0))),
    Kind("nearly all constant", (Errors(25.0, 0.9), Errors(25.0, 0.9))),
    Kind("new, 2 % swaps", (Errors(25.0, swaps=0.02), Errors(25.0, swaps=0.02))),
    Kind("half constant, 2 % swaps", (Errors(25.0, 0.5, 0.3, swaps=0.02), Errors(25.0, 0.5, 0.3, swaps=0.02))),
    Kind(
        "half constant, 0.2 % swaps",
        (Errors(25.0, 0.5, 0.3, swaps=0.002), Errors(25.0, 0.5, 0.3, swaps=0.002)),
    ),
)


@dataclass(frozen=True)
class Trial:
    """A scene, the true object of every report of every source, and the true motion of the ships."""

    scene: Scene
    truth: tuple[np.ndarray, ...]
    true: TrueMotion

    @classmethod
    def of(cls, true: TrueMotion, log: Reports, kind: Kind, seed: int, misses: float = 0.1) -> Trial:
        rng = np.random.default_rng(seed)
        start = float(log.time_s.min())
        sources, truth = [], []
        objects = true.objects_of(log)
        ais_times = [(k, log.time_s[objects == k]) for k in range(len(true))]
        simulated = [_tracks(true, ais_times, kind.ais, "ais", rng)]
        for number, errors in enumerate(kind.trackers):
            scans_s = np.arange(start, start + SPAN_S, 3.0) + 0.7 * number
            scan_times = [(k, scans_s[rng.random(len(scans_s)) >= misses]) for k in range(len(true))]
            simulated.append(_tracks(true, scan_times, errors, f"tracker {number + 1}", rng))
        for reports, owner, errors in simulated:
            described = Description(
                reports.source, "ais" if reports.source == "ais" else "tracks",
                misses=MissRate(misses), motion=Motion(0.01, 8.0),
                timing=Timing(None if reports.source == "ais" else 3.0, 0.0, 0.0),
                errors=SensorErrors(position_m=errors.sigma_m, speed_m_per_s=0.5, course_deg=5.0, extent_m=0.0),
            )  # fmt: skip
            sources.append((described, reports))
            truth.append(owner)
        return cls(Scene.of(sources, true.plane), tuple(truth), true)


def _tracks(
    true: TrueMotion, times_of: list[tuple[int, np.ndarray]], errors: Errors, name: str, rng: np.random.Generator
) -> tuple[Reports, np.ndarray, Errors]:
    """Reports of tracks at the times of each ship, the ship of each report, and the errors."""
    rows: list[list[np.ndarray]] = []
    for k, times in times_of:
        path = true.paths[k]
        position, next_position = path.at(times)[:, :2], path.at(times + 1.0)[:, :2]
        is_known = np.isfinite(position).all(axis=1) & np.isfinite(next_position).all(axis=1)
        times, position, next_position = times[is_known], position[is_known], next_position[is_known]
        if len(times) < 2:
            continue
        velocity = next_position - position + 0.5 * rng.standard_normal(position.shape)
        measured = position + errors.of_track(times, rng)
        rows.append([times, measured[:, 0], measured[:, 1], *velocity.T, np.full(len(times), k)])
    time_s, x, y, vx, vy, owner = (np.concatenate(column) for column in zip(*rows, strict=True))
    order = np.argsort(time_s, kind="stable")
    time_s, x, y, vx, vy, owner = (column[order] for column in (time_s, x, y, vx, vy, owner.astype(np.int64)))
    names = _named(true, time_s, owner, errors.swaps, rng)
    lat, lon = true.plane.to_geodetic(np.column_stack([x, y]))
    columns = {"time_s": time_s, "lat_deg": lat, "lon_deg": lon, "track_id": names,
               "speed_m_per_s": np.hypot(vx, vy), "course_deg": np.degrees(np.arctan2(vx, vy)) % 360.0}  # fmt: skip
    return Reports.of(name, "table", columns), owner, errors


def _named(
    true: TrueMotion, time_s: np.ndarray, owner: np.ndarray, swaps: float, rng: np.random.Generator
) -> np.ndarray:
    """(n,) track ids: the numbers of the ships, exchanged when two near ones are swapped."""
    names = owner.copy()
    if swaps > 0.0:
        number = np.arange(len(true))
        for scan in np.split(np.arange(len(time_s)), np.flatnonzero(np.diff(time_s) > 0.0) + 1):
            position = true.at(float(time_s[scan[0]]))[owner[scan], :2]
            distance = np.hypot(*(position[:, None] - position).transpose(2, 0, 1))
            for i, j in np.argwhere(np.triu(distance < SWAPPED_M, 1)):
                if rng.random() < swaps:
                    number[[owner[scan[i]], owner[scan[j]]]] = number[[owner[scan[j]], owner[scan[i]]]]
            names[scan] = number[owner[scan]]
    return np.array([str(name) for name in names], object)


def instant_evidence(now: Instant, memory: TrackMemory) -> Rule:
    """The evidence of the instant."""
    return all_evidence(now, memory, previous_scans=False)  # type: ignore[return-value]


METHODS = {"memory": Watch, "instants alone": lambda: Watch(evidence=instant_evidence, bound=1.0)}


@dataclass(frozen=True)
class Score:
    """(n,) of every scored object: stated probability, whether it is right, metres to the next ship; and, of those that
    are right, χ²/2 of the fused position, and squared errors of the fused position and of the best member."""

    p: np.ndarray
    right: np.ndarray
    spacing_m: np.ndarray
    nees: np.ndarray
    fused_m: np.ndarray
    best_m: np.ndarray

    @classmethod
    def of(cls, trial: Trial, instants_s: np.ndarray, watch: Watch) -> Score:
        rows: list[tuple[float, ...]] = []
        for state in picture_states(trial.scene, instants_s, watch):
            scan = state.scan
            names = [feed.description.name for feed in trial.scene.feeds]
            of = [names.index(d.name) for d in scan.now.descriptions]
            true = np.array([trial.truth[of[s]][row] for s, row in zip(scan.source, scan.row, strict=True)])
            places = trial.true.at(state.now.instant_s)[:, :2]
            distance = np.hypot(*(places[:, None] - places).transpose(2, 0, 1))
            np.fill_diagonal(distance, np.inf)
            spacing = np.nanmin(np.where(np.isnan(distance), np.inf, distance), axis=1)
            shows = Counter(true.tolist())
            sigma = np.trace(scan.covariance[:, :2, :2], axis1=1, axis2=2)
            for n, members in enumerate(state.members):
                own = members[members >= 0]
                if len(own) < 2 and state.p_runner_up[n] <= 0.0:
                    continue
                ship = int(true[own[0]])
                right = bool((true[own] == ship).all()) and shows[ship] == len(own)
                off = state.states.state[n, :2] - places[ship]
                p = state.states.covariance[n, :2, :2]
                best = own[np.argmin(sigma[own])]
                measured = right and len(own) > 1
                rows.append((
                    state.probability[n], right, spacing[ship],
                    float(off @ np.linalg.solve(p, off)) / 2.0 if measured else np.nan,
                    float(off @ off) if measured else np.nan,
                    float(np.sum((scan.state[best, :2] - places[ship]) ** 2)) if measured else np.nan,
                ))  # fmt: skip
        p, right, spacing_m, nees, fused, best = np.array(rows, np.float64).T
        return cls(p, right, spacing_m, nees, fused, best)

    def rows(self, label: list[object]) -> list[list[object]]:
        """By spacing: number, mean stated probability, share right, the worst bin of 500 or more, and all bins."""
        out: list[list[object]] = []
        for low, high in [*pairwise(SPACING_M), (0.0, np.inf)]:
            near = (self.spacing_m >= low) & (self.spacing_m < high) if (low, high) != (0.0, np.inf) else self.p >= 0
            bins, worst = [], 0.0
            for a, b in pairwise(BINS):
                some = near & (self.p >= a) & (self.p < b)
                if not some.any():
                    bins.append("")
                    continue
                p, right = float(self.p[some].mean()), float(self.right[some].mean())
                bins.append(f"{p:.3f}→{right:.3f} ({int(some.sum())})")
                if some.sum() >= 500 and abs(p - right) > abs(worst):
                    worst = p - right
            words = "all" if (low, high) == (0.0, np.inf) else f"{low:g} to {high:g}"
            loss = -np.mean(
                np.log(np.clip(np.where(self.right[near] > 0, self.p[near], 1.0 - self.p[near]), 1e-9, 1.0))
            )
            out.append([*label, words, int(near.sum()), float(self.p[near].mean()), float(self.right[near].mean()),
                        float(loss), worst, *bins])  # fmt: skip
        return out


def scene_motion() -> tuple[TrueMotion, Reports] | None:
    """The motion of the vessels of the Solent, and the times of their AIS reports; None without the recording."""
    log = motion.solent()
    if log is None:
        return None
    start = float(log.time_s.min()) + 120.0
    log = motion.between(log, start, start + SPAN_S)
    return TrueMotion.of(
        log, Description("ais", "ais", errors=SensorErrors(position_m=5.0), motion=Motion(0.01, 8.0))
    ), log


def table(every_s: float, seeds: int, only: str) -> Iterator[Table]:
    """The table of all kinds."""
    recorded = scene_motion()
    if recorded is None:
        print("the recording of the Solent's AIS is missing")
        return
    true, log = recorded
    rows: list[list[object]] = []
    start = float(log.time_s.min())
    instants = np.arange(start + WARM_S, start + SPAN_S, every_s)
    states: list[list[object]] = []
    for kind in KINDS:
        if only not in kind.words:
            continue
        for way, watch in METHODS.items():
            began = time.process_time()
            parts = [Score.of(Trial.of(true, log, kind, seed), instants, watch()) for seed in range(seeds)]
            one = Score(*(np.concatenate([getattr(p, n) for p in parts]) for n in Score.__annotations__))
            rows += one.rows([kind.words, way])
            states.append([kind.words, way, float(np.nanmean(one.nees)), float(np.sqrt(np.nanmean(one.fused_m))),
                           float(np.sqrt(np.nanmean(one.best_m))), time.process_time() - began])  # fmt: skip
    names = tuple(f"{a:g} to {min(b, 1.0):g}" for a, b in pairwise(BINS))
    yield Table("Stated probability → share right (number)",
                ("errors", "way", "next ship, m", "objects", "stated", "right", "log loss", "worst bin of 500",
                 *names), rows)  # fmt: skip
    yield Table("Fused states", ("errors", "way", "NEES per dimension", "fused, m", "best sensor, m", "CPU s"), states)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(prog="scripts/bench memory", description=__doc__)
    parser.add_argument("--every", type=float, default=15.0, help="seconds between instants (default 15)")
    parser.add_argument("--seeds", type=int, default=2, help="scenes of each kind (default 2)")
    parser.add_argument("--only", default="", help="kinds whose name contains this")
    options = parser.parse_args()
    report("memory", table(options.every, options.seeds, options.only))


if __name__ == "__main__":
    main()

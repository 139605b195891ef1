"""Stated probabilities of a picture with memory against observed frequencies, for errors that persist in time.

Real motion (AIS of the Solent), modelled trackers. The errors of every source have a constant part per track (position
of the antenna on the hull, residual bias), a part with correlation time τ, and white noise. The descriptions of the
sensors are right, but do not give the correlation time. Trackers may swap ships that are close to each other. Scored is
every object with two records or more, or an alternative: stated probability against the frequency with which exactly
its records are one ship, with memory and for each instant alone. Where a ship is, is known from her AIS until ten
minutes after the scene, and in pauses of ten minutes: else the modelled trackers would miss a ship at anchor, whose AIS
is still in the picture, for minutes, whatever miss rate is described. Those whose recorded motion ends all the same are
not scored.

The objects are divided by the distance to the next object *of the picture*. The true distance to the next ship is not
known to the picture, and probabilities need not be frequencies given the truth: of the objects stated with 0.7 from one
instant, those 60 m or more from the next ship are right more often, and the others less often.

The objects of one scene are not independent: constant errors are the same at all its instants, and estimated errors are
common to all its ships. So all standard errors are those of the scatter of scenes.

The places of the ships are the same in all scenes, and standard errors do not include their scatter: some distances of
neighbours are frequent and others are missing. A picture has no such knowledge; where positions are spread evenly, what
it states is a frequency. ``--displaced 60`` makes scenes with every ship displaced by 60 m per axis, and the errors of
old AIS positions as they are: the probabilities of single instants then are within 0.03 at all distances, and at the
true places they are 0.035 too high below 60 m and 0.04 too low at 60 to 200 m (0.5 to 0.8).

Which kind its errors are a picture does not know, so the lines of all kinds together are given as well, and those of
memory that knows the size and the correlation of all errors. Where errors are constant, more instants show little more
than one: an error then is one for all instants of a scene, and memory can have less luck than the changing instants.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from benchmarks import motion
from benchmarks.tables import Table, report
from sameas.arrays import FloatArray, IntArray
from sameas.evidence.rule import Rule
from sameas.picture.error_correlation import ErrorCorrelation
from sameas.picture.error_factors import ErrorFactors
from sameas.picture.memory import TrackMemory
from sameas.picture.named_tracks import NamedTracks
from sameas.picture.picture import picture_states
from sameas.picture.tables import Scan
from sameas.picture.tuning import DEFAULT_TUNING, Tuning
from sameas.picture.watch import Watch, all_evidence
from sameas.simulate.sensors import TrueMotion
from sameas.tracks.reports import Reports
from sameas.tracks.scene import Instant, Scene
from sameas.tracks.source import Description, MissRate, Motion, SensorErrors, Timing

SPAN_S, WARM_S = 1200.0, 240.0
#: Seconds after the scene whose AIS still shows where ships are: a ship at anchor reports every three minutes.
AFTER_S = 600.0
#: Ships nearer than this may be swapped by a tracker.
SWAPPED_M = 60.0
#: Bins of the distance to the nearest other object of the picture, metres.
SPACING_M = (0.0, 60.0, 200.0, np.inf)
#: Bins of the stated probability.
BINS = (0.0, 0.5, 0.8, 0.95, 0.99, 0.999, 1.0 + 1e-9)
#: A bin of this many objects counts, and its stated probability should be the frequency within this.
COUNTED, TOLERANCE = 500, 0.03
#: Standard errors beyond the tolerance from which a deviation is taken as real.
SIGNIFICANT = 2.0
VERDICTS = ("few objects", "met", "open", "missed")


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
    Kind("half constant, 0.2 % swaps", (Errors(25.0, 0.5, 0.3, swaps=0.002), Errors(25.0, 0.5, 0.3, swaps=0.002))),
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

    def truth_of(self, scan: Scan) -> tuple[np.ndarray, np.ndarray]:
        """(n,), (n,) the source in ``truth`` and the true object of each record of a scan."""
        names = [feed.description.name for feed in self.scene.feeds]
        source = np.array([names.index(d.name) for d in scan.now.descriptions])[scan.source]
        return source, np.array([self.truth[s][row] for s, row in zip(source, scan.row, strict=True)])


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


@dataclass(frozen=True)
class KnownCorrelation(ErrorCorrelation):
    """The true correlation of the errors; true : by the name of each source."""

    true: Mapping[str, Errors] = field(default_factory=dict)

    def lasting(self, source: IntArray, tuning: Tuning = DEFAULT_TUNING) -> FloatArray:
        return np.array([self.true[name].constant for name in self.names])[source]

    def decaying(self, source: IntArray, elapsed_s: FloatArray, tuning: Tuning = DEFAULT_TUNING) -> FloatArray:
        true = [self.true[name] for name in self.names]
        share, tau_s = np.array([errors.correlated for errors in true]), np.array([errors.tau_s for errors in true])
        return np.asarray(share[source] * np.exp(-elapsed_s / tau_s[source]))


@dataclass(frozen=True)
class KnownFactors(ErrorFactors):
    """The stated errors are right."""

    def of_records(self, scan: Scan) -> FloatArray:
        return np.ones(len(scan))


def with_known_errors(kind: Kind) -> Watch:
    """A watch that knows the sizes and correlations of all errors: what memory can give at most."""
    true = {"ais": kind.ais, **{f"tracker {k}": errors for k, errors in enumerate(kind.trackers, start=1)}}
    tracks = NamedTracks(error_correlation=KnownCorrelation(true=true), error_factors=KnownFactors())
    return Watch(memory=TrackMemory(tracks=tracks))


METHODS: Mapping[str, Callable[[Kind], Watch]] = {
    "memory": lambda kind: Watch(),
    "instants alone": lambda kind: Watch(evidence=instant_evidence, bound=1.0),
    "memory, errors known": with_known_errors,
}


@dataclass(frozen=True)
class Score:
    """(n,) of every scored object: stated probability, whether it is right, whether it is kept by hysteresis though
    another is more probable, metres to the next object, its scene; and, of those that are right, χ²/2 of the fused
    position, and squared errors of the fused position and of the best member."""

    p: np.ndarray
    right: np.ndarray
    kept: np.ndarray
    spacing_m: np.ndarray
    scene: np.ndarray
    nees: np.ndarray
    fused_m: np.ndarray
    best_m: np.ndarray

    @classmethod
    def of(cls, trial: Trial, instants_s: np.ndarray, watch: Watch, seed: int) -> Score:
        rows: list[tuple[float, ...]] = []
        for state in picture_states(trial.scene, instants_s, watch):
            scan, (_, true) = state.scan, trial.truth_of(state.scan)
            places = trial.true.at(state.now.instant_s)[:, :2]
            fused = state.states.state[:, :2]
            distance = np.hypot(*(fused[:, None] - fused).transpose(2, 0, 1))
            np.fill_diagonal(distance, np.inf)
            spacing = np.min(np.where(np.isnan(distance), np.inf, distance), axis=1, initial=np.inf)
            shows = Counter(true.tolist())
            sigma = np.trace(scan.covariance[:, :2, :2], axis1=1, axis2=2)
            for n, members in enumerate(state.members):
                own = members[members >= 0]
                if len(own) < 2 and state.p_runner_up[n] <= 0.0:
                    continue
                ship = int(true[own[0]])
                if not np.isfinite(places[ship]).all():
                    continue
                right = bool((true[own] == ship).all()) and shows[ship] == len(own)
                off = fused[n] - places[ship]
                p = state.states.covariance[n, :2, :2]
                best = own[np.argmin(sigma[own])]
                measured = right and len(own) > 1
                rows.append((
                    state.probability[n], right, state.p_runner_up[n] > state.probability[n], spacing[n], seed,
                    float(off @ np.linalg.solve(p, off)) / 2.0 if measured else np.nan,
                    float(off @ off) if measured else np.nan,
                    float(np.sum((scan.state[best, :2] - places[ship]) ** 2)) if measured else np.nan,
                ))  # fmt: skip
        return cls(*np.array(rows, np.float64).T)

    @classmethod
    def pooled(cls, parts: Sequence[Score]) -> Score:
        """The objects of all scenes."""
        return cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in cls.__annotations__))

    @property
    def log_loss(self) -> np.ndarray:
        """(n,) minus ln of the probability stated for what is true."""
        return -np.log(np.clip(np.where(self.right > 0, self.p, 1.0 - self.p), 1e-9, 1.0))

    def mean(self, values: np.ndarray, which: np.ndarray) -> tuple[float, float]:
        """The mean of ``values`` (n,) over the objects ``which``, and its standard error by the scatter of scenes."""
        _, scene = np.unique(self.scene[which], return_inverse=True)
        mean, scenes = float(values[which].mean()), int(scene.max()) + 1
        sums = np.bincount(scene, values[which] - mean)
        return mean, float(np.sqrt(np.sum(sums**2) * scenes / (scenes - 1))) / len(scene) if scenes > 1 else np.nan

    def rows(self, label: list[object]) -> list[list[object]]:
        """By spacing, of all objects and of those kept by hysteresis: number, log loss, verdict, and of all bins stated
        probability, its excess over the share right with standard error, and number."""
        out: list[list[object]] = []
        for low, high in [*pairwise(SPACING_M), (0.0, np.inf)]:
            near = (self.spacing_m >= low) & (self.spacing_m < high) | (low == 0.0) & np.isinf(high)
            words = "all" if (low, high) == (0.0, np.inf) else f"{low:g} to {high:g}"
            for which, named in ((near, words), (near & (self.kept > 0), f"{words}, kept")):
                if which.any():
                    out.append([*label, named, *self._by_probability(which)])
        return out

    def _by_probability(self, which: np.ndarray) -> list[object]:
        """Of the objects ``which``: number, log loss, verdict and bins as of :meth:`rows`."""
        bins, verdict = [], 0
        for a, b in pairwise(BINS):
            some = which & (self.p >= a) & (self.p < b)
            if some.sum() < COUNTED:
                bins.append(f"({int(some.sum())})")
                continue
            excess, error = self.mean(self.p - self.right, some)
            bins.append(f"{self.p[some].mean():.3f} {excess:+.3f}±{error:.3f} ({int(some.sum())})")
            is_real = abs(excess) - TOLERANCE > SIGNIFICANT * error
            verdict = max(verdict, 3 if is_real else 2 if abs(excess) > TOLERANCE else 1)
        return [int(which.sum()), float(self.log_loss[which].mean()), VERDICTS[verdict], *bins]

    def compared(self, other: Score) -> list[object]:
        """Percent right and that of another score of the same scenes, log loss and that of the other: the differences
        with standard errors, and the lowest difference of percent right in one scene."""
        out: list[object] = []
        seeds = np.unique(self.scene)
        for one, two, scale in ((self.right, other.right, 100.0), (self.log_loss, other.log_loss, 1.0)):
            means = [[v[s.scene == seed].mean() for v, s in ((one, self), (two, other))] for seed in seeds]
            difference = scale * np.subtract(*np.array(means).T)
            error = difference.std(ddof=1) / np.sqrt(len(seeds)) if len(seeds) > 1 else np.nan
            digits = 2 if scale > 1.0 else 4
            out += [scale * float(one.mean()), scale * float(two.mean()),
                    f"{difference.mean():+.{digits}f}±{error:.{digits}f}"]  # fmt: skip
            if scale > 1.0:
                out.append(float(difference.min()))
        return out


def displaced(true: TrueMotion, sigma_m: float, seed: int) -> TrueMotion:
    """The motion with every ship displaced, 1σ per axis in metres."""
    offset = np.zeros((len(true), 3))
    if sigma_m > 0.0:
        offset[:, :2] = sigma_m * np.random.default_rng((seed, len(true))).standard_normal((len(true), 2))
    return replace(true, paths=tuple(replace(p, place=p.place + d) for p, d in zip(true.paths, offset, strict=True)))


def scene_motion() -> tuple[TrueMotion, Reports] | None:
    """The motion of the vessels of the Solent, and the times of their AIS reports; None without the recording."""
    log = motion.solent()
    if log is None:
        return None
    start = float(log.time_s.min()) + 120.0
    longer = motion.between(log, start, start + SPAN_S + AFTER_S)
    described = Description("ais", "ais", errors=SensorErrors(position_m=5.0), motion=Motion(0.01, 8.0))
    return TrueMotion.of(longer, described, gap_s=AFTER_S), motion.between(log, start, start + SPAN_S)


def table(every_s: float, seeds: Sequence[int], only: str, displaced_m: float = 0.0) -> Iterator[Table]:
    """The table of all kinds."""
    recorded = scene_motion()
    if recorded is None:
        print("the recording of the Solent's AIS is missing")
        return
    true, log = recorded
    rows: list[list[object]] = []
    start = float(log.time_s.min())
    instants = np.arange(start + WARM_S, start + SPAN_S, every_s)
    motions = [displaced(true, displaced_m, k) for k in seeds]
    compared, states, pooled = list[list[object]](), list[list[object]](), {way: list[Score]() for way in METHODS}
    for kind in KINDS:
        if only not in kind.words:
            continue
        scores = []
        for way, watch in METHODS.items():
            began = time.process_time()
            trials = ((Trial.of(moved, log, kind, k), k) for moved, k in zip(motions, seeds, strict=True))
            one = Score.pooled([Score.of(trial, instants, watch(kind), k) for trial, k in trials])
            scores.append(one)
            pooled[way].append(one)
            rows += one.rows([kind.words, way])
            states.append([kind.words, way, float(np.nanmean(one.nees)), float(np.sqrt(np.nanmean(one.fused_m))),
                           float(np.sqrt(np.nanmean(one.best_m))), time.process_time() - began])  # fmt: skip
        compared.append([kind.words, *scores[0].compared(scores[1])])
        compared.append([f"{kind.words}, known", *scores[2].compared(scores[1])])
    for way, of_kinds in pooled.items():
        if len(of_kinds) > 1:
            rows += Score.pooled(of_kinds).rows(["all kinds", way])
    names = tuple(f"{a:g} to {min(b, 1.0):g}" for a, b in pairwise(BINS))
    scenes = f"standard errors by the scatter of {len(seeds)} scenes"
    yield Table("Memory against each instant alone",
                ("errors", "right, %", "alone, %", "difference", "lowest of a scene",
                 "log loss", "alone", "difference"), compared, (scenes,))  # fmt: skip
    yield Table("Stated probability, its excess over the share right, and number",
                ("errors", "way", "next object, m", "objects", "log loss", f"within {TOLERANCE}", *names), rows,
                (f"{scenes}; bins of fewer than {COUNTED} objects: the number only",
                 f"met: all bins within {TOLERANCE}; missed: one is beyond by {SIGNIFICANT:g} standard errors;"
                 " open: more scenes are needed"))  # fmt: skip
    yield Table("Fused states", ("errors", "way", "NEES per dimension", "fused, m", "best sensor, m", "CPU s"), states)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(prog="scripts/bench memory", description=__doc__)
    parser.add_argument("--every", type=float, default=15.0, help="seconds between instants (default 15)")
    parser.add_argument("--seeds", type=int, default=12, help="scenes of each kind (default 12)")
    parser.add_argument("--first", type=int, default=0, help="seed of the first scene (default 0)")
    parser.add_argument("--only", default="", help="kinds whose name contains this")
    parser.add_argument(
        "--displaced", type=float, default=0.0, help="1σ per axis of the ships' places, metres (default 0)"
    )
    options = parser.parse_args()
    seeds = range(options.first, options.first + options.seeds)
    report("memory", table(options.every, seeds, options.only, options.displaced))


if __name__ == "__main__":
    main()

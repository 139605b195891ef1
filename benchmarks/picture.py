"""Pairs identified between AIS or ADS-B logs of real motion and two or three modelled radars, by `sameas` and others.

Vessels in the Solent (AIS) and aircraft around Paris (ADS-B) are where their reports say. Radars miss some of them, add
false echoes, break tracks, have biases of range, azimuth and time, all drawn by ``sameas.simulate.sensors``. The log is
the first source; identities are not used. Scored are pairs of records at every instant (``sameas.score.picture``): ours
for one instant, with biases uncorrected, known and estimated, and with memory (``sameas.picture``); and other methods
(``contenders.py``) on our states, without and with our registration. ``scripts/bench picture``, 8 minutes.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks import contenders, motion
from benchmarks.tables import Table, report
from sameas.many.identify import identify_many
from sameas.many.observations import records_of
from sameas.picture.picture import Picture
from sameas.score.picture import (
    Identities,
    Nees,
    PictureScore,
    Siap,
    majority_votes,
    mean_gospa,
    nees,
    pair_score,
    siap,
)
from sameas.simulate.sensors import Bias, Sensor, Tracker, TrueMotion
from sameas.tracks.alignment import States
from sameas.tracks.coordinates import LocalPlane
from sameas.tracks.feed import position_updates
from sameas.tracks.placement import PlacedReports
from sameas.tracks.registration import SourceBiases
from sameas.tracks.reports import Reports
from sameas.tracks.scene import Instant, Scene
from sameas.tracks.source import (
    BiasPrior,
    Clutter,
    Description,
    MissRate,
    Resolution,
    SensorCoverage,
    SensorErrors,
    Site,
    Timing,
)

CACHE = Path(__file__).resolve().parents[1] / "cache"
#: Biases of the radars, not given to any method.
BIASES = (Bias(50.0, 1.0, time_s=0.5), Bias(-30.0, -0.8, time_s=-0.3), Bias(40.0, 0.6, time_s=0.4))
#: Modelled radars detect the antenna, not a hull around it.
AIS_ERRORS = SensorErrors(position_m=5.0, extent_m=0.0)
#: Time stamps of a receiver network are off by up to a second.
ADSB_ERRORS = SensorErrors(position_m=60.0)
SPAN_S, WARM_S = 1500.0, 300.0
#: GOSPA: an object farther away than this counts as missed.
CUTOFF_M = 200.0


@dataclass(frozen=True)
class World:
    """Moving objects and the sites of the radars: (lat, lon, height) each."""

    name: str
    log: Reports
    described: Description
    true: TrueMotion
    sites: tuple[tuple[float, float, float], ...]
    radar: Description

    def sensor(self, number: int, noise_m: float, misses: float) -> Sensor:
        """Radar ``number`` with this noise and miss rate."""
        lat, lon, height = self.sites[number]
        described = replace(
            self.radar, name=f"radar {number + 1}", site=Site(lat, lon, height), misses=MissRate(misses),
            errors=replace(self.radar.errors, position_m=noise_m), assumed=(),
        )  # fmt: skip
        return Sensor(described, BIASES[number], Tracker())


def solent() -> World | None:
    """The Solent from 13:05, the busiest time, around Portsmouth harbour; None without the data."""
    log = motion.solent()
    if log is None:
        return None
    start = float(log.time_s.min()) + 120.0
    log = motion.between(log, start - 120.0, start + SPAN_S + 200.0)
    radar = Description(
        "radar", "marine radar", coverage=SensorCoverage(range_m=20e3), clutter=Clutter(0.01),
        resolution=Resolution(30.0, 0.5), errors=SensorErrors(extent_m=0.0), bias=BiasPrior(time_s=1.0),
        timing=Timing(period_s=3.0, latency_s=1.0, latency_sigma_s=0.1),
    )  # fmt: skip
    sites = ((50.7905, -1.1030, 20.0), (50.7735, -1.1395, 15.0), (50.7300, -1.1600, 30.0))
    described = Description("ais", "ais", errors=AIS_ERRORS)
    return World("Solent, AIS", log, described, TrueMotion.of(log, described), sites, radar)


def paris(cache: Path) -> World:
    """Aircraft around Paris, the busiest 25 minutes of three hours."""
    flights = motion.aircraft(cache)
    start = float(flights.time_s.min()) + 24 * 300.0
    log = motion.between(flights, start, start + SPAN_S + 200.0)
    radar = Description(
        "radar", "air radar", coverage=SensorCoverage(range_m=150e3), clutter=Clutter(1e-4),
        resolution=Resolution(200.0, 1.0),
        errors=SensorErrors(extent_m=0.0, height_m=15.0), bias=BiasPrior(azimuth_deg=1.0, time_s=1.0),
        timing=Timing(period_s=4.0, latency_s=1.0, latency_sigma_s=0.05),
    )  # fmt: skip
    sites = ((48.72, 2.38, 90.0), (49.01, 2.55, 120.0), (48.61, 2.68, 90.0))
    description = Description("adsb", "ads-b", errors=ADSB_ERRORS, timing=Timing(latency_s=0.0))
    # The log repeats the last position while none is received: repetitions are not truth.
    plane = LocalPlane.about(np.asarray(log.lat_deg), np.asarray(log.lon_deg))
    placed = PlacedReports(description, log, plane).in_plane
    assert isinstance(placed, States)
    measured = log.where(position_updates(placed)[0].usable)
    return World("Paris, ADS-B", log, description, TrueMotion.of(measured, description, gap_s=30.0), sites, radar)


@dataclass(frozen=True)
class Trial:
    """The reports of all sources, and the true object of every report."""

    world: World
    sources: tuple[tuple[Description, Reports], ...]
    truth: tuple[np.ndarray, ...]
    biases: tuple[Bias, ...]

    @classmethod
    def of(cls, world: World, noise_m: float, misses: float, sensors: int, seed: int) -> Trial:
        rng = np.random.default_rng(seed)
        start = float(world.log.time_s.min())
        sources, truth = [(world.described, world.log)], [world.true.objects_of(world.log)]
        for number in range(sensors):
            sensor = world.sensor(number, noise_m, misses)
            simulated = sensor(world.true, (start, start + SPAN_S), rng)
            sources.append((sensor.description, simulated.reports))
            truth.append(simulated.truth)
        return cls(world, tuple(sources), tuple(truth), (Bias(), *BIASES[:sensors]))

    def true_of(self, records: Mapping[str, np.ndarray]) -> np.ndarray:
        """(n,) the true object of every record, by its source and row."""
        truth = {described.name: own for (described, _), own in zip(self.sources, self.truth, strict=True)}
        pairs = zip(np.asarray(records["source"]).tolist(), np.asarray(records["row"]).tolist(), strict=True)
        return np.array([truth[source][row] for source, row in pairs], np.int64)

    def instants(self, every_s: float) -> np.ndarray:
        """Times of the picture, after ``WARM_S`` for the trackers to start."""
        start = float(self.world.log.time_s.min())
        return np.arange(start + WARM_S, start + SPAN_S, every_s)

    def scene(self) -> Scene:
        """The scene with uncorrected biases."""
        return Scene.of(self.sources, self.world.true.plane)

    def scene_unbiased(self) -> Scene:
        """The scene corrected for the true biases."""
        pairs = zip(self.sources, self.biases, strict=True)
        return Scene.of([(described, corrected(reports, bias)) for (described, reports), bias in pairs],
                        self.world.true.plane)  # fmt: skip


def corrected(reports: Reports, bias: Bias) -> Reports:
    """The reports, corrected for a known bias."""
    if reports.range_m is None or reports.bearing_deg is None:
        return reports
    course = None if reports.course_deg is None else (reports.course_deg - bias.azimuth_deg) % 360.0
    return replace(
        reports, time_s=reports.time_s - bias.time_s, range_m=(reports.range_m - bias.range_m) / (1 + bias.range_gain),
        bearing_deg=(reports.bearing_deg - bias.azimuth_deg) % 360.0, course_deg=course,
    )  # fmt: skip


Method = Callable[[Instant], list[np.ndarray]]


def instant_only(now: Instant) -> list[np.ndarray]:
    """Object numbers of the records of every source, from this instant only."""
    identified = identify_many(now.sources, rule=now.rule(), region=now.region)
    return [np.ma.filled(identified.of(k).object, -1) for k in range(len(now.sources))]


def scored(trial: Trial, scene: Scene, instants: np.ndarray, method: Method) -> PictureScore:
    """The score of a method that identifies instant by instant."""
    columns: dict[str, list[np.ndarray]] = {"time_s": [], "source": [], "object": [], "row": []}
    for instant_s in instants:
        now = scene.at(float(instant_s)).with_records()
        for feed, source, numbers in zip(now.feeds, now.sources, method(now), strict=True):
            rows = records_of(source).ids
            columns["time_s"].append(np.full(len(rows), instant_s))
            columns["source"].append(np.full(len(rows), feed.description.name))
            columns["object"].append(np.asarray(numbers))
            columns["row"].append(rows)
    joined = {name: np.concatenate(parts) for name, parts in columns.items()}
    return pair_score(Identities.of(joined, trial.true_of(joined)))


@dataclass(frozen=True)
class MemoryScore:
    """The picture with memory against the truth: pairs, SIAP metrics, NEES of the fused states.

    error_m, half_m : RMS and median error of the fused positions.
    gospa_m, missed, false : means over instants.
    """

    score: PictureScore
    siap: Siap
    nees: Nees
    error_m: float
    half_m: float
    gospa_m: float
    missed: float
    false: float

    @classmethod
    def of(cls, trial: Trial, picture: Picture) -> MemoryScore:
        identities = Identities.of(picture.records, trial.true_of(picture.records))
        votes = majority_votes(identities)
        key = {pair: k for k, pair in enumerate(zip(votes.time_s.tolist(), votes.assigned.tolist(), strict=True))}
        objects = picture.objects
        at = [key.get(pair, -1) for pair in zip(objects["time_s"].tolist(), objects["object"].tolist(), strict=True)]
        row = np.flatnonzero([k >= 0 and votes.true[k] >= 0 for k in at])
        k = np.array(at)[row]
        true_at = {t: trial.world.true.at(t)[:, :2] for t in np.unique(votes.time_s).tolist()}
        true = np.array([true_at[t][j] for t, j in zip(votes.time_s[k].tolist(), votes.true[k], strict=True)])
        estimated = np.column_stack([objects["x_m"], objects["y_m"]])[row]
        packed = [np.ma.filled(objects[name], np.nan)[row] for name in ("var_x_m2", "cov_xy_m2", "var_y_m2")]
        honest = nees(
            estimated, np.stack([packed[0], packed[1], packed[1], packed[2]], axis=-1).reshape(-1, 2, 2), true
        )
        off_m = np.ma.filled(np.hypot(*(estimated - true).T), np.nan)
        error_m, half_m = float(np.sqrt(np.nanmean(off_m**2))), float(np.nanmedian(off_m))
        return cls(pair_score(identities), siap(identities), honest, error_m, half_m, *gospa(trial, picture))


def gospa(trial: Trial, picture: Picture) -> tuple[float, float, float]:
    """Mean GOSPA in metres, missed and false objects per instant, of the confirmed objects against all true ones."""
    objects = picture.objects
    confirmed = (objects["stage"] == "confirmed") & ~np.ma.getmaskarray(objects["x_m"])
    position = np.column_stack([np.ma.getdata(objects[name]) for name in ("x_m", "y_m")])
    pictures = []
    for instant_s in picture.instants_s:
        true = trial.world.true.at(float(instant_s))[:, :2]
        pictures.append((position[confirmed & (objects["time_s"] == instant_s)], true[np.isfinite(true).all(axis=1)]))
    mean, parts = mean_gospa(pictures, cutoff=CUTOFF_M)
    return mean, float(np.mean([part.missed for part in parts])), float(np.mean([part.false for part in parts]))


@dataclass(frozen=True)
class Steps:
    """Seconds between instants: scored alone, and of the picture with memory."""

    alone_s: float
    picture_s: float


@dataclass(frozen=True)
class Lines:
    """The rows of one trial in every table."""

    picture_rows: list[object]
    others: list[list[object]]
    biases: list[list[object]]

    @classmethod
    def of(cls, trial: Trial, label: list[object], steps: Steps) -> Lines:
        start = time.process_time()
        instants = trial.instants(steps.alone_s)
        biased, known = trial.scene(), trial.scene_unbiased()
        registered, biases = biased.registered()
        picture = MemoryScore.of(trial, Picture.of(registered, trial.instants(steps.picture_s)))
        instant_scores = [scored(trial, scene, instants, instant_only) for scene in (biased, known, registered)]
        picture_row = [
            *label, *(score.pairs.f1 for score in instant_scores), picture.score.pairs.f1,
            picture.score.pairs.precision, picture.score.pairs.recall, picture.score.share_right,
            picture.siap.completeness, picture.siap.ambiguity,
            picture.siap.continuity, picture.siap.switches, picture.nees.mean,
            picture.nees.median, picture.error_m, picture.half_m, picture.gospa_m, picture.missed, picture.false,
        ]  # fmt: skip
        others = [
            [*label, name, *(scored(trial, scene, instants, method).pairs.f1 for scene in (biased, registered))]
            for name, method in contenders.methods().items()
        ]
        others.append([*label, "ours, one instant", instant_scores[0].pairs.f1, instant_scores[2].pairs.f1])
        print(f"  {trial.world.name} {label}: {time.process_time() - start:.0f} s of CPU", flush=True)
        return cls(picture_row, others, [[*label, *row] for row in _bias_rows(trial, biases)])


def _bias_rows(trial: Trial, biases: tuple[SourceBiases, ...]) -> list[list[object]]:
    """True and estimated biases of every radar."""
    rows: list[list[object]] = []
    for source, bias in zip(biases[1:], trial.biases[1:], strict=True):
        row: list[object] = [source.source]
        for name in ("range_m", "azimuth_deg", "time_s"):
            estimate = source.parameters.get(name)
            row += [
                getattr(bias, name),
                *((None, None) if estimate is None else (estimate.value, estimate.standard_error)),
            ]
        rows.append(row)
    return rows


LABEL = ("noise, m", "misses", "radars")
OURS = (
    *LABEL, "alone, biased", "alone, known", "alone, found", "memory", "precision", "recall", "instants right",
    "complete", "ambiguity", "continuity", "switches", "NEES (2)", "median (1.39)", "fused, m", "half within, m",
    "GOSPA, m", "missed", "false",
)  # fmt: skip
OTHERS = (*LABEL, "method", "F1, biased", "F1, biases found")
FOUND = (*LABEL, "source", "range, m", "found", "±", "azimuth, °", "found", "±", "late, s", "found", "±")


def tables(world: World, noises: tuple[float, ...], misses: tuple[float, ...], steps: Steps) -> list[Table]:
    """The three tables of a world."""
    lines = [
        Lines.of(Trial.of(world, noise, q, count, seed=count), [noise, q, count], steps)
        for noise in noises for q in misses for count in (2, 3)
    ]  # fmt: skip
    notes = (
        f"real motion, modelled sensors; F1 of pairs of records over all instants, one in {steps.alone_s:g} s, with "
        f"memory one in {steps.picture_s:g} s",
        "the log is a source and the truth at once: NEES is below 2 where its records have the most weight",
        f"GOSPA of the confirmed objects, cutoff {CUTOFF_M:g} m; missed and false per instant",
    )
    return [
        Table(f"{world.name}: ours", OURS, [line.picture_rows for line in lines], notes),
        Table(
            f"{world.name}: other methods, one instant", OTHERS, [row for line in lines for row in line.others], notes
        ),
        Table(f"{world.name}: biases", FOUND, [row for line in lines for row in line.biases], notes),
    ]


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="25 m and 10 %% misses only, a third of the instants")
    parser.add_argument("--every", type=float, help="seconds between instants scored alone; 60, 180 if quick")
    parser.add_argument("--step", type=float, help="seconds between instants of the picture; 10, 30 if quick")
    parser.add_argument("--cache", type=Path, default=CACHE, help="folder of downloads")
    options = parser.parse_args()
    worlds = [world for world in (solent(), paris(options.cache)) if world is not None]
    noises, misses = ((25.0,), (0.1,)) if options.quick else ((25.0, 50.0), (0.1, 0.3))
    usual = Steps(180.0, 30.0) if options.quick else Steps(60.0, 10.0)
    steps = Steps(options.every or usual.alone_s, options.step or usual.picture_s)
    report("picture", (table for world in worlds for table in tables(world, noises, misses, steps)))


if __name__ == "__main__":
    main()

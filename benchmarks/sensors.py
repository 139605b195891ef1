"""Sensor troubles: azimuth offsets of a radar in clutter, heights, and alarms for sources that deceive or fail.

Also prints the tables of ``unnamed_boats`` and ``unnamed_aircraft`` (without names in clutter), ``memory`` (stated
probabilities) and of ``autoferry`` (errors of fused positions).

The radar in clutter is modelled (``benchmarks.boat_radar``): a small radar on a moving boat, ten plots per
rotation, one or two of them from vessels with AIS, azimuth offset 0.5 to 8° either way, and in rough scenes a compass
that drifts by 2°, echoes that fade, and ships at berths. An estimate of the mean offset is right within 1°
and three standard errors (or 0.5°); established and not right is false. In scenes without common objects every
established offset is false. Other methods get the same plots and AIS: the azimuth at which most plots lie within a
radius of a vessel (fixed radius), the median rotation to the nearest vessel (nearest neighbour), and a fit that weighs
every pair of 16 instants. Stone Soup has no registration.

Heights: couples of aircraft cross in the plane or fly on one path, 300 or 7 000 m apart in height, seen by ADS-B and
by multilateration with heights of ± 20 m, in a part of the records, or with a bias. Right is an aircraft whose two
records are one object and nothing else is. Other methods get the positions of the same instants, in the plane or with
the heights.

Resolution: two boats pass side by side, and a marine radar shows both as one where it does not resolve them; a lidar
sees each in 60 % of its scans. Neither names them. Both are found if each is the nearest of an object of its own that
exists with p > 0.5, within 12 m. Told nothing, the tracker takes the radar to resolve everything.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib.util import find_spec

import numpy as np

from benchmarks import autoferry, invented, memory, motion, unnamed_aircraft, unnamed_boats
from benchmarks.autoferry_models import describe_all, models_from_others
from benchmarks.autoferry_scenes import FOLDER, SCENARIOS, scene_of
from benchmarks.boat_radar import BoatRadarScene, boat_radar
from benchmarks.contenders import Pairing, compass, nearest_one, stone_soup
from benchmarks.memory import instant_evidence
from benchmarks.picture import World, solent
from benchmarks.tables import Table, report
from benchmarks.watch_rules import SHIP_RULES, SOURCE_RULES, rule_alarms, source_alarms
from sameas.picture.picture import Picture, picture_states
from sameas.picture.picture_state import PictureState
from sameas.picture.plot_tracker import PlotTracker
from sameas.picture.watch import Watch
from sameas.records import Records
from sameas.simulate.sensors import Bias, Sensor, SensorOutput, TrueMotion
from sameas.tracks.bias_fit import BiasFit, fit_biases
from sameas.tracks.biases import AZIMUTH
from sameas.tracks.coordinates import LocalPlane
from sameas.tracks.faults import source_faults
from sameas.tracks.feed import Feed
from sameas.tracks.plot_offsets import fit_plots
from sameas.tracks.plot_pairs import Plots, candidates
from sameas.tracks.reports import Reports
from sameas.tracks.scene import POSITION_AND_VELOCITY, Scene
from sameas.tracks.snapshot import ComparedSource, common_scans
from sameas.tracks.source import Clutter, Description, MissRate, Resolution, SensorCoverage, SensorErrors, Site, Timing

#: Radius of the peers: plots within it belong to a vessel.
RADIUS_M = 60.0


@dataclass(frozen=True)
class Kind:
    """One line: vessels under way that both see (from, to), moored ones, AIS that the radar does not see, minutes.

    rough : the compass drifts by 2° within two minutes, echoes fade for half a minute, and four ships are at berths.
    """

    words: str
    common: tuple[int, int]
    moored: int
    unseen: int
    silent: int
    minutes: float
    rough: bool = False


KINDS = (
    Kind("3 vessels, 10 min", (3, 3), 1, 1, 1, 10.0),
    Kind("4 to 8 vessels, 10 min", (4, 8), 1, 1, 1, 10.0),
    Kind("3 to 8 vessels, 30 min", (3, 8), 1, 2, 2, 30.0),
    Kind("nothing in common, 10 min", (0, 0), 0, 6, 3, 10.0),
    Kind("3 to 8 vessels, 20 min, rough", (3, 8), 1, 2, 3, 20.0, True),
    Kind("nothing in common, 20 min, rough", (0, 0), 0, 6, 4, 20.0, True),
)


#: A rough scene.
ROUGH = partial(boat_radar, berthed=4, compass_deg=2.0, compass_s=120.0, fading_s=30.0)


def drawn(kind: Kind, seed: int) -> tuple[BoatRadarScene, float]:
    """A scene and its true azimuth offset, the mean over its time."""
    rng = np.random.default_rng(seed)
    azimuth = float(rng.uniform(0.5, 8.0) * rng.choice([-1, 1]))
    bias = Bias(range_m=float(rng.normal(0.0, 25.0)), azimuth_deg=azimuth, time_s=float(rng.uniform(0.0, 1.5)))
    common = int(rng.integers(kind.common[0], kind.common[1] + 1))
    rough = partial(ROUGH, berthed_seen=kind.common[1] > 0)
    scene = (rough if kind.rough else boat_radar)(
        rng, bias=bias, common=common, moored=kind.moored, unseen=kind.unseen, silent=kind.silent, minutes=kind.minutes
    )
    return scene, azimuth + float(scene.heading_error_deg.mean())


#: Azimuth, its standard error, and whether it is established.
Answer = tuple[float, float, bool]


def answer_of(fit: BiasFit | None) -> Answer:
    """The answer of a fit."""
    if fit is None:
        return np.nan, np.nan, False
    at = int(np.flatnonzero(fit.biases == AZIMUTH)[0])
    return float(fit.theta[at]), float(np.sqrt(fit.covariance[at, at])), fit.established


def by_all_plots(radar: Feed, ais: Feed) -> Answer:
    """`sameas`: all plots of all rotations."""
    return answer_of(fit_plots(radar, [ais]))


def by_instants(radar: Feed, ais: Feed) -> Answer:
    """The fit of 16 instants, which `sameas` used before."""
    scans = common_scans(ComparedSource(ais, None), ComparedSource(radar, 0))
    return answer_of(fit_biases(scans) if scans else None)


def by_radius(radar: Feed, ais: Feed) -> Answer:
    """The azimuth at which most plots lie within a radius of a vessel; without an error."""
    near = candidates(Plots.of(radar), radar, [ais])
    grid = np.arange(-20.0, 20.05, 0.25)
    across = near.residual[:, 1, None] - near.jacobian[:, 1, 1, None] * grid
    counts = (np.hypot(near.residual[:, :1], across) < RADIUS_M).sum(axis=0)
    return float(grid[int(np.argmax(counts))]), np.nan, True


def by_nearest(radar: Feed, ais: Feed) -> Answer:
    """The median rotation of every plot to the nearest vessel, 30 iterations."""
    near = candidates(Plots.of(radar), radar, [ais])
    azimuth = 0.0
    for _ in range(30):
        across = near.residual[:, 1] - near.jacobian[:, 1, 1] * azimuth
        distance = np.hypot(near.residual[:, 0], across)
        order = np.lexsort([distance, near.plot])
        first = order[np.unique(near.plot[order], return_index=True)[1]]
        first = first[distance[first] < 500.0]
        if not len(first):
            break
        azimuth += float(np.median(across[first] / near.jacobian[first, 1, 1]))
    return azimuth, np.nan, True


METHODS = {"all plots": by_all_plots, "16 instants": by_instants, "fixed radius": by_radius, "nearest": by_nearest}


def offsets(scenes: int) -> Table:
    """Offsets of a small radar in clutter."""
    lines = []
    for number, kind in enumerate(KINDS):
        answers: dict[str, list[Answer]] = {way: [] for way in METHODS}
        seconds = dict.fromkeys(METHODS, 0.0)
        truth = []
        for seed in range(scenes):
            simulated, azimuth = drawn(kind, 1000 * (number + 1) + seed)
            truth.append(azimuth)
            radar, ais = Scene.of(simulated.sources).feeds
            for way, method in METHODS.items():
                begin = time.process_time()
                answers[way].append(method(radar, ais))
                seconds[way] += time.process_time() - begin
        for way, given in answers.items():
            value, error, sure = (np.array(column) for column in zip(*given, strict=True))
            deviation = np.abs(value - np.array(truth))
            near = (deviation < np.maximum(0.5, 3.0 * np.nan_to_num(error))) & (deviation < 1.0)
            right = near & sure.astype(bool) & (kind.common[1] > 0)
            wrong = sure.astype(bool) & ~right
            spread = float(np.sqrt(np.mean(deviation[right] ** 2))) if right.any() else np.nan
            z = deviation[right] / error[right]
            lines.append(
                [kind.words, way, 100.0 * right.mean(), 100.0 * wrong.mean(), spread,
                 float(np.sqrt(np.mean(z**2))) if right.any() else np.nan, seconds[way] / scenes]
            )  # fmt: skip
    columns = ("scene", "method", "right and established %", "false %", "rms error °", "rms error / s.e.", "CPU s")
    return Table(
        f"Azimuth offsets of 0.5 to 8° of a small radar in clutter, {scenes} modelled scenes per line", columns, lines,
        ("fixed radius and nearest state no error and no doubt: every answer counts as established",),
    )  # fmt: skip


@dataclass(frozen=True)
class Injected:
    """A fault inserted into AIS. kind : of the expected alarm. change : returns AIS with the fault."""

    words: str
    kind: str
    change: Callable[[Reports, np.random.Generator], Reports]


def _middle(reports: Reports, rng: np.random.Generator) -> float:
    """A time in the middle third."""
    begin, end = float(reports.time_s.min()), float(reports.time_s.max())
    return float(rng.uniform(begin + (end - begin) / 3.0, end - (end - begin) / 3.0))


def _jumped(seconds: float) -> Callable[[Reports, np.random.Generator], Reports]:
    def change(reports: Reports, rng: np.random.Generator) -> Reports:
        late = reports.time_s >= _middle(reports, rng)
        return replace(reports, time_s=reports.time_s + seconds * late)

    return change


def _cut(reports: Reports, rng: np.random.Generator) -> Reports:
    return reports.where(reports.time_s < _middle(reports, rng))


def _stuck(reports: Reports, rng: np.random.Generator) -> Reports:
    lat, lon, when = np.array(reports.lat_deg), np.array(reports.lon_deg), _middle(reports, rng)
    assert reports.object_ids is not None
    for name in set(reports.object_ids):
        late = np.flatnonzero((reports.object_ids == name) & (reports.time_s > when))
        lat[late], lon[late] = lat[late[:1]], lon[late[:1]]
    return replace(reports, lat_deg=lat, lon_deg=lon)


def _flooded(reports: Reports, rng: np.random.Generator) -> Reports:
    burst = np.flatnonzero(np.abs(reports.time_s - _middle(reports, rng)) < 10.0)
    return reports.where(np.sort(np.concatenate([np.arange(len(reports)), np.repeat(burst, 60)])))


INJECTED = (
    Injected("nothing", "", lambda reports, rng: reports),
    Injected("clock jumps by +30 s", "clock", _jumped(30.0)),
    Injected("clock jumps by -30 s", "clock", _jumped(-30.0)),
    Injected("ends early", "ended", _cut),
    Injected("freezes", "frozen", _stuck),
    Injected("floods", "flood", _flooded),
)


def alarms(scenes: int) -> Table:
    """Alarms for faults inserted into AIS, and false alarms on sound data."""
    sets: dict[str, Callable[[int], tuple[tuple[Description, Reports], tuple[Description, Reports]] | None]] = {
        "boat's radar, 8 vessels": lambda seed: drawn(Kind("", (8, 8), 1, 1, 1, 10.0), 5000 + seed)[0].sources,
        "Solent's AIS, 10 min": _of_the_solent,
    }
    lines = []
    for words, sources_of in sets.items():
        for injected in INJECTED:
            found = false = tried = by_rule = false_rules = 0
            for seed in range(scenes):
                sources = sources_of(seed)
                if sources is None:
                    continue
                radar, (described, ais) = sources
                changed = injected.change(ais, np.random.default_rng(seed))
                feeds = Scene.of([radar, (described, changed)]).feeds
                kinds = {fault.kind for fault in source_faults(feeds)}
                tried, found, false = tried + 1, found + (injected.kind in kinds), false + len(kinds - {injected.kind})
                kinds = {kind for kind, *_ in source_alarms(feeds)} & {one.kind for one in INJECTED}
                by_rule, false_rules = by_rule + (injected.kind in kinds), false_rules + len(kinds - {injected.kind})
            if tried:
                seen = (found, by_rule) if injected.kind else (None, None)
                lines.append([words, injected.words, tried, seen[0], false, seen[1], false_rules])
    notes = ["false: alarms of another kind than the fault", SOURCE_RULES]
    if FOLDER.exists():
        count = sum(
            len(source_faults(scene_of(name, describe_all(models_from_others(name, SCENARIOS), name)).feeds))
            for name in SCENARIOS
        )
        notes.append(f"autoferry, {len(SCENARIOS)} unchanged recordings: {count} alarms")
    columns = ("sources", "fault", "scenes", "found", "false", "rules: found", "rules: false")
    return Table("Alarms", columns, lines, tuple(notes))


#: Change of the AIS of one ship from a moment on, and the expected alarm; "" without a change.
DECEPTIONS = (("nothing", ""), ("drags away at 4 m/s", "dragged"), ("leaps by 800 m", "dragged"), ("silent", "silent"))


def deceived(reports: Reports, ship: str, words: str, from_s: float) -> Reports:
    """AIS in which one ship's reports are false from a moment on."""
    late = (reports.object_ids == ship) & (reports.time_s >= from_s)
    if words == "silent":
        return reports.where(~late)
    away_m = {"nothing": 0.0 * reports.time_s, "leaps by 800 m": np.full(len(reports), 800.0)}.get(
        words, 4.0 * (reports.time_s - from_s)
    )
    return replace(reports, lat_deg=np.asarray(reports.lat_deg) + late * away_m / 111_240.0)


def deceptions(scenes: int) -> Table | None:
    """One ship of real AIS that deceives two modelled radars; all alarms count.

    Pictures of twelve minutes, and of twenty where the ship falls silent: at rest AIS may report every three minutes,
    so five minutes of silence of a ship at rest are no alarm yet.
    """
    world = solent()
    if world is None:
        return None
    begin = float(world.log.time_s.min()) + 120.0
    counts = {words: [0, 0, 0, 0, 0] for words, _ in DECEPTIONS}
    for seed in range(scenes):
        rng = np.random.default_rng(seed)
        from_s = begin + 60.0 * (seed % 10)
        until_s = from_s + 1200.0
        log = motion.between(world.log, from_s, until_s)
        radars = [replace(world.sensor(number, 20.0, 0.1), bias=Bias()) for number in range(2)]
        simulated = [(radar.description, radar(world.true, (from_s, until_s), rng)) for radar in radars]
        ship = _seen_by_all(world, log, [output for _, output in simulated], rng)
        when = from_s + rng.uniform(300.0, 420.0)
        for words, expected in DECEPTIONS:
            end = until_s if expected == "silent" else from_s + 720.0
            sources = [
                (world.described, deceived(log, ship, words, when)),
                *((d, output.reports) for d, output in simulated),
            ]
            scene = Scene.of([(d, reports.where(reports.time_s < end)) for d, reports in sources], world.true.plane)
            found = Picture.of(scene, np.arange(from_s + 30.0, end, 10.0)).summary.faults
            right = [fault.kind == expected and fault.track == ship for fault in found]
            counts[words][0] += 1
            counts[words][1] += any(right)
            counts[words][2] += len(right) - sum(right)
            of_ship = _tracks_of(ship, world, [output for _, output in simulated])
            kinds = {"dragged": ("alone", "jumped"), "silent": ("silent",)}.get(expected, ())
            rules = [kind in kinds and (source, track) in of_ship for kind, source, track in rule_alarms(scene.feeds)]
            counts[words][3] += any(rules)
            counts[words][4] += len(rules) - sum(rules)
    lines = [[words, tried, *((found, tried - found) if expected else (None, None)), false, rules if expected else None,
              false_rules]
             for (words, expected), (tried, found, false, rules, false_rules)
             in zip(DECEPTIONS, counts.values(), strict=True)]  # fmt: skip
    return Table(
        "Deception: real motion, modelled sensors",
        ("one ship's AIS", "scenes", "found", "missed", "false alarms", "rules: found", "rules: false alarms"), lines,
        ("Solent: all ships in 12 minutes of AIS (silent: 20), two modelled radars; false: any other alarm",
         SHIP_RULES),
    )  # fmt: skip


def _tracks_of(ship: str, world: World, outputs: Sequence[SensorOutput]) -> set[tuple[str, str]]:
    """The source and id of the tracks of a ship: her AIS, and those of the radars with mostly her plots."""
    own, out = world.true.names.index(ship), {(world.described.name, ship)}
    for output in outputs:
        ids = output.reports.object_ids
        assert ids is not None
        for track in np.unique(ids.astype(str)):
            if np.mean(output.truth[ids.astype(str) == track] == own) > 0.5:
                out.add((output.reports.source, str(track)))
    return out


def _seen_by_all(world: World, log: Reports, outputs: Sequence[SensorOutput], rng: np.random.Generator) -> str:
    """A ship with AIS that all radars see throughout."""
    own = world.true.objects_of(log)
    often = [np.bincount(output.truth[output.truth >= 0], minlength=own.max() + 1) for output in outputs]
    seen = np.min([count >= 0.6 * count.max() for count in often], axis=0)
    assert log.object_ids is not None
    reporting = {k for k in np.unique(own[own >= 0]).tolist() if (own == k).sum() >= 60 and seen[k]}
    return str(rng.choice(sorted({str(name) for name, k in zip(log.object_ids, own, strict=True) if k in reporting})))


def _of_the_solent(seed: int) -> tuple[tuple[Description, Reports], tuple[Description, Reports]] | None:
    """Ten minutes of real AIS, and a radar in the Solent that shows only clutter."""
    log = motion.solent()
    if log is None:
        return None
    begin = float(log.time_s.min()) + 60.0 + 150.0 * (seed % 25)
    radar = boat_radar(np.random.default_rng(seed), common=0, moored=0, unseen=0).sources[0]
    moved = replace(radar[1], time_s=radar[1].time_s - radar[1].time_s.min() + begin)
    return (radar[0], moved), (Description("ais", "ais"), motion.between(log, begin, begin + 600.0))


@dataclass(frozen=True)
class Levels:
    """One line of heights: metres between the aircraft of a couple, whether they fly on one path, the share of records
    with a height, the bias of those of multilateration, and the vertical speed of one, up, and of the other, down."""

    words: str
    apart_m: float
    on_one_path: bool = True
    known: float = 1.0
    bias_m: float = 0.0
    climb_m_per_s: float = 0.0


LEVELS = (
    Levels("crossing, no heights", 300.0, on_one_path=False, known=0.0),
    Levels("crossing, 7 000 m apart", 7000.0, on_one_path=False),
    Levels("on one path, no heights", 300.0, known=0.0),
    Levels("on one path, 300 m apart", 300.0),
    Levels("the same, one source 150 m too high", 300.0, bias_m=150.0),
    Levels("the same, half of the heights missing", 300.0, known=0.5),
    Levels("one climbs, one descends, no heights", 300.0, known=0.0, climb_m_per_s=8.0),
)
#: Couples of a scene; 1σ of their positions by each source and of all heights, metres, and of all vertical speeds, m/s;
#: seconds between reports.
COUPLES, POSITION_M, HEIGHT_M, CLIMB_M_PER_S, EVERY_S = 10, {"ads-b": 100.0, "mlat": 200.0}, 20.0, 1.0, 4.0


def couples(levels: Levels, seed: int) -> Scene:
    """Aircraft 2k and 2k + 1 fly on one line with 150 m/s, one above the other or towards each other so that they meet
    after a minute; the track ids are their numbers. Vertical speeds are reported where they are not 0."""
    rng = np.random.default_rng((seed, int(levels.apart_m)))
    number, sign = np.arange(2 * COUPLES), np.tile([1.0, 1.0 if levels.on_one_path else -1.0], COUPLES)
    angle = np.repeat(rng.uniform(0.0, 2.0 * np.pi, COUPLES), 2)
    speed = 150.0 * sign[:, None] * np.column_stack([np.sin(angle), np.cos(angle)])
    middle = 40e3 * np.column_stack(np.divmod(number // 2, 4))
    height = 3000.0 + 700.0 * (number // 2) + levels.apart_m * (number % 2)
    sources = []
    for name, sigma in POSITION_M.items():
        parts = []
        for t in np.arange(0.0, 120.0, EVERY_S):
            place = middle + (t - 60.0) * speed + sigma * rng.standard_normal(middle.shape)
            level = height + HEIGHT_M * rng.standard_normal(len(number)) + (levels.bias_m if name == "mlat" else 0.0)
            known = rng.random(len(number)) < levels.known
            parts.append([np.full(len(number), t), *place.T, np.where(known, level, np.nan), number])
        time_s, x, y, level, track = (np.concatenate(column) for column in zip(*parts, strict=True))
        columns = {"time_s": time_s, "x_m": x, "y_m": y, "track_id": track.astype(int).astype(str).astype(object)}
        columns |= {"alt_m": level} if levels.known else {}
        if levels.climb_m_per_s:
            climb = np.where(track % 2, -levels.climb_m_per_s, levels.climb_m_per_s)
            columns["climb_m_per_s"] = climb + CLIMB_M_PER_S * rng.standard_normal(len(climb))
        errors = SensorErrors(position_m=sigma, height_m=HEIGHT_M)
        sources.append((Description(name, name, errors=errors), Reports.of(name, "table", columns)))
    return Scene.of(sources)


def heights(scenes: int) -> Table:
    """Share of the aircraft with the right pair of records, by each method."""
    pairings: dict[str, Pairing] = {"nearest": nearest_one, "1852 m": compass}
    if find_spec("stonesoup") is not None:
        pairings["Stone Soup"] = stone_soup
    names = ("sameas, an instant", "sameas", *pairings, *(f"{name}, heights" for name in pairings if name != "1852 m"))
    rows: list[list[object]] = []
    for levels in LEVELS:
        right = {name: list[bool]() for name in names}
        for seed in range(scenes):
            scene = couples(levels, seed)
            for name, watch in (
                ("sameas, an instant", Watch(evidence=instant_evidence, bound=1.0)),
                ("sameas", Watch()),
            ):
                for state in picture_states(scene, np.arange(40.0, 81.0, EVERY_S), watch):
                    track = state.scan.track
                    sets = [tuple(track[members[members >= 0]]) for members in state.members]
                    right[name] += [(one, one) in sets for one in map(str, range(2 * COUPLES))]
                    if name == "sameas":
                        add_others(right, state, pairings)
        rows.append(
            [levels.words, len(right["sameas"]), *(100.0 * float(np.mean(r)) if r else None for r in right.values())]
        )
    return Table(
        "Aircraft above each other: per cent with the right pair of records", ("couples", "aircraft", *names), rows,
        ("other methods: the states at the instant, 3σ; with heights: records with a height, σ 20 m, no offset known",),
    )  # fmt: skip


def add_others(right: dict[str, list[bool]], state: PictureState, pairings: Mapping[str, Pairing]) -> None:
    """Add to the results of the other methods those of an instant."""
    scan, n = state.scan, len(state.now.sources)
    rows = [np.arange(scan.start[s], scan.start[s + 1]) for s in range(n)]
    levels = [
        np.full((len(own), 3), np.nan) if h is None else h for own, h in zip(rows, state.now.heights, strict=True)
    ]
    for name, pairing in pairings.items():
        for label, with_heights in ((name, False), (f"{name}, heights", True)):
            if label not in right or (with_heights and not np.isfinite(levels[0][:, 0]).any()):
                continue
            records, kept = [], []
            for own, level in zip(rows, levels, strict=True):
                kept.append(own[np.isfinite(level[:, 0])] if with_heights else own)
                place, covariance = scan.state[kept[-1], :2], scan.covariance[kept[-1], :2, :2]
                if with_heights:
                    z = level[np.isfinite(level[:, 0]), 0]
                    whole = np.tile(HEIGHT_M**2 * np.eye(3), (len(z), 1, 1))
                    whole[:, :2, :2] = covariance
                    place, covariance = np.column_stack([place, z]), whole
                records.append(Records.of(place, covariance=covariance, source=f"source {len(records)}"))
            i, j = pairing(records[0], records[1], np.zeros(len(records[1])))
            found = list(zip(scan.track[kept[0][i]], scan.track[kept[1][j]], strict=True))
            right[label] += [
                (one, one) in found and sum(one in pair for pair in found) == 1 for one in map(str, range(2 * COUPLES))
            ]


#: Metres between two boats, or None for one boat; metres within which an object is of a boat.
SIDE_BY_SIDE_M, OF_A_BOAT_M = (15.0, 25.0, 60.0, None), 12.0


def side_by_side(apart_m: float | None, seed: int) -> tuple[Scene, TrueMotion]:
    """Boats that pass a radar and a lidar at 500 m with 2 m/s, abreast of each other."""
    plane, rows = LocalPlane(50.8, -1.3), dict[str, list[float | str]](time_s=[], lat_deg=[], lon_deg=[], mmsi=[])
    for k, y in enumerate([500.0] if apart_m is None else [500.0, 500.0 + apart_m]):
        lat, lon = plane.to_geodetic(np.array([[2.0 * t - 120.0, y] for t in range(121)]))
        rows["time_s"] += range(121)
        rows["lat_deg"] += lat.tolist()
        rows["lon_deg"] += lon.tolist()
        rows["mmsi"] += [str(235_000_000 + k)] * 121
    true = TrueMotion.of(Reports.of("ais", "table", rows), plane=plane)
    site, clutter, rng = Site(50.8, -1.3), Clutter(per_km2=1.0), np.random.default_rng(seed)
    sensors = (
        Description("radar", "marine radar", site=site, misses=MissRate(0.1), clutter=clutter, timing=Timing(2.0, 0, 0),
                    coverage=SensorCoverage(range_m=1500.0), errors=SensorErrors(8.0, 0.0, 0.5, extent_m=2.0)),
        Description("lidar", "lidar", site=site, misses=MissRate(0.4), clutter=clutter, timing=Timing(1.0, 0.0, 0.0),
                    coverage=SensorCoverage(range_m=900.0), errors=SensorErrors(1.0, 0.0, 0.2, extent_m=2.0)),
    )  # fmt: skip
    return Scene.of([(one, Sensor(one)(true, (0.0, 120.0), rng).reports) for one in sensors], plane), true


def resolution(scenes: int) -> Table:
    """How often two boats that a radar does not resolve are two objects."""
    rows: list[list[object]] = []
    for apart_m in SIDE_BY_SIDE_M:
        for words, told in (("described", None), ("not told", Resolution(0.0, 0.0))):
            found, numbers, extra = list[bool](), list[set[int]](), list[bool]()
            for seed in range(scenes):
                scene, true = side_by_side(apart_m, seed)
                if told is not None:
                    feeds = tuple(replace(f, description=replace(f.description, resolution=told)) for f in scene.feeds)
                    scene = replace(scene, feeds=feeds)
                tracker, tracks, used = PlotTracker(), None, set[int]()
                for t in np.arange(3.0, 118.0):
                    tracks = tracker.advance(scene.at(t, features=POSITION_AND_VELOCITY), tracks)
                    there = tracks.existence > 0.5
                    off = np.linalg.norm(tracks.state[there, None, :2] - true.at(t)[:, :2], axis=2)
                    if t <= 15.0:
                        continue
                    near = off.min(axis=0, initial=np.inf) < OF_A_BOAT_M
                    own = np.unique(off.argmin(axis=0)) if len(off) else np.empty(0, np.int64)
                    found.append(bool(near.all()) and len(own) == len(true))
                    extra.append(int((off.min(axis=1, initial=np.inf) < 4.0 * OF_A_BOAT_M).sum()) > len(true))
                    used.update(tracks.number[there][own].tolist() if found[-1] else [])
                numbers.append(used)
            apart = "one boat" if apart_m is None else f"two boats {apart_m:.0f} m apart"
            rows.append([apart, words, 100.0 * float(np.mean(found)), 100.0 * float(np.mean(extra)),
                         float(np.mean([len(used) for used in numbers]))])  # fmt: skip
    return Table(
        "Boats abreast of each other that a radar shows as one, without names",
        ("boats", "the radar's resolution", "all found, %", "too many, %", "numbers used"), rows,
        (f"{scenes} scenes of two minutes; the radar resolves 40 m or 2.5°, 22 m there",),
    )  # fmt: skip


def tables(options: argparse.Namespace) -> Iterator[Table]:
    """All tables."""
    if "offsets" in options.only:
        yield offsets(options.scenes)
    if "heights" in options.only:
        yield heights(min(options.scenes, 10))
    if "resolution" in options.only:
        yield resolution(min(options.scenes, 12))
    if "boats" in options.only:
        yield unnamed_boats.table(min(options.scenes, 3))
    if "aircraft" in options.only:
        yield unnamed_aircraft.table(min(options.scenes, 3))
    if "alarms" in options.only:
        yield alarms(min(options.scenes, 20))
        yield invented.table(min(options.scenes, 20))
    if "positions" in options.only and FOLDER.exists():
        yield autoferry.positions(0.5)
        yield autoferry.kinds_only(0.5)
    if "memory" in options.only:
        yield from memory.table(every_s=30.0, seeds=range(2), only="")
    if "deception" in options.only and (table := deceptions(min(options.scenes, 10))) is not None:
        yield table


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(prog="scripts/bench sensors", description=__doc__)
    parser.add_argument("--scenes", type=int, default=100, help="modelled scenes of each line (default 100)")
    sections = ("aircraft", "alarms", "boats", "deception", "heights", "memory", "offsets", "positions", "resolution")
    parser.add_argument("--only", nargs="+", choices=sections, default=sections, help="sections to print")
    report("sensors", tables(parser.parse_args()))


if __name__ == "__main__":
    main()

"""Aircraft that radars without track numbers show: they turn and change speed, and codes of transponders are shared.

Twelve aircraft in a square of 100 km for fifteen minutes: half fly straight at 180 to 240 m/s, half at 90 to 140 m/s
and turn by 3° a second through 90° every three minutes. Two radars, of 4.8 and 12 s a turn, give ranges and azimuths,
± 60 m and 0.08°, of 93 % of them, the code of the transponder (1000 for half of them), and false plots; they read 80 m
too far and 0.25° too far clockwise, or −50 m and −0.3°. In some lines ADS-B reports two thirds of the aircraft. The
radars are described by their kind and place only. Scored are the confirmed objects of the instants 10 s apart after
two minutes: aircraft within 500 m of one, the numbers used for an aircraft, and objects more than 2 km from all
aircraft.

Stone Soup gets the plots of the faster radar, without its offsets, its errors described: global nearest neighbour, gate
of 4σ, tracks of three plots or more (``MultiMeasurementInitiator``), deleted after three scans without a plot, with the
noise of motion that this library assumes for straight flight, and ten times that.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec

import numpy as np

from benchmarks.tables import Table
from benchmarks.unnamed import Scoring, StoneSoup, of_picture
from sameas.tracks.reports import Reports
from sameas.tracks.scene import Scene
from sameas.tracks.source import Description, Site

AIRCRAFT, SPAN_S, SIDE_M, AFTER_S, STEP_S = 12, 900.0, 1e5, 120.0, 0.2
P_SHOWN, RANGE_M, AZIMUTH_DEG = 0.93, 60.0, 0.08
#: Metres within which an object is of an aircraft, and beyond which it is of none.
NEAR_M, FAR_M = 500.0, 2000.0
#: Power density of the velocity walk of straight flight, m²/s³.
WALK = 4.0


@dataclass(frozen=True)
class Radar:
    """Name, place, seconds a turn, offsets in range and azimuth."""

    name: str
    site: tuple[float, float]
    turn_s: float
    range_m: float
    azimuth_deg: float


RADARS = (Radar("approach", (0.0, 0.0), 4.8, 80.0, 0.25), Radar("route", (9e3, 2e4), 12.0, -50.0, -0.3))


@dataclass(frozen=True)
class Kind:
    """A line: false plots a scan, and whether ADS-B reports two thirds of the aircraft."""

    clutter: float
    adsb: bool


KINDS = (Kind(0.0, False), Kind(10.0, False), Kind(10.0, True))


@dataclass(frozen=True)
class Trial:
    """Places (aircraft, times, 2) every 0.2 s, plots of each radar (time, range, azimuth, code), and ADS-B."""

    kind: Kind
    place: np.ndarray
    plots: tuple[list[tuple[float, float, float, str]], ...]
    adsb: Reports | None

    @classmethod
    def of(cls, kind: Kind, seed: int) -> Trial:
        rng, t = np.random.default_rng(seed), np.arange(0.0, SPAN_S, STEP_S)
        turns = np.arange(AIRCRAFT) % 2 == 1
        phase_s = rng.uniform(0.0, 150.0, AIRCRAFT)[:, None]
        turning = turns[:, None] & ((t + phase_s) % 180.0 < 30.0)
        course = rng.uniform(0.0, 2.0 * np.pi, AIRCRAFT)[:, None] + np.radians(3.0) * STEP_S * np.cumsum(
            turning, axis=1
        )
        speed = np.where(turns, rng.uniform(90.0, 140.0, AIRCRAFT), rng.uniform(180.0, 240.0, AIRCRAFT))
        velocity = speed[:, None, None] * np.stack([np.sin(course), np.cos(course)], axis=-1)
        # In the middle of the time near the middle of the square.
        place = np.cumsum(STEP_S * velocity, axis=1)
        place += rng.uniform(-0.3, 0.3, (AIRCRAFT, 1, 2)) * SIDE_M - place[:, len(t) // 2, None]
        codes = [("1000" if k < AIRCRAFT // 2 else f"{4500 + k}") for k in rng.permutation(AIRCRAFT)]
        plots = tuple(cls._plots(radar, place, t, codes, kind.clutter, rng) for radar in RADARS)
        reported = np.flatnonzero(np.arange(AIRCRAFT) % 3 > 0)
        adsb = cls._reports(place, velocity, t, reported, rng) if kind.adsb else None
        return cls(kind, place, plots, adsb)

    @staticmethod
    def _plots(
        radar: Radar, place: np.ndarray, t: np.ndarray, codes: list[str], clutter: float, rng: np.random.Generator
    ) -> list[tuple[float, float, float, str]]:
        """The plots in the order of their times."""
        out: list[tuple[float, float, float, str]] = []
        for k in range(AIRCRAFT):
            east, north = (place[k] - radar.site).T
            azimuth = np.degrees(np.arctan2(east, north)) % 360.0
            behind = (t / radar.turn_s - azimuth / 360.0) % 1.0
            seen = np.flatnonzero((np.diff(behind) < -0.5) & (rng.random(len(t) - 1) < P_SHOWN))
            range_m = np.hypot(east, north)[seen] + radar.range_m + RANGE_M * rng.normal(size=len(seen))
            read = azimuth[seen] + radar.azimuth_deg + AZIMUTH_DEG * rng.normal(size=len(seen))
            out += zip(t[seen].tolist(), range_m.tolist(), (read % 360.0).tolist(), [codes[k]] * len(seen), strict=True)
        n = rng.poisson(clutter * SPAN_S / radar.turn_s)
        turn, azimuth = rng.integers(0, int(SPAN_S / radar.turn_s), n), rng.uniform(0.0, 360.0, n)
        time_s, range_m = radar.turn_s * (turn + azimuth / 360.0), rng.uniform(5e3, 0.6 * SIDE_M, n)
        return sorted([*out, *zip(time_s.tolist(), range_m.tolist(), azimuth.tolist(), [""] * n, strict=True)])

    @staticmethod
    def _reports(
        place: np.ndarray, velocity: np.ndarray, t: np.ndarray, reported: np.ndarray, rng: np.random.Generator
    ) -> Reports:
        """ADS-B once a second, ± 20 m and 1 m/s."""
        rows = np.arange(0, len(t), round(1.0 / STEP_S))
        names = np.repeat([f"39d3{k:02d}" for k in reported], len(rows))
        position = place[np.ix_(reported, rows)].reshape(-1, 2) + 20.0 * rng.normal(size=(len(names), 2))
        speed = velocity[np.ix_(reported, rows)].reshape(-1, 2) + rng.normal(size=(len(names), 2))
        columns = {"time_s": np.tile(t[rows], len(reported)) + 0.2, "icao": names, "track_id": names}
        columns |= {"x_m": position[:, 0], "y_m": position[:, 1]}
        return Reports.of("adsb", "table", columns | {"vx_m_per_s": speed[:, 0], "vy_m_per_s": speed[:, 1]})

    def scene(self) -> Scene:
        """The scene, the radars described by their kind and place."""
        sources = []
        for radar, plots in zip(RADARS, self.plots, strict=True):
            columns = dict(zip(("time_s", "range_m", "bearing_deg", "mode_a"), zip(*plots, strict=True), strict=True))
            site = Site(east_m=radar.site[0], north_m=radar.site[1])
            sources.append((Description(radar.name, "air radar", site=site), Reports.of(radar.name, "table", columns)))
        if self.adsb is not None:
            sources.append((Description("adsb", "ads-b"), self.adsb))
        return Scene.of(sources)

    @property
    def score(self) -> Scoring:
        """Of all aircraft."""
        times = np.arange(AFTER_S, SPAN_S - 10.0, 10.0)
        return Scoring(times, lambda t: self.place[:, round(t / STEP_S)], AIRCRAFT, NEAR_M, FAR_M)


def by_sameas(trial: Trial) -> tuple[float, float, float]:
    """The score of the picture."""
    scene, _ = trial.scene().registered()
    return trial.score(of_picture(scene, 10.0))


def by_stone_soup(trial: Trial, walk: float) -> tuple[float, float, float]:
    """The score of Stone Soup's multi-target tracker with the plots of the first radar, without their offsets."""
    radar, tracker = RADARS[0], StoneSoup(walk=walk, speed_m_per_s=150.0, sigma_m=100.0, gate_sigmas=4, scans=3)
    time_s, range_m, azimuth_deg = np.array([plot[:3] for plot in trial.plots[0]]).T
    range_m, azimuth = range_m - radar.range_m, np.radians(azimuth_deg - radar.azimuth_deg)
    axes = np.stack([np.sin(azimuth), np.cos(azimuth), np.cos(azimuth), -np.sin(azimuth)], axis=-1).reshape(-1, 2, 2)
    variance = np.column_stack([np.full(len(range_m), RANGE_M**2), (range_m * np.radians(AZIMUTH_DEG)) ** 2])
    place, covariance = range_m[:, None] * axes[:, 0], np.swapaxes(axes, 1, 2) @ (variance[:, :, None] * axes)
    scan = np.floor(time_s / radar.turn_s).astype(int)
    # A tracker of scans takes all plots of a turn at one time.
    scans = [(radar.turn_s * (k + 0.5), place[scan == k], covariance[scan == k]) for k in range(scan.max() + 1)]
    tracks = tracker(scans)

    def shown(t: float) -> tuple[np.ndarray, np.ndarray]:
        time_s, number, state = tracks[max(int(t / radar.turn_s - 0.5), 0)]
        return number, state[:, [0, 2]] + (t - time_s) * state[:, [1, 3]]

    return trial.score(shown)


def table(scenes: int) -> Table:
    """Aircraft found and false objects of each kind of scene."""
    ways: dict[str, Callable[[Trial], tuple[float, float, float]]] = {"sameas": by_sameas}
    if find_spec("stonesoup") is not None:
        ways["Stone Soup"] = lambda trial: by_stone_soup(trial, WALK)
        ways["noise × 10"] = lambda trial: by_stone_soup(trial, 10.0 * WALK)
    rows: list[list[object]] = []
    for kind in KINDS:
        trials = [Trial.of(kind, seed) for seed in range(scenes)]
        row: list[object] = [kind.clutter, "2 of 3" if kind.adsb else "none"]
        for way in ways.values():
            row += np.mean([way(trial) for trial in trials], axis=0).tolist()
        rows.append(row)
    columns = [
        f"{way}: {what}" for way in ways for what in ("aircraft shown, %", "numbers an aircraft", "false objects")
    ]
    return Table(
        "Aircraft in radars without track numbers",
        ("clutter a scan", "with ADS-B", *columns), rows,
        (f"{scenes} scenes of twelve aircraft each; false objects at an instant",),
    )  # fmt: skip

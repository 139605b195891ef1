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

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import datetime, timedelta
from importlib.util import find_spec

import numpy as np

from benchmarks.tables import Table
from sameas.picture import Picture, instants
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

    def score(self, shown: Callable[[float], tuple[np.ndarray, np.ndarray]]) -> tuple[float, float, float]:
        """Percent of the aircraft shown, numbers an aircraft, and false objects an instant; shown : gives the numbers
        and the places of the confirmed objects at a time."""
        found, false, times = np.zeros(AIRCRAFT), 0, np.arange(AFTER_S, SPAN_S - 10.0, 10.0)
        used: list[set[int]] = [set() for _ in range(AIRCRAFT)]
        for t in times:
            number, at = shown(float(t))
            off = np.linalg.norm(at[:, None] - self.place[:, round(t / STEP_S)], axis=2)
            false += int((off > FAR_M).all(axis=1).sum())
            near = off < NEAR_M
            found += near.any(axis=0)
            for k in range(AIRCRAFT):
                used[k].update(number[near[:, k]].tolist())
        return (
            100.0 * float(found.mean()) / len(times),
            float(np.mean([len(each) for each in used])),
            false / len(times),
        )


def by_sameas(trial: Trial) -> tuple[float, float, float]:
    """The score of the picture."""
    scene, _ = trial.scene().registered()
    objects = Picture.of(scene, instants(scene.span_s, every_s=10.0)).objects
    confirmed = np.isin(objects["stage"], ("confirmed", "coasting"))
    time_s, number = np.asarray(objects["time_s"]), np.asarray(objects["object"])
    place = np.column_stack([objects["x_m"], objects["y_m"]])

    def shown(t: float) -> tuple[np.ndarray, np.ndarray]:
        here = np.flatnonzero((time_s == t) & confirmed)
        return number[here], place[here]

    return trial.score(shown)


def by_stone_soup(trial: Trial, walk: float) -> tuple[float, float, float]:
    """The score of Stone Soup's multi-target tracker with the plots of the first radar, without their offsets."""
    from stonesoup.dataassociator.neighbour import GNNWith2DAssignment
    from stonesoup.deleter.time import UpdateTimeStepsDeleter
    from stonesoup.hypothesiser.distance import DistanceHypothesiser
    from stonesoup.initiator.simple import MultiMeasurementInitiator
    from stonesoup.measures import Mahalanobis
    from stonesoup.models.measurement.linear import LinearGaussian
    from stonesoup.models.transition.linear import CombinedLinearGaussianTransitionModel, ConstantVelocity
    from stonesoup.predictor.kalman import KalmanPredictor
    from stonesoup.tracker.simple import MultiTargetTracker
    from stonesoup.types.detection import Detection
    from stonesoup.types.state import GaussianState
    from stonesoup.updater.kalman import KalmanUpdater

    began, radar = datetime(2026, 1, 1), RADARS[0]
    model = LinearGaussian(4, (0, 2), 100.0**2 * np.eye(2))
    predictor = KalmanPredictor(CombinedLinearGaussianTransitionModel([ConstantVelocity(walk)] * 2))
    updater = KalmanUpdater(None)
    associator = GNNWith2DAssignment(DistanceHypothesiser(predictor, updater, Mahalanobis(), missed_distance=4))
    deleter = UpdateTimeStepsDeleter(3)
    prior = GaussianState(np.zeros((4, 1)), np.diag([0.0, 150.0**2, 0.0, 150.0**2]), timestamp=began)
    initiator = MultiMeasurementInitiator(prior, deleter, associator, updater, model, min_points=3)
    plots = np.array([plot[:3] for plot in trial.plots[0]])
    scan = np.floor(plots[:, 0] / radar.turn_s).astype(int)

    def detection(plot: np.ndarray, now: datetime) -> Detection:
        """A plot with the covariance of its range and azimuth."""
        range_m, azimuth = plot[1] - radar.range_m, np.radians(plot[2] - radar.azimuth_deg)
        along, across = np.array([np.sin(azimuth), np.cos(azimuth)]), np.array([np.cos(azimuth), -np.sin(azimuth)])
        sigma = range_m * np.radians(AZIMUTH_DEG)
        covariance = RANGE_M**2 * np.outer(along, along) + sigma**2 * np.outer(across, across)
        measured = LinearGaussian(4, (0, 2), covariance)
        return Detection((range_m * along)[:, None], timestamp=now, measurement_model=measured)

    def scans() -> Iterator[tuple[datetime, set[Detection]]]:
        for k in range(scan.max() + 1):
            # A tracker of scans takes all plots of a turn at one time.
            now = began + timedelta(seconds=radar.turn_s * (k + 0.5))
            yield now, {detection(plot, now) for plot in plots[scan == k]}

    at: list[tuple[float, np.ndarray, np.ndarray]] = []
    numbers: dict[str, int] = {}
    for now, tracks in MultiTargetTracker(initiator, deleter, scans(), associator, updater):
        ordered = sorted(tracks, key=lambda track: track.id)
        number = np.array([numbers.setdefault(track.id, len(numbers)) for track in ordered], np.int64)
        state = np.array([track.state_vector[:, 0] for track in ordered], np.float64).reshape(-1, 4)
        at.append(((now - began).total_seconds(), number, state))

    def shown(t: float) -> tuple[np.ndarray, np.ndarray]:
        time_s, number, state = at[max(int(t / radar.turn_s - 0.5), 0)]
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

"""A simulated day of the live watch: memory, state, journal, archive and time of a tick, hour by hour.

Ships arrive and leave all day, each with an MMSI of its own, so that everything kept of a ship that has left shows. Two
radars give a track another number every twenty minutes or so, and use old numbers again. The keeper is that of ``sameas
watch``, with its folder, journal, archive, alarms, registration and search for faults; only the clock is simulated. A
memory that grows with the hours is a leak; the journal and the archive grow, as they are meant to.
"""

from __future__ import annotations

import argparse
import gc
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from benchmarks.tables import Table, report
from benchmarks.worker import status_mb
from sameas.kernels import compiled
from sameas.live.keeper import Keeper
from sameas.live.replay import Replay
from sameas.live.settings import LiveSource, Settings, WatchSettings
from sameas.tracks.coordinates import LocalPlane
from sameas.tracks.reports import Reports
from sameas.tracks.source import Description, SensorErrors, Site

START_S = 1_764_201_600.0
SITE = (50.55, -0.95)
HALF_WIDTH_M = 8000.0
#: Seconds between ticks, between registrations, and between searches for faults.
TICK_S, REGISTER_S, SEARCH_S = 5.0, 300.0, 30.0
#: Mean stay of a ship, and life of a radar's track number; numbers are used again after this many.
STAY_S, NUMBER_S, NUMBERS = 5400.0, 1200.0, 1000
RADARS = ("radar 1", "radar 2")
POSITION_M, RADAR_PERIOD_S, AIS_PERIOD_S = 15.0, 3.0, 10.0


@dataclass
class Ships:
    """The ships present, (n, 8): number of arrival, place, m, velocity, m/s, end of the stay, s, and the radars' number
    of the track with its end, s."""

    mean: int
    rng: np.random.Generator
    arrived: int = 0
    numbered: int = 0
    rows: np.ndarray = field(default_factory=lambda: np.empty((0, 8)))

    def at(self, now_s: float, elapsed_s: float) -> np.ndarray:
        """The ships at this time, ``elapsed_s`` after the last: moved, some have left, and others arrived."""
        self.rows[:, 1:3] += elapsed_s * self.rows[:, 3:5]
        turned = np.abs(self.rows[:, 1:3]) > HALF_WIDTH_M
        self.rows[:, 3:5] = np.where(turned, -np.sign(self.rows[:, 1:3]) * np.abs(self.rows[:, 3:5]), self.rows[:, 3:5])
        self.rows = self.rows[self.rows[:, 5] > now_s]
        due = self.mean if not self.arrived else int(self.rng.poisson(self.mean * elapsed_s / STAY_S))
        new = np.zeros((due, 8))
        new[:, 0] = self.arrived + np.arange(due)
        new[:, 1:3], new[:, 3:5] = (
            self.rng.uniform(-HALF_WIDTH_M, HALF_WIDTH_M, (due, 2)),
            self.rng.normal(0, 4, (due, 2)),
        )
        new[self.rng.random(due) < 0.3, 3:5] = 0.0
        new[:, 5] = now_s + self.rng.exponential(STAY_S, due)
        self.rows, self.arrived = np.vstack([self.rows, new]), self.arrived + due
        ended = np.flatnonzero(self.rows[:, 7] <= now_s)
        self.rows[ended, 6] = (self.numbered + np.arange(len(ended))) % NUMBERS
        self.rows[ended, 7] = now_s + self.rng.exponential(NUMBER_S, len(ended))
        self.numbered += len(ended)
        return self.rows


class Traffic(Replay):
    """Reports made when they are taken: those of a day need not be kept in memory, which is measured."""

    def __init__(
        self, mean: int, seed: int, radar_period_s: float = RADAR_PERIOD_S, ais_period_s: float = AIS_PERIOD_S
    ) -> None:
        first = {"time_s": [START_S], "lat_deg": [SITE[0]], "lon_deg": [SITE[1]]}
        super().__init__([("ais", Reports.of("ais", "ais", first | {"mmsi": ["1"], "track_id": ["1"]}))])
        self.ships, self.rng = Ships(mean, np.random.default_rng(seed)), np.random.default_rng((seed, 1))
        self.plane, self.taken_s = LocalPlane(*SITE), START_S
        self.radar_period_s, self.ais_period_s = radar_period_s, ais_period_s

    def take(self, until_s: float) -> list[tuple[str, Reports]]:
        """The reports since the last call."""
        elapsed_s = until_s - self.taken_s
        ships = self.ships.at(until_s, elapsed_s)
        self.taken_s = until_s
        parts = [("ais", self._ais(ships, until_s, elapsed_s))]
        parts += [(name, self._radar(name, ships, until_s, elapsed_s)) for name in RADARS]
        return [(name, reports) for name, reports in parts if len(reports)]

    def _times(self, ships: np.ndarray, until_s: float, elapsed_s: float, period_s: float) -> np.ndarray:
        """(n,) times of one report of each ship at most, in this span; NaN for none."""
        age_s = self.rng.random(len(ships)) * min(elapsed_s, period_s)
        return np.where(self.rng.random(len(ships)) < min(elapsed_s / period_s, 0.95), until_s - age_s, np.nan)

    def _measured(self, ships: np.ndarray, times_s: np.ndarray, until_s: float) -> np.ndarray:
        place = ships[:, 1:3] - (until_s - times_s)[:, None] * ships[:, 3:5]
        return np.asarray(place + POSITION_M * self.rng.standard_normal(place.shape))

    def _ais(self, ships: np.ndarray, until_s: float, elapsed_s: float) -> Reports:
        times_s = self._times(ships, until_s, elapsed_s, self.ais_period_s)
        has = np.isfinite(times_s)
        lat, lon = self.plane.to_geodetic(self._measured(ships, times_s, until_s)[has])
        mmsi = np.array([f"{235_000_000 + int(k)}" for k in ships[has, 0]], object)
        return Reports.of("ais", "ais", {
            "time_s": times_s[has], "lat_deg": lat, "lon_deg": lon, "mmsi": mmsi, "track_id": mmsi,
            "name": np.array([f"SHIP {int(k)}" for k in ships[has, 0]], object),
            "vx_m_per_s": ships[has, 3], "vy_m_per_s": ships[has, 4],
        }).in_time_order()  # fmt: skip

    def _radar(self, name: str, ships: np.ndarray, until_s: float, elapsed_s: float) -> Reports:
        times_s = self._times(ships, until_s, elapsed_s, self.radar_period_s)
        has = np.isfinite(times_s)
        place = self._measured(ships, times_s, until_s)[has]
        return Reports.of(name, "table", {
            "time_s": times_s[has], "range_m": np.hypot(*place.T), "bearing_deg": np.degrees(np.arctan2(*place.T)),
            "track_id": np.array([f"{int(k)}" for k in ships[has, 6]], object),
        }).in_time_order()  # fmt: skip


def settings() -> Settings:
    """AIS and two radars at one site."""
    errors = SensorErrors(range_m=POSITION_M, range_share=0.0, bearing_deg=0.3, extent_m=5.0)
    described = [Description("ais", "ais"), *(
        Description(name, "marine radar", site=Site(lat_deg=SITE[0], lon_deg=SITE[1]), errors=errors) for name in RADARS
    )]  # fmt: skip
    return Settings({one.name: LiveSource(one) for one in described}, WatchSettings(every_s=TICK_S, save_every_s=60.0))


def size_mb(folder: Path, pattern: str) -> float:
    """Of all files of this name in the folder."""
    return sum(path.stat().st_size for path in folder.rglob(pattern) if path.is_file()) / 1e6


def table(hours: float, mean: int, seed: int) -> Iterator[Table]:
    """The table of one day."""
    rows: list[list[object]] = []
    traffic = Traffic(mean, seed)
    with tempfile.TemporaryDirectory() as folder:
        keeper, began, spent = Keeper(settings(), Path(folder), replay=traffic), time.perf_counter(), list[float]()
        for k in range(1, int(hours * 3600.0 / TICK_S) + 1):
            elapsed_s = k * TICK_S
            tick_began = time.thread_time()
            situation = keeper.tick(START_S + elapsed_s)
            spent.append(time.thread_time() - tick_began)
            if elapsed_s % REGISTER_S == 0.0:
                keeper.background.register()
            if elapsed_s % SEARCH_S == 0.0:
                keeper.background.search()
            if elapsed_s % 3600.0 == 0.0:
                assert situation is not None
                of_files = [size_mb(Path(folder), f"{kind}*") for kind in ("state", "journal")]
                rows.append([
                    f"{elapsed_s / 3600.0:g}", traffic.ships.arrived, len(traffic.ships.rows), len(situation.objects),
                    len(situation.alarms), status_mb("VmRSS"), *of_files, size_mb(Path(folder), "*.parquet"),
                    1e3 * float(np.median(spent)), 1e3 * float(np.quantile(spent, 0.99)),
                ])  # fmt: skip
                spent.clear()
        failed = keeper.failed_ticks
        keeper.close()
    wall_s = time.perf_counter() - began
    columns = (
        "hour", "ships so far", "present", "objects", "alarms", "resident, MB", "state, MB", "journal, MB",
        "archive, MB", "tick, ms", "p99",
    )  # fmt: skip
    yield Table(
        "A day of the live watch", columns, rows,
        (f"a tick every {TICK_S:g} s, {mean} ships present on average; {failed} failed ticks",
         f"{3600.0 * hours / wall_s:.0f} times real time"),
    )  # fmt: skip


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(prog="scripts/bench day", description=__doc__)
    parser.add_argument("--hours", type=float, default=24.0, help="simulated hours (default 24)")
    parser.add_argument("--ships", type=int, default=60, help="mean number of ships present (default 60)")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    compiled.compile_all()
    gc.freeze()
    gc.set_threshold(100_000, 50, 100)  # as in the command
    report("day", table(options.hours, options.ships, options.seed))


if __name__ == "__main__":
    main()

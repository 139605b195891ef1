"""Time of a tick of the live watch alone, and beside a registration or a search for faults that go on.

``sameas watch`` does both every half minute to minute; with hundreds of tracks each takes seconds. The keeper is that
of ``sameas watch``, with its folder, journal and archive; ships are those of ``scripts/bench day``, reported every
second. Needs two idle cores.
"""

from __future__ import annotations

import argparse
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from benchmarks.day import START_S, Traffic, settings
from benchmarks.tables import Table, report
from sameas.io.processes import Aside
from sameas.kernels import compiled
from sameas.live.keeper import LEAST_ASIDE, Keeper

#: Seconds of warming up, and ticks measured for each line.
WARM_S, TICKS = 120, 60
#: Seconds between ticks while they are measured: much less than in use, so that most meet the work beside them.
PAUSE_S = 0.05


class Ticks:
    """A keeper that is ticked every second of its time."""

    def __init__(self, keeper: Keeper) -> None:
        self.keeper, self.now_s = keeper, START_S

    def timed(self, number: int) -> list[float]:
        """Milliseconds of each of the next ticks."""
        times = []
        for _ in range(number):
            self.now_s += 1.0
            began = time.perf_counter()
            self.keeper.tick(self.now_s)
            times.append(1e3 * (time.perf_counter() - began))
            time.sleep(PAUSE_S)
        return times


def beside(ticks: Ticks, work: Callable[[], None]) -> list[float]:
    """Milliseconds of ticks while a thread does this work again and again."""
    ended = threading.Event()

    def repeat() -> None:
        while not ended.is_set():
            work()

    thread = threading.Thread(target=repeat)
    thread.start()
    try:
        return ticks.timed(TICKS)
    finally:
        ended.set()
        thread.join()


def table(ships: int, seed: int) -> Iterator[Table]:
    """The table, with that work in a thread of the watch, and as ``sameas watch`` does it."""
    rows: list[list[object]] = []
    for where, least in (("in a thread", 10**9), ("as the watch", LEAST_ASIDE)):
        with tempfile.TemporaryDirectory() as folder:
            traffic = Traffic(ships, seed, radar_period_s=1.0, ais_period_s=2.0)
            keeper = Keeper(settings(), Path(folder), replay=traffic)
            keeper.background.aside = Aside(least)
            ticks = Ticks(keeper)
            ticks.timed(WARM_S)
            for work in (keeper.background.register, keeper.background.search):
                began = time.perf_counter()
                work()  # begins the process, where there is one
                work()
                took_s = 0.5 * (time.perf_counter() - began)
                for name, times in (("nothing", ticks.timed(TICKS)), (work.__name__, beside(ticks, work))):
                    rows.append([where, name, took_s, *np.quantile(times, [0.5, 0.9, 0.99])])
            keeper.close()
    yield Table(
        f"Ticks of a watch of {ships} ships, AIS and two radars",
        ("registration and search", "beside", "that takes, s", "tick, ms", "p90", "p99"),
        rows,
        (f"{TICKS} ticks a line; the work is begun again as soon as it ends",),
    )


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(prog="scripts/bench beside", description=__doc__)
    parser.add_argument("--ships", type=int, default=500, help="mean number of ships present (default 500)")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    compiled.compile_all()
    report("beside", table(options.ships, options.seed))


if __name__ == "__main__":
    main()

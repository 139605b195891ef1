"""CPU time of one cycle of the live picture: three sources that report every target every second.

Measured is one thread, second by second after the first ones: ``LivePicture.add`` (positions brought to the plane,
repetitions and jumps excluded, tracks continued) and ``LivePicture.advance`` (the picture of the instant).
"""

from __future__ import annotations

import argparse
import gc
import time
from collections.abc import Iterator

import numpy as np

from benchmarks.instants import CROWDS, MISSES, Case, modelled
from benchmarks.tables import Table, report
from sameas.arrays import FloatArray
from sameas.kernels import compiled
from sameas.picture.live import LivePicture

#: Targets for the p99 of a cycle in milliseconds, by number of targets: sparse, busy, crowded.
TARGET_MS = {500: (40.0, 60.0, 90.0), 1000: (60.0, 100.0, 180.0)}
#: Cycles that are not counted, because kernels are compiled or all tracks are new.
WARMUP_CYCLES = 4


def cycles(targets: int, crowd: float, seed: int, count: int) -> FloatArray:
    """(count, 2) milliseconds of ``add`` and of ``advance`` of each cycle."""
    sources = modelled(Case(3, targets, 0.0), crowd, seed, count + WARMUP_CYCLES + 1.0, period_s=1.0)
    picture = LivePicture([description for description, _ in sources], lag_s=5.0)
    spent = []
    for second in range(1, count + WARMUP_CYCLES + 1):
        received = [
            (description.name, reports.where((reports.time_s > second - 1.0) & (reports.time_s <= second)))
            for description, reports in sources
        ]
        began = time.thread_time()
        for name, reports in received:
            picture.add(name, reports)
        added = time.thread_time()
        picture.advance(float(second))
        spent.append((added - began, time.thread_time() - added))
    return 1e3 * np.array(spent[WARMUP_CYCLES:])


def lines(seeds: int, count: int) -> Iterator[list[object]]:
    """The rows of the table, one per number of targets and crowding."""
    for targets, limits in TARGET_MS.items():
        for crowd, limit in zip(CROWDS, limits, strict=True):
            spent = np.concatenate([cycles(targets, crowd, seed, count) for seed in range(seeds)])
            total = spent.sum(axis=1)
            yield [
                3, targets, crowd, float(np.median(spent[:, 0])), float(np.median(spent[:, 1])),
                float(np.median(total)), float(np.quantile(total, 0.99)), limit,
            ]  # fmt: skip


COLUMNS = ("sources", "targets", "others within σ", "add, ms", "advance, ms", "cycle, ms", "p99", "target")


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="one scene of ten cycles each")
    options = parser.parse_args()
    compiled.compile_all()
    gc.freeze()
    gc.set_threshold(100_000, 50, 100)  # as in the command
    seeds, count = (1, 10) if options.quick else (2, 60)
    notes = (
        f"milliseconds of one thread over {seeds} scene{'s' * (seeds > 1)} of {count} cycles, every target reported by "
        f"every source every second with a miss in {1 / MISSES:g}",
    )
    report("live", [Table("One cycle of the live picture", COLUMNS, list(lines(seeds, count)), notes)])


if __name__ == "__main__":
    main()

"""Delays of time stamps that no description mentions: how many are found, how well, and how many are invented.

Scenes as those of ``hard`` and ``traffic``, in which the last source (or AIS) is late and its description has latency
0. Ships move at 1 to 3 m/s, aircraft at 80 to 140 m/s. A delay counts as found if registration removes one. None of
these scenes was used to choose a number of the library.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from benchmarks.hard import AIRCRAFT, AIS, RADAR, Fleet, Kind, Sensor, simulated
from benchmarks.tables import Table, report
from benchmarks.traffic import ADS_B, AIR_RADAR, FAR, NEAR, Paths, fairway, in_lock, stack


def _of(paths: Callable[[np.random.Generator], Paths]) -> Callable[[Fleet, np.random.Generator], Fleet]:
    """Objects on given paths instead of a fleet."""
    return lambda _, rng: paths(rng)  # type: ignore[return-value]


#: What is late in each kind: the last source, or the first.
LAST, FIRST = -1, 0
WIDE = Sensor("ads-b", "ads-b", sigma_m=40.0, period_s=2.0, share=0.75, motion=AIRCRAFT, speed_error=1.5)
KINDS = (
    (Kind("ships, AIS, trackers of 25 m", FAR), LAST),
    (Kind("ships, trackers of 25 m, AIS late", FAR), FIRST),
    (Kind("ships, AIS, trackers of 8 m", NEAR), LAST),
    (Kind("ships, trackers of 25 m, no AIS", FAR[1:]), LAST),
    (Kind("ships, errors stated half as large", tuple(replace(one, stated=0.5) for one in FAR)), LAST),
    (Kind("ferries across a fairway, trackers of 25 m", FAR, arranged=_of(fairway)), LAST),
    (Kind("ships in a lock, trackers of 8 m", NEAR, arranged=_of(in_lock)), LAST),
    (Kind("ships, AIS, plots of a radar", (AIS, RADAR), n=10, width_m=3000.0), LAST),
    (Kind("ships, AIS, plots 3° off and clutter", (AIS, replace(RADAR, azimuth_deg=3.0, false=10.0)), n=10,
          width_m=3000.0), LAST),
    (Kind("aircraft in a stack, radar", (ADS_B, AIR_RADAR), width_m=10e3, arranged=_of(stack)), LAST),
    (Kind("aircraft, radar", (WIDE, replace(AIR_RADAR, heights=0.0)), width_m=8e3, speed=(80.0, 140.0)), LAST),
    (Kind("aircraft, multilateration", (WIDE, replace(WIDE, name="mlat", kind="mlat", sigma_m=150.0, share=1.0)),
          width_m=30e3, speed=(80.0, 140.0)), LAST),
)  # fmt: skip


def with_delay(kind: Kind, late: int, late_s: float) -> Kind:
    """The kind with one source that is late."""
    sources = list(kind.sources)
    sources[late] = replace(sources[late], late_s=late_s)
    return replace(kind, sources=tuple(sources))


def estimated(kind: Kind, late: int, late_s: float, seed: int) -> list[tuple[float, float, float]]:
    """True delay, estimate and standard error (NaN where none is removed) of every source against the first."""
    _, scene, _ = simulated(with_delay(kind, late, late_s), seed)
    _, biases = scene.registered()
    values = [one.parameters.get("time_s") if one.established else None for one in biases]
    first = 0.0 if values[0] is None else values[0].value
    truth = np.zeros(len(biases))
    truth[late] = late_s
    known = values[0] is not None
    out = []
    for estimate, true in zip(values[1:], truth[1:], strict=True):
        error = np.nan if estimate is None else estimate.standard_error
        error = values[0].standard_error if estimate is None and known and values[0] is not None else error
        out.append((true - truth[0], (0.0 if estimate is None else estimate.value) - first, error))
    return out


def lines(scenes: int, first: int, delays_s: list[float]) -> Iterator[list[object]]:
    """A row for each kind and delay."""
    for number, (kind, late) in enumerate(KINDS):
        for late_s in delays_s:
            began = time.process_time()
            parts = [estimated(kind, late, late_s, 7_000_000 + 1000 * number + first + k) for k in range(scenes)]
            spent = (time.process_time() - began) / scenes
            true, value, error = np.array([one for part in parts for one in part]).T
            established, delayed = np.isfinite(error), true != 0.0
            removed = established & delayed
            difference = (value - true)[removed]
            z = difference / error[removed]
            yield [kind.words, late_s, scenes, int(delayed.sum()) or None,
                   int(removed.sum()) if delayed.any() else None, int((established & ~delayed).sum()),
                   float(np.sqrt(np.mean(difference**2))) if len(difference) else None,
                   float(np.sqrt(np.mean(z**2))) if len(difference) else None, spent]  # fmt: skip


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(prog="scripts/bench delays", description=__doc__)
    parser.add_argument("--scenes", type=int, default=20, help="scenes of each kind and delay (default 20)")
    parser.add_argument("--first", type=int, default=0, help="number of the first scene (default 0)")
    parser.add_argument("--delays", type=float, nargs="+", default=[0.0, 1.0, 2.0, 5.0], help="delays, seconds")
    options = parser.parse_args()
    columns = (
        "scene",
        "late s",
        "scenes",
        "late sources",
        "found",
        "false",
        "rms error s",
        "rms error / s.e.",
        "CPU s",
    )
    rows = list(lines(options.scenes, options.first, options.delays))
    report("delays", [Table("Delays that no description mentions", columns, rows)])


if __name__ == "__main__":
    main()

"""CPU time of one instant of a picture: two or three sources that track many targets, sparse and crowded.

Measured is one thread, instant by instant after the first: aligning the sources (``Scene.at``), identifying their
records and updating the tracks (``Watch.advance``), the columns of the two tables. For comparison ``identify_many``
alone, without memory and without identities.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from typing import TypeVar

import numpy as np

from benchmarks.tables import Table, report
from sameas.arrays import FloatArray
from sameas.kernels import compiled
from sameas.many.identify import identify_many
from sameas.picture.picture import object_columns, record_columns
from sameas.picture.picture_state import PictureState
from sameas.picture.rows import Columns
from sameas.picture.watch import Watch
from sameas.tracks.reports import Reports
from sameas.tracks.scene import Instant, Scene
from sameas.tracks.source import Description, MissRate, Motion, SensorErrors, Timing

SIGMA_M, SPEED_M_PER_S, MISSES, PERIOD_S, EVERY_S = 25.0, 5.0, 0.1, 3.0, 10.0
#: Standard deviation of the difference of two records.
PAIR_M = math.sqrt(2.0) * SIGMA_M
#: Mean number of other targets within one standard deviation of a pair: sparse, busy, crowded.
CROWDS = (0.01, 0.03, 0.1)
Result = TypeVar("Result")


@dataclass(frozen=True)
class Case:
    """Numbers of sources and targets, and the targeted time of one instant."""

    sources: int
    targets: int
    target_ms: float


CASES = (Case(3, 500, 100.0), Case(2, 5000, 300.0))


@dataclass(frozen=True)
class Stopwatch:
    """CPU milliseconds of this thread by stage, one value per instant."""

    spent_ms: dict[str, list[float]] = field(default_factory=dict)

    def of(self, stage: str, work: Callable[[], Result]) -> Result:
        """The result of ``work``, whose time is recorded under ``stage``."""
        began = time.thread_time()
        result = work()
        self.spent_ms.setdefault(stage, []).append(1e3 * (time.thread_time() - began))
        return result

    def total_ms(self, stages: tuple[str, ...]) -> np.ndarray:
        """(k,) per instant after the first, which compiles and fills caches."""
        return np.sum([self.spent_ms[stage] for stage in stages], axis=0)[1:]


def scene(case: Case, crowd: float, seed: int, span_s: float) -> Scene:
    """The scene of :func:`modelled`."""
    return Scene.of(modelled(case, crowd, seed, span_s))


def modelled(
    case: Case, crowd: float, seed: int, span_s: float, period_s: float = PERIOD_S
) -> list[tuple[Description, Reports]]:
    """Reports of sources with track ids, of targets on straight courses over a square."""
    rng = np.random.default_rng(seed)
    width_m = math.sqrt(case.targets * math.pi * PAIR_M**2 / crowd)
    start = rng.uniform(0.0, width_m, (case.targets, 2))
    velocity = SPEED_M_PER_S * rng.standard_normal((case.targets, 2))
    sources = []
    for number in range(case.sources):
        scan_s = np.arange(rng.uniform(-period_s, 0.0), span_s, period_s)
        target, scan = np.nonzero(rng.random((case.targets, len(scan_s))) >= MISSES)
        position = start[target] + scan_s[scan, None] * velocity[target]
        position = position + SIGMA_M * rng.standard_normal((len(target), 2))
        reported = velocity[target] + 0.3 * rng.standard_normal((len(target), 2))
        columns = {
            "time_s": scan_s[scan], "x_m": position[:, 0], "y_m": position[:, 1], "vx_m_per_s": reported[:, 0],
            "vy_m_per_s": reported[:, 1], "track_id": np.array([f"{k}" for k in target], object),
        }  # fmt: skip
        description = Description(
            f"source {number}", "tracks", errors=SensorErrors(position_m=SIGMA_M, speed_m_per_s=0.3, course_deg=3.0),
            misses=MissRate(MISSES), motion=Motion(0.01, SPEED_M_PER_S), timing=Timing(period_s, 0.0, 0.0),
        )  # fmt: skip
        sources.append((description, Reports.of(description.name, "table", columns)))
    return sources


STAGES = ("scene", "picture", "columns")


def timed(case: Case, crowd: float, seed: int, instants: int) -> Stopwatch:
    """Times of the stages of a picture, and of each instant identified alone."""
    of_case, watch, clock = scene(case, crowd, seed, EVERY_S * (instants + 1)), Watch(), Stopwatch()

    for k in range(instants):
        now = clock.of("scene", partial(of_case.at, EVERY_S * (k + 1)))
        state = clock.of("picture", partial(watch.advance, now))
        clock.of("columns", partial(tables_of, state))
        clock.of("alone", partial(alone, now))
        watch = state.watch
    return clock


def tables_of(state: PictureState) -> tuple[Columns, Columns]:
    """The rows of both tables."""
    return object_columns(state), record_columns(state)


def alone(now: Instant) -> FloatArray:
    """Probabilities of the objects of one instant, from positions only."""
    return identify_many(now.sources, rule=now.rule(), region=now.region).probability


def lines(case: Case, seeds: int, instants: int) -> Iterator[list[object]]:
    """The rows of one case, one per crowding."""
    for crowd in CROWDS:
        clocks = [timed(case, crowd, seed, instants) for seed in range(seeds)]
        total = np.concatenate([clock.total_ms(STAGES) for clock in clocks])
        parts = [np.median(np.concatenate([clock.total_ms((stage,)) for clock in clocks])) for stage in STAGES]
        alone = np.concatenate([clock.total_ms(("alone",)) for clock in clocks])
        yield [
            case.sources, case.targets, crowd, *map(float, parts), float(np.median(total)), float(total.max()),
            float(np.median(alone)), float(alone.max()), case.target_ms,
        ]  # fmt: skip


COLUMNS = (
    "sources", "targets", "others within σ", "scene, ms", "picture, ms", "columns, ms", "all, ms", "slowest",
    "identify_many alone, ms", "slowest", "target",
)  # fmt: skip


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="one scene of four instants each")
    options = parser.parse_args()
    compiled.compile_all()
    seeds, instants = (1, 4) if options.quick else (4, 8)
    rows = [line for case in CASES for line in lines(case, seeds, instants)]
    notes = (
        f"milliseconds of one thread, medians over {seeds} scene{'s' * (seeds > 1)} of {instants - 1} instants after "
        "the first, modelled tracks",
        f"σ of a record {SIGMA_M:g} m; others within σ: of the difference of two records",
    )
    report("instants", [Table("One instant", COLUMNS, rows, notes)])


if __name__ == "__main__":
    main()

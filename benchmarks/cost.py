"""CPU time of one thread of a match with everything estimated, relative to one match with given parameters."""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from benchmarks import workload
from benchmarks.frames import one_band
from benchmarks.recovered import true_rule
from benchmarks.registration import drawn, put
from benchmarks.tables import Table, report
from sameas import Errors, Identification, Records, identify
from sameas.estimate.match import Estimate, match
from sameas.evidence import Magnitudes, Rule
from sameas.kernels import compiled
from sameas.registration import Shift, register
from sameas.simulate.exposures import Sky, exposure

ASKED = 5.0
#: Calls of one line are begun for no longer than this.
LONGEST_S = 8.0
#: Registration is tried at this density of targets, per σ², with these shifts, σ.
DENSITY, SHIFTS_SIGMAS = 0.01, (0.0, 4.0, 30.0)

Brightness = tuple[Magnitudes, Magnitudes]


@dataclass(frozen=True)
class Task:
    """Two sources, the rule with the parameters that made them, and magnitudes in two bands where they have any."""

    name: str
    first: Records
    second: Records
    rule: Rule
    brightness: Brightness | None = None


def tasks(options: argparse.Namespace) -> Iterator[Task]:
    """What the cost is measured on."""
    skies = [(f"crowded frame of {side:g}°", Sky(), side) for side in options.sides]
    skies += [(f"sparse frame of {side:g}°", Sky(stars_per_deg2=5000.0), side) for side in (0.4, 1.0)]
    for name, sky, side in skies:
        made = exposure(np.random.default_rng(83), sky, side_deg=side)
        yield Task(name, made.scene.first, made.scene.second, true_rule(made), made.brightness)
    scene, densities = workload.frame(13)
    yield Task("frame, wide range of errors", scene.first, scene.second, densities.rule())
    for lam in options.lambdas:
        scene, densities = workload.crowded(83, options.rows, lam, True)
        yield Task(f"catalogues, λ {lam:g}", scene.first, scene.second, densities.rule())


def seconds(runs: Sequence[Callable[[], Any]], times: int) -> list[float]:
    """CPU of this thread that the cheapest of some calls of each takes, after one to warm up.

    They take turns, so that all meet the same machine; slow ones get fewer turns.
    """
    for run in runs:
        run()
    taken: list[list[float]] = [[] for _ in runs]
    end = time.monotonic() + LONGEST_S
    while len(taken[0]) < 3 or (len(taken[0]) < times and time.monotonic() < end):
        for run, these in zip(runs, taken, strict=True):
            begin = time.thread_time()
            run()
            these.append(time.thread_time() - begin)
    return [min(these) for these in taken]


def rule_of(task: Task, estimate: Estimate) -> Rule:
    """The rule of a task, with what magnitudes and the sizes of the errors say as it was learned."""
    shares = np.full(len(task.first), estimate.share_1), np.full(len(task.second), estimate.share_2)
    brightness = estimate.photometry.rule(shares) if estimate.photometry is not None else None
    rule = task.rule if brightness is None else task.rule + replace(brightness, comparisons=None)
    return rule if estimate.precision is None else rule + estimate.precision


def every_quantity(task: Task, brightness: Brightness | None) -> object:
    """Compute everything that an estimate computes on demand."""
    _, estimate = match(task.first, task.second, brightness=brightness)
    return estimate.quantities, estimate.error_model, estimate.detection_1, estimate.detection_2


def measured(task: Task, times: int) -> Iterator[list[object]]:
    """A line for positions alone, and for one and two bands."""
    kinds: dict[str, Brightness | None] = {"positions": None}
    if task.brightness is not None:
        kinds |= {"one band": one_band(task.brightness), "two bands": task.brightness}
    for kind, brightness in kinds.items():
        _, estimate = match(task.first, task.second, brightness=brightness)
        rule = rule_of(task, estimate)
        runs = (
            lambda rule=rule: identify(task.first, task.second, rule=rule),
            lambda: identify(task.first, task.second, rule=task.rule),
            lambda b=brightness: match(task.first, task.second, brightness=b),
        )
        given, plain, all_of_it = seconds(runs, times)
        (asked_all,) = seconds([lambda b=brightness: every_quantity(task, b)], 1)  # type: ignore[misc]
        ratio = all_of_it / given
        yield [
            task.name, len(task.first), len(task.second), kind, 1e3 * plain, 1e3 * given, 1e3 * all_of_it,
            estimate.iterations, ratio, all_of_it / plain, "yes" if ratio <= ASKED else "no", 1e3 * asked_all,
        ]  # fmt: skip


def estimation(options: argparse.Namespace) -> Table:
    """Estimation of densities, errors and magnitudes."""
    lines = [line for task in tasks(options) for line in measured(task, options.times)]
    columns = (
        "scene", "rows 1", "rows 2", "evidence", "positions given, ms", "all given, ms", "all estimated, ms",
        "iterations", "ratio", "× positions given", f"at most {ASKED:g}", "and every standard error, ms",
    )  # fmt: skip
    notes = (
        "ratio: all estimated over one identification with the same evidence, its parameters given",
        "× positions given: over one identification by positions alone, whatever the evidence that is estimated",
        "and every standard error: with everything that is computed on demand, error model and completeness too",
    )
    return Table("Cost of estimation, CPU of one thread", columns, lines, notes)


def registration(options: argparse.Namespace) -> Table:
    """The search for a shift, against the same identification at every shift that there could be."""
    lines = []
    for n in options.targets:
        made = drawn(7, 0.1, DENSITY, n)
        for shift in SHIFTS_SIGMAS:
            moved = put(made.second, made.second.features - [shift, 0.0])
            runs = (
                lambda m=made: _matched(m.first, m.second),
                lambda m=made, s=moved: register(m.first, s, Shift()),
            )
            once, found = seconds(runs, options.times)
            span = np.ptp(made.first.features, axis=0) + np.ptp(moved.features, axis=0)
            within = "yes" if found / once <= ASKED else "no"
            lines.append([n, shift, 1e3 * once, 1e3 * found, found / once, within, float(np.prod(span))])
    columns = (
        "targets", "shift σ", "match without offset, ms", "register, ms", "ratio", f"at most {ASKED:g}", "shifts, σ²",
    )  # fmt: skip
    notes = ("'shifts' are those, 1σ apart, that bring any two records together: the search looks at them all",)
    return Table("Cost of registration", columns, lines, notes)


def _matched(first: Records, second: Records) -> Identification:
    return match(first, second, errors=Errors())[0]


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(prog="scripts/bench cost", description=__doc__)
    parser.add_argument("--sides", type=float, nargs="+", default=[0.1, 0.2, 0.6], help="of crowded frames, degrees")
    parser.add_argument("--rows", type=int, default=20_000, help="of the catalogues (default 20000)")
    parser.add_argument("--lambdas", type=float, nargs="+", default=[0.05, 0.5, 2.0])
    parser.add_argument("--targets", type=int, nargs="+", default=[40, 400, 4000], help="of registration")
    parser.add_argument("--times", type=int, default=60, help="runs of each at most; the cheapest counts (default 60)")
    options = parser.parse_args()
    # Loops on other threads would not be counted.
    os.environ["SAMEAS_THREADS"] = "1"
    compiled.compile_all()
    report("cost", (make(options) for make in (estimation, registration)))


if __name__ == "__main__":
    main()

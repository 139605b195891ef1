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
from benchmarks.exposures import Sky, exposure
from benchmarks.frames import one_band
from benchmarks.recovered import true_rule
from benchmarks.registration import draw_scene, with_positions
from benchmarks.tables import Table, report
from sameas import Errors, Identification, Records, identify
from sameas.estimate.match import match
from sameas.estimate.result import Estimate
from sameas.evidence import Magnitudes, Rule
from sameas.kernels import compiled
from sameas.registration import Shift, register

#: Target: largest ratio of the times.
MAX_RATIO = 5.0
#: Time after which no further call of a line starts.
MAX_S = 8.0
#: Density of targets per σ², and shifts in σ, of the scenes of registration.
DENSITY, SHIFTS_SIGMAS = 0.01, (0.0, 4.0, 30.0)

Brightness = tuple[Magnitudes, Magnitudes]


@dataclass(frozen=True)
class Task:
    """Two sources, the rule with the true parameters, and magnitudes in two bands if they have any."""

    name: str
    first: Records
    second: Records
    rule: Rule
    brightness: Brightness | None = None


def tasks(options: argparse.Namespace) -> Iterator[Task]:
    """The scenes on which the cost is measured."""
    skies = [(f"crowded frame of {side:g}°", Sky(), side) for side in options.sides]
    skies += [(f"sparse frame of {side:g}°", Sky(stars_per_deg2=5000.0), side) for side in (0.4, 1.0)]
    for name, sky, side in skies:
        simulated = exposure(np.random.default_rng(83), sky, side_deg=side)
        scene = simulated.scene
        yield Task(name, scene.first, scene.second, true_rule(simulated), simulated.brightness)
    scene, densities = workload.frame(13)
    yield Task("frame, wide range of errors", scene.first, scene.second, densities.rule())
    for lam in options.lambdas:
        scene, densities = workload.crowded(83, options.rows, lam, True)
        yield Task(f"catalogues, λ {lam:g}", scene.first, scene.second, densities.rule())


def seconds(runs: Sequence[Callable[[], Any]], times: int) -> list[float]:
    """CPU seconds of this thread of the cheapest call of each function, after one call to warm up.

    The functions are called in turns, so that the load of the machine is the same for all; slow ones are called less
    often.
    """
    for run in runs:
        run()
    spent: list[list[float]] = [[] for _ in runs]
    end = time.monotonic() + MAX_S
    while len(spent[0]) < 3 or (len(spent[0]) < times and time.monotonic() < end):
        for run, own in zip(runs, spent, strict=True):
            begin = time.thread_time()
            run()
            own.append(time.thread_time() - begin)
    return [min(own) for own in spent]


def rule_of(task: Task, estimate: Estimate) -> Rule:
    """The rule of a task, with the estimated evidence of magnitudes and of the sizes of the errors."""
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
        given, plain, estimated = seconds(runs, times)
        (with_errors,) = seconds([lambda b=brightness: every_quantity(task, b)], 1)  # type: ignore[misc]
        ratio = estimated / given
        yield [
            task.name, len(task.first), len(task.second), kind, 1e3 * plain, 1e3 * given, 1e3 * estimated,
            estimate.iterations, ratio, estimated / plain, "yes" if ratio <= MAX_RATIO else "no", 1e3 * with_errors,
        ]  # fmt: skip


def estimation(options: argparse.Namespace) -> Table:
    """Estimation of densities, errors and magnitudes."""
    lines = [line for task in tasks(options) for line in measured(task, options.times)]
    columns = (
        "scene", "rows 1", "rows 2", "evidence", "positions given, ms", "all given, ms", "all estimated, ms",
        "iterations", "ratio", "× positions given", f"at most {MAX_RATIO:g}", "and every standard error, ms",
    )  # fmt: skip
    notes = (
        "ratio: all estimated over one identification with the same evidence, its parameters given",
        "× positions given: over one identification by positions alone, whatever the evidence that is estimated",
        "and every standard error: with everything that is computed on demand, error model and completeness too",
    )
    return Table("Cost of estimation, CPU of one thread", columns, lines, notes)


def registration(options: argparse.Namespace) -> Table:
    """Cost of the search for a shift, relative to one match without an offset."""
    lines = []
    for n in options.targets:
        scene = draw_scene(7, 0.1, DENSITY, n)
        for shift in SHIFTS_SIGMAS:
            moved = with_positions(scene.second, scene.second.features - [shift, 0.0])
            runs = (lambda m=scene: _matched(m.first, m.second), lambda m=scene, s=moved: register(m.first, s, Shift()))
            once, search = seconds(runs, options.times)
            span = np.ptp(scene.first.features, axis=0) + np.ptp(moved.features, axis=0)
            within = "yes" if search / once <= MAX_RATIO else "no"
            lines.append([n, shift, 1e3 * once, 1e3 * search, search / once, within, float(np.prod(span))])
    columns = (
        "targets", "shift σ", "match without offset, ms", "register, ms", "ratio", f"at most {MAX_RATIO:g}", "shifts",
    )  # fmt: skip
    notes = ("shifts: number of shifts, 1σ apart, that bring any two records together; the search covers all of them",)
    return Table("Cost of registration", columns, lines, notes)


def _matched(first: Records, second: Records) -> Identification:
    return match(first, second, errors=Errors())[0]


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(prog="scripts/bench cost", description=__doc__)
    parser.add_argument("--sides", type=float, nargs="+", default=[0.1, 0.2, 0.6], help="sides of frames, degrees")
    parser.add_argument("--rows", type=int, default=20_000, help="rows of the catalogues (default 20000)")
    parser.add_argument("--lambdas", type=float, nargs="+", default=[0.05, 0.5, 2.0])
    parser.add_argument("--targets", type=int, nargs="+", default=[40, 400, 4000], help="targets, for registration")
    parser.add_argument("--times", type=int, default=60, help="most runs of each; the cheapest counts (default 60)")
    options = parser.parse_args()
    # Loops on other threads would not be counted.
    os.environ["SAMEAS_THREADS"] = "1"
    compiled.compile_all()
    report("cost", (make(options) for make in (estimation, registration)))


if __name__ == "__main__":
    main()

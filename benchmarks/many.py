"""Objects of 4 to 20 sources, right ones and their probabilities, beside a sequence and friends of friends.

Objects in a square, each missed by a source with a probability, errors of one size, known densities. An object is right
if it has all records of one true object and no other. ``scripts/bench many``, 6 minutes.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from benchmarks.tables import Table, report
from sameas.many.identify import identify_many, identify_sequentially
from sameas.many.objects import Objects
from sameas.many.rules import PoissonObjects
from sameas.records import Records

#: Neighbours are linked within this many σ of one record: 99 % of an object's differences are shorter.
LINK_SIGMA = 4.3
COLUMNS = ("sources", "misses, %", "λ", "objects", "records", "right, %", "stated, %", "in sequence", "stated",
           "linked", "CPU s", "in sequence")  # fmt: skip


class Scene(NamedTuple):
    """sources : their records. objects : (n,) of each, the true object of every record. sigma : of an axis."""

    sources: list[Records]
    objects: list[np.ndarray]
    sigma: float


class Score(NamedTuple):
    """Objects that are right, the sum of their probabilities, how many were found, and the CPU time."""

    right: int
    stated: float
    found: int
    cpu_s: float


def scene(rng: np.random.Generator, n_sources: int, n: int, close: float, missed: float) -> Scene:
    """n objects in a unit square; ``close`` others are within 1σ of the difference of two records (λ)."""
    sigma = float(np.sqrt(close / (2.0 * np.pi * n)))
    places, sources, objects = rng.random((n, 2)), [], []
    for s in range(n_sources):
        seen = rng.permutation(np.flatnonzero(rng.random(n) > missed))
        objects.append(seen)
        measured = places[seen] + sigma * rng.standard_normal((len(seen), 2))
        sources.append(Records.of(measured, sigma=sigma, source=f"source {s}"))
    return Scene(sources, objects, sigma)


def identified(scene: Scene, rule: PoissonObjects, identify: Callable[..., Objects]) -> Score:
    """The score of :func:`identify_many` or :func:`identify_sequentially`."""
    start = time.process_time()
    found = identify(scene.sources, rule=rule)
    cpu_s = time.process_time() - start
    members = np.ma.filled(found.members, -1)
    return Score(right_objects(scene, members), float(found.probability.sum()), len(members), cpu_s)


def linked(scene: Scene) -> Score:
    """The score of friends of friends: records that are linked by neighbours, whatever their sources."""
    start = time.process_time()
    places = np.concatenate([source.features for source in scene.sources])
    pairs = cKDTree(places).query_pairs(LINK_SIGMA * scene.sigma, output_type="ndarray")
    links = coo_array((np.ones(len(pairs)), pairs.T), shape=(len(places), len(places)))
    number, label = connected_components(links, directed=False)
    objects = np.concatenate(scene.objects)
    total, right = np.bincount(objects), 0
    for k in range(number):
        own = objects[label == k]
        right += bool((own == own[0]).all() and len(own) == total[own[0]])
    return Score(right, float("nan"), number, time.process_time() - start)


def right_objects(scene: Scene, members: np.ndarray) -> int:
    """How many found objects, (k, S) rows or −1, have all records of one object and no other."""
    total, right = np.bincount(np.concatenate(scene.objects)), 0
    for rows in members:
        own = [int(scene.objects[s][row]) for s, row in enumerate(rows) if row >= 0]
        right += len(set(own)) == 1 and len(own) == total[own[0]]
    return right


def row(n_sources: int, n: int, close: float, missed: float, seeds: Sequence[int]) -> list[object]:
    """A row of the table, of the sums over some scenes."""
    scores: list[tuple[Score, ...]] = []
    true, records = 0, 0
    for seed in seeds:
        one = scene(np.random.default_rng((seed, n_sources, n)), n_sources, n, close, missed)
        rule = PoissonObjects(float(n), missed)
        scores.append((identified(one, rule, identify_many), identified(one, rule, identify_sequentially), linked(one)))
        true += len(np.unique(np.concatenate(one.objects)))
        records += sum(map(len, one.sources))
    joint, sequence, friends = (Score(*map(sum, zip(*each, strict=True))) for each in zip(*scores, strict=True))
    per_cent = [100.0 * value / true for value in (joint.right, joint.stated, sequence.right, sequence.stated)]
    return [
        n_sources, f"{100 * missed:.0f}", close, true, records, *(f"{value:.1f}" for value in per_cent),
        f"{100.0 * friends.right / true:.1f}", f"{joint.cpu_s:.1f}", f"{sequence.cpu_s:.1f}",
    ]  # fmt: skip


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(prog="scripts/bench many", description=__doc__)
    parser.add_argument("--sources", type=int, nargs="+", default=[4, 8, 12, 20])
    parser.add_argument("--lambdas", type=float, nargs="+", default=[0.01, 0.05, 0.2], help="others within 1σ")
    parser.add_argument("--misses", type=float, nargs="+", default=[0.2, 0.7], help="probabilities of a miss")
    parser.add_argument("--objects", type=int, default=100)
    parser.add_argument("--scenes", type=int, default=4)
    options = parser.parse_args()
    rows = [
        row(n_sources, options.objects, close, missed, range(options.scenes))
        for missed in options.misses
        for n_sources in options.sources
        for close in options.lambdas
    ]
    notes = (
        "right: all records of one object and no other, of the true objects; stated: the sum of the probabilities",
        f"in sequence: identify_sequentially; linked: friends of friends within {LINK_SIGMA} σ",
    )
    report("many", [Table("Objects of many sources", COLUMNS, rows, notes)])


if __name__ == "__main__":
    main()

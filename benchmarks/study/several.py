"""Several sources: the joint result compared with the papers' method, source after source in every order (METHOD 7).

Every rule is given the density of the targets and q. ``enumerated`` is the reference for three sources: it compares
every hypothesis of the first two, each with the best assignment of the third.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.study.scenes import Formation, Scenes
from benchmarks.study.tally import Ratio, distances
from benchmarks.study.trial import generator
from sameas.arrays import FloatArray, IntArray
from sameas.many.identify import identify_many, identify_sequentially
from sameas.many.objects import Objects
from sameas.many.rules import PoissonObjects
from sameas.records import Records

#: Scenes that are identified in one call; maximum number of orders of the sources that are tried.
TOGETHER, ORDERS = 50, 6
#: One block in four repeats the joint result in these orders, and enumerates every partition.
ONCE_IN = 4
COLUMNS = ("joint whole", "sequential whole", "order matters", "joint order", "gap", "joint gospa",
           "sequential gospa", "oracle whole", "oracle differs")  # fmt: skip


@dataclass(frozen=True)
class Several:
    """A formation of several sources. oracle : whether every partition is enumerated too (three sources only)."""

    name: str
    formation: Formation
    scenes: int
    oracle: bool = False


@dataclass(frozen=True)
class Counts:
    """Per scene (n, c) the values of COLUMNS, and the seconds of the joint and of one sequential result."""

    per_scene: FloatArray
    joint_s: float
    sequential_s: float

    def __add__(self, other: Counts) -> Counts:
        return Counts(np.concatenate([self.per_scene, other.per_scene]), self.joint_s + other.joint_s,
                      self.sequential_s + other.sequential_s)  # fmt: skip

    def mean(self, column: str) -> Ratio:
        """Mean over the scenes and its standard error; NaN if it was not computed."""
        values = self.per_scene[:, COLUMNS.index(column)]
        values = values[np.isfinite(values)]
        if len(values) < 2:
            return Ratio(math.nan, math.nan)
        return Ratio(float(values.mean()), float(values.std(ddof=1) / math.sqrt(len(values))))


def counts(several: Several, block: int) -> Counts:
    """The counts of one block of :data:`TOGETHER` scenes."""
    formation = several.formation
    scenes = formation(generator(several.name, block), TOGETHER)
    orders = _orders(len(scenes.sources))
    start = time.perf_counter()
    joint = _in_order(identify_many, scenes, formation, orders[0])
    joint_s = time.perf_counter() - start
    start = time.perf_counter()
    sequential = [_in_order(identify_sequentially, scenes, formation, orders[0])]
    sequential_s = time.perf_counter() - start
    sequential += [_in_order(identify_sequentially, scenes, formation, order) for order in orders[1:]]
    unknown = np.full(TOGETHER, np.nan)
    column = {
        "joint whole": wholly_right(scenes, joint.members),
        "sequential whole": np.mean([wholly_right(scenes, answer.members) for answer in sequential], axis=0),
        "order matters": np.any([differs(scenes, sequential[0].members, x.members) for x in sequential[1:]], axis=0),
        "joint order": unknown, "oracle whole": unknown, "oracle differs": unknown,
        "gap": _gaps(scenes, joint.objects),
        "joint gospa": _gospa(scenes, joint), "sequential gospa": _gospa(scenes, sequential[0]),
    }  # fmt: skip
    if block % ONCE_IN == 0:
        others = [_in_order(identify_many, scenes, formation, order) for order in orders[1:]]
        column["joint order"] = np.any([differs(scenes, joint.members, x.members) for x in others], axis=0)
    if several.oracle and block % ONCE_IN == 0:
        best = enumerated(scenes, formation)
        column["oracle whole"] = wholly_right(scenes, best)
        column["oracle differs"] = differs(scenes, best, joint.members)
    return Counts(np.stack([np.asarray(column[name], float) for name in COLUMNS], axis=1), joint_s, sequential_s)


@dataclass(frozen=True)
class _Answer:
    """``members`` (n, S), −1 for none, in the order of the scenes' sources."""

    members: IntArray
    objects: Objects


def _orders(n: int) -> list[tuple[int, ...]]:
    """All orders of three sources or fewer; of more sources the given order, its reverse and some between."""
    orders = list(itertools.islice(itertools.permutations(range(n)), 5040))
    if len(orders) <= ORDERS:
        return orders
    return [orders[k] for k in np.linspace(0, len(orders) - 1, ORDERS).astype(int)]


def _in_order(identify, scenes: Scenes, formation: Formation, order: Sequence[int]) -> _Answer:
    q = [formation.q[s] for s in order]
    objects = identify([scenes.sources[s] for s in order], rule=PoissonObjects(formation.density, q))
    members = np.empty((len(objects), len(order)), np.int64)
    members[:, list(order)] = objects.members.filled(-1)
    return _Answer(members, objects)


def _targets(scenes: Scenes, members: IntArray) -> tuple[IntArray, IntArray]:
    """(n, S) the target of every member, −1 for none, and (n,) the largest of each object."""
    targets = np.full(members.shape, -1)
    for s, truth in enumerate(scenes.truth):
        present = members[:, s] >= 0
        targets[present, s] = truth[members[present, s]]
    return targets, targets.max(axis=1, initial=-1)


def wholly_right(scenes: Scenes, members: IntArray) -> np.ndarray:
    """(count,) whether every object of a scene is all records of one target."""
    targets, one = _targets(scenes, members)
    seen = np.zeros(len(scenes.targets), np.int64)
    for truth in scenes.truth:
        seen[truth] += 1
    pure = np.all((targets == one[:, None]) | (targets < 0), axis=1)
    whole = pure & ((targets >= 0).sum(axis=1) == seen[one])
    right = np.ones(len(scenes), bool)
    right[scenes.target_scene[one[~whole]]] = False
    return right


def differs(scenes: Scenes, members: IntArray, other: IntArray) -> np.ndarray:
    """(count,) whether two partitions of a scene's records are not the same."""
    labels = [_labels(scenes, m) for m in (members, other)]
    different = np.zeros(len(scenes), bool)
    for scene, one, two in zip(scenes.scene, *labels, strict=True):
        different[scene[one != two]] = True
    return different


def _labels(scenes: Scenes, members: IntArray) -> list[IntArray]:
    """Per source (n,) a label of each record's object: the smallest number of its records."""
    start = np.cumsum([0, *map(len, scenes.sources)])
    numbers = np.where(members >= 0, members + start[:-1], start[-1])
    least = numbers.min(axis=1, initial=start[-1])
    labels = [np.full(len(source), -1) for source in scenes.sources]
    for s, label in enumerate(labels):
        present = members[:, s] >= 0
        label[members[present, s]] = least[present]
    return labels


def _scene_of(scenes: Scenes, members: IntArray) -> IntArray:
    """(n,) the scene of each object."""
    return scenes.target_scene[_targets(scenes, members)[1]]


def _gospa(scenes: Scenes, answer: _Answer) -> FloatArray:
    return distances(scenes, (answer.objects.fused.state, _scene_of(scenes, answer.members)))


def _gaps(scenes: Scenes, objects: Objects) -> np.ndarray:
    """(count,) whether the result of a scene is not proved optimal."""
    open_groups = np.flatnonzero(objects.groups.gap > 0)
    unproved = np.zeros(len(scenes), bool)
    records = objects.members.filled(-1)
    unproved[_scene_of(scenes, records)[np.isin(objects.group, open_groups)]] = True
    return unproved


# ---- enumeration ----


def enumerated(scenes: Scenes, formation: Formation) -> IntArray:
    """(n, 3) the most probable partition of every scene, from every hypothesis of the first two sources."""
    partition = []
    for scene in range(len(scenes)):
        rows, records = scenes.one(scene)
        for members in _best_of_three(records, formation):
            partition.append([rows[s][k] if k >= 0 else -1 for s, k in enumerate(members)])
    return np.array(partition, np.int64).reshape(-1, 3)


def _best_of_three(records: tuple[Records, ...], formation: Formation) -> list[tuple[int, int, int]]:
    """Members of the best partition; a set of k records has the log ratio ln J − (k − 1) ln(ρ ∏ q) to k objects."""
    from scipy.optimize import linear_sum_assignment

    n1, n2, n3 = map(len, records)
    price = math.log(formation.density * math.prod(formation.q))
    pair = [_log_joint([records[a], records[b]]) - price for a, b in ((0, 1), (0, 2), (1, 2))]
    triple = _log_joint(list(records)) - 2.0 * price
    best, winner = -math.inf, []
    for matched in _matchings(n1, n2):
        one, two = set(range(n1)) - {i for i, _ in matched}, set(range(n2)) - {j for _, j in matched}
        objects = [*matched, *((i, -1) for i in one), *((-1, j) for j in two)]
        total = sum(pair[0][i, j] for i, j in matched)
        gain = np.zeros((len(objects), n3))
        for k, (i, j) in enumerate(objects):
            gain[k] = triple[i, j] - pair[0][i, j] if i >= 0 and j >= 0 else pair[1][i] if i >= 0 else pair[2][j]
        gain = np.maximum(gain, 0.0)
        k, third = linear_sum_assignment(gain, maximize=True)
        total += gain[k, third].sum()
        if total > best:
            taken = {int(a): int(b) for a, b in zip(k, third, strict=True) if gain[a, b] > 0.0}
            alone = set(range(n3)) - set(taken.values())
            best = total
            winner = [(i, j, taken.get(a, -1)) for a, (i, j) in enumerate(objects)] + [(-1, -1, c) for c in alone]
    return winner


def _matchings(n1: int, n2: int) -> list[tuple[tuple[int, int], ...]]:
    """Every one-to-one set of pairs of n1 and n2 records."""
    return [
        tuple(zip(rows, columns, strict=True))
        for k in range(min(n1, n2) + 1)
        for rows in itertools.combinations(range(n1), k)
        for columns in itertools.permutations(range(n2), k)
    ]


def _log_joint(records: list[Records]) -> FloatArray:
    """ln ∫ ∏ N(x_s; M, σ_s²) dM for every choice of one record of each source, one axis a source."""
    d, k = records[0].d, len(records)
    weight = [1.0 / r.covariance[0, 0] if len(r) else 1.0 for r in records]
    places = np.meshgrid(*(np.arange(len(r)) for r in records), indexing="ij")
    x = np.stack([r.features[at] for r, at in zip(records, places, strict=True)])
    w = np.array(weight).reshape((k,) + (1,) * k)
    middle = (w[..., None] * x).sum(axis=0) / sum(weight)
    spread = (w * ((x - middle) ** 2).sum(axis=-1)).sum(axis=0)
    constant = sum(map(math.log, weight)) - math.log(sum(weight)) - (k - 1) * math.log(2.0 * math.pi)
    return 0.5 * d * constant - 0.5 * spread

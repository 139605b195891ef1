"""Small fields made of the real records of NGC 188, Gaia × 2MASS, in which the match of the whole tells the truth.

The positions are the real ones; or, to crowd the field, each object keeps its real residual and quoted errors and is
put at a random place. The pairs of the whole field have hardly a chance candidate (less than 1e-3 within 3σ).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache
from itertools import pairwise

import numpy as np

from benchmarks import real
from benchmarks.tables import Table
from sameas.estimate.match import match
from sameas.gate import Pairs, Radius
from sameas.records import Records
from sameas.score.baselines import mutual_nearest
from sameas.space import Sphere

#: A pair of the whole field is true from this probability on; records less certain are in no crowded field.
CERTAIN = 0.99
#: Assumed by the formula of NWAY (its own default is 1).
COMPLETENESS = 0.9
LEAST_P, EDGES = 1e-4, (0.01, 0.05, 0.2, 0.5, 0.8, 0.95, 0.99, 1.0)
METHODS = ("sameas", "NWAY's formula", "mutual nearest within 3σ", "mutual nearest within 1″")


@dataclass(frozen=True)
class Objects:
    """Certain objects of NGC 188: indices of their records in either source, −1 without one."""

    first: Records
    second: Records
    of_first: np.ndarray
    of_second: np.ndarray


@cache
def objects() -> Objects:
    """All objects, both sources at one epoch."""
    answer = real.identified()[0].result
    first, second = answer.pairs.first, answer.pairs.second
    i, j = answer.pairs.i, answer.pairs.j
    sure = answer.p_pair > CERTAIN
    unsure = (answer.p_pair > 1.0 - CERTAIN) & ~sure
    alone = [np.setdiff1d(np.arange(len(side)), at[sure | unsure]) for side, at in ((first, i), (second, j))]
    none = [np.full(len(rows), -1) for rows in alone]
    return Objects(first, second, np.concatenate([i[sure], alone[0], none[1]]),
                   np.concatenate([j[sure], none[0], alone[1]]))  # fmt: skip


def real_field(rng: np.random.Generator, n: int) -> tuple[Records, Records, set[tuple[int, int]]]:
    """The n objects nearest to one of them at their real places, and the true pairs."""
    everything = objects()
    centre = everything.first.features[rng.integers(len(everything.first))]
    place = _places(everything)
    east = (place[:, 0] - centre[0]) * math.cos(math.radians(centre[1]))
    chosen = np.argsort(np.hypot(east, place[:, 1] - centre[1]))[:n]
    return _records(everything, chosen, np.zeros((n, 2)))


def crowded_field(rng: np.random.Generator, n: int, chance: float) -> tuple[Records, Records, set[tuple[int, int]]]:
    """n random objects at random places, with this number of other objects within 3σ of a pair."""
    everything = objects()
    chosen = rng.choice(len(everything.of_first), n, replace=False)
    variance = float(everything.first.covariance[:, 0].mean() + everything.second.covariance[:, 0].mean())
    side_deg = math.sqrt(n * 9.0 * math.pi * variance / chance) / 3600.0
    place = _places(everything)[chosen]
    # Moved along the parallel, so that residuals keep their size: all lie within a degree in declination.
    goal = np.array([0.0, 85.0]) + rng.uniform(0.0, side_deg, (n, 2)) / [math.cos(math.radians(85.0)), 1.0]
    return _records(everything, chosen, goal - place)


def _places(everything: Objects) -> np.ndarray:
    first, second = everything.first.features, everything.second.features
    has = everything.of_first >= 0
    return np.where(has[:, None], first[everything.of_first], second[everything.of_second])


def _records(
    everything: Objects, chosen: np.ndarray, shift: np.ndarray
) -> tuple[Records, Records, set[tuple[int, int]]]:
    """The chosen objects, moved; a residual in right ascension keeps its length."""
    place, sides, numbers = _places(everything)[chosen], [], []
    for records, at in ((everything.first, everything.of_first), (everything.second, everything.of_second)):
        seen = np.flatnonzero(at[chosen] >= 0)
        rows = at[chosen][seen]
        offset = records.features[rows] - place[seen]
        goal = place[seen] + shift[seen]
        offset[:, 0] *= np.cos(np.radians(place[seen, 1])) / np.cos(np.radians(goal[:, 1]))
        sides.append(Records.of(goal + offset, covariance=records.full_covariance()[rows], space=Sphere(),
                                source=records.source))  # fmt: skip
        numbers.append(seen)
    second = {int(number): k for k, number in enumerate(numbers[1])}
    true = {(k, second[int(number)]) for k, number in enumerate(numbers[0]) if int(number) in second}
    return sides[0], sides[1], true


@dataclass
class Score:
    """Candidates with stated probabilities; or pairs that are claimed."""

    p: list[float] = field(default_factory=list)
    is_true: list[bool] = field(default_factory=list)
    loss: list[float] = field(default_factory=list)
    wrong: int = 0
    missed: int = 0

    def add(self, stated: dict[tuple[int, int], float], claimed: set[tuple[int, int]],
            true: set[tuple[int, int]], n_first: int) -> None:  # fmt: skip
        """One field."""
        self.wrong += len(claimed - true)
        self.missed += len(true - claimed)
        self.p += list(stated.values())
        self.is_true += [pair in true for pair in stated]
        none, partner = np.ones(n_first), dict(true)
        for (i, _), p in stated.items():
            none[i] -= p
        if stated:
            answers = [stated.get((i, partner[i]), 0.0) if i in partner else none[i] for i in range(n_first)]
            self.loss += [-math.log(max(p, LEAST_P)) for p in answers]

    def row(self) -> list[object]:
        """Wrong, missed, log loss, and stated → right by bin."""
        if not self.p:
            return [self.wrong, self.missed, math.nan, *[""] * (len(EDGES) - 1)]
        p, is_true = np.array(self.p), np.array(self.is_true)
        at, cells = np.digitize(p, EDGES), []
        for k in range(1, len(EDGES)):
            here = at == k if k < len(EDGES) - 1 else at >= k
            n = int(here.sum())
            cells.append(f"{p[here].mean():.3f} → {is_true[here].mean():.3f} ({n})" if n >= 20 else f"({n})")
        return [self.wrong, self.missed, float(np.mean(self.loss)), *cells]


def _stated(pairs: tuple[np.ndarray, np.ndarray], p: np.ndarray) -> dict[tuple[int, int], float]:
    return {(int(i), int(j)): float(x) for i, j, x in zip(*pairs, p, strict=True)}


def by_nway(near: Pairs) -> np.ndarray:
    """(m,) p_i of NWAY with the quoted errors: each record of the first source by itself."""
    place = near.second.features
    area = float(np.prod(np.ptp(place, axis=0) * 3600.0)) * math.cos(math.radians(float(place[0, 1])))
    density = len(place) / area
    log_density = near.log_peak - 0.5 * near.mahalanobis_sq
    odds = COMPLETENESS / (1.0 - COMPLETENESS) * np.exp(log_density) / density
    return np.asarray(odds / (1.0 + np.bincount(near.i, odds, len(near.first)))[near.i])


def add_field(scores: dict[str, Score], first: Records, second: Records, true: set[tuple[int, int]]) -> None:
    """One field, by every method."""
    answer, _ = match(first, second)
    claimed = set(zip(answer.matches.rows_1.tolist(), answer.matches.rows_2.tolist(), strict=True))
    scores["sameas"].add(_stated((answer.rows_1, answer.rows_2), answer.p_pair), claimed, true, len(first))
    near = Radius(5.5)(first, second)
    at = near.first.rows[near.i], near.second.rows[near.j]
    p = by_nway(near)
    best = {(int(i), int(j)) for i, j, x in zip(*at, p, strict=True) if x > 0.5}
    scores["NWAY's formula"].add(_stated(at, p), best, true, len(first))
    within = {"mutual nearest within 3σ": near.mahalanobis_sq < 9.0,
              "mutual nearest within 1″": np.hypot(*near.residual.T) < 1.0}  # fmt: skip
    for name, inside in within.items():
        kept = near.part(inside)
        chosen = mutual_nearest(kept)
        rows = kept.first.rows[kept.i[chosen]], kept.second.rows[kept.j[chosen]]
        scores[name].add({}, set(zip(*(side.tolist() for side in rows), strict=True)), true, len(first))


def tables(n_objects: int) -> Iterator[Table]:
    """Fields of 20, 50 and 100 real objects, n_objects of each kind in all."""
    if reason := real.missing():
        yield Table("Few real pairs", ("not run",), [[reason]])
        return
    rows: list[list[object]] = []
    for chance in (0.0, 0.3, 1.0):
        for n in (20, 50, 100):
            scores = {name: Score() for name in METHODS}
            n_true = 0
            for number in range(n_objects // n):
                rng = np.random.default_rng([n, round(10.0 * chance), number])
                first, second, true = crowded_field(rng, n, chance) if chance else real_field(rng, n)
                n_true += len(true)
                if min(len(first), len(second)):
                    add_field(scores, first, second, true)
            where = f"random places, λ {chance:g}" if chance else "real places"
            rows += [[where, n, n_true, name, *score.row()] for name, score in scores.items()]
    ranges = [f"{a:g} to {b:g}" for a, b in pairwise(EDGES)]
    columns = ("field", "objects", "true pairs", "by", "wrong", "missed", "log loss", *ranges)
    notes = (
        f"truth: pairs of the whole field with p > {CERTAIN:g}; records with a less certain partner are left out",
        f"NWAY's formula: quoted errors, completeness {COMPLETENESS:g}, each Gaia star by itself; claimed if p > 0.5",
        "stated → right (candidates), at least 20; log loss: mean −ln p of the true answer of a Gaia star",
    )
    yield Table("Few pairs, real residuals of NGC 188", columns, rows, notes)

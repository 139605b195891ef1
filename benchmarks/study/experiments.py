"""Experiments: the points of the study, under the names of ``--only``.

- claims: the papers' own figures.
- spacing: share right against the spacing of targets, for every rule and several q.
- formations: lines, grids, unequal errors, four features, Poisson scenes.
- wrong: rules with a wrong C, b or q.
- several: two to six sources, joint and sequential.
- mori: dense fields and Mori's formula.
- priors: exact and linear.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from benchmarks.study.contenders import (
    PAPERS_GATE,
    ByDistance,
    Close,
    Constant,
    Contender,
    CountPrior,
    Enumerated,
    Gate,
    Identified,
    NoPrior,
    Uniform,
    line_up,
    most_pairs_of_groups,
)
from benchmarks.study.reach import EstimatedReach
from benchmarks.study.scenes import EQUAL, UNEQUAL, Formation, Lattice, Scatter
from benchmarks.study.several import Several
from benchmarks.study.stonesoup import StoneSoup, is_installed
from benchmarks.study.trial import Point
from sameas.gate import Radius

NAMES = ("claims", "spacing", "formations", "wrong", "several", "mori", "priors")

SPACINGS = (0.5, 1.0, 1.6, 1.9, 2.5, 3.0, 4.0, 6.0)
#: q of the line of five and of two targets.
FIVE_Q, TWO_Q = (0.05, 0.1, 0.2, 0.4), (0.02, 0.2, 0.4, 0.6)
FIVE, TWO = (5, 1), (2, 1)
#: Parameter given to a rule, as a multiple of its true value.
C_FACTORS = (0.01, 0.03, 0.1, 0.3, 1.0, 2.0, 3.0, 10.0, 30.0, 100.0)
B_FACTORS = (0.125, 0.25, 0.5, 0.75, 1.0, 2.0, 4.0, 8.0, 16.0)
Q_FACTORS = (0.05, 0.1, 0.25, 0.5, 1.0, 1.5, 2.0)
#: A gate that excludes no pair, for figures that the papers' gate would change.
OPEN_GATE = Radius(1e3)
#: The two gates, by the suffix of a contender's name.
GATES: dict[str, Gate] = {"": PAPERS_GATE, ", no gate": OPEN_GATE}
#: Close objects with the true parameters, the reference for wrong ones.
RIGHT = "everything right, no gate"
#: Share of the scenes for Stone Soup, which takes some thirty times as long.
STONE_SOUP_SHARE = 0.25
#: Standard deviation of a record, in σ; the unit of the spacings of several sources.
RECORD = EQUAL[0]


def spacing() -> list[Point]:
    """All rules against the spacing, in lines of five and of two targets."""
    points = []
    for shape, several_q in ((FIVE, FIVE_Q), (TWO, TWO_Q)):
        for q in several_q:
            for d in SPACINGS:
                points += _compared(
                    "spacing", f"{math.prod(shape)} targets, d {d:g}, q {q:g}", Lattice(shape, d, (q, q))
                )
    return points


FORMATIONS: dict[str, Formation] = {
    "line of 5": Lattice((5, 1), 3.0, (0.2, 0.2)),
    "line of 5, d 1.9": Lattice((5, 1), 1.9, (0.2, 0.2)),
    "line of 25": Lattice((25, 1), 3.0, (0.2, 0.2)),
    "grid 3 × 3": Lattice((3, 3), 3.0, (0.2, 0.2)),
    "grid 5 × 5": Lattice((5, 5), 3.0, (0.2, 0.2)),
    "line of 5, errors 3 : 1": Lattice((5, 1), 3.0, (0.2, 0.2), UNEQUAL),
    "line of 5, q 0.05 and 0.5": Lattice((5, 1), 3.0, (0.05, 0.5)),
    "2 × 2 × 2 in 4 features, d 2": Lattice((2, 2, 2, 1), 2.0, (0.2, 0.2)),
    "Poisson, density 0.02": Scatter(0.02, 10, (0.2, 0.2)),
    "Poisson, density 0.05": Scatter(0.05, 10, (0.2, 0.2)),
    "Poisson, density 0.1": Scatter(0.1, 10, (0.2, 0.2)),
    "Poisson, density 0.2": Scatter(0.2, 10, (0.2, 0.2)),
}


def formations() -> list[Point]:
    """All rules on all formations; enumeration up to five targets."""
    points = []
    for name, formation in FORMATIONS.items():
        more = [Enumerated("enumeration", Close())] if formation.targets <= 5 else []
        points += _compared("formations", name, formation, more)
    return points


def wrong() -> list[Point]:
    """Rules with a wrong C, b or q, all on the same scenes: a line of five, d = 3, q = 0.4."""
    formation = Lattice(FIVE, 3.0, (0.4, 0.4))
    rules: dict[str, list[Contender]] = {name: [Identified(RIGHT, Close(), gate=OPEN_GATE)] for name in ("C", "b", "q")}
    for suffix, gate in GATES.items():
        rules["C"] += [Identified(f"C × {f:g}{suffix}", Constant(f), NoPrior(), gate) for f in C_FACTORS]
        rules["b"] += [Identified(f"b × {f:g}{suffix}", Close(f), gate=gate) for f in B_FACTORS]
        rules["q"] += [Identified(f"q × {f:g}{suffix}", Close(), CountPrior(f), gate) for f in Q_FACTORS]
        rules["b"].append(EstimatedReach(f"b estimated{suffix}", gate=gate))
    return [Point("wrong", name, formation, tuple(contenders), scenes_of="wrong") for name, contenders in rules.items()]


def claims() -> list[Point]:
    """The papers' own figures, with and without a gate."""
    points = []
    close = (Identified("close objects", Close()), Identified("close objects, no gate", Close(), gate=OPEN_GATE))
    for shape, several_q in ((TWO, (0.2, 0.4)), (FIVE, (0.05, 0.1))):
        for q in several_q:
            for d in (1.6, 1.9):
                name = f"{math.prod(shape)} targets, d {d:g}, q {q:g}"
                points.append(Point("claims", name, Lattice(shape, d, (q, q)), close))
    rules: list[Contender] = []
    for suffix, gate in GATES.items():
        rules += [
            Identified(f"close objects{suffix}", Close(), gate=gate),
            Identified(f"close objects, generalized Gaussian{suffix}", Close(approximation="generalized Gaussian"),
                         gate=gate),
            Identified(f"uniform{suffix}", Uniform(), gate=gate),
            ByDistance(f"k = min{suffix}", most_pairs_of_groups, gate),
        ]  # fmt: skip
    rules.append(Identified(f"uniform, box by a record's σ{suffix}", Uniform(RECORD), gate=gate))
    points.append(Point("claims", "2 targets, d 3, q 0.5", Lattice(TWO, 3.0, (0.5, 0.5)), tuple(rules)))
    return points


def several(scenes: int) -> list[Several]:
    """Five targets scattered over a square, mean spacings in σ of a record; one line; fewer scenes of more sources."""
    points = []
    for spacing in (3.0, 4.0, 6.0, 8.0, 12.0):
        name, oracle = f"3 sources, spacing {spacing:g}", spacing == 4.0
        points.append(Several(name, _scattered(spacing, 3), max(scenes // 2, 50), oracle))
    line = Lattice(FIVE, 4.0 * RECORD, (0.1,) * 3, (RECORD,) * 3)
    points.append(Several("3 sources, in a line, spacing 4", line, max(scenes // 4, 50)))
    for n_sources, share in ((2, 2), (4, 4), (5, 10), (6, 20)):
        name = f"{n_sources} sources, spacing 8"
        points.append(Several(name, _scattered(8.0, n_sources), max(scenes // share, 50)))
    return points


def _scattered(spacing_records: float, n_sources: int, targets: int = 5) -> Scatter:
    q, sigma = (0.1,) * n_sources, (RECORD,) * n_sources
    return Scatter((spacing_records * RECORD) ** -2.0, targets, q, sigma, numbers="fixed")


def crowd() -> Scatter:
    """200 targets of six sources, with a mean spacing of 16 σ of a record."""
    return _scattered(16.0, 6, 200)


def _compared(experiment: str, name: str, formation: Formation, more: Sequence[Contender] = ()) -> list[Point]:
    """The contenders on a formation, and Stone Soup on a part of the same scenes."""
    points = [Point(experiment, name, formation, (*line_up(formation), *more))]
    if is_installed() and formation.targets <= 10:
        points.append(Point(experiment, name, formation, (points[0].contenders[0], StoneSoup()), STONE_SOUP_SHARE))
    return points

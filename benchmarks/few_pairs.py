"""Stated probabilities of catalogues with few pairs against observed frequencies, by what is wrong with their errors.

Fields of 10 to 1 000 pairs, errors right, too small, too large, with a floor and with tails, from sparse to crowded, by
`sameas.match` with everything estimated and with the true densities and errors. Then fields of 20 to 100 real objects
(``few_real.py``), beside nearest neighbour and the formula of NWAY.
``scripts/bench few_pairs``, 30 minutes.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from benchmarks import few_real
from benchmarks.misstated import formal_field
from benchmarks.tables import Table, report
from sameas import PoissonField, identify
from sameas.estimate.match import match
from sameas.evidence import Errors
from sameas.gate import Radius
from sameas.kernels.compiled import prefer_compiled
from sameas.result import Identification
from sameas.score.pairs import is_true_pair
from sameas.simulate.scenes import SimulatedScene

#: Quoted errors of a record on each axis, log-uniform, and their mean square over a pair.
QUOTED_ARCSEC = (0.05, 0.5)
MEAN_SQUARE = (QUOTED_ARCSEC[1] ** 2 - QUOTED_ARCSEC[0] ** 2) / math.log(QUOTED_ARCSEC[1] / QUOTED_ARCSEC[0])
MISSING, FALSE_SHARE = (0.1, 0.2), 0.1
#: Bins of the stated probability; a bin of fewer candidates is not judged.
EDGES, MIN_COUNT = (0.01, 0.05, 0.2, 0.5, 0.8, 0.95, 0.99, 0.999, 1.0), 200
LEAST_P = 1e-4


@dataclass(frozen=True)
class Kind:
    """What the true errors are, relative to the quoted ones."""

    title: str
    scale: float = 1.0
    floor_arcsec: float = 0.0
    tail: tuple[float, float] = (0.0, 1.0)

    @property
    def errors(self) -> Errors:
        """The true distribution of the residuals."""
        share, wider = self.tail
        mixture = Errors((1.0, wider), (1.0 - share, share)) if share else Errors()
        return Errors(mixture.scales, mixture.shares, self.scale, self.scale, self.floor_arcsec)


KINDS = (
    Kind("as quoted"),
    Kind("2 times too small", scale=2.0),
    Kind("floor of 0.5″", floor_arcsec=0.5),
    Kind("tail of 5 %, 4 times", tail=(0.05, 4.0)),
    Kind("tail of 15 %, 4 times", tail=(0.15, 4.0)),
    Kind("tail of 10 %, 8 times", tail=(0.1, 8.0)),
)


@dataclass
class Statements:
    """Stated probabilities of all candidates and whether they are true; −ln of that of each record's true answer."""

    p: list[np.ndarray] = field(default_factory=list)
    is_true: list[np.ndarray] = field(default_factory=list)
    loss: list[np.ndarray] = field(default_factory=list)

    def add(self, answer: Identification, scene: SimulatedScene) -> None:
        """Add one field."""
        true = scene.true_pairs()
        happened = is_true_pair((answer.rows_1, answer.rows_2), true)
        self.p.append(answer.p_pair)
        self.is_true.append(happened)
        p_answer = answer.answers_1.p_none.filled(1.0).copy()
        p_answer[true[0]] = 0.0
        p_answer[answer.rows_1[happened]] = answer.p_pair[happened]
        self.loss.append(-np.log(np.maximum(p_answer, LEAST_P)))

    def join(self, other: Statements) -> None:
        """Add all of the other's."""
        self.p += other.p
        self.is_true += other.is_true
        self.loss += other.loss

    @property
    def log_loss(self) -> float:
        """Mean over the records of the first source."""
        return float(np.concatenate(self.loss).mean())

    def bins(self) -> list[tuple[int, float, float]]:
        """(number, stated, observed) in each bin."""
        p, is_true = np.concatenate(self.p), np.concatenate(self.is_true)
        which = np.digitize(p, EDGES) - 1
        out = []
        for k in range(len(EDGES) - 1):
            here = which == k if k < len(EDGES) - 2 else which >= k
            n = int(here.sum())
            out.append((n, float(p[here].mean()) if n else math.nan, float(is_true[here].mean()) if n else math.nan))
        return out

    @property
    def largest(self) -> float:
        """Greatest difference of stated and observed in the bins with enough candidates."""
        return max((abs(stated - seen) for n, stated, seen in self.bins() if n >= MIN_COUNT), default=math.nan)


@dataclass(frozen=True)
class Field:
    """Fields with this expected number of pairs and of chance candidates within 3σ of a record, by quoted errors."""

    kind: Kind
    pairs: int
    chance: float

    @property
    def per_deg2(self) -> float:
        """Density of the real objects."""
        seen = 1.0 - MISSING[1] + FALSE_SHARE
        return self.chance / (9.0 * math.pi * MEAN_SQUARE) / seen * 3600.0**2

    def scene(self, number: int) -> SimulatedScene:
        """One of these fields."""
        seed = [*map(ord, self.kind.title), self.pairs, round(1000 * self.chance), number]
        kind, objects = self.kind, round(self.pairs / ((1.0 - MISSING[0]) * (1.0 - MISSING[1])))
        return formal_field(
            np.random.default_rng(seed), objects, per_deg2=self.per_deg2, quoted_arcsec=QUOTED_ARCSEC,
            scale=kind.scale, floor_arcsec=kind.floor_arcsec, tail=kind.tail, missing=MISSING,
            false_share=FALSE_SHARE,
        )  # fmt: skip

    def known(self, scene: SimulatedScene) -> Identification:
        """The identification with the true densities and errors."""
        density, (q1, q2), errors = self.per_deg2 / 3600.0**2, MISSING, self.kind.errors
        only = density * ((1.0 - q1) * q2 + FALSE_SHARE), density * ((1.0 - q2) * q1 + FALSE_SHARE)
        rule = PoissonField(density * (1.0 - q1) * (1.0 - q2), *only, errors)
        sigma = math.hypot(QUOTED_ARCSEC[0] * errors.factor_1 * math.sqrt(2.0), self.kind.floor_arcsec)
        widest = max(errors.scales) * 5.5 * max(errors.factor_1, sigma / QUOTED_ARCSEC[0] / math.sqrt(2.0))
        return identify(scene.first, scene.second, rule=rule, gate=Radius(min(widest, 60.0)))

    def statements(self, options: argparse.Namespace) -> tuple[Statements, Statements]:
        """By estimation, and with everything known."""
        estimated, known = Statements(), Statements()
        for number in range(max(2, options.pairs // self.pairs)):
            scene = self.scene(number)
            if min(len(scene.first), len(scene.second)):
                estimated.add(match(scene.first, scene.second)[0], scene)
                known.add(self.known(scene), scene)
        return estimated, known


def tables(options: argparse.Namespace) -> Iterator[Table]:
    """By kind and number of pairs, then by kind and crowding, then over all kinds."""
    kinds = [kind for kind in KINDS if options.kinds is None or any(name in kind.title for name in options.kinds)]
    of: dict[Field, tuple[Statements, Statements]] = {}
    for kind in kinds:
        for n in options.numbers:
            for chance in options.lambdas:
                case = Field(kind, n, chance)
                of[case] = case.statements(options)
    if of:
        yield from _calibration("by number of pairs", of, lambda case: (case.kind.title, f"{case.pairs} pairs"))
        yield from _calibration("by crowding", of, lambda case: (case.kind.title, f"λ {case.chance:g}"))
        yield from _calibration("all kinds", of, lambda case: (f"{case.pairs} pairs", f"λ {case.chance:g}"))
        yield from _calibration("everything", of, lambda case: ("all", ""))
    if options.real:
        yield from few_real.tables(options.real)


def _calibration(title: str, of: dict[Field, tuple[Statements, Statements]], key) -> Iterator[Table]:  # type: ignore[no-untyped-def]
    joined: dict[tuple[str, str], tuple[Statements, Statements]] = {}
    for case, both in of.items():
        for total, part in zip(joined.setdefault(key(case), (Statements(), Statements())), both, strict=True):
            total.join(part)
    rows: list[list[object]] = []
    for names, (estimated, known) in joined.items():
        cells = [f"{s:.3f} → {o:.3f} ({n})" if n >= MIN_COUNT else f"({n})" for n, s, o in estimated.bins()]
        rows.append([*names, estimated.log_loss, known.log_loss, estimated.largest, known.largest, *cells])
    ranges = [f"{a:g} to {b:g}" for a, b in pairwise(EDGES)]
    columns = ("errors", "of", "log loss", "known", "largest difference", "known", *ranges)
    note = f"stated → observed (candidates); bins of fewer than {MIN_COUNT} candidates: their number only"
    yield Table(f"Few pairs, {title}", columns, rows, (note, "log loss: mean −ln p of the true answer of a record"))


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(prog="scripts/bench few_pairs", description=__doc__)
    parser.add_argument("--pairs", type=int, default=600, help="pairs of each kind of field (default 600)")
    parser.add_argument("--numbers", type=int, nargs="+", default=[10, 30, 100, 200], help="pairs of a field")
    parser.add_argument("--lambdas", type=float, nargs="+", default=[0.01, 0.3, 1.0, 4.0], help="chance candidates")
    parser.add_argument("--real", type=int, default=1000, help="real objects of each kind of field (default 1000)")
    parser.add_argument("--kinds", nargs="*", help="parts of their titles (default all; nothing: none)")
    options = parser.parse_args()
    prefer_compiled()
    report("few_pairs", tables(options))


if __name__ == "__main__":
    main()

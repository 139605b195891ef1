"""Stated probabilities against observed frequencies, with the true model and with everything estimated."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks import workload
from benchmarks.tables import OUTPUT, Table, report
from sameas import CommonObjects, Field, Identification, Plane, Radius, identify
from sameas.estimate.match import match
from sameas.score.pairs import is_true_pair, reliability, score_probabilities
from sameas.simulate.scenes import poisson_field

COLUMNS = (
    "scene", "model", "candidates", "ECE, candidates", "ECE, p > 1 %", "ECE, claimed", "ECE, no partner",
    "largest by chance", "Brier", "expected wrong", "wrong",
)  # fmt: skip
LIMIT = 0.01


@dataclass(frozen=True)
class Statements:
    """Stated probabilities and truth: of candidates, of claimed pairs, of records without a partner."""

    pairs: tuple[np.ndarray, np.ndarray]
    claimed: tuple[np.ndarray, np.ndarray]
    alone: tuple[np.ndarray, np.ndarray]

    @classmethod
    def of(cls, answer: Identification, true: tuple[np.ndarray, np.ndarray]) -> Statements:
        """The probabilities of a result, with the truth."""
        is_true = is_true_pair((answer.rows_1, answer.rows_2), true)
        chosen = answer.chosen
        p_none, is_none = [], []
        for answers, rows in ((answer.answers_1, true[0]), (answer.answers_2, true[1])):
            p_none.append(answers.p_none.compressed())
            alone = np.ones(len(answers.usable), bool)
            alone[rows] = False
            is_none.append(alone[answers.usable])
        p = answer.p_pair
        return cls((p, is_true), (p[chosen], is_true[chosen]), (np.concatenate(p_none), np.concatenate(is_none)))

    @classmethod
    def joined(cls, parts: list[Statements]) -> Statements:
        """The statements of several scenes."""

        def both(name: str) -> tuple[np.ndarray, np.ndarray]:
            p, is_true = (np.concatenate([getattr(s, name)[k] for s in parts]) for k in (0, 1))
            return p, is_true

        return cls(both("pairs"), both("claimed"), both("alone"))

    def line(self) -> list[object]:
        """The numbers of one row of the table."""
        p, is_true = self.pairs
        above = p > 0.01
        kinds = (self.pairs, (p[above], is_true[above]), self.claimed, self.alone)
        errors = [score_probabilities(*events).expected_calibration_error for events in kinds]
        chance = max(by_chance(*events) for events in kinds)
        wrong = int((~self.claimed[1]).sum())
        brier = score_probabilities(*self.pairs).brier
        return [len(p), *errors, chance, brier, float(np.sum(1 - self.claimed[0])), wrong]


def by_chance(p: np.ndarray, is_true: np.ndarray) -> float:
    """The expected calibration error of calibrated probabilities with this number of events."""
    r = reliability(p, is_true)
    return float(np.sqrt(2 / np.pi) * np.sum(r.count * r.standard_error) / r.count.sum())


# ---- catalogues ----


def catalogues(rows: int, lam: float, elliptical: bool) -> Iterator[tuple[str, Statements]]:
    """A crowded field, with the true densities and with everything estimated."""
    scene, densities = workload.crowded(41, rows, lam, elliptical)
    true = scene.true_pairs()
    yield "true", Statements.of(identify(scene.first, scene.second, rule=densities.rule()), true)
    yield "estimated", Statements.of(match(scene.first, scene.second)[0], true)


# ---- pictures of few targets ----

Q1, Q2, BOX, MOST = 0.1, 0.25, 12.0, 10


def pictures(scenes: int, priors: dict[str, Any]) -> dict[str, Statements]:
    """Small scenes drawn as ``CommonObjects`` assumes: every number of targets is equally probable, one group.

    The density is uniform, so that the number of targets is. Scenes with more than ten records of a source are
    excluded; this selection depends on the records only, so the posterior stays calibrated. The box has no edges and
    no gate.
    """
    rng = np.random.default_rng(43)
    parts: dict[str, list[Statements]] = {name: [] for name in priors}
    while min(map(len, parts.values())) < scenes:
        density = rng.uniform(0.0, 3.0 * MOST / BOX**2)
        space = Plane(periods=(BOX, BOX))
        scene = poisson_field(
            rng, density=density, extent=(BOX, BOX), q1=Q1, q2=Q2, sigma_1=0.3, sigma_2=(0.15, 0.45), correlated=True,
            space=space,
        )  # fmt: skip
        if not (0 < len(scene.first) <= MOST and 0 < len(scene.second) <= MOST):
            continue
        for name, prior in priors.items():
            rule = Field(1.0 / BOX**2)
            answer = identify(scene.first, scene.second, rule=rule, prior=prior, gate=Radius(1e3))
            parts[name].append(Statements.of(answer, scene.true_pairs()))
    return {name: Statements.joined(some) for name, some in parts.items()}


# ---- tables ----


def tables(options: argparse.Namespace, curves: dict[str, Statements]) -> Iterator[Table]:
    """The summary, then the reliability of every kind of scene; ``curves`` collects the statements for the figure."""
    lines: list[list[object]] = []
    for lam in options.lambdas:
        for elliptical in (False, True):
            kind = "ellipses" if elliptical else "circles"
            for model, statements in catalogues(options.rows, lam, elliptical):
                curves[f"λ {lam:g}, {kind}, {model}"] = statements
                lines.append([f"λ {lam:g}, {kind}", model, *statements.line()])
    priors = {"CommonObjects": CommonObjects(Q1, Q2), "CommonObjects, linear": CommonObjects(Q1, Q2, linear=True)}
    for model, statements in pictures(options.scenes, priors).items():
        curves[f"pictures, {model}"] = statements
        lines.append([f"{options.scenes} pictures", model, *statements.line()])
    true = [line for line in lines if line[1] in ("true", "CommonObjects")]
    worst = max(float(line[k]) for line in true for k in (3, 4, 5, 6))  # type: ignore[arg-type]
    notes = (
        f"largest ECE with the true model: {worst:.4f} (target: ≤ {LIMIT}); ten equal bins; default gate",
        "estimated: densities and errors from the data; linear: the papers' line through ln P(k), not the true prior",
    )
    yield Table(f"Calibration, {options.rows} rows", COLUMNS, lines, notes)
    for name, statements in curves.items():
        yield reliability_table(name, statements)


def reliability_table(name: str, statements: Statements) -> Table:
    """Stated and observed probability of all candidates by bin."""
    r = reliability(*statements.pairs)
    columns = ("stated", "observed", "candidates", "deviation in σ")
    lines = [
        [round(float(s), 4), round(float(o), 4), int(c), round(float(d), 1)]
        for s, o, c, d in zip(r.stated, r.observed, r.count, r.deviation, strict=True)
    ]
    return Table(f"Reliability: {name}", columns, lines)


def figure(curves: dict[str, Statements]) -> str:
    """Draw the reliability curves; returns a message."""
    try:
        import matplotlib

        matplotlib.use("Agg")
        import matplotlib.pyplot as plt
    except ImportError:
        return "no figure: matplotlib is missing (pip install matplotlib)"
    drawing, axes = plt.subplots(figsize=(5.5, 5.5))
    axes.plot([0, 1], [0, 1], color="0.6", linewidth=1)
    for name, statements in curves.items():
        if "linear" in name or "estimated" in name:
            continue
        r = reliability(*statements.pairs)
        axes.errorbar(r.stated, r.observed, r.standard_error, fmt="o-", markersize=3, linewidth=0.8, label=name)
    axes.set(xlabel="stated probability", ylabel="observed frequency", title="With the true model")
    axes.legend(fontsize=7)
    drawing.tight_layout()
    drawing.savefig(OUTPUT / "calibration.png", dpi=150)
    return f"figure: {OUTPUT / 'calibration.png'}"


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(prog="scripts/bench calibration", description=__doc__)
    parser.add_argument("--rows", type=int, default=20_000, help="rows of each source (default 20000)")
    parser.add_argument("--scenes", type=int, default=3000, help="number of small pictures (default 3000)")
    parser.add_argument("--lambdas", type=float, nargs="+", default=list(workload.LAMBDAS))
    parser.add_argument("--figure", action="store_true", help="draw the curves too")
    options = parser.parse_args()
    curves: dict[str, Statements] = {}
    report("calibration", tables(options, curves))
    if options.figure:
        print(figure(curves))


if __name__ == "__main__":
    main()

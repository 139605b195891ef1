"""Pairs found between two sources with an offset: ignored, fitted by nearest neighbours, or estimated."""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from benchmarks.tables import Table, report
from sameas import Errors, Records, identify
from sameas.estimate.match import match
from sameas.evidence import PoissonField
from sameas.registration import Offset, SensorBias, Shift, Similarity, register
from sameas.score.pairs import score_pairs
from sameas.simulate.scenes import SimulatedScene, poisson_field

TARGETS = 40
DENSITIES, MISSES, SHIFTS = (0.01, 0.03), (0.1, 0.3), (0.0, 2.0, 4.0, 8.0, 30.0)
#: Rounds of the nearest-neighbour peer, and how far it looks in the end, in σ.
ICP_STEPS, REACH_SIGMAS = 30, 3.0


def draw_scene(seed: int, q: float, density: float, n: int = TARGETS) -> SimulatedScene:
    """Targets scattered at ``density`` per σ², σ = 1 the error of one axis of a residual."""
    side = math.sqrt(n / density)
    half = math.sqrt(0.5)
    return poisson_field(
        np.random.default_rng(seed), density=density, extent=(side, side), q1=q, q2=q, sigma_1=half, sigma_2=half
    )


def with_positions(records: Records, features: np.ndarray) -> Records:
    """The records at other places."""
    return replace(records, features=np.ascontiguousarray(features))


def inverse(model: Offset, theta: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """The positions that the offset moves to ``positions``, by Newton's method."""
    estimate = positions.copy()
    for _ in range(20):
        residual = positions - model.moved(estimate, theta)
        estimate = estimate + np.linalg.solve(model.carried(estimate, theta), residual[..., None])[..., 0]
    return estimate


def f1(scene: SimulatedScene, pairs: tuple[np.ndarray, np.ndarray]) -> float:
    """F1 of the claimed pairs; NaN without true pairs."""
    return score_pairs(pairs, scene.true_pairs()).f1


def pairs_of(answer: object) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the identified pairs."""
    matches = answer.matches  # type: ignore[attr-defined]
    return matches.rows_1, matches.rows_2


def icp(first: Records, second: Records) -> tuple[np.ndarray, np.ndarray]:
    """For comparison, iterative closest point (ICP): mutual nearest, mean residual, within a shrinking radius."""
    from scipy.spatial import cKDTree

    x, y = first.features, second.features.copy()
    for step in range(ICP_STEPS):
        reach = max(30.0 * 0.7**step, REACH_SIGMAS)
        distance, nearest = cKDTree(y).query(x)
        _, backward = cKDTree(x).query(y)
        rows = np.flatnonzero((backward[nearest] == np.arange(len(x))) & (distance <= reach * math.sqrt(2.0)))
        if len(rows):
            y = y + (x[rows] - y[nearest[rows]]).mean(axis=0)
    return rows, nearest[rows]


@dataclass
class Tally:
    """The values of one column, one per seed."""

    values: list[float] = field(default_factory=list)

    @property
    def mean(self) -> float:
        """Mean."""
        return float(np.nanmean(self.values))

    @property
    def error(self) -> float:
        """Standard error of the mean."""
        return float(np.nanstd(self.values) / math.sqrt(len(self.values)))


def f1_with_truth(scene: SimulatedScene, q: float, density: float) -> float:
    """F1 without an offset, with the true densities and miss rates given."""
    one = density * q * (1 - q)
    return f1(scene, pairs_of(identify(scene.first, scene.second, rule=PoissonField(density * (1 - q) ** 2, one, one))))


def shifts(scenes: int) -> Table:
    """Shifts of 0 to 30σ."""
    lines = []
    for density in DENSITIES:
        for q in MISSES:
            for shift in SHIFTS:
                truth, without, by_icp, by_register, loss, established = (Tally() for _ in range(6))
                for seed in range(scenes):
                    scene = draw_scene(seed, q, density)
                    angle = 2.0 * math.pi * np.random.default_rng(seed + 10**6).uniform()
                    offset = shift * np.array([math.cos(angle), math.sin(angle)])
                    second = with_positions(scene.second, scene.second.features - offset)
                    solution = register(scene.first, second, Shift())
                    truth.values.append(f1_with_truth(scene, q, density))
                    unshifted = f1(scene, pairs_of(match(scene.first, scene.second, errors=Errors())[0]))
                    without.values.append(f1(scene, pairs_of(match(scene.first, second, errors=Errors())[0])))
                    by_icp.values.append(f1(scene, icp(scene.first, second)))
                    by_register.values.append(f1(scene, pairs_of(solution.identification)))
                    loss.values.append(unshifted - by_register.values[-1])
                    established.values.append(100.0 * solution.established)
                lines.append(
                    [density, q, shift, truth.mean, without.mean, by_icp.mean, by_register.mean, loss.mean, loss.error,
                     "yes" if loss.mean <= 0.03 else "no", established.mean]
                )  # fmt: skip
    columns = ("β·s²", "misses", "shift σ", "F1 truth given", "F1 no registration", "F1 ICP", "F1 register", "loss",
               "± s.e.", "within 0.03", "established %")  # fmt: skip
    return Table(
        f"Shift: mean F1 of {scenes} scenes of {TARGETS} targets", columns, lines,
        ("loss: F1 of match on the unshifted scene less F1 of register on the shifted one",),
    )  # fmt: skip


@dataclass(frozen=True)
class Trial:
    """An offset to estimate: name, model for a scene, true parameters."""

    name: str
    model: Callable[[SimulatedScene, float], Offset]
    theta: tuple[float, ...]


def _velocity(scene: SimulatedScene) -> np.ndarray:
    return np.random.default_rng(len(scene.second)).normal(0.0, 2.0, (len(scene.second), 2))


TRIALS = (
    Trial("rotation 2°, scale 1 %, shift 8σ", lambda scene, side: Similarity(), (8.0, 0.0, 2.0, 0.01)),
    Trial("sensor: range 6σ, azimuth 3°", lambda scene, side: SensorBias((-0.3 * side, -0.2 * side)), (6.0, 3.0)),
    Trial(
        "sensor: the same, gain 2 %, time 2",
        lambda scene, side: SensorBias(
            (-0.3 * side, -0.2 * side), gain_width=0.02, time_width=3.0, velocity=_velocity(scene)
        ),
        (6.0, 3.0, 0.02, 2.0),
    ),
)


def others(scenes: int) -> Table:
    """Rotation and scale, and biases of a sensor, with the coverage of their standard errors."""
    lines = []
    for trial in TRIALS:
        for density in DENSITIES:
            for q in MISSES:
                # Different scenes for every line, so that their errors are independent.
                base = 10**4 * (1 + len(lines))
                loss, established, time_ms = Tally(), Tally(), Tally()
                z = []
                for seed in range(scenes):
                    scene = draw_scene(base + seed, q, density)
                    model = trial.model(scene, math.sqrt(TARGETS / density)).placed(scene.first, scene.second)
                    theta = np.array(trial.theta)
                    second = with_positions(scene.second, inverse(model, theta, scene.second.features))
                    start = time.perf_counter()
                    solution = register(scene.first, second, model)
                    time_ms.values.append(1e3 * (time.perf_counter() - start))
                    unshifted = f1(scene, pairs_of(match(scene.first, scene.second, errors=Errors())[0]))
                    loss.values.append(unshifted - f1(scene, pairs_of(solution.identification)))
                    established.values.append(100.0 * solution.established)
                    z.append((solution.theta - theta) / solution.standard_errors)
                inside = 100.0 * np.mean(np.abs(z) < 2.0, axis=0)
                within = ", ".join(f"{name} {share:.1f}" for name, share in zip(model.names, inside, strict=True))
                lines.append([trial.name, density, q, loss.mean, loss.error, within, established.mean, time_ms.mean])
    columns = ("offset", "β·s²", "misses", "F1 loss", "± s.e.", "% within 2 s.e.", "established %", "ms")
    error = 100.0 * math.sqrt(0.0455 * 0.9545 / scenes)
    return Table(
        f"Other offsets, {scenes} scenes", columns, lines,
        (f"within 2 s.e.: 95.4 % is expected, with a standard error of {error:.1f} %",),
    )  # fmt: skip


def times(runs: int) -> Table:
    """Time of a registration, and of one match with everything estimated."""
    lines = []
    for n in (40, 300, 2000, 20_000):
        scene = draw_scene(1, 0.1, 0.01, n)
        for name, model in (("shift", Shift()), ("similarity", Similarity())):
            second = with_positions(scene.second, scene.second.features - [8.0, 3.0])
            seconds: dict[str, list[float]] = {"register": [], "match": []}
            for _ in range(runs + 1):
                start = time.perf_counter()
                register(scene.first, second, model)
                middle = time.perf_counter()
                match(scene.first, scene.second, errors=Errors())
                seconds["register"].append(middle - start)
                seconds["match"].append(time.perf_counter() - middle)
            medians = [1e3 * float(np.median(seconds[key][1:])) for key in ("register", "match")]
            lines.append([n, name, *medians, medians[0] / medians[1]])
    return Table("Time, ms (median)", ("objects", "offset", "register", "match alone", "×"), lines)


def tables(options: argparse.Namespace) -> Iterator[Table]:
    """All tables."""
    if "times" in options.only:
        yield times(3)
    if "shifts" in options.only:
        yield shifts(options.scenes)
    if "others" in options.only:
        yield others(options.scenes)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(prog="scripts/bench registration", description=__doc__)
    parser.add_argument("--scenes", type=int, default=200, help="scenes of each line (default 200)")
    sections = ("times", "shifts", "others")
    parser.add_argument("--only", nargs="+", choices=sections, default=sections, help="sections to print")
    report("registration", tables(parser.parse_args()))


if __name__ == "__main__":
    main()

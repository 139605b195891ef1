"""Extreme inputs: crowds within one error, equal positions, one record against a million, millions of rows.

Each is one command in its own process, which must succeed, or refuse in one line, within limits of CPU time and memory.
It is then started again and gets Ctrl-C at random moments, which it must answer within ``ANSWER_S``.
``scripts/bench faults --only loads``.
"""

from __future__ import annotations

import os
import random
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.tables import Table

#: Limits: CPU seconds, bytes, seconds until Ctrl-C is answered (docs/promises.md promises one; the rest allows for the
#: start of Python on a busy machine).
CPU_S, BYTES, ANSWER_S = 900.0, 12 << 30, 1.5
COLUMNS = ("load", "outcome", "CPU s", "peak MB", "Ctrl-C", "slowest answer, s", "message")


@dataclass(frozen=True)
class Load:
    """One command. make : writes its files to a folder, returns its arguments. moments : number of interrupted runs."""

    name: str
    make: Callable[[Path], list[str]]
    moments: int = 4


def stars(folder: Path, *sides: tuple[int, float, float]) -> list[str]:
    """Catalogues around one position; sides : rows, scatter and error in arcsec of each."""
    return _catalogues(folder, [(_scattered(k, n, spread), np.full(n, sigma)) for k, (n, spread, sigma) in
                                enumerate(sides)])  # fmt: skip


def wide_one(folder: Path) -> list[str]:
    """100 000 rows each, one of them with an error that covers the field."""
    offset_arcsec = np.random.default_rng(3).uniform(-3600.0, 3600.0, (2, 100_000))
    noise = np.random.default_rng(4).normal(0.0, 0.1, (2, 2, 100_000))
    sigma = np.full(100_000, 0.1)
    return _catalogues(folder, [(offset_arcsec + noise[0], np.where(np.arange(100_000) == 77, 3600.0, sigma)),
                                (offset_arcsec + noise[1], sigma)])  # fmt: skip


def field(folder: Path, n: int, absent: int = 0, crowd: tuple[int, float] = (0, 0.0), sides: int = 2) -> list[str]:
    """Catalogues of n rows each of the same stars, eleven per square arcmin.

    absent : number of rows with NaN positions. crowd : number of rows in one clump, and its scatter in arcsec.
    """
    side = 3600.0 * np.sqrt(n / 40_000.0)
    offset_arcsec = np.random.default_rng(5).uniform(-0.5 * side, 0.5 * side, (2, n))
    noise = np.random.default_rng(6).normal(0.0, 0.1, (sides, 2, n))
    rows = np.random.default_rng(7).integers(n // 3, n, absent)
    for source_noise in noise:
        source_noise[:, rows] = np.nan
        source_noise[:, : crowd[0]] = source_noise[:, : crowd[0]] * crowd[1] - offset_arcsec[:, : crowd[0]]
    return _catalogues(folder, [(offset_arcsec + source_noise, np.full(n, 0.1)) for source_noise in noise])


def _scattered(k: int, n: int, sigma: float) -> np.ndarray:
    return np.random.default_rng(k).normal(0.0, sigma, (2, n))


def _catalogues(folder: Path, sides: list[tuple[np.ndarray, np.ndarray]]) -> list[str]:
    import pyarrow as pa
    from pyarrow import parquet

    paths = []
    for k, (offset_arcsec, sigma) in enumerate(sides):
        columns = {"ra": 150.0 + offset_arcsec[0] / 3600.0, "dec": offset_arcsec[1] / 3600.0, "sigma": sigma}
        paths.append(str(folder / f"{k}.parquet"))
        parquet.write_table(pa.table(columns), paths[-1])
    return paths


def detections(folder: Path, n: int) -> list[str]:
    """n detections around one position on each of four exposures."""
    path = folder / "night.csv"
    lines = ["ra,dec,mjd"]
    for k in range(4):
        ra, dec = 150.0 + np.random.default_rng(k).normal(0.0, 0.2, (2, n)) / 3600.0
        lines += [f"{a:.8f},{b - 150.0:.8f},{60000.0 + k / 100.0}" for a, b in zip(ra, dec, strict=True)]
    path.write_text("\n".join(lines) + "\n")
    return [str(path), "--sigma", "0.2"]


def ships(folder: Path, n: int) -> list[str]:
    """AIS and radar reports of n ships around one position."""
    paths = []
    for name, column in (("ais", "mmsi"), ("radar", "track_id")):
        lines = [f"time,lat,lon,sog,cog,sigma,{column}"]
        rng = np.random.default_rng(len(name))
        for t in range(0, 60, 10):
            lines += [f"{1.7e9 + t},{50 + a:.7f},{-1 + b:.7f},0,0,15,{235_000_000 + k}"
                      for k, (a, b) in enumerate(rng.normal(0.0, 5e-5, (n, 2)))]  # fmt: skip
        paths.append(str(folder / f"{name}.csv"))
        Path(paths[-1]).write_text("\n".join(lines) + "\n")
    return [*paths, "--no-image", "--every", "30s"]


def _match(make: Callable[[Path], list[str]], verb: str = "match") -> Callable[[Path], list[str]]:
    return lambda folder: [verb, *make(folder), "-o", str(folder / "out.parquet")]


LOADS = (
    Load("1 000 against 1 000 within one error, in a field", _match(lambda f: field(f, 100_000, crowd=(1000, 0.1)))),
    Load("20 000 against 20 000 within an error, in a field", _match(lambda f: field(f, 100_000, crowd=(20_000, 0.1)))),
    Load("20 000 against 20 000 at one position, in a field", _match(lambda f: field(f, 100_000, crowd=(20_000, 0.0)))),
    Load("20 000 against 20 000 at one position, no other", _match(lambda f: stars(f, *[(20_000, 0.0, 1.0)] * 2))),
    Load("1 against 1 000 000 within its error", _match(lambda f: stars(f, (1, 0.1, 10.0), (1_000_000, 1.0, 0.1)))),
    Load("100 000, one error covers all", _match(wide_one)),
    Load("100 000, 1 000 positions are NaN", _match(lambda f: field(f, 100_000, 1000))),
    Load("100 000, errors 3 600 times too large", _match(lambda f: [*field(f, 100_000), "--sigma", "360"])),
    Load("3 000 000 against 3 000 000", _match(lambda f: field(f, 3_000_000)), moments=2),
    Load("many: 3 times 2 000 in a field", _match(lambda f: field(f, 20_000, crowd=(2000, 0.1), sides=3), "many")),
    Load("many: 3 times 300 in a field", _match(lambda f: field(f, 3000, crowd=(300, 0.1), sides=3), "many")),
    Load("movers: 4 times 1 000 at one place", lambda f: ["movers", *detections(f, 1000), "-o", str(f / "out.fits")]),
    Load("picture: 300 ships at one place", lambda f: ["picture", *ships(f, 300), "-o", str(f / "out")]),
)


@dataclass(frozen=True)
class Outcome:
    """One run: exit code, CPU seconds, peak memory in MB, last line of stderr."""

    code: int
    cpu_s: float
    peak_mb: float
    message: str


def run(arguments: list[str], interrupt_after_s: float = float("inf")) -> tuple[Outcome, float]:
    """Run a command in its own process; its outcome, and the seconds from Ctrl-C to its end."""
    with tempfile.TemporaryFile("w+") as stderr:
        process = subprocess.Popen([sys.executable, "-m", "sameas", *arguments, "--quiet"], stdout=subprocess.DEVNULL,
                                   stderr=stderr, preexec_fn=_limit_resources)  # fmt: skip
        answer_s, began = 0.0, time.monotonic()
        while time.monotonic() - began < interrupt_after_s:
            ended, status, used = os.wait4(process.pid, os.WNOHANG)
            if ended:
                break
            time.sleep(0.02)
        else:
            sent = time.monotonic()
            with suppress(ProcessLookupError):
                os.kill(process.pid, signal.SIGINT)
            _, status, used = os.wait4(process.pid, 0)
            answer_s = time.monotonic() - sent
        process.returncode = os.waitstatus_to_exitcode(status)
        stderr.seek(0)
        lines = stderr.read().strip().splitlines() or [""]
    return Outcome(process.returncode, used.ru_utime + used.ru_stime, used.ru_maxrss / 1024.0, lines[-1]), answer_s


def _limit_resources() -> None:
    signal.signal(signal.SIGINT, signal.default_int_handler)
    resource.setrlimit(resource.RLIMIT_CPU, (int(CPU_S), int(CPU_S)))
    resource.setrlimit(resource.RLIMIT_AS, (BYTES, BYTES))


def measured(load: Load, rng: random.Random) -> tuple[list[object], list[str]]:
    """The row of a load, and its faults."""
    faults, slowest_s, stopped = [], 0.0, 0
    with tempfile.TemporaryDirectory() as folder:
        arguments = load.make(Path(folder))
        began = time.monotonic()
        first, _ = run(arguments)
        run_s = time.monotonic() - began
        kind = {0: "answered", 1: "refused"}.get(first.code, f"exit code {first.code}")
        if first.code not in (0, 1) or "fault of sameas" in first.message or "Traceback" in first.message:
            faults.append(f"{load.name}: exit code {first.code}: {first.message}")
        for _ in range(load.moments):
            again, answer_s = run(arguments, rng.uniform(0.1, 1.0) * run_s)
            stopped += again.code == 130
            slowest_s = max(slowest_s, answer_s)
            if again.code not in (0, 1, 130, -signal.SIGINT) and "KeyboardInterrupt" not in again.message:
                faults.append(f"{load.name}, Ctrl-C: exit code {again.code}: {again.message}")
            if answer_s > ANSWER_S:
                faults.append(f"{load.name}, Ctrl-C: answered after {answer_s:.1f} s")
    message = "" if first.code == 0 else first.message.removeprefix("sameas: ").replace(f"{folder}/", "")
    return [load.name, kind, round(first.cpu_s, 1), round(first.peak_mb), stopped, round(slowest_s, 2), message], faults


def tables(only: str, rng: random.Random) -> Iterator[Table]:
    """The loads whose names contain ``only``."""
    rows, faults = [], []
    for load in LOADS:
        if only in load.name:
            row, faults_of_load = measured(load, rng)
            rows.append(row)
            faults += faults_of_load
            print(*row, *faults_of_load, sep="  ", flush=True)
    yield Table("Extreme inputs", COLUMNS, rows, faults)

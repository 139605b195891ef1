"""Time and memory of one task, run alone in its own process (``worker.py``) by any Python interpreter."""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parent.parent


@dataclass(frozen=True)
class Work:
    """A task: a function "module:name" of this package that returns the callable to time.

    options : the function's arguments. runs : timed calls, after one that warms up. at_most_s : no further run starts
    after this time. threads : SAMEAS_THREADS. python : the interpreter. cpu_time : measure the thread's CPU time,
    which other work on the machine hardly changes, instead of wall time.
    """

    function: str
    options: dict[str, Any] = field(default_factory=dict)
    runs: int = 7
    at_most_s: float = 240.0
    threads: int | None = None
    python: str = sys.executable
    cpu_time: bool = False


@dataclass(frozen=True)
class Measurement:
    """The runs of one task.

    seconds, returned : of each run. peak_mb : memory of the process during the runs. baseline_mb : the same before
    them. error : why there are no runs. not_installed : whether the reason is a program that is not installed.
    """

    seconds: tuple[float, ...] = ()
    peak_mb: float = float("nan")
    baseline_mb: float = float("nan")
    returned: tuple[Any, ...] = ()
    error: str = ""
    not_installed: bool = False

    @property
    def median(self) -> float:
        """Median time, NaN without runs."""
        return statistics.median(self.seconds) if self.seconds else float("nan")

    def quantile(self, share: float) -> float:
        """The time that a ``share`` of the runs did not exceed; the median for 0.5; NaN without runs."""
        if share == 0.5:
            return self.median
        ordered = sorted(self.seconds)
        return ordered[min(len(ordered) - 1, int(share * len(ordered)))] if ordered else float("nan")


def measure(work: Work) -> Measurement:
    """Run the task in its own process; a failure is returned in ``error``, not raised."""
    task = {name: getattr(work, name) for name in ("function", "options", "runs", "at_most_s", "cpu_time")}
    paths = [str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths), "PYTHONWARNINGS": "ignore"}
    if work.threads is not None:
        environment["SAMEAS_THREADS"] = str(work.threads)
    done = subprocess.run(
        [work.python, "-m", "benchmarks.worker"], input=json.dumps(task, default=str), text=True,
        capture_output=True, cwd=ROOT, env=environment, check=False,
    )  # fmt: skip
    lines = done.stdout.splitlines()
    if done.returncode or not lines:
        stderr = done.stderr.strip().splitlines() or [f"ended with {done.returncode}"]
        return Measurement(error=stderr[-1][:200])
    answer = json.loads(lines[-1])
    children = [r["peak_mb"] for r in answer["returned"] if isinstance(r, dict) and "peak_mb" in r]
    return Measurement(
        tuple(answer["seconds"]), max(children) if children else answer["peak_mb"],
        0.0 if children else answer["baseline_mb"], tuple(answer["returned"]),
    )  # fmt: skip

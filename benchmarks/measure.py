"""Time and memory of one piece of work, alone in a process of its own (``worker.py``), in any interpreter."""

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
    """A function "module:name" of this package whose result, called again and again, is what is timed.

    options : its arguments. runs : how often, after one run to warm up. at_most_s : no further run starts after it.
    threads : SAMEAS_THREADS. python : another interpreter. processor : whether a run's time is what its thread takes of
    the processor, which other work on the machine hardly changes.
    """

    function: str
    options: dict[str, Any] = field(default_factory=dict)
    runs: int = 7
    at_most_s: float = 240.0
    threads: int | None = None
    python: str = sys.executable
    processor: bool = False


@dataclass(frozen=True)
class Measurement:
    """seconds of each run; peak and resting memory of the process in MB; what the runs returned.

    missing : why there is none; absent : because it is not installed.
    """

    seconds: tuple[float, ...] = ()
    peak_mb: float = float("nan")
    resting_mb: float = float("nan")
    returned: tuple[Any, ...] = ()
    missing: str = ""
    absent: bool = False

    @property
    def median(self) -> float:
        """Median time, NaN where there is none."""
        return statistics.median(self.seconds) if self.seconds else float("nan")

    def quantile(self, share: float) -> float:
        """The time that a ``share`` of the runs did not exceed."""
        ordered = sorted(self.seconds)
        return ordered[min(len(ordered) - 1, int(share * len(ordered)))] if ordered else float("nan")


def measure(work: Work) -> Measurement:
    """The work done in a process of its own; a failure is told in ``missing``, not raised."""
    order = {name: getattr(work, name) for name in ("function", "options", "runs", "at_most_s", "processor")}
    paths = [str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths), "PYTHONWARNINGS": "ignore"}
    if work.threads is not None:
        environment["SAMEAS_THREADS"] = str(work.threads)
    done = subprocess.run(
        [work.python, "-m", "benchmarks.worker"], input=json.dumps(order, default=str), text=True,
        capture_output=True, cwd=ROOT, env=environment, check=False,
    )  # fmt: skip
    lines = done.stdout.splitlines()
    if done.returncode or not lines:
        said = done.stderr.strip().splitlines() or [f"ended with {done.returncode}"]
        return Measurement(missing=said[-1][:200])
    answer = json.loads(lines[-1])
    children = [r["peak_mb"] for r in answer["returned"] if isinstance(r, dict) and "peak_mb" in r]
    return Measurement(
        tuple(answer["seconds"]), max(children) if children else answer["peak_mb"],
        0.0 if children else answer["resting_mb"], tuple(answer["returned"]),
    )  # fmt: skip

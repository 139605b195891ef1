"""Runs one task: reads it as JSON from standard input, times it, and writes one line of JSON.

Only the standard library is imported here, because Linux counts the parent's memory in a child's ``ru_maxrss``.
"""

from __future__ import annotations

import gc
import importlib
import json
import sys
import time
from contextlib import suppress
from pathlib import Path


def main() -> None:
    """Warm up, then time every run; the peak memory is that of the timed runs only."""
    task = json.load(sys.stdin)
    module, name = task["function"].split(":")
    work = getattr(importlib.import_module(module), name)(**task["options"])
    begin = time.monotonic()
    if getattr(work, "warm", True):
        work()
    gc.collect()
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")  # resets the peak
    baseline = status_mb("VmRSS")
    clock = time.thread_time if task["cpu_time"] else time.perf_counter
    seconds: list[float] = []
    returned: list[object] = []
    while len(seconds) < task["runs"] and (not seconds or time.monotonic() - begin < task["at_most_s"]):
        start = clock()
        value = work()
        seconds.append(clock() - start)
        returned.append(value)
    answer = {"seconds": seconds, "peak_mb": status_mb("VmHWM"), "baseline_mb": baseline, "returned": returned}
    print(json.dumps(answer, default=float))


def status_mb(field: str) -> float:
    """Memory of this process by its name in /proc/self/status; NaN where there is none."""
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        return float("nan")
    return next((float(line.split()[1]) / 1024 for line in lines if line.startswith(field + ":")), float("nan"))


if __name__ == "__main__":
    main()

"""Whole processes: wall time and peak memory of a command. Imports the standard library only, like ``worker.py``."""

from __future__ import annotations

import os
import subprocess
import time
from collections.abc import Callable
from pathlib import Path


class Process:
    """A command to time; raises if it fails. ``output`` is a file that is deleted before each run."""

    def __init__(self, command: list[str], output: str | None = None, environment: dict[str, str] | None = None):
        self.command, self.output = command, output
        self.environment = os.environ | (environment or {})
        # An installed package has its bytecode; a process that may not write it would compile all modules every time.
        self.environment.pop("PYTHONDONTWRITEBYTECODE", None)

    def __call__(self) -> dict[str, float]:
        if self.output:
            Path(self.output).unlink(missing_ok=True)
        running = subprocess.Popen(
            self.command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, env=self.environment
        )
        stderr = running.stderr.read() if running.stderr else ""
        _, status, usage = os.wait4(running.pid, 0)
        running.returncode = os.waitstatus_to_exitcode(status)
        if running.returncode:
            raise RuntimeError(f"{self.command[0]}: {stderr.strip()[-300:]}")
        return {"peak_mb": usage.ru_maxrss / 1024}


def process(command: list[str], output: str | None = None, environment: dict[str, str] | None = None) -> Callable:
    """The command as a task for ``worker.py``."""
    return Process(command, output, environment)


def stages_of_match(first: str, second: str, out: str) -> Callable[[], dict[str, float]]:
    """Seconds of every stage of `sameas.match` of two files, everything estimated, table written.

    The stages are those that ``progress`` names, and the import; needs a process that has not imported `sameas`.
    """

    def work() -> dict[str, float]:
        seconds: dict[str, float] = {}
        last, stage = time.perf_counter(), "import"

        def begin(next_stage: str) -> None:
            nonlocal last, stage
            now = time.perf_counter()
            seconds[stage] = seconds.get(stage, 0.0) + now - last
            last, stage = now, next_stage

        import sameas

        begin("reading")
        found = sameas.match(first, second, progress=begin)
        begin("joining and writing")
        found.write(out)
        begin("")
        return seconds

    work.warm = False  # type: ignore[attr-defined]
    return work


def first_ever(command: list[str], cache: str) -> Callable:
    """The command without compiled kernels: their cache is emptied before every run."""
    import shutil

    cold = Process(command, environment={"NUMBA_CACHE_DIR": cache})

    def work() -> dict[str, float]:
        shutil.rmtree(cache, ignore_errors=True)
        return cold()

    work.warm = False  # type: ignore[attr-defined]
    return work

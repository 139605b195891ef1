"""Whole processes: how long a command takes from its start to its end, and how much memory. No imports to speak of."""

from __future__ import annotations

import os
import subprocess
import time
from collections.abc import Callable
from pathlib import Path


class Process:
    """A command to be timed; it fails loudly. ``before`` is a file that must not exist when it starts."""

    def __init__(self, command: list[str], before: str | None = None, environment: dict[str, str] | None = None):
        self.command, self.before = command, before
        self.environment = os.environ | (environment or {})
        # An installed package has its bytecode; a process that may not write it would compile all modules anew.
        self.environment.pop("PYTHONDONTWRITEBYTECODE", None)
        #: A process needs no warming up: it is all there is to measure.
        self.warm = True

    def __call__(self) -> dict[str, float]:
        if self.before:
            Path(self.before).unlink(missing_ok=True)
        running = subprocess.Popen(
            self.command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, env=self.environment
        )
        said = running.stderr.read() if running.stderr else ""
        _, status, usage = os.wait4(running.pid, 0)
        running.returncode = os.waitstatus_to_exitcode(status)
        if running.returncode:
            raise RuntimeError(f"{self.command[0]}: {said.strip()[-300:]}")
        return {"peak_mb": usage.ru_maxrss / 1024}


def process(command: list[str], before: str | None = None, environment: dict[str, str] | None = None) -> Callable:
    """The command as work for the worker."""
    return Process(command, before, environment)


def stages_of_match(first: str, second: str, out: str) -> Callable[[], dict[str, float]]:
    """`sameas.match` of two files, everything estimated, and its table written, from before the import on: seconds of
    every stage, as its ``progress`` names them. In a process that has imported nothing yet."""

    def work() -> dict[str, float]:
        seconds: dict[str, float] = {}
        last, stage = time.perf_counter(), "import"

        def begins(next_stage: str) -> None:
            nonlocal last, stage
            now = time.perf_counter()
            seconds[stage] = seconds.get(stage, 0.0) + now - last
            last, stage = now, next_stage

        import sameas

        begins("reading")
        found = sameas.match(first, second, progress=begins)
        begins("joining and writing")
        found.write(out)
        begins("")
        return seconds

    work.warm = False  # type: ignore[attr-defined]
    return work


def first_ever(command: list[str], cache: str) -> Callable:
    """The command with nothing compiled beforehand: its cache of compiled kernels is emptied before every run."""
    import shutil

    cold = Process(command, environment={"NUMBA_CACHE_DIR": cache})

    def work() -> dict[str, float]:
        shutil.rmtree(cache, ignore_errors=True)
        return cold()

    work.warm = False  # type: ignore[attr-defined]
    return work

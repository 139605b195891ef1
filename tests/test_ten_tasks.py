"""The ten tasks of a new user are one command or one cell each; run as a program this file times them.

What the page says they print is tested with the other pages (test_docs.py).
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import resource
import shlex
import subprocess
import sys
import tempfile
import time
import types
from dataclasses import dataclass
from pathlib import Path

import pytest

HOME = Path(__file__).parents[1]
PAGE = HOME / "docs" / "tasks" / "ten.md"
FENCE = re.compile(r"^```(python|console)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
#: The tasks of a new user, by a word of the heading.
WANTED = ("catalogues", "Three", "prior", "Why", "plate", "frames", "map", "radar", "without|no radar", "pandas")


@dataclass(frozen=True)
class Task:
    """A heading and its one block."""

    heading: str
    kind: str
    code: str

    @property
    def command(self) -> list[str]:
        """The words of the command that the console block shows."""
        (line,) = re.findall(r"^\$ (.*)$", self.code, re.MULTILINE)
        return shlex.split(line)


def page() -> tuple[str, list[Task]]:
    """The block that makes the files, and the tasks."""
    head, *parts = re.split(r"^## ", PAGE.read_text(encoding="utf-8"), flags=re.MULTILINE)
    ((_, setting),) = FENCE.findall(head)
    tasks = []
    for part in parts:
        ((kind, code),) = FENCE.findall(part)
        tasks.append(Task(part.partition("\n")[0], kind, code))
    return setting, tasks


def timed(folder: Path) -> list[tuple[str, float, float]]:
    """Each task's heading, seconds and seconds of CPU."""
    setting, tasks = page()
    module = types.ModuleType("page")
    os.chdir(folder)
    exec(compile(setting, str(PAGE), "exec"), vars(module))
    found = []
    for task in tasks:
        began, used = time.perf_counter(), _cpu()
        if task.kind == "python":
            with contextlib.redirect_stdout(io.StringIO()):
                exec(compile(task.code, str(PAGE), "exec"), vars(module))
        else:
            program, *arguments = task.command
            assert program == "sameas"
            done = subprocess.run(
                [sys.executable, "-m", "sameas", *arguments], capture_output=True, text=True, check=False
            )
            assert done.returncode == 0, f"{task.heading}: {done.stdout}{done.stderr}"
        found.append((task.heading, time.perf_counter() - began, _cpu() - used))
    return found


def _cpu() -> float:
    parts = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(part.ru_utime + part.ru_stime for part in parts)


def test_each_task_is_one_command_or_one_cell():
    _, tasks = page()
    assert [task.heading.partition(".")[0] for task in tasks] == [str(k) for k in range(1, 11)]
    for task, word in zip(tasks, WANTED, strict=True):
        assert re.search(word, task.heading), task.heading
        if task.kind == "console":
            # No pipe, no second command, nothing but our own program.
            assert task.command[0] == "sameas" and not set(task.command) & {"|", "&&", ";"}


@pytest.mark.long
def test_the_ten_tasks_run_in_order(tmp_path, monkeypatch):
    for package in ("photutils", "pymap3d", "pandas", "matplotlib"):
        pytest.importorskip(package, reason="the ten tasks need the extras sameas[all]")
    monkeypatch.chdir(tmp_path)
    found = timed(tmp_path)
    assert len(found) == 10
    there = ("best.fits", "objects.fits", "by-brightness.fits", "identified.fits", "night-identified/index.html")
    for name in (*there, *(f"{folder}/map.html" for folder in ("ais-map", "both", "without-radar"))):
        assert (tmp_path / name).stat().st_size > 10_000, name


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as place:
        print(f"{'task':58} seconds   CPU")
        for heading, seconds, cpu in timed(Path(place)):
            print(f"{heading:58} {seconds:7.1f} {cpu:5.1f}")

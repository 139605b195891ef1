"""The terminal: text on stdout, notices and progress on stderr. Control characters from files are escaped."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Iterable
from functools import cached_property
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, TextIO

from sameas.errors import printable
from sameas.report.prose import ALARM, DOUBT, wrapped

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress

#: Seconds before progress is shown.
PATIENCE = 2.0
#: Environment variables that request colours without a terminal, as in rich.
_COLOURED = ("FORCE_COLOR", "TTY_COMPATIBLE", "TTY_INTERACTIVE")
#: Labels of lines that are printed even with --quiet, and their styles.
_STYLES = {DOUBT: "yellow", ALARM: "bold red"}


class Printer:
    """Prints lines of a report. Headings start at the margin, everything else is indented.

    out : where to; stdout unless data are written there.
    """

    def __init__(self, quiet: bool, out: TextIO | None = None) -> None:
        self.quiet, self.out = quiet, sys.stdout if out is None else out

    def __call__(self, lines: Iterable[str]) -> None:
        """Print lines; if quiet, only doubts and alarms, on stderr."""
        for line in map(printable, lines):
            label = next((label for label in _STYLES if line.startswith(label)), None)
            if self.quiet:
                if label is not None:
                    notice(f"{label.strip()}: {line[len(label) :]}")
                continue
            style = _STYLES[label] if label else "bold" if line[:1].strip() else None
            for part in wrapped(line) if label else [line]:
                self._print(part, style)

    @cached_property
    def _console(self) -> Console | None:
        """A console for colours; None without a terminal: rich takes longer to import than everything to print."""
        if not (self.out.isatty() or any(map(os.environ.get, _COLOURED))):
            return None
        from rich.console import Console

        return Console(file=self.out, highlight=False, markup=False, emoji=False, soft_wrap=True)

    def _print(self, line: str, style: str | None) -> None:
        try:
            if self._console is None:
                self.out.write(f"{line}\n")
                self.out.flush()
            else:
                self._console.print(line, style=style)
        except (BrokenPipeError, SystemExit):  # rich ends the process where a reader has gone
            # The reader of stdout (head, less) has gone; the output file is still to be written.
            os.dup2(os.open(os.devnull, os.O_WRONLY), self.out.fileno())
            self.quiet = True


class Pace:
    """Shows progress on a terminal after two seconds. Call it with the name of each stage."""

    def __init__(self, quiet: bool) -> None:
        self.shown = not quiet and sys.stderr.isatty()
        self.stage = ""
        self.bar: Progress | None = None
        self.lock = threading.Lock()
        self.timer = threading.Timer(PATIENCE, self._show)
        self.timer.daemon = True

    def __enter__(self) -> Pace:
        if self.shown:
            self.timer.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self.lock:
            self.timer.cancel()
            self.shown = False
            if self.bar is not None:
                self.bar.stop()

    def __call__(self, stage: str) -> None:
        """Begin the next stage."""
        with self.lock:
            self.stage = stage
            if self.bar is not None:
                self.bar.update(self.bar.task_ids[0], description=stage)
                self.bar.start()

    def pause(self) -> None:
        """Clear the progress bar before printing; the next stage shows it again."""
        with self.lock:
            if self.bar is not None:
                self.bar.stop()

    def _show(self) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

        with self.lock:
            if self.shown:
                self.bar = Progress(
                    TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(),
                    console=Console(stderr=True), transient=True,
                    redirect_stdout=False, redirect_stderr=False,
                )  # fmt: skip
                self.bar.add_task(self.stage, total=None)
                self.bar.start()


def notice(message: str) -> None:
    """One line on stderr."""
    sys.stderr.write(f"sameas: {printable(message)}\n")


def share_compilation(quiet: bool, result: str = "match") -> None:
    """If kernels have to be compiled, compile some of them in a second process; announce it unless quiet.

    result : what the command makes, "match", "frame" or "picture".
    """
    from sameas.kernels import compiled

    def in_second_process(cache: Path) -> None:
        from sameas.cli import warmup

        warmup.start_second_process(cache, result)

    compiled.on_first_compilation[:] = [in_second_process] if quiet else [compiled.announce, in_second_process]

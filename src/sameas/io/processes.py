"""Worker processes: started without the caller's script, deaf to Ctrl-C, ended with the process that started them."""

from __future__ import annotations

import logging
import os
import signal
import sys
import threading
import types
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from typing import ParamSpec, TypeVar

from sameas.io.atomic import end_with_parent

P = ParamSpec("P")
R = TypeVar("R")
LOG = logging.getLogger("sameas")
#: Added to the niceness of the process of :class:`Aside`: its parent comes first, also on a single core.
NICENESS = 10


@contextmanager
def without_script() -> Iterator[None]:
    """Processes started within it do not import the caller's script: scripts need no ``if __name__ == "__main__"``."""
    main = sys.modules["__main__"]
    sys.modules["__main__"] = types.ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = main


def begin_worker() -> None:
    """Initialise a worker.

    A terminal sends SIGINT to all processes; the main process ends its workers. A worker watches the main process and
    not its own parent, which may be a fork server that lives as long as its workers do.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_with_parent()


class Aside:
    """Calls functions in a process of low priority, if their work is large; it is started when first needed.

    A thread would hold the interpreter for half of the time, and what has to be in time would take two to three times
    as long meanwhile.

    least : work below which the process, of some 250 MB, is not worth it.
    """

    def __init__(self, least: int) -> None:
        self.least = least
        self._pool: ProcessPoolExecutor | None = None
        self._lock = threading.Lock()

    def call(self, work: int, function: Callable[P, R], *arguments: P.args, **named: P.kwargs) -> R:
        """The result of a function, in this process if the other one dies; from any thread.

        Raises Exception: what the function raises.
        """
        if work >= self.least:
            try:
                return self._submitted(function, *arguments, **named).result()
            except BrokenProcessPool as error:
                LOG.info("no process beside this one: %r", error)
                self._pool = None
        return function(*arguments, **named)

    def _submitted(self, function: Callable[P, R], *arguments: P.args, **named: P.kwargs) -> Future[R]:
        with self._lock, without_script():
            try:
                if self._pool is None:
                    import multiprocessing

                    context = multiprocessing.get_context("spawn")
                    self._pool = ProcessPoolExecutor(1, mp_context=context, initializer=_begin_aside)
                return self._pool.submit(function, *arguments, **named)
            except (OSError, ImportError, NotImplementedError) as error:
                # As where the memory does not suffice for another process, or the system has no shared semaphores.
                raise BrokenProcessPool("the process cannot be started") from error

    def close(self) -> None:
        """Ends the process; calls that wait are not begun."""
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)
            self._pool = None


def _begin_aside() -> None:
    from sameas.kernels import compiled

    begin_worker()
    if hasattr(os, "nice"):
        os.nice(NICENESS)
    # The parent announces what is compiled.
    compiled.on_first_compilation.clear()

"""Worker processes that share a folder: every worker reads the settings of all parts from it, once.

A worker's functions take the folder and a task. Workers share nothing else.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

from sameas.errors import InputError
from sameas.io.processes import begin_worker, without_script
from sameas.io.saved import dumps, loads
from sameas.kernels import threads
from sameas.partitions.hats import Cell, written_whole
from sameas.partitions.part import Work

T = TypeVar("T")
R = TypeVar("R")
#: Workers may die this many times in a row before the run stops, if no task ends in between.
MAX_FAILURES = 3


def store(work: Work, folder: Path) -> None:
    """Write the common settings to a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    if work.learned is not None:
        work.learned.places.write(folder / "places")
        bare = replace(work.learned, places=work.learned.places.without_columns(), estimate=None)
        work = replace(work, learned=bare)
    written_whole(folder / "work.pickle", dumps(work))


def stored_work(folder: str) -> Work:
    """The settings that :func:`store` wrote."""
    return _read_work(folder, (Path(folder) / "work.pickle").stat().st_mtime_ns)


@lru_cache(maxsize=2)
def _read_work(folder: str, time_ns: int) -> Work:
    path = Path(folder) / "work.pickle"
    work: Work = loads(path.read_bytes(), str(path))
    if work.learned is None:
        return work
    places = work.learned.places.with_columns(Path(folder) / "places")
    return replace(work, learned=replace(work.learned, places=places))


class Workers:
    """A context manager of worker processes, or of the caller's executor.

    number : of processes, default one a processor. executor : used instead of processes of our own.
    """

    def __init__(self, number: int | None = None, executor: Executor | None = None) -> None:
        self.number = threads.count() if number is None else number
        if self.number < 1:
            raise InputError(f"workers is {number}; give 1 or more")
        self.executor = executor
        self._own: ProcessPoolExecutor | None = None

    def alone(self) -> Workers:
        """One task at a time in this process, unless there is an executor."""
        return Workers(1, self.executor)

    def __enter__(self) -> Workers:
        return self

    def __exit__(self, *error: object) -> None:
        if self._own is not None:
            self._own.shutdown(wait=error[0] is None, cancel_futures=True)
            self._own = None

    def each(self, work: Callable[[str, T], R], folder: str, tasks: Sequence[T]) -> Iterator[tuple[T, R]]:
        """Tasks and their results, in the order of completion.

        Raises InputError: raised by a task; or workers keep dying: names the tasks that they were at.
        """
        if self.executor is None and self.number == 1:
            for task in tasks:
                yield task, work(folder, task)
            return
        left, failures = list(tasks), 0
        while left:
            done = []
            try:
                for task, result in self._completed(work, folder, left):
                    done.append(task)
                    yield task, result
            except BrokenProcessPool as error:
                failures = 1 if done else failures + 1
                self._own = None
                if failures >= MAX_FAILURES:
                    at = ", ".join(str(_cell_of_task(task)) for task in left[: len(done) + self.number][:3])
                    raise InputError(
                        f"workers died {failures} times, at one of the partitions {at} …; finished parts are kept",
                        "give fewer workers if memory ran out, and call again",
                    ) from error
            finished = {id(task) for task in done}
            left = [task for task in left if id(task) not in finished]

    def _completed(self, work: Callable[[str, T], R], folder: str, tasks: Sequence[T]) -> Iterator[tuple[T, R]]:
        """Tasks and their results, until a worker dies."""
        pool = self._pool()
        with without_script():
            futures: dict[Future[R], T] = {pool.submit(work, folder, task): task for task in tasks}
        for future in as_completed(futures):
            yield futures[future], future.result()

    def _pool(self) -> Executor:
        if self.executor is not None:
            return self.executor
        if self._own is None:
            import multiprocessing

            # With a fork server, one process imports everything and workers are forked from it.
            can_fork = "forkserver" in multiprocessing.get_all_start_methods()
            context: Any = multiprocessing.get_context("forkserver" if can_fork else "spawn")
            if can_fork:
                context.set_forkserver_preload(list(_PRELOADED))
            self._own = ProcessPoolExecutor(self.number, mp_context=context, initializer=_begin_worker)
        return self._own


def _cell_of_task(task: Any) -> Any:
    return next((part for part in task if isinstance(part, Cell)), task)


#: Modules that the fork server imports.
_PRELOADED = ("sameas.partitions.run", "sameas._identify", "numba", "pyarrow.parquet", "pyarrow.compute", "cdshealpix",
           "scipy.spatial", "astropy.table", "astropy.coordinates")  # fmt: skip


def _begin_worker() -> None:
    """Let a worker use one thread."""
    os.environ["SAMEAS_THREADS"] = "1"
    begin_worker()

"""Threads: their number, and parallel runs of compiled loops over independent ranges."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import pairwise
from typing import TypeVar

T = TypeVar("T")
U = TypeVar("U")


def count() -> int:
    """Number of threads: SAMEAS_THREADS if set, else the number of processors that this process may use."""
    setting = os.environ.get("SAMEAS_THREADS", "")
    if setting.isdigit() and int(setting) > 0:
        return int(setting)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def over(work: Callable[[int, int], T], bounds: Sequence[int]) -> list[T]:
    """``work(bounds[t], bounds[t + 1])`` for every t, in parallel; results in the order of the ranges.

    There may be more ranges than threads, each of which then takes the next one.
    """
    ranges = [(int(a), int(b)) for a, b in pairwise(bounds) if b > a]
    if len(ranges) <= 1:
        return [work(a, b) for a, b in ranges]
    with ThreadPoolExecutor(min(len(ranges), count())) as pool:
        return list(pool.map(lambda r: work(*r), ranges))


def each(works: Sequence[Callable[[], T]], size: int) -> list[T]:
    """The results of several independent functions, run in parallel if ``size`` items make two ranges or more."""
    if len(even(size)) <= 2:
        return [work() for work in works]
    with ThreadPoolExecutor(min(len(works), count())) as pool:
        return [future.result() for future in [pool.submit(work) for work in works]]


def both(one: Callable[[], T], other: Callable[[], U], size: int) -> tuple[T, U]:
    """:func:`each` for two functions of different result types."""
    results: list[T | U] = each([one, other], size)
    return results[0], results[1]


def started(work: Callable[[], T]) -> Callable[[], T]:
    """Start ``work`` in a thread that does not keep the process alive; the returned function waits for its result."""
    future: Future[T] = Future()

    def run() -> None:
        try:
            future.set_result(work())
        except BaseException as error:
            future.set_exception(error)

    threading.Thread(target=run, daemon=True).start()
    return future.result


def even(n: int, least: int = 4096) -> list[int]:
    """Bounds that divide n items into one range for each thread, or fewer so that none is smaller than ``least``."""
    if n < 2 * least:
        return [0, n]
    parts = max(1, min(count(), n // least))
    return [n * t // parts for t in range(parts + 1)]

"""How many threads the compiled loops use, and running them side by side over independent ranges."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import TypeVar

T = TypeVar("T")
U = TypeVar("U")


def count() -> int:
    """SAMEAS_THREADS where it is set, else the number of processors this process may run on."""
    given = os.environ.get("SAMEAS_THREADS", "")
    if given.isdigit() and int(given) > 0:
        return int(given)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def over(work: Callable[[int, int], T], bounds: Sequence[int]) -> list[T]:
    """``work(bounds[t], bounds[t + 1])`` for every t, side by side; results in the order of the ranges."""
    ranges = [(int(a), int(b)) for a, b in pairwise(bounds) if b > a]
    if len(ranges) <= 1:
        return [work(a, b) for a, b in ranges]
    with ThreadPoolExecutor(len(ranges)) as pool:
        return list(pool.map(lambda r: work(*r), ranges))


def each(works: Sequence[Callable[[], T]], size: int) -> list[T]:
    """The results of several independent pieces of work, side by side where that is worth it for ``size`` items."""
    if len(even(size)) <= 2:
        return [work() for work in works]
    with ThreadPoolExecutor(min(len(works), count())) as pool:
        return [future.result() for future in [pool.submit(work) for work in works]]


def both(one: Callable[[], T], other: Callable[[], U], size: int) -> tuple[T, U]:
    """The same of two pieces of work of different kinds."""
    made: list[T | U] = each([one, other], size)
    return made[0], made[1]


def even(n: int, least: int = 4096) -> list[int]:
    """Bounds that cut n items in as many even ranges as there are threads, none smaller than ``least``."""
    if n < 2 * least:
        return [0, n]
    parts = max(1, min(count(), n // least))
    return [n * t // parts for t in range(parts + 1)]

"""Trials: every contender decides the scenes of a point of the study, in blocks, over all cores.

Scenes come in blocks of :data:`BLOCK`; every block has its own generator, seeded by the study's seed, the point and the
block. A run of more scenes repeats those of a shorter one, and the answer does not depend on the number of processes.
"""

from __future__ import annotations

import os
import time
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from functools import reduce
from multiprocessing import get_context
from operator import add
from typing import Any

import numpy as np

from benchmarks.study.contenders import Contender
from benchmarks.study.scenes import Formation
from benchmarks.study.tally import Tally, count, rightly
from sameas.kernels import threads

#: Scenes of a block, and of a piece of work for one process.
BLOCK = 250
PIECE = 1000
SEED = 20261121


@dataclass(frozen=True)
class Point:
    """One point of the study: a formation, and the contenders that decide its scenes.

    experiment : it belongs to. name : seeds the scenes, unless ``scenes_of`` is given, by which points share scenes.
    share : of the scenes that are used, below 1 for slow contenders.
    """

    experiment: str
    name: str
    formation: Formation
    contenders: tuple[Contender, ...]
    share: float = 1.0
    scenes_of: str = ""


@dataclass(frozen=True)
class Outcome:
    """The result of a point: the tally of every contender, in the order of the point."""

    point: Point
    tallies: tuple[Tally, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """The contenders' names."""
        return tuple(contender.name for contender in self.point.contenders)

    def of(self, name: str) -> Tally:
        """The tally of a contender."""
        return self.tallies[self.names.index(name)]


def generator(name: str, block: int) -> np.random.Generator:
    """The generator of a block of a point."""
    return np.random.default_rng([SEED, zlib.crc32(name.encode()), block])


def tallies(point: Point, blocks: Sequence[int]) -> tuple[Tally, ...]:
    """Every contender's tally over some blocks of a point."""
    sums: list[list[Tally]] = [[] for _ in point.contenders]
    for block in blocks:
        scenes = point.formation(generator(point.scenes_of or point.name, block), BLOCK)
        reference = None
        for contender, parts in zip(point.contenders, sums, strict=True):
            start = time.perf_counter()
            verdict = contender(scenes, point.formation)
            parts.append(count(scenes, verdict, time.perf_counter() - start, reference))
            reference = rightly(scenes, verdict) if reference is None else reference
    return tuple(reduce(add, parts) for parts in sums)


def run(points: Iterable[Point], scenes: int, progress: Callable[[int, int, str], None] | None = None) -> list[Outcome]:
    """The outcomes of the points with ``scenes`` scenes each, rounded up to whole blocks.

    progress : called with pieces done, pieces in all and the name of the experiment.
    """
    listed = list(points)
    pieces = [(number, part) for number, point in enumerate(listed) for part in _parts(point, scenes)]
    results: dict[int, list[tuple[int, tuple[Tally, ...]]]] = {number: [] for number in range(len(listed))}
    work = [(tallies, (listed[number], part)) for number, part in pieces]
    for done, (at, result) in enumerate(in_parallel(work), start=1):
        number, part = pieces[at]
        results[number].append((part[0], result))
        if progress is not None:
            progress(done, len(pieces), listed[number].experiment)
    outcomes = []
    for number, point in enumerate(listed):
        parts = [result for _, result in sorted(results[number], key=lambda entry: entry[0])]
        outcomes.append(Outcome(point, tuple(reduce(add, column) for column in zip(*parts, strict=True))))
    return outcomes


def _parts(point: Point, scenes: int) -> list[range]:
    blocks = max(1, -(-int(scenes * point.share) // BLOCK))
    step = PIECE // BLOCK
    return [range(k, min(k + step, blocks)) for k in range(0, blocks, step)]


def in_parallel(work: Sequence[tuple[Callable[..., Any], tuple[Any, ...]]]) -> Iterator[tuple[int, Any]]:
    """(index in ``work``, result) in the order of completion, from one process per processor."""
    workers = min(threads.count(), len(work))
    if workers <= 1:
        for at, (function, arguments) in enumerate(work):
            yield at, function(*arguments)
        return
    # New processes, not forks: threads of compiled loops do not survive a fork.
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn"), initializer=_single_threaded) as pool:
        futures = {pool.submit(function, *arguments): at for at, (function, arguments) in enumerate(work)}
        for future in as_completed(futures):
            yield futures[future], future.result()


def _single_threaded() -> None:
    """Limit this process to one thread."""
    for name in ("SAMEAS_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ[name] = "1"

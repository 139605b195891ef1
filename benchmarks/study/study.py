"""The study: runs the experiments over all cores and collects their results."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import reduce
from operator import add

from benchmarks.study import experiments, mori, several
from benchmarks.study.priors import Priors, compared
from benchmarks.study.several import Counts, Several
from benchmarks.study.stonesoup import is_installed
from benchmarks.study.tally import Ratio, Tally
from benchmarks.study.trial import Outcome, generator, in_parallel, run
from sameas.errors import InputError
from sameas.many.identify import identify_many
from sameas.many.rules import PoissonObjects

#: Groups on which the priors are compared.
GROUPS = 2000
#: Called with experiment, pieces done, pieces in all.
Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class MoriPoint:
    """Mori's formula and simulation at one density."""

    features: int
    density: float
    formula: float
    simulated: Ratio


@dataclass(frozen=True)
class Crowd:
    """Time and groups of ``identify_many`` on 200 targets of six sources."""

    records: int
    largest_group: int
    unproved_groups: int
    seconds: float


@dataclass(frozen=True)
class Study:
    """Results of the experiments; empty for those that were not run.

    scenes : requested per point. seconds : duration of the run. load : of the machine at the start, NaN if not known.
    stone_soup : whether Stone Soup is installed.
    """

    scenes: int
    outcomes: tuple[Outcome, ...] = ()
    several: tuple[tuple[Several, Counts], ...] = ()
    crowd: Crowd | None = None
    mori: tuple[MoriPoint, ...] = ()
    priors: Priors | None = None
    seconds: float = 0.0
    load: float = math.nan
    stone_soup: bool = field(default_factory=is_installed)

    def experiment(self, name: str) -> list[Outcome]:
        """The outcomes of an experiment."""
        return [outcome for outcome in self.outcomes if outcome.point.experiment == name]

    def tally(self, experiment: str, point: str, contender: str) -> Tally | None:
        """A contender's tally at a point, None if it is not there."""
        for outcome in self.experiment(experiment):
            if outcome.point.name == point and contender in outcome.names:
                return outcome.of(contender)
        return None


def studied(scenes: int, only: Sequence[str] = (), progress: Progress | None = None) -> Study:
    """The study with ``scenes`` scenes per point.

    Parameters
    ----------
    only : experiments to run, of :data:`benchmarks.study.experiments.NAMES`; default all.
    progress : called with the experiment, its pieces done, and its pieces in all.
    """
    unknown = sorted(set(only) - set(experiments.NAMES))
    if unknown:
        raise InputError(f"no experiment is called {unknown[0]}; give one of {', '.join(experiments.NAMES)}")
    if scenes < 2:
        raise InputError(f"scenes is {scenes}; give at least 2, 4000 for a run to be published")
    selected, start = only or experiments.NAMES, time.perf_counter()
    progress = progress or (lambda name, done, total: None)
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else math.nan
    makers = {"claims": experiments.claims, "spacing": experiments.spacing, "formations": experiments.formations,
              "wrong": experiments.wrong}  # fmt: skip
    points = [point for name, make in makers.items() if name in selected for point in make()]
    return Study(
        scenes,
        outcomes=tuple(run(points, scenes, lambda done, total, _: progress("rules", done, total))),
        several=tuple(_several(scenes, progress)) if "several" in selected else (),
        crowd=_crowd() if "several" in selected else None,
        mori=tuple(_mori(scenes, progress)) if "mori" in selected else (),
        priors=compared(GROUPS) if "priors" in selected else None,
        seconds=time.perf_counter() - start,
        load=load,
    )


def _several(scenes: int, progress: Progress) -> Iterator[tuple[Several, Counts]]:
    listed = experiments.several(scenes)
    blocks = [(at, block) for at, x in enumerate(listed) for block in range(-(-x.scenes // several.TOGETHER))]
    # The longest first, so that no core idles at the end.
    blocks.sort(key=lambda entry: -len(listed[entry[0]].formation.q))
    parts: dict[int, dict[int, Counts]] = {at: {} for at in range(len(listed))}
    work = [(several.counts, (listed[at], block)) for at, block in blocks]
    for done, (place, result) in enumerate(in_parallel(work), start=1):
        at, block = blocks[place]
        parts[at][block] = result
        progress("several sources", done, len(blocks))
    for at, x in enumerate(listed):
        yield x, reduce(add, (counts for _, counts in sorted(parts[at].items())))


def _mori(scenes: int, progress: Progress) -> Iterator[MoriPoint]:
    fields = max(5, math.ceil(scenes / 50))
    points = [(m, density) for m in (1, 2, 3) for density in mori.DENSITIES]
    shares: dict[int, Ratio] = {}
    for done, (at, ratio) in enumerate(in_parallel([(mori.simulated, (b, m, fields)) for m, b in points]), start=1):
        shares[at] = ratio
        progress("Mori's formula", done, len(points))
    for at, (m, density) in enumerate(points):
        yield MoriPoint(m, density, mori.formula(density, m), shares[at])


def _crowd(runs: int = 3) -> Crowd:
    """The fastest of ``runs`` runs, without compilation."""
    formation = experiments.crowd()
    scenes = formation(generator("crowd", 0), 1)
    rule = PoissonObjects(formation.density, formation.q)
    times = []
    for _ in range(runs):
        start = time.perf_counter()
        objects = identify_many(scenes.sources, rule=rule)
        times.append(time.perf_counter() - start)
    groups = objects.groups
    unproved = int((groups.gap > 0).sum())
    return Crowd(sum(map(len, scenes.sources)), int(groups.records.max()), unproved, min(times))

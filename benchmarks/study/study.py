"""The study: runs the experiments over all cores and keeps what they found."""

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
from benchmarks.study.trial import Outcome, everywhere, generator, run
from sameas.errors import InputError
from sameas.many.identify import identify_many
from sameas.many.rules import PoissonObjects

#: Groups on which the priors are compared, and objects of Mori's fields per scene asked for.
GROUPS = 2000
#: Tells the progress: experiment, pieces done, pieces in all.
Told = Callable[[str, int, int], None]


@dataclass(frozen=True)
class MoriPoint:
    """Mori's formula and simulation at one density."""

    features: int
    density: float
    formula: float
    simulated: Ratio


@dataclass(frozen=True)
class Crowd:
    """200 targets seen by six sources: how long ``identify_many`` took, and in what groups."""

    records: int
    largest_group: int
    unproved_groups: int
    seconds: float


@dataclass(frozen=True)
class Study:
    """What the experiments found; empty where one was not run.

    scenes : asked for at every point. seconds : it took. load : of the machine when it began, NaN where not known.
    stone_soup : whether Stone Soup took part.
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
        """A contender's tally at a point, None where it did not take part."""
        for outcome in self.experiment(experiment):
            if outcome.point.name == point and contender in outcome.names:
                return outcome.of(contender)
        return None


def studied(scenes: int, only: Sequence[str] = (), told: Told | None = None) -> Study:
    """The study with so many scenes at every point.

    Parameters
    ----------
    only : experiments to run, of :data:`benchmarks.study.experiments.NAMES`; all if none are named.
    told : called with the experiment, the pieces of it that are done, and all of its pieces.
    """
    unknown = sorted(set(only) - set(experiments.NAMES))
    if unknown:
        raise InputError(f"no experiment is called {unknown[0]}; give one of {', '.join(experiments.NAMES)}")
    if scenes < 2:
        raise InputError(f"scenes is {scenes}; give at least 2, 4000 for a run to be published")
    wanted, tell, start = only or experiments.NAMES, told or (lambda name, done, of: None), time.perf_counter()
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else math.nan
    makers = {"claims": experiments.claims, "spacing": experiments.spacing, "formations": experiments.formations,
              "wrong": experiments.wrong}  # fmt: skip
    points = [point for name, make in makers.items() if name in wanted for point in make()]
    return Study(
        scenes,
        outcomes=tuple(run(points, scenes, lambda done, of, _: tell("rules", done, of))),
        several=tuple(_several(scenes, tell)) if "several" in wanted else (),
        crowd=_crowd() if "several" in wanted else None,
        mori=tuple(_mori(scenes, tell)) if "mori" in wanted else (),
        priors=compared(GROUPS) if "priors" in wanted else None,
        seconds=time.perf_counter() - start,
        load=load,
    )


def _several(scenes: int, tell: Told) -> Iterator[tuple[Several, Counts]]:
    listed = experiments.several(scenes)
    blocks = [(at, block) for at, x in enumerate(listed) for block in range(-(-x.scenes // several.TOGETHER))]
    # The longest first, so that no core waits for one of them at the end.
    blocks.sort(key=lambda entry: -len(listed[entry[0]].formation.q))
    kept: dict[int, dict[int, Counts]] = {at: {} for at in range(len(listed))}
    work = [(several.counts, (listed[at], block)) for at, block in blocks]
    for done, (place, result) in enumerate(everywhere(work), start=1):
        at, block = blocks[place]
        kept[at][block] = result
        tell("several sources", done, len(blocks))
    for at, x in enumerate(listed):
        yield x, reduce(add, (counts for _, counts in sorted(kept[at].items())))


def _mori(scenes: int, tell: Told) -> Iterator[MoriPoint]:
    fields = max(5, math.ceil(scenes / 50))
    asked = [(m, density) for m in (1, 2, 3) for density in mori.DENSITIES]
    found: dict[int, Ratio] = {}
    for done, (at, ratio) in enumerate(everywhere([(mori.simulated, (b, m, fields)) for m, b in asked]), start=1):
        found[at] = ratio
        tell("Mori's formula", done, len(asked))
    for at, (m, density) in enumerate(asked):
        yield MoriPoint(m, density, mori.formula(density, m), found[at])


def _crowd(runs: int = 3) -> Crowd:
    """The fastest of some runs, compiled beforehand."""
    formation = experiments.crowd()
    scenes = formation(generator("crowd", 0), 1)
    rule = PoissonObjects(formation.density, formation.q)
    times = []
    for _ in range(runs):
        start = time.perf_counter()
        found = identify_many(scenes.sources, rule=rule)
        times.append(time.perf_counter() - start)
    groups = found.groups
    unproved = int((groups.gap > 0).sum())
    return Crowd(sum(map(len, scenes.sources)), int(groups.records.max()), unproved, min(times))

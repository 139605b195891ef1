"""The report of ``sameas picture``: input, doubts, results, estimates and assumptions."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from sameas.arrays import FloatArray
from sameas.evidence.identity import FREQUENCY
from sameas.picture.plot_picture import PlotPicture
from sameas.picture.summary import Summary
from sameas.picture.watch import Watch
from sameas.report.prose import ALARM, DOUBT, entry, moment, span
from sameas.representation import counted, listed
from sameas.tracks.placement import Directions
from sameas.tracks.scene import Scene


def read_lines(sources: Iterable[tuple[str, Sequence[str]]]) -> Iterator[str]:
    """Every source by name, with what was read and what was guessed; two notes or more that an earlier one has as well
    are not repeated."""
    yield "Sources"
    earlier: dict[str, list[str]] = {}
    for name, (first, *rest) in sources:
        lines = [line.removeprefix(f"{name}: ") for line in rest]
        common = {other: {*lines}.intersection(noted) for other, noted in earlier.items()}
        like = max(common, key=lambda other: len(common[other]), default="")
        repeated = common[like] if like and len(common[like]) > 1 else set()
        yield f"  {first}"
        yield from (f"    {line}" for line in lines if line not in repeated)
        if repeated:
            yield f"    otherwise as {like}"
        earlier[name] = lines


def scene_lines(scene: Scene, watch: Watch | PlotPicture) -> Iterator[str]:
    """The processing of each source: filtered to tracks, or plots without ids, and how these are followed."""
    for feed in scene.feeds:
        if feed.filtered:
            yield f"  {feed.description.name}: plots with ids, filtered to tracks with velocities"
        elif feed.reports.track is None and not isinstance(watch, PlotPicture):
            yield f"  {feed.description.name}: plots without ids; objects that only they show are followed over scans"
    if isinstance(watch, PlotPicture):
        yield "  no source identifies its objects: they are tracked from scan to scan"
    if scene.feeds and all(isinstance(feed.reports, Directions) for feed in scene.feeds):
        yield f"  directions only, from {_crossing_line(scene)}"


#: Direction finders nearer to each other than this are at one place: their directions do not cross.
ONE_PLACE_M = 10.0


def _crossing_line(scene: Scene) -> str:
    """What the places of sensors of directions allow to say about positions."""
    places: list[FloatArray] = []
    for feed in scene.feeds:
        at = feed.sensor_m
        if at is not None and len(at) and all(np.hypot(*(at[0] - other)) > ONE_PLACE_M for other in places):
            places.append(at[0])
    if len(places) < 2:
        return "one place: no object gets a position; add a sensor at another place, or a source of positions"
    if len(places) == 2 and not all(FREQUENCY in feed.attributes for feed in scene.feeds):
        return (
            "two places: positions are their crossings; of several objects, some may be at false crossings, which only "
            "a third place, or names or frequencies that both sources give can exclude"
        )
    return f"{len(places)} places: positions are their crossings"


def doubt_lines(doubts: Sequence[str]) -> Iterator[str]:
    """Doubts about whole sources."""
    yield from (f"{DOUBT}{doubt}" for doubt in doubts)


def estimated_lines(scene: Scene) -> Iterator[str]:
    """The errors (1σ) of plots, estimated from their scatter."""
    for line in scene.estimated:
        yield from entry("estimated", line)


def found_lines(summary: Summary) -> Iterator[str]:
    """The summary: objects, alarms and doubts, offsets, misses."""
    yield ""
    times = f"{counted(summary.instants, 'instant')}, " if summary.instants > 1 else ""
    yield f"Picture: {times}{span(summary.first_s, summary.last_s)}"
    yield from (f"{ALARM}{alarm}, from {moment(alarm.first_s)}" for alarm in summary.urgent)
    for label, words in summary.entries():
        yield from [f"{DOUBT}{words}"] if label == "doubt" else entry(label, words)


def assumed_lines(scene: Scene) -> Iterator[str]:
    """Every assumed parameter, grouped by kind of source; summary.json has the reasons."""
    taken: dict[tuple[str, str], list[str]] = {}
    for feed in scene.feeds:
        described = feed.description
        if described.assumed:
            numbers = ", ".join(f"{line.name} {_number(line.value)}" for line in described.assumed)
            taken.setdefault((described.kind, numbers), []).append(described.name)
    for (kind, numbers), names in taken.items():
        yield from entry("assumed", f"{listed(names)} ({kind}): {numbers}")


def _number(value: object) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)

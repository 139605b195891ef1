"""Thirteen situations at sea and in the air, as files and through the live watch: stated probabilities against truth.

Each situation is written in formats of the field with sensor files that give kinds and sites only, and goes through
what ``sameas picture`` and, with ``--live``, ``sameas watch`` do. Scored is every object with two records, an
alternative, or a part of it elsewhere, every 10 s after two minutes: right, if its records are of one real object and
no other source shows that one elsewhere; wrong, if they are of two, or with a false echo; else split. An echo of two
objects that the radar does not resolve is of either. *Numbers* counts how often real objects change the object number.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

import sameas
from benchmarks.situation_files import START_S, Truth, write
from benchmarks.situation_scenes import SITUATIONS, Situation
from benchmarks.tables import Table, report
from sameas.cli.watch import settings_of
from sameas.live.keeper import Keeper

EVERY_S, WARM_S, SURE = 10.0, 120.0, 0.99
#: Seconds of a tick and between two registrations of the live watch.
TICK_S, REGISTER_S = 2.0, 60.0
Columns = Mapping[str, Any]


@dataclass
class Score:
    """Of each scored object: stated probability, and whether it is right or wrong (neither: split)."""

    p: list[float] = field(default_factory=list)
    right: list[bool] = field(default_factory=list)
    wrong: list[bool] = field(default_factory=list)
    changes: int = 0
    numbers: dict[int, int] = field(default_factory=dict)

    def add(self, objects: Columns, records: Columns, of: Sequence[frozenset[int]]) -> None:
        """Adds the objects of an instant. of : the real objects that each record is of."""
        sources = records["source"].tolist()
        number = np.asarray(records["object"])
        members = {int(n): np.flatnonzero(number == n).tolist() for n in np.unique(number)}
        # Objects that a record is surely of, with the sources that show each by itself.
        alone: dict[int, set[tuple[str, int]]] = {}
        for k, one in enumerate(of):
            if len(one) == 1:
                alone.setdefault(next(iter(one)), set()).add((sources[k], int(number[k])))
        p, rival = (np.ma.filled(objects[name], np.nan) for name in ("probability", "p_runner_up"))
        for row, n in enumerate(objects["object"].tolist()):
            own = members.get(n, [])
            if not own:
                continue
            common = frozenset.intersection(*(of[k] for k in own)) or (frozenset([-1]) if len(own) == 1 else None)
            if common is None:
                self._append(p[row], right=False, wrong=True)
                continue
            inside = {sources[k] for k in own}
            elsewhere = [any(s not in inside and m != n for s, m in alone.get(k, ())) for k in common]
            if len(own) > 1 or rival[row] > 0.0 or all(elsewhere):
                self._append(p[row], right=not all(elsewhere), wrong=False)
        self._count_changes(alone)

    def _append(self, p: float, right: bool, wrong: bool) -> None:
        self.p.append(float(p))
        self.right.append(right)
        self.wrong.append(wrong)

    def _count_changes(self, alone: Mapping[int, set[tuple[str, int]]]) -> None:
        for k, places in alone.items():
            used = {m for _, m in places}
            if k in self.numbers and self.numbers[k] not in used:
                self.changes += 1
            if self.numbers.get(k) not in used:
                self.numbers[k] = min(used)


def _at(columns: Columns, time_s: np.ndarray, t: float) -> dict[str, Any]:
    rows = np.flatnonzero(time_s == t)
    return {name: column[rows] for name, column in columns.items()}


def _in_order(records: Columns, of: Mapping[str, list[frozenset[int]]]) -> list[frozenset[int]]:
    """The real objects of all records, from those of each source."""
    each = {name: iter(one) for name, one in of.items()}
    return [next(each[name]) for name in records["source"].tolist()]


def of_files(folder: Path, truth: Mapping[str, Truth], files: Mapping[str, Path]) -> Score:
    """The score of the picture of the files."""
    score = Score()
    picture = sameas.match_picture(files, sensors=folder / "sensors.toml", every=EVERY_S).picture
    times = [np.asarray(columns["time_s"]) for columns in (picture.objects, picture.records)]
    for t in picture.instants_s.tolist():
        if t - START_S >= WARM_S:
            objects, records = (_at(c, at, t) for c, at in zip((picture.objects, picture.records), times, strict=True))
            score.add(objects, records, _in_order(records, {
                name: one.of_lines(records["line"][records["source"] == name].tolist()) for name, one in truth.items()
            }))  # fmt: skip
    return score


def of_watch(folder: Path, truth: Mapping[str, Truth], files: Mapping[str, Path]) -> Score:
    """The score of the live watch, to which the files are replayed without waiting."""
    score = Score()
    named = [f"{name}={path}" for name, path in files.items()]
    settings, replay = settings_of(named, folder / "sensors.toml", None, 1.0)
    assert replay is not None
    keeper, registered_s = Keeper(settings, replay=replay), -np.inf
    for t in np.arange(START_S + TICK_S, replay.last_s, TICK_S).tolist():
        situation = keeper.tick(t)
        since_s = t - START_S
        if since_s >= 10.0 and t - registered_s >= REGISTER_S:
            keeper.background.register()
            registered_s = t
        if since_s >= WARM_S and since_s % EVERY_S < TICK_S:
            assert situation is not None
            records, of = situation.records, {}
            for name, one in truth.items():
                own = records["source"] == name
                bias = keeper.picture.biases.get(name)
                late = None if bias is None else bias.parameters.get("time_s")
                time_s = t - np.asarray(records["age_s"])[own] + (0.0 if late is None else late.value)
                of[name] = one.of_times(records["track_id"][own].tolist(), time_s)
            score.add(situation.objects, records, _in_order(records, of))
    keeper.close()
    return score


COLUMNS = (
    "situation", "objects", "right", "wrong", "split", "expected wrong", "above 0.99", "wrong or split of them",
    "expected", "0.8 to 0.99", "right of them", "stated", "log loss", "numbers", "wall s",
)  # fmt: skip


def line(situation: Situation, seeds: range, live: bool) -> list[object]:
    """One row."""
    began, parts = time.perf_counter(), []
    for seed in seeds:
        with tempfile.TemporaryDirectory() as name:
            folder, rng = Path(name), np.random.default_rng(seed)
            world, sensors = situation.built(rng)
            truth = write(folder, world, sensors, rng)
            files = {sensor.name: folder / sensor.file for sensor in sensors}
            parts.append((of_watch if live else of_files)(folder, truth, files))
    p, right, wrong = (np.concatenate([getattr(one, name) for one in parts]) for name in ("p", "right", "wrong"))
    right, wrong = right.astype(bool), wrong.astype(bool)
    sure, likely = p > SURE, (p >= 0.8) & (p <= SURE)
    stated = np.clip(p, 1e-6, 1.0 - 1e-6)
    return [situation.words, len(p), int(right.sum()), int(wrong.sum()), int((~right & ~wrong).sum()),
            float((1.0 - p).sum()), int(sure.sum()), int((sure & ~right).sum()), float((1.0 - p[sure]).sum()),
            int(likely.sum()), *((float(x[likely].mean()) if likely.any() else None) for x in (right, p)),
            float(-np.mean(np.log(np.where(right, stated, 1.0 - stated)))),
            sum(one.changes for one in parts), time.perf_counter() - began]  # fmt: skip


def rows(only: str, seeds: int, first: int, live: bool) -> Iterator[list[object]]:
    """The rows of the situations whose name contains this."""
    for number, situation in enumerate(SITUATIONS):
        if only in situation.words:
            begin = 9_000_000 + 1000 * number + first
            yield line(situation, range(begin, begin + seeds), live)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(prog="scripts/bench situations", description=__doc__)
    parser.add_argument("--seeds", type=int, default=2, help="scenes of each situation (default 2)")
    parser.add_argument("--first", type=int, default=0, help="number of the first scene (default 0)")
    parser.add_argument("--only", default="", help="situations whose name contains this")
    parser.add_argument("--live", action="store_true", help="the live watch, besides the files")
    options = parser.parse_args()
    ways = [("files", False), *([("live", True)] if options.live else [])]
    tables = (
        Table(f"Situations, {name}", COLUMNS, list(rows(options.only, options.seeds, options.first, live)))
        for name, live in ways
    )
    report("situations", tables)


if __name__ == "__main__":
    main()

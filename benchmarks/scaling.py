"""Time and memory against the number of rows and against crowding, `sameas` and other programs; table and figure.

Measured on the workload of ``speed``: 1000 to 5 million rows at λ 0.5, then λ 0.05 to 8 at a million rows, for
`sameas` with and without posteriors, astropy, SciPy, STILTS, LSDB and NWAY. A program is dropped once a run takes
longer than --slow seconds, or once the next step may not fit into memory. Run ``scripts/bench scaling`` on an idle
machine; --draw draws the figure of ``docs/measured.md`` again from the stored tables.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks import machine
from benchmarks.measure import Measurement, Work, measure
from benchmarks.peers import PEERS, Interpreters
from benchmarks.speed import Bench
from benchmarks.tables import OUTPUT, Table, duration, report
from sameas.errors import InputError
from sameas.plots.sheet import FAINT, FIRST, INK, SECOND, save, sheet, tidy

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FULL, QUICK = 5_000_000, 100_000
#: Rows of the sweep over λ, or --rows if that is less.
LAMBDA_ROWS = 1_000_000
LAMBDAS = (0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 4.0, 8.0)
#: λ of the sweep over rows.
ROWS_LAMBDA = 0.5
#: Columns after that of the axis.
COLUMNS = ("by", "median, s", "fastest", "slowest", "runs", "peak MB", "above baseline", "µs a row", "× sameas MAP")
MAP, POSTERIORS = "sameas MAP", "sameas with posteriors"
PROGRAMS = ("astropy", "scipy", "stilts", "lsdb", "nway")


@dataclass(frozen=True)
class Step:
    """One scene of a sweep. x : its position on the axis, rows or λ."""

    x: float
    rows: int
    lam: float


def by_rows(most: int) -> list[Step]:
    """1, 5, 10, 50 … thousand rows, and ``most``."""
    sizes = [digit * 10**power for power in range(3, 8) for digit in (1, 5)]
    return [Step(n, n, ROWS_LAMBDA) for n in (*(n for n in sizes if n < most), most)]


def by_crowding(rows: int) -> list[Step]:
    """Every λ at the same number of rows."""
    return [Step(lam, rows, lam) for lam in LAMBDAS]


# ---- measuring ----


def programs(b: Bench, step: Step) -> dict[str, Work | str]:
    """The tasks on one scene, `sameas` first; a missing program has its installation command instead."""
    folder = b.sky(step.lam, rows=step.rows)
    small = step.rows <= 20_000
    of_sameas = {
        name: b.stages(folder, until, runs=50 if small else 7)
        for name, until in ((MAP, "assignment"), (POSTERIORS, "posterior"))
    }
    return of_sameas | dict(b.peers(folder, *PROGRAMS, runs=15 if small else 5))


def sweep(b: Bench, title: str, axis: str, steps: Sequence[Step], excluded: Sequence[str] = ()) -> Table:
    """Every program at every step, the smallest first, until it fails, is too slow or may run out of memory."""
    ended = dict.fromkeys(excluded, "")
    lines: list[list[Any]] = []
    for k, step in enumerate(steps):
        growth = steps[k + 1].rows / step.rows if k + 1 < len(steps) else 1.0
        sameas_s = float("nan")
        for name, work in programs(b, step).items():
            if name in ended:
                continue
            measurement = Measurement(error=work, not_installed=True) if isinstance(work, str) else measure(work)
            if measurement.seconds:
                sameas_s = measurement.median if name == MAP else sameas_s
                lines.append([step.x, name, *cells(measurement, step.rows, sameas_s)])
            reason = end_reason(measurement, growth, b.slow_s)
            if reason:
                ended[name] = reason if measurement.not_installed else f"ends at {axis} {step.x:g}: {reason}"
    versions = (f"{PEERS[name].name} {b.versions[name]}" for name in PROGRAMS if b.versions[name])
    notes = [
        f"a line ends where one run took longer than {b.slow_s:g} s",
        "peak MB: the whole process, interpreter and imports included",
        ", ".join(versions),
    ]
    notes += [f"{name} {reason}" for name, reason in ended.items() if reason]
    return Table(title, (axis, *COLUMNS), lines, notes)


def end_reason(measurement: Measurement, growth: float, slow_s: float) -> str:
    """Why a program does not run the next step, of ``growth`` times the rows; empty if it does."""
    if not measurement.seconds:
        return f"is missing ({measurement.error})" if measurement.not_installed else f"failed: {measurement.error}"
    if measurement.median > slow_s:
        return f"a run took {duration(measurement.median)}"
    if growth * measurement.peak_mb > 1024 * machine.memory_gb():
        return f"took {measurement.peak_mb:.0f} MB; {growth:g} times that may not fit"
    return ""


def cells(measurement: Measurement, rows: int, sameas_s: float) -> list[float]:
    """The numbers of a measurement in the order of ``COLUMNS``."""
    return [
        measurement.median, min(measurement.seconds), max(measurement.seconds), len(measurement.seconds),
        round(measurement.peak_mb), round(measurement.peak_mb - measurement.baseline_mb),
        1e6 * measurement.median / rows, measurement.median / sameas_s,
    ]  # fmt: skip


def tables(b: Bench) -> Iterator[Table]:
    """Against rows; then against λ, with the programs that were fast enough at that number of rows."""
    first = sweep(b, f"Against rows, λ {ROWS_LAMBDA:g}", "rows", by_rows(b.rows))
    yield first
    rows = min(b.rows, LAMBDA_ROWS)
    fit = {line[1] for line in first.rows if line[0] >= rows and line[2] <= b.slow_s}
    fit |= {line[1] for line in first.rows if line[0] > rows}
    excluded = {MAP, POSTERIORS, *(PEERS[name].name for name in PROGRAMS)} - fit
    yield sweep(b, f"Against crowding, {spaced(rows)} rows", "λ", by_crowding(rows), sorted(excluded))


def spaced(n: float) -> str:
    """A whole number with thin spaces between thousands."""
    return f"{n:,.0f}".replace(",", "\u202f")


# ---- the figure ----

#: Label, colour, marker: `sameas` in blues, the others in colours that remain distinct with colour blindness.
LOOKS = {
    MAP: ("sameas: best pairs", FIRST, "o"),
    POSTERIORS: ("sameas: + probabilities", "#56B4E9", "o"),
    PEERS["astropy"].name: ("astropy: nearest", SECOND, "s"),
    PEERS["scipy"].name: ("SciPy: nearest", "#E69F00", "^"),
    PEERS["stilts"].name: ("STILTS: greedy best", "#B4508C", "D"),
    PEERS["lsdb"].name: ("LSDB: nearest", "#6F6F6F", "v"),
    PEERS["nway"].name: ("NWAY: probabilities", INK, "P"),
}
TIME, MEMORY = 2, 6  # columns of the tables
#: Rows of panels: the column, its label, the format of a tick.
AXES: tuple[tuple[int, str, Callable[[float, int], str]], ...] = (
    (TIME, "time of a run", lambda seconds, _: duration(seconds)),
    (MEMORY, "peak memory of the process", lambda mb, _: f"{spaced(mb)} MB"),
)
#: Lines of constant cost per row: label, and seconds or MB per row.
GUIDES = {
    TIME: (("0.1 µs a row", 1e-7), ("10 µs a row", 1e-5), ("100 µs a row", 1e-4)),
    MEMORY: (("the input: 48 B a row", 48 / 2**20),),
}


def draw(sweeps: Sequence[Table], about: Sequence[str], path: Path) -> None:
    """Draw time (top) and memory (bottom), against rows (left) and λ (right)."""
    rows, crowding = sweeps
    notes = f"{rows.notes[0]}; medians; {about[0]}"
    figure = sheet(headline(rows), notes[0].upper() + notes[1:], width=13.0, height=9.0)
    from matplotlib import rc_context
    from matplotlib.ticker import LogLocator

    grid = figure.subplots(2, 2, sharex="col", sharey="row", width_ratios=(1.25, 1.0))
    for column, table in enumerate(sweeps):
        for row, (what, label, ticks) in enumerate(AXES):
            axes = grid[row][column]
            axes.set_xscale("log")
            axes.set_yscale("log")
            lines(axes, table, what)
            x = ("rows of either source", "λ: chance candidates of a record within 3σ")[column] if row else ""
            tidy(axes, x, "" if column else label, "" if row else table.title)
            axes.tick_params(which="minor", length=0)
            axes.tick_params(labelleft=True)
            if what == MEMORY:
                axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axes.yaxis.set_major_formatter(ticks)
            axes.yaxis.set_minor_formatter("")
            axes.xaxis.set_minor_formatter("")
            axes.grid(axis="y", color="#E8E8E8", linewidth=0.6)
    lambda_panel = grid[1][1]
    lambda_panel.set_xticks(sorted({line[0] for line in crowding.rows}))
    lambda_panel.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    figure.draw_without_rendering()  # sets the limits and sizes that the labels need
    for axes, table, what in zip(grid.flat, (rows, crowding) * 2, (TIME, TIME, MEMORY, MEMORY), strict=True):
        label_ends(axes, table, what)
    figure.draw_without_rendering()  # the labels changed the sizes of the panels
    for axes, what in zip(grid[:, 0], (TIME, MEMORY), strict=True):
        guides(axes, what)
    path.parent.mkdir(parents=True, exist_ok=True)
    with rc_context({"svg.fonttype": "none"}):  # text as text: a third of the size
        save(figure, path)


def headline(rows: Table) -> str:
    """The title: both times at the largest number of rows, up to a million, that `sameas` and astropy finished."""
    astropy = PEERS["astropy"].name
    seconds = {(line[1], line[0]): line[TIME] for line in rows.rows}
    shared = [n for by, n in seconds if by == astropy and n <= LAMBDA_ROWS and (MAP, n) in seconds]
    if not shared:
        return "Time and memory against rows and crowding"
    n = max(shared)
    times = [duration(seconds[by, n]) for by in (MAP, astropy)]
    return f"{spaced(n)} rows a side: best one-to-one pairs in {times[0]}, astropy's nearest in {times[1]}"


def curves(table: Table, what: int) -> dict[str, np.ndarray]:
    """(2, n) position on the axis and value, of every program in the table."""
    names = [name for name in LOOKS if any(line[1] == name for line in table.rows)]
    return {name: np.array([[line[0], line[what]] for line in table.rows if line[1] == name]).T for name in names}


def lines(axes: Axes, table: Table, what: int) -> None:
    """Draw the line of every program, those of `sameas` thicker and on top."""
    for name, (x, y) in curves(table, what).items():
        _, colour, marker = LOOKS[name]
        width, size, order = (2.6, 5.5, 4) if name in (MAP, POSTERIORS) else (1.4, 4.5, 3)
        axes.plot(x, y, color=colour, marker=marker, linewidth=width, markersize=size, zorder=order)


def label_ends(axes: Axes, table: Table, what: int) -> None:
    """Label the lines to the right of the panel without overlaps; those that end early, at their ends."""
    ends = {name: (float(x[-1]), float(y[-1])) for name, (x, y) in curves(table, what).items()}
    last = max(x for x, _ in ends.values())
    complete = sorted((name for name in ends if ends[name][0] == last), key=lambda name: ends[name][1])
    heights = axes.transAxes.inverted().transform(axes.transData.transform([ends[name] for name in complete]))[:, 1]
    # At least one line of text between labels: the mean of moving them only up and only down.
    offsets = np.arange(len(complete)) * 15.0 * axes.figure.dpi / 72 / axes.get_window_extent().height
    spare = heights - offsets
    up, down = np.maximum.accumulate(spare), np.minimum.accumulate(spare[::-1])[::-1]
    for name, height in zip(complete, 0.5 * (up + down) + offsets, strict=True):
        label, colour, _ = LOOKS[name]
        axes.annotate(
            label, ends[name], (1.035, height), textcoords="axes fraction", color=colour, fontsize=10, va="center",
            fontweight="bold" if name in (MAP, POSTERIORS) else "normal", annotation_clip=False,
            arrowprops={"arrowstyle": "-", "color": colour, "linewidth": 0.6, "shrinkA": 1, "shrinkB": 4},
        )  # fmt: skip
    for name in ends.keys() - set(complete):
        label, colour, _ = LOOKS[name]
        axes.annotate(
            label, ends[name], (0, 6), textcoords="offset points", color=colour, fontsize=10, ha="center", va="bottom"
        )


def guides(axes: Axes, what: int) -> None:
    """Draw lines of slope 1, parallel to a cost that is proportional to the rows."""
    (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
    for text, cost in GUIDES[what]:
        begin, end = max(left, low / cost), min(right, high / cost)
        if end < 3 * begin:
            continue
        axes.plot([begin, end], [cost * begin, cost * end], color=FAINT, linewidth=0.8, linestyle=":", zorder=1)
        (x1, y1), (x2, y2) = axes.transData.transform([(begin, cost * begin), (end, cost * end)])
        axes.text(
            1.2 * begin, 1.2 * cost * begin, text, color="#6A6A6A", fontsize=8.5, ha="left", va="bottom",
            rotation=np.degrees(np.arctan2(y2 - y1, x2 - x1)), rotation_mode="anchor", zorder=2,
        )  # fmt: skip
    axes.set(xlim=(left, right), ylim=(low, high))


# ---- the command line ----


def stored(name: str) -> tuple[list[Table], list[str]]:
    """The tables that an earlier run stored, and its machine."""
    path = OUTPUT / f"{name}.json"
    if not path.exists():
        sys.exit(f"{path} does not exist: measure first, without --draw")
    content = json.loads(path.read_text())
    if len(content["tables"]) != 2:
        sys.exit(f"{path} is incomplete: measure again, without --draw")
    return [Table(**table) for table in content["tables"]], content["machine"]


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(prog="scripts/bench scaling", description=__doc__)
    parser.add_argument("--rows", type=int, metavar="MAX", help=f"most rows (default {FULL}, quick {QUICK})")
    parser.add_argument("--quick", action="store_true", help=f"up to {QUICK} rows, --slow 10")
    parser.add_argument("--slow", type=float, help="a program is dropped after a run of this many seconds (default 60)")
    parser.add_argument("--figure", type=Path, help="the picture, .svg or .png (default benchmarks/output/scaling.png)")
    parser.add_argument("--draw", action="store_true", help="measure nothing: draw the stored tables")
    parser.add_argument("--peer-python", action="append", default=[], metavar="NAME=PYTHON")
    options = parser.parse_args()
    name = "scaling-quick" if options.quick else "scaling"
    if not options.draw:
        interpreters = Interpreters.of(options.peer_python)
        rows = options.rows or (QUICK if options.quick else FULL)
        slow_s = options.slow or (10.0 if options.quick else 60.0)
        with tempfile.TemporaryDirectory(prefix="sameas-bench-") as folder:
            report(name, tables(Bench(rows, Path(folder), interpreters, interpreters.versions(), slow_s)))
    figure = options.figure or OUTPUT / f"{name}.png"
    try:
        draw(*stored(name), figure)
    except InputError as error:
        sys.exit(f"no figure: {error}\nthe numbers are stored; the same command with --draw draws them")
    print(f"figure: {figure}")


if __name__ == "__main__":
    main()

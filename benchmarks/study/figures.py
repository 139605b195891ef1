"""Figures of the study, ready for print; every function returns a matplotlib ``Figure``.

Bars are one standard error. The colours can be distinguished with any colour vision. The figures need matplotlib
(``pip install sameas[plots]``).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.study import mori as formulas
from benchmarks.study.experiments import FIVE_Q, GATES, OPEN_GATE, RIGHT, SPACINGS, TWO_Q
from benchmarks.study.scenes import Formation, Scatter
from benchmarks.study.study import Study
from benchmarks.study.tally import BINS, Ratio
from sameas.io import replacing
from sameas.plots.sheet import FAINT, FIRST, FOUND, INK, SECOND, sheet, tidy

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# More of Okabe and Ito's colours.
ORANGE, PURPLE, SKY, YELLOW = "#E69F00", "#CC79A7", "#56B4E9", "#B8A500"
#: Spacings that are labelled on the logarithmic axis.
LABELLED = (0.5, 1.0, 1.6, 2.5, 4.0, 6.0)
#: Rules of the main figure: colour, line style, width, marker.
LINES = {
    "close objects": (FIRST, "-", 2.6, "o"),
    "uniform": (SECOND, "-", 1.5, "s"),
    "constant C": (FOUND, "-", 1.5, "D"),
    "k = min": (ORANGE, "--", 1.5, "^"),
    "Stone Soup 1–1": (PURPLE, "--", 1.5, "v"),
    "independent Bayes": (SKY, ":", 1.8, "P"),
    "mutual nearest": (FAINT, ":", 1.8, "X"),
}


def all_figures(study: Study) -> dict[str, Figure]:
    """The figures whose experiments were run, by the name of the file."""
    makers: dict[str, tuple[bool, Callable[[Study], Figure]]] = {
        "study-five": (bool(study.experiment("spacing")), five),
        "study-two": (bool(study.experiment("spacing")), two),
        "study-wrong": (bool(study.experiment("wrong")), wrong),
        "study-calibration": (bool(study.experiment("formations")), calibration),
        "study-order": (bool(study.several), order),
        "study-mori": (bool(study.mori), mori),
    }
    return {name: make(study) for name, (was_run, make) in makers.items() if was_run}


# ---- share right against the spacing ----


def five(study: Study) -> Figure:
    """Share of records right in a line of five, against the spacing, for each rule and q."""
    title = "Line of five targets: share of records right"
    return _spacing(study, 5, FIVE_Q, ("right", "lead"), "share of records right", title)


def two(study: Study) -> Figure:
    """Share of scenes of two targets wholly right, against the spacing, for each rule and q."""
    title = "Two targets: share of scenes wholly right"
    return _spacing(study, 2, TWO_Q, ("whole", "whole lead"), "share of scenes wholly right", title)


def _spacing(
    study: Study, targets: int, several_q: Sequence[float], names: tuple[str, str], y: str, title: str
) -> Figure:
    """Top row: the share; bottom row: its difference to close objects on the same scenes."""
    from matplotlib.lines import Line2D

    subtitle = (
        f"3σ gate; {study.scenes} scenes per point, Stone Soup on a quarter of them. Below: difference to close "
        "objects on the same scenes. Bars: one standard error."
    )
    figure = sheet(title, subtitle, 12.0, 7.2)
    panels = figure.subplots(2, len(several_q), sharey="row", sharex=True, squeeze=False, height_ratios=(1.2, 1.0))
    drawn: dict[str, Line2D] = {}
    for column, q in enumerate(several_q):
        for rule, (colour, dash, width, mark) in LINES.items():
            tallies = [(d, study.tally("spacing", f"{targets} targets, d {d:g}, q {q:g}", rule)) for d in SPACINGS]
            points = [(d, tally.figures()) for d, tally in tallies if tally is not None]
            if not points:
                continue
            for axes, name in zip(panels[:, column], names, strict=True):
                _bars(axes, [d for d, _ in points], [f[name] for _, f in points], colour, mark, dash, width)
            drawn[rule] = Line2D([], [], color=colour, ls=dash, lw=width, marker=mark, ms=5, label=rule)
        for axes, words in zip(panels[:, column], (y, "difference to close objects"), strict=True):
            axes.set_xscale("log")
            axes.set_xticks(SPACINGS, [f"{d:g}" if d in LABELLED else "" for d in SPACINGS])
            axes.minorticks_off()
            axes.grid(axis="y", color="#E6E6E6", lw=0.8)
            tidy(axes, "" if axes is panels[0, column] else "spacing d [σ]", words if not column else "")
        panels[0, column].set_title(f"q = {q:g}", fontsize=11.5, loc="left", color=INK)
        panels[0, column].set_ylim(0.0, 1.03)
        panels[1, column].set_ylim(-0.26, 0.06)
    figure.legend(
        handles=list(drawn.values()), loc="outside lower center", ncols=len(drawn), frameon=False, fontsize=9.5
    )
    return figure


def _bars(
    axes: Axes, x: Sequence[float], figures: Sequence[Ratio], colour: str, mark: str, dash: str, width: float
) -> None:
    y, error = [r.value for r in figures], np.nan_to_num([r.error for r in figures])
    axes.errorbar(x, y, error, color=colour, ls=dash, lw=width, marker=mark, ms=4.5, elinewidth=1.0, zorder=3)


# ---- wrong parameters ----


#: Axis label, title and colour of each panel.
PARAMETERS = {
    "C": ("C / √(ρ q₁ q₂)", "constant C: wrong C", FOUND),
    "b": ("b / (2 d σ)", "close objects: wrong b", FIRST),
    "q": ("q / true q", "close objects: wrong q", FIRST),
}


def wrong(study: Study) -> Figure:
    """Share of records right with a wrong C, b or q."""
    subtitle = (
        "Line of five, d = 3, q = 0.4. Solid: no gate; dotted: 3σ gate, which hides errors. "
        "A line has no density; ρ = d⁻² is assumed."
    )
    figure = sheet("Wrong parameters", subtitle, 11.5, 4.8)
    panels = figure.subplots(1, 3, sharey=True)
    for axes, (parameter, (x, title, colour)) in zip(panels, PARAMETERS.items(), strict=True):
        outcome = next(o for o in study.experiment("wrong") if o.point.name == parameter)
        for suffix, gate in GATES.items():
            names = [
                n
                for n in outcome.names
                if n.startswith(f"{parameter} ×") and n.endswith("gate") == bool(gate is OPEN_GATE)
            ]
            factors = [float(n.removesuffix(suffix).split("×")[1]) for n in names]
            shares = [outcome.of(n).figures()["right"] for n in names]
            _bars(
                axes, factors, shares, colour, "o", "-" if gate is OPEN_GATE else ":", 2.0 if gate is OPEN_GATE else 1.2
            )
        axes.axvline(1.0, color=FAINT, lw=1.0, ls=":")
        axes.set_xscale("log")
        axes.set_xticks(factors, [f"{f:g}" for f in factors], rotation=45)
        axes.minorticks_off()
        axes.grid(axis="y", color="#E6E6E6", lw=0.8)
        if parameter == "b":
            _level(axes, outcome.of("b estimated, no gate").figures()["right"].value, "b estimated per scene", SECOND)
        elif parameter == "C":
            _level(axes, outcome.of(RIGHT).figures()["right"].value, "close objects, true parameters", FIRST)
        tidy(axes, x, "share of records right" if parameter == "C" else "", title)
    panels[0].set_ylim(0.3, 1.0)
    return figure


def _level(axes: Axes, y: float, words: str, colour: str) -> None:
    """A horizontal line across the panel, with a label above it."""
    axes.axhline(y, color=colour, lw=1.1, ls="--", zorder=1)
    axes.annotate(words, (0.98, y), (0, 5), xycoords=("axes fraction", "data"), textcoords="offset points", ha="right",
                  fontsize=9, color=colour)  # fmt: skip


# ---- calibration ----

#: Formations in which the models of the rules are nearly true, and in which they are not.
CALIBRATED = ("line of 5, d 1.9", "grid 5 × 5", "Poisson, density 0.1")


def calibration(study: Study) -> Figure:
    """Stated probability of candidates against the share that is true."""
    figure = sheet(
        "Calibration: stated probability of candidates against the share that is true",
        "Each mark: the candidates of one tenth of the scale, with an area proportional to their number.",
        11.5, 5.1,
    )  # fmt: skip
    rules = ("close objects", "uniform", "constant C")
    names = [name for name in CALIBRATED if study.tally("formations", name, rules[0]) is not None]
    for axes, name in zip(figure.subplots(1, len(names), sharey=True, squeeze=False)[0], names, strict=True):
        axes.plot([0, 1], [0, 1], color=FAINT, lw=1.0, zorder=1)
        lines = []
        for rule in rules:
            tally = study.tally("formations", name, rule)
            if tally is None:
                continue
            number, stated, true = tally.bins.sum(axis=0)
            enough = number > 20
            colour = LINES[rule][0]
            x, y = stated[enough] / number[enough], true[enough] / number[enough]
            axes.plot(x, y, color=colour, lw=1.3, zorder=2)
            axes.scatter(x, y, 8 + 160 * number[enough] / number.sum(), color=colour, zorder=3)
            lines.append((rule, colour, tally.figures()["ece"]))
        for k, (rule, colour, error) in enumerate(lines):
            axes.text(0.98, 0.18 - 0.06 * k, f"{rule}: error {error.value:.3f}", transform=axes.transAxes, color=colour,
                      fontsize=9, ha="right", va="top")  # fmt: skip
        axes.set_aspect("equal")
        axes.set_xlim(0, 1)
        axes.set_ylim(0, 1)
        tidy(axes, "stated probability", "share that is true" if name == names[0] else "", name)
    assert BINS == 10
    return figure


# ---- many sources ----


def order(study: Study) -> Figure:
    """Joint and sequential results: share of scenes wholly right, and share in which the order of sources matters."""
    figure = sheet(
        "Many sources: joint and sequential",
        "Five targets scattered over a square, q = 0.1; spacing: edge of the mean area per target, in σ of a record.",
        11.5, 4.6,
    )  # fmt: skip
    left, middle, right = figure.subplots(1, 3)
    scattered = [(s.formation, c) for s, c in study.several if isinstance(s.formation, Scatter)]
    three = [(_spacing_records(f), c) for f, c in scattered if len(f.q) == 3]
    x = [spacing for spacing, _ in three]
    for way, colour, mark in (("joint", FIRST, "o"), ("sequential", SECOND, "s")):
        _bars(left, x, [c.mean(f"{way} whole") for _, c in three], colour, mark, "-", 2.0)
    for k, (words, colour) in enumerate((("joint", FIRST), ("sequential", SECOND))):
        left.text(0.97, 0.15 - 0.07 * k, words, transform=left.transAxes, ha="right", color=colour, fontsize=9.5)
    tidy(left, "spacing [σ of a record]", "share of scenes wholly right", "three sources")
    _bars(middle, x, [c.mean("order matters") for _, c in three], SECOND, "s", "-", 2.0)
    middle.axhline(0.0, color=FIRST, lw=2.0)
    middle.text(0.97, 0.03, "joint: never", transform=middle.transAxes, ha="right", color=FIRST, fontsize=9.5)
    middle.text(0.97, 0.55, "sequential", transform=middle.transAxes, ha="right", color=SECOND, fontsize=9.5)
    tidy(middle, "spacing [σ of a record]", "share of scenes where order matters", "three sources, all six orders")
    eight = sorted(((len(f.q), c) for f, c in scattered if _spacing_records(f) == 8), key=lambda entry: entry[0])
    numbers = [n for n, _ in eight]
    for way, colour, mark in (("joint", FIRST, "o"), ("sequential", SECOND, "s")):
        _bars(right, numbers, [c.mean(f"{way} whole") for _, c in eight], colour, mark, "-", 2.0)
    right.set_xticks(numbers)
    tidy(right, "number of sources", "share of scenes wholly right", "spacing 8 σ of a record")
    for axes in (left, middle, right):
        axes.set_ylim(0.0 if axes is not middle else -0.02, 1.0)
        axes.grid(axis="y", color="#E6E6E6", lw=0.8)
    return figure


def _spacing_records(formation: Formation) -> int:
    """The spacing in σ of a record."""
    return round(formation.spacing / formation.sigma[0])


# ---- Mori's formula ----


def mori(study: Study) -> Figure:
    """The share of objects that get their own record, by formula and by simulation."""
    figure = sheet(
        "Mori's formula compared with simulation",
        "One-to-one assignment, both sources see every object; marks: simulation, one standard error.",
        7.6, 5.0,
    )  # fmt: skip
    axes = figure.subplots()
    top = max(p.density for p in study.mori)
    density = np.linspace(0.0, top, 200)
    for m, colour, mark in ((1, FIRST, "o"), (2, SECOND, "s"), (3, FOUND, "D")):
        axes.plot(density, np.exp(-formulas.constant(m) * density), color=colour, lw=1.8)
        points = [p for p in study.mori if p.features == m]
        _bars(axes, [p.density for p in points], [p.simulated for p in points], colour, mark, "", 1.0)
        last = points[-1].simulated.value
        words = ("one feature", "two features", "three features")[m - 1]
        axes.annotate(f"{words}\n$C_{m}$ = {formulas.constant(m):.3f}", (top, last), (9, 0), textcoords="offset points",
                      va="center", fontsize=9.5, color=colour)  # fmt: skip
    axes.set_xlim(0.0, top * 1.22)
    axes.set_ylim(0.0, 1.0)
    axes.grid(axis="y", color="#E6E6E6", lw=0.8)
    tidy(axes, "β √|S|: objects per unit of the residual's σ to the m", "share of objects with their own record",
         "lines: exp(−$C_m$ β √|S|)")  # fmt: skip
    return figure


def save(figure: Figure, path: Path) -> None:
    """Write a figure as SVG, atomically, with the same bytes for the same numbers."""
    import matplotlib

    with matplotlib.rc_context({"svg.hashsalt": "sameas"}), replacing(path) as draft:
        figure.savefig(draft, format="svg", metadata={"Date": None})

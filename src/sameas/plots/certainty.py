"""Expected errors of the identification by a cut on probability, and the identified share of the first catalogue."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sameas.plots.sheet import FIRST, FOUND, SECOND, sheet, tidy
from sameas.report.prose import count
from sameas.sky.crossmatch import SkyMatch

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def certainty(match: SkyMatch) -> Figure:
    """Expected numbers of wrong pairs and of lost true pairs against a cut on probability, and the identified share.

    The share is of the first catalogue against its magnitude; the panel is left out where it has none.
    """
    matches = match.result.matches
    title = f"Of {count(len(matches))} identified pairs {match.result.expected_wrong:.1f} are expected to be wrong"
    rows = f"{count(len(match.result.first))} usable rows of {match.first.name}"
    figure = sheet(title, f"{rows}, {count(len(match.result.second))} of {match.second.name}.")
    if not len(matches):
        return figure
    has_magnitude = match.first.magnitude is not None and np.isfinite(match.first.magnitude).any()
    axes = figure.subplots(1, 2 if has_magnitude else 1, squeeze=False)[0]
    _cut(axes[0], match)
    if has_magnitude:
        _reach(axes[1], match)
    return figure


def _cut(axes: Axes, match: SkyMatch) -> None:
    """Expected numbers of wrong pairs kept and of true pairs given up, against the least probability kept."""
    p = np.sort(match.result.matches.p_match)
    cuts = np.linspace(0.0, 0.999, 400)
    first_kept = np.searchsorted(p, cuts)
    below = np.concatenate([[0.0], np.cumsum(p)])[first_kept]
    wrong_above = np.concatenate([[0.0], np.cumsum((1.0 - p)[::-1])])[len(p) - first_kept]
    axes.plot(cuts, wrong_above, color=SECOND, lw=2.2)
    axes.plot(cuts, below, color=FIRST, lw=2.2)
    at = int(np.searchsorted(below, 0.5 * below[-1]))
    for words, place, shift, colour, side in (
        ("wrong pairs kept", (0.04, wrong_above[0]), (0, 6), SECOND, "left"),
        ("true pairs given up", (cuts[at], below[at]), (-6, 0), FIRST, "right"),
    ):
        axes.annotate(words, place, shift, textcoords="offset points", color=colour, ha=side)
    axes.set_xlim(0.0, 1.0)
    axes.set_ylim(bottom=0.0)
    tidy(axes, "least p_match that is kept", "expected number of pairs", "what a cut would do")


def _reach(axes: Axes, match: SkyMatch) -> None:
    magnitude = match.first.magnitude
    assert magnitude is not None
    usable = match.result.answers_1.usable & np.isfinite(magnitude)
    identified = usable & ~np.ma.getmaskarray(match.result.answers_1.partner)
    low, high = np.floor(magnitude[usable].min()), np.ceil(magnitude[usable].max())
    edges = np.arange(low, high + 0.5, 0.5)
    every = np.histogram(magnitude[usable], edges)[0]
    counted = np.histogram(magnitude[identified], edges)[0]
    with np.errstate(invalid="ignore"):
        share = np.where(every > 0, counted / np.maximum(every, 1), np.nan)
    middle = 0.5 * (edges[1:] + edges[:-1])
    axes.bar(middle, 100.0 * share, width=0.46, color=FOUND, alpha=0.85)
    for x, y, n in zip(middle, share, every, strict=True):
        if n:
            axes.text(x, 100.0 * y + 1.0, f"{n}", ha="center", va="bottom", fontsize=7.5, rotation=90)
    axes.set_ylim(0.0, 118.0)
    axes.set_yticks(range(0, 101, 20))
    brightness = f"{match.first.magnitude_name} of {match.first.name}  [mag]"
    tidy(axes, brightness, "identified  [%]", "share identified (number of rows above each bar)")

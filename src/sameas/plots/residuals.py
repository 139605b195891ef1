"""The offsets of the identified pairs on the sky, as observed and at the common epoch."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sameas.arrays import FloatArray
from sameas.plots.sheet import DENSITY, FAINT, INK, sheet, tidy
from sameas.report.prose import count
from sameas.sky.crossmatch import SkyMatch

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import QuadMesh
    from matplotlib.figure import Figure

#: Share of the offsets without motion within the panels, and of those with motion within the inset (chosen).
IN_PANEL = 0.95
IN_INSET = 0.98
#: Cells along a side of a panel.
BINS = 120


def residuals(match: SkyMatch) -> Figure:
    """Two maps of the offsets first minus second, each catalogue at its own epoch and both at the common one.

    The scale is that of the first map; an inset magnifies the second.
    """
    still, moved = match.still_offsets, match.result.matches.residual
    subtitle = f"{count(len(moved))} identified pairs. {_sentence(match.moved)}"
    figure = sheet(_finding(still, moved), subtitle, 11.0, 6.25)
    figure.set_layout_engine("compressed")
    if not len(moved):
        return figure
    left, right = figure.subplots(1, 2, sharex=True, sharey=True)
    names = f"{match.first.name} minus {match.second.name}"
    limit = _nice(np.quantile(np.abs(still).max(axis=1), IN_PANEL))
    limit = max(limit, _nice(np.quantile(np.abs(moved).max(axis=1), IN_INSET)))
    fullest = max(_counted(offsets, limit)[1].max() for offsets in (still, moved))
    for axes, offsets, title in ((left, still, _epochs(match)), (right, moved, _common(match))):
        mesh = _map(axes, offsets, limit, fullest)
        tidy(axes, f"east offset, {names} [arcsec]", "north offset [arcsec]", title)
        _numbers(axes, offsets, limit)
    right.set_ylabel("")
    close = _nice(np.quantile(np.abs(moved).max(axis=1), IN_INSET))
    if close < 0.34 * limit:
        _magnified(right, moved, close, limit)
    bar = figure.colorbar(mesh, ax=(left, right), pad=0.01, aspect=35, format="%g")
    bar.set_label("pairs per cell", fontsize=10)
    bar.ax.tick_params(labelsize=9)
    return figure


def _counted(offsets: FloatArray, limit: float) -> tuple[FloatArray, FloatArray]:
    """Edges of the cells within ±limit on both axes, and the pairs in each."""
    edges = np.linspace(-limit, limit, BINS + 1)
    return edges, np.histogram2d(offsets[:, 0], offsets[:, 1], bins=(edges, edges))[0]


def _map(axes: Axes, offsets: FloatArray, limit: float, fullest: float) -> QuadMesh:
    """Numbers of offsets within ±limit, in logarithmic colours; east is on the left."""
    from matplotlib.colors import LogNorm

    edges, number = _counted(offsets, limit)
    norm = LogNorm(0.7, max(float(fullest), 10.0))
    filled = np.ma.masked_equal(number, 0.0).T
    mesh = axes.pcolormesh(edges, edges, filled, cmap=DENSITY, norm=norm, rasterized=True)
    axes.set_aspect("equal")
    axes.set_xlim(limit, -limit)
    axes.set_ylim(-limit, limit)
    for line in (axes.axhline, axes.axvline):
        line(0.0, color=FAINT, linewidth=0.6, zorder=0)
    return mesh


def _numbers(axes: Axes, offsets: FloatArray, limit: float) -> None:
    distance = np.hypot(offsets[:, 0], offsets[:, 1])
    rms = np.sqrt(np.mean(offsets**2, axis=0))
    outside = np.mean(np.abs(offsets).max(axis=1) > limit)
    lines = [
        f"median distance  {_arcsec(np.median(distance))}",
        f"95 % within  {_arcsec(np.quantile(distance, 0.95))}",
        f"rms  {_arcsec(rms[0])} east, {_arcsec(rms[1])} north",
    ]
    if outside > 0:
        lines.append(f"{_percent(outside)} lie outside the panel")
    axes.text(
        0.025, 0.975, "\n".join(lines), transform=axes.transAxes, va="top", fontsize=9.5, linespacing=1.5,
        color=INK, bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.93, "pad": 3.0},
    )  # fmt: skip


def _magnified(axes: Axes, offsets: FloatArray, close: float, limit: float) -> None:
    """The middle of the map once more in its corner, with finer cells of their own colours."""
    inset = axes.inset_axes((0.60, 0.08, 0.38, 0.38))
    _map(inset, offsets, close, _counted(offsets, close)[1].max())
    inset.set_xticks([])
    inset.set_yticks([])
    words = f"{limit / close:.0f} × magnified: ±{close:g}″"
    inset.text(0.5, -0.04, words, transform=inset.transAxes, ha="center", va="top", fontsize=9.5, color=INK)
    axes.indicate_inset_zoom(inset, edgecolor=INK, linewidth=0.8, alpha=0.6)


def _finding(still: FloatArray, moved: FloatArray) -> str:
    if not len(moved):
        return "No pair was identified"
    before, after = (float(np.median(np.hypot(*offsets.T))) for offsets in (still, moved))
    change = f"median distance {_arcsec(before)} → {_arcsec(after)}"
    if after < 0.9 * before:
        return f"Motion brings the identified pairs together: {change}"
    if after > 1.1 * before:
        return f"Motion drives the identified pairs apart: {change}"
    return f"Motion changes little: the median distance of the identified pairs is {_arcsec(after)}"


def _epochs(match: SkyMatch) -> str:
    one, two = match.first.epoch_jyr, match.second.epoch_jyr
    if one is None or two is None:
        return "as observed"
    return f"without motion ({one:.2f} against {two:.2f})"


def _common(match: SkyMatch) -> str:
    return "nothing was moved" if match.epoch_jyr is None else f"with motion (both at {match.epoch_jyr:.2f})"


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:] + "."


def _nice(value: float) -> float:
    """The next of 1, 2, 3, 5, 7 times a power of ten."""
    power = 10.0 ** np.floor(np.log10(max(float(value), 1e-9)))
    return float(next(step * power for step in (1, 2, 3, 5, 7, 10) if step * power >= 0.999 * value))


def _arcsec(value: float) -> str:
    return f"{value:.2f}″" if value >= 0.1 else f"{1e3 * value:.3g} mas"


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %" if share >= 0.001 else f"{100 * share:.2g} %"

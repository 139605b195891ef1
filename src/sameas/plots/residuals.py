"""Plots of residuals: on the sky, in units of their quoted errors, and by quoted error and magnitude."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import FloatArray
from sameas.evidence import Errors
from sameas.plots.sheet import DENSITY, FAINT, FILL, FOUND, INK, SECOND, sheet, tidy
from sameas.records import unpack
from sameas.report.findings import by_source
from sameas.report.prose import percent
from sameas.representation import count
from sameas.sky.crossmatch import SkyMatch

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import QuadMesh
    from matplotlib.figure import Figure

#: Fraction of the offsets without motion inside the panels, and of those with motion inside the inset (chosen).
IN_PANEL = 0.95
IN_INSET = 0.98
#: Cells per side of a panel.
BINS = 120


def residuals(match: SkyMatch) -> Figure:
    """Two density maps of the offsets first minus second: catalogues at their own epochs, and at the common epoch.

    Both have the scale of the first; an inset magnifies the second.
    """
    still, moved = match.offsets_without_motion, match.result.matches.residual
    subtitle = f"{count(len(moved))} identified pairs. {_sentence(match, match.moved)}"
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
    """Edges of the cells within ±limit on both axes, and the number of pairs in each cell."""
    edges = np.linspace(-limit, limit, BINS + 1)
    return edges, np.histogram2d(offsets[:, 0], offsets[:, 1], bins=(edges, edges))[0]


def _map(axes: Axes, offsets: FloatArray, limit: float, fullest: float) -> QuadMesh:
    """Draws the number of offsets per cell within ±limit, in logarithmic colours; east is left."""
    from matplotlib.colors import LogNorm

    edges, number = _counted(offsets, limit)
    norm = LogNorm(0.7, max(float(fullest), 10.0))
    occupied = np.ma.masked_equal(number, 0.0).T
    mesh = axes.pcolormesh(edges, edges, occupied, cmap=DENSITY, norm=norm, rasterized=True)
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
    """An inset with the middle of the map, in finer cells with their own colour scale."""
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
        return f"Proper motion reduces the residuals: {change}"
    if after > 1.1 * before:
        return f"Proper motion increases the residuals: {change}"
    return f"Proper motion changes little: the median distance of the identified pairs is {_arcsec(after)}"


def _epochs(match: SkyMatch) -> str:
    one, two = match.first.epoch_jyr, match.second.epoch_jyr
    if one is None or two is None:
        return "as observed"
    return f"without motion ({one:.2f} against {two:.2f})"


def _common(match: SkyMatch) -> str:
    return "nothing was moved" if match.epoch_jyr is None else f"with motion (both at {match.epoch_jyr:.2f})"


def _sentence(match: SkyMatch, text: str) -> str:
    named = text.startswith((match.first.name, match.second.name))
    return (text if named else text[:1].upper() + text[1:]) + "."


def _nice(value: float) -> float:
    """The smallest of 1, 2, 3, 5, 7 times a power of ten that is at least the value."""
    power = 10.0 ** np.floor(np.log10(max(float(value), 1e-9)))
    return float(next(step * power for step in (1, 2, 3, 5, 7, 10) if step * power >= 0.999 * value))


def _arcsec(value: float) -> str:
    return f"{value:.2f}″" if value >= 0.1 else f"{1e3 * value:.3g} mas"


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %" if share >= 0.001 else f"{100 * share:.2g} %"


# Normalised offsets, compared with the distribution for correct errors and with the estimated one.


def normalised(match: SkyMatch) -> Figure:
    """Histograms of the identified pairs' normalised separations: core on a linear, tail on a logarithmic scale.

    With the Rayleigh density expected from the quoted errors, and the density of the estimated error distribution.
    """
    distance = match.result.matches.mahalanobis
    errors = match.estimate.spread
    figure = sheet(finding(match), _detail(match))
    if not len(distance):
        return figure
    bulk, tail = figure.subplots(1, 2)
    _bulk(bulk, distance, errors)
    _tail(tail, distance, errors)
    return figure


def _bulk(axes: Axes, distance: FloatArray, errors: Errors) -> None:
    end = max(5.0, 1.6 * float(np.quantile(distance, 0.9)))
    edges = np.linspace(0.0, end, 81)
    x = np.linspace(0.0, end, 400)
    height = np.histogram(distance, edges)[0] / (len(distance) * np.diff(edges))
    axes.stairs(height, edges, fill=True, color=FILL, label="identified pairs")
    axes.plot(x, rayleigh_mixture(x, Errors()), "--", color=SECOND, lw=2, label="quoted errors (Rayleigh)")
    axes.plot(x, rayleigh_mixture(x, errors), color=FOUND, lw=2.2, label="estimated error distribution")
    top = 1.06 * max(height.max(), 0.607)
    for value, colour, text, level in (
        (np.sqrt(2.0 * np.log(2.0)), SECOND, "due", 0.97),
        (np.median(distance), INK, "median", 0.88),
    ):
        axes.axvline(value, ymax=level / 1.06, color=colour, lw=1.0, ls=":")
        axes.annotate(f" {text} {value:.2f}", (value, level * top), color=colour, fontsize=9.5, va="top", ha="left")
    axes.set_xlim(0.0, end)
    axes.set_ylim(0.0, 1.06 * top)
    tidy(axes, "separation / its quoted error  [σ]", "density of pairs  [1/σ]", "core, linear scale")
    axes.legend(frameon=False, fontsize=9.5, loc="center right")


def _tail(axes: Axes, distance: FloatArray, errors: Errors) -> None:
    """Number of pairs per 0.05 dex of distance, so that a single pair is visible."""
    step = 0.05
    high = np.log10(max(10.0, 1.2 * float(distance.max())))
    edges = 10.0 ** np.arange(-1.0, high + step, step)
    x = np.geomspace(edges[0], edges[-1], 500)
    per_step = x * np.log(10.0) * step * len(distance)
    axes.stairs(np.histogram(distance, edges)[0], edges, fill=True, color=FILL, baseline=0.3)
    axes.plot(x, per_step * rayleigh_mixture(x, Errors()), "--", color=SECOND, lw=2)
    axes.plot(x, per_step * rayleigh_mixture(x, errors), color=FOUND, lw=2.2)
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_ylim(0.3, 3.0 * len(distance) * step)
    axes.set_xlim(edges[0], edges[-1])
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    beyond = int(np.count_nonzero(distance > 5.0))
    if beyond:
        axes.axvline(5.0, color=FAINT, lw=0.8, ls=":")
        due = len(distance) * np.exp(-12.5)
        words = f"beyond 5 σ: {count(beyond)} pairs;\n{due:.1g} expected of correct errors"
        axes.text(5.3, 1.6 * len(distance) * step, words, fontsize=9.5, color=INK, va="top")
    tidy(axes, "separation / its quoted error  [σ]", "pairs per 0.05 dex", "tail, logarithmic scale")


def rayleigh_mixture(distance: FloatArray, errors: Errors) -> FloatArray:
    """(n,) density of the normalised separation in two dimensions: Σ_k share_k m/s_k² exp(−m²/2s_k²)."""
    scales, shares = np.array(errors.scales), np.array(errors.shares)
    m = np.asarray(distance)[:, None]
    return np.asarray(np.sum(shares * m / scales**2 * np.exp(-0.5 * (m / scales) ** 2), axis=1))


def containment(errors: Errors, share: float) -> float:
    """Normalised separation in two dimensions that contains a fraction ``share`` of true pairs."""
    scales, shares = np.array(errors.scales), np.array(errors.shares)
    x = np.geomspace(1e-2, 10.0 * scales.max(), 4000)
    inside = 1.0 - np.exp(-0.5 * (x[:, None] / scales) ** 2) @ shares
    return float(np.interp(share, inside, x))


def finding(match: SkyMatch) -> str:
    """One sentence on whether the quoted errors are right."""
    e = match.estimate
    scale = e.quantities["error_scale"].value if "error_scale" in e.quantities else e.typical_scale
    if not len(match.result.matches):
        return "No pair was identified"
    if scale > 1.1:
        return f"The quoted errors are {scale:.2f} times too small for the typical pair"
    if scale < 0.9:
        return f"The quoted errors are too large: the typical pair scatters {scale:.2f} times as far"
    return "The typical pair scatters as its quoted errors"


def _detail(match: SkyMatch) -> str:
    words = f"{count(len(match.result.matches))} identified pairs of {match.first.name} and {match.second.name}."
    beyond = match.estimate.tail
    if beyond is not None:
        share = f"{percent(beyond.share.value)} of them have errors about {beyond.factor:.1f} times the quoted ones"
        words += f" A tail: {share}."
    return words


# Scatter of the identified pairs by quoted error and by magnitude.

#: Minimum number of pairs per bin, and maximum number of bins.
LEAST, MAX_BINS = 40, 16
#: Axes are logarithmic if errors differ by more than this factor.
FAR = 20.0
#: Median separation of two-dimensional normal errors over their σ, and √n times the relative error of that median.
DUE = math.sqrt(2.0 * math.log(2.0))
OF_MEDIAN = 1.0 / (DUE * DUE)


def scatter(match: SkyMatch) -> Figure:
    """Scatter of the identified pairs, σ on each axis, in bins of quoted error and of magnitude.

    With the quoted errors, and the estimated ones: scaled by a factor, or by factors and a floor.
    """
    figure = sheet(finding(match), _subtitle(match))
    pairs = match.result.matches
    if not len(pairs):
        return figure
    quoted, estimated = _sigmas(match)
    sigma = np.hypot(*pairs.residual.T) / DUE
    magnitude, words = _magnitude(match)
    by_error, sigmas = _bins(quoted), (sigma, quoted, estimated)
    # No panel by quoted error if these hardly differ.
    panels = (len(by_error) > 1 or magnitude is None) + (magnitude is not None)
    axes = figure.subplots(1, panels, squeeze=False)[0]
    spread = "scatter, σ on each axis  [arcsec]"
    if len(by_error) > 1 or magnitude is None:
        _against(axes[0], by_error, quoted, sigmas)
        tidy(axes[0], "quoted error of the pair, σ on each axis  [arcsec]", spread, "against the quoted error")
        _scaled(axes[0].set_xscale, quoted)
    if magnitude is not None:
        known = np.flatnonzero(np.isfinite(magnitude))
        _against(axes[-1], [known[part] for part in _bins(magnitude[known])], magnitude, sigmas)
        tidy(axes[-1], f"{words}  [mag]", spread, "against brightness")
    for one in axes:
        if not _scaled(one.set_yscale, quoted):
            one.set_ylim(bottom=0.0)
    axes[0].legend(frameon=False, fontsize=9.5)
    return figure


def _scaled(set_scale: Callable[[str], None], values: FloatArray) -> bool:
    """Makes an axis logarithmic if the values span a large range; returns whether it did."""
    low, high = np.quantile(values, (0.02, 0.98))
    far = bool(high > FAR * low)
    if far:
        set_scale("log")
    return far


def _subtitle(match: SkyMatch) -> str:
    # Room for one clause only: the reasons after the semicolon are in the report.
    words = by_source(match).partition(";")[0]
    return words[:1].upper() + words[1:] if words else "The errors were used as given, not estimated"


def _sigmas(match: SkyMatch) -> tuple[FloatArray, FloatArray]:
    """(k,) σ on each axis of the identified pairs, arcsec: as quoted, and as estimated."""
    pairs, chosen = match.result.pairs, match.result.matches.pair
    e = match.estimate
    one = unpack(pairs.first.covariance[pairs.i[chosen]], pairs.d)
    two = unpack(pairs.second.covariance[pairs.j[chosen]], pairs.d)
    of_1, of_2 = (0.5 * np.einsum("mvv->m", covariance) for covariance in (one, two))
    quoted = np.sqrt(of_1 + of_2)
    model = e.error_model
    if model is None or not model.is_estimated:
        scale = e.quantities["error_scale"].value if "error_scale" in e.quantities else e.typical_scale
        return quoted, scale * quoted
    return quoted, np.sqrt(model.variance(of_1, of_2))


def _magnitude(match: SkyMatch) -> tuple[FloatArray | None, str]:
    """(k,) magnitudes of the identified pairs, from the first catalogue that has enough, and their name."""
    pairs = match.result.matches
    for catalogue, rows in ((match.first, pairs.rows_1), (match.second, pairs.rows_2)):
        if catalogue.magnitude is not None and np.isfinite(catalogue.magnitude[rows]).sum() >= 2 * LEAST:
            return catalogue.magnitude[rows], f"{catalogue.magnitude_name} of {catalogue.name}"
    return None, ""


def _bins(values: FloatArray) -> list[NDArray[np.intp]]:
    """Indices of the values in ascending bins of equal number; one bin if the values hardly differ."""
    order = np.argsort(values, kind="stable")
    low, high = np.quantile(values, (0.02, 0.98))
    number = 1 if high - low <= 0.02 * abs(high) else max(1, min(MAX_BINS, len(values) // LEAST))
    return np.array_split(order, number)


def _against(
    axes: Axes, parts: Sequence[NDArray[np.intp]], along: FloatArray, sigmas: tuple[FloatArray, FloatArray, FloatArray]
) -> None:
    """Draws medians per bin: the scatter with its error, the quoted σ and the estimated σ."""
    x = np.array([np.median(along[part]) for part in parts])
    sigma, quoted, estimated = (np.array([np.median(values[part]) for part in parts]) for values in sigmas)
    error = OF_MEDIAN * sigma / np.sqrt([len(part) for part in parts])
    mark = "" if len(parts) > 1 else "_"
    axes.plot(x, quoted, "--", marker=mark, ms=18, color=SECOND, lw=2.0, label="as quoted")
    axes.plot(x, estimated, marker=mark, ms=18, color=FOUND, lw=2.2, label="as estimated")
    axes.errorbar(x, sigma, error, fmt="o", ms=4.5, color=INK, elinewidth=1.0, label="identified pairs, ± 1 σ")

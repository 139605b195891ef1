"""Plots of a match of two catalogues: residuals on the sky, their errors, certainty and completeness."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import FloatArray
from sameas.errors import InputError
from sameas.evidence import Errors
from sameas.evidence.detection import DetectionCurve
from sameas.plots.sheet import DENSITY, FAINT, FILL, FIRST, FOUND, INK, SECOND, sheet, short, tidy
from sameas.records import unpack
from sameas.report.estimates import by_source
from sameas.report.prose import expected, percent, times
from sameas.representation import count, counted
from sameas.sky.sky_match import ARCSEC2_PER_DEG2, SkyMatch

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import QuadMesh
    from matplotlib.figure import Figure

# Residuals on the sky, before and after motion.

#: Fraction of the offsets without motion inside the panels, and of those with motion inside the inset (chosen).
IN_PANEL = 0.95
IN_INSET = 0.98
#: Cells per side of a panel.
BINS = 120
#: Pairs are drawn as points if no cell has more than this number.
FEW_PER_CELL = 3
#: Offsets are the same before and after if none changes by more than this fraction of their median (chosen).
SAME = 0.01
#: Smallest half width of a panel, arcsec; smaller offsets are rounding.
LEAST_ANGLE = 1e-6


def residuals(match: SkyMatch) -> Figure:
    """Density maps of the offsets first minus second: as in the catalogues, and after motion and removed offsets.

    Points instead of a density where pairs are few.

    Both have the scale of the first; an inset magnifies the second. One map if nothing was moved.
    """
    still, moved = match.offsets_without_motion, match.result.matches.residual
    names = f"{match.first.name} minus {match.second.name}"
    subtitle = f"{count(len(moved))} identified pairs, {names}. {_sentence(match, match.moved)}"
    if not len(moved):
        return sheet("No pair was identified", subtitle, 11.0, 6.25)
    maps, title = [(moved, "")], f"Half of the identified pairs lie within {_angle(max(_median(moved), LEAST_ANGLE))}"
    if np.abs(still - moved).max() > max(SAME * _median(moved), LEAST_ANGLE):
        maps, title = [(still, _epochs(match)), (moved, _common(match))], _finding(match, still, moved)
    figure = sheet(title, subtitle, 11.0 if len(maps) > 1 else 8.0, 6.25)
    figure.set_layout_engine("compressed")
    panels = figure.subplots(1, len(maps), sharex=True, sharey=True, squeeze=False)[0]
    limit = _nice(np.quantile(np.abs(maps[0][0]).max(axis=1), IN_PANEL))
    close = max(_nice(np.quantile(np.abs(moved).max(axis=1), IN_INSET)), LEAST_ANGLE)
    limit = max(limit, close)
    factor, unit = _unit(limit)
    fullest = max(_counted(offsets, limit)[1].max() for offsets, _ in maps)
    for axes, (offsets, words) in zip(panels, maps, strict=True):
        mesh = _map(axes, factor * offsets, factor * limit, fullest)
        tidy(axes, f"east offset [{unit}]", f"north offset [{unit}]" if axes is panels[0] else "", words)
        _numbers(axes, offsets, limit)
    if close < 0.34 * limit:
        _magnified(panels[-1], factor * moved, factor * close, factor * limit, unit)
    if mesh is None:
        return figure
    bar = figure.colorbar(mesh, ax=list(panels), pad=0.01, aspect=35, format="%g")
    bar.set_label("pairs per cell", fontsize=10)
    bar.ax.tick_params(labelsize=9)
    _plain_ticks(bar.ax)
    return figure


def _plain_ticks(axes: Axes) -> None:
    """Numbers on the logarithmic y axis as 20 and 600, not 2 × 10¹ and 6 × 10²."""
    from matplotlib.ticker import LogFormatter

    axes.yaxis.set_minor_formatter(LogFormatter())
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")


def _counted(offsets: FloatArray, limit: float) -> tuple[FloatArray, FloatArray]:
    """Edges of the cells within ±limit on both axes, and the number of pairs in each cell."""
    edges = np.linspace(-limit, limit, BINS + 1)
    return edges, np.histogram2d(offsets[:, 0], offsets[:, 1], bins=(edges, edges))[0]


def _map(axes: Axes, offsets: FloatArray, limit: float, fullest: float) -> QuadMesh | None:
    """Draws the number of offsets per cell within ±limit, in logarithmic colours, or points if no cell has many; east
    is left."""
    from matplotlib.colors import LogNorm

    mesh = None
    if fullest <= FEW_PER_CELL:
        axes.plot(*offsets.T, "o", color=INK, markersize=3.0, markeredgewidth=0.0, alpha=0.7)
    else:
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
        f"median distance  {_angle(np.median(distance))}",
        f"95 % within  {_angle(np.quantile(distance, 0.95))}",
        f"rms  {_angle(rms[0])} east, {_angle(rms[1])} north",
    ]
    if outside > 0:
        lines.append(f"{_percent(outside)} lie outside the panel")
    axes.text(
        0.025, 0.975, "\n".join(lines), transform=axes.transAxes, va="top", fontsize=9.5, linespacing=1.5,
        color=INK, bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.93, "pad": 3.0},
    )  # fmt: skip


def _magnified(axes: Axes, offsets: FloatArray, close: float, limit: float, unit: str) -> None:
    """An inset with the middle of the map, in finer cells with their own colour scale."""
    inset = axes.inset_axes((0.60, 0.08, 0.38, 0.38))
    _map(inset, offsets, close, _counted(offsets, close)[1].max())
    inset.set_xticks([])
    inset.set_yticks([])
    words = f"{limit / close:.0f} × magnified: ±{close:g} {unit}"
    inset.text(0.5, -0.04, words, transform=inset.transAxes, ha="center", va="top", fontsize=9.5, color=INK)
    axes.indicate_inset_zoom(inset, edgecolor=INK, linewidth=0.8, alpha=0.6)


def _finding(match: SkyMatch, still: FloatArray, moved: FloatArray) -> str:
    before, after = _median(still), _median(moved)
    change = f"median distance {_angle(before)} → {_angle(after)}"
    cause = " and ".join(["proper motion"] * _has_moved(match) + ["the offset found"] * _has_offset(match))
    cause = cause[:1].upper() + cause[1:]
    verb = "" if " and " in cause else "s"
    if after < 0.9 * before:
        return f"{cause} reduce{verb} the residuals: {change}"
    if after > 1.1 * before:
        return f"{cause} increase{verb} the residuals: {change}"
    return f"{cause} change{verb} little: the median distance of the identified pairs is {_angle(after)}"


def _has_moved(match: SkyMatch) -> bool:
    """Whether a catalogue with proper motions was moved to the common epoch."""
    epoch = match.epoch_jyr
    return epoch is not None and any(
        one.has_motion and one.epoch_jyr is not None and abs(one.epoch_jyr - epoch) > 0.01
        for one in (match.first, match.second)
    )


def _has_offset(match: SkyMatch) -> bool:
    """Whether a shift, rotation or warp of the second catalogue was removed."""
    return match.rotation is not None or match.warp is not None


def _median(offsets: FloatArray) -> float:
    return float(np.median(np.hypot(*offsets.T)))


def _epochs(match: SkyMatch) -> str:
    one, two = match.first.epoch_jyr, match.second.epoch_jyr
    return "as in the catalogues" if one is None or two is None else f"as in the catalogues ({one:.2f}, {two:.2f})"


def _common(match: SkyMatch) -> str:
    words = ["offset removed"] * _has_offset(match)
    if match.epoch_jyr is not None:
        words.append(f"both at {match.epoch_jyr:.2f}")
    return ", ".join(words)


def _sentence(match: SkyMatch, text: str) -> str:
    named = text.startswith((match.first.name, match.second.name))
    return (text if named else text[:1].upper() + text[1:]) + "."


def _nice(value: float) -> float:
    """The smallest of 1, 2, 3, 5, 7 times a power of ten that is at least the value."""
    power = 10.0 ** np.floor(np.log10(max(float(value), 1e-9)))
    return float(next(step * power for step in (1, 2, 3, 5, 7, 10) if step * power >= 0.999 * value))


def _unit(largest_arcsec: float) -> tuple[float, str]:
    """The unit of an axis that ends at this value, and its number per arcsec."""
    if largest_arcsec >= 0.1:
        return 1.0, "arcsec"
    return (1e3, "mas") if largest_arcsec >= 1e-4 else (1e6, "µas")


def _angle(arcsec: float) -> str:
    factor, unit = _unit(arcsec)
    if factor == 1.0:
        return f"{arcsec:.2f}″"
    return f"{factor * arcsec:.3g} {unit}" if arcsec >= 0.1 * LEAST_ANGLE else "0"


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %" if share >= 0.001 else f"{100 * share:.2g} %"


# Normalised offsets, compared with the distribution for correct errors and with the estimated one.


def normalised(match: SkyMatch) -> Figure:
    """Histograms of the identified pairs' normalised separations: core on a linear, tail on a logarithmic scale.

    With the Rayleigh density expected from the quoted errors, and the density of the estimated error distribution.
    """
    distance = match.result.matches.mahalanobis
    errors = match.estimate.spread
    words = f"{count(len(match.result.matches))} identified pairs of {match.first.name} and {match.second.name}."
    beyond = match.estimate.tail
    if beyond is not None:
        share = f"{percent(beyond.share.value)} of them have errors about {times(beyond.factor)} times the quoted ones"
        words += f" A tail: {share}."
    figure = sheet(finding(match), words)
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
        (np.sqrt(2.0 * np.log(2.0)), SECOND, "expected median", 0.97),
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
    low = np.clip(np.floor(np.log10(max(float(np.quantile(distance, 0.01)), 1e-9))), -3.0, -1.0)
    edges = 10.0 ** np.arange(low, high + step, step)
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
        words = f"{scale:.2g} times as far" if scale >= 0.01 else "less than 0.01 times as far"
        return f"The quoted errors are too large: the typical pair scatters {words}"
    return "The typical pair scatters as its quoted errors"


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
    in_quoted = np.sqrt(match.result.pairs.mahalanobis_sq[pairs.pair]) / DUE
    magnitude, words = _magnitude(match)
    by_error = _bins(quoted)
    factor, unit = _unit(float(np.median(quoted) * max(np.median(in_quoted), 1.0)))
    quoted = factor * quoted
    sigmas = in_quoted, quoted, factor * estimated
    # No panel by quoted error if these hardly differ.
    panels = (len(by_error) > 1 or magnitude is None) + (magnitude is not None)
    axes = figure.subplots(1, panels, squeeze=False)[0]
    spread = f"scatter, σ on each axis  [{unit}]"
    if len(by_error) > 1 or magnitude is None:
        _against(axes[0], by_error, quoted, sigmas)
        tidy(axes[0], f"quoted error of the pair, σ on each axis  [{unit}]", spread, "against the quoted error")
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
    return f"Estimated errors: {words}" if words else "The errors were used as given, not estimated"


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
            return catalogue.magnitude[rows], f"{catalogue.magnitude_name} of {short(catalogue.name)}"
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
    """Draws medians per bin: the scatter with its error, the quoted σ and the estimated σ.

    sigmas : the scatter in units of the quoted σ, the quoted σ and the estimated σ. Among pairs of unequal errors, or
    of long ellipses, the median of the separations alone would be smaller than that of the σ.
    """
    x = np.array([np.median(along[part]) for part in parts])
    sigma, quoted, estimated = (np.array([np.median(values[part]) for part in parts]) for values in sigmas)
    sigma *= quoted
    error = OF_MEDIAN * sigma / np.sqrt([len(part) for part in parts])
    mark = "" if len(parts) > 1 else "_"
    axes.plot(x, quoted, "--", marker=mark, ms=18, color=SECOND, lw=2.0, label="as quoted")
    axes.plot(x, estimated, marker=mark, ms=18, color=FOUND, lw=2.2, label="as estimated")
    axes.errorbar(x, sigma, error, fmt="o", ms=4.5, color=INK, elinewidth=1.0, label="identified pairs, ± 1 σ")


# Expected errors of the identification by a cut on probability, and the identified share of the first catalogue.

#: 1 minus the highest cut on probability of the plot.
SUREST = 1e-4


def certainty(match: SkyMatch) -> Figure:
    """Expected numbers of wrong and of lost true pairs by a cut on probability, and the identified share by magnitude.

    The share is that of the first catalogue; without magnitudes there is no such panel.
    """
    matches = match.result.matches
    wrong = expected(match.result.expected_wrong)
    title = f"Of {count(len(matches))} identified pairs {wrong} are expected to be wrong"
    rows = f"{count(len(match.result.first))} usable rows of {match.first.name}"
    figure = sheet(title, f"{rows}, {count(len(match.result.second))} of {match.second.name}.")
    if not len(matches):
        return figure
    has_magnitude = match.first.magnitude is not None and np.isfinite(match.first.magnitude).any()
    axes = figure.subplots(1, 2 if has_magnitude else 1, squeeze=False)[0]
    _by_cut(axes[0], match)
    if has_magnitude:
        _share_identified(axes[1], match)
    return figure


def _by_cut(axes: Axes, match: SkyMatch) -> None:
    """Expected numbers of wrong pairs kept and of true pairs lost, by the minimum probability kept."""
    from matplotlib.ticker import FuncFormatter, NullLocator

    p = np.sort(match.result.matches.p_match)
    # A cut matters near 1: the axis is logarithmic in 1 − p.
    doubt = np.geomspace(1.0, SUREST, 400)
    cuts = 1.0 - doubt
    first_kept = np.searchsorted(p, cuts)
    below = np.concatenate([[0.0], np.cumsum(p)])[first_kept]
    wrong_above = np.concatenate([[0.0], np.cumsum((1.0 - p)[::-1])])[len(p) - first_kept]
    axes.plot(doubt, wrong_above, color=SECOND, lw=2.2, clip_on=False, label="wrong pairs kept")
    axes.plot(doubt, below, color=FIRST, lw=2.2, clip_on=False, label="true pairs lost")
    axes.set_xscale("log")
    axes.set_xlim(1.0, SUREST)
    shown = (1.0, 0.5, 0.1, 0.01, 1e-3, 1e-4)
    axes.set_xticks(shown, [f"{1.0 - value:g}" for value in shown])
    axes.xaxis.set_minor_locator(NullLocator())
    # Few wrong pairs and many lost ones must both be readable.
    axes.set_yscale("symlog", linthresh=10.0)
    top = max(float(below.max()), float(wrong_above.max()), 1.0)
    axes.set_yticks(
        [0.0, *(step * 10.0**power for power in range(8) for step in (1, 2, 5) if step * 10.0**power <= top)]
    )
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_locator(NullLocator())
    axes.set_ylim(0.0, 1.05 * top)
    axes.legend(frameon=False, fontsize=9.5)
    tidy(axes, "lowest p_match kept", "expected number of pairs", "wrong pairs kept and true pairs lost by a cut")


def _share_identified(axes: Axes, match: SkyMatch) -> None:
    magnitude = match.first.magnitude
    assert magnitude is not None
    identified = ~np.ma.getmaskarray(match.result.answers_1.partner)
    usable = match.result.answers_1.usable & np.isfinite(magnitude) & (match.covered_1 | identified)
    identified &= usable
    low, high = np.floor(magnitude[usable].min()), np.ceil(magnitude[usable].max())
    edges = np.arange(low, high + 0.5, 0.5)
    total = np.histogram(magnitude[usable], edges)[0]
    matched = np.histogram(magnitude[identified], edges)[0]
    with np.errstate(invalid="ignore"):
        share = np.where(total > 0, matched / np.maximum(total, 1), np.nan)
    middle = 0.5 * (edges[1:] + edges[:-1])
    axes.bar(middle, 100.0 * share, width=0.46, color=FOUND, alpha=0.85)
    for x, y, n in zip(middle, share, total, strict=True):
        if n:
            axes.text(x, 100.0 * y + 1.0, f"{n}", ha="center", va="bottom", fontsize=7.5, rotation=90)
    axes.set_ylim(0.0, 118.0)
    axes.set_yticks(range(0, 101, 20))
    brightness = f"{match.first.magnitude_name} of {short(match.first.name)}  [mag]"
    tidy(axes, brightness, "identified  [%]", "share identified of the rows covered (numbers)")


# Completeness by magnitude, density of records without a partner, and the relation of the magnitudes.

#: Maximum number of pairs drawn.
MAX_DOTS = 5000


def brightness(match: SkyMatch) -> Figure:
    """Completeness of each catalogue and density of its records without a partner, by magnitude; magnitudes of pairs.

    Raises InputError: no magnitudes were used.
    """
    e = match.estimate
    if e.photometry is None:
        raise InputError("no magnitudes were used in this match; give both catalogues one, and not magnitudes off")
    relation = e.photometry.first_relation
    names = e.photometry.names[0][0], e.photometry.names[1][0]
    title = f"Magnitudes change {counted(e.changed_by_brightness, 'answer')}"
    subtitle = "" if relation is None else f"Zero point {e.quantities['zero_point']}, scatter {e.quantities['scatter']}"
    figure = sheet(title, subtitle, 15.0)
    left, middle, right = figure.subplots(1, 3)
    for curve, mine, colour in ((e.detection_1, match.first, FIRST), (e.detection_2, match.second, SECOND)):
        if curve is not None:
            _completeness(left, curve, f"{short(mine.name)}, {curve.band}", colour)
            _alone(middle, curve, f"{short(mine.name)}, {curve.band}", colour)
    left.set_ylim(0.0, 105.0)
    middle.set_yscale("log")
    _plain_ticks(middle)
    for axes in (left, middle):
        if axes.lines:
            axes.legend(frameon=False, fontsize=9)
    bands = "magnitude in the catalogue's first band  [mag]"
    tidy(left, bands, "also in the other catalogue  [%]", "objects also in the other catalogue, ± 1 σ")
    tidy(middle, bands, "per square degree and magnitude", "objects in this catalogue only, ± 1 σ")
    _relation(right, match, names)
    return figure


def _completeness(axes: Axes, curve: DetectionCurve, label: str, colour: str) -> None:
    half = 0.5 * np.diff(curve.edges)
    axes.errorbar(
        curve.middle, 100.0 * curve.probability, 100.0 * curve.standard_error, half, fmt="o-", ms=3.5, lw=1.0,
        color=colour, label=label,
    )  # fmt: skip


def _alone(axes: Axes, curve: DetectionCurve, label: str, colour: str) -> None:
    """Density of the records without a partner in the other catalogue; bins below one standard error are not drawn."""
    some = curve.density > curve.density_error
    density, error = ARCSEC2_PER_DEG2 * curve.density[some], ARCSEC2_PER_DEG2 * curve.density_error[some]
    half = 0.5 * np.diff(curve.edges)[some]
    axes.errorbar(
        curve.middle[some], density, (np.minimum(error, 0.7 * density), error), half, fmt="o-", ms=3.5, lw=1.0,
        color=colour, label=label,
    )  # fmt: skip


def _relation(axes: Axes, match: SkyMatch, names: tuple[str, str]) -> None:
    """Magnitude differences of the identified pairs, with their fitted mean and scatter."""
    photometry, matches = match.estimate.photometry, match.result.matches
    assert photometry is not None
    first, second = match.result.first, match.result.second
    i = match.result.pairs.i[matches.pair]
    j = match.result.pairs.j[matches.pair]
    one = photometry.sides[0].measured.values[i, 0]
    two = photometry.sides[1].measured.values[j, 0]
    some = slice(None, None, max(1, -(-len(one) // MAX_DOTS)))
    axes.plot(two[some], (one - two)[some], ".", ms=2.0, color=FAINT, alpha=0.5, rasterized=True)
    relation = photometry.first_relation
    if relation is not None:
        axes.plot(relation.knots, relation.offset, color=FOUND, lw=2.0)
        low, high = relation.offset - relation.scatter, relation.offset + relation.scatter
        axes.fill_between(relation.knots, low, high, color=FOUND, alpha=0.2, lw=0)
        axes.annotate(
            f"{percent(relation.unrelated)} of the pairs are off the relation", (0.98, 0.02), xycoords="axes fraction",
            ha="right", fontsize=9, color=INK,
        )  # fmt: skip
        reach = 6.0 * float(relation.scatter.max()) + 0.3
        axes.set_ylim(float(relation.offset.min()) - reach, float(relation.offset.max()) + reach)
    own = ("", "") if names[0] != names[1] else (f" of {short(first.source)}\n", f" of {short(second.source)}")
    label = f"{names[0]}{own[0]} − {names[1]}{own[1]}  [mag]"
    tidy(axes, f"{names[1]} of {short(second.source)}  [mag]", label, "identified pairs, mean and scatter")

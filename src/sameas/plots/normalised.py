"""Offsets in units of their quoted errors, against the distribution for correct errors and the estimated one."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sameas.arrays import FloatArray
from sameas.evidence import Errors
from sameas.plots.sheet import FAINT, FILL, FOUND, INK, SECOND, sheet, tidy
from sameas.report.prose import count, percent
from sameas.sky.crossmatch import SkyMatch

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def normalised(match: SkyMatch) -> Figure:
    """Histograms of the identified pairs' normalised separations: the bulk linear, the tail logarithmic.

    With them the Rayleigh density that the quoted errors promise, and that of the errors that were estimated.
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
    axes.plot(x, rayleigh_mixture(x, errors), color=FOUND, lw=2.2, label="estimated spread of the errors")
    top = 1.06 * max(height.max(), 0.607)
    for value, colour, text, level in (
        (np.sqrt(2.0 * np.log(2.0)), SECOND, "due", 0.97),
        (np.median(distance), INK, "median", 0.88),
    ):
        axes.axvline(value, ymax=level / 1.06, color=colour, lw=1.0, ls=":")
        axes.annotate(f" {text} {value:.2f}", (value, level * top), color=colour, fontsize=9.5, va="top", ha="left")
    axes.set_xlim(0.0, end)
    axes.set_ylim(0.0, 1.06 * top)
    tidy(axes, "separation / its quoted error  [σ]", "density of pairs  [1/σ]", "the bulk, linear")
    axes.legend(frameon=False, fontsize=9.5, loc="center right")


def _tail(axes: Axes, distance: FloatArray, errors: Errors) -> None:
    """Pairs per step of 10^0.05 in distance: the same areas, counted, so that one pair can be seen."""
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
        words = f"beyond 5 σ: {count(beyond)} pairs;\nhonest errors would leave {due:.1g}"
        axes.text(5.3, 1.6 * len(distance) * step, words, fontsize=9.5, color=INK, va="top")
    tidy(axes, "separation / its quoted error  [σ]", "pairs per 0.05 dex", "the tail, logarithmic")


def rayleigh_mixture(distance: FloatArray, errors: Errors) -> FloatArray:
    """(n,) density of the normalised separation in two dimensions: Σ_k share_k m/s_k² exp(−m²/2s_k²)."""
    scales, shares = np.array(errors.scales), np.array(errors.shares)
    m = np.asarray(distance)[:, None]
    return np.asarray(np.sum(shares * m / scales**2 * np.exp(-0.5 * (m / scales) ** 2), axis=1))


def containment(errors: Errors, share: float) -> float:
    """Normalised separation in two dimensions within which ``share`` of true pairs lie."""
    scales, shares = np.array(errors.scales), np.array(errors.shares)
    x = np.geomspace(1e-2, 10.0 * scales.max(), 4000)
    inside = 1.0 - np.exp(-0.5 * (x[:, None] / scales) ** 2) @ shares
    return float(np.interp(share, inside, x))


def finding(match: SkyMatch) -> str:
    """Whether the quoted errors are right, in a sentence."""
    e = match.estimate
    scale = e.quantities["error_scale"].value if "error_scale" in e.quantities else e.typical_scale
    if not len(match.result.matches):
        return "No pair was identified"
    if scale > 1.1:
        return f"The quoted errors are {scale:.2f} times too small for the typical pair"
    if scale < 0.9:
        return f"The quoted errors are too large: the typical pair scatters {scale:.2f} times as far"
    return "The typical pair scatters as its quoted errors say"


def _detail(match: SkyMatch) -> str:
    words = f"{count(len(match.result.matches))} identified pairs of {match.first.name} and {match.second.name}."
    beyond = match.estimate.tail
    if beyond is not None:
        share = f"{percent(beyond.share.value)} of them have errors about {beyond.factor:.1f} times the quoted ones"
        words += f" A tail: {share}."
    return words

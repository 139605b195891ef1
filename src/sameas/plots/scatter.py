"""Scatter of the identified pairs against their quoted errors and against brightness."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import FloatArray
from sameas.plots.normalised import finding
from sameas.plots.sheet import FOUND, INK, SECOND, sheet, tidy
from sameas.records import unpack
from sameas.report.findings import by_source
from sameas.sky.crossmatch import SkyMatch

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Fewest pairs of a bin, and most bins.
LEAST, MOST_BINS = 40, 16
#: Axes are logarithmic where errors differ by more than this factor.
FAR = 20.0
#: Median separation of two-dimensional normal errors over their σ, and √n times the relative error of that median.
DUE = math.sqrt(2.0 * math.log(2.0))
OF_MEDIAN = 1.0 / (DUE * DUE)


def scatter(match: SkyMatch) -> Figure:
    """Scatter of the identified pairs, σ on each axis, in bins of quoted error and of magnitude.

    With them the quoted errors, and the estimated ones: by a factor, or by factors and a floor.
    """
    figure = sheet(finding(match), _subtitle(match))
    pairs = match.result.matches
    if not len(pairs):
        return figure
    quoted, estimated = _sigmas(match)
    scattered = np.hypot(*pairs.residual.T) / DUE
    magnitude, words = _magnitude(match)
    by_error, drawn = _bins(quoted), (scattered, quoted, estimated)
    # No panel against quoted errors that hardly differ.
    panels = (len(by_error) > 1 or magnitude is None) + (magnitude is not None)
    axes = figure.subplots(1, panels, squeeze=False)[0]
    spread = "scatter, σ on each axis  [arcsec]"
    if len(by_error) > 1 or magnitude is None:
        _against(axes[0], by_error, quoted, drawn)
        tidy(axes[0], "quoted error of the pair, σ on each axis  [arcsec]", spread, "against the quoted error")
        _scaled(axes[0].set_xscale, quoted)
    if magnitude is not None:
        known = np.flatnonzero(np.isfinite(magnitude))
        _against(axes[-1], [known[part] for part in _bins(magnitude[known])], magnitude, drawn)
        tidy(axes[-1], f"{words}  [mag]", spread, "against brightness")
    for one in axes:
        if not _scaled(one.set_yscale, quoted):
            one.set_ylim(bottom=0.0)
    axes[0].legend(frameon=False, fontsize=9.5)
    return figure


def _scaled(set_scale: Callable[[str], None], values: FloatArray) -> bool:
    """Makes an axis logarithmic where the values reach far; whether it did."""
    low, high = np.quantile(values, (0.02, 0.98))
    far = bool(high > FAR * low)
    if far:
        set_scale("log")
    return far


def _subtitle(match: SkyMatch) -> str:
    # The line is short: the reasons after the semicolon are in the report.
    words = by_source(match).partition(";")[0]
    return words[:1].upper() + words[1:] if words else "The errors were taken as they were given, not estimated"


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
    """(k,) of the identified pairs, from the first catalogue that has some, and its name."""
    pairs = match.result.matches
    for catalogue, rows in ((match.first, pairs.rows_1), (match.second, pairs.rows_2)):
        if catalogue.magnitude is not None and np.isfinite(catalogue.magnitude[rows]).sum() >= 2 * LEAST:
            return catalogue.magnitude[rows], f"{catalogue.magnitude_name} of {catalogue.name}"
    return None, ""


def _bins(values: FloatArray) -> list[NDArray[np.intp]]:
    """Positions of the values in bins of equal number, rising; one bin where the values hardly differ."""
    order = np.argsort(values, kind="stable")
    low, high = np.quantile(values, (0.02, 0.98))
    number = 1 if high - low <= 0.02 * abs(high) else max(1, min(MOST_BINS, len(values) // LEAST))
    return np.array_split(order, number)


def _against(
    axes: Axes, parts: Sequence[NDArray[np.intp]], along: FloatArray, sigmas: tuple[FloatArray, FloatArray, FloatArray]
) -> None:
    """Medians in bins along some values: the scatter with its error, the quoted σ, the estimated σ."""
    x = np.array([np.median(along[part]) for part in parts])
    scattered, quoted, estimated = (np.array([np.median(values[part]) for part in parts]) for values in sigmas)
    error = OF_MEDIAN * scattered / np.sqrt([len(part) for part in parts])
    mark = "" if len(parts) > 1 else "_"
    axes.plot(x, quoted, "--", marker=mark, ms=18, color=SECOND, lw=2.0, label="as quoted")
    axes.plot(x, estimated, marker=mark, ms=18, color=FOUND, lw=2.2, label="as estimated")
    axes.errorbar(x, scattered, error, fmt="o", ms=4.5, color=INK, elinewidth=1.0, label="identified pairs, ± 1 σ")

"""Magnitudes: completeness of either catalogue, density of its unmatched records, relation of the magnitudes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sameas.errors import InputError
from sameas.evidence.detection import DetectionCurve
from sameas.plots.sheet import FAINT, FIRST, FOUND, INK, SECOND, sheet, tidy
from sameas.report.prose import percent
from sameas.sky.crossmatch import ARCSEC2_PER_DEG2, SkyMatch

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Most dots.
MOST_DOTS = 5000


def brightness(match: SkyMatch) -> Figure:
    """Completeness of either catalogue and density of what it has alone by magnitude; the pairs' magnitudes compared.

    Raises
    ------
    InputError : no magnitudes were used.
    """
    e = match.estimate
    if e.photometry is None:
        raise InputError("no magnitudes were used in this match; give both catalogues one, and not magnitudes off")
    relation = e.photometry.first_relation
    names = e.photometry.names[0][0], e.photometry.names[1][0]
    title = f"Brightness changes {e.changed_by_brightness} of the answers"
    subtitle = "" if relation is None else f"Zero point {e.quantities['zero_point']}, scatter {e.quantities['scatter']}"
    figure = sheet(title, subtitle, 15.0)
    left, middle, right = figure.subplots(1, 3)
    for curve, mine, other, colour in (
        (e.detection_1, match.first.name, match.second.name, FIRST),
        (e.detection_2, match.second.name, match.first.name, SECOND),
    ):
        if curve is not None:
            _completeness(left, curve, f"{mine}, shown by {other}", colour)
            _alone(middle, curve, f"{mine} alone", colour)
    left.set_ylim(0.0, 105.0)
    middle.set_yscale("log")
    for axes in (left, middle):
        if axes.lines:
            axes.legend(frameon=False, fontsize=9)
    bands = "magnitude in the first band of each  [mag]"
    tidy(left, bands, "also in the other  [%]", "completeness, ± 1 σ")
    tidy(
        middle,
        "magnitude in the first band of each  [mag]",
        "per square degree and magnitude",
        "those in one only, ± 1 σ",
    )
    _relation(right, match, names)
    return figure


def _completeness(axes: Axes, curve: DetectionCurve, label: str, colour: str) -> None:
    half = 0.5 * np.diff(curve.edges)
    axes.errorbar(
        curve.middle, 100.0 * curve.probability, 100.0 * curve.standard_error, half, fmt="o-", ms=3.5, lw=1.0,
        color=colour, label=f"{label} ({curve.band})",
    )  # fmt: skip


def _alone(axes: Axes, curve: DetectionCurve, label: str, colour: str) -> None:
    """Density of the records without a partner in the other catalogue; bins without any are left out."""
    some = curve.density > curve.density_error
    density, error = ARCSEC2_PER_DEG2 * curve.density[some], ARCSEC2_PER_DEG2 * curve.density_error[some]
    half = 0.5 * np.diff(curve.edges)[some]
    axes.errorbar(
        curve.middle[some], density, (np.minimum(error, 0.7 * density), error), half, fmt="o-", ms=3.5, lw=1.0,
        color=colour, label=label,
    )  # fmt: skip


def _relation(axes: Axes, match: SkyMatch, names: tuple[str, str]) -> None:
    """Magnitude differences of the identified pairs, with the curve of the mean and its scatter."""
    photometry, matches = match.estimate.photometry, match.result.matches
    assert photometry is not None
    first, second = match.result.first, match.result.second
    i = match.result.pairs.i[matches.pair]
    j = match.result.pairs.j[matches.pair]
    one = photometry.sides[0].measured.values[i, 0]
    two = photometry.sides[1].measured.values[j, 0]
    some = slice(None, None, max(1, -(-len(one) // MOST_DOTS)))
    axes.plot(two[some], (one - two)[some], ".", ms=2.0, color=FAINT, alpha=0.5, rasterized=True)
    relation = photometry.first_relation
    if relation is not None:
        axes.plot(relation.knots, relation.offset, color=FOUND, lw=2.0)
        low, high = relation.offset - relation.scatter, relation.offset + relation.scatter
        axes.fill_between(relation.knots, low, high, color=FOUND, alpha=0.2, lw=0)
        axes.annotate(
            f"{percent(relation.unrelated)} of the pairs follow no relation", (0.98, 0.02), xycoords="axes fraction",
            ha="right", fontsize=9, color=INK,
        )  # fmt: skip
        reach = 6.0 * float(relation.scatter.max()) + 0.3
        axes.set_ylim(float(relation.offset.min()) - reach, float(relation.offset.max()) + reach)
    own = ("", "") if names[0] != names[1] else (f" of {first.source}", f" of {second.source}")
    label = f"{names[0]}{own[0]} − {names[1]}{own[1]}  [mag]"
    tidy(axes, f"{names[1]} of {second.source}  [mag]", label, "identified pairs, mean and scatter")

"""Plots of certainty and completeness: by a cut on probability, and by magnitude.

Also the density of records without a partner, and the relation of the magnitudes of both catalogues.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sameas.errors import InputError
from sameas.evidence.detection import DetectionCurve
from sameas.plots.sheet import FAINT, FIRST, FOUND, INK, SECOND, sheet, tidy
from sameas.report.prose import percent
from sameas.representation import count
from sameas.sky.crossmatch import ARCSEC2_PER_DEG2, SkyMatch

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Expected errors of the identification by a cut on probability, and the identified share of the first catalogue.

#: 1 minus the highest cut on probability of the plot.
SUREST = 1e-4


def certainty(match: SkyMatch) -> Figure:
    """Expected numbers of wrong and of lost true pairs by a cut on probability, and the identified share by magnitude.

    The share is that of the first catalogue; without magnitudes there is no such panel.
    """
    matches = match.result.matches
    title = f"Of {count(len(matches))} identified pairs {match.result.expected_wrong:.1f} are expected to be wrong"
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
    axes.plot(doubt, wrong_above, color=SECOND, lw=2.2)
    axes.plot(doubt, below, color=FIRST, lw=2.2)
    at = int(np.searchsorted(below, 0.5 * below[-1]))
    for words, place, shift, colour, side in (
        ("wrong pairs kept", (doubt[200], wrong_above[200]), (0, 6), SECOND, "left"),
        ("true pairs given up", (doubt[at], below[at]), (-6, 0), FIRST, "right"),
    ):
        axes.annotate(words, place, shift, textcoords="offset points", color=colour, ha=side)
    axes.set_xscale("log")
    axes.set_xlim(1.0, SUREST)
    shown = (1.0, 0.5, 0.1, 0.01, 1e-3, 1e-4)
    axes.set_xticks(shown, [f"{1.0 - value:g}" for value in shown])
    axes.xaxis.set_minor_locator(NullLocator())
    # Few wrong pairs and many lost ones must both be readable.
    axes.set_yscale("symlog", linthresh=10.0)
    top = max(float(below.max()), float(wrong_above.max()), 1.0)
    axes.set_yticks(
        [0.0, *(step * 10.0**power for power in range(8) for step in (2, 5, 10) if step * 10.0**power <= top)]
    )
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_locator(NullLocator())
    axes.set_ylim(bottom=0.0)
    tidy(axes, "lowest p_match kept", "expected number of pairs", "pairs kept and lost by a cut in p_match")


def _share_identified(axes: Axes, match: SkyMatch) -> None:
    magnitude = match.first.magnitude
    assert magnitude is not None
    usable = match.result.answers_1.usable & np.isfinite(magnitude)
    identified = usable & ~np.ma.getmaskarray(match.result.answers_1.partner)
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
    brightness = f"{match.first.magnitude_name} of {match.first.name}  [mag]"
    tidy(axes, brightness, "identified  [%]", "share identified (rows above each bar)")


#: Maximum number of pairs drawn.
MAX_DOTS = 5000


def brightness(match: SkyMatch) -> Figure:
    """Completeness of each catalogue and density of its records without a partner, by magnitude; magnitudes of pairs.

    Raises
    ------
    InputError : no magnitudes were used.
    """
    e = match.estimate
    if e.photometry is None:
        raise InputError("no magnitudes were used in this match; give both catalogues one, and not magnitudes off")
    relation = e.photometry.first_relation
    names = e.photometry.names[0][0], e.photometry.names[1][0]
    title = f"Magnitudes change {e.changed_by_brightness} of the answers"
    subtitle = "" if relation is None else f"Zero point {e.quantities['zero_point']}, scatter {e.quantities['scatter']}"
    figure = sheet(title, subtitle, 15.0)
    left, middle, right = figure.subplots(1, 3)
    for curve, mine, other, colour in (
        (e.detection_1, match.first.name, match.second.name, FIRST),
        (e.detection_2, match.second.name, match.first.name, SECOND),
    ):
        if curve is not None:
            _completeness(left, curve, f"{mine}, also in {other}", colour)
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
        "objects in one catalogue only, ± 1 σ",
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
    own = ("", "") if names[0] != names[1] else (f" of {first.source}", f" of {second.source}")
    label = f"{names[0]}{own[0]} − {names[1]}{own[1]}  [mag]"
    tidy(axes, f"{names[1]} of {second.source}  [mag]", label, "identified pairs, mean and scatter")

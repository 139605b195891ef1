"""One group of competing records drawn on the sky: error ellipses, candidates, probabilities."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from sameas.arrays import FloatArray, IntArray
from sameas.errors import InputError
from sameas.plots.match import containment
from sameas.plots.sheet import FAINT, FIRST, FOUND, INK, SECOND, TangentAxes, ellipse, nice_length, sheet, tidy
from sameas.records import Records
from sameas.representation import counted
from sameas.result import Identification
from sameas.sky.catalogue import Catalogue
from sameas.sky.sky_match import SkyMatch

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Maximum size of a group that is chosen automatically; larger plots are not readable.
READABLE = 12
#: Maximum size of a group that the user chooses.
DRAWABLE = 60
#: Share of the true partners inside the dashed contour.
INSIDE = 0.99
#: The contour is drawn if its radius exceeds this, σ. For normal errors the radius is 3.03 σ.
MIN_CONTOUR = 3.2
#: Minimum probability of the candidates drawn, other than those of the requested record.
MIN_DRAWN = 1e-3
DASHES = (0, (5, 4))


@dataclass(frozen=True)
class _CatalogueSide:
    """The records of one catalogue in the group.

    position : (n,) indices in the result's records. place : (n, 2) arcsec east and north of the middle.
    covariance : (n, 2, 2) arcsec². names : labels. colour, marker : style.
    """

    catalogue: Catalogue
    position: IntArray
    place: FloatArray
    covariance: FloatArray
    names: list[str]
    colour: str
    marker: str

    @property
    def errors(self) -> FloatArray:
        """(n,) error on each axis, arcsec."""
        return np.sqrt(np.trace(self.covariance, axis1=1, axis2=2) / 2.0)

    @property
    def size(self) -> float:
        """The typical error in arcsec."""
        return float(np.sqrt(np.median(self.errors**2)))


def most_ambiguous(match: SkyMatch) -> int:
    """Number of the most ambiguous group of at least three records.

    It has the largest Σ H(p) over its candidates, H the entropy of a pair's probability.

    Raises InputError: no record has two candidates.
    """
    result = match.result
    p = np.clip(result.p_pair, 1e-15, 1.0 - 1e-15)
    entropy = -p * np.log(p) - (1.0 - p) * np.log1p(-p)
    total = np.bincount(result.groups.of_pairs(), entropy, len(result.groups))
    size = result.groups.sizes_1 + result.groups.sizes_2
    open_groups = (size >= 3) & (size <= READABLE)
    if not open_groups.any():
        raise InputError(
            f"{match.first.name} and {match.second.name}: no record has two candidates in a group of up to "
            f"{READABLE} records; nothing to plot is ambiguous"
        )
    return int(np.argmax(np.where(open_groups, total, -1.0)))


def group(match: SkyMatch, *, record: Any = None, source: int = 1) -> Figure:
    """A group of competing records with their error ellipses at the common epoch.

    Solid ellipses are 1, 2 and 3 quoted σ; the dashed one contains 99 % of true partners by the estimated error
    distribution. Every candidate pair is a line with its probability, identified pairs are thick. North is up,
    east left.

    record : id of a record of the group; None: the most ambiguous group.
    source : 1 or 2, the catalogue of the id.

    Raises InputError: an unknown id, a record without candidates, a group of more than 60, nothing ambiguous.
    """
    result = match.result
    if record is None:
        number = most_ambiguous(match)
    else:
        group_of_record = result.explain(record, source=source).group
        if group_of_record is None:
            raise InputError(f"{record} has no candidates; nothing to plot")
        number = group_of_record
    pairs = np.flatnonzero(result.groups.of_pairs() == number)
    own = None
    if record is not None:
        records = (result.first, result.second)[source - 1]
        own = records.at_row(result.explain(record, source=source).row)
    pairs = _competing(result, pairs, own, source)
    sides = _sides(match, pairs)
    count = sum(len(side.position) for side in sides)
    if count > DRAWABLE:
        raise InputError(f"the group has {count} records; pictures are drawn of up to {DRAWABLE}")
    when = "as observed" if match.epoch_jyr is None else f"at epoch {match.epoch_jyr:.2f}"
    subtitle = f"Positions {when}; each probability is that of the two records being one object."
    figure = sheet(_finding(result, sides, pairs), subtitle, 13.0, 6.8)
    sky, words = figure.subplots(1, 2, width_ratios=(1.0, 1.05))
    _draw(sky, match, sides, pairs)
    words.set_axis_off()
    _list(words, result, sides, pairs)
    _key(words, match, sides)
    return figure


def _competing(result: Identification, pairs: IntArray, own: int | None, source: int) -> IntArray:
    """The pairs of a group to draw: probable ones connected to each other, and to the requested record if there is one.

    own : index of that record in its source. A distant, nearly impossible candidate would shrink the rest of the plot.
    """
    i, j, p = result.pairs.i[pairs], result.pairs.j[pairs], result.p_pair[pairs]
    probable = (p >= MIN_DRAWN) | result.chosen[pairs]
    if own is not None:
        probable |= (i if source == 1 else j) == own
        seed = np.flatnonzero((i if source == 1 else j) == own)[:1]
    else:
        q = np.clip(p, 1e-15, 1.0 - 1e-15)
        seed = np.array([int(np.argmax(-q * np.log(q) - (1.0 - q) * np.log1p(-q)))])
    joined = np.zeros(len(pairs), np.bool_)
    joined[seed] = True
    while True:
        more = probable & (np.isin(i, i[joined]) | np.isin(j, j[joined]))
        if np.array_equal(more | joined, joined):
            return np.asarray(pairs[joined])
        joined |= more


def _sides(match: SkyMatch, pairs: IntArray) -> tuple[_CatalogueSide, _CatalogueSide]:
    result = match.result
    chosen = np.unique(result.pairs.i[pairs]).astype(np.int64), np.unique(result.pairs.j[pairs]).astype(np.int64)
    frame = TangentAxes.about(np.concatenate([result.first.features[chosen[0]], result.second.features[chosen[1]]]))

    def side(catalogue: Catalogue, records: Records, at: IntArray, sign: tuple[str, str]) -> _CatalogueSide:
        place, axes = frame(records.features[at])
        covariance = axes @ records.full_covariance()[at] @ axes.transpose(0, 2, 1)
        return _CatalogueSide(catalogue, at, place, covariance, _names(catalogue, records.rows[at]), *sign)

    return (
        side(match.first, result.first, chosen[0], (FIRST, "o")),
        side(match.second, result.second, chosen[1], (SECOND, "s")),
    )


def _names(catalogue: Catalogue, rows: IntArray) -> list[str]:
    label = f"{catalogue.choice.id} " if catalogue.choice.id and catalogue.choice.id.isupper() else ""
    names = [f"{label}{catalogue.ids[row]}" for row in rows]
    if catalogue.magnitude is None:
        return names
    return [
        f"{name}\n{catalogue.magnitude[row]:.2f} mag" if np.isfinite(catalogue.magnitude[row]) else name
        for name, row in zip(names, rows, strict=True)
    ]


def _draw(axes: Axes, match: SkyMatch, sides: tuple[_CatalogueSide, _CatalogueSide], pairs: IntArray) -> None:
    _lines(axes, match.result, sides, pairs)
    reach = containment(match.estimate.spread, INSIDE)
    outlines = [_ellipses(axes, side, reach if side is _wider(sides) else 3.0) for side in sides]
    places = np.concatenate([side.place for side in sides])
    low, high = _view(places, np.concatenate(outlines))
    axes.set_aspect("equal")
    axes.set_xlim(high[0], low[0])
    axes.set_ylim(low[1], high[1])
    _labels(axes, sides)
    tidy(axes, "east [arcsec]", "north [arcsec]")
    _compass(axes, 0.5 * float(high[0] - low[0]))


def _wider(sides: tuple[_CatalogueSide, _CatalogueSide]) -> _CatalogueSide:
    return max(sides, key=lambda side: side.size)


def _view(places: FloatArray, outlines: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Corners of a square around all positions, and around the ellipses unless they are much larger."""
    low, high = places.min(axis=0), places.max(axis=0)
    margin = 0.6 * float(np.ptp(places, axis=0).max())
    span = np.ptp(outlines, axis=0).max()
    if margin < 0.3 * span:
        margin = max(margin, 0.1 * float(span))
    low = np.maximum(outlines.min(axis=0), low - margin)
    high = np.minimum(outlines.max(axis=0), high + margin)
    half = 0.8 * float((high - low).max())
    middle = 0.5 * (low + high)
    return middle - half, middle + half


def _lines(axes: Axes, result: Identification, sides: tuple[_CatalogueSide, _CatalogueSide], pairs: IntArray) -> None:
    order = pairs[np.argsort(result.chosen[pairs], kind="stable")]
    for k, pair in enumerate(order):
        one = np.flatnonzero(sides[0].position == result.pairs.i[pair])[0]
        two = np.flatnonzero(sides[1].position == result.pairs.j[pair])[0]
        ends = np.stack([sides[0].place[one], sides[1].place[two]])
        chosen = bool(result.chosen[pair])
        line, ink, weight = (FOUND, FOUND, "bold") if chosen else (FAINT, "#555555", "normal")
        axes.plot(*ends.T, color=line, lw=3.4 if chosen else 1.2, zorder=1, solid_capstyle="round")
        # Lines may nearly coincide: their probabilities are at different fractions of their length.
        share = (0.58, 0.4, 0.75, 0.25)[k % 4]
        x, y = (1.0 - share) * ends[0] + share * ends[1]
        axes.text(
            x, y, percent(result.p_pair[pair]), ha="center", va="center", fontsize=10, fontweight=weight,
            color=ink, zorder=4, bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.2, "alpha": 0.9},
        )  # fmt: skip


def _ellipses(axes: Axes, side: _CatalogueSide, reach: float) -> FloatArray:
    """Draws 1, 2, 3 quoted σ, and ``reach`` σ dashed if larger; returns the points of the outermost."""
    outermost = []
    for place, covariance in zip(side.place, side.covariance, strict=True):
        for sigmas, alpha in ((3.0, 0.10), (2.0, 0.16), (1.0, 0.30)):
            outline = ellipse(place, covariance, sigmas)
            axes.fill(*outline.T, facecolor=side.colour, alpha=alpha, linewidth=0, zorder=2)
            axes.plot(*outline.T, color=side.colour, lw=0.8, zorder=2)
        outermost.append(ellipse(place, covariance, max(reach, 3.0)))
        if reach > MIN_CONTOUR:
            axes.plot(*outermost[-1].T, color=side.colour, lw=1.2, ls=DASHES, zorder=1)
        axes.plot(*place, marker=side.marker, ms=5, color=side.colour, zorder=5)
    return np.concatenate(outermost)


def _labels(axes: Axes, sides: tuple[_CatalogueSide, _CatalogueSide]) -> None:
    """Names in a column on either side, without overlap, each with a line to its record."""
    places = np.concatenate([side.place for side in sides])
    names = [(name, side.colour) for side in sides for name in side.names]
    # East is left: the names of the eastern half are on the left.
    eastward = np.argsort(-places[:, 0], kind="stable")
    for rows, x, ha in ((eastward[: len(names) // 2], 0.01, "left"), (eastward[len(names) // 2 :], 0.99, "right")):
        step = min(0.12, 0.86 / max(len(rows), 1))
        for k, row in enumerate(rows[np.argsort(-places[rows, 1], kind="stable")]):
            name, colour = names[row]
            axes.annotate(
                name, tuple(places[row]), (x, 0.97 - step * k), textcoords="axes fraction", ha=ha, va="top",
                fontsize=min(9.0, 75.0 * step), color=colour, zorder=6,
                bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.8, "alpha": 0.85},
                arrowprops={"arrowstyle": "-", "color": colour, "lw": 0.6, "alpha": 0.6, "shrinkA": 0, "shrinkB": 3},
            )  # fmt: skip


def _compass(axes: Axes, half: float) -> None:
    """N up, E left, and a bar of a round length."""
    length = nice_length(0.45 * half)
    share = length / (2.0 * half)
    words = f"{length:g}″" if length >= 0.1 else f"{1e3 * length:g} mas"
    axes.plot([0.04, 0.04 + share], [0.04, 0.04], transform=axes.transAxes, color=INK, lw=2.5)
    axes.text(0.04 + share / 2, 0.05, words, transform=axes.transAxes, ha="center", va="bottom", fontsize=9.5)
    directions = (((0.94, 0.15), "N", "center", "bottom"), ((0.85, 0.04), "E", "right", "center"))
    for end, name, ha, va in directions:
        axes.annotate(
            "", end, (0.94, 0.04), xycoords="axes fraction", textcoords="axes fraction",
            arrowprops={"arrowstyle": "-|>", "color": INK, "lw": 1.2, "shrinkA": 0, "shrinkB": 0},
        )  # fmt: skip
        axes.text(*end, name, ha=ha, va=va, transform=axes.transAxes, fontsize=10, color=INK)


def _list(axes: Axes, result: Identification, sides: tuple[_CatalogueSide, _CatalogueSide], pairs: IntArray) -> None:
    """Every record of the first catalogue with its candidates, as text."""
    lines: list[tuple[str, str, str]] = []
    for at, name in zip(sides[0].position, sides[0].names, strict=True):
        lines.append((f"{sides[0].catalogue.name} {', '.join(name.split(chr(10)))} is", FIRST, "bold"))
        own = pairs[result.pairs.i[pairs] == at]
        for pair in own[np.argsort(-result.p_pair[own])]:
            two = int(np.flatnonzero(sides[1].position == result.pairs.j[pair])[0])
            separation = float(np.hypot(*result.pairs.residual[pair]))
            sigmas = float(np.sqrt(result.pairs.mahalanobis_sq[pair]))
            words = f"{percent(result.p_pair[pair]):>7}  {', '.join(sides[1].names[two].split(chr(10)))}"
            words += f"   {separation:.2f}″, {sigmas:.1f} σ"
            chosen = bool(result.chosen[pair])
            lines.append((words, FOUND if chosen else INK, "bold" if chosen else "normal"))
        no_partner = max(0.0, 1.0 - float(result.p_pair[own].sum()))
        lines.append((f"{percent(no_partner):>7}  none of them", INK, "normal"))
        lines.append(("", INK, "normal"))
    step = min(0.044, 0.72 / len(lines))
    for k, (text, colour, weight) in enumerate(lines):
        axes.text(
            0.0, 0.97 - step * k, text, transform=axes.transAxes, fontsize=min(9.8, 222.0 * step),
            family="monospace", color=colour, fontweight=weight, va="top",
        )  # fmt: skip


def _key(axes: Axes, match: SkyMatch, sides: tuple[_CatalogueSide, _CatalogueSide]) -> None:
    """The legend."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    entries: list[tuple[Any, str]] = []
    for side in sides:
        dot = Line2D([], [], color=side.colour, marker=side.marker, ls="", ms=6)
        errors = dict.fromkeys(map(_arcsec, (side.errors.min(), side.errors.max())))
        entries.append((dot, f"{side.catalogue.name}: error here {' to '.join(errors)} on each axis"))
    entries.append((Patch(facecolor=FIRST, alpha=0.3), "ellipses: 1, 2 and 3 σ of the quoted errors"))
    if containment(match.estimate.spread, INSIDE) > MIN_CONTOUR:
        wider = _wider(sides)
        line = Line2D([], [], color=wider.colour, ls=DASHES, lw=1.2)
        entries.append((line, f"{100 * INSIDE:.0f} % of true partners, by the estimated errors"))
    entries.append((Line2D([], [], color=FOUND, lw=3.4), "identified, with its probability"))
    entries.append((Line2D([], [], color=FAINT, lw=1.2), "other candidates, with theirs"))
    handles, words = zip(*entries, strict=True)
    axes.legend(handles, words, loc="lower left", frameon=False, fontsize=9.5, borderaxespad=0.0)


def percent(p: float) -> str:
    """A probability as a label."""
    if p < 0.001:
        return "< 0.1 %"
    if p > 0.999:
        return "> 99.9 %"
    return f"{100 * p:.1f} %" if p < 0.095 or p > 0.905 else f"{100 * p:.0f} %"


def _finding(result: Identification, sides: tuple[_CatalogueSide, _CatalogueSide], pairs: IntArray) -> str:
    one, two = (len(side.position) for side in sides)
    names = sides[0].catalogue.name, sides[1].catalogue.name
    if one == 1:
        best = percent(result.p_pair[pairs].max())
        who = sides[0].names[0].split("\n")[0]
        return f"{counted(two, 'record')} of {names[1]} could be {names[0]} {who}; the best has {best}"
    return f"{one} records of {names[0]} and {two} of {names[1]} compete"


def _arcsec(value: float) -> str:
    return f"{value:.2f}″" if value >= 0.1 else f"{1e3 * value:.3g} mas"

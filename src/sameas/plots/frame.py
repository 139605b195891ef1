"""Plots of frames: the image with its stars marked, residuals of the plate model and magnitudes, and moving objects.

A moving object is drawn on all frames of its series, aligned on the stars and aligned on its motion.
"""

from __future__ import annotations

import math
import textwrap
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import FloatArray, IntArray, robust_scale
from sameas.plots.sheet import DOTS_PER_INCH, FAINT, FILL, FIRST, FOUND, INK, SECOND, nice_length, required, sheet, tidy
from sameas.representation import count, counted
from sameas.sky.frame.identified import FrameIdentification
from sameas.sky.frame.image import Frame
from sameas.sky.frame.measurements import Flag
from sameas.sky.frame.outputs import orientation
from sameas.sky.frame.photometry import instrumental

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from sameas.sky.movers.known import KnownObjects
    from sameas.sky.movers.search import Movers
    from sameas.sky.movers.stack import Stack
    from sameas.sky.series import Series

#: Marks on the dark sky: identified, not identified, missing; distinct for every colour vision, as on the page.
BLUE, YELLOW, RED = "#2f9bff", "#ffe14a", "#d9522e"
NIGHT, PAPER, DIM = "#0b0d12", "#e8e6df", "#a9adb5"
#: Maximum number of residual arrows, of the brightest identified stars.
ARROWS = 1500
#: Half the height of the diagram of zero points: this many times their scatter, and mag at least (chosen).
LIMIT_SCATTERS, LEAST_LIMIT_MAG = 12.0, 0.1


def picture(match: FrameIdentification, frame: Frame, *, brightest: int | None = None) -> Figure:
    """The image with marks on identified stars, unidentified measurements and missing stars.

    brightest : maximum number of identified stars to mark, the brightest first; None: all.
    """
    rows, columns = match.measured.shape
    side = 11.0
    wide, high = (side, side * rows / columns) if columns >= rows else (side * columns / rows, side)
    wide, high = max(wide, 5.0), max(high, 4.0)
    figure = required()(figsize=(wide + 0.5, high + 1.45), dpi=DOTS_PER_INCH, facecolor=NIGHT)
    total = high + 1.45
    axes = figure.add_axes((0.25 / (wide + 0.5), 0.62 / total, wide / (wide + 0.5), high / total))
    grey = stretched(binned(frame.image, binning(frame.shape)))
    extent = (-0.5, columns - 0.5, -0.5, rows - 0.5)
    axes.imshow(grey, cmap="gray", origin="lower", extent=extent, interpolation="antialiased", vmin=0, vmax=255)
    axes.set_axis_off()
    handles = _marks(axes, match, brightest)
    _compass(axes, match)
    _scale_bar(axes, match)
    _words(figure, match, handles, total)
    axes.set_xlim(extent[:2])
    axes.set_ylim(extent[2:])
    return figure


def brightest_pairs(match: FrameIdentification, number: int | None) -> IntArray:
    """(number,) indices of the identified pairs, brightest first; all if ``number`` is None."""
    order = np.argsort(-match.measured.flux[match.pairs[0]], kind="stable")
    return order[:number]


def _marks(axes: Axes, match: FrameIdentification, brightest: int | None) -> list[Any]:
    """Draws circles (larger for brighter stars), crosses and diamonds; returns the handles of the legend."""
    from matplotlib.collections import EllipseCollection

    m, (i, _, p) = match.measured, match.pairs
    marked = brightest_pairs(match, brightest)
    unit = m.psf_fwhm_px * max(1.0, m.shape[1] / 1600)
    magnitude = instrumental(m.flux[i[marked]])
    faint = float(np.nanquantile(instrumental(m.flux), 0.9))
    steps = np.clip(np.nan_to_num(faint - magnitude, nan=0.0), 0.0, 7.0)
    size = unit * (3.2 + 0.75 * steps)
    sure = p[marked] >= 0.9
    for which, style in ((sure, "solid"), (~sure, "dotted")):
        axes.add_collection(
            EllipseCollection(
                size[which],
                size[which],
                np.zeros(which.sum()),
                units="xy",
                facecolors="none",
                edgecolors=BLUE,
                linewidths=0.55,
                linestyles=style,
                alpha=0.9,
                offsets=np.column_stack([m.x_px, m.y_px])[i[marked][which]],
                transOffset=axes.transData,
            )
        )
    beyond = match.beyond_catalogue
    unidentified = np.setdiff1d(match.result.leftovers_1, beyond)
    missing = match.predicted_px[match.missing]
    axes.plot(m.x_px[unidentified], m.y_px[unidentified], "x", color=YELLOW, ms=3.2, mew=0.6, alpha=0.9)
    axes.plot(*missing.T, "D", color="none", markeredgecolor=RED, ms=4.4, mew=0.7)
    dotted = int(np.count_nonzero(~sure))
    return _legend(len(marked), len(i), dotted, len(unidentified), len(beyond), len(missing))


def _legend(marked: int, identified: int, dotted: int, unidentified: int, beyond: int, missing: int) -> list[Any]:
    """The handles of the legend, with the number of each mark."""
    from matplotlib.lines import Line2D

    first = (
        f"{count(marked)} brightest identified of {count(identified)}"
        if identified > marked
        else f"{count(identified)} identified"
    )
    first += f" (dotted: {count(dotted)} with p < 0.9)" if dotted else ""
    legend = [
        ("o", BLUE, first),
        ("x", YELLOW, f"{count(unidentified)} not in the catalogue{_beyond(beyond)}"),
        ("D", RED, f"{count(missing)} of the catalogue missing"),
    ]
    return [
        Line2D([], [], ls="", marker=mark, color=colour, label=words, markersize=7, markerfacecolor="none")
        for mark, colour, words in legend
    ]


def _beyond(number: int) -> str:
    """The number of measurements beyond the catalogue, which are not marked."""
    return f" (and {count(number)} fainter than its limit, not marked)" if number else ""


def _compass(axes: Axes, match: FrameIdentification) -> None:
    """Arrows north and east in the upper right corner."""
    rows, columns = match.measured.shape
    slope = match.plate.polynomial.slope(np.array([[columns - 1.0, rows - 1.0]]) / 2.0)[0]
    to_px = np.linalg.inv(slope)
    length = 0.055 * min(rows, columns)
    at = np.array([columns - 1.9 * length, rows - 1.9 * length])
    for name, direction in (("E", np.array([1.0, 0.0])), ("N", np.array([0.0, 1.0]))):
        step = to_px @ direction
        step *= length / np.linalg.norm(step)
        arrow = {"arrowstyle": "-|>", "color": PAPER, "lw": 1.1, "shrinkA": 0, "shrinkB": 0}
        axes.annotate("", tuple(at + step), tuple(at), arrowprops=arrow)
        axes.text(
            at[0] + 1.32 * step[0], at[1] + 1.32 * step[1], name, color=PAPER, fontsize=10, ha="center", va="center"
        )


def _scale_bar(axes: Axes, match: FrameIdentification) -> None:
    rows, columns = match.measured.shape
    scale = orientation(match)[0]
    units = ((3600.0, "°"), (60.0, "′"), (1.0, "″"))
    unit, words = next((each for each in units if 0.22 * columns * scale >= each[0]), units[-1])
    longest = 0.22 * columns * scale / unit
    length = nice_length(longest)
    px = length * unit / scale
    x, y = 0.035 * columns, 0.035 * rows
    axes.plot([x, x + px], [y, y], color=PAPER, lw=2.0, solid_capstyle="butt")
    axes.text(x + px / 2, y + 0.012 * rows, f"{length:g}{words}", color=PAPER, fontsize=10, ha="center", va="bottom")


def _words(figure: Figure, match: FrameIdentification, handles: list[Any], high: float) -> None:
    rows, columns = match.measured.shape
    ra, dec, _ = match.plate.to_sky((columns - 1) / 2.0, (rows - 1) / 2.0)
    scale = orientation(match)[0]
    scatter = match.scatter_arcsec
    left = 0.25 / figure.get_figwidth()
    figure.text(left, 1 - 0.34 / high, match.measured.name, color=PAPER, fontsize=15, fontweight="bold", va="center")
    when = "" if match.stars.epoch_jyr is None else f" · epoch {match.stars.epoch_jyr:.2f}"
    size = f"{_angle(columns * scale)} × {_angle(rows * scale)}, {scale:.3g}″ per pixel"
    figure.text(
        left, 1 - 0.62 / high,
        f"{ra[0]:.4f}° {dec[0]:+.4f}° · {size}{when} · {match.stars.name} · "
        f"scatter {scatter[0]:#.2g}″ × {scatter[1]:#.2g}″",
        color=DIM, fontsize=10, va="center",
    )  # fmt: skip
    legend = figure.legend(
        handles=handles, loc="lower left", ncols=3, frameon=False, fontsize=10, bbox_to_anchor=(left - 0.012, 0.0),
        handletextpad=0.3, columnspacing=2.0, borderpad=0.6,
    )  # fmt: skip
    for text in legend.get_texts():
        text.set_color(PAPER)


def _angle(arcsec: float) -> str:
    for unit, words in ((3600.0, "°"), (60.0, "′")):
        if arcsec >= unit:
            return f"{arcsec / unit:.3g}{words}"
    return f"{arcsec:.3g}″"


def quality(match: FrameIdentification) -> Figure:
    """Four panels: residuals over the frame and by magnitude, the photometric relation, and completeness.

    The last two need magnitudes of the catalogue.
    """
    left, i = match.residual_arcsec, match.pairs[0]
    scatter = match.scatter_arcsec
    subtitle = f"{count(len(i))} identified stars of {match.stars.name} on {match.measured.name}; {_model(match)}"
    title = "No star was identified" if not len(i) else f"Stars lie within {scatter[0]:#.2g}″ × {scatter[1]:#.2g}″ (1σ)"
    with_magnitudes = match.zero_point is not None or match.completeness is not None
    figure = sheet(title, subtitle, 12.0, 10.4 if with_magnitudes else 5.8)
    if not len(i):
        return figure
    panels = figure.subplots(2 if with_magnitudes else 1, 2).ravel()
    _arrows(panels[0], match)
    _against_brightness(panels[1], match, left)
    if with_magnitudes:
        _magnitudes(panels[2], match)
        _complete(panels[3], match)
    return figure


def _model(match: FrameIdentification) -> str:
    plate = match.plate
    larger = f", rms residual {plate.error_scale:.2f} times the quoted errors" if plate.error_scale > 1.005 else ""
    floor = f", floor of {plate.floor_arcsec:.2g}″" if plate.floor_arcsec else ""
    return f"plate model of order {plate.order}{larger}{floor}"


def _arrows(axes: Axes, match: FrameIdentification) -> None:
    """Residuals as magnified arrows."""
    kept = brightest_pairs(match, ARROWS)
    i = match.pairs[0][kept]
    rows, columns = match.measured.shape
    px = match.residual_px[kept]
    length = np.hypot(*px.T)
    # A quantile of the small residuals: wrong pairs and doubles must not shorten the other arrows.
    typical = max(float(np.quantile(length, 0.7)), 1e-6)
    magnified = 10.0 ** math.floor(math.log10(0.05 * max(rows, columns) / typical))
    magnified *= max((f for f in (1, 2, 5) if f * magnified * typical <= 0.05 * max(rows, columns)), default=1)
    drawn = length <= 3 * typical
    axes.quiver(
        match.measured.x_px[i][drawn], match.measured.y_px[i][drawn], *(magnified * px[drawn]).T,
        angles="xy", scale_units="xy", scale=1.0, width=0.0022, color=FIRST, alpha=0.75,
    )  # fmt: skip
    bar = nice_length(0.12 * columns / magnified * orientation(match)[0])
    reach = bar / orientation(match)[0] * magnified
    axes.plot([0.03 * columns, 0.03 * columns + reach], [1.03 * rows] * 2, color=INK, lw=2, clip_on=False)
    axes.text(0.03 * columns + reach * 1.15, 1.03 * rows, f"{bar:g}″", va="center", fontsize=9.5, color=INK)
    axes.set_aspect("equal")
    axes.set_xlim(0, columns)
    axes.set_ylim(0, 1.06 * rows)
    far = int(np.count_nonzero(~drawn))
    longer = f"; {counted(far, 'longer one')} not drawn" if far else ""
    words = f"residuals, {magnified:g} × magnified{longer}"
    tidy(axes, "x [px]", "y [px]", words)


def _brightness(match: FrameIdentification) -> tuple[FloatArray, str]:
    """Magnitudes of the identified pairs and their name: of the catalogue, else instrumental."""
    i, j, _ = match.pairs
    if np.isfinite(match.stars.magnitude[j]).sum() > 2:
        return match.stars.magnitude[j], f"magnitude, {match.stars.name}"
    return instrumental(match.measured.flux[i]), "instrumental magnitude"


def _against_brightness(axes: Axes, match: FrameIdentification, left: FloatArray) -> None:
    magnitude, words = _brightness(match)
    limit = 4.0 * max(float(np.nanmax(match.scatter_arcsec)), 1e-6)
    for values, colour, name in ((left[:, 0], FIRST, "east"), (left[:, 1], SECOND, "north")):
        axes.plot(magnitude, np.clip(values, -limit, limit), ".", ms=_dot(left), color=colour, alpha=0.45, label=name)
    axes.axhline(0.0, color=FAINT, lw=0.7)
    _running(axes, magnitude, match)
    axes.set_ylim(-1.05 * limit, 1.05 * limit)
    far = int(np.count_nonzero(np.abs(left).max(axis=1) > limit))
    edge = f"; {count(far)} beyond the edges" if far else ""
    tidy(axes, words, "measured minus catalogue [arcsec]", f"residuals against brightness, running 1σ{edge}")
    axes.legend(frameon=False, fontsize=9.5, markerscale=3, loc="upper left")


def _dot(points: FloatArray | IntArray) -> float:
    """Marker size, larger for few points."""
    return 2.6 if len(points) > 200 else 6.0


def _running(axes: Axes, magnitude: FloatArray, match: FrameIdentification) -> None:
    """Draws the robust standard deviation per axis in bins of equal number, and the quoted errors."""
    known = np.flatnonzero(np.isfinite(magnitude))
    if len(known) < 60:
        return
    left, pairs = match.residual_arcsec, match.result.pairs
    covariance = pairs.covariance_of(match.result.matches.pair)
    quoted = orientation(match)[0] * np.sqrt(0.5 * np.einsum("mvv->m", covariance))
    parts = np.array_split(known[np.argsort(magnitude[known])], min(12, len(known) // 30))
    x = [float(np.median(magnitude[part])) for part in parts]
    sigma = np.array([float(np.median(quoted[part])) for part in parts])
    for sign, label in ((-1, None), (1, "1σ as quoted")):
        axes.plot(x, sign * sigma, "--", color=INK, lw=1.4, label=label)
    for axis, colour in ((0, FIRST), (1, SECOND)):
        s = [robust_scale(left[part, axis]) for part in parts]
        for sign in (-1, 1):
            axes.plot(x, sign * np.array(s), color=colour, lw=1.6)


def _magnitudes(axes: Axes, match: FrameIdentification) -> None:
    """Catalogue minus instrumental magnitudes, the zero point by each star, with the fitted relation."""
    i, j, _ = match.pairs
    zero = match.zero_point
    if zero is None or not np.isfinite(match.stars.magnitude[j]).any():
        axes.text(0.5, 0.5, "no magnitudes to compare", ha="center", transform=axes.transAxes, color=FAINT)
        tidy(axes, "", "", "magnitudes")
        return
    flux = match.measured.flux[i]
    magnitude, fitted = match.stars.magnitude[j], zero(flux) - instrumental(flux)
    by_star = fitted - match.excess_mag
    centre = float(np.nanmedian(fitted))
    limit = max(LIMIT_SCATTERS * zero.scatter, LEAST_LIMIT_MAG, 1.2 * float(np.nanmax(np.abs(fitted - centre))))
    saturated = (match.measured.flags[i] & Flag.SATURATED) != 0
    for some, colour, label in ((~saturated, FIRST, None), (saturated, SECOND, "saturated")):
        if some.any():
            shown = np.clip(by_star[some], centre - 0.98 * limit, centre + 0.98 * limit)
            axes.plot(magnitude[some], shown, ".", ms=_dot(i), color=colour, alpha=0.5, label=label)
    within = (zero(flux) >= np.nanmin(magnitude)) & (zero(flux) <= np.nanmax(magnitude))
    order = np.flatnonzero(within)[np.argsort(zero(flux)[within])]
    axes.plot(zero(flux)[order], fitted[order], color=FOUND, lw=1.8)
    axes.set_ylim(centre - limit, centre + limit)
    if saturated.any():
        axes.legend(frameon=False, fontsize=9.5, loc="upper right")
    beyond = int(np.count_nonzero(np.abs(by_star - centre) > limit))
    words = _zero_words(match) + (f"; {beyond} beyond the edges" if beyond else "")
    axes.ticklabel_format(axis="y", useOffset=False)
    tidy(axes, f"magnitude, {match.stars.name}", "catalogue minus instrumental magnitude", textwrap.fill(words, 58))


def _zero_words(match: FrameIdentification) -> str:
    zero = match.zero_point
    assert zero is not None
    words = f"zero point {zero.words}"
    if zero.colour_term:
        words += f", colour term {zero.colour_term:+.3f}".replace("-", "−")
    return f"{words}; scatter {zero.scatter:.3f} mag"


def _complete(axes: Axes, match: FrameIdentification) -> None:
    """Catalogue stars on the frame and identified ones by magnitude; the identified share with its standard error."""
    curve = match.completeness
    if curve is None:
        axes.text(0.5, 0.5, "the catalogue has no magnitudes", ha="center", transform=axes.transAxes, color=FAINT)
        tidy(axes, "", "", "completeness")
        return
    axes.stairs(curve.stars, curve.edges, fill=True, color=FILL, label="in the catalogue")
    axes.stairs(curve.identified, curve.edges, fill=True, color=FOUND, alpha=0.55, label="identified")
    tidy(axes, f"magnitude, {match.stars.name}", "stars on the frame", textwrap.fill(curve.describe(), 58))
    axes.legend(frameon=False, fontsize=9.5, loc="center left")
    share = axes.twinx()
    middle, some = 0.5 * (curve.edges[1:] + curve.edges[:-1]), curve.stars > 0
    share.errorbar(
        middle[some], (curve.identified / np.maximum(curve.stars, 1))[some], curve.sigma[some], fmt="o", ms=4,
        color=SECOND, elinewidth=1.0,
    )  # fmt: skip
    grid = np.linspace(curve.edges[0], curve.edges[-1], 300)
    share.plot(grid, curve(grid), color=SECOND, lw=1.4)
    share.set_ylim(0, 1.08)
    share.set_ylabel("share identified", color=SECOND, fontsize=10.5)
    for spine in share.spines.values():
        spine.set_visible(False)
    share.tick_params(labelsize=9.5, color=FAINT, labelcolor=SECOND)


# The intensity stretch: sky nearly black, faint stars visible, bright ones not all white.

#: In units of the sky noise: distance of black below the sky, and softening of asinh (chosen).
BLACK, SOFT = 0.7, 3.5
#: Fraction of white pixels (chosen).
WHITE = 0.0008
#: Maximum size of the image, pixels per side; larger frames are binned.
LARGEST = 2400


def stretched(image: NDArray[np.float32]) -> NDArray[np.uint8]:
    """(rows, columns) grey values 0 … 255: asinh of the intensity above the sky.

    image : (rows, columns); NaN gets the value of the sky.
    """
    values = np.asarray(image, np.float32)
    used = np.isfinite(values)
    values = values - _sky_gradient(np.where(used, values, np.nan))
    sample = values[used]
    if len(sample) > 1_000_000:
        sample = sample[:: len(sample) // 1_000_000]
    level = float(np.median(sample))
    below = sample[sample <= level]
    # The noise is measured on the pixels below the sky level, which contain no stars.
    noise = robust_scale(level - below) if len(below) else 1.0
    noise = noise if noise > 0 else max(float(sample.std()), 1e-6)
    low, high = level - BLACK * noise, max(float(np.quantile(sample, 1.0 - WHITE)), level + 10.0 * noise)
    light = np.where(used, (values - low) / (SOFT * noise), BLACK / SOFT)
    top = np.arcsinh((high - low) / (SOFT * noise))
    return np.asarray(255.0 * np.clip(np.arcsinh(np.maximum(light, 0.0)) / top, 0.0, 1.0), np.uint8)


def _sky_gradient(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """(rows, columns) the gradient of a parabola fitted to the sky (vignetting, moonlight), without its constant.

    (1, 1) zero if too few tiles have valid pixels.
    """
    rows, columns = values.shape
    size = max(8, min(rows, columns) // 16)
    tiles = [(y, x) for y in range(0, rows - size + 1, size) for x in range(0, columns - size + 1, size)]
    step = max(1, size // 24)
    parts = [values[y : y + size : step, x : x + size : step] for y, x in tiles]
    known = [k for k, part in enumerate(parts) if np.isfinite(part).mean() > 0.5]
    if len(known) < 12:
        return np.zeros((1, 1), np.float32)
    level = np.array([np.nanmedian(parts[k]) for k in known])
    v, u = ((np.array([tiles[k] for k in known]) + size / 2) / (rows, columns) - 0.5).T
    weight = np.ones(len(level))
    for _ in range(4):
        terms = np.column_stack([np.ones_like(u), u, v, u * u, u * v, v * v])
        fit = np.linalg.lstsq(terms * weight[:, None], level * weight, rcond=None)[0]
        left = level - terms @ fit
        # Lower weights for outliers: tiles with bright stars or nebulae.
        scatter = max(robust_scale(left), 1e-9)
        weight = np.minimum(1.0, 2.0 * scatter / np.maximum(np.abs(left), 1e-12))
    y, x = np.arange(rows)[:, None] / rows - 0.5, np.arange(columns)[None, :] / columns - 0.5
    surface = fit[1] * x + fit[2] * y + fit[3] * x * x + fit[4] * x * y + fit[5] * y * y
    return np.asarray(surface, np.float32)


def binning(shape: tuple[int, int]) -> int:
    """Binning factor: pixels per side averaged to one pixel of the image."""
    return max(1, -(-max(shape) // LARGEST))


def binned(image: NDArray[np.float32], factor: int) -> NDArray[np.float32]:
    """(rows // factor, columns // factor) means of blocks of pixels."""
    if factor == 1:
        return image
    rows, columns = (size // factor * factor for size in image.shape)
    cut = image[:rows, :columns].reshape(rows // factor, factor, columns // factor, factor)
    return np.asarray(cut.mean(axis=(1, 3)), np.float32)


#: In units of the pixel noise: distance of black below the sky, and softening of asinh (chosen).
MOVER_BLACK, MOVER_SOFT = 1.0, 4.0
#: Radius of the ring around a mover, in FWHM of a star (chosen).
RING_WIDTHS = 1.7


def mover_picture(
    movers: Movers, series: Series, pixels: Stack, known: KnownObjects | None = None, k: int = 0
) -> Figure:
    """Two images of one candidate, north up and east left.

    movers, pixels : results of the search and of the stacking. known : known objects. k : the candidate; 0 is the most
    probable. Left: maximum over the frames at fixed sky positions, or the frame on which it is brightest if the mover
    goes too far for that. Right: mean along its motion.

    Raises InputError: matplotlib is not installed.
    """
    figure = required()(figsize=(11.0, 6.6), dpi=DOTS_PER_INCH, facecolor=NIGHT)
    fixed = pixels.fixed[k]
    width = RING_WIDTHS * float(np.median([e.psf_fwhm_px for e in series.exposures]))
    left, right = (figure.add_axes((x, 0.045, 0.475, 0.8)) for x in (0.018, 0.507))
    detected = pixels.detected[k]
    if fixed is not None:
        at = _on_the_sky(pixels, k, fixed.shape[1])
        _show(left, np.nanmax(fixed, axis=0), "fixed on the stars: the brightest of all frames")
        shown = np.flatnonzero(detected)
        along = at[shown[-1]] - at[shown[0]]
        along = along / max(float(np.hypot(*along)), 1e-9)
        across = np.array([along[1], -along[0]])
        # A tick for every frame, next to the image; dotted if predicted but not detected.
        for n in np.flatnonzero(np.isfinite(pixels.flux[k]) | detected):
            ends = np.array([at[n] + across * f * width for f in (1.15, 1.6)])
            left.plot(*ends.T, color=YELLOW if detected[n] else PAPER, lw=1.0, ls="-" if detected[n] else ":")
        for n in (shown[0], shown[-1]):
            words = _clock(series.exposures[n].mjd_utc)
            x, y = (at[n] + across * 2.4 * width).tolist()
            left.text(x, y, words, color=YELLOW, fontsize=9.5, ha="center", va="center")
    else:
        best = int(np.nanargmax(np.where(detected, pixels.flux[k], np.nan)))
        _show(left, pixels.along[k][best], f"one frame, {_clock(series.exposures[best].mjd_utc)} UTC")
    stacked = pixels.stacked[k]
    _show(right, stacked, f"fixed on the mover: the mean of {len(pixels.along[k])} frames, S/N {pixels.snr[k]:.0f}")
    middle = (np.array(stacked.shape[::-1]) - 1) / 2
    _ring(right, middle, width, BLUE)
    for axes in (left, right):
        _arcsec_bar(axes, pixels.scale_arcsec_per_px)
    figure.text(0.018, 0.957, _name(movers, known, k), color=PAPER, fontsize=16, fontweight="bold", va="center")
    figure.text(0.018, 0.916, _facts(movers, series, known, k), color=DIM, fontsize=10.5, va="center")
    figure.text(0.982, 0.022, "north up, east left", color=DIM, fontsize=9.5, ha="right", va="center")
    return figure


def _on_the_sky(pixels: Stack, k: int, size: int) -> FloatArray:
    """(f, 2) pixel positions of the mover in the cut-out at fixed sky position; east is left."""
    off = (pixels.place[k] - pixels.place[k].mean(axis=0)) / pixels.scale_arcsec_per_px
    # Row 0 of a cut-out is the top one.
    return np.asarray((size - 1) / 2 + off * [-1.0, -1.0])


def _show(axes: Axes, light: FloatArray, words: str) -> None:
    top = max(15.0, float(np.nanpercentile(light, 99.5)))
    grey = np.arcsinh(np.maximum(np.nan_to_num(light) + MOVER_BLACK, 0.0) / MOVER_SOFT) / math.asinh(
        (top + MOVER_BLACK) / MOVER_SOFT
    )
    axes.imshow(grey, cmap="gray", origin="upper", vmin=0.0, vmax=1.0, interpolation="bicubic")
    axes.set_axis_off()
    axes.set_title(words, color=DIM, fontsize=10.5, loc="left", pad=4)


def _ring(axes: Axes, at: FloatArray, radius: float, colour: str) -> None:
    from matplotlib.patches import Circle

    axes.add_patch(Circle((at[0], at[1]), radius, fill=False, edgecolor=colour, lw=0.9))


def _arcsec_bar(axes: Axes, arcsec_per_px: float) -> None:
    low, high = axes.get_xlim()
    bottom = axes.get_ylim()[0]
    length = nice_length(0.25 * (high - low) * arcsec_per_px)
    x, y = high - 0.04 * (high - low), bottom - 0.04 * (high - low)
    axes.plot([x - length / arcsec_per_px, x], [y, y], color=PAPER, lw=2.0, solid_capstyle="butt")
    axes.text(x, y - 0.015 * (high - low), f"{length:g}″", color=PAPER, fontsize=10, ha="right", va="bottom")


def _name(movers: Movers, known: KnownObjects | None, k: int) -> str:
    if known is None or known.object[k] < 0:
        return movers.names[k]
    number, name = known.number(k), known.name(k)
    return f"({number}) {name.removeprefix(number).strip()}" if number else name


def _facts(movers: Movers, series: Series, known: KnownObjects | None, k: int) -> str:
    east, north = movers.rate_arcsec_per_min[k]
    rows = movers.members[k][movers.members[k] >= 0]
    light = movers.detections.magnitude[rows]
    span = 1440.0 * float(np.ptp(movers.detections.mjd_utc[rows]))
    day = datetime.fromtimestamp((movers.detections.mjd_utc[rows[0]] - 40587.0) * 86400.0, UTC)
    words = [
        f"{day:%Y-%m-%d}", f"{len(rows)} of {len(series.exposures)} frames, {span:.0f} min",
        f"{math.hypot(east, north):.2f}″/min towards {math.degrees(math.atan2(east, north)) % 360:.0f}°",
    ]  # fmt: skip
    if np.isfinite(light).any() and not series.stars.scale.startswith("instrumental"):
        words.append(f"{np.nanmedian(light):.1f} mag")
    words.append(f"{movers.scatter_arcsec[k]:.2f}″ about straight motion")
    if known is not None and known.object[k] >= 0:
        off = known.mean_offset(movers, k)
        words.append(
            "O−C " + ", ".join(f"{v:+.2f}″" for v in np.round(off, 2) + 0.0).replace("-", "−") + " east, north"
        )
    return " · ".join(words)


def _clock(mjd: float) -> str:
    seconds = round((mjd % 1.0) * 86400.0)
    return f"{seconds // 3600:02d}:{seconds // 60 % 60:02d}"

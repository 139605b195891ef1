"""The picture of a moving object: all frames aligned on the stars, and aligned on its motion."""

from __future__ import annotations

import math
from datetime import UTC, datetime
from typing import TYPE_CHECKING

import numpy as np

from sameas.arrays import FloatArray
from sameas.plots.frame import BLUE, DIM, NIGHT, PAPER, YELLOW
from sameas.plots.sheet import DOTS_PER_INCH, nice_length, required
from sameas.sky.movers.known import KnownObjects
from sameas.sky.movers.search import Movers
from sameas.sky.movers.stack import Stack
from sameas.sky.series import Series

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: In units of the pixel noise: distance of black below the sky, and softening of asinh (chosen).
BLACK, SOFT = 1.0, 4.0
#: Radius of the ring around a mover, in FWHM of a star (chosen).
RING_WIDTHS = 1.7


def mover_picture(
    found: Movers, series: Series, pixels: Stack, known: KnownObjects | None = None, k: int = 0
) -> Figure:
    """Two images of one candidate, north up and east left.

    found, pixels : results of the search and of the stacking. known : known objects. k : the candidate; 0 is the most
    probable. Left: maximum over the frames at fixed sky positions, or the frame on which it is brightest if the mover
    goes too far for that. Right: mean along its motion.

    Raises
    ------
    InputError : matplotlib is not installed.
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
    _ring(right, middle, width, BLUE, "-")
    for axes in (left, right):
        _scale_bar(axes, pixels.scale_arcsec_per_px)
    figure.text(0.018, 0.957, _name(found, known, k), color=PAPER, fontsize=16, fontweight="bold", va="center")
    figure.text(0.018, 0.916, _facts(found, series, known, k), color=DIM, fontsize=10.5, va="center")
    figure.text(0.982, 0.022, "north up, east left", color=DIM, fontsize=9.5, ha="right", va="center")
    return figure


def _on_the_sky(pixels: Stack, k: int, size: int) -> FloatArray:
    """(f, 2) pixel positions of the mover in the cut-out at fixed sky position; east is left."""
    off = (pixels.place[k] - pixels.place[k].mean(axis=0)) / pixels.scale_arcsec_per_px
    # Row 0 of a cut-out is the top one.
    return np.asarray((size - 1) / 2 + off * [-1.0, -1.0])


def _show(axes: Axes, light: FloatArray, words: str) -> None:
    top = max(15.0, float(np.nanpercentile(light, 99.5)))
    grey = np.arcsinh(np.maximum(np.nan_to_num(light) + BLACK, 0.0) / SOFT) / math.asinh((top + BLACK) / SOFT)
    axes.imshow(grey, cmap="gray", origin="upper", vmin=0.0, vmax=1.0, interpolation="bicubic")
    axes.set_axis_off()
    axes.set_title(words, color=DIM, fontsize=10.5, loc="left", pad=4)


def _ring(axes: Axes, at: FloatArray, radius: float, colour: str, style: str) -> None:
    from matplotlib.patches import Circle

    axes.add_patch(Circle((at[0], at[1]), radius, fill=False, edgecolor=colour, lw=0.9, ls=style))


def _scale_bar(axes: Axes, arcsec_per_px: float) -> None:
    low, high = axes.get_xlim()
    bottom = axes.get_ylim()[0]
    length = nice_length(0.25 * (high - low) * arcsec_per_px)
    x, y = high - 0.04 * (high - low), bottom - 0.04 * (high - low)
    axes.plot([x - length / arcsec_per_px, x], [y, y], color=PAPER, lw=2.0, solid_capstyle="butt")
    axes.text(x, y - 0.015 * (high - low), f"{length:g}″", color=PAPER, fontsize=10, ha="right", va="bottom")


def _name(found: Movers, known: KnownObjects | None, k: int) -> str:
    if known is None or known.object[k] < 0:
        return found.names[k]
    number, name = known.number(k), known.name(k)
    return f"({number}) {name.removeprefix(number).strip()}" if number else name


def _facts(found: Movers, series: Series, known: KnownObjects | None, k: int) -> str:
    east, north = found.rate_arcsec_per_min[k]
    rows = found.members[k][found.members[k] >= 0]
    light = found.detections.magnitude[rows]
    span = 1440.0 * float(np.ptp(found.detections.mjd_utc[rows]))
    day = datetime.fromtimestamp((found.detections.mjd_utc[rows[0]] - 40587.0) * 86400.0, UTC)
    words = [
        f"{day:%Y-%m-%d}", f"{len(rows)} of {len(series.exposures)} frames, {span:.0f} min",
        f"{math.hypot(east, north):.2f}″/min towards {math.degrees(math.atan2(east, north)) % 360:.0f}°",
    ]  # fmt: skip
    if np.isfinite(light).any() and not series.stars.scale.startswith("instrumental"):
        words.append(f"{np.nanmedian(light):.1f} mag")
    words.append(f"{found.scatter_arcsec[k]:.2f}″ about straight motion")
    if known is not None and known.object[k] >= 0:
        off = known.mean_offset(found, k)
        words.append(
            "O−C " + ", ".join(f"{v:+.2f}″" for v in np.round(off, 2) + 0.0).replace("-", "−") + " east, north"
        )
    return " · ".join(words)


def _clock(mjd: float) -> str:
    seconds = round((mjd % 1.0) * 86400.0)
    return f"{seconds // 3600:02d}:{seconds // 60 % 60:02d}"

"""The common layout of all plots: figure, axes, title, colours, saving."""

from __future__ import annotations

import io
import os
import textwrap
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from sameas.arrays import FloatArray
from sameas.errors import InputError, optional
from sameas.io import replacing
from sameas.space import ARCSEC_PER_RADIAN, axes_at, local_axes, mean_direction, unit_vectors

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Colours of Okabe and Ito, distinct for every colour vision: of the first catalogue, of the second, of estimates.
FIRST = "#0072B2"
SECOND = "#D55E00"
FOUND = "#009E73"
INK = "#222222"
FAINT = "#8A8A8A"
FILL = "#BFD3E0"
DENSITY = "viridis"

#: Dots per inch of a file, and of a notebook, which is about 900 pixels wide.
DOTS_PER_INCH, NOTEBOOK_DPI = 150, 80
#: Letters of a title and of a subtitle per inch before they wrap.
TITLE_LETTERS_PER_INCH, LETTERS_PER_INCH = 8.5, 12.0
#: Height of a line of a title, inches.
TITLE_LINE_IN = 0.33
#: Longest name on axes and in legends (chosen).
LETTERS_OF_NAME = 22


def required() -> type[Figure]:
    """Matplotlib's figure class.

    Raises InputError: matplotlib is not installed.
    """
    with optional("plots need matplotlib", "plots"):
        from matplotlib.figure import Figure
    return _shown(Figure)


@cache
def _shown(figure: type[Figure]) -> type[Figure]:
    """A subclass of matplotlib's figure that notebooks show without pyplot and ``%matplotlib``."""

    class ShownFigure(figure):  # type: ignore[misc, valid-type]
        """A figure with a PNG representation for notebooks."""

        def _repr_png_(self) -> bytes:
            buffer = io.BytesIO()
            self.savefig(buffer, format="png", dpi=NOTEBOOK_DPI)
            return buffer.getvalue()

    return ShownFigure


def sheet(title: str, subtitle: str, width: float = 11.0, height: float = 5.4) -> Figure:
    """An empty figure with a title (the finding) and a subtitle, both wrapped; sizes in inches.

    Raises InputError: matplotlib is not installed.
    """
    title = textwrap.fill(title, int(TITLE_LETTERS_PER_INCH * width), break_on_hyphens=False)
    subtitle = textwrap.fill(subtitle, int(LETTERS_PER_INCH * width), break_on_hyphens=False)
    figure = required()(figsize=(width, height), dpi=DOTS_PER_INCH, facecolor="white", layout="constrained")
    head = figure.suptitle(
        title + "\n" * (1 + subtitle.count("\n")), x=0.012, ha="left", fontsize=14, fontweight="bold", color=INK
    )
    # Constrained layout reserves room for the title only: its empty lines make room for the subtitle.
    head.set_linespacing(1.6)
    below = 0.98 - TITLE_LINE_IN * (1 + title.count("\n")) / height
    figure.text(0.012, below, subtitle, ha="left", va="top", fontsize=10.5, color="#4A4A4A")
    return figure


def tidy(axes: Axes, x: str, y: str, title: str = "") -> None:
    """Sets axis labels and a title; keeps the left and lower spines only."""
    axes.set_xlabel(x, fontsize=10.5, color=INK)
    axes.set_ylabel(y, fontsize=10.5, color=INK)
    axes.tick_params(labelsize=9.5, color=FAINT, labelcolor=INK)
    for name, spine in axes.spines.items():
        spine.set_visible(name in ("left", "bottom"))
        spine.set_color(FAINT)
    if title:
        axes.set_title(title, fontsize=11.5, loc="left", color=INK)


def short(name: str) -> str:
    """A name for axes and legends: of a long one its begin and its end."""
    return name if len(name) <= LETTERS_OF_NAME else f"{name[:11]}…{name[-10:]}"


def save(figure: Figure, path: str | os.PathLike[str]) -> None:
    """Writes a figure atomically; the extension gives the format (png, pdf, svg).

    Raises InputError: an unknown format, or the file cannot be written.
    """
    kind = os.path.splitext(os.fspath(path))[1].lstrip(".").lower()
    known = figure.canvas.get_supported_filetypes()
    if kind not in known:
        raise InputError(f"{os.fspath(path)}: plots are written as {', '.join(sorted(known))}")
    with replacing(path) as draft:
        figure.savefig(draft, format=kind)


@dataclass(frozen=True)
class TangentAxes:
    """East and north axes at the mean of some directions; accurate over a few arcminutes, also at the poles."""

    middle: FloatArray
    east: FloatArray
    north: FloatArray

    @classmethod
    def about(cls, position_deg: FloatArray) -> TangentAxes:
        """The frame at the mean direction of (n, 2) longitudes and latitudes."""
        middle = mean_direction(unit_vectors(*position_deg.T))
        return cls(middle, *axes_at(middle))

    def __call__(self, position_deg: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(n, 2) positions in arcsec east and north of the middle, and (n, 2, 2) matrices that rotate vectors from
        each record's own east and north to those of the frame."""
        east, north = local_axes(*np.radians(position_deg).T)
        basis = np.stack([self.east, self.north])
        place = ARCSEC_PER_RADIAN * (unit_vectors(*position_deg.T) - self.middle) @ basis.T
        return place, np.stack([east @ basis.T, north @ basis.T], axis=2)


def ellipse(place: FloatArray, covariance: FloatArray, sigmas: float, points: int = 121) -> FloatArray:
    """(points, 2) closed outline of the ellipse at ``sigmas`` σ about a position; east and north, in its unit."""
    angle = np.linspace(0.0, 2.0 * np.pi, points)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(place + sigmas * (circle * np.sqrt(np.maximum(values, 0.0))) @ vectors.T)


def nice_length(most: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that is at most ``most``."""
    power = 10.0 ** np.floor(np.log10(most))
    return float(max(step * power for step in (1, 2, 5) if step * power <= most * (1 + 1e-9)))

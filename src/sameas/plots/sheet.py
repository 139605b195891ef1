"""The sheet that every picture is drawn on: figure, axes, title, colours, and its way into a file."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

from sameas.errors import InputError
from sameas.io import replacing

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Okabe and Ito's colours, told apart by every kind of colour vision.
FIRST = "#0072B2"  # what belongs to the first catalogue
SECOND = "#D55E00"  # what belongs to the second
FOUND = "#009E73"  # what was estimated from the data
INK = "#222222"
FAINT = "#8A8A8A"
FILL = "#BFD3E0"
DENSITY = "viridis"

DOTS_PER_INCH = 150


def required() -> type[Figure]:
    """Matplotlib's figure, that every picture needs.

    Raises
    ------
    InputError : matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise InputError("pictures need matplotlib: pip install 'sameas[plots]'") from error
    return Figure


def sheet(title: str, subtitle: str, width: float = 11.0, height: float = 5.4) -> Figure:
    """An empty figure that says its finding on top; sizes in inches.

    Raises
    ------
    InputError : matplotlib is not installed.
    """
    figure = required()(figsize=(width, height), dpi=DOTS_PER_INCH, facecolor="white", layout="constrained")
    head = figure.suptitle(f"{title}\n", x=0.012, ha="left", fontsize=14, fontweight="bold", color=INK)
    # Constrained layout leaves room for the title only: its empty second line is the subtitle's.
    head.set_linespacing(1.6)
    figure.text(0.012, 0.98 - 0.33 / height, subtitle, ha="left", va="top", fontsize=10.5, color="#4A4A4A")
    return figure


def tidy(axes: Axes, x: str, y: str, title: str = "") -> None:
    """Labels with units, a title, and no more ink than needed."""
    axes.set_xlabel(x, fontsize=10.5, color=INK)
    axes.set_ylabel(y, fontsize=10.5, color=INK)
    axes.tick_params(labelsize=9.5, color=FAINT, labelcolor=INK)
    for name, spine in axes.spines.items():
        spine.set_visible(name in ("left", "bottom"))
        spine.set_color(FAINT)
    if title:
        axes.set_title(title, fontsize=11.5, loc="left", color=INK)


def save(figure: Figure, path: str | os.PathLike[str]) -> None:
    """Writes a figure; the format is that of the extension (png, pdf, svg), and the file is whole or absent.

    Raises
    ------
    InputError : an unknown format, or the file cannot be written.
    """
    kind = os.path.splitext(os.fspath(path))[1].lstrip(".").lower()
    known = figure.canvas.get_supported_filetypes()
    if kind not in known:
        raise InputError(f"{os.fspath(path)}: pictures are written as {', '.join(sorted(known))}")
    with replacing(path) as draft:
        figure.savefig(draft, format=kind)

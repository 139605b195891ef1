"""How results show themselves: in a few lines where they are printed, with their report and a picture in a notebook."""

from __future__ import annotations

import base64
import html
import io
import textwrap
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from sameas.errors import InputError
from sameas.report.prose import count, figures

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Lines of doubts, and letters of one, that a short text has room for (chosen).
DOUBTS, LETTERS = 4, 160
#: Lines that a value prints in.
LINES = 10
#: Dots per inch of the picture in a notebook (chosen: about 600 pixels wide).
SMALL_DPI = 55


def in_lines(headline: str, doubts: Sequence[str], offers: str) -> str:
    """A result in at most seven lines: what it is, what is doubted, what it offers."""
    lines = [headline, *(f"  doubt: {textwrap.shorten(doubt, LETTERS, placeholder=' …')}" for doubt in doubts[:DOUBTS])]
    if len(doubts) > DOUBTS:
        lines.append(f"  and {count(len(doubts) - DOUBTS)} more doubts")
    return "\n".join([*lines, f"  {offers}"])


def in_first_lines(lines: Sequence[str]) -> str:
    """A long text in at most ten lines, and how the others are seen."""
    if len(lines) <= LINES:
        return "\n".join(lines)
    return "\n".join([*lines[: LINES - 1], f"… print() shows all {len(lines)} lines"])


def in_html(headline: str, report: str, plot: Callable[[], Figure]) -> str:
    """The report and one small picture for a notebook; without the picture where nothing can be drawn."""
    parts = [f"<b>{html.escape(headline)}</b>"]
    try:
        drawn = io.BytesIO()
        plot().savefig(drawn, format="png", dpi=SMALL_DPI)
    except InputError:  # matplotlib is missing, or there is nothing to draw
        pass
    else:
        parts.append(f'<br><img alt="" src="data:image/png;base64,{base64.b64encode(drawn.getvalue()).decode()}">')
    parts.append(f'<pre style="line-height:1.2">{html.escape(report)}</pre>')
    return "".join(parts)


def expected(wrong: float) -> str:
    """An expected number of wrong answers, small ones too."""
    if wrong < 0.05:
        return "fewer than 0.05"
    return figures(wrong) if wrong >= 10.0 else f"{wrong:.1f}"

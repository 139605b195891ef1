"""Text elements of reports: labelled lines, times and percentages; short and notebook forms of results."""

from __future__ import annotations

import base64
import html
import io
import textwrap
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from sameas.errors import InputError
from sameas.representation import count, counted

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WIDTH = 100
LABEL = 22
DOUBT, ALARM = "  doubt".ljust(2 + LABEL), "  ALARM".ljust(2 + LABEL)
#: Times from this value on (March 1973) are UTC seconds since 1970; smaller ones are seconds of another clock.
UTC_FROM_S = 1e8


def moment(time_s: float) -> str:
    """A time as text: UTC if it counts from 1970, else seconds of another clock.

    >>> moment(1714560000.0), moment(12.5)
    ('2024-05-01 10:40:00 UTC', '12.5 s')
    """
    if time_s < UTC_FROM_S:
        return f"{time_s:.10g} s"
    return datetime.fromtimestamp(time_s, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")


def span(first_s: float, last_s: float) -> str:
    """A time span as text; a common date is written once.

    >>> span(1714560000.0, 1714560300.0), span(0.0, 60.0)
    ('2024-05-01 10:40:00 to 10:45:00 UTC', '0 to 60 s')
    """
    first, last = moment(first_s), moment(last_s)
    unit = first.rpartition(" ")[2]
    day = f"{first[:10]} " if unit == "UTC" and first[:10] == last[:10] else ""
    return first if first == last else f"{first.removesuffix(f' {unit}')} to {last.removeprefix(day)}"


def percent(share: float) -> str:
    """A fraction in percent, with three decimals near 0 and 100, else one."""
    if not np.isfinite(share):
        return "–"
    near = min(share, 1.0 - share)
    return f"{100 * share:.{1 if near > 0.005 or near <= 0 else 3}f} %"


def figures(value: float) -> str:
    """A positive number to four digits; from 10 000 on all digits of the integer part."""
    return f"{value:.4g}" if value < 1e4 else count(round(value))


def times(factor: float) -> str:
    """A factor with one decimal; below 1 with two significant digits."""
    return f"{factor:.1f}" if factor >= 0.95 else f"{factor:.2g}"


def entry(label: str, words: str) -> list[str]:
    """A labelled line, wrapped and indented below the text."""
    return textwrap.wrap(
        words, WIDTH, initial_indent=f"  {label:{LABEL}}", subsequent_indent=" " * (2 + LABEL),
        break_long_words=False, break_on_hyphens=False,
    ) or [f"  {label}"]  # fmt: skip


def labelled(texts: Sequence[str]) -> list[str]:
    """Lines of texts such as ``epoch: 2016.0 (column ref_epoch)``; a text without a short label is a note.

    A later text with the same label replaces the earlier one.
    """
    parts = [text.partition(": ") for text in texts]
    last = {label: k for k, (label, _, _) in enumerate(parts)}
    lines = []
    for k, (label, colon, text) in enumerate(parts):
        if not colon or len(label) > LABEL:
            lines += entry("note", label + colon + text)
        elif last[label] == k:
            lines += entry(label, text)
    return lines


def wrapped(line: str) -> list[str]:
    """A line that begins with a doubt or alarm label, wrapped and indented below the text."""
    indent = " " * len(DOUBT)
    return textwrap.wrap(line, WIDTH, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False)


def in_one(lines: Iterable[str]) -> str:
    """A report as one text."""
    return "\n".join(part for line in lines for part in (wrapped(line) if line.startswith((DOUBT, ALARM)) else [line]))


#: Number of doubts, and characters of each, in the short form (chosen).
DOUBTS, LETTERS = 4, 160
#: Number of lines in the short form of a long text.
LINES = 10
#: Dots per inch of the plot in a notebook (chosen: about 600 pixels wide).
SMALL_DPI = 55


@dataclass(frozen=True, repr=False)
class Lines:
    """A text; ``print`` it, or use its ``lines``. In a prompt it shows ten lines at most."""

    lines: tuple[str, ...]

    def __str__(self) -> str:
        return "\n".join(self.lines)

    def __repr__(self) -> str:
        if len(self.lines) <= LINES:
            return str(self)
        return "\n".join([*self.lines[: LINES - 1], f"… print() shows all {len(self.lines)} lines"])


class Result:
    """The short forms of a result: at most seven lines in a prompt; in a notebook its report and a small plot.

    A result has the four members below; ``_offers`` are the names of its attributes and methods.
    """

    _offers: ClassVar[str]

    @property
    def headline(self) -> str:
        """Summary in one line."""
        raise NotImplementedError

    @property
    def doubts(self) -> tuple[str, ...]:
        """One sentence for each doubt about the input or the result."""
        raise NotImplementedError

    def report(self) -> str:
        """The report that the command prints."""
        raise NotImplementedError

    def plot(self) -> Figure:
        """A figure."""
        raise NotImplementedError

    def __repr__(self) -> str:
        doubts = self.doubts
        lines = [self.headline]
        lines += [f"  doubt: {textwrap.shorten(doubt, LETTERS, placeholder=' …')}" for doubt in doubts[:DOUBTS]]
        if len(doubts) > DOUBTS:
            lines.append(f"  and {counted(len(doubts) - DOUBTS, 'more doubt')}")
        return "\n".join([*lines, f"  {self._offers}"])

    def _repr_html_(self) -> str:
        headline = html.escape(self.headline)
        parts = [f"<b>{headline}</b>"]
        try:
            drawn = io.BytesIO()
            self.plot().savefig(drawn, format="png", dpi=SMALL_DPI)
        except InputError:  # matplotlib is missing, or nothing to plot
            pass
        else:
            data = base64.b64encode(drawn.getvalue()).decode()
            parts.append(f'<br><img alt="{headline}" src="data:image/png;base64,{data}">')
        # Some notebooks style <pre> with a proportional font, in which columns are not aligned.
        parts.append(f'<pre style="line-height:1.2;font-family:monospace">{html.escape(self.report())}</pre>')
        return "".join(parts)


def expected(wrong: float) -> str:
    """An expected number of false matches, small numbers as an upper limit."""
    if wrong < 0.05:
        return "fewer than 0.05"
    return figures(wrong) if wrong >= 10.0 else f"{wrong:.1f}"

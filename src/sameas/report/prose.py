"""Prose: labelled lines, counts and shares, as every report writes them."""

from __future__ import annotations

import textwrap
from datetime import UTC, datetime

import numpy as np

WIDTH = 100
LABEL = 22
DOUBT, ALARM = "  doubt".ljust(2 + LABEL), "  ALARM".ljust(2 + LABEL)
#: Times from this on are seconds since 1970, in UTC (it is March 1973); earlier ones are the user's own seconds.
UTC_FROM_S = 1e8


def count(number: int | np.integer) -> str:
    """A whole number, its thousands apart."""
    return f"{int(number):,}".replace(",", " ")


def counted(number: int | np.integer, noun: str) -> str:
    """So many of something.

    >>> counted(1, "report"), counted(12345, "report")
    ('1 report', '12 345 reports')
    """
    return f"{count(number)} {noun}{'' if number == 1 else 's'}"


def moment(time_s: float) -> str:
    """A time: in UTC where it counts from 1970, else the user's own seconds.

    >>> moment(1714560000.0), moment(12.5)
    ('2024-05-01 10:40:00 UTC', '12.5 s')
    """
    if time_s < UTC_FROM_S:
        return f"{time_s:.10g} s"
    return datetime.fromtimestamp(time_s, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")


def span(first_s: float, last_s: float) -> str:
    """From one time to another; a day that both share is said once.

    >>> span(1714560000.0, 1714560300.0), span(0.0, 60.0)
    ('2024-05-01 10:40:00 to 10:45:00 UTC', '0 to 60 s')
    """
    first, last = moment(first_s), moment(last_s)
    unit = first.rpartition(" ")[2]
    day = f"{first[:10]} " if unit == "UTC" and first[:10] == last[:10] else ""
    return first if first == last else f"{first.removesuffix(f' {unit}')} to {last.removeprefix(day)}"


def percent(share: float) -> str:
    """A share in percent, with as many decimals as it needs near 0 and 100."""
    if not np.isfinite(share):
        return "–"
    near = min(share, 1.0 - share)
    return f"{100 * share:.{1 if near > 0.005 or near <= 0 else 3}f} %"


def figures(value: float) -> str:
    """A positive number to four figures, never in powers of ten where it is large."""
    return f"{value:.4g}" if value < 1e4 else count(round(value))


def entry(label: str, words: str) -> list[str]:
    """A labelled line, wrapped under itself."""
    return textwrap.wrap(
        words, WIDTH, initial_indent=f"  {label:{LABEL}}", subsequent_indent=" " * (2 + LABEL),
        break_long_words=False, break_on_hyphens=False,
    ) or [f"  {label}"]  # fmt: skip

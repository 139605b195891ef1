"""Prose: labelled lines, counts and shares, as every report writes them."""

from __future__ import annotations

import textwrap

import numpy as np

WIDTH = 100
LABEL = 22
DOUBT = "  doubt".ljust(2 + LABEL)


def count(number: int | np.integer) -> str:
    """A whole number, its thousands apart."""
    return f"{int(number):,}".replace(",", " ")


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

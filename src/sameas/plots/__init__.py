"""Plots of a crossmatch of two catalogues; each function returns a matplotlib ``Figure``.

- :func:`residuals`: offsets of the identified pairs with and without proper motion. Does motion help?
- :func:`normalised`: the same offsets in units of their quoted errors. Are the errors right?
- :func:`scatter`: scatter of the pairs by quoted error and by magnitude. Whose errors are wrong, and is there a floor?
- :func:`group`: competing records with error ellipses and probabilities. Why is this identification ambiguous?
- :func:`certainty`: expected wrong and lost pairs by a cut on probability, and the identified share by magnitude.
- :func:`brightness`: completeness of each catalogue in the other, density of records without a partner, relation of the
  magnitudes.

:func:`save` writes a figure to a file atomically. Plots need matplotlib (``pip install sameas[plots]``), neither pyplot
nor a display, and change no global setting.

>>> from sameas import plots
>>> plots.save(plots.residuals(match), "residuals.png")  # doctest: +SKIP
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from sameas.errors import InputError
from sameas.plots.group import group, most_ambiguous
from sameas.plots.match import brightness, certainty, normalised, residuals, scatter
from sameas.plots.sheet import required, save
from sameas.sky.sky_match import SkyMatch

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["brightness", "certainty", "every", "group", "most_ambiguous", "normalised", "residuals", "save", "scatter"]

_EVERY = {
    "residuals": residuals, "normalised": normalised, "scatter": scatter, "certainty": certainty,
    "brightness": brightness, "ambiguous": group,
}  # fmt: skip


def every(match: SkyMatch) -> Iterator[tuple[str, Figure]]:
    """Name and figure of each plot that this match has data for.

    Raises InputError: matplotlib is not installed.
    """
    required()
    for name, draw in _EVERY.items():
        try:
            figure = draw(match)
        except InputError:  # no magnitudes were used, or nothing is ambiguous
            continue
        yield name, figure

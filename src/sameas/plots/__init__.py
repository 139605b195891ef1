"""Pictures of an identification of two catalogues; each function returns a matplotlib ``Figure``.

- :func:`residuals`: the offsets of the identified pairs, before and after motion. What did motion do?
- :func:`normalised`: the same offsets in units of their quoted errors. Are the errors right?
- :func:`scatter`: how far the pairs scatter at which quoted error and magnitude. Whose errors, and is there a floor?
- :func:`group`: records that compete, with error ellipses and probabilities. Why is this one not certain?
- :func:`certainty`: how sure all of them are, and which share is identified at which magnitude.
- :func:`brightness`: which share of each catalogue the other shows, how densely what it does not show lies, and how the
  magnitudes are related.

:func:`save` writes a figure to a file, whole or not at all. They need matplotlib
(``pip install sameas[plots]``) but neither pyplot nor a display, and change no setting of the session.

>>> from sameas import plots
>>> plots.save(plots.residuals(match), "residuals.png")  # doctest: +SKIP
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from sameas.errors import InputError
from sameas.plots.brightness import brightness, certainty
from sameas.plots.group import group, most_ambiguous
from sameas.plots.residuals import normalised, residuals, scatter
from sameas.plots.sheet import required, save
from sameas.sky.crossmatch import SkyMatch

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["brightness", "certainty", "every", "group", "most_ambiguous", "normalised", "residuals", "save", "scatter"]

_EVERY = {
    "residuals": residuals, "normalised": normalised, "scatter": scatter, "certainty": certainty,
    "brightness": brightness, "ambiguous": group,
}  # fmt: skip


def every(match: SkyMatch) -> Iterator[tuple[str, Figure]]:
    """Name and figure of each picture that there is something to draw for.

    Raises
    ------
    InputError : matplotlib is not installed.
    """
    required()
    for name, draw in _EVERY.items():
        try:
            figure = draw(match)
        except InputError:  # no magnitudes were used, or nothing is ambiguous
            continue
        yield name, figure

"""Pictures of an identification of two catalogues; each function returns a matplotlib ``Figure``.

- :func:`residuals`: the offsets of the identified pairs, before and after motion. What did motion do?
- :func:`normalised`: the same offsets in units of their quoted errors. Are the errors right?
- :func:`group`: records that compete, with error ellipses and probabilities. Why is this one not certain?
- :func:`certainty`: how sure all of them are, and which share is identified at which magnitude.
- :func:`brightness`: which share of each catalogue the other shows, and how the magnitudes are related.

:func:`save` writes a figure to a file, whole or not at all. They need matplotlib
(``pip install sameas[plots]``) but neither pyplot nor a display, and change no setting of the session.

>>> from sameas import plots
>>> plots.save(plots.residuals(match), "residuals.png")  # doctest: +SKIP
"""

from sameas.plots.brightness import brightness
from sameas.plots.certainty import certainty
from sameas.plots.group import group, most_ambiguous
from sameas.plots.normalised import normalised
from sameas.plots.residuals import residuals
from sameas.plots.sheet import save

__all__ = ["brightness", "certainty", "group", "most_ambiguous", "normalised", "residuals", "save"]

"""The gate: which pairs of records could be one object, with the residual of each.

- :class:`ChiSquare`: the gate keeps a given share of the true pairs. The default.
- :class:`Radius`: the Mahalanobis distance is within a number of standard deviations.
- :class:`Box`: every feature by itself is within a number of standard deviations, as in the papers.
"""

from sameas.gate.gate import DEFAULT_COMPLETENESS, DEFAULT_GATE, Box, ChiSquare, Pairs, Radius
from sameas.gate.zones import Tuning

__all__ = ["DEFAULT_COMPLETENESS", "DEFAULT_GATE", "Box", "ChiSquare", "Pairs", "Radius", "Tuning"]

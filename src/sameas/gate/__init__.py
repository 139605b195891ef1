"""The gate: which pairs of records could be one object, with the residual of each.

- :class:`ChiSquare`: within so many standard deviations of both errors together. The default.
- :class:`Radius`: within a distance, whatever the errors.
- :class:`Box`: within so many standard deviations on every axis by itself, as the papers do it.
"""

from sameas.gate.gate import DEFAULT_COMPLETENESS, DEFAULT_GATE, Box, ChiSquare, Pairs, Radius

__all__ = ["DEFAULT_COMPLETENESS", "DEFAULT_GATE", "Box", "ChiSquare", "Pairs", "Radius"]

"""The offset between two sources, estimated jointly with the identification, without an initial guess.

A relative offset of a few standard deviations makes any identification wrong. Use :func:`register` if one source may be
shifted, rotated, stretched or biased relative to the other, with the matching
:class:`~sameas.registration.offsets.Offset`: ``Shift``, ``Similarity``, ``Affine`` or ``SensorBias``.
"""

from sameas.registration.offsets import Affine, Offset, SensorBias, Shift, Similarity
from sameas.registration.solution import Parameter, Registration, Solution, register

__all__ = ["Affine", "Offset", "Parameter", "Registration", "SensorBias", "Shift", "Similarity", "Solution", "register"]

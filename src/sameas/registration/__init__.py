"""The offset between two sources: found together with the identification, with nothing known in advance.

A relative offset of a few standard deviations spoils any identification. Use :func:`register` where one source may be
shifted, turned, stretched or biased against the other, with the :class:`~sameas.registration.offsets.Offset` that it
may have: ``Shift``, ``Similarity``, ``Affine`` or ``SensorBias``.
"""

from sameas.registration.hough import Tuning
from sameas.registration.offsets import Affine, Offset, SensorBias, Shift, Similarity
from sameas.registration.solution import Parameter, Registration, Solution, register

__all__ = [
    "Affine",
    "Offset",
    "Parameter",
    "Registration",
    "SensorBias",
    "Shift",
    "Similarity",
    "Solution",
    "Tuning",
    "register",
]

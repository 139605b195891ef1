"""sameas tells which records of two or more sources are the same real thing, and how sure it is.

``identify`` is the whole method; ``Records``, a decision rule, a prior and a gate are what it needs.
"""

from sameas.errors import InputError
from sameas.evidence import CloseObjects, ConstantCost, Field, PoissonField
from sameas.gate import Box, ChiSquare, Radius
from sameas.identify import identify
from sameas.prior import CommonObjects, PerPair
from sameas.records import Records
from sameas.result import Identification
from sameas.space import Plane, Sphere

__version__ = "0.1.0"

__all__ = [
    "Box", "ChiSquare", "CloseObjects", "CommonObjects", "ConstantCost", "Field", "Identification", "InputError",
    "PerPair", "Plane", "PoissonField", "Radius", "Records", "Sphere", "identify",
]  # fmt: skip

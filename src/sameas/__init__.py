"""sameas tells which records of two or more sources are the same real thing, and how sure it is.

``identify`` is the whole method; ``Records``, a decision rule, a prior and a gate are what it needs; ``match``
estimates what is not known, ``register`` the offset between two sources; ``identify_many`` takes any number. Names are
imported when they are first used, so that ``import sameas`` costs nothing.
"""

from __future__ import annotations

import sys
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sameas.belief import MissedObjects, PoissonObjects
    from sameas.decision import Loss, least_loss, most_right
    from sameas.errors import InputError
    from sameas.estimate import Estimate, match
    from sameas.evidence import (
        CloseObjects,
        ConstantCost,
        Displacement,
        Errors,
        Field,
        Flat,
        GaussianMixture,
        PoissonField,
        Samples,
        Universal,
    )
    from sameas.gate import Box, ChiSquare, Radius
    from sameas.identify import identify
    from sameas.many import identify_many
    from sameas.objects import Objects
    from sameas.observations import Bearing, LinearPart, Observations, Region
    from sameas.prior import CommonObjects, PerPair
    from sameas.records import Records
    from sameas.registration import Affine, Registration, SensorBias, Shift, Similarity, register
    from sameas.result import Identification
    from sameas.sequence import identify_sequentially
    from sameas.space import Plane, Sphere
    from sameas.spacing import estimate_reach

__version__ = "0.1.0"

__all__ = [
    "Affine",
    "Bearing",
    "Box",
    "ChiSquare",
    "CloseObjects",
    "CommonObjects",
    "ConstantCost",
    "Displacement",
    "Errors",
    "Estimate",
    "Field",
    "Flat",
    "GaussianMixture",
    "Identification",
    "InputError",
    "LinearPart",
    "Loss",
    "MissedObjects",
    "Objects",
    "Observations",
    "PerPair",
    "Plane",
    "PoissonField",
    "PoissonObjects",
    "Radius",
    "Records",
    "Region",
    "Registration",
    "Samples",
    "SensorBias",
    "Shift",
    "Similarity",
    "Sphere",
    "Universal",
    "estimate_reach",
    "identify",
    "identify_many",
    "identify_sequentially",
    "least_loss",
    "match",
    "most_right",
    "register",
]

_HOMES = {
    "belief": (
        "MissedObjects",
        "PoissonObjects",
    ),
    "decision": (
        "Loss",
        "least_loss",
        "most_right",
    ),
    "errors": ("InputError",),
    "estimate": (
        "Estimate",
        "match",
    ),
    "evidence": (
        "CloseObjects",
        "ConstantCost",
        "Displacement",
        "Errors",
        "Field",
        "Flat",
        "GaussianMixture",
        "PoissonField",
        "Samples",
        "Universal",
    ),
    "gate": (
        "Box",
        "ChiSquare",
        "Radius",
    ),
    "identify": ("identify",),
    "many": ("identify_many",),
    "objects": ("Objects",),
    "observations": (
        "Bearing",
        "LinearPart",
        "Observations",
        "Region",
    ),
    "prior": (
        "CommonObjects",
        "PerPair",
    ),
    "records": ("Records",),
    "registration": (
        "Affine",
        "Registration",
        "SensorBias",
        "Shift",
        "Similarity",
        "register",
    ),
    "result": ("Identification",),
    "sequence": ("identify_sequentially",),
    "space": (
        "Plane",
        "Sphere",
    ),
    "spacing": ("estimate_reach",),
}
_HOME = {name: home for home, names in _HOMES.items() for name in names}


class _Package(ModuleType):
    """Importing the module ``sameas.identify`` must not hide the function of that name."""

    def __setattr__(self, name: str, value: object) -> None:
        if name == "identify" and isinstance(value, ModuleType):
            value = value.identify
        super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package


def __getattr__(name: str) -> object:
    if name not in _HOME:
        raise AttributeError(f"module 'sameas' has no attribute {name!r}")
    value = getattr(import_module(f"sameas.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})

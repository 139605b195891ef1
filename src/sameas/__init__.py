"""sameas tells which records of two or more sources are the same real thing, and how sure it is.

``identify`` is the whole method; ``Records``, a decision rule, a prior and a gate are what it needs; ``match``
estimates what is not known. Names are imported when they are first used, so that ``import sameas`` costs nothing.
"""

from __future__ import annotations

import sys
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sameas.errors import InputError
    from sameas.estimate import Estimate, match
    from sameas.evidence import CloseObjects, ConstantCost, Errors, Field, PoissonField
    from sameas.gate import Box, ChiSquare, Radius
    from sameas.identify import identify
    from sameas.prior import CommonObjects, PerPair
    from sameas.records import Records
    from sameas.result import Identification
    from sameas.space import Plane, Sphere

__version__ = "0.1.0"

__all__ = [
    "Box", "ChiSquare", "CloseObjects", "CommonObjects", "ConstantCost", "Errors", "Estimate", "Field",
    "Identification", "InputError", "PerPair", "Plane", "PoissonField", "Radius", "Records", "Sphere", "identify",
    "match",
]  # fmt: skip

_HOMES = {
    "errors": ("InputError",),
    "estimate": ("Estimate", "match"),
    "evidence": ("CloseObjects", "ConstantCost", "Errors", "Field", "PoissonField"),
    "gate": ("Box", "ChiSquare", "Radius"),
    "identify": ("identify",),
    "prior": ("CommonObjects", "PerPair"),
    "records": ("Records",),
    "result": ("Identification",),
    "space": ("Plane", "Sphere"),
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

"""Targets seen by sensors: sources described, their reports in one plane and at one instant, biases taken away.

Use :class:`Scene` where several sensors watch the same objects: describe each (:class:`Description`, or
:func:`read_descriptions` from a file), read what it wrote (:func:`sameas.io.sensors.read_reports`), and ask the scene
for an instant, which :func:`sameas.identify_many` understands. Names are imported when they are first used.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sameas.tracks.coordinates import LocalPlane
    from sameas.tracks.feed import Feed
    from sameas.tracks.kinds import KINDS
    from sameas.tracks.registration import SourceBiases
    from sameas.tracks.reports import Reports
    from sameas.tracks.scene import POSITION, POSITION_AND_VELOCITY, Instant, Scene
    from sameas.tracks.source import (
        BiasPrior,
        Calibration,
        Clutter,
        Coverage,
        Description,
        ErrorModel,
        Misses,
        Motion,
        Resolution,
        Site,
        Targets,
        Timing,
        read_descriptions,
    )

__all__ = [
    "KINDS",
    "POSITION",
    "POSITION_AND_VELOCITY",
    "BiasPrior",
    "Calibration",
    "Clutter",
    "Coverage",
    "Description",
    "ErrorModel",
    "Feed",
    "Instant",
    "LocalPlane",
    "Misses",
    "Motion",
    "Reports",
    "Resolution",
    "Scene",
    "Site",
    "SourceBiases",
    "Targets",
    "Timing",
    "read_descriptions",
]

_HOMES = {
    "coordinates": ("LocalPlane",),
    "feed": ("Feed",),
    "kinds": ("KINDS",),
    "registration": ("SourceBiases",),
    "reports": ("Reports",),
    "scene": ("POSITION", "POSITION_AND_VELOCITY", "Instant", "Scene"),
    "source": (
        "BiasPrior", "Calibration", "Clutter", "Coverage", "Description", "ErrorModel", "Misses", "Motion",
        "Resolution", "Site", "Targets", "Timing", "read_descriptions",
    ),
}  # fmt: skip
_HOME = {name: home for home, names in _HOMES.items() for name in names}


def __getattr__(name: str) -> object:
    if name not in _HOME:
        raise AttributeError(f"module 'sameas.tracks' has no attribute {name!r}")
    value = getattr(import_module(f"sameas.tracks.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})

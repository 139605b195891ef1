"""Areas of the sphere to scatter directions over, and directions moved along it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sameas.arrays import FloatArray
from sameas.errors import InputError
from sameas.space import ARCSEC_PER_RADIAN, displaced


@dataclass(frozen=True)
class WholeSky:
    """All directions."""

    def steradians(self) -> float:
        """Area."""
        return 4 * math.pi

    def draw(self, rng: np.random.Generator, n: int) -> FloatArray:
        """(n, 2) directions, evenly scattered: longitude, latitude in degrees."""
        return LonLatBox((0.0, 360.0), (-90.0, 90.0)).draw(rng, n)


@dataclass(frozen=True)
class Cap:
    """The directions within ``radius_deg`` of a centre."""

    lon_deg: float
    lat_deg: float
    radius_deg: float

    def __post_init__(self) -> None:
        if not 0 < self.radius_deg <= 180:
            raise InputError(f"Cap: radius_deg is {self.radius_deg}; give a radius above 0 and up to 180")

    def steradians(self) -> float:
        """Area."""
        return 4 * math.pi * math.sin(math.radians(self.radius_deg) / 2) ** 2

    def draw(self, rng: np.random.Generator, n: int) -> FloatArray:
        """(n, 2) directions, evenly scattered: longitude, latitude in degrees."""
        distance = 2 * np.arcsin(math.sin(math.radians(self.radius_deg) / 2) * np.sqrt(rng.uniform(size=n)))
        angle = rng.uniform(0, 2 * np.pi, n)
        offset = distance[:, None] * np.stack([np.sin(angle), np.cos(angle)], axis=1) * ARCSEC_PER_RADIAN
        return displaced(np.broadcast_to([self.lon_deg, self.lat_deg], (n, 2)), offset)


@dataclass(frozen=True)
class LonLatBox:
    """The directions between two meridians and two parallels, (low, high) each; longitude may pass 360."""

    lon_deg: tuple[float, float]
    lat_deg: tuple[float, float]

    def __post_init__(self) -> None:
        if not 0 < self.lon_deg[1] - self.lon_deg[0] <= 360:
            raise InputError(f"LonLatBox: lon_deg is {self.lon_deg}; give (low, high) that span up to 360")
        if not -90 <= self.lat_deg[0] < self.lat_deg[1] <= 90:
            raise InputError(f"LonLatBox: lat_deg is {self.lat_deg}; give (low, high) within ±90")

    def steradians(self) -> float:
        """Area."""
        low, high = np.sin(np.radians(self.lat_deg))
        return float(math.radians(self.lon_deg[1] - self.lon_deg[0]) * (high - low))

    def draw(self, rng: np.random.Generator, n: int) -> FloatArray:
        """(n, 2) directions, evenly scattered: longitude, latitude in degrees."""
        low, high = np.sin(np.radians(self.lat_deg))
        sine = rng.uniform(low, high, n)
        return np.stack([rng.uniform(*self.lon_deg, n) % 360, np.degrees(np.arcsin(sine))], axis=1)

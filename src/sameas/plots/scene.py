"""A small piece of sky laid flat, and the outlines that are drawn on it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sameas.records import FloatArray
from sameas.space import ARCSEC_PER_RADIAN


@dataclass(frozen=True)
class Frame:
    """East and north axes at the middle of some directions; good over a few arcminutes, at the poles too."""

    middle: FloatArray
    east: FloatArray
    north: FloatArray

    @classmethod
    def about(cls, position_deg: FloatArray) -> Frame:
        """The frame at the mean direction of (n, 2) longitudes and latitudes."""
        middle = _axes(position_deg)[0].mean(axis=0)
        middle /= np.linalg.norm(middle)
        lon = np.degrees(np.arctan2(middle[1], middle[0]))
        lat = np.degrees(np.arctan2(middle[2], np.hypot(middle[0], middle[1])))
        _, east, north = _axes(np.array([[lon, lat]]))
        return cls(middle, east[0], north[0])

    def __call__(self, position_deg: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(n, 2) places in arcsec east and north of the middle, and (n, 2, 2) matrices that turn vectors on a
        record's own east and north into vectors on the frame's."""
        direction, east, north = _axes(position_deg)
        basis = np.stack([self.east, self.north])
        place = ARCSEC_PER_RADIAN * (direction - self.middle) @ basis.T
        return place, np.stack([east @ basis.T, north @ basis.T], axis=2)


def _axes(position_deg: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(n, 3) unit vectors towards each direction, to its east and to its north."""
    lon, lat = np.radians(np.asarray(position_deg, dtype=np.float64)).T
    zero = np.zeros_like(lon)
    direction = np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], axis=1)
    east = np.stack([-np.sin(lon), np.cos(lon), zero], axis=1)
    north = np.stack([-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)], axis=1)
    return direction, east, north


def ellipse(place: FloatArray, covariance: FloatArray, sigmas: float, points: int = 121) -> FloatArray:
    """(points, 2) closed outline of the ellipse of so many σ about a place; east and north, in its unit."""
    angle = np.linspace(0.0, 2.0 * np.pi, points)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    values, vectors = np.linalg.eigh(covariance)
    return place + sigmas * (circle * np.sqrt(np.maximum(values, 0.0))) @ vectors.T


def nice_length(most: float) -> float:
    """The longest of 1, 2, 5 times a power of ten that is not longer than ``most``."""
    power = 10.0 ** np.floor(np.log10(most))
    return float(max(step * power for step in (1, 2, 5) if step * power <= most * (1 + 1e-9)))

"""Rates of motion of movers: their density in ecliptic axes, estimated from the data.

Rates are relative to that of a circular orbit in the ecliptic at 2.7 au at the same elongation from the Sun: most
asteroids then form one narrow component anywhere on the sky. A mixture of Gaussians is convolved with the error of a
measured rate in closed form (extreme deconvolution, Bovy, Hogg & Roweis 2011, AnnAS 5, 1657).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sameas.arrays import FloatArray, IntArray
from sameas.gaussian import inverse, log_density
from sameas.space import ARCSEC_PER_RADIAN, from_plane, to_plane, unit_vectors

#: Gauss's constant: the mean angular speed of the Earth about the Sun, radian per day; and in arcsec per minute.
GAUSS = 0.01720209895
_EARTH_ARCSEC_PER_MIN = GAUSS * ARCSEC_PER_RADIAN / 1440.0
#: Radius of the orbit to which rates are relative, in the main belt.
ORBIT_AU = 2.7
#: Obliquity of the ecliptic of J2000, radians (IAU 1976): that to which orbital elements refer. Catalogues in ecliptic
#: coordinates refer to that of IAU 2006 (``sky/column_values.py``).
OBLIQUITY = math.radians(84381.448 / 3600.0)
#: Direction of the pole of the ecliptic, ICRS.
ECLIPTIC_POLE = np.array([0.0, -math.sin(OBLIQUITY), math.cos(OBLIQUITY)])


def sun_longitude_deg(mjd: FloatArray) -> FloatArray:
    """Ecliptic longitude of the Sun, accurate to 0.4° over a century (Astronomical Almanac, low-precision formula)."""
    days = np.asarray(mjd) - 51544.5
    anomaly = np.radians(357.528 + 0.9856003 * days)
    # The mean longitude refers to the equinox of date, directions here to that of J2000: 0.0000382° per day.
    return (280.460 + 0.9856474 * days + 1.915 * np.sin(anomaly) + 0.020 * np.sin(2 * anomaly) - 3.82e-5 * days) % 360.0


def reference_rate(elongation_deg: FloatArray) -> FloatArray:
    """Rate in longitude, arcsec/min, of a circular orbit at 2.7 au in the ecliptic; elongation east of the Sun."""
    angle = np.radians(elongation_deg)
    cos, sin = np.cos(angle), np.sin(angle)
    distance = cos + np.sqrt(cos**2 + ORBIT_AU**2 - 1.0)
    # The Sun is at (1, 0) from the Earth, so the Earth moves along −y.
    x, y = distance * cos - 1.0, distance * sin
    vx, vy = -y / ORBIT_AU**1.5, x / ORBIT_AU**1.5 + 1.0
    return np.asarray(_EARTH_ARCSEC_PER_MIN * (vy * cos - vx * sin) / distance)


def ecliptic_longitude_deg(unit: FloatArray) -> FloatArray:
    """(n,) ecliptic longitudes of directions (n, 3)."""
    y = unit[:, 1] * math.cos(OBLIQUITY) + unit[:, 2] * math.sin(OBLIQUITY)
    return np.asarray(np.degrees(np.arctan2(y, unit[:, 0])) % 360.0)


@dataclass(frozen=True)
class EclipticAxes:
    """Directions and the axes of ecliptic longitude and latitude at them.

    unit, east, north : (n, 3) unit vectors of each direction, and along increasing longitude and latitude.
    rotation : (n, 2) cosine and sine of the angle from the equatorial to the ecliptic axes.
    """

    unit: FloatArray
    east: FloatArray
    north: FloatArray
    rotation: FloatArray
    longitude_deg: FloatArray

    @classmethod
    def of(cls, ra_deg: FloatArray, dec_deg: FloatArray) -> EclipticAxes:
        """The axes at ICRS directions, (n,) each."""
        ra = np.radians(ra_deg)
        unit = unit_vectors(ra_deg, dec_deg)
        east = np.cross(ECLIPTIC_POLE, unit)
        east /= np.maximum(np.linalg.norm(east, axis=1, keepdims=True), 1e-12)
        north = np.cross(unit, east)
        east_equator = np.column_stack([-np.sin(ra), np.cos(ra), np.zeros_like(ra)])
        north_equator = np.cross(unit, east_equator)
        rotation = np.column_stack([(east * east_equator).sum(1), (east * north_equator).sum(1)])
        return cls(unit, east, north, rotation, ecliptic_longitude_deg(unit))

    def offsets(self, origin: np.ndarray, other: np.ndarray) -> FloatArray:
        """(m, 2) offsets of directions ``other`` on the tangent planes at ``origin``, arcsec; both (m,) are rows."""
        axes = self.east[origin], self.north[origin]
        return ARCSEC_PER_RADIAN * to_plane(self.unit[other], self.unit[origin], axes)

    def directions(self, origin: np.ndarray, offsets: FloatArray) -> FloatArray:
        """(m, 3) unit vectors at offsets (m, 2), arcsec, on the tangent planes at rows ``origin``."""
        return from_plane(offsets / ARCSEC_PER_RADIAN, self.unit[origin], (self.east[origin], self.north[origin]))

    def rotated(self, covariance: FloatArray) -> FloatArray:
        """(n, 2, 2) covariances on these axes. covariance : (n, 3) ee, en, nn on the equatorial axes."""
        cos, sin = self.rotation.T
        ee, en, nn = covariance.T
        xx = cos**2 * ee + 2 * cos * sin * en + sin**2 * nn
        yy = sin**2 * ee - 2 * cos * sin * en + cos**2 * nn
        xy = cos * sin * (nn - ee) + (cos**2 - sin**2) * en
        return np.stack([np.stack([xx, xy], -1), np.stack([xy, yy], -1)], -2)

    def to_equator(self, rows: np.ndarray, offsets: FloatArray) -> FloatArray:
        """(m, 2) offsets at some rows, rotated from these axes to equatorial east and north."""
        cos, sin = self.rotation[rows].T
        x, y = offsets.T
        return np.column_stack([cos * x - sin * y, sin * x + cos * y])


@dataclass(frozen=True)
class RateDensity:
    """A Gaussian mixture of rates relative to the reference, arcsec/min along ecliptic longitude and latitude.

    share : (c,). mean : (c, 2). covariance : (c, 2, 2). For g groups, or m rates, each has a second axis (c, g, ...).
    """

    share: FloatArray
    mean: FloatArray
    covariance: FloatArray

    @classmethod
    def of(cls, share: list[float], mean: list[tuple[float, float]], sigma: list[tuple[float, float]]) -> RateDensity:
        """The mixture of shares, means and standard deviations along both axes."""
        covariance = np.zeros((len(share), 2, 2))
        covariance[:, [0, 1], [0, 1]] = np.square(sigma)
        return cls(np.asarray(share) / np.sum(share), np.asarray(mean, float), covariance)

    def _parts(self, rate: FloatArray, error: FloatArray) -> FloatArray:
        """(m, c) ln of share and density of each component at rates (m, 2) with errors (m, 2, 2)."""
        out = np.empty((len(rate), len(self.share)))
        for c, (share, mean, spread) in enumerate(zip(self.share, self.mean, self.covariance, strict=True)):
            out[:, c] = np.log(share) + log_density(rate - mean, error + spread)
        return out

    def log_density(self, rate: FloatArray, error: FloatArray) -> FloatArray:
        """(m,) ln of the density per (arcsec/min)² at measured rates (m, 2) with covariances (m, 2, 2)."""
        parts = self._parts(rate, error)
        top = parts.max(axis=1)
        return np.asarray(top + np.log(np.exp(parts - top[:, None]).sum(axis=1)))

    def prior_at(self, rate: FloatArray, error: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(m, 2), (m, 2, 2): mean and covariance of the mixture, its components weighted by each measured rate."""
        parts = self._parts(rate, error)
        weight = np.exp(parts - parts.max(axis=1, keepdims=True))
        weight /= weight.sum(axis=1, keepdims=True)
        mean = weight @ self.mean
        off = self.mean[None] - mean[:, None]
        spread = np.einsum("mc,cij->mij", weight, self.covariance) + np.einsum("mc,mci,mcj->mij", weight, off, off)
        return mean, spread

    def moments(
        self, rate: FloatArray, error: FloatArray, weight: FloatArray, group: IntArray, groups: int
    ) -> RateMoments:
        """Moments of the true rates given measured ones (m, 2), (m, 2, 2), by weight (m,), component and group (m,)."""
        parts = self._parts(rate, error)
        share = np.exp(parts - parts.max(axis=1, keepdims=True))
        share *= (weight / share.sum(axis=1))[:, None]
        out = RateMoments.none(len(self.share), groups)
        for c in range(len(self.share)):
            own = self.covariance[c]
            gain = own @ inverse(own + error)
            value = self.mean[c] + np.einsum("mij,mj->mi", gain, rate - self.mean[c])
            square = value[:, :, None] * value[:, None] + own - gain @ own
            np.add.at(out.count[c], group, share[:, c])
            np.add.at(out.first[c], group, share[:, c, None] * value)
            np.add.at(out.second[c], group, share[:, c, None, None] * square)
        return out

    def counted(self, counts: float) -> RateMoments:
        """The moments of ``counts`` rates distributed as this mixture, in one group."""
        count = counts * self.share
        square = self.covariance + self.mean[:, :, None] * self.mean[:, None]
        return RateMoments(
            count[:, None], (count[:, None] * self.mean)[:, None], (count[:, None, None] * square)[:, None]
        )

    def refined(self, rate: FloatArray, error: FloatArray, weight: FloatArray, *, counts: float) -> RateDensity:
        """The mixture after one EM iteration; this mixture is the prior with a weight of ``counts`` rates."""
        one_group = np.zeros(len(rate), np.int64)
        return (self.counted(counts) + self.moments(rate, error, weight, one_group, 1)).densities().group(0)

    def group(self, group: int | IntArray) -> RateDensity:
        """The mixture of one group, or of the groups (m,) of each rate."""
        return RateDensity(self.share[:, group], self.mean[:, group], self.covariance[:, group])


@dataclass(frozen=True)
class RateMoments:
    """Sums over rates by component and group: counts (c, g), rates (c, g, 2), and their squares (c, g, 2, 2)."""

    count: FloatArray
    first: FloatArray
    second: FloatArray

    @classmethod
    def none(cls, components: int, groups: int) -> RateMoments:
        """Moments of no rates."""
        shape = components, groups
        return cls(np.zeros(shape), np.zeros((*shape, 2)), np.zeros((*shape, 2, 2)))

    def __add__(self, other: RateMoments) -> RateMoments:
        return RateMoments(self.count + other.count, self.first + other.first, self.second + other.second)

    def __sub__(self, other: RateMoments) -> RateMoments:
        return RateMoments(self.count - other.count, self.first - other.first, self.second - other.second)

    def all(self) -> RateMoments:
        """The moments summed over all groups, as one group."""
        return RateMoments(*(getattr(self, name).sum(axis=1, keepdims=True) for name in self.__dataclass_fields__))

    def densities(self) -> RateDensity:
        """The mixtures with these moments, (c, g)."""
        mean = self.first / self.count[..., None]
        covariance = self.second / self.count[..., None, None] - mean[..., :, None] * mean[..., None, :]
        return RateDensity(self.count / self.count.sum(axis=0), mean, covariance)


#: Prior density of rates: the main belt, its edges, near-Earth objects, satellites. The first three were estimated by
#: ``learn`` from nights of ZTF alerts of March 2021, the others are chosen wide.
SOLAR_SYSTEM = RateDensity.of(
    [0.55, 0.35, 0.07, 0.02, 0.01],
    [(0.0, 0.0), (0.0, 0.0), (0.0, 0.0), (0.0, 0.0), (0.0, 0.0)],
    [(0.05, 0.07), (0.10, 0.16), (0.25, 0.35), (2.0, 2.0), (15.0, 15.0)],
)

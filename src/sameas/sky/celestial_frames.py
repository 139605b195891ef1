"""Celestial frames: galactic, ecliptic and B1950 positions, with their errors, converted to ICRS.

The directions of the axes of each frame are those of the matrices below.

The galactic frame is that of the Hipparcos and Gaia catalogues (ESA 1997, SP-1200, vol. 1, section 1.5.3), the
ecliptic one that of J2000 with the obliquity of IAU 2006, 84381.406″; with other obliquities the difference is up to
0.05″ (orbital elements refer to that of IAU 1976, ``sky/movers/rates.py``).
"""

from __future__ import annotations

import numpy as np

from sameas.arrays import FloatArray
from sameas.gaussian import correlation_of
from sameas.sky.conventions import SkyFrame
from sameas.space import ARCSEC_PER_RADIAN, local_axes, unit_vectors

# Columns: the directions of the galactic x, y and z axes in ICRS (SP-1200, equation 1.5.11).
_GALACTIC = np.array(
    [
        [-0.0548755604162154, +0.4941094278755837, -0.8676661490190047],
        [-0.8734370902348850, -0.4448296299600112, -0.1980763734312015],
        [-0.4838350155487132, +0.7469822444972189, +0.4559837761750669],
    ]
)
_OBLIQUITY = np.radians(84381.406 / 3600.0)
_ECLIPTIC = np.array(
    [[1.0, 0.0, 0.0], [0.0, np.cos(_OBLIQUITY), -np.sin(_OBLIQUITY)], [0.0, np.sin(_OBLIQUITY), np.cos(_OBLIQUITY)]]
)


# From the FK4 with the equinox B1950 to the FK5 (ICRS to 0.03″), for objects that do not move on the sky, observed at
# B1950: E-terms of aberration, and the matrices from positions at B1950 to positions and motions (arcsec per Julian
# century) at J2000 (Aoki, Sôma, Kinoshita and Inoue 1983, A&A 128, 263; as in SOFA's iauFk425). Within 1.4 mas of
# astropy's FK5.
_E_TERMS = np.array([-1.62557e-6, -0.31919e-6, -0.13843e-6])
_FK4_POSITION = np.array(
    [
        [0.9999256782, -0.0111820611, -0.0048579477],
        [0.0111820610, 0.9999374784, -0.0000271765],
        [0.0048579479, -0.0000271474, 0.9999881997],
    ]
)
_FK4_MOTION = np.array(
    [[-0.000551, -0.238565, 0.435739], [0.238514, -0.002667, -0.008541], [-0.435623, 0.012254, 0.002117]]
)
#: Julian centuries from B1950 to J2000.
_CENTURIES = 0.500002095577002


def _from_b1950(unit: FloatArray) -> FloatArray:
    """(3, n) directions at J2000, not normalised, of unit vectors (3, n) at B1950."""
    at = unit - _E_TERMS[:, None] + (_E_TERMS @ unit) * unit
    return np.asarray(_FK4_POSITION @ at + (-_CENTURIES / ARCSEC_PER_RADIAN) * (_FK4_MOTION @ at))


def to_icrs(frame: SkyFrame, lon_deg: FloatArray, lat_deg: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(n,) right ascension and declination, degrees, and the rotation of the frame's axes, radians.

    lon_deg, lat_deg : (n,). The rotation is the angle from the direction of increasing right ascension to that of
    increasing longitude, positive towards north.

    >>> ra, dec, _ = to_icrs("galactic", np.array([0.0]), np.array([90.0]))
    >>> float(ra[0].round(3)), float(dec[0].round(3))
    (192.859, 27.128)
    """
    unit = unit_vectors(lon_deg, lat_deg).T
    if frame == "B1950":
        matrix, (x, y, z) = _FK4_POSITION, _from_b1950(unit)
    else:
        matrix = {"galactic": _GALACTIC, "ecliptic": _ECLIPTIC}[frame]
        x, y, z = matrix @ unit
    ra, dec = np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))
    # The direction of increasing longitude in ICRS, relative to east and north there.
    ex, ey, ez = matrix @ local_axes(*np.radians([lon_deg, lat_deg]))[0].T
    east = -np.sin(ra) * ex + np.cos(ra) * ey
    north = -np.sin(dec) * (np.cos(ra) * ex + np.sin(ra) * ey) + np.cos(dec) * ez
    return np.degrees(ra) % 360.0, np.degrees(dec), np.arctan2(north, east)


def in_icrs(frame: SkyFrame, position_deg: FloatArray) -> FloatArray:
    """(n, 2) positions in ICRS, degrees, of those in another frame."""
    ra, dec, _ = to_icrs(frame, *position_deg.T)
    return np.column_stack([ra, dec])


def rotated_errors(
    along: FloatArray, across: FloatArray, rho: FloatArray | None, rotation: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Standard deviations east and north and their correlation, from those along longitude and latitude.

    along, across : (n,). rho : (n,) their correlation or None. rotation : (n,) from :func:`to_icrs`.
    """
    xx, yy = along**2, across**2
    xy = np.zeros_like(xx) if rho is None else rho * along * across
    cos, sin = np.cos(rotation), np.sin(rotation)
    ee = cos**2 * xx - 2.0 * sin * cos * xy + sin**2 * yy
    nn = sin**2 * xx + 2.0 * sin * cos * xy + cos**2 * yy
    en = sin * cos * (xx - yy) + (cos**2 - sin**2) * xy
    east, north = np.sqrt(ee), np.sqrt(nn)
    return east, north, correlation_of(en, east, north)

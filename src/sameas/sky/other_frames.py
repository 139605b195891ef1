"""Positions in galactic and ecliptic coordinates, brought to ICRS with the directions of their axes.

The galactic frame is that of the Hipparcos and Gaia catalogues (ESA 1997, SP-1200, vol. 1, section 1.5.3), the ecliptic
one that of J2000 with the obliquity of IAU 2006, 84381.406″; catalogues that take another differ by up to 0.05″.
"""

from __future__ import annotations

import numpy as np

from sameas.arrays import FloatArray
from sameas.sky.conventions import SkyFrame

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


def to_icrs(frame: SkyFrame, lon_deg: FloatArray, lat_deg: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Right ascension and declination in degrees, and by how much (radians) the frame's axes stand turned.

    lon_deg, lat_deg : (n,). The turn is the angle from the direction of growing right ascension to that of growing
    longitude, positive towards north.

    >>> ra, dec, _ = to_icrs("galactic", np.array([0.0]), np.array([90.0]))
    >>> float(ra[0].round(3)), float(dec[0].round(3))
    (192.859, 27.128)
    """
    turned = {"galactic": _GALACTIC, "ecliptic": _ECLIPTIC}[frame]
    lon, lat = np.radians(lon_deg), np.radians(lat_deg)
    x, y, z = turned @ np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
    ra, dec = np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))
    # Where longitude grows, as a direction in ICRS, against east and north there.
    ex, ey, ez = turned @ np.stack([-np.sin(lon), np.cos(lon), np.zeros_like(lon)])
    east = -np.sin(ra) * ex + np.cos(ra) * ey
    north = -np.sin(dec) * (np.cos(ra) * ex + np.sin(ra) * ey) + np.cos(dec) * ez
    return np.degrees(ra) % 360.0, np.degrees(dec), np.arctan2(north, east)


def turned_errors(
    along: FloatArray, across: FloatArray, rho: FloatArray | None, turn: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Standard deviations east and north and their correlation, from those along longitude and latitude.

    along, across : (n,). rho : (n,) their correlation, None for none. turn : (n,) of :func:`to_icrs`.
    """
    xx, yy = along**2, across**2
    xy = np.zeros_like(xx) if rho is None else rho * along * across
    cos, sin = np.cos(turn), np.sin(turn)
    ee = cos**2 * xx - 2.0 * sin * cos * xy + sin**2 * yy
    nn = sin**2 * xx + 2.0 * sin * cos * xy + cos**2 * yy
    en = sin * cos * (xx - yy) + (cos**2 - sin**2) * xy
    east, north = np.sqrt(ee), np.sqrt(nn)
    with np.errstate(divide="ignore", invalid="ignore"):
        return east, north, np.nan_to_num(en / (east * north), posinf=0.0, neginf=0.0)

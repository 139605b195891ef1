"""Hull: from the antenna that a ship reports to the middle of the ship that a radar sees.

A ship of 300 m with its antenna over the bridge reports a position 80 m from its middle: more than the errors of either
sensor. The position is moved along the heading; the hull's extent goes into the covariance, since nobody knows from
which part of it an echo comes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sameas.records import FloatArray
from sameas.tracks.coordinates import along_and_across, geodesy


@dataclass(frozen=True)
class Hull:
    """Distances (n,) in metres from the antenna to bow, stern, port and starboard; NaN or all 0 where not known.

    Bow and port 0 with stern and starboard above 0 tell the size of a ship, but not where its antenna is (ITU-R
    M.1371).
    """

    to_bow_m: FloatArray
    to_stern_m: FloatArray
    to_port_m: FloatArray
    to_starboard_m: FloatArray

    @property
    def length_m(self) -> FloatArray:
        """(n,) NaN where not known."""
        return _known(self.to_bow_m + self.to_stern_m)

    @property
    def width_m(self) -> FloatArray:
        """(n,) NaN where not known."""
        return _known(self.to_port_m + self.to_starboard_m)

    @property
    def antenna_known(self) -> np.ndarray:
        """(n,) whether the antenna's place on the hull is told."""
        nowhere = (self.to_bow_m == 0.0) & (self.to_port_m == 0.0)
        return ~np.isnan(self.length_m) & ~(nowhere & (self.to_stern_m > 0.0) & (self.to_starboard_m > 0.0))

    def centre(
        self, lat_deg: FloatArray, lon_deg: FloatArray, heading_deg: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Latitude and longitude (n,) of the middle, and what the hull adds to the covariance (n, 3), m² east, north.

        heading_deg : (n,) from true north; NaN where not known: there nothing is moved, and the covariance holds the
            offset turned in all directions.

        The extent counts as if echoes came evenly from all over the hull: L²/12 along it and B²/12 across.
        """
        length, width = np.nan_to_num(self.length_m), np.nan_to_num(self.width_m)
        ahead = np.where(self.antenna_known, (self.to_bow_m - self.to_stern_m) / 2.0, 0.0)
        starboard = np.where(self.antenna_known, (self.to_starboard_m - self.to_port_m) / 2.0, 0.0)
        # Somewhere on the hull: as far from the middle as an echo is.
        often = np.where(self.antenna_known, 1.0, 2.0)
        along, across = often * length**2 / 12.0, often * width**2 / 12.0
        turned = np.isfinite(heading_deg)
        heading = np.where(turned, heading_deg, 0.0)
        everywhere = (along + across + ahead**2 + starboard**2) / 2.0
        extent = along_and_across(np.where(turned, along, everywhere), np.where(turned, across, everywhere), heading)
        angle = np.radians(heading)
        east = np.where(turned, ahead * np.sin(angle) + starboard * np.cos(angle), 0.0)
        north = np.where(turned, ahead * np.cos(angle) - starboard * np.sin(angle), 0.0)
        lat, lon, _ = geodesy().enu2geodetic(east, north, np.zeros_like(east), lat_deg, lon_deg, np.zeros_like(east))
        return np.atleast_1d(lat), np.atleast_1d(lon), np.stack([extent[:, 0, 0], extent[:, 0, 1], extent[:, 1, 1]], -1)


def _known(size: FloatArray) -> FloatArray:
    with np.errstate(invalid="ignore"):
        return np.where(size > 0.0, size, np.nan)

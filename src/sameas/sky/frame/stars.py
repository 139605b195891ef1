"""Stars: the catalogue's directions and magnitudes that a frame is placed by."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sameas.arrays import FloatArray, IntArray
from sameas.errors import InputError


@dataclass(frozen=True)
class Stars:
    """Catalogue stars where they are at the frame's epoch.

    Attributes
    ----------
    ra_deg, dec_deg : (m,) ICRS. sigma_arcsec : (m,) error per axis, or one number. magnitude : (m,) in any band near
        that of the frame; a star without one (NaN) counts as faintest.
    """

    ra_deg: FloatArray
    dec_deg: FloatArray
    sigma_arcsec: FloatArray | float
    magnitude: FloatArray
    name: str = "catalogue"

    def __post_init__(self) -> None:
        n = len(self.ra_deg)
        for what in ("dec_deg", "sigma_arcsec", "magnitude"):
            values = np.asarray(getattr(self, what), dtype=np.float64)
            if values.shape != (n,) and not (what == "sigma_arcsec" and values.ndim == 0):
                raise InputError(f"{self.name}: {what} has shape {values.shape}; give one number per star, ({n},)")
        known = np.isfinite(self.ra_deg) & np.isfinite(self.dec_deg) & (np.asarray(self.sigma_arcsec) >= 0)
        if not known.all():
            row = int(np.flatnonzero(~known)[0])
            raise InputError(f"{self.name}: row {row} has no position or no error; leave such stars out")

    def order(self) -> IntArray:
        """(m,) rows, brightest first."""
        return np.argsort(np.where(np.isnan(self.magnitude), np.inf, self.magnitude), kind="stable")

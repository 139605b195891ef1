"""Unmeasured motion: what is believed of the motion of an object that no catalogue gives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sameas.errors import InputError
from sameas.records import FloatArray


@dataclass(frozen=True)
class MissingMotion:
    """What is believed of a motion that was not measured: mean zero, these standard deviations, uncorrelated.

    The defaults are those of a faint field star. Michalik et al. 2015 (A&A 583, A68) give the prior that Gaia
    uses for its two-parameter solutions: at G = 20 a parallax scatter of 0.4 mas (galactic plane) to 1.1 mas
    (poles), and 10 /yr times that in proper motion. Radial velocities near the Sun scatter by some 50 km/s
    (both discs, and the Sun's own motion). A brighter or nearer sample deserves larger values.
    """

    pm_sigma_mas_per_yr: float = 10.0
    parallax_sigma_mas: float = 1.0
    radial_velocity_sigma_km_per_s: float = 50.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 0.0 <= value < np.inf:
                raise InputError(f"MissingMotion: {name} is {value}; give a standard deviation, zero or more")

    def __call__(
        self, parameter: int, value: FloatArray | None, error: FloatArray | None, n: int
    ) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
        """(n,) values and errors of a parameter with NaN where unknown, or None, filled; and where they were filled.

        Positions are left alone. A value without an error is kept, and gets the error of a missing one.
        An error without a value is of no use and gives way.
        """
        pm = self.pm_sigma_mas_per_yr
        prior = (np.nan, np.nan, self.parallax_sigma_mas, pm, pm, self.radial_velocity_sigma_km_per_s)[parameter]
        if value is None:
            # One number stands for all rows; it takes no room.
            return np.broadcast_to(0.0, n), np.broadcast_to(prior, n), np.broadcast_to(True, n)
        error = np.broadcast_to(np.nan, n) if error is None else error
        if parameter < 2:
            return value, error, np.broadcast_to(False, n)
        no_value = np.isnan(value)
        filled = no_value | np.isnan(error)
        return np.where(no_value, 0.0, value), np.where(filled, prior, error), filled

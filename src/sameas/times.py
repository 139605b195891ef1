"""Astropy's times, of which nothing is fetched: leap seconds and the Earth's rotation are those that are installed.

Astropy loads newer tables from the network where its own are some weeks old, without being asked.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

from astropy.time import Time
from astropy.utils import iers


def _with_leap_seconds() -> None:
    """Astropy looks for newer leap seconds once in a process, at the first time that needs them: now."""
    with iers.conf.set_temp("auto_download", False), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        _ = Time(0.0, format="unix").tai


_with_leap_seconds()


@cache
def _rotation() -> Any:
    import astropy_iers_data

    return iers.IERS_A.open(astropy_iers_data.IERS_A_FILE)


@contextmanager
def installed_rotation() -> Iterator[None]:
    """Within the block astropy takes the Earth's rotation from the table that is installed, whatever its age.

    At times that the table does not hold, the pole is the mean one and UT1 is UTC: a place is off by half a kilometre.
    """
    with iers.earth_orientation_table.set(_rotation()), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


__all__ = ["Time", "installed_rotation"]

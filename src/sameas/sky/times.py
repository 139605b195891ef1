"""Astropy's times without network access: leap seconds and the Earth's rotation come from the installed tables.

By default astropy downloads newer tables when its own are some weeks old.
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
    """Load the leap seconds now: astropy looks for newer ones once per process, at the first time that needs them."""
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
    """Within the block astropy takes the Earth's rotation from the installed table, whatever its age.

    At times outside the table, the mean pole and UT1 = UTC are used: a position is off by half a kilometre.
    """
    with iers.earth_orientation_table.set(_rotation()), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


__all__ = ["Time", "installed_rotation"]

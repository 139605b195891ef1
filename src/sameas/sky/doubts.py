"""Doubts: what is legal in a catalogue, but looks like a wrong unit, a wrong column or a wrong year."""

from __future__ import annotations

import numpy as np

from sameas.sky.motion import Astrometry
from sameas.sky.understood import CatalogueOptions, ColumnChoice

_LARGEST_SIGMA_ARCSEC, _LEAST_SIGMA_ARCSEC = 60.0, 1e-6
_FASTEST_MAS_PER_YR = 20_000.0  # Barnard's star moves 10.4 arcsec a year


def doubts_of(astrometry: Astrometry, choice: ColumnChoice, options: CatalogueOptions) -> tuple[str, ...]:
    """Lines that question a catalogue; none if nothing looks wrong."""
    lines = [
        _errors(astrometry, choice),
        _radians(astrometry, choice),
        _hours(astrometry, choice),
        _epochs(astrometry, choice),
        _motions(astrometry, choice),
        _motion_errors(choice, options),
    ]
    return tuple(line for line in lines if line)


def _errors(astrometry: Astrometry, choice: ColumnChoice) -> str:
    sigma = 1e-3 * np.sqrt(0.5 * (astrometry.variance(0) + astrometry.variance(1)))
    known = sigma[np.isfinite(sigma) & np.isfinite(astrometry.ra_deg) & np.isfinite(astrometry.dec_deg)]
    if not len(known):
        return "no row has both a position and a positive error: nothing can be matched"
    median = float(np.median(known))
    names = ", ".join(column.name for column in choice.error.columns) or "sigma"
    if median > _LARGEST_SIGMA_ARCSEC:
        return f"the position errors ({names}) have a median of {median:g} arcsec: are they rather in mas?"
    if median < _LEAST_SIGMA_ARCSEC:
        return f"the position errors ({names}) have a median of {median:g} arcsec: are they rather in degrees?"
    lost = len(sigma) - len(known)
    if lost:
        return f"{lost} of {len(sigma)} rows lack a position or a positive error and are set aside"
    return ""


def _radians(astrometry: Astrometry, choice: ColumnChoice) -> str:
    if choice.ra.unit != "deg" or choice.ra.reason != "by convention":
        return ""
    ra, dec = astrometry.ra_deg, astrometry.dec_deg
    known = np.isfinite(ra) & np.isfinite(dec)
    if known.any() and (np.abs(dec[known]) <= np.pi / 2).all() and (ra[known] <= 2 * np.pi).all():
        return f"{choice.ra.name}, {choice.dec.name} say no unit and stay below 2π and π/2: are they in radians?"
    return ""


def _hours(astrometry: Astrometry, choice: ColumnChoice) -> str:
    if choice.ra.unit != "deg" or choice.ra.reason != "by convention":
        return ""
    ra, dec = astrometry.ra_deg, astrometry.dec_deg
    known = np.isfinite(ra) & np.isfinite(dec)
    # Right ascensions of a whole sky that end at 24
    if known.any() and ra[known].max() <= 24.0 and np.ptp(ra[known]) > 12.0 and np.ptp(dec[known]) > 60.0:
        return f"{choice.ra.name} says no unit and stays below 24: is it in hours?"
    return ""


def _epochs(astrometry: Astrometry, choice: ColumnChoice) -> str:
    epochs = astrometry.epoch_jyr
    known = epochs[np.isfinite(epochs)]
    odd = known[(known < 1850) | (known > 2100)]
    if len(odd):
        return f"the epoch {odd[0]:g} ({choice.epoch.reason}) lies outside 1850 to 2100"
    lost = len(epochs) - len(known)
    if lost and len(known):
        return f"{lost} rows have no epoch ({choice.epoch.reason}) and are set aside when moved"
    return ""


def _motions(astrometry: Astrometry, choice: ColumnChoice) -> str:
    if choice.motion[1] is None:
        return ""
    speed = np.hypot(astrometry.pm_ra_mas_per_yr, astrometry.pm_dec_mas_per_yr)
    with np.errstate(invalid="ignore"):
        fast = np.flatnonzero(speed > _FASTEST_MAS_PER_YR)
    if not len(fast):
        return ""
    return (
        f"{len(fast)} proper motions exceed 20 arcsec/yr "
        f"(first: row {fast[0]}, {1e-3 * speed[fast[0]]:g} arcsec/yr): is {choice.motion[1].name} in mas/yr?"
    )


def _motion_errors(choice: ColumnChoice, options: CatalogueOptions) -> str:
    if choice.motion[1] is None or choice.motion_errors[1] is not None or options.pm_sigma_mas_per_yr is not None:
        return ""
    return (
        f"{choice.motion[1].name} has no column of errors, so its error is taken to be that of an "
        "unknown motion; say --pm-sigma MAS_PER_YR"
    )

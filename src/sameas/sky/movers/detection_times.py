"""Times of detections: a table's column of times as MJD of the middle of the exposure, UTC, at the Earth.

:func:`times_of` reads MJD, JD, dates, days with a clock beside them, and elapsed times with the zero of the header
(MJDREF of event files), on the scale of TIMESYS; times at the Sun or the barycentre (HJD, BJD) become those at the
Earth.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import numpy as np
from astropy import units as u
from numpy.typing import NDArray

from sameas.arrays import FloatArray, median
from sameas.errors import InputError, naming
from sameas.sky import column_values
from sameas.sky.catalogue import Catalogue
from sameas.sky.frame.cards import TAI_MINUS_GPS_S, reference_mjd, scale_of
from sameas.space import unit_vectors

#: Recognised names of columns of times, ignoring case, in order of preference.
TIMES = (
    "mjd_utc", "mjd", "mjd_mid", "mjd_obs", "midpointmjdtai", "expmidptmjd", "obstime", "obs_time", "date_obs",
    "jd_utc_mid", "jd_utc", "jd", "bjd_tdb", "bjd_utc", "bjd", "hjd_utc", "hjd", "date_utc", "date", "time",
)  # fmt: skip
#: Recognised names of a time of day beside a column of days.
CLOCKS = (
    "ut", "utc", "uth", "ut_hours", "ut_h", "hour_ut", "ut_mid", "ut_start", "ut_obs", "ut_time", "utc_time",
    "time_ut", "time_utc", "time_obs", "time",
)  # fmt: skip
#: MJD of 1890, before the first asteroid was photographed (1891), and of 2150: times outside are in another unit.
_FIRST_MJD, _LAST_MJD = 11368.0, 106332.0
#: Columns of LSST whose MJD are those of TAI, by lower-case name.
_IN_TAI = ("midpointmjdtai", "expmidptmjd")
#: Numbers above this are Julian dates, not MJD.
_JULIAN = 2_000_000.0
#: Names of times at the Sun or the barycentre: HJD, BJD_TDB, MHJD, BMJD.
_AT_SUN = re.compile(r"[rmt]?([hb])[mtk]?jd")
_AU_LIGHT_DAYS = 499.004784 / 86400.0


def times_of(catalogue: Catalogue, name: str) -> tuple[FloatArray, str]:
    """(n,) MJD (UTC) of the column ``name``, NaN where there is none, and how it was read.

    Raises InputError: the column contains no times, or days without a time of day.
    """
    days, how, scale = _days(catalogue, name)
    at_sun = _AT_SUN.match(name.lower())
    if at_sun is not None:
        scale = scale or ("tdb" if "tdb" in name.lower() or (at_sun[1] == "b" and "utc" not in name.lower()) else "utc")
        centre = "the Sun" if at_sun[1] == "h" else "the barycentre"
        days = _at_earth(_in_utc(days, scale), catalogue, barycentric=at_sun[1] == "b")
        return days, f"{how} at {centre} in {scale.upper()}, turned into UTC at the Earth"
    scale = scale or "utc"
    return _in_utc(days, scale), f"{how}, UTC" if scale == "utc" else f"{how} of {scale.upper()}, turned into UTC"


def possible(mjd: FloatArray) -> NDArray[np.bool_]:
    """Whether numbers may be the MJD of an observation."""
    with np.errstate(invalid="ignore"):
        return np.asarray((mjd > _FIRST_MJD) & (mjd < _LAST_MJD))


def _days(catalogue: Catalogue, name: str) -> tuple[FloatArray, str, str]:
    """(n,) MJD of a column of times on its own scale, how it was read, and the scale if it is stated."""
    keywords = {str(key).upper(): value for key, value in catalogue.table.meta.items()}
    scale = "tai" if name.lower() in _IN_TAI else scale_of(str(keywords.get("TIMESYS", "")))
    column = catalogue.table[name]
    if np.ma.MaskedArray(column).dtype.kind in "fiu":
        days, how = _counted(column, keywords, catalogue.name, name)
    else:
        days, how = _dated(column, catalogue.name, name), "dates"
    known = days[np.isfinite(days)]
    if not len(known) or (known % 1.0 != known[0] % 1.0).any() or known[0] % 0.5:
        return days, how, scale
    clock = _clock(catalogue, name)
    if clock is not None:
        return np.floor(days + 0.5 * (how[0] == "J")) + clock[0], f"{how} and {clock[1]}", scale
    if how == "dates" and all(len(str(text).strip()) <= len("2018-Oct-18") for text in column[np.isfinite(days)]):
        raise InputError(
            f"{catalogue.name}: column {name!r} holds days without a time of day, and there is no column of it "
            f"(known names: {', '.join(CLOCKS[:5])}, …)",
            naming("give {time:NAME} with MJD, JD or dates with a time, in UTC"),
        )
    return days, how, scale


def _counted(column: Any, keywords: Mapping[str, Any], source: str, name: str) -> tuple[FloatArray, str]:
    """(n,) MJD of a column of numbers, and what they are."""
    values = np.ma.MaskedArray(column)
    days = np.asarray(np.ma.filled(values.astype(np.float64), np.nan))
    known = days[np.isfinite(days)]
    unit = getattr(column, "unit", None)
    middle = median(known) if len(known) else np.nan
    counted_from = column_values.stated_zero_mjd(column)
    if counted_from is not None and len(known) and bool(np.all(possible(counted_from + known))):
        return counted_from + days, f"days since JD {counted_from + 2400000.5:.10g}"
    zero = reference_mjd(keywords)
    if zero is not None and len(known) and not _JULIAN < middle < _JULIAN + 1e6 and not _are_mjd(known, unit):
        per_day = _per_day(unit if unit is not None else keywords.get("TIMEUNIT", "s"))
        _refuse_other_times(zero[0] + known / per_day, middle, None, source, name)
        return np.asarray(zero[0] + days / per_day), f"elapsed times since {zero[1]}"
    julian = len(known) > 0 and _JULIAN < middle < _JULIAN + 1e6
    _refuse_other_times(known - 2400000.5 * julian, middle, unit, source, name)
    if julian:
        return days - 2400000.5, "JD"
    if "jd" in name.lower() and "m" not in name.lower():
        return days - 0.5, "JD − 2400000"
    return days, "MJD"


def _are_mjd(known: FloatArray, unit: Any) -> bool:
    return bool(np.all(possible(known))) and (unit is None or unit == "day")


def _per_day(unit: Any) -> float:
    try:
        return float(u.day.to(u.Unit(unit)))
    except (ValueError, TypeError, u.UnitConversionError):
        return 86400.0


def _dated(column: Any, source: str, name: str) -> FloatArray:
    """(n,) MJD of a column of texts."""
    from sameas.sky.times import Time

    texts = np.ma.filled(np.ma.MaskedArray(column).astype(str), "")
    out = np.full(len(texts), np.nan)
    there = np.char.strip(texts) != ""
    try:
        out[there] = Time([t.strip().removesuffix("Z") for t in texts[there]], scale="utc").mjd
    except ValueError:
        raise InputError(
            f"{source}: column {name} holds neither MJD, JD nor dates such as 2018-10-18T03:01:20",
            naming("give {time:NAME}"),
        ) from None
    return out


def _clock(catalogue: Catalogue, day: str) -> tuple[FloatArray, str] | None:
    """(n,) fractions of the day of the column of a time of day, and how it was read; None without such a column."""
    table = catalogue.table
    names = {column.lower(): column for column in reversed(table.colnames) if column != day}
    for name in (names[known] for known in CLOCKS if known in names):
        if column_values.is_sexagesimal(table, name):
            hours, unit = column_values.sexagesimal(table, name, catalogue.name), "h"
        elif column_values.holds_numbers(table, name):
            hours = column_values.numbers(table, name, catalogue.name)
            stated = column_values.unit_of(table, name)
            largest = float(np.nanmax(hours))
            unit = "h" if largest <= 24.0 else "s"
            if stated is not None and stated.is_equivalent(u.s):
                hours, unit = hours * stated.to(u.h), stated.to_string()
            elif unit == "s":
                hours = hours / 3600.0
        else:
            continue
        if np.nanmin(hours) >= 0.0 and np.nanmax(hours) <= 24.0:
            return hours / 24.0, f"{name} [{unit}]"
    return None


def _in_utc(days: FloatArray, scale: str) -> FloatArray:
    """(n,) MJD of a scale as those of UTC."""
    from sameas.sky.times import Time

    if scale == "utc":
        return days
    if scale == "gps":
        days, scale = days + TAI_MINUS_GPS_S / 86400.0, "tai"
    out, known = np.full(len(days), np.nan), np.isfinite(days)
    whole = np.floor(days[known])
    out[known] = Time(whole, days[known] - whole, format="mjd", scale=scale).utc.mjd
    return out


def _at_earth(days: FloatArray, catalogue: Catalogue, *, barycentric: bool) -> FloatArray:
    """(n,) MJD at the Earth of times at the Sun or the barycentre: less the light time along the direction observed.

    Equal times were corrected for one direction, such as the middle of the field: for the mean of their rows here.
    """
    import erfa

    a = catalogue.astrometry
    out, rows = days.copy(), np.flatnonzero(np.isfinite(days) & np.isfinite(a.ra_deg) & np.isfinite(a.dec_deg))
    direction = unit_vectors(a.ra_deg[rows], a.dec_deg[rows])
    _, group = np.unique(days[rows], return_inverse=True)
    mean = np.column_stack([np.bincount(group, axis) for axis in direction.T])
    mean = mean / np.linalg.norm(mean, axis=1, keepdims=True)
    earth = erfa.epv00(2400000.5, days[rows])[int(barycentric)]["p"]
    out[rows] -= _AU_LIGHT_DAYS * np.einsum("nk,nk->n", earth, mean[group])
    return out


def _refuse_other_times(mjd: FloatArray, middle: float, unit: Any, source: str, name: str) -> None:
    """Refuses a column of times most of which are no MJD, or that has another unit than days. middle : as written."""
    in_days = unit is None or not unit.is_equivalent("day") or unit == "day"
    if in_days and 2 * np.count_nonzero(possible(mjd)) >= len(mjd):
        return
    about = f"about {middle:g}{'' if in_days else f' {unit}'}"
    seconds = "; of seconds since 1970 the MJD is 40587 + seconds / 86400"
    hint = seconds if 3e8 < middle < 5e9 else column_values.missing_zero(name, middle)
    raise InputError(
        f"{source}: column {name!r} ({about}) is no MJD or JD between 1890 and 2150{hint}",
        naming("give {time:NAME} with MJD, JD or dates in UTC"),
    )

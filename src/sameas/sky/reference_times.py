"""Reference times of FITS headers: time scales by name, and the zero from which a file counts its times.

Event files of X-ray telescopes count seconds from MJDREF, or MJDREFI + MJDREFF; Kepler and TESS days from BJDREFI +
BJDREFF (FITS standard 4.0, section 9).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

#: Scales of TIMESYS as astropy names them; "gps" is none of its own.
SCALES = {"UTC": "utc", "UT": "utc", "GMT": "utc", "TDB": "tdb", "TT": "tt", "TDT": "tt", "TAI": "tai", "TCB": "tcb"}
SCALES |= {"TCG": "tcg", "UT1": "ut1", "IAT": "tai", "ET": "tt", "GPS": "gps"}
TAI_MINUS_GPS_S = 19.0
_JD_OF_MJD_0 = 2400000.5


def reference_mjd(keywords: Mapping[str, Any]) -> tuple[float, str] | None:
    """The MJD from which times of a file are counted, and the keyword that states it; None without one.

    keywords : by upper-case name.

    >>> reference_mjd({"MJDREFI": 51910, "MJDREFF": 7.5e-4})
    (51910.00075, 'MJDREFI')
    """
    for stem, zero in (("MJDREF", 0.0), ("JDREF", _JD_OF_MJD_0), ("BJDREF", _JD_OF_MJD_0)):
        for name in (stem, f"{stem}I"):
            whole = _number(keywords.get(name))
            if whole is not None:
                fraction = 0.0 if name == stem else _number(keywords.get(f"{stem}F")) or 0.0
                return whole - zero + fraction + (_number(keywords.get("TIMEZERO")) or 0.0) * _unit_days(keywords), name
    return None


def start_mjd(keywords: Mapping[str, Any]) -> tuple[float, str] | None:
    """The MJD of TSTART (the middle of TSTART and TSTOP, if both are there), and what states it; None without."""
    zero, start = reference_mjd(keywords), _number(keywords.get("TSTART"))
    if zero is None or start is None:
        return None
    stop = _number(keywords.get("TSTOP"))
    elapsed = start if stop is None else 0.5 * (start + stop)
    return zero[0] + elapsed * _unit_days(keywords), f"{'TSTART' if stop is None else 'TSTART, TSTOP'} and {zero[1]}"


def _unit_days(keywords: Mapping[str, Any]) -> float:
    """Days of the file's unit of time; seconds without TIMEUNIT, as in the FITS standard."""
    return {"d": 1.0, "day": 1.0, "min": 1 / 1440.0, "h": 1 / 24.0}.get(
        str(keywords.get("TIMEUNIT", "s")).strip().lower(), 1.0 / 86400.0
    )


def _number(value: Any) -> float | None:
    try:
        return None if value is None or isinstance(value, bool) else float(value)
    except (TypeError, ValueError):
        return None

"""Catalogue doubts: legal values of a table that suggest a wrong unit, column, year or a row given twice.

Each doubt is a sentence, or "" without one; it says what looks wrong, the first row or the number, and what to give.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from astropy.table import Table

from sameas.arrays import BoolArray, FloatArray, median
from sameas.errors import InputError, Message, naming
from sameas.representation import counted
from sameas.sky import column_values
from sameas.sky.column_choice import GUESSED, CatalogueOptions, ColumnChoice
from sameas.sky.motion import Astrometry, MissingMotion
from sameas.sky.table_astrometry import FULL_TURN, longitudes

_LARGEST_SIGMA_ARCSEC, _LEAST_SIGMA_ARCSEC = 60.0, 1e-6
#: Typical motions below it are hardly measured in mas/yr, but in degrees a year.
_SLOWEST_MAS_PER_YR = 0.03
_FASTEST_MAS_PER_YR = 20_000.0  # Barnard's star moves 10.4 arcsec a year


def doubts_of(
    table: Table, astrometry: Astrometry, choice: ColumnChoice, options: CatalogueOptions, duplicates: str, source: str
) -> tuple[str, ...]:
    """One line per doubt about a catalogue; empty if nothing looks wrong. duplicates : that of :func:`duplicate_doubt`.

    Raises InputError: most right ascensions are beyond a turn, so that another unit or column is likelier.
    """
    lines = [
        _error_doubt(table, astrometry, choice),
        _assumed_error_doubt(choice),
        _radians_doubt(astrometry, choice),
        _hours_doubt(astrometry, choice),
        _epoch_doubt(astrometry, choice),
        _motion_doubt(astrometry, choice),
        _motion_error_doubt(choice, options),
        _not_measured_note(table, choice),
        _turns_doubt(table, choice, source),
        duplicates,
        _precision_doubt(table, choice, astrometry),
    ]
    return tuple(line for line in lines if line)


def _error_doubt(table: Table, astrometry: Astrometry, choice: ColumnChoice) -> str:
    if choice.error.kind == "unknown":
        return ""
    sigma = 1e-3 * np.sqrt(0.5 * (astrometry.variance(0) + astrometry.variance(1)))
    known = np.compress(np.isfinite(sigma) & np.isfinite(astrometry.ra_deg) & np.isfinite(astrometry.dec_deg), sigma)
    if not len(known):
        return "no row has both a position and a positive error: no row can be matched"
    middle = median(known)
    names = ", ".join(column.name for column in choice.error.columns) or "sigma"
    if middle > _LARGEST_SIGMA_ARCSEC and not choice.error.containment:  # of a survey whose unit is known
        return f"the position errors ({names}) have a median of {middle:g} arcsec: are they rather in mas?"
    if middle < _LEAST_SIGMA_ARCSEC:
        return f"the position errors ({names}) have a median of {middle:g} arcsec: are they rather in degrees?"
    n_unusable = len(sigma) - len(known)
    if n_unusable:
        lack, are = ("lacks", "is") if n_unusable == 1 else ("lack", "are")
        text = f"{n_unusable} of {len(sigma)} rows {lack} a position or a positive error and {are} set aside"
        placed = np.isfinite(astrometry.ra_deg) & np.isfinite(astrometry.dec_deg)
        if np.count_nonzero(placed) == len(known):
            return text
        zero = placed & bool(choice.error.columns)
        for column in choice.error.columns:
            zero &= np.ma.filled(table[column.name] == 0.0, False)
        if zero.any():
            # Rounded to the digits of the column, as those of the brightest sources.
            text += f"; {counted(np.count_nonzero(zero), 'error')} of 0 may be rounded, the least other is "
            return Message(f"{text}{known.min():.2g} arcsec: ", naming("a {sigma_floor:ARCSEC} below that keeps them"))
        remedy = naming("{fill_errors} gives those with a position the typical error of their magnitude")
        return Message(f"{text}; ", remedy)
    return ""


def _assumed_error_doubt(choice: ColumnChoice) -> str:
    """A doubt about errors that are not in the table, or whose unit is not stated."""
    error = choice.error
    if error.survey is not None:
        by = f" at its {choice.magnitude}" if choice.magnitude else ""
        text = f"no column of position errors: those of {error.survey.title}{by} are assumed ({error.survey.source}); "
        return Message(text, naming("give {sigma:ARCSEC} or {sigma:COLUMN} if you know better"))
    if error.guessed_unit:
        guessed = [column for column in error.columns if column.reason == GUESSED]
        names, unit = ", ".join(column.name for column in guessed), guessed[0].unit
        return Message(f"the unit of {names} is not stated; by its size {unit}: ", naming("give {sigma_unit:UNIT}"))
    return ""


def _radians_doubt(astrometry: Astrometry, choice: ColumnChoice) -> str:
    if choice.ra.unit != "deg" or choice.ra.reason != "by convention":
        return ""
    ra, _ = _known_positions(astrometry, lambda ra, dec: (np.abs(dec) <= np.pi / 2) & (ra <= 2 * np.pi))
    if len(ra):
        return f"{choice.ra.name}, {choice.dec.name} state no unit and stay below 2π and π/2: are they in radians?"
    return ""


def _known_positions(
    astrometry: Astrometry, within: Callable[[FloatArray, FloatArray], BoolArray]
) -> tuple[FloatArray, FloatArray]:
    """Right ascension and declination of the rows with both; none if one of them is not ``within``.

    The first rows decide most cases without a look at the others.
    """
    ra, dec = astrometry.ra_deg, astrometry.dec_deg
    for rows in (slice(1000), slice(None)):
        known = np.isfinite(ra[rows]) & np.isfinite(dec[rows])
        known_ra, known_dec = ra[rows][known], dec[rows][known]
        if not within(known_ra, known_dec).all():
            return ra[:0], dec[:0]
    return known_ra, known_dec


def _hours_doubt(astrometry: Astrometry, choice: ColumnChoice) -> str:
    if choice.ra.unit != "deg" or choice.ra.reason != "by convention":
        return ""
    ra, dec = _known_positions(astrometry, lambda ra, dec: ra <= 24.0)
    # A wide field (12° by 60°) whose right ascensions end at 24
    if len(ra) and np.ptp(ra) > 12.0 and np.ptp(dec) > 60.0:
        return f"{choice.ra.name} states no unit and stays below 24: is it in hours?"
    return ""


def _epoch_doubt(astrometry: Astrometry, choice: ColumnChoice) -> str:
    epochs = astrometry.epoch_jyr
    known = epochs[np.isfinite(epochs)]
    odd = known[(known < 1850) | (known > 2100)]
    if len(odd):
        return f"the epoch {odd[0]:g} ({choice.epoch.reason}) lies outside 1850 to 2100"
    n_undated = len(epochs) - len(known)
    if n_undated and len(known):
        have, are = ("has", "is") if n_undated == 1 else ("have", "are")
        return (
            f"{n_undated} of {len(epochs)} rows {have} no epoch ({choice.epoch.reason}) and {are} set aside when moved"
        )
    return ""


def _motion_doubt(astrometry: Astrometry, choice: ColumnChoice) -> str:
    if choice.motion[1] is None:
        return ""
    speed = np.hypot(astrometry.pm_ra_mas_per_yr, astrometry.pm_dec_mas_per_yr)
    typical = float(median(speed[speed > 0.0])) if (speed > 0.0).any() else np.inf
    if typical < _SLOWEST_MAS_PER_YR:
        return f"half of the proper motions are below {typical:.2g} mas/yr: is {choice.motion[1].name} in mas/yr?"
    with np.errstate(invalid="ignore"):
        fast = np.flatnonzero(speed > _FASTEST_MAS_PER_YR)
    if not len(fast):
        return ""
    return (
        f"{counted(len(fast), 'proper motion exceeds', 'proper motions exceed')} 20 arcsec/yr "
        f"(first: row {fast[0]}, {1e-3 * speed[fast[0]]:g} arcsec/yr): is {choice.motion[1].name} in mas/yr?"
    )


def _motion_error_doubt(choice: ColumnChoice, options: CatalogueOptions) -> str:
    if choice.motion[1] is None or choice.motion_errors[1] is not None or options.pm_sigma_mas_per_yr is not None:
        return ""
    survey = choice.survey
    if survey is not None and survey.typical_mas_per_yr is not None:
        return Message(
            f"{choice.motion[1].name} has no column of errors: those of {survey.title} are assumed ({survey.source}); ",
            naming("give {pm_sigma_mas_per_yr:MAS_PER_YR}"),
        )
    return Message(
        f"{choice.motion[1].name} has no column of errors, so the spread of unknown motions is assumed; ",
        naming("give {pm_sigma_mas_per_yr:MAS_PER_YR}"),
    )


#: Rounding steps below this fraction of the typical error are ignored (chosen).
_HARMLESS_STEP = 0.3


def _precision_doubt(table: Table, choice: ColumnChoice, astrometry: Astrometry) -> str:
    """A doubt about positions in single precision (seven digits) that are rounded too coarsely for their errors."""
    steps, placed = [], np.isfinite(astrometry.ra_deg) & np.isfinite(astrometry.dec_deg)
    for column in (choice.ra, choice.dec):
        values = table[column.name]
        if column.parts or values.dtype != np.float32 or column.unit not in FULL_TURN or not placed.any():
            continue
        largest = np.abs(np.ma.filled(np.ma.asarray(values), 0.0)[placed]).max()
        cosine = np.cos(np.radians(np.median(astrometry.dec_deg[placed]))) if column is choice.ra else 1.0
        steps.append((3600.0 * 360.0 / FULL_TURN[column.unit] * cosine * float(np.spacing(largest)), column.name))
    if not steps:
        return ""
    step, name = max(steps)
    sigma = 1e-3 * np.sqrt(0.5 * (astrometry.variance(0) + astrometry.variance(1)))
    known = np.compress(np.isfinite(sigma), sigma)
    if len(known) and step < _HARMLESS_STEP * median(known):
        return ""
    return f"{name} is in single precision: positions are rounded to {step:.2g} arcsec; store it in double precision"


def duplicate_doubt(table: Table, astrometry: Astrometry) -> str:
    """A doubt about rows that repeat others, in all columns or in position only."""
    bits = astrometry.ra_deg.view(np.uint64) * np.uint64(11400714819323198485) ^ astrometry.dec_deg.view(np.uint64)
    ordered = np.sort(bits)  # takes a twentieth of the time of argsort, which is rarely needed
    if not (ordered[1:] == ordered[:-1]).any():
        return ""
    order = np.argsort(bits, kind="stable")
    ra, dec, bits = astrometry.ra_deg[order], astrometry.dec_deg[order], bits[order]
    same = np.flatnonzero((bits[1:] == bits[:-1]) & (ra[1:] == ra[:-1]) & (dec[1:] == dec[:-1]))
    if not len(same):
        return ""
    row, other_row = order[same], order[same + 1]
    identical = np.ones(len(same), np.bool_)
    for name in table.colnames:
        column = table[name]
        if getattr(column, "ndim", 1) == 1:
            first, second = column[row], column[other_row]
            masked = column_values.is_masked(table, name)
            both_nan = (first != first) & (second != second)
            equal = np.ma.filled(np.ma.asarray((first == second) | both_nan), False)
            identical &= np.asarray(equal, np.bool_) | (masked[row] & masked[other_row])
    count = int(np.count_nonzero(identical)) or len(same)
    are, have = ("is", "has") if count == 1 else ("are", "have")
    what = f"{are} given twice" if identical.any() else f"{have} exactly the position of another row"
    k = int(np.flatnonzero(identical)[0]) if identical.any() else 0
    return (
        f"{count} of {len(table)} rows {what} (first: rows {row[k]} and {other_row[k]}); "
        "each counts as an object of its own: remove duplicates"
    )


def filled_note(filled_arcsec: FloatArray, choice: ColumnChoice) -> str:
    """How many rows were given typical errors, and of what size; ``filled`` in arcsec."""
    if not len(filled_arcsec):
        return ""
    least, largest = f"{filled_arcsec.min():.2g}", f"{filled_arcsec.max():.2g}"
    size = least if least == largest else f"{least} to {largest}"
    of = f"magnitude ({choice.magnitude})" if choice.magnitude else "catalogue"
    rows = (
        "1 row has no position error and was"
        if len(filled_arcsec) == 1
        else f"{len(filled_arcsec)} rows have no position error and were"
    )
    return f"{rows} given the typical one of their {of}, {size} arcsec"


def missing_motion_note(unmoved: BoolArray, options: CatalogueOptions) -> tuple[Message, ...]:
    """A note that some rows have no proper motion, with the scatter that is assumed for it."""
    number = int(np.count_nonzero(unmoved))
    if not number:
        return ()
    stated = options.missing_pm_mas_per_yr
    scatter = MissingMotion().pm_sigma_mas_per_yr if stated is None else stated
    rows = f"{number} of {len(unmoved)} rows {'has' if number == 1 else 'have'} no proper motion"
    text = f"{rows}: 0 ± {scatter:g} mas/yr on each axis is assumed"
    return (Message(text, naming("; give {missing_pm:MAS/YR}") if stated is None else ""),)


def _not_measured_note(table: Table, choice: ColumnChoice) -> str:
    count = 0 if not choice.measured else int(np.count_nonzero(column_values.is_masked(table, choice.measured)))
    if not count:
        return ""
    rows = counted(count, "row is a star that was", "rows are stars that were")
    return f"{rows} not measured, and {'is' if count == 1 else 'are'} set aside"


def _turns_doubt(table: Table, choice: ColumnChoice, source: str) -> str:
    """A doubt about right ascensions (or longitudes) beyond a turn, which are reduced to one.

    Raises InputError: most of them are, so that another unit or column is likelier.
    """
    if choice.ra.unit != "deg":
        return ""  # refused beyond a turn when they are read
    lon = longitudes(table, choice, source)
    with np.errstate(invalid="ignore"):
        beyond = np.flatnonzero((lon > 360.0) | (lon < -180.0))
    if not len(beyond):
        return ""
    first = f"first: row {beyond[0]}, {lon[beyond[0]]:g}"
    if 2 * len(beyond) > np.count_nonzero(np.isfinite(lon)):
        raise InputError(
            f"{source}: {choice.ra.name} is beyond 360° or below −180° in {counted(len(beyond), 'row')} ({first})",
            naming("give degrees, or another column: {ra:NAME}"),
            source=source,
        )
    what = "is beyond 360° or below −180° and was" if len(beyond) == 1 else "are beyond 360° or below −180° and were"
    return f"{len(beyond)} of {len(lon)} values of {choice.ra.name} {what} reduced to one turn ({first})"


def unmeasured_magnitude_note(table: Table, choice: ColumnChoice, source: str) -> tuple[str, ...]:
    """A note if the magnitude is that of a flux, or if its cells contain text."""
    if choice.magnitude and column_values.is_flux(table, choice.magnitude):
        return (f"{choice.magnitude} is a flux: −2.5 lg of it is the magnitude; 0 and less count as not measured",)
    _, words = column_values.measured(table, choice.magnitude, source) if choice.magnitude else (None, None)
    if words is None:
        return ()
    return (f"{choice.magnitude}, row {words[0]}: {words[1]!r} is not a number; such cells count as not measured",)

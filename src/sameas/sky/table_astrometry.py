"""Astrometry of a table: positions, motions, errors and epochs in degrees, mas and years from its chosen columns.

Units, notations and frames are those that :func:`sameas.sky.columns.choose` states. Values impossible in their unit are
refused with the first row; missing ones, and placeholders such as 999, are NaN.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from astropy.table import Table

from sameas.arrays import BoolArray, FloatArray, IntArray, median, within_turn
from sameas.errors import InputError, naming
from sameas.gaussian import correlation_of
from sameas.representation import counted
from sameas.sky import column_values
from sameas.sky.celestial_frames import rotated_errors, to_icrs
from sameas.sky.column_choice import OF_RA, SECONDS_OF_RA, CatalogueOptions, ChosenColumn, ColumnChoice, PositionError
from sameas.sky.motion import Astrometry, MissingMotion

FULL_TURN = {"deg": 360.0, "rad": 2 * np.pi, "hourangle": 24.0, "sexagesimal hours": 24.0}

_MOTION_UNITS = ("mas", "mas / yr", "mas / yr", "km / s")


def ellipse_covariance(
    major: FloatArray, minor: FloatArray, angle_deg: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """East variance, north variance and covariance of error ellipses, each (n,).

    major, minor : (n,) semi-axes, one sigma. angle_deg : (n,) of the major axis, east of north.
    """
    sin, cos = np.sin(np.radians(angle_deg)), np.cos(np.radians(angle_deg))
    a2, b2 = major**2, minor**2
    return a2 * sin**2 + b2 * cos**2, a2 * cos**2 + b2 * sin**2, (a2 - b2) * sin * cos


def table_astrometry(
    table: Table, choice: ColumnChoice, options: CatalogueOptions, magnitude: FloatArray | None, source: str
) -> tuple[Astrometry, FloatArray, list[BoolArray]]:
    """Positions, motions and errors; the position errors that were filled in, arcsec; and which rows (n,) have no
    proper motion in right ascension, and which none in declination: an empty list without columns of motions."""
    ra, dec, rotation = _icrs_position(table, choice, source)
    motion = _motions(table, choice, source)
    unmoved = [np.isnan(one) for one in motion[1:3] if one is not None]
    sigma, correlation = _errors(table, choice, options, magnitude, source, rotation)
    filled_arcsec = np.zeros(0)
    if options.fill_errors and choice.error.kind != "unknown":
        sigma, correlation, filled_arcsec = _with_typical_errors(
            sigma, correlation, magnitude, np.isfinite(ra) & np.isfinite(dec)
        )
    epoch = epochs_jyr(table, choice, source)
    dec = _possible_declinations(ra, dec, source)
    missing = MissingMotion()
    if options.missing_pm_mas_per_yr is not None:
        missing = replace(missing, pm_sigma_mas_per_yr=options.missing_pm_mas_per_yr)
    astrometry = Astrometry.of(
        within_turn(ra if np.isfinite(ra).all() else np.where(np.isfinite(ra), ra, np.nan)),
        dec,
        epoch_jyr=np.where(np.isnan(epoch), 2000.0, epoch),
        sigma=sigma,
        correlation=correlation,
        parallax_mas=motion[0],
        pm_ra_mas_per_yr=motion[1],
        pm_dec_mas_per_yr=motion[2],
        radial_velocity_km_per_s=motion[3],
        missing=missing,
        source=source,
    )
    # Astrometry.of requires an epoch: 2000 was a placeholder for an unknown one.
    if np.isnan(epoch).any():
        astrometry = replace(astrometry, epoch_jyr=epoch)
    return astrometry, filled_arcsec, unmoved


def _possible_declinations(ra: FloatArray, dec: FloatArray, source: str) -> FloatArray:
    """The declinations, NaN where a few have a placeholder (99, −999 …). Others beyond ±90° are refused: many suggest
    swapped columns, a few suggest missing values."""
    beyond = np.flatnonzero(np.abs(dec) > 90.0)
    if not len(beyond):
        return dec
    message = f"{source}: declinations beyond ±90° in {counted(len(beyond), 'row')} (first: row {beyond[0]})"
    few = 2 * len(beyond) < np.count_nonzero(np.isfinite(dec))
    if few and column_values.is_placeholder(dec[beyond]).all():
        return np.where(np.abs(dec) > 90.0, np.nan, dec)
    if few:
        remedy: str = f"leave cells empty that were not measured ({dec[beyond[0]]:g} there)"
    elif np.all(np.abs(ra[np.isfinite(ra)]) <= 90.0):
        message += ", right ascensions within it"
        remedy = naming("are the two swapped? give {ra:NAME} {dec:NAME}")
    else:
        remedy = "give degrees"
    raise InputError(message, remedy, source=source)


#: Minimum number of rows per median error (chosen).
_ROWS_PER_MEDIAN = 25
#: Maximum number of medians along the magnitude (chosen).
_MOST_MEDIANS = 50


def typical_errors(sigma: FloatArray, magnitude: FloatArray | None) -> FloatArray:
    """(n,) the median error at the magnitude of each row; the overall median for rows without a magnitude.

    sigma : (n,) errors, NaN where not known. magnitude : (n,), NaN where not known. All NaN if no error is known.

    >>> typical_errors(np.array([0.1, 0.1, np.nan, 0.3, 0.3]), None).tolist()
    [0.2, 0.2, 0.2, 0.2, 0.2]
    """
    known = np.isfinite(sigma) & (sigma > 0)
    if not known.any():
        return np.full(len(sigma), np.nan)
    overall = np.full(len(sigma), median(sigma[known]))
    both = np.flatnonzero(known & np.isfinite(magnitude)) if magnitude is not None else np.zeros(0, np.int64)
    if magnitude is None or len(both) < 2 * _ROWS_PER_MEDIAN:
        return overall
    parts = np.array_split(both[np.argsort(magnitude[both])], min(_MOST_MEDIANS, len(both) // _ROWS_PER_MEDIAN))
    mags = [median(magnitude[part]) for part in parts]
    logs = [median(np.log(sigma[part])) for part in parts]
    return np.where(np.isfinite(magnitude), np.exp(np.interp(magnitude, mags, logs)), overall)


def _with_typical_errors(
    sigma: FloatArray, correlation: FloatArray | None, magnitude: FloatArray | None, placed: BoolArray
) -> tuple[FloatArray, FloatArray | None, FloatArray]:
    """Errors and correlations with typical errors by magnitude where missing, and the typical errors used, arcsec."""
    without_error = np.flatnonzero(placed & ~np.isfinite(sigma[:, :2]).all(axis=1))
    if not len(without_error):
        return sigma, correlation, np.zeros(0)
    typical = typical_errors(np.sqrt(0.5 * (sigma[:, 0] ** 2 + sigma[:, 1] ** 2)), magnitude)[without_error]
    sigma, typical = sigma.copy(), np.where(np.isfinite(typical), typical, np.nan)
    sigma[without_error, 0] = sigma[without_error, 1] = typical
    if correlation is not None:
        correlation = correlation.copy()
        correlation[without_error] = np.eye(correlation.shape[1])
    return sigma, correlation, 1e-3 * typical[np.isfinite(typical)]


def longitudes(table: Table, choice: ColumnChoice, source: str) -> FloatArray:
    """(n,) right ascensions or longitudes in degrees, NaN for placeholders (999, −999 …)."""
    lon = _degrees(table, choice.ra, source)
    with np.errstate(invalid="ignore"):
        beyond = np.flatnonzero(np.abs(lon) > 360.0)
    placeholders = beyond[column_values.is_placeholder(lon[beyond])]
    if len(placeholders):
        lon = lon.copy()
        lon[placeholders] = np.nan
    return lon


def _icrs_position(table: Table, choice: ColumnChoice, source: str) -> tuple[FloatArray, FloatArray, FloatArray | None]:
    """(n,) right ascension and declination, degrees, and the rotation of the axes of another frame (None for ICRS)."""
    lon, lat = longitudes(table, choice, source), _degrees(table, choice.dec, source)
    if choice.measured:
        lon = np.where(column_values.is_masked(table, choice.measured), np.nan, lon)
    if choice.frame == "icrs":
        return lon, lat, None
    beyond = np.flatnonzero(np.abs(lat) > 90.0)
    if len(beyond):
        raise InputError(f"{source}: {choice.dec.name!r}, row {beyond[0]}: {lat[beyond[0]]:g} is beyond ±90 degrees")
    return to_icrs(choice.frame, lon, lat)


def _errors(
    table: Table,
    choice: ColumnChoice,
    options: CatalogueOptions,
    magnitude: FloatArray | None,
    source: str,
    rotation: FloatArray | None,
) -> tuple[FloatArray, FloatArray | None]:
    """(n, k) standard deviations in mas, mas/yr and km/s, and their correlations (n, 6, 6), or None.

    rotation : of the axes of the errors, None if they point east and north. k is 2 without correlations and errors of
    motions, else 6.
    """
    if choice.error.survey is not None:
        east = north = 1e-3 * choice.error.survey.sigma_mas(magnitude, len(table))
        rho = None
    else:
        east, north, rho = _position_sigmas(table, choice.error, source)
        if choice.error.kind == "axes" and choice.error.columns[0].unit == SECONDS_OF_RA:
            east = east * (15.0 * np.cos(np.radians(_degrees(table, choice.dec, source))))
        if choice.error.kind == "inverse variances":  # of right ascension, without cos δ
            east = east * np.cos(np.radians(_degrees(table, choice.dec, source)))
    if rotation is not None and choice.error.kind not in ("circle", "number", "survey"):
        east, north, rho = rotated_errors(east, north, rho, rotation)
    motion = _motion_errors(table, choice, source)
    if choice.survey is not None and choice.motion[1] is not None and options.pm_sigma_mas_per_yr is None:
        pm_sigma = choice.survey.pm_sigma_mas_per_yr(magnitude, len(table))
        motion[1:3] = [pm_sigma if column is None else column for column in motion[1:3]]
    if options.pm_sigma_mas_per_yr is not None:
        for k in (1, 2):
            motion_error = motion[k]
            given = np.full(len(table), np.nan) if motion_error is None else motion_error
            motion[k] = np.where(np.isnan(given), options.pm_sigma_mas_per_yr, given)
    correlated = rho is not None or bool(choice.weights) or bool(choice.correlations)
    motion_sigmas = motion if correlated or any(column is not None for column in motion) else []
    unknown = np.full(len(table) if motion_sigmas else 0, np.nan)
    sigmas = [east, north, *(unknown if column is None else column for column in motion_sigmas)]
    sigma = np.empty((len(sigmas), len(table))).T  # each parameter's errors one after the other
    for k, of_parameter in enumerate(sigmas):
        np.multiply(of_parameter, 1e3 if k < 2 else 1.0, out=sigma[:, k])
    floored = sigma.copy(order="K") if correlated or options.sigma_floor_arcsec else sigma
    if options.sigma_floor_arcsec:
        floored[:, :2] = np.hypot(sigma[:, :2], 1e3 * options.sigma_floor_arcsec)
    floored[:, :2][~(floored[:, :2] > 0)] = np.nan
    if not correlated:
        return floored, None
    correlation = _correlations(table, choice, sigma, source)
    if not choice.weights:
        correlation[:, 0, 1] = correlation[:, 1, 0] = 0.0 if rho is None else rho
    # The floor is independent noise: it adds to the variances and does not change the covariances.
    ratio = np.ones_like(sigma)
    ratio[:, :2] = sigma[:, :2] / floored[:, :2]
    return floored, correlation * ratio[:, :, None] * ratio[:, None, :]


def _degrees(table: Table, column: ChosenColumn, source: str) -> FloatArray:
    if column.parts:
        return column_values.of_parts(table, column.parts, source) * (15.0 if column.unit.startswith("hours") else 1.0)
    if column.unit.startswith("sexagesimal"):
        values = column_values.sexagesimal(table, column.name, source)
    else:
        values = column_values.numbers(table, column.name, source)
    if column.unit == "deg":
        return values
    full_turn = FULL_TURN.get(column.unit, np.inf)
    with np.errstate(invalid="ignore"):
        beyond = np.flatnonzero(np.abs(values) > full_turn * 1.0001)
    if len(beyond):
        raise InputError(
            f"{source}: {column.name!r} is in {column.unit} ({column.reason}), but row {beyond[0]} has "
            f"{values[beyond[0]]:g}; give the column its unit"
        )
    if column.unit == "sexagesimal degrees":
        return values
    return values * (15.0 if column.unit == "sexagesimal hours" else column_values.factor(column.unit, "deg"))


def _position_sigmas(
    table: Table, error: PositionError, source: str
) -> tuple[FloatArray, FloatArray, FloatArray | None]:
    """(n,) standard deviations east and north in arcsec, and their correlation or None."""
    if error.kind in ("number", "unknown"):
        sigma = np.full(len(table), error.sigma_arcsec)
        return sigma, sigma, None
    if error.kind == "variances":
        return _of_variances(table, error, source)
    if error.kind == "inverse variances":
        inverses = _in_unit(table, error, "1/arcsec2", source)
        with np.errstate(invalid="ignore", divide="ignore"):  # 0 states that nothing was measured
            east, north = (1.0 / np.sqrt(np.where(inverse > 0, inverse, np.nan)) for inverse in inverses)
        return east, north, None
    numbers = [column_values.numbers(table, column.name, source) for column in error.columns]
    if error.placeholders:
        numbers[:2] = [np.where(np.isin(size, error.placeholders), np.nan, size) for size in numbers[:2]]
    columns = [
        numbers[k] * (1.0 if c.unit == SECONDS_OF_RA else column_values.factor(c.unit, "deg" if k == 2 else "arcsec"))
        for k, c in enumerate(error.columns)
    ]
    with np.errstate(invalid="ignore"):
        columns[:2] = [np.where(size >= 0, size, np.nan) / error.divisor for size in columns[:2]]
    if error.kind == "circle":
        return columns[0], columns[0], None
    if error.kind == "ellipse":
        major, minor, angle = columns
        angle = angle if error.angle_from == "north" else 90.0 - angle
        xx, yy, xy = ellipse_covariance(major, np.where(minor > 0, minor, np.nan), np.where(major == minor, 0.0, angle))
        return np.sqrt(xx), np.sqrt(yy), xy / np.sqrt(xx * yy)
    east, north = columns
    return east, north, _stated_correlation(table, error, east, north, source)


def _in_unit(table: Table, error: PositionError, unit: str, source: str) -> list[FloatArray]:
    """(n,) each of the columns of an error, in one unit."""
    columns = ((column_values.numbers(table, c.name, source), c.unit) for c in error.columns)
    return [values * column_values.factor(own, unit) for values, own in columns]


def _of_variances(table: Table, error: PositionError, source: str) -> tuple[FloatArray, FloatArray, FloatArray | None]:
    """As of :func:`_position_sigmas`, of an error that is given by variances in columns."""
    with np.errstate(invalid="ignore"):
        east, north = (np.sqrt(np.where(x >= 0, x, np.nan)) for x in _in_unit(table, error, "arcsec2", source))
    return east, north, _by_covariance(table, error, error.columns[0].unit, east, north, source)


def _stated_correlation(
    table: Table, error: PositionError, east: FloatArray, north: FloatArray, source: str
) -> FloatArray | None:
    """(n,) correlation of the errors east and north, arcsec, by a column of it, or of the covariance; None without."""
    if error.correlation:
        return np.nan_to_num(column_values.numbers(table, error.correlation, source))
    if error.co_sigma:
        root = column_values.numbers(table, error.co_sigma, source)
        root = root * column_values.factor(error.columns[0].unit, "arcsec")
        return correlation_of(root * np.abs(root), east, north)
    return _by_covariance(table, error, f"{error.columns[0].unit}2", east, north, source)


def _by_covariance(
    table: Table, error: PositionError, unit: str, east: FloatArray, north: FloatArray, source: str
) -> FloatArray | None:
    """(n,) correlation by a column of the covariance, in its own unit or else in ``unit``; None without one."""
    if not error.covariance:
        return None
    own = column_values.unit_of(table, error.covariance)
    square = column_values.factor(own.to_string() if own else unit, "arcsec2")
    return correlation_of(column_values.numbers(table, error.covariance, source) * square, east, north)


#: Numbers beyond it stand for missing ones, as −999 999 500 at the archives of UKIRT and VISTA, or 1e20.
_LARGEST_MOTION = 1e8


def _motions(table: Table, choice: ColumnChoice, source: str) -> list[FloatArray | None]:
    """Parallax, proper motions and radial velocity, each (n,) in mas, mas/yr and km/s; None without a column.

    Missing are nines (−9999.99, 999) in both proper motions of a row, and below zero as a parallax or a velocity.
    """
    values = [None if c is None else column_values.numbers(table, c.name, source) for c in choice.motion]
    missing = [None if v is None else _rows_of_nines(v) for v in values]
    if missing[1] is not None and missing[2] is not None:
        missing[1] = missing[2] = np.intersect1d(missing[1], missing[2], assume_unique=True)
    for k in (0, 3):
        of_one, rows = values[k], missing[k]
        missing[k] = None if of_one is None or rows is None else rows[of_one[rows] < 0.0]
    known = [None if v is None or rows is None else _without(v, rows) for v, rows in zip(values, missing, strict=True)]
    return _in_motion_units(table, choice.motion, known, choice, source)


def _rows_of_nines(values: FloatArray) -> IntArray:
    rows = np.flatnonzero(np.abs(values) >= 90.0)
    return rows[column_values.is_placeholder(values[rows])]


def _without(values: FloatArray, rows: IntArray) -> FloatArray:
    """The values with NaN in the rows, and where they are beyond every motion."""
    known = np.where(np.abs(values) > _LARGEST_MOTION, np.nan, values)
    known[rows] = np.nan
    return known


def _motion_errors(table: Table, choice: ColumnChoice, source: str) -> list[FloatArray | None]:
    """The errors of :func:`_motions`; negative ones are missing."""
    values = [None if c is None else column_values.numbers(table, c.name, source) for c in choice.motion_errors]
    known = [None if v is None else np.where((v >= 0.0) & (v < _LARGEST_MOTION), v, np.nan) for v in values]
    return _in_motion_units(table, choice.motion_errors, known, choice, source)


def _in_motion_units(
    table: Table,
    columns: tuple[ChosenColumn | None, ...],
    values: Sequence[FloatArray | None],
    choice: ColumnChoice,
    source: str,
) -> list[FloatArray | None]:
    converted: list[FloatArray | None] = []
    for column, numbers, unit in zip(columns, values, _MOTION_UNITS, strict=True):
        if column is None or numbers is None:
            converted.append(None)
        elif column.unit.endswith(OF_RA):
            seconds = column_values.factor(column.unit.removesuffix(OF_RA), "s / yr")
            cos_dec = np.cos(np.radians(_degrees(table, choice.dec, source)))
            converted.append(np.asarray(numbers * (15e3 * seconds) * cos_dec))
        else:
            converted.append(numbers * column_values.factor(column.unit, unit))
    return converted


def _correlations(table: Table, choice: ColumnChoice, sigma: FloatArray, source: str) -> FloatArray:
    """(n, 6, 6) correlations; those of ``hip2`` from its weights."""
    matrices = np.zeros((len(table), 6, 6))
    if choice.weights:
        *weights, f2, transits = (column_values.numbers(table, name, source) for name in choice.weights)
        matrices[:, :5, :5] = hip2_correlations(np.column_stack(weights), sigma[:, :5], f2, transits)
    for i, j, name in () if choice.weights else choice.correlations:
        matrices[:, i, j] = matrices[:, j, i] = np.nan_to_num(column_values.numbers(table, name, source))
    return matrices


def epochs_jyr(table: Table, choice: ColumnChoice, source: str) -> FloatArray:
    """(n,) Julian years, NaN where not known."""
    if choice.epoch.column:
        years = column_values.years(table, choice.epoch.column, source)
        return (
            years
            if np.isnan(choice.epoch.otherwise_jyr)
            else np.where(np.isnan(years), choice.epoch.otherwise_jyr, years)
        )
    return np.broadcast_to(np.nan if choice.epoch.jyr is None else choice.epoch.jyr, len(table))


# The covariance of the new reduction of Hipparcos (I/311, "hip2"), encoded in its weights.
#
# The catalogue gives five formal errors σᵢ and the 15 elements ``UW`` of an upper triangular matrix, column by
# column. The diagonal elements are scaled by the errors, the others are not:
#
#     Uᵢᵢ = UWᵢᵢ u / σᵢ,   Uᵢⱼ = UWᵢⱼ (i < j, in 1/mas),   covariance C = u² U⁻¹ U⁻ᵀ,
#
# u² the unit weight variance, from the goodness of fit F2 with ν = Ntr − 5 degrees of freedom (Wilson and
# Hilferty):
#
#     u² = [ √(2 / 9ν) F2 + 1 − 2 / 9ν ]³
#
# (Michalik, Lindegren, Hobbs and Lammers 2014, A&A 571, A85, appendix B, describe the decoding; this form was
# found from the data: √Cᵢᵢ = σᵢ within the rounding of two decimals for solutions of five parameters.) Where
# the diagonal does not reproduce the quoted errors (solutions of seven and more parameters, whose further
# elements are in other files) the correlations are not known and set to zero.

# Rounding of UW to 0.01 changes the diagonal by less than 1 % in 98 % of the five-parameter solutions.
_HIP2_TOLERANCE = 0.03


def hip2_correlations(weights: FloatArray, errors: FloatArray, f2: FloatArray, n_transits: FloatArray) -> FloatArray:
    """(n, 5, 5) correlations of ra*, dec, parallax, pm ra*, pm dec; the identity where not known.

    weights : (n, 15) UW. errors : (n, 5) quoted formal errors in mas and mas/yr. f2 : (n,) goodness of fit.
    n_transits : (n,) Ntr, the number of field transits used.
    """
    n = len(weights)
    result = np.broadcast_to(np.eye(5), (n, 5, 5)).copy()
    with np.errstate(divide="ignore", invalid="ignore"):
        free = n_transits - 5.0
        variance = (np.sqrt(2 / (9 * free)) * f2 + 1 - 2 / (9 * free)) ** 3
        scaled = _scaled_triangle(weights, errors / np.sqrt(variance)[:, None])
        determinant = scaled[:, range(5), range(5)].prod(axis=1)
    usable = np.flatnonzero(np.isfinite(scaled).all(axis=(1, 2)) & (np.abs(determinant) > 1e-12))
    inverse = np.linalg.inv(scaled[usable])
    covariance = inverse @ inverse.transpose(0, 2, 1)
    deviation = np.sqrt(np.einsum("nii->ni", covariance))
    with_deviation = (np.abs(deviation - 1) < _HIP2_TOLERANCE).all(axis=1)
    spread = deviation[with_deviation]
    result[usable[with_deviation]] = covariance[with_deviation] / (spread[:, :, None] * spread[:, None, :])
    return result


def _scaled_triangle(weights: FloatArray, unscaled_errors: FloatArray) -> FloatArray:
    """(n, 5, 5) triangle U in units of the errors, U'ᵢⱼ = Uᵢⱼ σⱼ / u; its inverse gives the correlations."""
    triangle = np.zeros((len(weights), 5, 5))
    k = 0
    for j in range(5):
        for i in range(j + 1):
            triangle[:, i, j] = weights[:, k] * (unscaled_errors[:, j] if i < j else 1.0)
            k += 1
    return triangle

"""Catalogue: one table of the sky with positions, errors, proper motions, epoch and magnitude in known units.

:meth:`Catalogue.of` finds the columns of a table; :class:`CatalogueOptions` overrides them. Read ``interpretation``
(the chosen columns) and ``doubts`` (what looks wrong) before trusting a result.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from astropy.table import Table
from numpy.typing import NDArray

from sameas.arrays import BoolArray, FloatArray, median, within_turn
from sameas.errors import InputError, Message, naming
from sameas.records import Records
from sameas.representation import counted, in_short
from sameas.sky import column_values, conventions
from sameas.sky.column_choice import (
    GUESSED,
    OF_RA,
    SECONDS_OF_RA,
    CatalogueOptions,
    ChosenColumn,
    ColumnChoice,
    Epoch,
    PositionError,
    in_years,
)
from sameas.sky.column_values import rotated_errors, to_icrs, typical_errors
from sameas.sky.columns import choose
from sameas.sky.motion import Astrometry, MissingMotion, Variances, position_at
from sameas.space import Sphere

# Doubts: legal values that suggest a wrong unit, a wrong column or a wrong year.

_LARGEST_SIGMA_ARCSEC, _LEAST_SIGMA_ARCSEC = 60.0, 1e-6
_FASTEST_MAS_PER_YR = 20_000.0  # Barnard's star moves 10.4 arcsec a year


def doubts_of(astrometry: Astrometry, choice: ColumnChoice, options: CatalogueOptions) -> tuple[str, ...]:
    """One line per doubt about a catalogue; empty if nothing looks wrong."""
    lines = [
        _error_doubt(astrometry, choice),
        _assumed_error_doubt(choice),
        _radians_doubt(astrometry, choice),
        _hours_doubt(astrometry, choice),
        _epoch_doubt(astrometry, choice),
        _motion_doubt(astrometry, choice),
        _motion_error_doubt(choice, options),
    ]
    return tuple(line for line in lines if line)


def _error_doubt(astrometry: Astrometry, choice: ColumnChoice) -> str:
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
    survey = choice.error.survey
    if survey is not None and survey.typical_mas_per_yr is not None:
        return Message(
            f"{choice.motion[1].name} has no column of errors: those of {survey.title} are assumed ({survey.source}); ",
            naming("give {pm_sigma_mas_per_yr:MAS_PER_YR}"),
        )
    return Message(
        f"{choice.motion[1].name} has no column of errors, so the spread of unknown motions is assumed; ",
        naming("give {pm_sigma_mas_per_yr:MAS_PER_YR}"),
    )


__all__ = ["Catalogue", "CatalogueOptions", "ellipse_covariance"]

_FULL_TURN = {"deg": 360.0, "rad": 2 * np.pi, "hourangle": 24.0, "sexagesimal hours": 24.0}
_MOTION_UNITS = ("mas", "mas / yr", "mas / yr", "km / s")


@in_short
@dataclass(frozen=True)
class Catalogue:
    """One source on the sky. Make it with :meth:`Catalogue.of`.

    Attributes
    ----------
    name : used in messages.
    table : the user's table, (n,) rows.
    ids : (n,) identifiers, unique.
    astrometry : (n,) positions, motions and errors; NaN where the position or its error is missing, and in
        ``epoch_jyr`` where the epoch is not known.
    options : given by the user. choice : the chosen columns. interpretation : the same as lines to print.
    doubts : what looks wrong. duplicates : the one about rows that repeat others, or "".
    has_motion : whether any row has a proper motion.
    magnitude, magnitude_error : (n,), NaN where not measured, or None. magnitude_name : the column.
    """

    name: str
    table: Table
    ids: NDArray[Any]
    astrometry: Astrometry
    choice: ColumnChoice
    interpretation: tuple[str, ...]
    doubts: tuple[str, ...]
    has_motion: bool
    options: CatalogueOptions = field(default_factory=CatalogueOptions)
    magnitude: FloatArray | None = None
    magnitude_error: FloatArray | None = None
    duplicates: str = ""

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def named_doubts(self) -> tuple[Message, ...]:
        """The doubts, each with the catalogue's name before it."""
        return tuple(Message(f"{self.name}: ", doubt) for doubt in self.doubts)

    @property
    def magnitude_name(self) -> str | None:
        """The column of the magnitude."""
        return self.choice.magnitude

    @cached_property
    def epoch_jyr(self) -> float | None:
        """The median epoch of the rows, None if no epoch is known."""
        known = self.astrometry.epoch_jyr[np.isfinite(self.astrometry.epoch_jyr)]
        return median(known) if len(known) else None

    @classmethod
    def of(cls, table: Any, name: str, *, options: CatalogueOptions | None = None) -> Catalogue:
        """The catalogue of a table.

        table : astropy Table or QTable, dict of arrays, pyarrow Table or pandas DataFrame.
        name : of the source, for messages. options : columns and values given by the user.

        Raises
        ------
        InputError : an empty table, missing or ambiguous columns (reported together), numbers impossible in
            their unit.

        Example
        -------
        >>> stars = Catalogue.of({"ra": [10.0], "dec": [20.0]}, "stars", options=CatalogueOptions(sigma=0.1))
        >>> stars.records().covariance.round(4)
        array([[0.01]])
        """
        options = CatalogueOptions() if options is None else options
        rows = column_values.as_table(table, name)
        if len(rows) == 0:
            raise InputError(f"{name}: the table has no rows")
        return cls._of_choice(rows, choose(rows, options, name), options, name)

    @classmethod
    def _of_choice(cls, rows: Table, choice: ColumnChoice, options: CatalogueOptions, name: str) -> Catalogue:
        """The catalogue of a table with chosen columns."""
        magnitude = _brightness(rows, choice.magnitude, name)
        astrometry, filled_arcsec = _astrometry(rows, choice, options, magnitude, name)
        pm = choice.motion[1]
        unmoved = [np.isnan(column_values.numbers(rows, c.name, name)) for c in choice.motion[1:3] if c is not None]
        has_motion = pm is not None and not bool(unmoved[0].all())
        if has_motion:
            choice = replace(choice, notes=(*choice.notes, *_missing_motion_note(np.logical_or(*unmoved), options)))
        epoch_doubt = ""
        if has_motion and not np.isfinite(astrometry.epoch_jyr).any():
            choice, epoch_doubt = _with_assumed_epoch(choice)
            astrometry = replace(astrometry, epoch_jyr=_epochs(rows, choice, name))
        ids, id_note = _ids(rows, choice, options, name)
        interpretation = choice.describe(_epoch_range(astrometry.epoch_jyr))
        if not has_motion and not np.isfinite(astrometry.epoch_jyr).any():
            interpretation = (*interpretation, "without epoch and motion: used as it is; it cannot be moved")
        doubts = (epoch_doubt, _filled_note(filled_arcsec, choice), *doubts_of(astrometry, choice, options))
        duplicates = _duplicate_doubt(rows, astrometry)
        doubts += (
            _not_measured_note(rows, choice),
            _turns_doubt(rows, choice, name),
            duplicates,
            _precision_doubt(rows, choice, astrometry),
        )
        return cls(
            name=name,
            table=rows,
            ids=ids,
            astrometry=astrometry,
            choice=choice,
            interpretation=interpretation + id_note + _unmeasured_magnitude_note(rows, choice, name),
            doubts=tuple(doubt for doubt in doubts if doubt),
            duplicates=duplicates,
            has_motion=has_motion,
            options=options,
            magnitude=magnitude,
            magnitude_error=_brightness(rows, choice.magnitude_error, name),
        )

    def with_rows(self, table: Any) -> Catalogue:
        """Other rows of the same source with the same columns and options, without doubts; may be empty."""
        rows = column_values.as_table(table, self.name)
        magnitude = _brightness(rows, self.choice.magnitude, self.name)
        astrometry, _ = _astrometry(rows, self.choice, self.options, magnitude, self.name)
        ids, _ = _ids(rows, self.choice, self.options, self.name)
        return replace(
            self, table=rows, ids=ids, astrometry=astrometry, doubts=(), magnitude=magnitude,
            magnitude_error=_brightness(rows, self.choice.magnitude_error, self.name),
        )  # fmt: skip

    @property
    def error_is_unknown(self) -> bool:
        """Whether no position errors are known."""
        return self.choice.error.kind == "unknown"

    def with_error(self, error: PositionError) -> Catalogue:
        """The same catalogue with other position errors."""
        return Catalogue._of_choice(self.table, replace(self.choice, error=error), self.options, self.name)

    def with_epoch(self, epoch_jyr: float) -> Catalogue:
        """The same catalogue with one epoch assumed for all rows."""
        epoch = Epoch(jyr=epoch_jyr, reason="assumed")
        return Catalogue._of_choice(self.table, replace(self.choice, epoch=epoch), self.options, self.name)

    def records(self, epoch_jyr: float | None = None) -> Records:
        """The catalogue's records at an epoch, with covariances of east and north in arcsec².

        epoch_jyr : Julian year to which every row is moved; None keeps the observed positions.
        Rows without a position or a positive error are set aside.

        Raises
        ------
        InputError : an epoch is given but the catalogue's epoch is not known; no position errors are known.
        """
        if self.error_is_unknown:
            raise InputError(
                f"{self.name}: no column of position errors ({self.choice.convention})",
                naming("give {sigma:ARCSEC}, {sigma:COLUMN} or {ellipse:'A,B,ANGLE'}"),
                source=self.name,
            )
        a = self.astrometry
        if epoch_jyr is None:
            return self._records(a.ra_deg, a.dec_deg, _position_errors(a))
        if self.epoch_jyr is None:
            raise InputError(
                f"{self.name}: its epoch is not known, so it cannot be moved to {epoch_jyr:g}",
                naming("give {epoch:YEAR}"),
                source=self.name,
            )
        known = np.isfinite(a.epoch_jyr)
        with_epoch_known = a if known.all() else replace(a, epoch_jyr=np.where(known, a.epoch_jyr, epoch_jyr))
        ra, dec, covariance = position_at(with_epoch_known, epoch_jyr)
        return self._records(np.where(known, ra, np.nan), dec, covariance)

    def _records(self, ra_deg: FloatArray, dec_deg: FloatArray, position_errors: FloatArray) -> Records:
        """Records at these positions. position_errors : (n, 2) variances or (n, 2, 2) covariances, arcsec²."""
        if position_errors.ndim == 3 and not position_errors[:, 0, 1].any():
            position_errors = np.einsum("nvv->nv", position_errors)
        if position_errors.ndim == 2 and np.array_equal(position_errors[:, 0], position_errors[:, 1]):
            position_errors = position_errors[:, :1]
        return Records.of(
            np.column_stack([ra_deg, dec_deg]),
            variance=position_errors if position_errors.ndim == 2 else None,
            covariance=position_errors if position_errors.ndim == 3 else None,
            ids=self.ids,
            space=Sphere(),
            source=self.name,
            table=self.table,
            invalid="set aside",
        )


def _position_errors(astrometry: Astrometry) -> FloatArray:
    """(n, 2) variances or (n, 2, 2) covariances of the positions, arcsec²."""
    packed = astrometry.packed
    return 1e-6 * (packed.stacked(2) if isinstance(packed, Variances) else packed[:, :2, :2])


def ellipse_covariance(
    major: FloatArray, minor: FloatArray, angle_deg: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """East variance, north variance and covariance of error ellipses, each (n,).

    major, minor : (n,) semi-axes, one sigma. angle_deg : (n,) of the major axis, east of north.
    """
    sin, cos = np.sin(np.radians(angle_deg)), np.cos(np.radians(angle_deg))
    a2, b2 = major**2, minor**2
    return a2 * sin**2 + b2 * cos**2, a2 * cos**2 + b2 * sin**2, (a2 - b2) * sin * cos


def _astrometry(
    table: Table, choice: ColumnChoice, options: CatalogueOptions, magnitude: FloatArray | None, source: str
) -> tuple[Astrometry, FloatArray]:
    """Positions, motions and errors, and the position errors that were filled in, arcsec."""
    ra, dec, rotation = _icrs_position(table, choice, source)
    motion = [_motion_numbers(table, c, u, choice, source) for c, u in zip(choice.motion, _MOTION_UNITS, strict=True)]
    sigma, correlation = _errors(table, choice, options, magnitude, source, rotation)
    filled_arcsec = np.zeros(0)
    if options.fill_errors and choice.error.kind != "unknown":
        sigma, correlation, filled_arcsec = _with_typical_errors(
            sigma, correlation, magnitude, np.isfinite(ra) & np.isfinite(dec)
        )
    epoch = _epochs(table, choice, source)
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
    return (replace(astrometry, epoch_jyr=epoch) if np.isnan(epoch).any() else astrometry), filled_arcsec


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


def _filled_note(filled_arcsec: FloatArray, choice: ColumnChoice) -> str:
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


def _with_assumed_epoch(choice: ColumnChoice) -> tuple[ColumnChoice, str]:
    """The choice with the usual epoch for proper motions without one, and the doubt that reports it."""
    gaia = choice.convention.startswith("Gaia")
    year = 2016.0 if gaia else 2000.0
    hint = " (Gaia DR1 2015.0, DR2 2015.5, DR3 2016.0)" if gaia else ""
    doubt = Message(
        f"its epoch is not stated: {in_years(year)} was assumed; ",
        naming(f"give {{epoch:YEAR}}{hint}, or {{pm:'none'}}"),
    )
    return replace(choice, epoch=Epoch(jyr=year, reason="assumed")), doubt


def _missing_motion_note(unmoved: BoolArray, options: CatalogueOptions) -> tuple[Message, ...]:
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
    count = 0 if not choice.measured else int(np.count_nonzero(_is_masked(table, choice.measured)))
    if not count:
        return ""
    rows = counted(count, "row is a star that was", "rows are stars that were")
    return f"{rows} not measured, and {'is' if count == 1 else 'are'} set aside"


def _is_masked(table: Table, name: str) -> BoolArray:
    column = table[name]
    return np.ma.getmaskarray(column) if hasattr(column, "mask") else np.zeros(len(table), np.bool_)


#: Rounding steps below this fraction of the typical error are ignored (chosen).
_HARMLESS_STEP = 0.3


def _precision_doubt(table: Table, choice: ColumnChoice, astrometry: Astrometry) -> str:
    """A doubt about positions in single precision (seven digits) that are rounded too coarsely for their errors."""
    steps, placed = [], np.isfinite(astrometry.ra_deg) & np.isfinite(astrometry.dec_deg)
    for column in (choice.ra, choice.dec):
        values = table[column.name]
        if column.parts or values.dtype != np.float32 or column.unit not in _FULL_TURN or not placed.any():
            continue
        largest = np.abs(np.ma.filled(np.ma.asarray(values), 0.0)[placed]).max()
        cosine = np.cos(np.radians(np.median(astrometry.dec_deg[placed]))) if column is choice.ra else 1.0
        steps.append((3600.0 * 360.0 / _FULL_TURN[column.unit] * cosine * float(np.spacing(largest)), column.name))
    if not steps:
        return ""
    step, name = max(steps)
    sigma = 1e-3 * np.sqrt(0.5 * (astrometry.variance(0) + astrometry.variance(1)))
    known = np.compress(np.isfinite(sigma), sigma)
    if len(known) and step < _HARMLESS_STEP * median(known):
        return ""
    return f"{name} is in single precision: positions are rounded to {step:.2g} arcsec; store it in double precision"


def _duplicate_doubt(table: Table, astrometry: Astrometry) -> str:
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
            masked = _is_masked(table, name)
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


def _turns_doubt(table: Table, choice: ColumnChoice, source: str) -> str:
    """A doubt about right ascensions (or longitudes) beyond a turn, which are reduced to one.

    Raises
    ------
    InputError : most of them are, so that another unit or column is likelier.
    """
    if choice.ra.unit != "deg":
        return ""  # refused beyond a turn when they are read
    lon = _longitudes(table, choice, source)
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


def _longitudes(table: Table, choice: ColumnChoice, source: str) -> FloatArray:
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
    lon, lat = _longitudes(table, choice, source), _degrees(table, choice.dec, source)
    if choice.measured:
        lon = np.where(_is_masked(table, choice.measured), np.nan, lon)
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
    motion = [
        _motion_numbers(table, c, u, choice, source) for c, u in zip(choice.motion_errors, _MOTION_UNITS, strict=True)
    ]
    if choice.error.survey is not None and choice.motion[1] is not None and options.pm_sigma_mas_per_yr is None:
        pm_sigma = choice.error.survey.pm_sigma_mas_per_yr(magnitude, len(table))
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
    full_turn = _FULL_TURN.get(column.unit, np.inf)
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
        names = [
            *((c.name, c.unit) for c in error.columns),
            *([(error.covariance, "arcsec2")] * bool(error.covariance)),
        ]
        squares = [column_values.numbers(table, n, source) * column_values.factor(u, "arcsec2") for n, u in names]
        with np.errstate(invalid="ignore", divide="ignore"):
            east, north = (np.sqrt(np.where(square >= 0, square, np.nan)) for square in squares[:2])
            rho = np.nan_to_num(squares[2] / (east * north), posinf=0.0, neginf=0.0) if error.covariance else None
        return east, north, rho
    if error.kind == "inverse variances":
        inverses = [
            column_values.numbers(table, c.name, source) * column_values.factor(c.unit, "1/arcsec2")
            for c in error.columns
        ]
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
    if error.correlation:
        return east, north, np.nan_to_num(column_values.numbers(table, error.correlation, source))
    if error.co_sigma:
        root = column_values.numbers(table, error.co_sigma, source)
        root = root * column_values.factor(error.columns[0].unit, "arcsec")
        with np.errstate(divide="ignore", invalid="ignore"):
            return east, north, np.nan_to_num(root * np.abs(root) / (east * north), posinf=0.0, neginf=0.0)
    if error.covariance:
        unit = column_values.unit_of(table, error.covariance)
        native = column_values.factor(error.columns[0].unit, "arcsec") ** 2
        square = column_values.factor(unit.to_string(), "arcsec2") if unit else native
        covariance = column_values.numbers(table, error.covariance, source) * square
        with np.errstate(divide="ignore", invalid="ignore"):
            return east, north, np.nan_to_num(covariance / (east * north), posinf=0.0, neginf=0.0)
    return east, north, None


def _motion_numbers(
    table: Table, column: ChosenColumn | None, unit: str, choice: ColumnChoice, source: str
) -> FloatArray | None:
    if column is None:
        return None
    if column.unit.endswith(OF_RA):
        seconds = column_values.factor(column.unit.removesuffix(OF_RA), "s / yr")
        cos_dec = np.cos(np.radians(_degrees(table, choice.dec, source)))
        return np.asarray(column_values.numbers(table, column.name, source) * (15e3 * seconds) * cos_dec)
    return column_values.numbers(table, column.name, source) * column_values.factor(column.unit, unit)


def _correlations(table: Table, choice: ColumnChoice, sigma: FloatArray, source: str) -> FloatArray:
    """(n, 6, 6) correlations; see :mod:`sameas.sky.conventions` for those derived from weights."""
    matrices = np.zeros((len(table), 6, 6))
    if choice.weights:
        *weights, f2, transits = (column_values.numbers(table, name, source) for name in choice.weights)
        matrices[:, :5, :5] = conventions.correlations(np.column_stack(weights), sigma[:, :5], f2, transits)
    for i, j, name in () if choice.weights else choice.correlations:
        matrices[:, i, j] = matrices[:, j, i] = np.nan_to_num(column_values.numbers(table, name, source))
    return matrices


def _epochs(table: Table, choice: ColumnChoice, source: str) -> FloatArray:
    """(n,) Julian years, NaN where not known."""
    if choice.epoch.column:
        return column_values.years(table, choice.epoch.column, source)
    return np.broadcast_to(np.nan if choice.epoch.jyr is None else choice.epoch.jyr, len(table))


def _epoch_range(epochs: FloatArray) -> str:
    known = epochs[np.isfinite(epochs)]
    if not len(known):
        return ""
    first, last = known.min(), known.max()
    return in_years(float(first)) if first == last else f"{first:.2f} to {last:.2f}"


def _ids(
    table: Table, choice: ColumnChoice, options: CatalogueOptions, source: str
) -> tuple[NDArray[Any], tuple[str, ...]]:
    """(n,) identifiers, and a note if the id column cannot be used."""
    if choice.id is None:
        return np.arange(len(table)), ()
    column = table[choice.id]
    if np.ma.getmaskarray(column).any() if hasattr(column, "mask") else False:
        return np.arange(len(table)), (f"id: {choice.id} has empty cells, so rows are numbered",)
    ids = np.asarray(column)
    if ids.ndim > 1 or any(isinstance(one, np.ndarray | list) for one in (ids if ids.dtype.kind == "O" else ())):
        if options.id:
            raise InputError(
                f"{source}: column {choice.id!r} has several values in a cell; give a column of single ids"
            )
        return np.arange(len(table)), (f"id: {choice.id} has several values in a cell, so rows are numbered",)
    if not options.id and _repeats(ids):
        return np.arange(len(table)), (f"id: {choice.id} is not unique, so rows are numbered",)
    return ids, ()


def _brightness(table: Table, name: str | None, source: str) -> FloatArray | None:
    """(n,) magnitudes, NaN where not measured."""
    if name is None:
        return None
    return column_values.magnitudes(table, name, source)


def _unmeasured_magnitude_note(table: Table, choice: ColumnChoice, source: str) -> tuple[str, ...]:
    """A note if cells of the magnitude contain text."""
    _, words = column_values.measured(table, choice.magnitude, source) if choice.magnitude else (None, None)
    if words is None:
        return ()
    return (f"{choice.magnitude}, row {words[0]}: {words[1]!r} is not a number; such cells count as not measured",)


def _repeats(ids: NDArray[Any]) -> bool:
    """Whether an identifier occurs twice."""
    if ids.dtype.kind in "iu" and np.all(ids[1:] > ids[:-1]):
        return False
    ordered = np.sort(ids.astype(str) if ids.dtype.kind == "O" else ids)
    return bool(np.any(ordered[1:] == ordered[:-1]))

"""Column values: numbers of table columns in any unit and notation, with missing values as NaN.

The readers take a table and a column name and return float64, NaN for empty cells.
"""

from __future__ import annotations

import math
import re
import warnings
from datetime import UTC, datetime
from typing import Any

import numpy as np
from astropy import units as u
from astropy.table import QTable, Table
from numpy.typing import NDArray

from sameas.arrays import BoolArray, FloatArray, median
from sameas.errors import InputError, naming

_SEXAGESIMAL = re.compile(r"^\s*[+-−]?\s*\d+\s*[:hdʰ°\s]\s*\d+", re.IGNORECASE)
_SEPARATORS = re.compile(r"[:hdmsʰᵐˢ°'\"′″\s]+", re.IGNORECASE)
#: Texts of missing numbers, in lower case.
_MISSING = frozenset(("", "nan", "null", "none", "-", "--", "---", "na", "n/a", "#n/a", "<na>", "...", "…", "indef"))
#: JD of the zeros of counts with a name of their own: TESS (also TBJD in its archive's pages) and Kepler (archive
#: manual, 2.3.2), both barycentric.
_NAMED = {"btjd": 2457000.0, "tbjd": 2457000.0, "bkjd": 2454833.0}
#: A count and the number subtracted from it: JD from 2 300 000 on, or MJD from 40 000 to 60 000 behind an MJD.
_SUBTRACTED = re.compile(
    r"(?:(?P<jd>jd)|(?P<mjd>mjd))(?:[ _]?(?:utc|tdb|tt|tai))?[\s()\-−–_+]+"
    r"(?P<zero>(?(jd)2[34]\d{5}|[456]\d{4})(?:\.\d*)?)(?!\d)"
)
_JD_OF_MJD = 2400000.5
_DAYS = re.compile(r"[bhrtk]{0,2}m?jd(?![a-z])")


def as_table(data: Any, source: str) -> Table:
    """An astropy Table of a table, dict of arrays, pyarrow Table or pandas DataFrame, without a copy if possible."""
    if isinstance(data, QTable):
        return Table(data, copy=False)
    if isinstance(data, Table):
        return data
    if isinstance(data, dict):
        return Table(data, copy=False)
    if hasattr(data, "column_names") and hasattr(data, "schema"):
        return Table({name: _from_arrow(data.column(name)) for name in data.column_names}, copy=False)
    if hasattr(data, "iloc") and hasattr(data, "columns"):
        return Table.from_pandas(data)
    raise InputError(
        f"{source}: {type(data).__name__} is not a table; give an astropy Table, a dict of arrays, "
        "a pyarrow Table or a pandas DataFrame"
    )


def _from_arrow(column: Any) -> NDArray[Any]:
    if not column.null_count:
        return np.asarray(column.to_numpy())
    values = column.to_pylist()
    empty = np.array([value is None for value in values])
    filler = next((value for value in values if value is not None), np.nan)
    return np.ma.MaskedArray(np.array([filler if value is None else value for value in values]), mask=empty)


def unit_of(table: Table, name: str) -> u.UnitBase | None:
    """The unit of the column, None if it has none or an unknown one."""
    unit = getattr(table[name], "unit", None)
    if unit is None or isinstance(unit, u.UnrecognizedUnit) or unit == u.dimensionless_unscaled:
        return None
    return u.Unit(unit)


def is_text(table: Table, name: str) -> bool:
    """Whether the column contains text."""
    kind = getattr(table[name], "dtype", None)  # columns of times and coordinates have none
    return kind is not None and kind.kind in "USO"


def is_sexagesimal(table: Table, name: str) -> bool:
    """Does the column hold angles written like 12 34 56.7 or 12:34:56.7?"""
    if not is_text(table, name):
        return False
    return any(_SEXAGESIMAL.match(text) for text in _texts(table, name)[:1000])


def _texts(table: Table, name: str) -> list[str]:
    column = table[name]
    empty = np.ma.getmaskarray(column) if hasattr(column, "mask") else np.zeros(len(column), bool)
    return [
        "" if is_empty or cell is None else cell.decode() if isinstance(cell, bytes) else str(cell)
        for cell, is_empty in zip(np.ma.getdata(column).tolist(), np.broadcast_to(empty, len(column)), strict=True)
    ]


def numbers(table: Table, name: str, source: str) -> FloatArray:
    """(n,) numbers of the column in its own unit; the table's own memory if it holds float64: not to be changed."""
    column = table[name]
    if getattr(column, "ndim", 1) != 1:
        raise InputError(f"{source}: column {name!r} has {column.ndim} dimensions; give one with a number per row")
    if is_text(table, name):
        return _parsed(_texts(table, name), float, name, source)
    values = np.ma.asarray(column.value if isinstance(column, u.Quantity) else column)
    return np.asarray(np.ma.filled(values.astype(np.float64, copy=False), np.nan))


def _parsed(texts: list[str], reader: Any, name: str, source: str, kind: str = "a number") -> FloatArray:
    values = np.full(len(texts), np.nan)
    for row, text in enumerate(texts):
        stripped = text.strip()
        if stripped.lower() not in _MISSING:
            try:
                values[row] = reader(stripped.replace("−", "-"))
            except ValueError:
                remedy = "write decimals with a point" if re.fullmatch(r"[-+−]?\d+,\d+", stripped) else ""
                if row == 0 and _is_unit(stripped):
                    remedy = f"a row of units is no data: delete it, and give units in names, such as '{name} [mas]'"
                message = f"{source}: column {name!r}, row {row}: {text!r} is not {kind}"
                raise InputError(message, remedy) from None
    return values


def _is_unit(text: str) -> bool:
    try:
        return bool(getattr(u.Unit(text, parse_strict="raise"), "bases", ()))
    except (ValueError, TypeError):
        return False


#: Numbers of nines only, of at most six digits, ascending, and how near to one a number is that is written as it.
_NINES = np.unique([float(f"{'9' * whole}.{'9' * part}0") for whole in range(1, 7) for part in range(7 - whole)])
_NEAR = 0.5 * 10.0 ** (np.floor(np.log10(_NINES)) - 5.0)


def is_masked(table: Table, name: str) -> BoolArray:
    """(n,) whether each cell of a column is masked."""
    column = table[name]
    return np.ma.getmaskarray(column) if hasattr(column, "mask") else np.zeros(len(table), np.bool_)


def is_placeholder(values: FloatArray) -> BoolArray:
    """(n,) whether the digits of numbers are nines only, as those that stand for missing values.

    >>> is_placeholder(np.array([-999.0, 99.99, 361.2, np.nan])).tolist()
    [True, True, False, False]
    """
    size = np.abs(values)
    above = np.clip(np.searchsorted(_NINES, size), 1, len(_NINES) - 1)
    either = [np.abs(size - _NINES[at]) < _NEAR[at] for at in (above - 1, above)]
    return np.asarray(either[0] | either[1])


def measured(table: Table, name: str, source: str) -> tuple[FloatArray, tuple[int, str] | None]:
    """(n,) numbers of the column, and the first row with another text (an upper limit, a remark) and the text, or None.

    Raises InputError: a text column with more other texts than numbers; a column of several dimensions.
    """
    if not is_text(table, name) or table[name].ndim != 1:
        return numbers(table, name, source), None
    texts = [text.strip().replace("−", "-") for text in _texts(table, name)]
    values = np.array([_number_or_none(text) for text in texts], dtype=np.float64)
    words = [row for row, text in enumerate(texts) if text.lower() not in _MISSING and np.isnan(values[row])]
    if not words or len(words) > np.count_nonzero(np.isfinite(values)):
        return numbers(table, name, source), None
    return values, (words[0], texts[words[0]])


def is_flux(table: Table, name: str) -> bool:
    """Whether the column is a flux or counts, by its unit; without one by its name."""
    unit = unit_of(table, name)
    if unit is None:
        return bool(_FLUX.search(name))
    return isinstance(unit, u.UnitBase) and any(unit.is_equivalent(flux) for flux in _FLUXES)


def magnitudes(table: Table, name: str, source: str) -> FloatArray:
    """(n,) magnitudes in mag of a column of any multiple of it, NaN for texts and placeholders (99, −99.99).

    Of fluxes −2.5 lg of the number, NaN if it is not above 0.
    """
    values, _ = measured(table, name, source)
    if is_flux(table, name):
        return np.asarray(-2.5 * np.log10(np.where(values > 0.0, values, np.nan)))
    unit = unit_of(table, name)
    if unit is not None and unit.is_equivalent(u.mag):
        values = values * unit.to(u.mag)
    with np.errstate(invalid="ignore"):
        missing = np.abs(values) >= 90.0
    return np.where(missing, np.nan, values) if missing.any() else values


#: A column without a unit that is a flux by its name, and the units of fluxes; a maggy has the zero point in its name.
_FLUX = re.compile(r"^(?!.*mag).*flux|^aperture_sum", re.IGNORECASE)
_FLUXES = (u.Jy, u.Unit("mgy"), u.ct, u.adu, u.electron, u.ct / u.s, u.adu / u.s, u.electron / u.s, u.photon)


def holds_numbers(table: Table, name: str) -> bool:
    """Whether the column contains numbers; in a text column, at least as many as other texts."""
    try:
        return bool(np.isfinite(measured(table, name, "")[0]).any())
    except InputError:
        return False


def _number_or_none(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


def sexagesimal(table: Table, name: str, source: str) -> FloatArray:
    """(n,) sexagesimal angles of the column, in hours or degrees as written."""
    return _parsed(_texts(table, name), _from_sexagesimal, name, source)


def _from_sexagesimal(text: str) -> float:
    sign = -1.0 if text.startswith("-") else 1.0
    parts = [float(part) for part in _SEPARATORS.split(text.lstrip("+-")) if part]
    if not parts or len(parts) > 3:
        raise ValueError(text)
    return sign * sum(part / 60.0**k for k, part in enumerate(parts))


def of_parts(table: Table, names: tuple[str, ...], source: str) -> FloatArray:
    """(n,) angles split into columns of hours or degrees, minutes and seconds.

    names : of the columns; a first one of text contains the signs.
    """
    sign = np.ones(len(table))
    if is_text(table, names[0]):
        sign = np.array([-1.0 if text.strip() in ("-", "−") else 1.0 for text in _texts(table, names[0])])
        names = names[1:]
    parts = [numbers(table, name, source) for name in names]
    # Missing minutes and seconds of less precise angles count as zero.
    whole = parts[0] + sum(np.nan_to_num(part) / 60.0**k for k, part in enumerate(parts[1:], 1))
    return np.asarray(sign * whole)


def years(table: Table, name: str, source: str) -> FloatArray:
    """(n,) Julian years of a column of Julian years, MJD, JD, ISO dates or astropy Times."""
    column = table[name]
    if hasattr(column, "jyear"):
        return np.asarray(np.ma.filled(np.ma.asarray(column.jyear, dtype=np.float64), np.nan))
    if is_text(table, name):
        return _parsed(_texts(table, name), year_of, name, source, "a year, an MJD, a JD or a date such as 2016-01-31")
    if column.dtype.kind == "M":
        return _years_of_dates(np.asarray(column, dtype="datetime64[us]"))
    values = numbers(table, name, source)
    values = np.where(values > 0.0, values, np.nan)  # zeros and negative numbers stand for no epoch
    known = values[np.isfinite(values)]
    middle = median(known) if len(known) else 2000.0
    zero = stated_zero_mjd(column)
    if zero is not None and 15000 < zero + middle < 100000:
        return np.asarray(mjd_to_jyr(zero + values))
    if 1700 < middle < 2300:
        return values
    if 15000 < middle < 100000:
        return np.asarray(mjd_to_jyr(values))
    if 2.3e6 < middle < 2.6e6:
        return np.asarray(mjd_to_jyr(values - _JD_OF_MJD))
    raise InputError(
        f"{source}: column {name!r} (about {middle:g}) is not an epoch{missing_zero(name, middle)}",
        naming("give a column of Julian years, MJD, JD or dates, or {epoch:YEAR}"),
    )


def holds_positive(table: Table, name: str) -> bool:
    """Whether any number of the column is positive, as an error or an epoch is; texts count as such."""
    if is_text(table, name) or not hasattr(table[name], "dtype") or table[name].dtype.kind not in "fiu":
        return True
    return any(
        bool(np.nanmax(numbers(table[rows], name, ""), initial=0.0) > 0.0) for rows in (slice(1000), slice(None))
    )


def are_years(table: Table, name: str) -> bool:
    """Whether the column can be read as Julian years, dates, MJD or JD."""
    try:
        return bool(np.isfinite(years(table, name, "")).any())
    except InputError:
        return False


def year_of(text: str) -> float:
    """The Julian year of a text: 2016.0, J2016.0, an MJD, a JD or an ISO date; else ValueError."""
    try:
        value = float(text.lstrip("Jj"))
    except ValueError:
        return float(_years_of_dates(np.array([_in_utc(text.strip())], dtype="datetime64[us]"))[0])
    if 2.3e6 < value < 2.6e6:
        return float(mjd_to_jyr(value - _JD_OF_MJD))
    return float(mjd_to_jyr(value)) if 15000 < value < 100000 else value


def _in_utc(text: str) -> datetime | str:
    """A date with a time zone converted to UTC; any other date as text, which NumPy reads as UTC."""
    if not re.search(r"\d[T ]\d\d:?\d\d.*[+-]\d\d(?::?\d\d)?$", text):
        return text.removesuffix("Z")
    return datetime.fromisoformat(text).astimezone(UTC).replace(tzinfo=None)


def mjd_to_jyr(mjd: Any) -> Any:
    """Julian years of modified Julian dates: 2000 + (MJD − 51544.5) / 365.25."""
    return 2000.0 + (mjd - 51544.5) / 365.25


def _years_of_dates(dates: NDArray[Any]) -> FloatArray:
    days = (dates - np.datetime64("2000-01-01T12:00:00")) / np.timedelta64(1, "D")
    return np.asarray(2000.0 + days / 365.25, dtype=np.float64)


#: Spellings of units of motions that astropy does not know, or takes for others (ha for hectare, cy for cycle).
_MOTION_ANGLES = {
    "sec": "s", "second": "s", "seconds": "s", "milliarcsec": "mas", "milliarcsecond": "mas", "milliarcseconds": "mas",
    "arcsecond": "arcsec", "arcseconds": "arcsec", "arcsecs": "arcsec",
}  # fmt: skip
_MOTION_YEARS = {
    "year": 1.0, "years": 1.0, "yr": 1.0, "y": 1.0, "a": 1.0, "annum": 1.0, "ha": 100.0, "cy": 100.0, "century": 100.0,
    "cycle": 100.0,
}  # fmt: skip
_MOTION = re.compile(
    r"(?P<angle>[a-z]+)\s*(?:(?:/|\bper\b)\s*(?P<of>[a-z]+)|[\s.*]\s*(?P<per>[a-z]+)\s*(?:\*\*|\^)?\s*\(?-1(?:\.0)?\)?)",
    re.IGNORECASE,
)


def motion_unit(text: str) -> str:
    """The unit of a motion as astropy writes it, or the text itself if it is not an angle or seconds over years.

    >>> motion_unit("s/ha"), motion_unit("milliarcsec per year"), motion_unit("'mas.yr-1'"), motion_unit("0.1 mas / yr")
    ('0.01 s / yr', 'mas / yr', 'mas / yr', '0.1 mas / yr')
    """
    parts = _MOTION.fullmatch(text.strip(" '\""))
    years = None if parts is None else _MOTION_YEARS.get((parts["of"] or parts["per"]).lower())
    if parts is None or years is None:
        return text
    angle = _MOTION_ANGLES.get(parts["angle"].lower(), parts["angle"])
    return f"{angle} / yr" if years == 1.0 else f"{1.0 / years:g} {angle} / yr"


def is_in_seconds_of_time(unit: str) -> bool:
    """Whether a motion in this unit is in seconds of time."""
    try:
        factor(unit, "s / yr")
    except (ValueError, TypeError):
        return False
    return True


def factor(unit: str, target: str) -> float:
    """The factor that converts a number in ``unit`` to ``target``."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", u.UnitsWarning)
        try:
            return float(u.Unit(unit).to(u.Unit(target)))
        except OverflowError as error:
            raise ValueError(f"the unit {unit!r} is beyond the range of numbers") from error


def stated_zero_mjd(column: Any) -> float | None:
    """The MJD from which the days of a table's column are counted, stated by its name, unit or description; None if
    none does."""
    for text in (column.name, getattr(column, "unit", None), column.info.description):
        written = str(text or "").lower()
        if written in _NAMED:
            return _NAMED[written] - _JD_OF_MJD
        match = _SUBTRACTED.search(written)
        if match:
            zero = float(match["zero"])
            return zero if match["mjd"] else zero - _JD_OF_MJD
    return None


def counted_days(table: Table) -> list[str]:
    """The columns named as days since a zero that they state. Others with a zero, such as that of a light curve's
    minimum, are times of something else."""
    return [name for name in table.colnames if _DAYS.match(name.lower()) and stated_zero_mjd(table[name]) is not None]


def missing_zero(name: str, middle: float) -> str:
    """The remedy for days of which most are near ``middle``, too few for a date; "" for other columns."""
    small = "jd" in name.lower() and 0.0 < middle < 15000.0
    return "; add what was subtracted from the JD, such as 2450000" if small else ""

"""The columns of two catalogues that are evidence: the magnitudes that are compared, and any others.

:func:`magnitudes_of` chooses the magnitudes of both, :func:`columns_of` the other columns, each with its values.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from astropy import units as u

from sameas.errors import InputError
from sameas.evidence import Column, Magnitudes, Related
from sameas.sky import column_values, conventions
from sameas.sky.catalogue import Catalogue

#: Choices of magnitudes: those chosen for each catalogue, or none.
AUTO, OFF = "auto", "off"
#: Names of the column of a magnitude's errors, given the name of the magnitude.
MAGNITUDE_ERROR_NAMES = ("e_{}", "{}_error", "{}_err", "{}err", "{}Err", "sigma_{}", "{}_msigcom", "{}_sigma")
#: The names of errors and of other spreads.
_ERROR = re.compile(r"^e_|err|sig|unc|rms|std|scatter", re.IGNORECASE)


def magnitudes_of(first: Catalogue, second: Catalogue, choice: str = AUTO) -> tuple[Magnitudes, Magnitudes] | None:
    """The magnitudes of both catalogues; None if they are not used or one catalogue has none.

    choice : "auto" uses the magnitude chosen for each catalogue; "off" none; "G,BP,RP:J,H" these columns of the first
        and of the second catalogue, the brightest known band of each first.

    Raises InputError: no such columns; another text.
    """
    if choice == OFF:
        return None
    if choice == AUTO:
        one, two = _chosen_magnitude(first), _chosen_magnitude(second)
        return None if one is None or two is None else (one, two)
    sides = choice.split(":")
    if len(sides) != 2 or not all(side.strip() for side in sides):
        raise InputError(f'magnitudes {choice!r}: give "auto", "off", or columns of both catalogues, BAND,…:BAND,…')
    named = [tuple(name.strip() for name in side.split(",")) for side in sides]
    return _columns(first, named[0]), _columns(second, named[1])


def columns_of(
    first: Catalogue, second: Catalogue, evidence: Sequence[Column | Related], magnitudes: str = AUTO
) -> tuple[Column | Related, ...]:
    """The columns used as evidence in addition to magnitudes, with their values.

    The magnitude of a catalogue is included if the other has none.

    evidence : as given, by column names. magnitudes : as in :func:`magnitudes_of`.

    Raises InputError: no such columns.
    """
    sides = first, second
    columns: list[Column | Related] = []
    for one in evidence:
        if isinstance(one, Related):
            a, b = (_column(sides[c.source - 1], c) for c in one.columns)
            columns.append(Related(a.values, b.values, (a.name, b.name)))
        else:
            columns.append(_column(sides[one.source - 1], one))
    if magnitudes == AUTO:
        for source, (own, other) in enumerate(((first, second), (second, first)), start=1):
            name = own.magnitude_name
            if name and other.magnitude is None:
                named = any(isinstance(c, Column) and (c.source, c.name) == (source, name) for c in columns)
                columns += [] if named else [Column(source, own.magnitude, name=name)]
    return tuple(columns)


def magnitude_columns(catalogue: Catalogue) -> tuple[str, ...]:
    """The columns that hold magnitudes by their names, or by their unit if they are no errors."""
    return tuple(
        name
        for name in catalogue.table.colnames
        if column_values.holds_numbers(catalogue.table, name)
        and (
            conventions.BAND_MAGNITUDE.fullmatch(name)
            or (column_values.unit_of(catalogue.table, name) == u.mag and not _ERROR.search(name))
        )
    )


def _column(catalogue: Catalogue, column: Column) -> Column:
    """The column with its values: looked up if it has a name, else unchanged."""
    if not isinstance(column.values, str):
        return column
    name = catalogue.column_named(column.values)
    if name is None:
        raise InputError(
            f"{catalogue.name}: no column {column.values!r} to be evidence; it has "
            f"{', '.join(catalogue.table.colnames)}",
            source=catalogue.name,
        )
    if column_values.is_text(catalogue.table, name):
        return replace(column, values=np.ma.asarray(catalogue.table[name]), name=name)
    if name == catalogue.magnitude_name:
        return replace(column, values=column_values.magnitudes(catalogue.table, name, catalogue.name), name=name)
    values = np.ma.asarray(catalogue.table[name])
    if values.dtype.kind == "f":
        # Other magnitudes have placeholders such as 99, too; other large numbers, as of a flux, are measured.
        large = np.flatnonzero(np.abs(np.ma.filled(values, np.nan)) >= 90.0)
        values = np.ma.array(values, copy=True)
        values[large[column_values.is_placeholder(np.ma.getdata(values)[large])]] = np.ma.masked
    return replace(column, values=values, name=name)


def _chosen_magnitude(catalogue: Catalogue) -> Magnitudes | None:
    if catalogue.magnitude is None:
        return None
    return Magnitudes(catalogue.magnitude, catalogue.magnitude_error, (str(catalogue.magnitude_name),))


def _columns(catalogue: Catalogue, names: tuple[str, ...]) -> Magnitudes:
    columns = {name: catalogue.column_named(name) for name in names}
    unknown = [name for name, column in columns.items() if column is None]
    if unknown:
        raise InputError(
            f"{catalogue.name}: no column {', '.join(map(repr, unknown))} of magnitudes; "
            f"it has {', '.join(catalogue.table.colnames)}"
        )
    names = tuple(column for column in columns.values() if column)
    values, errors = [], []
    for name in names:
        stems = ((name.removesuffix("_m") if "msigcom" in pattern else name) for pattern in MAGNITUDE_ERROR_NAMES)
        error_names = map(str.format, MAGNITUDE_ERROR_NAMES, stems)
        error = next((column for one in error_names if (column := catalogue.column_named(one))), None)
        values.append(column_values.magnitudes(catalogue.table, name, catalogue.name))
        unknown_error = np.full(len(catalogue), np.nan)
        known_error = None if error is None else column_values.magnitudes(catalogue.table, error, catalogue.name)
        errors.append(unknown_error if known_error is None else known_error)
    sigma = np.column_stack(errors)
    return Magnitudes(np.column_stack(values), np.where(sigma >= 0.0, sigma, np.nan), names)

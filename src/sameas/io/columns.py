"""Columns of a picture as a table of any format: Parquet, CSV, ECSV, FITS, VOTable."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from numpy.typing import NDArray

from sameas.io.tables import write_table

if TYPE_CHECKING:
    from astropy.table import Table

#: Units by the end of a column's name, the longest first.
UNITS = {"_m_per_s": "m/s", "_m2": "m2", "_deg": "deg", "_s": "s", "_m": "m"}


def write_columns(
    columns: Mapping[str, NDArray[Any]],
    path: str | os.PathLike[str],
    *,
    provenance: Mapping[str, Any],
    overwrite: bool = True,
) -> None:
    """Writes columns (n,) by name, such as ``Picture.objects``; the file is whole or absent.

    Masked cells become the format's nulls. provenance : see :func:`sameas.io.tables.write_table`.

    Raises
    ------
    InputError : the path cannot be written, or its extension is not known.
    """
    write_table(table_of(columns), path, provenance=provenance, overwrite=overwrite)


def table_of(columns: Mapping[str, NDArray[Any]]) -> Table:
    """The columns as an :class:`astropy.table.Table`, with units by their names.

    >>> import numpy as np
    >>> print(table_of({"x_m": np.array([1.5]), "object": np.array([7])})["x_m"].unit)
    m
    """
    from astropy.table import Table

    table = Table(dict(columns), copy=False)
    for name in table.colnames:
        unit = next((unit for end, unit in UNITS.items() if name.endswith(end)), None)
        if unit is not None:
            table[name].unit = unit
    return table

"""Astropy tables of anything that holds positions. Data frames are recognised without importing their libraries.

- a path: a file of :func:`sameas.io.read_table`;
- astropy ``Table`` and ``QTable``; a ``SkyCoord`` column becomes columns of right ascension, declination and motion,
  one of several, and one of a corner, columns ``NAME_ra`` and ``NAME_dec``;
- astropy ``SkyCoord`` in any frame, with proper motions, distance, radial velocity and ``obstime``;
- pandas, polars (lazy frames are collected), pyarrow, and any object with Arrow's stream interface;
- NumPy structured arrays, mappings of names to columns, and lists of mappings (rows).
"""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from sameas.errors import InputError
from sameas.evidence import OddsTable

if TYPE_CHECKING:
    from astropy.coordinates import SkyCoord
    from astropy.table import Table

#: Columns made from a ``SkyCoord``, in ICRS, by names that :mod:`sameas.sky.conventions` knows.
_PLACE = ("ra", "dec")
_MOTION = ("pm_ra_cosdec", "pm_dec")
_EPOCH = "epoch"
#: Names of corners of a source's box, as in catalogues of JWST.
_CORNER = re.compile("bbox|corner|vertex", re.IGNORECASE)


def table_of(data: Any, name: str, *, format: str | None = None, hdu: int | str | None = None) -> Table:
    """The astropy table of anything that holds positions. Data are shared, not copied, where possible.

    name : of the source, for messages. format, hdu : of a file.

    Raises InputError: not a table; a file that cannot be read.
    """
    if isinstance(data, str | os.PathLike):
        from sameas.io import read_table

        return _with_plain_places(read_table(data, format=format, hdu=hdu), name)
    table = _as_table(data, name)
    if table is None:
        raise InputError(
            f"{name}: {kind_of(data)} does not hold positions",
            "give a path, a Table, SkyCoord, data frame, Arrow table, structured array, dict of columns, "
            "Catalogue or Records",
        )
    return _with_plain_places(table, name)


def odds_of(source: Any) -> OddsTable:
    """A table of prior odds by the value of a column.

    source : a path, a table, a mapping of values to odds, or rows. Columns are (low, high, odds), (value, odds), or as
    in NWAY's files (low, high, selected, others), where the odds are the ratio of the last two.

    Raises InputError: other columns; odds that are not positive.
    """
    from astropy.table import Table

    if isinstance(source, OddsTable):
        return source
    if isinstance(source, str | os.PathLike):
        source = _odds_file(source)
    if not isinstance(source, Table):
        return OddsTable(source)
    last = source.colnames[-1]
    if len(source.colnames) in (2, 3) and last.lower().startswith(("prob", "p_")):
        raise InputError(f"table of odds: its last column is {last}", "give odds, p / (1 - p), and call them odds")
    rows = [tuple(row) for row in source.iterrows()]
    if len(source.colnames) == 4:
        rows = [(low, high, one / max(other, 1e-6)) for low, high, one, other in rows if one > 0.0]
    if len(source.colnames) not in (2, 3, 4):
        raise InputError(
            f"table of odds: it has {len(source.colnames)} columns, {', '.join(source.colnames)}",
            "give low, high, odds; or value, odds; or NWAY's low, high, selected, others",
        )
    return OddsTable([tuple(cell.item() if hasattr(cell, "item") else cell for cell in row) for row in rows])


def _odds_file(path: str | os.PathLike[str]) -> Table:
    """The table of a file, also of NWAY's text files, whose columns have no names."""
    from astropy.table import Table

    from sameas.io import read_table

    text = os.fspath(path)
    if text.endswith(".txt") or not os.path.splitext(text)[1]:
        try:
            values = np.loadtxt(path, ndmin=2)
        except (OSError, ValueError) as error:
            raise InputError(f"{text}: is not a table of odds ({error})") from None
        return Table(values)
    return read_table(path)


def kind_of(data: object) -> str:
    """The type of an object with its library: ``pandas DataFrame``."""
    kind = type(data)
    home = kind.__module__.partition(".")[0]
    return kind.__name__ if home in ("builtins", "sameas") else f"{home} {kind.__name__}"


def _as_table(data: Any, name: str) -> Table | None:
    from astropy.coordinates import SkyCoord
    from astropy.table import QTable, Table

    library = type(data).__module__.partition(".")[0]
    if isinstance(data, Table):
        return Table(data, copy=False) if isinstance(data, QTable) else data
    if isinstance(data, SkyCoord):
        return Table(_columns_of(data), copy=False)
    if library == "pandas" and hasattr(data, "iloc") and hasattr(data, "columns"):
        return _of_pandas(data, name)
    if library == "polars" and hasattr(data, "collect"):
        data = data.collect()
    if hasattr(data, "__arrow_c_stream__"):
        return _of_arrow(data, name)
    if isinstance(data, np.ndarray) and data.dtype.names:
        return Table(data, copy=False)
    if isinstance(data, Mapping):
        return _of_columns(data, name)
    if isinstance(data, list) and data and all(isinstance(row, Mapping) for row in data):
        return Table(rows=data)
    return None


def _of_columns(data: Mapping[Any, Any], name: str) -> Table:
    """The table of a mapping of names to columns."""
    from astropy.table import Table

    lengths = {key: _length(cells) for key, cells in data.items()}
    single = next((key for key, length in lengths.items() if length is None), None)
    if single is not None:
        raise InputError(f"{name}: {single} is a single value, not a column", "give one value for each row")
    if len(set(lengths.values())) > 1:
        listed = ", ".join(f"{key} {length}" for key, length in lengths.items())
        raise InputError(f"{name}: the columns have different lengths ({listed})", "give one value for each row")
    return Table(dict(data), copy=False)


def _length(cells: Any) -> int | None:
    """Number of cells of a column; None for a single value, also in an array without axes."""
    if isinstance(cells, str | bytes):
        return None
    try:
        return len(cells)
    except TypeError:
        return None


def _of_pandas(frame: Any, name: str) -> Table:
    """The table of a data frame, with its index unless that only counts rows."""
    from astropy.table import Table

    index_counts = type(frame.index).__name__ == "RangeIndex" and frame.index.name is None
    names = ["_".join(map(str, one)) if isinstance(one, tuple) else str(one) for one in frame.columns]
    _refuse_duplicates(names, name)
    if names != list(frame.columns):
        frame = frame.set_axis(names, axis=1)
    return Table.from_pandas(frame, index=not index_counts)


def _refuse_duplicates(names: list[str], source: str) -> None:
    twice = next((name for name, times in Counter(names).items() if times > 1), None)
    if twice is not None:
        raise InputError(f"{source}: two columns are called {twice}; rename one")


def _of_arrow(data: Any, name: str) -> Table | None:
    import pyarrow as pa
    from astropy.table import Table

    from sameas.io.arrow import column_of

    try:
        arrow = data if isinstance(data, pa.Table) else pa.table(data)
    except pa.ArrowInvalid:  # one column only: a Series, an array
        return None
    _refuse_duplicates(arrow.column_names, name)
    columns = (column_of(one, arrow.column(one)) for one in arrow.column_names)
    return Table([column for column in columns if column is not None], copy=False)


def _with_plain_places(table: Table, name: str) -> Table:
    """The table with plain columns instead of a ``SkyCoord`` column, which joins and files cannot hold."""
    from astropy.table import Table

    places = [column for column, cells in table.columns.items() if type(cells).__name__ == "SkyCoord"]
    if not places:
        return table
    centres = [column for column in places if not _CORNER.search(column)]
    main = centres[0] if len(centres) == 1 else None
    columns: dict[str, Any] = {}
    others = {column.lower() for column in table.colnames if column not in places}
    for column, cells in table.columns.items():
        if column not in places:
            columns[column] = cells
            continue
        plain = _columns_of(cells)
        if column != main:
            columns |= {f"{column}_{part}": plain[part] for part in _PLACE}
            continue
        if others & {part.lower() for part in plain}:
            raise InputError(
                f"{name}: it has a SkyCoord {column!r} and columns {', '.join(sorted(others & set(plain)))}",
                "which of them are the positions? give a table with one of both",
            )
        columns |= plain
    return Table(columns, copy=False, meta=table.meta)


def _columns_of(place: SkyCoord) -> dict[str, Any]:
    """Right ascension and declination in ICRS; proper motion, radial velocity, parallax and epoch where known."""
    from astropy import units as u
    from astropy.coordinates import SphericalRepresentation

    icrs = place.reshape(1).icrs if place.isscalar else place.icrs
    columns: dict[str, Any] = {_PLACE[0]: icrs.ra.to(u.deg), _PLACE[1]: icrs.dec.to(u.deg)}
    if "s" in icrs.data.differentials:
        velocity = icrs.data.differentials["s"]
        if hasattr(velocity, "d_lon") or hasattr(velocity, "d_lon_coslat") or _has_distance(icrs):
            columns[_MOTION[0]] = icrs.pm_ra_cosdec.to(u.mas / u.yr)
            columns[_MOTION[1]] = icrs.pm_dec.to(u.mas / u.yr)
        speed = icrs.radial_velocity if _has_distance(icrs) or hasattr(velocity, "d_distance") else None
        if speed is not None and speed.unit.is_equivalent(u.km / u.s):
            columns["radial_velocity"] = speed.to(u.km / u.s)
    if _has_distance(icrs) and isinstance(icrs.represent_as("spherical"), SphericalRepresentation):
        columns["parallax"] = icrs.distance.to(u.mas, u.parallax())
    if place.obstime is not None:
        years = np.broadcast_to(np.asarray(place.obstime.jyear, np.float64), icrs.shape)
        columns[_EPOCH] = years * u.yr
    return {name: u.Quantity(cells).reshape(-1) for name, cells in columns.items()}


def _has_distance(place: SkyCoord) -> bool:
    from astropy import units as u

    return bool(place.distance.unit.is_equivalent(u.pc))

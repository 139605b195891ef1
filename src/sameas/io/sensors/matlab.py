"""MAT files of MATLAB and Octave: structs of columns, arrays of structs, or vectors of one length.

    radar.time = posixtime(t); radar.range_m = r; radar.bearing_deg = b; save('plots.mat', 'radar', '-v7')

Each struct is a table, read as a CSV with these names. Tables and timetables are objects that only MATLAB reads; so are
``objectDetection`` and ``objectTrack``. Version 7.3 is HDF5, which is not read.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from sameas.errors import InputError
from sameas.io.sensors.format import SensorFile, SensorFormat
from sameas.io.sensors.table_cells import TableText
from sameas.io.sensors.tables import read as read_cells
from sameas.tracks.reports import Reports

_VERSION_5, _VERSION_7_3 = b"MATLAB 5.0 MAT-file", b"MATLAB 7.3 MAT-file"
#: Names of matrices with a column for each axis.
_PLACES = ("position", "pos", "xy", "xyz", "enu")
_AXES = "xyz"


def read(file: SensorFile) -> list[Reports]:
    """The reports of a file, one :class:`Reports` for each table; several are named ``source:variable``.

    Raises InputError: version 7.3; a damaged file; objects, or no table at all; a table without times or positions.
    """
    from scipy.io import loadmat
    from scipy.io.matlab import MatlabOpaque

    if file.content.startswith(_VERSION_7_3):
        raise InputError(f"{file.source}: is a MAT file of version 7.3", f"save it with '-v7'; {_INSTEAD}")
    try:
        variables = loadmat(io.BytesIO(file.content), simplify_cells=True, chars_as_strings=True)
    except Exception as error:  # scipy raises errors of many kinds for damaged files
        raise InputError(f"{file.source}: cannot be read as a MAT file ({error})", "save it again") from error
    objects = any(isinstance(value, MatlabOpaque) for value in variables.values())
    found = {name: value for name, value in variables.items() if not isinstance(value, MatlabOpaque)}
    tables = dict(_tables("", {name: value for name, value in found.items() if not name.startswith("__")}))
    if not tables:
        what = "objects, such as tables" if objects else "neither structs of columns nor vectors of one length"
        raise InputError(f"{file.source}: has {what}", _INSTEAD)
    return [
        read_cells(
            TableText(columns, np.arange(1, len(next(iter(columns.values()))) + 1), unit="record"),
            file.source if len(tables) == 1 else f"{file.source}:{name}",
            file.options,
        )
        for name, columns in tables.items()
    ]


_INSTEAD = "write tables with parquetwrite('NAME.parquet', T) and timetables after timetable2table"


def _tables(name: str, value: Any) -> Iterator[tuple[str, dict[str, list[Any]]]]:
    """The tables in a variable by name, and in the structs within it."""
    if isinstance(value, list) and value and all(isinstance(one, Mapping) for one in value):
        yield name, _of_structs(value)
        return
    if not isinstance(value, Mapping):
        return
    columns = dict(part for field, cells in value.items() for part in _columns(field, cells))
    n = max((len(cells) for cells in columns.values()), default=0)
    whole = {field: cells for field, cells in columns.items() if len(cells) == n}
    if n > 1 and len(whole) > 1:
        yield name, whole
    for field, part in value.items():
        yield from _tables(f"{name}.{field}" if name else field, part)


def _columns(name: str, cells: Any) -> Iterator[tuple[str, list[Any]]]:
    """The columns of a field: one of a vector or of texts, one for each axis of a matrix of positions."""
    if isinstance(cells, list):
        if all(isinstance(one, (str, int, float, np.number)) for one in cells):
            yield name, [_cell(one) for one in cells]
        return
    if not isinstance(cells, np.ndarray) or cells.dtype.kind not in "iufbOUS":
        return
    if cells.ndim == 1:
        yield name, [_cell(one) for one in cells.tolist()]
    elif cells.ndim == 2 and 2 <= min(cells.shape) <= 3 and cells.dtype.kind in "iuf":
        # As many rows as reports, or as many columns.
        for axis, column in zip(_AXES, cells.T if cells.shape[1] <= 3 else cells, strict=False):
            yield axis if name.lower() in _PLACES else f"{name}_{axis}", [_cell(one) for one in column.tolist()]


def _of_structs(structs: Sequence[Mapping[str, Any]]) -> dict[str, list[Any]]:
    """The columns of an array of structs, each a report."""
    rows = [dict(part for name, value in one.items() for part in _fields(name, value)) for one in structs]
    return {name: [row.get(name) for row in rows] for name in dict.fromkeys(name for row in rows for name in row)}


def _fields(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    if isinstance(value, np.ndarray) and value.ndim == 1 and 2 <= len(value) <= 3 and name.lower() in _PLACES:
        yield from ((axis, _cell(one)) for axis, one in zip(_AXES, value.tolist(), strict=False))
    elif isinstance(value, (str, int, float, np.number)):
        yield name, _cell(value)


def _cell(value: Any) -> Any:
    """A text, a number or None."""
    if isinstance(value, (bool, int, float, np.number)):
        return None if np.isnan(value) else float(value)
    return str(value) if isinstance(value, str) and value else None


FORMAT = SensorFormat(
    "mat", "MAT files of MATLAB (structs of columns)", read, lambda file: False, magic=(_VERSION_5, _VERSION_7_3)
)

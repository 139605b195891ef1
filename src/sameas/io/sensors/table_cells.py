"""The cells of tables of reports: texts and numbers by column, from CSV, Parquet or JSON."""

from __future__ import annotations

import codecs
import csv
import os
import re
from array import array
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import chain
from types import NoneType
from typing import TYPE_CHECKING, Any, TypeVar, overload

import numpy as np

from sameas.arrays import AnyIntArray, IntArray
from sameas.bounds import check_columns
from sameas.errors import InputError
from sameas.io.sensors.format import SensorFile, json_lines, lines_in, of_json
from sameas.io.sensors.languages import PLACES
from sameas.io.sensors.remote_id import with_messages
from sameas.io.sensors.table_columns import QUANTITIES, rank_of, stem_of

if TYPE_CHECKING:
    import pyarrow as pa

#: Texts of cells without a value.
NULLS = {"", "null", "none", "na", "n/a", "-", "--", "nan", "unknown", "undefined"}
_DELIMITERS = ",;\t|"
_T = TypeVar("_T")
#: Numbers with a decimal comma or none, and with a decimal point.
_COMMA, _POINT = re.compile(r"\s*[+-]?\d+(,\d+)?\s*"), re.compile(r"\s*[+-]?\d+\.\d+\s*")
#: Number of cells always read from a Parquet file, however small: it compresses equal cells (1 GB as Python lists).
_CELLS = 1 << 24
#: Rows of a CSV file whose cells are Python objects at once: all of a day of AIS would take 2 kB a row.
ROWS_OF_PART = 50_000


def of_each(read: Callable[[Any], _T], cells: Sequence[Any]) -> list[_T]:
    """What ``read`` makes of each cell; of equal texts once, since the columns of a log have few.

    >>> of_each(len, ["2024-05-01", "", "2024-05-01"])
    [10, 0, 10]
    """
    if not isinstance(cells, PackedTexts) and not set(map(type, cells)) <= {str, NoneType}:
        return [read(cell) for cell in cells]
    of_text = {text: read(text) for text in dict.fromkeys(distinct_texts(cells))}
    return [of_text[text] for text in cells]


class PackedTexts(Sequence[str]):
    """A column of texts in parts, of which each stores equal texts once.

    parts : dictionary arrays of Arrow, which take a tenth of the memory of texts of Python.
    """

    def __init__(self, parts: Iterable[pa.DictionaryArray]) -> None:
        self.parts = tuple(parts)
        self._start = np.cumsum([0, *map(len, self.parts)])

    @staticmethod
    def part(cells: Sequence[str]) -> pa.DictionaryArray:
        """A part of these cells."""
        import pyarrow as pa

        return pa.array(cells, pa.string()).dictionary_encode()

    def __len__(self) -> int:
        return int(self._start[-1])

    @overload
    def __getitem__(self, row: int) -> str: ...
    @overload
    def __getitem__(self, row: slice) -> Sequence[str]: ...
    def __getitem__(self, row: int | slice) -> str | Sequence[str]:
        if isinstance(row, slice):
            return [self[k] for k in range(len(self))[row]]
        row = range(len(self))[row]
        k = int(np.searchsorted(self._start, row, side="right")) - 1
        return str(self.parts[k][row - int(self._start[k])].as_py())

    def __iter__(self) -> Iterator[str]:
        for texts, number in parts_of(self):
            yield from map(texts.__getitem__, number.tolist())

    def changed(self, change: Callable[[str], str]) -> PackedTexts:
        """The column with other texts."""
        import pyarrow as pa

        return PackedTexts(
            pa.DictionaryArray.from_arrays(number, pa.array(map(change, texts), pa.string()))
            for texts, number in parts_of(self)
        )


def parts_of(cells: Sequence[Any]) -> Iterator[tuple[Sequence[Any], AnyIntArray]]:
    """The parts of a column: distinct cells (k,), and which of them (n,) stands in each row of the part."""
    if isinstance(cells, PackedTexts):
        for part in cells.parts:
            yield part.dictionary.to_pylist(), part.indices.to_numpy()
    else:
        yield cells, np.arange(len(cells))


def distinct_texts(cells: Sequence[Any]) -> Iterator[Any]:
    """The cells of a column, of which equal texts may be missing."""
    return chain.from_iterable(texts for texts, _ in parts_of(cells))


@dataclass(frozen=True)
class _LazyColumns(Mapping[str, Sequence[Any]]):
    """Columns that are converted on access, since few columns of a table are used."""

    names: Sequence[str]
    column: Callable[[str], Sequence[Any]]

    def __getitem__(self, name: str) -> Sequence[Any]:
        if name not in self.names:
            raise KeyError(name)
        return self.column(name)

    def __iter__(self) -> Iterator[str]:
        return iter(self.names)

    def __len__(self) -> int:
        return len(self.names)


@dataclass(frozen=True)
class TableText:
    """The cells of a table (text, numbers or None) by column, and the line number of each row.

    unended : whether the last line has no line end. unit : what is counted, of a JSON document or Parquet its records.
    """

    columns: Mapping[str, Sequence[Any]]
    lines: IntArray
    damaged: tuple[tuple[int, str], ...] = ()
    unended: bool = False
    unit: str = "line"


def cells_of_csv(lines: Iterable[str], source: str, rows_of_part: int = ROWS_OF_PART) -> TableText:
    """The cells of lines separated by commas, semicolons, tabs or bars (ECSV: also blanks). Lines that begin with # are
    comments. rows_of_part : of a longer table, columns are packed in parts of so many rows."""
    above: list[str] = []
    lines = iter(lines)
    # A comment with the delimiter of the rows may be the line of names, as in Danish AIS.
    for line in lines:
        above.append(line)
        if line.strip() and not _SEPARATOR.fullmatch(line.strip()) and line[0] != "#":
            number = len(above)
            break
    else:
        number = 1
    ecsv = bool(above) and above[0].startswith(ECSV)
    if not ecsv and (named := _commented_names(above)):
        number = named
    header = above[number - 1].lstrip("# ")
    delimiter = _delimiter_of(header) or (" " if ecsv else "")
    if header.startswith("<"):
        raise InputError(f"{source}: is XML of no format that is read", "give its positions as CSV or GeoJSON")
    if not delimiter:
        raise InputError(f"{source}: no format of sensors fits; as a table, its line {number} does not name columns")
    names = _of_ros([name.strip() for name in next(csv.reader([header], delimiter=delimiter))])
    check_columns(len(names), source)
    if 2 * sum(_NUMBER.fullmatch(name) is not None for name in names) > len(names):
        raise InputError(
            f"{source}: its line {number} has values, not the names of columns",
            "give the table a first line with names, such as time,lat,lon",
        )
    counts = Counter(names)
    duplicates = [name for name in names if counts[name] > 1]
    if duplicates:
        raise InputError(f"{source}: two columns are called {duplicates[0]}; rename one")
    columns, line_numbers, damaged = _rows(chain(above[number:], lines), number, names, delimiter, rows_of_part)
    if delimiter != ",":
        columns = _with_points(columns)
    return TableText(columns, line_numbers, tuple(damaged))


def _commented_names(above: Sequence[str]) -> int:
    """The number of the comment that names the columns of the first row, the last line: as many as its cells, or any
    if these are values; 0 if there is none."""
    *comments, row = above or [""]
    delimiter = _delimiter_of(row)
    if not delimiter:
        return 0
    cells = [cell.strip() for cell in row.split(delimiter)]
    is_values = any(_NUMBER.fullmatch(cell) for cell in cells)
    counts = [line.count(delimiter) + 1 for line in comments]
    return max((k for k, n in enumerate(counts, 1) if n == len(cells) or (is_values and n > 1)), default=0)


#: A number, which is no name of a column.
_NUMBER = re.compile(r"[+-]?\d+([.,]\d*)?([eE][+-]?\d+)?")
#: What Excel wants in the first line of a file.
_SEPARATOR = re.compile(r"sep=.", re.IGNORECASE)
#: Fields of messages of ROS, by the ends of their names, and the names of tables for them. Velocities of odometry are
#: those of the body, not of the plane.
_ROS = {
    "%time": "time", "__time": "time", "position.x": "x", "position.y": "y", "position.z": "z", "latitude": "latitude",
    "longitude": "longitude", "altitude": "altitude", "position_covariance0": "cov_xx",
    "position_covariance1": "cov_xy", "position_covariance4": "cov_yy", "id": "id",
}  # fmt: skip
#: Names of what a radar or a receiver measures, as the end of a field of a message of ROS.
_ROS_PLOTS = tuple(
    name
    for quantity in QUANTITIES
    if quantity.column in ("range_m", "bearing_deg", "relative_bearing_deg", "mmsi", "station_heading_deg")
    for name in quantity.names
    if len(name) > 1
)


def _of_ros(names: Sequence[str]) -> list[str]:
    """The names of the columns of a topic of ROS, as ``rostopic echo -p`` and PlotJuggler write them, as those of
    tables; other names as they are."""
    if not names or names[0] not in ("%time", "__time"):
        return list(names)
    out = list(names)
    for k, name in enumerate(names):
        words = re.split(r"[./]", name)
        known = next((_ROS[".".join(words[-n:])] for n in (2, 1) if ".".join(words[-n:]) in _ROS), None)
        known = words[-1] if known is None and stem_of(words[-1])[0] in _ROS_PLOTS else known
        if known is not None and known not in out:
            out[k] = known
    return out


def _rows(
    lines: Iterable[str], above: int, names: Sequence[str], delimiter: str, rows_of_part: int
) -> tuple[dict[str, Sequence[str]], IntArray, list[tuple[int, str]]]:
    """The columns of lines below ``above`` others, the line of each row, and the numbers of damaged lines with the
    reasons."""
    damaged: list[tuple[int, str]] = []
    rows: list[list[str]] = []
    line_numbers = array("q")
    packed: list[list[pa.DictionaryArray]] = [[] for _ in names]
    reader = csv.reader(lines, delimiter=delimiter)
    for row in reader:
        line = above + reader.line_num
        if not row or row[0].startswith("#"):
            continue
        if len(row) != len(names):
            damaged.append((line, f"has not {len(names)} cells"))
            continue
        rows.append(row)
        line_numbers.append(line)
        if len(rows) == rows_of_part:
            _pack(rows, packed)
    if not packed[0]:
        # Few rows are not worth packing.
        cells = zip(*rows, strict=True) if rows else [()] * len(names)
        return dict(zip(names, cells, strict=True)), np.array(line_numbers, np.int64), damaged
    if rows:
        _pack(rows, packed)
    columns = dict(zip(names, map(PackedTexts, packed), strict=True))
    return dict(columns), np.array(line_numbers, np.int64), damaged


def _pack(rows: list[list[str]], packed: Sequence[list[pa.DictionaryArray]]) -> None:
    """Moves the cells of rows to the columns."""
    for column, cells in zip(packed, zip(*rows, strict=True), strict=True):
        column.append(PackedTexts.part(cells))
    rows.clear()


def _with_points(columns: Mapping[str, Sequence[Any]]) -> dict[str, Sequence[Any]]:
    """The columns with decimal points for decimal commas, unless any number of the table has a point: then a comma may
    separate thousands. Changes columns of numbers only."""
    if not any("," in cell for cells in columns.values() for cell in distinct_texts(cells)):
        return dict(columns)
    if any(_POINT.fullmatch(cell) for cells in columns.values() for cell in distinct_texts(cells)):
        return dict(columns)
    numbers = {
        name
        for name, cells in columns.items()
        if all(_COMMA.fullmatch(cell) or cell.strip().lower() in NULLS for cell in distinct_texts(cells))
    }
    return {name: _with_point(cells) if name in numbers else cells for name, cells in columns.items()}


def _with_point(cells: Sequence[str]) -> Sequence[str]:
    if isinstance(cells, PackedTexts):
        return cells.changed(lambda cell: cell.replace(",", "."))
    return tuple(cell.replace(",", ".") for cell in cells)


def cells_of_json(lines: Sequence[str], source: str) -> TableText:
    """The cells of JSON objects, one per line or in one list; nested objects are flattened."""
    rows: list[dict[str, Any]] = []
    line_numbers: list[int] = []
    damaged: list[tuple[int, str]] = []
    unit = "record"
    try:
        document = of_json("\n".join(lines))
        objects = list(enumerate(_records(document), start=1))
    except ValueError:
        objects, unit = json_lines(lines, damaged), "line"
    answers = [_states(value) for _, value in objects]
    if any(answers):
        unit = "state"
        objects = list(enumerate((state for states in answers for state in states or ()), start=1))
    for number, value in _of_scans(objects):
        if isinstance(value, dict):
            rows.append(_of_aisstream(value) or _of_virtual_radar(value) or _flattened(value))
            line_numbers.append(number)
        else:
            damaged.append((number, "no JSON object"))
    with_positions = with_messages(rows)
    line_numbers = [line for line, row in zip(line_numbers, with_positions, strict=True) if row is not None]
    # Lists and objects are no cells.
    rows = [
        {name: None if isinstance(cell, dict | list) else cell for name, cell in row.items()}
        for row in with_positions if row is not None
    ]  # fmt: skip
    names = list(dict.fromkeys(name for row in rows for name in row))
    if not names:
        raise InputError(f"{source}: no JSON object with columns")
    check_columns(len(names), source)

    def column(name: str) -> list[Any]:
        return [row.get(name) for row in rows]

    return TableText(_LazyColumns(names, column), np.array(line_numbers, np.int64), tuple(damaged), unit=unit)


def _records(document: Any) -> list[Any]:
    """The records of a JSON document: itself, the items of its list, or those of the only list of objects in it, as of
    servers that put their answer beside a state. A report may have a list of objects too, such as its tracks. Or those
    of columns, as pandas writes them."""
    if isinstance(document, dict) and (columns := _columns(document)):
        names, cells = columns.keys(), columns.values()
        return [dict(zip(names, row, strict=True)) for row in zip(*cells, strict=True)]
    if not isinstance(document, list | dict) or (isinstance(document, dict) and _has_position(document)):
        return [document]
    inner = [value for value in (document if isinstance(document, list) else document.values()) if _is_records(value)]
    if len(inner) == 1:
        return list(inner[0])
    return document if isinstance(document, list) else [document]


def _of_scans(objects: Sequence[tuple[int, Any]]) -> Iterator[tuple[int, Any]]:
    """The objects, or, of scans, which have no position and one list of objects, such as plots, each of these with what
    its scan states of all. An empty scan has none."""
    dicts = [value for _, value in objects if isinstance(value, dict)]
    first = next((value for value in dicts if any(map(_is_records, value.values()))), {})
    lists = [name for name, value in first.items() if _is_records(value)]
    if len(lists) != 1 or _has_position({name: cell for name, cell in first.items() if name != lists[0]}):
        yield from objects
        return
    [plots] = lists
    for number, value in objects:
        inner = value.get(plots) if isinstance(value, dict) else None
        if not isinstance(inner, list) or not all(isinstance(item, dict) for item in inner):
            yield number, value
            continue
        scan = _flattened({name: cell for name, cell in value.items() if name != plots})
        yield from ((number, scan | _flattened(item)) for item in inner)


def _columns(document: Mapping[str, Any]) -> dict[str, list[Any]]:
    """The columns of a JSON document of pandas (``orient`` "columns", "index" or "split"); none of another one."""
    rows, names = document.get("data"), document.get("columns")
    if set(document) <= {"columns", "index", "data"} and isinstance(rows, list) and isinstance(names, list):
        if any(not isinstance(row, list) or len(row) != len(names) for row in rows):
            return {}
        return {str(name): [row[k] for row in rows] for k, name in enumerate(names)}
    first = next(iter(document.values()), None)
    if len(document) < 2 or not isinstance(first, dict) or not first:
        return {}
    if any(not isinstance(cells, dict) or cells.keys() != first.keys() for cells in document.values()):
        return {}
    if any(isinstance(cell, dict | list) for cells in document.values() for cell in cells.values()):
        return {}
    if all(name.isdigit() for name in document):
        return {name: [row[name] for row in document.values()] for name in first}
    return {name: list(cells.values()) for name, cells in document.items()}


#: The names of a state of OpenSky (its REST interface, "All State Vectors"), as those of its tables where they differ.
_STATE = (
    "icao24", "callsign", "origin_country", "lastposupdate", "lastcontact", "lon", "lat", "baroaltitude", "onground",
    "velocity", "heading", "vertrate", "sensors", "geoaltitude", "squawk", "spi", "position_source", "category",
)  # fmt: skip


def _states(answer: Any) -> list[dict[str, Any]] | None:
    """The states in an answer of OpenSky; None for another object."""
    if not isinstance(answer, dict) or not {"time", "states"} <= set(answer):
        return None
    states = answer["states"] if isinstance(answer["states"], list) else []
    states = [state for state in states if isinstance(state, list)]
    return [{"time": answer["time"]} | dict(zip(_STATE, state, strict=False)) for state in states]


def _of_aisstream(value: Mapping[str, Any]) -> dict[str, Any] | None:
    """The cells of a message of aisstream.io, whose content is under its type; None for another object.

    Every message comes with a position, which is an old one if its content has none: that is not used.
    """
    about, content = value.get("MetaData"), value.get("Message")
    if not isinstance(about, dict) or not isinstance(content, dict) or "MessageType" not in value:
        return None
    inner = content.get(str(value["MessageType"]))
    inner = inner if isinstance(inner, dict) else {}
    of_message = ("Latitude", "Longitude", "Sog", "Cog", "TrueHeading")
    return {
        "time_utc": about.get("time_utc"), "MMSI": about.get("MMSI"), "ShipName": about.get("ShipName"),
        **{name: inner.get(name) for name in of_message},
    }  # fmt: skip


#: The names in a list of aircraft of Virtual Radar Server, and those of tables for them.
_VIRTUAL_RADAR = {
    "PosTime": "time", "Icao": "icao", "Lat": "lat", "Long": "lon", "Alt": "pressure_altitude_ft", "Spd": "groundspeed",
    "Trak": "track", "Vsi": "vertical_rate_fpm", "Call": "callsign", "Sqk": "squawk", "Type": "type",
}  # fmt: skip


def _of_virtual_radar(value: Mapping[str, Any]) -> dict[str, Any] | None:
    """The cells of an aircraft of Virtual Radar Server, and of the archives of ADS-B Exchange; None for another."""
    if not {"Icao", "PosTime"} <= set(value):
        return None
    return {name: value.get(key) for key, name in _VIRTUAL_RADAR.items()}


def _has_position(value: Mapping[str, Any]) -> bool:
    stems = {name: stem_of(name) for name in _flattened(value)}
    places = [quantity for quantity in QUANTITIES if quantity.column in PLACES]
    return any(rank_of(name, quantity, stems) is not None for name in stems for quantity in places)


def _is_records(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and all(isinstance(item, dict) for item in value)


def cells_of_parquet(path: str | os.PathLike[str]) -> TableText:
    """The cells of a Parquet file."""
    import pyarrow as pa
    from pyarrow import parquet

    # Not parquet.read_table: it takes the folders of a path for columns, as data sets in parts have them.
    with parquet.ParquetFile(path) as file:
        check_columns(len(file.schema_arrow), path)
        cells, limit = file.metadata.num_rows * len(file.schema_arrow), max(_CELLS, 8 * os.path.getsize(path))
        if cells > limit:
            raise InputError(f"{path}: says {cells} cells; up to {limit} are read from a file of this size",
                             "write the columns that are needed, or fewer rows")  # fmt: skip
        table = file.read()
    if len(set(table.column_names)) < len(table.column_names):
        raise InputError(f"{path}: two columns have one name; rename one")
    names = [field.name for field in table.schema if not pa.types.is_nested(field.type)]
    if not names:
        raise InputError(f"{path}: no column of numbers or text")

    def column(name: str) -> list[Any]:
        cells = table.column(name)
        if not pa.types.is_timestamp(cells.type):
            return list(cells.to_pylist())
        microseconds = cells.cast(pa.timestamp("us"), safe=False).cast(pa.int64())
        return [None if t is None else t / 1e6 for t in microseconds.to_pylist()]

    points = _points(table) if "geometry" in names else None
    if points is not None:
        columns = {name: column(name) for name in names if name != "geometry"}
        return TableText({**points, **columns}, np.arange(1, table.num_rows + 1), unit="record")
    return TableText(_LazyColumns(names, column), np.arange(1, table.num_rows + 1), unit="record")


def _points(table: pa.Table) -> dict[str, list[float]] | None:
    """The longitudes and latitudes of the points of GeoParquet (WKB of 21 bytes); None of another geometry, or where
    the table has them as columns."""
    stems = {stem_of(name)[0] for name in table.column_names}
    cells = table.column("geometry").to_pylist()
    if {"lat", "latitude"} & stems or not all(isinstance(cell, bytes) and len(cell) == 21 for cell in cells):
        return None
    little = np.frombuffer(b"".join(cells), np.dtype([("order", "u1"), ("kind", "<u4"), ("place", "<f8", 2)]))
    if not ((little["order"] == 1) & (little["kind"] == 1)).all():
        return None
    return {"longitude": little["place"][:, 0].tolist(), "latitude": little["place"][:, 1].tolist()}


def _delimiter_of(line: str) -> str:
    """The delimiter in a line; "" where there is none."""
    return next((sign for sign in _DELIMITERS if sign in line), "")


def _flattened(nested: Mapping[str, Any]) -> dict[str, Any]:
    """The cells of an object and of those in it; of a feature of GeoJSON, with the place of its point."""
    row: dict[str, Any] = {}
    for name, value in nested.items():
        for inner, cell in value.items() if isinstance(value, dict) else [(name, value)]:
            row[inner if inner not in row else f"{name}_{inner}"] = cell
    geometry = nested.get("geometry")
    if nested.get("type") == "Feature" and isinstance(geometry, dict) and geometry.get("type") == "Point":
        place, names = geometry.get("coordinates"), ("longitude", "latitude", "altitude_m")
        if isinstance(place, list) and len(place) >= 2:
            row = {
                **dict(zip(names, place, strict=False)),
                **_flattened({"properties": nested.get("properties") or {}}),
            }
    return row


PARQUET, ECSV = b"PAR1", "# %ECSV"
#: Bytes that are decoded at once.
_BLOCK = 1 << 24


def _of_windows(file: SensorFile) -> SensorFile:
    """The file in UTF-8, where its text has other letters and is that of Windows (code page 1252), as Excel writes."""
    try:
        decoder = codecs.getincrementaldecoder("utf-8")()
        for start in range(0, len(file.content), _BLOCK):
            decoder.decode(file.content[start : start + _BLOCK])
        decoder.decode(b"", final=True)
    except UnicodeDecodeError:
        with suppress(UnicodeDecodeError):
            return replace(file, content=file.content.decode("cp1252").encode())
    return file


def cells_of(file: SensorFile) -> TableText:
    """The cells of a file: Parquet, JSON or separated text, whichever it is."""
    if file.content.startswith(PARQUET):
        return cells_of_parquet(file.path)
    file = _of_windows(file)
    first = next((line.strip() for line in lines_in(file.content) if line.strip()), "")
    # The first line of a log may be truncated.
    if first[:1] in "{[" or file.share_of_lines(r"\{.*") > 0.5:
        return cells_of_json(file.lines, file.source)
    return replace(cells_of_csv(lines_in(file.content), file.source), unended=file.unended)

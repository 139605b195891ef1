"""GeoJSON: the objects of a picture for maps and geographic information systems (RFC 7946: WGS84, longitude first).

One feature per object and instant: its position, or null where bearings do not intersect, and all other columns as
properties; missing values are null. One feature per object is its track, the line through its positions in time order.
Lines are split at the antimeridian.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from itertools import chain, pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import FloatArray
from sameas.errors import InputError
from sameas.io.atomic import replacing
from sameas.report.prose import UTC_FROM_S

Columns = Mapping[str, NDArray[Any]]

#: Decimals of degrees (7 are a centimetre), and significant digits of other numbers.
DECIMALS, DIGITS = 7, 9
#: Rows that are Python objects at once: those of a coast of 2 000 ships would take 2 kB each.
PART = 10_000


def write_geojson(objects: Columns, path: str | os.PathLike[str]) -> None:
    """Writes the objects of a picture as a FeatureCollection, atomically.

    objects : columns as of :class:`sameas.picture.Picture`, lat_deg and lon_deg among them.

    Raises InputError: there are no latitudes and longitudes; the path cannot be written.
    """
    for name in ("time_s", "object", "lat_deg", "lon_deg"):
        if name not in objects:
            raise InputError(
                f"cannot write {path}: the objects have no {name}; GeoJSON needs latitudes and longitudes, which a "
                "picture in metres of its own does not have; write CSV or Parquet"
            )
    n, encode = len(objects["object"]), json.JSONEncoder(ensure_ascii=False, allow_nan=False).encode
    with replacing(path) as draft, draft.open("w", encoding="utf-8") as out:
        out.write('{"type": "FeatureCollection", "features": [')
        parts = ({name: column[k : k + PART] for name, column in objects.items()} for k in range(0, n, PART))
        for k, feature in enumerate(chain(chain.from_iterable(map(_points, parts)), _tracks(objects))):
            out.write((",\n" if k else "\n") + encode(feature))
        out.write("\n]}\n")


def _points(objects: Columns) -> Iterator[dict[str, Any]]:
    """A feature for each row of the objects."""
    positions = _positions(objects)
    columns = {name: _values(column) for name, column in objects.items() if name not in ("lat_deg", "lon_deg")}
    # Times since 1970 need more digits than other numbers.
    columns["time_s"] = np.asarray(objects["time_s"], dtype=np.float64).tolist()
    stamps = _stamps(columns["time_s"])
    for k, position in enumerate(positions):
        properties = {name: column[k] for name, column in columns.items()}
        geometry = None if position is None else {"type": "Point", "coordinates": position}
        properties = {**stamps.get(properties["time_s"], {}), **properties}
        yield {"type": "Feature", "geometry": geometry, "properties": properties}


def _tracks(objects: Columns) -> Iterator[dict[str, Any]]:
    """A feature for each object with two or more positions: the line through them, and their times."""
    time_s, numbers = np.asarray(objects["time_s"], dtype=np.float64), np.asarray(objects["object"])
    labels = np.ma.getdata(objects["label"]) if "label" in objects else None
    places = _rounded_positions(objects)
    known = np.asarray(np.isfinite(places).all(axis=1))
    # Object by object: all points of a coast in a day as lists would take a gigabyte.
    order = np.argsort(numbers, kind="stable")
    of_objects = np.split(order, np.flatnonzero(np.diff(numbers[order])) + 1) if len(order) else []
    of_tracks = [(rows, rows[known[rows]]) for rows in of_objects]
    for rows, points in sorted((one for one in of_tracks if len(one[1]) > 1), key=lambda one: int(one[1][0])):
        points = points[np.argsort(time_s[points], kind="stable")]
        names = [] if labels is None else _values(labels[rows])
        times = time_s[points].tolist()
        yield {
            "type": "Feature",
            "geometry": {"type": "MultiLineString", "coordinates": _line_parts(places[points].tolist())},
            "properties": {
                "track": True, "object": numbers[rows[0]].item(), "label": next(filter(None, reversed(names)), None),
                "first_s": times[0], "last_s": times[-1], "times_s": times,
            },
        }  # fmt: skip


def _line_parts(positions: list[list[float]]) -> list[list[list[float]]]:
    """The line through the positions, split into parts where it crosses the antimeridian."""
    lines: list[list[list[float]]] = [[positions[0]]]
    for begin, end in pairwise(positions):
        first, *rest = _split_at_antimeridian(begin, end)
        lines[-1].append(first[1])
        lines += rest
    return lines


def _split_at_antimeridian(begin: list[float], end: list[float]) -> list[list[list[float]]]:
    """The parts of a line segment; two where it crosses the antimeridian (RFC 7946, 3.1.9)."""
    width = end[0] - begin[0]
    if abs(width) <= 180.0:
        return [[begin, end]]
    side = 180.0 if width < 0.0 else -180.0
    share = (side - begin[0]) / (width + 2.0 * side)
    lat = round(begin[1] + share * (end[1] - begin[1]), DECIMALS)
    return [[begin, [side, lat]], [[-side, lat], end]]


def _positions(columns: Columns) -> list[list[float] | None]:
    """[longitude, latitude] of every row, None where unknown."""
    pairs = _rounded_positions(columns)
    known = np.asarray(np.isfinite(pairs).all(axis=1))
    return [pair if is_known else None for pair, is_known in zip(pairs.tolist(), known.tolist(), strict=True)]


def _rounded_positions(columns: Columns) -> FloatArray:
    """(n, 2) longitude and latitude of every row, NaN where unknown."""
    lon, lat = (np.ma.filled(np.ma.asarray(columns[name], dtype=np.float64), np.nan) for name in ("lon_deg", "lat_deg"))
    return np.asarray(np.round(np.column_stack([(lon + 180.0) % 360.0 - 180.0, lat]), DECIMALS))


def _values(column: NDArray[Any]) -> list[Any]:
    """The cells of a column as JSON values; None where a cell is masked, empty or not finite."""
    missing: NDArray[Any] = np.ma.getmaskarray(column)
    values = np.ma.getdata(column)
    if values.dtype.kind == "f":
        missing = missing | ~np.isfinite(values)
        cells: list[Any] = [float(f"{value:.{DIGITS}g}") for value in values.tolist()]
    else:
        cells = values.tolist()
        if values.dtype.kind == "U":
            missing = missing | np.asarray(values == "")
    return [None if absent else cell for cell, absent in zip(cells, missing.tolist(), strict=True)]


def _stamps(times_s: list[float]) -> dict[float, dict[str, str]]:
    """The property "time" (ISO 8601, UTC) by time in seconds; none for times of another clock."""
    utc = {t for t in times_s if t >= UTC_FROM_S}
    return {t: {"time": datetime.fromtimestamp(t, UTC).isoformat().replace("+00:00", "Z")} for t in utc}

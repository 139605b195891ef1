"""Tables of drones: positions in messages of MAVLink, and what shows that a table is of Remote ID (ASTM F3411).

MAVLink's units are those of its messages (``common.xml``): 10⁻⁷ degrees, millimetres, centimetres a second and
hundredths of a degree, with velocities towards north, east and down. pymavlink's ``mavlogdump --format csv --types …``
writes them with names such as ``GLOBAL_POSITION_INT.lat``; with ``--format json`` the message's type is beside them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from sameas.io.sensors.table_cells import TableText
from sameas.io.sensors.table_columns import stem_of

Cell = str | float | None
#: Bits of ADSB_FLAGS: what of the position, the height, the course, the velocity, the callsign and the code is valid.
_POSITION, _HEIGHT, _COURSE, _VELOCITY, _CALLSIGN, _CODE, _CLIMB = 1, 2, 4, 8, 16, 32, 128
#: A heading that is not known, in hundredths of a degree.
_UNKNOWN_HEADING = 65535.0


@dataclass(frozen=True)
class _Field:
    """A field of a message: its name, the factor of its unit to ours, the flag of its validity."""

    name: str
    factor: float = 1.0
    flag: int = 0


_FIELDS: Mapping[str, Mapping[str, _Field]] = {
    "GLOBAL_POSITION_INT": {
        "lat_deg": _Field("lat", 1e-7), "lon_deg": _Field("lon", 1e-7), "alt_m": _Field("alt", 1e-3),
        "vx_m_per_s": _Field("vy", 1e-2), "vy_m_per_s": _Field("vx", 1e-2), "climb_m_per_s": _Field("vz", -1e-2),
        "heading_deg": _Field("hdg", 1e-2),
    },
    "ADSB_VEHICLE": {
        "lat_deg": _Field("lat", 1e-7, _POSITION), "lon_deg": _Field("lon", 1e-7, _POSITION),
        "alt_m": _Field("altitude", 1e-3, _HEIGHT), "speed_m_per_s": _Field("hor_velocity", 1e-2, _VELOCITY),
        "course_deg": _Field("heading", 1e-2, _COURSE), "climb_m_per_s": _Field("ver_velocity", 1e-2, _CLIMB),
    },
}  # fmt: skip
#: Names of columns, without blanks and signs, that only tables of Remote ID have.
_REMOTE_ID = {"uasid", "basicid", "selfid", "operatorid", "operatorlat", "operatorlatitude",
              "pilotlat", "pilotlatitude", "remoteid", "uavid", "droneid", "heightagl", "takeofflat",
              "takeofflatitude"}  # fmt: skip


def recognised(cells: TableText) -> tuple[TableText, str, list[str]]:
    """A table, its format ("mavlink", "remote id" or "table"), and sentences on how it is read: one of messages of
    MAVLink with our names and units, others as they are."""
    message = _message(cells)
    if {"time_utc_usec", "lat", "lon", "vel_n_m_s", "vel_e_m_s"} <= set(cells.columns):
        return _of_px4(cells), "mavlink", ["read as vehicle_gps_position of PX4, in the units of that topic"]
    if message is None:
        stems = {stem_of(name)[0] for name in cells.columns}
        if stems.isdisjoint(_REMOTE_ID):
            return cells, "table", []
        return _with_time_of_receipt(_without_heights_above_ground(cells)), "remote id", []
    column = _columns_of(cells, message)
    flags = [_number(cell) for cell in column("flags")]
    out: dict[str, Sequence[Any]] = {"time_s": column("timestamp")}
    for name, field in _FIELDS[message].items():
        out[name] = [_scaled(cell, field) for cell in _valid(column(field.name), flags, field.flag)]
    if message == "ADSB_VEHICLE":
        types = [_number(cell) for cell in column("altitude_type")]
        heights = list(zip(out["alt_m"], types, strict=True))
        out["alt_m"] = [height if kind == 1.0 else None for height, kind in heights]
        out["pressure_altitude_m"] = [height if kind == 0.0 else None for height, kind in heights]
        out["icao"] = [_address(cell) for cell in column("ICAO_address")]
        out["callsign"] = _valid(column("callsign"), flags, _CALLSIGN)
        out["squawk"] = _valid(column("squawk"), flags, _CODE)
    else:
        out["track_id"] = [f"vehicle {cell or 1}" for cell in column("srcSystem")]
    format_name = "mavlink" if message == "GLOBAL_POSITION_INT" else "table"
    return replace(cells, columns=out), format_name, [f"read as {message} of MAVLink, in the units of that message"]


def _of_px4(cells: TableText) -> TableText:
    """A table of ``vehicle_gps_position`` of PX4 (before 1.14), as ``ulog2csv`` writes it: the time of GNSS, not that
    since the start, 10⁻⁷ degrees, millimetres above the ellipsoid."""
    numbers = {name: [_number(cell) for cell in cells.columns[name]] for name in
               ("time_utc_usec", "lat", "lon", "vel_n_m_s", "vel_e_m_s")}  # fmt: skip
    out: dict[str, Sequence[Any]] = {
        "time_s": [None if not cell else cell / 1e6 for cell in numbers["time_utc_usec"]],
        "lat_deg": [None if cell is None else cell * 1e-7 for cell in numbers["lat"]],
        "lon_deg": [None if cell is None else cell * 1e-7 for cell in numbers["lon"]],
        "vx_m_per_s": numbers["vel_e_m_s"], "vy_m_per_s": numbers["vel_n_m_s"],
        "track_id": ["vehicle 1"] * len(cells.lines),
    }  # fmt: skip
    if "alt_ellipsoid" in cells.columns:
        heights = [_number(cell) for cell in cells.columns["alt_ellipsoid"]]
        out["alt_m"] = [None if height is None else height / 1e3 for height in heights]
    return replace(cells, columns=out)


#: Tenths of a second of an hour.
_TENTHS_OF_HOUR = 36_000.0


def _with_time_of_receipt(cells: TableText) -> TableText:
    """A table of Remote ID without the ``TimeStamp`` of its messages, tenths of a second after the hour, beside another
    time stamp."""
    names = [name for name in cells.columns if stem_of(name)[0] == "timestamp"]
    if len(names) < 2:
        return cells
    numbers = {name: [_number(cell) for cell in cells.columns[name]] for name in names}
    of_hour = {
        name for name, column in numbers.items()
        if any(column) and all(cell is None or 0.0 <= cell <= _TENTHS_OF_HOUR for cell in column)
    }  # fmt: skip
    if len(of_hour) == len(names):
        return cells
    return replace(cells, columns={name: cells.columns[name] for name in cells.columns if name not in of_hour})


def _without_heights_above_ground(cells: TableText) -> TableText:
    """A table of Remote ID without its ``Height``, where a type says from where it counts: the ground, or the place of
    take-off (ASTM F3411)."""
    stems = {stem_of(name)[0]: name for name in cells.columns}
    if "height" not in stems or stems.keys().isdisjoint(("heighttype", "heightref", "heightreference")):
        return cells
    height = stems["height"]
    kept = {name: cells.columns[name] for name in cells.columns if name != height}
    return replace(cells, columns=kept | {f"{height} above ground": cells.columns[height]})


def _message(cells: TableText) -> str | None:
    """The message of MAVLink whose fields a table has, or None."""
    names = set(cells.columns)
    of_names = [message for message in _FIELDS if {f"{message}.lat", f"{message}.lon", "timestamp"} <= names]
    if of_names:
        return of_names[0]
    if {"type", "timestamp", "lat", "lon"} <= names:
        types = set(cells.columns["type"])
        return next((message for message in _FIELDS if message in types), None)
    return None


def _columns_of(cells: TableText, message: str) -> Callable[[str], list[Cell]]:
    """The column of a field in the rows of a message; without values where the table does not have it."""
    n, kinds = len(cells.lines), None if f"{message}.lat" in cells.columns else list(cells.columns["type"])

    def column(field: str) -> list[Cell]:
        name = field if kinds is not None or field == "timestamp" else f"{message}.{field}"
        values = list(cells.columns[name]) if name in cells.columns else [None] * n
        if kinds is None or field == "timestamp":
            return values
        return [value if kind == message else None for value, kind in zip(values, kinds, strict=True)]

    return column


def _number(cell: Cell) -> float | None:
    try:
        value = float(cell) if cell is not None else math.nan
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def _scaled(cell: Cell, field: _Field) -> float | None:
    value = _number(cell)
    if value is None or (field.name in ("hdg", "heading") and value == _UNKNOWN_HEADING):
        return None
    return value * field.factor


def _valid(column: Sequence[Cell], flags: Sequence[float | None], flag: int) -> list[Cell]:
    """The cells of a column without those that are not valid by their flags; all where no flag tells (0)."""
    if not flag:
        return list(column)
    return [cell if bits is None or int(bits) & flag else None for cell, bits in zip(column, flags, strict=True)]


def _address(cell: Cell) -> str | None:
    value = _number(cell)
    return None if not value else f"{int(value):06x}"

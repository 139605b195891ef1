"""Tables: reports in CSV, Parquet or JSON lines, with columns recognised by their names.

A table needs times and positions: latitude and longitude, x and y, range and bearing, or bearings alone; speeds, errors
and identities are optional. A line with too few cells, or with text in place of a number, is damaged and skipped.
Columns are recognised in :mod:`~sameas.io.sensors.table_columns`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import ABSENT, BoolArray, FloatArray, IntArray, ordered_by
from sameas.errors import Argument, InputError, Message
from sameas.io.sensors import drones
from sameas.io.sensors.ais import SIDES, STATUSES_AT_REST, at_hull_centres, is_imo_number
from sameas.io.sensors.format import (
    AIS_SIGMA_M,
    KNOT_M_PER_S,
    ReadOptions,
    SensorFormat,
    kind_by_name,
    round_covariance,
    start_seconds,
)
from sameas.io.sensors.languages import DATES, HOURS, plain
from sameas.io.sensors.table_cells import NULLS, PARQUET, TableText, cells_of, distinct_texts, of_each, parts_of
from sameas.io.sensors.table_columns import (
    HEADINGS,
    NO_UNIT,
    Choice,
    choose,
    is_compass,
    require_columns,
    stem_of,
    with_breadths_as_places,
    with_sensors_motion,
)
from sameas.io.sensors.table_times import FIRST_S, milliseconds, times_of
from sameas.representation import counted
from sameas.tracks.distress import TESTED, device_of
from sameas.tracks.reports import DIRECTIONS, OWN_HEADING, Damaged, Reports, is_impossible

#: Columns with latitude and longitude in one cell.
_POSITIONS = ("position", "latlon", "latlong", "latlng", "coordinates")
#: Metres of a degree of latitude.
DEGREE_M = 111_200.0
#: Number of unused columns that are listed.
_LISTED = 12
#: MMSI of base stations (00 and the country) and aids to navigation.
_STATION = re.compile("00[2-7]|99[2-7]")


def read(cells: TableText, source: str, options: ReadOptions | None = None) -> Reports:
    """The reports of a table.

    cells : of the table.
    source : its name in messages; it may show the kind of the source.
    options : what the table does not contain.

    Raises InputError: no time; no position; two columns of one quantity; every row damaged; dates of two readings.
    """
    options = options or ReadOptions()
    kind = options.kind or kind_by_name(source)
    cells, format_name, read_as = drones.recognised(_with_split_positions(cells))
    chosen = choose(list(cells.columns), source, options.columns, options.units, kind)
    require_columns(chosen, list(cells.columns), source)
    if not len(cells.lines):
        reasons = "; ".join(Damaged.of(cells.damaged, cells.unit).sentences())
        raise InputError(f"{source}: names columns, but has no row that can be used{': ' * bool(reasons)}{reasons}")
    if is_compass(chosen):
        format_name = OWN_HEADING
        chosen = {"heading_deg" if name in HEADINGS else name: choice for name, choice in chosen.items()}
    damaged = dict(cells.damaged)
    is_ais = "mmsi" in chosen or kind == "ais"
    if is_ais:
        cells, chosen = _with_flagged_errors(cells, chosen)
    values = {
        name: _values(cells, choice, damaged) for name, choice in chosen.items() if name not in ("time_s", "day_s")
    }
    chosen = _with_unit_of_frequencies(values, chosen)
    chosen = _with_unit_of_bearings(values, chosen, options.units or {})
    values, chosen = with_sensors_motion(*with_breadths_as_places(values, chosen))
    values, chosen = _with_nav_status(values, _without_row_numbers(values, chosen), is_ais)
    _refuse_steps(values, chosen, source)
    marks = _mark_unavailable(values, chosen, is_ais)
    start_s = start_seconds(options.start, source)
    values["time_s"], note = times_of(cells, chosen, source, start_s, options.time_zone)
    if _is_in_milliseconds(values, chosen, options):
        values["time_s"], note = values["time_s"] / 1000.0, f"{note}; they are milliseconds, by their steps"
    if start_s is not None and float(np.nanmax(np.abs(values["time_s"]), initial=0.0)) < FIRST_S:
        values["time_s"], note = values["time_s"] + start_s, f"{source}: times are read as seconds since the start"
    _mark(np.isnan(values["time_s"]), cells.lines, damaged, "no time")
    values, static = _with_statics(values)
    _mark_unusable(values, cells.lines, damaged, static)
    good = ~np.isin(cells.lines, list(damaged)) & ~static
    if not good.any():
        raise InputError(
            f"{source}: no row can be used: {'; '.join(Damaged.of(damaged.items(), cells.unit).sentences())}"
        )
    values = {name: column[good] for name, column in values.items()} | {"line": cells.lines[good]}
    values, stations = _without_stations(values)
    values, repeated = _without_repeats(_with_track_id(values))
    counts = {
        "static data of ships, without a position": int(static.sum()),
        "base station or aid to navigation": stations, "position repeated": repeated,
    }  # fmt: skip
    passed_over = {what: count for what, count in counts.items() if count}
    truncated = ["its last line has no line end: it may be incomplete"] * cells.unended
    values, hulls = _at_hulls(_with_covariances(values), is_ais)
    more = [f"{source}: {one}" for one in (*read_as, *truncated, *marks, *_interpretation(cells, chosen), *hulls)]
    return Reports.of(
        source, format_name, values, damaged=Damaged.of(damaged.items(), cells.unit),
        passed_over=passed_over, notes=[note, *more],
    )  # fmt: skip


def _is_in_milliseconds(values: Mapping[str, Any], chosen: Mapping[str, Choice], options: ReadOptions) -> bool:
    """Whether times from an origin of their own are milliseconds, though nothing says so."""
    time = chosen.get("time_s")
    if time is None or time.name in (options.units or {}) or stem_of(time.name)[1] or {"mmsi", "icao"} & set(values):
        return False
    if np.nanmax(np.abs(values["time_s"]), initial=0.0) >= FIRST_S:
        return False
    n = len(values["time_s"])
    place = np.full((n, 2), np.nan)
    if {"x_m", "y_m"} <= set(values):
        place = np.column_stack([values["x_m"], values["y_m"]])
    elif {"range_m", "bearing_deg"} <= set(values):
        angle = np.radians(values["bearing_deg"])
        place = values["range_m"][:, None] * np.column_stack([np.sin(angle), np.cos(angle)])
    elif {"lat_deg", "lon_deg"} <= set(values):
        east = values["lon_deg"] * np.cos(np.radians(values["lat_deg"]))
        place = DEGREE_M * np.column_stack([east, values["lat_deg"]])
    return milliseconds(values["time_s"], values.get("track_id"), place)


def _interpretation(cells: TableText, chosen: Mapping[str, Choice]) -> list[str]:
    """Sentences on how the columns are read, and on those that are not used."""
    sentences = [choice.why for choice in chosen.values() if choice.why]
    if translated := [f"{c.name} as {c.quantity.column}" for c in chosen.values() if c.translated]:
        sentences.append(f"columns read by their names: {', '.join(translated)}")
    used = {choice.name for choice in chosen.values()}
    unused = [name for name in cells.columns if name not in used and plain(name) not in (*DATES, *HOURS)]
    if unused:
        more = f" and {len(unused) - _LISTED} more" if len(unused) > _LISTED else ""
        sentences.append(f"columns not used: {', '.join(unused[:_LISTED])}{more}")
    return sentences


def _at_hulls(values: dict[str, Any], is_ais: bool) -> tuple[dict[str, Any], list[str]]:
    """The values of AIS at the centres of the hulls, without the places of antennas, and sentences on the shift."""
    sides = [values.pop(f"to_{side}_m", None) for side in SIDES]
    if not is_ais or "lat_deg" not in values:
        return values, []
    angles = {
        name: np.where((values[name] >= 0.0) & (values[name] < 360.0), values[name], np.nan)
        for name in ("heading_deg", "course_deg") if name in values
    }  # fmt: skip
    centred, sentences = at_hull_centres(values | angles, sides)
    return centred | {name: values[name] for name in angles}, list(sentences)


def _with_split_positions(cells: TableText) -> TableText:
    """The table with a latitude and a longitude instead of positions in one column, as "55.5,12.25"."""
    for name in cells.columns:
        if "".join(stem_of(name)) in _POSITIONS:
            column = cells.columns[name]
            parts = [cell.partition(",") if isinstance(cell, str) else ("", "", "") for cell in column]
            if any(comma for _, comma, _ in parts):
                others = {other: values for other, values in cells.columns.items() if other != name}
                places = {"latitude": [lat for lat, _, _ in parts], "longitude": [lon for _, _, lon in parts]}
                return replace(cells, columns=others | places)
    return cells


def _with_flagged_errors(cells: TableText, chosen: dict[str, Choice]) -> tuple[TableText, dict[str, Choice]]:
    """The table with errors in metres instead of the accuracy flag of AIS, if its column of errors has only 0 and 1, or
    low and high (Spire)."""
    choice = chosen.get("sigma_m")
    if choice is None:
        return cells, chosen
    column = cells.columns[choice.name]
    is_set, is_not = {"1", "1.0", "true", "high"}, {"0", "0.0", "false", "low", *NULLS}
    if not is_set | is_not >= set(map(_flag, distinct_texts(column))):
        return cells, chosen
    errors = of_each(lambda cell: AIS_SIGMA_M[_flag(cell) in is_set], column)
    why = f"{choice.name} is the accuracy flag of AIS: {AIS_SIGMA_M[True]:g} m per axis where it is set, "
    why += f"{AIS_SIGMA_M[False]:g} m where not"
    others = {name: cells.columns[name] for name in cells.columns if name != choice.name}
    return (
        replace(cells, columns=others | {choice.name: errors}),
        chosen | {"sigma_m": replace(choice, factor=1.0, why=why)},
    )


def _flag(cell: Any) -> str:
    return "" if cell is None else str(cell).strip().lower()


def _values(cells: TableText, choice: Choice, damaged: dict[int, str]) -> NDArray[Any]:
    """A column in SI units or degrees; lines with cells that are not numbers become damaged."""
    column = cells.columns[choice.name]
    if choice.quantity.kind == "text":
        return _texts(column, choice.quantity.column)
    values = np.empty(len(column))
    first, is_place = 0, choice.quantity.column in ("lat_deg", "lon_deg")
    for texts, number in parts_of(column):
        numbers, unreadable = _numbers(texts, choice.factor, is_place)
        values[first : first + len(number)] = numbers[number]
        if unreadable.any():
            for k in np.flatnonzero(unreadable[number]):
                damaged.setdefault(int(cells.lines[first + k]), f"{choice.name} is no number")
        first += len(number)
    return values


def _numbers(column: Sequence[Any], factor: float, is_place: bool) -> tuple[FloatArray, BoolArray]:
    """The numbers of cells (n,), times the factor, NaN where there is none; and whether a cell has something else."""
    unreadable = np.zeros(len(column), bool)
    try:
        return np.array(column, dtype=np.float64) * factor, unreadable
    except (TypeError, ValueError, OverflowError):
        pass
    values = np.full(len(column), np.nan)
    for k, cell in enumerate(column):
        if cell is None or str(cell).strip().lower() in NULLS:
            continue
        try:
            values[k] = float(cell) * factor
        except (TypeError, ValueError, OverflowError):
            values[k] = _degrees(str(cell)) if is_place else math.nan
            unreadable[k] = math.isnan(values[k])
    return values, unreadable


#: Degrees, minutes and seconds, of which the last may have decimals, between letters of the hemisphere.
_DEGREES = re.compile(
    r"([NSEW])?\s*([+-]?\d{1,3}(?:[.,]\d+)?)(?:[\s°:]+(\d{1,2}(?:[.,]\d+)?)(?:[\s'′:]+(\d{1,2}(?:[.,]\d+)?))?)?"
    r"[\s°'′\"″]*([NSEW])?",
    re.IGNORECASE,
)


def _degrees(text: str) -> float:
    """A latitude or longitude such as 53° 56,656' N or S 33°51'20"; NaN for other texts."""
    parts = _DEGREES.fullmatch(text.strip())
    if parts is None or (parts[1] and parts[5]):
        return math.nan
    numbers = [float(part.replace(",", ".")) for part in parts.group(2, 3, 4) if part]
    if any(number >= 60.0 for number in numbers[1:]) or any(number % 1.0 for number in numbers[:-1]):
        return math.nan
    size = sum(abs(number) / 60.0**k for k, number in enumerate(numbers))
    hemisphere = (parts[1] or parts[5] or "").upper()
    if hemisphere and parts[2][0] in "+-":
        return math.nan
    return -size if hemisphere in ("S", "W") or parts[2].startswith("-") else size


def _texts(column: Sequence[Any], quantity: str) -> NDArray[np.object_]:
    """Text cells in standard form: integers without decimal point, ICAO addresses in lower case, 4-digit squawks."""
    return np.array([*of_each(partial(_text, quantity=quantity), column), None], object)[:-1]


def _text(cell: Any, quantity: str) -> str | None:
    if isinstance(cell, float):
        cell = None if np.isnan(cell) else (int(cell) if cell.is_integer() else cell)
    text = "" if cell is None else str(cell).strip()
    if text.lower() in NULLS:
        return None
    if quantity in ("mmsi", "mode_a", "imo") and re.fullmatch(r"\d+\.0*", text):
        text = text.split(".")[0]
    if quantity == "mode_a" and text.isdigit():
        text = text.zfill(4)
    if quantity == "mmsi" and text.isdigit():
        text = text.zfill(9)
    if quantity == "imo":
        text = text.upper().removeprefix("IMO").strip()
    return text.lower() if quantity == "icao" else text


def _with_nav_status(
    values: dict[str, Any], chosen: dict[str, Choice], is_ais: bool
) -> tuple[dict[str, Any], dict[str, Choice]]:
    """The navigational statuses of AIS as numbers, NaN for those without a number of ours; no statuses of others."""
    status = values.pop("nav_status", None)
    if status is None:
        return values, chosen
    if not is_ais:
        return values, {name: choice for name, choice in chosen.items() if name != "nav_status"}
    number = np.array(of_each(_nav_status, status.tolist()))
    # Of a locating device it is a test, of a ship none.
    undefined = np.flatnonzero(number == TESTED)
    senders = values["mmsi"][undefined].tolist() if "mmsi" in values else [None] * len(undefined)
    number[undefined] = [math.nan if device_of(mmsi) is None else TESTED for mmsi in senders]
    return values | {"nav_status": number}, chosen


#: Median of frequencies without a unit, from which on they are read in a unit; the highest first.
_FREQUENCY_UNITS = ((3e7, 1.0, "Hz"), (1e5, 1e3, "kHz"), (0.0, 1e6, "MHz"))


def _with_unit_of_frequencies(values: dict[str, Any], chosen: dict[str, Choice]) -> dict[str, Choice]:
    """The columns with the unit of frequencies that state none, by their size: 156.8 is in MHz; changes the values."""
    choice = chosen.get("frequency_hz")
    if choice is None or not choice.why.endswith(NO_UNIT) or not np.isfinite(values["frequency_hz"]).any():
        return chosen
    median = float(np.nanmedian(values["frequency_hz"]))
    factor, unit = next((factor, unit) for least, factor, unit in _FREQUENCY_UNITS if median >= least)
    values["frequency_hz"] = values["frequency_hz"] * factor
    why = f"{choice.name} is read in {unit}, by its size: {NO_UNIT}"
    return chosen | {"frequency_hz": replace(choice, factor=factor, why=why)}


#: Different values beyond a turn that no mark of a missing bearing explains, and their share.
_STEPS, _STEPS_SHARE = 20, 0.2


def _refuse_steps(values: Mapping[str, Any], chosen: Mapping[str, Choice], source: str) -> None:
    """Refuses bearings of which many are beyond a turn: steps of an antenna, or another unit.

    Raises InputError: so many.
    """
    for name in sorted({"bearing_deg", "relative_bearing_deg"} & set(values)):
        beyond = values[name][is_impossible(name, values[name])]
        if len(beyond) > _STEPS_SHARE * len(values[name]) and len(np.unique(beyond)) > _STEPS:
            column = chosen[name].name
            raise InputError(
                f"{source}: {column} goes to {np.max(beyond):g}, which no bearing in degrees does",
                Message(
                    "give ", Argument("units", "UNIT", (column,)), ', such as "4096 per turn" for steps of an antenna'
                ),
            )


#: Bearings without a unit are radians if there are so many, all within a turn of radians and over most of it, and half
#: of them as far from the one before (in their unit): the antenna turns from object to object.
_RADIANS, _RADIANS_SPAN, _RADIANS_APART = 50, 5.5, 0.3


def _with_unit_of_bearings(
    values: dict[str, Any], chosen: dict[str, Choice], units: Mapping[str, str]
) -> dict[str, Choice]:
    """The columns with bearings in radians, if they state no unit and look so, and the headings beside them; changes
    the values."""
    out = dict(chosen)
    for name in ("bearing_deg", "relative_bearing_deg"):
        if name not in values or not _states_no_unit(chosen[name], units):
            continue
        angle = values[name][np.isfinite(values[name])]
        if len(angle) < _RADIANS or not _is_in_radians(angle):
            continue
        apart = np.abs(np.mod(np.diff(angle) + math.pi, 2.0 * math.pi) - math.pi)
        if np.ptp(angle) < _RADIANS_SPAN or np.median(apart) < _RADIANS_APART:
            continue
        read = [name, *(one for one in ("station_heading_deg", "heading_deg", "course_deg") if one in values)]
        read = [one for one in read if _states_no_unit(chosen[one], units) and _is_in_radians(values[one])]
        for one in read:
            values[one] = np.degrees(values[one])
            why = f"{chosen[one].name} is read in rad, by its size: {NO_UNIT}"
            out[one] = replace(chosen[one], factor=math.degrees(1.0), why=why)
    return out


def _states_no_unit(choice: Choice, units: Mapping[str, str]) -> bool:
    return choice.name not in units and not stem_of(choice.name)[1]


def _is_in_radians(angle: FloatArray) -> bool:
    """Whether no angle is beyond a turn of radians, from 0 or to either side."""
    return bool(np.nanmin(angle) >= -math.pi - 0.01 and np.nanmax(angle) <= 2.0 * math.pi + 0.01)


def _nav_status(text: str | None) -> float:
    text = "" if text is None else str(text).strip().lower()
    number = float(text) if re.fullmatch(r"1?\d(\.0*)?", text) else STATUSES_AT_REST.get(text, math.nan)
    return math.nan if number > TESTED else number


def _mark(rows: BoolArray, lines: IntArray, damaged: dict[int, str], reason: str) -> None:
    for line in lines[rows]:
        damaged.setdefault(int(line), reason)


#: Values of AIS that mean "not available" (ITU-R M.1371, table 48), also as the integers of the message.
_OF_AIS: Mapping[str, tuple[float, ...]] = {
    "speed_m_per_s": (102.3, 1023.0), "course_deg": (360.0, 3600.0), "heading_deg": (511.0,), "lon_deg": (181.0,),
}  # fmt: skip
#: The highest speed of AIS, that of search and rescue aircraft.
FASTEST_AIS_M_PER_S = 1022.0 * KNOT_M_PER_S
#: Rows in which a number of nines only must stand to mean that there is no value, if no other number is as frequent.
_NINES = 3


def _mark_unavailable(values: dict[str, NDArray[Any]], chosen: Mapping[str, Choice], is_ais: bool) -> list[str]:
    """Makes values that mean "not available" NaN, in place, and returns sentences on them.

    They are those of AIS; impossible ones (:data:`~sameas.tracks.reports.POSSIBLE`); a number of nines only, such as
    −999 or 9999, that is the most frequent value of its column; heights that are all 0; and IMO numbers without their
    check digit.
    """
    sentences = _mark_no_imo_numbers(values, chosen)
    for name, column in values.items():
        if column.dtype.kind != "f" or not len(column):
            continue
        given = column / chosen[name].factor
        missing = np.isin(np.round(given, 4), _OF_AIS.get(name, ())) if is_ais else np.zeros(len(column), bool)
        missing |= np.isin(np.round(given, 4), _nines(given))
        missing |= is_impossible(name, column)
        missing |= is_ais and name == "speed_m_per_s" and column > FASTEST_AIS_M_PER_S
        missing |= name in DIRECTIONS and given == 511.0
        if name in ("alt_m", "pressure_alt_m") and len(column) >= _NINES and not np.nan_to_num(column).any():
            missing = column == 0.0
        if missing.any():
            values[name] = np.where(missing, np.nan, column)
            which = ", ".join(f"{value:g}" for value in np.unique(given[missing])[:3].tolist())
            sentences.append(
                f"{chosen[name].name}: {counted(int(missing.sum()), 'value')} of {which} not used: missing"
            )
    return sentences


def _mark_no_imo_numbers(values: dict[str, NDArray[Any]], chosen: Mapping[str, Choice]) -> list[str]:
    """As of :func:`_mark_unavailable`, for the texts of a column of IMO numbers; 0 is said nothing of."""
    column = values.get("imo")
    if column is None:
        return []
    missing = np.array([text is not None and not is_imo_number(text) for text in column], bool)
    values["imo"] = kept = column.copy()
    kept[missing] = None
    false = [text for text in column[missing] if text.strip("0")]
    which = ", ".join(sorted(set(false))[:3])
    made_up = (
        f"{chosen['imo'].name}: {counted(len(false), 'value')} of {which} not used: no IMO number, by the check digit"
    )
    return [made_up] if false else []


def _nines(column: FloatArray) -> FloatArray:
    """The numbers of nines only of which no other number of a column is more frequent.

    >>> _nines(np.array([9999.0, 5.0, 9999.0, 7.0, 9999.0])), _nines(np.array([9999.0, 5.0, 7.0]))
    (array([9999.]), array([], dtype=float64))
    """
    found, counts = np.unique(np.round(column[np.isfinite(column)], 4), return_counts=True)
    if not len(found) or counts.max() < _NINES:
        return np.empty(0)
    frequent = found[counts >= max(_NINES, 0.1 * counts.max())]
    nines = np.array([bool(re.fullmatch(r"-?9{3,}(\.9+)?", f"{value:.12g}")) for value in frequent.tolist()])
    most = counts[~np.isin(found, frequent[nines])].max(initial=0)
    return np.array([value for value in frequent[nines].tolist() if counts[found == value][0] > most])


#: Columns that are a position together, the first always.
_POSITIONS_IN = (("lat_deg", "lon_deg"), ("x_m", "y_m"), ("bearing_deg",), ("relative_bearing_deg",))


#: What a ship's static data say of her, in messages of their own.
_STATICS = ("imo", "callsign", "name", "type", "length_m", "width_m", *(f"to_{side}_m" for side in SIDES))


def _with_statics(values: dict[str, Any]) -> tuple[dict[str, Any], BoolArray]:
    """The values with the static data of each ship at her positions, and (n,) whether a row has only these: receivers
    write the messages of AIS one below the other."""
    coordinates = [name for pair in _positions_in(values) for name in pair]
    missing = np.logical_and.reduce([np.isnan(values[name]) for name in coordinates])
    given = [name for name in _STATICS if name in values]
    if not missing.any() or "mmsi" not in values or not given:
        return values, np.zeros(len(missing), bool)
    has = {name: _is_given(values[name]) for name in given}
    static = missing & np.logical_or.reduce(list(has.values())) & _is_given(values["mmsi"])
    if not static.any():
        return values, static
    out, ships = dict(values), values["mmsi"]
    for name in given:
        known = dict(zip(ships[static & has[name]], values[name][static & has[name]], strict=True))
        empty = None if values[name].dtype == object else math.nan
        rows = np.flatnonzero(~has[name] & ~static)
        column = values[name].copy()
        column[rows] = [known.get(ship, empty) for ship in ships[rows]]
        out[name] = column
    return out, static


def _is_given(column: NDArray[Any]) -> BoolArray:
    return np.asarray(column != None if column.dtype == object else np.isfinite(column), bool)  # noqa: E711


def _without_position(values: Mapping[str, Any]) -> BoolArray:
    return np.logical_and.reduce([np.isnan(sum(values[name] for name in pair)) for pair in _positions_in(values)])


def _positions_in(values: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """The columns that are positions in a table; those of headings in that of a compass."""
    return [pair for pair in _POSITIONS_IN if pair[0] in values] or [("heading_deg",)]


def _mark_unusable(values: Mapping[str, Any], lines: IntArray, damaged: dict[int, str], static: BoolArray) -> None:
    """Marks rows without a position, or with an impossible one, as damaged; not the static data of ships."""
    reason = "no heading" if _positions_in(values) == [("heading_deg",)] else "no position"
    _mark(_without_position(values) & ~static, lines, damaged, reason)
    if "range_m" in values:
        _mark(values["range_m"] < 0.0, lines, damaged, "a distance below 0")
    heading_deg = values.get("station_heading_deg") if "relative_bearing_deg" in values else None
    if heading_deg is not None and np.isfinite(heading_deg).any():
        _mark(np.isnan(heading_deg), lines, damaged, "no heading of the vessel with the sensor")
    if "lat_deg" not in values:
        return
    beyond = np.abs(values["lat_deg"]) > 90.0
    # Where most lie outside, the columns are wrong, not the lines: Reports refuses them in its own words.
    if 2 * beyond.sum() <= len(lines):
        _mark(beyond, lines, damaged, "latitude beyond ±90°")


def _without_stations(values: dict[str, Any]) -> tuple[dict[str, Any], int]:
    """The rows of ships, and the number of those of base stations and aids to navigation, by their MMSI (ITU-R M.585).
    If there are no ships, all rows are kept."""
    if "mmsi" not in values:
        return values, 0
    ships = np.array(of_each(lambda one: one is None or _STATION.match(one) is None, values["mmsi"].tolist()))
    if ships.all() or not ships.any():
        return values, 0
    return {name: column[ships] for name, column in values.items()}, int(np.count_nonzero(~ships))


def _without_row_numbers(values: dict[str, Any], chosen: dict[str, Choice]) -> dict[str, Choice]:
    """The columns without an ``id`` beside an MMSI in every row, which databases give each row; removes its values."""
    choice = chosen.get("track_id")
    if choice is None or stem_of(choice.name)[0] not in ("id", "uid") or "mmsi" not in values:
        return chosen
    if any(one is None for one in values["mmsi"]):
        return chosen
    del values["track_id"]
    return {column: one for column, one in chosen.items() if one is not choice}


def _with_track_id(values: dict[str, Any]) -> dict[str, Any]:
    """The values with a track id; where the table has none, MMSI or ICAO address."""
    own = next((name for name in ("mmsi", "icao") if name in values), None)
    return values if "track_id" in values or own is None else values | {"track_id": values[own]}


def _without_repeats(values: dict[str, Any]) -> tuple[dict[str, Any], int]:
    """The values without repeated rows (same object, time and position), and the number of these."""
    if "track_id" not in values:
        return values, 0
    position = next(pair for pair in _POSITIONS_IN if pair[0] in values)
    names = values["track_id"].tolist()
    number_of = {name: k for k, name in enumerate(dict.fromkeys(names))}
    number = np.fromiter(map(number_of.__getitem__, names), np.int64, len(names))
    keys = [number, *(values[name] for name in ("time_s", *position))]
    order = ordered_by(keys)
    repeats = np.ones(max(len(order) - 1, 0), bool)
    for key in keys:
        repeats &= key[order[1:]] == key[order[:-1]]
    first = np.ones(len(order), bool)
    first[order[1:][repeats]] = False
    first |= number == number_of.get(None, ABSENT)
    return {name: column[first] for name, column in values.items()}, int((~first).sum())


def _with_covariances(values: dict[str, Any]) -> dict[str, Any]:
    """The values with covariance matrices instead of their columns; covariances take precedence over sigmas."""
    position = _matrix(values, ("cov_xx", "cov_xy", "cov_yy"), ("sigma_x_m", "sigma_y_m"))
    sigma = values.pop("sigma_m", None)
    if position is None and sigma is not None:
        position = round_covariance(sigma)
    velocity = _matrix(values, ("cov_vxvx", "cov_vxvy", "cov_vyvy"), ("sigma_vx", "sigma_vy"))
    matrices = {"covariance_m2": position, "velocity_covariance_m2_per_s2": velocity}
    return values | {name: matrix for name, matrix in matrices.items() if matrix is not None}


def _matrix(values: dict[str, Any], covariances: Sequence[str], sigmas: Sequence[str]) -> FloatArray | None:
    covariance = [values.pop(name, None) for name in covariances]
    sigma = [values.pop(name, None) for name in sigmas]
    if covariance[0] is not None and covariance[2] is not None:
        cross = np.zeros(len(covariance[0])) if covariance[1] is None else covariance[1]
        return np.stack([covariance[0], cross, covariance[2]], axis=-1)
    if sigma[0] is not None and sigma[1] is not None:
        return np.stack([sigma[0] ** 2, np.zeros(len(sigma[0])), sigma[1] ** 2], axis=-1)
    return None


FORMAT = SensorFormat(
    "table",
    "CSV, Parquet or JSON lines with columns recognized by their names",
    lambda file: [read(cells_of(file), file.source, file.options)],
    # Zero bytes are in damaged logs of sentences, never in a table.
    lambda file: b"\0" not in file.head,
    magic=(PARQUET,),
)

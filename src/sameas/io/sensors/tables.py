"""Tables: reports in CSV, Parquet or JSON lines, with columns recognised by their names.

A table needs times and positions: latitude and longitude, x and y, range and bearing, or bearings alone; speeds, errors
and identities are optional. A line with too few cells, or with text in place of a number, is damaged and skipped.

Columns are recognised by their names, compared without case, blanks, signs and a unit at their end: ``SOG_knots``,
``sog (kn)`` and ``SOG`` are the same quantity. Columns named by the user take precedence. Two columns of equal rank are
refused, with the choices.
"""

from __future__ import annotations

import csv
import difflib
import io
import math
import os
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from collections.abc import Set as AbstractSet
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import Any, SupportsFloat

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import BoolArray, FloatArray, IntArray
from sameas.bounds import check_columns
from sameas.errors import Argument, InputError, Message, naming
from sameas.io.sensors.ais import SIDES, at_hull_centres
from sameas.io.sensors.format import (
    AIS_SIGMA_M,
    DAY_S,
    FEET_PER_MINUTE_M_PER_S,
    KNOT_M_PER_S,
    ReadOptions,
    SensorFile,
    SensorFormat,
    instant,
    json_lines,
    kind_by_name,
    of_json,
    round_covariance,
    seconds,
    start_seconds,
    unwrapped,
    utc_of,
)
from sameas.io.sensors.languages import DATES, HOURS, names_in, plain
from sameas.representation import counted
from sameas.tracks.coordinates import FOOT_M, MILE_M
from sameas.tracks.reports import Damaged, Reports, is_impossible

#: Units by kind of quantity: as written at the end of a name, and their factor to our unit.
UNITS: Mapping[str, Mapping[str, float]] = {
    "length": {"m": 1.0, "metres": 1.0, "meters": 1.0, "metre": 1.0, "meter": 1.0, "km": 1000.0, "ft": FOOT_M,
               "feet": FOOT_M, "nm": MILE_M, "nmi": MILE_M, "cm": 0.01, "mm": 0.001, "sm": MILE_M, "seemeilen": MILE_M,
               "milles": MILE_M, "millas": MILE_M, "miglia": MILE_M, "milhas": MILE_M, "sjomil": MILE_M,
               "somil": MILE_M, "zeemijl": MILE_M, "metri": 1.0, "metros": 1.0},
    "angle": {"deg": 1.0, "degrees": 1.0, "degree": 1.0, "rad": 57.29577951308232, "radians": 57.29577951308232,
              "mrad": 0.05729577951308232, "grad": 1.0, "degres": 1.0, "grados": 1.0, "gradi": 1.0, "graus": 1.0,
              "grader": 1.0, "graden": 1.0},
    "speed": {"mps": 1.0, "ms": 1.0, "mpers": 1.0, "msec": 1.0, "kn": KNOT_M_PER_S, "kt": KNOT_M_PER_S,
              "kts": KNOT_M_PER_S, "knots": KNOT_M_PER_S, "knot": KNOT_M_PER_S, "kmh": 1.0 / 3.6, "kph": 1.0 / 3.6,
              "kmperh": 1.0 / 3.6, "mph": 0.44704, "fpm": FEET_PER_MINUTE_M_PER_S, "ftmin": FEET_PER_MINUTE_M_PER_S,
              "knoten": KNOT_M_PER_S, "noeuds": KNOT_M_PER_S, "nds": KNOT_M_PER_S, "nudos": KNOT_M_PER_S,
              "nodi": KNOT_M_PER_S, "nos": KNOT_M_PER_S, "knop": KNOT_M_PER_S, "knob": KNOT_M_PER_S,
              "knopen": KNOT_M_PER_S},
    "variance": {"m2": 1.0, "km2": 1e6},
    "speed variance": {"m2s2": 1.0, "m2pers2": 1.0},
    "time": {"s": 1.0, "sec": 1.0, "seconds": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "utc": 0.0},
    "text": {},
}  # fmt: skip


@dataclass(frozen=True)
class SensorQuantity:
    """One quantity: its column in Reports, its kind, and its known names, the preferred first.

    translations : names in other languages that are certain in a table.
    """

    column: str
    kind: str
    names: tuple[str, ...]
    translations: tuple[str, ...] = ()


def _quantity(column: str, kind: str, names: str) -> SensorQuantity:
    return SensorQuantity(column, kind, tuple(names.split()))


QUANTITIES = (
    _quantity(
        "time_s",
        "time",
        "lastposupdate time timestamp datetime basedatetime t utc timeutc utctime dt epoch unixtime unix date",
    ),
    _quantity("day_s", "time", "timeofday tod"),
    _quantity("lat_deg", "angle", "lat latitude latitudewgs84"),
    _quantity("lon_deg", "angle", "lon long longitude lng longitudewgs84"),
    _quantity("alt_m", "length", "alt altitude geoaltitude geometricaltitude altgeom heightellipsoid height hae"),
    _quantity("pressure_alt_m", "length", "pressurealtitude baroaltitude altbaro baroalt flightlevelaltitude"),
    _quantity("x_m", "length", "x east e xeast easting xpos posx"),
    _quantity("y_m", "length", "y north n ynorth northing ypos posy"),
    _quantity("z_m", "length", "z up"),
    _quantity("range_m", "length", "range rng rho distance dist slantrange r"),
    _quantity(
        "bearing_deg",
        "angle",
        "bearing brg azimuth az theta truebearing truebrg bearingtrue brgtrue bearingt brgt bearingdegt",
    ),
    _quantity("elevation_deg", "angle", "elevation el elev"),
    _quantity("station_lat_deg", "angle", "stationlat sensorlat ownlat ownshiplat"),
    _quantity("station_lon_deg", "angle", "stationlon sensorlon ownlon ownshiplon"),
    _quantity("station_x_m", "length", "stationx sensorx ownx ownshipx"),
    _quantity("station_y_m", "length", "stationy sensory owny ownshipy"),
    _quantity("speed_m_per_s", "speed", "sog speed groundspeed gs velocity speedoverground"),
    _quantity("course_deg", "angle", "cog course courseoverground track trackangle direction"),
    _quantity("heading_deg", "angle", "heading hdg trueheading"),
    _quantity("vx_m_per_s", "speed", "vx ve veast velx velocityx xvel vele xspeed xdot"),
    _quantity("vy_m_per_s", "speed", "vy vn vnorth vely velocityy yvel veln yspeed ydot"),
    _quantity("climb_m_per_s", "speed", "climb verticalrate vertrate rocd vrate vz"),
    _quantity("sigma_m", "length", "sigma sigmapos sigmaposition positionsigma poserror accuracy std stddev"),
    _quantity("sigma_x_m", "length", "sigmax sx stdx xstd xsigma xerr sigmaeast sigmae"),
    _quantity("sigma_y_m", "length", "sigmay sy stdy ystd ysigma yerr sigmanorth sigman"),
    _quantity("cov_xx", "variance", "covxx covee pxx varx xvar covarxx"),
    _quantity("cov_xy", "variance", "covxy coven pxy covarxy covyx"),
    _quantity("cov_yy", "variance", "covyy covnn pyy vary yvar covaryy"),
    _quantity("cov_vxvx", "speed variance", "covvxvx varvx vxvar"),
    _quantity("cov_vxvy", "speed variance", "covvxvy"),
    _quantity("cov_vyvy", "speed variance", "covvyvy varvy vyvar"),
    _quantity("sigma_vx", "speed", "sigmavx stdvx vxstd vxsigma sigmave"),
    _quantity("sigma_vy", "speed", "sigmavy stdvy vystd vysigma sigmavn"),
    _quantity("sigma_alt_m", "length", "sigmaalt sigmaz altsigma sigmaaltitude altstd"),
    _quantity("sigma_range_m", "length", "sigmarange rangesigma rangestd stdrange sigmar"),
    _quantity("sigma_bearing_deg", "angle", "sigmabearing bearingsigma bearingstd sigmaazimuth azimuthsigma sigmaaz"),
    _quantity("sigma_elevation_deg", "angle", "sigmaelevation elevationsigma sigmael"),
    _quantity(
        "track_id",
        "text",
        "trackid tracknumber trackno tracknum id targetid target targetno targetnumber tgt tgtid tgtno trkid trkno "
        "tracknr targetnr objectid uid shipid vesselid",
    ),
    _quantity("mmsi", "text", "mmsi sourcemmsi"),
    _quantity("imo", "text", "imo imonumber"),
    _quantity("icao", "text", "icao24 icao icaoaddress hex modes modesaddress"),
    _quantity("callsign", "text", "callsign flight"),
    _quantity("mode_a", "text", "squawk modea mode3a modea3"),
    _quantity("name", "text", "name vesselname shipname"),
    _quantity("type", "text", "type vesseltype shiptype typecode"),
    _quantity("length_m", "length", "length loa"),
    _quantity("width_m", "length", "width beam"),
    *(
        _quantity(f"to_{side}_m", "length", f"to{side} {side} dim{letter} dimension{letter} size{letter} {letter}")
        for side, letter in zip(SIDES, "abcd", strict=True)
    ),
)
#: Places of the antenna on the hull, A to D in AIS: other tables call other things by these letters.
_OF_THE_ANTENNA = tuple(f"to_{side}_m" for side in SIDES)
#: Conventional units where none is stated: sentence, columns or kind of source that indicate it, names, unit.
_CONVENTIONS = (
    ("ship speeds are knots", ("mmsi", "sourcemmsi", "imo", "ais"), ("sog", "speed", "speedoverground"), "kn"),
    ("speeds over ground (sog) are knots", ("sog", "speedoverground"), ("sog", "speedoverground"), "kn"),
    ("speeds of aircraft are knots", ("groundspeed", "gs"), ("groundspeed", "gs"), "kn"),
    ("altitudes are feet", ("groundspeed", "gs"), ("altitude", "alt", "geoaltitude", "altgeom", "altbaro",
                                                   "baroaltitude"), "ft"),
    ("vertical rates are feet a minute", ("groundspeed", "gs"), ("verticalrate", "rocd", "vertrate"), "fpm"),
    ("speeds are knots in tables of flightradar24", ("direction",), ("speed",), "kn"),
    ("altitudes are feet in tables of flightradar24", ("direction",), ("altitude",), "ft"),
)  # fmt: skip


@dataclass(frozen=True)
class Choice:
    """One recognised column: its name in the table, its quantity, and the factor of its unit to ours."""

    name: str
    quantity: SensorQuantity
    factor: float
    why: str

    @property
    def translated(self) -> bool:
        """Whether its name is in another language than English."""
        return _stem(self.name)[0] in self.quantity.translations


def choose(
    names: Sequence[str],
    source: str,
    named: Mapping[str, str] | None = None,
    units: Mapping[str, str] | None = None,
    kind: str | None = None,
) -> dict[str, Choice]:
    """The recognised columns, by their column in Reports.

    Parameters
    ----------
    names : of the table's columns.
    source : its name in messages.
    named : name of the column of a quantity (``lat_deg``, ``time_s`` …); None: the table does not have it.
    units : unit of a column, by its name in the table.
    kind : of the source, if known: speeds of AIS are knots.

    Raises
    ------
    InputError : two columns of equal rank, an unknown name or unit.
    """
    named, units = dict(named or {}), dict(units or {})
    _check_named(names, source, named, units)
    stems = {name: _stem(name) for name in names}
    signs = {stem for stem, _ in stems.values()} | {kind or ""}
    taken = set(named.values())
    chosen: dict[str, Choice] = {}
    for quantity in _quantities(stems):
        if quantity.column in named:
            if named[quantity.column]:
                chosen[quantity.column] = _choice(
                    named[quantity.column], quantity, stems[named[quantity.column]], units, signs, source
                )
            continue
        candidates = [name for name in names if name not in taken and _rank(name, quantity, stems) is not None]
        if candidates:
            best = min(_rank(name, quantity, stems) or 0 for name in candidates)
            equal = [name for name in candidates if _rank(name, quantity, stems) == best]
            if len(equal) > 1:
                listed = ", ".join(map(repr, equal))
                raise InputError(
                    f"{source}: {len(equal)} columns may be {quantity.column}: {listed}",
                    naming_columns(quantity.column),
                )
            chosen[quantity.column] = _choice(equal[0], quantity, stems[equal[0]], units, signs, source)
            taken.add(equal[0])
    if not (kind == "ais" or "mmsi" in chosen):
        chosen = {column: choice for column, choice in chosen.items() if column not in _OF_THE_ANTENNA}
    return _with_courses(chosen, stems)


def _quantities(stems: Mapping[str, tuple[str, str]]) -> tuple[SensorQuantity, ...]:
    """The quantities with the names that are certain in this table, those of other languages after the English ones."""
    known = {q.column for q in QUANTITIES if any(_rank(name, q, stems) is not None for name in stems)}
    more = names_in({stem for stem, _ in stems.values()}, known)
    return tuple(replace(quantity, translations=more.get(quantity.column, ())) for quantity in QUANTITIES)


def naming_columns(*quantities: str) -> Message:
    """The remedy: name the columns of these quantities."""
    return Message("give ", Argument("columns", "NAME", quantities))


def _check_named(names: Sequence[str], source: str, named: Mapping[str, str], units: Mapping[str, str]) -> None:
    quantities = {quantity.column for quantity in QUANTITIES}
    for column in named:
        if column not in quantities:
            near = difflib.get_close_matches(column, sorted(quantities), n=3)
            raise InputError(f"{source}: {column!r} is not a quantity; did you mean {' or '.join(near) or 'lat_deg'}?")
    for name in [*(name for name in named.values() if name), *units]:
        if name not in names:
            raise InputError(f"{source}: no column {name!r} among: {', '.join(names)}")


def _stem(name: str) -> tuple[str, str]:
    """The name without signs and unit, and the unit at its end, or ""."""
    words = re.findall(r"[a-z0-9]+", plain(re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name).replace("²", "2")))
    known_units = {unit for kinds in UNITS.values() for unit in kinds}
    for count in (4, 3, 2, 1):
        unit = "".join(words[-count:])
        if len(words) > count and unit in known_units:
            stem = words[:-count]
            # "Speed in kn", "Vitesse en noeuds".
            return "".join(stem[:-1] if len(stem) > 1 and stem[-1] in ("in", "en", "em", "i") else stem), unit
    return "".join(words), ""


def _rank(name: str, quantity: SensorQuantity, stems: Mapping[str, tuple[str, str]]) -> int | None:
    """The rank of a name for a quantity, 0 for the best; None where it does not match."""
    whole = "".join(stems[name])
    stem, unit = stems[name]
    for rank, known in enumerate((*quantity.names, *quantity.translations)):
        if whole == known or (stem == known and unit in UNITS[quantity.kind]):
            return rank
    return None


def _choice(
    name: str,
    quantity: SensorQuantity,
    stem_and_unit: tuple[str, str],
    units: Mapping[str, str],
    signs: AbstractSet[str],
    source: str,
) -> Choice:
    """The column with its unit: as said, as its name states, or by a convention that the signs (stems of the columns,
    kind of the source) indicate."""
    factors = UNITS[quantity.kind]
    if name in units:
        unit = re.sub(r"[^a-z0-9]", "", units[name].lower())
        if unit not in factors:
            raise InputError(f"{source}: column {name!r}: unit {units[name]!r} is none of {', '.join(factors)}")
        return Choice(name, quantity, factors[unit], f"{name} is in {units[name]}, as said")
    stem, unit = stem_and_unit
    if unit in factors and stem + unit not in quantity.names:
        return Choice(name, quantity, factors[unit], "")
    if stem in quantity.translations and quantity.column == "speed_m_per_s":
        stem = "speed"
    for why, indicators, applies, unit in _CONVENTIONS:
        if stem in applies and unit in factors and not signs.isdisjoint(indicators):
            return Choice(name, quantity, factors[unit], f"{name} is read in {unit}: {why}")
    if quantity.column in ("length_m", "width_m", *_OF_THE_ANTENNA):
        return Choice(name, quantity, 1.0, "")  # of ships, in metres everywhere
    # Angles without a unit are degrees everywhere.
    our_unit = {"length": "m", "speed": "m/s", "variance": "m²", "speed variance": "m²/s²"}.get(quantity.kind)
    return Choice(name, quantity, 1.0, f"{name} is read in {our_unit}: its name states no unit" if our_unit else "")


def _with_courses(chosen: dict[str, Choice], stems: Mapping[str, tuple[str, str]]) -> dict[str, Choice]:
    """Corrects ambiguous names of courses.

    "track" is a course in tables with speeds, and a track number in others and beside another course; "heading" in
    OpenSky's state vectors is the course over ground.
    """
    course, heading = chosen.get("course_deg"), chosen.get("heading_deg")
    opensky = any(stems[name][0] == "lastposupdate" for name in stems)
    if heading and course is None and opensky:
        quantity = next(q for q in QUANTITIES if q.column == "course_deg")
        why = f"{heading.name} is read as the course, as in OpenSky's states"
        chosen["course_deg"] = Choice(chosen.pop("heading_deg").name, quantity, heading.factor, why)
        return chosen
    track = next((name for name in stems if "".join(stems[name]) == "track"), None)
    if track is None:
        return chosen
    named = not {"track_id", "mmsi", "icao", "callsign"}.isdisjoint(chosen)
    if course and course.name == track:
        if "speed_m_per_s" in chosen:
            why = f"{track} is read as the course of the speeds; if it is the number of a track, name it track_id"
            return chosen if named else chosen | {"course_deg": replace(course, why=why)}
        del chosen["course_deg"]
    elif named:
        return chosen
    if "track_id" not in chosen and all(choice.name != track for choice in chosen.values()):
        quantity = next(q for q in QUANTITIES if q.column == "track_id")
        chosen["track_id"] = Choice(track, quantity, 1.0, f"{track} is read as a track number")
    return chosen


_NULLS = {"", "null", "none", "na", "n/a", "-", "--", "nan", "unknown", "undefined"}
#: Quantities of which a report has one at least.
_PLACES = {"lat_deg", "x_m", "range_m", "bearing_deg"}
#: Columns with latitude and longitude in one cell.
_POSITIONS = ("position", "latlon", "latlong", "latlng", "coordinates")
#: Columns of tables whose dates like 01/05/2024 have the day first: Danish AIS.
_DAY_FIRST_TABLES = ("typeofmobile",)
#: Number of unused columns that are listed.
_LISTED = 12
_DELIMITERS = ",;\t|"
_DAY_FIRST = re.compile(r"(\d{1,2})[/.-](\d{1,2})[/.-](\d{4})[ T]+(\d{1,2}):(\d{2})(?::(\d{2}(?:\.\d+)?))?")
#: Numbers with a decimal comma or none, and with a decimal point.
_COMMA, _POINT = re.compile(r"\s*[+-]?\d+(,\d+)?\s*"), re.compile(r"\s*[+-]?\d+\.\d+\s*")
#: MMSI of base stations (00 and the country) and aids to navigation.
_STATION = re.compile("00[2-7]|99[2-7]")
_OF_DAY = re.compile(r"(\d{1,2}):(\d{2}):(\d{2}(?:\.\d+)?)")


#: Number of cells always read from a Parquet file, however small: it compresses equal cells (1 GB as Python lists).
_CELLS = 1 << 24


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

    unended : whether the last line has no line end.
    """

    columns: Mapping[str, Sequence[Any]]
    lines: IntArray
    damaged: tuple[tuple[int, str], ...] = ()
    unended: bool = False


def cells_of_csv(lines: Sequence[str], source: str) -> TableText:
    """The cells of lines separated by commas, semicolons, tabs or bars (ECSV: also blanks). Lines that begin with # are
    comments."""
    ecsv = bool(lines) and lines[0].startswith(ECSV)
    # A comment with the delimiter of the rows may be the line of names, as in Danish AIS.
    number = next(
        (
            k
            for k, line in enumerate(lines, start=1)
            if line.strip() and (line[0] != "#" or (_delimiter_of(line) and not ecsv))
        ),
        1,
    )
    header = lines[number - 1].lstrip("# ")
    delimiter = _delimiter_of(header) or (" " if ecsv else "")
    if not delimiter:
        raise InputError(f"{source}: no format of sensors fits; as a table, its line {number} does not name columns")
    names = [name.strip() for name in next(csv.reader([header], delimiter=delimiter))]
    check_columns(len(names), source)
    counts = Counter(names)
    duplicates = [name for name in names if counts[name] > 1]
    if duplicates:
        raise InputError(f"{source}: two columns are called {duplicates[0]}; rename one")
    rows: list[list[str]] = []
    line_numbers: list[int] = []
    damaged: list[tuple[int, str]] = []
    reader = csv.reader(io.StringIO("\n".join(lines[number:])), delimiter=delimiter)
    for row in reader:
        line = number + reader.line_num
        if not row or row[0].startswith("#"):
            continue
        if len(row) == len(names):
            rows.append(row)
            line_numbers.append(line)
        else:
            damaged.append((line, f"has not {len(names)} cells"))
    columns: dict[str, Sequence[Any]] = dict(
        zip(names, zip(*rows, strict=True) if rows else [()] * len(names), strict=True)
    )
    if delimiter != "," and any("," in line for line in lines[number:]):
        columns = _with_points(columns)
    return TableText(columns, np.array(line_numbers, np.int64), tuple(damaged))


def _with_points(columns: Mapping[str, Sequence[Any]]) -> dict[str, Sequence[Any]]:
    """The columns with decimal points for decimal commas, unless any number of the table has a point: then a comma may
    separate thousands. Changes columns of numbers only."""
    if any(_POINT.fullmatch(cell) for cells in columns.values() for cell in cells):
        return dict(columns)
    numbers = {
        name
        for name, cells in columns.items()
        if all(_COMMA.fullmatch(cell) or cell.strip().lower() in _NULLS for cell in cells)
    }
    return {
        name: tuple(cell.replace(",", ".") for cell in cells) if name in numbers else cells
        for name, cells in columns.items()
    }


def cells_of_json(lines: Sequence[str], source: str) -> TableText:
    """The cells of JSON objects, one per line or in one list; nested objects are flattened."""
    rows: list[dict[str, Any]] = []
    line_numbers: list[int] = []
    damaged: list[tuple[int, str]] = []
    try:
        document = of_json("\n".join(lines))
        objects = list(enumerate(_records(document), start=1))
    except ValueError:
        objects = json_lines(lines, damaged)
    for number, value in objects:
        if isinstance(value, dict):
            rows.append(_flattened(value))
            line_numbers.append(number)
        else:
            damaged.append((number, "no JSON object"))
    names = list(dict.fromkeys(name for row in rows for name in row))
    if not names:
        raise InputError(f"{source}: no JSON object with columns")
    check_columns(len(names), source)

    def column(name: str) -> list[Any]:
        return [row.get(name) for row in rows]

    return TableText(_LazyColumns(names, column), np.array(line_numbers, np.int64), tuple(damaged))


def _records(document: Any) -> list[Any]:
    """The records of a JSON document: itself, the items of its list, or those of the only list of objects in it, as of
    servers that put their answer beside a state. A report may have a list of objects too, such as its tracks."""
    if not isinstance(document, list | dict) or (isinstance(document, dict) and _has_position(document)):
        return [document]
    inner = [value for value in (document if isinstance(document, list) else document.values()) if _is_records(value)]
    if len(inner) == 1:
        return list(inner[0])
    return document if isinstance(document, list) else [document]


def _has_position(value: Mapping[str, Any]) -> bool:
    stems = {name: _stem(name) for name in _flattened(value)}
    places = [quantity for quantity in QUANTITIES if quantity.column in _PLACES]
    return any(_rank(name, quantity, stems) is not None for name in stems for quantity in places)


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

    return TableText(_LazyColumns(names, column), np.arange(1, table.num_rows + 1))


def read(cells: TableText, source: str, options: ReadOptions | None = None) -> Reports:
    """The reports of a table.

    Parameters
    ----------
    cells : of the table.
    source : its name in messages; it may show the kind of the source.
    options : what the table does not contain.

    Raises
    ------
    InputError : no time; no position; two columns of one quantity; every row damaged; dates of two readings.
    """
    options = options or ReadOptions()
    kind = options.kind or kind_by_name(source)
    cells = _with_split_positions(cells)
    chosen = choose(list(cells.columns), source, options.columns, options.units, kind)
    _check_chosen(chosen, list(cells.columns), source)
    if not len(cells.lines):
        reasons = "; ".join(Damaged.of(cells.damaged).sentences())
        raise InputError(f"{source}: names columns, but has no row that can be used{': ' * bool(reasons)}{reasons}")
    damaged = dict(cells.damaged)
    is_ais = "mmsi" in chosen or kind == "ais"
    if is_ais:
        cells, chosen = _with_flagged_errors(cells, chosen)
    values = {
        name: _values(cells, choice, damaged) for name, choice in chosen.items() if name not in ("time_s", "day_s")
    }
    marks = _mark_unavailable(values, chosen, is_ais)
    start_s = start_seconds(options.start, source)
    values["time_s"], note = _times(cells, chosen, source, start_s, damaged, options.time_zone)
    _mark_unusable(values, cells.lines, damaged)
    good = ~np.isin(cells.lines, list(damaged))
    if not good.any():
        raise InputError(f"{source}: no row can be used: {'; '.join(Damaged.of(damaged.items()).sentences())}")
    values = {name: column[good] for name, column in values.items()} | {"line": cells.lines[good]}
    values, stations = _without_stations(values)
    values, repeated = _without_repeats(_with_track_id(values))
    counts = {"base station or aid to navigation": stations, "position repeated": repeated}
    passed_over = {what: count for what, count in counts.items() if count}
    unavailable = [f"{source}: {one}" for one in marks]
    truncated = [f"{source}: its last line has no line end: it may be incomplete"] * cells.unended
    notes = [note, *truncated, *unavailable, *(f"{source}: {choice.why}" for choice in chosen.values() if choice.why)]
    if translated := [f"{c.name} as {c.quantity.column}" for c in chosen.values() if c.translated]:
        notes.append(f"{source}: columns read by their names: {', '.join(translated)}")
    used = {choice.name for choice in chosen.values()}
    unused = [name for name in cells.columns if name not in used and plain(name) not in (*DATES, *HOURS)]
    if unused:
        more = f" and {len(unused) - _LISTED} more" if len(unused) > _LISTED else ""
        notes.append(f"{source}: columns not used: {', '.join(unused[:_LISTED])}{more}")
    values = _with_covariances(values)
    sides = [values.pop(f"to_{side}_m", None) for side in SIDES]
    if is_ais and "lat_deg" in values:
        angles = {
            name: np.where((values[name] >= 0.0) & (values[name] < 360.0), values[name], np.nan)
            for name in ("heading_deg", "course_deg") if name in values
        }  # fmt: skip
        centred, hulls = at_hull_centres(values | angles, sides)
        values = centred | {name: values[name] for name in angles}
        notes += [f"{source}: {one}" for one in hulls]
    return Reports.of(
        source, "table", values, damaged=Damaged.of(damaged.items()),
        passed_over=passed_over, notes=notes,
    )  # fmt: skip


def _with_split_positions(cells: TableText) -> TableText:
    """The table with a latitude and a longitude instead of positions in one column, as "55.5,12.25"."""
    for name in cells.columns:
        if "".join(_stem(name)) in _POSITIONS:
            column = cells.columns[name]
            parts = [cell.partition(",") if isinstance(cell, str) else ("", "", "") for cell in column]
            if any(comma for _, comma, _ in parts):
                others = {other: values for other, values in cells.columns.items() if other != name}
                places = {"latitude": [lat for lat, _, _ in parts], "longitude": [lon for _, _, lon in parts]}
                return replace(cells, columns=others | places)
    return cells


def _with_flagged_errors(cells: TableText, chosen: dict[str, Choice]) -> tuple[TableText, dict[str, Choice]]:
    """The table with errors in metres instead of the accuracy flag of AIS, if its column of errors has only 0 and 1."""
    choice = chosen.get("sigma_m")
    if choice is None:
        return cells, chosen
    flags = ["" if cell is None else str(cell).strip().lower() for cell in cells.columns[choice.name]]
    is_set, is_not = {"1", "1.0", "true"}, {"0", "0.0", "false", *_NULLS}
    if not is_set | is_not >= set(flags):
        return cells, chosen
    errors = [AIS_SIGMA_M[flag in is_set] for flag in flags]
    why = f"{choice.name} is the accuracy flag of AIS: {AIS_SIGMA_M[True]:g} m per axis where it is set, "
    why += f"{AIS_SIGMA_M[False]:g} m where not"
    others = {name: cells.columns[name] for name in cells.columns if name != choice.name}
    return (
        replace(cells, columns=others | {choice.name: errors}),
        chosen | {"sigma_m": replace(choice, factor=1.0, why=why)},
    )


def _delimiter_of(line: str) -> str:
    """The delimiter in a line; "" where there is none."""
    return next((sign for sign in _DELIMITERS if sign in line), "")


def _flattened(nested: Mapping[str, Any]) -> dict[str, Any]:
    row: dict[str, Any] = {}
    for name, value in nested.items():
        for inner, cell in value.items() if isinstance(value, dict) else [(name, value)]:
            row[inner if inner not in row else f"{name}_{inner}"] = None if isinstance(cell, dict | list) else cell
    return row


def _check_chosen(chosen: Mapping[str, Choice], names: Sequence[str], source: str) -> None:
    """Refuses a table without times or positions; the message names all that is missing at once."""
    listed = ", ".join(names)
    times = () if {"time_s", "day_s"} & set(chosen) else ("time_s",)
    words = "time and " if times else ""
    for pair in (("lat_deg", "lon_deg"), ("x_m", "y_m")):
        if (pair[0] in chosen) != (pair[1] in chosen):
            missing = pair[0] if pair[1] in chosen else pair[1]
            raise InputError(
                f"{source}: no column of {words}{missing} among: {listed}", naming_columns(*times, missing)
            )
    if "range_m" in chosen and not {"lat_deg", "x_m", "bearing_deg"} & set(chosen):
        raise InputError(
            f"{source}: ranges ({chosen['range_m'].name}), but no column of {words}bearings among: {listed}",
            naming_columns(*times, "bearing_deg"),
        )
    if not {"lat_deg", "x_m", "bearing_deg"} & set(chosen):
        raise InputError(
            f"{source}: no columns of {words}a position among: {listed}",
            Message(naming_columns(*times, "lat_deg", "lon_deg"), ", or those of x_m and y_m, range_m and bearing_deg"),
        )
    if times:
        raise InputError(f"{source}: no column of time among: {listed}", naming_columns("time_s"))


def _values(cells: TableText, choice: Choice, damaged: dict[int, str]) -> NDArray[Any]:
    """A column in SI units or degrees; lines with cells that are not numbers become damaged."""
    column = cells.columns[choice.name]
    if choice.quantity.kind == "text":
        return _texts(column, choice.quantity.column)
    try:
        return np.array(column, dtype=np.float64) * choice.factor
    except (TypeError, ValueError, OverflowError):
        pass
    values = np.full(len(column), np.nan)
    is_place = choice.quantity.column in ("lat_deg", "lon_deg")
    for k, cell in enumerate(column):
        if cell is None or str(cell).strip().lower() in _NULLS:
            continue
        try:
            values[k] = float(cell) * choice.factor
        except (TypeError, ValueError, OverflowError):
            values[k] = _degrees(str(cell)) if is_place else math.nan
            if math.isnan(values[k]):
                damaged.setdefault(int(cells.lines[k]), f"{choice.name} is no number")
    return values


#: The offset of a time zone at the end of ISO text; Z is UTC.
_ZONE = re.compile(r"T.*[+-]\d\d:?\d\d$| .*:\d\d[+-]\d\d:?\d\d$")
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
    texts: list[str | None] = []
    for cell in column:
        if isinstance(cell, float):
            cell = None if np.isnan(cell) else (int(cell) if cell.is_integer() else cell)
        text = "" if cell is None else str(cell).strip()
        if text.lower() in _NULLS:
            texts.append(None)
            continue
        if quantity in ("mmsi", "mode_a", "imo") and re.fullmatch(r"\d+\.0*", text):
            text = text.split(".")[0]
        if quantity == "mode_a" and text.isdigit():
            text = text.zfill(4)
        if quantity == "mmsi" and text.isdigit():
            text = text.zfill(9)
        texts.append(text.lower() if quantity == "icao" else text)
    return np.array([*texts, None], object)[:-1]


def _times(
    cells: TableText,
    chosen: Mapping[str, Choice],
    source: str,
    start_s: float | None,
    damaged: dict[int, str],
    time_zone: str | None,
) -> tuple[FloatArray, str]:
    """The time of each row, and a note on its interpretation."""
    choice = chosen.get("time_s") or chosen["day_s"]
    column = list(cells.columns[choice.name])
    known = (*choice.quantity.names, *choice.quantity.translations)
    parts = [
        next((name for word in words for name in cells.columns if plain(name) == word), None)
        for words in (DATES, [word for word in HOURS if word in known])
    ]
    if choice.name in parts and None not in parts:
        days, hours = (cells.columns[str(part)] for part in parts)
        column = [f"{day} {hour}" for day, hour in zip(days, hours, strict=True)]
    if choice.quantity.column == "time_s":
        # Of the languages that are read, only English has the month first.
        day_first = any("".join(_stem(name)) in _DAY_FIRST_TABLES for name in cells.columns)
        day_first = day_first or any(one.translated for one in chosen.values())
        times = _instants(column, choice, source, start_s, day_first)
        if np.isfinite(times).any():
            _mark(np.isnan(times), cells.lines, damaged, "no time")
            low = float(np.nanmax(np.abs(times))) < 1e8
            if low:
                note = "seconds from an origin of its own: all sources must use the same origin"
                return times, f"{source}: {choice.name} is read as {note}"
            offset, local = _zones(column)
            times[local] = utc_of(times[local], time_zone)
            zone = "UTC" if time_zone is None or not local.any() else f"the time of {time_zone}"
            if offset.any():
                others = f" that {offset.sum()} of {len(column)} rows state, the others as {zone}"
                zone = "the time of its stated zone" if offset.all() else f"the time of the zone{others}"
            return times, f"{source}: {choice.name} is read as {zone}"
    times = np.array([_seconds_of_day(cell) for cell in column])
    _mark(np.isnan(times), cells.lines, damaged, "no time")
    if not np.isfinite(times).any():
        raise InputError(
            f"{source}: no time can be read in column {choice.name!r} (first: {column[0]!r}); write ISO 8601"
        )
    if start_s is None:
        raise InputError(
            f"{source}: {choice.name!r} has the time of day only", naming("give {start}, the UTC date of the first row")
        )
    # The start is UTC, the times are of the zone.
    start_s += start_s - float(utc_of(np.array([start_s]), time_zone)[0])
    zone = time_zone or "UTC"
    note = f"{source}: {choice.name} is read as {zone} time of day, counted on from the start"
    return utc_of(unwrapped(times, DAY_S, start_s), time_zone), note


def _zones(column: Sequence[Any]) -> tuple[BoolArray, BoolArray]:
    """(n,) whether a cell states an offset from UTC, and whether it is a clock time without a zone."""
    texts = ["" if cell is None or isinstance(cell, (int, float)) else str(cell).strip() for cell in column]
    offset = np.array([_ZONE.search(text) is not None for text in texts], bool)
    local = np.array([":" in text and re.search(r"(?i)(Z|UTC|GMT)$", text) is None for text in texts], bool)
    return offset, local & ~offset


def _instants(column: Sequence[Any], choice: Choice, source: str, start_s: float | None, day_first: bool) -> FloatArray:
    """Times in seconds, from numbers, ISO text or dates like 13/01/2024; NaN where a cell is none of these.

    day_first : whether dates of two readings have the day first.
    """
    try:
        numbers = np.array(column, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        texts = ["" if cell is None else str(cell).strip() for cell in column]
        if any(_DAY_FIRST.fullmatch(text) for text in texts[:100]):
            return _day_month_dates(texts, source, start_s, day_first)
        return np.array([np.nan if (time_s := instant(text)) is None else time_s for text in texts])
    if choice.factor in (1.0, 0.0):
        return np.array([seconds(number) for number in numbers])
    return numbers * choice.factor


def _day_month_dates(texts: Sequence[str], source: str, start_s: float | None, always_day_first: bool) -> FloatArray:
    """Times from dates like 13/01/2024 12:00:00. A number above 12 shows which one is the day, else the kind of table
    does, the start, or points between the numbers: these are written day first (DIN 5008, and wherever dates have
    points)."""
    day_first, month_first = (np.array([_of_date(text, day) for text in texts]) for day in (1, 2))
    readable = [np.isfinite(day_first), np.isfinite(month_first)]
    only = [bool((readable[k] & ~readable[1 - k]).any()) for k in (0, 1)]
    if only[0] and only[1]:
        raise InputError(f"{source}: some dates have the day first, others the month", "write them as 2024-01-13")
    if only[0] or only[1]:
        return day_first if only[0] else month_first
    if not np.array_equal(day_first, month_first, equal_nan=True):
        if always_day_first or (start_s is None and all("." in text[:3] for text in texts if text)):
            return day_first
        if start_s is None:
            example = next(text for text in texts if _DAY_FIRST.fullmatch(text))
            raise InputError(
                f"{source}: dates like {example!r} can be read in two ways",
                naming("give {start}, the UTC date of the first row, or write them as 2024-01-13"),
            )
        return min(day_first, month_first, key=lambda times: abs(float(times[np.isfinite(times)][0]) - start_s))
    return day_first


def _of_date(text: str, day: int) -> float:
    """The time of a date like 13/01/2024 12:00:00 whose ``day``-th number is the day; NaN where it is none."""
    match = _DAY_FIRST.fullmatch(text)
    if match is None:
        return np.nan
    try:
        moment = datetime(int(match[3]), int(match[3 - day]), int(match[day]), int(match[4]), int(match[5]), tzinfo=UTC)
    except ValueError:
        return np.nan
    return moment.timestamp() + float(match[6] or 0.0)


def _seconds_of_day(cell: str | SupportsFloat) -> float:
    match = _OF_DAY.fullmatch(str(cell).strip())
    if match:
        return 3600.0 * int(match[1]) + 60.0 * int(match[2]) + float(match[3])
    try:
        return float(cell)
    except (TypeError, ValueError, OverflowError):
        return np.nan


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
    −999 or 9999, that is the most frequent value of its column; and heights that are all 0.
    """
    sentences = []
    for name, column in values.items():
        if column.dtype.kind != "f" or not len(column):
            continue
        given = column / chosen[name].factor
        missing = np.isin(np.round(given, 4), _OF_AIS.get(name, ())) if is_ais else np.zeros(len(column), bool)
        missing |= np.isin(np.round(given, 4), _nines(given))
        missing |= is_impossible(name, column)
        missing |= is_ais and name == "speed_m_per_s" and column > FASTEST_AIS_M_PER_S
        missing |= name in ("heading_deg", "course_deg", "bearing_deg") and given == 511.0
        if name in ("alt_m", "pressure_alt_m") and len(column) >= _NINES and not np.nan_to_num(column).any():
            missing = column == 0.0
        if missing.any():
            values[name] = np.where(missing, np.nan, column)
            which = ", ".join(f"{value:g}" for value in np.unique(given[missing])[:3].tolist())
            sentences.append(
                f"{chosen[name].name}: {counted(int(missing.sum()), 'value')} of {which} not used: missing"
            )
    return sentences


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


def _mark_unusable(values: Mapping[str, Any], lines: IntArray, damaged: dict[int, str]) -> None:
    """Marks rows without a position, or with an impossible one, as damaged."""
    pairs = [pair for pair in (("lat_deg", "lon_deg"), ("x_m", "y_m"), ("bearing_deg",)) if pair[0] in values]
    missing = np.logical_and.reduce([np.isnan(sum(values[name] for name in pair)) for pair in pairs])
    _mark(missing, lines, damaged, "no position")
    if "range_m" in values:
        _mark(values["range_m"] < 0.0, lines, damaged, "a distance below 0")
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
    ships = np.array([one is None or _STATION.match(one) is None for one in values["mmsi"]])
    if ships.all() or not ships.any():
        return values, 0
    return {name: column[ships] for name, column in values.items()}, int(np.count_nonzero(~ships))


def _with_track_id(values: dict[str, Any]) -> dict[str, Any]:
    """The values with a track id; where the table has none, MMSI or ICAO address."""
    own = next((name for name in ("mmsi", "icao") if name in values), None)
    return values if "track_id" in values or own is None else values | {"track_id": values[own]}


def _without_repeats(values: dict[str, Any]) -> tuple[dict[str, Any], int]:
    """The values without repeated rows (same object, time and position), and the number of these."""
    if "track_id" not in values:
        return values, 0
    position = next(pair for pair in (("lat_deg", "lon_deg"), ("x_m", "y_m"), ("bearing_deg",)) if pair[0] in values)
    rows_read: set[tuple[Any, ...]] = set()
    first = np.ones(len(values["time_s"]), bool)
    for k, key in enumerate(zip(*(values[name].tolist() for name in ("track_id", "time_s", *position)), strict=True)):
        first[k] = key[0] is None or key not in rows_read
        rows_read.add(key)
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


PARQUET, ECSV = b"PAR1", "# %ECSV"


def _of_windows(file: SensorFile) -> SensorFile:
    """The file in UTF-8, where its text has other letters and is that of Windows (code page 1252), as Excel writes."""
    try:
        file.content.decode("utf-8")
    except UnicodeDecodeError:
        with suppress(UnicodeDecodeError):
            return replace(file, content=file.content.decode("cp1252").encode())
    return file


def _cells_of(file: SensorFile) -> TableText:
    if file.content.startswith(PARQUET):
        return cells_of_parquet(file.path)
    file = _of_windows(file)
    first = next((line.strip() for line in file.lines if line.strip()), "")
    # The first line of a log may be truncated.
    if first[:1] in "{[" or file.share_of_lines(r"\{.*") > 0.5:
        return cells_of_json(file.lines, file.source)
    return replace(cells_of_csv(file.lines, file.source), unended=file.unended)


FORMAT = SensorFormat(
    "table",
    "CSV, Parquet or JSON lines with columns recognized by their names",
    lambda file: [read(_cells_of(file), file.source, file.options)],
    # Zero bytes are in damaged logs of sentences, never in a table.
    lambda file: b"\0" not in file.head,
    magic=(PARQUET,),
)

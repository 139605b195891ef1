"""Columns: which column of a table is which quantity, in which unit, and why.

Names are compared without case, blanks and signs, less a unit at their end: ``SOG_knots``, ``sog (kn)`` and ``SOG`` are
the same column. The user's own choice wins. Two columns that are equally good are refused with the choices.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from sameas.errors import Argument, InputError, Message
from sameas.io.sensors.clock import FEET_PER_MINUTE_M_PER_S, FOOT_M, KNOT_M_PER_S, MILE_M

#: Units by kind of quantity: as written at the end of a name, and their factor to our unit.
UNITS: Mapping[str, Mapping[str, float]] = {
    "length": {"m": 1.0, "metres": 1.0, "meters": 1.0, "metre": 1.0, "meter": 1.0, "km": 1000.0, "ft": FOOT_M,
               "feet": FOOT_M, "nm": MILE_M, "nmi": MILE_M, "cm": 0.01, "mm": 0.001},
    "angle": {"deg": 1.0, "degrees": 1.0, "degree": 1.0, "rad": 57.29577951308232, "radians": 57.29577951308232,
              "mrad": 0.05729577951308232},
    "speed": {"mps": 1.0, "ms": 1.0, "mpers": 1.0, "msec": 1.0, "kn": KNOT_M_PER_S, "kt": KNOT_M_PER_S,
              "kts": KNOT_M_PER_S, "knots": KNOT_M_PER_S, "knot": KNOT_M_PER_S, "kmh": 1.0 / 3.6, "kph": 1.0 / 3.6,
              "kmperh": 1.0 / 3.6, "mph": 0.44704, "fpm": FEET_PER_MINUTE_M_PER_S, "ftmin": FEET_PER_MINUTE_M_PER_S},
    "variance": {"m2": 1.0, "km2": 1e6},
    "speed variance": {"m2s2": 1.0, "m2pers2": 1.0},
    "time": {"s": 1.0, "sec": 1.0, "seconds": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "utc": 0.0},
    "text": {},
}  # fmt: skip


@dataclass(frozen=True)
class SensorQuantity:
    """One quantity: the column of Reports it becomes, its kind, and the names under which it goes, the best first."""

    column: str
    kind: str
    names: tuple[str, ...]


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
    _quantity("bearing_deg", "angle", "bearing brg azimuth az theta"),
    _quantity("elevation_deg", "angle", "elevation el elev"),
    _quantity("station_lat_deg", "angle", "stationlat sensorlat ownlat ownshiplat"),
    _quantity("station_lon_deg", "angle", "stationlon sensorlon ownlon ownshiplon"),
    _quantity("station_x_m", "length", "stationx sensorx ownx ownshipx"),
    _quantity("station_y_m", "length", "stationy sensory owny ownshipy"),
    _quantity("speed_m_per_s", "speed", "sog speed groundspeed gs velocity speedoverground"),
    _quantity("course_deg", "angle", "cog course courseoverground track trackangle"),
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
    _quantity("track_id", "text", "trackid tracknumber trackno tracknum id targetid target targetno objectid uid"),
    _quantity("mmsi", "text", "mmsi"),
    _quantity("imo", "text", "imo imonumber"),
    _quantity("icao", "text", "icao24 icao icaoaddress hex modes modesaddress"),
    _quantity("callsign", "text", "callsign flight"),
    _quantity("mode_a", "text", "squawk modea mode3a modea3"),
    _quantity("name", "text", "name vesselname shipname"),
    _quantity("type", "text", "type vesseltype shiptype typecode"),
    _quantity("length_m", "length", "length loa"),
    _quantity("width_m", "length", "width beam"),
)
#: Unstated units: a sentence, columns that identify the habit, names with that unit, the unit.
_HABITS = (
    ("ship speeds are knots", ("mmsi", "imo"), ("sog", "speed", "speedoverground"), "kn"),
    ("speeds over ground (sog) are knots", ("sog", "speedoverground"), ("sog", "speedoverground"), "kn"),
    ("speeds of aircraft are knots", ("groundspeed", "gs"), ("groundspeed", "gs"), "kn"),
    ("altitudes are feet", ("groundspeed", "gs"), ("altitude", "alt", "geoaltitude", "altgeom", "altbaro",
                                                   "baroaltitude"), "ft"),
    ("vertical rates are feet a minute", ("groundspeed", "gs"), ("verticalrate", "rocd", "vertrate"), "fpm"),
)  # fmt: skip


@dataclass(frozen=True)
class Choice:
    """One recognised column: its name in the table, its quantity, and the factor of its unit to ours."""

    name: str
    quantity: SensorQuantity
    factor: float
    why: str


def choose(
    names: Sequence[str], source: str, named: Mapping[str, str] | None = None, units: Mapping[str, str] | None = None
) -> dict[str, Choice]:
    """Which columns are which quantities, by the column of Reports that each becomes.

    Parameters
    ----------
    names : of the table's columns.
    source : its name in messages.
    named : by quantity (``lat_deg``, ``time_s`` …) the name of the column that it is; None as name: not there.
    units : by name of a column of the table the unit that it is in.

    Raises
    ------
    InputError : two equally good columns, a name or a unit that does not exist.
    """
    named, units = dict(named or {}), dict(units or {})
    _check_named(names, source, named, units)
    stems = {name: _stem(name) for name in names}
    taken = set(named.values())
    chosen: dict[str, Choice] = {}
    for quantity in QUANTITIES:
        if quantity.column in named:
            if named[quantity.column]:
                chosen[quantity.column] = _choice(named[quantity.column], quantity, stems, units, source)
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
            chosen[quantity.column] = _choice(equal[0], quantity, stems, units, source)
            taken.add(equal[0])
    return _with_courses(chosen, stems)


def naming_columns(*quantities: str) -> Message:
    """The remedy that names the columns of quantities."""
    pairs = ", ".join(f"{quantity!r}: NAME" for quantity in quantities)
    return Message("give ", Argument("columns", f"{{{pairs}}}"))


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
    """The name without signs and unit, and the unit at its end, or an empty one."""
    words = re.findall(r"[a-z0-9]+", re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name).lower().replace("²", "2"))
    every = {unit for kinds in UNITS.values() for unit in kinds}
    for count in (4, 3, 2, 1):
        unit = "".join(words[-count:])
        if len(words) > count and unit in every:
            return "".join(words[:-count]), unit
    return "".join(words), ""


def _rank(name: str, quantity: SensorQuantity, stems: Mapping[str, tuple[str, str]]) -> int | None:
    """How well a name fits; None where it does not."""
    whole = "".join(stems[name])
    for rank, known in enumerate(quantity.names):
        stem, unit = stems[name]
        if whole == known or (stem == known and unit in UNITS[quantity.kind]):
            return rank
    return None


def _choice(
    name: str, quantity: SensorQuantity, stems: Mapping[str, tuple[str, str]], units: Mapping[str, str], source: str
) -> Choice:
    factors = UNITS[quantity.kind]
    if name in units:
        unit = re.sub(r"[^a-z0-9]", "", units[name].lower())
        if unit not in factors:
            raise InputError(f"{source}: column {name!r}: unit {units[name]!r} is none of {', '.join(factors)}")
        return Choice(name, quantity, factors[unit], f"{name} is in {units[name]}, as said")
    stem, unit = stems[name]
    if unit in factors and "".join(stems[name]) not in quantity.names:
        return Choice(name, quantity, factors[unit], "")
    for why, marks, applies, unit in _HABITS:
        if stem in applies and unit in factors and any(stems[other][0] in marks for other in stems):
            return Choice(name, quantity, factors[unit], f"{name} is read in {unit}: {why}")
    # Angles without a unit are degrees everywhere.
    our_unit = {"length": "m", "speed": "m/s", "variance": "m²", "speed variance": "m²/s²"}.get(quantity.kind)
    return Choice(name, quantity, 1.0, f"{name} is read in {our_unit}: its name states no unit" if our_unit else "")


def _with_courses(chosen: dict[str, Choice], stems: Mapping[str, tuple[str, str]]) -> dict[str, Choice]:
    """The course, where its name misleads.

    A column "track" is a course beside speeds, and the number of a track elsewhere; "heading" of OpenSky's states is
    the course over ground.
    """
    course, heading = chosen.get("course_deg"), chosen.get("heading_deg")
    opensky = any(stems[name][0] == "lastposupdate" for name in stems)
    if heading and course is None and opensky:
        quantity = next(q for q in QUANTITIES if q.column == "course_deg")
        why = f"{heading.name} is read as the course, as in OpenSky's states"
        chosen["course_deg"] = Choice(chosen.pop("heading_deg").name, quantity, heading.factor, why)
        return chosen
    if course and "".join(stems[course.name]) == "track" and "speed_m_per_s" not in chosen:
        del chosen["course_deg"]
        if "track_id" not in chosen:
            quantity = next(q for q in QUANTITIES if q.column == "track_id")
            chosen["track_id"] = Choice(course.name, quantity, 1.0, f"{course.name} is read as a track number")
    return chosen

"""Columns of tables of reports, recognised by their names, and their units.

Names are compared without case, blanks, signs and a unit at their end: ``SOG_knots``, ``sog (kn)`` and ``SOG`` are the
same quantity. Columns named by the user take precedence. Two columns of equal rank are refused, with the choices.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sameas.errors import Argument, InputError, Message
from sameas.io.sensors.ais import SIDES
from sameas.io.sensors.format import FEET_PER_MINUTE_M_PER_S, KNOT_M_PER_S
from sameas.io.sensors.languages import BREADTHS, PLACES, names_in, plain
from sameas.tracks.coordinates import FOOT_M, MILE_M

#: Units by kind of quantity: as written at the end of a name, and their factor to our unit.
UNITS: Mapping[str, Mapping[str, float]] = {
    "length": {"m": 1.0, "metres": 1.0, "meters": 1.0, "metre": 1.0, "meter": 1.0, "km": 1000.0, "ft": FOOT_M,
               "feet": FOOT_M, "nm": MILE_M, "nmi": MILE_M, "cm": 0.01, "mm": 0.001, "sm": MILE_M, "seemeilen": MILE_M,
               "milles": MILE_M, "millas": MILE_M, "miglia": MILE_M, "milhas": MILE_M, "sjomil": MILE_M,
               "somil": MILE_M, "zeemijl": MILE_M, "metri": 1.0, "metros": 1.0, "100ft": 100.0 * FOOT_M},
    "angle": {"deg": 1.0, "degrees": 1.0, "degree": 1.0, "rad": 57.29577951308232, "radians": 57.29577951308232,
              "mrad": 0.05729577951308232, "grad": 1.0, "degres": 1.0, "grados": 1.0, "gradi": 1.0, "graus": 1.0,
              "grader": 1.0, "graden": 1.0},
    "speed": {"mps": 1.0, "ms": 1.0, "mpers": 1.0, "msec": 1.0, "kn": KNOT_M_PER_S, "kt": KNOT_M_PER_S,
              "kts": KNOT_M_PER_S, "knots": KNOT_M_PER_S, "knot": KNOT_M_PER_S, "kmh": 1.0 / 3.6, "kph": 1.0 / 3.6,
              "kmperh": 1.0 / 3.6, "mph": 0.44704, "fpm": FEET_PER_MINUTE_M_PER_S, "ftmin": FEET_PER_MINUTE_M_PER_S,
              "knoten": KNOT_M_PER_S, "noeuds": KNOT_M_PER_S, "nds": KNOT_M_PER_S, "nudos": KNOT_M_PER_S,
              "nodi": KNOT_M_PER_S, "nos": KNOT_M_PER_S, "knop": KNOT_M_PER_S, "knob": KNOT_M_PER_S,
              "knopen": KNOT_M_PER_S, "kn10": KNOT_M_PER_S / 10.0},
    "variance": {"m2": 1.0, "km2": 1e6},
    "speed variance": {"m2s2": 1.0, "m2pers2": 1.0},
    "time": {"s": 1.0, "sec": 1.0, "seconds": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "utc": 0.0},
    "frequency": {"hz": 1.0, "khz": 1e3, "mhz": 1e6, "ghz": 1e9},
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


def _hers(*words: str) -> str:
    """The names of a quantity of the vessel or the site with the sensor."""
    owners = "station", "sensor", "own", "ownship", "platform", "ship", "vessel", "boat", "radar", "antenna"
    return " ".join(owner + word for word in words for owner in owners)


QUANTITIES = tuple(
    SensorQuantity(column, kind, tuple(names.split()))
    for column, kind, names in (
        ("time_s", "time", "lastposupdate time timestamp datetime basedatetime t utc timeutc utctime dt epoch "
                           "unixtime unix date msgtime dtpos clock ts epochtime rxtime receivetime"),
        ("day_s", "time", "timeofday tod"),
        ("lat_deg", "angle", "lat latitude latitudewgs84"),
        ("lon_deg", "angle", "lon long longitude lng longitudewgs84"),
        ("alt_m", "length", "alt altitude geoaltitude geometricaltitude altgeom altitudegeo heightellipsoid "
                            "height hae "
                            "geodeticaltitude altitudegeodetic altitudeabovesealevel altitudemsl geoalt gnssaltitude "
                            "gnssalt gpsaltitude gpsalt mslaltitude altmsl mslalt altitudeamsl altamsl qnhaltitude"),
        ("pressure_alt_m", "length", "pressurealtitude baroaltitude altbaro baroalt flightlevelaltitude "
                                     "altitudebarometric barometricaltitude altitudebaro flightlevel fl "
                                     "measuredflightlevel flightlevelmeasured altitudefl altfl modec modeccode "
                                     "modecaltitude modecheight"),
        ("x_m", "length", "x east e xeast easting xpos posx"),
        ("y_m", "length", "y north n ynorth northing ypos posy"),
        ("z_m", "length", "z up"),
        ("range_m", "length", "range rng rho distance dist slantrange r"),
        ("bearing_deg", "angle", "bearing brg azimuth az theta truebearing truebrg bearingtrue brgtrue bearingt brgt "
                                 "lob lineofbearing doa directionofarrival aoa angleofarrival azimuthtrue trueazimuth "
                                 "azimutht azt angle"),
        ("relative_bearing_deg", "angle", "relativebearing relbearing relbrg bearingrelative bearingrel brgrel "
                                          "relativebrg relativeazimuth azimuthrelative relazimuth relaz azrel "
                                          "azimuthrel bearingr brgr bowbearing bearingfrombow"),
        ("elevation_deg", "angle", "elevation el elev"),
        ("station_lat_deg", "angle", _hers("lat", "latitude")),
        ("station_lon_deg", "angle", _hers("lon", "longitude", "long", "lng")),
        ("station_x_m", "length", "stationx sensorx ownx ownshipx"),
        ("station_y_m", "length", "stationy sensory owny ownshipy"),
        ("station_heading_deg", "angle", _hers("heading", "hdg")),
        ("speed_m_per_s", "speed", "sog speed groundspeed gs velocity speedoverground speedhorizontal "
                                  "horizontalspeed spd"),
        ("course_deg", "angle", "cog course courseoverground track trackangle direction coursetrue groundtrack"),
        ("heading_deg", "angle", "heading hdg trueheading headingtrue hdt gyro gyroheading"),
        ("vx_m_per_s", "speed", "vx ve veast velx velocityx xvel vele xspeed xdot"),
        ("vy_m_per_s", "speed", "vy vn vnorth vely velocityy yvel veln yspeed ydot"),
        ("climb_m_per_s", "speed", "climb verticalrate vertrate rocd vrate vz speedvertical verticalspeed"),
        ("sigma_m", "length", "sigma sigmapos sigmaposition positionsigma poserror accuracy std stddev"),
        ("sigma_x_m", "length", "sigmax sx stdx xstd xsigma xerr sigmaeast sigmae"),
        ("sigma_y_m", "length", "sigmay sy stdy ystd ysigma yerr sigmanorth sigman"),
        ("cov_xx", "variance", "covxx covee pxx varx xvar covarxx"),
        ("cov_xy", "variance", "covxy coven pxy covarxy covyx"),
        ("cov_yy", "variance", "covyy covnn pyy vary yvar covaryy"),
        ("cov_vxvx", "speed variance", "covvxvx varvx vxvar"),
        ("cov_vxvy", "speed variance", "covvxvy"),
        ("cov_vyvy", "speed variance", "covvyvy varvy vyvar"),
        ("sigma_vx", "speed", "sigmavx stdvx vxstd vxsigma sigmave"),
        ("sigma_vy", "speed", "sigmavy stdvy vystd vysigma sigmavn"),
        ("sigma_alt_m", "length", "sigmaalt sigmaz altsigma sigmaaltitude altstd"),
        ("sigma_range_m", "length", "sigmarange rangesigma rangestd stdrange sigmar"),
        ("sigma_bearing_deg", "angle", "sigmabearing bearingsigma bearingstd sigmaazimuth azimuthsigma sigmaaz"),
        ("sigma_elevation_deg", "angle", "sigmaelevation elevationsigma sigmael"),
        ("track_id", "text", "trackid tracknumber trackno tracknum id targetid target targetno targetnumber tgt tgtid "
                             "tgtno trkid trkno tracknr targetnr objectid uid shipid vesselid uasid "
                             "uavid droneid faflightid flightid trknum tn systemtracknumber stn localtracknumber "
                             "contactid"),
        ("mmsi", "text", "mmsi sourcemmsi mmsinumber vesselmmsi userid"),
        ("imo", "text", "imo imonumber"),
        ("icao", "text", "icao24 icao icaoaddress hex hexid modes modesaddress modescode aircraftaddress targetaddress "
                         "transponderid"),
        ("callsign", "text", "callsign flight ident targetidentification aircraftidentification aircraftid acid "
                             "flightnumber"),
        ("mode_a", "text", "squawk modea mode3a modea3 squawkcode modeacode mode3acode ssrcode ssr"),
        ("name", "text", "name vesselname shipname"),
        ("type", "text", "type vesseltype shiptype typecode"),
        ("nav_status", "text", "navstatus navstat navigationalstatus navigationstatus status"),
        ("length_m", "length", "length loa"),
        ("width_m", "length", "width beam"),
        ("frequency_hz", "frequency", "frequency freq carrierfrequency centerfrequency centrefrequency rf "
                                      "rffrequency channelfrequency"),
        *((f"to_{side}_m", "length",
           f"to{side} {side} dim{letter} dimension{letter} size{letter} dimensionto{side} {letter}")
          for side, letter in zip(SIDES, "abcd", strict=True)),
    )
)  # fmt: skip
_QUANTITY = {quantity.column: quantity for quantity in QUANTITIES}
#: Places of the antenna on the hull, A to D in AIS: other tables call other things by these letters.
OF_THE_ANTENNA = tuple(f"to_{side}_m" for side in SIDES)
_FLIGHT_LEVELS = "flightlevel", "fl", "measuredflightlevel", "flightlevelmeasured", "altitudefl", "altfl", "modec"
_MODE_C = "modeccode", "modecaltitude", "modecheight"
#: Conventional units where none is stated: sentence, columns (several together) or kind of source that indicate it,
#: names, unit.
_CONVENTIONS = (
    ("speeds are tenths of a knot in tables of MarineTraffic", ("dsrc",), ("speed",), "kn/10"),
    ("ship speeds are knots", ("mmsi", "sourcemmsi", "imo", "ais"), ("sog", "speed", "speedoverground"), "kn"),
    ("speeds over ground (sog) are knots", ("sog", "speedoverground"), ("sog", "speedoverground"), "kn"),
    ("speeds of aircraft are knots", ("groundspeed", "gs"), ("groundspeed", "gs"), "kn"),
    ("flight levels and mode C are hundreds of feet", _FLIGHT_LEVELS, _FLIGHT_LEVELS, "100 ft"),
    ("altitudes are hundreds of feet in answers of FlightAware", ("faflightid",), ("altitude",), "100 ft"),
    ("altitudes of mode C are feet", _MODE_C, _MODE_C, "ft"),
    ("altitudes are feet", ("groundspeed", "gs"), ("altitude", "alt", "geoaltitude", "altgeom", "altbaro",
                                                   "baroaltitude"), "ft"),
    ("vertical rates are feet a minute", ("groundspeed", "gs"), ("verticalrate", "rocd", "vertrate"), "fpm"),
    ("speeds are knots in tables of flightradar24", ("utc callsign direction",), ("speed",), "kn"),
    ("altitudes are feet in tables of flightradar24", ("utc callsign direction",), ("altitude",), "ft"),
)  # fmt: skip


#: Why a unit is assumed.
NO_UNIT = "its name states no unit"


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
        return stem_of(self.name)[0] in self.quantity.translations


def choose(
    names: Sequence[str],
    source: str,
    named: Mapping[str, str] | None = None,
    units: Mapping[str, str] | None = None,
    kind: str | None = None,
) -> dict[str, Choice]:
    """The recognised columns, by their column in Reports.

    names : of the table's columns.
    source : its name in messages.
    named : name of the column of a quantity (``lat_deg``, ``time_s`` …); None: the table does not have it.
    units : unit of a column, by its name in the table.
    kind : of the source, if known: speeds of AIS are knots.

    Raises InputError: two columns of equal rank, an unknown name or unit.
    """
    named, units = dict(named or {}), dict(units or {})
    _check_named(names, source, named, units)
    stems = {name: stem_of(name) for name in names}
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
        candidates = [name for name in names if name not in taken and rank_of(name, quantity, stems) is not None]
        if candidates:
            best = min(rank_of(name, quantity, stems) or 0 for name in candidates)
            equal = [name for name in candidates if rank_of(name, quantity, stems) == best]
            if len(equal) > 1:
                listed = ", ".join(map(repr, equal))
                raise InputError(
                    f"{source}: {len(equal)} columns may be {quantity.column}: {listed}",
                    naming_columns(quantity.column),
                )
            chosen[quantity.column] = _choice(equal[0], quantity, stems[equal[0]], units, signs, source)
            taken.add(equal[0])
    if not (kind == "ais" or "mmsi" in chosen):
        chosen = {column: choice for column, choice in chosen.items() if column not in OF_THE_ANTENNA}
    return _with_courses(_with_own_heading(_with_own_place(chosen, kind)), stems)


def _quantities(stems: Mapping[str, tuple[str, str]]) -> tuple[SensorQuantity, ...]:
    """The quantities with the names that are certain in this table, those of other languages after the English ones."""
    known = {q.column for q in QUANTITIES if any(rank_of(name, q, stems) is not None for name in stems)}
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


#: From where a direction counts, which may stand behind its unit.
_REFERENCES = ("t", "true", "r", "rel", "relative")


def stem_of(name: str) -> tuple[str, str]:
    """The name without signs and unit, and the unit at its end, or ""."""
    words = re.findall(r"[a-z0-9]+", plain(re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name).replace("²", "2")))
    known_units = {unit for kinds in UNITS.values() for unit in kinds}
    if len(words) > 2 and words[-1] in _REFERENCES and words[-2] in known_units:
        words[-2:] = [words[-1], words[-2]]  # "Azimuth_deg_true"
    for count in (4, 3, 2, 1):
        unit = "".join(words[-count:])
        if len(words) > count and unit in known_units:
            stem = words[:-count]
            # "Speed in kn", "Vitesse en noeuds".
            return "".join(stem[:-1] if len(stem) > 1 and stem[-1] in ("in", "en", "em", "i") else stem), unit
    return "".join(words), ""


def rank_of(name: str, quantity: SensorQuantity, stems: Mapping[str, tuple[str, str]]) -> int | None:
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
        steps = re.fullmatch(r"([1-9]\d{1,5})(perturn|turn)", unit)
        if steps and quantity.kind == "angle":
            return Choice(name, quantity, 360.0 / int(steps[1]), f"{name} has {steps[1]} steps a turn, as said")
        if unit not in factors:
            raise InputError(f"{source}: column {name!r}: unit {units[name]!r} is none of {', '.join(factors)}")
        return Choice(name, quantity, factors[unit], f"{name} is in {units[name]}, as said")
    stem, unit = stem_and_unit
    if unit in factors and stem + unit not in quantity.names:
        return Choice(name, quantity, factors[unit], "")
    if stem in quantity.translations and quantity.column == "speed_m_per_s":
        stem = "speed"
    for why, indicators, applies, written in _CONVENTIONS:
        unit = re.sub("[/ ]", "", written)
        if stem in applies and unit in factors and any(set(each.split()) <= signs for each in indicators):
            return Choice(name, quantity, factors[unit], f"{name} is read in {written}: {why}")
    if quantity.column in ("length_m", "width_m", *OF_THE_ANTENNA):
        return Choice(name, quantity, 1.0, "")  # of ships, in metres everywhere
    # Angles without a unit are degrees everywhere.
    our_unit = {"length": "m", "speed": "m/s", "variance": "m²", "speed variance": "m²/s²", "frequency": "Hz"}.get(
        quantity.kind
    )
    return Choice(name, quantity, 1.0, f"{name} is read in {our_unit}: {NO_UNIT}" if our_unit else "")


def _with_own_place(chosen: dict[str, Choice], kind: str | None) -> dict[str, Choice]:
    """The columns with the place of the direction finder, where its log calls it latitude and longitude: it knows the
    direction of an emission, not the place."""
    lat, lon, bearing = (chosen.get(name) for name in ("lat_deg", "lon_deg", "bearing_deg"))
    if lat is None or lon is None or bearing is None or not {"range_m", "station_lat_deg"}.isdisjoint(chosen):
        return chosen
    if kind != "esm" and "frequency_hz" not in chosen:
        return chosen
    why = (
        f"{lat.name} and {lon.name} are read as the place of the direction finder: {bearing.name} is the direction of "
    )
    why += "what it receives; if they are that of the emitter, leave the bearing out"
    own = {
        f"station_{name}": replace(choice, quantity=_QUANTITY[f"station_{name}"], why=why if name == "lat_deg" else "")
        for name, choice in (("lat_deg", lat), ("lon_deg", lon))
    }
    return {column: choice for column, choice in chosen.items() if choice not in (lat, lon)} | own


def with_breadths_as_places(
    values: Mapping[str, Any], chosen: Mapping[str, Choice]
) -> tuple[dict[str, Any], dict[str, Choice]]:
    """The values with a width and a length as latitude and longitude, where one word is both and they cannot be sizes:
    those of ships are in metres with two decimals at most, and a ship is not wider than she is long.

    >>> choices = choose(["Zeit", "Breite", "Länge", "Entfernung", "Peilung"], "radar")
    >>> values = {"range_m": np.ones(2), "width_m": np.array([51.98, 51.981]), "length_m": np.array([4.0, 4.001])}
    >>> sorted(with_breadths_as_places(values, choices)[0])
    ['lat_deg', 'lon_deg', 'range_m']
    """
    out, choices = dict(values), dict(chosen)
    if not {"width_m", "length_m", "range_m"} <= set(out) or "lat_deg" in out:
        return out, choices
    if stem_of(choices["width_m"].name)[0] not in BREADTHS:
        return out, choices
    width, length = out["width_m"], out["length_m"]
    finer = np.abs(100.0 * width - np.round(100.0 * width)) > 1e-6
    if np.mean(finer | (width > length)) < 0.5 or np.nanmax(np.abs(width)) > 90.0 or np.nanmax(np.abs(length)) > 180.0:
        return out, choices
    for size, place in (("width_m", "lat_deg"), ("length_m", "lon_deg")):
        out[place] = out.pop(size)
        choices[place] = replace(choices.pop(size), quantity=_QUANTITY[place])
    return out, choices


#: Change of the arm from one report to the next above which they are of different objects, m; the part of it that the
#: place of the sensor changes at most; and the change of her velocity between them, m/s (chosen).
_OTHER_M, _STEADY_PART, _STEADY_M_PER_S = 100.0, 0.2, 0.5


def with_sensors_motion(
    values: Mapping[str, Any], chosen: Mapping[str, Choice]
) -> tuple[dict[str, Any], dict[str, Choice]]:
    """The values with the place, heading and velocity of the vessel with the sensor as hers, where the columns name
    nobody's: beside ranges and bearings that jump from object to object, they follow each other.

    >>> choices = choose(["time", "range", "relbearing", "lat", "lon", "heading", "sog"], "radar")
    >>> values = {"range_m": 1000.0 * np.arange(1, 5), "relative_bearing_deg": np.arange(4) % 2 * 90.0}
    >>> values |= {name: np.full(4, 50.0) for name in ("lat_deg", "lon_deg", "heading_deg", "speed_m_per_s")}
    >>> values, choices = with_sensors_motion(values, choices)
    >>> sorted(values)
    ['range_m', 'relative_bearing_deg', 'station_heading_deg', 'station_lat_deg', 'station_lon_deg']
    """
    out, choices = dict(values), dict(chosen)
    bearing = next((name for name in ("bearing_deg", "relative_bearing_deg") if name in out), None)
    if "range_m" not in out or bearing is None:
        return out, choices
    is_hers = _follows(out, bearing, ("lat_deg", "lon_deg")) if "station_lat_deg" not in out else False
    if "lat_deg" in out and not is_hers:
        # Nothing is made of bearings from the bow beside the positions of the targets.
        out.pop("relative_bearing_deg", None), choices.pop("relative_bearing_deg", None)
        return out, choices
    if not is_hers and "track_id" in out:
        return out, choices
    unused = [name for name in ("speed_m_per_s", "course_deg") if name in out]
    if not is_hers and not (unused and _follows(out, bearing, ("speed_m_per_s", "course_deg"))):
        return out, choices
    moved = [name for name in ("lat_deg", "lon_deg", "heading_deg") if name in out]
    moved = [name for name in moved if f"station_{name}" not in out]
    why = f"{', '.join(choices[name].name for name in (*moved, *unused))}: read as those of the vessel with the sensor"
    for one in unused:
        del out[one], choices[one]
    for name in moved:
        out[f"station_{name}"] = out.pop(name)
        choices[f"station_{name}"] = replace(choices.pop(name), quantity=_QUANTITY[f"station_{name}"])
    first = bearing if bearing in choices else "range_m"
    choices[first] = replace(choices[first], why="; ".join(filter(None, (choices[first].why, why))))
    return out, choices


def _follows(values: Mapping[str, Any], bearing: str, names: tuple[str, str]) -> bool:
    """Whether places (latitude, longitude) or velocities (speed, course) hardly change between reports of different
    objects."""
    if not set(names) <= set(values):
        return False
    first, second = (values[name] for name in names)
    if names[0] == "lat_deg":
        state = 60.0 * MILE_M * np.column_stack([first, second * np.cos(np.radians(first))])
    else:
        state = first[:, None] * np.column_stack([np.cos(np.radians(second)), np.sin(np.radians(second))])
    angle = np.radians(values[bearing])
    arm = values["range_m"][:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    change, way = (np.hypot(*np.diff(one, axis=0).T) for one in (state, arm))
    others = (way > _OTHER_M) & np.isfinite(change)
    if 2 * others.sum() < len(way) or not len(way):
        return False
    most = _STEADY_PART * np.median(way[others]) if names[0] == "lat_deg" else _STEADY_M_PER_S
    return bool(np.median(change[others]) < most)


def _with_own_heading(chosen: dict[str, Choice]) -> dict[str, Choice]:
    """The columns of bearings from the bow with the heading that they need; without them beside other positions."""
    relative = chosen.get("relative_bearing_deg")
    if relative is None:
        return chosen
    if "range_m" in chosen and "lat_deg" in chosen and not {"bearing_deg", "station_lat_deg"} & set(chosen):
        return chosen  # The values show whose position it is.
    if {"lat_deg", "x_m", "bearing_deg"} & set(chosen):
        return {column: choice for column, choice in chosen.items() if choice is not relative}
    # A radar does not know where the bows of its targets are: the heading beside a bearing from the bow is her own.
    own = chosen.get("station_heading_deg") or chosen.get("heading_deg")
    others = {c: choice for c, choice in chosen.items() if choice not in (relative, own)}
    why = f"{relative.name} is relative to the bow of the vessel with the sensor"
    if own is None:
        return others | {"relative_bearing_deg": replace(relative, why=f"{why}; no column has the heading")}
    return others | {
        "relative_bearing_deg": replace(relative, why=f"{why}; the heading, {own.name}, is added"),
        "station_heading_deg": replace(own, quantity=_QUANTITY["station_heading_deg"]),
    }


def _with_courses(chosen: dict[str, Choice], stems: Mapping[str, tuple[str, str]]) -> dict[str, Choice]:
    """Corrects ambiguous names of courses.

    "track" is a course in tables with speeds, and a track number in others and beside another course; "heading" in
    OpenSky's state vectors is the course over ground.
    """
    course, heading = chosen.get("course_deg"), chosen.get("heading_deg")
    opensky = any(stems[name][0] == "lastposupdate" for name in stems)
    if heading and course is None and opensky:
        why = f"{heading.name} is read as the course, as in OpenSky's states"
        chosen["course_deg"] = Choice(chosen.pop("heading_deg").name, _QUANTITY["course_deg"], heading.factor, why)
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
        chosen["track_id"] = Choice(track, _QUANTITY["track_id"], 1.0, f"{track} is read as a track number")
    return chosen


#: Columns of a table of own ship's heading.
HEADINGS = ("station_heading_deg", "heading_deg")


def is_compass(chosen: Mapping[str, Choice]) -> bool:
    """Whether a table has the headings of one vessel, which it does not name, and no positions."""
    others = chosen.keys() - {"time_s", "day_s", *HEADINGS, "speed_m_per_s", "course_deg"}
    return not others and sum(name in chosen for name in HEADINGS) == 1


def require_columns(chosen: Mapping[str, Choice], names: Sequence[str], source: str) -> None:
    """Refuses a table without times, or without positions or headings; the message names all that is missing."""
    listed = ", ".join(names)
    if any(re.fullmatch(r"I\d{3}", name) for name in names) or {"data_blocks", "data_items"} & set(names):
        raise InputError(
            f"{source}: is JSON that a decoder of ASTERIX has written", "give the ASTERIX itself, or its pcap"
        )
    times = () if {"time_s", "day_s"} & set(chosen) else ("time_s",)
    words = "time and " if times else ""
    for pair in (("lat_deg", "lon_deg"), ("x_m", "y_m")):
        if (pair[0] in chosen) != (pair[1] in chosen):
            missing = pair[0] if pair[1] in chosen else pair[1]
            raise InputError(
                f"{source}: no column of {words}{missing} among: {listed}", naming_columns(*times, missing)
            )
    is_placed = not chosen.keys().isdisjoint(PLACES - {"range_m"}) or is_compass(chosen)
    if "range_m" in chosen and not is_placed:
        raise InputError(
            f"{source}: ranges ({chosen['range_m'].name}), but no column of {words}bearings among: {listed}",
            naming_columns(*times, "bearing_deg"),
        )
    if not is_placed:
        raise InputError(
            f"{source}: no columns of {words}a position among: {listed}",
            Message(naming_columns(*times, "lat_deg", "lon_deg"), ", or those of x_m and y_m, range_m and bearing_deg"),
        )
    if times:
        raise InputError(f"{source}: no column of time among: {listed}", naming_columns("time_s"))

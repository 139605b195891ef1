"""ASTERIX: the binary records of radars, trackers and ADS-B ground stations (EUROCONTROL-SPEC-0149).

``asterix_records`` splits files and network captures into blocks of one category, and blocks into records; this module
decodes their items, by category, and groups them into the reports of each sensor.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from sameas.arrays import FloatArray
from sameas.errors import UndatedTimes, naming
from sameas.io.sensors.aircraft import errors_of
from sameas.io.sensors.asterix_records import (
    CATEGORIES,
    Block,
    DamagedRecord,
    blocks_of,
    letters,
    looks_like,
    octal,
    records_of,
    signed,
    unsigned,
)
from sameas.io.sensors.asterix_services import Place, Services
from sameas.io.sensors.captures import PCAPNG
from sameas.io.sensors.format import (
    DAY_S,
    FEET_PER_MINUTE_M_PER_S,
    SensorFormat,
    round_covariance,
    sigma_of_nucp,
    unwrapped,
)
from sameas.tracks.coordinates import FOOT_M, MILE_M, geodesy
from sameas.tracks.reports import Damaged, Reports, Unused, of_rows

# Category 021: ADS-B target reports of ground stations, editions 2.1 to 2.7.

#: Items with the time of the position, the preferred first: applicability, reception, report transmission.
_POSITION_TIMES = ("071", "073", "077")


def row_021(items: Mapping[str, Any]) -> dict[str, Any] | str:
    """The row of a report, or the reason why the record has none."""
    position = items.get("131") or items.get("130")
    if position is None:
        return "021 without a position"
    descriptor = items.get("040", b"") + b"\0\0"
    if descriptor[0] & 0x02 or descriptor[1] & 0x30:
        return "021 of a simulated or test target or a field monitor"
    half = len(position) // 2
    unit = 180.0 / 2.0 ** (30 if half == 4 else 23)
    time = next((items[name] for name in _POSITION_TIMES if name in items), None)
    values: dict[str, Any] = {
        "day_s": None if time is None else unsigned(time) / 128.0,
        "lat_deg": signed(position[:half]) * unit,
        "lon_deg": signed(position[half:]) * unit,
        "icao": f"{unsigned(items['080']):06x}" if "080" in items else None,
        "track_id": str(unsigned(items["161"]) & 0xFFF) if "161" in items else None,
        "callsign": letters(items["170"]) if "170" in items else None,
        "mode_a": octal(items["070"]) if "070" in items else None,
        "alt_m": _height(items.get("140")),
        "pressure_alt_m": signed(items["145"]) / 4.0 * 100.0 * FOOT_M if "145" in items else None,
        "climb_m_per_s": _climb(items),
        "on_ground": float(bool(descriptor[1] & 0x40)),
        **_velocity_021(items.get("160")),
        **_quality_021(items),
    }
    if values["track_id"] is None:
        values["track_id"] = values["icao"]
    return values


def errors_021(columns: Mapping[str, Any]) -> dict[str, Any]:
    """Covariances from NACp for versions 1 and 2, and from NUCp for version 0, which is in the bits of NIC."""
    n = len(columns["time_s"])
    absent = np.full(n, np.nan)
    version_0 = columns.get("version", absent) == 0
    of_newer = {name: np.where(version_0, np.nan, columns.get(name, absent)) for name in ("nac_p", "nac_v", "nic")}
    newer = errors_of({**columns, **of_newer})
    old = round_covariance(sigma_of_nucp(np.where(version_0, columns.get("nic", absent), np.nan)))
    return newer | {"covariance_m2": np.where(version_0[:, None], old, newer["covariance_m2"])}


def _height(item: bytes | None) -> float | None:
    """Geometric height in metres; None for the largest value, which means "greater than"."""
    if item is None or item == b"\x7f\xff":
        return None
    return signed(item) * 6.25 * FOOT_M


def _climb(items: Mapping[str, Any]) -> float | None:
    """Geometric, else barometric rate of climb in m/s; None where the first bit says it is out of range."""
    for name in ("157", "155"):
        if name in items and not items[name][0] & 0x80:
            return _low_bits(items[name], 15) * 6.25 * FEET_PER_MINUTE_M_PER_S
    return None


def _low_bits(item: bytes, bits: int) -> int:
    """The signed number in the lowest bits of an item."""
    value = unsigned(item) & (1 << bits) - 1
    return value - (1 << bits) if value >> bits - 1 else value


def _velocity_021(item: bytes | None) -> dict[str, float]:
    if item is None or item[0] & 0x80:
        return {}
    speed = (unsigned(item[:2]) & 0x7FFF) * MILE_M / 2.0**14
    return {"speed_m_per_s": speed, "course_deg": unsigned(item[2:]) * 360.0 / 2.0**16}


def _quality_021(items: Mapping[str, Any]) -> dict[str, float]:
    """The version of the transponder and its accuracy categories."""
    values: dict[str, float] = {}
    if "210" in items and items["210"][0] & 7 == 2:
        # Other values of the lowest bits are UAT, VDL 4 and others, which have versions of their own.
        values["version"] = float(items["210"][0] >> 3 & 7)
    quality = items.get("090")
    if quality:
        values["nac_v"], values["nic"] = float(quality[0] >> 5), float(quality[0] >> 1 & 15)
        if len(quality) > 1:
            values["nac_p"], values["sil"] = float(quality[1] >> 1 & 15), float(quality[1] >> 5 & 3)
    return values


# Category 048: target reports of one radar, editions 1.27 to 1.32.
#
# Ranges are slant ranges. The height of the target (Mode C, or of a 3D radar) is a column of its own; position and
# height of the radar are in its service messages (034), or come from its description.

#: Type of detection, by the first three bits of item 020.
_DETECTIONS = (None, "primary", "secondary", "primary and secondary", "Mode S all-call", "Mode S roll-call",
               "Mode S all-call and primary", "Mode S roll-call and primary")  # fmt: skip


def row_048(items: Mapping[str, Any]) -> dict[str, Any] | str:
    """The row of a report, or the reason why the record has none."""
    if "040" not in items:
        return "048 without a measured position"
    descriptor = items["020"][0] if "020" in items else 0
    if descriptor & 0x12:
        return "048 of a simulated target or a field monitor"
    if len(items.get("020", b"")) > 1 and items["020"][1] & 0x80:
        return "048 of a test target"
    if "140" not in items:
        return "a plot without a time"
    return {
        "day_s": unsigned(items["140"]) / 128.0,
        "range_m": unsigned(items["040"][:2]) * MILE_M / 256.0,
        "bearing_deg": unsigned(items["040"][2:]) * 360.0 / 2.0**16,
        "alt_m": signed(b"\0\0" + items["110"]) * 25.0 * FOOT_M if "110" in items else None,
        "pressure_alt_m": _pressure_altitude_048(items.get("090")),
        "icao": f"{unsigned(items['220']):06x}" if "220" in items else None,
        "callsign": letters(items["240"]) if "240" in items else None,
        "mode_a": _mode_a(items.get("070")),
        "track_id": str(unsigned(items["161"]) & 0xFFF) if "161" in items else None,
        "detection": _DETECTIONS[descriptor >> 5],
        **_velocity_048(items),
        **_quality_048(items.get("210")),
    }


def errors_048(columns: Mapping[str, Any]) -> dict[str, Any]:
    """Covariances from the track quality (item 210), where the radar sends it."""
    covariances = {}
    if "sigma_x_m" in columns:
        x, y = columns["sigma_x_m"] ** 2, columns["sigma_y_m"] ** 2
        covariances["covariance_m2"] = np.stack([x, np.where(np.isnan(x), np.nan, 0.0), y], axis=-1)
    return covariances


def _pressure_altitude_048(item: bytes | None) -> float | None:
    """Metres from the flight level; None where the code is invalid or garbled (first two bits)."""
    if item is None or item[0] & 0xC0:
        return None
    return _low_bits(item, 14) / 4.0 * 100.0 * FOOT_M


def _mode_a(item: bytes | None) -> str | None:
    """Mode A code; None where it is invalid or garbled (first two bits)."""
    return None if item is None or item[0] & 0xC0 else octal(item)


def _velocity_048(items: Mapping[str, Any]) -> dict[str, float]:
    if "200" not in items:
        return {}
    speed, heading = unsigned(items["200"][:2]), unsigned(items["200"][2:])
    return {"speed_m_per_s": speed * MILE_M / 2.0**14, "course_deg": heading * 360.0 / 2.0**16}


def _quality_048(item: bytes | None) -> dict[str, float]:
    """Standard deviations of the track along x and y; empty where one of them is 0, which means unknown."""
    if item is None or not (item[0] and item[1]):
        return {}
    return {"sigma_x_m": item[0] * MILE_M / 128.0, "sigma_y_m": item[1] * MILE_M / 128.0}


# Category 001: plots and tracks of older radars, editions 1.1 to 1.4.
#
# The time of day is truncated to 512 s: the service messages (002) or the time of receipt say which.


def row_001(items: Mapping[str, Any]) -> dict[str, Any] | str:
    """The row of a report, without its time, or the reason why the record has none."""
    descriptor = items.get("020", b"\0")
    if descriptor[0] & 0x40 or (len(descriptor) > 1 and descriptor[1] & 0x80):
        return "001 of a simulated or test target"
    if items.keys().isdisjoint(("040", "042")):
        return "001 without a position"
    values: dict[str, Any] = {
        "mode_a": _mode_a(items.get("070")),
        "pressure_alt_m": _pressure_altitude_048(items.get("090")),
        "track_id": str(unsigned(items["161"])) if "161" in items else None,
        "detection": _DETECTIONS[descriptor[0] >> 4 & 3],
        **_velocity_048(items),
    }
    if "040" in items:
        range_m = unsigned(items["040"][:2]) * MILE_M / 128.0
        return values | {"range_m": range_m, "bearing_deg": unsigned(items["040"][2:]) * 360.0 / 2.0**16}
    x, y = (signed(items["042"][k : k + 2]) * MILE_M / 64.0 for k in (0, 2))
    return values | {"x_m": x, "y_m": y}


# Category 062: tracks of a surveillance data processing system, editions 1.16 to 1.21, with their accuracies.

#: Steps of item 500: metres of a standard deviation, degrees of one in WGS84, metres per second of a velocity.
_APC_M, _APW_DEG, _ATV_M_PER_S = 0.5, 180.0 / 2.0**25, 0.25


def row_062(items: Mapping[str, Any]) -> dict[str, Any] | str:
    """The row of a track report, or the reason why the record has none."""
    status = items.get("080", b"")
    # Byte 2 has the flags simulated (SIM) and end of track (TSE), byte 4 has coasted (CST).
    if len(status) > 1 and status[1] & 0x80:
        return "062 of a simulated track"
    if "105" not in items and "100" not in items:
        return "062 without a position"
    if "070" not in items:
        return "a track without a time"
    aircraft = items.get("380", {})
    return {
        "day_s": unsigned(items["070"]) / 128.0,
        "track_id": str(unsigned(items["040"])) if "040" in items else None,
        "icao": f"{unsigned(aircraft['ADR']):06x}" if "ADR" in aircraft else None,
        "callsign": letters(aircraft["ID"]) if "ID" in aircraft else _callsign(items),
        "mode_a": octal(items["060"]) if "060" in items and not items["060"][0] & 0xC0 else None,
        "alt_m": signed(items["130"]) * 6.25 * FOOT_M if "130" in items else None,
        "pressure_alt_m": _pressure_altitude_062(items),
        "climb_m_per_s": signed(items["220"]) * 6.25 * FEET_PER_MINUTE_M_PER_S if "220" in items else None,
        "ends": float(len(status) > 1 and bool(status[1] & 0x40)),
        "coasted": float(len(status) > 3 and bool(status[3] & 0x80)),
        **_position(items),
        **_velocity_062(items.get("185")),
        **_accuracies(items.get("500", {})),
    }


def errors_062(columns: Mapping[str, Any]) -> dict[str, Any]:
    """Covariances of position and velocity from item 500: in x and y, else in latitude and longitude."""
    n = len(columns["time_s"])
    absent = np.full(n, np.nan)
    sigma = [columns.get(name, absent) for name in ("sigma_x_m", "sigma_y_m")]
    if "lat_deg" in columns and "sigma_lat_deg" in columns:
        metres = _metres_per_degree(columns["lat_deg"])
        of_degrees = (columns["sigma_lon_deg"] * metres[0], columns["sigma_lat_deg"] * metres[1])
        sigma = [np.where(np.isnan(own), other, own) for own, other in zip(sigma, of_degrees, strict=True)]
    cross = columns.get("covariance_xy_m2", absent)
    cross = np.where(np.isnan(cross) & ~np.isnan(sigma[0]), 0.0, cross)
    covariances = {"covariance_m2": np.stack([sigma[0] ** 2, cross, sigma[1] ** 2], axis=-1)}
    vx, vy = (columns.get(name, absent) for name in ("sigma_vx_m_per_s", "sigma_vy_m_per_s"))
    cross = np.where(np.isnan(vx), np.nan, 0.0)
    return covariances | {"velocity_covariance_m2_per_s2": np.stack([vx**2, cross, vy**2], axis=-1)}


def _position(items: Mapping[str, Any]) -> dict[str, float]:
    values: dict[str, float] = {}
    if "105" in items:
        unit = 180.0 / 2.0**25
        values = {"lat_deg": signed(items["105"][:4]) * unit, "lon_deg": signed(items["105"][4:]) * unit}
    if "100" in items:
        values |= {"x_m": signed(items["100"][:3]) * 0.5, "y_m": signed(items["100"][3:]) * 0.5}
    return values


def _velocity_062(item: bytes | None) -> dict[str, float]:
    if item is None:
        return {}
    return {"vx_m_per_s": signed(item[:2]) * _ATV_M_PER_S, "vy_m_per_s": signed(item[2:]) * _ATV_M_PER_S}


def _accuracies(parts: Mapping[str, bytes]) -> dict[str, float]:
    """Item 500: standard deviations, and the covariance, which is sent as a signed square root."""
    values: dict[str, float] = {}
    if "APC" in parts:
        x, y = unsigned(parts["APC"][:2]) * _APC_M, unsigned(parts["APC"][2:]) * _APC_M
        if x > 0.0 and y > 0.0:
            values |= {"sigma_x_m": x, "sigma_y_m": y}
            root = signed(parts["COV"]) * _APC_M if "COV" in parts else 0.0
            # Rounded to 0.5 m, it may slightly exceed the product of the standard deviations.
            values["covariance_xy_m2"] = float(np.clip(root * abs(root), -0.999 * x * y, 0.999 * x * y))
    if "APW" in parts:
        lat, lon = unsigned(parts["APW"][:2]) * _APW_DEG, unsigned(parts["APW"][2:]) * _APW_DEG
        if lat > 0.0 and lon > 0.0:
            values |= {"sigma_lat_deg": lat, "sigma_lon_deg": lon}
    if "ATV" in parts and all(parts["ATV"]):
        values["sigma_vx_m_per_s"] = parts["ATV"][0] * _ATV_M_PER_S
        values["sigma_vy_m_per_s"] = parts["ATV"][1] * _ATV_M_PER_S
    if "AGA" in parts and parts["AGA"][0]:
        values["sigma_alt_m"] = parts["AGA"][0] * 6.25 * FOOT_M
    return values


def _pressure_altitude_062(items: Mapping[str, Any]) -> float | None:
    """Metres from the measured flight level, else from the barometric altitude without QNH correction (first bit)."""
    if "136" in items:
        return signed(items["136"]) / 4.0 * 100.0 * FOOT_M
    if "135" in items and not items["135"][0] & 0x80:
        return _low_bits(items["135"], 15) / 4.0 * 100.0 * FOOT_M
    return None


def _callsign(items: Mapping[str, Any]) -> str | None:
    """The target identification of the track (item 245, after the byte of its source)."""
    return letters(items["245"][1:]) if "245" in items else None


def _metres_per_degree(lat_deg: Any) -> tuple[Any, Any]:
    """Metres per degree of longitude and of latitude, at this latitude."""
    pm = geodesy()
    return (
        np.radians(pm.rcurve.transverse(lat_deg) * np.cos(np.radians(lat_deg))),
        np.radians(pm.rcurve.meridian(lat_deg)),
    )


# Category 020: multilateration, editions 1.5 to 1.11, and category 010: radars and multilateration of the surface of an
# airport, edition 1.1. Their x and y count from a point of the system; they are used where latitudes are not sent.


def row_020(items: Mapping[str, Any]) -> dict[str, Any] | str:
    """The row of a multilateration report, or the reason why the record has none."""
    descriptor = items.get("020", b"\0")
    if len(descriptor) > 1 and descriptor[1] & 0x86:
        return "020 of a simulated or test target or a field monitor"
    if "041" not in items and "042" not in items:
        return "020 without a position"
    if "140" not in items:
        return "a report without a time"
    return {
        **_of_surveillance(items),
        **_place(items, 180.0 / 2.0**25, 0.5),
        "mode_a": _mode_a(items.get("070")),
        "alt_m": signed(items["105"]) * 6.25 * FOOT_M if "105" in items else None,
        # The unit of the correlation of both is not certain in the specification.
        **_deviations(items.get("500", {}).get("SDP", b"")[:4], 2),
    }


def row_010(items: Mapping[str, Any]) -> dict[str, Any] | str:
    """The row of a report of the surface of an airport, or the reason why the record has none."""
    descriptor = items.get("020", b"\0")
    if items.get("000", b"\1")[0] != 1:
        return "010 of a status or an update cycle"
    if len(descriptor) > 1 and descriptor[1] & 0xE0:
        return "010 of a simulated or test target or a field monitor"
    if items.keys().isdisjoint(("041", "042", "040")):
        return "010 without a position"
    if "140" not in items:
        return "a report without a time"
    values = {
        **_of_surveillance(items),
        **_place(items, 180.0 / 2.0**31, 1.0),
        "mode_a": _mode_a(items.get("060")),
        **_deviations(items.get("500", b""), 1),
    }
    if "041" not in items and "040" in items:
        values |= {"x_m": None, "y_m": None, "range_m": float(unsigned(items["040"][:2]))}
        values["bearing_deg"] = unsigned(items["040"][2:]) * 360.0 / 2.0**16
    if "202" not in items and "200" in items:
        values |= _velocity_048(items)
    return values


#: 1σ per axis where none is sent: 7.5 m with 95 % (EUROCAE ED-116, ED-117) and the extent of an aircraft.
_SURFACE_M = 10.0


def errors_010(columns: Mapping[str, Any]) -> dict[str, Any]:
    """Covariances from item 500; 10 m where positions in degrees have none. A range has the errors of its radar."""
    covariance = errors_062(columns)["covariance_m2"]
    if "range_m" not in columns:
        covariance = np.where(np.isnan(covariance[:, :1]), _SURFACE_M**2 * np.array([1.0, 0.0, 1.0]), covariance)
    return {"covariance_m2": covariance}


def _of_surveillance(items: Mapping[str, Any]) -> dict[str, Any]:
    """What categories 010 and 020 have in common: time, identity, flight level, velocity."""
    return {
        "day_s": unsigned(items["140"]) / 128.0,
        "track_id": str(unsigned(items["161"]) & 0xFFF) if "161" in items else None,
        "icao": f"{unsigned(items['220']):06x}" if "220" in items else None,
        "callsign": _callsign(items),
        "pressure_alt_m": _pressure_altitude_048(items.get("090")),
        "ends": float(bool(items.get("170", b"\0")[0] & 0x40)),
        **_velocity_062(items.get("202")),
    }


def _place(items: Mapping[str, Any], degrees: float, metres: float) -> dict[str, float]:
    """Latitude and longitude (041), else x and y (042), of items in these steps."""
    for name, keys, step in (("041", ("lat_deg", "lon_deg"), degrees), ("042", ("x_m", "y_m"), metres)):
        if name in items:
            half = len(items[name]) // 2
            return {keys[0]: signed(items[name][:half]) * step, keys[1]: signed(items[name][half:]) * step}
    return {}


def _deviations(item: bytes, size: int) -> dict[str, float]:
    """Standard deviations along x and y of ``size`` bytes each, in steps of 0.25 m, and the covariance, where it is
    there, in 0.25 m²; none where one is 0: unknown."""
    if not (any(item[:size]) and any(item[size : 2 * size])):
        return {}
    x, y = 0.25 * unsigned(item[:size]), 0.25 * unsigned(item[size : 2 * size])
    cross = 0.25 * signed(item[2 * size :]) if len(item) > 2 * size else 0.0
    return {"sigma_x_m": x, "sigma_y_m": y, "covariance_xy_m2": float(np.clip(cross, -0.999 * x * y, 0.999 * x * y))}


# Reports of each sensor.


class _Decoder(NamedTuple):
    """row : of a record, or the reason why it has none. errors : columns of covariances. notes : the assumptions."""

    row: Callable[[Mapping[str, Any]], dict[str, Any] | str]
    errors: Callable[[Mapping[str, Any]], dict[str, Any]]
    notes: tuple[str, ...]


_PLACES = "positions are those in WGS84, else x and y of a plane of the system; accuracies are those of item 500"
_DECODERS = {
    1: _Decoder(row_001, lambda columns: {}, (
        "ranges are slant ranges", "bearings are taken from true north; errors are those of the radar's description",
    )),
    10: _Decoder(row_010, errors_010, (_PLACES, f"errors are {_SURFACE_M:g} m where item 500 states none")),
    20: _Decoder(row_020, errors_062, (_PLACES,)),
    21: _Decoder(row_021, errors_021, (
        "errors are NACp (radius of 95 % over 2.45), NUCp where the transponder is of version 0, else half of the "
        "containment radius of NIC as the radius of 95 %",
    )),
    48: _Decoder(row_048, errors_048, (
        "ranges are slant ranges",
        "bearings are taken from true north; errors are those of the radar's description, or of item 210",
    )),
    62: _Decoder(row_062, errors_062, (
        "accuracies are those of item 500; its x and y are read as east and north of the track",
        "tracks are the output of a tracker: their errors are correlated in time",
    )),
}  # fmt: skip
#: Category, SAC and SIC: one sensor.
Sensor = tuple[int, int, int]


#: Kinds of damage that the refusal of a file lists.
_LISTED = 3
#: The editions of the specifications that are read; older ones have other items.
_EDITIONS = (
    "1.1 to 1.4 of category 001, 1.1 of 010, 1.5 to 1.11 of 020, 2.1 to 2.7 of 021, 1.27 to 1.32 of 048 and 1.16 to "
    "1.21 of 062"
)


def read(
    content: bytes,
    source: str,
    start_s: float | None = None,
    *,
    received_s: float = float("nan"),
    blocks_read: set[tuple[int, bytes]] | None = None,
    services: Services | None = None,
) -> list[Reports]:
    """The reports in ASTERIX bytes, one :class:`Reports` for each category and sensor (SAC, SIC).

    content : consecutive blocks, or a recording of datagrams (:mod:`~sameas.io.sensors.captures`). Line numbers are
        those of the records in the file.
    source : its name in messages; several sensors are named ``source:048 SAC/SIC``.
    start_s : UTC date of the first record, for files that are no capture: records have the time of day only.
    received_s, blocks_read, services : for a stream, the receive time, the earlier blocks and what service messages
        have said (both updated); every sensor is then named as one of several.

    Raises InputError: nothing of these categories; no date.
    """
    rows: dict[Sensor, list[dict[str, Any]]] = {}
    services = Services() if services is None else services
    unused, number, read = Unused(unit="record"), 0, False
    live = blocks_read is not None
    blocks_read = set() if blocks_read is None else blocks_read
    for block in blocks_of(content, received_s):
        repeated = (block.category, block.data) in blocks_read
        blocks_read.add((block.category, block.data))
        if repeated and not block.problem:
            # Sensors may send over two networks; otherwise blocks differ by their time of day.
            unused.passed_over["block that came before, from a second network"] += 1
        elif block.problem:
            unused.damaged.append((number + 1, block.problem))
        elif services.take(block):
            continue
        elif block.category not in _DECODERS:
            unused.passed_over[f"block of category {block.category:03d}"] += 1
        else:
            read = True
            number = _add_block(block, number, rows, unused, services)
    if not rows:
        problems = Damaged.of(unused.damaged, "record").sentences()
        more = len(problems) - _LISTED
        problems = [*problems[:_LISTED], *([f"{more} more kinds of damage"] if more > 0 else [])]
        problems += [f"{n} skipped: {what}" for what, n in unused.passed_over.items()]
        remedy = f"are its records of another edition? Read are {_EDITIONS}" if read and unused.damaged else ""
        why = "; ".join(problems) or "is it ASTERIX?"
        raise unused.refusal(f"{source}: no target of category 001, 010, 020, 021, 048 or 062; {why}", remedy)
    # Damaged and skipped records are counted for the whole file, with its first sensor.
    return [
        _reports(
            sensor, of_rows(rows[sensor]), _name(source, sensor, 2 if live else len(rows)), start_s,
            Unused(unit="record") if k else unused, services.places.get(sensor[1:]),
        )
        for k, sensor in enumerate(sorted(rows))
    ]  # fmt: skip


def _add_block(
    block: Block, number: int, rows: dict[Sensor, list[dict[str, Any]]], unused: Unused, services: Services
) -> int:
    """Adds the reports of a block to ``rows``; returns the number of its last record in the file."""
    decoder, identity = _DECODERS[block.category], b"\0\0"
    try:
        for items in records_of(CATEGORIES[block.category], block.data):
            number += 1
            # In category 001 only the first record need have it.
            identity = items.get("010", identity)  # type: ignore[assignment]
            row = decoder.row(items)
            if block.category == 1 and isinstance(row, dict):
                row = services.with_time(row, items, identity, block.received_s)
            if isinstance(row, str):
                # A reason that begins with the category is that of an intact record without a target.
                if row.startswith("0"):
                    unused.passed_over[row] += 1
                else:
                    unused.damaged.append((number, row))
                continue
            if abs(row.get("lat_deg", 0.0)) > 90.0:
                unused.damaged.append((number, "latitude beyond ±90°"))
                continue
            sensor = (block.category, identity[0], identity[1])
            rows.setdefault(sensor, []).append({"line": number, "received_s": block.received_s, **row})
    except DamagedRecord as error:
        number += 1
        unused.damaged.append((number, f"{error}; the rest of its block is lost"))
    return number


def _name(source: str, sensor: Sensor, count: int) -> str:
    category, sac, sic = sensor
    return source if count == 1 else f"{source}:{category:03d} {sac}/{sic}"


def _reports(
    sensor: Sensor, columns: dict[str, Any], name: str, start_s: float | None, unused: Unused, place: Place | None
) -> Reports:
    decoder = _DECODERS[sensor[0]]
    received_s = columns.pop("received_s")
    columns["time_s"] = _times(columns.pop("day_s"), received_s, name, start_s)
    columns |= decoder.errors(columns)
    date_source = "of the capture" if np.isfinite(received_s).any() else "that was given"
    notes = [f"{name}: {note}" for note in (f"times of day on the date {date_source}", *decoder.notes)]
    reports = unused.reports(name, f"asterix {sensor[0]:03d}", columns, notes)
    return replace(reports, sac_sic=f"{sensor[1]}/{sensor[2]}", site=place)


def _times(day_s: FloatArray, received_s: FloatArray, name: str, start_s: float | None) -> FloatArray:
    """UTC of the times of day: on the day nearest to the packet's, else counted from the given date."""
    if np.isfinite(received_s).all():
        day_s = np.where(np.isnan(day_s), np.mod(received_s, DAY_S), day_s)
        return np.asarray(day_s + DAY_S * np.round((received_s - day_s) / DAY_S))
    if start_s is None:
        raise UndatedTimes(
            f"{name}: no date: the records have the time of day only", naming("give {start}, the UTC date of the first")
        )
    return unwrapped(day_s, DAY_S, start_s)


FORMAT = SensorFormat(
    "asterix",
    "ASTERIX categories 001, 010, 020, 021, 048 and 062, bare or in a pcap, pcapng, IOSS or RFF recording",
    lambda file: read(file.content, file.source, file.start_s),
    lambda file: looks_like(file.content),
    magic=(PCAPNG,),
)

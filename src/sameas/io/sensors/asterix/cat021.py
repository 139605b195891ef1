"""Category 021: ADS-B target reports of ground stations, editions 2.1 to 2.7."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from sameas.io.sensors.aircraft import errors_of
from sameas.io.sensors.asterix.records import letters, octal, signed, unsigned
from sameas.io.sensors.format import FEET_PER_MINUTE_M_PER_S, FOOT_M, MILE_M, round_covariance, sigma_of_nucp

#: Items with the time of the position, the preferred first: applicability, reception, report transmission.
_TIMES = ("071", "073", "077")


def row(items: Mapping[str, Any]) -> dict[str, Any] | str:
    """The row of a report, or the reason why the record has none."""
    position = items.get("131") or items.get("130")
    if position is None:
        return "021 without a position"
    descriptor = items.get("040", b"") + b"\0\0"
    if descriptor[0] & 0x02 or descriptor[1] & 0x30:
        return "021 of a simulated or test target or a field monitor"
    half = len(position) // 2
    unit = 180.0 / 2.0 ** (30 if half == 4 else 23)
    time = next((items[name] for name in _TIMES if name in items), None)
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
        **_velocity(items.get("160")),
        **_quality(items),
    }
    if values["track_id"] is None:
        values["track_id"] = values["icao"]
    return values


def errors(columns: Mapping[str, Any]) -> dict[str, Any]:
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
            rate = unsigned(items[name]) & 0x7FFF
            return (rate - 0x8000 if rate & 0x4000 else rate) * 6.25 * FEET_PER_MINUTE_M_PER_S
    return None


def _velocity(item: bytes | None) -> dict[str, float]:
    if item is None or item[0] & 0x80:
        return {}
    speed = (unsigned(item[:2]) & 0x7FFF) * MILE_M / 2.0**14
    return {"speed_m_per_s": speed, "course_deg": unsigned(item[2:]) * 360.0 / 2.0**16}


def _quality(items: Mapping[str, Any]) -> dict[str, float]:
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


def notes(source: str) -> tuple[str, ...]:
    """The assumptions about these records."""
    return (
        f"{source}: errors are NACp (radius of 95 % over 2.45), NUCp where the transponder is of version 0, else half "
        "of the containment radius of NIC as the radius of 95 %",
    )

"""Category 062: tracks of a surveillance data processing system, editions 1.16 to 1.21, with their accuracies."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from sameas.io.sensors.asterix.records import letters, octal, signed, unsigned
from sameas.io.sensors.format import FEET_PER_MINUTE_M_PER_S, FOOT_M
from sameas.tracks.coordinates import geodesy

#: Steps of item 500: metres of a standard deviation, degrees of one in WGS84, metres per second of a velocity.
_APC_M, _APW_DEG, _ATV_M_PER_S = 0.5, 180.0 / 2.0**25, 0.25


def row(items: Mapping[str, Any]) -> dict[str, Any] | str:
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
        "pressure_alt_m": _pressure_altitude(items),
        "climb_m_per_s": signed(items["220"]) * 6.25 * FEET_PER_MINUTE_M_PER_S if "220" in items else None,
        "ends": float(len(status) > 1 and bool(status[1] & 0x40)),
        "coasted": float(len(status) > 3 and bool(status[3] & 0x80)),
        **_position(items),
        **_velocity(items.get("185")),
        **_accuracies(items.get("500", {})),
    }


def errors(columns: Mapping[str, Any]) -> dict[str, Any]:
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


def _velocity(item: bytes | None) -> dict[str, float]:
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


def _pressure_altitude(items: Mapping[str, Any]) -> float | None:
    """Metres from the measured flight level, else from the barometric altitude without QNH correction (first bit)."""
    if "136" in items:
        return signed(items["136"]) / 4.0 * 100.0 * FOOT_M
    if "135" in items and not items["135"][0] & 0x80:
        level = unsigned(items["135"]) & 0x7FFF
        return (level - 0x8000 if level & 0x4000 else level) / 4.0 * 100.0 * FOOT_M
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


def notes(source: str) -> tuple[str, ...]:
    """The assumptions about these records."""
    return (
        f"{source}: accuracies are those of item 500; its x and y are read as east and north of the track",
        f"{source}: tracks are the output of a tracker: their errors are correlated in time",
    )

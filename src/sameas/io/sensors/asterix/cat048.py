"""Category 048: target reports of one radar, editions 1.27 to 1.32.

Ranges are slant ranges. The height of the target (Mode C, or of a 3D radar) is a column of its own; position and height
of the radar are not in the records and come from its description.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from sameas.io.sensors.asterix.records import letters, octal, signed, unsigned
from sameas.io.sensors.format import FOOT_M, MILE_M

#: Type of detection, by the first three bits of item 020.
_DETECTIONS = (None, "primary", "secondary", "primary and secondary", "Mode S all-call", "Mode S roll-call",
               "Mode S all-call and primary", "Mode S roll-call and primary")  # fmt: skip


def row(items: Mapping[str, Any]) -> dict[str, Any] | str:
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
        "pressure_alt_m": _pressure_altitude(items.get("090")),
        "icao": f"{unsigned(items['220']):06x}" if "220" in items else None,
        "callsign": letters(items["240"]) if "240" in items else None,
        "mode_a": _mode_a(items.get("070")),
        "track_id": str(unsigned(items["161"]) & 0xFFF) if "161" in items else None,
        "detection": _DETECTIONS[descriptor >> 5],
        **_velocity(items),
        **_quality(items.get("210")),
    }


def errors(columns: Mapping[str, Any]) -> dict[str, Any]:
    """Covariances from the track quality (item 210), where the radar sends it."""
    covariances = {}
    if "sigma_x_m" in columns:
        x, y = columns["sigma_x_m"] ** 2, columns["sigma_y_m"] ** 2
        covariances["covariance_m2"] = np.stack([x, np.where(np.isnan(x), np.nan, 0.0), y], axis=-1)
    return covariances


def _pressure_altitude(item: bytes | None) -> float | None:
    """Metres from the flight level; None where the code is invalid or garbled (first two bits)."""
    if item is None or item[0] & 0xC0:
        return None
    level = unsigned(item) & 0x3FFF
    return (level - 0x4000 if level & 0x2000 else level) / 4.0 * 100.0 * FOOT_M


def _mode_a(item: bytes | None) -> str | None:
    """Mode A code; None where it is invalid or garbled (first two bits)."""
    return None if item is None or item[0] & 0xC0 else octal(item)


def _velocity(items: Mapping[str, Any]) -> dict[str, float]:
    if "200" not in items:
        return {}
    speed, heading = unsigned(items["200"][:2]), unsigned(items["200"][2:])
    return {"speed_m_per_s": speed * MILE_M / 2.0**14, "course_deg": heading * 360.0 / 2.0**16}


def _quality(item: bytes | None) -> dict[str, float]:
    """Standard deviations of the track along x and y; empty where one of them is 0, which means unknown."""
    if item is None or not (item[0] and item[1]):
        return {}
    return {"sigma_x_m": item[0] * MILE_M / 128.0, "sigma_y_m": item[1] * MILE_M / 128.0}


def notes(source: str) -> tuple[str, ...]:
    """The assumptions about these records."""
    return (
        f"{source}: ranges are slant ranges; the description of the radar must state its position and height",
        f"{source}: bearings are taken from true north; errors are those of the radar's description, or of item 210",
    )

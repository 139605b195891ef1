"""aircraft.json: snapshots of dump1090, readsb and tar1090, one per file or one per line; and the traces of readsb.

A snapshot has all aircraft, so most positions repeat the previous snapshot: only new positions become reports, at the
time of the snapshot minus ``seen_pos``. The API of ADS-B Exchange (version 2) and its likes call the list ``ac``.
Accuracy is NACp, else half the containment radius (``rc``, NIC or NUCp); positions by multilateration (mlat) and
rebroadcast (tisb) state none and have no error of their own. The older names of dump1090-mutability (``altitude``,
``speed``, ``vert_rate``, ``nucp``) count as those of today. A trace (``trace_full`` of tar1090 and of ADS-B Exchange)
has the positions of one aircraft, each a list of values in a fixed order.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from sameas.arrays import FloatArray
from sameas.io.sensors.format import (
    FEET_PER_MINUTE_M_PER_S,
    KNOT_M_PER_S,
    SensorFormat,
    json_lines,
    of_json,
    plain_text,
    round_covariance,
    seconds,
    sigma_of_containment,
    sigma_of_nacp,
    sigma_of_nacv,
    sigma_of_nic,
)
from sameas.tracks.coordinates import FOOT_M
from sameas.tracks.reports import LAST_S, Reports, Unused, of_rows

#: Snapshots round the age of a position to 0.1 s, so the times of one position differ by less than 0.25 s.
_SAME_POSITION_S = 0.25
_NO_POSITION = "aircraft without a position"
#: Numeric fields, with their column and its factor.
_NUMBERS = {
    "gs": ("speed_m_per_s", KNOT_M_PER_S), "track": ("course_deg", 1.0), "true_heading": ("heading_deg", 1.0),
    "alt_geom": ("alt_m", FOOT_M), "nac_p": ("nac_p", 1.0), "nac_v": ("nac_v", 1.0), "nic": ("nic", 1.0),
    "rc": ("rc_m", 1.0), "sil": ("sil", 1.0),
}  # fmt: skip
#: Fields of dump1090-mutability, with their names today.
_OLDER = {"altitude": "alt_baro", "speed": "gs", "vert_rate": "baro_rate"}
#: Containment radius of each navigation uncertainty category of position, metres (RTCA DO-260, table 2-11).
_RADIUS_OF_NUCP = {9: 7.5, 8: 25.0, 7: 185.2, 6: 370.4, 5: 926.0, 4: 1852.0, 3: 3704.0, 2: 18_520.0, 1: 37_040.0}


def read(lines: Sequence[str], source: str, last: dict[str, Mapping[str, Any]] | None = None) -> Reports:
    """The positions of aircraft in snapshots.

    lines : of a file that is one snapshot, or has one in each line.
    source : its name in messages.
    last : for a stream, the last report of each aircraft; updated.

    Raises InputError: no snapshot; no position.
    """
    unused = Unused()
    rows: list[dict[str, Any]] = []
    last = {} if last is None else last
    numbered, unused.unit = _documents(lines, unused.damaged)
    for number, snapshot in _snapshots(numbered, unused.damaged):
        for aircraft in snapshot.get("aircraft") or snapshot["ac"]:
            row = _row(number, snapshot["now"], aircraft)
            if isinstance(row, str):
                if row == _NO_POSITION:
                    unused.passed_over[row] += 1
                else:
                    unused.damaged.append((number, row))
            elif _is_same(last.get(row["track_id"]), row):
                unused.passed_over["position repeated"] += 1
            else:
                last[row["track_id"]] = row
                rows.append(row)
    if not rows:
        raise unused.refusal(f"{source}: no position of an aircraft: {unused.reasons() or 'no aircraft has one'}")
    columns = of_rows(rows)
    columns |= errors_of(columns)
    return unused.reports(source, "adsb", columns, notes(source))


def errors_of(columns: Mapping[str, Any]) -> dict[str, FloatArray]:
    """Covariances of position and velocity from ``nac_p``, ``rc_m``, ``nic`` and ``nac_v`` of the transponders."""
    n = len(columns["time_s"])
    absent = np.full(n, np.nan)
    sigma = sigma_of_nacp(columns.get("nac_p", absent))
    for other in (sigma_of_containment(columns.get("rc_m", absent)), sigma_of_nic(columns.get("nic", absent))):
        sigma = np.where(np.isfinite(sigma), sigma, other)
    return {
        "covariance_m2": round_covariance(sigma),
        "velocity_covariance_m2_per_s2": round_covariance(sigma_of_nacv(columns.get("nac_v", absent))),
    }


def notes(source: str) -> tuple[str, ...]:
    """The assumptions about the stated accuracies."""
    return (
        f"{source}: errors are the transponder's NACp (radius of 95 % over 2.45); without it, half of the containment "
        "radius is used as the radius of 95 %; positions that state neither have no error of their own",
    )


def identity_of(address: str) -> dict[str, str | None]:
    """The columns ``icao`` (None for an address with ~, which is not one of ICAO) and ``track_id`` of an address."""
    text = address.strip().lower()
    return {"track_id": text, "icao": None if text.startswith("~") else text}


def _documents(lines: Sequence[str], damaged: list[tuple[int, str]]) -> tuple[list[tuple[int, Any]], str]:
    """Numbered snapshots, and what is counted: lines, of a trace its positions. One snapshot may span all lines."""
    try:
        document = of_json("\n".join(lines))
    except ValueError:
        return json_lines(lines, damaged), "line"
    if isinstance(document, dict) and isinstance(document.get("trace"), list) and "icao" in document:
        return list(_of_trace(document)), "record"
    return [(1, document)], "line"


def _snapshots(
    numbered: Sequence[tuple[int, Any]], damaged: list[tuple[int, str]]
) -> Iterator[tuple[int, Mapping[str, Any]]]:
    """Numbers and snapshots, without those that are none."""
    for number, snapshot in numbered:
        if not isinstance(snapshot, dict) or not isinstance(snapshot.get("aircraft", snapshot.get("ac")), list):
            damaged.append((number, "no list of aircraft"))
        elif not isinstance(snapshot.get("now"), (int, float)):
            damaged.append((number, 'no time ("now")'))
        else:
            try:
                now = seconds(float(snapshot["now"]))
            except OverflowError:
                now = math.inf
            if abs(now) <= LAST_S:
                yield number, snapshot | {"now": now}
            else:
                damaged.append((number, "no time"))


#: Fields by their place in a position of a trace; the ninth is an object with further ones.
_TRACE = {1: "lat", 2: "lon", 3: "alt_baro", 4: "gs", 5: "track", 9: "type", 10: "alt_geom"}
#: Flags of a position of a trace: its vertical rate, its height is geometric.
_GEOMETRIC_RATE, _GEOMETRIC_HEIGHT = 4, 8


def _of_trace(document: Mapping[str, Any]) -> Iterator[tuple[int, Any]]:
    """Numbers and snapshots of the positions of a trace (readsb, README-json.md)."""
    fixed = {"hex": document["icao"], "r": document.get("r"), "t": document.get("t")}
    latest: dict[str, Any] = {}
    for number, values in enumerate(document["trace"], start=1):
        if not isinstance(values, list) or len(values) < 8 or not isinstance(values[0], int | float):
            yield number, None
            continue
        latest |= values[8] if len(values) > 8 and isinstance(values[8], dict) else {}
        flags = values[6] if isinstance(values[6], int) else 0
        stated = {name: values[k] for k, name in _TRACE.items() if k < len(values) and values[k] is not None}
        if flags & _GEOMETRIC_HEIGHT and "alt_baro" in stated:
            stated["alt_geom"] = stated.pop("alt_baro")
        if values[7] is not None:
            stated["geom_rate" if flags & _GEOMETRIC_RATE else "baro_rate"] = values[7]
        further = {name: latest[name] for name in _OF_LATEST if name in latest}
        now = document.get("timestamp")
        yield (
            number,
            {"now": now + values[0] if isinstance(now, int | float) else now, "aircraft": [fixed | further | stated]},
        )


#: Fields of the objects in a trace that stay as they are until the next object.
_OF_LATEST = ("flight", "squawk", "category", "nac_p", "nac_v", "nic", "rc", "sil", "true_heading")


def _with_names_of_today(aircraft: Mapping[str, Any]) -> Mapping[str, Any]:
    """An aircraft with the fields of dump1090-mutability under the names that others use."""
    renamed = {new: aircraft[old] for old, new in _OLDER.items() if old in aircraft and new not in aircraft}
    if isinstance(by_mlat := aircraft.get("mlat"), list) and "lat" in by_mlat:
        return {**aircraft, **renamed, "type": "mlat"}
    category = aircraft.get("nucp")
    if not {"rc", "nic"} & set(aircraft) and isinstance(category, int) and category in _RADIUS_OF_NUCP:
        renamed["rc"] = _RADIUS_OF_NUCP[category]
    return {**aircraft, **renamed}


def _row(number: int, now: float, aircraft: Any) -> dict[str, Any] | str:
    """The row of a report, or the reason why there is none."""
    if not isinstance(aircraft, dict) or not isinstance(aircraft.get("hex"), str):
        return "aircraft without an address"
    aircraft = _with_names_of_today(aircraft)
    if "lat" not in aircraft or "lon" not in aircraft:
        return _NO_POSITION
    try:
        lat, lon = float(aircraft["lat"]), float(aircraft["lon"])
        age = float(aircraft.get("seen_pos", 0.0))
        values = {
            column: scale * float(aircraft[name]) for name, (column, scale) in _NUMBERS.items() if name in aircraft
        }
        on_ground = aircraft.get("alt_baro") == "ground"
        pressure = None if on_ground or "alt_baro" not in aircraft else FOOT_M * float(aircraft["alt_baro"])
        climb = next((float(aircraft[name]) for name in ("geom_rate", "baro_rate") if name in aircraft), None)
    except (TypeError, ValueError, OverflowError):
        return "a position or another value is not a number"
    if not (abs(lat) <= 90.0 and abs(lon) <= 180.0):
        return "position outside the earth"
    return {
        "line": number,
        "time_s": now - age,
        "lat_deg": lat,
        "lon_deg": lon,
        **identity_of(aircraft["hex"]),
        "callsign": plain_text(aircraft.get("flight")),
        "mode_a": plain_text(aircraft.get("squawk")),
        "name": plain_text(aircraft.get("r")),
        "type": plain_text(aircraft.get("t")),
        "category": plain_text(aircraft.get("category")),
        "origin": plain_text(aircraft.get("type")),
        "pressure_alt_m": pressure,
        "on_ground": float(on_ground),
        "climb_m_per_s": None if climb is None else climb * FEET_PER_MINUTE_M_PER_S,
        **values,
    }


def _is_same(last: Mapping[str, Any] | None, row: Mapping[str, Any]) -> bool:
    if last is None:
        return False
    same_position = last["lat_deg"] == row["lat_deg"] and last["lon_deg"] == row["lon_deg"]
    return bool(same_position and abs(last["time_s"] - row["time_s"]) <= _SAME_POSITION_S)


FORMAT = SensorFormat(
    "aircraft",
    "aircraft.json of dump1090, readsb, tar1090 or the API of ADS-B Exchange, a snapshot a line or a file, or a trace",
    lambda file: [read(file.lines, file.source)],
    lambda file: re.search(rb'"(?:aircraft|ac)"\s*:\s*\[|"trace"\s*:\s*\[\s*\[', file.head) is not None,
)

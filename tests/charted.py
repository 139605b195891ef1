"""A seeded map sheet of simulated vessels: columns of objects and records made from motion and noise."""

from __future__ import annotations

from typing import Any

import numpy as np

from sameas.maps import MapAlarm, MapSensor, MapSheet
from sameas.tracks.coordinates import LocalPlane
from sameas.tracks.source import Description, SensorCoverage, Site

SOLENT = LocalPlane(50.77, -1.25)
START_S = 1_700_000_000.0
SOURCES = ("harbour radar", "ais", "camera")
SIGMA_M = (35.0, 12.0)


def sensors(plane: LocalPlane | None) -> tuple[MapSensor, ...]:
    if plane is None:
        site, pier = Site(east_m=-3500.0, north_m=-900.0), Site(east_m=3500.0, north_m=3300.0)
    else:
        (lat, pier_lat), (lon, pier_lon) = plane.to_geodetic([[-3500.0, -900.0], [3500.0, 3300.0]])
        site, pier = Site(lat, lon), Site(pier_lat, pier_lon)
    radar = SensorCoverage(range_m=14_000.0, sector_deg=(300.0, 200.0), shadows_deg=((70.0, 82.0),))
    view = SensorCoverage(range_m=6_000.0, sector_deg=(150.0, 260.0))
    descriptions = [
        Description("harbour radar", "marine radar", site, radar),
        Description("ais", "ais"),
        Description("camera", "camera", pier, view),
    ]
    return tuple(MapSensor.of(each, plane, f"{each.kind.split()[0]}.csv") for each in descriptions)


def charted(
    vessels: int = 12, instants: int = 40, *, every_s: float = 10.0, plane: LocalPlane | None = SOLENT,
    reach_m: float = 9000.0, seed: int = 3, names: dict[int, str] | None = None,
) -> MapSheet:  # fmt: skip
    """Map sheet of vessels on straight courses, detected by a radar, AIS and, one in four, a camera (bearings only).

    names : names of vessels by number. Vessels 1 and 2 pass close to each other and are ambiguous there.
    """
    rng = np.random.default_rng(seed)
    start = rng.uniform(-reach_m, reach_m, (vessels, 2)) * [1.0, 0.7]
    speed, heading = rng.gamma(3.0, 2.0, vessels), rng.uniform(0.0, 2.0 * np.pi, vessels)
    velocity = np.column_stack([np.sin(heading), np.cos(heading)]) * speed[:, None]
    middle = every_s * (instants - 1) / 2.0
    start[1] = start[0] + middle * (velocity[0] - velocity[1]) + [70.0, 0.0]
    objects: list[dict[str, Any]] = []
    records: list[dict[str, Any]] = []
    texts: dict[tuple[int, int], str] = {}
    carries = rng.random(vessels) < 0.75
    sites = sensors(plane)
    unseen = np.zeros(vessels)
    for k in range(instants):
        t = k * every_s
        true = start + velocity * t
        seen = rng.random((vessels, 2)) < [0.85, 0.8]
        seen[:, 1] &= carries
        close = np.hypot(*(true[0] - true[1])) < 250.0
        for n in range(vessels):
            own = []
            for s in range(2):
                if seen[n, s]:
                    own.append(_fix(rng, s, n, t, true[n]))
            if n % 4 == 0 and seen[n].any():
                own.append(_direction(rng, sites[2], n, t, true[n]))
            unseen[n] = 0 if own else unseen[n] + 1
            if unseen[n] > 6:
                continue
            ambiguous = bool(close and n < 2 and len(own) > 1)
            objects.append(_object(rng, n, t, true[n], velocity[n], own, unseen[n], k, ambiguous, names or {}))
            records += own
            found = rng.normal(4.0, 2.0)
            if k % 4 == 0:  # a text is valid until the next one
                texts[k, n + 1] = (
                    f"object {n + 1}: {len(own)} records\n  positions       {found:+.2f}\n"
                    "  identity (MMSI) +9.21\n  prior           -3.10\n"
                )
    alarm = MapAlarm(
        f"mmsi {235000000 + 3} shown twice: 4.1 km apart (31 σ); forged, duplicate or wrong",
        time_s=_time(plane, every_s * (instants // 2)), objects=(min(3, vessels),),
    )  # fmt: skip
    return MapSheet.of(
        "Solent, modelled sensors" if plane is not None else "Basin, metres only",
        _columns(objects, plane), _columns(records, plane),
        instants_s=[_time(plane, k * every_s) for k in range(instants)], sensors=sites, plane=plane, alarms=[alarm],
        summary=[f"{vessels} vessels, {instants} instants", "expected wrong identities: 0.3",
                 "assumed  harbour radar: misses.q = 0.1, a radar shows nine of ten vessels"],
        texts=texts,
    )  # fmt: skip


def _time(plane: LocalPlane | None, t: float) -> float:
    return t if plane is None else START_S + t


def _fix(rng: np.random.Generator, s: int, n: int, t: float, true: Any) -> dict[str, Any]:
    x, y = true + rng.normal(0.0, SIGMA_M[s], 2)
    var = SIGMA_M[s] ** 2
    covariance = 0.4 * var if s == 0 else 0.0
    return {
        "time_s": t, "source": SOURCES[s], "row": int(t) * 1000 + n, "line": int(t) * 1000 + n + 2, "object": n + 1,
        "track_id": str(100 + n) if s == 0 else str(235000000 + n), "p_object": 0.97, "p_alone": 0.02, "age_s": 2.5,
        "x_m": x, "y_m": y, "var_x_m2": var, "cov_xy_m2": covariance, "var_y_m2": var,
    }  # fmt: skip


def _direction(rng: np.random.Generator, eye: MapSensor, n: int, t: float, true: Any) -> dict[str, Any]:
    assert eye.x_m is not None and eye.y_m is not None
    bearing = np.degrees(np.arctan2(true[0] - eye.x_m, true[1] - eye.y_m)) + rng.normal(0.0, 0.3)
    return {
        "time_s": t, "source": SOURCES[2], "row": int(t) * 1000 + n, "line": int(t) * 1000 + n + 2, "object": n + 1,
        "track_id": "", "p_object": 0.9, "p_alone": 0.1, "age_s": 0.5, "bearing_deg": bearing % 360.0,
        "sigma_bearing_deg": 0.3, "sensor_x_m": eye.x_m, "sensor_y_m": eye.y_m,
    }  # fmt: skip


def _object(
    rng: np.random.Generator, n: int, t: float, true: Any, velocity: Any, own: list[dict[str, Any]], unseen: float,
    k: int, ambiguous: bool, names: dict[int, str],
) -> dict[str, Any]:  # fmt: skip
    sigma = 15.0 + 25.0 * unseen
    x, y = true + rng.normal(0.0, 8.0, 2)
    members = " ".join(f"{r['source']}:{r['row']}" for r in own)
    rival = f"{own[0]['source']}:{own[0]['row'] - n + (1 - n)}" if ambiguous else ""
    ais = any(r["source"] == "ais" for r in own)
    label = names.get(n + 1, f"VESSEL {n + 1:02d}" if ais or n % 3 else "")
    return {
        "time_s": t, "object": n + 1, "stage": "tentative" if k < 2 else "coasting" if unseen else "confirmed",
        "x_m": x, "y_m": y, "vx_m_per_s": velocity[0], "vy_m_per_s": velocity[1],
        "speed_m_per_s": float(np.hypot(*velocity)), "course_deg": float(np.degrees(np.arctan2(*velocity)) % 360.0),
        "var_x_m2": sigma**2, "cov_xy_m2": 0.3 * sigma**2, "var_y_m2": 0.6 * sigma**2,
        "n_sources": len({r["source"] for r in own}), "sources": " ".join(sorted({r["source"] for r in own})),
        "members": members, "probability": 0.71 if ambiguous else 0.9876, "runner_up": rival,
        "p_runner_up": 0.28 if ambiguous else 0.004, "label": label, "mmsi": str(235000000 + n) if ais else "",
        "icao": "", "callsign": "", "name": label, "mode_a": "", "type": "cargo" if ais else "", "ambiguous": ambiguous,
    }  # fmt: skip


def _columns(rows: list[dict[str, Any]], plane: LocalPlane | None) -> dict[str, Any]:
    """Masked columns in the layout of a picture."""
    names = dict.fromkeys(name for each in rows for name in each)
    columns: dict[str, Any] = {}
    for name in names:
        values = [each.get(name) for each in rows]
        known = next(v for v in values if v is not None)
        if isinstance(known, str):
            columns[name] = np.array(["" if v is None else v for v in values], dtype=object)
        else:
            filled = np.array([0.0 if v is None else v for v in values])
            columns[name] = np.ma.array(filled, mask=[v is None for v in values])
    if "time_s" in columns:
        columns["time_s"] = np.array([_time(plane, t) for t in columns["time_s"]])
    return columns

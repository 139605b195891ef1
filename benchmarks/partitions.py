"""Catalogues in partitions: is it the answer of one machine, and what a row costs, beside LSDB's nearest neighbour."""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table as Rows

import sameas
from benchmarks import workload
from benchmarks.tables import Table, report
from sameas.partitions.layout import HatsCatalogue
from sameas.partitions.output import write_hats

EVERYTHING = np.array([[0, 12 << 58]], np.int64)
COLUMNS = ("partitions", "pairs", "others than one machine", "claimed twice", "largest |Δp|", "% |Δp| > 1e-6",
           "not certain", "halo, arcsec", "estimating, µs/row", "deciding, µs/row")  # fmt: skip
NOTES = (
    "one machine: everything in memory at once, decided by the same estimates; |Δp| of having no partner",
    "µs of the processor per row of both catalogues, all workers together, reading and writing Parquet included",
)
#: Times of a process and its children, in a process of its own: what was loaded and compiled before does not count.
OURS = """
import resource, sys, time, sameas
def cpu():
    return sum(sum(resource.getrusage(who)[:2]) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
a, b, out, workers = sys.argv[1:]
found = sameas.match(a, b, sigma="pos_err", sigma_unit="arcsec")
start = cpu(); found.estimated; middle = cpu()
written = found.write(out, workers=int(workers), margin_arcsec=0.0)
print(middle - start, cpu() - middle, written.doubtful, written.halo_arcsec)
"""
THEIRS = """
import resource, sys, warnings; warnings.simplefilter("ignore")
import dask, lsdb
dask.config.set(scheduler="synchronous")
a, b = (lsdb.open_catalog(path) for path in sys.argv[1:3])
start = sum(resource.getrusage(resource.RUSAGE_SELF)[:2])
n = len(a.crossmatch(b, radius_arcsec=1.0, suffixes=("_1", "_2")).compute())
print(sum(resource.getrusage(resource.RUSAGE_SELF)[:2]) - start, n)
"""


def tables(n: int, lam: float) -> list[Any]:
    """The workload of the other benchmarks as two tables."""
    scene, _ = workload.crowded(71, n, lam)
    out = []
    for records in (scene.first, scene.second):
        sigma = np.sqrt(records.covariance[:, 0])
        ra, dec = np.mod(records.features[:, 0], 360.0), records.features[:, 1]
        out.append(Rows({"id": np.arange(len(ra)), "ra": ra, "dec": dec, "pos_err": sigma}))
    return out


def run(program: str, *arguments: Any) -> list[float]:
    """What a program prints, as numbers."""
    done = subprocess.run([sys.executable, "-c", program, *map(str, arguments)], capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(done.stderr)
    return [float(word) for word in done.stdout.split()[-4:]]


def told(folder: Path) -> dict[str, Any]:
    """The output's columns."""
    rows = HatsCatalogue.open(folder).rows(EVERYTHING, ["id_1", "id_2", "p_none"])
    return {name: rows.column(name).to_numpy(zero_copy_only=False) for name in ("id_1", "id_2", "p_none")}


def row(folder: Path, both: list[Any], most: int, workers: int) -> tuple[Any, ...]:
    """One way to cut the sky; the second catalogue is cut coarser."""
    for name in ("a", "b", "out"):
        shutil.rmtree(folder / name, ignore_errors=True)
    cells = [write_hats(table, folder / name, most_rows=rows)
             for table, name, rows in zip(both, "ab", (most, 3 * most), strict=True)]  # fmt: skip
    paths = folder / "a", folder / "b"
    estimating, deciding, doubtful, halo = run(OURS, *paths, folder / "out", workers)
    found = sameas.match(*paths, sigma="pos_err", sigma_unit="arcsec")
    work = found.estimated.work
    one, two = (work.read(side, EVERYTHING, np.array([0.0, 0.0, 1.0, 1e9])) for side in (1, 2))
    result = work.identified(one, two)
    partner = np.full(len(both[0]), -1)
    partner[result.first.ids[result.matches.rows_1]] = result.second.ids[result.matches.rows_2]
    p_none = np.empty(len(both[0]))
    p_none[result.first.ids] = np.ma.getdata(result.answers_1.p_none)
    ours = told(folder / "out")
    id_1, id_2 = ours["id_1"].astype(int), np.nan_to_num(ours["id_2"].astype(float), nan=-1.0).astype(int)
    claims, apart = id_2[id_2 >= 0], np.abs(ours["p_none"] - p_none[id_1])
    rows = sum(map(len, both))
    return (
        f"{len(cells[0])} and {len(cells[1])}", len(claims), int(np.count_nonzero(id_2 != partner[id_1])),
        len(claims) - len(np.unique(claims)), float(apart.max()), 100.0 * float((apart > 1e-6).mean()),
        int(doubtful), halo, 1e6 * estimating / rows, 1e6 * deciding / rows,
    )  # fmt: skip


def lsdb_row(folder: Path, rows: int) -> tuple[Any, ...] | None:
    """LSDB's nearest neighbour on the last cut; None where it is not installed."""
    try:
        import lsdb
    except ImportError:
        return None
    seconds, found = run(THEIRS, folder / "a", folder / "b")[-2:]
    nothing = (None,) * 6
    return (f"LSDB {lsdb.__version__}, nearest", int(found), *nothing, None, 1e6 * seconds / rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rows", type=float, default=1e6, help="of objects")
    parser.add_argument("--lam", type=float, default=0.5, help="chance candidates of a record within 3σ")
    parser.add_argument("--most-rows", type=float, nargs="*", default=[3e5, 2.5e4, 1.5e3], help="of a partition")
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    both = tables(int(options.rows), options.lam)
    with tempfile.TemporaryDirectory() as name:
        lines = [row(Path(name), both, int(most), options.workers) for most in options.most_rows]
        peer = lsdb_row(Path(name), sum(map(len, both)))
    title = f"{len(both[0])} and {len(both[1])} rows, λ {options.lam:g}, {options.workers} workers"
    report("partitions", [Table(title, COLUMNS, [*lines, *([peer] if peer else [])], NOTES)])


if __name__ == "__main__":
    main()

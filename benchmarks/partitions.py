"""Matching of catalogues in partitions: agreement with a match in memory, and cost per row, next to LSDB's nearest.

The workload of ``speed`` as HATS catalogues; --awkward puts a pole, RA 0 and holes into the field; --sizes measures
the cost per row against the number of rows. ``scripts/bench partitions``.
"""

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
from benchmarks.tables import Table, report
from sameas.partitions.hats import Cell, HatsCatalogue, finish_catalogue, properties, write_hats
from sameas.partitions.run import PIECE_ROWS

EVERYTHING = np.array([[0, 12 << 58]], np.int64)
#: Objects of one field with --sizes; larger catalogues have several fields at the same declination.
FIELD_OBJECTS = 2_500_000
#: Holes in the field of --awkward.
HOLES = 12
COLUMNS = ("partitions", "pairs", "differences from one machine", "claimed twice", "largest |Δp|", "% |Δp| > 1e-6",
           "not certain", "halo, arcsec", "decided on, per row", "estimating, µs/row", "deciding, µs/row",
           "memory, GB")  # fmt: skip
NOTES = (
    "one machine: everything in memory at once, with the same estimates; Δp of p_none",
    "CPU µs per row of both catalogues in one process, after the imports, reading and writing Parquet included; "
    "decided on: records with halos, counted again if a halo was widened",
)
#: Columns of --sizes.
SIZES = ("rows", "partitions", "pairs", "estimating, µs/row", "deciding, µs/row", "both, seconds", "memory, GB")
#: Programs that measure `sameas` and LSDB in a new process, without imports and compilation.
OURS = """
import dataclasses, resource, sys, sameas
def used():
    return resource.getrusage(resource.RUSAGE_SELF)
def cpu():
    return sum(used()[:2])
def most_memory():
    try:  # ru_maxrss would include the parent process
        with open("/proc/self/status") as lines:
            return next(int(line.split()[1]) / 1e6 for line in lines if line.startswith("VmHWM"))
    except OSError:
        return used().ru_maxrss / (1e9 if sys.platform == "darwin" else 1e6)
a, b, out, rows = sys.argv[1:]
found = dataclasses.replace(sameas.match(a, b, sigma="pos_err", sigma_unit="arcsec"), workers=1)
start = cpu(); found.estimated; middle = cpu()
written = found.write(out, workers=1, margin_arcsec=0.0, piece_rows=int(rows))
print(middle - start, cpu() - middle, written.doubtful, written.halo_arcsec, written.read, written.pairs,
      most_memory())
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


def tables(n: int, lam: float, awkward: bool = False, field: int = 0) -> list[Any]:
    """The workload of the other benchmarks as two tables.

    awkward : around the pole, which includes RA 0, with holes in both sources. field : number, which sets the position.
    """
    from sameas.simulate.scenes import crowded_sky

    rng = np.random.default_rng(71 + field)
    centre_deg = (0.0, 90.0) if awkward else ((150.0 + 18.0 * field) % 360.0, 40.0)
    scene = crowded_sky(rng, n, lam, centre_deg=centre_deg)
    widest = float(90.0 - scene.first.features[:, 1].min())
    holes = widest * rng.uniform(-0.7, 0.7, (HOLES, 2)), widest * rng.uniform(0.05, 0.12, HOLES)
    out = []
    for records in (scene.first, scene.second):
        sigma = np.sqrt(records.covariance[:, 0])
        ra, dec = np.mod(records.features[:, 0], 360.0), records.features[:, 1]
        kept = np.ones(len(ra), np.bool_)
        for (x, y), radius in zip(*holes, strict=True) if awkward else ():
            at = np.radians(ra)
            kept &= np.hypot((90.0 - dec) * np.cos(at) - x, (90.0 - dec) * np.sin(at) - y) > radius
        out.append(
            Rows({"id": field * n + np.arange(kept.sum()), "ra": ra[kept], "dec": dec[kept], "pos_err": sigma[kept]})
        )
    return out


def run(program: str, *arguments: Any) -> list[float]:
    """The numbers that a program prints."""
    done = subprocess.run([sys.executable, "-c", program, *map(str, arguments)], capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(done.stderr)
    return [float(word) for word in done.stdout.splitlines()[-1].split()]


def output(folder: Path) -> dict[str, Any]:
    """The columns of the output."""
    rows = HatsCatalogue.open(folder).rows(EVERYTHING, ["id_1", "id_2", "p_none"])
    return {name: rows.column(name).to_numpy(zero_copy_only=False) for name in ("id_1", "id_2", "p_none")}


def stored(folder: Path, both: list[Any], most: int) -> tuple[str, tuple[Path, Path]]:
    """Write both as catalogues, the second with larger partitions: numbers of partitions, paths."""
    for name in ("a", "b", "out"):
        shutil.rmtree(folder / name, ignore_errors=True)
    one, two = (write_hats(table, folder / name, max_rows=rows)
                for table, name, rows in zip(both, "ab", (most, 3 * most), strict=True))  # fmt: skip
    return f"{len(one)} and {len(two)}", (folder / "a", folder / "b")


def in_fields(folder: Path, rows: int, lam: float, most: int) -> tuple[str, tuple[Path, Path], int]:
    """Write both as catalogues of one or more fields, field by field: numbers of partitions, paths, number of rows."""
    fields = max(1, round(rows / FIELD_OBJECTS))
    coarser = 3 * most if fields == 1 else min(3 * most, rows // fields // 8)  # no partition with rows of two fields
    most = min(most, coarser)
    cells: tuple[list[Cell], list[Cell]] = [], []
    n, paths = 0, (folder / "a", folder / "b")
    for path in (*paths, folder / "out"):
        shutil.rmtree(path, ignore_errors=True)
    for number in range(fields):
        both = tables(rows // fields, lam, field=number)
        n += sum(map(len, both))
        for table, path, found, rows_at_most in zip(both, paths, cells, (most, coarser), strict=True):
            found += write_hats(table, path, max_rows=rows_at_most)
    for path, found in zip(paths, cells, strict=True):
        finish_catalogue(path, found, properties(path / "hats.properties"), {})
    return " and ".join(str(len(found)) for found in cells), paths, n


def size(folder: Path, rows: int, lam: float, most: int) -> tuple[Any, ...]:
    """The row of --sizes for catalogues of ``rows`` objects."""
    cells, paths, n = in_fields(folder, rows, lam, most)
    estimating, deciding, _, _, _, pairs, memory = run(OURS, *paths, folder / "out", PIECE_ROWS)
    return (n, cells, int(pairs), 1e6 * estimating / n, 1e6 * deciding / n, estimating + deciding, memory)


def row(folder: Path, both: list[Any], max_rows: int, piece_rows: int) -> tuple[Any, ...]:
    """The row of the table for partitions of at most ``most`` rows."""
    cells, paths = stored(folder, both, max_rows)
    estimating, deciding, doubtful, halo, read, _, memory = run(OURS, *paths, folder / "out", piece_rows)
    matched = sameas.match(*paths, sigma="pos_err", sigma_unit="arcsec")
    work = matched.estimated.work
    one, two = (work.read(side, EVERYTHING, np.array([0.0, 0.0, 1.0, 1e9])) for side in (1, 2))
    result = work.identified(one, two)
    partner = np.full(len(both[0]), -1)
    partner[result.first.ids[result.matches.rows_1]] = result.second.ids[result.matches.rows_2]
    p_none = np.empty(len(both[0]))
    p_none[result.first.ids] = np.ma.getdata(result.answers_1.p_none)
    joined = output(folder / "out")
    id_1, id_2 = joined["id_1"].astype(int), np.nan_to_num(joined["id_2"].astype(float), nan=-1.0).astype(int)
    claims, difference = id_2[id_2 >= 0], np.abs(joined["p_none"] - p_none[id_1])
    rows = sum(map(len, both))
    return (
        cells, len(claims), int(np.count_nonzero(id_2 != partner[id_1])),
        len(claims) - len(np.unique(claims)), float(difference.max()), 100.0 * float((difference > 1e-6).mean()),
        int(doubtful), halo, read / rows, 1e6 * estimating / rows, 1e6 * deciding / rows, memory,
    )  # fmt: skip


def lsdb_row(folder: Path, rows: int) -> tuple[Any, ...] | None:
    """LSDB's nearest neighbour on the last partitions; None if it is not installed."""
    try:
        import lsdb
    except ImportError:
        return None
    seconds, found = run(THEIRS, folder / "a", folder / "b")[-2:]
    nothing = (None,) * 7
    return (f"LSDB {lsdb.__version__}, nearest", int(found), *nothing, None, 1e6 * seconds / rows, None)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rows", type=float, default=1e6, help="number of objects")
    parser.add_argument("--lam", type=float, default=0.5, help="chance candidates of a record within 3σ")
    parser.add_argument("--most-rows", type=float, nargs="*", default=[3e5, 2.5e4, 1.5e3], help="rows of a partition")
    parser.add_argument("--awkward", action="store_true", help="around a pole, with holes")
    parser.add_argument(
        "--together", action="store_true", help="decide small partitions together (the default of sameas)"
    )
    parser.add_argument("--sizes", type=float, nargs="+", help="instead: cost per row at these numbers of objects")
    options = parser.parse_args()
    if options.sizes:
        with tempfile.TemporaryDirectory() as name:
            rows = [size(Path(name), int(n), options.lam, int(options.most_rows[0])) for n in options.sizes]
        report("partitions", [Table(f"λ {options.lam:g}", SIZES, rows, NOTES[1:])])
        return
    both = tables(int(options.rows), options.lam, options.awkward)
    with tempfile.TemporaryDirectory() as name:
        lines = [
            row(Path(name), both, int(most), PIECE_ROWS if options.together else int(min(4 * most, PIECE_ROWS)))
            for most in options.most_rows
        ]
        peer = lsdb_row(Path(name), sum(map(len, both)))
    title = f"{len(both[0])} and {len(both[1])} rows, λ {options.lam:g}"
    report("partitions", [Table(title, COLUMNS, [*lines, *([peer] if peer else [])], NOTES)])


if __name__ == "__main__":
    main()

"""Writes motion_oracle.csv: stars carried to another epoch by `stilts` (epochPropErr), edge cases first.

Run with a Python that has numpy, where stilts 3.4 or later is installed: python make_motion_oracle.py
Columns: years; the 22 numbers that epochPropErr takes; the 22 that it gives, named out_….
"""

from __future__ import annotations

import csv
import itertools
import subprocess
import tempfile
from pathlib import Path

import numpy as np

SHORT = ("ra", "dec", "plx", "pmra", "pmdec")
VALUES = (*SHORT, "rv")
CORRELATIONS = tuple(f"{a}_{b}_corr" for a, b in itertools.combinations(SHORT, 2))
COLUMNS = (*VALUES, *(f"e_{v}" for v in VALUES), *CORRELATIONS)

BARNARD = (269.4520769, 4.6933650, 547.45, -801.551, 10362.394, -110.5)
EDGES = [  # years, then ra, dec, parallax, pm, radial velocity
    (100.0, *BARNARD),
    (-100.0, *BARNARD),
    (1000.0, *BARNARD),
    (50.0, 12.0, 89.9999, 5.0, 300.0, -200.0, 20.0),
    (50.0, 200.0, -89.9999, 5.0, 300.0, -200.0, 20.0),
    (100.0, 33.0, 89.9999, 8.0, 5.0, 9000.0, -40.0),  # over the pole
    (100.0, 250.0, -89.9999, 8.0, 5.0, -9000.0, -40.0),
    (-100.0, 33.0, 89.99999, 8.0, 5.0, -9000.0, -40.0),
    (40.0, 33.0, 89.9999, 0.0, 0.0, 9000.0, 0.0),  # exactly at the pole, but for rounding, after 40 years
    (100.0, 359.99999, 10.0, 3.0, 1500.0, 20.0, 10.0),  # over RA 0
    (100.0, 0.00001, -10.0, 3.0, -1500.0, 20.0, 10.0),
    (15.5, 0.0, 0.0, 1.0, -1.0, 1.0, 5.0),
    (100.0, 80.0, 30.0, -3.0, 500.0, 400.0, 150.0),  # negative parallax
    (100.0, 80.0, -70.0, -0.01, 50.0, -400.0, -150.0),
    (100.0, 80.0, 30.0, 0.0, 500.0, 400.0, 150.0),  # no parallax
    (100.0, 80.0, 30.0, 10.0, 500.0, 400.0, np.nan),  # no radial velocity
    (-24.75, 120.0, 60.0, 300.0, -3000.0, 1000.0, np.nan),
    (100.0, 80.0, 30.0, 10.0, 0.0, 0.0, 50.0),  # at rest on the sky
    (0.0, 80.0, 30.0, 10.0, 500.0, -300.0, 50.0),
]


def stars(rng: np.random.Generator, random_stars: int) -> np.ndarray:
    """(n, 23) years and the 22 numbers; errors up to those that make second-order terms felt."""
    n = random_stars
    drawn = np.column_stack(
        [
            rng.uniform(-120, 120, n),
            rng.uniform(0, 360, n),
            np.degrees(np.arcsin(rng.uniform(-1, 1, n))),
            rng.normal(0, 1, n) * 10 ** rng.uniform(-2, 2.5, n),
            rng.normal(0, 1, n) * 10 ** rng.uniform(0, 3.5, n),
            rng.normal(0, 1, n) * 10 ** rng.uniform(0, 3.5, n),
            rng.normal(0, 80, n),
        ]
    )
    rows = np.vstack([np.array(EDGES), drawn])
    n = len(rows)
    errors = 10 ** rng.uniform(-2, 1, (n, 6))
    roots = rng.normal(size=(n, 5, 7))
    spread = roots @ roots.swapaxes(1, 2)
    scale = np.sqrt(np.einsum("nii->ni", spread))
    correlations = (spread / scale[:, :, None] / scale[:, None, :])[:, *np.triu_indices(5, 1)]
    table = np.hstack([rows, errors, correlations])
    return np.vectorize(lambda x: float(f"{x:.9g}"))(table)


def main() -> None:
    table = stars(np.random.default_rng(20160101), 180)
    with tempfile.TemporaryDirectory() as folder:
        given, answer = Path(folder, "in.csv"), Path(folder, "out.csv")
        np.savetxt(given, table, "%.17g", ",", header=",".join(("years", *COLUMNS)), comments="")
        given.write_text(given.read_text().replace("nan", ""))
        take = [f"addcol -shape 22 answer epochPropErr(years,array({','.join(COLUMNS)}))", "explodecols answer"]
        command = ["stilts", "tpipe", f"in={given}", "ifmt=csv", f"out={answer}", "ofmt=csv"]
        subprocess.run([*command, *(f"cmd={step}" for step in take)], check=True)
        with answer.open() as file:
            rows = list(csv.reader(file))[1:]
    with Path(__file__).with_name("motion_oracle.csv").open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(("years", *COLUMNS, *(f"out_{c}" for c in COLUMNS)))
        writer.writerows(rows)


if __name__ == "__main__":
    main()

"""Small catalogues of one field."""

from pathlib import Path

import numpy as np
from astropy.table import Table

from sameas.io import write_table


def field(n: int, seed: int) -> Table:
    """n of 120 stars, observed with errors of 0.1 arcsec."""
    truth, noise = np.random.default_rng(1), np.random.default_rng(seed)
    ra, dec = truth.uniform(10.0, 10.4, 120)[:n], truth.uniform(-0.2, 0.2, 120)[:n]
    magnitude = truth.uniform(10.0, 18.0, 120)[:n]
    table = Table({
        "name": [f"s{k}" for k in range(n)],
        "ra": ra + noise.normal(0, 0.1, n) / 3600, "dec": dec + noise.normal(0, 0.1, n) / 3600,
        "sigma": np.full(n, 0.1), "mag": magnitude,
    })  # fmt: skip
    table["ra"].unit = table["dec"].unit = "deg"
    table["sigma"].unit = "arcsec"
    return table


def save(table: Table, path: Path) -> str:
    """The path of the table, written."""
    write_table(table, path, provenance={})
    return str(path)

"""Hipparcos, Gaia and Tycho-2: a joint match of all three, against matches two at a time and in sequence."""

from __future__ import annotations

import argparse
import sys
import time
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import MaskedColumn
from astropy.table import Table as SkyTable

from benchmarks.measure import ROOT
from benchmarks.tables import Table, report
from sameas.sky.catalogue import Catalogue, CatalogueOptions
from sameas.sky.many import ManyMatch, ManyOptions, match_many

sys.path.insert(0, str(ROOT / "examples"))

NAMES = ("hipparcos", "gaia", "tycho2")
UNKNOWN_MOTION_MAS_PER_YR = 20.0
#: Magnitudes are left to check the result.
POSITIONS = ManyOptions(magnitudes="off")


def read_catalogues(index: Path, north_of_deg: float) -> list[Catalogue]:
    """The catalogues of the example, north of a declination."""
    import hipparcos_gaia
    import three_catalogues

    tables = [hipparcos_gaia.hipparcos_table(), hipparcos_gaia.gaia_table(), three_catalogues.tycho_table(index)]
    declination = np.degrees(np.asarray(tables[0]["DErad"])), *(np.asarray(table["dec"]) for table in tables[1:])
    kept = [table[dec > north_of_deg] for table, dec in zip(tables, declination, strict=True)]
    return list(three_catalogues.catalogues(*kept))


def members(many: ManyMatch) -> np.ndarray:
    """(n, S) rows of the catalogues in the order of ``NAMES``, −1 for none."""
    order = [
        [c.name for c in many.catalogues].index(name) for name in NAMES if name in {c.name for c in many.catalogues}
    ]
    return np.asarray(np.ma.filled(many.objects.members, -1)[:, order])


def picture(many: ManyMatch) -> tuple[Catalogue, np.ndarray]:
    """The fused catalogue of two catalogues, and the rows (n, 2) of both that its rows come from.

    An object of both has the fused position and motion at the common epoch; other records are unchanged.
    """
    rows = np.ma.filled(many.objects.members, -1)
    both = np.flatnonzero((rows >= 0).all(axis=1))
    state, covariance = many.state.state, 1e6 * many.state.covariance
    columns = {name: np.full(len(rows), np.nan) for name in _COLUMNS}
    values = [state[both, 0], state[both, 1], *(1e3 * state[both, k] for k in (2, 3))]
    values += [np.sqrt(covariance[both, k, k]) for k in range(4)]
    pairs = [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)]
    sigma = [np.sqrt(covariance[both, k, k]) for k in range(4)]
    values += [covariance[both, a, b] / (sigma[a] * sigma[b]) for a, b in pairs]
    for name, column in zip(_COLUMNS, [*values, np.full(len(both), many.epoch_jyr)], strict=True):
        columns[name][both] = column
    for k, catalogue in enumerate(many.catalogues):
        single = np.flatnonzero((rows[:, k] >= 0) & (rows[:, 1 - k] < 0))
        for name, column in zip(_COLUMNS, _astrometry(catalogue, rows[single, k]), strict=True):
            columns[name][single] = column
    table = SkyTable({name: MaskedColumn(column, mask=np.isnan(column)) for name, column in columns.items()})
    options = CatalogueOptions(sigma_unit="mas", missing_pm_mas_per_yr=UNKNOWN_MOTION_MAS_PER_YR)
    return Catalogue.of(table, "picture", options=options), rows


_COLUMNS = (
    "ra", "dec", "pmra", "pmdec", "ra_error", "dec_error", "pmra_error", "pmdec_error",
    "ra_dec_corr", "ra_pmra_corr", "ra_pmdec_corr", "dec_pmra_corr", "dec_pmdec_corr", "pmra_pmdec_corr", "ref_epoch",
)  # fmt: skip


def _astrometry(catalogue: Catalogue, rows: np.ndarray) -> list[np.ndarray]:
    """The astrometry of rows of a catalogue, in the order of ``_COLUMNS``; NaN for unknown motions."""
    from sameas.sky.population import moving_rows

    a = catalogue.astrometry[rows]
    has_motion = moving_rows(catalogue)[rows]
    components = [0, 1, 3, 4]
    sigma = [np.sqrt(a.covariance[:, k, k]) for k in components]
    pairs = [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)]
    rho = [a.covariance[:, components[u], components[v]] / (sigma[u] * sigma[v]) for u, v in pairs]
    motion = [np.where(has_motion, value, np.nan) for value in (a.pm_ra_mas_per_yr, a.pm_dec_mas_per_yr)]
    sigmas = [*sigma[:2], *(np.where(has_motion, value, np.nan) for value in sigma[2:])]
    return [a.ra_deg, a.dec_deg, *motion, *sigmas, *rho, a.epoch_jyr]


def one_after_another(catalogues: dict[str, Catalogue], last: str) -> np.ndarray:
    """(n, 3) objects if two catalogues are matched first, and the last one with their fused catalogue."""
    first = [name for name in NAMES if name != last]
    joined, rows = picture(match_many([catalogues[name] for name in first], POSITIONS))
    many = match_many([joined, catalogues[last]], POSITIONS)
    both = np.ma.filled(many.objects.members, -1)
    out = np.full((len(both), len(NAMES)), -1)
    for k, name in enumerate(first):
        out[:, NAMES.index(name)] = np.where(both[:, 0] >= 0, rows[both[:, 0], k], -1)
    out[:, NAMES.index(last)] = both[:, 1]
    return out


def two_at_a_time(many: ManyMatch) -> np.ndarray:
    """(n, 3) triples whose three pairs, from matches of two catalogues each, are consistent."""
    import three_catalogues as example

    to_gaia, to_tycho = (example.partners(many, "hipparcos", name) for name in NAMES[1:])
    across = np.append(example.partners(many, "gaia", "tycho2"), -1)[to_gaia]
    closed = np.flatnonzero((to_gaia >= 0) & (to_tycho >= 0) & (across == to_tycho))
    return np.column_stack([closed, to_gaia[closed], to_tycho[closed]])


def objects_of(rows: np.ndarray) -> set[tuple[int, ...]]:
    """The objects with at least two records."""
    return set(map(tuple, rows[(rows >= 0).sum(axis=1) > 1].tolist()))


def compare_methods(index: Path, north_of_deg: float) -> list[Table]:
    """Number of objects of each method, and of those that differ from the joint match."""
    catalogues = dict(zip(NAMES, read_catalogues(index, north_of_deg), strict=True))
    start = time.process_time()
    together = match_many(list(catalogues.values()), POSITIONS)
    seconds = time.process_time() - start
    by_method = {"all together": members(together)}
    for last in NAMES:
        by_method[f"{' and '.join(n for n in NAMES if n != last)}, then {last}"] = one_after_another(catalogues, last)
    joint_objects = objects_of(by_method["all together"])
    rows = []
    for method, objects in by_method.items():
        present = objects >= 0
        counts = [int((present.sum(axis=1) == k).sum()) for k in (3, 2)]
        other_objects = objects_of(objects)
        rows.append([method, *counts, len(other_objects - joint_objects), len(joint_objects - other_objects)])
    closed = two_at_a_time(together)
    triples = {one for one in joint_objects if min(one) >= 0}
    other_objects = objects_of(closed)
    rows.append(
        [
            "two at a time, closed triangles",
            len(closed),
            None,
            len(other_objects - joint_objects),
            len(triples - other_objects),
        ]
    )
    orders = [objects_of(objects) for method, objects in by_method.items() if method != "all together"]
    largest = max(len(one ^ two) for one, two in combinations(orders, 2))
    notes = [
        f"Records: {', '.join(f'{len(c)} of {name}' for name, c in catalogues.items())}; all together took "
        f"{seconds:.0f} s of CPU, {together.iterations} iterations.",
        f"Two orders of one after another differ by up to {largest} objects of several records.",
        f"All together expects {np.sum(1.0 - together.objects.probability[together.objects.n_members > 1]):.0f} wrong.",
    ]
    columns = ["method", "in three", "in two", "only there", "only all together"]
    where = "whole sky" if north_of_deg <= -90 else f"north of {north_of_deg:+g}°"
    return [Table(f"Hipparcos, Gaia, Tycho-2, {where}", columns, rows, notes)]


def main(arguments: Any = None) -> None:
    """Print the table."""
    import three_catalogues

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--index", type=Path, default=three_catalogues.INDEX, help="the index of Tycho-2")
    parser.add_argument("--north-of", type=float, default=-90.0, metavar="DEG", help="a part of the sky")
    options = parser.parse_args(arguments)
    if not options.index.exists():
        sys.exit(f"{options.index} does not exist: apt-get install astrometry-data-tycho2-07-littleendian")
    report("three", compare_methods(options.index, options.north_of))


if __name__ == "__main__":
    main()

